# Licensed under a 3-clause BSD style license - see LICENSE
"""Parts of a grid against plain indexing, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ObservationError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.grid import build_grid
from astropolcal.observations.table import masked_grid, some_bins, some_frames

ARRAYS = ("flux_right", "flux_left")


@pytest.fixture(scope="module")
def grid():
    """Four frames of three bins with fluxes that all differ."""
    table = example_table()
    table["flux_right"] *= np.linspace(1.0, 2.0, len(table))
    return build_grid(table, "night")


@pytest.fixture(scope="module")
def holed(grid):
    """The same without the first frame, and without the last bin of the second."""
    grid = masked_grid(grid, np.arange(4) == 0, "cloud", "night")
    cell = np.zeros((4, 3), dtype=bool)
    cell[1, 2] = True
    return masked_grid(grid, cell, "cosmic ray", "night")


# ---- masks ---------------------------------------------------------------------------


def test_masked_cells_lose_fluxes_and_errors(grid):
    mask = np.zeros((4, 3), dtype=bool)
    mask[2, 1] = mask[3, 0] = True
    found = masked_grid(grid, mask, "  faint ", "night")
    for name in ARRAYS:
        np.testing.assert_array_equal(np.isnan(getattr(found, name)), mask)
        np.testing.assert_array_equal(getattr(found, name)[~mask], getattr(grid, name)[~mask])
    for name, error in found.errors.items():
        np.testing.assert_array_equal(np.isnan(error), mask, err_msg=name)
    assert found.reasons == ("faint",)
    np.testing.assert_array_equal(found.reason, mask.astype(int))


def test_a_row_of_booleans_masks_whole_frames(grid):
    found = masked_grid(grid, np.array([False, True, False, True]), "cloud", "night")
    assert (found.reason > 0).all(axis=1).tolist() == [False, True, False, True]


def test_first_reason_stays_and_known_reasons_are_not_repeated(holed):
    assert holed.reasons == ("cloud", "cosmic ray")
    again = masked_grid(holed, np.array([True, True, False, False]), "cosmic ray", "night")
    assert again.reasons == ("cloud", "cosmic ray")
    assert again.reason.tolist() == [[1, 1, 1], [2, 2, 2], [0, 0, 0], [0, 0, 0]]


def test_a_grid_is_not_changed(grid):
    before = grid.flux_right.copy()
    masked_grid(grid, np.array([True, False, False, False]), "cloud", "night")
    np.testing.assert_array_equal(grid.flux_right, before)
    assert grid.reasons == ()


def test_bad_masks_are_refused(grid):
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
            masked_grid(grid, mask, reason, "night")


def test_the_last_usable_cell_counts_with_those_masked_before(holed):
    rest = np.array([False, True, True, True])
    with pytest.raises(ObservationError, match="no usable cell of 12"):
        masked_grid(holed, rest, "cloud", "night")


# ---- frames --------------------------------------------------------------------------


@given(st.lists(st.sampled_from(range(-4, 4)), min_size=1, max_size=4, unique_by=lambda i: i % 4))
def test_frames_come_in_the_order_of_the_table(index):
    grid = build_grid(example_table(), "night")
    wanted = sorted(i % 4 for i in index)
    found = some_frames(grid, index, "night")
    np.testing.assert_array_equal(found.flux_right, grid.flux_right[wanted])
    np.testing.assert_array_equal(
        found.errors["flux_left_err"], grid.errors["flux_left_err"][wanted]
    )
    assert found.frames["frame"].tolist() == wanted
    assert found.rows.tolist() == grid.rows[wanted].tolist()
    flags = np.isin(np.arange(4), wanted)
    np.testing.assert_array_equal(some_frames(grid, flags, "night").flux_left, found.flux_left)


def test_bad_indices_are_refused(grid):
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
            some_frames(grid, frames, "night")


def test_frames_without_a_usable_cell_are_refused(holed):
    assert some_frames(holed, [0, 1], "night").reason.shape == (2, 3)
    with pytest.raises(ObservationError, match="the 1 frame selected have no usable cell"):
        some_frames(holed, [0], "night")


# ---- wavelengths ---------------------------------------------------------------------


def test_bins_keep_their_numbers(grid):
    found = some_bins(grid, [False, True, True], "night")
    assert found.bin.tolist() == [1, 2]
    assert found.wavelength.value.tolist() == [1.6, 2.2]
    np.testing.assert_array_equal(found.flux_left, grid.flux_left[:, 1:])
    for name, error in found.errors.items():
        np.testing.assert_array_equal(error, grid.errors[name][:, 1:])
    assert len(found.frames) == 4


def test_bins_must_be_one_boolean_each(grid):
    for bins in [[0, 1], [True, False], [[True, True, True]], [1.0, 0.0, 1.0]]:
        with pytest.raises(
            ObservationError, match=r"night: bins of type .*; allowed are 3 booleans"
        ):
            some_bins(grid, bins, "night")


def test_no_bin_at_all_has_no_usable_cell(grid):
    with pytest.raises(ObservationError, match="the bins selected have no usable cell"):
        some_bins(grid, [False] * 3, "night")


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
