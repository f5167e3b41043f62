# Licensed under a 3-clause BSD style license - see LICENSE
"""Parameters against wavelength and date, laws, mirrors, and how well each is known."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import calibrate, optics
from astropolcal.calibration.uncertainty.derived import mirror_values
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.measurement import Tie
from astropolcal.plotting import (
    parameters,
    plot_history,
    plot_mirrors,
)
from astropolcal.plotting._style import BLUE
from astropolcal.plotting.parameters import plot_efficiency, plot_parameters, plot_retardances
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


def test_one_panel_a_retardance_with_units(elliptical, two_step):
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
    # a linear derotator has one
    figure = plot_retardances(two_step)
    assert [a.get_title().split("\n")[0] for a in figure.axes] == [
        "hwp: law",
        "derotator: retardance",
    ]


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
    # half wave line is drawn only near it
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
    # dots a turn away are drawn beside the law
    stage = two_step.stages[0]
    turned = stage["parameters"]["hwp.retardance"] + [360, 0, -360, 0, 720] * u.deg
    stages = [stage | {"parameters": stage["parameters"] | {"hwp.retardance": turned}}]
    axes = panel(plot_retardances(replace(two_step, stages=stages)), "hwp")
    (dots,) = by_label(axes, "fitted per wavelength")
    law = two_step.chain["hwp"].retardance(LAMBDA * u.nm).to_value(u.deg)
    assert np.abs(dots.get_ydata() - law).max() < 5


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


@pytest.mark.slow
def test_legend_lies_outside_the_axes(undetermined):
    for draw in [plot_retardances, plot_efficiency, plot_parameters]:
        figure = draw(undetermined)
        figure.draw_without_rendering()
        box = figure.legends[0].get_window_extent()
        assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes), draw
        assert box.y0 >= -1, draw
        assert len(set(legend_texts(figure))) == len(legend_texts(figure)), draw


# ---- efficiency --------------------------------------------------------------------


def test_efficiency_has_errors_and_marks_points_at_the_bound(at_bound, elliptical):
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
    (axes,) = plot_efficiency(elliptical).axes
    assert by_label(axes, "perfect")[0].get_ydata()[0] == 1
    assert not by_label(axes, "boxed")
    assert axes.get_title() == "wollaston.efficiency"


# ---- any parameter -----------------------------------------------------------------


def test_free_and_chosen_parameters_with_their_units(several):
    figure = plot_parameters(several)
    assert {axes.get_title() for axes in figure.axes} == {
        "derotator.retardance",
        "wollaston.efficiency",
        "fold_mirror.diattenuation",
    }
    first, second = plot_parameters(several, ["hwp.w_sio2", "fold_mirror.diattenuation"]).axes
    labels = [axes.get_ylabel().replace("\n", " ") for axes in (first, second)]
    assert labels == [
        "thickness of the quartz layer (mm)",
        "relative difference of the two transmissions",
    ]
    entry = several.parameter_values()["fold_mirror.diattenuation"]
    np.testing.assert_allclose(second.containers[0][0].get_ydata(), entry["value"])


def test_nothing_to_draw_is_said(scalar, elliptical, several):
    with pytest.raises(ChainError, match="nothing to draw"):
        plot_parameters(scalar)
    bare = replace(scalar, chains=[optics.WollastonPrism(name="wollaston")])
    with pytest.raises(ChainError, match="no retarder"):
        plot_retardances(bare)
    bare = replace(elliptical, chains=[optics.ParityFlip(name="nbs")])
    with pytest.raises(ChainError, match="efficiency"):
        plot_efficiency(bare)
    with pytest.raises(ParameterError, match=r"did you mean 'hwp\.w_sio2'"):
        plot_parameters(several, ["hwp.w_sio"])


NM = np.array([1600.0, 1200.0, 2200.0])
LOOK = (BLUE, "o")


def calibration(**more):
    return SimpleNamespace(wavelength=NM * u.nm, **more)


def entry(value, std, bound=False, fixed=False, tied=None):
    value = np.asarray(value, float)
    return {
        "value": value,
        "std": np.broadcast_to(np.asarray(std, float), value.shape),
        "at_bound": np.broadcast_to(bound, value.shape),
        "fixed": fixed,
        "tied": tied,
        "unit": "deg",
    }


def drawn(one):
    axes = Figure().subplots()
    parameters._draw_entry(axes, calibration(), one, LOOK)
    return axes


def labels(axes):
    return [label for label in axes.get_legend_handles_labels()[1]]


# ---- values per wavelength -----------------------------------------------------------------


def test_kinds_of_parameters_are_told_by_their_shape():
    axes = drawn(entry([1.0, 2.0, 3.0], [0.1, np.nan, 0.3], [False, False, True]))
    hollow = [one for one in axes.lines if one.get_markerfacecolor() == "white"]
    boxes = [one for one in axes.lines if one.get_marker() == "s"]
    (points,) = axes.containers
    assert points.lines[0].get_xdata().tolist() == [1600]
    assert hollow[0].get_xdata().tolist() == [1200, 2200]
    assert boxes[0].get_xdata().tolist() == [2200]
    assert set(labels(axes)) == {parameters._DETERMINED, parameters._ALONE, parameters._BOUND}
    # at a bound alone is not called open
    axes = drawn(entry([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], [True, False, False]))
    assert set(labels(axes)) == {parameters._DETERMINED, parameters._BOUND}


# ---- one value -----------------------------------------------------------------------------


def test_a_constant_is_a_line_over_the_range():
    for one, label, band in [
        (entry(2.0, 0.5), "one value for all wavelengths", (1.5, 2.5)),
        (entry(2.0, np.nan), "one value for all wavelengths, not determined alone", None),
        (entry(2.0, np.nan, bound=True), "one value for all wavelengths, at a bound", None),
        (entry(2.0, np.nan, fixed=True), "fixed", None),
    ]:
        axes = drawn(one)
        (line,) = axes.lines
        assert line.get_xdata().tolist() == [1200, 2200], (one, label, band)
        assert line.get_ydata().tolist() == [2, 2], (one, label, band)
        assert line.get_label() == label, (one, label, band)
        if band is None:
            assert not axes.collections, (one, label, band)
        else:
            edges = axes.collections[0].get_paths()[0].vertices[:, 1]
            assert (edges.min(), edges.max()) == pytest.approx(band), (one, label, band)


# ---- laws ----------------------------------------------------------------------------------


def test_band_of_a_law_counts_what_is_tied_and_open():
    """A layer that follows the other moves the retardance, too; what no datum tells has no band."""
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp")
        | optics.TwoLayerWaveplate(fixed={"w_mgf2": True}, name="window")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    lam, share = [1.2, 1.6] * u.um, 0.78
    frames = half_wave_plate_cycles(derotator=[0, 30] * u.deg)
    data = simulate(chain, lam, frames, seed=1)
    ties = {"hwp.w_mgf2": Tie("hwp.w_sio2", share)}
    cal = calibrate(chain, data, ties=ties, search=False, cross_validate=False)
    per_mm = [
        optics.TwoLayerWaveplate(w_sio2=a * u.mm, w_mgf2=b * u.mm).retardance(lam).value
        for a, b in ((1, 0), (0, 1))
    ]
    sigma = cal.covariance.std("hwp.w_sio2").value
    plate, window = plot_retardances(cal).axes
    (band,) = plate.collections
    vertices = band.get_paths()[0].vertices
    widths = [np.ptp(vertices[np.isclose(vertices[:, 0], nm), 1]) / 2 for nm in (1200, 1600)]
    np.testing.assert_allclose(widths, np.abs(per_mm[0] + share * per_mm[1]) * sigma, rtol=1e-4)
    assert not window.collections
    assert labels(window)[0] == parameters._LAW_ALONE


def test_numbers_on_axes_are_whole():
    """No "+9.799e1" in a corner, beside labels that are what is left of 98 deg."""
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=98 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.98, fixed={"efficiency": True}, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[20, 30, 60] * u.deg)
    data = simulate(chain, [1.2, 1.6] * u.um, frames, flux=1e11, seed=1)
    single = "normalized_single_difference"
    cal = calibrate(chain, data, observable=single, search=False, cross_validate=False)
    figure = plot_retardances(cal)
    figure.draw_without_rendering()
    assert [axes.yaxis.get_offset_text().get_text() for axes in figure.axes] == [""]


def test_one_wavelength_is_seen_with_its_errors():
    """A line from a wavelength to itself has no length, a band no width."""
    chain = (
        optics.MetalMirror(film_thickness=50 * u.nm, fixed={"film_thickness": False}, name="m3")
        | optics.TwoLayerWaveplate(mount="hwp", fixed={"w_mgf2": True}, name="hwp")
        | optics.LinearRetarder(retardance=98 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.98, fixed={"efficiency": True}, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[0, 30, 60] * u.deg)
    data = simulate(chain, [1.6] * u.um, frames, flux=1e8, seed=1)
    cal = calibrate(chain, data, search=False, cross_validate=False)
    for draw, bands in ((plot_retardances, 3), (plot_efficiency, 0), (plot_mirrors, 2)):
        axes = draw(cal).axes
        drawn = [line for one in axes for line in one.lines]
        assert all(np.ptp(line.get_xdata()) > 0 for line in drawn), draw
        found = [band.get_paths()[0].vertices for one in axes for band in one.collections]
        assert len(found) == bands, draw
        assert all((np.ptp(vertices, axis=0) > 0).all() for vertices in found), draw


def test_values_of_a_law_are_words():
    own = {
        "w_sio2": entry(1.65, 0.01),
        "w_mgf2": entry(1.25, np.nan),
        "many": entry([1.0, 2.0], 0.1),
    }
    assert list(parameters._words(own)) == ["w_sio2 = 1.6500 ± 0.0100 deg", "w_mgf2 = 1.2500 deg"]


def test_legend_says_how_much_is_open():
    figure = Figure()
    axes = figure.subplots(1, 2)
    parameters._draw_entry(axes[0], calibration(), entry([1.0, 2.0, 3.0], np.nan), LOOK)
    parameters._draw_entry(axes[1], calibration(), entry([1.0, 2.0, 3.0], 0.1), ("red", "s"))
    for count, words in ((1, "1 combination of parameters"), (2, "2 combinations of parameters")):
        known = calibration(identifiability=SimpleNamespace(directions=[{}] * count))
        legend = parameters._legend(figure, axes, known)
        texts = [text.get_text() for text in legend.get_texts()]
        # in the order of certainty, each once, and in no panel's colour
        assert texts[0] == parameters._DETERMINED
        assert texts[1] == f"{parameters._ALONE} (the data do not determine {words})"
        assert {handle.get_color() for handle in legend.legend_handles} == {"#000000"}


SIGMA = "\N{GREEK SMALL LETTER SIGMA}"
NM_OF_MIRRORS = np.array([1200.0, 1400.0, 1600.0, 1900.0, 2200.0])


@pytest.fixture(scope="module")
def diattenuator(with_mirror):
    return with_mirror(optics.Diattenuator(diattenuation=np.full(5, 0.012), name="fold"))


@pytest.fixture(scope="module")
def retarder(with_mirror):
    mirror = optics.DiattenuatorRetarder(
        diattenuation=np.full(5, 0.012), retardance=np.full(5, 170.0) * u.deg, name="fold"
    )
    mirror.retardance.fixed = True
    return with_mirror(mirror)


def lines(axes):
    return {line.get_label(): line for line in axes.lines}


def test_values_have_their_errors(diattenuator):
    (axes,) = plot_mirrors(diattenuator).axes
    table = mirror_values(diattenuator, "fold")
    (drawn,) = axes.containers
    line, _, (bars,) = drawn.lines
    assert drawn.get_label() == f"fitted, with 1{SIGMA} error"
    np.testing.assert_allclose(line.get_xdata(), NM_OF_MIRRORS)
    np.testing.assert_allclose(line.get_ydata(), table["diattenuation"].to_value(u.percent))
    lengths = [np.ptp(segment[:, 1]) / 2 for segment in bars.get_segments()]
    np.testing.assert_allclose(lengths, table["diattenuation_err"].to_value(u.percent))
    # near the truth of 1.2 percent
    assert np.all(np.abs(line.get_ydata() - 1.2) < 5 * np.array(lengths))


def test_metals_are_drawn_beside_with_looks_of_their_own(diattenuator):
    figure = plot_mirrors(diattenuator)
    (axes,) = figure.axes
    table = mirror_values(diattenuator, "fold")
    found = {key.split(" ")[0]: line for key, line in lines(axes).items() if "bare" in key}
    assert set(found) == {"silver", "gold", "aluminium"}
    for metal, line in found.items():
        np.testing.assert_allclose(
            line.get_ydata(), table[f"diattenuation_{metal}"].to_value(u.percent)
        )
    assert len({line.get_linestyle() for line in found.values()}) == 3
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    # what was calibrated comes before what it is compared with
    assert [("bare" in label) for label in labels] == [False, True, True, True]


def test_labels_of_a_mirror(diattenuator, retarder):
    (axes,) = plot_mirrors(diattenuator).axes
    assert (axes.get_title(), axes.get_ylabel()) == ("fold", "diattenuation (%)")
    assert axes.get_xlabel() == "wavelength (nm)"
    top, bottom = plot_mirrors(retarder).axes
    assert (top.get_ylabel(), bottom.get_ylabel()) == ("diattenuation (%)", "retardance (°)")
    assert (top.get_xlabel(), bottom.get_xlabel()) == ("", "wavelength (nm)")
    assert plot_mirrors(retarder).get_suptitle().startswith("Mirrors\n")


def test_what_is_held_is_hollow_and_has_no_error(retarder):
    _, bottom = plot_mirrors(retarder).axes
    held = lines(bottom)["held, not fitted"]
    assert held.get_markerfacecolor() == "white"
    np.testing.assert_allclose(held.get_ydata(), 170)
    assert not bottom.containers


def test_what_is_published_is_drawn_beside(retarder):
    other = SimpleNamespace(
        diattenuation=lambda lam: 0.01 * lam.to_value(u.um),
        retardance=lambda lam: (180 - 10 * lam.to_value(u.um)) * u.deg,
    )
    top, bottom = plot_mirrors(retarder, reference={"fold": {"law A": other}}).axes
    np.testing.assert_allclose(lines(top)["law A"].get_ydata(), NM_OF_MIRRORS / 1000)
    np.testing.assert_allclose(lines(bottom)["law A"].get_ydata(), 180 - NM_OF_MIRRORS / 100)
    # of another mirror
    assert "law A" not in lines(plot_mirrors(retarder, reference={"m3": {"law A": other}}).axes[0])


def test_a_law_is_a_line_with_its_band(with_mirror):
    mirror = optics.MetalMirror(material="silver", incidence=45 * u.deg, name="fold")
    for key in mirror.param_names:
        getattr(mirror, key).fixed = key != mirror.param_names[0]
    calibration = with_mirror(mirror)
    top = plot_mirrors(calibration).axes[0]
    label = next(key for key in lines(top) if key.startswith("fitted law"))
    table = mirror_values(calibration, "fold")
    expected = table["diattenuation"].to_value(u.percent)
    np.testing.assert_allclose(lines(top)[label].get_ydata(), expected)
    (band,) = top.collections
    std = table["diattenuation_err"].to_value(u.percent)
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx((expected + std).max())


def test_no_mirror_and_no_such_mirror(elliptical, diattenuator):
    with pytest.raises(ChainError, match="has no mirror to draw"):
        plot_mirrors(elliptical)
    with pytest.raises(ChainError, match="no mirror 'm3'; the calibration has fold"):
        plot_mirrors(diattenuator, ["m3"])


WAVELENGTH = [1200, 1600, 2200] * u.nm


def fit(seed, date, shift=0.0, hold=False):
    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp")
        | optics.LinearRetarder(
            retardance=[-160, -110, -60] * u.deg, mount="derotator", name="derotator"
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    truth = chain.copy()
    truth["derotator"].retardance = truth["derotator"].retardance.quantity + shift * u.deg
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 100] * u.deg)
    table = simulate(truth, WAVELENGTH, frames, seed=seed, meta={"date": date}, name=date)
    chain["hwp"].w_sio2.fixed = chain["hwp"].w_mgf2.fixed = hold
    return calibrate(chain, table, search=False, cross_validate=False)


@pytest.fixture(scope="module")
def years():
    return [fit(1, "2025-02-01"), fit(2, "2025-10-05"), fit(3, "2026-02-01", 0.5)]


def texts(ax):
    return [text.get_text() for text in ax.texts]


@pytest.mark.slow
def test_panels_labels_and_changes(years):
    figure = plot_history(years)
    titles = [ax.get_title() for ax in figure.axes]
    assert titles == ["hwp.w_sio2", "hwp.w_mgf2", "derotator.retardance", "wollaston.efficiency"]
    panel = dict(zip(titles, figure.axes, strict=True))
    assert panel["hwp.w_sio2"].get_ylabel() == "value (mm)"
    assert panel["derotator.retardance"].get_ylabel() == "difference to the mean (deg)"
    assert all(len(texts(ax)) == 2 for ax in figure.axes)
    weights = [t.get_fontweight() for t in panel["derotator.retardance"].texts]
    assert weights == ["normal", "bold"]
    assert [t.get_text() for t in panel["derotator.retardance"].get_legend().get_texts()] == [
        "1200 nm", "1600 nm", "2200 nm",
    ]  # fmt: skip


def test_values_of_a_history_and_its_wavelengths(years):
    (ax,) = plot_history(years, ["hwp.w_sio2"]).axes
    drawn = ax.lines[0].get_ydata()
    assert drawn == pytest.approx([c.chain["hwp"].w_sio2.value for c in years])
    figure = plot_history(years, ["derotator.retardance"], shown=2)
    legend = figure.axes[0].get_legend()
    assert [t.get_text() for t in legend.get_texts()] == ["1200 nm", "2200 nm"]


def test_held_values_are_open_symbols(years):
    held = fit(4, "2026-03-01", hold=True)
    (ax,) = plot_history([*years, held], ["hwp.w_sio2"]).axes
    hollow = [line for line in ax.lines if line.get_markerfacecolor() == "white"]
    assert [len(line.get_xdata()) for line in hollow] == [1]
    # no change can be judged against a value that was held
    assert len(texts(ax)) == 2
    assert np.isfinite(ax.get_ylim()).all()


@pytest.mark.slow
def test_bad_input(years):
    record = dataclasses.replace(years[0].datasets[0], meta={})
    undated = dataclasses.replace(years[0], datasets=[record])
    with pytest.raises(ParameterError, match="2025-02-01: no date; state one"):
        plot_history([undated, *years[1:]])
    with pytest.raises(ParameterError, match="no calibration has a parameter 'm3'"):
        plot_history(years, ["m3"])
    with pytest.raises(ParameterError, match="0 parameters to draw"):
        plot_history(years, ["hwp.theta"])


def test_accuracies_that_no_run_has_are_not_in_the_legend():
    for known, labels in ((0.06, 2), (np.nan, 1)):
        run = {"date": "2025-10-05", "s_cv_percent": known, "s_res_percent": 0.05}
        figure = parameters.draw_accuracies({"calibrations": [run], "events": []})
        assert len(legend_texts(figure)) == labels, known
