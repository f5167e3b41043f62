# Licensed under a 3-clause BSD style license - see LICENSE
"""North up, east left; fluxes and noise of turned images; Q_phi and U_phi."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.correction.geometry import (
    azimuthal,
    azimuthal_variances,
    derotate,
    derotate_variance,
)
from astropolcal.exceptions import ParameterError

SIZE = 41
MIDDLE = (SIZE - 1) / 2


def blob(x, y, width=2.5, shape=(SIZE, SIZE)):
    rows, columns = np.indices(shape)
    return np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / width**2)


def on_detector(separation, angle, camera, mirrored=False):
    """Where a companion at a position angle falls, if the camera's +y axis points at ``camera``."""
    relative = np.deg2rad(angle - camera)
    parity = -1 if mirrored else 1
    return MIDDLE - parity * separation * np.sin(relative), MIDDLE + separation * np.cos(relative)


@given(
    angle=st.floats(0, 360),
    camera=st.floats(-180, 180),
    mirrored=st.booleans(),
)
def test_a_companion_comes_to_its_position_angle(angle, camera, mirrored):
    image = blob(*on_detector(10.0, angle, camera, mirrored))
    turned = derotate(image, camera * u.deg, mirrored=mirrored)
    east, north = 10 * np.sin(np.deg2rad(angle)), 10 * np.cos(np.deg2rad(angle))
    # east is left
    inside = np.isfinite(turned)
    expected = blob(MIDDLE - east, MIDDLE + north)
    np.testing.assert_allclose(turned[inside], expected[inside], atol=3e-3)
    assert expected[~inside].max(initial=0.0) < 0.01


@given(camera=st.floats(-180, 180))
def test_flux_is_conserved(camera):
    image = blob(MIDDLE + 4, MIDDLE - 3)
    assert np.nansum(derotate(image, camera * u.deg)) == pytest.approx(image.sum(), rel=1e-4)


def test_quarter_turns_are_exact():
    for turns in [-1, 0, 1, 2, 3, 7]:
        image = np.random.default_rng(1).normal(size=(4, 9, 9))
        turned = derotate(image, turns * 90 * u.deg)
        np.testing.assert_array_equal(turned, np.rot90(image, turns, axes=(2, 1))[:, ::1])


def test_a_window_about_a_point():
    image = np.random.default_rng(1).normal(size=(30, 40))
    window = derotate(image, 0 * u.deg, centre=(22, 11), size=5)
    np.testing.assert_array_equal(window, image[9:14, 20:25])
    assert derotate(image, 0 * u.deg, centre=(1, 1), size=5).shape == (5, 5)
    assert np.isnan(derotate(image, 0 * u.deg, centre=(1, 1), size=5)[0]).all()
    assert np.isfinite(derotate(image, 0 * u.deg, centre=(1, 1), size=5)[1:, 1:]).all()
    assert np.isnan(derotate(image, 10 * u.deg, centre=(99, 99), size=5)).all()


def test_a_fraction_of_a_pixel_moves_the_centre():
    window = derotate(blob(22.4, 18.7), 0 * u.deg, centre=(22.4, 18.7), size=11)
    np.testing.assert_allclose(window, blob(5, 5, shape=(11, 11)), atol=3e-3)


def test_pixels_without_value_stay_without():
    image = blob(MIDDLE, MIDDLE)
    image[30, 12] = np.nan
    whole = derotate(blob(MIDDLE, MIDDLE), 30 * u.deg)
    bad = np.argwhere(np.isnan(derotate(image, 30 * u.deg)) & np.isfinite(whole))
    assert 1 <= len(bad) <= 9
    x, y = 12 - MIDDLE, 30 - MIDDLE
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    np.testing.assert_allclose(bad.mean(axis=0) - MIDDLE, [c * y + s * x, c * x - s * y], atol=0.6)


def test_pixels_beside_one_without_value_keep_theirs():
    """A spline through a zero there would ring: by 14 % of the light next to it."""
    rows, columns = np.indices((41, 41)) - 20
    for width in (1.8, 4.0, 1e3):
        whole = np.exp(-(rows**2 + columns**2) / (2 * width**2))
        image = whole.copy()
        image[20, 22] = image[15, 17] = image[16, 17] = np.nan
        image[:2], image[:, -4:] = np.nan, np.nan
        # few images are turned by scipy, many by a spline of our own
        for count in (1, 6):
            turned = derotate(np.stack([image] * count), 17 * u.deg)
            off = np.abs(turned - derotate(np.stack([whole] * count), 17 * u.deg))
            assert np.nanmax(off) < 3e-3, (width, count)


@pytest.mark.slow
def test_variances_are_those_of_turned_noise():
    for angle in [0.0, 17.0, 45.0]:
        for order in [1, 3]:
            rng = np.random.default_rng(4)
            rows, _ = np.indices((21, 21))
            sigma = 1 + 0.05 * rows
            noise = rng.normal(size=(1500, 21, 21)) * sigma
            turned = derotate(noise, angle * u.deg, order=order)
            predicted = derotate_variance(sigma**2, angle * u.deg, order=order)
            inner = np.s_[4:-4, 4:-4]
            ratio = turned.var(axis=0)[inner] / predicted[inner]
            assert ratio.mean() == pytest.approx(1, abs=0.02), (order, angle)
            np.testing.assert_allclose(ratio, 1, atol=0.25)


def test_position_angles_run_through_east():
    """Q is positive north-south, so across to what lies east or west."""
    q_phi, u_phi = azimuthal(np.ones((5, 5)), np.zeros((5, 5)))
    assert q_phi[4, 2] == -1
    assert q_phi[2, 0] == q_phi[2, 4] == pytest.approx(1)
    # north-east at 45 deg
    assert u_phi[4, 0] == pytest.approx(1)
    assert u_phi[4, 4] == pytest.approx(-1)


def test_azimuthal_polarization_is_positive(scene):
    _, q, u_ = scene(2)
    q_phi, u_phi = azimuthal(q, u_)
    assert q_phi.min() > -1e-12
    assert q_phi.max() > 3
    np.testing.assert_allclose(u_phi, 0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(q, u_), q_phi, atol=1e-12)


@given(seed=st.integers(0, 100))
def test_turning_the_axes_and_the_image_leaves_q_phi(seed):
    """Q and U in the frame of a camera, turned to the sky with the image, against Q_phi there."""
    camera = np.random.default_rng(seed).uniform(0, 360)
    rows, columns = np.indices((SIZE, SIZE)) - MIDDLE
    # from north through east
    angle = np.arctan2(-columns, rows)
    ring = np.exp(-0.5 * ((np.hypot(rows, columns) - 10) / 2.5) ** 2)
    # tangential polarization looks the same in any camera
    q, u_ = -ring * np.cos(2 * angle), -ring * np.sin(2 * angle)
    turn = 2 * np.deg2rad(camera)
    q_sky = derotate(np.cos(turn) * q - np.sin(turn) * u_, camera * u.deg)
    u_sky = derotate(np.sin(turn) * q + np.cos(turn) * u_, camera * u.deg)
    inside = np.isfinite(q_sky)
    assert inside.mean() > 0.8
    np.testing.assert_allclose(q_sky[inside], q[inside], atol=5e-3)
    np.testing.assert_allclose(u_sky[inside], u_[inside], atol=5e-3)


def test_variances_of_q_phi():
    rng = np.random.default_rng(2)
    cov = np.array([[1.0, 0.4], [0.4, 2.0]])
    q, u_ = rng.multivariate_normal([0, 0], cov, size=(20000, 5, 5)).transpose(3, 0, 1, 2)
    plain = (np.full((5, 5), c) for c in (1.0, 2.0, 0.4))
    predicted = azimuthal_variances(*plain)
    for found, variance in zip(azimuthal(q, u_), predicted, strict=True):
        np.testing.assert_allclose(found.var(axis=0), variance, rtol=0.06)


def test_bad_choices():
    for settings, words in [
        ({"position_angle": 30}, "position_angle"),
        ({"position_angle": np.nan * u.deg}, "finite"),
        ({"centre": (1, np.inf)}, "centre"),
        ({"order": 7}, "order = 7"),
    ]:
        with pytest.raises(ParameterError, match=words):
            derotate(np.ones((5, 5)), **({"position_angle": 0 * u.deg} | settings))
