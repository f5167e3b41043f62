# Licensed under a 3-clause BSD style license - see LICENSE
"""Quick look at a reduced run: apertures over images, and the run over time."""

from pathlib import Path

import numpy as np

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.files import understood
from astropolcal.plotting import _style as st
from astropolcal.reduction.cubes import BEAMS
from astropolcal.reduction.frames import open_cube

__all__ = ["plot_apertures"]

_COLORS = {"right": st.VERMILION, "left": st.BLUE}
_LINES = {"right": "-", "left": "--"}
_MARKERS = {"right": "o", "left": "s"}
_MAX_PANELS = 12
# yellow, where a pixel has no value
_GAP = "#F0E442"


def plot_apertures(reduction, *, frames=None, wavelength=None, figure=None):
    """
    Draw the apertures over the images of some frames, one panel each.

    Parameters
    ----------
    reduction : Reduction
        The run; the cubes are read again.
    frames : sequence of int, optional
        Indices of frames; by default up to twelve, evenly spaced over the run.
    wavelength : int, optional
        Index of the slice; by default the middle one.
    figure : `~matplotlib.figure.Figure`, optional
        Where to draw.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If an index is out of range.

    Examples
    --------
    >>> from astropolcal.plotting.reduction import plot_apertures
    >>> from astropolcal.reduction import Reduction
    >>> plot_apertures(Reduction(None, "star"))
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ParameterError: the reduction has no frames
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    chosen = _chosen(reduction, frames)
    k, at = _slice(reduction, wavelength)
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    with st.canvas(figure, 3.1 * columns + 0.9, 3.2 * rows + 1.2) as figure:
        axes, lowest = st.grid(figure, len(chosen), columns, sharex=True, sharey=True)
        gaps = [_draw_frame(*panel, reduction, k) for panel in zip(axes, chosen, strict=True)]
        for panel in lowest:
            panel.set_xlabel("x (pixel)")
        for panel in axes[::columns]:
            panel.set_ylabel("y (pixel)")
        count = f"{len(chosen)} of {len(reduction.frames)} frames"
        figure.suptitle(f"Apertures at {at} ({count}; square-root scale)")
        handles = [
            Line2D([], [], color=_COLORS[b], ls=_LINES[b], lw=1.8, label=f"{b} beam") for b in BEAMS
        ]
        if reduction.source == "star":
            handles.append(Line2D([], [], color="0.35", ls=":", lw=1.4, label="background ring"))
        if any(gaps):
            handles.append(Patch(fc=_GAP, ec="0.5", label="no value"))
        st.legend_outside(figure, handles, columns=4)
    return figure


def _chosen(reduction, frames):
    count = len(reduction.frames)
    if not count:
        raise ParameterError("the reduction has no frames")
    if frames is None:
        return np.unique(np.linspace(0, count - 1, min(count, _MAX_PANELS)).round().astype(int))
    chosen = np.atleast_1d(np.asarray(frames, dtype=int))
    if chosen.size == 0 or chosen.min() < 0 or chosen.max() >= count:
        raise ParameterError(f"frames = {chosen.tolist()}; allowed are 0 to {count - 1}")
    return chosen


def _slice(reduction, wavelength):
    """Return the index of a slice, by default the middle one, and its wavelength in words."""
    grid = reduction.instrument.wavelength
    k = len(grid) // 2 if wavelength is None else int(wavelength)
    if not 0 <= k < len(grid):
        raise ParameterError(f"wavelength = {k}; allowed are 0 to {len(grid) - 1}")
    return k, f"{grid[k].to_value('nm'):.0f} nm"


def _draw_frame(panel, index, reduction, k):
    """Draw one panel; return whether pixels lack a value."""
    frame = reduction.frames[index]
    layout = reduction.instrument.files
    with open_cube(frame.path, layout, reduction.masters) as (_, _, cube, good):
        image = np.array(cube[k], dtype=float)
        image[~good[k]] = np.nan
    _draw_image(panel, image)
    if reduction.source == "star":
        from matplotlib.patches import Circle

        ring = reduction.options.get("annulus", 5.0)
        for beam, name in enumerate(BEAMS):
            r, x, y = (getattr(frame.photometry, key)[beam, k] for key in ("radius", "x", "y"))
            # a spot that was not found has neither centre nor radius
            if r > 0 and (x, y) != (0.0, 0.0):
                look = {"fill": False, "ec": _COLORS[name]}
                panel.add_patch(Circle((x, y), r, ls=_LINES[name], lw=1.6, **look))
                panel.add_patch(Circle((x, y), r + ring, ls=":", lw=1.2, **look))
    else:
        from matplotlib.patches import Rectangle

        left, right, width, height, angle = layout.internal_apertures
        for name, (x, y) in (("right", right), ("left", left)):
            look = {"fill": False, "ec": _COLORS[name], "ls": _LINES[name], "lw": 1.6}
            look |= {"angle": np.rad2deg(angle), "rotation_point": "center"}
            # matplotlib counts from a corner, the layout from the centre
            panel.add_patch(Rectangle((x - width / 2, y - height / 2), width, height, **look))
    reason = frame.photometry.reasons[k]
    label = f"frame {index}: hwp {frame.values['hwp']:g}°, der. {frame.values['derotator']:.4g}°"
    panel.set_title(label + (f"\nMASKED: {reason}" if reason else ""), fontsize=9)
    panel.grid(False)
    return bool(np.isnan(image).any())


def _draw_image(panel, image):
    from matplotlib.colors import PowerNorm

    known = image[np.isfinite(image)]
    if not known.size:
        panel.text(0.5, 0.5, "no values", transform=panel.transAxes, ha="center")
        return
    # a few hot pixels must not hide the spots, nor a few dead ones the background
    low, high = np.percentile(known, (2, 99.8))
    # square root: wings and core of a star in one picture
    norm = PowerNorm(0.5, vmin=low, vmax=max(high, low + 1e-12), clip=True)
    drawn = panel.imshow(image, origin="lower", cmap="gray_r", norm=norm, interpolation="nearest")
    drawn.set_cmap(drawn.cmap.with_extremes(bad=_GAP))


def plot_run(reduction, *, wavelength=None, figure=None):
    """Draw fluxes, single differences, and places and widths of stars over the run."""
    _chosen(reduction, None)
    k, at = _slice(reduction, wavelength)
    star = reduction.source == "star"
    clock, label = _clock(reduction.frames)
    with st.canvas(figure, 9.0, 11.0 if star else 6.0) as figure:
        axes = figure.subplots(5 if star else 2, 1, sharex=True)
        _draw_fluxes(axes[0], axes[1], reduction, clock, k)
        labels = f"x {st.MINUS} median\n(pixel)", f"y {st.MINUS} median\n(pixel)", "FWHM (pixel)"
        for panel, key, words in zip(axes[2:], ("x", "y", "fwhm"), labels, strict=False):
            panel.set_ylabel(words)
            for values, name in zip(_cells(reduction, k, key), BEAMS, strict=True):
                # centres of both beams are far apart; their motion is what is looked for
                if key != "fwhm" and np.isfinite(values).any():
                    values = values - np.nanmedian(values)
                panel.plot(clock, values, **_look(name))
        axes[-1].set_xlabel(label)
        figure.suptitle(f"The run at {at}")
        figure.align_ylabels()
        st.legend_outside(figure, list(st.legend_entries(axes[:2]).values()), columns=4)
    return figure


def _clock(frames):
    """Return when the frames were taken and the label of that axis."""
    times = [frame.values.get("mjd") for frame in frames]
    # headers without times, or all the same: number the frames
    if None in times or np.ptp(times) == 0:
        return np.arange(len(frames)), "frame"
    # days of the modified Julian date to minutes
    minutes = (np.array(times) - min(times)) * 1440.0
    return minutes, "time since the first frame (min)"


def _cells(reduction, k, name):
    """Return an array of the photometry over the run, (..., F), NaN where a cell failed."""
    values = np.array([getattr(frame.photometry, name)[..., k] for frame in reduction.frames]).T
    failed = np.array([bool(frame.photometry.reasons[k]) for frame in reduction.frames])
    # a frame that was masked has numbers, which mean nothing
    return np.where(failed, np.nan, values)


def _draw_fluxes(top, below, reduction, clock, k):
    flux = _cells(reduction, k, "flux")
    error = np.sqrt(_cells(reduction, k, "variance"))
    for beam, name in enumerate(BEAMS):
        look = _look(name) | {"label": f"{name} beam"}
        top.errorbar(clock, flux[beam], error[beam], lw=0, elinewidth=1.2, **look)
    top.set_ylabel(f"flux ({reduction.frames[0].unit})")
    total = flux.sum(axis=0)
    # d[(R - L) / (R + L)] = 2 (L dR - R dL) / (R + L)^2, and both have one background
    variance = np.sum((flux[::-1] * error) ** 2, axis=0)
    variance -= 2 * flux.prod(axis=0) * _cells(reduction, k, "covariance")
    scatter = 2 * np.sqrt(variance.clip(0)) / total**2
    single = (flux[0] - flux[1]) / total
    look = {"fmt": "D", "color": st.GREEN, "ms": 5, "lw": 0, "elinewidth": 1.2}
    below.errorbar(clock, single, scatter, label="single difference", **look)
    below.axhline(0.0, color="0.6", lw=0.8)
    below.set_ylabel(f"(right {st.MINUS} left) /\n(right + left)")
    failed = clock[np.isnan(flux[0])]
    for axes in (top, below) if failed.size else ():
        # at the foot of the panel, whatever the fluxes are
        look = {"color": st.BLACK, "transform": axes.get_xaxis_transform()}
        axes.plot(failed, np.full(failed.size, 0.05), "x", label="masked frame", **look)


def _look(name):
    """Return the look of a beam's points; the left one is open, for the two often coincide."""
    fill = {"mfc": "none", "ms": 8} if name == "left" else {"ms": 5}
    return {"color": _COLORS[name], "marker": _MARKERS[name], "ls": ""} | fill


def save_quicklook(reduction, folder):
    """Write ``apertures.png`` and ``run.png`` of a run to a folder; return their paths."""
    folder, beams = Path(folder), reduction.instrument.files.beams
    if tuple(beams) != BEAMS:
        raise ParameterError(f"figures of the beams {', '.join(beams)}; they are of right and left")
    with understood(folder, ObservationError, "cannot be made", reads=False):
        folder.mkdir(parents=True, exist_ok=True)
    plots = {"apertures.png": plot_apertures, "run.png": plot_run}
    return [st.save(plot(reduction), folder / n, ObservationError) for n, plot in plots.items()]
