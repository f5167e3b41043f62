# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments with random effects in them, for sealed challenges."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.chain import leaves, stages
from astropolcal.exceptions import GapError
from astropolcal.gap.attribution import scan
from astropolcal.gap.channels import Channels
from astropolcal.gap.effects import EFFECTS, Context, get_effect
from astropolcal.gap.model import Model
from astropolcal.gap.problem import GapProblem, law_basis
from astropolcal.observations import Observations
from astropolcal.propagation import Propagator
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.units import canonical_factor

#: An effect that explains this share of the evidence cannot be told from the true one.
ENOUGH = 0.95
#: What the library may explain of an effect that it is not to know.
UNKNOWN = 0.3
# an effect that lifts chi-square by less than this at its usual size is absorbed
_INVISIBLE = 0.5
_WEAKEST = 3.0
# the scan is linear: a share as large as this is checked by a full fit
_REFIT_FROM = 0.5
_TRIES = 40


@dataclass(frozen=True)
class Setup:
    """
    What is simulated.

    Parameters
    ----------
    instrument : str
        Name of the instrument.
    options : dict
        Passed to its ``chain``: the nominal model.
    n_wavelengths, n_derotator : int
        Numbers of wavelengths and of derotator angles; at each of these one
        cycle of the half-wave plate.
    flux : float
        Median flux that enters, in electrons per wavelength and frame.
    read_noise : float
        Per beam and frame, in electrons.
    drift, flicker : float
        Drift of the lamp through the run and its flicker from frame to frame,
        relative; every challenge draws between none and twice this.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Setup
    >>> Setup(n_derotator=4).n_wavelengths
    8
    """

    instrument: str = "charis"
    options: dict = field(default_factory=lambda: {"derotator": "linear"})
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

    @property
    def wavelength(self):
        """Wavelengths, evenly in the logarithm over the range of the instrument."""
        usual = instruments.get(self.instrument).wavelength
        return np.geomspace(usual.min(), usual.max(), self.n_wavelengths)

    @property
    def sources(self):
        """The sources of the instrument that need nothing but plate and derotator."""
        return [
            name for name in instruments.get(self.instrument).sources if self._is_internal(name)
        ]

    def _is_internal(self, source):
        return set(stages(self._chain(source))) <= {"hwp", "derotator"}

    def _chain(self, source):
        instrument = instruments.get(self.instrument)
        return instrument.chain(source, wavelength=self.wavelength, **self.options)

    def chains(self):
        """Return the nominal chain of each internal source, at its starting values."""
        return [self._chain(source) for source in self.sources]

    def frames(self):
        """Return the frames of one dataset."""
        turn = np.linspace(45, 132.5, self.n_derotator) * u.deg
        return half_wave_plate_cycles(derotator=turn)


@dataclass
class Key:
    """
    The truth of a challenge, to be opened after the answer.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    effects : list of str
        What the data hold and the nominal model lacks.
    snr : list of float
        Square root of the chi-square that each effect adds after the nominal
        model is fitted again.
    alternatives : list of dict
        Share of that chi-square which other effects explain, one dict an effect.
    values : list of dict
        True values of the parameters of each effect, canonical.
    chains : list
        The true chains.

    Examples
    --------
    >>> from astropolcal.gap.challenge import Key
    >>> key = Key("single", ["beam_gain"], [9.0], [{"background": 0.97}], [{}])
    >>> sorted(key.accepted[0])
    ['background', 'beam_gain']
    """

    kind: str
    effects: list
    snr: list
    alternatives: list
    values: list
    chains: list = field(default_factory=list, repr=False)

    @property
    def accepted(self):
        """The right names for each effect: itself, and what cannot be told from it."""
        return [
            {name, *(other for other, share in shares.items() if share >= ENOUGH)}
            for name, shares in zip(self.effects, self.alternatives, strict=True)
        ]

    @property
    def library(self):
        """Names of the effects that the diagnosis may ask."""
        gone = set().union(*self.accepted) if self.kind == "withheld" else set()
        return [name for name in EFFECTS if name not in gone]


@dataclass
class _Planted:
    """An effect of a certain size, and what it does to the data."""

    name: str
    draw: object
    size: float = 1.0
    snr: float = 0.0
    shares: dict = field(default_factory=dict)
    values: dict = field(default_factory=dict)


class Bench:
    """A true instrument, its lamps, and the nominal problem at the truth."""

    def __init__(self, setup, rng):
        self.setup, self.rng = setup, rng
        self.wavelength = setup.wavelength
        self.chains = _varied(setup.chains(), self.wavelength.to_value(u.um), rng)
        instrument = instruments.get(setup.instrument)
        # a lamp is not white: a law of second degree, between 0.3 and 3 times the flux asked for
        slope = law_basis(self.wavelength.to_value(u.um), 2) @ (1, *rng.normal(0, 0.2, 2))
        flux = setup.flux * np.clip(slope, 0.3, 3.0)
        self.clean = [
            simulate(
                chain,
                self.wavelength,
                setup.frames(),
                flux=flux,
                lamp=self._lamp(len(setup.frames())),
                noise=False,
                name=source,
                meta={"instrument": instrument.name, "source": source},
            )
            for chain, source in zip(self.chains, setup.sources, strict=True)
        ]
        middle = [np.median(o.flux_right + o.flux_left) / 2 for o in self.clean]
        self.context = Context(self.wavelength.to_value(u.um), float(np.median(middle)))
        noisy = self.record(
            [self.fluxes(c, o) for c, o in zip(self.chains, self.clean, strict=True)]
        )
        self.problem = GapProblem(self.chains, noisy)
        self.problem.settle_noise(self.problem.start)

    def _lamp(self, n_frames):
        # drift in the logarithm: higher orders fall as one over the degree
        x = np.linspace(-1, 1, n_frames)
        drift = np.polynomial.legendre.legval(x, [0, *self.rng.normal(0, 1, 3) / (1, 2, 3)])
        flicker = self.rng.normal(0, self.rng.uniform(0, 2 * self.setup.flicker), n_frames)
        return np.exp(self.rng.uniform(0, 2 * self.setup.drift) * drift + flicker)

    def fluxes(self, chain, clean, positions=()):
        """Return the fluxes of both beams for unit lamps, (2, W, F)."""
        given = {leaf.stage: clean.position(leaf.stage) for leaf in leaves(chain) if leaf.stage}
        sweep = Propagator(chain, self.context.wavelength, given | dict(positions)).forward()
        return np.stack(sweep.fluxes)

    def expose(self, planted):
        """Return the fluxes of all datasets with the effects, and the chains that gave them."""
        chains, bend = [chain.copy() for chain in self.chains], None
        for one in planted:
            if isinstance(one.draw, _Unlisted):
                bend = one
                continue
            chains = one.draw.chains(chains, one.size)
        if bend is not None:
            return bend.draw.fluxes(self, bend.size), chains
        return [self.fluxes(c, o) for c, o in zip(chains, self.clean, strict=True)], chains

    def record(self, fluxes):
        """Return observations with photon noise."""
        found = []
        for clean, ideal, one in zip(self.clean, self.chains, fluxes, strict=True):
            # what a unit lamp does not explain is the brightness, (W, F)
            lamp = (clean.flux_right + clean.flux_left).T / self.fluxes(ideal, clean).sum(axis=0)
            table = clean.to_table()
            for beam, flux in zip(("right", "left"), (one * lamp).clip(0.0), strict=True):
                # rows are frame by frame
                electrons = flux.T.ravel()
                read = self.setup.read_noise
                drawn = self.rng.poisson(electrons) + self.rng.normal(0, read, electrons.shape)
                table[f"flux_{beam}"] = drawn * u.adu
                table[f"flux_{beam}_err"] = np.sqrt(electrons + read**2) * u.adu
            found.append(Observations.from_table(table, name=clean.name))
        return found

    def signal(self, planted):
        """Return the nominal model fitted to noiseless data with an effect."""
        for channel, flux in zip(self.problem.channels, self.expose([planted])[0], strict=True):
            lit = np.maximum(flux, 1e-9)
            # noiseless data in the place of the noisy ones; their noise stays, so that chi-square
            # is SNR squared
            channel.observed = Channels.predicted(SimpleNamespace(fluxes=lit))
        return Model(self.problem, self.problem.fit(self.problem.start))

    def shares(self, model, degree="default"):
        """Return the share of the chi-square that each effect of the library explains."""
        smooth = [effect for effect in EFFECTS.values() if effect.kind != "discrete"]
        context, found = replace(model.context, degree=degree), {}
        for score in scan(model, smooth, context=context):
            share = score.statistic / model.fit.chi2
            if share > _REFIT_FROM:
                share = 1 - model.with_effect(score.effect, context).fit.chi2 / model.fit.chi2
            found[score.effect.name] = round(float(share), 4)
        return found

    def best_shares(self, model):
        """Return the larger share of each effect, with its usual law and without a law."""
        stiff, free = self.shares(model), self.shares(model, None)
        names = stiff.keys() | free.keys()
        return {name: max(stiff.get(name, 0.0), free.get(name, 0.0)) for name in names}


def _varied(chains, wavelength, rng):
    """Return the chains with other values of all free parameters, the same in all chains."""
    known = {}
    for chain in chains:
        for leaf in leaves(chain):
            for key in leaf.param_names:
                if not getattr(leaf, key).fixed:
                    name = f"{leaf.name}.{key}"
                    if name not in known:
                        known[name] = _vary(leaf, key, wavelength, rng, known)
                    setattr(leaf, key, known[name])
    return chains


def _vary(leaf, key, wavelength, rng, known):
    parameter = getattr(leaf, key)
    unit = u.dimensionless_unscaled if parameter.unit is None else parameter.unit
    value = np.array(parameter.value, dtype=float)
    if unit.is_equivalent(u.m):
        # two layers that compensate each other are cut together
        common = known.setdefault(f"{leaf.name} thickness", rng.normal(0, 0.01))
        return value * (1 + common + rng.normal(0, 5e-4)) * unit
    angle = unit.is_equivalent(u.deg)
    if not value.ndim:
        return (value * unit) + (rng.normal(0, 0.3) * u.deg if angle else rng.normal(0, 0.003))
    # smooth in wavelength, and a little that is not, so that a stiff law alone does not fit
    law = law_basis(wavelength, 2) @ (rng.normal(0, 1, 3) / (1, 2, 3))
    law = law + rng.normal(0, 0.2, value.shape)
    new = value * unit + (2 * u.deg if angle else 0.005) * law
    low, high = (
        np.inf * s if b is None else b for s, b in zip((-1, 1), parameter.bounds, strict=True)
    )
    # a truth at its bound could be fitted from one side only
    margin = 0.0 if angle else 0.002
    return np.clip(new.to_value(unit), low + margin, high - margin) * unit


# ---- effects of random size --------------------------------------------------------------------


class _Drawn:
    """An effect of the library with random laws, to be scaled."""

    def __init__(self, effect, bench):
        self.effect, self.context = effect, bench.context
        rng = bench.rng
        edit = effect.edit([chain.copy() for chain in bench.chains], self.context)
        self.laws = {p.name: _law(p, _size(edit.chains, p.name), rng) for p in edit.parameters}
        #: Values at which the effect is absent: a law says by how much they are left.
        self.absent = {p.name: p.canonical_neutral for p in edit.parameters}
        sizes = [p.canonical_limit / np.abs(self.laws[p.name]).max() for p in edit.parameters]
        #: The largest size within the effect's limits.
        self.largest = 0.9 * min(sizes) if sizes else 1.0

    def chains(self, chains, size):
        """Return the chains with the effect at a size."""
        edit = self.effect.edit(chains, self.context)
        for name, value in self.values(size).items():
            _put(edit.chains, name, value)
            for target, tie in edit.ties.items():
                if tie.source == name:
                    _put(edit.chains, target, tie.factor * value)
        return edit.chains

    def values(self, size):
        """Return the canonical values of the parameters at a size."""
        return {name: self.absent[name] + size * law for name, law in self.laws.items()}


def _law(parameter, n, rng):
    """Return a random law, in canonical units and of the parameter's usual size."""
    scale = parameter.canonical_scale
    if n == 1:
        return scale * rng.normal()
    k = n if parameter.basis is None else parameter.basis.shape[1]
    # an effect that is free at each wavelength is tried where it is sharp
    if n == k and k > 3:
        # a resonance anywhere
        at, width = rng.uniform(0, n), rng.uniform(0.5, 0.3 * n)
        return scale * rng.normal() / (1 + ((np.arange(n) - at) / width) ** 2)
    basis = np.eye(n) if parameter.basis is None else parameter.basis
    law = basis @ (rng.normal(0, 1, k) / (1 + np.arange(k)))
    if parameter.is_retained:
        # no optic gives more polarization than there is
        law = -(law - law.min() + 0.3 * (np.ptp(law) + 0.1))
    return scale * law


def _carriers(chains, name):
    """Return the optics that have a parameter, and its key."""
    optic, key = name.split(".")
    return [leaf for chain in chains for leaf in leaves(chain) if leaf.name == optic], key


def _size(chains, name):
    found, key = _carriers(chains, name)
    return np.size(getattr(found[0], key).value)


def _put(chains, name, value):
    found, key = _carriers(chains, name)
    for leaf in found:
        parameter = getattr(leaf, key)
        unit = 1 if parameter.unit is None else parameter.unit
        factor = 1.0 if parameter.unit is None else canonical_factor(unit)
        setattr(leaf, key, np.broadcast_to(value / factor, parameter.shape) * unit)


class _Unlisted:
    """An effect that no physical library holds: a pattern in the order of the frames."""

    names = ("hysteresis", "jitter", "beam_flicker", "polarization_flicker")
    largest = 500.0

    def __init__(self, name, bench):
        self.name = name
        self.noise = [bench.rng.normal(0, 1, o.n_frames) for o in bench.clean]

    def fluxes(self, bench, size):
        """Return the fluxes of all datasets."""
        found = []
        for chain, clean, noise in zip(bench.chains, bench.clean, self.noise, strict=True):
            moved, gain = self._pattern(clean, noise, size)
            ideal = bench.fluxes(chain, clean, moved)
            found.append(ideal * np.stack([1 + gain, 1 - gain])[:, None, :])
        return found

    def _pattern(self, clean, noise, size):
        plate, turn = clean.position("hwp"), clean.position("derotator")
        # size 1 turns a stage by 0.05 deg, or changes a gain by 0.1 percent
        angle, still = size * np.deg2rad(0.05), np.zeros(len(plate))
        if self.name == "hysteresis":
            # backlash has the sign of the motion; its random size keeps it out of every harmonic
            way = np.sign(np.diff(plate, prepend=plate[0]))
            return {"hwp": plate + angle * way * np.abs(noise)}, still
        if self.name == "jitter":
            return {"hwp": plate + angle * noise}, still
        if self.name == "beam_flicker":
            return {}, 1e-3 * size * noise
        return {"derotator": turn + angle * noise}, still


def plant(bench, kind, name, snr):
    """Return the effects of a challenge, at their sizes."""
    if kind == "pair":
        return _pair(bench, name, snr)
    for _ in range(_TRIES):
        one = _candidate(bench, kind, name)
        if one is None:
            break
        model = _scale(bench, one, kind, snr)
        if _fits(bench, one, model, kind, snr):
            return [one]
    what = kind if name is None else f"{kind} with {name!r}"
    raise GapError(f"no effect found for a challenge of kind {what}")


def _candidate(bench, kind, name):
    if kind == "unlisted":
        chosen = str(bench.rng.choice(_Unlisted.names)) if name is None else name
        if chosen not in _Unlisted.names:
            raise GapError(f"no unlisted effect {chosen!r}; there are {_Unlisted.names}")
        return _Planted(f"unlisted_{chosen}", _Unlisted(chosen, bench))
    fitting = [
        effect
        for effect in (EFFECTS.values() if name is None else [get_effect(name)])
        if effect.kind != "discrete" and effect.applies(bench.chains)
    ]
    if not fitting:
        return None
    effect = fitting[bench.rng.integers(len(fitting))]
    return _Planted(effect.name, _Drawn(effect, bench))


def _scale(bench, one, kind, snr):
    """Scale an effect until it stands out by this much; return the model without it."""
    model = bench.signal(one)
    one.snr = float(np.sqrt(model.fit.chi2))
    if kind == "absorbed":
        return model
    # the SNR is nearly proportional to the size: a few steps reach two percent
    for _ in range(8):
        if one.snr <= 0 or abs(one.snr / snr - 1) < 0.02:
            break
        # a step too far may reach another branch of the nominal model
        wanted = min(one.size * np.clip(snr / one.snr, 0.02, 20), one.draw.largest)
        if wanted == one.size:
            break
        one.size = wanted
        model = bench.signal(one)
        one.snr = float(np.sqrt(model.fit.chi2))
    return model


def _fits(bench, one, model, kind, snr):
    """Fill in what the effect amounts to; return whether it is of the kind."""
    if kind != "unlisted":
        one.values = one.draw.values(one.size)
    if kind == "absorbed":
        return one.snr < _INVISIBLE
    dark = min(flux.min() for flux in bench.expose([one])[0]) <= 0
    if not _WEAKEST <= one.snr < 1.1 * snr or dark or not model.fit.converged:
        return False
    # what is to stay unexplained must not be explained by an effect that the selection frees
    unknown = kind in ("unlisted", "withheld")
    one.shares = bench.best_shares(model) if unknown else bench.shares(model)
    # where it does not explain itself, the nominal model went to another branch
    if kind != "unlisted" and one.shares.get(one.name, 0.0) < ENOUGH:
        return False
    if kind == "single":
        return True
    others = [
        share
        for name, share in one.shares.items()
        if kind == "unlisted" or (name != one.name and share < ENOUGH)
    ]
    return max(others, default=0.0) < UNKNOWN


def _pair(bench, name, snr):
    """Return two effects that the data can tell from each other."""
    for _ in range(_TRIES):
        first = plant(bench, "single", name, snr)[0]
        second = plant(bench, "single", None, snr)[0]
        apart = first.shares.get(second.name, 0) < 0.5 and second.shares.get(first.name, 0) < 0.5
        if first.name != second.name and apart and min(first.snr, second.snr) > 0.7 * snr:
            return [first, second]
    raise GapError("no two effects found that can be told from each other")
