# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sums and differences of the two beams, of one frame and of two.

X and I follow Sec. 2.2 of the CHARIS recalibration paper.
"""

__all__ = ["double_difference", "double_sum", "single_difference", "single_sum"]


def single_difference(right, left):
    """
    Return the single difference, X = R - L.

    Parameters
    ----------
    right, left : `~numpy.ndarray`
        Fluxes of the ordinary (right) and extraordinary (left) beam, any shape.

    Returns
    -------
    `~numpy.ndarray`
        Of the common shape, in the unit of the fluxes.

    Examples
    --------
    >>> from astropolcal.observations import single_difference
    >>> single_difference(3.0, 1.0)
    2.0
    """
    return right - left


def single_sum(right, left):
    """
    Return the single sum, I = R + L.

    Parameters
    ----------
    right, left : `~numpy.ndarray`
        Fluxes of the ordinary (right) and extraordinary (left) beam, any shape.

    Returns
    -------
    `~numpy.ndarray`
        Of the common shape, in the unit of the fluxes.

    Examples
    --------
    >>> from astropolcal.observations import single_sum
    >>> single_sum(3.0, 1.0)
    4.0
    """
    return right + left


def double_difference(right, left):
    """
    Return the double difference, (X+ - X-) / 2.

    Parameters
    ----------
    right, left : `~numpy.ndarray`
        Fluxes of shape (2, ...): the plus frame, then the minus frame.

    Returns
    -------
    `~numpy.ndarray`
        Of shape (...), in the unit of the fluxes.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.observations import double_difference
    >>> float(double_difference(np.array([3.0, 1.0]), np.array([1.0, 3.0])))
    2.0
    """
    difference = right - left
    return 0.5 * (difference[0] - difference[1])


def double_sum(right, left):
    """
    Return the double sum, (I+ + I-) / 2.

    Parameters
    ----------
    right, left : `~numpy.ndarray`
        Fluxes of shape (2, ...): the plus frame, then the minus frame.

    Returns
    -------
    `~numpy.ndarray`
        Of shape (...), in the unit of the fluxes.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.observations import double_sum
    >>> float(double_sum(np.array([3.0, 1.0]), np.array([1.0, 3.0])))
    4.0
    """
    total = right + left
    return 0.5 * (total[0] + total[1])
