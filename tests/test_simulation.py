# Licensed under a 3-clause BSD style license - see LICENSE
"""Simulated observations: what the chain gives, and the statistics of the noise."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import instruments, optics
from astropolcal.chain import with_beam
from astropolcal.exceptions import AstropolcalWarning, ChainError, ParameterError
from astropolcal.propagation import Propagator
from astropolcal.simulation import (
    check_seed,
    entering_flux,
    expected_fluxes,
    half_wave_plate_cycles,
    simulate,
)

CHARIS = instruments.get("charis")
WAVELENGTH = [1.2, 1.6, 2.2] * u.um


@pytest.fixture
def chain():
    return CHARIS.chain(wavelength=WAVELENGTH)


@pytest.fixture
def frames():
    return half_wave_plate_cycles(derotator=[45, 80, 110] * u.deg)


# --- frames ---------------------------------------------------------------------------


def test_cycle_is_that_of_a_calibration_run():
    frames = half_wave_plate_cycles()
    assert frames["hwp"].to_value(u.deg).tolist() == [0, 45, 11.25, 56.25, 22.5, 67.5, 33.75, 78.75]
    assert set(frames["derotator"].to_value(u.deg)) == {45}


def test_every_derotator_angle_has_a_cycle():
    frames = half_wave_plate_cycles([0, 45] * u.deg, [10, 20, 30] * u.deg)
    assert frames["hwp"].to_value(u.deg).tolist() == [0, 45] * 3
    assert frames["derotator"].to_value(u.deg).tolist() == [10, 10, 20, 20, 30, 30]


# --- without noise ----------------------------------------------------------------------


def test_fluxes_without_noise_are_those_of_the_chain(chain, frames):
    observations = simulate(chain, WAVELENGTH, frames, flux=2e6, noise=False)
    positions = {stage: frames[stage].to_value(u.rad) for stage in ("hwp", "derotator")}
    right, left = Propagator(chain, WAVELENGTH.to_value(u.um), positions).fluxes()
    np.testing.assert_allclose(observations.flux_right, 2e6 * right.T, rtol=1e-14)
    np.testing.assert_allclose(observations.flux_left, 2e6 * left.T, rtol=1e-14)


@settings(max_examples=15)
@given(hwp=st.floats(-180, 180), derotator=st.floats(-180, 180), q=st.floats(-0.7, 0.7))
def test_one_frame_agrees_with_the_call_of_the_astropy_model(hwp, derotator, q):
    """The chain evaluated as a plain compound model, an independent way through the optics."""
    chain = CHARIS.chain(wavelength=WAVELENGTH)
    chain["hwp"].position, chain["derotator"].position = hwp * u.deg, derotator * u.deg
    frames = half_wave_plate_cycles([hwp] * u.deg, [derotator] * u.deg)
    source = (1.0, q, 0.3, 0.2)
    observations = simulate(chain, WAVELENGTH, frames, flux=1e5, noise=False, source=source)
    for beam in ("right", "left"):
        flux = with_beam(chain, beam)(WAVELENGTH, *source)[1]
        measured = getattr(observations, f"flux_{beam}")[0]
        np.testing.assert_allclose(measured, 1e5 * np.broadcast_to(flux, 3), rtol=1e-10)


def test_flux_may_depend_on_wavelength_and_lamp_on_time(chain, frames):
    plain = simulate(chain, WAVELENGTH, frames, flux=1.0, noise=False)
    flux, lamp = np.array([1e5, 2e5, 3e5]), np.linspace(1, 2, len(frames))
    bright = simulate(chain, WAVELENGTH, frames, flux=flux, lamp=lamp, noise=False)
    expected = plain.flux_right * flux[None, :] * lamp[:, None]
    np.testing.assert_allclose(bright.flux_right, expected, rtol=1e-14)


def test_gain_changes_errors_but_not_fluxes(chain, frames):
    one, four = (simulate(chain, WAVELENGTH, frames, gain=g, noise=False) for g in (1.0, 4.0))
    np.testing.assert_allclose(one.flux_left, four.flux_left, rtol=1e-14)
    np.testing.assert_allclose(one.variance_left, 4 * four.variance_left, rtol=1e-12)


def test_errors_hold_photon_and_read_noise(chain, frames):
    observations = simulate(chain, WAVELENGTH, frames, gain=2.0, read_noise=30.0, noise=False)
    expected = (2.0 * observations.flux_right + 30.0**2) / 2.0**2
    np.testing.assert_allclose(observations.variance_right, expected, rtol=1e-12)


def test_what_a_simulation_is_given_may_have_units(chain, frames):
    one, count = {"seed": 1, "flux": 2e6, "gain": 2.0, "read_noise": 30.0}, len(frames)
    plain = simulate(chain, WAVELENGTH, frames, **one, lamp=np.full(count, 0.5))
    units = {"flux": u.adu, "gain": u.electron / u.adu, "read_noise": u.electron}
    given = {key: one[key] * unit for key, unit in units.items()}
    lamp = np.full(count, 50) * u.percent
    found = simulate(chain, WAVELENGTH, frames, **given, seed=1, lamp=lamp)
    np.testing.assert_allclose(found.flux_right, plain.flux_right, rtol=1e-12)
    np.testing.assert_allclose(found.variance_right, plain.variance_right, rtol=1e-12)
    for key in units:
        with pytest.raises(ParameterError, match=f"{key} has unit s, which is not convertible"):
            simulate(chain, WAVELENGTH, frames, **given | {key: 1 * u.s})


def test_table_keeps_frames_meta_and_name(chain, frames):
    frames["time"] = np.arange(len(frames)) * u.s
    meta = {"source": "polarized", "instrument": "CHARIS"}
    observations = simulate(chain, WAVELENGTH, frames, meta=meta, name="night 1", seed=0)
    assert observations.name == "night 1"
    assert observations.source == "polarized"
    assert observations.meta["simulated"] is True
    np.testing.assert_array_equal(observations.frames["time"], frames["time"])
    assert observations.wavelength.to_value(u.um).tolist() == [1.2, 1.6, 2.2]


def test_one_wavelength_may_be_a_scalar(frames):
    chain = optics.LinearPolarizer() | optics.WollastonPrism(efficiency=0.9)
    assert simulate(chain, 1.6 * u.um, frames, seed=0).n_bins == 1


def test_extinguished_beam_is_no_error():
    """A rounding error below zero, as crossed polarizers give, is not an unphysical chain."""
    chain = (
        optics.LinearPolarizer(theta=33 * u.deg)
        | optics.LinearRetarder(retardance=180 * u.deg, theta=33 * u.deg, mount="hwp")
        | optics.WollastonPrism(theta=33 * u.deg)
    )
    frames = half_wave_plate_cycles([0, 22.5, 45, 67.5] * u.deg)
    with pytest.warns(AstropolcalWarning, match="flux not positive"):
        observations = simulate(chain, 1.6 * u.um, frames, noise=False)
    assert observations.mask.any()
    assert not observations.mask.all()


# --- noise ----------------------------------------------------------------------------


def test_noise_has_the_mean_and_variance_of_its_errors():
    """1e5 draws: the mean to 5 and the variance to 5 standard errors, with gain and read noise."""
    n = 50_000
    chain = optics.LinearPolarizer() | optics.WollastonPrism(efficiency=0.5)
    frames = half_wave_plate_cycles([0.0] * u.deg, np.zeros(n) * u.deg)
    settings = {"flux": 400.0, "gain": 2.5, "read_noise": 12.0}
    clean = simulate(chain, 1.6 * u.um, frames, noise=False, **settings)
    noisy = simulate(chain, 1.6 * u.um, frames, seed=3, **settings)
    for beam in ("right", "left"):
        error = getattr(noisy, f"flux_{beam}") - getattr(clean, f"flux_{beam}")
        variance = getattr(clean, f"variance_{beam}")[0, 0]
        assert abs(error.mean()) < 5 * np.sqrt(variance / n)
        assert error.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / n))


def test_noise_of_the_beams_is_independent():
    n = 20_000
    chain = optics.LinearPolarizer() | optics.WollastonPrism(efficiency=0.5)
    frames = half_wave_plate_cycles([0.0] * u.deg, np.zeros(n) * u.deg)
    noisy = simulate(chain, 1.6 * u.um, frames, flux=1e4, seed=4)
    correlation = np.corrcoef(noisy.flux_right[:, 0], noisy.flux_left[:, 0])[0, 1]
    assert abs(correlation) < 5 / np.sqrt(n)


def test_seed_makes_the_noise_reproducible(chain, frames):
    first, same, other = (simulate(chain, WAVELENGTH, frames, seed=s) for s in (1, 1, 2))
    assert first.content_hash == same.content_hash
    assert first.content_hash != other.content_hash


def test_generator_goes_on_where_it_stands(chain, frames):
    rng = np.random.default_rng(1)
    first, second = (simulate(chain, WAVELENGTH, frames, seed=rng) for _ in range(2))
    assert first.content_hash == simulate(chain, WAVELENGTH, frames, seed=1).content_hash
    assert first.content_hash != second.content_hash


# --- bad input ------------------------------------------------------------------------


def test_bad_numbers_are_refused(chain, frames):
    for options, words in [
        ({"flux": 0.0}, "flux = 0.0 must be finite and positive"),
        ({"flux": -1.0}, "flux"),
        ({"flux": np.nan}, "flux"),
        ({"gain": 0.0}, "gain = 0.0 must be finite and positive"),
        ({"read_noise": -1.0}, "read_noise = -1.0 must be finite and not negative"),
        ({"read_noise": np.inf}, "read_noise"),
        ({"lamp": np.zeros(24)}, "lamp"),
        ({"flux": 1e300}, r"flux = 1e\+300: allowed is up to 1e\+18"),
        ({"flux": 1e17, "gain": 1e9}, r"flux and gain give .*e\+2\d electrons.* up to 1e\+18"),
        ({"read_noise": 1e300}, r"read_noise = 1e\+300: allowed is up to 1e\+18"),
        ({"flux": np.ones(4)}, r"flux has shape \(4,\).*allowed are a scalar or \(3,\)"),
        ({"lamp": np.ones(5)}, r"lamp \(5,\).*\(24,\)"),
    ]:
        with pytest.raises(ParameterError, match=words):
            simulate(chain, WAVELENGTH, frames, **options)
    with pytest.raises(ParameterError, match="at least one frame is needed"):
        simulate(chain, WAVELENGTH, frames[:0])


def test_unphysical_chain_is_refused(frames):
    amplifier = optics.MuellerElement(m01=1.5, name="amplifier")
    chain = optics.LinearPolarizer(theta=90 * u.deg) | amplifier | optics.WollastonPrism()
    with pytest.raises(ParameterError, match="negative flux"):
        simulate(chain, 1.6 * u.um, frames)

    class Broken(optics.Optic):
        """Of a user, with a mistake."""

        def _matrix(self, dispersion):
            return np.nan * np.eye(4)

        def _derivatives(self, dispersion):
            return ()

    for noise in (True, False):
        with pytest.raises(ParameterError, match="flux that is not a number"):
            simulate(Broken() | optics.WollastonPrism(), 1.6 * u.um, frames, noise=noise)


def test_values_per_wavelength_are_those_of_ascending_wavelengths(chain, frames):
    """As a calibration takes them, whatever the order of the rows."""
    with pytest.raises(ParameterError, match="ascending"):
        simulate(chain, WAVELENGTH[::-1], frames)
    plain = optics.LinearPolarizer(theta=20 * u.deg) | optics.WollastonPrism()
    up = simulate(plain, WAVELENGTH, frames, noise=False)
    with pytest.warns(AstropolcalWarning, match="do not ascend; here they do"):
        down = simulate(plain, WAVELENGTH[::-1], frames, noise=False)
    np.testing.assert_allclose(up.flux_right, down.flux_right)


def test_stage_without_position_is_refused(chain, frames):
    frames.remove_column("hwp")
    with pytest.raises(ChainError, match="stage 'hwp'"):
        simulate(chain, WAVELENGTH, frames)


def test_chain_without_beam_splitter_has_one_beam(frames):
    found = simulate(optics.LinearPolarizer(), 1.6 * u.um, frames, flux=100, noise=False)
    assert found.single_beam
    np.testing.assert_allclose(found.flux_right, 50)
    assert {"flux", "flux_err"} < set(found.to_table().colnames)


# ---- parts -------------------------------------------------------------------------------


def test_expected_fluxes_of_an_ideal_polarimeter():
    """R, L = (1 +- q cos 4 hwp) / 2 of half a wave and an ideal splitter, at all wavelengths."""
    chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp") | optics.WollastonPrism()
    hwp = np.linspace(0, 90, 9) * u.deg
    table = half_wave_plate_cycles(hwp=hwp)
    right, left = expected_fluxes(chain, [1.2, 1.6] * u.um, table, (1.0, 0.3, 0.0, 0.0))
    modulation = 0.3 * np.cos(4 * hwp)
    np.testing.assert_allclose(right, np.broadcast_to((1 + modulation) / 2, (2, 9)), atol=1e-12)
    np.testing.assert_allclose(left, np.broadcast_to((1 - modulation) / 2, (2, 9)), atol=1e-12)


def test_expected_fluxes_are_linear_in_the_source(chain, frames):
    sources = np.array([1.0, 0.0, 0.0, 0.0]) + np.random.default_rng(3).uniform(-0.3, 0.3, (2, 4))
    summed = (*sources, sources.sum(axis=0))
    one, two, both = (expected_fluxes(chain, WAVELENGTH, frames, source) for source in summed)
    for a, b, total in zip(one, two, both, strict=True):
        np.testing.assert_allclose(a + b, total, rtol=1e-12)


def test_true_angle_goes_before_the_commanded_one():
    chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp") | optics.WollastonPrism()
    table = half_wave_plate_cycles(hwp=[0.0] * u.deg)
    table["hwp_true"] = [45.0] * u.deg
    right, left = expected_fluxes(chain, [1.6] * u.um, table, (1.0, 1.0, 0.0, 0.0))
    assert (right[0, 0], left[0, 0]) == pytest.approx((0.0, 1.0), abs=1e-12)
    # rounding below zero is cut off, so that a Poisson draw is possible
    assert right.min() >= 0.0


def test_flux_that_enters_is_lamp_times_flux():
    for flux, lamp, expected in [
        (10.0, None, [[10, 10], [10, 10], [10, 10]]),
        ([10.0, 20.0], None, [[10, 20], [10, 20], [10, 20]]),
        (10.0, [1.0, 0.5, 2.0], [[10, 10], [5, 5], [20, 20]]),
        ([10.0, 20.0], [1.0, 0.5, 2.0], [[10, 20], [5, 10], [20, 40]]),
    ]:
        assert entering_flux(flux, lamp, 3, 2).tolist() == expected, (flux, lamp, expected)


def test_flux_of_another_shape_or_sign_is_refused():
    for flux, lamp, words in [
        ([1.0, 2.0, 3.0], None, r"flux has shape \(3,\) and lamp \(3,\); allowed are a scalar or"),
        (1.0, [1.0, 2.0], r"lamp \(2,\)"),
        (0.0, None, "flux = 0.0 must be finite and positive"),
        (np.inf, None, "flux = inf must be finite"),
        (1.0, [1.0, -1.0, 1.0], "lamp = .* must be finite and positive"),
    ]:
        with pytest.raises(ParameterError, match=words):
            entering_flux(flux, lamp, 3, 2)


# --- seeds ------------------------------------------------------------------------------


def test_seed_that_is_none_is_refused(chain, frames):
    for seed in [-1, 1.5, "a"]:
        for noise in [True, False]:
            with pytest.raises(
                ParameterError, match=f"seed = {seed!r}; allowed are whole numbers from 0"
            ):
                simulate(chain, WAVELENGTH, frames, seed=seed, noise=noise)


def test_seed_is_returned_and_a_generator_left_as_it_is():
    assert check_seed(None) is None
    assert check_seed(0) == 0
    rng = np.random.default_rng(3)
    assert check_seed(rng) is rng
    assert rng.random() == np.random.default_rng(3).random()
