# Licensed under a 3-clause BSD style license - see LICENSE
"""What the headers of frames tell: instrument, mode, date, and the angles of the stages."""

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time

from astropolcal import instruments
from astropolcal.exceptions import CalibrationFileError, InstrumentError, ObservationError
from astropolcal.instruments.layout import ANGLES, RANGES, TEXTS, convert, frame_time, look_up
from astropolcal.observations.reading import numeric_column
from astropolcal.units import plain_number

_SKY = ("right_ascension", "declination")
# columns that are no angles of a stage, though their values may be numbers
_OTHERS = {"exposure_time", "mjd", *TEXTS} - set(_SKY)


def describe(header, instrument=None, stated=()):
    """
    Return what a header tells of a frame.

    Parameters
    ----------
    header : `~astropy.io.fits.Header` or mapping
        Primary header.
    instrument : str or Instrument, optional
        The instrument, by default that whose identity stands in the header.
    stated : set of str
        What is not to be looked for.

    Returns
    -------
    dict
        ``instrument`` (name), ``stated`` (what the header calls it), ``mode`` and ``date`` (ISO,
        UTC); what is not told is None.
    """
    if instrument is None:
        found = _recognized(header)
    else:
        found = instruments.get(instrument) if isinstance(instrument, str) else instrument
    layout = found.files
    if layout is None:
        return {"instrument": found.name}
    # what is stated by the user, or is the identity itself, is no contradiction
    own = _look_up(header, "instrument", layout)
    if "instrument" in stated or own in layout.identities:
        own = None
    time = None if "date" in stated else _time(header, layout)
    return {
        "instrument": found.name,
        "stated": own,
        "mode": None if "mode" in stated else _text(_look_up(header, "filter", layout)),
        "date": None if time is None else time.utc.isot,
    }


def _text(value):
    return None if value is None else str(value).strip()


def _recognized(header):
    """Return the instrument whose identity a header bears."""
    seen = []
    # each instrument looks under its own keyword, so that all of them are asked
    for name in instruments.names():
        instrument = instruments.get(name)
        layout = instrument.files
        told = None if layout is None else _text(_look_up(header, "instrument", layout))
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


def _look_up(header, column, layout):
    return look_up([header], column, layout)[1]


def _time(header, layout):
    """Return when a frame was taken, or None."""
    try:
        return frame_time(header, layout)
    except (TypeError, ValueError):
        told = (_look_up(header, key, layout) for key in ("mjd", "date", "time"))
        mjd, date, clock = (_text(value) for value in told)
        shown = mjd or f"{date} {clock or ''}".strip()
        raise CalibrationFileError(f"the header's date {shown!r} cannot be understood") from None


class FrameAngles:
    """
    The angles of frames from their headers, as `~astropolcal.instruments.Instrument` reads them.

    Parameters
    ----------
    headers : list of mappings
        One a frame.
    instrument : Instrument
        With a layout of its files.

    Raises
    ------
    InstrumentError
        If the instrument has no map of keywords.
    ObservationError
        If an angle is no number, cannot be right, or is missing in some of the frames.
    """

    def __init__(self, headers, instrument):
        if instrument.files is None:
            raise InstrumentError(f"{instrument.name}: no map of header keywords; give positions")
        if not headers:
            raise ObservationError("no header: at least one frame is needed")
        self.name, self.path, self.meta = "header", None, {"instrument": instrument.name}
        self.instrument, self.source, self.mask = instrument.name, "star", np.zeros((1, 1), bool)
        self._layout = layout = instrument.files
        self.n_frames = len(headers)
        table = QTable({"frame": np.arange(self.n_frames)})
        for column in (c for c in layout.keywords if c not in _OTHERS):
            values = [_look_up(header, column, layout) for header in headers]
            if self._complete(column, values):
                table[column] = self._column(column, values)
        times = [_time(header, layout) for header in headers]
        if all(time is not None for time in times):
            table["time"] = Time(times)
        self._table = table

    @property
    def frames(self):
        """One row a frame."""
        return self._table.copy()

    def _complete(self, column, values):
        missing = [i for i, value in enumerate(values) if value is None]
        if not missing:
            return True
        # some with and some without is a mixture of modes, or a
        # broken header; none has it: not there
        if len(missing) < len(values):
            keyword = self._layout.keywords[column]
            raise ObservationError(
                f"frame {missing[0]}: no {keyword} in the header, others have it"
            )
        return False

    def _column(self, column, values):
        """Return angles as a Quantity, anything else as text."""
        if column in _SKY:
            return _sky(column, values)
        keyword, layout = self._layout.keywords[column], self._layout
        # states of a modulator, cameras and such
        if not u.Unit(layout.units.get(column, "deg")).is_equivalent(u.deg):
            return np.array([str(value).strip() for value in values])
        # two turns: encoders count on past 360 deg, but what is further out is no angle
        low, high = RANGES.get(column, (-720.0, 720.0))
        angles = []
        for i, value in enumerate(values):
            try:
                angle = convert(column, value, layout, u.deg)
            except (TypeError, ValueError):
                if column not in ANGLES:
                    return np.array([str(value).strip() for value in values])
                raise ObservationError(
                    f"frame {i}: {keyword} = {value!r}, a number is needed"
                ) from None
            if not low <= angle <= high:
                raise ObservationError(
                    f"frame {i}: {keyword} = {value}, allowed are {low:g} to {high:g} deg"
                )
            angles.append(angle)
        return angles * u.deg

    def position(self, column):
        """Return an angle of every frame in radian."""
        if column not in self._table.colnames:
            keyword = self._layout.keywords.get(column)
            lacking = f"no {keyword}" if keyword else "no keyword is known for it"
            raise ObservationError(f"position of {column!r}: {lacking} in the header")
        return numeric_column(self._table, column, self.name, u.rad)


def _sky(column, values):
    from astropy.coordinates import Angle

    try:
        numbers = [plain_number(value) for value in values]
        # plain numbers are degrees, also for the right ascension; sexagesimal ones are hours there
        return numbers * u.deg
    except (TypeError, ValueError):
        pass
    unit = u.hourangle if column == "right_ascension" else u.deg
    try:
        return u.Quantity([Angle(str(value), unit=unit).to(u.deg) for value in values])
    except ValueError as error:
        raise ObservationError(f"{column}: {' '.join(str(error).split())}") from None
