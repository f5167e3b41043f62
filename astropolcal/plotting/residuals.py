# Licensed under a 3-clause BSD style license - see LICENSE
"""A map of the residuals: where the model fails."""

import numpy as np

from astropolcal.plotting._data import SAME_ANGLE, DataGrid
from astropolcal.plotting._style import (
    BLUE,
    MINUS,
    canvas,
    cell_edges,
    clusters,
    degrees,
    heading,
    rms,
    style,
)

__all__ = ["plot_residuals"]

# share of the residuals that the colour scale covers, so that one outlier does not blank the map
_COVERED = 99
_MAX_TICKS = 12


def plot_residuals(calibration, *, figure=None):
    """
    Draw a map of the residuals: wavelength against datum, by derotator angle.

    Above the map is the rms of each datum over the wavelengths, at its right
    the rms of each wavelength over the data; one map a dataset, all with the
    same colours. Masked data are grey.

    Parameters
    ----------
    calibration : Calibration
        A calibration that still has its data.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    CalibrationFileError
        If the calibration was read from a file, which holds no data.
    ObservationError
        If every datum of a dataset is masked.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_residuals
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> plot_residuals(cal).axes[0].get_ylabel()
    'wavelength (nm)'
    """
    grids = [DataGrid(calibration, i) for i in range(len(calibration.datasets))]
    limit, clipped = _limit(grids)
    with style():
        figure = canvas(figure, 10.5, 0.8 + 5.4 * len(grids))
        spec = figure.add_gridspec(
            2 * len(grids), 2, width_ratios=(5, 1), height_ratios=(1, 3.6) * len(grids)
        )
        maps = []
        for i, grid in enumerate(grids):
            main = figure.add_subplot(spec[2 * i + 1, 0])
            above = figure.add_subplot(spec[2 * i, 0], sharex=main)
            right = figure.add_subplot(spec[2 * i + 1, 1], sharey=main)
            maps.append(main)
            drawn = _draw_dataset(main, above, right, grid, limit)
            if len(grids) > 1:
                above.set_title(grid.part.observations.name, loc="left")
        bar = figure.colorbar(
            drawn, ax=figure.axes, extend="both" if clipped else "neither", shrink=0.8, aspect=35
        )
        bar.set_label(f"observed {MINUS} model (%); grey: masked")
        heading(
            figure,
            calibration,
            f"Residuals of the {grids[0].quantity}",
            [grid.part.observations.name for grid in grids],
        )
    return figure


def _limit(grids):
    """Return the end of the colour scale in percent, and whether data lie beyond it."""
    size = np.concatenate([np.abs(g.residual[np.isfinite(g.residual)]) for g in grids]) * 100
    # exact data would leave a scale of no width
    limit = max(np.percentile(size, _COVERED), 1e-12)
    return limit, bool(size.max() > limit)


def _draw_dataset(main, above, right, grid, limit):
    order, group, ends = _layout(grid)
    lam = np.argsort(grid.wavelength)
    edges = cell_edges(grid.wavelength[lam])
    percent = 100 * grid.residual[np.ix_(lam, order)]
    columns = np.arange(len(order) + 1)
    main.grid(False)
    main.set_facecolor("0.75")
    drawn = main.pcolormesh(
        columns, edges, np.ma.masked_invalid(percent), cmap="RdBu_r", vmin=-limit, vmax=limit
    )
    main.vlines(ends[:-1], edges[0], edges[-1], color="black", linewidth=0.8)
    main.set_ylabel("wavelength (nm)")
    _name_groups(main, grid, order, group, ends)
    above.stairs(rms(percent, axis=0), columns, color=BLUE, fill=True)
    above.tick_params(labelbottom=False)
    above.set_ylabel("rms (%)")
    _wavelength_rms(right, rms(percent, axis=1), grid.wavelength[lam])
    for axes in (above, right):
        axes.margins(0)
    above.set_ylim(bottom=0)
    return drawn


def _layout(grid):
    """Return the data by derotator then half-wave plate angle, groups, and where these end."""
    derotator = clusters(grid.derotator, SAME_ANGLE)
    # number of the setting of the plate of each datum
    plate = np.empty(len(derotator), dtype=int)
    for i, series in enumerate(grid.series()):
        plate[series.data] = i
    # the last key is the first: by derotator angle, within it by plate
    order = np.lexsort((plate, derotator))
    group = derotator[order]
    ends = np.flatnonzero(np.diff(group, append=group[-1] + 1)) + 1
    return order, group, ends


def _name_groups(main, grid, order, group, ends):
    starts = np.concatenate([[0], ends[:-1]])
    angles = [np.median(grid.derotator[order][group == g]) for g in range(len(ends))]
    step = -(-len(ends) // _MAX_TICKS)
    main.set_xticks(
        ((starts + ends) / 2)[::step], labels=[degrees(angle) for angle in angles[::step]]
    )
    main.tick_params(axis="x", length=0)
    labels = [series.label for series in grid.series()]
    within = ", ".join(labels) if len(labels) <= 8 else f"{labels[0]} to {labels[-1]}"
    main.set_xlabel(f"derotator angle; at each, left to right, half-wave plate at\n{within}")


def _wavelength_rms(axes, values, wavelength):
    axes.plot(values, wavelength, "o-", color=BLUE)
    axes.set_xlabel("rms (%)")
    axes.tick_params(labelleft=False)
    axes.set_xlim(0, 1.1 * np.nanmax(values) or 1)
