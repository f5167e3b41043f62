# Licensed under a 3-clause BSD style license - see LICENSE
"""The list of slow tests names tests that are there."""

import re
from pathlib import Path

import pytest

HERE = Path(__file__).parent
NAMES = (HERE / "slow_tests.txt").read_text(encoding="utf-8").split()


@pytest.mark.parametrize("module", sorted({name.partition("::")[0] for name in NAMES}))
def test_listed_tests_exist(module):
    source = (HERE.parent / module).read_text(encoding="utf-8")
    for name in NAMES:
        path, _, function = name.partition("::")
        if path == module:
            assert re.search(rf"def {function}\(", source), f"{name} is not there any more"


def test_list_is_sorted_and_without_repetition():
    assert sorted(set(NAMES)) == NAMES
