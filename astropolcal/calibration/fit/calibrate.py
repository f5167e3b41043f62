# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrate a chain against observations, with any astropy fitter.

The joint strategy fits all free parameters of all datasets at once, from a start in which every
wavelength sits in its best mirror branch. The two-step strategy is the procedure of McIntosh et al.
(2026, Sec. 5.2): per wavelength with misalignments held, then global, then per wavelength again.

Gauge: where the data do not determine all directions, every point along them fits equally well, and
where a fit ends is an accident of its start. The *minimal* gauge takes the solution whose
parameters common to all wavelengths (the misalignments) have moved least from where they started. A
user names another gauge by holding parameters (``fix=``) or by a prior.
"""

import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version as installed

import astropy.units as u
import numpy as np
from astropy.modeling import Model
from astropy.modeling.fitting import LinearLSQFitter, TRFLSQFitter

from astropolcal.calibration.fit.branches import ROUNDED, BinProblem, bent_valleys, undecided_signs
from astropolcal.calibration.fit.strategies import (
    joint,
    known_noises,
    outside_bounds,
    sequential,
    two_step,
    until_settled,
)
from astropolcal.calibration.identifiability.analysis import complete
from astropolcal.calibration.identifiability.linearized import curved_directions
from astropolcal.calibration.identifiability.sky import consequences_along, view_of_measurement
from astropolcal.calibration.noise.estimates import noise_as_given, rms
from astropolcal.calibration.noise.scatter import Scatter, model_error
from astropolcal.calibration.noise.weighting import (
    GIVEN,
    LOSSES,
    Problem,
    describe,
    first_weighting,
    outlying_data,
    robust_weighting,
)
from astropolcal.calibration.result.calibration import Calibration, DatasetRecord
from astropolcal.calibration.uncertainty.covariance import (
    between_datasets,
    covariance_around,
    disagreements,
    errors_at_bounds,
)
from astropolcal.calibration.validation.cross_validation import (
    accuracy_table,
    cross_validated_residuals,
    lack_of_fit,
)
from astropolcal.calibration.validation.targets import keep_sky_accuracy
from astropolcal.chain import leaves
from astropolcal.exceptions import ChainError, FitError, ParameterError, warn
from astropolcal.files import columns, provenance
from astropolcal.measurement import Measurement
from astropolcal.measurement.datasets import as_pairs, refuse_repeated
from astropolcal.measurement.parameters import parameters_named, with_own
from astropolcal.progress import in_one_thread, stage
from astropolcal.units import to_unit
from astropolcal.words import check_choice, check_type

__all__ = ["calibrate"]

STRATEGIES = ("joint", "two-step", "sequential")
ERRORS = ("scatter", "white")
GAUGES = ("minimal", None)
_CHOICES = {"strategy": STRATEGIES, "loss": LOSSES, "errors": ERRORS, "gauge": GAUGES}
DEFAULTS = {key: next(iter(allowed)) for key, allowed in _CHOICES.items()}
_ROBUST_ROUNDS = 50
# the optics of this package are tested; step, in degrees, micrometres or percent, for others
_OWN, _DIFFERENCE, _DIFFERS = __name__.partition(".")[0], 1e-4, 1e-2
# and how many of them away from bounds
_INSIDE = 100


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
        step holding what the ones before have found. Steps do not end at the minimum of all
        parameters, to which errors belong; the verdict says which is how far off.
    observable : str or Observable, optional
        What is fitted; see `astropolcal.observations.OBSERVABLES`. By default normalized double
        differences, of tables without a column ``hwp`` single ones, and of single beams the
        intensity.
    weights : {None, "wavelength", "errors"}, NoiseEstimate or array_like
        Noise of the data, which sets their weights, and with ``errors="white"`` the scale of all
        errors. None: one level for all data, from the residuals (the default, as the errors of real
        tables are rarely complete). ``"wavelength"``: one level for each wavelength of each
        dataset, from the residuals, with the fit repeated until both agree. ``"errors"``: the
        errors of the tables. Or the noise itself, its standard deviation as one value, one per
        wavelength or one per datum.
    ties : dict of str to Tie, optional
        Parameters that follow others. They have no priors but those of what they follow.
    own : str or sequence of str, or dict of str to sequence
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
        from the model count less. It sets the noise of each datum, so ``weights`` counts for the
        first fit only. Errors of parameters allow for weights that follow the residuals; a profile,
        a bootstrap and samples take them as known, and may be a third narrower.
    fix : str or sequence of str, or dict of str to `~astropy.units.Quantity` or None, optional
        Parameters to hold, ``"optic.parameter"``, at a value or (None, or a name alone) at
        that of the chain: another way to choose a gauge. ``"optic"`` holds all of its parameters.
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
        outside its bounds, an optic gives wrong derivatives, or the two-step strategy has no
        polarized source.
    ChainError, ObservationError, ParameterError
        If chain and observations do not fit together, a table is given twice, or a noise given is
        not a possible one.

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
    chosen = {"strategy": strategy, "loss": loss, "errors": errors, "gauge": gauge}
    for name, value in chosen.items():
        check_choice(name, value, _CHOICES[name], FitError)
    search = strategy != "two-step" if search is None else search
    options = {"observable": observable, "positions": positions, "wavelength": wavelength}
    if not isinstance(fix, Mapping):
        fix = dict.fromkeys([fix] if isinstance(fix, str) else fix or ())
    chain, held = _fixed(chain, fix) if fix else (chain, ())
    copies = {}
    if own:
        chains, tables, _ = zip(*as_pairs(chain, observations, positions), strict=True)
        chain, ties, copies = with_own(chains, [table.name for table in tables], own, ties)
    measurement = Measurement(chain, observations, ties=ties, **options)
    how = {"weights": weights, "fitter": fitter, "search": search, "options": options}
    found = fitted(measurement, chosen, **how, instrument=instrument, held=held)
    found.settings |= {"own": copies} if copies else {}
    return found.calibration(cross_validate=cross_validate)


@dataclass
class FittedMeasurement:
    """A measurement that was fitted, of which errors are worked out where they are asked for."""

    measurement: Measurement
    whitened: object
    settings: dict
    fit: dict
    stages: list
    #: Parameters with laws that a fit of the measurement alone does not know.
    lawful: tuple = ()

    @property
    def chains(self):
        """The fitted chains."""
        return self.measurement.put_back(self.measurement.vector())

    @property
    def converged(self):
        """Whether the fit converged."""
        return self.fit["converged"]

    def accuracies(self, *, cross_validate=True):
        """Return the accuracies of each dataset, for which no errors of parameters are needed."""
        live, held_out = self.measurement, None
        if cross_validate:
            stage("cross-validation")
            held_out = cross_validated_residuals(live, live.weighting.weight)
        each = range(len(live.datasets))
        return [accuracy_table(live, i, live.residuals(), held_out) for i in each]

    def calibration(self, *, cross_validate=False, covariance=None):
        """Return the calibration, with its errors; ``covariance`` is that of more data."""
        calibration = _result(self, covariance)
        stage("cross-validation")
        return calibration.cross_validate() if cross_validate else calibration


def fitted(
    measurement,
    chosen=None,
    *,
    weights=None,
    fitter=None,
    search=True,
    options=None,
    instrument=None,
    held=(),
):
    """Fit a measurement as `calibrate` does; ``held`` are the names of what was fixed for it."""
    started, chosen = time.perf_counter(), DEFAULTS if chosen is None else chosen
    check_type("instrument", instrument, str | None, "its name is needed", FitError)
    fitter = TRFLSQFitter() if fitter is None else fitter
    # a linear one takes no steps
    if isinstance(fitter, (type, LinearLSQFitter)) or not callable(fitter):
        raise FitError(
            f"fitter = {fitter!r}; allowed are astropy's non-linear ones, such as TRFLSQFitter()"
        )
    measurement.note_inputs()
    weighting = first_weighting(measurement, weights)
    _check(measurement)
    origin, (strategy, loss) = measurement.vector(), (chosen[k] for k in ("strategy", "loss"))
    given, stages = weights if strategy == "sequential" else weighting, []
    how = measurement, given, fitter, search, options
    if strategy == "joint":
        outcome, weighting = joint(*how)
    else:
        outcomes, weighting, stages = (two_step if strategy == "two-step" else sequential)(*how)
        # the first step that did not converge makes the next ones useless
        outcome = next((o for o in outcomes if not o["converged"]), outcomes[-1]) | {"others": []}
    if loss != "linear":
        # iteratively reweighted least squares
        first, what = robust_weighting(measurement, loss), "the weights of the robust fit"
        how = fitter, lambda _: robust_weighting(measurement, loss), _ROBUST_ROUNDS, what
        outcome, weighting = until_settled(measurement, first, *how)
    if not outcome["converged"]:
        warn(f"the fit did not converge: {outcome['message']}", stacklevel=3)
    taken, whitened = _at_gauge(measurement, weighting, origin, chosen["gauge"])
    gauge = describe_gauge(chosen["gauge"], taken, measurement.free, held)
    settings = {"instrument": instrument, "fitter": type(fitter).__name__, **chosen, "gauge": gauge}
    outcome |= {"seconds": time.perf_counter() - started, "n_data": measurement.n_data}
    return FittedMeasurement(measurement, whitened, settings, outcome, stages)


def standing_at(measurement, told, lawful=(), **settings):
    """Return a measurement as fitted where it stands, by more data than its own."""
    measurement.note_inputs()
    if measurement.weighting is None:
        weighting = first_weighting(measurement, None).updated(measurement)
        around = Problem(measurement, weighting).around()
        measurement.weighting = weighting.updated(measurement, around)
    whitened = Problem(measurement, measurement.weighting).around()
    told = {"evaluations": None, "n_data": measurement.n_data, "seconds": 0.0} | told
    settings = {"instrument": None, "loss": "linear", "errors": "scatter"} | settings
    return FittedMeasurement(measurement, whitened, settings, told, [], lawful)


def _fixed(chain, fix):
    """Return copies of the chains with parameters held, and the names of these."""
    single = isinstance(chain, Model)
    copies = [item.copy() for item in ([chain] if single else chain)]
    held = {}
    for name, value in fix.items():
        try:
            label = "" if value is None else f"{name} = {value}"
            found = parameters_named(copies, str(name), label)
        except (ChainError, ParameterError) as error:
            raise FitError(f"fix: {error}") from None
        held |= found
        for parameter in (each for parameters in found.values() for each in parameters):
            if value is not None:
                # every dataset's chain has its own Parameter object of the name
                number, shape = to_unit(value, parameter.unit, name), np.shape(parameter.value)
                if number.shape not in ((), shape):
                    words = f" or {shape[0]}, one per wavelength" if shape else ""
                    raise FitError(f"fix: {name} = {value}; allowed is one value{words}")
                parameter.value = np.broadcast_to(number, shape).copy()
            parameter.fixed = True
    return copies[0] if single else copies, list(held)


def _check(measurement):
    refuse_repeated([dataset.observations for dataset in measurement.datasets])
    measurement.free.check_priors()
    if not measurement.free.size:
        raise FitError("nothing to fit: every parameter is fixed or tied")
    if measurement.free.size > measurement.n_data:
        raise FitError(
            f"{measurement.free.size} free parameters but only {measurement.n_data} data; "
            "fix some, or add frames"
        )
    for name in outside_bounds(measurement):
        free, i = measurement.free, measurement.free.names.index(name)
        unit, factor = free.by_name[name.partition("[")[0]].unit or "", free.factors()[i]
        value, low, high = (x[i] / factor for x in (measurement.vector(), *free.bounds()))
        # fitters tell neither name nor value
        allowed = f"{low:.7g} to {high:.7g} {unit}".strip()
        raise FitError(f"{name} starts at {value:.7g}; allowed are {allowed}")
    measurement.check_start()
    # fitters refuse a start that is outside by a rounding error, too
    measurement.stand_at(np.clip(measurement.vector(), *measurement.free.bounds()))
    _check_derivatives(measurement)


def _check_derivatives(measurement):
    """Hold derivatives of optics from elsewhere against differences: all errors stand on them."""
    found = (leaf for chain in measurement.chains for leaf in leaves(chain))
    foreign = {leaf.name for leaf in found if type(leaf).__module__.partition(".")[0] != _OWN}
    free, (low, high) = measurement.free, measurement.free.bounds()
    for slot in (s for s in free.slots if s.name.partition(".")[0] in foreign):
        step, vector = np.zeros(free.size), measurement.vector()
        step[slot.slice] = _DIFFERENCE * free.steps[slot.slice]
        # beyond a bound there may be no matrix, and at it no derivative
        room = np.minimum(_INSIDE * step, (high - low) / 2)
        vector = np.clip(vector, low + room, high - room)
        change = (measurement.predict(vector + step) - measurement.predict(vector - step)) / 2
        told = step @ measurement.jacobian(vector)
        worst = int(np.argmax(np.abs(change - told)))
        largest = max(np.abs(change).max(), np.abs(told).max())
        if not abs(change[worst] - told[worst]) <= _DIFFERS * largest + _SILENT:
            raise FitError(
                f"{slot.name}: the derivative that the optic gives is not that of its matrix: "
                f"data change by up to {change[worst]:.4g} a step, not {told[worst]:.4g}"
            )


# ---- choice of a gauge: one of the solutions that the data cannot tell apart ----


_ROUNDS = 6
# a gauge is reached when the leading parameters would move by less (deg, um, percent)
_SETTLED = 1e-4
# longest step along an open direction, in the same units: the surface of solutions is curved
_LONGEST = 2.0
# the solution is left alone if a move spoils it by more than this share
_SPOILT = 1e-3
# what changes the data by less than this (for a degree, micrometre, percent) changes none
_SILENT = 1e-12
# a datum whose fit leaves less than this of what it departs says nothing but of itself
_ALONE = 1e-6
# the noise of the sums, which is in the errors, moves no parameter by many more errors than this
_LITTLE = 1.0
# a fit is at odds with a prior that is so many of its standard deviations away
_FAR = 4.0


def _at_gauge(measurement, weighting, origin, gauge):
    """Choose the gauge where there is a choice; return what is open, and the linear problem.

    The measurement keeps the noise that its residuals show there.
    """
    hold_silent(measurement, origin)
    problem = BinProblem(measurement, weighting)
    whitened = settled(problem, origin) if gauge == "minimal" else problem.around()
    beside = problem.beside_extrema(measurement.vector(), whitened)
    if beside is not None:
        measurement.stand_at(beside)
        whitened = problem.around(beside)
    chosen = open_parameters(measurement.free, whitened)
    if len(whitened.data.null):
        hold_silent(measurement, origin)
    measurement.weighting = weighting.updated(measurement, whitened)
    if measurement.weighting.choice == "wavelength":
        whitened = Problem(measurement, measurement.weighting).around()
    return chosen, whitened


def settled(problem, origin):
    """Move a solution along the directions that neither data nor priors see, to the minimal gauge.

    ``origin`` is where the fit started. Returns the linear problem around the new solution.
    """
    measurement = problem.measurement
    free, vector = measurement.free, measurement.vector()
    scale, (low, high) = free.steps, free.bounds()
    # the elements whose moves are to be small: those common to all wavelengths
    leaders = [slot.start for slot in free.slots if not slot.per_wavelength]
    leaders = np.array(leaders or range(free.size), dtype=int)
    whitened = problem.around(vector)
    for _ in range(_ROUNDS):
        null = whitened.together.null
        if not len(null):
            break
        # least squares of what the leaders are away from home, over shifts along the null
        # directions, which turn as one moves: in steps with a new null space each
        away = ((vector - origin) / scale)[leaders]
        step = np.linalg.lstsq(null[:, leaders].T, -away, rcond=1e-6)[0] @ null
        step *= min(1.0, _LONGEST / max(np.abs(step).max(), 1e-300))
        if np.abs(step[leaders]).max() < _SETTLED:
            break
        # a straight step leaves the curved surface of equal fits; the bins find back to it
        trial = np.clip(vector + step * scale, low, high)
        trial, _ = problem.polish(trial, iterations=8, still_gaining=1 - 1e-12)
        before, after = (0.5 * np.sum(problem.residuals(x) ** 2) for x in (vector, trial))
        # noise-free data are fitted to rounding: there, a share of nothing is nothing
        if after > (1 + _SPOILT) * before + 1e-12 * measurement.n_data:
            break
        vector, whitened = trial, problem.around(trial)
    measurement.stand_at(vector)
    return whitened


def open_parameters(free, whitened):
    """Return the parameters common to all wavelengths that data and priors do not determine."""
    known = whitened.together.determined
    moving = [slot for slot in free.slots if not known[slot.slice].all()]
    return [s.name for s in moving if not s.per_wavelength] or [s.name for s in moving]


def hold_silent(measurement, origin):
    """Put back to the start what ended elsewhere although it changes no datum."""
    vector, scale = measurement.vector(), measurement.free.steps
    slopes = np.abs(measurement.jacobian(vector)).max(axis=1, initial=0.0) * scale
    still = (slopes < _SILENT) & (vector != origin)
    for slot, prior in measurement.free.priors:
        # a prior that is not flat has put it where it belongs
        still[slot.slice] &= prior.is_flat
    predicted = measurement.predict(vector)
    for i in np.flatnonzero(still):
        trial = vector.copy()
        trial[i] = origin[i]
        if np.abs(measurement.predict(trial) - predicted).max() < _SILENT:
            vector = trial
    if still.any():
        measurement.stand_at(vector)


def describe_gauge(gauge, chosen, free, held):
    """Say which of the equivalent solutions a calibration reports, and why.

    ``chosen`` are parameters that the data do not determine, ``held`` those that the user holds.
    """
    parts = [f"held: {', '.join(held)}"] if held else []
    if free.priors:
        parts.append(f"prior on {', '.join(slot.name for slot, _ in free.priors)}")
    if not chosen:
        known = "data and priors determine" if free.priors else "the data determine"
        parts.append(f"{known} every free parameter")
    elif gauge is None:
        parts.append(f"none for {', '.join(chosen)}: where the fit ended, an accident of its start")
    else:
        parts.append(f"minimal: of all equal fits, the least change of {', '.join(chosen)}")
    return "; ".join(parts)


# ---- the result ------------------------------------------------------------------


def _result(fitted, covariance=None):
    """Return the calibration; ``covariance`` is that of more data than its own."""
    measurement, whitened, settings = fitted.measurement, fitted.whitened, fitted.settings
    vector, weighting, fit = measurement.vector(), measurement.weighting, dict(fitted.fit)
    names, residuals = measurement.free.names, measurement.residuals(vector)
    view = view_of_measurement(measurement, vector, settings["instrument"])
    finding = complete(measurement, whitened, weighting.level, view)
    if covariance is not None and not measurement.free.priors:
        # by the data of all runs, too
        finding.identifiable |= np.isfinite(covariance.stds)
    white = settings["errors"] == "white"
    scatter = None if white else Scatter.of(measurement, weighting, whitened)
    own = covariance_around(measurement, whitened, weighting, scatter)
    if covariance is None and np.isfinite(weighting.level):
        own, curved = _along_valleys(measurement, whitened, own, view)
        finding.near_null += curved
    if covariance is None:
        found = fit["disagreements"] = disagreements(measurement, whitened, weighting, scatter)
        own = between_datasets(own, found)
        own, fit["lamp_moves"] = _beside_lamp(measurement, whitened, own, white)
    told = own.stds * measurement.free.factors(), fit.pop("others", ()), fitted.lawful
    signs, errors_of_signs, fit["elsewhere"] = undecided_signs(measurement, view, *told)
    fit["minima"] = [one.pop("minimum") for one in signs if "minimum" in one]
    finding.branches += signs
    finding.mirrors = [branch["words"] for branch in finding.branches]
    # the error of the model at a new setting
    lacking = None if white else model_error(measurement, scatter, errors_of_signs)
    calibration = Calibration(
        chains=measurement.put_back(vector),
        wavelength=(measurement.wavelength * u.um).to(u.nm),
        covariance=own if covariance is None else covariance,
        identifiability=finding,
        at_bound=[names[i] for i in np.flatnonzero(whitened.held)],
        datasets=[_record(measurement, i, residuals) for i in range(len(measurement.datasets))],
        settings=settings
        | {
            "observable": measurement.observable.name,
            "weights": weighting.choice,
            "noise": describe(measurement),
        },
        fit=fit,
        ties=dict(measurement.free.ties),
        stages=fitted.stages,
        measurement=measurement,
        provenance=provenance()
        | {"scipy": installed("scipy"), "python": platform.python_version()},
    )
    fit["masked"] = [dict(each.observations.mask_reasons) for each in measurement.datasets]
    fit["bounds"] = errors_at_bounds(measurement, whitened, scatter)
    fit["lack_of_fit"] = _lack_of_fit(calibration, whitened)
    # the pairs of frames at odds with the fit, for summary, JSON and file
    outlying = outlying_data(calibration)
    if covariance is None:
        fit["off_minimum"] = _moved(measurement, whitened, own)
        if len(outlying) and settings["loss"] == "linear":
            fit["outliers_move"] = _moved(measurement, whitened, own, outlying.meta["data"])
    fit["against_prior"] = _against_prior(measurement, whitened, calibration.covariance)
    outliers = columns(outlying)
    rows = zip(*outliers.values(), strict=True)
    fit["outliers"] = [dict(zip(outliers, row, strict=True)) for row in rows]
    fit["model_error"] = lacking
    return keep_sky_accuracy(calibration, view)


def _along_valleys(measurement, whitened, covariance, view):
    """Return the covariance with errors from how far chi-square stays low, and words on them."""
    free, factors = measurement.free, measurement.free.factors()
    stds = covariance.stds * factors
    found = bent_valleys(measurement, whitened, stds)
    wide = covariance.widened([(i, way / factors, more / factors) for i, way, more, _ in found])
    sky_of = partial(consequences_along, view)
    return wide, curved_directions(free, measurement.vector(), found, stds, sky_of)


def _against_prior(measurement, whitened, covariance):
    """Return the parameter farthest from its prior, by ``sigma``, if that is far.

    And which one of other optics such priors move most, as `_moved`: with them or without, one of
    the two is wrong.
    """
    free = measurement.free
    off = np.abs(free.prior_residuals(measurement.vector()))
    far = np.flatnonzero(off > _FAR)
    if not far.size:
        return None
    told = (np.arange(free.size)[slot.slice] for slot, prior in free.priors if not prior.is_flat)
    names, own = [name.partition("[")[0] for name in free.names], np.concatenate([*told])
    optics = {names[i].partition(".")[0] for i in own[far]}
    others = np.array([name.partition(".")[0] not in optics for name in names])
    moved = _moved(measurement, whitened, covariance, measurement.n_data + far, others)
    worst = int(np.argmax(off))
    return {"parameter": names[own[worst]], "sigma": float(off[worst]), "moves": moved}


def _beside_lamp(measurement, whitened, covariance, white):
    """Return a covariance that knows of the lamp, and which parameter this moves most.

    Where a lamp changes between the frames of a difference, the model has both equally bright.
    Errors of independent data stay as they are published.
    """
    problem, vector = Problem(measurement, measurement.weighting), measurement.vector()
    rows, priors = problem.jacobian(vector) * whitened.scale, np.zeros(measurement.n_priors)
    lamp = measurement.of_lamp(vector, covariance.stds * measurement.free.factors())
    pull = np.concatenate([lamp * problem.weights, priors])
    step, moved = _moved_by(whitened, rows, pull, covariance, measurement)
    moved["counts"] = moved["errors"] > _LITTLE
    if moved["counts"] and not white:
        covariance = covariance.beside(np.where(covariance.stds > 0, step, 0.0)[None])
    return covariance, moved


def _moved_by(whitened, rows, pull, covariance, measurement, among=True):
    """Return a step of Newton's, and by how many errors it moves which parameter most."""
    free, factor = measurement.free, whitened.factor()
    step = factor.T @ (factor @ (rows.T @ pull)) * whitened.scale / free.factors()
    # of data without noise residuals are rounding
    known = (covariance.stds > 0) & (rms(measurement.residuals()) > ROUNDED) & among
    times = np.divide(np.abs(step), covariance.stds, out=np.zeros(free.size), where=known)
    worst = int(np.argmax(times))
    return step, {"parameter": free.names[worst], "errors": float(times[worst])}


def _moved(measurement, whitened, covariance, data=None, among=True):
    """Return which parameter residuals move most, by how many errors; at the minimum none does.

    Of some data: by how much it would move without them (Cook 1977, Technometrics 19, 15). Priors
    count as data after all others.
    """
    problem, vector = Problem(measurement, measurement.weighting), measurement.vector()
    rows, pull = problem.jacobian(vector) * whitened.scale, problem.residuals(vector)
    if data is not None:
        rows, pull = rows[data], pull[data]
        # how far each of them draws the fit to itself
        drawn = rows @ whitened.factor().T
        pull = np.linalg.lstsq(np.eye(len(data)) - drawn @ drawn.T, pull, rcond=_ALONE)[0]
    return _moved_by(whitened, rows, pull, covariance, measurement, among)[1]


def _lack_of_fit(calibration, whitened):
    """Hold the residuals against the noise given, stated in the table, and shown by the frames."""
    measurement, found = calibration.measurement, []
    # as the table states it first
    noises = [*known_noises(measurement)][::-1]
    weighting, settings = measurement.weighting, calibration.settings
    if (weighting.choice, settings["loss"], settings["errors"]) == (GIVEN, "linear", "white"):
        # all errors stand on it alone
        noises.insert(0, noise_as_given(measurement, weighting.sigma))
    for noise in noises:
        test = lack_of_fit(measurement, calibration, noise, whitened=whitened)
        # unknown where no degree of freedom is left
        ratio = test.chi2 / test.expected if test.expected > 0 else np.nan
        found.append(
            {
                "noise": noise.method,
                "noise_percent": 100 * rms(noise.sigma_of_data),
                "times_noise": float(np.sqrt(ratio)),
                "p_value": float(test.p_value),
                "words": test.words,
            }
        )
    return found


def _record(measurement, i, residuals):
    observations = measurement.datasets[i].observations
    keys = ("name", "source", "content_hash", "n_frames")
    return DatasetRecord(
        **{key: getattr(observations, key) for key in keys},
        meta=dict(observations.meta),
        n_masked=int(observations.mask.sum()),
        accuracy=accuracy_table(measurement, i, residuals),
    )
