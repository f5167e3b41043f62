# Licensed under a 3-clause BSD style license - see LICENSE
"""Bases of laws in wavelength, and of spaces of columns."""

import numpy as np


def law_basis(wavelength, degree):
    """
    Return the basis of a polynomial law in wavelength.

    Parameters
    ----------
    wavelength : `~numpy.ndarray`
        Micrometre, shape (W,).
    degree : int or None
        Degree of the polynomial (Legendre, over the range of the wavelengths);
        None for one value a wavelength.

    Returns
    -------
    `~numpy.ndarray`
        Shape (W, k).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.problem import law_basis
    >>> law_basis(np.array([1.0, 1.5, 2.0]), 1).tolist()
    [[1.0, -1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    n = len(wavelength)
    if degree is None or degree >= n - 1:
        return np.eye(n)
    middle, half = (wavelength.max() + wavelength.min()) / 2, np.ptp(wavelength) / 2
    return np.polynomial.legendre.legvander((wavelength - middle) / half, degree)


def orthonormal(columns, keep=1e-9):
    """
    Return an orthonormal basis of columns.

    Parameters
    ----------
    columns : `~numpy.ndarray`
        Shape (n_rows, k).
    keep : float
        Directions below this share of the strongest are left out; columns are
        compared at unit length.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_rows, rank).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.problem import orthonormal
    >>> orthonormal(np.array([[1.0, 2.0], [1.0, 2.0]])).shape
    (2, 1)
    """
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    if not columns.shape[1]:
        return np.zeros((len(columns), 0))
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > keep * singular[0]]
