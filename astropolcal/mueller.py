# Licensed under a 3-clause BSD style license - see LICENSE
"""
Mueller algebra: pure functions on arrays of shape (..., 4, 4).

An optic of matrix M turned by an angle is ``T(-angle) M T(angle)``; a matrix
acts on Stokes vectors (I, Q, U, V) in the sense of `astropolcal.stokes`.
"""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.stokes import checked_error, require
from astropolcal.units import angle_to_rad, to_unit

__all__ = ["elliptical_retarder", "linear_retarder", "rotate"]

#: Matrices with a one in a row and a column, (row, column, 4, 4).
UNITS = np.eye(16).reshape(4, 4, 4, 4)


def _mueller_array(matrix):
    """Return finite floats of shape (..., 4, 4), or raise."""
    matrix = to_unit(matrix, None, "matrix")
    if matrix.shape[-2:] != (4, 4):
        raise ParameterError(f"matrix has shape {matrix.shape}; a Mueller matrix is (..., 4, 4)")
    require(np.isfinite(matrix), matrix, "matrix", "finite")
    return matrix


def _finite_angle(value, name):
    """Return an angle in radian, or raise if it is not finite."""
    angle = angle_to_rad(value, name)
    require(np.isfinite(angle), angle, name, "finite")
    return angle


def _rotation_matrix(theta):
    """Return T(theta) for floats in radian."""
    theta = np.asarray(theta, dtype=float)
    matrix = np.zeros((*theta.shape, 4, 4))
    matrix[..., 0, 0] = matrix[..., 3, 3] = 1.0
    matrix[..., 1, 1] = matrix[..., 2, 2] = np.cos(2 * theta)
    matrix[..., 1, 2] = np.sin(2 * theta)
    matrix[..., 2, 1] = -matrix[..., 1, 2]
    return matrix


def _rotate(matrix, theta):
    """Return T(-theta) M T(theta) for floats in radian."""
    turn = _rotation_matrix(theta)
    # T(-theta) is the transpose of T(theta)
    return np.swapaxes(turn, -1, -2) @ matrix @ turn


def phase_of(angle):
    """Return what T(angle) multiplies Q + iU by, for floats in radian, or None for 1."""
    # np.any takes three times as long
    return np.exp(-2j * angle) if np.asarray(angle).any() else None


def turned(light, phase, in_place=False):
    """Return T(angle) times Stokes vectors (..., 4), for the phase of the angle."""
    if phase is None:
        return light
    shape = np.broadcast(light[..., 0], phase).shape
    if not in_place or shape != light.shape[:-1]:
        light, given = np.empty((*shape, 4)), light
        light[...] = given
    both = plane(light)
    np.multiply(both, phase, out=both)
    return light


def turned_back(light, phase):
    """Return T(-angle) times Stokes vectors, for the phase of the angle."""
    return turned(light, None if phase is None else phase.conjugate())


def crossed(row, light):
    """Return a G s of rows a and light s, a_Q s_U - a_U s_Q; G is the generator of rotations."""
    return (plane(row).conj() * plane(light)).imag


def plane(light):
    """Return Q + iU as a view."""
    return light[..., 1:3].view(complex)[..., 0]


def _linear_retarder(retardance):
    """Return a linear retarder for floats in radian."""
    matrix = blank(retardance)
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1.0
    fill_phase_block(matrix, np.cos(retardance), np.sin(retardance))
    return matrix


def _diattenuator_retarder(diattenuation, retardance):
    """Return a linear diattenuator-retarder for floats, radian."""
    diattenuation, retardance = (np.asarray(x, float) for x in (diattenuation, retardance))
    transverse = transverse_share(diattenuation)
    matrix = blank(diattenuation, retardance)
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1.0
    matrix[..., 0, 1] = matrix[..., 1, 0] = diattenuation
    fill_phase_block(matrix, transverse * np.cos(retardance), transverse * np.sin(retardance))
    return matrix


def _elliptical_retarder(horizontal, diagonal, circular):
    """Return an elliptical retarder for floats in radian."""
    vector = h, d, c = [np.asarray(x, dtype=float) for x in (horizontal, diagonal, circular)]
    squares = [x * x for x in vector]
    total = np.sqrt(sum(squares))
    # S / Delta and T / Delta^2 of the paper, which are smooth through zero
    sine, cosine = np.sinc(total / np.pi), np.cos(total)
    # 1 - cos x = 2 sin^2(x / 2)
    versine = 0.5 * np.sinc(total / (2 * np.pi)) ** 2
    matrix = np.zeros((*np.shape(total), 16))
    matrix[..., 0] = 1.0
    # cos Delta + T d_i^2 on the diagonal; T d_i d_j plus and minus S d_k on either side of it
    for i, square in zip((5, 10, 15), squares, strict=True):
        matrix[..., i] = cosine + versine * square
    for i, j, first, second, axis in ((6, 9, h, d, c), (11, 14, d, c, h), (13, 7, c, h, d)):
        both, own = versine * first * second, sine * axis
        matrix[..., i] = both + own
        matrix[..., j] = both - own
    return matrix.reshape(*np.shape(total), 4, 4)


def rotation_matrix(angle):
    """
    Return T(angle), shape (..., 4, 4), of an angle with unit.

    It takes Stokes vectors to axes turned counter-clockwise: Q' = Q cos 2 angle + U sin 2 angle,
    U' = -Q sin 2 angle + U cos 2 angle.
    """
    return _rotation_matrix(_finite_angle(angle, "angle"))


def rotate(matrix, angle):
    """
    Return the Mueller matrix of an optic turned by an angle.

    Parameters
    ----------
    matrix : array_like
        Mueller matrix of the optic at angle zero, shape (..., 4, 4).
    angle : `~astropy.units.Quantity`
        Angle of the turn, counter-clockwise looking into the beam; broadcast
        with the leading axes of ``matrix``.

    Returns
    -------
    `~numpy.ndarray`
        ``T(-angle) @ matrix @ T(angle)``, shape (..., 4, 4).

    Raises
    ------
    ParameterError
        If the matrix is not (..., 4, 4), or a value is not finite or has the wrong unit.

    Examples
    --------
    A half-wave plate at 22.5 degrees makes U of Q:

    >>> import astropy.units as u
    >>> from astropolcal.mueller import linear_retarder, rotate
    >>> half_wave = rotate(linear_retarder(180 * u.deg), 22.5 * u.deg)
    >>> (half_wave @ [1, 1, 0, 0]).round(12).tolist()
    [1.0, 0.0, 1.0, 0.0]
    """
    return _rotate(_mueller_array(matrix), _finite_angle(angle, "angle"))


def linear_retarder(retardance):
    r"""
    Return a linear retarder with its axis along Q.

    Parameters
    ----------
    retardance : `~astropy.units.Quantity`
        :math:`\Delta`, an angle.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4), with :math:`U' = U\cos\Delta + V\sin\Delta`.

    Raises
    ------
    ParameterError
        If the retardance has no unit of angle or is not finite.

    Notes
    -----
    Linear retarder of Sec. 3 of the CHARIS recalibration paper.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.mueller import linear_retarder
    >>> (linear_retarder(90 * u.deg) @ [1, 0, 1, 0]).round(12).tolist()
    [1.0, 0.0, 0.0, -1.0]
    """
    return _linear_retarder(_finite_angle(retardance, "retardance"))


def diattenuator_retarder(diattenuation, retardance):
    """
    Return a linear diattenuator and retarder with common axes along Q.

    Equation for M_DR in Sec. 3 of the CHARIS paper.
    """
    strength = to_unit(diattenuation, None, "diattenuation")
    require(np.abs(strength) <= 1, strength, "diattenuation", "between -1 and 1")
    return _diattenuator_retarder(strength, _finite_angle(retardance, "retardance"))


def elliptical_retarder(horizontal, diagonal, circular):
    r"""
    Return an elliptical retarder.

    Parameters
    ----------
    horizontal, diagonal, circular : `~astropy.units.Quantity`
        Components :math:`\Delta_H, \Delta_{45}, \Delta_R` of the retardance,
        angles. Their root of summed squares is the total retardance.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4), the arguments broadcast; smooth where the retardance goes through zero.

    Raises
    ------
    ParameterError
        If a component has no unit of angle or is not finite.

    Notes
    -----
    Equation for :math:`M_{ER}` in Sec. 3 of the CHARIS recalibration paper,
    after Chipman, Lam & Young 2018, doi:10.1201/9781351129121.

    Examples
    --------
    A circular retarder turns the plane of polarization by half its retardance:

    >>> import astropy.units as u
    >>> from astropolcal.mueller import elliptical_retarder
    >>> turn = elliptical_retarder(0 * u.deg, 0 * u.deg, 90 * u.deg)
    >>> (turn @ [1, 1, 0, 0]).round(12).tolist()
    [1.0, 0.0, -1.0, 0.0]
    """
    return _elliptical_retarder(
        _finite_angle(horizontal, "horizontal"),
        _finite_angle(diagonal, "diagonal"),
        _finite_angle(circular, "circular"),
    )


# sqrt(1 - eps^2) has no derivative at |eps| = 1: a floor keeps it finite there
_ROOT_FLOOR = 1e-8


def rotation_generator(matrix):
    """
    Return the derivative of ``T(-theta) M T(theta)`` per radian, at theta = 0.

    It is the commutator ``2 (M G - G M)``, where G turns Q into U.
    """
    out = np.zeros_like(matrix)
    # T(theta) = exp(2 theta G) with G[1, 2] = 1 and G[2, 1] = -1: two columns are those of M G
    out[..., :, 1] -= 2 * matrix[..., :, 2]
    out[..., :, 2] += 2 * matrix[..., :, 1]
    # and two rows those of G M, which is subtracted
    out[..., 1, :] -= 2 * matrix[..., 2, :]
    out[..., 2, :] += 2 * matrix[..., 1, :]
    return out


def turn(matrix):
    """Return 2 G M, the derivative of T(theta) M to theta at theta = 0."""
    out = np.zeros_like(matrix)
    out[..., 1, :] = 2 * matrix[..., 2, :]
    out[..., 2, :] = -2 * matrix[..., 1, :]
    return out


def blank(*values):
    """Return zeros of the values' broadcast shape + (4, 4)."""
    return np.zeros((*np.broadcast(*values).shape, 4, 4))


def retardance_slope(retardance):
    """Return the derivative of a linear retarder to its retardance."""
    out = blank(retardance)
    # of the block [[cos, sin], [-sin, cos]] of (U, V)
    fill_phase_block(out, -np.sin(retardance), np.cos(retardance))
    return out


def transverse_share(diattenuation):
    """Return sqrt(1 - eps^2), what a diattenuator leaves of U and V."""
    # 1 - eps^2 would lose the digits near a polarizer; a fit may try more than 1
    return np.sqrt(np.maximum((1 - diattenuation) * (1 + diattenuation), 0.0))


def fill_phase_block(matrix, c, s):
    """Fill the U, V block with [[c, s], [-s, c]], in place."""
    matrix[..., 2, 2] = matrix[..., 3, 3] = c
    matrix[..., 2, 3] = s
    np.negative(s, out=matrix[..., 3, 2])


def diattenuator_retarder_slopes(diattenuation, retardance):
    """Return the derivatives of a diattenuator-retarder to its diattenuation and retardance."""
    to_diattenuation = blank(diattenuation, retardance)
    to_retardance = np.zeros_like(to_diattenuation)
    c, s, root = np.cos(retardance), np.sin(retardance), transverse_share(diattenuation)
    slope = -diattenuation / np.maximum(root, _ROOT_FLOOR)
    to_diattenuation[..., 0, 1] = to_diattenuation[..., 1, 0] = 1.0
    fill_phase_block(to_diattenuation, slope * c, slope * s)
    # the block of (U, V) is root * [[c, s], [-s, c]]
    fill_phase_block(to_retardance, -root * s, root * c)
    return to_diattenuation, to_retardance


# closer to one than this, a diattenuation is that of a polarizer
_POLARIZER = 1e-13
# excess over one that rounding or measurement may give a diattenuation
_EXCESS = 1e-9
# singular values below this fraction of one count as zero
_SINGULAR = 1e-12


def _transmitting(matrix):
    """Return Mueller matrices that transmit unpolarized light, or raise."""
    matrix = _mueller_array(matrix)
    mean, words = matrix[..., 0, 0], "positive: it is the transmission of unpolarized light"
    require(mean > 0, mean, "matrix[0, 0]", words)
    return matrix


def diattenuation_vector(matrix):
    """Return the first row over its first element, (..., 3): horizontal, diagonal, circular."""
    matrix = _transmitting(matrix)
    return matrix[..., 0, 1:] / matrix[..., 0, :1]


def unit_vectors(vector, fallback):
    """Return unit vectors, and the fallback for vectors of no length."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.where(length > 0, vector / np.where(length > 0, length, 1.0), fallback)


def _smallest_rotation(start, end):
    """Return the rotations of smallest angle that take unit start to end."""
    cosine = np.sum(start * end, axis=-1)[..., None, None]
    # two reflections make the rotation; opposite vectors leave the plane open
    least = np.eye(3)[np.argmin(np.abs(start), axis=-1)]
    aside = unit_vectors(np.cross(start, least), least)
    bisector = np.where(cosine[..., 0] > -1 + _SINGULAR, start + end, aside)
    bisector = unit_vectors(bisector, aside)
    halfway = 2 * bisector[..., :, None] * bisector[..., None, :] - np.eye(3)
    along = 2 * start[..., :, None] * start[..., None, :] - np.eye(3)
    return halfway @ along


def _polar_rotation(block):
    """Return the rotation factor of blocks (..., 3, 3), which are a symmetric one times it."""
    left, singular, right = np.linalg.svd(block)
    floor = _SINGULAR * np.maximum(singular[..., :1], _SINGULAR)
    hand = np.sign(np.linalg.det(left @ right))[..., None]
    # a negative determinant belongs to the depolarizer; a singular block has
    # none, and there the sign of its empty direction makes the rotation proper
    regular = singular[..., 2:] > floor
    flip = np.where(regular | (np.arange(3) == 2), hand, 1.0)
    rotation = (left * flip[..., None, :]) @ right
    # one direction left, or none: the smallest retardance that fits
    lone = (singular[..., 1:2] <= floor)[..., None]
    empty = (singular[..., :1] <= _SINGULAR)[..., None]
    smallest = _smallest_rotation(right[..., 0, :], left[..., :, 0])
    return np.where(empty, np.eye(3), np.where(lone, smallest, rotation))


def retardance_vector(matrix):
    """Return the retardance vector of the retarder within Mueller matrices (..., 4, 4).

    It is a Quantity in radian of shape (..., 3), horizontal, diagonal and circular, of length up
    to pi; at pi, where both signs are the same retarder, the first component that is not zero is
    positive.

    The retarder is that of matrix = depolarizer @ retarder @ diattenuator (Lu & Chipman 1996,
    doi:10.1364/JOSAA.13.001106). Singular matrices have many: a polarizer (diattenuation within
    1e-13 of one), and a matrix that leaves one state of polarization, are given the smallest
    retardance that fits, one that leaves no state is given none. A negative determinant belongs
    to the depolarizer.
    """
    # slow to import, and only this function needs it
    from scipy.spatial.transform import Rotation

    matrix = _transmitting(matrix)
    matrix = matrix / matrix[..., :1, :1]
    row, column = matrix[..., 0, 1:], matrix[..., 1:, 0]
    strength = np.linalg.norm(row, axis=-1, keepdims=True)
    if (strength > 1 + _EXCESS).any():
        raise ParameterError(f"diattenuation = {strength.max()} must be at most 1")
    axis, pure = unit_vectors(row, np.array([1.0, 0.0, 0.0])), strength >= 1 - _POLARIZER
    attenuation = np.where(pure, 0.0, strength)
    # the block without the diattenuator, written for the two states that this passes best and
    # worst, so that nothing cancels however close to a polarizer it is
    block = matrix[..., 1:, 1:]
    image = np.squeeze(block @ axis[..., None], axis=-1)
    best = (column + image) / (1 + attenuation)
    worst = (column - image) / (1 - attenuation)
    across = block - image[..., :, None] * axis[..., None, :]
    across = across / np.sqrt((1 - attenuation) * (1 + attenuation))[..., None]
    block = across + (best - worst)[..., :, None] * axis[..., None, :] / 2
    turn = _smallest_rotation(axis, unit_vectors(column, axis))
    block = np.where(pure[..., None], turn, _polar_rotation(block))
    # a retarder of vector d is the rotation exp(-[d]x), hence the sign
    flat = -Rotation.from_matrix(block.reshape(-1, 3, 3)).as_rotvec()
    # at half a wave both signs are the same retarder: take the first
    # component that is not zero as positive
    half_wave = np.pi - np.linalg.norm(flat, axis=-1) < _SINGULAR
    leading = np.argmax(np.abs(flat) > 1e-9, axis=-1)[..., None]
    negative = np.take_along_axis(flat, leading, axis=-1)[..., 0] < 0
    flat = np.where((half_wave & negative)[..., None], -flat, flat)
    # adding zero turns -0 into 0
    return (flat.reshape(block.shape[:-1]) + 0.0) * u.rad


# the Pauli matrices in the order of the Stokes parameters
_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, -1j], [1j, 0]]])
# M_ij = sum_kl _BASIS_ijkl C_kl; four times unitary as a 16 by 16 matrix
_BASIS = np.einsum("iab,kbc,jcd,lda->ijkl", _PAULI, _PAULI, _PAULI, _PAULI) / 2


def coherency_matrix(matrix):
    r"""
    Return the coherency matrices of Mueller matrices (..., 4, 4) in the Pauli basis.

    They are Hermitian, their trace is the transmission of unpolarized light. For an optic of Jones
    matrix :math:`\sum_k c_k \sigma_k` it is :math:`c\,c^\dagger`. Inverse of :math:`M_{ij} =
    \frac{1}{2} \sum_{kl} C_{kl} \mathrm{tr}(\sigma_i \sigma_k \sigma_j \sigma_l)`, Cloude 1990,
    Proc. SPIE 1166, 177, doi:10.1117/12.962889; a retarder is
    :math:`e^{+i \Delta \cdot \sigma / 2}`.
    """
    return np.einsum("ijkl,...ij->...kl", _BASIS.conj(), _mueller_array(matrix)) / 4


def is_physical(matrix, tolerance=1e-9):
    """Tell which matrices, (..., 4, 4), are Mueller matrices that nature allows.

    An eigenvalue of the coherency matrix may lie below zero by the tolerance, a fraction of the
    transmission of unpolarized light; one that is negative raises. A matrix is a mixture of at
    most four optics without depolarization where its coherency matrix has no negative eigenvalue:
    Cloude 1990, doi:10.1117/12.962889.
    """
    matrix, tolerance = _mueller_array(matrix), checked_error(tolerance, "tolerance")
    smallest = np.linalg.eigvalsh(coherency_matrix(matrix))[..., 0]
    return smallest >= -tolerance * matrix[..., 0, 0]
