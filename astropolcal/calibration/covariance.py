# Licensed under a 3-clause BSD style license - see LICENSE
"""Covariance of calibrated parameters, with their names and units."""

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import canonical_factor

__all__ = ["Covariance"]


class Covariance:
    """
    Covariance matrix of named parameters, in their declared units.

    Parameters
    ----------
    names : sequence of str
        Name of each row, such as ``hwp.w_sio2`` or ``derotator.horizontal[3]``.
    units : sequence of `~astropy.units.Unit` or None
        Unit of each.
    matrix : array_like
        Shape (n, n); NaN in the rows and columns of parameters that the data
        do not determine.

    Raises
    ------
    ParameterError
        If the shapes differ or the matrix is not symmetric.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration import Covariance
    >>> covariance = Covariance(["hwp.theta"], [u.deg], [[0.04]])
    >>> covariance.std("hwp.theta")
    <Quantity 0.2 deg>
    """

    def __init__(self, names, units, matrix):
        self.names = list(names)
        self.units = list(units)
        self.matrix = np.array(matrix, dtype=float)
        n = len(self.names)
        if self.matrix.shape != (n, n) or len(self.units) != n:
            raise ParameterError(
                f"covariance of {n} names and {len(self.units)} units has shape {self.matrix.shape}"
            )
        if not np.allclose(self.matrix, self.matrix.T, rtol=1e-6, atol=1e-30, equal_nan=True):
            raise ParameterError("a covariance matrix must be symmetric")

    @classmethod
    def from_canonical(cls, free, matrix):
        """
        Make it from a matrix in canonical units.

        Parameters
        ----------
        free : FreeParameters
            The free parameters that the rows belong to.
        matrix : `~numpy.ndarray`
            Shape (n_free, n_free), in radian, micrometre or 1.

        Returns
        -------
        Covariance
        """
        units = [slot.unit for slot in free.slots for _ in range(slot.size)]
        per_unit = np.array([1 / canonical_factor(unit) for unit in units])
        return cls(free.names, units, matrix * per_unit[:, None] * per_unit[None, :])

    def __len__(self):
        return len(self.names)

    def __repr__(self):
        known = int(np.isfinite(np.diag(self.matrix)).sum())
        return f"<Covariance of {len(self)} parameters, {known} of them determined>"

    def __eq__(self, other):
        if not isinstance(other, Covariance):
            return NotImplemented
        same = self.names == other.names and self.units == other.units
        return same and np.array_equal(self.matrix, other.matrix, equal_nan=True)

    __hash__ = None

    @property
    def stds(self):
        """Standard deviations in the declared units, NaN where not determined."""
        return np.sqrt(np.diag(self.matrix))

    def std(self, name):
        """
        Return the standard deviation of one parameter.

        Parameters
        ----------
        name : str
            One of ``names``.

        Returns
        -------
        `~astropy.units.Quantity` or float
            NaN where the data do not determine it.

        Raises
        ------
        ParameterError
            If there is no such parameter.

        Examples
        --------
        >>> from astropolcal.calibration import Covariance
        >>> one = Covariance(["wollaston.efficiency"], [None], [[1e-4]])
        >>> float(one.std("wollaston.efficiency"))
        0.01
        """
        if name not in self.names:
            raise ParameterError(f"no parameter {name!r} in the covariance")
        i = self.names.index(name)
        value = self.stds[i]
        return value if self.units[i] is None else value * self.units[i]

    @property
    def correlation(self):
        """Correlation matrix, shape (n, n), NaN where not determined."""
        stds = self.stds
        return self.matrix / stds[:, None] / stds[None, :]
