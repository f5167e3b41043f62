# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of a diagnosis show the numbers of the diagnosis."""

from dataclasses import replace

import astropy.units as u
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic
from astropolcal.exceptions import ParameterError
from astropolcal.gap import diagnose, get_effect
from astropolcal.gap.report import to_dict
from astropolcal.gap.residuals import locate
from astropolcal.plotting.gap import (
    plot_effect_scores,
    plot_effect_sizes,
    plot_gap_maps,
    plot_gap_spectrum,
    plot_where,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate

ALL = [plot_effect_scores, plot_gap_maps, plot_gap_spectrum, plot_where]
WAVELENGTH = [1200, 1400, 1600, 1900, 2200] * u.nm


def make(imbalance):
    chain = instruments.get("charis").chain(wavelength=WAVELENGTH, derotator="linear")
    gain = optics.BeamGain(imbalance=np.full(5, imbalance), name="gain")
    frames = half_wave_plate_cycles(derotator=[45, 70, 95] * u.deg)
    true = insert_optic(chain, gain, after="wollaston")
    data = simulate(true, WAVELENGTH, frames, flux=1e6, seed=1, name="lamp")
    mask = np.zeros((24, 5), dtype=bool)
    mask[3, 2] = True
    effects = ["beam_gain", "hwp_diattenuation", "source_circular"]
    return diagnose(
        chain, data.with_mask(mask, "cosmic ray"), effects=effects, cross_validate=False
    )


@pytest.fixture(scope="module")
def gap():
    return make(0.02)


@pytest.fixture(scope="module")
def none():
    return make(0.0)


@pytest.mark.parametrize("plot", ALL)
def test_a_figure_without_traces(plot, gap, none):
    before = dict(mpl.rcParams)
    for diagnosis in (gap, none):
        own = Figure()
        assert plot(diagnosis, figure=own) is own
        own.canvas.draw()
    assert dict(mpl.rcParams) == before


def test_spectrum_shows_the_residuals(gap):
    axes = plot_gap_spectrum(gap).axes[0]
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    residual = gap.nominal.problem.differences(gap.nominal.fit.coefficients)[0][0]
    valid = gap.nominal.problem.channels[0].valid
    rms = 100 * np.sqrt((residual**2).sum(axis=1) / valid.sum(axis=1))
    np.testing.assert_allclose(lines["before"], rms, rtol=1e-9)
    assert np.all(lines["after"] < lines["before"])


def test_maps_have_one_scale_and_grey_masks(gap):
    figure = plot_gap_maps(gap)
    meshes = [axes.collections[0] for axes in figure.axes[:2]]
    assert meshes[0].get_clim() == meshes[1].get_clim()
    assert meshes[0].get_clim()[0] == -meshes[0].get_clim()[1]
    assert np.ma.getmaskarray(meshes[0].get_array()).sum() == 1
    assert "before" in figure.axes[0].get_title(loc="left")


def test_map_of_the_sums(gap):
    assert "sum" in plot_gap_maps(gap, channel="sum").get_suptitle()
    with pytest.raises(ParameterError, match="product"):
        plot_gap_maps(gap, channel="product")


def test_scores_mark_what_was_found(gap, none):
    figure = plot_effect_scores(gap)
    labels = [t.get_text() for t in figure.axes[0].get_yticklabels()]
    assert labels[0] == gap.causes[0].name == "beam_gain"
    widths = [patch.get_width() for patch in figure.axes[0].patches]
    assert widths == sorted(widths, reverse=True)
    assert widths[0] ** 2 == pytest.approx(gap.scores[0].statistic / gap.scores[0].scale)
    assert "found" in [t.get_text() for t in figure.legends[0].get_texts()]
    assert "found" not in [t.get_text() for t in plot_effect_scores(none).legends[0].get_texts()]


def test_shares_are_those_of_the_table(gap, none):
    where = locate(gap.nominal)
    axes = plot_where(where).axes[0]
    widths = [patch.get_width() for patch in axes.patches]
    told = where.told
    assert widths == pytest.approx(list(100 * told["share"][told["kind"] == "pattern"]))
    assert plot_where(gap).axes[0].patches[0].get_width() == pytest.approx(widths[0])
    texts = [t.get_text() for t in plot_where(none).axes[0].texts]
    assert "nothing beyond the noise" in texts


def test_shares_end_at_a_hundred(gap):
    for axes in plot_where(gap).axes:
        assert axes.get_xlim() == (0, 100)


def test_sizes_are_those_of_the_fit(gap):
    figure = plot_effect_sizes(gap, "beam_gain")
    (axes,) = figure.axes
    line, _, bars = axes.containers[0].lines
    np.testing.assert_allclose(line.get_ydata(), 0.02, rtol=0.1)
    ends = np.array([np.ptp(s[:, 1]) / 2 for s in bars[0].get_segments()])
    content = to_dict(gap)
    (size,) = content["causes"][0]["parameters"].values()
    np.testing.assert_allclose(ends, size["std"], rtol=1e-6)
    same = plot_effect_sizes(gap, "beam_gain", content=content)
    assert same.axes[0].get_ylim() == axes.get_ylim()


def test_sizes_that_are_not_determined_are_marked(gap):
    content = to_dict(gap)
    (size,) = content["causes"][0]["parameters"].values()
    size["std"][1], size["std"][3] = None, 9.0
    (axes,) = plot_effect_sizes(gap, "beam_gain", content=content).axes
    assert len(axes.containers[0].lines[0].get_xdata()) == 3
    assert axes.get_title(loc="left") == "crosses: not determined"


def test_sizes_of_what_is_no_cause(gap):
    with pytest.raises(ParameterError, match="these are: beam_gain"):
        plot_effect_sizes(gap, "hwp_diattenuation")
    content = to_dict(gap)
    for size in content["causes"][0]["parameters"].values():
        size["value"] = 0.1
    with pytest.raises(ParameterError, match="depends on wavelength"):
        plot_effect_sizes(gap, "beam_gain", content=content)


def test_titles_of_many_causes_fit(gap, monkeypatch):
    """Names of effects and of a dataset that are too long stay within the figure."""
    (cause,) = gap.causes
    names = ("hwp_encoder_eccentricity", "derotator_diattenuation", "static_diattenuator")
    many = [replace(cause, effect=get_effect(n)) for n in (*names, "background", "hwp_tilt")]
    diagnosis = replace(gap, causes=[*many, cause])
    monkeypatch.setattr(gap.nominal.observations[0], "name", "a_very_long_name_of_a_dataset_" * 3)
    figures = [plot(diagnosis) for plot in (plot_effect_scores, plot_gap_maps, plot_gap_spectrum)]
    for figure in figures:
        assert "and 4 more" in figure.get_suptitle()
        check_titles(figure)


def check_titles(figure):
    """Every title is within the figure, and within the width of its panel or nearly so."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    box = figure._suptitle.get_window_extent(renderer)
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    for axes in figure.axes:
        title = axes.title if axes.get_title() else axes._left_title
        extent = title.get_window_extent(renderer)
        assert extent.x1 <= axes.get_window_extent(renderer).x1 + 5
