# Licensed under a 3-clause BSD style license - see LICENSE
"""Files appear complete or not at all."""

import pytest

from astropolcal.exceptions import AstropolcalError, CalibrationFileError
from astropolcal.files import atomic_path


def test_the_file_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "out.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_keeps_the_old_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("ha")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [AstropolcalError, CalibrationFileError])
def test_what_the_system_refuses_is_one_of_our_errors(tmp_path, error):
    with (
        pytest.raises(error, match="cannot be written"),
        atomic_path(tmp_path / "no" / "x.txt", error) as temporary,
    ):
        temporary.write_text("x")


def test_a_block_that_writes_nothing_is_an_error(tmp_path):
    with pytest.raises(AstropolcalError, match="cannot be written"), atomic_path(tmp_path / "x"):
        pass
    assert list(tmp_path.iterdir()) == []
