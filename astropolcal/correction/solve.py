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
from astropolcal.words import check_choice

__all__ = []

#: What may be solved for; without V it is taken as zero.
COMPONENTS = ("IQU", "IQUV")

# ---- what is fitted: linear in the beams, so that a solution for channels is one for beams -------

#: What a solution may be made of.
CHANNELS = ("intensity", "single", "double")


class Channels:
    """
    Linear combinations of the fluxes of both beams in all frames.

    ``intensity``: the fluxes; ``single``: difference and sum of each frame; ``double``: half the
    difference of differences and half the sum of sums of each pair, frames (n_pairs, 2).
    """

    def __init__(self, observable, n_frames, pairs=None):
        check_choice("observable", observable, CHANNELS, ParameterError)
        self.observable, self.n_frames = observable, n_frames
        self.pairs = None
        if observable == "double":
            self.pairs = _checked(pairs, n_frames)

    @property
    def units(self):
        """Frames of which each pair of channels is made, a list of tuples."""
        if self.pairs is None:
            return [(frame,) for frame in range(self.n_frames)]
        return [tuple(pair) for pair in self.pairs.tolist()]

    def combine(self, fluxes):
        """Return channels of fluxes of shape (2, n_frames, ...): shape (2, n_units, ...)."""
        if self.observable == "intensity":
            return fluxes
        both = np.stack([fluxes[0] - fluxes[1], fluxes[0] + fluxes[1]])
        if self.pairs is None:
            return both
        plus, minus = both[:, self.pairs[:, 0]], both[:, self.pairs[:, 1]]
        # (X+ - X-) / 2 and (I+ + I-) / 2, the half differences and sums of the paper
        return np.stack([plus[0] - minus[0], plus[1] + minus[1]]) / 2

    def one(self, fluxes, variance=False):
        """Return the channels, or their variances, of one unit from its frames, (2, k, ...)."""
        alone = Channels(self.observable, fluxes.shape[1], [(0, 1)])
        return (alone.variances if variance else alone.combine)(fluxes)[:, 0]

    def variances(self, variances):
        """Return variances of channels, without their correlations; shapes as in `combine`."""
        if self.observable == "intensity":
            return variances
        # var(r - l) = var(r + l) = var(r) + var(l); halving the pair divides it by four
        total = variances.sum(axis=0)
        if self.pairs is not None:
            total = (total[self.pairs[:, 0]] + total[self.pairs[:, 1]]) / 4
        return np.stack([total, total])

    def to_beams(self, gain):
        """
        Return gains of the beams, (..., 2, n_frames), from those of channels, (..., 2, n_units).
        """
        if self.observable == "intensity":
            return gain
        difference, total = gain[..., 0, :], gain[..., 1, :]
        if self.pairs is not None:
            shape = (*difference.shape[:-1], self.n_frames)
            spread = np.zeros((2, *shape))
            for side, sign in ((0, 1.0), (1, -1.0)):
                # a frame may belong to several pairs
                np.add.at(spread[0], (..., self.pairs[:, side]), sign * difference / 2)
                np.add.at(spread[1], (..., self.pairs[:, side]), total / 2)
            difference, total = spread
        # of right - left and right + left: both gains act on each beam, the first with its sign
        return np.stack([total + difference, total - difference], axis=-2)


def _checked(pairs, n_frames):
    pairs = np.asarray([] if pairs is None else pairs, dtype=int).reshape(-1, 2)
    if not len(pairs):
        raise ObservationError("double differences need pairs of frames, and there is none")
    if pairs.min() < 0 or pairs.max() >= n_frames:
        raise ObservationError(
            f"pairs name frames {pairs.min()} to {pairs.max()}; there are 0 to {n_frames - 1}"
        )
    return pairs


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
    # (2, n_wavelengths, n_units, 4) and (2, n_wavelengths, n_units)
    channel_rows: np.ndarray
    weights: np.ndarray
    # largest over smallest singular value for each wavelength, of all components asked for
    condition: np.ndarray
    # both (n_wavelengths, n_components); what each takes from a V that is taken as zero
    determined: np.ndarray
    leakage: np.ndarray
    # the poorly determined combinations in words, one per wavelength; else ""
    weak: list
    max_condition: float = _MAX_CONDITION
    # of the frames, (n_wavelengths, n_frames), and of the fluxes, (2, n_wavelengths, n_frames)
    scale: np.ndarray | None = None
    beam_weights: np.ndarray | None = None

    def apply(self, fluxes):
        """
        Return Stokes parameters, (n_components, n_wavelengths, ...), of fluxes.

        These have shape (2, n_frames, n_wavelengths, ...), the right beam first.
        """
        return np.einsum("wkbf,bfw...->kw...", self.gain, np.asarray(fluxes, dtype=float))

    def flags(self):
        """Return what is poorly determined, in words, by the index of the wavelength."""
        return {i: words for i, words in enumerate(self.weak) if words}


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
    """
    Solve for what turns fluxes into Stokes parameters, wavelength by wavelength.

    ``rows`` are those of `measurement_rows`, (2, n_wavelengths, n_frames, 4). Without V in
    ``components`` it is taken as zero, and so where it cannot be determined. ``observable`` and
    ``pairs`` as for `Channels`; ``weights`` are inverse variances of the fluxes, (n_frames,),
    (n_wavelengths, n_frames) or (2, n_wavelengths, n_frames); ``scale`` the brightness of the
    frames, (n_frames,) or (n_wavelengths, n_frames). A combination is poorly determined if its
    singular value is smaller than the largest by more than ``max_condition``.
    """
    # rows are (2 beams, n_wavelengths, n_frames, 4)
    rows = np.asarray(rows, dtype=float)
    check_choice("components", components, COMPONENTS, ParameterError)
    if not max_condition > 1:
        raise ParameterError(f"max_condition = {max_condition}; it must be above 1")
    shape = rows.shape[1:3]
    channels = Channels(observable, shape[1], pairs)
    if weights is None:
        weights = np.ones((2, *shape))
    else:
        weights = np.broadcast_to(_positive("weights", weights, shape, beams=True), (2, *shape))
    if scale is not None:
        scale = _positive("scale", scale, shape)
        rows = rows * scale[None, :, :, None]
    combined = channels.combine(np.moveaxis(rows, 1, 2))
    combined = np.moveaxis(combined, 2, 1)
    with np.errstate(divide="ignore"):
        # a weight of zero is an infinite variance, and stays a weight of zero in its pair
        variances = channels.variances(np.moveaxis(1 / weights, 1, 2))
        inverse = np.moveaxis(1 / variances, 2, 1)
    solved = [
        _solve(combined[:, w].reshape(-1, 4), inverse[:, w].ravel(), components, max_condition)
        for w in range(shape[0])
    ]
    gains, condition, determined, weak = zip(*solved, strict=True)
    gain = np.stack(gains).reshape(shape[0], len(components), 2, -1)
    gain = channels.to_beams(gain)
    found = Estimator(
        components,
        gain,
        rows,
        channels,
        combined,
        inverse,
        np.array(condition),
        np.array(determined),
        _leakage(gain, rows, components),
        list(weak),
        max_condition,
        scale,
        weights,
    )
    _refuse_undetermined(found, labels)
    return found


def _solve(rows, weights, components, max_condition):
    """Return gain, condition, what is determined, and in words what is not."""
    n = len(components)
    gain, values, right, good = inverse_rows(rows[:, :n], weights, max_condition)
    condition, weak = values[0] / values[-1] if values[-1] > 0 else np.inf, right[~good]
    words = "; ".join(_in_words(direction, components) for direction in _led(weak))
    determined = _determined(weak, n)
    if len(weak) and n == 4 and not determined[3]:
        # V is what most often is open: the others are solved as without it
        gain = np.zeros((n, len(rows)))
        gain[:3], _, right, good = inverse_rows(rows[:, :3], weights, max_condition)
        determined = np.append(_determined(right[~good], 3), False)
    gain[~determined] = np.nan
    return gain, condition, determined, words


def _determined(weak, n):
    # a component that leans on an open direction is open itself
    return np.abs(weak).max(axis=0, initial=0.0) < _SHARE if len(weak) else np.ones(n, dtype=bool)


def _led(weak):
    """Return a basis of the same directions in which one component after the other leads."""
    # singular vectors of equal values are any basis, and each has any sign: their projector is one
    projector, basis = weak.T @ weak, []
    for _ in weak:
        lead = ranked(np.diag(projector))[0]
        basis.append(projector[lead] / np.sqrt(projector[lead, lead]))
        projector = projector - np.outer(basis[-1], basis[-1])
    return basis


def _in_words(direction, components):
    parts = [
        f"{value:+.2f} {name}"
        for name, value in zip(components, direction, strict=True)
        if abs(value) >= 0.005
    ]
    return " ".join(parts).removeprefix("+")


def _leakage(gain, rows, components):
    if "V" in components:
        leakage = np.zeros(gain.shape[:2])
        # where V was solved for, nothing leaks; where it was given up, it does as without it
        assumed = np.isnan(gain).any(axis=(2, 3))[:, 3]
        leakage[assumed] = np.einsum("wkbf,bwf->wk", gain, rows[..., 3])[assumed]
        return leakage
    return np.einsum("wkbf,bwf->wk", gain, rows[..., 3])


def _positive(name, value, shape, beams=False):
    value = np.asarray(value, dtype=float)
    allowed = [shape[1:], shape] + ([(2, *shape)] if beams else [])
    if value.shape not in allowed:
        raise ParameterError(f"{name} has shape {value.shape}; allowed are {allowed}")
    # a weight of zero leaves a flux out; a frame without light says nothing
    if not np.all(np.isfinite(value)) or value.min() < 0 or (not beams and value.min() == 0):
        raise ParameterError(
            f"{name} = {value.min():g} must be finite and {'not negative' if beams else 'positive'}"
        )
    return np.broadcast_to(value, shape if value.ndim < 3 else value.shape)


def _refuse_undetermined(found, labels):
    linear = found.determined[:, 1:3]
    if linear.all(axis=1).any():
        return
    count = found.rows.shape[2]
    words = f"{count} frame{'s' if count > 1 else ''}"
    if labels is not None:
        shown = ", ".join(map(str, list(labels)[:_MAX_NAMED]))
        words += f" ({shown}{', ...' if count > _MAX_NAMED else ''})"
    if found.channels.pairs is not None:
        words += f" in {len(found.channels.pairs)} pairs"
    raise ObservationError(
        f"Q and U are not determined at any wavelength by {words}: poorly determined is "
        f"{found.weak[0]}; frames at half-wave-plate angles such as 0, 22.5, 45 and 67.5 deg are "
        "needed"
    )


# ---- brightness of the frames: clouds, seeing, exposure times ------------------------------------

# a step shrinks the error by the instrumental polarization, some percent: ten suffice mostly
_STEPS, _SETTLED = 50, 1e-13


def frame_brightness(rows, fluxes, groups=None, **settings):
    """
    Return the relative brightness of frames, (n_wavelengths, n_frames), of mean one.

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
