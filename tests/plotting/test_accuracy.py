# Licensed under a 3-clause BSD style license - see LICENSE
"""The figure of accuracies."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

from astropolcal.exceptions import ParameterError
from astropolcal.plotting import plot_accuracy

PUBLISHED = {"goal": ([1200, 2200] * u.nm, [0.1, 0.001] * u.percent)}


def lines(axes):
    return {line.get_label().split(" ")[0].rstrip(":"): line for line in axes.lines}


def test_curves_are_the_accuracy_table(elliptical):
    (axes,) = plot_accuracy(elliptical).axes
    drawn = lines(axes)
    assert list(drawn) == ["s_res", "s_mean", "s_cv"]
    for name, line in drawn.items():
        np.testing.assert_allclose(line.get_ydata(), elliptical.accuracy[name].value)
        np.testing.assert_allclose(line.get_xdata(), [1200, 1400, 1600, 1900, 2200])
    assert len({line.get_marker() for line in drawn.values()}) == 3
    assert len({line.get_color() for line in drawn.values()}) == 3


def test_legend_defines_every_curve_outside_the_axes(elliptical):
    figure = plot_accuracy(elliptical)
    figure.draw_without_rendering()
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(texts) == 3
    assert "√(Σr²/(n" in texts[0]
    assert "s_res/√n" in texts[1]
    assert "left out of the fit" in texts[2]
    box = figure.legends[0].get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)


def test_labels_have_units(elliptical):
    (axes,) = plot_accuracy(elliptical).axes
    assert axes.get_xlabel() == "wavelength (nm)"
    assert axes.get_ylabel() == "accuracy (% of polarization)"
    assert "n = 20" in axes.get_title()
    assert "k = 6" in axes.get_title()


def test_unknown_cross_validation_is_said(single_angle):
    figure = plot_accuracy(single_angle)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[2].startswith("s_cv: not known")


def test_reference_curves_and_logarithmic_axis(elliptical):
    (axes,) = plot_accuracy(elliptical, PUBLISHED).axes
    reference = lines(axes)["goal"]
    np.testing.assert_allclose(reference.get_ydata(), [0.1, 0.001])
    assert axes.get_yscale() == "log"
    low, high = axes.get_ylim()
    assert low < 0.001
    assert high > elliptical.accuracy["s_res"].value.max()


def test_similar_values_are_drawn_on_a_linear_axis_from_zero(single_angle):
    (axes,) = plot_accuracy(single_angle).axes
    assert axes.get_yscale() == "linear"
    assert axes.get_ylim()[0] == 0


def test_one_panel_a_dataset(several):
    figure = plot_accuracy(several)
    assert [axes.get_title().split(":")[0] for axes in figure.axes] == ["polarized", "unpolarized"]
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_calibration_without_data_will_do(elliptical):
    assert len(plot_accuracy(replace(elliptical, measurement=None)).axes) == 1


def test_many_datasets_are_counted_in_the_title(elliptical):
    many = replace(elliptical, datasets=elliptical.datasets * 3)
    assert plot_accuracy(many).get_suptitle().endswith("bench: 3 datasets")


def test_fit_that_did_not_converge_is_marked(elliptical):
    failed = replace(elliptical, fit=elliptical.fit | {"converged": False})
    assert "NOT CONVERGED" in plot_accuracy(failed).get_suptitle()
    assert "NOT CONVERGED" not in plot_accuracy(elliptical).get_suptitle()


def _standard(name, source, factor=3.0, wavelength=(1200.0, 1600.0, 2200.0)):
    """What a calibration remembers of a standard, see add_standard."""
    n = len(wavelength)
    return {
        "name": name,
        "source": source,
        "content_hash": name,
        "wavelength_nm": list(wavelength),
        "n": [12] * n,
        "s_standard_percent": [0.1 * factor] * n,
        "s_cv_percent": [0.1] * n,
    }


def test_standards_are_drawn_into_the_panel_of_their_source(several):
    sources = [record.source for record in several.datasets]
    entries = [_standard("july", sources[0]), _standard("august", sources[0], 5.0, (1600.0,))]
    with_standards = replace(several, fit=several.fit | {"standards": entries})
    figure = plot_accuracy(with_standards)
    assert len(figure.axes) == 2
    drawn = [line for line in figure.axes[0].lines if "s_standard" in line.get_label()]
    assert [line.get_label().split("predicting ")[1].split(",")[0] for line in drawn] == [
        "july",
        "august",
    ]
    np.testing.assert_allclose(drawn[0].get_ydata(), 0.3)
    np.testing.assert_allclose(drawn[1].get_xdata(), [1600])
    assert drawn[0].get_marker() != drawn[1].get_marker()
    assert drawn[0].get_linestyle() != drawn[1].get_linestyle()
    low, high = figure.axes[0].get_ylim()
    assert low < 0.3 < 0.5 < high
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(texts) == 5
    assert "not fitted" in texts[-1]


def test_standard_of_another_source_has_its_own_panel(elliptical):
    star = _standard("star", "unpolarized standard star")
    figure = plot_accuracy(replace(elliptical, fit=elliptical.fit | {"standards": [star]}))
    first, second = figure.axes
    assert list(lines(first)) == ["s_res", "s_mean", "s_cv"]
    assert "star: n = 12 data a wavelength, predicted" in second.get_title()
    drawn = {line.get_label().split(" ")[0].rstrip(":"): line for line in second.lines}
    assert list(drawn) == ["s_standard", "s_cv"]
    np.testing.assert_allclose(drawn["s_cv"].get_ydata(), 0.1)


def test_legend_says_what_was_left_out(elliptical):
    cycles = replace(elliptical, fit=elliptical.fit | {"groups": "cycle"})
    texts = [text.get_text() for text in plot_accuracy(cycles).legends[0].get_texts()]
    assert "half-wave-plate cycles left out" in texts[2]


@pytest.mark.parametrize(
    "curve",
    [
        ([1200, 2200] * u.nm, [0.1, 0.2]),
        ([1200, 2200] * u.nm, [0.1, 0.2] * u.deg),
        ([1200, 2200], [0.1, 0.2] * u.percent),
        ([1200, 2200] * u.nm,),
        None,
    ],
)
def test_reference_without_units_is_refused(elliptical, curve):
    with pytest.raises(ParameterError, match="reference 'mine' must be a pair"):
        plot_accuracy(elliptical, {"mine": curve})


def test_reference_of_other_length_is_refused(elliptical):
    curve = ([1200, 1500, 2200] * u.nm, [0.1, 0.2] * u.percent)
    with pytest.raises(ParameterError, match="3 wavelengths but 2 accuracies"):
        plot_accuracy(elliptical, {"mine": curve})


def test_datasets_of_one_wavelength_share_a_panel(several):
    single = [
        replace(one, accuracy=one.accuracy[i : i + 1]) for i, one in enumerate(several.datasets)
    ]
    (axes,) = plot_accuracy(replace(several, datasets=single)).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == [
        "polarized\n1200 nm",
        "unpolarized\n1400 nm",
    ]
    expected = [one.accuracy["s_res"].to_value(u.percent)[0] for one in single]
    np.testing.assert_allclose(lines(axes)["s_res"].get_ydata(), expected)
