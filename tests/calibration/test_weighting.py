# Licensed under a 3-clause BSD style license - see LICENSE
"""One noise for fit, errors and sampler, for every choice of weights."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration import Calibration, bootstrap, calibrate, profile
from astropolcal.calibration.noise import noise_from_errors, noise_from_null_channel
from astropolcal.calibration.noise.weighting import (
    Weighting,
    noise_of,
    problem_of,
    weighting_of,
)
from astropolcal.calibration.posterior import LogPosterior
from astropolcal.calibration.validation import lack_of_fit
from astropolcal.converters.calibration import content_hash
from astropolcal.exceptions import (
    AstropolcalWarning,
    CalibrationFileError,
    FitError,
    ParameterError,
)
from astropolcal.measurement import Measurement, Normal
from astropolcal.observations import Observations

LAM = [1.2, 1.6, 2.0, 2.2] * u.um
LEVELS = np.array([0.0005, 0.002, 0.002, 0.006])
CHOICES = (None, "wavelength", "errors", 0.002)


@pytest.fixture(scope="module")
def truth(make):
    chain = make.truth(make.chain(wavelength=LAM))
    # away from 1, so that noise does not turn the flux of a beam negative
    chain["wollaston"].efficiency = np.full(4, 0.9)
    return chain


def unequal(make, truth, seed, levels=LEVELS, frames=None):
    """Data as noisy as LEVELS: all of a wavelength alike, the wavelengths not."""
    table = make.observe(truth, frames, LAM, noise=False).to_table()
    right, left = (np.asarray(table[f"flux_{beam}"]) for beam in ("right", "left"))
    total, difference = right + left, (right - left) / (right + left)
    level = levels[np.asarray(table["bin"])]
    noisy = difference + np.random.default_rng(seed).normal(0, np.sqrt(2) * level)
    for beam, sign in (("right", 1), ("left", -1)):
        table[f"flux_{beam}"] = total * (1 + sign * noisy) / 2
        table[f"flux_{beam}_err"] = total * level / np.sqrt(1 + difference**2)
    return Observations.from_table(table)


@pytest.fixture(scope="module")
def data(make, truth):
    return unequal(make, truth, 1)


def fit(truth, data, weights=None, **options):
    options = {"search": False, "cross_validate": False} | options
    return calibrate(truth, data, weights=weights, **options)


@pytest.fixture(scope="module")
def fitted(truth, data):
    return {choice: fit(truth, data, choice, errors="white") for choice in CHOICES}


def draw(measurement, rng, sigma):
    """Give the measurement new data: its model at its current values, and noise."""
    measurement.observed = measurement.predict(measurement.vector()) + rng.normal(0, sigma)


# --- every choice -------------------------------------------------------------------------


def test_one_level_is_the_scatter_of_all_residuals(fitted):
    cal = fitted[None]
    noise = weighting_of(cal)
    freedom = cal.measurement.n_data - cal.identifiability.rank
    expected = np.sqrt(np.sum(cal.residuals**2) / freedom)
    assert noise.weight is None
    np.testing.assert_allclose(noise.sigma, expected)
    assert noise.level == noise.sigma[0]


def test_errors_of_the_table_are_taken_as_they_are(fitted):
    noise = weighting_of(fitted["errors"])
    np.testing.assert_array_equal(noise.sigma, fitted["errors"].measurement.sigma)
    np.testing.assert_array_equal(noise.weight, 1 / noise.sigma)
    assert noise.level == 1


def test_one_level_a_wavelength_agrees_with_the_residuals_of_its_own_fit(fitted):
    """The fixed point: sum r^2 over sum (1 - h), with the leverages of the weighted fit."""
    cal = fitted["wavelength"]
    live, noise = cal.measurement, weighting_of(cal)
    slopes = (live.jacobian(live.vector()) * noise.weight).T
    spare = 1 - np.sum(np.linalg.qr(slopes)[0] ** 2, axis=1)
    for b in range(4):
        row = live.bins == b
        expected = np.sqrt(np.sum(cal.residuals[row] ** 2) / spare[row].sum())
        np.testing.assert_allclose(noise.sigma[row], expected, rtol=0.01)
    assert spare.sum() == pytest.approx(live.n_data - live.free.size)


def test_the_weighted_fit_is_a_minimum_of_the_weighted_residuals(fitted):
    cal = fitted["wavelength"]
    live, weight = cal.measurement, weighting_of(cal).weight
    slopes = (live.jacobian(live.vector()) * weight).T
    step = np.linalg.lstsq(slopes, cal.residuals * weight, rcond=None)[0]
    stds = cal.covariance.stds * live.free.factors()
    assert np.abs(step / stds).max() < 0.01


@pytest.mark.slow
def test_levels_of_the_wavelengths_are_recovered(make, truth):
    """Ten runs of 28 degrees of freedom a wavelength: 4 % in the mean."""
    found = []
    for seed in range(10):
        cal = fit(truth, unequal(make, truth, seed), "wavelength")
        sigma = weighting_of(cal).sigma
        found.append([sigma[cal.measurement.bins == b][0] for b in range(4)] / LEVELS)
    np.testing.assert_allclose(np.mean(found, axis=0), 1.0, atol=0.15)
    np.testing.assert_allclose(cal.measurement.sigma, LEVELS[cal.measurement.bins], rtol=0.05)


@pytest.mark.slow
def test_levels_are_unbiased(truth, data):
    """Restricted maximum likelihood, 150 draws; without leverages it were 0.92 and less."""
    live, rng = Measurement(truth, data), np.random.default_rng(5)
    sigma = LEVELS[live.bins]
    vector, squares = live.vector(), []
    for _ in range(150):
        draw(live, rng, sigma)
        noise = noise_of(live, "wavelength")
        for _ in range(2):
            slopes = (live.jacobian(live.vector()) * noise.weight).T
            step = np.linalg.lstsq(slopes, live.residuals() * noise.weight, rcond=None)[0]
            live.stand_at(live.vector() + step)
            noise = noise_of(live, "wavelength")
        squares.append([(noise.sigma[live.bins == b][0]) ** 2 for b in range(4)])
        live.stand_at(vector)
    error = np.sqrt(2 / 29 / 150)
    np.testing.assert_allclose(np.mean(squares, axis=0) / LEVELS**2, 1, atol=4 * error)


@pytest.mark.long
def test_errors_are_right_where_wavelengths_are_unequally_noisy(make, truth):
    """24 runs of 11 parameters: the pulls have unit width, also where one level weighted all."""
    pulls = {None: [], "wavelength": []}
    for seed in range(24):
        observed = unequal(make, truth, seed)
        for choice, found in pulls.items():
            cal = fit(truth, observed, choice)
            start = Measurement(truth, observed).vector()
            stds = cal.covariance.stds * cal.measurement.free.factors()
            found.append((cal.measurement.vector() - start) / stds)
    for choice, found in pulls.items():
        width = np.std(found, axis=0)
        assert np.mean(width) == pytest.approx(1, abs=0.1), choice
        assert width.max() < 1.5, choice


def test_the_weighted_fit_is_the_better_one(fitted):
    """Parameters of the quiet wavelengths profit most."""
    stds = {c: fitted[c].covariance.stds for c in ("wavelength", "errors")}
    np.testing.assert_allclose(stds["wavelength"], stds["errors"], rtol=0.4)


def test_datasets_have_levels_of_their_own(make, truth):
    pair = [make.observe(truth, wavelength=LAM, seed=i, flux=f) for i, f in enumerate((1e7, 1e5))]
    cal = fit([truth, truth], pair, "wavelength")
    noise = weighting_of(cal)
    first, second = (noise.sigma[segment] for segment in cal.measurement.segments)
    assert second.min() > 5 * first.max()
    assert len(np.unique(noise.sigma)) == 8


def test_both_strategies_know_it(truth, data, fitted):
    for strategy in ["joint", "two-step"]:
        cal = fit(truth, data, "wavelength", strategy=strategy)
        assert cal.converged, strategy
        ratio = weighting_of(cal).sigma / weighting_of(fitted["wavelength"]).sigma
        # the two-step fit is not the minimum
        np.testing.assert_allclose(ratio, 1, atol={"joint": 1e-6, "two-step": 0.3}[strategy])


# --- noise that is given ------------------------------------------------------------------


def test_noise_given_as_it_is_in_the_table_gives_the_same_fit(truth, data, fitted):
    sigma = fitted["errors"].measurement.sigma
    for noise in (sigma, sigma * u.one, noise_from_errors(fitted["errors"].measurement)):
        cal = fit(truth, data, noise, errors="white")
        assert cal.settings["weights"] == "given"
        np.testing.assert_array_equal(
            cal.measurement.vector(), fitted["errors"].measurement.vector()
        )
        np.testing.assert_array_equal(cal.covariance.stds, fitted["errors"].covariance.stds)


def test_noise_given_by_wavelength(truth, data):
    for noise, expected in [
        (0.3 * u.percent, [0.003] * 4),
        ([0.1, 0.2, 0.3, 0.4] * u.percent, [1e-3, 2e-3, 3e-3, 4e-3]),
    ]:
        cal = fit(truth, data, noise)
        np.testing.assert_allclose(
            weighting_of(cal).sigma, np.array(expected)[cal.measurement.bins]
        )
        (kept,) = cal.settings["noise"]
        np.testing.assert_allclose(kept["sigma_percent"], 100 * np.array(expected))
        np.testing.assert_allclose(kept["wavelength_nm"], LAM.to_value(u.nm))


def test_estimate_of_the_noise_may_be_given(truth, data):
    live = Measurement(truth, data)
    noise = noise_from_null_channel(live, null_model="smooth")
    cal = fit(truth, data, noise)
    np.testing.assert_array_equal(weighting_of(cal).sigma, noise.sigma_of_data)
    # fluctuations of that noise are all that is left
    assert lack_of_fit(cal.measurement, cal, noise).p_value > 1e-3


def test_bad_weights_are_refused(truth, data):
    for weights, error, message in [
        ("none", FitError, "'none'; allowed are None, 'wavelength', 'errors', or the noise"),
        ("given", FitError, "was not fitted with a noise given"),
        (0.0, ParameterError, "must be positive"),
        ([0.1, 0.2], ParameterError, r"shape \(2,\); allowed are one value, 4"),
        (3 * u.mm, ParameterError, "noise has unit"),
        (1 / 0.002, ParameterError, "noise of 5e[+]04 %: weights takes the noise"),
    ]:
        with pytest.raises(error, match=message):
            fit(truth, data, weights)


def test_estimate_of_another_measurement_is_refused(make, truth, data):
    other = Measurement(truth, make.observe(truth, make.frames([45] * u.deg), LAM, seed=1))
    with pytest.raises(FitError, match="the noise is that of 16 data, the measurement has 128"):
        fit(truth, data, noise_from_errors(other))


def test_estimate_with_gaps_is_refused(truth, data):
    noise = noise_from_errors(Measurement(truth, data))
    sigma = noise.sigma_of_data.copy()
    sigma[:3] = np.nan
    with pytest.raises(FitError, match="noise from errors: 3 of 128 data have none"):
        fit(truth, data, dataclasses.replace(noise, sigma_of_data=sigma))


# --- residuals that tell no noise -----------------------------------------------------------


def test_no_wavelength_has_infinite_weight(truth, data):
    """One that the model fits to rounding counts as a tenth as noisy as the median."""
    live = Measurement(truth, data)
    row = live.bins == 1
    live.observed[row] = live.predict(live.vector())[row] + 1e-9 * np.arange(row.sum())
    sigma = noise_of(live, "wavelength").sigma
    levels = np.array([sigma[live.bins == b][0] for b in range(4)])
    assert levels[1] == pytest.approx(0.1 * np.median(levels), rel=1e-6)
    assert np.ptp(sigma[row]) == 0


def test_wavelength_without_freedom_is_named(make):
    chain, data = two_by_wavelength(make, [50, 80] * u.deg)
    mask = np.zeros((16, 4), dtype=bool)
    mask[4:, 2] = True
    masked = data.with_mask(mask, "test")
    assert fit(chain, masked).converged
    with pytest.raises(FitError, match=r"2000\.0 nm: 2 data leave 0\.0 degrees of freedom"):
        fit(chain, masked, "wavelength")


def two_by_wavelength(make, derotator):
    """A chain with two free parameters at each wavelength, and data."""
    chain = make.chain(wavelength=LAM)
    for name, keys in (("hwp", ("w_sio2", "w_mgf2")), ("calibration_polarizer", ("theta",))):
        for key in keys:
            getattr(chain[name], key).fixed = True
    return chain, make.observe(chain, make.frames(derotator), LAM, seed=1)


def test_no_freedom_at_all_gives_no_error(make):
    """As many data as parameters: the fit is perfect and says nothing of its errors."""
    chain, data = two_by_wavelength(make, [50] * u.deg)
    data = data.select(data.pairs()[:2].ravel())
    cal = fit(chain, data)
    assert cal.measurement.n_data == cal.measurement.free.size
    assert np.isnan(cal.covariance.stds).all()
    assert cal.identifiability.near_null == []
    with pytest.raises(FitError, match=r"8 data, 8 free parameters .* tell no noise"):
        LogPosterior(cal.measurement)


def test_noise_that_does_not_settle_is_told(truth, data, monkeypatch):
    from astropolcal.calibration.fit import strategies as module

    monkeypatch.setattr(module, "ROUNDS", 1)
    with pytest.warns(AstropolcalWarning, match="noise from the residuals did not settle in 1 fit"):
        cal = fit(truth, data, "wavelength")
    assert not cal.converged


# --- kept, and used by all -------------------------------------------------------------------


def test_choice_is_written_and_read(fitted, tmp_path):
    for choice in CHOICES:
        cal = fitted[choice]
        assert cal.settings["weights"] == ("given" if choice == 0.002 else choice)
        cal.write(tmp_path / "cal.asdf", overwrite=True)
        again = Calibration.read(tmp_path / "cal.asdf")
        assert again.settings == cal.settings
        with pytest.raises(CalibrationFileError, match="holds no observations"):
            weighting_of(again)


def test_noise_given_for_every_datum_is_read_again(truth, data, tmp_path):
    errors = noise_from_errors(Measurement(truth, data))
    uneven = 0.002 * np.exp(np.random.default_rng(1).normal(size=errors.sigma_of_data.size))
    for noise, kept in ((uneven, True), (errors, True), (0.002, False), (LEVELS, False)):
        cal = fit(truth, data, noise, errors="white")
        assert ("sigma_of_data" in cal.settings["noise"][0]) is kept
        cal.write(tmp_path / "cal.asdf", overwrite=True)
        read = Calibration.read(tmp_path / "cal.asdf")
        assert content_hash(read) == content_hash(cal)
        again = weighting_of(read.with_observations(data))
        assert again.choice == "given"
        np.testing.assert_allclose(again.sigma, weighting_of(cal).sigma, rtol=0 if kept else 1e-12)
    # of a robust fit it follows from the residuals
    robust = fit(truth, data, noise, loss="huber")
    assert "sigma_of_data" not in robust.settings["noise"][0]


def test_same_data_give_the_same_noise_again(truth, data, fitted):
    """As after reading from a file, where the measurement is made anew."""
    for choice in CHOICES:
        cal = fitted[choice]
        anew = dataclasses.replace(cal, measurement=Measurement(cal.chains, data))
        assert anew.measurement.weighting is None
        again = weighting_of(anew)
        np.testing.assert_allclose(again.sigma, weighting_of(cal).sigma, rtol=0.01)
        assert again.choice == weighting_of(cal).choice


def test_sampler_assumes_the_noise_of_the_fit(fitted):
    for choice in CHOICES:
        cal = fitted[choice]
        for options in ({}, {"weights": cal.settings["weights"]}):
            sigma = LogPosterior(cal.measurement, **options).sigma
            np.testing.assert_array_equal(sigma, weighting_of(cal).sigma)


def test_posterior_peaks_at_the_fit_with_its_width(fitted):
    """By finite differences of the log-posterior along every parameter."""
    for choice in CHOICES:
        cal = fitted[choice]
        posterior = LogPosterior(cal.measurement)
        curvature = np.linalg.inv(cal.covariance.matrix)
        for i, std in enumerate(cal.covariance.stds):
            step = np.zeros(len(cal.covariance))
            step[i] = 0.1 * std * posterior.factors[i]
            up, here, down = (posterior(posterior.centre + s * step) for s in (1, 0, -1))
            drop = 2 * here - up - down
            assert drop == pytest.approx(curvature[i, i] * (0.1 * std) ** 2, rel=0.01)
            assert abs(up - down) / 2 < 0.02 * np.sqrt(drop)


def test_refits_stay_at_the_fit(fitted):
    for choice in CHOICES:
        cal = fitted[choice]
        vector, _, arrived = problem_of(cal).fit(cal.measurement.vector())
        assert arrived
        moved = (vector - cal.measurement.vector()) / cal.measurement.free.factors()
        assert np.abs(moved / cal.covariance.stds).max() < 0.01


def test_profile_and_bootstrap_know_the_weights(fitted):
    cal = fitted["wavelength"]
    low, high = profile(cal, "hwp.w_sio2", n=7).interval()
    half, std = ((high - low) / 2).value, cal.covariance.std("hwp.w_sio2").value
    assert half == pytest.approx(std, rel=0.05)
    made = bootstrap(cal, n=60, block="pair", seed=1)
    assert np.median(made.stds / cal.covariance.stds) == pytest.approx(1, abs=0.25)


def test_cross_validation_knows_the_weights(truth, data, fitted):
    """Left out and predicted with one level or another: not the same, and both finite."""
    found = [
        fit(truth, data, w, cross_validate=True).accuracy["s_cv"] for w in (None, "wavelength")
    ]
    assert all(np.isfinite(s).all() for s in found)
    assert np.abs(found[1] / found[0] - 1).max() > 1e-3


def test_lack_of_fit_knows_the_weights(fitted):
    live = fitted["wavelength"].measurement
    own = lack_of_fit(live, fitted["wavelength"])
    same = lack_of_fit(live, weights=weighting_of(fitted["wavelength"]).weight)
    assert own.expected == same.expected
    assert own.expected != lack_of_fit(live).expected


def test_prior_weighs_by_the_noise_of_the_wavelengths(make, truth):
    """A prior on one parameter of a quiet wavelength combines as two measurements do."""
    observed = unequal(make, truth, 3)
    free = fit(truth, observed, "wavelength")
    name = "calibration_polarizer.theta"
    i = free.covariance.names.index(name)
    value, std = free.chain["calibration_polarizer"].theta.value, free.covariance.stds[i]
    chain = truth.copy()
    chain["calibration_polarizer"].theta.prior = Normal((value + 2 * std) * u.deg, std * u.deg)
    pulled = fit(chain, observed, "wavelength")
    assert pulled.chain["calibration_polarizer"].theta.value == pytest.approx(
        value + std, abs=0.15 * std
    )
    assert pulled.covariance.stds[i] == pytest.approx(std / np.sqrt(2), rel=0.1)


def test_level_with_priors_counts_what_the_data_give(make, truth):
    """Parameters that priors fix take no freedom from the data."""
    observed = make.observe(truth, wavelength=LAM, seed=4)
    chain = truth.copy()
    chain["wollaston"].efficiency.prior = Normal(
        float(truth["wollaston"].efficiency.value.mean()), 1e-9
    )
    cal = fit(chain, observed)
    expected = np.sqrt(np.sum(cal.residuals**2) / (cal.measurement.n_data - 7))
    assert weighting_of(cal).level == pytest.approx(expected, rel=1e-3)


def test_weighting_in_words(fitted):
    """What is not known yet says so."""
    before = Weighting("wavelength", np.full(3, np.nan))
    assert not before.is_known
    assert before.weight is None
    assert before.from_residuals
    assert not weighting_of(fitted["errors"]).from_residuals


# --- real measurements ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def dataset_3(charis_data, make):
    """Dataset 3 with all 93 parameters and priors on the angles that say where the gauge is."""
    found = charis_data("dataset3_")
    (chain,) = make.charis.chains_for([found])
    for name, angle in (("calibration_polarizer", 90), ("hwp", 0), ("derotator", 0)):
        chain[name].theta.prior = Normal(angle * u.deg, 0.3 * u.deg)
    return {
        w: calibrate(chain, found, weights=w, cross_validate=False) for w in (None, "wavelength")
    }


def walk(cal, n=16_000, share=0.3):
    """Samples by the preconditioned Crank-Nicolson walk, in standard errors from the fit."""
    posterior, rng = LogPosterior(cal.measurement), np.random.default_rng(1)
    scale = posterior.physical_scale()
    whitened = posterior.whitened_jacobian() * scale[:, None]
    half = scale[:, None] * np.linalg.cholesky(np.linalg.inv(whitened @ whitened.T))
    here, excess, samples = np.zeros(scale.size), posterior(posterior.centre), []
    for _ in range(n):
        trial = np.sqrt(1 - share**2) * here + share * rng.normal(size=here.size)
        new = posterior(posterior.centre + half @ trial) + 0.5 * trial @ trial
        if np.log(rng.random()) < new - excess:
            here, excess = trial, new
        samples.append(here)
    stds = np.linalg.norm(half, axis=1)
    return np.array(samples[n // 10 :]) @ half.T / stds


@pytest.mark.long
def test_posterior_of_dataset_3_agrees_with_its_fit(dataset_3):
    """Medians within 0.3 sigma and widths within 20 %; measured: 0.1 sigma and 7 %."""
    for weights in [None, "wavelength"]:
        cal = dataset_3[weights]
        assert np.isfinite(cal.covariance.stds).sum() == 92, weights
        samples, names = walk(cal), cal.covariance.names
        common = ["hwp.w_sio2", "hwp.w_mgf2", "hwp.theta", "derotator.theta"]
        rows = [names.index(name) for name in [*common, "calibration_polarizer.theta"]]
        assert np.abs(np.median(samples, axis=0)[rows]).max() < 0.3, weights
        np.testing.assert_allclose(samples.std(axis=0)[rows], 1, atol=0.2)


def test_wavelengths_of_dataset_3_are_unequally_noisy(dataset_3):
    """A factor of 8 between them; equal weights let the noisy ones decide."""
    (kept,) = dataset_3["wavelength"].settings["noise"]
    assert 5 < max(kept["sigma_percent"]) / min(kept["sigma_percent"]) < 12
    own, one = (dataset_3[w].covariance.std("hwp.w_sio2") for w in ("wavelength", None))
    assert own < 0.75 * one
