# Licensed under a 3-clause BSD style license - see LICENSE
"""What triple differences leave of a relay that polarizes, and why it is not to be held."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate, instruments
from astropolcal.measurement import Measurement
from astropolcal.reduction.cubes import both_states
from astropolcal.simulation import half_wave_plate_cycles, simulate

VAMPIRES = instruments.get("vampires")
FIELDS = VAMPIRES.wavelength[:2]
SINGLE, TRIPLE = "normalized_single_difference", "normalized_triple_difference"
META = {"instrument": "SCExAO/VAMPIRES", "flc": "in", "pairing": "flc_state"}
RELAY = "relay.diattenuation"


def _chain(**values):
    chain = VAMPIRES.chain(wavelength=FIELDS, derotator="linear")
    for name, value in values.items():
        optic, key = name.split("__")
        setattr(chain[optic], key, value)
    return chain


@pytest.fixture(scope="module")
def lamp():
    """A source seen through a relay that polarizes by 8 %, in both states of the crystal."""
    frames = both_states(half_wave_plate_cycles(derotator=[45, 60, 75, 90, 105] * u.deg))
    truth = _chain(relay__diattenuation=[0.08, 0.08])
    return simulate(truth, FIELDS, frames, seed=3, flux=1e6, meta=META | {"source": "polarized"})


def _left(chain, data, name):
    """Rms slope of triple over that of single differences, one a wavelength."""
    rms = []
    for observable in (TRIPLE, SINGLE):
        measurement = Measurement(chain, data, observable=observable)
        slopes = measurement.jacobian(measurement.vector())[measurement.free.by_name[name].slice]
        counts = np.bincount(measurement.bins)
        rms.append(np.sqrt(np.sum(slopes**2, axis=1) / counts))
    return rms[0] / rms[1]


def test_little_of_the_relay_is_left_and_most_of_the_plate(lamp):
    assert (_left(_chain(), lamp, RELAY) < 0.1).all()
    assert (_left(_chain(), lamp, "cameras.imbalance") < 0.05).all()
    assert (_left(_chain(), lamp, "hwp.retardance") > 0.3).all()


def test_what_is_left_is_due_to_a_plate_of_less_than_half_a_wave(lamp):
    """With exactly half a wave the plate turns the sign of all it passes, and nothing is left."""
    left = [
        _left(_chain(hwp__retardance=[-angle] * 2 * u.deg), lamp, RELAY).max()
        for angle in (150, 165, 179.99)
    ]
    assert left[0] > left[1] > left[2]
    assert left[2] < 0.02


def test_a_relay_held_at_a_wrong_value_spoils_the_plate(lamp):
    """Free it costs an error; held at 1 % in place of 8 % it shifts the retardance by degrees."""
    true = _chain()["hwp"].retardance.value
    options = {"observable": TRIPLE, "cross_validate": False, "search": False}
    free = calibrate(_chain(), lamp, **options)
    held = calibrate(_chain(), lamp, fix={RELAY: None}, **options)
    known = free.parameter_values()
    plate = known["hwp.retardance"]
    assert (np.abs(plate["value"] - true) < 3 * plate["std"]).all()
    np.testing.assert_allclose(known[RELAY]["value"], 0.08, atol=4 * known[RELAY]["std"].max())
    wrong = held.parameter_values()["hwp.retardance"]
    assert np.abs(wrong["value"] - true).max() > 1
