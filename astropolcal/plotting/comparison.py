# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments and calibrations side by side."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.result.comparison import compare
from astropolcal.plotting._style import canvas, legend_outside, looks, style, wavelength_label

__all__ = ["plot_comparison"]

# fewer wavelengths than these are filters: nothing is known in between
_LEAST_SPECTRUM = 8
# panel, column, unit of the axis, and what differs from the look of the member
_DRAWN = (
    (0, "hwp_retardance", u.deg, {}),
    (1, "derotator_retardance", u.deg, {}),
    (2, "path_diattenuation", u.percent, {}),
    (3, "least_efficiency", u.one, {}),
    (3, "most_efficiency", u.one, {"markerfacecolor": "white"}),
)


def plot_comparison(members, *, title=None, figure=None):
    """
    Draw retardances, diattenuation and polarimetric efficiency of several instruments.

    Parameters
    ----------
    members : `~astropy.table.QTable`, sequence or dict
        The table of `~astropolcal.calibration.compare`, or what that takes.
    title : str, optional
        Title of the figure.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Against the wavelength: retardance of half-wave plate and of derotator, diattenuation
        of the path behind the telescope, and the range of the efficiency over the derotator
        angles. Spectra are lines, filters are points on dotted lines. Bars are standard errors of
        calibrations; where the data leave a value open, the bar goes through the whole panel.

    Examples
    --------
    >>> from astropolcal.plotting import plot_comparison
    >>> figure = plot_comparison(["charis", "irdis"])
    >>> [axes.get_ylabel() for axes in figure.axes][:2]
    ['retardance (deg)', 'retardance (deg)']
    """
    table = members if isinstance(members, QTable) else compare(members)
    labels = list(dict.fromkeys(str(label) for label in table["label"]))
    with style():
        fig = canvas(figure, 11.5, 8.2)
        axes = fig.subplots(2, 2, sharex=True).ravel()
        handles = [
            _draw(axes, table[table["label"] == label], label, *look)
            for label, look in zip(labels, looks(len(labels)), strict=True)
        ]
        _label(axes)
        legend_outside(fig, handles, columns=min(4, len(labels)))
        fig.suptitle(title or "Polarization optics behind the telescope")
    return fig


def _draw(axes, rows, label, color, marker):
    # tables hold the wavelengths as they were given, not in order
    rows = rows[np.argsort(rows["wavelength"])]
    lam, few = rows["wavelength"].to_value(u.nm), len(rows) < _LEAST_SPECTRUM
    settings = {"color": color, "marker": marker, "linestyle": ":" if few else "-"}
    settings |= {"markersize": 6.5 if few else 4.0}
    handles = []
    for panel, key, unit, look in _DRAWN:
        value, std = _column(rows, key, unit), _column(rows, f"{key}_std", unit)
        handles += axes[panel].plot(lam, value, label=label, **settings | look)
        _bars(axes[panel], lam, value, std, color)
    return handles[0]


def _column(rows, key, unit):
    """Return a column as plain numbers, NaN where a table of before there were errors has none."""
    if key not in rows.colnames:
        return np.full(len(rows), np.nan)
    return u.Quantity(rows[key]).to_value(unit)


def _bars(ax, lam, value, std, color):
    """Draw the standard errors; a value that the data leave open may be anywhere."""
    known = np.isfinite(value) & np.isfinite(std)
    if known.any():
        bars = {"color": color, "elinewidth": 1.2, "zorder": 3}
        ax.errorbar(lam[known], value[known], std[known], fmt="none", **bars)
    for x in lam[np.isinf(std)]:
        ax.axvline(x, color=color, linewidth=1.0, alpha=0.6)


def _label(axes):
    words = (
        ("half-wave plate", "retardance (deg)"),
        ("derotator", "retardance (deg)"),
        ("half-wave plate to beam splitter, at 0°", "diattenuation (%)"),
        (
            "efficiency: worst (filled) and best (open) derotator angle",
            "measured share of the polarization",
        ),
    )
    for ax, (title, ylabel) in zip(axes, words, strict=True):
        ax.set(title=title, ylabel=ylabel)
    axes[0].axhline(180, color="0.45", linewidth=0.9, linestyle="--")
    # what has none lies on the zero line, in full
    axes[2].set_ylim(bottom=-0.03 * axes[2].get_ylim()[1])
    axes[3].set_ylim(-0.02, 1.02)
    for ax in axes[2:]:
        wavelength_label(ax)
