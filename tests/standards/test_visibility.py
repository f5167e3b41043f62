# Licensed under a 3-clause BSD style license - see LICENSE
"""Altitudes and parallactic angles over a night, and the search that uses them."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.table import QTable
from astropy.time import Time

from astropolcal import standards
from astropolcal.exceptions import ParameterError
from astropolcal.standards import visibility as _sky

SUBARU = _sky.location("subaru")
NIGHT = "2025-11-03"


# ---- the parallactic angle -----------------------------------------------------------


def test_parallactic_angle_is_the_position_angle_of_the_zenith():
    star = standards.get("HD 293396").coord
    time = Time("2025-11-04 12:30")
    altitude, parallactic = _sky.pointing(star, time, SUBARU)
    with _sky.offline():
        frame = AltAz(obstime=time, location=SUBARU)
        zenith = SkyCoord(0 * u.deg, 90 * u.deg, frame=frame).icrs
    # the pole of date is within a third of a degree of that of J2000
    turned = (star.position_angle(zenith) - parallactic).wrap_at(180 * u.deg)
    assert abs(turned) < 0.3 * u.deg
    assert altitude.value == pytest.approx(90 - star.separation(zenith).deg, abs=0.02)


@pytest.mark.slow
def test_angles_agree_with_the_headers_of_charis(shared_data):
    for file, name, night in [
        ("hd293396_unpolarized_standard_2025-11-03", "HD 293396", "2025-11-02"),
        ("hd30675_polarized_standard_2025-02", "HD 30675", "2025-02-10"),
        ("hd35532_unpolarized_standard", "HD 35532", "2025-02-10"),
    ]:
        path = shared_data / "data" / "charis" / f"{file}.ecsv"
        if not path.is_file():
            pytest.skip(f"{path.name} is absent")
        frames = QTable.read(path, format="ascii.ecsv")
        frames = frames[frames["bin"] == frames["bin"][0]]
        seen = standards.observability(name, "subaru", night, step=2 * u.min, twilight=-6 * u.deg)
        # all were taken after the transit, where the altitude falls
        table = seen.table[int(np.argmax(seen.table["altitude"])) + 1 :]
        expected = np.interp(
            -frames["altitude"].value, -table["altitude"].value, table["parallactic"].value
        )
        inside = frames["altitude"] > table["altitude"].min()
        off = (frames["parallactic"].value - expected)[inside]
        assert np.sum(inside) > 20, (file, name, night)
        # the headers give the altitude of the telescope, refraction included
        assert np.max(np.abs(off)) < 0.4, (file, name, night)


# ---- one star over a night ------------------------------------------------------------


def test_table_covers_the_dark_hours():
    seen = standards.observability("HD 293396", "subaru", NIGHT)
    time = seen.table["time"]
    assert time[0].iso.startswith("2025-11-04 04:")
    assert time[-1].iso.startswith("2025-11-04 15:")
    np.testing.assert_allclose(np.diff(time.mjd) * 24 * 60, 10, rtol=1e-6)
    np.testing.assert_array_equal(seen.table["observable"], seen.table["altitude"] >= 30 * u.deg)


def test_ranges_transit_and_hours():
    seen = standards.observability("HD 293396", "subaru", NIGHT)
    # culmination at 90 - |latitude - declination of date|
    assert seen.altitude[1].value == pytest.approx(69.1, abs=0.1)
    assert seen.altitude[0] >= 30 * u.deg
    low, high = seen.parallactic
    assert low < 0 * u.deg < high
    near = seen.table[np.argmin(np.abs(seen.table["time"].mjd - seen.transit.mjd))]
    assert abs(near["parallactic"]) < 10 * u.deg
    assert seen.hours.value == pytest.approx(np.sum(seen.table["observable"]) / 6)
    spread = seen.table["altitude"] - seen.table["parallactic"]
    assert seen.difference[1] == spread[seen.table["observable"]].max()


def test_transit_does_not_hang_on_the_step():
    fine = standards.observability("HD 293396", "subaru", NIGHT, step=1 * u.min).transit
    coarse = standards.observability("HD 293396", "subaru", NIGHT, step=20 * u.min).transit
    assert abs((fine - coarse).to_value(u.s)) < 30


def test_a_star_that_culminates_in_the_north_passes_180_without_a_jump():
    seen = standards.observability("HD 30675", "subaru", NIGHT)
    assert np.max(np.abs(np.diff(seen.table["parallactic"].value))) < 60
    low, high = seen.parallactic.value
    assert -180 <= low < 180 < high


def test_a_place_a_coordinate_and_a_time_will_do():
    place = EarthLocation.from_geodetic(-155.476, 19.8255, 4139)
    star = standards.get("HD 293396")
    by_name = standards.observability(star.name, "Subaru", NIGHT)
    others = (
        standards.observability(star, place, NIGHT),
        standards.observability(star.coord, "subaru", Time(NIGHT)),
    )
    for other in others:
        np.testing.assert_allclose(other.table["altitude"], by_name.table["altitude"], atol=1e-3)
        assert other.night == NIGHT


def test_information_of_the_night():
    seen = standards.observability("HD 293396", "subaru", NIGHT)
    rows = seen.table[seen.table["observable"]]
    whole = standards.telescope_information(rows["parallactic"]).diattenuation
    assert seen.information().diattenuation == pytest.approx(whole, rel=1e-9)
    assert seen.information(32).diattenuation == pytest.approx(
        whole * np.sqrt(len(rows) / 32), rel=0.1
    )
    assert seen.information(32, offset=True).names[-1] == "offset_u"
    for bad in (0, 2.5, -1):
        with pytest.raises(ParameterError, match="frames"):
            seen.information(bad)


@pytest.mark.slow
def test_no_file_is_fetched_and_an_unknown_rotation_of_the_earth_is_said_once(no_network):
    for night, covered in (("1990-11-03", True), ("2026-12-05", True), ("2041-11-03", False)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            standards.observability("HD 293396", "subaru", night)
            standards.search(kind="unpolarized", site="subaru", night=night)
        found = [str(warning.message) for warning in caught]
        assert len(found) == (not covered), found
        # 0.9 s are 13.5 arcsec
        assert all("0.004 deg" in text for text in found)


def test_bad_night_is_refused():
    for night in ["2025-13-01", "tomorrow", "2025-02-30", "03.11.2025", "", 5, "2025-11-03 12:00"]:
        with pytest.raises(ParameterError, match=r"must be the date of the evening"):
            standards.observability("HD 293396", "subaru", night)


def test_star_that_does_not_rise_is_refused():
    with pytest.raises(ParameterError, match=r"Cha F7 does not rise above 30 deg .* gets to"):
        standards.observability("Cha F7", "subaru", NIGHT)


def test_night_without_darkness_is_refused():
    pole = EarthLocation.from_geodetic(0, 80, 0)
    with pytest.raises(ParameterError, match="the Sun does not go below -12 deg"):
        standards.observability("HD 7927", pole, "2025-06-21")


def test_bad_options_are_refused():
    for options, words in [
        ({"min_altitude": 95 * u.deg}, "min_altitude = 95 deg"),
        ({"min_altitude": 30}, "min_altitude"),
        ({"twilight": 10 * u.deg}, "twilight"),
        ({"step": 3 * u.h}, "at most 60 min"),
        ({"step": 0 * u.s}, "step"),
        ({"step": 10}, "unit of time"),
    ]:
        with pytest.raises(ParameterError, match=words):
            standards.observability("HD 293396", "subaru", NIGHT, **options)
    with pytest.raises(ParameterError, match="star has 2 positions; one is needed"):
        standards.observability(SkyCoord([1, 2], [3, 4], unit="deg"), "subaru", NIGHT)


def test_unknown_site_gets_a_suggestion():
    with pytest.raises(ParameterError, match="did you mean 'subaru'"):
        standards.observability("HD 293396", "subru", NIGHT)


# ---- search --------------------------------------------------------------------------


def test_search_without_conditions_gives_everything_by_right_ascension():
    found = standards.search()
    assert list(found["name"]) == standards.names()
    assert np.all(np.diff(found["ra"]) >= 0 * u.deg)
    assert np.all(np.isfinite(found["p"]))


def test_search_around_a_position():
    star = standards.get("HD 30675").coord
    found = standards.search(center=star, radius=5 * u.deg)
    assert found["name"][0] == "HD 30675"
    assert np.all(np.diff(found["separation"]) >= 0 * u.deg)
    every = SkyCoord(standards.catalogue()[0]["ra"], standards.catalogue()[0]["dec"])
    assert len(found) == np.sum(every.separation(star) <= 5 * u.deg) > 3


def test_search_by_kind_and_magnitude():
    found = standards.search(kind="unpolarized", magnitude=(9, 10))
    assert set(found["kind"]) == {"unpolarized"}
    assert "HD 293396" in found["name"]
    assert np.all((found["magnitude"] >= 9 * u.mag) & (found["magnitude"] <= 10 * u.mag))


def test_search_by_band_gives_magnitude_and_polarization_in_it():
    found = standards.search(kind="polarized", band="H")
    row = found[found["name"] == "HD 30675"][0]
    assert (row["magnitude"].value, row["magnitude_band"]) == (6.687, "H")
    assert row["p"].value == 1.10
    # a bright star without measurement in H has its law there
    law = found[found["name"] == "HD 7927"][0]
    assert law["p"].value == pytest.approx(
        standards.get("HD 7927").interstellar().law(1.65 * u.um).to_value(u.percent)
    )
    # neither law nor measurement in H
    assert "HD 155197" not in found["name"]
    assert "HD 155197" in standards.search(kind="polarized", band="R")["name"]


def test_search_by_night_agrees_with_observability():
    found = standards.search(
        kind="unpolarized", magnitude=(9, 10), site="subaru", night=NIGHT, min_altitude=40 * u.deg
    )
    assert np.all(np.diff(found["m3_score"]) >= 0)
    for row in found[:3]:
        seen = standards.observability(str(row["name"]), "subaru", NIGHT, min_altitude=40 * u.deg)
        assert row["altitude_max"].value == pytest.approx(seen.altitude[1].value, abs=1e-6)
        low, high = seen.parallactic.value
        assert row["parallactic_min"].value == pytest.approx(low, abs=1e-6)
        assert row["parallactic_max"].value == pytest.approx(high, abs=1e-6)
        assert row["m3_error"] == pytest.approx(seen.information(32).diattenuation, rel=1e-9)
        assert row["m3_score"] == pytest.approx(
            row["m3_error"] * 10 ** (0.2 * (row["magnitude"].value - 10)), rel=1e-9
        )
        assert row["transit"] == seen.transit.iso[:16]


@pytest.mark.slow
def test_search_leaves_out_what_does_not_rise():
    found = standards.search(site="subaru", night=NIGHT)
    assert "Cha F7" not in found["name"]
    assert "Cha F7" in standards.search(site="paranal", night="2026-03-01")["name"]


def test_search_may_be_empty():
    assert len(standards.search(magnitude=(30, 31))) == 0
    empty = standards.search(magnitude=(30, 31), site="subaru", night=NIGHT)
    assert len(empty) == 0
    assert "m3_score" in empty.colnames
    around = SkyCoord(0 * u.deg, -89 * u.deg)
    assert len(standards.search(center=around, radius=1 * u.deg)) == 0


def test_bad_conditions_are_refused():
    for options, words in [
        ({"kind": "both"}, "kind"),
        ({"site": "subaru"}, "go together"),
        ({"night": NIGHT}, "go together"),
        ({"radius": 3 * u.deg}, "go together"),
        ({"center": (3, 4), "radius": 3 * u.deg}, "SkyCoord"),
        ({"center": SkyCoord(3 * u.deg, 4 * u.deg), "radius": 0 * u.deg}, "radius"),
        ({"band": "Y"}, "band = 'Y'"),
        ({"magnitude": 5}, "two numbers"),
        ({"magnitude": (9, 5)}, "brightest"),
        ({"site": "subaru", "night": NIGHT, "min_altitude": -3 * u.deg}, "min_altitude"),
    ]:
        with pytest.raises(ParameterError, match=words):
            standards.search(**options)
