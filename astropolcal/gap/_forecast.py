# Licensed under a 3-clause BSD style license - see LICENSE
"""
What data know already, and what new exposures would add.

Used by `astropolcal.gap.planning`, which says what is asked of it.
"""

from functools import cached_property
from itertools import pairwise

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.linalg import qr

from astropolcal.calibration._directions import ranked
from astropolcal.chain import leaves, remove_optic
from astropolcal.exceptions import GapError
from astropolcal.gap.effects import Roles
from astropolcal.gap.problem import GapProblem, orthonormal
from astropolcal.optics import COORDINATES
from astropolcal.simulation import simulate

MODULATOR, STATES = "flc_state", ("A", "B")
#: What cannot be seen to one standard deviation is not worth an exposure.
LEAST_GAIN = 1.0
# singular values of unit columns below this are open directions
_OPEN = 1e-6
# a change of this size (radian or relative) has to be seen
_WANTED = 0.01


# ---- what the data know already -------------------------------------------------------------


class Known:
    """A fitted model, and the triangle of its least-squares problem on the data taken."""

    def __init__(self, member, base):
        self.member, self.base, self.problem = member, base, member.problem
        q = member.fit.coefficients
        raw = self.problem.jacobian(q, whitened=False).T
        slopes = np.concatenate(
            [
                c.whiten(raw[:, rows].reshape(-1, *c.shape)).reshape(len(raw), -1)
                for c, rows in zip(base.problem.channels, base.problem.segments, strict=True)
            ],
            axis=1,
        ).T
        self.slopes = np.concatenate([slopes, np.diag(self.problem.tight)])
        self.scale = np.linalg.norm(self.slopes, axis=0)
        self.scale = np.where(self.scale > 0, self.scale, 1.0)
        # observed minus predicted: the difference of two such is that of the predictions
        self.gaps = self.problem.differences(q)
        self._triangles = {}

    def triangle(self, other):
        """Return the triangle of slopes and of the difference to another model's predictions."""
        if id(other) not in self._triangles:
            parts = zip(self.base.problem.channels, self.gaps, other.gaps, strict=True)
            difference = [c.whiten(mine - theirs).ravel() for c, mine, theirs in parts]
            target = np.concatenate([*difference, np.zeros(self.problem.size)])
            # the last column of the triangle holds what the slopes cannot take up, in its last row
            table = np.concatenate([self.slopes / self.scale, target[:, None]], axis=1)
            self._triangles[id(other)] = qr(table, mode="r")[0][: table.shape[1]]
        return self._triangles[id(other)]

    @cached_property
    def directions(self):
        """Directions of unit columns that the data determine, and those that they leave open."""
        _, singular, right = np.linalg.svd(self.slopes / self.scale, full_matrices=False)
        is_open = singular < _OPEN * singular[0]
        return right[~is_open].T, right[is_open].T

    def fixes(self, columns):
        """
        Return what new rows say of the open directions.

        That is the parameters of the one seen best, at how many standard deviations a
        change of it shows, and how many directions show at all.
        """
        known, unknown = self.directions
        table = np.concatenate([self.slopes, columns]) / self.scale
        basis = orthonormal(table @ known)
        left = table @ unknown
        # twice is enough to be orthogonal to rounding
        left -= basis @ (basis.T @ left)
        left -= basis @ (basis.T @ left)
        _, singular, right = np.linalg.svd(left, full_matrices=False)
        steps = np.abs(unknown @ right.T) / self.scale[:, None]
        sigmas = _WANTED * singular / steps.max(axis=0)
        best = int(ranked(sigmas)[0])
        step = steps[:, best]
        main = [i for i in ranked(step)[:3] if step[i] > 0.3 * step.max()]
        names = [self.problem.names[i] for i in main]
        return names, float(sigmas[best]), int(np.sum(sigmas > LEAST_GAIN))


# ---- what it would see -----------------------------------------------------------------------


class Foreseen:
    """Predictions of a fitted model, and their slopes, for exposures of one set-up."""

    def __init__(self, old, base, group):
        member, first = old.member, group[0]
        chain = _set_up(member.chains[first.dataset], first)
        observations = _hypothetical(base, group)
        own = {leaf.name for leaf in leaves(chain)}
        ties = {
            name: tie
            for name, tie in member.problem.ties.items()
            if name.split(".")[0] in own and tie.source.split(".")[0] in own
        }
        problem = GapProblem([chain], [observations], ties=ties, laws=member.problem.laws)
        channel, vector = problem.channels[0], problem.vector(problem.start)
        self.predicted = channel.predicted(problem.datasets[0].forward(vector))
        slopes = problem.jacobian(problem.start, whitened=False).T.reshape(-1, *channel.shape)
        self.slopes = np.zeros((member.problem.size, *channel.shape))
        for name, where in problem.slices.items():
            self.slopes[member.problem.slices[name]] = slopes[where]
        edges = np.cumsum([0, *(one.n_frames for one in group)])
        self.frames = [slice(a, b) for a, b in pairwise(edges)]
        self.noise = _Noise(base, first)

    def columns(self, j):
        """Return the whitened slopes of one exposure, shape (rows, n_coefficients)."""
        whitened = self.noise.whiten(self.slopes[..., self.frames[j]])
        return whitened.reshape(len(whitened), -1).T

    def against(self, other, j):
        """Return the whitened difference of the predictions of one exposure."""
        frames = self.frames[j]
        return self.noise.whiten(other.predicted[..., frames] - self.predicted[..., frames]).ravel()


def separation(old, new, truth, fitted, j):
    """Return by how many standard deviations an exposure speaks against a wrong model."""
    triangle = old[fitted].triangle(old[truth])
    added = np.column_stack(
        [new[fitted].columns(j) / old[fitted].scale, new[fitted].against(new[truth], j)]
    )
    table = np.concatenate([triangle, added])
    basis = orthonormal(table[:, :-1])
    left = table[:, -1] - basis @ (basis.T @ table[:, -1])
    return float(np.sqrt(max(left @ left - triangle[-1, -1] ** 2, 0.0)))


def _set_up(chain, exposure):
    """Return a copy of a chain as the exposure needs it."""
    chain = chain.copy()
    polarizer = Roles(chain).polarizer
    if exposure.polarizer_turned:
        if polarizer is None:
            raise GapError("no polarizer to turn in the chain of this dataset")
        angle = exposure.polarizer_turned
        theta = polarizer.theta
        theta.bounds = tuple(None if b is None else b + angle for b in theta.bounds)
        theta.value = theta.value + angle
    for name in exposure.without:
        chain = remove_optic(chain, name)
    return chain


def _hypothetical(base, group):
    """Return noiseless observations of the exposures, as bright as their dataset."""
    i, exposure = group[0].dataset, group[0]
    problem, observations = base.problem, base.observations[group[0].dataset]
    chain = _set_up(base.chains[i], exposure)
    for leaf in leaves(chain):
        if leaf.stage in COORDINATES and leaf.stage != MODULATOR:
            chain = remove_optic(chain, leaf.name)
    sweep = problem.datasets[i].forward(problem.vector(base.fit.coefficients))
    expected = np.median(np.sum(sweep.fluxes, axis=0), axis=1)
    measured = np.exp(_middle(problem.channels[i], problem.channels[i].observed[1]))
    # of a wavelength without a datum nothing is asked: any flux will do
    measured = np.where(np.isfinite(measured), measured, expected)
    frames = QTable({"hwp": np.concatenate([one.plate for one in group]) * u.deg})
    for name, _ in exposure.positions:
        values = [np.full(one.n_frames, dict(one.positions)[name]) for one in group]
        frames[name] = np.concatenate(values) * u.deg
    if "derotator" not in frames.colnames:
        # tables have it, also those of instruments without one
        frames["derotator"] = np.zeros(len(frames)) * u.deg
    if exposure.states:
        states = np.concatenate([one.modulator for one in group])
        frames[MODULATOR] = (states == STATES[1]).astype(float)
    return simulate(
        chain,
        problem.wavelength * u.um,
        frames,
        flux=exposure.lamp * measured / expected,
        noise=False,
        name=f"next {observations.name}",
    )


def _middle(channel, values):
    """Return the median of values (..., W, F) over the frames, NaN at a wavelength without data."""
    found, some = np.full(values.shape[:-1], np.nan), channel.valid.any(axis=1)
    known = np.where(channel.valid, values, np.nan)
    found[..., some] = np.nanmedian(known[..., some, :], axis=-1)
    return found


class _Noise:
    """Noise of new frames: that of the dataset, and a lamp of unknown brightness."""

    def __init__(self, base, exposure):
        channel = base.problem.channels[exposure.dataset]
        self.weight = np.sqrt(exposure.lamp) / _middle(channel, channel.sigma)[..., None]
        self.flicker = channel.lamp.flicker

    def whiten(self, array):
        """Divide by the noise; take out flicker and the brightness at each wavelength."""
        weight = np.where(np.isfinite(self.weight), self.weight, 0.0)
        out = array * weight
        # the brightness at each wavelength is that of this block alone
        sums = out[..., 1, :, :] - out[..., 1, :, :].mean(axis=-1, keepdims=True)
        norm = np.sqrt(np.sum(weight[1] ** 2))
        direction = weight[1] / (norm if norm > 0 else 1.0)
        shrink = 1 - 1 / np.sqrt(1 + (self.flicker * norm) ** 2)
        common = np.sum(sums * direction, axis=-2, keepdims=True)
        out[..., 1, :, :] = sums - shrink * common * direction
        return out
