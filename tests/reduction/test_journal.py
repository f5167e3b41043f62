# Licensed under a 3-clause BSD style license - see LICENSE
"""The journal of a reduction: what counts as done, and what is no journal."""

import json
import os

import numpy as np
import pytest

from astropolcal.exceptions import ObservationError
from astropolcal.reduction.frames import Frame
from astropolcal.reduction.photometry import Photometry
from astropolcal.reduction.run import Journal


@pytest.fixture
def cube(tmp_path):
    """A file and its frame."""
    path = tmp_path / "CRSA00000001.fits"
    path.write_bytes(b"x" * 100)
    photometry = Photometry.empty(2)
    photometry.flux[:] = [[1 / 3, 2.0], [1e300, 1e-300]]
    photometry.flag([False, True], "saturated")
    return path, Frame(
        str(path), 1, {"hwp": 0.1, "object": "HD 1"}, unit="adu", photometry=photometry
    )


def write(path, frame, **settings):
    journal = Journal(path, settings)
    journal.add(frame)


def test_frame_comes_back_exactly(cube, tmp_path):
    path, frame = cube
    write(tmp_path / "run", frame, radius=3)
    again = Journal(tmp_path / "run", {"radius": 3}).done(path)
    assert again.values == frame.values
    assert again.photometry.reasons == ["", "saturated"]
    np.testing.assert_array_equal(again.photometry.flux, frame.photometry.flux)
    assert again.to_dict() == frame.to_dict()


def test_frame_that_failed_is_done_too(cube, tmp_path):
    path, _ = cube
    write(tmp_path / "run", Frame(str(path), errors=["no star"]))
    assert Journal(tmp_path / "run", {}).done(path).errors == ["no star"]


def test_what_changed_is_not_done(cube, tmp_path):
    for change in ["settings", "size", "time", "name"]:
        path, frame = cube
        write(tmp_path / "run", frame, radius=3)
        if change == "size":
            state = path.stat()
            path.write_bytes(b"x" * 101)
            os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
        if change == "time":
            os.utime(path, ns=(0, 0))
        if change == "name":
            path = path.rename(tmp_path / "CRSA00000002.fits")
        settings = {"radius": 4 if change == "settings" else 3}
        assert Journal(tmp_path / "run", settings).done(path) is None, change


def test_a_left_beam_that_changed_is_not_done(cube, tmp_path):
    path, frame = cube
    left = tmp_path / "left.fits"
    left.write_bytes(b"y")
    Journal(tmp_path / "run", {}, lambda path: left).add(frame)
    assert Journal(tmp_path / "run", {}, lambda path: left).done(path) is not None
    left.write_bytes(b"yy")
    assert Journal(tmp_path / "run", {}, lambda path: left).done(path) is None


def test_order_of_settings_does_not_matter(cube, tmp_path):
    path, frame = cube
    write(tmp_path / "run", frame, a=1, b=2)
    assert Journal(tmp_path / "run", {"b": 2, "a": 1}).done(path) is not None


def test_a_file_that_is_gone_is_neither_done_nor_written(cube, tmp_path):
    path, frame = cube
    path.unlink()
    write(tmp_path / "run", frame)
    assert not (tmp_path / "run").exists()
    assert Journal(None, {}).done(path) is None


def test_last_entry_of_a_file_counts_and_cut_lines_do_not(cube, tmp_path):
    path, frame = cube
    journal = tmp_path / "run"
    write(journal, frame)
    with open(journal, "a") as stream:
        stream.write('{"key": "cut')
    frame.values["hwp"] = 45.0
    write(journal, frame)
    assert Journal(journal, {}).done(path).values["hwp"] == 45.0
    assert len(journal.read_text().splitlines()) == 3


def test_an_entry_that_is_no_frame_is_ignored(cube, tmp_path):
    for spoil in [
        {"path": 3},
        {"values": []},
        {"errors": "none"},
        {"doubts": [1]},
        {"photometry": {}},
        {"photometry": {"flux": "x"}},
        {"surplus": 1},
    ]:
        path, frame = cube
        write(tmp_path / "run", frame)
        entry = json.loads((tmp_path / "run").read_text().splitlines()[0])
        bad = entry | {"frame": entry["frame"] | spoil}
        (tmp_path / "bad").write_text(json.dumps(bad) + "\n")
        with pytest.raises(
            ObservationError, match="bad: not a journal of a reduction; take another"
        ):
            Journal(tmp_path / "bad", {})
        (tmp_path / "bad").write_text(json.dumps(entry) + "\n" + json.dumps(bad) + "\n")
        assert Journal(tmp_path / "bad", {}).done(path).values["hwp"] == 0.1, spoil


def test_what_cannot_be_read_or_written_is_said(cube, tmp_path):
    _, frame = cube
    with pytest.raises(ObservationError, match="is a folder, not a file"):
        Journal(tmp_path, {})
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ObservationError, match="binary: cannot be read as a journal"):
        Journal(tmp_path / "binary", {})
    with pytest.raises(ObservationError, match=r"run: cannot be written: there is no folder"):
        write(tmp_path / "no" / "run", frame)


def test_an_empty_file_is_a_new_journal(cube, tmp_path):
    path, frame = cube
    (tmp_path / "run").touch()
    write(tmp_path / "run", frame)
    assert Journal(tmp_path / "run", {}).done(path) is not None
