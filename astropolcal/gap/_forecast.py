# Licensed under a 3-clause BSD style license - see LICENSE
r"""
What exposures that were not taken would tell of causes and of parameters.

Everything is linear about a fitted model. With the normal equations H of what a cause and the
parameters do to the data taken, and the derivatives N of new data, the new data are foreseen with
the covariance :math:`V = 1 + N H^{-1} N^T`. If another cause is the truth and new data differ by d
from what this one foresees, they speak against it by half of :math:`d^T V^{-1} d`, and by what V
says of its freedom. Of the new data only the products of their derivatives are needed.
"""

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.linalg import cho_factor, cho_solve

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.chain import Train, join, leaves
from astropolcal.exceptions import GapError
from astropolcal.gap.effects import Roles
from astropolcal.gap.problem import OPEN, GapProblem, orthonormal
from astropolcal.optics import COORDINATES
from astropolcal.simulation import simulate

MODULATOR, STATES = "flc_state", ("A", "B")
#: What cannot be seen to one standard deviation is not worth an exposure.
LEAST_GAIN = 1.0
# a change of this size (radian or relative) has to be seen
_WANTED = 0.01
# nearer to a bound is at it
_AT_BOUND = 1e-9
# keeps open directions where they are, of columns of unit length; sizes are known within this
# factor of the usual one
_HOLD, _WIDE = 1e-10, 3.0


class Forecast:
    """
    A fitted model with all causes that are asked about, and what the data say of each of them.

    Parameters
    ----------
    model : Model
        The fitted model; causes may be in it.
    recipes : sequence of tuple
        Effect and context of each cause, the latter None for that of the data.
    """

    def __init__(self, model, recipes):
        self.model, base = model, model.problem
        chains, ties, laws, added = model.trains, dict(base.ties), dict(base.laws), {}
        for effect, context in recipes:
            if effect.name in model.added:
                added[effect.name] = model.added[effect.name]
            elif effect.name not in added and effect.applies(chains):
                edit = effect.edit(chains, context or model.context)
                chains, ties, laws = edit.chains, ties | edit.ties, laws | edit.laws
                added[effect.name] = edit.parameters
        self.chains, self.ties, self.laws = chains, ties, laws
        self.problem = GapProblem(chains, model.observations, ties=ties, laws=laws, like=base)
        problem, q = self.problem, self.problem.start
        every = np.arange(problem.size)
        #: Coefficients of each cause that has a place.
        self.own = {}
        for name, some in added.items():
            rows = [every[problem.slices[p.name]] for p in some if p.name in problem.slices]
            if sum(map(len, rows)):
                self.own[name] = np.concatenate(rows)
        slopes, residual = problem.jacobian(q), problem.residual(q)
        tight = np.zeros(problem.size)
        for name, sigma in base.priors.items():
            tight[problem.slices[name]] = 1 / sigma**2
        absent = np.zeros(problem.free.size)
        for one in (p for some in added.values() for p in some if p.name in problem.slices):
            tight[problem.slices[one.name]] = 1 / (_WIDE * one.canonical_scale) ** 2
            absent[problem.free.by_name[one.name].slice] = one.canonical_neutral
        self.causes = np.zeros(problem.size, dtype=bool)
        for own in self.own.values():
            self.causes[own] = True
        at_bound = (q <= problem.low + _AT_BOUND) | (q >= problem.high - _AT_BOUND)
        #: Coefficients that the data may move.
        self.live = self.causes | ~at_bound
        norm = np.linalg.norm(slopes, axis=0)
        self.scale = np.where(norm > 0, norm, 1.0)
        slopes = slopes / self.scale
        self.gram = slopes.T @ slopes + np.diag(tight / self.scale**2 + _HOLD)
        self.slopes, self.residual = slopes, residual
        #: By how much each coefficient is off the value at which its cause is absent.
        self.value = (q - problem.coefficients(absent)) * self.scale

    def foreseen(self, names):
        """
        Return what the data say of causes, one at a time: their coefficients and the solution.

        Parameters
        ----------
        names : sequence of str
            Causes of which one is true.

        Returns
        -------
        list of tuple
            Coefficients that are live, the normal equations, and the solution (size,).
        """
        inside = [name for name in names if name in self.model.added]
        # the data, with the causes of the group that are in the model taken out
        taken = np.concatenate([np.empty(0, dtype=int), *(self.own[n] for n in inside)])
        wanted = self.slopes.T @ (self.residual + self.slopes[:, taken] @ self.value[taken])
        absent = self.causes.copy()
        for name in self.own.keys() & self.model.added.keys():
            absent[self.own[name]] = False
        found = []
        for name in names:
            live = self.live & ~absent
            live[taken] = False
            live[self.own[name]] = True
            rows = np.flatnonzero(live)
            normal = self.gram[np.ix_(rows, rows)]
            solution = np.zeros(self.problem.size)
            solution[rows] = cho_solve(cho_factor(normal), wanted[rows])
            found.append((rows, normal, solution))
        return found

    def columns(self, exposure):
        """Return the whitened derivatives of an exposure, in the same units: (rows, size)."""
        chain = _set_up(self.chains[exposure.dataset], exposure)
        observations = _hypothetical(self.model, exposure)
        own = {leaf.name for leaf in leaves(chain)}
        ties = {
            name: tie
            for name, tie in self.ties.items()
            if {name.split(".")[0], tie.source.split(".")[0]} <= own
        }
        problem = GapProblem([chain], [observations], ties=ties, laws=self.laws)
        channel = problem.channels[0]
        slopes = problem.jacobian(problem.start, whitened=False).T.reshape(-1, *channel.shape)
        white = _whitened(slopes, self.model.problem.channels[exposure.dataset], exposure, channel)
        out = np.zeros((white[0].size, self.problem.size))
        for name, where in problem.slices.items():
            # a parameter that the set-up alone has is none of those fitted
            if name in self.problem.slices:
                rows = white[where].reshape(where.stop - where.start, -1)
                out[:, self.problem.slices[name]] = rows.T
        return out / self.scale

    def open_directions(self):
        """Return what the data determine, as few rows, and the directions that they leave open."""
        if not self.problem.size:
            return (np.empty((0, 0)),) * 4
        singular, right, scale = self.model.problem.decomposed(self.model.fit.coefficients)
        is_open = singular < OPEN * singular[0]
        return singular[:, None] * right, right[~is_open].T, right[is_open].T, scale

    def fixes(self, directions, columns):
        """
        Return what new rows say of the open directions.

        That is the parameters of the one seen best, at how many standard deviations a
        change of it shows, and how many directions show at all.
        """
        rows, known, unknown, scale = directions
        names = self.model.problem.slices
        order = np.concatenate(
            [np.arange(self.problem.size)[self.problem.slices[n]] for n in names]
        )
        table = np.concatenate([rows, columns[:, order] * self.scale[order] / scale])
        basis = orthonormal(table @ known)
        left = table @ unknown
        # twice is enough to be orthogonal to rounding
        left -= basis @ (basis.T @ left)
        left -= basis @ (basis.T @ left)
        _, singular, right = np.linalg.svd(left, full_matrices=False)
        steps = np.abs(unknown @ right.T) / scale[:, None]
        sigmas = _WANTED * singular / steps.max(axis=0)
        best = int(ranked(sigmas)[0])
        step = steps[:, best]
        main = [i for i in ranked(step)[:3] if step[i] > 0.3 * step.max()]
        found = [self.model.problem.names[i] for i in main]
        return found, float(sigmas[best]), int(np.sum(sigmas > LEAST_GAIN))


def odds(hypotheses, gram):
    """
    Return the expected logarithms of Bayes factors, and what tells two causes apart.

    Parameters
    ----------
    hypotheses : list of tuple
        As `Forecast.foreseen` gives them.
    gram : `~numpy.ndarray`
        Products of the new derivatives.

    Returns
    -------
    factors : `~numpy.ndarray`
        Of the truth (first axis) against another cause (second axis).
    sigmas : `~numpy.ndarray`
        By how many standard deviations the other one fails.
    """
    n = len(hypotheses)
    chi2, freedom = np.zeros((n, n)), np.zeros(n)
    for j, (rows, normal, mine) in enumerate(hypotheses):
        inner = gram[np.ix_(rows, rows)]
        both = cho_factor(normal + inner)
        for i, (_, _, theirs) in enumerate(hypotheses):
            change = gram @ (theirs - mine)
            seen = change[rows] @ cho_solve(both, change[rows])
            chi2[i, j] = max(float((theirs - mine) @ change - seen), 0.0)
        grown = _log_det(both) - _log_det(cho_factor(normal))
        freedom[j] = grown - np.trace(cho_solve(both, inner))
    return (chi2 + freedom[None] - freedom[:, None]) / 2, np.sqrt(chi2)


def _log_det(factor):
    return 2 * np.sum(np.log(np.diag(factor[0])))


def expected(weights, factors):
    """
    Return the probability that the true one of several causes is expected to have.

    Parameters
    ----------
    weights : `~numpy.ndarray`
        Probabilities now, which sum to one.
    factors : `~numpy.ndarray`
        As `odds` gives them.

    Returns
    -------
    float
    """
    against = np.exp(np.clip(-factors, -700, 50)) @ weights
    return float(np.sum(weights**2 / against))


# ---- exposures ---------------------------------------------------------------------------------


def _set_up(chain, exposure):
    """Return copies of the optics of a chain as the exposure needs them."""
    train = Train(leaf.copy() for leaf in leaves(chain) if leaf.name not in exposure.without)
    if exposure.polarizer_turned:
        polarizer = Roles(train).polarizer
        if polarizer is None:
            raise GapError("no polarizer to turn in the chain of this dataset")
        theta, angle = polarizer.theta, exposure.polarizer_turned
        theta.bounds = tuple(None if b is None else b + angle for b in theta.bounds)
        theta.value = theta.value + angle
    return train


def _hypothetical(base, exposure):
    """Return noiseless observations of an exposure, as bright as its dataset."""
    i, problem = exposure.dataset, base.problem
    chain = _set_up(base.trains[i], exposure)
    chain = [leaf for leaf in chain if leaf.stage not in COORDINATES or leaf.stage == MODULATOR]
    sweep = problem.datasets[i].forward(problem.vector(base.fit.coefficients))
    usual = np.median(np.sum(sweep.fluxes, axis=0), axis=1)
    measured = np.exp(_middle(problem.channels[i], problem.channels[i].observed[1]))
    # of a wavelength without a datum nothing is asked: any flux will do
    measured = np.where(np.isfinite(measured), measured, usual)
    frames = QTable({name: angles * u.deg for name, angles in exposure.angles.items()})
    if "derotator" not in frames.colnames:
        # tables have it, also those of instruments without one
        frames["derotator"] = np.zeros(len(frames)) * u.deg
    if exposure.states:
        frames[MODULATOR] = (exposure.modulator == STATES[1]).astype(float)
    return simulate(
        join(chain),
        problem.wavelength * u.um,
        frames,
        flux=exposure.lamp * measured / usual,
        noise=False,
        name=f"next {base.observations[i].name}",
    )


def _middle(channel, values):
    """Return the median of values (..., W, F) over the frames, NaN at a wavelength without data."""
    found, some = np.full(values.shape[:-1], np.nan), channel.valid.any(axis=1)
    known = np.where(channel.valid, values, np.nan)
    found[..., some] = np.nanmedian(known[..., some, :], axis=-1)
    return found


def _whitened(array, old, exposure, new):
    """
    Divide by the noise of a dataset, and take out what its lamp may do.

    That is the brightness at each wavelength, a drift common to them, and flicker.
    """
    sigma = _middle(old, old.sigma)[..., None]
    weight = np.where(np.isfinite(sigma), np.sqrt(exposure.lamp) / sigma, 0.0)
    out = array * weight
    sums = out[..., 1, :, :] - out[..., 1, :, :].mean(axis=-1, keepdims=True)
    norm = np.sqrt(np.sum(weight[1] ** 2))
    direction = weight[1] / (norm if norm > 0 else 1.0)
    common = np.sum(sums * direction, axis=-2)
    kept = common / np.sqrt(1 + (old.lamp.flicker * norm) ** 2)
    drift = orthonormal(np.vander(2 * new.sequence - 1, old.lamp.degree + 1))
    kept = kept - (kept @ drift) @ drift.T
    out[..., 1, :, :] = sums + direction * (kept - common)[..., None, :]
    return out
