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
from astropolcal.gap.residuals import locate
from astropolcal.plotting.gap import (
    plot_cause_map,
    plot_gap_frames,
    plot_gap_maps,
    plot_gap_spectrum,
    plot_where,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate

ALL = [plot_cause_map, plot_gap_frames, plot_gap_maps, plot_gap_spectrum, plot_where]
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
        chain,
        data.with_mask(mask, "cosmic ray"),
        effects=effects,
        cross_validate=False,
        cells=False,
    )


@pytest.fixture(scope="module")
def gap():
    return make(0.02)


@pytest.fixture(scope="module")
def none():
    return make(0.0)


@pytest.mark.slow
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


def test_frames_show_what_the_causes_do(gap, none):
    (axes,) = plot_gap_frames(gap).axes
    before, after, line = (
        next(x for x in axes.lines if x.get_label() == label).get_ydata()
        for label in ("before", "after", "what the causes do")
    )
    np.testing.assert_allclose(before - after, line)
    assert np.std(after) < 0.3 * np.std(before)
    labels = [line.get_label() for line in plot_gap_frames(none).axes[0].lines]
    assert "after" not in labels


def test_shares_are_those_of_the_table(gap, none):
    widths = [patch.get_width() for patch in plot_where(gap).axes[0].patches]
    told = [100 * one["share"] for one in locate(gap.nominal) if one["kind"] == "pattern"]
    assert widths == pytest.approx(told)
    texts = [t.get_text() for t in plot_where(none).axes[0].texts]
    assert "nothing beyond the noise" in texts


def test_shares_end_at_a_hundred(gap):
    for axes in plot_where(gap).axes:
        assert axes.get_xlim() == (0, 100)


@pytest.mark.slow
def test_titles_of_many_causes_fit(gap, monkeypatch):
    """Names of causes and of a dataset that are too long stay within the figure."""
    many = [replace(gap.causes[0], effect=get_effect("hwp_encoder_eccentricity"))] * 6
    monkeypatch.setattr(gap.nominal.observations[0], "name", "a_very_long_name_of_a_dataset_" * 3)
    for causes in (many, many[:1]):
        diagnosis = replace(gap, causes=causes)
        for plot in (plot_gap_frames, plot_gap_maps, plot_gap_spectrum):
            check_titles(plot(diagnosis))


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
