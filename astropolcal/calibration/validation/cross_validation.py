# Licensed under a 3-clause BSD style license - see LICENSE
"""
Accuracy of a calibration per wavelength (s_res, s_mean, s_cv, s_standard), and its chi-square.

The first two accuracies look back at the data of the fit. The others are errors of predictions: of
settings that were left out of the fit, and of a dataset that was not fitted (a standard).
Whether the residuals exceed the noise is decided by chi-square where the noise is known, and by F
where it is itself estimated.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability.linearized import Whitened
from astropolcal.calibration.noise.estimates import data_by_wavelength, noise_from_errors, rms
from astropolcal.calibration.noise.scatter import groups_by, labels_as_given, leave_out_groups
from astropolcal.calibration.noise.weighting import Problem, assumed, weighting_of
from astropolcal.calibration.system import free_of
from astropolcal.chain import join, leaves
from astropolcal.exceptions import ChainError, FitError
from astropolcal.files import columns
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.measurement.parameters import ties_among
from astropolcal.observations.reading import SAME_WAVELENGTH, bins_on_grid
from astropolcal.optics import PolarizedSource
from astropolcal.progress import steps
from astropolcal.words import listed, p_words

__all__ = ["add_standard", "lack_of_fit"]

# a datum that moves by less than this share of the largest slope does not move
_STILL = 1e-6
# what is named of a direction, as a share of its length
_WORTH_A_WORD = 0.1
_MOST_NAMES = 4
# of more groups than this none moves the parameters far
_MANY = 16
# a leverage this near to one is that of data which alone determine something
_ALONE = 1e-7
# up to this leverage of a group, along any direction, the others determine everything
_MOSTLY = 0.5


def accuracy_table(measurement, dataset, residuals, held_out=None):
    r"""Return the accuracies of one dataset at each wavelength, in percent.

    ``s_res`` is :math:`\sqrt{\sum r_i^2/(n-k)}`, ``s_mean`` that over :math:`\sqrt n`, the paper's
    s_rel (Sec. 2.3), with k the free parameters that act there; ``s_cv`` the rms of held-out
    residuals.
    """
    part, own = measurement.datasets[dataset], measurement.segments[dataset]
    residuals = residuals[own]
    held_out = np.full(residuals.size, np.nan) if held_out is None else held_out[own]
    rows = [part.bin_of_datum == b for b in part.bins]
    n, k = np.array([row.sum() for row in rows]), part.n_parameters_per_wavelength
    squares = np.array([np.sum(residuals[row] ** 2) for row in rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        # n - k as for independent data: every parameter that acts here takes one degree of freedom,
        # also one common to all wavelengths, as in the paper
        s_res = np.where(n > k, np.sqrt(squares / np.where(n > k, n - k, 1)), np.nan)
        s_mean = s_res / np.sqrt(n)
    s_cv = [rms(held_out[row][np.isfinite(held_out[row])]) for row in rows]
    table = QTable({"wavelength": part.observations.wavelength, "n": n, "k": np.full(len(n), k)})
    add_percent(table, s_res=s_res, s_mean=s_mean, s_cv=s_cv, s_standard=np.full(len(n), np.nan))
    return table


def add_percent(table, **fractions):
    """Add columns in percent."""
    for key, values in fractions.items():
        table[key] = 100 * np.asarray(values) * u.percent


def held_out_residuals(calibration, groups=None):
    """Return the residuals of all data, each predicted without its group, with the fit's weights.

    ``groups`` may be a word, see `groups_by`.
    """
    live = calibration.live_measurement()
    groups = groups_by(live, groups) if isinstance(groups, str) else groups
    # of equal weights there are none
    weights = weighting_of(calibration).weight if calibration.settings.get("weights") else None
    return cross_validated_residuals(live, weights, groups)


def cross_validated_residuals(measurement, weights=None, groups=None):
    """Return the residual of every datum predicted by a fit that left its group out.

    Up to 16 groups each have a fit; of more, which weigh little, the fits are linear steps. NaN
    where the other groups do not determine the prediction, or where there are too few.
    """
    # two derotator angles are too few to predict one from the other; nights need not be
    fewest = 3 if groups is None else 2
    labels = leave_out_groups(measurement) if groups is None else _checked(measurement, groups)
    held_out = np.full(measurement.n_data, np.nan)
    order = np.argsort(labels, kind="stable")
    members = np.split(order, np.flatnonzero(labels[order][1:] != labels[order][:-1]) + 1)
    if len(members) < fewest:
        return held_out
    problem = Problem(measurement, assumed(measurement, weights))
    if not np.isfinite(problem.noise):
        # as many data as parameters tell no noise, against which a prior could weigh
        problem.noise = 0.0
    fits = len(members) <= _MANY
    beside = (_begin if fits else _without)(problem)
    for out in steps(members, "groups left out"):
        # where a fit of the others starts, or what a step without one predicts
        found, blind = beside(out)
        if groups is not None and blind.any():
            share = np.abs(_undetermined(problem, out)[0] / measurement.free.steps)
            slots = measurement.free.slots
            moved = [s.name for s in slots if share[:, s.slice].max() > _WORTH_A_WORD]
            raise FitError(
                f"cross-validation: without group {labels[out[0]]} ({out.size} data) the others do "
                f"not determine {listed(moved, most=_MOST_NAMES)}; group by something else"
            )
        if fits:
            counts = np.ones(measurement.n_data)
            counts[out] = 0.0
            found = measurement.residuals(problem.fit(found, counts)[0])[out]
        # along what the others leave open the fit still stands where all data have put it
        held_out[out] = np.where(blind, np.nan, found)
    return held_out


def _without(problem):
    """Return what says what a fit without a group predicts, by one step of linear algebra.

    The residuals of a group g become (1 - H_g)^-1 r_g, with H_g its part of the hat matrix: exact
    for a linear model, and a small group moves no parameter far.
    """
    weights, root = problem.weights, problem.around().slopes
    weighted = problem.measurement.residuals(problem.solution) * weights

    def predicted(out):
        """Return the residuals of a group, and which of them the others do not determine."""
        # (1 - H_g)^-1 r_g without inverting a matrix of the size of the group: H_g = R R^T, and its
        # eigenvalues are those of R^T R, (rank, rank)
        own, residuals = root[out], weighted[out]
        values, axes = np.linalg.eigh(own.T @ own)
        seen = own @ axes
        # along these the others determine nothing
        alone = values > 1 - _ALONE
        blind = (np.abs(seen[:, alone]) > _STILL).any(axis=1)
        gain = np.where(alone, 0.0, 1 / np.where(alone, 1.0, 1 - values))
        # (1 - R R^T)^-1 = 1 + R (1 - R^T R)^-1 R^T
        change = seen @ (gain * (seen.T @ residuals))
        return (residuals + change) / weights[out], blind

    return predicted


def _begin(problem):
    """Return what says where a fit without a group starts, and which data only the group tells of.

    It starts a step of linear algebra from the fit of all data, where that leads down.
    """
    measurement, solution = problem.measurement, problem.solution
    scale, residuals = measurement.free.steps, problem.residuals(solution)
    whole = Whitened(problem.jacobian(solution).T, scale)
    root, half = whole.slopes, whole.errors.half * scale
    pull, (low, high) = root.T @ residuals, measurement.free.bounds()

    def cost(vector, out):
        return np.sum(np.delete(problem.residuals(vector), out) ** 2)

    def begin(out):
        own = root[out]
        values, axes = np.linalg.eigh(own.T @ own)
        if values.max(initial=0.0) > _MOSTLY:
            # the others may determine nothing
            return solution, _undetermined(problem, out)[1]
        # normal equations in coordinates in which those of all data are the unit matrix
        move = axes @ ((axes.T @ (pull - own.T @ residuals[out])) / (1 - values))
        start = np.clip(solution - move @ half, low, high)
        leads_down = cost(start, out) < np.sum(np.delete(residuals, out) ** 2)
        return start if leads_down else solution, np.zeros(out.size, dtype=bool)

    return begin


def _checked(measurement, groups):
    groups = labels_as_given(measurement, groups)
    labels, counts = np.unique(groups, return_counts=True)
    if (counts < 2).any():
        raise FitError(
            f"cross-validation: group {labels[counts < 2][0]} has a single member; "
            "at least 2 data are needed"
        )
    return groups


def _undetermined(problem, out):
    """Return canonical moves that only data left out see, (n_moves, n_free), and which."""
    measurement, scale = problem.measurement, problem.measurement.free.steps
    jacobian = measurement.jacobian(problem.solution)
    kept = np.delete(problem.jacobian(problem.solution), out, axis=0)
    null = Whitened(kept.T, scale).data.null * scale
    # which combinations of what the others leave open do the data left out see, and how strongly
    left, seen, right = np.linalg.svd(null @ jacobian[:, out], full_matrices=False)
    limit = _STILL * np.abs(jacobian * scale[:, None]).max(initial=0.0)
    moves = seen > limit
    change = seen[moves, None] * right[moves]
    return left.T[moves] @ null, (np.abs(change) > limit).any(axis=0)


# ---- goodness of fit: whether the residuals exceed the noise ----


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
        Of all data and priors together, and what it is on average if the model is true.
    p_value : float
        Probability of residuals at least as large, were the model true and the noise right.
    words : str
        The verdict in a sentence, and what the noise includes.
    priors : dict or None
        ``chi2``, ``expected`` and ``p_value`` of the priors alone; None without
        priors that are not flat.

    Examples
    --------
    >>> from astropolcal.calibration.validation.cross_validation import LackOfFit
    >>> from astropy.table import QTable
    >>> LackOfFit(QTable(), 12.0, 10.0, 0.285, "the residuals agree with the noise").p_value
    0.285
    """

    table: QTable
    chi2: float
    expected: float
    p_value: float
    words: str
    priors: dict | None = None


def lack_of_fit(measurement, vector=None, noise=None, *, weights=None, fitted=True, whitened=None):
    r"""
    Test whether residuals are larger than the noise.

    The statistic is :math:`\chi^2 = \sum r^2/\sigma^2`. With S the diagonal matrix of
    :math:`\sigma`, J the Jacobian and W the weights squared, residuals are
    :math:`A\epsilon`, :math:`A = S^{-1}(1 - J (J^TWJ)^+ J^TW)S`, and with
    :math:`C = AA^T` restricted to a wavelength chi-square has the mean
    :math:`\operatorname{tr} C` and the variance :math:`2\operatorname{tr} C^2`
    (Satterthwaite 1946, Biometrics Bull. 2, 110, doi:10.2307/3002019). So parameters shared by all
    wavelengths and a fit whose weights are not those of the noise are accounted for. Where the
    noise is estimated, the ratio follows F; where it comes from replicates of the same data, their
    scatter is taken out of the residuals first (Draper & Smith 1998, Sec. 2.1). Priors of a fit are
    data like any other: a row each of r, :math:`\sigma` and J. So a prior that the data overrule
    adds to chi-square, one that decides what the data do not determine adds nothing, and one that a
    fit heeds leaves more freedom to the data.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : array_like or Calibration, optional
        Fitted parameters, by default the current ones. A calibration made from this very
        measurement brings its weights along; with another one the data count as not fitted.
    noise : NoiseEstimate, optional
        By default ``noise_from_errors``.
    weights : array_like, optional
        Weights of the fit (one over sigma), by default equal; shape (n_data,).
    fitted : bool
        Whether the parameters come from these data.
    whitened : Whitened, optional
        The linear problem of the fit at these parameters, where it is known already.

    Returns
    -------
    ``LackOfFit``
        For all data and for each wavelength; NaN where the noise is unknown or no
        degree of freedom is left. With estimated noise the total is Fisher's
        combination of the probabilities of the wavelengths.

    Raises
    ------
    FitError
        If the noise belongs to another measurement.

    Examples
    --------
    >>> from astropolcal.calibration.validation import lack_of_fit
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> bool(lack_of_fit(cal.measurement, cal).p_value > 0.01)
    True
    """
    noise = noise_from_errors(measurement) if noise is None else noise
    sigma = noise.of_data(measurement)
    if hasattr(vector, "measurement"):
        fitted = vector.measurement is measurement
        vector, weights = None, weighting_of(vector).weight if fitted else None
    vector = measurement.vector() if vector is None else np.asarray(vector, dtype=float)
    hat = _Hat.of(measurement, vector, sigma, weights, whitened) if fitted else None
    table, whole = _test_by_wavelength(measurement, vector, noise, hat)
    priors = _test_of_priors(measurement, vector, hat)
    chi2, expected, p_value = _together(table, whole, noise, priors)
    words = _verdict(chi2, expected, p_value, noise, priors)
    return LackOfFit(table, chi2, expected, p_value, words, priors)


def _test_of_priors(measurement, vector, hat):
    """Return chi-square of the priors that were rows of the fit, its mean and probability."""
    n = measurement.n_data
    if hat is None or len(hat.basis) == n:
        return None
    chi2 = np.sum(measurement.free.prior_residuals(vector) ** 2)
    rows = np.arange(n, len(hat.basis))
    mean, dof = _moments(len(rows), hat.moments(rows), 0.0)
    p = chi2_above(chi2 / mean * dof, dof) if np.isfinite(dof) else np.nan
    return {"chi2": float(chi2), "expected": float(mean), "p_value": float(p)}


def _test_by_wavelength(measurement, vector, noise, hat):
    """Return the table of the test, and mean and freedom of the whole chi-square."""
    numbers, wavelength, rows = data_by_wavelength(measurement)
    residuals, sigma = measurement.residuals(vector), noise.sigma_of_data
    usable, counted = np.isfinite(sigma), np.zeros(0, dtype=int)
    replicates = noise.method == "replicates"
    chi2, mean, dof = np.full((3, len(rows)), np.nan)
    for i, row in enumerate(rows):
        if row.size and usable[row].all():
            # scatter among replicates is noise by definition
            own = noise.dof[i] if replicates else 0.0
            chi2[i] = np.sum((residuals[row] / sigma[row]) ** 2) - own
            taken = (0.0, 0.0) if hat is None else hat.moments(row)
            mean[i], dof[i] = _moments(row.size, taken, own)
            counted = np.append(counted, row)
    from scipy.special import fdtrc

    with np.errstate(invalid="ignore"):
        reduced = chi2 / np.where(mean > _LEAST_FREEDOM, mean, np.nan)
        known = np.isinf(noise.dof)
        p = np.where(known, chi2_above(reduced * dof, dof), fdtrc(dof, noise.dof, reduced))
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
    if hat is not None and len(hat.basis) > sigma.size:
        counted = np.append(counted, np.arange(sigma.size, len(hat.basis)))
    taken = (0.0, 0.0) if hat is None else hat.moments(counted)
    return table, _moments(counted.size, taken, 0.0)


@dataclass
class _Hat:
    """The covariance 1 + P Q^T of residuals over the noise, a row per datum and then per prior."""

    basis: np.ndarray
    by_noise: np.ndarray
    inner: np.ndarray

    @classmethod
    def of(cls, measurement, vector, sigma, weights, whitened):
        problem = Problem(measurement, assumed(measurement, weights))
        if whitened is None or measurement.n_priors:
            whitened = problem.around(vector)
        basis, weights = whitened.slopes, problem.weights
        known = np.where(np.isfinite(sigma), sigma, 1.0)
        if measurement.n_priors:
            basis = np.concatenate([basis, whitened.along(whitened.prior_rows)])
            weights = np.append(weights, np.full(measurement.n_priors, problem.noise))
            known = np.append(known, np.ones(measurement.n_priors))
        by_noise = (weights * known)[:, None]
        if not np.all(by_noise > 0):
            # data without noise, which the fit meets exactly
            return None
        # in units of the noise the hat matrix is a b^T
        return cls(basis, by_noise, (basis * by_noise).T @ (basis * by_noise))

    def moments(self, rows):
        """Return tr(P Q^T) and tr((P Q^T)^2) of some rows."""
        # P = (a, b) and Q = (a K - b, -a), with K = b^T b of all rows
        a, b = self.basis[rows] / self.by_noise[rows], self.basis[rows] * self.by_noise[rows]
        if len(a) < a.shape[1]:
            left = a @ self.inner @ a.T - a @ b.T - b @ a.T
            return np.trace(left), np.sum(left**2)
        # of Q^T P, which is the smaller one
        aa, ab, bb = a.T @ a, a.T @ b, b.T @ b
        first, second = self.inner @ aa - ab.T, self.inner @ ab - bb
        square = np.sum(first * first.T) - 2 * np.sum(second * aa.T) + np.sum(ab * ab.T)
        return np.trace(first) - np.trace(ab), square


def chi2_above(chi2, dof):
    """Return the probability of a larger chi-square; `scipy.stats` takes long to import."""
    from scipy.special import gammaincc

    return gammaincc(dof / 2, np.maximum(chi2, 0) / 2)


def _moments(n, taken, own):
    """Return mean and effective freedom of chi-square without the replicates' own."""
    # tr(C) and tr(C^2) of C = 1 + P Q^T
    once, twice = taken
    mean = n + once - own
    square = n + 2 * once + twice - own
    if mean <= _LEAST_FREEDOM or square <= 0:
        return max(mean, 0.0), np.nan
    # mean and variance of chi-square match those of a scaled chi-square of this freedom
    return mean, mean**2 / square


def _together(table, whole, noise, priors):
    """Return chi-square, freedom and probability of all wavelengths and priors together."""
    p, shares = np.asarray(table["p_value"]), np.broadcast_to(noise.independent, len(table))
    chi2, mean = float(np.nansum(table["chi2"])), float(np.nansum(table["expected"]))
    if priors is not None:
        p, shares = np.append(p, priors["p_value"]), np.append(shares, 1.0)
        chi2, mean = chi2 + priors["chi2"], mean + priors["expected"]
    known = np.isfinite(p)
    if not known.any():
        return chi2, mean, np.nan
    if np.isinf(noise.dof).all():
        mean, dof = whole
        return chi2, float(mean), float(chi2_above(chi2 / mean * dof, dof))
    with np.errstate(divide="ignore"):
        # p of the wavelengths are uniform if the model is true: of independent ones -2 sum ln p is
        # then chi-square of twice their number, and of others of as many as are independent
        fisher = -2 * np.sum(shares[known] * np.log(p[known]))
    return chi2, mean, float(chi2_above(fisher, 2 * shares[known].sum()))


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
    says += f" ({p_words(p_value)})"
    if priors is not None and priors["p_value"] < _UNLIKELY:
        says += f"; the data disagree with the priors ({p_words(priors['p_value'])})"
    return f"{says}; noise: {noise.words}"


# ---- held-out standards --------------------------------------------------------------------


# what a step of a degree may add to the errors of a prediction before it is worth a word
_WORTH_A_CAUTION = 0.1


def refuse_fitted(calibration, observations):
    """Refuse observations with the content of a fitted dataset."""
    seen = {record.content_hash: record.name for record in calibration.datasets}
    if observations.content_hash in seen:
        raise FitError(
            f"{observations.name} is not an independent standard: the calibration was fitted "
            f"to it as {seen[observations.content_hash]}"
        )


def standard_accuracy(calibration, chain, observations, positions=None):
    """Return how well a calibration predicts a dataset that its fit did not use.

    The table of `add_standard`, which keeps it with the calibration.
    """
    refuse_fitted(calibration, observations)
    rows = bins_on_grid(observations, calibration.wavelength.to_value(u.um))
    fitted = {leaf.name for item in calibration.chains for leaf in leaves(item)}
    measurement = predicted_measurement(calibration, chain, observations, positions)
    table = _errors(measurement)
    same = [record for record in calibration.datasets if record.source == observations.source]
    # s_cv over the data of the same source, or over all
    tables = (r.accuracy for r in same or calibration.datasets if r.accuracy is not None)
    found = [(t["wavelength"].to_value(u.nm), t["s_cv"].value, t["n"]) for t in tables]
    table["s_cv"] = _pooled(calibration.wavelength.to_value(u.nm), found)[rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        table["chi"] = (table["s_standard"] / table["s_cv"]).to_value(u.one)
    # open directions of the calibration, as far as the standard's chain follows them
    free, moved = free_of(calibration), np.zeros((1, measurement.n_data))
    null = np.reshape(calibration.identifiability.null_vectors, (-1, free.size))
    null, jacobian = null * free.steps, measurement.jacobian(measurement.vector())
    for slot in measurement.free.slots:
        own, factor, _ = free.lookup(slot.name)
        columns = own.start + (np.sort(rows) if own.per_wavelength else np.zeros(1, dtype=int))
        moved = moved + factor * null[:, columns] @ jacobian[slot.slice]
    table.meta |= {
        "name": observations.name,
        "source": observations.source,
        "content_hash": observations.content_hash,
        "n_frames": observations.n_frames,
        "open_percent": float(100 * np.linalg.norm(moved, axis=0).max(initial=0.0)),
        "not_calibrated": [leaf.name for leaf in leaves(chain) if leaf.name not in fitted],
    }
    table.meta["words"] = _words(table, bool(same))
    return table


def predicted_measurement(calibration, chain, observations, positions=None, sources=False):
    """Return the measurement of a standard with the values of a calibration where it has the optic.

    Polarized sources stay free if ``sources``.
    """
    rows = bins_on_grid(observations, calibration.wavelength.to_value(u.um))
    # reversed, so that of optics in several chains the first dataset's counts
    fitted = {leaf.name: leaf for item in calibration.chains[::-1] for leaf in leaves(item)}
    train, unknown = [], []
    for leaf in leaves(chain):
        is_source = sources and isinstance(leaf, PolarizedSource)
        is_new = not is_source and leaf.name not in fitted
        origin = leaf if is_source or is_new else fitted[leaf.name]
        if type(origin) is not type(leaf):
            raise ChainError(
                f"{observations.name}: {leaf.name} is of class {type(leaf).__name__}, but that of "
                f"the calibration is of class {type(origin).__name__}"
            )
        values, known = {}, {key: getattr(origin, key) for key in leaf.param_names}
        for key, parameter in known.items():
            on_grid = np.size(parameter.value) == len(calibration.wavelength) > 1
            value = parameter.value[rows] if on_grid else parameter.value
            values[key] = value if parameter.unit is None else value * parameter.unit
            if is_new and not parameter.fixed and parameter.prior is None:
                # free, and nothing is known of it
                unknown.append(f"{leaf.name}.{key}")
        new = leaf.with_parameters(**values)
        for key, parameter in known.items():
            # with the calibration's flags its open directions can be followed; what only a
            # catalogue knows stays as it is
            getattr(new, key).fixed = parameter.fixed or is_new
            getattr(new, key).bounds = parameter.bounds
            if parameter.grid is not None:
                getattr(new, key).wavelength = calibration.wavelength[rows]
            getattr(new, key).prior = None
        train.append(new)
    if unknown:
        raise FitError(
            f"{observations.name}: nothing determines {', '.join(unknown)}: the calibration has no "
            "such optics; hold them at known values"
        )
    return measurement_with(calibration, join(train), observations, positions)


def measurement_with(calibration, chain, observations, positions=None, wavelength=None):
    """Return the measurement of new observations as a calibration observes, of a chain as it is."""
    return Measurement(
        chain,
        observations,
        observable=calibration.settings["observable"],
        positions=None if positions is None else [positions],
        ties=ties_among(calibration.ties, parameter_table([chain])),
        wavelength=wavelength,
    )


def _errors(measurement):
    """Return number, rms, mean and scatter of the residuals at each wavelength."""
    residuals, (part,) = measurement.residuals(), measurement.datasets
    groups = [residuals[part.bin_of_datum == b] for b in part.bins]
    bias = [r.mean() if r.size else np.nan for r in groups]
    scatter = [r.std(ddof=1) if r.size > 1 else np.nan for r in groups]
    table = QTable({"wavelength": part.observations.wavelength, "n": [r.size for r in groups]})
    add_percent(table, s_standard=[rms(r) for r in groups], bias=bias, scatter=scatter)
    return table


def _pooled(wavelength, tables):
    """Return the rms in percent at some wavelengths (nm), of those in tables, by number of data."""
    squares, n = np.zeros(wavelength.size), np.zeros(wavelength.size)
    for own, percent, count in tables:
        percent, count = np.array(percent, dtype=float), np.array(count)
        known = np.isfinite(percent)
        pairs = np.abs(wavelength[:, None] - own) < SAME_WAVELENGTH * np.array(own)
        squares += pairs[:, known] @ (count * percent**2)[known]
        n += pairs[:, known] @ count[known]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(squares / n) * u.percent


def _words(table, same_source):
    chi = table["chi"][np.isfinite(table["chi"])]
    words = "no s_cv to compare with"
    if chi.size:
        words = f"errors {np.median(chi):.2g} times s_cv (median over the wavelengths)"
        words += "" if same_source else ", which is that of other sources"
    moved = table.meta["open_percent"]
    if moved > _WORTH_A_CAUTION * np.nanmedian(table["s_standard"].value):
        words += (
            "; along what the calibration does not determine the prediction moves by up to "
            f"{moved:.2g} % a degree, so its gauge counts"
        )
    return words


def keep(calibration, key, entry):
    """Keep what was found of observations, in the place of what was found of the same before."""
    others = calibration.fit.get(key, [])
    others = [other for other in others if other["content_hash"] != entry["content_hash"]]
    calibration.fit[key] = [*others, entry]


def add_standard(calibration, chain, observations, positions=None):
    """
    Predict a standard and keep the result with the calibration.

    It goes into ``calibration.fit["standards"]``, and so into summary, JSON and
    file, and into the column ``s_standard`` of the accuracies of datasets with the same
    source. A standard that was there already is replaced.

    Parameters
    ----------
    calibration : Calibration
        The calibration, which is changed; one read from a file will do.
    chain : Optic or `~astropy.modeling.CompoundModel`
        Chain of the standard. Nothing is fitted: optics that the calibration has, by name, take
        its values; the others keep theirs.
    observations : Observations
        The standard: a source, a night or settings that did not take part in the fit.
    positions : dict of str to `~numpy.ndarray`, optional
        Position of every stage in radian, shape (n_frames,).

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``wavelength``; ``n``, the number of data; ``s_standard``, rms of the errors of
        prediction; ``bias``, their mean; ``scatter``, their standard deviation about it; ``s_cv``,
        that of the calibration's data of the same source, or of all; and ``chi``, the ratio
        ``s_standard / s_cv``: 1 where the standard is predicted as well as settings left out of
        the fit. Meta ``name``, ``source``, ``content_hash``, ``n_frames``, ``words``;
        ``open_percent``: by how much the prediction moves, at most, for one degree, micrometre or
        percent along what the calibration does not determine; and ``not_calibrated``: optics whose
        values are those of the chain.

    Raises
    ------
    FitError
        If the observations took part in the fit, or the chain has free parameters of optics that
        were not calibrated.
    ChainError
        If an optic is of another kind than that of the same name.
    ObservationError
        If a wavelength is none of the calibration's.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration import add_standard
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> standard = example_calibration(seed=3).measurement.datasets[0].observations
    >>> table = add_standard(cal, cal.chain, standard)
    >>> u.allclose(cal.accuracy["s_standard"], table["s_standard"])
    True
    """
    table = standard_accuracy(calibration, chain, observations, positions)
    keys = ("wavelength", "n", "s_standard", "bias", "scatter", "s_cv", "chi")
    keep(calibration, "standards", columns(table, *keys) | dict(table.meta))
    for record in (r for r in calibration.datasets if r.accuracy is not None):
        same = (s for s in calibration.fit["standards"] if s["source"] == record.source)
        found = [(s["wavelength_nm"], s["s_standard_percent"], s["n"]) for s in same]
        wavelength = record.accuracy["wavelength"].to_value(u.nm)
        record.accuracy["s_standard"] = _pooled(wavelength, found)
    return table
