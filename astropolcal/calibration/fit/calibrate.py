# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrate a chain against observations, with any astropy fitter.

The joint strategy fits all free parameters of all datasets at once, from a
start in which every wavelength sits in its best mirror branch. The two-step
strategy is the procedure of McIntosh et al. (2026, Sec. 5.2): per wavelength
with misalignments held, then global, then per wavelength again.
"""

import platform
import time
import warnings
from datetime import UTC, datetime
from importlib.metadata import version as installed

import astropy
import astropy.units as u
import numpy as np
from astropy.modeling import Model
from astropy.modeling.fitting import TRFLSQFitter
from astropy.utils.exceptions import AstropyWarning

from astropolcal.calibration.fit.strategies import (
    BinProblem,
    copy_fitted,
    describe_gauge,
    hold_silent,
    open_parameters,
    other_laws,
    search_branches,
    sequential,
    settled,
    smooth_branches,
    telescope_alone,
    two_step,
)
from astropolcal.calibration.identifiability.analysis import complete, finding_of
from astropolcal.calibration.identifiability.sky import view_of_measurement
from astropolcal.calibration.noise.estimates import (
    noise_from_errors,
    noise_from_null_channel,
    noise_from_roughness,
)
from astropolcal.calibration.noise.scatter import Scatter, model_error
from astropolcal.calibration.noise.weighting import (
    LOSSES,
    ROUNDS,
    TALL,
    Problem,
    Weighting,
    describe,
    first_weighting,
    noise_of,
    outlying_data,
    robust_sigma,
)
from astropolcal.calibration.result.calibration import Calibration, DatasetRecord
from astropolcal.calibration.uncertainty.covariance import (
    covariance_around,
    errors_at_bounds,
    white_covariance,
)
from astropolcal.calibration.validation.cross_validation import accuracy_table, lack_of_fit
from astropolcal.calibration.validation.targets import keep_sky_accuracy
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, FitError
from astropolcal.files import one_line
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.measurement.datasets import as_pairs
from astropolcal.measurement.parameters import ROUNDING, with_own
from astropolcal.progress import in_one_thread, stage
from astropolcal.units import to_unit
from astropolcal.version import version
from astropolcal.words import check_choice

__all__ = ["calibrate"]

STRATEGIES = ("joint", "two-step", "sequential")
ERRORS = ("scatter", "white")
_MAX_EVALUATIONS = 500
_MAX_ROUNDS = 4
_ROBUST_ROUNDS = 50
# residuals this many times the noise may be those of a wrong minimum: so many others are tried, and
# one counts that leaves less than this share
_STANDS_OUT, _STARTS, _BETTER = 3.0, 4, 0.9
# nor is one tried that leaves so many times as much before everything is fitted, or is not better
# after so many evaluations
_HOPELESS, _GLANCE = 100.0, 15
# of data without noise, residuals below this are rounding
_ROUNDED = 1e-6
# branches are searched in so many groups of frames of a dataset, if it has several times as many
_FEW, _LONG = 256, 4
# a wavelength in the branch of its neighbours may have up to so many times the sum of squares
_WORTH = 3.0


@in_one_thread
def calibrate(
    chain,
    observations,
    *,
    fitter=None,
    strategy="joint",
    observable=None,
    weights=None,
    ties=None,
    own=(),
    positions=None,
    wavelength=None,
    search=None,
    gauge="minimal",
    loss="linear",
    fix=None,
    instrument=None,
    errors="scatter",
    cross_validate=True,
):
    """
    Calibrate a chain against observations.

    Parameters
    ----------
    chain : Optic, `~astropy.modeling.CompoundModel` or sequence of them
        The chain of each dataset, with starting values, bounds and fixed
        flags; it is not changed. Optics of the same name are the same optic.
    observations : Observations or sequence of Observations
        The datasets.
    fitter : `~astropy.modeling.fitting.Fitter`, optional
        Any non-linear astropy fitter, by default ``TRFLSQFitter()``.
    strategy : {"joint", "two-step", "sequential"}
        All parameters at once; or the paper's procedure for the polarized source; or
        the paper's order of datasets: polarized source, unpolarized source, stars, each
        step holding what the ones before have found.
    observable : str or Observable, optional
        What is fitted; see `astropolcal.observations.OBSERVABLES`. By default normalized double
        differences, of tables without a column ``hwp`` single ones, and of single beams the
        intensity.
    weights : {None, "wavelength", "errors"}, NoiseEstimate or array_like
        Noise of the data, which sets their weights and the scale of all errors. None: one level for
        all data, from the residuals (the default, as the errors of real tables are rarely
        complete). ``"wavelength"``: one level for each wavelength of each dataset, from the
        residuals, with the fit repeated until both agree. ``"errors"``: the errors of the tables.
        Or the noise itself, its standard deviation as one value, one per wavelength or one per
        datum.
    ties : dict of str to Tie, optional
        Parameters that follow others.
    own : sequence of str, or dict of str to sequence
        Parameters, ``"optic.parameter"``, with a value of their own in each dataset; in a dict with
        the group of each dataset, such as its night, in which they have the same. All others are
        shared. In all groups but the first the name of the group is added to that of the optic. The
        full summary says which of them really differ.
    positions : sequence of dict, optional
        Position of every stage for each dataset, see `~astropolcal.measurement.Measurement`.
    wavelength : `~astropy.units.Quantity`, optional
        Grid of the parameters given per wavelength.
    search : bool, optional
        Whether to look for the best mirror branch of each wavelength; without
        it the fit goes downhill from the chain's own values. By default the
        joint strategy searches, and the two-step one, like the paper, does not.
    gauge : {"minimal", None}
        Which solution to take where several are equal: that with the
        least change of the parameters common to all wavelengths, or wherever
        the fit happens to end. The choice is recorded in ``settings``.
    loss : {"linear", "huber", "cauchy", "bisquare"}
        With another loss than the linear one, which is least squares, data that depart far
        from the model count less. It sets the
        noise of each datum, so ``weights`` counts for the first fit only.
    fix : dict of str to `~astropy.units.Quantity` or None, optional
        Parameters to hold, ``"optic.parameter"``, at a value or (None) at
        that of the chain: another way to choose a gauge.
    instrument : str, optional
        Name to record.
    errors : {"scatter", "white"}
        Errors of the parameters: from how the residuals scatter and are correlated at wavelengths,
        pairs of frames and settings of each dataset; or those of independent data whose noise is
        that of ``weights``.
    cross_validate : bool
        Whether to work out ``s_cv``, which costs one fit a derotator angle.

    Returns
    -------
    Calibration
        Chains, errors, accuracy, and what the data do not determine.

    Raises
    ------
    FitError
        If there is nothing to fit, fewer data than free parameters, the weights are asked for where
        the table has no errors, the residuals of a wavelength tell no noise, a parameter starts
        outside its bounds, or the two-step strategy has no polarized source.
    ChainError, ObservationError, ParameterError
        If chain and observations do not fit together, or a noise given is not a possible one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> cal.converged
    True
    """
    _check_choices(strategy, loss, errors)
    search = strategy != "two-step" if search is None else search
    started = time.perf_counter()
    fitter = TRFLSQFitter() if fitter is None else fitter
    options = {"observable": observable, "positions": positions, "wavelength": wavelength}
    chain = chain if fix is None else _fixed(chain, fix)
    copies = {}
    if own:
        chains, tables, _ = zip(*as_pairs(chain, observations, positions), strict=True)
        chain, ties, copies = with_own(chains, [table.name for table in tables], own, ties)
    measurement = Measurement(chain, observations, ties=ties, **options)
    measurement.note_inputs()
    weighting = first_weighting(measurement, weights)
    _check(measurement)
    origin = measurement.vector()
    how = _Strategy(fitter, search, weights, options)
    outcome, weighting, stages = how.fit(strategy, measurement, weighting)
    if loss != "linear":
        outcome, weighting = _robust(measurement, fitter, loss, outcome)
    if not outcome["converged"]:
        warnings.warn(
            f"the fit did not converge: {outcome['message']}", AstropolcalWarning, stacklevel=2
        )
    hold_silent(measurement, origin)
    chosen, weighting, whitened = _settled(measurement, weighting, origin, gauge)
    outcome |= {"seconds": time.perf_counter() - started, "n_data": measurement.n_data}
    return _result(
        measurement,
        whitened,
        settings={
            "instrument": instrument,
            "observable": measurement.observable.name,
            "fitter": type(fitter).__name__,
            "strategy": strategy,
            "weights": weighting.choice,
            "loss": loss,
            "errors": errors,
            "noise": describe(measurement, weighting),
            "gauge": describe_gauge(gauge, chosen, measurement.free, list(fix or ())),
            **({"own": copies} if copies else {}),
        },
        fit=outcome,
        stages=stages,
        cross_validate=cross_validate,
    )


def _check_choices(*values):
    choices = {"strategy": STRATEGIES, "loss": LOSSES, "errors": ERRORS}
    for (name, allowed), value in zip(choices.items(), values, strict=True):
        check_choice(name, value, allowed, FitError)


def _fixed(chain, fix):
    """Return copies of the chains with parameters held."""
    single = isinstance(chain, Model)
    copies = [item.copy() for item in ([chain] if single else chain)]
    table = parameter_table(copies)
    for name, value in fix.items():
        if name not in table:
            raise FitError(f"fix: no parameter {name!r}; there are {', '.join(table)}")
        for parameter in table[name]:
            if value is not None:
                # every dataset's chain has its own Parameter object of the name
                number = to_unit(value, parameter.unit, name)
                parameter.value = np.broadcast_to(number, np.shape(parameter.value)).copy()
            parameter.fixed = True
    return copies[0] if single else copies


def _settled(measurement, weighting, origin, gauge):
    """Choose the gauge where there is a choice; return what is open, noise and linear problem."""
    if gauge == "minimal":
        chosen, whitened = settled(BinProblem(measurement, weighting), origin)
    else:
        whitened = Problem(measurement, weighting).around()
        chosen = open_parameters(measurement.free, whitened)
    if len(whitened.data.null):
        hold_silent(measurement, origin)
    measurement.weighting = weighting.updated(measurement, whitened)
    if measurement.weighting.weight is not None and weighting.from_residuals:
        whitened = Problem(measurement, measurement.weighting).around()
    return chosen, measurement.weighting, whitened


def _check(measurement):
    if not measurement.free.size:
        raise FitError("nothing to fit: every parameter is fixed or tied")
    if measurement.free.size > measurement.n_data:
        raise FitError(
            f"{measurement.free.size} free parameters but only {measurement.n_data} data; "
            "fix some, or add frames"
        )
    for name in _outside_bounds(measurement):
        free, i = measurement.free, measurement.free.names.index(name)
        unit, factor = free.by_name[name.partition("[")[0]].unit or "", free.factors()[i]
        value, low, high = (x[i] / factor for x in (measurement.vector(), *free.bounds()))
        # fitters tell neither name nor value
        allowed = f"{low:.7g} to {high:.7g} {unit}".strip()
        raise FitError(f"{name} starts at {value:.7g}; allowed are {allowed}")
    vector, inside = measurement.vector(), np.clip(measurement.vector(), *measurement.free.bounds())
    # fitters refuse a start that is outside by a rounding error, too
    if (vector != inside).any():
        measurement.stand_at(inside)


def _run(measurement, weighting, fitter):
    """Fit in place until the noise agrees with the residuals; return how it went, and the noise."""
    # one level for all data does not move the minimum, unless priors weigh against them
    told = weighting.choice == "wavelength" or (weighting.from_residuals and measurement.n_priors)
    if not told:
        return _fit(measurement, weighting, fitter), weighting
    if not weighting.is_known:
        weighting = weighting.started(measurement)
    # noise from the residuals of a fit whose weights come from that noise: a fixed point
    for _ in range(ROUNDS):
        outcome = _fit(measurement, weighting, fitter)
        before, weighting = weighting, weighting.updated(measurement)
        if not np.isfinite(weighting.sigma).all():
            raise FitError(
                f"{measurement.free.size} free parameters and {measurement.n_data} data leave none "
                "for the noise, against which priors weigh; fix some, add frames, or take "
                "weights='errors'"
            )
        if weighting.agrees(before):
            return outcome, weighting
    message = f"the noise from the residuals did not settle in {ROUNDS} fits"
    return outcome | {"converged": False, "message": message}, weighting


def _fit(measurement, weighting, fitter):
    """Fit in place; return whether it arrived, what it said, and how long it took."""
    stage(f"fitting {measurement.free.size} parameters")
    if type(fitter) is TRFLSQFitter and measurement.n_data > TALL:
        # the same steps by triangular factors, for which the fitter has no place
        vector, _, found = Problem(measurement, weighting).fit(measurement.vector())
        measurement.stand_at(vector)
        return {
            "converged": found.success,
            "message": found.message,
            "evaluations": int(found.nfev),
        }
    index, observed, weights = measurement.fit_arguments(weighting.weight, weighting.level)
    canonical = measurement.canonical()
    with warnings.catch_warnings(record=True) as caught:
        # recorded, not shown: whether the fit arrived is told once, in the words of this package
        warnings.simplefilter("always", AstropyWarning)
        try:
            fitter(
                canonical,
                index,
                observed,
                weights=weights,
                maxiter=_MAX_EVALUATIONS,
                inplace=True,
            )
        except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
            said = one_line(str(error))
            raise FitError(f"{type(fitter).__name__} failed: {said}") from error
    measurement.stand_at(canonical.vector())
    info = fitter.fit_info if hasattr(fitter, "fit_info") and fitter.fit_info else {}
    said = [str(w.message) for w in caught if "unsuccessful" in str(w.message)]
    outside = _outside_bounds(measurement)
    if outside:
        said.append(f"{type(fitter).__name__} left the bounds of {', '.join(outside)}")
    evaluations = info.get("nfev")
    return {
        "converged": not said,
        "message": said[-1] if said else str(info.get("message", "")).strip(),
        "evaluations": None if evaluations is None else int(evaluations),
    }


def _outside_bounds(measurement):
    """Return the names of parameters that a fitter without bounds left outside of theirs."""
    low, high = measurement.free.bounds()
    vector = measurement.vector()
    # a fitter that minds the bounds ends on them only as exactly as rounding allows
    slack = ROUNDING * np.maximum(1.0, np.abs(vector))
    outside = (vector < low - slack) | (vector > high + slack)
    return [measurement.free.names[i] for i in np.flatnonzero(outside)]


def _joint(measurement, weighting, fitter, search, prepare):
    """Fit everything; where the residuals stand out, from other values of its laws, too."""
    origin = measurement.vector()
    best = _descend(measurement, weighting, fitter, search, prepare, origin)
    if not search or not _stands_out(measurement):
        return best
    found, problem = measurement.vector(), BinProblem(*_thinned(measurement, weighting))
    least = np.sum(problem.residuals(found) ** 2)
    for promised, start in other_laws(problem, found, origin)[:_STARTS]:
        if promised > _HOPELESS * least:
            break
        start, left = _glanced(problem, start, origin)
        if left >= _BETTER * least:
            continue
        measurement.stand_at(start)
        outcome = _descend(measurement, weighting, fitter, search, prepare, origin, start)
        left = np.sum(problem.residuals(measurement.vector()) ** 2)
        if left < _BETTER * least:
            best, found, least = outcome, measurement.vector(), left
            if not _stands_out(measurement):
                break
    measurement.stand_at(found)
    return best


def _glanced(problem, start, origin):
    """Return where a start leads in a few steps of everything, and what it leaves there.

    Most starts lead to the minimum that is known, or crawl towards one that is no better.
    """
    start = problem.fit(start, evaluations=_GLANCE)[0]
    start, moved = search_branches(problem, start, origin)
    if moved.any():
        start = problem.fit(start, evaluations=_GLANCE)[0]
    return start, np.sum(problem.residuals(start) ** 2)


def _stands_out(measurement):
    """Whether the residuals are far above the noise that the frames show, or the table states."""
    residuals = measurement.residuals(measurement.vector())[: measurement.n_data]
    for method in (_noise_of_frames, noise_from_errors):
        try:
            sigma = method(measurement).sigma_of_data
        except AstropolcalError:
            continue  # few wavelengths, or no errors in the table
        return bool(np.mean((residuals / np.maximum(sigma, _ROUNDED)) ** 2) > _STANDS_OUT**2)
    return False


def _descend(measurement, weighting, fitter, search, prepare, origin, start=None):
    """Fit everything; go on as long as some bin finds a better mirror branch."""
    small, noise = _thinned(measurement, weighting)
    if search and start is None:
        small.stand_at(_first_search(small, noise, origin))
    prepare(small)
    # branches are found on few frames, so the long table starts from their fit
    if small is not measurement:
        _run(small, noise, fitter)
        measurement.stand_at(small.vector())
    for left in reversed(range(_MAX_ROUNDS)):
        outcome, weighting = _run(measurement, weighting, fitter)
        # the last word belongs to the fit of all parameters, not to a search by bin
        if not search or not left:
            break
        small, noise = _thinned(measurement, weighting)
        better, moved = search_branches(BinProblem(small, noise), small.vector(), origin)
        if not moved.any():
            break
        measurement.stand_at(better)
    return _smoothed(measurement, weighting, fitter, outcome) if search else (outcome, weighting)


def _smoothed(measurement, weighting, fitter, outcome):
    """Fit again with single wavelengths in the branch of their neighbours, if nearly as good."""
    problem, found = BinProblem(*_thinned(measurement, weighting)), measurement.vector()
    start, moved = smooth_branches(problem, found)
    if not moved.any():
        return outcome, weighting
    costs = problem.costs(found)[moved]
    measurement.stand_at(start)
    again = _run(measurement, weighting, fitter)
    if np.all(problem.costs(measurement.vector())[moved] < _WORTH * costs):
        return again
    measurement.stand_at(found)
    return outcome, weighting


def _thinned(measurement, weighting):
    """Return a few hundred frames of each dataset, and their noise; short tables as they are."""
    if max(d.frames.shape[0] for d in measurement.datasets) <= _LONG * _FEW:
        return measurement, weighting
    small, kept = measurement.thinned(_FEW)
    return small, Weighting(weighting.choice, weighting.sigma[kept])


def _first_search(measurement, weighting, origin):
    """Return the best branches; where no noise is known yet, first without the priors."""
    stage("looking for where to start")
    problem = BinProblem(measurement, weighting)
    found = search_branches(problem, origin)[0]
    if weighting.is_known or not problem.has_priors:
        return found
    measurement.stand_at(found)
    problem = BinProblem(measurement, weighting.started(measurement))
    return search_branches(problem, origin)[0]


class _Strategy:
    """How a measurement is fitted: fitter, search of branches, and the order of steps."""

    def __init__(self, fitter, search, weights, options):
        self.fitter, self.search, self.weights, self.options = fitter, search, weights, options

    def fit(self, strategy, measurement, weighting):
        """Fit in place; return how it went, the noise, and the values after each step."""
        if strategy == "joint":
            return *self._joint(measurement, weighting, self._stars), []
        if strategy == "two-step":
            return two_step(measurement, weighting, self._joint, self._run, self.options)
        outcome, stages = sequential(measurement, self._first, self._joint, self._run, self.options)
        return outcome, noise_of(measurement, self.weights), stages

    def _joint(self, measurement, weighting, prepare=lambda _: None):
        return _joint(measurement, weighting, self.fitter, self.search, prepare)

    def _stars(self, measurement):
        # the law of a telescope's mirror is nearly degenerate: cheap steps with the rest held
        alone = telescope_alone(measurement, self.options)
        if alone is not None:
            self._run(alone, first_weighting(alone, None))
            copy_fitted(alone, measurement)

    def _run(self, measurement, weighting):
        return _run(measurement, weighting, self.fitter)

    def _first(self, measurement):
        if self.weights is not None and not isinstance(self.weights, str):
            raise FitError(
                "strategy='sequential' fits the datasets one by one, so the noise cannot be given "
                "for all data; allowed are weights = None, 'wavelength', 'errors'"
            )
        return first_weighting(measurement, self.weights)


def _robust(measurement, fitter, loss, outcome):
    """Fit with the weights of a robust loss until they settle."""
    before = None
    for _ in range(_ROBUST_ROUNDS):
        # iteratively reweighted least squares, which every fitter can do
        weighting = Weighting("given", robust_sigma(measurement, loss))
        if before is not None and weighting.agrees(before):
            return outcome, weighting
        outcome = _fit(measurement, weighting, fitter)
        before = weighting
    message = f"the weights of the robust fit did not settle in {_ROBUST_ROUNDS} fits"
    return outcome | {"converged": False, "message": message}, weighting


# ---- the result ------------------------------------------------------------------


def _result(measurement, whitened, *, settings, fit, stages, cross_validate, covariance=None):
    """Return the calibration; ``covariance`` is that of more data than its own."""
    vector = measurement.vector()
    residuals, level = measurement.residuals(vector), measurement.weighting.level
    finding = finding_of(measurement.free, whitened)
    view = view_of_measurement(measurement, vector, settings["instrument"])
    complete(finding, measurement, vector, whitened, level, view=view)
    names = measurement.free.names
    own, lacking = _errors(measurement, whitened, settings["errors"])
    covariance = own if covariance is None else covariance
    calibration = Calibration(
        chains=measurement.put_back(vector),
        wavelength=(measurement.wavelength * u.um).to(u.nm),
        covariance=covariance,
        identifiability=finding,
        at_bound=[names[i] for i in np.flatnonzero(whitened.held)],
        datasets=[_record(measurement, i, residuals) for i in range(len(measurement.datasets))],
        settings=settings,
        fit=fit,
        ties=dict(measurement.free.ties),
        stages=stages,
        measurement=measurement,
        provenance=_provenance(),
    )
    observations = (dataset.observations for dataset in measurement.datasets)
    calibration.fit["masked"] = [dict(each.mask_reasons) for each in observations]
    calibration.fit["bounds"] = errors_at_bounds(measurement, whitened)
    calibration.fit["lack_of_fit"] = _lack_of_fit(calibration, whitened)
    calibration.fit["outliers"] = _outliers(calibration)
    calibration.fit["model_error"] = lacking
    keep_sky_accuracy(calibration, view)
    stage("cross-validation")
    return calibration.cross_validate() if cross_validate else calibration


def _errors(measurement, whitened, how):
    """Return the covariance of the parameters, and the error of the model at a new setting."""
    if how == "white":
        return white_covariance(measurement, whitened, measurement.weighting), None
    scatter = Scatter(measurement, measurement.weighting, whitened)
    covariance = covariance_around(measurement, whitened, measurement.weighting, scatter)
    return covariance, model_error(measurement, scatter)


def _lack_of_fit(calibration, whitened):
    """Hold the residuals against the noise that the table states, and that the frames show."""
    found = []
    live = calibration.measurement
    for method in (noise_from_errors, _noise_of_frames):
        try:
            noise = method(live)
            test = lack_of_fit(live, calibration, noise, whitened=whitened)
        except AstropolcalError:
            continue  # no errors in the table, or too few frames: nothing to hold against
        # unknown where no degree of freedom is left
        ratio = test.chi2 / test.expected if test.expected > 0 else np.nan
        found.append(
            {
                "noise": noise.method,
                "noise_percent": 100 * float(np.sqrt(np.mean(noise.sigma_of_data**2))),
                "times_noise": float(np.sqrt(ratio)),
                "p_value": float(test.p_value),
                "words": test.words,
            }
        )
    return found


def _noise_of_frames(measurement):
    """Return the noise that a diagnosis compares with; of few wavelengths that of the null."""
    try:
        return noise_from_roughness(measurement)
    except FitError:
        return noise_from_null_channel(measurement, null_model="smooth")


def _outliers(calibration):
    """Return the pairs of frames at odds with the fit, for summary, JSON and file."""
    table = outlying_data(calibration)
    return [
        {
            "dataset": str(row["dataset"]),
            "frames": str(row["frames"]),
            "residual_percent": float(row["residual"].to_value("percent")),
            "sigma": float(row["sigma"]),
            "brightness": float(row["brightness"]),
        }
        for row in table
    ]


def _record(measurement, i, residuals):
    observations = measurement.datasets[i].observations
    return DatasetRecord(
        name=observations.name,
        source=observations.source,
        content_hash=observations.content_hash,
        meta=dict(observations.meta),
        n_frames=observations.n_frames,
        n_masked=int(observations.mask.sum()),
        accuracy=accuracy_table(measurement, i, residuals),
    )


def _provenance():
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "astropolcal": version,
        "astropy": astropy.__version__,
        "numpy": np.__version__,
        "scipy": installed("scipy"),
        "python": platform.python_version(),
    }
