# Licensed under a 3-clause BSD style license - see LICENSE
"""What observations of a star tell of the telescope's diattenuation."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad

__all__ = ["TelescopeInformation", "telescope_information"]

_NAMES = ("star_q", "star_u", "diattenuation", "offset_q", "offset_u")
# singular values below this part of the largest count as zero
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class TelescopeInformation:
    """
    Expected covariance of a star's polarization and a telescope's diattenuation.

    Parameters
    ----------
    names : tuple of str
        ``star_q``, ``star_u``, ``diattenuation``; with an offset also
        ``offset_q``, ``offset_u``.
    covariance : `~numpy.ndarray`
        In the order of ``names``; rows and columns of what the frames cannot
        separate are infinite.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.standards import telescope_information
    >>> info = telescope_information([-45, 45] * u.deg)
    >>> round(info.error("star_q"), 2)
    0.71
    """

    names: tuple
    covariance: np.ndarray

    def error(self, name):
        """
        Return the standard error of one of the parameters.

        Parameters
        ----------
        name : str
            One of ``names``.

        Returns
        -------
        float
            Infinite if the frames do not determine it.

        Raises
        ------
        ParameterError
            If there is no such parameter.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.standards import telescope_information
        >>> telescope_information([10] * u.deg).error("diattenuation")
        inf
        """
        if name not in self.names:
            raise ParameterError(f"no parameter {name!r}; there are {', '.join(self.names)}")
        place = self.names.index(name)
        return float(np.sqrt(self.covariance[place, place]))

    @property
    def diattenuation(self):
        """Standard error of the telescope's diattenuation."""
        return self.error("diattenuation")


def telescope_information(
    parallactic, altitude=None, *, frame_error=1.0, star_error=None, offset=False
):
    r"""
    Return how well frames separate a telescope's diattenuation from the star.

    In the frame of a tertiary mirror the star turns by the parallactic angle
    :math:`\psi`, while the diattenuation :math:`D` of the mirror stays along q:

    .. math::
        q' = q \cos 2\psi + u \sin 2\psi + D, \qquad
        u' = -q \sin 2\psi + u \cos 2\psi .

    With an offset, the instrument adds a constant in its own frame, which
    is turned by minus the altitude as in the chain of an alt-azimuth telescope's
    Nasmyth focus. Each frame is taken to measure q' and u' with the same
    error; the covariance is that of linear least squares. For a star that is not
    known and without an offset,

    .. math:: \sigma_D = \sigma_\mathrm{frame} \big/ \sqrt{n (1 - R^2)}, \qquad
              R = \left|\frac1n \sum e^{2 i \psi}\right| ,

    so only the spread of the parallactic angle counts: a half turn of the double
    angle is all that one can wish for, and a star that barely turns says
    nothing.

    Parameters
    ----------
    parallactic : `~astropy.units.Quantity`
        One angle a frame, shape (n,).
    altitude : `~astropy.units.Quantity`, optional
        One a frame; needed with ``offset``.
    frame_error : float
        Standard error of q and of u in one frame. The default of 1 gives errors
        in units of it.
    star_error : float, optional
        Standard error of the star's q and u in a catalogue; by default the star
        is not known.
    offset : bool
        Whether an offset of the instrument is determined as well.

    Returns
    -------
    TelescopeInformation

    Raises
    ------
    ParameterError
        If angles are missing or do not match, or an error is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.standards import telescope_information
    >>> angles = np.linspace(-45, 45, 101) * u.deg
    >>> round(telescope_information(angles, frame_error=1e-3).diattenuation, 5)
    0.00013
    """
    psi = _angles(parallactic, "parallactic")
    turn = np.zeros_like(psi)
    if altitude is not None:
        turn = _angles(altitude, "altitude")
    elif offset:
        raise ParameterError("an offset can only be separated with the altitude of each frame")
    if psi.shape != turn.shape:
        raise ParameterError(f"there are {psi.size} parallactic angles and {turn.size} altitudes")
    columns = _design(psi, turn, offset) / _positive(frame_error, "frame_error")
    if star_error is not None:
        columns = np.vstack([columns, _prior(columns.shape[1], star_error)])
    return TelescopeInformation(_NAMES[: columns.shape[1]], _covariance(columns))


def _design(psi, turn, offset):
    """Return the derivatives of all q' and u' by the parameters, shape (2 n, 3 or 5)."""
    # in the frame of the instrument; the turn itself changes no information
    star, mirror = _rotation(psi - turn), _rotation(-turn)[..., :1]
    # columns: star q, star u, diattenuation, and with an offset its q and u
    parts = [star, mirror]
    if offset:
        parts.append(np.broadcast_to(np.eye(2), star.shape))
    return np.concatenate(parts, axis=-1).reshape(2 * len(psi), -1)


def _rotation(angle):
    """Return the matrices that turn (q, u) by an angle, shape (n, 2, 2)."""
    cosine, sine = np.cos(2 * angle), np.sin(2 * angle)
    return np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], axis=-2)


def _prior(width, star_error):
    # a star known beforehand is two more measurements, of its q and u
    rows = np.zeros((2, width))
    rows[:, :2] = np.eye(2) / _positive(star_error, "star_error")
    return rows


def _covariance(columns):
    """Return the covariance of least squares; infinite where nothing is determined."""
    # all right vectors are there even if one frame gives fewer rows than columns; with more rows
    # the full matrix of left ones would have the square of their number
    short = columns.shape[0] < columns.shape[1]
    _, size, directions = np.linalg.svd(columns, full_matrices=short)
    # one frame gives two rows for three or more columns: the missing singular values are zero
    size = np.concatenate([size, np.zeros(columns.shape[1] - len(size))])
    good = size > _RANK * size.max()
    half = directions[good] / size[good, None]
    covariance = half.T @ half
    # a parameter that takes part in an open direction has an infinite error, not that of a
    # pseudo-inverse; null vectors are exact to about the root of the rank tolerance
    lost = np.any(np.abs(directions[~good]) > np.sqrt(_RANK), axis=0)
    covariance[lost, :] = covariance[:, lost] = np.inf
    return covariance


def _angles(value, name):
    angles = np.atleast_1d(angle_to_rad(value, name))
    if angles.ndim != 1 or not angles.size or not np.all(np.isfinite(angles)):
        raise ParameterError(f"{name} must be finite angles, one a frame")
    return angles


def _positive(value, name):
    value = u.Quantity(value).to_value(u.dimensionless_unscaled)
    if not (np.isfinite(value) and value > 0):
        raise ParameterError(f"{name} = {value!r} must be a positive number")
    return float(value)
