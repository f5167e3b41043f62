"""``astropolcal challenge``, as a person or a pipeline calls it."""

import argparse
import json

import pytest

from astropolcal.exceptions import AstropolcalError
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
    from astropolcal.gap.challenge import ChallengeResult

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
