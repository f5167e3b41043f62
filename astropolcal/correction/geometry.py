# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Images turned north up, and polarization about a star.

Position angles run from north through east. On the sky north is up and east is left, so they
run counter-clockwise in an image. A frame whose rows of pixels point elsewhere is resampled;
the Stokes parameters need no further rotation, because the measurement rows refer to the axes
of the sky already.
"""

from functools import lru_cache

import astropy.units as u
import numpy as np

from astropolcal.correction._spline import resample, suits
from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad

__all__ = ["azimuthal", "derotate", "derotate_variance", "position_angles"]

_QUARTER = np.pi / 2
# also the share of a pixel without a value from which on the result has none
_EXACT = 1e-12
# pixels after which the influence of a spline's neighbours has fallen below rounding
_REACH = 25


def derotate(
    image, position_angle, *, centre=None, size=None, mirrored=False, order=3, centre_out=None
):
    """
    Resample images so that north is up and east is left.

    Parameters
    ----------
    image : `~numpy.ndarray`
        Shape (..., Y, X).
    position_angle : `~astropy.units.Quantity`
        Of the +y axis of the image, from north through east.
    centre : (float, float), optional
        0-based x and y of the point that stays; by default the middle.
    size : int or (int, int), optional
        Rows and columns of the result; by default those of the image.
    mirrored : bool
        Whether east is to the right of north in the image.
    order : int
        Of the spline, 0 to 5.
    centre_out : (float, float), optional
        Where the point lies in the result; by default in the middle, or where it was if
        ``size`` is not given.

    Returns
    -------
    `~numpy.ndarray`
        NaN outside the image, and where a pixel without a value has a share.

    Raises
    ------
    ParameterError
        If the angle has no unit or is not finite, or a choice is not possible.

    Notes
    -----
    Surface brightness is interpolated. A pixel keeps its area in a rotation, so this
    conserves flux up to what leaves the image.

    Examples
    --------
    A star up in an image whose y axis points east is east of the middle, so left:

    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.correction import derotate
    >>> image = np.zeros((5, 5))
    >>> image[3, 2] = 1
    >>> np.argwhere(derotate(image, 90 * u.deg).round(9)).tolist()
    [[2, 1]]
    """
    image = np.asarray(image, dtype=float)
    grid = _grid(image, position_angle, centre, size, mirrored, centre_out)
    if not 0 <= order <= 5:
        raise ParameterError(f"order = {order}; allowed are 0 to 5")
    return _resampled(image, *grid, order)


def derotate_variance(
    variance, position_angle, *, centre=None, size=None, mirrored=False, order=3, centre_out=None
):
    """
    Return the variances of images resampled by `derotate`.

    Parameters
    ----------
    variance : `~numpy.ndarray`
        Of the pixels, which are independent; shape (..., Y, X).
    position_angle, centre, size, mirrored, order, centre_out
        As for `derotate`.

    Returns
    -------
    `~numpy.ndarray`
        Correlations between neighbours, which resampling makes, are not in it.

    Notes
    -----
    The sum of the squared weights of the spline, times the variance interpolated linearly,
    which is exact where the variance is the same within a few pixels.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.correction import derotate_variance
    >>> derotate_variance(np.ones((9, 9)), 45 * u.deg)[4, 4:7].round(2).tolist()
    [1.0, 0.7, 0.6]
    """
    variance = np.asarray(variance, dtype=float)
    matrix, offset, shape = _grid(variance, position_angle, centre, size, mirrored, centre_out)
    # linear at most: a cubic spline would make negative variances beside a bright pixel
    smooth = _resampled(variance, matrix, offset, shape, min(order, 1))
    y, x = _places(matrix, offset, shape)
    # the weights of a spline in two dimensions are products, and so are the sums of their squares
    return smooth * _gain(y, order) * _gain(x, order)


def _grid(image, position_angle, centre, size, mirrored, centre_out):
    """Return matrix and offset from pixels of the result to those of the image, and its shape."""
    angle = float(angle_to_rad(position_angle, "position_angle"))
    if not np.isfinite(angle):
        raise ParameterError(f"position_angle = {position_angle} must be finite")
    height, width = image.shape[-2:]
    middle = ((width - 1) / 2, (height - 1) / 2)
    x, y = _point("centre", middle if centre is None else centre)
    shape = (height, width) if size is None else tuple(np.broadcast_to(size, 2).tolist())
    if centre_out is None:
        centre_out = (x, y) if size is None else ((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    out_x, out_y = _point("centre_out", centre_out)
    cosine, sine = _clean(np.cos(angle)), _clean(np.sin(angle))
    parity = -1.0 if mirrored else 1.0
    # a direction at the position angle of +y, (-sin, cos) on the sky, is (0, 1) in the image
    matrix = np.array([[cosine, -sine], [parity * sine, parity * cosine]])
    offset = np.array([y, x]) - matrix @ [out_y, out_x]
    return matrix, offset, shape


def _clean(value):
    """Return -1, 0 and 1 exactly, so that quarter turns do not interpolate."""
    return float(np.rint(value)) if abs(value - np.rint(value)) < _EXACT else float(value)


def _point(name, point):
    point = np.asarray(point, dtype=float)
    if point.shape != (2,) or not np.all(np.isfinite(point)):
        raise ParameterError(f"{name} = {point}; two finite numbers are needed, x and y")
    return point


def _resampled(image, matrix, offset, shape, order):
    # then nothing is interpolated, and quarter turns give back each number bit by bit
    if _on_pixels(matrix, offset):
        order = 0
    image, offset = _cropped(image, matrix, offset, shape)
    flat = image.reshape(-1, *image.shape[-2:])
    bad = ~np.isfinite(flat)
    filled = np.where(bad, 0.0, flat) if bad.any() else flat
    out = _interpolated(filled, matrix, offset, shape, order)
    if bad.any():
        # planes mostly lack the same pixels
        bad = bad[:1] if (bad == bad[0]).all() else bad
        # what a cubic spline takes from pixels farther away than the next is small, and would grow
        # the holes of masked pixels by many rows
        share = _interpolated(bad.astype(float), matrix, offset, shape, min(order, 1))
        out[np.broadcast_to(share > _EXACT, out.shape)] = np.nan
    out[:, _outside(matrix, offset, shape, flat.shape[1:])] = np.nan
    return out.reshape(*image.shape[:-2], *shape)


def _interpolated(planes, matrix, offset, shape, order):
    """Return what a spline through finite planes gives at the places of the result."""
    from scipy.ndimage import affine_transform

    if suits(planes.shape, order):
        return resample(planes, matrix, offset, shape, order)
    # mirrored edges are what the filter of our own spline assumes too
    settings = {"output_shape": shape, "mode": "mirror", "order": order}
    return np.stack([affine_transform(plane, matrix, offset, **settings) for plane in planes])


def _cropped(image, matrix, offset, shape):
    """Return the part of the image that has an influence on the result, and the offset in it."""
    corners = np.array([[0, 0, shape[0] - 1, shape[0] - 1], [0, shape[1] - 1, 0, shape[1] - 1]])
    places = matrix @ corners + offset[:, None]
    # the window of a frame is small in its cube: most of the filtering would be for nothing
    low = np.floor(places.min(axis=1)).astype(int) - _REACH
    high = np.ceil(places.max(axis=1)).astype(int) + _REACH + 1
    low = np.clip(low, 0, image.shape[-2:])
    high = np.clip(high, low, image.shape[-2:])
    if np.any(high <= low):
        # nothing of the image is there
        return image, offset
    return image[..., low[0] : high[0], low[1] : high[1]], offset - low


def _on_pixels(matrix, offset):
    """Return whether pixels fall on pixels."""
    whole = np.abs(offset - np.rint(offset)) < 1e-9
    return bool(np.isin(matrix, (-1.0, 0.0, 1.0)).all() and whole.all())


def _outside(matrix, offset, shape, image_shape):
    """Return which pixels of the result lie beyond the middles of the image's last pixels."""
    y, x = _places(matrix, offset, shape)
    # rounding of the rotation must not cost the outermost rows
    slack = 1e-9
    height, width = image_shape
    outside = (y < -slack) | (y > height - 1 + slack)
    return outside | (x < -slack) | (x > width - 1 + slack)


def _places(matrix, offset, shape):
    """Return y and x in the image of all pixels of the result."""
    rows, columns = np.indices(shape)
    y = matrix[0, 0] * rows + matrix[0, 1] * columns + offset[0]
    x = matrix[1, 0] * rows + matrix[1, 1] * columns + offset[1]
    return y, x


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


def _gain(place, order):
    return np.interp(place - np.floor(place), *_gain_table(order))


def position_angles(shape, centre=None):
    """
    Return the position angle of every pixel about a point, of an image with north up.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    centre : (float, float), optional
        0-based x and y; by default the middle.

    Returns
    -------
    `~astropy.units.Quantity`
        Degree, from north through east, shape (Y, X), between -180 and 180.

    Examples
    --------
    >>> from astropolcal.correction import position_angles
    >>> position_angles((3, 3))[1, 0]
    <Quantity 90. deg>
    """
    height, width = shape
    x, y = _point("centre", ((width - 1) / 2, (height - 1) / 2) if centre is None else centre)
    rows, columns = np.indices(shape)
    # north is +y and east is -x
    return np.rad2deg(np.arctan2(x - columns, rows - y)) * u.deg


def azimuthal(q, u_, centre=None):
    r"""
    Return the Stokes parameters with respect to the direction to a star.

    Parameters
    ----------
    q, u_ : `~numpy.ndarray`
        Stokes Q and U, north up, shape (..., Y, X).
    centre : (float, float), optional
        0-based x and y of the star; by default the middle.

    Returns
    -------
    q_phi, u_phi : `~numpy.ndarray`
        Positive ``q_phi`` is polarization across the direction to the star.

    Notes
    -----
    :math:`Q_\phi = -Q\cos 2\phi - U\sin 2\phi`, :math:`U_\phi = Q\sin 2\phi - U\cos 2\phi`
    with the position angle :math:`\phi` (de Boer et al. 2020, A&A 633, A63,
    doi:10.1051/0004-6361/201834989).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.correction import azimuthal
    >>> q_phi, u_phi = azimuthal(np.full((3, 3), -1.0), np.zeros((3, 3)))
    >>> q_phi[2, 1], q_phi[1, 2]
    (np.float64(1.0), np.float64(-1.0))
    """
    cosine, sine = _double(np.shape(q)[-2:], centre)
    return -q * cosine - u_ * sine, q * sine - u_ * cosine


def _double(shape, centre):
    angle = 2 * position_angles(shape, centre).to_value(u.rad)
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
