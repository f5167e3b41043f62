# Licensed under a 3-clause BSD style license - see LICENSE
"""The Serkowski law: values, derivatives, fits, covariance."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.fitting import TRFLSQFitter
from astropy.utils.masked import Masked
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.standards import SerkowskiLaw, whittet_width

HIDDEN = Masked([0.5, 0.6] * u.um, mask=[False, True])
WAVELENGTH = np.linspace(0.4, 2.2, 15) * u.um
degrees = st.floats(0.001, 0.12)
maxima = st.floats(0.4, 0.9)
widths = st.floats(0.5, 1.8)
angles = st.floats(0, 179)


def noisy(law, scale=1e-4):
    return law(WAVELENGTH) + np.random.default_rng(3).normal(0, scale, len(WAVELENGTH))


@settings(max_examples=40)
@given(degrees, maxima, widths)
def test_maximum_is_p_max_at_lambda_max_and_the_curve_is_symmetric_in_log(p_max, longest, width):
    law = SerkowskiLaw(p_max, longest * u.um, width)
    assert law(longest * u.um).value == pytest.approx(p_max, rel=1e-12)
    for factor in (1.1, 1.3):
        up, down = law([longest * factor, longest / factor] * u.um).value
        assert up == pytest.approx(down, rel=1e-9)
        assert up < p_max


def test_value_of_the_formula():
    law = SerkowskiLaw(p_max=3.9 * u.percent, lambda_max=520 * u.nm, K=0.99)
    expected = 0.039 * np.exp(-0.99 * np.log(0.52 / 1.25) ** 2)
    assert law(1.25 * u.um).value == pytest.approx(expected, rel=1e-12)


def test_any_unit_of_length_gives_the_same():
    law = SerkowskiLaw()
    np.testing.assert_allclose(law(1.6 * u.um), law(1600 * u.nm), rtol=1e-14)


def test_width_defaults_to_the_relation_of_whittet():
    # Whittet et al. 1992: K = 0.01 + 1.66 lambda_max
    assert SerkowskiLaw(lambda_max=0.6 * u.um).K.value == pytest.approx(1.006)
    assert whittet_width(600 * u.nm) == pytest.approx(1.006)
    law = SerkowskiLaw()
    law.lambda_max = 600 * u.nm
    assert whittet_width(law) == pytest.approx(1.006)


@settings(max_examples=40)
@given(degrees, maxima, widths)
def test_derivatives_are_those_of_central_differences(p_max, longest, width):
    law, x = SerkowskiLaw(p_max, longest * u.um, width), WAVELENGTH.value
    values = np.array([p_max, longest, width, 0.0, 0.0])
    columns = law.fit_deriv(x, *values)
    for i, column in enumerate(columns):
        step = np.zeros(5)
        step[i] = 1e-6
        slope = (law.evaluate(x, *(values + step)) - law.evaluate(x, *(values - step))) / 2e-6
        np.testing.assert_allclose(column, slope, atol=1e-8)


def test_analytic_derivative_fits_like_a_numerical_one():
    for tied in [False, True]:
        truth = SerkowskiLaw(p_max=0.039, lambda_max=0.52 * u.um, K=None if tied else 0.8)
        fits = []
        for numerical in (False, True):
            start = SerkowskiLaw()
            start.K.tied = whittet_width if tied else False
            fitter = TRFLSQFitter(calc_uncertainties=True)
            fits.append(fitter(start, WAVELENGTH, noisy(truth), estimate_jacobian=numerical))
        np.testing.assert_allclose(fits[0].parameters, fits[1].parameters, rtol=1e-5)
        np.testing.assert_allclose(fits[0].parameters[:3], truth.parameters[:3], rtol=0.02)
        assert fits[0].lambda_max.unit == u.um, tied


def test_fit_of_data_in_percent_and_nanometre():
    truth = SerkowskiLaw(p_max=0.06, lambda_max=0.6 * u.um)
    data = noisy(truth).to(u.percent)
    fit = TRFLSQFitter()(SerkowskiLaw(), WAVELENGTH.to(u.nm), data)
    assert fit.p_max.quantity.to_value(u.percent) == pytest.approx(6, abs=0.05)
    np.testing.assert_allclose(fit.stokes(0.6 * u.um).q, 0.06, rtol=0.01)
    # what is held, or bounded, is the same share in any unit of the data
    held, bounded = SerkowskiLaw(p_max=0.06), SerkowskiLaw()
    held.p_max.fixed, bounded.p_max.bounds = True, (0.02, 0.1)
    for start in (held, bounded):
        fit = TRFLSQFitter()(start, WAVELENGTH, data)
        assert fit.p_max.quantity.to_value(u.percent) == pytest.approx(6, abs=0.05)
        np.testing.assert_allclose(fit.lambda_max.value, 0.6, rtol=0.01)
        again = TRFLSQFitter()(fit, WAVELENGTH, data.to(u.one))
        assert again.p_max.value == pytest.approx(0.06, abs=0.0005)


def test_unknown_tie_leaves_the_derivative_to_the_fitter():
    law = SerkowskiLaw()
    law.K.tied = lambda model: 1.15
    assert law.fit_deriv is None


@settings(max_examples=40)
@given(degrees, maxima, widths, angles)
def test_q_and_u_have_the_degree_and_the_angle(p_max, longest, width, theta):
    law = SerkowskiLaw(p_max, longest * u.um, width, theta * u.deg)
    q, stokes_u, covariance = law.stokes(WAVELENGTH)
    assert covariance is None
    np.testing.assert_allclose(np.hypot(q, stokes_u), law(WAVELENGTH).value, rtol=1e-12)
    turned = np.rad2deg(np.arctan2(stokes_u, q)) / 2 - theta
    np.testing.assert_allclose((turned + 90) % 180, 90, atol=1e-6)


def test_angle_turns_with_wavelength_about_the_maximum():
    law = SerkowskiLaw(lambda_max=0.5 * u.um, theta=178 * u.deg, rotation=4 * u.deg / u.um)
    np.testing.assert_allclose(law.angle([0.5, 1.5] * u.um).value, [178, 2], atol=1e-9)


@settings(max_examples=25)
@given(degrees, maxima, angles, st.floats(-20, 20))
def test_covariance_is_propagated_with_the_derivatives_of_q_and_u(p_max, longest, theta, turn):
    units = (1, u.um, 1, u.deg, u.deg / u.um)
    values = np.array([p_max, longest, 0.9, theta, turn])

    def q_u(shift):
        law = SerkowskiLaw(*(v * n for v, n in zip(values + shift, units, strict=True)))
        return np.array(law.stokes(1.2 * u.um)[:2])

    steps = 1e-6 * np.eye(5)
    jacobian = np.array([(q_u(s) - q_u(-s)) / 2e-6 for s in steps]).T
    matrix = np.cov(np.random.default_rng(1).normal(size=(5, 9)))
    law = SerkowskiLaw(*(v * n for v, n in zip(values, units, strict=True)))
    np.testing.assert_allclose(
        law.stokes(1.2 * u.um, matrix).covariance, jacobian @ matrix @ jacobian.T, atol=1e-8
    )


def test_covariance_of_errors_equals_that_of_a_diagonal_matrix():
    law = SerkowskiLaw(theta=30 * u.deg)
    errors = {"p_max": 0.05 * u.percent, "lambda_max": 10 * u.nm, "K": 0.05, "theta": 0.5 * u.deg}
    by_name = law.stokes(WAVELENGTH, errors).covariance
    matrix = np.diag([0.0005, 0.01, 0.05, 0.5, 0]) ** 2
    np.testing.assert_allclose(by_name, law.stokes(WAVELENGTH, matrix).covariance, rtol=1e-12)
    assert by_name.shape == (15, 2, 2)


def test_covariance_of_free_parameters_as_a_fitter_returns_it():
    law = SerkowskiLaw(theta=30 * u.deg)
    free = np.diag([1e-3, 1e-2, 1e-1]) ** 2
    full = np.zeros((5, 5))
    full[:3, :3] = free
    np.testing.assert_allclose(
        law.stokes(1 * u.um, free).covariance, law.stokes(1 * u.um, full).covariance
    )


def test_a_tied_width_carries_the_error_of_lambda_max():
    law = SerkowskiLaw()
    law.K.tied = whittet_width
    matrix = np.diag([0, 1e-4])
    step = 1e-5
    low, high = (SerkowskiLaw(lambda_max=(0.55 + s) * u.um).q(1.5 * u.um) for s in (-step, step))
    expected = ((high - low) / (2 * step)) ** 2 * 1e-4
    assert law.stokes(1.5 * u.um, matrix).covariance[0, 0] == pytest.approx(expected, rel=1e-6)


def test_whatever_a_width_is_tied_to_its_error_is_that_of_many_laws_drawn():
    for intercept, slope in ((2.5, -1.66), (-0.5, 2.6)):
        law = SerkowskiLaw(p_max=0.04, K=intercept + slope * 0.55)
        law.K.tied = lambda model: intercept + slope * model.lambda_max.value  # noqa: B023
        error = law.stokes(2.2 * u.um, np.diag([1e-3, 0.02]) ** 2).covariance[0, 0] ** 0.5
        p_max, longest = np.random.default_rng(1).normal([0.04, 0.55], [1e-3, 0.02], (9999, 2)).T
        drawn = p_max * np.exp(-(intercept + slope * longest) * np.log(longest / 2.2) ** 2)
        assert error == pytest.approx(drawn.std(), rel=0.05)


def test_a_width_that_is_fixed_and_not_tied_has_no_error():
    """A fit of p_max and lambda_max with K held: its 2 x 2 matrix says nothing of K."""
    law = SerkowskiLaw(theta=20 * u.deg)
    law.K.fixed = True
    fitted = np.array([[1e-6, 2e-6], [2e-6, 1e-4]])
    full = np.zeros((5, 5))
    full[:2, :2] = fitted
    one, other = (law.stokes(1.6 * u.um, matrix).covariance for matrix in (fitted, full))
    np.testing.assert_allclose(one, other, rtol=1e-12)


def test_bad_covariance_is_refused():
    for covariance, words in [
        (np.eye(4), "has 4 rows"),
        (np.full((5, 5), np.nan), "finite"),
        (np.ones(5), "square"),
        ({"pmax": 0.1}, "parameter of the law = 'pmax'"),
        ({"p_max": -0.1}, "not negative"),
        ({"theta": 0.1}, "needs a unit"),
    ]:
        with pytest.raises(ParameterError, match=words):
            SerkowskiLaw().stokes(1 * u.um, covariance)


def test_wavelength_out_of_range_is_refused():
    for wavelength in [0.2 * u.um, 2.6 * u.um, [1.0, 3.0] * u.um, np.nan * u.um, HIDDEN]:
        law = SerkowskiLaw()
        for function in (law, law.stokes, law.angle):
            with pytest.raises(WavelengthRangeError, match=r"0\.28 to 2\.5 um"):
                function(wavelength)


def test_ends_of_the_range_survive_their_unit():
    assert np.all(SerkowskiLaw()(SerkowskiLaw.valid_range.to(u.nm)) > 0)


def test_wrong_units_are_refused():
    for values in [{"lambda_max": 0.55}, {"theta": 3}, {"p_max": 1 * u.um}, {"K": "wide"}]:
        with pytest.raises(ParameterError):
            SerkowskiLaw(**values)


def test_wavelength_without_unit_is_refused():
    with pytest.raises(u.UnitsError):
        SerkowskiLaw()(1.2)


def test_copy_and_name_are_kept():
    law = SerkowskiLaw(p_max=0.02, name="dust").copy()
    assert law.name == "dust"
    assert law.p_max.value == 0.02
