# Licensed under a 3-clause BSD style license - see LICENSE
"""Priors: checked against their parameter, one more datum for a fit."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from astropolcal import calibrate, optics
from astropolcal.exceptions import ParameterError
from astropolcal.measurement import Measurement, Normal, Tie
from astropolcal.measurement.parameters import FreeParameters, Uniform, bind_prior
from astropolcal.simulation import half_wave_plate_cycles, simulate

DISTRIBUTIONS = [
    stats.norm(0.3, 0.2),
    stats.truncnorm(-2, 3, loc=0.1, scale=0.3),
    stats.t(5, loc=0.2, scale=0.1),
    stats.gamma(3, loc=-0.5, scale=0.2),
    stats.beta(2, 3),
]


def _chain(**priors):
    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.LinearRetarder(retardance=[100, 150] * u.deg, mount="hwp", name="plate")
        | optics.WollastonPrism(efficiency=[0.95, 0.9], name="wollaston")
    )
    for name, prior in priors.items():
        optic, key = name.split("__")
        getattr(chain[optic], key).prior = prior
    return chain


def _measurement(chain, noise=False):
    frames = half_wave_plate_cycles(derotator=[45] * u.deg)
    truth = _chain()
    return Measurement(chain, simulate(truth, [1.2, 1.6] * u.um, frames, noise=noise, seed=3))


def test_half_square_of_the_residual_is_minus_the_log_density():
    for distribution in DISTRIBUTIONS:
        prior = bind_prior(distribution, "x.y", None, (None, None))
        x = distribution.ppf(np.linspace(0.02, 0.98, 31))
        depth = distribution.logpdf(prior.mode) - distribution.logpdf(x)
        np.testing.assert_allclose(prior.residual(x) ** 2 / 2, depth, atol=1e-7)
        assert np.all(np.diff(prior.residual(x)) > 0), distribution


def test_log_densities_are_those_of_scipy():
    """For rows of values at once, outside of the support too."""
    for distribution in [*DISTRIBUTIONS, stats.uniform(0.1, 0.5), stats.gamma(0.5)]:
        for unit in [None, u.deg]:
            prior = bind_prior(distribution, "x.y", unit, (None, None))
            values = np.linspace(-3, 3, 12).reshape(4, 3)
            expected = distribution.logpdf(values)
            np.testing.assert_allclose(
                prior.log_densities(values * prior.factor), expected, atol=1e-9
            )


def test_edges_of_a_flat_prior_are_inside():
    """A fit may stand there; in degrees they are beyond the edge by rounding."""
    for low in (15, 22, 30):
        prior = bind_prior(stats.uniform(low, 7), "x.y", u.deg, (None, None))
        np.testing.assert_allclose(prior.log_densities(prior.support), -np.log(7))


def test_bounds_are_told_for_a_whole_vector():
    """Elements at a bound, of the parameter or of a prior that is flat."""
    free = FreeParameters([_chain(wollaston__efficiency=Uniform(0.9, 0.99))], 2)
    vector = free.start()
    where = free.by_name["wollaston.efficiency"].slice
    vector[where] = [0.95, 0.99]
    assert free.at_bounds(vector)[where].tolist() == [False, True]
    low, _ = free.bounds()
    low[:] = 7
    assert free.bounds()[0].max() < 7


def test_slope_is_the_derivative_of_the_residual():
    for distribution in DISTRIBUTIONS:
        prior = bind_prior(distribution, "x.y", u.deg, (None, None))
        x = distribution.ppf([0.05, 0.3, 0.7, 0.95]) * prior.factor
        step = 1e-4 * distribution.std() * prior.factor
        difference = (prior.residual(x + step) - prior.residual(x - step)) / (2 * step)
        np.testing.assert_allclose(prior.slope(x), difference, rtol=1e-3)


@pytest.mark.slow
@given(st.floats(-3, 3), st.floats(0.01, 2), st.floats(-10, 10))
def test_normal_in_any_unit(mean, std, value):
    here = bind_prior(Normal(mean * u.deg, std * u.deg), "a.theta", u.deg, (None, None))
    there = bind_prior(Normal((mean * u.deg).to(u.rad), (std * u.deg).to(u.arcmin)), "a.theta",
                       u.deg, (None, None))  # fmt: skip
    radian = np.deg2rad(value)
    assert here.residual(radian) == pytest.approx((value - mean) / std, abs=1e-9)
    assert there.residual(radian) == pytest.approx(float(here.residual(radian)), abs=1e-9)


def test_a_prior_that_does_not_fit_is_refused():
    for prior, unit, bounds, complaint in [
        (Normal(1, 2), u.deg, (None, None), "needs a unit"),
        (Normal(1 * u.mm, 2 * u.mm), u.deg, (None, None), "not convertible"),
        (Normal(0 * u.deg, -1 * u.deg), u.deg, (None, None), "positive std"),
        (Normal(9 * u.deg, 1 * u.deg), u.deg, (-5, 5), "outside the bounds -5 to 5 deg"),
        (Uniform(6 * u.deg, 7 * u.deg), u.deg, (-5, 5), "outside the bounds"),
        (Uniform(2 * u.deg, 1 * u.deg), u.deg, (-5, 5), "low below high"),
        (0.3, None, (0, 1), "is a float"),
        (stats.poisson(3), None, (0, 10), "continuous"),
    ]:
        with pytest.raises(ParameterError, match=complaint):
            bind_prior(prior, "plate.theta", unit, bounds)


def test_a_prior_of_what_is_tied_is_not_lost_in_silence():
    def fit(prior, lead=None, **tie):
        chain = _chain(plate__theta=lead, wollaston__theta=prior)
        chain["plate"].theta.fixed = False
        data = _measurement(_chain()).datasets[0].observations
        ties = {"wollaston.theta": Tie("plate.theta", **tie)}
        return calibrate(chain, data, ties=ties, search=False, cross_validate=False)

    narrow = Normal(0 * u.deg, 0.1 * u.deg)
    for lead, tie in (
        (None, {}),
        (Normal(0 * u.deg, 0.2 * u.deg), {}),
        (narrow, {"factor": 2.0}),
        (narrow, {"offset": 1 * u.deg}),
    ):
        with pytest.raises(ParameterError, match=r"wollaston\.theta is tied to plate\.theta"):
            fit(narrow, lead, **tie)
    # the same twice is what shares of one parameter have
    assert fit(narrow, narrow).converged


def test_uniform_is_a_tighter_bound_and_moves_the_start_inside():
    free = FreeParameters([_chain(wollaston__efficiency=Uniform(0.96, 0.99))], 2)
    low, high = free.bounds()
    where = free.by_name["wollaston.efficiency"].slice
    np.testing.assert_allclose(low[where], 0.96)
    np.testing.assert_allclose(high[where], 0.99)
    assert np.all((free.start()[where] >= 0.96) & (free.start()[where] <= 0.99))
    assert free.prior_residuals(free.start()).size == 0


def test_priors_are_data_behind_the_data():
    measurement = _measurement(_chain(wollaston__efficiency=Normal(0.9, 0.05)))
    index, observed, weights = measurement.fit_arguments(noise=0.01)
    assert index.size == observed.size == measurement.n_data + 2
    np.testing.assert_array_equal(weights[-2:], 0.01)
    predicted = measurement.evaluate(index, *measurement.parameters)
    np.testing.assert_allclose(predicted[:-2], measurement.observed, atol=1e-9)
    np.testing.assert_allclose(predicted[-2:], [1.0, 0.0], atol=1e-12)
    slope = measurement.fit_deriv(index, *measurement.parameters)
    assert slope.shape == (4, measurement.n_data + 2)
    np.testing.assert_allclose(slope[2:, -2:], np.eye(2) / 0.05)
    assert (
        measurement.fit_deriv(measurement.index, *measurement.parameters).shape[1] == index.size - 2
    )


def test_without_priors_nothing_is_added():
    measurement = _measurement(_chain())
    index, _, weights = measurement.fit_arguments()
    assert index is not None
    assert index.size == measurement.n_data
    assert weights is None
