# Licensed under a 3-clause BSD style license - see LICENSE
"""
Evidence that something changed between runs: in steps, by a drift, a random walk or a scatter.

Against no change, with a prior of unknown size: in units of the error of one run (Zellner's
g-prior), averaged over three orders of magnitude, and over laws in wavelength of one or three
numbers per parameter, or one per wavelength.
"""

from dataclasses import dataclass, field

import numpy as np
from astropy.time import Time

from astropolcal.exceptions import ParameterError, warn
from astropolcal.units import iso_date

__all__ = []

#: What an optic may do from run to run.
COURSES = ("constant", "steps", "drift", "walk", "scatter")
#: Courses that follow a law.
SIMPLE = ("steps", "drift")
#: Sizes of a deviation in standard errors of one run, and numbers per parameter of its law in
#: wavelength; None is one per wavelength.
SIZES, LAWS = (3.0, 10.0, 30.0, 100.0, 1000.0), (1, 3, None)
#: Prior probability of a change between two runs where something was done in between.
EVENT = 0.5
# those of a drift, a walk and a scatter each
_OTHER = 0.1
# a walk or a scatter of more numbers than this is looked for with simpler laws only
_MOST_NUMBERS = 600
_RANK = 1e-12
# a step is in the gaps that are named with this probability
_IN_SPAN = 0.95


def moment_of(when, name):
    """Return a date as a `Time` that no table of leap seconds limits: a decade ahead, too."""
    return Time(iso_date(when, name), scale="tai")


def chances_of(dates, events, usual):
    """Return the prior probability of a change in each gap between two dates, in order."""
    ordered = dates[np.argsort(dates.mjd)]
    found = np.full(len(ordered) - 1, usual)
    for event in events:
        gap = int(np.searchsorted(ordered.mjd, moment_of(event, "event").mjd)) - 1
        if not 0 <= gap < len(found):
            warn(f"event {event} is not between two of the runs, and has no part", stacklevel=3)
            continue
        if found[gap] == EVENT:
            raise ParameterError(
                f"event {event}: another one lies between {ordered[gap].isot[:10]} and "
                f"{ordered[gap + 1].isot[:10]} too; the data cannot tell them apart"
            )
        found[gap] = EVENT
    return found


def law_of(names, count):
    """Return the law in wavelength of elements such as ``hwp.theta[3]``, shape (n_names, k)."""
    stems = np.array([name.partition("[")[0] for name in names])
    columns = []
    for stem in dict.fromkeys(stems):
        own = np.flatnonzero(stems == stem)
        degree = len(own) if count is None else min(count, len(own))
        x = np.linspace(-1, 1, len(own)) if len(own) > 1 else np.zeros(1)
        block = np.zeros((len(names), degree))
        block[own] = np.polynomial.legendre.legvander(x, degree - 1)
        columns.append(block)
    return np.concatenate(columns, axis=1)


def laws_of(names):
    """Return the laws that differ, simplest first."""
    laws = [law_of(names, count) for count in LAWS]
    return list({law.shape[1]: law for law in reversed(laws)}.values())[::-1]


def log_evidence(gram, target, size):
    """Return the log evidence of a deviation against none, with a prior of unit times the size.

    Of one, (k, k), or of many, (n, k, k).
    """
    k = gram.shape[-1]
    held = gram + np.eye(k) / size**2
    fit = np.linalg.solve(held, target[..., None])[..., 0]
    gained = 0.5 * np.sum(target * fit, axis=-1)
    return gained - 0.5 * np.linalg.slogdet(held)[1] - k * np.log(size)


def waves_of(dates):
    """Return the functions of time of each course, (n_runs, k)."""
    mjd, n = dates.mjd, len(dates)
    order = np.argsort(mjd)
    after = (np.argsort(order)[:, None] > np.arange(n - 1)).astype(float)
    # the walk reaches its size over the whole series
    pace = np.sqrt(np.diff(mjd[order]) / np.ptp(mjd))
    drift = (2 * (mjd - mjd.min()) / np.ptp(mjd) - 1)[:, None]
    found = {"steps": after, "drift": drift, "walk": after * pace, "scatter": np.eye(n)}
    # of two runs all courses are one
    return found if n > 2 else {"steps": after}


@dataclass
class Deviation:
    """Normal equations of a deviation of each run, in units of the error of one run."""

    law: np.ndarray
    grams: np.ndarray
    taken: np.ndarray
    targets: np.ndarray

    @classmethod
    def of(cls, law, grams, taken, targets):
        """Return it without what no run knows; None where nothing is left.

        ``taken`` is what the parameters of all runs take of each, (n_runs, rank, k).
        """
        size, vectors = np.linalg.eigh(grams.mean(axis=0))
        kept = size > max(_RANK * size.max(initial=0.0), 0.0)
        if not kept.any():
            return None
        unit = vectors[:, kept] / np.sqrt(size[kept])
        return cls(law @ unit, unit.T @ grams @ unit, taken @ unit, targets @ unit)

    def along(self, waves, each=False):
        """Return the normal equations of functions of time, (n_runs, m), all else refitted.

        Of all together, or of ``each`` by itself, (m, k, k).
        """
        m, size = waves.shape[1], self.targets.shape[1]
        target, taken = waves.T @ self.targets, np.tensordot(waves, self.taken, axes=(0, 0))
        if each:
            gram = np.tensordot(waves**2, self.grams, axes=(0, 0))
            return gram - np.swapaxes(taken, 1, 2) @ taken, target
        gram = np.einsum("ra,rb,rij->aibj", waves, waves, self.grams, optimize=True)
        taken = np.moveaxis(taken, 0, 1).reshape(-1, m * size)
        return gram.reshape(m * size, m * size) - taken.T @ taken, target.ravel()


@dataclass(eq=False)
class Term:
    """A course: its law in wavelength, its functions of time, and the size of its prior.

    With its log evidence, and the elements (by name) of the optic that it is taken for.
    """

    course: str
    law: np.ndarray
    times: np.ndarray
    prior: float = np.inf
    gap: int | None = None
    evidence: float = 0.0
    what: str = ""
    names: tuple = ()

    @property
    def size(self):
        """Number of its coefficients."""
        return self.law.shape[1] * self.times.shape[1]


@dataclass
class Weighed:
    """Probabilities of all courses of an optic, and the tries that make them up."""

    chances: dict
    constant: float
    tries: list = field(repr=False)

    def odds_of(self, courses):
        """Return the log of how much more probable than constant some courses are together."""
        told = [one.evidence for one in self.tries if one.course in courses]
        return float(np.logaddexp.reduce(told)) - self.constant if told else -np.inf

    def best(self, courses):
        """Return the best try of the most probable of some courses."""
        course = max(courses, key=self.chances.get)
        own = [one for one in self.tries if one.course == course]
        return max(own, key=lambda one: one.evidence, default=None)

    def span(self):
        """Return the first and the last gap between runs in which a step may be (95 %)."""
        told = np.array([(t.gap, t.evidence) for t in self.tries if t.course == "steps"])
        chance = np.bincount(told[:, 0].astype(int), np.exp(told[:, 1] - told[:, 1].max()))
        chance /= chance.sum()
        first = last = int(np.argmax(chance))
        while chance[first : last + 1].sum() < _IN_SPAN:
            before, after = chance[:first].sum(), chance[last + 1 :].sum()
            first, last = (first - 1, last) if before > after else (first, last + 1)
        return first, last


def weigh(deviations, waves, chances):
    """Return the probabilities of all courses, `Weighed`; ``chances`` are those of each gap."""
    tries, base = [], 1 - 3 * _OTHER
    for deviation in deviations:
        share = -np.log(len(deviations) * len(SIZES))
        for course, times in waves.items():
            simple = course in SIMPLE
            if not simple and times.shape[1] * deviation.targets.shape[1] > _MOST_NUMBERS:
                continue
            normal = deviation.along(times, each=simple)
            prior = np.log(_OTHER if course != "steps" else base * chances / (1 - chances))
            for size in SIZES:
                found = np.atleast_1d(log_evidence(*normal, size) + share + prior)
                for gap, value in enumerate(found):
                    own = times[:, [gap]] if simple else times
                    at = gap if course == "steps" else None
                    tries.append(Term(course, deviation.law, own, size, at, float(value)))
    told = {"constant": np.log(base)} | {
        course: np.logaddexp.reduce([t.evidence for t in tries if t.course == course] or [-np.inf])
        for course in COURSES[1:]
    }
    total = np.logaddexp.reduce(list(told.values()))
    chance = {key: float(np.exp(value - total)) for key, value in told.items()}
    return Weighed(chance, told["constant"], tries)
