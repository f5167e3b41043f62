# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors of degree and angle of linear polarization, to first order."""

import astropy.units as u
import numpy as np

from astropolcal.stokes._checks import ROUNDING, checked_error, number, require

__all__ = ["aolp_error", "dolp_error", "transverse_error"]

# where the Stokes parameter u is an argument, it hides the units
_DEGREE = u.deg


def _polarization_and_errors(q, u_, sigma_q, sigma_u, covariance):
    """Return q / p, u / p, p and the checked errors of a polarized measurement."""
    q, u_ = number(q, "q"), number(u_, "u")
    sigma_q, sigma_u = checked_error(sigma_q, "sigma_q"), checked_error(sigma_u, "sigma_u")
    covariance = number(covariance, "covariance")
    # Cauchy-Schwarz; full correlation lies on the limit to rounding
    limit = sigma_q * sigma_u
    require(
        np.abs(covariance) <= limit * (1 + ROUNDING),
        covariance,
        "covariance",
        "at most sigma_q sigma_u in size",
    )
    # hypot neither overflows nor underflows where the squares would
    dolp = np.hypot(q, u_)
    require(dolp > 0, dolp, "dolp", "positive for first-order errors to exist (see aolp_interval)")
    return q / dolp, u_ / dolp, dolp, sigma_q, sigma_u, covariance


def dolp_error(q, u, sigma_q, sigma_u, covariance=0.0):
    r"""
    Return the error of the degree of linear polarization, to first order.

    Parameters
    ----------
    q, u : float or array_like
        Normalized Stokes parameters, not both zero.
    sigma_q, sigma_u : float or array_like
        Their standard deviations.
    covariance : float or array_like
        Their covariance, at most ``sigma_q * sigma_u`` in size.

    Returns
    -------
    `~numpy.ndarray`
        Standard deviation of :math:`p = \sqrt{q^2 + u^2}`: the error along
        the direction of polarization.

    Raises
    ------
    ParameterError
        If a value is not finite, an error is negative, the covariance is
        impossible or q = u = 0, where p has no derivative.

    Notes
    -----
    :math:`\sigma_p^2 = (q^2 \sigma_q^2 + u^2 \sigma_u^2 + 2 q u\,\sigma_{qu}) / p^2`,
    which without covariance is :math:`s_p` in Sec. 2.3 of the CHARIS
    recalibration paper. Good above a signal-to-noise ratio of about three.

    Examples
    --------
    >>> from astropolcal.stokes import dolp_error
    >>> float(dolp_error(0.02, 0.0, 0.001, 0.003))
    0.001
    """
    along, across, _, sigma_q, sigma_u, covariance = _polarization_and_errors(
        q, u, sigma_q, sigma_u, covariance
    )
    variance = (along * sigma_q) ** 2 + (across * sigma_u) ** 2 + 2 * along * across * covariance
    return np.sqrt(np.maximum(variance, 0))


def transverse_error(q, u, sigma_q, sigma_u, covariance=0.0):
    r"""
    Return the error of (q, u) across the direction of polarization.

    It sets the error of the angle, and the positive bias of the degree of
    linear polarization: pass it to `debias_dolp` when the errors of q and u
    differ.

    Parameters
    ----------
    q, u : float or array_like
        Normalized Stokes parameters, not both zero.
    sigma_q, sigma_u : float or array_like
        Their standard deviations.
    covariance : float or array_like
        Their covariance, at most ``sigma_q * sigma_u`` in size.

    Returns
    -------
    `~numpy.ndarray`
        Standard deviation across the direction of polarization.

    Raises
    ------
    ParameterError
        If a value is not finite, an error is negative, the covariance is
        impossible or q = u = 0.

    Notes
    -----
    :math:`b^2 = (u^2 \sigma_q^2 + q^2 \sigma_u^2 - 2 q u\,\sigma_{qu}) / p^2`, the
    noise bias of Plaszczynski et al. (2014), doi:10.1093/mnras/stu270.

    Examples
    --------
    >>> from astropolcal.stokes import transverse_error
    >>> float(transverse_error(0.02, 0.0, 0.001, 0.003))
    0.003
    """
    along, across, _, sigma_q, sigma_u, covariance = _polarization_and_errors(
        q, u, sigma_q, sigma_u, covariance
    )
    variance = (across * sigma_q) ** 2 + (along * sigma_u) ** 2 - 2 * along * across * covariance
    return np.sqrt(np.maximum(variance, 0))


def aolp_error(q, u, sigma_q, sigma_u, covariance=0.0):
    r"""
    Return the error of the angle of linear polarization, to first order.

    Parameters
    ----------
    q, u : float or array_like
        Normalized Stokes parameters, not both zero.
    sigma_q, sigma_u : float or array_like
        Their standard deviations.
    covariance : float or array_like
        Their covariance, at most ``sigma_q * sigma_u`` in size.

    Returns
    -------
    `~astropy.units.Quantity`
        Standard deviation of the AoLP in degrees.

    Raises
    ------
    ParameterError
        If a value is not finite, an error is negative, the covariance is
        impossible or q = u = 0, where no angle exists.

    See Also
    --------
    aolp_interval : for a low signal-to-noise ratio.

    Notes
    -----
    `transverse_error` over 2 p, which without covariance is :math:`s_\chi` in
    Sec. 2.3 of the CHARIS recalibration paper.

    Examples
    --------
    >>> from astropolcal.stokes import aolp_error
    >>> aolp_error(0.02, 0.0, 0.001, 0.001).round(3)
    <Quantity 1.432 deg>
    """
    across = transverse_error(q, u, sigma_q, sigma_u, covariance)
    # the angle is half that of (q, u)
    return np.rad2deg(across / (2 * np.hypot(number(q, "q"), number(u, "u")))) * _DEGREE
