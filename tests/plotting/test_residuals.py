# Licensed under a 3-clause BSD style license - see LICENSE
"""Double differences, the map of residuals, and the grid of data that they draw."""

from dataclasses import replace
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from matplotlib.figure import Figure

from astropolcal import Observations, calibrate, instruments, optics
from astropolcal.chain import join, leaves
from astropolcal.exceptions import CalibrationFileError, ParameterError, WavelengthRangeError
from astropolcal.observations.observables import get_observable
from astropolcal.plotting import _style, plot_double_differences
from astropolcal.plotting.residuals import (
    DataGrid,
    _layout,
    _looks,
    _name_axis,
    _scales,
    plot_residuals,
)
from astropolcal.reduction.cubes import both_states
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
def test_curve_goes_through_the_model_at_the_data(request):
    for name in ["elliptical", "masked", "two_step", "single_angle", "modulated"]:
        calibration = request.getfixturevalue(name)
        grid = DataGrid(calibration, 0)
        bins = np.array([0, 3])
        for series in grid.series():
            predicted = (grid.observed - grid.residual)[np.ix_(bins, series.data)]
            curve = grid.curve(series, bins, grid.abscissa[series.data])
            known = np.isfinite(predicted)
            assert known.any(), name
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


def test_unknown_datasets_and_wavelengths_are_refused(elliptical):
    for dataset in [1, -1, True, "polarized", 0.5]:
        with pytest.raises(ParameterError, match="allowed are whole numbers 0 to 0"):
            plot_double_differences(elliptical, dataset=dataset)
    with pytest.raises(WavelengthRangeError, match=r"3000 nm; simulated has 1200\.0 to 2200\.0"):
        plot_double_differences(elliptical, [1600, 3000] * u.nm)
    for wavelengths in [1600, [1600, 1700] * u.deg]:
        with pytest.raises(ParameterError, match="needs a unit such as nm"):
            plot_double_differences(elliptical, wavelengths)


def test_calibration_without_data_says_so(elliptical):
    for draw in [plot_double_differences, plot_residuals]:
        with pytest.raises(CalibrationFileError, match="holds no observations"):
            draw(replace(elliptical, measurement=None))


# ---- map of residuals ----------------------------------------------------------


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


MINUS = "\N{MINUS SIGN}"
FIELDS = [610, 670, 720] * u.nm


@pytest.fixture(scope="module")
def grid(masked):
    return DataGrid(masked, 0)


@pytest.fixture(scope="module")
def modulated_of_data_grid():
    """Frames of a ferroelectric modulator, whose two states make the difference."""
    chain = instruments.get("vampires").chain(wavelength=FIELDS, derotator="linear")
    table = both_states(half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg))
    meta = {"instrument": "vampires", "source": "polarized", "pairing": "flc_state"}
    data = simulate(chain, FIELDS, table, flux=1e6, seed=1, meta=meta, name="lamp")
    return DataGrid(calibrate(chain, data, search=False, cross_validate=False), 0)


# ---- grids ---------------------------------------------------------------------------------


def test_grids_hold_each_datum_at_its_place(grid):
    part = grid.part
    known = np.isfinite(grid.observed)
    np.testing.assert_array_equal(known, part.valid)
    np.testing.assert_allclose(grid.observed[known], part.observed)
    np.testing.assert_allclose(grid.sigma[known], part.sigma)
    # two masked cells and a masked frame take their pairs along
    assert np.sum(~known) == 1 + len(grid.wavelength)


def test_residual_is_observed_less_model(grid):
    vector = grid.part.values if hasattr(grid.part, "values") else None
    assert vector is not None
    near = np.abs(grid.residual) < 6 * grid.sigma
    assert near[np.isfinite(grid.residual)].all()


def test_series_are_the_settings_of_the_plate(grid):
    series = grid.series()
    pairs = [("0°", "45°"), ("11.25°", "56.25°"), ("22.5°", "67.5°"), ("33.75°", "78.75°")]
    assert [one.label for one in series] == [f"{a} {MINUS} {b}" for a, b in pairs]
    together = np.concatenate([one.data for one in series])
    assert sorted(together) == list(range(grid.observed.shape[1]))
    for one in series:
        plate = np.rad2deg(grid.position("hwp")[0, one.data])
        assert np.ptp(plate) < 0.5
        assert set(one.positions) == {"hwp"}


def test_series_of_a_modulator_name_its_states(modulated_of_data_grid):
    labels = [one.label for one in modulated_of_data_grid.series()]
    assert labels[0] == f"0°, A {MINUS} B"
    assert len(labels) == 8
    assert all(label.endswith(f", A {MINUS} B") for label in labels)


# ---- wavelengths ---------------------------------------------------------------------------


def lambdas(wavelength, known=None):
    """A grid with these wavelengths (nm), some of them without data."""
    new = object.__new__(DataGrid)
    new.wavelength = np.asarray(wavelength, float)
    known = np.ones(len(wavelength), dtype=bool) if known is None else np.asarray(known)
    new.observed = np.where(known[:, None], 0.1, np.nan) * np.ones((1, 3))
    new.part = SimpleNamespace(observations=SimpleNamespace(name="run"))
    return new


def test_wavelengths_are_spread_over_the_range():
    found = lambdas(np.linspace(1200, 2400, 22)).spread_bins(4)
    assert len(found) == 4
    steps = np.diff(found)
    assert steps.max() - steps.min() <= 1
    # away from the ends, where the data are poor
    assert found[0] > 0
    assert found[-1] < 21
    # few wavelengths are all drawn in order
    assert lambdas([1600, 1200, 2200]).spread_bins(4).tolist() == [1, 0, 2]
    assert lambdas([1600, 1200, 2200, 1900, 1400]).spread_bins(4).tolist() == [1, 4, 3, 2]
    # a wavelength without data is not drawn
    known = np.arange(5) != 2
    assert 2 not in lambdas(np.arange(5) + 1200.0, known).spread_bins(5)


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
    assert np.all(np.diff(grid.angle[order]) >= -0.5)
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
    # tallest bar has room above
    tallest = np.nanmax(above.patches[0].get_data().values)
    assert above.get_ylim()[1] == pytest.approx(1.05 * tallest)


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
    assert figure.axes[-1].get_ylabel() == "observed \N{MINUS SIGN} model (%); grey: no datum"
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


def test_scale_covers_nearly_all_residuals():
    for residual, limit, clipped in [
        (np.zeros(50), 1e-12, False),
        (np.full(50, -0.02), 2.0, False),
        # of a thousand data one is far out: it does not blank the others
        ([*([0.01] * 999), 5.0], 1.0, True),
        ([0.01, np.nan, -0.01], 1.0, False),
    ]:
        found, beyond = _style.color_limit(100 * np.asarray(residual), 99)
        assert found == pytest.approx(limit), (residual, limit, clipped)
        assert beyond == clipped, (residual, limit, clipped)


def test_many_groups_have_few_labels():
    n = 30
    parts = np.array_split(np.arange(n), 9)
    series = [SimpleNamespace(label=f"{i}°", data=data) for i, data in enumerate(parts)]
    grid = SimpleNamespace(
        angle=np.arange(n) * 5.0, turning="derotator", by_plate=True, series=lambda: series
    )
    axes = Figure().subplots()
    _name_axis(axes, grid)
    assert len(axes.get_xticks()) <= 12
    # more than eight settings of the plate are named by the first and the last
    assert axes.get_xlabel().endswith("0° to 8°")


def test_data_without_a_derotator_are_drawn():
    """Against the stage that turns, by the states of a device, or of a star by the plate."""
    plate = optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
    lamp = (
        optics.LinearPolarizer(name="lamp")
        | plate
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    frames = QTable({"hwp": np.arange(0, 180, 22.5) * u.deg})
    wheel = [
        optics.StateAnalyser(
            efficiency=0.9, theta=angle * u.deg, name=f"p{angle}", mount=f"filter=P{angle}"
        )
        for angle in (0, 60, 120)
    ]
    turned = optics.LinearPolarizer(mount="calibrator", name="calibrator")
    states = QTable({"calibrator": np.repeat(np.arange(0, 180, 15), 3) * u.deg})
    states["filter"] = np.tile(["P0", "P60", "P120"], 12)
    states["group"] = np.arange(36) // 3
    sky = optics.PolarizedSource(q=0.05, u=0.0, name="star")
    star = sky | optics.Rotator(mount="parallactic", name="p") | plate | lamp["wollaston"]
    night = QTable({"hwp": np.tile([0, 45, 22.5, 67.5], 4) * u.deg})
    night["parallactic"] = np.linspace(-40, 40, 16) * u.deg
    pairs = {f" {_style.MINUS} ".join(pair) for pair in (("0°", "45°"), ("22.5°", "67.5°"))}
    for chain, table, source, label, names, between in (
        (lamp, frames, "polarized", "half-wave plate angle (°)", {"all"}, True),
        (join([turned, *wheel]), states, "lamp", "calibrator angle (°)",
         {"filter P0", "filter P60", "filter P120"}, False),
        (star, night, "star", "parallactic angle (°)", pairs, False),
    ):  # fmt: skip
        data = simulate(chain, [0.6] * u.um, table, seed=1, meta={"source": source})
        calibration = calibrate(chain, data, cross_validate=False)
        top, bottom = plot_double_differences(calibration).axes
        assert bottom.get_xlabel() == label
        assert set(points(top)) == names
        assert bool(curves(top)) == between
        for curve in curves(top):
            measured = np.concatenate(list(points(top).values()))
            model = np.interp(measured[:, 0], *curve.get_data())
            np.testing.assert_allclose(model, measured[:, 1], atol=0.01)
        assert plot_residuals(calibration).axes


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
