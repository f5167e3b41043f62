# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an optic does, read from its Mueller matrix.

Diattenuation, polarizance and depolarization come straight from the
elements; retardance needs the polar decomposition of Lu & Chipman (1996,
J. Opt. Soc. Am. A 13, 1106, doi:10.1364/JOSAA.13.001106).
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.mueller.elements import _mueller_array

__all__ = [
    "LuChipman",
    "depolarization_index",
    "diattenuation",
    "diattenuation_vector",
    "lu_chipman",
    "polarizance",
    "polarizance_vector",
    "retardance_vector",
]

# closer to one than this, a diattenuation is that of a polarizer
_POLARIZER = 1e-13
# excess over one that rounding or measurement may give a diattenuation
_EXCESS = 1e-9
# singular values below this fraction of one count as zero
_SINGULAR = 1e-12


def _transmitting(matrix):
    """Return Mueller matrices that transmit unpolarized light, or raise."""
    matrix = _mueller_array(matrix)
    mean = matrix[..., 0, 0]
    if not (mean > 0).all():
        raise ParameterError(
            f"matrix[0, 0] = {mean[~(mean > 0)].ravel()[0]} must be positive: "
            "it is the transmission of unpolarized light"
        )
    return matrix


def diattenuation_vector(matrix):
    """
    Return the diattenuation vector, the first row without its first element.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        Horizontal, diagonal and circular diattenuation, shape (..., 3).

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or the transmission of
        unpolarized light is not positive.

    Notes
    -----
    Lu & Chipman 1996, doi:10.1364/JOSAA.13.001106.

    Examples
    --------
    >>> from astropolcal.mueller import diattenuation_vector, diattenuator
    >>> diattenuation_vector(diattenuator(-0.2)).tolist()
    [-0.2, 0.0, 0.0]
    """
    matrix = _transmitting(matrix)
    return matrix[..., 0, 1:] / matrix[..., 0, :1]


def polarizance_vector(matrix):
    """
    Return the polarizance vector, the first column without its first element.

    It is the polarization that unpolarized light leaves with.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        q, u and v given to unpolarized light, shape (..., 3).

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or the transmission of
        unpolarized light is not positive.

    Notes
    -----
    Lu & Chipman 1996, doi:10.1364/JOSAA.13.001106.

    Examples
    --------
    >>> from astropolcal.mueller import diattenuator, polarizance_vector
    >>> polarizance_vector(diattenuator(-0.2)).tolist()
    [-0.2, 0.0, 0.0]
    """
    matrix = _transmitting(matrix)
    return matrix[..., 1:, 0] / matrix[..., :1, 0]


def diattenuation(matrix):
    """
    Return the diattenuation, the length of the diattenuation vector.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        Contrast of the transmission over all input states, 0 to 1 for
        physical matrices.

    Raises
    ------
    ParameterError
        As `diattenuation_vector`.

    Examples
    --------
    >>> from astropolcal.mueller import diattenuation, diattenuator
    >>> float(diattenuation(diattenuator(-0.2)))
    0.2
    """
    return np.linalg.norm(diattenuation_vector(matrix), axis=-1)


def polarizance(matrix):
    """
    Return the polarizance, the length of the polarizance vector.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        Degree of polarization that unpolarized light leaves with.

    Raises
    ------
    ParameterError
        As `polarizance_vector`.

    Examples
    --------
    >>> from astropolcal.mueller import diattenuator, polarizance
    >>> float(polarizance(diattenuator(-0.2)))
    0.2
    """
    return np.linalg.norm(polarizance_vector(matrix), axis=-1)


def depolarization_index(matrix):
    r"""
    Return the depolarization index: one without depolarization, zero with all.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        :math:`\sqrt{(\sum_{ij} m_{ij}^2 - m_{00}^2) / (3 m_{00}^2)}`.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or the transmission of
        unpolarized light is not positive.

    Notes
    -----
    Gil & Bernabeu 1985, Opt. Acta 32, 259, doi:10.1080/713821732.

    Examples
    --------
    >>> from astropolcal.mueller import depolarization_index, depolarizer
    >>> float(depolarization_index(depolarizer(0.9)).round(12))
    0.9
    """
    matrix = _transmitting(matrix)
    relative = matrix / matrix[..., :1, :1]
    relative[..., 0, 0] = 0.0
    return np.sqrt(np.sum(relative**2, axis=(-2, -1)) / 3)


@dataclass(frozen=True, eq=False)
class LuChipman:
    """
    A Mueller matrix as diattenuator, retarder and depolarizer, in this order.

    Made by `lu_chipman`; every array may carry leading axes.

    Parameters
    ----------
    depolarizer : `~numpy.ndarray`
        Depolarizer with the polarizance that depolarization brings.
    retarder : `~numpy.ndarray`
        Pure elliptical retarder.
    diattenuator : `~numpy.ndarray`
        Pure diattenuator, which carries the mean transmission.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.mueller import diattenuator, lu_chipman
    >>> parts = lu_chipman(diattenuator(0.3))
    >>> bool(np.allclose(parts.matrix, diattenuator(0.3)))
    True
    """

    depolarizer: np.ndarray
    retarder: np.ndarray
    diattenuator: np.ndarray

    @property
    def matrix(self):
        """The product of the three, the matrix that was decomposed."""
        return self.depolarizer @ self.retarder @ self.diattenuator

    @property
    def diattenuation_vector(self):
        """Horizontal, diagonal and circular diattenuation, shape (..., 3)."""
        return diattenuation_vector(self.diattenuator)

    @property
    def polarizance_vector(self):
        """Polarization that unpolarized light leaves with, shape (..., 3)."""
        return polarizance_vector(self.matrix)

    @property
    def retardance_vector(self):
        """Horizontal, diagonal and circular retardance, Quantity in radian."""
        return _rotation_vector(self.retarder[..., 1:, 1:]) * u.rad

    @property
    def retardance(self):
        """Total retardance, Quantity in radian from 0 to pi."""
        return np.linalg.norm(self.retardance_vector, axis=-1)

    @property
    def depolarization_power(self):
        """One minus the mean of the three depolarization factors."""
        return 1 - np.abs(np.trace(self.depolarizer, axis1=-2, axis2=-1) - 1) / 3

    @property
    def depolarization_index(self):
        """Depolarization index of the whole matrix."""
        return depolarization_index(self.matrix)


def _rotation_vector(block):
    """Return the retardance vectors of rotation blocks of shape (..., 3, 3)."""
    # a retarder of vector d is the rotation exp(-[d]x), hence the sign
    # slow to import, and only this function needs it
    from scipy.spatial.transform import Rotation

    flat = -Rotation.from_matrix(block.reshape(-1, 3, 3)).as_rotvec()
    # at half a wave both signs are the same retarder: take the first
    # component that is not zero as positive
    half_wave = np.pi - np.linalg.norm(flat, axis=-1) < _SINGULAR
    leading = np.argmax(np.abs(flat) > 1e-9, axis=-1)[..., None]
    negative = np.take_along_axis(flat, leading, axis=-1)[..., 0] < 0
    flat = np.where((half_wave & negative)[..., None], -flat, flat)
    # adding zero turns -0 into 0
    return flat.reshape(block.shape[:-1]) + 0.0


def _unit(vector, fallback):
    """Return unit vectors, and the fallback for vectors of no length."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.where(length > 0, vector / np.where(length > 0, length, 1.0), fallback)


def _smallest_rotation(start, end):
    """Return the rotations of smallest angle that take unit start to end."""
    cosine = np.sum(start * end, axis=-1)[..., None, None]
    # two reflections make the rotation; opposite vectors leave the plane open
    least = np.eye(3)[np.argmin(np.abs(start), axis=-1)]
    aside = _unit(np.cross(start, least), least)
    bisector = np.where(cosine[..., 0] > -1 + _SINGULAR, start + end, aside)
    bisector = _unit(bisector, aside)
    halfway = 2 * bisector[..., :, None] * bisector[..., None, :] - np.eye(3)
    along = 2 * start[..., :, None] * start[..., None, :] - np.eye(3)
    return halfway @ along


def _polar_factors(block):
    """Return the symmetric and the rotation factor of blocks (..., 3, 3)."""
    left, singular, right = np.linalg.svd(block)
    floor = _SINGULAR * np.maximum(singular[..., :1], _SINGULAR)
    hand = np.sign(np.linalg.det(left @ right))[..., None]
    # a negative determinant belongs to the depolarizer; a singular block has
    # none, and there the sign of its empty direction makes the rotation proper
    regular = singular[..., 2:] > floor
    flip = np.where(regular | (np.arange(3) == 2), hand, 1.0)
    retarder = (left * flip[..., None, :]) @ right
    strength = np.where(regular, hand, 1.0) * singular
    depolarizer = (left * strength[..., None, :]) @ np.swapaxes(left, -1, -2)
    # one direction left, or none: the smallest retardance that fits
    lone = (singular[..., 1:2] <= floor)[..., None]
    empty = (singular[..., :1] <= _SINGULAR)[..., None]
    smallest = _smallest_rotation(right[..., 0, :], left[..., :, 0])
    return depolarizer, np.where(empty, np.eye(3), np.where(lone, smallest, retarder))


def _embed(block, column=0.0, row=0.0):
    """Return matrices (..., 4, 4) of unit transmission around a 3 by 3 block."""
    matrix = np.zeros((*block.shape[:-2], 4, 4))
    matrix[..., 0, 0] = 1.0
    matrix[..., 1:, 1:] = block
    matrix[..., 1:, 0] = column
    matrix[..., 0, 1:] = row
    return matrix


def _without_diattenuator(block, column, axis, strength):
    """
    Return the block and the column of M times the inverse of its diattenuator.

    Written for the two states that the diattenuator passes best and worst, so
    that nothing cancels however close to a polarizer it is.
    """
    image = np.squeeze(block @ axis[..., None], axis=-1)
    best = (column + image) / (1 + strength)
    worst = (column - image) / (1 - strength)
    across = block - image[..., :, None] * axis[..., None, :]
    across = across / np.sqrt((1 - strength) * (1 + strength))[..., None]
    return across + (best - worst)[..., :, None] * axis[..., None, :] / 2, (best + worst) / 2


def lu_chipman(matrix):
    """
    Decompose Mueller matrices as depolarizer, retarder and diattenuator.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    LuChipman
        The three factors, ``matrix = depolarizer @ retarder @ diattenuator``,
        and the vectors drawn from them.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite, the transmission of
        unpolarized light is not positive, or a diattenuation exceeds one (see
        `nearest_physical <astropolcal.mueller.nearest_physical>`).

    Notes
    -----
    Lu & Chipman 1996, doi:10.1364/JOSAA.13.001106. Singular matrices have
    many decompositions. A polarizer (diattenuation within 1e-13 of one) is
    given the retarder of smallest retardance that takes its input axis to its
    output axis, and a depolarizer alike in all directions. A matrix that
    leaves one state of polarization is given the smallest retardance too, one
    that leaves none is given no retarder. A negative determinant is given to
    the depolarizer.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.mueller import diattenuator_retarder, lu_chipman
    >>> parts = lu_chipman(diattenuator_retarder(0.1, 60 * u.deg))
    >>> parts.diattenuation_vector.round(12).tolist()
    [0.1, 0.0, 0.0]
    >>> parts.retardance_vector.to_value(u.deg).round(9).tolist()
    [60.0, 0.0, 0.0]
    """
    matrix = _transmitting(matrix)
    mean = matrix[..., :1, :1]
    row, column = matrix[..., 0, 1:] / mean[..., 0], matrix[..., 1:, 0] / mean[..., 0]
    strength = np.linalg.norm(row, axis=-1, keepdims=True)
    if (strength > 1 + _EXCESS).any():
        raise ParameterError(
            f"diattenuation = {strength.max()} must be at most 1; "
            "nearest_physical gives the matrix that it may stand for"
        )
    axis = _unit(row, np.array([1.0, 0.0, 0.0]))
    pure = strength >= 1 - _POLARIZER
    block, extra = _without_diattenuator(
        matrix[..., 1:, 1:] / mean, column, axis, np.where(pure, 0.0, strength)
    )
    depolarizer, retarder = _polar_factors(block)
    polarizer = pure[..., None]
    kept = np.linalg.norm(column, axis=-1)[..., None, None] * np.eye(3)
    depolarizer = np.where(polarizer, kept, depolarizer)
    turn = _smallest_rotation(axis, _unit(column, axis))
    retarder = np.where(polarizer, turn, retarder)
    strength = np.where(pure, 1.0, strength)
    across = np.sqrt((1 - strength) * (1 + strength))[..., None]
    along = (1 - across) * axis[..., :, None] * axis[..., None, :]
    row = strength * axis
    return LuChipman(
        depolarizer=_embed(depolarizer, np.where(pure, 0.0, extra)),
        retarder=_embed(retarder),
        diattenuator=mean * _embed(across * np.eye(3) + along, row, row),
    )


def retardance_vector(matrix):
    """
    Return the retardance vector of the retarder within Mueller matrices.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~astropy.units.Quantity`
        Horizontal, diagonal and circular retardance in radian, shape
        (..., 3): what `~astropolcal.mueller.elliptical_retarder` takes. Its
        length is at most pi; at pi, where both signs are the same retarder,
        the first component that is not zero is positive.

    Raises
    ------
    ParameterError
        As `lu_chipman`.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.mueller import elliptical_retarder, retardance_vector
    >>> retarder = elliptical_retarder(30 * u.deg, -20 * u.deg, 10 * u.deg)
    >>> retardance_vector(retarder).to(u.deg).round(9)
    <Quantity [ 30., -20.,  10.] deg>
    """
    return lu_chipman(matrix).retardance_vector
