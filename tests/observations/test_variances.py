# Licensed under a 3-clause BSD style license - see LICENSE
"""Variances of the beams from errors of the beams or of their sum and difference."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.observations.grid import BEAM_ERRORS, SINGLE_ERRORS, beam_variances

positive = st.floats(1e-3, 1e6)


@given(positive, positive, positive, positive)
def test_single_errors_are_reproduced(right, left, error_difference, error_sum):
    errors = dict(zip(SINGLE_ERRORS, np.array([[error_difference], [error_sum]]), strict=True))
    var_right, var_left, cov = beam_variances(np.array([right]), np.array([left]), errors)
    scale = error_difference**2 + error_sum**2
    difference, total = var_right + var_left - 2 * cov, var_right + var_left + 2 * cov
    np.testing.assert_allclose(difference, error_difference**2, atol=1e-12 * scale)
    np.testing.assert_allclose(total, error_sum**2, atol=1e-12 * scale)
    # a covariance matrix: no variance is negative, no correlation beyond one
    assert var_right[0] >= 0
    assert var_left[0] >= 0
    assert cov[0] ** 2 <= var_right[0] * var_left[0] + 1e-12 * scale**2


def test_equal_single_errors_share_the_variance_by_flux():
    errors = dict.fromkeys(SINGLE_ERRORS, np.array([10.0]))
    found = beam_variances(np.array([300.0]), np.array([100.0]), errors)
    np.testing.assert_allclose(np.ravel(found), [75.0, 25.0, 0.0])


def test_beam_errors_are_independent():
    errors = dict(zip(BEAM_ERRORS, np.array([[3.0], [4.0]]), strict=True))
    found = beam_variances(np.array([1.0]), np.array([1.0]), errors)
    assert np.ravel(found).tolist() == [9.0, 16.0, 0.0]


def test_no_errors_give_nan():
    assert np.isnan(beam_variances(np.ones(2), np.ones(2), {})).all()


def test_equal_single_errors_of_a_real_row():
    # first row of the public CHARIS table of 2025-07-15: both errors are 4026.556536386394 adu,
    # the square root of R + L, so each beam has its own flux as variance (photon noise)
    right, left = np.array([10609191.439855931]), np.array([5603966.100860059])
    errors = dict.fromkeys(SINGLE_ERRORS, np.array([4026.556536386394]))
    found = beam_variances(right, left, errors)
    np.testing.assert_allclose(np.ravel(found), [right[0], left[0], 0.0], rtol=1e-7, atol=1e-6)


def test_sharing_stops_where_the_beams_would_be_correlated_beyond_one():
    # var(D) = 4, var(S) = 0: R and L are perfectly anticorrelated, so they share equally
    errors = dict(zip(SINGLE_ERRORS, np.array([[2.0], [0.0]]), strict=True))
    found = beam_variances(np.array([900.0]), np.array([100.0]), errors)
    np.testing.assert_allclose(np.ravel(found), [1.0, 1.0, -1.0])


def test_masked_cells_stay_nan():
    errors = dict(zip(BEAM_ERRORS, np.array([[3.0, np.nan], [4.0, np.nan]]), strict=True))
    found = np.array(beam_variances(np.array([1.0, np.nan]), np.array([1.0, np.nan]), errors))
    assert np.isnan(found).tolist() == [[False, True]] * 3
