# Licensed under a 3-clause BSD style license - see LICENSE
"""
Canonical internal units, and conversion at the door.

Outside, every quantity carries its unit. Inside, the hot path sees plain
floats: angles in radian, lengths in micrometre, everything else as a number.
"""

from functools import lru_cache

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError

__all__ = ["angle_to_rad", "canonical_factor", "canonical_unit", "length_to_um", "to_unit"]

# radian for numpy, micrometre because dispersion laws are written in it
_CANONICAL = (u.rad, u.um, u.dimensionless_unscaled)


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
