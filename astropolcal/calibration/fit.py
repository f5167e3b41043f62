# Licensed under a 3-clause BSD style license - see LICENSE
"""
Calibrate a chain against observations, with any astropy fitter.

The joint strategy fits all free parameters of all datasets at once, from a
start in which every wavelength sits in its best mirror branch. The two-step
strategy is the procedure of McIntosh et al. (2026, Sec. 5.2): per wavelength
with misalignments held, then global, then per wavelength again.
"""

import platform
import time
import warnings
from datetime import UTC, datetime

import astropy
import astropy.units as u
import numpy as np
import scipy
from astropy.modeling import Model
from astropy.modeling.fitting import TRFLSQFitter
from astropy.utils.exceptions import AstropyWarning

from astropolcal.calibration.accuracy import accuracy_table
from astropolcal.calibration.covariance import Covariance, full_covariance, prior_noise
from astropolcal.calibration.gauge import describe_gauge, open_parameters, settle
from astropolcal.calibration.goodness import lack_of_fit
from astropolcal.calibration.identifiability import analyse, complete
from astropolcal.calibration.noise import noise_from_errors, noise_from_null_channel
from astropolcal.calibration.result import Calibration, DatasetRecord
from astropolcal.calibration.starts import BinProblem, search_branches
from astropolcal.chain import join, leaves
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, FitError
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.units import to_unit
from astropolcal.version import version

__all__ = ["calibrate"]

STRATEGIES = ("joint", "two-step")
WEIGHTS = (None, "errors")
_MAX_EVALUATIONS = 500
_MAX_ROUNDS = 4
# a parameter closer to its bound than this (canonical units) sits at it
_AT_BOUND = 1e-5


def calibrate(
    chain,
    observations,
    *,
    fitter=None,
    strategy="joint",
    observable="normalized_double_difference",
    weights=None,
    ties=None,
    positions=None,
    wavelength=None,
    search=None,
    gauge="minimal",
    fix=None,
    instrument=None,
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
    strategy : {"joint", "two-step"}
        All parameters at once, or the paper's procedure.
    observable : str or Observable
        What is fitted; see `astropolcal.observations.OBSERVABLES`.
    weights : {None, "errors"}
        Equal weights, errors scaled to the residuals (the default, as the
        errors of real tables are rarely complete), or one over the errors.
    ties : dict of str to Tie, optional
        Parameters that follow others.
    positions : sequence of dict, optional
        Position of every stage for each dataset, see
        `~astropolcal.measurement.Measurement`.
    wavelength : `~astropy.units.Quantity`, optional
        Grid of the parameters given per wavelength.
    search : bool, optional
        Whether to look for the best mirror branch of each wavelength; without
        it the fit goes downhill from the chain's own values. By default the
        joint strategy searches, and the two-step one, like the paper, does not.
    gauge : {"minimal", None}
        Which solution to take where the data leave a choice: that with the
        least change of the parameters common to all wavelengths, or wherever
        the fit happens to end. The choice is recorded in ``settings``.
    fix : dict of str to `~astropy.units.Quantity` or None, optional
        Parameters to hold, ``"optic.parameter"``, at a value or (None) at
        that of the chain: another way to choose a gauge.
    instrument : str, optional
        Name to record.
    cross_validate : bool
        Whether to work out ``s_cv``, which costs one fit a derotator angle.

    Returns
    -------
    Calibration
        Chains, errors, accuracy, and what the data do not determine.

    Raises
    ------
    FitError
        If there is nothing to fit, fewer data than free parameters, or the
        weights are asked for where the table has no errors.
    ChainError, ObservationError, ParameterError
        If chain and observations do not fit together.

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
    if strategy not in STRATEGIES:
        raise FitError(f"strategy = {strategy!r}; allowed are {', '.join(STRATEGIES)}")
    search = strategy == "joint" if search is None else search
    started = time.perf_counter()
    fitter = TRFLSQFitter() if fitter is None else fitter
    options = {"observable": observable, "positions": positions, "wavelength": wavelength}
    chain = chain if fix is None else _fixed(chain, fix)
    measurement = Measurement(chain, observations, ties=ties, **options)
    weight = _weights(measurement, weights)
    _check(measurement)
    origin = measurement.vector()
    if strategy == "joint":
        outcome, stages = _joint(measurement, weight, fitter, search), []
    else:
        outcome, stages = _two_step(measurement, weight, fitter, search, options)
    if not outcome["converged"]:
        warnings.warn(
            f"the fit did not converge: {outcome['message']}", AstropolcalWarning, stacklevel=2
        )
    chosen = _settled(measurement, weight, origin, gauge)
    seconds = time.perf_counter() - started
    return _result(
        measurement,
        weight,
        settings={
            "instrument": instrument,
            "observable": measurement.observable.name,
            "fitter": type(fitter).__name__,
            "strategy": strategy,
            "weights": weights,
            "gauge": describe_gauge(gauge, chosen, measurement.free, list(fix or ())),
        },
        fit={"seconds": seconds, "n_data": measurement.n_data, **outcome},
        stages=stages,
        cross_validate=cross_validate,
    )


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
                number = to_unit(value, parameter.unit, name)
                parameter.value = np.broadcast_to(number, np.shape(parameter.value)).copy()
            parameter.fixed = True
    return copies[0] if single else copies


def _settled(measurement, weight, origin, gauge):
    """Choose the gauge where there is a choice; return what the data leave open."""
    if gauge == "minimal" and not measurement.free.priors:
        return settle(BinProblem(measurement, weight), weight, origin)
    return open_parameters(measurement, weight)


def _check(measurement):
    if not measurement.free.size:
        raise FitError("nothing to fit: every parameter is fixed or tied")
    if measurement.free.size > measurement.n_data:
        raise FitError(
            f"{measurement.free.size} free parameters but only {measurement.n_data} data; "
            "fix some, or add frames"
        )


def _weights(measurement, weights):
    """Return one over sigma, or None for equal weights."""
    if weights not in WEIGHTS:
        raise FitError(f"weights = {weights!r}; allowed are None and 'errors'")
    if weights is None:
        return None
    bad = ~(np.isfinite(measurement.sigma) & (measurement.sigma > 0))
    if bad.any():
        raise FitError(f"weights='errors', but {bad.sum()} of {bad.size} data have no error")
    return 1 / measurement.sigma


def _run(measurement, weight, fitter):
    """Fit in place; return whether it arrived, what it said, and how long it took."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", AstropyWarning)
        try:
            # a prior weighs against equal weights as much as the residuals say
            for _ in range(2 if weight is None and measurement.n_priors else 1):
                index, observed, weights = measurement.fit_arguments(
                    weight, prior_noise(measurement, weight)
                )
                fitter(
                    measurement,
                    index,
                    observed,
                    weights=weights,
                    maxiter=_MAX_EVALUATIONS,
                    inplace=True,
                )
        except (ValueError, np.linalg.LinAlgError) as error:
            raise FitError(f"{type(fitter).__name__} failed: {error}") from error
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
    slack = _AT_BOUND * np.maximum(1.0, np.abs(vector))
    outside = (vector < low - slack) | (vector > high + slack)
    return [measurement.free.names[i] for i in np.flatnonzero(outside)]


def _joint(measurement, weight, fitter, search):
    """Fit everything; go on as long as some bin finds a better mirror branch."""
    problem = BinProblem(measurement, weight)
    origin = measurement.vector()
    if search:
        measurement.parameters = search_branches(problem, origin)[0]
    for left in reversed(range(_MAX_ROUNDS)):
        outcome = _run(measurement, weight, fitter)
        # the last word belongs to the fit of all parameters, not to a search by bin
        if not search or not left:
            break
        better, moved = search_branches(problem, measurement.vector(), origin)
        if not moved.any():
            break
        measurement.parameters = better
    return outcome


# ---- the paper's procedure -----------------------------------------------------


def _two_step(measurement, weight, fitter, search, options):
    """Per wavelength with misalignments held, then global, then per wavelength again."""
    parts = [dataset.observations for dataset in measurement.datasets]
    single = {slot.name for slot in measurement.free.slots if not slot.per_wavelength}
    several = {slot.name for slot in measurement.free.slots if slot.per_wavelength}
    ties = measurement.free.ties
    measurement.put_back()
    options = options | {"wavelength": measurement.wavelength * u.um}
    stages = []

    loose = [_loosened(chain, measurement.wavelength * u.um) for chain in measurement.chains]
    first = _step_of(loose, single, parts, ties, options)
    outcomes = [_joint(first, weight, fitter, search)]
    stages.append(_stage("per wavelength, misalignments held", first))
    _copy_values(first.put_back(), measurement.chains)

    for title, held in (("global", several), ("per wavelength, global parameters held", single)):
        step = _step_of(measurement.chains, held, parts, ties, options)
        if step.free.size:
            outcomes.append(_run(step, weight, fitter))
        stages.append(_stage(title, step))
        _copy_values(step.put_back(), measurement.chains)
    measurement.parameters = measurement.free.start()
    # the first step that did not arrive spoils those behind it
    return next((o for o in outcomes if not o["converged"]), outcomes[-1]), stages


def _step_of(chains, held, parts, ties, options):
    """Return the measurement of one step; what follows a held parameter is held too."""
    known = set(parameter_table(chains))
    live = {n: tie for n, tie in ties.items() if n in known and tie.source in known - held}
    return Measurement(_held(chains, held | (set(ties) - set(live))), parts, ties=live, **options)


def _loosened(chain, wavelength):
    return join(leaf.loosened(wavelength) for leaf in leaves(chain.copy()))


def _held(chains, names):
    """Return copies of the chains with more parameters fixed."""
    copies = [chain.copy() for chain in chains]
    for name, parameters in parameter_table(copies).items():
        if name in names:
            for parameter in parameters:
                parameter.fixed = True
    return copies


def _copy_values(origin, target):
    """Copy the values of parameters that both have, name by name."""
    known = parameter_table(origin)
    for name, parameters in parameter_table(target).items():
        for parameter in parameters:
            if name in known and np.shape(known[name][0].value) == np.shape(parameter.value):
                parameter.value = known[name][0].value


def _stage(title, measurement):
    """Record the values of one stage, with units, and its residuals."""
    measurement.put_back()
    values = {slot.name: measurement.free.values_of(slot.name) for slot in measurement.free.slots}
    rms = float(np.sqrt(np.mean(measurement.residuals() ** 2)))
    return {"title": title, "parameters": values, "residual_rms": rms}


# ---- the result ------------------------------------------------------------------


def _result(measurement, weight, *, settings, fit, stages, cross_validate):
    vector = measurement.vector()
    held = _at_bounds(measurement.free, vector)
    whitened = measurement.jacobian(vector) * (1.0 if weight is None else weight)
    priors = measurement.free.prior_jacobian(vector) * prior_noise(measurement, weight)
    finding, unscaled = analyse(measurement.free, whitened, held, priors)
    complete(finding, measurement, vector)
    residuals = measurement.residuals(vector)
    freedom = max(measurement.n_data - finding.rank, 1)
    scale = np.sum(residuals**2) / freedom if weight is None else 1.0
    names = measurement.free.names
    calibration = Calibration(
        chains=measurement.put_back(vector),
        wavelength=(measurement.wavelength * u.um).to(u.nm),
        covariance=Covariance.from_canonical(measurement.free, unscaled * scale),
        identifiability=finding,
        at_bound=[names[i] for i in np.flatnonzero(held)],
        datasets=[_record(measurement, i, residuals) for i in range(len(measurement.datasets))],
        settings=settings,
        fit=fit,
        ties=dict(measurement.free.ties),
        stages=stages,
        measurement=measurement,
        provenance=_provenance(),
    )
    calibration.covariance = full_covariance(calibration)
    calibration.fit["lack_of_fit"] = _lack_of_fit(calibration)
    return calibration.cross_validate() if cross_validate else calibration


def _lack_of_fit(calibration):
    """Hold the residuals against the noise that the table states, and that the data show."""
    found = []
    for noise_of in (noise_from_errors, _smooth_null):
        try:
            noise = noise_of(calibration.measurement)
            test = lack_of_fit(calibration.measurement, calibration, noise)
        except AstropolcalError:
            continue  # no errors in the table, or no pairs: nothing to hold against
        found.append(
            {
                "noise": noise.method,
                "times_noise": float(np.sqrt(test.chi2 / test.expected)),
                "p_value": float(test.p_value),
                "words": test.words,
            }
        )
    return found


def _smooth_null(measurement):
    return noise_from_null_channel(measurement, null_model="smooth")


def _at_bounds(free, vector):
    low, high = free.bounds()
    near = _AT_BOUND * np.maximum(1.0, np.abs(vector))
    return (vector - low < near) | (high - vector < near)


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
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }
