# Licensed under a 3-clause BSD style license - see LICENSE
"""Single and double differences and sums are linear in the beams."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.correction.solve import CHANNELS, Channels
from astropolcal.exceptions import ObservationError, ParameterError

#: Right and left beam of four frames.
FLUX = np.array([[60.0, 50.0, 58.0, 44.0], [40.0, 54.0, 42.0, 57.0]])
#: A frame in two pairs, one backwards, one in none.
PAIRS = [(0, 1), (3, 0)]
EXPECTED = {
    "intensity": FLUX,
    "single": [[20.0, -4.0, 16.0, -13.0], [100.0, 104.0, 100.0, 101.0]],
    # (20 + 4) / 2 and (-13 - 20) / 2; (100 + 104) / 2 and (101 + 100) / 2
    "double": [[12.0, -16.5], [102.0, 100.5]],
}


EVERY = [Channels(observable, 4, PAIRS) for observable in CHANNELS]


def matrix(channels):
    """Return the channels as a matrix on the beams, of what `combine` makes of each alone."""
    unit = np.eye(8).reshape(8, 2, 4)
    return np.stack([channels.combine(one).ravel() for one in unit], axis=1)


def test_numbers():
    for channels in EVERY:
        np.testing.assert_array_equal(channels.combine(FLUX), EXPECTED[channels.observable])


def test_frames_of_the_units():
    for channels in EVERY:
        expected = [[0], [1], [2], [3]] if channels.observable != "double" else PAIRS
        np.testing.assert_array_equal(channels.units, expected)


def test_images_are_combined_pixel_by_pixel():
    for channels in EVERY:
        images = np.random.default_rng(1).normal(size=(2, 4, 3, 5, 6))
        found = channels.combine(images)
        one = channels.combine(images[:, :, 1, 2, 3])
        np.testing.assert_allclose(found[:, :, 1, 2, 3], one, rtol=1e-14, atol=1e-15)
        assert found.shape == (2, len(channels.units), 3, 5, 6), channels.observable


def test_variances_are_the_diagonal_of_the_propagated_covariance():
    """For independent beams: diag(M V M^T)."""
    for channels in EVERY:
        m, variances = matrix(channels), np.array([[4.0, 1.0, 9.0, 2.0], [3.0, 5.0, 7.0, 6.0]])
        expected = np.diag(m @ np.diag(variances.ravel()) @ m.T)
        np.testing.assert_allclose(channels.combine(variances, 2).ravel(), expected, rtol=1e-14)


def test_gains_of_beams_are_the_transposed_matrix():
    for channels in EVERY:
        gain = np.random.default_rng(2).normal(size=(7, 2, len(channels.units)))
        found = channels.to_beams(gain)
        expected = gain.reshape(7, -1) @ matrix(channels)
        np.testing.assert_allclose(found.reshape(7, -1), expected, rtol=1e-13, atol=1e-15)


@given(st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4))
def test_what_both_beams_share_is_in_no_difference(common):
    """Background under both beams, the reason to take differences at all."""
    for kind in ("single", "double"):
        channels = Channels(kind, 4, PAIRS)
        moved = channels.combine(FLUX + np.array(common))
        np.testing.assert_allclose(moved[0], channels.combine(FLUX)[0], atol=1e-9)


@given(st.floats(0.5, 2.0))
def test_a_constant_offset_between_the_beams_leaves_double_differences(offset):
    double = Channels("double", 4, PAIRS)
    moved = FLUX + np.array([[offset], [-offset]])
    np.testing.assert_allclose(double.combine(moved)[0], double.combine(FLUX)[0], atol=1e-12)
    single = Channels("single", 4).combine(moved)[0]
    np.testing.assert_allclose(single, np.array(EXPECTED["single"][0]) + 2 * offset)


def test_what_cannot_be():
    for observable, pairs, error, words in [
        ("triple", PAIRS, ParameterError, r"'triple'; allowed are intensity, single, double"),
        ("double", None, ObservationError, "need pairs of frames, and there is none"),
        ("double", [], ObservationError, "need pairs of frames, and there is none"),
        ("double", [(0, 4)], ObservationError, r"frames 0 to 4; there are 0 to 3"),
        ("double", [(-1, 2)], ObservationError, r"frames -1 to 2; there are 0 to 3"),
    ]:
        with pytest.raises(error, match=words):
            Channels(observable, 4, pairs)
