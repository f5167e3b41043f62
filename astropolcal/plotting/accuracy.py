# Licensed under a 3-clause BSD style license - see LICENSE
"""Accuracy of a calibration against wavelength."""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.plotting._style import (
    BLACK,
    BLUE,
    GREEN,
    MINUS,
    VERMILION,
    canvas,
    heading,
    legend_outside,
    nanometres,
    style,
    wavelength_label,
)

__all__ = ["plot_accuracy"]

_CURVES = {
    "s_res": (
        VERMILION,
        "o",
        f"s_res = √(Σr²/(n {MINUS} k)): scatter of one datum about the model",
    ),
    "s_mean": (BLUE, "s", "s_mean = s_res/√n: scatter of the mean of n data (elsewhere s_rel)"),
    "s_cv": (GREEN, "^", "s_cv: rms error when predicting derotator angles left out of the fit"),
}
_REFERENCE_STYLES = ("--", ":", "-.")
# a larger ratio between the extremes is drawn on a logarithmic axis
_LOGARITHMIC_FROM = 6


def plot_accuracy(calibration, reference=None, *, figure=None):
    """
    Draw s_res, s_mean and s_cv against wavelength, one panel a dataset.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    reference : dict of str to (`~astropy.units.Quantity`, `~astropy.units.Quantity`), optional
        Curves to compare with: label to wavelengths and accuracies, the
        latter with a unit (``u.percent``, or dimensionless).
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If a reference has other units or shapes.

    Notes
    -----
    Definitions as in `~astropolcal.calibration.accuracy_table`; ``s_mean`` is
    s_rel of McIntosh et al. (2026, Sec. 2.3).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_accuracy
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> goal = {"goal": ([1200, 2300] * u.nm, [0.1, 0.1] * u.percent)}
    >>> plot_accuracy(cal, goal).axes[0].get_ylabel()
    'accuracy (% of polarization)'
    """
    curves = {label: _reference(label, pair) for label, pair in (reference or {}).items()}
    records = calibration.datasets
    with style():
        figure = canvas(figure, 8.5, 2.2 + 3.6 * len(records))
        panels = figure.subplots(len(records), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        for axes, record in zip(panels, records, strict=True):
            handles = [_draw(axes, record.accuracy, name) for name in _CURVES]
            handles += _draw_references(axes, curves)
            name = f"{record.name}: " if len(records) > 1 else ""
            axes.set_title(name + _counts(record))
            axes.set_ylabel("accuracy (% of polarization)")
        _scale(panels[0], records, curves)
        wavelength_label(panels[-1])
        heading(
            figure, calibration, "Accuracy of the calibration", [record.name for record in records]
        )
        legend_outside(figure, handles)
    return figure


def _reference(label, pair):
    """Return a reference curve in nm and percent."""
    try:
        wavelength, accuracy = pair
        lam, value = nanometres(wavelength), np.atleast_1d(accuracy.to_value(u.percent))
    except (AttributeError, TypeError, ValueError, u.UnitConversionError) as error:
        raise ParameterError(
            f"reference {label!r} must be a pair (wavelength, accuracy) of quantities, "
            f"the second in percent: {error}"
        ) from None
    if lam.shape != value.shape:
        raise ParameterError(
            f"reference {label!r} has {lam.size} wavelengths but {value.size} accuracies"
        )
    return lam, value


def _draw(axes, table, name):
    color, marker, label = _CURVES[name]
    value = table[name].to_value(u.percent)
    if not np.isfinite(value).any():
        label = f"{name}: not known (too few data or derotator angles)"
    lam = nanometres(table["wavelength"])
    order = np.argsort(lam)
    (line,) = axes.plot(lam[order], value[order], color=color, marker=marker, label=label)
    return line


def _draw_references(axes, curves):
    return [
        axes.plot(
            lam,
            value,
            color=BLACK,
            linestyle=_REFERENCE_STYLES[i % len(_REFERENCE_STYLES)],
            label=label,
        )[0]
        for i, (label, (lam, value)) in enumerate(curves.items())
    ]


def _counts(record):
    n, k = (np.asarray(record.accuracy[key]) for key in ("n", "k"))
    span = f"{n.min()}" if n.min() == n.max() else f"{n.min()} to {n.max()}"
    return f"n = {span} data a wavelength, k = {k.max()} free parameters"


def _scale(axes, records, curves):
    """Use a logarithmic axis where the values need it, with plain numbers on it."""
    values = [record.accuracy[name].to_value(u.percent) for record in records for name in _CURVES]
    values = np.concatenate([*values, *(value for _, value in curves.values())])
    known = values[np.isfinite(values) & (values > 0)]
    if known.size and known.max() > _LOGARITHMIC_FROM * known.min():
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        axes.set_yscale("log")
        axes.set_ylim(known.min() / 1.3, known.max() * 1.3)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0)
