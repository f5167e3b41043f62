# Licensed under a 3-clause BSD style license - see LICENSE
"""Parts of the fit of Gaussians: derivatives, steps, and what its numbers mean."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.reduction.stars import _model, _step, fit_gaussians

SIZE = 25
GRID = tuple(axis.ravel().astype(float) for axis in np.indices((SIZE, SIZE))[::-1])
P = np.array([[100.0, 11.3, 12.8, 0.2, 0.05, 0.1, 7.0], [30.0, 13.0, 10.0, 0.05, 0.0, 0.3, -2.0]])


def fit(images, good=None):
    """Fit images from the middle."""
    good = np.isfinite(images) if good is None else good
    return fit_gaussians(images, good, x=12, y=12, fwhm=4)


def ellipse(sigma_long, sigma_short, angle, x=12.2, y=11.7, amplitude=50.0, background=3.0):
    """Return a turned Gaussian, by its axes."""
    dx, dy = GRID[0] - x, GRID[1] - y
    along = dx * np.cos(angle) + dy * np.sin(angle)
    across = dy * np.cos(angle) - dx * np.sin(angle)
    exponent = (along / sigma_long) ** 2 / 2 + (across / sigma_short) ** 2 / 2
    return (amplitude * np.exp(-exponent) + background).reshape(SIZE, SIZE)


def test_derivatives_agree_with_central_differences():
    model, jacobian = _model(P, GRID)
    for i in range(7):
        step = np.zeros(7)
        step[i] = 1e-5
        high, low = (_model(P + sign * step, GRID)[0] for sign in (1, -1))
        np.testing.assert_allclose(jacobian[:, i], (high - low) / 2e-5, atol=2e-6 * 100)
    assert model.shape == (2, SIZE**2)


@settings(max_examples=15)
@given(st.floats(2.2, 3.5), st.floats(1.2, 2.0), st.floats(-1.5, 1.5))
def test_axes_of_a_turned_ellipse(long, short, angle):
    found = fit(ellipse(long, short, angle)[None])
    factor = np.sqrt(8 * np.log(2))
    assert found.fwhm[0] == pytest.approx(factor * np.sqrt(long * short), rel=1e-3)
    assert found.elongation[0] == pytest.approx(long / short, rel=1e-3)
    assert (found.x[0], found.y[0]) == pytest.approx((12.2, 11.7), abs=1e-3)
    assert (found.amplitude[0], found.background[0]) == pytest.approx((50.0, 3.0), rel=1e-3)
    assert found.converged[0]


def test_image_of_a_fit_is_what_was_fitted():
    data = ellipse(3.0, 1.5, 0.7)
    found = fit(np.stack([ellipse(2, 2, 0), data]))
    again = found.image(1, *GRID).reshape(SIZE, SIZE)
    np.testing.assert_allclose(again, data, atol=1e-2)


def test_step_solves_the_normal_equations_of_each_image():
    """Without damping it is that of Gauss and Newton, as numpy's least squares has it."""
    rng = np.random.default_rng(4)
    jacobian = rng.normal(size=(2, 7, 40)) * np.geomspace(1, 1e6, 7)[:, None]
    residual, weight = rng.normal(size=(2, 40)), rng.uniform(0.5, 2, (2, 40))
    found = _step(residual, jacobian, weight, np.zeros(2))
    for k in range(2):
        root = np.sqrt(weight[k])
        known = np.linalg.lstsq((jacobian[k] * root).T, residual[k] * root)[0]
        np.testing.assert_allclose(found[k], known, rtol=1e-6)


def test_damping_shortens_the_step():
    rng = np.random.default_rng(5)
    jacobian, residual = rng.normal(size=(1, 7, 40)), rng.normal(size=(1, 40))
    lengths = [
        np.linalg.norm(_step(residual, jacobian, np.ones((1, 40)), np.array([damping])))
        for damping in (0.0, 1.0, 100.0)
    ]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[2] < lengths[0] / 50


def test_centres_scatter_about_the_place():
    rng = np.random.default_rng(6)
    images = ellipse(2, 2, 0, amplitude=500.0) + rng.normal(0, 4.0, (30, SIZE, SIZE))
    found = fit(images)
    assert 0 < found.x.std() < 0.1
    assert abs(found.x.mean() - 12.2) < 4 * found.x.std() / np.sqrt(30)


def test_an_image_does_not_depend_on_its_neighbours():
    images = np.stack([ellipse(2, 2, 0), ellipse(3, 1.5, 1.0), np.zeros((SIZE, SIZE))])
    together = fit(images)
    for k, image in enumerate(images):
        alone = fit(image[None])
        np.testing.assert_allclose(alone.x, together.x[k : k + 1], rtol=1e-9)
        np.testing.assert_allclose(alone.shape, together.shape[k : k + 1], rtol=1e-6)


def test_masked_pixels_do_not_count_whatever_they_hold():
    clean, good = ellipse(2, 2, 0), np.ones((SIZE, SIZE), dtype=bool)
    good[10:13, 12], good[3, 3] = False, False
    spoilt = np.where(good, clean, np.nan)
    spoilt[3, 3] = 1e9
    found = fit(spoilt[None], good[None])
    assert (found.x[0], found.y[0]) == pytest.approx((12.2, 11.7), abs=1e-3)
