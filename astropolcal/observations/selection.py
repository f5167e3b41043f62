# Licensed under a 3-clause BSD style license - see LICENSE
"""Parts of a grid of observations: cells masked, some frames, some wavelengths."""

import dataclasses

import numpy as np

from astropolcal.exceptions import ObservationError
from astropolcal.words import counted

__all__ = ["masked_grid", "some_bins", "some_frames"]


def masked_grid(grid, mask, reason, label):
    """
    Return a grid with more cells masked.

    Parameters
    ----------
    grid : Grid
        Shape (F, W).
    mask : array_like of bool
        True where a cell is to be masked: shape (F, W), or (F,) for whole frames.
    reason : str
        Why; cells masked before keep their reason.
    label : str
        What to call the table in messages.

    Returns
    -------
    Grid

    Raises
    ------
    ObservationError
        If the shape, type or reason is wrong, or no usable cell would remain.

    Examples
    --------
    >>> from astropolcal.observations import example_table
    >>> from astropolcal.observations.grid import build_grid
    >>> from astropolcal.observations.selection import masked_grid
    >>> grid = build_grid(example_table(), "night")
    >>> masked_grid(grid, grid.flux_right < 400, "faint", "night").reasons
    ('faint',)
    """
    mask, known = np.asarray(mask), grid.reason > 0
    shapes = (known.shape, known.shape[:1])
    if mask.dtype != bool or mask.shape not in shapes:
        raise ObservationError(
            f"{label}: mask of type {mask.dtype} and shape {mask.shape}; allowed are "
            f"booleans of shape {shapes[0]} or {shapes[1]}"
        )
    if not isinstance(reason, str) or not reason.strip():
        raise ObservationError(f"{label}: reason = {reason!r}, some words are needed")
    reason = reason.strip()
    new = (mask if mask.ndim == 2 else mask[:, None]) & ~known
    if (new | known).all():
        raise ObservationError(
            f"{label}: masking {reason!r} would leave no usable cell of {new.size}"
        )
    reasons = grid.reasons if reason in grid.reasons else (*grid.reasons, reason)
    # a masked flux is NaN as well, so that what forgets the mask cannot use it
    return dataclasses.replace(
        grid,
        flux_right=np.where(new, np.nan, grid.flux_right),
        flux_left=np.where(new, np.nan, grid.flux_left),
        errors={name: np.where(new, np.nan, error) for name, error in grid.errors.items()},
        reason=np.where(new, reasons.index(reason) + 1, grid.reason),
        reasons=reasons,
    )


def some_frames(grid, frames, label):
    """
    Return the grid of some frames, in the order of the table.

    Parameters
    ----------
    grid : Grid
        Shape (F, W).
    frames : array_like of bool or int
        One boolean a frame, or indices of frames, each at most once.
    label : str
        What to call the table in messages.

    Returns
    -------
    Grid

    Raises
    ------
    ObservationError
        If an index is out of range or given twice, or no usable cell remains.

    Examples
    --------
    >>> from astropolcal.observations import example_table
    >>> from astropolcal.observations.grid import build_grid
    >>> from astropolcal.observations.selection import some_frames
    >>> some_frames(build_grid(example_table(), "night"), [-1, 0], "night").rows.tolist()
    [1, 10]
    """
    index = _frame_index(np.asarray(frames), len(grid.frames), label)
    if grid.reason[index].all():
        raise ObservationError(
            f"{label}: the {counted(len(index), 'frame')} selected have no usable cell"
        )
    return dataclasses.replace(
        grid,
        frames=grid.frames[index],
        rows=grid.rows[index],
        flux_right=grid.flux_right[index],
        flux_left=grid.flux_left[index],
        errors={name: error[index] for name, error in grid.errors.items()},
        reason=grid.reason[index],
    )


def some_bins(grid, bins, label):
    """
    Return the grid at some wavelengths.

    Parameters
    ----------
    grid : Grid
        Shape (F, W).
    bins : array_like of bool
        One boolean a bin, shape (W,).
    label : str
        What to call the table in messages.

    Returns
    -------
    Grid

    Raises
    ------
    ObservationError
        If the shape or type is wrong, or no usable cell remains.

    Examples
    --------
    >>> from astropolcal.observations import example_table
    >>> from astropolcal.observations.grid import build_grid
    >>> from astropolcal.observations.selection import some_bins
    >>> some_bins(build_grid(example_table(), "night"), [True, False, True], "night").wavelength
    <Quantity [1.2, 2.2] um>
    """
    chosen, n_bins = np.asarray(bins), len(grid.bin)
    if chosen.dtype != bool or chosen.shape != (n_bins,):
        raise ObservationError(
            f"{label}: bins of type {chosen.dtype} and shape {chosen.shape}; allowed "
            f"are {n_bins} booleans"
        )
    if grid.reason[:, chosen].all():
        raise ObservationError(f"{label}: the bins selected have no usable cell")
    return dataclasses.replace(
        grid,
        bin=grid.bin[chosen],
        wavelength=grid.wavelength[chosen],
        flux_right=grid.flux_right[:, chosen],
        flux_left=grid.flux_left[:, chosen],
        errors={name: error[:, chosen] for name, error in grid.errors.items()},
        reason=grid.reason[:, chosen],
    )


def _frame_index(frames, n_frames, label):
    """Return the indices of frames, ascending; negative ones count from the end."""
    if frames.dtype == bool and frames.shape == (n_frames,):
        return np.flatnonzero(frames)
    # an empty list has type float, and selects nothing that could be used
    if frames.dtype.kind not in "iu" or frames.ndim != 1:
        raise ObservationError(
            f"{label}: frames of type {frames.dtype} and shape {frames.shape}; allowed "
            f"are {n_frames} booleans or a list of indices"
        )
    outside = frames[(frames < -n_frames) | (frames >= n_frames)]
    if outside.size:
        raise ObservationError(
            f"{label}: frame index {outside[0]}, allowed are 0 to {n_frames - 1}"
        )
    # -1 and the last index are the same frame
    index, counts = np.unique(frames % n_frames, return_counts=True)
    if (counts > 1).any():
        raise ObservationError(
            f"{label}: frame index {index[counts > 1][0]} is given twice, "
            "each frame is allowed once"
        )
    return index
