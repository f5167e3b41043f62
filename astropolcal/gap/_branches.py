# Licensed under a 3-clause BSD style license - see LICENSE
"""Starts of fits that would stay where they are: at an extremum, or in a wrong branch."""

import astropy.units as u
import numpy as np
from scipy import stats

from astropolcal.gap.cells import FINITE
from astropolcal.optics import LinearRetarder, Perturbation

__all__ = ["in_branch", "off_extremum"]

#: A fit whose residuals are less probable than this may sit in a wrong minimum
NOISE = 1e-3
# a second difference above this share of the first one is tried at finite size
_BENT = 1.0
# wavelengths with a mean square above so many medians may sit in a wrong branch; another one has to
# leave less than this share, and is sought in so many steps
_CONSPICUOUS, _FAR_LESS, _FEW_STEPS = 3.0, 0.7, 8
# square of the bend (radian) that another sign has to be worth
_OTHER_SIGN = 0.01


def off_extremum(problem, start, parameters):
    """
    Return the start of a fit, or those of both signs where the derivative of a retardance vanishes.

    At half a wave it does, and a fit from there would stay.
    """
    found = []
    optics = {leaf.name: leaf for d in problem.datasets for leaf in d.propagator.leaves}
    for parameter in parameters:
        where = problem.slices.get(parameter.name)
        if where is None or np.any(start[where]) or not _retards(optics, parameter.name):
            continue
        vector = problem.vector(start)
        vector[problem.free.by_name[parameter.name].slice] = FINITE
        step = problem.coefficients(vector) - start
        ends = [start + sign * step for sign in (1, -1)]
        there, up, down = (problem.residual(q) for q in (start, *ends))
        bend = np.linalg.norm(up + down - 2 * there)
        if bend > max(1.0, _BENT * np.linalg.norm(up - down)):
            found += ends
    return found or [start]


def _retards(optics, name):
    """Return whether a parameter is a constant retardance that was inserted."""
    optic = optics.get(name.partition(".")[0])
    if isinstance(optic, Perturbation):
        return optic.kind.startswith("retardance") and optic.dependence == "constant"
    return isinstance(optic, LinearRetarder) and name.endswith(".retardance")


def in_branch(problem, found):
    """
    Return the fit with the wavelengths in other branches that are far better there.

    A retardance of the other sign, or a turn from it, may be a minimum of its own, from which a
    fit does not leave. Wavelengths that fit much worse than the others are started again from what
    their neighbours say, with all signs; where those would have all others bent, everything is
    fitted from the signs of the smoothest course.
    """
    slots = [s for s in problem.free.slots if s.per_wavelength and s.name not in problem.laws]
    slots = [slot for slot in slots if slot.size == len(problem.wavelength)]
    if not slots or stats.chi2.sf(found.chi2, max(problem.n_data - problem.size, 1)) > NOISE:
        return found
    for starts in (_mended(problem, slots, found.coefficients), _smoothest(problem, slots, found)):
        for start in starts:
            again = problem.fit(start)
            found = again if again.converged and again.chi2 < found.chi2 else found
    return found


def _mended(problem, slots, coefficients):
    """Yield the coefficients with the wavelengths that fit worst in a better branch, if any are."""
    before = _by_wavelength(problem, coefficients)
    bad = before > _CONSPICUOUS * np.median(before)
    if not bad.any() or np.sum(~bad) < 2:
        return
    live = np.zeros(problem.size, dtype=bool)
    for slot in slots:
        live[problem.slices[slot.name]] = bad
    rows = np.concatenate(
        [np.broadcast_to(bad[d.bins][:, None], c.shape).ravel() for c, d in _datasets(problem)]
    )
    best, least = coefficients.copy(), before
    for start in _branches(problem, slots, coefficients, bad):
        trial = problem.fit(start, rows, ~live, steps=_FEW_STEPS).coefficients
        after = _by_wavelength(problem, trial)
        better = bad & (after < least)
        for slot in slots:
            where = problem.slices[slot.name]
            best[where] = np.where(better, trial[where], best[where])
        least = np.where(better, after, least)
    # what a wavelength gains has to be more than what a fit may still win by itself
    if np.any(least < _FAR_LESS * before):
        yield best


def _smoothest(problem, slots, found):
    """Yield the coefficients with the signs of retardances that make their courses smoothest."""
    start = found.coefficients.copy()
    for slot in slots:
        where = problem.slices[slot.name]
        if slot.unit == u.deg and slot.size > 2:
            start[where] = _smooth(
                problem.wavelength, start[where], problem.low[where], problem.high[where]
            )
    if not np.array_equal(start, found.coefficients):
        yield start


def _smooth(wavelength, values, low, high):
    """Return values with the signs and turns with which their course is least bent."""
    turn = 2 * np.pi
    choices = np.array([s * values + k * turn for s in (1, -1) for k in (0, -1, 1)])
    # what is out of the bounds is no choice; its own value is always one, and preferred
    cost = np.where((choices >= low) & (choices <= high), _OTHER_SIGN, np.inf)
    cost[0] = 0.0
    total, back = cost[:, :1] + cost[:, 1], []
    for i in range(2, len(values)):
        first, second, third = choices[:, i - 2], choices[:, i - 1], choices[:, i]
        share = (wavelength[i] - wavelength[i - 1]) / (wavelength[i - 1] - wavelength[i - 2])
        straight = second[None] + share * (second[None] - first[:, None])
        bends = total[:, :, None] + (third - straight[:, :, None]) ** 2 + cost[:, i]
        back.append(bends.argmin(axis=0))
        total = bends.min(axis=0)
    path = list(np.unravel_index(total.argmin(), total.shape))
    for step in reversed(back):
        path.insert(0, int(step[path[0], path[1]]))
    return choices[path, np.arange(len(values))]


def _datasets(problem):
    return zip(problem.channels, problem.datasets, strict=True)


def _by_wavelength(problem, coefficients):
    """Return the mean square of the residuals at each wavelength."""
    square = problem.residual(coefficients) ** 2
    total, count = np.zeros((2, len(problem.wavelength)))
    for (channel, dataset), rows in zip(_datasets(problem), problem.segments, strict=True):
        total[dataset.bins] += square[rows].reshape(channel.shape).sum(axis=(0, 2))
        count[dataset.bins] += 2 * channel.valid.sum(axis=1)
    return total / np.maximum(count, 1)


def _branches(problem, slots, coefficients, bad):
    """Yield starts at which wavelengths are as their neighbours say, with one sign or another."""
    smooth = {}
    for slot in slots:
        values = coefficients[problem.slices[slot.name]]
        # a retardance is known up to a turn
        good = np.unwrap(values[~bad]) if slot.unit == u.deg else values[~bad]
        smooth[slot.name] = np.interp(problem.wavelength, problem.wavelength[~bad], good)
    angles = [slot.name for slot in slots if slot.unit == u.deg]
    for flipped in dict.fromkeys([(), tuple(angles), *((name,) for name in angles)]):
        start = coefficients.copy()
        for slot in slots:
            where, value = problem.slices[slot.name], smooth[slot.name]
            value = -value if slot.name in flipped else value
            if slot.name in angles:
                value = _within(value, problem.low[where], problem.high[where])
            start[where] = np.where(bad, value, start[where])
        yield np.clip(start, problem.low, problem.high)
    own = coefficients.copy()
    for name in angles:
        where = problem.slices[name]
        turned = _within(-own[where], problem.low[where], problem.high[where])
        own[where] = np.where(bad, turned, own[where])
    yield np.clip(own, problem.low, problem.high)


def _within(angle, low, high):
    """Return an angle, radian, moved by a turn where that brings it within its bounds."""
    turn = 2 * np.pi
    angle = np.where((angle < low) & (angle + turn <= high), angle + turn, angle)
    return np.where((angle > high) & (angle - turn >= low), angle - turn, angle)
