# Licensed under a 3-clause BSD style license - see LICENSE
"""Rows of the system Mueller matrix of a chain: values, derivatives and errors."""

import astropy.units as u
import numpy as np

from astropolcal.chain import join, leaves
from astropolcal.exceptions import ChainError, ParameterError, WavelengthRangeError
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations.reading import nearest_bins
from astropolcal.optics import COORDINATES
from astropolcal.propagation import Propagator
from astropolcal.units import canonical_factor

__all__ = []

# columns of I and of Q and U, to which an error of the model is independent or in proportion
_INTENSITY, _LINEAR = (0,), (1, 2)


class Rows:
    """Measurement rows of a chain at canonical positions and wavelengths, and how they move."""

    def __init__(self, chain, lam, placed, free=None, mix=None, nodes=(1.0,)):
        self.chain, self.free = chain, free
        self._leaves = leaves(chain)
        self._own = [leaf.canonical_values() for leaf in self._leaves]
        self._mix, self._nodes = np.eye(len(lam)) if mix is None else mix, np.asarray(nodes)
        # fluxes of I, Q, U and V alone: a flux is linear in the light, these are its coefficients
        self._light = [Propagator(chain, lam, placed, source) for source in np.eye(4)]
        self._shape = len(lam), self._light[0].shape[1] // len(self._nodes)

    def rows(self, vector=None, n=4):
        """Return the rows of both beams, right first, (2, n_wavelengths, n_frames, n)."""
        values = self._values(vector)
        fluxes = [np.stack(light.fluxes(values)) for light in self._light[:n]]
        return np.stack([self._over_nodes(flux) for flux in fluxes], axis=-1)

    def derivatives(self, n=4):
        """Return derivatives of the rows, ``"optic.parameter"`` to array, per canonical unit.

        Of a parameter given per wavelength it is that to the value at the wavelength of the row.
        """
        wanted = self._wanted()
        if not wanted:
            return {}
        values, shape = self._values(None), self._light[0].shape
        result = {name: np.empty((2, *self._shape, n)) for name in wanted.values()}
        ones, zeros = np.ones(shape), np.zeros(shape)
        for k, light in enumerate(self._light[:n]):
            # one forward sweep serves the derivatives of both beams
            sweep = light.forward(values)
            for beam, weights in enumerate([(ones, zeros), (zeros, ones)]):
                found = sweep.derivatives(list(wanted), weights)
                for place, name in wanted.items():
                    # what lies behind the splitter of the other beam leaves no trace
                    slope = found.get(place, np.zeros(shape))
                    result[name][beam, ..., k] = self._over_nodes(slope)
        return result

    def spread(self, slopes):
        """Return derivatives to the free parameters on a last axis, see `spread_out`."""
        shape = next(iter(slopes.values())).shape if slopes else self._shape
        return spread_out(self.free, slopes, shape, self._mix)

    def changes(self, gain, n=3, scale=1.0):
        r"""Return how the Stokes parameters that a solution finds change with the free parameters.

        :math:`\delta\hat S = -G\,\delta A\,S`, per declared unit, (n_wavelengths, n_found, n,
        n_free); ``gain`` G turns fluxes into Stokes parameters, (n_wavelengths, n_found, 2,
        n_frames).
        """
        slopes = {
            # dS = -G dA S; b: beams, f: frames, s: components of the light
            name: -np.einsum("wkbf,bwfs->wks", gain, (slope * scale)[..., :n], optimize=True)
            for name, slope in self.derivatives(max(n, 3)).items()
        }
        if not slopes:
            return np.zeros((len(gain), gain.shape[1], n, self.free.size))
        return self.spread(slopes)

    def _names(self):
        return [f"{leaf.name}.{key}" for leaf in self._leaves for key in leaf.param_names]

    def _slot(self, name):
        return None if self.free is None else self.free.lookup(name)[0]

    def _wanted(self):
        places = (
            (i, j) for i, leaf in enumerate(self._leaves) for j in range(len(leaf.param_names))
        )
        named = zip(places, self._names(), strict=True)
        return {place: name for place, name in named if self._slot(name) is not None}

    def _values(self, vector):
        """Return the values of every optic at the wavelengths of the data."""
        names = iter(self._names())
        values = []
        for own in self._own:
            values.append([self._at(next(names), value, vector) for value in own])
        return values

    def _at(self, name, value, vector):
        slot = None if vector is None else self._slot(name)
        if slot is not None:
            _, factor, offset = self.free.lookup(name)
            # a tied parameter follows its source: value = factor * source + offset
            value = np.reshape(factor * vector[slot.slice] + offset, value.shape)
        if value.size == 1:
            return value.reshape(())
        if value.size != self._mix.shape[1]:
            raise ParameterError(
                f"{name} has {value.size} values; allowed are 1 or {self._mix.shape[1]}, "
                "one per wavelength"
            )
        return self._mix @ value

    def _over_nodes(self, array):
        """Average over the nodes of the exposures, the last axis but one of columns."""
        array = array.reshape(*array.shape[:-1], len(self._nodes), self._shape[1])
        return np.einsum("...nf,n->...f", array, self._nodes)


def model_error(fit, lam, n=3):
    """Return what the model lacks, as directions (n_directions, n_wavelengths, n, n) of Stokes.

    From ``model_error`` of `Calibration.fit`: each of q and u errs in proportion to q and u, and by
    a share of the intensity, at all wavelengths together, as what the model lacks is smooth.
    """
    known = (fit or {}).get("model_error")
    if not known:
        return np.zeros((0, len(lam), n, n))
    own = np.asarray(known["wavelength_nm"], dtype=float) / 1e3
    order = np.argsort(own)
    directions = []
    for key, columns in (("relative_percent", _LINEAR), ("absolute_percent", _INTENSITY)):
        values = np.asarray(known[key], dtype=float)[order] / 100
        for row in _LINEAR:
            for column in columns:
                direction = np.zeros((len(lam), n, n))
                direction[:, row, column] = np.interp(lam, own[order], values)
                directions.append(direction)
    return np.array(directions)


# ---- pieces of a system Mueller matrix: where a chain begins, its wavelengths, its errors ----


def match_wavelengths(grid, chain, wavelength, interpolate=False):
    """Return the wavelengths, and the weights of those of the grid in each, (n_wanted, n_grid).

    The weights are None where laws give all. Parameters that are known at the wavelengths of the
    grid only are interpolated linearly if ``interpolate``.
    """
    if wavelength is None:
        return grid, np.eye(grid.size)
    try:
        lam = np.atleast_1d(u.Quantity(wavelength)).to(grid.unit)
    except (TypeError, u.UnitConversionError):
        raise ParameterError(f"wavelength = {wavelength!r} needs a unit such as nm") from None
    bins, off = nearest_bins(lam, grid)
    if not off.any():
        return lam, np.eye(grid.size)[bins]
    several = [
        f"{leaf.name}.{key}"
        for leaf in leaves(chain)
        for key in leaf.param_names
        if np.size(getattr(leaf, key).value) > 1
    ]
    if several and not interpolate:
        nearest = grid[np.argmin(np.abs(grid - lam[off][0]))]
        raise WavelengthRangeError(
            f"{lam[off][0]:.2f} is none of the {grid.size} calibrated wavelengths, and "
            f"{several[0]} is known at these only: {grid.min():.2f} to {grid.max():.2f}, the "
            f"nearest is {nearest:.2f}; interpolate=True interpolates it linearly"
        )
    # laws of glass and metal interpolate between calibrated wavelengths, but are not trusted beyond
    outside = (lam < grid.min()) | (lam > grid.max())
    if (outside & off).any():
        raise WavelengthRangeError(
            f"{lam[outside & off][0]:.2f} is outside the calibrated range, "
            f"{grid.min():.2f} to {grid.max():.2f}"
        )
    return lam, between(lam.value, grid.value) if several else None


def spread_out(free, slopes, shape, mix, axis=0):
    r"""Lay derivatives by name, per canonical unit, out over the free parameters on a last axis.

    ``axis`` is that of the wavelengths, which are weighted means of those of the calibration, by
    ``mix`` (n_wavelengths, n_grid). The result, (\*shape, n_free), is per declared unit.
    """
    result = np.zeros((*shape, free.size))
    for name, slope in slopes.items():
        slot, factor, _ = free.lookup(name)
        if slot is None:
            continue
        # tie (own value by the source) and unit (canonical by declared)
        part = slope * factor * slot.factor
        if slot.per_wavelength:
            # w: wavelengths of the data, i: those of the calibration
            own = np.einsum("w...,wi->w...i", np.moveaxis(part, axis, 0), mix)
            result[..., slot.slice] += np.moveaxis(own, 0, part.ndim + axis if axis < 0 else axis)
        else:
            result[..., slot.start] += part
    return result


def per_canonical(free, slopes):
    """Return derivatives by name per canonical unit, of those per declared unit."""
    return {
        name: getattr(slope, "value", slope)
        / canonical_factor(getattr(free.values_of(name), "unit", None))
        for name, slope in slopes.items()
        if free.lookup(name)[0] is not None
    }


def between(lam, grid):
    """Return the weights of linear interpolation between wavelengths, (n_wanted, n_grid)."""
    order = np.argsort(grid)
    rows = np.eye(len(grid))[order]
    return np.stack([np.interp(lam, grid[order], row) for row in rows.T], axis=1)


def errors(calibration, axes, value, slopes, mix):
    """Return the factor of the covariance, and which elements are open or blind."""
    free, shape = free_of(calibration), value.shape
    # where a law gives all wavelengths no parameter has a value at each
    mix = np.zeros((shape[-3], len(calibration.wavelength))) if mix is None else mix
    slopes = per_canonical(free, slopes)
    factor = np.empty((*shape, len(axes.sigmas)))
    is_open, is_blind = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
    for w in range(shape[-3]):
        # at one after the other, as all derivatives at once would be large
        at = (..., slice(w, w + 1), slice(None), slice(None))
        here, own = value[at].shape, {name: slope[at] for name, slope in slopes.items()}
        along = axes.along(spread_out(free, own, here, mix[w : w + 1], -3).reshape(-1, free.size))
        spread = axes.spread(*along)
        factor[(*at, slice(None))] = spread.moved.reshape(*here, -1)
        is_open[at] = spread.is_open.reshape(here)
        is_blind[at] = spread.is_blind.reshape(here)
    return factor, is_open, is_blind


def free_of(calibration):
    """Return the free parameters of a calibration's chains."""
    return FreeParameters(calibration.chains, len(calibration.wavelength), calibration.ties)


def from_first_stage(chain, wanted=None):
    """Return the optics from the first on a stage, or on one of those that are wanted."""
    found = leaves(chain)
    for i, leaf in enumerate(found):
        on_stage = (
            leaf.stage is not None and leaf.stage not in COORDINATES
            if wanted is None
            else leaf.stage in wanted
        )
        if on_stage:
            return join(found[i:])
    if wanted is None and any(leaf.stage in COORDINATES for leaf in found):
        # whatever is in several states is not a source
        return chain
    raise ChainError("the chain has no optic on a stage; give the chain from the sky")


def split_chain(chain):
    """Return the optics upstream of the first stage of the instrument, and the others."""
    found = leaves(chain)
    # up to there it is the telescope, which turns the sky, or the calibration source
    fixed = (i for i, leaf in enumerate(found) if leaf.stage and not leaf.rotates_frame)
    start = next((i for i in fixed if found[i].stage not in COORDINATES), 0)
    return found[:start], found[start:]


def at_wavelengths(chain, mix, size):
    """Return a copy of the chain with weighted means of the parameters given per wavelength."""
    chain = chain.copy()
    if mix is None or np.array_equal(mix, np.eye(size)):
        return chain
    mixed = []
    for leaf in leaves(chain):
        several = [k for k in leaf.param_names if np.size(getattr(leaf, k).value) == size > 1]
        own = {key: getattr(leaf, key) for key in several}
        values = {key: (mix @ p.value) * (p.unit or 1) for key, p in own.items()}
        mixed.append(leaf.with_parameters(**values))
    return join(mixed)
