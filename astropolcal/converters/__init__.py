# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibration files: nodes of an ASDF tree, and the files themselves."""

__all__ = []
