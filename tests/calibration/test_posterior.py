# Licensed under a 3-clause BSD style license - see LICENSE
"""Samples of a posterior: autocorrelation, quantiles, covariance, words, files."""

import sys

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration import Posterior, autocorrelation, autocorrelation_time
from astropolcal.exceptions import AstropolcalError, ParameterError

NAMES, UNITS = ["hwp.theta", "wollaston.efficiency[0]"], [u.deg, None]


def correlated(rho, n_steps=20000, n_walkers=8, seed=1):
    """An AR(1) process, whose autocorrelation time is (1 + rho)/(1 - rho)."""
    from scipy.signal import lfilter

    noise = np.random.default_rng(seed).normal(size=(n_steps + 500, n_walkers))
    return lfilter([(1 - rho**2) ** 0.5], [1, -rho], noise, axis=0)[500:]


def make_posterior(rho=0.6, n_steps=4000, **options):
    pair = [correlated(rho, n_steps, seed=seed) for seed in (1, 2)]
    chain = np.stack([2 + 0.1 * pair[0], 0.9 + 0.01 * (0.8 * pair[0] + 0.6 * pair[1])], axis=2)
    return Posterior(NAMES, UNITS, chain, -(chain[..., 0] ** 2), **options)


@pytest.fixture(scope="module")
def posterior():
    return make_posterior(acceptance=np.full(8, 0.5), fitted=[2.0, 0.9], seed=1)


# --- autocorrelation ----------------------------------------------------------------------


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, 0.98])
def test_autocorrelation_time_of_a_known_process(rho):
    expected = (1 + rho) / (1 - rho)
    assert autocorrelation_time(correlated(rho)) == pytest.approx(expected, rel=0.12)


def test_autocorrelation_of_a_known_process():
    found = autocorrelation(correlated(0.9, 50000))[:20]
    assert found == pytest.approx(0.9 ** np.arange(20), abs=0.03)


def test_autocorrelation_agrees_with_emcee():
    emcee = pytest.importorskip("emcee")
    chain = correlated(0.9)
    theirs = emcee.autocorr.integrated_time(chain[:, :, None])
    assert autocorrelation_time(chain) == pytest.approx(theirs[0], rel=0.02)


def test_walkers_that_stay_apart_are_correlated():
    apart = correlated(0.5, 2000) + 10 * np.arange(8)
    assert autocorrelation_time(apart) > 500


def test_what_does_not_move_has_no_autocorrelation():
    assert np.isnan(autocorrelation_time(np.full((100, 4), 0.3)))


# --- numbers ------------------------------------------------------------------------------


def test_quantiles_have_units(posterior):
    found = posterior.quantile("hwp.theta", [0.16, 0.5, 0.84])
    assert found.to_value(u.deg) == pytest.approx([1.9, 2.0, 2.1], abs=0.01)
    assert isinstance(posterior.quantile("wollaston.efficiency[0]", 0.5), float)


def test_covariance(posterior):
    covariance = posterior.covariance
    assert covariance.names == NAMES
    assert covariance.std("hwp.theta").to_value(u.deg) == pytest.approx(0.1, rel=0.05)
    assert covariance.correlation[0, 1] == pytest.approx(0.8, abs=0.03)


def test_covariance_of_one_parameter():
    chain = np.random.default_rng(1).normal(size=(500, 4, 1))
    one = Posterior(["hwp.theta"], ["deg"], chain, chain[..., 0])
    assert one.covariance.std("hwp.theta").to_value(u.deg) == pytest.approx(1, rel=0.1)


def test_burn_in_is_left_out():
    """An exponential approach from far away does not reach the quantiles."""
    posterior = make_posterior()
    chain = posterior.chain.copy()
    chain[:, :, 0] += 50 * np.exp(-np.arange(4000) / 4)[:, None]
    far = Posterior(NAMES, UNITS, chain, posterior.log_prob)
    assert 10 < far.burn_in < 60
    assert len(far.samples()) == 8 * (4000 - far.burn_in)
    assert len(far.samples(burn_in=0)) == 8 * 4000
    assert far.quantile("hwp.theta", 1.0) < 2.6 * u.deg


def test_burn_in_is_half_of_a_short_chain():
    assert make_posterior(0.99, 100).burn_in == 50


def test_summary(posterior):
    pytest.importorskip("arviz_stats")
    table = posterior.summary()
    assert table["name"].tolist() == NAMES
    assert table["unit"].tolist() == ["deg", ""]
    assert table["tau"] == pytest.approx([4.0, 4.0], rel=0.15)
    assert table["r_hat"] == pytest.approx([1.0, 1.0], abs=0.01)
    # 8 walkers of 4000 steps
    assert table["ess"] == pytest.approx([8000, 8000], rel=0.2)
    assert (table["lower"] < table["median"]).all()
    assert (table["median"] < table["upper"]).all()
    assert table["std"] == pytest.approx([0.1, 0.01], rel=0.05)


def test_r_hat_of_walkers_that_stay_apart():
    pytest.importorskip("arviz_stats")
    apart = make_posterior()
    chain = apart.chain + np.arange(8)[:, None]
    table = Posterior(NAMES, UNITS, chain, apart.log_prob).summary()
    assert (table["r_hat"] > 1.5).all()


def test_summary_without_arviz(posterior, monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz_stats.base", None)
    with pytest.raises(AstropolcalError, match=r"arviz-stats, .*pip install astropolcal\[mcmc\]"):
        posterior.summary()


# --- words --------------------------------------------------------------------------------


def test_words_of_a_long_chain(posterior):
    assert posterior.converged
    words = posterior.words()
    assert words.startswith("4000 steps of 8 walkers in 2 parameters.")
    assert "times as long" in words
    assert "moved in 50% to 50% of the steps" in words
    assert "NOT CONVERGED" not in words


def test_words_of_a_short_chain():
    short = make_posterior(0.9, 300)
    assert not short.converged
    assert short.n_times == pytest.approx(300 / short.autocorrelation_times.max())
    assert "NOT CONVERGED: 50 times are needed; run " in short.words()


def test_words_of_a_chain_that_does_not_move():
    chain = np.zeros((100, 8, 2))
    chain[..., 1] = correlated(0.1, 100)
    stuck = Posterior(NAMES, UNITS, chain, chain[..., 0])
    assert not stuck.converged
    assert "NOT CONVERGED: hwp.theta did not move" in stuck.words()


def test_times_are_in_steps_of_the_sampler(posterior):
    thinned = posterior.thinned(2)
    assert thinned.thin == 2
    assert thinned.autocorrelation_times == pytest.approx(posterior.autocorrelation_times, rel=0.2)
    assert thinned.n_times == pytest.approx(posterior.n_times, rel=0.2)
    np.testing.assert_array_equal(thinned.chain, posterior.chain[1::2])


# --- to and from a dictionary -------------------------------------------------------------


def test_round_trip(posterior):
    again = Posterior.from_dict(posterior.to_dict())
    assert again == posterior
    assert again.units == UNITS
    assert repr(again) == "<Posterior of 2 parameters: 4000 steps of 8 walkers>"


@pytest.mark.parametrize("change", [{"seed": 2}, {"fitted": None}, {"units": ["rad", ""]}])
def test_posteriors_that_differ(posterior, change):
    assert Posterior.from_dict(posterior.to_dict() | change) != posterior
    assert posterior != "posterior"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"chain": np.zeros((10, 8, 3))}, r"shape \(10, 8, 3\)"),
        ({"chain": np.zeros((10, 8))}, "allowed is"),
        ({"log_prob": np.zeros((10, 8))}, r"log_prob has shape \(10, 8\)"),
        ({"units": ["deg"]}, "2 names and 1 units"),
        ({"acceptance": [0.5]}, r"acceptance has shape \(1,\), not \(8,\)"),
        ({"fitted": [0.5]}, r"fitted has shape \(1,\), not \(2,\)"),
        ({"color": "red"}, "missing or unknown color"),
    ],
)
def test_bad_parts(posterior, change, message):
    with pytest.raises(ParameterError, match=message):
        Posterior.from_dict(posterior.to_dict() | change)


@pytest.mark.parametrize("step", [0, 4001])
def test_bad_thinning(posterior, step):
    with pytest.raises(ParameterError, match="allowed are 1 to 4000"):
        posterior.thinned(step)


def test_bad_quantile(posterior):
    with pytest.raises(ParameterError, match="numbers from 0 to 1"):
        posterior.quantile("hwp.theta", 16)
    with pytest.raises(ParameterError, match=r"no parameter 'hwp\.w_sio2'"):
        posterior.quantile("hwp.w_sio2", 0.5)
