# Licensed under a 3-clause BSD style license - see LICENSE
"""
Which 4 by 4 matrices are Mueller matrices, and which optics only take light.

A matrix is physical where its coherency matrix (Cloude 1986, Optik 75, 26)
has no negative eigenvalue: it is then a mixture of at most four optics
without depolarization.
"""

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.mueller.decomposition import _transmitting, diattenuation, polarizance
from astropolcal.mueller.elements import _mueller_array
from astropolcal.units import to_unit

__all__ = [
    "coherency_eigenvalues",
    "coherency_matrix",
    "is_passive",
    "is_physical",
    "mueller_from_coherency",
    "nearest_physical",
]

# the Pauli matrices in the order of the Stokes parameters
_PAULI = np.array(
    [
        [[1, 0], [0, 1]],
        [[1, 0], [0, -1]],
        [[0, 1], [1, 0]],
        [[0, -1j], [1j, 0]],
    ]
)
# M_ij = sum_kl _BASIS_ijkl C_kl; four times unitary as a 16 by 16 matrix
_BASIS = np.einsum("iab,kbc,jcd,lda->ijkl", _PAULI, _PAULI, _PAULI, _PAULI) / 2


def _tolerance(value):
    """Return a tolerance, or raise if it is negative or not a number."""
    value = to_unit(value, None, "tolerance")
    if not (value >= 0).all():
        raise ParameterError(f"tolerance = {value} must be zero or positive")
    return value


def coherency_matrix(matrix):
    r"""
    Return the coherency matrices of Mueller matrices in the Pauli basis.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        Hermitian complex matrices of shape (..., 4, 4) whose trace is the
        transmission of unpolarized light. For an optic of Jones matrix
        :math:`\sum_k c_k \sigma_k` it is :math:`c\,c^\dagger`.

    Raises
    ------
    ParameterError
        If the shape is wrong or a value is not finite.

    Notes
    -----
    Inverse of :math:`M_{ij} = \frac{1}{2} \sum_{kl} C_{kl}
    \mathrm{tr}(\sigma_i \sigma_k \sigma_j \sigma_l)`, Cloude 1990, Proc. SPIE
    1166, 177, doi:10.1117/12.962889. In the sign convention of the package a
    retarder has the Jones matrix :math:`e^{+i \Delta \cdot \sigma / 2}`.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.mueller import coherency_matrix
    >>> coherency_matrix(np.eye(4)).real.diagonal().tolist()
    [1.0, 0.0, 0.0, 0.0]
    """
    return np.einsum("ijkl,...ij->...kl", _BASIS.conj(), _mueller_array(matrix)) / 4


def mueller_from_coherency(coherency):
    """
    Return the Mueller matrices of coherency matrices.

    Parameters
    ----------
    coherency : array_like
        Hermitian matrices of shape (..., 4, 4), as of `coherency_matrix`.

    Returns
    -------
    `~numpy.ndarray`
        Real matrices of shape (..., 4, 4).

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or a matrix is not
        Hermitian.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.mueller import mueller_from_coherency
    >>> mueller_from_coherency(np.eye(4) / 4).tolist()[0]
    [1.0, 0.0, 0.0, 0.0]
    """
    coherency = np.asarray(coherency, dtype=complex)
    if coherency.shape[-2:] != (4, 4) or not np.isfinite(coherency).all():
        raise ParameterError(
            f"coherency of shape {coherency.shape} must be finite and of shape (..., 4, 4)"
        )
    # products of measured matrices are Hermitian to rounding only, hence 1e-9 of the largest
    skew = np.abs(coherency - np.swapaxes(coherency, -1, -2).conj()).max(initial=0.0)
    if skew > 1e-9 * np.abs(coherency).max(initial=0.0):
        raise ParameterError(f"coherency differs from its adjoint by {skew}; it must be Hermitian")
    return _mueller(coherency)


def _mueller(coherency):
    """Return the Mueller matrices of Hermitian matrices, unchecked."""
    return np.einsum("ijkl,...kl->...ij", _BASIS, coherency).real


def coherency_eigenvalues(matrix):
    """
    Return the eigenvalues of the coherency matrices, smallest first.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4).

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4); their sum is the transmission of unpolarized light.

    Raises
    ------
    ParameterError
        If the shape is wrong or a value is not finite.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.mueller import coherency_eigenvalues
    >>> coherency_eigenvalues(np.diag([1.0, 1.0, 1.0, -1.0])).round(12).tolist()
    [-0.5, 0.5, 0.5, 0.5]
    """
    return np.linalg.eigvalsh(coherency_matrix(matrix))


def is_physical(matrix, tolerance=1e-9):
    """
    Tell which matrices are Mueller matrices that nature allows.

    Parameters
    ----------
    matrix : array_like
        Matrices of shape (..., 4, 4).
    tolerance : float
        How far below zero an eigenvalue of the coherency matrix may lie, as a
        fraction of the transmission of unpolarized light.

    Returns
    -------
    `~numpy.ndarray` of bool
        Of the leading shape of ``matrix``.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite or the tolerance is
        negative.

    See Also
    --------
    is_passive : whether it also gives out no more light than it takes.

    Notes
    -----
    Cloude 1990, doi:10.1117/12.962889.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.mueller import is_physical
    >>> bool(is_physical(np.diag([1.0, 1.0, 1.0, -1.0])))
    False
    """
    matrix = _mueller_array(matrix)
    return coherency_eigenvalues(matrix)[..., 0] >= -_tolerance(tolerance) * matrix[..., 0, 0]


def _nearest_eigenvalues(values, total):
    """Return the nearest values that are not negative and have the sum given."""
    # projection onto the simplex: the largest eigenvalues are lowered alike until their sum is
    # right, and those that fall below zero count as zero
    falling = values[..., ::-1]
    count = np.arange(1, 5)
    shift = (np.cumsum(falling, axis=-1) - total[..., None]) / count
    last = np.sum(falling > shift, axis=-1, keepdims=True) - 1
    return np.maximum(values - np.take_along_axis(shift, last, axis=-1), 0.0)


def nearest_physical(matrix, tolerance=1e-12):
    """
    Return the nearest Mueller matrices of the same transmission.

    Negative eigenvalues of the coherency matrix, the part that no mixture of
    optics can make, are removed, and the others lowered alike until their sum
    is again the transmission of unpolarized light.

    Parameters
    ----------
    matrix : array_like
        Matrices of shape (..., 4, 4), such as measured ones.
    tolerance : float
        Matrices that are physical within this tolerance (see `is_physical`)
        are returned as they are.

    Returns
    -------
    `~numpy.ndarray`
        Shape (..., 4, 4): the physical matrix of the same first element that
        is nearest in the Frobenius norm. Applying it again changes nothing,
        and no physical matrix of that first element comes to lie farther away.

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite, the transmission of
        unpolarized light is not positive or the tolerance is negative.

    Notes
    -----
    Eigenvalue filtering of Cloude 1990, Proc. SPIE 1166, 177,
    doi:10.1117/12.962889, with the sum kept as Smolin, Gambetta & Smith 2012,
    doi:10.1103/PhysRevLett.108.070502, do for density matrices. Scaling the
    eigenvalues instead keeps the sum too, but can take a noisy matrix farther
    from the truth.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.mueller import nearest_physical
    >>> nearest_physical(np.diag([1.0, 1.0, 1.0, -1.0])).diagonal().round(6).tolist()
    [1.0, 0.333333, 0.333333, -0.333333]
    """
    matrix = _transmitting(matrix)
    values, vectors = np.linalg.eigh(coherency_matrix(matrix))
    kept = _nearest_eigenvalues(values, matrix[..., 0, 0])
    # V diag(kept) V^H
    filtered = _mueller((vectors * kept[..., None, :]) @ np.swapaxes(vectors, -1, -2).conj())
    physical = values[..., 0] >= -_tolerance(tolerance) * matrix[..., 0, 0]
    return np.where(physical[..., None, None], matrix, filtered)


def is_passive(matrix, tolerance=1e-9):
    r"""
    Tell which Mueller matrices give out no more light than they take.

    Parameters
    ----------
    matrix : array_like
        Mueller matrices of shape (..., 4, 4), physical ones.
    tolerance : float
        Excess over full transmission that still passes.

    Returns
    -------
    `~numpy.ndarray` of bool
        Whether :math:`m_{00} (1 + \max(D, P)) \le 1`, with diattenuation D
        and polarizance P (light may travel either way).

    Raises
    ------
    ParameterError
        If the shape is wrong, a value is not finite, the transmission of
        unpolarized light is not positive or the tolerance is negative.

    Notes
    -----
    San José & Gil 2020, J. Opt. Soc. Am. A 37, 199,
    doi:10.1364/JOSAA.37.000199. The matrices of unit mean transmission of a
    calibration are passive only where they have no diattenuation.

    Examples
    --------
    >>> from astropolcal.mueller import diattenuator, is_passive, linear_polarizer
    >>> bool(is_passive(linear_polarizer())), bool(is_passive(diattenuator(0.1)))
    (True, False)
    """
    matrix = _transmitting(matrix)
    # the state that passes best has 1 + D of the mean; backwards the polarizance takes its place
    best = matrix[..., 0, 0] * (1 + np.maximum(diattenuation(matrix), polarizance(matrix)))
    return best <= 1 + _tolerance(tolerance)
