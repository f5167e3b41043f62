# Licensed under a 3-clause BSD style license - see LICENSE
"""
Starts and branches: the parameters of all wavelengths at once, common ones held.

With the global parameters held, the bins of a calibration are independent of each other. So all are
searched at once: a coarse scan along the main retardance of each optic finds the valleys, and a
Levenberg-Marquardt step that is batched over the bins polishes the best few. The result is a start
for the joint fit, later a check whether a bin sits in the wrong valley, and after the fit how far
the valleys go and which signs the data do not tell.
"""

from itertools import pairwise, product

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.analysis import other_turn
from astropolcal.calibration.identifiability.sky import mean_errors, seen_with
from astropolcal.calibration.noise.weighting import Problem
from astropolcal.chain import leaves
from astropolcal.progress import steps

__all__ = []

_SCAN_STEP = np.deg2rad(15.0)
_N_VALLEYS = 4
CLEARLY_BETTER = 0.99
# a branch may be so many times worse before all are fitted again, and of a few wavelengths
FAR_WORSE, _ABSURD = 30.0, 1e3
# phases of which the sign hangs on the hand of an optic, and those of an elliptical retarder
_LINEAR, _ELLIPTICAL = "retardance", ("horizontal", "diagonal", "circular")
# what else has a sign that data may not tell
_SIGNED = ".diattenuation"
# how the logarithm of sums of squares, and the square of the way from the start, count beside a
# corner, the square of a bend over that of the ways (radian) and a little
_DEAR, _PULL, _SMOOTH = 1.5, 0.1, 0.1
# of so few wavelengths nothing tells what is smooth; what is outside the bounds comes last
COARSE, _OUTSIDE = 4, 1e3
# phases of other signs are so far apart (radian); what is nearer to half a wave is nearly the same
_OTHER_SIGN = 0.2
# a polish ends when no bin gains a ten-thousandth in a step, or is about to, as one whose step led
# astray, by more than a little, and is not yet damped so much
_STILL_GAINING = 0.9999
_HARDLY, _STUCK = 1e-6, 1.0
# a step of two standard errors raises the root of chi-square by two if it is a parabola; else so
# many more are taken, until the end is known so well, and an error so many times too small grows
_STRAIGHT, _STRIDES, _NEAR, _MATTERS = 1.7, 20, 0.9, 1.1
# so many other thicknesses to either side are tried; each step changes the data by such a share
_LAWS, _LAW_STEP, _ROUGH = 4, 0.15, 4
# steps of a scan in half a turn
_HALF_TURN = 12
# a phase with bounds so far apart may go on by half a turn
_WHOLE_TURN = 1.99 * np.pi
# starts whose sums of squares differ by less are the same
_APART = 1.001
# a fit of everything that is not better after so many evaluations, or gains less than a share in a
# step, is given up
GLANCE, GAIN = 15, 1e-4
# so many steps tell which signs may be the best, and of so many more are taken
_GLIMPSE, _PROMISING = 2, 4
# a sign is told by the data if chi-square, in units of the residuals, differs by more
_UNDECIDED = 9.0
# so far an axis is turned for another start (radian)
_TURNS = np.deg2rad([45.0, 22.5, -22.5])
# of data without noise, residuals below this are rounding
ROUNDED = 1e-6


class BinProblem(Problem):
    """The fit of the parameters given per wavelength, all bins at once.

    As long as no noise is known against which they could weigh, priors are left out. With
    ``together`` all wavelengths are one bin.
    """

    def __init__(self, measurement, weighting, together=False):
        super().__init__(measurement, weighting)
        self.noise = self.noise if weighting.is_known else 0.0
        self.n_bins = 1 if together else len(measurement.wavelength)
        bins = np.zeros_like(measurement.bins) if together else measurement.bins
        # with a single bin every element belongs to it
        slots = [s for s in measurement.free.slots if s.per_wavelength or self.n_bins == 1]
        self.slots = [s for s in slots for _ in range(s.size if self.n_bins == 1 else 1)]
        # the data of each bin, padded, and which of them are real
        counts = np.bincount(bins, minlength=self.n_bins)
        self._present = np.arange(counts.max()) < counts[:, None]
        self._data = np.zeros(self._present.shape, dtype=int)
        self._data[self._present] = np.argsort(bins, kind="stable")
        starts = [slot.start for slot in slots] if self.n_bins > 1 else range(self._low.size)
        #: Element of the flat vector of each slot and bin, (n_slots, n_bins).
        self.elements = np.array(starts, dtype=int)[:, None] + np.arange(self.n_bins)
        self._below, self._above = self._low[self.elements], self._high[self.elements]
        self._own = np.isin(np.arange(self._low.size), self.elements)
        rows = {s.name: [k for k, own in enumerate(self.slots) if own is s] for s in slots}
        #: Priors that enter the costs of the bins, with the rows of each.
        self.priors = [
            (rows[slot.name], prior)
            for slot, prior in measurement.free.priors
            if slot.name in rows and not prior.is_flat
        ]

    def of_bins(self, vector):
        """Return weighted residuals by bin, zero where a bin has fewer data."""
        # all bins at once: a prediction costs as much for one bin as for all; a trial that lets no
        # light pass is not better than another
        with np.errstate(divide="ignore", invalid="ignore"):
            predicted = self.measurement.predict(vector)
            residual = (predicted - self.measurement.observed) * self.weights
            return residual[self._data] * self._present

    def costs(self, vector):
        """Return half the sum of squares of each bin, of data and priors, shape (n_bins,)."""
        costs = 0.5 * np.sum(self.of_bins(vector) ** 2, axis=1)
        for rows, prior in self.priors:
            # one row of all bins, or the rows of the only bin
            residual = self.noise * prior.residual(vector[self.elements[rows]].ravel())
            costs += 0.5 * np.sum(residual.reshape(len(rows), -1) ** 2, axis=0)
        return costs

    # where no light passes there is no slope, and the step is taken back
    @np.errstate(divide="ignore", invalid="ignore")
    def _step(self, vector, damping, kept=()):
        """Return the per-wavelength parameters after a damped step, within their bounds.

        Slots that are ``kept`` stay as they are.
        """
        jacobian = self.measurement.jacobian(vector, self._own) * self.weights
        # (n_bins, n_slots, n_data_of_a_bin): in other bins these parameters change nothing
        blocks = jacobian[self.elements.T[:, :, None], self._data[:, None, :]]
        blocks *= self._present[:, None, :]
        residual = self.of_bins(vector)
        normal = blocks @ np.swapaxes(blocks, 1, 2)
        gradient = np.einsum("bsd,bd->bs", blocks, residual)
        for rows, prior in self.priors:
            value = vector[self.elements[rows]].ravel()
            slope = self.noise * prior.slope(value)
            along = slope * self.noise * prior.residual(value)
            normal[:, rows, rows] += (slope**2).reshape(len(rows), -1).T
            gradient[:, rows] += along.reshape(len(rows), -1).T
        here = vector[self.elements]
        held = (
            ((here <= self._below) & (gradient.T > 0)) | ((here >= self._above) & (gradient.T < 0))
        ).T
        held[:, list(kept)] = True
        # a parameter that leans against its bound must not slow down the others
        normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal)
        gradient = np.where(held, 0.0, gradient)
        size = normal.shape[-1]
        diagonal = np.einsum("bss->bs", normal)
        # relative to the diagonal (Marquardt), plus a little for what changes nothing
        ridge = damping[:, None] * diagonal + 1e-12 * (1 + diagonal.max(axis=1, keepdims=True))
        step = np.linalg.solve(normal + ridge[:, :, None] * np.eye(size), gradient[..., None])
        return np.clip(here - step[..., 0].T, self._below, self._above)

    def polish(self, vector, iterations=12, still_gaining=_STILL_GAINING, kept=(), known=np.inf):
        """Improve the per-wavelength parameters by batched Levenberg-Marquardt.

        Slots that are ``kept`` stay as they are. Returns the vector, where no bin is worse than at
        the start, and the cost of each bin. It ends when no bin falls below the share
        ``still_gaining`` of its cost in a step, or those that do would end above what is ``known``
        of the bin if they went on at this rate.
        """
        vector = vector.copy()
        if not self.slots:
            return vector, self.costs(vector)
        costs, damping = self.costs(vector), np.full(self.n_bins, 1e-3)
        for left in reversed(range(iterations)):
            trial = vector.copy()
            trial[self.elements] = self._step(vector, damping, kept)
            new = self.costs(trial)
            # each bin has its own damping, and takes or leaves its own step
            better = new < costs
            gaining = new < still_gaining * costs
            rate = np.divide(new, costs, out=np.ones_like(new), where=gaining)
            gaining &= rate**left * new < known
            # what is not better, and hardly worse, is at its minimum
            astray = (new > (1 + _HARDLY) * costs) & (damping < _STUCK)
            vector[self.elements[:, better]] = trial[self.elements[:, better]]
            costs = np.where(better, new, costs)
            damping = np.where(better, damping / 5, damping * 8)
            if not np.any(gaining | astray):
                break
        return vector, costs

    def walk(self, row, step, walking, unit):
        """Return how far bins get along a slot, others following, (n_slots, n_bins).

        That is where the root of chi-square's rise is two units, one for each bin; from twice
        ``step`` on, each time half as far again, and then halving, of the bins that are
        ``walking``.
        """
        places, costs = self.elements[row], self.costs(self.solution)
        here, inside = self.solution[self.elements], self.solution.copy()
        reached, beyond = np.zeros(self.n_bins), np.full(self.n_bins, np.inf)
        for _ in range(_STRIDES):
            times = np.where(np.isinf(beyond), np.maximum(1.5 * reached, 2), (reached + beyond) / 2)
            trial = inside.copy()
            trial[places[walking]] = (here[row] + times * step)[walking]
            trial = np.clip(trial, self._low, self._high)
            trial, new = self.polish(trial, kept=[row])
            root = np.sqrt(2 * (new - costs).clip(0)) / unit
            low = root < 2
            inside[self.elements[:, walking & low]] = trial[self.elements[:, walking & low]]
            at_end = (trial[places] <= self._below[row]) | (trial[places] >= self._above[row])
            reached, beyond = np.where(low, times, reached), np.where(low, beyond, times)
            walking = walking & ~(low & (at_end | (root > _STRAIGHT))) & (reached < _NEAR * beyond)
            if not walking.any():
                break
        return inside[self.elements] - here

    def main_retardances(self):
        """Return the first slot of each optic that can make half a turn or more."""
        found = {}
        for row, slot in enumerate(self.slots):
            optic, key = slot.name.split(".")
            low, high = slot.canonical_bounds()
            # only a phase that may go round has mirror branches; an
            # orientation is within its bounds
            is_phase = key != "theta" and slot.unit is not None and slot.unit.is_equivalent(u.rad)
            if is_phase and high - low > np.pi:
                found.setdefault(optic, (row, max(low, -2 * np.pi), min(high, 2 * np.pi)))
        return list(found.values())

    def phases(self):
        """Return the elements of phases that change their sign with the hand, (n_phases, n_bins).

        With them whether a turn changes nothing.
        """
        keys = [slot.name.split(".")[1] for slot in self.slots]
        rows = [row for row, key in enumerate(keys) if key in (_LINEAR, *_ELLIPTICAL[:2])]
        known = [row for own, _ in self.priors for row in own]
        turns = [keys[row] == _LINEAR and row not in known for row in rows]
        return self.elements[rows], np.array(turns, dtype=bool)

    def branches(self, vector):
        """Return vectors that may fit as well: this one, of the other hand, and of other signs."""
        places, _ = self.phases()
        found, optics = [vector], {}
        for row, slot in enumerate(self.slots):
            optic, key = slot.name.split(".")
            optics.setdefault(optic, {})[key] = row
        for own in (places, *(self.elements[[row]] for row, *_ in self.main_retardances())):
            other = vector.copy()
            other[own] *= -1
            found.append(np.clip(self.turned(other, own, vector[own]), self._low, self._high))
        for rows in optics.values():
            if set(_ELLIPTICAL) <= set(rows):
                own = self.elements[[rows[key] for key in _ELLIPTICAL]]
                for one in found[:2]:
                    other = one.copy()
                    other[own] = other_turn(one[own])
                    found.append(np.clip(other, self._low, self._high))
        return found

    def in_line(self, vectors, towards):
        """Return the vector of each bin's own, with whole turns that bring its phases in line.

        ``vectors`` has one for each bin, (n_bins, n_free); the first is turned ``towards`` another.
        """
        vector, (places, turns) = vectors[0].copy(), self.phases()
        for i, own in enumerate(vectors):
            vector[self.elements[:, i]] = own[self.elements[:, i]]
        columns = places[turns].T
        for before, there in zip((None, *columns), columns, strict=False):
            near = towards[there] if before is None else vector[before]
            vector = self.turned(vector, there, near)
        return vector

    def turned(self, vector, elements, towards):
        """Return a vector with whole turns that bring elements near others, within their bounds."""
        options = vector[elements] + 2 * np.pi * np.arange(-2, 3).reshape(-1, *[1] * elements.ndim)
        inside = (self._low[elements] <= options) & (options <= self._high[elements])
        # within the bounds first
        way = np.abs(options - towards) + np.where(inside, 0.0, _OUTSIDE)
        turned = vector.copy()
        turned[elements] = np.take_along_axis(options, np.argmin(way, axis=0)[None], axis=0)[0]
        return turned

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
                trial, new = problem.polish(trial, known=CLEARLY_BETTER * costs)
                better = new < CLEARLY_BETTER * costs
                best[problem.elements[:, better]] = trial[problem.elements[:, better]]
                costs = np.where(better, new, costs)
                moved |= better
    return best, moved


def _between(wavelength, phases):
    """Return phases between the two beside each, NaN at the ends of the spectrum."""
    found, lam = np.full(len(phases), np.nan), wavelength
    for i in range(1, len(phases) - 1):
        found[i] = np.interp(lam[i], lam[[i - 1, i + 1]], phases[[i - 1, i + 1]])
    return found


def undecided_signs(measurement, view, stds, minima, lawful=()):
    """
    Return, as mirror solutions are, what the data do not tell the sign of, at single wavelengths.

    And which of the ``minima`` that a search has seen elsewhere they do not exclude.

    These are phases, and diattenuations, of which the other sign, all else of the wavelength
    refitted, and of a few wavelengths everything, is less than three standard deviations worse, or
    better. Phases that fit exactly as well are a mirror solution anyway; what is zero within three
    of its ``stds`` has no sign. With them the mean squares of the errors of q and u that the other
    signs would be on sky, times their probabilities: in proportion to the polarization and apart
    from it, (2, n_wavelengths); zero where the phases beside tell the sign. And the roots of those
    of parameters, in their units by name, where these are longer than ``stds``, but for what has
    the other sign. What is ``lawful`` stays as it is.
    """
    problem = BinProblem(measurement, measurement.weighting)
    kept = [row for row, slot in enumerate(problem.slots) if slot.name in lawful]
    vector, found, errors = measurement.vector(), [], np.zeros((2, problem.n_bins))
    away = np.zeros(vector.size)
    costs, total = problem.polish(vector, kept=kept)[1], np.sum(problem.residuals(vector) ** 2)
    # no more degrees of freedom than are left
    whole = max(measurement.n_data - measurement.free.size, 1)
    count = problem._present.sum(axis=1) * min(whole / measurement.n_data, 1.0)
    phases = {row for row, *_ in problem.main_retardances()}
    signed = [row for row, slot in enumerate(problem.slots) if slot.name.endswith(_SIGNED)]
    for row in (row for row in (*phases, *signed) if row not in kept):
        slot, places = problem.slots[row], problem.elements[row]
        trial = vector.copy()
        trial[places] *= -1
        if row in phases:
            trial = problem.turned(trial, places, np.zeros(places.shape))
        trial, new = problem.polish(np.clip(trial, *measurement.free.bounds()), kept=kept)
        others = _refitted(problem, vector, costs, trial, new)
        moved = np.abs(trial[places] - vector[places])
        if row in phases:
            moved = np.abs(np.remainder(moved + np.pi, 2 * np.pi) - np.pi)
        # what is less than its error is no sign
        least = _OTHER_SIGN if row in phases else 3 * np.nan_to_num(stds[places], nan=np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = new / costs
            # against the noise of the bin, and that of all
            lost = np.minimum(count * np.log(ratio), whole * np.log1p(2 * (new - costs) / total))
            # which may as well fit a little better
            close = (np.abs(ratio - 1) > ROUNDED) | (row not in phases)
            close &= (lost < _UNDECIDED) & (moved > least) & (costs > 0)
        for i in np.flatnonzero(close):
            nm, value = 1e3 * measurement.wavelength[i], trial[places[i]] / slot.factor
            shown = f"{value:.4g} {slot.unit or ''}".strip()
            words = (
                f"{slot.name} at {nm:.1f} nm: with the other sign, {shown}, the "
                f"sum of squares is {ratio[i]:.2f} times as large: the data do not tell the sign"
            )
            found.append({"words": words, "sky": None})
        beside = _between(measurement.wavelength, vector[places])
        open_ = close & ~(4 * np.abs(vector[places] - beside) < np.abs(trial[places] - beside))
        chance = np.where(open_, 1 / (1 + np.exp(np.where(open_, lost, 0.0) / 2)), 0.0)
        shares = [(chance[i], one) for i, one in others.items()]
        chance[[*others]] = 0.0
        for share, there in ((chance, trial), *shares):
            near = there.copy()
            for own in phases:
                near = problem.turned(near, problem.elements[own], vector[problem.elements[own]])
            # what is known but for its sign is named
            near[places] = vector[places]
            weight = np.full(vector.size, np.max(share))
            weight[problem.elements] = share
            away = np.maximum(away, np.sqrt(weight) * np.abs(near - vector))
            if view is not None and np.any(share > 0):
                other = seen_with(view, measurement.put_back(there))
                errors = np.maximum(errors, share * mean_errors(view, other))
    elsewhere, further, farther = _elsewhere(measurement, view, stds, minima)
    free, away = measurement.free, np.maximum(away, farther)
    far = zip(free.names, away / free.factors(), away > stds, strict=True)
    longer = {name: float(error) for name, error, is_longer in far if is_longer}
    return found + elsewhere, np.maximum(errors, further), longer


def _elsewhere(measurement, view, stds, minima):
    """Return minima, of those given, that are less than three standard deviations worse.

    As `undecided_signs` does, with errors on sky at all wavelengths. What lies within three of the
    ``stds`` of another is the same; what fits exactly as well is a mirror solution anyway.
    """
    problem, free = Problem(measurement, measurement.weighting), measurement.free
    # what a prior holds departs from it at all wavelengths alike: that counts once
    known = [slot.size for slot, prior in free.priors if not prior.is_flat]
    once = [np.full(size, size**-0.5) for size in known]
    counts = np.concatenate([np.ones(measurement.n_data), *once])
    whole, inverse = max(measurement.n_data - free.size, 1), np.zeros(free.size)
    # what is held, or open, is no way to another
    np.divide(1, stds, out=inverse, where=stds > 0)
    seen, found, errors = [problem.solution], [], np.zeros((2, measurement.wavelength.size))
    away = np.zeros(free.size)
    total = np.sum((counts * problem.residuals(seen[0])) ** 2)
    for there in minima if total > 0 else ():
        ratio = np.sum((counts * problem.residuals(there)) ** 2) / total
        lost = whole * np.log(ratio)
        ways = np.array([np.abs(there - one) * inverse for one in seen])
        if not (ROUNDED < abs(ratio - 1) and lost < _UNDECIDED and ways.max(axis=1).min() > 3):
            continue
        seen.append(there)
        far = int(np.argmax(ways[0]))
        shown = f"{there[far] / free.factors()[far]:.4g} {free.units[far] or ''}".strip()
        words = (
            f"{free.names[far]}: in another minimum, at {shown}, the sum of squares is "
            f"{ratio:.2f} times as large: the data do not tell which is true"
        )
        found.append({"words": words, "sky": None, "minimum": free.names[far]})
        chance = 1 / (1 + np.exp(lost / 2))
        away = np.maximum(away, np.sqrt(chance) * np.abs(there - seen[0]))
        if view is not None:
            other = mean_errors(view, seen_with(view, measurement.put_back(there)))
            errors = np.maximum(errors, other * chance)
    return found, errors, away


def _refitted(problem, vector, costs, trial, new):
    """Return fits of everything from other signs by wavelength, put into ``trial`` and ``new``."""
    found, total = {}, np.sum(problem.residuals(vector) ** 2)
    for i, start in _one_by_one(problem, vector, costs, trial, new):
        found[i] = problem.fit(start, evaluations=GLANCE, gain=GAIN)[0]
        trial[problem.elements[:, i]] = found[i][problem.elements[:, i]]
        rise = (np.sum(problem.residuals(found[i]) ** 2) - total) / 2
        new[i] = max(costs[i] + rise, ROUNDED * costs[i])
    return found


def bent_valleys(measurement, whitened, stds):
    """Return how far parameters may go where chi-square is not a parabola.

    Of a wavelength with common parameters held and all others of the wavelength refitted, and along
    each common parameter with everything refitted.

    Each is an element of the flat vector, a direction, (n_free,) in canonical units, what of it is
    beyond the one that slopes tell, and by how much the element may fall and rise. The direction is
    as long as a standard error: half the way at which chi-square has risen by four, to the side
    where it is longer. Where scatter makes the stated error, ``stds``, larger than that of white
    noise, chi-square has to rise by as much more.
    """
    level, scale, null = measurement.weighting.level, whitened.scale, whitened.null()
    with np.errstate(divide="ignore", invalid="ignore"):
        times = stds / (level * np.sqrt(np.diag(whitened.covariance())))
    several = measurement.free.spread([slot.per_wavelength for slot in measurement.free.slots])
    found = []
    for together in [*([False] if several.any() else []), True]:
        problem = BinProblem(measurement, measurement.weighting, together)
        around = whitened.given_others(problem._own)
        for row, places in enumerate(problem.elements):
            if together and several[places[0]]:
                continue
            for i, ends, straight in _ends(problem, *around, row, times):
                own, sides = problem.elements[:, i], np.abs(ends).argmax(axis=0)
                least = np.maximum(stds[own], np.abs(straight[0]))
                for k in np.flatnonzero(np.abs(ends).max(axis=0) > 2 * _MATTERS * least):
                    ways = np.zeros((2, stds.size))
                    ways[:, own] = ends[sides[k]] / 2, ends[sides[k]] / 2 - straight[sides[k]]
                    # what is open stays open
                    ways -= (ways / scale @ null.T) @ null * scale
                    found.append((own[k], *ways, sorted((0.0, *ends[:, k]))[::2]))
    return found


def _ends(problem, known, half, row, times):
    """Yield bins, and how far their slots get along one of them to either side, (2, n_slots).

    At two standard errors; with them the straight ways of one.
    """
    vector, places = problem.solution, problem.elements[row]
    errors = np.linalg.norm(half[:, places], axis=0)
    live = known[places] & (times[places] > 0) & (errors > 0)
    # a standard error of each bin, in units of the root of chi-square and of the parameter
    rise = np.where(live, problem.weighting.level * times[places], 0.0)
    unit, step = np.where(live, rise, np.inf), rise * np.where(live, errors, 0.0)
    # the way of each bin is its own: all are gone at once
    way = half.T @ (half[:, places] @ (rise / np.where(live, errors, 1.0)))
    ends, costs = [], problem.costs(vector)
    straight = np.array([way[problem.elements], -way[problem.elements]])
    for sign in (1, -1):
        there = np.clip(vector + 2 * sign * way, problem._low, problem._high)
        root = np.sqrt(2 * (problem.costs(there) - costs).clip(0)) / unit
        bent = live & ~((_STRAIGHT < root) & (root < 4 / _STRAIGHT))
        far = 2 * sign * way[problem.elements]
        if bent.any():
            far = np.where(bent, problem.walk(row, sign * step, bent, unit), far)
        ends.append(far)
    for i in np.flatnonzero(live):
        yield i, np.array(ends)[:, :, i], straight[:, :, i]


def other_laws(problem, vector, origin):
    """Return sums of squares and starts with other thicknesses or laws of phases, best first.

    A phase that is a law, of a thickness or with coefficients, has minima of its own, as one of a
    bin has. Thicknesses are tried around those of ``origin``, beside the other common parameters of
    ``vector``, with each bin roughly in its best valley, and in that of the origin; so are
    coefficients, with the constant moved so that the data change least, and all the way round.
    """
    laws, base, starts, found = list(_law_slots(problem.measurement)), vector.copy(), {}, []
    for slot in (slot for both in laws for slot in both if slot):
        base[slot.start] = origin[slot.start]
    slopes = problem.jacobian(base)[: problem.measurement.n_data]
    # an unpolarized source shows little of either
    step = _LAW_STEP * np.sqrt(np.mean((problem.measurement.observed * problem.weights) ** 2))
    for slot, constant in laws:
        way, turn = np.zeros((2, vector.size))
        way[slot.start] = 1.0
        if constant is not None:
            own, of = slopes[:, slot.start], slopes[:, constant.start]
            way[constant.start] = -(own @ of) / max(of @ of, np.finfo(float).tiny)
            turn[constant.start] = _SCAN_STEP
        size = np.sqrt(np.mean((slopes @ way) ** 2))
        if size > 0:
            name = slot.name.partition(".")[0] if constant is None else slot.name
            starts.setdefault(name, _law_starts(problem, base, step / size * way, turn))
    for start in (start for each in starts.values() for start in each):
        start[problem.elements] = origin[problem.elements]
        found.append(problem.polish(start, _ROUGH))
        for row, *bounds in problem.main_retardances():
            start[problem.elements[row]] = problem.valleys(start, row, *bounds)[0]
        found.append(problem.polish(start, _ROUGH))
    ranked = sorted(((costs.sum(), start) for start, costs in found), key=lambda one: one[0])
    # where the best valley is the nearest one, both are the same
    return [one for k, one in enumerate(ranked) if not k or one[0] > _APART * ranked[k - 1][0]]


def _law_starts(problem, base, way, turn):
    """Return vectors some steps along a law, of its turned constants those of least costs."""
    low, high = problem.measurement.free.bounds()
    turns = range(-_HALF_TURN, _HALF_TURN) if turn.any() else (0,)
    found = []
    for k in range(-_LAWS, _LAWS + 1):
        ways = [base + k * way + times * turn for times in turns]
        inside = [start for start in ways if np.all((low <= start) & (start <= high))]
        found += sorted(inside, key=lambda start: problem.costs(start).sum())[:1]
    return found


def _law_slots(measurement):
    """Yield thicknesses, and coefficients of laws that are phases with the slots of constants."""
    by_name = measurement.free.by_name
    for slot in measurement.free.slots:
        if not slot.per_wavelength and slot.unit is not None and slot.unit.is_equivalent(u.m):
            yield slot, None
    for leaf in (leaf for chain in measurement.chains for leaf in leaves(chain)):
        for key, law in leaf._follows.items() if leaf.name else ():
            constant = by_name.get(f"{leaf.name}.{key}")
            if constant is None or constant.per_wavelength or key not in (_LINEAR, *_ELLIPTICAL):
                continue
            names = (f"{leaf.name}.{name}" for name in law.names(key))
            yield from ((by_name[name], constant) for name in names if name in by_name)


def other_signs(problem, vector):
    """Return starts in which one of a few wavelengths is in another branch."""
    costs, found = problem.costs(vector), []
    for branch in problem.branches(vector)[1:] if problem.n_bins <= COARSE else ():
        others = _one_by_one(problem, vector, costs, *problem.polish(branch))
        found += [start for _, start in others]
    return found


def _one_by_one(problem, vector, costs, other, new):
    """Yield each of a few wavelengths, and vectors that have its other sign.

    Only where that is not as good and not far worse.
    """
    few = problem.n_bins <= COARSE
    for i in np.flatnonzero(few & (_APART * costs < new) & (new < _ABSURD * costs)):
        start = vector.copy()
        start[problem.elements[:, i]] = other[problem.elements[:, i]]
        yield i, start


def other_axes(problem, vector, origin):
    """Return starts with other orientations of diattenuators, and all else of these at home.

    Without diattenuation its axis changes no datum, so that a fit may end where both are wrong.
    """
    free, found = problem.measurement.free, []
    low, high = free.bounds()
    for slot in (slot for slot in free.slots if slot.name.endswith(".theta")):
        optic = f"{slot.name.partition('.')[0]}."
        may_turn = high[slot.start] - low[slot.start] > np.pi / 2
        may_turn &= f"{optic}diattenuation" in free.by_name
        for turn in _TURNS if may_turn else ():
            start = vector.copy()
            for own in (one for one in free.slots if one.name.startswith(optic)):
                start[own.slice] = origin[own.slice]
            # an axis that is turned by half a turn is the same
            start[slot.slice] = (start[slot.slice] - low[slot.slice] + turn) % np.pi
            start[slot.slice] += low[slot.slice]
            found.append(np.clip(start, low, high))
    return found


def centres(problem):
    """Return what priors hold near a centre: common angles, and phases of single wavelengths.

    Each is its elements and its centre, with the width of the prior of an angle, and of a phase
    whether half a turn stays in its bounds.
    """
    free, axes, phases = problem.measurement.free, [], []
    for slot, prior in free.priors:
        if prior.is_flat or slot.unit is None or not slot.unit.is_equivalent(u.rad):
            continue
        centre, (low, high) = prior.mode * prior.factor, slot.canonical_bounds()
        if slot in problem.slots:
            places = problem.elements[problem.slots.index(slot)]
            phases.append((places, centre, high - low > _WHOLE_TURN))
        else:
            axes.append((slice(slot.start, slot.start + slot.size), centre, prior.width))
    return axes, phases


def best_signs(problem, vector, phases):
    """Return a vector whose bins have their best signs of phases, and the best half turns of these.

    With a few steps of all parameters of a wavelength from each, and more from the best; common
    ones are held.
    """
    tried, ways = [], [range(4 if turns else 2) for *_, turns in phases]
    # of the other hand is what no prior holds, too
    for base, which in product(problem.branches(vector)[:2], product(*ways)):
        trial = base.copy()
        for k, (places, centre, _) in zip(which, phases, strict=True):
            side = trial[places] - centre
            side = -side if k % 2 else side
            trial[places] = centre + (side - np.pi * np.where(side > 0, 1, -1) if k > 1 else side)
        tried.append(problem.polish(np.clip(trial, problem._low, problem._high), _GLIMPSE))
    order = np.argsort([costs for _, costs in tried], axis=0)[:_PROMISING]
    best, least = vector.copy(), np.full(problem.n_bins, np.inf)
    for ranked in order:
        trial = vector.copy()
        for i, k in enumerate(ranked):
            trial[problem.elements[:, i]] = tried[k][0][problem.elements[:, i]]
        trial, costs = problem.polish(trial, known=least)
        better = costs < least
        best[problem.elements[:, better]] = trial[problem.elements[:, better]]
        least = np.where(better, costs, least)
    return best


def mirrored(vector, axes):
    """Return a vector, and others in which common angles lie on the other sides of their centres.

    Half a wave along the axes of an analyzer mirrors all axes between it and the analyzer. So a
    static retarder of any retardance hides the signs of what is downstream of it.
    """
    found = [vector]
    for places, centre, _ in axes:
        for one in list(found):
            other = one.copy()
            other[places] = 2 * centre - other[places]
            found.append(other)
    return found


def beside_centres(vector, axes):
    """Return vectors with common angles on all sides of their centres, the width of a prior away.

    A wavelength of the wrong sign may have drawn an angle to its centre, of which the mirror is
    nearly the same.
    """
    found = []
    for sides in product((1, -1), repeat=len(axes)):
        other = vector.copy()
        for side, (places, centre, width) in zip(sides, axes, strict=True):
            other[places] = centre + side * width
        found.append(other)
    return found


def least_bent(problem, branches, ratio, origin):
    """Return the branch of each bin, (n_bins,), with which phases bend least over the wavelengths.

    ``ratio`` has the sums of squares of branches over those of the first, (n_branches, n_bins). The
    least sum of all is found by dynamic programming over pairs of neighbours.
    """
    places, turns = problem.phases()
    # what priors hold near a centre may have either sign beside each other
    known = [row for own, _ in problem.priors for row in own]
    loose = ~np.isin(places[:, 0], problem.elements[known, 0])
    if loose.any():
        places, turns = places[loose], turns[loose]
    # (n_bins, n_branches, n_phases)
    phases = np.transpose([branch[places] for branch in branches], (2, 0, 1))
    away = _PULL * np.sum(_shortest(phases - origin[places].T[:, None], turns) ** 2, axis=-1)
    alone = _DEAR * np.log(ratio.T) + away
    if problem.n_bins == 1:
        return np.argmin(alone, axis=1)
    # from each branch of a bin to each of the next
    ways = [_shortest(after - one[:, None], turns) for one, after in pairwise(phases)]
    gaps, before = np.diff(problem.measurement.wavelength), []
    # few wavelengths are no measure of what is smooth
    corner = float(problem.n_bins > COARSE)
    # least cost of each pair of branches of the last two bins
    least = alone[0][:, None] + alone[1]
    for i in range(1, len(ways)):
        straight = ways[i - 1][:, :, None] * (gaps[i] / gaps[i - 1])
        size = _SMOOTH + ways[i] ** 2 + straight**2
        costs = least[:, :, None] + corner * np.sum((ways[i] - straight) ** 2 / size, axis=-1)
        before.append(np.argmin(costs, axis=0))
        least = np.min(costs, axis=0) + alone[i + 1]
    path = list(np.unravel_index(np.argmin(least), least.shape))
    for back in reversed(before):
        path.insert(0, back[path[0], path[1]])
    return np.array(path)


def _shortest(ways, turns):
    """Return ways between phases, (..., n_phases), less whole turns where these change nothing."""
    return ways - np.where(turns, 2 * np.pi * np.rint(ways / (2 * np.pi)), 0.0)
