# Licensed under a 3-clause BSD style license - see LICENSE
"""Fractions, degree and angle of polarization of maps, with errors; NaN where there are none."""

import numpy as np

from astropolcal.stokes import (
    aolp_error,
    debias_dolp,
    dolp_error,
    polarization_angle,
    transverse_error,
)

__all__ = ["fractions", "polarization"]


def fractions(stokes, covariances, components="IQU"):
    r"""
    Return errors of Q / I, U / I and V / I.

    Parameters
    ----------
    stokes : `~numpy.ndarray`
        Shape (n_components, ...), I first.
    covariances : `~numpy.ndarray`
        Shape (n_components, n_components, ...).
    components : str
        What they are.

    Returns
    -------
    dict of str to `~numpy.ndarray`
        Standard deviations ``q``, ``u``, ``v``, and ``covariance_qu``; infinite where a
        covariance is, NaN where it is not known or there is no light.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.correction.polarization import fractions
    >>> errors = fractions(np.array([2.0, 0.0, 0.0]), np.diag([1.0, 0.01, 0.04]))
    >>> float(errors["q"].round(6)), float(errors["u"].round(6))
    (0.05, 0.1)
    """
    bright = stokes[0] > 0
    light = np.where(bright, stokes[0], 1.0)
    share = stokes / light
    found = {}
    with np.errstate(invalid="ignore"):
        for i, name in enumerate(components[1:].lower(), start=1):
            # dq = (dQ - q dI) / I to first order
            variance = (
                covariances[i, i]
                - 2 * share[i] * covariances[0, i]
                + share[i] ** 2 * covariances[0, 0]
            ) / light**2
            # what is open has no covariance, but an infinite error all the same
            variance = np.where(np.isinf(covariances[i, i]), np.inf, variance)
            found[name] = np.where(bright, np.sqrt(np.maximum(variance, 0)), np.nan)
        # the same for the covariance of q and u
        cross = (
            covariances[1, 2]
            - share[1] * covariances[0, 2]
            - share[2] * covariances[0, 1]
            + share[1] * share[2] * covariances[0, 0]
        ) / light**2
    found["covariance_qu"] = np.where(bright, cross, np.nan)
    return found


def polarization(q, u, errors, method="mas"):
    """
    Return degree and angle of linear polarization with their errors.

    Parameters
    ----------
    q, u : `~numpy.ndarray`
        Normalized Stokes parameters.
    errors : dict of str to dict
        Kind of error to what `fractions` gives; that of the kind ``"statistical"`` removes the
        bias of noise.
    method : str
        Of `~astropolcal.stokes.debias_dolp`.

    Returns
    -------
    dict of str to `~numpy.ndarray`
        ``dolp``, ``dolp_debiased``, ``aolp`` (degree, 0 to 180), and ``s_p`` and ``s_chi``
        (degree) of each kind.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.correction.polarization import polarization
    >>> error = {"q": np.array([1e-3]), "u": np.array([1e-3]), "covariance_qu": np.zeros(1)}
    >>> found = polarization(np.array([0.02]), np.zeros(1), {"statistical": error})
    >>> found["s_p_statistical"], found["s_chi_statistical"].round(3)
    (array([0.001]), array([1.432]))
    """
    dolp = np.hypot(q, u)
    result = {
        "dolp": dolp,
        "dolp_debiased": np.full(dolp.shape, np.nan),
        "aolp": np.where(dolp > 0, polarization_angle(q, u), np.nan),
    }
    for kind, error in errors.items():
        s_p, s_chi, across = _errors(q, u, dolp, error)
        result[f"s_p_{kind}"], result[f"s_chi_{kind}"] = s_p, s_chi
        if kind == "statistical":
            known = np.isfinite(across) & np.isfinite(dolp)
            result["dolp_debiased"][known] = debias_dolp(dolp[known], across[known], method)
    return result


def _errors(q, u, dolp, error):
    """Return error of the degree, of the angle, and across the direction of polarization."""
    s_q, s_u = error["q"], error["u"]
    is_open = np.isinf(s_q) | np.isinf(s_u)
    found = np.full((3, *dolp.shape), np.nan)
    found[:, is_open & (dolp > 0)] = np.inf
    good = (dolp > 0) & np.isfinite(s_q) & np.isfinite(s_u)
    if good.any():
        # rounding may lift a perfect correlation above one
        limit = s_q[good] * s_u[good]
        cross = np.clip(error["covariance_qu"][good], -limit, limit)
        arguments = q[good], u[good], s_q[good], s_u[good], cross
        found[0, good] = dolp_error(*arguments)
        found[1, good] = aolp_error(*arguments).value
        found[2, good] = transverse_error(*arguments)
    return found
