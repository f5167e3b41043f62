# Licensed under a 3-clause BSD style license - see LICENSE
"""What a report says, in words, numbers and as a page."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Observations, instruments
from astropolcal.exceptions import GapError
from astropolcal.gap import EFFECTS, _words, diagnose, get_effect
from astropolcal.gap._numbers import Fitted
from astropolcal.gap.effects import Context
from astropolcal.gap.model import nominal_model
from astropolcal.gap.report import _about_frames, causes_table, summary, to_dict, write_html
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[2, 6, 10, 14, 18, 20]]
FRAMES = half_wave_plate_cycles(derotator=[45, 62.5, 80, 100] * u.deg)
SIZE = 0.012
CONTRACT = {
    "verdict",
    "nominal",
    "n_free",
    "seconds",
    "noise_floor_percent",
    "gap_before_percent",
    "gap_after_percent",
    "where",
    "causes",
    "accuracy_before",
    "accuracy_after",
    "next_observations",
}
CAUSE = {
    "rank",
    "effect",
    "place",
    "kind",
    "aliases",
    "p_value",
    "explained",
    "gap_cv_before_percent",
    "gap_cv_after_percent",
    "parameters",
    "physical",
    "words",
}


def data(size=0.0, name="run <b>&", seed=3):
    """Simulated frames of a chain with unequal beam gains, the same at all wavelengths."""
    chain = CHARIS.chain(derotator="linear", wavelength=WAVELENGTH)
    context = Context(WAVELENGTH.to_value(u.um), 1e6)
    (edited,) = get_effect("beam_gain").edit([chain], context).chains
    edited["gap_beam_gain"].imbalance = np.full(len(WAVELENGTH), size)
    meta = {"source": "polarized", "instrument": "charis"}
    observations = simulate(edited, WAVELENGTH, FRAMES, seed=seed, meta=meta, name=name)
    return chain, observations


@pytest.fixture(scope="module")
def found():
    """Diagnosis of unequal gains."""
    return diagnose(*data(SIZE), effects=["beam_gain", "hwp_diattenuation", "hwp_tilt"])


@pytest.fixture(scope="module")
def nothing():
    """Diagnosis of a model that lacks nothing."""
    return diagnose(*data(), effects=["beam_gain", "hwp_diattenuation"])


@pytest.fixture(scope="module")
def unknown():
    """Diagnosis with a library that lacks the effect."""
    return diagnose(*data(SIZE), effects=["hwp_encoder_eccentricity"])


@pytest.fixture(scope="module")
def content(found):
    return to_dict(found)


# ---- numbers ---------------------------------------------------------------------------


def test_contract(content, nothing, unknown):
    for one in (content, to_dict(nothing), to_dict(unknown)):
        assert set(one) >= CONTRACT
        # finite or null, and nothing but plain types
        assert json.loads(json.dumps(one, allow_nan=False)) == one
        assert one["n_free"] > 0
        assert len(one["sentences"]) == 3
        for when in ("accuracy_before", "accuracy_after"):
            (entry,) = one[when]["datasets"]
            assert entry["name"] == "run <b>&"
            assert entry["s_mean_percent"] < entry["s_res_percent"]
    (cause,) = content["causes"]
    assert set(cause) >= CAUSE
    assert (cause["rank"], cause["effect"], cause["kind"]) == (1, "beam_gain", "detector")
    assert content["verdict"] == "effect"


def test_gap_is_that_of_left_out_frames(found, content):
    assert content["cross_validated"]
    assert content["gap_before_percent"] == pytest.approx(found.gap_before_percent, rel=1e-6)
    assert content["gap_after_percent"] == pytest.approx(found.gap_after_percent, rel=1e-6)
    before, after = (content[f"accuracy_{w}"]["datasets"][0] for w in ("before", "after"))
    assert after["s_cv_percent"] < 0.5 * before["s_cv_percent"]
    # noise is all that is left
    assert content["gap_after_percent"] < 1.3 * content["noise_floor_percent"]
    shrunk = content["shrinkage_percent"]
    assert shrunk["low"] <= shrunk["value"] <= shrunk["high"]
    (cause,) = content["causes"]
    assert cause["gap_cv_before_percent"] == pytest.approx(content["gap_before_percent"])
    assert cause["gap_cv_after_percent"] == pytest.approx(content["gap_after_percent"])


def test_sizes_are_those_of_the_simulation(content):
    (cause,) = content["causes"]
    (entry,) = cause["parameters"].values()
    value, std = np.array(entry["value"]), np.array(entry["std"])
    assert value.shape == std.shape == (len(WAVELENGTH),)
    assert np.all(std > 0)
    assert np.all(np.abs(value - SIZE) < 4.5 * std)
    assert np.all(std < 0.1 * SIZE)
    assert cause["significance"] > 30
    assert cause["physical"]


def test_errors_of_sizes_agree_with_the_scatter_of_simulations():
    pulls = []
    for seed in range(5):
        diagnosis = diagnose(*data(SIZE, seed=seed), effects=["beam_gain"], cross_validate=False)
        (cause,) = to_dict(diagnosis)["causes"]
        (entry,) = cause["parameters"].values()
        pulls.append((np.array(entry["value"]) - SIZE) / np.array(entry["std"]))
    # 5 x 3 coefficients of the law
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6


def test_targets_are_worse_before(content):
    before, after = (content[f"accuracy_{w}"]["targets"] for w in ("before", "after"))
    assert [(t["dolp_percent"], t["column"]) for t in before] == [
        (1, "s_mean"),
        (30, "s_mean"),
        (1, "s_cv"),
        (30, "s_cv"),
    ]
    assert all(a["s_p_percent"] < b["s_p_percent"] for a, b in zip(after, before, strict=True))
    assert before[0]["missing"] == ["unpolarized", "on_sky"]


def test_without_cross_validation_the_report_says_so():
    diagnosis = diagnose(*data(SIZE), effects=["beam_gain"], cross_validate=False)
    content = to_dict(diagnosis)
    assert not content["cross_validated"]
    assert content["gap_after_percent"] < content["gap_before_percent"]
    (cause,) = content["causes"]
    assert cause["gap_cv_before_percent"] is None
    assert content["accuracy_before"]["datasets"][0]["s_cv_percent"] is None
    assert "the frames of the fit" in content["sentences"][0]
    assert "left out" not in " ".join(content["sentences"])
    assert np.isnan(causes_table(diagnosis)["gap_before"][0])


# ---- words -------------------------------------------------------------------------------


def test_words_of_an_effect(found, content):
    large, what, left = content["sentences"]
    assert f"{content['gap_before_percent']:#.3g} % of polarization" in large
    assert "the gap is real" in large
    assert get_effect("beam_gain").title in what
    assert "what remains is noise" in left
    text = summary(found, content)
    assert max(map(len, text.splitlines())) <= 80
    assert "gap_beam_gain.imbalance" in text
    assert "physically possible" in text


def test_words_of_nothing(nothing):
    text = summary(nothing)
    assert text.startswith("The model agrees with the measurements")
    assert "take up entirely" in text.replace("\n", " ")
    assert "Cause" not in text


def test_words_of_the_unknown(unknown):
    content = to_dict(unknown)
    assert content["verdict"] == "unexplained"
    assert "not in the library" in content["sentences"][1]
    # the effect is in both beams alike at all plate angles: the null channel or the differences
    assert content["where"][0]["detail"] in content["sentences"][2]


def test_an_alias_group_has_no_winner(found):
    (cause,) = found.causes
    grouped = replace(found, causes=[replace(cause, aliases=["background", "hwp_diattenuation"])])
    content = to_dict(grouped)
    titles = [get_effect(n).title for n in ("beam_gain", "background", "hwp_diattenuation")]
    assert "cannot tell apart" in content["sentences"][1]
    assert all(title in content["sentences"][1] for title in titles)
    assert "cannot tell it from" in content["causes"][0]["words"]
    assert causes_table(grouped)["cannot_be_told_from"][0] == "background, hwp_diattenuation"


def test_an_impossible_size_is_said_to_be_one(found):
    (cause,) = found.causes
    content = to_dict(replace(found, causes=[replace(cause, physical=False)]))
    assert "physically impossible" in content["sentences"][2]
    assert "physically impossible" in content["causes"][0]["words"]


def test_a_pattern_among_noise_is_not_called_a_large_gap(found):
    content = to_dict(replace(found, gap_p_value=0.3))
    assert "the gap is real" not in content["sentences"][0]
    assert "pattern" in content["sentences"][0]


def test_an_alternative_has_no_size_and_the_nominal_model_no_prediction(found):
    (cause,) = found.causes
    swapped = replace(cause, effect=get_effect("beams_swapped"), before=None, after=None)
    improved = replace(found.improved, added={"beams_swapped": []})
    content = to_dict(replace(found, improved=improved, causes=[swapped]))
    assert content["accuracy_before"]["datasets"][0]["s_cv_percent"] is None
    assert "The model misses the single differences of the frames by" in content["sentences"][0]
    assert "has no size" in content["causes"][0]["words"]
    assert content["causes"][0]["parameters"] == {}
    assert content["causes"][0]["gap_cv_before_percent"] is None
    assert content["causes"][0]["gap_cv_after_percent"] == found.held_out[0].percent
    before, after = (content[f"accuracy_{w}"]["targets"][-1] for w in ("before", "after"))
    assert before["s_p_percent"] is None
    assert after["s_p_percent"] > 0
    assert " - -> " in summary(found, content)


def test_what_the_data_do_not_tell_is_not_given_as_a_size():
    known = {"unit": "deg", "limit": 30.0}
    lines = _words.sizes(
        {
            "a.b": {"value": [1.0, 2.0, 9.0], "std": [0.1, 0.011, 25.0], **known},
            "a.c": {"value": [1.0, 2.0], "std": [None, 25.0], **known},
            "a.d": {"value": 1.23456, "std": 0.0123, **known},
            "a.e": {"value": 1.23456, "std": None, **known},
        }
    )
    assert lines[0].startswith(
        "a.b: median 1.500, from 1.000 to 2.000 deg; errors 0.011 to 0.10 deg"
    )
    assert lines[0].endswith("determined at 2 of 3 wavelengths")
    assert lines[1] == "a.c: not determined by these data at any wavelength"
    assert lines[2] == "a.d: 1.235 +- 0.012 deg"
    assert lines[3] == "a.e: not determined by these data"


def several(found, shares):
    """Return the diagnosis with as many causes of other effects, which explain these shares."""
    (cause,) = found.causes
    names = [n for n in EFFECTS if EFFECTS[n].kind != "discrete" and n != "beam_gain"]
    others = [replace(cause, effect=get_effect(n)) for n in names[: len(shares) - 1]]
    causes = [replace(c, explained=s) for c, s in zip([cause, *others], shares, strict=True)]
    return replace(found, causes=causes)


def test_the_largest_of_several_causes_are_named(found):
    content = to_dict(several(found, [0.3, 0.6]))
    what = content["sentences"][1]
    first, second = (cause["title"] for cause in content["causes"])
    assert "lacks 2 effects, which explain 90 %" in what
    assert what.index(second) < what.index(first)


def test_many_causes_fit_a_sentence_a_title_and_a_table(found, tmp_path):
    diagnosis = several(found, [0.5, 0.2, 0.1, 0.1, 0.004, 0.05])
    content = to_dict(diagnosis)
    what, titles = content["sentences"][1], [cause["title"] for cause in content["causes"]]
    assert all(title in what for title in titles[:3])
    assert "and 3 more" in what
    assert titles[4] not in what
    assert "less than 1 %" in content["causes"][4]["words"]
    write_html(diagnosis, tmp_path / "gap.html", content=content)
    page = (tmp_path / "gap.html").read_text(encoding="utf-8")
    heading = re.search(r"<h1>(.*?)</h1>", page, re.DOTALL).group(1)
    assert f"{titles[0]}, {titles[1]} and 4 more" in heading
    rows = re.findall(r"^ \d \w.*%.*->.*", summary(diagnosis, content), re.MULTILINE)
    assert len(rows) == 6
    assert "< 1 %" in rows[4]


def test_an_alias_that_is_a_cause_itself_is_no_alternative(found):
    diagnosis = several(found, [0.9, 0.1])
    first, second = diagnosis.causes
    aliased = replace(diagnosis, causes=[replace(first, aliases=[second.name]), second])
    content = to_dict(aliased)
    assert "It resembles cause 2: the data ask for both" in content["causes"][0]["words"]
    assert "cannot tell it from" not in content["causes"][0]["words"]
    assert "may as well be" not in content["sentences"][1]
    other = replace(first, aliases=[second.name, "background"])
    content = to_dict(replace(diagnosis, causes=[other, second]))
    assert get_effect("background").title in content["causes"][0]["words"]
    assert "one of them may as well be another effect" in content["sentences"][1]


def test_a_size_that_is_not_determined_is_explained(content):
    (cause,) = content["causes"]
    ((name, size),) = cause["parameters"].items()
    vague = {name: size | {"std": [size["limit"]] * len(WAVELENGTH)}}
    entry = cause | {"parameters": vague, "trades_with": ["hwp.w_sio2"]}
    words = _words.cause(entry, {})
    assert "do not tell its size" in words
    assert "changes of hwp.w_sio2" in words
    assert "do not tell" not in cause["words"]
    partly = cause | {"parameters": {name: size, "other": vague[name]}, "trades_with": []}
    assert "do not tell all of its size: a part of it hardly changes" in _words.cause(partly, {})


def test_what_can_be_exchanged_for_a_size_is_named():
    """The retardance of a plate without a law is open in the thicknesses of its materials."""
    chain, observations = data()
    model = nominal_model([chain], [observations]).with_effect(get_effect("hwp_retardance_free"))
    fitted = Fitted(model)
    assert set(fitted.trades("hwp_retardance_free")) & {"hwp.w_sio2", "hwp.w_mgf2"}
    gain = Fitted(model.with_effect(get_effect("beam_gain")))
    assert "hwp.w_sio2" not in gain.trades("beam_gain")


def test_significance_is_counted_from_where_an_effect_is_absent(found):
    """Also where the fit went on from another one, at which its prior then is centred."""
    again = found.improved.with_effect(get_effect("hwp_diattenuation"))
    values = [Fitted(model).significance("beam_gain") for model in (found.improved, again)]
    assert values[0] > 30
    assert values[1] == pytest.approx(values[0], rel=0.1)


def test_a_size_that_is_the_same_everywhere_is_given_once():
    size = {"value": [0.01, 0.01], "std": [0.001, 0.001], "unit": "", "limit": 1.0}
    assert _words.sizes({"a.b": size}) == ["a.b: 0.0100 +- 0.0010 at every wavelength"]


def test_effects_that_leave_the_gap_unexplained_are_no_causes(found, tmp_path):
    diagnosis = replace(several(found, [0.1, 0.1]), verdict="unexplained")
    content = to_dict(diagnosis)
    text = summary(diagnosis, content)
    assert "Cause" not in text
    assert "\nEffects that help; " in text
    assert "\nEffect 2: " in text
    write_html(diagnosis, tmp_path / "gap.html", content=content)
    page = (tmp_path / "gap.html").read_text(encoding="utf-8")
    assert "<h2>Effects that help, but do not explain the gap</h2>" in page


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (1.9, "1.90"),
        (0.108, "0.108"),
        (123.4, "123"),
        (12345.6, "12346"),
        (None, "-"),
        (0.0, "0.00"),
    ],
)
def test_percent(value, words):
    assert _words.percent(value) == words


def test_names_that_are_too_long():
    assert _words.shortened("short", 9) == "short"
    assert _words.shortened("dataset_2025-10-05", 9) == "data\N{HORIZONTAL ELLIPSIS}0-05"
    name = "dataset3_polarized_2025-10-05"
    assert _words.shortened(name, 19) == "dataset3\N{HORIZONTAL ELLIPSIS}2025-10-05"
    assert _words.shortened(name, 28) == "dataset3_polarize\N{HORIZONTAL ELLIPSIS}2025-10-05"
    # no room for a beginning
    assert _words.shortened(name, 9) == "data\N{HORIZONTAL ELLIPSIS}0-05"
    assert _words.in_title(["a", "b"]) == "a and b"
    assert _words.in_title(["a", "b", "c"]) == "a, b and 1 more"
    assert _words.in_title([]) == ""


def test_table(found, nothing):
    table = causes_table(found)
    assert table["effect"][0] == "beam_gain"
    assert table["gap_before"][0] > table["gap_after"][0]
    assert table["gap_before"].unit == u.percent
    assert causes_table(nothing).colnames == table.colnames


# ---- page ---------------------------------------------------------------------------------


class Page(HTMLParser):
    """Collects what a page consists of, and checks that its tags match."""

    void = {"meta", "img", "link", "br"}

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.links, self.images, self.words = [], [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        attrs = dict(attrs)
        self.links += [attrs[key] for key in ("src", "href") if key in attrs]
        if tag == "img":
            self.images.append(attrs)
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.words.append(text)


def test_page_is_self_contained_and_complete(found, content, tmp_path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3, 2))
    figure.subplots().plot([1, 2])
    path = tmp_path / "gap.html"
    write_html(found, path, figures={"Gap <of> the run": figure})
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    words = " ".join(" ".join(page.words).split())
    for sentence in content["sentences"]:
        assert sentence in words
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    assert not re.search(r"https?://|<script|@import|url\(", text)
    (image,) = page.images
    assert image["alt"] == "Gap <of> the run"
    assert base64.b64decode(image["src"].partition(",")[2]).startswith(b"\x89PNG")
    # what comes from a table or its name is no markup
    assert "run <b>&" in words
    assert "b" not in page.tags
    assert "summary" in page.tags
    assert len([w for w in page.words if re.fullmatch(r"\d{4}\.\d", w)]) == len(WAVELENGTH)


def test_page_of_nothing_and_of_the_unknown(nothing, unknown, tmp_path):
    for diagnosis, words in ((nothing, "No gap beyond"), (unknown, "A real gap, unexplained")):
        path = tmp_path / "gap.html"
        write_html(diagnosis, path)
        page = Page(path.read_text(encoding="utf-8"))
        assert words in " ".join(" ".join(page.words).split())
        assert page.images == []
    assert [p.name for p in tmp_path.iterdir()] == ["gap.html"]


def test_page_that_cannot_be_written(found, content, tmp_path):
    with pytest.raises(GapError, match="cannot be written"):
        write_html(found, tmp_path / "nowhere" / "gap.html", content=content)


# ---- frames that calibrate would mask ----------------------------------------------------------


def unusual(data):
    """A diagnosis with these observations, of which nothing but the frames is asked."""
    return SimpleNamespace(nominal=SimpleNamespace(observations=[data]))


def test_frames_of_an_unstable_lamp_are_said_to_be_used():
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH)
    meta = {"instrument": "CHARIS", "source": "polarized"}
    data = simulate(chain, WAVELENGTH, FRAMES, seed=1, meta=meta, name="run")
    assert _about_frames(unusual(data)) == []
    scale = np.ones(data.n_frames)
    scale[:2] = 3.0
    table = data.to_table()
    for side in ("left", "right"):
        table[f"flux_{side}"] *= np.repeat(scale, data.n_bins)
    data = Observations.from_table(table, name="run")
    n = data.n_frames
    words = f"2 of {n} frames of run (unstable lamp)."
    assert _about_frames(unusual(data)) == [f"Used here, though calibrate masks them: {words}"]
    # who masks them first, as calibrate does, has them left out
    lit = np.repeat(scale[:, None] > 1, data.n_bins, axis=1)
    masked = data.with_mask(lit, "unstable lamp")
    assert _about_frames(unusual(masked)) == [f"Left out, as the tables mask them: {words}"]
