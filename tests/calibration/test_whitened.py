# Licensed under a 3-clause BSD style license - see LICENSE
"""The linear problem around a solution against dense algebra written out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.calibration.identifiability.linearized import Whitened, decompose

SCALE = np.array([0.01, 1.0, 20.0, 3.0])


def _rows(n_data=30, n_free=4, seed=1):
    """Derivatives of the data, shape (n_free, n_data), as a measurement gives them."""
    return np.random.default_rng(seed).normal(size=(n_free, n_data)) / SCALE[:n_free, None]


def _dense(data, priors=None, held=()):
    """The covariance by inversion of the normal matrix, over the columns that are not held."""
    rows = data.T if priors is None else np.vstack([data.T, priors.T])
    live = [i for i in range(rows.shape[1]) if i not in held]
    out = np.full((rows.shape[1],) * 2, np.nan)
    out[np.ix_(live, live)] = np.linalg.inv(rows[:, live].T @ rows[:, live])
    return out


# --- decomposition ----------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 12), st.integers(1, 6), st.integers(0, 100))
def test_directions_are_orthonormal_and_complete(n_rows, n_columns, seed):
    rows = np.random.default_rng(seed).normal(size=(n_rows, n_columns))
    found = decompose(rows)
    np.testing.assert_allclose(found.right @ found.right.T, np.eye(n_columns), atol=1e-12)
    assert found.rank == min(n_rows, n_columns)
    assert found.singular.shape == (n_columns,)
    np.testing.assert_allclose(rows @ found.null.T, 0, atol=1e-10)
    # singular values and determined directions give the rows' own quadratic form
    back = found.right.T * found.singular**2 @ found.right
    np.testing.assert_allclose(back, rows.T @ rows, atol=1e-10)


def test_directions_are_the_same_where_the_quick_decomposition_fails(monkeypatch):
    def fails(*args, **kwargs):
        raise np.linalg.LinAlgError("SVD did not converge")

    for n_data in (30, 2):
        rows = _rows(n_data).T
        quick = decompose(rows)
        with monkeypatch.context() as patch:
            patch.setattr(np.linalg, "svd", fails)
            slow = decompose(rows)
        assert slow.rank == quick.rank
        np.testing.assert_allclose(slow.singular, quick.singular, rtol=1e-10)
        np.testing.assert_allclose(slow.half.T @ slow.half, quick.half.T @ quick.half, rtol=1e-8)


def test_a_copy_of_a_column_is_one_direction_less():
    rows = _rows().T
    rows[:, 1] = 2 * rows[:, 0]
    found = decompose(rows)
    assert found.rank == 3
    direction = found.null[0] / found.null[0, 1]
    np.testing.assert_allclose(direction, [-2, 1, 0, 0], atol=1e-9)
    assert found.determined.tolist() == [False, False, True, True]


def test_what_is_a_billion_times_weaker_is_open():
    for share, rank in [(1e-8, 2), (1e-10, 1)]:
        assert decompose(np.diag([1.0, share])).rank == rank, (share, rank)


def test_data_that_nothing_moves_determine_nothing():
    """A rounding error is no slope, even where it is the largest there is."""
    for size in [0.0, 1e-13]:
        found = decompose(np.full((3, 2), size))
        assert found.rank == 0, size
        assert not found.determined.any(), size
        assert found.half.shape == (0, 2), size


def test_without_rows_all_is_open():
    assert decompose(np.zeros((0, 3))).rank == 0
    assert decompose(np.zeros((0, 3))).null.shape == (3, 3)


# --- covariance ---------------------------------------------------------------------------


def test_covariance_is_the_inverse_of_the_normal_matrix():
    data = _rows()
    np.testing.assert_allclose(Whitened(data, SCALE).covariance(), _dense(data), rtol=1e-9)


def test_units_of_the_steps_do_not_matter():
    data = _rows()
    plain, scaled = (Whitened(data, s).covariance() for s in (np.ones(4), SCALE))
    np.testing.assert_allclose(plain, scaled, rtol=1e-9)


def test_what_is_held_counts_as_known():
    data, held = _rows(), np.array([False, True, False, False])
    found = Whitened(data, SCALE, held=held)
    np.testing.assert_allclose(found.covariance(), _dense(data, held=[1]), rtol=1e-9)
    # fewer unknown, smaller errors
    free = np.diag(Whitened(data, SCALE).covariance())[~held]
    assert (np.diag(found.covariance())[~held] < free).all()
    assert not found.factor()[:, 1].any()


def test_priors_are_rows_like_any_other():
    data, priors = _rows(), np.array([[0, 0, 40.0, 0], [0, 3.0, 0, 0]]).T
    found = Whitened(data, SCALE, priors)
    np.testing.assert_allclose(found.covariance(), _dense(data, priors), rtol=1e-9)


def test_a_prior_closes_what_the_data_leave_open():
    data = _rows()
    data[1] = 2 * data[0]
    prior = np.array([[5.0, 0, 0, 0]]).T
    alone, together = Whitened(data, SCALE), Whitened(data, SCALE, prior)
    assert np.isnan(alone.covariance()[:2]).all()
    np.testing.assert_allclose(together.covariance(), _dense(data, prior), rtol=1e-8, atol=1e-12)
    # what the data alone determine is not changed by it
    assert together.data.rank == alone.data.rank == 3
    assert together.together.rank == 4


def test_factor_squared_is_the_covariance():
    data = _rows()
    found = Whitened(data, SCALE)
    half = found.factor() * SCALE
    np.testing.assert_allclose(half.T @ half, _dense(data), rtol=1e-9)


def test_no_number_for_what_is_open_but_for_the_rest():
    data = _rows()
    data[3] = data[2]
    covariance = Whitened(data, SCALE).covariance()
    assert np.isnan(covariance[2:]).all()
    assert np.isnan(covariance[:, 2:]).all()
    # the others are as if the pair were one parameter
    np.testing.assert_allclose(covariance[:2, :2], _dense(data[:3])[:2, :2], rtol=1e-8)


def test_fewer_data_than_parameters():
    data = _rows(n_data=2)
    found = Whitened(data, SCALE)
    assert found.data.rank == 2
    assert found.null().shape == (2, 4)
    assert np.isnan(found.covariance()).all()


# --- leverage and degrees of freedom -----------------------------------------------------------


def _hat(data, priors=None, held=()):
    live = [i for i in range(len(data)) if i not in held]
    rows = data.T[:, live]
    normal = rows.T @ rows
    if priors is not None:
        normal = normal + priors[live] @ priors[live].T
    return rows @ np.linalg.inv(normal) @ rows.T


def test_leverage_is_the_diagonal_of_the_hat_matrix():
    for held in [(), (2,), (0, 3)]:
        for with_prior in [False, True]:
            data = _rows()
            priors = np.array([[30.0, 0, 0, 0], [0, 0, 0, 2.0]]).T if with_prior else None
            mask = np.isin(np.arange(4), held)
            found = Whitened(data, SCALE, priors, mask)
            hat = _hat(data, priors, held)
            np.testing.assert_allclose(found.leverage, np.diag(hat), rtol=1e-9)
            assert found.n_taken == pytest.approx(np.trace(hat), rel=1e-9), with_prior


def test_leverages_are_between_0_and_1_and_sum_to_the_rank():
    found = Whitened(_rows(n_data=6), SCALE)
    assert ((found.leverage > 0) & (found.leverage < 1)).all()
    assert found.leverage.sum() == pytest.approx(4)
    assert found.n_taken == 4


def test_a_narrow_prior_takes_the_freedom_of_its_parameter():
    """From all of its degree of freedom to none, as the prior gets narrower."""
    data, taken = _rows(), []
    for strength in (1e-6, 1e2, 1e8):
        taken.append(Whitened(data, SCALE, np.array([[strength, 0, 0, 0]]).T).n_taken)
    assert taken[0] == pytest.approx(4, abs=1e-6)
    assert 3 < taken[1] < 4
    assert taken[2] == pytest.approx(3, abs=1e-6)
