# Licensed under a 3-clause BSD style license - see LICENSE
"""
Starts, steps and gauges of a fit.

Starts: with the global parameters held, the bins of a calibration are independent of each other. So
all are searched at once: a coarse scan along the main retardance of each optic finds the valleys,
and a Levenberg-Marquardt step that is batched over the bins polishes the best few. The result is a
start for the joint fit, and later a check whether a bin sits in the wrong valley.

Steps, each of which holds what the steps before have found. Two-step: the polarized internal source
as in McIntosh et al. (2026, Sec. 5.2). Sequential: one dataset after another, as the paper goes
from the polarized source to the unpolarized one and to the star.

Gauge: where the data do not determine all directions, every point along them fits equally well, and
where a fit ends is an accident of its start. The *minimal* gauge takes the solution whose
parameters common to all wavelengths (the misalignments) have moved least from where they started. A
user names another gauge by holding parameters (``fix=``) or by a prior.
"""

from itertools import groupby

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.analysis import physical_scale
from astropolcal.calibration.noise.scatter import kind_of_source
from astropolcal.calibration.noise.weighting import Problem
from astropolcal.chain import join, leaves
from astropolcal.exceptions import FitError
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.progress import steps
from astropolcal.words import check_choice

__all__ = []

_SCAN_STEP = np.deg2rad(15.0)
_N_VALLEYS = 4
_CLEARLY_BETTER = 0.99
# a phase so far off its neighbours (radian) is given the other sign if that is four times as near;
# the bin may be so many times worse before all are fitted again
_STICKS_OUT, _FAR_WORSE = 1.0, 30.0
# a polish ends when no bin gains a thousandth in a step, or is about to
_STILL_GAINING = 0.999
_STUCK = 1.0
# so many other thicknesses to either side are tried; each step changes the data by so much (rms)
_LAWS, _LAW_STEP, _ROUGH = 4, 0.1, 4
# starts whose sums of squares differ by less are the same
_APART = 1.001


class BinProblem(Problem):
    """The fit of the parameters given per wavelength, all bins at once.

    As long as no noise is known against which they could weigh, priors are left out.
    """

    def __init__(self, measurement, weighting):
        super().__init__(measurement, weighting)
        self.noise = self.noise if weighting.is_known else 0.0
        self.n_bins = len(measurement.wavelength)
        # with a single bin every parameter belongs to it
        self.slots = [s for s in measurement.free.slots if s.per_wavelength or self.n_bins == 1]
        self._data, self._present = _data_of_bins(measurement, self.n_bins)
        starts = np.array([slot.start for slot in self.slots], dtype=int)
        #: Element of the flat vector of each slot and bin, (n_slots, n_bins).
        self.elements = starts[:, None] + np.arange(self.n_bins)
        self._below, self._above = self._low[self.elements], self._high[self.elements]
        rows = {slot.name: row for row, slot in enumerate(self.slots)}
        tight = [(slot, prior) for slot, prior in measurement.free.priors if not prior.is_flat]
        self._priors = [(rows[slot.name], prior) for slot, prior in tight if slot.name in rows]
        self._common = [(slot, prior) for slot, prior in tight if slot.name not in rows]

    @property
    def has_priors(self):
        """Whether priors that are not flat enter the costs of the bins."""
        return bool(self._priors)

    def of_bins(self, vector):
        """Return weighted residuals by bin, zero where a bin has fewer data."""
        # all bins at once: a prediction costs as much for one bin as for all
        residual = (self.measurement.predict(vector) - self.measurement.observed) * self.weights
        return residual[self._data] * self._present

    def costs(self, vector):
        """Return half the sum of squares of each bin, of data and priors, shape (n_bins,)."""
        costs = 0.5 * np.sum(self.of_bins(vector) ** 2, axis=1)
        for row, prior in self._priors:
            costs += 0.5 * (self.noise * prior.residual(vector[self.elements[row]])) ** 2
        return costs

    def total(self, vector):
        """Return half the sum of squares of all data and priors."""
        common = [prior.residual(vector[slot.slice]) for slot, prior in self._common]
        return self.costs(vector).sum() + 0.5 * self.noise**2 * sum(np.sum(r**2) for r in common)

    def _normal_equations(self, vector):
        jacobian = self.measurement.jacobian(vector) * self.weights
        # (n_bins, n_slots, n_data_of_a_bin): in other bins these parameters change nothing
        blocks = jacobian[self.elements.T[:, :, None], self._data[:, None, :]]
        blocks *= self._present[:, None, :]
        residual = self.of_bins(vector)
        normal = blocks @ np.swapaxes(blocks, 1, 2)
        gradient = np.einsum("bsd,bd->bs", blocks, residual)
        for row, prior in self._priors:
            value = vector[self.elements[row]]
            slope = self.noise * prior.slope(value)
            normal[:, row, row] += slope**2
            gradient[:, row] += slope * self.noise * prior.residual(value)
        return normal, gradient

    def polish(self, vector, iterations=12, still_gaining=_STILL_GAINING):
        """Improve the per-wavelength parameters by batched Levenberg-Marquardt.

        Returns the vector, where no bin is worse than at the start, and the cost of each bin. It
        ends when no bin falls below the share ``still_gaining`` of its cost in a step.
        """
        vector = vector.copy()
        if not self.slots:
            return vector, self.costs(vector)
        costs, damping = self.costs(vector), np.full(self.n_bins, 1e-3)
        for _ in range(iterations):
            trial = vector.copy()
            trial[self.elements] = self._step(vector, damping)
            new = self.costs(trial)
            # each bin has its own damping, and takes or leaves its own step
            better = new < costs
            gaining = new < still_gaining * costs
            vector[self.elements[:, better]] = trial[self.elements[:, better]]
            costs = np.where(better, new, costs)
            damping = np.where(better, damping / 5, damping * 8)
            if not np.any(gaining | (~better & (damping < _STUCK))):
                break
        return vector, costs

    def _step(self, vector, damping):
        normal, gradient = self._normal_equations(vector)
        here = vector[self.elements]
        held = (
            ((here <= self._below) & (gradient.T > 0)) | ((here >= self._above) & (gradient.T < 0))
        ).T
        # a parameter that leans against its bound must not slow down the others
        normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal)
        gradient = np.where(held, 0.0, gradient)
        size = normal.shape[-1]
        diagonal = np.einsum("bss->bs", normal)
        # relative to the diagonal (Marquardt), plus a little for what changes nothing
        ridge = damping[:, None] * diagonal + 1e-12 * (1 + diagonal.max(axis=1, keepdims=True))
        step = np.linalg.solve(normal + ridge[:, :, None] * np.eye(size), gradient[..., None])
        return np.clip(here - step[..., 0].T, self._below, self._above)

    def main_retardances(self):
        """Return the first slot of each optic that can make half a turn or more."""
        seen, found = set(), []
        for row, slot in enumerate(self.slots):
            optic, key = slot.name.split(".")
            low, high = slot.canonical_bounds()
            # only a phase that may go round has mirror branches; an
            # orientation is within its bounds
            is_phase = key != "theta" and slot.unit is not None and slot.unit.is_equivalent(u.rad)
            if is_phase and high - low > np.pi and optic not in seen:
                seen.add(optic)
                found.append((row, max(low, -2 * np.pi), min(high, 2 * np.pi)))
        return found

    def valleys(self, vector, row, low, high):
        """Return the best values of one slot from a scan over its bounds, (n_valleys, n_bins)."""
        grid = np.arange(low, high + _SCAN_STEP / 2, _SCAN_STEP).clip(low, high)
        trial = vector.copy()
        costs = np.empty((grid.size, self.n_bins))
        for i, value in enumerate(grid):
            trial[self.elements[row]] = value
            costs[i] = self.costs(trial)
        padded = np.pad(costs, ((1, 1), (0, 0)), constant_values=np.inf)
        # local minima of the scan; the ends count, as valleys may open beyond a bound
        valley = (costs <= padded[:-2]) & (costs <= padded[2:])
        order = np.argsort(np.where(valley, costs, np.inf), axis=0)[:_N_VALLEYS]
        return grid[order]


def search_branches(problem, vector, origin=None):
    """Return a start in which every bin sits in its best valley, and which bins moved there.

    A bin keeps its own valley unless another is clearly (1 %) better. Scans begin at the
    per-wavelength parameters of ``origin``, by default at ``vector``.
    """
    if not problem.slots:
        return vector, np.zeros(problem.n_bins, dtype=bool)
    # in the wrong valley a bin drives its other parameters astray: scan from the origin
    start = vector.copy()
    if origin is not None:
        start[problem.elements] = origin[problem.elements]
    best, costs = problem.polish(vector)
    moved = np.zeros(problem.n_bins, dtype=bool)
    retardances = problem.main_retardances()
    for row, low, high in steps(retardances, "retardances"):
        # one that was scanned before may have moved
        for base in (start, best.copy()) if len(retardances) > 1 else (start,):
            for values in problem.valleys(base, row, low, high):
                trial = base.copy()
                trial[problem.elements[row]] = values
                trial, new = problem.polish(trial)
                better = new < _CLEARLY_BETTER * costs
                best[problem.elements[:, better]] = trial[problem.elements[:, better]]
                costs = np.where(better, new, costs)
                moved |= better
    return best, moved


def smooth_branches(problem, vector):
    """
    Return a vector with single bins in the branch of their neighbours, and which bins moved there.

    Where a half-wave plate has half a wave, both signs of all other retardances fit nearly equally
    well. Any error of the model then decides between them; their neighbours tell which is true.
    """
    start, moved = vector.copy(), np.zeros(problem.n_bins, dtype=bool)
    for row, low, high in problem.main_retardances() if problem.n_bins > 2 else ():
        where = problem.elements[row]
        turned = _turned(problem.measurement.wavelength, vector[where], low, high)
        start[where] = np.where(np.isfinite(turned), turned, vector[where])
        moved |= np.isfinite(turned)
    if not moved.any():
        return vector, moved
    start, costs = problem.polish(start)
    moved &= costs < _FAR_WORSE * problem.costs(vector)
    best = vector.copy()
    best[problem.elements[:, moved]] = start[problem.elements[:, moved]]
    return best, moved


def _turned(wavelength, phases, low, high):
    """Return phases with the other sign where the neighbours say so, NaN elsewhere."""
    found = np.full(len(phases), np.nan)
    for i in range(1, len(phases) - 1):
        beside = np.interp(wavelength[i], wavelength[[i - 1, i + 1]], phases[[i - 1, i + 1]])
        off = abs(phases[i] - beside)
        for other in -phases[i] + 2 * np.pi * np.arange(-1, 2):
            if off > _STICKS_OUT and abs(other - beside) < off / 4 and low <= other <= high:
                found[i] = other
    return found


def other_laws(problem, vector, origin):
    """
    Return sums of squares and starts with other thicknesses of each optic, best first.

    A phase that is a law of a thickness has minima of its own, as one of a bin has. Thicknesses are
    tried around those of ``origin``, beside the other common parameters of ``vector``, with each
    bin roughly in its best valley, and in that of the origin.
    """
    slots = [
        slot
        for slot in problem.measurement.free.slots
        if not slot.per_wavelength and slot.unit is not None and slot.unit.is_equivalent(u.m)
    ]
    slopes, found = problem.jacobian(origin)[: problem.measurement.n_data], []
    low, high = problem.measurement.free.bounds()
    base = vector.copy()
    for slot in slots:
        base[slot.start] = origin[slot.start]
    for slot in {slot.name.partition(".")[0]: slot for slot in reversed(slots)}.values():
        size = np.sqrt(np.mean(slopes[:, slot.start] ** 2))
        for k in (k for k in range(-_LAWS, _LAWS + 1) if size > 0):
            start = base.copy()
            start[slot.start] += k * _LAW_STEP / size
            if low[slot.start] <= start[slot.start] <= high[slot.start]:
                start[problem.elements] = origin[problem.elements]
                found.append(problem.polish(start, _ROUGH))
                for row, *bounds in problem.main_retardances():
                    start[problem.elements[row]] = problem.valleys(start, row, *bounds)[0]
                found.append(problem.polish(start, _ROUGH))
    ranked = sorted(((costs.sum(), start) for start, costs in found), key=lambda one: one[0])
    # where the best valley is the nearest one, both are the same
    return [one for k, one in enumerate(ranked) if not k or one[0] > _APART * ranked[k - 1][0]]


def _data_of_bins(measurement, n_bins):
    """Return the data of each bin, padded, and which of them are real."""
    bins = measurement.bins
    counts = np.bincount(bins, minlength=n_bins)
    order = np.argsort(bins, kind="stable")
    present = np.arange(counts.max()) < counts[:, None]
    data = np.zeros(present.shape, dtype=int)
    data[present] = order
    return data, present


# ---- calibrations in steps, each of which holds what the steps before have found ----


_ORDER = ("polarized", "unpolarized", "star")


def two_step(measurement, weighting, joint, run, options):
    """Fit per wavelength with misalignments held, then global, then per wavelength again.

    ``joint`` and ``run`` fit a measurement in place, with and without a search of branches. Returns
    how it went, the noise, and the values after each step.
    """
    parts = [dataset.observations for dataset in measurement.datasets]
    _check_polarized(parts)
    single = {slot.name for slot in measurement.free.slots if not slot.per_wavelength}
    several = {slot.name for slot in measurement.free.slots if slot.per_wavelength}
    ties = measurement.free.ties
    measurement.put_back()
    options = options | {"wavelength": measurement.wavelength * u.um}
    stages = []

    # in the first step each wavelength has its own retardance, also of a plate that follows a law
    grid = measurement.wavelength * u.um
    loose = [join(leaf.loosened(grid) for leaf in leaves(c.copy())) for c in measurement.chains]
    first = _step_of(loose, single, parts, ties, options)
    outcome, weighting = joint(first, weighting)
    outcomes = [outcome]
    stages.append(_stage("per wavelength, misalignments held", first))
    _copy_values(first.put_back(), measurement.chains)

    for title, held in (("global", several), ("per wavelength, global parameters held", single)):
        step = _step_of(measurement.chains, held, parts, ties, options)
        if step.free.size:
            outcome, weighting = run(step, weighting)
            outcomes.append(outcome)
        stages.append(_stage(title, step))
        _copy_values(step.put_back(), measurement.chains)
    measurement.stand_at(measurement.free.start())
    return _worst(outcomes), weighting, stages


def _check_polarized(parts):
    if not any(kind_of_source(part.source) == "polarized" for part in parts):
        stated = ", ".join(sorted({repr(part.source) for part in parts}))
        raise FitError(
            f"strategy 'two-step' is for a polarized source, but the source is {stated}; "
            "allowed here are 'joint' and 'sequential'"
        )


def sequential(measurement, weights, joint, run, options):
    """Fit one kind of source after another and hold what was found: polarized, unpolarized, stars.

    Errors of the steps before do not enter the later ones, and later data do not improve what is
    held: that is the paper's procedure. ``weights`` returns the first weighting of the measurement
    of a step.
    """
    measurement.put_back()
    ties, chains = measurement.free.ties, measurement.chains
    positions = options["positions"] or [None] * len(chains)
    options = options | {"wavelength": measurement.wavelength * u.um}
    parts = [d.observations for d in measurement.datasets]
    kinds = [kind_of_source(o.source) for o in parts]
    # stable: datasets of one kind keep their order
    order = sorted(range(len(parts)), key=lambda i: _ORDER.index(kinds[i]))
    held, outcomes, stages = set(), [], []
    for kind, group in groupby(order, key=lambda i: kinds[i]):
        rows = list(group)
        own = [chains[i] for i in rows]
        known = {"positions": [positions[i] for i in rows]}
        present = {n: tie for n, tie in ties.items() if n in parameter_table(own)}
        step = _step_of(own, held, [parts[i] for i in rows], present, options | known)
        if step.free.size:
            outcome, _ = (run if stages else joint)(step, weights(step))
            outcomes.append(outcome)
        stages.append(_stage(f"{kind}, what came before held" if stages else kind, step))
        _copy_values(step.put_back(), chains)
        # what this step has found is known for the next ones
        held |= {slot.name for slot in step.free.slots}
    measurement.stand_at(measurement.free.start())
    return _worst(outcomes), stages


def telescope_alone(measurement, options):
    """Return the fit of what stars alone see and all wavelengths share, such as a law of M3.

    Such parameters can be nearly degenerate, so that a fit takes hundreds of steps; with all others
    held these are cheap. None where there is nothing of the kind.
    """
    chains, parts = measurement.put_back(), [d.observations for d in measurement.datasets]
    seen = [kind_of_source(part.source) == "star" for part in parts]
    rows = [i for i, star in enumerate(seen) if star]
    if not rows or all(seen):
        return None
    # what a lamp sees as well is found better with it
    lamps = {name for i, star in enumerate(seen) if not star for name in parameter_table(chains[i])}
    own = {s.name for s in measurement.free.slots if not s.per_wavelength} - lamps
    # what has a prior is not degenerate
    if own <= {slot.name for slot, _ in measurement.free.priors}:
        return None
    held = {slot.name for slot in measurement.free.slots} - own
    positions = options["positions"]
    options = options | {
        "wavelength": measurement.wavelength * u.um,
        "positions": None if positions is None else [positions[i] for i in rows],
    }
    stars = [chains[i] for i in rows]
    return _step_of(stars, held, [parts[i] for i in rows], measurement.free.ties, options)


def copy_fitted(origin, target):
    """Give the measurement ``target`` the values that ``origin`` has found, name by name."""
    vector = target.vector()
    for slot in origin.free.slots:
        known = target.free.by_name.get(slot.name)
        if known is not None and known.size == slot.size:
            vector[known.slice] = origin.vector()[slot.slice]
    target.stand_at(vector)


def _worst(outcomes):
    """Return the first step that did not converge, which makes the next useless, or the last."""
    return next((o for o in outcomes if not o["converged"]), outcomes[-1])


def _step_of(chains, held, parts, ties, options):
    """Return the measurement of one step; what follows a held parameter is held too."""
    known = set(parameter_table(chains))
    # a tie needs a source that is free in this step
    live = {n: tie for n, tie in ties.items() if n in known and tie.source in known - held}
    return Measurement(_held(chains, held | (set(ties) - set(live))), parts, ties=live, **options)


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


# ---- choice of a gauge: one of the solutions that the data cannot tell apart ----


GAUGES = ("minimal", None)
_ROUNDS = 6
# a gauge is reached when the leading parameters would move by less (deg, um, percent)
_SETTLED = 1e-4
# longest step along an open direction, in the same units: the surface of solutions is curved
_LONGEST = 2.0
# the solution is left alone if a move spoils it by more than this share
_SPOILT = 1e-3
# what changes the data by less than this (for a degree, micrometre, percent) changes none
_SILENT = 1e-12


def settled(problem, origin):
    """Move a solution along the directions that neither data nor priors see, to the minimal gauge.

    ``origin`` is where the fit started. Returns the parameters that were not determined, and the
    linear problem around the new solution.
    """
    measurement = problem.measurement
    vector = measurement.vector()
    scale, leaders = physical_scale(measurement.free), _leaders(measurement.free)
    whitened = problem.around(vector)
    for _ in range(_ROUNDS):
        null = whitened.together.null
        if not len(null):
            break
        # open directions turn as one moves along them, so in steps with a new null space each
        step = _step(null, leaders, scale, vector - origin)
        if np.abs(step[leaders] / scale[leaders]).max() < _SETTLED:
            break
        moved = _move(problem, vector, step)
        if moved is None:
            break
        vector = moved
        whitened = problem.around(vector)
    measurement.stand_at(vector)
    return open_parameters(measurement.free, whitened), whitened


def open_parameters(free, whitened):
    """Return the parameters common to all wavelengths that data and priors do not determine."""
    known = whitened.together.determined
    moving = [slot for slot in free.slots if not known[slot.slice].all()]
    return [s.name for s in moving if not s.per_wavelength] or [s.name for s in moving]


def hold_silent(measurement, origin):
    """Put back to the start what ended elsewhere although it changes no datum."""
    vector, scale = measurement.vector(), physical_scale(measurement.free)
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


def _leaders(free):
    """Return the elements whose moves are to be small: those common to all wavelengths."""
    single = [slot.start for slot in free.slots if not slot.per_wavelength]
    return np.array(single if single else range(free.size), dtype=int)


def _step(null, leaders, scale, moved):
    """Return the step along the open directions that brings the leaders nearest to home."""
    # least squares of what the leaders are away from home, over shifts along the null directions
    along, *_ = np.linalg.lstsq(null[:, leaders].T, -(moved / scale)[leaders], rcond=1e-6)
    step = along @ null
    longest = np.abs(step).max()
    return step * scale * min(1.0, _LONGEST / longest if longest else 1.0)


def _move(problem, vector, step):
    """Take the step and let the bins follow; None where that corrupts the solution."""
    low, high = problem.measurement.free.bounds()
    before = problem.total(vector)
    trial = np.clip(vector + step, low, high)
    # a straight step leaves the curved surface of equal fits; the bins find back to it
    trial, _ = problem.polish(trial, iterations=8, still_gaining=1 - 1e-12)
    # noise-free data are fitted to rounding: there, a share of nothing is nothing
    spoilt = problem.total(trial) > (1 + _SPOILT) * before + 1e-12 * problem.measurement.n_data
    return None if spoilt else trial


def describe_gauge(gauge, chosen, free, held):
    """Say which of the equivalent solutions a calibration reports, and why.

    ``chosen`` are parameters that the data do not determine, ``held`` those that the user holds.
    """
    check_choice("gauge", gauge, GAUGES, FitError)
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
