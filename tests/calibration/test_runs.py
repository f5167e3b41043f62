# Licensed under a 3-clause BSD style license - see LICENSE
"""One likelihood of many runs: what they share, what changed, and what is said of it."""

import json
from concurrent.futures import ProcessPoolExecutor

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, calibrate, instruments
from astropolcal.calibration import calibrate_runs
from astropolcal.exceptions import AstropolcalError
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
GRID = [1200, 1600, 2000] * u.nm
FRAMES = half_wave_plate_cycles(derotator=[50, 65, 80, 95] * u.deg)


def make_chain():
    chain = CHARIS.chain(derotator="linear", wavelength=GRID)
    chain["wollaston"].efficiency = [0.98, 0.975, 0.97]
    return chain


def make_runs(angles, seed=0, years=range(2001, 2050), flux=1e6):
    """Return a table of each run, whose plate is turned by the angles."""
    tables = []
    for i, (angle, year) in enumerate(zip(angles, years, strict=False)):
        truth = make_chain()
        truth["hwp"].theta = angle * u.deg
        meta = {"date": f"{year}-03-01", "instrument": "CHARIS"}
        name = f"run {i}"
        made = simulate(truth, GRID, FRAMES, seed=seed + i, flux=flux, meta=meta, name=name)
        tables.append(made)
    return tables


def elements(found, name, i=0):
    """Return value and error of a parameter of a run as floats."""
    row = found.values(name)[i]
    return tuple(np.atleast_1d(getattr(x, "value", x)) for x in (row["value"], row["std"]))


def test_it_is_the_fit_of_calibrate():
    """Of independent data of the same noise both have the same values and errors."""
    tables, chain = make_runs([0.2] * 3), make_chain()
    runs = calibrate_runs(chain, tables, vary=None, errors="white")
    levels = [runs.runs["rms_alone"][i].to_value(u.one) for i in range(3)]
    sizes = [calibrate(chain, t, cross_validate=False).fit["n_data"] for t in tables]
    free = 11
    noise = [lev * np.sqrt(n / (n - free)) for lev, n in zip(levels, sizes, strict=True)]
    sigma = np.repeat(noise, sizes)
    one = calibrate(chain, tables, weights=sigma, errors="white", cross_validate=False)
    known = one.parameter_values()
    for name in ("hwp.theta", "hwp.w_sio2", "derotator.retardance", "wollaston.efficiency"):
        value, std = elements(runs, name)
        np.testing.assert_allclose(std, known[name]["std"], rtol=1e-2)
        assert np.all(np.abs(value - np.ravel(known[name]["value"])) < 0.02 * std), name


@pytest.mark.parametrize(
    ("course", "angles"),
    [
        ("constant", np.zeros(8)),
        ("steps", 0.3 * (np.arange(8) > 4)),
        ("steps", 0.3 * (np.arange(8) > 4) - 0.5 * (np.arange(8) > 1)),
        ("drift", np.linspace(-0.3, 0.3, 8)),
        ("scatter", [0.3, -0.2, 0.5, -0.4, 0.1, -0.5, 0.4, -0.1]),
    ],
)
def test_what_changed_is_named(course, angles):
    found = calibrate_runs(make_chain(), make_runs(angles))
    assert found.converged
    varying = {r["what"]: r for r in found.courses if r["course"] != "constant"}
    assert set(varying) == ({"hwp.theta"} if course != "constant" else set())
    if varying:
        row = varying["hwp.theta"]
        assert row["course"] == course
        assert row["probability"] > 0.9
        assert ("2005-03-01 to 2006-03-01" in row["when"]) == (course == "steps")
        assert "hwp.theta" in str(found)
    for i, angle in enumerate(angles):
        value, std = elements(found, "hwp.theta", i)
        assert abs(value - angle) < 4 * std < 0.4


@pytest.mark.long
def test_errors_are_as_large_as_the_deviations():
    pulls, wrong = [], 0
    for seed in range(12):
        step = 0.3 * (np.arange(6) > 2)
        found = calibrate_runs(make_chain(), make_runs(step, seed=100 * seed))
        wrong += {r["what"] for r in found.courses if r["course"] != "constant"} != {"hwp.theta"}
        value, std = elements(found, "wollaston.efficiency")
        pulls.append((value - [0.98, 0.975, 0.97]) / std)
        value, std = elements(found, "derotator.retardance")
        truth = make_chain()["derotator"].retardance.value
        pulls.append(((value - truth + 180) % 360 - 180) / std)
    # 72 pulls, some of them correlated
    assert np.std(pulls) == pytest.approx(1, abs=0.3)
    assert wrong <= 2


@pytest.mark.slow
def test_ten_years_of_a_recoating_a_drift_and_a_replaced_plate_are_told_apart():
    chains = [
        CHARIS.chain(source, derotator="linear", wavelength=GRID)
        for source in ("polarized", "unpolarized")
    ]
    chains[0]["calibration_polarizer"].theta.fixed = True
    runs = []
    for i in range(20):
        tables = []
        for source, chain in zip(("polarized", "unpolarized"), chains, strict=True):
            truth = chain.copy()
            if source == "unpolarized":
                truth["fold_mirror"].diattenuation = np.full(3, 0.009 if i >= 7 else 0.012)
            truth["derotator"].theta = 0.015 * i * u.deg
            truth["hwp"].w_sio2 = (1.657 if i >= 13 else 1.654) * u.mm
            date = f"{2021 + i // 2}-{1 + 6 * (i % 2):02d}-15"
            meta = {"date": date, "source": source, "instrument": "CHARIS"}
            seed = 2 * i + (source == "unpolarized")
            tables.append(simulate(truth, GRID, FRAMES, seed=seed, flux=1e6, meta=meta))
        runs.append(tables)
    found = calibrate_runs([chains] * 20, runs).courses
    varies = {row["what"]: row for row in found if row["course"] != "constant"}
    assert {name: str(row["course"]) for name, row in varies.items()} == {
        "fold_mirror.diattenuation": "steps",
        "hwp.w_sio2": "steps",
        "derotator.theta": "drift",
    }
    assert varies["fold_mirror.diattenuation"]["when"] == "2024-01-15 to 2024-07-15"
    assert varies["hwp.w_sio2"]["when"] == "2027-01-15 to 2027-07-15"


def test_own_values_are_those_of_calibrate():
    tables, chain = make_runs([0.0, 0.4, -0.3]), make_chain()
    runs = calibrate_runs(chain, tables, vary=None, own=["hwp.theta"], errors="white")
    one = calibrate(chain, tables, own=["hwp.theta"], errors="white", cross_validate=False)
    known, names = one.parameter_values(), one.settings["own"]["hwp.theta"]
    for i, name in enumerate(names):
        value, std = elements(runs, "hwp.theta", i)
        # calibrate has one noise for all runs
        np.testing.assert_allclose(std, known[name]["std"], rtol=0.3)
        assert abs(value - known[name]["value"]) < 0.5 * std


def test_own_values_at_a_bound_are_held_there():
    """As in the fit of all: what is shared follows, and what is at the bound has no error."""
    tables, chain = make_runs([0.2] * 2), make_chain()
    chain["wollaston"].efficiency.bounds = (0, 0.973)
    chain["wollaston"].efficiency = [0.97, 0.97, 0.97]
    own, errors = ["wollaston.efficiency"], "white"
    runs = calibrate_runs(chain, tables, vary=None, own=own, errors=errors)
    one = calibrate(chain, tables, own=own, errors=errors, cross_validate=False)
    known = one.parameter_values()
    for name in ("hwp.theta", "hwp.w_sio2", "derotator.retardance"):
        value, std = elements(runs, name)
        assert np.abs((value - known[name]["value"]) / std).max() < 0.1, name
    stuck = np.isnan(elements(runs, "wollaston.efficiency")[1])
    np.testing.assert_array_equal(stuck, known["wollaston.efficiency"]["at_bound"])


def test_courses_that_the_user_wants():
    angles = 0.3 * (np.arange(5) > 2)
    tables, chain = make_runs(angles), make_chain()
    for vary, events in (
        ({"hwp.theta": "steps"}, ["2003-09-01"]),
        ({"hwp": "drift"}, ()),
        ({"hwp.theta": "walk"}, ()),
        ({"hwp.theta": "scatter"}, ()),
    ):
        found = calibrate_runs(chain, tables, vary=vary, events=events)
        value, std = elements(found, "hwp.theta", 4)
        first, _ = elements(found, "hwp.theta", 0)
        assert (value - first == pytest.approx(0.3, abs=0.05)) == (vary != {"hwp": "drift"})
        assert std > 0
        assert next(iter(vary)) in found.courses["what"]


def test_a_run_is_a_calibration(tmp_path):
    found = calibrate_runs(make_chain(), make_runs(0.3 * (np.arange(5) > 2)))
    one = found.calibration(4)
    value, std = elements(found, "hwp.theta", 4)
    known = one.parameter_values()["hwp.theta"]
    assert known["value"] == pytest.approx(value[0])
    assert known["std"] == pytest.approx(std[0])
    one.write(tmp_path / "one.asdf")
    assert Calibration.read(tmp_path / "one.asdf").covariance == one.covariance
    assert "likelihood of 5 runs" in one.fit["message"]


def test_what_other_runs_determine_of_a_run_is_determined():
    short = make_runs([0.1] * 3)
    pairs = short[0].select(np.arange(short[0].n_frames) < 8)
    one = calibrate_runs(make_chain(), [pairs, *short[1:]], vary=None).calibration(0)
    assert set(one.parameters["status"]) == {"determined"}


def test_an_interrupted_call_goes_on(tmp_path):
    tables, chain, path = make_runs([0.1] * 3), make_chain(), tmp_path / "fits.json"
    whole = calibrate_runs(chain, tables, checkpoint=path)
    kept = json.loads(path.read_text())
    assert len(kept["fits"]) == 3
    # as if it had been stopped after the second run
    kept["fits"].pop(list(kept["fits"])[-1])
    path.write_text(json.dumps(kept))
    again = calibrate_runs(chain, tables, checkpoint=path)
    for a, b in zip(elements(whole, "hwp.w_sio2"), elements(again, "hwp.w_sio2"), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    # a fit within other bounds is another fit
    chain["hwp"].theta.bounds = (0.2, 1)
    chain["hwp"].theta = 0.5 * u.deg
    narrow = calibrate_runs(chain, tables, checkpoint=path)
    chain["hwp"].theta.bounds = (-1, 1)
    again = calibrate_runs(chain, tables, checkpoint=path)
    assert narrow.runs["rms_alone"][0] > 1.05 * whole.runs["rms_alone"][0]
    np.testing.assert_allclose(again.runs["rms_alone"], whole.runs["rms_alone"], rtol=1e-3)
    for content in ("", "{}", '{"fits": 3}', '{"fits": {"x": [NaN]}}'):
        path.write_text(content)
        with pytest.raises(AstropolcalError, match="is not a checkpoint"):
            calibrate_runs(chain, tables, checkpoint=path)


@pytest.mark.slow
def test_processes_give_the_same_numbers():
    tables, chain = make_runs(0.3 * (np.arange(4) > 1)), make_chain()
    here = calibrate_runs(chain, tables)
    with ProcessPoolExecutor(2) as pool:
        there = calibrate_runs(chain, tables, executor=pool)
    for name in ("hwp.theta", "derotator.retardance"):
        for a, b in zip(elements(here, name), elements(there, name), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9)


def test_wrong_input_is_refused_in_one_line():
    tables, chain = make_runs([0.0] * 3), make_chain()

    def with_meta(**meta):
        new = [Observations.from_table(t.to_table()) for t in tables]
        for one, table in zip(new, tables, strict=True):
            one.meta.update(table.meta)
        new[1].meta.update(meta)
        return new

    twice = ["2001-09-01", "2001-10-01"]
    for runs, options, message in (
        (tables[:1], {}, "1 run: at least two"),
        (tables, {"errors": "none"}, "errors = 'none'; allowed are scatter, white"),
        (tables, {"vary": {"hwp": "jump"}}, "hwp = 'jump'; allowed are constant, steps"),
        (tables, {"vary": {"mirror": "drift"}}, "vary: no free optic or parameter 'mirror'"),
        (tables, {"own": ["mirror"]}, "own: no free optic or parameter 'mirror'"),
        (tables, {"vary": {"hwp": "steps"}}, "there is no event between the runs"),
        (tables, {"vary": "all"}, "vary = 'all'"),
        (tables, {"events": twice}, "another one lies between 2001-03-01 and 2002-03-01"),
        (tables, {"events": ["soon"]}, "event = 'soon' is not a date"),
        (with_meta(date=None), {}, "run 2 .* has no date"),
        (with_meta(date="2001-03-01"), {}, "runs 1 and 2 are both of 2001-03-01"),
        (with_meta(instrument="irdis"), {}, "different instruments: charis, irdis"),
    ):
        with pytest.raises(AstropolcalError, match=message) as caught:
            calibrate_runs(chain, runs, **options)
        assert "\n" not in str(caught.value)
    other = [1200, 1600, 2100] * u.nm
    strange = simulate(make_chain(), other, FRAMES, meta={"date": "2009-01-01"})
    with pytest.raises(AstropolcalError, match="wavelengths"):
        calibrate_runs(chain, [*tables, strange])
    with pytest.raises(AstropolcalError, match="2 chains for 3 runs"):
        calibrate_runs([chain, chain], tables)
    with pytest.raises(AstropolcalError, match=r"no free parameter 'hwp.x'; there are"):
        calibrate_runs(chain, tables, vary=None).values("hwp.x")


@pytest.mark.slow
def test_wanted_courses_of_what_the_data_leave_open_fit_as_well_as_any():
    """Angles of an elliptical derotator turn against each other: a bound must not stop the fit."""
    vary = {"hwp.theta": "drift", "derotator.theta": "walk"}
    for step in (0.1, 0.3):
        chain = CHARIS.chain(derotator="elliptical", wavelength=GRID)
        found = calibrate_runs(chain, make_runs(step * np.arange(4), seed=20), vary=vary)
        assert found.converged
        assert np.all(found.runs["rms"] < 1.4 * found.runs["rms_alone"]), step
        value, std = elements(found, "wollaston.efficiency")
        assert np.all(np.abs(value - [0.98, 0.975, 0.97]) < 4 * std), step
