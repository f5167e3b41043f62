# Licensed under a 3-clause BSD style license - see LICENSE
r"""
One likelihood over many runs: what they share, what changed, and when.

A run that is linearized around its parameters is a few rows, :math:`R_r \theta_r = y_r` with unit
noise: the derivatives to its parameters in the directions that it determines, divided by how the
residuals of the run scatter in these directions. Rows of runs are simply put together, so that runs
can be worked on anywhere and memory does not grow with frames. The parameters of a run follow from
coefficients of all runs, :math:`\theta_r = A_r c`: values that all share, values of one run only
(eliminated run by run), and courses in time. The rows are made again at each solution until it
stays.

Whether an optic has a course is decided by the evidence of a step in each gap between two runs, a
drift, a random walk and a scatter against none, with all shared parameters profiled out (Zellner's
g-prior in units of the error of one run, averaged over its size). Courses are added one by one, the
most probable first.
"""

import json
import os
import uuid
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.modeling import Model
from astropy.modeling.fitting import TRFLSQFitter
from astropy.table import QTable, Table
from astropy.time import Time

from astropolcal.calibration.fit.calibrate import ERRORS, standing_at
from astropolcal.calibration.fit.run_model import Model as _Coefficients
from astropolcal.calibration.fit.strategies import joint, stands_out
from astropolcal.calibration.identifiability.linearized import Whitened
from astropolcal.calibration.noise.estimates import rms
from astropolcal.calibration.noise.scatter import Scatter, model_error
from astropolcal.calibration.noise.weighting import Problem, first_weighting
from astropolcal.calibration.uncertainty.covariance import covariance_along
from astropolcal.chain import leaves
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.files import atomic_path, understood
from astropolcal.measurement import Measurement
from astropolcal.measurement.datasets import refuse_repeated
from astropolcal.measurement.parameters import stem, told_prior
from astropolcal.observations import Observations
from astropolcal.observations.reading import dates_of
from astropolcal.progress import in_one_thread, stage, steps
from astropolcal.words import check_choice, counted

__all__ = ["RunsCalibration", "calibrate_runs"]

# a run whose residuals grow by more than this beside all others does not fit to them
_WORSE = 1.2
_RANK = 1e-12


@in_one_thread
def calibrate_runs(
    chains,
    runs,
    *,
    own=(),
    vary="evidence",
    events=(),
    errors="scatter",
    executor=None,
    checkpoint=None,
    observable=None,
):
    """
    Calibrate many runs of one instrument with one likelihood, and say what changed between them.

    Parameters
    ----------
    chains : Optic, `~astropy.modeling.CompoundModel` or sequence of them
        The chain of all runs; or one of each run, or, where a run has several tables, a sequence
        for each run. Optics of the same name are the same optic in all runs.
    runs : sequence of Observations, or of sequences of Observations
        The tables of each run. Each run needs a date of its own in the meta of its tables, unless
        nothing may vary with time.
    own : sequence of str
        Optics or parameters (``"optic.parameter"``) with a value of their own in each run. What
        occurs in one run only is its own anyway.
    vary : "evidence" or dict of str to str
        Which optics or parameters vary, and how: "steps" (at the events), "drift", "walk" or
        "scatter"; all others are constant. By default the evidence decides for all optics.
    events : sequence of str or `~astropy.time.Time`
        Dates at which something was done to the instrument: a change there is as probable
        beforehand as none.
    errors : {"scatter", "white"}
        Weights and errors of the runs, as in `calibrate`.
    executor : `concurrent.futures.Executor`, optional
        Where runs are worked on, such as a ``ProcessPoolExecutor`` or, of a
        ``dask.distributed.Client``, what its ``get_executor`` returns.
    checkpoint : path-like, optional
        File that keeps the fits of single runs; an interrupted call goes on from there.
    observable : str or Observable, optional
        See `calibrate`.

    Returns
    -------
    RunsCalibration

    Raises
    ------
    FitError
        If there are fewer than two runs, nothing is free, or the runs are of different instruments
        or have different wavelengths.
    ObservationError
        If a table is given twice.
    ParameterError
        If a run has no date or that of another where something may vary with time, two events lie
        between the same two runs, or an optic, a parameter or a course is unknown.

    Examples
    --------
    A plate that was taken out and put back half a degree off:

    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import calibrate_runs
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear", wavelength=[1200, 1600, 2000] * u.nm)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> tables = []
    >>> for i in range(5):
    ...     truth = chain.copy()
    ...     truth["hwp"].theta = 0.5 * (i > 2) * u.deg
    ...     tables.append(simulate(truth, [1200, 1600, 2000] * u.nm, frames, seed=i,
    ...                            meta={"date": f"202{i}-03-01"}))
    >>> found = calibrate_runs(chain, tables)
    >>> varies = found.courses[found.courses["course"] != "constant"]
    >>> [str(varies[key][0]) for key in ("what", "course", "when")]
    ['hwp.theta', 'steps', '2022-03-01 to 2023-03-01']
    """
    check_choice("errors", errors, ERRORS, FitError)
    parts = _parts(chains, runs)
    dates = _dates(parts, needed=bool(vary))
    kept = _Checkpoint(checkpoint, [_fingerprint(*part, observable) for part in parts])
    work = _Work(parts, {"observable": observable}, errors, executor, kept)
    model = _Coefficients(work, own, dates, events)
    if vary == "evidence":
        model.search()
    elif vary:
        model.add_wanted(vary)
    rounds, converged = model.settle()
    return RunsCalibration(model, rounds, converged)


def _parts(chains, runs):
    """Return chains and tables of each run."""
    runs = [[run] if isinstance(run, Observations) else list(run) for run in runs]
    if len(runs) < 2:
        raise FitError(f"{len(runs)} run: at least two are needed; one is for calibrate")
    refuse_repeated([table for run in runs for table in run])
    chains = [chains] * len(runs) if isinstance(chains, Model) else list(chains)
    if len(chains) != len(runs):
        raise FitError(f"{len(chains)} chains for {len(runs)} runs; give one for each, or one")
    named = {o.instrument.lower() for run in runs for o in run if o.instrument is not None}
    if len(named) > 1:
        raise FitError(f"the runs are of different instruments: {', '.join(sorted(named))}")
    chains = [
        [chain] * len(run) if isinstance(chain, Model) else list(chain)
        for chain, run in zip(chains, runs, strict=True)
    ]
    return list(zip(chains, runs, strict=True))


def _dates(parts, needed):
    """Return the date of each run; None where it is not needed and one has none."""
    told = []
    for i, (_, tables) in enumerate(parts):
        days = dates_of(tables, ParameterError)
        told.append(days[0] if days else None)
        if needed and not days:
            raise ParameterError(f"run {i + 1} ({tables[0].name}) has no date in its meta")
    if None in told:
        return None
    for i, day in enumerate(told):
        if needed and day in told[:i]:
            raise ParameterError(
                f"runs {told.index(day) + 1} and {i + 1} are both of {day}: neither comes first"
            )
    return Time(told, scale="tai")


def _fingerprint(chains, tables, observable):
    """Return a text that is another where tables, optics or what is known of them are."""
    values = []
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        values.append(leaf.fingerprint())
        for p in (getattr(leaf, key) for key in leaf.param_names):
            values.append([np.ravel(p.value).tolist(), p.fixed, str(p.bounds), told_prior(p.prior)])
    known = [table.content_hash for table in tables], str(observable), values
    return uuid.uuid5(uuid.NAMESPACE_OID, json.dumps(known)).hex


class _Checkpoint:
    """Fits of single runs on disk, by fingerprint; in memory only without a path."""

    def __init__(self, path, keys):
        self.path, self.keys, self.fits = path, keys, {}
        if path is None or not os.path.exists(path):
            return
        words = "is not a checkpoint of calibrate_runs, give another file"
        with understood(path, FitError, words), open(path, encoding="utf-8") as stream:
            self.fits = json.load(stream)["fits"]
            if not all(np.isfinite(vector).all() for vector in self.fits.values()):
                raise ValueError("a value is not finite")

    def __getitem__(self, i):
        return self.fits.get(self.keys[i])

    def __setitem__(self, i, vector):
        self.fits[self.keys[i]] = np.asarray(vector).tolist()
        if self.path is not None:
            with atomic_path(self.path, FitError) as new:
                new.write_text(json.dumps({"fits": self.fits}), encoding="utf-8")


# ---- one run ----------------------------------------------------------------------------------


@dataclass
class _Rows:
    """A run around its parameters: rows and targets of unit noise, and its sum of squares.

    With the number of settings whose errors its residuals tell, None where they tell none.
    """

    rows: np.ndarray
    targets: np.ndarray
    chi2: float
    rms: float
    stands_out: bool
    settings: int | None


class _Run:
    """A run that was fitted by itself, which tells its noise and how it scatters."""

    def __init__(self, chains, tables, options, errors, start=None, known=None):
        self.measurement = measurement = Measurement(chains, tables, **options)
        measurement.note_inputs()
        if not measurement.free.size:
            raise FitError("nothing to fit: every parameter is fixed or tied")
        self.scale = measurement.free.steps
        weighting = first_weighting(measurement, None)
        if known is None:
            self._fit(start, weighting, options)
        else:
            measurement.stand_at(np.asarray(known))
        weighting = weighting.updated(measurement)
        around = Problem(measurement, weighting).around()
        weighting = weighting.updated(measurement, around)
        measurement.weighting = weighting
        is_white = errors == "white"
        self.scatter = None if is_white else Scatter.of(measurement, weighting, around)
        #: Of the fit of this run alone, canonical.
        self.fitted, self.level = measurement.vector(), weighting.level
        self.stands_out = stands_out(measurement)
        self.settings = (model_error(measurement, self.scatter, np.zeros(0)) or {}).get("settings")
        if not np.isfinite(self.level):
            raise FitError(f"{tables[0].name}: no datum is left over to tell the noise of the run")
        # noise that rounding alone makes would give a run all the weight
        self.level = max(self.level, 1e-12)

    def _fit(self, start, weighting, options):
        """Fit from the parameters of another run; where this does not do, as `calibrate` does."""
        measurement, first = self.measurement, self.measurement.vector()
        if start is not None:
            for slot in measurement.free.slots:
                if np.size(start.get(slot.name, ())) == slot.size:
                    first[slot.slice] = start[slot.name]
            first = np.clip(first, *measurement.free.bounds())
            problem = Problem(measurement, weighting.started(measurement))
            measurement.stand_at(problem.fit(first)[0])
            if not stands_out(measurement):
                return
            measurement.stand_at(measurement.free.start())
        joint(measurement, weighting, TRFLSQFitter(), True, options)

    def around(self, vector):
        """Return the rows of the run around canonical values, in steps of a degree or so."""
        residual = self.measurement.residuals(vector)
        problem = Whitened(self.measurement.jacobian(vector), self.scale)
        found = problem.data
        along = problem.rows @ found.half.T
        middle = np.eye(found.rank) * self.level**2
        if self.scatter is not None:
            middle = self.scatter.middle(along)
        variance, turn = np.linalg.eigh(middle)
        root = turn.T / np.sqrt(np.maximum(variance, _RANK * variance.max(initial=0)))[:, None]
        rows = root @ (found.singular[: found.rank, None] * found.right[: found.rank])
        targets = rows @ (vector / self.scale) + root @ (along.T @ residual)
        square = float(residual @ residual)
        told = rms(residual), self.stands_out, self.settings
        return _Rows(rows, targets, square / self.level**2, *told)


# runs that a process has prepared, by what calls for them and number
_PREPARED = {}


def _prepared(token, i, part, options, errors, start, known):
    if (token, i) not in _PREPARED:
        if _PREPARED and next(iter(_PREPARED))[0] != token:
            _PREPARED.clear()
        _PREPARED[token, i] = _Run(*part, options, errors, start, known)
    return _PREPARED[token, i]


def _fit_of(job):
    return _prepared(*job).fitted


def _rows_of(job, vector):
    return _prepared(*job).around(vector)


class _Work:
    """All runs, worked on here or by an executor."""

    def __init__(self, parts, options, errors, executor, kept):
        self.parts, self.token = parts, uuid.uuid4().hex
        self._map = map if executor is None else executor.map
        self.shapes = [Measurement(*part, **options) for part in parts]
        first, *others = (shape.wavelength for shape in self.shapes)
        if any(w.shape != first.shape or not np.allclose(w, first) for w in others):
            raise FitError("the runs have different wavelengths; select or resample them first")
        jobs = [(self.token, i, part, options, errors) for i, part in enumerate(parts)]
        stage("fitting the first run")
        if kept[0] is None:
            kept[0] = _fit_of((*jobs[0], None, None))
        free = self.shapes[0].free
        start = {slot.name: np.array(kept[0])[slot.slice] for slot in free.slots}
        todo = [i for i in range(len(jobs)) if kept[i] is None]
        found = self._map(_fit_of, [(*jobs[i], start, None) for i in todo])
        stage("fitting each run by itself")
        for i in steps(todo, "runs", len(jobs), len(jobs) - len(todo)):
            kept[i] = next(found)
        #: Parameters of each run from its own data, canonical.
        self.alone = [np.array(kept[i]) for i in range(len(jobs))]
        self.jobs = [(*job, None, fitted) for job, fitted in zip(jobs, self.alone, strict=True)]

    def around(self, vectors):
        """Return the rows of all runs around canonical values."""
        return list(steps(self._map(_rows_of, self.jobs, vectors), "runs", len(self.jobs)))


# ---- the result -------------------------------------------------------------------------------


class RunsCalibration:
    """
    What many runs share and what changed between them; `calibrate_runs` makes it.

    Attributes
    ----------
    dates : `~astropy.time.Time` or None
        Of the runs.
    courses : `~astropy.table.Table`
        One row per optic that all runs share, or its parameter: ``what``; its ``course`` in the
        model; the ``probability`` that this is what varies, or that it is constant; that of each
        course, beside all others; ``when``, between which runs it changed (95 %); ``or``, what
        would explain the data nearly as well in its place. Two runs differ by steps only. Empty
        without dates.
    runs : `~astropy.table.QTable`
        One row per run: ``date``, ``tables``, and the root mean square of its residuals with the
        parameters of all runs, ``rms``, and with those of this run alone, ``rms_alone``;
        ``stands_out``, whether that is clearly above the noise, of all data or of a wavelength.
    converged : bool
        Whether the solution stayed where it was when the runs were linearized again.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import calibrate_runs
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear", wavelength=[1200, 1600, 2000] * u.nm)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> tables = [simulate(chain, [1200, 1600, 2000] * u.nm, frames, seed=i) for i in range(2)]
    >>> found = calibrate_runs(chain, tables, vary=None)
    >>> len(found), found.converged, found.runs.colnames
    (2, True, ['date', 'tables', 'rms', 'rms_alone', 'stands_out'])
    """

    def __init__(self, model, rounds, converged):
        self._model, self.dates, self.converged = model, model.dates, converged
        self.rounds = rounds
        self.courses, self.runs = self._courses(), self._runs()

    def __len__(self):
        return len(self._model.rows)

    def __repr__(self):
        varying = self._varying()
        return f"<RunsCalibration of {len(self)} runs, varying: {', '.join(varying) or 'nothing'}>"

    def _varying(self):
        return {row["what"]: row["course"] for row in self.courses if row["course"] != "constant"}

    def _courses(self):
        if self._model.dates is None:
            return Table(names=("what", "course"), dtype=(str, str))
        return Table(rows=self._model.courses()[0])

    def _runs(self):
        model = self._model
        days = [""] * len(self) if self.dates is None else [d[:10] for d in self.dates.isot]
        return QTable(
            {
                "date": days,
                "tables": [", ".join(o.name for o in tables) for _, tables in model.work.parts],
                "rms": [100 * one.rms for one in model.rows] * u.percent,
                "rms_alone": [100 * one.rms for one in model.alone] * u.percent,
                "stands_out": [one.stands_out for one in model.rows],
            }
        )

    def values(self, name):
        """
        Return a parameter in all runs.

        Parameters
        ----------
        name : str
            ``"optic.parameter"``.

        Returns
        -------
        `~astropy.table.QTable`
            One row per run that has it: ``date``, ``value`` and ``std``, one number or one per
            wavelength; an error is NaN where the runs do not determine the parameter.

        Raises
        ------
        ParameterError
            If no run has such a free parameter.
        """
        rows = []
        for i, shape in enumerate(self._model.work.shapes):
            slot = shape.free.by_name.get(name)
            if slot is None:
                continue
            value = self._model.vectors[i][slot.slice] / slot.factor
            std = self._covariance(i).stds[slot.slice]
            date = "" if self.dates is None else self.dates[i].isot[:10]
            unit = 1 if slot.unit is None else slot.unit
            pair = [x if slot.per_wavelength else x[0] for x in (value, std)]
            rows.append((date, *(x * unit for x in pair)))
        if not rows:
            known = dict.fromkeys(stem(n) for names in self._model.names for n in names)
            raise ParameterError(f"no free parameter {name!r}; there are {', '.join(known)}")
        return QTable(rows=rows, names=("date", "value", "std"))

    def _covariance(self, i):
        """Return the covariance of a run's parameters from all runs."""
        return covariance_along(self._model.work.shapes[i].free, *self._model.errors_of(i))

    def calibration(self, run):
        """
        Return the calibration of one run, as `calibrate` does, with what all runs tell of it.

        Parameters
        ----------
        run : int
            Number of the run, from 0.

        Returns
        -------
        Calibration
            Its chains have the values of the solution of all runs, its covariance is that of all
            runs.
        """
        one, model = _prepared(*self._model.work.jobs[run]), self._model
        measurement = one.measurement
        measurement.stand_at(model.vectors[run])
        told = {"converged": self.converged, "message": f"one likelihood of {len(self)} runs"}
        standing = standing_at(
            measurement,
            told | {"evaluations": self.rounds},
            strategy="runs",
            errors="scatter" if one.scatter is not None else "white",
            fitter="calibrate_runs",
            gauge="least change from the first run",
            runs={"count": len(self), "varying": self._varying()},
        )
        return standing.calibration(covariance=self._covariance(run))

    def summary(self):
        """
        Return what changed and what did not, in words.

        Returns
        -------
        str
        """
        state = "" if self.converged else ": NOT CONVERGED, its numbers are not to be used"
        lines = [f"One likelihood of {counted(len(self), 'run')}{state}"]
        for row in self.courses:
            words = f"  {row['what']:24s} {row['course']:9s} {100 * row['probability']:5.1f} %"
            words += f", {row['when']}" if row["when"] else ""
            lines.append(words + (f"; or {row['or']}" if row["or"] else ""))
        for row in self.runs:
            name = f"  run of {row['date']}" if row["date"] else f"  run of {row['tables']}"
            if row["stands_out"]:
                lines.append(f"{name}: residuals stand out by themselves, a wrong minimum?")
            elif row["rms"] > _WORSE * row["rms_alone"]:
                lines.append(f"{name}: {row['rms']:.3f} are left, by itself {row['rms_alone']:.3f}")
        return "\n".join(lines)

    def __str__(self):
        return self.summary()
