# Licensed under a 3-clause BSD style license - see LICENSE
r"""
What changed over the years, and when: the course of every optic through many calibrations.

Each calibration says what it knows of an optic by its values and its information, the inverse of
its covariance in the directions that all determine. Five courses are compared by their evidence:
constant; steps between runs (a partition of the runs into stretches of one value each, Barry &
Hartigan 1993, doi:10.1080/01621459.1993.10594323); a drift in proportion to the date; a random
walk; and a scatter from run to run. A deviation from the common value follows a law in wavelength,
of one, or three numbers per parameter, or is free. Its size is unknown within three orders of
magnitude and averaged over, in units of the error of one run (Zellner's g-prior).
"""

from itertools import pairwise

import numpy as np
from astropy.table import Table
from astropy.time import Time

from astropolcal.calibration.fit.evidence import (
    COURSES,
    LAWS,
    SIZES,
    chances_of,
    law_of,
    log_evidence,
)
from astropolcal.exceptions import ParameterError
from astropolcal.pipeline.history import compared, named_by_date, optics_of

__all__ = ["courses"]

# prior of a partition into stretches, of which most are one; the others share the rest
_PARTITION = 0.7
# a change between two runs is thought this probable beforehand
_CHANGE = 0.05
# a direction less certain than this share of the most certain one tells nothing
_RANK = 1e-12


def courses(calibrations, parameters=None, *, events=()):
    """
    Return what each optic did through a series of calibrations, and when it changed.

    Parameters
    ----------
    calibrations : Library or sequence
        See `parameter_history`; at least three, each with a date of its own and data of its own.
    parameters : sequence of str, optional
        Optics or parameters that are judged one by one; by default all optics that are free in
        all calibrations.
    events : sequence of str or `~astropy.time.Time`
        Dates at which something was done to the instrument: a change there is as probable
        beforehand as none.

    Returns
    -------
    `~astropy.table.Table`
        One row per optic: ``what``; ``course``, the most probable of constant, steps, drift, walk
        and scatter; the probability of each; ``change``, the probability of a step between each
        calibration and the next (n - 1 numbers); ``n_open``, the directions that one of the
        calibrations does not determine; they take no part.
        ``meta["calibrations"]`` and ``meta["dates"]`` name the runs.

    Raises
    ------
    FitError
        If two calibrations share a dataset.
    ParameterError
        If there are fewer than three, one has no date or that of another, two events lie in the
        same gap, an event is not a date, or a parameter is not free in all of them.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.pipeline import courses
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> years = []
    >>> for i in range(4):
    ...     truth = chain.copy()
    ...     truth["hwp"].theta = 0.5 * (i > 1) * u.deg
    ...     table = simulate(truth, charis.wavelength, frames, seed=i,
    ...                      meta={"date": f"202{i + 5}-03-01"})
    ...     years.append(calibrate(chain, table, cross_validate=False))
    >>> found = courses(years, ["hwp"])
    >>> str(found["course"][0]), found["change"][0].round(2).tolist()
    ('steps', [0.0, 1.0, 0.0])
    """
    named = named_by_date(calibrations)
    if len(named) < 3:
        raise ParameterError(f"{len(named)} calibrations: at least three are needed for a course")
    dates = _dates(named)
    priors = chances_of(dates, events, _CHANGE)
    rows = [_course(named, what, dates, priors) for what in parameters or optics_of(named)]
    table = Table(rows=[row for row in rows if row is not None])
    table.meta |= {"calibrations": [name for name, _ in named], "dates": dates.isot.tolist()}
    return table


def _dates(named):
    from astropolcal.calibration.result.calibration import validity_of

    told = [validity_of(calibration).valid_from for _, calibration in named]
    for (name, _), date in zip(named, told, strict=True):
        if date is None:
            raise ParameterError(f"{name} has no date: when it changed cannot be said")
    for (one, first), (other, second) in pairwise(zip((n for n, _ in named), told, strict=True)):
        if first == second:
            raise ParameterError(f"{one} and {other} are both of {first}: neither comes first")
    return Time(told, scale="tai")


def _course(named, what, dates, priors):
    """Return the row of an optic, None where nothing of it is determined."""
    found = compared(named, [what])
    series = Series.of(found, dates.mjd)
    if series is None:
        return None
    evidence, change = series.weigh(priors)
    chance = np.exp(evidence - np.logaddexp.reduce(evidence))
    row = {"what": what, "course": COURSES[int(np.argmax(chance))]}
    row |= dict(zip(COURSES, chance, strict=True))
    return row | {"change": change, "n_open": found.n_open}


class Series:
    """Deviations of the runs from a common value, and their information, for some laws."""

    def __init__(self, deviations, weights, laws, mjd):
        self.deviations, self.weights, self.laws = deviations, weights, laws
        span = np.ptp(mjd)
        #: Date from -1 to 1, and time since the run before in units of the mean gap.
        self.time = 2 * (mjd - mjd[0]) / span - 1
        self.steps = np.diff(mjd, prepend=mjd[0]) * (len(mjd) - 1) / span

    @classmethod
    def of(cls, found, mjd):
        """Return the series of what was compared, None where there is nothing."""
        total = sum(found.covariances)
        if not total.size:
            return None
        variance, vectors = np.linalg.eigh(total)
        kept = vectors[:, variance > _RANK * variance.max()]
        if not kept.size:
            return None
        weights = np.array([np.linalg.inv(kept.T @ c @ kept) for c in found.covariances])
        points = np.array([kept.T @ v for v in found.values])
        middle = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, points))
        laws = []
        for count in LAWS:
            law = kept.T @ found.basis @ (law_of(found.names, count) / found.steps[:, None])
            # orthonormal, and without what the kept directions do not know
            left, size, _ = np.linalg.svd(law, full_matrices=False)
            laws.append(left[:, size > 1e-6 * size.max(initial=1e-300)])
        # a law that spans the same as one before is the same
        spans = {law.shape[1]: law for law in reversed(laws) if law.shape[1]}
        return cls(points - middle, weights, list(spans.values()), mjd)

    def weigh(self, priors):
        """Return the log evidence of each course, and the probability of a change in each gap."""
        parts, changes = [], []
        for law in self.laws:
            gram = law.T @ self.weights @ law
            target = np.einsum("ik,nij,nj->nk", law, self.weights, self.deviations)
            # unit information of one run: the g-prior then is a multiple of unity
            root = np.linalg.inv(np.linalg.cholesky(gram.mean(axis=0)))
            gram, target = root @ gram @ root.T, target @ root.T
            for size in SIZES:
                one, change = self._partitions(gram, target, size, priors)
                line = np.stack([np.ones(len(gram)), self.time], axis=1)
                drift = _regressed(gram, target, line, size)
                runs = zip(gram, target, strict=True)
                scatter = sum(log_evidence(*run, size) for run in runs)
                parts.append([*one, drift, self._walk(gram, target, size), scatter])
                changes.append(change)
        parts, n = np.array(parts), len(parts)
        share = np.log([1.0, 1.0, *[(1 - _PARTITION) / 3] * 3])
        share[:2] = np.log(_PARTITION)
        evidence = np.logaddexp.reduce(parts, axis=0) - np.log(n) + share
        # a step is a step only as far as neither a drift nor a walk explains it
        weight = np.exp(parts[:, 1] - np.log(n) + share[1] - np.logaddexp.reduce(evidence))
        return evidence, np.asarray(changes).T @ weight

    def _partitions(self, gram, target, size, priors):
        """
        Return the log evidence of one stretch, and of more, and the chance of a change in each gap.

        By dynamic programming over the ends of stretches; the chance is that among partitions of
        more than one stretch.
        """
        n = len(gram)
        grams, targets = (np.concatenate([0 * x[:1], np.cumsum(x, axis=0)]) for x in (gram, target))
        stretch = np.full((n + 1, n + 1), -np.inf)
        for i in range(n):
            for j in range(i + 1, n + 1):
                stretch[i, j] = log_evidence(grams[j] - grams[i], targets[j] - targets[i], size)
        change, stay = np.log(priors), np.log1p(-priors)
        quiet = np.concatenate([[0.0], np.cumsum(stay)])
        # within a stretch no gap changes
        for i in range(n):
            for j in range(i + 1, n + 1):
                stretch[i, j] += quiet[j - 1] - quiet[i]
        ahead, behind = np.full(n + 1, -np.inf), np.full(n + 1, -np.inf)
        ahead[0] = behind[n] = 0.0
        for j in range(1, n + 1):
            before = [ahead[i] + (change[i - 1] if i else 0.0) for i in range(j)]
            ahead[j] = np.logaddexp.reduce(np.array(before) + stretch[:j, j])
        for i in range(n - 1, -1, -1):
            after = [behind[j] + (change[j - 1] if j < n else 0.0) for j in range(i + 1, n + 1)]
            behind[i] = np.logaddexp.reduce(np.array(after) + stretch[i, i + 1 :])
        one = stretch[0, n]
        more = ahead[n] + np.log1p(-min(np.exp(one - ahead[n]), 1 - 1e-15))
        chance = np.exp(ahead[1:n] + behind[1:n] + change - more)
        return (one, more), np.clip(chance, 0.0, 1.0)

    def _walk(self, gram, target, size):
        """Return the log evidence of a random walk, which begins anywhere."""
        k = gram.shape[1]
        mean, spread, total = np.zeros(k), size**2 * np.eye(k), 0.0
        # the walk reaches the size over the whole series
        pace = size**2 / len(gram)
        for own, aim, step in zip(gram, target, self.steps, strict=True):
            spread = spread + pace * step * np.eye(k)
            # aim is W (x - middle); about the mean that is foreseen
            surprise = aim - own @ mean
            gain = np.linalg.inv(np.eye(k) + spread @ own) @ spread
            total += 0.5 * surprise @ gain @ surprise + mean @ aim - 0.5 * mean @ own @ mean
            total -= 0.5 * np.linalg.slogdet(np.eye(k) + spread @ own)[1]
            mean, spread = mean + gain @ surprise, gain
        return total


def _regressed(gram, target, waves, size):
    """Return the log evidence of deviations in proportion to functions of the run, (n, m)."""
    k = target.shape[1]
    both = np.einsum("na,nb,nij->aibj", waves, waves, gram).reshape(2 * k, 2 * k)
    return log_evidence(both, np.einsum("na,ni->ai", waves, target).ravel(), size)
