# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors of degree and angle of linear polarization, their bias, and the interval of the angle."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import erf

from astropolcal.exceptions import ParameterError
from astropolcal.stokes import (
    angle_error,
    aolp_interval,
    debias_dolp,
    polarization_angle,
    polarization_errors,
)


def test_arguments_broadcast():
    q = np.full((3, 1), 0.01)
    assert np.shape(polarization_errors(q, [0.0, 0.02], 1e-3, 1e-3)) == (2, 3, 2)
    assert debias_dolp(q, [1e-3, 2e-3]).shape == (3, 2)
    assert aolp_interval(q, [1e-3, 2e-3]).shape == (3, 2)


def test_first_order_errors_against_monte_carlo():
    for covariance in [0.0, 6e-7, -6e-7]:
        rng = np.random.default_rng(7)
        sigma_q, sigma_u, n = 1e-3, 1.5e-3, 40_000
        matrix = [[sigma_q**2, covariance], [covariance, sigma_u**2]]
        # five standard errors of a standard deviation from n draws, plus 0.2 %
        # for the second order at a signal-to-noise ratio of 33 and more
        rel = 5 / np.sqrt(2 * n) + 0.002
        for angle in (0.0, 20.0, 75.0, 130.0):
            q, u_ = 0.05 * np.array([np.cos(np.deg2rad(2 * angle)), np.sin(np.deg2rad(2 * angle))])
            sample = rng.multivariate_normal([q, u_], matrix, n)
            p = np.hypot(*sample.T)
            chi = np.rad2deg(np.arctan2(sample[:, 1], sample[:, 0]) - np.arctan2(u_, q)) / 2
            chi = (chi + 90) % 180 - 90
            arguments = (q, u_, sigma_q, sigma_u, covariance)
            along, across = polarization_errors(*arguments)
            found = along, np.rad2deg(across / (2 * np.hypot(q, u_)))
            assert found == pytest.approx((p.std(), chi.std()), rel=rel), angle


@given(
    st.floats(-0.5, 0.5).filter(lambda x: abs(x) > 1e-3),
    st.floats(-0.5, 0.5).filter(lambda x: abs(x) > 1e-3),
    st.floats(1e-5, 1e-2),
    st.floats(1e-5, 1e-2),
    st.floats(-0.99, 0.99),
)
def test_errors_follow_the_derivatives(q, u_, sigma_q, sigma_u, correlation):
    step = 1e-6
    covariance = correlation * sigma_q * sigma_u
    matrix = np.array([[sigma_q**2, covariance], [covariance, sigma_u**2]])

    def slope(function):
        return np.array(
            [
                function(q + step, u_) - function(q - step, u_),
                function(q, u_ + step) - function(q, u_ - step),
            ]
        ) / (2 * step)

    def angle(a, b):
        return np.rad2deg(np.unwrap([np.arctan2(u_, q), np.arctan2(b, a)])[1] / 2)

    along, across = polarization_errors(q, u_, sigma_q, sigma_u, covariance)
    turn = np.rad2deg(across / (2 * np.hypot(q, u_)))
    for function, found in ((np.hypot, along), (angle, turn)):
        gradient = slope(function)
        assert found == pytest.approx(np.sqrt(gradient @ matrix @ gradient), rel=1e-3)


def test_the_papers_accuracy_equations():
    # s_p and s_chi of Sec. 2.3 for a target of 30 % at 50 degrees
    p, chi, s_q, s_u = 0.3, np.deg2rad(50), 1.2e-3, 0.8e-3
    q, u_ = abs(p * np.cos(2 * chi)), abs(p * np.sin(2 * chi))
    s_p = np.sqrt((q**2 * s_q**2 + u_**2 * s_u**2) / (q**2 + u_**2))
    s_chi = np.sqrt(q**2 * s_u**2 + u_**2 * s_q**2) / (2 * (q**2 + u_**2))
    along, across = polarization_errors(q, u_, s_q, s_u)
    assert (along, across / (2 * p)) == pytest.approx((s_p, s_chi), rel=1e-14)


def test_the_two_errors_share_the_variance():
    # along and across are an orthogonal pair, so the trace is kept
    along, across = polarization_errors(0.01, -0.03, 2e-3, 1e-3, 1e-6)
    assert along**2 + across**2 == pytest.approx(5e-6, rel=1e-12)


def test_wardle_kronberg_by_hand():
    dolp = [0.05, 0.03, 0.01, 0.0]
    np.testing.assert_allclose(
        debias_dolp(dolp, 0.03, method="wardle-kronberg"), [0.04, 0, 0, 0], atol=1e-15
    )


@given(st.floats(0, 1), st.floats(0, 0.1), st.sampled_from(["mas", "wardle-kronberg"]))
def test_debiasing_only_takes_away_and_never_below_zero(dolp, sigma, method):
    result = debias_dolp(dolp, sigma, method=method)
    assert 0 <= result <= dolp
    if sigma == 0:
        assert result == pytest.approx(dolp, rel=1e-15, abs=0)


def test_the_modified_estimator_at_the_ends():
    # p / 2 for p << sigma, p - sigma^2 / (2 p) for p >> sigma
    assert debias_dolp(1e-6, 1e-2) == pytest.approx(5e-7, rel=1e-4)
    assert debias_dolp(0.5, 0.01) == pytest.approx(0.5 - 1e-4, rel=1e-12)
    # the ratio overflows, underflows or is nothing at all
    assert debias_dolp([1.0, 5e-324, 0.0], [5e-324, 1e10, 0.0]).tolist()[::2] == [1.0, 0.0]
    assert aolp_interval(1.0, 5e-324) < 1e-90 * u.deg
    # below the smallest normal square
    assert debias_dolp(1e-200, 1e-180) == pytest.approx(5e-201, rel=1e-10)


def test_the_modified_estimator_is_unbiased_above_a_ratio_of_two():
    # Plaszczynski et al. 2014, Sec. 3; in units of the noise
    rng = np.random.default_rng(3)
    for snr, bias in ((2.0, 0.06), (3.0, 0.015), (5.0, 0.015)):
        q, u_ = rng.normal(snr, 1, 200_000), rng.normal(0, 1, 200_000)
        raw = np.hypot(q, u_)
        assert raw.mean() - snr > 0.09
        assert abs(debias_dolp(raw, 1.0).mean() - snr) < bias, snr


def test_debiasing_with_unequal_errors():
    rng = np.random.default_rng(5)
    angle = np.deg2rad(35)
    truth = 0.01 * np.array([np.cos(2 * angle), np.sin(2 * angle)])
    q = rng.normal(truth[0], 1e-3, 200_000)
    u_ = rng.normal(truth[1], 3e-3, 200_000)
    raw = np.hypot(q, u_)
    estimate = debias_dolp(raw, polarization_errors(q, u_, 1e-3, 3e-3)[1])
    assert abs(estimate.mean() - 0.01) < 0.2 * abs(raw.mean() - 0.01)


def test_bad_input_to_debiasing_and_intervals():
    for function in (debias_dolp, aolp_interval):
        for arguments, message in (
            ((-0.1, 0.1), r"^dolp = -0\.1 must be zero or positive$"),
            (([0.1, -1.2], 0.1), r"dolp = -1\.2 at index \(1,\) must be"),
            ((0.1, -0.1), "sigma"),
            ((np.nan, 0.1), "dolp"),
        ):
            with pytest.raises(ParameterError, match=message):
                function(*arguments)
    with pytest.raises(ParameterError, match=r"'magic'; allowed are mas, wardle-kronberg"):
        debias_dolp(0.1, 0.1, method="magic")


def angular_density(angle, snr):
    """Naghizadeh-Khouei & Clarke 1993, A&A 274, 968, their Eq. for G."""
    eta = snr / np.sqrt(2) * np.cos(2 * angle)
    return (
        (1 / np.sqrt(np.pi) + eta * np.exp(eta**2) * (1 + erf(eta)))
        * np.exp(-(snr**2) / 2)
        / np.sqrt(np.pi)
    )


def test_the_interval_holds_its_probability():
    for snr in (0.0, 0.3, 1.0, 2.0, 5.0, 20.0):
        for probability in (0.3, 0.6827, 0.95, 0.997):
            half = aolp_interval(snr * 0.01, 0.01, probability).to_value(u.rad)
            held, _ = quad(angular_density, -half, half, args=(snr,), epsabs=1e-12, limit=200)
            assert held == pytest.approx(probability, abs=1e-9), (snr, probability)


def test_the_error_of_an_angle_at_any_signal():
    """The rms over all angles, at most that of uniform ones."""
    for snr in (0.0, 0.3, 1.0, 3.333, 12.0, 30.0):
        edge = min(np.pi / 2, 6 / max(snr, 1e-9))
        square, _ = quad(lambda x, s=snr: x**2 * angular_density(x, s), 0, edge, epsabs=1e-14)
        found = angle_error(0.01 * snr, 0.01)
        assert found == pytest.approx(np.rad2deg(np.sqrt(2 * square)), rel=1e-5), snr
    for snr in (39.999, 40.001, 1e4):
        series = np.rad2deg(0.5 / snr) * (1 + 0.5 / snr**2)
        assert angle_error(snr, 1.0) == pytest.approx(series, rel=1e-5), snr
    assert angle_error([0.0, 0.1], [0.1, 0.0]) == pytest.approx([90 / np.sqrt(3), 0.0])


def test_the_interval_against_monte_carlo():
    rng = np.random.default_rng(11)
    q, u_ = rng.normal(1.3, 1, 100_000), rng.normal(0, 1, 100_000)
    angle = np.abs(np.rad2deg(np.arctan2(u_, q)) / 2)
    half = aolp_interval(1.3, 1.0).to_value(u.deg)
    assert np.mean(angle < half) == pytest.approx(0.6827, abs=0.006)


def test_the_interval_at_the_ends():
    assert aolp_interval(0.0, 0.1, 0.5).to_value(u.deg) == pytest.approx(45, rel=1e-12)
    assert aolp_interval(0.1, 0.0).value == 0
    # first order once the ratio is high; 0.6827 is one standard deviation
    first = np.rad2deg(1e-5 / 0.2)
    assert aolp_interval(0.1, 1e-5).to_value(u.deg) / first == pytest.approx(1.0, abs=1e-4)
    with pytest.raises(ParameterError, match="angle"):
        aolp_interval(0.0, 0.0)
    for probability in (0, 1, np.nan):
        with pytest.raises(ParameterError, match="probability"):
            aolp_interval(0.1, 0.1, probability)


@given(st.floats(1e-4, 1), st.floats(1e-4, 1), st.floats(1.01, 3))
def test_the_interval_shrinks_with_the_signal(dolp, sigma, factor):
    assert aolp_interval(dolp * factor, sigma) < aolp_interval(dolp, sigma)


# --- angles of plain numbers ----------------------------------------------------------------


@given(dolp=st.floats(1e-6, 1), degrees=st.floats(0, 179.999))
def test_plain_angle_is_that_of_the_stokes_vector(dolp, degrees):
    q, u_ = dolp * np.cos(2 * np.radians(degrees)), dolp * np.sin(2 * np.radians(degrees))
    # on the circle of 180 deg
    assert (polarization_angle(q, u_) - degrees + 90) % 180 - 90 == pytest.approx(0, abs=1e-9)


def test_plain_angle_at_the_ends():
    """Tables of corrected frames have gaps, which neither warn nor stop the others."""
    found = polarization_angle(np.array([0.1, np.nan, 0.0]), np.array([0.0, 0.1, np.nan]))
    assert found[0] == 0.0
    assert np.isnan(found[1:]).all()
    for u_ in (-1e-300, -1e-17, -0.0):
        assert 0 <= polarization_angle(1.0, u_) < 180, u_
