# Licensed under a 3-clause BSD style license - see LICENSE
"""
What every command prints, as a person sees it in a terminal of 80 columns.

`OUTPUTS` holds at least one call of every command; a new command or a new kind
of output needs a line there.
"""

import argparse
import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import time

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.scripts.main import build_parser, main
from astropolcal.simulation import half_wave_plate_cycles, simulate

COLUMNS = 80
PARSER = build_parser()
(CHOICES,) = (a.choices for a in PARSER._actions if isinstance(a, argparse._SubParsersAction))
# as for a user: warnings are printed
pytestmark = [
    pytest.mark.samplers,
    pytest.mark.filterwarnings("default::astropolcal.exceptions.AstropolcalWarning"),
]
NIGHT = "--site subaru --night 2025-11-03"

OUTPUTS = {
    "installation": "info",
    "instruments": "info --instruments",
    "calibration": "info cal.asdf",
    "joint calibration": "info a_long_name_of_a_calibration_that_joins_several_tables.asdf",
    "library": "info .",
    "health": "health .",
    "table": "info run.ecsv",
    "table of many angles": "info fine.ecsv",
    "fit": "calibrate run.ecsv -o again.asdf --json fit.json",
    "joint fit": "calibrate run.ecsv dark.ecsv --derotator linear --standard fine.ecsv",
    "two steps": "calibrate run.ecsv --strategy two-step --observable ratio --target 5,30",
    "priors": "calibrate run.ecsv --prior hwp.theta=0+-0.1deg --fix derotator.theta",
    "effects": "diagnose --effects help",
    "diagnosis": "diagnose run.ecsv dark.ecsv --effects beam_gain,hwp_tilt --report gap.html",
    "diagnosis of a gap": "diagnose gain.ecsv --effects beam_gain,hwp_diattenuation",
    "challenges": "challenge -n 1 --kinds none --wavelengths 5 --derotator-angles 3",
    "simulation": "simulate -o new.ecsv --derotator 45,90",
    "cubes": "simulate --cubes cubes --source star --hwp 0,45,22.5,67.5 --derotator 60"
    " --altitude 70 --parallactic 20 --flux 2e6",
    "reduction": "reduce cubes --raw cubes/raw -o reduced.ecsv --source star",
    "correction": "correct cubes --raw cubes/raw --calibration all.asdf -o out.fits --size 21"
    " --optics-in nbs,dichroic",
    "stars": "standards",
    "stars of a night": f"standards {NIGHT}",
    "stars of a place": "standards --near 81.5,16.7 --band H",
    "efficiency": "efficiency cal.asdf",
    "published efficiency": "efficiency --instrument irdis",
}
# how the summary says verdict, accuracy, what is determined, what to do next and what was written
VERDICT = r"^(Usable|NOT USABLE AS IT IS|NOT CONVERGED)"
SKY = [VERDICT, r"^On sky      \S", r"^Determined  \d", r"^Not         \S", r"^Next        \S"]
TOLD = [VERDICT, r"^Accuracy    \S", r"^Determined  \S", r"^Next        \S"]
CAUSES = [
    "^(The model (lacks|agrees)|Something in)",
    r"is off by \d",
    "probability|does not show",
    r"^Next  +\S",
]
SUMMARIES = {
    "calibrate run.ecsv -o again.asdf --json x.json": SKY,
    "info cal.asdf --json x.json": SKY,
    "sample cal.asdf run.ecsv --walkers 40 --steps 20 -o again.asdf --json x.json": SKY,
    "diagnose gain.ecsv --effects beam_gain,hwp_diattenuation --json x.json": CAUSES,
    "diagnose run.ecsv --derotator linear --effects hwp_tilt --json x.json": CAUSES,
    f"{OUTPUTS['reduction']} --json x.json": TOLD,
    f"{OUTPUTS['correction']} --json x.json": TOLD,
}
LINES = 24
STARS = ["HD 293396", "HD 30675", "HD 212311", "HD 14069"]
SAMPLES = "sample cal.asdf run.ecsv --parameters hwp.w_sio2 --walkers 8 --steps 40"


def call(text):
    """Run a command of words with blanks between; return what it prints."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(text.split() if isinstance(text, str) else text)
        except SystemExit as stop:
            status = stop.code
    assert not status, err.getvalue()
    return out.getvalue(), err.getvalue()


def assert_fits(text):
    """Neither a line beyond the last column nor a character that moves the cursor."""
    wide = [line for line in text.splitlines() if len(line) > COLUMNS]
    assert not wide, "wider than 80 columns:\n" + "\n".join(wide)
    assert not [line for line in text.splitlines() if line != line.rstrip()], "blanks at an end"
    control = sorted(set(re.findall(r"[^\n\x20-\x7e]", text)))
    assert not control, f"characters that not every terminal shows alike: {control}"


def without_warnings(err):
    """What was printed to the standard error but warnings, which may be of any width."""
    return "\n".join(line for line in err.splitlines() if "warning:" not in line)


def write_tables():
    """Write tables of three bins: polarized, unpolarized, of many angles, with a gain."""
    charis = instruments.get("charis")
    wavelength = charis.wavelength[[9, 12, 16]]
    meta = charis.published_meta()
    angles = {"run": [50, 62.5, 80, 100], "dark": [45, 90], "fine": np.linspace(0, 177, 23)}
    for i, (name, derotator) in enumerate(angles.items()):
        source = "unpolarized" if name == "dark" else "polarized"
        chain = charis.chain(source, ["nbs"], wavelength=wavelength)
        frames = half_wave_plate_cycles(derotator=derotator * u.deg)
        told = meta | {"source": source, "yjh50_dichroic": "out"}
        simulate(chain, wavelength, frames, seed=i, meta=told).write(f"{name}.ecsv")
    table = QTable.read("run.ecsv")
    table["flux_right"] *= 1.03
    table.write("gain.ecsv", format="ascii.ecsv")


@pytest.fixture(scope="module", autouse=True)
def desk(tmp_path_factory):
    """A folder with tables and calibrations, in which the commands run."""
    with contextlib.chdir(tmp_path_factory.mktemp("desk")):
        write_tables()
        call("calibrate run.ecsv -q -o cal.asdf --fix hwp.theta=0 --fix derotator.theta=0")
        call(
            "calibrate run.ecsv dark.ecsv fine.ecsv -q"
            " -o a_long_name_of_a_calibration_that_joins_several_tables.asdf"
        )
        call("calibrate -q -o all.asdf")
        yield


@pytest.mark.slow
def test_output_fits_a_terminal():
    for what, words in OUTPUTS.items():
        if any(summary.startswith(words) for summary in SUMMARIES):
            # its lines are looked at below
            continue
        out, err = call(words)
        assert out.strip(), what
        assert_fits(out)
        assert_fits(without_warnings(err))


@pytest.mark.long
def test_summary_says_five_things_in_24_lines():
    for package in ("emcee", "arviz_stats"):
        pytest.importorskip(package)
    if not os.path.isdir("cubes"):
        call(OUTPUTS["cubes"])
    for words, told in SUMMARIES.items():
        out, err = call(words)
        assert_fits(out)
        assert_fits(without_warnings(err))
        # the prompt takes the last line
        assert out.count("\n") < LINES, f"{words}: too high:\n{out}"
        for item in [*told, r"^Written:    x\.json$"]:
            assert re.search(item, out, re.MULTILINE), f"{words}: no {item!r} in\n{out}"
        whole = call(f"{words} --full")[0].splitlines()
        assert_fits("\n".join(whole))
        both = CAUSES[:1] if told is CAUSES else told
        for place, items in ((whole[:LINES], both), (whole[1 - LINES :], [*both, told[-1]])):
            for item in items:
                assert any(re.search(item, line) for line in place), f"{words} --full: no {item!r}"
    assert call("info")[0].count("\n") < LINES


def test_samples_fit_a_terminal():
    for package in ("emcee", "h5py", "arviz_stats"):
        pytest.importorskip(package)
    assert_fits(call(SAMPLES)[0])


def test_star_fits_a_terminal():
    for name in STARS:
        assert_fits(call(["standards", name, *NIGHT.split()])[0])


def test_every_command_has_an_output():
    missing = set(CHOICES) - {words.split()[0] for words in [*OUTPUTS.values(), SAMPLES]}
    assert not missing, f"add a call of {sorted(missing)} to OUTPUTS in {__file__}"


def test_help_fits_a_terminal(monkeypatch):
    for command in ["", *CHOICES]:
        monkeypatch.setenv("COLUMNS", str(COLUMNS))
        text = call([*command.split(), "--help"])[0]
        assert text.startswith(f"usage: {' '.join(['astropolcal', *command.split()])} "), command
        assert_fits(text)


def test_examples_of_the_help_are_commands():
    """The calls that the help shows can be parsed."""
    for command, parser in [*CHOICES.items(), (None, PARSER)]:
        epilog = re.sub(r" \\\n +", " ", parser.epilog.replace("--help", ""))
        examples = re.findall(r"^  astropolcal (.*?)(?:  .*)?$", epilog, re.MULTILINE)
        for words in examples:
            assert PARSER.parse_args(words.split()).command == (command or words.split()[0]), words


@pytest.mark.long
def test_nothing_moves_the_cursor_of_a_pipe():
    """Progress bars and colours are for terminals; a log is plain text."""
    for words in ["simulate --cubes piped --derotator 45 --hwp 0,45", "effects"]:
        argv = OUTPUTS.get(words, words).split()
        done = subprocess.run(
            [sys.executable, "-m", "astropolcal.scripts.main", *argv],
            capture_output=True,
            check=True,
            env=os.environ | {"FORCE_COLOR": "1", "COLUMNS": "80"},
        )
        assert done.stdout, words
        assert not re.search(rb"[\r\x1b\x08]", done.stdout + done.stderr), words


@pytest.mark.skipif(os.name != "posix", reason="signals of a group of processes")
@pytest.mark.long
def test_interruption_of_several_processes_is_one_line():
    call("simulate --cubes many --source star --hwp 0,45,22.5,67.5 --derotator 50,60,70,80,90"
         " --altitude 70 --parallactic 20 --flux 2e6")  # fmt: skip
    words = "reduce many --raw many/raw -o late.ecsv --source star --workers 2 --resume begun"
    command = [sys.executable, "-m", "astropolcal.scripts.main", *words.split()]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    for attempt in range(3):
        # as a terminal does, to all processes of the command
        process = subprocess.Popen(command, start_new_session=True, **options)
        while process.poll() is None and not os.path.exists("begun"):
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate()
        if process.returncode or attempt == 2:
            break
        # it was done before the signal came
        os.remove("late.ecsv")
        os.remove("begun")
    assert process.returncode == 130, err
    lines = [line for line in err.splitlines() if "warning: " not in line]
    assert (out, lines) == ("", ["astropolcal: interrupted"])
    assert not os.path.exists("late.ecsv")
