# Licensed under a 3-clause BSD style license - see LICENSE
"""
Calibrations over the years: parameters against date, what changed, and how surely.

A difference between calibrations is judged in the directions that the data of all of them
determine, without priors, which stay alike when something changes, with each full covariance,
wider where its errors rest on few settings.
Calibrations that share data are refused, because their errors are not independent. `restart` refits
what changed since a calibration, and holds the rest; as the errors of the rest are not in its own,
there is a warning where it is compared.

For the courses of optics through many calibrations, each is a few rows, its values weighted by its
information, the inverse of its covariance in the directions that all determine. Rows of all are put
together, as `calibrate_runs` does with those of tables, and its search for what varies is the same.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table
from astropy.time import Time

from astropolcal.calibration.fit.calibrate import calibrate
from astropolcal.calibration.fit.run_model import Model
from astropolcal.calibration.identifiability.sky import chain_from_sky, known_instrument
from astropolcal.calibration.noise.scatter import by_chance
from astropolcal.calibration.system import free_of, split_chain
from astropolcal.calibration.uncertainty.covariance import Covariance, full_covariance
from astropolcal.calibration.validation.targets import keep_sky_accuracy, target_accuracies
from astropolcal.chain import join, leaves, stages
from astropolcal.converters.calibration import content_hash
from astropolcal.exceptions import FitError, ParameterError, warn
from astropolcal.measurement import parameter_table
from astropolcal.measurement.parameters import declared_step, is_of, stem, ties_among
from astropolcal.observations import Observations
from astropolcal.observations.reading import SAME_WAVELENGTH
from astropolcal.pipeline.headers import date_of
from astropolcal.words import listed, p_words

__all__ = ["Change", "changes", "courses", "parameter_history", "restart"]

# a direction less certain than this share of the most certain one tells nothing
_RANK = 1e-12
# a direction shorter than this is rounding; with a sine up to that two open ones are the same
_SHORT, _TURNED = 1e-5, 0.3
# degrees by which a retardance, or an orientation, is the same again
_PERIODS = {"retardance": 360.0, "theta": 180.0}
# of a history
_COLUMNS = ("date", "calibration", "parameter", "wavelength", "value", "std", "unit", "fixed")


def named_by_date(calibrations):
    """Return (name, calibration) by date of their data; of such pairs the names stay."""
    # a library, which itself compares calibrations
    if hasattr(calibrations, "_in_force"):
        if calibrations.problems:
            path, reason = next(iter(calibrations.problems.items()))
            raise ParameterError(f"{path}: {reason}")
        # what was superseded is no other state of the instrument
        calibrations = calibrations._in_force()
    named = []
    for i, item in enumerate(calibrations):
        if isinstance(item, tuple):
            named.append(item)
            continue
        inside, path = getattr(item, "calibration", item), getattr(item, "path", None)
        name = ", ".join(r.name for r in inside.datasets) or f"calibration {i}"
        named.append((name if path is None else Path(path).name, inside))
    return sorted(named, key=lambda pair: date_of(pair[1]) or "")


def parameter_history(calibrations, parameters=None):
    """
    Return the calibrated parameters of several calibrations against their date.

    Parameters
    ----------
    calibrations : Library, or sequence of Entry, LoadedCalibration or Calibration
        In any order.
    parameters : sequence of str, optional
        ``"optic.parameter"`` or ``"optic"``; by default all that are free in one of them.

    Returns
    -------
    `~astropy.table.QTable`
        One row a calibration, parameter and wavelength: ``date`` (of its data, masked if
        it is not known), ``calibration``, ``parameter``, ``wavelength`` (nm; NaN for one value
        for all), ``value``, ``std`` (NaN where not determined or held), ``unit``, ``fixed``.
        Retardances and orientations are in the turn that is nearest to the first calibration's.

    Raises
    ------
    ParameterError
        If no calibration has a parameter of the name.

    Examples
    --------
    >>> from astropolcal.pipeline import parameter_history
    >>> from astropolcal.testing import example_calibration
    >>> years = [example_calibration(seed=i, date=f"202{i}-03-01") for i in (5, 6)]
    >>> table = parameter_history(years, ["hwp.w_sio2"])
    >>> table["date"].iso[0][:10], len(table)
    ('2025-03-01', 2)
    """
    rows = []
    for name, calibration in named_by_date(calibrations):
        date = date_of(calibration)
        for key, entry in calibration.parameter_values().items():
            held = entry["tied"] is not None
            if held if parameters is None else not is_of(key, parameters):
                continue
            grid = calibration.wavelength.to_value("nm") if entry["value"].ndim else [np.nan]
            unit, fixed = str(entry["unit"] or ""), entry["fixed"] or held
            numbers = zip(grid, *(np.ravel(entry[k]) for k in ("value", "std")), strict=True)
            rows += [(date, name, key, *number, unit, fixed) for number in numbers]
    found = {row[2] for row in rows}
    for key in parameters or ():
        if not any(is_of(name, [key]) for name in found):
            raise ParameterError(f"no calibration has a parameter {key!r}")
    if parameters is None:
        free = {row[2] for row in rows if not row[-1]}
        rows = [row for row in rows if row[2] in free]
    dates, *others = list(zip(*rows, strict=True)) or [[]] * len(_COLUMNS)
    unknown = np.array([date is None for date in dates], dtype=bool)
    time = Time([date or "2000-01-01" for date in dates], scale="utc") if rows else []
    if unknown.any():
        time[unknown] = np.ma.masked
    table, first = QTable([time, *map(list, others)], names=_COLUMNS), {}
    for row in table:
        key = row["parameter"], str(row["wavelength"])
        row["value"] = _in_turn(row["value"], first.setdefault(key, row["value"]), key[0])
    table["wavelength"] = np.asarray(table["wavelength"], dtype=float) * u.nm
    return table


def _in_turn(value, first, name):
    """Return an angle in degree in the turn that is nearest to a first one, anything else as is."""
    period = _PERIODS.get(stem(name).rpartition(".")[2])
    return value if period is None else value - period * np.round((value - first) / period)


# ---- has something changed? --------------------------------------------------------------


@dataclass
class Change:
    """
    How surely parameters differ between calibrations.

    Parameters
    ----------
    calibrations : list of str
        Their names, by date.
    parameters : list of str
        Elements that were compared, such as ``derotator.horizontal[3]``.
    chi2 : float
        Of the hypothesis that they are the same in all calibrations.
    dof : int
        Directions that all of them determine, times calibrations less one.
    p_value : float
        Probability of a larger chi-square if nothing changed.
    left_out : list of str
        Elements at a bound, which have no error.
    n_open : int
        Directions that the data of one of the calibrations do not determine, also where a prior
        does; they do not count.

    Examples
    --------
    >>> from astropolcal.pipeline import Change
    >>> print(Change(["a", "b"], ["m3.diattenuation"], 30.0, 1, 4e-8))
    m3.diattenuation: changed from a to b at 5.5 sigma (chi-square 30.0 of 1, p < 1e-6)
    """

    calibrations: list
    parameters: list
    chi2: float
    dof: int
    p_value: float
    left_out: list = field(default_factory=list)
    n_open: int = 0

    @property
    def sigma(self):
        """The probability as that of a normal deviate of two sides; 0 where nothing is known."""
        from scipy.special import ndtri_exp

        if not self.dof or self.p_value >= 1:
            return 0.0
        # half of the probability on each side of a normal deviate
        return float(-ndtri_exp(_log_p(self.chi2, self.dof) - np.log(2)))

    def __str__(self):
        names = list(dict.fromkeys(map(stem, self.parameters)))
        between = f"from {self.calibrations[0]} to {self.calibrations[-1]}"
        what = ", ".join(names) or "nothing"
        if not self.dof:
            return f"{what}: nothing that is determined in all of them to compare, {between}"
        verdict = "changed" if self.p_value < 0.00135 else "no change seen"
        return (
            f"{what}: {verdict} {between} at {self.sigma:.1f} sigma (chi-square {self.chi2:.1f} "
            f"of {self.dof}, {p_words(self.p_value)})"
        )


def _log_p(chi2, dof):
    """Return the logarithm of the probability of a larger chi-square, however small."""
    from scipy.special import gammaincc, gammaln

    p = gammaincc(dof / 2, chi2 / 2)
    # below that exp underflows, and sigma would be infinite
    if p > 1e-290:
        return np.log(p)
    half, x = dof / 2, chi2 / 2
    # the first terms of the asymptotic series, far in the tail
    return (half - 1) * np.log(x) - x - gammaln(half) + np.log1p((half - 1) / x)


def significance(calibrations, parameters=None, *, shared=False):
    """Return how surely parameters differ between two or more calibrations, a `Change`.

    The chi-square of one set of values for all, each with its covariance, in the directions that
    all determine. A fit in another mirror branch counts as a change, so start it from the earlier
    one. Those of ``shared`` data differ by less than their errors.
    """
    named = named_by_date(calibrations)
    if len(named) < 2:
        raise FitError(f"{len(named)} calibration: at least two are needed to compare")
    if not shared:
        _check_independent(named)
    found = compared(named, parameters)
    apart = found.deviations
    # of one common value for all
    chi2 = float(np.einsum("ni,nij,nj->", apart, found.weights, apart))
    dof = apart.shape[1] * (len(named) - 1)
    p = float(np.exp(_log_p(chi2, dof))) if dof else 1.0
    told = found.names, chi2, dof, p, found.left_out, found.n_open
    return Change([name for name, _ in named], *told)


@dataclass
class Compared:
    """What several calibrations say of some parameters, in the directions that all determine."""

    names: list
    left_out: list
    #: Number of directions that are open in one of the calibrations.
    n_open: int
    #: What the directions take of each parameter in its unit, (n_directions, n_names).
    slopes: np.ndarray
    #: Of each calibration from the common value, (n, n_directions), and their information.
    deviations: np.ndarray
    weights: np.ndarray


def moved(earlier, later):
    """Return by how many sigma the parameters of each optic differ, of all under ""."""
    named = [("earlier", earlier), ("later", later)]
    wanted = {"": None} | {optic: [optic] for optic in optics_of(named)}
    found = {key: significance(named, names, shared=True) for key, names in wanted.items()}
    return {key: change.sigma for key, change in found.items() if change.dof}


def shift(earlier, later):
    """Return by how much parameters differ, in their units, in what both determine."""
    found = compared([("earlier", earlier), ("later", later)])
    units = dict(zip(earlier.covariance.names, earlier.covariance.units, strict=True))
    # slopes are orthonormal per step
    squares = np.array([declared_step(units[name]) for name in found.names]) ** 2
    change = squares * ((found.deviations[1] - found.deviations[0]) @ found.slopes)
    return dict(zip(found.names, change, strict=True))


def _check_independent(named):
    """Refuse calibrations of shared data, and warn of errors that lack those of what is held."""
    seen = {}
    for i, (name, calibration) in enumerate(named):
        for record in calibration.datasets:
            other = seen.setdefault(record.content_hash, i)
            if other != i:
                raise FitError(
                    f"{named[other][0]} and {name} were both made from {record.name}: their "
                    "errors are not independent, so that a change cannot be judged"
                )
    if held := [name for name, one in named if one.settings.get("restarted")]:
        words = f"{listed(held)}: holds what another calibration found, whose errors are not in its"
        words += " own; how sure a change from or to it is, is not known"
        warn(words, stacklevel=4)


def compared(named, parameters=None):
    """Return what calibrations say of the same parameters, `Compared`."""
    spaces = [full_covariance(calibration) for _, calibration in named]
    names = _common(named, spaces, parameters)
    axes = [space._axes() for space in spaces]
    # what has no error in one of them
    stuck = {name for _, calibration in named for name in calibration.at_bound}
    for space, own in zip(spaces, axes, strict=True):
        stuck |= {space.names[i] for i in np.flatnonzero(np.abs(own.blind).any(axis=0))}
    left_out = [name for name in names if name in stuck]
    names = [name for name in names if name not in stuck]
    places = [[space.names.index(name) for name in names] for space in spaces]
    # compared is only what every calibration knows
    opens = [_left_open(calibration, a) for (_, calibration), a in zip(named, axes, strict=True)]
    opens = [o[:, p] for o, p in zip(opens, places, strict=True)]
    basis, leads = _in_one_gauge(opens, len(names))
    steps = axes[0].steps[places[0]]
    values = [_values(calibration, names) for _, calibration in named]
    # another turn is no change
    for own in values[1:]:
        turned = zip(own, values[0], names, strict=True)
        own[:] = [_in_turn(value, first, name) for value, first, name in turned]
    apart = [(own - values[0]) / steps for own in values]
    # on the way what is open turns to that of the first: half of its turn counts
    values = [(basis + lead) / 2 @ own for lead, own in zip(leads, apart, strict=True)]
    told = [(one.fit.get("model_error") or {}).get("settings") for _, one in named]
    # settings that err in one of them do so in all
    luck = by_chance(min(filter(None, told), default=None))
    known = [
        luck * (a.known * a.sigmas[:, None])[:, p] @ lead.T
        for a, p, lead in zip(axes, places, leads, strict=True)
    ]
    kept, deviations, weights = about_the_mean(values, [k.T @ k for k in known])
    slopes = kept.T @ basis / steps
    return Compared(names, left_out, len(names) - len(basis), slopes, deviations, weights)


def about_the_mean(values, covariances):
    """Return the directions that have an error, (n_values, k), deviations in them, and weights.

    The deviations are those from the common value that fits all of them best.
    """
    variance, vectors = np.linalg.eigh(sum(covariances))
    kept = vectors[:, variance > _RANK * variance.max(initial=0.0)]
    # each calibration's own covariance, in the directions that are kept
    weights = np.array([np.linalg.inv(kept.T @ c @ kept) for c in covariances])
    points = np.array([kept.T @ v for v in values])
    mean = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, points))
    return kept, points - mean, weights


def _common(named, spaces, parameters):
    """Return the elements to compare, in the order of the first calibration."""
    names = [n for n in spaces[0].names if all(n in space.names for space in spaces)]
    if parameters is not None:
        for key in parameters:
            for (name, _), space in zip(named, spaces, strict=True):
                if not any(is_of(n, [key]) for n in space.names):
                    raise ParameterError(f"{name}: no free parameter {key!r}")
        names = [n for n in names if is_of(n, parameters)]
    first, *grids = (calibration.wavelength.to_value("nm") for _, calibration in named)
    same = all(g.shape == first.shape and np.allclose(g, first, SAME_WAVELENGTH) for g in grids)
    if not same and any("[" in n for n in names):
        raise ParameterError(
            f"{named[0][0]} and the others are on different wavelengths; compare parameters "
            "common to all wavelengths"
        )
    return names


def _values(calibration, names):
    free = free_of(calibration)
    elements = dict(zip(free.names, free.start() / free.factors(), strict=True))
    # a parameter given per wavelength on a grid of one goes by its plain name
    return np.array([elements.get(n, elements.get(f"{n}[0]")) for n in names], dtype=float)


def _left_open(calibration, axes):
    """Return what the data do not determine beside what is at a bound, also where a prior does."""
    names = calibration.covariance.names
    null = np.reshape(calibration.identifiability.null_vectors, (-1, len(names)))
    if calibration.settings.get("strategy") in ("runs", "diagnosis") or not len(null):
        # its own data tell less than those of all runs, or single differences, do
        return axes.open
    held = np.isin(names, calibration.at_bound)
    return np.concatenate([axes.open, _determined(null[:, held].T, len(null)) @ null])


def _determined(rows, size):
    """Return an orthonormal basis of the directions that none of the open ones moves."""
    if not rows.size:
        return np.eye(size)
    _, singular, vectors = np.linalg.svd(rows, full_matrices=True)
    rank = int(np.sum(singular > 1e-5 * max(singular.max(initial=0.0), 1.0)))
    return vectors[rank:]


def _orthonormal(rows, least=_SHORT):
    """Return an orthonormal basis of what rows span by more than a length."""
    _, singular, vectors = np.linalg.svd(rows, full_matrices=False)
    return vectors[singular > least]


def _in_one_gauge(opens, size):
    """Return the directions that are open in no calibration, and what leads to them in each.

    What is open in two of them turns with the values of the parameters, and is the same all the
    same: each is moved along what is open in it, to where the first stands, (n_directions, size).
    """
    common, opens = np.zeros((0, size)), [_orthonormal(rows) for rows in opens]
    for own in opens:
        common = np.concatenate([common, _orthonormal(own - own @ common.T @ common, _TURNED)])
    basis = _determined(common, size)
    along = (own.T @ np.linalg.pinv(common @ own.T) @ common for own in opens)
    return basis, [basis - basis @ way for way in along]


def changes(calibrations, parameters=None):
    """
    Return what changed from each calibration to the next.

    All optics together, and each by itself, where all others may have changed as well. A change
    that only a combination of optics shows, such as that of the zeros of two stages, is in the
    first row alone; `courses` finds the optic that explains it.

    Parameters
    ----------
    calibrations : Library or sequence
        See `parameter_history`.
    parameters : sequence of str, optional
        Optics or parameters that are judged one by one; by default all optics with
        free parameters in both.

    Returns
    -------
    `~astropy.table.Table`
        One row per pair and optic, before them one of ``"all"``: ``before``, ``after``, ``what``,
        ``chi2``, ``dof``, ``p_value``, ``sigma``, ``n_open``, ``left_out``.

    Raises
    ------
    FitError
        If there are fewer than two calibrations, or two share a dataset.
    ParameterError
        If a parameter is not free in one of them, or they are on different wavelengths.

    Examples
    --------
    >>> from astropolcal.pipeline import changes
    >>> from astropolcal.testing import example_calibration
    >>> years = [example_calibration(seed=i) for i in (5, 6)]
    >>> changes(years)["what"].tolist()
    ['all', 'calibration_polarizer', 'hwp', 'derotator', 'wollaston']
    """
    named = named_by_date(calibrations)
    numbers = ("chi2", "dof", "p_value", "sigma", "n_open")
    rows = []
    for pair in pairwise(named):
        for what in parameters or ["all", *optics_of(pair)]:
            found = significance(pair, None if what == "all" else [what])
            row = {"before": pair[0][0], "after": pair[1][0], "what": what}
            row |= {key: getattr(found, key) for key in numbers}
            rows.append(row | {"left_out": len(found.left_out)})
    if not rows:
        raise FitError(f"{len(named)} calibration: at least two are needed to compare")
    return Table(rows=rows)


def optics_of(named):
    """Return the optics of which a parameter is free in all calibrations."""
    names = [calibration.covariance.names for _, calibration in named]
    common = [name for name in names[0] if all(name in own for own in names)]
    return list(dict.fromkeys(name.partition(".")[0] for name in common))


# ---- courses through many calibrations -----------------------------------------------------


def courses(calibrations, parameters=None, *, events=()):
    """
    Return what each optic did through a series of calibrations, and when it changed.

    All optics are judged together, by the fewest that explain how the calibrations differ: what one
    lamp alone may not tell apart, such as the zeros of two stages, is well known in combination. An
    optic that is given counts as constant beside what others do.

    Parameters
    ----------
    calibrations : Library or sequence
        See `parameter_history`; at least three, each with a date of its own and data of its own.
    parameters : sequence of str, optional
        Optics or parameters that are judged, where all others may have changed as well; by
        default all optics that are free in all calibrations.
    events : sequence of str or `~astropy.time.Time`
        Dates at which something was done to the instrument: a change there is as probable
        beforehand as none.

    Returns
    -------
    `~astropy.table.Table`
        As ``courses`` of `~astropolcal.calibration.RunsCalibration`, one row per optic, or per
        parameter that alone varies: ``what``; its ``course``; the ``probability`` that this is
        what varies, or that it is constant; that of each course, beside all others; ``when``,
        between which calibrations it changed (95 %); ``or``, what would explain them nearly as well
        in its place. ``meta["calibrations"]`` and ``meta["dates"]`` name the runs,
        ``meta["steps"]`` those before and after each step, row by row, with its probability and
        what may be in its place, ``meta["rivals"]`` the names of ``or``, row by row, and
        ``meta["n_open"]`` is the number of directions that one of the calibrations does not
        determine; they take no part.

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
    >>> (found,) = courses(years, ["hwp.theta"])
    >>> str(found["course"]), str(found["when"])
    ('steps', '2026-03-01 to 2027-03-01')
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
    _check_independent(named)
    found, rows, spans, rivals = compared(named, parameters), [], [], []
    if found.slopes.size:
        # something is determined in all of them
        model = Model(_Standing(found, named[0][1]), (), dates, events)
        model.search()
        rows, spans, rivals = model.courses()
    table, names = Table(rows=rows), [name for name, _ in named]
    table.meta |= {"calibrations": names, "dates": dates.isot.tolist(), "n_open": found.n_open}
    table.meta["rivals"] = rivals
    table.meta["steps"] = [
        [(names[a], names[b + 1], *told) for a, b, *told in own] for own in spans
    ]
    return table


class _Standing:
    """Calibrations as runs of which the rows stay, in what all of them determine."""

    def __init__(self, found, first):
        units = dict(zip(first.covariance.names, first.covariance.units, strict=True))
        steps = np.array([declared_step(units[name]) for name in found.names])
        size, count = len(found.names), len(found.weights)
        free = SimpleNamespace(
            names=found.names,
            steps=np.ones(size),
            bounds=lambda: (np.full(size, -np.inf), np.full(size, np.inf)),
            prior_jacobian=lambda vector: np.empty((size, 0)),
            prior_residuals=lambda vector: np.empty(0),
        )
        self.shapes, self.alone = [SimpleNamespace(free=free)] * count, [np.zeros(size)] * count
        self.rows = []
        for weight, off in zip(found.weights, found.deviations, strict=True):
            root = np.linalg.cholesky(weight).T
            rows, targets = root @ found.slopes * steps, root @ off
            # the weights know on how few settings they rest
            one = SimpleNamespace(rows=rows, targets=targets, chi2=0.0, settings=None)
            self.rows.append(one)

    def around(self, vectors):
        """Return the rows of all calibrations."""
        return self.rows


# ---- refit what changed since a calibration, and hold the rest ----


def restart(calibration, observations, free, *, chain=None, **options):
    """
    Refit only what changed: everything else keeps the values of a calibration.

    Parameters
    ----------
    calibration : Calibration or LoadedCalibration
        The old one, which is not changed.
    observations : Observations or sequence of Observations
        The new data.
    free : sequence of str
        What may have changed, ``"optic.parameter"`` or ``"optic"`` (then what is free in the old
        calibration, or all if nothing is). Optics that the old one lacks, such as a new star,
        are free as the instrument has them.
    chain : sequence of chains, optional
        One per dataset, whose optics take the values of those of the same name; by default as the
        instrument makes them, or the first of the calibration.
    **options
        Passed to ``calibrate``; by default the old observable, positions as the instrument reads
        them, and no search of other mirror branches.

    Returns
    -------
    Calibration
        With the errors of what was refitted as if what was held were exact. In the accuracy on sky
        are those of both, as errors of degree and angle.
        ``settings["restarted"]`` holds the hash and date of the old one and what was free. A
        telescope is held only where one of the tables is of a star, such as the old one's.

    Raises
    ------
    ParameterError
        If nothing of a name in ``free`` exists, or the wavelengths differ.
    FitError
        As ``calibrate``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.pipeline import restart
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> old = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> new = restart(old, simulate(chain, charis.wavelength, frames, seed=3), ["wollaston"])
    >>> {name.partition(".")[0] for name in new.covariance.names}
    {'wollaston'}
    """
    old = getattr(calibration, "calibration", calibration)
    datasets = [observations] if isinstance(observations, Observations) else list(observations)
    free = [free] if isinstance(free, str) else list(free)
    instrument = known_instrument(old.instrument)
    chains = _new_chains(old, datasets, instrument, chain)
    for name in old.settings.get("own") or ():
        if not {name, name.partition(".")[0]} & set(free):
            raise ParameterError(f"{name} has several values in the old calibration: free it, too")
    _hold(old, chains, free)
    # another mirror branch would look like a change of the instrument
    start = {"observable": old.settings["observable"], "search": False}
    start |= {"wavelength": old.wavelength, "instrument": old.instrument}
    if options.get("positions") is None and instrument is not None:
        pairs = zip(datasets, chains, strict=True)
        options["positions"] = [instrument.positions(*pair) for pair in pairs]
    # those of which the leading parameter is free
    ties = ties_among(old.ties, table := parameter_table(chains))
    start["ties"] = {n: tie for n, tie in ties.items() if not table[tie.source][0].fixed}
    new = calibrate(chains, datasets, **(start | options))
    # what is held has no error, though it was not known
    known, fitted = old.parameter_values(), {*map(stem, new.covariance.names)}
    held, before = {n for n in known if n in table} - fitted, old.settings.get("restarted", {})
    told = {"open": [n for n in known if n in held and "open" in known[n]["status"]]}
    told["open"] += [n for n in before.get("open", ()) if n in held]
    # of a telescope that no new frame was taken through nothing is in the new chains
    if not any("parallactic" in stages(c) for c in chains):
        seen = (chain_from_sky([c])[0] for c in old.chains if "parallactic" in stages(c))
        outer = {leaf.name: 0 for c in seen for leaf in split_chain(c)[0] if not leaf.stage}
        told["lost"] = [*outer] or before.get("lost")
    new.settings["restarted"] = {"from": content_hash(old), "free": free}
    told["date"] = before.get("date") or date_of(old)
    new.settings["restarted"] |= {key: value for key, value in told.items() if value}
    if held := _errors_of_held(old, held):
        missing = {"missing": ["relative", "absolute"]}
        new.fit["model_error"] = (new.fit.get("model_error") or missing) | held
        keep_sky_accuracy(new)
    return new


def _errors_of_held(old, held):
    """Return what the errors of held parameters do on sky, for ``model_error`` of the fit.

    As errors of the degree, across it, and of q and u in proportion to the intensity. What was open
    then is left out.
    """
    chains, whole = [chain.copy() for chain in old.chains], full_covariance(old)
    for name, parameters in parameter_table(chains).items():
        for parameter in parameters if name not in held else ():
            parameter.fixed = True
    kept = [i for i, name in enumerate(whole.names) if stem(name) in held]
    # one that was restarted has held others
    before = {k: x for k, x in (old.fit.get("model_error") or {}).items() if k.startswith("held_")}
    grid = {"wavelength_nm": old.wavelength.to_value(u.nm).tolist()}
    if not kept:
        return before and before | grid
    parts = {key: getattr(whole, key) for key in ("factor", "null")}
    covariance = Covariance(
        *([of[i] for i in kept] for of in (whole.names, whole.units)),
        whole.matrix[np.ix_(kept, kept)],
        **{key: rows[:, kept] for key, rows in parts.items() if rows is not None},
    )
    ties = {name: tie for name, tie in old.ties.items() if tie.source in held}
    fit = {key: old.fit[key] for key in ("sky_settings",) if key in old.fit}
    part = replace(old, chains=chains, covariance=covariance, ties=ties, fit=fit)
    tables = target_accuracies(part, [(1.0, None), (0.0, None)], open_directions="ignore")
    if not tables:
        return {}
    (s_p, turn), (absolute, _) = (
        (table["s_p"].to_value(u.one), table["s_chi"].to_value(u.rad)) for table in tables
    )
    sizes = {"along": s_p**2 - absolute**2, "across": 4 * turn**2 - absolute**2}
    found = {}
    for key, square in (sizes | {"absolute": absolute**2}).items():
        key = f"held_{key}_percent"
        square = 1e4 * np.nan_to_num(square).clip(0) + np.square(before.get(key, 0.0))
        found[key] = np.sqrt(square).tolist()
    return found | grid


def _new_chains(old, datasets, instrument, chain):
    """Return a chain a dataset with copies of the old optics in the place of those it has."""
    if chain is not None:
        chains = list(chain) if isinstance(chain, (list, tuple)) else [chain]
    elif instrument is not None:
        chains = []
        for table in datasets:
            instrument.check(table)
            options = {"wavelength": old.wavelength} | instrument.particulars(table)
            chains.append(instrument.chain(*instrument.setup(table), **options))
    else:
        chains = [old.chains[0]] * len(datasets)
    if len(chains) != len(datasets):
        raise ParameterError(f"{len(chains)} chains for {len(datasets)} datasets")
    # reversed, so that of optics in several chains the first dataset's is taken
    known = {leaf.name: leaf for chain in reversed(old.chains) for leaf in leaves(chain)}
    return [join(known.get(leaf.name, leaf).copy() for leaf in leaves(c)) for c in chains]


def _hold(old, chains, free):
    """Fix all that the old calibration knows but what is to be free."""
    known = {leaf.name for chain in old.chains for leaf in leaves(chain)}
    found = {}
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        for key in leaf.param_names:
            parameter, names = getattr(leaf, key), (leaf.name.lower(), f"{leaf.name}.{key}".lower())
            for text in (t for t in free if t.lower() in names):
                # as it was before it is held below
                found.setdefault(text, []).append((parameter, parameter.fixed))
            if leaf.name in known:
                parameter.fixed = True
    for text in free:
        if text not in found:
            names = sorted({leaf.name for chain in chains for leaf in leaves(chain)})
            raise ParameterError(f"free: no {text!r} in the chains; optics are {', '.join(names)}")
        # all of an optic of which nothing was free
        all_fixed = all(fixed for _, fixed in found[text])
        for parameter, fixed in found[text]:
            parameter.fixed = fixed and "." not in text and not all_fixed
