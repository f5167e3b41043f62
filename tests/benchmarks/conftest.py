# Licensed under a 3-clause BSD style license - see LICENSE
"""
Lets the benchmarks import what times them, and keeps their times.

``pytest tests/benchmarks --record FILE`` writes the table that docs/speed.rst shows, if no
benchmark failed.
"""

import csv
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

_ROWS = []
# what most readers look for
_FIRST = ("test_others.py", "test_speed.py")


def pytest_addoption(parser):
    parser.addoption("--record", metavar="FILE", help="write the times to a table (CSV)")


def pytest_collection_modifyitems(items):
    items.sort(key=lambda item: item.path.name not in _FIRST)


@pytest.fixture
def measured(capsys):
    """Print and keep how long something takes (s), in how much memory (MB), and beside what."""

    def keep(what, seconds, beside=(), memory=None):
        time = _in_words(seconds) + (f", {memory:.0f} MB" if memory else "")
        ratios = {other: _digits(theirs / seconds) for other, theirs in dict(beside).items()}
        _ROWS.extend((what, time, *pair) for pair in ratios.items() or [("", "")])
        with capsys.disabled():
            print(f"\n  {what}: {time}", *(f"{k} x {v}" for k, v in ratios.items()), sep="; ")

    return keep


def _in_words(seconds):
    return f"{_digits(1e3 * seconds)} ms" if seconds < 0.1 else f"{_digits(seconds)} s"


def _digits(value):
    return f"{value:.2g}" if value < 10 else f"{value:.0f}"


def pytest_sessionfinish(session, exitstatus):
    path = session.config.getoption("--record")
    if path and exitstatus == 0:
        with Path(path).open("w", encoding="utf-8", newline="") as stream:
            table = csv.writer(stream, lineterminator="\n")
            table.writerow(("What", "Time", "Beside", "Their time over ours"))
            table.writerows(_ROWS)
