"""Sealed challenges: what is made, how it is scored, and how a run goes on."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from astropolcal.exceptions import GapError
from astropolcal.gap.challenge import ChallengeResult, Key, Setup, make_challenge, run_challenge
from astropolcal.gap.effects import get_effect
from astropolcal.gap.model import nominal_model

SMALL = Setup(n_wavelengths=5, n_derotator=4)
RUN = {"setup": SMALL, "kinds": ["single", "none"], "snr": (40, 60)}

pytestmark = pytest.mark.filterwarnings("ignore::astropolcal.exceptions.AstropolcalWarning")


@pytest.fixture(scope="module")
def result():
    return run_challenge(3, 5, **RUN)


def record(kind="single", right=True, snr=20.0, **more):
    effects = {"none": [], "pair": ["a", "b"]}.get(kind, ["a"])
    return {
        "index": 0,
        "kind": kind,
        "effects": effects,
        "snr": [snr] * len(effects),
        "verdict": "effect",
        "causes": [["a"]],
        "right": right,
        **more,
    }


# ---- what is made -----------------------------------------------------------------------------


def test_a_seed_makes_the_same_challenge_again():
    (one, _, key), (two, _, other), (three, _, _) = (
        make_challenge(seed, effect="beam_gain", setup=SMALL) for seed in (3, 3, 4)
    )
    assert [o.content_hash for o in one] == [o.content_hash for o in two]
    np.testing.assert_equal(key.values, other.values)
    assert one[0].content_hash != three[0].content_hash


@pytest.mark.parametrize("effect", ["beam_gain", "hwp_diattenuation"])
def test_the_effect_stands_out_as_asked_in_noisy_data_too(effect):
    data, chains, key = make_challenge(6, effect=effect, snr=40, setup=SMALL)
    assert key.snr[0] == pytest.approx(40, rel=0.03)
    without = nominal_model(chains, data)
    with_it = without.with_effect(get_effect(effect))
    # the noise moves the square root of chi-square by one
    assert np.sqrt(without.fit.chi2 - with_it.fit.chi2) == pytest.approx(40, abs=6)


def test_an_effect_of_the_flux_has_the_size_in_the_key():
    effect = get_effect("detector_nonlinearity")
    data, chains, key = make_challenge(6, effect=effect.name, snr=40, setup=SMALL)
    fitted = nominal_model(chains, data).with_effect(effect)
    ((value, error, *_),) = fitted.sizes(effect.name).values()
    true = np.mean(key.values[0]["gap_detector_nonlinearity.right"])
    assert abs(true) > 10 * error[0]
    assert value[0] == pytest.approx(true, abs=4 * error[0])


def test_nominal_chains_do_not_hold_the_truth():
    _, chains, key = make_challenge(7, kind="none", setup=SMALL)
    for nominal, true in zip(chains, key.chains, strict=True):
        assert nominal["hwp"].w_sio2.value != true["hwp"].w_sio2.value
        assert not np.any(nominal["wollaston"].efficiency == true["wollaston"].efficiency)
    # what both datasets share is the same in both
    assert key.chains[0]["hwp"].w_sio2.value == key.chains[1]["hwp"].w_sio2.value


def test_an_absorbed_effect_leaves_no_gap():
    data, chains, key = make_challenge(6, kind="absorbed", effect="beam_crosstalk", setup=SMALL)
    assert key.snr[0] < 0.5
    model = nominal_model(chains, data)
    assert model.fit.chi2 < model.problem.n_data + 5 * np.sqrt(2 * model.problem.n_data)


def test_two_effects_can_be_told_from_each_other():
    _, _, key = make_challenge(11, kind="pair", snr=30, setup=SMALL)
    assert len(set(key.effects)) == 2
    assert not key.accepted[0] & key.accepted[1]


def test_a_withheld_effect_is_not_in_the_library():
    _, _, key = make_challenge(8, kind="withheld", effect="hwp_diattenuation", setup=SMALL)
    assert key.effects[0] not in key.library
    shares = key.alternatives[0]
    assert max(shares.get(name, 0.0) for name in key.library) < 0.3


def test_what_is_unlisted_is_explained_by_no_effect():
    _, _, key = make_challenge(9, kind="unlisted", effect="beam_flicker", setup=SMALL)
    assert key.effects == ["unlisted_beam_flicker"]
    assert max(key.alternatives[0].values()) < 0.3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "odd"}, "allowed are single"),
        ({"snr": -1}, "must be finite and positive"),
        ({"effect": "beam_gian"}, "did you mean 'beam_gain'"),
        ({"kind": "unlisted", "effect": "odd"}, "there are"),
        ({"kind": "absorbed", "effect": "mirror_flip"}, "no effect found"),
        ({"kind": "pair", "snr": 1e-3}, "no two effects found for a challenge of kind pair"),
    ],
)
def test_what_cannot_be_made_is_refused(options, words):
    with pytest.raises(GapError, match=words):
        make_challenge(1, setup=SMALL, **options)


def test_a_setup_that_is_too_small_is_refused():
    with pytest.raises(GapError, match="n_derotator = 2"):
        Setup(n_derotator=2)


# ---- how it is scored -------------------------------------------------------------------------


def test_aliases_are_accepted_from_their_share():
    key = Key("single", ["a"], [9.0], [{"b": 0.96, "c": 0.94}], [{}])
    assert key.accepted == [{"a", "b"}]


def test_rates_count_only_the_range_asked_for():
    records = [record(right=True, snr=20), record(right=False, snr=5), record("none", right=True)]
    result = ChallengeResult(records, {"snr": [3, 30]})
    assert result.rate("single", least=8)[0] == 1
    assert result.rate("single")[0] == 0.5
    assert result.rate("single", below=8)[3] == 1
    assert result.rate("none", least=8)[3] == 1
    assert np.isnan(result.rate("pair")[0])
    assert result.failures == [records[1]]


def test_the_interval_of_a_rate_holds_it_and_narrows():
    few, many = (ChallengeResult([record()] * n, {}).rate("single") for n in (3, 300))
    assert few[1] < many[1] < few[0] == few[2] == 1


def test_shrinkage_is_that_over_the_oracle():
    halfway = record(gap_percent=[2.0, np.sqrt(2.0), np.sqrt(0.4)], pulls=[0.5, -2.0])
    result = ChallengeResult([halfway], {})
    assert result.shrinkage_ratio() == pytest.approx(0.5 / 0.9)
    assert result.summary()["rates"]["coverage of sizes"]["value"] == 0.5


def test_a_run_finds_what_is_there(result):
    assert [r["right"] for r in result.records] == [True] * 3
    table = result.table
    assert len(table) == 3
    named = table["kind"] == "single"
    assert np.all(table["snr"][named] > 35)
    assert np.all(table["gap_after"][named] < table["gap_before"][named])
    assert "recall" in result.words()
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["settings"]["seed"] == 5


def test_the_figure_shows_each_kind_that_was_run(result):
    axes = result.plot().axes[0]
    assert axes.get_xlabel() == "signal-to-noise ratio of the weakest effect"
    labels = axes.get_legend_handles_labels()[1]
    assert sorted(label.split(",")[0] for label in labels) == ["nothing to be found", "one effect"]


# ---- how a run goes on ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_goes_on_where_it_was_killed(tmp_path, result, monkeypatch):
    path = tmp_path / "run.jsonl"
    run_challenge(2, 5, checkpoint=path, **RUN)
    whole = path.read_text()
    path.write_text(whole + '{"index": 2, "ki')
    made = []
    from astropolcal.gap import challenge

    original = challenge._run_one
    monkeypatch.setattr(challenge, "_run_one", lambda i, s: made.append(i) or original(i, s))
    again = run_challenge(3, 5, checkpoint=path, **RUN)
    assert made == [2]
    assert path.read_text().startswith(whole)
    drop = {"seconds"}
    for ours, theirs in zip(again.records, result.records, strict=True):
        assert {k: v for k, v in ours.items() if k not in drop} == {
            k: v for k, v in theirs.items() if k not in drop
        }


def test_a_checkpoint_of_another_run_is_refused(tmp_path, monkeypatch):
    from astropolcal.gap import challenge

    monkeypatch.setattr(challenge, "_run_one", lambda i, s: record() | {"index": i})
    path = tmp_path / "run.jsonl"
    run_challenge(1, 1, checkpoint=path)
    with pytest.raises(GapError, match="other settings \\(seed\\)"):
        run_challenge(1, 2, checkpoint=path)
    path.write_text("no json\n")
    with pytest.raises(GapError, match="is no checkpoint"):
        run_challenge(1, 1, checkpoint=path)


def test_an_executor_gives_the_same_records(monkeypatch):
    from astropolcal.gap import challenge

    monkeypatch.setattr(challenge, "_run_one", lambda i, s: record() | {"index": i})
    with ThreadPoolExecutor(2) as pool:
        spread = run_challenge(6, 1, client=pool)
    assert [r["index"] for r in spread.records] == list(range(6))


def test_a_diagnosis_that_fails_counts_as_wrong(monkeypatch):
    from astropolcal.gap import challenge

    def refuse(*args, **kwargs):
        raise GapError("did not converge")

    monkeypatch.setattr(challenge, "diagnose", refuse)
    found = run_challenge(1, 5, setup=SMALL, kinds=["none"])
    assert found.records[0]["verdict"] == "error"
    assert found.rate("none")[0] == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"n": 0}, "n = 0"),
        ({"n": 1, "seed": -1}, "seed = -1"),
        ({"n": 1, "kinds": ["odd"]}, "allowed are single"),
        ({"n": 1, "snr": (9, 3)}, "the lower first"),
    ],
)
def test_a_run_that_makes_no_sense_is_refused(options, words):
    with pytest.raises(GapError, match=words):
        run_challenge(**options)


@pytest.mark.slow
def test_a_cluster_of_dask_gives_the_same_answers():
    distributed = pytest.importorskip("distributed")
    small = Setup(n_wavelengths=5, n_derotator=4)
    here = run_challenge(2, seed=3, kinds=("single",), setup=small)
    with distributed.Client(processes=False, n_workers=1, dashboard_address=None) as client:
        there = run_challenge(2, seed=3, kinds=("single",), setup=small, client=client)
    timeless = [
        [{k: v for k, v in record.items() if k != "seconds"} for record in run.records]
        for run in (here, there)
    ]
    assert timeless[0] == timeless[1]


def test_progress_is_told_after_each_challenge(tmp_path):
    told, options = [], {"kinds": ["none"], "setup": SMALL, "checkpoint": tmp_path / "c.jsonl"}
    run_challenge(1, **options)
    run_challenge(2, **options, progress=lambda *numbers: told.append(numbers))
    assert told == [(2, 2)]
