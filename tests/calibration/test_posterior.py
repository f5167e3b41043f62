# Licensed under a 3-clause BSD style license - see LICENSE
"""Samples of a posterior: autocorrelation, quantiles, covariance, words, files."""

import sys
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration.posterior import Posterior
from astropolcal.calibration.posterior.samples import autocorrelation, autocorrelation_time
from astropolcal.exceptions import AstropolcalError, ParameterError

pytestmark = pytest.mark.samplers
NAMES, UNITS = ["hwp.theta", "wollaston.efficiency[0]"], [u.deg, None]
CONVERGENCE = {"n_steps": 100, "burn_in": 10, "n_draws": 90}
CONVERGENCE |= {key: [1.0] for key in ("times", "median", "lower", "upper", "std")}


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


def test_autocorrelation_time_of_a_known_process():
    for rho in [0.0, 0.5, 0.9, 0.98]:
        expected = (1 + rho) / (1 - rho)
        assert autocorrelation_time(correlated(rho)) == pytest.approx(expected, rel=0.12), rho


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
    assert table["ess_bulk"] == pytest.approx([8000, 8000], rel=0.2)
    assert (table["ess_tail"] > 4000).all()
    assert (table["lower"] < table["median"]).all()
    assert (table["median"] < table["upper"]).all()
    assert table["std"] == pytest.approx([0.1, 0.01], rel=0.05)
    # nothing is left out, whatever the terminal
    printed = str(table)
    assert all(name in printed for name in [*table.colnames, *NAMES])
    assert "..." not in printed


def test_r_hat_of_walkers_that_stay_apart():
    pytest.importorskip("arviz_stats")
    apart = make_posterior()
    chain = apart.chain + np.arange(8)[:, None]
    table = Posterior(NAMES, UNITS, chain, apart.log_prob).summary()
    assert (table["r_hat"] > 1.5).all()


def test_summary_without_arviz(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz_stats.base", None)
    with pytest.raises(AstropolcalError, match=r'arviz-stats, .*pip install "astropolcal\[mcmc\]"'):
        make_posterior().summary()


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
    parts = {"thin": 2, "chain": posterior.chain[1::2], "log_prob": posterior.log_prob[1::2]}
    every_second = Posterior.from_dict(posterior.to_dict() | parts)
    times = posterior.autocorrelation_times
    assert every_second.autocorrelation_times == pytest.approx(times, rel=0.2)
    assert every_second.n_times == pytest.approx(posterior.n_times, rel=0.2)
    assert every_second.steps[[0, -1]].tolist() == [2, 4000]


def test_long_chain_of_walkers_that_do_not_agree_has_not_converged():
    pytest.importorskip("arviz_stats")
    apart = make_posterior(0.1, 4000)
    # small against the width, so that the autocorrelation time hardly shows it
    chain = apart.chain + 0.04 * np.array([0, 0, 0, 0, 0, 0, 0, 5.0])[:, None]
    found = Posterior(NAMES, UNITS, chain, apart.log_prob, thin=1000)
    found.convergence = replace(found.convergence, times=np.array([10.0, 10.0]))
    assert found.n_times > 50
    assert not found.converged
    assert "NOT CONVERGED: R-hat of " in found.words()
    assert "1.05 is the most for walkers that agree" in found.words()


def test_few_samples_have_not_converged():
    """Four walkers of 60 autocorrelation times are 240 samples."""
    pytest.importorskip("arviz_stats")
    pair = [correlated(0.5, 200, 4, seed) for seed in (1, 2)]
    few = Posterior(NAMES, UNITS, np.stack(pair, axis=2), pair[0])
    assert few.n_times > 50
    assert not few.converged
    assert "has an effective sample size (bulk) of " in few.words()


def test_converged_without_arviz_is_a_matter_of_length(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz_stats.base", None)
    found = make_posterior()
    assert found.converged
    assert found.convergence.r_hat is None
    assert found.report()["parameters"]["hwp.theta"]["r_hat"] is None
    assert Posterior.from_dict(found.thinned().to_dict()) == found.thinned()


def test_hardly_any_steps_have_not_converged():
    for n_steps in [2, 3]:
        found = make_posterior(0.1, n_steps)
        assert not found.converged, n_steps
        assert "NOT CONVERGED" in found.words(), n_steps


# --- burn-in ------------------------------------------------------------------------------


def test_burn_in_that_is_given(posterior):
    given = Posterior.from_dict(posterior.to_dict() | {"burn_in": 1000})
    assert given.burn_in == given.convergence.burn_in == 1000
    assert len(given.samples()) == 8 * 3000
    assert "The first 1000 steps are left out" in given.words()
    assert given != posterior


def test_bad_burn_in(posterior):
    for burn_in in [-1, 3999, 5000]:
        with pytest.raises(ParameterError, match="allowed are 0 to 3998 of 4000 kept steps"):
            Posterior.from_dict(posterior.to_dict() | {"burn_in": burn_in})


# --- thinned, for files -------------------------------------------------------------------


def test_thinned_posterior_keeps_what_the_run_says(posterior):
    pytest.importorskip("arviz_stats")
    thinned = posterior.thinned()
    start = posterior.burn_in
    assert thinned.log_prob.size <= 4000
    assert thinned.is_thinned
    assert thinned.burn_in == 0
    np.testing.assert_array_equal(thinned.chain, posterior.chain[start + 7 :: 8])
    for key in ("converged", "n_steps", "n_times"):
        assert getattr(thinned, key) == getattr(posterior, key)
    assert thinned.convergence is posterior.convergence
    assert (thinned.summary() == posterior.summary()).all()
    assert thinned.report() == posterior.report()


def test_thinned_posterior_says_what_is_left(posterior):
    thinned = posterior.thinned()
    assert thinned.words() == posterior.words()
    n, kept = 8 * (4000 - posterior.burn_in), thinned.log_prob.size
    assert thinned.kept_words() == (
        f"Of {n} samples {kept} are kept, one step in 8; convergence and quantiles are those of "
        "all."
    )
    assert posterior.kept_words() == "All steps are kept."


def test_steps_of_a_thinned_posterior_are_those_of_the_run(posterior):
    thinned = posterior.thinned(5)
    assert thinned.steps[0] == posterior.burn_in + 5
    np.testing.assert_array_equal(thinned.chain, posterior.chain[thinned.steps - 1])


def test_thinned_again_is_the_same(posterior):
    once = posterior.thinned()
    assert once.thinned() == once
    assert once.thinned(2).thin == 2 * once.thin
    assert once.thinned(2).convergence is posterior.convergence


def test_size_of_a_thinned_posterior(posterior):
    for draws, kept in [(8, 8), (3, 8), (100, 88), (10**9, None)]:
        found = posterior.thinned(draws=draws).log_prob.size
        assert found == (kept or 8 * (4000 - posterior.burn_in)), kept


def test_quantiles_of_a_thinned_posterior_are_about_the_same(posterior):
    name = "hwp.theta"
    found = posterior.thinned().quantile(name, 0.5) - posterior.quantile(name, 0.5)
    assert abs(found.to_value(u.deg)) < 0.1 * 4 / 4000**0.5


# --- for machines -------------------------------------------------------------------------


def test_report_is_json(posterior):
    import json

    pytest.importorskip("arviz_stats")
    report = json.loads(json.dumps(posterior.report(), allow_nan=False))
    assert report["converged"] is True
    assert report["words"] == posterior.words()
    assert report["acceptance"] == [0.5, 0.5]
    assert report["n_samples"] == len(posterior.samples())
    entry = report["parameters"]["hwp.theta"]
    assert entry["unit"] == "deg"
    assert entry["fitted"] == 2.0
    assert entry["lower"] < entry["median"] < entry["upper"]
    assert entry["median"] == pytest.approx(posterior.quantile("hwp.theta", 0.5).value)
    assert entry["r_hat"] < 1.05
    assert min(entry["ess_bulk"], entry["ess_tail"]) > 400


def test_report_of_what_does_not_move_has_no_numbers_that_are_none():
    chain = np.zeros((100, 8, 2))
    chain[..., 1] = correlated(0.1, 100)
    report = Posterior(NAMES, UNITS, chain, chain[..., 0]).report()
    assert not report["converged"]
    assert report["acceptance"] is None
    stuck, moves = report["parameters"].values()
    assert stuck["autocorrelation_time"] is None
    assert stuck["r_hat"] is None
    assert stuck["median"] == 0.0
    assert moves["autocorrelation_time"] > 0


# --- to and from a dictionary -------------------------------------------------------------


def test_round_trip(posterior):
    again = Posterior.from_dict(posterior.to_dict())
    assert again == posterior
    assert again.units == UNITS
    assert repr(again) == "<Posterior of 2 parameters: 4000 steps of 8 walkers>"


def test_round_trip_of_a_thinned_posterior(posterior):
    thinned = posterior.thinned()
    again = Posterior.from_dict(thinned.to_dict())
    assert again == thinned
    assert again != posterior
    other = thinned.to_dict()
    other["convergence"]["median"] = other["convergence"]["median"] + 1e-15
    assert Posterior.from_dict(other) != thinned


def test_posteriors_that_differ(posterior):
    for change in [{"seed": 2}, {"fitted": None}, {"units": ["rad", ""]}]:
        assert Posterior.from_dict(posterior.to_dict() | change) != posterior
        assert posterior != "posterior"


def test_bad_parts(posterior):
    for change, message in [
        ({"chain": np.zeros((10, 8, 3))}, r"shape \(10, 8, 3\)"),
        ({"chain": np.zeros((10, 8))}, "allowed is"),
        ({"log_prob": np.zeros((10, 8))}, r"log_prob has shape \(10, 8\)"),
        ({"units": ["deg"]}, "2 names and 1 units"),
        ({"acceptance": [0.5]}, r"acceptance has shape \(1,\), not \(8,\)"),
        ({"fitted": [0.5]}, r"fitted has shape \(1,\), not \(2,\)"),
        ({"color": "red"}, "missing or unknown color"),
        ({"convergence": CONVERGENCE}, r"convergence has shape \(1,\), not \(2,\)"),
        ({"convergence": CONVERGENCE | {"std": [1.0, 2.0]}}, "one value per parameter is allowed"),
    ]:
        with pytest.raises(ParameterError, match=message):
            Posterior.from_dict(posterior.to_dict() | change)


def test_bad_thinning(posterior):
    for step in [0, 4001]:
        with pytest.raises(ParameterError, match=f"allowed are 1 to {4000 - posterior.burn_in}"):
            posterior.thinned(step)


def test_bad_quantile(posterior):
    for q in (16, np.nan, [0.5, np.nan]):
        with pytest.raises(ParameterError, match="numbers from 0 to 1"):
            posterior.quantile("hwp.theta", q)
    with pytest.raises(ParameterError, match=r"no parameter 'hwp\.w_sio2'"):
        posterior.quantile("hwp.w_sio2", 0.5)
