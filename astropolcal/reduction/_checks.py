# Licensed under a 3-clause BSD style license - see LICENSE
"""Arguments of a simulation of images, each refused with its name, value and what is allowed."""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad

# milliarcsecond in a degree, the unit of a layout's pixel scale
_MAS_PER_DEG = 3.6e6


def choice(name, value, allowed):
    """Refuse a word that is not among those allowed."""
    if value not in allowed:
        raise ParameterError(f"{name} = {value!r}; allowed are {', '.join(allowed)}")


def number(name, value, *, least=0.0, above=-np.inf, most=np.inf):
    """Return a number within its bounds, of which ``above`` is itself not allowed."""
    value = float(value)
    # NaN compares as false and is refused as well
    if not (np.isfinite(value) and least <= value <= most and value > above):
        bounds = f"above {above:g}" if above > least or above == least else f"{least:g} and above"
        raise ParameterError(f"{name} = {value:g}; allowed is {bounds}, up to {most:g}")
    return value


def per_wavelength(name, value, n_wavelengths):
    """Return numbers that are not negative, one a wavelength, shape (W,)."""
    value = np.asarray(value, dtype=float)
    if value.shape not in ((), (n_wavelengths,)) or not np.all(np.isfinite(value) & (value >= 0)):
        raise ParameterError(
            f"{name} = {value}; allowed are numbers not negative, of shape () or ({n_wavelengths},)"
        )
    return np.broadcast_to(value, (n_wavelengths,))


def pixels(name, value, layout, n_wavelengths, least=0.5):
    """Return a length on the detector in pixels, one a wavelength."""
    # a plain number, and a Quantity without a unit, are pixels already
    if isinstance(value, u.Quantity) and value.unit is not u.dimensionless_unscaled:
        if value.unit.is_equivalent(u.pix):
            value = value.to_value(u.pix)
        else:
            value = np.rad2deg(angle_to_rad(value, name)) * _MAS_PER_DEG / layout.pixel_scale
    value = per_wavelength(name, value, n_wavelengths)
    if value.min() < least:
        raise ParameterError(f"{name} = {value.min():g} pixels; allowed are {least:g} and above")
    return value
