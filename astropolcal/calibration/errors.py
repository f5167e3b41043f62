# Licensed under a 3-clause BSD style license - see LICENSE
"""
Standard errors of parameters: of the full covariance, robust, and as published ones are.

The sandwich estimate reads from the residuals of whole groups of data how far each
group pulls the parameters (White 1980; Liang & Zeger 1986).
"""

import numpy as np
from astropy.table import QTable

from astropolcal.calibration._whitened import decompose
from astropolcal.calibration.covariance import sandwich, white_covariance
from astropolcal.calibration.identifiability import physical_scale
from astropolcal.calibration.resampling import labels_of
from astropolcal.calibration.weighting import around, weighting_of
from astropolcal.exceptions import FitError

__all__ = ["robust_covariance", "standard_errors"]

METHODS = ("covariance", "white", "robust", "van-holstein")
CORRECTIONS = ("leverage", "number")
_FEWEST_GROUPS = 3
# a share of a residual below this is what the fit has taken away, and no scatter
_TAKEN = 1e-6


def standard_errors(calibration, method=None, groups=None):
    r"""
    Return the standard errors of the free parameters.

    ``"covariance"`` is that of the calibration, by default from how its residuals scatter and hang
    together. ``"white"`` takes them to be independent, with the noise of its weights.
    ``"robust"`` lets groups of residuals hang together in any way, see `robust_covariance`.
    ``"van-holstein"`` is the error that calibrations of SPHERE/IRDIS and CHARIS quote (van Holstein
    et al. 2020, A&A 633, A64,
    Appendix E): each wavelength is a fit of its own in which the parameters
    common to all wavelengths are known, with covariance

    .. math:: s_\mathrm{res}^2 (J^T J)^{-1}, \qquad
              s_\mathrm{res}^2 = \frac{\sum_i r_i^2}{n - k},

    where J is the derivative of the n data of that wavelength to its k
    parameters. It is too small where the common parameters are uncertain, which
    is why the parameters held are named in the table's meta.

    Parameters
    ----------
    calibration : Calibration
        The calibration; with its data for all but ``"covariance"``.
    method : {"covariance", "white", "robust", "van-holstein"}, optional
        Which error; by default ``"covariance"``, or ``"robust"`` with groups.
    groups : str or array_like, optional
        For ``"robust"``, see `robust_covariance`; by default ``"derotator"``.

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``name``, ``std`` and ``unit``, one row a parameter; NaN for
        those at a bound, that the data leave open, or (van Holstein) that are
        common to all wavelengths. ``meta`` has ``method``, ``held`` and, for
        ``"robust"``, ``groups``.

    Raises
    ------
    FitError
        If the method is unknown, or groups are given for another than
        ``"robust"`` or are not possible ones.
    CalibrationFileError
        If the data are needed but were not kept.

    Notes
    -----
    The formula is that of the published software of McIntosh et al. (2026),
    which says that it follows the appendix; it there falls back on a
    pseudo-inverse where the matrix is singular, here there is no number then.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import standard_errors
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> standard_errors(cal, method="van-holstein").meta["held"][:2]
    ['calibration_polarizer.theta', 'hwp.theta']
    """
    method = ("covariance" if groups is None else "robust") if method is None else method
    if method not in METHODS:
        raise FitError(f"method = {method!r}; allowed are {', '.join(METHODS)}")
    if groups is not None and method != "robust":
        raise FitError(f"method = {method!r} knows no groups; 'robust' does")
    covariance = calibration.covariance
    stds, held, meta = covariance.stds, [], {}
    if method == "white":
        weighting, live = weighting_of(calibration), calibration.live_measurement()
        stds = white_covariance(live, around(live, weighting), weighting).stds
    if method == "robust":
        groups = "derotator" if groups is None else groups
        stds = robust_covariance(calibration, groups).stds
        meta = {"groups": groups if isinstance(groups, str) else "as given"}
    if method == "van-holstein":
        stds = _per_wavelength(calibration)
        slots = calibration.measurement.free.slots
        held = [slot.name for slot in slots if not slot.per_wavelength]
    units = [str(unit or "") for unit in covariance.units]
    return QTable(
        {"name": covariance.names, "std": stds, "unit": units},
        meta={"method": method, "held": held} | meta,
    )


# ---- robust -----------------------------------------------------------------------------


def robust_covariance(calibration, groups="derotator", correction="leverage"):
    r"""
    Return a covariance that allows residuals to be correlated within groups.

    With the derivative J of the weighted data, :math:`B = (J^T J)^{-1}` and the
    weighted residuals :math:`e_g` of group g it is the sandwich

    .. math:: B \left(\sum_g J_g^T A_g e_g e_g^T A_g^T J_g\right) B

    (White 1980 [1]_ for groups of one datum, Liang & Zeger 1986 [2]_ for any).
    Nothing is assumed of the residuals of a group but that they are
    independent of other groups', which takes many groups. As the fit follows its
    data, residuals are too small, and few groups more so. ``"leverage"`` undoes it
    with :math:`A_g = (1 - J_g B J_g^T)^{-1/2}`, which is exact for independent
    residuals (Bell & McCaffrey 2002 [3]_); ``"number"`` multiplies the
    whole by :math:`\frac{G}{G-1}\frac{n-1}{n-k}` for G groups, n data and k
    parameters.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    groups : {"derotator", "pair"} or array_like
        What is correlated: all data at a derotator angle, those of a pair of
        frames, or the label of each datum, shape (n_data,).
    correction : {"leverage", "number"}
        Correction for a small number of groups.

    Returns
    -------
    Covariance
        In the gauge of the calibration's. It has no more independent
        directions than groups: for a combination of many parameters take a
        `bootstrap`.

    Raises
    ------
    FitError
        If there are fewer than three groups, the labels are not one a datum,
        or a choice is unknown.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Notes
    -----
    Priors enter B, and with their own variance the sum in the middle. An
    error from G groups is itself uncertain by about :math:`1/\sqrt{2(G-1)}`.

    References
    ----------
    .. [1] White, H. 1980, Econometrica 48, 817, doi:10.2307/1912934
    .. [2] Liang, K.-Y. & Zeger, S. L. 1986, Biometrika 73, 13,
       doi:10.1093/biomet/73.1.13
    .. [3] Bell, R. M. & McCaffrey, D. F. 2002, Survey Methodology 28, 169

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration.errors import robust_covariance
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 50, 65, 80, 95] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> robust = robust_covariance(cal, groups="pair")
    >>> bool(0.5 < robust.std("hwp.w_sio2") / cal.covariance.std("hwp.w_sio2") < 2)
    True
    """
    if correction not in CORRECTIONS:
        raise FitError(f"correction = {correction!r}; allowed are {', '.join(CORRECTIONS)}")
    weighting, measurement = weighting_of(calibration), calibration.measurement
    labels = _labels(measurement, groups)
    whitened = around(measurement, weighting)
    residuals = measurement.residuals()
    if weighting.weight is not None:
        residuals = residuals * weighting.weight
    # derivatives to the determined directions, each in units of its standard error
    slopes = whitened.rows[:, whitened.live] @ whitened.errors.half.T
    # (n_groups, rank): how far each group alone pulls the solution, in standard errors
    pulls = np.array(
        [_pull(slopes[labels == g], residuals[labels == g], correction) for g in set(labels)]
    )
    # of one array with itself: a product of two copies is symmetric to rounding only
    middle = pulls.T @ pulls
    if correction == "number":
        n, k, n_groups = len(labels), slopes.shape[1], len(pulls)
        middle *= n_groups / (n_groups - 1) * (n - 1) / max(n - k, 1)
    # priors are taken at their word: their variance is not read from residuals
    prior = weighting.level * whitened.prior_rows[:, whitened.live] @ whitened.errors.half.T
    middle += prior.T @ prior
    return sandwich(measurement, whitened, middle)


def _labels(measurement, groups):
    labels = labels_of(measurement, groups) if isinstance(groups, str) else np.asarray(groups)
    if labels.shape != (measurement.n_data,):
        raise FitError(
            f"groups of shape {labels.shape}; allowed are ({measurement.n_data},), one a datum"
        )
    _, numbers = np.unique(labels, return_inverse=True)
    if numbers.max() + 1 < _FEWEST_GROUPS:
        raise FitError(
            f"{numbers.max() + 1} groups; a robust covariance needs {_FEWEST_GROUPS}, and many "
            "more to be accurate"
        )
    return numbers


def _pull(slopes, residuals, correction):
    """Return how far a group pulls along each determined direction."""
    if correction == "leverage":
        # of the hat matrix in the group only the directions of its slopes count
        left, singular, _ = np.linalg.svd(slopes, full_matrices=False)
        spare = 1 - singular**2
        grown = np.where(spare > _TAKEN, 1 / np.sqrt(np.maximum(spare, _TAKEN)), 0.0)
        residuals = residuals + left @ ((grown - 1) * (left.T @ residuals))
    return slopes.T @ residuals


# ---- as published --------------------------------------------------------------------------


def _per_wavelength(calibration):
    """Return the errors of fits wavelength by wavelength, in declared units."""
    measurement = calibration.live_measurement()
    free, weights = measurement.free, weighting_of(calibration).weight
    weights = 1.0 if weights is None else weights
    jacobian = measurement.jacobian(measurement.vector()) * weights
    residuals = measurement.residuals() * weights
    at_bound, names = set(calibration.at_bound), free.names
    stds = np.full(free.size, np.nan)
    for i in range(len(measurement.wavelength)):
        own = [slot.start + i for slot in free.slots if slot.per_wavelength]
        own = np.array([j for j in own if names[j] not in at_bound], dtype=int)
        rows = measurement.bins == i
        if own.size and rows.sum() > own.size:
            scale = physical_scale(free)[own]
            unit_noise = _stds(jacobian[np.ix_(own, rows)].T * scale) * scale
            # the common parameters count as known, so that only a wavelength's own take freedom
            variance = np.sum(residuals[rows] ** 2) / (rows.sum() - own.size)
            stds[own] = np.sqrt(variance) * unit_noise
    return stds / free.factors()


def _stds(jacobian):
    """Return the errors for unit noise, NaN for what the data leave open."""
    found = decompose(jacobian)
    return np.where(found.determined, np.linalg.norm(found.half, axis=0), np.nan)
