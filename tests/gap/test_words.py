# Licensed under a 3-clause BSD style license - see LICENSE
"""The words of a report, piece by piece."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.gap import _words
from astropolcal.gap.cells import Cell

ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
DRIFT = Cell("in:derotator", "retardance_h", "time")
BEFORE = {"left_out_before_percent": 2.0, "left_out_after_percent": 0.5}


def named(name="beam_gain", probability=0.1):
    own = {"effect": name, "cell": None, "probability": probability}
    return own | {"name": name, "title": f"title of {name}"}


def cell(place, kind="diattenuation_h", dependence="constant", probability=0.1):
    one = Cell(place, kind, dependence)
    own = {"effect": None, "cell": one.to_dict(), "probability": probability}
    return own | {"name": f"{place}/{kind}/{dependence}", "title": one.title}


def entry(what=None, **changes):
    """What `to_dict` says of a cause."""
    return {
        **(what or named()),
        "rank": 1,
        "probability": 0.97,
        "share": 1.0,
        "kind": "detector",
        "aliases": [],
        "explained": 0.9,
        "double_difference_share": 0.4,
        **BEFORE,
        "size": {"g.i": {"value": 0.5, "std": 0.01, "unit": "", "limit": 1.0}},
        "significance": 40.0,
        "physical": True,
        "at_bound": 0,
        "trades_with": [],
        "details": ["Something."],
    } | changes


def where(kind="pattern", share=0.6, **changes):
    return {
        "axis": "frame",
        "detail": f"a {kind}",
        "kind": kind,
        "share": share,
        "p_value": 1e-9,
    } | changes


def content(*causes, **changes):
    """What `to_dict` says of a diagnosis."""
    target = {"dolp_percent": 1.0, "s_p_percent": 0.05, "s_chi_deg": 0.25, "words": "so"}
    dataset = {"name": "lamp", "s_res_percent": 1.0, "s_cv_percent": None}
    own = {"observable": "normalized_double_difference"}
    accuracy = own | {"datasets": [dataset], "targets": [target]}
    accuracy |= {"against_prior": None, "unusable": []}
    one = {
        "verdict": "named",
        "frames": [],
        "in_tails": [],
        "causes": list(causes) or [entry()],
        "cross_validated": True,
        "exchanged": False,
        "converged": True,
        "gap_p_value": 1e-9,
        "remainder_p_value": 0.4,
        "gap_before_percent": 2.0,
        "gap_after_percent": 0.5,
        "noise_floor_percent": 0.45,
        "double_difference": {"before_percent": 1.1, "after_percent": 0.4, "noise_percent": 0.3},
        "n_effects": 12,
        "where": [where(), where("place")],
        "where_left": [],
        "left_share": 0.0,
        "left_share_limit": 0.112,
        "hidden_percent": 0.01234,
        "next_observations": [],
        "nominal": "hwp | wollaston. Free: hwp.theta",
        "accuracy_before": accuracy,
        "accuracy_after": accuracy,
    } | changes
    return one | {"sentences": _words.sentences(one)}


def said(one, ranks=()):
    """What is said of a cause beside others of some ranks."""
    return _words.cause(one | {"details": _words.details(one, dict(ranks))})


def test_what_is_not_asked_for_and_looks_like_a_cause_is_told():
    every = ("background", "other wavelengths", "wavelength scale")
    told = {
        ("after:derotator", "depolarization_h", "time"): {"background"},
        ("after:derotator", "depolarization_h", "constant"): {"other wavelengths"},
        ("in:derotator", "depolarization_h", "time"): set(),
        ("after:derotator", "retardance_h", "time"): set(),
        ("in:derotator", "retardance_h", "time"): {"wavelength scale"},
    }
    for one, what in told.items():
        words = said(entry(cell(*one)))
        assert {word for word in every if word in words} == what, one
        # of an alias, too, unless it is hardly probable
        for probability, expected in ((0.3, what), (0.001, set())):
            words = said(entry(cell("source"), aliases=[cell(*one, probability=probability)]))
            assert {word for word in every if word in words} == expected, one


# ---- numbers and names ----------------------------------------------------------------------


def test_numbers_have_the_digits_that_count():
    for value, words in ((None, "-"), (np.nan, "-"), (1234.5, "1.23e+03"), (0.00123456, "0.00123")):
        assert _words.number(value) == words
    for value, words in ((1.9, "1.90"), (0.108, "0.108"), (12345.6, "12346"), (100.2, "100")):
        assert _words.percent(value) == words
    for value, words in ((0.3, "0.3"), (2e-6, "2e-06"), (1e-7, "< 1e-6"), (0.0, "< 1e-6")):
        assert _words.p(value) == words
    for value, words in ((0.0, "0 %"), (0.0049, "< 1 %"), (1.0, "100 %"), (None, "-")):
        assert _words.short_share(value) == words
    assert _words.change(1.234, None) == "1.2 -> -"


@given(st.floats(1e-3, 999))
def test_percent_is_within_half_a_digit(value):
    assert float(_words.percent(value)) == pytest.approx(value, rel=0.005)


def test_lists_end_with_how_many_more():
    for texts, options, words in (
        ("a", {}, "a"),
        ("abc", {"word": "or"}, "a, b or c"),
        ("abcd", {"most": 3}, "a, b, c and 1 more"),
    ):
        assert _words.listed(iter(texts), **options) == words
    assert _words.in_title(["a", "b", "c"]) == "a, b and 1 more"
    assert _words.in_title([]) == ""


@given(st.text("abc", max_size=40), st.integers(1, 30))
def test_a_shortened_name_fits_and_keeps_its_ends(name, width):
    found = _words.shortened(name, width)
    assert len(found) == min(len(name), width)
    if len(name) > width:
        head, tail = found.split(ELLIPSIS)
        assert name.startswith(head)
        assert name.endswith(tail)
    else:
        assert found == name
    assert _words.shortened("dataset3_polarized_2025-10-05", 19) == f"dataset3{ELLIPSIS}2025-10-05"


# ---- sizes ----------------------------------------------------------------------------------


def test_sizes_are_in_units_that_people_use():
    known = {"unit": "deg", "limit": 30.0}
    share = {"unit": "", "limit": 1.0}
    lines = _words.sizes(
        entry(
            size={
                "a.b": {"value": [1.0, 2.0, 9.0], "std": [0.1, 0.011, 25.0], **known, "degree": 2},
                "a.c": {"value": [1.0, 2.0], "std": [None, 25.0], **known},
                "a.long_name": {"value": 0.0123456, "std": 0.000123, **share},
                "a.e": {"value": [0.01, 0.01], "std": [0.001, 0.001], **share},
            }
        )
    )
    assert lines == [
        "b: 1.000 to 2.000 deg, median 1.500, errors 0.011 to 0.10 deg, if it is nearly a "
        "polynomial of degree 2 in wavelength; determined at 2 of 3 wavelengths",
        "c: not determined by these data at any wavelength",
        "long name: 1.235 +- 0.012 %",
        "e: 1.00 +- 0.10 % at every wavelength",
    ]


def test_parameters_of_a_cell_have_names_without_its_name():
    sizes = dict.fromkeys(("gap_x.amplitude", "gap_x.quadrature"), entry()["size"]["g.i"])
    own = entry(cell("after:hwp", "rotation", "harmonic:hwp:2"), size=sizes)
    assert _words.labels(own) == ["amplitude of the cosine", "amplitude of the sine"]
    # two optics of one effect are told apart
    # of one law for both beams the parameter is that of the right one
    size = {"gap_detector.right": entry()["size"]["g.i"]}
    for kind, label in (
        ("nonlinearity", "both beams"),
        ("background_of_one_beam", "right beam, or the left with the other sign"),
    ):
        assert _words.labels(entry(cell("detector", kind, "flux"), size=size)) == [label]
    sizes = dict.fromkeys(("one.size", "other.size"), entry()["size"]["g.i"])
    assert _words.labels(entry(size=sizes)) == ["size of one", "size of other"]


def test_a_size_is_known_if_one_wavelength_tells_it():
    for std, known in (([0.01, None], True), ([None, None], False), ([5.0, 9.0], False)):
        size = {"value": [1.0, 2.0], "std": std, "unit": "", "limit": 1.0}
        assert _words.has_sizes({"size": {"a.b": size}}) == [known]
    vague = entry(size={"a.b": size}, trades_with=["hwp.w_sio2"])
    assert "do not tell its size: a part can be exchanged for" in said(vague)


# ---- causes and what they may be taken for -------------------------------------------------------


def test_every_cause_has_its_probability_beside_it():
    assert "title of beam_gain (97 %)." in said(entry())
    words = said(entry(cell("in:derotator", "retardance_h", "time")))
    assert words.startswith("Something in the derotator causes retardance along the axes that")
    assert "(97 %); no name is known for it." in words
    two = content(entry(), entry(named("tilt"), probability=0.92, rank=2))
    assert "title of beam_gain (97 %) and title of tilt (92 %)" in two["sentences"][0]


def test_the_same_kind_at_several_places_is_told_once():
    aliases = [
        cell("after:hwp", probability=0.3),
        cell("after:derotator", probability=0.28),
        cell("source", "rotation", "time", 0.06),
        cell("after:hwp", "rotation", "time", 0.05),
    ]
    one = entry(cell("source"), share=0.3, aliases=aliases)
    title = _words.title(one)
    assert title.count("diattenuation") == 1
    assert (
        "at the source, downstream of the half-wave plate or downstream of the derotator" in title
    )
    assert _words.own_share(one) == pytest.approx(0.88)
    (other,) = _words.others(one, {})
    assert other.endswith("(11 %)")
    # a place that is much less probable is another answer
    aliases[1]["probability"] = 0.01
    assert "downstream of the derotator" not in _words.title(one)


def test_a_name_and_the_cell_that_it_is_for_are_one_thing():
    own = cell("detector", "gain", "constant", 0.48)
    one = entry(named("beam_gain", 0.0), share=0.48, cell=own["cell"], aliases=[own])
    assert _words.own_share(one) == pytest.approx(0.96)
    assert said(one).startswith("The model lacks one effect: title of beam_gain (97 %)")


def test_long_groups_are_told_shortly():
    aliases = [named(f"e{i}", 0.05 - 0.001 * i) for i in range(12)]
    words = said(entry(share=0.5, aliases=aliases))
    assert "title of e3" in words
    assert "title of e4" not in words
    assert "or 8 more" in words
    # none of them stands out
    words = said(entry(share=0.2, aliases=aliases))
    assert words.startswith("The model lacks one of several things (97 %)")


def test_a_terminal_shows_no_table_of_which_only_the_head_fits():
    content = {"causes": [entry(), entry(cell("source"))]}
    for n_sentences, head in ((3, True), (15, False)):
        content["sentences"] = ["Word " * 15] * n_sentences
        lines = _words.short(content, ["end"] * 6)
        assert len(lines) <= 24
        assert any("probability" in line for line in lines) == head, n_sentences
        assert not any("more line" in line for line in lines)


def test_an_alias_that_is_a_cause_itself_is_no_alternative():
    words = said(entry(aliases=[named("tilt")]), {"beam_gain": 1, "tilt": 2})
    assert "It resembles cause 2: the data ask for both" in words
    assert "hardly tell" not in words


def test_a_cause_says_which_differences_it_concerns():
    for kept, words in ((0.001, "it cancels in"), (0.4, "40 % of its signal is in")):
        assert f"{words} the double differences" in said(entry(double_difference_share=kept))
    assert "double" not in said(entry(double_difference_share=None))


def test_what_is_not_known_of_a_cause_is_left_out():
    words = said(entry(left_out_before_percent=None, significance=None))
    assert "left-out" not in words
    assert "standard errors" not in words
    assert said(entry(kind="discrete", size={})).endswith("has no size.")
    assert "impossible" in said(entry(physical=False))
    assert "at a bound of the optic at 1 of 1" in said(entry(at_bound=1))


# ---- the summary ----------------------------------------------------------------------------


def test_frames_come_first_in_every_verdict():
    words = "frame 29: its data are those of another plate angle"
    frames = [{"dataset": "lamp", "frame": 29, "what": "hwp angle", "words": words}]
    for verdict in ("none", "named", "located", "unexplained"):
        first = _words.sentences(content(verdict=verdict, frames=frames))[0]
        assert f"says: {words}" in first
        # of several tables that of the frame
        first = _words.sentences(content(verdict=verdict, frames=frames), several=True)[0]
        assert f"says: lamp, {words}" in first


def test_every_verdict_has_its_sentence():
    left = {"where_left": [where(share=0.2)], "left_share": 0.3, "remainder_p_value": 0.0}
    fits = {"verdict": "none", "causes": [], "gap_p_value": 0.4}
    for changes, words in (
        (fits, "The model agrees with the measurements"),
        ({}, "The model lacks one effect: title of beam_gain (97 %)."),
        ({"verdict": "unexplained"}, "I do not know what the model lacks: what helps most"),
        ({"verdict": "unexplained", "causes": []}, "none of the 12 causes that were tried"),
        ({"verdict": "unexplained", "causes": []}, "60 % of the gap follows a pattern."),
        ({"verdict": "unexplained"} | left, "20 % of what is left follows a pattern."),
        (left, "What is left, 30 % of the gap, is more than noise (p < 1e-6): 20 % of it"),
        ({}, "What is left is noise (p = 0.4), which may hide up to 12 % of the gap (95 %)."),
        (fits, "does not show: a gap of up to 0.0123 % (rms, 95 %)."),
        ({"cross_validated": False}, "the frames of the fit"),
        ({"converged": False}, "The nominal fit did not converge"),
        ({"gap_p_value": 0.02}, "no larger than noise (p = 0.02), but have a pattern"),
        ({"gap_p_value": 0.0}, "The gap is real (p < 1e-6)."),
        (
            {"verdict": "unexplained", "causes": [], "where": []},
            "it may be noise that is 4.4 times as large.",
        ),
    ):
        assert words in " ".join(content(**changes)["sentences"])


def test_double_differences_lead_and_single_ones_follow():
    text = " ".join(content()["sentences"])
    numbers = ("1.10 %", "0.400 %", "0.300 %", "2.00 %", "0.500 %", "0.450 %")
    places = [text.index(number) for number in numbers]
    assert places == sorted(places)
    alone = " ".join(content(double_difference=None)["sentences"])
    assert "In single differences the model is off by 2.00 %" in alone
    # nobody overlooks that causes make it worse
    worse = " ".join(content(gap_after_percent=2.5)["sentences"])
    assert "2.50 %, which is worse" in worse
    assert "worse" not in text


def test_the_sky_is_spoken_of_where_the_improved_model_is_worth_saving():
    assert "--save" in content()["sentences"][-1]
    for verdict in ("none", "unexplained"):
        assert "--save" not in " ".join(content(verdict=verdict)["sentences"])


# ---- the terminal ---------------------------------------------------------------------------


def test_the_summary_comes_first_and_lines_fit():
    alias = [named("b")]
    many = [entry(named(f"{'x' * 40}{i}"), rank=i + 1, aliases=alias) for i in range(6)]
    take = {
        "exposure": f"Take run: 2, {'this ' * 27}",
        "words": f"Take run: 2, {'this ' * 27}: tells",
        "separates": [many[0]["name"], "b"],
        "gain": 5.0,
    }
    for causes, written in ((many, ["a.json", "b.html"]), (many[:1], [])):
        one = content(*causes, next_observations=[take] * 3)
        lines = _words.text(one, ["Left out: 2."], written).splitlines()
        assert max(map(len, lines)) <= 80
        summary = "\n".join(lines[:24])
        assert all(f"{share:>3}" in summary for share in ("97 %", "2.00 %", "1.10 %"))
        told = " ".join(" ".join(lines).split())
        assert "this : tells cause 1 from what it may be (5.0 standard" in told
        assert all(name in summary for name in written)
        assert lines[lines.index("Cause 1: " + _words.title(causes[0]) + " (97 %)") - 1] == ""
    assert "p = 1e-09" not in "\n".join(lines)
    # what no exposure tells is said as it is
    none = take | {"exposure": None, "words": "No exposure tells a from b", "gain": 0.0}
    assert _words.exposure(none, many) == none["words"]


def test_of_where_the_gap_lies_five_lines_are_told():
    looks = [where(share=0.5 - 0.01 * i) for i in range(9)] + [where("place")] * 4
    assert [one["kind"] for one in _words.worth_reading(looks)] == ["pattern"] * 3 + ["place"] * 2
    assert len(_words.worth_reading(looks[:9])) == 5
    text = _words.text(content(where=looks))
    assert " 50 %  follows a pattern" in text
    assert " 60 %  lies in a place" in text


def test_what_is_hardly_probable_is_told_in_the_table_only():
    doubtful = entry(probability=0.01)
    text = _words.text(content(doubtful, verdict="unexplained"))
    assert "Cause 1:" not in text
    assert re.search(r"^1 +1 % +90 % +40 %  beam_gain", text, re.MULTILINE)
    empty = content(verdict="none", causes=[], where=[], gap_p_value=0.4)
    assert "cause" not in _words.text(empty | {"causes": []})


def test_lines_are_broken_under_their_beginning():
    lines = list(_words._wrapped(["  - " + "word " * 30, "  1. " + "word " * 30, ""]))
    assert lines[0].startswith("  - word")
    assert lines[1].startswith("    word")
    assert [line for line in lines if line.startswith("     word")]
    assert lines[-1] == ""
