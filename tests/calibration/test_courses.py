# Licensed under a 3-clause BSD style license - see LICENSE
"""Courses of optics over the years, and the page on the health of an instrument."""

import json
from dataclasses import replace
from itertools import pairwise

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Observations, calibrate, instruments
from astropolcal.calibration.result.calibration import validity_of, with_validity
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.pipeline import Entry, Library, changes, courses, health, parameter_history
from astropolcal.pipeline.monitoring import write_health
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[::5]
CHAIN = CHARIS.chain(derotator="linear", wavelength=WAVELENGTH)
FRAMES = half_wave_plate_cycles(derotator=[50, 65, 80, 95] * u.deg)
N = 8


def run(i, change=lambda truth, i: None, flux=3e6, **meta):
    truth = CHAIN.copy()
    change(truth, i)
    meta = {"date": f"{2020 + i // 2}-{1 + 6 * (i % 2)}-01", "source": "polarized"} | meta
    table = simulate(truth, WAVELENGTH, FRAMES, seed=i, flux=flux, meta=meta, name=f"run {i}")
    return calibrate(CHAIN, table, instrument="charis", cross_validate=False)


def replaced(truth, i):
    if i >= 5:
        truth["wollaston"].efficiency = truth["wollaston"].efficiency.value - 0.01


def drifting(truth, i):
    truth["hwp"].theta = 0.1 * i * u.deg


def slipping(truth, i):
    truth["hwp"].theta = [0.5, -0.4, 0.1, 0.6, -0.6, 0.3, -0.2, 0.45][i] * u.deg


@pytest.fixture(scope="module")
def steady():
    return [run(i) for i in range(N)]


@pytest.fixture(scope="module")
def worn():
    """A prism that is replaced and a plate that drifts."""

    def change(truth, i):
        replaced(truth, i)
        drifting(truth, i)

    return [run(i, change) for i in range(N)]


def by_optic(table):
    return {row["what"]: row for row in table}


def test_what_is_constant_is_not_said_to_change(steady):
    for row in courses(steady):
        chances = np.array([row[key] for key in ("constant", "steps", "drift", "walk", "scatter")])
        assert row["course"] == "constant", row
        assert chances.sum() == pytest.approx(1)
        assert (row["when"], row["or"]) == ("", "")


def test_a_step_and_a_drift_are_found_and_dated(worn):
    table = courses(worn)
    assert [", ".join(names) for names in table.meta["rivals"]] == [*table["or"]]
    found = by_optic(table)
    assert found["wollaston"]["course"] == "steps"
    assert found["wollaston"]["when"] == "2022-01-01 to 2022-07-01"
    assert found["hwp.theta"]["course"] == "drift"
    assert found["calibration_polarizer"]["course"] == "constant"


@pytest.mark.slow
def test_what_differs_from_run_to_run_is_neither_a_drift_nor_a_single_step():
    (row,) = courses([run(i, slipping) for i in range(N)], ["hwp.theta"])
    assert row["constant"] < 1e-6
    assert row["drift"] < 0.01
    assert row["scatter"] + row["walk"] > 0.5


@pytest.mark.slow
def test_an_event_makes_a_faint_change_more_probable():
    def faint(truth, i):
        truth["hwp"].theta = 0.12 * (i >= 4) * u.deg

    runs = [run(i, faint) for i in range(N)]
    chance = [courses(runs, ["hwp.theta"], events=e)["steps"][0] for e in ((), ("2021-10-01",))]
    assert chance[1] > chance[0]


def test_what_only_a_combination_of_optics_tells_is_a_change(steady):
    """A lamp tells less of each stage than of the stages against each other."""

    def turned(truth, i):
        truth["hwp"].theta = 0.4 * (i >= 3) * u.deg

    runs = [run(i, turned, flux=3e4) for i in range(6)]
    sigma = [changes(pair, ["hwp", "calibration_polarizer"])["sigma"] for pair in pairwise(runs)]
    assert np.max(sigma) < 3
    found = by_optic(courses(runs))
    assert found["hwp.theta"]["probability"] > 0.9
    assert found["hwp.theta"]["when"] == "2021-01-01 to 2021-07-01"


@pytest.mark.long
def test_errors_that_rest_on_few_settings_are_no_change():
    """The derotator stops somewhere else at each of four settings, in each run."""
    for seed in range(3):
        rng, runs = np.random.default_rng(seed), []
        for i in range(6):
            seen = FRAMES.copy()
            seen["derotator"] = seen["derotator"] + np.repeat(rng.normal(0, 0.15, 4), 8) * u.deg
            meta = {"date": f"{2010 + i}-01-01", "source": "polarized"}
            noise = {"seed": 10 * seed + i, "flux": 3e6}
            table = simulate(CHAIN, WAVELENGTH, seen, meta=meta, **noise).to_table()
            table["derotator"] = FRAMES["derotator"][np.asarray(table["frame"])]
            data = Observations.from_table(table, name=f"run {i}")
            runs.append(calibrate(CHAIN, data, instrument="charis", cross_validate=False))
        assert set(courses(runs)["course"]) == {"constant"}, seed


def test_another_turn_of_a_retardance_is_no_change(steady):
    """A fit may end a turn away: the same retarder."""
    turned = run(N)
    angle = turned.chain["derotator"].retardance
    angle.value = angle.value + 360 * (np.arange(len(WAVELENGTH)) == 1)
    for leaf in turned.chains:
        leaf["derotator"].retardance.value = angle.value
    table = changes([steady[-1], turned], ["derotator"])
    assert table["sigma"].max() < 5
    values = parameter_history([steady[-1], turned], ["derotator.retardance"])
    first, second = (values["value"][values["calibration"] == c] for c in ("run 7", "run 8"))
    assert np.abs(first - second).max() < 5


def test_what_gives_no_course_is_refused(steady):
    undated = calibrate(
        CHAIN, simulate(CHAIN, WAVELENGTH, FRAMES, seed=90, name="x"), cross_validate=False
    )
    cases = [
        (ParameterError, steady[:2], {}, "2 calibrations: at least three"),
        (ParameterError, [*steady[:3], undated], {}, "x has no date"),
        (ParameterError, [*steady[:3], run(20, date="2020-01-01")], {}, "neither comes first"),
        (FitError, [*steady[:3], steady[0]], {}, "neither comes first|both made from"),
        (ParameterError, steady, {"events": ["2020-02-01", "2020-03-01"]}, "another one lies"),
        (ParameterError, steady, {"events": ["soon"]}, "'soon' is not a date"),
        (ParameterError, steady, {"parameters": ["mirror"]}, "no free parameter 'mirror'"),
    ]
    for error, runs, options, message in cases:
        with pytest.raises((error, ParameterError), match=message) as info:
            courses(runs, **options)
        assert "\n" not in str(info.value)


@pytest.fixture(scope="module")
def folder(worn, tmp_path_factory):
    path = tmp_path_factory.mktemp("library")
    library = Library(path)
    for calibration in worn:
        library.add(calibration)
    return path


def test_health_says_what_needs_care(folder):
    content = health(folder, now="2030-01-01", goal=1e-6)
    (group,) = content["groups"]
    assert json.loads(json.dumps(content)) == content
    assert [one["what"] for one in group["events"]] == ["wollaston"]
    assert (group["events"][0]["from"], group["events"][0]["to"]) == ("2022-01-01", "2022-07-01")
    alarms = " ".join(group["alarms"])
    assert "of 2023-07-01" in alarms
    assert "hwp.theta is not constant" in alarms
    assert "the goal is 1e-06 %" in alarms
    (fresh,) = health(folder, now="2023-08-01", max_age=4 * u.yr)["groups"]
    assert not any("days old" in words for words in fresh["alarms"])
    # it is as old as its data, whatever is stated of when it holds
    entry = Library(folder).entries[-1]
    for start, words in (("2029-06-01", "of 2023-07-01, 2376 days old"), ("2020-01-01", "2376")):
        stated = with_validity(entry.calibration, valid_from=start)
        library = Library([])
        library.entries = [Entry(entry.path, stated, validity_of(stated), "0")]
        assert words in " ".join(health(library, now="2030-01-01")["groups"][0]["alarms"])
    for options in ({"goal": -1}, {"max_age": 3 * u.m}, {"goal": "high"}):
        with pytest.raises(
            ParameterError,
            match=r"one positive number, of %|not convertible to d|not a number|needs a unit",
        ):
            health(folder, **options)
    for events, words in ((["soon"], "is not a date"), (["2022-03-01"] * 2, "two of one date")):
        with pytest.raises(ParameterError, match=words):
            health(folder, events=events)


@pytest.mark.slow
def test_each_of_two_steps_of_an_optic_is_an_event_with_its_own_probability(steady, tmp_path):
    """The second is faint beside the first."""

    def twice(truth, i):
        lost = 0.01 * (i >= 2) + 0.0008 * (i >= 5)
        truth["wollaston"].efficiency = truth["wollaston"].efficiency.value - lost

    for i in range(N):
        Library(tmp_path).add(steady[i] if i < 2 else run(i, twice))
    (group,) = health(tmp_path, now="2024-01-01")["groups"]
    first, second = group["events"]
    assert {first["what"], second["what"]} == {"wollaston"}
    assert (first["from"], first["to"]) == ("2020-07-01", "2021-01-01")
    assert second["from"] >= "2021-07-01"
    assert second["probability"] < first["probability"]


def test_a_change_is_dated_by_the_data_whatever_is_stated_of_when_they_hold(worn):
    stated = [with_validity(one, valid_from=f"{2010 + i % 3}-01-01") for i, one in enumerate(worn)]
    assert courses(stated).meta == courses(worn).meta
    dates = [parameter_history(some)["date"].iso.tolist() for some in (stated, worn)]
    assert dates[0] == dates[1]
    library = Library([])
    library.entries = [
        Entry(f"{i}.asdf", one, validity_of(one), str(i)) for i, one in enumerate(stated)
    ]
    (group,) = health(library, now="2024-01-01")["groups"]
    (event,) = group["events"]
    assert (event["from"], event["to"]) == ("2022-01-01", "2022-07-01")


def test_health_of_a_moment_knows_nothing_of_what_is_dated_later(folder, capsys):
    """Such as a calibration of 2052 that is one of 2025: every older one would count as fresh."""
    (group,) = health(folder, now="2021-12-31")["groups"]
    # of the next day in another time zone
    assert [one["date"] for one in group["calibrations"]][-1] == "2022-01-01"
    assert len(group["calibrations"]) == 5
    assert [words.partition(" is of ")[2] for words in group["left_out"]] == [
        f"{date}, after 2021-12-31" for date in ("2022-07-01", "2023-01-01", "2023-07-01")
    ]
    assert not group["events"]
    for moment, alarm in (("2020-03-01", []), ("2021-05-01", ["2021-01-01", "120 days old"])):
        (group,) = health(folder, now=moment, max_age=90 * u.day)["groups"]
        assert all(words in " ".join(group["alarms"]) for words in alarm)
    assert main(["health", str(folder), "--date", "2019-01-01"]) in (0, None)
    out = capsys.readouterr().out
    assert "Not compared: 0 calibrations with a date; courses need at least three" in out
    assert "Next: Calibrate: no calibration is of 2019-01-01 or before." in out


def test_health_of_a_mode_however_it_is_written(steady):
    modes, library = ("Broadband", "broadband", "BROADBAND"), Library([])
    stated = [with_validity(one, mode=mode) for one, mode in zip(steady, modes, strict=False)]
    library.entries = [
        Entry(f"{i}.asdf", one, validity_of(one), str(i)) for i, one in enumerate(stated)
    ]
    (group,) = health(library, now="2021-01-01")["groups"]
    assert (group["mode"], len(group["calibrations"])) == ("BROADBAND", 3)
    assert group["courses"]


def test_health_says_that_changes_about_a_restart_are_unsure(steady):
    new = replace(steady[2], settings=steady[2].settings | {"restarted": {"from": "", "free": []}})
    for calibrations, count in ((steady[:3], 0), ([*steady[:2], new], 1)):
        library = Library([])
        library.entries = [
            Entry(f"{i}.asdf", one, validity_of(one), str(i)) for i, one in enumerate(calibrations)
        ]
        (group,) = health(library, now="2021-01-01")["groups"]
        assert sum("whose errors are not in its own" in words for words in group["alarms"]) == count
        assert group["courses"]
    # what lies before all runs is no reason for a change between two
    for event, count in (("1990-01-01", 1), ("2020-03-01", 0)):
        (group,) = health(library, now="2021-01-01", events=[event])["groups"]
        words = f"event {event} is not between two of the runs, and has no part."
        assert group["alarms"].count(words) == count, event


def test_what_was_done_after_all_calibrations_is_an_alarm_and_what_is_to_come_is_refused(steady):
    for calibrations in (steady[:1], steady[:3]):
        library = Library([])
        library.entries = [
            Entry(f"{i}.asdf", one, validity_of(one), str(i)) for i, one in enumerate(calibrations)
        ]
        (group,) = health(library, now="2031-01-01", events=["2030-12-31"])["groups"]
        told = [words for words in group["alarms"] if "done on 2030-12-31" in words]
        assert len(told) == 1, group["alarms"]
        with pytest.raises(ParameterError, match="event 2031-01-03: allowed are dates up to now"):
            health(library, now="2031-01-01", events=["2031-01-03"])


@pytest.mark.slow
def test_the_command_writes_a_page_and_numbers(folder, tmp_path, capsys):
    page, numbers = tmp_path / "health.html", tmp_path / "health.json"
    options = ["--html", str(page), "--json", str(numbers), "--date", "2024-01-01"]
    assert main(["health", str(folder), *options]) in (0, None)
    out = capsys.readouterr().out
    assert "wollaston changed between 2022-01-01 and 2022-07-01 (100 %)" in out
    assert max(len(line) for line in out.splitlines() if str(tmp_path) not in line) <= 80
    text = page.read_text()
    assert text.count("<img") >= 4
    assert "wollaston changed" in text
    assert json.loads(numbers.read_text())["groups"][0]["events"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(ParameterError, match="no calibration"):
        health(tmp_path / "empty")


def test_a_page_escapes_what_it_shows(tmp_path):
    content = {"now": "2030-01-01", "groups": [], "unreadable": {"<b>.asdf": "<script>"}}
    write_health(content, tmp_path / "page.html")
    assert "<script>" not in (tmp_path / "page.html").read_text()
