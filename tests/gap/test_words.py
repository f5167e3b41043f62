# Licensed under a 3-clause BSD style license - see LICENSE
"""The words of a report, piece by piece."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.gap import _words

ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"


def entry(**changes):
    """What `to_dict` says of a cause."""
    return {
        "rank": 1,
        "effect": "beam_gain",
        "title": "unequal gains",
        "place": "detector",
        "kind": "detector",
        "aliases": [],
        "alias_titles": [],
        "p_value": 1e-9,
        "explained": 0.9,
        "gap_cv_before_percent": 2.0,
        "gap_cv_after_percent": 0.5,
        "parameters": {"g.i": {"value": 1.0, "std": 0.01, "unit": "", "limit": 1.0}},
        "significance": 40.0,
        "physical": True,
        "trades_with": [],
        "details": ["The size is physically possible."],
    } | changes


def content(**changes):
    """What `to_dict` says of a diagnosis."""
    return {
        "verdict": "effect",
        "causes": [entry()],
        "cross_validated": True,
        "exchanged": False,
        "gap_p_value": 1e-9,
        "alpha": 0.01,
        "remainder_p_value": 0.4,
        "gap_before_percent": 2.0,
        "gap_after_percent": 0.5,
        "noise_floor_percent": 0.45,
        "n_effects": 12,
        "scores": [{"p_value": 0.3}, {"p_value": 0.2}],
        "where": [],
        "shrinkage_percent": {"value": 94.0, "low": 90.0, "high": 96.0},
    } | changes


# ---- numbers -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "words"),
    [(None, "-"), (np.nan, "-"), (np.inf, "-"), (1234.5, "1.23e+03"), (0.00123456, "0.00123")],
)
def test_number(value, words):
    assert _words.number(value) == words


def test_digits_of_a_number():
    assert _words.number(1.23456, 5) == "1.2346"
    assert _words.percent(1.23456, 2) == "1.2"
    # no digits are lost in front of the point
    assert _words.percent(1234.5, 2) == "1234"
    assert _words.percent(-1234.5, 3) == "-1234"
    assert _words.percent(np.nan) == "-"
    # a trailing point is no digit
    assert _words.percent(100.2, 3) == "100"


@given(st.floats(1e-3, 999))
def test_percent_is_within_half_a_digit(value):
    assert float(_words.percent(value)) == pytest.approx(value, rel=0.005)


@pytest.mark.parametrize(
    ("value", "alone", "with_letter"),
    [
        (0.3, "0.3", "p = 0.3"),
        (1e-9, "1e-09", "p = 1e-09"),
        (1e-98, "1e-98", "p = 1e-98"),
        (0.0, "< 1e-99", "p < 1e-99"),
        (1e-200, "< 1e-99", "p < 1e-99"),
    ],
)
def test_probabilities(value, alone, with_letter):
    assert _words.p(value) == alone
    assert _words.p_is(value) == with_letter


@pytest.mark.parametrize(
    ("value", "words", "short"),
    [
        (0.0, "0 %", "0 %"),
        (0.0049, "less than 1 %", "< 1 %"),
        (0.005, "less than 1 %", "< 1 %"),
        (0.006, "1 %", "1 %"),
        (1.0, "100 %", "100 %"),
    ],
)
def test_shares(value, words, short):
    assert _words.share(value) == words
    assert _words.short_share(value) == short


def test_change():
    assert _words.change(1.234, None) == "1.2 -> -"
    assert _words.change(1.234, 0.1, 3) == "1.23 -> 0.100"


# ---- names ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("texts", "options", "words"),
    [
        (["a"], {}, "a"),
        (["a", "b"], {}, "a and b"),
        (["a", "b", "c"], {"word": "or"}, "a, b or c"),
        (["a", "b", "c"], {"most": 3}, "a, b and c"),
        (["a", "b", "c", "d"], {"most": 3}, "a, b, c and 1 more"),
        (["a", "b", "c", "d"], {"word": "or", "most": 1}, "a or 3 more"),
    ],
)
def test_lists(texts, options, words):
    assert _words.listed(texts, **options) == words
    assert _words.listed(iter(texts), **options) == words


@given(st.text("abc", max_size=40), st.integers(1, 30))
def test_a_shortened_name_fits_and_keeps_its_ends(name, width):
    found = _words.shortened(name, width)
    assert len(found) == min(len(name), width)
    if len(name) > width:
        head, tail = found.split(ELLIPSIS)
        assert name.startswith(head)
        assert name.endswith(tail)
        assert 0 <= len(head) - len(tail) <= 1
    else:
        assert found == name


# ---- sizes ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ({"value": 0.5, "std": 0.05, "unit": "deg", "limit": 1.0}, "0.500 +- 0.050 deg"),
        # an error of a tenth of the limit still tells, more does not
        ({"value": 0.5, "std": 0.1, "unit": "", "limit": 1.0}, "0.50 +- 0.10"),
        ({"value": 0.5, "std": 0.101, "unit": "", "limit": 1.0}, "not determined by these data"),
        ({"value": 55.0, "std": 12.0, "unit": "deg", "limit": 180.0}, "55 +- 12 deg"),
        ({"value": 1.23456, "std": 0.0, "unit": "", "limit": 1.0}, "1.235 +- 0.000"),
    ],
)
def test_size_of_one_number(size, words):
    assert _words.sizes({"a.b": size}) == [f"a.b: {words}"]


def test_size_of_a_law_is_its_range():
    size = {"value": [1.0, 3.0, 2.0], "std": [0.1, 0.3, 0.2], "unit": "deg", "limit": 30.0}
    assert _words.sizes({"a.b": size}) == [
        "a.b: median 2.00, from 1.00 to 3.00 deg; errors 0.10 to 0.30 deg"
    ]


@pytest.mark.parametrize(
    ("std", "known"),
    [([0.01, 0.02], True), ([0.01, None], True), ([None, None], False), ([5.0, 9.0], False)],
)
def test_a_size_is_known_if_one_wavelength_tells_it(std, known):
    size = {"value": [1.0, 2.0], "std": std, "unit": "", "limit": 1.0}
    assert _words.has_sizes({"parameters": {"a.b": size}}) == [known]


# ---- a cause -------------------------------------------------------------------------------


def test_words_of_a_cause_say_all_that_is_known():
    words = _words.cause(entry(), {"beam_gain": 1})
    assert words.startswith("Unequal gains (detector). It explains 90 % of what exceeds the noise.")
    assert "Left-out frames: 2.00 % without it, 0.500 % with it." in words
    assert "corrected for the number of effects: p = 1e-09." in words
    assert "Its size as a whole is 40 standard errors from zero." in words
    assert words.endswith("The size is physically possible.")


def test_a_size_at_a_bound_is_said_to_be_there():
    several = {"g.i": {"value": [1.0, 0.9], "std": [0.01, 0.01], "unit": "", "limit": 1.0}}
    for parameters, words in ((entry()["parameters"], ""), (several, " at 1 of 2 values")):
        found = _words.cause(entry(parameters=parameters, at_bound=1), {})
        assert found.endswith(f"The size is physically possible: at a bound of the optic{words}.")


def test_what_is_not_known_of_a_cause_is_left_out():
    words = _words.cause(entry(gap_cv_before_percent=None, significance=None), {})
    assert "Left-out frames" not in words
    assert "standard errors" not in words


def test_a_discrete_cause_has_neither_size_nor_scan():
    words = _words.cause(entry(kind="discrete", parameters={}), {})
    assert "corrected for the number" not in words
    assert words.endswith("It is an alternative to the model and has no size.")


def test_aliases_are_parted_into_causes_and_others():
    ranks = {"beam_gain": 1, "background": 2, "hwp_tilt": 3}
    names = ["background", "hwp_tilt", "persistence", "fringes"]
    one = entry(aliases=names, alias_titles=[f"title of {name}" for name in names])
    assert _words.open_aliases(one, ranks) == ["title of persistence", "title of fringes"]
    first, second, *_ = _words.details(one, ranks)
    assert first == ("These data cannot tell it from: title of persistence; title of fringes.")
    assert second.startswith("It resembles cause 2 and cause 3: the data ask for both")


# ---- sentences -----------------------------------------------------------------------------


def test_sentences_of_a_gap_that_is_closed():
    large, what, left = _words.sentences(content())
    assert large == (
        "The model misses the single differences of frames left out of the fit by 2.00 % of "
        "polarization where the noise is 0.450 %; the gap is real (residuals as large by noise "
        "alone: p = 1e-09)."
    )
    assert what == (
        "The model lacks one effect: unequal gains, which explains 90 % of what exceeds the noise."
    )
    assert left == (
        "With it the model predicts frames left out of the fit to 0.500 % (mean square lower by "
        "94 %, 68 % interval 90 to 96 %), and what remains is noise (p = 0.4)."
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"cross_validated": False}, "misses the single differences of the frames of the fit by"),
        ({"exchanged": True}, "misses the single differences of the frames by"),
        ({"gap_p_value": 0.02}, "the residuals are no larger than noise (p = 0.02), but"),
        ({"gap_p_value": 0.0}, "by noise alone: p < 1e-99"),
    ],
)
def test_how_large_the_gap_is(changes, words):
    assert words in _words.sentences(content(**changes))[0]


def test_sentences_of_no_gap():
    large, what, left = _words.sentences(content(verdict="none", causes=[], gap_p_value=0.7))
    assert large.startswith("The model agrees with the measurements: it predicts the single ")
    assert large.endswith("the noise is 0.450 % (residuals as large by noise alone: p = 0.7).")
    # the least of the corrected probabilities
    assert "None of the 12 effects that were tried is needed (the least," in what
    assert "p = 0.2" in what
    assert "would not show" in left
    nothing = content(verdict="none", causes=[], scores=[])
    assert _words.sentences(nothing)[1] == (
        "There was no effect to try that the model does not contain."
    )


def test_sentences_of_a_gap_that_no_effect_touches():
    where = [{"detail": "derotator at 45 deg", "share": 0.4}]
    _, what, left = _words.sentences(content(verdict="unexplained", causes=[], where=where))
    assert what.startswith("None of the 12 effects that were tried explains it")
    assert left.endswith("; the clearest part of it is derotator at 45 deg (40 % of the gap).")
    bare = _words.sentences(content(verdict="unexplained", causes=[]))[2]
    assert bare == "Nothing should be added to the model before its cause is known."


def test_sentence_of_effects_that_help_only():
    some = content(verdict="unexplained", causes=[entry(explained=0.3)])
    assert _words.sentences(some)[1] == (
        "The effects that help (unequal gains) explain only 30 % of what exceeds the noise: "
        "the cause is not in the library."
    )


def test_sentence_of_an_alias_group():
    group = entry(aliases=["b", "c", "d"], alias_titles=["tb", "tc", "td"])
    what = _words.sentences(content(causes=[group]))[1]
    assert "lacks one of these, which the data cannot tell apart: unequal gains, tb, tc or" in what
    assert "or 1 more, which explains 90 %" in what


@pytest.mark.parametrize(
    ("doubtful", "words"),
    [
        (0, "a and b."),
        (1, "a and b (one of them may as well be another effect, as listed)."),
        (2, "a and b (2 of them may as well be other effects, as listed)."),
    ],
)
def test_sentence_of_two_causes(doubtful, words):
    other = {"aliases": ["x"], "alias_titles": ["tx"]}
    causes = [
        entry(effect=name, title=name, explained=share) | (other if i < doubtful else {})
        for i, (name, share) in enumerate((("b", 0.2), ("a", 0.7)))
    ]
    what = _words.sentences(content(causes=causes))[1]
    assert what.startswith("The model lacks 2 effects, which explain 90 % of what exceeds")
    assert what.endswith(words)


def test_what_is_left_is_called_by_its_probability():
    rest = {"value": None, "low": None, "high": None}
    causes = [entry(physical=False), entry(title="tilt", physical=False)]
    left = _words.sentences(content(causes=causes, remainder_p_value=1e-5, shrinkage_percent=rest))[
        2
    ]
    assert left == (
        "With them the model predicts frames left out of the fit to 0.500 %, and what remains is "
        "more than noise and unexplained (p = 1e-05); physically impossible is the size of unequal "
        "gains and tilt."
    )


# ---- the terminal --------------------------------------------------------------------------


def report(**changes):
    accuracy = {
        "datasets": [{"name": "lamp", "s_res_percent": 1.0, "s_cv_percent": None}],
        "targets": [
            {"dolp_percent": 30.0, "column": "s_mean", "s_p_percent": 0.5, "s_chi_deg": 0.25}
        ],
    }
    return (
        content(
            sentences=["one.", "two."],
            next_observations=[{"words": "Take this"}, {"words": "Take that"}],
            nominal="hwp | wollaston. Free: hwp.theta",
            accuracy_before=accuracy,
            accuracy_after=accuracy,
            where=[
                {"detail": "harmonic 4", "share": 0.6, "p_value": 1e-9},
                {"detail": "1450 nm", "share": 0.7, "p_value": 0.0},
            ],
        )
        | changes
    )


def test_report_is_in_the_order_of_importance():
    text = _words.text(report(), ("s_res", "s_cv"))
    parts = [part.splitlines()[0] for part in text.split("\n\n")]
    assert [part.split()[0] for part in parts] == [
        *("one.", "Causes;", "Cause", "What", "Where", "Accuracy", "Nominal"),
    ]
    assert max(map(len, text.splitlines())) <= 80
    assert "  1. Take this\n  2. Take that" in text
    assert re.search(r"^  lamp +1\.00 -> 1\.00 +- -> -$", text, re.MULTILINE)
    assert "target of 30 % by s_mean: s_p 0.50 -> 0.50 %, s_chi 0.25 -> 0.25 deg" in text


def test_shares_of_both_lists_are_said_not_to_add_up():
    text = _words.text(report(), ("s_res",))
    where = next(part for part in text.split("\n\n") if part.startswith("Where"))
    words = " ".join(where.split())
    assert "each has the share that those before it have left" in words
    assert "Places overlap" in words
    assert "do not add up" in words
    # the smallest probabilities are not written out
    assert "60 % harmonic 4 (p = 1e-09)" in words
    assert words.endswith("70 % 1450 nm")


def test_empty_parts_are_left_out():
    text = _words.text(report(causes=[], where=[], next_observations=[]), ("s_res",))
    assert "Where" not in text
    assert "observe next" not in text
    assert "Cause" not in text


def test_lines_are_broken_under_their_beginning():
    lines = list(_words._wrapped(["  - " + "word " * 30, "  1. " + "word " * 30, ""]))
    assert lines[0].startswith("  - word")
    assert lines[1].startswith("    word")
    assert [line for line in lines if line.startswith("     word")]
    assert lines[-1] == ""
    # a name with hyphens stays whole
    long = "x" * 70 + " half-wave-plate"
    assert list(_words._wrapped([long]))[1] == "half-wave-plate"


def test_table_of_causes_shortens_long_names():
    long = entry(effect="x" * 40, place="y" * 60, gap_cv_before_percent=None)
    lines = _words._table_lines(content(causes=[long, entry(gap_cv_after_percent=None)]))
    assert max(map(len, lines[1:])) <= 80
    assert f"{'x' * 13}{ELLIPSIS}{'x' * 12}" in lines[2]
    assert lines[1].split() == ["effect", "place", "explains", "left-out", "(%)"]
    assert lines[3].endswith("2.00 -> -")
