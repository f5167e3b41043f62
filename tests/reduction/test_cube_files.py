# Licensed under a 3-clause BSD style license - see LICENSE
"""Names, headers and extensions of simulated files, and places that cannot be written to."""

from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time

from astropolcal import instruments
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.instruments.layout import FileLayout
from astropolcal.reduction.cubes import CubeFiles, file_names, header_of, write_cube
from astropolcal.reduction.headers import read_header

CHARIS = instruments.get("charis").files
TWO = FileLayout({"hwp": "HWP", "camera": "CAM"}, (1, 4, 8), cube_extension=0,
                 beam_files=("cam1", "cam2"), prefix="v_")  # fmt: skip


def names(folder, layout=CHARIS, *, n_frames=2, **options):
    return file_names(folder, layout, CubeFiles(**options), n_frames)


def relative(found, folder):
    return [tuple(p and str(p.relative_to(folder)) for p in pair) for pair in found]


# ---- names -------------------------------------------------------------------------------


def test_cubes_and_raw_headers_share_numbers(tmp_path):
    found = relative(names(tmp_path / "run", first=99_999_998), tmp_path)
    assert found[0] == ("run/CRSA99999998_cube.fits", "run/raw/CRSA99999998.fits")
    assert (tmp_path / "run" / "raw").is_dir()


def test_right_beam_names_a_frame_of_two_files(tmp_path):
    (first, _) = relative(names(tmp_path, TWO, raw=False), tmp_path)
    assert first == ("v_00000001_cam1.fits", None)
    assert not (tmp_path / "raw").exists()


def test_numbers_that_nobody_could_read_back_are_refused(tmp_path):
    for options in [{"first": -1}, {"first": 99_999_999}, {"prefix": "run1"}]:
        with pytest.raises(ParameterError, match="the number of the frame must match"):
            names(tmp_path / "run", **options)
        assert not (tmp_path / "run").exists(), options


def test_one_file_that_exists_stops_the_run(tmp_path):
    for i, (layout, there) in enumerate([
        (CHARIS, "CRSA00000002_cube.fits"),
        (CHARIS, "raw/CRSA00000001.fits"),
        (TWO, "v_00000002_cam1.fits"),
        # the file of the left beam, which has no place in the list
        (TWO, "v_00000001_cam2.fits"),
    ]):  # fmt: skip
        folder = tmp_path / str(i)
        (folder / "raw").mkdir(parents=True)
        (folder / there).write_text("old")
        words = rf"{Path(there).name}: exists already; remove it, name another"
        with pytest.raises(ObservationError, match=words):
            names(folder, layout)
        assert len(names(folder, layout, overwrite=True)) == 2, there


def test_impossible_folders(tmp_path):
    for place, words in [
        ("a/b", "a/b: there is no folder .*/a$"),
        ("note", "note: is a file, not a folder"),
    ]:
        (tmp_path / "note").touch()
        with pytest.raises(ObservationError, match=words):
            names(tmp_path / place)


def test_folder_that_may_not_be_made_is_one_of_our_errors(tmp_path, monkeypatch):
    def refuse(self, **options):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "mkdir", refuse)
    with pytest.raises(ObservationError, match=r"run/raw: cannot be made: Permission denied"):
        names(tmp_path / "run")


# ---- headers -----------------------------------------------------------------------------


def frame(**columns):
    table = QTable({"hwp": [22.5] * u.deg, "derotator": [97.0] * u.deg})
    table["exposure_time"] = [10.0] * u.s
    table["time"] = Time(["2025-11-03T12:00:00.000"])
    for name, value in columns.items():
        table[name] = value
    return table[0]


def test_header_reads_back_what_was_written():
    row = frame(parallactic=[20.0] * u.deg, altitude=[1.2] * u.rad)
    header = fits.Header(list(header_of(row, CHARIS).items()))
    values = read_header("CRSA00000001_cube.fits", CHARIS, header=header).values
    assert values["hwp"] == pytest.approx(22.5)
    assert values["derotator"] == pytest.approx(97.0)
    assert values["altitude"] == pytest.approx(np.rad2deg(1.2))
    assert values["exposure_time"] == pytest.approx(10.0)
    assert values["mjd"] == pytest.approx(60982.5)
    assert values["instrument"] == "CHARIS"


def test_transformation_is_turned_round():
    layout = replace(TWO, transforms={"hwp": (2.0, 10.0)}, beam_files=())
    header = header_of(frame(), layout)
    # hwp = 2 header + 10
    assert header["HWP"] == pytest.approx(6.25)


def test_state_of_a_modulator_is_a_letter():
    layout = FileLayout({"flc_state": "FLC"}, (1, 4, 8))
    assert [header_of(frame(flc_state=[s]), layout)["FLC"] for s in (0.0, 1.0)] == ["A", "B"]


# ---- extensions --------------------------------------------------------------------------


def test_keywords_of_raw_frames_stay_behind(tmp_path):
    ((cube, raw),) = names(tmp_path, n_frames=1)
    header = header_of(frame(), CHARIS)
    write_cube(cube, raw, np.ones((2, 3, 4)), np.ones((2, 3, 4)), header, CHARIS)
    assert "RET-ANG1" not in fits.getheader(cube)
    assert fits.getheader(raw)["RET-ANG1"] == pytest.approx(22.5)
    with fits.open(cube) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "IMAGE", "IVAR"]
        assert [hdu.header.get("BUNIT") for hdu in hdus] == [None, "adu", "adu-2"]


def test_each_camera_gets_its_half_and_its_number(tmp_path):
    ((cube, _),) = names(tmp_path, TWO, n_frames=1, raw=False)
    image = np.arange(32.0).reshape(1, 4, 8)
    layout = replace(TWO, weights="error")
    weight = np.full((1, 4, 8), 0.25)
    weight[0, 0, 0] = 0.0
    write_cube(cube, None, image, weight, {"HWP": 1.0}, layout)
    left = cube.with_name("v_00000001_cam2.fits")
    np.testing.assert_array_equal(fits.getdata(cube), image[..., 4:])
    np.testing.assert_array_equal(fits.getdata(left), image[..., :4])
    assert [fits.getheader(path)["CAM"] for path in (cube, left)] == [1, 2]
    # inverse variance 1/4 is a standard deviation of 2; nothing known is 0 in both
    errors = fits.getdata(left, "ERR")
    assert errors[0, 0, 0] == 0.0
    assert errors[0, 1, 1] == 2.0


def test_cube_may_stand_in_any_extension(tmp_path):
    layout = replace(CHARIS, cube_extension=3)
    ((cube, _),) = names(tmp_path, n_frames=1, raw=False)
    write_cube(cube, None, np.full((2, 3, 4), 5.0), np.ones((2, 3, 4)), {}, layout)
    with fits.open(cube) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "", "", "IMAGE", "IVAR"]
        assert np.all(hdus[3].data == 5.0)
