# Licensed under a 3-clause BSD style license - see LICENSE
"""Arrays of Mueller matrices that optics fill, and their derivatives by a turn."""

import numpy as np

# sqrt(1 - eps^2) has no derivative at |eps| = 1: a floor keeps it finite there
_ROOT_FLOOR = 1e-8


def rotation_generator(matrix):
    """
    Return the derivative of ``T(-theta) M T(theta)`` to theta, at theta = 0.

    With ``T(theta)`` the rotation of Sec. 2 of the CHARIS paper, the
    derivative is the commutator ``2 (M G - G M)``, where G turns Q into U.

    Parameters
    ----------
    matrix : `~numpy.ndarray`
        Mueller matrices, shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        Derivative per radian, shape (..., 4, 4).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.optics import rotation_generator
    >>> bool(np.all(rotation_generator(np.eye(4)) == 0))
    True
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
    out[..., 2, 2] = out[..., 3, 3] = -np.sin(retardance)
    cosine = np.cos(retardance)
    out[..., 2, 3] = cosine
    out[..., 3, 2] = -cosine
    return out


def transverse_share(diattenuation):
    """Return sqrt(1 - eps^2), what a diattenuator leaves of U and V."""
    # 1 - eps^2 would lose the digits near a polarizer
    return np.sqrt((1 - diattenuation) * (1 + diattenuation))


def fill_phase_block(matrix, c, s):
    """Fill the U, V block with [[c, s], [-s, c]], in place."""
    matrix[..., 2, 2] = matrix[..., 3, 3] = c
    matrix[..., 2, 3] = s
    matrix[..., 3, 2] = -np.asarray(s)


def diattenuation_slope(diattenuation, c, s):
    """Return the derivative of a diattenuator-retarder, by cosine and sine of its retardance."""
    out = blank(diattenuation, c)
    out[..., 0, 1] = out[..., 1, 0] = 1.0
    slope = -diattenuation / np.maximum(transverse_share(diattenuation), _ROOT_FLOOR)
    fill_phase_block(out, slope * c, slope * s)
    return out
