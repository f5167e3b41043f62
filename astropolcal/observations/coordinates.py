# Licensed under a 3-clause BSD style license - see LICENSE
"""Quantities of a frame, other than angles, on which an optic may depend."""

import numpy as np
from astropy.time import Time

from astropolcal.exceptions import ObservationError
from astropolcal.optics import COORDINATES
from astropolcal.optics.core import MOVES

__all__ = ["angle_change", "clock", "frame_coordinate"]

# tables of others number the states, and a reader may have turned the numbers into floats
_STATES = {"A": 0.0, "B": 1.0, "0": 0.0, "1": 1.0, "0.0": 0.0, "1.0": 1.0}


def frame_coordinate(observations, name):
    r"""
    Return how far the run has come, or the fluxes of the beams, in every frame.

    Parameters
    ----------
    observations : Observations
        The dataset.
    name : str
        One of `~astropolcal.optics.COORDINATES`.

        ``"sequence"`` runs from 0 in the first frame to 1 in the last, by the
        column ``time`` if it gives the time of every frame (see `clock`), else
        by the order of the frames; it is 0 where all are at one time.

        ``"flc_state"`` is the state of a modulator, from the column of that name: 0 where it
        holds A (or 0), 1 where it holds B (or 1).

        ``"frame"`` is the number of the frame, from 0.

        ``"hwp_direction"`` and ``"derotator_direction"`` are 1 where the last move of that stage
        was towards smaller angles, else 0; ``"hwp_move"`` and ``"derotator_move"`` are how far
        it was moved before the frame, in radian with its sign.

        ``"parallactic_rate"`` and ``"derotator_rate"`` are the changes of that angle from
        one frame to the next, in radian, in the order in which the frames were taken.

        ``"flux"`` is the flux of each beam in the unit of the table, 0 where it
        is masked.

        ``"total_flux"`` is the sum of both beams, once for each of them.

        ``"previous_flux"`` is the flux of a beam over the one of the same beam and
        wavelength in the frame taken before. It is 1 for the first frame and
        where one of the two is masked.

    Returns
    -------
    `~numpy.ndarray`
        Shape (F,) for the sequence, the state and the rates, (2, B, F) for the fluxes, the
        right beam first.

    Raises
    ------
    ObservationError
        If the name is another, there is no such angle, or the state of the modulator is
        missing or neither of the two.

    Notes
    -----
    Persistence adds a share p of the frame before to a frame. It multiplies the
    flux by :math:`1 + p\,F_\mathrm{before}/F_\mathrm{now}`, which is
    `~astropolcal.optics.FluxGain` with ``power=-1`` and ``mount="previous_flux"``.

    Examples
    --------
    >>> from astropolcal.observations import Observations, example_table
    >>> from astropolcal.observations.coordinates import frame_coordinate
    >>> frame_coordinate(Observations.from_table(example_table()), "sequence").tolist()
    [0.0, 0.3333333333333333, 0.6666666666666666, 1.0]
    """
    if name not in COORDINATES:
        raise ObservationError(
            f"{observations.name}: no coordinate {name!r}; allowed are {', '.join(COORDINATES)}"
        )
    if name == "flc_state":
        return _modulator_state(observations)
    time = _time_or_order(observations)
    if name == "sequence":
        # affine in time, so that a drift has the same parameter whatever the unit of the clock
        passed = time - time.min()
        return passed / passed.max() if passed.max() > 0 else passed
    if name == "frame":
        return np.arange(observations.n_frames, dtype=float)
    if name in MOVES:
        return _last_move(time, observations.position(name.rpartition("_")[0]), name)
    if name.endswith("_rate"):
        return angle_change(observations, observations.position(name.removesuffix("_rate")))
    # (2, B, F): beam, wavelength, frame, as the optics of a chain want them
    fluxes = np.stack([observations.flux_right.T, observations.flux_left.T])
    if name == "flux":
        return np.where(observations.mask.T, 0.0, fluxes)
    if name == "total_flux":
        # both entries alike: what depends on all of the light acts on both beams alike
        total = np.where(observations.mask.T, 0.0, fluxes.sum(axis=0))
        return np.stack([total, total])
    # stable: frames of one time stay in the order of the table
    order = np.argsort(time, kind="stable")
    # what the frame before leaves behind; the first one has none, and 1 changes nothing there
    ratio = np.ones_like(fluxes)
    ratio[..., order[1:]] = fluxes[..., order[1:]] / fluxes[..., order[:-1]]
    return np.where(np.isnan(ratio), 1.0, ratio)


def _last_move(time, angle, name):
    """Return of every frame the last move of a stage: whether it was backwards, or how far."""
    order = np.argsort(time, kind="stable")
    steps = np.diff(angle[order], prepend=angle[order[:1]])
    out = np.zeros_like(angle)
    if name.endswith("_move"):
        out[order] = steps
        return out
    # a stage that stays where it is was last moved as before
    moved = np.maximum.accumulate(np.where(steps != 0, np.arange(len(steps)), 0))
    out[order] = steps[moved] < 0
    return out


def angle_change(observations, angle):
    """
    Return by how much an angle changes from one frame to the next.

    Parameters
    ----------
    observations : Observations
        The dataset: its frames are taken in the order of their times.
    angle : `~numpy.ndarray`
        The angle of every frame, radian, shape (F,).

    Returns
    -------
    `~numpy.ndarray`
        Radian, shape (F,): half the change from the frame before to the one after.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.observations import Observations, example_table
    >>> from astropolcal.observations.coordinates import angle_change
    >>> obs = Observations.from_table(example_table())
    >>> angle_change(obs, np.array([0.0, 0.1, 0.3, 0.4])).round(2).tolist()
    [0.1, 0.15, 0.15, 0.1]
    """
    order = np.argsort(_time_or_order(observations), kind="stable")
    out = np.zeros_like(angle)
    if len(angle) > 1:
        # a turn through 180 deg is a small change; central differences, one-sided at both ends
        out[order] = np.gradient(np.unwrap(angle[order]))
    return out


def clock(frames):
    """
    Return the times of frames as numbers.

    Parameters
    ----------
    frames : `~astropy.table.Table`
        One row a frame.

    Returns
    -------
    `~numpy.ndarray` or None
        Shape (F,), in days or in the unit of the column; None if there is no
        column ``time``, it holds neither times nor numbers, or one is unknown.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal.observations.coordinates import clock
    >>> clock(QTable({"time": [0, 30, 65] * u.s})).tolist()
    [0.0, 30.0, 65.0]
    >>> clock(QTable({"hwp": [0, 45] * u.deg})) is None
    True
    """
    column = frames["time"] if "time" in frames.colnames else None
    # a double resolves a microsecond of a modified Julian date
    column = column.mjd if isinstance(column, Time) else column
    if getattr(getattr(column, "dtype", None), "kind", "") not in tuple("iuf"):
        return None
    # one unknown time makes the order of all frames doubtful, so none is used then
    known = ~np.asarray(getattr(column, "mask", False))
    plain = getattr(column, "unmasked", column)
    times = np.asarray(getattr(plain, "value", plain), dtype=float)
    return times if np.all(known & np.isfinite(times)) else None


def _modulator_state(observations):
    frames = observations.frames
    if "flc_state" not in frames.colnames:
        raise ObservationError(
            f"{observations.name}: no column flc_state; it is needed, with A or B in each frame"
        )
    # strings, bytes and numbers alike become text here
    found = [_STATES.get(str(value).strip().upper()) for value in frames["flc_state"]]
    if None in found:
        i = found.index(None)
        raise ObservationError(
            f"{observations.name}: flc_state = {str(frames['flc_state'][i])!r} in frame "
            f"{frames['frame'][i]}; allowed are A and B, or 0 and 1"
        )
    return np.array(found)


def _time_or_order(observations):
    times = clock(observations.frames)
    return np.arange(observations.n_frames, dtype=float) if times is None else times
