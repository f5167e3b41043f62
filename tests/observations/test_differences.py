# Licensed under a 3-clause BSD style license - see LICENSE
"""Sums and differences of the beams: what they are for a half-wave plate, and their algebra."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from astropolcal.observations import (
    double_difference,
    double_sum,
    single_difference,
    single_sum,
)

fluxes = arrays(float, (2, 2, 3), elements=st.floats(0.0, 1e6))
offsets = arrays(float, (2, 3), elements=st.floats(0.0, 1e4))


def beams(intensity, q, gain=1.0, background=0.0):
    """Return fluxes of plates at 0 and 45 deg, (2,): q changes its sign, the rest does not."""
    signed = np.array([q, -q])
    right = 0.5 * intensity * (1 + signed) * gain + background
    left = 0.5 * intensity * (1 - signed)
    return right, left


@pytest.mark.parametrize("q", [-1.0, -0.3, 0.0, 0.02, 1.0])
def test_double_difference_over_double_sum_is_the_polarization(q):
    right, left = beams(1e4, q)
    assert double_difference(right, left) / double_sum(right, left) == pytest.approx(q)
    assert double_sum(right, left) == pytest.approx(1e4)


@pytest.mark.parametrize("q", [-0.3, 0.02])
def test_double_difference_is_blind_to_what_the_plate_does_not_turn(q):
    """A background of one beam shifts single differences, but not the double one."""
    clean, spoilt = (double_difference(*beams(1e4, q, background=b)) for b in (0.0, 777.0))
    assert spoilt == pytest.approx(clean)
    shift = single_difference(*beams(1e4, q, background=777.0)) - single_difference(*beams(1e4, q))
    np.testing.assert_allclose(shift, 777.0)


@given(fluxes, fluxes)
def test_beams_follow_from_sum_and_difference(right, left):
    x, total = single_difference(right, left), single_sum(right, left)
    np.testing.assert_allclose(0.5 * (total + x), right, atol=1e-9)
    np.testing.assert_allclose(0.5 * (total - x), left, atol=1e-9)


@pytest.mark.slow
@given(fluxes, fluxes)
def test_doubles_are_means_of_singles(right, left):
    x, total = single_difference(right, left), single_sum(right, left)
    np.testing.assert_allclose(double_difference(right, left), (x[0] - x[1]) / 2, atol=1e-9)
    np.testing.assert_allclose(double_sum(right, left), total.mean(axis=0), atol=1e-9)


@pytest.mark.slow
@given(fluxes, fluxes, offsets)
def test_exchange_of_beams_or_frames_turns_the_sign(right, left, background):
    x = double_difference(right, left)
    np.testing.assert_array_equal(double_difference(left, right), -x)
    np.testing.assert_array_equal(double_difference(right[::-1], left[::-1]), -x)
    np.testing.assert_allclose(double_difference(right + background, left), x, atol=1e-8)
    assert np.all(np.abs(x) <= double_sum(right, left) + 1e-9)


def test_unknown_stays_unknown():
    right, left = np.array([np.nan, 1.0]), np.array([1.0, 1.0])
    for function in (single_difference, single_sum):
        assert np.isnan(function(right, left)).tolist() == [True, False]
    assert np.isnan(double_difference(right, left))
    assert np.isnan(double_sum(right, left))
