# Licensed under a 3-clause BSD style license - see LICENSE
"""Derivatives of data and priors in units of the noise, decomposed once for all who ask."""

from functools import cached_property
from typing import NamedTuple

import numpy as np

# singular values below this share of the largest count as zero
_RANK_TOLERANCE = 1e-9
# and so do those below this: a rounding error, as the error would be 1e12 degrees
_NOTHING = 1e-12
# a parameter that moves by less than this share along an open direction stands still
STILL = 1e-5


class Directions(NamedTuple):
    """Singular values, right singular vectors as rows, and the rank."""

    singular: np.ndarray
    right: np.ndarray
    rank: int

    @property
    def null(self):
        """Rows along which nothing changes."""
        return self.right[self.rank :]

    @property
    def determined(self):
        """Whether each column stands still along all open directions."""
        return (np.abs(self.null) < STILL).all(axis=0)

    @property
    def half(self):
        """Determined rows, each as long as its standard error for unit noise."""
        # covariance = V S^-2 V^T = half^T half
        return self.right[: self.rank] / self.singular[: self.rank, None]


def decompose(rows):
    """
    Decompose rows of derivatives, shape (n_rows, n_columns).

    All right vectors are there even if there are fewer rows than columns.
    """
    n_rows, n_columns = rows.shape
    # null directions need all right vectors; with more rows than columns they are there anyway
    _, singular, right = np.linalg.svd(rows, full_matrices=n_rows < n_columns)
    singular = np.pad(singular, (0, n_columns - singular.size))
    # without data the largest singular value is zero too: nothing is determined then
    threshold = max(_RANK_TOLERANCE * singular.max(initial=0.0), _NOTHING)
    return Directions(singular, right, int(np.sum(singular > threshold)))


class Whitened:
    """
    The problem around a solution, linear, with steps of a degree, micrometre or percent.

    Parameters
    ----------
    data : `~numpy.ndarray`
        Derivative of the data times their weights, shape (n_free, n_data).
    scale : `~numpy.ndarray`
        Step of each parameter, shape (n_free,).
    priors : `~numpy.ndarray`, optional
        Derivative of the priors' residuals times their weight, shape (n_free, n_priors).
    held : `~numpy.ndarray`, optional
        True for parameters that count as known.
    """

    def __init__(self, data, scale, priors=None, held=None):
        self.rows, self.scale = (data * scale[:, None]).T, scale
        self.held = np.zeros(scale.size, dtype=bool) if held is None else held
        self.live = np.flatnonzero(~self.held)
        self.prior_rows = np.zeros((0, scale.size))
        if priors is not None:
            self.prior_rows = (priors * scale[:, None]).T

    @cached_property
    def _square(self):
        """The triangular factor: as good as all rows, and much shorter."""
        rows = self.rows
        return np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows

    @cached_property
    def data(self):
        """What the data alone determine."""
        return decompose(self._square)

    @cached_property
    def together(self):
        """What data and priors determine."""
        if not len(self.prior_rows):
            return self.data
        return decompose(np.concatenate([self._square, self.prior_rows]))

    @cached_property
    def errors(self):
        """What data and priors determine of the parameters that are not held; ``live`` columns."""
        if not self.held.any():
            return self.together
        return decompose(np.concatenate([self._square, self.prior_rows])[:, self.live])

    @cached_property
    def leverage(self):
        """Derivative of each fitted to its observed datum, shape (n_data,)."""
        # diagonal of the hat matrix J (J^T J + P)^-1 J^T
        return np.sum((self.rows[:, self.live] @ self.errors.half.T) ** 2, axis=1)

    @cached_property
    def n_taken(self):
        """Degrees of freedom that the parameters take from the data, the sum of the leverages."""
        if not len(self.prior_rows):
            # trace of a projection
            return float(self.errors.rank)
        return float(np.sum((self._square[:, self.live] @ self.errors.half.T) ** 2))

    def factor(self):
        """Return `errors.half` over all columns, zero for what is held, in steps."""
        return self._spread(self.errors.half)

    def null(self):
        """Return the open directions over all columns, zero for what is held, in steps."""
        return self._spread(self.errors.null)

    def _spread(self, rows):
        out = np.zeros((len(rows), self.scale.size))
        out[:, self.live] = rows
        return out

    def covariance(self):
        """
        Return the covariance for unit noise, canonical, shape (n_free, n_free).

        NaN in the rows and columns of what is held or not determined.
        """
        out = np.full((self.scale.size, self.scale.size), np.nan)
        # a pseudo-inverse would give a small number for what is open; it gets none
        known = self.errors.determined
        columns = self.live[known]
        half = self.errors.half[:, known] * self.scale[columns]
        out[np.ix_(columns, columns)] = half.T @ half
        return out
