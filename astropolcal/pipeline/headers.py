# Licensed under a 3-clause BSD style license - see LICENSE
"""What headers tell of frames, and whether a calibration and which of its chains hold for them."""

from contextlib import suppress

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time

from astropolcal import instruments
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.result.calibration import (
    _moment,
    beam_words,
    folded,
    optics_words,
    validity_of,
)
from astropolcal.calibration.result.verdict import faults
from astropolcal.calibration.system import split_chain
from astropolcal.chain import leaves
from astropolcal.exceptions import (
    AstropolcalError,
    CalibrationFileError,
    ChainError,
    InstrumentError,
    ObservationError,
    ParameterError,
    warn,
)
from astropolcal.files import one_line
from astropolcal.instruments import Instrument
from astropolcal.instruments.base import without_nuisance
from astropolcal.instruments.layout import (
    ANGLES,
    TEXTS,
    frame_time,
    frame_value,
    look_up,
    middle_time,
    other_system,
    unit_of,
)
from astropolcal.observations.pointings import frame_coordinate, offline, sky_angle
from astropolcal.observations.reading import dates_of, numeric_column
from astropolcal.optics.positions import PLACES

__all__ = []

_SKY = ("right_ascension", "declination")
# of what positions depend on in any layout; the number of a state counts as an angle
_UNITS = dict.fromkeys((*ANGLES, *_SKY), u.deg) | {"flc_state": u.rad}


def describe(header, instrument=None, stated=()):
    """Return ``instrument``, ``stated`` (as the header says), ``mode`` and ``date`` (ISO, UTC).

    What is not known is None; what the user has ``stated`` is not looked for.
    """
    if instrument is None:
        found = recognized(header)
    else:
        found = instruments.get(instrument) if isinstance(instrument, str) else instrument
    with suppress(InstrumentError):
        # which keyword holds the mode may depend on the mode
        found = found.configured(header)
    layout = found.files or found.headers
    if layout is None:
        return {"instrument": found.name}
    # what is stated by the user, or is the identity itself, is no contradiction
    own = _text(header, "instrument", layout)
    if "instrument" in stated or own in layout.identities:
        own = None
    header = layout.from_header(header)
    time = None if "date" in stated else _time(header, layout)
    return {
        "instrument": found.name,
        "stated": own,
        "mode": None if "mode" in stated else _text(header, "filter", layout),
        "date": None if time is None else time.isot,
    }


def _text(header, column, layout):
    """Return as text what a header says, or None."""
    value = look_up([header], column, layout)[1]
    return None if value is None else str(value).strip()


def recognized(header, known=None):
    """Return the instrument, of those that are ``known``, whose identity a header bears."""
    seen = []
    known = filter(None, map(known_instrument, instruments.names())) if known is None else known
    # each instrument looks under its own keyword, so that all of them are asked
    for instrument in known:
        layout = instrument.files or instrument.headers
        told = None if layout is None else _text(header, "instrument", layout)
        if told is None:
            continue
        if told in layout.identities or instrument.answers_to(told):
            return instrument
        seen.append(told)
    words = f"says {seen[0]!r}, which is not known" if seen else "does not say it"
    raise InstrumentError(
        f"which instrument? the header {words}; give instrument=, one of "
        f"{', '.join(instruments.names())}"
    )


def _time(header, layout, read=frame_time):
    """Return when a frame was taken, or None."""
    try:
        return read(header, layout)
    except (TypeError, ValueError) as error:
        known = (_text(header, key, layout) for key in ("mjd", "date", "time"))
        shown = " ".join(filter(None, known))
        raise CalibrationFileError(
            f"the header's date {shown!r} cannot be understood: {one_line(error)}"
        ) from None


class FrameAngles:
    """The angles of frames from their headers, as the instrument's layout of files reads them."""

    def __init__(self, headers, instrument):
        layout = instrument.files or instrument.headers
        if layout is None:
            raise InstrumentError(f"{instrument.name}: no map of header keywords; give positions")
        if not headers:
            raise ObservationError("no header: at least one frame is needed")
        self.name, self.path, self.meta = "header", None, {"instrument": instrument.name}
        self.instrument, self.source, self.mask = instrument.name, "star", np.zeros((1, 1), bool)
        self.keywords, self.n_frames = layout.keywords, len(headers)
        self._table = QTable({"frame": np.arange(self.n_frames)})
        headers = [layout.from_header(header) for header in headers]
        texts = {*TEXTS, *layout.texts}.difference(_UNITS)
        for column, keyword in layout.keywords.items():
            unit = _UNITS.get(column, unit_of(column, layout))
            if column in texts or not unit.is_equivalent(u.deg):
                continue
            values = [_angle(i, header, column, layout) for i, header in enumerate(headers)]
            missing = [i for i, value in enumerate(values) if value is None]
            # a mixture of modes, or a broken header
            if 0 < len(missing) < len(values):
                raise ObservationError(
                    f"frame {missing[0]}: no {keyword} in the header, others have it"
                )
            if not missing and str not in map(type, values):
                self._table[column] = values * unit
        #: Why no sky can be computed from the headers, or an empty text.
        self.unfit = other_system(headers)
        times = [_time(header, layout, middle_time) for header in headers]
        if not self.unfit and all(time is not None for time in times):
            self._table["time"] = Time(times)

    @property
    def frames(self):
        """One row per frame."""
        return self._table.copy()

    @property
    def frame_columns(self):
        """Names of the columns of `frames`."""
        return self._table.colnames

    def position(self, column):
        """Return an angle of every frame in radian, a moment, a place, or the number of a state."""
        if column in PLACES:
            return frame_coordinate(self, column)
        if column not in self._table.colnames:
            keyword = self.keywords.get(column)
            lacking = f"no {keyword}" if keyword else "no keyword is known for it"
            raise ObservationError(f"position of {column!r}: {lacking} in the header")
        return numeric_column(self._table, column, self.name, u.rad)


def _angle(i, header, column, layout):
    """Return an angle of frame ``i``, 0 or 1 for a state, as text what is none, or None."""
    keyword, value = look_up([header], column, layout)
    if value is None:
        return None
    try:
        if column in _SKY:
            return sky_angle(column, value)
        found = frame_value(column, keyword, value, layout)
    except ValueError as error:
        # the column of a user may hold what is no angle
        if column not in (*_UNITS, *layout.transforms) and isinstance(value, str | bool):
            return str(value)
        words = f"{column}: {one_line(error)}" if column in _SKY else error
        raise ObservationError(f"frame {i}: {words}") from None
    if column == "flc_state":
        # a word for no modulation is none
        return float(found == "B") if found else None
    return found


# ---- which of a calibration's chains the light of a frame went through ----


def inner_optics(calibration, optics_in=None, beam=None, label="the calibration"):
    """Return the optics from the first on a stage of the instrument on.

    ``optics_in`` are all optional optics in the beam, ``beam`` those known to be in it or not.
    """
    instrument, kinds = known_instrument(calibration.instrument), {}
    known = None if optics_in is None else set(optics_in)
    for record, chain in zip(calibration.datasets, calibration.chains, strict=True):
        inner = split_chain(without_nuisance(chain))[1]
        try:
            present = set(instrument.setup(record)[1])
            fits = known == present
        except (AttributeError, AstropolcalError):
            # an instrument knows which of its optics are optional; without one all may be
            present = {leaf.name for leaf in inner}
            fits = known is not None and known <= present
        if known is None:
            fits = all((name in present) == is_in for name, is_in in (beam or {}).items())
        if fits:
            # chains of the same optics share them by name, so any one stands for all
            kinds.setdefault(tuple(leaf.name for leaf in inner), inner)
    _check_own(calibration, kinds, label)
    if not kinds:
        wanted = beam_words(beam) if known is None else optics_words([tuple(sorted(known))])
        raise ChainError(f"{label}: no chain {wanted}; it holds for {validity_of(calibration)}")
    if len(kinds) > 1:
        # only what differs helps to choose
        common = set.intersection(*map(set, kinds))
        shown = [",".join(n for n in names if n not in common) or "none" for names in kinds]
        raise ChainError(
            f"{label}: which optics are in the beam? optics_in tells its chains apart: "
            f"{' or '.join(shown)}"
        )
    return next(iter(kinds.values()))


def telescope_optics(calibration, label="the calibration"):
    """Return the optics of a calibrated telescope, from the sky on; empty if there are none."""
    kinds = {}
    for chain in calibration.chains:
        outer, _ = split_chain(chain)
        # upstream of the turning of the sky stands the star itself, which is no telescope
        turns = (i for i, leaf in enumerate(outer) if leaf.stage and leaf.rotates_frame)
        start = next(turns, None)
        if start is not None:
            kinds.setdefault(tuple(leaf.name for leaf in outer[start:]), outer[start:])
    _check_own(calibration, kinds, label)
    return next(iter(kinds.values()), [])


def _check_own(calibration, kinds, label):
    """Refuse chains that differ by what has values of its own in single tables."""
    own = calibration.settings.get("own") or {}
    optic = {
        copy.partition(".")[0]: name.partition(".")[0]
        for name, copies in own.items()
        for copy in copies
    }
    if len({tuple(optic.get(name, name) for name in names) for names in kinds}) < len(kinds):
        raise ChainError(
            f"{label}: {', '.join(own)} with a value of its own in each table or group of tables: "
            "nothing tells which holds for a frame; calibrate with the tables of its night alone"
        )


def told_beam(headers, instrument, labels=None):
    """Return what headers tell of optional optics, name to whether they are in the beam."""
    found = {}
    for i, header in enumerate(headers):
        label = f"frame {i}" if labels is None else labels[i]
        for name, is_in in instrument.optics_of(header).items():
            first, before = found.setdefault(name, (label, is_in))
            if before != is_in:
                words = ("in the beam", "not") if before else ("not in the beam", "in it")
                raise ChainError(f"{name} was {words[0]} in {first}, and {words[1]} in {label}")
    return {name: is_in for name, (_, is_in) in found.items()}


def days_of(calibration):
    """Return the dates of a calibration's data, or else the start of its validity, oldest first."""
    start = validity_of(calibration).valid_from
    dates = dates_of(calibration.datasets, CalibrationFileError)
    return dates or ([] if start is None else [start])


def date_of(calibration):
    """Return from when a calibration's data are, or else from when it holds; None if not known."""
    # a change is seen by the data, whatever is stated of when they hold
    return next((_moment(day, "date") for day in days_of(calibration)), None)


def faults_of(calibration, name):
    """Return why a calibration is not usable, with a warning; what is open, the errors tell."""
    found = faults(calibration)
    if found:
        warn(f"{name}: NOT USABLE AS IT IS: {'; '.join(found)}", stacklevel=3)
    return found


def check_frames(calibration, frames, name, *, ways, max_age=None, light="sky", dates=True):
    """Refuse frames for which a calibration does not hold, and warn if it is old for some.

    ``frames`` are label, date (UTC) and mode, None where not known. ``light`` is "sky" or
    "internal"; ``ways`` says what the caller can do about a missing ``date`` or ``mode``, or an
    ``other date``.
    """
    held = validity_of(calibration)
    limit = _max_age(max_age, held, known_instrument(calibration.instrument))
    dated = dates and (held.valid_from is not None or held.valid_until is not None)
    moments, way = {}, ways["mode"].format(repr(held.mode))
    for label, date, mode in frames:
        if held.mode is not None and mode is None:
            raise CalibrationFileError(
                f"{label}: its mode is not known, and {name} holds for {held}; {way} states it"
            )
        if held.mode is not None and folded(mode) != folded(held.mode):
            raise CalibrationFileError(
                f"{label} is in mode {mode!r}, but {name} holds for {held}; if it is the same by "
                f"another name, state it by {way}"
            )
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
    days = days_of(calibration)
    if not (moments and days):
        return
    _check_changes(calibration, light, days, moments, name, ways["date"])
    # no word on leap seconds to come
    with offline():
        times, taken = (Time(texts, format="isot", scale="utc") for texts in (list(moments), days))
    # (n_moments, n_days), in days
    apart = np.abs((times[:, None] - taken).to_value(u.day)).min(axis=1)
    worst = apart.argmax()
    if apart[worst] > limit:
        moment = list(moments)[worst]
        warn(
            f"{moments[moment]} was taken {moment}, {apart[worst] / 365.25:.1f} yr from the data "
            f"of {name} ({' to '.join(dict.fromkeys((days[0], days[-1])))}); a calibration counts "
            f"as old after {limit:g} d (max_age), and what has changed since is not in its errors",
            stacklevel=3,
        )


def _check_changes(calibration, light, days, moments, name, way):
    """Refuse a day between which and all days of the data the instrument has changed."""
    instrument, held = known_instrument(calibration.instrument), validity_of(calibration)
    if instrument is None:
        return
    own = {leaf.name for chain in calibration.chains for leaf in leaves(chain)}
    # a published telescope of the right epoch stands in where none was calibrated
    renewed = "date" in instrument.sky_options
    # who states that it holds from a later day on vouches for what changed until then
    since = (held.valid_from or "")[:10] if (held.valid_from or "") > days[-1] else ""
    changes = [
        (first, last, words)
        for optic, first, last, words in instrument.changes
        if since < first and (optic is None or (light == "sky" and (optic in own or not renewed)))
    ]
    for moment, label in moments.items():
        day = moment[:10]
        spans = [sorted([old[:10], day]) for old in days]
        for first, last, words in changes:
            # on an unknown day from first on and before last; ISO dates compare as text
            if all(a < last and b >= first and not (first <= a and b < last) for a, b in spans):
                raise CalibrationFileError(
                    f"{label}, {name}: {words} between the data of the calibration "
                    f"({' to '.join(dict.fromkeys((days[0][:10], days[-1][:10])))}) and {day}; "
                    f"calibrate again, or {way}"
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
        raise ParameterError(f"max_age = {max_age}; a time from zero is needed, such as 1 yr")
    return days
