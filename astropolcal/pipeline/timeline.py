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
from astropolcal.pipeline.headers import date_of
from astropolcal.pipeline.history import compared, named_by_date, optics_of

__all__ = ["courses"]

# prior of a partition into stretches, of which most are one; the others share the rest
_PARTITION = 0.7
# a change between two runs is thought this probable beforehand
_CHANGE = 0.05


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
    told = [date_of(calibration) for _, calibration in named]
    for i, ((name, _), date) in enumerate(zip(named, told, strict=True)):
        if date is None:
            raise ParameterError(f"{name} has no date: when it changed cannot be said")
        if i and date == told[i - 1]:
            raise ParameterError(
                f"{named[i - 1][0]} and {name} are both of {date}: neither comes first"
            )
    dates = Time(told, scale="tai")
    priors = chances_of(dates, events, _CHANGE)
    rows = []
    for what in parameters or optics_of(named):
        found = compared(named, [what])
        if not found.slopes.size:
            # nothing of it is determined
            continue
        evidence, change = _weighed(found, dates.mjd, priors)
        chance = np.exp(evidence - np.logaddexp.reduce(evidence))
        row = {"what": what, "course": COURSES[int(np.argmax(chance))]}
        row |= dict(zip(COURSES, chance, strict=True))
        rows.append(row | {"change": change, "n_open": found.n_open})
    table = Table(rows=rows)
    table.meta |= {"calibrations": [name for name, _ in named], "dates": dates.isot.tolist()}
    return table


def _weighed(found, mjd, priors):
    """Return the log evidence of each course, and the probability of a change in each gap."""
    laws = []
    for count in LAWS:
        # orthonormal, and without what the directions do not know
        left, size, _ = np.linalg.svd(
            found.slopes @ law_of(found.names, count), full_matrices=False
        )
        laws.append(left[:, size > 1e-6 * size.max(initial=1e-300)])
    # a law that spans the same as one before is the same
    laws = {law.shape[1]: law for law in reversed(laws) if law.shape[1]}.values()
    # date from -1 to 1
    time = 2 * (mjd - mjd[0]) / np.ptp(mjd) - 1
    line = np.stack([np.ones(len(mjd)), time], axis=1)
    parts, changes = [], []
    for law in laws:
        gram = law.T @ found.weights @ law
        target = np.einsum("ik,nij,nj->nk", law, found.weights, found.deviations)
        # unit information of one run: the g-prior then is a multiple of unity
        root = np.linalg.inv(np.linalg.cholesky(gram.mean(axis=0)))
        gram, target = root @ gram @ root.T, target @ root.T
        k = law.shape[1]
        # deviations in proportion to functions of the run
        both = np.einsum("na,nb,nij->aibj", line, line, gram).reshape(2 * k, 2 * k)
        along = np.einsum("na,ni->ai", line, target).ravel()
        for size in SIZES:
            one, change = _partitions(gram, target, size, priors)
            scatter = log_evidence(gram, target, size).sum()
            walk = _walk(gram, target, size, mjd)
            parts.append([*one, log_evidence(both, along, size), walk, scatter])
            changes.append(change)
    parts, n = np.array(parts), len(parts)
    share = np.log([_PARTITION, _PARTITION, *[(1 - _PARTITION) / 3] * 3])
    evidence = np.logaddexp.reduce(parts, axis=0) - np.log(n) + share
    # a step is a step only as far as neither a drift nor a walk explains it
    weight = np.exp(parts[:, 1] - np.log(n) + share[1] - np.logaddexp.reduce(evidence))
    return evidence, np.asarray(changes).T @ weight


def _partitions(gram, target, size, priors):
    """
    Return the log evidence of one stretch, and of more, and the chance of a change in each gap.

    By dynamic programming over the ends of stretches; the chance is that among partitions of
    more than one stretch.
    """
    n = len(gram)
    grams, targets = (np.concatenate([0 * x[:1], np.cumsum(x, axis=0)]) for x in (gram, target))
    change, stay = np.log(priors), np.log1p(-priors)
    quiet = np.concatenate([[0.0], np.cumsum(stay)])
    stretch = np.full((n + 1, n + 1), -np.inf)
    for i in range(n):
        for j in range(i + 1, n + 1):
            own = log_evidence(grams[j] - grams[i], targets[j] - targets[i], size)
            # within a stretch no gap changes
            stretch[i, j] = own + quiet[j - 1] - quiet[i]
    # at the first and the last run a stretch begins and ends for certain
    change = np.concatenate([[0.0], change, [0.0]])
    ahead, behind = np.full(n + 1, -np.inf), np.full(n + 1, -np.inf)
    ahead[0] = behind[n] = 0.0
    for j in range(1, n + 1):
        ahead[j] = np.logaddexp.reduce(ahead[:j] + change[:j] + stretch[:j, j])
    for i in range(n - 1, -1, -1):
        behind[i] = np.logaddexp.reduce(behind[i + 1 :] + change[i + 1 :] + stretch[i, i + 1 :])
    one = stretch[0, n]
    more = ahead[n] + np.log1p(-min(np.exp(one - ahead[n]), 1 - 1e-15))
    chance = np.exp(ahead[1:n] + behind[1:n] + change[1:n] - more)
    return (one, more), np.clip(chance, 0.0, 1.0)


def _walk(gram, target, size, mjd):
    """Return the log evidence of a random walk, which begins anywhere."""
    unit = np.eye(gram.shape[1])
    mean, spread, total = np.zeros(len(unit)), size**2 * unit, 0.0
    # the walk reaches the size over the whole series, in proportion to time
    paces = size**2 * np.diff(mjd, prepend=mjd[0]) * (1 - 1 / len(mjd)) / np.ptp(mjd)
    for own, aim, pace in zip(gram, target, paces, strict=True):
        spread = spread + pace * unit
        # aim is W (x - middle); about the mean that is foreseen
        surprise = aim - own @ mean
        gain = np.linalg.inv(unit + spread @ own) @ spread
        total += 0.5 * surprise @ gain @ surprise + mean @ aim - 0.5 * mean @ own @ mean
        total -= 0.5 * np.linalg.slogdet(unit + spread @ own)[1]
        mean, spread = mean + gain @ surprise, gain
    return total
