# Licensed under a 3-clause BSD style license - see LICENSE
"""Points and lines of parameters, which tell how well each is known."""

import astropy.units as u
import numpy as np

from astropolcal.plotting._style import (
    BLACK,
    GREY,
    SIGMA,
    legend_entries,
    legend_outside,
    nanometres,
)

_DETERMINED = f"fitted, with 1{SIGMA} error"
_ALONE = "hollow: not determined alone, so no error"
_BOUND = "boxed: at a bound, so no error"
_FIXED = "fixed"
_STAGE = "fitted per wavelength (first step of two), modulo 360°"
_LAW = f"law fitted to all wavelengths, with 1{SIGMA} band"
_LAW_ALONE = "law fitted to all wavelengths (no error: not determined alone)"
_ORDER = (_DETERMINED, _ALONE, _BOUND, _LAW, _LAW_ALONE, _STAGE)
_FINE = 201
# how near to half a wave a panel must be to show that line (deg)
_NEAR_HALF_WAVE = 45
_STEP = 1e-3
_TITLE_WIDTH = 58


def draw_entry(axes, calibration, entry, look):
    """Draw one parameter, an entry of ``Calibration.parameter_values``, against wavelength."""
    if not entry["value"].ndim:
        _draw_constant(axes, calibration, entry, look[0])
        return
    lam = nanometres(calibration.wavelength)
    color, marker = look
    order = np.argsort(lam)
    if entry["fixed"] or entry["tied"]:
        label = f"follows {entry['tied']}" if entry["tied"] else _FIXED
        axes.plot(lam[order], entry["value"][order], color=color, linestyle=":", label=label)
        return
    # the thin line only leads the eye through points of different kind
    axes.plot(lam[order], entry["value"][order], color=color, linewidth=0.6, alpha=0.6)
    _draw_points(axes, lam, entry, color, marker)


def _draw_points(axes, lam, entry, color, marker):
    value, std, bound = entry["value"], entry["std"], entry["at_bound"]
    known = np.isfinite(std) & ~bound
    look = {"color": color, "marker": marker, "linestyle": "none"}
    if known.any():
        axes.errorbar(lam[known], value[known], yerr=std[known], label=_DETERMINED, **look)
    if (~known).any():
        label = _ALONE if (~known & ~bound).any() else None
        axes.plot(lam[~known], value[~known], markerfacecolor="white", label=label, **look)
    if bound.any():
        axes.plot(
            lam[bound],
            value[bound],
            marker="s",
            markersize=12,
            linestyle="none",
            markerfacecolor="none",
            color=BLACK,
            label=_BOUND,
            clip_on=False,
        )


def _draw_constant(axes, calibration, entry, color):
    """Draw a parameter that has one value for all wavelengths."""
    lam = nanometres(calibration.wavelength)
    ends = np.array([lam.min(), lam.max()])
    value, std = float(entry["value"]), float(entry["std"])
    kind = _FIXED if entry["fixed"] else "one value for all wavelengths"
    note = "" if np.isfinite(std) or entry["fixed"] else ", at a bound"
    if note and not entry["at_bound"]:
        note = ", not determined alone"
    axes.plot(ends, [value, value], color=color, label=kind + note)
    if np.isfinite(std):
        axes.fill_between(ends, value - std, value + std, color=color, alpha=0.25, linewidth=0)


# ---- laws in wavelength ----------------------------------------------------------


def draw_law(axes, calibration, leaf, known, look):
    """Draw a retardance that follows a law, its band, and the stages' points."""
    lam = nanometres(calibration.wavelength)
    # a law is smooth between the wavelengths unless its parameters are given at these
    if not any(np.size(getattr(leaf, key).value) > 1 for key in leaf.param_names):
        lam = np.linspace(lam.min(), lam.max(), _FINE)
    lam = np.sort(lam)
    value, std = _retardance(leaf, lam), _law_std(calibration, leaf, lam)
    own = {key: known[f"{leaf.name}.{key}"] for key in leaf.own_names}
    free = any(not entry["fixed"] for entry in own.values())
    label = (_LAW_ALONE if std is None else _LAW) if free else f"law, {_FIXED}"
    axes.plot(lam, value, color=look[0], label=label)
    if std is not None:
        axes.fill_between(lam, value - std, value + std, color=look[0], alpha=0.3, linewidth=0)
    _draw_stage(axes, calibration, leaf)
    shown = {key: entry for key, entry in own.items() if not entry["fixed"]} or own
    words = [", ".join(row) for row in _in_rows(_words(shown))]
    axes.set_title("\n".join([f"{leaf.name}: law", *words]))


def _retardance(leaf, lam):
    return np.atleast_1d(leaf.retardance(lam * u.nm).to_value(u.deg))


def _law_std(calibration, leaf, lam):
    """Return the 1 sigma error of the law, or None where a parameter has none."""
    covariance = calibration.covariance
    rows = [
        (key, covariance.names.index(f"{leaf.name}.{key}"))
        for key in leaf.own_names
        if f"{leaf.name}.{key}" in covariance.names
    ]
    if not rows:
        return None
    index = [i for _, i in rows]
    matrix = covariance.matrix[np.ix_(index, index)]
    if not np.isfinite(matrix).all():
        return None
    slopes = np.stack([_slope(leaf, key, lam) for key, _ in rows])
    # sigma^2(lambda) = g^T C g with the slopes g (n_parameters, n_wavelengths)
    return np.sqrt(np.clip(np.einsum("in,ij,jn->n", slopes, matrix, slopes), 0, None))


def _slope(leaf, key, lam):
    """Return the derivative of the law to a parameter, per its unit, by central differences."""
    parameter = getattr(leaf, key)
    unit = 1 if parameter.unit is None else parameter.unit
    # relative, but for parameters that are zero
    step = _STEP * max(abs(float(parameter.value)), 1e-6)
    high, low = (
        _retardance(leaf.with_parameters(**{key: (parameter.value + sign * step) * unit}), lam)
        for sign in (1, -1)
    )
    return (high - low) / (2 * step)


def _draw_stage(axes, calibration, leaf):
    """Draw the retardances of the first stage that fitted one a wavelength."""
    lam = nanometres(calibration.wavelength)
    for stage in calibration.stages:
        value = stage["parameters"].get(f"{leaf.name}.retardance")
        if value is not None and np.size(value) == lam.size:
            value = u.Quantity(value, u.deg).value
            # a turn more or less is the same retarder: draw the one near the law
            value = value - 360 * np.round((value - _retardance(leaf, lam)) / 360)
            axes.plot(lam, value, "o", color=GREY, label=_STAGE)
            return


def _words(own):
    for key, entry in own.items():
        std = entry["std"]
        error = f" ± {float(std):.4f}" if np.ndim(std) == 0 and np.isfinite(std) else ""
        if np.ndim(entry["value"]) == 0:
            yield f"{key} = {float(entry['value']):.4f}{error} {entry['unit'] or ''}".rstrip()


def _in_rows(words):
    """Yield lists of words that are not too long for a title."""
    row = []
    for word in words:
        if row and len(", ".join([*row, word])) > _TITLE_WIDTH:
            yield row
            row = []
        row.append(word)
    yield row


def mark_half_wave(axes):
    """Draw the line of a perfect half-wave plate where the data come near to it."""
    # the limits of the data, not of the axes, which a line would widen
    low, high = axes.dataLim.intervaly
    for half in (180, -180):
        if abs(low - half) < _NEAR_HALF_WAVE and abs(high - half) < _NEAR_HALF_WAVE:
            axes.axhline(half, color=BLACK, linestyle="--", linewidth=1, label="half wave (±180°)")


# ---- legend -----------------------------------------------------------------------


def legend_of(figure, axes, calibration):
    """Put one legend for all panels below them: each label once, in neutral colours."""
    entries = legend_entries(axes)
    labels = [label for label in _ORDER if label in entries]
    labels += [label for label in entries if label not in labels]
    handles = [_neutral(entries[label], label) for label in labels]
    free = len(calibration.identifiability.directions)
    if _ALONE in labels and free:
        parameters = "combination of parameters" if free == 1 else "combinations of parameters"
        handles[labels.index(_ALONE)].set_label(
            f"{_ALONE} (the data leave {free} {parameters} open)"
        )
    return legend_outside(figure, handles)


def _neutral(handle, label):
    """Return a line for the legend; colours and markers differ between the panels."""
    from matplotlib.lines import Line2D

    line = handle[0] if isinstance(handle, tuple) else handle
    hollow = line.get_markerfacecolor() in ("white", "none")
    boxed = label == _BOUND
    points = line.get_linestyle() == "None"
    return Line2D(
        [],
        [],
        color=GREY if label == _STAGE else BLACK,
        linestyle=line.get_linestyle(),
        linewidth=line.get_linewidth(),
        marker=("s" if boxed else "o") if points else "",
        markersize=11 if boxed else line.get_markersize(),
        markerfacecolor=("none" if boxed else "white") if hollow else None,
        label=label,
    )
