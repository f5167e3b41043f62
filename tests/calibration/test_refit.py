# Licensed under a 3-clause BSD style license - see LICENSE
"""Quick refits of a known solution against the fit itself and against central differences."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate
from astropolcal.calibration.noise.weighting import problem_of
from astropolcal.measurement import Normal
from astropolcal.simulation import half_wave_plate_cycles

LAM = [1.2, 1.6, 2.2] * u.um
FRAMES = half_wave_plate_cycles(derotator=[45, 60, 80, 100] * u.deg)


@pytest.fixture(scope="module")
def problem(make):
    chain = make.chain(wavelength=LAM)
    truth = make.truth(chain)
    data = make.observe(truth, FRAMES, LAM, seed=3)
    return truth, data


def _fit(problem, **options):
    options = {"search": False, "errors": "white", "cross_validate": False} | options
    return calibrate(problem[0], problem[1], **options)


def _moved(cal, vector):
    """How far a vector is from the fit, in standard errors."""
    change = vector - cal.measurement.vector()
    return np.abs(change / cal.measurement.free.factors() / cal.covariance.stds).max()


@pytest.fixture(scope="module")
def cal(problem):
    return _fit(problem)


@pytest.fixture(scope="module")
def with_prior(problem):
    chain = problem[0].copy()
    chain["wollaston"].efficiency.prior = Normal(0.95, 0.005)
    return calibrate(chain, problem[1], search=False, cross_validate=False, weights="errors")


def test_the_solution_is_its_own_refit(cal):
    refit = problem_of(cal)
    vector, chi2, arrived = refit.fit(refit.solution)
    assert arrived
    assert _moved(cal, vector) < 1e-4
    assert chi2 == pytest.approx(np.sum(cal.residuals**2), rel=1e-6)


def test_the_way_back_is_found(cal):
    refit = problem_of(cal)
    vector, _, arrived = refit.fit(refit.solution * 1.0005)
    assert arrived
    stds = cal.covariance.stds * refit.measurement.free.factors()
    assert np.abs((vector - refit.solution) / stds).max() < 0.01


def test_jacobian_is_that_of_central_differences(request):
    for which in ["cal", "with_prior"]:
        refit = problem_of(request.getfixturevalue(which))
        start, weights = refit.solution * 1.0002, refit.weights
        jacobian = refit.jacobian(start, weights)
        assert jacobian.shape == (refit.residuals(start, weights).size, start.size), which
        for i in range(start.size):
            step = np.zeros(start.size)
            step[i] = 1e-6 * max(1.0, abs(start[i]))
            ends = [refit.residuals(start + s * step, weights) for s in (1, -1)]
            slope = (ends[0] - ends[1]) / (2 * step[i])
            scale = np.abs(slope).max()
            np.testing.assert_allclose(jacobian[:, i], slope, atol=2e-5 * scale)


def test_a_prior_is_a_residual_in_the_noise_of_a_datum(with_prior):
    refit = problem_of(with_prior)
    found = refit.residuals(refit.solution, refit.weights)
    n = refit.measurement.n_data
    np.testing.assert_allclose(found[:n], -with_prior.residuals * refit.weights)
    value = with_prior.chain["wollaston"].efficiency.value
    np.testing.assert_allclose(found[n:], (value - 0.95) / 0.005, rtol=1e-9)


def test_with_equal_weights_the_prior_is_scaled_by_the_noise(problem):
    chain = problem[0].copy()
    chain["wollaston"].efficiency.prior = Normal(0.95, 0.005)
    cal = calibrate(chain, problem[1], search=False, cross_validate=False)
    refit, level = problem_of(cal), cal.measurement.weighting.level
    found = refit.residuals(refit.solution, refit.weights)[refit.measurement.n_data :]
    value = cal.chain["wollaston"].efficiency.value
    np.testing.assert_allclose(found, level * (value - 0.95) / 0.005, rtol=1e-9)


def test_a_datum_counted_twice_weighs_twice(cal):
    """The gradient of chi-square is zero at the refit, with each square times its count."""
    refit = problem_of(cal)
    counts = np.random.default_rng(1).integers(0, 3, refit.measurement.n_data).astype(float)
    vector, chi2, _ = refit.fit(refit.solution, counts)
    squares = (refit.measurement.predict(vector) - refit.measurement.observed) ** 2
    assert chi2 == pytest.approx(np.sum(counts * squares), rel=1e-9)
    before = refit.measurement.predict(refit.solution) - refit.measurement.observed
    assert chi2 < np.sum(counts * before**2)
    slope = refit.measurement.jacobian(vector) @ (
        counts * (refit.measurement.predict(vector) - refit.measurement.observed)
    )
    size = np.linalg.norm(refit.measurement.jacobian(vector), axis=1)
    assert np.abs(slope / size).max() < 1e-4 * np.sqrt(chi2)


def test_what_is_held_stays_and_the_others_follow(cal):
    refit = problem_of(cal)
    i = cal.covariance.names.index("hwp.w_sio2")
    start = refit.solution.copy()
    start[i] += cal.covariance.stds[i] * refit.measurement.free.factors()[i]
    vector, chi2, arrived = refit.fit(start, held=[i])
    assert arrived
    assert vector[i] == start[i]
    # one standard error costs one unit of the residual variance, all else refitted
    level = cal.measurement.weighting.level
    assert (chi2 - np.sum(cal.residuals**2)) / level**2 == pytest.approx(1, rel=0.05)
    others = np.delete(vector - refit.solution, i)
    assert np.abs(others).max() > 0


def test_a_start_beyond_a_bound_is_taken_back(cal):
    refit = problem_of(cal)
    start = refit.solution.copy()
    slot = refit.measurement.free.by_name["wollaston.efficiency"].slice
    start[slot] = 1.0 + 1e-9
    vector, _, arrived = refit.fit(start)
    assert arrived
    assert _moved(cal, vector) < 1e-4


def test_a_parameter_that_moves_nothing_disturbs_no_other(problem):
    truth, data = problem
    mask = np.zeros((data.n_frames, 3), dtype=bool)
    mask[:, 2] = True
    cal = calibrate(truth, data.with_mask(mask, "test"), search=False, cross_validate=False)
    refit = problem_of(cal)
    vector, _, arrived = refit.fit(refit.solution)
    silent = [cal.covariance.names.index(name) for name in cal.identifiability.silent]
    assert silent
    assert arrived
    others = (np.delete(each, silent) for each in (vector, refit.solution))
    np.testing.assert_allclose(*others, rtol=1e-4)


def test_weights_are_those_of_the_fit(problem):
    cal = _fit(problem, weights="errors")
    np.testing.assert_allclose(problem_of(cal).weights, 1 / cal.measurement.sigma)
    np.testing.assert_array_equal(problem_of(_fit(problem)).weights, 1)
