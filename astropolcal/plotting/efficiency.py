# Licensed under a 3-clause BSD style license - see LICENSE
"""What instruments can measure: polarimetric efficiency, optics side by side."""

from functools import partial

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.result.comparison import compare
from astropolcal.chain import stages
from astropolcal.efficiency import has_derotator, polarimetric_efficiency
from astropolcal.plotting import _style as st

__all__ = ["plot_comparison"]

_DEROTATOR = np.arange(0, 181, 2.5)
_ALTITUDE = np.arange(20, 91, 5.0)
_PARALLACTIC = np.arange(-180, 181, 10.0)
# fewer wavelengths than these are filters: nothing is known in between
_LEAST_SPECTRUM = 8
# white contours on the dark end of the colours, black ones on the bright end
_LEVELS = (0.2, 0.4, 0.6, 0.8, 0.9)
_SHARE = "measured share of the polarization"


def plot_polarimetric_efficiency(
    chain,
    wavelength,
    *,
    altitude=60 * u.deg,
    parallactic=0 * u.deg,
    derotator=90 * u.deg,
    shown=None,
    title=None,
    figure=None,
    **settings,
):
    """Draw the polarimetric efficiency of an instrument, see `polarimetric_efficiency`.

    Lines against the derotator angle, at the ``shown`` wavelengths or six; a map of derotator angle
    and wavelength; for a chain from the sky a map of parallactic angle and altitude at this
    ``derotator`` angle: the least over the wavelengths. Without a derotator there are lines against
    the parallactic angle, or against the wavelength downstream of an internal source.
    """
    lam, moving = st.nanometres(wavelength), stages(chain)
    at = {"altitude": altitude, "parallactic": parallactic}
    at = {key: angle for key, angle in at.items() if key in moving}
    asked = partial(polarimetric_efficiency, chain, wavelength, **settings)
    # without an altitude axis there is no pointing to map
    turns, maps = has_derotator(chain), "altitude" in at
    panels = (2 if turns else int(not maps)) + maps
    with st.canvas(figure, 5.5 * panels + 0.5 * (panels < 2), 5.2) as fig:
        axes = list(fig.subplots(1, panels, squeeze=False)[0])
        if turns:
            values = asked(derotator=_DEROTATOR * u.deg, **at)
            _lines(axes[0], lam, _DEROTATOR, values, shown)
            axes[0].set(xlabel="derotator angle (deg)", xlim=(0, 180), xticks=np.arange(0, 181, 45))
            _map_of_wavelengths(fig, axes[1], lam, values)
            axes[1].set_title("as on the left, all wavelengths")
            words = {"altitude": "altitude", "parallactic": "parallactic angle"}
            where = ", ".join(f"{words[key]} {_degree(angle)}" for key, angle in at.items())
            axes[0].set_title(where or "downstream of the internal source")
        elif not maps:
            ax = axes[0]
            if "parallactic" in at:
                angles = np.arange(-180, 181, 5.0)
                _lines(ax, lam, angles, asked(parallactic=angles * u.deg), shown)
                ax.set(xlabel="parallactic angle (deg)", xlim=(-180, 180))
                ax.set(xticks=np.arange(-180, 181, 90))
            else:
                st.draw_line(ax, lam, np.atleast_2d(asked())[0], marker="o")
                ax.set(xlabel="wavelength (nm)", ylabel=_SHARE, ylim=(0, 1.02))
        if maps:
            _map_of_pointings(fig, axes[-1], asked, derotator if turns else None)
        fig.suptitle(title or "Polarimetric efficiency")
    return fig


def _degree(angle):
    return f"{u.Quantity(angle).to_value(u.deg):g}°"


def _lines(ax, lam, angles, values, shown):
    if shown is None:
        rows = np.unique(np.linspace(0, lam.size - 1, min(6, lam.size)).astype(int))
    else:
        # two wavelengths asked for may be nearest to the same one
        rows = np.unique(np.abs(st.nanometres(shown)[:, None] - lam).argmin(axis=1))
    for (color, marker), row in zip(st.looks(len(rows)), rows, strict=True):
        # markers tell the lines apart without colour; at all points they would be a band
        look = {"color": color, "marker": marker, "markevery": 6, "label": f"{lam[row]:.0f} nm"}
        ax.plot(angles, values[:, row], **look)
    ax.set(ylabel=_SHARE, ylim=(0, 1.02))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)


def _map_of_wavelengths(fig, ax, lam, values):
    order = np.argsort(lam)
    # between a few filters there is nothing to interpolate
    filters = lam.size < _LEAST_SPECTRUM
    y, values = np.arange(lam.size) if filters else lam[order], values.T[order]
    # cells between edges: the one of a single wavelength has no neighbours that tell its size
    edges = np.arange(lam.size + 1) - 0.5 if filters else st.cell_edges(y)
    # 0 to 1 in all maps of wavelengths, so that colours of two instruments mean the same
    look = {"cmap": "cividis", "vmin": 0, "vmax": 1}
    mesh = ax.pcolormesh(st.cell_edges(_DEROTATOR), edges, values, **look)
    for levels, color in () if filters else ((_LEVELS[:3], "white"), (_LEVELS[3:], "black")):
        # a level that no value reaches is no fault
        inside = [level for level in levels if values.min() < level < values.max()]
        if inside:
            look = {"levels": inside, "colors": color, "linewidths": 0.8}
            ax.clabel(ax.contour(_DEROTATOR, y, values, **look), fmt="%g", fontsize=9)
    ax.grid(False)
    if filters:
        ax.set_yticks(y, [f"{value:.0f}" for value in lam[order]])
    ax.set(xlabel="derotator angle (deg)", ylabel="wavelength (nm)", xticks=np.arange(0, 181, 45))
    fig.colorbar(mesh, ax=ax, label=_SHARE)


def _map_of_pointings(fig, ax, asked, derotator):
    pointing = {"altitude": _ALTITUDE[:, None] * u.deg, "parallactic": _PARALLACTIC * u.deg}
    values = asked(derotator=derotator, **pointing).min(axis=-1)
    mesh = ax.pcolormesh(_PARALLACTIC, _ALTITUDE, values, cmap="cividis", shading="nearest")
    # the cells of the last row reach beyond the zenith
    ax.set_ylim(_ALTITUDE[0], 90)
    ax.set(xlabel="parallactic angle (deg)", ylabel="altitude (deg)")
    ax.set(xticks=np.arange(-180, 181, 90))
    turned = "" if derotator is None else f"derotator at {_degree(derotator)}, "
    ax.set_title(f"{turned}worst wavelength")
    fig.colorbar(mesh, ax=ax, label=_SHARE)


# ---- instruments side by side ------------------------------------------------------------------
# panel, column, unit of the axis, and what differs from the look of the member
_DRAWN = (
    (0, "hwp_retardance", u.deg, {}),
    (1, "derotator_retardance", u.deg, {}),
    (2, "path_diattenuation", u.percent, {}),
    (3, "least_efficiency", u.one, {}),
    (3, "most_efficiency", u.one, {"markerfacecolor": "white"}),
)
# of each panel
_TITLES = (
    ("half-wave plate", "retardance (deg)"),
    ("derotator", "retardance (deg)"),
    ("half-wave plate to beam splitter, at 0°", "diattenuation (%)"),
    ("efficiency: worst (filled) and best (open) derotator angle", _SHARE),
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
        of the path downstream of the telescope, and the range of the efficiency over the derotator
        angles. Spectra are lines, filters are points on dotted lines. Bars are standard errors of
        calibrations; where the data do not determine a value, the bar goes through the whole panel.

    Examples
    --------
    >>> from astropolcal.plotting import plot_comparison
    >>> figure = plot_comparison(["charis", "irdis"])
    >>> [axes.get_ylabel() for axes in figure.axes][:2]
    ['retardance (deg)', 'retardance (deg)']
    """
    table = members if isinstance(members, QTable) else compare(members)
    labels = list(dict.fromkeys(str(label) for label in table["label"]))
    with st.canvas(figure, 11.5, 8.2) as fig:
        axes = fig.subplots(2, 2, sharex=True).ravel()
        handles = [
            _draw_member(axes, table[table["label"] == label], label, *look)
            for label, look in zip(labels, st.looks(len(labels)), strict=True)
        ]
        for ax, (title_of, ylabel) in zip(axes, _TITLES, strict=True):
            ax.set(title=title_of, ylabel=ylabel)
        axes[0].axhline(180, color="0.45", linewidth=0.9, linestyle="--")
        # what has none lies on the zero line, in full
        axes[2].set_ylim(bottom=-0.03 * axes[2].get_ylim()[1])
        axes[3].set_ylim(-0.02, 1.02)
        for ax in axes[2:]:
            st.wavelength_label(ax)
        st.legend_outside(fig, handles, columns=min(4, len(labels)))
        fig.suptitle(title or "Polarization optics downstream of the telescope")
    return fig


def _draw_member(axes, rows, label, color, marker):
    # tables hold the wavelengths as they were given, not in order
    rows = rows[np.argsort(rows["wavelength"])]
    lam, few = rows["wavelength"].to_value(u.nm), len(rows) < _LEAST_SPECTRUM
    settings = {"color": color, "marker": marker, "linestyle": ":" if few else "-"}
    settings |= {"markersize": 6.5 if few else 4.0}
    bars = {"color": color, "elinewidth": 1.2, "zorder": 3, "fmt": "none"}
    handles = []
    for panel, key, unit, look in _DRAWN:
        value = u.Quantity(rows[key]).to_value(unit)
        handles += axes[panel].plot(lam, value, label=label, **settings | look)
        # a table of before there were errors has none
        if f"{key}_std" not in rows.colnames:
            continue
        std = u.Quantity(rows[f"{key}_std"]).to_value(unit)
        known = np.isfinite(value) & np.isfinite(std)
        axes[panel].errorbar(lam[known], value[known], std[known], **bars)
        # a value that the data leave open may be anywhere
        for x in lam[np.isinf(std)]:
            axes[panel].axvline(x, color=color, linewidth=1.0, alpha=0.6)
    return handles[0]
