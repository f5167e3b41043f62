# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Images turned north up, and polarization about a star.

Position angles run from north through east. On the sky north is up and east is left, so they
run counter-clockwise in an image. A frame whose rows of pixels point elsewhere is resampled;
the Stokes parameters need no further rotation, because the measurement rows refer to the axes
of the sky already.
"""

from functools import lru_cache

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad

__all__ = []

# also the share of a pixel without a value from which on the result has none
_EXACT = 1e-12
# pixels after which the influence of a spline's neighbours has fallen below rounding
_REACH = 25


def derotate(image, position_angle, *, centre=None, size=None, mirrored=False, order=3):
    """Resample images (..., Y, X) so that north is up and east is left.

    NaN outside and where a pixel without a value has a share.

    ``position_angle`` is that of the +y axis, from north through east; ``centre`` the 0-based x and
    y that stays (by default the middle), or lies in the middle of the result of ``size`` rows and
    columns; ``mirrored`` images have east to the right of north; ``order`` is the spline's, 0 to 5.
    Surface brightness is interpolated: a rotation keeps the area of a pixel, so flux is conserved.
    """
    image = np.asarray(image, dtype=float)
    if not 0 <= order <= 5:
        raise ParameterError(f"order = {order}; allowed are 0 to 5")
    return _resampled(image, *_grid(image.shape, position_angle, centre, size, mirrored), order)


def derotate_variance(variance, position_angle, *, centre=None, size=None, mirrored=False, order=3):
    """Return the variances of images turned by `derotate`, of independent pixels.

    The sum of the squared spline weights times the variance interpolated linearly: exact where the
    variance is the same within a few pixels. Correlations that resampling makes are not in it.
    """
    variance = np.asarray(variance, dtype=float)
    grid = _grid(variance.shape, position_angle, centre, size, mirrored)
    # linear at most: a cubic spline would make negative variances beside a bright pixel
    return _resampled(variance, *grid, min(order, 1)) * _gain(grid, order)


def derotate_gain(shape, position_angle, *, centre=None, size=None, mirrored=False, order=3):
    """
    Return the mean share of their variance that pixels keep when an image is turned by `derotate`.

    A sum of many of them keeps all of it, because neighbours are correlated.
    """
    return _gain(_grid(shape, position_angle, centre, size, mirrored), order).mean()


def _grid(image_shape, position_angle, centre, size, mirrored):
    """Return matrix and offset from pixels of the result to those of the image, and its shape."""
    angle = float(angle_to_rad(position_angle, "position_angle"))
    if not np.isfinite(angle):
        raise ParameterError(f"position_angle = {position_angle} must be finite")
    shape = image_shape[-2:] if size is None else tuple(np.broadcast_to(size, 2).tolist())
    x, y = _point(centre, image_shape[-2:])
    out_x, out_y = (x, y) if size is None else _point(None, shape)
    cosine, sine = _clean(np.cos(angle)), _clean(np.sin(angle))
    parity = -1.0 if mirrored else 1.0
    # a direction at the position angle of +y, (-sin, cos) on the sky, is (0, 1) in the image
    matrix = np.array([[cosine, -sine], [parity * sine, parity * cosine]])
    offset = np.array([y, x]) - matrix @ [out_y, out_x]
    return matrix, offset, shape


def _clean(value):
    """Return -1, 0 and 1 exactly, so that quarter turns do not interpolate."""
    return float(np.rint(value)) if abs(value - np.rint(value)) < _EXACT else float(value)


def _point(point, shape):
    """Return x and y of a point of an image, by default its middle."""
    middle = [(shape[1] - 1) / 2, (shape[0] - 1) / 2]
    point = np.asarray(middle if point is None else point, dtype=float)
    if point.shape != (2,) or not np.all(np.isfinite(point)):
        raise ParameterError(f"centre = {point}; two finite numbers are needed, x and y")
    return point


def _resampled(image, matrix, offset, shape, order):
    # then nothing is interpolated, and quarter turns give back each number bit by bit
    if np.isin(matrix, (-1.0, 0.0, 1.0)).all() and np.all(np.abs(offset - np.rint(offset)) < 1e-9):
        order = 0
    image, offset = _cropped(image, matrix, offset, shape)
    flat = image.reshape(-1, *image.shape[-2:])
    bad = ~np.isfinite(flat)
    filled = _filled(flat, bad) if bad.any() else flat
    out = _interpolated(filled, matrix, offset, shape, order)
    if bad.any():
        # planes mostly lack the same pixels
        bad = bad[:1] if (bad == bad[0]).all() else bad
        # what a cubic spline takes from pixels farther away than the next is small, and would grow
        # the holes of masked pixels by many rows
        share = _interpolated(bad.astype(float), matrix, offset, shape, min(order, 1))
        out[np.broadcast_to(share > _EXACT, out.shape)] = np.nan
    # beyond the middles of the last pixels; rounding of the rotation must not cost those
    slack = 1e-9
    for place, size in zip(_places(matrix, offset, shape), flat.shape[1:], strict=True):
        out[:, (place < -slack) | (place > size - 1 + slack)] = np.nan
    return out.reshape(*image.shape[:-2], *shape)


def _filled(planes, bad):
    """Return planes whose missing pixels continue their neighbours, so that no spline rings."""
    from scipy.ndimage import gaussian_filter

    def smooth(values):
        return gaussian_filter(np.where(bad, 0.0, values), [0, 1, 1], mode="constant") / weight

    weight = gaussian_filter((~bad).astype(float), [0, 1, 1], mode="constant")
    weight[weight == 0] = np.inf
    # twice, which is exact also where an image is curved
    once = smooth(planes)
    return np.where(bad, once + smooth(planes - once), planes)


def _interpolated(planes, matrix, offset, shape, order):
    """Return what a spline through finite planes gives at the places of the result."""
    from scipy.ndimage import affine_transform

    settings = {"output_shape": shape, "mode": "mirror", "order": order}
    return np.stack([affine_transform(plane, matrix, offset, **settings) for plane in planes])


def _cropped(image, matrix, offset, shape):
    """Return the part of the image that has an influence on the result, and the offset in it."""
    places = _places(matrix, offset, shape).reshape(2, -1)
    # the window of a frame is small in its cube: most of the filtering would be for nothing
    low = np.floor(places.min(axis=1)).astype(int) - _REACH
    high = np.ceil(places.max(axis=1)).astype(int) + _REACH + 1
    low = np.clip(low, 0, image.shape[-2:])
    high = np.clip(high, low, image.shape[-2:])
    if np.any(high <= low):
        # nothing of the image is there
        return image, offset
    return image[..., low[0] : high[0], low[1] : high[1]], offset - low


def _places(matrix, offset, shape):
    """Return y and x in the image of all pixels of the result."""
    return np.tensordot(matrix, np.indices(shape), axes=1) + offset[:, None, None]


def _gain(grid, order):
    """Return the sums of the squared weights of a spline at the places of the result."""
    # the weights in two dimensions are products, and so are the sums of their squares
    y, x = (np.interp(p - np.floor(p), *_gain_table(order)) for p in _places(*grid))
    return y * x


@lru_cache(maxsize=8)
def _gain_table(order, steps=100):
    """Return the sum of the squared weights of a spline at fractions of a pixel."""
    from scipy.ndimage import map_coordinates

    # the response to a single pixel at all distances is the kernel of the spline
    impulse = np.zeros(41)
    impulse[20] = 1.0
    fraction = np.linspace(0, 1, steps + 1)
    places = (np.arange(-15, 16)[:, None] + fraction + 20).ravel()
    kernel = map_coordinates(impulse, places[None], order=order, mode="grid-constant")
    return fraction, (kernel.reshape(31, -1) ** 2).sum(axis=0)


def azimuthal(q, u_, centre=None):
    """
    Return Q_phi and U_phi about a star; positive Q_phi is polarization across the direction to it.

    Q_phi = -Q cos 2 phi - U sin 2 phi, U_phi = Q sin 2 phi - U cos 2 phi with the position angle
    phi (de Boer et al. 2020, A&A 633, A63, doi:10.1051/0004-6361/201834989); maps (..., Y, X),
    north up.
    """
    cosine, sine = _double(np.shape(q)[-2:], centre)
    return -q * cosine - u_ * sine, q * sine - u_ * cosine


def _double(shape, centre):
    """Return cosine and sine of twice the position angle of every pixel about a point."""
    x, y = _point(centre, shape)
    rows, columns = np.indices(shape)
    # from north, +y, through east, which is -x
    angle = 2 * np.arctan2(x - columns, rows - y)
    return np.cos(angle), np.sin(angle)


def azimuthal_variances(variance_q, variance_u, covariance, centre=None):
    """Return the variances of `azimuthal` from those of Q and U and their covariance."""
    cosine, sine = _double(np.shape(variance_q)[-2:], centre)
    with np.errstate(invalid="ignore"):
        cross = 2 * cosine * sine * covariance
        # an infinite variance of Q says nothing of a combination without Q
        return (
            cosine**2 * variance_q + sine**2 * variance_u + cross,
            sine**2 * variance_q + cosine**2 * variance_u - cross,
        )
