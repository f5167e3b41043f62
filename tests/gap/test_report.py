# Licensed under a 3-clause BSD style license - see LICENSE
"""What a report says in numbers, and as a page."""

import base64
import json
import re
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.fitting import TRFLSQFitter
from gap_data import WAVELENGTH, chain, fitted, frames, observed, with_effect
from matplotlib.figure import Figure

from astropolcal import Normal, Observations, calibrate, instruments
from astropolcal.exceptions import GapError
from astropolcal.gap import diagnose, get_effect
from astropolcal.gap.attribution import Candidate
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import Context
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.model import nominal_model
from astropolcal.gap.problem import GapProblem
from astropolcal.gap.report import (
    MAP,
    Fitted,
    _about_frames,
    accuracies,
    causes_table,
    summary,
    to_dict,
    with_causes,
    write_html,
)
from astropolcal.simulation import simulate

SIZE = 0.012
CONTRACT = {
    *("verdict", "sentences", "nominal", "n_free", "seconds", "frames", "noise_floor_percent"),
    *("gap_before_percent", "gap_after_percent", "double_difference", "where", "where_left"),
    *("causes", "accuracy_before", "accuracy_after", "next_observations"),
}
CAUSE = {
    *("rank", "probability", "effect", "title", "cell", "aliases", "size", "explained", "words"),
    *("left_out_before_percent", "left_out_after_percent", "double_difference_share", "physical"),
}
ASKED = {"effects": ["beam_gain", "hwp_diattenuation", "hwp_tilt"], "cells": False}


def data(size=0.0, **options):
    gain = with_effect("beam_gain", imbalance=size)
    return observed(gain, name="run <b>&", meta={"source": "polarized"}, **options)


@pytest.fixture(scope="module")
def found():
    """Diagnosis of unequal gains."""
    return diagnose(chain(), data(SIZE), **ASKED)


@pytest.fixture(scope="module")
def content(found):
    return to_dict(found)


@pytest.fixture(scope="module")
def nothing():
    """Diagnosis of a model that lacks nothing."""
    return diagnose(chain(), data(), **ASKED)


@pytest.fixture(scope="module")
def unknown():
    """Diagnosis with a library that lacks the effect."""
    return diagnose(chain(), data(SIZE), effects=["hwp_encoder_eccentricity"], cells=False)


@dataclass
class Fault:
    """Stands for a frame that is not what the table says."""

    words: str = "frame 29 of lamp: another plate angle (98 %)"

    def to_dict(self):
        own = {"dataset": "lamp", "frame": 29, "what": "hwp angle", "with": None}
        return own | {"value": 22.5, "probability": 0.98, "words": self.words}


def with_cell(diagnosis, cell, **values):
    """Return a diagnosis whose improved model has a cell in it, and says that it is a cause."""
    effect = CellEffect(cell, 0)
    model = diagnosis.nominal.with_effect(effect)
    return replace(
        diagnosis,
        verdict="located",
        improved=model,
        causes=[replace(diagnosis.causes[0], effect=effect, cell=cell, **values)],
    )


# ---- numbers --------------------------------------------------------------------------------


@pytest.mark.slow
def test_contract(content, nothing, unknown):
    for one in (content, to_dict(nothing), to_dict(unknown)):
        assert set(one) >= CONTRACT
        # finite or null, and nothing but plain types
        assert json.loads(json.dumps(one, allow_nan=False)) == one
        assert all(set(cause) >= CAUSE for cause in one["causes"])
        assert set(one["double_difference"]) == {"before_percent", "after_percent", "noise_percent"}
    assert (content["verdict"], content["causes"][0]["effect"]) == ("named", "beam_gain")
    assert to_dict(nothing)["verdict"] == "none"
    assert to_dict(unknown)["verdict"] == "unexplained"


@pytest.mark.slow
def test_gap_is_that_of_left_out_frames(found, content):
    assert content["cross_validated"]
    for when in ("before", "after"):
        expected = getattr(found, f"gap_{when}_percent")
        assert content[f"gap_{when}_percent"] == pytest.approx(expected, rel=1e-6)
        assert content["causes"][0][f"left_out_{when}_percent"] == pytest.approx(expected)
    # noise is all that is left
    assert content["gap_after_percent"] < 1.3 * content["noise_floor_percent"]
    shrunk = content["shrinkage_percent"]
    assert shrunk["low"] <= shrunk["value"] <= shrunk["high"]
    # that of the nominal model is what calibrate says
    known = calibrate(chain(), data(SIZE), instrument="charis").accuracy["s_cv"].value
    stated = content["accuracy_before"]["datasets"][0]["s_cv_percent"]
    assert stated == pytest.approx(np.median(known), rel=1e-3)
    fit = to_dict(replace(found, held_out=[]))
    assert not fit["cross_validated"]
    assert fit["gap_after_percent"] < fit["gap_before_percent"]
    assert fit["accuracy_before"]["datasets"][0]["s_cv_percent"] is None
    assert fit["double_difference"]["before_percent"] != pytest.approx(
        content["double_difference"]["before_percent"]
    )


@pytest.mark.slow
def test_unequal_gains_cancel_in_double_differences(content):
    (cause,) = content["causes"]
    assert cause["double_difference_share"] < 0.01
    double = content["double_difference"]
    assert double["before_percent"] == pytest.approx(double["after_percent"], rel=0.1)
    # the mean of two frames has less noise than one
    ratio = double["noise_percent"] / content["noise_floor_percent"]
    assert ratio == pytest.approx(np.sqrt(0.5), rel=0.01)
    assert content["gap_before_percent"] > 5 * content["gap_after_percent"]


@pytest.mark.slow
def test_what_turns_with_the_derotator_is_left_in_double_differences(nothing):
    model = nothing.nominal.with_effect(CellEffect(Cell("in:derotator", "rotation", "time"), 0))
    share = Fitted(model).double_share("in:derotator/rotation/time")
    assert 0.5 < share <= 1


@pytest.mark.slow
def test_double_differences_are_those_of_calibrate(found, content):
    model = found.nominal
    calibration = calibrate(model.chains, model.observations)
    (table,) = [record.accuracy for record in calibration.datasets]
    gap = np.sqrt(np.average(table["s_cv"].value ** 2, weights=table["n"]))
    assert content["double_difference"]["before_percent"] == pytest.approx(gap, rel=1e-3)
    # and none where frames form no pairs
    single = frames()[:12]
    single["hwp"] = np.linspace(0, 40, 12) * u.deg
    alone = simulate(chain(), WAVELENGTH, single, seed=1)
    unpaired = SimpleNamespace(chains=[chain()], observations=[alone], problem=model.problem)
    assert Fitted(unpaired).doubles is None


def test_frames_that_no_other_foresees_do_not_make_the_gap_smaller():
    """A wavelength has data at one derotator angle only, which alone determine its retardance."""
    clouds = np.zeros((32, len(WAVELENGTH)), dtype=bool)
    clouds[8:, 3] = True
    seen = observed(flux=1e4).with_mask(clouds, "clouds")
    model = nominal_model([chain()], [seen])
    (table,) = [record.accuracy for record in calibrate(chain(), seen).datasets]
    known = np.isfinite(table["s_cv"].value)
    gap = np.sqrt(np.average(table["s_cv"].value[known] ** 2, weights=table["n"][known]))
    assert not known.all()
    assert accuracies(Fitted(model))["rms_percent"] == pytest.approx(gap, rel=1e-3)


@pytest.mark.slow
def test_what_was_worked_out_is_only_shown(found, content, tmp_path, monkeypatch):
    """No fit, however often and in which form a diagnosis is written."""

    def fit(*args, **kwargs):
        raise AssertionError("a serializer fits")

    monkeypatch.setattr("scipy.optimize.least_squares", fit)
    monkeypatch.setattr(TRFLSQFitter, "__call__", fit)
    monkeypatch.setattr(GapProblem, "fit", fit)
    for _ in range(2):
        told = to_dict(found)
        assert told == content
        # what a user does with it is not remembered
        told["causes"].clear()
        assert summary(found)
        write_html(found, tmp_path / "gap.html")


@pytest.mark.slow
def test_sizes_are_those_of_the_simulation(content):
    (cause,) = content["causes"]
    (entry,) = cause["size"].values()
    value, std = np.array(entry["value"]), np.array(entry["std"])
    assert np.all(np.abs(value - SIZE) < 4.5 * std)
    assert np.all((std > 0) & (std < 0.1 * SIZE))
    assert cause["significance"] > 30


def test_angles_of_cells_are_in_degrees(found):
    located = with_cell(found, Cell("in:derotator", "retardance_h", "time"))
    (entry,) = to_dict(located)["causes"][0]["size"].values()
    model = located.improved
    (radian,) = model.added[located.causes[0].name]
    assert entry["unit"] == "deg"
    size = radian.basis @ model.fit.coefficients[model.problem.slices[radian.name]]
    assert entry["value"] == pytest.approx(np.rad2deg(size))


def test_errors_of_a_law_know_of_bends_that_the_data_hardly_show():
    """A gain that is one number, of light whose gain changes a little with the wavelength."""
    effect = CellEffect(Cell("detector", "gain", "constant"), 0)
    edit = effect.edit([chain()], Context(WAVELENGTH.to_value(u.um)))
    name, line = edit.parameters[0].name, np.linspace(-1, 1, len(WAVELENGTH))
    for bend in (0, 0.03, 0.05):
        true = SIZE * (1 + bend * line)
        edit.chains[0][name.split(".")[0]].amplitude = true
        report = Fitted(fitted(observed(edit.chains[0], noise=False)).with_effect(effect))
        (size,) = report.sizes(effect.name).values()
        std, rows = np.array(size["std"]), report.problem.slices[name]
        assert np.all(np.abs(size["value"] - true) < 1.5 * std), bend
        # they hardly grow where there is no bend
        assert bend or std.max() < 1.4 * np.sqrt(report.covariance[rows, rows].item())


@pytest.mark.slow
def test_the_sky_is_that_of_calibrate(content, nothing):
    for when in ("before", "after"):
        targets = content[f"accuracy_{when}"]["targets"]
        assert [one["dolp_percent"] for one in targets] == [30.0, 1.0, 0.1]
        assert all(one["s_p_percent"] > 0 for one in targets)
    same = to_dict(nothing)
    assert same["accuracy_before"] == same["accuracy_after"]


def test_what_can_be_exchanged_for_a_size_is_named():
    """The retardance of a plate without a law is open in the thicknesses of its materials."""
    charis = instruments.get("charis")
    wavelength = charis.wavelength[[2, 6, 10, 14, 18, 20]]
    nominal = charis.chain(derotator="linear", wavelength=wavelength)
    model = nominal_model([nominal], [simulate(nominal, wavelength, frames(), seed=3)])
    model = model.with_effect(get_effect("hwp_retardance_free"))
    assert set(Fitted(model).trades("hwp_retardance_free")) & {"hwp.w_sio2", "hwp.w_mgf2"}


def test_significance_is_counted_from_where_an_effect_is_absent(found):
    """Also where the fit went on from another one, at which its prior then is centred."""
    again = found.improved.with_effect(get_effect("hwp_diattenuation"))
    values = [Fitted(model).significance("beam_gain") for model in (found.improved, again)]
    assert values[1] == pytest.approx(values[0], rel=0.1)


def test_frames_to_distrust_are_in_the_first_sentence(found):
    faulty = replace(found, frames=[Fault()])
    content = to_dict(faulty)
    assert Fault().words in content["sentences"][0]
    assert content["frames"][0]["frame"] == 29
    assert summary(faulty).replace("\n", " ").startswith(content["sentences"][0])


def test_an_alternative_has_no_size_and_the_nominal_model_no_prediction(found):
    (cause,) = found.causes
    swapped = replace(cause, effect=get_effect("beams_swapped"), before=None, after=None)
    improved = replace(found.improved, added={"beams_swapped": []})
    content = to_dict(replace(found, improved=improved, causes=[swapped]))
    (entry,) = content["causes"]
    assert content["accuracy_before"]["datasets"][0]["s_cv_percent"] is None
    assert entry["size"] == {}
    assert entry["double_difference_share"] is None
    assert entry["left_out_before_percent"] is None
    assert entry["left_out_after_percent"] == found.held_out[0].percent


@pytest.mark.slow
def test_table(found, nothing):
    other = Candidate(get_effect("background"), None, 30.0, 2, 10.0)
    grouped = replace(found, causes=[replace(found.causes[0], aliases=[(other, 0.3)])])
    table = causes_table(grouped)
    assert table["effect"][0] == "beam_gain"
    assert table["cannot_be_told_from"][0] == "background"
    assert table["gap_before"][0] > table["gap_after"][0]
    assert table["gap_before"].unit == u.percent
    assert causes_table(nothing).colnames == table.colnames
    page = grouped._repr_html_()
    assert page.startswith("<p>Diagnosis: ")
    assert "<th>probability</th>" in page


@pytest.mark.slow
def test_the_first_lines_are_the_summary(found, content):
    lines = summary(found, ["gap.html"]).splitlines()
    assert max(map(len, lines)) <= 80
    words = " ".join(" ".join(lines[:24]).split())
    for sentence in content["sentences"]:
        assert sentence in words
    assert "gap.html" in words
    assert "gap_beam_gain.imbalance" not in words


# ---- page -----------------------------------------------------------------------------------


class Page(HTMLParser):
    """Collects what a page consists of, and checks that its tags match."""

    void = {"meta", "img", "link", "br", "source"}

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.links, self.images, self.words = [], [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        attrs = dict(attrs)
        self.links += [attrs[key] for key in ("src", "srcset", "href") if key in attrs]
        if tag == "img":
            self.images.append(attrs)
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, text):
        self.words.append(text)

    @property
    def text(self):
        return " ".join(" ".join(self.words).replace("\u2011", "-").split())


@pytest.mark.slow
def test_page_is_self_contained_and_complete(found, content, tmp_path):
    figure = Figure(figsize=(3, 2))
    axes = figure.subplots()
    axes.set_xticks(range(8), labels=[f"10{i}.5" for i in range(8)])
    axes.tick_params(axis="x", length=0)
    path = tmp_path / "gap.html"
    figure.suptitle("a title")
    drawn = []

    def look():
        turned = {label.get_rotation() for label in axes.get_xticklabels()}
        return turned, figure.get_size_inches().tolist()

    figure.savefig = lambda *args, **options: drawn.append(look())
    before = look(), axes.get_subplotspec()
    image = Figure()
    image.subplots().set_xticks([])
    image.axes[0].tick_params(axis="x", length=0)
    write_html(found, path, figures={"Gap": figure, "without ticks": image})
    assert (look(), axes.get_subplotspec()) == before, "the figures are the caller's"
    # on a telephone names of groups of frames do not stand in each other
    assert [turned for turned, _ in drawn] == [{0}, {90}]
    del figure.savefig
    write_html(found, path, figures={"Gap <of> the run": figure, MAP: figure})
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    for sentence in content["sentences"]:
        assert sentence in page.text
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    assert not re.search(r"https?://|<script|@import|url\(", text)
    # the map stands with the causes, before all other figures
    assert [image["alt"] for image in page.images] == [MAP, "Gap <of> the run"]
    assert base64.b64decode(page.links[0].partition(",")[2]).startswith(b"\x89PNG")
    # what comes from a table or its name is no markup
    assert "run <b>&" in page.text
    assert "b" not in page.tags
    assert {f"{nm:.1f}" for nm in WAVELENGTH.to_value(u.nm)} <= set(page.words)


@pytest.mark.slow
def test_page_of_every_verdict(found, nothing, unknown, tmp_path):
    located = with_cell(found, Cell("in:derotator", "rotation", "time"), probability=0.95)
    for diagnosis, words in (
        (nothing, "No gap beyond"),
        (unknown, "A real gap, unexplained"),
        (located, "rotation (circular retardance) of the derotator that drifts"),
    ):
        write_html(diagnosis, tmp_path / "gap.html")
        page = Page((tmp_path / "gap.html").read_text(encoding="utf-8"))
        assert words in page.text
        assert page.images == []
    assert [p.name for p in tmp_path.iterdir()] == ["gap.html"]


@pytest.mark.slow
def test_page_that_cannot_be_written(found, content, tmp_path):
    with pytest.raises(GapError, match="cannot be written"):
        write_html(found, tmp_path / "nowhere" / "gap.html")


# ---- frames that calibrate would mask -----------------------------------------------------------


def test_frames_of_an_unstable_lamp_are_said_to_be_used():
    def about(data):
        return _about_frames(SimpleNamespace(nominal=SimpleNamespace(observations=[data])))

    meta = {"instrument": "CHARIS", "source": "polarized"}
    data = observed(meta=meta, name="run")
    assert about(data) == []
    scale = np.ones(data.n_frames)
    scale[:2] = 3.0
    table = data.to_table()
    for side in ("left", "right"):
        table[f"flux_{side}"] *= np.repeat(scale, data.n_bins)
    data = Observations.from_table(table, name="run")
    words = f"2 of {data.n_frames} frames of run (unstable lamp)."
    assert about(data) == [f"Used here, though calibrate masks them: {words}"]
    # who masks them first, as calibrate does, has them left out
    lit = np.repeat(scale[:, None] > 1, data.n_bins, axis=1)
    masked = data.with_mask(lit, "unstable lamp")
    (told,) = about(masked)
    assert told.endswith(words)
    # a datum that the diagnosis itself leaves out is no frame that the table masks
    lit[:, 1:] = False
    told, *_ = about(data.with_mask(lit, "not as the table says"))
    assert told.startswith("Left out in whole or in part: 2 of ")


def test_what_takes_a_parameter_off_its_prior_may_be_what_the_model_lacks():
    """Crosstalk of the beams fits as a lower efficiency, which is known not to be so low."""
    seen = data()
    for known, sigma, verdict in ((0.97, None, "none"), (0.705, 28, "unexplained")):
        model = chain()
        model["wollaston"].efficiency.prior = Normal(known, 0.01)
        told = to_dict(diagnose(model, seen, **ASKED))
        assert told["verdict"] == verdict
        against = told["accuracy_after"]["against_prior"]
        assert (against and round(against["sigma"])) == sigma
        says = "it is 28 standard deviations from its prior, and may stand for something"
        assert (says in " ".join(told["sentences"])) == bool(sigma)


def test_a_model_that_agrees_but_has_no_usable_calibration_is_not_praised_alone():
    """The polarizer was left in: a mirror that polarizes like one describes the data to noise."""
    charis, grid = instruments.get("charis"), [1.2, 1.45, 1.6, 1.9, 2.2] * u.um
    chains = {
        source: charis.chain(source, derotator="linear", wavelength=grid)
        for source in ("polarized", "unpolarized")
    }
    for true, says in (("unpolarized", False), ("polarized", True)):
        seen = simulate(chains[true], grid, frames(), seed=2, meta={"source": "unpolarized"})
        told = to_dict(diagnose(chains["unpolarized"], seen, **ASKED))
        assert told["verdict"] == "none"
        assert ("as no mirror does" in " ".join(told["accuracy_after"]["unusable"])) == says
        assert ("as no mirror does" in told["sentences"][1]) == says


def test_an_improved_model_is_a_calibration_with_the_sizes_and_errors_of_the_report(found, nothing):
    report = Fitted(found.improved)
    seen, same = (with_causes(one, "charis") for one in (report, Fitted(nothing.improved)))
    # of the instrument that is asked for, with and without causes
    assert [seen.instrument, same.instrument] == ["charis"] * 2
    (cause,) = found.causes
    for name, size in report.sizes(cause.name).items():
        optic, key = name.split(".")
        std = [seen.covariance.std(f"{name}[{i}]") for i in range(len(size["std"]))]
        assert np.allclose(getattr(seen.chains[0][optic], key), size["value"])
        assert np.allclose(std, size["std"], rtol=0.01)


@pytest.mark.slow
def test_what_no_datum_says_of_a_cause_is_no_larger_than_usual():
    """A static retarder along the axes that the derotator has at few angles may be anything."""
    truth = with_effect("static_retarder", horizontal=0.02, diagonal=-0.05)
    asked = {"effects": ["static_retarder"], "cells": False, "cross_validate": False}
    found = diagnose(chain(), observed(truth, seed=2, flux=1e7), **asked)
    sizes = Fitted(found.improved).sizes("static_retarder")
    diagonal, horizontal = (
        sizes[f"gap_static_retarder.{key}"] for key in ("diagonal", "horizontal")
    )
    assert np.allclose(diagonal["value"], -0.05, atol=0.01)
    assert np.abs(horizontal["value"]).max() < 1
    assert 1 < np.max(horizontal["std"]) < 10
