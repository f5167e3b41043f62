# Licensed under a 3-clause BSD style license - see LICENSE
"""The two channels of a frame, their noise, and the lamp that is taken out."""

from types import SimpleNamespace

import gap_data as data
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.gap.channels import (
    Channels,
    _best_degree,
    _Lamp,
    orthonormal,
)
from astropolcal.measurement import Measurement

W, F = 6, 40


def channel_of(observations):
    """The channels of a dataset, without a model."""
    measurement = Measurement(data.chain(), observations, observable="normalized_single_difference")
    return Channels(measurement.datasets[0])


def channels_of(right, left, var_right=1.0, var_left=1.0, covariance=0.0):
    """The channels of fluxes (F, W) alone."""
    table = SimpleNamespace(
        flux_right=right,
        flux_left=left,
        variance_right=var_right * np.ones_like(right),
        variance_left=var_left * np.ones_like(right),
        covariance=covariance * np.ones_like(right),
        position=lambda name: np.linspace(0, 1, len(right)),
        single_beam=False,
    )
    return Channels(SimpleNamespace(observations=table, valid=np.ones(right.T.shape, dtype=bool)))


@pytest.fixture(scope="module")
def channel():
    return channel_of(data.observed())


def lamp_of(common, *, sigma=1e-3, seed=1, color=None, saturating=None):
    """The lamp that residuals with this common brightness and noise tell."""
    rng = np.random.default_rng(seed)
    residual = common + sigma * rng.normal(size=(W, F))
    residual = residual if color is None else residual + color
    weight = np.full((W, F), 1 / sigma)
    saturating = np.zeros((F, 0)) if saturating is None else saturating
    return _Lamp(residual, weight, np.linspace(0, 1, F), saturating)


# ---- observed ------------------------------------------------------------------------------


def test_observed_are_difference_and_logarithm_of_the_sum(channel):
    table = data.observed()
    right, left = table.flux_right.T, table.flux_left.T
    np.testing.assert_allclose(channel.observed[0], (right - left) / (right + left))
    np.testing.assert_allclose(np.exp(channel.observed[1]), right + left)
    assert channel.shape == (2, len(data.WAVELENGTH), 32)


def test_variances_are_those_of_samples():
    """Errors of both beams, with a covariance, carried to the channels by drawing."""
    rng = np.random.default_rng(4)
    beams = rng.multivariate_normal([500.0, 300.0], [[25.0, 6.0], [6.0, 16.0]], size=400_000)
    right, left = beams.T
    expected = [np.var((right - left) / (right + left)), np.var(np.log(right + left))]
    one = np.ones((1, 1))
    found = channels_of(500.0 * one, 300.0 * one, 25.0 * one, 16.0 * one, 6.0 * one)
    np.testing.assert_allclose(found.variance[:, 0, 0], expected, rtol=0.01)


def test_fluxes_without_a_logarithm_are_not_valid():
    right, left = np.array([[3.0], [1.0], [0.0], [np.nan]]), np.array([[1.0], [-2.0], [0.0], [1.0]])
    found = channels_of(right, left)
    assert found.valid.tolist() == [[True, False, False, False]]
    np.testing.assert_allclose(found.observed[:, 0, 0], [0.5, np.log(4)])
    np.testing.assert_array_equal(found.observed[:, 0, 1:], 0)


def test_slopes_against_central_differences():
    rng = np.random.default_rng(2)
    fluxes = rng.uniform(1, 5, (2, 3, 4))
    slopes = Channels.slopes(SimpleNamespace(fluxes=fluxes))
    for beam in range(2):
        step = np.zeros((2, 1, 1))
        step[beam] = 1e-6
        up, down = (
            Channels.predicted(SimpleNamespace(fluxes=fluxes + sign * step)) for sign in (1, -1)
        )
        numeric = (up - down) / 2e-6
        for i in range(2):
            np.testing.assert_allclose(slopes[i][beam], numeric[i], rtol=1e-6, atol=1e-9)


@given(st.floats(1e-3, 1e3))
def test_the_difference_knows_no_lamp(factor):
    fluxes = np.array([[[2.0]], [[1.0]]])
    one, two = (Channels.predicted(SimpleNamespace(fluxes=f * fluxes)) for f in (1.0, factor))
    assert one[0] == pytest.approx(two[0])
    assert two[1] - one[1] == pytest.approx(np.log(factor), abs=1e-12)


# ---- whitening -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whitened(channel):
    rng = np.random.default_rng(6)
    channel = channel_of(data.observed())
    sigma = np.sqrt(channel.variance)
    channel.set_noise(sigma, sigma * rng.normal(size=channel.shape), np.zeros((32, 0)))
    return channel


def test_whitening_is_linear(whitened):
    a, b = np.random.default_rng(1).normal(size=(2, *whitened.shape))
    np.testing.assert_allclose(
        whitened.whiten(2 * a - b), 2 * whitened.whiten(a) - whitened.whiten(b), atol=1e-8
    )


def test_whitening_of_many_is_that_of_each(whitened):
    many = np.random.default_rng(2).normal(size=(3, *whitened.shape))
    found = whitened.whiten(many)
    for one, expected in zip(many, found, strict=True):
        np.testing.assert_allclose(whitened.whiten(one), expected)


def test_the_brightness_at_each_wavelength_is_no_gap(whitened):
    own = np.zeros(whitened.shape)
    own[1] = np.linspace(-1, 1, whitened.shape[1])[:, None]
    assert np.abs(whitened.whiten(own)).max() < 1e-6 * (own / whitened.sigma).max()
    # in the differences the same is one
    assert np.abs(whitened.whiten(own[::-1])).max() > 1


def test_the_lamp_takes_a_number_a_wavelength(whitened):
    assert whitened.lamp.degree == whitened.lamp.color == 0
    assert whitened.n_nuisance == whitened.shape[1]
    identity = whitened.nuisance.T @ whitened.nuisance
    np.testing.assert_allclose(identity, np.eye(whitened.n_nuisance), atol=1e-10)


def test_what_is_masked_is_zero_after_whitening():
    channel = channel_of(data.observed())
    channel.valid[1, 4] = False
    channel.set_noise(np.sqrt(channel.variance), np.zeros(channel.shape), np.zeros((32, 0)))
    assert np.all(channel.whiten(np.ones(channel.shape))[:, 1, 4] == 0)


# ---- the lamp ------------------------------------------------------------------------------


def test_the_drift_has_the_degree_that_it_has():
    for degree in [0, 1, 2, 4]:
        drift = 0.1 * np.polynomial.legendre.Legendre.basis(degree)(np.linspace(-1, 1, F))
        assert lamp_of(drift if degree else 0.0).degree == degree


def test_a_drift_never_takes_all_frames():
    x = np.linspace(-1, 1, 5)
    values = np.random.default_rng(1).normal(size=5)
    # four columns would leave one frame: at least three are kept
    assert _best_degree(x, values, np.ones(5, dtype=bool), np.zeros((5, 0))) <= 1
    # nor nearly all of a dozen beside what the plate does: the flicker is left
    x, plate = np.linspace(-1, 1, 12), np.tile(np.deg2rad([0, 22.5, 45, 67.5]), 3)
    columns = np.stack([part(k * plate) for k in (2, 4) for part in (np.cos, np.sin)], axis=1)
    weight, found = np.full((W, 12), 1e4), []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        flicker = 0.005 * rng.normal(size=12) + 1e-4 * rng.normal(size=(W, 12))
        found.append(_Lamp(flicker, weight, x / 2 + 0.5, columns).flicker)
    assert min(found) > 0.001
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.005, rel=0.2)
    drift = 0.1 * x + 0.05 * x**2
    assert _best_degree(x, drift + flicker.mean(axis=0), np.ones(12, dtype=bool), columns) == 2


def test_flicker_is_that_of_the_lamp():
    for true in [0.0, 0.01, 0.05]:
        flicker = true * np.random.default_rng(8).normal(size=F)
        found = lamp_of(flicker).flicker
        # its error from 40 frames is a ninth
        assert found == pytest.approx(true, rel=0.35, abs=2e-4)


def test_a_lamp_that_wanders_makes_no_step():
    """A step of the brightness in a random walk stands out no more than one in white flicker."""
    sigma, frames, found = np.full((2, W, 96), 5e-4), np.arange(96), []
    steps = np.zeros((94, 2, W, 96))
    steps[:, 1] = (frames >= frames[1:-1, None])[:, None]
    for seed in range(20):
        rng = np.random.default_rng(seed)
        residual = sigma * rng.normal(size=sigma.shape)
        residual[1] += np.cumsum(rng.normal(0, 0.005, 96))
        channel = channels_of(*np.full((2, 96, W), 1e6))
        channel.set_noise(sigma, residual, np.zeros((96, 0)))
        white, seen = (channel.whiten(one).reshape(-1, sigma.size) for one in (steps, residual))
        found.append(np.max((white @ seen[0]) ** 2 / np.sum(white**2, axis=1)))
    # the best of so many steps in white noise
    assert max(found) < 2 * np.log(len(steps))


def test_what_optics_do_to_the_sums_is_no_flicker():
    wave = np.cos(np.linspace(0, 60, F))
    without = lamp_of(0.05 * wave)
    known = lamp_of(0.05 * wave, saturating=wave[:, None])
    assert without.flicker > 0.02
    assert known.flicker < 1e-3


def test_color_is_a_drift_of_each_wavelength_for_itself():
    for degree in [0, 1, 2]:
        x = np.linspace(-1, 1, F)
        tilt = np.linspace(-0.1, 0.1, W)[:, None]
        color = tilt * np.polynomial.legendre.Legendre.basis(degree)(x) if degree else 0 * tilt
        lamp = lamp_of(0.0, color=color)
        assert lamp.color == degree
        # one curve a wavelength, and of the common drift what is beyond
        assert len(lamp.design(np.ones((W, F), dtype=bool))) == W * (degree + 1) + max(
            lamp.degree - degree, 0
        )


def test_design_holds_any_lamp_of_its_degrees():
    x = np.linspace(-1, 1, F)
    lamp = lamp_of(0.3 * x**3)
    columns = orthonormal(lamp.design(np.ones((W, F), dtype=bool)).reshape(-1, W * F).T)
    some = np.arange(W)[:, None] + 0.2 * x**3 - 0.4 * x
    left = some.ravel() - columns @ (columns.T @ some.ravel())
    np.testing.assert_allclose(left, 0, atol=1e-10)


def test_shrink_is_the_root_of_the_covariance():
    """Noise and flicker common to the wavelengths of a frame become white."""
    lamp = lamp_of(0.01 * np.random.default_rng(3).normal(size=F))
    weight = np.linspace(500, 1500, W)[:, None] * np.ones(F)
    direction, shrink = lamp.shrink(weight)
    covariance = np.diag(1 / weight[:, 0] ** 2) + lamp.flicker**2
    scaled = weight[:, 0, None] * covariance * weight[:, 0]
    root = np.eye(W) - shrink[0] * np.outer(direction[:, 0], direction[:, 0])
    np.testing.assert_allclose(root @ scaled @ root.T, np.eye(W), atol=1e-9)


def test_a_frame_without_data_is_not_shrunk():
    lamp = lamp_of(0.0)
    direction, shrink = lamp.shrink(np.zeros((W, F)))
    assert np.all(direction == 0)
    assert np.all(shrink == 0)


def test_brightness_follows_what_is_certain_and_the_drift_elsewhere():
    flicker = 0.5 * np.random.default_rng(3).normal(size=F)
    lamp = lamp_of(flicker)
    certain = lamp.brightness(flicker, np.full(F, 1e9))
    np.testing.assert_allclose(certain, flicker, atol=1e-6)
    vague = lamp.brightness(flicker, np.full(F, 1e-3))
    np.testing.assert_allclose(vague, flicker.mean(), atol=1e-3)
    # a small one is not told: what depends on the flux would explain the flicker by itself
    small = lamp_of(0.1 * flicker)
    np.testing.assert_allclose(
        small.brightness(0.1 * flicker, np.full(F, 1e9)),
        small.brightness(np.zeros(F), np.full(F, 1e9)) + 0.1 * flicker.mean(),
        atol=1e-6,
    )
