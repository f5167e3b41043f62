# Licensed under a 3-clause BSD style license - see LICENSE
"""Fits of a gap problem: bounds, priors, left-out rows, errors."""

import gap_data as data
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from astropolcal.gap import problem as module
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import get_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.problem import Fit, GapProblem, _positions, law_basis

EFFICIENCY, RETARDANCE = "wollaston.efficiency", "derotator.retardance"
DEGREE = np.pi / 180


def problem_of(observations=None, chain=None, like=None, **options):
    observations = data.observed() if observations is None else observations
    found = GapProblem([chain or data.chain()], [observations], like=like, **options)
    if like is None:
        found.settle_noise()
    return found


@pytest.fixture(scope="module")
def plain():
    return problem_of()


@pytest.fixture(scope="module")
def fitted(plain):
    return plain.fit()


# ---- the minimum ---------------------------------------------------------------------------


def test_the_gradient_vanishes_where_the_fit_ends(plain, fitted):
    slopes, left = plain.jacobian(fitted.coefficients), plain.residual(fitted.coefficients)
    inside = (fitted.coefficients < plain.high - 1e-6) & (fitted.coefficients > plain.low + 1e-6)
    steepest = (slopes.T @ left) / np.linalg.norm(slopes, axis=0)
    assert fitted.converged
    # in units of the noise
    assert np.abs(steepest[inside]).max() < 0.05


def test_chi_square_is_that_of_the_residuals(plain, fitted):
    left = plain.residual(fitted.coefficients)
    assert fitted.chi2 == pytest.approx(left @ left)
    # of data that were simulated with this noise
    assert fitted.chi2 == pytest.approx(plain.n_data - plain.size, rel=0.2)


def test_a_curved_valley_takes_few_steps():
    """A background does to the differences what a lower efficiency does, but for the drift."""
    lamp = 1 + 0.02 * np.linspace(-1, 1, len(data.frames()))
    table = data.observed(noise=False, lamp=lamp, flux=1e7).to_table()
    usual = np.median(table["flux_right"] + table["flux_left"])
    rng = np.random.default_rng(1)
    for beam in ("flux_right", "flux_left"):
        flux = (table[beam] + 0.15 * usual).value
        table[beam] = (flux + rng.normal(0, np.sqrt(flux))) * table[beam].unit
    plain = data.fitted(data.Observations.from_table(table, name="lamp"))
    found = plain.with_effect(get_effect("background"), steps=10)
    assert found.fit.converged
    assert found.fit.chi2 < found.problem.n_data


def test_added_light_is_fitted_to_faint_beams_too():
    """A nominal fit takes up a part of it, and the flux that it expects is not that of a beam."""
    clean = data.observed(noise=False, flux=1e7).to_table()
    cases = (("background_of_one_beam", "flux", 0.03), ("persistence", "previous", 0.015))
    for kind, follows, size in cases:
        table, rng = clean.copy(), np.random.default_rng(1)
        for beam in ("right", "left"):
            flux = clean[f"flux_{beam}"].value.reshape(-1, len(data.WAVELENGTH))
            added = np.median(flux) * (beam == "right")
            if kind == "persistence":
                added = np.concatenate([flux[:1], flux[:-1]])
            flux = (flux + size * added).ravel()
            table[f"flux_{beam}"] = rng.normal(flux, np.sqrt(flux)) * clean["flux_right"].unit
            table[f"flux_{beam}_err"] = np.sqrt(flux) * clean["flux_right"].unit
        plain = data.fitted(data.Observations.from_table(table, name="lamp"))
        found = plain.with_effect(CellEffect(Cell("detector", kind, follows)))
        assert plain.p_value < 1e-9, kind
        assert found.p_value > 0.01, kind


def test_the_same_minimum_is_found_from_elsewhere(plain, fitted):
    rng = np.random.default_rng(7)
    start = fitted.coefficients + 0.03 * rng.normal(size=plain.size)
    again = plain.fit(start)
    assert again.chi2 == pytest.approx(fitted.chi2, abs=0.05)


def test_no_step_is_no_convergence(plain):
    found = plain.fit(steps=0)
    assert not found.converged
    np.testing.assert_array_equal(found.coefficients, np.clip(plain.start, plain.low, plain.high))


def test_rows_that_are_left_out_have_no_say(plain, fitted):
    spoiled = data.with_flux(data.observed(), np.where(np.arange(32) < 8, 1.5, 1.0))
    other = problem_of(spoiled, like=plain)
    # the noise is that of the clean data, the data are the spoiled ones
    other.channels = [type(c)(d) for c, d in zip(other.channels, other.datasets, strict=True)]
    for mine, theirs in zip(other.channels, plain.channels, strict=True):
        mine.sigma, mine.lamp = theirs.sigma, theirs.lamp
        mine._whitening, mine.nuisance = theirs._whitening, theirs.nuisance
    kept = np.broadcast_to(np.arange(32) >= 8, plain.channels[0].shape).ravel()
    found, expected = other.fit(rows=kept), plain.fit(rows=kept)
    differences = [p.differences(f.coefficients)[0][0][:, 8:] for p, f in
                   ((other, found), (plain, expected))]  # fmt: skip
    # the sums share the lamp with the frames that are left out, the differences nothing
    noise = plain.channels[0].sigma[0].mean()
    assert np.abs(differences[0] - differences[1]).max() < 0.6 * noise


# ---- bounds, limits and priors -------------------------------------------------------------


def test_a_fit_stops_at_its_bound():
    chain = data.chain()
    chain["wollaston"].efficiency.bounds = (0, 0.9)
    found = problem_of(chain=chain)
    fit = found.fit()
    values = fit.coefficients[found.slices[EFFICIENCY]]
    np.testing.assert_allclose(values, 0.9, atol=1e-8)
    # what is at its bound takes nothing up
    assert found.tangent(fit.coefficients).shape[1] == found.size - len(data.WAVELENGTH)


def test_limits_narrow_the_bounds_about_the_neutral_value():
    options = {"neutral": {EFFICIENCY: 0.8}, "limits": {EFFICIENCY: 0.05, RETARDANCE: 1.0}}
    found = problem_of(**options)
    where = found.slices[EFFICIENCY]
    np.testing.assert_allclose(found.low[where], 0.75)
    np.testing.assert_allclose(found.high[where], 0.85)
    np.testing.assert_allclose(found.high[found.slices[RETARDANCE]], 1.0)
    # never wider than the chain's own
    wide = problem_of(limits={EFFICIENCY: 50.0})
    assert wide.high[wide.slices[EFFICIENCY]].max() <= 1.0


def test_the_values_of_a_law_are_held_to_the_bounds_of_its_optic():
    laws = {EFFICIENCY: law_basis(data.WAVELENGTH.to_value("um"), 1)}
    true = data.chain()
    true["wollaston"].efficiency = np.linspace(0.98, 0.95, len(data.WAVELENGTH))
    free = problem_of(data.observed(true), true, laws=laws)
    values = free.vector(free.fit().coefficients)[free.free.by_name[EFFICIENCY].slice]
    # coefficients have no bounds of their own
    assert np.all(np.isinf(free.high[free.slices[EFFICIENCY]]))
    bound = (values.min() + values.max()) / 2
    true["wollaston"].efficiency.bounds = (0, bound)
    held = problem_of(data.observed(true), true, laws=laws, like=free)
    fit = held.fit()
    found = held.vector(fit.coefficients)[held.free.by_name[EFFICIENCY].slice]
    assert fit.converged
    assert found.max() == pytest.approx(bound, abs=1e-7)
    # one value of a straight line is at its bound, and takes one direction
    assert np.sum(found > bound - 1e-7) == 1
    assert held.tangent(fit.coefficients).shape[1] == held.size - 1
    # no step along the wall, or away from it, leads down
    slopes = held.jacobian(fit.coefficients).T @ held.residual(fit.coefficients)
    where = held.slices[EFFICIENCY]
    line = laws[EFFICIENCY][np.argmax(found)]
    along = np.array([-line[1], line[0]])
    errors = data.errors(held, fit.coefficients)[where]
    assert abs(slopes[where] @ along) * np.linalg.norm(errors) < 0.05
    assert slopes[where] @ line > 0


@pytest.mark.slow
def test_a_prior_holds_only_if_it_is_narrower_than_the_data(plain, fitted):
    for sigma in [1e-5, 1e3]:
        held = problem_of(like=plain, priors={EFFICIENCY: sigma}, neutral={EFFICIENCY: 0.9})
        found = held.fit()
        where = plain.slices[EFFICIENCY]
        expected = 0.9 if sigma < 1 else fitted.coefficients[where]
        np.testing.assert_allclose(found.coefficients[where], expected, atol=2e-3)
        # chi-square is of the data alone
        left = held.residual(found.coefficients)
        assert found.chi2 == pytest.approx(left @ left)


def test_a_prior_as_wide_as_the_data_meets_them_half_way(plain, fitted):
    where = plain.slices[EFFICIENCY]
    errors = data.errors(plain, fitted.coefficients)[where]
    target = fitted.coefficients[where][3] - 0.01
    one = problem_of(like=plain, priors={EFFICIENCY: errors[3]}, neutral={EFFICIENCY: target})
    moved = one.fit().coefficients[where][3]
    assert moved == pytest.approx(target + 0.005, abs=0.001)


# ---- steps ---------------------------------------------------------------------------------


def test_a_step_within_bounds_is_that_of_bounded_least_squares(plain):
    rng = np.random.default_rng(3)
    n = plain.size
    matrix, target = rng.normal(size=(2 * n, n)), 3 * rng.normal(size=2 * n)
    narrow = problem_of(like=plain)
    narrow.low, narrow.high = plain.start - 0.3, plain.start + 0.3
    normal = matrix.T @ matrix, matrix.T @ target, np.ones(n)
    step, promised = narrow._step(plain.start, *normal, 0.0)
    expected = lsq_linear(matrix, target, (-0.3, 0.3), tol=1e-12).x
    np.testing.assert_allclose(step, expected, atol=1e-4)
    left = matrix @ step - target
    assert promised == pytest.approx(target @ target - left @ left)


def test_a_model_without_derivatives_does_not_converge(plain, monkeypatch):
    nothing = np.full((plain.n_rows, plain.size), np.nan)
    monkeypatch.setattr(plain, "jacobian", lambda *_: nothing)
    assert not plain.fit().converged


# ---- what follows --------------------------------------------------------------------------


def test_errors_are_those_of_the_normal_equations(plain, fitted):
    slopes = plain.jacobian(fitted.coefficients)
    scale = np.linalg.norm(slopes, axis=0)
    inverse = np.linalg.inv((slopes / scale).T @ (slopes / scale))
    expected = np.sqrt(np.diag(inverse)) / scale
    np.testing.assert_allclose(data.errors(plain, fitted.coefficients), expected, rtol=1e-5)


def test_an_open_coefficient_is_known_as_well_as_its_prior(plain):
    chain = data.chain()
    chain["wollaston"].theta.fixed = False
    chain["wollaston"].theta.bounds = (-5, 5)
    found = problem_of(chain=chain, like=plain, priors={"wollaston.theta": 2 * DEGREE})
    (error,) = data.errors(found, found.start)[found.slices["wollaston.theta"]]
    assert error <= 2 * DEGREE * (1 + 1e-9)


def test_decomposition_gives_the_table_back(plain):
    singular, right, scale = plain.decomposed(plain.start)
    gram = plain.jacobian(plain.start).T @ plain.jacobian(plain.start)
    found = (right.T * singular**2) @ right * np.outer(scale, scale)
    np.testing.assert_allclose(found, gram, rtol=1e-8, atol=1e-8 * gram.max())
    np.testing.assert_allclose(np.sum(singular**2), plain.size, rtol=1e-9)


def test_coefficients_and_values_are_inverse_to_each_other():
    wavelength = data.WAVELENGTH.to_value("um")
    found = problem_of(laws={RETARDANCE: law_basis(wavelength, 2)})
    some = np.random.default_rng(2).normal(size=found.size)
    np.testing.assert_allclose(found.coefficients(found.vector(some)), some, atol=1e-10)
    values = found.vector(some)
    slot = found.free.by_name[RETARDANCE]
    expected = law_basis(wavelength, 2) @ some[found.slices[RETARDANCE]]
    np.testing.assert_allclose(values[slot.slice], expected)


def test_data_count_without_the_lamp(plain):
    (channel,) = plain.channels
    assert plain.n_rows == channel.observed.size == 2 * 32 * len(data.WAVELENGTH)
    assert plain.n_data == plain.n_rows - channel.n_nuisance


def test_residuals_of_the_data_are_zero_for_what_they_predict():
    exact = problem_of(data.observed(noise=False))
    (gap,) = exact.differences(exact.start)
    np.testing.assert_allclose(gap[0], 0, atol=1e-9)


def test_an_effect_of_the_flux_sees_the_expected_fluxes():
    model = data.clean_model()
    problem = model.edited((get_effect("persistence"), None)).problem
    flux = model.problem.fluxes[0]
    chain = problem.measurement.chains[0]
    previous = _positions(chain, model.observations[0], flux)["previous_flux"]
    np.testing.assert_allclose(previous[..., 1:], flux[..., 1:] / flux[..., :-1])
    # the first frame has none before it and refers to itself
    np.testing.assert_allclose(previous[..., 0], 1.0)


def test_a_problem_that_nothing_is_free_in():
    chain = data.chain()
    for optic in ("hwp", "derotator", "wollaston", "calibration_polarizer"):
        for key in chain[optic].param_names:
            getattr(chain[optic], key).fixed = True
    found = problem_of(chain=chain)
    assert found.size == 0
    assert found.vector(found.start).shape == (0,)
    fit = found.fit()
    assert isinstance(fit, Fit)
    assert fit.converged
    assert found.tangent(fit.coefficients).shape == (found.n_rows, 0)


# ---- steps within bounds -----------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.sampled_from([0.0, 0.1, 1.0, 10.0]))
def test_least_squares_within_bounds_are_those_of_scipy(seed, n, room):
    """Correlated columns of unit length, bounds on either side, some of them closed."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(3 * n, n)) @ (np.eye(n) + rng.normal(size=(n, n)))
    base, triangle = np.linalg.qr(table / np.linalg.norm(table, axis=0))
    wanted = base.T @ rng.normal(size=3 * n)
    low, high = -room * rng.exponential(size=n), room * rng.exponential(size=n)
    high[rng.random(n) < 0.2] = 0.0
    free = np.linalg.solve(triangle, wanted)
    found = module._within(triangle, wanted, low, high, free)
    slack = 1e-9
    other = lsq_linear(triangle, wanted, (low - slack, high + slack), method="bvls").x
    assert np.all((low <= found) & (found <= high))
    squares = [np.sum((triangle @ x - wanted) ** 2) for x in (found, np.clip(other, low, high))]
    assert squares[0] <= squares[1] * (1 + 1e-9) + 1e-15


@given(st.integers(0, 2**32 - 1), st.integers(1, 12))
def test_least_squares_behind_walls_are_those_within_bounds(seed, n):
    """Where the walls are the bounds of the unknowns, some closed, some open."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(3 * n, n)) @ (np.eye(n) + rng.normal(size=(n, n)))
    base, triangle = np.linalg.qr(table / np.linalg.norm(table, axis=0))
    wanted = base.T @ rng.normal(size=3 * n)
    low, high = -rng.exponential(size=n), rng.exponential(size=n)
    high[rng.random(n) < 0.3], low[rng.random(n) < 0.3] = 0.0, -np.inf
    free = np.linalg.solve(triangle, wanted)
    assume(np.any((free > high) | (free < low)))
    rows, room = np.concatenate([np.eye(n), -np.eye(n)]), np.concatenate([high, -low])
    found = module._behind_walls(triangle, wanted, rows, room)
    assert np.all(rows @ found < room + 2e-7)
    expected = module._within(triangle, wanted, low, high, free)
    squares = [np.sum((triangle @ x - wanted) ** 2) for x in (found, expected)]
    assert squares[0] == pytest.approx(squares[1], rel=1e-5, abs=1e-6)


def test_what_is_guessed_wrong_is_found_as_behind_walls(monkeypatch):
    triangle, wanted = np.array([[1.0, 0.9], [0.0, 0.1]]), np.array([1.0, -1.0])
    low, high = np.full(2, -1.0), np.full(2, 1.0)
    free = np.linalg.solve(triangle, wanted)
    expected = module._within(triangle, wanted, low, high, free)
    monkeypatch.setattr(module, "_GUESSES", 0)
    found = module._within(triangle, wanted, low, high, free)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(expected, [1.0, -0.121951], atol=1e-6)
