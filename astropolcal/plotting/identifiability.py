# Licensed under a 3-clause BSD style license - see LICENSE
"""What the data determine, what they do not determine, and how parameters are correlated."""

import textwrap
from collections import namedtuple

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.analysis import _POOR, SETS, harmonic_conditions
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.exceptions import ParameterError
from astropolcal.plotting import _style as st
from astropolcal.units import angle_to_rad

__all__ = ["plot_correlations", "plot_identifiability"]

# a singular value and an error belong together if they agree to this share
_SAME = 0.05
# a condition number is 1 or more
_LEFT = 0.8
# what is named of a direction, as a share of its length, and at most so many
_WORTH_A_WORD, _MOST_NAMES = 0.15, 3
_COLUMNS = 125


# a direction: its name, its loadings (length 1), and what it is in words
_Row = namedtuple("_Row", "name loadings words")


def plot_identifiability(calibration, *, weakest=3, hwp=None, figure=None):
    r"""
    Draw what the data determine, and along which directions they determine little.

    (a) The singular values of the whitened derivative of the data, with parameters in steps of a
    degree, a micrometre or a percent; those below the threshold of the rank are open directions. On
    the right stands the standard error along each direction. (b) What takes part in each open
    direction and in the most weakly determined ones; a direction has length 1, and parameters given
    per wavelength are summed in squares. (c) How well the half-wave-plate angles tell harmonics
    apart.

    Parameters
    ----------
    calibration : Calibration or Identifiability
        What was found. A calibration that was read from a file has no angles, and an
        ``Identifiability`` alone has no errors: panels then show what there is.
    weakest : int
        How many of the determined directions to show, those with the largest errors; more
        where more are called badly determined.
    hwp : `~astropy.units.Quantity`, optional
        Half-wave-plate angles; by default those of the calibration's data.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If there is no free parameter, or the angles or the number are not possible.

    Examples
    --------
    >>> from astropolcal.plotting import plot_identifiability
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> plot_identifiability(cal).axes[0].get_title()
    '(a) 49 of 49 combinations determined, none open'
    """
    finding = getattr(calibration, "identifiability", calibration)
    if not finding.n_free:
        raise ParameterError("no free parameter, so nothing to identify")
    if weakest < 0:
        raise ParameterError(f"weakest = {weakest}; allowed are numbers from 0")
    known = _errors(calibration)
    weak = _weak_rows(finding, known, weakest)
    rows = [*_open_rows(finding), *weak]
    angles = _angles(calibration, hwp)
    words = []
    for row in (row for row in rows if row.words):
        words += textwrap.wrap(f"{row.name}: {row.words}", _COLUMNS, subsequent_indent=" " * 5)
    heights = (3.4, 0.9 + 0.42 * max(len(rows), 1), 0.15 + 0.165 * len(words))
    with st.canvas(figure, 11.0, sum(heights) + 1.6) as figure:
        grid = figure.add_gridspec(3, 2, height_ratios=heights, width_ratios=(3, 2))
        _draw_values(figure.add_subplot(grid[0, 0]), finding, known, len(weak))
        _draw_conditions(figure.add_subplot(grid[0, 1]), finding, angles)
        _draw_loadings(figure, figure.add_subplot(grid[1, :]), finding, rows)
        below = figure.add_subplot(grid[2, :])
        below.axis("off")
        where = {"transform": below.transAxes, "va": "top", "ha": "left"}
        below.text(0, 1, "\n".join(words), fontsize=9, linespacing=1.3, **where)
        st.heading(figure, calibration, "What the data determine")
    return figure


# ---- the directions ------------------------------------------------------------------------


def _errors(calibration):
    """Return steps, directions and standard errors, the largest last; None without a covariance."""
    covariance = getattr(calibration, "covariance", None)
    if covariance is None:
        return None
    axes = covariance._axes()
    order = np.argsort(axes.sigmas, kind="stable")
    order = order[axes.sigmas[order] > 0]
    return covariance, axes.known[order], axes.sigmas[order]


def _open_rows(finding):
    """Return the open directions in the order, and led by the parameter, of their words."""
    null = np.asarray(finding.null_vectors).reshape(-1, finding.n_free)
    words = [direction["words"] for direction in finding.directions]
    leads = [text.split(" ", 1)[0] for text in words]
    if len(words) != len(null) or not set(leads) <= set(finding.names):
        words = [""] * len(null)
    elif words:
        null = np.linalg.solve(null[:, [finding.names.index(lead) for lead in leads]], null)
    return [
        _Row(f"open {i + 1}", vector / np.linalg.norm(vector), text)
        for i, (vector, text) in enumerate(zip(null, words, strict=True))
    ]


def _weak_rows(finding, known, count):
    """Return the determined directions with the largest errors, the largest first."""
    if known is None:
        return []
    covariance, vectors, sigmas = known
    near_null = list(getattr(finding, "near_null", []))
    # more of those that are nearly open, up to six
    count = max(count, min(len(near_null), 6))
    rows = []
    for vector, sigma in list(zip(vectors, sigmas, strict=True))[::-1][:count]:
        vector = vector * np.sign(vector[ranked(np.abs(vector))[0]])
        words = _near_null_words(near_null, finding.names, covariance.units, vector)
        name = f"{'badly determined' if words else 'largest error'} {len(rows) + 1}"
        words = words or _weak_words(finding.names, covariance.units, vector, sigma)
        rows.append(_Row(name, vector, words))
    return rows


def _near_null_words(near_null, names, units, vector):
    """Return the words of the near-null direction that this is, or none."""
    places = st.element_places(names)
    for direction in near_null:
        change = np.zeros(len(names))
        for name, value in direction["parameters"].items():
            at = [names.index(name)] if name in names else places[name]
            change[at] = np.asarray(value) / (0.01 if units[at[0]] is None else 1.0)
        # by the cosine between them
        if abs(change @ vector) > 0.9 * np.linalg.norm(change):
            return direction["words"]
    return ""


def _weak_words(names, units, vector, sigma):
    """Say what a step of one standard error along a direction changes."""
    parts = []
    for stem, places in st.element_places(names).items():
        part = vector[places]
        size = np.linalg.norm(part)
        if size > _WORTH_A_WORD:
            unit, typical = units[places[0]], sigma * size / np.sqrt(len(part))
            is_angle = unit is not None and u.Unit(unit).is_equivalent(u.deg)
            unit = "%" if unit is None else "deg" if is_angle else "µm"
            words = f"{stem} by {sigma * part[0]:+.2g} {unit}"
            if len(part) > 1:
                words = f"{stem} by {typical:.2g} {unit} (rms of {len(part)} wavelengths)"
            parts.append((size, words))
    named = [text for _, text in sorted(parts, reverse=True)]
    more = f" and {len(named) - _MOST_NAMES} more" if len(named) > _MOST_NAMES else ""
    return f"1{st.SIGMA} changes {', '.join(named[:_MOST_NAMES])}{more}"


# ---- (a) singular values ---------------------------------------------------------------------


def _draw_values(axes, finding, known, n_weak):
    values, rank = np.asarray(finding.singular_values), finding.rank
    index, n_open = np.arange(1, len(values) + 1), len(values) - rank
    largest = values.max(initial=0.0) or 1.0
    # the limit of the rank, between the values that it parts
    between = (values[rank] if n_open else 0.0, values[rank - 1] if rank else largest)
    # singular values below this share of the largest count as zero
    threshold = float(np.clip(1e-9 * largest, *between)) or 1e-12
    # singular values and errors go together where the data count as independent
    sigmas = np.empty(0) if known is None or not rank else known[2]
    if len(sigmas):
        ratio = (sigmas.max() / sigmas.min()) / (largest / values[:rank].min())
        sigmas = sigmas if abs(np.log(ratio)) < _SAME else sigmas[:0]
    is_weak = np.zeros(rank, dtype=bool)
    for sigma in sigmas[len(sigmas) - n_weak :] if len(sigmas) else ():
        # with priors or bounds the errors may have directions of their own
        off = np.abs(np.log(values[:rank] * sigma / (sigmas.min() * largest)))
        is_weak[off.argmin()] |= off.min() < _SAME
    low = threshold / 30 if n_open else values[rank - 1] / 3
    axes.set_yscale("log")
    kinds = ((~is_weak, "o", st.BLUE, "determined"), (is_weak, "s", st.ORANGE, "shown in (b)"))
    for which, marker, color, label in kinds:
        if which.any():
            axes.plot(index[:rank][which], values[:rank][which], marker, color=color, label=label)
    if n_open:
        # at their true values, a rounding error, they would press all others together
        worst = values[rank:].max()
        rounding = f"at most {worst:.1g}" if worst > 0 else "exactly zero"
        label = f"{n_open} open: {rounding} (below the axis)"
        at_edge = {"color": st.VERMILION, "label": label, "clip_on": False, "zorder": 3}
        axes.plot(index[rank:], np.full(n_open, low), "v", **at_edge)
        axes.axhline(
            threshold, color=st.BLACK, linestyle="--", linewidth=1, label="limit of the rank"
        )
    axes.set_title(
        f"(a) {rank} of {finding.n_free} combinations determined, {n_open or 'none'} open"
    )
    axes.set_xlabel("direction, the best determined first")
    axes.set_ylabel("singular value\n(data per deg, µm or %)")
    axes.set(xlim=(0, len(values) + 1), ylim=(low, largest * 3))
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(loc="center left" if n_open else "lower left")
    if len(sigmas):
        _add_error_axis(axes, sigmas.min() * largest, threshold if n_open else low)


def _add_error_axis(axes, noise, lowest):
    """Show on the right the standard error along a determined direction: noise over its value."""

    def convert(value):
        return noise / np.maximum(value, 1e-300)

    right = axes.secondary_yaxis("right", functions=(convert, convert))
    first, last = (np.log10(convert(value)) for value in (axes.get_ylim()[1], lowest))
    # none at the open directions, which have no error
    decades = np.arange(np.ceil(first), np.floor(last) + 1)
    right.set_yticks(10.0**decades)
    right.minorticks_off()
    right.set_ylabel("standard error (deg, µm or %)")


# ---- (b) loadings ---------------------------------------------------------------------------


def _draw_loadings(figure, axes, finding, rows):
    title = "(b) parameters that take part in each direction; (n): norm over n wavelengths"
    axes.set_title(title, loc="left")
    if not rows:
        _say(axes, "no open direction; errors are not known")
        return
    places = st.element_places(finding.names)
    # signed of a single parameter, the norm of one given per wavelength
    parts = [[row.loadings[at] for at in places.values()] for row in rows]
    table = np.array([[p[0] if len(p) == 1 else np.linalg.norm(p) for p in row] for row in parts])
    image = axes.imshow(np.abs(table), cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.grid(False)
    labels = [f"{n} ({len(at)})" if len(at) > 1 else n for n, at in places.items()]
    look = {"rotation": 30, "ha": "right", "rotation_mode": "anchor", "fontsize": 9.5}
    axes.set_xticks(range(len(labels)), labels, **look)
    axes.set_yticks(range(len(rows)), [row.name for row in rows])
    axes.tick_params(length=0)
    signs = ["+" if len(at) == 1 else "-" for at in places.values()]
    for i, j in zip(*np.nonzero(np.abs(table) > 0.02), strict=True):
        _write(axes, j, i, table[i, j], signs[j])
    n_open = sum(row.name.startswith("open") for row in rows)
    if 0 < n_open < len(rows):
        axes.axhline(n_open - 0.5, color=st.BLACK, linewidth=1)
    figure.colorbar(image, ax=axes, pad=0.01, label="|loading|")


def _write(axes, x, y, value, sign="-"):
    """Write a number into its cell, in white on dark ground."""
    color = "white" if abs(value) > 0.6 else "black"
    text = f"{value:{sign}.2f}".replace("-", st.MINUS)
    axes.text(x, y, text, color=color, ha="center", va="center", fontsize=9)


# ---- (c) half-wave-plate angles ---------------------------------------------------------------


def _angles(calibration, hwp):
    """Return the different half-wave-plate angles in radian, or None where not known."""
    measurement = getattr(calibration, "measurement", None)
    if hwp is not None:
        angles = [np.atleast_1d(angle_to_rad(hwp, "hwp"))]
    elif measurement is None:
        return None
    else:
        angles = [dataset.observations.position("hwp") for dataset in measurement.datasets]
    return np.unique(np.round(np.concatenate(angles), 6))


def _draw_conditions(axes, finding, angles):
    axes.set_title("(c) half-wave-plate angles")
    if angles is None:
        # stars that would help have no room here
        own = [text for text in finding.sampling if text.startswith("half-wave-plate angles")]
        lines = [line for text in own for line in textwrap.wrap(text, 40)]
        _say(axes, "\n".join(lines) or "half-wave-plate angles are not known")
        return
    found = harmonic_conditions(angles)
    values = np.array([found[harmonics] for harmonics, _ in SETS])
    top = 10 * max(values[np.isfinite(values)].max(initial=_POOR), _POOR)
    for i, value in enumerate(values):
        look = {"color": st.BLUE} if value <= _POOR else {"color": st.VERMILION, "hatch": "//"}
        length = min(value, top)
        axes.barh(i, length - _LEFT, left=_LEFT, edgecolor="white", height=0.55, **look)
        if np.isfinite(value):
            axes.text(length, i, f" {value:.2g}", va="center")
        else:
            paper = {"facecolor": "white", "edgecolor": "none", "pad": 1}
            axes.text(1.1, i, " \N{INFINITY}: too few angles", va="center", bbox=paper)
    axes.axvline(_POOR, color=st.BLACK, linestyle="--", linewidth=1)
    axes.text(_POOR, -0.62, " poor beyond", va="center", fontsize=9.5, color=st.GREY)
    axes.set(xscale="log", xlim=(_LEFT, top * 8), ylim=(len(values) - 0.5, -0.9))
    names = ["harmonics " + ", ".join(map(str, harmonics)) for harmonics, _ in SETS]
    axes.set_yticks(range(len(SETS)), names)
    axes.set_xlabel(f"condition number ({len(angles)} angles)")
    axes.grid(False, axis="y")


def _say(axes, text):
    """Write a sentence where there is nothing to draw."""
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    st.note(axes, text, fontsize=9)


# ---- correlations ---------------------------------------------------------------------------
_SIZE, _MARGIN = 8.5, 2.6


def plot_correlations(calibration, *, figure=None):
    """
    Draw the correlation matrix of the free parameters.

    Parameters given per wavelength form a block, short wavelengths first; those common to all
    wavelengths are drawn wider. Parameters without an error, because the data do not determine them
    or because they sit at a bound, have no correlations: they are listed below the matrix.

    Parameters
    ----------
    calibration : Calibration, Resampled or Covariance
        What has the covariance; a calibration read from a file will do.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If there is no free parameter.

    Examples
    --------
    >>> from astropolcal.plotting import plot_correlations
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> len(plot_correlations(cal).axes)
    2
    """
    covariance = getattr(calibration, "covariance", calibration)
    if not len(covariance):
        raise ParameterError("no free parameter, so no correlation to draw")
    with np.errstate(invalid="ignore"):
        matrix = covariance.correlation
    known = np.isfinite(np.diag(matrix))
    groups, left_out = _by_stem(covariance.names, known), _by_stem(covariance.names, ~known)
    matrix = matrix[np.ix_(known, known)]
    with st.canvas(figure, _SIZE + _MARGIN, _SIZE + 1.4) as figure:
        axes = figure.add_subplot()
        st.heading(figure, calibration, "Correlations of the parameters")
        if left_out:
            named = ", ".join(_labels(left_out))
            words = f"not shown, as the data do not determine them or at a bound: {named}"
            figure.supxlabel(textwrap.fill(words, _COLUMNS), fontsize="medium")
        if not groups:
            _say(axes, "no parameter has an error by itself")
            return figure
        several = any(count > 1 for _, count in groups)
        # a parameter common to all wavelengths is drawn this much wider than one of a wavelength
        widths = [np.full(n, 4.0 if n == 1 and several else 1.0) for _, n in groups]
        edges = np.concatenate([[0.0], np.cumsum(np.concatenate(widths))])
        axes.grid(False)
        look = {"cmap": "RdBu_r", "vmin": -1, "vmax": 1, "rasterized": True}
        image = axes.pcolormesh(edges, edges, matrix, **look)
        axes.set(xlim=(0, edges[-1]), ylim=(edges[-1], 0), aspect="equal")
        # every group is named in its middle, and parted from the next
        ends = edges[np.cumsum([0] + [count for _, count in groups])]
        places = (ends[1:] + ends[:-1]) / 2
        turned = {"rotation": 45, "ha": "right", "rotation_mode": "anchor"}
        axes.set_xticks(places, _labels(groups), **turned)
        axes.set_yticks(places, _labels(groups))
        axes.tick_params(length=0)
        for border in ends[1:-1]:
            axes.axhline(border, color="0.25", linewidth=0.6)
            axes.axvline(border, color="0.25", linewidth=0.6)
        middles = (edges[1:] + edges[:-1]) / 2
        for i, j in zip(*np.nonzero(np.isfinite(matrix)), strict=True):
            # numbers are written into the cells of a matrix that is not larger than this
            if len(matrix) <= 12:
                _write(axes, middles[j], middles[i], matrix[i, j])
        figure.colorbar(image, ax=axes, shrink=0.7, pad=0.02, label="correlation")
    return figure


def _by_stem(names, which):
    """Return name and number of the parameters that are marked, those of wavelengths together."""
    places = st.element_places(names).items()
    return [(stem, int(which[at].sum())) for stem, at in places if which[at].any()]


def _labels(groups):
    return [f"{stem} ({count})" if count > 1 else stem for stem, count in groups]
