# Licensed under a 3-clause BSD style license - see LICENSE
"""
Readers give a valid object or one of our errors, whatever a file holds.

Some spoiled files of each reader, and all that ever failed. `tests.fuzz.run` makes
any number.
"""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.fuzz.readers import READERS
from tests.fuzz.run import attempt, mutation, run

if not sys.platform.startswith("linux"):
    pytest.skip("memory and time are read from /proc", allow_module_level=True)

#: Spoiled files in the test-suite, of a series that the offline runs do not use.
SEED, COUNT = 7, 50
#: Which seeds and numbers have failed, or made the process hang or die.
FAILED = {
    "calibration": {0: (8, 54, 101, 104)},
    "forged": {0: (14, 17, 18, 21), 1: (58, 333, 1231, 717, 2987, 3133, 3222, 5030)},
    "observations": {0: (33, 45), 1: (3869, 5501, 6332, 8381)},
    "spectra": {0: (84,), 5: (8038,)},
    "csv": {5: (2376, 2800)},
    "cube": {5: (12, 4446), 6: (15,)},
    "star": {6: (482,), 8: (822,)},
    "cameras": {5: (1, 54, 162, 981, 3176)},
    "header": {5: (34, 177, 657, 697, 918, 5446), 6: (282, 826, 831)},
    "instruments": {5: (25, 95)},
    "science": {5: (418, 457, 9807), 7: (12,)},
    "product": {5: (1610, 3945, 4083, 5965, 6142)},
    "info": {5: (5271, 6925, 8189)},
    "challenge": {5: (444, 622, 898)},
}
#: Slow ones take a part of that.
SHARE = {"calibration": 2, "forged": 2, "loaded": 4, "observations": 2, "spectra": 2}
SHARE |= dict.fromkeys(("cube", "star", "cameras", "header", "science", "info", "product"), 3)
NEEDS = {"checkpoint": "h5py", "spectra": "specutils"}


@pytest.fixture(params=READERS)
def name(request):
    """A reader whose optional package is there."""
    if request.param in NEEDS:
        pytest.importorskip(NEEDS[request.param])
    return request.param


def failures(name, seed, only):
    """Return what went wrong, one line each."""
    lines = []
    run(name, 0, seed, only=only, show=lambda line, **_: lines.append(line))
    return lines


def test_good_files_are_valid(name, tmp_path):
    from tests.fuzz.run import _seeds

    reader = READERS[name]()
    for seed, content in _seeds(type(reader)).items():
        folder = tmp_path / seed
        folder.mkdir()
        assert attempt(reader, content, folder) == ("valid", "")


def test_mutations_are_always_the_same():
    reader = READERS["csv"]()
    assert mutation(reader, 3, 5) == mutation(reader, 3, 5)
    assert mutation(reader, 3, 5) != mutation(reader, 3, 6)


def test_spoiled_files(name):
    assert failures(name, SEED, range(COUNT // SHARE.get(name, 1))) == []


@pytest.mark.parametrize("name", FAILED)
def test_files_that_failed_once(name):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    for seed, only in FAILED[name].items():
        assert failures(name, seed, only) == []
