# Licensed under a 3-clause BSD style license - see LICENSE
"""Degrees and angle of polarization, their errors, their bias."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import erf

from astropolcal.exceptions import ParameterError
from astropolcal.stokes import (
    angle_of_linear_polarization,
    aolp_error,
    aolp_interval,
    debias_dolp,
    degree_of_linear_polarization,
    degree_of_polarization,
    dolp_error,
    is_physical_stokes,
    polarization_angle,
    stokes_from_dolp_aolp,
    transverse_error,
)

DEGREES = [degree_of_linear_polarization, degree_of_polarization, angle_of_linear_polarization]
ERRORS = [dolp_error, aolp_error, transverse_error]


@pytest.mark.parametrize(
    ("q", "u_", "angle"),
    [(1, 0, 0), (0, 1, 45), (-1, 0, 90), (0, -1, 135), (1, 1, 22.5), (-1, -1, 112.5)],
)
def test_angles_of_the_four_quadrants(q, u_, angle):
    result = angle_of_linear_polarization([2.0, q, u_, 0.0])
    assert result.unit == u.deg
    assert result.value == pytest.approx(angle, abs=1e-12)


def test_the_angle_stays_below_180_degrees():
    result = angle_of_linear_polarization([[1.0, 1.0, -1e-30, 0.0], [1.0, 1.0, -1e-10, 0.0]])
    assert np.all(result < 180 * u.deg)
    assert np.all(result >= 0 * u.deg)


def test_degrees_of_polarization_by_hand():
    stokes = [[2.0, 0.6, 0.8, 0.0], [3.0, 1.0, 2.0, 2.0], [1.0, 0.0, 0.0, -0.3]]
    np.testing.assert_allclose(
        degree_of_linear_polarization(stokes), [0.5, np.sqrt(5) / 3, 0], rtol=1e-15
    )
    np.testing.assert_allclose(degree_of_polarization(stokes), [0.5, 1.0, 0.3], rtol=1e-15)


@given(st.floats(1e-6, 1), st.floats(0, 179.99), st.floats(0.01, 1e6))
def test_dolp_and_aolp_round_trip(dolp, angle, intensity):
    stokes = stokes_from_dolp_aolp(dolp, angle * u.deg, intensity=intensity)
    assert degree_of_linear_polarization(stokes) == pytest.approx(dolp, rel=1e-12)
    found = angle_of_linear_polarization(stokes).value
    # 0 and 180 degrees are the same angle
    assert abs((found - angle + 90) % 180 - 90) < 1e-9
    assert stokes[0] == pytest.approx(intensity)


@given(st.floats(0, 1), st.floats(-180, 180), st.floats(-1, 1))
def test_circular_polarization_adds_in_quadrature(dolp, angle, share):
    circular = share * np.sqrt(1 - dolp**2)
    stokes = stokes_from_dolp_aolp(dolp, angle * u.deg, circular)
    assert degree_of_polarization(stokes) == pytest.approx(np.hypot(dolp, circular), abs=1e-12)
    assert is_physical_stokes(stokes)


def test_a_degree_may_come_in_percent_and_an_angle_in_radian():
    one = stokes_from_dolp_aolp(2 * u.percent, 30 * u.deg)
    other = stokes_from_dolp_aolp(0.02, np.pi / 6 * u.rad)
    np.testing.assert_allclose(one, other, rtol=1e-14)


@pytest.mark.parametrize("function", [*DEGREES, is_physical_stokes])
def test_shapes_axes_and_flux_units(function):
    rng = np.random.default_rng(1)
    stokes = rng.uniform(0.1, 0.3, (5, 4, 3))
    stokes[:, 0] = 1.0
    expected = function(np.moveaxis(stokes, 1, -1))
    assert expected.shape == (5, 3)
    np.testing.assert_array_equal(function(stokes, axis=1), expected)
    np.testing.assert_array_equal(function(stokes * u.Jy, axis=1), expected)


def test_arguments_broadcast():
    stokes = stokes_from_dolp_aolp(np.full((3, 1), 0.1), [0, 45] * u.deg, intensity=[[[2.0]]])
    assert stokes.shape == (1, 3, 2, 4)
    q = np.full((3, 1), 0.01)
    for function in ERRORS:
        assert function(q, [0.0, 0.02], 1e-3, 1e-3).shape == (3, 2)
    assert debias_dolp(q, [1e-3, 2e-3]).shape == (3, 2)
    assert aolp_interval(q, [1e-3, 2e-3]).shape == (3, 2)


@pytest.mark.parametrize("function", DEGREES)
@pytest.mark.parametrize(
    ("stokes", "message"),
    [
        ([0.0, 0.0, 0.0, 0.0], "intensity"),
        ([[1.0, 0.1, 0, 0], [-2.0, 0.1, 0, 0]], r"intensity I = -2.0 at index \(1,\)"),
        ([np.nan, 0.1, 0.0, 0.0], "finite"),
        ([1.0, np.inf, 0.0, 0.0], "finite"),
        ([1.0, 0.1, 0.0], "shape"),
        (1.0, "shape"),
    ],
)
def test_bad_stokes_vectors_give_no_number(function, stokes, message):
    with pytest.raises(ParameterError, match=message):
        function(stokes)


def test_unpolarized_light_has_no_angle():
    with pytest.raises(ParameterError, match="angle"):
        angle_of_linear_polarization([[1.0, 0.1, 0, 0], [1.0, 0.0, 0.0, 0.5]])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.1, 0 * u.deg), "dolp"),
        ((-0.1, 0 * u.deg), "dolp"),
        ((np.nan, 0 * u.deg), "dolp"),
        ((0.1, 30.0), "aolp"),
        ((0.1, np.nan * u.deg), "aolp"),
        ((0.8, 0 * u.deg, 0.8), "degree of polarization"),
        ((0.1, 0 * u.deg, 0.0, 0.0), "intensity"),
        ((0.1 * u.m, 0 * u.deg), "dolp"),
        (("much", 0 * u.deg), "dolp"),
    ],
)
def test_bad_polarizations_are_refused(arguments, message):
    with pytest.raises(ParameterError, match=message):
        stokes_from_dolp_aolp(*arguments)


def test_physical_stokes_vectors():
    stokes = [[1, 1, 0, 0], [1, 1 + 1e-6, 0, 0], [0, 0, 0, 0], [-1, 0, 0, 0], [1, 0.6, 0.6, 0.6]]
    assert is_physical_stokes(stokes).tolist() == [True, False, True, False, False]
    assert is_physical_stokes(stokes, tolerance=1e-5).tolist() == [True, True, True, False, False]
    with pytest.raises(ParameterError, match="finite"):
        is_physical_stokes([1.0, np.nan, 0.0, 0.0])
    with pytest.raises(ParameterError, match="tolerance"):
        is_physical_stokes(stokes, tolerance=-1)


@pytest.mark.parametrize("covariance", [0.0, 6e-7, -6e-7])
@pytest.mark.parametrize("angle", [0.0, 20.0, 75.0, 130.0])
def test_first_order_errors_against_monte_carlo(angle, covariance):
    rng = np.random.default_rng(7)
    _, q, u_, _ = stokes_from_dolp_aolp(0.05, angle * u.deg)
    sigma_q, sigma_u, n = 1e-3, 1.5e-3, 40_000
    matrix = [[sigma_q**2, covariance], [covariance, sigma_u**2]]
    sample = rng.multivariate_normal([q, u_], matrix, n)
    p = np.hypot(*sample.T)
    chi = np.rad2deg(np.arctan2(sample[:, 1], sample[:, 0]) - np.arctan2(u_, q)) / 2
    chi = (chi + 90) % 180 - 90
    # five standard errors of a standard deviation from n draws, plus 0.2 %
    # for the second order at a signal-to-noise ratio of 33 and more
    rel = 5 / np.sqrt(2 * n) + 0.002
    arguments = (q, u_, sigma_q, sigma_u, covariance)
    assert dolp_error(*arguments) == pytest.approx(p.std(), rel=rel)
    assert aolp_error(*arguments).to_value(u.deg) == pytest.approx(chi.std(), rel=rel)


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

    for function, error in (
        (np.hypot, dolp_error),
        (
            lambda a, b: np.rad2deg(np.unwrap([np.arctan2(u_, q), np.arctan2(b, a)])[1] / 2),
            aolp_error,
        ),
    ):
        gradient = slope(function)
        expected = np.sqrt(gradient @ matrix @ gradient)
        found = error(q, u_, sigma_q, sigma_u, covariance)
        assert getattr(found, "value", found) == pytest.approx(expected, rel=1e-3)


def test_the_papers_accuracy_equations():
    # s_p and s_chi of Sec. 2.3 for a target of 30 % at 50 degrees
    p, chi, s_q, s_u = 0.3, np.deg2rad(50), 1.2e-3, 0.8e-3
    q, u_ = abs(p * np.cos(2 * chi)), abs(p * np.sin(2 * chi))
    s_p = np.sqrt((q**2 * s_q**2 + u_**2 * s_u**2) / (q**2 + u_**2))
    s_chi = np.sqrt(q**2 * s_u**2 + u_**2 * s_q**2) / (2 * (q**2 + u_**2))
    assert dolp_error(q, u_, s_q, s_u) == pytest.approx(s_p, rel=1e-14)
    assert aolp_error(q, u_, s_q, s_u).to_value(u.rad) == pytest.approx(s_chi, rel=1e-14)


def test_the_two_errors_share_the_variance():
    # along and across are an orthogonal pair, so the trace is kept
    along = dolp_error(0.01, -0.03, 2e-3, 1e-3, 1e-6)
    across = transverse_error(0.01, -0.03, 2e-3, 1e-3, 1e-6)
    assert along**2 + across**2 == pytest.approx(5e-6, rel=1e-12)


@pytest.mark.parametrize("function", ERRORS)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 0.0, 1e-3, 1e-3), "dolp"),
        ((0.1, 0.0, -1e-3, 1e-3), "sigma_q"),
        ((0.1, 0.0, 1e-3, np.nan), "sigma_u"),
        ((np.nan, 0.0, 1e-3, 1e-3), "q = nan"),
        ((0.1, 0.0, 1e-3, 1e-3, 1.1e-6), "covariance"),
        ((0.1, 0.0, 1e-3 * u.m, 1e-3), "sigma_q"),
    ],
)
def test_bad_errors_are_refused(function, arguments, message):
    with pytest.raises(ParameterError, match=message):
        function(*arguments)


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


@pytest.mark.parametrize(("snr", "bias"), [(2.0, 0.06), (3.0, 0.015), (5.0, 0.015)])
def test_the_modified_estimator_is_unbiased_above_a_ratio_of_two(snr, bias):
    # Plaszczynski et al. 2014, Sec. 3; in units of the noise
    rng = np.random.default_rng(3)
    q, u_ = rng.normal(snr, 1, 200_000), rng.normal(0, 1, 200_000)
    raw = np.hypot(q, u_)
    assert raw.mean() - snr > 0.09
    assert abs(debias_dolp(raw, 1.0).mean() - snr) < bias


def test_debiasing_with_unequal_errors():
    rng = np.random.default_rng(5)
    angle = np.deg2rad(35)
    truth = 0.01 * np.array([np.cos(2 * angle), np.sin(2 * angle)])
    q = rng.normal(truth[0], 1e-3, 200_000)
    u_ = rng.normal(truth[1], 3e-3, 200_000)
    raw = np.hypot(q, u_)
    estimate = debias_dolp(raw, transverse_error(q, u_, 1e-3, 3e-3))
    assert abs(estimate.mean() - 0.01) < 0.2 * abs(raw.mean() - 0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [((-0.1, 0.1), "dolp"), ((0.1, -0.1), "sigma"), ((np.nan, 0.1), "dolp")],
)
def test_bad_input_to_debiasing_and_intervals(arguments, message):
    with pytest.raises(ParameterError, match=message):
        debias_dolp(*arguments)
    with pytest.raises(ParameterError, match=message):
        aolp_interval(*arguments)


def test_an_unknown_method_is_named():
    with pytest.raises(
        ParameterError, match=r"'magic' must be one of \['mas', 'wardle-kronberg'\]"
    ):
        debias_dolp(0.1, 0.1, method="magic")


def angular_density(angle, snr):
    """Naghizadeh-Khouei & Clarke 1993, A&A 274, 968, their Eq. for G."""
    eta = snr / np.sqrt(2) * np.cos(2 * angle)
    return (
        (1 / np.sqrt(np.pi) + eta * np.exp(eta**2) * (1 + erf(eta)))
        * np.exp(-(snr**2) / 2)
        / np.sqrt(np.pi)
    )


@pytest.mark.parametrize("snr", [0.0, 0.3, 1.0, 2.0, 5.0, 20.0])
@pytest.mark.parametrize("probability", [0.3, 0.6827, 0.95, 0.997])
def test_the_interval_holds_its_probability(snr, probability):
    half = aolp_interval(snr * 0.01, 0.01, probability).to_value(u.rad)
    held, _ = quad(angular_density, -half, half, args=(snr,), epsabs=1e-12, limit=200)
    assert held == pytest.approx(probability, abs=1e-9)


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
    first = aolp_error(0.1, 0.0, 1e-5, 1e-5)
    assert (aolp_interval(0.1, 1e-5) / first).value == pytest.approx(1.0, abs=1e-4)
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
    checked = angle_of_linear_polarization([1.0, q, u_, 0.0]).to_value(u.deg)
    assert polarization_angle(q, u_) == checked
    # on the circle of 180 deg
    assert (polarization_angle(q, u_) - degrees + 90) % 180 - 90 == pytest.approx(0, abs=1e-9)


def test_plain_angle_of_what_is_no_number_is_none():
    """Tables of corrected frames have gaps, which neither warn nor stop the others."""
    found = polarization_angle(np.array([0.1, np.nan, 0.0]), np.array([0.0, 0.1, np.nan]))
    assert found[0] == 0.0
    assert np.isnan(found[1:]).all()


@pytest.mark.parametrize("u_", [-1e-300, -1e-17, -0.0])
def test_plain_angle_never_reaches_180_deg(u_):
    assert 0 <= polarization_angle(1.0, u_) < 180


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: stokes_from_dolp_aolp([0.1, 1.2], 0 * u.deg),
            r"dolp = 1\.2 at index \(1,\) must be",
        ),
        (lambda: stokes_from_dolp_aolp(0.1, 0 * u.deg, intensity=[[1.0, 0.0]]), r"index \(0, 1\)"),
        (lambda: debias_dolp(-0.1, 0.1), r"^dolp = -0\.1 must be zero or positive$"),
        (lambda: degree_of_linear_polarization(np.ones(3)), r"shape \(3,\); axis -1 must hold"),
        (
            lambda: degree_of_linear_polarization(np.ones((4, 2)), axis=2),
            "axis 2 must hold the four",
        ),
    ],
)
def test_message_names_value_and_place(call, words):
    with pytest.raises(ParameterError, match=words):
        call()
