# Licensed under a 3-clause BSD style license - see LICENSE
"""
Degree and angle of linear polarization, their errors and their bias.

A Stokes vector is (I, Q, U, V) with Q = vertical - horizontal, U = (+45) - (-45) and V = right -
left, so that the angle of linear polarization runs counter-clockwise from vertical when looking
into the beam. Lower-case q, u are Q / I and U / I.

Bad input (a NaN, an intensity that is not positive, a negative error) raises
`~astropolcal.exceptions.ParameterError`; it never comes back as a number.
"""

import math
from functools import cache

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import to_unit
from astropolcal.words import check_choice

__all__ = ["aolp_interval", "debias_dolp"]


def polarization_angle(q, u):
    """
    Return the angle of linear polarization of plain numbers, in degree from 0 to below 180.

    Without any check; NaN where q or u is.
    """
    with np.errstate(invalid="ignore"):
        angle = np.rad2deg(np.arctan2(u, q) / 2) % 180
    # the remainder of a tiny negative angle rounds to the excluded end
    return np.where(angle >= 180, 0.0, angle)


def polarization_errors(q, u_, sigma_q, sigma_u, covariance=0.0):
    r"""
    Return the errors along and across the direction of linear polarization.

    To first order, of numbers whose degree p is above zero. The error along (q, u) is that of the
    degree, :math:`\sigma_p^2 = (q^2 \sigma_q^2 + u^2 \sigma_u^2 + 2 q u\,\sigma_{qu}) / p^2`. That
    across is :math:`b^2 = (u^2 \sigma_q^2 + q^2 \sigma_u^2 - 2 q u\,\sigma_{qu}) / p^2` of
    Plaszczynski et al. 2014, doi:10.1093/mnras/stu270; it sets the error of the angle, see
    `angle_error`, and the positive bias of the degree. Without covariance the first, and the second
    over 2 p, are :math:`s_p` and :math:`s_\chi` in Sec. 2.3 of the CHARIS recalibration paper.
    """
    # hypot neither overflows nor underflows where the squares would
    dolp = np.hypot(q, u_)
    c, s = q / dolp, u_ / dolp
    cross = 2 * c * s * covariance
    along = np.sqrt(np.maximum((c * sigma_q) ** 2 + (s * sigma_u) ** 2 + cross, 0))
    across = np.sqrt(np.maximum((s * sigma_q) ** 2 + (c * sigma_u) ** 2 - cross, 0))
    return along, across


def angle_error(dolp, sigma, is_measured=False):
    r"""
    Return the rms error of the angle, in degree, of light of a degree of polarization.

    For equal and independent errors of q and u, from the angular distribution of Naghizadeh-Khouei
    & Clarke (1993). To first order it is sigma / (2 p); without polarization, where any angle is as
    likely, :math:`90^\circ / \sqrt 3`. With ``sigma`` that across the direction of polarization it
    is right wherever the errors are small, or equal. The degree is the true one; of one that
    ``is_measured`` the bias is taken away in the way that leaves the errors nearest to the truth.
    """
    dolp, sigma = np.broadcast_arrays(dolp, sigma)
    dolp = debias_dolp(dolp, sigma, "wardle-kronberg") if is_measured else dolp
    snr = _signal_to_noise(dolp, sigma)
    first = np.rad2deg(0.5 / np.maximum(snr, _KNOWN[-1])) * np.hypot(1, 1 / np.maximum(snr, 1))
    found = np.where(snr < _KNOWN[-1], np.interp(snr, _KNOWN, _angle_errors()), first)
    return np.where(sigma > 0, found, np.where(sigma == 0, 0.0, np.nan))


# signal-to-noise ratios between which the error of the angle is interpolated; above the last, two
# terms of its series are good to a millionth
_KNOWN = np.linspace(0.0, 40.0, 4001)


@cache
def _angle_errors():
    # of the angle in (q, u) beyond twelve standard deviations is nothing
    nodes, weights = np.polynomial.legendre.leggauss(100)
    half = np.minimum(np.pi, 12 / np.maximum(_KNOWN, 1))[:, None] / 2
    angle, snr = half * (nodes + 1), _KNOWN[:, None]
    along, across = snr * np.cos(angle), snr * np.sin(angle)
    density = np.exp(-(snr**2) / 2) / np.pi
    # a pipeline that loads a calibration need not have scipy
    normal = (1 + np.vectorize(math.erf)(along / np.sqrt(2))) / 2
    density = density + np.sqrt(2 / np.pi) * along * np.exp(-(across**2) / 2) * normal
    return np.rad2deg(np.sqrt((density * angle**2 * half) @ weights)) / 2


def _signal_to_noise(dolp, sigma):
    """Return dolp / sigma, but at most 1e100, also where there is no noise."""
    quiet = sigma <= 1e-100 * dolp
    return np.where(quiet, 1e100, dolp / np.where(quiet, 1.0, sigma))


def debias_dolp(dolp, sigma, method="mas"):
    r"""
    Remove the positive noise bias of a degree of linear polarization.

    Parameters
    ----------
    dolp : float or array_like
        Measured degree of linear polarization, zero or positive. Noise may lift it above 1.
    sigma : float or array_like
        Error of q and u, across the direction of polarization where they differ.
    method : {"mas", "wardle-kronberg"}
        ``"mas"``: modified asymptotic estimator,
        :math:`p - \sigma^2 (1 - e^{-p^2/\sigma^2}) / (2 p)`, continuous,
        never zero for p > 0, unbiased above a signal-to-noise ratio of two
        (Plaszczynski et al. 2014, doi:10.1093/mnras/stu270).
        ``"wardle-kronberg"``: :math:`\sqrt{p^2 - \sigma^2}`, zero below
        :math:`p = \sigma` (Wardle & Kronberg 1974, doi:10.1086/153240).

    Returns
    -------
    `~numpy.ndarray`
        Debiased DoLP, the arguments broadcast together.

    Raises
    ------
    ParameterError
        If a value is not finite or negative, or the method is unknown.

    Examples
    --------
    >>> from astropolcal.stokes import debias_dolp
    >>> float(debias_dolp(0.05, 0.03, method="wardle-kronberg").round(12))
    0.04
    >>> float(debias_dolp(0.05, 0.03).round(4))
    0.0416
    """
    from scipy.special import exprel

    check_choice("method", method, ("mas", "wardle-kronberg"), ParameterError)
    dolp, sigma = np.broadcast_arrays(checked_error(dolp, "dolp"), checked_error(sigma, "sigma"))
    if method == "wardle-kronberg":
        # two roots, because the squares of tiny values underflow
        return np.minimum(dolp, np.sqrt(np.maximum(dolp - sigma, 0)) * np.sqrt(dolp + sigma))
    # Plaszczynski et al. with b = sigma; exprel(-x) = (1 - exp(-x)) / x, which holds at any
    # signal-to-noise ratio
    return dolp * (1 - exprel(-(_signal_to_noise(dolp, sigma) ** 2)) / 2)


def aolp_interval(dolp, sigma, probability=0.6827):
    """
    Return the half-width of the AoLP interval of given probability.

    Unlike the error to first order it holds at any signal-to-noise ratio: it grows to ``90 deg *
    probability`` where the light is unpolarized and any angle is as likely as any other.

    Parameters
    ----------
    dolp : float or array_like
        True degree of linear polarization, in practice the debiased one.
    sigma : float or array_like
        Error of q and u, taken as equal and independent.
    probability : float
        Probability that the measured angle lies within the half-width of the
        true one, above 0 and below 1.

    Returns
    -------
    `~astropy.units.Quantity`
        Half-width in degrees, the arguments broadcast together.

    Raises
    ------
    ParameterError
        If a value is not finite or out of range, or dolp = sigma = 0.

    Notes
    -----
    Solves the integral of the angular distribution of Naghizadeh-Khouei &
    Clarke (1993, A&A 274, 968; bibcode 1993A&A...274..968N) by bisection.

    Examples
    --------
    >>> from astropolcal.stokes import aolp_interval
    >>> aolp_interval([0.0, 0.01, 0.1], 0.01).round(2)
    <Quantity [61.44, 28.99,  2.87] deg>
    """
    dolp, sigma = np.broadcast_arrays(checked_error(dolp, "dolp"), checked_error(sigma, "sigma"))
    probability = number(probability, "probability")
    require((probability > 0) & (probability < 1), probability, "probability", "in (0, 1)")
    require((dolp > 0) | (sigma > 0), dolp, "dolp = sigma", "positive for an angle to exist")
    # half of the wedge in (q, u) is the angle there, which is twice that of polarization
    snr, probability = np.broadcast_arrays(_signal_to_noise(dolp, sigma), probability)
    from scipy.special import ndtr, owens_t

    low = np.zeros(snr.shape)
    # forty standard deviations hold any probability below one in floats
    high = np.minimum(np.pi, 40.0 / np.maximum(snr, 1.0))
    # 60 halvings of at most pi reach the last bit of a float
    for _ in range(60):
        middle = (low + high) / 2
        distance, slope = snr * np.sin(middle), np.cos(middle) / np.sin(middle)
        inside = 1 - 2 * owens_t(distance, slope) - ndtr(-distance) > probability
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    half = ((low + high) / 2) / 2
    return np.rad2deg(np.where(sigma > 0, half, 0.0)) * u.deg


def require(good, value, name, allowed):
    """Raise a ParameterError that names the first value that is not good."""
    if np.all(good):
        return
    good, value = np.broadcast_arrays(good, value)
    # argmin of booleans is the first that is False
    where = np.unravel_index(np.argmin(good), good.shape)
    place = f" at index {tuple(int(i) for i in where)}" if where else ""
    raise ParameterError(f"{name} = {float(value[where])!r}{place} must be {allowed}")


def number(value, name):
    """Return a dimensionless value as finite floats."""
    value = to_unit(value, None, name)
    require(np.isfinite(value), value, name, "finite")
    return value


def checked_error(value, name):
    """Return a standard deviation as finite floats that are not negative."""
    value = number(value, name)
    require(value >= 0, value, name, "zero or positive")
    return value
