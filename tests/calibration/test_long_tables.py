# Licensed under a 3-clause BSD style license - see LICENSE
"""Fits of many frames: the same results, and work that grows as the number of frames."""

import time

import astropy.units as u
import numpy as np
import pytest
from star_data import CHARIS, observe_star

from astropolcal import calibrate
from astropolcal.calibration.fit import strategies as fit_module
from astropolcal.calibration.validation import cross_validation as accuracy
from astropolcal.calibration.validation.cross_validation import cross_validated_residuals
from astropolcal.exceptions import FitError
from astropolcal.measurement import Measurement
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1200, 1600, 2200] * u.nm


def lamp(n_frames, seed=1):
    truth = CHARIS.chain("polarized", wavelength=LAM)
    truth["derotator"].horizontal = [-240, -95, -55] * u.deg
    truth["calibration_polarizer"].theta = 90.5 * u.deg
    frames = half_wave_plate_cycles(derotator=np.linspace(45, 127, n_frames // 8) * u.deg)
    return CHARIS.chain("polarized", wavelength=LAM), simulate(truth, LAM, frames, seed=seed)


@pytest.fixture(scope="module")
def long():
    return lamp(2400)


def test_thinned_measurement_is_a_part_of_the_whole(long):
    whole = Measurement(*long)
    whole.stand_at(whole.vector() + 0.01)
    fewer, kept = whole.thinned(100)
    vector = whole.vector()
    assert fewer.n_data == kept.sum() == 300
    np.testing.assert_array_equal(fewer.vector(), vector)
    np.testing.assert_array_equal(fewer.observed, whole.observed[kept])
    np.testing.assert_allclose(fewer.predict(vector), whole.predict(vector)[kept], rtol=1e-12)
    np.testing.assert_allclose(fewer.jacobian(vector), whole.jacobian(vector)[:, kept], atol=1e-14)


def test_thinning_leaves_the_whole_as_it_is(long):
    whole = Measurement(*long)
    before = whole.vector()
    fewer, _ = whole.thinned(50)
    fewer.stand_at(before + 0.1)
    fewer.put_back()
    np.testing.assert_array_equal(whole.vector(), before)
    chain = whole.put_back()[0]
    assert chain["calibration_polarizer"].theta.value == 90


def test_short_measurement_is_not_thinned():
    whole = Measurement(*lamp(64))
    fewer, kept = whole.thinned(100)
    assert kept.all()
    assert fewer.n_data == whole.n_data


@pytest.mark.slow
def test_fit_of_a_long_table_ends_where_one_without_the_short_cut_does(long, monkeypatch):
    for weights in [None, "wavelength", "errors"]:
        quick = calibrate(*long, cross_validate=False, weights=weights)
        monkeypatch.setattr(fit_module, "_LONG", 1000)
        slow = calibrate(*long, cross_validate=False, weights=weights)
        assert quick.converged, weights
        assert slow.converged, weights
        residuals = [np.sum((c.residuals / c.measurement.sigma) ** 2) for c in (quick, slow)]
        assert residuals[0] == pytest.approx(residuals[1], rel=1e-6), weights


@pytest.mark.slow
def test_time_is_linear_in_the_number_of_frames():
    def seconds(n_frames):
        chain, data = lamp(n_frames)
        start = time.process_time()
        calibrate(chain, data)
        return time.process_time() - start

    seconds(320)
    assert seconds(9600) < 12 * max(seconds(2400), 0.3)


# --- cross-validation with many groups ----------------------------------------------------------


@pytest.mark.slow
def test_groups_in_one_step_are_as_fits_without_them(monkeypatch):
    for weighted in [False, True]:
        chain, data = lamp(160, seed=5)
        cal = calibrate(chain, data, cross_validate=False)
        measurement = cal.measurement
        weights = 1 / measurement.sigma if weighted else None
        fitted = calibrate(
            chain, data, cross_validate=False, weights="errors" if weighted else None
        )
        vector = fitted.measurement.vector()
        linear = cross_validated_residuals(measurement, weights)
        monkeypatch.setattr(accuracy, "_MANY", 1000)
        exact = cross_validated_residuals(measurement, weights)
        assert np.isfinite(linear).all(), weighted
        # larger than the residuals of the fit, by the same
        change = exact - measurement.residuals(vector)
        assert np.std(linear - exact) < 0.02 * np.std(change), weighted


def test_group_that_alone_determines_something_is_not_predicted(monkeypatch):
    chain, data = lamp(160, seed=5)
    measurement = Measurement(chain, data)
    measurement.stand_at(calibrate(chain, data, cross_validate=False).measurement.vector())
    # one group holds all data of the first wavelength
    labels = np.where(measurement.bins == 0, 0, 1 + np.arange(measurement.n_data) % 20)
    with pytest.raises(FitError, match="the others do not determine"):
        cross_validated_residuals(measurement, groups=labels)


# --- nearly degenerate parameters of stars -----------------------------------------------------


@pytest.mark.slow
def test_power_law_next_to_a_lamp_takes_few_steps():
    lamp_meta = {
        "source": "polarized",
        "nasmyth_beam_switcher": "installed",
        "yjh50_dichroic": "in",
    }
    sources = ("polarized", "unpolarized standard star")
    chains = [
        CHARIS.chain(s, ["dichroic", "nbs"], wavelength=LAM, m3="power law", derotator="linear")
        for s in sources
    ]
    truth = [chain.copy() for chain in chains]
    truth[1]["m3"].b1, truth[1]["m3"].m1 = 14.5, 2.5
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 105] * u.deg)
    data = [
        simulate(truth[0], LAM, frames, seed=1, meta=lamp_meta),
        observe_star(truth[1], 12, seed=2),
    ]
    cal = calibrate(chains, data, cross_validate=False)
    assert cal.converged
    assert cal.fit["evaluations"] < 60
    found = cal.chains[1]["m3"].diattenuation(LAM)
    np.testing.assert_allclose(found, truth[1]["m3"].diattenuation(LAM), atol=2e-4)
