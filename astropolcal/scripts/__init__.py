# Licensed under a 3-clause BSD style license - see LICENSE
"""The ``astropolcal`` command."""

__all__ = ["calibrate", "common", "info", "main", "simulate"]
