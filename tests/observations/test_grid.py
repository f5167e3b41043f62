# Licensed under a 3-clause BSD style license - see LICENSE
"""The grid of frames and bins against a plain loop over the rows."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.grid import (
    CELL_COLUMNS,
    REQUIRED,
    build_grid,
    mask_missing,
    mask_rows,
)

N_FRAMES, N_BINS = 4, 3
FLUXES = st.sampled_from([np.nan, np.inf, -1.0, 0.0, 3.0, 250.0])


@st.composite
def tables(draw):
    """Draw a table with odd numbers of frames and bins, bad fluxes and rows left out."""
    table = example_table()
    n = N_FRAMES * N_BINS
    names = np.array(draw(st.lists(st.integers(-50, 50), min_size=4, max_size=4, unique=True)))
    bins = np.array(draw(st.lists(st.integers(-9, 40), min_size=3, max_size=3, unique=True)))
    table["frame"], table["bin"] = names[table["frame"]], bins[table["bin"]]
    for name in ("flux_right", "flux_left"):
        table[name] = draw(st.lists(FLUXES, min_size=n, max_size=n)) * u.adu
    rows = draw(st.permutations(range(n)))[: draw(st.integers(3, n))]
    return table[list(rows)]


def quiet_grid(table):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        return build_grid(table, "drawn")


def usable(row):
    return all(0 < row[name].value < np.inf for name in ("flux_right", "flux_left"))


def by_wavelength(table):
    return table["bin"][np.unique(table["wavelength"], return_index=True)[1]].tolist()


@pytest.mark.slow
@given(tables())
def test_grid_agrees_with_a_loop_over_rows(table):
    assume(any(usable(row) for row in table))
    grid = quiet_grid(table)
    frames, bins = sorted(set(table["frame"])), by_wavelength(table)
    assert grid.frames["frame"].tolist() == frames
    assert grid.bin.tolist() == sorted(bins)
    expected = np.full((len(frames), len(bins)), np.nan)
    for row in table:
        if usable(row):
            expected[frames.index(row["frame"]), bins.index(row["bin"])] = row["flux_left"].value
    np.testing.assert_array_equal(grid.flux_left, expected)
    np.testing.assert_array_equal(grid.reason > 0, np.isnan(expected))


@pytest.mark.slow
@given(tables())
def test_every_masked_cell_has_the_right_reason(table):
    assume(any(usable(row) for row in table))
    grid = quiet_grid(table)
    bins = by_wavelength(table)
    given_cells = {(row["frame"], bins.index(row["bin"])): row for row in table}
    for i, j in np.ndindex(grid.reason.shape):
        cell = grid.frames["frame"][i], j
        code = grid.reason[i, j]
        reason = grid.reasons[code - 1] if code else None
        if cell not in given_cells:
            assert reason == "missing"
            continue
        both = [given_cells[cell][name].value for name in ("flux_right", "flux_left")]
        if not np.isfinite(both).all():
            assert reason == "flux not finite"
        elif min(both) <= 0:
            assert reason == "flux not positive"
        else:
            assert reason is None


@pytest.mark.slow
@given(tables())
def test_a_table_without_a_usable_cell_is_refused(table):
    assume(not any(usable(row) for row in table))
    with pytest.raises(ObservationError, match="cells are masked"):
        quiet_grid(table)


@pytest.mark.slow
@given(tables())
def test_to_table_and_back(table):
    assume(any(usable(row) for row in table))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        first = Observations.from_table(table)
    # the reasons are declared now, so nothing warns
    again = Observations.from_table(first.to_table())
    assert again.content_hash == first.content_hash
    assert again.mask_reasons == first.mask_reasons
    np.testing.assert_array_equal(again.flux_right, first.flux_right)


def test_rows_say_where_a_frame_starts():
    table = example_table()
    assert build_grid(table, "x").rows.tolist() == [1, 4, 7, 10]
    assert build_grid(table[::-1], "x").rows.tolist() == [10, 7, 4, 1]


def test_display_formats_of_a_file_are_dropped():
    # a format such as '>1000000000' would hang whoever prints the table
    table = example_table()
    table["hwp"].info.format = ">1000000"
    assert build_grid(table, "x").frames["hwp"].info.format is None


def test_required_columns_are_not_optional():
    for name in REQUIRED:
        table = example_table()
        table.remove_column(name)
        with pytest.raises(ObservationError, match=f"x: missing column {name}; it has "):
            build_grid(table, "x")


def test_columns_of_cells_do_not_appear_among_the_frames():
    grid = build_grid(example_table(), "x")
    assert not set(grid.frames.colnames) & set(CELL_COLUMNS)


def test_mask_rows_respects_declared_reasons():
    table = example_table()[:3]
    table["mask_reason"] = ["", "cosmic ray", ""]
    values = {"flux_right": np.array([1.0, np.nan, 2.0]), "flux_left": np.array([1.0, 1.0, 0.0])}
    with pytest.warns(AstropolcalWarning, match=r"x: 1 cell masked, flux not pos.*first: row 3"):
        code, reasons = mask_rows(table, values, "x")
    assert code.tolist() == [0, 1, 2]
    assert reasons == ["cosmic ray", "flux not positive"]


def test_mask_missing_joins_a_declared_reason():
    code, reasons = np.array([[0, -1], [1, 0]]), ["missing"]
    with pytest.warns(AstropolcalWarning, match=r"first: frame 7, bin 4 has no row"):
        mask_missing(code, reasons, [7, 8], [2, 4], "x")
    assert code.tolist() == [[0, 1], [1, 0]]
    assert reasons == ["missing"]
