# Licensed under a 3-clause BSD style license - see LICENSE
"""The choice of causes: planted cells are found, with their place and a probability."""

import dataclasses
import importlib
import runpy
from pathlib import Path

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from astropy.table import QTable, Table
from gap_setups import SETUPS

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic, leaves
from astropolcal.efficiency import sky_path
from astropolcal.gap.attribution import Candidate, Scan
from astropolcal.gap.cells import Cell
from astropolcal.gap.challenge import Setup, make_challenge, score_answer
from astropolcal.gap.diagnosis import diagnose
from astropolcal.gap.effects import EFFECTS
from astropolcal.gap.model import nominal_model
from astropolcal.gap.report import Fitted, to_dict
from astropolcal.gap.selection import _members, select
from astropolcal.gap.shrinkage import frame_groups
from astropolcal.simulation import half_wave_plate_cycles, simulate

pytestmark = pytest.mark.usefixtures("own_instruments")
SMOOTH = [effect for effect in EFFECTS.values() if effect.kind != "discrete"]


def chosen(setup, observations, library=(), **options):
    groups = frame_groups([observations]) if options.pop("left_out", False) else None
    base = nominal_model([setup.nominal], [observations])
    return select(base, library, groups, lambda line: None, **options)


def names(group):
    return [candidate.name for candidate, _ in group.members]


# every kind of place, generator and dependence once
PLANTED = [
    ("charis", Cell("in:derotator", "retardance_d", "harmonic:hwp:1"), (0.05, 0.03)),
    ("charis", Cell("after:hwp", "depolarization_circular", "harmonic:derotator:1"), (0.02, 0.02)),
    ("cassegrain", Cell("telescope", "diattenuation_h", "step:39"), (0.01,)),
    ("cassegrain", Cell("detector", "gain", "time2"), (0.01,)),
    ("cassegrain", Cell("in:hwp", "diattenuation_d", "direction:hwp"), (0.01,)),
    ("rotating", Cell("in:hwp", "rotation", "direction:hwp"), (0.01,)),
    ("rotating", Cell("in:rotator", "diattenuation_h", "time"), (0.01,)),
    ("irdis lamp", Cell("source", "depolarization_linear", "step:30"), (0.01,)),
    ("irdis star", Cell("in:derotator", "diattenuation_h", "harmonic:derotator:2"), (0.01, 0.0)),
    ("vampires", Cell("after:relay", "rotation", "harmonic:derotator:4"), (0.01, 0.0)),
    # the nominal model follows half of it: two other causes together look better at first
    ("vampires", Cell("after:flc", "retardance_d", "harmonic:derotator:1"), (0.004, 0.0)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "cell", "sizes"), PLANTED)
def test_a_planted_cell_is_found_first_and_alone(name, cell, sizes):
    setup = SETUPS[name]()
    found = chosen(setup, setup.observed(setup.with_cell(cell, *sizes), seed=7))
    (group,) = found.groups
    assert cell.name in names(group)
    assert group.probability > 0.9
    assert found.unlisted < 0.1
    assert found.model.p_value > 1e-3
    shares = [share for _, share in group.members]
    # what is equal up to rounding is in the order of the names
    assert np.all(np.diff(shares) < 1e-9)
    assert sum(shares) == pytest.approx(1)


@pytest.mark.slow
def test_an_error_of_the_detector_is_found():
    for kind, size in [("nonlinearity", 0.003), ("background_of_one_beam", 0.003)]:
        setup = SETUPS["charis"]()
        found = chosen(setup, setup.with_detector(kind, size, seed=3))
        assert kind in [candidate.cell.kind for candidate, _ in found.groups[0].members], (
            kind,
            size,
        )
        assert found.groups[0].probability > 0.9, (kind, size)


@pytest.mark.slow
def test_a_background_may_grow_and_one_beam_may_bend():
    """Elsewhere they are called depolarization that drifts, or a gain and what is left."""
    setup = SETUPS["charis"]()
    for cell, size, course in (
        ("background/time", 0.01, lambda frames: np.linspace(0, 1, len(frames))),
        ("background_of_one_beam/step:20", 0.004, lambda frames: 1.0 * (frames["frame"] >= 20)),
        ("nonlinearity_of_right_beam/flux", 0.004, 1.0),
    ):
        found = chosen(setup, setup.with_detector(cell.partition("/")[0], size, course, seed=3))
        (group,) = found.groups
        assert group.probability > 0.9, cell
        assert f"detector/{cell}" in names(group), names(group)


@pytest.mark.slow
def test_a_lamp_whose_polarization_follows_its_flux_is_told_beside_a_background():
    """To first order both do the same: a lamp of less flux has a larger share of background."""
    setup = SETUPS["charis"]()
    how = {"lamp": np.random.default_rng(4).uniform(0.98, 1.02, len(setup.frames)), "seed": 3}
    lamp, background = "source/depolarization_linear/brightness", "detector/background/flux"
    follows = setup.with_cell(Cell(*lamp.split("/")), 0.1)
    for seen in (setup.observed(follows, **how), setup.with_detector("background", 0.05, **how)):
        (group,) = chosen(setup, seen).groups
        assert group.probability > 0.9
        assert {lamp, background} <= set(names(group)), names(group)


@pytest.mark.slow
def test_beams_of_other_wavelengths_are_no_optic_that_turns():
    """To first order they are circular diattenuation that follows the derotator, of some phase."""
    setup = SETUPS["charis"]()
    one, other = (
        setup.observed(setup.with_cell(Cell("in:derotator", "retardance_h", "constant"), size))
        for size in (0.01, -0.01)
    )
    table = one.to_table()
    table["flux_left"] = other.flux_left.ravel() * table["flux_left"].unit
    (group,) = chosen(setup, type(one).from_table(table, name=one.name)).groups
    assert group.probability > 0.9
    assert group.best.name == "in:derotator/retardance_h_between_beams/constant"
    # what corrects for it is no part of the path of the light from the sky
    (beams,) = (chain for chain in nominal_model([setup.nominal], [one]).chains)
    found = optics.Perturbation(dependence="beam", name="found")
    assert [leaf.name for leaf in leaves(sky_path(insert_optic(beams, found, after="hwp")))] == [
        leaf.name for leaf in leaves(sky_path(beams))
    ]


@pytest.mark.slow
def test_what_changes_three_times_in_a_turn_of_the_plate_is_in_the_table():
    """A quarter turn of the plate hardly tells it from two lobes, which were named instead."""
    setup = SETUPS["charis"]()
    third = Cell("in:hwp", "rotation", "harmonic:hwp:3")
    (group,) = chosen(setup, setup.observed(setup.with_cell(third, 0.003, 0.002), seed=3)).groups
    assert group.probability > 0.9
    assert third.name in names(group), names(group)
    assert third.title.endswith("that changes three times in a turn of the half-wave plate")


@pytest.mark.slow
def test_two_planted_causes_are_both_found_and_left_out_frames_agree():
    setup = SETUPS["charis"]()
    first = Cell("in:derotator", "retardance_h", "time")
    second = Cell("in:hwp", "diattenuation_h", "constant")
    setup.truth = setup.with_cell(first, 0.03)
    found = chosen(setup, setup.observed(setup.with_cell(second, 0.004), seed=2), left_out=True)
    assert len(found.groups) == 2
    for cell in (first, second):
        assert any(cell.name in names(group) for group in found.groups), cell.name
    assert all(group.probability > 0.8 for group in found.groups)
    # each lowers the error of frames that were left out
    errors = [one.percent for one in found.history]
    assert errors == sorted(errors, reverse=True)
    assert found.history[-1].chi2 < 1.5
    assert all(group.lowered > 0 for group in found.groups)
    assert list(found.model.added) == [group.best.name for group in found.groups]


@pytest.mark.slow
def test_an_axis_between_those_of_an_optic_turns_with_it():
    """In a static frame both components would change twice in a turn."""
    setup = SETUPS["charis"]()
    cells = [Cell("in:derotator", f"diattenuation_{axis}", "constant") for axis in "hd"]
    setup.truth = setup.with_cell(cells[0], 0.006)
    found = chosen(setup, setup.observed(setup.with_cell(cells[1], 0.005), seed=2))
    assert {group.best.name for group in found.groups} == {cell.name for cell in cells}


@pytest.mark.slow
def test_a_stage_that_slips_at_a_frame_is_one_cause():
    """Elsewhere it is two rotations, in front of the optic and behind it."""
    setup = SETUPS["charis"]()
    cell = Cell("in:derotator", "orientation", "step:20")
    found = chosen(setup, setup.observed(setup.with_cell(cell, 0.003), seed=2))
    (group,) = found.groups
    assert (group.best.name, group.probability > 0.9) == (cell.name, True)
    assert cell.to_dict()["kind"] == "rotation"


@pytest.mark.slow
def test_a_name_is_given_where_it_does_as_well_as_its_cell():
    setup = SETUPS["charis"]()
    observations = setup.observed(setup.with_effect("beam_gain", imbalance=0.005))
    (named,) = chosen(setup, observations, SMOOTH).groups
    assert named.best.name == "beam_gain"
    assert "detector/gain/constant" in names(named)
    # without the library it is the cell; without the cells it is the name
    (cell,) = chosen(setup, observations).groups
    assert (cell.best.name, cell.best.is_named) == ("detector/gain/constant", False)
    (alone,) = chosen(setup, observations, SMOOTH, cells=False).groups
    assert alone.best.name == "beam_gain"
    assert all(candidate.is_named for candidate, _ in alone.members)


@pytest.mark.slow
def test_a_law_of_any_form_is_one_cause():
    """A gain at one wavelength alone."""
    true = data.with_effect("beam_gain")
    true["gap_beam_gain"].imbalance = np.where(np.arange(len(data.WAVELENGTH)) == 2, 0.02, 0.0)
    found = chosen(SETUPS["charis"](), data.observed(true, flux=1e7), SMOOTH)
    assert [group.best.name for group in found.groups] == ["beam_gain"]
    sizes = Fitted(found.model).sizes("beam_gain")["gap_beam_gain.imbalance"]
    np.testing.assert_allclose(sizes["value"], true["gap_beam_gain"].imbalance.value, atol=2e-3)


@pytest.mark.long
def test_what_only_a_free_law_shows_is_found():
    """Fringes change sign between wavelengths: no smooth law has anything of them."""
    small = Setup(n_derotator=4)
    for seed, turns in ((4, "hwp:2"), (8, "derotator:4"), (11, "hwp:1")):
        made = make_challenge(
            seed, kind="mechanism", snr=20, setup=small, fault={"what": "fringes"}
        )
        observations, chains, case = made
        (cause,) = diagnose(chains, observations).causes
        fault = case["faults"][0]
        # in front of the splitter a diattenuation and a gain of its beams are the same
        cells = [cause.cell, *(one.cell for one, _ in cause.aliases)]
        assert (fault["place"], fault["kind"]) in {(one.place, one.kind) for one in cells}
        assert cause.cell.dependence == f"harmonic:{turns}"
        assert cause.probability > 0.9


def test_equally_probable_aliases_have_one_order():
    """Whichever of them rounding puts in front; what is more probable comes first."""

    def candidate(place, evidence):
        spectrum = np.array([1.0]), np.array([1.0]), 1.0
        cell = Cell(place, "rotation", "constant")
        return Candidate(None, cell, 100.0, 1, evidence, spectrum=spectrum)

    orders = set()
    for off in (1e-12, -1e-12):
        best = candidate("source", 50.0)
        alike = [candidate("in:hwp", 48.0 + off), candidate("after:hwp", 48.0 - off)]
        rivals = sorted([best, *alike, candidate("telescope", 49.0)], key=lambda o: -o.evidence)
        members = _members(best, Scan(rivals), None)
        orders.add(tuple(one.cell.place for one, _ in members))
    assert orders == {("source", "telescope", "after:hwp", "in:hwp")}


def test_what_is_alike_with_a_law_is_alike_without_one():
    """The law of the chosen cell alone was let go of: what others gain by that is not known."""

    def candidate(place, statistic, evidence, degree=2):
        cell, spectrum = Cell(place, "rotation", "constant"), (np.ones(1), np.ones(1), 1.0)
        return Candidate(None, cell, statistic, 3, evidence, 0.0, spectrum, degree)

    seen = [candidate("source", 2e3, 800.0), candidate("in:hwp", 1.9e3, 799.0)]
    seen += [candidate("after:hwp", 2e3 + 1e-4, 799.0), candidate("telescope", 2.4e3, 990.0)]
    members = _members(candidate("source", 2.8e3, 1100.0, 4), Scan(seen), None)
    assert [one.cell.place for one, _ in members] == ["source", "telescope", "after:hwp"]


@pytest.mark.long
def test_one_thing_that_changes_in_two_ways_is_one_that_no_table_has():
    """An axis that wanders looks like two errors of its encoder."""
    made = make_challenge(7, kind="mechanism", snr=25, fault={"what": "wander"})
    observations, chains, case = made
    diagnosis = diagnose(chains, observations)
    assert {cause.cell.to_dict()["kind"] for cause in diagnosis.causes} == {"rotation"}
    assert len(diagnosis.causes) == 2
    assert max(cause.probability for cause in diagnosis.causes) < 0.5
    assert score_answer(case, to_dict(diagnosis)) == "right"


@pytest.mark.long
def test_a_listed_cause_is_exchanged_for_no_other_freedom_than_the_data_ask_for():
    """To first order much freedom does better; a law that is taken away asks for more causes."""
    for seed, number, snr in ((176, 509, 102.2), (311, 36, 100.6)):
        making = np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2)[1]
        how = {"kind": "listed", "snr": snr}
        observations, chains, case = make_challenge(np.random.default_rng(making), **how)
        diagnosis = diagnose(chains, observations, cross_validate=False)
        assert score_answer(case, to_dict(diagnosis)) == "right", seed
        assert diagnosis.verdict == "named", seed


@pytest.mark.long
def test_two_causes_that_follow_the_same_thing_may_be_one_that_no_table_has():
    setup = SETUPS["charis"]()
    first = Cell("in:hwp", "diattenuation_h", "harmonic:derotator:1")
    for dependence, least, most in (("harmonic:derotator:1", 0.0, 0.2), ("step:25", 0.9, 1.0)):
        second = Cell("after:derotator", "rotation", dependence)
        with_first = dataclasses.replace(setup, truth=setup.with_cell(first, 0.02, 0.01))
        truth = with_first.with_cell(second, 0.03, 0.02)
        found = chosen(setup, setup.observed(truth, seed=4))
        assert len(found.groups) == 2
        assert all(least <= group.probability <= most for group in found.groups)


def test_the_table_of_the_rules_is_that_of_the_benchmark():
    repository = Path(__file__).resolve().parents[2]
    script = runpy.run_path(str(repository / "tests" / "benchmarks" / "ablation.py"))
    table = Table.read(repository / "docs" / "challenge_rules.csv", format="csv")
    assert list(table["Without the rule"]) == list(script["RULES"])
    for constants in script["RULES"].values():
        for path in constants:
            module, _, name = path.partition(".")
            assert hasattr(importlib.import_module(f"astropolcal.gap.{module}"), name), path


@pytest.mark.long
def test_pairs_that_a_greedy_search_gets_wrong():
    """Two of three causes that are one, and one of much freedom in place of two simple ones."""
    for number in (27, 3):
        rng = np.random.default_rng([99, number])
        snr = float(np.exp(rng.uniform(np.log(30), np.log(100))))
        made = make_challenge([99, number], kind="pair", snr=snr, fault={"type": "listed"})
        observations, chains, case = made
        diagnosis = diagnose(chains, observations)
        assert len(diagnosis.causes) == 2, number
        assert score_answer(case, to_dict(diagnosis)) == "right", number


@pytest.mark.long
def test_sets_of_causes_are_compared_by_their_fits():
    """Fringes that are static are not given as fringes that drift, which need two numbers more.

    Nor is one retarder, free at each wavelength, given for a depolarizer with a smooth law beside
    fringes, which need fewer numbers.
    """
    for seed, number, snr in ((177, 423, 85.6), (178, 3, 49.7), (313, 151, 65.5)):
        making = np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2)[1]
        made = make_challenge(np.random.default_rng(making), kind="pair", snr=snr)
        observations, chains, case = made
        diagnosis = diagnose(chains, observations)
        assert score_answer(case, to_dict(diagnosis)) == "right", seed
        names = [cause.name for cause in diagnosis.causes]
        assert not any(name.startswith("fringes_drift") for name in names), (seed, names)


@pytest.mark.slow
def test_what_an_exchange_makes_superfluous_goes():
    """A retarder at any axis is one, and no second cause beside it halves its probability."""
    wavelength = np.linspace(0.5, 0.8, 6) * u.um
    frames = QTable({"pol": np.repeat(np.arange(0, 180, 30), 16) * u.deg})
    frames["qwp"] = np.tile(np.arange(16) * 22.5, 6) * u.deg
    plate = optics.LinearRetarder(retardance=np.full(6, 90.0) * u.deg, mount="qwp", name="qwp")
    nominal = optics.LinearPolarizer(mount="pol", name="pol") | plate
    nominal = nominal | optics.WollastonPrism(efficiency=np.full(6, 0.97), name="wollaston")
    film = optics.LinearRetarder(retardance=2 * u.deg, theta=30 * u.deg, name="film")
    seen = simulate(insert_optic(nominal, film, after="qwp"), wavelength, frames, seed=11)
    found = diagnose(nominal, seen, cross_validate=False)
    assert [cause.name for cause in found.causes] == ["static_retarder"]
    assert found.causes[0].probability > 0.9


@pytest.mark.slow
def test_two_components_that_drift_together_are_one_optic():
    """An optic between the axes, such as one under stress, is in the table."""
    setup = SETUPS["charis"]()
    cells = [Cell("after:hwp", f"retardance_{axis}", "time") for axis in "hd"]
    setup.truth = setup.with_cell(cells[0], 0.03)
    found = chosen(setup, setup.observed(setup.with_cell(cells[1], 0.04), seed=2))
    assert {group.best.name for group in found.groups} == {cell.name for cell in cells}
    assert all(group.probability > 0.9 for group in found.groups)


@pytest.mark.slow
def test_an_axis_that_turns_is_told_in_the_other_frame_too():
    """A beam that circles on a mirror downstream turns its axis as an optic on the stage could."""
    setup, own = SETUPS["charis"](), "harmonic:derotator:1"
    axis = {
        place: [Cell(f"{place}:derotator", f"diattenuation_{kind}", own) for kind in "hd"]
        for place in ("in", "after")
    }
    setup.truth = setup.with_cell(axis["after"][0], 0.01, 0.0)
    found = chosen(setup, setup.observed(setup.with_cell(axis["after"][1], 0.0, 0.01), seed=2))
    assert len(found.groups) == 2
    for group in found.groups:
        assert {f"{cells[0].place}/{group.best.cell.kind}/{own}" for cells in axis.values()} <= set(
            names(group)
        )


@pytest.mark.slow
def test_a_bright_lamp_shows_what_is_far_smaller_than_usual():
    """Of a static retarder of 0.05 deg: sizes that data tell are no reason against a cause."""
    charis, sources = instruments.get("charis"), ("polarized", "unpolarized")
    grid = np.linspace(1160, 2370, 6) * u.nm
    nominal = [charis.chain(one, derotator="linear", wavelength=grid) for one in sources]
    window = {"horizontal": 0.032 * u.deg, "diagonal": 0.038 * u.deg}
    window = optics.EllipticalRetarder(**window, name="window")
    frames = half_wave_plate_cycles(derotator=np.linspace(45, 132.5, 8) * u.deg)
    seen = [
        simulate(
            insert_optic(chain, window, after="hwp"), grid, frames,
            flux=1e7, seed=3 + 10 * i, name=name, meta={"source": name},
        )
        for i, (chain, name) in enumerate(zip(nominal, sources, strict=True))
    ]  # fmt: skip
    found = diagnose(nominal, seen, cross_validate=False)
    (cause,) = found.causes
    assert cause.probability > 0.9
    assert "static_retarder:hwp" in [cause.name, *(one.name for one, _ in cause.aliases)]
