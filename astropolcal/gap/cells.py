# Licensed under a 3-clause BSD style license - see LICENSE
r"""
The gap as a perturbation of the chain: place, kind and dependence of a small error.

A small error of any optic is a small Mueller perturbation somewhere in the chain, of some kind,
with some dependence on the frame. The product of all places, kinds and dependences is a table of
*cells*. The derivative of the data to a cell is a . G s times a function of the frame, with the
light s that arrives at the place, the analyser row a behind it and the generator G of the kind:
light and rows of all places come from one forward and one backward sweep.
"""

from dataclasses import dataclass
from functools import cached_property

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import insert_optic, leaves
from astropolcal.gap._bases import law_basis
from astropolcal.gap.problem import GapProblem
from astropolcal.optics import GENERATORS, Dependence
from astropolcal.optics.positions import COORDINATES

__all__ = ["Cell", "Place", "Probes", "dependences", "places"]

# kinds that a detector may have, and the dependence of each where there is one only
_DETECTOR = {
    "background": "flux",
    "background_of_one_beam": "flux",
    "nonlinearity": "flux",
    "persistence": "previous",
    "crosstalk": "constant",
}
_SKY = ("parallactic", "altitude")
_HARMONICS = (1, 2, 4)
# steps are looked for at so many frames
_MOST_STEPS = 64
# functions of the frame that differ by less are the same
_SAME = 1e-9
#: Usual size of a perturbation (radian, or a share) by kind, the scale of its prior.
SIZES = {"retardance": 0.1, "rotation": 0.02, "diattenuation": 0.02, "depolarization": 0.05}
_USUAL = 0.02


@dataclass(frozen=True, order=True)
class Cell:
    """
    One place, kind and dependence of a small error.

    Parameters
    ----------
    place : str
        ``"source"``, ``"telescope"``, ``"in:OPTIC"`` (the frame that turns with it),
        ``"after:OPTIC"`` (the frame that stands still) or ``"detector"``.
    kind : str
        Key of `~astropolcal.optics.GENERATORS`, or ``"background"``,
        ``"background_of_one_beam"``, ``"nonlinearity"``, ``"persistence"``, ``"crosstalk"``.
    dependence : str
        As `~astropolcal.optics.Dependence` takes it, or ``"flux"`` and ``"previous"``.

    Examples
    --------
    >>> from astropolcal.gap.cells import Cell
    >>> Cell("in:derotator", "retardance_h", "time").title
    'retardance along the axes of the derotator that drifts through the run'
    """

    place: str
    kind: str
    dependence: str

    @property
    def name(self):
        """Place, kind and dependence as one word."""
        return f"{self.place}/{self.kind}/{self.dependence}"

    @property
    def optic(self):
        """Name of the optic of the place, None where it is none."""
        return self.place.partition(":")[2] or None

    @property
    def scale(self):
        """Usual size, in radian or as a share."""
        return SIZES.get(self.kind.partition("_")[0], _USUAL)

    @property
    def title(self):
        """The cell in words."""
        return f"{_kind_words(self)} {_place_words(self.place)}{_when(self.dependence)}"

    def to_dict(self):
        """Return place, kind and dependence, ready for JSON."""
        return {"place": self.place, "kind": self.kind, "dependence": self.dependence}


_KINDS = {
    "rotation": "rotation (circular retardance)",
    "diattenuation_c": "circular diattenuation",
    "depolarization_linear": "depolarization of linear light",
    "depolarization_h": "depolarization along one axis against the other",
    "depolarization_d": "depolarization at 45 deg to the axes",
    "depolarization_circular": "depolarization of circular light",
    "gain": "gain of one beam against the other",
    "background": "background in both beams",
    "background_of_one_beam": "background in one beam",
    "nonlinearity": "answer that is not linear",
    "persistence": "light of the frame before",
    "crosstalk": "light of one beam in the other",
}


def _kind_words(cell):
    if cell.kind in _KINDS:
        return _KINDS[cell.kind]
    word, _, axis = cell.kind.partition("_")
    return f"{word} along the axes" if axis == "h" else f"{word} at 45 deg to the axes"


def _place_words(place):
    head, _, optic = place.partition(":")
    if head in ("in", "after"):
        own = {"hwp": "half-wave plate"}.get(optic, optic)
        return f"of the {own}" if head == "in" else f"behind the {own}"
    return {
        "source": "of the source, or in front of the first optic that turns",
        "telescope": "in front of the half-wave plate",
        "detector": "at the detector",
    }[head]


def _when(dependence):
    parts = dependence.split(":")
    stage = {"hwp": "half-wave plate"}.get(parts[1], parts[1]) if len(parts) > 1 else ""
    times = {"1": "once", "2": "twice", "4": "four times"}
    return {
        "time": lambda: " that drifts through the run",
        "time2": lambda: " that bends through the run",
        "step": lambda: f" that changes at frame {stage}",
        "frame": lambda: f" in frame {stage} alone",
        "harmonic": lambda: (
            f" that changes {times.get(parts[-1], parts[-1] + ' times')} in a turn of the {stage}"
        ),
        "direction": lambda: f" that depends on the direction of the last move of the {stage}",
        "move": lambda: f" that grows with the last move of the {stage}",
        "dataset": lambda: f' in "{dependence.partition(":")[2]}" only',
    }.get(parts[0], lambda: "")()


# ---- places ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """
    A place in a chain where a perturbation may stand.

    Parameters
    ----------
    name : str
        As in `Cell`.
    before, after : str or None
        Name of the optic next to which it is.
    mount : str or None
        Stage whose frame it has, with its sign.
    theta : float
        Orientation in that frame, radian.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.cells import places
    >>> [place.name for place in places(instruments.get("charis").chain())]
    ['source', 'in:hwp', 'after:hwp', 'in:derotator', 'after:derotator']
    """

    name: str
    before: str | None = None
    after: str | None = None
    mount: str | None = None
    theta: float = 0.0

    def insert(self, chain, optic):
        """Return the chain with an optic at the place, which has to have its frame."""
        where = {"before": self.before} if self.after is None else {"after": self.after}
        return insert_optic(chain, optic, **where)


def places(chain):
    """
    Return the places of a chain, in the order in which the light meets them.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.

    Returns
    -------
    list of Place
        Behind the source; in front of the plate where there is a telescope; in the frame of each
        optic on a stage, and behind it; and behind what stands still and retards.

    Examples
    --------
    >>> from astropolcal.gap.cells import places
    >>> from astropolcal import instruments
    >>> len(places(instruments.get("charis").chain()))
    5
    """
    found = [o for o in leaves(chain) if not (o.name or "").startswith("gap_")]
    split = next(i for i, o in enumerate(found) if o.splits_light)
    found = found[: split + 1]
    turning = [o for o in found if o.stage is not None and o.stage not in COORDINATES]
    first = turning[0] if turning else found[-1]
    out = [Place("source", before=first.name)] if found[0] is not first else []
    own = [o for o in turning if o.stage not in _SKY and not o.rotates_frame]
    if own and own[0] is not first:
        out.append(Place("telescope", before=own[0].name))
    for optic in found:
        if optic in own:
            theta = float(np.deg2rad(np.mean(optic.theta.value)))
            out.append(Place(f"in:{optic.name}", None, optic.name, optic.mount, theta))
            out.append(Place(f"after:{optic.name}", None, optic.name))
        elif own and optic is not found[-1] and _mixes(optic) and _behind(optic, own[0], found):
            out.append(Place(f"after:{optic.name}", None, optic.name))
    return out


def _mixes(optic):
    """Whether an optic that stands still makes the place behind it another one."""
    kinds = (optics.ParityFlip, optics.Rotator, optics.FrameOptic)
    return optic.stage is None and not optic.splits_light and not isinstance(optic, kinds)


def _behind(optic, other, found):
    return found.index(optic) > found.index(other)


# ---- dependences -------------------------------------------------------------------------------


def dependences(problem, most_steps=_MOST_STEPS):
    """
    Return the functions of the frame that the data of a problem can tell.

    Parameters
    ----------
    problem : GapProblem
        Chains and datasets.
    most_steps : int
        Steps are looked for at so many frames.

    Returns
    -------
    dict of str to list of `~numpy.ndarray`
        Dependence to its functions, shape (count, F), one array a dataset.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.cells import dependences
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = instruments.get("charis").chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)])
    >>> list(dependences(model.problem, 0))[:4]
    ['constant', 'time', 'time2', 'harmonic:hwp:1']
    """
    stages = dict.fromkeys(
        stage
        for dataset in problem.datasets
        for stage in dataset._given
        if stage not in (*COORDINATES, *_SKY)
    )
    names = ["constant", "time", "time2"]
    names += [f"harmonic:{stage}:{k}" for stage in stages for k in _HARMONICS]
    names += [f"{what}:{s}" for s in ("hwp", "derotator") if s in stages for what in _MOVED]
    sources = [o.source for o in (d.observations for d in problem.datasets)]
    if len(set(sources)) < len(sources):
        names += [f"dataset:{d.observations.name}" for d in problem.datasets]
    names += [f"step:{n}" for n in _steps(problem, most_steps)]
    found = {}
    for name in names:
        waves = [_waves(Dependence(name), dataset) for dataset in problem.datasets]
        if name == "constant" or np.ptp(np.concatenate(waves, axis=1), axis=1).max() > _SAME:
            found[name] = waves
    return found


_MOVED = ("direction", "move")


def _waves(dependence, dataset):
    """Return the functions of a dependence in the frames of a dataset, (count, F)."""
    observations = dataset.observations
    if dependence.kind == "dataset":
        own = dependence.text.partition(":")[2] == observations.name
        return np.full((1, observations.n_frames), float(own))
    if dependence.driver is None:
        return np.ones((1, observations.n_frames))
    given = dataset._given.get(dependence.driver)
    if given is None:
        known = (
            dependence.driver in COORDINATES or dependence.driver in observations.frames.colnames
        )
        if not known or not _has_stage(dependence, observations):
            return np.zeros((dependence.count, observations.n_frames))
        given = observations.position(dependence.driver)
    return dependence.waves(given.mean(axis=0) if given.ndim == 2 else given)


def _has_stage(dependence, observations):
    stage = dependence.parts[1] if dependence.kind in _MOVED else None
    return stage is None or stage in observations.frames.colnames


def _steps(problem, most):
    """Return frames at which something may have changed: all, or as many as are looked at."""
    n = min(d.observations.n_frames for d in problem.datasets)
    if n < 8 or not most:
        return []
    return sorted({int(x) for x in np.linspace(2, n - 2, min(most, n - 3)).round()})


# ---- derivatives -------------------------------------------------------------------------------


class Probes:
    """
    Derivatives of the data to all cells at a fitted model.

    Parameters
    ----------
    model : Model
        The fitted model.
    tangent : `~numpy.ndarray`, optional
        Orthonormal basis of what the model can do already, (n_rows, rank), if known.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.cells import Probes
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> probes = Probes(nominal_model([charis.chain()], [observations]))
    >>> len({cell.place for cell in probes.cells})
    6
    """

    def __init__(self, model, tangent=None, most_steps=_MOST_STEPS):
        self.model, problem = model, model.problem
        self.problem = problem
        coefficients = model.fit.coefficients
        self.tangent = problem.tangent(coefficients) if tangent is None else tangent
        residual = problem.residual(coefficients)
        self.residual = residual - self.tangent @ (self.tangent.T @ residual)
        #: A function of the frame that is one everywhere, of each dataset.
        self.ones = [np.ones((1, d.observations.n_frames)) for d in problem.datasets]
        #: Functions of the frame, see `dependences`.
        self.waves = problem.waves = problem.waves or dependences(problem, most_steps)
        self.slopes = self._at_places()
        parts = list(zip(problem.channels, problem.segments, strict=True))
        #: Tangent and lamp with the frames first, (F, rows of a frame, rank), one a dataset.
        self.by_frame = [_frames_first(self.tangent[rows], c.shape) for c, rows in parts]
        self.lamp_by_frame = [_frames_first(c.nuisance, c.shape[1:]) for c, _ in parts]

    @cached_property
    def cells(self):
        """All cells, in the order of places, kinds and dependences."""
        return [
            Cell(place, kind, dependence)
            for place, kind in self.slopes
            for dependence in ([_DETECTOR[kind]] if kind in _DETECTOR else self.waves)
        ]

    def _at_places(self):
        """Return the derivative of both channels to a constant perturbation, by place and kind."""
        chains, where = [], {}
        for chain in self.model.held_chains:
            for place in places(chain):
                probe = optics.LinearRetarder(
                    retardance=0 * u.deg,
                    theta=place.theta * u.rad,
                    mount=place.mount,
                    name=_probe(place),
                )
                chain = place.insert(chain, probe)
                where.setdefault(place.name, None)
            chains.append(chain)
        for chain in chains:
            for leaf in leaves(chain):
                for key in leaf.param_names:
                    getattr(leaf, key).fixed = True
        observations = self.model.observations
        problem = GapProblem(chains, observations, like=self.problem, copy=False)
        found = {}
        for i, (channel, dataset) in enumerate(
            zip(problem.channels, problem.datasets, strict=True)
        ):
            sweep = dataset.forward(problem.vector(problem.start))
            names = {leaf.name: j for j, leaf in enumerate(dataset.propagator.leaves)}
            own = {p: names[_PROBE + p] for p in where if _PROBE + p in names}
            both = [sweep.crossings(own.values(), w) for w in channel.slopes(sweep)]
            for place, j in own.items():
                for kind, generator in GENERATORS.items():
                    if kind == "gain":
                        continue
                    slope = np.stack([_bilinear(*part[j], generator) for part in both])
                    found.setdefault((place, kind), {})[i] = slope * channel.valid
            right, left = sweep.fluxes
            gain = np.stack([(one * right - other * left) for one, other in channel.slopes(sweep)])
            found.setdefault(("detector", "gain"), {})[i] = gain * channel.valid
            for kind, slope in self._at_detector(i, channel, sweep):
                found.setdefault(("detector", kind), {})[i] = slope * channel.valid
        return found

    def _at_detector(self, i, channel, sweep):
        """Yield what background, nonlinearity, afterglow and crosstalk do to the channels."""
        right, left = sweep.fluxes
        fluxes = self.problem.fluxes[i]
        if fluxes is None:
            return
        usual = np.median(fluxes)
        # light that is added counts as much as the source gives in the frame, in these units
        added = usual * (right + left) / np.maximum(fluxes.sum(axis=0), 1e-9 * usual)
        order = np.argsort(channel.sequence, kind="stable")
        # the first frame has none before it, and its own counts, as in a chain
        before = fluxes.copy()
        before[..., order[1:]] = fluxes[..., order[:-1]]
        afterglow = np.divide(before, fluxes, out=np.zeros_like(fluxes), where=fluxes > 0)
        half = (left - right) / 2
        changes = {
            "background": (added, added),
            "background_of_one_beam": (added, 0 * added),
            "nonlinearity": (right * fluxes[0] / usual, left * fluxes[1] / usual),
            "persistence": (right * afterglow[0], left * afterglow[1]),
            "crosstalk": (half, -half),
        }
        for kind, (one, other) in changes.items():
            slopes = [a * one + b * other for a, b in channel.slopes(sweep)]
            yield kind, np.stack(slopes)

    @staticmethod
    def is_detector(kind):
        """Whether a kind belongs to a detector, and has one dependence only."""
        return kind in _DETECTOR

    @staticmethod
    def dependence_of(kind):
        """Return the one dependence of a kind that belongs to a detector."""
        return _DETECTOR[kind]

    # ---- normal equations --------------------------------------------------------------------

    def reduced(self, degrees=(0, 2)):
        """
        Yield, of each place and kind and law in wavelength, what all dependences need.

        Parameters
        ----------
        degrees : sequence of int or None
            Degrees of the laws in wavelength.

        Yields
        ------
        place, kind : str
        degree : int or None
        Reduced
        """
        wavelength = self.problem.wavelength
        for (place, kind), slopes in self.slopes.items():
            for degree in degrees:
                law = law_basis(wavelength, degree)
                yield place, kind, degree, Reduced(self, slopes, law)


def _frames_first(basis, shape):
    """Return columns (..., F) x q of a table as (F, rows of a frame, q)."""
    # no -1: of a model without free parameters there are no columns
    rows, rank = basis.shape
    table = basis.reshape(rows // shape[-1], shape[-1], rank)
    return np.ascontiguousarray(table.swapaxes(0, 1))


_PROBE = "gap_probe_"


def _probe(place):
    return _PROBE + place.name


def _bilinear(row, light, generator):
    """Return a . G s of every wavelength and frame."""
    out = np.zeros(row.shape[:-1])
    for i, j in zip(*np.nonzero(generator), strict=True):
        out += generator[i, j] * row[..., i] * light[..., j]
    return out


class Reduced:
    """
    Sums over the wavelengths, of one place, kind and law, of which dependences are linear maps.

    Parameters
    ----------
    probes : Probes
        Derivatives.
    slopes : dict of int to `~numpy.ndarray`
        Of each dataset (2, W, F).
    law : `~numpy.ndarray`
        Basis of the law in wavelength, shape (W, k).
    """

    def __init__(self, probes, slopes, law):
        problem, k = probes.problem, law.shape[1]
        self.gram, self.target, self.seen, self.lamps = [], [], [], []
        for i, (dataset, channel, rows) in enumerate(
            zip(problem.datasets, problem.channels, problem.segments, strict=True)
        ):
            slope = slopes.get(i)
            if slope is None:
                slope = np.zeros(channel.shape)
            columns = law[dataset.bins].T[:, None, :, None] * slope
            white = channel.whiten_frames(columns)
            n_frames = channel.shape[2]
            # frames last, then a product of matrices a frame
            flat = white.reshape(k, -1, n_frames)
            self.gram.append(np.einsum("krf,lrf->klf", flat, flat))
            residual = probes.residual[rows].reshape(-1, n_frames)
            self.target.append(np.einsum("krf,rf->kf", flat, residual))
            self.seen.append(_by_frame(flat, probes.by_frame[i]))
            # the lamp is taken up as the tangent is: both are directions that data do not tell
            self.lamps.append(_by_frame(white[:, 1], probes.lamp_by_frame[i]))

    def normal(self, waves):
        """
        Return the normal equations of dependences of one function each, less tangent and lamp.

        Parameters
        ----------
        waves : list of `~numpy.ndarray`
            Functions of the frame, shape (n, F), one array a dataset.

        Returns
        -------
        gram : `~numpy.ndarray`
            Shape (n, k, k).
        target : `~numpy.ndarray`
            Shape (n, k).
        """
        parts = zip(self.gram, waves, strict=True)
        gram = sum(np.einsum("klf,nf->nkl", g, w * w, optimize=True) for g, w in parts)
        target = sum(np.einsum("kf,nf->nk", t, w) for t, w in zip(self.target, waves, strict=True))
        for seen in self._taken(waves):
            gram = gram - seen @ seen.swapaxes(1, 2)
        return gram, target

    def pair(self, waves):
        """Return the same for one dependence of several functions: (n k, n k) and (n k,)."""
        n = len(waves[0])
        products = [(w[:, None] * w[None]).reshape(n * n, -1) for w in waves]
        gram = sum(np.tensordot(p, g, (1, 2)) for g, p in zip(self.gram, products, strict=True))
        k = gram.shape[-1]
        gram = gram.reshape(n, n, k, k).transpose(0, 2, 1, 3).reshape(n * k, n * k)
        target = sum(np.einsum("kf,nf->nk", t, w) for t, w in zip(self.target, waves, strict=True))
        for seen in self._taken(waves):
            flat = seen.reshape(n * k, -1)
            gram = gram - flat @ flat.T
        return gram, target.ravel()

    def _taken(self, waves):
        """Yield what tangent and lamps take of the columns, (n, k, rank)."""
        yield sum(np.tensordot(w, s, (1, 1)) for s, w in zip(self.seen, waves, strict=True))
        for lamp, wave in zip(self.lamps, waves, strict=True):
            yield np.tensordot(wave, lamp, (1, 1))


def _by_frame(columns, basis):
    """Return products of columns (k, R, F) and a basis (F, R, q), frame by frame: (k, F, q)."""
    return np.matmul(columns.transpose(2, 0, 1), basis).transpose(1, 0, 2)
