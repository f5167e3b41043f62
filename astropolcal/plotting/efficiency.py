# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarimetric efficiency over wavelength, derotator angle and pointing: lines and maps."""

import astropy.units as u
import numpy as np

from astropolcal.calibration.efficiency import polarimetric_efficiency
from astropolcal.chain import stages
from astropolcal.plotting._style import canvas, looks, nanometres, style

__all__ = ["plot_polarimetric_efficiency"]

_DEROTATOR = np.arange(0, 181, 2.5)
_ALTITUDE = np.arange(20, 91, 5.0)
_PARALLACTIC = np.arange(-180, 181, 10.0)
_MOST_LINES = 6
_LEVELS = (0.2, 0.4, 0.6, 0.8, 0.9)


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
):
    """
    Draw the polarimetric efficiency of an instrument.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        A calibrated chain, see `~astropolcal.calibration.polarimetric_efficiency`.
    wavelength : `~astropy.units.Quantity`
        On the grid of the chain's parameters.
    altitude, parallactic : `~astropy.units.Quantity`
        Pointing of the first two panels.
    derotator : `~astropy.units.Quantity`
        Derotator angle of the third panel.
    shown : `~astropy.units.Quantity`, optional
        Wavelengths of the lines, the nearest of the grid; by default six spread over it.
    title : str, optional
        Title of the figure.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Lines against the derotator angle; a map of derotator angle and wavelength; and, for a
        chain from the sky, a map of parallactic angle and altitude: the least efficiency over the
        wavelengths.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.plotting import plot_polarimetric_efficiency
    >>> charis = instruments.get("charis")
    >>> figure = plot_polarimetric_efficiency(charis.published(), charis.wavelength)
    >>> len(figure.axes) >= 2
    True
    """
    lam = nanometres(wavelength)
    on_sky = "parallactic" in stages(chain)
    pointing = {"altitude": altitude, "parallactic": parallactic} if on_sky else {}
    values = polarimetric_efficiency(chain, wavelength, derotator=_DEROTATOR * u.deg, **pointing)
    with style():
        fig = canvas(figure, 16.5 if on_sky else 11.5, 5.2)
        axes = fig.subplots(1, 3 if on_sky else 2)
        _lines(axes[0], lam, values, shown)
        where = f"altitude {_degree(altitude)}, parallactic angle {_degree(parallactic)}"
        axes[0].set_title(where if on_sky else "behind the internal source")
        _map_of_wavelengths(fig, axes[1], lam, values)
        axes[1].set_title("as on the left, all wavelengths")
        if on_sky:
            _map_of_pointings(fig, axes[2], chain, wavelength, derotator)
        fig.suptitle(title or "Polarimetric efficiency")
    return fig


def _degree(angle):
    return f"{u.Quantity(angle).to_value(u.deg):g}°"


def _lines(ax, lam, values, shown):
    if shown is None:
        rows = np.unique(np.linspace(0, lam.size - 1, min(_MOST_LINES, lam.size)).astype(int))
    else:
        rows = np.unique(np.abs(nanometres(shown)[:, None] - lam).argmin(axis=1))
    for (color, marker), row in zip(looks(len(rows)), rows, strict=True):
        ax.plot(
            _DEROTATOR,
            values[:, row],
            color=color,
            marker=marker,
            markevery=6,
            label=f"{lam[row]:.0f} nm",
        )
    ax.set(xlabel="derotator angle (deg)", ylabel="measured share of the polarization")
    ax.set(xlim=(0, 180), ylim=(0, 1.02), xticks=np.arange(0, 181, 45))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)


def _map_of_wavelengths(fig, ax, lam, values):
    order = np.argsort(lam)
    mesh = _mesh(ax, _DEROTATOR, lam[order], values.T[order])
    ax.set(xlabel="derotator angle (deg)", ylabel="wavelength (nm)", xticks=np.arange(0, 181, 45))
    fig.colorbar(mesh, ax=ax, label="measured share of the polarization")


def _map_of_pointings(fig, ax, chain, wavelength, derotator):
    values = polarimetric_efficiency(
        chain,
        wavelength,
        derotator=derotator,
        altitude=_ALTITUDE[:, None] * u.deg,
        parallactic=_PARALLACTIC * u.deg,
    ).min(axis=-1)
    mesh = ax.pcolormesh(_PARALLACTIC, _ALTITUDE, values, cmap="cividis", shading="nearest")
    ax.set(xlabel="parallactic angle (deg)", ylabel="altitude (deg)")
    ax.set(xticks=np.arange(-180, 181, 90))
    ax.set_title(f"derotator at {_degree(derotator)}, worst wavelength")
    fig.colorbar(mesh, ax=ax, label="measured share of the polarization")


def _mesh(ax, x, y, values):
    mesh = ax.pcolormesh(x, y, values, cmap="cividis", vmin=0, vmax=1, shading="nearest")
    for levels, color in ((_LEVELS[:3], "white"), (_LEVELS[3:], "black")):
        # a level that no value reaches is no fault
        inside = [level for level in levels if values.min() < level < values.max()]
        if inside:
            lines = ax.contour(x, y, values, levels=inside, colors=color, linewidths=0.8)
            ax.clabel(lines, fmt="%g", fontsize=9)
    ax.grid(False)
    return mesh
