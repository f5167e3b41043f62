# Licensed under a 3-clause BSD style license - see LICENSE
"""The command itself: exit status, one line of complaint, and what -q leaves."""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
import warnings
from types import SimpleNamespace

import pytest

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.scripts import main as module
from astropolcal.scripts._common import Continued, Folder, Input, Output
from astropolcal.scripts.main import build_parser, main

(COMMANDS,) = (
    action.choices
    for action in build_parser()._actions
    if isinstance(action, argparse._SubParsersAction)
)
QUIET = [name for name, parser in COMMANDS.items() if "--quiet" in parser._option_string_actions]


@pytest.fixture
def running(monkeypatch):
    """Function that lets a command do something else, and returns the exit status."""

    def run(act):
        parsed = SimpleNamespace(run=lambda _: act())
        monkeypatch.setattr(
            module, "build_parser", lambda: SimpleNamespace(parse_args=lambda _: parsed)
        )
        return main([])

    return run


def fail(error):
    raise error


def test_exit_status_and_one_line(running, capsys, monkeypatch):
    assert running(lambda: print("done")) == 0
    assert capsys.readouterr().out == "done\n"
    assert running(lambda: fail(ObservationError("run.ecsv:\n  row 3\tis bad"))) == 2
    out, err = capsys.readouterr()
    assert (out, err) == ("", "astropolcal: error: run.ecsv: row 3 is bad\n")
    assert running(lambda: fail(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "astropolcal: interrupted\n"
    # interruption while the commands are loaded
    monkeypatch.setattr(module, "build_parser", lambda: fail(KeyboardInterrupt()))
    assert main([]) == 130
    assert capsys.readouterr().err == "astropolcal: interrupted\n"


def test_interruption_is_not_lost_where_python_drops_exceptions(running, capsys):
    class Odd:
        def __del__(self):
            raise KeyboardInterrupt

    def work():
        Odd()
        for _ in range(500):
            time.sleep(0.01)

    assert running(work) == 130
    assert capsys.readouterr().err == "astropolcal: interrupted\n"


def test_no_memory_is_one_line(running, capsys):
    for said, words in [
        ("Unable to allocate 21 GiB", "Unable to allocate 21 GiB"),
        ("", "give it less to do at a time"),
    ]:
        assert running(lambda said=said: fail(MemoryError(said))) == 2, (said, words)
        assert capsys.readouterr().err == f"astropolcal: error: not enough memory: {words}\n", said


def test_errors_that_are_bugs_are_not_hidden(running):
    with pytest.raises(ZeroDivisionError):
        running(lambda: 1 / 0)


def test_warnings_go_to_standard_error_in_one_line(running, capsys):
    def warn():
        warnings.simplefilter("always")
        # steps that read the same table say the same, which is shown once
        for _ in range(2):
            warnings.warn("two\n  lines", AstropolcalWarning, stacklevel=2)

    assert running(warn) == 0
    assert capsys.readouterr() == ("", "astropolcal: warning: two lines\n")
    # how warnings are shown is put back
    before = warnings.showwarning
    running(lambda: None)
    assert warnings.showwarning is before


_COMPLETED = """
source ./script
try() {
    COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 )); COMPREPLY=()
    _shtab_astropolcal; echo "${COMPREPLY[*]}"
}
try astropolcal calib
try astropolcal calibrate --st
try astropolcal calibrate --errors ""
try astropolcal calibrate --start run
try astropolcal calibrate --plots f
"""


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
def test_completion_of_commands_options_choices_files_and_folders(tmp_path, capsys):
    pytest.importorskip("shtab")
    with pytest.raises(SystemExit) as stop:
        main(["--print-completion", "bash"])
    assert not stop.value.code
    (tmp_path / "script").write_text(capsys.readouterr().out)
    (tmp_path / "run.asdf").touch()
    (tmp_path / "figure.png").touch()
    (tmp_path / "figures").mkdir()
    command = ["bash", "--norc", "-c", _COMPLETED]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    found = [sorted(line.split()) for line in done.stdout.splitlines()]
    assert found == [
        ["calibrate"],
        ["--standard", "--start", "--strategy"],
        ["scatter", "white"],
        ["run.asdf"],
        ["figures"],
    ], done.stderr


def test_completion_says_what_it_needs(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "shtab", None)
    with pytest.raises(SystemExit):
        main(["--print-completion", "zsh"])
    assert 'pip install "astropolcal[completion]"' in capsys.readouterr().err


def test_a_reader_that_has_gone_is_no_error(running, tmp_path, monkeypatch):
    with open(tmp_path / "out", "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        assert running(lambda: fail(BrokenPipeError())) == 0
        # what is printed from here on goes nowhere
        print("lost", file=stream, flush=True)
    assert (tmp_path / "out").read_text() == ""


def test_options_that_cannot_be_understood(capsys):
    for argv, words in [
        ([], "the following arguments are required: COMMAND (see astropolcal --help)"),
        (["calibrat"], "; did you mean 'calibrate'? (see astropolcal --help)"),
        (
            ["calibrate", "--derotater", "linear"],
            "--derotater; did you mean '--derotator'? (see astropolcal calibrate --help)",
        ),
        (["challenge", "--figure", "x"], "unrecognized arguments: --figure (see"),
        (["correct", "x"], "required: --calibration (see astropolcal correct --help)"),
        (["correct", "--size", "wide"], "argument --size: 'wide' is not a whole number"),
        (["correct", "--size", "2_1"], "argument --size: '2_1' is not a whole number"),
        (["simulate", "--flux", "\u0661"], "argument --flux: '\u0661' is not a finite number"),
        (["efficiency", "--wavelength", "nan"], "--wavelength: 'nan' is not a finite number"),
        (["reduce", "c", "-o", "x", "--radius", "inf"], "--radius: 'inf' is not"),
        (["simulate", "--hwp", "4_5,0"], "argument --hwp: '4_5,0' is not a list of angles"),
        (["challenge", "--snr", "8"], "argument --snr: '8' is not of the form LOW:HIGH"),
        (["correct", "x", "--centre", "7"], "argument --centre: '7' is not X,Y"),
        (["sample", "c", "t", "--burn", "x"], "argument --burn: 'x' is not auto or a number"),
        (["reduce", "c", "-o", "x", "--meta", "=in"], "argument --meta: '=in' is not KEY=VALUE"),
        (["simulate", "--source", "sun"], "argument --source: invalid choice: 'sun'"),
        (["correct", "--camera-angle", "1e9"], "'1e9' is not an angle from -720 to 720 deg"),
        (["efficiency", "--derotator", "45", "1e9"], "'1e9' is not an angle from -720"),
        (["simulate", "--hwp", "0,900"], "'0,900' is not a list of angles from -720 to 720 deg"),
    ]:
        with pytest.raises(SystemExit) as caught:
            main(argv)
        assert caught.value.code == 2, (argv, words)
        err = capsys.readouterr().err
        assert err.startswith("astropolcal: error: "), (argv, words)
        assert err.count("\n") == 1, (argv, words)
        assert words in err, (argv, words)


def test_negative_values_are_values():
    for argv, name, value in [
        (["simulate", "--parallactic", "-30,40"], "parallactic", [-30, 40]),
        (["simulate", "--parallactic=-30,40"], "parallactic", [-30, 40]),
        (["simulate", "--derotator", "-45,0,45", "-q"], "derotator", [-45, 0, 45]),
        (["simulate", "--hwp", "-.5,3"], "hwp", [-0.5, 3]),
        (["simulate", "--seed", "-1"], "seed", -1),
        (["simulate", "--flux", "-1e3"], "flux", -1000),
        (["standards", "--site", "-155,19,4200", "--night", "x"], "site", "-155,19,4200"),
        (["efficiency", "--target", "-75.2,28.3", "--night", "x"], "target", "-75.2,28.3"),
        (["efficiency", "--derotator", "-45", "0", "45", "-q"], "derotator", [-45, 0, 45]),
        (["efficiency", "--derotator", "0", "-4.5e1", "--altitude", "5"], "derotator", [0, -45]),
        (["efficiency", "--parallactic", "-30", "x.asdf"], "parallactic", -30),
        (["correct", "x", "--calibration", "c", "-o", "o", "--centre", "-1,5"], "centre", [-1, 5]),
    ]:
        assert getattr(build_parser().parse_args(argv), name) == value, (argv, name, value)


def test_words_that_look_like_options_are_no_values(capsys):
    for argv in [["info", "-x"], ["simulate", "--seed", "-q"], ["info", "-x1"]]:
        with pytest.raises(SystemExit):
            build_parser().parse_args(argv)
        assert "astropolcal: error: " in capsys.readouterr().err, argv


def test_no_option_looks_like_a_negative_number():
    for parser in COMMANDS.values():
        assert not [o for o in parser._option_string_actions if re.match(r"-\.?\d", o)]


# ---- files that are named ------------------------------------------------------------------


def files_of(command, kind):
    """Return the arguments of a command that name files of a kind."""
    return [
        a
        for a in COMMANDS[command]._actions
        if isinstance(a.type, type) and issubclass(a.type, kind)
    ]


def words_of(command, given):
    """Return a command line with files that are given by argument, and others where needed."""
    words = [command]
    for action in COMMANDS[command]._actions:
        value = given.get(action.dest, f"{action.dest}.txt" if action.required else None)
        if value is not None:
            words += [*action.option_strings[-1:], value]
    return words


def test_every_argument_that_names_a_file_says_what_it_does_with_it():
    named = re.compile(r"FILE|DIR|CUBES|\.(asdf|ecsv|fits|html|h5)$")
    for command, parser in COMMANDS.items():
        told = {action.dest for action in files_of(command, (Input, Output))}
        assert told == {a.dest for a in parser._actions if named.search(str(a.metavar))}, command


def refused(capsys, words):
    """Run a command that is refused; return its one line of complaint."""
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.startswith("astropolcal: error: ")
    return err


@pytest.mark.slow
def test_no_output_is_an_input_or_another_output(tmp_path, monkeypatch, capsys):
    for command in COMMANDS:
        monkeypatch.chdir(tmp_path)
        inputs, outputs = files_of(command, Input), files_of(command, Output)
        for action in [*inputs, *outputs]:
            if action.type is not Folder:
                (tmp_path / f"{action.dest}.txt").write_text(action.dest)
        before = {path: path.read_text() for path in tmp_path.iterdir()}
        for action in outputs:
            others = [other for other in [*inputs, *outputs] if other is not action]
            # samples are added to a calibration
            may = COMMANDS[command].get_default("may_replace") or {}
            for other in (a for a in others if may.get(action.dest) != a.dest):
                same = f"{other.dest}.txt"
                given = {action.dest: same, other.dest: same}
                assert same in refused(capsys, words_of(command, given)), command
        assert {path: path.read_text() for path in tmp_path.iterdir()} == before, command


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.slow
def test_nothing_is_read_that_is_no_regular_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    for command in COMMANDS:
        for action in files_of(command, (Input, Continued)):
            assert "pipe: is a pipe" in refused(capsys, words_of(command, {action.dest: "pipe"})), (
                command
            )
        for action in files_of(command, Input):
            err = refused(capsys, words_of(command, {action.dest: "/dev/zero"}))
            assert "/dev/zero: is a device" in err, command
        for action in files_of(command, (Input, Output)):
            for name in ("n" * 256, "a\0b"):
                err = refused(capsys, words_of(command, {action.dest: name}))
                assert "too long" in err or "not the name of a file" in err, command


@pytest.mark.filterwarnings("ignore")
@pytest.mark.long
def test_names_are_shown_without_what_a_terminal_acts_on(desk, capsys):
    odd = "\x1b[31m\r\x07\u202eodd\nastropolcal: error: forged"
    calls = [
        "simulate -o {}.ecsv --json {}.json --derotator 45,70,95 --without dichroic",
        "simulate --cubes {} --source star --hwp 0,45,22.5,67.5 --derotator 60 --altitude 70"
        " --parallactic 20 --flux 2e6 --without dichroic",
        "calibrate {}.ecsv -o {}.asdf --derotator linear",
        "diagnose {}.ecsv --effects beam_gain --derotator linear --report {}.html",
        "info {}.ecsv",
        "info {}.asdf",
        "info {}",
        "reduce {} --raw {}/raw --source star -o {}r.ecsv",
        "correct {} --raw {}/raw --calibration {}.asdf -o {}.fits --size 11 --any-date"
        " --optics-in nbs",
        "info {}.fits",
    ]
    wrong = ["info {}.no", "calibrate {}no", "simulate -o {}.txt", "reduce {}no -o {}", "{}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(desk)
        for words in [*calls, *wrong]:
            try:
                status = main([word.replace("{}", odd) for word in words.split()])
            except SystemExit as stop:
                status = stop.code
            assert status == (2 if words in wrong else 0), capsys.readouterr().err
            out, err = capsys.readouterr()
            lines = (out + err).split("\n")
            assert all(line.isprintable() for line in lines), words
            assert not [line for line in lines if line.startswith("astropolcal: error: forged")]
        page = (desk / f"{odd}.html").read_text()
        assert all(line.isprintable() for line in page.split("\n"))
        assert "odd astropolcal: error: forged" in page


# ---- quiet -------------------------------------------------------------------------------


def test_every_help_has_examples():
    for name, command in COMMANDS.items():
        assert f"examples:\n  astropolcal {name}" in command.format_help(), name
    assert "examples:\n  astropolcal " in build_parser().format_help()


def test_quiet_means_the_same_everywhere():
    for command in QUIET:
        action = COMMANDS[command]._option_string_actions["--quiet"]
        assert action is COMMANDS[command]._option_string_actions["-q"], command
        assert action.help == "print only warnings and errors", command
    assert set(QUIET) == set(COMMANDS)


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Table, calibration and cubes of a star, all small."""
    folder = tmp_path_factory.mktemp("desk")
    star = "--source star --hwp 0,45,22.5,67.5 --derotator 60 --altitude 70 --parallactic 20"
    for words in (
        "simulate -q -o run.ecsv --derotator 45,70,95 --without dichroic",
        "calibrate -q run.ecsv -o cal.asdf --derotator linear",
        f"simulate -q --cubes cubes {star} --flux 2e6 --without dichroic",
    ):
        call(folder, words)
    return folder


def call(folder, words):
    """Run a command in a folder; return its status."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return main(words.split())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.long
def test_quiet_commands_print_nothing(desk, capsys):
    for words in [
        "simulate -o again.ecsv --derotator 45",
        "simulate --cubes few --derotator 45 --hwp 0,45",
        "calibrate run.ecsv --derotator linear",
        "reduce cubes --raw cubes/raw --source star -o star.ecsv --resume journal",
        "correct cubes --raw cubes/raw --calibration cal.asdf -o out.fits --size 11 --any-date "
        "--optics-in nbs",
        "efficiency cal.asdf",
        "challenge -n 1 --kinds none --wavelengths 5 --derotator-angles 3",
        "diagnose run.ecsv --effects beam_gain --derotator linear",
        "info run.ecsv",
        "info --instruments",
        "standards --kind unpolarized --json stars.json",
    ]:
        assert call(desk, f"{words} -q") == 0, words
        assert capsys.readouterr().out == "", words


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_quiet_reduction_still_says_what_is_left_out(desk, tmp_path, capsys):
    (tmp_path / "CRSA00000099_cube.fits").write_text("no FITS")
    words = f"reduce cubes {tmp_path} --raw cubes/raw --source star -o some.ecsv -q"
    assert call(desk, words) == 0
    out, err = capsys.readouterr()
    assert out == ""
    assert "left out: CRSA00000099_cube.fits: is not a FITS file" in err


def test_quiet_errors_are_printed(desk, capsys):
    assert call(desk, "calibrate nowhere.ecsv -q") == 2
    assert capsys.readouterr().err == "astropolcal: error: nowhere.ecsv: no such file\n"


# ---- numbers and their nouns ---------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_one_frame_is_no_frames(desk, capsys):
    call(desk, "simulate -o single.ecsv --derotator 45 --hwp 0 --without dichroic")
    assert "(1 frame x 22 wavelengths)" in capsys.readouterr().out
    call(desk, "simulate --cubes one --derotator 45 --hwp 0")
    assert "one (1 cube)" in capsys.readouterr().out


@pytest.mark.slow
def test_summary_has_no_negative_zero(desk, capsys):
    """Misalignments that are held at zero, and those that the data pull just below it."""
    held = "--fix hwp.theta=-1e-9deg --fix derotator.theta=0"
    assert call(desk, f"calibrate run.ecsv --full --derotator linear {held}") == 0
    out = capsys.readouterr().out
    assert "24 frames x 22 wavelengths" in out
    assert "-0.00000" not in out
    assert "-0.000 " not in out


def test_parameter_just_below_zero_is_printed_without_a_sign():
    from astropolcal.calibration.result.verdict import number

    entry = {"value": -1e-7, "std": 1e-3, "unit": "deg", "tied": None, "status": "determined"}
    assert number(entry).strip() == "0.00000 +- 0.00100 deg"
    assert number(entry | {"value": -0.1}).strip() == "-0.10000 +- 0.00100 deg"


def test_the_package_is_the_command():
    words = [sys.executable, "-m", "astropolcal", "--version"]
    assert subprocess.run(words, capture_output=True, text=True).stdout.startswith("astropolcal ")
