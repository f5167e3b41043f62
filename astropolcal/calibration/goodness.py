# Licensed under a 3-clause BSD style license - see LICENSE
"""
Goodness of fit: whether the residuals exceed the noise.

Chi-square where the noise is known, F where it is itself estimated.
"""

from dataclasses import dataclass

import numpy as np
from astropy.table import QTable

from astropolcal.calibration.covariance import prior_noise
from astropolcal.calibration.noise import data_by_wavelength, noise_from_errors
from astropolcal.calibration.weighting import weighting_of
from astropolcal.exceptions import FitError

__all__ = ["LackOfFit", "lack_of_fit"]

# a singular value below this share of the largest belongs to a null direction
_RANK = 1e-9
# fewer degrees of freedom than this give no test
_LEAST_FREEDOM = 0.5
# what happens by chance less often than this is no chance
_UNLIKELY = 0.01


@dataclass(frozen=True)
class LackOfFit:
    """
    How far residuals exceed the noise.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Columns ``dataset``, ``wavelength``, ``n``, ``chi2``, ``expected``, ``dof``,
        ``chi2_reduced``, ``dof_noise`` and ``p_value``.
    chi2, expected : float
        Of all data and priors together, and what it is on average if the model
        is true.
    p_value : float
        Probability of residuals at least as large, were the model true and the
        noise right.
    words : str
        The verdict in a sentence, and what the noise includes.
    priors : dict or None
        ``chi2``, ``expected`` and ``p_value`` of the priors alone; None without
        priors that are not flat.

    Examples
    --------
    >>> from astropy.table import QTable
    >>> from astropolcal.calibration import LackOfFit
    >>> LackOfFit(QTable(), 12.0, 10.0, 0.285, "the residuals agree with the noise").p_value
    0.285
    """

    table: QTable
    chi2: float
    expected: float
    p_value: float
    words: str
    priors: dict | None = None


def lack_of_fit(measurement, vector=None, noise=None, *, weights=None, fitted=True):
    r"""
    Test whether residuals are larger than the noise.

    The statistic is :math:`\chi^2 = \sum r^2/\sigma^2`. With S the diagonal matrix of
    :math:`\sigma`, J the Jacobian and W the weights squared, residuals are
    :math:`A\epsilon`, :math:`A = S^{-1}(1 - J (J^TWJ)^+ J^TW)S`, and with
    :math:`C = AA^T` restricted to a wavelength chi-square has the mean
    :math:`\operatorname{tr} C` and the variance :math:`2\operatorname{tr} C^2`
    (Satterthwaite 1946, Biometrics Bull. 2, 110, doi:10.2307/3002019). So
    parameters shared by all wavelengths and a fit whose weights are not those of
    the noise are accounted for. Where the noise is estimated, the ratio follows F;
    where it comes from replicates of the same data, their scatter is taken out of
    the residuals first (Draper & Smith 1998, Sec. 2.1). Priors of a fit are data
    like any other: a row each of r, :math:`\sigma` and J. So a prior that the data
    overrule adds to chi-square, one that decides what the data leave open adds
    nothing, and one that a fit heeds leaves more freedom to the data.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : array_like or Calibration, optional
        Fitted parameters, by default the current ones. A calibration made from this
        very measurement brings its weights along; with another one
        the data count as not fitted.
    noise : NoiseEstimate, optional
        By default `noise_from_errors`.
    weights : array_like, optional
        Weights of the fit (one over sigma), by default equal; shape (n_data,).
    fitted : bool
        Whether the parameters come from these data.

    Returns
    -------
    LackOfFit
        For all data and for each wavelength; NaN where the noise is unknown or no
        degree of freedom is left. With estimated noise the total is Fisher's
        combination of the probabilities of the wavelengths.

    Raises
    ------
    FitError
        If the noise belongs to another measurement.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import lack_of_fit
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> bool(lack_of_fit(cal.measurement, cal).p_value > 0.01)
    True
    """
    noise = noise_from_errors(measurement) if noise is None else noise
    if noise.sigma_of_data.shape != (measurement.n_data,):
        raise FitError(
            f"the noise is that of {noise.sigma_of_data.size} data, the measurement has "
            f"{measurement.n_data}; estimate it from this measurement"
        )
    if hasattr(vector, "measurement"):
        vector, weights, fitted = _of_calibration(measurement, vector)
    vector = measurement.vector() if vector is None else np.asarray(vector, dtype=float)
    left, right = _low_rank(measurement, vector, noise.sigma_of_data, weights, fitted)
    table, whole = _test_by_wavelength(measurement, vector, noise, left, right)
    priors = _test_of_priors(measurement, vector, left, right)
    chi2, expected, p_value = _together(table, whole, noise.dof, priors)
    words = _verdict(chi2, expected, p_value, noise, priors)
    return LackOfFit(table, chi2, expected, p_value, words, priors)


def _of_calibration(measurement, calibration):
    fitted = calibration.measurement is measurement
    return measurement.vector(), weighting_of(calibration).weight if fitted else None, fitted


def _test_of_priors(measurement, vector, left, right):
    """Return chi-square of the priors that were rows of the fit, its mean and probability."""
    n = measurement.n_data
    if len(left) == n:
        return None
    chi2 = np.sum(measurement.free.prior_residuals(vector) ** 2)
    mean, dof = _moments(left[n:], right[n:], 0.0)
    p = _chi2_above(chi2 / mean * dof, dof) if np.isfinite(dof) else np.nan
    return {"chi2": float(chi2), "expected": float(mean), "p_value": float(p)}


def _test_by_wavelength(measurement, vector, noise, left, right):
    """Return the table of the test, and mean and freedom of the whole chi-square."""
    numbers, wavelength, rows = data_by_wavelength(measurement)
    residuals, sigma = measurement.residuals(vector), noise.sigma_of_data
    usable = np.isfinite(np.append(sigma, np.ones(len(left) - sigma.size)))
    replicates = noise.method == "replicates"
    chi2, mean, dof = np.full((3, len(rows)), np.nan)
    for i, row in enumerate(rows):
        if row.size and usable[row].all():
            # scatter among replicates is noise by definition
            own = noise.dof[i] if replicates else 0.0
            chi2[i] = np.sum((residuals[row] / sigma[row]) ** 2) - own
            mean[i], dof[i] = _moments(left[row], right[row], own)
    from scipy.special import fdtrc

    with np.errstate(invalid="ignore"):
        reduced = chi2 / np.where(mean > _LEAST_FREEDOM, mean, np.nan)
        known = np.isinf(noise.dof)
        p = np.where(known, _chi2_above(reduced * dof, dof), fdtrc(dof, noise.dof, reduced))
    table = QTable(
        {
            "dataset": numbers,
            "wavelength": wavelength,
            "n": np.array([row.size for row in rows]),
            "chi2": chi2,
            "expected": mean,
            "dof": dof,
            "chi2_reduced": reduced,
            "dof_noise": noise.dof.astype(float),
            "p_value": p,
        }
    )
    return table, _moments(left[usable], right[usable], 0.0)


def _low_rank(measurement, vector, sigma, weights, fitted):
    """
    Return P and Q of C = 1 + P Q^T, the covariance of residuals over the noise.

    One row a datum, and behind them one a prior of the fit.
    """
    nothing = np.zeros((measurement.n_data, 0))
    if not fitted:
        return nothing, nothing
    free = measurement.free
    level = prior_noise(measurement, weights)
    weights = np.ones(measurement.n_data) if weights is None else np.asarray(weights, float)
    weights = np.append(weights, np.full(measurement.n_priors, level))
    slope = np.hstack([measurement.jacobian(vector), free.prior_jacobian(vector)])
    slope = slope[~free.at_bounds(vector)].T
    # columns of unit length, lest the rank depend on units
    scale = np.sqrt(np.sum((slope * weights[:, None]) ** 2, axis=0))
    slope = slope[:, scale > 0] / scale[scale > 0]
    slope *= weights[:, None]
    # the triangular factor has the same right vectors, and there are far more data than columns
    triangle = np.linalg.qr(slope, mode="r") if len(slope) > slope.shape[1] else slope
    _, values, right = np.linalg.svd(triangle, full_matrices=False)
    some = values > _RANK * values.max(initial=0.0)
    basis = slope @ (right[some] / values[some, None]).T
    # in units of the noise the hat matrix is a b^T
    known = np.append(np.where(np.isfinite(sigma), sigma, 1.0), np.ones(measurement.n_priors))
    by_noise = (weights * known)[:, None]
    a, b = basis / by_noise, basis * by_noise
    return np.hstack([a, b]), np.hstack([a @ (b.T @ b) - b, -a])


def _chi2_above(chi2, dof):
    """Return the probability of a larger chi-square; `scipy.stats` takes long to import."""
    from scipy.special import gammaincc

    return gammaincc(dof / 2, np.maximum(chi2, 0) / 2)


def _moments(left, right, own):
    """Return mean and effective freedom of chi-square without the replicates' own."""
    # tr(C) and tr(C^2) of C = 1 + P Q^T from the small matrix Q^T P, not the n x n one
    inner = right.T @ left
    n = len(left)
    mean = n + np.trace(inner) - own
    square = n + 2 * np.trace(inner) + np.sum(inner * inner.T) - own
    if mean <= _LEAST_FREEDOM or square <= 0:
        return max(mean, 0.0), np.nan
    # mean and variance of chi-square match those of a scaled chi-square of this freedom
    return mean, mean**2 / square


def _together(table, whole, dof_noise, priors):
    """Return chi-square, freedom and probability of all wavelengths and priors together."""
    p = np.asarray(table["p_value"])
    chi2, mean = float(np.nansum(table["chi2"])), float(np.nansum(table["expected"]))
    if priors is not None:
        p = np.append(p, priors["p_value"])
        chi2, mean = chi2 + priors["chi2"], mean + priors["expected"]
    p = p[np.isfinite(p)]
    if not p.size:
        return chi2, mean, np.nan
    if np.isinf(dof_noise).all():
        mean, dof = whole
        return chi2, float(mean), float(_chi2_above(chi2 / mean * dof, dof))
    with np.errstate(divide="ignore"):
        # p of the wavelengths are uniform and independent if the model is true: -2 sum ln p is then
        # chi-square of twice their number
        fisher = -2 * np.sum(np.log(p))
    return chi2, mean, float(_chi2_above(fisher, 2 * p.size))


def _verdict(chi2, expected, p_value, noise, priors):
    if not np.isfinite(p_value):
        return f"no test: no degree of freedom is left; noise from {noise.method}"
    ratio = np.sqrt(chi2 / expected) if chi2 > 0 else 0.0
    if p_value < _UNLIKELY:
        says = f"the residuals are {ratio:.3g} times the noise: the model misses something"
    elif p_value > 1 - _UNLIKELY:
        says = f"the residuals are {ratio:.3g} times the noise: the noise is overestimated"
    else:
        says = "the residuals agree with the noise"
    says += f" (p = {p_value:.3g})"
    if priors is not None and priors["p_value"] < _UNLIKELY:
        says += f"; the data disagree with the priors (p = {priors['p_value']:.3g})"
    return f"{says}; noise: {noise.words}"
