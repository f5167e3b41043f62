# Licensed under a 3-clause BSD style license - see LICENSE
"""What data determine: rank, null directions, mirror solutions, and their effect on the sky."""

__all__ = []
