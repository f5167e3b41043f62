# Licensed under a 3-clause BSD style license - see LICENSE
"""
What is fitted: the two beams, or single or double differences and sums.

All are linear in the fluxes of the beams, so a solution for channels is one for beams.
"""

import numpy as np

from astropolcal.exceptions import ObservationError, ParameterError

__all__ = ["CHANNELS", "Channels"]

#: What a solution may be made of.
CHANNELS = ("intensity", "single", "double")


class Channels:
    """
    Linear combinations of the fluxes of both beams in all frames.

    Parameters
    ----------
    observable : {"intensity", "single", "double"}
        The fluxes; difference and sum of each frame; half the difference of differences and
        half the sum of sums of each pair.
    n_frames : int
        Number of frames.
    pairs : array_like of int, optional
        Frames of each pair, shape (n_pairs, 2), for double differences.

    Raises
    ------
    ParameterError
        If the observable is unknown.
    ObservationError
        If double differences lack pairs, or a pair names a frame that is not there.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.correction.channels import Channels
    >>> flux = np.array([[6.0, 5.0], [4.0, 5.0]])
    >>> Channels("double", 2, pairs=[(0, 1)]).combine(flux).tolist()
    [[1.0], [10.0]]
    """

    def __init__(self, observable, n_frames, pairs=None):
        if observable not in CHANNELS:
            raise ParameterError(f"observable = {observable!r}; allowed are {', '.join(CHANNELS)}")
        self.observable, self.n_frames = observable, n_frames
        self.pairs = None
        if observable == "double":
            self.pairs = _checked(pairs, n_frames)

    @property
    def units(self):
        """Frames of which each pair of channels is made, a list of tuples."""
        if self.pairs is None:
            return [(frame,) for frame in range(self.n_frames)]
        return [tuple(pair) for pair in self.pairs.tolist()]

    def combine(self, fluxes):
        """Return channels of fluxes of shape (2, n_frames, ...): shape (2, n_units, ...)."""
        if self.observable == "intensity":
            return fluxes
        both = np.stack([fluxes[0] - fluxes[1], fluxes[0] + fluxes[1]])
        if self.pairs is None:
            return both
        plus, minus = both[:, self.pairs[:, 0]], both[:, self.pairs[:, 1]]
        # (X+ - X-) / 2 and (I+ + I-) / 2, the half differences and sums of the paper
        return np.stack([plus[0] - minus[0], plus[1] + minus[1]]) / 2

    def of_unit(self, beams):
        """Return the two channels of one unit from the beams of its frames, [(right, left)...]."""
        fluxes = np.stack([np.stack(beam) for beam in zip(*beams, strict=True)])
        if self.observable == "intensity":
            return fluxes[:, 0]
        both = fluxes[0] - fluxes[1], fluxes[0] + fluxes[1]
        if self.pairs is None:
            return np.stack([both[0][0], both[1][0]])
        return np.stack([both[0][0] - both[0][1], both[1][0] + both[1][1]]) / 2

    def variance_of_unit(self, beams):
        """Return the variances of the two channels of one unit from those of the beams."""
        fluxes = np.stack([np.stack(beam) for beam in zip(*beams, strict=True)])
        if self.observable == "intensity":
            return fluxes[:, 0]
        # var(r - l) = var(r + l) = var(r) + var(l); halving the pair divides it by four
        total = fluxes.sum(axis=(0, 1)) / (1 if self.pairs is None else 4)
        return np.stack([total, total])

    def variances(self, variances):
        """Return variances of channels, without their correlations; shapes as in `combine`."""
        if self.observable == "intensity":
            return variances
        total = variances.sum(axis=0)
        if self.pairs is not None:
            total = (total[self.pairs[:, 0]] + total[self.pairs[:, 1]]) / 4
        return np.stack([total, total])

    def to_beams(self, gain):
        """
        Return what multiplies the beams from what multiplies the channels.

        Parameters
        ----------
        gain : `~numpy.ndarray`
            Shape (..., 2, n_units).

        Returns
        -------
        `~numpy.ndarray`
            Shape (..., 2, n_frames).
        """
        if self.observable == "intensity":
            return gain
        difference, total = gain[..., 0, :], gain[..., 1, :]
        if self.pairs is not None:
            shape = (*difference.shape[:-1], self.n_frames)
            spread = np.zeros((2, *shape))
            for side, sign in ((0, 1.0), (1, -1.0)):
                # a frame may belong to several pairs
                np.add.at(spread[0], (..., self.pairs[:, side]), sign * difference / 2)
                np.add.at(spread[1], (..., self.pairs[:, side]), total / 2)
            difference, total = spread
        # of right - left and right + left: both gains act on each beam, the first with its sign
        return np.stack([total + difference, total - difference], axis=-2)


def _checked(pairs, n_frames):
    pairs = np.asarray([] if pairs is None else pairs, dtype=int).reshape(-1, 2)
    if not len(pairs):
        raise ObservationError("double differences need pairs of frames, and there is none")
    if pairs.min() < 0 or pairs.max() >= n_frames:
        raise ObservationError(
            f"pairs name frames {pairs.min()} to {pairs.max()}; there are 0 to {n_frames - 1}"
        )
    return pairs
