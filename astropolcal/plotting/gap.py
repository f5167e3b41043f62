# Licensed under a 3-clause BSD style license - see LICENSE
"""
Figures of a diagnosis: the gap by wavelength, its maps, where it lies.

Those of its effects are in `astropolcal.plotting.effects`, and to be had from here too.
"""

import textwrap

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.gap._words import shortened
from astropolcal.gap.residuals import locate
from astropolcal.plotting._style import (
    BLACK,
    BLUE,
    GREY,
    MINUS,
    ORANGE,
    VERMILION,
    canvas,
    cell_edges,
    legend_outside,
    rms,
    style,
    wavelength_label,
)
from astropolcal.plotting.effects import plot_cause_map, plot_effect_sizes, verdict_line

__all__ = [
    "plot_cause_map",
    "plot_effect_sizes",
    "plot_gap_frames",
    "plot_gap_maps",
    "plot_gap_spectrum",
    "plot_where",
]

_CHANNELS = {
    "difference": ("normalized difference of the beams", "R\N{MINUS SIGN}L over R+L"),
    "sum": ("logarithm of the sum of the beams", "ln(R+L)"),
}
# share of the residuals that the colour scale of the maps covers
_COVERED = 99.5
_WIDTH = 56
_MOST_TICKS = 10
# characters of a dataset's name above a panel
_LONGEST_NAME = 30


def _gaps(model, noise):
    """Return residuals in percent without the lamp, one array (2, W, F) a dataset."""
    found = []
    gaps = model.problem.differences(model.fit.coefficients)
    for channel, gap in zip(noise.problem.channels, gaps, strict=True):
        # whitened by the same noise before and after, lest the two differ by their lamps
        percent = 100 * channel.whiten(gap) * channel.sigma
        found.append(np.where(channel.valid, percent, np.nan))
    return found


def _name(channel):
    if channel not in _CHANNELS:
        raise ParameterError(f"channel = {channel!r}; allowed are {', '.join(_CHANNELS)}")
    return list(_CHANNELS).index(channel)


def plot_gap_spectrum(diagnosis, *, figure=None):
    """
    Draw the gap by wavelength, before and after, with the noise floor.

    One row a dataset, the difference of the beams at the left and the sum at
    the right, less the lamp's drift and flicker; of the fits, not of left-out
    frames.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting.gap import plot_gap_spectrum
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=1)
    >>> diagnosis = diagnose(chain, data, effects=["beam_gain"], cross_validate=False)
    >>> len(plot_gap_spectrum(diagnosis).axes)
    2
    """
    nominal, improved = diagnosis.nominal, diagnosis.improved
    before, after = _gaps(nominal, nominal), _gaps(improved, nominal)
    n = len(before)
    with style():
        figure = canvas(figure, 10, 1.6 + 3.3 * n)
        grid = figure.subplots(n, 2, sharex=True, squeeze=False)
        for i, row in enumerate(grid):
            sigma = nominal.problem.channels[i].sigma
            valid = nominal.problem.channels[i].valid
            nm = 1000 * nominal.problem.wavelength[nominal.problem.datasets[i].bins]
            order = np.argsort(nm)
            for c, axes in enumerate(row):
                floor = rms(np.where(valid, 100 * sigma[c], np.nan), axis=1)[order]
                axes.fill_between(nm[order], floor, color="0.85", label="noise")
                axes.plot(nm[order], floor, color=GREY, linewidth=1)
                one = rms(before[i][c], axis=1)[order]
                two = rms(after[i][c], axis=1)[order]
                axes.plot(nm[order], two, "o-", color=BLUE, markersize=4, label="after")
                # hollow and larger, so that both are seen where they are the same
                hollow = {"markerfacecolor": "none", "markersize": 8}
                axes.plot(nm[order], one, "s--", color=VERMILION, label="before", **hollow)
                _percent_axis(axes, np.concatenate([floor, one, two]))
                _spectrum_labels(axes, nominal.observations[i].name, c, i == n - 1)
        handles = grid[0, 0].get_legend_handles_labels()[0]
        legend_outside(figure, handles, columns=3)
        figure.suptitle(f"Gap between model and data\n{verdict_line(diagnosis)}")
    return figure


def _percent_axis(axes, values):
    """Choose a logarithmic axis where the values need it."""
    # a wavelength that is masked wholly has none
    low, high = np.nanmin(values[values > 0]), np.nanmax(values)
    if high > 5 * low:
        axes.set_yscale("log")
        axes.set_ylim(low / 1.6, high * 1.6)
        # a handful of plain numbers rather than powers of ten
        axes.yaxis.set_major_formatter(_plain())
        axes.yaxis.set_minor_formatter(_plain((2, 5) if high < 30 * low else ()))
    else:
        axes.set_ylim(0, 1.15 * high)


def _plain(digits=(1,)):
    from matplotlib.ticker import FuncFormatter

    def text(value, _):
        first = value / 10 ** np.floor(np.log10(value))
        return f"{value:g}" if np.any(np.isclose(first, digits)) else ""

    return FuncFormatter(text)


def _spectrum_labels(axes, name, channel, last):
    title, label = list(_CHANNELS.values())[channel]
    axes.set_title(f"{shortened(name, _LONGEST_NAME)}\n{title}", loc="left")
    axes.set_ylabel(f"rms of {label} (%)")
    if last:
        wavelength_label(axes)


def plot_gap_frames(diagnosis, *, figure=None):
    """
    Draw the residuals frame by frame, before and after, with what the causes do.

    Single differences, mean of that third of the wavelengths in which the causes do most. The
    line is what the model predicts with the causes in it, less what it predicts without.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting.gap import plot_gap_frames
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=1)
    >>> diagnosis = diagnose(chain, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_gap_frames(diagnosis).axes[0].get_xlabel()[:5]
    'frame'
    """
    nominal, improved = diagnosis.nominal, diagnosis.improved
    before, after = _gaps(nominal, nominal), _gaps(improved, nominal)
    n = len(before)
    with style():
        figure = canvas(figure, 9, 1.4 + 2.5 * n)
        grid = figure.subplots(n, 1, squeeze=False)[:, 0]
        for i, axes in enumerate(grid):
            observations, order = nominal.observations[i], np.argsort(_wavelength(nominal, i))
            thirds = [part for part in np.array_split(order, 3) if part.size]
            does = [rms(before[i][0][part] - after[i][0][part]) for part in thirds]
            third = thirds[int(np.nanargmax(does))] if np.nanmax(does) > 0 else thirds[-1]
            old, new = (_mean(gap[i][0][third]) for gap in (before, after))
            x = np.arange(len(old)) + 0.5
            axes.axhline(0, color=GREY, linewidth=0.8)
            look = {"markerfacecolor": "none", "markersize": 6}
            axes.plot(x, old, "s", color=VERMILION, label="before", **look)
            if diagnosis.causes:
                axes.plot(x, old - new, color=BLACK, linewidth=1, label="what the causes do")
                axes.plot(x, new, "o", color=BLUE, markersize=4, label="after")
            nm = 1000 * _wavelength(nominal, i)[third]
            name = shortened(observations.name, _LONGEST_NAME)
            axes.set_title(f"{name}, {nm.min():.0f} to {nm.max():.0f} nm", loc="left")
            axes.set_ylabel(f"observed {MINUS} model (%)")
            _frame_axis(axes, observations)
        handles = grid[0].get_legend_handles_labels()[0]
        legend_outside(figure, handles, columns=3)
        figure.suptitle(f"Residuals of the single differences\n{verdict_line(diagnosis)}")
    return figure


def _wavelength(model, i):
    return model.problem.wavelength[model.problem.datasets[i].bins]


def _mean(values):
    """Return the mean over the wavelengths of the known values, NaN where there are none."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def plot_gap_maps(diagnosis, *, channel="difference", figure=None):
    """
    Draw maps of the residuals, wavelength against frame, before and after.

    All maps have the same colours. Frames are in the order of the table; lines
    separate derotator angles. Masked data are grey.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    channel : {"difference", "sum"}
        Of the beams.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If the channel is another.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting.gap import plot_gap_maps
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=1)
    >>> diagnosis = diagnose(chain, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_gap_maps(diagnosis).axes[0].get_ylabel()
    'wavelength (nm)'
    """
    c = _name(channel)
    nominal, improved = diagnosis.nominal, diagnosis.improved
    pairs = list(zip(_gaps(nominal, nominal), _gaps(improved, nominal), strict=True))
    sizes = np.abs(np.concatenate([gap[c].ravel() for pair in pairs for gap in pair]))
    # one hot pixel must not blank the maps
    limit = max(np.nanpercentile(sizes, _COVERED), 1e-12)
    with style():
        figure = canvas(figure, 12, 1.5 + 3.2 * len(pairs))
        grid = figure.subplots(len(pairs), 2, sharey="row", squeeze=False)
        for row, pair, dataset in zip(grid, pairs, nominal.problem.datasets, strict=True):
            observations = dataset.observations
            wavelength = nominal.problem.wavelength[dataset.bins]
            for axes, gap, when in zip(row, pair, ("before", "after"), strict=True):
                drawn = _map(axes, gap[c], wavelength, limit)
                size = rms(gap[c])
                name = shortened(observations.name, _LONGEST_NAME)
                axes.set_title(f"{name}, {when}: rms {size:.2g} %", loc="left")
                _frame_axis(axes, observations)
            row[0].set_ylabel("wavelength (nm)")
        extend = "both" if np.nanmax(sizes) > limit else "neither"
        bar = figure.colorbar(drawn, ax=grid, extend=extend, shrink=0.85, aspect=35)
        bar.set_label(f"observed {MINUS} model (%); grey: masked")
        figure.suptitle(f"Residuals of the {_CHANNELS[channel][0]}\n{verdict_line(diagnosis)}")
    return figure


def _map(axes, gap, wavelength, limit):
    order = np.argsort(wavelength)
    axes.grid(False)
    axes.set_facecolor("0.75")
    return axes.pcolormesh(
        np.arange(gap.shape[1] + 1),
        cell_edges(1000 * wavelength[order]),
        np.ma.masked_invalid(gap[order]),
        cmap="RdBu_r",
        vmin=-limit,
        vmax=limit,
        rasterized=True,
    )


def _frame_axis(axes, observations):
    """Name the runs of frames at one derotator angle, or number the frames."""
    from astropolcal.gap.residuals import frame_blocks

    blocks = frame_blocks(observations)
    count = blocks.max() + 1
    if count == blocks.size or "derotator" not in observations.frames.colnames:
        axes.set_xlabel("frame")
        return
    starts = np.searchsorted(blocks, np.arange(count))
    ends = np.append(starts[1:], blocks.size)
    for edge in starts[1:]:
        axes.axvline(edge, color=BLACK, linewidth=0.6)
    angles = np.rad2deg(observations.position("derotator")[starts])
    # rounded up, so that there are never more labels than fit
    step = -(-count // _MOST_TICKS)
    labels = [f"{angle:.4g}" for angle in angles[::step]]
    axes.set_xticks(((starts + ends) / 2)[::step], labels=labels)
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel("frames by derotator angle (deg)")


def plot_where(diagnosis, *, limit=12, figure=None):
    """
    Draw the shares of the gap by axis: what it follows, and where it is largest.

    Patterns share the gap among themselves; places do so for each axis, so that
    bars of different axes do not add up.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis, whose nominal model is looked at.
    limit : int
        Most bars of either kind.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting.gap import plot_where
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=1)
    >>> diagnosis = diagnose(chain, data, effects=["beam_gain"], cross_validate=False)
    >>> len(plot_where(diagnosis).axes)
    2
    """
    told = locate(diagnosis.nominal)
    # two panels, for the shares of one list add up and those of the other do not
    kinds = [[row for row in told if row["kind"] == k][:limit] for k in ("pattern", "place")]
    # bars of the same height in both panels
    heights = [max(len(rows), 1) + 0.4 for rows in kinds]
    titles = (
        "what the gap follows (one after the other, shares add up)",
        "where the gap is large (overlapping, shares do not add up)",
    )
    with style():
        figure = canvas(figure, 10, 1.8 + 0.5 * sum(heights))
        panels = figure.subplots(2, 1, height_ratios=heights, sharex=True)
        for axes, rows, color, title in zip(panels, kinds, (BLUE, ORANGE), titles, strict=True):
            _shares(axes, rows, color)
            axes.set_title(title, loc="left")
        panels[-1].set_xlabel("share of the excess over the noise (%)")
        figure.suptitle("Where the gap lies")
    return figure


# beyond this share (percent) its number stands inside the bar
_NEAR_THE_EDGE = 93


def _shares(axes, rows, color):
    shares = [100 * row["share"] for row in rows]
    labels = [textwrap.fill(row["detail"], _WIDTH) for row in rows]
    axes.barh(range(len(rows)), shares, color=color, height=0.6)
    for i, share in enumerate(shares):
        inside = share > _NEAR_THE_EDGE
        ends = {"ha": "right", "color": "white" if color == BLUE else BLACK} if inside else {}
        axes.text(share, i, f"{share:.0f} " if inside else f" {share:.0f}", va="center", **ends)
    axes.set_yticks(range(len(rows)), labels=labels, fontsize=10)
    axes.set_ylim(max(len(rows), 1) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0, 100)
    if not len(rows):
        axes.set_yticks([])
        axes.text(0.5, 0.5, "nothing beyond the noise", transform=axes.transAxes, ha="center")
