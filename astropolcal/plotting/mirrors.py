# Licensed under a 3-clause BSD style license - see LICENSE
"""Diattenuation and retardance of mirrors, beside those of metals."""

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.calibration.uncertainty.derived import METALS, mirror_names, mirror_values
from astropolcal.exceptions import ChainError, InstrumentError
from astropolcal.plotting._style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SIGMA,
    SKY,
    canvas,
    heading,
    legend_entries,
    legend_outside,
    nanometres,
    style,
    wavelength_label,
)

__all__ = ["plot_mirrors"]

# dashes of their own: a thin metal line must not look like a fit
_METAL_LOOKS = dict(zip(METALS, ((SKY, "--"), (ORANGE, "-."), (GREEN, ":")), strict=True))
_LAW_ALONE = "fitted law, not determined: a choice of the law"
_LABELS = {"diattenuation": "diattenuation (%)", "retardance": "retardance (°)"}


def plot_mirrors(calibration, names=None, reference=None, *, figure=None):
    """
    Draw diattenuation and retardance of mirrors against wavelength, beside those of bare metals.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    names : sequence of str, optional
        Mirrors, by default all, see `~astropolcal.calibration.uncertainty.derived.mirror_names`.
    reference : dict of str to dict, optional
        Name of a mirror to others that it is compared with, by label, such as
        ``{"m3": {"published": published_mirror()}}``; anything with the methods ``diattenuation``
        and ``retardance`` of a wavelength. By default what is published of the instrument.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        One column a mirror: above its diattenuation, below its retardance. What is held
        is hollow; what follows a law is a line with its 1 sigma band. The metals are silver, gold
        and aluminium at 45 deg, with the indices of Rakić et al. (1998).

    Raises
    ------
    ChainError
        If there is no such mirror.

    Notes
    -----
    The figures of the fold mirror and of the tertiary mirror of McIntosh et al. (2026).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, optics
    >>> from astropolcal.plotting import plot_mirrors
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = (optics.Diattenuator(diattenuation=[0.01] * 3, name="fold_mirror")
    ...          | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(fixed={"efficiency": True}, name="wollaston"))
    >>> chain["hwp"].retardance.fixed = True
    >>> data = simulate(chain, [1.2, 1.6, 2.2] * u.um, half_wave_plate_cycles(), seed=2)
    >>> cal = calibrate(chain, data)
    >>> [axes.get_title() for axes in plot_mirrors(cal).axes]
    ['fold_mirror']
    """
    names = mirror_names(calibration) if names is None else list(names)
    if not names:
        raise ChainError("the calibration has no mirror to draw")
    tables = [mirror_values(calibration, name) for name in names]
    # an empty dict is a wish to see none
    reference = _published(calibration) if reference is None else reference
    rows = ["diattenuation"]
    if any("retardance" in table.colnames for table in tables):
        rows.append("retardance")
    with style():
        figure = canvas(figure, 2.5 + 5 * len(names), 2.4 + 3.2 * len(rows))
        # mirrors side by side on one scale
        panels = figure.subplots(len(rows), len(names), sharex=True, sharey="row", squeeze=False)
        for column, table in zip(panels.T, tables, strict=True):
            column[0].set_title(table.meta["name"])
            shown = [
                (axes, key) for axes, key in zip(column, rows, strict=True) if key in table.keys()
            ]
            for axes, key in shown:
                _draw(axes, calibration, table, key, reference.get(table.meta["name"], {}))
                axes.set_ylabel(_LABELS[key])
                axes.tick_params(labelleft=True)
            # a mirror that only attenuates has no lower panel
            for axes in column[len(shown) :]:
                axes.remove()
            last = column[len(shown) - 1]
            last.tick_params(labelbottom=True)
            wavelength_label(last)
        heading(figure, calibration, "Mirrors")
        _legend(figure, panels)
    return figure


def _published(calibration):
    try:
        return instruments.get(calibration.instrument).published_mirrors()
    except InstrumentError:
        return {}


def _draw(axes, calibration, table, key, reference):
    lam = nanometres(table["wavelength"])
    order = np.argsort(lam)
    _draw_metals(axes, lam[order], table[order], key)
    for i, (label, mirror) in enumerate(reference.items()):
        value = getattr(mirror, key)(table["wavelength"][order])
        value = value.to_value(u.deg) if key == "retardance" else 100 * value
        axes.plot(lam[order], value, color=BLACK, linestyle=("-", "--", "-.")[i % 3], label=label)
    _draw_values(axes, lam[order], table[order], key, _has_law(calibration, table.meta["name"]))


def _draw_metals(axes, lam, table, key):
    for metal, (color, line) in _METAL_LOOKS.items():
        axes.plot(lam, table[f"{key}_{metal}"].value, color=color, linestyle=line, label=metal)


def _has_law(calibration, name):
    """Return whether the values follow a law in wavelength."""
    # with a law the diattenuation is computed and no parameter
    return f"{name}.diattenuation" not in calibration.parameter_values()


def _draw_values(axes, lam, table, key, law):
    value, std = table[key].value, table[f"{key}_err"].value
    known, look = np.isfinite(std), {"color": BLUE}
    if law:
        label = f"fitted law, with 1{SIGMA} band" if known.all() else _LAW_ALONE
        line = "-" if known.all() else (0, (5, 1))
        axes.plot(lam, value, linewidth=2.2, linestyle=line, label=label, **look)
        axes.fill_between(lam, value - std, value + std, alpha=0.3, linewidth=0, **look)
        return
    points = look | {"marker": "o", "linestyle": "none"}
    if known.any():
        label = f"fitted, with 1{SIGMA} error"
        axes.errorbar(lam[known], value[known], yerr=std[known], label=label, **points)
    if not known.all():
        held = key == "retardance" and table.meta["held"]
        label = "held, not fitted" if held else "no error: not determined alone, or at a bound"
        axes.plot(lam[~known], value[~known], markerfacecolor="white", label=label, **points)


def _legend(figure, panels):
    entries = {
        f"{label} (bare, 45°)" if label in METALS else label: handle
        for label, handle in legend_entries(panels.ravel()).items()
    }
    # sorting is stable: what was calibrated stays in its order, the metals come last
    ordered = sorted(entries, key=lambda label: "bare" in label)
    handles = [entries[label] for label in ordered]
    for handle, label in zip(handles, ordered, strict=True):
        handle.set_label(label)
    legend_outside(figure, handles, columns=2)
