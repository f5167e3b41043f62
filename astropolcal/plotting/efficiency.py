# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarimetric efficiency over wavelength, derotator angle and offset, and pointing."""

import astropy.units as u
import numpy as np

from astropolcal.chain import stages
from astropolcal.efficiency import has_derotator, polarimetric_efficiency
from astropolcal.plotting._style import canvas, looks, nanometres, style

__all__ = ["plot_derotator_offsets", "plot_polarimetric_efficiency"]

_DEROTATOR = np.arange(0, 181, 2.5)
_ALTITUDE = np.arange(20, 91, 5.0)
_PARALLACTIC = np.arange(-180, 181, 10.0)
_MOST_LINES = 6
_LEAST_SPECTRUM = 8
# white contours on the dark end of the colours, black ones on the bright end
_LEVELS = (0.2, 0.4, 0.6, 0.8, 0.9)


def plot_polarimetric_efficiency(
    chain,
    wavelength,
    *,
    altitude=60 * u.deg,
    parallactic=0 * u.deg,
    derotator=90 * u.deg,
    shown=None,
    instrument=None,
    mode=None,
    title=None,
    figure=None,
):
    """
    Draw the polarimetric efficiency of an instrument.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        A calibrated chain, see `~astropolcal.efficiency.polarimetric_efficiency`.
    wavelength : `~astropy.units.Quantity`
        On the grid of the chain's parameters.
    altitude, parallactic : `~astropy.units.Quantity`
        Pointing of the first two panels.
    derotator : `~astropy.units.Quantity`
        Derotator angle of the third panel.
    shown : `~astropy.units.Quantity`, optional
        Wavelengths of the lines, the nearest of the grid; by default six spread over it.
    instrument, mode
        Whose half-wave plate it is, see `~astropolcal.efficiency.polarimetric_efficiency`.
    title : str, optional
        Title of the figure.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Lines against the derotator angle; a map of derotator angle and wavelength; and, for a
        chain from the sky, a map of parallactic angle and altitude: the least efficiency over the
        wavelengths. Without a derotator there are lines against the parallactic angle, or
        against the wavelength behind an internal source.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.plotting import plot_polarimetric_efficiency
    >>> charis = instruments.get("charis")
    >>> figure = plot_polarimetric_efficiency(charis.published(), charis.wavelength)
    >>> len(figure.axes) >= 2
    True
    """
    lam, moving = nanometres(wavelength), stages(chain)
    at = {"altitude": altitude} if "altitude" in moving else {}
    at |= {"parallactic": parallactic} if "parallactic" in moving else {}
    asked = _Asked(chain, wavelength, {"instrument": instrument, "mode": mode})
    # without an altitude axis there is no pointing to map
    turns, maps = has_derotator(chain), "altitude" in at
    panels = (2 if turns else int(not maps)) + maps
    with style():
        fig = canvas(figure, 5.5 * panels + 0.5 * (panels < 2), 5.2)
        axes = list(fig.subplots(1, panels, squeeze=False)[0])
        if turns:
            _with_derotator(fig, axes, lam, asked(derotator=_DEROTATOR * u.deg, **at), shown)
            axes[0].set_title(_where(at))
        elif not maps:
            _without_derotator(axes[0], lam, asked, shown, "parallactic" in at)
        if maps:
            _map_of_pointings(fig, axes[-1], asked, derotator if turns else None)
        fig.suptitle(title or "Polarimetric efficiency")
    return fig


def plot_derotator_offsets(best, *, title=None, figure=None):
    """
    Draw the polarimetric efficiency of an observation against the offset of the derotator.

    Parameters
    ----------
    best : `~astropolcal.efficiency.BestDerotator`
        Of `~astropolcal.efficiency.best_derotator`.
    title : str, optional
        Title of the figure.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Lines of the mean and the least efficiency over the observation and all wavelengths, at
        the angle of polarization that is measured worst; the best offset is marked.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.efficiency import best_derotator
    >>> from astropolcal.plotting.efficiency import plot_derotator_offsets
    >>> charis = instruments.get("charis")
    >>> best = best_derotator(charis.on_sky(charis.published()), charis.wavelength,
    ...                       [60, 65] * u.deg, [-30, -20] * u.deg,
    ...                       offsets=range(0, 180, 5) * u.deg)
    >>> [line.get_label() for line in plot_derotator_offsets(best).axes[0].get_lines()][:2]
    ['mean', 'least']
    """
    # offsets may have been tried in any order
    table = best.table[np.argsort(best.table["offset"])]
    offset, marked = table["offset"].to_value(u.deg), best.offset.to_value(u.deg)
    with style():
        fig = canvas(figure, 6.5, 5.2)
        ax = fig.subplots()
        for (color, marker), name in zip(looks(2), ("mean", "least"), strict=True):
            # markers tell the lines apart without colour; at all offsets they would be a band
            every = max(1, len(offset) // 12)
            ax.plot(offset, table[name], color=color, marker=marker, markevery=every, label=name)
        words = f"best offset, {_degree(best.offset)}"
        ax.axvline(marked, color="black", linestyle="--", label=words, zorder=1)
        # optics before the analyzer may add polarization of their own
        ax.set(ylim=(-0.02, 1.02 * max(1.0, np.max(table["mean"]))))
        ax.set(xlabel="derotator offset (deg)", ylabel="measured share of the polarization")
        ax.set_title(f"{best.law} still; over all times and wavelengths")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
        fig.suptitle(title or "Polarimetric efficiency of an observation")
    return fig


class _Asked:
    """The efficiency of one chain at angles."""

    def __init__(self, chain, wavelength, settings):
        self.chain, self.wavelength, self.settings = chain, wavelength, settings

    def __call__(self, **angles):
        return polarimetric_efficiency(self.chain, self.wavelength, **angles, **self.settings)


def _where(at):
    words = {"altitude": "altitude", "parallactic": "parallactic angle"}
    if not at:
        return "behind the internal source"
    return ", ".join(f"{words[key]} {_degree(angle)}" for key, angle in at.items())


def _with_derotator(fig, axes, lam, values, shown):
    """Draw lines against the derotator angle, and a map of all wavelengths."""
    _lines(axes[0], lam, _DEROTATOR, values, shown)
    axes[0].set(xlabel="derotator angle (deg)", xlim=(0, 180), xticks=np.arange(0, 181, 45))
    _map_of_wavelengths(fig, axes[1], lam, values)
    axes[1].set_title("as on the left, all wavelengths")


def _without_derotator(ax, lam, asked, shown, on_sky):
    """Draw lines against the parallactic angle, or points at the wavelengths."""
    if on_sky:
        angles = np.arange(-180, 181, 5.0)
        _lines(ax, lam, angles, asked(parallactic=angles * u.deg), shown)
        ax.set(xlabel="parallactic angle (deg)", xlim=(-180, 180), xticks=np.arange(-180, 181, 90))
        return
    order = np.argsort(lam)
    ax.plot(lam[order], np.atleast_2d(asked())[0][order], marker="o")
    ax.set(xlabel="wavelength (nm)", ylabel="measured share of the polarization", ylim=(0, 1.02))


def _degree(angle):
    return f"{u.Quantity(angle).to_value(u.deg):g}°"


def _lines(ax, lam, angles, values, shown):
    if shown is None:
        rows = np.unique(np.linspace(0, lam.size - 1, min(_MOST_LINES, lam.size)).astype(int))
    else:
        # two wavelengths asked for may be nearest to the same one
        rows = np.unique(np.abs(nanometres(shown)[:, None] - lam).argmin(axis=1))
    for (color, marker), row in zip(looks(len(rows)), rows, strict=True):
        ax.plot(
            angles,
            values[:, row],
            color=color,
            marker=marker,
            # markers tell the lines apart without colour; at all points they would be a band
            markevery=6,
            label=f"{lam[row]:.0f} nm",
        )
    ax.set(ylabel="measured share of the polarization", ylim=(0, 1.02))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)


def _map_of_wavelengths(fig, ax, lam, values):
    order = np.argsort(lam)
    # between a few filters there is nothing to interpolate
    filters = lam.size < _LEAST_SPECTRUM
    y = np.arange(lam.size) if filters else lam[order]
    mesh = _mesh(ax, _DEROTATOR, y, values.T[order], contours=not filters)
    if filters:
        ax.set_yticks(y, [f"{value:.0f}" for value in lam[order]])
    ax.set(xlabel="derotator angle (deg)", ylabel="wavelength (nm)", xticks=np.arange(0, 181, 45))
    fig.colorbar(mesh, ax=ax, label="measured share of the polarization")


def _map_of_pointings(fig, ax, asked, derotator):
    values = asked(
        derotator=derotator,
        altitude=_ALTITUDE[:, None] * u.deg,
        parallactic=_PARALLACTIC * u.deg,
    ).min(axis=-1)
    mesh = ax.pcolormesh(_PARALLACTIC, _ALTITUDE, values, cmap="cividis", shading="nearest")
    # the cells of the last row reach beyond the zenith
    ax.set_ylim(_ALTITUDE[0], 90)
    ax.set(xlabel="parallactic angle (deg)", ylabel="altitude (deg)")
    ax.set(xticks=np.arange(-180, 181, 90))
    turned = "" if derotator is None else f"derotator at {_degree(derotator)}, "
    ax.set_title(f"{turned}worst wavelength")
    fig.colorbar(mesh, ax=ax, label="measured share of the polarization")


def _mesh(ax, x, y, values, contours):
    # 0 to 1 in all maps of wavelengths, so that colours of two instruments mean the same
    mesh = ax.pcolormesh(x, y, values, cmap="cividis", vmin=0, vmax=1, shading="nearest")
    for levels, color in ((_LEVELS[:3], "white"), (_LEVELS[3:], "black")) * contours:
        # a level that no value reaches is no fault
        inside = [level for level in levels if values.min() < level < values.max()]
        if inside:
            lines = ax.contour(x, y, values, levels=inside, colors=color, linewidths=0.8)
            ax.clabel(lines, fmt="%g", fontsize=9)
    ax.grid(False)
    return mesh
