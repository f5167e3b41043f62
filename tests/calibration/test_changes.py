# Licensed under a 3-clause BSD style license - see LICENSE
"""Chi-square of a change between calibrations against closed forms and scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from astropolcal.measurement.parameters import is_of
from astropolcal.pipeline import Change
from astropolcal.pipeline.history import _determined, _log_p, about_the_mean


def _change(chi2, dof, **options):
    p = float(stats.chi2.sf(chi2, dof)) if dof else 1.0
    return Change(
        ["a", "b"], ["m3.diattenuation[0]", "m3.diattenuation[1]"], chi2, dof, p, **options
    )


def _chi_square(values, covariances):
    _, deviations, weights = about_the_mean(values, covariances)
    chi2 = np.einsum("ni,nij,nj->", deviations, weights, deviations)
    return chi2, deviations.shape[1]


# --- probabilities ------------------------------------------------------------------------------


def test_logarithm_of_the_probability_is_that_of_scipy():
    for dof in [1, 2, 7, 60]:
        for chi2 in [0.1, 3.0, 50.0, 400.0, 1200.0]:
            assert _log_p(chi2, dof) == pytest.approx(
                stats.chi2.logsf(chi2, dof), rel=1e-9, abs=1e-12
            ), (dof, chi2)


def test_far_in_the_tail_the_series_goes_on_where_the_number_ends():
    """Against an exact tail: for even freedom exp(-x) times a finite sum."""
    for dof in [1, 2, 5, 40]:
        chi2 = 4000.0
        assert stats.chi2.sf(chi2, dof) == 0
        if dof % 2 == 0:
            x, k = chi2 / 2, np.arange(dof // 2)
            from scipy.special import gammaln, logsumexp

            exact = -x + logsumexp(k * np.log(x) - gammaln(k + 1))
        else:
            # between the neighbours, as the tail grows with the freedom
            low, high = _log_p(chi2, dof - 1) if dof > 1 else -np.inf, _log_p(chi2, dof + 1)
            assert low < _log_p(chi2, dof) < high
            continue
        assert _log_p(chi2, dof) == pytest.approx(exact, rel=1e-5)


@settings(max_examples=40)
@given(st.floats(0.5, 37))
def test_sigma_of_one_degree_of_freedom_is_the_root_of_chi_square(sigma):
    """A normal deviate of n sigma has chi-square n^2, also where p underflows."""
    assert _change(sigma**2, 1).sigma == pytest.approx(sigma, rel=1e-6)


def test_sigma_of_huge_changes_is_finite():
    # 0.5 % of the exact 100 sigma: the series has two terms
    assert _change(100.0**2, 1).sigma == pytest.approx(100, rel=5e-3)
    assert np.isfinite(_change(1e6, 3).sigma)


def test_nothing_compared_is_no_sigma():
    assert _change(0.0, 0).sigma == 0
    assert "nothing that is determined in all of them to compare, from a to b" in str(_change(0, 0))


def test_a_change_in_words():
    for chi2, words in [(2.0, "no change seen from a to b"), (30.0, "changed from a to b")]:
        text = str(_change(chi2, 2))
        assert text.startswith("m3.diattenuation: " + words), (chi2, words)
        assert f"(chi-square {chi2:.1f} of 2, p " in text, (chi2, words)


# --- chi-square of one common value ------------------------------------------------------


def test_two_numbers_differ_by_their_combined_error():
    """(x - y)^2 / (s^2 + t^2)."""
    chi2, rank = _chi_square(
        [np.array([1.0]), np.array([4.0])], [np.eye(1) * 0.25, np.eye(1) * 2.0]
    )
    assert chi2 == pytest.approx(9 / 2.25)
    assert rank == 1


def test_several_scatter_about_their_weighted_mean():
    for n in [2, 3, 5]:
        rng = np.random.default_rng(n)
        values, sigma = rng.normal(size=n), rng.uniform(0.5, 2, n)
        chi2, _ = _chi_square([np.array([v]) for v in values], [np.eye(1) * s**2 for s in sigma])
        mean = np.average(values, weights=sigma**-2.0)
        assert chi2 == pytest.approx(np.sum(((values - mean) / sigma) ** 2)), n


def test_correlated_errors_count_in_full():
    """For two calibrations (x - y)^T (C + D)^-1 (x - y), whatever the axes."""
    rng = np.random.default_rng(1)
    c, d = (m @ m.T for m in rng.normal(size=(2, 4, 4)))
    x, y = rng.normal(size=(2, 4))
    expected = (x - y) @ np.linalg.solve(c + d, x - y)
    assert _chi_square([x, y], [c, d])[0] == pytest.approx(expected, rel=1e-8)
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    turned = _chi_square([turn @ x, turn @ y], [turn @ m @ turn.T for m in (c, d)])[0]
    assert turned == pytest.approx(expected, rel=1e-8)


def test_equal_values_do_not_differ():
    x = np.array([1.0, 2.0])
    assert _chi_square([x, x, x], [np.eye(2)] * 3)[0] == pytest.approx(0, abs=1e-12)


def test_chi_square_has_its_mean_where_nothing_changed():
    """Over many draws, the rank times one less than the number of calibrations."""
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(3, 2, 2))
    found = []
    for _ in range(400):
        values = [root @ rng.normal(size=2) for root in roots]
        found.append(_chi_square(values, [root @ root.T for root in roots])[0])
    # 4 degrees of freedom; the mean of 400 is known to sqrt(2 * 4 / 400)
    assert np.mean(found) == pytest.approx(4, abs=4 * np.sqrt(8 / 400))


def test_a_direction_without_any_error_is_left_out():
    """As of parameters that no data vary: the others are compared all the same."""
    flat = np.diag([1.0, 0.0])
    chi2, rank = _chi_square([np.array([0.0, 5.0]), np.array([2.0, 7.0])], [flat, flat])
    assert rank == 1
    assert chi2 == pytest.approx(2)
    assert _chi_square([np.zeros(0)] * 2, [np.zeros((0, 0))] * 2) == (0.0, 0)


# --- directions that all determine ----------------------------------------------------------


def test_what_one_of_them_leaves_open_is_not_compared():
    first, second = np.array([[1.0, 1.0, 0.0]]) / np.sqrt(2), np.zeros((0, 3))
    basis = _determined(np.concatenate([first, second]), 3)
    assert basis.shape == (2, 3)
    np.testing.assert_allclose(basis @ first.T, 0, atol=1e-12)
    np.testing.assert_allclose(basis @ basis.T, np.eye(2), atol=1e-12)


def test_the_same_open_direction_twice_is_one():
    row = np.array([[0.6, 0.8]])
    assert _determined(np.concatenate([row, -row]), 2).shape == (1, 2)
    assert _determined(np.concatenate([np.eye(2), row]), 2).shape == (0, 2)
    np.testing.assert_array_equal(_determined(np.zeros((0, 2)), 2), np.eye(2))


def test_a_trace_of_an_open_direction_does_not_count():
    """An open direction of other parameters shows here by its rounding errors."""
    assert _determined(np.array([[1e-7, 0.0]]), 2).shape == (2, 2)


def test_an_element_belongs_to_a_parameter_or_an_optic():
    for element, parameters, inside in [
        ("m3.n[2]", ["m3.n"], True),
        ("m3.n[2]", ["m3"], True),
        ("m3.n", ["m3.k"], False),
        ("m30.n", ["m3"], False),
    ]:
        assert is_of(element, parameters) == inside, (element, inside)
