# Licensed under a 3-clause BSD style license - see LICENSE
r"""
The gap as a perturbation of the chain: place, kind and dependence of a small error.

A small error of any optic is a small Mueller perturbation somewhere in the chain, of some kind,
with some dependence on the frame. The product of all places, kinds and dependences is a table of
*cells*. The derivative of the data to a cell is a . G s times a function of the frame, with the
light s that arrives at the place, the analyser row a downstream of it and the generator G of the
kind: light and rows of all places come from one forward and one backward sweep.
"""

from collections import Counter
from copy import copy
from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import insert_optic, leaves
from astropolcal.gap.problem import GapProblem
from astropolcal.optics.perturbations import GENERATORS, Dependence, split_run
from astropolcal.optics.positions import COORDINATES

__all__ = []

# kinds that only a detector may have: dependence and words of each
_DETECTED = {
    "background": ("flux", "background in both beams"),
    "background_of_one_beam": ("flux", "background in one beam"),
    "nonlinearity": ("flux", "answer that is not linear"),
    "nonlinearity_of_right_beam": ("flux", "answer of the right beam that is not linear"),
    "nonlinearity_of_left_beam": ("flux", "answer of the left beam that is not linear"),
    "persistence": ("previous", "light of the frame before"),
    "crosstalk": ("constant", "light of one beam in the other"),
}
#: Kinds that only a detector may have, and the dependence of each.
DETECTED = {kind: dependence for kind, (dependence, _) in _DETECTED.items()}
# what no matrix of one wavelength is: the beams see an optic at other wavelengths, or bands
BETWEEN_BEAMS = "_between_beams"
_RETARDANCE = f"retardance_h{BETWEEN_BEAMS}"
# of these some may also drift or step; an angle may do that, too, and what follows a stage has a
# name
_COURSES = dict.fromkeys(("background", "background_of_one_beam"), ("time", "step"))
_COURSES[_RETARDANCE] = ("constant",)
_COURSES["orientation"] = ("time", "time2", "step", "direction", "move")
# the components of an elliptical retarder
_RETARDER = {"retardance_h", "retardance_d", "rotation"}
# what all frames have, or runs, or what a kind brings with it, is no course
_NO_COURSE = ("constant", "dataset", *dict.fromkeys(DETECTED.values()))
_SKY = ("parallactic", "altitude")
_HARMONICS = (1, 2, 3, 4)
# steps are looked for at so many frames, and the best of them at those in between
_MOST_STEPS = 16
# in so few frames a step is that of one that is wrong, beside others that a cell hardly changes
_FEW = 3
# functions of the frame that differ by less are the same
_SAME = 1e-9
# size (radian) of a retardance that is tried where its derivative vanishes
FINITE = 0.1
# usual size of a perturbation by kind, the scale of its prior, and the most that it may be (radian,
# or a share): beyond it is no perturbation
_SIZES = {
    "retardance": (0.1, np.pi),
    **dict.fromkeys(("rotation", "orientation"), (0.02, np.pi / 4)),
    "diattenuation": (0.02, 3.0),
    "depolarization": (0.05, 3.0),
    # what follows the flux would follow the flicker of the lamp as well if it could be large
    **dict.fromkeys(("background", "nonlinearity", "persistence"), (0.003, 0.5)),
}
_USUAL = 0.02, 0.5


@dataclass(frozen=True, order=True)
class Cell:
    """One place, kind and dependence of a small error.

    Places are ``"source"``, ``"telescope"``, ``"in:OPTIC"`` (the frame that turns with it),
    ``"after:OPTIC"`` (the frame that is static) and ``"detector"``. Kinds are those of a
    `~astropolcal.optics.Perturbation`, and ``"background"``, ``"background_of_one_beam"``,
    ``"nonlinearity"``, ``"persistence"``, ``"crosstalk"``, and ``"brightness"``, which a gain is
    where there is one beam. Dependences are as a perturbation takes them, and ``"flux"`` and
    ``"previous"``; in one of several runs only with ``"/dataset:NAME"`` after it.
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
    def run(self):
        """Name of the one dataset in which it is, None where it is in all."""
        return split_run(self.dependence)[1]

    def in_run(self, name):
        """Return the same in one dataset only."""
        text = "" if self.dependence in ("constant", "flux", "previous") else f"{self.dependence}/"
        return replace(self, dependence=f"{text}dataset:{name}")

    @property
    def scale(self):
        """Usual size, in radian or as a share."""
        if split_run(self.dependence)[0] == "brightness":
            # data hardly tell it from a background, nor should the usual sizes
            return _SIZES["background"][0]
        return _SIZES.get(self.kind.partition("_")[0], _USUAL)[0]

    @property
    def limit(self):
        """The most that it may be, in radian or as a share."""
        return _SIZES.get(self.kind.partition("_")[0], _USUAL)[1]

    @property
    def title(self):
        """The cell in words."""
        return f"{_kind_words(self)} {_place_words(self.place)}{_when(self.dependence)}"

    def to_dict(self):
        """Return place, kind and dependence, ready for JSON."""
        kind = _FOR_MACHINES.get(self.kind, self.kind)
        return {"place": self.place, "kind": kind, "dependence": self.dependence}


# what has more words than kinds
_FOR_MACHINES = {
    "brightness": "gain",
    "orientation": "rotation",
    "nonlinearity_of_right_beam": "nonlinearity",
    "nonlinearity_of_left_beam": "nonlinearity",
}
_KINDS = {
    "rotation": "rotation (circular retardance)",
    "orientation": "error of the angle",
    "diattenuation_c": "circular diattenuation",
    "depolarization_linear": "depolarization of linear light",
    "depolarization_h": "depolarization along one axis against the other",
    "depolarization_d": "depolarization at 45 deg to the axes",
    "depolarization_circular": "depolarization of circular light",
    "gain": "gain of one beam against the other",
    "brightness": "brightness of the source, or gain",
    "gain_of_right_beam": "gain of the right beam",
    "gain_of_left_beam": "gain of the left beam",
    _RETARDANCE: "retardance that differs between the beams (other wavelengths)",
    **{kind: words for kind, (_, words) in _DETECTED.items()},
}


# after the stage, or what else follows the first colon, and how often a harmonic comes
_PATTERNS = {
    "time": " that drifts through the run",
    "time2": " that bends through the run",
    "step": " that changes at the {0} frame of the table",
    "frame": " in the {0} frame of the table alone",
    "harmonic": " that changes {1} in a turn of the {0}",
    "direction": " that depends on the direction of the last move of the {0}",
    "state": " where {0}",
    "move": " that grows with the last move of the {0}",
    "brightness": " that follows its brightness",
}
_TIMES = {"1": "once", "2": "twice", "3": "three times", "4": "four times"}


def _kind_words(cell):
    if cell.kind in _KINDS:
        return _KINDS[cell.kind]
    word, _, axis = cell.kind.partition("_")
    return f"{word} along the axes" if axis == "h" else f"{word} at 45 deg to the axes"


def own_name(optic):
    """Return the name of an optic or stage in words."""
    return "half-wave plate" if optic == "hwp" else optic


def _place_words(place):
    head, _, optic = place.partition(":")
    return {
        "in": f"of the {own_name(optic)}",
        "after": f"downstream of the {own_name(optic)}",
        "source": "of the source, or upstream of the first optic that turns",
        "telescope": "upstream of the half-wave plate",
        "detector": "at the detector",
    }[head]


def _when(dependence):
    text, run = split_run(dependence)
    kind, where, count, *_ = (*text.split(":"), "", "")
    if kind in ("step", "frame"):
        # a table may number its frames in any way
        where = _ordinal(int(where) + 1)
    where = own_name(where).replace("=", " is ")
    words = _PATTERNS.get(kind, "").format(where, _TIMES.get(count, f"{count} times"))
    return words + (f' in "{run}" only' if run is not None else "")


def _ordinal(number):
    ends = {1: "st", 2: "nd", 3: "rd"}
    return f"{number}{'th' if number // 10 % 10 == 1 else ends.get(number % 10, 'th')}"


def alike(cells):
    """Return what two cells have in common: an "optic", a "course" or an "action".

    An optic of any axis has two components, and a cell may be asked for twice, with another law. A
    course through the run, or an action, which is place and kind, may be one thing that no table
    has; empty for all others.
    """
    if len(cells) != 2 or None in cells:
        return ""
    one, other = sorted(cells, key=lambda cell: cell.kind == "gain")
    if one.dependence == other.dependence:
        # what differs between the beams is a component, too, along the axes of what splits them
        kind = "diattenuation_h" if other.kind == "gain" else other.kind
        stem = one.kind.rpartition("_")[0]
        beams = other.kind == "gain" and one.place.startswith("after:")
        pair = {one.kind, kind} == {f"{stem}_h", f"{stem}_d"}
        # and a retarder that does not change may be elliptical
        static = one.dependence.startswith(("constant", "dataset"))
        pair |= static and one.kind != kind and {one.kind, kind} < _RETARDER
        if (beams or one.place == other.place) and (pair or one.kind == other.kind):
            return "optic"
    if one.dependence == other.dependence and not one.dependence.startswith(_NO_COURSE):
        return "course"
    return "action" if (one.place, one.kind) == (other.place, other.kind) else ""


def in_other_frame(cells, stages):
    """Return pairs of cells that two components of an optic may be in its other frame.

    What turns n times with a stage turns n - 2 or n + 2 times in the frame of the optic on it, and
    the other way round; ``stages`` are those of optics, by name.
    """
    one, other = cells
    head, _, optic = one.place.partition(":")
    text, run = split_run(one.dependence)
    word, stage, number = (*text.split(":"), "", "")[:3]
    axes = {cell.kind.rpartition("_")[2] for cell in cells}
    if alike(cells) != "optic" or one.place != other.place or axes != {"h", "d"}:
        return []
    if run is not None or word != "harmonic" or stages.get(optic) != stage:
        return []
    place = f"{'after' if head == 'in' else 'in'}:{optic}"
    turns = sorted({abs(int(number) - 2), int(number) + 2} & set(_HARMONICS))
    patterns = [f"harmonic:{stage}:{n}" for n in turns]
    return [[replace(c, place=place, dependence=pattern) for c in cells] for pattern in patterns]


# ---- places ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """A place in a chain where a perturbation may stand, next to the optic ``before`` or ``after``.

    Its frame is that of the stage ``mount``, which has a sign, turned by ``theta``, radian.
    """

    name: str
    before: str | None = None
    after: str | None = None
    mount: str | None = None
    theta: float = 0.0

    def insert(self, chain, optic):
        """Return the chain with an optic at the place, which has to have its frame."""
        return insert_optic(chain, optic, after=self.after, before=self.before)


_KEEPS = (optics.ParityFlip, optics.Rotator, optics.FrameOptic)
# frame optics that mix what they get in every state
_MODULATES = (optics.FerroelectricLiquidCrystal, optics.StateRetarder)


def places(chain):
    """Return the places of a chain, in the order in which the light meets them."""
    found = [o for o in leaves(chain) if not (o.name or "").startswith("gap_")]
    # a chain of one beam ends with its last optic
    split = next((i for i, o in enumerate(found) if o.splits_light), len(found))
    found = found[: split + 1]
    turning = [o for o in found if o.stage is not None and o.stage not in COORDINATES]
    turning = [o for o in turning if not o.splits_light]
    first = turning[0] if turning else found[-1]
    lamp = found[: found.index(first)]
    # upstream of what belongs to the first, too
    nearest = lamp[-1].name if lamp else None
    out = [Place("source", None if nearest else first.name, nearest)] if lamp else []
    own = [o for o in turning if o.stage not in _SKY and not o.rotates_frame]
    if own and own[0] is not first:
        out.append(Place("telescope", before=own[0].name))
    between = [o for o in found[found.index(own[0]) : -1] if not o.splits_light] if own else []
    for optic in found:
        if optic in own:
            theta = float(np.deg2rad(np.mean(optic.theta.value)))
            out.append(Place(f"in:{optic.name}", None, optic.name, optic.mount, theta))
            out.append(Place(f"after:{optic.name}", None, optic.name))
        # one that does not turn and mixes what it gets makes the place downstream another one
        elif optic in between and (
            isinstance(optic, _MODULATES) or (optic.stage is None and not isinstance(optic, _KEEPS))
        ):
            out.append(Place(f"after:{optic.name}", None, optic.name))
    return out


# ---- dependences -------------------------------------------------------------------------------


def dependences(problem):
    """Return the functions of the frame that the data of a problem can tell."""
    given = dict.fromkeys(stage for dataset in problem.datasets for stage in dataset._given)
    stages = [stage for stage in given if stage not in COORDINATES and stage not in _SKY]
    names = ["constant", "time", "time2"]
    names += [f"harmonic:{stage}:{k}" for stage in stages for k in _HARMONICS]
    names += [f"state:{stage}" for stage in given if "=" in stage]
    names += [f"{what}:{s}" for s in stages for what in _MOVED]
    # of one beam the sums follow the modulation
    names += ["brightness"] * all(channel.groups is None for channel in problem.channels)
    several = [d.observations.name for d in problem.datasets]
    runs = several if count_runs(problem) > 1 else []
    n = min(d.observations.n_frames for d in problem.datasets)
    # frames at which something may have changed: all, or as many as are looked at
    most = min(_MOST_STEPS // max(len(runs), 1), n - 3) if n >= 8 else 0
    steps = [f"step:{at:.0f}" for at in np.unique(np.linspace(2, n - 2, most).round())]
    # a frame of one run has nothing to do with that of the same number in another
    alone = [*names[1:], *steps]
    if len(several) > 1:
        names += [f"dataset:{name}" for name in several]
    names += [] if runs else steps
    names += [f"{name}/dataset:{run}" for run in runs for name in alone]
    found = {}
    for name in names:
        waves = [_waves(Dependence(name), dataset) for dataset in problem.datasets]
        if name == "constant" or _varies(name, waves, problem):
            found[name] = waves
    return found


def _varies(name, waves, problem):
    """Return whether functions, (count, F) per dataset, differ between frames that have data.

    What differs in one frame only, or steps in a few, is a fault of these frames.
    """
    seen = [w[:, c.valid.any(axis=0)] for w, c in zip(waves, problem.channels, strict=True)]
    few, seen = (_FEW, seen) if name.startswith("step:") else (1, [np.concatenate(seen, axis=1)])
    seen = [np.sort(one, axis=1) for one in seen if one.shape[1] > few]
    return any(
        np.minimum(one[:, -1 - few] - one[:, 0], one[:, -1] - one[:, few]).max() > _SAME
        for one in seen
    )


_MOVED = ("direction", "move")


def count_runs(problem):
    """Return how many runs of the same kind of source the datasets of a problem are at most."""
    return max(Counter(d.observations.source for d in problem.datasets).values())


def _waves(dependence, dataset):
    """Return the functions of a dependence in the frames of a dataset, (count, F)."""
    observations = dataset.observations
    if dependence.run not in (None, observations.name):
        return np.zeros((dependence.count, observations.n_frames))
    if dependence.driver is None:
        return np.ones((1, observations.n_frames))
    given = dataset._given.get(dependence.driver)
    if given is None:
        there = observations.frame_columns
        known = dependence.driver in COORDINATES or dependence.driver in there
        if not known or (dependence.kind in _MOVED and dependence.parts[1] not in there):
            return np.zeros((dependence.count, observations.n_frames))
        given = observations.position(dependence.driver)
    return dependence.waves(given.mean(axis=0) if given.ndim == 2 else given)


# ---- derivatives -------------------------------------------------------------------------------


class Probes:
    """Derivatives of the data to all cells at a fitted model.

    ``without`` are the names of its effects that are taken out, to first order; from ``like``,
    probes of the same model, the derivatives are taken over.
    """

    def __init__(self, model, without=(), like=None):
        self.model, self.problem = model, model.problem
        problem, linear = model.problem, model.without(without)
        self.tangent, self.residual = linear.tangent, linear.residual
        #: Names of the effects that are in the model.
        self.own = set(model.added) - set(without)
        #: A function of the frame that is one everywhere, of each dataset.
        self.ones = [np.ones((1, d.observations.n_frames)) for d in problem.datasets]
        #: Functions of the frame, see `dependences`.
        self.waves = problem.waves = problem.waves or dependences(problem)
        self._groups, self._asked = {}, len(self.waves)
        #: Second derivatives over the size that is tried, where they outdo the first ones.
        self.bends = {} if like is None else like.bends
        self.slopes = self._at_places() if like is None else like.slopes
        parts = list(zip(problem.channels, problem.segments, strict=True))
        #: Tangent and lamp with the frames first, (F, rows of a frame, rank), one a dataset.
        self.by_frame = [_frames_first(self.tangent[rows], c.shape) for c, rows in parts]
        self.lamp_by_frame = [_frames_first(c.nuisance, c.shape[1:]) for c, _ in parts]

    def dependences_of(self, place, kind):
        """Return the dependences of a kind at a place."""
        names = list(self.waves)
        if kind != "rotation":
            # nothing but the scale of a stage has reason to change three times in a turn
            names = [name for name in names if not split_run(name)[0].endswith(":3")]
        if kind in DETECTED or kind in _COURSES:
            allowed = (*_COURSES.get(kind, ()), "dataset")
            names = [name for name in names if split_run(name)[0].partition(":")[0] in allowed]
        if kind in DETECTED:
            return [DETECTED[kind], *names]
        if place != "source":
            # nothing else knows how bright it is, and a detector has its own laws
            names = [name for name in names if split_run(name)[0] != "brightness"]
        if len(self.slopes[place, kind]) > 1:
            return names
        # a place in one chain only is in that run anyway
        return [name for name in names if split_run(name)[1] is None]

    @property
    def runs(self):
        """Names of the datasets, of which a cause may be in one only; none for a single run."""
        names = [d.observations.name for d in self.problem.datasets]
        return names if count_runs(self.problem) > 1 else []

    def run_of(self, cell):
        """Return the name of the one dataset that has a cell, None where several have it."""
        if cell is None or cell.run is not None or not self.runs:
            return cell and cell.run
        where = list(self.slopes.get((cell.place, cell.kind), ()))
        return self.runs[where[0]] if len(where) == 1 else None

    def waves_of(self, cell):
        """Return the functions of the frame by which the derivative of a cell is multiplied."""
        name = cell.dependence
        if name not in self.waves and name.startswith("step:"):
            return [_waves(Dependence(name), dataset) for dataset in self.problem.datasets]
        # the derivative of what belongs to a detector has its dependence in it
        return self.waves.get(name, self.ones)

    @property
    def has_more_steps(self):
        """Whether functions of the frame are known by now that were not when these were made."""
        return len(self.waves) > self._asked

    def grouped(self, names):
        """Return dependences with their functions of the frame, those of as many together.

        Each is the names and, per dataset, an array (n, count, F).
        """
        key = tuple(names)
        if key not in self._groups:
            waves = {name: self.waves.get(name, self.ones) for name in names}
            counts = dict.fromkeys(len(w[0]) for w in waves.values())
            together = [[n for n, w in waves.items() if len(w[0]) == count] for count in counts]
            self._groups[key] = [
                (same, [np.stack(each) for each in zip(*(waves[n] for n in same), strict=True)])
                for same in together
            ]
        return self._groups[key]

    def by_wavelength(self, slopes):
        """Return, per dataset, derivative times residual and derivative squared, each (F, W)."""
        problem, found = self.problem, []
        for i, (dataset, channel, rows) in enumerate(
            zip(problem.datasets, problem.channels, problem.segments, strict=True)
        ):
            tables = np.zeros((2, channel.shape[2], len(problem.wavelength)))
            if i in slopes:
                white = channel.whiten_frames(slopes[i])
                both = white * self.residual[rows].reshape(white.shape), white**2
                tables[..., dataset.bins] = [part.sum(axis=0).T for part in both]
            found.append(tables)
        return found

    def steps_near(self, cell):
        """Return the cells of the steps between one that was looked at and its neighbours."""
        text, run = split_run(cell.dependence)
        if not text.startswith("step:"):
            return []
        known = [split_run(name) for name in self.waves if name.startswith("step:")]
        frames = sorted(int(step[5:]) for step, where in known if where == run)
        at = int(text[5:])
        before = max((frame for frame in frames if frame < at), default=0)
        last = max(one.shape[1] for one in self.ones)
        after = min((frame for frame in frames if frame > at), default=last)
        others = [f"step:{frame}" for frame in range(before + 1, after) if frame != at]
        others = others if run is None else [f"{name}/dataset:{run}" for name in others]
        near = [replace(cell, dependence=name) for name in others]
        return [one for one in near if _varies(one.dependence, self.waves_of(one), self.problem)]

    def _at_places(self):
        """Return the derivative of both channels to a constant perturbation, by place and kind."""
        chains, where = [], {}
        for chain in self.model.held_chains:
            found = places(chain)
            # what turns an optic turns the light in front of it and back behind it
            turning = [one.after for one in found if one.name.startswith("in:")]
            for place in [*found, *(Place(f"{_FRONT}{name}", before=name) for name in turning)]:
                frame = {"theta": place.theta * u.rad, "mount": place.mount}
                held = {"fixed": {"theta": True, "retardance": True}}
                name = _PROBE + place.name
                probe = optics.LinearRetarder(retardance=0 * u.deg, name=name, **frame, **held)
                chain = place.insert(chain, probe)
                where.setdefault(place.name, None)
            chains.append(chain)
        observations = self.model.observations
        problem = GapProblem(chains, observations, like=self.problem, copy=False)
        found = {}
        for i, (channel, dataset) in enumerate(
            zip(problem.channels, problem.datasets, strict=True)
        ):
            sweep = dataset.forward(problem.vector(problem.start))
            names = {leaf.name: j for j, leaf in enumerate(dataset.propagator.leaves)}
            own = {p: names[_PROBE + p] for p in where if _PROBE + p in names}
            weights = channel.slopes(sweep)
            both = [sweep.crossings(own.values(), w) for w in weights]
            apart = [sweep.crossings(own.values(), (right, -left)) for right, left in weights]
            for place, j in own.items():
                if place.startswith(_FRONT):
                    inside = "in:" + place.removeprefix(_FRONT)
                    slope = np.stack([_bilinear(p[j], GENERATORS["rotation"]) for p in both])
                    slope = slope * channel.valid - found[inside, "rotation"][i]
                    found.setdefault((inside, "orientation"), {})[i] = slope
                    continue
                for kind, generator in GENERATORS.items():
                    if kind == "gain":
                        continue
                    slope = np.stack([_bilinear(part[j], generator) for part in both])
                    found.setdefault((place, kind), {})[i] = slope * channel.valid
                    if kind.startswith("retardance") and place.startswith("in:"):
                        # of exp(x G), per size: at a size of FINITE it is half of this
                        bend = np.stack([_bilinear(p[j], generator @ generator) for p in both])
                        bend = FINITE / 2 * bend * channel.valid
                        self.bends.setdefault((place, kind), {})[i] = bend
                if place.startswith("in:") and channel.groups is None:
                    slope = [_bilinear(p[j], GENERATORS["retardance_h"]) for p in apart]
                    slope = np.stack(slope) * channel.valid
                    found.setdefault((place, _RETARDANCE), {})[i] = slope
            right, left = sweep.fluxes
            gain = np.stack([(one * right - other * left) for one, other in channel.slopes(sweep)])
            kind = "gain" if channel.groups is None else "brightness"
            found.setdefault(("detector", kind), {})[i] = gain * channel.valid
            for kind, slope in self._at_detector(i, channel, sweep):
                found.setdefault(("detector", kind), {})[i] = slope * channel.valid
        self.bends = {
            key: bend
            for key, bend in self.bends.items()
            # what is seen in first order, be it taken up by the model, has its second one there
            if self._left(bend) > max(np.linalg.norm(self._white(found[key])), 1.0 / FINITE)
        }
        return found

    def _white(self, slopes):
        """Return the whitened derivative of the data to a constant perturbation, (n_rows,)."""
        parts = [
            channel.whiten(slopes.get(i, np.zeros(channel.shape))).ravel()
            for i, channel in enumerate(self.problem.channels)
        ]
        return np.concatenate([*parts, np.zeros(len(self.problem.known))])

    def _left(self, slopes):
        """Return how much of it the model cannot absorb."""
        column = self._white(slopes)
        return float(np.linalg.norm(column - self.tangent @ (self.tangent.T @ column)))

    def _at_detector(self, i, channel, sweep):
        """Yield what background, nonlinearity, afterglow and crosstalk do to the channels."""
        seen = self.problem.flickering[i], self.problem.fluxes[i]
        # differences see the flicker of the lamp, sums do not
        usual = self.model.context.flux
        by_channel = [self._detected(channel, sweep, fluxes, usual) for fluxes in seen]
        weights = channel.slopes(sweep)
        for kind in by_channel[0]:
            pairs = zip(weights, (changes[kind] for changes in by_channel), strict=True)
            yield kind, np.stack([a * one + b * other for (a, b), (one, other) in pairs])

    @staticmethod
    def _detected(channel, sweep, fluxes, usual):
        """Return what each kind adds to the fluxes of both beams, for a usual one of all data."""
        right, left = sweep.fluxes
        single = channel.groups is not None
        # light that is added counts as much as the source gives in the frame, in these units
        added = (1 + single) * usual * (right + left) / np.maximum(fluxes.sum(axis=0), 1e-9 * usual)
        order = np.argsort(channel.sequence, kind="stable")
        # the first frame has none before it, and its own counts, as in a chain
        before = fluxes.copy()
        before[..., order[1:]] = fluxes[..., order[:-1]]
        afterglow = np.divide(before, fluxes, out=np.zeros_like(fluxes), where=fluxes > 0)
        half = (left - right) / 2
        bent = right * fluxes[0] / usual, left * fluxes[1] / usual
        changes = {
            "background": (added, added),
            "background_of_one_beam": (added, 0 * added),
            "nonlinearity": bent,
            "nonlinearity_of_right_beam": (bent[0], 0 * left),
            "nonlinearity_of_left_beam": (0 * right, bent[1]),
            "persistence": (right * afterglow[0], left * afterglow[1]),
            "crosstalk": (half, -half),
        }
        kinds = ("background", "nonlinearity") if single else changes
        return {kind: changes[kind] for kind in kinds}


def _frames_first(basis, shape):
    """Return columns (..., F) x q of a table as (F, rows of a frame, q)."""
    rows = int(np.prod(shape[:-1]))
    return np.ascontiguousarray(basis.reshape(rows, shape[-1], basis.shape[1]).swapaxes(0, 1))


_PROBE, _FRONT = "gap_probe_", "front:"


def _bilinear(pairs, generator):
    """Return a . G s of every wavelength and frame, the sum over pairs of a and s."""
    out = np.zeros(pairs[0][0].shape[:-1])
    for row, light in pairs:
        for i, j in zip(*np.nonzero(generator), strict=True):
            out += generator[i, j] * row[..., i] * light[..., j]
    return out


class Reduced:
    """Sums over the wavelengths, of one place, kind and law, of which dependences are linear maps.

    ``slopes`` are those of each dataset by number, (2, W, F), or several in a list; ``law`` is the
    basis of the law in wavelength, (W, k).
    """

    def __init__(self, probes, slopes, law):
        problem = probes.problem
        slopes = slopes if isinstance(slopes, (list, tuple)) else [slopes]
        k = law.shape[1] * len(slopes)
        self.gram, self.target, self.seen, self.lamps = [], [], [], []
        for i, (dataset, channel, rows) in enumerate(
            zip(problem.datasets, problem.channels, problem.segments, strict=True)
        ):
            nothing = np.zeros(channel.shape)
            own = law[dataset.bins].T[:, None, :, None]
            columns = np.concatenate([own * slope.get(i, nothing) for slope in slopes])
            white = channel.whiten_frames(columns)
            n_frames = channel.shape[2]
            # frames first: a product of matrices for each
            flat = np.ascontiguousarray(white.reshape(k, -1, n_frames).transpose(2, 0, 1))
            self.gram.append(flat @ flat.swapaxes(1, 2))
            residual = probes.residual[rows].reshape(-1, n_frames)
            self.target.append((flat @ residual.T[:, :, None])[..., 0])
            self.seen.append(flat @ probes.by_frame[i])
            # the lamp is taken up as the tangent is: both are directions that data do not tell
            sums = flat[:, :, flat.shape[2] // 2 :]
            self.lamps.append(sums @ probes.lamp_by_frame[i])

    def along(self, columns):
        """Return the same for another law, whose basis is these combinations of its own, (k, j)."""
        part = copy(self)
        part.gram = [columns.T @ g @ columns for g in self.gram]
        part.target = [t @ columns for t in self.target]
        for name in ("seen", "lamps"):
            setattr(part, name, [columns.T @ each for each in getattr(self, name)])
        return part

    def together(self, numbers):
        """Return the same with all frames of a number, (F,) per dataset, as one frame."""
        one, count = copy(self), 1 + max(number.max() for number in numbers)
        members = [np.eye(count)[number].T for number in numbers]
        for name in ("gram", "target", "seen", "lamps"):
            tables = getattr(self, name)
            pairs = zip(members, tables, strict=True)
            tables = [_over_frames(m, t).reshape(count, *t.shape[1:]) for m, t in pairs]
            # the lamp of each dataset has directions of its own
            setattr(one, name, [np.concatenate(tables, -1) if name == "lamps" else sum(tables)])
        return one

    def normal(self, waves):
        """
        Return the normal equations of dependences, less tangent and lamp.

        The functions of the frame are m for each of n dependences, an array (n, m, F) per dataset;
        the equations have shapes (n, m k, m k) and (n, m k), for a law of k columns.
        """
        n, m = waves[0].shape[:2]
        k = self.target[0].shape[1]
        pairs = [(w[:, :, None] * w[:, None]).reshape(n * m * m, -1) for w in waves]
        gram = sum(_over_frames(p, g) for p, g in zip(pairs, self.gram, strict=True))
        gram = gram.reshape(n, m, m, k, k).swapaxes(2, 3).reshape(n, m * k, m * k)
        flat = [w.reshape(n * m, -1) for w in waves]
        target = sum(_over_frames(w, t) for w, t in zip(flat, self.target, strict=True))
        taken = [sum(_over_frames(w, s) for w, s in zip(flat, self.seen, strict=True))]
        taken += [_over_frames(w, s) for w, s in zip(flat, self.lamps, strict=True)]
        for part in taken:
            seen = part.reshape(n, m * k, -1)
            gram = gram - seen @ seen.swapaxes(1, 2)
        return gram, target.reshape(n, m * k)


def _over_frames(waves, table):
    """Return the sums of a table (F, ...) over the frames with weights (n, F)."""
    return waves @ table.reshape(len(table), -1)
