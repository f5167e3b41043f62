# Licensed under a 3-clause BSD style license - see LICENSE
"""The map of residuals: its cells, its margins, and how it is labelled."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal.plotting.residuals import (
    DataGrid,
    _layout,
    _limit,
    _name_groups,
    _scales,
    plot_residuals,
)


def parts(figure):
    """Map, panel above and panel at the right of the first dataset."""
    main, above, right, *_ = figure.axes
    return main, above, right


def cells(main):
    return main.collections[0].get_array()


@pytest.fixture(scope="module")
def drawn(masked):
    return plot_residuals(masked), DataGrid(masked, 0)


def test_cells_are_the_residuals_in_percent(drawn):
    figure, grid = drawn
    found = cells(parts(figure)[0])
    order, _, _ = _layout(grid)
    lam = np.argsort(grid.wavelength)
    expected = 100 * grid.residual[np.ix_(lam, order)]
    np.testing.assert_allclose(found.filled(np.nan), expected)
    # what was masked stays empty
    assert np.ma.getmaskarray(found).sum() == np.isnan(grid.residual).sum() > 0


def test_data_are_ordered_by_derotator_and_then_by_plate(drawn):
    _, grid = drawn
    order, group, ends = _layout(grid)
    assert np.all(np.diff(grid.derotator[order]) >= -0.5)
    plate = np.rad2deg(grid.position("hwp")[0]) % 90
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        assert np.all(np.diff(plate[order][start:end]) > 0)
        assert len(set(group[start:end])) == 1
    assert ends[-1] == len(order)


def test_margins_are_the_root_mean_squares(drawn):
    figure, grid = drawn
    main, above, right = parts(figure)
    percent = cells(main)
    (steps,) = above.patches
    values, edges, _ = steps.get_data()
    np.testing.assert_allclose(values, np.sqrt((percent**2).mean(axis=0)))
    assert edges.tolist() == list(range(percent.shape[1] + 1))
    (line,) = right.lines
    np.testing.assert_allclose(line.get_xdata(), np.sqrt((percent**2).mean(axis=1)))
    np.testing.assert_allclose(line.get_ydata(), np.sort(grid.wavelength))
    assert right.get_xlim()[0] == 0
    assert right.get_xlim()[1] > line.get_xdata().max()


def test_colours_are_symmetric_and_the_same_in_all_maps(several):
    figure = plot_residuals(several)
    maps = [a for a in figure.axes if a.get_ylabel() == "wavelength (nm)"]
    limits = [a.collections[0].get_clim() for a in maps]
    assert len(maps) == 2
    assert limits[0] == limits[1]
    assert limits[0][0] == -limits[0][1]
    titles = [a.get_title(loc="left") for a in figure.axes]
    assert [t for t in titles if t] == ["polarized", "unpolarized"]


def test_labels_have_units(drawn):
    figure, _ = drawn
    main, above, right = parts(figure)
    assert main.get_ylabel() == "wavelength (nm)"
    assert above.get_ylabel() == right.get_xlabel() == "rms (%)"
    assert figure.axes[-1].get_ylabel() == "observed \N{MINUS SIGN} model (%); grey: masked"
    assert "derotator angle; at each, left to right, half-wave plate at" in main.get_xlabel()
    assert figure.get_suptitle().startswith("Residuals of the normalized double difference")


def test_groups_are_named_by_their_derotator_angle(drawn):
    figure, _ = drawn
    main = parts(figure)[0]
    labels = [text.get_text() for text in main.get_xticklabels()]
    assert labels == ["45°", "57.5°", "82.5°", "107.5°", "132.5°"]
    (lines,) = [c for c in main.collections if hasattr(c, "get_segments")]
    assert len(lines.get_segments()) == len(labels) - 1
    # a label stands in the middle of its group
    borders = [0, *(s[0, 0] for s in lines.get_segments()), len(cells(main)[0])]
    np.testing.assert_allclose(main.get_xticks(), (np.array(borders[1:]) + borders[:-1]) / 2)


def grid_of(residual):
    return SimpleNamespace(residual=np.asarray(residual, float))


@pytest.mark.parametrize(
    ("residual", "limit", "clipped"),
    [
        (np.zeros(50), 1e-12, False),
        (np.full(50, -0.02), 2.0, False),
        # of a thousand data one is far out: it does not blank the others
        ([*([0.01] * 999), 5.0], 1.0, True),
        ([0.01, np.nan, -0.01], 1.0, False),
    ],
)
def test_scale_covers_nearly_all_residuals(residual, limit, clipped):
    found, beyond = _limit([grid_of(residual)])
    assert found == pytest.approx(limit)
    assert beyond == clipped


def test_many_groups_have_few_labels():
    n = 30
    series = [SimpleNamespace(label=f"{i}°") for i in range(9)]
    grid = SimpleNamespace(derotator=np.arange(n) * 5.0, series=lambda: series)
    axes = Figure().subplots()
    _name_groups(axes, grid, np.arange(n), np.arange(n), np.arange(1, n + 1))
    assert len(axes.get_xticks()) <= 12
    # more than eight settings of the plate are named by the first and the last
    assert axes.get_xlabel().endswith("0° to 8°")


def test_one_derotator_angle_and_single_frames(single_angle):
    figure = plot_residuals(single_angle)
    main = parts(figure)[0]
    assert [text.get_text() for text in main.get_xticklabels()] == ["70°"]
    assert "normalized single difference" in figure.get_suptitle()
    assert cells(main).shape == (5, 8)


def test_maps_of_other_size_have_a_scale_of_their_own():
    large, small, alike = (grid_of(np.full(9, size)) for size in (0.02, 0.0005, 0.015))
    scales, shared = _scales([large, small])
    assert not shared
    assert [limit for limit, _ in scales] == pytest.approx([2.0, 0.05])
    scales, shared = _scales([large, alike])
    assert shared
    assert scales[0] == scales[1]


def test_tallest_bar_has_room_above(drawn):
    above = parts(drawn[0])[1]
    tallest = np.nanmax(above.patches[0].get_data().values)
    assert above.get_ylim()[1] == pytest.approx(1.05 * tallest)
