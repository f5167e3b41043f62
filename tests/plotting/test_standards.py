# Licensed under a 3-clause BSD style license - see LICENSE
"""The figure of standard stars over a night."""

import numpy as np
import pytest

from astropolcal import standards
from astropolcal.exceptions import ParameterError
from astropolcal.plotting.standards import plot_observability

NIGHT = "2025-11-03"


@pytest.fixture(scope="module")
def seen():
    names = ("HD 293396", "HD 30675", "HD 14069")
    return [standards.observability(name, "subaru", NIGHT) for name in names]


@pytest.mark.slow
def test_curves_are_the_tables(seen):
    upper, lower = plot_observability(seen).axes
    dotted = [line for line in upper.lines if line.get_linestyle() == ":" and len(line.get_xdata())]
    for line, star in zip(dotted, seen, strict=True):
        np.testing.assert_allclose(line.get_ydata(), star.table["altitude"].value)
        hours = line.get_xdata()
        assert hours[0] == pytest.approx((star.table["time"].mjd[0] % 1) * 24)
    dotted = [line for line in lower.lines if line.get_linestyle() == ":"]
    for line, star in zip(dotted, seen, strict=True):
        np.testing.assert_allclose(line.get_ydata(), star.table["parallactic"].value)


@pytest.mark.slow
def test_thick_curves_are_only_where_the_star_is_observable(seen):
    upper, _ = plot_observability(seen).axes
    thick = [line for line in upper.lines if line.get_linewidth() == 2]
    for line, star in zip(thick, seen, strict=True):
        drawn = np.isfinite(line.get_ydata())
        np.testing.assert_array_equal(drawn, star.table["observable"])


@pytest.mark.slow
def test_the_angle_goes_on_beyond_half_a_turn_as_in_the_table(seen):
    # culminates north of the zenith
    upper, lower = plot_observability(seen[1:2]).axes
    values = lower.lines[0].get_ydata()
    assert np.max(np.abs(np.diff(values))) < 180
    assert values.max() > 180
    low, high = lower.get_ylim()
    assert low <= values.min()
    assert values.max() <= high
    # the markers are at the same times in both panels
    marked = [next(x for x in axes.lines if x.get_linestyle() == "None") for axes in (upper, lower)]
    np.testing.assert_array_equal(*(line.get_xdata() for line in marked))


@pytest.mark.slow
def test_the_title_says_of_how_many_stars_these_are_the_first(seen):
    title = plot_observability(seen, total=4).get_suptitle()
    assert title.startswith("The first 3 of 4 standard stars, night of")
    assert plot_observability(seen, total=3).get_suptitle().startswith("Standard stars, night of")


@pytest.mark.slow
def test_labels_have_units_and_the_legend_is_outside(seen):
    figure = plot_observability(seen)
    upper, lower = figure.axes
    assert upper.get_ylabel() == "altitude (deg)"
    assert lower.get_ylabel() == "parallactic angle (deg)"
    assert lower.get_xlabel() == "time on 2025-11-04 (hours UTC)"
    assert NIGHT in figure.get_suptitle()
    assert "\nSubaru, 155.48° W, 19.83° N" in figure.get_suptitle()
    figure.draw_without_rendering()
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:3] == ["HD 293396", "HD 30675", "HD 14069"]
    box = figure.legends[0].get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)


@pytest.mark.slow
def test_stars_differ_in_colour_and_marker(seen):
    upper, _ = plot_observability(seen).axes
    marked = [line for line in upper.lines if line.get_linestyle() == "None"]
    assert len({line.get_color() for line in marked}) == 3
    assert len({line.get_marker() for line in marked}) == 3


@pytest.mark.slow
def test_what_cannot_be_drawn_together_is_refused(seen):
    with pytest.raises(ParameterError, match="0 stars"):
        plot_observability([])
    with pytest.raises(ParameterError, match="9 stars"):
        plot_observability(seen * 3)
    for other in (
        standards.observability("HD 14069", "paranal", NIGHT),
        standards.observability("HD 14069", "subaru", "2025-11-04"),
    ):
        with pytest.raises(ParameterError, match="different nights or sites"):
            plot_observability([seen[0], other])
