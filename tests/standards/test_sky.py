# Licensed under a 3-clause BSD style license - see LICENSE
"""Sites, dark hours and angles of a night, each against what is known without the package."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, get_body, get_sun
from astropy.time import Time

from astropolcal.exceptions import ParameterError
from astropolcal.standards.visibility import (
    SITES,
    checked,
    date_of,
    location,
    night_table,
    night_times,
    offline,
    pointing,
)

SUBARU = location("subaru")
NIGHT = "2025-11-03"


# --- sites --------------------------------------------------------------------------------


def test_names_of_sites_are_forgiven():
    for written in ["gemini_south", "Gemini South", " GEMINI-SOUTH "]:
        place = location(written)
        assert place.lat.deg == pytest.approx(-30.2407, abs=1e-4), written
        assert place.lon.deg == pytest.approx(-70.7367, abs=1e-4), written


def test_sites_are_as_far_apart_as_they_are():
    for one, other, nearest, farthest in [
        # the summit of Mauna Kea, Cerro Pachon to Cerro Paranal, and both sides of the Pacific
        ("subaru", "keck", 0.05, 0.5),
        ("gemini_south", "paranal", 600, 650),
        ("subaru", "paranal", 9500, 10800),
    ]:
        places = [u.Quantity(location(name).geocentric).to_value(u.km) for name in (one, other)]
        chord = np.linalg.norm(places[0] - places[1])
        assert nearest < 2 * 6371 * np.arcsin(chord / 2 / 6371) < farthest, (
            one,
            other,
            nearest,
            farthest,
        )


def test_observatories_stand_on_mountains():
    for name in SITES:
        assert 2500 < location(name).height.to_value(u.m) < 4300


def test_a_place_is_taken_as_it_is():
    place = EarthLocation.from_geodetic(10, 20, 30)
    assert location(place) is place


def test_unknown_site_lists_the_known_ones():
    for name in ["", "subaro", 7, None]:
        with pytest.raises(
            ParameterError, match=r"is not known.*keck, paranal, subaru.*EarthLocation"
        ):
            location(name)


# --- dark hours -----------------------------------------------------------------------------


@pytest.mark.slow
def test_rows_are_those_of_the_evening_named():
    """The middle of the night is local midnight of that date, wherever the site is."""
    for site in list(SITES):
        place = location(site)
        times = night_times(place, NIGHT, twilight=-12 * u.deg, step=10 * u.min)
        middle = times[len(times) // 2]
        local = middle + place.lon.to_value(u.deg) / 360 * u.day
        midnight = Time("2025-11-04T00:00")
        # the equation of time is a quarter of an hour in November, daylight is symmetric about noon
        assert abs((local - midnight).to_value(u.min)) < 25, site


def test_the_sun_is_below_the_limit_in_all_rows_and_nowhere_else():
    times = night_times(SUBARU, NIGHT, twilight=-18 * u.deg, step=10 * u.min)
    around = times[0] + np.arange(-1, len(times) + 1) * 10 * u.min
    with offline():
        altitude = get_sun(around).transform_to(AltAz(obstime=around, location=SUBARU)).alt.deg
    assert (altitude[1:-1] < -18).all()
    assert altitude[0] > -18
    assert altitude[-1] > -18


def test_deeper_twilight_makes_a_shorter_night():
    """Near the equator the Sun sinks 15 deg an hour, a little less at 20 deg of latitude."""
    lengths = [
        len(night_times(SUBARU, NIGHT, twilight=t * u.deg, step=2 * u.min)) for t in (0, -6, -12)
    ]
    assert lengths[0] > lengths[1] > lengths[2]
    # two twilights of 6 deg each
    assert 24 <= lengths[0] - lengths[1] <= 30


def test_rows_are_a_step_apart():
    for step in [4, 7.5, 60]:
        times = night_times(SUBARU, NIGHT, twilight=-12 * u.deg, step=step * u.min)
        gaps = np.diff(times.mjd) * 1440
        np.testing.assert_allclose(gaps, step, rtol=1e-6)


def test_polar_day_has_no_night_and_polar_night_no_end():
    pole = EarthLocation.from_geodetic(0, 89.9, 0)
    with pytest.raises(ParameterError, match=r"night = 2025-06-21: the Sun does not go below 0"):
        night_times(pole, "2025-06-21", twilight=0 * u.deg, step=60 * u.min)
    assert len(night_times(pole, "2025-12-21", twilight=-12 * u.deg, step=60 * u.min)) == 24


def test_message_says_how_deep_the_sun_gets():
    """At 60 deg north on midsummer the Sun gets to 90 - 60 - 23.4 = 6.6 deg below."""
    place = EarthLocation.from_geodetic(0, 60, 0)
    with pytest.raises(ParameterError, match=r"below -12 deg at this site; it gets to -6\.[56]"):
        night_times(place, "2025-06-21", twilight=-12 * u.deg, step=10 * u.min)


def test_a_night_is_a_date():
    for night in ["2025-11", "2025-11-03T10:00", "tonight", "2025-02-30", "", 5]:
        with pytest.raises(ParameterError, match="must be the date of the evening"):
            night_times(SUBARU, night, twilight=-12 * u.deg, step=10 * u.min)


def test_a_time_is_a_night_too():
    assert date_of(" 2025-11-03 ", SUBARU) == "2025-11-03"
    # a moment belongs to the night from noon to noon at the site: here noon is at 22:22 UTC
    for text, evening in {"03T22:10": "02", "03T22:30": "03", "04T12:00": "03"}.items():
        assert date_of(Time(f"2025-11-{text}"), SUBARU) == f"2025-11-{evening}", text
    text, time = (
        night_times(SUBARU, night, twilight=-12 * u.deg, step=30 * u.min)
        for night in (NIGHT, Time(NIGHT))
    )
    np.testing.assert_array_equal(text.mjd, time.mjd)


# --- options ----------------------------------------------------------------------------------


def test_options_may_have_any_unit():
    limit, dark, step = checked(0.5 * u.rad, -720 * u.arcmin, 0.25 * u.h)
    assert limit.to_value(u.deg) == pytest.approx(np.rad2deg(0.5))
    assert dark.to_value(u.deg) == pytest.approx(-12)
    assert step.to_value(u.min) == pytest.approx(15)


def test_impossible_options_are_named():
    for options, words in [
        ((-1 * u.deg, -12 * u.deg, 10 * u.min), "min_altitude = -1 deg must be from 0"),
        ((90 * u.deg, -12 * u.deg, 10 * u.min), "min_altitude = 90 deg must be from 0"),
        ((30, -12 * u.deg, 10 * u.min), "min_altitude"),
        ((30 * u.deg, 1 * u.deg, 10 * u.min), "twilight = 1 deg must be from -90 to 0"),
        ((30 * u.deg, -91 * u.deg, 10 * u.min), "twilight = -91 deg must be from -90 to 0"),
        ((30 * u.deg, -12 * u.deg, 10), "step = 10 needs a unit of time"),
        ((30 * u.deg, -12 * u.deg, 10 * u.deg), "needs a unit of time"),
        ((30 * u.deg, -12 * u.deg, 0 * u.min), "step = 0 min must be positive"),
        ((30 * u.deg, -12 * u.deg, 61 * u.min), "at most 60 min"),
    ]:
        with pytest.raises(ParameterError, match=words):
            checked(*options)


def test_ends_of_the_ranges_are_allowed():
    for end in [0 * u.deg, 89.9 * u.deg]:
        limit, dark, _ = checked(end, 0 * u.deg, 60 * u.min)
        assert u.isclose(limit, end, atol=1e-9 * u.deg), end
        assert dark == 0 * u.deg, end


# --- one star over the night -------------------------------------------------------------------


def _table(parallactic, altitude=None):
    altitude = np.full(len(parallactic), 50.0) if altitude is None else altitude
    times = Time(60000 + np.arange(len(parallactic)) / 144, format="mjd")
    return night_table(times, altitude * u.deg, parallactic * u.deg, 30 * u.deg)


def test_a_jump_is_undone():
    """From -170 over 180 to 170 deg the star goes on turning, by 20 deg each row."""
    table = _table(np.array([130.0, 150.0, 170.0, -170.0, -150.0]))
    np.testing.assert_allclose(table["parallactic"].to_value(u.deg), [130, 150, 170, 190, 210])


def test_the_turn_begins_within_the_half_circle():
    """Wherever the unwrapped angle starts, its least value is from -180 to below 180 deg."""
    for start in (-500.0, -181.0, -180.0, 179.0, 180.0, 700.0):
        angles = start + np.linspace(0, 40, 5)
        table = _table(np.mod(angles + 180, 360) - 180)
        least = table["parallactic"].min().to_value(u.deg)
        assert -180 - 1e-9 <= least < 180
        turned = np.mod(table["parallactic"].to_value(u.deg) - angles, 360)
        np.testing.assert_allclose(np.minimum(turned, 360 - turned), 0, atol=1e-9)


def test_rows_below_the_limit_do_not_set_where_the_turn_begins():
    altitude = np.array([10.0, 20.0, 40.0, 50.0])
    table = _table(np.array([-179.0, 179.0, 170.0, 160.0]), altitude)
    assert table["observable"].tolist() == [False, False, True, True]
    # unwrapped -179, -181, -190, -200: of the observable rows the least is put at 160
    np.testing.assert_allclose(table["parallactic"].to_value(u.deg), [181, 179, 170, 160])


def test_a_star_that_is_never_up_still_has_a_table():
    table = _table(np.array([10.0, 20.0]), np.array([-5.0, 5.0]))
    assert not table["observable"].any()
    np.testing.assert_allclose(table["parallactic"].to_value(u.deg), [10, 20])


def test_pointing_is_that_of_another_frame_of_astropy():
    """The altitude of Jupiter by `pointing` and by its own AltAz frame."""
    times = Time("2025-11-04T10:00") + np.arange(3) * u.h
    with offline():
        jupiter = get_body("jupiter", times[1], SUBARU)
        own = jupiter.icrs.transform_to(AltAz(obstime=times, location=SUBARU)).alt
    altitude, _ = pointing(jupiter.icrs, times, SUBARU)
    assert u.allclose(altitude, own, atol=0.05 * u.deg)
