# Licensed under a 3-clause BSD style license - see LICENSE
"""
How far the gap shrinks on frames that the fit has not seen.

Frames are left out in groups (a derotator angle at a time, in all datasets), the model is fitted to
the others, and predicts what was left out. The gap is the root mean square of the normalized single
differences, in percent of polarization. Its errors come from a bootstrap over the groups.
"""

from dataclasses import dataclass

import numpy as np

from astropolcal.exceptions import GapError
from astropolcal.gap.model import Linear
from astropolcal.observations.grid import clusters, runs_of_frames

__all__ = []

# singular values below this share of the largest belong to directions that are open
_OPEN = 1e-12
# so many parts of the data are left out in turn
_MOST_PARTS = 16
# a direction that a group determines by more than this share is its own
_MOST_LEVER = 0.99


@dataclass
class HeldOut:
    """Prediction errors of each group that was left out: its label and its number of data.

    ``squares`` is the sum of squares in the normalized single difference, ``whitened`` half that
    of the whitened errors of both channels.
    """

    labels: list
    squares: np.ndarray
    whitened: np.ndarray
    counts: np.ndarray

    @classmethod
    def of_rows(cls, labels, rows):
        """Return the errors from squares, whitened squares and number of data of each group."""
        kept = [(label, row) for label, row in zip(labels, rows, strict=True) if row[2]]
        return cls([label for label, _ in kept], *np.array([row for _, row in kept]).T)

    @classmethod
    def of_predictions(cls, problem, groups, gaps):
        """Return the errors of a prediction for each group: differences of all data each."""
        labels, numbers = groups
        rows = []
        for i, gap in enumerate(gaps):
            squares = whitened = count = 0
            for number, channel, one in zip(numbers, problem.channels, gap, strict=True):
                seen = channel.valid & (number == i)
                squares += np.sum(channel.gap(one)[seen] ** 2)
                # mostly two channels a datum: half, so that noise gives 1 a datum
                whitened += np.sum(channel.whiten(one)[:, seen] ** 2) / channel.count
                count += seen.sum()
            rows.append((squares, whitened, count))
        return cls.of_rows(labels, rows)

    @property
    def percent(self):
        """Root mean square prediction error, in percent of polarization."""
        return 100 * float(np.sqrt(self.squares.sum() / self.counts.sum()))

    @property
    def typical_percent(self):
        """Mean over the groups of the root mean square error in each: no one decides alone."""
        return 100 * float(np.mean(np.sqrt(self.squares / self.counts)))

    @property
    def chi2(self):
        """Mean square over the variances."""
        return float(self.whitened.sum() / self.counts.sum())

    def shrinkage(self, other):
        """
        Return by how much the mean square is lower in another model, in percent.

        With the 16th and 84th percentile of a bootstrap over the groups.
        """
        value = 1 - other.squares.sum() / self.squares.sum()
        rng = np.random.default_rng(20261121)
        # groups and not data are drawn: frames at one angle share what the model misses
        draws = rng.integers(0, len(self.counts), (1000, len(self.counts)))
        spread = 1 - other.squares[draws].sum(axis=1) / self.squares[draws].sum(axis=1)
        low, high = np.percentile(spread, [16, 84])
        return 100 * float(value), 100 * float(low), 100 * float(high)

    def better_than(self, other):
        """Return by how many standard errors the whitened squares are below those of another."""
        difference = (other.whitened - self.whitened) / self.counts
        error = difference.std(ddof=1) / np.sqrt(len(difference))
        if error > 0:
            return float(difference.mean() / error)
        # all groups differ by exactly the same
        return float(np.inf * difference.mean()) if difference.mean() else 0.0


def frame_groups(observations):
    """
    Return the names of the groups, and the group of every frame, an array per dataset.

    Fewer than three groups are refused: a derotator angle each, or blocks in time.
    """
    if all("derotator" in o.frame_columns for o in observations):
        angle = np.concatenate([o.position("derotator") for o in observations])
        number = clusters(angle)
        count = number.max() + 1
        # an angle that moves from frame to frame would make every frame a group
        if 3 <= count < len(number) / 2:
            middle = np.rad2deg(np.bincount(number, angle) / np.bincount(number))
            labels = [f"derotator at {value:g} deg" for value in np.round(middle, 1)]
            ends = np.cumsum([o.n_frames for o in observations])[:-1]
            return labels, np.split(number, ends)
    # blocks of frames that were taken one after the other, no more than eight
    shortest = min(observations, key=lambda o: o.n_frames)
    count = min(8, shortest.n_frames // 4)
    if count < 3:
        least = f"twelve frames of {shortest.name}"
        if any("derotator" in o.frame_columns for o in observations):
            least = f"three derotator angles, or {least},"
        raise GapError(
            f"too few frames to leave out in groups: {shortest.n_frames} in the shortest dataset; "
            f"{least} are the least"
        )
    labels = [f"frames {i + 1} of {count}" for i in range(count)]
    return labels, [runs_of_frames(o.n_frames, count) for o in observations]


def foreseen(model, groups):
    """Return the prediction errors on left-out frames to first order, without a fit for each group.

    With an orthonormal basis N of the derivatives, residuals r of a group become
    :math:`(1 - N N^T)^{-1} r` where the group does not take part in the fit: exact in a linear
    model (Cook & Weisberg 1982, Residuals and Influence in Regression, Sec. 2.2).
    """
    labels, numbers = groups
    linear = model if isinstance(model, Linear) else model.linear
    problem, tangent, residual = linear.model.problem, linear.tangent, linear.residual
    found, group, scale = [], [], []
    for number, channel in zip(numbers, problem.channels, strict=True):
        group.append([np.where(channel.valid, number, -1)] * 2)
        # whitened differences are divided by their noise; sums have none of their own here
        scale.append(np.zeros(channel.shape))
        scale[-1][channel.told] = channel.noise
    group, scale = (np.concatenate([np.ravel(one) for one in each]) for each in (group, scale))
    for i in range(len(labels)):
        rows = np.flatnonzero(group == i)
        # N (1 - N^T N)^-1 N^T r is what (1 - N N^T)^-1 r has beyond r; there are fewer parameters
        # than data of a group
        here = tangent[rows]
        pull, left = here.T @ residual[rows], np.eye(here.shape[1]) - here.T @ here
        try:
            np.linalg.cholesky(left - (1 - _MOST_LEVER) * np.eye(len(left)))
            pull = np.linalg.solve(left, pull)
        except np.linalg.LinAlgError:
            # what the group alone determines cannot be foreseen at all; it is not counted
            values, along = np.linalg.eigh(left)
            pull = along @ (along.T @ pull / np.maximum(values, 1 - _MOST_LEVER))
        gap = residual[rows] + here @ pull
        whitened = np.sum(gap**2) / problem.channels[0].count
        found.append((np.sum((gap * scale[rows]) ** 2), whitened, len(rows) // 2))
    return HeldOut.of_rows(labels, found)


def stability(model, groups, temper):
    """
    Return in which share of parts of the data each effect of a model is still asked for.

    The parts are the odd and the even wavelengths, and the data without each group of frames. An
    effect is asked for where the evidence for its size by Schwarz (1978) is above that for none.
    """
    problem, q = model.problem, model.fit.coefficients
    # what is at its bound does not give way to an effect that does the same
    absent, jacobian = problem.absent, model.jacobian * ~problem.at_bound(q)
    found = {name: [] for name in model.added}
    scale = np.linalg.norm(jacobian, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    prior = np.diag((problem.tight / scale) ** 2)
    pull = (absent - q) * problem.tight**2 / scale
    whole = _normal(jacobian, model.residual, slice(None), scale)
    for inside, rows in _parts(problem, groups):
        gram, target = _normal(jacobian, model.residual, rows, scale)
        if not inside:
            gram, target = whole[0] - gram, whole[1] - target
        inverse = np.linalg.pinv(gram + prior, rcond=_OPEN, hermitian=True)
        size = (q - absent) * scale + inverse @ (target + pull)
        n = rows.sum() if inside else len(rows) - rows.sum()
        for name, parameters in model.added.items():
            own = problem.numbers(p.name for p in parameters)
            if own.size:
                covariance = temper * inverse[np.ix_(own, own)]
                strength = size[own] @ np.linalg.pinv(covariance, hermitian=True) @ size[own]
                found[name].append(strength > own.size * np.log(max(n, 2)))
    return {name: float(np.mean(asked)) for name, asked in found.items() if asked}


def _normal(jacobian, residual, rows, scale):
    """Return the normal equations of some rows, of columns over their length."""
    table = jacobian[rows] / scale
    return table.T @ table, table.T @ residual[rows]


def _parts(problem, groups):
    """Yield rows, and whether the part is these or all but these."""
    if len(problem.wavelength) > 3:
        for half in (0, 1):
            yield True, problem.rows([(d.bins % 2 == half)[:, None] for d in problem.datasets])
    labels, numbers = groups or ((), ())
    # neighbours together where there are many
    bundle = np.arange(len(labels)) * min(len(labels), _MOST_PARTS) // max(len(labels), 1)
    for k in np.unique(bundle):
        out = problem.rows([bundle[number] == k for number in numbers])
        # what is known is no part of the frames
        yield False, out & (np.arange(len(out)) < len(out) - len(problem.known))
