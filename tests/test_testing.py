# Licensed under a 3-clause BSD style license - see LICENSE
"""The conformance test of instruments finds what is wrong, and passes what is right."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter
from scipy.stats import norm

from astropolcal import instruments, optics
from astropolcal.chain import join, leaves
from astropolcal.exceptions import InstrumentError
from astropolcal.instruments import Instrument
from astropolcal.instruments.layout import FileLayout
from astropolcal.observations.pointings import location_of
from astropolcal.testing import RULES, Conformance, check_instrument

GRID = [0.6, 0.7] * u.um


class Sound(Instrument):
    """A polarimeter with a half-wave plate at a telescope without a derotator."""

    name = "sound"
    aliases = ("Observatory/Sound",)
    wavelength = GRID
    keywords = {"hwp": "HWPANG", "parallactic": "PARANG", "altitude": "ALTITUDE"}
    references = ("Author et al. 2020",)
    sources = ("polarized", "star")
    efficiency = 0.97

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        if source not in self.sources:
            raise InstrumentError(f"source = {source!r}; allowed are {', '.join(self.sources)}")
        size = np.size(self.wavelength if wavelength is None else wavelength)
        first = self.first(source)
        return (
            first
            | optics.LinearRetarder(
                retardance=np.full(size, 172.0) * u.deg, mount="hwp", name="hwp"
            )
            | optics.WollastonPrism(efficiency=np.full(size, self.efficiency), name="wollaston")
        )

    def telescope_optics(self, behind):
        return [optics.Rotator(mount="parallactic", name="sky")]

    def first(self, source):
        if source == "polarized":
            return optics.LinearPolarizer(name="polarizer")
        return optics.PolarizedSource(name="star") | optics.Rotator(mount="parallactic", name="sky")

    @property
    def location(self):
        return location_of((-70.0, -30.0, 2000.0))

    def setup(self, observations):
        return observations.source, ()


class Leaky(optics.Optic):
    """An optic that no converter knows."""

    leak = Parameter(default=0.1, bounds=(0, 1), fixed=True, description="leak")

    def _matrix(self, dispersion, leak):
        return np.eye(4) * (1 - leak)

    def _derivatives(self, dispersion, leak):
        return (-np.eye(4),)


class Amplifier(Leaky):
    """Polarizes more than entirely."""

    def _matrix(self, dispersion, leak):
        return np.diag([1.0, 1.2, 1.2, 1.0])


def variant(**members):
    """Return a sound instrument with some things exchanged."""
    return type("Variant", (Sound,), {"__doc__": "A variant."} | members)


def behind(optic):
    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        return Sound.chain(self, source, optics_in, wavelength=wavelength) | optic

    return chain


def _turns(stage):
    return optics.Rotator(mount=stage, name="turns")


def _accepts_all(self, source="polarized", optics_in=(), *, wavelength=None):
    known = source if source in self.sources else "polarized"
    return Sound.chain(self, known, optics_in, wavelength=wavelength)


def _off_by_45(self, observations, chain, **exposure):
    found = Instrument.positions(self, observations, chain, **exposure)
    return found | {"hwp": found["hwp"] + np.pi / 8}


def _out_of_bounds(self):
    chain = self.chain()
    chain["wollaston"].efficiency = [0.9, 1.3]
    return chain


def _sky(*front, drop=1, last=None):
    """Return an ``on_sky`` that puts optics before those of the internal chain."""

    def on_sky(self, chain):
        return join([*front, *leaves(chain)[drop:last]])

    return {"on_sky": on_sky}


def _again(self, chain):
    """Return the chain behind one more mirror each time."""
    found = leaves(chain)
    more = optics.ParityFlip(name=f"flip{len(found)}")
    return join([_turns("parallactic"), more, *found[1 if len(found) == 3 else 2 :]])


def _without_splitter(self, source="polarized", optics_in=(), *, wavelength=None):
    return join(leaves(Sound.chain(self, source, optics_in, wavelength=wavelength))[:-1])


def _five_values(self, source="polarized", optics_in=(), *, wavelength=None):
    flat = optics.Depolarizer(retained_q=np.full(5, 0.9), name="flat")
    return Sound.chain(self, source, optics_in, wavelength=wavelength) | flat


def _layout(**keywords):
    return FileLayout(keywords=keywords, shape=(2, 10, 10))


BROKEN = {
    "no name": ({"name": ""}, "class", "no name"),
    "blank": ({"name": "two words"}, "class", "'two words' has blanks"),
    "alias": ({"aliases": "SND"}, "class", "a tuple of texts"),
    "deaf": ({"answers_to": lambda self, name: False}, "class", "does not answer to 'sound'"),
    "docstring": ({"__doc__": None}, "documentation", "no docstring"),
    "references": ({"references": ()}, "documentation", "at least one"),
    "one text": ({"references": "Author 2020"}, "documentation", "a tuple of at least one text"),
    "empty text": ({"references": ("A", " ")}, "documentation", "one of its references is empty"),
    "scalar": ({"wavelength": 0.6 * u.um}, "wavelengths", r"has shape \(\); \(n,\) is it"),
    "not finite": ({"wavelength": [0.6, np.nan] * u.um}, "wavelengths", "must be positive and fin"),
    "no unit": ({"wavelength": np.array([0.6])}, "wavelengths", "a Quantity is needed"),
    "frequency": ({"wavelength": [1, 2] * u.Hz}, "wavelengths", "a length is needed"),
    "twice": ({"wavelength": [0.6, 0.6] * u.um}, "wavelengths", "occurs twice"),
    "negative": ({"wavelength": [-0.6, 0.6] * u.um}, "wavelengths", "must be positive"),
    "any source": ({"chain": _accepts_all}, "sources", "takes the source 'no such source'"),
    "nameless": ({"chain": behind(optics.ParityFlip())}, "names", "has no name"),
    "same name": ({"chain": behind(optics.ParityFlip(name="hwp"))}, "sources", "more than once"),
    "dotted": ({"chain": behind(optics.ParityFlip(name="a.b"))}, "names", "cannot be used"),
    "two splitters": (
        {"chain": behind(optics.WollastonPrism(name="second"))}, "names", "one optic may split",
    ),
    "no beams": ({"chain": _without_splitter}, "names", "must split the light, or analyse it"),
    "five values": ({"chain": _five_values}, "bounds", "flat.retained_q has 5 values; allowed"),
    "bounds": ({"efficiency": 1.2}, "bounds", "wollaston.efficiency = .* outside of its bounds"),
    "unphysical": ({"chain": behind(Amplifier(name="amp"))}, "physical", "amp is not physical"),
    "polarizer on sky": (_sky(_turns("parallactic"), drop=0), "on sky", "polarizer of the source"),
    "lamp on sky": (
        _sky(_turns("parallactic"), optics.PolarizedSource(name="lamp")), "on sky", "would hide",
    ),
    "no telescope": (_sky(), "on sky", "no optic upstream of hwp stands on the stage parallactic"),
    "altitude only": (_sky(_turns("-altitude")), "on sky", "stands on the stage parallactic"),
    "no plate": (_sky(_turns("parallactic"), drop=2), "on sky", "the last must be hwp, wollaston"),
    "no splitter": (_sky(_turns("parallactic"), last=-1), "on sky", "there are turns, hwp; the"),
    "twice on sky": ({"on_sky": _again}, "on sky", "a chain from the sky gets another telescope"),
    "stage": ({"chain": behind(_turns("rotator"))}, "mounts", "not a column .* known are"),
    "no site": ({"location": None}, "mounts", "site of the telescope"),
    "lower case": ({"keywords": {"hwp": "hwpang"}}, "headers", "'hwpang' is not a FITS keyword"),
    "long": ({"keywords": {"hwp": "HWPANGLEX"}}, "headers", "is not a FITS keyword"),
    "shared": ({"keywords": {"hwp": "ANG", "derotator": "ANG"}}, "headers", "hwp and derotator"),
    "layout": ({"files": _layout(hwp="HWP")}, "headers", "HWPANG here, HWP in its file layout"),
    "no keyword": ({"keywords": {"hwp": " "}}, "headers", "hwp: keyword ' '"),
    "not in the chain": (
        {"setup": lambda self, obs: (obs.source, ("window",))}, "setup", "the chain lacks it",
    ),
    "other optics": (
        {"chains_for": lambda self, tables: [join(leaves(self.chain())[2:])]},
        "setup", "its table's chain lacks hwp, polarizer",
    ),
    "setup": ({"setup": lambda self, obs: ("star", ())}, "setup", "is set up as 'star'"),
    "greedy": ({"check": lambda self, obs: None}, "setup", "is not refused"),
    "published": ({"published": _out_of_bounds}, "published", "published: wollaston.efficiency"),
    "other meta": (
        {"published": lambda self: self.chain(), "published_meta": lambda self: {"source": "star"}},
        "published", "published_meta lead to .*'star'.*, published to .*'polarizer'",
    ),
    "unphysical values": (
        {"published": lambda self: self.chain() | Amplifier(name="amp")}, "published", "amp is not",
    ),
    "still": ({"efficiency": 0.0}, "predicts", "no source gives fluxes that change with the mod"),
    "file": ({"chain": behind(Leaky(name="leaky"))}, "round trip", "Leaky"),
    "angles": ({"positions": _off_by_45}, "predicts", "do stages stand where its positions say"),
}  # fmt: skip


@pytest.mark.slow
def test_sound_instrument_passes_every_rule():
    report = check_instrument(Sound)
    assert report
    assert not report.failed
    # it publishes nothing
    assert set(report.skipped) == {"published"}
    assert {*report.passed, "published"} == set(RULES)
    assert str(report).splitlines()[0] == f"sound passes {len(RULES) - 1} rules"


def test_each_rule_finds_what_breaks_it():
    for case in BROKEN:
        members, rule, words = BROKEN[case]
        others = [other for other in RULES if other not in (rule, "sources")]
        with pytest.raises(InstrumentError, match=rf"- {rule}: .*{words}"):
            check_instrument(variant(**members), skip=others)


def _guess(value):
    return 0.0


def _with_prior(prior):
    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        made = Sound.chain(self, source, optics_in, wavelength=wavelength)
        made["hwp"].theta.prior = prior
        return made

    return chain


def test_priors_are_kept_in_a_file_or_refused():
    skip = [rule for rule in RULES if rule not in ("sources", "round trip")]
    assert check_instrument(variant(chain=_with_prior(norm(0, 1))), skip=skip)
    with pytest.raises(InstrumentError, match=r"- round trip: .*prior of hwp.theta is a function"):
        check_instrument(variant(chain=_with_prior(_guess)), skip=skip)


def test_every_rule_but_one_has_a_case_that_breaks_it():
    assert set(RULES) - {rule for _, rule, _ in BROKEN.values()} == {"calibrates"}


def test_calibration_that_does_not_recover_is_found(monkeypatch):
    """A result that keeps its start predicts other frames badly."""
    import astropolcal.calibration as module

    class Untouched:
        def __init__(self, chains):
            self.chains = chains

    monkeypatch.setattr(module, "calibrate", lambda chains, *_, **__: Untouched(chains))
    report = check_instrument(Sound, skip=[r for r in RULES if r != "calibrates"], raises=False)
    assert "it predicts others to" in report.failed["calibrates"]


def test_instrument_without_free_parameters_is_not_calibrated():
    def held(self, source="polarized", optics_in=(), *, wavelength=None):
        chain = Sound.chain(self, source, optics_in, wavelength=wavelength)
        for optic in chain:
            for key in optic.param_names:
                getattr(optic, key).fixed = True
        return chain

    report = check_instrument(variant(chain=held))
    assert report.skipped["calibrates"] == "no parameter is free"


def test_failures_are_named_together():
    with pytest.raises(InstrumentError) as caught:
        check_instrument(variant(references=(), aliases="SND"), skip=["calibrates"])
    assert "fails 2 of" in str(caught.value)
    assert "- class:" in str(caught.value)
    assert "- documentation:" in str(caught.value)


def test_exception_of_an_instrument_is_a_finding():
    def chain(self, *arguments, **options):
        raise KeyError("grating")

    report = check_instrument(variant(chain=chain), raises=False)
    assert report.failed["sources"] == "KeyError: 'grating'"
    assert report.skipped["round trip"] == "there are no chains"
    assert not report


def test_instrument_without_keywords_has_no_headers_to_check():
    report = check_instrument(variant(keywords={}), skip=["calibrates"])
    assert report.skipped["headers"] == "it has no keywords"


def test_what_is_no_instrument_is_refused():
    for thing in [int, "sound", Instrument, None]:
        with pytest.raises(InstrumentError, match=r"is not an Instrument|lacks the methods"):
            check_instrument(thing)


def test_hierarchical_keywords_are_fits_keywords():
    skip = [rule for rule in RULES if rule not in ("sources", "headers")]
    keywords = {"hwp": "ESO INS4 DROT3 BEGIN", "altitude": "ESO TEL ALT"}
    assert check_instrument(variant(keywords=keywords), skip=skip)


def test_instrument_without_a_lamp_has_no_chain_to_take_to_the_sky():
    skip = [rule for rule in RULES if rule not in ("sources", "on sky")]
    report = check_instrument(variant(sources=("star",)), skip=skip)
    assert report.skipped["on sky"] == "it has no internal source"
    report = check_instrument(variant(telescope_optics=Instrument.telescope_optics), skip=skip)
    assert report.skipped["on sky"] == "it has no telescope of known values"


def test_seed_of_the_positions_does_not_decide():
    skip = [rule for rule in RULES if rule not in ("sources", "physical", "predicts")]
    assert all(check_instrument(Sound, seed=seed, skip=skip) for seed in range(3))


def test_unknown_rule_is_refused():
    with pytest.raises(InstrumentError, match=r"rule = 'colour'; allowed are class, "):
        check_instrument(Sound, skip=["colour"])


OUTSIDE = """
from astropolcal import optics
from astropolcal.instruments import Instrument
import astropy.units as u

class Outside(Instrument):
    "A polarimeter of another package."

    name = "outside"
    wavelength = [1.2, 1.6] * u.um
    references = ("Author et al. 2020",)

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        return (optics.LinearPolarizer(name="polarizer")
                | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
                | optics.WollastonPrism(efficiency=0.98, name="wollaston"))

    def setup(self, observations):
        return "polarized", ()
"""


def test_instrument_of_an_installed_package_is_found_and_conforms(tmp_path, monkeypatch):
    """A module and the entry point of its distribution, and nothing else."""
    (tmp_path / "outside_package.py").write_text(OUTSIDE)
    folder = tmp_path / "outside_package-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: outside-package\nVersion: 1.0\n")
    group = "[astropolcal.instruments]\noutside = outside_package:Outside\n"
    (folder / "entry_points.txt").write_text(group)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(instruments, "_REGISTRY", dict(instruments._REGISTRY))
    assert "outside" in instruments.names()
    assert check_instrument(instruments.get("outside"))


def test_missing_methods_are_named():
    class Half(Instrument):
        """Without a chain."""

        name = "half"

    with pytest.raises(InstrumentError, match=r"Half lacks the methods chain"):
        check_instrument(Half)


@pytest.mark.slow
def test_every_instrument_conforms():
    for name in instruments.names():
        report = check_instrument(instruments.get(name))
        assert len(report.passed) + len(report.skipped) == len(RULES), name


def test_report_lists_what_was_not_checked():
    report = Conformance("mine", ["class"], {}, {"headers": "it has no keywords"})
    assert str(report) == "mine passes 1 rules\n- headers not checked: it has no keywords"
