# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrated parameters against date, with the significance of each change."""

from itertools import pairwise

import numpy as np
from astropy.time import Time

from astropolcal.exceptions import FitError, ParameterError
from astropolcal.pipeline.history import _Named, _named, parameter_history, significance
from astropolcal.plotting._style import GREY, SIGMA, canvas, looks, style

__all__ = ["plot_history"]

_MOST_LINES = 6
_MOST_PANELS = 12
# share of the time axis over which the wavelengths of one calibration are spread
_SPREAD = 0.03


def plot_history(calibrations, parameters=None, *, shown=None, title=None, figure=None):
    """
    Draw calibrated parameters against the date from which they hold.

    Parameters
    ----------
    calibrations : Library or sequence
        See `~astropolcal.pipeline.parameter_history`; each needs a date.
    parameters : sequence of str, optional
        ``"optic.parameter"`` or ``"optic"``; by default all that are free in one of them.
    shown : int, optional
        How many wavelengths of a parameter given per wavelength, by default six spread over
        the grid; they stand side by side so that their errors can be told apart.
    title : str, optional
        Title of the figure.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        One panel a parameter: values with errors, open symbols where a value was held; between
        two calibrations how surely they differ, over all wavelengths. Of a parameter
        per wavelength the differences to its mean over the calibrations.

    Raises
    ------
    ParameterError
        If there is no such parameter, a calibration has no date, or there are too many panels.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting.history import plot_history
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> years = [calibrate(chain, simulate(chain, charis.wavelength, frames, seed=i,
    ...                                    meta={"date": f"202{i}-03-01"})) for i in (5, 6)]
    >>> len(plot_history(years, ["hwp"]).axes)
    3
    """
    table = parameter_history(calibrations, parameters)
    if np.any(table["date"].mask):
        without = table["calibration"][table["date"].mask][0]
        raise ParameterError(f"{without}: no date; state one with with_validity(valid_from=)")
    names = [n for n in dict.fromkeys(table["parameter"]) if not np.all(_of(table, n)["fixed"])]
    if not 1 <= len(names) <= _MOST_PANELS:
        raise ParameterError(
            f"{len(names)} parameters to draw; allowed are 1 to {_MOST_PANELS}, choose with "
            "parameters="
        )
    with style():
        columns = min(len(names), 2)
        rows = -(-len(names) // columns)
        fig = canvas(figure, 7.2 * columns, 3.6 * rows + 0.6)
        axes = np.atleast_1d(fig.subplots(rows, columns, sharex=True)).ravel()
        for ax, name in zip(axes, names, strict=False):
            own = _of(table, name)
            _draw(ax, own, name, _MOST_LINES if shown is None else shown)
            _mark_changes(ax, calibrations, own, name)
        per_wavelength = np.isfinite(table["wavelength"].value).any()
        aside = "; wavelengths of one date side by side" if per_wavelength else ""
        for ax in axes[len(names) :]:
            ax.remove()
        for ax in axes[: len(names)][-columns:]:
            ax.tick_params(axis="x", labelbottom=True, labelrotation=25)
            ax.set_xlabel(f"valid from (UTC{aside})")
        note = f"{SIGMA}: by how much neighbours differ, over all wavelengths"
        fig.suptitle(f"{title or 'Calibrated parameters over time'}\n{note}")
    return fig


def _of(table, name):
    return table[table["parameter"] == name]


def _days(own):
    return own["date"].mjd


def _draw(ax, own, name, most):
    """Draw one parameter; of several wavelengths the differences to the mean."""
    lam = np.unique(own["wavelength"].value)
    several = np.isfinite(lam).all()
    unit = own["unit"][0]
    suffix = f" ({unit})" if unit else ""
    if several:
        lam = lam[np.unique(np.linspace(0, lam.size - 1, min(most, lam.size)).astype(int))]
    # a single date has no range to take a share of: one day
    width = max(np.ptp(_days(own)), 1.0) * _SPREAD if several else 0.0
    offsets = np.linspace(-width, width, lam.size) if lam.size > 1 else [0.0]
    for wavelength, shift, (color, marker) in zip(lam, offsets, looks(lam.size), strict=True):
        here = own[own["wavelength"].value == wavelength] if several else own
        days, value, std = _days(here) + shift, here["value"], here["std"]
        # retardances of the wavelengths differ by tens of degrees, their changes by tenths
        value = value - np.mean(value) if several else value
        label = f"{wavelength:.0f} nm" if several else None
        dates = Time(days, format="mjd").datetime
        known = np.isfinite(std)
        ax.plot(dates, value, color=color, lw=0.8, alpha=0.6, zorder=1)
        ax.errorbar(
            dates[known], value[known], std[known], fmt=marker, color=color, label=label, zorder=3
        )
        ax.plot(dates[~known], value[~known], marker, color=color, mfc="white", ls="", zorder=3)
    ax.set_title(name)
    ax.set_ylabel(f"difference to the mean{suffix}" if several else f"value{suffix}")
    ax.margins(y=0.18)
    # "+9e1" in a corner is easily missed
    ax.ticklabel_format(axis="y", useOffset=False)
    if several:
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _mark_changes(ax, calibrations, own, name):
    """Write between neighbours how many sigma they differ by."""
    named = _named(calibrations)
    held = {row["calibration"]: row["date"].mjd for row in own}
    for first, second in pairwise(named):
        try:
            found = significance([_Named(*first), _Named(*second)], [name])
        except (ParameterError, FitError):
            continue
        if not found.dof or not {first[0], second[0]} <= set(held):
            continue
        middle = Time((held[first[0]] + held[second[0]]) / 2, format="mjd").datetime
        # one tail of a normal law beyond three sigma
        certain = found.p_value < 0.00135
        ax.annotate(
            f"{found.sigma:.1f} {SIGMA}",
            (middle, 1),
            xycoords=("data", "axes fraction"),
            xytext=(0, -4),
            textcoords="offset points",
            ha="center",
            va="top",
            color="black" if certain else GREY,
            fontweight="bold" if certain else "normal",
        )
