# Licensed under a 3-clause BSD style license - see LICENSE
"""Where the walkers of a sampler start, and how they move."""

import numpy as np

from astropolcal.exceptions import FitError

# in degree, micrometre or percent: a direction counts as determined up to this error, and
# the walkers start as wide as this along one that is not
_WIDEST, _START = 5.0, 0.3
# a parameter closer to its bound than this (canonical units) sits at it
_AT_BOUND = 1e-5
_MAX_DRAWS, _MAX_HALVINGS = 50, 60
# up to so many parameters the stretch move is as good as any
_FEW = 10
# least part of a walker's place that a step around the fit draws anew
_LEAST_ANEW = 0.1
# emcee up to this version accepts snooker steps with a wrong probability (its pull request 531):
# in 91 normal parameters their standard deviation comes out as 0.82 of the true one
_BIASED_SNOOKER = (3, 1, 6)


class Laplace:
    """
    The normal distribution around a fit, with the covariance of data and priors.

    It leaves out what sits at a bound. Along directions that are not
    determined it is narrow.

    Parameters
    ----------
    log_posterior : LogPosterior
        The log-posterior, whose centre is the fit.
    """

    def __init__(self, log_posterior):
        self.log_posterior = log_posterior
        self.centre = log_posterior.centre
        scale = log_posterior.physical_scale()
        jacobian = log_posterior.whitened_jacobian() * scale[:, None]
        #: Sign in which each parameter can leave the bound that it sits at, else 0.
        self.inward = _inward(log_posterior)
        self.free = self.inward == 0
        # rows of the Jacobian are parameters: left vectors are directions among them, (n, n)
        left, singular, _ = np.linalg.svd(jacobian[self.free])
        # the standard error along each, as the Jacobian is in units of the noise
        width = 1 / np.maximum(np.pad(singular, (0, len(left) - singular.size)), 1e-99)
        #: Which principal directions are determined.
        self.determined = width < _WIDEST
        width = np.where(self.determined, width, _START)
        # columns lead from unit normal numbers to parameters, `_back` the other way
        self._out = left * width * scale[self.free][:, None]
        self._back = (left / width).T / scale[self.free]
        # what sits at a bound leaves it as far as its own slope allows
        steepness = np.linalg.norm(jacobian[~self.free], axis=1)
        self._reach = scale[~self.free] / np.maximum(steepness, 1 / _START)

    def normal(self, coords):
        """Return coordinates along the principal directions, of unit width."""
        return (coords - self.centre)[:, self.free] @ self._back.T

    def place(self, coords, normal):
        """Return places with other coordinates along the principal directions."""
        coords = coords.copy()
        coords[:, self.free] = self.centre[self.free] + normal @ self._out.T
        return coords

    def start(self, n_walkers, rng):
        """
        Return places of walkers within the bounds, where there is probability.

        What is outside of the bounds is drawn again, and mirrored if that does
        not help; what is impossible comes closer to the fit.
        """
        low, high, centre = self.log_posterior.low, self.log_posterior.high, self.centre
        coords = self._draw(n_walkers, rng)
        # a normal cut off at the bounds, by rejection; near many bounds that may take forever
        for _ in range(_MAX_DRAWS):
            wrong = ((coords < low) | (coords > high)).any(axis=1)
            coords[wrong] = self._draw(int(wrong.sum()), rng)
        offset = np.where((coords < low) | (coords > high), centre - coords, coords - centre)
        for _ in range(_MAX_HALVINGS):
            coords = np.clip(centre + offset, low, high)
            impossible = ~np.isfinite(self.log_posterior(coords))
            if not impossible.any():
                return coords
            # the fit itself is possible, so that halving the way to it ends somewhere that is
            offset[impossible] /= 2
        raise FitError("the walkers find no place to start: the fitted values have no probability")

    def _draw(self, count, rng):
        coords = np.tile(self.centre, (count, 1))
        coords = self.place(coords, rng.normal(size=(count, self.determined.size)))
        away = np.abs(rng.normal(size=(count, self._reach.size))) * self._reach
        coords[:, ~self.free] += self.inward[~self.free] * away
        return coords


def _inward(log_posterior):
    centre, low, high = log_posterior.centre, log_posterior.low, log_posterior.high
    near = _AT_BOUND * np.maximum(1.0, np.abs(centre))
    return np.where(centre - low <= near, 1.0, np.where(high - centre <= near, -1.0, 0.0))


# ---- moves -------------------------------------------------------------------------------


def default_moves(emcee, laplace):
    """
    Return what moves the walkers, with the share of each.

    For few parameters the stretch move. For more, steps around the fit, which
    in a posterior that is nearly normal are as good in a hundred parameters as
    in one; steps of what sits at a bound alone; and differential evolution,
    which needs neither a fit nor a normal posterior.
    """
    if laplace.centre.size <= _FEW:
        return [(emcee.moves.StretchMove(), 1.0)]
    moves = [(emcee.moves.DEMove(), 0.3)]
    if laplace.determined.any():
        moves.append((_crank_nicolson(emcee, laplace), 0.5))
    if not laplace.free.all():
        moves.append((_bound_move(emcee, laplace), 0.2))
    return moves


def _crank_nicolson(emcee, laplace):
    """
    Return a step that keeps the normal distribution around the fit.

    It is accepted as far as the posterior is that distribution (Cotter et al.
    2013, Statistical Science 28, 424, doi:10.1214/13-STS421).
    """
    moved = laplace.determined

    def proposal(coords, random):
        before = laplace.normal(coords)
        after = before.copy()
        anew = random.uniform(_LEAST_ANEW, 1.0, size=(len(coords), 1))
        noise = random.normal(size=(len(coords), int(moved.sum())))
        after[:, moved] = np.sqrt(1 - anew**2) * before[:, moved] + anew * noise
        # log of the ratio of proposal densities; it undoes the normal part of the posterior
        gain = 0.5 * np.sum(after[:, moved] ** 2 - before[:, moved] ** 2, axis=1)
        return laplace.place(coords, after), gain

    class CrankNicolsonMove(emcee.moves.MHMove):
        """Steps around the fit."""

    return CrankNicolsonMove(proposal)


def _bound_move(emcee, laplace):
    """Return differential evolution of what sits at a bound, the rest held."""
    held = ~laplace.free

    class BoundDEMove(emcee.moves.DEMove):
        """Differential evolution of some parameters."""

        def get_proposal(self, s, c, random):
            moved, factors = super().get_proposal(s, c, random)
            return np.where(held, moved, s), factors

    # the optimal scale for as many dimensions as move
    # (ter Braak 2006, doi:10.1007/s11222-006-8769-1)
    return BoundDEMove(gamma0=2.38 / np.sqrt(2 * int(held.sum())))


def move_names(moves):
    """Return the name of each move, and its share."""
    weighted = moves if isinstance(moves, list) else [moves]
    parts = [move if isinstance(move, tuple) else (move, 1.0) for move in weighted]
    return [[type(move).__name__, float(weight)] for move, weight in parts]


def refuse_biased(moves, version):
    """Raise FitError if emcee samples wrongly with a move."""
    numbers = tuple(int(part) for part in version.split(".")[:3] if part.isdigit())
    if "DESnookerMove" in dict(move_names(moves)) and numbers <= _BIASED_SNOOKER:
        raise FitError(
            f"moves: the DESnookerMove of emcee {version} samples too narrow a distribution; "
            "use DEMove or StretchMove"
        )
