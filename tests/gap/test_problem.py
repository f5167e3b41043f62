# Licensed under a 3-clause BSD style license - see LICENSE
"""Residuals, derivatives and fits in both channels."""

import astropy.units as u
import gap_data as data
import numpy as np
import pytest

from astropolcal.gap.channels import Channels, orthonormal
from astropolcal.gap.effects import get_effect
from astropolcal.gap.problem import GapProblem, law_basis
from astropolcal.gap.report import Fitted
from astropolcal.measurement import Measurement


@pytest.fixture(scope="module")
def problem():
    found = GapProblem([data.chain()], [data.observed()])
    found.settle_noise()
    return found


def test_jacobian_against_central_differences(problem):
    q = problem.start + 1e-3 * np.random.default_rng(1).normal(size=problem.size)
    found = problem.jacobian(q)
    for i in range(problem.size):
        step = np.zeros(problem.size)
        step[i] = 1e-6 * max(1.0, abs(q[i]))
        expected = (problem.residual(q - step) - problem.residual(q + step)) / (2 * step[i])
        scale = max(np.abs(expected).max(), 1.0)
        np.testing.assert_allclose(found[:, i], expected, rtol=0, atol=1e-5 * scale)


def test_law_is_a_combination_of_the_values(problem):
    basis = law_basis(problem.wavelength, 2)
    stiff = GapProblem(
        [data.chain()],
        [data.observed()],
        laws={"derotator.retardance": basis},
        like=problem,
    )
    assert stiff.size == problem.size - len(problem.wavelength) + 3
    where = problem.slices["derotator.retardance"]
    full = problem.jacobian(_vector_in(problem, stiff))[:, where]
    found = stiff.jacobian(stiff.start)[:, stiff.slices["derotator.retardance"]]
    np.testing.assert_allclose(found, full @ basis, atol=1e-8 * np.abs(full).max())


def _vector_in(problem, other):
    """Return the coefficients of a problem without laws that stand for those of another."""
    return other.vector(other.start)


def test_fit_comes_back_to_the_truth(problem):
    rng = np.random.default_rng(3)
    away = problem.start * (1 + 0.002 * rng.normal(size=problem.size))
    fit = problem.fit(away)
    assert fit.converged
    freedom = problem.n_data - problem.tangent(fit.coefficients).shape[1]
    assert abs(fit.chi2 - freedom) < 5 * np.sqrt(2 * freedom)
    again = problem.fit(fit.coefficients)
    assert again.chi2 == pytest.approx(fit.chi2, abs=1e-2)


def test_fit_stays_within_the_bounds():
    true = data.chain()
    true["wollaston"].efficiency = np.ones(len(data.WAVELENGTH))
    problem = GapProblem([data.chain()], [data.observed(true)])
    problem.settle_noise()
    fit = problem.fit()
    assert fit.converged
    assert np.all(fit.coefficients <= problem.high)
    assert np.all(fit.coefficients >= problem.low)


def test_lamp_is_no_gap():
    """Drift and flicker of the lamp leave chi-square what it is."""
    for seed in [1, 2]:
        rng = np.random.default_rng(seed)
        n = len(data.frames())
        x = np.linspace(-1, 1, n)
        lamp = 1 + 0.02 * x - 0.01 * x**2 + 0.002 * rng.normal(size=n)
        model = data.fitted(data.observed(seed=seed, lamp=lamp))
        nominal = model.problem.tangent(model.fit.coefficients)
        freedom = model.problem.n_data - nominal.shape[1]
        assert abs(model.fit.chi2 - freedom) < 5 * np.sqrt(2 * freedom)
        found = model.problem.channels[0].lamp.flicker
        assert 0.001 < found < 0.004


def test_whitened_noise_has_unit_variance():
    variances = []
    for seed in range(4):
        measurement = Measurement(
            data.chain(), data.observed(seed=seed), observable="normalized_single_difference"
        )
        channel = Channels(measurement.datasets[0])
        residual = channel.observed - channel.predicted(
            measurement.datasets[0].forward(measurement.vector())
        )
        channel.set_noise(np.sqrt(channel.variance), residual, np.zeros((residual.shape[2], 0)))
        white = channel.whiten(residual)
        variances.append(np.sum(white**2) / (white.size - channel.n_nuisance))
    assert np.mean(variances) == pytest.approx(1, abs=0.07)


def test_masked_data_do_not_count():
    observations = data.observed()
    mask = np.zeros((observations.n_frames, observations.n_bins), dtype=bool)
    mask[5, 2] = True
    masked = observations.with_mask(mask, "cosmic ray")
    problem = GapProblem([data.chain()], [masked])
    problem.settle_noise()
    channel = problem.channels[0]
    assert not channel.valid[2, 5]
    residual = problem.residual(problem.start).reshape(channel.shape)
    assert residual[0, 2, 5] == 0


def test_errors_are_infinite_where_the_data_are_silent():
    chain = data.chain()
    chain["wollaston"].theta.fixed = False
    chain["wollaston"].theta.bounds = (-5, 5)
    problem = GapProblem([chain], [data.observed()])
    problem.settle_noise()
    errors = data.errors(problem, problem.start)
    assert np.isinf(errors[problem.slices["wollaston.theta"]]).all()
    assert np.isfinite(errors[problem.slices["wollaston.efficiency"]]).all()


def test_orthonormal_drops_what_is_there_already():
    columns = np.random.default_rng(1).normal(size=(20, 3))
    basis = orthonormal(np.concatenate([columns, columns @ np.ones((3, 1))], axis=1))
    assert basis.shape == (20, 3)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)


def test_background_of_a_flickering_lamp_is_found_at_its_size():
    """The flux on which an effect depends must not carry the noise of the data."""
    rng = np.random.default_rng(5)
    n = len(data.frames())
    lamp = 1 + 0.2 * np.sin(np.arange(n)) + 0.01 * rng.normal(size=n)
    observations = data.observed(lamp=lamp, flux=1e7)
    table = observations.to_table()
    level = 0.02 * np.median(table["flux_right"].value)
    for beam in ("right", "left"):
        table[f"flux_{beam}"] = table[f"flux_{beam}"] + level * u.adu
    from astropolcal.observations import Observations

    model = data.fitted(Observations.from_table(table))
    better = model.with_effect(get_effect("background"))
    assert model.fit.chi2 - better.fit.chi2 > 100
    size = Fitted(better).sizes("background")["gap_background.amount"]
    off = np.array(size["value"]) - level / better.context.flux
    assert np.all(np.abs(off) < 5 * np.array(size["std"]))
