# Licensed under a 3-clause BSD style license - see LICENSE
"""Accuracy for targets against wavelength."""

import astropy.units as u
import numpy as np

from astropolcal.calibration import target_accuracies
from astropolcal.calibration.validation import paper_accuracies
from astropolcal.calibration.validation.targets import TARGETS
from astropolcal.exceptions import ObservationError
from astropolcal.plotting._style import (
    canvas,
    draw_line,
    heading,
    legend_outside,
    looks,
    nanometres,
    style,
    wavelength_label,
)
from astropolcal.plotting.accuracy import scale_axis

__all__ = ["plot_target_accuracy"]

_PARTS = {
    "s_rel": "s_rel, of the polarized source: scales with the polarization",
    "s_unpol": "s_unpol, of the unpolarized source",
    "s_sky": "s_sky, of unpolarized stars",
    "s_abs": "s_abs = √(s_unpol² + s_sky²): scales with the intensity",
}


def plot_target_accuracy(calibration, targets=TARGETS, *, figure=None):
    """
    Draw the accuracy for targets against wavelength, and what it is made of.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    targets : sequence of (dolp, aolp)
        See `~astropolcal.calibration.target_accuracies`.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Panels of the residuals' s_rel, s_unpol, s_sky and s_abs, for comparison; of s_p, and of
        s_chi.

    Raises
    ------
    ParameterError
        If a target is impossible.
    ObservationError
        If the chain has no half-wave plate.

    Notes
    -----
    Where an open direction makes an error infinite there is no line.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_target_accuracy
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(plot_target_accuracy(cal).axes)
    3
    """
    tables = target_accuracies(calibration, targets)
    if not tables:
        raise ObservationError("the chain has no half-wave plate: no accuracy for targets")
    parts = paper_accuracies(calibration, targets[:1])
    with style():
        figure = canvas(figure, 8.5, 11)
        panels = figure.subplots(3, 1, sharex=True)
        handles = _draw_parts(panels[0], parts[0]) if parts else []
        lines = _draw_targets(panels[1], tables, "s_p")
        # the lines of the angle look as those of the degree, and need no entries of their own
        _draw_targets(panels[2], tables, "s_chi")
        for axes, label in zip(panels, ("accuracy (%)", "s_p (%)", "s_chi (°)"), strict=True):
            axes.set_ylabel(label)
        panels[1].set_title("Degree of polarization of a target")
        panels[2].set_title("Angle of polarization of a target")
        wavelength_label(panels[2])
        heading(figure, calibration, "Accuracy for targets")
        legend_outside(figure, [*handles, *lines])
    return figure


def _draw_parts(axes, table):
    # the parts are those of the instrument and the same for every target: the first will do
    axes.set_title("Residuals of the calibrations, which know neither telescope nor correlations")
    lam = nanometres(table["wavelength"])
    handles, values = [], []
    for (key, label), (color, marker) in zip(_PARTS.items(), looks(len(_PARTS)), strict=True):
        value = table[key].to_value(u.percent)
        look = {"color": color, "marker": marker}
        if key == "s_abs":
            # the sum is often its largest part: wide and open, and below it
            look |= {"linewidth": 4, "markersize": 10, "markerfacecolor": "none", "zorder": 1.9}
        if not np.isfinite(value).any():
            # text only: a marker would promise a curve
            label = f"{key}: not known, no such dataset"
            look = {"linestyle": "none", "marker": "none"}
        # what is exactly zero stands for a calibration that is missing
        handles.append(draw_line(axes, lam, value, label=label, **look))
        values.append(value)
    scale_axis(axes, np.concatenate(values))
    return handles


def _draw_targets(axes, tables, key):
    lines, values = [], []
    # apart from the looks of the parts, which share the legend
    for table, (color, marker) in zip(tables, looks(len(tables) + 4)[4:], strict=True):
        lam, value = nanometres(table["wavelength"]), table[key].value
        # large open markers and wide lines below: of curves that coincide all are seen
        below = len(tables) - 1 - len(lines)
        look = {"color": color, "marker": marker, "linewidth": 1.5 + 2 * below}
        look |= {"markersize": 5.5 + 4.5 * below, "markeredgewidth": 1.5}
        look |= {"markerfacecolor": "none"} if below else {}
        lines.append(draw_line(axes, lam, value, label=f"target of {_words(table)}", **look))
        values.append(value)
    scale_axis(axes, np.concatenate(values))
    return lines


def _words(table):
    angle = table.meta["aolp"]
    dolp = u.Quantity(table.meta["dolp"]).to_value(u.percent)
    where = "at its worst angle" if angle is None else f"at {angle.to_value(u.deg):g}°"
    return f"{dolp:g} % {where}"
