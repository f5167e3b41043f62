# Licensed under a 3-clause BSD style license - see LICENSE
"""Robust errors: the truth where residuals are correlated or unequal, by simulation."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration import Calibration, bootstrap, calibrate
from astropolcal.calibration.noise.scatter import Scatter, leave_out_groups
from astropolcal.calibration.noise.weighting import Problem, problem_of, weighting_of
from astropolcal.calibration.uncertainty import derived_retardance, standard_errors
from astropolcal.calibration.uncertainty.covariance import covariance_around
from astropolcal.calibration.uncertainty.refits import robust_covariance
from astropolcal.calibration.validation.cross_validation import cross_validated_residuals
from astropolcal.exceptions import CalibrationFileError, FitError
from astropolcal.measurement import Normal

LAM = [1.2, 1.6, 2.2] * u.um
OPTIONS = {"search": False, "cross_validate": False}


def calibrated(make, n_angles, **options):
    truth = make.truth(make.chain("linear", wavelength=LAM))
    frames = make.frames(np.linspace(45, 132.5, n_angles) * u.deg)
    return calibrate(truth, make.observe(truth, frames, LAM, seed=1), **(OPTIONS | options))


@pytest.fixture(scope="module")
def many(make):
    """24 derotator angles."""
    return calibrated(make, 24)


@pytest.fixture(scope="module")
def few(make):
    """8 derotator angles, as real runs have."""
    return calibrated(make, 8)


def redrawn(cal, noises):
    """For each noise give the calibration new data, fit them, and yield it."""
    live, before = cal.measurement, (cal.measurement.vector(), cal.measurement.observed)
    for noise in noises:
        live.observed = live.predict(before[0]) + noise
        vector = before[0]
        for _ in range(2):
            step = np.linalg.lstsq(live.jacobian(vector).T, live.residuals(vector), rcond=None)[0]
            vector = vector + step
        live.stand_at(vector)
        yield cal
    live.stand_at(before[0])
    live.observed = before[1]


def true_stds(cal, covariance):
    """Errors of an unweighted fit to data of a known covariance."""
    live = cal.measurement
    inverse = np.linalg.pinv(live.jacobian(live.vector()).T)
    return np.sqrt(np.diag(inverse @ covariance @ inverse.T)) / live.free.factors()


def mean_ratio(cal, noises, truth, **options):
    """Root of the mean robust variance over the true one, of each parameter."""
    found = [robust_covariance(c, **options).stds ** 2 for c in redrawn(cal, noises)]
    return np.sqrt(np.mean(found, axis=0)) / truth


# --- the truth, by simulation -----------------------------------------------------------------


@pytest.mark.slow
def test_white_noise_gives_the_ordinary_errors_in_the_mean(few):
    """The correction for leverage is exact here: 120 draws, 5 % each parameter."""
    for block in ["derotator", "pair"]:
        n = few.measurement.n_data
        noises = np.random.default_rng(1).normal(0, 1e-3, (120, n))
        truth = true_stds(few, 1e-6 * np.eye(n))
        ratio = mean_ratio(few, noises, truth, groups=block)
        np.testing.assert_allclose(ratio, 1, atol=0.2)
        assert np.mean(ratio) == pytest.approx(1, abs=0.06), block


def shared(cal, rng, n_draws):
    """Errors that all data at a derotator angle have in common, and their covariance."""
    labels = leave_out_groups(cal.measurement)
    pattern = np.random.default_rng(7).normal(0, 1e-3, cal.measurement.n_data)
    covariance = np.where(labels[:, None] == labels, np.outer(pattern, pattern), 0.0)
    covariance += 1e-7 * np.eye(labels.size)
    common = rng.normal(size=(n_draws, labels.max() + 1))[:, labels] * pattern
    return common + rng.normal(0, np.sqrt(1e-7), common.shape), covariance


@pytest.mark.slow
def test_errors_shared_by_an_angle_are_found(many):
    """Within 12 % in the mean and 35 % each, where the ordinary errors are off by more."""
    noises, covariance = shared(many, np.random.default_rng(3), 100)
    truth = true_stds(many, covariance)
    ratio = mean_ratio(many, noises, truth)
    assert np.mean(ratio) == pytest.approx(1, abs=0.12)
    np.testing.assert_allclose(ratio, 1, atol=0.35)
    level = np.sqrt(np.mean(np.diag(covariance)))
    ordinary = true_stds(many, level**2 * np.eye(len(covariance))) / truth
    assert np.abs(np.log(ordinary)).max() > 2 * np.abs(np.log(ratio)).max()


@pytest.mark.slow
def test_errors_know_a_stage_that_stands_beside_its_angle_at_each_of_few_settings(make):
    """It turns q and u, and hardly changes their size: 60 draws, the polarizer's angle."""
    cal = calibrated(make, 4)
    live, rng = cal.measurement, np.random.default_rng(11)
    labels, (dataset,) = leave_out_groups(live), live.datasets
    slope = dataset.along_stage(live.chains[0], dataset.forward(live.vector()), "derotator")
    spread = np.deg2rad(0.15) * slope
    covariance = np.where(labels[:, None] == labels, np.outer(spread, spread), 0.0)
    noises = rng.normal(size=(60, labels.max() + 1))[:, labels] * spread
    noises = noises + rng.normal(0, 1e-4, noises.shape)
    truth, found = true_stds(cal, covariance + 1e-8 * np.eye(labels.size)), []
    for one in redrawn(cal, noises):
        problem = problem_of(one)
        around, weighting = problem.around(), problem.weighting
        scatter = Scatter.of(live, weighting, around)
        found.append(covariance_around(live, around, weighting, scatter).stds ** 2)
    ratio = np.sqrt(np.mean(found, axis=0)) / truth
    # 0.77 without both, its share and Student's t of three degrees of freedom
    assert 1 < ratio[live.free.names.index("calibration_polarizer.theta")] < 1.55


@pytest.mark.slow
def test_errors_know_a_plate_that_is_wrong_at_each_of_its_own_angles(few):
    """The same in each cycle, which few degrees of freedom tell: 60 draws, all parameters."""
    live, rng = few.measurement, np.random.default_rng(12)
    start, (dataset,) = live.vector(), live.datasets
    slope = dataset.along_stage(live.chains[0], dataset.forward(start), "hwp")
    plate = dataset.observations.position("hwp")[dataset.frames[:, 0]]
    own = np.unique(plate.round(3), return_inverse=True)[1][dataset.group_of_datum]
    noises = np.deg2rad(0.15) * rng.normal(size=(60, own.max() + 1))[:, own] * slope
    pulls = []
    for one in redrawn(few, noises + rng.normal(0, 1e-4, noises.shape)):
        problem = problem_of(one)
        around, weighting = problem.around(), problem.weighting
        scatter = Scatter.of(live, weighting, around)
        stds = covariance_around(live, around, weighting, scatter).stds
        pulls.append((live.vector() - start) / live.free.factors() / stds)
    # 95 % are expected, 33 % without the share of the plate's own angles
    assert np.mean(np.abs(pulls) < 2, axis=0).min() > 0.9


@pytest.mark.slow
def test_one_sigma_covers_where_errors_are_shared(many):
    """Pulls of 100 draws: unit width with robust errors, twice it with ordinary ones."""
    labels = leave_out_groups(many.measurement)
    live, rng = many.measurement, np.random.default_rng(5)
    start = many.measurement.vector()
    slope = live.jacobian(start)[live.free.names.index("calibration_polarizer.theta")]
    # an angle that is wrong for a while
    noises = rng.normal(0, 2e-3, (100, labels.max() + 1))[:, labels] * slope
    noises = noises + rng.normal(0, 1e-4, noises.shape)
    i = live.free.names.index("calibration_polarizer.theta")
    robust, ordinary = [], []
    for cal in redrawn(many, noises):
        shift = (live.vector() - start)[i] / live.free.factors()[i]
        level = np.sqrt(np.sum(cal.residuals**2) / (live.n_data - live.free.size))
        plain = true_stds(cal, level**2 * np.eye(live.n_data))[i]
        robust.append(shift / robust_covariance(cal).stds[i])
        ordinary.append(shift / plain)
    assert np.std(robust) == pytest.approx(1, abs=0.2)
    assert np.std(ordinary) > 1.8


def test_unequal_noise_needs_no_groups(few):
    """White (1980): each datum a group of its own, with noise that the fit knows nothing of."""
    live = few.measurement
    sigma = np.array([1e-3, 2e-3, 5e-3])[live.bins]
    noises = np.random.default_rng(2).normal(0, sigma, (80, live.n_data))
    truth = true_stds(few, np.diag(sigma**2))
    ratio = mean_ratio(few, noises, truth, groups=np.arange(live.n_data))
    # the correction takes the noise to be equal, so it errs on the safe side
    np.testing.assert_allclose(ratio, 1.05, atol=0.2)
    ordinary = true_stds(few, np.mean(sigma**2) * np.eye(live.n_data)) / truth
    assert ordinary.max() > 2
    assert ordinary.min() < 0.7


@pytest.mark.slow
def test_bootstrap_agrees(many):
    """Two estimates of the same from the same residuals, 24 blocks."""
    noises, _ = shared(many, np.random.default_rng(4), 1)
    for cal in redrawn(many, noises):
        ratio = robust_covariance(cal).stds / bootstrap(cal, n=150, seed=1).stds
    assert np.median(ratio) == pytest.approx(1, abs=0.15)
    assert ratio.min() > 0.6
    assert ratio.max() < 1.6


# --- priors, weights, open directions --------------------------------------------------------


def test_weights_do_not_matter_if_they_are_all_the_same(make, few):
    given = calibrated(make, 8, weights=few.measurement.weighting.level)
    np.testing.assert_allclose(
        robust_covariance(given).stds, robust_covariance(few).stds, rtol=1e-3
    )


def test_prior_keeps_its_own_error(make):
    """What the data say nothing of has the error of its prior, by any estimate."""
    chain = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    for name in ("hwp", "derotator"):
        chain[name].theta.prior = Normal(0 * u.deg, 0.1 * u.deg)
    cal = calibrate(chain, make.observe(chain, wavelength=LAM, seed=1), **OPTIONS)
    robust = robust_covariance(cal)
    # exactly, on every processor
    for made in (robust, cal.covariance):
        np.testing.assert_array_equal(made.matrix, made.matrix.T)
    for name in ("hwp.theta", "derotator.theta"):
        assert robust.std(name).to_value(u.deg) == pytest.approx(0.1, rel=0.01)


def test_open_directions_stay_open(make):
    """The covariance can stand in for the calibration's, for all that is derived from it."""
    chain = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    cal = calibrate(chain, make.observe(chain, wavelength=LAM, seed=1), **OPTIONS)
    robust = robust_covariance(cal)
    np.testing.assert_array_equal(np.isnan(robust.stds), np.isnan(cal.covariance.stds))
    # the same directions, of which any basis may come out
    both = np.concatenate([robust.null, cal.covariance.null])
    assert len(robust.null) == np.linalg.matrix_rank(both, tol=1e-6) == 2
    slopes = np.eye(len(robust))[[robust.names.index("hwp.theta")]]
    assert np.isinf(robust.propagate(slopes)[0, 0])
    known = robust.names.index("hwp.w_sio2")
    found = np.sqrt(robust.propagate(np.eye(len(robust))[known]))
    assert found == pytest.approx(robust.stds[known])
    ordinary = derived_retardance(cal, "hwp", 1.6 * u.um).std
    cal.covariance = robust
    assert 0.2 < derived_retardance(cal, "hwp", 1.6 * u.um).std / ordinary < 4


# --- as standard errors ----------------------------------------------------------------------


def test_groups_make_standard_errors_robust(few):
    table = standard_errors(few, groups="derotator")
    assert table.meta == {"method": "robust", "held": [], "groups": "derotator"}
    np.testing.assert_array_equal(table["std"], robust_covariance(few).stds)
    assert standard_errors(few, "robust").meta["groups"] == "derotator"
    given = standard_errors(few, groups=leave_out_groups(few.measurement))
    assert given.meta["groups"] == "as given"
    np.testing.assert_array_equal(given["std"], table["std"])


def test_bad_choices_are_refused(few):
    for options, message in [
        ({"groups": "night"}, "block = 'night'; allowed are derotator, pair"),
        ({"groups": np.zeros(4)}, r"groups of shape \(4,\); allowed is \(96,\), one per datum"),
        ({"groups": np.zeros(96)}, "1 groups for a robust covariance; 3 are needed"),
    ]:
        with pytest.raises(FitError, match=message):
            robust_covariance(few, **options)


def test_other_methods_know_no_groups(few):
    with pytest.raises(FitError, match="method = 'van-holstein' knows no groups"):
        standard_errors(few, "van-holstein", groups="pair")


def test_calibration_from_a_file_has_no_data(few, tmp_path):
    few.write(tmp_path / "cal.asdf")
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        robust_covariance(Calibration.read(tmp_path / "cal.asdf"))


# --- real measurements -----------------------------------------------------------------------


@pytest.mark.long
def test_errors_of_dataset_3_are_those_of_the_bootstrap(charis_fit):
    """Measured: 1.7 times the covariance's, 0.9 times the bootstrap's, in the median."""
    cal = charis_fit(3, "hwp.theta", "derotator.theta")
    robust = robust_covariance(cal).stds
    assert np.nanmedian(robust / standard_errors(cal, "white")["std"]) == pytest.approx(
        1.7, abs=0.2
    )
    ratio = robust / bootstrap(cal, n=60, seed=1).stds
    assert np.nanmedian(ratio) == pytest.approx(0.9, abs=0.2)


@pytest.mark.slow
def test_derotator_angles_left_out_are_predicted_within_the_errors(charis_fit):
    """Errors of the parameters without an angle, and the scatter of its own data, together."""
    for number in (1, 3):
        cal = charis_fit(number)
        model, weighting = cal.measurement, weighting_of(cal)
        whitened = Problem(model, weighting).around()
        (part,) = Scatter(model, weighting, whitened).parts
        applied = part.applied(np.eye(model.n_data))
        middle = sum(s * matrix for s, matrix in zip(part.shares, applied, strict=True))
        scatter = part.amplitude[:, None] * middle * part.amplitude
        held_out = cross_validated_residuals(model)
        slopes, groups, pulls = whitened.rows[:, whitened.live], leave_out_groups(model), []
        for group in np.unique(groups):
            out = groups == group
            inverse = np.linalg.pinv(slopes[~out], rcond=1e-9)
            moved = slopes[out] @ inverse
            variance = np.diag(scatter)[out] + np.diag(
                moved @ scatter[np.ix_(~out, ~out)] @ moved.T
            )
            pulls.append(held_out[out] / np.sqrt(variance))
        width = np.sqrt(np.nanmean(np.concatenate(pulls) ** 2))
        assert 0.8 < width < 1.3, number
