# Licensed under a 3-clause BSD style license - see LICENSE
"""Pieces of a system Mueller matrix: where a chain begins, its wavelengths, its errors."""

import astropy.units as u
import numpy as np

from astropolcal.chain import join, leaves
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.optics import COORDINATES
from astropolcal.units import canonical_factor

_TELESCOPE = ("parallactic", "altitude")
_SAME_WAVELENGTH = 1e-6


def match_wavelengths(grid, chain, wavelength):
    """Return the wavelengths, and the bin of each; None where the law gives all."""
    if wavelength is None:
        return grid, np.arange(grid.size)
    try:
        lam = np.atleast_1d(u.Quantity(wavelength)).to(grid.unit)
    except (TypeError, u.UnitConversionError):
        raise ParameterError(f"wavelength = {wavelength!r} needs a unit such as nm") from None
    # relative, (n_wanted, n_grid)
    far = np.abs(lam[:, None] - grid) / grid
    bins = far.argmin(axis=1)
    off = far.min(axis=1) > _SAME_WAVELENGTH
    if not off.any():
        return lam, bins
    several = [
        f"{leaf.name}.{key}"
        for leaf in leaves(chain)
        for key in leaf.param_names
        if np.size(getattr(leaf, key).value) > 1
    ]
    if several:
        raise WavelengthRangeError(
            f"{lam[off][0]:.2f} is none of the {grid.size} calibrated wavelengths, and "
            f"{several[0]} is known at these only: {grid.min():.2f} to {grid.max():.2f}"
        )
    # laws of glass and metal interpolate between calibrated wavelengths, but are not trusted beyond
    outside = (lam < grid.min()) | (lam > grid.max())
    if (outside & off).any():
        raise WavelengthRangeError(
            f"{lam[outside & off][0]:.2f} is outside the calibrated range, "
            f"{grid.min():.2f} to {grid.max():.2f}"
        )
    return lam, None


def errors(calibration, axes, value, slopes, bins):
    """Return the factor of the covariance, and which elements are open or blind."""
    grid = calibration.wavelength
    free = FreeParameters(calibration.chains, len(grid), calibration.ties)
    shape = value.shape
    factor = np.empty((*shape, len(axes.sigmas)))
    is_open, is_blind = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for w in range(shape[-3]):
        at = (..., w, slice(None), slice(None))
        place = None if bins is None else bins[w]
        # derivatives per degree, micrometre or percent, (n_elements of the matrices, n_free)
        scaled = _along(free, slopes, at, place, value[at].shape) * axes.steps
        spread = axes.spread(scaled @ axes.known.T, scaled @ axes.open.T, scaled @ axes.blind.T)
        here = value[at].shape
        factor[(*at, slice(None))] = spread.moved.reshape(*here, -1)
        is_open[at] = spread.is_open.reshape(here)
        is_blind[at] = spread.is_blind.reshape(here)
    return factor, is_open, is_blind


def _along(free, slopes, at, place, shape):
    """Return derivatives to the flat vector at a wavelength, (n_elements, n_free)."""
    result = np.zeros((int(np.prod(shape)), free.size))
    for name, slope in slopes.items():
        slot, factor, _ = free.lookup(name)
        if slot is None:
            continue
        own = getattr(free.values_of(name), "unit", None)
        # at one wavelength only its own value of a parameter per wavelength matters
        column = slot.start + (place if slot.per_wavelength else 0)
        # per unit of the follower -> canonical -> the source of the tie -> per unit of the source
        result[:, column] += slope.value[at].ravel() / canonical_factor(own) * factor * slot.factor
    return result


def split_chain(chain):
    """Return the optics in front of the first stage of the instrument, and the others."""
    found = leaves(chain)
    # up to there it is the telescope or the calibration source
    start = next(
        (i for i, leaf in enumerate(found) if leaf.stage not in (None, *_TELESCOPE, *COORDINATES)),
        0,
    )
    return found[:start], found[start:]


def at_bins(chain, bins, size):
    """Return a copy of the chain at some bins of the parameters given per wavelength."""
    chain = chain.copy()
    if bins is None or np.array_equal(bins, np.arange(size)):
        return chain
    return join(_sliced(leaf, bins, size) for leaf in leaves(chain))


def _sliced(leaf, bins, size):
    """Return an optic at some bins of its parameters given per wavelength."""
    several = [key for key in leaf.param_names if np.size(getattr(leaf, key).value) == size > 1]
    values = {key: getattr(leaf, key) for key in several}
    return leaf.with_parameters(
        **{key: own.value[bins] * (own.unit or 1) for key, own in values.items()}
    )
