# Licensed under a 3-clause BSD style license - see LICENSE
"""What many challenges tell together: rates, pulls, shrinkage, table, figure."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from astropolcal.gap._outcome import ChallengeResult, wilson


def record(index, kind="single", right=True, snr=(30.0,), **more):
    verdict = {"none": "none", "absorbed": "none"}.get(kind, "effect")
    return {
        "index": index,
        "kind": kind,
        "right": right,
        "verdict": verdict if right else "unexplained",
        "effects": ["beam_gain"] * len(snr),
        "snr": list(snr),
        "causes": [["beam_gain", "background"]] if right and snr else [],
    } | more


@pytest.fixture
def result():
    return ChallengeResult(
        [
            record(0, snr=[10.0], gap_percent=[2.0, 1.0, 1.0], pulls=[0.5, -2.0]),
            record(1, snr=[40.0], right=False, gap_percent=[2.0, 2.0, 1.0], pulls=[0.9]),
            record(2, snr=[4.0]),
            record(3, "pair", snr=[50.0, 35.0], gap_percent=[4.0, 1.0, 1.0]),
            record(4, "pair", snr=[50.0, 9.0], right=False),
            record(5, "none", snr=[]),
            record(6, "none", snr=[], right=False),
            record(7, "unlisted", snr=[25.0]),
            {"index": 8, "kind": "single", "verdict": "not made", "error": "too dark"},
        ],
        {"snr": [8.0, 128.0], "seed": 3},
    )


# ---- intervals -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("right", "n", "low", "high"),
    # Newcombe (1998), Statistics in Medicine 17, 857, table I, method 3
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_interval_of_wilson_at_95_percent(right, n, low, high):
    value, lower, upper = wilson(right, n, z=stats.norm.ppf(0.975))
    assert value == right / n
    assert (lower, upper) == pytest.approx((low, high), abs=6e-5)


@given(st.integers(1, 400), st.integers(0, 400))
def test_interval_holds_the_rate_and_ends_where_the_score_test_does(n, right):
    right = min(right, n)
    rate, low, high = wilson(right, n)
    assert 0 <= low <= rate + 1e-12
    assert rate - 1e-12 <= high <= 1
    for end in (low, high):
        if 1e-9 < end < 1 - 1e-9:
            assert abs(rate - end) == pytest.approx(np.sqrt(end * (1 - end) / n), abs=1e-9)


def test_no_trial_no_rate():
    assert np.isnan(wilson(0, 0)).all()


# ---- rates ---------------------------------------------------------------------------------


def test_rates_are_of_what_was_answered(result):
    assert result.rate("single")[0] == pytest.approx(2 / 3)
    assert result.rate("single")[3] == 3
    assert result.rate("single", least=8)[3] == 2
    # the weaker of two effects counts
    assert result.rate("pair", least=30)[3] == 1
    assert result.rate("pair", below=30)[0] == 0
    assert result.rate("none", least=1000)[3] == 2
    assert np.isnan(result.rate("withheld")[0])
    assert [r["index"] for r in result.failures] == [1, 4, 6]


def test_pulls_are_those_of_effects_that_can_be_seen(result):
    np.testing.assert_allclose(result.pulls(), [0.5, -2.0, 0.9])
    np.testing.assert_allclose(result.pulls(least=20), [0.9])
    assert ChallengeResult([], {}).pulls().shape == (0,)


def test_shrinkage_is_measured_by_that_of_the_truth(result):
    # 1 - 1/4, 0 and 1 - 1/16, of 3/4, 3/4 and 15/16
    assert result.shrinkage_ratio() == pytest.approx((0.75 + 0 + 0.9375) / (1.5 + 0.9375))
    assert np.isnan(ChallengeResult([record(0)], {}).shrinkage_ratio())


def test_summary_leaves_out_what_was_not_asked(result):
    summary = result.summary()
    assert set(summary["rates"]) == {
        "recall",
        "recall of pairs",
        "unexplained of unknown",
        "quiet on clean",
        "coverage of sizes",
    }
    assert summary["rates"]["recall"]["n"] == 2
    # two of three pulls are within one standard error
    assert summary["rates"]["coverage of sizes"]["value"] == pytest.approx(2 / 3)
    assert summary["shrinkage over oracle"] == pytest.approx(result.shrinkage_ratio())
    assert ChallengeResult([record(0)], {}).summary()["shrinkage over oracle"] is None


def test_everything_can_be_written_as_json(result):
    content = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert content["settings"]["seed"] == 3
    assert len(content["challenges"]) == 9


def test_words_are_the_summary(result):
    lines = result.words().splitlines()
    words = "8 of 9 challenges could be made; not the others: too dark (1)"
    assert lines.pop(0) == words == result.shortfall
    assert lines[0] == "8 challenges, 3 wrong answers"
    value, low, high = (100 * x for x in wilson(1, 2))
    assert lines[1] == f"{'recall':<24}{value:6.1f} % ({low:.1f} to {high:.1f}; 2)"
    assert lines[-1].startswith("shrinkage over oracle")
    assert "shrinkage" not in ChallengeResult([record(0)], {}).words()


def test_what_could_not_be_made_is_no_right_answer():
    dark = {"index": 0, "kind": "single", "verdict": "not made", "error": "too dark"}
    none = ChallengeResult([dark, dark | {"index": 1}], {})
    assert none.words() == "0 of 2 challenges could be made: too dark (2)"
    assert none.answered == []
    assert ChallengeResult([record(0)], {}).shortfall == ""


# ---- table ---------------------------------------------------------------------------------


def test_table_has_a_row_for_each_answer(result):
    table = result.table
    assert list(table["index"]) == list(range(8))
    assert table["effect"][3] == "beam_gain + beam_gain"
    assert table["snr"][3] == 35.0
    assert table["snr"][5] == 0.0
    assert table["answer"][0] == "beam_gain|background"
    assert table["answer"][1] == ""
    assert table["gap_before"][3].to_value("percent") == 4.0
    assert np.isnan(table["gap_oracle"][2])


# ---- figure --------------------------------------------------------------------------------


def bars(axes, start):
    """Points and the ends of the bars of the curve whose label starts so."""
    (found,) = [c for c in axes.containers if c.get_label().startswith(start)]
    line, _, (segments,) = found.lines
    ends = np.array([s[:, 1] for s in segments.get_segments()])
    return line.get_xdata(), line.get_ydata(), ends


def test_points_are_rates_and_bars_their_intervals(result):
    figure = result.plot(bins=4)
    (axes,) = figure.axes
    x, y, ends = bars(axes, "one effect")
    edges = np.geomspace(8, 128, 5)
    assert np.all((x > edges[[0, 2]]) & (x < edges[[1, 3]]))
    np.testing.assert_allclose(y, [100, 0])
    np.testing.assert_allclose(ends[0], 100 * np.array(wilson(1, 1)[1:]))
    np.testing.assert_allclose(ends[1], 100 * np.array(wilson(0, 1)[1:]), atol=1e-9)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0] == "nothing to be found, and nothing said (2)"
    assert "one effect, named first or in the first group (2)" in labels
    assert axes.get_xlabel() == "signal-to-noise ratio of the weakest effect"
    assert axes.get_ylabel() == "right answers (%)"
    assert figure.get_suptitle() == "8 sealed challenges, 68 % binomial intervals"


def test_the_line_of_quiet_answers_has_its_band(result):
    (axes,) = result.plot().axes
    line = next(one for one in axes.lines if one.get_label().startswith("nothing"))
    assert set(line.get_ydata()) == {50.0}
    (band,) = axes.patches
    low, high = (100 * x for x in wilson(1, 2)[1:])
    assert band.get_y() == pytest.approx(low)
    assert band.get_y() + band.get_height() == pytest.approx(high)


def test_kinds_that_were_not_asked_are_not_drawn():
    result = ChallengeResult([record(0)], {"snr": [8.0, 128.0]})
    figure = result.plot()
    assert len(figure.axes[0].containers) == 1
    assert len(figure.legends[0].get_texts()) == 1
    assert not figure.axes[0].patches


def test_quiet_challenges_alone_are_drawn_by_kind():
    quiet = [record(0, "none", snr=[]), record(1, "absorbed", right=False, snr=[])]
    (axes,) = ChallengeResult(quiet, {"snr": [8.0, 128.0]}).plot().axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["none", "absorbed"]
    assert axes.get_xscale() == "linear"
    assert "signal-to-noise" not in axes.get_xlabel()
    points = [c.lines[0].get_ydata()[0] for c in axes.containers]
    assert points == [100, 0]


def test_a_size_at_the_end_of_the_range_has_its_bin():
    records = [record(0, snr=[7.7]), record(1, snr=[130.0])]
    (axes,) = ChallengeResult(records, {"snr": [8.0, 128.0]}).plot(bins=3).axes
    assert len(bars(axes, "one effect")[0]) == 2
