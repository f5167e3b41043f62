# Licensed under a 3-clause BSD style license - see LICENSE
"""Words that messages share."""

import difflib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import FitError
from astropolcal.words import check_choice, counted, did_you_mean

NAMES = ["hwp", "derotator", "wollaston", "dichroic"]
texts = st.text("abcdehiloprtw_", min_size=1, max_size=12)


def test_nearest_name_or_nothing():
    for name, hint in [
        ("wolaston", "; did you mean 'wollaston'?"),
        ("hpw", "; did you mean 'hwp'?"),
        ("derotators", "; did you mean 'derotator'?"),
        ("quartz", ""),
        ("", ""),
        (None, ""),
    ]:
        assert did_you_mean(name, NAMES) == hint, (name, hint)
        # a registry is a dictionary, and an iterator has its names once only
        assert did_you_mean(name, dict.fromkeys(NAMES)) == hint, (name, hint)
        assert did_you_mean(name, iter(NAMES)) == hint, (name, hint)


def test_several_are_joined_the_nearest_first():
    known = ["beam_gain", "beam_gains", "beam_gap"]
    assert did_you_mean("beam_gain", known, most=2) == (
        "; did you mean 'beam_gain' or 'beam_gains'?"
    )


def test_aliases_of_one_thing_are_named_once():
    index = {"hd 30675": "HD 30675", "hd030675": "HD 30675"}
    assert did_you_mean("hd 3067", index, most=3, show=index.get) == "; did you mean HD 30675?"


def test_cutoff_decides_what_is_near():
    # two of three letters agree: a similarity of 2/3
    assert did_you_mean("hwq", ["hwp"], cutoff=0.66)
    assert not did_you_mean("hwq", ["hwp"], cutoff=0.67)


@given(texts, st.lists(texts, max_size=6))
def test_what_is_suggested_is_known_and_similar(name, known):
    hint = did_you_mean(name, known)
    near = [k for k in known if difflib.SequenceMatcher(None, k, name).ratio() >= 0.6]
    assert bool(hint) == bool(near)
    if hint:
        assert hint.removeprefix("; did you mean '").removesuffix("'?") in near


def test_one_is_singular():
    for number, words in [
        (0, "0 frames"),
        (1, "1 frame"),
        (2, "2 frames"),
        (-1, "-1 frames"),
        (1000, "1000 frames"),
    ]:
        assert counted(number, "frame") == words, (number, words)


def test_irregular_plural():
    assert [counted(n, "half", "halves") for n in (1, 2)] == ["1 half", "2 halves"]


def test_choices_are_named_with_what_may_have_been_meant():
    for value, allowed, words in [
        ("doublo", ("double", "single"), r"x = 'doublo'; allowed are double, single; did you mean"),
        (["double"], ("double",), r"x = \['double'\]; allowed are double"),
        (1, (), r"x = 1; allowed are none$"),
    ]:
        with pytest.raises(FitError, match=words):
            check_choice("x", value, allowed, FitError)
    assert check_choice("x", None, ("double", None), FitError) is None
