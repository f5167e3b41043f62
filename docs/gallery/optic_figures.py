# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of an optic: the elements of its Mueller matrix, and what it does to a measurement."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join, stages, system_mueller, with_beam
from astropolcal.optics import COORDINATES

BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
# an optic that changes less than this is drawn as departure from the unit matrix
_SMALL = 0.3
# widest range of a parameter that is drawn, by unit
_WIDEST = {"deg": 180.0, "nm": 500.0, "mm": 3.0, "": 1.0}
_FLUX = 1e7


def size_of(optic):
    """Return the number of wavelengths for which an optic has values."""
    return max(np.size(getattr(optic, key).value) for key in optic.param_names)


def _grid(optic, count=101):
    return np.linspace(1.16, 2.37, size_of(optic) if size_of(optic) > 1 else count) * u.um


def _spread(values):
    return float(np.ptp(values, axis=0).max())


def _coordinates(optic):
    """Yield the label, the values and the Mueller matrices along what changes an optic."""
    if optic.stage in COORDINATES:
        largest = 2 * getattr(optic, "reference", 0.5)
        # the share of a constant light grows without end towards no flux
        values = np.linspace(0.1 * largest if "flux" in optic.stage else 0, largest, 101)
        label = optic.stage.replace("_", " ") + (" (adu)" if largest > 1 else "")
        yield label, values, [optic.mueller(1.6 * u.um, x) for x in values]
    if isinstance(optic, optics.FrameOptic) and optic.stage not in COORDINATES:
        angles = np.linspace(0, 360, 181)
        matrices = [optic.mueller(1.6 * u.um, angle * u.deg) for angle in angles]
        yield f"angle of the stage {optic.stage!r} (deg)", angles, matrices
    grid = _grid(optic)
    yield "wavelength (µm)", grid.value, np.broadcast_to(optic.mueller(grid), (grid.size, 4, 4))
    for key in (*optic.own_names, "theta"):
        yield _along(optic, key)


def _along(optic, key):
    """Return label, values and matrices along one parameter."""
    parameter = getattr(optic, key)
    unit = "" if parameter.unit is None else str(parameter.unit)
    widest = _WIDEST.get(unit, 1.0)
    low, high = parameter.bounds
    low = -widest if low is None else max(low, -widest)
    high = widest if high is None else min(high, widest)
    values = np.linspace(low, high, 101)
    matrices = []
    for value in values:
        one = optic.with_parameters(**{key: value * (parameter.unit or 1)})
        matrices.append(np.atleast_3d(one.mueller(1.6 * u.um)).reshape(-1, 4, 4)[0])
    return f"{key}" + (f" ({unit})" if unit else ""), values, matrices


def _what_changes(optic):
    """Return label, values and matrices along the first coordinate that changes the optic."""
    for label, values, matrices in _coordinates(optic):
        found = label, values, np.asarray(matrices)
        if _spread(found[2]) > 1e-9:
            break
    return found


def draw_elements(figure, optic):
    """
    Draw the sixteen elements of an optic's Mueller matrix along what changes them.

    Parameters
    ----------
    figure : `~matplotlib.figure.Figure`
        Without a layout, which would take longer than the drawing.
    optic : Optic
        An example.

    Returns
    -------
    str
        What is drawn, in words.
    """
    label, values, matrices = _what_changes(optic)
    departure = np.abs(matrices - np.eye(4)).max() < _SMALL
    shown = matrices - np.eye(4) if departure else matrices
    limit = 1.08 * np.abs(shown).max()
    axes = figure.subplots(4, 4, sharex=True, sharey=True)
    figure.subplots_adjust(left=0.11, right=0.98, top=0.96, bottom=0.1, wspace=0.12, hspace=0.3)
    for (i, j), axis in np.ndenumerate(axes):
        axis.axhline(0, color="0.75", lw=0.8, zorder=0)
        axis.plot(values, shown[:, i, j], color=BLUE, lw=1.8)
        axis.set_ylim(-limit, limit)
        axis.tick_params(labelsize=8)
        unit = " \N{MINUS SIGN} 1" if departure and i == j else ""
        axis.set_title(f"$m_{{{i}{j}}}${unit}", fontsize=9, pad=3)
    axes[0, 0].set_xlim(values[0], values[-1])
    figure.supxlabel(label, fontsize=10)
    words = "departure from the unit matrix" if departure else "element of the Mueller matrix"
    figure.supylabel(words, fontsize=10)
    return label


def _is_source(optic):
    """Return whether what leaves the optic does not depend on the polarization that enters."""
    matrix = np.asarray(optic.mueller(1.6 * u.um)).reshape(-1, 4, 4)[0]
    singular = np.linalg.svd(matrix, compute_uv=False)
    return not optic.splits_light and singular[1] < 1e-9 * singular[0]


def _train(optic):
    """Return the optics of a small polarimeter, with the optic where it belongs."""
    plate = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="plate")
    splitter = optics.WollastonPrism(name="splitter")
    if optic is None:
        return [plate, splitter], "nowhere"
    one = optic.copy()
    one.name = "optic"
    if optic.splits_light:
        return [plate, one], "in the place of the beam splitter"
    if optic.depends_on_beam:
        return [plate, splitter, one], "downstream of the beam splitter"
    if _is_source(optic):
        return [one, plate, splitter], "upstream of the half-wave plate"
    return [plate, one, splitter], "between half-wave plate and beam splitter"


def _positions(chain, frames, fluxes):
    """Return the positions of all stages of one beam."""
    share = np.linspace(0, 1, frames.size)
    total = _FLUX * np.ones(frames.size) * (1 - 0.5 * share)
    known = {
        "hwp": frames * u.deg,
        "sequence": share,
        "flc_state": (share >= 0.5).astype(float),
        "flux": total / 2 if fluxes is None else fluxes,
        "total_flux": total,
        "previous_flux": np.ones(frames.size),
    }
    if fluxes is not None:
        known["previous_flux"] = np.roll(fluxes, 1) / np.maximum(fluxes, 1e-3 * _FLUX)
        known["previous_flux"][0] = 1.0
    # a state is that of the second half, as with the liquid crystal; any other stage goes through
    # half a turn
    known |= {name: known["flc_state"] for name in stages(chain) if "=" in name}
    return {name: known.get(name, 180 * share * u.deg) for name in stages(chain)}


def _beams(train, frames, light, nominal=None):
    """Return the fluxes of both beams, shape (2, n_frames)."""
    wavelength = _grid(train[-2] if len(train) < 3 else train[1], 1)
    lamp = _FLUX * (1 - 0.5 * np.linspace(0, 1, frames.size))
    found = []
    for number, beam in enumerate(("right", "left")):
        chain = with_beam(join(train), beam)
        positions = _positions(chain, frames, None if nominal is None else nominal[number])
        matrix = system_mueller(chain, wavelength, positions)
        row = np.broadcast_to(matrix, (frames.size, wavelength.size, 4, 4))[:, 0, 0]
        found.append(lamp * (row @ light))
    return np.array(found)


def _differences(beams):
    return 100 * (beams[0] - beams[1]) / np.maximum(beams.sum(axis=0), 1e-12)


def draw_measurement(figure, optic):
    """
    Draw what an optic does to the normalized single differences of a small polarimeter.

    Parameters
    ----------
    figure : `~matplotlib.figure.Figure`
        With a constrained layout.
    optic : Optic
        An example.

    Returns
    -------
    str or None
        Where the optic stands, in words; None where nothing can be drawn.
    """
    frames = np.arange(0, 360, 5.625)
    lights = {"+Q, 100 %": [1, 1, 0, 0], "+U, 100 %": [1, 0, 1, 0], "unpolarized": [1, 0, 0, 0]}
    train, place = _train(optic)
    axes = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    styles = ((BLUE, "-"), (VERMILION, "--"), (GREEN, ":"))
    for (label, light), (color, line) in zip(lights.items(), styles, strict=True):
        nominal = _beams(_train(None)[0], frames, light)
        with_optic = _beams(train, frames, light, nominal)
        change = _differences(with_optic) - _differences(nominal)
        sums = 100 * (with_optic.sum(axis=0) / nominal.sum(axis=0) - 1)
        axes[0].plot(frames, change, color=color, ls=line, lw=2, label=label)
        axes[1].plot(frames, sums, color=color, ls=line, lw=2)
    axes[0].set_ylabel("change of the\nsingle difference (%)")
    axes[1].set_ylabel("change of the\nsum (%)")
    axes[1].set_xlabel("half-wave plate (deg)")
    axes[1].set_xticks(np.arange(0, 361, 45))
    for axis in axes:
        axis.axhline(0, color="0.75", lw=0.8, zorder=0)
        low, high = axis.get_ylim()
        if high - low < 1e-9:
            axis.set_ylim(-1, 1)
        axis.grid(True, color="0.9")
    figure.legend(loc="outside upper center", ncols=3, frameon=False, title="light that enters")
    return place


__all__ = ["draw_elements", "draw_measurement", "size_of"]
