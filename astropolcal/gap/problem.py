# Licensed under a 3-clause BSD style license - see LICENSE
"""
Residuals and derivatives of chains in both channels, and their fit.

Parameters given per wavelength may follow a law in wavelength: a basis with
one column a coefficient. What is fitted is the flat vector of coefficients.
"""

from itertools import pairwise

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.optimize import lsq_linear

from astropolcal.exceptions import FitError
from astropolcal.gap.channels import Channels
from astropolcal.measurement import Measurement
from astropolcal.measurement.datasets import _positions as _read_positions

__all__ = ["Fit", "GapProblem", "law_basis", "orthonormal"]

_MAX_STEPS = 40
# a step that lowers chi-square by less than this, or than this share of it, has arrived
_ARRIVED, _ARRIVED_SHARE = 1e-4, 1e-5
# keeps what the data do not determine where it is
_HOLD = 1e-6
# Marquardt's damping, of columns of unit length: where it begins, below what it is dropped,
# below what it does not count, and above what no step leads down
_FIRST_DAMPING, _LEAST_DAMPING, _FREE, _STUCK = 1e-5, 1e-7, 1e-3, 1e3
# the share of the frames' freedom that harmonics may take from the measure of the noise
_MOST_TURNING = 0.7
# a coefficient closer to its bound than this (canonical units) sits at it
_AT_BOUND = 1e-9


def law_basis(wavelength, degree):
    """
    Return the basis of a polynomial law in wavelength.

    Parameters
    ----------
    wavelength : `~numpy.ndarray`
        Micrometre, shape (W,).
    degree : int or None
        Degree of the polynomial (Legendre, over the range of the wavelengths);
        None for one value a wavelength.

    Returns
    -------
    `~numpy.ndarray`
        Shape (W, k).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.problem import law_basis
    >>> law_basis(np.array([1.0, 1.5, 2.0]), 1).tolist()
    [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    n = len(wavelength)
    if degree is None or degree >= n - 1:
        return np.eye(n)
    middle, half = (wavelength.max() + wavelength.min()) / 2, np.ptp(wavelength) / 2
    return np.polynomial.legendre.legvander((wavelength - middle) / half, degree)


class GapProblem:
    """
    Chains against all frames of their datasets, whitened by the noise.

    Parameters
    ----------
    chains : sequence
        The chain of each dataset.
    observations : sequence of Observations
        The datasets.
    ties : dict of str to Tie, optional
        Parameters that follow others.
    laws : dict of str to `~numpy.ndarray`, optional
        Basis (W, k) of parameters given per wavelength, ``"optic.parameter"``.
    priors : dict of str to float, optional
        Standard deviation (canonical) of a normal prior on the coefficients of
        a parameter.
    neutral : dict of str to float, optional
        Value (canonical) about which a parameter's prior and limits are, by
        default 0: that at which an effect is absent.
    limits : dict of str to float, optional
        The most (canonical) by which a parameter may differ from that value. A
        parameter that follows a law is not held to it.
    like : GapProblem, optional
        Another problem of the same data whose noise, lamp and fluxes are taken
        over; by default `settle_noise` must be called.
    copy : bool
        Whether to copy the chains; without it values are put back into those given.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.problem import GapProblem
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> problem = GapProblem([charis.chain()], [observations])
    >>> problem.settle_noise()
    >>> bool(problem.fit().chi2 < 1.2 * problem.n_rows)
    True
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
        copy=True,
    ):
        self.ties, self.laws, self.priors = dict(ties or {}), dict(laws or {}), dict(priors or {})
        self.neutral, self.limits = dict(neutral or {}), dict(limits or {})
        chains, observations = list(chains), list(observations)
        self.fluxes = [None] * len(chains) if like is None else like.fluxes
        self.measurement = Measurement(
            chains,
            observations,
            observable="normalized_single_difference",
            ties=ties,
            copy=copy,
            positions=[
                _positions(*each) for each in zip(chains, observations, self.fluxes, strict=True)
            ],
        )
        self.datasets = self.measurement.datasets
        self.free = self.measurement.free
        self.wavelength = self.measurement.wavelength
        self.channels = [Channels(d) for d in self.datasets] if like is None else like.channels
        self._set_laws(self.laws)
        sizes = [channel.observed.size for channel in self.channels]
        edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        #: Slice of the rows that belongs to each dataset.
        self.segments = [slice(a, b) for a, b in pairwise(edges)]
        self.n_rows = int(edges[-1])
        self.start = self._coefficients(self.free.start())
        self.tight = np.zeros(self.size)
        for name, sigma in self.priors.items():
            self.tight[self.slices[name]] = 1 / sigma
        self.centre = np.where(self.tight > 0, self._coefficients(self._absent()), 0.0)

    def _absent(self):
        """Return the vector of values about which the priors are."""
        vector = np.zeros(self.free.size)
        for slot in self.free.slots:
            vector[slot.slice] = self.neutral.get(slot.name, 0.0)
        return vector

    def _set_laws(self, laws):
        """Note the linear map from the coefficients to the flat vector."""
        blocks, self.names, self.slices = [], [], {}
        low, high = self._bounds()
        self.low, self.high, start = [], [], 0
        for slot in self.free.slots:
            basis = laws.get(slot.name)
            follows = basis is not None and slot.per_wavelength and np.shape(basis)[1] < slot.size
            block = basis if follows else np.eye(slot.size)
            blocks.append(block)
            k = block.shape[1]
            self.slices[slot.name] = slice(start, start + k)
            self.names += [slot.name if k == 1 else f"{slot.name}[{i}]" for i in range(k)]
            self.low += [-np.inf] * k if follows else list(low[slot.slice])
            self.high += [np.inf] * k if follows else list(high[slot.slice])
            start += k
        self._blocks = blocks
        self.low, self.high = np.array(self.low), np.array(self.high)
        self.size = start

    def _bounds(self):
        """Return the bounds of the flat vector: those of the chains, or narrower limits."""
        low, high = (np.array(bound, dtype=float) for bound in self.free.bounds())
        absent = self._absent()
        for slot in self.free.slots:
            room, where = self.limits.get(slot.name, np.inf), slot.slice
            low[where] = np.maximum(low[where], absent[where] - room)
            high[where] = np.minimum(high[where], absent[where] + room)
        return low, high

    def _coefficients(self, vector):
        parts = [
            np.linalg.lstsq(block, vector[slot.slice], rcond=None)[0]
            for slot, block in zip(self.free.slots, self._blocks, strict=True)
        ]
        return np.concatenate(parts) if parts else np.empty(0)

    def vector(self, coefficients):
        """Return the canonical values of the free parameters, shape (n_free,)."""
        parts = [
            block @ coefficients[self.slices[slot.name]]
            for slot, block in zip(self.free.slots, self._blocks, strict=True)
        ]
        return np.concatenate(parts) if parts else np.empty(0)

    # ---- data ------------------------------------------------------------------------

    def differences(self, coefficients):
        """Return observed minus predicted of each dataset, arrays (2, W, F)."""
        vector = self.vector(coefficients)
        return [
            np.where(c.valid, c.observed - c.predicted(d.forward(vector)), 0.0)
            for c, d in zip(self.channels, self.datasets, strict=True)
        ]

    def residual(self, coefficients):
        """Return the whitened residuals, shape (n_rows,)."""
        parts = zip(self.channels, self.differences(coefficients), strict=True)
        return np.concatenate([channel.whiten(r).ravel() for channel, r in parts])

    def jacobian(self, coefficients, whitened=True):
        """Return the derivative of the predicted rows, shape (n_rows, n_coefficients)."""
        vector = self.vector(coefficients)
        out = np.empty((self.size, self.n_rows))
        for channel, dataset, rows in zip(self.channels, self.datasets, self.segments, strict=True):
            slopes = self._slopes(channel, dataset, vector)
            slopes = channel.whiten(slopes) if whitened else slopes
            out[:, rows] = slopes.reshape(self.size, rows.stop - rows.start)
        return out.T

    def _slopes(self, channel, dataset, vector):
        """Return the derivative of a dataset's channels, shape (n_coefficients, 2, W, F)."""
        sweep = dataset.forward(vector)
        keys = [key for key, *_ in dataset._live]
        out = np.zeros((self.size, *channel.shape))
        for i, weights in enumerate(channel.slopes(sweep)):
            slopes = sweep.derivatives(keys, weights)
            for key, where, factor, _ in dataset._live:
                self._add(out[:, i], where, factor * slopes[key], dataset)
        return out * channel.valid

    def _add(self, out, where, slope, dataset):
        slot, block = self._owner(where)
        rows = out[self.slices[slot.name]]
        if np.ndim(where):
            rows += block[np.asarray(where) - slot.start].T[:, :, None] * slope
        else:
            rows[0] += slope

    def _owner(self, where):
        first = int(np.min(where))
        for slot, block in zip(self.free.slots, self._blocks, strict=True):
            if slot.start <= first < slot.start + slot.size:
                return slot, block
        raise AssertionError(where)

    # ---- noise -----------------------------------------------------------------------

    def settle_noise(self, coefficients=None):
        """Measure noise and lamp from the residuals at some coefficients."""
        q = self.start if coefficients is None else coefficients
        for channel, dataset, residual in zip(
            self.channels, self.datasets, self.differences(q), strict=True
        ):
            angles = {stage: angle[0] for stage, angle in dataset.positions.items()}
            settings = _settings(angles, dataset.observations.n_frames)
            noise = _noise(channel, residual, angles)
            channel.set_noise(noise, residual, settings)
        self.fluxes = [
            _expected_fluxes(channel, dataset.forward(self.vector(q)))
            for channel, dataset in zip(self.channels, self.datasets, strict=True)
        ]

    # ---- fit -------------------------------------------------------------------------

    def fit(self, start=None, rows=None, held=None, steps=_MAX_STEPS, share=_ARRIVED_SHARE):
        """
        Fit by damped Gauss-Newton steps within the bounds (Nielsen 1999, IMM-REP-1999-05).

        Parameters
        ----------
        start : `~numpy.ndarray`, optional
            Coefficients to start from.
        rows : `~numpy.ndarray` of bool, optional
            Rows that take part, shape (n_rows,).
        held : `~numpy.ndarray` of bool, optional
            Coefficients that stay.
        steps : int
            The most steps.
        share : float
            A step that lowers chi-square by less than this share of it is the last.

        Returns
        -------
        Fit
        """
        q = np.clip(self.start if start is None else start, self.low, self.high)
        live = np.ones(self.size, dtype=bool) if held is None else ~held
        take = slice(None) if rows is None else rows
        residual, cost = self._cost(q, take)
        converged, damping, slow = not live.any(), 0.0, False
        for _ in range(steps):
            if converged:
                break
            reduced, growth = self._reduced(q, residual, take, live), 2
            while damping < _STUCK:
                step, promised = self._step(q, live, *reduced, damping)
                trial = np.clip(q + step, self.low, self.high)
                there, new = self._cost(trial, take)
                if np.isfinite(new) and new <= cost * (1 + 1e-12):
                    break
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

    def _cost(self, q, take):
        # a trial may be where the model is not defined; it is not taken then
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            residual = self.residual(q)[take]
        return residual, residual @ residual + np.sum(((q - self.centre) * self.tight) ** 2)

    def _reduced(self, q, residual, take, live):
        """Return the least-squares problem of a step with as many rows as coefficients."""
        slopes = self.jacobian(q)[take][:, live]
        scale = np.sqrt(np.sum(slopes**2, axis=0) + self.tight[live] ** 2)
        scale = np.where(scale > 0, scale, 1.0)
        matrix, target = _triangle(slopes / scale, residual)
        offset = (self.centre - q)[live] * self.tight[live]
        matrix = np.concatenate([matrix, np.diag(self.tight[live] / scale)])
        return scale, matrix, np.concatenate([target, offset])

    def _step(self, q, live, scale, matrix, target, damping):
        n = len(scale)
        held = np.concatenate([matrix, np.sqrt(damping + _HOLD**2) * np.eye(n)])
        triangle, wanted = _triangle(held, np.concatenate([target, np.zeros(n)]))
        low = (self.low[live] - q[live]) * scale
        high = (self.high[live] - q[live]) * scale
        found = solve_triangular(triangle, wanted, check_finite=False) if n else wanted
        if np.any((found < low) | (found > high)):
            slack = 1e-9 * np.maximum(1.0, scale)
            found = lsq_linear(triangle, wanted, (low - slack, high + slack), method="bvls").x
            found = np.clip(found, low, high)
        left = matrix @ found - target
        step = np.zeros(self.size)
        step[live] = found / scale
        return step, target @ target - left @ left

    # ---- what follows from a fit --------------------------------------------------------

    def tangent(self, coefficients):
        """
        Return an orthonormal basis of the derivatives, shape (n_rows, rank).

        A coefficient at its bound cannot take anything up and is left out.
        """
        inside = (coefficients > self.low + _AT_BOUND) & (coefficients < self.high - _AT_BOUND)
        return orthonormal(self.jacobian(coefficients)[:, inside])

    @property
    def n_data(self):
        """Number of rows that hold data, less the numbers that describe the lamps."""
        return sum(2 * int(c.valid.sum()) - c.n_nuisance for c in self.channels)

    def errors(self, coefficients):
        """Return the standard errors of the coefficients, infinite where they are open."""
        slopes = self.jacobian(coefficients)
        table = np.concatenate([slopes, np.diag(self.tight)])
        scale = np.linalg.norm(table, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        _, singular, right = np.linalg.svd(table / scale, full_matrices=False)
        good = singular > 1e-7 * singular[0]
        variance = np.sum((right[good] / singular[good, None]) ** 2, axis=0)
        is_open = np.sum(right[~good] ** 2, axis=0) > 1e-6
        prior = np.divide(1, self.tight, out=np.full(self.size, np.inf), where=self.tight > 0)
        return np.minimum(np.where(is_open, np.inf, np.sqrt(variance) / scale), prior)


def _triangle(matrix, target):
    """Return the same least-squares problem with a triangle for its matrix."""
    n = matrix.shape[1]
    table = np.concatenate([matrix, target[:, None]], axis=1)
    factors = qr(table, mode="raw", check_finite=False, overwrite_a=True)[0][0][:n]
    return np.triu(factors[:, :n]), factors[:, n].copy()


def orthonormal(columns, keep=1e-9):
    """
    Return an orthonormal basis of columns.

    Parameters
    ----------
    columns : `~numpy.ndarray`
        Shape (n_rows, k).
    keep : float
        Directions below this share of the strongest are left out; columns are
        compared at unit length.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_rows, rank).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.problem import orthonormal
    >>> orthonormal(np.array([[1.0, 2.0], [1.0, 2.0]])).shape
    (2, 1)
    """
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    if not columns.shape[1]:
        return np.zeros((len(columns), 0))
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > keep * singular[0]]


class Fit:
    """
    Outcome of a fit.

    Parameters
    ----------
    coefficients : `~numpy.ndarray`
        The solution.
    chi2 : float
        Sum of squares of the whitened residuals.
    converged : bool
        Whether the last step changed next to nothing.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.problem import Fit
    >>> Fit(np.zeros(1), 12.0, True).chi2
    12.0
    """

    def __init__(self, coefficients, chi2, converged):
        self.coefficients, self.chi2, self.converged = coefficients, chi2, converged


def _expected_fluxes(channel, sweep):
    """
    Return the fluxes of both beams as chain and lamp give them, shape (2, W, F).

    An effect that depends on the flux must not depend on the noise of the datum
    that it is to explain.
    """
    right, left = sweep.fluxes
    level = channel.observed[1] - np.log(right + left)
    weight = channel.valid / np.square(channel.sigma[1])
    level = np.where(channel.valid, level, 0.0)
    scale = (level * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    certain = np.maximum(weight.sum(axis=0), 1e-300)
    shift = ((level - scale[:, None]) * weight).sum(axis=0) / certain
    shift = channel.lamp.brightness(shift, certain)
    lamp = np.exp(scale[:, None] + shift)
    return np.stack([right * lamp, left * lamp])


def _positions(chain, observations, fluxes):
    """Return the positions of all stages, fluxes as expected where they are known."""
    found = _read_positions(chain, observations, None)
    if fluxes is None:
        return found
    before = np.concatenate([fluxes[..., :1], fluxes[..., :-1]], axis=-1)
    expected = {
        "flux": fluxes,
        "total_flux": np.stack([fluxes.sum(axis=0)] * 2),
        "previous_flux": fluxes / before,
    }
    return found | {stage: expected[stage] for stage in expected.keys() & found.keys()}


def _by_state(waves, angles):
    """Return the waves, and for a modulator with two states those that change sign with them."""
    state = angles.get("flc_state", np.zeros(1))
    return (
        waves
        if np.ptp(state) == 0
        else [w for wave in waves for w in (wave, wave * (1 - 2 * state))]
    )


def _settings(angles, n):
    """
    Return what optics could do to the sums: columns of the plate angle, (F, k).

    Not of the derotator angle alone, which changes as slowly as a lamp drifts.
    """
    if "hwp" not in angles:
        return np.zeros((n, 0))
    plate = angles["hwp"]
    waves = [np.exp(1j * k * plate) for k in (2, 4)]
    columns = list(waves)
    if "derotator" in angles:
        turn = np.exp(2j * angles["derotator"])
        columns += [wave * other for wave in waves for other in (turn, turn.conj())]
    columns += [np.exp(1j * k * plate) for k in (1, 3, 6, 8)]
    columns = _by_state(columns, angles)[: n // 6]
    return np.stack([part(c) for c in columns for part in (np.real, np.imag)], axis=1).reshape(
        n, -1
    )


def _noise(channel, residual, angles):
    """
    Return the noise of every datum: the stated errors, or more where the data say so.

    What optics that stand still or turn can do to a beam is a sum of a few
    harmonics of the stages' angles, sharp in wavelength or not; everything else
    is smooth in wavelength. So noise is what is left without either.
    """
    sigma = np.sqrt(channel.variance)
    basis = _turning(angles, channel.valid)
    for i in range(2):
        rough = _roughness(residual[i], channel.valid, basis)
        stated = np.isfinite(sigma[i]) & (sigma[i] > 0) & channel.valid
        if not stated.any():
            if not rough > 0:
                raise FitError("no errors in the table, and the residuals tell no noise")
            sigma[i] = rough
            continue
        if np.isfinite(rough):
            sigma[i] *= max(1.0, rough / _roughness_of(sigma[i], channel.valid))
        sigma[i] = np.where(stated, sigma[i], np.median(sigma[i][stated]))
    return sigma


def _turning(angles, valid):
    """Return an orthonormal basis of the harmonics of the stages, (F, k); k may be 0."""
    waves = [np.ones(valid.shape[1], dtype=complex)]
    for stage, orders in (("hwp", (2, 4)), ("derotator", (2, 4))):
        if stage in angles:
            turns = [np.exp(1j * k * angles[stage]) for k in orders]
            waves += [wave * t for wave in waves for turn in turns for t in (turn, turn.conj())]
    waves = _by_state(waves, angles)
    whole = valid.all(axis=0)
    columns = np.concatenate([part(np.array(waves)) for part in (np.real, np.imag)]).T
    basis = orthonormal(columns * whole[:, None], keep=1e-6)
    # too few frames would be left to tell the noise
    return basis if basis.shape[1] <= _MOST_TURNING * whole.sum() else basis[:, :0]


def _roughness(residual, valid, basis):
    """Return the scatter of second differences along the wavelengths, per datum."""
    if len(residual) < 5:
        return np.nan
    whole = valid.all(axis=0) if basis.shape[1] else np.ones(valid.shape[1], dtype=bool)
    left = np.where(whole, residual, 0.0)
    left = left - (left @ basis) @ basis.T
    second = (left[:-2] - 2 * left[1:-1] + left[2:]) / np.sqrt(6)
    second = second - np.median(second, axis=1, keepdims=True)
    keep = valid[:-2] & valid[1:-1] & valid[2:] & whole
    shrunk = np.sqrt(1 - basis.shape[1] / whole.sum())
    return float(1.4826 * np.median(np.abs(second[keep])) / shrunk) if keep.any() else np.nan


def _roughness_of(sigma, valid):
    total = np.sqrt((sigma[:-2] ** 2 + 4 * sigma[1:-1] ** 2 + sigma[2:] ** 2) / 6)
    keep = valid[:-2] & valid[1:-1] & valid[2:]
    return float(np.median(total[keep]))
