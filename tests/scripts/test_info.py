# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal info`` on calibrations and folders of them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table

from astropolcal import Calibration, instruments, optics
from astropolcal.calibration.result.calibration import with_validity
from astropolcal.converters.calibration import content_hash
from astropolcal.correction import ScienceFrames, correct
from astropolcal.observations import example_table
from astropolcal.pipeline.library import Library
from astropolcal.reduction.cubes import CubeFiles, simulate_cubes
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles

OLD = Path(__file__).parents[1] / "calibration" / "data" / "calibration-1.0.0.asdf"


@pytest.fixture
def folder(tmp_path):
    """Two that follow each other."""
    base = Calibration.read(OLD)
    library = Library(tmp_path)
    library.add(base, name="a.asdf", valid_until="2026-01-01")
    library.add(base, name="b.asdf", valid_from="2026-01-01", optics_in=["dichroic", "nbs"])
    return tmp_path


def test_file_and_json_say_for_what_it_is_valid(capsys, tmp_path):
    assert main(["info", str(OLD)]) == 0
    text = capsys.readouterr().out
    assert "valid for charis, broadband JHK, from 2025-10-05 on, with nbs" in text
    assert content_hash(Calibration.read(OLD)) in text
    assert "s_res" in text
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


def test_options_of_a_folder_do_nothing_in_silence_nowhere(folder, capsys):
    fits.PrimaryHDU().writeto(folder / "cube.fits")
    for words, told in (
        (["--frame", "a.fits"], "--frame and --context need a folder of calibrations"),
        (["--context", "now"], "--frame and --context need a folder of calibrations"),
        (["--instruments", OLD], "--instruments cannot be combined with FILE|DIR"),
        ([OLD, "--frame", "a.fits"], "need a folder of calibrations"),
        # of a terminal's options there is none for its instrument
        (
            [folder, "--frame", folder / "cube.fits"],
            "cube.fits: which instrument? the header does not say it; give a raw frame",
        ),
    ):
        assert main(["info", *map(str, words)]) == 2, words
        complaint = capsys.readouterr().err
        assert told in complaint, words
        assert "instrument=" not in complaint, words


def test_folder_without_calibrations(tmp_path, capsys):
    assert main(["info", str(tmp_path)]) == 0
    # a long path is wrapped
    assert " ".join(capsys.readouterr().out.split()).endswith("0 calibrations")
    # one of tables says how to look at one
    for name in ("a.ecsv", "b.ECSV", "c.fits", "notes.txt"):
        (tmp_path / name).write_text("")
    assert main(["info", str(tmp_path)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "0 calibrations" in text
    assert "3 tables and FITS files in it; astropolcal info FILE tells of one" in text


def test_damaged_file_is_bad_input(product, tmp_path, capsys):
    path = tmp_path / "bad.asdf"
    path.write_bytes(OLD.read_bytes()[:900])
    assert "bad.asdf: truncated" in refused(path, capsys)
    path = tmp_path / "out.fits"
    product.write(path)
    path.write_bytes(path.read_bytes()[:6000])
    assert "out.fits: " in refused(path, capsys)


HWP = [0, 45, 22.5, 67.5] * u.deg


def told(path, capsys):
    """Return the text and the JSON of a file."""
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80 or " " not in str(path)
    assert main(["info", str(path), "--json", "-"]) == 0
    return " ".join(text.split()), json.loads(capsys.readouterr().out)


def refused(path, capsys):
    assert main(["info", str(path)]) == 2
    return capsys.readouterr().err


@pytest.fixture(scope="module")
def product():
    """A star of 2 % at two wavelengths, by an ideal polarimeter."""
    chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    chain = chain | optics.WollastonPrism(name="wollaston")
    signal = 0.02 * np.array([1, -1, 0, 0])[:, None] * np.ones(2)
    frames = ScienceFrames.from_arrays(1 + signal, 1 - signal, [1.2, 1.6] * u.um, {"hwp": HWP})
    return correct(chain, frames, provenance={"calibration": "cal.asdf"})


@pytest.fixture(scope="module")
def cubes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cubes")
    charis = instruments.get("charis")
    frames = half_wave_plate_cycles(hwp=[22.5] * u.deg, derotator=60 * u.deg)
    files = CubeFiles(headers={"INSTRUME": "CHARIS", "OBJECT": "HD 1"}, raw=False)
    simulate_cubes(folder, charis.published(), charis, frames, seed=1, files=files)
    simulate_cubes(folder / "plain", charis.published(), charis, frames, seed=1)
    return folder


# ---- products --------------------------------------------------------------------------


def test_product_tells_what_it_holds(product, tmp_path, capsys):
    product.write(tmp_path / "out.fits")
    text, content = told(tmp_path / "out.fits", capsys)
    assert "corrected product, made 20" in text
    assert "Stokes parameters IQU in adu, 2 wavelengths from 1200 to 1600 nm" in text
    assert "mode stokes, observable intensity, as the detector sees the field" in text
    assert "determined at 2 of 2 wavelengths" in text
    assert "calibration: cal.asdf" in text
    assert "from 4 frames" in text
    assert "images of" not in text
    assert content["type"] == "corrected product"
    assert content["components"] == "IQU"
    assert content["shape"] == [3, 2]
    assert content["wavelength_nm"] == pytest.approx([1200, 1600])
    assert content["n_determined"] == 2
    assert content["provenance"]["calibration"] == "cal.asdf"
    assert len(content["frames"]) == 4
    assert "NOT USABLE" not in text
    made = product.provenance | {"calibration_faults": ["the fit did not converge"]}
    replace(product, provenance=made).write(tmp_path / "faulty.fits")
    text, _ = told(tmp_path / "faulty.fits", capsys)
    assert "NOT USABLE AS IT IS: the fit did not converge" in text


# ---- cubes and other FITS files ----------------------------------------------------------


def test_cube_tells_its_instrument_and_angles(cubes, capsys):
    (path,) = cubes.glob("*_cube.fits")
    text, content = told(path, capsys)
    assert "cube of charis, 3 HDUs" in text
    assert "1 IMAGE: 22 x 201 x 201 adu" in text
    assert "object HD 1" in text
    assert "hwp 22.5 deg, derotator 60 deg" in text
    assert content["instrument"] == "charis"
    assert content["hdus"][1] == {
        "name": "IMAGE", "shape": [22, 201, 201], "bits": -32, "unit": "adu",
    }  # fmt: skip
    assert content["header"]["derotator"] == 60.0
    # one without instrument is known by its shape
    (path,) = (cubes / "plain").glob("*_cube.fits")
    text, content = told(path, capsys)
    assert "cube of charis" in text
    assert content["instrument"] == "charis"
    # the angles stand in the raw header only
    assert "hwp" not in content["header"]


def test_raw_header_is_no_cube(tmp_path, capsys):
    header = fits.Header({"INSTRUME": "CHARIS", "RET-ANG1": 45.0, "ALTITUDE": 99.0})
    fits.PrimaryHDU(header=header).writeto(tmp_path / "CRSA00000001.fits")
    text, content = told(tmp_path / "CRSA00000001.fits", capsys)
    assert "FITS file of charis, 1 HDU 0 PRIMARY: no data" in text
    assert content["type"] == "FITS file of charis"
    assert "problem: ALTITUDE = 99.0, allowed are -90 to 90 deg" in text or "problem: ALT" in text


def test_plate_that_is_nowhere_it_should_be_is_doubtful(tmp_path, capsys):
    """It stands at 45 deg for the internal source, and at 45 + 20 / 2 + 70 deg on sky."""
    for true, doubtful in [(45.0, False), (125.0, False), (60.0, True)]:
        angles = {"RET-ANG1": 45.0, "RET-POS1": true, "PARANG": 20.0, "ALTITUDE": 70.0}
        header = fits.Header({"INSTRUME": "CHARIS"} | angles)
        fits.PrimaryHDU(header=header).writeto(tmp_path / "CRSA00000001.fits", overwrite=True)
        text, _ = told(tmp_path / "CRSA00000001.fits", capsys)
        assert ("doubtful: RET-ANG1 and RET-POS1 agree neither" in text) == doubtful, true


def test_any_fits_file_is_listed(tmp_path, capsys):
    for name in ["x.fits", "x.fits.gz", "x.bin"]:
        hdus = [fits.PrimaryHDU(np.zeros((2, 3))), fits.ImageHDU(np.zeros(5, "i2"), name="SPEC")]
        fits.HDUList(hdus).writeto(tmp_path / "plain.fits", overwrite=True)
        path = tmp_path / name
        if name.endswith("gz"):
            fits.HDUList(hdus).writeto(path)
        else:
            path.write_bytes((tmp_path / "plain.fits").read_bytes())
        text, content = told(path, capsys)
        assert "FITS file, 2 HDUs 0 PRIMARY: 2 x 3 1 SPEC: 5" in text, name
        assert content["type"] == "FITS file", name
        assert content["instrument"] is None, name
        assert [hdu["shape"] for hdu in content["hdus"]] == [[2, 3], [5]], name


def test_files_of_another_kind_are_bad_input(tmp_path, capsys):
    for name, content, words in [
        ("x.fits", b"hello", "x.fits: is not a FITS file"),
        ("x.fits", None, "x.fits: no such file"),
        ("x.txt", b"hello", "x.txt: info takes a calibration (.asdf), a folder"),
        ("x.png", b"\x89PNG\r\n", "x.png: info takes a calibration (.asdf), a folder"),
        ("x.txt", None, "x.txt: no such file"),
    ]:
        if content is None:
            (tmp_path / name).unlink()
        else:
            (tmp_path / name).write_bytes(content)
        assert words in refused(tmp_path / name, capsys), (name, content, words)


# ---- tables ----------------------------------------------------------------------------


def test_spectrum_of_a_correction(product, tmp_path, capsys):
    product.table().write(tmp_path / "star.ecsv", format="ascii.ecsv")
    text, content = told(tmp_path / "star.ecsv", capsys)
    assert "spectrum of a corrected target, 2 rows x" in text
    assert "calibration: cal.asdf" in text
    assert content["type"] == "spectrum of a corrected target"
    assert content["columns"]["wavelength"] in ("um", "nm")
    assert content["columns"]["q"] == ""
    assert content["meta"]["mode"] == "stokes"


def test_tables_are_known_by_their_columns(tmp_path, capsys):
    for columns, kind in [
        (["wavelength", "intensity", "q", "u"], "spectra of a target"),
        (["frame", "bin", "right_00", "left_00"], "Mueller matrices"),
        (["a", "b"], "table"),
    ]:
        table = Table({name: [1.0] for name in columns}, meta={"list": [1, "x"], "n": 2, "x": 0.5})
        table.write(tmp_path / "t.ecsv", format="ascii.ecsv", overwrite=True)
        text, content = told(tmp_path / "t.ecsv", capsys)
        assert f"{kind}, 1 row x {len(columns)} columns columns: {', '.join(columns)}" in text, (
            columns
        )
        assert "list: 1, x" in text, (columns, kind)
        assert content == {
            "file": str(tmp_path / "t.ecsv"), "type": kind, "n_rows": 1,
            "columns": dict.fromkeys(columns, ""), "meta": {"list": [1, "x"], "n": 2, "x": 0.5},
        }, (columns, kind)  # fmt: skip


def test_a_bad_observation_table_is_not_described_as_another(tmp_path, capsys):
    for missing in ["bin", "flux_left", "wavelength"]:
        table = QTable(example_table())
        table.remove_column(missing)
        table.write(tmp_path / "run.ecsv", format="ascii.ecsv", overwrite=True)
        assert f"missing column {missing}" in refused(tmp_path / "run.ecsv", capsys), missing
