# Licensed under a 3-clause BSD style license - see LICENSE
"""
Quantities that follow from a calibration, with their errors.

To first order: with g the derivative of a quantity to the parameters and C
their covariance, the variance is g C g. A quantity that moves along a
direction which the data leave open has an infinite error, however small the
change: no pseudo-inverse hides it.
"""

from dataclasses import dataclass, field

import astropy.units as u
import numpy as np

from astropolcal.calibration._directions import led
from astropolcal.calibration.covariance import full_covariance
from astropolcal.exceptions import ParameterError
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.units import canonical_factor

__all__ = ["Derived", "propagate"]

# step of a central difference along a direction, in degree, micrometre or percent
_STEP = 1e-2


@dataclass
class Derived:
    """
    A quantity that follows from a calibration, with its error.

    Parameters
    ----------
    value : `~astropy.units.Quantity` or `~numpy.ndarray`
        The quantity, of any shape.
    std : `~astropy.units.Quantity` or `~numpy.ndarray`
        Standard error from the calibration, of the same shape: infinite where
        the data leave it open; NaN where it depends on parameters at a bound
        alone, or where a calibration file does not say.
    covariance : callable
        Called without arguments, the covariance of the flattened quantity in
        squares of its unit, shape (size, size).
    open_directions : dict of str to array
        For each open direction that moves the quantity, named by its leading
        parameter, the change of the quantity for +1 degree (micrometre,
        percent) of that parameter.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Derived
    >>> Derived(np.array([0.9]), np.array([0.01]), lambda: np.array([[1e-4]])).is_determined
    array([ True])
    """

    value: object
    std: object
    covariance: object
    open_directions: dict = field(default_factory=dict)

    @property
    def is_determined(self):
        """Whether the data determine each element, a bool array of the shape of ``value``."""
        return np.isfinite(np.asarray(u.Quantity(self.std).value))

    def __str__(self):
        lines = [
            f"{np.size(self.value)} values, {int(np.sum(self.is_determined))} of them with an error"
        ]
        lines += [
            f"  - open: {name} by +1 moves them by up to {np.abs(change).max():.3g}"
            for name, change in self.open_directions.items()
        ]
        return "\n".join(lines)


def propagate(calibration, function, derivatives=None):
    """
    Return any function of the calibrated chains with its error.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    function : callable
        Takes the chain of each dataset as one argument, returns a number, an
        array or a `~astropy.units.Quantity`. Smooth near the solution.
    derivatives : callable, optional
        Takes the same; returns a dict of ``"optic.parameter"`` to the
        derivative of the function per unit of that parameter, as plain
        numbers of the shape of the function's value, with one more axis at the
        end for a parameter given per wavelength. Without it central differences
        are taken along the directions of the covariance.

    Returns
    -------
    Derived

    Raises
    ------
    ParameterError
        If a derivative is of a parameter that is not free, or of wrong shape.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import propagate
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> ratio = propagate(cal, lambda chain: chain["hwp"].w_sio2.value / chain["hwp"].w_mgf2.value)
    >>> bool(0 < ratio.std < 1e-3)
    True
    """
    chains = [chain.copy() for chain in calibration.chains]
    free = FreeParameters(chains, len(calibration.wavelength), calibration.ties)
    value = function(*chains)
    if derivatives is not None:
        known = slopes_of(free, derivatives(*chains), np.shape(value))
        return derive(calibration, free, value, known)
    unit = value.unit if isinstance(value, u.Quantity) else None
    start, canonical = free.start(), free.factors()

    def slope(direction):
        ends = []
        for sign in (1, -1):
            # direction is in steps, `steps` leads to declared units,
            # `canonical` on to those of the vector
            free.put_back(start + sign * _STEP * direction * axes.steps * canonical)
            end = function(*chains)
            ends.append(np.ravel(end.to_value(unit) if unit is not None else end))
        return (ends[0] - ends[1]) / (2 * _STEP)

    axes = full_covariance(calibration)._axes()
    parts = [
        np.stack([slope(row) for row in rows], axis=1)
        if len(rows)
        else np.zeros((np.size(value), 0))
        for rows in (axes.known, axes.open, axes.blind)
    ]
    # the basis of open directions is arbitrary; a user asks what one degree of a parameter does
    changes = parts[1] @ _to_leads(free, axes.open) if len(axes.open) else None
    return _package(free, axes, value, axes.spread(*parts), changes)


def slopes_of(free, derivatives, shape):
    """Lay derivatives by name out over the flat vector, shape (size, n_free)."""
    size = int(np.prod(shape, dtype=int))
    slopes = np.zeros((size, free.size))
    for name, derivative in derivatives.items():
        slot, factor, _ = free.lookup(name)
        if slot is None:
            raise ParameterError(f"derivative of {name}: no such free parameter")
        expected = (*shape, slot.size) if slot.per_wavelength else shape
        if np.shape(derivative) != expected:
            raise ParameterError(
                f"derivative of {name} has shape {np.shape(derivative)}; expected is {expected}"
            )
        # a follower moves with the parameter it is tied to, in canonical units
        own = free.values_of(name)
        per_own = canonical_factor(own.unit) if isinstance(own, u.Quantity) else 1.0
        block = np.reshape(np.asarray(derivative, dtype=float), (size, slot.size))
        slopes[:, slot.slice] += block / per_own * factor * slot.factor
    return slopes


def derive(calibration, free, value, slopes):
    """Return a quantity with its error from its derivatives per declared unit."""
    axes = full_covariance(calibration)._axes()
    scaled = slopes * axes.steps
    along_open = scaled @ axes.open.T
    spread = axes.spread(scaled @ axes.known.T, along_open, scaled @ axes.blind.T)
    changes = along_open @ _to_leads(free, axes.open) if len(axes.open) else None
    return _package(free, axes, value, spread, changes)


def _to_leads(free, null):
    """Return what turns changes along the open directions into those per leading parameter."""
    reduced = np.array([vector for vector, _ in led(free, null)])
    return null @ reduced.T


def _package(free, axes, value, spread, changes):
    shape, moved = np.shape(value), {}
    if changes is not None and spread.is_open.any():
        names = [lead for _, lead in led(free, axes.open)]
        limit = 1e-5 * np.abs(changes).max()
        moved = {
            name: change.reshape(shape)
            for name, change in zip(names, changes.T, strict=True)
            if np.abs(change).max() > limit
        }
    std = spread.stds().reshape(shape)
    std = std * value.unit if isinstance(value, u.Quantity) else std
    return Derived(value, std[()], spread.covariance, moved)
