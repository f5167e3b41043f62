# Licensed under a 3-clause BSD style license - see LICENSE
"""
Pairs of frames whose half-wave plates stand 45 degrees apart, or whose modulators differ, or both.

Pairs are found from the angles, never from the order of the rows: the angles
must differ by 45 degrees modulo 180, the derotator must stand still and the
modulator must be in the same state. Among the candidates the nearest in time wins.
"""

import warnings

import astropy.units as u
import numpy as np

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.units import angle_to_rad

__all__ = ["PAIRINGS", "pair_frames", "pair_states", "quadruples"]

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
    Pair the frames whose half-wave-plate angles differ by 45 degrees.

    Parameters
    ----------
    hwp : `~astropy.units.Quantity`
        Half-wave-plate angle of every frame, shape (F,).
    derotator : `~astropy.units.Quantity`, optional
        Derotator angle of every frame; the frames of a pair must agree in it.
    flc_state : array_like, optional
        State of a modulator of every frame; the frames of a pair must agree in it.
    time : array_like of float, optional
        Time of every frame in any unit; by default the index of the frame.
    tolerance, derotator_tolerance : `~astropy.units.Quantity`
        Largest difference that still counts as the same angle.
    share : bool
        Whether a frame left over may be paired with one that is already used.
    labels : sequence, optional
        What to call the frames in messages; by default their index.
    rows : sequence of int, optional
        The row of the file each frame starts in, for messages.
    name : str
        What to call the table in messages.

    Returns
    -------
    `~numpy.ndarray` of int
        Frame indices, shape (P, 2), ordered by plus frame: plus, then minus. The
        plus frame is the one whose angle modulo 90 degrees lies in [0, 45).

    Raises
    ------
    ObservationError
        If no frame of the whole table stands 45 degrees from one of the angles.

    Warns
    -----
    AstropolcalWarning
        If frames are left over because their partners are missing or used.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.observations import pair_frames
    >>> pair_frames([0, 22.5, 45, 67.5] * u.deg).tolist()
    [[0, 2], [1, 3]]
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
        _warn_left_over(left, hwp, labels, name)
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
    Pair the frames of two states of a modulator at the same angles.

    Parameters
    ----------
    state : array_like of float
        State of every frame, 0 or 1, shape (F,).
    hwp, derotator : `~astropy.units.Quantity`
        Angles of every frame; the frames of a pair agree in them, modulo 180 deg.
    time : array_like of float, optional
        Time of every frame in any unit; by default the index of the frame.
    tolerance, derotator_tolerance : `~astropy.units.Quantity`
        Largest difference that still counts as the same angle.
    share : bool
        Whether a frame left over may be paired with one that is already used.
    rows : sequence of int, optional
        The row of the file each frame starts in, for messages.
    name : str
        What to call the table in messages.

    Returns
    -------
    `~numpy.ndarray` of int
        Frame indices, shape (P, 2), ordered by the first: state 0, then state 1. Among
        several partners the nearest in time is taken.

    Raises
    ------
    ObservationError
        If a frame has no partner in the other state at its angles.

    Warns
    -----
    AstropolcalWarning
        If frames are left over because their partners are used.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.observations.pairing import pair_states
    >>> pair_states([0, 1, 1, 0], [0, 0, 22.5, 22.5] * u.deg, [90, 90, 90, 90] * u.deg).tolist()
    [[0, 1], [3, 2]]
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
    Combine pairs of modulator states whose half-wave plates stand 45 degrees apart.

    Parameters
    ----------
    states : `~numpy.ndarray` of int
        Frame indices of each pair, first and second state, shape (P, 2), see `pair_states`.
    hwp, derotator : `~astropy.units.Quantity`
        Angles of every frame, shape (F,).
    time : array_like of float, optional
        Time of every frame in any unit; by default the index of the frame.
    labels, rows, name
        As for `pair_frames`, one a frame.
    **limits
        ``tolerance``, ``derotator_tolerance`` and ``share`` of `pair_frames`.

    Returns
    -------
    `~numpy.ndarray` of int
        Frame indices, shape (Q, 4): both states of the plus angle, both of the minus angle.

    Raises
    ------
    ObservationError
        If no pair stands 45 degrees from one of the angles.

    Warns
    -----
    AstropolcalWarning
        If pairs are left over because their partners are missing or used.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.observations.pairing import quadruples
    >>> pairs = np.array([[0, 1], [2, 3]])
    >>> quadruples(pairs, [0, 0, 45, 45] * u.deg, [90] * 4 * u.deg).tolist()
    [[0, 1, 2, 3]]
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

        Only frames that are at most ``width`` places apart in ``frames`` count.
        """
        first, second = _neighbours(frames, width)
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
            # a derotator that drifts pairs neighbours; one that stands still is better
            drift = distance[close] > 0.5 * self.derotator_tolerance
        forward = self.phase[first] < self.phase[second]
        plus, minus = np.where(forward, (first, second), (second, first))
        order = self._preference(plus, minus, drift)
        return plus[order], minus[order]

    def _preference(self, plus, minus, drift):
        # a partner at +45 degrees is preferred to the equivalent one at -45
        backwards = _apart(self.hwp[minus], self.hwp[plus] + _QUARTER) > self.tolerance
        return np.lexsort(
            (
                np.minimum(plus, minus),
                np.abs(plus - minus),
                np.abs(self.steps[plus] - self.steps[minus]),
                drift,
                backwards,
            )
        )


def _neighbours(frames, width):
    """Return all pairs of frames that are at most ``width`` places apart."""
    # a band of the matrix of all pairs, (frames, width)
    ahead = np.arange(1, min(width, frames.size - 1) + 1)
    place = np.arange(frames.size)[:, None] + ahead
    here, there = np.nonzero(place < frames.size)
    return frames[here], frames[place[here, there]]


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


def _warn_left_over(left, hwp, labels, name):
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
