# Licensed under a 3-clause BSD style license - see LICENSE
"""
How far the gap shrinks on frames that the fit has not seen.

Frames are left out in groups (a derotator angle at a time, in all datasets),
the model is fitted to the others, and predicts what was left out. The gap is
the root mean square of the normalized single differences, in percent of
polarization. Its errors come from a bootstrap over the groups.
"""

from dataclasses import dataclass

import numpy as np

from astropolcal.exceptions import GapError
from astropolcal.gap.model import Linear

__all__ = ["HeldOut", "foreseen", "frame_groups", "held_out", "left_out_fits", "stability"]

# degree; angles that differ by less are one group
_SAME_ANGLE = 0.5
# next to the solution of all frames the fit to most of them takes few steps
_STEPS, _SHARE = 8, 1e-5
# singular values below this share of the largest belong to directions that are open
_OPEN = 1e-12
# so many parts of the data are left out in turn
_MOST_PARTS = 16
# a direction that a group determines by more than this share is its own
_MOST_LEVER = 0.99


@dataclass
class HeldOut:
    """
    Squares of prediction errors, by group.

    Parameters
    ----------
    labels : list of str
        What was left out.
    squares : `~numpy.ndarray`
        Sum of squared prediction errors of the normalized single difference,
        one a group.
    whitened : `~numpy.ndarray`
        Half the sum of squares of the whitened prediction errors of both channels.
    counts : `~numpy.ndarray`
        Number of data of each group.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.shrinkage import HeldOut
    >>> one = HeldOut(["a", "b"], np.array([0.02, 0.02]), np.ones(2), np.array([200, 200]))
    >>> round(one.percent, 6)
    1.0
    """

    labels: list
    squares: np.ndarray
    whitened: np.ndarray
    counts: np.ndarray

    @property
    def percent(self):
        """Root mean square prediction error, in percent of polarization."""
        return 100 * float(np.sqrt(self.squares.sum() / self.counts.sum()))

    @property
    def chi2(self):
        """Mean square over the variances."""
        return float(self.whitened.sum() / self.counts.sum())

    def shrinkage(self, other):
        """
        Return by how much the mean square is lower in another model, in percent.

        Parameters
        ----------
        other : HeldOut
            Of the same groups.

        Returns
        -------
        value, low, high : float
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
        """
        Return by how many standard errors the whitened squares are below those of another.

        Parameters
        ----------
        other : HeldOut
            Of the same groups.

        Returns
        -------
        float
            Mean difference over the groups by its standard error; at least two
            groups.
        """
        difference = (other.whitened - self.whitened) / self.counts
        error = difference.std(ddof=1) / np.sqrt(len(difference))
        if error > 0:
            return float(difference.mean() / error)
        # all groups differ by exactly the same
        return float(np.inf * difference.mean()) if difference.mean() else 0.0


def frame_groups(observations):
    """
    Return the group of every frame of every dataset.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets.

    Returns
    -------
    labels : list of str
        Names of the groups.
    numbers : list of `~numpy.ndarray`
        Group of each frame, one array a dataset.

    Raises
    ------
    GapError
        If there are fewer than three groups to leave out.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.shrinkage import frame_groups
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> frame_groups([simulate(charis.chain(), charis.wavelength, frames, seed=1)])[0]
    ['derotator at 45 deg', 'derotator at 60 deg', 'derotator at 90 deg']
    """
    if all("derotator" in o.frames.colnames for o in observations):
        angles = [np.rad2deg(o.position("derotator")) for o in observations]
        rounded = [np.round(a / _SAME_ANGLE) for a in angles]
        kinds = np.unique(np.concatenate(rounded))
        # an angle that moves from frame to frame would make every frame a group
        several = len(kinds) < sum(map(len, rounded)) / 2
        if several and len(kinds) >= 3:
            every = np.concatenate(rounded)
            middle = [np.concatenate(angles)[every == k].mean() for k in kinds]
            labels = [f"derotator at {value:g} deg" for value in np.round(middle, 1)]
            return labels, [np.searchsorted(kinds, r) for r in rounded]
    return _blocks(observations)


def _blocks(observations, count=8):
    """Return blocks of frames that were taken one after the other."""
    shortest = min(o.n_frames for o in observations)
    count = min(count, shortest // 4)
    if count < 3:
        raise GapError(
            f"too few frames to leave out in groups: {shortest} in the shortest dataset; "
            "three derotator angles, or twelve frames, are the least"
        )
    labels = [f"frames {i + 1} of {count}" for i in range(count)]
    return labels, [np.arange(o.n_frames) * count // o.n_frames for o in observations]


def held_out(model, groups):
    """
    Return the prediction errors of a model on frames left out in groups.

    Parameters
    ----------
    model : Model
        The fitted model.
    groups : tuple
        As `frame_groups` gives them.

    Returns
    -------
    HeldOut

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.shrinkage import frame_groups, held_out
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 75, 90] * u.deg)
    >>> observations = simulate(chain, charis.wavelength, frames, seed=1)
    >>> model = nominal_model([chain], [observations])
    >>> bool(held_out(model, frame_groups([observations])).percent < 0.1)
    True
    """
    labels, numbers = groups
    problem = model.problem
    squares, whitened, counts = (np.zeros(len(labels)) for _ in range(3))
    for i, fit in enumerate(left_out_fits(model, labels, numbers)):
        for number, channel, gap in zip(
            numbers, problem.channels, problem.differences(fit.coefficients), strict=True
        ):
            seen = channel.valid & (number == i)
            squares[i] += np.sum(gap[0][seen] ** 2)
            # two channels a datum: half, so that noise gives 1 a datum
            whitened[i] += np.sum(channel.whiten(gap)[:, seen] ** 2) / 2
            counts[i] += seen.sum()
    keep = counts > 0
    labels = [label for label, here in zip(labels, keep, strict=True) if here]
    return HeldOut(labels, squares[keep], whitened[keep], counts[keep])


def foreseen(model, groups):
    """
    Return the prediction errors on left-out frames to first order, without a fit for each group.

    With an orthonormal basis N of the derivatives, residuals r of a group become
    :math:`(1 - N N^T)^{-1} r` where the group does not take part in the fit: exact in a linear
    model (Cook & Weisberg 1982, Residuals and Influence in Regression, Sec. 2.2).

    Parameters
    ----------
    model : Model or Linear
        The fitted model, or one from which effects were taken.
    groups : tuple
        As `frame_groups` gives them.

    Returns
    -------
    HeldOut

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.shrinkage import foreseen, frame_groups
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = instruments.get("charis").chain(derotator="linear", wavelength=[1.2, 1.6] * u.um)
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)
    >>> model = nominal_model([chain], [data])
    >>> bool(foreseen(model, frame_groups([data])).percent < 0.2)
    True
    """
    labels, numbers = groups
    linear = model if isinstance(model, Linear) else model.without(())
    problem, tangent, residual = linear.model.problem, linear.tangent, linear.residual
    sizes = [c.shape for c in problem.channels]
    squares, whitened, counts = (np.zeros(len(labels)) for _ in range(3))
    for i in range(len(labels)):
        rows, scale = [], []
        for number, channel, shape, segment in zip(
            numbers, problem.channels, sizes, problem.segments, strict=True
        ):
            seen = np.broadcast_to(channel.valid & (number == i), shape)
            here = np.arange(segment.start, segment.stop).reshape(shape)[seen]
            rows.append(here)
            # whitened differences are divided by their noise; sums have none of their own here
            size = np.zeros(shape)
            size[0] = channel.sigma[0]
            scale.append(size[seen])
            counts[i] += seen[0].sum()
        rows, scale = np.concatenate(rows), np.concatenate(scale)
        if not rows.size:
            continue
        left, share, _ = np.linalg.svd(tangent[rows], full_matrices=False)
        # what the group alone determines cannot be foreseen at all; it is not counted
        lever = np.minimum(share**2, _MOST_LEVER)
        gap = residual[rows] + left @ ((lever / (1 - lever)) * (left.T @ residual[rows]))
        squares[i] = np.sum((gap * scale) ** 2)
        whitened[i] = np.sum(gap**2) / 2
    keep = counts > 0
    labels = [label for label, here in zip(labels, keep, strict=True) if here]
    return HeldOut(labels, squares[keep], whitened[keep], counts[keep])


def stability(model, groups, temper):
    """
    Return in which share of parts of the data each effect of a model is still asked for.

    The parts are the odd and the even wavelengths, and the data without each group of frames. An
    effect is asked for where the evidence for its size by Schwarz (1978) is above that for none.

    Parameters
    ----------
    model : Model
        The fitted model.
    groups : tuple or None
        As `frame_groups` gives them; None for the halves of the wavelengths alone.
    temper : float
        Variance of the residuals, in units of the noise.

    Returns
    -------
    dict of str to float
        Share by name of the effect.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.shrinkage import stability
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = instruments.get("charis").chain(derotator="linear", wavelength=[1.2, 1.6] * u.um)
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)
    >>> model = nominal_model([chain], [data])
    >>> stability(model, None, 1.0)
    {}
    """
    problem, q = model.problem, model.fit.coefficients
    absent, jacobian = problem.coefficients(problem._absent()), model.jacobian
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
            own = [problem.slices[p.name] for p in parameters if p.name in problem.slices]
            if own:
                own = np.concatenate([np.arange(s.start, s.stop) for s in own])
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


def left_out_fits(model, labels, numbers):
    """
    Yield the fit of a model without each group of frames.

    Parameters
    ----------
    model : Model
        The fitted model.
    labels, numbers
        As `frame_groups` gives them.

    Yields
    ------
    Fit

    Examples
    --------
    >>> from astropolcal.gap.shrinkage import left_out_fits
    >>> list(left_out_fits(None, [], []))
    []
    """
    for i in range(len(labels)):
        rows = model.problem.rows([number != i for number in numbers])
        yield model.problem.fit(model.fit.coefficients, rows=rows, steps=_STEPS, share=_SHARE)
