# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors of q, u, degree and angle of polarization of a target, from the covariance of a fit."""

import numpy as np

from astropolcal.calibration._rows import model_error
from astropolcal.calibration.covariance import full_covariance
from astropolcal.calibration.sky import light_of

# what changes by less than this share of all its changes along an open direction stands still
_STILL = 1e-5
KEYS = ("s_Q", "s_U", "s_p", "s_chi")


class SkyErrors:
    """Covariance of the nine changes of I, Q and U that a calibration's errors make on sky."""

    def __init__(self, calibration, view, ignore=False):
        self._good, self._ignore = view.good, ignore
        axes = full_covariance(calibration)._axes()
        # the nine in one axis, in degree, micrometre or percent
        slopes = view.changes.reshape(*view.good.shape, 9, -1) * axes.steps
        known, is_open, is_blind = (slopes @ part.T for part in (axes.known, axes.open, axes.blind))
        self._known, self._open, self._blind = map(_products, (known, is_open, is_blind))
        self._partial = axes.partial
        extra = model_error(calibration.fit, view.lam)
        extra = np.moveaxis(extra.reshape(len(extra), len(view.lam), 9), 0, -1)
        self._covariance = _products(known * axes.sigmas) + _products(extra)[:, None]

    def of_target(self, dolp, double):
        """
        Return the rms over the settings of the errors of q, u, degree and angle, as fractions.

        Shape (4, n_wavelengths, n_angles) for angles of which the double is given in radian;
        infinite where an open direction changes a quantity.
        """
        weights = _weights(dolp, double).reshape(-1, 9)
        variance, known, is_open, blind = (
            _quadratic(matrix, weights)
            for matrix in (self._covariance, self._known, self._open, self._blind)
        )
        # as for any quantity derived from the parameters, see `Covariance.propagate`
        limit = _STILL**2 * (known + is_open + blind)
        lost = blind > limit
        if not self._partial:
            lost &= known <= limit
        if not self._ignore:
            variance[lost | (is_open > limit)] = np.inf
        variance[~self._good] = np.nan
        with np.errstate(invalid="ignore", divide="ignore"):
            count = self._good.sum(axis=1)[:, None]
            rms = np.sqrt(np.nansum(variance, axis=1) / np.where(count, count, np.nan))
        return np.moveaxis(rms.reshape(len(rms), len(KEYS), -1), 0, 1)


def _products(rows):
    return rows @ np.swapaxes(rows, -1, -2)


def _quadratic(matrices, weights):
    """Return w M w for each of the weights, (n_wavelengths, n_settings, n_weights)."""
    return np.sum((matrices @ weights.T) * weights.T, axis=-2)


def _weights(dolp, double):
    """Return how q, u, degree and angle follow from the nine changes, (4, n_angles, 9)."""
    light = light_of(dolp, double).T
    # dQ = sum of M_Qc S_c, and of q = Q / I also what is found of I changes
    change = np.eye(3)[:, None, :, None] * light[None, :, None, :]
    dq, du = (change[i] - light[:, i, None, None] * change[0] for i in (1, 2))
    cosine, sine = np.cos(double)[:, None, None], np.sin(double)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.where(dolp > 0, (cosine * du - sine * dq) / np.float64(2 * dolp), np.nan)
    return np.stack([dq, du, cosine * dq + sine * du, turn]).reshape(4, len(light), 9)
