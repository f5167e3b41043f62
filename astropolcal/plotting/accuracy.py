# Licensed under a 3-clause BSD style license - see LICENSE
"""Accuracy of a calibration against wavelength."""

import astropy.units as u
import numpy as np

from astropolcal.calibration.noise.scatter import what_is_left_out
from astropolcal.exceptions import ParameterError
from astropolcal.plotting._style import (
    BLACK,
    BLUE,
    GREEN,
    MINUS,
    PURPLE,
    VERMILION,
    canvas,
    draw_line,
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
    "s_cv": (GREEN, "^", "s_cv: rms error when predicting {} left out of the fit"),
}
_STANDARD_MARKERS = ("D", "v", "P", "X")
_STANDARD_STYLES = ("-", "--", ":", "-.")
_REFERENCE_STYLES = ("--", ":", "-.")
# a larger ratio between the extremes is drawn on a logarithmic axis
_LOGARITHMIC_FROM = 6


def plot_accuracy(calibration, reference=None, *, figure=None):
    """
    Draw the accuracies of a calibration against wavelength, one panel a dataset.

    These are s_res, s_mean and s_cv, and s_standard for each standard of the dataset's
    source. Standards of other sources have panels of their own, with the s_cv that they
    are compared with. Where several datasets, and every standard, have one wavelength each,
    one panel shows them side by side.

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
    Definitions as in `~astropolcal.calibration.validation.cross_validation.accuracy_table` and
    `~astropolcal.calibration.validation.held_out.standard_accuracy`; ``s_mean`` is s_rel of
    McIntosh et al. (2026, Sec. 2.3).

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
    records, standards = calibration.datasets, calibration.fit.get("standards", [])
    sources = {record.source for record in records}
    # a standard of a source that was not fitted has no panel to be drawn into
    others = [entry for entry in standards if entry["source"] not in sources]
    count = len(records) + len(others)
    if len(records) > 1 and not curves and _have_one_wavelength(records, standards):
        return _draw_side_by_side(figure, calibration, records, standards)
    with style():
        figure = canvas(figure, 8.5, 2.4 + 3.6 * count)
        # one scale, so that datasets can be compared by eye
        panels = figure.subplots(count, 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        # by name, for the curves of all panels look alike and share one legend
        handles = {}
        for axes, record in zip(panels, records, strict=False):
            name = f"{record.name}: " if count > 1 else ""
            axes.set_title(name + _counts(record))
            handles |= _draw_record(axes, record, calibration)
        looks = _standard_looks(standards)
        for axes, entries in _placed(panels, records, standards, others):
            for entry in entries:
                handles |= _draw_standard(axes, entry, looks[entry["content_hash"]])
        for axes, entry in zip(panels[len(records) :], others, strict=True):
            axes.set_title(f"{entry['name']}: n = {_span(entry['n'])} data a wavelength, predicted")
            handles |= _draw_standard_s_cv(axes, entry)
        for axes in panels:
            references = _draw_references(axes, curves)
            axes.set_ylabel("accuracy (% of polarization)")
        scale_axis(panels[0], _all_values(records, standards, curves))
        wavelength_label(panels[-1])
        heading(
            figure, calibration, "Accuracy of the calibration", [record.name for record in records]
        )
        legend_outside(figure, [*handles.values(), *references])
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


def _have_one_wavelength(records, standards):
    return all(len(record.accuracy) == 1 for record in records) and all(
        len(entry["wavelength_nm"]) == 1 for entry in standards
    )


def _draw_side_by_side(figure, calibration, records, standards):
    """Draw one panel of points over the datasets, then the standards."""
    values = {
        name: np.array([record.accuracy[name].to_value(u.percent)[0] for record in records])
        for name in _CURVES
    }
    at, after = np.arange(len(records)), len(records) + np.arange(len(standards))
    with style():
        figure = canvas(figure, max(8.5, 2.5 + 0.6 * (len(at) + len(after))), 7.0)
        axes = figure.subplots()
        for name, (color, marker, label) in _CURVES.items():
            label = label.format(what_is_left_out(calibration)) if name == "s_cv" else label
            if not np.isfinite(values[name]).any():
                label, marker = f"{name}: not known (too few data or groups)", ""
            axes.plot(at, values[name], marker=marker, ls="", color=color, label=label)
        if standards:
            predicted = [entry["s_standard_percent"][0] for entry in standards]
            label = "s_standard: rms error when predicting a standard, which was not fitted"
            axes.plot(after, predicted, "D", color=PURPLE, label=label)
            compared = [entry["s_cv_percent"][0] for entry in standards]
            label = "s_cv of the data that were fitted, for comparison"
            axes.plot(after, compared, "_", color=GREEN, markersize=14, label=label)
        names = [
            f"{record.name}\n{nanometres(record.accuracy['wavelength'])[0]:.0f} nm"
            for record in records
        ] + [f"{entry['name']}\n{entry['wavelength_nm'][0]:.0f} nm" for entry in standards]
        axes.set_xticks([*at, *after], names, rotation=35, ha="right", fontsize=9.5)
        axes.set_ylabel("accuracy (% of polarization)")
        n = [count for record in records for count in record.accuracy["n"]]
        k = _span([k for record in records for k in record.accuracy["k"]])
        axes.set_title(f"n = {_span(n)} data a dataset, k = {k} free parameters")
        scale_axis(axes, _all_values(records, standards, {}))
        heading(figure, calibration, "Accuracy of the calibration", [r.name for r in records])
        legend_outside(figure, axes.get_legend_handles_labels()[0])
    return figure


def _draw_record(axes, record, calibration):
    """Draw the curves of a dataset; return them by name."""
    drawn = {}
    for name, (color, marker, label) in _CURVES.items():
        values = record.accuracy[name].to_value(u.percent)
        label = label.format(what_is_left_out(calibration)) if name == "s_cv" else label
        # a curve that is missing is said to be so in the legend, not left out
        if not np.isfinite(values).any():
            label = f"{name}: not known (too few data or groups)"
        lam = nanometres(record.accuracy["wavelength"])
        drawn[name] = draw_line(axes, lam, values, color=color, marker=marker, label=label)
    return drawn


def _standard_looks(standards):
    """Return marker and line style of each standard, by its content."""
    return {
        entry["content_hash"]: {
            "marker": _STANDARD_MARKERS[i % len(_STANDARD_MARKERS)],
            "linestyle": _STANDARD_STYLES[i % len(_STANDARD_STYLES)],
        }
        for i, entry in enumerate(standards)
    }


def _placed(panels, records, standards, others):
    """Yield each panel with the standards that are drawn into it."""
    for axes, record in zip(panels, records, strict=False):
        yield axes, [entry for entry in standards if entry["source"] == record.source]
    for axes, entry in zip(panels[len(records) :], others, strict=True):
        yield axes, [entry]


def _draw_standard(axes, entry, look):
    label = f"s_standard: rms error when predicting {entry['name']}, which was not fitted"
    line = draw_line(
        axes, entry["wavelength_nm"], entry["s_standard_percent"], color=PURPLE, label=label, **look
    )
    return {entry["content_hash"]: line}


def _draw_standard_s_cv(axes, entry):
    """Draw what a standard of another source is compared with."""
    label = "s_cv of the data that were fitted, for comparison"
    line = draw_line(
        axes, entry["wavelength_nm"], entry["s_cv_percent"], color=GREEN, alpha=0.6, label=label
    )
    return {"s_cv for comparison": line}


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
    k = np.asarray(record.accuracy["k"])
    span = _span(record.accuracy["n"])
    return f"n = {span} data a wavelength, k = {k.max()} free parameters"


def _span(n):
    low, high = np.min(n), np.max(n)
    return f"{low}" if low == high else f"{low} to {high}"


def _all_values(records, standards, curves):
    values = [record.accuracy[name].to_value(u.percent) for record in records for name in _CURVES]
    values += [np.array(entry["s_standard_percent"]) for entry in standards]
    return np.concatenate([*values, *(value for _, value in curves.values())])


def scale_axis(axes, values):
    """Use a logarithmic axis where the values need it, with plain numbers on it."""
    # zero stands for what is missing and has no logarithm
    known = values[np.isfinite(values) & (values > 0)]
    if known.size and known.max() > _LOGARITHMIC_FROM * known.min():
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        axes.set_yscale("log")
        axes.set_ylim(known.min() / 1.3, known.max() * 1.3)
        # powers of ten alone would give an axis over half a decade no number at all
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        # accuracies of similar size are compared by their lengths from zero
        axes.set_ylim(0, 1.08 * known.max() if known.size else None)
