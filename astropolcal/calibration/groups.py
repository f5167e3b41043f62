# Licensed under a 3-clause BSD style license - see LICENSE
"""
Groups of data that cross-validation leaves out together.
"""

import numpy as np

from astropolcal.exceptions import FitError
from astropolcal.observations.quality import cycle_numbers

__all__ = ["GROUPS", "groups_by", "leave_out_groups", "what_is_left_out"]

#: What may make a group, and what groups of it are called.
GROUPS = {
    "derotator": "derotator angles",
    "cycle": "half-wave-plate cycles",
    "dataset": "datasets",
}
# derotator angles that differ by less belong to one group
_SAME_ANGLE = np.deg2rad(0.5)
# runs into which the cycles of a star are divided
_RUNS = 8


def leave_out_groups(measurement):
    """
    Return the group of each datum for cross-validation: its derotator angle.

    On sky the derotator turns slowly, so there a group is one of eight runs of
    consecutive cycles of the half-wave plate, or one cycle where there are fewer.

    Parameters
    ----------
    measurement : Measurement
        The measurement.

    Returns
    -------
    `~numpy.ndarray`
        Number of the group, shape (n_data,); datasets have their own groups.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import leave_out_groups
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames)
    >>> measurement = Measurement(charis.chain(), observations)
    >>> int(leave_out_groups(measurement).max())
    2
    """
    groups, first = [], 0
    for dataset in measurement.datasets:
        if "parallactic" in dataset.positions:
            group = _star_runs(dataset)
            groups.append(first + group[dataset.group_of_datum])
            first += int(group.max()) + 1
            continue
        angle = dataset.observations.position("derotator")[dataset.frames[:, 0]]
        # sorted angles fall apart into groups at every step larger than the tolerance
        order = np.argsort(angle)
        new = np.concatenate([[0], np.cumsum(np.diff(angle[order]) > _SAME_ANGLE)])
        group = np.empty(len(angle), dtype=int)
        group[order] = new
        groups.append(first + group[dataset.group_of_datum])
        first += int(new[-1]) + 1
    return np.concatenate(groups)


def _star_runs(dataset):
    """Return the run of consecutive cycles of each group of frames, shape (n_groups,)."""
    cycle = cycle_numbers(dataset.observations)[dataset.frames[:, 0]]
    rank = np.unique(cycle, return_inverse=True)[1]
    runs = min(_RUNS, int(rank.max()) + 1)
    # equal runs of consecutive cycles; a derotator that follows the sky gives no angles to group by
    return rank * runs // (int(rank.max()) + 1)


def groups_by(measurement, by="derotator"):
    """
    Return the group of each datum for cross-validation.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    by : {"derotator", "cycle", "dataset"}
        A group is a derotator angle of a dataset (of a star: a run of cycles); a cycle of
        the half-wave plate; or a whole dataset (a night). A cycle is the column ``cycle`` of the
        frames where there is one; otherwise it ends where a plate angle
        (of one state of a modulator) comes again or the derotator moves. A
        datum belongs to the cycle of its plus frame.

    Returns
    -------
    `~numpy.ndarray` of int
        Shape (n_data,); numbered from 0.

    Raises
    ------
    FitError
        If a group has a single member at each wavelength, or there is one
        group only, or no such way of grouping.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import groups_by
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 60] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames)
    >>> measurement = Measurement(charis.chain(), observations)
    >>> [int(groups_by(measurement, by).max()) for by in ("derotator", "cycle")]
    [1, 2]
    """
    if by not in GROUPS:
        raise FitError(f"groups by {by!r}; allowed are {', '.join(GROUPS)}")
    groups = leave_out_groups(measurement) if by == "derotator" else _groups(measurement, by)
    names = _members(measurement, groups, by)
    if len(names) < 2:
        raise FitError(f"cross-validation by {by}: all data are in one group, {names[0][0]}")
    for name, count in names:
        if count < 2:
            raise FitError(
                f"cross-validation by {by}: group {name} has a single member; at least 2 data a "
                "wavelength are needed, group by something else or leave it out"
            )
    return groups


def _groups(measurement, by):
    groups, first = [], 0
    for part in measurement.datasets:
        number = np.zeros(len(part.frames), dtype=int)
        if by == "cycle":
            number = cycle_numbers(part.observations)[part.frames[:, 0]]
        number = np.unique(number, return_inverse=True)[1]
        groups.append(first + number[part.group_of_datum])
        # groups of different datasets never share a number
        first += int(number.max()) + 1
    return np.concatenate(groups)


def _members(measurement, groups, by):
    """Return name and largest number of data at one wavelength of every group."""
    found = []
    for i, (part, where) in enumerate(zip(measurement.datasets, measurement.segments, strict=True)):
        angle = np.rad2deg(part.observations.position("derotator"))[part.frames[:, 0]]
        own, bins = groups[where], measurement.bins[where]
        for k, label in enumerate(np.unique(own)):
            rows = own == label
            what = {
                "derotator": f"{angle[part.group_of_datum[rows][0]]:g} deg",
                "cycle": f"number {k}",
                "dataset": f"number {i}",
            }[by]
            count = int(np.bincount(bins[rows]).max())
            found.append((f"{by} {what} of {part.observations.name}", count))
    return found


def what_is_left_out(calibration):
    """
    Return what the cross-validation of a calibration has left out, in words.

    Parameters
    ----------
    calibration : Calibration
        The calibration; its ``fit["groups"]`` counts, by default "derotator".

    Returns
    -------
    str

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> from astropolcal.calibration.groups import what_is_left_out
    >>> what_is_left_out(SimpleNamespace(fit={"groups": "cycle"}))
    'half-wave-plate cycles'
    """
    return GROUPS.get(calibration.fit.get("groups", "derotator"), "groups")
