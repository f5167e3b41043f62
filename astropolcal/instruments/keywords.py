# Licensed under a 3-clause BSD style license - see LICENSE
"""
Values of header keywords in the units of a file layout.

Shared by all that reads headers: the reduction of cubes, the prediction for a single frame, and
instruments whose frames tell more than a column.
"""

from itertools import product

import astropy.units as u
from astropy.io.fits import VerifyError
from astropy.io.fits.card import Undefined
from astropy.time import Time

from astropolcal.observations.pointings import offline
from astropolcal.units import iso_date, plain_number

__all__ = [
    "ANGLES",
    "RANGES",
    "TEXTS",
    "convert",
    "frame_time",
    "in_calendar",
    "look_up",
    "stated",
    "unit_of",
]

#: Columns that are angles of a stage.
ANGLES = ("hwp", "hwp_true", "derotator", "parallactic", "altitude")
#: Columns that are text, whatever they look like.
TEXTS = (
    "date",
    "time",
    "right_ascension",
    "declination",
    "object",
    "instrument",
    "filter",
    "pickoff",
    "flc",
    "flc_state",
    "read_mode",
)
#: Beyond these, in degree, an angle in a header cannot be right.
RANGES = dict.fromkeys(ANGLES, (-720.0, 720.0)) | {"altitude": (0.0, 90.0)}
RANGES |= {"em_gain": (0.0, 1e5)}
# numbers without a unit
# what a layout means that gives no unit; everything else is in degree
_UNITS = {"camera": "", "em_gain": "", "exposure_time": "s"}

_MISSING = ("", "unavailable", "none", "nan", "n/a", "#")


def look_up(headers, column, layout):
    """
    Return the first keyword that holds a value for a column, and the value.

    Parameters
    ----------
    headers : sequence of `~astropy.io.fits.Header` or dict
        Where to look, in turn.
    column : str
        Column of the observation table.
    layout : FileLayout
        Its ``keywords`` and ``alternatives``.

    Returns
    -------
    keyword : str or None
        Where there is no value, the first one; None if the layout knows none.
    value : object or None
        As it stands in the header; None for what stands for no value, such as "N/A".

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments.keywords import look_up
    >>> layout = instruments.get("charis").files
    >>> look_up([{"D_IMRPAD": "N/A"}, {layout.keywords["hwp"]: 45.0}], "hwp", layout)[1]
    45.0
    """
    return next(stated(headers, column, layout), (layout.keywords.get(column), None))


def stated(headers, column, layout):
    """
    Yield all keywords that hold a value for a column, and the values, as `look_up` finds them.

    Parameters
    ----------
    headers, column, layout
        As for `look_up`.

    Yields
    ------
    keyword : str
    value : object

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments.keywords import stated
    >>> layout = instruments.get("vampires").files
    >>> list(stated([{"U_HWPANG": 45.0, "RET-ANG1": 0.0}], "hwp", layout))
    [('RET-ANG1', 0.0), ('U_HWPANG', 45.0)]
    """
    keywords = (layout.keywords.get(column), *layout.alternatives.get(column, ()))
    for header, keyword in product(headers, filter(None, keywords)):
        value = _read(header, keyword)
        if value is None or isinstance(value, Undefined):
            continue
        if str(value).strip().lower() not in _MISSING:
            yield keyword, value


def unit_of(column, layout):
    """
    Return the unit of a column's keyword.

    Parameters
    ----------
    column : str
        Column of the observation table.
    layout : FileLayout
        Its ``units``; where it gives none, an angle is in degree and a time in seconds.

    Returns
    -------
    `~astropy.units.Unit`

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments.keywords import unit_of
    >>> unit_of("altitude", instruments.get("charis").files)
    Unit("deg")
    """
    return u.Unit(layout.units.get(column, _UNITS.get(column, "deg")))


def _read(header, keyword):
    try:
        return header.get(keyword)
    except VerifyError:
        # no number, and no text that anything answers to
        return "an unreadable card"


def convert(column, value, layout, target):
    """
    Return a value of a header as a number in a unit.

    Parameters
    ----------
    column : str
        Column of the observation table.
    value : object
        As it stands in the header.
    layout : FileLayout
        Its ``transforms`` and ``units``.
    target : unit-like
        The unit wanted.

    Returns
    -------
    float

    Raises
    ------
    TypeError, ValueError
        If the value is no number.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments.keywords import convert
    >>> round(convert("altitude", "45.0", instruments.get("charis").files, "rad"), 6)
    0.785398
    """
    factor, offset = layout.transforms.get(column, (1.0, 0.0))
    unit = unit_of(column, layout)
    return (factor * plain_number(value) + offset) * unit.to(target)


def frame_time(header, layout):
    """
    Return when a frame was taken.

    Parameters
    ----------
    header : `~astropy.io.fits.Header` or dict
        Of the frame.
    layout : FileLayout
        Where its ``mjd``, or its ``date`` and ``time``, stand.

    Returns
    -------
    `~astropy.time.Time` or None
        UTC; None if the header does not say. A date alone is its midnight.

    Raises
    ------
    TypeError, ValueError
        If what the header says cannot be understood.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments.keywords import frame_time
    >>> layout = instruments.get("charis").files
    >>> frame_time({layout.keywords["mjd"]: 60982.5}, layout).isot
    '2025-11-03T12:00:00.000'
    """
    mjd, date, clock = (look_up([header], key, layout)[1] for key in ("mjd", "date", "time"))
    if mjd is not None:
        return in_calendar(Time(plain_number(mjd), format="mjd", scale="utc"))
    if date is None:
        return None
    day = iso_date(date)
    if "T" not in day and clock is not None:
        day = iso_date(f"{day}T{str(clock).strip()}")
    with offline():
        return in_calendar(Time(day, scale="utc"))


def in_calendar(time):
    """
    Return a time as it is, if a calendar has its day.

    Astropy takes any number as a day, and finds out in the first conversion only.

    Parameters
    ----------
    time : `~astropy.time.Time`
        Any.

    Returns
    -------
    `~astropy.time.Time`

    Raises
    ------
    ValueError
        ErfaError, if no calendar has the day.

    Examples
    --------
    >>> from astropy.time import Time
    >>> from astropolcal.instruments.keywords import in_calendar
    >>> in_calendar(Time(60982.5, format="mjd")).isot
    '2025-11-03T12:00:00.000'
    """
    # years long before UTC was made are doubtful, but are years
    with offline():
        time.tai, time.isot  # noqa: B018
    return time
