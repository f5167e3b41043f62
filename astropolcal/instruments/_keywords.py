# Licensed under a 3-clause BSD style license - see LICENSE
"""Values of header keywords in the units of a file layout."""

import warnings

import astropy.units as u
from astropy.io.fits import VerifyError
from astropy.io.fits.card import Undefined
from astropy.time import Time
from erfa import ErfaWarning

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
    """Return the first keyword that holds a value for a column, and the value or None."""
    if column not in layout.keywords:
        return None, None
    for header in headers:
        for keyword in (layout.keywords[column], *layout.alternatives.get(column, ())):
            value = _read(header, keyword)
            if value is None or isinstance(value, Undefined):
                continue
            if str(value).strip().lower() not in _MISSING:
                return keyword, value
    return layout.keywords[column], None


def unit_of(column, layout):
    """Return the unit of a column's keyword."""
    return u.Unit(layout.units.get(column, _UNITS.get(column, "deg")))


def _read(header, keyword):
    try:
        return header.get(keyword)
    except VerifyError:
        # no number, and no text that anything answers to
        return "an unreadable card"


def convert(column, value, layout, target):
    """Return a value as a number in a unit; TypeError or ValueError if it is none."""
    factor, offset = layout.transforms.get(column, (1.0, 0.0))
    unit = unit_of(column, layout)
    return (factor * float(value) + offset) * unit.to(target)


def frame_time(header, layout):
    """
    Return when a frame was taken, None if the header does not say.

    A date alone is its midnight; TypeError or ValueError if it cannot be understood.
    """
    mjd, date, clock = (look_up([header], key, layout)[1] for key in ("mjd", "date", "time"))
    if mjd is not None:
        return in_calendar(Time(float(mjd), format="mjd", scale="utc"))
    if date is None:
        return None
    day = str(date).strip()
    if "T" not in day and clock is not None:
        day = f"{day}T{str(clock).strip()}"
    return in_calendar(Time(day, scale="utc"))


def in_calendar(time):
    """
    Return a time as it is; ErfaError, a ValueError, if it is of a day that no calendar has.

    Astropy takes any number as a day, and finds out in the first conversion only.
    """
    with warnings.catch_warnings():
        # years long before UTC was made are doubtful, but are years
        warnings.simplefilter("ignore", ErfaWarning)
        time.tai, time.isot  # noqa: B018
    return time
