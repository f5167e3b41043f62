# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments: the registry, the chain of CHARIS, and its published values."""

import ast
import re
from datetime import date
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table

from astropolcal import calibrate, diagnose, instruments, optics
from astropolcal.calibration.system import from_first_stage, split_chain
from astropolcal.chain import join, leaves, stages
from astropolcal.exceptions import AstropolcalError, ChainError, InstrumentError
from astropolcal.instruments import CHARIS, Instrument, SkyLaw
from astropolcal.measurement import Measurement
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations import Observations
from astropolcal.observations.grid import is_star
from astropolcal.simulation import half_wave_plate_cycles, simulate

N_BINS = 22


class Plugin(Instrument):
    name = "plug-in polarimeter"
    aliases = ("PIP",)

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        return optics.LinearPolarizer(name="polarizer") | optics.WollastonPrism(name="wollaston")

    def setup(self, observations):
        return "polarized", ()


@pytest.fixture
def registry(monkeypatch):
    """The registry, restored afterwards."""
    monkeypatch.setattr(instruments, "_REGISTRY", dict(instruments._REGISTRY))


@pytest.fixture
def entry_point(registry, monkeypatch):
    """An installed package that brings an instrument."""
    point = SimpleNamespace(name=Plugin.name, load=lambda: Plugin)
    monkeypatch.setattr(
        instruments,
        "entry_points",
        lambda group: [point] if group == "astropolcal.instruments" else [],
    )


def _observations(wavelength=(1200, 1600) * u.nm, name="night", **meta):
    frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    chain = CHARIS().chain(wavelength=wavelength)
    return simulate(chain, wavelength, frames, noise=False, meta=meta, name=name)


def _setup(**meta):
    return CHARIS().setup(_observations(**meta))


# --- registry -----------------------------------------------------------------------


def test_get_knows_name_and_aliases_in_any_case():
    for name in ["charis", "CHARIS", "SCExAO/CHARIS", "scexao/charis", "Subaru/SCExAO/CHARIS"]:
        assert isinstance(instruments.get(name), CHARIS), name


def test_get_names_what_is_known():
    with pytest.raises(InstrumentError, match=r"unknown instrument 'chari'.*did you mean 'charis'"):
        instruments.get("chari")
    # nothing near
    with pytest.raises(InstrumentError, match=r"known are .*charis") as caught:
        instruments.get("zzzzzz")
    assert "did you mean" not in str(caught.value)
    assert isinstance(caught.value, AstropolcalError)


def test_registered_class_is_found_and_returned(registry):
    assert instruments.register(Plugin) is Plugin
    assert isinstance(instruments.get("pip"), Plugin)
    assert Plugin.name in instruments.names()
    # twice is harmless
    assert instruments.register(CHARIS) is CHARIS


def test_what_cannot_be_registered_is_refused(registry):
    other = type("Other", (Plugin,), {"name": "charis"})
    with pytest.raises(InstrumentError, match="'charis' is registered already"):
        instruments.register(other)
    for thing in [CHARIS(), int, "charis", type("Nameless", (Plugin,), {"name": ""})]:
        with pytest.raises(InstrumentError, match="not an Instrument with a name"):
            instruments.register(thing)


def test_entry_point_is_loaded_when_asked_for(entry_point):
    assert instruments.names() == sorted([*instruments._REGISTRY, Plugin.name])
    assert Plugin.name not in instruments._REGISTRY
    assert isinstance(instruments.get("PIP"), Plugin)
    assert Plugin.name in instruments._REGISTRY


def test_entry_point_with_something_else_is_refused(registry, monkeypatch):
    point = SimpleNamespace(name="broken", load=lambda: object)
    monkeypatch.setattr(instruments, "entry_points", lambda group: [point])
    with pytest.raises(InstrumentError, match="not an Instrument with a name"):
        instruments.get("broken")


def test_package_that_cannot_be_loaded_is_named_and_stands_in_nobodys_way(registry, monkeypatch):
    def fail():
        raise ModuleNotFoundError("No module named 'missing'")

    points = [
        SimpleNamespace(name="broken", load=fail),
        SimpleNamespace(name=Plugin.name, load=lambda: Plugin),
    ]
    monkeypatch.setattr(instruments, "entry_points", lambda group: points)
    assert isinstance(instruments.get("PIP"), Plugin)
    with pytest.raises(InstrumentError, match=r"'broken' cannot be loaded: ModuleNotFoundError"):
        instruments.get("broken")


def test_base_class_cannot_be_used_itself():
    with pytest.raises(TypeError, match="abstract"):
        Instrument()


def test_every_instrument_gives_a_chain_that_predicts():
    for name in instruments.names():
        instrument = instruments.get(name)
        chain = instrument.chain()
        assert all(leaf.name for leaf in leaves(chain)), name
        assert instrument.references, name
        assert instrument.name in repr(instrument), name
        for leaf in leaves(chain):
            for key in leaf.param_names:
                low, high = getattr(leaf, key).bounds
                value = getattr(leaf, key).value
                assert np.all(value >= (-np.inf if low is None else low)), f"{leaf.name}.{key}"
                assert np.all(value <= (np.inf if high is None else high)), f"{leaf.name}.{key}"


# --- the chain of CHARIS ----------------------------------------------------------


def test_polarized_chain_has_the_contracts_names_in_order():
    chain = CHARIS().chain("polarized", ["dichroic", "nbs"])
    assert [leaf.name for leaf in leaves(chain)] == [
        "calibration_polarizer", "hwp", "derotator", "dichroic", "nbs", "wollaston",
    ]  # fmt: skip
    assert sorted(stages(chain)) == ["derotator", "hwp"]


def test_unpolarized_chain_begins_with_the_fold_mirror():
    chain = CHARIS().chain("unpolarized")
    assert [leaf.name for leaf in leaves(chain)] == ["fold_mirror", "hwp", "derotator", "wollaston"]
    assert not chain["fold_mirror"].diattenuation.fixed


def test_number_of_free_parameters():
    for derotator, count in [("elliptical", 5 + 4 * N_BINS), ("linear", 5 + 2 * N_BINS)]:
        chain = CHARIS().chain(derotator=derotator)
        assert FreeParameters([chain], N_BINS).size == count, (derotator, count)
    # the dichroic adds none, and changes nothing
    with_it, without = (CHARIS().chain(optics_in=o) for o in (["dichroic"], []))
    assert FreeParameters([with_it], N_BINS).size == FreeParameters([without], N_BINS).size
    light = (1.0, 0.3, 0.4, 0.1)
    wavelength = CHARIS.wavelength
    np.testing.assert_allclose(with_it(wavelength, *light)[1], without(wavelength, *light)[1])


def test_bounds_of_the_derotator():
    for bounds, expected in [
        ("physical", {"horizontal": (-360, 360), "diagonal": (-360, 360), "circular": (-360, 360)}),
        ("paper", {"horizontal": (-360, 0), "diagonal": (-360, 0), "circular": (0, 360)}),
    ]:
        derotator = CHARIS().chain(bounds=bounds)["derotator"]
        assert {key: getattr(derotator, key).bounds for key in expected} == expected, (
            bounds,
            expected,
        )
    # a linear one takes its bounds from the same choice
    chain = CHARIS().chain(derotator="linear", bounds="paper")
    assert chain["derotator"].retardance.bounds == (-360, 0)


def test_bounds_of_the_paper():
    """Table "initial guesses and bounds": thicknesses 0.6 to 1.4 of 't Hart's, angles 5 deg."""
    chain = CHARIS().chain()
    assert chain["calibration_polarizer"].theta.bounds == (85, 95)
    assert chain["hwp"].theta.bounds == chain["derotator"].theta.bounds == (-5, 5)
    np.testing.assert_allclose(chain["hwp"].w_sio2.bounds, np.array([0.6, 1.4]) * 1.63398)
    np.testing.assert_allclose(chain["hwp"].w_mgf2.bounds, np.array([0.6, 1.4]) * 1.27711)
    assert chain["wollaston"].efficiency.bounds == (0, 1)
    assert chain["wollaston"].theta.fixed


def test_chain_follows_the_wavelength_grid_and_options():
    chain = CHARIS().chain(wavelength=[1.2, 1.6, 2.2] * u.um)
    assert chain["derotator"].horizontal.shape == (3,)
    assert chain["wollaston"].efficiency.shape == (3,)
    # the options of several chains too
    table = _observations(source="polarized", date="2025-10-05")
    (chain,) = CHARIS().chains_for([table], derotator="linear")
    assert isinstance(chain["derotator"], optics.LinearRetarder)


def test_unknown_choice_is_refused():
    for options, words in [
        ({"source": "moon"}, r"source = 'moon'; allowed are polarized, unpolarized"),
        ({"source": "star", "m3": "glass"}, r"m3 = 'glass'; allowed are free, power law, metal"),
        ({"derotator": "round"}, r"derotator = 'round'; allowed are elliptical, linear"),
        ({"bounds": "none"}, r"bounds = 'none'; allowed are physical, paper"),
        ({"optics_in": ["lens"]}, r"charis: optics_in = 'lens'; allowed are nbs, dichroic"),
    ]:
        with pytest.raises(InstrumentError, match=words):
            CHARIS().chain(**options)


# --- setup from a table -------------------------------------------------------------


def test_setup_reads_what_is_in_the_beam():
    for meta, expected in [
        ({"nasmyth_beam_switcher": "installed"}, ("nbs",)),
        ({"nasmyth_beam_switcher": " Not Installed "}, ()),
        ({"nasmyth_beam_switcher": "not installed", "date": "2025-11-01"}, ()),
        ({"date": "2025-07-15"}, ()),
        ({"date": "2025-10-05"}, ("nbs",)),
        ({"date": "2025-10-05T03:04:05"}, ("nbs",)),
        ({"date": date(2025, 7, 31)}, ()),
        ({"date": "2025-10-05", "yjh50_dichroic": "in"}, ("dichroic", "nbs")),
        ({"date": "2025-07-15", "yjh50_dichroic": "out"}, ()),
    ]:
        assert _setup(source="polarized", **meta) == ("polarized", expected), (meta, expected)


def test_setup_that_is_not_understood_is_an_error():
    for day in [None, "2025-09-01", "2025-10", " "]:
        meta = {} if day is None else {"date": day}
        with pytest.raises(InstrumentError, match="neither nasmyth_beam_switcher nor a conclusive"):
            _setup(source="polarized", **meta)
    for key in ["nasmyth_beam_switcher", "yjh50_dichroic"]:
        meta = {"date": "2025-10-05", key: "perhaps"}
        with pytest.raises(InstrumentError, match=f"night: {key} = 'perhaps'; allowed are"):
            _setup(source="polarized", **meta)
    for source in ["moon", "unpolarized_standard", None]:
        meta = {"date": "2025-10-05"} | ({} if source is None else {"source": source})
        with pytest.raises(InstrumentError, match=r"night: source .*allowed are polarized"):
            _setup(**meta)


def test_spelling_of_a_source_does_not_matter():
    """And a standard star of which nothing else is said is a star of unknown polarization."""
    for spelling, source in (
        *(("standard star", "star"), ("Standard_Star", "star"), ("standard-star ", "star")),
        *(("STAR", "star"), ("Unpolarized_standard-star", "unpolarized standard star")),
        ("POLARIZED", "polarized"),
    ):
        table = _observations([1.2] * u.um, date="2025-10-05", source=spelling)
        for name in ("charis", "irdis", "vampires"):
            assert instruments.get(name).setup(table)[0] == source
        assert is_star(spelling) == ("star" in source)


# --- chains for several datasets ------------------------------------------------------


def test_chains_share_one_grid():
    meta = {"source": "polarized", "instrument": "CHARIS"}
    first = _observations([1200, 1600] * u.nm, date="2025-07-15", **meta)
    second = _observations([1.6, 2.0] * u.um, date="2025-10-05", **meta)
    chains = CHARIS().chains_for([first, second])
    assert [c["derotator"].horizontal.size for c in chains] == [3, 3]
    assert ["nbs" in c.submodel_names for c in chains] == [False, True]


def test_tables_that_round_wavelengths_differently_share_their_bins():
    """One table writes 1159.5614 nm and another 1159.56 nm: the same bin to both layers."""
    meta = {"source": "polarized", "date": "2025-07-15"}
    first = _observations([1159.5614, 1600.0012] * u.nm, **meta)
    second = _observations([1159.56, 1600.0] * u.nm, **meta)
    chains = CHARIS().chains_for([first, second])
    assert chains[0]["wollaston"].efficiency.size == 2
    assert Measurement(chains, [first, second]).wavelength.size == 2


def test_table_of_another_instrument_is_refused():
    table = _observations(instrument="VAMPIRES", source="polarized", date="2025-10-05")
    with pytest.raises(InstrumentError, match="night: the table is of instrument 'VAMPIRES'"):
        CHARIS().chains_for([table])
    # one that names none is taken
    assert CHARIS().check(_observations()) is None


def test_positions_are_those_of_the_stages():
    table = _observations()
    positions = CHARIS().positions(table, CHARIS().chain())
    assert sorted(positions) == ["derotator", "hwp"]
    np.testing.assert_array_equal(positions["hwp"], table.position("hwp"))


# --- published values -------------------------------------------------------------------


@pytest.fixture(scope="module")
def published(shared_data):
    return Table.read(shared_data / "reference" / "charis_published_fits.ecsv")


def _published_chain(table):
    """Their per-wavelength fit in our signs: see the docstring of the CHARIS module."""

    def angle(name, sign=-1):
        return sign * np.asarray(table[name]) * u.deg

    return join(
        [
            optics.LinearPolarizer(theta=90 * u.deg, name="calibration_polarizer"),
            optics.LinearRetarder(retardance=angle("hwp_retardance"), mount="hwp", name="hwp"),
            optics.EllipticalRetarder(
                horizontal=angle("derotator_horizontal"),
                diagonal=angle("derotator_45"),
                circular=angle("derotator_circular", +1),
                mount="derotator",
                name="derotator",
            ),
            optics.ParityFlip(name="nbs"),
            optics.WollastonPrism(efficiency=table["wollaston_efficiency"], name="wollaston"),
        ]
    )


def test_wavelengths_are_the_published_bins(published):
    expected = np.asarray(published["wavelength"])
    np.testing.assert_allclose(CHARIS.wavelength.to_value(u.nm), expected, rtol=0, atol=1e-3)


def test_published_parameters_reproduce_the_published_accuracy(published, shared_data):
    """
    All 22 values of s_rel of the CHARIS authors' own software, to 1e-5 percent.

    Their n = 32 double differences and k = 5 parameters (HWP retardance, three
    of the derotator, efficiency), s_rel = sqrt(sum r^2 / (n - k) / n).
    """
    folder = shared_data / "data" / "charis"
    observations = Observations.read(folder / "dataset3_polarized_2025-10-05.ecsv")
    measurement = Measurement(_published_chain(published), observations)
    squares = np.bincount(measurement.bins, measurement.residuals() ** 2)
    s_rel = 100 * np.sqrt(squares / (32 - 5) / 32)
    np.testing.assert_allclose(s_rel, published["s_rel_elliptical_dataset3"], rtol=0, atol=1e-5)


def test_meta_of_the_published_chain_lead_to_it():
    instrument = CHARIS()
    table = _observations(**instrument.published_meta())
    assert instrument.check(table) is None
    source, optics_in = instrument.setup(table)
    expected = instrument.published().submodel_names
    assert instrument.chain(source, optics_in).submodel_names == expected


def test_published_chain_of_the_instrument_agrees_with_the_table(published):
    chain = CHARIS().published()
    derotator = chain["derotator"]
    for name, key, sign in (
        ("horizontal", "final_derotator_horizontal", -1),
        ("diagonal", "final_derotator_45", -1),
        ("circular", "final_derotator_circular", 1),
    ):
        values = sign * getattr(derotator, name).value
        np.testing.assert_allclose(values, published[key], rtol=0, atol=0.0051, err_msg=name)
    given = published.meta["paper_table_global"]
    assert chain["hwp"].w_sio2.value == pytest.approx(given["w_sio2_mm"])
    assert chain["hwp"].w_mgf2.value == pytest.approx(given["w_mgf2_mm"])
    assert chain["calibration_polarizer"].theta.value == pytest.approx(90 + given["offset_cal_deg"])


def test_on_sky_needs_a_half_wave_plate():
    for name in ["charis", "irdis", "vampires"]:
        chain = optics.LinearPolarizer(name="polarizer") | optics.WollastonPrism(name="wollaston")
        with pytest.raises(
            ChainError, match=f"{name}: the chain has no optic 'hwp' to put the tel"
        ):
            instruments.get(name).on_sky(chain)


def test_on_sky_keeps_what_belongs_to_the_plate_and_drops_what_belongs_to_the_lamp():
    for name in ["charis", "irdis", "vampires"]:
        instrument = instruments.get(name)
        polarizer = optics.LinearPolarizer(name="polarizer")
        lamp = optics.Perturbation(kind="rotation", dependence="harmonic:hwp:2", name="lamp")
        angle = optics.HarmonicRotator(mount="hwp", name="angle")
        error = optics.LinearRetarder(retardance=1 * u.deg, mount="hwp", name="error")
        plate = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
        back = optics.HarmonicRotator(mount="hwp", name="angle_back")
        chain = polarizer | lamp | angle | error | plate | back
        chain |= optics.WollastonPrism(name="wollaston")
        told = {"date": "2018-03-20", "wavelength": [1.245] * u.um}
        known = {key: told[key] for key in instrument.sky_options}
        mine = ["angle", "error", "hwp", "angle_back", "wollaston"]
        assert [leaf.name for leaf in split_chain(chain)[1]] == mine
        assert [leaf.name for leaf in leaves(from_first_stage(chain))] == mine
        names = [leaf.name for leaf in leaves(instrument.on_sky(chain, **known))]
        assert names[-5:] == mine
        assert not {"polarizer", "lamp"} & set(names)


# --- nothing outside of this folder knows an instrument -------------------------------------

PACKAGE = Path(instruments.__file__).parents[1]
SPELLINGS = re.compile("charis|scexao|vampires|irdis|sphere", re.IGNORECASE)
# stages, roles and words of tables that any polarimeter has
GENERAL = {
    "hwp", "derotator", "wollaston", "parallactic", "altitude", "star", "lamp", "relay", "cameras",
    "pairing",
}  # fmt: skip
DEFAULT = "instrument that a command takes where nothing names one"
ALLOWED = {
    ("gap/_bench.py", "charis"): "instrument on which challenges run by default",
    ("gap/effects/library.py", "dichroic"): "place of an effect, in a chain with or without one",
    ("reduction/tables.py", "SCExAO/CHARIS"): "the software whose tables are read has only it",
    ("scripts/_calibrate.py", "charis_example.ecsv"): "packaged data",
    ("scripts/_correct.py", "charis"): DEFAULT,
    ("scripts/_efficiency.py", "charis"): DEFAULT,
    ("scripts/_reduce.py", "charis"): DEFAULT,
    ("scripts/_simulate.py", "charis"): DEFAULT,
    ("testing.py", "charis"): "the calibration with which examples of docstrings start",
}
# arguments of argparse whose texts may cite an instrument
HELP = {"help", "epilog", "description", "metavar"}
# constants that hold the options of a command as its help shows them
TEXTS = {"OPTIONS", "_SHARED", "MODEL"}


def _private_names():
    """Names of optics, and words in the meta, that only some instruments have."""
    found = set()
    for name in ("charis", "irdis", "vampires"):
        instrument = instruments.get(name)
        found |= {*instrument.optional_optics, *instrument.meta_without(instrument.optional_optics)}
        for source in instrument.sources:
            found |= set(instrument.chain(source).submodel_names)
    return found - GENERAL


def _not_code(tree):
    """The constants of a module that are docstrings or texts of the command line's help."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    found = [n.body[0].value for n in ast.walk(tree) if isinstance(n, kinds) and
             n.body and isinstance(n.body[0], ast.Expr)]  # fmt: skip
    found += [n.value for n in ast.walk(tree) if isinstance(n, ast.keyword) and n.arg in HELP]
    # the texts of options: of a command, and those that several commands have
    named = [n for n in ast.walk(tree) if isinstance(n, ast.Assign)]
    texts = [n.value for n in named if getattr(n.targets[0], "id", None) in TEXTS]
    found += [value for text in texts for value in getattr(text, "values", (text,))]
    return {id(inner) for node in found for inner in ast.walk(node)}


def _named(source, private):
    """Yield the texts and names in a module that tell of an instrument."""
    tree = ast.parse(source)
    ignored = _not_code(tree)
    for node in ast.walk(tree):
        text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if text and id(node) not in ignored:
            # a text of several words is prose, such as the title of an effect
            words = set() if " " in node.value else set(re.split(r"\W+", node.value))
            if SPELLINGS.search(node.value) or private & words:
                yield node.value
        for key in ("id", "attr", "name", "arg"):
            word = getattr(node, key, None)
            if isinstance(word, str) and id(node) not in ignored:
                if SPELLINGS.search(word) or word in private:
                    yield word


def test_the_search_finds_what_it_should():
    code = '''
"""Docstring of charis."""
parser.add_argument("--x", help="such as charis")
a = "SCExAO/CHARIS"
vampires_only = chain["nbs"]
'''
    assert set(_named(code, {"nbs"})) == {"SCExAO/CHARIS", "vampires_only", "nbs"}


@pytest.mark.slow
def test_no_code_outside_of_the_folder_names_an_instrument():
    """What a new instrument needs is in its file: nothing else may tell one from another."""
    private, found = _private_names(), {}
    assert {"nbs", "m3", "m4", "flc", "yjh50_dichroic"} <= private
    for path in sorted(PACKAGE.rglob("*.py")):
        where = path.relative_to(PACKAGE).as_posix()
        if not where.startswith("instruments/"):
            found |= dict.fromkeys((where, text) for text in _named(path.read_text(), private))
    excused = {
        key: [a for a in ALLOWED if key[0] == a[0] and key[1].startswith(a[1])] for key in found
    }
    strange = [key for key, reasons in excused.items() if not reasons]
    assert not strange, (
        f"{strange}: move what is particular to an instrument into astropolcal/instruments, and "
        "ask the Instrument for it"
    )
    needed = {reason for reasons in excused.values() for reason in reasons}
    unneeded = sorted(set(ALLOWED) - needed)
    assert not unneeded, "exceptions that are no longer needed"


# --- the only instrument there is -----------------------------------------------------------


class Lone(Instrument):
    """A polarimeter with optics, stages and wavelengths of its own, and no derotator."""

    name = "lone"
    wavelength = [0.7, 0.8, 0.9] * u.um
    keywords = {"hwp": "ROTOR"}
    references = ("Nobody 2020",)
    sources = ("polarized", "unpolarized")
    sky_law = SkyLaw(plate=(0, 0), derotator={})

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        self.check_choices(source, optics_in)
        size = self.grid(wavelength).size
        lights = {
            "polarized": optics.LinearPolarizer(name="grid"),
            "unpolarized": optics.Diattenuator(diattenuation=np.zeros(size), name="flat_mirror"),
        }
        plate = optics.LinearRetarder(
            retardance=np.full(size, 170) * u.deg,
            mount="hwp",
            name="rotor",
            fixed={"theta": False},
            bounds={"theta": (-5, 5)},
        )
        # without a derotator, as good as the retardance
        splitter = optics.WollastonPrism(efficiency=0.97, name="savart", fixed={"efficiency": True})
        return lights[source] | plate | splitter

    def setup(self, observations):
        return self.source_of(observations), ()


@pytest.fixture
def lone(monkeypatch):
    """An installation with one instrument only, which is none of ours."""
    monkeypatch.setattr(instruments, "_REGISTRY", {})
    monkeypatch.setattr(instruments, "entry_points", lambda group: [])
    instruments.register(Lone)
    assert instruments.names() == ["lone"]
    return instruments.get("lone")


def _lone_night(chain, source="polarized", seed=1, cycles=4):
    frames = half_wave_plate_cycles(derotator=np.zeros(cycles) * u.deg)
    meta = {"instrument": "lone", "source": source}
    return simulate(chain, Lone.wavelength, frames, flux=3e7, seed=seed, meta=meta, name=source)


def test_package_works_with_one_instrument_alone(lone):
    """From simulated frames to a diagnosis that finds what the model lacks."""
    truth = lone.chain()
    truth["rotor"].retardance = [172.0, 175.0, 168.0] * u.deg
    truth["rotor"].theta = 1.5 * u.deg
    night = _lone_night(truth)
    cal = calibrate(lone.chains_for([night]), [night], instrument="lone", cross_validate=False)
    rotor = cal.chains[0]["rotor"]
    np.testing.assert_allclose(rotor.retardance.value, [172, 175, 168], atol=0.3)
    assert rotor.theta.value == pytest.approx(1.5, abs=0.01)
    assert cal.instrument == "lone"
    assert diagnose(cal, night).verdict == "none"


def test_diagnosis_finds_a_cause_in_the_only_instrument(lone):
    """The plate's encoder is not centred: an effect of any plate, whatever it is called."""
    error = optics.HarmonicRotator(cosine=0.6 * u.deg, mount="hwp", name="error")
    back = optics.HarmonicRotator(cosine=-0.6 * u.deg, mount="hwp", name="back")
    first, plate, last = leaves(lone.chain())
    night = _lone_night(join([first, error, plate, back, last]), cycles=8)
    cal = calibrate(lone.chains_for([night]), [night], instrument="lone", cross_validate=False)
    report = diagnose(cal, night)
    assert report.verdict == "named"
    assert report.causes[0].effect.name == "hwp_encoder_eccentricity"


def test_other_names_are_unknown_where_there_is_one_instrument(lone):
    with pytest.raises(InstrumentError, match=r"unknown instrument 'charis'; known are lone$"):
        instruments.get("charis")
