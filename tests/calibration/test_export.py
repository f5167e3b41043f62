# Licensed under a 3-clause BSD style license - see LICENSE
"""Tables of Mueller matrices that pipelines in other languages read."""

import os
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from astropolcal.exceptions import CalibrationFileError, ParameterError
from astropolcal.pipeline.export import mueller_table, write_mueller
from astropolcal.pipeline.loading import load

OLD = Path(__file__).parent / "data" / "calibration-1.0.0.asdf"
POSITIONS = {"hwp": [0, 22.5] * u.deg, "derotator": 60 * u.deg}


@pytest.fixture(scope="module")
def loaded():
    return load(OLD)


@pytest.fixture
def table(loaded):
    return mueller_table(loaded, positions=POSITIONS, light="internal")


def test_table_has_a_row_a_frame_and_wavelength(loaded, table):
    assert table["frame"].tolist() == [0, 0, 0, 1, 1, 1]
    assert table["bin"].tolist() == [0, 1, 2, 0, 1, 2]
    assert table["wavelength"][:3].to_value(u.nm) == pytest.approx(loaded.wavelength.value)
    assert table["hwp"].to_value(u.deg).tolist() == [0, 0, 0, 22.5, 22.5, 22.5]
    assert set(table["derotator"].to_value(u.deg)) == {60.0}
    for beam in ("right", "left"):
        found = loaded.system_mueller(positions=POSITIONS, light="internal", beam=beam)
        np.testing.assert_array_equal(table[f"mueller_{beam}"], found.value.reshape(6, 4, 4))
        np.testing.assert_array_equal(table[f"cov_{beam}"], found.covariance.reshape(6, 16, 16))


def test_one_frame_from_its_header(loaded):
    header = {"MJD": 60988.5, "RET-ANG1": 22.5, "D_IMRANG": 60.0, "INSTRUME": "CHARIS"}
    header["FILTNAME"] = "broadband JHK"
    one = mueller_table(loaded, header, light="internal")
    assert len(one) == 3
    assert one["hwp"].to_value(u.deg) == pytest.approx([22.5] * 3)


def test_fits_as_another_language_sees_it(table, tmp_path):
    path = tmp_path / "mueller.fits"
    write_mueller(table, path)
    with fits.open(path, memmap=False) as hdus:
        hdus.verify("exception")
        data, header = hdus["MUELLER"].data, hdus["MUELLER"].header
        np.testing.assert_array_equal(data["MUELLER_RIGHT"], table["mueller_right"])
        np.testing.assert_array_equal(data["COV_LEFT"], table["cov_left"])
    keywords = {header[f"TTYPE{i}"]: i for i in range(1, header["TFIELDS"] + 1)}
    assert header[f"TDIM{keywords['MUELLER_RIGHT']}"] == "(4,4)"
    assert header[f"TDIM{keywords['COV_RIGHT']}"] == "(16,16)"
    assert header[f"TUNIT{keywords['WAVELENGTH']}"] == "nm"
    assert header[f"TUNIT{keywords['HWP']}"] == "deg"
    # in the file, the incident Stokes parameter varies fastest
    row = table["mueller_right"][0].astype(">f8").tobytes()
    assert path.read_bytes().count(row) == 1


def test_keywords_say_what_the_numbers_mean(loaded, table, tmp_path):
    path = tmp_path / "mueller.fits"
    write_mueller(table, path)
    header = fits.getheader(path, "MUELLER")
    assert header["INSTRUME"] == "charis"
    assert header["CALHASH"] == loaded.content_hash
    assert header["CALFILE"] == "calibration-1.0.0.asdf"
    assert header["CALFROM"] == "2025-10-05"
    assert header["CALOPTIC"] == "nbs"
    assert header["MUELLIGH"] == "internal"
    assert (header["NFRAMES"], header["NBINS"]) == (2, 3)
    assert "CALUNTIL" not in header
    words = " ".join(header["COMMENT"])
    assert "incident Stokes parameter j" in words
    # a longer line goes on in another card, within a word
    assert len(header["COMMENT"]) == 11
    assert "without the error of the model" in words
    for key in ("INSTRUME", "CALFROM", "MUELREF", "TTYPE4"):
        assert header.comments[key]


def test_ecsv_has_a_column_a_number(loaded, table, tmp_path):
    path = tmp_path / "mueller.ecsv"
    write_mueller(table, path)
    again = QTable.read(path)
    np.testing.assert_array_equal(again["left_02"], table["mueller_left"][:, 0, 2])
    found = loaded.system_mueller(positions=POSITIONS, light="internal", beam="left")
    assert again["left_02_err"] == pytest.approx(found.std[..., 0, 2].ravel())
    assert again["hwp"].unit == u.deg
    assert again.meta["CALHASH"] == loaded.content_hash
    # any reader of text: names in the first line that is no comment, numbers behind it
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert lines[0].split()[:3] == ["frame", "bin", "wavelength"]
    assert len(lines) == 7


def test_on_sky_the_frame_of_the_stokes_parameters_is_said(loaded):
    positions = POSITIONS | {"altitude": 60 * u.deg, "parallactic": 10 * u.deg}
    with pytest.warns(UserWarning, match="m3 not calibrated"):
        table = mueller_table(loaded, positions=positions)
    assert table.meta["MUELREF"][0] == "Q = N-S, U = NE-SW"
    assert table.meta["CALASSUM"][0] == "m3"


def test_files_appear_complete_or_not_at_all(table, tmp_path, monkeypatch):
    path = tmp_path / "mueller.fits"
    path.write_text("precious")
    with pytest.raises(CalibrationFileError, match="exists already"):
        write_mueller(table, path)

    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", refuse)
        with pytest.raises(CalibrationFileError, match=r"mueller.fits: cannot be written: Perm"):
            write_mueller(table, path, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["mueller.fits"]
    assert path.read_text() == "precious"
    write_mueller(table, path, overwrite=True)
    assert len(fits.getdata(path, 1)) == 6
    with pytest.raises(CalibrationFileError, match="no folder"):
        write_mueller(table, tmp_path / "nowhere" / "m.fits")
    with pytest.raises(ParameterError, match=r"must end in .fits or .ecsv"):
        write_mueller(table, tmp_path / "m.csv")
