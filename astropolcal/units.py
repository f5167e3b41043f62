# Licensed under a 3-clause BSD style license - see LICENSE
"""
Canonical internal units, and conversion of quantities, numbers and dates that come from outside.

Outside, every quantity carries its unit. Inside, the hot path sees plain
floats: angles in radian, lengths in micrometre, everything else as a number.
"""

import datetime
import re
import warnings
from functools import lru_cache

import astropy.units as u
import numpy as np
from astropy.time import Time
from erfa import ErfaWarning

from astropolcal.exceptions import ParameterError
from astropolcal.files import one_line

__all__ = []

# radian for numpy, micrometre because dispersion laws are written in it
_CANONICAL = (u.rad, u.um, u.dimensionless_unscaled)
# year, month, day, and the time of day with the minutes at least; ASCII digits only
_DATE = re.compile(
    r"((?:19|[2-9]\d)\d\d)-(\d\d?)(?:-(\d\d?)(?:[T ](\d\d?:\d\d(?::\d\d(?:\.\d*)?)?)Z?)?)?",
    re.ASCII,
)
# the same as it is kept
_ISO = re.compile(r"(19|[2-9]\d)\d\d-\d\d-\d\d(T([01]\d|2[0-3]):[0-5]\d:[0-5]\d\.\d{3})?", re.ASCII)
_COMPACT_DATE = re.compile(r"((?:19|20)\d\d)(\d\d)(\d\d)", re.ASCII)
# 1968 to 2132: no five digits mean anything else in a date
_MJD = re.compile(r"[4-9]\d{4}(\.\d*)?", re.ASCII)


def canonical_unit(unit):
    """
    Return the internal unit for quantities of the same kind as ``unit``.

    Parameters
    ----------
    unit : unit-like or None
        Any unit of angle or length, a dimensionless one, or None.

    Returns
    -------
    `~astropy.units.Unit`
        Radian, micrometre or dimensionless.

    Raises
    ------
    ParameterError
        If the unit is of another kind.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.units import canonical_unit
    >>> canonical_unit(u.deg), canonical_unit(u.mm)
    (Unit("rad"), Unit("um"))
    """
    unit = u.dimensionless_unscaled if unit is None else u.Unit(unit)
    for candidate in _CANONICAL:
        # angles count as dimensionless for astropy only under an equivalency
        if unit.is_equivalent(candidate):
            return candidate
    raise ParameterError(
        f"unit {unit} is neither an angle, a length nor dimensionless; "
        "astropolcal has no internal unit for it"
    )


def canonical_factor(unit):
    """
    Return the number by which a value in ``unit`` becomes canonical.

    Parameters
    ----------
    unit : unit-like or None
        Any unit of angle or length, a dimensionless one, or None.

    Returns
    -------
    float
        Radian, micrometre or 1 a unit.

    Raises
    ------
    ParameterError
        If the unit is of another kind.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.units import canonical_factor
    >>> float(canonical_factor(u.mm))
    1000.0
    """
    return 1.0 if unit is None else _factor(u.Unit(unit))


@lru_cache
def _factor(unit):
    # there are a handful of units, and 600 fits ask 600,000 times
    return float(unit.to(canonical_unit(unit)))


def to_unit(value, unit, name="value"):
    """
    Return ``value`` as floats in ``unit``; refuse numbers without a unit.

    Parameters
    ----------
    value : `~astropy.units.Quantity` or float or array_like
        Plain numbers are accepted only where ``unit`` is None or dimensionless.
    unit : unit-like or None
        The unit wanted.
    name : str
        What the value is called in the error message.

    Returns
    -------
    `~numpy.ndarray`
        Floats in ``unit``, of the shape of ``value``.

    Raises
    ------
    ParameterError
        If the unit is missing or cannot be converted.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.units import to_unit
    >>> float(to_unit(1.2 * u.mm, u.um))
    1200.0
    """
    unit = u.dimensionless_unscaled if unit is None else u.Unit(unit)
    # numpy would drop the imaginary part with no more than a warning
    if np.iscomplexobj(value):
        raise ParameterError(f"{name} = {value!r} is complex; allowed are real numbers")
    # parameters of astropy and columns of tables carry a unit without being quantities
    if isinstance(value, u.Quantity) or hasattr(value, "unit"):
        try:
            return np.asarray(u.Quantity(value).to_value(unit), dtype=float)
        except u.UnitConversionError:
            raise ParameterError(
                f"{name} has unit {value.unit}, which is not convertible to "
                f"{unit if unit.to_string() else 'a plain number'}"
            ) from None
    if unit != u.dimensionless_unscaled:
        raise ParameterError(f"{name} = {value!r} needs a unit such as {unit}")
    try:
        found = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} = {value!r} is not a number") from None
    # numpy makes NaN of None
    if np.isnan(found).any() and None in np.asarray(value, dtype=object).flat:
        raise ParameterError(f"{name} = {value!r} is not a number")
    return found


def angle_to_rad(value, name="angle"):
    """
    Return an angle with unit as floats in radian.

    Parameters
    ----------
    value : `~astropy.units.Quantity`
        Any angle, of any shape.
    name : str
        What the angle is called in the error message.

    Returns
    -------
    `~numpy.ndarray`
        Floats in radian, of the shape of ``value``.

    Raises
    ------
    ParameterError
        If the unit is missing or is not one of angle.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.units import angle_to_rad
    >>> round(float(angle_to_rad(180 * u.deg)), 6)
    3.141593
    """
    return to_unit(value, u.rad, name)


def length_to_um(value, name="wavelength"):
    """
    Return a length with unit as floats in micrometre.

    Parameters
    ----------
    value : `~astropy.units.Quantity`
        Any length, of any shape.
    name : str
        What the length is called in the error message.

    Returns
    -------
    `~numpy.ndarray`
        Floats in micrometre, of the shape of ``value``.

    Raises
    ------
    ParameterError
        If the unit is missing or is not one of length.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.units import length_to_um
    >>> float(length_to_um(1600 * u.nm))
    1.6
    """
    return to_unit(value, u.um, name)


def plain_number(value, kind=float):
    """
    Return a number, or the one that a text writes in ASCII digits without separators.

    Python reads ``1_000`` and digits of all scripts as numbers; no file of data means them so.

    Parameters
    ----------
    value : str or number
        The value.
    kind : callable
        What makes the number of it: `float`, `int` or `~astropy.units.Quantity`.

    Returns
    -------
    float, int or `~astropy.units.Quantity`

    Raises
    ------
    TypeError, ValueError
        If it is not a number, or written in another way.

    Examples
    --------
    >>> from astropolcal.units import plain_number
    >>> plain_number(" 1e3")
    1000.0
    >>> plain_number("1_000")
    Traceback (most recent call last):
    ...
    ValueError: '1_000' is not written as a plain number
    """
    if isinstance(value, str) and _doubtful(value):
        raise ValueError(f"{value!r} is not written as a plain number")
    return kind(value)


def _doubtful(text):
    return "_" in text or any(c.isdecimal() and not c.isascii() for c in text)


def iso_date(value, name="date", error=ParameterError, *, months=False):
    """
    Return a date in the one form in which dates are kept and compared.

    Parameters
    ----------
    value : str, number, ``datetime.date``, ``datetime.datetime`` or `~astropy.time.Time`
        In UTC: ``YYYY-MM-DD``, perhaps with a time of day, ``YYYYMMDD``, or a Modified Julian
        Date of five digits and perhaps a fraction.
    name : str
        What the date is called in the error message.
    error : type
        What to raise.
    months : bool
        Whether ``YYYY-MM`` is enough.

    Returns
    -------
    str
        ``YYYY-MM-DD``, followed by ``T`` and the time of day where it is known; or ``YYYY-MM``.

    Raises
    ------
    AstropolcalError
        Of the type given, if it is not a date, or not one of the calendar.

    Examples
    --------
    >>> from astropolcal.units import iso_date
    >>> iso_date("20251005"), iso_date(60953), iso_date("2025-10-05 09:30")
    ('2025-10-05', '2025-10-05', '2025-10-05T09:30:00.000')
    >>> iso_date("5 Oct 2025")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ParameterError: date = '5 Oct 2025' is not a date; allowed are ...
    """
    if _is_iso(value):
        return value
    try:
        with warnings.catch_warnings():
            # leap seconds of years far off are not known, and do not matter here
            warnings.simplefilter("ignore", ErfaWarning)
            return _iso_date(_date_text(value), months)
    except Exception:  # astropy raises errors of many kinds
        month = "2025-10, " if months else ""
        raise error(
            f"{name} = {one_line(repr(value), 60)} is not a date; allowed are 2025-10-05, "
            f"2025-10-05T09:30, {month}20251005 and Modified Julian Dates such as 60953"
        ) from None


def _is_iso(value):
    """Return whether it has that form already; astropy takes a hundred times as long."""
    if not isinstance(value, str) or not _ISO.fullmatch(value):
        return False
    try:
        datetime.datetime.fromisoformat(value)
    except ValueError:
        return False
    return True


def _date_text(value):
    if isinstance(value, Time) and value.isscalar:
        return value.utc.isot
    if isinstance(value, datetime.datetime) and value.tzinfo is not None:
        value = value.astimezone(datetime.UTC).replace(tzinfo=None)
    return value.isoformat() if isinstance(value, datetime.date) else str(value).strip()


def _iso_date(text, months):
    if _MJD.fullmatch(text):
        return Time(float(text), format="mjd", scale="utc").isot.removesuffix("T00:00:00.000")
    found = _COMPACT_DATE.fullmatch(text) or _DATE.fullmatch(text)
    year, month, day, clock = (*found.groups(), None)[:4] if found else [None] * 4
    if month is None or (day is None and not months):
        raise ValueError
    hour, _, rest = (clock or "0:00").partition(":")
    # astropy knows the calendar
    whole = Time(f"{year}-{int(month):02d}-{int(day or 1):02d}T{int(hour):02d}:{rest}", scale="utc")
    return whole.isot[: 7 if day is None else 10 if clock is None else None]
