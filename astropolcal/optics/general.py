# Licensed under a 3-clause BSD style license - see LICENSE
"""An optic known only by its Mueller matrix."""

import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.optics._matrices import blank
from astropolcal.optics.core import Optic

__all__ = ["MuellerElement"]

# in the order in which the parameters are declared
_ELEMENTS = [(row, column) for row in range(4) for column in range(4)]


def _element(row, column):
    return Parameter(
        default=float(row == column),
        # fluxes are compared up to a factor: a transmission needs no bound
        bounds=(None, None) if (row, column) == (0, 0) else (-1, 1),
        fixed=True,
        description=f"element in row {row}, column {column}",
    )


class MuellerElement(Optic):
    """
    General element of constant Mueller matrix; the elements are parameters.

    Parameters
    ----------
    m00, m01, ..., m33 : float or array_like
        The elements, fixed by default; scalars, or one value a wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.optics import MuellerElement
    >>> element = MuellerElement.from_matrix(np.diag([1, 0.9, 0.9, 0.8]), name="window")
    >>> element.m33
    Parameter('m33', value=0.8, fixed=True, bounds=(-1, 1))
    """

    m00, m01, m02, m03 = (_element(0, j) for j in range(4))
    m10, m11, m12, m13 = (_element(1, j) for j in range(4))
    m20, m21, m22, m23 = (_element(2, j) for j in range(4))
    m30, m31, m32, m33 = (_element(3, j) for j in range(4))

    @classmethod
    def from_matrix(cls, matrix, **kwargs):
        """
        Make the element from a Mueller matrix.

        Parameters
        ----------
        matrix : array_like
            Shape (4, 4), or (n_wavelengths, 4, 4).
        **kwargs
            ``name``, ``mount``, ``theta`` as for any optic.

        Returns
        -------
        MuellerElement

        Raises
        ------
        ParameterError
            If the shape is another or an element is not finite.

        Examples
        --------
        >>> import numpy as np
        >>> from astropolcal.optics import MuellerElement
        >>> MuellerElement.from_matrix(np.eye(4)).mueller()[3, 3]
        np.float64(1.0)
        """
        matrix = np.asarray(matrix, dtype=float)
        if matrix.shape[-2:] != (4, 4) or matrix.ndim not in (2, 3):
            raise ParameterError(
                f"a Mueller matrix has shape (4, 4) or (n, 4, 4), not {matrix.shape}"
            )
        values = {f"m{i}{j}": matrix[..., i, j] for i, j in _ELEMENTS}
        return cls(**values, **kwargs)

    def _matrix(self, dispersion, *elements):
        out = blank(*elements)
        for (i, j), value in zip(_ELEMENTS, elements, strict=True):
            out[..., i, j] = value
        return out

    def _derivatives(self, dispersion, *elements):
        slopes = []
        for i, j in _ELEMENTS:
            out = blank(*elements)
            out[..., i, j] = 1.0
            slopes.append(out)
        return tuple(slopes)
