# Licensed under a 3-clause BSD style license - see LICENSE
"""Beams on two cameras: what both headers must agree in, and electrons of both."""

import numpy as np
import pytest
from astropy.io import fits

from astropolcal.exceptions import ObservationError
from astropolcal.instruments.layout import FileLayout, ReadOut
from astropolcal.reduction.frames import (
    Frame,
    beam_detectors,
    match_beams,
    open_cube,
    survey_frames,
)
from astropolcal.reduction.photometry import detector_of

KEYWORDS = {
    "hwp": "HWP", "derotator": "ROT", "exposure_time": "EXPTIME", "flc_state": "FLC",
    "filter": "FILTER", "camera": "CAMERA", "read_mode": "MODE", "exposures": "NDIT",
}  # fmt: skip
LAYOUT = FileLayout(
    KEYWORDS, (1, 8, 16), cube_extension=0, beam_files=("cam1", "cam2"), gain=1.0,
    read_outs={"slow 1": ReadOut(0.5, 3.0, 1e4), "slow 2": ReadOut(0.25, 2.0, 2e4)},
)  # fmt: skip
HEADER = {"HWP": 22.5, "ROT": 45.0, "EXPTIME": 1.0, "FLC": "A", "FILTER": "F670", "MODE": "slow"}


@pytest.fixture
def files(tmp_path):
    """Function that writes both files of a frame, and returns the path of the right one."""

    def write(image=None, **left):
        for camera, value, changes in ((1, 1.0, {}), (2, 4.0, left)):
            cards = HEADER | {"CAMERA": camera} | changes
            header = fits.Header([(k, v) for k, v in cards.items() if v is not None])
            data = np.full((8, 8), value, dtype="f4") if image is None else image
            path = tmp_path / f"n_00000001_cam{camera}.fits"
            fits.PrimaryHDU(data, header).writeto(path, overwrite=True)
        return tmp_path / "n_00000001_cam1.fits"

    return write


def matched(path, **values):
    known = {"hwp": 22.5, "derotator": 45.0, "exposure_time": 1.0, "flc_state": "A"}
    known |= {"filter": "F670", "camera": 1.0, "read_mode": "slow"} | values
    frame = Frame(str(path), values=known)
    cube = np.concatenate([np.full((1, 8, 8), 4.0), np.ones((1, 8, 8))], axis=-1)
    return frame, *match_beams(frame, LAYOUT, cube, detector_of(LAYOUT, values=known))


def test_both_images_count_the_same_electrons(files):
    """0.25 e/adu on the left against 0.5: its adu count half."""
    frame, detector, cube = matched(files())
    assert frame.errors == []
    np.testing.assert_allclose(cube[0, :, :8], 2.0)
    np.testing.assert_allclose(cube[0, :, 8:], 1.0)
    assert detector.left.gain == detector.gain == 0.5
    # 2 electrons of read noise, 2e4 adu of 0.25 electrons
    assert detector.left.read_noise * detector.gain == pytest.approx(2.0)
    assert detector.left.saturation * detector.gain == pytest.approx(5000.0)
    right, left = beam_detectors(frame.path, LAYOUT, frame.values)
    assert left.gain / right.gain == pytest.approx(0.5)


def test_contradictions_are_errors(files):
    for keyword, value, words in [
        ("HWP", 22.7, "hwp = 22.5, but 22.7 in n_00000001_cam2.fits"),
        ("ROT", 46.0, "derotator = 45.0, but 46.0"),
        ("EXPTIME", 1.01, "exposure_time = 1.0, but 1.01"),
        ("FLC", "B", "flc_state = A, but B"),
        ("FILTER", "F610", "filter = F670, but F610"),
        ("HWP", None, "hwp = 22.5, but None"),
        ("CAMERA", 1, "CAMERA = 1, its name says 'cam2'"),
        ("ROT", "x", "n_00000001_cam2.fits: ROT = 'x', a number is needed"),
    ]:
        frame, _, _ = matched(files(**{keyword: value}))
        assert words in "; ".join(frame.errors), (keyword, value, words)


def test_rounding_is_no_contradiction(files):
    for keyword, value in [("HWP", 22.59), ("ROT", 45.4), ("EXPTIME", 1.0005)]:
        assert matched(files(**{keyword: value}))[0].errors == [], (keyword, value)


def test_an_encoder_that_begins_again_is_no_contradiction(files):
    for one, other in [(359.99, 0.01), (0.02, 179.98), (22.5, 202.5)]:
        for column, keyword in [("hwp", "HWP"), ("derotator", "ROT")]:
            frame, _, _ = matched(files(**{keyword: other}), **{column: one})
            assert frame.errors == [], (column, one, other)


def test_left_image_comes_first(files):
    with open_cube(files(), LAYOUT) as (_, _, cube, good):
        assert cube.shape == (1, 8, 16)
        assert np.unique(cube[..., :8]).tolist() == [4.0]
        assert np.unique(cube[..., 8:]).tolist() == [1.0]
        assert good.all()


def test_missing_left_file_is_named(files):
    path = files()
    path.with_name("n_00000001_cam2.fits").unlink()
    words = r"no file n_00000001_cam2.fits of the left beam beside it"
    with pytest.raises(ObservationError, match=words), open_cube(path, LAYOUT):
        pass
    with pytest.raises(ObservationError, match=r"cam2.fits: no such file"):
        beam_detectors(path, LAYOUT, {})


def test_damaged_left_file_is_named(files):
    path = files()
    path.with_name("n_00000001_cam2.fits").write_text("no FITS")
    words = r"cam2.fits: is not a FITS file"
    with pytest.raises(ObservationError, match=words), open_cube(path, LAYOUT):
        pass


def test_one_file_has_one_detector():
    right, left = beam_detectors("n_00000001.fits", FileLayout(KEYWORDS, (1, 8, 16)), {})
    assert right == left


def test_unit_of_the_files_is_that_of_the_scale(files):
    """In electrons the images of both cameras count alike already."""
    values = {"read_mode": "slow", "camera": 1.0}
    right, left = beam_detectors(files(), LAYOUT, values, "electron")
    assert right.gain == left.gain == 1.0


def test_each_camera_has_the_unit_of_its_own_header(files):
    for unit, expected in [(None, 2.0), ("adu", 2.0), ("electron", 8.0)]:
        path = files(BUNIT=unit)
        frame, _, cube = matched(path)
        # 4 electrons are 8 adu of the right camera
        np.testing.assert_allclose(cube[0, :, :8], expected, err_msg=str(unit))
        right, left = beam_detectors(path, LAYOUT, frame.values)
        assert 4.0 * left.units_of(right) == pytest.approx(expected), unit


def test_a_camera_that_lost_exposures_is_as_bright_and_noisier(files):
    _, whole, expected = matched(files(NDIT=3), exposures=3.0)
    _, detector, cube = matched(files(NDIT=2), exposures=3.0)
    np.testing.assert_allclose(cube, expected)
    ratio = detector.left.variance(cube) / whole.left.variance(expected)
    np.testing.assert_allclose(ratio, 3 / 2)


def test_beams_of_other_plate_angles_are_refused_where_no_star_is_looked_for(files):
    survey_frames([files()], LAYOUT, centre=(4, 4))
    with pytest.raises(ObservationError, match=r"hwp = 22\.5, but 67\.5 in n_00000001_cam2"):
        survey_frames([files(HWP=67.5)], LAYOUT, centre=(4, 4))
