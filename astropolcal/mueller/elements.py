# Licensed under a 3-clause BSD style license - see LICENSE
"""
The elementary Mueller matrices, their rotation and their composition.

Public functions take angles with a unit and check what they are given; their
twins with a leading underscore take floats in radian, check nothing, and are
what an optic evaluates in a fit.
"""

from functools import reduce

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import angle_to_rad, to_unit

__all__ = [
    "compose",
    "depolarizer",
    "diattenuator",
    "diattenuator_retarder",
    "elliptical_retarder",
    "linear_polarizer",
    "linear_retarder",
    "rotate",
    "rotation_matrix",
]

# sums of four factors, each known to a few 1e-16, lie on the limit to within this
_ROUNDING = 1e-12


def _mueller_array(matrix, name="matrix"):
    """Return finite floats of shape (..., 4, 4), or raise."""
    matrix = to_unit(matrix, None, name)
    if matrix.shape[-2:] != (4, 4):
        raise ParameterError(f"{name} has shape {matrix.shape}; a Mueller matrix is (..., 4, 4)")
    if not np.isfinite(matrix).all():
        where = np.unravel_index(np.argmin(np.isfinite(matrix)), matrix.shape)
        raise ParameterError(
            f"{name} = {matrix[where]} at index {tuple(int(i) for i in where)} must be finite"
        )
    return matrix


def _finite_angle(value, name):
    """Return an angle in radian, or raise if it is not finite."""
    angle = angle_to_rad(value, name)
    if not np.isfinite(angle).all():
        raise ParameterError(f"{name} = {value} must be finite")
    return angle


def _fraction(value, name):
    """Return a number between -1 and 1, or raise."""
    value = to_unit(value, None, name)
    bad = ~(np.abs(value) <= 1)
    if bad.any():
        raise ParameterError(f"{name} = {value[bad].ravel()[0]} must be between -1 and 1")
    return value


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


def _linear_retarder(retardance):
    """Return a linear retarder for floats in radian."""
    retardance = np.asarray(retardance, dtype=float)
    sine = np.sin(retardance)
    matrix = np.zeros((*retardance.shape, 4, 4))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1.0
    matrix[..., 2, 2] = matrix[..., 3, 3] = np.cos(retardance)
    matrix[..., 2, 3] = sine
    matrix[..., 3, 2] = -sine
    return matrix


def _diattenuator(diattenuation):
    """Return a linear diattenuator, unchecked."""
    return _diattenuator_retarder(diattenuation, 0.0)


def _diattenuator_retarder(diattenuation, retardance):
    """Return a linear diattenuator-retarder for floats, radian."""
    diattenuation = np.asarray(diattenuation, dtype=float)
    # the product keeps the digits that 1 - D^2 loses near D = 1
    transverse = np.sqrt((1 - diattenuation) * (1 + diattenuation))
    cosine, sine = transverse * np.cos(retardance), transverse * np.sin(retardance)
    matrix = np.zeros((*np.shape(cosine), 4, 4))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1.0
    matrix[..., 0, 1] = matrix[..., 1, 0] = diattenuation
    matrix[..., 2, 2] = matrix[..., 3, 3] = cosine
    matrix[..., 2, 3] = sine
    matrix[..., 3, 2] = -sine
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
    r"""
    Return T(angle), which takes Stokes vectors to axes turned by the angle.

    Parameters
    ----------
    angle : `~astropy.units.Quantity`
        Angle of the turn, counter-clockwise looking into the beam.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4): :math:`Q' = Q\cos 2\theta + U\sin 2\theta`,
        :math:`U' = -Q\sin 2\theta + U\cos 2\theta`.

    Raises
    ------
    ParameterError
        If the angle has no unit of angle or is not finite.

    Notes
    -----
    Rotation matrix of Sec. 3 of the CHARIS recalibration paper.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.mueller import rotation_matrix
    >>> (rotation_matrix(45 * u.deg) @ [1, 0, 1, 0]).round(12).tolist()
    [1.0, 1.0, 0.0, 0.0]
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
        If the matrix is not (..., 4, 4), or a value is not finite or has the
        wrong unit.

    Examples
    --------
    A polarizer turned by 90 degrees passes -Q:

    >>> import astropy.units as u
    >>> from astropolcal.mueller import linear_polarizer, rotate
    >>> (rotate(linear_polarizer(), 90 * u.deg) @ [1, 0, 0, 0]).round(12).tolist()
    [0.5, -0.5, 0.0, 0.0]
    """
    return _rotate(_mueller_array(matrix), _finite_angle(angle, "angle"))


def compose(*matrices):
    """
    Return the Mueller matrix of several optics behind one another.

    Parameters
    ----------
    *matrices : array_like
        Mueller matrices (..., 4, 4) in the order in which the light meets
        them, broadcast together.

    Returns
    -------
    `~numpy.ndarray`
        Their product, the first matrix rightmost.

    Raises
    ------
    ParameterError
        If nothing is given, a matrix is not (..., 4, 4) or not finite.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.mueller import compose, linear_polarizer, linear_retarder, rotate
    >>> half_wave = rotate(linear_retarder(180 * u.deg), 22.5 * u.deg)
    >>> (compose(linear_polarizer(), half_wave) @ [1, 1, 0, 0]).round(12).tolist()
    [1.0, 0.0, 1.0, 0.0]
    """
    if not matrices:
        raise ParameterError("compose needs at least one Mueller matrix")
    checked = [_mueller_array(m, f"matrix {i + 1}") for i, m in enumerate(matrices)]
    # light meets the first matrix first, which stands rightmost
    return reduce(lambda so_far, optic: optic @ so_far, checked)


def linear_polarizer():
    """
    Return an ideal polarizer that passes +Q and half of unpolarized light.

    Returns
    -------
    `~numpy.ndarray`
        Shape (4, 4), first element 0.5; turn it with `rotate`. With unit mean
        transmission it is ``diattenuator(1)``.

    Examples
    --------
    >>> from astropolcal.mueller import linear_polarizer
    >>> (linear_polarizer() @ [1.0, 0.0, 0.0, 0.0]).tolist()
    [0.5, 0.5, 0.0, 0.0]
    """
    return 0.5 * _diattenuator(1.0)


def diattenuator(diattenuation):
    r"""
    Return a linear diattenuator of unit mean transmission.

    Parameters
    ----------
    diattenuation : float or array_like
        :math:`\epsilon`, -1 to 1; positive where +Q passes better.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4). Light polarized along the better axis is scaled by
        :math:`1 + |\epsilon|`, so absolute fluxes need a further factor.

    Raises
    ------
    ParameterError
        If the diattenuation is not between -1 and 1.

    Notes
    -----
    Diattenuator-retarder of Sec. 3 of the CHARIS recalibration paper with
    zero retardance.

    Examples
    --------
    >>> from astropolcal.mueller import diattenuator
    >>> (diattenuator(0.01) @ [1.0, 0.0, 0.0, 0.0]).tolist()
    [1.0, 0.01, 0.0, 0.0]
    """
    return _diattenuator(_fraction(diattenuation, "diattenuation"))


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
    r"""
    Return a linear diattenuator and retarder with common axes along Q.

    Parameters
    ----------
    diattenuation : float or array_like
        :math:`\epsilon`, -1 to 1; positive where +Q passes better.
    retardance : `~astropy.units.Quantity`
        :math:`\Delta`, an angle.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4), unit mean transmission, the arguments broadcast.

    Raises
    ------
    ParameterError
        If a value is out of range, not finite or has the wrong unit.

    Notes
    -----
    Equation for :math:`M_{DR}` in Sec. 3 of the CHARIS recalibration paper.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.mueller import diattenuator_retarder
    >>> diattenuator_retarder(0.6, 90 * u.deg).round(12).tolist()[2]
    [0.0, 0.0, 0.0, 0.8]
    """
    return _diattenuator_retarder(
        _fraction(diattenuation, "diattenuation"), _finite_angle(retardance, "retardance")
    )


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
        Shape (..., 4, 4), the arguments broadcast; smooth where the
        retardance goes through zero.

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


def depolarizer(q, u=None, v=None):
    """
    Return a diagonal depolarizer.

    Parameters
    ----------
    q, u, v : float or array_like
        Factors on Q, U and V, -1 to 1. ``u`` and ``v`` left out equal ``q``.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4), the arguments broadcast.

    Raises
    ------
    ParameterError
        If a factor is out of range, or no light path has these three
        together, such as (1, 1, -1).

    Notes
    -----
    The three factors are possible where the four eigenvalues of the coherency
    matrix, ``1 + q + u + v``, ``1 + q - u - v`` and so on, are not negative.

    Examples
    --------
    >>> from astropolcal.mueller import depolarizer
    >>> (depolarizer(0.9) @ [1.0, 1.0, 0.0, 0.0]).tolist()
    [1.0, 0.9, 0.0, 0.0]
    """
    q = _fraction(q, "q")
    u, v = (q if x is None else _fraction(x, name) for x, name in ((u, "u"), (v, "v")))
    # the coherency matrix of a diagonal matrix is diagonal, a quarter of these four sums
    factors = np.stack(np.broadcast_arrays(np.ones(()), q, u, v), axis=-1)
    signs = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]])
    bad = ((factors @ signs) < -_ROUNDING).any(axis=-1)
    if bad.any():
        q, u, v = (float(x) for x in factors[bad][0, 1:])
        raise ParameterError(
            f"depolarizer factors q = {q}, u = {u}, v = {v} must satisfy "
            "|q + u| <= 1 + v and |q - u| <= 1 - v"
        )
    return factors[..., None] * np.eye(4)
