# Licensed under a 3-clause BSD style license - see LICENSE
"""Which frames of a run belong together: copies, other modes, angles that do not fit."""

import re
from collections import Counter

import numpy as np

from astropolcal.exceptions import ObservationError
from astropolcal.reduction.headers import check_sequence

# what all frames of a run must have in common
_KINDS = {"internal": ("filter", "pickoff", "light"), "star": ("filter", "pickoff", "object")}


def set_aside(frames, reduction):
    """Leave out what cannot be used, copies, and frames of another kind than most."""
    kept = []
    seen = {}
    for frame in frames:
        if not frame.usable:
            reduction.problems[frame.path] = frame.errors
            continue
        # a copy under another name has the same fluxes to the last bit
        keys = [f"data {frame.digest}"]
        keys += [f"number {frame.number}"] if frame.number is not None else []
        first = next((seen[key] for key in keys if key in seen), None)
        if first is not None:
            same = "the same data as" if f"data {frame.digest}" in seen else "the same frame as"
            name = first.path if first.name == frame.name else first.name
            reduction.problems[frame.path] = [f"{same} {name}"]
            continue
        seen.update(dict.fromkeys(keys, frame))
        kept.append(frame)
    # before the rest: fluxes in other units cannot be compared at all
    kept = _of_one_kind(kept, "unit", lambda frame: frame.unit, reduction)
    for name in _KINDS[reduction.source]:
        kept = _of_one_kind(kept, name, lambda frame, name=name: frame.values.get(name), reduction)
    return sorted(kept, key=_order)


def _of_one_kind(frames, what, value, reduction):
    """Leave out frames that differ from most in what a run has in common."""
    kinds = [None if value(frame) is None else _plain(value(frame)) for frame in frames]
    counts = Counter(kind for kind in kinds if kind is not None)
    if len(counts) < 2:
        return frames
    # whose frames are fewer is the intruder, even if it came first
    usual = counts.most_common(1)[0][0]
    words = value(frames[kinds.index(usual)])
    kept = []
    for frame, kind in zip(frames, kinds, strict=True):
        # a header that says nothing contradicts nothing
        if kind in (usual, None):
            kept.append(frame)
            continue
        reduction.problems[frame.path] = [
            f"{what} {value(frame)!r}, the others of the run have {words!r}"
        ]
    return kept


def _plain(text):
    """Return a name without what is written now so, now so: case, blanks, signs."""
    # but BD+12 and BD-12 are two stars
    return re.sub(r"[^\w+-]|_", "", text).casefold()


def _order(frame):
    """Order by frame number; what has none comes last, by time and name."""
    if frame.number is not None:
        return (0, frame.number, frame.name)
    return (1, frame.values.get("mjd", np.inf), frame.name)


def replace_angles(frames, sequence):
    if sequence is None:
        return
    sequence = [float(angle) for angle in sequence]
    if not sequence or len(frames) % len(sequence):
        raise ObservationError(
            f"{len(frames)} frames cannot be cut into sequences of {len(sequence)} angles; "
            "frames are missing, and it is unclear which"
        )
    for i, frame in enumerate(frames):
        stated, frame.values["hwp"] = frame.values["hwp"], sequence[i % len(sequence)]
        # degree; what a header rounds
        if abs(stated - frame.values["hwp"]) > 1e-3:
            frame.doubts.append(
                f"half-wave plate at {stated:g} deg in the header, replaced by "
                f"{frame.values['hwp']:g} deg"
            )


def consistent(frames, reduction, layout, check):
    """Leave out frames whose commanded angle does not fit the sequence of the run."""
    if not check or not frames:
        return frames
    angles = ([frame.values[name] for frame in frames] for name in ("hwp", "derotator"))
    wrong = check_sequence(*angles, layout)
    for i, why in wrong.items():
        reduction.problems[frames[i].path] = [why]
    return [frame for i, frame in enumerate(frames) if i not in wrong]


def without_repeats(frames, reduction):
    """Leave out frames at 90 deg from another one, which measure the same again."""
    kept = []
    for frame in frames:
        twin = next((other for other in kept if _repeats(frame, other)), None)
        if twin is None:
            kept.append(frame)
        else:
            reduction.problems[frame.path] = [
                f"half-wave plate at {frame.values['hwp']:g} deg repeats that of {twin.name}"
            ]
    return kept


def _repeats(frame, other):
    hwp, derotator = (frame.values[k] - other.values[k] for k in ("hwp", "derotator"))
    # a half-wave plate at 90 deg has the Mueller matrix of one at 0
    return abs(abs(hwp) - 90.0) < 0.3 and abs(derotator) < 0.5
