# Licensed under a 3-clause BSD style license - see LICENSE
"""Challenges: what is made, how answers are scored, what many of them tell, how a run goes on."""

import json
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from scipy.linalg import expm

from astropolcal.chain import system_mueller, with_beam
from astropolcal.exceptions import AstropolcalError, GapError
from astropolcal.gap import challenge
from astropolcal.gap._bench import _COURSES, _MECHANISMS, ACTIONS, Bench, Fault
from astropolcal.gap.challenge import (
    KINDS,
    ChallengeResult,
    Setup,
    make_cases,
    make_challenge,
    run_challenge,
    score_answer,
    score_cases,
)

SMALL = Setup(n_wavelengths=5, n_derotator=3)
LEAST = Setup(n_wavelengths=3, n_derotator=3)
DRIFT = {"place": "in:derotator", "kind": "retardance_h", "dependence": "time"}
CELL = "in:derotator/retardance_h/time"

pytestmark = pytest.mark.filterwarnings("ignore::astropolcal.exceptions.AstropolcalWarning")


def bench(seed=1, **more):
    return Bench(
        Setup(**{"n_wavelengths": 4, "n_derotator": 3} | more), np.random.default_rng(seed)
    )


# ---- what is made -----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_seed_makes_the_same_challenge_again():
    one, two, three = (make_challenge(seed, setup=SMALL, fault=DRIFT) for seed in (3, 3, 4))
    assert one[2] == two[2]
    assert [o.content_hash for o in one[0]] == [o.content_hash for o in two[0]]
    assert one[0][0].content_hash != three[0][0].content_hash


def test_light_goes_through_the_chain_as_the_package_says():
    for instrument in ("charis", "vampires", "irdis"):
        made = bench(instrument=instrument)
        for dataset, (chain, clean) in enumerate(zip(made.chains, made.clean, strict=True)):
            places = {
                name: clean.position(name) * (1 if name == "flc_state" else u.rad)
                for name in ("hwp", "derotator", "flc_state")
                if instrument == "vampires" or name != "flc_state"
            }
            for beam, flux in zip(("right", "left"), made.path(dataset), strict=True):
                expected = system_mueller(with_beam(chain, beam), made.setup.wavelength, places)
                np.testing.assert_allclose(flux, expected[..., 0, 0], atol=1e-12)


@pytest.mark.long
def test_each_kind_of_fault_stands_out_as_asked():
    for kind in sorted(set(KINDS) - {"none", "absorbed", "frame", "mechanism"}):
        data, _, case = make_challenge(5, kind=kind, setup=SMALL, snr=20)
        assert len(case["faults"]) == (2 if kind == "pair" else 1), kind
        for fault in case["faults"]:
            assert fault["absorbed"] or fault["snr"] < 21, kind
        assert [one.name for one in data] == ["polarized", "unpolarized"]
        assert json.loads(json.dumps(case)) == case
    mechanisms = [{"what": what} for what in _MECHANISMS]
    mechanisms += [
        {"what": "course", "place": "source", "kind": "rotation", "course": course}
        for course in _COURSES
    ]
    for fault in mechanisms:
        case = make_challenge(2, kind="mechanism", fault=fault, setup=LEAST)[2]
        assert case["snr"] > 5, fault
    for what in ("hwp angle", "derotator angle", "exchanged", "one beam"):
        fault = {"what": what, "frame": 4, "dataset": "polarized"}
        case = make_challenge(2, kind="frame", fault=fault, setup=LEAST)[2]
        assert (case["snr"] > 5, case["faults"][0]["frame"]) == (True, 4), what


def test_what_the_nominal_model_takes_up_is_absorbed():
    assert make_challenge(1, kind="absorbed", setup=SMALL)[2]["absorbed"]
    # its retardance is free at each wavelength
    fault = DRIFT | {"dependence": "constant"}
    case = make_challenge(1, setup=SMALL, fault=fault)[2]
    assert (case["absorbed"], case["snr"], case["faults"][0]["cells"]) == (True, 0.0, {})


def test_the_cells_of_the_key_are_what_a_finite_fault_does():
    made = bench()
    fault = Fault(made, {"type": "cell", **DRIFT})
    residual, fit = made.scale(fault, 5)
    shares = fault.cells(residual, fit)
    linear = made.shares(residual, fit)
    assert shares[CELL] == max(shares.values()) == 1
    assert linear[CELL] == pytest.approx(1, abs=2e-3)
    # other kinds cannot do it, and a trend of higher order not all of it
    assert linear.get("in:derotator/rotation/time", 0) < 0.9
    assert linear.get("in:derotator/retardance_h/time2", 0) < 0.9


def test_the_key_has_the_cell_of_a_fault_that_no_smooth_law_describes():
    setup = Setup(n_wavelengths=6, n_derotator=3)
    for seed in (1, 3):
        fault = {"effect": "hwp_retardance_free"}
        case = make_challenge(seed, kind="listed", snr=10, setup=setup, fault=fault)[2]
        assert case["faults"][0]["cells"]["in:hwp/retardance_h/constant"] > 0.99


def test_generators_give_matrices_of_their_kind():
    for kind, action in ACTIONS.items():
        matrix = expm(0.1 * action)
        if kind.startswith(("retardance", "rotation")):
            np.testing.assert_allclose(matrix @ matrix.T, np.eye(4), atol=1e-12)
        elif kind.startswith("diattenuation"):
            np.testing.assert_allclose(matrix, matrix.T)
            assert matrix[0, 0] > 1
        else:
            assert matrix[0, 0] == 1
            assert np.abs(np.linalg.eigvalsh(matrix)).max() < 1.2


def test_what_cannot_be_made_is_refused():
    for options, words in (
        ({"kind": "odd"}, "allowed are none"),
        ({"snr": np.nan}, "must be finite and positive"),
        ({"fault": {"place": "in:wollaston"}}, "place = 'in:wollaston'; allowed are source"),
        ({"kind": "listed", "fault": {"effect": "beam_gian"}}, "did you mean 'beam_gain'"),
        ({"kind": "listed", "fault": {"effect": "mirror_flip"}}, "no place on the bench"),
    ):
        with pytest.raises(GapError, match=words):
            make_challenge(1, setup=SMALL, **options)
    with pytest.raises(GapError, match="n_derotator = 2"):
        Setup(n_derotator=2)


# ---- how an answer is scored ------------------------------------------------------------------


def case(kind="cell", *cells, **fault):
    cells = cells or ({CELL: 1.0, "after:derotator/retardance_h/time": 0.6, "a/b/step:20": 0.95},)
    faults = [{"type": kind, "absorbed": False, "cells": one, **fault} for one in cells]
    return {"kind": kind, "snr": 20.0, "faults": faults}


def cause(name, probability=0.9, **more):
    cell = dict(zip(("place", "kind", "dependence"), name.split("/"), strict=True))
    return {"cell": cell, "probability": probability, **more}


def answer(*causes, verdict="located", **more):
    return {"verdict": verdict, "causes": list(causes), **more}


RIGHT, HALF, WRONG = cause(CELL), cause("after:derotator/retardance_h/time"), cause("a/b/time")


def test_answers_are_right_silent_or_wrong():
    nothing = {"kind": "none", "snr": 0.0, "faults": []}
    absorbed = case(absorbed=True)
    frame = case("frame", frame=7, **{"with": 9})
    named = [{"frame": 7}]
    two = case("pair", {CELL: 1.0}, {"a/b/time": 1.0})
    for key, given, expected in (
        (nothing, answer(verdict="none"), "right"),
        (nothing, {}, "silent"),
        (nothing, answer(verdict="unexplained"), "wrong"),
        (absorbed, answer(verdict="none"), "right"),
        (absorbed, answer(RIGHT), "wrong"),
        (case(), answer(RIGHT), "right"),
        (case(), answer(verdict="unexplained"), "silent"),
        (case(), answer(HALF), "silent"),
        (case(), answer(HALF | {"aliases": [RIGHT]}), "right"),
        (case(), answer(WRONG), "wrong"),
        (case(), answer(cause("a/b/time", 0.4)), "silent"),
        # one of several that is wrong
        (case(), answer(RIGHT, WRONG), "wrong"),
        # a step is the same a few frames away
        (case(), answer(cause("a/b/step:23")), "right"),
        (case(), answer(cause("a/b/step:40")), "wrong"),
        (case(effect="beam_gain"), answer({"effect": "beam_gain", "aliases": []}), "right"),
        (case(effect="beam_gain"), answer({"effect": "x", "aliases": ["beam_gain"]}), "right"),
        (case(effect="beam_gain"), answer({"effect": "x", "aliases": []}), "wrong"),
        (two, answer(RIGHT, WRONG), "right"),
        (two, answer(RIGHT), "silent"),
        (two, answer(RIGHT, cause("c/d/time")), "wrong"),
        (frame, answer(verdict="none", frames=named), "right"),
        (frame, answer(verdict="none", frames=[{"frame": 9}]), "right"),
        (frame, answer(verdict="none"), "silent"),
        (frame, answer(RIGHT, frames=named), "wrong"),
        (case("mechanism"), answer(verdict="unexplained"), "right"),
        (case("mechanism"), answer(WRONG), "wrong"),
        (case("detector", {"detector/persistence/previous": 1.0}),
         answer(cause("detector/persistence/flux")), "right"),
    ):  # fmt: skip
        assert score_answer(key, given) == expected, (key, given)


def test_what_is_no_answer_is_refused():
    for given in ([], {"causes": [5]}, answer(cause(CELL, 2.0)), answer(cause(CELL, "x"))):
        with pytest.raises(GapError, match="neither a case nor an answer"):
            score_answer(case(), given)


# ---- cases in files ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("cases")
    make_cases(path, 2, 3, kinds=["cell", "detector"], setup=SMALL)
    return path


def test_cases_in_files_are_scored(folder, tmp_path):
    key = json.loads((folder / "key.json").read_text())
    assert list(key) == ["case000", "case001"]
    for name, one in key.items():
        assert {path.name for path in (folder / name).iterdir()} == set(one["tables"])
    (tmp_path / "case001.json").write_text(json.dumps(answer(verdict="unexplained")))
    result = score_cases(folder, tmp_path)
    assert [r["verdict"] for r in result.records] == ["missing", "unexplained"]
    assert result.rate("silent")[0] == 1


def test_damaged_files_get_one_clear_line(folder, tmp_path):
    with pytest.raises(GapError, match="holds no answer to any of the 2 cases"):
        score_cases(folder, tmp_path)
    (tmp_path / "case000.json").write_text("{")
    with pytest.raises(GapError, match=r"case000\.json: is not an answer"):
        score_cases(folder, tmp_path)
    for content in ("[]", '{"case000": {}}', "\0", '{"case000": {"kind": 1, "faults": [3]}}'):
        (tmp_path / "key.json").write_text(content)
        with pytest.raises(GapError, match="is not a key of challenges"):
            score_cases(tmp_path, tmp_path)
    with pytest.raises(GapError, match="no such file"):
        score_cases(tmp_path / "none", tmp_path)
    with pytest.raises(GapError, match="is there already"):
        make_cases(folder, 1)


# ---- what many of them tell -------------------------------------------------------------------


def record(index=0, kind="cell", snr=20.0, result="right", claims=()):
    told = {"index": index, "kind": kind, "snr": snr, "result": result, "verdict": "located"}
    return told | {"faults": ["a"], "causes": ["b"], "claims": [list(c) for c in claims]}


@pytest.fixture
def result():
    rng = np.random.default_rng(1)
    given = rng.uniform(0, 1, (60, 2))
    return ChallengeResult(
        [
            record(
                i,
                ("cell", "none", "frame")[i % 3],
                (i % 3 != 1) * 10.0 ** (i % 5 / 2),
                ("right", "silent", "wrong", "right")[i % 4],
                [(p, bool(rng.uniform() < p)) for p in given[i]],
            )
            for i in range(60)
        ],
        {"seed": 3},
    )


def test_rates_are_by_kind_and_signal(result):
    rows = {row["challenges"]: row for row in result.rates}
    assert list(rows)[:4] == ["all", "cell", "frame", "none"]
    assert rows["all"]["right"] == 0.5
    # Wilson (1927): p = 0.5 has the ends that solve |p - e| = sqrt(e (1 - e) / n)
    for key in ("right_low", "right_high"):
        end = rows["all"][key]
        assert abs(0.5 - end) == pytest.approx(np.sqrt(end * (1 - end) / 60), rel=1e-4)
    assert sum(row["n"] for name, row in rows.items() if name.startswith("SNR")) == 40
    for row in rows.values():
        assert row["right"] + row["silent"] + row["wrong"] == pytest.approx(1)
    assert "60 challenges" in result.words()
    assert json.loads(json.dumps(result.to_dict(), allow_nan=False))["settings"] == {"seed": 3}


def test_probabilities_are_held_against_how_often_they_are_right(result):
    claims = np.array([claim for r in result.records for claim in r["claims"]])
    table = result.reliability
    assert table["n"].sum() == 120
    for row in table:
        inside = claims[(claims[:, 0] >= row["from"]) & (claims[:, 0] < row["to"])]
        assert row["probability"] == pytest.approx(inside[:, 0].mean())
        assert row["right"] == inside[:, 1].mean()
    axes = result.plot_reliability().axes[0]
    (points,) = axes.containers
    np.testing.assert_allclose(points.lines[0].get_xdata(), 100 * table["probability"])
    # certainty is in the last bin, and nothing at all is a picture too
    assert ChallengeResult([record(claims=[(1.0, True)])], {}).reliability["to"][0] == 1
    ChallengeResult([], {}).plot_reliability().canvas.draw()


# ---- how a run goes on ------------------------------------------------------------------------


def told(observations_or_error):
    """Replace the diagnosis by an answer."""

    def diagnose(chains, observations):
        if isinstance(observations_or_error, Exception):
            raise observations_or_error
        return SimpleNamespace()

    return diagnose


def test_a_run_makes_asks_and_scores(monkeypatch):
    monkeypatch.setattr(challenge, "diagnose", told(None))
    found = answer(WRONG, seconds=1.0)
    monkeypatch.setattr("astropolcal.gap.report.to_dict", lambda diagnosis: found)
    result = run_challenge(2, 5, setup=SMALL, kinds=["none", "cell"])
    assert [r["result"] for r in result.records] == ["wrong"] * 2
    assert result.records[0]["claims"] == [[0.9, False]]
    monkeypatch.setattr(challenge, "diagnose", told(GapError("did not converge")))
    failed = run_challenge(1, 5, setup=SMALL, kinds=["none"]).records[0]
    assert (failed["verdict"], failed["error"]) == ("error", "did not converge")
    assert failed["result"] == "silent"


@pytest.mark.slow
def test_the_diagnosis_keeps_quiet_where_there_is_nothing():
    small = Setup(n_wavelengths=5, n_derotator=4)
    assert run_challenge(2, 5, setup=small, kinds=["none"]).rate("right")[0] == 1


def test_a_run_goes_on_where_it_was_killed(tmp_path, monkeypatch):
    made, path = [], tmp_path / "run.jsonl"
    monkeypatch.setattr(challenge, "_run_one", lambda i, settings: made.append(i) or record(i))
    run_challenge(2, 5, checkpoint=path)
    whole = path.read_text()
    path.write_text(whole + '{"index": 2, "ki')
    result = run_challenge(4, 5, checkpoint=path)
    assert sorted(made) == [0, 1, 2, 3]
    assert [r["index"] for r in result.records] == [0, 1, 2, 3]
    assert path.read_text().startswith(whole)


def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(challenge, "_run_one", lambda i, settings: record(i))
    path = tmp_path / "run.jsonl"
    run_challenge(1, 1, checkpoint=path)
    with pytest.raises(GapError, match="other settings \\(seed\\)"):
        run_challenge(1, 2, checkpoint=path)
    first = path.read_text().splitlines()[0]
    odd = record(1) | {"claims": [[2.0, True]]}
    for line in ("no json", "[]", json.dumps(odd), json.dumps(record(1) | {"result": "so so"})):
        path.write_text(f"{line}\n")
        with pytest.raises(GapError, match="not a checkpoint"):
            run_challenge(1, 1, checkpoint=path)
        # what one line has lost is done again
        path.write_text(f"{first}\n{line}\n")
        assert [r["index"] for r in run_challenge(1, 1, checkpoint=path).records] == [0]


def test_a_run_that_makes_no_sense_is_refused():
    for options, words in (
        ({"n": 0}, "n = 0"),
        ({"n": 1, "seed": -1}, "seed = -1"),
        ({"n": 1, "kinds": ["odd"]}, "allowed are none"),
        ({"n": 1, "kinds": []}, "allowed are none"),
        ({"n": 1, "snr": (9, 3)}, "the lower first"),
    ):
        with pytest.raises(GapError, match=words):
            run_challenge(**options)


@pytest.mark.long
def test_processes_and_a_cluster_give_the_same_answers():
    distributed = pytest.importorskip("distributed")
    options = {"seed": 3, "kinds": ["none"], "setup": SMALL}
    here = run_challenge(2, **options).records
    with distributed.LocalCluster(processes=False, n_workers=1, dashboard_address=None) as cluster:
        for where in ({"workers": 2}, {"cluster": cluster.scheduler_address}):
            there = run_challenge(2, **where, **options).records
            for one, two in zip(here, there, strict=True):
                assert one | {"seconds": 0} == two | {"seconds": 0}, where
    with pytest.raises(AstropolcalError, match="workers = 0; a number above zero"):
        run_challenge(2, workers=0, **options)
