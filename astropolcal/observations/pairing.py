# Licensed under a 3-clause BSD style license - see LICENSE
"""
Pairs of frames whose half-wave plates stand 45 degrees apart, or whose modulators differ, or both.

Pairs are found from the angles, never from the order of the rows: the angles
must differ by 45 degrees modulo 180, the derotator must be static and the
modulator must be in the same state. Among the candidates the nearest in time wins.
"""

import warnings

import astropy.units as u
import numpy as np

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations.pointings import angle_or_zero, clock
from astropolcal.units import angle_to_rad
from astropolcal.words import counted

__all__ = []

#: By what frames may be paired: the half-wave plate, or the state of a modulator.
PAIRINGS = ("hwp", "flc_state")

# a half-wave plate at 45 deg exchanges +Q and -Q, and at 180 deg is the same again
_QUARTER, _HALF, _TURN = np.deg2rad([45.0, 90.0, 180.0])
# a message of a thousand numbers helps nobody
_MAX_NAMED = 10
# tables up to this length are searched as a whole, longer ones within so many frames first
_SMALL, _WINDOW = 1000, 64


def pair_frames(
    hwp,
    derotator=None,
    flc_state=None,
    time=None,
    *,
    tolerance=0.3 * u.deg,
    derotator_tolerance=0.5 * u.deg,
    share=False,
    labels=None,
    rows=None,
    name="table",
):
    """
    Pair the frames whose half-wave-plate angles differ by 45 deg; return indices (P, 2).

    All arguments are one per frame, angles as quantities; frames of a pair agree in derotator and
    state. The plus frame, whose angle modulo 90 deg lies in [0, 45), comes first; the nearest in
    time (else in the table) wins. ``share`` lets a frame left over use one that is used already;
    ``labels``, ``rows`` and ``name`` are for messages. An angle without any partner in the table is
    an error, frames left over a warning.
    """
    hwp = np.atleast_1d(angle_to_rad(hwp, "hwp"))
    tolerance = float(angle_to_rad(tolerance, "tolerance"))
    derotator_tolerance = float(angle_to_rad(derotator_tolerance, "derotator_tolerance"))
    labels = range(len(hwp)) if labels is None else labels
    _check_partners(hwp, tolerance, rows, name)
    steps = np.arange(len(hwp)) if time is None else np.asarray(time, dtype=float)
    setting = _Setting(hwp, derotator, flc_state, steps, tolerance, derotator_tolerance)
    pairs, left = _paired(setting, share)
    if left:
        shown = ", ".join(
            f"{labels[frame]} (hwp {np.rad2deg(hwp[frame]):g} deg)" for frame in left[:_MAX_NAMED]
        )
        more = f" and {len(left) - _MAX_NAMED} more" if len(left) > _MAX_NAMED else ""
        warnings.warn(
            f"{name}: {len(left)} of {len(hwp)} frames left out, their partner 45 deg of half-wave "
            f"plate away is missing or used: frame {shown}{more}",
            AstropolcalWarning,
            stacklevel=3,
        )
    return pairs


def pair_states(
    state,
    hwp,
    derotator,
    time=None,
    *,
    tolerance=0.3 * u.deg,
    derotator_tolerance=0.5 * u.deg,
    share=False,
    rows=None,
    name="table",
):
    """
    Pair frames of both states (0, 1) of a modulator at the same angles, modulo 180 deg.

    Returns indices (P, 2), state 0 first; the nearest in time wins. Arguments as for `pair_frames`.
    A frame without any partner is an error, one whose partner is used a warning.
    """
    state = np.asarray(state)
    angles = [np.atleast_1d(angle_to_rad(x, "angle")) for x in (hwp, derotator)]
    limits = [float(angle_to_rad(x, "tolerance")) for x in (tolerance, derotator_tolerance)]
    steps = np.arange(len(state)) if time is None else np.asarray(time, dtype=float)
    first, second = np.flatnonzero(state == 0), np.flatnonzero(state == 1)
    alike = np.ones((first.size, second.size), dtype=bool)
    for angle, limit in zip(angles, limits, strict=True):
        # (frames in state 0, frames in state 1)
        alike &= _apart(angle[first][:, None], angle[second]) <= limit
    # of no partner at all, not only of none that is free: that is a table with a hole
    lonely = [*first[~alike.any(axis=1)], *second[~alike.any(axis=0)]]
    if lonely:
        _refuse_lonely(min(lonely), state, angles, rows, name)
    i, j = (frames[k] for frames, k in zip((first, second), np.nonzero(alike), strict=True))
    # the last key counts most: nearest in time, then in the file, then the earliest
    order = np.lexsort((np.minimum(i, j), np.abs(i - j), np.abs(steps[i] - steps[j])))
    chosen, used = _choose(i[order], j[order], len(state), share)
    if not used.all():
        warnings.warn(
            f"{name}: {np.sum(~used)} of {len(state)} frames left out, their partner in the other "
            "state of the modulator is used",
            AstropolcalWarning,
            stacklevel=2,
        )
    return np.array(sorted(chosen), dtype=np.intp).reshape(-1, 2)


def quadruples(
    states, hwp, derotator, time=None, *, labels=None, rows=None, name="table", **limits
):
    """
    Combine pairs of states, (P, 2), whose half-wave plates stand 45 deg apart.

    Returns indices (Q, 4): both states of the plus angle, both of the minus angle. Arguments as for
    `pair_frames`, one per frame.
    """
    # both frames of a pair stand at the same angles, so that one speaks for both
    first = np.asarray(states)[:, 0]
    found = pair_frames(
        hwp[first],
        derotator[first],
        time=first if time is None else np.asarray(time)[first],
        labels=first.tolist() if labels is None else [labels[i] for i in first],
        rows=None if rows is None else [rows[i] for i in first],
        name=name,
        **limits,
    )
    # (Q, 2, 2): plus and minus, then states; flat it is A+, B+, A-, B-
    return np.asarray(states)[found].reshape(-1, 4)


def _refuse_lonely(frame, state, angles, rows, name):
    where = f"frame index {frame}" if rows is None else f"row {rows[frame]}"
    own, other = ("A", "B") if state[frame] == 0 else ("B", "A")
    hwp, derotator = (np.rad2deg(angle[frame]) for angle in angles)
    raise ObservationError(
        f"{name}, {where}: flc_state {own} at hwp = {hwp:g} deg and derotator = {derotator:g} deg "
        f"has no partner; a frame in state {other} at these angles is needed"
    )


def _apart(first, second):
    """Return the smallest angle between two axes, in [0, 90] degrees."""
    return np.abs(np.mod(first - second + _HALF, _TURN) - _HALF)


class _Setting:
    """What the frames of a pair must agree in, and how good a pair they make."""

    def __init__(self, hwp, derotator, flc_state, steps, tolerance, derotator_tolerance):
        self.hwp, self.steps, self.tolerance = hwp, steps, tolerance
        # shifted, so that an angle slightly below 0 counts as 0 and not as 90 deg
        self.phase = np.mod(hwp + tolerance, _HALF)
        self.derotator_tolerance = derotator_tolerance
        self.derotator = None
        if derotator is not None:
            self.derotator = np.atleast_1d(angle_to_rad(derotator, "derotator"))
        self.state = None if flc_state is None else np.asarray(flc_state)

    def candidates(self, frames, width):
        """
        Return plus and minus frame of all possible pairs, the best first.

        Only frames at most ``width`` places apart in ``frames`` count.
        """
        ahead = np.arange(1, min(width, frames.size - 1) + 1)
        place = np.arange(frames.size)[:, None] + ahead
        here, there = np.nonzero(place < frames.size)
        first, second = frames[here], frames[place[here, there]]
        gap = self.hwp[second] - self.hwp[first]
        # 45 and 135 degrees are alike for a pair: both are 45 from a multiple of 90
        good = np.abs(np.mod(gap, _HALF) - _QUARTER) <= self.tolerance
        good &= self.phase[first] != self.phase[second]
        if self.state is not None:
            good &= self.state[first] == self.state[second]
        first, second = first[good], second[good]
        drift = np.zeros(first.size, dtype=bool)
        if self.derotator is not None:
            distance = _apart(self.derotator[first], self.derotator[second])
            close = distance <= self.derotator_tolerance
            first, second = first[close], second[close]
            # a derotator that drifts pairs neighbours; one that is static is better
            drift = distance[close] > 0.5 * self.derotator_tolerance
        forward = self.phase[first] < self.phase[second]
        plus, minus = np.where(forward, (first, second), (second, first))
        backwards = _apart(self.hwp[minus], self.hwp[plus] + _QUARTER) > self.tolerance
        order = np.lexsort(
            (
                np.minimum(plus, minus),
                np.abs(plus - minus),
                np.abs(self.steps[plus] - self.steps[minus]),
                drift,
                backwards,
            )
        )
        return plus[order], minus[order]


def _paired(setting, share):
    """
    Return the pairs, and the frames left over.

    In long tables partners are sought among the neighbours in time first, and farther away for
    the frames that found none, so that the work grows as the number of frames.
    """
    left = np.argsort(setting.steps, kind="stable")
    n_frames, width, chosen = left.size, _WINDOW, []
    while left.size:
        everything = share or left.size <= _SMALL or width >= left.size
        reach = left.size if everything else width
        pairs, used = _choose(*setting.candidates(left, reach), n_frames, share)
        chosen += pairs
        left = left[~used[left]]
        if everything:
            break
        width *= 4
    return np.array(sorted(chosen), dtype=np.intp).reshape(-1, 2), sorted(left.tolist())


def _check_partners(hwp, tolerance, rows, name):
    there = np.sort(np.mod(hwp, _HALF))
    # the neighbours across 0 and 90 deg
    there = np.concatenate([there - _HALF, there, there + _HALF])
    wanted = np.mod(hwp + _QUARTER, _HALF)
    place = np.searchsorted(there, wanted)
    nearest = np.minimum(wanted - there[place - 1], there[place] - wanted)
    lonely = nearest > tolerance
    if lonely.any():
        frame = int(np.argmax(lonely))
        where = f"frame index {frame}" if rows is None else f"row {rows[frame]}"
        raise ObservationError(
            f"{name}, {where}: hwp = {np.rad2deg(hwp[frame]):g} deg has no partner; a frame "
            "with the half-wave plate 45 deg from it (modulo 180 deg) is needed"
        )


def _choose(plus, minus, n_frames, share):
    """Take candidates in order of preference, each frame once; then share if allowed."""
    used = np.zeros(n_frames, dtype=bool)
    chosen = []
    for p, m in zip(plus.tolist(), minus.tolist(), strict=True):
        if not (used[p] or used[m]):
            used[p] = used[m] = True
            chosen.append((p, m))
    if share:
        for p, m in zip(plus.tolist(), minus.tolist(), strict=True):
            if not (used[p] and used[m]):
                used[[p, m]] = True
                chosen.append((p, m))
    return chosen, used


# ---- data of a table -----------------------------------------------------------------------------


def frame_groups(observations, kind, rows, label, **limits):
    """
    Return the frames of each datum of a table, an array that is read only.

    By ``kind``: pairs by ``"hwp"`` or by ``"flc_state"``, (P, 2); ``"both"``, pairs in both states
    of a modulator, (Q, 4): A and B at the plus angle, then at the minus. The limits are those
    of `pair_frames`, rows and label are for messages.
    """
    frames, time = observations.frames, clock(observations.frames)
    plate = observations.position("hwp") * u.rad
    angles = plate, angle_or_zero(observations, "derotator") * u.rad
    named = limits | {"rows": rows, "name": label}
    labels = np.asarray(frames["frame"]).tolist()
    if kind == "hwp":
        # the plate cancels what is static: both frames must be in one state
        state = np.asarray(frames["flc_state"]) if "flc_state" in frames.colnames else None
        found = pair_frames(*angles, state, time, labels=labels, **named)
    else:
        # states first: they alternate within an exposure and so share its atmosphere
        found = pair_states(observations.position("flc_state"), *angles, time, **named)
    if kind == "both":
        found = quadruples(found, *angles, time, labels=labels, **named)
    if not len(found) and kind != "flc_state":
        raise ObservationError(
            f"{label}: none of its {counted(observations.n_frames, 'frame')} can be paired; two "
            "frames 45 deg of half-wave plate apart at the same derotator angle are needed"
        )
    found.flags.writeable = False
    return found
