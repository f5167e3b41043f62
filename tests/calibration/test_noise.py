# Licensed under a 3-clause BSD style license - see LICENSE
"""Noise against what was put in, and what it is in real measurements."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments, optics
from astropolcal.calibration.noise import (
    noise_from_errors,
    noise_from_null_channel,
    noise_from_replicates,
)
from astropolcal.calibration.noise.estimates import data_by_wavelength, equal_axes
from astropolcal.chain import join
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.simulation import simulate

CHARIS = instruments.get("charis")
LAM = [1.2, 1.6, 2.2] * u.um
# a faint source: noise is the same in all data, and the null is zero
FAINT = {"flux": 1e6, "read_noise": 500.0}
TWICE = np.repeat(np.linspace(45, 132.5, 8), 2) * u.deg


def polarized(make, degree):
    """The chain behind a source that is polarized by a given degree."""
    optics_behind = list(make.truth(make.chain(wavelength=LAM)))[1:]
    settings = {"theta": 20 * u.deg, "fixed": {"diattenuation": True}, "name": "source"}
    return join([optics.Diattenuator(diattenuation=degree, **settings), *optics_behind])


@pytest.fixture(scope="module")
def chain(make):
    return polarized(make, 0.02)


@pytest.fixture(scope="module")
def strong(make):
    return polarized(make, 0.9)


@pytest.fixture(scope="module")
def faint(make, chain):
    return Measurement(chain, simulate(chain, LAM, make.frames(), seed=4, **FAINT))


@pytest.fixture(scope="module")
def repeated(make, chain):
    return Measurement(chain, simulate(chain, LAM, make.frames(TWICE), seed=5, **FAINT))


def percent(quantity):
    return quantity.to_value(u.percent)


# --- known --------------------------------------------------------------------------


def test_noise_from_errors_is_that_of_the_measurement(faint):
    noise = noise_from_errors(faint)
    np.testing.assert_array_equal(noise.sigma_of_data, faint.sigma)
    for b, sigma in enumerate(percent(noise.sigma)):
        rms = np.sqrt(np.mean(faint.sigma[faint.bins == b] ** 2))
        assert sigma == pytest.approx(100 * rms)
    assert np.isinf(noise.dof).all()


def test_photon_noise_by_hand(faint):
    """Unpolarized light: var x = var(R) / (2 I^2) with I the flux of one beam... of 4 beams."""
    obs = faint.datasets[0].observations
    noise = noise_from_errors(faint, gain=2.0, read_noise=100.0)
    total = np.nanmean(obs.flux_right + obs.flux_left, axis=0)
    # 4 independent beams of variance total / 2 / gain + (rn / gain)^2 over (2 total)^2
    variance = 4 * (total / 2 / 2.0 + (100 / 2.0) ** 2) / (2 * total) ** 2
    np.testing.assert_allclose(percent(noise.sigma), 100 * np.sqrt(variance), rtol=2e-3)


def test_gain_of_the_table_reproduces_the_errors_of_the_simulation(make, chain):
    data = simulate(chain, LAM, make.frames(), noise=False, gain=3.0, read_noise=20.0)
    measurement = Measurement(chain, data)
    noise = noise_from_errors(measurement, gain=3.0, read_noise=20.0)
    np.testing.assert_allclose(noise.sigma_of_data, measurement.sigma, rtol=1e-12)


def test_gain_may_have_its_unit(faint):
    plain = noise_from_errors(faint, gain=2.0, read_noise=100.0)
    gain, read_noise = 2 * u.electron / u.adu, 100 * u.electron
    noise = noise_from_errors(faint, gain=gain, read_noise=read_noise)
    np.testing.assert_array_equal(noise.sigma_of_data, plain.sigma_of_data)
    assert noise.words == plain.words


def test_impossible_gain_is_refused(faint):
    wrong = 0.0, np.nan, -1.0, [1, 2], "a", 1 * u.adu
    for settings in [{"gain": gain} for gain in wrong]:
        with pytest.raises(ParameterError, match=r"gain (= |has unit adu)"):
            noise_from_errors(faint, **settings)
        with pytest.raises(ParameterError, match="read_noise = -1"):
            noise_from_errors(faint, gain=1.0, read_noise=-1.0)
    # table without errors needs a gain
    table = faint.datasets[0].observations.to_table()
    table.remove_columns(["flux_right_err", "flux_left_err"])
    bare = Measurement(faint.chains[0], Observations.from_table(table))
    with pytest.raises(FitError, match="96 of 96 data have no error; give gain="):
        noise_from_errors(bare)
    assert np.isfinite(noise_from_errors(bare, gain=1.0).sigma).all()


# --- replicates ---------------------------------------------------------------------


def test_replicates_by_hand(repeated):
    noise = noise_from_replicates(repeated)
    residuals = repeated.residuals()
    part = repeated.datasets[0]
    hwp, stage = (part.positions[name][0] for name in ("hwp", "derotator"))
    rows = data_by_wavelength(repeated)[2][1]
    same = {}
    for row in rows:
        g = part.group_of_datum[row]
        same.setdefault((round(hwp[g], 6), round(stage[g], 6)), []).append(residuals[row])
    squares = sum(np.sum((np.array(v) - np.mean(v)) ** 2) for v in same.values())
    assert {len(v) for v in same.values()} == {2}
    assert noise.dof[1] == 32
    assert percent(noise.sigma)[1] == pytest.approx(100 * np.sqrt(squares / 32))


def test_replicates_do_not_depend_on_the_model(repeated):
    wrong = repeated.copy()
    wrong.stand_at(repeated.vector() * 1.01 + 0.01)
    sigma = noise_from_replicates(wrong).sigma
    np.testing.assert_allclose(sigma, noise_from_replicates(repeated).sigma, rtol=1e-9)


def test_replicates_find_the_noise_put_in(repeated):
    ratio = noise_from_replicates(repeated).sigma / noise_from_errors(repeated).sigma
    # relative error of a standard deviation from 32 degrees of freedom: 12.5 %
    np.testing.assert_allclose(ratio, 1, atol=0.4)


def test_small_differences_of_position_are_modelled(make, strong):
    """A plate that stands 0.05 deg off in the repetition changes the data, not the noise."""
    frames = make.frames(TWICE)
    second = np.tile(np.repeat([0, 1], 8), 8).astype(bool)
    frames["hwp"] = frames["hwp"] + np.where(second, 0.05, 0.0) * u.deg
    measurement = Measurement(strong, simulate(strong, LAM, frames, noise=False))
    assert percent(noise_from_replicates(measurement).sigma).max() < 1e-9
    with pytest.raises(FitError, match=r"no two data at the same settings within 0\.01 deg"):
        noise_from_replicates(measurement, tolerance=0.01 * u.deg)


def test_nothing_repeated_is_said(faint, make, chain):
    with pytest.raises(FitError, match="simulated: no two data at the same settings"):
        noise_from_replicates(faint)
    # nor are other states of a modulator, or of what else the chain knows
    cells = [optics.StateRetarder(mount=f"lcvr={state}", name=f"lc_{state}") for state in "AB"]
    left = []
    for column, own in (("flc_state", chain), ("lcvr", join([*cells, chain])), ("set", chain)):
        frames = make.frames(TWICE)
        frames[column] = np.tile(np.repeat(["A", "B"], 8), 8)
        measurement = Measurement(own, simulate(own, LAM, frames, seed=1, **FAINT))
        left.append(noise_from_null_channel(measurement).dof[0])
        if column == "set":
            # what it does not know changes nothing
            assert noise_from_replicates(measurement).dof[0] == 32
            continue
        with pytest.raises(FitError, match="no two data"):
            noise_from_replicates(measurement)
    # of each state the null has a constant of its own at each of the 8 derotator angles
    assert left[0] == left[1] == left[2] - 8


def test_states_of_a_single_beam_are_no_replicates():
    wheel = [
        optics.StateAnalyser(efficiency=0.95, theta=a * u.deg, mount=f"filter=P{a}", name=f"p{a}")
        for a in (0, 60, 120)
    ]
    lamp = optics.LinearPolarizer(mount="calibrator", name="calibrator")
    chain = join([lamp, optics.LinearRetarder(retardance=90 * u.deg, name="mirror"), *wheel])
    angle = np.arange(0, 180, 15.0)
    for turns, freedom in ((1, 0), (2, 24)):
        frames = QTable({"calibrator": np.tile(np.repeat(angle, 3), turns) * u.deg})
        frames["group"] = np.repeat(np.arange(12 * turns), 3)
        frames["filter"] = np.tile(["P0", "P60", "P120"], 12 * turns)
        measurement = Measurement(chain, simulate(chain, LAM, frames, noise=False))
        if freedom:
            assert (noise_from_replicates(measurement).dof == freedom).all()
            continue
        with pytest.raises(FitError, match="no two data"):
            noise_from_replicates(measurement)


def test_settings_of_replicates_that_cannot_be(repeated):
    for tolerance in ([1, 2] * u.deg, *([np.nan, -1, 91, 200] * u.deg)):
        with pytest.raises(ParameterError, match=r"tolerance = .*one angle from 0 to 90 deg"):
            noise_from_replicates(repeated, tolerance=tolerance)


def test_masked_data_do_not_count(repeated):
    data = repeated.datasets[0].observations
    mask = np.zeros((data.n_frames, 3), dtype=bool)
    mask[0, 2] = True
    noise = noise_from_replicates(Measurement(repeated.chains[0], data.with_mask(mask, "test")))
    assert noise.dof.tolist() == [32, 32, 31]


@given(
    st.lists(st.floats(-720, 720), min_size=1, max_size=30), st.floats(0.01, 30), st.floats(-1, 1)
)
def testequal_axes_are_no_wider_than_the_tolerance(angles, tolerance, turn):
    axis = np.deg2rad(angles)
    label = equal_axes(axis, np.deg2rad(tolerance))
    for k in np.unique(label):
        members = axis[label == k]
        apart = np.abs(np.mod(members[:, None] - members + np.pi / 2, np.pi) - np.pi / 2)
        assert np.rad2deg(apart.max()) <= tolerance + 1e-6
    same = equal_axes(axis + np.pi * np.rint(3 * turn), np.deg2rad(tolerance))
    if np.ptp(np.mod(np.array(angles) * 64, 1.0)) == 0:
        np.testing.assert_array_equal(same, label)


def testequal_axes_join_0_and_180_deg():
    label = equal_axes(np.deg2rad([179.99, 45, 0.01, 180, 45.02]), np.deg2rad(0.1))
    assert label[0] == label[2] == label[3]
    assert label[1] == label[4] != label[0]


# --- the null channel ---------------------------------------------------------------


def test_null_channel_by_hand(make):
    """Unpolarized light has neither a null of its own nor a signal: mean by derotator angle."""
    chain = polarized(make, 0.0)
    measurement = Measurement(chain, simulate(chain, LAM, make.frames(), seed=4, **FAINT))
    obs = measurement.datasets[0].observations
    x = (obs.flux_right - obs.flux_left) / (obs.flux_right + obs.flux_left)
    null = x[obs.pairs()].mean(axis=1).reshape(8, 4, 3)
    squares = np.sum((null - null.mean(axis=1, keepdims=True)) ** 2, axis=(0, 1))
    noise = noise_from_null_channel(measurement)
    assert noise.dof.tolist() == [24, 24, 24]
    np.testing.assert_allclose(percent(noise.sigma), 100 * np.sqrt(squares / 24))


@pytest.mark.slow
def test_null_channel_finds_the_noise_put_in(make, chain):
    """Over 20 runs its variance is the true one within three standard errors."""
    for null_model, dof in [("constant", 23), ("smooth", 11)]:
        found, true = [], []
        for seed in range(20):
            measurement = Measurement(
                chain, simulate(chain, LAM, make.frames(), seed=seed, **FAINT)
            )
            noise = noise_from_null_channel(measurement, null_model=null_model)
            assert (noise.dof == dof).all(), (null_model, dof)
            found.append(percent(noise.sigma) ** 2)
            true.append(percent(noise_from_errors(measurement).sigma) ** 2)
        ratio = np.mean(found) / np.mean(true)
        assert abs(ratio - 1) < 3 * np.sqrt(2 / (20 * 3 * dof)), (null_model, dof)


def test_single_frames_are_noisier_than_pairs(make, chain, faint):
    data = faint.datasets[0].observations
    single = Measurement(chain, data, observable="normalized_single_difference")
    ratio = noise_from_null_channel(single).sigma / noise_from_null_channel(faint).sigma
    np.testing.assert_allclose(ratio, np.sqrt(2))
    expected = noise_from_errors(single).sigma / noise_from_errors(faint).sigma
    np.testing.assert_allclose(expected, np.sqrt(2), rtol=1e-3)


def test_brightness_of_the_source_cancels(make, strong):
    lamp = np.exp(np.random.default_rng(1).normal(0, 0.3, 64))
    measurement = Measurement(strong, simulate(strong, LAM, make.frames(), lamp=lamp, noise=False))
    assert percent(noise_from_null_channel(measurement).sigma).max() < 1e-9


def test_plate_that_is_not_half_a_wave_is_in_the_chain(make, strong):
    """Its sine, times the crosstalk of the derotator, leaves a null: percents, were it noise."""
    measurement = Measurement(strong, simulate(strong, LAM, make.frames(), noise=False))
    ideal = measurement.vector()
    for name in ("hwp.w_sio2", "hwp.w_mgf2"):
        ideal[measurement.free.by_name[name].slice] *= 1.02
    assert percent(noise_from_null_channel(measurement).sigma).max() < 1e-9
    measurement.stand_at(ideal)
    assert percent(noise_from_null_channel(measurement).sigma).max() > 0.01


def test_unequal_beams_are_taken_away(make, strong):
    """The null of beams unequal by e is e (1 - x^2), percents here; left are terms in e^2."""
    table = simulate(strong, LAM, make.frames(), noise=False).to_table()
    table["flux_right"] *= 1.1
    measurement = Measurement(strong, Observations.from_table(table))
    e = 0.1 / 2.1
    assert 0 < percent(noise_from_null_channel(measurement).sigma).max() < 100 * e**2 / 10


def test_diattenuation_that_the_chain_lacks_is_an_upper_limit(make, strong):
    """Of the derotator, 2 %: for strongly polarized light far above the noise put in."""
    true = list(strong)
    behind = optics.Diattenuator(diattenuation=0.02, mount="derotator", name="coating")
    data = simulate(join([*true[:3], behind, true[3]]), LAM, make.frames(), seed=1)
    measurement = Measurement(strong, data)
    noise, limit = noise_from_errors(measurement), noise_from_null_channel(measurement)
    assert (limit.sigma > 3 * noise.sigma).all()
    smooth = noise_from_null_channel(measurement, null_model="smooth")
    assert np.median(smooth.sigma / limit.sigma) < 0.7


def test_too_few_angles_for_the_null_model(make, chain):
    data = simulate(chain, LAM, make.frames([45, 80] * u.deg), seed=1)
    with pytest.raises(FitError, match="no degree of freedom left by the smooth null model"):
        noise_from_null_channel(Measurement(chain, data), null_model="smooth")
    with pytest.raises(FitError, match="null_model = 'cubic'; allowed are constant, smooth"):
        noise_from_null_channel(Measurement(chain, data), null_model="cubic")


# --- choice, several datasets ------------------------------------------------


def test_each_dataset_has_its_own_noise(make, chain, faint):
    brighter = simulate(chain, LAM, make.frames(), seed=9, **(FAINT | {"flux": 1e8}))
    both = Measurement(chain, [faint.datasets[0].observations, brighter])
    noise = noise_from_null_channel(both)
    assert noise.dataset.tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_allclose(noise.sigma[:3], noise_from_null_channel(faint).sigma)
    assert (noise.sigma[3:] < 0.1 * noise.sigma[:3]).all()
    assert "upper limit" in noise.words


# --- real measurements --------------------------------------------------------------


def smooth_null(measurement):
    return np.median(percent(noise_from_null_channel(measurement, null_model="smooth").sigma))


def test_noise_of_unpolarized_charis_data(charis_data):
    """Dataset 4, median over the wavelengths: 0.014 %, near the 0.010 % of the table."""
    data = charis_data("dataset4_")
    measurement = Measurement(CHARIS.chains_for([data]), data)
    assert 0.010 < smooth_null(measurement) < 0.018
    assert np.median(percent(noise_from_errors(measurement).sigma)) == pytest.approx(0.0104, 0.01)


@pytest.mark.slow
def test_noise_of_polarized_charis_data(charis_fit):
    """Datasets 1 and 3: 0.041 and 0.028 %, a tenth of the residuals; nothing was repeated."""
    for number, low, high in [(1, 0.035, 0.048), (3, 0.022, 0.034)]:
        cal = charis_fit(number)
        assert low < smooth_null(cal.measurement) < high, (number, low, high)
        assert smooth_null(cal.measurement) < 0.15 * np.median(percent(cal.accuracy["s_res"])), (
            number,
            low,
            high,
        )
        with pytest.raises(FitError, match="no two data"):
            noise_from_replicates(cal.measurement)
