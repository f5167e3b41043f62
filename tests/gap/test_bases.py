# Licensed under a 3-clause BSD style license - see LICENSE
"""Bases of laws in wavelength, and of spaces of columns."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.gap.channels import orthonormal
from astropolcal.gap.problem import law_basis

GRID = np.array([1.15, 1.3, 1.37, 1.6, 1.9, 2.2, 2.39])


def test_law_holds_every_polynomial_of_its_degree():
    for degree in [0, 1, 2, 3]:
        basis = law_basis(GRID, degree)
        assert basis.shape == (len(GRID), degree + 1)
        for power in range(degree + 1):
            left = GRID**power - basis @ np.linalg.lstsq(basis, GRID**power, rcond=None)[0]
            np.testing.assert_allclose(left, 0, atol=1e-12)
        wrong = GRID ** (degree + 1)
        left = wrong - basis @ np.linalg.lstsq(basis, wrong, rcond=None)[0]
        assert np.abs(left).max() > 1e-3


def test_columns_are_legendre_polynomials_over_the_range():
    x = (GRID - 1.77) / 0.62
    expected = np.stack([np.ones(7), x, (3 * x**2 - 1) / 2], axis=1)
    np.testing.assert_allclose(law_basis(GRID, 2), expected, atol=1e-12)


def test_first_coefficient_is_the_value_in_the_middle_of_a_straight_law():
    basis = law_basis(np.array([1.0, 1.2, 3.0]), 1)
    coefficients = np.linalg.lstsq(basis, np.array([1.0, 1.2, 3.0]), rcond=None)[0]
    np.testing.assert_allclose(coefficients, [2.0, 1.0])


def test_as_many_coefficients_as_values_are_the_values():
    for n, degree in [(1, 0), (3, None), (3, 2), (2, 5)]:
        np.testing.assert_array_equal(law_basis(GRID[:n], degree), np.eye(n))


def test_order_of_the_wavelengths_does_not_matter():
    np.testing.assert_allclose(law_basis(GRID[::-1], 2), law_basis(GRID, 2)[::-1])


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 6), st.integers(0, 3), st.integers(0, 999), st.floats(1e-6, 1e6))
def test_orthonormal_basis_spans_the_columns(k, copies, seed, scale):
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(20, k))
    more = columns @ rng.normal(size=(k, copies))
    basis = orthonormal(np.concatenate([columns, scale * more], axis=1))
    assert basis.shape == (20, k)
    np.testing.assert_allclose(basis.T @ basis, np.eye(k), atol=1e-10)
    np.testing.assert_allclose(columns, basis @ (basis.T @ columns), atol=1e-8)


def test_units_of_columns_do_not_matter():
    columns = np.random.default_rng(3).normal(size=(9, 2))
    small = columns * [1.0, 1e-30]
    assert orthonormal(small).shape == (9, 2)


def test_nothing_spans_nothing():
    for columns in [np.zeros((5, 0)), np.zeros((5, 3))]:
        assert orthonormal(columns).shape == (5, 0)


def test_directions_below_the_share_are_left_out():
    # columns of unit length whose difference is small: singular values near sqrt(2) and 1e-4
    near = np.array([[1.0, 1.0], [0.0, 1e-4], [0.0, 0.0]])
    assert orthonormal(near).shape == (3, 2)
    assert orthonormal(near, keep=1e-3).shape == (3, 1)
