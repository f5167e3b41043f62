# Licensed under a 3-clause BSD style license - see LICENSE
"""For what a calibration holds: instrument, mode, dates, optics in the beam."""

from dataclasses import asdict, dataclass, replace

from astropolcal import instruments
from astropolcal.exceptions import (
    AstropolcalError,
    CalibrationFileError,
    InstrumentError,
)
from astropolcal.observations.reading import stated_date
from astropolcal.units import iso_date

__all__ = ["Validity", "with_validity"]

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
    >>> from astropolcal.calibration.result import Validity
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
    if isinstance(optics_in, str) or not all(isinstance(s, (str, list, tuple)) for s in given):
        raise CalibrationFileError(f"optics_in = {optics_in!r}; names of optics are needed")
    if all(isinstance(name, str) for name in given):
        given = [given]
    flat = [name for names in given for name in names]
    if not all(isinstance(name, str) for name in flat) or any(isinstance(s, str) for s in given):
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
    records, dates = calibration.datasets, _dates(calibration)
    # of several modes none is that of the calibration
    modes = {record.meta.get("mode") for record in records}
    mode = modes.pop() if len(modes) == 1 else None
    derived = {
        "mode": mode if isinstance(mode, str) else None,
        "valid_from": min(dates, default=None),
        "optics_in": _optics_of(calibration) if "optics_in" not in stated else None,
    }
    return Validity(calibration.instrument, **(derived | stated))


def instrument_of(calibration):
    """Return the instrument; None without one, or for a name that somebody chose."""
    name = calibration.instrument
    try:
        return None if name is None else instruments.get(name)
    except InstrumentError:
        return None


def _dates(calibration):
    """Return the dates of a calibration's data, the oldest first."""
    return sorted(day for record in calibration.datasets if (day := _first_day(record)))


def _first_day(record):
    """Return the date of a dataset's meta, with a day; None where there is none."""
    date = stated_date(record.meta, record.name, CalibrationFileError)
    # a month alone begins on its first day
    return f"{date}-01" if date is not None and len(date) == len("2025-10") else date


def _optics_of(calibration):
    """Return the optional optics of each dataset as the instrument knows them, or None."""
    try:
        instrument = instruments.get(calibration.instrument)
        return [list(instrument.setup(record)[1]) for record in calibration.datasets]
    except AstropolcalError:
        return None


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
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import with_validity
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> validity_of(with_validity(cal, valid_from="2025-10-01", mode="JHK")).valid_from
    '2025-10-01'
    """
    unknown = sorted(set(stated) - set(_STATED))
    if unknown:
        raise CalibrationFileError(f"validity: no {unknown[0]!r}; allowed are {', '.join(_STATED)}")
    if not stated:
        return calibration
    clean = Validity(calibration.instrument, **stated).to_dict()
    new = (calibration.settings.get("validity") or {}) | {key: clean[key] for key in stated}
    changed = replace(calibration, settings=calibration.settings | {"validity": new})
    validity_of(changed)
    return changed
