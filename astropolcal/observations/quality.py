# Licensed under a 3-clause BSD style license - see LICENSE
"""
Frames of a run that cannot be used, found from the table and masked with a reason.

Nothing is dropped: a masked frame stays in the table with its reason, and one warning
per reason says how many there are and which. Single cells are
judged while a table is read.
"""

import re
import warnings

import astropy.units as u
import numpy as np

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations.pointings import angle_or_zero
from astropolcal.units import angle_to_rad
from astropolcal.words import counted

__all__ = []

#: Derotator angles, radian, that differ by less belong to one run.
SAME_ANGLE = np.deg2rad(0.5)
# angles closer than this are one step, as for pairs
_PLATE_STEPS = np.deg2rad(0.3)
#: Median absolute deviation to standard deviation, for normal noise.
MAD_TO_SIGMA = 1.4826
_MOST_NAMED = 8


def is_star(source):
    """Return whether the source in the meta of a table is a star."""
    words = plain_source(source).split()
    return "star" in words or "sky" in words


def plain_source(source):
    """
    Return a source in lower case with single spaces.

    "star" for "standard star", of which nobody says how polarized it is.
    """
    words = re.sub(r"[\s_-]+", " ", (source or "").lower()).strip()
    return "star" if words == "standard star" else words


def clusters(values, gap=SAME_ANGLE):
    """Return the number of each value's cluster; clusters are more than ``gap`` apart."""
    order = np.argsort(values, kind="stable")
    number = np.empty(len(values), dtype=int)
    number[order] = np.concatenate([[0], np.cumsum(np.diff(values[order]) > gap)])
    return number


def runs_of_frames(count, number):
    """Return the run of each frame where frames, one after the other, fall in so many, (F,)."""
    return np.arange(count) * number // count


def derotator_runs(observations):
    """Return the number of the run of frames at one derotator angle of every frame, (F,)."""
    angle = angle_or_zero(observations, "derotator")
    return np.cumsum(np.abs(np.diff(angle, prepend=angle[:1])) > SAME_ANGLE)


# ---- cycles of the half-wave plate ---------------------------------------------------------------


def cycle_numbers(observations, start=None):
    """
    Return the number of the half-wave-plate cycle of every frame, from 0, (F,).

    That of the column ``cycle``; else a cycle ends where a plate angle (of one state of a
    modulator) comes again, the derotator moves, or ``start`` comes, the angle with which a cycle
    begins.
    """
    frames = observations.frames
    if "cycle" in frames.colnames:
        # numbers of cycles need not be consecutive
        return np.unique(np.asarray(frames["cycle"]), return_inverse=True)[1]
    plate = _step_of(angle_or_zero(observations, "hwp"))
    state = frames["flc_state"] if "flc_state" in frames.colnames else np.zeros(len(plate))
    moved = np.diff(derotator_runs(observations), prepend=0) > 0
    first = None if start is None else _step_of(angle_to_rad(start, "start"))
    cycle, number, seen = np.zeros(len(plate), dtype=int), 0, set()
    for i, key in enumerate(zip(plate.tolist(), np.asarray(state).tolist(), strict=True)):
        # with its first angle, unless nothing but that angle was seen: both states share it
        begins = key[0] == first and any(angle != first for angle, _ in seen)
        if i and (moved[i] or begins or key in seen):
            number, seen = number + 1, set()
        seen.add(key)
        cycle[i] = number
    return cycle


def _step_of(angle):
    """Return the number of the step at which a plate stands; 180 deg is 0 deg again."""
    step = np.rint(np.mod(angle, np.pi) / _PLATE_STEPS).astype(int)
    return step % round(np.pi / _PLATE_STEPS)


def mask_incomplete_cycles(observations, angles=(0, 45, 22.5, 67.5) * u.deg):
    """
    Mask the frames of cycles that lack an angle of the half-wave plate.

    They give q without u, or neither. A frame masked at all wavelengths counts as missing. Without
    a half-wave plate all frames stay.
    """
    if "hwp" not in observations.frames.colnames:
        return observations
    wanted = np.mod(np.atleast_1d(angle_to_rad(angles, "angles")), np.pi)
    plate, cycle = observations.position("hwp"), cycle_numbers(observations, wanted[0] * u.rad)
    lost = observations.mask.all(axis=1)
    # (frames, wanted angles)
    apart = np.abs(np.mod(plate[:, None] - wanted + np.pi / 2, np.pi) - np.pi / 2)
    there = (apart < _PLATE_STEPS) & ~lost[:, None]
    complete = np.array([there[cycle == c].any(axis=0).all() for c in range(cycle.max() + 1)])
    if not complete.any():
        shown = ", ".join(f"{angle:g}" for angle in np.rad2deg(wanted))
        raise ObservationError(
            f"{observations.name}: none of its {len(complete)} half-wave-plate cycles has all "
            f"of the angles {shown} deg"
        )
    return _masked(observations, ~complete[cycle] & ~lost, "incomplete half-wave-plate cycle")


# ---- detector and lamp ---------------------------------------------------------------------------


def mask_saturated(observations):
    """Mask the frames whose column ``saturated`` is true or above zero."""
    frames = observations.frames
    if "saturated" not in frames.colnames:
        return observations
    flag = np.asarray(getattr(frames["saturated"], "value", frames["saturated"]))
    if flag.dtype.kind not in "biuf":
        raise ObservationError(
            f"{observations.name}: column saturated has type {flag.dtype}; booleans or numbers "
            "are needed"
        )
    return _masked(observations, np.nan_to_num(flag.astype(float)) > 0, "saturated")


def brightness(observations):
    """
    Return how bright each frame is, (F,).

    The sum of the beams over its median frame, median over the wavelengths; NaN where all are
    masked.
    """
    total = np.where(observations.mask, np.nan, observations.flux_right + observations.flux_left)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames and bins without any cell
        # each bin by its own median, so that faint wavelengths count as bright ones do
        relative = total / np.nanmedian(total, axis=0)
        return np.nanmedian(relative, axis=1)


def mask_unstable_lamp(observations, *, limit=0.1, sigma=6.0):
    """
    Mask the frames of an internal source whose brightness leaves its slow drift.

    The drift is the parabola in the order of the frames with the least absolute deviations. A frame
    is unstable if ln(brightness) is off by more than ``limit`` and by more than ``sigma`` robust
    standard deviations. Where at least half of the frames at one derotator angle are, all frames of
    that angle are masked, as pairs are formed within it.
    """
    if not (limit > 0 and sigma > 0):
        raise ObservationError(f"limit = {limit}, sigma = {sigma}; both must be above zero")
    if observations.single_beam:
        # its flux follows the modulation, not only the lamp
        return observations
    # a lamp changes by factors
    logarithm = np.log(brightness(observations))
    degree = min(2, max(int(np.isfinite(logarithm).sum()) - 4, 0))
    drift = robust_curve(np.linspace(-1, 1, len(logarithm)), logarithm, degree)
    off = np.abs(logarithm - drift)
    spread = MAD_TO_SIGMA * np.nanmedian(off)
    # NaN, a frame masked already, is not far
    far = np.nan_to_num(off) > max(limit, sigma * spread)
    run = derotator_runs(observations)
    far |= (np.bincount(run, far) >= 0.5 * np.bincount(run))[run]
    return _masked(observations, far, "unstable lamp")


def robust_curve(x, values, degree):
    """
    Return at all x the polynomial of least absolute deviations, which a bad run does not bend.

    x runs from -1 to 1; values are NaN where there is none.
    """
    known = np.isfinite(values)
    curve = np.polynomial.legendre.legvander(x, degree)
    # the median is where the least deviations of a constant are
    solution = np.zeros(degree + 1)
    solution[0] = np.nanmedian(values)
    # iterated weights: squares over the last deviation are absolute values where they converge
    for _ in range(50):
        off = np.abs(values - curve @ solution)[known]
        weight = 1 / np.sqrt(np.maximum(off, 1e-3 * max(np.median(off), 1e-12)))
        rows = curve[known] * weight[:, None]
        solution = np.linalg.lstsq(rows, values[known] * weight, rcond=None)[0]
    return curve @ solution


def _masked(observations, frames, reason):
    """Mask whole frames with a reason, and say so; leave the rest untouched."""
    new = frames & ~observations.mask.all(axis=1)
    if not new.any():
        return observations
    result = observations.with_mask(np.asarray(new), reason)
    numbers = np.asarray(observations.frames["frame"])[new].tolist()
    more = f" and {len(numbers) - _MOST_NAMED} more" if len(numbers) > _MOST_NAMED else ""
    warnings.warn(
        f"{observations.name}: {len(numbers)} of {counted(observations.n_frames, 'frame')} masked, "
        f"{reason}: "
        f"frame {', '.join(map(str, numbers[:_MOST_NAMED]))}{more}",
        AstropolcalWarning,
        stacklevel=3,
    )
    return result
