# Licensed under a 3-clause BSD style license - see LICENSE
"""Values of header keywords: which of several, in which unit, and when a frame was taken."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.io.fits.card import Undefined
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.instruments.layout import (
    ANGLES,
    RANGES,
    TEXTS,
    FileLayout,
    convert,
    frame_time,
    look_up,
    unit_of,
)

LAYOUT = FileLayout(
    {
        "hwp": "RET-ANG1",
        "altitude": "ALT",
        "exposure_time": "EXPTIME",
        "mjd": "MJD",
        "date": "DATE-OBS",
        "time": "UT",
        "camera": "CAM",
        "em_gain": "EMGAIN",
        "derotator": "ROT",
    },
    (1, 8, 8),
    alternatives={"hwp": ("RET-POS1", "HWP")},
    units={"derotator": "rad", "mjd": "d"},
    transforms={"derotator": (-1.0, 0.5), "altitude": (1.0, 0.0)},
)


# --- which keyword counts -----------------------------------------------------------------


def test_first_keyword_with_a_value_counts():
    header = {"RET-POS1": 3.0, "HWP": 4.0}
    assert look_up([header], "hwp", LAYOUT) == ("RET-POS1", 3.0)
    assert look_up([header | {"RET-ANG1": 0.0}], "hwp", LAYOUT) == ("RET-ANG1", 0.0)


def test_first_header_goes_before_the_next():
    """The cube's own header first, then that of the raw frame, with every spelling of each."""
    cube, raw = {"HWP": 1.0}, {"RET-ANG1": 2.0}
    assert look_up([cube, raw], "hwp", LAYOUT) == ("HWP", 1.0)
    assert look_up([{}, raw], "hwp", LAYOUT) == ("RET-ANG1", 2.0)


def test_value_that_stands_for_none_is_passed_over():
    for nothing in ["", "  ", "unavailable", "N/A", "NaN", "#", "None", Undefined(), None]:
        assert look_up([{"RET-ANG1": nothing, "HWP": 7.0}], "hwp", LAYOUT) == ("HWP", 7.0), nothing
        assert look_up([{"RET-ANG1": nothing}], "hwp", LAYOUT) == ("RET-ANG1", None), nothing


def test_column_that_the_layout_does_not_have():
    assert look_up([{"PARANG": 3.0}], "parallactic", LAYOUT) == (None, None)


def test_card_that_cannot_be_read_is_no_number():
    header = fits.Header([fits.Card.fromstring("RET-ANG1= 12..5.3 / two points")])
    keyword, value = look_up([header], "hwp", LAYOUT)
    assert keyword == "RET-ANG1"
    with pytest.raises(ValueError, match="could not convert"):
        convert("hwp", value, LAYOUT, u.deg)


# --- units ----------------------------------------------------------------------------------


def test_units_of_keywords():
    for column, unit in [
        ("hwp", u.deg),
        ("derotator", u.rad),
        ("exposure_time", u.s),
        ("mjd", u.d),
        ("camera", u.one),
        ("em_gain", u.one),
    ]:
        assert unit_of(column, LAYOUT) == unit, (column, unit)


@given(value=st.floats(-10, 10))
def test_transform_comes_before_the_conversion(value):
    """Factor and offset are in the unit of the keyword, here radian."""
    found = convert("derotator", value, LAYOUT, u.deg)
    assert found == pytest.approx(np.degrees(0.5 - value))


def test_texts_of_numbers_are_numbers():
    assert convert("hwp", " 22.5 ", LAYOUT, u.deg) == 22.5
    assert convert("exposure_time", "1500", LAYOUT, u.ms) == pytest.approx(1.5e6)


def test_what_is_no_number():
    for value, error in [("east", ValueError), (None, TypeError), ([1, 2], TypeError)]:
        with pytest.raises(error):
            convert("hwp", value, LAYOUT, u.deg)


def test_ranges_are_of_angles_gains_and_counts():
    assert set(RANGES) == {*ANGLES, "em_gain", "exposures", "exposure_time"}
    assert RANGES["altitude"] == (0.0, 90.0)
    assert not set(ANGLES) & set(TEXTS)


# --- times ----------------------------------------------------------------------------------


def test_when_a_frame_was_taken():
    for header, expected in [
        ({"MJD": 60000.25}, "2023-02-25T06:00:00.000"),
        # the number counts more than the text, such as a local date; what is no date counts nothing
        ({"MJD": "60000.25", "DATE-OBS": "2023-02-24"}, "2023-02-25T06:00:00.000"),
        ({"MJD": 60000.25, "DATE-OBS": "25.02.2023"}, "2023-02-25T06:00:00.000"),
        ({"DATE-OBS": "2025-07-15"}, "2025-07-15T00:00:00.000"),
        ({"DATE-OBS": "2025-07-15", "UT": "03:04:05.5"}, "2025-07-15T03:04:05.500"),
        ({"DATE-OBS": " 2025-07-15T01:02:03 ", "UT": "23:00:00"}, "2025-07-15T01:02:03.000"),
    ]:
        assert frame_time(header, LAYOUT).isot == expected, (header, expected)


def test_header_without_a_date():
    for header in [{}, {"UT": "03:04:05"}, {"DATE-OBS": "unavailable"}]:
        assert frame_time(header, LAYOUT) is None, header


def test_date_that_is_none():
    for header, word in [
        ({"MJD": "soon"}, "soon"),
        ({"DATE-OBS": "15.07.2025"}, r"15\.07\.2025"),
        # a Julian Date, and two days of which nobody knows the right one
        ({"MJD": 2460953.5}, "Modified Julian Date"),
        ({"MJD": 60000.25, "DATE-OBS": "1999-01-01"}, "2023-02-25, the date 1999-01-01"),
    ]:
        with pytest.raises(ValueError, match=word):
            frame_time(header, LAYOUT)
