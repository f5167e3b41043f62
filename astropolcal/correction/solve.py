# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Stokes parameters by weighted least squares over frames, where the frames determine them.

With rows :math:`A` and weights :math:`W`, the solution is :math:`\hat{\mathbf S} = G\,\mathbf d`
with :math:`G = (A^\mathsf{T} W A)^{-1} A^\mathsf{T} W`. It is found by singular values;
what belongs to values that are too small is reported, never divided by.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.calibration.system import inverse_rows
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.units import to_unit
from astropolcal.words import check_choice, counted

__all__ = []

#: What may be solved for; without V it is taken as zero.
COMPONENTS = ("IQU", "IQUV")

# ---- what is fitted: linear in the beams, so that a solution for channels is one for beams -------

#: What a solution may be made of: two channels of one or two frames, each by what it takes of both
#: beams of these, (2 channels, 2 beams, n frames).
CHANNELS = {
    "intensity": np.eye(2)[:, :, None],
    "single": np.array([[[1.0], [-1.0]], [[1.0], [1.0]]]),
    # (X+ - X-) / 2 and (I+ + I-) / 2, the half differences and sums of the paper
    "double": np.array([[[0.5, -0.5], [-0.5, 0.5]], [[0.5, 0.5], [0.5, 0.5]]]),
}


class Channels:
    """Linear combinations of the fluxes of both beams in all frames.

    ``intensity``: the fluxes; ``single``: difference and sum of each frame; ``double``: half the
    difference of differences and half the sum of sums of each pair, frames (n_pairs, 2).
    """

    def __init__(self, observable, n_frames, pairs=None):
        check_choice("observable", observable, CHANNELS, ParameterError)
        self.observable, self.n_frames = observable, n_frames
        #: Frames of which each pair of channels is made, (n_units, 1 or 2).
        self.units = np.arange(n_frames)[:, None]
        if observable == "double":
            self.units = np.asarray([] if pairs is None else pairs, dtype=int).reshape(-1, 2)
            if not len(self.units):
                raise ObservationError("double differences need pairs of frames, and there is none")
            first, last = self.units.min(), self.units.max()
            if first < 0 or last >= n_frames:
                raise ObservationError(
                    f"pairs name frames {first} to {last}; there are 0 to {n_frames - 1}"
                )

    def combine(self, fluxes, power=1):
        """Return channels, (2, n_units, ...), of fluxes of shape (2, n_frames, ...).

        With a ``power`` of two, of variances, without their correlations.
        """
        if self.observable == "intensity":
            return fluxes
        # c: channels, b: beams, u: units, k: frames of a unit
        shares = CHANNELS[self.observable] ** power
        return np.einsum("cbk,buk...->cu...", shares, fluxes[:, self.units])

    def to_beams(self, gain):
        """Return gains of beams, (..., 2, n_frames), from those of channels, (..., 2, n_units)."""
        spread = np.einsum("...cu,cbk->...buk", gain, CHANNELS[self.observable])
        found = np.zeros((*gain.shape[:-1], self.n_frames))
        # a frame may belong to several pairs
        np.add.at(found, (..., self.units), spread)
        return found


# ---- the solution --------------------------------------------------------------------------------

# a component whose share in a poorly determined direction is larger than this is not determined
_SHARE = 1e-3
# the worst combination has so much more noise than the best; good cycles have 1.5 to 3
_MAX_CONDITION = 30.0
_MAX_NAMED = 8


def covariance_index(n_components):
    """Return the pairs of components whose covariances are kept, in order: (0, 0), (0, 1), ..."""
    return list(combinations_with_replacement(range(n_components), 2))


@dataclass
class Estimator:
    """What turns the fluxes of all frames into Stokes parameters."""

    components: str
    # (n_wavelengths, n_components, 2, n_frames); NaN where a component is not determined
    gain: np.ndarray
    # with the brightness of the frames, (2, n_wavelengths, n_frames, 4)
    rows: np.ndarray
    channels: Channels
    # of fluxes over brightness, (2, n_wavelengths, n_units, 4) and (2, n_wavelengths, n_units)
    channel_rows: np.ndarray
    weights: np.ndarray
    # largest over smallest singular value for each wavelength, of all components asked for
    condition: np.ndarray
    # both (n_wavelengths, n_components); what each takes from a V that is taken as zero
    determined: np.ndarray
    leakage: np.ndarray
    # the poorly determined combinations in words, one per wavelength; else ""
    weak: list
    # of the frames, (n_wavelengths, n_frames)
    scale: np.ndarray
    # what else `estimator` was called with
    settings: dict

    def apply(self, fluxes):
        """Return Stokes parameters, (n_components, n_wavelengths, ...), of fluxes.

        These have shape (2, n_frames, n_wavelengths, ...), the right beam first.
        """
        return np.einsum("wkbf,bfw...->kw...", self.gain, np.asarray(fluxes, dtype=float))


def estimator(
    rows,
    *,
    components="IQU",
    observable="intensity",
    pairs=None,
    weights=None,
    scale=None,
    max_condition=_MAX_CONDITION,
    labels=None,
):
    """Solve for what turns fluxes into Stokes parameters, wavelength by wavelength.

    ``rows`` are those of `measurement_rows`, (2, n_wavelengths, n_frames, 4). Without V in
    ``components`` it is taken as zero, and so where it cannot be determined. ``observable`` and
    ``pairs`` as for `Channels`; ``weights`` are inverse variances of the fluxes, (n_frames,),
    (n_wavelengths, n_frames) or (2, n_wavelengths, n_frames); ``scale`` the brightness of the
    frames, (n_frames,) or (n_wavelengths, n_frames). A combination is poorly determined if its
    singular value is smaller than the largest by more than ``max_condition``.
    """
    settings = {"components": components, "observable": observable, "pairs": pairs}
    settings |= {"weights": weights, "max_condition": max_condition}
    rows = np.asarray(rows, dtype=float)
    check_choice("components", components, COMPONENTS, ParameterError)
    if np.ndim(max_condition) or not to_unit(max_condition, None, "max_condition") > 1:
        raise ParameterError(f"max_condition = {max_condition}; it must be one number above 1")
    shape = rows.shape[1:3]
    channels = Channels(observable, shape[1], pairs)
    weights = 1.0 if weights is None else _positive("weights", weights, shape, beams=True)
    weights = np.broadcast_to(weights, (2, *shape))
    scale = np.ones(shape) if scale is None else _positive("scale", scale, shape)
    # fluxes are divided by the brightness of their frame: an unequal gain cancels in pairs
    combined = np.moveaxis(channels.combine(np.moveaxis(rows, 1, 2)), 2, 1)
    with np.errstate(divide="ignore"):
        # a weight of zero is an infinite variance, and stays a weight of zero in its pair
        variances = np.moveaxis(1 / (weights * scale**2), 1, 2)
        inverse = np.moveaxis(1 / channels.combine(variances, 2), 2, 1)
    solved = [
        _solve(combined[:, w].reshape(-1, 4), inverse[:, w].ravel(), components, max_condition)
        for w in range(shape[0])
    ]
    gain, condition, determined, weak = map(np.array, zip(*solved, strict=True))
    gain = channels.to_beams(gain.reshape(shape[0], len(components), 2, -1))
    gain, rows = gain / scale[:, None, None], rows * scale[..., None]
    if not determined[:, 1:3].all(axis=1).any():
        raise ObservationError(_undetermined(channels, labels, weak[0]))
    leakage = np.einsum("wkbf,bwf->wk", gain, rows[..., 3])
    if "V" in components:
        # where V was solved for, nothing leaks; where it was given up, it does as without it
        leakage[determined[:, 3]] = 0.0
    found = condition, determined, leakage, weak.tolist()
    return Estimator(components, gain, rows, channels, combined, inverse, *found, scale, settings)


def _solve(rows, weights, components, max_condition):
    """Return gain, condition, what is determined, and in words what is not."""
    n = len(components)
    gain, values, right, good = inverse_rows(rows[:, :n], weights, max_condition)
    condition, weak = values[0] / values[-1] if values[-1] > 0 else np.inf, right[~good]
    determined = _determined(weak)
    if len(weak) and n == 4 and not determined[3]:
        # V is what most often is open: the others are solved as without it
        gain = np.zeros((n, len(rows)))
        gain[:3], _, right, good = inverse_rows(rows[:, :3], weights, max_condition)
        determined = np.append(_determined(right[~good]), False)
    gain[~determined] = np.nan
    return gain, condition, determined, _in_words(weak, components)


def _determined(weak):
    # a component that leans on an open direction is open itself
    return np.abs(weak).max(axis=0, initial=0.0) < _SHARE


def _in_words(weak, components):
    """Return the same directions in words, in each of which another component leads."""
    # singular vectors of equal values are any basis, and each has any sign: their projector is one
    projector, words = weak.T @ weak, []
    for _ in weak:
        lead = ranked(np.diag(projector))[0]
        direction = projector[lead] / np.sqrt(projector[lead, lead])
        projector = projector - np.outer(direction, direction)
        named = zip(components, direction, strict=True)
        parts = [f"{value:+.2f} {name}" for name, value in named if abs(value) >= 0.005]
        words.append(" ".join(parts).removeprefix("+"))
    return "; ".join(words)


def _positive(name, value, shape, beams=False):
    # only ratios matter, in whatever unit
    value = to_unit(value, getattr(value, "unit", None), name)
    allowed = [shape[1:], shape] + ([(2, *shape)] if beams else [])
    if value.shape not in allowed:
        raise ParameterError(f"{name} has shape {value.shape}; allowed are {allowed}")
    # a weight of zero leaves a flux out; a frame without light says nothing
    if not np.all(np.isfinite(value)) or value.min() < 0 or (not beams and value.min() == 0):
        raise ParameterError(
            f"{name} = {value.min():g} must be finite and {'not negative' if beams else 'positive'}"
        )
    return np.broadcast_to(value, shape if value.ndim < 3 else value.shape)


def _undetermined(channels, labels, weak):
    """Return in words that the frames do not determine Q and U."""
    count = channels.n_frames
    words = counted(count, "frame")
    if labels is not None:
        shown = ", ".join(map(str, list(labels)[:_MAX_NAMED]))
        words += f" ({shown}{', ...' if count > _MAX_NAMED else ''})"
    if channels.observable == "double":
        words += f" in {len(channels.units)} pairs (observable='intensity' needs none)"
    return (
        f"Q and U are not determined at any wavelength by {words}: poorly determined is {weak}; "
        "frames at half-wave-plate angles such as 0, 22.5, 45 and 67.5 deg are needed"
    )


# ---- brightness of the frames: clouds, seeing, exposure times ------------------------------------

# a step shrinks the error by the instrumental polarization, some percent: ten suffice mostly
_STEPS, _SETTLED = 50, 1e-13


def frame_brightness(rows, fluxes, groups=None, **settings):
    """Return the relative brightness of frames, (n_wavelengths, n_frames), of mean one.

    ``fluxes`` are those of the whole image of each beam, (2, n_frames, n_wavelengths), NaN where
    there is none, which gives one; the settings are those of `estimator`. The sum of both beams
    follows the light that enters, but also, by a little, its polarization: brightness and Stokes
    parameters are found in turn until they settle. Frames of one of the ``groups``, (n_frames,),
    share their brightness.
    """
    fluxes = np.asarray(fluxes, dtype=float)
    member = np.eye(fluxes.shape[1])
    if groups is not None:
        kinds = np.unique(groups, return_inverse=True)[1]
        member = np.equal.outer(kinds, kinds).astype(float)
    # shape (n_wavelengths, n_frames), as the scale of an estimator
    totals = fluxes.sum(axis=0).T
    missing = np.isnan(totals)
    totals = np.where(missing, np.nan, np.nan_to_num(totals) @ member)
    dark = ~(totals > 0) & ~missing
    if dark.any():
        wavelength, frame = np.argwhere(dark)[0]
        raise ObservationError(
            f"frame {frame} has no light at wavelength {wavelength}: the sum of both beams is "
            f"{totals[wavelength, frame]:.4g}"
        )
    if missing.any():
        weights = settings.get("weights")
        weights = 1.0 if weights is None else np.asarray(weights, dtype=float)
        settings["weights"] = np.broadcast_to(weights, (2, *totals.shape)) * ~missing
        fluxes = np.nan_to_num(fluxes)
    # at a wavelength where not even I is determined, the sums have the last word
    unknown = ~estimator(rows, **settings).determined[:, 0]
    scale = _shared(totals, missing)
    for _ in range(_STEPS):
        stokes = estimator(rows, scale=scale, **settings).apply(fluxes)
        # the light of an undetermined component is not known, and small
        expected = np.einsum("bwfs,sw->wf", rows[..., : len(stokes)], np.nan_to_num(stokes))
        expected = np.where(missing, 0.0, expected) @ member
        expected[unknown] = 1.0
        if not np.all(expected[~missing] > 0):
            break
        new = _shared(totals / expected, missing)
        change, scale = np.abs(new - scale).max(), new
        if change < _SETTLED:
            return scale
    raise ObservationError(
        "the brightness of the frames does not settle: there is too little light, or it is not "
        "that of one source in all frames"
    )


def _shared(brightness, missing):
    """Return brightness over its mean: only ratios are measured, the mean is the source's."""
    known = np.where(missing, 0.0, brightness)
    mean = known.sum(axis=1, keepdims=True) / np.maximum((~missing).sum(axis=1, keepdims=True), 1)
    return np.where(missing | (mean == 0), 1.0, known / np.where(mean == 0, 1.0, mean))
