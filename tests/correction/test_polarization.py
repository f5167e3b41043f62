# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors of fractions, of degree and of angle, by the derivatives and by sampling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.correction.result import fractions, polarization
from astropolcal.stokes import angle_error, debias_dolp

STOKES = np.array([1000.0, 30.0, -40.0, 15.0])


def covariance(seed, scale):
    """Return a covariance of four correlated numbers of about this standard deviation."""
    root = np.random.default_rng(seed).normal(size=(4, 4)) * scale / 2
    return root @ root.T


def jacobian():
    """Return the derivatives of q, u and v by I, Q, U and V."""
    i = STOKES[0]
    rows = [np.append(-STOKES[k] / i**2, np.eye(3)[k - 1] / i) for k in (1, 2, 3)]
    return np.array(rows)


@given(st.integers(0, 1000))
def test_fractions_by_their_derivatives(seed):
    """J C J^T, in which the error of I and its correlations count."""
    c = covariance(seed, 5.0)
    found = fractions(STOKES, c, "IQUV")
    expected = jacobian() @ c @ jacobian().T
    for i, name in enumerate("quv"):
        assert found[name] == pytest.approx(np.sqrt(expected[i, i]), rel=1e-10)
    assert found["covariance_qu"] == pytest.approx(expected[0, 1], rel=1e-9)


def test_fractions_without_v():
    c = covariance(1, 5.0)
    found = fractions(STOKES[:3], c[:3, :3])
    assert set(found) == {"q", "u", "covariance_qu"}
    assert found["q"] == fractions(STOKES, c, "IQUV")["q"]


def test_fractions_of_samples():
    c = covariance(7, 10.0)
    draws = np.random.default_rng(2).multivariate_normal(STOKES, c, size=40_000)
    shares = draws[:, 1:] / draws[:, :1]
    found = fractions(STOKES, c, "IQUV")
    np.testing.assert_allclose(shares.std(axis=0), [found[n] for n in "quv"], rtol=0.03)


def test_a_gain_of_all_is_in_no_fraction():
    """An error that moves I, Q and U in proportion, such as a transmission."""
    c = 0.1**2 * np.outer(STOKES, STOKES)
    found = fractions(STOKES, c, "IQUV")
    for name in "quv":
        assert found[name] == pytest.approx(0.0, abs=1e-9)


def test_no_light_has_no_fraction():
    stokes = np.array([[1.0, 0.0, -2.0, np.nan], [0.1] * 4, [0.1] * 4])
    c = np.tile(np.eye(3)[:, :, None] * 0.01, (1, 1, 4))
    found = fractions(stokes, c)
    for values in found.values():
        assert np.isfinite(values).tolist() == [True, False, False, False]


def test_what_is_open_is_infinite():
    """Of Q alone: U is as well known as before."""
    c = np.eye(3) * 0.01
    c[1, 1], c[0, 1], c[1, 0], c[1, 2], c[2, 1] = np.inf, np.nan, np.nan, np.nan, np.nan
    found = fractions(STOKES[:3], c)
    assert np.isinf(found["q"])
    assert np.isfinite(found["u"])


# ---- degree and angle ------------------------------------------------------------------


def errors(s_q, s_u, cross):
    return {
        key: np.atleast_1d(v)
        for key, v in zip(("q", "u", "covariance_qu"), (s_q, s_u, cross), strict=True)
    }


@given(
    angle=st.floats(0, 180, exclude_max=True),
    s_q=st.floats(1e-4, 3e-3),
    s_u=st.floats(1e-4, 3e-3),
    rho=st.floats(-0.95, 0.95),
)
def test_errors_along_and_across(angle, s_q, s_u, rho):
    """In axes turned along the polarization the variances are s_p^2 and (2 p s_chi)^2."""
    p, chi = 0.05, np.deg2rad(angle)
    q, u = p * np.cos(2 * chi), p * np.sin(2 * chi)
    found = polarization(np.array([q]), np.array([u]), {"kind": errors(s_q, s_u, rho * s_q * s_u)})
    turn = np.array([[q, u], [-u, q]]) / p
    c = np.array([[s_q**2, rho * s_q * s_u], [rho * s_q * s_u, s_u**2]])
    along, across = np.diag(turn @ c @ turn.T)
    assert found["dolp"][0] == pytest.approx(p)
    assert found["s_p_kind"][0] == pytest.approx(np.sqrt(along), rel=1e-6)
    turn = angle_error(p, np.sqrt(across))
    assert found["s_chi_kind"][0] == pytest.approx(turn, rel=1e-6)
    off = (found["aolp"][0] - angle + 90) % 180 - 90
    assert off == pytest.approx(0, abs=1e-6)


def test_bias_is_removed_by_the_statistical_error_only():
    q, u = np.array([0.01, 0.003]), np.array([0.0, 0.002])
    kinds = {"statistical": errors([1e-3, 2e-3], [1e-3, 2e-3], [0.0, 0.0])}
    kinds["systematic"] = errors([5e-3, 5e-3], [5e-3, 5e-3], [0.0, 0.0])
    found = polarization(q, u, kinds)
    expected = debias_dolp(np.hypot(q, u), np.array([1e-3, 2e-3]), "mas")
    np.testing.assert_allclose(found["dolp_debiased"], expected)
    assert np.all(found["dolp_debiased"] < found["dolp"])
    only = polarization(q, u, {"systematic": kinds["systematic"]})
    assert np.isnan(only["dolp_debiased"]).all()


def test_error_of_an_angle_in_noise():
    """As many angles are within the stated errors as of normal ones, or more."""
    rng = np.random.default_rng(2)
    for snr in (1.0, 2.0, 3.0, 6.0):
        q, u = rng.normal(snr, 1, 20_000), rng.normal(0, 1, 20_000)
        found = polarization(q, u, {"statistical": errors(*np.ones((2, q.size)), np.zeros(q.size))})
        off, stated = (found["aolp"] + 90) % 180 - 90, found["s_chi_statistical"]
        assert 0.67 < np.mean(np.abs(off) < stated) < 0.77, snr
        assert np.sqrt(np.mean(off**2)) == pytest.approx(np.median(stated), rel=0.07), snr
        assert stated[found["dolp"] < 1] == pytest.approx(90 / np.sqrt(3)), snr


def test_nothing_polarized_has_no_angle():
    found = polarization(np.zeros(1), np.zeros(1), {"statistical": errors(1e-3, 1e-3, 0.0)})
    assert found["dolp"][0] == 0
    for name in ("aolp", "s_p_statistical", "s_chi_statistical", "dolp_debiased"):
        assert np.isnan(found[name][0]), name


def test_an_open_direction_leaves_both_open():
    for s_q, s_u in [(np.inf, 1e-3), (1e-3, np.inf), (np.inf, np.inf)]:
        found = polarization(np.array([0.01]), np.array([0.01]), {"x": errors(s_q, s_u, np.nan)})
        assert np.isinf(found["s_p_x"][0]), (s_q, s_u)
        assert np.isinf(found["s_chi_x"][0]), (s_q, s_u)


def test_unknown_errors_stay_unknown():
    found = polarization(np.array([0.01]), np.array([0.01]), {"x": errors(np.nan, 1e-3, 0.0)})
    assert np.isnan(found["s_p_x"][0])
    assert np.isnan(found["s_chi_x"][0])


def test_rounding_beyond_perfect_correlation():
    """q and u that always move together, by an error in the last digit too much."""
    found = polarization(
        np.array([0.03]), np.array([0.03]), {"x": errors(1e-3, 1e-3, 1e-6 * (1 + 1e-12))}
    )
    assert found["s_p_x"][0] == pytest.approx(np.sqrt(2) * 1e-3)
    assert found["s_chi_x"][0] == pytest.approx(0, abs=1e-6)
