# Licensed under a 3-clause BSD style license - see LICENSE
"""Patterns over the frames: which there are, and which the angles cannot tell apart."""

from types import SimpleNamespace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.gap.residuals import (
    _harmonics,
    badly_separated,
    frame_blocks,
    frame_patterns,
)

PLATE = np.arange(8) * 11.25
ORDER = "the order of frames within a block at one derotator angle"


def run(**degrees):
    """A dataset with the angles (degree) of its frames."""
    angles = {name: np.deg2rad(np.asarray(values, float)) for name, values in degrees.items()}
    n = len(next(iter(angles.values())))
    positions = angles | {"sequence": np.linspace(0, 1, n) if n > 1 else np.zeros(1)}
    return SimpleNamespace(n_frames=n, frame_columns=list(angles), position=positions.__getitem__)


def cycles(derotator, plate=PLATE):
    return run(hwp=np.tile(plate, len(derotator)), derotator=np.repeat(derotator, len(plate)))


def words(observations, axis):
    return [text for which, text in frame_patterns(observations) if which == axis]


# ---- harmonics -----------------------------------------------------------------------------


def test_harmonic_is_a_cosine_and_a_sine():
    found = frame_patterns(cycles([45, 70, 95]))
    angle = np.deg2rad(np.tile(PLATE, 3))
    columns = found["hwp", "harmonic 4 of the half-wave-plate angle"]
    np.testing.assert_allclose(columns, [np.cos(4 * angle), np.sin(4 * angle)], atol=1e-12)
    constant = found["hwp", "what is constant in the half-wave-plate angle"]
    np.testing.assert_array_equal(constant, np.ones((1, 24)))


def test_a_wave_that_vanishes_at_all_angles_is_left_out():
    # the sine of four times 0, 45 and 90 deg
    found = _harmonics(np.deg2rad([0.0, 45.0, 90.0, 22.5]), "derotator", (8,))
    ((_, columns),) = found.items()
    np.testing.assert_allclose(columns, [[1, 1, 1, -1]], atol=1e-12)


def test_harmonics_that_the_angles_cannot_tell_have_the_simpler_name():
    # at steps of 45 deg harmonic 8 is constant, and harmonics 1 and 7 are the same
    angle = np.deg2rad(np.arange(8) * 45.0)
    found = _harmonics(angle, "derotator", (0, 4, 2, 8, 1, 3, 5, 6, 7, 12))
    assert [text for _, text in found] == [
        "what is constant in the derotator angle",
        *(f"harmonic {k} of the derotator angle" for k in (4, 2, 1, 3)),
    ]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_no_harmonic_lies_in_the_span_of_an_earlier_one(seed):
    angle = np.random.default_rng(seed).integers(0, 16, 20) * np.deg2rad(22.5)
    spans = [c for (_, _), c in _harmonics(angle, "hwp", (0, 4, 2, 8, 1, 3)).items()]
    for i, columns in enumerate(spans):
        for other in spans[:i]:
            left = columns - columns @ np.linalg.pinv(other) @ other
            assert np.abs(left).max() > 1e-6


# ---- other patterns ------------------------------------------------------------------------


def test_trend_is_orthogonal_to_a_constant_and_of_two_degrees():
    found = frame_patterns(cycles([45, 70]))["time", "a trend through the run"]
    x = np.linspace(-1, 1, 16)
    np.testing.assert_allclose(found, [x, (3 * x**2 - 1) / 2], atol=1e-12)


def test_products_are_of_plate_and_another_angle():
    observations = cycles([10, 20, 40, 70])
    found = frame_patterns(observations)
    plate, turn = observations.position("hwp"), observations.position("derotator")
    title = "harmonic 4 of the half-wave-plate angle times harmonic 2 of the derotator angle"
    expected = [
        one(4 * plate) * two(2 * turn) for one in (np.cos, np.sin) for two in (np.cos, np.sin)
    ]
    np.testing.assert_allclose(found["hwp x derotator", title], expected, atol=1e-12)
    # the first harmonic of the derotator has no optics behind it
    assert not [text for _, text in found if "times harmonic 1 " in text]


def test_products_need_a_harmonic_of_the_plate():
    found = frame_patterns(run(derotator=[10, 20, 70]))
    assert ("derotator", "harmonic 2 of the derotator angle") in found
    assert not [axis for axis, _ in found if " x " in axis]


def test_a_plate_that_stands_still_leaves_its_constant():
    found = frame_patterns(run(hwp=[10.0] * 6, derotator=[1, 2, 3, 4, 5, 60]))
    assert words(run(hwp=[10.0] * 6), "hwp") == ["what is constant in the half-wave-plate angle"]
    assert all(np.ptp(c) > 0 for (axis, _), c in found.items() if axis == "derotator")


def test_a_pattern_that_grows_through_the_run():
    observations = cycles([10, 20])
    title = "harmonic 4 of the half-wave-plate angle with a trend through the run"
    found = frame_patterns(observations)["time x hwp", title]
    expected = np.cos(4 * observations.position("hwp")) * np.linspace(-1, 1, 16)
    np.testing.assert_allclose(found[0], expected, atol=1e-12)
    assert ("time x hwp", title) not in frame_patterns(run(derotator=[10, 20, 30]))


def test_sky_angles_have_their_harmonics():
    observations = run(altitude=[30, 40, 55, 60], parallactic=[-40, -10, 20, 60])
    assert words(observations, "altitude") == [
        "harmonic 2 of the altitude angle",
        "harmonic 4 of the altitude angle",
    ]
    assert len(words(observations, "parallactic")) == 2


# ---- order of the frames -------------------------------------------------------------------


def test_blocks():
    for derotator, blocks in [
        ([45, 45, 60, 60, 60], [0, 0, 1, 1, 1]),
        # the same angle again is another run
        ([45, 60, 45], [0, 1, 2]),
        # less than half a degree is none
        ([45, 45.4, 45.8, 50], [0, 0, 0, 1]),
        ([7], [0]),
    ]:
        assert frame_blocks(run(derotator=derotator)).tolist() == blocks


def test_frames_without_a_derotator_are_their_own_blocks():
    assert frame_blocks(run(hwp=[0, 45, 0])).tolist() == [0, 1, 2]


def test_order_counts_from_minus_one_to_one_in_each_block():
    found = frame_patterns(run(derotator=[1] * 3 + [20] * 5 + [40]))["time", ORDER]
    x = np.array([-1, 0, 1, -1, -0.5, 0, 0.5, 1, 0])
    single = np.arange(9) == 8
    np.testing.assert_allclose(found[0], x)
    np.testing.assert_allclose(found[1], np.where(single, 0, (3 * x**2 - 1) / 2))


def test_blocks_of_two_frames_have_no_order():
    assert ("time", ORDER) not in frame_patterns(run(hwp=[0, 45], derotator=[1, 20]))


# ---- what is badly separated ---------------------------------------------------------------


def test_the_dataset_with_the_better_angles_counts():
    short, full = run(hwp=PLATE), run(hwp=np.arange(32) * 11.25)
    assert "harmonic 1 of the half-wave-plate angle" in badly_separated([short])
    assert "harmonic 1 of the half-wave-plate angle" not in badly_separated([short, full])


def test_without_a_plate_nothing_is_badly_separated():
    assert badly_separated([run(derotator=[10, 20, 30])]) == {}


def test_the_same_order_of_the_angles():
    """Angles half a turn apart are the same; a little jitter does not matter."""
    for jitter, same in [(0.3, True), (2.0, False)]:
        plate = np.concatenate([PLATE, PLATE + 180 + jitter * (np.arange(8) == 3)])
        observations = run(hwp=plate, derotator=np.repeat([10, 40], 8))
        assert (ORDER in badly_separated([observations])) == same
