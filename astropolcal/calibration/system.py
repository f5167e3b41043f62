# Licensed under a 3-clause BSD style license - see LICENSE
"""Rows of the system Mueller matrix of a chain: values, derivatives and errors."""

from functools import cached_property

import astropy.units as u
import numpy as np

from astropolcal.chain import join, leaves, parted, system_mueller, system_mueller_derivatives
from astropolcal.exceptions import ChainError, ParameterError, WavelengthRangeError
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations.reading import SAME_WAVELENGTH, nearest_bins
from astropolcal.optics import COORDINATES, Perturbation
from astropolcal.propagation import Propagator
from astropolcal.units import canonical_factor, mjd_of, wavelengths_of

__all__ = []

# how q and u err, each in proportion to I, or to q and u; and both with the degree or the angle
_APART = np.eye(6).reshape(6, 2, 3)[[0, 3]]
_SHARE = np.eye(6).reshape(6, 2, 3)[[1, 2, 4, 5]]
_ALONG, _ACROSS = np.array([[0, 1, 0], [0, 0, 1]]), np.array([[0, 0, -1], [0, 1, 0]])
# by the keys of ``model_error``, percent
_ERRORS = {"relative_percent": _SHARE, "absolute_percent": _APART}
_ERRORS |= {f"sign_{key}": patterns for key, patterns in _ERRORS.items()}
_ERRORS |= {"held_along_percent": [_ALONG], "held_across_percent": [_ACROSS]}
_ERRORS |= {"held_absolute_percent": _APART}


class Rows:
    """Measurement rows of a chain at canonical positions and wavelengths, and how they move."""

    def __init__(self, chain, lam, placed, free=None, mix=None, nodes=(1.0,)):
        self.chain, self.free = chain, free
        self._leaves = leaves(chain)
        self._own = [leaf.canonical_values() for leaf in self._leaves]
        # by place among the optics, and among the parameters of the optic
        self._named = {
            (i, j): f"{leaf.name}.{key}"
            for i, leaf in enumerate(self._leaves)
            for j, key in enumerate(leaf.param_names)
        }
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
        wanted = {place: name for place, name in self._named.items() if self._slot(name)}
        values, shape = self._values(None), self._light[0].shape
        result = {name: np.empty((2, *self._shape, n)) for name in wanted.values()}
        # the derivatives of both beams at once
        weights = np.broadcast_to(np.eye(2)[:, :, None, None], (2, 2, *shape))
        for k, light in enumerate(self._light[:n]):
            found = light.forward(values).derivatives(list(wanted), weights)
            for place, name in wanted.items():
                # what lies behind the splitter of the other beam leaves no trace
                slope = found.get(place, np.zeros((2, *shape)))
                result[name][..., k] = self._over_nodes(slope)
        return result

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
        return spread_out(self.free, slopes, (*gain.shape[:2], n), self._mix)

    def _slot(self, name):
        return None if self.free is None else self.free.lookup(name)[0]

    def _values(self, vector):
        """Return the values of every optic at the wavelengths of the data."""
        values, size = [list(own) for own in self._own], self._mix.shape[1]
        for (i, j), name in self._named.items():
            value = values[i][j]
            if vector is not None and self._slot(name):
                # a tied parameter follows its source: value = factor * source + offset
                slot, factor, offset = self.free.lookup(name)
                value = np.reshape(factor * vector[slot.slice] + offset, value.shape)
            if value.size not in (1, size):
                raise ParameterError(
                    f"{name} has {value.size} values; allowed are 1 or {size}, one per wavelength"
                )
            values[i][j] = self._mix @ value if value.size > 1 else value.reshape(())
        return values

    def _over_nodes(self, array):
        """Average over the nodes of the exposures, the last axis but one of columns."""
        array = array.reshape(*array.shape[:-1], len(self._nodes), self._shape[1])
        return np.einsum("...nf,n->...f", array, self._nodes)


def inverse_rows(rows, weights=None, max_condition=1e6):
    """Return what turns fluxes into Stokes parameters, and how well it is determined.

    ``rows`` are (..., n_data, n), ``weights`` (..., n_data) inverse variances, equal by default.
    Returns the gain of least squares, (..., n, n_data), the singular values, (..., n), largest
    first, their right vectors, rows of (..., n, n), and which of them are determined, (..., n):
    their values are not smaller than the largest by ``max_condition``. The gain leaves out others.
    """
    count, n = rows.shape[-2:]
    root = np.ones(rows.shape[:-1]) if weights is None else np.sqrt(weights)
    # weights of 1e-300 or 1e300 must not under- or overflow in the singular values
    root = root / np.maximum(root.max(axis=-1, keepdims=True), np.finfo(float).tiny)
    scaled = rows * root[..., None]
    if count < n:
        # rows of zeros, so that there is a singular value for each component
        scaled = np.concatenate([scaled, np.zeros((*rows.shape[:-2], n - count, n))], axis=-2)
    left, values, right = np.linalg.svd(scaled, full_matrices=False)
    # the largest always counts, unless all rows are zero
    good = (values * max_condition > values[..., :1]) & (values > 0)
    inverse = good / np.where(good, values, 1.0)
    gain = (right * inverse[..., None]).swapaxes(-1, -2) @ left[..., :count, :].swapaxes(-1, -2)
    return gain * root[..., None, :], values, right, good


def model_error(fit, lam, n=3):
    """Return what the model lacks, as directions (n_directions, n_wavelengths, n, n) of Stokes.

    From ``model_error`` of `Calibration.fit`: each of q and u errs in proportion to q and u, and by
    a share of the intensity, at all wavelengths together, as what the model lacks is smooth. So
    do signs of retardances that the data do not tell.
    """
    known = (fit or {}).get("model_error") or {}
    own = np.array(known.get("wavelength_nm", ()), dtype=float) / 1e3
    order = np.argsort(own)
    directions = []
    for key, patterns in _ERRORS.items():
        if key not in known:
            continue
        values = np.interp(lam, own[order], np.asarray(known[key], dtype=float)[order] / 100)
        for pattern in patterns:
            direction = np.zeros((len(lam), n, n))
            direction[:, 1:3, :3] = values[:, None, None] * pattern
            directions.append(direction)
    return np.reshape(directions, (-1, len(lam), n, n))


# ---- pieces of a system Mueller matrix: where a chain begins, its wavelengths, its errors ----


def match_wavelengths(grid, chain, wavelength, interpolate=False):
    """Return the wavelengths, and the weights of those of the grid in each, (n_wanted, n_grid).

    The weights are None where laws give all. Parameters that are known at the wavelengths of the
    grid only are interpolated linearly if ``interpolate``.
    """
    if wavelength is None:
        return grid, np.eye(grid.size)
    lam = np.atleast_1d(wavelengths_of(wavelength)).to(grid.unit)
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
    check_range(lam, grid)
    return lam, between(lam.value, grid.value) if several else None


def check_range(wavelength, grid):
    """Raise if wavelengths are beyond the calibrated ones."""
    wavelength, slack = np.atleast_1d(wavelength), SAME_WAVELENGTH * grid.max()
    outside = (wavelength < grid.min() - slack) | (wavelength > grid.max() + slack)
    if outside.any():
        raise WavelengthRangeError(
            f"wavelength {wavelength[outside][0].to(grid.unit):.2f} is outside the calibrated "
            f"range {grid.min():.2f} to {grid.max():.2f}"
        )


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


def distinct(positions):
    """Return the positions of all distinct settings of the stages, and which one each frame has.

    Of positions that are all scalar the frames have no axis.
    """
    # dates as numbers, and states by their numbers
    positions = {k: mjd_of(v, k) if k == "time" else v for k, v in positions.items()}
    numbers = {name: _numbers(position) for name, position in positions.items()}
    counts = {name: len(number) for name, number in numbers.items() if number.ndim}
    if len({*counts.values()} - {1}) > 1:
        told = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ParameterError(f"positions: {told}; one number of frames is allowed")
    count = max(counts.values(), default=1)
    columns = [np.broadcast_to(number, (count, *number.shape[1:])) for number in numbers.values()]
    rows = np.column_stack(columns or [np.zeros((1, 0))])
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    settings = {}
    for name, number in numbers.items():
        given = positions[name]
        if not hasattr(given, "shape"):
            text = np.asarray(given).dtype.kind in "US"
            given = np.asarray(given) if text else u.Quantity(given)
        shape = (count, *number.shape[1:])
        settings[name] = np.broadcast_to(given, shape, subok=True)[first]
    return settings, which.reshape((count,) if counts else ())


def _numbers(position):
    """Return positions, which may be names of states, as plain numbers that tell them apart."""
    told = np.asarray(position) if not isinstance(position, u.Quantity) else position.value
    if told.dtype.kind in "US":
        return np.unique(told, return_inverse=True)[1].reshape(told.shape)
    return np.asarray(u.Quantity(position).value)


# settings of the stages that are worked on at a time: their derivatives are the largest arrays
_BLOCK = 256


class MuellerMatrices:
    """
    System Mueller matrices of frames and how they move with the parameters, when that is asked for.

    ``positions`` are those of the distinct settings of the stages, ``which`` tells which of them
    each frame has; ``axes`` are those of the calibration's covariance. A matrix at one wavelength
    depends on few parameters, so that its covariance has a factor with no more columns than those.
    """

    def __init__(self, calibration, axes, chain, lam, positions, which, mix):
        self._free, self._axes = free_of(calibration), axes
        self._chain, self._lam, self._positions, self.which = chain, lam, positions, which
        # where a law gives all wavelengths no parameter has a value at each
        self._mix = np.zeros((len(lam), len(calibration.wavelength))) if mix is None else mix
        names = [f"{leaf.name}.{key}" for leaf in leaves(chain) for key in leaf.param_names]
        self._names = [name for name in names if self._free.lookup(name)[0] is not None]

    def values(self):
        """Return the matrices, (n_frames, n_wavelengths, 4, 4)."""
        return self._found(lambda at: system_mueller(self._chain, self._lam, at), (4, 4))

    @property
    def factor(self):
        """Changes of ``value`` for one standard error along each direction that is determined.

        Shape (..., 4, 4, rank). The covariance of any two elements, also of different frames,
        wavelengths or beams, is the sum of the products of theirs. It is large: some megabytes for
        ten frames.
        """
        known = self._along[0] * self._axes.sigmas
        return self._found(lambda at: self._slopes(at) @ known, (4, 4, known.shape[-1]))

    def local_factor(self):
        """Return a factor of the covariance at each wavelength, (..., 16, n_parameters)."""
        local = self._local
        return self._found(lambda at: self._slopes(at) @ local, (16, local.shape[-1]))

    @property
    def std(self):
        """Standard errors, infinite for what is open and NaN for what is blind."""

        def of_settings(at):
            slopes = self._slopes(at)
            is_open, is_blind = self._flags(slopes)
            std = np.sqrt(np.sum((slopes @ self._local) ** 2, axis=-1))
            return np.where(is_open, np.inf, np.where(is_blind, np.nan, std))

        return self._found(of_settings, (4, 4))

    def flags(self):
        """Return which elements are open and which are blind."""
        found = self._found(lambda at: np.stack(self._flags(self._slopes(at)), axis=2), (2, 4, 4))
        return found[..., 0, :, :] > 0, found[..., 1, :, :] > 0

    def _flags(self, slopes):
        known, *others = self._along
        return self._axes.flags(*(slopes @ part for part in (_reduced(known), *others)))

    @cached_property
    def _along(self):
        """What each parameter does along the known, open and blind directions at a wavelength."""
        ones = np.ones(len(self._lam))
        rows = [spread_out(self._free, {name: ones}, ones.shape, self._mix) for name in self._names]
        rows = np.reshape(rows, (len(self._names), len(ones), self._free.size))
        return self._axes.along(rows.swapaxes(0, 1))

    @cached_property
    def _local(self):
        return _reduced(self._along[0] * self._axes.sigmas)

    def _slopes(self, at):
        """Return derivatives at some settings, (n_settings, n_wavelengths, 16, n_parameters)."""
        slopes = system_mueller_derivatives(self._chain, self._lam, at)
        slopes = per_canonical(self._free, slopes)
        shape = (len(next(iter(at.values()))), len(self._lam), 16)
        rows = [slopes[name].reshape(shape) for name in self._names]
        return np.stack(rows, axis=-1) if rows else np.zeros((*shape, 0))

    def _found(self, of_settings, own):
        """Return for all frames what a function gives for settings, a block after the other."""
        needed, which = np.unique(self.which, return_inverse=True)
        found = np.empty((len(needed), len(self._lam), *own))
        for start in range(0, len(needed), _BLOCK):
            block = needed[start : start + _BLOCK]
            at = {name: position[block] for name, position in self._positions.items()}
            found[start : start + _BLOCK] = of_settings(at).reshape(len(block), *found.shape[1:])
        if np.array_equal(which.ravel(), np.arange(which.size)) and self.which.ndim:
            return found
        return found[which.reshape(self.which.shape)]


def _reduced(rows):
    """Return rows (..., n, k) of the same products in no more than n columns."""
    if rows.shape[-1] <= rows.shape[-2]:
        return rows
    return np.linalg.qr(rows.swapaxes(-1, -2), mode="r").swapaxes(-1, -2)


def free_of(calibration):
    """Return the free parameters of a calibration's chains."""
    return FreeParameters(calibration.chains, len(calibration.wavelength), calibration.ties)


def from_first_stage(chain, wanted=None):
    """Return the optics from the first on a stage, or on one of those that are wanted."""
    found = leaves(chain)
    for i, optic in enumerate(found):
        if _is_first(optic) if wanted is None else optic.stage in wanted:
            return join(found[i:] if wanted else parted(found, i)[1])
    if wanted is None and any(optic.stage in COORDINATES for optic in found):
        # whatever is in several states is not a source
        return chain
    raise ChainError("the chain has no optic on a stage; give the chain from the sky")


def split_chain(chain):
    """Return the optics upstream of the first stage of the instrument, and the others."""
    found = leaves(chain)
    # up to there it is the telescope, which turns the sky, or the calibration source
    fixed = (i for i, o in enumerate(found) if _is_first(o) and not o.rotates_frame)
    start = next(fixed, 0)
    return parted(found, start) if start else ([], found)


def _is_first(optic):
    """Return whether an optic stands on a stage; a perturbation only follows it."""
    is_on = optic.stage and optic.stage not in COORDINATES
    return bool(is_on) and not isinstance(optic, Perturbation)


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
