# Licensed under a 3-clause BSD style license - see LICENSE
"""
The two channels in which a model is compared with every frame.

Double differences throw away what the optics downstream of the half-wave plate and the detector
leave in the data. Two numbers per frame and wavelength keep nearly all of it: the difference
normalized by the frame's own sum, which knows no lamp, and the logarithm of the sum, compared up to
the brightness of the lamp. The lamp is common to all wavelengths of a frame: its drift is a smooth
curve through the run and its flicker a random shift of all wavelengths of a frame together, so that
neither counts as a gap.

A single beam has the sum only, and of the lamp nothing is known but that the frames of a group
share its brightness, a number for each wavelength.
"""

from types import SimpleNamespace

import numpy as np

from astropolcal.calibration.identifiability.linearized import orthonormal
from astropolcal.calibration.noise.estimates import by_state, frame_noise

__all__ = []

_LARGEST_DEGREE = 6
_LARGEST_COLOR = 2
# the mean square of so many degrees beyond that of the drift is larger than that of all by this
# factor in one of forty lamps whose flicker is white, and in nearly all that wander
_SLOW, _WANDERS = 8, 2.0
# a flicker below this is not told to what depends on the flux
_LARGE_FLICKER = 0.1
# a single beam of fewer standard deviations than this is no datum
_FAINT = 5.0
# a model without any light, as behind crossed polarizers, has this flux, and no derivative
_DARK = 1e-30


class Channels:
    """Both channels of one dataset, whitened by their noise."""

    def __init__(self, dataset):
        obs = dataset.observations
        beams = SimpleNamespace(fluxes=(obs.flux_right.T, obs.flux_left.T))
        var_right, var_left, cov = obs.variance_right.T, obs.variance_left.T, obs.covariance.T
        with np.errstate(divide="ignore", invalid="ignore"):
            self.observed = self.predicted(beams)
            right, left = np.swapaxes(self.slopes(beams), 0, 1)
            self.variance = right**2 * var_right + left**2 * var_left + 2 * cov * right * left
        #: Index of the channel that tells the gap, and how many channels have data.
        self.told, self.count = (1, 1) if obs.single_beam else (0, 2)
        self.groups = obs.brightness_groups if obs.single_beam else None
        usable = ~obs.mask.T if obs.single_beam else dataset.valid
        lit = np.add(*beams.fluxes) > 0
        self.valid = usable & lit & np.isfinite(self.observed).all(axis=0)
        if obs.single_beam:
            # the logarithm of a flux within its noise is none; the differences are 1, and told
            self.valid &= ~(self.variance[1] > _FAINT**-2)
            self.variance[0] = 1.0
        self.observed = np.where(self.valid, self.observed, 0.0)
        #: What a residual counts in a gap: a logarithm of an intensity as its share of the mean of
        #: the group, lest frames that are nearly dark count most.
        self.level = np.ones(self.shape[1:])
        if obs.single_beam:
            flux = np.where(self.valid, np.exp(self.observed[1]), 0.0)
            mean = _GroupLamp(self.groups).mean(flux, self.valid * 1.0)
            self.level = flux / np.where(mean > 0, mean, 1.0)
        #: Whether the table states errors.
        self.stated = bool(np.any(np.isfinite(self.variance) & (self.variance > 0) & self.valid))
        self.sequence = obs.position("sequence")

    @property
    def shape(self):
        """Number of channels, wavelengths and frames."""
        return self.observed.shape

    # ---- the model ---------------------------------------------------------------------

    @staticmethod
    def predicted(sweep):
        """Return both channels of the fluxes of a forward sweep, (2, W, F)."""
        right, left = sweep.fluxes
        total = np.maximum(right + left, _DARK)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([(right - left) / total, np.log(total)])

    @staticmethod
    def slopes(sweep):
        """Return the derivative of each channel to the two fluxes."""
        right, left = sweep.fluxes
        total = right + left
        inverse = np.where(total > _DARK, 1 / np.maximum(total, _DARK), 0.0)
        # d[(R - L) / (R + L)] = 2 (L dR - R dL) / (R + L)^2,
        # d ln(R + L) = (dR + dL) / (R + L)
        return (2 * left * inverse**2, -2 * right * inverse**2), (inverse, inverse)

    # ---- noise and lamp -----------------------------------------------------------------

    def set_noise(self, sigma, residual, saturating, without=None):
        """Set the noise of both channels, (2, W, F), and fit the lamp, some frames (F,) aside.

        The sums of the residual, (2, W, F), tell how the lamp drifts and flickers. What optics
        could do to the sum of a frame, columns (F, k), is taken away first, lest a missing optic be
        taken for a restless lamp.
        """
        if self.groups is None:
            weight = np.where(
                self.valid & ~(np.array(False) if without is None else without), 1 / sigma[1], 0.0
            )
            self.lamp = _Lamp(residual[1], weight, self.sequence, saturating)
        else:
            self.lamp = _GroupLamp(self.groups)
        self.settle(sigma)

    def settle(self, sigma):
        """Note how data of some noise, (2, W, F), are whitened beside the lamp."""
        self.sigma, weight = sigma, np.where(self.valid, 1 / sigma, 0.0)
        if self.groups is not None:
            weight[0] = 0.0
        # the flicker makes the sums of a frame correlated: its inverse root is a rank-one change
        self._whitening = weight, self.lamp.shrink(weight[1])
        design = self.lamp.design(self.valid) * weight[1]
        self._calm(design)
        #: Orthonormal directions of the sums that the lamp takes up, (W * F, n).
        design = design.reshape(len(design), -1)
        if self.groups is None:
            self.nuisance = orthonormal(design.T)
        else:
            # no two groups have a datum in common
            norm = np.linalg.norm(design, axis=1, keepdims=True)
            self.nuisance = (design / np.where(norm > 0, norm, 1.0))[norm[:, 0] > 0].T

    def whiten(self, array, out=None):
        """Divide residuals or derivatives, (..., 2, W, F), by the noise and take the lamp out."""
        out = self.whiten_frames(array, out)
        sums = out[..., 1, :, :]
        flat = sums.reshape(*sums.shape[:-2], sums.shape[-2] * sums.shape[-1])
        sums -= (flat @ self.nuisance @ self.nuisance.T).reshape(sums.shape)
        return out

    def whiten_frames(self, array, out=None):
        """Divide by noise and flicker only, frame by frame: the lamp's drift stays; as `whiten`."""
        out = np.multiply(array, self._whitening[0], out=out)
        self._calm(out[..., 1, :, :])
        return out

    def gap(self, residual):
        """Return what of residuals (2, W, F) is a gap: differences, or intensities less their lamp.

        Those are shares of the mean of their group.
        """
        if self.groups is None:
            return residual[0]
        level, weight = residual[1], self.valid / np.square(self.sigma[1])
        return np.where(self.valid, level - self.lamp.mean(level, weight), 0.0) * self.level

    @property
    def noise(self):
        """Noise of what is a gap, (W, F)."""
        return self.sigma[self.told] * self.level

    def _calm(self, sums):
        """Take the flicker out of sums in units of their noise, (..., W, F), where they are."""
        direction, shrink = self._whitening[1]
        if shrink.any():
            common = np.einsum("...wf,wf->...f", sums, direction)
            sums -= direction * (shrink * common)[..., None, :]

    @property
    def n_nuisance(self):
        """Number of numbers that describe the lamp."""
        return self.nuisance.shape[1]

    @property
    def n_data(self):
        """Number of data, less the numbers that describe the lamp."""
        return self.count * int(self.valid.sum()) - self.n_nuisance


class _Lamp:
    """Brightness of the lamp: a scale per wavelength, a drift common to all, and flicker."""

    def __init__(self, residual, weight, sequence, saturating):
        centred = residual - _mean(residual, weight, axis=1)[:, None]
        common = _mean(centred, weight, axis=0)
        var = 1 / np.maximum((weight**2).sum(axis=0), 1e-300)
        seen = (weight > 0).any(axis=0)
        self.sequence = 2 * sequence - 1
        self.degree = _best_degree(self.sequence, common, seen, saturating)
        (square, rank), (fast, more) = (
            _left_over(np.concatenate([self._curve(k), saturating], axis=1)[seen], common[seen])
            for k in (self.degree, self.degree + _SLOW)
        )
        freedom = int(seen.sum()) - rank
        scatter = square / freedom if freedom > 0 else 0.0
        slow = (square - fast) / max(more - rank, 1)
        # a lamp that wanders is not white: what is slow, as causes are, must not exceed its noise
        scatter = slow if slow > _WANDERS * scatter else scatter
        #: Standard deviation of the flicker, in the logarithm of the flux.
        self.flicker = float(np.sqrt(max(scatter - np.mean(var[seen]), 0.0)))
        rest, scores, n = centred - common, [], (weight > 0).sum()
        for degree in range(_LARGEST_COLOR + 1):
            curve = self._curve(degree)
            fits = (
                _left_over(curve * w[:, None], r * w) for r, w in zip(rest, weight, strict=True)
            )
            freedom = len(weight) * (degree + 1)
            scores.append(sum(square for square, _ in fits) + freedom * np.log(max(n, 2)))
        #: Degree of a drift of its own for each wavelength, 0 for none.
        self.color = int(np.argmin(scores))

    def _curve(self, degree):
        return np.polynomial.legendre.legvander(self.sequence, degree)

    def shrink(self, weight):
        """Return, for each frame, the direction of the flicker and how much it is shrunk."""
        norm = np.sqrt((weight**2).sum(axis=0))
        direction = weight / np.where(norm > 0, norm, 1.0)
        # (1 + s^2 n n^T)^-1/2 = 1 - (1 - 1 / sqrt(1 + s^2)) n n^T for a unit vector n
        return direction, 1 - 1 / np.sqrt(1 + (self.flicker * norm) ** 2)

    def brightness(self, shift, weight):
        """
        Return the brightness of each frame, (F,), less what is but its noise.

        It is measured in the logarithm of the flux; the weight is one over its variance. Where the
        drift is large, the flicker about it is kept as far as it exceeds the noise.
        """
        curve, root = self._curve(self.degree), np.sqrt(weight)
        drift = curve @ np.linalg.lstsq(curve * root[:, None], shift * root, rcond=None)[0]
        if self.flicker < _LARGE_FLICKER:
            # what follows the flux would explain the very flicker that it is made of
            return drift
        # Wiener filter: a frame is believed by its share of flicker in flicker and noise
        signal = weight * self.flicker**2
        return drift + signal / (1 + signal) * (shift - drift)

    def design(self, valid):
        """Return the columns of the lamp, shape (k, W, F)."""
        curve = self._curve(max(self.degree, self.color)).T
        own = np.eye(len(valid))[:, None, :, None] * curve[: self.color + 1, None]
        common = np.ones((len(valid), 1)) * curve[self.color + 1 :, None]
        return np.concatenate([own.reshape(-1, *valid.shape), common]) * valid


class _GroupLamp(_Lamp):
    """Brightness of the frames of a single beam: one number for each group and wavelength."""

    flicker, degree, color = 0.0, 0, 0

    def __init__(self, groups):
        self.groups = groups
        # (F, n_groups)
        self.member = np.eye(groups.max() + 1)[groups]

    def summed(self, values):
        """Return the sum of (..., F) over the group of each frame."""
        return values @ self.member @ self.member.T

    def mean(self, values, weight):
        """Return the mean of (..., F) over the group of each frame."""
        total = self.summed(weight)
        return self.summed(values * weight) / np.where(total > 0, total, 1.0)

    # that of a frame is that of its group
    brightness = mean

    def design(self, valid):
        """Return the columns of the lamp, shape (k, W, F)."""
        own = np.eye(len(valid))[:, None, :, None] * self.member.T[None, :, None, :]
        return own.reshape(-1, *valid.shape) * valid


def _mean(values, weight, axis):
    norm = (weight**2).sum(axis=axis)
    return (values * weight**2).sum(axis=axis) / np.where(norm > 0, norm, 1.0)


def _left_over(columns, values):
    """Return the sum of squares that columns leave of values, and their rank."""
    solution, _, rank, _ = np.linalg.lstsq(columns, values, rcond=1e-9)
    return float(np.sum((values - columns @ solution) ** 2)), int(rank)


def _best_degree(sequence, values, seen, beside):
    """Return the degree of the drift, with other columns (F, k), by an information criterion.

    That of Schwarz (1978), corrected for the few data that the columns leave (McQuarrie 1999): in a
    dozen frames a curve that bends more leaves no flicker of any lamp.
    """
    scores, n = [], int(seen.sum())
    for degree in range(_LARGEST_DEGREE + 1):
        curve = np.polynomial.legendre.legvander(sequence, degree)
        square, rank = _left_over(curve[seen], values[seen])
        left = n - rank - beside.shape[1]
        # a curve through all frames would leave no flicker to be seen
        if left < 3:
            break
        scores.append(n * np.log(max(square / n, 1e-24)) + rank * np.log(n) * n / (left - 2))
    return int(np.argmin(scores)) if scores else 0


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
    columns = by_state(columns, angles)[: n // 6]
    return np.array([part(c) for c in columns for part in (np.real, np.imag)]).reshape(-1, n).T


def noise(channel, residual, angles, bins, without=None):
    """
    Return the noise of every datum, see `frame_noise`; of a single beam less its groups.

    That of frames ``without``, (F,), which tell none, follows from their stated errors.
    """
    valid = channel.valid if without is None else channel.valid & ~without
    seen = SimpleNamespace(variance=channel.variance, valid=valid)
    if channel.groups is None:
        sigma = frame_noise(seen, residual, angles, bins)
    else:
        lamp = _GroupLamp(channel.groups)
        level = residual[1] - lamp.mean(residual[1], valid * 1.0)
        seen.variance = channel.variance[1:]
        sigma = frame_noise(seen, np.where(valid, level, 0.0)[None], angles, bins)
        sigma = np.stack([np.ones_like(sigma[0]), sigma[0]])
    if without is None:
        return sigma
    for own, told in zip(sigma, np.sqrt(channel.variance), strict=True):
        stated = np.isfinite(told) & (told > 0) & channel.valid
        known, wanted = stated & valid, stated & without
        if known.any():
            own[wanted] = told[wanted] * np.median(own[known] / told[known])
    return sigma


def expected_fluxes(channel, sweep):
    """Return the fluxes of both beams as chain and lamp give them, without and with flicker.

    Both have shape (2, W, F). An effect that depends on the flux must not depend on the noise of
    the datum that it is to explain: sums of both beams do not see the flicker, which is their own,
    and their differences do.
    """
    right, left = sweep.fluxes
    level = channel.observed[1] - np.log(right + left)
    weight = channel.valid / np.square(channel.sigma[1])
    level = np.where(channel.valid, level, 0.0)
    scale = (level * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-300)
    certain = np.maximum(weight.sum(axis=0), 1e-300)
    shift = ((level - scale[:, None]) * weight).sum(axis=0) / certain
    beams = np.stack([right, left])
    shifts = channel.lamp.brightness(shift, certain), shift
    return tuple(beams * np.exp(scale[:, None] + one) for one in shifts)
