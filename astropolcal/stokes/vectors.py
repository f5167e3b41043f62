# Licensed under a 3-clause BSD style license - see LICENSE
"""Degree and angle of polarization, and the Stokes vectors that have them."""

import astropy.units as u
import numpy as np

from astropolcal.stokes._checks import (
    ROUNDING,
    bright_stokes,
    checked_error,
    finite_stokes,
    number,
    require,
)
from astropolcal.units import angle_to_rad

__all__ = [
    "angle_of_linear_polarization",
    "degree_of_linear_polarization",
    "degree_of_polarization",
    "is_physical_stokes",
    "polarization_angle",
    "stokes_from_dolp_aolp",
]


def degree_of_linear_polarization(stokes, axis=-1):
    r"""
    Return the degree of linear polarization, :math:`\sqrt{Q^2 + U^2} / I`.

    Parameters
    ----------
    stokes : array_like or `~astropy.units.Quantity`
        Stokes vectors (I, Q, U, V), any common flux unit.
    axis : int
        The axis of length 4 that holds the components.

    Returns
    -------
    `~numpy.ndarray`
        DoLP, of the shape of ``stokes`` without ``axis``.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or I is not positive.

    Notes
    -----
    Equation for the DoLP in Sec. 2 of the CHARIS recalibration paper.

    Examples
    --------
    >>> from astropolcal.stokes import degree_of_linear_polarization
    >>> float(degree_of_linear_polarization([2.0, 0.6, 0.8, 0.0]))
    0.5
    """
    intensity, q, u_, _ = bright_stokes(stokes, axis)
    return np.hypot(q, u_) / intensity


def degree_of_polarization(stokes, axis=-1):
    r"""
    Return the degree of polarization, :math:`\sqrt{Q^2 + U^2 + V^2} / I`.

    Parameters
    ----------
    stokes : array_like or `~astropy.units.Quantity`
        Stokes vectors (I, Q, U, V), any common flux unit.
    axis : int
        The axis of length 4 that holds the components.

    Returns
    -------
    `~numpy.ndarray`
        Degree of polarization, of the shape of ``stokes`` without ``axis``.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or I is not positive.

    Examples
    --------
    >>> from astropolcal.stokes import degree_of_polarization
    >>> float(degree_of_polarization([3.0, 1.0, 2.0, 2.0]))
    1.0
    """
    intensity, q, u_, v = bright_stokes(stokes, axis)
    return np.hypot(np.hypot(q, u_), v) / intensity


def angle_of_linear_polarization(stokes, axis=-1):
    r"""
    Return the angle of linear polarization, :math:`\arctan2(U, Q) / 2`.

    Parameters
    ----------
    stokes : array_like or `~astropy.units.Quantity`
        Stokes vectors (I, Q, U, V), any common flux unit.
    axis : int
        The axis of length 4 that holds the components.

    Returns
    -------
    `~astropy.units.Quantity`
        AoLP in degrees, at least 0 and below 180, counter-clockwise from
        +Q, of the shape of ``stokes`` without ``axis``.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite, I is not positive, or
        Q = U = 0, where no angle exists.

    Notes
    -----
    Equation for the AoLP in Sec. 2 of the CHARIS recalibration paper, with the
    quadrant taken from the signs of Q and U.

    Examples
    --------
    >>> from astropolcal.stokes import angle_of_linear_polarization
    >>> angle_of_linear_polarization([1.0, -0.02, 0.0, 0.0])
    <Quantity 90. deg>
    """
    _, q, u_, _ = bright_stokes(stokes, axis)
    require((q != 0) | (u_ != 0), q, "Q = U", "different from zero for an angle to exist")
    # an angle of nothing would be a number that means nothing
    return polarization_angle(q, u_) * u.deg


def polarization_angle(q, u):
    """
    Return the angle of linear polarization of plain numbers, without any check.

    Parameters
    ----------
    q, u : float or array_like
        Normalized Stokes parameters, or those of one flux unit.

    Returns
    -------
    `~numpy.ndarray`
        Degrees, at least 0 and below 180; NaN where q or u is.

    Examples
    --------
    >>> from astropolcal.stokes import polarization_angle
    >>> float(polarization_angle(0.0, -0.01))
    135.0
    """
    with np.errstate(invalid="ignore"):
        angle = np.rad2deg(np.arctan2(u, q) / 2) % 180
    # the remainder of a tiny negative angle rounds to the excluded end
    return np.where(angle >= 180, 0.0, angle)


def stokes_from_dolp_aolp(dolp, aolp, circular=0.0, intensity=1.0):
    """
    Return the Stokes vectors of light of given polarization.

    Parameters
    ----------
    dolp : float or array_like
        Degree of linear polarization, 0 to 1 (or a Quantity in percent).
    aolp : `~astropy.units.Quantity`
        Angle of linear polarization, counter-clockwise from +Q.
    circular : float or array_like
        V / I, -1 to 1.
    intensity : float or array_like
        I, positive.

    Returns
    -------
    `~numpy.ndarray`
        Stokes vectors of shape (..., 4), the arguments broadcast together.

    Raises
    ------
    ParameterError
        If a value is not finite or out of range, or the light would be more
        than fully polarized.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.stokes import stokes_from_dolp_aolp
    >>> stokes_from_dolp_aolp(0.5, 45 * u.deg).round(12).tolist()
    [1.0, 0.0, 0.5, 0.0]
    """
    dolp, circular = number(dolp, "dolp"), number(circular, "circular")
    angle, intensity = angle_to_rad(aolp, "aolp"), number(intensity, "intensity")
    require(np.isfinite(angle), angle, "aolp", "finite")
    require(intensity > 0, intensity, "intensity", "positive")
    require((dolp >= 0) & (dolp <= 1 + ROUNDING), dolp, "dolp", "between 0 and 1")
    # linear and circular polarization add in squares
    total = np.hypot(dolp, circular)
    require(total <= 1 + ROUNDING, total, "the degree of polarization", "at most 1")
    parts = (np.ones_like(total), dolp * np.cos(2 * angle), dolp * np.sin(2 * angle), circular)
    return np.stack(np.broadcast_arrays(*(part * intensity for part in parts)), axis=-1)


def is_physical_stokes(stokes, tolerance=1e-9, axis=-1):
    r"""
    Tell which Stokes vectors light can have: :math:`I \ge \sqrt{Q^2 + U^2 + V^2}`.

    Parameters
    ----------
    stokes : array_like or `~astropy.units.Quantity`
        Stokes vectors (I, Q, U, V).
    tolerance : float
        Excess of the polarized intensity over I that still passes, as a
        fraction of I.
    axis : int
        The axis of length 4 that holds the components.

    Returns
    -------
    `~numpy.ndarray` of bool
        Of the shape of ``stokes`` without ``axis``. No light at all is
        physical.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite, or the tolerance is
        negative.

    Examples
    --------
    >>> from astropolcal.stokes import is_physical_stokes
    >>> is_physical_stokes([[1.0, 0.6, 0.8, 0.0], [1.0, 0.9, 0.9, 0.0]]).tolist()
    [True, False]
    """
    tolerance = checked_error(tolerance, "tolerance")
    intensity, q, u_, v = finite_stokes(stokes, axis)
    # no intensity, no polarization: 0 <= 0 holds
    return np.hypot(np.hypot(q, u_), v) <= intensity * (1 + tolerance)
