# Licensed under a 3-clause BSD style license - see LICENSE
"""
Residuals and derivatives of chains in both channels, and their fit.

Parameters given per wavelength may follow a law in wavelength: a basis with
one column a coefficient. What is fitted is the flat vector of coefficients.
"""

from copy import copy as copied
from itertools import pairwise

import astropy.units as u
import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, null_space, solve_triangular
from scipy.optimize import nnls

from astropolcal.calibration.identifiability.linearized import orthonormal, triangle
from astropolcal.chain import Train, leaves
from astropolcal.gap.channels import Channels, expected_fluxes, noise, settings
from astropolcal.measurement import Measurement
from astropolcal.measurement.datasets import _positions as _read_positions
from astropolcal.measurement.parameters import bind_prior
from astropolcal.optics import StarSource
from astropolcal.optics.positions import FLUXES

__all__ = []

#: A direction whose singular value is below this share of the largest is open; a
#: coefficient with more than that of its length in such a direction is open too.
OPEN, TOUCHES = 1e-7, 1e-3
_MAX_STEPS = 40
# a step that lowers chi-square by less than this, or than this share of it, has arrived
_ARRIVED, _ARRIVED_SHARE = 1e-4, 1e-5
# keeps what the data do not determine where it is
_HOLD = 1e-6
# and this where rounding takes normal equations for negative
_ROUNDED = 1e-9
# Marquardt's damping, of columns of unit length: where it begins, below what it is dropped,
# below what it does not count, and above what no step leads down
_FIRST_DAMPING, _LEAST_DAMPING, _FREE, _STUCK = 1e-5, 1e-7, 1e-3, 1e3
# the second derivative along a step is that of this share of it, and what corrects for it is at
# most so many times as long as the step
_SHORT, _CURVED = 0.1, 0.75
# a coefficient closer to its bound than this (canonical units) sits at it
_AT_BOUND = 1e-9
# and a value of a law closer than this
_AT_WALL = 1e-7
# so often it is guessed which bounds hold; a slope below this share of its terms is none
_GUESSES, _ROUNDING = 10, 1e-13


def _exact(chain):
    """Return the optics of a chain, copies where a standard star is held as it is known."""
    found = [leaf.copy() if isinstance(leaf, StarSource) else leaf for leaf in leaves(chain)]
    for star in (leaf for leaf in found if isinstance(leaf, StarSource)):
        for parameter in (getattr(star, key) for key in star.param_names):
            if parameter.prior is not None:
                parameter.fixed, parameter.prior = True, None
    return Train(found)


def _expected(chains):
    """Return mean and standard deviation, canonical, of each value that a prior holds.

    The zero of a stage may be anywhere.
    """
    found = {}
    for leaf in (leaf for chain in chains for leaf in chain):
        for key in leaf.param_names if leaf.name else ():
            value, name = getattr(leaf, key), f"{leaf.name}.{key}"
            if value.prior is None or value.fixed or (key == "theta" and leaf.mount is not None):
                continue
            prior = bind_prior(value.prior, name, value.unit, value.bounds)
            if not prior.is_flat:
                known = prior.mode * prior.factor, prior.width
                found |= {(name, k): known for k in range(np.size(value.value))}
    return found


class GapProblem:
    """Chains against all frames of their datasets, whitened by the noise.

    Parameters may have ``laws``, a basis (W, k) each; ``priors``, the standard deviation of a
    normal prior on their coefficients; ``neutral``, the value about which law, prior and limits
    are (0 if none is given); and ``limits``, the most by which they may differ from it, where they
    follow no law: those are held to the bounds of their optic. All by ``"optic.parameter"``,
    canonical. ``wavelength`` is a grid with more than those of the datasets. Noise, lamp and
    fluxes are those of a problem ``like`` it, or `settle_noise` must be called.
    """

    def __init__(
        self,
        chains,
        observations,
        *,
        ties=None,
        laws=None,
        priors=None,
        neutral=None,
        limits=None,
        like=None,
        wavelength=None,
        copy=True,
    ):
        self.ties, self.laws, self.priors = dict(ties or {}), dict(laws or {}), dict(priors or {})
        self.neutral, self.limits = dict(neutral or {}), dict(limits or {})
        # what the model holds is held; an effect is what frees it
        chains, observations = [_exact(chain) for chain in chains], list(observations)
        expected = _expected(chains)
        #: Mean and standard deviation of each value that a prior holds: one datum each, also where
        #: an effect lets go of it.
        self.known = expected if like is None else like.known
        #: Expected fluxes of each dataset, (2, W, F), without and with the flicker of its lamp.
        self.fluxes = [None] * len(chains) if like is None else like.fluxes
        self.flickering = self.fluxes if like is None else like.flickering
        #: Functions of the frame on which a cause may depend, once they are known.
        self.waves = None if like is None else like.waves
        single = all(each.single_beam for each in observations)
        how = {"observable": "intensity" if single else "normalized_single_difference"}
        seen = zip(chains, observations, self.fluxes, strict=True)
        how |= {"ties": ties, "copy": copy, "positions": [_positions(*each) for each in seen]}
        # of a part of the data that of all
        grid = None if like is None else like.wavelength * u.um
        how["wavelength"] = grid if wavelength is None else wavelength
        self.measurement = Measurement(chains, observations, **how)
        self.datasets = self.measurement.datasets
        self._flickering = [self._with_flicker(*each) for each in enumerate(chains)]
        self.free = self.measurement.free
        self.wavelength = self.measurement.wavelength
        self.channels = [Channels(d) for d in self.datasets] if like is None else like.channels
        self._set_laws(self.laws)
        sizes = [channel.observed.size for channel in self.channels]
        edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        #: Slice of the rows that belongs to each dataset.
        self.segments = [slice(a, b) for a, b in pairwise(edges)]
        self.n_rows = int(edges[-1]) + len(self.known)
        self._hold(expected)
        self.start = self.coefficients(self.free.start())
        self.tight = np.zeros(self.size)
        for name, sigma in self.priors.items():
            self.tight[self.slices[name]] = 1 / sigma
        #: Coefficients at which every effect is absent, about which the priors are.
        self.absent = self.coefficients(self._absent())
        self.centre = np.where(self.tight > 0, self.absent, 0.0)

    def _with_flicker(self, i, chain):
        """Return a dataset as its differences see it, None where that is no matter."""
        dataset, fluxes = self.datasets[i], self.flickering[i]
        if fluxes is None or not any(leaf.stage in FLUXES for leaf in leaves(chain)):
            return None
        new = copied(dataset)
        new._given = _positions(chain, dataset.observations, fluxes)
        new._place(chain, dataset.frames.T.ravel())
        return new

    def _hold(self, expected):
        """Note the rows of what is known beforehand: targets and derivatives."""
        self._targets = np.zeros(len(self.known))
        self._holds = np.zeros((len(self.known), self.size))
        blocks = dict(zip(self.slices, self._blocks, strict=True))
        for i, ((name, k), (middle, spread)) in enumerate(self.known.items()):
            if (name, k) in expected and name in self.slices:
                beside = self._rest[self.free.by_name[name].start + k]
                self._holds[i, self.slices[name]] = blocks[name][k] / spread
                self._targets[i] = (middle - beside) / spread
                self.neutral.setdefault(name, middle)

    def _absent(self):
        """Return the vector of values about which the priors are."""
        vector = np.zeros(self.free.size)
        for slot in self.free.slots:
            vector[slot.slice] = self.neutral.get(slot.name, 0.0)
        return vector

    def _set_laws(self, laws):
        """Note the linear map from the coefficients to the flat vector."""
        blocks, self.names, self.slices = [], [], {}
        (low, high), absent, rest = self._bounds(), self._absent(), []
        self.low, self.high, start, walls = [], [], 0, []
        for slot in self.free.slots:
            basis = laws.get(slot.name)
            follows = basis is not None and slot.per_wavelength and np.shape(basis)[1] < slot.size
            block = basis if follows else np.eye(slot.size)
            blocks.append(block)
            # what a law cannot describe of the value about which it is stays as it is
            around = absent[slot.slice] * follows
            rest.append(around - block @ _along(block, around))
            k = block.shape[1]
            self.slices[slot.name] = slice(start, start + k)
            self.names += [slot.name if k == 1 else f"{slot.name}[{i}]" for i in range(k)]
            self.low += [-np.inf] * k if follows else list(low[slot.slice])
            self.high += [np.inf] * k if follows else list(high[slot.slice])
            walls += [(self.slices[slot.name], block, slot.canonical_bounds(), rest[-1])] * follows
            start += k
        self._blocks, self._rest = blocks, np.concatenate([np.empty(0), *rest])
        self.low, self.high = np.array(self.low), np.array(self.high)
        self.size = start
        # the bounds of the values of laws: rows, and what each is at most
        rows, ends = [np.empty((0, self.size))], [np.empty(0)]
        for where, block, bounds, beside in walls:
            for sign, end in zip((-1, 1), bounds, strict=True):
                if np.isfinite(end):
                    rows.append(np.zeros((len(block), self.size)))
                    rows[-1][:, where] = sign * block
                    ends.append(sign * (end - beside))
        self._walls = np.concatenate(rows), np.concatenate(ends)

    def _bounds(self):
        """Return the bounds of the flat vector: those of the chains, or narrower limits."""
        low, high = (np.array(bound, dtype=float) for bound in self.free.bounds())
        absent = self._absent()
        for slot in self.free.slots:
            room, where = self.limits.get(slot.name, np.inf), slot.slice
            low[where] = np.maximum(low[where], absent[where] - room)
            high[where] = np.minimum(high[where], absent[where] + room)
        return low, high

    def numbers(self, names):
        """Return the numbers of the coefficients of parameters, of those that are free."""
        every = np.arange(self.size)
        known = [every[self.slices[name]] for name in names if name in self.slices]
        return np.concatenate([every[:0], *known])

    def coefficients(self, vector):
        """Return the coefficients whose laws are nearest to canonical values, see `vector`."""
        vector = vector - self._rest
        blocks = zip(self.free.slots, self._blocks, strict=True)
        return np.concatenate([vector[:0], *(_along(b, vector[slot.slice]) for slot, b in blocks)])

    def vector(self, coefficients):
        """Return the canonical values of the free parameters, shape (n_free,)."""
        return self.spread(coefficients) + self._rest

    def spread(self, coefficients):
        """Return how far coefficients, (..., n), move canonical values, shape (..., n_free)."""
        parts = [
            coefficients[..., self.slices[slot.name]] @ block.T
            for slot, block in zip(self.free.slots, self._blocks, strict=True)
        ]
        return np.concatenate([coefficients[..., :0], *parts], axis=-1)

    # ---- data ------------------------------------------------------------------------

    def differences(self, coefficients):
        """Return observed minus predicted of each dataset, arrays (2, W, F)."""
        vector, out = self.vector(coefficients), []
        for channel, *pair in zip(self.channels, self.datasets, self._flickering, strict=True):
            dataset, flickering = pair
            predicted = channel.predicted(dataset.forward(vector))
            if flickering is not None:
                predicted[0] = channel.predicted(flickering.forward(vector))[0]
            out.append(np.where(channel.valid, channel.observed - predicted, 0.0))
        return out

    def residual(self, coefficients):
        """Return the whitened residuals, shape (n_rows,)."""
        parts = zip(self.channels, self.differences(coefficients), strict=True)
        known = self._targets - self._holds @ coefficients
        return np.concatenate([*(channel.whiten(r).ravel() for channel, r in parts), known])

    def jacobian(self, coefficients, whitened=True):
        """
        Return the derivative of the predicted rows, shape (n_rows, n_coefficients).

        Those that are not whitened are of the data alone.
        """
        vector = self.vector(coefficients)
        out = np.zeros((self.size, self.n_rows))
        for i, (channel, rows) in enumerate(zip(self.channels, self.segments, strict=True)):
            table = out[:, rows].reshape(self.size, *channel.shape)
            dataset, flickering = self.datasets[i], self._flickering[i]
            keys = [key for key, *_ in dataset._live]
            sums, own = dataset.forward(vector), [slice(None)]
            sweeps = [sums]
            if flickering is not None:
                sweeps, own = [flickering.forward(vector), sums], [slice(0, 1), slice(1, 2)]
            for some, sweep in zip(own, sweeps, strict=True):
                slopes = sweep.derivatives(keys, np.swapaxes(channel.slopes(sweep)[some], 0, 1))
                for key, where, factor, _ in dataset._live:
                    self._add(table[:, some], where, factor * slopes[key])
            if whitened:
                channel.whiten(table, out=table)
            else:
                table *= channel.valid
        seen = self.n_rows - len(self.known)
        out[:, seen:] = self._holds.T
        return out.T if whitened else out.T[:seen]

    def rows(self, masks):
        """Return which rows masks (of each dataset, broadcast) keep; what is known is kept."""
        parts = zip(masks, self.channels, strict=True)
        kept = [np.broadcast_to(mask, channel.shape).ravel() for mask, channel in parts]
        return np.concatenate([*kept, np.ones(len(self.known), dtype=bool)])

    def _add(self, out, where, slope):
        """Add the derivative to a free value, (channels, W, F), to those to its coefficients."""
        first = int(np.min(where))
        owners = zip(self.free.slots, self._blocks, strict=True)
        slot, block = next(o for o in owners if o[0].start <= first < o[0].start + o[0].size)
        rows, at = out[self.slices[slot.name]], np.asarray(where) - slot.start
        if not at.ndim:
            rows[0] += slope
        elif len(block) == len(rows):
            # one number for each wavelength
            rows[at, :, np.arange(len(at))] += slope.swapaxes(0, 1)
        else:
            rows += block[at].T[:, None, :, None] * slope

    # ---- noise -----------------------------------------------------------------------

    def settle_noise(self, coefficients=None, without=None):
        """Measure noise and lamp from residuals, those of frames ``without``, (F,) each, aside."""
        q = self.start if coefficients is None else coefficients
        without = without or [None] * len(self.datasets)
        seen = zip(self.channels, self.datasets, self.differences(q), without, strict=True)
        for channel, dataset, residual, out in seen:
            angles = {stage: angle[0] for stage, angle in dataset.positions.items()}
            saturating = settings(angles, dataset.observations.n_frames)
            told = noise(channel, residual, angles, dataset.bins, out)
            channel.set_noise(told, residual, saturating, out)
        self.fluxes, self.flickering = self.expected(q)

    def expected(self, coefficients):
        """Return the fluxes that a fit expects, without and with flicker."""
        vector, pairs = self.vector(coefficients), zip(self.channels, self.datasets, strict=True)
        found = [expected_fluxes(channel, dataset.forward(vector)) for channel, dataset in pairs]
        return tuple(map(list, zip(*found, strict=True)))

    @property
    def follows_flux(self):
        """Whether an optic follows the flux, for each dataset."""
        return [any(leaf.stage in FLUXES for leaf in leaves(c)) for c in self.measurement.chains]

    def follow(self, fluxes, flickering):
        """Let what follows the flux follow other ones, see `expected`."""
        self.fluxes, self.flickering = fluxes, flickering
        for i in np.flatnonzero(self.follows_flux):
            dataset, chain = self.datasets[i], self.measurement.chains[i]
            dataset._given = _positions(chain, dataset.observations, fluxes[i])
            dataset._place(chain, dataset.frames.T.ravel())
            self._flickering[i] = self._with_flicker(i, chain)

    # ---- fit -------------------------------------------------------------------------

    def fit(self, start=None, rows=None, steps=_MAX_STEPS, share=_ARRIVED_SHARE):
        """Fit by damped Gauss-Newton steps within the bounds (Nielsen 1999, IMM-REP-1999-05).

        Damped steps follow valleys to second order (Transtrum & Sethna 2012, arXiv:1201.5885).
        ``rows`` are those that take part, (n_rows,); a step that lowers chi-square by less than
        ``share`` of it is the last.
        """
        q = self._inside(self.start if start is None else start)
        take = slice(None) if rows is None else rows
        residual, cost = self._cost(q, take)
        converged, damping, slow = not self.size, 0.0, False
        longest = np.zeros(self.size)
        for _ in range(steps):
            # from where the model is not defined no step leads down
            if converged or not np.isfinite(cost):
                break
            slopes, *normal = self._normal(q, residual, take)
            if not np.isfinite(normal[0]).all():
                # the model has no derivative here
                break
            longest, growth = np.maximum(longest, normal[-1]), 2
            while damping < _STUCK:
                damped = damping * (longest / normal[-1]) ** 2
                step, promised = self._step(q, *normal, damped)
                if damping > 0:
                    step = self._bent(q, step, (residual, slopes, take), *normal, damped)
                trial = np.clip(q + step, self.low, self.high)
                there, new = self._cost(trial, take)
                if np.isfinite(new) and new <= cost * (1 + 1e-12):
                    break
                if damping == 0:
                    # what is short at an extremum, as half a wave is, is long beside it
                    with np.errstate(all="ignore"):
                        *_, beside = self._normal(q + _SHORT * step, residual, take)
                    longest = np.maximum(longest, np.where(np.isfinite(beside), beside, 0.0))
                damping, growth = max(growth * damping, _FIRST_DAMPING), 2 * growth
            else:
                break
            small = cost - new < max(_ARRIVED, share * new)
            converged, slow = small and (damping < _FREE or slow), small
            # Nielsen's rule: the better the promise was kept, the less the next step is damped
            kept = (cost - new) / promised if promised > 0 else 0.0
            damping *= min(max(1 / 3, 1 - (2 * kept - 1) ** 3), 2.0)
            damping = damping if damping > _LEAST_DAMPING else 0.0
            q, residual, cost = trial, there, new
        # where no step leads down any more, the bottom is reached as well
        return Fit(q, float(residual @ residual), bool(converged or damping >= _STUCK))

    def _inside(self, q):
        """Return the nearest coefficients within all bounds."""
        q = np.clip(q, self.low, self.high)
        rows, room = self._walls[0], self._walls[1] - self._walls[0] @ q
        if np.all(room > -_AT_WALL):
            return q
        return q + _behind_walls(np.eye(self.size), np.zeros(self.size), rows, room)

    def _cost(self, q, take):
        # a trial may be where the model is not defined; it is not taken then
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            residual = self.residual(q)[take]
        return residual, residual @ residual + np.sum(((q - self.centre) * self.tight) ** 2)

    def _normal(self, q, residual, take):
        """Return derivatives, normal equations of a step in columns of unit length, and lengths."""
        # rows of the transposed table are contiguous
        slopes = self.jacobian(q).T[:, take].T
        gram = slopes.T @ slopes + np.diag(self.tight**2)
        target = slopes.T @ residual + self.tight**2 * (self.centre - q)
        scale = np.sqrt(np.diag(gram))
        # what moves the data by rounding alone has no length
        scale[scale <= np.finfo(float).eps * scale.max(initial=0.0)] = 1.0
        return slopes, gram / np.outer(scale, scale), target / scale, scale

    def _step(self, q, gram, target, scale, damped):
        n = len(scale)
        triangle = _root(gram + (damped + _HOLD**2) * np.eye(n))
        wanted = solve_triangular(triangle, target, trans="T", check_finite=False) if n else target
        low, high = (self.low - q) * scale, (self.high - q) * scale
        found = solve_triangular(triangle, wanted, check_finite=False) if n else wanted
        if np.any((found < low) | (found > high)):
            found = _within(triangle, wanted, low, high, found)
        rows, room = self._walls[0] / scale, self._walls[1] - self._walls[0] @ q
        if np.any(rows @ found > room + _AT_WALL):
            rows = np.concatenate([rows, np.eye(n), -np.eye(n)])
            found = _behind_walls(triangle, wanted, rows, np.concatenate([room, high, -low]))
        return found / scale, found @ (2 * target - gram @ found)

    def _bent(self, q, step, seen, gram, _, scale, damped):
        """Return a damped step that follows the second derivative along it, within all walls."""
        residual, slopes, take = seen
        ahead, _ = self._cost(q + _SHORT * step, take)
        curvature = 2 / _SHORT * ((ahead - residual) / _SHORT + slopes @ step)
        if not np.isfinite(curvature).all():
            return step
        root = _root(gram + (damped + _HOLD**2) * np.eye(len(gram)))
        found = cho_solve((root, False), slopes.T @ curvature / scale, check_finite=False)
        if np.linalg.norm(found) > _CURVED * np.linalg.norm(step * scale):
            return step
        bend = found / scale / 2
        rows, ends = self._walls
        # through no wall
        far, room = rows @ bend, ends + _AT_WALL - rows @ (q + step)
        return step + bend * max(0.0, np.min(room[far > room] / far[far > room], initial=1.0))

    # ---- what follows from a fit --------------------------------------------------------

    def tangent(self, coefficients, jacobian=None, kept=True):
        """
        Return an orthonormal basis of the derivatives, shape (n_rows, rank).

        A coefficient, or a value of a law, at its bound cannot take anything up and is left out,
        as are those that are not kept.
        """
        return orthonormal(self.open_slopes(coefficients, jacobian, kept))

    def at_bound(self, coefficients):
        """Return which coefficients are at their bounds, (n_coefficients,) of bool."""
        below, above = self.low + _AT_BOUND, self.high - _AT_BOUND
        return (coefficients <= below) | (coefficients >= above)

    def open_slopes(self, coefficients, jacobian=None, kept=True):
        """Return the derivatives in the directions that no bound closes, shape (n_rows, k)."""
        inside = ~self.at_bound(coefficients) & kept
        jacobian = self.jacobian(coefficients) if jacobian is None else jacobian
        slopes, (rows, ends) = jacobian[:, inside], self._walls
        held = rows[rows @ coefficients > ends - _AT_WALL][:, inside]
        return slopes @ null_space(held) if len(held) else slopes

    @property
    def n_data(self):
        """Number of rows that hold data, less the numbers that describe the lamps."""
        known = int(np.count_nonzero(self._holds.any(axis=1)))
        return known + sum(channel.n_data for channel in self.channels)

    def decomposed(self, coefficients, jacobian=None):
        """
        Return what data and priors determine: singular values, directions, and scale.

        Of the derivatives with columns of unit length; rows of the second are directions
        in these columns, the third is the length that the columns had.
        """
        jacobian = self.jacobian(coefficients) if jacobian is None else jacobian
        table = np.concatenate([jacobian, np.diag(self.tight)])
        scale = np.linalg.norm(table, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        _, singular, right = np.linalg.svd(triangle(table / scale), full_matrices=False)
        return singular, right, scale


def _along(block, values):
    """Return the coefficients of a law nearest to values, themselves where each is free."""
    if len(block) == block.shape[1]:
        return values
    return np.linalg.lstsq(block, values, rcond=None)[0]


def _within(triangle, wanted, low, high, found):
    """Return the least squares within bounds, given those without.

    What was outside is guessed to be at its bound, and the guess is corrected for all at once
    (Portugal, Judice & Vicente 1994, doi:10.2307/2153286). Where that does not end, as in one of
    2,000 random problems, they are walls like others.
    """
    held = (found < low) | (found > high)
    gram, target = triangle.T @ triangle, triangle.T @ wanted
    tiny = _ROUNDING * np.linalg.norm(wanted)
    for _ in range(_GUESSES):
        found = np.clip(found, low, high)
        if not held.all():
            rest = target[~held] - gram[np.ix_(~held, held)] @ found[held]
            root = _root(gram[np.ix_(~held, ~held)])
            found[~held] = cho_solve((root, False), rest, check_finite=False)
        # where a bound holds, the sum of squares falls outwards only
        inwards = (target - gram @ found) * np.where(found > low, -1.0, 1.0)
        wrong = np.where(held, (inwards > tiny) & (low < high), (found < low) | (found > high))
        if not wrong.any():
            return found
        held ^= wrong
    sides = np.concatenate([np.eye(len(found)), -np.eye(len(found))])
    found = _behind_walls(triangle, wanted, sides, np.concatenate([high, -low]))
    return np.clip(found, low, high)


def _behind_walls(triangle, wanted, rows, room):
    """Return the least squares where no row times the unknowns is above its room.

    Lawson & Hanson (1974), chapter 23: the step from the solution without walls that is the
    shortest in units of the noise, by non-negative least squares.
    """
    real = np.isfinite(room) & rows.any(axis=1)
    rows, ends = rows[real], room[real]
    slopes = solve_triangular(triangle, rows.T, trans="T", check_finite=False).T
    room = ends - slopes @ wanted
    # lengths about one, lest the last row vanish beside the others
    unit = np.max(-room / np.linalg.norm(slopes, axis=1))
    table = np.concatenate([-slopes.T, -room[None] / unit])
    target = np.zeros(len(table))
    target[-1] = 1.0
    left = table @ nnls(table, target, maxiter=30 * len(rows))[0] - target
    found = solve_triangular(triangle, wanted - unit * left[:-1] / left[-1], check_finite=False)
    # rounding may carry it through a wall: back towards where it came from, which is within
    far, slack = rows @ found, ends + _AT_WALL
    return found * max(0.0, np.min(slack[far > slack] / far[far > slack], initial=1.0))


def _root(gram):
    """Return the upper triangle whose square is a matrix, as near to it as rounding allows."""
    try:
        return cholesky(gram, check_finite=False)
    except LinAlgError:
        return cholesky(gram + _ROUNDED * np.eye(len(gram)), check_finite=False)


class Fit:
    """Outcome of a fit."""

    def __init__(self, coefficients, chi2, converged):
        self.coefficients, self.chi2, self.converged = coefficients, chi2, converged


def _positions(chain, observations, fluxes):
    """Return the positions of all stages, fluxes as expected where they are known."""
    found = _read_positions(chain, observations, None)
    if fluxes is None:
        return found
    before = np.concatenate([fluxes[..., :1], fluxes[..., :-1]], axis=-1)
    expected = {
        "flux": fluxes,
        "total_flux": np.stack([fluxes.sum(axis=0)] * 2),
        "previous_flux": np.divide(fluxes, before, out=np.ones_like(fluxes), where=before > 0),
    }
    return found | {stage: expected[stage] for stage in expected.keys() & found.keys()}


def law_basis(wavelength, degree):
    """
    Return the basis of a polynomial law in wavelength (micrometre, (W,)), shape (W, k).

    Legendre polynomials over the range of the wavelengths; one value per wavelength for None.
    """
    n = len(wavelength)
    if degree is None or degree >= n - 1:
        return np.eye(n)
    middle, half = (wavelength.max() + wavelength.min()) / 2, np.ptp(wavelength) / 2
    return np.polynomial.legendre.legvander((wavelength - middle) / half, degree)
