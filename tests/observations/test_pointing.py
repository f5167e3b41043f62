# Licensed under a 3-clause BSD style license - see LICENSE
"""Altitude and parallactic angle, the tracking law, and the motion within an exposure."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations, example_table, pointing
from astropolcal.observations.pointings import motion, sky_angles, sky_positions, smeared, tracked

SUBARU = EarthLocation(lon=-155.4761 * u.deg, lat=19.8255 * u.deg, height=4139 * u.m)
STAR = SkyCoord(80 * u.deg, -1 * u.deg)
TIMES = Time("2025-11-03T08:00") + np.linspace(0, 8, 9) * u.h


def table_on_sky(altitude=60 * u.deg, parallactic=30 * u.deg, **columns):
    table = example_table()
    frame = np.asarray(table["frame"])
    if altitude is not None:
        table["altitude"] = altitude
        table["parallactic"] = parallactic[frame] if np.ndim(parallactic) else parallactic
    for name, values in columns.items():
        table[name] = values[frame] if np.ndim(values) or isinstance(values, Time) else values
    return table


def on_sky(**columns):
    return Observations.from_table(table_on_sky(**columns), name="night")


# --- pointing -----------------------------------------------------------------------------------


def test_altitude_is_that_of_astropy():
    altitude, _ = pointing(STAR, TIMES, SUBARU)
    expected = STAR.transform_to(AltAz(obstime=TIMES, location=SUBARU)).alt
    # the frames differ by diurnal aberration only
    np.testing.assert_allclose(altitude.to_value(u.deg), expected.to_value(u.deg), atol=1e-3)


def test_parallactic_angle_is_the_direction_of_the_zenith():
    _, parallactic = pointing(STAR, TIMES, SUBARU)
    frame = AltAz(obstime=TIMES, location=SUBARU)
    zenith = SkyCoord(alt=np.full(9, 90) * u.deg, az=np.zeros(9) * u.deg, frame=frame)
    here = STAR.transform_to(frame).transform_to("icrs")
    expected = here.position_angle(zenith.transform_to("icrs")).wrap_at(180 * u.deg)
    apart = (parallactic - expected).to_value(u.deg)
    # the pole of date is not that of the ICRS: 26 years of precession
    np.testing.assert_allclose(np.mod(apart + 180, 360) - 180, 0, atol=0.2)


def test_an_unknown_rotation_of_the_earth_does_what_the_warning_says(no_network):
    """The largest difference of UT1 and UTC changes the angles by no more than is stated."""
    times = Time(61900.0 + np.linspace(0, 1, 97), format="mjd")
    with pytest.warns(AstropolcalWarning, match=r"0\.004 deg over the sine of the zenith"):
        altitude, parallactic = pointing(STAR, times, SUBARU)
    # only once
    later = pointing(STAR, Time(times.mjd + 0.9 / 86400, format="mjd"), SUBARU)
    turned = (later[1] - parallactic + 180 * u.deg) % (360 * u.deg) - 180 * u.deg
    assert np.abs(later[0] - altitude).max() < 0.004 * u.deg
    assert np.abs(turned * np.cos(altitude)).max() < 0.004 * u.deg


def test_headers_of_real_stars_obey_the_spherical_triangle(shared_data):
    """Altitude and parallactic angle of each frame give the declination of the star."""
    for name, declination in [("hd293396", -1.0), ("hd35532", 16.7), ("hd30675", 28.3)]:
        (path,) = (shared_data / "data" / "charis").glob(f"{name}*.ecsv")
        altitude, parallactic = sky_angles(Observations.read(path))
        # sin(lat) = sin(dec) sin(alt) + cos(dec) cos(alt) cos(p), solved for the declination
        along, up = np.cos(altitude) * np.cos(parallactic), np.sin(altitude)
        middle = np.arctan2(up, along)
        half = np.arccos(np.sin(np.deg2rad(19.8255)) / np.hypot(along, up))
        found = np.rad2deg([middle - half, middle + half])
        branch = np.abs(found.mean(axis=1) - declination).argmin()
        np.testing.assert_allclose(found[branch], declination, atol=0.6)
        assert np.ptp(found[branch]) < 0.1, (name, declination)


# --- angles of a table ----------------------------------------------------------------------------


def test_angles_of_the_columns_come_first():
    altitude, parallactic = sky_angles(on_sky())
    np.testing.assert_allclose(np.rad2deg(altitude), 60)
    np.testing.assert_allclose(np.rad2deg(parallactic), 30)


def test_angles_are_computed_from_time_target_and_site():
    for text in [True, False]:
        times = Time("2025-11-03T10:00") + np.arange(4) * 15 * u.s
        time = np.array(times.isot) if text else times
        expected = [angle.to_value(u.rad) for angle in pointing(STAR, times, SUBARU)]
        table = table_on_sky(altitude=None, time=time)
        table.meta |= {"right_ascension": 80.0, "declination": -1.0}
        found = sky_angles(Observations.from_table(table), SUBARU)
        np.testing.assert_allclose(found, expected, atol=1e-7)
        # one that is stated counts, such as a position angle of FORS2 that is called so
        for place, name in enumerate(("altitude", "parallactic")):
            table[name] = np.full(len(table), 33.0) * u.deg
            found = sky_angles(Observations.from_table(table), SUBARU)
            np.testing.assert_allclose(np.rad2deg(found[place]), 33)
            np.testing.assert_allclose(found[1 - place], expected[1 - place], atol=1e-7)
            table.remove_column(name)


def test_targets_as_headers_write_them_and_what_is_none():
    times = Time("2025-11-03T10:00") + np.arange(4) * 15 * u.s
    hidden = times.copy()
    hidden[2] = np.ma.masked
    dates = np.array([text[:10] for text in times.isot])

    def angles(right_ascension="05:20:00", declination=-1.0, time=times):
        table = table_on_sky(altitude=None, time=time)
        table.meta |= {"right_ascension": right_ascension, "declination": declination}
        return sky_angles(Observations.from_table(table, name="night"), SUBARU)

    for right_ascension in ("05:20:00", "80", 80 * u.deg, np.deg2rad(80) * u.rad):
        np.testing.assert_allclose(angles(right_ascension), angles(80.0), atol=1e-9)
    for wrong, word in (
        ({"right_ascension": "east"}, "right_ascension"),
        ({"right_ascension": np.nan}, "right_ascension"),
        ({"declination": 100.0}, "-90"),
        # half a night off, in silence
        ({"time": dates}, "time of day"),
        ({"time": hidden}, "time of day"),
    ):
        with pytest.raises(ObservationError, match=word):
            angles(**wrong)


def test_star_without_pointing_is_an_error_that_says_what_is_needed():
    with pytest.raises(
        ObservationError, match=r"night: a star needs its pointing.*missing: a column tim"
    ):
        sky_angles(on_sky(altitude=None))
    with pytest.raises(ObservationError, match=r"row 1.*altitude = 91.*-90 to 90 deg"):
        on_sky(altitude=91 * u.deg)
    with pytest.raises(ObservationError, match=r"frame 0: altitude = -2 deg; a star is above 0"):
        sky_angles(on_sky(altitude=-2 * u.deg))


# --- half-wave plate ------------------------------------------------------------------------------


def test_plate_follows_the_law_of_the_paper():
    found = sky_positions(on_sky())
    commanded = on_sky().position("hwp")
    np.testing.assert_allclose(np.rad2deg(found["hwp"] - commanded), 0.5 * 30 + 60)
    # true angle of the table overrules the law
    true = np.array([1.0, 2.0, 3.0, 4.0]) * u.deg
    found = sky_positions(on_sky(hwp_true=true))
    np.testing.assert_allclose(np.rad2deg(found["hwp"]), true.value)


def test_real_plate_law_of_the_derotator(shared_data):
    """The derotator keeps the pupil still: half the altitude plus a constant."""
    (path,) = (shared_data / "data" / "charis").glob("hd293396*.ecsv")
    observations = Observations.read(path)
    offset = observations.position("derotator") - 0.5 * observations.position("altitude")
    assert np.rad2deg(np.ptp(offset)) < 0.1


@given(st.floats(-180, 180), st.floats(1, 90), st.floats(-180, 180))
def test_tracking_is_linear(hwp, altitude, parallactic):
    found = tracked(hwp * u.deg, parallactic * u.deg, altitude * u.deg).to_value(u.deg)
    assert found == pytest.approx(hwp + 0.5 * parallactic + altitude)


# --- exposures --------------------------------------------------------------------------------


def test_motion_is_rate_times_exposure():
    times = np.array([0.0, 20.0, 40.0, 60.0]) * u.s
    observations = on_sky(time=times, exposure_time=5 * u.s)
    np.testing.assert_allclose(motion(observations, [0.0, 0.2, 0.4, 0.6]), 0.05)
    # motion crosses a full turn
    angle = np.mod(np.deg2rad([358, 359, 360, 361]), 2 * np.pi)
    np.testing.assert_allclose(motion(on_sky(), angle, duty=1), np.deg2rad(1))


def test_impossible_motions_are_errors():
    with pytest.raises(ObservationError, match="columns time and exposure_time"):
        motion(on_sky(), np.zeros(4))
    for duty in [-0.1, 1.1, np.nan]:
        with pytest.raises(ObservationError, match=r"duty = .*0 to 1"):
            motion(on_sky(), np.zeros(4), duty=duty)
    observations = on_sky(time=np.zeros(4) * u.s, exposure_time=5 * u.s)
    with pytest.raises(ObservationError, match="do not increase"):
        motion(observations, np.zeros(4))


@given(st.floats(-3, 3), st.floats(-1, 1), st.integers(1, 6))
def test_nodes_integrate_polynomials(start, change, nodes):
    """The mean of angle**k over an exposure, k up to twice the nodes less one."""
    _, weights = np.polynomial.legendre.leggauss(nodes)
    angle = smeared([start], [change], nodes)[:, 0]
    for k in range(2 * nodes):
        low, high = start - change / 2, start + change / 2
        if abs(change) > 1e-3:
            exact = (high ** (k + 1) - low ** (k + 1)) / ((k + 1) * change)
            assert 0.5 * weights @ angle**k == pytest.approx(exact, rel=1e-6, abs=1e-6)


def test_moment_of_the_header():
    for when, mean in [("start", 1.1), ("middle", 1.0), ("end", 0.9)]:
        assert smeared([1.0], [0.2], 3, when).mean() == pytest.approx(mean), (when, mean)
    # impossible exposures are errors
    for options, words in [({"nodes": 0}, "nodes = 0"), ({"when": "x"}, "when")]:
        with pytest.raises(ObservationError, match=words):
            smeared([1.0], [0.1], **options)


def test_moment_counts_with_a_single_node_too():
    observations = on_sky(parallactic=np.array([30, 31, 32, 33]) * u.deg, altitude=60 * u.deg)
    for when, turned in [("start", 0.5), ("middle", 0.0), ("end", -0.5)]:
        found = sky_positions(observations, when=when, duty=1)["parallactic"].reshape(-1)
        np.testing.assert_allclose(np.rad2deg(found), np.arange(30, 34) + turned, err_msg=when)
    for options in ({"nodes": 0}, {"when": "x"}):
        with pytest.raises(ObservationError, match="allowed are"):
            sky_positions(observations, duty=1, **options)


def test_nodes_of_all_stages_follow_the_sky():
    observations = on_sky(parallactic=np.array([30, 31, 32, 33]) * u.deg, altitude=60 * u.deg)
    found = sky_positions(observations, nodes=3, duty=1)
    assert {angle.shape for angle in found.values()} == {(3, 4)}
    follows = found["hwp"] - 0.5 * found["parallactic"] - found["altitude"]
    np.testing.assert_allclose(follows, np.broadcast_to(observations.position("hwp"), (3, 4)))
    np.testing.assert_allclose(
        np.rad2deg(np.ptp(found["parallactic"], axis=0)), 2 * 0.5 * 0.7745967, rtol=1e-6
    )


def test_motion_takes_moments_in_any_form():
    """Of plain numbers those that are Modified Julian Dates."""
    times = Time(60000.0 + np.arange(4) / 1440, format="mjd")
    for column in (times, times.isot, times.mjd, times.mjd * u.day, times.tai):
        observations = on_sky(time=column, exposure_time=30 * u.s)
        found = motion(observations, [0.0, 0.2, 0.4, 0.6])
        np.testing.assert_allclose(found, 0.1, rtol=1e-4, err_msg=str(column))
    observations = on_sky(time=np.arange(4.0), exposure_time=30 * u.s)
    with pytest.raises(ObservationError, match="time = 0 is not a Modified Julian Date"):
        motion(observations, np.zeros(4))


def test_derotator_moves_on_across_half_a_turn():
    """Its image is the same again after 180 deg, where encoders may begin again."""
    angle = np.array([178.0, 179.0, 0.0, 1.0])
    observations = on_sky(derotator=angle * u.deg)
    found = np.rad2deg(sky_positions(observations, nodes=3, duty=1)["derotator"])
    np.testing.assert_allclose(found, angle + 0.5 * np.sqrt(0.6) * np.array([[-1], [0], [1]]))
    np.testing.assert_allclose(np.rad2deg(observations.position("derotator_rate")), 1.0)
