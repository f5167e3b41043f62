# Licensed under a 3-clause BSD style license - see LICENSE
"""What every function of Stokes parameters asks of its arguments."""

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import to_unit

# rounding allowed where a degree of polarization is compared with one
ROUNDING = 1e-12


def require(good, value, name, allowed):
    """Raise a ParameterError that names the first value that is not good."""
    if np.all(good):
        return
    good, value = np.broadcast_arrays(good, value)
    # argmin of booleans is the first that is False
    where = np.unravel_index(np.argmin(good), good.shape)
    place = f" at index {tuple(int(i) for i in where)}" if where else ""
    raise ParameterError(f"{name} = {float(value[where])!r}{place} must be {allowed}")


def number(value, name):
    """Return a dimensionless value as finite floats."""
    value = to_unit(value, None, name)
    require(np.isfinite(value), value, name, "finite")
    return value


def checked_error(value, name):
    """Return a standard deviation as finite floats that are not negative."""
    value = number(value, name)
    require(value >= 0, value, name, "zero or positive")
    return value


def finite_stokes(stokes, axis):
    """Return finite Stokes vectors with their four components first."""
    stokes = np.asarray(getattr(stokes, "value", stokes), dtype=float)
    # of a Quantity the number: the unit of flux cancels in all that follows
    if stokes.ndim == 0 or not -stokes.ndim <= axis < stokes.ndim or stokes.shape[axis] != 4:
        raise ParameterError(
            f"stokes has shape {stokes.shape}; axis {axis} must hold the four components I, Q, U, V"
        )
    require(np.isfinite(stokes), stokes, "stokes", "finite")
    return np.moveaxis(stokes, axis, 0)


def bright_stokes(stokes, axis):
    """Return finite Stokes vectors of positive intensity, components first."""
    components = finite_stokes(stokes, axis)
    require(components[0] > 0, components[0], "the intensity I", "positive")
    return components
