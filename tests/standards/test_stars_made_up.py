# Licensed under a 3-clause BSD style license - see LICENSE
"""Stars and nights made up for the test, whose numbers are known beforehand."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import EarthLocation, SkyCoord
from astropy.table import QTable
from astropy.time import Time

from astropolcal import standards
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.standards import SerkowskiLaw, StandardStar, telescope_information
from astropolcal.standards.priors import _law, _normal
from astropolcal.standards.visibility import Observability, _degree, _in_band, _spread

BANDS = {"U": 0.36, "V": 0.55, "H": 1.65}


def _measured(bands="UVH", p=(0.1, 0.2, 0.3), p_err=(0.01, 0.02, np.nan), theta=None, error=None):
    """Measurements of one star, in percent and degree."""
    n = len(bands)
    theta = np.zeros(n) if theta is None else np.asarray(theta, dtype=float)
    error = np.ones(n) if error is None else np.asarray(error, dtype=float)
    return QTable(
        {
            "band": list(bands),
            "wavelength": [BANDS[b] for b in bands] * u.um,
            "p": list(p)[:n] * u.percent,
            "p_err": list(p_err)[:n] * u.percent,
            "theta": theta * u.deg,
            "theta_err": error * u.deg,
            "reference": ["Nobody 1900"] * n,
            "checked": np.ones(n, dtype=bool),
        }
    )


def _star(kind="unpolarized", table=None, **options):
    table = _measured() if table is None else table
    place = SkyCoord(30 * u.deg, 10 * u.deg)
    magnitudes = {"V": 7.0 * u.mag, "H": 5.0 * u.mag}
    return StandardStar("made up", kind, place, 1 * u.arcsec, magnitudes, table, **options)


# --- what a star is expected to be -------------------------------------------------------------


def test_shape_of_the_wavelengths_is_kept():
    found = _star().stokes(np.full((2, 3), 600) * u.nm)
    assert found.q.shape == found.u.shape == (2, 3)
    assert found.covariance.shape == (2, 3, 2, 2)
    # two arrays, or a change of one would be one of both
    found.q[:] = 1
    assert not found.u.any()


def test_a_law_ends_at_2_5_um():
    star = _star("polarized", law=SerkowskiLaw())
    with pytest.raises(WavelengthRangeError):
        star.stokes(2.6 * u.um)


def test_magnitude_in_a_band_or_in_v():
    for band, expected in [("H", (5.0, "H")), ("K", (7.0, "V")), (None, (7.0, "V"))]:
        assert _star().brightness(band) == expected, (band, expected)
    # a star without magnitudes has none
    star = StandardStar("x", "polarized", _star().coord, 1 * u.arcsec, {}, _measured())
    magnitude, band = star.brightness("H")
    assert np.isnan(magnitude)
    assert band == "V"


# --- a law of the catalogue's table ----------------------------------------------------------


def _row(**changes):
    row = {"p_max": 4 * u.percent, "lambda_max": 0.6 * u.um, "width": 1.0, "law_theta": 30 * u.deg}
    errors = {"p_max_err": 0.1 * u.percent, "lambda_max_err": 0.01 * u.um, "width_err": 0.05}
    return row | errors | changes


def test_a_law_takes_its_own_angle_or_that_of_the_measurements():
    measured = _measured(theta=[50, 50, 50])
    own, errors = _law(_row(), measured)
    assert own.theta.value == pytest.approx(30)
    assert own.rotation.value == 0
    # the published angle has no error: errors of the others alone would be too small
    assert errors == {}
    derived, errors = _law(_row(law_theta=np.nan * u.deg), measured)
    assert derived.theta.value == pytest.approx(50)
    assert derived.rotation.value == pytest.approx(0, abs=1e-9)
    assert set(errors) == set(derived.param_names)
    assert errors["K"] == 0.05


def test_a_law_needs_all_errors_and_p_max():
    _, errors = _law(_row(law_theta=np.nan * u.deg, width_err=np.nan), _measured(theta=[50] * 3))
    assert errors == {}
    assert _law(_row(p_max=np.nan * u.percent), _measured()) == (None, {})


# --- names -------------------------------------------------------------------------------


def test_names_are_of_one_star_or_not():
    for written, other in [
        ("HD 030675", "hd30675"),
        ("HDE 30675", "HD 30675"),
        ("HIP 00123", "hip123"),
        ("BD+59 389", "BD +59d389"),
        ("BD+59 389", "bd+59°389"),
        ("Cha-F7", "cha f7"),
        ("Cyg OB2 No. 12", "cyg_ob2 #12"),
    ]:
        assert _normal(written) == _normal(other), (written, other)
    # of different stars
    for one, other in [
        ("BD+59 389", "BD-59 389"),
        ("CPD-56 5793", "CPD+56 5793"),
        ("HD 1", "HD 10"),
    ]:
        assert _normal(one) != _normal(other), (one, other)


# --- the degree that a search shows ---------------------------------------------------------


def test_degree_in_the_band_measured_or_nearest_to_v():
    assert _degree(_star(), "U") == pytest.approx((0.1, 0.01))
    found = _degree(_star(), "H")
    assert found[0] == pytest.approx(0.3)
    assert np.isnan(found[1])
    # without a band, nearest to V
    assert _degree(_star(table=_measured("UH", p=(0.1, 0.3))), None)[0] == pytest.approx(0.1)
    # without measurements the law speaks in V
    law = SerkowskiLaw(p_max=0.04, lambda_max=0.55 * u.um)
    star = _star("polarized", _measured("UVH")[:0], law=law)
    assert _degree(star, None)[0] == pytest.approx(4)


def test_degree_of_a_law_has_the_error_along_the_polarization():
    """An error of the angle leaves the degree certain; one of p_max is its share of it."""
    law = SerkowskiLaw(p_max=0.04, lambda_max=0.5 * u.um, K=1.0, theta=70 * u.deg)
    shape = np.exp(-(np.log(0.5 / 1.25) ** 2))
    errors = {"p_max": 0.2 * u.percent, "lambda_max": 0 * u.um, "K": 0.0}
    errors |= {"theta": 5 * u.deg, "rotation": 0 * u.deg / u.um}
    star = _star("polarized", _measured("U"), law=law, law_errors=errors)
    assert _degree(star, "J") == pytest.approx((4 * shape, 0.2 * shape), rel=1e-9)
    star = _star("polarized", _measured("U"), law=law, law_errors=errors | {"p_max": 0 * u.percent})
    assert _degree(star, "J") == pytest.approx((4 * shape, 0), abs=1e-9)
    # beyond 1.5 um the law itself errs, the more the farther
    for wavelength, share in (
        (1.5, 0.0),
        (1.65, 0.25 * np.log(1.1)),
        (2.2, 0.25 * np.log(2.2 / 1.5)),
    ):
        q, stokes_u, covariance = star.stokes(wavelength * u.um)
        known = np.array([q, stokes_u])
        np.testing.assert_allclose(
            known @ covariance @ known, share**2 * (known @ known) ** 2, atol=1e-20
        )


def test_a_star_is_known_in_a_band():
    for kind, law, band, known in [
        ("unpolarized", None, "K", True),
        ("polarized", None, "K", False),
        ("polarized", None, "V", True),
        ("polarized", SerkowskiLaw(), "K", True),
        ("polarized", None, None, True),
    ]:
        assert _in_band(_star(kind, law=law), band) == known, (kind, law, band, known)


# --- a night of which every row is known -----------------------------------------------------


def _night(altitude, parallactic, limit=30, step=0.1):
    altitude, parallactic = np.asarray(altitude, float), np.asarray(parallactic, float)
    table = QTable(
        {
            "time": Time(61000 + step / 24 * np.arange(altitude.size), format="mjd"),
            "altitude": altitude * u.deg,
            "parallactic": parallactic * u.deg,
            "observable": altitude >= limit,
        }
    )
    site = EarthLocation.from_geodetic(0, 0, 0)
    return Observability("made up", site, "2025-11-03", limit * u.deg, table)


def test_ranges_count_observable_rows_only():
    seen = _night([20, 40, 50, 25], [90, 10, -10, -90])
    np.testing.assert_allclose(seen.altitude.value, [40, 50])
    np.testing.assert_allclose(seen.parallactic.value, [-10, 10])
    np.testing.assert_allclose(seen.difference.value, [30, 60])
    assert seen.hours.to_value(u.h) == pytest.approx(0.2)


def test_transit_is_the_vertex_of_a_parabola():
    """Altitude 60 - (i - 2.3)^2: the vertex lies between the rows, at 2.3 steps."""
    rows = np.arange(6)
    seen = _night(60 - (rows - 2.3) ** 2, rows)
    hours = (seen.transit - seen.table["time"][0]).to_value(u.h)
    assert hours == pytest.approx(0.23, abs=1e-6)


def test_transit_by_day_is_the_end_of_the_night():
    for altitude, row in [([50, 40, 35], 0), ([35, 40, 50], 2)]:
        seen = _night(altitude, [0, 1, 2])
        assert seen.transit.mjd == seen.table["time"][row].mjd, (altitude, row)
    # a night of one row has no length
    seen = _night([50], [20])
    assert seen.hours == 0 * u.h
    assert seen.transit.mjd == 61000


def test_information_is_that_of_the_observable_rows():
    altitude, parallactic = [20, 40, 50, 60, 25], [80, 30, 0, -30, -80]
    seen = _night(altitude, parallactic)
    direct = telescope_information([30, 0, -30] * u.deg, [40, 50, 60] * u.deg, frame_error=0.002)
    found = seen.information(frame_error=0.002)
    np.testing.assert_allclose(found.covariance, direct.covariance, rtol=1e-12)
    # with the closed form: n = 3, R = |sum of e^(2 i psi)| / 3 = (1 + 2 cos 60 deg) / 3
    assert found.diattenuation == pytest.approx(0.002 / np.sqrt(3 * (1 - (2 / 3) ** 2)))


def test_frames_are_spread_from_the_first_to_the_last_row():
    assert _spread(9, 3).tolist() == [0, 4, 8]
    assert _spread(9, 1).tolist() == [0]
    # more frames than rows repeat them
    assert _spread(2, 4).tolist() == [0, 0, 1, 1]


def test_many_frames_of_a_short_table_count_as_many():
    """3000 frames of three rows, those at the ends half as often: R = (1 + cos 60 deg) / 2."""
    seen = _night([50, 50, 50], [-30, 0, 30])
    expected = 1 / np.sqrt(3000 * (1 - 0.75**2))
    assert seen.information(3000).diattenuation == pytest.approx(expected, rel=1e-3)


def test_frames_are_a_whole_number():
    for frames in [0, -3, 2.5]:
        with pytest.raises(
            ParameterError, match=f"frames = {frames} must be a positive whole number"
        ):
            _night([50, 50], [0, 1]).information(frames)


# --- a search ---------------------------------------------------------------------------------


def test_radius_ends_with_the_star_on_it():
    star = standards.get("HD 30675").coord
    others = standards.search(center=star, radius=20 * u.deg)
    edge = others["separation"][-1]
    assert len(standards.search(center=star, radius=edge + 1e-6 * u.deg)) == len(others)
    assert len(standards.search(center=star, radius=edge - 1e-6 * u.deg)) == len(others) - 1
    # the whole sky is a radius of 180 deg
    assert len(standards.search(center=star, radius=180 * u.deg)) == len(standards.names())
    with pytest.raises(ParameterError, match="radius = 181 deg must be from 0 to 180 deg"):
        standards.search(center=star, radius=181 * u.deg)


def test_a_search_that_cannot_be_is_refused():
    star = standards.get("HD 30675").coord
    with pytest.raises(ParameterError, match="one position"):
        standards.search(center=SkyCoord([star, star]), radius=1 * u.deg)
    for magnitude in [("a", "b"), (1, 2, 3), (np.nan, 9)]:
        with pytest.raises(ParameterError, match=r"must be (two numbers|the brightest)"):
            standards.search(magnitude=magnitude)


def test_conditions_are_joined_by_and():
    polarized, bright = standards.search(kind="polarized"), standards.search(magnitude=(0, 7))
    both = standards.search(kind="polarized", magnitude=(0, 7))
    assert set(both["name"]) == set(polarized["name"]) & set(bright["name"])
    assert 0 < len(both) < min(len(polarized), len(bright))
