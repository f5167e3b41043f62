# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of a diagnosis: the gap by wavelength and frame, its maps, and its causes."""

import textwrap

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.gap._words import is_determined, labels, share, shortened
from astropolcal.gap.cells import own_name, places
from astropolcal.gap.report import ANGLES, Fitted, to_dict
from astropolcal.gap.residuals import frame_blocks
from astropolcal.optics.perturbations import GENERATORS, Dependence
from astropolcal.plotting import _style as st
from astropolcal.words import check_choice

__all__ = ["plot_cause_map", "plot_gap_frames", "plot_gap_maps", "plot_gap_spectrum"]

_CHANNELS = {
    "difference": ("normalized difference of the beams", "R\N{MINUS SIGN}L over R+L"),
    "sum": ("logarithm of the sum of the beams", "ln(R+L)"),
}


def _datasets(diagnosis):
    """
    Return short name, observations, wavelengths (nm), and gaps before and after, of each dataset.

    Gaps are residuals in percent without the lamp, (2, W, F).
    """
    models, problem, found = (diagnosis.nominal, diagnosis.improved), diagnosis.nominal.problem, []
    pairs = zip(*(m.problem.differences(m.fit.coefficients) for m in models), strict=True)
    for dataset, channel, pair in zip(problem.datasets, problem.channels, pairs, strict=True):
        # whitened by the same noise before and after, lest the two differ by their lamps
        gaps = (100 * channel.whiten(gap) * channel.sigma * channel.level for gap in pair)
        # there is room for so many characters above a panel
        name = shortened(dataset.observations.name, 30)
        gaps = (np.where(channel.valid, gap, np.nan) for gap in gaps)
        found.append((name, dataset.observations, 1000 * problem.wavelength[dataset.bins], *gaps))
    return found


def _finish(figure, axes, diagnosis, title):
    """Add the legend of a panel, which is that of all, and the title with the verdict."""
    if axes is not None:
        st.legend_outside(figure, axes.get_legend_handles_labels()[0], columns=3)
    names = [cause.name for cause in diagnosis.causes]
    several = names[0] if len(names) == 1 else f"{len(names)} causes"
    verdict = {
        "none": "no gap beyond the noise",
        "unexplained": "a real gap that is not explained",
    }.get(diagnosis.verdict, f"{diagnosis.verdict}: {several}")
    figure.suptitle(f"{title}\n{verdict}")
    return figure


def plot_gap_spectrum(diagnosis, *, figure=None):
    """
    Draw the gap by wavelength, before and after, with the noise floor.

    One row per dataset, the difference of the beams at the left and the sum at the right, less the
    lamp's drift and flicker; of the fits, not of left-out frames.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting import plot_gap_spectrum
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> data = cal.measurement.datasets[0].observations
    >>> diagnosis = diagnose(cal, data, effects=["beam_gain"], cross_validate=False)
    >>> len(plot_gap_spectrum(diagnosis).axes)
    2
    """
    datasets, channels = _datasets(diagnosis), diagnosis.nominal.problem.channels
    with st.canvas(figure, 10, 1.6 + 3.3 * len(datasets)) as figure:
        panels = figure.subplots(len(datasets), 2, sharex=True, squeeze=False)
        for row, channel, dataset in zip(panels, channels, datasets, strict=True):
            name, _, nm, before, after = dataset
            order = np.argsort(nm)
            noise = np.where(channel.valid, 100 * channel.sigma * channel.level, np.nan)
            for c, (axes, (title, label)) in enumerate(zip(row, _CHANNELS.values(), strict=True)):
                floor, one, two = (st.rms(v[c], axis=1)[order] for v in (noise, before, after))
                x, level = st.widened(nm[order], floor)
                axes.fill_between(x, level, color="0.85", label="noise")
                axes.plot(x, level, color=st.GREY, linewidth=1)
                axes.plot(nm[order], two, "o-", color=st.BLUE, markersize=4, label="after")
                # hollow and larger, so that both are seen where they are the same
                hollow = {"markerfacecolor": "none", "markersize": 8}
                axes.plot(nm[order], one, "s--", color=st.VERMILION, label="before", **hollow)
                st.scale_axis(axes, np.concatenate([floor, one, two]))
                axes.set_title(f"{name}\n{title}", loc="left")
                axes.set_ylabel(f"rms of {label} (%)")
        for axes in panels[-1]:
            st.wavelength_label(axes)
        return _finish(figure, panels[0, 0], diagnosis, "Gap between model and data")


def plot_gap_frames(diagnosis, *, figure=None):
    """
    Draw the residuals frame by frame, before and after, with what the causes do.

    Single differences, mean of that third of the wavelengths in which the causes do most. The
    line is what the model predicts with the causes in it, less what it predicts without. Where one
    perturbation of any course may be in place of the causes, its size stands below, in the frames
    that tell it.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting import plot_gap_frames
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> data = cal.measurement.datasets[0].observations
    >>> diagnosis = diagnose(cal, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_gap_frames(diagnosis).axes[0].get_xlabel()[:5]
    'frame'
    """
    datasets, told = _datasets(diagnosis), []
    for course in diagnosis.courses[:1]:
        least = min(std.min() for std in course.std)
        # frames that tell a size so many times worse than the best one are left out
        told = [(i, std < 20.0 * least) for i, std in enumerate(course.std)]
        told = [(i, frames) for i, frames in told if frames.any()]
    rows = len(datasets) + len(told)
    with st.canvas(figure, 9, 1.4 + 2.5 * rows) as figure:
        panels = figure.subplots(rows, 1, squeeze=False)[:, 0]
        for axes, (name, observations, nm, before, after) in zip(panels, datasets, strict=False):
            thirds = [part for part in np.array_split(np.argsort(nm), 3) if part.size]
            does = [st.rms(before[0][part] - after[0][part]) for part in thirds]
            third = thirds[int(np.nanargmax(does))] if np.nanmax(does) > 0 else thirds[-1]
            old, new = (st.mean_known(gap[0][third]) for gap in (before, after))
            x = np.arange(len(old)) + 0.5
            axes.axhline(0, color=st.GREY, linewidth=0.8)
            look = {"markerfacecolor": "none", "markersize": 6}
            axes.plot(x, old, "s", color=st.VERMILION, label="before", **look)
            if diagnosis.causes:
                axes.plot(x, old - new, color=st.BLACK, linewidth=1, label="what the causes do")
                axes.plot(x, new, "o", color=st.BLUE, markersize=4, label="after")
            of = nm[third]
            axes.set_title(f"{name}\n{of.min():.0f} to {of.max():.0f} nm", loc="left")
            axes.set_ylabel(f"observed {st.MINUS} model (%)")
            _frame_axis(axes, observations)
        for axes, (i, frames) in zip(panels[len(datasets) :], told, strict=True):
            name, observations, *_ = datasets[i]
            # the size in the frames of the dataset that tell it
            angle = course.kind.startswith(ANGLES)
            scale = np.rad2deg(1) if angle else 100
            value, error = (scale * values[i][frames] for values in (course.wave, course.std))
            look = {"fmt": "o", "color": st.BLACK, "markersize": 3, "elinewidth": 0.8}
            axes.axhline(0, color=st.GREY, linewidth=0.8)
            axes.errorbar(np.flatnonzero(frames) + 0.5, value, error, **look)
            nm = 1000 * diagnosis.nominal.problem.wavelength[np.argmax(course.law)]
            axes.set_ylabel(f"size at {nm:.0f} nm ({'deg' if angle else '%'})")
            axes.set_title(f"{name}\n{course.place}, {course.kind}, any course", loc="left")
            axes.set_xlim(panels[i].get_xlim())
            _frame_axis(axes, observations)
        return _finish(figure, panels[0], diagnosis, "Residuals of the single differences")


def plot_gap_maps(diagnosis, *, channel="difference", figure=None):
    """
    Draw maps of the residuals, wavelength against frame, before and after.

    All maps have the same colours. Frames are in the order of the table; lines
    separate derotator angles. Masked data are grey.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    channel : {"difference", "sum"}
        Of the beams.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If the channel is another.

    Examples
    --------
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting import plot_gap_maps
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> data = cal.measurement.datasets[0].observations
    >>> diagnosis = diagnose(cal, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_gap_maps(diagnosis).axes[0].get_ylabel()
    'wavelength (nm)'
    """
    check_choice("channel", channel, _CHANNELS, ParameterError)
    c, datasets = list(_CHANNELS).index(channel), _datasets(diagnosis)
    gaps = [(before[c], after[c]) for *_, before, after in datasets]
    sizes = np.concatenate([gap.ravel() for pair in gaps for gap in pair])
    # share of the residuals that the colour scale of the maps covers
    limit, clipped = st.color_limit(sizes, 99.5)
    with st.canvas(figure, 12, 1.5 + 3.2 * len(datasets)) as figure:
        panels = figure.subplots(len(datasets), 2, sharey="row", squeeze=False)
        for row, pair, (name, observations, nm, *_) in zip(panels, gaps, datasets, strict=True):
            for axes, gap, when in zip(row, pair, ("before", "after"), strict=True):
                drawn = st.draw_map(axes, gap, nm, limit)
                axes.set_title(f"{name}\n{when}: rms {st.rms(gap):.2g} %", loc="left")
                _frame_axis(axes, observations)
            row[1].set_ylabel("")
        st.color_bar(figure, drawn, panels, clipped)
        return _finish(figure, None, diagnosis, f"Residuals of the {_CHANNELS[channel][0]}")


def _frame_axis(axes, observations):
    """Name the runs of frames at one derotator angle, or number the frames."""
    blocks = frame_blocks(observations)
    starts = np.flatnonzero(np.diff(blocks, prepend=-1))
    if len(starts) == len(blocks):
        axes.set_xlabel("frame")
        return
    for edge in starts[1:]:
        axes.axvline(edge, color=st.BLACK, linewidth=0.6)
    angles = [f"{a:.4g}" for a in np.rad2deg(observations.position("derotator")[starts])]
    ends = np.append(starts[1:], len(blocks))
    st.name_groups(axes, ends, angles, "frames by derotator angle (deg)")


# ---- the causes -----------------------------------------------------------------------------


def plot_cause_map(diagnosis, *, figure=None):
    """
    Draw where in the chain a cause is, and of which kind: a map of probabilities.

    Rows are the places in the order in which the light meets them, columns the kinds of
    perturbation. A cell is the probability that a cause is there, summed over all its
    dependences and over what cannot be distinguished from it.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Examples
    --------
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.plotting import plot_cause_map
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> data = cal.measurement.datasets[0].observations
    >>> diagnosis = diagnose(cal, data, effects=["beam_gain"], cross_validate=False)
    >>> plot_cause_map(diagnosis).axes[0].get_yticklabels()[-1].get_text()
    'detector'
    """
    rows = _cause_map(diagnosis)
    shown = [k for k in _FAMILIES if k != _OTHER or any(k in row for row in rows.values())]
    table = np.array([[row.get(k, (0.0, ""))[0] for k in shown] for row in rows.values()])
    with st.canvas(figure, 5.4, 1.6 + 0.5 * len(rows)) as figure:
        axes = figure.subplots()
        # one hue from white to dark: it is the same for all kinds of colour vision, and in print
        axes.imshow(table, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for i, row in enumerate(rows.values()):
            for j, kind in enumerate(shown):
                chance, words = row.get(kind, (0.0, ""))
                # hardly anything is not written
                if chance < 0.01:
                    continue
                # white where the ground is dark
                look = {"ha": "center", "color": "white" if chance > 0.65 else st.BLACK}
                axes.text(j, i - 0.26, share(chance), va="center", weight="bold", **look)
                # on a telephone a cell is narrow
                words = textwrap.fill(words, 8, break_long_words=False)
                axes.text(j, i - 0.06, words, va="top", fontsize=7.5, linespacing=0.95, **look)
        axes.set_xticks(range(len(shown)), labels=shown, rotation=30, ha="left")
        words = {"in": "in the {}", "after": "downstream of the {}"}
        named = []
        for place in rows:
            head, _, optic = place.partition(":")
            label = words.get(head, place).format(own_name(optic))
            named.append(textwrap.fill(label, 16))
        axes.set_yticks(range(len(rows)), labels=named)
        axes.tick_params(length=0, labelsize=9.5)
        axes.xaxis.tick_top()
        axes.grid(visible=False)
        for draw, count in ((axes.axhline, len(rows)), (axes.axvline, len(shown))):
            for edge in np.arange(0.5, count - 1):
                draw(edge, color="0.8", linewidth=0.8)
        figure.suptitle("Probability that a cause is there", fontsize=11.5)
    return figure


# columns of the map
_OTHER = "other"
_FAMILIES = ("retardance", "rotation", "diattenuation", "depolarization", "beams, detector", _OTHER)
_AXES = {"h": "along axes", "d": "at 45 deg", "c": "circular", "h_between_beams": "per beam"}


def _cause_map(diagnosis):
    """Return {place: {family: (probability, what)}}, places in the order of the light."""
    chains = diagnosis.nominal.chains
    rows = {p.name: {} for chain in chains for p in places(chain)}
    rows["detector"] = rows.pop("detector", {})
    for cause in diagnosis.causes:
        own, words = {}, {}
        for one, part in [(cause, cause.share), *cause.aliases]:
            place, family, what = _on_map(one.effect, one.cell, chains)
            own[place, family] = own.get((place, family), 0.0) + part * cause.probability
            words.setdefault((place, family), what)
        for (place, family), chance in own.items():
            before, what = rows.setdefault(place, {}).get(family, (0.0, words[place, family]))
            # that at least one of several causes is there
            rows[place][family] = (1 - (1 - before) * (1 - min(chance, 1.0)), what)
    return rows


def _on_map(effect, cell, chains):
    """Return place, family and what exactly of a cause."""
    if cell is not None:
        family, _, axis = cell.kind.partition("_")
        known = family in _FAMILIES
        what = _AXES.get(axis, axis) if known else cell.kind.replace("_", " ")
        return cell.place, family if known else _FAMILIES[-2], what
    place = _place_of(effect, chains)
    words = f"{effect.name} {effect.title}"
    family = next((family for family in _FAMILIES[:4] if family in words), _OTHER)
    return place, _FAMILIES[-2] if place == "detector" else family, "named"


def _place_of(effect, chains):
    """Return the place of a named effect that is not a cell, in a chain with its optic."""
    where = effect.where
    if where is None:
        return effect.place
    every = [effect.roles(chain) for chain in chains]
    there = [roles for roles in every if where.anchor(roles) is not None]
    roles = (there or every)[0]
    optic = where.anchor(roles)
    # behind a splitter the light is on its way to the detector
    if optic is not None and optic.splits_light and where.relation != "before":
        return "detector"
    place = where.cell_place(roles)
    known = {one.name for chain in chains for one in places(chain)} | {"detector"}
    # what turns with the sky, and is no optic, has no frame of its own on the map
    return place if place in known else where.in_front_of(roles)


def plot_effect_sizes(diagnosis, effect):
    """Draw the fitted size of a cause, by its name, with its errors.

    One panel for what it depends on, if that is a cell that changes from frame to frame: the size
    at the middle wavelength with its 68 % band, and the frames as marks. One panel for each
    parameter that changes with the wavelength; crosses mark where the data do not tell the size.
    """
    names = [cause.name for cause in diagnosis.causes]
    check_choice("cause", effect, names, ParameterError)
    entry = to_dict(diagnosis)["causes"][names.index(effect)]
    cause, model = diagnosis.causes[names.index(effect)], diagnosis.improved
    sizes = {name: size for name, size in entry["size"].items() if _varies(size["value"])}
    dependence = _curve(model, cause)
    panels = [None, *sizes] if dependence else list(sizes)
    if not panels:
        raise ParameterError(f"effect = {effect!r} has no size that depends on anything")
    words = dict(zip(entry["size"], labels(entry), strict=True))
    columns = min(len(panels), 2)
    with st.canvas(None, 4.9 * columns + 0.6, 0.4 + 2.6 * -(-len(panels) // 2)) as figure:
        for axes, name in zip(st.grid(figure, len(panels), columns)[0], panels, strict=True):
            if name is None:
                _curve_panel(axes, model, effect, dependence)
                continue
            (parameter,) = (p for p in model.added[effect] if p.name == name)
            unit = _size_panel(axes, model.problem, sizes[name], parameter)
            # there is room for so many characters beside a panel
            axes.set_ylabel(f"{textwrap.fill(words[name], 26)} ({unit})")
            st.wavelength_label(axes)
    return figure


def _varies(value):
    known = [abs(one) for one in value if one is not None] if isinstance(value, list) else []
    return bool(known) and max(value) - min(value) > 1e-6 * max(known)


def _size_panel(axes, problem, size, parameter):
    """Draw the size of a parameter over the wavelength; return its unit."""
    nm, scale = 1000 * problem.wavelength, 1 if size["unit"] else 100
    value, error = (scale * np.array(size[key], dtype=float) for key in ("value", "std"))
    known = is_determined(error, scale * size["limit"])
    # mostly zero; a share that is retained counts from one, what the model held from its value
    factor = problem.free.by_name[parameter.name].factor
    absent = parameter.canonical_neutral / factor * scale
    look = {"color": st.BLACK, "linewidth": 0.8}
    axes.axhline(absent, **look) if np.ndim(absent) == 0 else st.draw_line(axes, nm, absent, **look)
    axes.errorbar(nm[known], value[known], error[known], fmt="o", color=st.BLUE, elinewidth=1.5)
    if not known.all():
        # x in data, y in shares of the panel: the crosses stay at its foot whatever the scale
        look = {"color": st.VERMILION, "transform": axes.get_xaxis_transform()}
        axes.plot(nm[~known], np.full((~known).sum(), 0.05), "x", **look)
        axes.set_title("crosses: not determined", loc="left", fontsize=10)
    if not known.any():
        axes.set_yticks([])
    return size["unit"] or "%"


# ---- what a cause depends on ------------------------------------------------------------------

_DRIVERS = {
    "sequence": "share of the run",
    "frame": "frame",
    "brightness": "brightness over its mean, minus 1",
}


def _curve(model, cause):
    """Return the dependence of a cause that is a cell and changes from frame to frame."""
    keys = [p.name.partition(".")[2] for p in model.added.get(cause.name) or ()]
    if cause.cell is None or cause.cell.kind not in GENERATORS or keys[:1] != ["amplitude"]:
        return None
    dependence = Dependence(cause.cell.dependence)
    return dependence if dependence.driver else None


def _curve_panel(axes, model, effect, dependence):
    """Draw the size of a cell over what it depends on, at the middle wavelength."""
    driver, problem, moved = dependence.driver, model.problem, dependence.kind == "direction"
    given = []
    for dataset in problem.datasets:
        where = dataset._given.get(driver)
        where = dataset.observations.position(driver) if where is None else where
        given.append(where.mean(axis=0) if where.ndim == 2 else where)
    given = np.concatenate(given)
    x = np.array([0.0, 1.0]) if moved else np.linspace(given.min(), given.max(), 400)
    fitted, middle = Fitted(model), len(problem.wavelength) // 2
    own = np.zeros((problem.size, len(x)))
    for wave, parameter in zip(dependence.waves(x), model.added[effect], strict=False):
        where, basis = problem.slices[parameter.name], parameter.basis
        basis = np.eye(where.stop - where.start) if basis is None else basis
        own[where] = np.outer(basis[min(middle, len(basis) - 1)], wave)
    unit, factor = fitted.unit_of(parameter.name)
    scale = 1 / factor if unit else 100
    value = scale * (model.fit.coefficients @ own)
    error = scale * np.sqrt(np.einsum("ij,ik,kj->j", own, fitted.covariance, own))
    axes.axhline(0, color=st.BLACK, linewidth=0.8)
    if moved:
        axes.errorbar(x, value, error, fmt="o", color=st.BLUE)
        axes.set_xticks(x, labels=["forwards", "backwards"])
        axes.set_xlim(-0.5, 1.5)
    else:
        x, given = (x, given) if driver in _DRIVERS else (np.rad2deg(x), np.rad2deg(given))
        st.draw_band(axes, x, value, error, st.SKY, 0.5)
        axes.plot(x, value, color=st.BLUE)
        foot = np.full(len(given), 0.02)
        axes.plot(given, foot, "|", color=st.GREY, transform=axes.get_xaxis_transform())
    stage = own_name(dependence.parts[1]) if len(dependence.parts) > 1 else ""
    known = {
        "harmonic": f"angle of the {stage} (deg)",
        "direction": f"last move of the {stage}",
        "move": f"last move of the {stage} (deg)",
    }
    axes.set_xlabel(known.get(dependence.kind) or _DRIVERS[driver])
    nm = 1000 * problem.wavelength[middle]
    axes.set_ylabel(f"size at {nm:.0f} nm ({unit or '%'})")
