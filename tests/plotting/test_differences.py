# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of data: double differences and the map of residuals."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from astropolcal import Observations, calibrate, instruments, optics
from astropolcal.chain import leaves
from astropolcal.exceptions import CalibrationFileError, ParameterError, WavelengthRangeError
from astropolcal.observations.observables import get_observable
from astropolcal.plotting import plot_double_differences, plot_residuals
from astropolcal.plotting._data import DataGrid
from astropolcal.plotting.differences import _looks
from astropolcal.simulation import half_wave_plate_cycles, simulate


def points(axes):
    """Markers of a panel by label, as arrays (n, 2)."""
    return {c.get_label(): np.column_stack(c[0].get_data()) for c in axes.containers}


def curves(axes):
    """Model curves of a panel: lines without markers that are longer than any data."""
    return [line for line in axes.lines if len(line.get_xdata()) > 100]


def observed(calibration, dataset, wavelength):
    """Angles and double differences formed from the fluxes by hand."""
    obs = calibration.measurement.datasets[dataset].observations
    pairs = np.asarray(obs.pairs())
    row = np.argmin(np.abs(obs.wavelength - wavelength))
    right, left = (flux[:, row][pairs.T] for flux in (obs.flux_right, obs.flux_left))
    value = ((right - left)[0] - (right - left)[1]) / (right + left).sum(axis=0)
    angle = np.rad2deg(obs.position("derotator"))[pairs[:, 0]]
    return angle, value


def test_has_a_pair_of_panels_for_each_of_four_wavelengths(elliptical):
    figure = plot_double_differences(elliptical)
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 8
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert len(titles) == 4
    assert all("nm" in title and "s_res" in title and "%" in title for title in titles)


def test_points_are_the_observations(elliptical):
    top, bottom = plot_double_differences(elliptical, [1600] * u.nm).axes
    assert top.get_title().startswith("1600.0 nm")
    drawn = np.concatenate(list(points(top).values()))
    angle, value = observed(elliptical, 0, 1600 * u.nm)
    expected = np.column_stack([angle, value])
    np.testing.assert_allclose(
        drawn[np.lexsort(drawn.T)], expected[np.lexsort(expected.T)], rtol=1e-9
    )
    residual = np.concatenate([p[:, 1] for p in points(bottom).values()])
    mine = elliptical.measurement
    assert sorted(residual) == pytest.approx(sorted(100 * mine.residuals()[mine.bins == 2]))


def test_one_color_and_marker_a_half_wave_plate_angle(elliptical):
    top, bottom = plot_double_differences(elliptical, [1600] * u.nm).axes
    lines = [container[0] for container in top.containers]
    assert len(lines) == 4
    assert len({line.get_color() for line in lines}) == 4
    assert len({line.get_marker() for line in lines}) == 4
    below = [container[0].get_color() for container in bottom.containers]
    assert below == [line.get_color() for line in lines]
    labels = list(points(top))
    assert [label.split(" ")[0] for label in labels] == ["0°", "11.25°", "22.5°", "33.75°"]
    assert labels[0].endswith("45°")


@pytest.fixture(scope="module")
def modulated():
    """VAMPIRES with its liquid crystal: the two frames of a pair differ in its state."""
    vampires = instruments.get("vampires")
    wavelength = [625, 675, 720, 750] * u.nm
    chain = vampires.chain("polarized", ("flc",), wavelength=wavelength, derotator="linear")
    for leaf in leaves(chain):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = (leaf.name, key) != ("derotator", "retardance")
    cycles = half_wave_plate_cycles(derotator=[45, 75, 105] * u.deg)
    frames = cycles[np.repeat(np.arange(len(cycles)), 2)]
    frames["flc_state"] = np.tile([0, 1], len(cycles))
    meta = {"instrument": "SCExAO/VAMPIRES", "source": "polarized", "flc": "in"}
    observations = simulate(chain, wavelength, frames, flux=1e6, seed=1, meta=meta)
    return calibrate(chain, observations, cross_validate=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elliptical", "masked", "two_step", "single_angle", "modulated"])
def test_curve_goes_through_the_model_at_the_data(name, request):
    calibration = request.getfixturevalue(name)
    grid = DataGrid(calibration, 0)
    bins = np.array([0, 3])
    for series in grid.series():
        predicted = (grid.observed - grid.residual)[np.ix_(bins, series.data)]
        curve = grid.curve(series, bins, grid.derotator[series.data])
        known = np.isfinite(predicted)
        assert known.any()
        np.testing.assert_allclose(curve[known], predicted[known], atol=1e-12)


def test_curve_is_fine_and_spans_the_data(elliptical):
    top = plot_double_differences(elliptical, [1200] * u.nm).axes[0]
    assert len(curves(top)) == 4
    for line in curves(top):
        x = line.get_xdata()
        assert x.min() < 45
        assert x.max() > 132.5
        assert np.diff(x).max() < 1


@pytest.mark.slow
def test_axes_have_units_and_the_legend_hides_no_data(elliptical):
    figure = plot_double_differences(elliptical)
    figure.draw_without_rendering()
    labels = {axes.get_xlabel() for axes in figure.axes} - {""}
    assert labels == {"derotator angle (°)"}
    assert any("(%)" in axes.get_ylabel() for axes in figure.axes)
    box = figure.legends[0].get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
    assert box.x1 <= figure.bbox.x1 + 1


def test_errors_are_drawn_from_the_table(elliptical):
    bottom = plot_double_differences(elliptical, [1600] * u.nm).axes[1]
    mine = elliptical.measurement
    drawn = []
    for container in bottom.containers:
        (bars,) = container[2]
        drawn += [(segment[1, 1] - segment[0, 1]) / 2 for segment in bars.get_segments()]
    assert sorted(drawn) == pytest.approx(sorted(100 * mine.sigma[mine.bins == 2]))


def test_masked_data_are_not_drawn(masked):
    top = plot_double_differences(masked, [1600] * u.nm).axes[0]
    drawn = np.concatenate([p[:, 1] for p in points(top).values()])
    # one frame of two pairs is masked at this wavelength
    assert len(drawn) == 20
    assert np.isfinite(drawn).sum() == 18


def test_single_angle_with_one_frame_a_datum(single_angle):
    figure = plot_double_differences(single_angle, [1400] * u.nm)
    top = figure.axes[0]
    assert len(points(top)) == 8
    assert "single difference" in top.get_ylabel().replace("\n", " ")
    assert top.get_xlim() == pytest.approx((60, 80))
    assert "of the frame" in figure.legends[0].get_title().get_text()


def test_second_dataset_is_drawn_on_demand(several):
    figure = plot_double_differences(several, [1600] * u.nm, dataset=1)
    assert "unpolarized" in figure.get_suptitle()
    drawn = np.concatenate([p[:, 1] for p in points(figure.axes[0]).values()])
    assert sorted(drawn) == pytest.approx(sorted(observed(several, 1, 1600 * u.nm)[1]))


def test_nearest_wavelengths_are_shown_once(elliptical):
    figure = plot_double_differences(elliptical, [1590, 1610, 2190] * u.nm)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert [title.split(" ")[0] for title in titles] == ["1600.0", "2200.0"]


@pytest.mark.slow
def test_moving_stage_leaves_the_model_at_the_data_only():
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.Rotator(mount="altitude", name="altitude")
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    frames["altitude"] = np.repeat([30, 40, 50], 8) * u.deg
    observations = simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)
    calibration = calibrate(chain, observations)
    figure = plot_double_differences(calibration, [1.2] * u.um)
    top = figure.axes[0]
    assert not curves(top)
    crosses = [line for line in top.lines if line.get_marker() == "x"]
    assert sum(len(line.get_xdata()) for line in crosses) == 12
    assert "model at data" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_positions_given_to_the_fit_are_the_ones_drawn():
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(retardance=90 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    observations = simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)
    true = {name: observations.position(name) for name in ("hwp", "derotator")}
    shifted = true | {"derotator": true["derotator"] + np.deg2rad(10)}
    calibration = calibrate(chain, observations, positions=[shifted])
    top = plot_double_differences(calibration, [1.2] * u.um).axes[0]
    drawn = np.concatenate([p[:, 0] for p in points(top).values()])
    assert set(np.round(drawn, 6)) == {55, 70, 100}


def test_draws_into_a_given_figure(elliptical):
    mine = Figure(figsize=(6, 6))
    assert plot_double_differences(elliptical, [1600] * u.nm, figure=mine) is mine
    assert len(mine.axes) == 2


@pytest.mark.parametrize("dataset", [1, -1, True, "polarized", 0.5])
def test_unknown_dataset_is_refused(elliptical, dataset):
    with pytest.raises(ParameterError, match="allowed are whole numbers 0 to 0"):
        plot_double_differences(elliptical, dataset=dataset)


def test_wavelength_out_of_range_is_refused(elliptical):
    with pytest.raises(WavelengthRangeError, match=r"3000 nm; simulated has 1200\.0 to 2200\.0"):
        plot_double_differences(elliptical, [1600, 3000] * u.nm)


@pytest.mark.parametrize("wavelengths", [1600, [1600, 1700] * u.deg])
def test_wavelength_without_unit_of_length_is_refused(elliptical, wavelengths):
    with pytest.raises(ParameterError, match="needs a unit such as nm"):
        plot_double_differences(elliptical, wavelengths)


@pytest.mark.parametrize("draw", [plot_double_differences, plot_residuals])
def test_calibration_without_data_says_so(elliptical, draw):
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        draw(replace(elliptical, measurement=None))


# ---- map of residuals ----------------------------------------------------------


def mesh(axes):
    return next(c for c in axes.collections if isinstance(c, QuadMesh))


def test_map_holds_every_residual(elliptical):
    figure = plot_residuals(elliptical)
    drawn = mesh(figure.axes[0])
    assert drawn.get_array().shape == (5, 20)
    values = np.ma.getdata(drawn.get_array()).ravel()
    np.testing.assert_allclose(np.sort(values), np.sort(100 * elliptical.residuals))
    low, high = drawn.get_clim()
    assert low == -high


def test_map_is_grouped_by_derotator_angle(elliptical):
    figure = plot_residuals(elliptical)
    axes = figure.axes[0]
    names = [text.get_text() for text in axes.get_xticklabels()]
    assert names == ["45°", "57.5°", "82.5°", "107.5°", "132.5°"]
    grid = DataGrid(elliptical, 0)
    first = 100 * grid.residual[:, np.isclose(grid.derotator, 45)]
    drawn = mesh(axes).get_array()[:, :4]
    np.testing.assert_allclose(np.sort(drawn, axis=1), np.sort(first, axis=1))


def test_marginal_rms(elliptical):
    main, above, right = plot_residuals(elliptical).axes[:3]
    percent = mesh(main).get_array()
    rms = np.sqrt((percent**2).mean(axis=0))
    np.testing.assert_allclose(above.patches[0].get_data().values, rms)
    np.testing.assert_allclose(right.lines[0].get_xdata(), np.sqrt((percent**2).mean(axis=1)))
    assert above.get_ylabel() == right.get_xlabel() == "rms (%)"


def test_masked_data_stay_blank_in_the_map(masked):
    blank = np.ma.getmaskarray(mesh(plot_residuals(masked).axes[0]).get_array())
    # a frame is masked at all five wavelengths, another at one
    assert blank.sum() == 6
    assert blank.all(axis=0).sum() == 1


def test_maps_of_several_datasets_share_their_colours(several):
    figure = plot_residuals(several)
    meshes = [c for axes in figure.axes for c in axes.collections if isinstance(c, QuadMesh)]
    maps = [m for m in meshes if m.get_array().shape[0] == 5 and m.axes.get_ylabel()]
    maps = [m for m in maps if "nm" in m.axes.get_ylabel()]
    assert [m.get_array().shape for m in maps] == [(5, 20), (5, 12)]
    assert maps[0].get_clim() == maps[1].get_clim()
    assert [a.get_title(loc="left") for a in figure.axes[1:5:3]] == ["polarized", "unpolarized"]


def test_one_wavelength_and_many_derotator_angles():
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=np.linspace(0, 170, 18) * u.deg)
    calibration = calibrate(chain, simulate(chain, [1.6] * u.um, frames, seed=1))
    axes = plot_residuals(calibration).axes[0]
    assert len(axes.get_xticklabels()) == 9
    # no map of a single row, but a bar a datum
    assert not axes.collections
    drawn = [bar.get_height() for bar in axes.patches]
    np.testing.assert_allclose(np.sort(drawn), np.sort(100 * calibration.residuals))
    assert "1600.0 nm" in axes.get_title(loc="left")
    assert len(plot_double_differences(calibration).axes) == 2


# ---- real data -------------------------------------------------------------------


@pytest.mark.slow
def test_charis_dataset_is_drawn_as_the_paper_has_it(shared_data):
    """Dataset 3: 8 derotator angles, 4 double differences, amplitude near 1 at 1329 nm."""
    (path,) = (shared_data / "data" / "charis").glob("dataset3_*.ecsv")
    observations = Observations.read(path)
    chain = instruments.get("charis").chains_for([observations])
    calibration = calibrate(chain, observations, instrument="charis", cross_validate=False)
    figure = plot_double_differences(calibration, [1329, 1575, 1744, 1932] * u.nm)
    assert len(figure.axes) == 8
    top = figure.axes[0]
    assert top.get_title().startswith("1328.6 nm")
    assert [len(p) for p in points(top).values()] == [8, 8, 8, 8]
    # a derotator near 180 deg of retardance turns the polarization by nearly all of it
    assert 0.9 < max(line.get_ydata().max() for line in curves(top)) < 1
    assert (
        calibration.measurement.observable.name
        == get_observable("normalized_double_difference").name
    )


# ---- many series -----------------------------------------------------------------


def test_where_colours_recur_lines_and_markers_are_others():
    found = _looks(16)
    assert found[0]["color"] == found[8]["color"]
    assert [one["linestyle"] for one in found] == ["-"] * 8 + ["--"] * 8
    assert {one["markerfacecolor"] for one in found[8:]} == {"white"}


def test_long_title_and_legend_do_not_overlap(elliptical):
    part = elliptical.measurement.datasets[0]
    figure = plot_double_differences(elliptical, [1600] * u.nm)
    assert part.observations.name in figure.get_suptitle()
    figure.suptitle("Double difference\n" + 45 * "n")
    figure.draw_without_rendering()
    title, legend = figure._suptitle.get_window_extent(), figure.legends[0].get_window_extent()
    assert not title.overlaps(legend)
