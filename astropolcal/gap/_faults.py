# Licensed under a 3-clause BSD style license - see LICENSE
"""The faults of a challenge: of any optic, of the detector, of single frames, and stranger ones."""

import numpy as np
from scipy.linalg import expm

from astropolcal.exceptions import GapError
from astropolcal.gap._bench import ACTIONS, DETECTOR
from astropolcal.gap.effects import EFFECTS, Context, get_effect
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.words import check_choice

_FRAME_FAULTS = ("hwp angle", "derotator angle", "exchanged", "one beam")
_MECHANISMS = (
    "smear", "ghost", "hysteresis", "wander", "jitter", "fringes", "course", "stray light",
    "crosstalk",
)  # fmt: skip
# of these the angle of a stage is wrong
_MOVED = ("hysteresis", "wander", "jitter")
# what a perturbation does through a run where no table has it: t from 0 to 1, angle of a stage,
# angles of both, a phase, a number from 0 to 1, and a random walk of unit steps
_COURSES = {
    "swings": lambda t, s, both, phase, x, walk: np.cos(2 * np.pi * (2 + 2 * x) * t + phase),
    "settles": lambda t, s, both, phase, x, walk: np.exp(-t / (0.1 + 0.3 * x)),
    "for a while": lambda t, s, both, phase, x, walk: (x / 2 < t) & (t < x / 2 + 0.3),
    "two states": lambda t, s, both, phase, x, walk: np.sign(walk),
    "both stages": lambda t, s, both, phase, x, walk: np.cos(both[0] + phase) * np.cos(both[1]),
    "third harmonic": lambda t, s, both, phase, x, walk: np.cos(3 * s + phase),
    "bends": lambda t, s, both, phase, x, walk: np.abs(np.sin(s + phase)),
}
# the largest size: radian, or a share
_LARGEST, _LARGEST_SHARE = 0.2, 0.3
# what the nominal model takes up leaves less than this share of itself
_TAKEN_UP = 0.02


class Fault:
    """What a simulated calibration has and its nominal model lacks."""

    def __init__(self, bench, told):
        self.bench, self.told = bench, dict(told)
        self.amplitude, self.largest, self.snr = 1e-3, _LARGEST, 0.0
        # the stage whose angle is wrong
        self._turned = None
        getattr(self, f"_draw_{self.told['type']}")(bench.rng)

    def _choose(self, key, among):
        """Return what the key says, drawn where it says nothing."""
        among = list(among)
        value = self.told.setdefault(key, among[self.bench.rng.integers(len(among))])
        check_choice(key, value, among, GapError)
        return value

    def _draw_law(self, rng, spread=1.0):
        """Draw a law in wavelength and a phase; the largest exponent is then the amplitude."""
        bench = self.bench
        n = bench.law.shape[1]
        drawn = [float(x) for x in rng.normal(0, 1, n) / (1 + np.arange(n))]
        drawn = drawn if spread == 1 else [1.0, *(spread * x for x in drawn[1:])]
        law = bench.law @ self.told.setdefault("law", drawn)
        phase = self.told.setdefault("phase", float(rng.uniform(0, 2 * np.pi)))
        self._shapes = []
        for d in range(len(bench.clean)):
            wave = bench.waves(d, self.told["dependence"])
            wave = wave @ [np.cos(phase), np.sin(phase)] if wave.shape[1] == 2 else wave[:, 0]
            self._shapes.append(wave[:, None] * law)
        self._shapes = np.array(self._shapes) / max(np.abs(self._shapes).max(), 1e-12)

    def _draw_cell(self, rng):
        self._choose("place", self.bench.places)
        self._choose("kind", ACTIONS)
        self._choose_dependence(rng)
        self._draw_law(rng)

    def _choose_dependence(self, rng):
        if self.told.get("dependence", "").startswith("step:"):
            return
        if self._choose("dependence", self.bench.dependences).startswith("step:"):
            # at any frame but the first and the last
            self.told["dependence"] = f"step:{rng.integers(4, self.bench.clean[0].n_frames - 4)}"

    def _draw_absorbed(self, rng):
        if "place" not in self.told:
            self.told |= self.bench.taken_up(_TAKEN_UP)
        self.told["type"], self.largest = "cell", 0.05
        self._draw_cell(rng)

    def _draw_detector(self, rng):
        self.told["place"], self.largest = "detector", _LARGEST_SHARE
        if self._choose("kind", ("gain", *DETECTOR)) == "gain":
            self._choose_dependence(rng)
            self._draw_law(rng)
            return
        # what is added is never negative
        self.told["dependence"] = "constant"
        self._draw_law(rng, 0.2)
        self.told["dependence"] = DETECTOR[self.told["kind"]]
        if self.told["kind"] == "background_of_one_beam":
            self._choose("beam", ("right", "left"))

    def _draw_frame(self, rng):
        sets, what = self.bench.clean, self._choose("what", _FRAME_FAULTS)
        names = [clean.name for clean in sets]
        self.place = names.index(self._choose("dataset", names))
        n = sets[self.place].n_frames
        frame = self._choose("frame", range(n))
        self.told["with"] = None
        if what == "exchanged":
            # with one that was taken soon after or before
            self.told["with"] = (frame + int(rng.integers(1, 6))) % n
        self._turned = what.split()[0] if "angle" in what else None
        self.largest, self._shapes = _LARGEST_SHARE, [np.zeros(clean.n_frames) for clean in sets]
        self._shapes[self.place][frame] = rng.choice((-1, 1))

    def _draw_mechanism(self, rng):
        what = self._choose("what", _MECHANISMS)
        self.largest = _LARGEST_SHARE
        self.stage = str(rng.choice(("hwp", "derotator")))
        angles = [clean.position(self.stage)[:, None] for clean in self.bench.clean]
        if what in _MOVED:
            self.told["stage"] = self._turned = self.stage
            self._shapes = [self._wandering(clean, rng) for clean in self.bench.clean]
        elif what == "ghost":
            self.told["optic"] = self.stage
        elif what == "course":
            self._choose("place", self.bench.places)
            self._choose("kind", ACTIONS)
            law, waves = self._smooth(rng), self._courses(rng)
            self._shapes = [wave[:, None] * law for wave in waves]
        elif what in ("stray light", "crosstalk"):
            # of a reflection that turns with a stage
            self.told["stage"], phase = self.stage, rng.uniform(0, 2 * np.pi)
            turn, law = rng.choice((1, 2)), 1 + 0.3 * self._smooth(rng)
            self._shapes = [(1 + np.cos(turn * angle + phase)) * law / 2 for angle in angles]
        elif what == "fringes":
            self.told["place"] = str(rng.choice(self.bench.places[2:]))
            self.told["kind"] = str(rng.choice(("retardance_h", "diattenuation_h")))
            phase = 2 * np.pi * rng.uniform(2, 5) * np.linspace(0, 1, len(self.bench.micron))
            turn = rng.choice((1, 2, 4))
            self._shapes = [np.cos(phase + turn * angle) for angle in angles]

    def _smooth(self, rng):
        """Return a random law in wavelength; its largest value is one."""
        n = self.bench.law.shape[1]
        law = self.bench.law @ (rng.normal(0, 1, n) / (1 + np.arange(n)))
        return law / np.abs(law).max()

    def _courses(self, rng):
        """Return what no dependence of the table is through each run, the largest of them one."""
        course, phase = self._choose("course", _COURSES), rng.uniform(0, 2 * np.pi)
        self.told["stage"], number, found = self.stage, rng.random(), []
        for clean in self.bench.clean:
            both = [clean.position(stage) for stage in ("hwp", "derotator")]
            time, walk = np.linspace(0, 1, clean.n_frames), rng.normal(0, 1, clean.n_frames)
            wave = _COURSES[course](
                time, clean.position(self.stage), both, phase, number, np.cumsum(walk)
            )
            found.append(np.asarray(wave, dtype=float))
        return [wave / max(np.abs(wave).max() for wave in found) for wave in found]

    def _wandering(self, clean, rng):
        """Return errors of an angle through a run, the largest one."""
        if self.told["what"] == "hysteresis":
            # each move pulls, and what was pulled goes back slowly
            angle = clean.position(self.stage)
            pull, found = np.diff(angle, prepend=angle[:1]), np.zeros(len(angle))
            for i in range(1, len(angle)):
                found[i] = 0.8 * found[i - 1] + pull[i]
        else:
            found = rng.normal(0, 1, clean.n_frames)
            found = np.cumsum(found) if self.told["what"] == "wander" else found
        return found / np.abs(found).max()

    def _draw_listed(self, rng):
        self.amplitude = 1.0
        bench, name = self.bench, self.told.get("effect")
        known = EFFECTS.values() if name is None else [get_effect(name)]
        fitting = [e for e in known if e.kind != "discrete" and e.applies(bench.chains)]
        if not fitting:
            raise GapError(f"effect = {name!r} has no place on the bench")
        effect = fitting[rng.integers(len(fitting))]
        self.told["effect"] = effect.name
        context = Context.of(bench.micron, bench.clean)
        self._edit = lambda chains: effect.edit([chain.copy() for chain in chains], context)
        edit = self._edit(bench.chains)
        free = FreeParameters(edit.chains, len(bench.micron), edit.ties)
        self._laws = [(p, _law(p, free.by_name[p.name].size, rng)) for p in edit.parameters]
        sizes = [p.canonical_limit / np.abs(law).max() for p, law in self._laws]
        self.largest = 0.9 * min(sizes, default=1 / 0.9)

    def cells(self, residual, fit):
        """Return the share of its signal that each cell carries; its own is all of it."""
        own = [self.told.get(key) for key in ("place", "kind", "dependence")]
        step = own[2] if own[2] and own[2].startswith("step:") else None
        found = self.bench.shares(residual, fit, step, self.told.get("what") == "fringes")
        return {**found, "/".join(own): 1.0} if all(own) else found

    # ---- what it does ---------------------------------------------------------------------------

    def _size(self, dataset):
        return self.amplitude * self._shapes[dataset]

    def kicks(self, dataset):
        """Return places, and a small Mueller matrix for each frame and wavelength there."""
        told = self.told
        if told["type"] == "cell" or told.get("what") in ("fringes", "course"):
            exponent = self._size(dataset)[..., None, None]
            return [(told["place"], expm(exponent * ACTIONS[told["kind"]]))]
        return []

    def moves(self, dataset):
        """Return errors of the angles of stages, radian."""
        return {self._turned: self._size(dataset)} if self._turned else {}

    def edited(self, chains):
        """Return chains with an effect of the library in them, the same without one."""
        if self.told["type"] != "listed":
            return chains
        edit = self._edit(chains)
        free = FreeParameters(edit.chains, len(self.bench.micron), edit.ties)
        vector = free.start()
        for parameter, law in self._laws:
            value = parameter.canonical_neutral + self.amplitude * law
            vector[free.by_name[parameter.name].slice] = value
        free.put_back(vector)
        return edit.chains

    def detected(self, dataset, flux):
        """Return the fluxes (2, F, W) as the detector gives them."""
        told, bench, what = self.told, self.bench, self.told.get("what")
        if told["type"] == "detector":
            beams = {"right": (1, 0), "left": (0, 1)}.get(told.get("beam"), (1, 1))
            added = self._size(dataset) * bench.glow(dataset, told["kind"], flux)
            return flux + np.array(beams)[:, None, None] * added
        if what == "ghost":
            return flux + self.amplitude * bench.path(dataset, skip=told["optic"])
        if what in ("stray light", "crosstalk"):
            # light of nowhere in one beam, or of each beam in the other
            stray = what == "stray light"
            other = np.array([np.median(flux), 0])[:, None, None] if stray else flux[::-1]
            return flux + self._size(dataset) * other
        if what == "one beam":
            return flux * np.stack([1 + self._size(dataset), np.ones(flux.shape[1])])[..., None]
        if what == "exchanged" and dataset == self.place:
            seen, pair = flux * bench.bright[dataset], [told["frame"], told["with"]]
            seen[:, pair] = seen[:, pair[::-1]]
            return seen / bench.bright[dataset]
        return flux


def _law(parameter, n, rng):
    """Return a random law of n values, canonical and of the parameter's usual size."""
    scale = parameter.canonical_scale
    if n == 1:
        return scale * rng.normal()
    basis = np.eye(n) if parameter.basis is None else parameter.basis
    k = basis.shape[1]
    # an effect that is free at each wavelength is tried where it is sharp
    if n == k and k > 3:
        # a resonance anywhere
        at, width = rng.uniform(0, n), rng.uniform(0.5, 0.3 * n)
        return scale * rng.normal() / (1 + ((np.arange(n) - at) / width) ** 2)
    law = basis @ (rng.normal(0, 1, k) / (1 + np.arange(k)))
    if parameter.is_retained:
        # no optic gives more polarization than there is
        law = -(law - law.min() + 0.3 * (np.ptp(law) + 0.1))
    return scale * law
