# Licensed under a 3-clause BSD style license - see LICENSE
"""One file: what cannot be opened, what its header lacks, and frames as plain numbers."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from reduction_lab import HEADER, expose, pair, star_image, write_cube

from astropolcal import instruments
from astropolcal.exceptions import ObservationError
from astropolcal.reduction import reduce_run
from astropolcal.reduction.frames import (
    Frame,
    Masters,
    _check_header,
    check_stars,
    open_cube,
    reduce_frame,
)
from astropolcal.reduction.headers import not_of_instrument, observation_time

LAYOUT = instruments.get("charis").files


@pytest.fixture
def flat(small, tmp_path, flat_cube):
    """A good file."""
    return write_cube(tmp_path / "CRSA00000001_cube.fits", flat_cube)


def opened(path, layout):
    with open_cube(path, layout) as (_, _, cube, good):
        return np.array(cube), good


# ---- files that cannot be opened -------------------------------------------------------


def test_other_files_are_called_that(tmp_path, small):
    for content, words in [
        (b"hello world\n", "is not a FITS file"),
        (b"# %ECSV 1.0\n" * 400, "is not a FITS file"),
        (b"", "not a readable FITS file: Empty or corrupt FITS file"),
    ]:
        path = tmp_path / "night.fits"
        path.write_bytes(content)
        with (
            pytest.raises(ObservationError, match=f"night.fits: {words}$"),
            open_cube(path, small.files),
        ):
            pass
        # what astropy would have tried does not help anybody here
        with pytest.raises(
            ObservationError, match=f"^the file cannot be used: .*{words}$"
        ) as caught:
            reduce_run([path], small)
        assert "ignore_missing" not in str(caught.value), (content, words)


def test_many_bad_files_are_counted(tmp_path, small):
    words = r"none of the 2 files can be used: .*a.fits: no such file \(and 1 more\)"
    with pytest.raises(ObservationError, match=words):
        reduce_run([tmp_path / "a.fits", tmp_path / "b.fits"], small)


def test_truncated_files_are_refused_without_a_warning(flat, small):
    for size in [4000, 40_000]:
        flat.write_bytes(flat.read_bytes()[:size])
        with pytest.raises(ObservationError, match="the file cannot be used: ") as caught:
            reduce_run([flat], small)
        assert "Warning" not in str(caught.value), size


def test_what_fails_in_the_block_is_not_the_file(flat, small):
    with pytest.raises(OSError, match="No SIMPLE card of the caller"), open_cube(flat, small.files):
        raise OSError("No SIMPLE card of the caller")


# ---- cubes -----------------------------------------------------------------------------


def test_pixels_without_value_or_weight_are_not_good(small, tmp_path, flat_cube):
    cube = flat_cube.copy()
    cube[1, 5, 6] = np.nan
    weight = np.ones_like(cube)
    weight[2, 7, 8], weight[3, 9, 10] = 0.0, -1.0
    path = write_cube(tmp_path / "a.fits", cube, extra_hdus=[fits.ImageHDU(weight)])
    _, good = opened(path, small.files)
    assert np.argwhere(~good).tolist() == [[1, 5, 6], [2, 7, 8], [3, 9, 10]]


def test_extension_of_another_size_is_no_weight(small, tmp_path, flat_cube):
    extra = [fits.ImageHDU(np.zeros((2, 2)))]
    _, good = opened(write_cube(tmp_path / "a.fits", flat_cube, extra_hdus=extra), small.files)
    assert good.all()


def test_pixels_become_native_floats(small, tmp_path, flat_cube):
    for kind, dtype in [("f8", "f8"), (">f4", "f4"), ("i2", "f8")]:
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(flat_cube.astype(kind))]
        fits.HDUList(hdus).writeto(tmp_path / "a.fits", overwrite=True)
        cube, _ = opened(tmp_path / "a.fits", small.files)
        assert cube.dtype == np.dtype(dtype), (kind, dtype)
        np.testing.assert_allclose(cube, flat_cube.astype(kind).astype(float), rtol=1e-6)


def test_complex_shapes_are_refused(small, tmp_path):
    path = write_cube(tmp_path / "a.fits", np.zeros((201, 201)))
    words = r"shape \(201, 201\) in extension 1, \(4, 201, 201\) is needed"
    with pytest.raises(ObservationError, match=words):
        opened(path, small.files)


def test_checksums_that_do_not_match_are_found_wherever_files_are_read(small, tmp_path, flat_cube):
    """A bit of the data, or a letter of the header, of cubes, raw frames and any FITS file."""
    from astropolcal.correction.sources import CubeFiles
    from astropolcal.scripts._info import describe_fits

    path = tmp_path / "CRSA00000001_cube.fits"
    write_cube(path, flat_cube)
    with fits.open(path) as hdus:
        hdus.writeto(path, overwrite=True, checksum=True)
    raw = {1: [tmp_path / "CRSA00000001.fits"]}
    good = path.read_bytes()
    for place, keyword in ((-4000, "DATASUM"), (good.index(b"HD 293396"), "CHECKSUM")):
        spoiled = bytearray(good)
        spoiled[place] ^= 1
        path.write_bytes(spoiled)
        raw[1][0].write_bytes(spoiled)
        (error,) = reduce_frame(path, small.files).errors
        assert error.startswith(f"{keyword} = ")
        for read in (describe_fits, lambda p: CubeFiles([p], [(131, 116), (71, 86)], 21)):
            with pytest.raises(ObservationError, match=f"{path}: {keyword} = .* does not match"):
                read(path)
    # of a raw frame only the header counts
    cube = write_cube(tmp_path / "x_00000001_cube.fits", flat_cube, drop=["RET-ANG1"])
    assert reduce_frame(cube, small.files, raw=raw).errors[0].startswith("raw frame: ")
    path.write_bytes(good)
    raw[1][0].write_bytes(good)
    assert reduce_frame(path, small.files).errors == []
    assert reduce_frame(cube, small.files, raw=raw).errors == []


# ---- headers ---------------------------------------------------------------------------


def test_errors_of_a_header_are_listed_once(small, tmp_path, flat_cube):
    for changes, drop, words in [
        ({}, ["RET-ANG1"], ["no keyword RET-ANG1 in its header"]),
        ({}, ["RET-ANG1", "D_IMRANG"], ["no keyword RET-ANG1", "no keyword D_IMRANG"]),
        # a keyword that is wrong is not missing as well
        ({"RET__ANG1": "x"}, [], ["RET-ANG1 = 'x', a number is needed"]),
        ({"INSTRUME": "HICIAO"}, [], ["INSTRUME = 'HICIAO', allowed are CHARIS"]),
    ]:
        path = write_cube(tmp_path / "CRSA00000001.fits", flat_cube, drop=drop, **changes)
        errors = reduce_frame(path, small.files).errors
        assert len(errors) == len(words), (changes, drop, words)
        assert all(error.startswith(word) for error, word in zip(errors, words, strict=True)), (
            changes,
            drop,
            words,
        )


def test_time_is_completed_from_date_or_mjd(small, tmp_path, flat_cube):
    for name, drop in (("a", ["MJD"]), ("b", ["UTC-DATE", "UTC-TIME"])):
        path = write_cube(tmp_path / f"{name}.fits", flat_cube, drop=drop)
        values = reduce_frame(path, small.files).values
        assert values["mjd"] == pytest.approx(60982.5)
        assert values["date"] == "2025-11-03"


def test_observation_time():
    for values, mjd in [
        ({"mjd": 60982.25}, 60982.25),
        ({"date": "2025-11-03", "time": "06:00:00"}, 60982.25),
        ({"date": "2025-11-03T06:00:00"}, 60982.25),
        ({"date": "20251103", "time": "06:00:00"}, 60982.25),
        # the number goes before the words
        ({"mjd": 60981.5, "date": "2025-11-03T06:00:00"}, 60981.5),
    ]:
        assert observation_time(values).mjd == pytest.approx(mjd), (values, mjd)


def test_impossible_times():
    for values, words in [
        ({}, "no date to compute the time from"),
        ({"date": "2025-11-03"}, "no time to compute the time from"),
        ({"date": "yesterday", "time": "noon"}, "time: "),
        ({"date": "2025-13-03", "time": "06:00:00"}, "time: "),
    ]:
        with pytest.raises(ObservationError, match=words):
            observation_time(values)


def test_own_and_silent_headers_belong_to_the_instrument():
    for own in ["CHARIS", None]:
        values = {} if own is None else {"instrument": own}
        assert not_of_instrument(values, LAYOUT) == "", own


# ---- frames as plain numbers -----------------------------------------------------------


def test_frame_survives_as_plain_numbers(flat, small):
    frame = reduce_frame(flat, small.files)
    assert frame.usable
    again = Frame.from_dict(frame.to_dict())
    assert again.to_dict() == frame.to_dict()
    assert (again.name, again.number, again.unit) == ("CRSA00000001_cube.fits", 1, "adu")
    assert again.values["hwp"] == HEADER["RET-ANG1"]
    np.testing.assert_array_equal(again.photometry.variance, frame.photometry.variance)


def test_digest_knows_the_fluxes(small, tmp_path, flat_cube):
    one = reduce_frame(write_cube(tmp_path / "a.fits", flat_cube), small.files)
    same = reduce_frame(write_cube(tmp_path / "b.fits", flat_cube, RET__ANG1=45.0), small.files)
    other = reduce_frame(write_cube(tmp_path / "c.fits", flat_cube * 1.001), small.files)
    assert one.digest == same.digest != other.digest
    assert len(one.digest) == 24


def test_frame_without_any_good_slice_says_the_usual_reason(small, tmp_path):
    cube = expose(np.full((201, 201), 0.0), small.files) - 1000.0
    frame = reduce_frame(write_cube(tmp_path / "a.fits", cube), small.files)
    assert frame.errors == ["no slice can be used: no light"]
    assert not frame.usable


# ---- stars -----------------------------------------------------------------------------

SKY = {"hwp": 0.0, "derotator": 97.0, "parallactic": 20.0, "altitude": 70.0, "hwp_true": 80.0}
TARGET = {"right_ascension": "05:05:05", "declination": "+10:00:00", "mjd": 60250.5}


def starred(*, without=(), **changes):
    """Return a frame whose header has been checked for a star."""
    values = {k: v for k, v in (SKY | changes).items() if k not in without}
    frame = Frame("CRSA00000001.fits", 1, values)
    _check_header(frame, LAYOUT, "star")
    check_stars([frame], LAYOUT)
    return frame


def test_plate_that_follows_the_sky_is_fine():
    # 0 + 20 / 2 + 70
    frame = starred()
    assert (frame.errors, frame.doubts) == ([], [])


def test_plate_off_the_tracking_law():
    for hwp_true, off in [(80.9, None), (81.5, "+1.50"), (78.0, "-2.00")]:
        errors = starred(hwp_true=hwp_true).errors
        words = (
            f"RET-POS1 = {hwp_true:g} deg is {off} deg off the tracking law; up to 1 deg is allowed"
        )
        assert errors == ([] if off is None else [words]), (hwp_true, off)


def test_plate_of_an_internal_source_stands_where_it_was_sent():
    for hwp_true, same in [(0.9, True), (179.5, True), (80.0, False)]:
        frame = Frame("CRSA00000001.fits", 1, SKY | {"hwp_true": hwp_true})
        _check_header(frame, LAYOUT, "internal")
        assert frame.errors == [], (hwp_true, same)
        words = "RET-POS1 and RET-ANG1 differ by more than 1 deg, though the plate does not follow"
        assert [doubt.startswith(words) for doubt in frame.doubts] == [True] * (not same), (
            hwp_true,
            same,
        )


def test_unknown_plate_angle_is_a_doubt():
    frame = starred(without=["hwp_true"])
    assert frame.errors == []
    assert frame.doubts == [
        "no keyword RET-POS1: the tracking of the half-wave plate was not checked"
    ]


def test_pointing_follows_from_place_and_time_but_what_is_known_stays():
    for missing in [["parallactic"], ["parallactic", "altitude"]]:
        frame = starred(without=[*missing, "hwp_true"], **TARGET)
        assert frame.values["parallactic"] == pytest.approx(-44.9, abs=0.1), missing
        assert frame.values["altitude"] == pytest.approx(
            75.9 if "altitude" in missing else 70, abs=0.1
        ), missing
        assert frame.doubts[0] == (
            f"{' and '.join(missing)} computed from the coordinates and the time"
        ), missing


def test_star_without_pointing_is_an_error_that_says_both():
    (error,) = starred(without=["parallactic", "hwp_true"]).errors
    assert error.startswith("no keyword PARANG in its header, and no ")


def test_weights_and_errors_that_are_no_numbers_mark_pixels_without_a_value(
    small, tmp_path, flat_cube
):
    weight = np.ones_like(flat_cube)
    weight[0, 0, :4] = 0.0, -1.0, np.nan, np.inf
    for kind in ("inverse variance", "error"):
        path = tmp_path / f"{kind}.fits"
        write_cube(path, flat_cube, extra_hdus=[fits.ImageHDU(weight)])
        _, good = opened(path, replace(small.files, weights=kind))
        assert not good[0, 0, :4].any(), kind
        assert good.sum() == good.size - 4, kind


def test_what_measures_nothing_is_no_light_of_a_star(small, tmp_path):
    """Cut off below the limit that is stated, in whole numbers too; lost packets and dead areas."""
    places = pair(small.files)
    cube = expose(star_image(places, flux=1e6), small.files, n_wavelengths=4)
    (x, y, _), lost = places[1], cube.copy()
    lost[0, int(y) - 3 : int(y) + 3, int(x) + 6 : int(x) + 12] = 0.0
    lost[1, int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3] = 0.0
    lost[2, :, int(x) + 1] = 0.0
    lost[3, int(y) + 9] = 0.0
    top = 0.8 * cube.max()
    # a dark and a flat leave few pixels equal
    flat = fits.PrimaryHDU(np.random.default_rng(1).normal(1.0, 0.02, (201, 201)))
    flat.writeto(tmp_path / "flat.fits")
    masters = Masters(flat=str(tmp_path / "flat.fits"))
    full, fine = ["saturated"] * 4, [""] * 4
    for i, (made, options, reasons) in enumerate([
        (cube, {}, fine),
        (np.rint(cube), {}, fine),
        (np.minimum(cube, top), {}, full),
        (np.rint(np.minimum(cube, top)), {}, full),
        (np.minimum(cube, top), {"masters": masters}, full),
        (lost, {}, ["", "aperture masked", "aperture masked", ""]),
    ]):  # fmt: skip
        path = write_cube(tmp_path / f"CRSA{i:08d}.fits", made)
        found = reduce_frame(path, small.files, source="star", **options).photometry
        assert found.reasons == reasons, i
        if reasons != full:
            np.testing.assert_allclose(found.flux[0, [0, 3]], 1e6, rtol=5e-3, err_msg=i)
    # nor is a lamp without noise cut off, or one of few electrons
    lamp = np.random.default_rng(2).poisson(2.0, (4, 201, 201)).astype(float)
    for i, made in enumerate([np.full((4, 201, 201), 300.0), lamp], start=10):
        path = write_cube(tmp_path / f"CRSA{i:08d}.fits", made)
        assert reduce_frame(path, small.files).photometry.reasons == fine, i
