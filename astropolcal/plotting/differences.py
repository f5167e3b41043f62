# Licensed under a 3-clause BSD style license - see LICENSE
"""Observed and modelled differences against the derotator angle, or the altitude of a star."""

import astropy.units as u
import numpy as np

from astropolcal.plotting._data import DataGrid
from astropolcal.plotting._style import (
    COLORS,
    GREY,
    MINUS,
    SIGMA,
    canvas,
    heading,
    legend_outside,
    looks,
    style,
)

__all__ = ["plot_double_differences"]

_PANELS = 4
# so many that a curve over 180 deg has no corners
_CURVE_POINTS = 241


def plot_double_differences(calibration, wavelengths=None, dataset=0, *, figure=None):
    """
    Draw observed and modelled differences against the derotator angle, or a star's altitude.

    One pair of panels a wavelength: above the observed data and the model,
    evaluated between the data too; below their difference in percent. Stars are drawn
    against their altitude, by the commanded angle of the half-wave plate. Where
    another stage than the derotator moves within a series, the model is drawn
    at the data only.

    Parameters
    ----------
    calibration : Calibration
        A calibration that still has its data.
    wavelengths : `~astropy.units.Quantity`, optional
        The nearest wavelengths of the data are shown; by default four.
    dataset : int
        Which of the calibration's datasets.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    CalibrationFileError
        If the calibration was read from a file, which holds no data.
    ParameterError, WavelengthRangeError
        If there is no such dataset, or a wavelength outside its range.
    ObservationError
        If every datum of the dataset is masked.

    Notes
    -----
    The figure of double differences of McIntosh et al. (2026), with residuals.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_double_differences
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(plot_double_differences(cal, [1330, 1575] * u.nm).axes)
    4
    """
    grid = DataGrid(calibration, dataset)
    bins = grid.spread_bins(_PANELS) if wavelengths is None else grid.nearest_bins(wavelengths)
    series = grid.series()
    with style():
        columns = min(2, len(bins))
        rows = -(-len(bins) // columns)
        # as high as a legend of all settings beside the panels, and a title above it
        height = max(1.2 + 4.1 * rows, 2.2 + 0.24 * len(series))
        figure = canvas(figure, 3.0 + 4.4 * columns, height)
        pairs = _panels(figure, len(bins), rows, columns)
        fine = _fine(grid.abscissa[0])
        curves = [_curve(grid, one, bins, fine) for one in series]
        spread = _s_res(calibration, dataset)
        for i, (pair, row) in enumerate(zip(pairs, bins, strict=True)):
            _draw_heading(pair, grid.wavelength[row], spread[row])
            for one, curve, look in zip(series, curves, _looks(len(series)), strict=True):
                _draw_series(pair, grid, row, one, look)
                if curve is not None:
                    pair[0].plot(fine, curve[i], color=look["color"], linestyle=look["linestyle"])
        _label(pairs, grid, columns)
        heading(figure, calibration, grid.quantity.capitalize(), [grid.part.observations.name])
        _legend(figure, grid, series, bins, spread[bins])
    return figure


def _panels(figure, count, rows, columns):
    """Return (data, residual) axes for each wavelength, all with the same scales."""
    # residuals need less height than data
    spec = figure.add_gridspec(2 * rows, columns, height_ratios=(3, 1.5) * rows)
    pairs = []
    for i in range(count):
        row, column = divmod(i, columns)
        first = pairs[0] if pairs else (None, None)
        top = figure.add_subplot(spec[2 * row, column], sharex=first[0], sharey=first[0])
        bottom = figure.add_subplot(spec[2 * row + 1, column], sharex=top, sharey=first[1])
        pairs.append((top, bottom))
    return pairs


def _looks(count):
    """Return the looks of the series: where colours recur, lines are dashed and markers open."""
    found = []
    for i, (color, marker) in enumerate(looks(count)):
        again = i // len(COLORS) % 2 == 1
        found.append(
            {
                "color": color,
                "marker": marker,
                "markerfacecolor": "white" if again else color,
                "linestyle": "--" if again else "-",
            }
        )
    return found


def _s_res(calibration, dataset):
    return calibration.datasets[dataset].accuracy["s_res"].to_value(u.percent)


def _draw_heading(pair, wavelength, s_res):
    top, bottom = pair
    bottom.axhline(0, color=GREY, linewidth=1)
    known = np.isfinite(s_res)
    top.set_title(f"{wavelength:.1f} nm" + (f",  s_res = {s_res:.2f} %" if known else ""))
    if known:
        bottom.axhspan(-s_res, s_res, color="0.92", zorder=0)


def _draw_series(pair, grid, row, one, look):
    """Draw the data of one setting of the half-wave plate, and their residuals."""
    angle = grid.abscissa[0][one.data]
    value, residual, sigma = (
        array[row, one.data] for array in (grid.observed, grid.residual, grid.sigma)
    )
    points = look | {"linestyle": "none", "label": one.label}
    pair[0].errorbar(angle, value, yerr=_bars(sigma), **points)
    pair[1].errorbar(angle, 100 * residual, yerr=_bars(100 * sigma), **points)
    # where a stage moves from datum to datum there is no model between the data
    if one.positions is None:
        pair[0].plot(angle, value - residual, "x", color=look["color"], markersize=8)


def _curve(grid, one, bins, fine):
    return None if one.positions is None else grid.curve(one, bins, fine)


def _bars(sigma):
    # bars of length zero would look like errors that are very small
    return np.nan_to_num(sigma) if np.isfinite(sigma).any() else None


def _fine(angle):
    """Return angles for the curve: a little beyond the data, ten degrees around a single one."""
    low, high = angle.min(), angle.max()
    # a single angle would give a curve without a length
    margin = 0.04 * (high - low) if high - low > 1 else 10
    return np.linspace(low - margin, high + margin, _CURVE_POINTS)


def _label(pairs, grid, columns):
    for i, (top, bottom) in enumerate(pairs):
        top.tick_params(labelbottom=False)
        last = i + columns >= len(pairs)
        bottom.tick_params(labelbottom=last)
        if last:
            bottom.set_xlabel(grid.abscissa[1])
        if i % columns == 0:
            top.set_ylabel(_two_lines(grid.quantity))
            bottom.set_ylabel(f"obs. {MINUS} model\n(%)")
        else:
            top.tick_params(labelleft=False)
            bottom.tick_params(labelleft=False)
    fine = _fine(grid.abscissa[0])
    pairs[0][0].set_xlim(fine[0], fine[-1])


def _two_lines(words):
    first, _, rest = words.partition(" ")
    return f"{first}\n{rest}" if rest else words


def _legend(figure, grid, series, bins, s_res):
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    # what is not drawn has no entry in the legend
    curves = any(one.positions is not None for one in series)
    handles = [
        Line2D([], [], **(look if curves else look | {"linestyle": ""}), label=one.label)
        for one, look in zip(series, _looks(len(series)), strict=True)
    ]
    bars = np.isfinite(grid.sigma[bins]).any()
    seen = f"observed, with 1{SIGMA} errors" if bars else "observed (no errors given)"
    handles.append(Line2D([], [], color=GREY, marker="o", linestyle="", label=seen))
    if curves:
        handles.append(Line2D([], [], color=GREY, label="model"))
    if any(one.positions is None for one in series):
        handles.append(Line2D([], [], color=GREY, marker="x", linestyle="", label="model at data"))
    if np.isfinite(s_res).any():
        handles.append(Patch(color="0.92", label="± s_res"))
    frames = f"plus {MINUS} minus frame" if grid.part.frames.shape[1] == 2 else "of the frame"
    plate = "half-wave plate\nas commanded" if grid.is_star else "half-wave plate"
    legend_outside(
        figure,
        handles,
        # at the top a long title would run into it
        place="outside right center",
        title=f"{plate},\n{frames}",
    )
