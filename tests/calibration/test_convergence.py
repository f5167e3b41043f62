# Licensed under a 3-clause BSD style license - see LICENSE
"""Autocorrelation of chains whose law is known, and what a run says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from astropolcal.calibration.posterior.samples import (
    ENOUGH,
    FEWEST_SAMPLES,
    LARGEST_R_HAT,
    Convergence,
    autocorrelation,
    autocorrelation_time,
    autocorrelation_times,
)
from astropolcal.exceptions import ParameterError

pytest.importorskip("arviz_stats")
pytestmark = pytest.mark.samplers


def _ar1(memory, n_steps=6000, n_walkers=20, seed=1):
    """x(t) = a x(t - 1) + noise, stationary from the start; rho(t) = a^t."""
    rng = np.random.default_rng(seed)
    chain = np.empty((n_steps, n_walkers))
    chain[0] = rng.normal(size=n_walkers)
    noise = np.sqrt(1 - memory**2) * rng.normal(size=(n_steps, n_walkers))
    for i in range(1, n_steps):
        chain[i] = memory * chain[i - 1] + noise[i]
    return chain


def _made(times, n_steps=10000, **changes):
    times = np.asarray(times, dtype=float)
    parts = dict.fromkeys(("median", "lower", "upper", "std"), np.zeros(times.size))
    parts |= {"r_hat": np.ones(times.size), "ess_bulk": np.full(times.size, 1e4)}
    parts |= {"ess_tail": np.full(times.size, 1e4)}
    return Convergence(n_steps, 0, 1000, times, **(parts | changes))


# --- autocorrelation ------------------------------------------------------------------------


def test_autocorrelation_is_the_sum_of_products():
    """The Fourier transform gives what the definition does, lag by lag."""
    chain = np.random.default_rng(3).normal(size=(12, 3)).cumsum(axis=0)
    off = chain - chain.mean()
    direct = [np.sum(off[: 12 - lag] * off[lag:]) for lag in range(12)]
    np.testing.assert_allclose(autocorrelation(chain), np.array(direct) / direct[0], atol=1e-12)


def test_autocorrelation_of_ar1_falls_geometrically():
    found = autocorrelation(_ar1(0.8))[:8]
    np.testing.assert_allclose(found, 0.8 ** np.arange(8), atol=0.03)


def test_time_of_ar1_is_known():
    for memory in [0.0, 0.5, 0.9]:
        expected = (1 + memory) / (1 - memory)
        assert autocorrelation_time(_ar1(memory)) == pytest.approx(expected, rel=0.1), memory


def test_walkers_that_stay_apart_are_correlated():
    """Each is white about a place of its own: about the common mean it remembers for ever."""
    rng = np.random.default_rng(2)
    chain = rng.normal(size=(500, 10)) + 5 * rng.normal(size=10)
    assert autocorrelation_time(rng.normal(size=(500, 10))) < 1.5
    assert autocorrelation_time(chain) > 50


def test_what_does_not_move_has_no_time():
    for value in [0.0, 3.0, -1e9]:
        chain = np.full((50, 4), value)
        assert np.isnan(autocorrelation(chain)).all()
        assert np.isnan(autocorrelation_time(chain))


def test_the_window_closes_before_the_noise_of_large_lags_sums_up():
    """Over all lags the autocorrelations about the sample's own mean sum to -1/2 exactly."""
    chain = _ar1(0.5, 3000, n_walkers=1)
    assert autocorrelation(chain)[1:].sum() == pytest.approx(-0.5, abs=1e-9)
    assert autocorrelation_time(chain) == pytest.approx(3, rel=0.3)


def test_times_are_those_of_each_parameter():
    chain = np.stack([_ar1(0.0, 800), _ar1(0.7, 800, seed=4)], axis=2)
    each = [autocorrelation_time(chain[:, :, i]) for i in range(2)]
    np.testing.assert_array_equal(autocorrelation_times(chain), each)


# --- what is worked out of a run ---------------------------------------------------------------


@pytest.fixture(scope="module")
def run():
    chain = np.stack([_ar1(0.3, 2000), 5 + 2 * _ar1(0.6, 2000, seed=5)], axis=2)
    chain[:100] += 50
    return chain


def test_numbers_are_those_behind_the_burn_in(run):
    found = Convergence.of(run, thin=3, burn_in=100)
    used = run[100:].reshape(-1, 2)
    assert (found.n_steps, found.burn_in, found.n_draws) == (6000, 300, 1900 * 20)
    np.testing.assert_allclose(found.std, used.std(axis=0, ddof=1))
    for key, q in (("lower", 0.16), ("median", 0.5), ("upper", 0.84)):
        np.testing.assert_allclose(getattr(found, key), np.quantile(used, q, axis=0))
    # times are told in steps of the sampler, of which every third was kept
    np.testing.assert_allclose(found.times, 3 * autocorrelation_times(run[100:]))
    assert found.n_times == pytest.approx(6000 / found.times.max())


def test_effective_samples_are_the_draws_over_the_time(run):
    """For the mean of a normal chain; arviz splits each walker in two, which costs a little."""
    found = Convergence.of(run, burn_in=100)
    expected = found.n_draws / (np.array([1.3 / 0.7, 1.6 / 0.4]))
    np.testing.assert_allclose(found.ess_bulk, expected, rtol=0.15)
    np.testing.assert_allclose(found.r_hat, 1, atol=0.01)
    assert found.converged


def test_walkers_that_disagree_are_told_by_r_hat():
    rng = np.random.default_rng(6)
    chain = (rng.normal(size=(4000, 8)) + np.repeat([0, 3], 4))[:, :, None]
    found = replace(Convergence.of(chain), times=np.ones(1))
    assert found.r_hat[0] > LARGEST_R_HAT
    assert not found.converged
    (*_, words) = [w for w in found.complaints(["hwp.theta"]) if "R-hat" in w]
    assert words.startswith(f"R-hat of hwp.theta is {found.r_hat[0]:.3f}, but {LARGEST_R_HAT}")


def test_a_parameter_that_does_not_move_has_no_statistics():
    chain = np.random.default_rng(1).normal(size=(100, 6, 2))
    chain[:, :, 1] = 4.0
    found = Convergence.of(chain)
    assert np.isnan([found.times[1], found.r_hat[1], found.ess_bulk[1], found.ess_tail[1]]).all()
    assert np.isfinite(found.r_hat[0])
    assert found.complaints(["a", "b"]) == ["b did not move"]
    assert found.n_times == 0
    assert found.agreement() == ""
    assert not found.converged


# --- verdicts ---------------------------------------------------------------------------------


def test_a_long_run_of_agreeing_walkers_has_no_complaint():
    found = _made([100.0, 20.0])
    assert found.n_times == 100
    assert found.complaints(["a", "b"]) == []
    assert found.converged
    assert found.agreement() == "R-hat is 1.000 or less, the effective sample size 10000 or more."


def test_a_short_run_says_how_long_it_should_be():
    """ENOUGH times, rounded up to two digits."""
    for time, wanted in [(201.0, 11000), (212.3, 11000), (999.0, 50000), (1001.0, 51000)]:
        (words,) = _made([time, 3.0], n_steps=1000).complaints(["a", "b"])
        assert words == f"{ENOUGH} times are needed; run {wanted} steps or more", (time, wanted)
        assert wanted >= ENOUGH * time, (time, wanted)


def test_the_limits_themselves_are_allowed():
    edge = {"r_hat": np.array([LARGEST_R_HAT]), "ess_bulk": np.array([float(FEWEST_SAMPLES)])}
    assert _made([10000 / ENOUGH], **edge).complaints(["a"]) == []


def test_too_few_samples_name_the_worst_parameter():
    for kind in ["bulk", "tail"]:
        found = _made([10.0, 10.0, 10.0], **{f"ess_{kind}": np.array([500.0, 399.0, 450.0])})
        assert found.complaints("abc") == [
            f"b has an effective sample size ({kind}) of 399, but {FEWEST_SAMPLES} are needed"
        ], kind


def test_what_is_no_number_is_the_worst():
    for key, words in [("r_hat", "R-hat of b is nan"), ("ess_bulk", "b has an")]:
        values = np.array([1.2, np.nan]) if key == "r_hat" else np.array([10.0, np.nan])
        (found,) = _made([10.0, 10.0], **{key: values}).complaints("ab")
        assert found.startswith(words), (key, words)


def test_without_arviz_only_the_length_counts():
    none = dict.fromkeys(("r_hat", "ess_bulk", "ess_tail"))
    assert _made([10.0], **none).converged
    assert _made([10.0], **none).agreement() == ""
    assert not _made([10.0], n_steps=100, **none).converged


def test_shapes_must_agree():
    for changes in [{"std": np.zeros(3)}, {"r_hat": np.zeros((2, 1))}]:
        with pytest.raises(ParameterError, match="one value per parameter is allowed"):
            _made([1.0, 2.0], **changes)
