# Licensed under a 3-clause BSD style license - see LICENSE
"""Systematic errors: linear against sampled, and against wrong calibrations."""

import warnings
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate
from astropolcal.calibration.posterior import Posterior
from astropolcal.correction import Systematic
from astropolcal.correction.rows import RowModel
from astropolcal.correction.solve import estimator
from astropolcal.correction.systematic import linear_systematic, sampled_systematic

STOKES = np.array([1.0, 0.12, -0.2])


@pytest.fixture(scope="module")
def model(calibration, track):
    return RowModel(calibration, track()[1], calibration.wavelength)


@pytest.fixture(scope="module")
def solution(model):
    return estimator(model.rows())


@pytest.fixture(scope="module")
def linear(model, solution):
    return linear_systematic(model, solution)


@pytest.mark.slow
def test_linear_agrees_with_sampled(model, solution, linear):
    sampled = sampled_systematic(model, solution, n_samples=400, seed=3)
    for w in (0, 8, 21):
        one = np.sqrt(np.diag(linear.covariance(STOKES, w)))
        two = np.sqrt(np.diag(sampled.covariance(STOKES, w)))
        np.testing.assert_allclose(two[1:], one[1:], rtol=0.12)


def test_derivatives_of_the_solution_are_exact(model, solution, linear):
    """A step along a direction of the covariance moves the solution by the factor."""
    from astropolcal.calibration.uncertainty.covariance import full_covariance

    axes = full_covariance(model.calibration)._axes()
    flux = np.einsum("bwfs,s->bfw", model.rows()[..., :3], STOKES)
    for r in (0, len(axes.known) // 2):
        step = axes.known[r] * axes.sigmas[r] * axes.steps * model.free.factors() * 1e-2
        ends = [estimator(model.rows(model.free.start() + s * step)).apply(flux) for s in (1, -1)]
        numeric = (ends[0] - ends[1]) / 2e-2
        predicted = np.einsum("wac,c->aw", linear.factor[r], STOKES)
        np.testing.assert_allclose(predicted, numeric, atol=1e-6 * np.abs(predicted).max() + 1e-12)


@pytest.mark.slow
def test_wrong_calibrations_scatter_as_predicted(model, solution, linear):
    """Frames of a true instrument, corrected with the calibrated one."""
    from astropolcal.correction.systematic import _draws

    rng = np.random.default_rng(11)
    sigma = np.stack([np.sqrt(np.diag(linear.covariance(STOKES, w))) for w in range(22)], axis=1)
    pulls = []
    for vector in _draws(model, 400, rng):
        flux = np.einsum("bwfs,s->bfw", model.rows(vector)[..., :3], STOKES)
        pulls.append((solution.apply(flux) - STOKES[:, None])[1:] / sigma[1:])
    pulls = np.array(pulls)
    assert abs(pulls.mean()) < 0.1
    assert abs(pulls.std() - 1) < 0.1
    np.testing.assert_allclose(pulls.std(axis=0), 1, atol=0.2)


def test_errors_between_wavelengths(linear):
    every = linear.between(np.tile(STOKES[:, None], 22))
    for w in (0, 7):
        np.testing.assert_allclose(every[:, w, :, w], linear.covariance(STOKES, w), rtol=1e-9)
    flat = every.reshape(66, 66)
    assert np.linalg.eigvalsh(flat).min() > -1e-12 * flat.max()


def test_they_scale_with_the_light(linear):
    images = STOKES[:, None, None] * np.array([[1.0, 2.0], [3.0, np.nan]])
    found = linear.covariance(images, 4)
    one = linear.covariance(STOKES, 4)
    np.testing.assert_allclose(found[..., 1, 0], 9 * one, rtol=1e-9)
    np.testing.assert_allclose(found[..., 0, 1], 4 * one, rtol=1e-9)


def test_open_directions_are_infinite_or_ignored(open_calibration, track):
    model = RowModel(open_calibration, track()[1], open_calibration.wavelength)
    solution = estimator(model.rows())
    found = linear_systematic(model, solution)
    assert found.is_open
    covariance = found.covariance(STOKES, 9)
    assert np.isinf(covariance[1, 1])
    assert np.isinf(covariance[2, 2])
    assert np.isnan(covariance[1, 2])
    ignored = linear_systematic(model, solution, open_directions="ignore")
    assert not ignored.is_open
    assert 0 < ignored.covariance(STOKES, 9)[1, 1] < 1e-6
    # a known spread along the open directions lies between
    one, two = (
        linear_systematic(model, solution, open_directions=s).covariance(STOKES, 9)[1, 1]
        for s in (1.0, 2.0)
    )
    least = ignored.covariance(STOKES, 9)[1, 1]
    assert one > least
    assert two - least == pytest.approx(4 * (one - least))


def test_samples_know_no_more_of_open_directions(open_calibration, track):
    model = RowModel(open_calibration, track()[1], open_calibration.wavelength)
    solution = estimator(model.rows())
    for choice in ("infinite", 1.0):
        linear = linear_systematic(model, solution, open_directions=choice)
        sampled = sampled_systematic(model, solution, n_samples=100, seed=1, open_directions=choice)
        np.testing.assert_array_equal(sampled.open, linear.open)
        np.testing.assert_allclose(
            np.sqrt(np.diag(sampled.covariance(STOKES, 9)))[1:],
            np.sqrt(np.diag(linear.covariance(STOKES, 9)))[1:],
            rtol=0.2,
        )


def test_samples_that_are_too_narrow_make_errors_that_are_said_to_be_too_small(calibration, track):
    free = calibration.measurement.free
    chain = np.tile(free.start() / free.factors(), (3, 4, 1))
    narrow = {"scatter": "the samples take data as independent"}
    for settings in ({}, narrow):
        posterior = Posterior(free.names, free.units, chain, np.zeros((3, 4)), settings=settings)
        sampled = replace(calibration, posterior=posterior)
        model = RowModel(sampled, track()[1], calibration.wavelength)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            sampled_systematic(model, estimator(model.rows()), n_samples=2, seed=1)
        expected = ["systematic errors are too small: " + narrow["scatter"]] if settings else []
        assert [str(one.message) for one in told] == expected


def test_open_directions_are_counted_in_degrees_of_their_angles(charis, open_calibration, track):
    """Other fits of the same data, each with one angle 0.2 deg away, are wrong by the claim."""
    positions, chain = track()[1], open_calibration.chain
    leads = [d["words"].partition(" by ")[0] for d in open_calibration.identifiability.directions]
    data = open_calibration.measurement.datasets[0].observations
    here = {name: chain[name[:-6]].theta.quantity for name in leads}
    flux, found = None, []
    for moved in (None, *leads):
        fix = {name: angle + 0.2 * (name == moved) * u.deg for name, angle in here.items()}
        fit = calibrate(chain, data, instrument="charis", fix=fix, cross_validate=False)
        model = RowModel(fit, positions, fit.wavelength)
        if flux is None:
            flux = np.einsum("bwfs,s->bfw", model.rows()[..., :3], STOKES)
        found.append(estimator(model.rows()).apply(flux)[:, 9])
    change = np.linalg.norm(np.array(found[1:]) - found[0], axis=0)
    model = RowModel(open_calibration, positions, open_calibration.wavelength)
    solution = estimator(model.rows())
    claimed, least = (
        linear_systematic(model, solution, open_directions=s).covariance(STOKES, 9)
        for s in (0.2, 0.0)
    )
    np.testing.assert_allclose(np.sqrt(np.diag(claimed - least))[1:], change[1:], rtol=0.05)


def test_parameters_without_error_are_listed(linear):
    assert any(name.startswith("m3.") for name in linear.held)
    assert "hwp.w_sio2" not in linear.held


def test_offsets_only_have_errors_of_offsets_only(model, solution):
    found = linear_systematic(model, solution, mode="ip")
    assert not found.factor[..., 1:].any()
    assert found.factor[..., 0].any()


def test_nothing_open_has_finite_errors():
    one = Systematic(np.zeros((0, 2, 3, 3)), np.zeros((2, 3, 3), dtype=bool), "linear")
    assert not one.covariance(STOKES, 1).any()
