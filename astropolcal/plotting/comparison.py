# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments and calibrations side by side."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.comparison import compare
from astropolcal.plotting._style import canvas, legend_outside, looks, style, wavelength_label

__all__ = ["plot_comparison"]

# fewer wavelengths than these are filters: nothing is known in between
_LEAST_SPECTRUM = 8


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
        angles. Spectra are lines, filters are points on dotted lines.

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
    rows = rows[np.argsort(rows["wavelength"])]
    lam, few = rows["wavelength"].to_value(u.nm), len(rows) < _LEAST_SPECTRUM
    settings = {"color": color, "marker": marker, "linestyle": ":" if few else "-"}
    settings |= {"markersize": 6.5 if few else 4.0}
    (handle,) = axes[0].plot(lam, rows["hwp_retardance"].to_value(u.deg), label=label, **settings)
    axes[1].plot(lam, rows["derotator_retardance"].to_value(u.deg), **settings)
    axes[2].plot(lam, 100 * np.asarray(rows["path_diattenuation"]), **settings)
    least, most = (np.asarray(rows[f"{key}_efficiency"]) for key in ("least", "most"))
    axes[3].plot(lam, least, **settings)
    axes[3].plot(lam, most, **settings | {"markerfacecolor": "white"})
    return handle


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
