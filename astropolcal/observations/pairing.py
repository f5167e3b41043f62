# Licensed under a 3-clause BSD style license - see LICENSE
"""
Pairs of frames whose half-wave plates stand 45 degrees apart.

Pairs are found from the angles, never from the order of the rows: the angles
must differ by 45 degrees modulo 180, the derotator must stand still and the
modulator must be in the same state. Among the candidates the nearest in time wins.
"""

import warnings

import astropy.units as u
import numpy as np

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.units import angle_to_rad

__all__ = ["pair_frames"]

_QUARTER, _HALF, _TURN = np.deg2rad([45.0, 90.0, 180.0])
_MAX_NAMED = 10


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
    phase = np.mod(hwp + tolerance, _HALF)
    apart = _apart(hwp[:, None], hwp[None, :] + _QUARTER) <= tolerance
    apart |= apart.T
    _check_partners(apart, hwp, rows, name)

    same, drift = _same_setting(len(hwp), derotator, flc_state, derotator_tolerance)
    plus, minus = np.nonzero(apart & same & (phase[:, None] < phase[None, :]))
    steps = np.arange(len(hwp)) if time is None else np.asarray(time, dtype=float)
    # a partner at +45 degrees is preferred to the equivalent one at -45
    backwards = _apart(hwp[minus], hwp[plus] + _QUARTER) > tolerance
    order = np.lexsort(
        (
            np.minimum(plus, minus),
            np.abs(plus - minus),
            np.abs(steps[plus] - steps[minus]),
            drift[plus, minus],
            backwards,
        )
    )
    pairs, left = _choose(plus[order], minus[order], len(hwp), share)
    if left:
        _warn_left_over(left, hwp, labels, name)
    return pairs


def _apart(first, second):
    """Return the smallest angle between two axes, in [0, 90] degrees."""
    return np.abs(np.mod(first - second + _HALF, _TURN) - _HALF)


def _same_setting(n_frames, derotator, flc_state, tolerance):
    """Return which frames agree in everything but the plate, and a coarse drift (0 or 1)."""
    same = np.ones((n_frames, n_frames), dtype=bool)
    drift = np.zeros((n_frames, n_frames), dtype=int)
    if derotator is not None:
        angle = np.atleast_1d(angle_to_rad(derotator, "derotator"))
        distance = _apart(angle[:, None], angle[None, :])
        same &= distance <= tolerance
        drift += distance > 0.5 * tolerance
    if flc_state is not None:
        state = np.asarray(flc_state)
        same &= state[:, None] == state[None, :]
    return same, drift


def _check_partners(apart, hwp, rows, name):
    lonely = ~apart.any(axis=1)
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
            used[[p, m]] = True
            chosen.append((p, m))
    if share:
        for p, m in zip(plus.tolist(), minus.tolist(), strict=True):
            if not (used[p] and used[m]):
                used[[p, m]] = True
                chosen.append((p, m))
    pairs = np.array(sorted(chosen), dtype=np.intp).reshape(-1, 2)
    return pairs, np.flatnonzero(~used).tolist()


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
