# Licensed under a 3-clause BSD style license - see LICENSE
"""FITS products: what the header states, what comes back, what is refused."""

import dataclasses
import re
from contextlib import suppress

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from astropolcal.correction import Corrected, ScienceFrames, correct
from astropolcal.exceptions import ObservationError


@pytest.fixture(scope="module")
def corrected(calibration, charis, track, scene, seen):
    hwp, positions = track()
    stokes = scene(22, size=9)
    right, left = seen(calibration, positions, charis.wavelength, stokes)
    names = [f"CRSA{i:08d}_cube.fits" for i in range(16)]
    frames = ScienceFrames.from_arrays(
        right,
        left,
        charis.wavelength,
        positions,
        hwp=hwp,
        names=names,
        centre=(4.0, 4.0),
        variance_right=right,
        variance_left=left,
        pixel_scale=16.2,
    )
    given = {"calibration": "charis.asdf", "calibration_hash": "ab" * 32}
    return correct(calibration, frames, provenance=given)


@pytest.fixture
def path(corrected, tmp_path):
    corrected.write(tmp_path / "out.fits")
    return tmp_path / "out.fits"


def test_the_header_states_its_conventions(path, corrected):
    header = fits.getheader(path)
    assert header["POLCONV"] == "IAU"
    assert "the pole of date if coordinates gave them" in " ".join(header["COMMENT"])
    assert header["CTYPE4"] == "STOKES"
    assert (header["CRVAL4"], header["CDELT4"], header["CRPIX4"]) == (1, 1, 1)
    assert header["STOKES"] == "IQU"
    assert header["CALFILE"] == "charis.asdf"
    assert header["CALHASH"] == "ab" * 32
    assert header["CRPIX1"] == 5
    # FITS has UTC without a zone
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d", header["DATE"])
    for keyword in ("APCVERS", "APYVERS", "NPYVERS", "DATE", "INSTRUME"):
        assert header[keyword]
    assert any("m3." in line for line in header["HISTORY"])
    with fits.open(path, checksum=True) as hdus:
        hdus.verify("exception")
        names = [hdu.name for hdu in hdus]
        assert hdus["FRAMES"].data["frame"][3] == "CRSA00000003_cube.fits"
        assert hdus["COVSYST"].header["PLANE2"] == "IQ"
        units = {"COVSTAT": "adu2", "COVSYST": "adu2", "AOLP": "deg", "QPHI": "adu"}
        assert {name: u.Unit(hdus[name].header["BUNIT"]) for name in units} == {
            name: u.Unit(unit) for name, unit in units.items()
        }
    assert names[1:] == [
        "WAVELENGTH", "COVSTAT", "SYSFACT", "SYSOPEN", "COVSYST", "DOLP", "AOLP", "QPHI", "FRAMES",
    ]  # fmt: skip
    # maps are what the object says
    found = corrected.polarization()
    with fits.open(path) as hdus:
        np.testing.assert_array_equal(hdus["DOLP"].data[2], found["s_p_statistical"])
        np.testing.assert_array_equal(hdus["AOLP"].data[2], found["s_chi_systematic"])
        np.testing.assert_array_equal(hdus["QPHI"].data[0], corrected.azimuthal()["q_phi"])


def test_files_say_where_north_is_not_known_to_be_up(corrected, tmp_path):
    for up in (True, False):
        path = tmp_path / f"{up}.fits"
        dataclasses.replace(corrected, north_up=up).write(path)
        with fits.open(path) as hdus:
            assert ("as if north were up" in str(hdus["QPHI"].header.get("COMMENT", ""))) != up
            assert ("to the east" in hdus[0].header.comments["CTYPE1"]) == up


def test_astropy_reads_the_stokes_axis(path):
    from astropy.wcs import WCS

    wcs = WCS(fits.getheader(path))
    coordinates = wcs.sub([4]).pixel_to_world([0, 1, 2])
    assert list(coordinates.symbol) == ["I", "Q", "U"]


def test_everything_comes_back(corrected, path, tmp_path):
    again = Corrected.read(path)
    for name in ("stokes", "covariance", "condition", "determined", "leakage"):
        np.testing.assert_array_equal(getattr(again, name), getattr(corrected, name))
    np.testing.assert_allclose(again.wavelength, corrected.wavelength, rtol=1e-15)
    for name in ("components", "weak", "mode", "observable", "unit", "centre", "pixel_scale"):
        assert getattr(again, name) == getattr(corrected, name)
    assert again.systematic.held == corrected.systematic.held
    one, two = corrected.polarization(), again.polarization()
    for name in one:
        np.testing.assert_allclose(two[name], one[name], rtol=1e-10)
    assert again.provenance["frames"] == corrected.provenance["frames"]
    # a packed product is read alike
    import gzip

    packed = tmp_path / "packed.fits.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(Corrected.read(packed).stokes, corrected.stokes)


def test_a_spectrum_without_errors(sky, charis, star, tmp_path):
    frames = ScienceFrames.from_arrays(star.right, star.left, charis.wavelength, star.positions)
    found = correct(sky, frames)
    found.write(tmp_path / "star.fits")
    again = Corrected.read(tmp_path / "star.fits")
    assert again.covariance is None
    assert again.systematic is None
    np.testing.assert_array_equal(again.q, found.q)
    assert fits.getheader(tmp_path / "star.fits")["CTYPE2"] == "STOKES"


def test_none_of_its_frames_is_replaced(corrected, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "CRSA00000003_cube.fits").write_text("a frame")
    (tmp_path / "link.fits").symlink_to("CRSA00000003_cube.fits")
    for name in ("CRSA00000003_cube.fits", "link.fits"):
        with pytest.raises(ObservationError, match=f"{name}: .*was made from this file"):
            corrected.write(tmp_path / name, overwrite=True)
    assert (tmp_path / "CRSA00000003_cube.fits").read_text() == "a frame"
    corrected.write(tmp_path / "CRSA00000099_cube.fits")


def test_a_file_is_not_replaced_unasked(corrected, path):
    before = path.read_bytes()
    with pytest.raises(ObservationError, match="exists already"):
        corrected.write(path)
    assert path.read_bytes() == before
    corrected.write(path, overwrite=True)


def test_a_failure_leaves_nothing(corrected, tmp_path, monkeypatch):
    def fail(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fits.HDUList, "writeto", fail)
    with pytest.raises(ObservationError, match="No space left"):
        corrected.write(tmp_path / "out.fits")
    assert not list(tmp_path.iterdir())


def test_damaged_files_are_refused(path, tmp_path):
    content = path.read_bytes()
    rng = np.random.default_rng(3)
    refused = 0
    for i in range(60):
        broken = bytearray(content)
        for place in rng.integers(0, len(content), size=5):
            broken[place] ^= int(rng.integers(1, 256))
        target = tmp_path / f"broken{i}.fits"
        target.write_bytes(bytes(broken))
        # nothing but our own error may come out
        with suppress(ObservationError):
            Corrected.read(target)
            continue
        refused += 1
    assert refused > 50
    (tmp_path / "short.fits").write_bytes(content[: len(content) // 2])
    with pytest.raises(ObservationError, match=r"short\.fits"):
        Corrected.read(tmp_path / "short.fits")


def test_other_files_are_refused(tmp_path, path):
    fits.PrimaryHDU(np.ones((2, 2))).writeto(tmp_path / "other.fits")
    with pytest.raises(ObservationError, match="CONTENT = None"):
        Corrected.read(tmp_path / "other.fits")
    with pytest.raises(ObservationError, match="no such file"):
        Corrected.read(tmp_path / "nowhere.fits")
    fits.setval(path, "POLCONV", value="COSMO")
    with pytest.raises(ObservationError, match=r"POLCONV = 'COSMO'|checksum"):
        Corrected.read(path)


def test_a_keyword_of_another_kind_is_named(path):
    """Taken as they are, "F" would be true and a text no scale."""
    content = path.read_bytes()
    for keyword, value, words in [
        ("PIXSCALE", "hwp", "a finite number is needed"),
        ("PIXSCALE", True, "a finite number is needed"),
        ("STARX", "nan", "a finite number is needed"),
        ("STARY", False, "a finite number is needed"),
        ("NORTHUP", "F", "T or F is needed"),
        ("NORTHUP", 1, "T or F is needed"),
        ("CORRMODE", 3, "a text is needed"),
        ("OBSERVBL", False, "a text is needed"),
    ]:
        path.write_bytes(content)
        with fits.open(path, mode="update") as hdus:
            assert keyword in hdus[0].header
            hdus[0].header[keyword] = value
            for key in ("CHECKSUM", "DATASUM"):
                hdus[0].header.remove(key, ignore_missing=True)
        with pytest.raises(ObservationError, match=f"{keyword} = {value!r}, {words}"):
            Corrected.read(path)
    # a scale may be a whole number
    path.write_bytes(content)
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["PIXSCALE"] = 16
        for key in ("CHECKSUM", "DATASUM"):
            hdus[0].header.remove(key, ignore_missing=True)
    found = Corrected.read(path).pixel_scale
    assert (found, type(found)) == (16.0, float)


def test_a_column_in_a_heap_is_not_read(path):
    """It may claim terabytes; FITS files of ours have none."""
    for name in ["WAVELENGTH", "FRAMES"]:
        for form in ["PA(999999999)", "QD(3)"]:
            with fits.open(path) as hdus:
                columns = hdus[name].columns
                old = f"TFORM{len(columns)}  = '{columns.formats[-1]:8}'".encode()
            content = path.read_bytes()
            place = content.index(old, content.index(f"EXTNAME = '{name}".encode()) - 2880)
            card = f"{old[:10].decode()}'{form}'".ljust(80).encode()
            content = content[:place] + card + content[place + 80 :]
            for key in (b"CHECKSUM=", b"DATASUM ="):
                content = content.replace(key, b"COMMENT  ")
            path.write_bytes(content)
            with pytest.raises(ObservationError, match="not a readable product"):
                Corrected.read(path)


def test_a_file_that_was_cut_off_is_not_read(path, tmp_path):
    for cut in [1, 2880, 30_000]:
        content = path.read_bytes()
        short = tmp_path / "short.fits"
        short.write_bytes(content[:-cut])
        with pytest.raises(ObservationError, match=r"short.fits: not a readable"):
            Corrected.read(short)


def test_names_that_fits_cannot_hold_are_spelled_out(corrected, tmp_path):
    """FITS has the characters from space to tilde only."""
    given = {"frames": ["étoile.fits", "a\nb.fits"], "calibration": "Ångström.asdf"}
    other = dataclasses.replace(corrected, provenance=corrected.provenance | given)
    other.write(tmp_path / "a.fits")
    again = Corrected.read(tmp_path / "a.fits")
    assert again.provenance["frames"] == [r"\xe9toile.fits", r"a\nb.fits"]
    assert again.provenance["calibration"] == r"\xc5ngstr\xf6m.asdf"


def test_text_that_is_no_ascii_is_refused(path):
    content = path.read_bytes().replace(b"CRSA00000003_cube.fits", b"CRSA0000\xff003_cube.fits")
    for key in (b"CHECKSUM=", b"DATASUM ="):
        content = content.replace(key, b"COMMENT  ")
    path.write_bytes(content)
    with pytest.raises(ObservationError, match="text in frame is not ASCII"):
        Corrected.read(path)


def test_a_complex_column_is_refused(path):
    with fits.open(path) as hdus:
        hdus = fits.HDUList([hdu.copy() for hdu in hdus])
    table = Table.read(hdus["WAVELENGTH"])
    table["leakage"] = table["leakage"] * (1 + 1j)
    hdus["WAVELENGTH"] = fits.BinTableHDU(table, name="WAVELENGTH")
    for hdu in hdus:
        for key in ("CHECKSUM", "DATASUM"):
            hdu.header.remove(key, ignore_missing=True)
    hdus.writeto(path, overwrite=True)
    with pytest.raises(ObservationError, match="leakage is complex"):
        Corrected.read(path)


def test_units_that_fits_does_not_know_come_back(corrected, tmp_path):
    for unit in (u.electron, u.electron / u.s, u.adu / u.s):
        dataclasses.replace(corrected, unit=unit).write(tmp_path / "out.fits", overwrite=True)
        assert Corrected.read(tmp_path / "out.fits").unit == unit


def test_long_names_without_error_come_back(corrected, tmp_path):
    # 28 characters are as many as a card has room for
    names = ["a" * 28, "mirror_of_the_telescope." + "b" * 80, "c.d", "e" * 29]
    held = dataclasses.replace(corrected.systematic, held=names)
    given = corrected.provenance | {"held": names}
    weak = ["0.98 Q -0.19 U", *corrected.weak[1:]]
    one = dataclasses.replace(corrected, systematic=held, provenance=given, weak=weak)
    one.write(tmp_path / "out.fits")
    assert Corrected.read(tmp_path / "out.fits").systematic.held == names


def test_what_is_wrong_with_the_calibration_comes_back(corrected, tmp_path):
    given = corrected.provenance | {"calibration_faults": ["a" * 90, "the fit did not converge"]}
    dataclasses.replace(corrected, provenance=given).write(tmp_path / "a.fits")
    # also of a product that was read
    Corrected.read(tmp_path / "a.fits").write(tmp_path / "b.fits")
    told = Corrected.read(tmp_path / "b.fits").provenance["calibration_faults"]
    assert "; ".join(told) == "; ".join(given["calibration_faults"])


def test_how_much_resampling_took_comes_back(corrected, path, tmp_path):
    dataclasses.replace(corrected, resampling=0.6).write(tmp_path / "turned.fits")
    again = Corrected.read(tmp_path / "turned.fits")
    np.testing.assert_allclose(
        again.aperture(2).covariance, corrected.aperture(2).covariance / 0.6, rtol=1e-12
    )
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["RESAMPLE"] = 0.0
        for key in ("CHECKSUM", "DATASUM"):
            hdus[0].header.remove(key, ignore_missing=True)
    with pytest.raises(ObservationError, match=r"RESAMPLE = 0\.0"):
        Corrected.read(path)


def test_a_unit_with_a_factor_is_refused(path):
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["BUNIT"] = "2147483648"
        for key in ("CHECKSUM", "DATASUM"):
            hdus[0].header.remove(key, ignore_missing=True)
    with pytest.raises(ObservationError, match="a unit without a factor is needed"):
        Corrected.read(path)
