# Licensed under a 3-clause BSD style license - see LICENSE
"""Parts of observations against plain indexing, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ObservationError
from astropolcal.observations import Observations, example_table

ARRAYS = ("flux_right", "flux_left")


@pytest.fixture(scope="module")
def whole():
    """Four frames of three bins with fluxes that all differ."""
    table = example_table()
    table["flux_right"] *= np.linspace(1.0, 2.0, len(table))
    return Observations.from_table(table, name="night")


@pytest.fixture(scope="module")
def holed(whole):
    """The same without the first frame, and without the last bin of the second."""
    obs = whole.with_mask(np.arange(4) == 0, "cloud")
    cell = np.zeros((4, 3), dtype=bool)
    cell[1, 2] = True
    return obs.with_mask(cell, "cosmic ray")


# ---- masks ---------------------------------------------------------------------------


def test_masked_cells_lose_fluxes_and_errors(whole):
    mask = np.zeros((4, 3), dtype=bool)
    mask[2, 1] = mask[3, 0] = True
    found = whole.with_mask(mask, "  faint ")
    for name in ARRAYS:
        np.testing.assert_array_equal(np.isnan(getattr(found, name)), mask)
        np.testing.assert_array_equal(getattr(found, name)[~mask], getattr(whole, name)[~mask])
    for name, error in found._grid.errors.items():
        np.testing.assert_array_equal(np.isnan(error), mask, err_msg=name)
    assert found._grid.reasons == ("faint",)
    np.testing.assert_array_equal(found._grid.reason, mask.astype(int))


def test_a_row_of_booleans_masks_whole_frames(whole):
    found = whole.with_mask(np.array([False, True, False, True]), "cloud")
    assert found.mask.all(axis=1).tolist() == [False, True, False, True]


def test_first_reason_stays_and_known_reasons_are_not_repeated(holed):
    assert holed._grid.reasons == ("cloud", "cosmic ray")
    again = holed.with_mask(np.array([True, True, False, False]), "cosmic ray")
    assert again._grid.reasons == ("cloud", "cosmic ray")
    assert again._grid.reason.tolist() == [[1, 1, 1], [2, 2, 2], [0, 0, 0], [0, 0, 0]]


def test_observations_are_not_changed(whole):
    before = whole.flux_right.copy()
    whole.with_mask(np.array([True, False, False, False]), "cloud")
    np.testing.assert_array_equal(whole.flux_right, before)
    assert whole._grid.reasons == ()


def test_bad_masks_are_refused(whole):
    for mask, reason, words in [
        (np.zeros((4, 3)), "x", r"mask of type float64 and shape \(4, 3\); .*\(4, 3\) or \(4,\)"),
        (np.zeros(3, dtype=bool), "x", r"shape \(3,\); allowed are booleans of shape"),
        (np.zeros((3, 4), dtype=bool), "x", r"shape \(3, 4\)"),
        (np.zeros(4, dtype=bool), "", "reason = '', some words are needed"),
        (np.zeros(4, dtype=bool), "   ", "some words are needed"),
        (np.zeros(4, dtype=bool), None, "reason = None"),
        (np.ones(4, dtype=bool), "cloud", "masking 'cloud' would leave no usable cell of 12"),
    ]:
        with pytest.raises(ObservationError, match=f"night: .*{words}|night: {words}"):
            whole.with_mask(mask, reason)


def test_the_last_usable_cell_counts_with_those_masked_before(holed):
    rest = np.array([False, True, True, True])
    with pytest.raises(ObservationError, match="no usable cell of 12"):
        holed.with_mask(rest, "cloud")


# ---- frames --------------------------------------------------------------------------


@given(st.lists(st.sampled_from(range(-4, 4)), min_size=1, max_size=4, unique_by=lambda i: i % 4))
def test_frames_come_in_the_order_of_the_table(index):
    whole = Observations.from_table(example_table(), name="night")
    wanted = sorted(i % 4 for i in index)
    found = whole.select(index)
    np.testing.assert_array_equal(found.flux_right, whole.flux_right[wanted])
    np.testing.assert_array_equal(
        found._grid.errors["flux_left_err"], whole._grid.errors["flux_left_err"][wanted]
    )
    assert found.frames["frame"].tolist() == wanted
    assert found._grid.rows.tolist() == whole._grid.rows[wanted].tolist()
    flags = np.isin(np.arange(4), wanted)
    np.testing.assert_array_equal(whole.select(flags).flux_left, found.flux_left)


def test_bad_indices_are_refused(whole):
    for frames, words in [
        ([4], "frame index 4, allowed are 0 to 3"),
        ([-5, 0], "frame index -5, allowed are 0 to 3"),
        ([1, 2, 1], "frame index 1 is given twice"),
        ([3, -1], "frame index 3 is given twice"),
        ([True, False], r"frames of type bool and shape \(2,\)"),
        ([0.0, 1.0], "frames of type float64"),
        ([[0, 1]], r"shape \(1, 2\); allowed are 4 booleans or a list of indices"),
        ([], "frames of type float64"),
    ]:
        with pytest.raises(ObservationError, match=f"night: .*{words}|night: {words}"):
            whole.select(frames)


def test_frames_without_a_usable_cell_are_refused(holed):
    assert holed.select([0, 1]).mask.shape == (2, 3)
    with pytest.raises(ObservationError, match="the 1 frame selected have no usable cell"):
        holed.select([0])


# ---- wavelengths ---------------------------------------------------------------------


def test_bins_keep_their_numbers(whole):
    found = whole.select_bins([False, True, True])
    assert found.bin.tolist() == [1, 2]
    assert found.wavelength.value.tolist() == [1.6, 2.2]
    np.testing.assert_array_equal(found.flux_left, whole.flux_left[:, 1:])
    for name, error in found._grid.errors.items():
        np.testing.assert_array_equal(error, whole._grid.errors[name][:, 1:])
    assert len(found.frames) == 4


def test_bins_must_be_one_boolean_each(whole):
    for bins in [[0, 1], [True, False], [[True, True, True]], [1.0, 0.0, 1.0]]:
        with pytest.raises(
            ObservationError, match=r"night: bins of type .*; allowed are 3 booleans"
        ):
            whole.select_bins(bins)


def test_no_bin_at_all_has_no_usable_cell(whole):
    with pytest.raises(ObservationError, match="the bins selected have no usable cell"):
        whole.select_bins([False] * 3)


# ---- together ------------------------------------------------------------------------


def test_frames_and_bins_commute_and_masks_follow():
    obs = Observations.from_table(example_table(), name="night")
    obs = obs.with_mask(obs.flux_right < 400, "faint")
    one = obs.select([0, 2]).select_bins([True, False, True])
    other = obs.select_bins([True, False, True]).select([0, 2])
    assert one.content_hash == other.content_hash
    np.testing.assert_array_equal(one.mask, obs.mask[[0, 2]][:, [0, 2]])
    # a mask made before or after the selection is the same
    plain = Observations.from_table(example_table(), name="night").select([0, 2])
    late = plain.with_mask(plain.flux_right < 400, "faint").select_bins([True, False, True])
    assert late.content_hash == one.content_hash
