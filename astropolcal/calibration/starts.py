# Licensed under a 3-clause BSD style license - see LICENSE
"""
Starts for a fit that has mirror solutions.

With the global parameters held, the bins of a calibration are independent of
each other. So all bins are searched at once: a coarse scan along the main
retardance of each optic finds the valleys, and a Levenberg-Marquardt step that
is batched over the bins polishes the best few. The result is a start for the
joint fit, and later a check whether a bin sits in the wrong valley.
"""

import astropy.units as u
import numpy as np

__all__ = ["BinProblem", "search_branches"]

_SCAN_STEP = np.deg2rad(15.0)
_N_VALLEYS = 4
_CLEARLY_BETTER = 0.99
# a polish ends when no bin gains a thousandth in a step, or is about to
_STILL_GAINING = 0.999
_STUCK = 1.0


class BinProblem:
    """
    The fit of the parameters given per wavelength, all bins at once.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    weights : `~numpy.ndarray`, optional
        Weight of each datum, shape (n_data,).
    noise : float
        Noise of a datum of weight one, against which priors weigh; zero leaves
        them out.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import BinProblem
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> problem = BinProblem(Measurement(charis.chain(), observations))
    >>> problem.costs(problem.measurement.vector()).shape
    (22,)
    """

    def __init__(self, measurement, weights=None, noise=1.0):
        self.measurement = measurement
        self.weights = np.ones(measurement.n_data) if weights is None else np.asarray(weights)
        self.n_bins = len(measurement.wavelength)
        # with a single bin every parameter belongs to it
        self.slots = [s for s in measurement.free.slots if s.per_wavelength or self.n_bins == 1]
        self._data, self._present = _data_of_bins(measurement, self.n_bins)
        starts = np.array([slot.start for slot in self.slots], dtype=int)
        #: Element of the flat vector of each slot and bin, (n_slots, n_bins).
        self.elements = starts[:, None] + np.arange(self.n_bins)
        low, high = measurement.free.bounds()
        self._low, self._high = low[self.elements], high[self.elements]
        self._noise = noise
        rows = {slot.name: row for row, slot in enumerate(self.slots)}
        tight = [(slot, prior) for slot, prior in measurement.free.priors if not prior.is_flat]
        self._priors = [(rows[slot.name], prior) for slot, prior in tight if slot.name in rows]
        self._common = [(slot, prior) for slot, prior in tight if slot.name not in rows]

    @property
    def has_priors(self):
        """Whether priors that are not flat enter the costs of the bins."""
        return bool(self._priors)

    def residuals(self, vector):
        """Return weighted residuals by bin, zero where a bin has fewer data."""
        # all bins at once: a prediction costs as much for one bin as for all
        residual = (self.measurement.predict(vector) - self.measurement.observed) * self.weights
        return residual[self._data] * self._present

    def costs(self, vector):
        """Return half the sum of squares of each bin, of data and priors, shape (n_bins,)."""
        costs = 0.5 * np.sum(self.residuals(vector) ** 2, axis=1)
        for row, prior in self._priors:
            costs += 0.5 * (self._noise * prior.residual(vector[self.elements[row]])) ** 2
        return costs

    def total(self, vector):
        """Return half the sum of squares of all data and priors."""
        common = [prior.residual(vector[slot.slice]) for slot, prior in self._common]
        return self.costs(vector).sum() + 0.5 * self._noise**2 * sum(np.sum(r**2) for r in common)

    def _normal_equations(self, vector):
        jacobian = self.measurement.jacobian(vector) * self.weights
        # (n_bins, n_slots, n_data_of_a_bin): in other bins these parameters change nothing
        blocks = jacobian[self.elements.T[:, :, None], self._data[:, None, :]]
        blocks *= self._present[:, None, :]
        residual = self.residuals(vector)
        normal = blocks @ np.swapaxes(blocks, 1, 2)
        gradient = np.einsum("bsd,bd->bs", blocks, residual)
        for row, prior in self._priors:
            value = vector[self.elements[row]]
            slope = self._noise * prior.slope(value)
            normal[:, row, row] += slope**2
            gradient[:, row] += slope * self._noise * prior.residual(value)
        return normal, gradient

    def polish(self, vector, iterations=12, still_gaining=_STILL_GAINING):
        """
        Improve the per-wavelength parameters by batched Levenberg-Marquardt.

        Parameters
        ----------
        vector : `~numpy.ndarray`
            Start, shape (n_free,).
        iterations : int
            Largest number of steps.
        still_gaining : float
            It ends when no bin falls below this share of its cost in a step.

        Returns
        -------
        vector : `~numpy.ndarray`
            Shape (n_free,); no bin is worse than at the start.
        costs : `~numpy.ndarray`
            Cost of each bin there.
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
            ((here <= self._low) & (gradient.T > 0)) | ((here >= self._high) & (gradient.T < 0))
        ).T
        # a parameter that leans against its bound must not slow down the others
        normal = np.where(held[:, :, None] | held[:, None, :], 0.0, normal)
        gradient = np.where(held, 0.0, gradient)
        size = normal.shape[-1]
        diagonal = np.einsum("bss->bs", normal)
        # relative to the diagonal (Marquardt), plus a little for what changes nothing
        ridge = damping[:, None] * diagonal + 1e-12 * (1 + diagonal.max(axis=1, keepdims=True))
        step = np.linalg.solve(normal + ridge[:, :, None] * np.eye(size), gradient[..., None])
        return np.clip(here - step[..., 0].T, self._low, self._high)

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
        """
        Return the best few values of one slot, from a scan over its bounds.

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_valleys, n_bins), best first.
        """
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
    """
    Return a start in which every bin sits in its best valley.

    Parameters
    ----------
    problem : BinProblem
        The bins of the measurement.
    vector : `~numpy.ndarray`
        Current values; its own valley is kept unless another is clearly
        (1 %) better.
    origin : `~numpy.ndarray`, optional
        Where the scans begin, by default at ``vector``; shape (n_free,). Only
        its per-wavelength parameters matter.

    Returns
    -------
    vector : `~numpy.ndarray`
        Shape (n_free,).
    moved : `~numpy.ndarray`
        True for the bins that changed their valley.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import BinProblem, search_branches
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> measurement = Measurement(charis.chain(), observations)
    >>> search_branches(BinProblem(measurement), measurement.vector())[1].any()
    np.False_
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
    for row, low, high in retardances:
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


def _data_of_bins(measurement, n_bins):
    """Return the data of each bin, padded, and which of them are real."""
    bins = measurement.bins
    counts = np.bincount(bins, minlength=n_bins)
    order = np.argsort(bins, kind="stable")
    present = np.arange(counts.max()) < counts[:, None]
    data = np.zeros(present.shape, dtype=int)
    data[present] = order
    return data, present
