# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an effect leaves in the data: scenes to put it in, and the picture of its residuals.

A scene is a nominal model, its chains and noiseless data of it. The fingerprint of an effect is the
change of both channels of a diagnosis (differences and sums) for the size to expect.
"""

import functools
from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.chain import insert_optic, leaves, remove_optic
from astropolcal.gap.channels import orthonormal
from astropolcal.gap.effects import Context, get_effect
from astropolcal.gap.problem import GapProblem
from astropolcal.instruments.telescope import published_mirror
from astropolcal.optics import LinearRetarder
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.units import canonical_factor

LAMPS = ("difference, polarized", "difference, unpolarized", "sum, polarized")
STARS = ("difference, unpolarized star", "difference, polarized star", "sum, polarized star")
# what is smaller than this, in percent, is drawn as nothing
NOTHING = 1e-4

_CHARIS = instruments.get("charis")
_GRID = _CHARIS.wavelength
_FRAMES = half_wave_plate_cycles(np.arange(0, 360, 22.5) * u.deg, np.arange(45, 121, 15) * u.deg)
_LAMP = 1 - 0.5 * np.linspace(0, 1, len(_FRAMES))
_SETTINGS = {"flux": 1e7, "lamp": _LAMP, "noise": False}


@dataclass(frozen=True)
class Scene:
    """A nominal model with noiseless data of it."""

    words: str
    chains: list
    data: list
    problem: GapProblem
    tangent: np.ndarray
    columns: tuple = LAMPS

    @property
    def last(self):
        """Dataset whose sums are drawn."""
        return int(self.columns is STARS)

    def context(self):
        """Return what an effect may know of the data."""
        return Context(_GRID.to_value(u.um), float(np.median(self.data[0].flux_right)))


def _scene(words, chains, frames, columns=LAMPS):
    data = [simulate(chain, _GRID, frames, **_SETTINGS) for chain in chains]
    problem = GapProblem(chains, data)
    problem.settle_noise()
    return Scene(words, chains, data, problem, _tangent(problem), columns)


def _tangent(problem):
    """Return what the free parameters can do, but for those that stand at a bound."""
    start = problem.start
    inside = (start > problem.low + 1e-9) & (start < problem.high - 1e-9)
    return orthonormal(problem.jacobian(start)[:, inside])


def _bench_chains():
    chains = [_CHARIS.chain(s, derotator="linear") for s in ("polarized", "unpolarized")]
    chains[1]["fold_mirror"].diattenuation = np.full(_GRID.size, 0.013)
    return chains


def _hold(chains, keep=()):
    for leaf in (leaf for chain in chains for leaf in leaves(chain) if leaf.name not in keep):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True


@functools.cache
def bench():
    """Return lamps with and without polarizer, and a linear derotator."""
    return _scene("a model of lamps with and without polarizer", _bench_chains(), _FRAMES)


@functools.cache
def bench_held():
    """Return the same with all orientations held."""
    chains = _bench_chains()
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        leaf.theta.fixed = True
    return _scene("a model that holds all orientations", chains, _FRAMES)


@functools.cache
def bench_dichroic():
    """Return the same with a dichroic whose retardance is steep."""
    steep = 50 * np.tanh((_GRID.to_value(u.um) - 1.5) / 0.1) * u.deg
    retarder = LinearRetarder(retardance=steep, theta=40 * u.deg, name="dichroic")
    retarder.retardance.fixed = True
    chains = [insert_optic(c, retarder.copy(), before="wollaston") for c in _bench_chains()]
    return _scene("a model with a dichroic that is steep at 1.5 µm", chains, _FRAMES)


@functools.cache
def bench_bare():
    """Return the same with nothing upstream of the plate but the polarizer."""
    chains = _bench_chains()
    chains[1] = remove_optic(chains[1], "fold_mirror")
    return _scene("a model without the fold mirror", chains, _FRAMES)


@functools.cache
def sky():
    """Return a star taken for unpolarized and one of 6 %, on a track through the transit."""
    track = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.zeros(24) * u.deg)
    hours = np.linspace(-2, 2, len(track))
    track["parallactic"] = 60 * np.tanh(hours) * u.deg
    track["altitude"] = (75 - 5 * hours**2) * u.deg
    track["derotator"] = 0.5 * (track["altitude"] - track["parallactic"]) + 63.5 * u.deg
    track["hwp"] = track["hwp"] + 0.5 * track["parallactic"] + track["altitude"]
    chains = [
        _CHARIS.chain("unpolarized standard star"),
        _CHARIS.chain("star", star="other"),
    ]
    _hold(chains, keep=("other",))
    for chain in chains:
        chain["m3"].diattenuation = published_mirror().diattenuation(_GRID)
    chains[1]["other"].q = np.full(_GRID.size, 0.05)
    chains[1]["other"].u = np.full(_GRID.size, -0.03)
    return _scene("a model of two stars that holds the instrument", chains, track, STARS)


@functools.cache
def bench_bounded():
    """Return a model whose bounded parameters stand at their upper bounds."""
    chains = _bench_chains()
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        for key in {"theta", "w_sio2", "w_mgf2"} & set(leaf.param_names):
            parameter = getattr(leaf, key)
            high = parameter.bounds[1]
            if high is not None and not parameter.fixed and abs(high) < 360:
                parameter.value = np.full(parameter.shape, high)
    for chain in chains:
        chain["derotator"].retardance.bounds = (-180, -100)
        chain["derotator"].retardance = np.full(_GRID.size, -100) * u.deg
    return _scene("a model that has run into the bound", chains, _FRAMES)


SCENES = (bench, bench_dichroic, bench_held, bench_bare, sky, bench_bounded)


def _size(edited, edit):
    """Return the coefficients of the size to expect, along 1, -0.6, 0.4 of the law."""
    size = np.zeros(edited.size)
    for parameter in edit.parameters:
        where, scale = edited.slices[parameter.name], u.Quantity(parameter.scale)
        weights = np.resize([1, -0.6, 0.4], where.stop - where.start)
        size[where] = weights * scale.value * canonical_factor(scale.unit)
    return size


def _channels(scene, rows):
    """Return the differences of both datasets and the sums of one, in percent."""
    pairs = zip(scene.problem.segments, scene.problem.channels, strict=True)
    parts = [rows[where].reshape(channel.shape) * channel.sigma for where, channel in pairs]
    return [100 * parts[0][0], 100 * parts[1][0], 100 * parts[scene.last][1]]


def _smooth(effect, scene):
    """Return the change that the effect makes, and what the nominal model leaves of it."""
    edit = effect.edit(scene.chains, scene.context())
    laws = {p.name: p.basis for p in edit.parameters if p.basis is not None}
    edited = GapProblem(edit.chains, scene.data, ties=edit.ties, laws=laws, like=scene.problem)
    rows = edited.jacobian(edited.start) @ _size(edited, edit)
    left = rows - scene.tangent @ (scene.tangent.T @ rows)
    return _channels(scene, rows), _channels(scene, left)


def _alternative(effect, scene):
    """Return the change that an alternative makes; it has no size, and nothing is refitted."""
    chains = effect.edit(scene.chains, scene.context()).chains
    edited = GapProblem(chains, scene.data, like=scene.problem)
    changed = edited.residual(edited.start) - scene.problem.residual(scene.problem.start)
    return _channels(scene, -changed)


@functools.cache
def _changes(name, make):
    effect, scene = get_effect(name), make()
    if effect.kind == "discrete":
        return (_alternative(effect, scene),)
    return _smooth(effect, scene)


def fingerprint(name, make=bench):
    """
    Return the images of an effect (wavelength, frame) in percent: two differences and a sum.

    Parameters
    ----------
    name : str
        Effect.
    make : callable
        One of ``SCENES``.

    Returns
    -------
    tuple
        The change that the effect makes, and what is left of it when the nominal parameters have
        absorbed what they can. An alternative without a size has the first only.
    """
    return _changes(name, make)


def scene_of(name):
    """Return the first of ``SCENES`` in which an effect has its place and shows, or None."""
    for make in SCENES:
        if not get_effect(name).applies(make().chains):
            continue
        if max(np.abs(image).max() for image in fingerprint(name, make)[0]) > NOTHING:
            return make
    return None


def _ticks(axis, columns):
    if columns is LAMPS:
        ticks = [f"{a}°" for a in range(45, 121, 15)]
        axis.set_xticks(np.arange(0, len(_FRAMES), 16), ticks, ha="left")
    else:
        angles = np.arange(-50, 51, 25)
        axis.set_xticks(48 + 24 * np.arctanh(angles / 60), [f"{a}°" for a in angles])
    axis.set_yticks([0, _GRID.size], ["1.2", "2.4"])


def _draw(axis, image):
    largest = np.abs(image).max()
    seen = largest > NOTHING
    edges = np.arange(image.shape[1] + 1), np.arange(image.shape[0] + 1)
    shown = image / largest if seen else 0 * image
    axis.pcolormesh(*edges, shown, cmap="PuOr", vmin=-1, vmax=1, rasterized=True)
    axis.text(
        0.99,
        0.95,
        f"±{largest:.2g} %" if seen else "nothing",
        ha="right",
        va="top",
        transform=axis.transAxes,
        fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1},
    )


def draw_rows(figure, rows, columns):
    """
    Draw rows of images into a figure.

    Parameters
    ----------
    figure : `~matplotlib.figure.Figure`
        With a constrained layout, with room around its axes, or a subfigure.
    rows : list of (str, list of `~numpy.ndarray`)
        Label and three images.
    columns : tuple of str
        ``LAMPS`` or ``STARS``.
    """
    axes = figure.subplots(len(rows), 3, sharex=True, sharey=True, squeeze=False)
    for row, (label, images) in zip(axes, rows, strict=True):
        for axis, image in zip(row, images, strict=True):
            _draw(axis, image)
            _ticks(axis, columns)
        row[0].set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    for axis, title in zip(axes[0], columns, strict=True):
        axis.set_title(title, fontsize=10)
    lamps = "derotator angle; at each, one turn of the half-wave plate"
    stars = "parallactic angle; 24 cycles of the half-wave plate"
    figure.supxlabel(lamps if columns is LAMPS else stars, fontsize=9)
    figure.supylabel("wavelength (µm)", fontsize=9)


def gallery(names, make=bench):
    """Draw what is left of several effects, one per row, into a new figure of pyplot."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(10, 0.9 * len(names) + 0.9), layout="constrained")
    rows = [(name.replace("_", "_\n"), fingerprint(name, make)[-1]) for name in names]
    draw_rows(figure, rows, make().columns)
    return figure
