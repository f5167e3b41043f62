# Licensed under a 3-clause BSD style license - see LICENSE
"""Noise of the data as the residuals of a model tell it, and fluxes without it."""

import numpy as np

from astropolcal.exceptions import FitError
from astropolcal.gap._bases import orthonormal
from astropolcal.observations.quality import MAD_TO_SIGMA

# the share of the frames' freedom that harmonics may take from the measure of the noise
_MOST_TURNING = 0.7


def _by_state(waves, angles):
    """Return the waves, and for a modulator with two states those that change sign with them."""
    state = angles.get("flc_state", np.zeros(1))
    return (
        waves
        if np.ptp(state) == 0
        else [w for wave in waves for w in (wave, wave * (1 - 2 * state))]
    )


def settings(angles, n):
    """
    Return what optics could do to the sums: columns of the plate angle, (F, k).

    Not of the derotator angle alone, which changes as slowly as a lamp drifts.
    """
    if "hwp" not in angles:
        return np.zeros((n, 0))
    plate = angles["hwp"]
    waves = [np.exp(1j * k * plate) for k in (2, 4)]
    columns = list(waves)
    if "derotator" in angles:
        turn = np.exp(2j * angles["derotator"])
        columns += [wave * other for wave in waves for other in (turn, turn.conj())]
    # last, as the list is cut where frames are few: two columns each, at most a third of the
    # frames
    columns += [np.exp(1j * k * plate) for k in (1, 3, 6, 8)]
    columns = _by_state(columns, angles)[: n // 6]
    return np.stack([part(c) for c in columns for part in (np.real, np.imag)], axis=1).reshape(
        n, -1
    )


def noise(channel, residual, angles):
    """
    Return the noise of every datum: the stated errors, or more where the data say so.

    What optics that stand still or turn can do to a beam is a sum of a few
    harmonics of the stages' angles, sharp in wavelength or not; everything else
    is smooth in wavelength. So noise is what is left without either.
    """
    sigma = np.sqrt(channel.variance)
    basis = _turning(angles, channel.valid)
    for i in range(2):
        rough = _roughness(residual[i], channel.valid, basis)
        stated = np.isfinite(sigma[i]) & (sigma[i] > 0) & channel.valid
        if not stated.any():
            if not rough > 0:
                raise FitError("no errors in the table, and the residuals tell no noise")
            sigma[i] = rough
            continue
        if np.isfinite(rough):
            sigma[i] *= max(1.0, rough / _roughness_of(sigma[i], channel.valid))
        sigma[i] = np.where(stated, sigma[i], np.median(sigma[i][stated]))
    return sigma


def _turning(angles, valid):
    """Return an orthonormal basis of the harmonics of the stages, (F, k); k may be 0."""
    waves = [np.ones(valid.shape[1], dtype=complex)]
    for stage, orders in (("hwp", (2, 4)), ("derotator", (2, 4))):
        if stage in angles:
            turns = [np.exp(1j * k * angles[stage]) for k in orders]
            waves += [wave * t for wave in waves for turn in turns for t in (turn, turn.conj())]
    waves = _by_state(waves, angles)
    whole = _whole(valid)
    columns = np.concatenate([part(np.array(waves)) for part in (np.real, np.imag)]).T
    basis = orthonormal(columns * whole[:, None], keep=1e-6)
    # too few frames would be left to tell the noise
    return basis if basis.shape[1] <= _MOST_TURNING * whole.sum() else basis[:, :0]


def _whole(valid):
    """Return which frames have a datum at every wavelength, (F,)."""
    # a wavelength that is masked through the run, as in a band of water, makes no frame incomplete
    return valid[valid.any(axis=1)].all(axis=0)


def _roughness(residual, valid, basis):
    """Return the scatter of second differences along the wavelengths, per datum."""
    if len(residual) < 5:
        return np.nan
    whole = _whole(valid) if basis.shape[1] else np.ones(valid.shape[1], dtype=bool)
    left = np.where(whole, residual, 0.0)
    left = left - (left @ basis) @ basis.T
    # white noise of unit variance has second differences of variance 1 + 4 + 1
    second = (left[:-2] - 2 * left[1:-1] + left[2:]) / np.sqrt(6)
    # what stands still at a wavelength, as its brightness, is no noise
    second = second - np.median(second, axis=1, keepdims=True)
    keep = valid[:-2] & valid[1:-1] & valid[2:] & whole
    # projection takes the freedom of its columns from the scatter
    shrunk = np.sqrt(1 - basis.shape[1] / whole.sum())
    # a median, lest a few sharp features of the optics count as noise
    return float(MAD_TO_SIGMA * np.median(np.abs(second[keep])) / shrunk) if keep.any() else np.nan


def _roughness_of(sigma, valid):
    total = np.sqrt((sigma[:-2] ** 2 + 4 * sigma[1:-1] ** 2 + sigma[2:] ** 2) / 6)
    keep = valid[:-2] & valid[1:-1] & valid[2:]
    return float(np.median(total[keep]))


def expected_fluxes(channel, sweep):
    """
    Return the fluxes of both beams as chain and lamp give them, shape (2, W, F).

    An effect that depends on the flux must not depend on the noise of the datum
    that it is to explain.
    """
    right, left = sweep.fluxes
    level = channel.observed[1] - np.log(right + left)
    weight = channel.valid / np.square(channel.sigma[1])
    level = np.where(channel.valid, level, 0.0)
    scale = (level * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    certain = np.maximum(weight.sum(axis=0), 1e-300)
    shift = ((level - scale[:, None]) * weight).sum(axis=0) / certain
    shift = channel.lamp.brightness(shift, certain)
    lamp = np.exp(scale[:, None] + shift)
    return np.stack([right * lamp, left * lamp])
