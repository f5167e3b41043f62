# Licensed under a 3-clause BSD style license - see LICENSE
"""The fit, its starts, its strategies and its gauge."""

from astropolcal.calibration.fit.strategies import search_branches

__all__ = ["search_branches"]
