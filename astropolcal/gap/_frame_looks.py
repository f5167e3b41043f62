# Licensed under a 3-clause BSD style license - see LICENSE
"""What single frames say against a nominal model: derivatives, leverages and finite errors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, ndtri, stdtr, stdtrit

from astropolcal.calibration.identifiability.linearized import inverse_root
from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.chain import leaves
from astropolcal.gap.problem import law_basis
from astropolcal.optics import COORDINATES
from astropolcal.propagation import Propagator

__all__ = []

#: Residuals less probable than this are no noise.
NOISE = 1e-3
#: Largest degree in wavelength of the law of a beam's factor.
BEAM_DEGREE = 2
# a direction of which the nominal model takes up all but this share is not seen
_SEEN = 1e-6
# the angles that are tried, and how often the best of them are refined (radian)
_STEP = np.deg2rad(1.0)
_ZOOMS, _POINTS = 6, 13
_MINIMA = 4
# minima that differ by less are alike: the one nearest to the table counts
_ALIKE = 9.0
# and the others are told whose evidence, minus twice its logarithm, is above it by less
_AS_PROBABLE = 2 * np.log(20)
# what the size of an angle's error or of a factor may be: log-uniform between these
_ANGLES = np.deg2rad([0.005, 90.0])
_FACTORS = np.array([1e-4, 2.0])
_NEWTON = 8
# variance of a brightness that no frame tells, by that of a datum
_UNKNOWN = 1e12
# differences that are wrong for no known reason, wavelength by wavelength
_ANY = 0.3
# of fewer wavelengths one is as good as all
_FEW = 3
# noise may have the tails of Student's t of these degrees of freedom, if the likelihood of all data
# is better by so much (its logarithm); with so many degrees of freedom it is a normal distribution
_TAILS, _CLEARLY, _NORMAL = (2.0, 3.0, 4.0, 6.0, 10.0), 10.0, 1e6
#: Evidence that is the same to so many digits is not ordered by what rounding leaves.
DIGITS = 6
_TINY = 1e-6
_BEAMS = {1: "right", -1: "left"}


def angle_stages(chain):
    """Return the stages that turn optics: of each index of the optic in the chain, and sign."""
    found = {}
    for i, leaf in enumerate(leaves(chain)):
        if leaf.stage and leaf.stage not in COORDINATES:
            found.setdefault(leaf.stage, []).append((i, leaf.stage_sign))
    return found


class Look:
    """All frames beside what a nominal model can do; ``out`` are those, (F,), that take no part."""

    def __init__(self, model, coefficients, out):
        self.model, self.problem, self.chains = model, model.problem, model.chains
        self.coefficients, self.out = coefficients, out
        self.vector = self.problem.vector(coefficients)
        numbers = range(len(out))
        self._datasets = list(
            zip(numbers, self.problem.channels, self.problem.segments, strict=True)
        )
        rows = self.problem.rows([~o for o in out])
        #: Of each dataset what the lamp takes up of its sums, (n_rows, k); nothing of groups.
        self.lamps = []
        for _, channel, own in self._datasets:
            count = channel.nuisance.shape[1] if channel.groups is None else 0
            self.lamps.append(np.zeros((self.problem.n_rows, count)))
            # the sums are the second half of the rows of a dataset
            sums = slice((own.start + own.stop) // 2, own.stop)
            self.lamps[-1][sums] = channel.nuisance[:, :count]
        slopes = self.problem.open_slopes(coefficients)
        columns = np.concatenate([slopes, self._of_flux(), *self.lamps], axis=1)
        #: Share of each datum, (2, W, F), that goes to the brightness of the group of a single
        #: beam; of a frame that takes no part, its variance by that of the datum.
        self.shares = [np.zeros(channel.shape) for channel in self.problem.channels]
        columns = self._less_groups(columns)
        #: What the model takes up of a frame that takes part, (n_rows, rank); of one that does
        #: not, how its prediction hangs on the others.
        self.tangent, weight = _basis(columns, rows)
        residual = self._less_groups(self.problem.residual(coefficients)[:, None])[:, 0]
        #: What is left of frames that take part; of others, by how far they miss the prediction.
        self.residual = residual - self.tangent @ (weight.T @ residual)
        #: Sum of squares and degrees of freedom of the frames that take part.
        self.chi2 = float(np.sum(self.residual[rows] ** 2))
        lost = sum(c.count * int(c.valid[:, out[i]].sum()) for i, c, _ in self._datasets)
        lost += self.tangent.shape[1] - sum(lamp.shape[1] for lamp in self.lamps)
        self.freedom = max(self.problem.n_data - lost, 1)

    @property
    def excess(self):
        """Sum of squares beyond that of noise, in units of it."""
        return self.chi2 / self.freedom - 1

    @cached_property
    def is_noise(self):
        """Whether what is left may be noise."""
        return chi2_above(self.chi2, self.freedom) > NOISE

    def _less_groups(self, columns):
        """Return columns, (n_rows, k), less the brightness of groups as frames that count say."""
        for i, channel, rows in self._datasets:
            if channel.groups is None:
                continue
            columns = columns.copy()
            # a datum of unit brightness, in standard deviations
            unit = channel.whiten_frames(np.ones(channel.shape) * channel.valid)[1]
            seen = np.square(unit) * ~self.out[i]
            total = channel.lamp.summed(seen)
            known = np.where(total > 0, total, 1.0)
            table = columns[rows].T.reshape(-1, *channel.shape)
            mean = channel.lamp.summed(table[:, 1] * (unit * ~self.out[i])) / known
            table[:, 1] -= mean * unit
            columns[rows] = table.reshape(len(table), -1).T
            # the only frame of its group that takes part says nothing, nor does any other of it
            self.shares[i][1] = np.where(total > 0, np.square(unit) / known, _UNKNOWN)
        return columns

    def _of_flux(self):
        """Return what background and nonlinearity do to the differences, or sums, (n_rows, k).

        A lamp that is dim in a few frames must not make a background look like their fault.
        """
        blocks = []
        for i, channel, rows in self._datasets:
            right, left = self.sweeps[i].fluxes
            difference = (right - left) / (right + left)
            level = np.where(channel.valid, np.exp(channel.observed[1]), np.nan)
            # of a dataset without data the median would warn
            bright = level / np.nanmedian(level) if channel.valid.any() else level
            bright = np.where(channel.valid, bright, 1.0)
            shapes = (1 / bright, difference / bright, bright * difference * (1 - difference**2))
            shapes = shapes if channel.groups is None else (1 / bright, bright)
            law = self.law(i).T[:, :, None]
            table = np.zeros((len(shapes) * len(law), *channel.shape))
            table[:, channel.told] = np.concatenate([law * one * channel.valid for one in shapes])
            block = np.zeros((self.problem.n_rows, len(table)))
            block[rows] = channel.whiten_frames(table).reshape(len(table), -1).T
            blocks.append(block)
        return np.concatenate(blocks, axis=1)

    def law(self, i):
        """Return the law of a beam's factor at the wavelengths of a dataset, (W, k)."""
        law = law_basis(self.problem.wavelength[self.problem.datasets[i].bins], BEAM_DEGREE)
        # of few wavelengths it is any function: its first column is a constant here, too, and the
        # others have no mean
        few = np.sqrt(len(law)) * np.linalg.qr(np.tril(np.ones(law.shape)))[0]
        return law if len(law) > BEAM_DEGREE + 1 else few

    @cached_property
    def _parts(self):
        """Residual (2, W, F), and tangent (2, W, F, k), of each dataset."""
        return [
            (self.residual[rows].reshape(c.shape), self.tangent[rows].reshape(*c.shape, -1))
            for _, c, rows in self._datasets
        ]

    @cached_property
    def tails(self):
        """Degrees of freedom and width of the noise of frames that take part; see `tails_of`."""
        off = []
        for i, channel, _ in self._datasets:
            residual, taken = self._told(i)
            seen = 1 - np.einsum("faa->fa", taken)
            there = (channel.valid & self.kept(i)).T & (seen > _SEEN)
            off.append(residual[there] / np.sqrt(seen[there]))
        return tails_of(np.concatenate(off))

    # ---- small errors, all frames at once -----------------------------------------------------

    @cached_property
    def sweeps(self):
        """The forward sweep of each dataset."""
        return [dataset.forward(self.vector) for dataset in self.problem.datasets]

    def columns(self, i):
        """Return what an error of each kind does to every frame of a dataset, (k, 2, W, F) each.

        By kind: ``"STAGE angle"`` per radian, ``"right beam"`` and ``"left beam"`` for a law in
        wavelength of the logarithm of the beam's flux.
        """
        channel, sweep = self.problem.channels[i], self.sweeps[i]
        stages, weights = angle_stages(self.chains[i]), channel.slopes(sweep)
        wanted = [(optic, 0) for turned in stages.values() for optic, _ in turned]
        slopes = [sweep.derivatives(wanted, weight) for weight in weights]
        found = {}
        for stage, turned in stages.items():
            both = [sum(sign * slope[optic, 0] for optic, sign in turned) for slope in slopes]
            found[f"{stage} angle"] = np.array([both])
        law = self.law(i).T[:, None, :, None]
        for beam, name in enumerate(("right beam", "left beam")[: channel.count]):
            found[name] = law * np.stack([weight[beam] * sweep.fluxes[beam] for weight in weights])
        return {kind: channel.whiten_frames(c * channel.valid) for kind, c in found.items()}

    def lowering(self, i, columns):
        """Return by how much columns (k, 2, W, F) of one frame each lower chi-square, (F,)."""
        residual, taken = self._parts[i]
        inner = np.einsum("hxaf,gxaf->fhg", columns, columns)
        full = np.einsum("fhh->fh", inner).copy()
        part = np.einsum("xafk,hxaf->fkh", taken, columns, optimize=True)
        inner -= np.einsum("fkh,fkg->fhg", part, part)
        share = np.minimum(self.shares[i], 1.0)
        inner -= np.einsum("xaf,hxaf,gxaf->fhg", share, columns, columns)
        scale = np.sqrt(np.where(full > 0, full, 1.0))
        values, vectors = np.linalg.eigh(inner / scale[:, :, None] / scale[:, None, :])
        along = np.einsum("hxaf,xaf->fh", columns, residual) / scale
        along = np.einsum("fhg,fh->fg", vectors, along)
        return _fall(values, along)

    def deleted(self, i):
        """Return by how much each frame's differences raise chi-square, and their number, (F,).

        That is by how much it falls if a frame that takes part is left out, and by how much it
        rises if one that does not is taken in.
        """
        channel = self.problem.channels[i]
        residual, taken = self._told(i)
        values, vectors = np.linalg.eigh(taken)
        along = np.einsum("fab,fa->fb", vectors, residual)
        share = np.where(self.out[i][:, None], 1 + values, 1 - values)
        return _fall(share, along), channel.valid.sum(axis=0)

    def _told(self, i):
        """Return residual (F, W) of what tells the gap, and what the model absorbs, (F, W, W)."""
        told, (residual, taken) = self.problem.channels[i].told, self._parts[i]
        taken = taken[told].transpose(1, 0, 2)
        own = self.shares[i][told].T[:, :, None] * np.eye(len(residual[told]))
        return residual[told].T, taken @ taken.swapaxes(1, 2) + own

    def kept(self, i):
        """Return which frames of a dataset take part and have data, (F,) of bool."""
        return self.problem.channels[i].valid.any(axis=0) & ~self.out[i]

    def of_frame(self, i, f):
        """Return what the other frames say of the differences of one.

        By how far it misses what is predicted from them, (W,), whitened; the inverse of the
        covariance of this, with the errors of the prediction, (W, W); and the inverse of the noise,
        (W,).
        """
        channel = self.problem.channels[i]
        residual, taken = (part[f] for part in self._told(i))
        weight = channel.whiten_frames(np.ones(channel.shape) * channel.valid)[channel.told, :, f]
        values, vectors = np.linalg.eigh(taken)
        if self.out[i][f]:
            return residual, (vectors / (1 + values)) @ vectors.T, weight
        share = np.where(1 - values > _SEEN, 1 - values, np.inf)
        missed = (vectors / share) @ vectors.T @ residual
        return missed, (vectors * np.maximum(1 - values, 0.0)) @ vectors.T, weight

    def sums_of_frame(self, i, f):
        """Return by how far the sums of a frame miss what others predict, (W,), as `of_frame`.

        And the inverse of the covariance of this, and whitening, (W, W) each.
        """
        channel, missed = self.problem.channels[i], self._parts[i][0][1, :, f]
        n, rows = channel.shape[1], self.problem.segments[i]
        lamp = self.lamps[i][rows].reshape(*channel.shape, -1)[1, :, f]
        single = np.zeros((n, *channel.shape))
        single[:, 1, :, f] = np.diag(channel.valid[:, f].astype(float))
        whiten, left = channel.whiten_frames(single)[:, 1, :, f].T, np.eye(n) - lamp @ lamp.T
        if not self.out[i][f]:
            missed = np.linalg.pinv(left, rcond=_SEEN, hermitian=True) @ missed
        return missed, left, whiten


def tails_of(off):
    """Return the degrees of freedom of Student's t whose tails noise has, and its width.

    The width is where the median of the sizes, one for a normal distribution, puts it.
    """
    if not off.any():
        return _NORMAL, 1.0
    middle, found = ndtri(0.75), {}
    off = np.abs(off) * middle / np.median(np.abs(off))
    for freedom in (_NORMAL, *_TAILS):
        width = float(middle / stdtrit(freedom, 0.75))
        # what is farther out than all of these was left out
        inside = 1 - 2 * stdtr(freedom, -off.max() / width)
        height = gammaln((freedom + 1) / 2) - gammaln(freedom / 2) - np.log(freedom) / 2
        fall = np.log1p(np.square(off / width) / freedom).sum() * (freedom + 1) / 2
        likelihood = off.size * (height - np.log(width * inside)) - fall
        found[freedom, width] = likelihood + _CLEARLY * (freedom == _NORMAL)
    return max(found, key=found.get)


def _fall(values, along):
    """Return the sums over directions that are seen, of eigenvalues and residuals (F, k) along."""
    seen = values > _SEEN
    return np.where(seen, along**2 / np.where(seen, values, 1.0), 0.0).sum(axis=1)


def _basis(columns, rows):
    """Return the basis that is orthonormal in some rows, in all of them, and in these rows only.

    A coefficient that these rows do not determine is left out.
    """
    every = rows.all()
    basis = columns if every else columns * rows[:, None]
    gram = basis.T @ basis
    norm = np.sqrt(np.diag(gram))
    unit = np.diag(1 / np.where(norm > 0, norm, 1.0))[:, norm > 0]
    mix = unit @ inverse_root(unit.T @ gram @ unit, _SEEN**2)
    basis = basis @ mix
    # once more for what that has rounded
    again = inverse_root(basis.T @ basis, 0.5)
    basis = basis @ again
    if every:
        return basis, basis
    whole = basis.copy()
    whole[~rows] = columns[~rows] @ (mix @ again)
    return whole, basis


@dataclass
class Trial:
    """One thing that may be wrong with a frame."""

    what: str
    chi2: float
    #: Minus twice the logarithm of the share of its prior that the data leave.
    cost: float
    #: Angle in radian, or factor of the beam, and its error; NaN where there is none.
    value: float = np.nan
    error: float = np.nan
    #: Index of the other frame of an exchange, and of the only wavelength that is off.
    partner: int | None = None
    bin: int | None = None
    beam: str = ""
    #: Other angles that describe the frame as well, in radian.
    others: tuple = ()

    @property
    def total(self):
        """Minus twice the logarithm of the evidence; of what does the same it is the same."""
        return round(float(self.chi2 + self.cost), DIGITS)


class Frame:
    """One frame's differences beside what all others say of them."""

    def __init__(self, look, i, f, scatter=1.0):
        self.look, self.i, self.f, self.frames, self.scatter = look, i, f, [f], scatter
        self.dataset, self.channel = look.problem.datasets[i], look.problem.channels[i]
        self.valid = self.channel.valid[:, f]
        told, self.single = self.channel.told, self.channel.groups is not None
        sigma = self.channel.sigma[told, :, f] * np.sqrt(scatter)
        self.weight = np.where(self.valid, 1 / sigma, 0.0)
        self.observed = self.channel.observed[told, :, f]
        missed, self._sight, weight = look.of_frame(i, f)
        plain = self.predicted(self._positions([f]))[:, 0]
        # what others say beyond the optics, of background and the like
        missed = np.divide(missed, weight, out=np.zeros(len(weight)), where=weight > 0)
        self._offset = np.where(self.valid, missed - (self.observed - plain), 0.0)
        self._plain, self._root = plain, _root(self._sight)
        missed, left, whiten = look.sums_of_frame(i, f)
        root, narrow = _root(left), 1 / np.sqrt(scatter)
        self._sums = narrow * root @ missed, narrow * root @ whiten

    # ---- predictions ------------------------------------------------------------------------

    def _positions(self, frames):
        """Return the positions of all stages in some frames."""
        given = self.dataset._given.items()
        return {stage: np.atleast_1d(position)[..., frames] for stage, position in given}

    def predicted(self, positions):
        """Return the differences, or log fluxes of a single beam, at some positions, (W, n)."""
        chain, values = self.look.chains[self.i], self.dataset.current_values(self.look.vector)
        propagator = Propagator(chain, self.dataset.propagator.wavelength, positions)
        right, left = propagator.fluxes(values)
        if self.single:
            return np.log(np.maximum(right, _TINY))
        return (right - left) / (right + left)

    def chi2(self, difference):
        """Return the sum of squares that predicted differences (W, n) leave, (n,)."""
        left = self.observed[:, None] - difference + self._offset[:, None]
        left = left * self.weight[:, None]
        return np.einsum("wn,wn->n", left, self._sight @ left)

    # ---- trials -----------------------------------------------------------------------------

    def as_told(self):
        """Return the trial in which nothing is wrong."""
        chi2, cost = float(self.with_positions_of(self.frames)[0]), 0.0
        freedom, width = self.look.tails
        # by how much less than their squares data cost that the tails of the noise hold
        if freedom != _NORMAL and len(self.frames) == 1:
            left = self._root @ ((self.observed - self._plain + self._offset) * self.weight)
            # what is off in one beam is off in its difference and in its sum
            off = np.array([left, self._sums[0] * (not self.single)])[: 2 - self.single]
            square = np.sum(off**2, axis=0)
            cost = (freedom + len(off)) * np.log1p(square / (freedom * width**2))
            cost = float(np.minimum(cost - square, 0.0).sum())
        return Trial("none", chi2, cost)

    def trials(self):
        """Return all trials that need no other frame."""
        stages = [self.angle(stage) for stage in angle_stages(self.look.chains[self.i])]
        law, sides = self.look.law(self.i), (1,) if self.single else _BEAMS
        beams = [self.beam(law[:, : n + 1], side) for n in range(law.shape[1]) for side in sides]
        # every wavelength of the frame is off by its own amount, or one alone
        width = np.log1p((_ANY * self.weight) ** 2)
        unknown = [Trial("unknown", 0.0, float(width[self.valid].sum()))]
        if not self.single:
            # in its differences, or in its sums, too
            missed, whiten = self._sums
            freed = np.log1p(_ANY**2 * np.linalg.eigvalsh(whiten.T @ whiten).clip(0)).sum()
            unknown.append(
                Trial("unknown", -float(missed @ missed), unknown[0].cost + float(freed))
            )
        return [*stages, *beams, *self.wavelength(width, sides), *unknown]

    def wavelength(self, width, sides):
        """Return the trials in which the data of one wavelength are off, of three or more."""
        n = int(self.valid.sum())
        if n < _FEW:
            return []
        left = (self.observed - self._plain + self._offset) * self.weight
        missed, whiten = self._sums
        # an amount of its own in the differences, and one in the sums, which single beams lack
        whiten = whiten * (not self.single)
        seen = np.array([np.diag(self._sight), np.sum(whiten**2, axis=0)])
        along = np.array([self._sight @ left, whiten.T @ missed])
        fall = np.divide(along**2, seen, out=np.zeros(seen.shape), where=seen > _TINY).sum(axis=0)
        best = int(np.argmax(np.where(self.valid, fall, -1.0)))
        cost = width[best] + np.log1p(_ANY**2 * seen[1, best])
        name, chi2 = "one wavelength", self.as_told().chi2 - float(fall[best])
        # or one beam is off there, which a law that bends enough describes as well
        beams = [self.beam(np.eye(len(width))[:, [best]], side) for side in sides]
        each = [Trial(name, chi2, float(cost)), *beams]
        return [Trial(name, one.chi2, one.cost + 2 * np.log(n), bin=best) for one in each]

    def angle(self, stage):
        """Return the trial in which a stage stood elsewhere."""
        told = float(self._positions([self.f])[stage][0])
        grid = np.arange(-np.pi / 2, np.pi / 2, _STEP)
        chi2 = self._turned(stage, grid)
        lowest = np.flatnonzero((chi2 <= np.roll(chi2, 1)) & (chi2 <= np.roll(chi2, -1)))
        lowest = lowest[np.argsort(chi2[lowest], kind="stable")][:_MINIMA]
        found = [self._refined(stage, grid[k]) for k in lowest]
        near = [one for one in found if one[1] < min(value for _, value in found) + _ALIKE]
        offset, chi2 = min(near, key=lambda one: abs(one[0]))
        h = np.deg2rad(0.02)
        low, middle, high = self._turned(stage, offset + np.array([-h, 0.0, h]))
        curvature = (low - 2 * middle + high) / h**2 / 2
        error = 1 / np.sqrt(max(curvature, 1.0))
        cost = _occam(offset, error, _ANGLES)
        far = [(x, y + _occam(x, error, _ANGLES)) for x, y in near if abs(x - offset) > error]
        others = tuple(told + x for x, total in far if total < chi2 + cost + _AS_PROBABLE)
        return Trial(f"{stage} angle", chi2, cost, told + offset, error, others=others)

    def _turned(self, stage, offsets):
        """Return the sum of squares that each of some angles leaves, in all frames, (n,)."""
        positions = self._positions(np.tile(self.frames, len(offsets)))
        positions[stage] = positions[stage] + np.repeat(offsets, len(self.frames))
        return self.chi2(self.predicted(positions))

    def _refined(self, stage, offset):
        half = _STEP
        for _ in range(_ZOOMS):
            grid = offset + np.linspace(-half, half, _POINTS)
            chi2 = self._turned(stage, grid)
            best = int(np.argmin(chi2))
            offset, half = grid[best], 2 * half / (_POINTS - 1)
        return float(offset), float(chi2[best])

    def beam(self, law, side):
        """Return the trial in which the right (1) or left (-1) beam, or a single one, was off.

        The logarithm of the factor is a law in wavelength. The sums take part, too: they tell
        which of the beams it was where the lamp is steady.
        """
        size = np.zeros(law.shape[1])
        for _ in range(_NEWTON):
            left, slopes = self._of_beam(law, size, side)
            inner = slopes.T @ slopes
            step = np.linalg.lstsq(inner, slopes.T @ left, rcond=1e-12)[0]
            size = size + np.clip(step, -1.0, 1.0)
        before, after = (np.sum(self._of_beam(law, x, side)[0] ** 2) for x in (0 * size, size))
        chi2 = self.as_told().chi2 - float(before - after)
        covariance = np.linalg.pinv(inner, hermitian=True)
        errors = np.sqrt(np.diag(covariance))
        # the law is about its mean: other coefficients are of its size or below
        biggest = max(np.abs(size).max(), errors[0])
        cost = _occam(size[0], errors[0], _FACTORS)
        cost += sum(_share(error, 2 * biggest) for error in errors[1:])
        middle = law[self.valid].mean(axis=0)
        mean = float(np.exp(middle @ size))
        error = float(mean * np.sqrt(middle @ covariance @ middle))
        what, beam = ("brightness", "") if self.single else ("one beam", _BEAMS[side])
        return Trial(what, chi2, cost, mean, error, beam=beam)

    def _of_beam(self, law, size, side):
        """Return what a law leaves of differences and sums, and its derivatives; unit noise."""
        factor = law @ size
        if self.single:
            left = (self.observed - self._plain - factor + self._offset) * self.weight
            return self._root @ left, self._root @ (law * self.weight[:, None])
        # normalized differences where the ratio of the beams is changed
        grown = np.tanh(side * factor / 2)
        shifted = (self._plain + grown) / (1 + self._plain * grown)
        left = (self.observed - shifted + self._offset) * self.weight
        slopes = side * law * ((1 - shifted**2) / 2 * self.weight)[:, None]
        share = (1 + side * self._plain) / 2
        brighter = np.log1p(share * np.expm1(factor))
        slope = law * (share * np.exp(factor - brighter))[:, None]
        missed, whiten = self._sums
        left = np.concatenate([self._root @ left, missed - whiten @ brighter])
        return left, np.concatenate([self._root @ slopes, whiten @ slope])

    def with_positions_of(self, frames):
        """Return what is left of the frame if its stages stood as in others, (n,)."""
        return self.chi2(self.predicted(self._positions(frames)))


class Group(Frame):
    """All frames of a group of a single beam, which stood alike and share their brightness."""

    def __init__(self, look, i, f, scatter=1.0):
        self.look, self.i, self.f = look, i, f
        self.dataset, self.channel = look.problem.datasets[i], look.problem.channels[i]
        valid, groups, told = self.channel.valid, self.channel.groups, self.channel.told
        self.frames, self.single = np.flatnonzero(valid.any(axis=0) & (groups == groups[f])), True
        sigma, observed = self.channel.sigma[told], self.channel.observed[told]
        valid, sigma, self.observed = (a[:, self.frames] for a in (valid, sigma, observed))
        self._weight = np.where(valid, 1 / np.square(sigma), 0.0)[:, None] / scatter
        #: Data less the brightness at each wavelength, and less an angle.
        self.freedom = int(valid.sum() - valid.any(axis=1).sum()) - 1

    def trials(self):
        """Return the trials in which a stage stood elsewhere in all frames, the best first."""
        angles = self._positions(self.frames)
        alike = [s for s in angle_stages(self.look.chains[self.i]) if np.ptp(angles[s]) == 0]
        return sorted((self.angle(stage) for stage in alike), key=lambda trial: trial.total)

    def chi2(self, difference):
        """Return the sum of squares that logarithms of the flux (W, n times frames) leave, (n,)."""
        predicted = difference.reshape(len(self.observed), -1, len(self.frames))
        left = self.observed[:, None] - predicted
        total = self._weight.sum(axis=-1, keepdims=True)
        mean = (self._weight * left).sum(axis=-1, keepdims=True) / np.where(total > 0, total, 1.0)
        return (self._weight * (left - mean) ** 2).sum(axis=(0, 2))


def _root(matrix):
    """Return the symmetric root of a symmetric matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _occam(size, error, between):
    """Return the cost of a size that may be any value between two, log-uniform, either sign."""
    density = 1 / (2 * np.log(between[1] / between[0]) * max(abs(size), between[0]))
    return _share(error, 1 / density)


def _share(error, width):
    """Return minus twice the logarithm of the share of a width that an error leaves."""
    return float(-2 * np.log(min(np.sqrt(2 * np.pi) * error / width, 1.0)))
