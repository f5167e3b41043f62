# Licensed under a 3-clause BSD style license - see LICENSE
"""
Errors of parameters that do not come from one covariance: refits, and robust estimates.

Profile: where a parameter enters the model non-linearly, the interval in which chi-square rises by
one, all others refitted, is a better statement than a standard error, and need not be symmetric.
Where residuals are correlated it has to rise by more, as much as that makes the error larger.
Where the data do not determine a parameter, its profile is flat.

Bootstrap: frames of one half-wave-plate cycle share what the model lacks (a lamp that drifts, a
derotator that stands slightly wrong), so their residuals are not independent, and errors from the
Jacobian are too small. Drawing whole cycles with replacement keeps that dependence (Kuensch 1989,
Ann. Statist. 17, 1217, https://doi.org/10.1214/aos/1176347265).

Sandwich: the residuals of whole groups of data tell how far each group pulls the parameters (White
1980; Liang & Zeger 1986).
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability.linearized import STILL, Whitened
from astropolcal.calibration.noise.scatter import labels_as_given, labels_of
from astropolcal.calibration.noise.weighting import problem_of
from astropolcal.calibration.uncertainty.covariance import (
    Covariance,
    full_covariance,
    sandwich,
    white_covariance,
    widening,
)
from astropolcal.exceptions import FitError, ParameterError, warn
from astropolcal.measurement.parameters import declared_step
from astropolcal.progress import counting, in_one_thread, shown
from astropolcal.units import check_seed, to_unit
from astropolcal.words import check_choice, did_you_mean, is_whole

__all__ = ["Resampled", "bootstrap", "profile", "robust_covariance", "standard_errors"]

# blocks of a bootstrap, and groups of a robust covariance, and how many make errors that are right
_FEWEST, _ENOUGH = 3, 6


# ---- profile likelihood: chi-square along one parameter, all others refitted ----


# half width of the default scan, in standard errors; in degree, micrometre, percent if open
_WIDTH = 3.0
_OPEN_WIDTH = 1.0


@dataclass
class Profile:
    """
    Profile of chi-square along one parameter.

    Parameters
    ----------
    name : str
        The parameter.
    best : `~astropy.units.Quantity` or float
        Its calibrated value.
    values : `~astropy.units.Quantity` or `~numpy.ndarray`
        Where it was held, ascending, with the calibrated value among them.
    delta_chi2 : `~numpy.ndarray`
        Rise of chi-square over the calibration's, in units of the residual
        variance where the errors of the data are not given; divided by how much
        larger the scatter of the residuals makes the variance of the parameter.
    vectors : `~numpy.ndarray`
        All parameters in canonical units at each value, shape (n_values, n_free).
    bounds : tuple of float
        Bounds of the parameter in its unit.

    Examples
    --------
    >>> from astropolcal.calibration.uncertainty.refits import Profile
    >>> import numpy as np
    >>> made = Profile("wollaston.efficiency", 0.9, np.array([0.8, 0.9, 1.0]),
    ...                np.array([4.0, 0.0, 4.0]), np.zeros((3, 1)))
    >>> [round(end, 3) for end in made.interval()]
    [0.85, 0.95]
    """

    name: str
    best: object
    values: object
    delta_chi2: np.ndarray
    vectors: np.ndarray
    bounds: tuple = (-np.inf, np.inf)

    def interval(self, rise=1.0):
        """
        Return where the profile has risen.

        Parameters
        ----------
        rise : float
            Rise of chi-square; 1 for one sigma.

        Returns
        -------
        low, high : `~astropy.units.Quantity` or float
            Infinite on a side where the profile stays below ``rise`` as far as it was followed.
        """
        if not rise > 0:
            raise ParameterError(f"rise = {rise}; allowed are numbers above 0")
        values = np.asarray(getattr(self.values, "value", self.values))
        unit = getattr(self.values, "unit", None)
        here = int(np.argmin(np.abs(values - getattr(self.best, "value", self.best))))
        # of a parabola the root is a straight line, so that interpolation is exact
        root = np.sqrt(np.clip(self.delta_chi2, 0, None))
        # left half turned round, so that both sides are searched outwards from the best value
        ends = (
            -_crossing(-values[here::-1], root[here::-1], np.sqrt(rise)),
            _crossing(values[here:], root[here:], np.sqrt(rise)),
        )
        return ends if unit is None else tuple(end * unit for end in ends)

    @property
    def words(self):
        """The finding in a sentence."""
        low, high = self.interval()
        ends = f"{self.values[0]:.6g} and {self.values[-1]:.6g}"
        if np.isinf(low) and np.isinf(high):
            return (
                f"{self.name} is unbounded: between {ends} chi-square rises by at most "
                f"{self.delta_chi2.max():.2g}, so the data do not determine it"
            )
        if np.isfinite(low) and np.isfinite(high):
            return f"{self.name} = {self.best:.6g}, between {low:.6g} and {high:.6g} at one sigma"
        least, end, i = ("at most", high, 0) if np.isinf(low) else ("at least", low, -1)
        last = self.values[i]
        at_bound = np.isclose(getattr(last, "value", last), self.bounds[i])
        stop = "its bound" if at_bound else "the last value"
        return (
            f"{self.name} is {least} {end:.6g} at one sigma; chi-square does not limit it "
            f"up to {stop} {last:.6g}"
        )

    def __str__(self):
        return self.words


def _crossing(values, root, rise):
    """Return where the root of the profile first exceeds ``rise``, between two values."""
    above = np.flatnonzero(root > rise)
    if not above.size:
        return np.inf
    near = slice(max(above[0] - 1, 0), above[0] + 1)
    return float(np.interp(rise, root[near], values[near]))


@in_one_thread
def profile(calibration, name, values=None, n=21):
    """
    Return chi-square along one parameter, with all others refitted.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    name : str
        One of ``calibration.covariance.names``, such as ``"hwp.w_sio2"`` or
        ``"derotator.horizontal[3]"``.
    values : `~astropy.units.Quantity` or array_like, optional
        Where to hold it; by default three standard errors to either side, of what is at a bound
        one-sided ones, or 1 degree (micrometre, percent) where it has none, within its bounds.
    n : int
        Number of values if none are given.

    Returns
    -------
    ``Profile``

    Raises
    ------
    ParameterError
        If there is no such parameter, or a value has the wrong unit or is outside the bounds.
    FitError
        If ``n`` is not a whole number from 3 up.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Examples
    --------
    >>> from astropolcal.calibration import profile
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> low, high = profile(cal, "hwp.w_sio2", n=7).interval()
    >>> bool(low < cal.chain["hwp"].w_sio2.quantity < high)
    True
    """
    covariance = calibration.covariance
    if name not in covariance.names:
        known = ", ".join(covariance.names[:8]) + (", ..." if len(covariance.names) > 8 else "")
        hint = did_you_mean(name, covariance.names)
        raise ParameterError(f"no free parameter {name!r}; there are {known}{hint}")
    if not is_whole(n) or n < 3:
        raise FitError(f"n = {n}; a profile needs a whole number of values, at least 3")
    index = covariance.names.index(name)
    refit = problem_of(calibration)
    unit = covariance.units[index]
    factor = refit.measurement.free.factors()[index]
    best = refit.solution[index] / factor
    low, high = (bounds[index] / factor for bounds in refit.measurement.free.bounds())
    if values is None:
        inward = (calibration.fit.get("bounds") or {"inward": {}})["inward"]
        std = inward.get(name, covariance.stds[index])
        half = _WIDTH * std if np.isfinite(std) else _OPEN_WIDTH * declared_step(unit)
        # an odd number of values, so that the best is one
        grid = best + half * np.linspace(-1, 1, n + 1 - n % 2)
        grid = np.unique(np.clip(grid, low, high))
    else:
        grid = np.unique(np.append(to_unit(values, unit, name), best))
        # what is not a number comes last, and is within no bounds
        if not (grid[0] >= low and grid[-1] <= high):
            raise ParameterError(f"{name}: values outside its bounds {low:g} to {high:g}")
    chi2, vectors = _follow(refit, index, grid * factor, int(np.argmin(np.abs(grid - best))))
    sigma = refit.weighting.level * widening(calibration)[index]
    rise = (chi2 - chi2.min()) / sigma**2
    quantity = 1 if unit is None else u.Unit(unit)
    return Profile(name, best * quantity, grid * quantity, rise, vectors, (low, high))


def _follow(refit, index, values, here):
    """Refit at every value, starting from the solution and going outward on both sides."""
    chi2, vectors = np.empty(values.size), np.empty((values.size, refit.solution.size))
    for side in (range(here, values.size), range(here, -1, -1)):
        # each fit starts from its neighbour's, so that it stays in the same valley
        vector = refit.solution
        for i in side:
            start = vector.copy()
            start[index] = values[i]
            vector, chi2[i], _ = refit.fit(start, held=[index])
            vectors[i] = vector
    return chi2, vectors


# ---- bootstrap over blocks of frames: errors that do not trust the noise model ----


# resamples drawn for each one wanted before giving up
_PATIENCE = 5
# a direction counts as lost if its singular value falls to this share of the original's
_LOST = 1e-7


@dataclass
class Resampled:
    """
    Parameters of refits to resampled data.

    Parameters
    ----------
    names : list of str
        Name of each parameter.
    units : list of `~astropy.units.Unit` or None
        Unit of each.
    samples : `~numpy.ndarray`
        Shape (n_resamples, n), in these units; NaN for parameters that the
        data do not determine, whose spread would be an accident of the fitter.
    block : str
        What was drawn: ``"derotator"`` or ``"pair"``.
    n_blocks : int
        How many of them the data have.
    n_rejected : int
        Resamples that did not determine what the data determine, or whose fit
        did not converge; others were drawn in their place.

    Examples
    --------
    >>> from astropolcal.calibration.uncertainty import Resampled
    >>> import numpy as np
    >>> made = Resampled(["wollaston.efficiency"], [None], np.array([[0.97], [0.99]]), "pair", 8, 0)
    >>> float(made.stds[0].round(4))
    0.0141
    """

    names: list
    units: list
    samples: np.ndarray
    block: str
    n_blocks: int
    n_rejected: int

    @property
    def stds(self):
        """Standard deviation of each parameter, NaN where not determined."""
        return self.samples.std(axis=0, ddof=1)

    @property
    def covariance(self):
        """The sample covariance, a `Covariance`."""
        return Covariance(self.names, self.units, np.atleast_2d(np.cov(self.samples.T)))

    def interval(self, level=0.6827):
        """
        Return the percentile interval of each parameter.

        Parameters
        ----------
        level : float
            Share of the resamples inside.

        Returns
        -------
        low, high : `~numpy.ndarray`
            Shape (n,), in ``units``.
        """
        if not 0 < level < 1:
            raise FitError(f"level = {level}; allowed is a share between 0 and 1")
        return tuple(np.quantile(self.samples, [(1 - level) / 2, (1 + level) / 2], axis=0))

    def __repr__(self):
        return (
            f"<Resampled: {len(self.samples)} bootstrap resamples of {self.n_blocks} "
            f"{self.block} blocks, {len(self.names)} parameters>"
        )


@in_one_thread
def bootstrap(calibration, n=200, block="derotator", seed=None, progress=False):
    """
    Refit resampled data, drawn in blocks of frames with replacement.

    The peaks of priors are drawn too, each from its own prior.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    n : int
        Number of resamples.
    block : {"derotator", "pair"}
        What is drawn: all frames at a derotator angle, or single pairs of
        frames, each with all wavelengths. Every dataset keeps its number of
        blocks. ``"pair"`` assumes that pairs are independent.
    seed : int or `~numpy.random.Generator`, optional
        Seed.
    progress : bool
        Whether to show how far it is; on a terminal only.

    Returns
    -------
    Resampled

    Raises
    ------
    FitError
        If the block is unknown, ``n`` is not a whole number from 2 up, a dataset has fewer than
        three blocks, or hardly any resample can be fitted.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Warns
    -----
    AstropolcalWarning
        If a dataset has fewer than six blocks: errors are then rough, mostly too small.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import bootstrap
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 50, 65, 80, 95, 110] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> bootstrap(cal, n=10, seed=1)
    <Resampled: 10 bootstrap resamples of 6 derotator blocks, 49 parameters>
    """
    if not is_whole(n) or n < 2:
        raise FitError(f"n = {n}; a bootstrap needs a whole number of resamples, at least 2")
    refit = problem_of(calibration)
    measurement, labels = refit.measurement, labels_of(refit.measurement, block)
    # for each dataset the block of each datum
    blocks = [
        _numbered(labels[segment], f"{dataset.observations.name} has ", f" {block} blocks")
        for dataset, segment in zip(measurement.datasets, measurement.segments, strict=True)
    ]
    counts = [int(numbers.max()) + 1 for numbers in blocks]
    rng = np.random.default_rng(check_seed(seed))
    # what all data determine, a resample must determine too
    wanted = _singular_values(refit, 1.0)
    samples, rejected = [], 0
    with shown(progress), counting(n, "resamples") as add:
        while len(samples) < n:
            # of each dataset as many blocks as there are, with replacement
            drawn = (np.bincount(rng.integers(k, size=k), minlength=k) for k in counts)
            often = [own[numbers] for own, numbers in zip(drawn, blocks, strict=True)]
            often = np.concatenate(often).astype(float)
            seen = _singular_values(refit, np.sqrt(often))[: wanted.size]
            if np.all(seen >= _LOST * wanted):
                # a prior is a datum too, and may have come out otherwise
                peaks = rng.normal(size=measurement.n_priors)
                vector, _, found = refit.fit(refit.solution, often, drawn=peaks)
                if found.success:
                    samples.append(vector)
                    add()
                    continue
            rejected += 1
            if rejected > _PATIENCE * n + 10:
                raise FitError(
                    f"{rejected} resamples could not be fitted: the data have too few blocks "
                    "for the model"
                )
    known = full_covariance(calibration)
    samples = np.array(samples) / measurement.free.factors()
    is_open = (np.abs(known._axes().open) > STILL).any(axis=0)
    # where the data leave a direction open, a fit ends anywhere along it
    samples[:, is_open] = np.nan
    return Resampled(known.names, known.units, samples, block, sum(counts), rejected)


def _numbered(labels, before, after):
    """Return the number of the group of each datum; words around their count if there are too few.

    The words may hold the name of a dataset, which may hold anything.
    """
    _, numbers = np.unique(labels, return_inverse=True)
    count = int(numbers.max()) + 1
    words = f"{before}{count}{after}"
    if count < _FEWEST:
        raise FitError(f"{words}; {_FEWEST} are needed, and many more to be accurate")
    if count < _ENOUGH:
        warn(f"{words}; of fewer than {_ENOUGH} errors are rough, mostly too small", stacklevel=3)
    return numbers


def _singular_values(refit, scale):
    """Return the singular values that are not zero, of columns of natural size."""
    jacobian = refit.jacobian(refit.solution, refit.weights * scale)
    size = np.linalg.norm(jacobian, axis=0)
    found = Whitened(jacobian.T, 1 / np.where(size > 0, size, 1.0)).data
    return found.singular[: found.rank] if np.ndim(scale) == 0 else found.singular


# ---- standard errors of parameters: of the full covariance, robust, and as published ones are ----


METHODS = ("covariance", "white", "robust", "van-holstein")
# a share of a residual below this is what the fit has taken away, and no scatter
_TAKEN = 1e-6


def standard_errors(calibration, method=None, groups=None):
    r"""
    Return the standard errors of the free parameters.

    ``"covariance"`` is that of the calibration, by default from how its residuals scatter and are
    correlated. ``"white"`` takes them to be independent, with the noise of its weights.
    ``"robust"`` lets groups of residuals be correlated in any way, see `robust_covariance`.
    ``"van-holstein"`` is the error that calibrations of SPHERE/IRDIS and CHARIS quote (van Holstein
    et al. 2020, A&A 633, A64, Appendix E): each wavelength is a fit of its own in which the
    parameters common to all wavelengths are known, with covariance

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
        Columns ``name``, ``std`` and ``unit``, one row per parameter; NaN for those at a bound,
        that the data do not determine, or (van Holstein) that are common to all wavelengths.
        ``meta`` has ``method``, ``held`` and, for ``"robust"``, ``groups``.

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
    >>> from astropolcal.calibration.uncertainty import standard_errors
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> standard_errors(cal, method="van-holstein").meta["held"][:2]
    ['calibration_polarizer.theta', 'hwp.theta']
    """
    method = ("covariance" if groups is None else "robust") if method is None else method
    check_choice("method", method, METHODS, FitError)
    if groups is not None and method != "robust":
        raise FitError(f"method = {method!r} knows no groups; 'robust' does")
    covariance = calibration.covariance
    stds, held, meta = covariance.stds, [], {}
    if method == "white":
        problem = problem_of(calibration)
        stds = white_covariance(problem.measurement, problem.around(), problem.weighting).stds
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


def robust_covariance(calibration, groups="derotator"):
    r"""
    Return a covariance that allows residuals to be correlated within groups.

    With the derivative J of the weighted data, :math:`B = (J^T J)^{-1}` and the
    weighted residuals :math:`e_g` of group g it is the sandwich

    .. math:: B \left(\sum_g J_g^T A_g e_g e_g^T A_g^T J_g\right) B

    (White 1980 [1]_ for groups of one datum, Liang & Zeger 1986 [2]_ for any). Nothing is assumed
    of the residuals of a group but that they are independent of other groups', which takes many
    groups. As the fit follows its data, residuals are too small, and few groups more so.
    :math:`A_g = (1 - J_g B J_g^T)^{-1/2}` undoes it, which is exact for independent residuals
    (Bell & McCaffrey 2002 [3]_).

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    groups : {"derotator", "pair"} or array_like
        What is correlated: all data at a derotator angle, those of a pair of
        frames, or the label of each datum, shape (n_data,).

    Returns
    -------
    Covariance
        In the gauge of the calibration's. It has no more independent directions than groups: for a
        combination of many parameters take a ``bootstrap``.

    Raises
    ------
    FitError
        If there are fewer than three groups, the labels are not one per datum,
        or a choice is unknown.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Warns
    -----
    AstropolcalWarning
        If there are fewer than six groups: errors are then rough, mostly too small.

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
    >>> from astropolcal.calibration.uncertainty import robust_covariance
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 50, 65, 80, 95] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> robust = robust_covariance(cal, groups="pair")
    >>> bool(0.5 < robust.std("hwp.w_sio2") / cal.covariance.std("hwp.w_sio2") < 2)
    True
    """
    problem = problem_of(calibration)
    measurement, whitened = problem.measurement, problem.around()
    labels = (labels_of if isinstance(groups, str) else labels_as_given)(measurement, groups)
    numbers = _numbered(labels, "", " groups for a robust covariance")
    residuals = problem.residuals(problem.solution)[: measurement.n_data]
    # derivatives to the determined directions, each in units of its standard error
    slopes = whitened.along(whitened.rows)
    pulls = []
    for group in range(numbers.max() + 1):
        own, left_over = slopes[numbers == group], residuals[numbers == group]
        # of the hat matrix in the group only the directions of its slopes count
        left, singular, _ = np.linalg.svd(own, full_matrices=False)
        spare = 1 - singular**2
        grown = np.where(spare > _TAKEN, 1 / np.sqrt(np.maximum(spare, _TAKEN)), 0.0)
        left_over = left_over + left @ ((grown - 1) * (left.T @ left_over))
        # (rank,): how far the group alone pulls the solution, in standard errors
        pulls.append(own.T @ left_over)
    # priors are taken at their word: their variance is not read from residuals
    prior = problem.weighting.level * whitened.along(whitened.prior_rows)
    # of one array with itself: a product of two copies is symmetric to rounding only
    pulls = np.array(pulls)
    middle = pulls.T @ pulls + prior.T @ prior
    return sandwich(measurement, whitened, problem.weighting, middle, from_residuals=True)


# ---- as published --------------------------------------------------------------------------


def _per_wavelength(calibration):
    """Return the errors of fits wavelength by wavelength, in declared units."""
    problem = problem_of(calibration)
    measurement, free = problem.measurement, problem.measurement.free
    jacobian = problem.jacobian(problem.solution).T
    residuals = problem.residuals(problem.solution)[: measurement.n_data]
    at_bound, names = set(calibration.at_bound), free.names
    stds = np.full(free.size, np.nan)
    for i in range(len(measurement.wavelength)):
        own = [slot.start + i for slot in free.slots if slot.per_wavelength]
        own = np.array([j for j in own if names[j] not in at_bound], dtype=int)
        rows = measurement.bins == i
        if own.size and rows.sum() > own.size:
            # no number for what the data leave open
            found = Whitened(jacobian[own][:, rows], free.steps[own]).covariance()
            # the common parameters count as known, so that only a wavelength's own take freedom
            variance = np.sum(residuals[rows] ** 2) / (rows.sum() - own.size)
            stds[own] = np.sqrt(variance * np.diag(found))
    return stds / free.factors()
