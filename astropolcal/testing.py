# Licensed under a 3-clause BSD style license - see LICENSE
"""
Whether an instrument does what the rest of the package relies on, and a calibration for examples.

`check_instrument` takes any instrument, also one of another package, which can run it in its
own tests.
"""

import inspect
import io
import re
import warnings
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.calibration import calibrate
from astropolcal.chain import leaves, stages, states_of, system_mueller, with_beam
from astropolcal.exceptions import AstropolcalError, InstrumentError
from astropolcal.instruments import Instrument
from astropolcal.measurement import Measurement
from astropolcal.measurement.parameters import limits
from astropolcal.mueller import is_physical
from astropolcal.observations.grid import is_star
from astropolcal.optics import COORDINATES, LinearPolarizer, Optic, PolarizedSource, StateAnalyser
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.units import check_seed
from astropolcal.words import check_choice

__all__ = ["check_instrument", "example_calibration"]

# standard deviation by which the true values of free parameters are moved: in radian or 1,
# and of other dimensions the share of them
_MOVED, _MOVED_SHARE = 0.005, 0.0005


class Broken(Exception):
    """A rule does not hold."""


class Absent(Exception):
    """A rule has nothing to be applied to."""


def require(condition, words):
    """Raise if a rule does not hold."""
    if not condition:
        raise Broken(words)


def optic_names(chain):
    """Return the names of the optics of a chain."""
    return [leaf.name for leaf in leaves(chain)]


def check_values(label, chain, size):
    """Require values that are finite, within their bounds and as many as the wavelengths."""
    for leaf in leaves(chain):
        for key in leaf.param_names:
            name, value = f"{label}: {leaf.name}.{key}", np.asarray(getattr(leaf, key).value)
            low, high = limits(getattr(leaf, key).bounds)
            good = np.isfinite(value) & (value >= low) & (value <= high)
            outside = f"{name} = {value[~good]} is outside of its bounds, {low} to {high}"
            require(good.all(), outside)
            words = f"{name} has {value.size} values; allowed are 1 or {size}"
            require(value.size in (1, size), words)


def read_back(chain):
    """Return a chain after it was written to an ASDF file."""
    import asdf

    from astropolcal.converters.nodes import node_from_priors, restore_priors, without_priors

    buffer = io.BytesIO()
    # a calibration file has priors beside the chains
    content = {"chain": without_priors(chain), "priors": node_from_priors([chain])}
    asdf.AsdfFile(content).write_to(buffer)
    buffer.seek(0)
    with asdf.config_context() as config:
        config.warn_on_failed_conversion = False
        with asdf.open(buffer, lazy_load=False, memmap=False) as file:
            read = file["chain"]
            restore_priors([read], file["priors"])
    return read


# optics behind which nothing is left of what polarization the light had
_LIGHTS = (LinearPolarizer, PolarizedSource)
# what tells polarization where no optic splits the light
_ANALYSERS = (LinearPolarizer, StateAnalyser)
# columns that every table may have
_COLUMNS = ("hwp", "derotator", "parallactic", "altitude", "flc_state")
_CYCLE = np.array([0, 45, 22.5, 67.5, 11.25, 56.25, 33.75, 78.75])
# rms of the predicted double differences
_LARGEST_ERROR = 1e-3


class Probe:
    """The rules, each a method that raises where it does not hold."""

    def __init__(self, instrument, seed):
        self.instrument, self.seed = instrument, seed
        self.rng = np.random.default_rng(seed)
        default = inspect.signature(instrument.chain).parameters.get("source")
        own = None if default is None else default.default
        # one that tells no sources has the one that its chain takes by default
        self.sources = tuple(instrument.sources or (own,))

    # ---- what it says of itself

    def check_class(self):
        """It is an Instrument, its name is one word, and it answers to name and aliases."""
        instrument = self.instrument
        name = instrument.name
        require(isinstance(name, str) and name.strip(), "it has no name")
        require(len(name.split()) == 1, f"name = {name!r} has blanks; the command line has none")
        aliases = instrument.aliases
        require(not isinstance(aliases, str), f"aliases = {aliases!r}; a tuple of texts is needed")
        for spelled in (name, name.upper(), *aliases):
            require(instrument.answers_to(spelled), f"it does not answer to {spelled!r}")

    def check_documentation(self):
        """Its class has a docstring, and references say where the values are from."""
        cls, references = type(self.instrument), self.instrument.references
        require((cls.__dict__.get("__doc__") or "").strip(), f"class {cls.__name__}: no docstring")
        words = f"references = {references!r}; a tuple of at least one text is needed"
        require(not isinstance(references, str) and len(references) > 0, words)
        require(all(str(text).strip() for text in references), "one of its references is empty")

    def check_wavelengths(self):
        """They are lengths, each positive, finite and another."""
        grid = self.grid
        require(grid.ndim == 1 and grid.size > 0, f"wavelength has shape {grid.shape}; (n,) is it")
        values = grid.to_value(u.um)
        good = np.isfinite(values) & (values > 0)
        require(good.all(), f"wavelength = {grid[~good]} must be positive and finite")
        require(len(set(values)) == values.size, "wavelength: one of them occurs twice")

    @property
    def grid(self):
        grid = self.instrument.wavelength
        require(isinstance(grid, u.Quantity), f"wavelength = {grid!r}; a Quantity is needed")
        require(grid.unit.is_equivalent(u.m), f"wavelength is in {grid.unit}; a length is needed")
        return grid

    @property
    def few(self):
        """At most three of the wavelengths."""
        return self.grid[np.unique(np.linspace(0, self.grid.size - 1, 3).round().astype(int))]

    # ---- chains

    def chains(self, grid=None):
        """Yield source and chain."""
        for source in self.sources:
            yield source, self.instrument.chain(source, (), wavelength=grid)

    def check_sources(self):
        """A chain is built for each of its sources, and an unknown source is refused."""
        for source, chain in self.chains():
            for leaf in leaves(chain):
                require(isinstance(leaf, Optic), f"{source}: {leaf!r} is not an Optic")
        try:
            self.instrument.chain("no such source")
        except AstropolcalError:
            return
        require(
            len(self.sources) == 1 and not self.instrument.sources,
            "its chain takes the source 'no such source'; InstrumentError is expected",
        )

    def check_names(self):
        """Every optic has a name of its own, and at most one of them splits the light."""
        for source, chain in self.chains():
            found = optic_names(chain)
            require(all(found), f"{source}: an optic has no name: {found}")
            odd = [name for name in found if not name.replace("-", "_").isidentifier()]
            require(not odd, f"{source}: {odd} cannot be used as optic.parameter")
            splitters = [leaf.name for leaf in leaves(chain) if leaf.splits_light]
            require(len(splitters) < 2, f"{source}: one optic may split the light, not {splitters}")
            analysers = [o for o in leaves(chain)[1:] if isinstance(o, _ANALYSERS)]
            require(
                splitters or analysers, f"{source}: one optic must split the light, or analyse it"
            )

    def check_bounds(self):
        """Starting values are finite, within their bounds and as many as the wavelengths."""
        for grid in (None, self.few):
            size = self.grid.size if grid is None else grid.size
            for source, chain in self.chains(grid):
                check_values(source, chain, size)

    def check_physical(self):
        """Every optic is physical, at random positions, and so is the whole."""
        for source, chain in self.chains(self.few):
            self._check_physical(source, chain, self.few)

    def _check_physical(self, label, chain, grid):
        for leaf in leaves(chain):
            matrix = system_mueller(leaf, grid, self._positions(leaf))
            require(np.all(is_physical(matrix)), f"{label}: {leaf.name} is not physical")
        beams = {"beam": chain}
        if any(leaf.splits_light for leaf in leaves(chain)):
            beams = {f"{beam} beam": with_beam(chain, beam) for beam in ("right", "left")}
        for beam, one in beams.items():
            whole = system_mueller(one, grid, self._positions(chain))
            require(np.all(is_physical(whole)), f"{label}: the {beam} is not physical")

    def _positions(self, chain, n=16):
        draws = {stage: self.rng.uniform(0.1, 1, n) for stage in stages(chain)}
        # a star is above the horizon
        units = {stage: (90 if stage == "altitude" else 180) * u.deg for stage in draws}
        return {s: x * (u.one if s in COORDINATES else units[s]) for s, x in draws.items()}

    def check_on_sky(self):
        """A chain from the sky starts with the telescope, and nothing of the source is in it."""
        if not self.instrument.has_telescope:
            raise Absent("it has no telescope of known values")
        internal = [(s, chain) for s, chain in self.chains() if not is_star(s)]
        if not internal:
            raise Absent("it has no internal source")
        for source, chain in internal:
            sky = self.instrument.on_sky(chain)
            found, inner, names = leaves(sky), leaves(chain), optic_names(sky)
            # what a lamp meets before anything turns belongs to the lamp
            first = next((i for i, leaf in enumerate(inner) if leaf.stage), len(inner))
            if self.instrument.entrance in (own := [leaf.name for leaf in inner]):
                first = own.index(self.instrument.entrance)
            left = ", ".join(leaf.name for leaf in inner[:first] if leaf.name in names)
            require(not left, f"{source}: {left} of the source would be upstream of a star")
            kept = [leaf.name for leaf in inner[first:]]
            lights = [o.name for o in found if isinstance(o, _LIGHTS) and o.name not in kept]
            words = f"{source}: {', '.join(lights)} would hide the polarization of a star"
            require(not lights, words)
            words = f"on sky there are {', '.join(names)}; the last must be {', '.join(kept)}"
            require(names[-len(kept) :] == kept, f"{source}: {words}")
            front = {leaf.stage for leaf in found[: len(found) - len(kept)]}
            words = f"no optic upstream of {kept[0]} stands on the stage parallactic"
            require("parallactic" in front, f"{source}: {words}")
            again = optic_names(self.instrument.on_sky(sky))
            require(again == names, f"{source}: a chain from the sky gets another telescope")

    # ---- tables and headers

    def check_mounts(self):
        """The position of every stage is a column of tables, or comes from a keyword."""
        layout = self.instrument.files or self.instrument.headers
        known = {*_COLUMNS, *self.instrument.keywords, *(layout.keywords if layout else ())}
        for source, chain in self.chains():
            angles = [s for s in stages(chain) if s not in COORDINATES]
            lost = ", ".join(s for s in angles if s not in known)
            words = f"the stage {lost} is not a column of tables and in no keyword; known are "
            require(not lost, f"{source}: {words}{', '.join(sorted(known))}")
            placed = not is_star(source) or self.instrument.location is not None or not angles
            require(placed, f"{source}: a star needs the site of the telescope")

    def check_headers(self):
        """Keywords are those of FITS, differ, and are the same in the file layout."""
        keywords = self.instrument.keywords
        layout = self.instrument.files or self.instrument.headers
        if not keywords and layout is None:
            raise Absent("it has no keywords")
        every = dict(keywords) | (dict(layout.keywords) if layout else {})
        for column, keyword in keywords.items():
            inside = every[column]
            require(inside == keyword, f"{column} is {keyword} here, {inside} in its file layout")
        seen = {}
        for column, keyword in every.items():
            require(isinstance(keyword, str) and keyword.strip(), f"{column}: keyword {keyword!r}")
            # a keyword of several words is a hierarchical one
            words = keyword.split(" ")
            known = all(re.fullmatch("[A-Z0-9_-]*[A-Z0-9][A-Z0-9_-]*", word) for word in words)
            short = len(keyword) <= 8 or len(words) > 1
            require(known and short, f"{column}: {keyword!r} is not a FITS keyword")
            require(keyword not in seen, f"{seen.get(keyword)} and {column} are both {keyword}")
            seen[keyword] = column

    def check_setup(self):
        """A table is given source and optics of its chain, and a strange one is refused."""
        for source, chain in self.chains(self.few):
            observations = self._observe(chain, source)
            told, present = self.instrument.setup(observations)
            require(told == source, f"a table of source {source!r} is set up as {told!r}")
            (built,) = self.instrument.chains_for([observations])
            lost = set(optic_names(chain)) - set(optic_names(built))
            # the source optic may have the name of the star
            require(len(lost) <= 1, f"{source}: its table's chain lacks {', '.join(sorted(lost))}")
            require(
                all(name in optic_names(built) for name in present),
                f"{source}: setup says {present} is in the beam, the chain lacks it",
            )
        # the table of the last source will do
        observations.meta["instrument"] = "another polarimeter"
        try:
            self.instrument.check(observations)
        except AstropolcalError:
            return
        raise Broken("a table of 'another polarimeter' is not refused")

    def check_published(self):
        """Published values are within their bounds and physical, and their meta fit."""
        try:
            chain = self.instrument.published()
        except InstrumentError as none:
            raise Absent(str(none)) from None
        check_values("published", chain, self.grid.size)
        self._check_physical("published", chain, self.grid)
        meta = self.instrument.published_meta()
        observations = self._observe(chain, meta.get("source", self.sources[0]), self.grid)
        (built,) = self.instrument.chains_for([observations])
        require(
            optic_names(built) == optic_names(chain),
            f"published_meta lead to {optic_names(built)}, published to {optic_names(chain)}",
        )

    def check_round_trip(self):
        """Every chain is the same after an ASDF file."""
        for source, chain in self.chains():
            read = read_back(chain)
            names = optic_names(read)
            require(names == optic_names(chain), f"{source}: read as {names}")
            for old, new in zip(leaves(chain), leaves(read), strict=True):
                require(type(old) is type(new), f"{source}: {old.name} is a {type(new).__name__}")
                require(old.mount == new.mount, f"{source}: {old.name} is on {new.mount}")
                for key in old.param_names:
                    was, now = getattr(old, key), getattr(new, key)
                    name = f"{source}: {old.name}.{key} after a file"
                    same = np.array_equal(was.value, now.value)
                    require(same, f"{name} is {now.value}, not {was.value}")
                    for what in ("unit", "bounds", "fixed"):
                        before, after = getattr(was, what), getattr(now, what)
                        require(before == after, f"{name}: {what} {after}, not {before}")
                    both = (was.prior is None) == (now.prior is None)
                    require(both, f"{name}: its prior is {now.prior}")

    # ---- observing

    def check_predicts(self):
        """Both beams change with the modulator, and positions are those of the frames."""
        largest = 0.0
        for source, chain in self.chains(self.few):
            observations = self._observe(chain, source, noise=False)
            positions = [self.instrument.positions(observations, chain)]
            measurement = Measurement(chain, observations, positions=positions)
            off = np.abs(measurement.residuals()).max()
            require(
                off < 1e-9,
                f"{source}: double differences are off by {off:.2g} from those of the frames; "
                "do stages stand where its positions say?",
            )
            left = 1.0 if observations.single_beam else observations.flux_left
            ratio = observations.flux_right / left
            # an unpolarized lamp may give the same in all frames; one source that varies is enough
            largest = max(largest, float(np.ptp(ratio) / np.mean(ratio)))
        require(largest > 1e-6, "no source gives fluxes that change with the modulator")

    def check_calibrates(self):
        """A calibration of simulated frames predicts frames that it did not see."""
        from astropolcal.calibration import calibrate

        # a lamp needs no pointing, so that less can go wrong that is not of the chain
        internal = [source for source in self.sources if not is_star(source)]
        source = (internal or self.sources)[0]
        start = self.instrument.chain(source, (), wavelength=self.few)
        if not any(not getattr(o, k).fixed for o in leaves(start) for k in o.param_names):
            raise Absent("no parameter is free")
        # the optics that the tables of its published chain say are in the beam
        chains = self.instrument.chains_for([self._observe(start, source)])
        truth = self._moved(chains[0])
        seen = self._observe(truth, source)
        positions = [self.instrument.positions(seen, chains[0])]
        found = calibrate(chains, [seen], positions=positions, cross_validate=False)
        # at angles of the derotator 7 deg from those of the fit, without noise of their own
        unseen = self._observe(truth, source, shift=7.0, noise=False)
        placed = [self.instrument.positions(unseen, truth)]
        residuals = Measurement(found.chains, [unseen], positions=placed).residuals()
        rms = np.sqrt(np.mean(residuals**2))
        require(
            rms < _LARGEST_ERROR,
            f"{source}: calibrated with simulated frames, it predicts others to {rms:.2g} rms; "
            f"up to {_LARGEST_ERROR:g} is allowed",
        )

    def _moved(self, chain):
        """Return the chain with its free parameters moved a little, within their bounds."""
        chain, rng = chain.copy(), np.random.default_rng(self.seed)
        for leaf in leaves(chain):
            for key in (k for k in leaf.param_names if not getattr(leaf, k).fixed):
                parameter = getattr(leaf, key)
                low, high = limits(parameter.bounds)
                value, unit = np.asarray(parameter.value, dtype=float), parameter.unit or u.one
                step = rng.normal(size=value.shape)
                if unit.is_equivalent(u.rad):
                    step = (_MOVED * step * u.rad).to_value(unit)
                else:
                    step = step * (_MOVED if unit == u.one else _MOVED_SHARE * np.abs(value))
                # at a bound the other way, so that every free parameter moves
                outside = (value + step < low) | (value + step > high)
                moved = np.where(outside, value - step, value + step)
                setattr(leaf, key, moved.clip(low, high) * unit)
        return chain

    def _observe(self, chain, source, grid=None, *, shift=0.0, noise=True):
        """Return simulated frames of a source, with everything that stands on a stage."""
        meta = {"instrument": self.instrument.name, "date": "2020-01-01"}
        meta |= self.instrument.published_meta() | {"source": source}
        frames = self._frames(chain, shift)
        if "flc_state" in (*stages(chain), meta.get("pairing")):
            # both states of a modulator at every position
            frames = frames[np.repeat(np.arange(len(frames)), 2)]
            frames["flc_state"] = np.tile([0, 1], len(frames) // 2)
        for column, states in states_of(chain).items():
            # every state of a device at every position; of beams there are all at once
            if column != "beam":
                frames = frames[np.repeat(np.arange(len(frames)), len(states))]
                frames[column] = np.tile(states, len(frames) // len(states))
        settings = {"flux": 1e8, "noise": noise, "seed": self.seed, "meta": meta}
        grid = self.few if grid is None else grid
        return simulate(chain, grid, frames, name=f"simulated {source}", **settings)

    def _frames(self, chain, shift):
        # a derotator that turns by 75 deg sees both of its axes; six cycles are enough for a fit
        n_cycles = 6
        hwp = np.tile(_CYCLE, n_cycles)
        steps = np.linspace(0, 1, n_cycles).repeat(_CYCLE.size)
        frames = QTable({"hwp": hwp * u.deg, "derotator": (20 + shift + 75 * steps) * u.deg})
        known = {"parallactic": -60 + shift + 100 * steps, "altitude": 40 + shift + 30 * steps}
        wanted = {s for s in stages(chain) if s not in COORDINATES} - {"hwp", "derotator"}
        on_sky = bool(wanted & set(known))
        for stage in sorted(wanted | (set(known) if on_sky else set())):
            frames[stage] = known.get(stage, 10 + shift + 60 * steps) * u.deg
        if on_sky:
            # where the plate stands is given, so that any tracking law will do
            frames["hwp_true"] = frames["hwp"] + 33 * u.deg
        return frames


#: Every rule, in the order in which they are checked.
RULES = tuple(
    name.removeprefix("check_").replace("_", " ") for name in vars(Probe) if name[:6] == "check_"
)


@dataclass
class Conformance:
    """
    What `check_instrument` found.

    Attributes
    ----------
    name : str
        Of the instrument.
    passed : list of str
        Rules that hold.
    failed : dict of str to str
        Rule to what is wrong.
    skipped : dict of str to str
        Rule to why it was not checked.

    Examples
    --------
    >>> from astropolcal.testing import Conformance
    >>> report = Conformance("mine", ["class"], {"headers": "twice the same keyword 'HWP'"})
    >>> bool(report)
    False
    >>> print(report)
    mine fails 1 of 2 rules
    - headers: twice the same keyword 'HWP'
    """

    name: str
    passed: list = field(default_factory=list)
    failed: dict = field(default_factory=dict)
    skipped: dict = field(default_factory=dict)

    def __bool__(self):
        return not self.failed

    def __str__(self):
        count = len(self.passed) + len(self.failed)
        words = f"fails {len(self.failed)} of {count}" if self.failed else f"passes {count}"
        lines = [f"{self.name} {words} rules"]
        lines += [f"- {rule}: {what}" for rule, what in self.failed.items()]
        lines += [f"- {rule} not checked: {why}" for rule, why in self.skipped.items()]
        return "\n".join(lines)


def check_instrument(instrument, *, skip=(), seed=0, raises=True):
    """
    Check that an instrument conforms to what calibration, correction and files rely on.

    Parameters
    ----------
    instrument : Instrument or type
        The instrument, or its class; it need not be registered.
    skip : sequence of str
        Rules that are left out, see ``RULES``.
    seed : int
        Of the random positions and of the noise.
    raises : bool
        Whether a rule that fails is an error.

    Returns
    -------
    Conformance
        Rules that hold, fail, or were not checked.

    Raises
    ------
    InstrumentError
        If a rule fails; the message names every one and what is wrong. Or if a rule to
        be skipped is unknown.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.testing import check_instrument
    >>> print(check_instrument(instruments.get("irdis"), skip=["calibrates"]))
    irdis passes 14 rules
    - calibrates not checked: skipped
    """
    for rule in skip:
        check_choice("rule", rule, RULES, InstrumentError)
    if inspect.isabstract(instrument):
        lacking = ", ".join(sorted(instrument.__abstractmethods__))
        raise InstrumentError(f"class: {instrument.__name__} lacks the methods {lacking}")
    if inspect.isclass(instrument):
        instrument = instrument()
    if not isinstance(instrument, Instrument):
        raise InstrumentError(f"class: {instrument!r} is not an Instrument, nor a class of one")
    report = Conformance(instrument.name or type(instrument).__name__)
    probe = Probe(instrument, check_seed(seed))
    for rule in RULES:
        if rule in skip:
            report.skipped[rule] = "skipped"
        elif rule not in ("class", "documentation", "headers") and report.failed.get("sources"):
            report.skipped[rule] = "there are no chains"
        else:
            try:
                # what an instrument warns of is for its users, not a breach of a rule
                with warnings.catch_warnings(action="ignore"):
                    getattr(probe, f"check_{rule.replace(' ', '_')}")()
            except Absent as absent:
                report.skipped[rule] = str(absent)
            except Broken as broken:
                report.failed[rule] = str(broken)
            except Exception as error:  # whatever the code of an instrument raises is a finding
                report.failed[rule] = f"{type(error).__name__}: {error}"
            else:
                report.passed.append(rule)
    if raises and not report:
        raise InstrumentError(str(report))
    return report


def example_calibration(seed=2, **meta):
    """
    Calibrate CHARIS with simulated frames of its internal source, for examples.

    Two cycles of the half-wave plate at each of three angles of the derotator, 50, 65 and 80 deg.

    Parameters
    ----------
    seed : int
        Of the noise.
    **meta
        Of the table, such as ``date``.

    Returns
    -------
    `~astropolcal.calibration.Calibration`

    Examples
    --------
    >>> from astropolcal.testing import example_calibration
    >>> example_calibration(date="2025-10-05")
    <Calibration of charis from simulated: 49 free parameters, rank 49>
    """
    charis = instruments.get("charis")
    chain = charis.chain(derotator="linear")
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    data = simulate(chain, charis.wavelength, frames, seed=seed, meta=meta)
    return calibrate(chain, data, instrument="charis")
