# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors of aperture fluxes against draws of noise, and units of detectors."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ObservationError
from astropolcal.instruments.layout import FileLayout, ReadOut
from astropolcal.reduction.photometry import (
    Detector,
    detector_of,
    flux_variance,
    shared_background,
    shared_pixels,
)

ADU = Detector(u.adu, 2.0, 5.0, 4e4)


def layout(gain=2.0, read_noise=10.0, saturation=4e4, excess=1.0):
    how = ReadOut(gain, read_noise, saturation, excess)
    return SimpleNamespace(read_out=lambda values: how)


# ---- detectors -----------------------------------------------------------------------


def test_variance_is_that_of_drawn_electrons():
    rng, signal = np.random.default_rng(1), 300.0
    electrons = rng.poisson(signal * ADU.gain, 200_000)
    electrons = electrons + rng.normal(0.0, ADU.read_noise * ADU.gain, electrons.size)
    assert np.var(electrons / ADU.gain) == pytest.approx(ADU.variance(signal), rel=0.02)


def test_light_below_zero_has_no_photon_noise():
    assert ADU.variance(np.array([-100.0, 0.0, 100.0])).tolist() == [25.0, 25.0, 75.0]


def test_excess_noise_multiplies_photons_only():
    # sqrt(2) for many stages of multiplication (Robbins & Hadwen 2003)
    multiplied = Detector(u.adu, 2.0, 5.0, 4e4, excess_noise=np.sqrt(2))
    assert multiplied.variance(100.0) == pytest.approx(2 * 50 + 25)
    assert multiplied.photon_noise(100.0) == pytest.approx(2 * ADU.photon_noise(100.0))


def test_each_beam_has_its_detector_if_there_are_two():
    left = Detector(u.adu, 4.0, 1.0, 1e4)
    both = Detector(u.adu, 2.0, 5.0, 4e4, left=left)
    assert (both.of(0), both.of(1)) == (both, left)
    assert (ADU.of(0), ADU.of(1)) == (ADU, ADU)


@given(st.floats(0.1, 10), st.floats(0.1, 10), st.floats(1, 1e4))
def test_other_units_describe_the_same_electrons(own, other, electrons):
    """Relative noise and saturation in electrons do not depend on the unit of the data."""
    first = Detector(u.adu, own, 30.0 / own, 1e5 / own)
    second = first.in_units_of(Detector(u.electron, other, 1.0, 1.0))
    assert (second.unit, second.gain) == (u.electron, other)
    assert second.saturation * other == pytest.approx(1e5)
    noise = [np.sqrt(d.variance(electrons / d.gain)) * d.gain for d in (first, second)]
    assert noise[0] == pytest.approx(noise[1])


def test_gain_counts_electrons_of_one_unit_of_the_data():
    for unit, seconds, gain in [
        (None, None, 2.0),
        ("", None, 2.0),
        ("ADU", None, 2.0),
        ("counts", None, 2.0),
        ("DN", None, 2.0),
        ("electrons", None, 1.0),
        ("e-", None, 1.0),
        ("electron", 10.0, 1.0),
        ("adu/s", 10.0, 20.0),
        ("counts / s", 10.0, 20.0),
        ("e-/s", 10.0, 10.0),
        ("kadu", None, 2000.0),
        ("adu/min", 60.0, 2.0),
    ]:
        found = detector_of(layout(), unit, {"exposure_time": seconds})
        assert found.gain == pytest.approx(gain), (unit, seconds, gain)
        # 10 electrons of read noise, saturated at 4e4 adu
        assert found.read_noise * found.gain == pytest.approx(10.0), (unit, seconds, gain)
        assert found.saturation * found.gain == pytest.approx(8e4), (unit, seconds, gain)


def test_electrons_of_a_mean_are_those_of_all_exposures():
    camera = FileLayout({}, (1, 8, 8), gain=2.0, read_noise=10.0, saturation=4e4)
    for unit, one in [("adu", 1.0), ("electron", 2.0)]:
        found = detector_of(camera, unit, {"exposures": 4.0})
        # a mean of 100 adu: 800 electrons in all, each read with 10 electrons of noise
        relative = np.sqrt(found.variance(100.0 * one)) / (100.0 * one)
        assert relative == pytest.approx(np.sqrt(800 + 4 * 10**2) / 800), unit
        assert found.saturation == pytest.approx(4e4 * one, rel=1e-5), unit


def test_a_full_pixel_is_saturated_in_any_unit_and_read_out():
    for gain in np.linspace(0.05, 2.0, 40):
        for unit, one in [("adu", 1.0), ("electron", gain)]:
            found = detector_of(layout(gain=gain, saturation=65535.0), unit)
            # as files have it
            assert np.float32(65535.0 * one) >= found.saturation, (unit, gain)
            assert np.float32(65000.0 * one) < found.saturation, (unit, gain)


def test_other_units_are_refused():
    for unit in ["Jy", "adu2", "adu m", "1e-17 erg", "per second", "s / adu"]:
        with pytest.raises(ObservationError, match=f"BUNIT = '{unit}'; allowed are adu, electron"):
            detector_of(layout(), unit)


def test_rate_needs_the_exposure_time():
    for unit in ["adu/s", "electron/s"]:
        with pytest.raises(ObservationError, match="is a rate, and the exposure time is unknown"):
            detector_of(layout(), unit)


# ---- fluxes --------------------------------------------------------------------------


def apertures(n_background, n_draws=4000, area=40, sigma=3.0, seed=2):
    """Return fluxes of two apertures on noise, less one median of other pixels."""
    rng = np.random.default_rng(seed)
    sums = rng.normal(0.0, sigma * np.sqrt(area), (2, n_draws))
    level = np.median(rng.normal(0.0, sigma, (n_draws, n_background)), axis=1)
    return sums - area * level


def test_median_of_the_background_adds_to_the_variance():
    for n_background in [100, 1000]:
        fluxes = apertures(n_background)
        expected = flux_variance(0.0, 40.0, 9.0, n_background)
        assert np.var(fluxes) == pytest.approx(expected, rel=0.05), n_background
        # without it, the variance is clearly another one
        assert expected > 1.05 * flux_variance(0.0, 40.0, 9.0), n_background


def test_common_background_makes_beams_agree():
    fluxes = apertures(100)
    expected = shared_background(40.0, 40.0, 9.0, 100)
    assert np.cov(fluxes)[0, 1] == pytest.approx(expected, rel=0.1)


@given(st.floats(0, 1e6), st.floats(1, 1e3), st.floats(0, 100), st.floats(1, 1e4))
def test_variances_of_flux_add(photons, area, pixel, n_background):
    whole = float(flux_variance(photons, area, pixel, n_background))
    assert whole >= photons
    parts = flux_variance(photons, area, pixel), flux_variance(0.0, 0.0, pixel)
    background = shared_background(area, area, pixel, n_background)
    assert whole == pytest.approx(float(parts[0] + parts[1] + background))


def test_overlap_of_two_circles_by_counting():
    for distance in [0.0, 3.0, 7.5, 12.0, 19.9]:
        step, radius = 0.02, 10.0
        x, y = np.meshgrid(np.arange(-10, 30, step), np.arange(-10, 10, step))
        both = (np.hypot(x, y) < radius) & (np.hypot(x - distance, y) < radius)
        found = shared_pixels(distance, radius, 4.0)
        assert found == pytest.approx(4.0 * both.sum() * step**2, rel=0.01, abs=0.05), distance


def test_circles_that_do_not_meet_share_nothing():
    assert shared_pixels(np.array([20.0, 25.0, 1e3]), 10.0, 4.0).tolist() == [0.0, 0.0, 0.0]
