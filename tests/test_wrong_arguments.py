# Licensed under a 3-clause BSD style license - see LICENSE
"""Arguments of the wrong type, in the wrong order or without an angle get one clear error."""

import astropy.units as u
import numpy as np
import pytest

import astropolcal
from astropolcal import Library, calibrate, correct, diagnose, instruments, load, simulate
from astropolcal.exceptions import AstropolcalError
from astropolcal.measurement import Measurement
from astropolcal.simulation import half_wave_plate_cycles

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
