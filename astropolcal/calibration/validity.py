# Licensed under a 3-clause BSD style license - see LICENSE
"""For what a calibration holds: instrument, mode, dates, optics in the beam; and its hash."""

import warnings
from dataclasses import asdict, dataclass, replace

import astropy.units as u
import numpy as np
from astropy.time import Time

from astropolcal import instruments
from astropolcal.chain import leaves
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    CalibrationFileError,
    InstrumentError,
    ParameterError,
)
from astropolcal.instruments import Instrument
from astropolcal.observations.pointings import offline
from astropolcal.observations.reading import stated_date
from astropolcal.units import iso_date

__all__ = ["Validity", "content_hash", "validity_of", "with_validity"]

_STATED = ("mode", "valid_from", "valid_until", "optics_in")
# how a caller states what headers lack, where a command has no option for it
_WAYS = {"date": "date= states it", "mode": "mode={}"}


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
    >>> from astropolcal.calibration import Validity
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
    """
    Return for what a calibration holds.

    What was stated with `with_validity` counts. Of the rest, mode, start (the first
    date) and optics come from the datasets that it was made from.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Returns
    -------
    Validity

    Raises
    ------
    CalibrationFileError
        If what was stated makes no sense, or the date of a dataset is not one.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> from astropolcal.calibration import validity_of
    >>> night = SimpleNamespace(meta={"date": "2025-10-05", "mode": "J"}, source="star", name="n")
    >>> print(validity_of(SimpleNamespace(settings={}, instrument="lab", datasets=[night])))
    lab, J, from 2025-10-05 on, optics in the beam not known
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


def check_frames(calibration, frames, name, *, max_age=None, light="sky", ways=None, dates=True):
    """
    Refuse frames for which a calibration does not hold, and warn if it is old for some.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    frames : sequence of (str, str or `~astropy.time.Time`, str)
        What to call each frame, when it was taken (UTC) and its mode; None where not known.
    name : str
        What to call the calibration.
    max_age : `~astropy.units.Quantity`, optional
        Age from which on there is a warning; by default that of the instrument, and none where
        the end of the validity was stated.
    light : {"sky", "internal"}
        Whether the light passed the telescope, whose mirrors may have changed.
    ways : dict of str to str, optional
        What the caller can do about a missing ``date`` or ``mode``, and an ``other date``, in
        words.
    dates : bool
        Whether the dates matter, or only the mode.

    Raises
    ------
    CalibrationFileError
        If the calibration holds for other dates or another mode, a frame lacks what would tell,
        or the instrument has changed in between.

    Warns
    -----
    AstropolcalWarning
        If the calibration is too old; once, for the frame that is furthest from its data.
    """
    held, ways = validity_of(calibration), _WAYS if ways is None else ways
    dated = dates and (held.valid_from is not None or held.valid_until is not None)
    moments = {}
    for label, date, mode in frames:
        _check_mode(held, label, mode, name, ways["mode"].format(repr(held.mode)))
        if dated and date is None:
            raise CalibrationFileError(
                f"{label}: its date is not known, and {name} holds for {held}; {ways['date']}"
            )
        if dated:
            moment = _moment(date, "date")
            if not held._spans(moment):
                raise CalibrationFileError(
                    f"{label} was taken {moment}, but {name} holds for {held}"
                    f"{ways.get('other date', '')}"
                )
            moments.setdefault(moment, label)
    days = _dates(calibration) or ([held.valid_from] if held.valid_from else [])
    if not (moments and days):
        return
    changes = _changes(calibration, light)
    if held.valid_from and held.valid_from > days[-1]:
        # who states that it holds from a later day on vouches for what changed until then
        changes = [change for change in changes if held.valid_from[:10] < change[1]]
    for moment, label in moments.items():
        _check_changes(changes, days, moment[:10], f"{label}, {name}", ways["date"])
    # (n_moments, n_days), in days
    apart = np.abs((_time(list(moments))[:, None] - _time(days)).to_value(u.day)).min(axis=1)
    limit, worst = _max_age(max_age, held, instrument_of(calibration)), apart.argmax()
    if apart[worst] > limit:
        moment = list(moments)[worst]
        warnings.warn(
            f"{moments[moment]} was taken {moment}, {apart[worst] / 365.25:.1f} yr from the data "
            f"of {name} ({' to '.join(dict.fromkeys((days[0], days[-1])))}); a calibration counts "
            f"as old after {limit:g} d (max_age), and what has changed since is not in its errors",
            AstropolcalWarning,
            stacklevel=3,
        )


def _check_mode(held, label, mode, name, way):
    if held.mode is None:
        return
    if mode is None:
        raise CalibrationFileError(
            f"{label}: its mode is not known, and {name} holds for {held}; {way} states it"
        )
    if _folded(mode) != _folded(held.mode):
        raise CalibrationFileError(
            f"{label} is in mode {mode!r}, but {name} holds for {held}; if it is the same by "
            f"another name, {way} says so"
        )


def _folded(text):
    return " ".join(str(text).split()).casefold()


def _changes(calibration, light):
    """Return the dated changes of the instrument that matter to light on its way."""
    instrument = instrument_of(calibration)
    if instrument is None:
        return []
    own = {leaf.name for chain in calibration.chains for leaf in leaves(chain)}
    # a published telescope of the right epoch stands in where none was calibrated
    renewed = "date" in instrument.sky_options
    return [
        change
        for change in instrument.changes
        if change[0] is None or (light == "sky" and (change[0] in own or not renewed))
    ]


def _check_changes(changes, days, day, label, way):
    """Refuse a day between which and all days of the data the instrument has changed."""
    for _, first, last, words in changes:
        spans = [sorted([old[:10], day]) for old in days]
        # on an unknown day from first on and before last; ISO dates compare as text
        if all(lo < last and hi >= first and not (first <= lo and hi < last) for lo, hi in spans):
            raise CalibrationFileError(
                f"{label}: {words} between the data of the calibration "
                f"({' to '.join(dict.fromkeys((days[0][:10], days[-1][:10])))}) and {day}; "
                f"calibrate anew, or {way}"
            )


def _max_age(max_age, held, instrument):
    """Return the age in days from which on a calibration is old."""
    if max_age is None:
        # who states an end has thought of it
        if held.valid_until is not None:
            return np.inf
        max_age = Instrument.max_age if instrument is None else instrument.max_age
    try:
        days = float(u.Quantity(max_age).to_value(u.day))
    except (TypeError, u.UnitConversionError):
        days = np.nan
    if not days >= 0:
        raise ParameterError(f"max_age = {max_age!r}; a time is needed, such as 1 yr")
    return days


def _dates(calibration):
    """Return the dates of a calibration's data, the oldest first."""
    return sorted(day for record in calibration.datasets if (day := _first_day(record)))


def _time(moments):
    """Return ISO texts as `~astropy.time.Time`, without a word on leap seconds to come."""
    with offline():
        return Time(moments, format="isot", scale="utc")


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
        ``mode``, ``valid_from``, ``valid_until``, ``optics_in`` of `Validity`; what is left
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
    >>> from astropolcal.calibration import validity_of, with_validity
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


def content_hash(calibration):
    """
    Return the SHA-256 of all that a calibration file keeps, the ``checksum`` of the file.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Returns
    -------
    str
        64 hexadecimal digits; the same after writing and reading.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import content_hash
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(content_hash(cal))
    64
    """
    from astropolcal.converters.calibration import node_from_calibration

    return node_from_calibration(calibration)["checksum"]
