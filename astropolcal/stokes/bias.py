# Licensed under a 3-clause BSD style license - see LICENSE
"""Degree and angle of linear polarization at a low signal-to-noise ratio."""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.stokes._checks import checked_error, number, require

__all__ = ["aolp_interval", "debias_dolp"]


def _asymptotic(dolp, sigma):
    """Return the estimate of Wardle and Kronberg."""
    # two roots, because the squares of tiny values underflow
    return np.minimum(dolp, np.sqrt(np.maximum(dolp - sigma, 0)) * np.sqrt(dolp + sigma))


def _modified_asymptotic(dolp, sigma):
    """Return the estimate of Plaszczynski et al. with b = sigma."""
    from scipy.special import exprel

    # exprel(-x) = (1 - exp(-x)) / x, which holds at any signal-to-noise ratio
    return dolp * (1 - exprel(-(_signal_to_noise(dolp, sigma) ** 2)) / 2)


def _signal_to_noise(dolp, sigma):
    """Return dolp / sigma, but at most 1e100, also where there is no noise."""
    quiet = sigma <= 1e-100 * dolp
    return np.where(quiet, 1e100, dolp / np.where(quiet, 1.0, sigma))


_DEBIAS = {"mas": _modified_asymptotic, "wardle-kronberg": _asymptotic}


def debias_dolp(dolp, sigma, method="mas"):
    r"""
    Remove the positive noise bias of a degree of linear polarization.

    Parameters
    ----------
    dolp : float or array_like
        Measured degree of linear polarization, zero or positive. Noise may
        lift it above 1.
    sigma : float or array_like
        Error of q and u; where they differ, `transverse_error`.
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
    if method not in _DEBIAS:
        raise ParameterError(f"method = {method!r} must be one of {sorted(_DEBIAS)}")
    return _DEBIAS[method](
        *np.broadcast_arrays(checked_error(dolp, "dolp"), checked_error(sigma, "sigma"))
    )


def _wedge_probability(half_angle, snr):
    """
    Return the probability that (q, u) falls within a wedge about its mean.

    The wedge starts at the origin, the mean lies ``snr`` standard deviations
    away on its axis. The integral of the angular density of Naghizadeh-Khouei
    and Clarke over the wedge is Owen's T function of its edge.
    """
    distance = snr * np.sin(half_angle)
    slope = np.cos(half_angle) / np.sin(half_angle)
    from scipy.special import ndtr, owens_t

    return 1 - 2 * owens_t(distance, slope) - ndtr(-distance)


def aolp_interval(dolp, sigma, probability=0.6827):
    """
    Return the half-width of the AoLP interval of given probability.

    Unlike `aolp_error` it holds at any signal-to-noise ratio: it grows to
    ``90 deg * probability`` where the light is unpolarized and any angle is
    as likely as any other.

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
    half = _bisect_half_angle(snr, probability) / 2
    return np.rad2deg(np.where(sigma > 0, half, 0.0)) * u.deg


def _bisect_half_angle(snr, probability):
    """Return the half-angle of the wedge that holds the probability."""
    low = np.zeros(snr.shape)
    # forty standard deviations hold any probability below one in floats
    high = np.minimum(np.pi, 40.0 / np.maximum(snr, 1.0))
    # 60 halvings of at most pi reach the last bit of a float
    for _ in range(60):
        middle = (low + high) / 2
        inside = _wedge_probability(middle, snr) > probability
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    return (low + high) / 2
