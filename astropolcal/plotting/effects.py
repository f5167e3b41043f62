# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of the effects of a diagnosis: their scan, and the sizes of those that were found."""

import textwrap

import numpy as np

from astropolcal.chain import leaves
from astropolcal.exceptions import ParameterError
from astropolcal.gap._numbers import Fitted
from astropolcal.gap._words import in_title, is_determined
from astropolcal.gap.selection import ENOUGH
from astropolcal.plotting._style import (
    BLACK,
    BLUE,
    ORANGE,
    SKY,
    VERMILION,
    canvas,
    draw_line,
    legend_outside,
    style,
    wavelength_label,
)

__all__ = ["plot_effect_scores", "plot_effect_sizes"]

# characters of a label beside a panel
_LABEL = 26


def verdict_line(diagnosis):
    """Return the verdict as a line that fits a figure."""
    largest = sorted(diagnosis.causes, key=lambda cause: -cause.explained)
    names = in_title([cause.name for cause in largest])
    several = "effects are" if len(largest) > 1 else "effect is"
    return {
        "named": f"{len(largest)} {several} missing: {names}",
        "located": f"{len(largest)} {several} missing: {names}",
        "none": "no gap beyond the noise",
        "unexplained": "a real gap that no effect explains"
        + (f"\n(in part: {names})" if names else ""),
    }.get(diagnosis.verdict, diagnosis.verdict)


def plot_effect_scores(diagnosis, *, limit=12, figure=None):
    """
    Draw how much of the gap each effect of the library would explain.

    The length of a bar is the signal-to-noise ratio of the effect in the scan,
    the square root of the expected lowering of chi-square over the scatter that
    remains. Causes that were found and their aliases have their own colours,
    those for which there is no evidence are pale.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    limit : int
        Most effects to draw, best first.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting.effects import plot_effect_scores
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=1)
    >>> diagnosis = diagnose(chain, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_effect_scores(diagnosis).axes[0].get_xlabel()[:8]
    'signal-t'
    """
    scores = sorted(diagnosis.scan.candidates[:limit], key=lambda s: -_strength(s))
    found = {cause.name for cause in diagnosis.causes}
    aliases = {one.name for cause in diagnosis.causes for one, _ in cause.aliases} - found
    # only the kinds that are there are explained
    used = set()
    with style():
        figure = canvas(figure, 10, 2.2 + 0.36 * max(len(scores), 2))
        axes = figure.subplots()
        for i, score in enumerate(scores):
            name, size = score.effect.name, _strength(score)
            kind = _kind(name, score.evidence > ENOUGH, found, aliases)
            used.add(kind)
            axes.barh(i, size, **_LOOKS[kind])
            axes.text(size, i, f"  {score.evidence:.0f}", va="center", fontsize=9.5)
        axes.set_yticks(range(len(scores)), labels=[s.effect.name for s in scores])
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("signal-to-noise ratio in the scan; at the bars: log Bayes factor")
        # room for the numbers at the ends of the bars
        axes.set_xlim(0, 1.18 * max(map(_strength, scores), default=1.0))
        legend_outside(figure, _keys(used), columns=4)
        figure.suptitle(f"Scan of the effects\n{verdict_line(diagnosis)}")
        if not scores:
            axes.text(0.5, 0.5, "no effect to score", transform=axes.transAxes, ha="center")
    return figure


_LOOKS = {
    "found": {"color": VERMILION},
    "alias: the data cannot tell": {"facecolor": ORANGE, "edgecolor": BLACK, "hatch": "//"},
    "significant": {"color": SKY},
    "not significant": {"color": "0.85"},
}


def _strength(score):
    # chi-square is the square of a signal-to-noise ratio
    return float(np.sqrt(score.statistic))


def _kind(name, significant, found, aliases):
    if name in found:
        return "found"
    if name in aliases:
        return "alias: the data cannot tell"
    return "significant" if significant else "not significant"


def _keys(used):
    from matplotlib.patches import Patch

    return [Patch(label=label, **look) for label, look in _LOOKS.items() if label in used]


def plot_effect_sizes(diagnosis, effect, *, content=None, figure=None):
    """
    Draw the fitted size of a cause with its errors by wavelength.

    One panel a parameter. Where the data do not tell the size, the wavelength
    is marked at the foot of the panel.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    effect : str
        Name of one of its causes.
    content : dict, optional
        What `~astropolcal.gap.report.to_dict` returned for it, if it is known already.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If the effect is no cause, or has no size that depends on wavelength.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.optics import BeamGain
    >>> from astropolcal.plotting.effects import plot_effect_sizes
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> wavelength = [1200, 1600, 2000] * u.nm
    >>> chain = instruments.get("charis").chain(derotator="linear", wavelength=wavelength)
    >>> truth = chain | BeamGain(imbalance=0.02, name="flat")
    >>> frames = half_wave_plate_cycles(derotator=[45, 70, 95, 120] * u.deg)
    >>> data = simulate(truth, wavelength, frames, seed=1)
    >>> diagnosis = diagnose(chain, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_effect_sizes(diagnosis, "beam_gain").axes[0].get_ylabel()[:9]
    'imbalance'
    """
    sizes = _sizes_by_wavelength(diagnosis, effect, content)
    nm = 1000 * diagnosis.nominal.problem.wavelength
    with style():
        figure = canvas(figure, 4.9 * min(len(sizes), 2) + 0.6, 0.4 + 2.5 * -(-len(sizes) // 2))
        grid = figure.subplots(-(-len(sizes) // 2), min(len(sizes), 2), squeeze=False, sharex=True)
        for axes in grid.flat[len(sizes) :]:
            axes.set_axis_off()
        for axes, (name, size) in zip(grid.flat, sizes.items(), strict=False):
            _size_panel(axes, nm, size, _absent(diagnosis.improved, effect, name))
            axes.set_ylabel(_label(diagnosis.improved, name, size["unit"]))
            wavelength_label(axes)
    return figure


def _sizes_by_wavelength(diagnosis, effect, content):
    names = [cause.name for cause in diagnosis.causes]
    if effect not in names:
        raise ParameterError(f"effect = {effect!r} is no cause; these are: {', '.join(names)}")
    if content is None:
        sizes = Fitted(diagnosis.improved).sizes(effect)
    else:
        sizes = content["causes"][names.index(effect)]["size"]
    found = {name: size for name, size in sizes.items() if isinstance(size["value"], list)}
    if not found:
        raise ParameterError(f"effect = {effect!r} has no size that depends on wavelength")
    return found


def _absent(model, effect, name):
    """Return the value at which an effect is absent in the unit of its size, scalar or (W,)."""
    (parameter,) = (p for p in model.added[effect] if p.name == name)
    return parameter.canonical_neutral / model.problem.free.by_name[name].factor


def _label(model, name, unit):
    """Return what a size is, in the words of its optic, and its unit."""
    optic, _, key = name.partition(".")
    carriers = (leaf for chain in model.chains for leaf in leaves(chain) if leaf.name == optic)
    carrier = next(carriers, None)
    description = "" if carrier is None else getattr(carrier, key).__doc__
    words = f"{key.replace('_', ' ')}{': ' if description else ''}{description}"
    return textwrap.fill(f"{words} ({unit or 'fraction'})", _LABEL)


def _size_panel(axes, nm, size, absent):
    known = np.array([is_determined(std, size["limit"]) for std in size["std"]])
    value = np.array(size["value"], dtype=float)
    error = np.array(size["std"], dtype=float)
    # mostly zero; a share that is retained counts from one, what the model held from its value
    look = {"color": BLACK, "linewidth": 0.8}
    axes.axhline(absent, **look) if np.ndim(absent) == 0 else draw_line(axes, nm, absent, **look)
    axes.errorbar(nm[known], value[known], error[known], fmt="o", color=BLUE, elinewidth=1.5)
    if not known.all():
        # x in data, y in shares of the panel: the crosses stay at its foot whatever the scale
        foot = axes.get_xaxis_transform()
        axes.plot(nm[~known], np.full((~known).sum(), 0.05), "x", color=VERMILION, transform=foot)
        axes.set_title("crosses: not determined", loc="left", fontsize=10)
    if not known.any():
        axes.set_yticks([])
