# Licensed under a 3-clause BSD style license - see LICENSE
"""Scan, selection, verdict: on planted effects, on none, and on bad input."""

import json

import astropy.units as u
import gap_data as data
import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.exceptions import GapError
from astropolcal.gap import EFFECTS, diagnose, frame_groups, held_out, scan
from astropolcal.gap.attribution import choose, false_discovery
from astropolcal.observations import Observations


@pytest.mark.parametrize("seed", range(3))
def test_clean_data_have_no_gap(seed):
    found = diagnose(data.chain(), data.observed(seed=seed))
    assert (found.verdict, found.causes) == ("none", [])
    assert found.gap_before_percent == pytest.approx(found.noise_floor_percent, rel=0.25)


def test_score_predicts_what_the_full_fit_gains():
    true = data.with_effect("hwp_diattenuation", diattenuation=0.002)
    model = data.fitted(data.observed(true, flux=1e7))
    (score,) = scan(model, [EFFECTS["hwp_diattenuation"]])
    better = model.with_effect(EFFECTS["hwp_diattenuation"])
    assert score.statistic > 50
    assert score.statistic == pytest.approx(model.fit.chi2 - better.fit.chi2, rel=0.02)


@pytest.mark.slow
def test_scores_of_noise_are_chi_square():
    """The p-values of many seeds are uniform."""
    effects = [EFFECTS["hwp_diattenuation"], EFFECTS["derotator_encoder"]]
    p_values = [
        score.single_p for seed in range(12) for score in scan(data.clean_model(seed), effects)
    ]
    assert 0.3 < np.mean(p_values) < 0.7
    assert np.min(p_values) > 1e-3


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("beam_gain", {"imbalance": 0.005}),
        ("derotator_diattenuation", {"diattenuation": 0.005}),
        ("hwp_encoder_eccentricity", {"cosine": 0.2}),
    ],
)
def test_planted_effect_is_found_and_its_gap_closed(name, values):
    true = data.with_effect(name, **values)
    if name == "hwp_encoder_eccentricity":
        # what stands behind the plate undoes the turn
        true[f"gap_{name}_back"].cosine = -values["cosine"] * u.deg
    found = diagnose(data.chain(), data.observed(true, flux=1e7))
    assert found.verdict == "effect"
    top = found.causes[0]
    assert name in {top.name, *top.aliases}
    assert top.physical
    assert top.explained > 0.9
    assert found.gap_after_percent < 1.2 * found.noise_floor_percent
    value, low, high = found.held_out[0].shrinkage(found.held_out[-1])
    assert 0 < low <= value <= high


def test_what_no_effect_explains_stays_unexplained():
    rng = np.random.default_rng(2)
    observations = data.observed(flux=1e7)
    # a shift of each frame by itself, that no optic makes
    shifted = data.with_flux(observations, 1 + 0.02 * rng.choice([-1, 1], observations.n_frames))
    found = diagnose(data.chain(), shifted)
    assert found.verdict == "unexplained"
    assert sum(cause.explained for cause in found.causes) < 0.5
    assert found.remainder_p_value < 1e-4


def test_wrong_parity_is_a_discrete_cause():
    observations = data.observed(flux=1e7)
    chain = data.chain()
    wrong = EFFECTS["mirror_flip"].edit([chain], None).chains[0]
    found = diagnose(wrong, observations)
    assert found.verdict == "effect"
    assert found.causes[0].effect.kind == "discrete"
    equal = [found.causes[0].name, *found.causes[0].aliases]
    # they cannot be told apart, so they come in the order of the library
    assert "mirror_flip" in equal
    assert equal == [name for name in EFFECTS if name in equal]


def test_held_out_errors_of_a_right_model_are_noise():
    observations = data.observed()
    model = data.clean_model()
    errors = held_out(model, frame_groups([observations]))
    assert errors.labels == [f"derotator at {a:g} deg" for a in data.DEROTATOR.value]
    assert 0.7 < errors.chi2 < 2.0


def test_without_left_out_frames_the_gap_is_that_of_the_fit():
    found = diagnose(data.chain(), data.observed(), cross_validate=False)
    assert found.held_out == []
    assert found.gap_before_percent == found.gap_after_percent
    assert found.gap_before_percent == pytest.approx(found.noise_floor_percent, rel=0.25)


def test_calibration_from_a_file(tmp_path):
    from astropolcal import Calibration, calibrate

    observations = data.observed()
    calibrate(data.chain(), observations).write(tmp_path / "cal.asdf")
    found = diagnose(Calibration.read(tmp_path / "cal.asdf"), observations)
    assert found.verdict == "none"


def test_nothing_significant_chooses_nothing():
    model = data.clean_model()
    assert choose(model, scan(model, [EFFECTS["beam_gain"]])) is None


def test_false_discovery_is_monotone_and_no_smaller():
    p_values = [1e-6, 1e-3, 0.2, 0.9]
    found = false_discovery(p_values)
    assert all(f >= p for f, p in zip(found, p_values, strict=True))
    assert found == sorted(found)


# ---- bad input -----------------------------------------------------------------------------


def test_too_few_groups_are_refused():
    from astropolcal.simulation import half_wave_plate_cycles

    short = data.observed(table=half_wave_plate_cycles(derotator=[45] * u.deg))
    with pytest.raises(GapError, match="too few frames to leave out in groups: 8 in the shortest"):
        diagnose(data.chain(), short)


def test_unknown_effect_is_refused():
    with pytest.raises(GapError, match=r"no effect 'beam_gian'.*did you mean 'beam_gain'"):
        diagnose(data.chain(), data.observed(), effects=["beam_gian"])


def test_no_effects_are_refused():
    with pytest.raises(GapError, match="no effects to ask for"):
        diagnose(data.chain(), data.observed(), effects=[])


def test_datasets_of_two_instruments_are_refused():
    one = data.observed(meta={"instrument": "CHARIS"})
    other = data.observed(seed=2, meta={"instrument": "IRDIS"})
    with pytest.raises(GapError, match="of different instruments: CHARIS, IRDIS"):
        diagnose(data.chain(), [one, other])


def test_fit_that_did_not_converge_is_refused(monkeypatch):
    from astropolcal.gap import alternatives

    real = alternatives.nominal_calibration

    def stopped(chains, observations):
        found = real(chains, observations)
        found.fit["converged"] = False
        return found

    monkeypatch.setattr(alternatives, "nominal_calibration", stopped)
    with pytest.raises(GapError, match="the nominal fit did not converge"):
        diagnose(data.chain(), data.observed())


# ---- the cases with a key ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("case", ["case000", "case004", "case009", "case015", "case026"])
def test_case_with_a_key(shared_data, case):
    folder = shared_data / "gap-cases"
    key = json.loads((folder / "key.json").read_text())[case]
    observations = [
        Observations.read(folder / case / f"{name}.ecsv") for name in ("polarized", "unpolarized")
    ]
    chains = instruments.get("charis").chains_for(observations, derotator="linear")
    found = diagnose(chains, observations)
    if key["effect"] == "none" or key["absorbed"]:
        assert found.verdict == "none"
    elif key["effect"].startswith("unlisted"):
        assert found.verdict == "unexplained"
    else:
        assert found.verdict == "effect"
        good = {key["effect"]} | {e for e, s in key["alternatives"].items() if s >= 0.95}
        assert good & {found.causes[0].name, *found.causes[0].aliases}
