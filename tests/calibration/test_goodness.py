# Licensed under a 3-clause BSD style license - see LICENSE
"""Lack of fit: uniform probabilities where the model is true, tiny ones where it is not."""

import astropy.units as u
import numpy as np
import pytest
from scipy import stats

from astropolcal import optics
from astropolcal.calibration import calibrate
from astropolcal.calibration.noise import (
    noise_from_errors,
    noise_from_null_channel,
    noise_from_replicates,
    noise_from_roughness,
)
from astropolcal.calibration.validation import lack_of_fit
from astropolcal.chain import join
from astropolcal.exceptions import FitError
from astropolcal.measurement import Measurement, Normal
from astropolcal.observations import Observations
from astropolcal.simulation import simulate
from astropolcal.words import p_words

LAM = [1.2, 1.6, 2.2] * u.um
FAINT = {"flux": 1e6, "read_noise": 500.0}


def fit(measurement, weights=1.0, steps=4):
    """Gauss-Newton from the truth, which is close enough."""
    vector = measurement.vector()
    for _ in range(steps):
        slope = measurement.jacobian(vector) * weights
        step = np.linalg.lstsq(slope.T, weights * measurement.residuals(vector), rcond=None)[0]
        vector = vector + step
    return vector


def at(measurement, vector):
    """Return a measurement that stands at other values."""
    new = measurement.copy()
    new.stand_at(vector)
    return new


def draw(measurement, rng, sigma=None):
    """Give the measurement new data: its model at its current values, and noise."""
    sigma = measurement.sigma if sigma is None else sigma
    measurement.observed = measurement.predict(measurement.vector()) + rng.normal(0, sigma)


def uniform(p):
    """Probability of the values, were they uniform (Kolmogorov and Smirnov)."""
    return stats.kstest(p, "uniform").pvalue


# --- known noise --------------------------------------------------------------------


@pytest.mark.slow
def test_probabilities_are_uniform_for_a_true_model(measurement):
    """Monte Carlo, 120 runs; a fit with equal weights is not the best one and yet calibrated."""
    for weighted in [True, False]:
        m, rng = measurement.copy(), np.random.default_rng(7)
        sigma = m.sigma * np.array([1.0, 2.0, 1.0])[m.bins]
        m.sigma = sigma
        weights = 1 / sigma if weighted else np.ones(m.n_data)
        total, single = [], []
        for _ in range(120):
            draw(m, rng, sigma)
            test = lack_of_fit(m, fit(m, weights), weights=weights)
            total.append(test.p_value)
            single.append(test.table["p_value"][2])
        assert uniform(total) > 0.01, weighted
        assert uniform(single) > 0.01, weighted


def test_expected_chi_square_by_hand(measurement):
    """Best weights: n - rank in all, and the leverages' sum in each wavelength."""
    weights = 1 / measurement.sigma
    test = lack_of_fit(measurement, weights=weights)
    slope = (measurement.jacobian(measurement.vector()) * weights).T
    hat = slope @ np.linalg.pinv(slope)
    assert test.expected == pytest.approx(96 - np.linalg.matrix_rank(slope))
    assert test.expected == pytest.approx(96 - measurement.free.size)
    for b, expected in enumerate(test.table["expected"]):
        row = measurement.bins == b
        assert expected == pytest.approx(row.sum() - np.trace(hat[np.ix_(row, row)]))
    np.testing.assert_allclose(test.table["expected"].sum(), test.expected)
    chi2 = np.sum((measurement.residuals() * weights) ** 2)
    assert test.chi2 == pytest.approx(chi2)
    assert test.p_value == pytest.approx(stats.chi2.sf(chi2, test.expected))


def test_effective_freedom_by_brute_force(measurement):
    """Equal weights, unequal noise: mean and variance of chi-square from the full matrices."""
    sigma = measurement.sigma * np.array([1.0, 5.0, 1.0])[measurement.bins]
    m = measurement.copy()
    m.sigma = sigma
    slope = m.jacobian(m.vector()).T
    a = (np.eye(96) - slope @ np.linalg.pinv(slope)) * sigma / sigma[:, None]
    table = lack_of_fit(m).table
    for b in range(3):
        row = m.bins == b
        c = a[row] @ a[row].T
        assert table["expected"][b] == pytest.approx(np.trace(c))
        assert table["dof"][b] == pytest.approx(np.trace(c) ** 2 / np.trace(c @ c))


def test_degenerate_parameters_count_once(make):
    """With polarizer, plate and derotator free to turn, the rank counts, not the parameters."""
    truth = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    m = Measurement(truth, make.observe(truth, wavelength=LAM, seed=1))
    rank = np.linalg.matrix_rank(m.jacobian(m.vector()), tol=1e-9)
    assert rank < m.free.size
    test = lack_of_fit(m, weights=1 / m.sigma)
    assert test.expected == pytest.approx(m.n_data - rank)


def test_parameter_at_its_bound_is_not_counted(make, chain):
    truth = chain.copy()
    truth["wollaston"].efficiency = np.ones(3)
    m = Measurement(truth, make.observe(truth, wavelength=LAM, seed=1))
    test = lack_of_fit(m, weights=1 / m.sigma)
    assert test.expected == pytest.approx(96 - (m.free.size - 3))


def test_data_that_were_not_fitted_have_all_their_freedom(make, chain, measurement):
    cal = calibrate(chain, measurement.datasets[0].observations, cross_validate=False)
    new = cal.measurement_of(make.observe(chain, wavelength=LAM, seed=2))
    test = lack_of_fit(new, cal)
    assert test.expected == 96
    np.testing.assert_allclose(test.table["dof"], 32)
    assert test.chi2 == lack_of_fit(new, fitted=False).chi2


def test_calibration_brings_its_weights(chain, measurement):
    data = measurement.datasets[0].observations
    cal = calibrate(chain, data, weights="errors", cross_validate=False)
    m = cal.measurement
    same = lack_of_fit(m, m.vector(), weights=1 / m.sigma)
    assert lack_of_fit(m, cal).p_value == same.p_value
    assert same.p_value > 0.01
    assert "agree with the noise" in same.words


def test_wrong_model_is_found(make):
    """A linear derotator fitted to data of an elliptical one, by stated noise and replicates."""
    truth = make.truth(make.chain("elliptical", wavelength=LAM))
    twice = np.repeat([45, 70, 95, 120], 2) * u.deg
    data = make.observe(truth, make.frames(twice), LAM, seed=3)
    cal = calibrate(make.chain(wavelength=LAM), data, cross_validate=False)
    test = lack_of_fit(cal.measurement, cal)
    assert test.p_value < 1e-12
    assert (test.table["p_value"] < 1e-12).all()
    assert "the model misses something" in test.words
    test = lack_of_fit(cal.measurement, cal, noise_from_replicates(cal.measurement))
    assert test.p_value < 1e-12


def test_errors_that_stand_on_a_noise_given_are_held_against_it(chain, measurement):
    data = measurement.datasets[0].observations
    for factor, agrees in ((1.0, True), (0.1, False)):
        noise = factor * measurement.sigma
        cal = calibrate(chain, data, weights=noise, errors="white", cross_validate=False)
        test = cal.fit["lack_of_fit"][0]
        assert test["noise"] == "given"
        assert (0.8 < test["times_noise"] < 1.2) == agrees
        assert (not cal.verdict().cautions) == agrees


def test_overestimated_noise_is_told(measurement):
    m = measurement.copy()
    m.sigma = 3 * m.sigma
    test = lack_of_fit(m)
    assert test.p_value > 0.99
    assert "overestimated" in test.words


# --- estimated noise ----------------------------------------------------------------


@pytest.mark.slow
def test_f_test_with_the_null_channel_is_calibrated(make, chain):
    """Monte Carlo, 50 runs of faintly polarized light, whose noise is the same in all data."""
    source = optics.Diattenuator(diattenuation=0.2, fixed={"diattenuation": True}, name="source")
    faint = join([source, *list(chain)[1:]])
    total, single = [], []
    for seed in range(50):
        m = Measurement(faint, simulate(faint, LAM, make.frames(), seed=seed, **FAINT))
        vector = fit(m)
        test = lack_of_fit(m, vector, noise_from_null_channel(at(m, vector)))
        total.append(test.p_value)
        single.append(test.table["p_value"][0])
        assert test.table["dof_noise"][0] == 23
    assert uniform(total) > 0.01
    assert uniform(single) > 0.01


@pytest.mark.slow
def test_f_test_with_replicates_is_calibrated(make, chain):
    """Monte Carlo, 80 runs: the classical test of lack of fit against pure error."""
    twice = np.repeat([45, 70, 95, 120], 2) * u.deg
    m = Measurement(chain, make.observe(chain, make.frames(twice), LAM, seed=1))
    rng, total, single = np.random.default_rng(3), [], []
    for _ in range(80):
        draw(m, rng, np.full(m.n_data, 1e-4))
        vector = fit(m)
        test = lack_of_fit(m, vector, noise_from_replicates(at(m, vector)))
        total.append(test.p_value)
        single.append(test.table["p_value"][1])
    # one noise a wavelength is estimated, but the fit has equal weights
    assert test.expected == pytest.approx(96 - m.free.size - 3 * 16, abs=1)
    assert uniform(total) > 0.01
    assert uniform(single) > 0.01


# --- priors --------------------------------------------------------------------------


def with_priors(chain, **priors):
    chain = chain.copy()
    for name, prior in priors.items():
        optic, key = name.split("__")
        getattr(chain[optic], key).prior = prior
    return chain


def fit_with_priors(measurement, vector, weights, level, steps=5):
    """Gauss-Newton on data and priors."""
    free = measurement.free
    for _ in range(steps):
        slope = np.hstack(
            [measurement.jacobian(vector) * weights, free.prior_jacobian(vector) * level]
        )
        residual = np.append(
            weights * measurement.residuals(vector), -level * free.prior_residuals(vector)
        )
        vector = vector + np.linalg.lstsq(slope.T, residual, rcond=None)[0]
    return vector


@pytest.mark.slow
def test_probabilities_are_uniform_with_priors_that_are_true(chain, measurement):
    """Monte Carlo, 200 runs: truths drawn from the priors, which are as narrow as the data."""
    data = measurement.datasets[0].observations
    priors = {"wollaston__efficiency": Normal(0.95, 1e-4)}
    priors["calibration_polarizer__theta"] = Normal(90 * u.deg, 0.01 * u.deg)
    m, rng = Measurement(with_priors(chain, **priors), data), np.random.default_rng(2)
    centre, slot = m.vector(), m.free.by_name["wollaston.efficiency"].slice
    total, alone, of_priors = [], [], []
    for _ in range(80):
        truth = centre.copy()
        truth[slot] = rng.normal(0.95, 1e-4, 3)
        truth[m.free.by_name["calibration_polarizer.theta"].start] = rng.normal(
            np.deg2rad(90), np.deg2rad(0.01)
        )
        m.observed = m.predict(truth) + rng.normal(0, m.sigma)
        test = lack_of_fit(m, fit_with_priors(m, truth, 1 / m.sigma, 1.0), weights=1 / m.sigma)
        total.append(test.p_value)
        alone.append(test.table["p_value"][1])
        of_priors.append(test.priors["p_value"])
    # four priors are four data more
    assert test.expected == pytest.approx(m.n_data + 4 - m.free.size)
    assert 0.5 < test.priors["expected"] < 3.5
    for p in (total, alone, of_priors):
        assert uniform(p) > 0.01


def test_a_narrow_prior_leaves_its_freedom_to_the_data(chain, measurement):
    """As if the parameter were fixed; and a broad one as if it were not there."""
    data = measurement.datasets[0].observations
    start = measurement.free.by_name["calibration_polarizer.theta"].start
    value = np.rad2deg(measurement.vector()[start]) * u.deg
    for std, taken in ((1e-7, 0), (30, 1)):
        prior = {"calibration_polarizer__theta": Normal(value, std * u.deg)}
        m = Measurement(with_priors(chain, **prior), data)
        test = lack_of_fit(m, weights=1 / m.sigma)
        of_data = sum(test.table["expected"])
        assert of_data == pytest.approx(m.n_data - (m.free.size - 1) - taken, abs=1e-3)
        # what a narrow prior loses the data gain, so that all together stays the same
        assert of_data + test.priors["expected"] == pytest.approx(test.expected)
        assert test.expected == pytest.approx(m.n_data + 1 - m.free.size)


def test_a_prior_that_only_chooses_the_gauge_adds_nothing(make):
    truth = make.truth(make.chain("elliptical", fixed=False, wavelength=LAM))
    priors = {f"{name}__theta": Normal(0 * u.deg, 1 * u.deg) for name in ("hwp", "derotator")}
    data = make.observe(truth, wavelength=LAM, seed=1)
    plain, gauged = (
        calibrate(c, data, weights="errors", search=False, cross_validate=False)
        for c in (truth, with_priors(truth, **priors))
    )
    tests = [lack_of_fit(cal.measurement, cal) for cal in (plain, gauged)]
    assert tests[1].expected == pytest.approx(tests[0].expected, abs=0.02)
    assert tests[1].chi2 == pytest.approx(tests[0].chi2, rel=1e-2)
    assert tests[0].priors is None
    assert tests[1].priors["expected"] < 0.02


def test_a_wrong_prior_is_found(make, chain):
    """Known noise and the null channel alike: the data overrule the prior, and the words say so."""
    data = make.observe(chain, wavelength=LAM, seed=1)
    wrong = with_priors(chain, calibration_polarizer__theta=Normal(89 * u.deg, 0.1 * u.deg))
    cal = calibrate(wrong, data, weights="errors", search=False, cross_validate=False)
    m = cal.measurement
    for noise in (noise_from_errors(m), noise_from_null_channel(m, null_model="smooth")):
        test = lack_of_fit(m, cal, noise)
        assert test.priors["p_value"] < 1e-6
        assert test.p_value < 1e-6
        assert (
            f"({p_words(test.p_value)}); the data disagree with the priors "
            f"({p_words(test.priors['p_value'])}); noise: "
        ) in test.words
    found = cal.fit["lack_of_fit"][0]["words"]
    assert "the data disagree with the priors" in found


def test_new_data_do_not_count_the_priors(make, chain):
    """They are no part of what is predicted."""
    wrong = with_priors(chain, calibration_polarizer__theta=Normal(89 * u.deg, 0.1 * u.deg))
    data = make.observe(chain, wavelength=LAM, seed=1)
    cal = calibrate(wrong, data, weights="errors", search=False, cross_validate=False)
    test = lack_of_fit(cal.measurement_of(make.observe(chain, wavelength=LAM, seed=2)), cal)
    assert test.priors is None
    assert test.expected == 96


# --- what cannot be tested ----------------------------------------------------------


def test_no_freedom_left_gives_nan(make, chain):
    data = make.observe(chain, make.frames([45] * u.deg), LAM, seed=1)
    m = Measurement(chain, data.select(data.pairs()[:2].ravel()))
    assert m.n_data < m.free.size
    test = lack_of_fit(m, weights=1 / m.sigma)
    assert np.isnan(test.p_value)
    assert "no test" in test.words


def test_noise_of_another_measurement_is_refused(make, chain, measurement):
    other = Measurement(chain, make.observe(chain, make.frames([45] * u.deg), LAM, seed=1))
    with pytest.raises(FitError, match="the noise is that of 12 data, the measurement has 96"):
        lack_of_fit(measurement, noise=noise_from_errors(other))


# --- real measurements --------------------------------------------------------------


@pytest.mark.slow
def test_charis_residuals_are_no_noise(charis_fit):
    """Measured: 73 and 36 times the stated noise, and above the null channel's upper limit."""
    for number, low, high in [(1, 60, 85), (3, 30, 42)]:
        cal = charis_fit(number)
        test = lack_of_fit(cal.measurement, cal)
        assert low < np.sqrt(test.chi2 / test.expected) < high, (number, low, high)
        assert (test.table["p_value"] < 1e-12).all(), (number, low, high)
        null = noise_from_null_channel(cal.measurement, null_model="smooth")
        assert lack_of_fit(cal.measurement, cal, null).p_value < 1e-12, (number, low, high)


def test_verdicts_hold_where_wavelengths_share_their_noise_and_none_is_stated(make):
    """A true model agrees with flicker of all wavelengths, and with photons of uneven spectra."""
    lam = make.charis.wavelength
    chain = make.truth(make.chain(wavelength=lam))
    frames = make.frames(np.repeat([50, 65, 80], 3) * u.deg)
    spectrum = 1e7 * np.exp(-0.5 * np.linspace(-2, 2, lam.size) ** 2)
    sharing, bare, rng = [], [], np.random.default_rng(5)
    for seed in range(24):
        table = simulate(chain, lam, frames, flux=spectrum, seed=seed).to_table()
        table.remove_columns(["flux_right_err", "flux_left_err"])
        plain = Measurement(chain, Observations.from_table(table, name="photons"))
        vector = fit(plain)
        bare.append(lack_of_fit(plain, vector, noise_from_roughness(at(plain, vector))).p_value)
        flicker = np.repeat(rng.normal(0, 2e-3, len(frames)), lam.size)
        table["flux_right"] = table["flux_right"] * (1 + flicker)
        table["flux_left"] = table["flux_left"] * (1 - flicker)
        m = Measurement(chain, Observations.from_table(table, name="flicker"))
        vector = fit(m)
        for noise in (noise_from_replicates, noise_from_null_channel):
            sharing.append(lack_of_fit(m, vector, noise(at(m, vector))).p_value)
    for found in (bare, sharing):
        found = np.array(found)
        assert np.mean((found < 0.01) | (found > 0.99)) < 0.1
