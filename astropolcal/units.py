# Licensed under a 3-clause BSD style license - see LICENSE
"""
Canonical internal units, and conversion of quantities, numbers and dates that come from outside.

Outside, every quantity carries its unit. Inside, the hot path sees plain
floats: angles in radian, lengths in micrometre, everything else as a number.
"""

import datetime
import re
import warnings
from contextlib import suppress
from functools import lru_cache

import astropy.units as u
import numpy as np
from astropy.time import Time
from erfa import ErfaWarning

from astropolcal.exceptions import ParameterError, WavelengthRangeError
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
_MJDS = (40000, 100000)


def canonical_unit(unit):
    """Return the internal unit of a unit: radian, micrometre or dimensionless (also for None)."""
    unit = u.dimensionless_unscaled if unit is None else u.Unit(unit)
    for candidate in _CANONICAL:
        # angles count as dimensionless for astropy only under an equivalency
        if unit.is_equivalent(candidate):
            return candidate
    raise ParameterError(
        f"unit {unit} is neither an angle, a length nor dimensionless; "
        "astropolcal has no internal unit for it"
    )


# there are a handful of units, and 600 fits ask 600,000 times
@lru_cache
def canonical_factor(unit):
    """
    Return the number by which a value in a unit, or without one (None), becomes canonical.

    What is neither angle, length nor dimensionless, such as a rate in deg / day, stays as it is.
    """
    if unit is None:
        return 1.0
    unit = u.Unit(unit)
    try:
        return float(unit.to(canonical_unit(unit)))
    except ParameterError:
        return 1.0


def to_unit(value, unit, name="value", kind=float):
    """
    Return a value as floats in a unit, NaN where masked; ``name`` is what messages call it.

    Plain numbers are accepted only where the unit is None or dimensionless, complex ones where
    the ``kind`` is complex.
    """
    unit = u.dimensionless_unscaled if unit is None else u.Unit(unit)
    # numpy would drop the imaginary part with no more than a warning
    if kind is float and np.iscomplexobj(value):
        raise ParameterError(f"{name} = {value!r} is complex; allowed are real numbers")
    # parameters of astropy and columns of tables carry a unit without being quantities
    if isinstance(value, u.Quantity) or hasattr(value, "unit"):
        try:
            return _known(np.asarray(u.Quantity(value).to_value(unit), dtype=kind), value)
        except u.UnitConversionError:
            wanted = unit.to_string() or "a plain number"
            has = f"unit {value.unit}, which is not convertible to {wanted}"
            if not str(value.unit or ""):
                has = f"no unit and needs one such as {unit}"
            raise ParameterError(f"{name} has {has}") from None
    if unit != u.dimensionless_unscaled:
        raise ParameterError(f"{name} = {value!r} needs a unit such as {unit}")
    try:
        found = np.asarray(value, dtype=kind)
    except (TypeError, ValueError):
        raise ParameterError(f"{name} = {value!r} is not a number") from None
    # numpy makes NaN of None
    if np.isnan(found).any() and None in np.asarray(value, dtype=object).flat:
        raise ParameterError(f"{name} = {value!r} is not a number")
    return _known(found, value)


def _known(found, value):
    """Return floats with NaN where the value they were made of is masked; numpy drops the mask."""
    mask = getattr(value, "mask", False)
    return np.where(mask, np.nan, found) if np.any(mask) else found


def positive_number(value, name, unit=None, zero=False):
    """Return one number above zero, or zero where that is allowed; a plain one has the unit."""
    number = to_unit(value, None if getattr(value, "unit", None) is None else unit, name)
    if number.ndim or not np.isfinite(number) or number < 0 or (number == 0 and not zero):
        allowed = "one number from zero on" if zero else "one positive number"
        allowed += "" if unit is None else f", of {unit}"
        raise ParameterError(f"{name} = {value!r} must be {allowed}")
    return float(number)


def median_of_known(values):
    """Return the median of what is not NaN as a float in the unit of the values."""
    values = np.asarray(values, dtype=float)
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else np.nan


def angle_to_rad(value, name="angle"):
    """Return an angle with unit as floats in radian."""
    return to_unit(value, u.rad, name)


def length_to_um(value, name="wavelength"):
    """Return a length with unit as floats in micrometre."""
    return to_unit(value, u.um, name)


def wavelengths_of(value, name="wavelength"):
    """Return wavelengths as a quantity of any shape; raise unless they are lengths above zero."""
    try:
        found = u.Quantity(value)
        # a masked one is not finite
        plain = length_to_um(value if hasattr(value, "unit") else found)
        good = (plain > 0) & np.isfinite(plain)
    # an error of astropy's units is a TypeError, too
    except (TypeError, ValueError, ParameterError):
        good = np.zeros(1, dtype=bool)
    if not good.size or not good.all():
        raise ParameterError(
            f"{name} = {one_line(value)} needs a unit such as nm, and finite numbers above zero"
        )
    return found


def check_range(wavelength, low, high, what, slack=1e-9):
    """
    Return wavelengths (um) as floats, or raise unless ``what`` is known at all of them.

    The ends of the range survive the conversion of their unit, by a share ``slack``.
    """
    wavelength = np.asarray(wavelength, dtype=float)
    # written so that NaN is outside
    outside = ~((wavelength >= low * (1 - slack)) & (wavelength <= high * (1 + slack)))
    if outside.any():
        raise WavelengthRangeError(
            f"{what} is known from {low:g} to {high:g} um, not at {wavelength[outside][0]:.6g} um"
        )
    return wavelength


def check_seed(seed, *, generator=True):
    """Return the seed of random numbers, plain, or raise; a ``generator`` may stand for it."""
    try:
        # draws nothing, so that a generator stays as it is
        (np.random.default_rng if generator else np.random.SeedSequence)(seed)
    except (TypeError, ValueError):
        raise ParameterError(f"seed = {seed!r}; allowed are whole numbers from 0 up") from None
    return seed.tolist() if isinstance(seed, np.integer | np.ndarray) else seed


def mjd_of(value, name="time"):
    """
    Return moments as Modified Julian Dates, UTC.

    Taken are `~astropy.time.Time` of any scale, texts of dates, and numbers in days or without a
    unit that lie where such dates do.
    """
    if isinstance(value, str | Time):
        # leap seconds of years to come are not known, and do not matter here
        with warnings.catch_warnings(action="ignore", category=ErfaWarning):
            value = Time(iso_date(value, name)) if isinstance(value, str) else value
            found = np.asarray(value.utc.mjd)
    else:
        found = to_unit(value, u.day if getattr(value, "unit", None) else None, name)
    strange = ~((found > _MJDS[0]) & (found < _MJDS[1]))
    if strange.any():
        worst = np.ravel(found)[np.argmax(strange)]
        raise ParameterError(
            f"{name} = {worst:g} is not a Modified Julian Date; allowed are {_MJDS[0]} to "
            f"{_MJDS[1]}, and Time of astropy"
        )
    return found


def plain_number(value, kind=float):
    """Return a number, or the one that a text writes in ASCII digits without separators.

    Python reads ``1_000`` and digits of all scripts as numbers; no file of data means them so. What
    makes the number of a text is ``kind``: float, int or Quantity. Raises ValueError or TypeError.
    """
    # true is 1 for Python
    text = value if isinstance(value, str) else "_" * isinstance(value, bool | np.bool_)
    if "_" in text or any(c.isdecimal() and not c.isascii() for c in text):
        raise ValueError(f"{value!r} is not written as a plain number")
    return kind(value)


def iso_date(value, name="date", error=ParameterError, *, months=False):
    """Return a date in the one form in which dates are kept and compared.

    It is ``YYYY-MM-DD``, followed by ``T`` and the time of day where it is known, or ``YYYY-MM``
    where ``months`` are enough; in UTC. Taken are texts such as these, ``YYYYMMDD``, Modified
    Julian Dates of five digits, dates of Python and `~astropy.time.Time`. What is none raises
    ``error``.
    """
    if isinstance(value, str) and _ISO.fullmatch(value):
        # astropy takes a hundred times as long
        with suppress(ValueError):
            datetime.datetime.fromisoformat(value)
            return value
    try:
        # leap seconds of years far off are not known, and do not matter here
        with warnings.catch_warnings(action="ignore", category=ErfaWarning):
            text = _date_text(value)
            if _MJD.fullmatch(text):
                return Time(float(text), format="mjd", scale="utc").isot.removesuffix(
                    "T00:00:00.000"
                )
            found = _COMPACT_DATE.fullmatch(text) or _DATE.fullmatch(text)
            year, month, day, clock = (*found.groups(), None)[:4] if found else [None] * 4
            if month is None or (day is None and not months):
                raise ValueError
            hour, _, rest = (clock or "0:00").partition(":")
            # astropy knows the calendar
            whole = Time(
                f"{year}-{int(month):02d}-{int(day or 1):02d}T{int(hour):02d}:{rest}", scale="utc"
            )
            return whole.isot[: 7 if day is None else 10 if clock is None else None]
    except Exception:  # astropy raises errors of many kinds
        month = "2025-10, " if months else ""
        raise error(
            f"{name} = {one_line(repr(value), 60)} is not a date; allowed are 2025-10-05, "
            f"2025-10-05T09:30, {month}20251005 and Modified Julian Dates such as 60953"
        ) from None


def _date_text(value):
    if isinstance(value, Time) and value.isscalar:
        return value.utc.isot
    if isinstance(value, datetime.datetime) and value.tzinfo is not None:
        value = value.astimezone(datetime.UTC).replace(tzinfo=None)
    return value.isoformat() if isinstance(value, datetime.date) else str(value).strip()
