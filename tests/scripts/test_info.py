# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal info`` on calibrations and folders of them."""

import json
import shutil
from pathlib import Path

import pytest

from astropolcal import Calibration
from astropolcal.calibration.result.validity import with_validity
from astropolcal.converters.calibration import content_hash
from astropolcal.pipeline.library import Library
from astropolcal.scripts.main import main

OLD = Path(__file__).parents[1] / "calibration" / "data" / "calibration-1.0.0.asdf"


@pytest.fixture
def folder(tmp_path):
    """Two that follow each other."""
    base = Calibration.read(OLD)
    library = Library(tmp_path)
    library.add(base, name="a.asdf", valid_until="2026-01-01")
    library.add(base, name="b.asdf", valid_from="2026-01-01", optics_in=["dichroic", "nbs"])
    return tmp_path


def test_file_says_for_what_it_is_valid(capsys):
    assert main(["info", str(OLD)]) == 0
    text = capsys.readouterr().out
    assert "valid for charis, broadband JHK, from 2025-10-05 on, with nbs" in text
    assert content_hash(Calibration.read(OLD)) in text
    assert "s_res" in text


def test_json_of_a_file(tmp_path):
    out = tmp_path / "out.json"
    assert main(["info", str(OLD), "--json", str(out)]) == 0
    told = json.loads(out.read_text())
    assert told["validity"]["optics_in"] == [["nbs"]]
    assert told["validity"]["valid_until"] is None
    assert told["content_hash"] == content_hash(Calibration.read(OLD))
    assert told["n_free"] == 10


def test_folder(folder, capsys):
    assert main(["info", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "2 calibrations" in text
    assert "from 2025-10-05 until 2026-01-01, with nbs" in text
    assert "from 2026-01-01 on, with dichroic + nbs" in text
    assert "s_res 0.073 %" in text
    assert "OVERLAP" not in text
    assert "UNREADABLE" not in text


def test_json_of_a_folder_and_what_is_wrong_in_it(folder, capsys):
    (folder / "bad.asdf").write_bytes(OLD.read_bytes()[:900])
    with_validity(Calibration.read(OLD), mode="J").write(folder / "c.asdf")
    shutil.copy(folder / "c.asdf", folder / "d.asdf")
    with_validity(Calibration.read(OLD), mode="J", valid_until="2030-01-01").write(
        folder / "e.asdf"
    )
    assert main(["info", str(folder), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [entry["name"] for entry in told["calibrations"]] == [
        "a.asdf", "c.asdf", "d.asdf", "e.asdf", "b.asdf",
    ]  # fmt: skip
    assert told["unreadable"] == {"bad.asdf": "truncated: the end of the file is missing"}
    # a copy is no second opinion
    assert len(told["overlaps"]) == 2
    assert all("e.asdf" in words for words in told["overlaps"])
    assert main(["info", str(folder)]) == 0
    text = capsys.readouterr().out
    assert "bad.asdf\n  UNREADABLE: truncated" in text
    assert "OVERLAP: c.asdf" in text


def test_empty_folder(tmp_path, capsys):
    assert main(["info", str(tmp_path)]) == 0
    assert capsys.readouterr().out.strip().endswith("0 calibrations")


def test_folder_of_tables_says_how_to_look_at_one(tmp_path, capsys):
    for name in ("a.ecsv", "b.ECSV", "c.fits", "notes.txt"):
        (tmp_path / name).write_text("")
    assert main(["info", str(tmp_path)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "0 calibrations" in text
    assert "3 tables and FITS files in it; astropolcal info FILE tells of one" in text


def test_damaged_file_is_bad_input(tmp_path, capsys):
    path = tmp_path / "bad.asdf"
    path.write_bytes(OLD.read_bytes()[:900])
    assert main(["info", str(path)]) == 2
    assert "bad.asdf: truncated" in capsys.readouterr().err
