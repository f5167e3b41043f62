# Licensed under a 3-clause BSD style license - see LICENSE
"""Accuracy of a calibration against wavelength: of its data, for targets, for a standard star."""

from itertools import cycle

import astropy.units as u
import numpy as np

from astropolcal.calibration import target_accuracies
from astropolcal.calibration.noise.scatter import what_is_left_out
from astropolcal.calibration.validation import paper_accuracies
from astropolcal.calibration.validation.targets import TARGETS
from astropolcal.exceptions import ObservationError
from astropolcal.plotting import _style as st

__all__ = ["plot_accuracy", "plot_star_check", "plot_target_accuracy"]

_S_RES = f"s_res = √(Σr²/(n {st.MINUS} k)): scatter of one datum about the model"
_CURVES = {
    "s_res": (st.VERMILION, "o", _S_RES),
    "s_mean": (st.BLUE, "s", "s_mean = s_res/√n: scatter of the mean of n data (elsewhere s_rel)"),
    "s_cv": (st.GREEN, "^", "s_cv: rms error when predicting {} left out of the fit"),
}
# what a standard of another source is compared with
_COMPARED = "s_cv of the data that were fitted, for comparison"
_PREDICTED = "s_standard: rms error when predicting {}, which was not fitted"


def plot_accuracy(calibration, *, figure=None):
    """
    Draw the accuracies of a calibration against wavelength, one panel per dataset.

    These are s_res, s_mean and s_cv, and s_standard for each standard of the dataset's
    source. Standards of other sources have panels of their own, with the s_cv that they
    are compared with. Where several datasets, and every standard, have one wavelength each,
    one panel shows them side by side.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Notes
    -----
    Definitions as in `~astropolcal.calibration.validation.cross_validation.accuracy_table` and
    `~astropolcal.calibration.validation.cross_validation.standard_accuracy`; ``s_mean`` is s_rel of
    McIntosh et al. (2026, Sec. 2.3).

    Examples
    --------
    >>> from astropolcal.plotting import plot_accuracy
    >>> from astropolcal.testing import example_calibration
    >>> plot_accuracy(example_calibration()).axes[0].get_ylabel()
    'accuracy (% of polarization)'
    """
    records, standards = calibration.datasets, calibration.fit.get("standards", [])
    sources = {record.source for record in records}
    # a standard of a source that was not fitted has no panel to be drawn into
    others = [entry for entry in standards if entry["source"] not in sources]
    count = len(records) + len(others)
    grids = [r.accuracy for r in records] + [entry["wavelength_nm"] for entry in standards]
    one_panel = len(records) > 1 and all(len(lam) == 1 for lam in grids)
    size = (max(8.5, 2.5 + 0.6 * len(grids)), 7.0) if one_panel else (8.5, 2.4 + 3.6 * count)
    with st.canvas(figure, *size) as figure:
        # one scale, so that datasets can be compared by eye
        share = {"sharex": True, "sharey": True, "squeeze": False}
        panels = figure.subplots(1 if one_panel else count, 1, **share)[:, 0]
        if one_panel:
            _draw_side_by_side(panels[0], calibration, records, standards)
        else:
            _draw_panels(panels, calibration, records, standards, others)
            st.wavelength_label(panels[-1])
        for axes in panels:
            axes.set_ylabel("accuracy (% of polarization)")
        values = [record.accuracy[key].to_value(u.percent) for record in records for key in _CURVES]
        values += [np.array(entry["s_standard_percent"]) for entry in standards]
        st.scale_axis(panels[0], np.concatenate(values))
        st.heading(figure, calibration, "Accuracy of the calibration", [r.name for r in records])
        # by label, for the curves of all panels look alike and share one legend
        st.legend_outside(figure, list(st.legend_entries(panels).values()))
    return figure


def _draw_panels(panels, calibration, records, standards, others):
    """Draw the accuracies of the datasets, then of what was not fitted, over the wavelength."""
    for axes, record in zip(panels, records, strict=False):
        name = f"{record.name}\n" if len(panels) > 1 else ""
        counts = f"n = {_span(record.accuracy['n'])} data per wavelength"
        axes.set_title(f"{name}{counts}, k = {np.max(record.accuracy['k'])} free parameters")
        lam = st.nanometres(record.accuracy["wavelength"])
        for key, (color, marker, _) in _CURVES.items():
            values = record.accuracy[key].to_value(u.percent)
            # a curve that is missing is said to be so in the legend, not left out
            label = _label(key, values, calibration)
            st.draw_line(axes, lam, values, color=color, marker=marker, label=label)
    own = [[e for e in standards if e["source"] == record.source] for record in records]
    looks = zip(cycle("DvPX"), cycle(("-", "--", ":", "-.")), strict=False)
    looks = {id(entry): look for entry, look in zip(standards, looks, strict=False)}
    for axes, entries in zip(panels, [*own, *([entry] for entry in others)], strict=True):
        for entry in entries:
            marker, line = looks[id(entry)]
            look = {"color": st.PURPLE, "marker": marker, "linestyle": line}
            look["label"] = _PREDICTED.format(entry["name"])
            st.draw_line(axes, entry["wavelength_nm"], entry["s_standard_percent"], **look)
    for axes, entry in zip(panels[len(records) :], others, strict=True):
        axes.set_title(f"{entry['name']}\nn = {_span(entry['n'])} data per wavelength, predicted")
        look = {"color": st.GREEN, "alpha": 0.6, "label": _COMPARED}
        st.draw_line(axes, entry["wavelength_nm"], entry["s_cv_percent"], **look)


def _label(key, values, calibration):
    label = _CURVES[key][2].format(what_is_left_out(calibration))
    return label if np.isfinite(values).any() else f"{key}: not known (too few data or groups)"


def _draw_side_by_side(axes, calibration, records, standards):
    """Draw points over the datasets, then over the standards."""
    at, after = np.arange(len(records)), len(records) + np.arange(len(standards))
    for key, (color, marker, _) in _CURVES.items():
        values = np.array([record.accuracy[key].to_value(u.percent)[0] for record in records])
        marker = marker if np.isfinite(values).any() else ""
        label = _label(key, values, calibration)
        axes.plot(at, values, marker=marker, ls="", color=color, label=label)
    if standards:
        predicted = [entry["s_standard_percent"][0] for entry in standards]
        axes.plot(after, predicted, "D", color=st.PURPLE, label=_PREDICTED.format("a standard"))
        compared = [entry["s_cv_percent"][0] for entry in standards]
        axes.plot(after, compared, "_", color=st.GREEN, markersize=14, label=_COMPARED)
    places = [(r.name, st.nanometres(r.accuracy["wavelength"])[0]) for r in records]
    places += [(entry["name"], entry["wavelength_nm"][0]) for entry in standards]
    names = [f"{name}\n{lam:.0f} nm" for name, lam in places]
    axes.set_xticks([*at, *after], names, rotation=35, ha="right", fontsize=9.5)
    n, k = (_span([i for r in records for i in r.accuracy[key]]) for key in "nk")
    axes.set_title(f"n = {n} data per dataset, k = {k} free parameters")


def _span(n):
    low, high = np.min(n), np.max(n)
    return f"{low}" if low == high else f"{low} to {high}"


# ---- targets --------------------------------------------------------------------------------
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
    >>> from astropolcal.plotting import plot_target_accuracy
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> len(plot_target_accuracy(cal).axes)
    3
    """
    tables = target_accuracies(calibration, targets)
    if not tables:
        raise ObservationError("the chain has no half-wave plate: no accuracy for targets")
    parts = paper_accuracies(calibration, targets[:1])
    with st.canvas(figure, 8.5, 11) as figure:
        panels = figure.subplots(3, 1, sharex=True)
        handles = _draw_parts(panels[0], parts[0]) if parts else []
        lines = _draw_targets(panels[1], tables, "s_p")
        # the lines of the angle look as those of the degree, and need no entries of their own;
        # what is open in both panels has no line
        both = zip(lines, _draw_targets(panels[2], tables, "s_chi"), strict=True)
        known = [a for a, b in both if np.isfinite([a.get_ydata(), b.get_ydata()]).any()]
        for axes, label in zip(panels, ("accuracy (%)", "s_p (%)", "s_chi (°)"), strict=True):
            axes.set_ylabel(label)
        panels[1].set_title("Degree of polarization of a target")
        panels[2].set_title("Angle of polarization of a target")
        st.wavelength_label(panels[2])
        st.heading(figure, calibration, "Accuracy for targets")
        st.legend_outside(figure, [*handles, *known])
    return figure


def _draw_parts(axes, table):
    # the parts are those of the instrument and the same for every target: the first will do
    axes.set_title("Residuals of the calibrations, which know neither telescope nor correlations")
    lam = st.nanometres(table["wavelength"])
    handles, values = [], []
    for (key, label), (color, marker) in zip(_PARTS.items(), st.looks(len(_PARTS)), strict=True):
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
        handles.append(st.draw_line(axes, lam, value, label=label, **look))
        values.append(value)
    st.scale_axis(axes, np.concatenate(values))
    return handles


def _draw_targets(axes, tables, key):
    lines, values = [], []
    # apart from the looks of the parts, which share the legend
    for table, (color, marker) in zip(tables, st.looks(len(tables) + 4)[4:], strict=True):
        lam, value = st.nanometres(table["wavelength"]), table[key].value
        # large open markers and wide lines below: of curves that coincide all are seen
        below = len(tables) - 1 - len(lines)
        look = {"color": color, "marker": marker, "linewidth": 1.5 + 2 * below}
        look |= {"markersize": 5.5 + 4.5 * below, "markeredgewidth": 1.5}
        look |= {"markerfacecolor": "none"} if below else {}
        lines.append(st.draw_line(axes, lam, value, label=f"target of {_words(table)}", **look))
        values.append(value)
    if not np.isfinite(values).any():
        axes.set_yticks([])
        st.note(axes, "open: the data of the calibration do not determine it")
    else:
        st.scale_axis(axes, np.concatenate(values))
    return lines


def _words(table):
    angle = table.meta["aolp"]
    dolp = u.Quantity(table.meta["dolp"]).to_value(u.percent)
    where = "at its worst angle" if angle is None else f"at {angle.to_value(u.deg):g}°"
    return f"{dolp:g} % {where}"


# ---- a standard star ------------------------------------------------------------------------
_QUANTITIES = (("dolp", "percent", "DoLP (%)", "%"), ("aolp", "deg", "AoLP (°)", "°"))


def plot_star_check(calibration, entry=None, *, figure=None):
    """
    Draw degree and angle of polarization of a standard star against wavelength.

    Parameters
    ----------
    calibration : Calibration
        A calibration that was checked with a star; one read from a file will do.
    entry : dict, optional
        One of ``calibration.fit["stars"]``, by default the last.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Left the degree, right the angle: above observed and catalogue, below their
        difference. Bars are standard errors of the mean over the cycles; the dashes
        are the rms error of single cycles.

    Raises
    ------
    ObservationError
        If the calibration was checked with no star.

    Notes
    -----
    The figure of the polarized standard of McIntosh et al. (2026, appendix).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments, optics
    >>> from astropolcal.calibration.validation.stars import add_star_check
    >>> from astropolcal.plotting import plot_star_check
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> lam = [1.2, 1.6, 2.2] * u.um
    >>> chain = charis.chain(derotator="linear", wavelength=lam)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, lam, frames, seed=2))
    >>> sky = optics.PolarizedSource(u=0.01, name="star") | chain["hwp"] | chain["derotator"]
    >>> sky = sky | chain["wollaston"]
    >>> night = simulate(sky, lam, frames, seed=3, meta={"object": "HD 30675"})
    >>> table = add_star_check(cal, sky, night)
    >>> len(plot_star_check(cal).axes)
    4
    """
    if entry is None:
        if not calibration.fit.get("stars"):
            raise ObservationError("the calibration was checked with no star: nothing to draw")
        entry = calibration.fit["stars"][-1]
    values = {key: np.asarray(value) for key, value in entry.items() if isinstance(value, list)}
    with st.canvas(figure, 12, 6.4) as figure:
        panels = figure.subplots(2, 2, sharex=True, height_ratios=(2, 1))
        for (top, bottom), (key, unit, label, short) in zip(panels.T, _QUANTITIES, strict=True):
            # lines are drawn through the points as they come
            order = np.argsort(values["wavelength_nm"])
            lam = values["wavelength_nm"][order]
            seen, error, known, spread, off = (
                values[f"{key}{part}_{unit}"][order]
                for part in ("", "_err", "_known", "_known_err", "_error")
            )
            points = {"color": st.BLUE, "marker": "o", "linestyle": "none"}
            observed = f"observed, with 1{st.SIGMA} errors of the mean"
            top.errorbar(lam, seen, yerr=np.nan_to_num(error), label=observed, **points)
            # a star whose polarization no catalogue has is drawn alone
            if np.isfinite(known).any():
                look = {"color": st.VERMILION, "label": "catalogue, with the published errors"}
                st.draw_line(top, lam, known, **look)
                st.draw_band(top, lam, known, spread, st.VERMILION, 0.2)
            bottom.axhline(0, color=st.GREY, linewidth=1)
            bottom.errorbar(lam, off, yerr=np.nan_to_num(error), **points)
            # of the angle no such error is known
            if key == "dolp":
                single = values["s_dolp_percent"][order]
                look = {"color": st.GREY, "linestyle": "--"}
                st.draw_line(bottom, lam, single, label="± rms error of a single cycle", **look)
                st.draw_line(bottom, lam, -single, **look)
            top.set_ylabel(label)
            bottom.set_ylabel(f"obs. {st.MINUS} catalogue\n({short})")
            st.wavelength_label(bottom)
        what = f"{entry['star']}, which no fit saw"
        st.heading(figure, calibration, what, [entry["name"]])
        st.legend_outside(figure, list(st.legend_entries(panels.ravel()).values()), columns=2)
    return figure
