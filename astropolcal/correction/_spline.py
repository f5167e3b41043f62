# Licensed under a 3-clause BSD style license - see LICENSE
"""
Many images resampled on one grid by a spline.

The same as `scipy.ndimage.affine_transform` with ``mode="mirror"`` makes of each of them. All
slices of a cube turn by the same angle, so the weights of the pixels are worked out once, and
applied to all slices as a sparse matrix.
"""

from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy.sparse import csr_array

# below, the weights cost more than they save, or the ends of the recursion meet
_FEWEST_PLANES, _SHORTEST = 5, 30
# the pole of the cubic spline filter and the terms after which its powers are below 1e-14
# (Unser, Aldroubi and Eden 1993, IEEE Trans. Signal Process. 41, 821)
_POLE = np.sqrt(3.0) - 2.0
_RECURSION = 25
# pixels of the result whose weights are in memory at a time: 16 each, 12 bytes a weight
_BLOCK = 2**17


def suits(shape, order):
    """Return whether `resample` takes images of this shape, (planes, rows, columns)."""
    return order in (1, 3) and shape[0] >= _FEWEST_PLANES and min(shape[1:]) >= _SHORTEST


def resample(planes, matrix, offset, shape, order):
    """Return finite images at ``matrix @ pixel + offset``, (planes, *shape)."""
    count, height, width = planes.shape
    # the slices are the last axis: the filter and the matrix then run over contiguous numbers
    values = np.ascontiguousarray(planes.transpose(1, 2, 0), dtype=float)
    if order == 3:
        _filter(values.reshape(height, -1))
    # now (column, row, slice), so that the pixel of a weight is row + height * column
    values = np.ascontiguousarray(values.swapaxes(0, 1))
    if order == 3:
        _filter(values.reshape(width, -1))
    values = values.reshape(-1, count)
    out = np.empty((count, *shape))
    rows = max(_BLOCK // shape[1], 1)
    for first in range(0, shape[0], rows):
        block = (first, min(first + rows, shape[0]), shape[1])
        weights = _weights(block, tuple(map(tuple, matrix)), tuple(offset), (height, width), order)
        out[:, first : block[1]] = (weights @ values).T.reshape(count, -1, shape[1])
    return out


def _filter(lines):
    """Replace values by the coefficients of a cubic spline, along the first axis, in place."""
    # the gain of the two passes, (1 - z)(1 - 1/z) = 6 for z = sqrt(3) - 2
    lines *= 6.0
    powers = _POLE ** np.arange(_RECURSION)
    # start of the causal pass as if the signal went on mirrored at its first sample
    lines[0] = powers @ lines[:_RECURSION]
    for before, line in pairwise(lines):
        line += _POLE * before
    # start of the anticausal pass, mirrored at the last sample
    lines[-1] = _POLE / (_POLE**2 - 1) * (lines[-1] + _POLE * lines[-2])
    for line, behind in zip(lines[-2::-1], lines[:0:-1], strict=True):
        np.subtract(behind, line, out=line)
        line *= _POLE


# both beams, fluxes and then variances, are turned alike
@lru_cache(maxsize=2)
def _weights(block, matrix, offset, size, order):
    """Return the weight of each pixel, column by column of the image, in those of the result."""
    i, j = np.arange(*block[:2])[:, None], np.arange(block[2])
    lines = zip(matrix, offset, strict=True)
    places = ((by_row * i + by_column * j + o).ravel() for (by_row, by_column), o in lines)
    (y, by_y), (x, by_x) = (_taps(p, n, order) for p, n in zip(places, size, strict=True))
    index = (y[:, :, None] + size[0] * x[:, None, :]).reshape(len(y), -1)
    weights = (by_y[:, :, None] * by_x[:, None, :]).reshape(index.shape)
    # every row of the matrix has the same number of weights, 4 or 16
    ends = np.arange(0, weights.size + 1, weights.shape[1], dtype=np.int32)
    shape = (len(index), size[0] * size[1])
    return csr_array((weights.ravel(), index.ravel(), ends), shape=shape)


def _taps(place, n, order):
    """Return the pixels that have a share at each place along an axis of n pixels, and shares."""
    # what lies outside has no value in the end; it must only not lie outside of the array
    place = np.clip(place, 0.0, n - 1.0)
    # the last pixel itself lies at the end of the last interval, not at the begin of another
    first = np.minimum(place.astype(np.int32), n - 2)
    f = (place - first)[:, None]
    g = 1.0 - f
    if order == 1:
        return first[:, None] + np.arange(2, dtype=np.int32), np.concatenate([g, f], axis=1)
    # the cubic B-spline at distances 1 + f, f, 1 - f and 2 - f, times six
    shares = [g**3, 4 - 6 * f**2 + 3 * f**3, 4 - 6 * g**2 + 3 * g**3, f**3]
    pixels = first[:, None] + np.arange(-1, 3, dtype=np.int32)
    # taps beyond an end fall on the pixels mirrored about it
    pixels = n - 1 - np.abs(n - 1 - np.abs(pixels))
    return pixels, np.concatenate(shares, axis=1) / 6
