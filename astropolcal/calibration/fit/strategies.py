# Licensed under a 3-clause BSD style license - see LICENSE
"""
Fits in place: the way to the minimum, and fits in steps.

Steps, each of which holds what the steps before have found. Two-step: the polarized internal source
as in McIntosh et al. (2026, Sec. 5.2). Sequential: one dataset after another, as the paper goes
from the polarized source to the unpolarized one and to the star.
"""

import warnings
from functools import partial

import astropy.units as u
import numpy as np
from astropy.modeling.fitting import TRFLSQFitter
from astropy.utils.exceptions import AstropyWarning

from astropolcal.calibration.fit.branches import (
    CLEARLY_BETTER,
    COARSE,
    FAR_WORSE,
    GAIN,
    GLANCE,
    ROUNDED,
    BinProblem,
    beside_centres,
    best_signs,
    centres,
    least_bent,
    mirrored,
    other_axes,
    other_laws,
    other_signs,
    search_branches,
)
from astropolcal.calibration.noise.estimates import (
    noise_from_errors,
    noise_from_null_channel,
    noise_from_roughness,
    rms,
)
from astropolcal.calibration.noise.scatter import kind_of_source
from astropolcal.calibration.noise.weighting import (
    ROUNDS,
    Problem,
    Weighting,
    first_weighting,
    noise_of,
)
from astropolcal.chain import join, leaves
from astropolcal.exceptions import AstropolcalError, FitError
from astropolcal.files import one_line
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.measurement.parameters import are_outside, ties_among
from astropolcal.progress import stage

__all__ = []

# equal but for rounding
_SAME = 1e-9
_MAX_EVALUATIONS, _ON_THE_WAY = 500, 20
_MAX_ROUNDS = 4
# residuals this many times the noise may be those of a wrong minimum: so many others are tried, and
# one counts that leaves less than this share
_STANDS_OUT, _STARTS, _BETTER = 1.3, 4, 0.9
# so may fewer, of all data or a wavelength, beyond so many times what chi-square scatters by
_BY_CHANCE = 5, 6
# nor is one tried that leaves so many times as much before everything is fitted
_HOPELESS = 100.0
# of so many signs not all combinations are tried; sums of squares of the same minimum, over that
# of the best
_MANY_SIGNS, _SAME_MINIMUM = 8, 1.001
# more data than these are fitted without astropy's fitter
_TALL = 20_000
# below this the sign of the start is as good
_AS_GOOD = 2.0
# branches are searched in so many groups of frames of a dataset, if it has several times as many
_FEW, _LONG = 256, 4
# a wavelength in the branch of its neighbours may have up to so many times the sum of squares
_WORTH = 3.0


# ---- fits in place --------------------------------------------------------------


def run(measurement, weighting, fitter):
    """Fit in place until the noise agrees with the residuals; return how it went, and the noise."""
    # one level for all data does not move the minimum, unless priors weigh against them
    told = weighting.choice == "wavelength" or (weighting.from_residuals and measurement.n_priors)
    if not told:
        return fit_once(measurement, weighting, fitter), weighting
    if not weighting.is_known:
        weighting = weighting.started(measurement)

    def updated(weighting):
        found = weighting.updated(measurement)
        if not np.isfinite(found.sigma).all():
            raise FitError(
                f"{measurement.free.size} free parameters and {measurement.n_data} data leave none "
                "for the noise, against which priors weigh; fix some, add frames, or take "
                "weights='errors'"
            )
        return found

    what = "the noise from the residuals"
    return until_settled(measurement, weighting, fitter, updated, ROUNDS, what)


def until_settled(measurement, weighting, fitter, updated, rounds, what):
    """Fit in place, with a noise that comes from the fit before, until it stays as it is."""
    # weights from the residuals of a fit that has these weights: a fixed point, on the way to which
    # no fit need be carried to the end
    is_last = False
    for left in reversed(range(rounds)):
        is_last |= 2 * left < rounds
        outcome = fit_once(measurement, weighting, fitter, None if is_last else _ON_THE_WAY)
        before, weighting = weighting, updated(weighting)
        if weighting.agrees(before):
            if outcome["converged"] or is_last:
                return outcome, weighting
            is_last = True
    message = f"{what} did not settle in {rounds} fits"
    return outcome | {"converged": False, "message": message}, weighting


def fit_once(measurement, weighting, fitter, most=None):
    """Fit in place; return whether it arrived, what it said, and after how many evaluations."""
    stage(f"fitting {measurement.free.size} parameters")
    if type(fitter) is TRFLSQFitter and measurement.n_data > _TALL:
        # the same steps by triangular factors, for which the fitter has no place
        vector, _, found = Problem(measurement, weighting).fit(measurement.vector())
        measurement.stand_at(vector)
        return {"converged": found.success, "message": found.message, "evaluations": found.nfev}
    index, observed, weights = measurement.fit_arguments(weighting.weight, weighting.level)
    canonical = measurement.canonical()
    how = {"weights": weights, "maxiter": most or _MAX_EVALUATIONS, "inplace": True}
    with warnings.catch_warnings(record=True) as caught:
        # recorded, not shown: whether the fit arrived is told once, in the words of this package
        warnings.simplefilter("always", AstropyWarning)
        try:
            fitter(canonical, index, observed, **how)
        except (ValueError, RuntimeError, np.linalg.LinAlgError) as error:
            said = one_line(str(error))
            raise FitError(f"{type(fitter).__name__} failed: {said}") from error
    measurement.stand_at(canonical.vector())
    info = fitter.fit_info if hasattr(fitter, "fit_info") and fitter.fit_info else {}
    said = [str(w.message) for w in caught if "unsuccessful" in str(w.message)]
    outside = outside_bounds(measurement)
    if outside:
        said.append(f"{type(fitter).__name__} left the bounds of {', '.join(outside)}")
    evaluations = info.get("nfev")
    return {
        "converged": not said,
        "message": said[-1] if said else str(info.get("message", "")).strip(),
        "evaluations": None if evaluations is None else int(evaluations),
    }


def outside_bounds(measurement):
    """Return the names of parameters that a fitter without bounds left outside of theirs."""
    # a fitter that minds the bounds ends on them only as exactly as rounding allows
    outside = are_outside(measurement.vector(), *measurement.free.bounds())
    return [measurement.free.names[i] for i in np.flatnonzero(outside)]


def joint(measurement, weighting, fitter, search, options=None):
    """Fit everything; again from other axes, signs and, where residuals stand out, laws.

    With ``options`` of the measurement what only stars see is fitted by itself first. How it went
    has the other minima that were seen, ``others``.
    """
    origin = measurement.vector()
    how = fitter, search, options, origin
    best = _descend(measurement, weighting, *how)
    if not search:
        return best
    found, problem = measurement.vector(), BinProblem(*few_frames(measurement, weighting))
    least = np.sum(problem.residuals(found) ** 2)
    starts = [(start, CLEARLY_BETTER) for start in other_axes(problem, found, origin)]
    if stands_out(measurement):
        laws = other_laws(problem, found, origin)[:_STARTS]
        starts += [(start, _BETTER) for told, start in laws if told <= _HOPELESS * least]
    best = _from_others(measurement, weighting, best, problem, starts, how)
    best, others = _behind_mirrors(measurement, best, how)
    problem = BinProblem(*few_frames(measurement, best[1]))
    signs = [(start, CLEARLY_BETTER) for start in other_signs(problem, measurement.vector())]
    outcome, weighting = _from_others(measurement, best[1], best, problem, signs, how)
    return outcome | {"others": others}, weighting


def _from_others(measurement, weighting, best, problem, starts, how):
    """Fit again from starts that lead to less than a share of the sum of squares, one for each."""
    found = measurement.vector()
    least = np.sum(problem.residuals(found) ** 2)
    for start, better in starts:
        # most starts lead to the minimum that is known, or crawl towards one that is no better:
        # a few steps of everything tell
        start = problem.fit(start, evaluations=GLANCE, gain=GAIN)[0]
        known = problem.costs(found)
        if np.allclose(problem.costs(start), known, rtol=1 - CLEARLY_BETTER, atol=0):
            # of no wavelength it is clearly better or worse: it is the minimum that is known
            continue
        start, moved = search_branches(problem, start, how[-1])
        if moved.any():
            start = problem.fit(start, evaluations=GLANCE, gain=GAIN)[0]
        if np.sum(problem.residuals(start) ** 2) >= better * least:
            continue
        measurement.stand_at(start)
        outcome = _descend(measurement, weighting, *how, is_searched=True)
        left = np.sum(problem.residuals(measurement.vector()) ** 2)
        if left < better * least:
            best, found, least = outcome, measurement.vector(), left
            if not stands_out(measurement):
                break
    measurement.stand_at(found)
    return best


def _behind_mirrors(measurement, best, how):
    """Fit again from where axes and phases lie on the other sides of what priors hold them near.

    Returns with it where all such fits ended.
    """
    problem, others = BinProblem(*few_frames(measurement, best[1])), []
    axes, phases = centres(problem)
    if not axes or not phases or len(axes) + len(phases) > _MANY_SIGNS:
        return best, others
    found = measurement.vector()
    starts, least = mirrored(found, axes), np.sum(problem.residuals(found) ** 2)
    first, worth, is_last = least, 2 * problem.noise**2, False
    while starts:
        start = starts.pop(0)
        # where a fit leads, wavelengths may have other signs again
        for _ in range(2):
            # along the valleys of such data a fit creeps: given up early, it ends above the minimum
            start, left, _ = problem.fit(best_signs(problem, start, phases))
            others.append(start)
            if not _SAME_MINIMUM < left / least < FAR_WORSE:
                break
        if left < least - worth:
            found, least, starts = start, left, mirrored(start, axes)
            measurement.stand_at(found)
        if not (starts or is_last) and stands_out(measurement):
            starts, is_last = beside_centres(found, axes), True
    if least < first:
        best = _descend(measurement, best[1], *how, is_searched=True)
    return best, others


def known_noises(measurement):
    """Yield the noise that single frames show, and that which the table states, if they do."""
    # of few wavelengths the noise is that of the null channel
    smooth = partial(noise_from_null_channel, null_model="smooth")
    for methods in ((noise_from_roughness, smooth), (noise_from_errors,)):
        for method in methods:
            try:
                yield method(measurement)
                break
            except AstropolcalError:
                continue  # few wavelengths, or no errors in the table


def stands_out(measurement):
    """Whether residuals, of all data or a wavelength, are clearly above the noise of the frames."""
    known = [*known_noises(measurement)]
    if not known:
        return False
    # a wrong minimum predicts a wrong null channel, so that this noise is too large as well
    noise = known[-1 if known[0].method == "null channel" else 0]
    squares = (measurement.residuals() / np.maximum(noise.sigma_of_data, ROUNDED)) ** 2
    sizes, n = np.bincount(measurement.bins), squares.size
    freedom = max(n - measurement.free.size, n / 2)
    least = min(n * _STANDS_OUT**2, freedom + _BY_CHANCE[0] * np.sqrt(2 * freedom))
    limit = np.maximum(sizes * _STANDS_OUT**2, sizes + _BY_CHANCE[1] * np.sqrt(2 * sizes))
    beyond = np.bincount(measurement.bins, squares) > limit
    return bool(np.sum(squares) > least or beyond.any())


def _descend(measurement, weighting, fitter, search, options, origin, is_searched=False):
    """Fit everything; go on as long as some bin finds a better mirror branch."""
    small, noise = few_frames(measurement, weighting)
    if search and not is_searched:
        stage("looking for where to start")
        problem = BinProblem(small, noise)
        found = search_branches(problem, origin)[0]
        small.stand_at(found)
        # where no noise is known yet, the first search is one without the priors
        if problem.priors and not noise.is_known:
            problem = BinProblem(small, noise.started(small))
            small.stand_at(search_branches(problem, origin)[0])
    alone = options and telescope_alone(small, options)
    if alone:
        # the law of a telescope's mirror is nearly degenerate: cheap steps with the rest held
        run(alone, first_weighting(alone, None), fitter)
        _copy_fitted(alone, small)
    # branches are found on few frames, so the long table starts from their fit
    if small is not measurement:
        run(small, noise, fitter)
        measurement.stand_at(small.vector())
    for left in reversed(range(_MAX_ROUNDS)):
        outcome, weighting = run(measurement, weighting, fitter)
        # the last word belongs to the fit of all parameters, not to a search by bin
        if not search or not left:
            break
        small, noise = few_frames(measurement, weighting)
        better, moved = search_branches(BinProblem(small, noise), small.vector(), origin)
        if not moved.any():
            break
        measurement.stand_at(better)
    how = fitter, outcome, origin
    return _smoothed(measurement, weighting, *how) if search else (outcome, weighting)


def _smoothed(measurement, weighting, fitter, outcome, origin):
    """Fit again with wavelengths in the branches that make their phases smooth, if nearly as good.

    Where a half-wave plate has half a wave, both signs of all other retardances fit nearly equally
    well, and without circular polarization both signs of all together fit exactly so. Any error of
    the model then decides between them; the other wavelengths tell which is true. Where these say
    nothing, and the data hardly anything, the start does.
    """
    problem, found = BinProblem(*few_frames(measurement, weighting)), measurement.vector()
    if not problem.main_retardances():
        return outcome, weighting
    branches = problem.branches(found)
    # most often nothing would be smoother, even if all branches fitted alike
    if not least_bent(problem, branches, np.ones((len(branches), problem.n_bins)), origin).any():
        measurement.stand_at(problem.in_line([found] * problem.n_bins, origin))
        return outcome, weighting
    before = problem.costs(found)
    for k, branch in enumerate(branches):
        if not np.allclose(problem.costs(branch), before, rtol=_SAME, atol=0):
            branches[k] = problem.polish(branch)[0]
    # of data without noise residuals are rounding
    rounding = 0.5 * np.sum((ROUNDED * problem.weights[problem._data] * problem._present) ** 2, 1)
    costs = np.array([problem.costs(branch) for branch in branches]) + rounding
    # of a bin without data, which a prior may still tell to rounding, all are the same
    ratio = np.ones(costs.shape)
    np.divide(costs, costs[0], out=ratio, where=rounding > 0)
    equal = np.abs(ratio - 1) < _SAME
    # beside few wavelengths only what is as good
    good = np.exp(_AS_GOOD / problem._present.sum(axis=1).clip(1))
    told = ratio < (FAR_WORSE if problem.n_bins > COARSE else good)
    for allowed in (told | equal, equal):
        chosen = least_bent(problem, branches, np.where(allowed, ratio, np.inf), origin)
        measurement.stand_at(problem.in_line(np.array(branches)[chosen], origin))
        moved = ~equal[chosen, np.arange(problem.n_bins)]
        if not moved.any():
            break
        again = run(measurement, weighting, fitter)
        if np.all(problem.costs(measurement.vector())[moved] < (_WORTH * costs[0])[moved]):
            return again
    return outcome, weighting


def few_frames(measurement, weighting):
    """Return a few hundred frames of each dataset, and their noise; short tables as they are."""
    if max(d.frames.shape[0] for d in measurement.datasets) <= _LONG * _FEW:
        return measurement, weighting
    small, kept = measurement.thinned(_FEW)
    return small, Weighting(weighting.choice, weighting.sigma[kept])


# ---- calibrations in steps, each of which holds what the steps before have found ----


_ORDER = ("polarized", "unpolarized", "star")


def two_step(measurement, weighting, fitter, search, options):
    """Fit per wavelength with misalignments held, then global, then per wavelength again.

    Returns how the steps went, the noise, and the values after each step.
    """
    sources = [dataset.observations.source for dataset in measurement.datasets]
    if "polarized" not in map(kind_of_source, sources):
        raise FitError(
            "strategy 'two-step' is for a polarized source, but the source is "
            f"{', '.join(sorted(set(map(repr, sources))))}; allowed here are 'joint' and "
            "'sequential'"
        )
    single = {slot.name for slot in measurement.free.slots if not slot.per_wavelength}
    several = {slot.name for slot in measurement.free.slots if slot.per_wavelength}
    grid = measurement.wavelength * u.um
    # in the first step each wavelength has its own retardance, also of a plate that follows a law
    loose = [join(leaf.loosened(grid) for leaf in leaves(c)) for c in measurement.put_back()]
    outcomes, stages = [], []
    for title, held in (
        ("per wavelength, misalignments held", single),
        ("global", several),
        ("per wavelength, global parameters held", single),
    ):
        chains = measurement.put_back() if stages else loose
        step = _step_of(measurement, chains, held, options)
        if step.free.size:
            # what the first step has found needs no search
            outcome, weighting = joint(step, weighting, fitter, search and not outcomes)
            outcomes.append(outcome)
        stages.append(_taken(title, step, measurement))
    return outcomes, weighting, stages


def sequential(measurement, weights, fitter, search, options):
    """Fit one kind of source after another and hold what was found: polarized, unpolarized, stars.

    Errors of the steps before do not enter the later ones, and later data do not improve what is
    held: that is the paper's procedure. Returns the same as `two_step`.
    """
    if weights is not None and not isinstance(weights, str):
        raise FitError(
            "strategy='sequential' fits the datasets one by one, so the noise cannot be given "
            "for all data; allowed are weights = None, 'wavelength', 'errors'"
        )
    kinds = [kind_of_source(dataset.observations.source) for dataset in measurement.datasets]
    held, outcomes, stages = set(), [], []
    for kind in (kind for kind in _ORDER if kind in kinds):
        rows = [i for i, own in enumerate(kinds) if own == kind]
        step = _step_of(measurement, measurement.put_back(), held, options, rows)
        if step.free.size:
            weighting = first_weighting(step, weights)
            outcomes.append(joint(step, weighting, fitter, search and not stages)[0])
        title = f"{kind}, what came before held" if stages else kind
        stages.append(_taken(title, step, measurement))
        # what this step has found is known for the next ones
        held |= {slot.name for slot in step.free.slots}
    return outcomes, noise_of(measurement, weights), stages


def telescope_alone(measurement, options):
    """Return the fit of what stars alone see and all wavelengths share, such as a law of M3.

    Such parameters can be nearly degenerate, so that a fit takes hundreds of steps; with all others
    held these are cheap. None where there is nothing of the kind.
    """
    seen = [kind_of_source(dataset.observations.source) for dataset in measurement.datasets]
    rows = [i for i, kind in enumerate(seen) if kind == "star"]
    if len(rows) in (0, len(seen)):
        return None
    chains = measurement.put_back()
    # what a lamp sees as well is found better with it
    lamps = parameter_table([c for c, kind in zip(chains, seen, strict=True) if kind != "star"])
    own = {s.name for s in measurement.free.slots if not s.per_wavelength} - set(lamps)
    # what has a prior is not degenerate
    if own <= {slot.name for slot, _ in measurement.free.priors}:
        return None
    held = {slot.name for slot in measurement.free.slots} - own
    return _step_of(measurement, chains, held, options, rows)


def _step_of(measurement, chains, held, options, rows=None):
    """Return the measurement of one step; what follows a held parameter is held too."""
    rows, ties = range(len(chains)) if rows is None else rows, measurement.free.ties
    copies = [chains[i].copy() for i in rows]
    table = parameter_table(copies)
    # a tie needs a source that is free in this step
    live = ties_among(ties, set(table) - held)
    for name in (held | set(ties) - set(live)) & set(table):
        for parameter in table[name]:
            parameter.fixed = True
    parts = [measurement.datasets[i].observations for i in rows]
    given = options.get("positions")
    own = {"positions": given and [given[i] for i in rows]}
    own["wavelength"] = measurement.wavelength * u.um
    return Measurement(copies, parts, ties=live, copy=False, **(options | own))


def _copy_fitted(origin, target):
    """Give the measurement ``target`` the values that ``origin`` has found, name by name."""
    vector = target.vector()
    for slot in origin.free.slots:
        known = target.free.by_name.get(slot.name)
        if known is not None and known.size == slot.size:
            vector[known.slice] = origin.vector()[slot.slice]
    target.stand_at(vector)


def _taken(title, step, measurement):
    """Take over what a step has found; return its values, with units, and its residuals."""
    _copy_fitted(step, measurement)
    step.put_back()
    values = {slot.name: step.free.values_of(slot.name) for slot in step.free.slots}
    return {"title": title, "parameters": values, "residual_rms": rms(step.residuals())}
