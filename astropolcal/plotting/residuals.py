# Licensed under a 3-clause BSD style license - see LICENSE
"""A map of the residuals: where the model fails."""

import numpy as np

from astropolcal.plotting._data import SAME_ANGLE, DataGrid
from astropolcal.plotting._style import (
    BLUE,
    GREY,
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
# maps have one scale unless those of their own differ by more than this factor
_ONE_SCALE = 3
# room above the tallest bar
_HEADROOM = 1.05


def plot_residuals(calibration, *, figure=None):
    """
    Draw a map of the residuals: wavelength against datum, by derotator angle.

    Above the map is the rms of each datum over the wavelengths, at its right
    the rms of each wavelength over the data; one map a dataset. All maps have the
    same colours, or where the residuals differ much in size each a scale of its own.
    Masked data are grey. Datasets of one wavelength each are drawn as bars, not as maps.

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
    with style():
        if all(grid.wavelength.size == 1 for grid in grids):
            figure = _draw_bars(figure, grids)
        else:
            figure = _draw_maps(figure, grids)
        heading(
            figure,
            calibration,
            f"Residuals of the {grids[0].quantity}",
            [grid.part.observations.name for grid in grids],
        )
    return figure


def _draw_maps(figure, grids):
    scales, shared = _scales(grids)
    figure = canvas(figure, 10.5, 0.8 + 5.4 * len(grids))
    spec = figure.add_gridspec(
        2 * len(grids), 2, width_ratios=(5, 1), height_ratios=(1, 3.6) * len(grids)
    )
    for i, (grid, (limit, clipped)) in enumerate(zip(grids, scales, strict=True)):
        main = figure.add_subplot(spec[2 * i + 1, 0])
        above = figure.add_subplot(spec[2 * i, 0], sharex=main)
        right = figure.add_subplot(spec[2 * i + 1, 1], sharey=main)
        drawn = _draw_dataset(main, above, right, grid, limit)
        if len(grids) > 1:
            above.set_title(grid.part.observations.name, loc="left")
        if not shared:
            bar = _add_bar(figure, drawn, [main, above, right], clipped)
            bar.set_label(f"observed {MINUS} model (%), own scale\ngrey: masked")
    if shared:
        bar = _add_bar(figure, drawn, figure.axes, clipped)
        bar.set_label(f"observed {MINUS} model (%); grey: masked")
    return figure


def _add_bar(figure, drawn, panels, clipped):
    extend = "both" if clipped else "neither"
    return figure.colorbar(drawn, ax=panels, extend=extend, shrink=0.8, aspect=35)


def _scales(grids):
    """Return the colour scale of each map, and whether it is that of all."""
    own = [_limit([grid]) for grid in grids]
    ends = [limit for limit, _ in own]
    if max(ends) > _ONE_SCALE * min(ends):
        return own, False
    return [_limit(grids)] * len(grids), True


def _draw_bars(figure, grids):
    """Draw the residuals at one wavelength, a panel a dataset, all with the same scale."""
    figure = canvas(figure, 10.5, 2.2 + 1.4 * max(len(grids), 2))
    panels = figure.subplots(len(grids), 1, sharey=True, squeeze=False)[:, 0]
    below = None
    for axes, grid in list(zip(panels, grids, strict=True))[::-1]:
        order, group, ends = _layout(grid)
        percent = 100 * grid.residual[0, order]
        axes.bar(np.arange(len(order)) + 0.5, percent, width=0.9, color=BLUE)
        for masked in np.flatnonzero(~np.isfinite(percent)):
            axes.axvspan(masked, masked + 1, color="0.75", linewidth=0)
        axes.axhline(0, color=GREY, linewidth=1)
        for end in ends[:-1]:
            axes.axvline(end, color="black", linewidth=0.8)
        axes.set_xlim(0, len(order))
        size = f"{grid.wavelength[0]:.1f} nm, rms {rms(percent):.2g} %"
        axes.set_title(f"{grid.part.observations.name}: {size}", loc="left", fontsize=10)
        _name_groups(axes, grid, order, group, ends)
        # what stands below the next panel need not be said twice
        words = axes.get_xlabel(), [text.get_text() for text in axes.get_xticklabels()]
        if words == below:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
        below = words
    figure.supylabel(f"observed {MINUS} model (%); grey: masked", fontsize=11)
    size = max(np.nanmax(np.abs(grid.residual)) for grid in grids) * 100
    panels[0].set_ylim(-_HEADROOM * max(size, 1e-12), _HEADROOM * max(size, 1e-12))
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
    # exact data have no bars
    above.set_ylim(0, _HEADROOM * np.nanmax(rms(percent, axis=0)) or 1)
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
