# Licensed under a 3-clause BSD style license - see LICENSE
"""Headers: matching, units, angles that cannot be right."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.io import fits
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st
from reduction_lab import HEADER, write_cube

from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments import CHARIS
from astropolcal.instruments.layout import FileLayout
from astropolcal.reduction.headers import (
    Frame,
    add_pointing,
    check_sequence,
    frame_number,
    raw_frames,
    read_header,
    tracking_error,
)

LAYOUT = CHARIS.files
CYCLE = [0, 11.25, 22.5, 33.75, 45, 56.25, 67.5, 78.75, 90]


def header(**changes):
    return fits.Header(list((HEADER | changes).items()))


def test_frame_number():
    for name, origname, number in [
        ("CRSA00170808_cube.fits", None, 170808),
        ("20251005_CRSA00170808_cube.fits", None, 170808),
        ("n0001e_skysub.fits", "CRSA00171001.fits", 171001),
        ("n0001e_skysub.fits", None, None),
        ("CRSA001708081_cube.fits", None, None),
    ]:
        cards = fits.Header() if origname is None else fits.Header({"ORIGNAME": origname})
        assert frame_number(name, LAYOUT, cards) == number, (name, origname, number)


def test_values_come_in_the_units_of_the_columns():
    values = read_header("CRSA00000001_cube.fits", LAYOUT, header=header()).values
    assert values["hwp"] == 0.0
    assert values["hwp_true"] == 80.0
    assert values["exposure_time"] == 10.0
    assert values["object"] == "HD 293396"


def test_transformations_and_units_are_applied():
    layout = replace(
        LAYOUT,
        units={"exposure_time": "ms", "hwp": "rad"},
        transforms={"derotator": (-1.0, 180.0)},
    )
    values = read_header("a.fits", layout, header=header(**{"RET-ANG1": np.pi / 4})).values
    assert values["hwp"] == pytest.approx(45.0)
    assert values["exposure_time"] == pytest.approx(0.01)
    assert values["derotator"] == pytest.approx(83.0)


def test_placeholders_count_as_missing():
    for missing in ["unavailable", "", "NaN"]:
        values = read_header("a.fits", LAYOUT, header=header(PARANG=missing)).values
        assert "parallactic" not in values, missing


def test_alternative_keywords_are_tried_in_turn():
    cards = header()
    del cards["UTC-DATE"]
    cards["DATE-OBS"] = "2025-11-04"
    assert read_header("a.fits", LAYOUT, header=cards).values["date"] == "2025-11-04"


def test_date_that_cannot_be_read_is_left_out_and_told():
    frame = read_header("a.fits", LAYOUT, header=header(**{"UTC-DATE": "5 Oct 2025"}))
    assert "date" not in frame.values
    assert frame.errors == []
    assert frame.doubts[0].startswith("UTC-DATE = '5 Oct 2025' is not a date")
    frame = read_header("a.fits", LAYOUT, header=header(**{"UTC-DATE": "20251005"}))
    assert frame.values["date"] == "2025-10-05"


def test_impossible_values_are_errors_that_name_the_keyword():
    for keyword, value in [
        ("ALTITUDE", 95.0),
        ("ALTITUDE", "6_0"),
        ("ALTITUDE", -3.0),
        ("RET-ANG1", 1e5),
        ("D_IMRANG", "x"),
        ("EXPTIME", 0),
    ]:
        frame = read_header("a.fits", LAYOUT, header=header(**{keyword: value}))
        assert len(frame.errors) == 1, (keyword, value)
        assert keyword in frame.errors[0], (keyword, value)
        assert str(value) in frame.errors[0], (keyword, value)
    # true is no angle of 1 deg
    assert (
        "RET-ANG1 = True"
        in read_header("a.fits", LAYOUT, header=header(**{"RET-ANG1": True})).errors[0]
    )


def test_keywords_of_one_angle_have_to_agree():
    layout = replace(LAYOUT, alternatives=LAYOUT.alternatives | {"hwp": ("U_HWPANG", "OLD")})
    for other, same in ((0.5, True), (180.0, True), (45.0, False), ("unavailable", True)):
        frame = read_header("a.fits", layout, header=header(U_HWPANG=other, OLD="x"))
        assert frame.values["hwp"] == 0.0
        words = ["RET-ANG1 and U_HWPANG differ by more than 1 deg"]
        assert frame.doubts == ([] if same else words)


def test_raw_frame_of_the_same_number_gives_what_the_cube_lacks(tmp_path):
    raw = tmp_path / "raw"
    raw.mkdir()
    write_cube(raw / "CRSA00000007.fits", None, RET__ANG1=33.75)
    write_cube(raw / "CRSA00000008.fits", None, RET__ANG1=45.0)
    (raw / "notes_00000007.txt").write_text("no frame")
    found = raw_frames(raw, LAYOUT)
    assert sorted(found) == [7, 8]
    cards = fits.Header({"PARANG": 1.0, "ALTITUDE": 60.0})
    frame = read_header("CRSA00000007_cube.fits", LAYOUT, header=cards, raw=found)
    assert frame.values["hwp"] == 33.75
    # what the cube has itself stays
    assert frame.values["altitude"] == 60.0
    assert frame.doubts == []
    lost = read_header("CRSA00000009_cube.fits", LAYOUT, header=cards, raw=found)
    assert lost.errors == ["no raw frame of number 9"]
    twice = {7: [*found[7], raw / "AO00000007.fits"], 8: [*found[8], raw / "CRSA00000008.fits.gz"]}
    both = read_header("CRSA00000007_cube.fits", LAYOUT, header=cards, raw=twice)
    words = "raw frame: CRSA00000007.fits and AO00000007.fits have the number 7: which one?"
    assert both.errors == [words]
    assert read_header("CRSA00000008_cube.fits", LAYOUT, header=cards, raw=twice).errors == []
    # numbers begin again: the raw frame is of MJD 60982.5
    for when, same in (
        ({"MJD": 60982.51}, True),
        ({"MJD": 60983.5}, False),
        ({"UTC-DATE": "2025-11-04", "UTC-TIME": "12:00"}, False),
        ({"UTC-DATE": "2025-11-03"}, True),
        ({"MJD": "lost"}, True),
    ):
        own = fits.Header(dict(cards) | when)
        told = read_header("CRSA00000007_cube.fits", LAYOUT, header=own, raw=found).errors
        words = "raw frame: CRSA00000007.fits of the same number is of 2025-11-03T12:00"
        assert any(error.startswith(words) for error in told) != same, when
    nameless = read_header("cube.fits", LAYOUT, header=cards, raw=found)
    assert "no frame number" in nameless.errors[0]


def test_raw_folder_without_frames(tmp_path):
    with pytest.raises(ObservationError, match="no FITS file with a frame number"):
        raw_frames(tmp_path, LAYOUT)


def pointing(values, site):
    """Return altitude and parallactic angle of a frame whose header has neither."""
    frame = Frame("cube.fits", values=dict(values))
    add_pointing([frame], replace(LAYOUT, site=site))
    if frame.errors:
        raise ObservationError(frame.errors[0])
    return frame.values["altitude"], frame.values["parallactic"]


def test_pointing_agrees_with_astropy():
    for mjd in [60250.5, 60250.6, 60982.55]:
        values = {"right_ascension": "05:05:05", "declination": "+10:00:00", "mjd": mjd}
        altitude, parallactic = pointing(values, LAYOUT.site)
        place = EarthLocation.from_geodetic(*LAYOUT.site[:2])
        time = Time(mjd, format="mjd")
        time.delta_ut1_utc = 0.0
        star = SkyCoord(values["right_ascension"], values["declination"], unit=(u.hourangle, u.deg))
        with _offline():
            frame = AltAz(obstime=time, location=place)
            seen = star.transform_to(frame)
            pole = SkyCoord(0 * u.deg, 90 * u.deg, frame="icrs").transform_to(frame)
        zenith = SkyCoord(0 * u.deg, 90 * u.deg, frame=frame)
        # azimuth runs the other way round than right ascension
        angle = seen.position_angle(pole) - seen.position_angle(zenith)
        assert altitude == pytest.approx(seen.alt.deg, abs=0.03), mjd
        assert parallactic == pytest.approx(angle.wrap_at(180 * u.deg).deg, abs=0.3), mjd


def test_angles_are_those_of_the_middle_of_the_exposure():
    """Near the zenith the parallactic angle turns by degrees in an exposure."""
    layout = replace(LAYOUT, alternatives={})
    place, found = {"RA": 76.27, "DEC": 15.0, "EXPTIME": 120.0}, []
    for keyword, moment in [
        ("MJD-OBS", 60982.54),
        ("MJD", 60982.54 + 60 / 86400),
        ("DATE-OBS", Time(60982.54, format="mjd").isot),
    ]:
        column = "date" if "DATE" in keyword else "mjd"
        own = replace(layout, keywords={"mjd": "NONE"} | layout.keywords | {column: keyword})
        cards = header(**place | {keyword: moment})
        for name in {"MJD", "PARANG", "ALTITUDE", "UTC-DATE", "UTC-TIME"} - {keyword}:
            cards.pop(name, None)
        frame = read_header("a.fits", own, header=cards)
        add_pointing([frame], own)
        assert frame.errors == []
        found.append(frame.values["parallactic"])
    np.testing.assert_allclose(found, found[1], atol=1e-3)
    start = pointing(
        {"right_ascension": "76.27", "declination": "15", "mjd": 60982.54}, LAYOUT.site
    )[1]
    assert abs(found[0] - start) > 0.2


def test_times_and_places_in_other_systems_give_no_angles():
    for keyword, value, understood in [
        ("TIMESYS", "UTC", True), ("TIMESYS", "TAI", False),
        ("EQUINOX", 2000, True), ("EQUINOX", 1950.0, False),
    ]:  # fmt: skip
        cards = header(RA=76.27, DEC=15.0, **{keyword: value})
        cards.pop("PARANG")
        frame = read_header("a.fits", LAYOUT, header=cards)
        assert frame.errors == []
        add_pointing([frame], LAYOUT)
        assert ("parallactic" in frame.values) is understood, keyword
        assert any(f"{keyword} = {value!r}" in e for e in frame.errors) is not understood, keyword


def _offline():
    from astropy.utils import iers

    return iers.conf.set_temp("auto_download", False)


def test_pointing_needs_place_and_time():
    with pytest.raises(ObservationError, match="right_ascension"):
        pointing({"mjd": 60000.0}, LAYOUT.site)
    with pytest.raises(ObservationError, match="time"):
        pointing({"date": "2025-01-01"}, LAYOUT.site)
    with pytest.raises(ObservationError, match="right ascension"):
        pointing({"right_ascension": "??", "declination": "1", "mjd": 60000.0}, LAYOUT.site)


@given(
    hwp=st.sampled_from([0.0, 45.0, 22.5, 67.5]),
    parallactic=st.floats(-180, 180),
    altitude=st.floats(0, 90),
    off=st.floats(-80, 80),
    turns=st.integers(-2, 2),
)
def test_tracking_error_is_the_deviation_modulo_half_a_turn(hwp, parallactic, altitude, off, turns):
    true = hwp + 0.5 * parallactic + altitude + off + 180.0 * turns
    values = {"hwp": hwp, "hwp_true": true, "parallactic": parallactic, "altitude": altitude}
    assert tracking_error(values, LAYOUT) == pytest.approx(off, abs=1e-9)


def test_sequence_without_fault():
    derotator = np.repeat(np.arange(45, 135, 12.5), len(CYCLE))
    assert check_sequence(CYCLE * 8, derotator, LAYOUT) == {}


def test_sequence_with_missing_frames_is_not_blamed():
    derotator = np.repeat(np.arange(45, 135, 12.5), len(CYCLE))
    keep = np.ones(72, dtype=bool)
    keep[[3, 20, 21, 60]] = False
    assert check_sequence(np.array(CYCLE * 8)[keep], derotator[keep], LAYOUT) == {}


def test_corrupted_angles_are_found_with_what_belongs_there():
    hwp = np.array(CYCLE * 8)
    hwp[20], hwp[30] = 3.7, hwp[29]
    found = check_sequence(hwp, np.repeat(np.arange(45, 135, 12.5), len(CYCLE)), LAYOUT)
    assert sorted(found) == [20, 30]
    assert "3.7 deg" in found[20]
    assert "the sequence has 22.5 deg" in found[20]
    assert "the sequence has 33.75 deg" in found[30]


def test_derotator_at_zero_stands_still_where_its_encoder_begins_again():
    hwp = np.array(CYCLE * 8)
    hwp[3] = hwp[2]
    derotator = np.repeat(np.arange(0, 90, 12.5), len(CYCLE))
    for turn in (180, 360):
        flicker = np.where(np.arange(72) % 2, 0.01, turn - 0.01)
        found = check_sequence(hwp, np.where(derotator == 0, flicker, derotator), LAYOUT)
        assert sorted(found) == [3], turn


def test_layout_refuses_nonsense():
    with pytest.raises(InstrumentError, match="gain"):
        FileLayout(keywords={}, shape=(1, 2, 3), gain=0.0)
    with pytest.raises(InstrumentError, match="read_noise"):
        FileLayout(keywords={}, shape=(1, 2, 3), read_noise=-1.0)
    with pytest.raises(InstrumentError, match="shape"):
        FileLayout(keywords={}, shape=(2, 3))
