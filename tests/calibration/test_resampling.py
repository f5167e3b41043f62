# Licensed under a 3-clause BSD style license - see LICENSE
"""The block bootstrap: right where the noise is white, larger where it is not."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration import Calibration, bootstrap, calibrate
from astropolcal.calibration.noise.weighting import Problem, problem_of
from astropolcal.calibration.uncertainty import standard_errors
from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.calibration.uncertainty.refits import Resampled
from astropolcal.exceptions import AstropolcalWarning, CalibrationFileError, FitError
from astropolcal.measurement import Normal
from astropolcal.observations import Observations

LAM = [1.2, 1.6, 2.2] * u.um
MANY = np.linspace(45, 132.5, 24) * u.deg


def calibrated(make, kind="linear", fixed=True, angles=MANY, data=None, **options):
    truth = make.truth(make.chain(kind, fixed=fixed, wavelength=LAM))
    if data is None:
        data = make.observe(truth, make.frames(angles), LAM, seed=1)
    options = {"search": False, "errors": "white", "cross_validate": False} | options
    return calibrate(truth, data, **options)


@pytest.fixture(scope="module")
def white(make):
    """24 derotator angles with photon noise only."""
    return calibrated(make)


def shifted(make, amount=0.5 * u.deg, seed=3):
    """The same, but the derotator stood somewhat wrong at each angle: errors in blocks."""
    truth = make.truth(make.chain("linear", wavelength=LAM))
    frames = make.frames(MANY)
    rng = np.random.default_rng(seed)
    error = np.repeat(rng.normal(0, amount.value, len(MANY)), 8) * amount.unit
    moved = frames.copy()
    moved["derotator"] = frames["derotator"] + error
    table = make.observe(truth, moved, LAM, seed=seed).to_table()
    table["derotator"] = np.repeat(frames["derotator"], len(LAM))
    return calibrated(make, data=Observations.from_table(table))


# --- what it should give ------------------------------------------------------------------


@pytest.mark.slow
def test_white_noise_gives_the_errors_of_the_covariance(white):
    """150 resamples: 6 % for each; a sandwich of 24 blocks scatters by 15 % more."""
    for block in ["derotator", "pair"]:
        made = bootstrap(white, n=150, block=block, seed=2)
        ratio = made.stds / white.covariance.stds
        assert np.median(ratio) == pytest.approx(1.0, abs=0.2), block
        assert ratio.min() > 0.5, block
        assert ratio.max() < 1.7, block


@pytest.mark.slow
def test_errors_in_blocks_are_noticed(make):
    """An angle wrong for a whole cycle: pairs are not independent, and cycles say so."""
    cal = shifted(make)
    names = cal.covariance.names
    i = names.index("calibration_polarizer.theta")
    blocks, pairs = (bootstrap(cal, 100, block, seed=4).stds[i] for block in ("derotator", "pair"))
    assert blocks > 1.4 * cal.covariance.stds[i]
    assert blocks > 1.2 * pairs


@pytest.mark.slow
def test_mean_of_the_samples_is_the_calibration(white):
    made = bootstrap(white, n=100, seed=5)
    solution = white.measurement.vector() / white.measurement.free.factors()
    np.testing.assert_array_less(np.abs(made.samples.mean(axis=0) - solution), 0.6 * made.stds)


def test_every_datum_once_is_the_calibration(white):
    """The refit itself: with all counts one it stays where it is."""
    refit = problem_of(white)
    vector, chi2, arrived = refit.fit(refit.solution, np.ones(white.measurement.n_data))
    assert arrived
    factors = white.measurement.free.factors()
    moved = np.abs(vector - refit.solution) / factors
    assert (moved < 1e-2 * white.covariance.stds).all()
    assert chi2 == pytest.approx(np.sum(white.residuals**2))


def test_a_datum_that_counts_twice_is_two_data(white, make):
    """Counts of two everywhere leave the solution and double chi-square."""
    refit = problem_of(white)
    vector, chi2, _ = refit.fit(refit.solution, np.full(white.measurement.n_data, 2.0))
    moved = np.abs(vector - refit.solution) / white.measurement.free.factors()
    assert (moved < 1e-2 * white.covariance.stds).all()
    assert chi2 == pytest.approx(2 * np.sum(white.residuals**2))


def test_derivative_of_the_refit(make):
    """With priors and weights, against central differences."""
    truth = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    truth["hwp"].theta.prior = Normal(0 * u.deg, 0.1 * u.deg)
    data = make.observe(truth, make.frames(), LAM, seed=1)
    cal = calibrate(truth, data, weights="errors", search=False, cross_validate=False)
    refit = problem_of(cal)
    jacobian = refit.jacobian(refit.solution, refit.weights)
    assert jacobian.shape == (cal.measurement.n_data + 1, cal.measurement.free.size)
    for i in range(cal.measurement.free.size):
        step = np.zeros(cal.measurement.free.size)
        step[i] = 1e-5
        ends = [refit.residuals(refit.solution + s * step, refit.weights) for s in (1, -1)]
        np.testing.assert_allclose(
            (ends[0] - ends[1]) / 2e-5,
            jacobian[:, i],
            rtol=1e-4,
            atol=1e-5 * np.abs(jacobian).max(),
        )


def test_same_seed_same_samples(white):
    first, second, other = (bootstrap(white, 5, seed=seed).samples for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - other).max() > 0


def test_calibration_is_left_alone(white):
    before = white.measurement.vector()
    bootstrap(white, 3, seed=1)
    np.testing.assert_array_equal(white.measurement.vector(), before)


# --- rank, blocks, bounds -----------------------------------------------------------------


def test_undetermined_parameters_have_no_spread(make):
    """The fitter's steps along an open direction are small; that is no error."""
    cal = calibrated(make, "elliptical", fixed=False, angles=np.linspace(45, 132.5, 8) * u.deg)
    made = bootstrap(cal, n=12, seed=1)
    known = np.isfinite(cal.covariance.stds)
    assert not known.all()
    assert np.isfinite(made.stds[known]).all()
    assert np.isnan(made.stds[~known]).all()
    assert np.isnan(made.interval()[0][~known]).all()


def test_priors_are_drawn_too(make):
    """What rests on a prior alone spreads as this does."""
    start = make.truth(make.chain("linear", fixed=False, wavelength=LAM))
    start["wollaston"].theta.fixed = False
    start["wollaston"].theta.prior = Normal(0 * u.deg, 0.5 * u.deg)
    data = make.observe(start, make.frames(MANY[::4]), LAM, seed=1)
    cal = calibrate(start, data, search=False, errors="white", cross_validate=False)
    i = cal.covariance.names.index("wollaston.theta")
    assert cal.parameters["status"][i] == "by priors"
    assert 0.3 < bootstrap(cal, n=30, seed=1).stds[i] < 0.7


def test_every_dataset_keeps_its_number_of_blocks(make):
    truth = make.truth(make.chain("linear", wavelength=LAM))
    one = make.observe(truth, make.frames([45, 80, 110] * u.deg), LAM, seed=1)
    two = make.observe(truth, make.frames([50, 65, 80, 95] * u.deg), LAM, seed=2)
    cal = calibrate([truth, truth], [one, two], search=False, cross_validate=False)
    with pytest.warns(AstropolcalWarning) as told:
        made = bootstrap(cal, 5, seed=1)
    # of three and of four blocks 50 to 60 of 100 intervals of 68 % held the truth
    assert len(told) == 2
    assert "3 derotator blocks; of fewer than 6 errors are rough" in str(told[0].message)
    assert made.n_blocks == 7
    assert bootstrap(cal, 5, "pair", seed=1).n_blocks == 28


def test_bounds_are_kept(make):
    truth = make.truth(make.chain("linear", wavelength=LAM))
    data = make.observe(truth, wavelength=LAM, seed=1)
    truth["wollaston"].efficiency.bounds = (0, 0.965)
    truth["wollaston"].efficiency = [0.96, 0.965, 0.965]
    cal = calibrate(truth, data, errors="white", search=False, cross_validate=False)
    made = bootstrap(cal, 10, seed=1)
    columns = [i for i, name in enumerate(made.names) if name.startswith("wollaston")]
    assert made.samples[:, columns].max() <= 0.965 + 1e-12


# --- the result ---------------------------------------------------------------------------


def test_statistics_of_the_samples():
    rng = np.random.default_rng(0)
    samples = rng.multivariate_normal([1, 2], [[4, 1], [1, 1]], size=4000)
    made = Resampled(["a.theta", "b.x"], [u.deg, None], samples, "pair", 8, 0)
    np.testing.assert_allclose(made.stds, np.std(samples, axis=0, ddof=1))
    assert isinstance(made.covariance, Covariance)
    np.testing.assert_allclose(made.covariance.matrix, np.cov(samples.T))
    low, high = made.interval()
    np.testing.assert_allclose((high - low) / 2, [2, 1], rtol=0.06)
    wide = made.interval(0.95)
    assert (wide[0] < low).all()
    assert (wide[1] > high).all()
    assert repr(made) == "<Resampled: 4000 bootstrap resamples of 8 pair blocks, 2 parameters>"
    with pytest.raises(FitError, match="level = 1"):
        made.interval(1)


# --- bad input ----------------------------------------------------------------------------


def test_bad_options_are_refused(white):
    for options, message in [
        ({"block": "night"}, "block = 'night'; allowed are derotator, pair"),
        ({"n": 1}, "n = 1"),
        ({"n": np.nan}, "n = nan; .* whole number"),
    ]:
        with pytest.raises(FitError, match=message):
            bootstrap(white, **options)


def test_too_few_blocks_are_refused(make):
    cal = calibrated(make, angles=[45, 80] * u.deg)
    # the name of a dataset may hold anything
    cal.measurement.datasets[0].observations.name = "night {a}"
    with pytest.raises(FitError, match=r"^night \{a\} has 2 derotator blocks; 3 are needed"):
        bootstrap(cal)


def test_blocks_that_do_not_determine_the_model_are_refused(make, monkeypatch):
    """If hardly any resample can be fitted there is an error, not an endless loop."""
    cal = calibrated(make, angles=[45, 60, 80] * u.deg)
    failed = (cal.measurement.vector(), 0.0, SimpleNamespace(success=False))
    monkeypatch.setattr(Problem, "fit", lambda *arguments, **options: failed)
    with pytest.raises(FitError, match="too few blocks"), pytest.warns(match="3 derotator blocks"):
        bootstrap(cal, 3, seed=1)


def test_calibration_from_a_file_has_no_data(white, tmp_path):
    white.write(tmp_path / "cal.asdf")
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        bootstrap(Calibration.read(tmp_path / "cal.asdf"))


# --- real data ----------------------------------------------------------------------------


@pytest.mark.long
def test_errors_of_the_real_fit_are_those_of_the_bootstrap(charis_fit):
    """Dataset 3: the residuals are no white noise, and cycles tell by how much, 1.8 times."""
    cal = charis_fit(3, "hwp.theta", "derotator.theta")
    made = bootstrap(cal, n=40, seed=1)
    assert np.nanmedian(made.stds / cal.covariance.stds) == pytest.approx(1.0, abs=0.3)
    white = standard_errors(cal, "white")["std"]
    assert np.nanmedian(made.stds / white) == pytest.approx(1.8, abs=0.5)
