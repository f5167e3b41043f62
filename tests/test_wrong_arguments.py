# Licensed under a 3-clause BSD style license - see LICENSE
"""Arguments of the wrong type, in the wrong order or without an angle get one clear error."""

import astropy.units as u
import numpy as np
import pytest

import astropolcal
from astropolcal import Library, calibrate, correct, diagnose, instruments, load, simulate
from astropolcal.calibration.uncertainty import (
    derived_efficiency,
    derived_mueller,
    derived_retardance,
    derived_sky,
)
from astropolcal.chain import system_mueller
from astropolcal.correction import ideal_chain, measurement_rows
from astropolcal.efficiency import best_modulation, polarimetric_efficiency
from astropolcal.exceptions import AstropolcalError
from astropolcal.gap.challenge import make_challenge
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.reduction import simulate_cubes
from astropolcal.simulation import half_wave_plate_cycles
from astropolcal.testing import check_instrument

WAVELENGTH = [1200, 1600] * u.nm


@pytest.fixture(scope="module")
def run():
    chain = instruments.get("charis").chain(derotator="linear", wavelength=WAVELENGTH)
    return chain, simulate(chain, WAVELENGTH, half_wave_plate_cycles(), seed=1)


def test_arguments_of_the_wrong_type_are_named(run):
    chain, data = run
    mistakes = {
        "chain": [lambda: calibrate("charis", data), lambda: Measurement([chain, 3], [data] * 2)],
        "observations": [
            lambda: calibrate(data, chain),
            lambda: calibrate(chain, "run.ecsv"),
            lambda: calibrate(chain, [data, None]),
            lambda: diagnose(data, chain),
        ],
        "frames": [
            lambda: simulate(chain, WAVELENGTH, None),
            lambda: simulate(chain, WAVELENGTH, [0, 45]),
            lambda: correct(chain, data),
            lambda: correct(data, chain),
        ],
        "calibration": [lambda: diagnose("cal.asdf", data), lambda: diagnose([3], data)],
        "path": [lambda: Observations.read(data.to_table())],
        "the source of calibrations": [lambda: load(3), lambda: Library(None)],
    }
    for name, calls in mistakes.items():
        for call in calls:
            with pytest.raises(AstropolcalError, match=f"^{name} is of type .*; .* needed"):
                call()


def test_a_sample_is_of_a_calibration(run):
    pytest.importorskip("emcee")
    with pytest.raises(AstropolcalError, match="calibration is of type str"):
        astropolcal.sample("calibration.asdf")


def test_cycles_have_finite_angles():
    for wrong in ([np.nan] * u.deg, [] * u.deg, [45], [45] * u.m, np.inf * u.rad):
        for name in ("hwp", "derotator"):
            with pytest.raises(AstropolcalError, match=name):
                half_wave_plate_cycles(**{name: wrong})


def refusal(call, value):
    """Return how our own error tells that a value is not accepted."""
    try:
        call(value)
    except AstropolcalError as error:
        return str(error)
    return "accepted"


@pytest.fixture(scope="module")
def cal(run):
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    return calibrate(run[0], simulate(run[0], WAVELENGTH, frames, seed=1), cross_validate=False)


def test_wavelengths_are_lengths_above_zero(run, cal):
    chain, data = run
    at = {"hwp": [0, 22.5] * u.deg, "derotator": 45 * u.deg}
    calls = {
        "simulate": lambda w: simulate(chain, w, half_wave_plate_cycles()),
        "calibrate": lambda w: calibrate(chain, data, wavelength=w),
        "derived_retardance": lambda w: derived_retardance(cal, "hwp", w),
        "derived_retardance of values": lambda w: derived_retardance(cal, "derotator", w),
        "derived_efficiency": lambda w: derived_efficiency(cal, w),
        "derived_mueller": lambda w: derived_mueller(cal, at, w),
        "derived_sky": lambda w: derived_sky(cal, 0.0, 0.0, at, wavelength=w),
        "system_mueller": lambda w: system_mueller(chain, w, at),
        "of a calibration": lambda w: load(cal).system_mueller(at, wavelength=w),
        "efficiency": lambda w: polarimetric_efficiency(chain, w, derotator=45 * u.deg),
        "ideal_chain": lambda w: ideal_chain(chain, w),
        "measurement_rows": lambda w: measurement_rows(chain, at, w),
        "mode_header": lambda w: instruments.get("vampires").mode_header(w),
        "on_sky": lambda w: instruments.get("irdis").on_sky(
            instruments.get("irdis").chain(), wavelength=w, date="2020-01-01"
        ),
    }
    for name in ("charis", "irdis", "vampires"):
        calls[name] = lambda w, name=name: instruments.get(name).chain(wavelength=w)
    wrong = ([1.4] * u.s, 1.4, [np.nan, 1.4] * u.um, -1.4 * u.um, [0] * u.um, [] * u.um, "H")
    for name, call in calls.items():
        for value in (*wrong, np.inf * u.um, [None]):
            assert refusal(call, value) != "accepted", (name, value)


def test_seeds_are_whole_numbers(run, cal, tmp_path):
    pytest.importorskip("emcee")
    chain, _ = run
    charis, frames = instruments.get("charis"), half_wave_plate_cycles()
    calls = {
        "sample": lambda seed: astropolcal.sample(cal, n_steps=2, seed=seed),
        "simulate": lambda seed: simulate(chain, WAVELENGTH, frames, seed=seed),
        "simulate_cubes": lambda seed: simulate_cubes(
            tmp_path, charis.chain(), charis, frames, seed=seed
        ),
        "make_challenge": make_challenge,
        "best_modulation": lambda seed: best_modulation(
            chain, WAVELENGTH, frames, ["hwp"], seed=seed
        ),
        "check_instrument": lambda seed: check_instrument(charis, seed=seed),
    }
    for name, call in calls.items():
        for seed in ("x", -1, 1.5, object()):
            assert "allowed are whole numbers" in refusal(call, seed), (name, seed)
