"""``astropolcal challenge``, as a person or a pipeline calls it."""

import json

import pytest

from astropolcal.exceptions import AstropolcalError
from astropolcal.scripts.main import build_parser

SMALL = ["-n", "2", "--kinds", "none", "--wavelengths", "5", "--derotator-angles", "3"]


@pytest.fixture
def command():
    """Function that runs the subcommand with arguments."""

    def call(*arguments):
        parsed = build_parser().parse_args(["challenge", *map(str, arguments)])
        parsed.run(parsed)

    return call


@pytest.mark.slow
def test_it_prints_rates_and_writes_what_is_asked_for(command, tmp_path, capsys):
    names = ("c.jsonl", "s.json", "r.png")
    checkpoint, summary, reliability = (tmp_path / name for name in names)
    options = ["--checkpoint", checkpoint, "--json", summary]
    command(*SMALL, *options, "--reliability", reliability)
    assert "2 challenges" in capsys.readouterr().out
    content = json.loads(summary.read_text())
    assert content["rates"][0] | {"right": 1.0, "n": 2} == content["rates"][0]
    assert content["settings"]["kinds"] == ["none"]
    assert len(checkpoint.read_text().splitlines()) == 3
    assert reliability.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_json_on_stdout_is_nothing_but_json(command, capsys):
    command("run", *SMALL, "--json", "-", "-n", "1")
    assert json.loads(capsys.readouterr().out)["settings"]["seed"] == 0


def test_cases_are_made_and_the_answers_of_a_tool_scored(command, tmp_path, capsys):
    cases, outputs = tmp_path / "cases", tmp_path / "outputs"
    command("make", cases, *SMALL, "--count", "1")
    assert "1 case and key.json written" in capsys.readouterr().out
    outputs.mkdir()
    (outputs / "case000.json").write_text('{"verdict": "unexplained"}')
    command("score", cases, outputs)
    assert "no. 0, wrong: none nothing (SNR 0) -> unexplained" in capsys.readouterr().out


def test_a_range_that_is_none_is_refused(command, capsys):
    for text in ["8", "a:b", "1:2:3"]:
        with pytest.raises(SystemExit):
            command("--snr", text)
        assert "is not of the form LOW:HIGH" in capsys.readouterr().err, text


def test_bad_input_is_refused(command):
    for options, words in [
        (["--workers", "0"], "workers = 0"),
        (["--kinds", "odd"], "allowed are none"),
        (["--snr", "9:3"], "the lower first"),
        (["--derotator-angles", "2"], "n_derotator = 2"),
        (["-n", "0"], "n = 0"),
        (["score", "cases"], "challenge score takes 2 folders, 1 given"),
        (["score", "nowhere", "outputs"], "no such file"),
        (["make", "x", "--reliability", "f.png"], "--reliability f.png: is for .* to x"),
        (["make", "x", "--json", "-"], "--json -: is for challenge run"),
        (["make", "x", "--checkpoint", "c.jsonl"], "--checkpoint c.jsonl: is for challenge run"),
    ]:
        with pytest.raises(AstropolcalError, match=words):
            command(*options)


@pytest.mark.slow
def test_an_unknown_format_of_the_figure_is_refused(command, tmp_path):
    with pytest.raises(AstropolcalError, match="odd"):
        command(*SMALL, "-n", "1", "--reliability", tmp_path / "f.odd")
