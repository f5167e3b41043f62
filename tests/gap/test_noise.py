# Licensed under a 3-clause BSD style license - see LICENSE
"""Noise as the residuals tell it, and fluxes without it."""

from types import SimpleNamespace

import gap_data as data
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.calibration import calibrate
from astropolcal.calibration.noise import estimates
from astropolcal.exceptions import FitError
from astropolcal.gap import channels, diagnose
from astropolcal.gap.model import nominal_model
from astropolcal.gap.problem import GapProblem
from astropolcal.gap.report import Fitted
from astropolcal.observations import Observations
from astropolcal.optics import BeamGain

W, F = 11, 60
ANGLES = {
    "hwp": np.deg2rad(np.tile(np.arange(10) * 9.0, 6)),
    "derotator": np.deg2rad(np.repeat(np.arange(6) * 17.0, 10)),
}


def channel(variance, valid=None):
    valid = np.ones((W, F), dtype=bool) if valid is None else valid
    variance = np.broadcast_to(variance, (2, W, F)).copy()
    return SimpleNamespace(variance=variance, valid=valid, groups=None, count=2)


def draws(sigma, seed=1):
    return sigma * np.random.default_rng(seed).normal(size=(2, W, F))


# ---- noise of every datum ------------------------------------------------------------------


def test_stated_errors_are_kept_where_the_data_do_not_contradict():
    for factor in [0.2, 1.0]:
        found = estimates.frame_noise(channel(1e-6), draws(factor * 1e-3), ANGLES)
        np.testing.assert_allclose(found, 1e-3, rtol=0.15)
        assert found.min() >= 1e-3 * (1 - 1e-12)


def test_larger_noise_than_stated_is_what_the_data_say():
    for factor in [3.0, 20.0]:
        found = estimates.frame_noise(channel(1e-6), draws(factor * 1e-3), ANGLES)
        np.testing.assert_allclose(found, factor * 1e-3, rtol=0.15)


def test_errors_keep_their_proportions():
    stated = np.linspace(1, 2, F)
    found = estimates.frame_noise(channel((1e-3 * stated) ** 2), draws(1e-2 * stated), ANGLES)
    np.testing.assert_allclose(found[0] / found[0, 0, 0], np.broadcast_to(stated, (W, F)))


def test_without_stated_errors_the_data_tell_them():
    """As the noise is not known to be the same at all wavelengths, few data tell each."""
    found = estimates.frame_noise(channel(np.nan), draws(0.02), ANGLES)
    assert found.shape == (2, W, F)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(found, 0.02, rtol=0.35)
    # one number that is far off is no noise; what the fit of the angles takes up of it is
    values = draws(0.02)
    values[0, W // 2, 5] += 2.0
    spoiled = estimates.frame_noise(channel(np.nan), values, ANGLES)
    assert np.max(spoiled / found) < 3


def test_without_stated_errors_noise_may_differ_between_wavelengths_and_frames():
    """Faint ends of a band, and light that one beam has nearly all of: the mean square counts."""
    shape = np.linspace(1, 4, W)[:, None] * np.where(np.arange(3000) % 3, 1.0, 0.2)
    values = 1e-3 * shape * np.random.default_rng(4).normal(size=(1, W, 3000))
    bare = SimpleNamespace(variance=np.full(values.shape, np.nan), valid=np.isfinite(values[0]))
    found = estimates.frame_noise(bare, values, {})[0]
    wanted = 1e-3 * np.sqrt(np.mean(shape**2, axis=1))
    np.testing.assert_allclose(found[3:-3, 0], wanted[3:-3], rtol=0.05)


def test_a_datum_without_error_gets_the_usual_one():
    variance = np.full((2, W, F), 4e-6)
    variance[:, 2, 5] = np.nan
    variance[:, 3, 6] = 0.0
    found = estimates.frame_noise(channel(variance), draws(2e-3), ANGLES)
    assert found[0, 2, 5] == found[0, 3, 6] == np.median(found[0])


def test_no_error_and_no_scatter_is_an_error():
    exact, few = channel(np.nan), channel(np.nan)
    few.variance, few.valid = few.variance[:, :4], few.valid[:4]
    for seen, residual in ((exact, np.zeros((2, W, F))), (few, draws(0.02)[:, :4])):
        wanted = f"{residual.shape[1]} wavelengths without errors .*flux_right_err and .* least 5 w"
        with pytest.raises(FitError, match=wanted):
            estimates.frame_noise(seen, residual, ANGLES)


def test_what_optics_do_is_no_noise():
    """A harmonic of both stages, sharp in wavelength, does not raise the noise."""
    wave = np.cos(4 * ANGLES["hwp"] + 2 * ANGLES["derotator"])
    sharp = 0.05 * (np.arange(W) == 4)[:, None] * wave
    found = estimates.frame_noise(channel(1e-6), draws(1e-3) + sharp, ANGLES)
    np.testing.assert_allclose(found, 1e-3, rtol=0.15)


def test_what_is_smooth_in_wavelength_is_no_noise():
    smooth = 0.05 * np.linspace(-1, 1, W)[:, None] * np.random.default_rng(3).normal(size=F)
    residual = draws(1e-3) + smooth
    found = estimates.frame_noise(channel(1e-6), residual, ANGLES)
    np.testing.assert_allclose(found, 1e-3, rtol=0.15)
    # whatever the order of the table
    order = np.random.default_rng(4).permutation(W)
    again = estimates.frame_noise(channel(1e-6), residual[:, order], ANGLES, bins=order)
    np.testing.assert_allclose(again, found[:, order], rtol=1e-12)


# ---- roughness -----------------------------------------------------------------------------


def test_roughness_is_the_standard_deviation_of_white_noise():
    values = np.random.default_rng(2).normal(size=(1, W, 3000))
    bare = SimpleNamespace(variance=np.full(values.shape, np.nan), valid=np.isfinite(values[0]))
    np.testing.assert_allclose(estimates.frame_noise(bare, values, {}), 1.0, atol=0.02)


def test_few_wavelengths_tell_no_roughness():
    four = SimpleNamespace(variance=np.full((1, 4, F), 1e-6), valid=np.ones((4, F), dtype=bool))
    np.testing.assert_allclose(estimates.frame_noise(four, draws(1.0)[:1, :4], {}), 1e-3)


def test_masked_neighbours_are_left_out():
    values, valid = draws(1e-4)[:1], np.ones((W, F), dtype=bool)
    values[:, 5], valid[5] = 1e6, False
    masked = SimpleNamespace(variance=np.full(values.shape, 1e-6), valid=valid)
    np.testing.assert_allclose(estimates.frame_noise(masked, values, {})[0, valid], 1e-3)


def test_an_error_of_zero_states_nothing_of_frames_left_out():
    """Nor does it warn: what is stated of the others tells the noise of these."""
    some = channel(1e-6)
    some.variance[:, :, 0] = 0.0
    found = channels.noise(some, draws(1e-3), {}, np.arange(W), np.arange(F) == 3)
    usual = np.median(found[:, :, 4:], axis=(1, 2))
    np.testing.assert_allclose(found[:, :, 3], np.repeat(usual[:, None], W, axis=1))


# ---- harmonics of the stages ---------------------------------------------------------------


def test_turning_holds_all_harmonics_of_two_and_four():
    valid = np.ones((W, F), dtype=bool)
    basis = estimates._turning(ANGLES, valid)
    plate, turn = ANGLES["hwp"], ANGLES["derotator"]
    for wave in (1 + 0 * plate, np.sin(4 * plate), np.cos(2 * turn), np.sin(2 * plate + 4 * turn)):
        np.testing.assert_allclose(basis @ (basis.T @ wave), wave, atol=1e-8)
    other = np.random.default_rng(1).normal(size=F)
    assert np.linalg.norm(other - basis @ (basis.T @ other)) > 0.5


def test_frames_with_a_masked_wavelength_are_not_asked():
    valid = np.ones((W, F), dtype=bool)
    valid[0, 7] = False
    assert np.all(np.abs(estimates._turning(ANGLES, valid)[7]) < 1e-12)


def test_a_wavelength_that_is_masked_through_the_run_hides_no_optics():
    """Else no frame were complete, and what optics do would count as noise."""
    wave = np.cos(4 * ANGLES["hwp"] + 2 * ANGLES["derotator"])
    sharp = 0.05 * np.where(np.arange(W) % 2, 1, -1)[:, None] * wave
    valid = np.ones((W, F), dtype=bool)
    valid[8] = False
    residual = np.where(valid, draws(1e-3) + sharp, 0.0)
    found = estimates.frame_noise(channel(1e-6, valid), residual, ANGLES)
    np.testing.assert_allclose(found, 1e-3, rtol=0.15)


def test_harmonics_that_would_take_most_frames_are_not_taken_out():
    few = dict(zip(ANGLES, np.random.default_rng(1).uniform(0, np.pi, (2, 12)), strict=True))
    assert estimates._turning(few, np.ones((W, 12), dtype=bool)).shape == (12, 0)


def test_a_calibration_and_its_diagnosis_compare_with_the_same_noise():
    """Also where it is larger than the table states, and in other words: as many times the gap."""
    for factor in [1.0, 0.2]:
        table = data.observed().to_table()
        for beam in ("flux_right_err", "flux_left_err"):
            table[beam] = factor * table[beam]
        observations = Observations.from_table(table, name="lamp")
        cal = calibrate(data.chain(), observations, cross_validate=False)
        model = nominal_model(cal.chains, [observations], cal)
        *_, told = cal.fit["lack_of_fit"]
        assert told["noise"] == "roughness"
        noise = Fitted(model).double_noise_percent
        assert told["noise_percent"] == pytest.approx(noise, rel=1e-6), factor
        rms = 100 * np.sqrt(np.sum(cal.residuals**2) / (cal.residuals.size - len(cal.covariance)))
        assert told["times_noise"] * noise == pytest.approx(rms, rel=0.15), factor


def test_settings_that_saturate_the_sums():
    for angles, columns in [
        ({}, 0),
        # harmonics 2, 4, 1, 3, 6 and 8 of the plate, each with a real and an imaginary part
        ({"hwp": ANGLES["hwp"]}, 12),
        # and two products each of 2 and 4 with the derotator; a third of the frames is the most
        (ANGLES, 20),
    ]:
        assert channels.settings(angles, F).shape == (F, columns)


def test_settings_hold_the_plate_but_not_the_derotator_alone():
    found = channels.settings(ANGLES, F)
    both = np.cos(4 * ANGLES["hwp"] - 2 * ANGLES["derotator"])
    alone = np.cos(2 * ANGLES["derotator"])
    wanted = np.stack([both, alone], axis=1)
    # regular plate angles make some columns the same: least squares know their rank
    left = wanted - found @ np.linalg.lstsq(found, wanted)[0]
    np.testing.assert_allclose(left[:, 0], 0, atol=1e-8)
    assert np.linalg.norm(left[:, 1]) > 0.05 * np.linalg.norm(alone)


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(0, 1), min_size=4, max_size=8))
def test_a_modulator_doubles_the_waves_where_both_states_were_taken(state):
    wave = np.ones(len(state))
    found = estimates.by_state([wave], {"flc_state": np.array(state, float)})
    if len(set(state)) == 1:
        assert len(found) == 1
    else:
        np.testing.assert_array_equal(found[1], 1 - 2 * np.array(state))


# ---- expected fluxes -----------------------------------------------------------------------


def test_expected_fluxes_are_those_without_noise():
    rng = np.random.default_rng(5)
    lamp = np.exp(0.1 * np.linspace(-1, 1, 32) + 0.2 * rng.normal(size=32))
    noisy = data.observed(lamp=lamp, flux=1e4, seed=3)
    clean = data.observed(lamp=lamp, flux=1e4, noise=False)
    problem = GapProblem([data.chain()], [noisy])
    problem.settle_noise()
    (found,) = problem.fluxes
    ideal = np.stack([clean.flux_right.T, clean.flux_left.T])
    seen = np.stack([noisy.flux_right.T, noisy.flux_left.T])
    error = found / ideal - 1
    # the lamp is common to all wavelengths: much better known than each datum
    assert np.std(error) < 0.5 * np.std(seen / ideal - 1)
    assert abs(np.mean(error)) < 1e-3


def test_expected_fluxes_are_there_for_masked_data_too():
    observations = data.observed()
    mask = np.zeros((observations.n_frames, observations.n_bins), dtype=bool)
    mask[4, 2] = True
    problem = GapProblem([data.chain()], [observations.with_mask(mask, "cosmic ray")])
    problem.settle_noise()
    (found,) = problem.fluxes
    assert found[0, 2, 4] == pytest.approx(observations.flux_right[4, 2], rel=0.02)


@pytest.mark.long
def test_noise_that_no_table_states_is_no_cause():
    """Alike at neighbouring wavelengths, or larger at some; a gain beside it is one."""
    true, n = data.chain(), len(data.WAVELENGTH)
    gain = true | BeamGain(imbalance=0.005, name="flat")
    uneven = np.where(np.arange(n) % 3 == 1, 3.0, 1.0)
    cases = [(true, 0, 0.7, 1.0), (true, 12, 0.0, uneven), (gain, 12, 0.0, 1.0)]
    for chain, seed, alike, size in cases:
        table = data.observed(chain, noise=False).to_table()
        table.remove_columns([name for name in table.colnames if name.endswith("_err")])
        rng = np.random.default_rng(seed)
        for beam in ("flux_right", "flux_left"):
            noise = rng.normal(size=(len(table) // n, n))
            for k in range(1, n):
                noise[:, k] = alike * noise[:, k - 1] + np.sqrt(1 - alike**2) * noise[:, k]
            table[beam] = table[beam] * (1 + 2e-3 * (size * noise).ravel())
        run = Observations.from_table(table, name="lamp")
        found = diagnose(data.chain(), run, cross_validate=False)
        assert (found.verdict == "none") == (chain is true), (seed, found)
        assert bool(found.causes) == (chain is gain)
