# Licensed under a 3-clause BSD style license - see LICENSE
"""
Simulated calibrations with faults in them, for the challenge.

Stokes vectors go through the Mueller matrices of the optics, and a fault is the matrix exponential
of a generator, or something that no such matrix is. What is shared with the diagnosis are optics
and free parameters, generators and functions of the frame, the listed effects, and the names of
what a detector does; nothing of its fits, noise, derivatives and evidence.
"""

from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from itertools import product

import astropy.units as u
import numpy as np
from numpy.polynomial.legendre import legval, legvander
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import lfilter

from astropolcal import instruments
from astropolcal.chain import leaves, stages, with_beam
from astropolcal.exceptions import GapError
from astropolcal.gap.cells import DETECTED
from astropolcal.gap.effects import EFFECTS, Context, get_effect
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.mueller import rotate
from astropolcal.observations import Observations
from astropolcal.optics import COORDINATES
from astropolcal.optics.perturbations import GENERATORS, Dependence
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.words import check_choice

#: Stages that a lamp on the bench knows.
_BENCH_STAGES = {"hwp", "derotator", "flc_state"}
# instruments with fewer wavelengths than this have filters, which stay where they are
_FILTERS = 8
_DEGREE = 2
#: Shares below this are not in the key.
_LEAST_SHARE = 0.3
# directions of a cell below this share of its length are taken up by the nominal model
_OPEN = 1e-4
# fits on the way to the size of a fault
_TRIES = 14
#: What optics can do to a Stokes vector, to first order.
ACTIONS = {kind: matrix for kind, matrix in GENERATORS.items() if kind != "gain"}
#: What a detector does, and the dependence under which the key has it; a gain may have any.
DETECTOR = {
    kind: on
    for kind, on in DETECTED.items()
    if kind != "crosstalk" and not kind.startswith("nonlinearity_")
}
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
# what a background may do
_FOLLOWED = ("time", "step", "harmonic")
# the largest size: radian, or a share
_LARGEST, _LARGEST_SHARE = 0.2, 0.3
# what the nominal model takes up leaves less than this share of itself
_TAKEN_UP = 0.02


@dataclass(frozen=True)
class Setup:
    """What is simulated: one cycle of the half-wave plate at each angle of the derotator.

    ``options`` go to the ``chain`` of the instrument; an instrument with filters keeps its own
    wavelengths. The median ``flux`` per wavelength and frame and the ``read_noise`` per beam and
    frame are in electrons. ``drift`` of the lamp through the run and ``flicker`` from frame to
    frame are relative; every challenge draws between none and twice this.
    """

    instrument: str = "charis"
    options: dict | None = None
    n_wavelengths: int = 8
    n_derotator: int = 8
    flux: float = 1e7
    read_noise: float = 100.0
    drift: float = 0.02
    flicker: float = 0.003

    def __post_init__(self):
        for key in ("n_wavelengths", "n_derotator"):
            if getattr(self, key) < 3:
                raise GapError(f"{key} = {getattr(self, key)}; allowed are whole numbers from 3 up")
        if self.options is None:
            known = signature(instruments.get(self.instrument).chain).parameters
            # a frozen dataclass is filled in like this
            options = {"derotator": "linear"} if "derotator" in known else {}
            object.__setattr__(self, "options", options)

    @property
    def wavelength(self):
        """Wavelengths: evenly in the logarithm over the range of the instrument, or its filters."""
        usual = instruments.get(self.instrument).wavelength
        if len(usual) < _FILTERS:
            return usual[: self.n_wavelengths]
        return np.geomspace(usual.min(), usual.max(), self.n_wavelengths)

    @cached_property
    def sources(self):
        """The sources of the instrument that need no telescope."""
        known = instruments.get(self.instrument).sources
        return [name for name in known if set(stages(self._chain(name))) <= _BENCH_STAGES]

    def _chain(self, source):
        instrument = instruments.get(self.instrument)
        return instrument.chain(source, wavelength=self.wavelength, **self.options)

    def chains(self):
        """Return the nominal chain of each internal source, at its starting values."""
        return [self._chain(source) for source in self.sources]

    def frames(self, order=None):
        """Return the frames of one dataset, the derotator's positions in an order."""
        turn = np.linspace(45, 132.5, self.n_derotator) * u.deg
        frames = half_wave_plate_cycles(derotator=turn if order is None else turn[order])
        if "flc_state" in stages(self._chain(self.sources[0])):
            # both states of the modulator at each position of the plate
            frames = frames[np.repeat(np.arange(len(frames)), 2)]
            frames["flc_state"] = np.arange(len(frames)) % 2
        return frames


class Bench:
    """A true instrument, its lamps and its nominal model, fitted to what the faults give."""

    def __init__(self, setup, rng):
        self.setup, self.rng = setup, rng
        wavelength = setup.wavelength
        self.micron = wavelength.to_value(u.um)
        x = np.log(self.micron)
        # over the range of the wavelengths, from -1 to 1
        x = 2 * (x - x.min()) / np.ptp(x) - 1
        self.law = legvander(x, min(_DEGREE, len(wavelength) - 1))
        self.chains = setup.chains()
        self._free = FreeParameters(self.chains, len(wavelength))
        self._start, cut = self._free.start(), {}
        known = {slot.name for slot, _ in self._free.priors}
        # a mounting that is known within its error is where it should be
        for slot in (slot for slot in self._free.slots if slot.name not in known):
            value = self._start[slot.slice]
            self._start[slot.slice] = _vary(slot, value, self.law, rng, cut)
        self._free.put_back(self._start)
        self.shuffled = bool(rng.random() < 0.5)
        order = rng.permutation(setup.n_derotator) if self.shuffled else None
        frames = setup.frames(order)
        # a lamp is not white
        flux = setup.flux * np.clip(self.law @ [1, *rng.normal(0, 0.2, _DEGREE)], 0.3, 3.0)
        self.flicker = rng.uniform(0, 2 * setup.flicker)
        instrument = instruments.get(setup.instrument)
        known = {leaf.name for leaf in leaves(self.chains[0])}
        out = [name for name in instrument.optional_optics if name not in known]
        # so that a table of it needs no more to be read
        meta = {"instrument": instrument.name, **instrument.meta_without(out)}
        self.clean = []
        for chain, source in zip(self.chains, setup.sources, strict=True):
            # drift in the logarithm: higher orders fall as one over the degree
            n, orders = len(frames), [0, *rng.normal(0, 1, 3) / (1, 2, 3)]
            drift, flicker = legval(np.linspace(-1, 1, n), orders), rng.normal(0, self.flicker, n)
            lamp = np.exp(rng.uniform(0, 2 * setup.drift) * drift + flicker)
            light = {"flux": flux, "lamp": lamp, "noise": False}
            named = {"name": source, "meta": meta | {"source": source}}
            self.clean.append(simulate(chain, wavelength, frames, **light, **named))
        self.optics = [self.split(chain) for chain in self.chains]
        self._last = {}
        every = (leaf for chain in self.chains for leaf in leaves(chain))
        self._known = {leaf.name: leaf.canonical_values() for leaf in every}
        ideal = self.expose()
        #: Electrons for a flux of one, (F, W).
        self.bright = [
            (o.flux_right + o.flux_left) / f.sum(axis=0)
            for o, f in zip(self.clean, ideal, strict=True)
        ]
        self._settle_noise(ideal)

    @staticmethod
    def split(chain):
        """Return each optic as it acts on the right and the left beam."""
        beams = [leaves(with_beam(chain, beam)) for beam in ("right", "left")]
        return list(zip(*beams, strict=True))

    # ---- light through the chain ---------------------------------------------------------------

    def _matrices(self, dataset, positions=None, values=None, optics=None):
        """Yield name, angle (F, W or 1) and matrices (beams, F, W, 4, 4) of each optic."""
        if positions or optics is not None:
            for pair in self.optics[dataset] if optics is None else optics:
                given = None if values is None else values.get(pair[0].name)
                yield self._resolved(dataset, positions, given, pair)
            return
        for i, pair in enumerate(self.optics[dataset]):
            given = (values or self._known)[pair[0].name]
            # of a derivative or a cell most optics are as they were
            last, done = self._last.get((dataset, i), (None, None))
            if last is None or not all(map(np.array_equal, last, given)):
                done = self._resolved(dataset, None, given, pair)
                self._last[dataset, i] = [np.copy(value) for value in given], done
            yield done

    def _resolved(self, dataset, positions, given, pair):
        found = []
        for beam, leaf in enumerate(pair):
            where = None
            if leaf.stage:
                where = (positions or {}).get(leaf.stage)
                where = self.clean[dataset].position(leaf.stage) if where is None else where
                # what differs between the beams is (2, W, F)
                where = where[beam].T if where.ndim == 3 else where[:, None]
                where = where * (1 if leaf.stage in COORDINATES else u.rad)
            found.append(leaf._resolve(self.micron * u.um, where, given))
        both = np.array([leaf._oriented(*one) for leaf, one in zip(pair, found, strict=True)])
        # frames, wavelengths, or both may be missing
        missing = (1,) * (5 - both.ndim)
        return pair[0].name, found[0][1], both.reshape(2, *missing, *both.shape[1:])

    def path(self, dataset, positions=None, values=None, kicks=(), optics=None, skip=None):
        """Return the fluxes (2, F, W) of a dataset; kicks are places with a Mueller matrix each."""
        n_frames, n_waves = self.clean[dataset].n_frames, len(self.micron)
        light = np.broadcast_to([1.0, 0, 0, 0], (2, n_frames, n_waves, 4))[..., None]
        for name, angle, matrices in self._matrices(dataset, positions, values, optics):
            light = light if name == skip else matrices @ light
            for place, kick in kicks:
                if name == self.anchor(dataset, place):
                    turn = angle if place.startswith("in:") else 0.0
                    light = rotate(kick, turn * u.rad) @ light
        return light[..., 0, 0]

    def anchor(self, dataset, place):
        """Return the optic upstream of a place; the source ends where the first stage is."""
        if place != "source":
            return place.split(":")[1]
        names = [pair[0].name for pair in self.optics[dataset]]
        return names[[bool(pair[0].stage) for pair in self.optics[dataset]].index(True) - 1]

    @cached_property
    def places(self):
        """Places where an optic may do what no parameter holds, in the order of the light."""
        behind = [pair[0] for pair in self.optics[0] if not pair[0].splits_light]
        first = [bool(leaf.stage) for leaf in behind].index(True)
        found = ["source"]
        for leaf in behind[first:]:
            if hasattr(leaf, "beam"):
                break
            found += [f"in:{leaf.name}"] * bool(leaf.stage) + [f"after:{leaf.name}"]
        return found

    @cached_property
    def dependences(self):
        """How a perturbation may depend on the frame."""
        found = ["constant", "time", "time2"]
        for stage in ("hwp", "derotator"):
            found += [f"harmonic:{stage}:{n}" for n in (1, 2, 4)]
            found += [f"direction:{stage}", f"move:{stage}"]
        cycle = self.clean[0].n_frames // self.setup.n_derotator
        found += [f"step:{cycle * k}" for k in range(1, self.setup.n_derotator)]
        several = self.setup.sources[1:]
        return found + [f"dataset:{name}" for name in several]

    def waves(self, dataset, dependence):
        """Return the functions of the frame that a dependence is, (F, k)."""
        how, clean = Dependence(dependence), self.clean[dataset]
        place = np.ones(clean.n_frames) if how.driver is None else clean.position(how.driver)
        return how.waves(place).T * (how.run in (None, clean.name))

    def expose(self, faults=()):
        """Return the fluxes (2, F, W) of each dataset for unit lamps, with faults."""
        return [self._exposed(dataset, faults) for dataset in range(len(self.clean))]

    def _exposed(self, dataset, faults):
        positions, kicks, chains, spread = {}, [], self.chains, 0.0
        for fault in faults:
            kicks += fault.kicks(dataset)
            chains = fault.edited(chains)
            for stage, moved in fault.moves(dataset).items():
                clean = self.clean[dataset].position(stage)
                positions[stage] = positions.get(stage, clean) + moved
            if fault.told.get("what") == "smear":
                spread = fault.amplitude * self.waves(dataset, "move:hwp")[:, 0]
        optics = None if chains is self.chains else self.split(chains[dataset])
        still = positions.get("hwp", self.clean[dataset].position("hwp"))
        nodes = (-1, -0.5, 0, 0.5, 1) if np.any(spread) else (0,)
        found = [
            self.path(dataset, positions | {"hwp": still + x * spread}, None, kicks, optics)
            for x in nodes
        ]
        flux = np.mean(found, axis=0)
        for fault in faults:
            flux = fault.detected(dataset, flux)
        # light cannot be less than none
        return np.maximum(flux, 1e-6)

    def record(self, fluxes):
        """Return observations with photon noise."""
        found = []
        for clean, bright, flux in zip(self.clean, self.bright, fluxes, strict=True):
            table = clean.to_table()
            for beam, one in zip(("right", "left"), flux * bright, strict=True):
                electrons, read = one.ravel(), self.setup.read_noise
                drawn = self.rng.poisson(electrons) + self.rng.normal(0, read, electrons.shape)
                # a beam that is dark must not drop out of the table
                table[f"flux_{beam}"] = np.maximum(drawn, 1.0) * u.adu
                table[f"flux_{beam}_err"] = np.sqrt(electrons + read**2) * u.adu
            found.append(Observations.from_table(table, name=clean.name))
        return found

    # ---- what can be seen beside the nominal model ---------------------------------------------

    def _settle_noise(self, fluxes):
        self._weights, self._lamps = [], []
        for bright, flux in zip(self.bright, fluxes, strict=True):
            right, left = flux * bright
            variance = flux * bright + self.setup.read_noise**2
            total = right + left
            difference = 4 * (left**2 * variance[0] + right**2 * variance[1]) / total**4
            weight = np.stack([difference, variance.sum(axis=0) / total**2]) ** -0.5
            n, waves = total.shape
            # the lamp: its spectrum, and a smooth drift common to all wavelengths
            spectrum = np.tile(np.eye(waves), (n, 1, 1))
            drift = np.repeat(legvander(np.linspace(-1, 1, n), 3)[:, None, 1:], waves, axis=1)
            shapes = np.moveaxis(np.concatenate([spectrum, drift], axis=2), 2, 0)
            shapes = self._steadied(shapes * weight[1], weight[1])
            self._weights.append(weight)
            self._lamps.append(np.linalg.qr(shapes.reshape(len(shapes), -1).T)[0])

    def _steadied(self, sums, weight):
        """Whiten sums in which all wavelengths of a frame flicker together."""
        length = np.linalg.norm(weight, axis=1, keepdims=True)
        unit = weight / length
        common = (sums * unit).sum(axis=-1, keepdims=True)
        return sums - (1 - 1 / np.sqrt(1 + (self.flicker * length) ** 2)) * common * unit

    def _whiten(self, channels, known=0.0):
        """Return both channels (..., 2, F, W) of each dataset as rows of unit noise."""
        rows = []
        for one, weight, lamp in zip(channels, self._weights, self._lamps, strict=True):
            shape = one.shape[:-3]
            scaled = one * weight
            sums = self._steadied(scaled[..., 1, :, :], weight[1]).reshape(*shape, -1)
            rows += [scaled[..., 0, :, :].reshape(*shape, -1), sums - (sums @ lamp) @ lamp.T]
        # behind the data, what is known beforehand of the parameters: no fault changes that
        known = np.broadcast_to(
            known, (*rows[0].shape[:-1], self._free.prior_residuals(self._start).size)
        )
        return np.concatenate([*rows, known], axis=-1)

    def _values(self, vector):
        values = {name: list(known) for name, known in self._known.items()}
        for leaf in (leaf for optics in self.optics for leaf, _ in optics):
            for i, key in enumerate(leaf.param_names):
                slot = self._free.by_name.get(f"{leaf.name}.{key}")
                if slot is not None:
                    shape = np.shape(self._known[leaf.name][i])
                    values[leaf.name][i] = vector[slot.slice].reshape(shape)
        return values

    def _model(self, vector):
        values = self._values(vector)
        return [
            _channels(self.path(d, values=values), self.bright[d]) for d in range(len(self.clean))
        ]

    def _jacobian(self, vector):
        """Return the derivative of the whitened model, by finite differences."""
        base, columns, h = self._model(vector), [], 1e-6
        known = self._free.prior_jacobian(vector)
        for slot in self._free.slots:
            moved = vector.copy()
            moved[slot.slice] += h
            # each wavelength has a value of its own, or all have one
            own = np.eye(slot.size)[:, None, None, :]
            slopes = [own * (m - b) / h for m, b in zip(self._model(moved), base, strict=True)]
            columns.append(self._whiten(slopes, known[slot.slice]))
        return np.concatenate(columns).T

    def residual(self, faults):
        """Return what faults leave beside the refitted nominal model, whitened, and the fit."""
        seen = [
            _channels(flux, b) for flux, b in zip(self.expose(faults), self.bright, strict=True)
        ]

        def miss(vector):
            model = self._model(vector)
            missed = [m - s for m, s in zip(model, seen, strict=True)]
            return self._whiten(missed, self._free.prior_residuals(vector))

        fit = least_squares(
            miss, self._start, self._jacobian, self._free.bounds(),
            x_scale="jac", max_nfev=25, ftol=1e-6,
        )  # fmt: skip
        return -fit.fun, fit

    def _cells(self, vector, more=(), law=None):
        """Yield name and whitened columns of each cell of places, kinds and dependences.

        With ``more`` dependences, those of a background that follows something are among them.
        """
        law = self.law if law is None else law
        values, n_sets = self._values(vector), range(len(self.clean))
        flux = [self.path(d, values=values) for d in n_sets]
        names = dict.fromkeys([*self.dependences, *more])
        waves = {name: [self.waves(d, name) for d in n_sets] for name in names}
        for place, (kind, action) in product(self.places, ACTIONS.items()):
            # to first order what is added to the light goes on as all light does
            slopes = [self.path(d, values=values, kicks=[(place, action)]) for d in n_sets]
            for name, wave in waves.items():
                yield f"{place}/{kind}/{name}", self._columns(flux, slopes, wave, law)
        still = waves["constant"]
        followed = {n: w for n, w in waves.items() if more and n.startswith(_FOLLOWED)}
        for kind in ("gain", *DETECTOR):
            slopes = [self.glow(d, kind, flux[d]) for d in n_sets]
            beams = np.ones((1, 2)) if kind in ("gain", "background") else np.eye(2)
            own = [[s * on[:, None, None] for s in slopes] for on in beams]
            known = waves if kind == "gain" else {DETECTOR[kind]: still}
            if kind.startswith("background"):
                known = known | followed
            for name, wave in known.items():
                columns = [self._columns(flux, one, wave, law) for one in own]
                yield f"detector/{kind}/{name}", np.concatenate(columns)

    def glow(self, dataset, kind, flux):
        """Return what is added to the fluxes (2, F, W) for a coefficient of one."""
        bright = self.bright[dataset]
        usual = np.median(bright)
        if kind == "gain":
            return flux * np.array([1, -1])[:, None, None]
        if kind == "nonlinearity":
            return flux**2 * bright / usual
        if kind == "persistence":
            seen = flux * bright
            return np.concatenate([0 * seen[:, :1], seen[:, :-1]], axis=1) / bright
        return np.broadcast_to(usual / bright, flux.shape)

    def _columns(self, flux, slopes, waves, law):
        """Return the whitened columns of slopes (2, F, W) times waves and laws."""
        found = []
        for f, s, wave in zip(flux, slopes, waves, strict=True):
            total = f.sum(axis=0)
            both = np.stack([2 * (f[1] * s[0] - f[0] * s[1]) / total**2, s.sum(axis=0) / total])
            each = np.einsum("fk,wl,cfw->klcfw", wave, law, both)
            found.append(each.reshape(-1, *both.shape))
        return self._whiten(found)

    def shares(self, residual, fit, own=None, sharp=False):
        """
        Return the share of a residual that each cell, or one's own, carries beside the model.

        With smooth laws in wavelength or, where it is sharp, any.
        """
        kept = fit.active_mask == 0
        taken = np.linalg.qr(fit.jac[:, kept])[0]
        signal = residual - taken @ (taken.T @ residual)
        found = {}
        more = [f"harmonic:{stage}:3" for stage in ("hwp", "derotator")] + [own] * bool(own)
        for name, columns in self._cells(fit.x, more, np.eye(len(self.micron)) if sharp else None):
            length = np.linalg.norm(columns, axis=1)
            columns = (columns[length > 0] / length[length > 0, None]).T
            columns = columns - taken @ (taken.T @ columns)
            left, size, _ = np.linalg.svd(columns, full_matrices=False)
            share = np.sum((left[:, size > _OPEN].T @ signal) ** 2) / np.sum(signal**2)
            if share >= _LEAST_SHARE:
                found[name] = round(float(share), 3)
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    def taken_up(self, share):
        """Return place and kind of a constant cell that the nominal parameters absorb."""
        taken, found = np.linalg.qr(self._jacobian(self._start))[0], []
        for name, columns in self._cells(self._start):
            place, kind, dependence = name.split("/")
            left = np.linalg.norm(columns - (columns @ taken) @ taken.T)
            if dependence == "constant" and place != "detector":
                found.append((left / max(np.linalg.norm(columns), 1e-12), place, kind))
        good = [one for one in found if one[0] < share] or [min(found)]
        _, place, kind = good[self.rng.integers(len(good))]
        return {"place": place, "kind": kind, "dependence": "constant"}

    def scale(self, fault, snr):
        """Scale a fault until it stands out by this much, or is as large as it can be."""
        power, last = 1.0, None
        # amplitudes at which it stands out by less, and by more
        low, high = 0.0, np.inf
        for left in reversed(range(_TRIES + 1)):
            residual, fit = self.residual([fault])
            fault.snr = float(np.linalg.norm(residual))
            if last is not None and min(fault.snr, last[1]) > 0.1:
                # some grow with the square of the size
                steps = np.log(fault.amplitude / last[0]), np.log(fault.snr / last[1])
                power = float(np.clip(steps[1] / steps[0], 0.7, 3))
            low, high = (fault.amplitude, high) if fault.snr < snr else (low, fault.amplitude)
            step = (snr / max(fault.snr, 1e-9)) ** (1 / power)
            wanted = min(float(fault.amplitude * np.clip(step, 0.05, 20)), fault.largest)
            if not low < wanted < high and low and np.isfinite(high):
                # parameters at their bounds let it stand out all at once
                wanted = float(np.sqrt(low * high))
            # what is exchanged is there or not, without a size
            done = wanted == fault.amplitude or fault.told.get("what") == "exchanged"
            if done or not left or abs(fault.snr / snr - 1) < 0.02:
                return residual, fit
            last, fault.amplitude = (fault.amplitude, fault.snr), wanted


def _channels(flux, bright):
    """Return normalized difference and logarithm of the sum, (2, F, W)."""
    total = flux.sum(axis=0)
    return np.stack([(flux[0] - flux[1]) / total, np.log(total * bright)])


def _vary(slot, value, law, rng, cut):
    """Return other values of a free parameter, the same in all chains."""
    angle = slot.unit is not None
    if angle and slot.unit.is_equivalent(u.m):
        # two layers that compensate each other are cut together
        common = cut.setdefault(slot.name.partition(".")[0], rng.normal(0, 0.01))
        return value * (1 + common + rng.normal(0, 5e-4))
    if not slot.per_wavelength:
        return value + (np.deg2rad(rng.normal(0, 0.3)) if angle else rng.normal(0, 0.003))
    # smooth in wavelength, and a little that is not, so that a stiff law alone does not fit
    smooth = law @ (rng.normal(0, 1, law.shape[1]) / np.arange(1, law.shape[1] + 1))
    rough = smooth + rng.normal(0, 0.2, value.shape)
    new = value + (np.deg2rad(2) if angle else 0.005) * rough
    low, high = slot.canonical_bounds()
    # a truth at its bound could be fitted from one side only
    margin = 0.0 if angle else 0.002
    return np.clip(new, low + margin, high - margin)


# ---- faults -----------------------------------------------------------------------------------


class Fault:
    """What a simulated calibration has and its nominal model lacks."""

    def __init__(self, bench, told):
        self.bench, self.told = bench, dict(told)
        self.amplitude, self.largest, self.snr = 1e-3, _LARGEST, 0.0
        # the stage whose angle is wrong, and whether it changes sharply with wavelength
        self._turned, self._is_sharp = None, False
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
            self._is_sharp = True
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
            found = lfilter([1.0], [1.0, -0.8], np.diff(angle, prepend=angle[:1]))
        else:
            found = rng.normal(0, 1, clean.n_frames)
            found = np.cumsum(found) if self.told["what"] == "wander" else found
        return found / np.abs(found).max()

    def _draw_listed(self, rng):
        self.amplitude = 1.0
        bench, name = self.bench, self.told.get("effect")
        # what follows the last move is drawn as a cell
        drawn = (e for e in EFFECTS.values() if not e.dependence.startswith("direction"))
        known = drawn if name is None else [get_effect(name)]
        fitting = [e for e in known if e.kind != "discrete" and e.applies(bench.chains)]
        if not fitting:
            raise GapError(f"effect = {name!r} has no place on the bench")
        effect = fitting[rng.integers(len(fitting))]
        self.told["effect"] = effect.name
        context = Context.of(bench.micron, bench.clean)
        self._edit = lambda chains: effect.edit([chain.copy() for chain in chains], context)
        edit = self._edit(bench.chains)
        free = FreeParameters(edit.chains, len(bench.micron), edit.ties)
        each = [(p, free.by_name[p.name].size) for p in edit.parameters]
        self._laws = [(p, _law(p, n, rng)) for p, n in each]
        self._is_sharp = any(_may_be_sharp(p, n) for p, n in each)
        sizes = [p.canonical_limit / np.abs(law).max() for p, law in self._laws]
        self.largest = 0.9 * min(sizes, default=1 / 0.9)

    def cells(self, residual, fit):
        """Return the share of its signal that each cell carries; its own is all of it."""
        own = [self.told.get(key) for key in ("place", "kind", "dependence")]
        step = own[2] if own[2] and own[2].startswith("step:") else None
        found = self.bench.shares(residual, fit, step, self._is_sharp)
        if not all(own):
            return found
        own = "/".join(own)
        # of a large fault its own cell, which is of first order, carries less; what carries as
        # much is the same
        same = [name for name, share in found.items() if share == found.get(own)]
        return found | dict.fromkeys([*same, own], 1.0)

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


def _may_be_sharp(parameter, n):
    """Return whether n values of a parameter, of more than a few, are free at each wavelength."""
    return n > 3 and (parameter.basis is None or parameter.basis.shape[1] == n)


def _law(parameter, n, rng):
    """Return a random law of n values, canonical and of the parameter's usual size."""
    scale = parameter.canonical_scale
    if n == 1:
        return scale * rng.normal()
    if _may_be_sharp(parameter, n):
        # an effect that is free at each wavelength is tried where it is sharp: a resonance anywhere
        at, width = rng.uniform(0, n), rng.uniform(0.5, 0.3 * n)
        return scale * rng.normal() / (1 + ((np.arange(n) - at) / width) ** 2)
    basis = np.eye(n) if parameter.basis is None else parameter.basis
    k = basis.shape[1]
    law = basis @ (rng.normal(0, 1, k) / (1 + np.arange(k)))
    if parameter.is_retained:
        # no optic gives more polarization than there is
        law = -(law - law.min() + 0.3 * (np.ptp(law) + 0.1))
    return scale * law
