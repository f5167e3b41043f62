# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrated parameters against wavelength and date, with what is known of their errors."""

import textwrap
from contextlib import suppress
from datetime import timedelta
from itertools import pairwise

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter
from astropy.time import Time

from astropolcal import instruments
from astropolcal.calibration.uncertainty import derived
from astropolcal.chain import leaves
from astropolcal.exceptions import ChainError, FitError, InstrumentError, ParameterError
from astropolcal.pipeline.history import named_by_date, parameter_history, significance
from astropolcal.plotting import _style as st
from astropolcal.words import check_choice, counted

__all__ = ["plot_efficiency", "plot_history", "plot_mirrors", "plot_retardances"]

# ---- points and lines of a parameter ----------------------------------------------------------
_DETERMINED = f"fitted, with 1{st.SIGMA} error"
_ALONE = "hollow: not determined alone, so no error"
_BOUND = "boxed: at a bound, so no error"
_FIXED = "fixed"
_STAGE = "fitted per wavelength (first step of two), modulo 360°"
_LAW = f"law fitted to all wavelengths, with 1{st.SIGMA} band"
_LAW_ALONE = "law fitted to all wavelengths (no error: not determined alone)"
_ORDER = (_DETERMINED, _ALONE, _BOUND, _LAW, _LAW_ALONE, _STAGE)
# how near to half a wave a panel must be to show that line (deg)
_NEAR_HALF_WAVE = 45


def _entries(calibration):
    """Return the parameters by name; what follows a law of the wavelength has its value at each."""
    known = calibration.parameter_values()
    for i, chain in enumerate(calibration.chains):
        laws = ((o.name, key, law.of) for o in leaves(chain) for key, law in o._follows.items())
        for optic, key in ((optic, key) for optic, key, of in laws if of == ("wavelength",)):
            found = derived.of_optic(calibration, i, optic, [key])
            value, std = np.asarray(found.value), np.asarray(found.std)
            std = np.where(found.is_determined, std, np.nan)
            own = {"value": value, "std": std, "at_bound": np.zeros(value.shape, dtype=bool)}
            known[f"{optic}.{key}"] |= own | {"fixed": False}
    return known


def _draw_entry(axes, calibration, entry, look):
    """Draw one parameter, an entry of ``Calibration.parameter_values``, against wavelength."""
    lam, (color, marker) = st.nanometres(calibration.wavelength), look
    if not entry["value"].ndim:
        (x,) = st.widened(lam)
        ends = x[[0, -1]]
        value, std = float(entry["value"]), float(entry["std"])
        label = _FIXED if entry["fixed"] else "one value for all wavelengths"
        if not (np.isfinite(std) or entry["fixed"]):
            label += ", at a bound" if entry["at_bound"] else ", not determined alone"
        axes.plot(ends, [value, value], color=color, label=label)
        if np.isfinite(std):
            st.draw_band(axes, ends, value, std, color, 0.25)
    elif entry["fixed"] or entry["tied"]:
        label = f"follows {entry['tied']}" if entry["tied"] else _FIXED
        st.draw_line(axes, lam, entry["value"], color=color, linestyle=":", label=label)
    else:
        # the thin line only leads the eye through points of different kind
        st.draw_line(axes, lam, entry["value"], color=color, linewidth=0.6, alpha=0.6)
        value, std, bound = entry["value"], entry["std"], entry["at_bound"]
        known = np.isfinite(std) & ~bound
        label = _ALONE if (~known & ~bound).any() else None
        labels, points = (_DETERMINED, label), {"color": color, "marker": marker}
        st.draw_points(axes, lam, value, np.where(known, std, np.nan), labels, **points)
        if bound.any():
            box = {"marker": "s", "markersize": 12, "markerfacecolor": "none", "color": st.BLACK}
            box |= {"linestyle": "none", "clip_on": False, "label": _BOUND}
            axes.plot(lam[bound], value[bound], **box)


# ---- laws in wavelength ----------------------------------------------------------


def _draw_law(axes, calibration, leaf, known, look):
    """Draw a retardance that follows a law, its band, and the stages' points."""
    lam = np.sort(st.nanometres(calibration.wavelength))
    # a law is smooth between the wavelengths unless its parameters are given at these
    if lam.size > 1 and not any(getattr(leaf, key).size > 1 for key in leaf.param_names):
        lam = np.linspace(lam[0], lam[-1], 201)
    found = derived.of_law(calibration, leaf.name, "retardance", lam * u.nm)
    value, std = (x.to_value(u.deg) for x in (found.value, found.std))
    own = {key: known[f"{leaf.name}.{key}"] for key in leaf.own_names}
    free = {key: entry for key, entry in own.items() if not entry["fixed"]}
    label = f"law, {_FIXED}"
    if free:
        label = _LAW if found.is_determined.all() else _LAW_ALONE
    st.draw_line(axes, lam, value, color=look[0], label=label)
    if label == _LAW:
        st.draw_band(axes, lam, value, std, look[0], 0.3)
    # those of a first stage that fitted one per wavelength
    grid, name = st.nanometres(calibration.wavelength), f"{leaf.name}.retardance"
    stages = [stage["parameters"].get(name) for stage in calibration.stages]
    stages = [value for value in stages if value is not None and np.size(value) == grid.size]
    for value in stages[:1]:
        value = u.Quantity(value, u.deg).value
        # a turn more or less is the same retarder: draw the one near the law
        law = np.atleast_1d(leaf.retardance(grid * u.nm).to_value(u.deg))
        value = value - 360 * np.round((value - law) / 360)
        axes.plot(grid, value, "o", color=st.GREY, label=_STAGE)
    # lines break between the values alone
    words = ", ".join(word.replace(" ", "\N{NO-BREAK SPACE}") for word in _words(free or own))
    axes.set_title("\n".join([f"{leaf.name}: law", *textwrap.wrap(words, 58)]))


def _words(own):
    for key, entry in own.items():
        std = entry["std"]
        error = f" ± {float(std):.4f}" if np.ndim(std) == 0 and np.isfinite(std) else ""
        if np.ndim(entry["value"]) == 0:
            yield f"{key} = {float(entry['value']):.4f}{error} {entry['unit'] or ''}".rstrip()


# ---- legend -----------------------------------------------------------------------


def _legend(figure, axes, calibration):
    """Put one legend for all panels below them: each label once, in neutral colours."""
    entries = st.legend_entries(axes)
    # the kinds of points and lines come first
    labels = sorted(entries, key=lambda label: _ORDER.index(label) if label in _ORDER else 9)
    handles = {label: _neutral(entries[label], label) for label in labels}
    free = len(calibration.identifiability.directions)
    if _ALONE in handles and free:
        words = f"{_ALONE} (the data do not determine {counted(free, 'combination')} of parameters)"
        handles[_ALONE].set_label(words)
    return st.legend_outside(figure, list(handles.values()))


def _neutral(handle, label):
    """Return a line for the legend; colours and markers differ between the panels."""
    from matplotlib.lines import Line2D

    line = handle[0] if isinstance(handle, tuple) else handle
    look = {"linestyle": line.get_linestyle(), "linewidth": line.get_linewidth(), "label": label}
    look |= {"color": st.GREY if label == _STAGE else st.BLACK}
    if label == _BOUND:
        look |= {"marker": "s", "markersize": 11, "markerfacecolor": "none"}
    elif line.get_linestyle() == "None":
        hollow = "white" if line.get_markerfacecolor() == "white" else None
        look |= {"marker": "o", "markersize": line.get_markersize(), "markerfacecolor": hollow}
    return Line2D([], [], **look)


# ---- figures of parameters -------------------------------------------------------------------
#: Parameters that are retardances, and how to call them (paper, Eq. of the elliptical retarder).
_RETARDANCES = {
    "horizontal": r"horizontal retardance $\Delta_H$",
    "diagonal": r"45° retardance $\Delta_{45}$",
    "circular": r"circular retardance $\Delta_R$",
    "retardance": r"retardance $\Delta$",
}


def plot_retardances(calibration, *, figure=None):
    """
    Draw the retardances of every retarder against wavelength.

    Parameters given per wavelength are points: filled with an error bar where the data determine
    them alone, hollow where they trade off with others, squared where they sit at a bound. A law in
    wavelength is a line with its 1 sigma band; where the calibration has two-step stages, the
    retardances fitted for each wavelength are dots beside it.

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
    The figures of the derotator's and the half-wave plate's retardance of McIntosh et al. (2026).

    Examples
    --------
    >>> from astropolcal.plotting import plot_retardances
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> len(plot_retardances(cal).axes)
    2
    """
    known = _entries(calibration)
    panels = [
        (leaf, key)
        for leaf in _optics(calibration).values()
        for key in _RETARDANCES
        if _has_retardance(leaf, key, known)
    ]
    if not panels:
        raise ChainError("the chain has no retarder, so it has no retardances to draw")

    def draw(axes, panel, look):
        leaf, key = panel
        if key in leaf.param_names:
            _draw_entry(axes, calibration, known[f"{leaf.name}.{key}"], look)
            axes.set_title(f"{leaf.name}: {key}")
        else:
            _draw_law(axes, calibration, leaf, known, look)
        low, high = axes.dataLim.intervaly
        for half in (180, -180):
            if abs(low - half) < _NEAR_HALF_WAVE and abs(high - half) < _NEAR_HALF_WAVE:
                look = {"color": st.BLACK, "linestyle": "--", "linewidth": 1}
                axes.axhline(half, label="half wave (±180°)", **look)
        axes.set_ylabel(f"{_RETARDANCES[key]} (°)")

    return _draw_all(figure, calibration, "Retardances", panels, draw)


def _has_retardance(leaf, key, known):
    """Return whether an optic retards in this way: a law, or a parameter that is not fixed at 0."""
    if key in leaf.param_names:
        if key not in derived.retardances_of(leaf):
            return False
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
    >>> from astropolcal.plotting import plot_efficiency
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> len(plot_efficiency(cal).axes)
    1
    """
    known = _entries(calibration)
    names = [name for name in known if name.endswith(".efficiency")]
    if not names:
        raise ChainError("no optic of the chain has an efficiency to draw")

    def draw(axes, name, look):
        _draw_entry(axes, calibration, known[name], look)
        # above 1 there is no physical efficiency
        axes.axhline(1, color="black", linestyle="--", linewidth=1, label="perfect: 1")
        axes.set(title=name, ylabel=r"modulation efficiency $|\eta|$")

    return _draw_all(figure, calibration, "Modulation efficiency", names, draw)


def plot_parameters(calibration, names=None, *, figure=None):
    """
    Draw any parameters against wavelength, one panel each; points as in `plot_retardances`.

    ``names`` are ``"optic.parameter"``, by default all free ones given per wavelength.
    """
    known = _entries(calibration)
    names = _per_wavelength(known) if names is None else list(names)
    for name in names:
        check_choice("parameter", name, known, ParameterError)
    if not names:
        raise ChainError("no free parameter has one value per wavelength: nothing to draw")
    optics = _optics(calibration)

    def draw(axes, name, look):
        _draw_entry(axes, calibration, known[name], look)
        optic, _, key = name.rpartition(".")
        parameter = getattr(optics[optic], key)
        # longer labels do not fit beside a panel
        words = textwrap.fill(parameter.__doc__ or parameter.name, 28)
        if parameter.unit is not None and parameter.unit != u.dimensionless_unscaled:
            words += f" ({'°' if parameter.unit == u.deg else parameter.unit})"
        axes.set(title=name, ylabel=words)

    return _draw_all(figure, calibration, "Parameters for each wavelength", names, draw)


def _per_wavelength(known):
    return [
        name
        for name, entry in known.items()
        if entry["value"].ndim and (not entry["fixed"] or entry["tied"])
    ]


def other_parameters(calibration):
    """Return the free parameters given per wavelength that no other figure shows."""
    optics = _optics(calibration).values()
    shown = {f"{leaf.name}.{key}" for leaf in optics for key in derived.retardances_of(leaf)}
    shown |= {f"{name}.diattenuation" for name in derived.mirror_names(calibration)}
    names = _per_wavelength(calibration.parameter_values())
    return [n for n in names if n not in shown and not n.endswith(".efficiency")]


# ---- common to all figures of parameters ------------------------------------------


def _optics(calibration):
    """Return the optics of all chains by name, in the order the light travels."""
    return {leaf.name: leaf for chain in calibration.chains for leaf in leaves(chain)}


def _draw_all(figure, calibration, title, panels, draw):
    """Draw panels, two a row where there are more than two, with one legend for all."""
    columns = 2 if len(panels) > 2 else 1
    height = 2.0 + 3.1 * -(-len(panels) // columns)
    with st.canvas(figure, 11.9 if columns == 2 else 8.5, height) as figure:
        axes, lowest = st.grid(figure, len(panels), columns, sharex=True)
        for one, panel, look in zip(axes, panels, st.looks(len(panels)), strict=True):
            draw(one, panel, look)
        for one in lowest:
            st.wavelength_label(one)
        st.heading(figure, calibration, title)
        _legend(figure, axes, calibration)
    return figure


# ---- mirrors --------------------------------------------------------------------------------
# dashes of their own: a thin metal line must not look like a fit
_METAL_LOOKS = ((st.SKY, "--"), (st.ORANGE, "-."), (st.GREEN, ":"))
_MIRROR_LAW_ALONE = "fitted law, not determined: a choice of the law"


def plot_mirrors(calibration, names=None, reference=None, *, figure=None):
    """
    Draw diattenuation and retardance of mirrors against wavelength, beside those of bare metals.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    names : sequence of str, optional
        Mirrors whose diattenuation is given per wavelength; by default all.
    reference : dict of str to dict, optional
        Name of a mirror to others that it is compared with, by label, such as
        ``{"m3": {"published": published_mirror()}}``; anything with the methods ``diattenuation``
        and ``retardance`` of a wavelength. By default what is published of the instrument.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        One column per mirror: above its diattenuation, below its retardance. What is held
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
    names = derived.mirror_names(calibration) if names is None else list(names)
    if not names:
        raise ChainError("the calibration has no mirror to draw")
    tables = [derived.mirror_values(calibration, name) for name in names]
    # an empty dict is a wish to see none
    if reference is None:
        reference = {}
        with suppress(InstrumentError):
            reference = instruments.get(calibration.instrument).published_mirrors()
    retards = any("retardance" in table.colnames for table in tables)
    rows = ["diattenuation", "retardance"][: 1 + retards]
    with st.canvas(figure, 2.5 + 5 * len(names), 2.4 + 3.2 * len(rows)) as figure:
        # mirrors side by side on one scale
        panels = figure.subplots(len(rows), len(names), sharex=True, sharey="row", squeeze=False)
        for column, table in zip(panels.T, tables, strict=True):
            column[0].set_title(table.meta["name"])
            for axes, key in zip(column, rows, strict=True):
                # a mirror that only attenuates has no lower panel
                if key not in table.colnames:
                    axes.remove()
                    continue
                _draw_mirror(axes, calibration, table, key, reference.get(table.meta["name"], {}))
                axes.set_ylabel(f"{key} ({'°' if key == 'retardance' else '%'})")
                axes.tick_params(labelleft=True)
                lowest = axes
            lowest.tick_params(labelbottom=True)
            st.wavelength_label(lowest)
        st.heading(figure, calibration, "Mirrors")
        entries = st.legend_entries(panels.ravel())
        # sorting is stable: what was calibrated stays in its order, the metals come last
        for label in sorted(entries, key=lambda label: label in derived.METALS):
            handle = entries[label] = entries.pop(label)
            handle.set_label(f"{label} (bare, 45°)" if label in derived.METALS else label)
        st.legend_outside(figure, list(entries.values()), columns=2)
    return figure


def _draw_mirror(axes, calibration, table, key, reference):
    table = table[np.argsort(table["wavelength"])]
    lam, name = st.nanometres(table["wavelength"]), table.meta["name"]
    for metal, (color, line) in zip(derived.METALS, _METAL_LOOKS, strict=True):
        value = table[f"{key}_{metal}"].value
        st.draw_line(axes, lam, value, color=color, linestyle=line, label=metal)
    for i, (label, mirror) in enumerate(reference.items()):
        value = getattr(mirror, key)(table["wavelength"])
        value = value.to_value(u.deg) if key == "retardance" else 100 * value
        look = {"color": st.BLACK, "linestyle": ("-", "--", "-.")[i % 3]}
        st.draw_line(axes, lam, value, label=label, **look)
    value, std = table[key].value, table[f"{key}_err"].value
    # with a law in wavelength the diattenuation is computed and no parameter
    if f"{name}.diattenuation" in calibration.parameter_values():
        held = key == "retardance" and table.meta["held"]
        hollow = "held, not fitted" if held else "no error: not determined alone, or at a bound"
        st.draw_points(axes, lam, value, std, (_DETERMINED, hollow), color=st.BLUE, marker="o")
        return
    known = np.isfinite(std).all()
    label = f"fitted law, with 1{st.SIGMA} band" if known else _MIRROR_LAW_ALONE
    look = {"linestyle": "-" if known else (0, (5, 1)), "linewidth": 2.2, "color": st.BLUE}
    st.draw_line(axes, lam, value, label=label, **look)
    st.draw_band(axes, lam, value, std, st.BLUE, 0.3)


# ---- history --------------------------------------------------------------------------------
_MOST_PANELS = 12


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
        the grid; they stand side by side so that their errors can be distinguished.
    title : str, optional
        Title of the figure.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        One panel per parameter: values with errors, open symbols where a value was held; between
        two calibrations how surely they differ, over all wavelengths. Of a parameter
        per wavelength the differences to its mean over the calibrations.

    Raises
    ------
    ParameterError
        If there is no such parameter, a calibration has no date, or there are too many panels.

    Examples
    --------
    >>> from astropolcal.plotting import plot_history
    >>> from astropolcal.testing import example_calibration
    >>> years = [example_calibration(seed=i, date=f"202{i}-03-01") for i in (5, 6)]
    >>> len(plot_history(years, ["hwp"]).axes)
    3
    """
    table = parameter_history(calibrations, parameters)
    if np.any(table["date"].mask):
        without = table["calibration"][table["date"].mask][0]
        raise ParameterError(f"{without}: no date; state one with with_validity(valid_from=)")
    own = {name: table[table["parameter"] == name] for name in dict.fromkeys(table["parameter"])}
    own = {name: rows for name, rows in own.items() if not np.all(rows["fixed"])}
    if not 1 <= len(own) <= _MOST_PANELS:
        raise ParameterError(
            f"{len(own)} parameters to draw; allowed are 1 to {_MOST_PANELS}, choose with "
            "parameters="
        )
    columns = min(len(own), 2)
    with st.canvas(figure, 7.2 * columns, 3.6 * -(-len(own) // columns) + 0.6) as fig:
        axes, lowest = st.grid(fig, len(own), columns, sharex=True)
        for ax, (name, rows) in zip(axes, own.items(), strict=True):
            _draw_history(ax, rows, name, 6 if shown is None else shown)
            _mark_changes(ax, calibrations, rows, name)
        per_wavelength = np.isfinite(table["wavelength"].value).any()
        aside = "; wavelengths of one date side by side" if per_wavelength else ""
        for ax in lowest:
            ax.tick_params(axis="x", labelrotation=25)
            ax.set_xlabel(f"valid from (UTC{aside})")
        note = f"{st.SIGMA}: by how much neighbours differ, over all wavelengths"
        fig.suptitle(f"{title or 'Calibrated parameters over time'}\n{note}")
    return fig


def _draw_history(ax, own, name, most):
    """Draw one parameter; of several wavelengths the differences to the mean."""
    lam = np.unique(own["wavelength"].value)
    several = np.isfinite(lam).all()
    if several:
        lam = lam[np.unique(np.linspace(0, lam.size - 1, min(most, lam.size)).astype(int))]
    # the wavelengths of one calibration are spread over a share of the time axis; a single date has
    # no range to take it of: one day
    width = max(np.ptp(own["date"].mjd), 1.0) * 0.03 if several else 0.0
    offsets = np.linspace(-width, width, lam.size) if lam.size > 1 else [0.0]
    for wavelength, shift, (color, marker) in zip(lam, offsets, st.looks(lam.size), strict=True):
        here = own[own["wavelength"].value == wavelength] if several else own
        # retardances of the wavelengths differ by tens of degrees, their changes by tenths
        value = here["value"] - np.mean(here["value"]) if several else here["value"]
        label = f"{wavelength:.0f} nm" if several else None
        dates = Time(here["date"].mjd + shift, format="mjd").datetime
        ax.plot(dates, value, color=color, lw=0.8, alpha=0.6, zorder=1)
        points = {"color": color, "marker": marker, "zorder": 3}
        st.draw_points(ax, dates, value, here["std"], (label, None), **points)
    unit = f" ({own['unit'][0]})" if own["unit"][0] else ""
    ax.set(title=name, ylabel=f"{'difference to the mean' if several else 'value'}{unit}")
    ax.margins(y=0.18)
    if several:
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _mark_changes(ax, calibrations, own, name):
    """Write between neighbours how many sigma they differ by."""
    held = {row["calibration"]: row["date"].mjd for row in own}
    crowded = len(held) > 8
    for first, second in pairwise(named_by_date(calibrations)):
        try:
            found = significance([first, second], [name])
        except (ParameterError, FitError):
            continue
        # one tail of a normal law beyond three sigma; of many dates only such changes are marked
        sure = found.p_value < 0.00135
        if not (found.dof and {first[0], second[0]} <= set(held)) or (crowded and not sure):
            continue
        middle = Time((held[first[0]] + held[second[0]]) / 2, format="mjd").datetime
        look = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        look |= {"xytext": (0, -4), "ha": "center", "va": "top", "color": st.GREY}
        look |= {"color": "black", "fontweight": "bold"} if sure else {}
        ax.annotate(f"{found.sigma:.1f} {st.SIGMA}", (middle, 1), **look)


def draw_accuracies(group, goal=None, *, figure=None):
    """Draw the accuracies of the calibrations of `~astropolcal.pipeline.health` against date."""
    dated = [one for one in group["calibrations"] if one["date"] is not None]
    # half as wide as the page: a telephone shows it in full
    with st.canvas(figure, 5.4, 4.0) as fig:
        ax = fig.subplots()
        dates = Time([one["date"] for one in dated], scale="tai").datetime
        for key, color, marker, label in (
            ("s_cv_percent", st.BLUE, "o", "left-out frames (s_cv)"),
            ("s_res_percent", st.VERMILION, "s", "residuals of the fit (s_res)"),
        ):
            values = np.array([one[key] for one in dated], dtype=float)
            if np.isfinite(values).any():
                ax.plot(dates, values, color=color, marker=marker, lw=1, label=label)
        if goal is not None:
            ax.axhline(goal, color=st.BLACK, ls="--", lw=1, label="goal")
        for one in group["events"]:
            span = Time([one["from"], one["to"]], scale="tai").datetime
            ax.axvspan(*span, color=st.GREY, alpha=0.2, lw=0)
        ax.set(ylabel="accuracy (% of polarization)", xlabel="date of the calibration data (UTC)")
        # what is highest stays off the edge, even if it is all there is
        ax.set_ylim(0, 1.1 * ax.get_ylim()[1])
        if len(set(dates)) == 1:
            ax.set_xlim(dates[0] - timedelta(days=60), dates[0] + timedelta(days=60))
        ax.tick_params(axis="x", labelrotation=25)
        fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
        changed = "; grey: an optic changed" if group["events"] else ""
        fig.suptitle(f"Accuracy over time{changed}")
    return fig
