# Licensed under a 3-clause BSD style license - see LICENSE
"""The example table against what an ideal polarimeter measures."""

import numpy as np

from astropolcal.observations import Observations, example_table
from astropolcal.observations.observables import get_observable


def measure(obs):
    frames = obs.pairs().T
    right, left = (np.swapaxes(flux[frames], 1, 2) for flux in (obs.flux_right, obs.flux_left))
    return get_observable("normalized_double_difference").evaluate(right, left)


def test_example_table_measures_its_polarization():
    for polarization in [0.0, 0.3, 1.0 - 1e-6]:
        obs = Observations.from_table(example_table(polarization=polarization))
        # at 0 deg the double difference is Q, at 22.5 deg it is U = 0
        expected = [[polarization, 0.0]] * 3
        np.testing.assert_allclose(measure(obs), expected, atol=1e-12)


def test_derotator_turns_the_signal():
    # half a wave turns the axis of polarization by twice its angle: cos 4 (hwp - derotator)
    obs = Observations.from_table(example_table(hwp=(0.0, 45.0), derotator=(90.0, 101.25, 112.5)))
    np.testing.assert_allclose(measure(obs)[0], [0.5, 0.5 * np.sqrt(0.5), 0.0], atol=1e-12)


def test_frames_are_numbered_by_stage_and_plate():
    obs = Observations.from_table(example_table(derotator=(45.0, 90.0), wavelength=(1.6,)))
    assert obs.frames["frame"].tolist() == list(range(8))
    assert np.rad2deg(obs.position("derotator")).round(9).tolist() == [45.0] * 4 + [90.0] * 4
    assert np.rad2deg(obs.position("hwp")).round(9).tolist() == [0.0, 22.5, 45.0, 67.5] * 2


def test_errors_are_those_of_photons():
    obs = Observations.from_table(example_table())
    np.testing.assert_allclose(obs.variance_right, obs.flux_right)
    np.testing.assert_allclose(obs.variance_left, obs.flux_left)
