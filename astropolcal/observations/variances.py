# Licensed under a 3-clause BSD style license - see LICENSE
"""
Errors of the two beams, from whichever errors a table gives.
"""

import numpy as np

__all__ = ["BEAM_ERRORS", "SINGLE_ERRORS", "beam_variances"]

BEAM_ERRORS = ("flux_right_err", "flux_left_err")
"""Columns with the standard deviations of R and L."""

SINGLE_ERRORS = ("single_difference_err", "single_sum_err")
"""Columns with the standard deviations of R - L and R + L."""


def beam_variances(flux_right, flux_left, errors):
    """
    Return the variances of the two beams and their covariance.

    With S = R + L and D = R - L, var(S) + var(D) = 2 (var(R) + var(L)) and
    var(S) - var(D) = 4 cov(R, L). Errors of S and D leave open how the variance
    is shared between the beams: it is shared in proportion to their fluxes, as
    photon noise would be, but never so unevenly that the covariance matrix of
    the two beams would cease to be one.

    Parameters
    ----------
    flux_right, flux_left : `~numpy.ndarray`
        Shape (F, W).
    errors : dict
        Standard deviations under the names of `BEAM_ERRORS` or `SINGLE_ERRORS`;
        an empty one gives NaN.

    Returns
    -------
    variance_right, variance_left, covariance : `~numpy.ndarray`
        Each (F, W).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.observations.variances import beam_variances
    >>> errors = {"single_difference_err": np.array([2.0]), "single_sum_err": np.array([2.0])}
    >>> [float(v[0]) for v in beam_variances(np.array([3.0]), np.array([1.0]), errors)]
    [3.0, 1.0, 0.0]
    """
    if not errors:
        return tuple(np.full_like(flux_right, np.nan) for _ in range(3))
    if BEAM_ERRORS[0] in errors:
        right, left = (errors[name] ** 2 for name in BEAM_ERRORS)
        return right, left, np.where(np.isnan(right), np.nan, 0.0)
    difference, total = (errors[name] ** 2 for name in SINGLE_ERRORS)
    # both at once: var(S) - var(D) = 4 cov
    covariance = 0.25 * (total - difference)
    # var(R) + var(L)
    both = 0.5 * (total + difference)
    # var(R) var(L) >= cov^2 bounds the share of the right beam around one half
    reach = np.sqrt(np.maximum(0.25 - (covariance / both) ** 2, 0.0))
    share = np.clip(flux_right / (flux_right + flux_left), 0.5 - reach, 0.5 + reach)
    return both * share, both * (1.0 - share), covariance
