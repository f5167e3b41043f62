# Licensed under a 3-clause BSD style license - see LICENSE
"""The ``astropolcal`` command; its entry point is `astropolcal.scripts.main.main`."""

__all__ = []
