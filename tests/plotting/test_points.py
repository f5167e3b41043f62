# Licensed under a 3-clause BSD style license - see LICENSE
"""Points and lines of parameters, and panels of a run, from hand-made numbers."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import optics
from astropolcal.plotting import efficiency, parameters, reduction, saving
from astropolcal.plotting._style import BLUE, GREY

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


def test_what_is_determined_is_filled_with_its_error():
    axes = drawn(entry([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]))
    (points,) = axes.containers
    line, _, (bars,) = points.lines
    assert line.get_xdata().tolist() == NM.tolist()
    lengths = [np.ptp(segment[:, 1]) / 2 for segment in bars.get_segments()]
    np.testing.assert_allclose(lengths, [0.1, 0.2, 0.3])
    assert labels(axes) == [parameters._DETERMINED]
    # the thin line leads from one wavelength to the next, whatever their order
    (thin,) = [one for one in axes.lines if one.get_linewidth() == 0.6]
    assert thin.get_xdata().tolist() == [1200, 1600, 2200]


def test_kinds_ofparameters_are_told_by_their_shape():
    axes = drawn(entry([1.0, 2.0, 3.0], [0.1, np.nan, 0.3], [False, False, True]))
    hollow = [one for one in axes.lines if one.get_markerfacecolor() == "white"]
    boxes = [one for one in axes.lines if one.get_marker() == "s"]
    (points,) = axes.containers
    assert points.lines[0].get_xdata().tolist() == [1600]
    assert hollow[0].get_xdata().tolist() == [1200, 2200]
    assert boxes[0].get_xdata().tolist() == [2200]
    assert set(labels(axes)) == {parameters._DETERMINED, parameters._ALONE, parameters._BOUND}


def test_at_a_bound_alone_is_not_called_open():
    axes = drawn(entry([1.0, 2.0, 3.0], [0.1, 0.2, 0.3], [True, False, False]))
    assert set(labels(axes)) == {parameters._DETERMINED, parameters._BOUND}


@pytest.mark.parametrize(
    ("options", "label"),
    [({"fixed": True}, "fixed"), ({"tied": "hwp.theta"}, "follows hwp.theta")],
)
def test_what_is_not_fitted_is_a_dotted_line(options, label):
    axes = drawn(entry([1.0, 2.0, 3.0], np.nan, **options))
    (line,) = axes.lines
    assert (line.get_linestyle(), line.get_label()) == (":", label)
    assert line.get_ydata().tolist() == [2, 1, 3]


# ---- one value -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("one", "label", "band"),
    [
        (entry(2.0, 0.5), "one value for all wavelengths", (1.5, 2.5)),
        (entry(2.0, np.nan), "one value for all wavelengths, not determined alone", None),
        (entry(2.0, np.nan, bound=True), "one value for all wavelengths, at a bound", None),
        (entry(2.0, np.nan, fixed=True), "fixed", None),
    ],
)
def test_a_constant_is_a_line_over_the_range(one, label, band):
    axes = drawn(one)
    (line,) = axes.lines
    assert line.get_xdata().tolist() == [1200, 2200]
    assert line.get_ydata().tolist() == [2, 2]
    assert line.get_label() == label
    if band is None:
        assert not axes.collections
    else:
        edges = axes.collections[0].get_paths()[0].vertices[:, 1]
        assert (edges.min(), edges.max()) == pytest.approx(band)


# ---- laws ----------------------------------------------------------------------------------


def test_band_of_a_law_is_propagated_from_the_covariance():
    """Retardance in the thickness of one layer: the slope is exact, as it is proportional."""
    plate = optics.TwoLayerWaveplate(mount="hwp", name="hwp")
    lam = np.array([1200.0, 1700.0])
    sigma = 1e-4
    covariance = SimpleNamespace(names=["other.x", "hwp.w_sio2"], matrix=np.diag([7.0, sigma**2]))
    found = parameters._law_std(calibration(covariance=covariance), plate, lam)
    thicker = plate.with_parameters(w_sio2=(plate.w_sio2.value + 0.1) * u.mm)
    slope = (parameters._retardance(thicker, lam) - parameters._retardance(plate, lam)) / 0.1
    np.testing.assert_allclose(found, np.abs(slope) * sigma, rtol=1e-6)


@pytest.mark.parametrize(
    "covariance",
    [
        SimpleNamespace(names=["other.x"], matrix=np.ones((1, 1))),
        SimpleNamespace(names=["hwp.w_sio2"], matrix=np.full((1, 1), np.nan)),
    ],
)
def test_a_law_whose_parameters_have_no_error_has_no_band(covariance):
    plate = optics.TwoLayerWaveplate(mount="hwp", name="hwp")
    assert parameters._law_std(calibration(covariance=covariance), plate, NM) is None


def test_first_step_is_drawn_on_the_turn_of_the_law():
    plate = optics.TwoLayerWaveplate(mount="hwp", name="hwp")
    law = parameters._retardance(plate, NM)
    stage = {"parameters": {"hwp.retardance": law + np.array([0.5, 360.5, -719.5])}}
    axes = Figure().subplots()
    parameters._draw_stage(axes, calibration(stages=[{"parameters": {}}, stage]), plate)
    (line,) = axes.lines
    np.testing.assert_allclose(line.get_ydata(), law + 0.5)
    assert (line.get_label(), line.get_color()) == (parameters._STAGE, GREY)


def test_values_of_a_law_are_words():
    own = {
        "w_sio2": entry(1.65, 0.01),
        "w_mgf2": entry(1.25, np.nan),
        "many": entry([1.0, 2.0], 0.1),
    }
    assert list(parameters._words(own)) == ["w_sio2 = 1.6500 ± 0.0100 deg", "w_mgf2 = 1.2500 deg"]
    rows = list(parameters._in_rows(["x" * 30, "y" * 30, "z"]))
    assert rows == [["x" * 30], ["y" * 30, "z"]]


@pytest.mark.parametrize(
    ("values", "halves"),
    [([170.0, 190.0], [180]), ([-175.0, -178.0], [-180]), ([100.0, 190.0], []), ([0.0, 10.0], [])],
)
def test_half_wave_is_marked_where_the_data_come_near(values, halves):
    axes = Figure().subplots()
    axes.plot([1, 2], values)
    parameters._mark_half_wave(axes)
    assert [line.get_ydata()[0] for line in axes.lines[1:]] == halves


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
        assert texts[1] == f"{parameters._ALONE} (the data leave {words} open)"
        assert {handle.get_color() for handle in legend.legend_handles} == {"#000000"}


# ---- a run over time -----------------------------------------------------------------------


def frame(mjd=None, reason="", flux=(1.0, 2.0)):
    photometry = SimpleNamespace(
        flux=np.array(flux)[:, None] * np.ones((1, 2)), reasons=[reason, ""]
    )
    return SimpleNamespace(values={} if mjd is None else {"mjd": mjd}, photometry=photometry)


@pytest.mark.parametrize(
    ("times", "clock", "label"),
    [
        ([60000.0, 60000.5, 59999.0], [1440, 2160, 0], "time since the first frame (min)"),
        ([60000.0, None], [0, 1], "frame"),
        ([60000.0, 60000.0], [0, 1], "frame"),
    ],
)
def test_clock_of_a_run(times, clock, label):
    found, words = reduction._clock([frame(time) for time in times])
    np.testing.assert_allclose(found, clock)
    assert words == label


def test_cells_that_failed_have_no_value():
    run = SimpleNamespace(frames=[frame(), frame(reason="saturated"), frame(flux=(3.0, 4.0))])
    np.testing.assert_array_equal(
        reduction._cells(run, 0, "flux"), [[1.0, np.nan, 3.0], [2.0, np.nan, 4.0]]
    )
    # at another wavelength the frame is good
    assert np.isfinite(reduction._cells(run, 1, "flux")).all()


def test_an_image_without_values_says_so():
    panel = Figure().subplots()
    reduction._draw_image(panel, np.full((4, 4), np.nan))
    assert [text.get_text() for text in panel.texts] == ["no values"]
    assert not panel.images


def test_scale_of_an_image_leaves_out_hot_pixels():
    image = np.random.default_rng(1).normal(100, 1, (50, 50))
    image[3, 3], image[4, 4] = 1e6, np.nan
    panel = Figure().subplots()
    reduction._draw_image(panel, image)
    low, high = panel.images[0].get_clim()
    assert 95 < low < high < 200
    assert panel.get_xlim() == (-0.5, 49.5)


# ---- small things --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shown", "names"),
    [
        (None, ["1200 nm", "1400 nm", "1600 nm", "1800 nm", "2000 nm", "2200 nm"]),
        # the nearest, each once
        ([1190, 1210, 2300] * u.nm, ["1200 nm", "2200 nm"]),
    ],
)
def test_lines_of_the_efficiency(shown, names):
    lam = np.arange(1200.0, 2201, 200)
    axes = Figure().subplots()
    values = np.linspace(0, 1, 5)[:, None] * np.ones(lam.size)
    efficiency._lines(axes, lam, np.arange(5), values, shown)
    assert [line.get_label() for line in axes.lines] == names
    np.testing.assert_allclose(axes.lines[0].get_ydata(), values[:, 0])
    assert axes.get_ylabel() == "measured share of the polarization"


def test_what_does_not_move_is_drawn_first():
    names = [f"a.x[{i}]" for i in range(4)] + ["hwp.theta"]
    posterior = SimpleNamespace(
        names=names, autocorrelation_times=np.array([3.0, np.nan, 9.0, 5.0, 1.0])
    )
    assert saving._drawn(posterior, 5, True) == names
    assert saving._drawn(posterior, 3, True) == ["hwp.theta", "a.x[1]", "a.x[2]"]
    assert saving._drawn(posterior, 3, False) == ["hwp.theta"]
