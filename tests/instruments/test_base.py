# Licensed under a 3-clause BSD style license - see LICENSE
"""What an instrument gets from its base class: choices, grids, sources, and the way to the sky."""

import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import EarthLocation
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments, optics
from astropolcal.chain import join, leaves, stages
from astropolcal.exceptions import ChainError, InstrumentError
from astropolcal.instruments import Instrument, SkyLaw, add_nuisance
from astropolcal.instruments.layout import FileLayout
from astropolcal.instruments.telescope import entrance, misaligned
from astropolcal.simulation import half_wave_plate_cycles, simulate

GRID = [0.6, 0.7, 0.8] * u.um


class Bench(Instrument):
    """A plate and a splitter behind a lamp, or behind a mirror of a telescope."""

    name = "bench"
    aliases = ("Lab/Bench",)
    wavelength = GRID
    sources = ("polarized", "star")
    optional_optics = ("window",)

    def chain(self, source="polarized", optics_in=(), *, wavelength=None, star="star"):
        self.check_choices(source, optics_in)
        size = self.grid(wavelength).size
        first = optics.LinearPolarizer(name="polarizer")
        train = [first] if source == "polarized" else [optics.PolarizedSource(name=star)]
        if source == "star":
            train += self.telescope_optics(())
        train.append(optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp"))
        if "window" in optics_in:
            train.append(optics.LinearRetarder(retardance=np.full(size, 2) * u.deg, name="window"))
        return join([*train, optics.WollastonPrism(efficiency=0.98, name="wollaston")])

    def setup(self, observations):
        return self.source_of(observations), ()

    def telescope_optics(self, behind, *, extra=()):
        return [optics.Rotator(mount="parallactic", name="sky"), *extra]


class Indoors(Bench):
    """The same without a telescope."""

    name = "indoors"
    telescope_optics = Instrument.telescope_optics


class Anything(Bench):
    """One that takes every option, and has no list of sources."""

    name = "anything"
    sources = ()

    def chain(self, source="polarized", optics_in=(), *, wavelength=None, **options):
        return Bench().chain()

    def setup(self, observations):
        return "any", ()


BENCH = Bench()


def night(**meta):
    chain = Bench().chain(wavelength=GRID)
    return simulate(chain, GRID, half_wave_plate_cycles(), meta=meta, noise=False, name="night")


# --- choices --------------------------------------------------------------------------------


def test_choice_that_is_not_known():
    for arguments, options, words in [
        (("moon",), {}, r"^bench: source = 'moon'; allowed are polarized, star$"),
        (("star", ["lens"]), {}, r"^bench: optics_in = 'lens'; allowed are window$"),
        (("star", ["window", "lens"]), {}, "optics_in = 'lens'"),
        (
            ("star",),
            {"m3": ("glass", ("free", "metal"))},
            r"m3 = 'glass'; allowed are free, metal$",
        ),
        (("star",), {"order": (3, (1, 2))}, r"bench: order = 3; allowed are 1, 2$"),
    ]:
        with pytest.raises(InstrumentError, match=words):
            BENCH.check_choices(*arguments, **options)


def test_choices_that_are_known_pass():
    assert BENCH.check_choices("star", ("window",), m3=("free", ("free",))) is None


# --- wavelengths -----------------------------------------------------------------------------


def test_grid_is_the_usual_one_or_that_asked_for():
    assert BENCH.grid() is GRID
    np.testing.assert_array_equal(BENCH.grid([1, 2] * u.nm), [1, 2] * u.nm)
    assert BENCH.grid(0.65 * u.um).shape == (1,)


def test_chain_of_one_wavelength_is_that_of_a_grid_of_one():
    """A scalar wavelength is one wavelength, not a chain of parameters without an axis."""
    for name in instruments.names():
        instrument = instruments.get(name)
        lam = instrument.wavelength[0]
        scalar, grid = (instrument.chain(wavelength=w) for w in (lam, lam[None]))
        for a, b in zip(leaves(scalar), leaves(grid), strict=True):
            for key in a.param_names:
                assert getattr(a, key).shape == getattr(b, key).shape in [(), (1,)], name
                np.testing.assert_array_equal(getattr(a, key).value, getattr(b, key).value)


# --- sources of tables --------------------------------------------------------------------


def test_source_of_a_table():
    assert BENCH.source_of(night(source="star")) == "star"
    with pytest.raises(InstrumentError, match=r"night: source .* = 'Stars'; allowed are polarized"):
        BENCH.source_of(night(source="Stars"))
    with pytest.raises(InstrumentError, match=r"night: source .* = None"):
        BENCH.source_of(night())


def test_spellings_of_a_source_know_no_case():
    spellings = {"lamp": "polarized", "sky": "star"}
    assert BENCH.source_of(night(source=" LAMP "), spellings) == "polarized"
    with pytest.raises(InstrumentError, match=r"source .* = 'polarized'; allowed are lamp, sky"):
        BENCH.source_of(night(source="polarized"), spellings)


def test_meta_of_what_is_taken_out_say_so_to_setup():
    """What ``meta_without`` writes is what ``setup`` reads."""
    for name, optic, meta in [
        ("charis", "nbs", {"nasmyth_beam_switcher": "not installed"}),
        ("charis", "dichroic", {"yjh50_dichroic": "out"}),
        ("vampires", "flc", {"flc": "out", "pairing": "hwp"}),
    ]:
        instrument = instruments.get(name)
        assert instrument.meta_without([optic]) == meta, (name, optic, meta)
        assert instrument.meta_without(["hwp"]) == {}, (name, optic, meta)
        table = night(**(instrument.published_meta() | {"date": "2025-11-01"}))
        assert optic in instrument.setup(table)[1], (name, optic, meta)
        table.meta.update(instrument.meta_without([optic]))
        assert optic not in instrument.setup(table)[1], (name, optic, meta)


def test_every_optional_optic_can_be_told_out():
    for name in instruments.names():
        instrument = instruments.get(name)
        for optic in instrument.optional_optics:
            assert instrument.meta_without([optic]), optic


# --- particulars ------------------------------------------------------------------------------


def test_particulars_are_what_the_chain_takes():
    table = night(source="star", object="HD 30675")
    # this chain has a name of the star, but no catalogue
    assert BENCH.particulars(table) == {"star": "star_HD30675"}
    assert instruments.get("charis").particulars(table) == {
        "star": "star_HD30675",
        "target": "HD 30675",
    }


def test_what_has_no_name_has_no_particulars():
    for meta in [
        {"source": "polarized", "object": "lamp"},
        {"source": "star"},
        {"source": "star", "object": " -+ "},
    ]:
        assert BENCH.particulars(night(**meta)) == {}, meta


def test_particulars_make_the_chain_of_each_dataset():
    tables = [night(source="star", object=name) for name in ("HD 1", "HD 2")]
    chains = BENCH.chains_for(tables)
    assert [chain.submodel_names[0] for chain in chains] == ["star_HD1", "star_HD2"]


def test_option_that_is_taken_by_any_name():
    (chain,) = Anything().chains_for([night()], colour="blue")
    assert chain.submodel_names[0] == "polarizer"
    with pytest.raises(InstrumentError, match="bench: its chain has no option colour, size"):
        BENCH.chains_for([night(source="star")], size=3, colour="blue")


# --- names ------------------------------------------------------------------------------------


@given(st.sampled_from(["bench", "BENCH", "lab/bench", "LAB/Bench"]))
def test_names_and_aliases_in_any_case(name):
    assert BENCH.answers_to(name)


def test_other_names():
    for name in ["", "ben", "bench ", "lab"]:
        assert not BENCH.answers_to(name), name


def test_repr_has_class_and_name():
    assert repr(BENCH) == "<Bench 'bench'>"


# --- defaults ---------------------------------------------------------------------------------


def test_what_an_instrument_need_not_say():
    assert BENCH.optics_of({"WINDOW": "in"}) == {}
    assert BENCH.configured({"MODE": "any"}) is BENCH
    assert BENCH.mode_header(GRID) == {}
    assert BENCH.published_mirrors() == {}
    assert BENCH.published_meta() == {"instrument": "bench"}
    assert BENCH.meta_without(["window"]) == {}
    assert BENCH.location is None
    assert BENCH.sky_law == SkyLaw()
    with pytest.raises(InstrumentError, match="bench: no published values; give a calibration"):
        BENCH.published()


def test_site_and_law_are_those_of_the_files():
    files = FileLayout({}, (3, 8, 8), site=(10.0, -20.0, 300.0), tracking=(0.0, 1.0))
    outdoors = type("Outdoors", (Bench,), {"files": files})()
    expected = EarthLocation.from_geodetic(10 * u.deg, -20 * u.deg, 300 * u.m)
    assert u.allclose(outdoors.location.lon, expected.lon)
    assert u.allclose(outdoors.location.lat, expected.lat)
    assert u.allclose(outdoors.location.height, expected.height)
    assert outdoors.sky_law.plate_law() == (0.0, 1.0)


# --- to the sky -------------------------------------------------------------------------------


def test_telescope_comes_in_the_place_of_the_lamp():
    inner = BENCH.chain(optics_in=["window"])
    sky = BENCH.on_sky(inner)
    assert sky.submodel_names == ("sky", "hwp", "window", "wollaston")
    # with the values that were calibrated, not those that the instrument starts with
    inner["window"].retardance = [5, 6, 7] * u.deg
    np.testing.assert_array_equal(BENCH.on_sky(inner)["window"].retardance.value, [5, 6, 7])


def test_options_reach_the_telescope():
    mirror = optics.MetalMirror(material="silver", name="m3")
    assert BENCH.on_sky(BENCH.chain(), extra=[mirror]).submodel_names[:2] == ("sky", "m3")


def test_chain_from_the_sky_stays():
    sky = BENCH.chain("star")
    assert BENCH.on_sky(sky) is sky


def test_nuisance_of_a_dataset_does_not_go_to_the_sky():
    table = night(source="polarized")
    (chain,) = add_nuisance([BENCH.chain(wavelength=GRID)], [table], ["background", "beam_gain"])
    assert len(leaves(chain)) == 5
    assert BENCH.on_sky(chain).submodel_names == ("sky", "hwp", "wollaston")


def test_plate_is_needed_for_the_sky():
    chain = optics.LinearPolarizer(name="p") | optics.WollastonPrism(name="w")
    with pytest.raises(ChainError, match="bench: the chain has no optic 'hwp'"):
        BENCH.on_sky(chain)


def test_instrument_that_knows_no_telescope():
    assert not Indoors().has_telescope
    for call in (lambda: Indoors().on_sky(BENCH.chain()), lambda: Indoors().telescope_optics([])):
        with pytest.raises(InstrumentError, match="indoors: no chain from the sky is known"):
            call()


def test_telescope_is_known_by_either_method():
    class Whole(Indoors):
        def on_sky(self, chain):
            return join([optics.Rotator(mount="parallactic", name="sky"), *leaves(chain)[1:]])

    assert Bench().has_telescope
    assert Whole().has_telescope


@pytest.mark.filterwarnings("ignore:irdis. neither date nor coating")
def test_optics_behind_the_plate_are_those_of_the_lamp():
    """The same objects are modelled, whichever light comes: names, stages and values."""
    for name in instruments.names():
        instrument = instruments.get(name)
        if not instrument.has_telescope or "polarized" not in instrument.sources:
            continue
        inner = instrument.chain("polarized")
        sky = instrument.on_sky(inner)
        behind = leaves(inner)[1:]
        assert set(stages(sky)) >= {"parallactic", "hwp", *stages(inner)}, name
        for old, new in zip(behind, leaves(sky)[-len(behind) :], strict=True):
            assert (old.name, old.mount) == (new.name, new.mount), name
            for key in old.param_names:
                np.testing.assert_array_equal(getattr(old, key).value, getattr(new, key).value)


# --- what the instruments of one telescope share ------------------------------------------------


def test_calibration_unit_of_subaru():
    assert misaligned(90)["bounds"]["theta"] == (85, 95)
    assert misaligned(0, most=20) == {"fixed": {"theta": False}, "bounds": {"theta": (-20, 20)}}
    (polarizer,) = entrance("polarized", GRID, "star", None, "free")
    # light of minus Q, half of it
    np.testing.assert_allclose(polarizer.mueller() @ [1, 0, 0, 0], [0.5, -0.5, 0, 0], atol=1e-15)
    assert not polarizer.theta.fixed
    (mirror,) = entrance("unpolarized", GRID[:2], "star", None, "free")
    assert mirror.diattenuation.shape == (2,)
    np.testing.assert_array_equal(mirror.mueller(GRID[:2]), [np.eye(4)] * 2)


def test_both_polarimeters_of_subaru_have_one_unit_and_one_site():
    charis, vampires = (instruments.get(name) for name in ("charis", "vampires"))
    assert charis.files.site == vampires.files.site
    for source in ("polarized", "unpolarized"):
        a, b = (leaves(i.chain(source))[0] for i in (charis, vampires))
        assert (type(a), a.name, a.theta.bounds) == (type(b), b.name, b.theta.bounds)


def test_wavelengths_go_to_other_processes():
    for name in instruments.names():
        lam = instruments.get(name).wavelength
        assert np.array_equal(pickle.loads(pickle.dumps(lam)), lam), name
