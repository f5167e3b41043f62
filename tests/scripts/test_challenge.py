"""``astropolcal challenge``, as a person or a pipeline calls it."""

import argparse
import json
import time
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool

import pytest

from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, GapError
from astropolcal.gap.challenge import ChallengeResult
from astropolcal.scripts import _challenge

SMALL = ["-n", "2", "--kinds", "none", "--wavelengths", "5", "--derotator-angles", "3"]


@pytest.fixture
def command():
    """Function that runs the subcommand with arguments."""
    parser = argparse.ArgumentParser()
    _challenge.add_parser(parser.add_subparsers())

    def call(*arguments):
        parsed = parser.parse_args(["challenge", *map(str, arguments)])
        parsed.run(parsed)

    return call


def test_it_prints_rates_and_writes_what_is_asked_for(command, tmp_path, capsys):
    checkpoint, summary, figure = (tmp_path / name for name in ("c.jsonl", "s.json", "f.png"))
    command(*SMALL, "--checkpoint", checkpoint, "--json", summary, "--figure", figure)
    assert "2 challenges" in capsys.readouterr().out
    content = json.loads(summary.read_text())
    assert content["summary"]["rates"]["quiet on clean"]["n"] == 2
    assert content["settings"]["kinds"] == ["none"]
    assert len(checkpoint.read_text().splitlines()) == 3
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_json_on_stdout_is_nothing_but_json(command, capsys):
    command(*SMALL, "--json", "-", "-n", "1")
    assert json.loads(capsys.readouterr().out)["settings"]["seed"] == 0


def test_wrong_answers_are_listed():
    wrong = {
        "index": 4,
        "kind": "single",
        "effects": ["beam_gain"],
        "snr": [12.0],
        "verdict": "effect",
        "causes": [["background", "persistence"]],
        "right": False,
    }
    report = _challenge._report(ChallengeResult([wrong], {}))
    assert "no. 4, single: beam_gain (SNR 12) -> effect background/persistence" in report


@pytest.mark.parametrize("text", ["8", "a:b", "1:2:3"])
def test_a_range_that_is_none_is_refused(command, text, capsys):
    with pytest.raises(SystemExit):
        command("--snr", text)
    assert "is not of the form LOW:HIGH" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--workers", "0"], "--workers 0"),
        (["--kinds", "odd"], "allowed are single"),
        (["--snr", "9:3"], "the lower first"),
        (["--json", "/nowhere/x.json"], "there is no folder"),
        (["--derotator-angles", "2"], "n_derotator = 2"),
    ],
)
def test_bad_input_is_refused(command, options, words):
    with pytest.raises(AstropolcalError, match=words):
        command(*options)


def test_an_unknown_format_of_the_figure_is_refused(command, tmp_path):
    with pytest.raises(AstropolcalError, match="odd"):
        command(*SMALL, "-n", "1", "--figure", tmp_path / "f.odd")


# ---- what could not be made, or was stopped ----------------------------------------------------

DARK = {"index": 0, "kind": "single", "verdict": "not made", "error": "too dark"}
QUIET = {"index": 1, "kind": "none", "verdict": "none", "right": True}
QUIET |= {"snr": [], "effects": [], "causes": []}


@pytest.fixture
def outcome(monkeypatch):
    """Function that sets the records of the challenges."""

    def replace(*records):
        result = ChallengeResult(records, {"snr": [8.0, 300.0]})
        run_challenge = "astropolcal.gap.challenge.run_challenge"
        monkeypatch.setattr(run_challenge, lambda *args, **options: result)

    return replace


def test_challenges_that_all_could_not_be_made_are_an_error(command, outcome, tmp_path):
    outcome(DARK)
    with pytest.raises(GapError, match=r"^0 of 1 challenges could be made: too dark \(1\)$"):
        command("--json", tmp_path / "c.json")
    # the records are kept
    assert json.loads((tmp_path / "c.json").read_text())["challenges"] == [DARK]


def test_challenges_of_which_some_could_not_be_made_warn(command, outcome, capsys):
    outcome(DARK, QUIET)
    with pytest.warns(AstropolcalWarning, match="1 of 2 challenges could be made"):
        command()
    assert "1 challenge, 0 wrong answers" in capsys.readouterr().out


def test_without_a_rate_there_is_no_footnote_on_rates():
    assert "in brackets" in _challenge._report(ChallengeResult([QUIET], {}))
    assert "in brackets" not in _challenge._report(ChallengeResult([DARK], {}))


def test_an_interruption_ends_the_workers_at_once(capsys):
    started = time.monotonic()
    futures = []

    def interrupted():
        with _challenge._workers(2) as pool:
            futures.extend(pool.submit(time.sleep, 60) for _ in range(5))
            while not futures[0].running():
                time.sleep(0.01)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - started < 20
    assert capsys.readouterr().err == "astropolcal: stopping ...\n"
    # what had begun ended with its process, and the rest never began
    for future in futures:
        with pytest.raises((CancelledError, BrokenProcessPool)):
            future.result(timeout=20)


def test_progress_without_a_terminal_is_a_line_now_and_then(capsys):
    progress = _challenge._Progress()
    progress(1, 9)
    progress.said -= _challenge._BETWEEN
    progress(2, 9)
    progress(3, 9)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("astropolcal: ")
    assert line.endswith("2 of 9 challenges")
