# Licensed under a 3-clause BSD style license - see LICENSE
"""What to observe next: predicted separations are those that new data give."""

import astropy.units as u
import numpy as np
import pytest
from gap_data import WAVELENGTH, chain, fitted, observed, with_effect

from astropolcal import instruments
from astropolcal.exceptions import GapError, ParameterError
from astropolcal.gap import _forecast
from astropolcal.gap.effects import get_effect
from astropolcal.gap.planning import Exposure, exposures, few, plan
from astropolcal.reduction.cubes import both_states
from astropolcal.simulation import half_wave_plate_cycles, simulate

PAIR = ("source_circular", "static_retarder")


@pytest.fixture(scope="module")
def model():
    return fitted(observed(with_effect("source_circular", retardance=1.5)))


@pytest.fixture(scope="module")
def members(model):
    return {name: model.with_effect(get_effect(name)) for name in PAIR}


def test_plan_ranks_by_gain(model, members):
    found = plan(model, members=members, limit=4)
    gains = [entry["gain"] for entry in found]
    assert gains == sorted(gains, reverse=True)
    assert 1 <= len(found) <= 4
    for entry in found:
        assert set(entry) == {"words", "separates", "gain"}
        assert set(entry["separates"]) <= {*PAIR, *model.problem.names}
        assert entry["words"].startswith("Take 8 half-wave-plate angles")


def test_predicted_separation_is_that_of_new_data(model, members):
    """Take the exposure, without noise, and fit both: chi-square differs as predicted."""
    exposure = Exposure(0, tuple(np.arange(8) * 11.25), (("derotator", 150.0),))
    truth, other = members["source_circular"], members["static_retarder"]
    (entry,) = [
        e
        for e in plan(model, members=members, candidates=[exposure])
        if set(e["separates"]) == set(PAIR)
    ]
    angles = [45, 70, 95, 120] * u.deg
    old = half_wave_plate_cycles(np.arange(8) * 11.25 * u.deg, angles)
    new = half_wave_plate_cycles(np.arange(8) * 11.25 * u.deg, [150] * u.deg)

    def missed(tables):
        data = [observed(truth.chains[0], table=t, noise=False) for t in tables]
        base = fitted(data, [c for c in [chain()] * len(data)])
        return base.with_effect(get_effect(other_name)).fit.chi2

    other_name = next(iter(other.added))
    gained = missed([old, new]) - missed([old])
    # the lesser of both directions is predicted, and the noise settles a little differently
    assert entry["gain"] <= 1.5 * np.sqrt(gained)
    assert entry["gain"] > 0.3 * np.sqrt(gained)


def test_identical_effects_cannot_be_separated(model, members):
    one = members["source_circular"]
    assert not [e for e in plan(model, members={"a": one, "b": one}) if "a" in e["separates"]]


def test_a_brighter_lamp_tells_more(model, members):
    base = Exposure(0, tuple(np.arange(8) * 11.25), (("derotator", 150.0),))
    brighter = Exposure(0, base.hwp, base.positions, lamp=4.0)
    gains = {
        lamp: plan(model, members=members, candidates=[one])[0]["gain"]
        for lamp, one in ((1, base), (4, brighter))
    }
    assert 1.2 * gains[1] < gains[4] < 2.01 * gains[1]


def test_candidates_cover_what_can_be_changed(model):
    kinds = exposures(model, flux_matters=True)
    assert {one.polarizer_turned for one in kinds} == {0.0, 45.0}
    assert {one.lamp for one in kinds} == {0.5, 1.0, 2.0}
    assert ("calibration_polarizer",) in {one.without for one in kinds}
    assert any(max(one.hwp) > 300 for one in kinds)


def test_polarizer_is_taken_out_only_where_no_dataset_is_without_it():
    charis = instruments.get("charis")
    bare = charis.chain("unpolarized", wavelength=WAVELENGTH, derotator="linear")
    both = fitted([observed(), observed(bare, seed=2)], [chain(), bare])
    assert {one.without for one in exposures(both)} == {()}
    assert {one.dataset for one in exposures(both)} == {0, 1}


def elliptical(angles):
    true = instruments.get("charis").chain(wavelength=WAVELENGTH, derotator="elliptical")
    table = half_wave_plate_cycles(derotator=angles * u.deg)
    return fitted(observed(true, table=table), [true])


def test_open_directions_are_fixed_by_another_derotator_angle():
    found = plan(elliptical([60]))
    assert found
    assert "fixes" in found[0]["words"]
    assert "open directions" in found[0]["words"]
    assert all(name.startswith("derotator.") for name in found[0]["separates"])
    same = Exposure(0, tuple(np.arange(8) * 11.25), (("derotator", 60.0),))
    assert plan(elliptical([60]), candidates=[same]) == []


def test_what_no_exposure_fixes_is_not_promised():
    """A common rotation of what is in front of the derotator stays open whatever is taken."""
    assert plan(elliptical([45, 70, 95, 120])) == []


@pytest.mark.parametrize(
    ("exposure", "message"),
    [
        (Exposure(3, (0.0,)), "dataset 3"),
        (Exposure(0, ()), "half-wave-plate angles"),
        (Exposure(0, (np.nan,)), "half-wave-plate angles"),
        (Exposure(0, (0.0,), lamp=0.0), "lamp = 0"),
    ],
)
def test_impossible_exposures(model, exposure, message):
    with pytest.raises(GapError, match=message):
        plan(model, candidates=[exposure])


def test_unknown_effect(model):
    with pytest.raises(GapError):
        plan(model, ["no_such_effect"])


@pytest.mark.parametrize(("argument", "foresees"), [("chain", True), (None, False)])
def test_where_a_model_is_not_physical_it_foresees_nothing(
    model, members, monkeypatch, argument, foresees
):
    angles = tuple(np.arange(8) * 11.25)
    candidates = [Exposure(0, angles, (("derotator", angle),)) for angle in (10.0, 150.0)]
    candidates.append(Exposure(0, angles, (("derotator", 150.0),), lamp=2.0))

    def of_one(chain, wavelength, frames, **options):
        if options["flux"].max() > 1.5 * brightness:
            raise ParameterError("the chain gives negative flux", argument=argument)
        return simulate(chain, wavelength, frames, **options)

    seen = []
    monkeypatch.setattr(
        _forecast, "simulate", lambda *a, **k: seen.append(k["flux"]) or simulate(*a, **k)
    )
    plan(model, members=members, candidates=candidates[:1])
    brightness = np.max(seen)
    monkeypatch.setattr(_forecast, "simulate", of_one)
    if foresees:
        assert plan(model, members=members, candidates=candidates) == plan(
            model, members=members, candidates=candidates[:2]
        )
    else:
        with pytest.raises(ParameterError, match="negative flux"):
            plan(model, members=members, candidates=candidates)


def test_words_of_an_exposure():
    one = Exposure(0, (0.0, 45.0), (("derotator", 60.0),), lamp=2.0, without=("polarizer",))
    assert one.words == (
        "2 half-wave-plate angles from 0 to 45 deg, derotator at 60 deg, polarizer taken out, "
        "the lamp 2 times as bright"
    )
    turn = Exposure(0, (0.0, 56.25, 112.5, 337.5), lamp=0.5)
    assert "over a full turn (0, 56.25, 112.5, ... deg), the lamp half as bright" in turn.words


def test_exposures_for_one_purpose_differ_in_kind(model, members):
    found = plan(model, members=members)
    for_the_pair = [e for e in found if set(e["separates"]) == set(PAIR)]
    assert 1 <= len(for_the_pair) <= 2
    turned = ["polarizer" in e["words"] or "lamp" in e["words"] for e in for_the_pair]
    assert len(set(turned)) == len(turned)
    assert all(f"({name})" in for_the_pair[0]["words"] for name in PAIR)
    assert get_effect(PAIR[0]).title in for_the_pair[0]["words"]


def entry(words, separates, gain):
    return {"words": f"Take {words}", "separates": separates, "gain": gain}


def test_several_plans_become_few():
    one = [entry(f"x{i}: tells a from b", ["a", "b"], 30.0 - i) for i in range(5)]
    two = [entry(f"y{i}: tells c from d", ["c", "d"], 9.0 - i) for i in range(5)]
    found = few([*one, *two], limit=3)
    assert [e["gain"] for e in found] == [30.0, 29.0, 9.0]
    assert few([]) == []
    # two causes may be aliases of each other
    assert [e["gain"] for e in few([one[0], one[0], one[1]])] == [30.0, 29.0]


def test_an_exposure_with_two_purposes_is_named_once():
    one, two = entry("x: tells a from b", ["a", "b"], 9.0), entry("x: fixes c", ["c"], 5.0)
    (both,) = few([two, one])
    assert both["words"] == "Take x: tells a from b; fixes c"
    assert (both["separates"], both["gain"]) == (["a", "b", "c"], 9.0)


# --- instruments with a modulator ----------------------------------------------------------------

FIELDS = [610, 670, 720] * u.nm


@pytest.fixture(scope="module")
def modulated():
    vampires = instruments.get("vampires")
    true = vampires.chain(wavelength=FIELDS, derotator="linear")
    table = both_states(half_wave_plate_cycles(derotator=[45, 60] * u.deg))
    meta = {"instrument": "vampires", "source": "polarized", "pairing": "flc_state"}
    data = simulate(true, FIELDS, table, flux=1e6, seed=1, meta=meta, name="lamp")
    return fitted(data, [true])


def test_candidates_carry_the_state_of_the_modulator(modulated):
    found = exposures(modulated)
    assert found
    assert {one.states for one in found} == {("A", "B")}
    one = found[0]
    assert one.n_frames == 2 * len(one.hwp)
    assert one.plate[:4].tolist() == [0, 0, 11.25, 11.25]
    assert one.modulator[:4].tolist() == ["A", "B", "A", "B"]
    assert "8 half-wave-plate angles from 0 to 78.75 deg in states A and B of the" in one.words
    assert {one.states for one in exposures(fitted(observed()))} == {()}


def test_a_modulator_alone_is_no_reason_for_another_lamp(modulated):
    assert {one.lamp for one in exposures(modulated)} == {1.0}
    assert all("lamp" not in entry["words"] for entry in plan(modulated))


def test_both_states_tell_more_than_one(modulated):
    """The state that is left out cannot be made up for by the other."""
    hwp, where = tuple(np.arange(8) * 11.25), (("derotator", 110.0),)
    members = {name: modulated.with_effect(get_effect(name)) for name in PAIR}
    gains = {}
    for states in (("A",), ("B",), ("A", "B")):
        entries = plan(
            modulated, members=members, candidates=[Exposure(0, hwp, where, states=states)]
        )
        gains[states] = max(
            (e["gain"] for e in entries if set(e["separates"]) == set(PAIR)), default=0
        )
    assert gains["A", "B"] > max(gains[("A",)], gains[("B",)])
    assert gains["A", "B"] > 1


@pytest.mark.parametrize("states", [(), ("C",), ("A", "C")])
def test_states_that_an_exposure_cannot_have(modulated, states):
    with pytest.raises(GapError, match="states"):
        plan(modulated, candidates=[Exposure(0, (0.0, 45.0), (("derotator", 9.0),), states=states)])


def test_states_where_there_is_no_modulator(model):
    with pytest.raises(GapError, match="nowhere else"):
        plan(model, candidates=[Exposure(0, (0.0, 45.0), (("derotator", 9.0),), states=("A",))])
