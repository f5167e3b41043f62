# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of parameters: retardances, efficiency, and any other."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate, optics
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.measurement import Tie
from astropolcal.plotting import plot_efficiency, plot_parameters, plot_retardances
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAMBDA = [1200, 1400, 1600, 1900, 2200]


def panel(figure, title):
    return next(axes for axes in figure.axes if axes.get_title().startswith(title))


def half_lengths(container):
    (bars,) = container[2]
    return [(segment[1, 1] - segment[0, 1]) / 2 for segment in bars.get_segments()]


def legend_texts(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def by_label(axes, start):
    return [line for line in axes.lines if str(line.get_label()).startswith(start)]


def hollow(axes):
    return [line for line in axes.lines if line.get_markerfacecolor() == "white"]


# ---- retardances -------------------------------------------------------------------


def test_one_panel_a_retardance_with_units(elliptical):
    figure = plot_retardances(elliptical)
    titles = [axes.get_title().split("\n")[0] for axes in figure.axes]
    assert titles == [
        "hwp: law",
        "derotator: horizontal",
        "derotator: diagonal",
        "derotator: circular",
    ]
    assert all(axes.get_ylabel().endswith("(°)") for axes in figure.axes)
    assert {axes.get_xlabel() for axes in figure.axes} == {"", "wavelength (nm)"}


def test_points_and_errors_are_the_parameters(elliptical):
    figure = plot_retardances(elliptical)
    entry = elliptical.parameter_values()["derotator.horizontal"]
    (container,) = panel(figure, "derotator: horizontal").containers
    np.testing.assert_allclose(container[0].get_xdata(), LAMBDA)
    np.testing.assert_allclose(container[0].get_ydata(), entry["value"])
    np.testing.assert_allclose(half_lengths(container), entry["std"], rtol=1e-6)
    assert not hollow(panel(figure, "derotator: horizontal"))


def test_undetermined_points_are_hollow_without_errors_and_explained(undetermined):
    figure = plot_retardances(undetermined)
    axes = panel(figure, "derotator: circular")
    assert not axes.containers
    (line,) = hollow(axes)
    value = undetermined.parameter_values()["derotator.circular"]["value"]
    np.testing.assert_allclose(line.get_ydata(), value)
    assert any(
        "not determined alone" in text and "2 combinations" in text for text in legend_texts(figure)
    )


def test_law_is_a_fine_curve_with_its_band(elliptical):
    axes = panel(plot_retardances(elliptical), "hwp")
    (line,) = by_label(axes, "law fitted")
    hwp = elliptical.chain["hwp"]
    lam = line.get_xdata()
    assert len(lam) > 100
    np.testing.assert_allclose(line.get_ydata(), hwp.retardance(lam * u.nm).to_value(u.deg))
    (band,) = axes.collections
    vertices = band.get_paths()[0].vertices
    at_end = vertices[np.isclose(vertices[:, 0], 2200), 1]
    width = (at_end.max() - at_end.min()) / 2
    # the law is linear in both thicknesses: its error in closed form
    cov = elliptical.covariance
    index = [cov.names.index(f"hwp.{key}") for key in ("w_sio2", "w_mgf2")]
    unit = [
        hwp.with_parameters(w_sio2=a * u.mm, w_mgf2=b * u.mm).retardance(2200 * u.nm).value
        for a, b in ((1, 0), (0, 1))
    ]
    expected = np.sqrt(unit @ cov.matrix[np.ix_(index, index)] @ unit)
    assert width == pytest.approx(expected, rel=1e-5)
    assert f"{float(hwp.w_sio2.value):.4f}" in axes.get_title()


def test_half_wave_line_is_drawn_only_near_it(elliptical):
    figure = plot_retardances(elliptical)
    assert by_label(panel(figure, "hwp"), "half wave")
    assert not by_label(panel(figure, "derotator: circular"), "half wave")


def test_two_step_calibration_has_a_dot_a_wavelength(two_step, elliptical):
    axes = panel(plot_retardances(two_step), "hwp")
    (dots,) = by_label(axes, "fitted per wavelength")
    expected = two_step.stages[0]["parameters"]["hwp.retardance"].to_value(u.deg)
    assert dots.get_linestyle() == "None"
    turns = (dots.get_ydata() - expected) / 360
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    law = two_step.chain["hwp"].retardance(LAMBDA * u.nm).to_value(u.deg)
    assert np.abs(dots.get_ydata() - law).max() < 5
    assert not by_label(panel(plot_retardances(elliptical), "hwp"), "fitted per wavelength")


def test_dots_a_turn_away_are_drawn_beside_the_law(two_step):
    stage = two_step.stages[0]
    turned = stage["parameters"]["hwp.retardance"] + [360, 0, -360, 0, 720] * u.deg
    stages = [stage | {"parameters": stage["parameters"] | {"hwp.retardance": turned}}]
    axes = panel(plot_retardances(replace(two_step, stages=stages)), "hwp")
    (dots,) = by_label(axes, "fitted per wavelength")
    law = two_step.chain["hwp"].retardance(LAMBDA * u.nm).to_value(u.deg)
    assert np.abs(dots.get_ydata() - law).max() < 5


def test_linear_derotator_has_one_panel(two_step):
    figure = plot_retardances(two_step)
    assert [a.get_title().split("\n")[0] for a in figure.axes] == [
        "hwp: law",
        "derotator: retardance",
    ]


def test_fixed_retardance_is_a_dotted_line(single_angle):
    axes = panel(plot_retardances(single_angle), "derotator")
    (line,) = by_label(axes, "fixed")
    assert line.get_linestyle() == ":"
    assert not axes.containers


def calibrate_scalars(**fixed):
    """Every parameter has one value; the data do not tell efficiency from retardance."""
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(name="window", fixed={"retardance": True})
        | optics.WollastonPrism(efficiency=0.98, name="wollaston", fixed=fixed)
    )
    frames = half_wave_plate_cycles(derotator=[45, 90] * u.deg)
    return calibrate(chain, simulate(chain, [1.2, 1.6] * u.um, frames, flux=1e5, seed=1))


@pytest.fixture(scope="module")
def scalar():
    return calibrate_scalars(efficiency=True)


def test_undetermined_scalar_is_a_line_that_says_so():
    (axes,) = plot_retardances(calibrate_scalars()).axes
    assert by_label(axes, "one value for all wavelengths, not determined alone")
    assert not axes.collections


def test_scalar_parameter_is_a_line_with_a_band(scalar):
    (axes,) = plot_retardances(scalar).axes  # none for a plate fixed at zero
    entry = scalar.parameter_values()["hwp.retardance"]
    (line,) = by_label(axes, "one value")
    np.testing.assert_allclose(line.get_ydata(), [entry["value"]] * 2)
    heights = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert np.ptp(heights) / 2 == pytest.approx(float(entry["std"]))


def test_tied_parameter_says_what_it_follows():
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=[170, 175] * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(
            retardance=[85, 87.5] * u.deg, theta=20 * u.deg, mount="derotator", name="plate"
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    chain["wollaston"].efficiency.fixed = True
    frames = half_wave_plate_cycles(derotator=[45, 70, 90] * u.deg)
    observations = simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)
    ties = {"plate.retardance": Tie("hwp.retardance", factor=0.5)}
    calibration = calibrate(chain, observations, ties=ties)
    axes = panel(plot_retardances(calibration), "plate")
    (line,) = by_label(axes, "follows hwp.retardance")
    np.testing.assert_allclose(
        line.get_ydata(), calibration.parameter_values()["hwp.retardance"]["value"] / 2
    )


def test_chain_without_retarder_is_refused(scalar):
    bare = replace(scalar, chains=[optics.WollastonPrism(name="wollaston")])
    with pytest.raises(ChainError, match="no retarder"):
        plot_retardances(bare)


@pytest.mark.slow
@pytest.mark.parametrize("draw", [plot_retardances, plot_efficiency, plot_parameters])
def test_legend_lies_outside_the_axes(undetermined, draw):
    figure = draw(undetermined)
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
    assert box.y0 >= -1
    assert len(set(legend_texts(figure))) == len(legend_texts(figure))


# ---- efficiency --------------------------------------------------------------------


def test_efficiency_has_errors_and_marks_points_at_the_bound(at_bound):
    figure = plot_efficiency(at_bound)
    (axes,) = figure.axes
    entry = at_bound.parameter_values()["wollaston.efficiency"]
    bound = entry["at_bound"]
    assert 0 < bound.sum() < len(bound)
    (boxes,) = by_label(axes, "boxed: at a bound")
    np.testing.assert_allclose(boxes.get_xdata(), np.array(LAMBDA)[bound])
    np.testing.assert_allclose(boxes.get_ydata(), 1, atol=1e-4)
    (container,) = axes.containers
    np.testing.assert_allclose(half_lengths(container), entry["std"][~bound], rtol=1e-6)
    assert legend_texts(figure)[:2] == ["fitted, with 1\N{GREEK SMALL LETTER SIGMA} error",
                                        "boxed: at a bound, so no error"]  # fmt: skip


def test_efficiency_shows_the_perfect_value(elliptical):
    (axes,) = plot_efficiency(elliptical).axes
    assert by_label(axes, "perfect")[0].get_ydata()[0] == 1
    assert not by_label(axes, "boxed")
    assert axes.get_title() == "wollaston.efficiency"


def test_chain_without_efficiency_is_refused(elliptical):
    bare = replace(elliptical, chains=[optics.ParityFlip(name="nbs")])
    with pytest.raises(ChainError, match="efficiency"):
        plot_efficiency(bare)


# ---- any parameter -----------------------------------------------------------------


def test_all_free_parameters_given_per_wavelength(several):
    figure = plot_parameters(several)
    assert {axes.get_title() for axes in figure.axes} == {
        "derotator.retardance",
        "wollaston.efficiency",
        "fold_mirror.diattenuation",
    }


def test_chosen_parameters_with_their_units(several):
    first, second = plot_parameters(several, ["hwp.w_sio2", "fold_mirror.diattenuation"]).axes
    labels = [axes.get_ylabel().replace("\n", " ") for axes in (first, second)]
    assert labels == [
        "thickness of the quartz layer (mm)",
        "relative difference of the two transmissions",
    ]
    entry = several.parameter_values()["fold_mirror.diattenuation"]
    np.testing.assert_allclose(second.containers[0][0].get_ydata(), entry["value"])


def test_unknown_parameter_is_refused_with_a_hint(several):
    with pytest.raises(ParameterError, match=r"did you mean 'hwp\.w_sio2'"):
        plot_parameters(several, ["hwp.w_sio"])


def test_nothing_to_draw_is_said(scalar):
    with pytest.raises(ChainError, match="nothing to draw"):
        plot_parameters(scalar)
