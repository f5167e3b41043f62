# Licensed under a 3-clause BSD style license - see LICENSE
"""How far long work is: a line of the terminal, and nothing anywhere else."""

import io
import itertools
import os
import subprocess
import sys
from types import SimpleNamespace

import astropy.units as u
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from astropolcal import diagnose, half_wave_plate_cycles, instruments, progress, simulate


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    """A terminal, and a clock of one second a look."""
    seconds = itertools.count()
    monkeypatch.setattr("time.monotonic", lambda: float(next(seconds)))
    # pytest exchanges that of sys between the set-up and the test
    stream = Terminal()
    monkeypatch.setattr("astropolcal.progress.sys", SimpleNamespace(stderr=stream))
    monkeypatch.setenv("COLUMNS", "60")
    return stream


def lines(terminal):
    return [line.rstrip() for line in terminal.getvalue().split("\r") if line.strip()]


def test_line_says_how_many_are_done_and_how_long_the_rest_takes(terminal):
    with progress.shown():
        progress.stage("cross-validation")
        assert list(progress.steps(range(3), "groups")) == [0, 1, 2]
    said = lines(terminal)
    assert said[0].startswith("astropolcal: cross-validation (")
    assert "astropolcal: cross-validation: 2 of 3 groups, 0:00:0" in said[2]
    assert terminal.getvalue().endswith("  \r"), "the line is gone at the end"


def test_line_fits_the_terminal(terminal):
    with progress.shown():
        progress.stage("a word " * 20)
    assert max(map(len, lines(terminal))) < 60


def test_what_was_done_before_took_no_time(terminal):
    with progress.shown(), progress.counting(1000, "steps", 900) as add:
        add(50)
    # 50 in a second or two
    assert "950 of 1000 steps, 0:00:0" in lines(terminal)[-1]


def test_work_inside_has_no_line_of_its_own(terminal):
    with progress.shown():
        for _ in progress.steps(range(3), "challenges"):
            progress.stage("fitting")
            list(progress.steps(range(9), "groups"))
            with progress.shown():
                pass
    assert {line.split()[-3] for line in lines(terminal)} == {"challenges,"}


def test_line_makes_room_for_a_warning(terminal):
    with progress.shown():
        progress.stage("fitting")
        progress.clear()
        print("astropolcal: warning: odd", file=terminal)
    assert "\rastropolcal: warning: odd\n" in terminal.getvalue()


def test_short_work_and_unwanted_lines_and_files_get_nothing(terminal, monkeypatch):
    with progress.shown(False):
        list(progress.steps(range(9), "groups"))
    list(progress.steps(range(9), "groups"))
    monkeypatch.setattr("time.monotonic", lambda: 0.0)
    with progress.shown():
        list(progress.steps(range(9), "groups"))
    monkeypatch.setattr(Terminal, "isatty", lambda self: False)
    with progress.shown():
        progress.stage("fitting")
    assert terminal.getvalue() == ""


def test_small_problems_are_solved_in_one_thread():
    """Threads that wait for each other took 30 times as long beside other work."""

    def threads():
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    charis, inside = instruments.get("charis"), set()
    wavelength = charis.wavelength[::8]
    chain = charis.chain(derotator="linear", wavelength=wavelength)
    frames = half_wave_plate_cycles(derotator=[45, 70, 95] * u.deg)
    observations = simulate(chain, wavelength, frames, seed=1)
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        diagnose(
            chain,
            observations,
            effects="beam_gain",
            cells=False,
            progress=lambda line: inside.update(threads()),
        )
        assert threads() == before
    # there are none where the linear algebra is that of the system
    assert inside == ({1} if before else set())


def test_one_thread_is_that_of_scipy_too():
    """It has a library of its own, which is not there before scipy is."""
    code = """
import numpy, sys
from threadpoolctl import threadpool_info, threadpool_limits
from astropolcal.progress import in_one_thread

@in_one_thread
def inside():
    import scipy.linalg
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]

with threadpool_limits(2, user_api="blas"):
    sys.exit(bool(set(inside()) - {1}))
"""
    two = {f"{name}_NUM_THREADS": "2" for name in ("OMP", "OPENBLAS", "MKL")}
    command = [sys.executable, "-c", code]
    assert subprocess.run(command, env=os.environ | two, check=False).returncode == 0


def test_the_limit_ends_with_the_last_of_those_that_run_at_a_time():
    def threads():
        return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with progress.in_one_thread:
            inside = threads()
            with progress.in_one_thread:
                pass
            assert threads() == inside == [1] * len(before)
        assert threads() == before
