# Licensed under a 3-clause BSD style license - see LICENSE
"""Colours, markers, sizes, and what else all figures have in common."""

from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal.exceptions import AstropolcalError
from astropolcal.files import atomic_path
from astropolcal.units import wavelengths_of

# Okabe & Ito (2008), distinct for all kinds of colour vision; yellow is too pale for lines, and the
# eighth is from P. Tol's "muted" scheme
BLUE, VERMILION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK = "#E69F00", "#56B4E9", "#000000"
COLORS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK, "#882255")
# one more than colours: the pairs repeat only after 72 series
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "h")
GREY = "0.45"
MINUS, SIGMA = "\N{MINUS SIGN}", "\N{GREEK SMALL LETTER SIGMA}"

_SHEET = Path(__file__).parents[1] / "data" / "figures.mplstyle"


@contextmanager
def canvas(figure, width, height, layout="constrained"):
    """Give the figure to draw into, in our style: the one given, or a new one of this size (inch).

    The user's settings come back after it.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(fname=_SHEET):
        if figure is None:
            figure = Figure(figsize=(width, height), layout=layout)
        elif isinstance(figure, Figure) and not (layout and figure.get_layout_engine()):
            # without it a legend cannot be kept outside the axes
            figure.set_layout_engine(layout)
        yield figure


def looks(count):
    """Return ``count`` pairs of colour and marker."""
    return list(islice(zip(cycle(COLORS), cycle(MARKERS), strict=False), count))


def save(figure, path, error=AstropolcalError):
    """Write a figure, atomically; raise ``error`` if the suffix is that of no known format."""
    path = Path(path)
    known = figure.canvas.get_supported_filetypes()
    if path.suffix.removeprefix(".").lower() not in known:
        raise error(f"{path}: the name must end with .{', .'.join(known)}")
    with atomic_path(path, error) as temporary:
        figure.savefig(temporary, dpi=150)
    return path


def heading(figure, calibration, what, names=None):
    """Title a figure with what it shows, of what, and whether the fit is to be trusted."""
    if names is None:
        if not hasattr(calibration, "datasets"):
            figure.suptitle(what)
            return
        names = [record.name for record in calibration.datasets]
    state = "" if calibration.converged else "  (FIT NOT CONVERGED)"
    # more than two names do not fit into a title
    of = ", ".join(names) if len(names) <= 2 else f"{len(names)} datasets"
    instrument = f"{calibration.instrument}: " if calibration.instrument else ""
    figure.suptitle(f"{what}{state}\n{instrument}{of}")


def legend_outside(figure, handles, *, place="outside lower center", title=None, columns=1):
    """Put a legend where it hides no data."""
    return figure.legend(handles=handles, loc=place, title=title, ncols=columns)


def nanometres(wavelength):
    """Return wavelengths in nm as floats, shape (n_wavelengths,)."""
    return np.atleast_1d(wavelengths_of(wavelength).to_value(u.nm))


def wavelength_label(axes):
    """Label the wavelength axis."""
    axes.set_xlabel("wavelength (nm)")


def draw_line(axes, lam, values, **look):
    """Draw values over the wavelength, which need not be in order; return the line."""
    # a marker is seen at a single wavelength, too
    drawn = (lam, values) if "marker" in look and np.size(lam) == 1 else widened(lam, values)
    (line,) = axes.plot(*drawn, **look)
    # an axis of wavelengths is one where no value is known, too
    axes.update_datalim([(x, 0) for x in drawn[0]], updatey=False)
    axes.autoscale_view(scaley=False)
    return line


def draw_band(axes, x, value, error, color, alpha, label=None):
    """Draw a band of one error to either side of values; it has gaps where the error is NaN."""
    x, value, error = widened(x, value, error)
    look = {"color": color, "alpha": alpha, "linewidth": 0, "label": label}
    axes.fill_between(x, value - error, value + error, **look)


def widened(x, *values):
    """Return what a line or a band is drawn of, in order; at one wavelength as long as a cell."""
    order = np.argsort(np.ravel(x))
    x = cell_edges(np.ravel(x)) if order.size == 1 else np.asarray(x)[order]
    values = (v[order] if np.ndim(v) and order.size > 1 else v for v in map(np.asarray, values))
    return x, *(np.broadcast_to(value, x.shape) for value in values)


def draw_points(axes, x, value, std, labels, **look):
    """Draw points with their errors, and hollow ones where there is none; labels of both."""
    known = np.isfinite(std)
    look |= {"linestyle": "none"}
    if known.any():
        axes.errorbar(x[known], value[known], yerr=std[known], label=labels[0], **look)
    if not known.all():
        look |= {"markerfacecolor": "white", "label": labels[1]}
        axes.plot(x[~known], value[~known], **look)


def note(axes, text, **look):
    """Write a sentence where there is nothing to draw."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", **look)


def degrees(angle):
    """Return an angle in degree as short text: ``11.25°``."""
    return f"{round(angle, 2):zg}°"


def rms(values, axis=None):
    """Return the root mean square of the known values, NaN where there is none."""
    return np.sqrt(mean_known(values**2, axis))


def mean_known(values, axis=0):
    """Return the mean of the known values, NaN where there are none."""
    # np.nanmean would warn of what is not known at all
    return np.ma.filled(np.ma.masked_invalid(values).mean(axis=axis), np.nan)


def cell_edges(centres):
    """Return the edges of cells half way between their centres, which ascend."""
    if len(centres) == 1:
        # one wavelength: a cell of a few percent, so that there is something to see
        return centres[0] * np.array([0.98, 1.02])
    middle = (centres[1:] + centres[:-1]) / 2
    first, last = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate([[first], middle, [last]])


def element_places(names):
    """Return ``optic.parameter`` with the places of its elements, in their order."""
    places = {}
    for i, name in enumerate(names):
        # one of a parameter given per wavelength is called optic.parameter[3]
        places.setdefault(name.split("[")[0], []).append(i)
    return places


def legend_entries(panels):
    """Return the handles of all panels by label, each label once."""
    entries = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    return entries


def grid(figure, count, columns, **share):
    """Return ``count`` panels in rows of ``columns``, and those with none below them."""
    panels = figure.subplots(-(-count // columns), columns, squeeze=False, **share).ravel()
    for empty in panels[count:]:
        empty.remove()
    lowest = panels[:count][-columns:]
    for axes in lowest:
        axes.tick_params(labelbottom=True)
    return panels[:count], lowest


def scale_axis(axes, values):
    """Use a logarithmic axis where the values need it, with plain numbers on it."""
    # zero stands for what is missing and has no logarithm
    known = values[np.isfinite(values) & (values > 0)]
    # where the largest is more than six times the smallest
    if known.size and known.max() > 6 * known.min():
        axes.set_yscale("log")
        axes.set_ylim(known.min() / 1.3, known.max() * 1.3)
        plain_numbers(axes)
    else:
        # values of similar size are compared by their lengths from zero
        axes.set_ylim(0, 1.08 * known.max() if known.size else None)


def plain_numbers(axes):
    """Write numbers on a logarithmic axis, and not only powers of ten, of which half has none."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def color_limit(values, covered):
    """Return the end of a colour scale that covers a share (%) of the values, and if all."""
    size = np.abs(values[np.isfinite(values)])
    # exact data would leave a scale of no width
    limit = max(np.percentile(size, covered), 1e-12)
    return limit, bool(size.max() > limit)


def draw_map(axes, values, nm, limit):
    """Draw residuals (percent, (W, N)) in the order of the wavelength; what is masked is grey."""
    order = np.argsort(nm)
    look = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit, "rasterized": True}
    axes.grid(False)
    axes.set_facecolor("0.75")
    axes.set_ylabel("wavelength (nm)")
    cells = np.ma.masked_invalid(values[order])
    return axes.pcolormesh(np.arange(len(values.T) + 1), cell_edges(nm[order]), cells, **look)


def color_bar(figure, drawn, panels, clipped, scale=";"):
    """Add the bar of one or several maps."""
    extend = "both" if clipped else "neither"
    bar = figure.colorbar(drawn, ax=panels, extend=extend, shrink=0.8, aspect=35)
    bar.set_label(f"observed {MINUS} model (%){scale} grey: no datum")


def name_groups(axes, ends, labels, label):
    """Name runs of data, which end at these numbers, below their middles, as far as they fit."""
    # rounded up, so that there are never more than twelve labels, which is what fits
    step = -(-len(ends) // 12)
    middles = (np.concatenate([[0], ends[:-1]]) + ends) / 2
    axes.set_xticks(middles[::step], labels=labels[::step])
    axes.tick_params(axis="x", length=0)
    axes.set_xlabel(label)
