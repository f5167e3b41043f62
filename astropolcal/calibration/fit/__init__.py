# Licensed under a 3-clause BSD style license - see LICENSE
"""The fit, its starts, its strategies and its gauge."""

__all__ = []
