# Licensed under a 3-clause BSD style license - see LICENSE
"""
The result of a calibration: chains, errors, accuracy, posterior, provenance.

For what a calibration holds: instrument, mode, dates, optics in the beam.
"""

import warnings
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.result.summary import summary, to_dict
from astropolcal.calibration.result.verdict import verdict
from astropolcal.calibration.uncertainty.covariance import status_of
from astropolcal.calibration.validation.cross_validation import (
    accuracy_table,
    held_out_residuals,
    measurement_with,
)
from astropolcal.exceptions import AstropolcalError, CalibrationFileError, ObservationError
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.measurement.datasets import as_tables
from astropolcal.measurement.parameters import element_names
from astropolcal.observations.reading import dates_of
from astropolcal.units import iso_date
from astropolcal.words import check_choice, html

__all__ = ["Calibration", "with_validity"]

# what is known of each element of a parameter, and what is said of those without an error
_OF_ELEMENTS = ("std", "identifiable", "at_bound", "std_inward", "conditional_on", "std_released")
_UNKNOWN = (np.nan, False, False, np.nan, "", np.nan)


def _above(name):
    """Return a module of the layers above, to which some methods of a calibration lead."""
    return import_module(f"astropolcal.{name}")


@dataclass
class DatasetRecord:
    """What a calibration remembers of a dataset; masked are cells of frame and wavelength."""

    name: str
    source: str | None
    content_hash: str
    meta: dict
    n_frames: int
    n_masked: int
    accuracy: QTable | None = None


class ParameterTable(QTable):
    """A table that prints every row; of fitted values value, error, unit and status only."""

    def __str__(self):
        lines = QTable(self, copy=False)
        if "value" in self.columns:
            known = ("name", "value", "std", "unit", "status")
            lines = lines[[name for name in known if name in self.columns]]
        return "\n".join(lines.pformat(max_lines=-1, max_width=-1))


@dataclass
class Calibration:
    """
    A calibrated instrument; `calibrate` makes it, ASDF files keep it.

    Parameters
    ----------
    chains : list of `~astropy.modeling.CompoundModel`
        The calibrated chain of each dataset, sharing their optics' values.
    wavelength : `~astropy.units.Quantity`
        Grid of the parameters given per wavelength.
    covariance : Covariance
        Of the free parameters, with names and units.
    identifiability : ``Identifiability``
        Rank and null directions.
    at_bound : list of str
        Free parameters that ended at a bound.
    datasets : list of DatasetRecord
        The data of the calibration.
    settings : dict
        ``instrument``, ``observable``, ``fitter``, ``strategy``, ``weights``.
    fit : dict
        ``seconds``, ``n_data``, ``converged``, ``message``, ``evaluations``.
    ties : dict of str to Tie
        Parameters that follow others.
    stages : list of dict
        Parameter values after each step of the two-step strategy.
    measurement : Measurement or None
        The fitted model; None after reading from a file.
    provenance : dict
        Software versions and time of the fit.
    posterior : Posterior or None
        Samples of the parameters' posterior, where ``sample`` made some. A file
        keeps some of them, see `~astropolcal.calibration.posterior.Posterior.thinned`.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> cal.chain["hwp"].w_sio2.unit, len(cal.accuracy)
    (Unit("mm"), 22)
    """

    chains: list
    wavelength: u.Quantity
    covariance: object
    identifiability: object
    at_bound: list
    datasets: list
    settings: dict
    fit: dict
    ties: dict = field(default_factory=dict)
    stages: list = field(default_factory=list)
    measurement: object = None
    provenance: dict = field(default_factory=dict)
    posterior: object = None

    @property
    def chain(self):
        """The calibrated chain of the first dataset."""
        return self.chains[0]

    @property
    def instrument(self):
        """Name of the instrument, or None."""
        return self.settings.get("instrument")

    @property
    def converged(self):
        """Whether the fitter says that it has arrived."""
        return bool(self.fit.get("converged"))

    @property
    def residuals(self):
        """Residuals of all data, observed minus model, shape (n_data,).

        Raises
        ------
        CalibrationFileError
            If the calibration was read from a file, which holds no data.
        """
        return self.live_measurement().residuals()

    def live_measurement(self):
        """
        Return the fitted measurement, for what needs the data.

        Returns
        -------
        Measurement

        Raises
        ------
        CalibrationFileError
            If the calibration was read from a file, which holds no data.
        """
        if self.measurement is None:
            raise CalibrationFileError(
                "this calibration was read from a file, which holds no observations; "
                "with_observations(observations) brings back those it was made from, "
                "measurement_of(observations) predicts others"
            )
        return self.measurement

    def with_observations(self, observations, positions=None):
        """
        Return the calibration together with the data that it was made from.

        Parameters
        ----------
        observations : Observations or sequence of Observations
            All of its datasets, in any order. They are recognized by their
            content, not by their names.
        positions : dict or sequence of dict, optional
            Position of every stage for each of them, see `~astropolcal.measurement.Measurement`; by
            default as the calibration's instrument reads it, or the columns of the tables.

        Returns
        -------
        Calibration
            With ``measurement``, so that residuals, cross-validation and
            sampling work as before it was written.

        Raises
        ------
        CalibrationFileError
            If a table is missing or is none of the calibration's, or if the
            residuals are not those of the fit.

        Examples
        --------
        >>> from astropolcal import Calibration
        >>> from astropolcal.testing import example_calibration
        >>> made = example_calibration()
        >>> made.write("with_data.asdf")
        >>> data = made.measurement.datasets[0].observations
        >>> cal = Calibration.read("with_data.asdf").with_observations(data)
        >>> cal.residuals.size
        264
        """
        measurement = measurement_of_all(self, observations, positions)
        # so that a cross-validation of the new one does not change the old one's accuracies
        records = deepcopy(self.datasets)
        return replace(self, chains=measurement.chains, measurement=measurement, datasets=records)

    def measurement_of(self, observations, dataset=0, positions=None):
        """
        Return a measurement of new observations with the calibrated chain.

        Parameters
        ----------
        observations : Observations
            New frames of the same set-up.
        dataset : int
            Which of the calibration's chains is meant.
        positions : dict, optional
            Position of every stage, see `~astropolcal.measurement.Measurement`.

        Returns
        -------
        Measurement
            Not fitted: its residuals tell how well the calibration predicts.

        Examples
        --------
        >>> from astropolcal.testing import example_calibration
        >>> cal = example_calibration()
        >>> new = example_calibration(seed=3).measurement.datasets[0].observations
        >>> bool(abs(cal.measurement_of(new).residuals()).max() < 0.01)
        True
        """
        chain = self.chains[dataset]
        return measurement_with(self, chain, observations, positions, self.wavelength)

    def cross_validate(self, groups=None):
        """
        Fill ``s_cv``: refit without each derotator angle and predict it.

        Parameters
        ----------
        groups : `~numpy.ndarray` or str, optional
            Group of each datum, or what makes a group, ``"derotator"``, ``"cycle"`` (of the
            half-wave plate) or ``"dataset"``; by default its derotator angle.

        Returns
        -------
        Calibration
            Itself.
        """
        live = self.live_measurement()
        # what was left out before is no longer true, should the refits fail
        self.fit.pop("groups", None)
        if groups is not None:
            self.fit["groups"] = groups if isinstance(groups, str) else "given"
        held_out = held_out_residuals(self, groups)
        residuals = live.residuals()
        for i, record in enumerate(self.datasets):
            before, record.accuracy = record.accuracy, accuracy_table(live, i, residuals, held_out)
            # predictions of standards stay: they do not depend on what was left out
            if before is not None and "s_standard" in before.colnames:
                record.accuracy["s_standard"] = before["s_standard"]
        return self

    @property
    def accuracy(self):
        """Accuracy per wavelength of the first dataset, a `~astropy.table.QTable`."""
        return self.datasets[0].accuracy

    # ---- parameters ----------------------------------------------------------

    def parameter_values(self):
        """
        Return every parameter of every optic with all that is known of it.

        Returns
        -------
        dict of str to dict
            ``"optic.parameter"`` to ``value``, ``std`` (NaN where not determined), ``unit``,
            ``bounds``, ``fixed``, ``tied``, ``at_bound``, ``identifiable``; ``status``
            (``"determined"``, ``"by priors"``, ``"conditional"``, ``"badly determined"``,
            ``"open"``, ``"at bound"``, ``"tied"`` or ``"fixed"``); ``std_inward``, how far what is
            at a bound may go inward at one sigma; and for errors that depend on such a bound
            ``conditional_on``, the names of what is at it, and ``std_released``, the error without
            it. Arrays for parameters given per wavelength.
        """
        known = self._known()
        # chains share optics by name, and the values of the fit
        table = parameter_table(self.chains).items()
        return {name: self._describe(name, first, known) for name, (first, *_) in table}

    def _describe(self, name, parameter, known):
        # the covariance has rows of free parameters only
        known = {} if parameter.fixed or name in self.ties else known
        elements = element_names(name, np.size(parameter.value))
        columns = zip(*(known.get(element, _UNKNOWN) for element in elements), strict=True)
        columns = (np.reshape(column, np.shape(parameter.value)) for column in columns)
        entry = {
            "value": np.array(parameter.value),
            "unit": parameter.unit,
            "bounds": tuple(parameter.bounds),
            "fixed": bool(parameter.fixed),
            "tied": self.ties[name].source if name in self.ties else None,
            **dict(zip(_OF_ELEMENTS, columns, strict=True)),
        }
        return entry | {"status": status_of(entry)}

    def _known(self):
        stds, flags = self.covariance.stds, self.identifiability.identifiable
        bound, found = set(self.at_bound), self.fit.get("bounds") or {}
        inward, released = found.get("inward", {}), found.get("released", {})
        known, elsewhere = {}, self.fit.get("elsewhere") or {}
        for i, name in enumerate(self.covariance.names):
            more = released.get(name, {"without": np.nan, "slack": 0.0, "by": []})
            # the error with all bounds as exact, as independent data have it, and with none
            slack = 0.0 if self.settings.get("errors") == "white" else more["slack"]
            exact = np.sqrt(max(stds[i] ** 2 - slack**2, 0.0))
            beyond = np.hypot(exact, more["without"])
            beside = (inward.get(name, np.nan), ", ".join(more["by"]), beyond)
            std = np.hypot(stds[i], elsewhere.get(name, 0.0))
            known[name] = (std, bool(flags[i]), name in bound, *beside)
        return known

    @property
    def parameters(self):
        """
        One row a free parameter: name, value, unit, errors, status; a `~astropy.table.QTable`.

        The columns are those of `parameter_values`.
        """
        keys, rows = ("value", *_OF_ELEMENTS, "status"), []
        for name, known in self.parameter_values().items():
            if known["fixed"] or known["tied"]:
                continue
            labels, unit = element_names(name, np.size(known["value"])), str(known["unit"] or "")
            flat = (np.ravel(known[key]) for key in keys)
            rows += [(label, *row, unit) for label, *row in zip(labels, *flat, strict=True)]
        types = (str, float, float, bool, bool, float, str, float, str, str)
        table = ParameterTable(rows=rows or None, names=("name", *keys, "unit"), dtype=types)
        table["value"].info.format, table["std"].info.format = ".6g", ".3g"
        return table["name", "value", "std", "unit", "status", *_OF_ELEMENTS[1:]]

    # ---- for pipelines ---------------------------------------------------------

    @property
    def validity(self):
        """For what it holds, a ``Validity``."""
        return validity_of(self)

    def system_mueller(self, header=None, **options):
        """
        Return the system Mueller matrix of frames, with its covariance.

        Parameters
        ----------
        header : `~astropy.io.fits.Header`, mapping, or sequence of those
            Primary header of a frame, or those of several.
        **options
            See `~astropolcal.pipeline.LoadedCalibration.system_mueller`.

        Returns
        -------
        SystemMueller
        """
        return _above("pipeline.loading").load(self).system_mueller(header, **options)

    # ---- in words and files ----------------------------------------------------

    def verdict(self):
        """
        Return whether it can be used, and why not.

        Returns
        -------
        `~astropolcal.calibration.result.Verdict`
        """
        return verdict(self)

    def summary(self, full=False):
        """
        Return a text for the terminal: whether it is usable, how good, what came out.

        Parameters
        ----------
        full : bool
            Whether to add the tables per wavelength, what is not determined in
            detail, and the gauge.

        Returns
        -------
        str
        """
        return summary(self, full=full)

    def to_dict(self):
        """
        Return the summary for machines, ready for JSON.

        Returns
        -------
        dict
            The keys of ``astropolcal calibrate --json``; not-a-number as None.
        """
        return to_dict(self)

    def write(self, path, overwrite=False):
        """
        Write the calibration to an ASDF file, atomically.

        Parameters
        ----------
        path : path-like
            The file, with suffix ``.asdf``.
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        CalibrationFileError
            If the file exists, has another suffix or cannot be written.
        """
        _above("converters.files").write_calibration(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read a calibration from an ASDF file, validated.

        Parameters
        ----------
        path : path-like
            The file.

        Returns
        -------
        Calibration

        Raises
        ------
        CalibrationFileError
            If the file is missing, damaged, of another version, or not ours.
        """
        return _above("converters.files").read_calibration(path)

    def __repr__(self):
        names = ", ".join(record.name for record in self.datasets)
        sampled = "" if self.posterior is None else f", {len(self.posterior.names)} sampled"
        return (
            f"<Calibration of {self.instrument or 'an instrument'} from {names}: "
            f"{len(self.covariance)} free parameters, rank {self.identifiability.rank}{sampled}>"
        )

    def _repr_html_(self):
        return html(repr(self), self.parameters)


# ---- bring a calibration that was read from a file and its observations together again ----


# two computers agree better in s_res; stages in other positions differ by far more
_SAME_ACCURACY = 1e-3
_SHOWN = 12


def measurement_of_all(calibration, observations, positions=None):
    """Return the measurement that a calibration read from a file was fitted to.

    Tables are recognized by content, and the residuals have to be those of the fit.
    """
    given = as_tables(observations)
    positions = [positions] if isinstance(positions, dict) else positions
    if positions is not None and len(positions) != len(given):
        raise CalibrationFileError(f"{len(positions)} positions for {len(given)} tables")
    given = [_prepared(calibration, table) for table in given]
    order = _order(calibration.datasets, given)
    tables = [given[i] for i in order]
    instrument = known_instrument(calibration.instrument)
    if positions is not None:
        positions = [positions[i] for i in order]
    elif instrument is not None:
        # as the instrument reads them; else from the columns
        pairs = zip(tables, calibration.chains, strict=True)
        positions = [instrument.positions(*pair) for pair in pairs]
    # the same chains, ties and grid as in the fit: what the file holds is enough to predict
    measurement = Measurement(
        calibration.chains,
        tables,
        observable=calibration.settings["observable"],
        positions=positions,
        ties=calibration.ties,
        wavelength=calibration.wavelength,
    )
    residuals = measurement.residuals()
    for i, record in enumerate(calibration.datasets):
        if record.accuracy is None:
            continue
        found = accuracy_table(measurement, i, residuals)["s_res"].value
        stored = record.accuracy["s_res"].value
        if found.shape != stored.shape or not np.allclose(
            found, stored, rtol=_SAME_ACCURACY, equal_nan=True
        ):
            raise CalibrationFileError(
                f"{record.name}: the residuals are not those of the calibration (median s_res "
                f"{np.nanmedian(found):.4g} %, in the calibration {np.nanmedian(stored):.4g} %); "
                "if the stages were not where the table's columns say, give positions="
            )
    return measurement


def _prepared(calibration, table):
    """Return a table with the masks of the instrument, if the calibration was made with them."""
    # hashes are those of the tables as they were fitted, masks included
    wanted = {record.content_hash for record in calibration.datasets}
    instrument = known_instrument(calibration.instrument)
    if table.content_hash in wanted or instrument is None:
        return table
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            masked = instrument.prepare(table)
    except ObservationError:
        return table
    return masked if masked.content_hash in wanted else table


def _order(records, given):
    """Return which of the tables given is that of each record."""
    known = [table.content_hash for table in given]
    wanted = {record.content_hash: record.name for record in records}
    for table in given:
        if table.content_hash not in wanted:
            listed = ", ".join(f"{name} ({hash_[:_SHOWN]})" for hash_, name in wanted.items())
            raise CalibrationFileError(
                f"{table.name}: the calibration was not made from this table, whose content "
                f"hash is {table.content_hash[:_SHOWN]}; it was made from {listed}"
            )
    missing = [record for record in records if record.content_hash not in known]
    if missing:
        listed = ", ".join(f"{r.name} (content hash {r.content_hash[:_SHOWN]})" for r in missing)
        raise CalibrationFileError(f"the calibration was also made from {listed}: give that table")
    # the order of the fit, on which slices of data and residuals depend
    return [known.index(record.content_hash) for record in records]


# ---- validity ------------------------------------------------------------------------------


_STATED = ("mode", "valid_from", "valid_until", "optics_in")


@dataclass(frozen=True)
class Validity:
    """
    For what a calibration holds.

    Parameters
    ----------
    instrument : str or None
        Name of the instrument.
    mode : str or None
        Its mode, such as a filter; None for any.
    valid_from, valid_until : str, `~astropy.time.Time`, date or None
        UTC; the first moment, and the end, which is not included. None: without
        limit, and an end until a newer calibration replaces it.
    optics_in : sequence of str, sequence of those, or None
        Optional optics in the beam, one set or several; None if not known.

    Raises
    ------
    CalibrationFileError
        If a date cannot be understood or the end is not after the start.

    Examples
    --------
    >>> from astropolcal.calibration.result.calibration import Validity
    >>> validity = Validity("charis", valid_from="2025-10-01", optics_in=["nbs"])
    >>> validity.holds("2025-10-05T09:30"), validity.holds("2025-09-30")
    (True, False)
    >>> print(validity)
    charis, any mode, from 2025-10-01 on, with nbs
    """

    instrument: str | None = None
    mode: str | None = None
    valid_from: str | None = None
    valid_until: str | None = None
    optics_in: tuple | None = None

    def __post_init__(self):
        for key in ("valid_from", "valid_until"):
            object.__setattr__(self, key, _moment(getattr(self, key), key))
        object.__setattr__(self, "optics_in", optics_sets(self.optics_in))
        if self.mode is not None and not isinstance(self.mode, str):
            raise CalibrationFileError(f"mode = {self.mode!r}; text is needed")
        # ISO texts of one form compare as moments do
        if self.valid_from and self.valid_until and self.valid_until <= self.valid_from:
            raise CalibrationFileError(
                f"valid_until = {self.valid_until} is not after valid_from = {self.valid_from}"
            )

    def holds(self, date):
        """Return whether a moment (text, date or Time, UTC) is within the range."""
        return self._spans(_moment(date, "date"))

    def _spans(self, moment):
        after = self.valid_from is None or self.valid_from <= moment
        return after and (self.valid_until is None or moment < self.valid_until)

    def to_dict(self):
        """Return it as text and lists, ready for JSON."""
        sets = None if self.optics_in is None else [list(names) for names in self.optics_in]
        return asdict(self) | {"optics_in": sets}

    def __str__(self):
        start = f"from {self.valid_from}" if self.valid_from else "from any date"
        end = f"until {self.valid_until}" if self.valid_until else "on"
        return (
            f"{self.instrument or 'an instrument'}, {self.mode or 'any mode'}, {start} {end}, "
            f"{optics_words(self.optics_in)}"
        )


def optics_words(sets):
    """Return the words for sets of optics that can be taken out of the beam."""
    if sets is None:
        return "optics in the beam not known"
    return " or ".join(f"with {' + '.join(s)}" if s else "no optional optics" for s in sets)


def folded(mode):
    """Return a mode as it is compared: case and blanks do not matter."""
    return " ".join(str(mode).split()).casefold()


def beam_words(beam):
    """Return in words which optics are known to be in the beam or not."""
    told = {True: [], False: []}
    for name, is_in in sorted(beam.items()):
        told[is_in].append(name)
    parts = [f"with {' + '.join(told[True])}"] if told[True] else []
    parts += [f"without {' + '.join(told[False])}"] if told[False] else []
    return ", ".join(parts)


def _moment(value, key):
    """Return a moment as ISO text in UTC, a date alone where it is midnight."""
    if value is None:
        return None
    return iso_date(value, key, CalibrationFileError).removesuffix("T00:00:00.000")


def optics_sets(optics_in):
    """Return sets of names as sorted tuples, each once."""
    if optics_in is None:
        return None
    given = list(optics_in)
    if all(isinstance(name, str) for name in given):
        given = [given]
    known = (isinstance(s, (list, tuple)) and all(isinstance(n, str) for n in s) for s in given)
    if isinstance(optics_in, str) or not all(known):
        raise CalibrationFileError(f"optics_in = {optics_in!r}; names of optics are needed")
    # one form whatever the order, because validities are compared and hashed
    return tuple(sorted({tuple(sorted(set(names))) for names in given}))


def validity_of(calibration):
    """Return for what a calibration holds: what was stated with `with_validity`, else its datasets.

    Mode, start (the first date) and optics come from the datasets.
    """
    stated = calibration.settings.get("validity") or {}
    if not isinstance(stated, dict) or set(stated) - set(_STATED):
        raise CalibrationFileError(f"validity = {stated!r}; allowed are {', '.join(_STATED)}")
    records, dates = calibration.datasets, dates_of(calibration.datasets, CalibrationFileError)
    # of several modes none is that of the calibration
    modes = {record.meta.get("mode") for record in records}
    mode = modes.pop() if len(modes) == 1 else None
    derived = {
        "mode": mode if isinstance(mode, str) else None,
        "valid_from": min(dates, default=None),
    }
    if "optics_in" not in stated:
        # as the instrument knows those of each dataset
        with suppress(AstropolcalError):
            instrument = instruments.get(calibration.instrument)
            derived["optics_in"] = [list(instrument.setup(record)[1]) for record in records]
    return Validity(calibration.instrument, **(derived | stated))


def with_validity(calibration, **stated):
    """
    Return a calibration that states for what it holds.

    Parameters
    ----------
    calibration : Calibration
        It is not changed.
    **stated
        ``mode``, ``valid_from``, ``valid_until``, ``optics_in`` of ``Validity``; what is left
        out stays as it is.

    Returns
    -------
    Calibration

    Raises
    ------
    CalibrationFileError
        If a statement makes no sense.

    Examples
    --------
    >>> from astropolcal.calibration import with_validity
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> validity_of(with_validity(cal, valid_from="2025-10-01", mode="JHK")).valid_from
    '2025-10-01'
    """
    for key in stated:
        check_choice("validity", key, _STATED, CalibrationFileError)
    if not stated:
        return calibration
    clean = Validity(calibration.instrument, **stated).to_dict()
    new = (calibration.settings.get("validity") or {}) | {key: clean[key] for key in stated}
    changed = replace(calibration, settings=calibration.settings | {"validity": new})
    validity_of(changed)
    return changed
