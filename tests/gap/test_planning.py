# Licensed under a 3-clause BSD style license - see LICENSE
"""What to observe next: what is proposed tells apart what it says, as far as it says."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from gap_data import WAVELENGTH, chain, fitted, frames, observed, with_effect

from astropolcal import instruments
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import Context, get_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.planning import Exposure, Forecast, expected, exposures, plan
from astropolcal.observations import Observations
from astropolcal.reduction.cubes import both_states
from astropolcal.simulation import half_wave_plate_cycles, simulate

PAIR = ("source_circular", "static_retarder")
CYCLE = tuple(np.arange(8) * 11.25)


@pytest.fixture(scope="module")
def model():
    return fitted(observed(with_effect(PAIR[0], retardance=1.5)))


@pytest.fixture(scope="module")
def full(model):
    return model.with_effect(get_effect(PAIR[0]))


def answer(model, causes=(), p=1.0, courses=()):
    return SimpleNamespace(
        improved=model,
        causes=causes,
        remainder_p_value=p,
        courses=courses,
        verdict="unexplained",
    )


def asked(model, *members, p=1.0):
    """Return a diagnosis that cannot tell some causes apart: effects and their probabilities."""
    first, *others = ((get_effect(one), share) for one, share in members)
    alias = [(SimpleNamespace(name=e.name, cell=None, recipe=(e, None)), c) for e, c in others]
    cause = SimpleNamespace(
        effect=first[0],
        name=first[0].name,
        cell=None,
        share=first[1],
        aliases=alias,
        probability=0.9,
    )
    return answer(model, [cause], p)


def even(model, *effects):
    return asked(model, *((one, 1 / len(effects)) for one in effects))


def open_only(model):
    return answer(model)


def test_aliases_are_told_apart(full):
    (found,) = plan(even(full, *PAIR))
    assert found["question"] == "cause"
    assert found["separates"] == list(PAIR)
    assert found["probability_now"] == pytest.approx(0.5)
    assert found["probability_after"] > 0.8
    assert found["words"].startswith("Take ")
    assert all(f"({name})" in found["words"] for name in PAIR)


def test_a_run_is_repeated_at_its_own_wavelengths():
    true = with_effect(PAIR[0], retardance=1.5)
    one, other = (observed(true, seed=seed) for seed in (1, 2))
    runs = [one.select_bins(np.arange(7) < 3), other.select_bins(np.arange(7) > 2)]
    (found,) = plan(even(fitted(runs).with_effect(get_effect(PAIR[0])), *PAIR))
    assert found["probability_after"] > 0.8


def test_what_is_the_same_everywhere_is_said_to_be(full):
    """A gain of one beam against the other is the same whatever name it has."""
    same = get_effect("beam_gain")
    again = same.changed(name="other_gain", title="another gain")
    (found,) = plan(asked(full.with_effect(same), (same, 0.6), (again, 0.4)))
    assert found["words"].startswith("No exposure that was tried tells")
    assert found["gain"] == 0
    assert found["probability_after"] == found["probability_now"] == pytest.approx(0.52)


def test_causes_of_a_source_are_not_told_apart_without_its_optic():
    """Of a chain that begins with the plate no diagnosis asks for causes upstream of it."""
    where, out = {"hwp": CYCLE, "derotator": 165.0}, ("calibration_polarizer",)
    waves = [f"harmonic:derotator:{n}" for n in (1, 2)]
    cells = [CellEffect(Cell("source", "diattenuation_d", wave), 0) for wave in waves]
    true = cells[0].edit([chain()], Context(WAVELENGTH.to_value(u.um))).chains[0]
    true["gap_source_diattenuation_d_harmonic_derotator_1"].amplitude = np.full(7, 0.01)
    full = fitted(observed(true)).with_effect(cells[0])
    found = [
        plan(even(full, *cells), candidates=[Exposure(0, where, without=one)])[0]
        for one in ((), out)
    ]
    assert found[0]["probability_after"] > 0.9
    assert found[1]["probability_after"] == found[1]["probability_now"]


def test_what_happened_at_a_frame_is_not_expected_in_another_run(model):
    steps = [CellEffect(Cell("after:hwp", "rotation", f"step:{n}"), 0) for n in (14, 15)]
    assert plan(even(model.with_effect(steps[0]), *steps)) == []


def test_a_brighter_lamp_tells_more(full):
    where = {"hwp": CYCLE, "derotator": 150.0}
    gains = [
        plan(even(full, *PAIR), candidates=[Exposure(0, where, lamp=lamp)]) for lamp in (1.0, 4.0)
    ]
    one, four = (entries[0]["gain"] for entries in gains)
    assert 1.2 * one < four < 2.01 * one


DRIFTS = [
    CellEffect(Cell("after:hwp", "rotation", text), 0) for text in ("time", "harmonic:derotator:1")
]


def drifting(order=None):
    """Return data, without noise, of light that is turned by 0.01 rad in the run, in some order."""
    table = frames()
    table["sequence"] = np.linspace(0, 1, len(table))
    taken = table if order is None else table[order]
    taken["sequence"] = np.linspace(0, 1, len(table))
    edited = DRIFTS[0].edit([chain()], Context(WAVELENGTH.to_value(u.um))).chains[0]
    edited["gap_after_hwp_rotation_time"].amplitude = np.full(len(WAVELENGTH), 0.01)
    data = observed(edited, table=taken, noise=False).to_table()
    data.remove_column("sequence")
    return Observations.from_table(data, name="lamp")


def test_time_and_derotator_are_told_apart_by_another_order():
    """The derotator moves once in the run and knows it as well as time; shuffled it does not."""
    model = fitted(drifting()).with_effect(DRIFTS[0])
    runs = [one for one in exposures(model) if one.what]
    entries = {one.what: plan(even(model, *DRIFTS), candidates=[one])[0] for one in runs}
    again, shuffled = (
        entries["the run of lamp again"],
        entries["the frames of lamp in shuffled order"],
    )
    assert again["gain"] < 0.5 * shuffled["gain"]
    assert shuffled["probability_after"] > 0.95
    # taken so, and fitted, they are as far apart as foreseen
    order = np.random.default_rng(len(frames())).permutation(len(frames()))
    both = [drifting(), drifting(order)]
    missed = [
        fitted(data, [chain()] * len(data)).with_effect(DRIFTS[1]).fit.chi2
        for data in (both, both[:1])
    ]
    assert shuffled["gain"] == pytest.approx(np.sqrt(missed[0] - missed[1]), rel=0.3)


def test_the_expected_probability():
    """Two causes that nothing tells apart stay as they are; the others lose what is told apart."""
    weights = np.array([0.7, 0.3])
    assert expected(weights, np.zeros((2, 2))) == pytest.approx(0.58)
    apart = np.array([[0.0, 50.0], [50.0, 0.0]])
    assert expected(weights, apart) == pytest.approx(1.0)
    # what is not asked about may still be it: the true one of two of 0.4 shares with 0.2
    assert expected(np.array([0.4, 0.4]), apart) == pytest.approx(0.4 / 0.6)


def elliptical(angles):
    true = instruments.get("charis").chain(wavelength=WAVELENGTH, derotator="elliptical")
    table = half_wave_plate_cycles(derotator=angles * u.deg)
    return fitted(observed(true, table=table), [true])


@pytest.mark.slow
def test_open_directions_are_fixed_by_another_derotator_angle():
    (found,) = plan(open_only(elliptical([60])))
    assert found["question"] == "parameters"
    assert "open directions" in found["words"]
    assert all(name.startswith("derotator.") for name in found["separates"])
    same = Exposure(0, {"hwp": CYCLE, "derotator": 60.0})
    assert plan(open_only(elliptical([60])), candidates=[same]) == []


def test_what_no_exposure_fixes_is_not_promised():
    """A common rotation of what is in front of the derotator stays open whatever is taken."""
    assert plan(open_only(elliptical([45, 70, 95, 120]))) == []


def test_exposures_are_what_can_be_changed(model):
    found = exposures(model, flux_matters=True)
    assert {one.polarizer_turned for one in found} == {0.0, 45.0}
    assert {one.lamp for one in found} == {0.5, 1.0, 2.0}
    assert {one.without for one in found} == {(), ("calibration_polarizer",)}
    assert any(max(one.positions["hwp"]) > 300 for one in found)
    words = " ".join(one.words for one in found)
    assert "again" in words
    assert "shuffled order" in words
    assert "backwards" in words
    bare = instruments.get("charis").chain("unpolarized", wavelength=WAVELENGTH, derotator="linear")
    both = exposures(fitted([observed(), observed(bare, seed=2)], [chain(), bare]))
    assert {one.without for one in both} == {()}
    assert {one.dataset for one in both} == {0, 1}


def test_a_modulator_has_both_states():
    fields = [610, 670, 720] * u.nm
    true = instruments.get("vampires").chain(wavelength=fields, derotator="linear")
    table = both_states(half_wave_plate_cycles(derotator=[45, 60] * u.deg))
    meta = {"instrument": "vampires", "source": "polarized", "pairing": "flc_state"}
    modulated = fitted(simulate(true, fields, table, seed=1, meta=meta, name="lamp"), [true])
    found = exposures(modulated)
    assert {one.states for one in found} == {("A", "B")}
    one = found[0]
    assert one.n_frames == 2 * len(one.positions["hwp"])
    assert one.angles["hwp"][:4].tolist() == [0, 0, 11.25, 11.25]
    assert one.states == ("A", "B")
    entries = plan(even(modulated.with_effect(get_effect(PAIR[0])), *PAIR), candidates=found)
    assert entries[0]["question"] == "cause"


def test_structure_without_a_cause_wants_the_run_again(model):
    """Residuals that nothing explains: repetitions tell structure from noise larger than stated."""
    unexplained = answer(model, p=1e-20)
    (found,) = plan(unexplained)
    assert found["question"] == "structure"
    assert found["words"].startswith("Take the run of lamp 3 times")
    assert found["gain"] > 3
    assert (found["probability_now"], found["probability_after"]) == (
        0.5,
        pytest.approx(1, abs=0.01),
    )
    assert plan(answer(model, p=0.5)) == []


def test_a_course_wants_another_order_and_an_improbable_cause_nothing(full):
    def course(wave):
        wave = np.array(wave, dtype=float)
        return SimpleNamespace(wave=[wave], std=[np.where(wave == 9, np.inf, 0.2)])

    improbable = even(full, *PAIR).causes
    improbable[0].probability = 0.01
    (found,) = plan(answer(full, improbable, courses=[course(np.repeat([0, 1, 0], 8))]))
    assert found["exposure"] == "Take the frames of lamp in shuffled order"
    assert found["question"] == "structure"
    assert found["gain"] > 3
    assert found["probability_now"] == pytest.approx(1 / 3)
    assert found["probability_after"] > 0.95
    # what is the same in all frames is so in any order, and a frame that tells nothing is none
    for wave in (np.ones(24), 0.05 * np.repeat([0, 1, 0], 8), np.repeat([0, 9, 0], 8)):
        assert plan(answer(full, improbable, courses=[course(wave)])) == []
    assert plan(answer(full, improbable)) == []


def test_the_run_to_take_again_is_that_with_most_structure_in_its_data():
    """Masked frames make it no smaller."""
    sizes = {"less": 0.01, "run: more": 0.015}
    runs = [observed(with_effect("beam_gain", imbalance=size), name=n) for n, size in sizes.items()]
    half = np.tile((np.arange(32) % 2 == 0)[:, None], len(WAVELENGTH))
    model = fitted([runs[0], runs[1].with_mask(half, "clouds")])
    (found,) = plan(answer(model, p=1e-20))
    assert found["exposure"] == "Take the run of run: more 3 times"
    assert found["words"].startswith(f"{found['exposure']}: tells structure")


def test_what_frees_a_parameter_counts_from_where_it_was_held():
    """An orientation beyond its bound, against a rotation of the light behind the plate."""
    true, narrow = chain(), chain()
    true["hwp"].theta = 2 * u.deg
    narrow["hwp"].theta.bounds = (-0.5, 0.5)
    narrow["calibration_polarizer"].theta.fixed = narrow["derotator"].theta.fixed = True
    full = fitted(observed(true), [narrow]).with_effect(get_effect("hwp_angle_bound"))
    rotation = CellEffect(Cell("after:hwp", "rotation", "constant"), 0)
    forecast = Forecast(full, [(get_effect("hwp_angle_bound"), None), (rotation, None)])
    held, turned = forecast.foreseen(["hwp_angle_bound", rotation.name])
    own = forecast.own["hwp_angle_bound"]
    # beyond the bound at which it was held, not beyond zero
    assert np.rad2deg(forecast.value / forecast.scale)[own] == pytest.approx(1.5, abs=0.3)
    assert np.rad2deg(held[2] / forecast.scale)[own] == pytest.approx(1.5, abs=0.3)
    size = np.rad2deg(turned[2] / forecast.scale)[forecast.own[rotation.name]]
    assert np.abs(size) == pytest.approx(3.0, abs=0.6)
