# Licensed under a 3-clause BSD style license - see LICENSE
"""
Stokes algebra: degrees and angle of polarization, their errors and their bias.

A Stokes vector is (I, Q, U, V) with Q = vertical - horizontal,
U = (+45) - (-45) and V = right - left, so that the angle of linear
polarization runs counter-clockwise from vertical when looking into the beam.
Lower-case q, u are Q / I and U / I.

Bad input (a NaN, an intensity that is not positive, a negative error) raises
`~astropolcal.exceptions.ParameterError`; it never comes back as a number.
"""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad, to_unit

__all__ = ["aolp_error", "aolp_interval", "debias_dolp", "dolp_error"]


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


# rounding allowed where a degree of polarization is compared with one
ROUNDING = 1e-12


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


def finite_stokes(stokes, axis):
    """Return finite Stokes vectors with their four components first."""
    stokes = np.asarray(getattr(stokes, "value", stokes), dtype=float)
    # of a Quantity the number: the unit of flux cancels in all that follows
    if stokes.ndim == 0 or not -stokes.ndim <= axis < stokes.ndim or stokes.shape[axis] != 4:
        raise ParameterError(
            f"stokes has shape {stokes.shape}; axis {axis} must hold the four components I, Q, U, V"
        )
    require(np.isfinite(stokes), stokes, "stokes", "finite")
    return np.moveaxis(stokes, axis, 0)


def bright_stokes(stokes, axis):
    """Return finite Stokes vectors of positive intensity, components first."""
    components = finite_stokes(stokes, axis)
    require(components[0] > 0, components[0], "the intensity I", "positive")
    return components
