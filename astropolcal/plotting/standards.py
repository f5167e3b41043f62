# Licensed under a 3-clause BSD style license - see LICENSE
"""Standard stars over a night."""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.plotting._style import GREY, canvas, legend_outside, looks, style

__all__ = ["plot_observability"]

_WIDTH, _HEIGHT = 8.0, 6.4
_MOST = 8
# a marker every so many hours tells the curves apart without colour
_EVERY = 1.0
_TICK = 45
_CROWDED = 405


def plot_observability(seen, *, total=None, figure=None):
    """
    Draw altitude and parallactic angle of stars against time.

    The curves are thick while a star is above its lowest altitude, thin and
    dotted below; only dark hours are drawn. The parallactic angle has no jumps, as
    in the table of a star: the axis goes beyond 180 deg where a star does.

    Parameters
    ----------
    seen : sequence of Observability
        Up to eight stars of one night at one site.
    total : int, optional
        Of how many stars these are the first, for the title.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If there is no star, are too many, or they are of different nights or sites.

    Examples
    --------
    >>> from astropolcal import standards
    >>> from astropolcal.plotting.standards import plot_observability
    >>> seen = [standards.observability(n, "subaru", "2025-11-03") for n in
    ...         ("HD 293396", "HD 30675")]
    >>> len(plot_observability(seen).axes)
    2
    """
    seen = list(seen)
    _check(seen)
    with style():
        figure = canvas(figure, _WIDTH, _HEIGHT)
        upper, lower = figure.subplots(2, 1, sharex=True)
        for star, look in zip(seen, looks(len(seen)), strict=True):
            hours = _hours(star, seen[0])
            _curve(upper, hours, star.table["altitude"].value, star, look)
            _curve(lower, hours, star.table["parallactic"].value, star, look)
        _finish(upper, lower, seen)
        handles = [
            upper.plot([], [], color=c, marker=m, label=s.name)[0]
            for s, (c, m) in zip(seen, looks(len(seen)), strict=True)
        ]
        dotted = upper.plot([], [], color=GREY, ls=":", label="too low to observe")
        legend_outside(figure, handles + dotted, columns=min(len(seen) + 1, 4))
        few = total is not None and total > len(seen)
        which = f"the first {len(seen)} of {total} standard stars" if few else "Standard stars"
        title = f"{which[0].upper()}{which[1:]}, night of {seen[0].night}"
        figure.suptitle(f"{title}\n{_place(seen[0].site)}")
    return figure


def _check(seen):
    if not 1 <= len(seen) <= _MOST:
        raise ParameterError(f"{len(seen)} stars cannot be drawn; allowed are 1 to {_MOST}")
    first = seen[0]
    for star in seen:
        if star.night != first.night or not np.all(star.site == first.site):
            raise ParameterError(
                f"{star.name} and {first.name} are of different nights or sites; draw them apart"
            )


def _place(site):
    lon, lat = site.lon.wrap_at(180 * u.deg).deg, site.lat.deg
    name = f"{site.info.name}, " if site.info.name else ""
    east, north = "E" if lon >= 0 else "W", "N" if lat >= 0 else "S"
    return f"{name}{abs(lon):.2f}° {east}, {abs(lat):.2f}° {north}"


def _hours(star, first):
    """Return hours UTC, counted from the midnight before the first dark hour."""
    # one midnight for all stars, that of the first
    start = np.floor(first.table["time"][0].mjd)
    return (star.table["time"].mjd - start) * 24


def _curve(axes, hours, values, star, look):
    """Draw one star: faint below the limit, with markers where it is observable."""
    color, marker = look
    good = star.table["observable"]
    axes.plot(hours, values, color=color, linestyle=":", linewidth=1)
    axes.plot(hours, np.where(good, values, np.nan), color=color, linewidth=2)
    count = max(len(hours) // max(int((hours[-1] - hours[0]) / _EVERY), 1), 1)
    axes.plot(
        hours[::count], np.where(good, values, np.nan)[::count], color=color, marker=marker, ls=""
    )


def _finish(upper, lower, seen):
    limits = {float(star.min_altitude.value) for star in seen}
    for limit in limits:
        upper.axhline(limit, color=GREY, linestyle="--", linewidth=1)
    upper.set_ylabel("altitude (deg)")
    upper.set_ylim(0, 90)
    upper.set_yticks(np.arange(0, 91, 15))
    lower.set_ylabel("parallactic angle (deg)")
    angles = np.concatenate([star.table["parallactic"].value for star in seen])
    low = min(_TICK * np.floor(angles.min() / _TICK), -180)
    high = max(_TICK * np.ceil(angles.max() / _TICK), 180)
    lower.set_ylim(low, high)
    # twice as wide where the labels would crowd
    lower.set_yticks(np.arange(low, high + 1, _TICK if high - low <= _CROWDED else 2 * _TICK))
    date = seen[0].table["time"][0].to_value("iso", "date")
    lower.set_xlabel(f"time on {date} (hours UTC)")
