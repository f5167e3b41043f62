# Licensed under a 3-clause BSD style license - see LICENSE
"""How files look: what a layout refuses, read-outs, and the files of two cameras."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments
from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments.layout import EM_EXCESS_NOISE, FileLayout, ReadOut

POSITIVE = ("gain", "saturation", "pixel_scale", "fwhm", "hwp_step")
NOT_NEGATIVE = ("read_noise", "edge", "tracking_tolerance")
TWO_CAMERAS = FileLayout({}, (3, 64, 128), beam_files=("cam1", "cam2"))


def layout(**settings):
    return FileLayout({"em_gain": "EMGAIN", "read_mode": "MODE"}, (3, 20, 30), **settings)


# --- what is refused --------------------------------------------------------------------


def test_number_that_must_be_positive():
    for name in POSITIVE:
        for value in [0.0, -2.5, math.nan]:
            with pytest.raises(InstrumentError, match=rf"{name} = {value}; it must be above zero"):
                layout(**{name: value})


def test_number_that_must_not_be_negative():
    for name in NOT_NEGATIVE:
        for value in [-1e-9, math.nan]:
            with pytest.raises(
                InstrumentError, match=rf"{name} = {value}; allowed are 0 and above"
            ):
                layout(**{name: value})


def test_zero_is_allowed_where_it_means_something():
    for name in NOT_NEGATIVE:
        assert getattr(layout(**{name: 0.0}), name) == 0.0, name


def test_shape_is_that_of_a_cube():
    for shape in [(20, 30), (1, 20, 30, 2), (0, 20, 30), (3, -1, 30), ()]:
        with pytest.raises(InstrumentError, match=r"shape = .*three positive numbers are needed"):
            FileLayout({}, shape)


def test_a_mean_of_exposures_has_the_electrons_of_all():
    found = layout(gain=2.0, read_noise=3.0, stacked=True).read_out({"exposures": 4.0})
    assert (found.gain, found.read_noise) == (8.0, 6.0)


def test_weights_are_one_of_two():
    with pytest.raises(InstrumentError, match="weights = 'sigma'; allowed are inverse variance"):
        layout(weights="sigma")


def test_beams_have_two_marks():
    for marks in [("cam1",), ("a", "b", "c")]:
        with pytest.raises(
            InstrumentError, match="the marks of the right and left beam are needed"
        ):
            layout(beam_files=marks)


def test_layout_is_the_same_for_ever():
    with pytest.raises(AttributeError):
        layout().gain = 3.0


# --- shapes and files of two cameras ------------------------------------------------------


def test_each_camera_has_half_of_the_columns():
    assert TWO_CAMERAS.file_shape == (3, 64, 64)
    assert layout().file_shape == (3, 20, 30)


def test_one_file_of_both_beams_has_no_left_file():
    assert layout().left_file("night_cam1.fits") is None
    assert layout().frame_files(["b_cam2.fits", "a_cam1.fits"]) == ["b_cam2.fits", "a_cam1.fits"]


@given(
    stem=st.text("abcxyz0123456789_", min_size=1, max_size=12),
    tail=st.sampled_from([".fits", "_FLC1.fits.gz", "", "-x.fits"]),
)
def test_left_file_differs_in_its_mark_only(stem, tail):
    path = f"/data/cam1/{stem}_cam1{tail}"
    left = TWO_CAMERAS.left_file(path)
    # the folder keeps its name, whatever it is
    assert str(left) == f"/data/cam1/{stem}_cam2{tail}"


def test_last_mark_in_a_name_is_that_of_the_camera():
    """A target or a run may be called as a camera is."""
    assert TWO_CAMERAS.left_file("cam1_test_cam1.fits").name == "cam1_test_cam2.fits"


def test_right_beam_is_named_where_it_is_missing():
    with pytest.raises(ObservationError, match=r"b_cam2\.fits: a frame needs the file .* 'cam1'"):
        TWO_CAMERAS.left_file("b_cam2.fits")


def test_frames_are_the_right_files_and_left_ones_that_are_alone():
    files = ["n/a_cam2.fits", "n/a_cam1.fits", "n/b_cam1.fits", "m/a_cam2.fits"]
    # m/a_cam2 belongs to no right file of its folder
    assert TWO_CAMERAS.frame_files(files) == ["n/a_cam1.fits", "n/b_cam1.fits", "m/a_cam2.fits"]


def test_order_of_frames_is_kept():
    files = [f"{name}_cam1.fits" for name in "cab"]
    assert TWO_CAMERAS.frame_files(files) == files


# --- read-outs ------------------------------------------------------------------------------

MODES = {
    "slow 1": ReadOut(0.105, 0.245, 65535.0),
    "slow 2": ReadOut(0.105, 0.220, 65535.0),
    "fast": ReadOut(0.103, 0.4, 65535.0),
    "conventional": ReadOut(4.5, 9.6, 40000.0),
    "em": ReadOut(4.5, 89.0, 65535.0, EM_EXCESS_NOISE),
}


def test_mode_and_camera_choose_the_read_out():
    for values, mode in [
        ({"read_mode": "slow", "camera": 1.0}, "slow 1"),
        ({"read_mode": " SLOW ", "camera": 2.0}, "slow 2"),
        # no entry for the camera: that of the mode
        ({"read_mode": "Fast", "camera": 2.0}, "fast"),
        ({"read_mode": "fast"}, "fast"),
        ({"em_gain": 0.0}, "conventional"),
        ({"em_gain": 1.0, "read_mode": "fast"}, "conventional"),
    ]:
        assert layout(read_outs=MODES).read_out(values) == MODES[mode], (values, mode)


def test_noise_before_the_multiplication():
    """What is read behind the register counts 1 / gain in electrons before it."""
    for gain in [1.5, 30.0, 300.0]:
        found = layout(read_outs=MODES).read_out({"em_gain": gain})
        assert found.read_noise == pytest.approx(89.0 / gain), gain
        assert found.gain == pytest.approx(4.5 / gain), gain
        # neither the limit of the converter nor the statistics of the register changes
        assert found.saturation == 65535.0, gain
        assert found.excess_noise == pytest.approx(math.sqrt(2)), gain


def test_layout_without_modes_has_its_own_numbers():
    own = layout(gain=2.0, read_noise=7.0, saturation=3e4)
    for values in ({}, {"read_mode": "anything"}, {"em_gain": 0.0}):
        assert own.read_out(values) == ReadOut(2.0, 7.0, 3e4)
    assert own.read_out({"em_gain": 10.0}) == ReadOut(0.2, 0.7, 3e4, EM_EXCESS_NOISE)


def test_mode_that_is_not_told_is_that_of_the_layout():
    assert layout(read_outs=MODES, gain=3.0).read_out({}).gain == 3.0


def test_impossible_multiplication():
    for gain in [-1.0, 0.5, math.nan]:
        with pytest.raises(
            ObservationError, match=rf"EMGAIN = {gain:g}; allowed are 0 .* 1 and above"
        ):
            layout().read_out({"em_gain": gain})


def test_unknown_mode_names_those_that_are_known():
    with pytest.raises(ObservationError, match="MODE = 'turbo'; allowed are slow 1, slow 2, fast"):
        layout(read_outs=MODES).read_out({"read_mode": "turbo", "camera": 1.0})


def test_read_out_that_cannot_be():
    for wrong in [
        {"gain": 0.0},
        {"saturation": -1.0},
        {"read_noise": -0.1},
        {"excess_noise": 0.99},
    ]:
        with pytest.raises(InstrumentError, match="gain and saturation must be above zero"):
            ReadOut(**wrong)


def test_default_read_out_adds_nothing():
    assert ReadOut() == ReadOut(1.0, 0.0, math.inf, 1.0)


def test_layouts_of_the_package_are_consistent():
    """Both beams and their rectangles fit on the image, and the site is on Earth."""
    for name in [n for n in instruments.names() if instruments.get(n).files]:
        files = instruments.get(name).files
        slices, rows, columns = files.shape
        # all wavelengths, or one filter
        assert slices in (1, instruments.get(name).wavelength.size), name
        (xl, yl), (xr, yr), width, height, _ = files.internal_apertures
        for x, y in ((xl, yl), (xr, yr)):
            assert 0 < x - width / 2 < x + width / 2 < columns, name
            assert 0 < y - height / 2 < y + height / 2 < rows, name
        # no pixel is in both
        assert xr - xl > width, name
        longitude, latitude, height = files.site
        assert abs(longitude) <= 180, name
        assert abs(latitude) <= 90, name
        assert 0 < height < 6000, name
        assert set(files.alternatives) <= set(files.keywords), name
        assert set(files.units) <= set(files.keywords), name
