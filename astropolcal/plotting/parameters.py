# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrated parameters against wavelength, with what is known of their errors."""

import textwrap

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.calibration.uncertainty.derived import mirror_names
from astropolcal.chain import leaves
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.plotting._points import draw_entry, draw_law, legend_of, mark_half_wave
from astropolcal.plotting._style import canvas, heading, looks, style, wavelength_label
from astropolcal.words import did_you_mean

__all__ = ["plot_efficiency", "plot_parameters", "plot_retardances"]

#: Parameters that are retardances, and how to call them (paper, Eq. of the elliptical retarder).
_RETARDANCES = {
    "horizontal": r"horizontal retardance $\Delta_H$",
    "diagonal": r"45° retardance $\Delta_{45}$",
    "circular": r"circular retardance $\Delta_R$",
    "retardance": r"retardance $\Delta$",
}
# longer labels do not fit beside a panel
_LABEL_WIDTH = 28
_EFFICIENCY = r"modulation efficiency $|\eta|$"


def plot_retardances(calibration, *, figure=None):
    """
    Draw the retardances of every retarder against wavelength.

    Parameters given per wavelength are points: filled with an error bar where
    the data determine them alone, hollow where they trade off with others,
    squared where they sit at a bound. A law in wavelength is a line with its
    1 sigma band; where the calibration has two-step stages, the retardances
    fitted for each wavelength are dots beside it.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        One panel a retardance.

    Raises
    ------
    ChainError
        If the chain has no retarder.

    Notes
    -----
    The figures of the derotator's and the half-wave plate's retardance of
    McIntosh et al. (2026).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_retardances
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(plot_retardances(cal).axes)
    2
    """
    known = calibration.parameter_values()
    panels = [
        (leaf, key)
        for leaf in _optics(calibration).values()
        for key in _RETARDANCES
        if _has_retardance(leaf, key, known)
    ]
    if not panels:
        raise ChainError("the chain has no retarder, so it has no retardances to draw")
    with style():
        figure, axes = _grid(figure, len(panels))
        for one, (leaf, key), look in zip(axes, panels, looks(len(panels)), strict=True):
            if key in leaf.param_names:
                entry = known[f"{leaf.name}.{key}"]
                draw_entry(one, calibration, entry, look)
                one.set_title(f"{leaf.name}: {key}")
            else:
                draw_law(one, calibration, leaf, known, look)
            mark_half_wave(one)
            one.set_ylabel(f"{_RETARDANCES[key]} (°)")
        _finish(figure, axes, calibration, "Retardances")
    return figure


def _has_retardance(leaf, key, known):
    """Return whether an optic retards in this way: a law, or a parameter that is not fixed at 0."""
    if key in leaf.param_names:
        entry = known[f"{leaf.name}.{key}"]
        # a component that is held at zero is one that the retarder does not have
        return not entry["fixed"] or bool(np.any(entry["value"] != 0))
    law = getattr(leaf, key, None)
    # a law is a method; astropy's parameters can be called, too
    return callable(law) and not isinstance(law, Parameter)


def plot_efficiency(calibration, *, figure=None):
    """
    Draw the modulation efficiency of the beam splitter against wavelength.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ChainError
        If no optic has an efficiency.

    Notes
    -----
    Points as in `plot_retardances`. The fit also absorbs depolarization that
    the chain neglects (McIntosh et al. 2026).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_efficiency
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(plot_efficiency(cal).axes)
    1
    """
    known = calibration.parameter_values()
    names = [name for name in known if name.endswith(".efficiency")]
    if not names:
        raise ChainError("no optic of the chain has an efficiency to draw")
    with style():
        figure, axes = _grid(figure, len(names))
        for one, name, look in zip(axes, names, looks(len(names)), strict=True):
            draw_entry(one, calibration, known[name], look)
            # above 1 there is no physical efficiency
            one.axhline(1, color="black", linestyle="--", linewidth=1, label="perfect: 1")
            one.set_title(name)
            one.set_ylabel(_EFFICIENCY)
        _finish(figure, axes, calibration, "Modulation efficiency")
    return figure


def plot_parameters(calibration, names=None, *, figure=None):
    """
    Draw any parameters against wavelength, one panel each.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    names : sequence of str, optional
        ``"optic.parameter"``; by default all free parameters that have one
        value a wavelength.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Points as in `plot_retardances`; a parameter with one value is a line.

    Raises
    ------
    ParameterError
        If there is no such parameter.
    ChainError
        If no parameter is left to draw.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_parameters
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> [axes.get_title() for axes in plot_parameters(cal).axes]
    ['derotator.retardance', 'wollaston.efficiency']
    """
    known = calibration.parameter_values()
    names = _per_wavelength(known) if names is None else list(names)
    for name in names:
        _check_name(name, known)
    if not names:
        raise ChainError("no free parameter has one value a wavelength: nothing to draw")
    optics = _optics(calibration)
    with style():
        figure, axes = _grid(figure, len(names))
        for one, name, look in zip(axes, names, looks(len(names)), strict=True):
            draw_entry(one, calibration, known[name], look)
            optic, _, key = name.rpartition(".")
            one.set_title(name)
            one.set_ylabel(_describe(getattr(optics[optic], key)))
        _finish(figure, axes, calibration, "Parameters for each wavelength")
    return figure


def _check_name(name, known):
    if name not in known:
        raise ParameterError(
            f"no parameter {name!r}; allowed are {', '.join(known)}{did_you_mean(name, known)}"
        )


def _describe(parameter):
    words = textwrap.fill(parameter.__doc__ or parameter.name, _LABEL_WIDTH)
    if parameter.unit is None or parameter.unit == u.dimensionless_unscaled:
        return words
    return f"{words} ({'°' if parameter.unit == u.deg else parameter.unit})"


def _per_wavelength(known):
    return [
        name
        for name, entry in known.items()
        if entry["value"].ndim and (not entry["fixed"] or entry["tied"])
    ]


def other_parameters(calibration):
    """Return the free parameters given per wavelength that no other figure shows."""
    shown = {*_RETARDANCES, "efficiency"}
    mirrors = {f"{name}.diattenuation" for name in mirror_names(calibration)}
    names = _per_wavelength(calibration.parameter_values())
    return [n for n in names if n not in mirrors and n.rpartition(".")[2] not in shown]


# ---- common to all figures of parameters ------------------------------------------


def _optics(calibration):
    """Return the optics of all chains by name, in the order the light travels."""
    return {leaf.name: leaf for chain in calibration.chains for leaf in leaves(chain)}


def _grid(figure, count):
    """Return a figure and its ``count`` panels, two a row where there are more than two."""
    columns = 2 if count > 2 else 1
    rows = -(-count // columns)
    figure = canvas(figure, 1.5 + 5.2 * columns if columns == 2 else 8.5, 2.0 + 3.1 * rows)
    spec = figure.add_gridspec(rows, columns)
    first, axes = None, []
    for i in range(count):
        # all on one wavelength axis, labelled at the lowest panels alone
        axes.append(figure.add_subplot(spec[divmod(i, columns)], sharex=first))
        first = axes[0]
        if i + columns >= count:
            wavelength_label(axes[-1])
        else:
            axes[-1].tick_params(labelbottom=False)
    return figure, axes


def _finish(figure, axes, calibration, what):
    heading(figure, calibration, what)
    legend_of(figure, axes, calibration)
