# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of a diagnosis show the numbers of the diagnosis."""

from dataclasses import replace
from types import SimpleNamespace

import astropy.units as u
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic
from astropolcal.exceptions import ParameterError
from astropolcal.gap import Cause, diagnose, get_effect
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import Effect, EffectParameter
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.model import nominal_model
from astropolcal.gap.report import Fitted
from astropolcal.plotting import gap as figures
from astropolcal.plotting._style import BLACK
from astropolcal.plotting.gap import (
    _cause_map,
    _on_map,
    plot_cause_map,
    plot_effect_sizes,
    plot_gap_frames,
    plot_gap_maps,
    plot_gap_spectrum,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate

ALL = [plot_cause_map, plot_gap_frames, plot_gap_maps, plot_gap_spectrum]
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
def test_a_figure_without_traces(gap, none):
    for plot in ALL:
        before = dict(mpl.rcParams)
        for diagnosis in (gap, none):
            own = Figure()
            assert plot(diagnosis, figure=own) is own, plot
            own.canvas.draw()
        assert dict(mpl.rcParams) == before, plot


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


NM = np.array([1200.0, 1600.0, 2200.0])


def cause(what, probability=1.0, aliases=(), share=1.0):
    """A cause that is a cell, or a named effect that has none."""
    cell = what if isinstance(what, Cell) else None
    effect = CellEffect(what) if cell else get_effect(what)
    aliases = [(SimpleNamespace(effect=CellEffect(one), cell=one), part) for one, part in aliases]
    return Cause(effect, cell, probability, aliases, share, 0.0, 0.9)


def diagnosis(*causes, verdict="located"):
    chain = instruments.get("charis").chain(derotator="linear")
    nominal = SimpleNamespace(chains=[chain])
    return SimpleNamespace(causes=list(causes), verdict=verdict, nominal=nominal, content=None)


# ---- the map -------------------------------------------------------------------------------

DRIFT = Cell("in:derotator", "retardance_h", "time")


def test_rows_are_places_in_the_order_of_the_light():
    rows = list(_cause_map(diagnosis()))
    assert rows == ["source", "in:hwp", "after:hwp", "in:derotator", "after:derotator", "detector"]
    # a place that the chain of these data does not have
    assert (
        list(_cause_map(diagnosis(cause(Cell("telescope", "rotation", "time")))))[-1] == "telescope"
    )


def test_probabilities_are_summed_over_dependences_and_aliases():
    others = [
        (Cell("in:derotator", "retardance_d", "step:4"), 0.2),
        (Cell("after:hwp", "rotation", "time"), 0.3),
    ]
    found = _cause_map(diagnosis(cause(DRIFT, 0.9, others, share=0.5)))
    assert found["in:derotator"]["retardance"] == (pytest.approx(0.63), "along axes")
    assert found["after:hwp"]["rotation"][0] == pytest.approx(0.27)
    # of two causes at one place at least one is there
    found = _cause_map(diagnosis(cause(DRIFT, 0.5), cause(DRIFT, 0.5)))
    assert found["in:derotator"]["retardance"][0] == pytest.approx(0.75)


def test_named_effects_have_a_place_in_the_map():
    for name, place, family in (
        ("beam_gain", "detector", "beams, detector"),
        ("hwp_diattenuation", "in:hwp", "diattenuation"),
        ("static_retarder", "after:derotator", "other"),
        ("hwp_encoder_eccentricity", "in:hwp", "other"),
    ):
        found = {k: row for k, row in _cause_map(diagnosis(cause(name))).items() if row}
        assert list(found) == [place]
        assert family in found[place] or family == "other"


def test_an_effect_of_the_user_is_in_the_row_of_its_place():
    """Whatever the optic is called; an alternative is where the optic is that it turns."""
    glass = optics.LinearRetarder(retardance=0 * u.deg, name="pane")
    charis = instruments.get("charis")
    inside, on_sky = charis.chain(derotator="linear"), charis.chain("star")
    for side, chain, place in (
        ({"inside": "hwp"}, inside, "in:hwp"),
        ({"after": "derotator"}, inside, "after:derotator"),
        ({"before": "hwp"}, inside, "source"),
        ({"before": "hwp"}, on_sky, "telescope"),
        ({"after": "wollaston"}, inside, "detector"),
    ):
        own = Effect.insert(glass, **side, name="pane", title="a pane of the user")
        assert _on_map(own, None, [chain])[0] == place, (side, place)
    for name, place in (
        ("hwp_sign", "in:hwp"),
        ("mirror_flip", "after:derotator"),
        ("parallactic_sign", "source"),
        ("beams_swapped", "detector"),
    ):
        assert _on_map(get_effect(name), None, [on_sky])[0] == place, name


def test_cells_that_matter_have_words():
    axes = plot_cause_map(diagnosis(cause(DRIFT, 0.98), cause("beam_gain", 0.3))).axes[0]
    words = [text.get_text().replace("\n", " ") for text in axes.texts]
    assert words == ["98 %", "along axes", "30 %", "named"]
    # dark words on light ground, and the reverse
    assert [text.get_color() for text in axes.texts[::2]] == ["white", BLACK]
    assert not plot_cause_map(diagnosis()).axes[0].texts


def test_verdict_as_a_title():
    for verdict, causes, line in (
        ("named", ["beam_gain"], "named: beam_gain"),
        ("located", ["beam_gain", "hwp_tilt"], "located: 2 causes"),
        ("none", [], "no gap beyond the noise"),
        ("unexplained", ["beam_gain"], "a real gap that is not explained"),
    ):
        own = diagnosis(*map(cause, causes), verdict=verdict)
        figure = figures._finish(Figure(), None, own, "Gap")
        assert figure.get_suptitle() == f"Gap\n{line}"


# ---- sizes ---------------------------------------------------------------------------------


def sized(sizes, parameters, factor=1.0):
    """A diagnosis with one cause of these sizes, as its report has them."""
    problem = SimpleNamespace(
        wavelength=NM / 1000,
        free=SimpleNamespace(by_name={name: SimpleNamespace(factor=factor) for name in sizes}),
    )
    found = diagnosis(cause("beam_gain"))
    model = SimpleNamespace(problem=problem, added={"beam_gain": parameters}, chains=[])
    found.nominal = found.improved = model
    found.content = {"causes": [{"size": sizes, "cell": None}]}
    return found


def size(value, std, unit="deg", limit=1.0):
    return {"value": list(value), "std": list(std), "unit": unit, "limit": limit}


def test_a_panel_for_each_size_that_depends_on_the_wavelength():
    names = ["gap_one.horizontal", "gap_one.horizontal_rate", "gap_one.same", "gap_one.common"]
    sizes = {name: size([1.0, 2.0, 3.0], [0.01, 0.02, 0.03]) for name in names[:2]}
    sizes["gap_one.same"] = size([1.0] * 3, [0.01] * 3)
    sizes["gap_one.common"] = {"value": 1.0, "std": 0.1, "unit": "", "limit": 1.0}
    found = sized(sizes, [EffectParameter(name, 1, 1) for name in names])
    figure = plot_effect_sizes(found, "beam_gain")
    assert [a.get_ylabel() for a in figure.axes] == ["horizontal (deg)", "horizontal rate (deg)"]
    for axes in figure.axes:
        line, _, (bars,) = axes.containers[0].lines
        np.testing.assert_allclose(line.get_xdata(), NM)
        np.testing.assert_allclose(line.get_ydata(), [1, 2, 3])
        lengths = [np.ptp(s[:, 1]) / 2 for s in bars.get_segments()]
        np.testing.assert_allclose(lengths, [0.01, 0.02, 0.03])


def test_the_line_is_where_the_effect_is_absent():
    for name, neutral, factor, unit, line in (
        ("gap_one.horizontal", None, 1.0, "deg", 0.0),
        # a share that is retained is one where there is no effect, and drawn in percent
        ("gap_one.retained_q", None, 1.0, "", 100.0),
        # an angle that the model held, in degrees though canonical inside
        ("k.theta", np.pi / 2, np.pi / 180, "deg", 90.0),
        # a catalogue's polarization, one a wavelength
        ("star.q", [0.01, 0.02, 0.03], 1.0, "", [1, 2, 3]),
    ):
        parameter = EffectParameter(name, 1, 1, neutral=neutral)
        sizes = {name: size([1.0, 1.0, 1.1], [0.01] * 3, unit)}
        found = sized(sizes, [parameter], factor)
        (axes,) = plot_effect_sizes(found, "beam_gain").axes
        np.testing.assert_allclose(axes.lines[0].get_ydata(), line)


def test_wavelengths_without_a_size_are_crosses_at_the_foot():
    sizes = {"gap_one.horizontal": size([1.0, 2.0, 3.0], [0.01, 0.2, None])}
    found = sized(sizes, [EffectParameter("gap_one.horizontal", 1, 1)])
    (axes,) = plot_effect_sizes(found, "beam_gain").axes
    (crosses,) = [line for line in axes.lines if line.get_marker() == "x"]
    np.testing.assert_allclose(crosses.get_xdata(), NM[1:])
    # in shares of the height of the panel
    assert crosses.get_transform() == axes.get_xaxis_transform()
    assert axes.get_title(loc="left") == "crosses: not determined"


def test_what_has_no_size_is_refused():
    found = sized({}, [])
    for name, words in (
        ("other", "cause = .other.; allowed are beam_gain"),
        ("beam_gain", "anything"),
    ):
        with pytest.raises(ParameterError, match=words):
            plot_effect_sizes(found, name)


def test_a_cell_is_drawn_over_what_it_depends_on():
    """The curve is that of the model, in degrees, with its error about it."""
    chain = instruments.get("charis").chain(derotator="linear", wavelength=[1.2, 1.6, 2.2] * u.um)
    frames = half_wave_plate_cycles(derotator=[45, 70, 95] * u.deg)
    model = nominal_model([chain], [simulate(chain, NM * u.nm, frames, seed=1)])
    for dependence, label in (
        ("time", "share of the run"),
        ("harmonic:derotator:2", "angle of the derotator (deg)"),
        ("direction:hwp", "last move of the half-wave plate"),
    ):
        cell = Cell("in:derotator", "retardance_h", dependence)
        own = cause(cell)
        own.effect = CellEffect(cell, 0)
        improved = model.with_effect(own.effect)
        entry = {"size": Fitted(improved).sizes(own.name), "cell": cell.to_dict()}
        found = SimpleNamespace(nominal=model, improved=improved, causes=[own])
        found.content = {"causes": [entry]}
        (axes,) = plot_effect_sizes(found, own.name).axes
        assert axes.get_xlabel() == label
        assert "deg" in axes.get_ylabel()
        value = next(iter(entry["size"].values()))["value"][0]
        if dependence == "time":
            curve = next(line for line in axes.lines if len(line.get_xdata()) == 400)
            np.testing.assert_allclose(curve.get_ydata()[[0, -1]], [-value, value], rtol=1e-6)


# ---- axes of the other figures -------------------------------------------------------------


def test_frames_are_named_by_their_derotator_angle():
    for derotator, label, ticks in [
        (np.repeat([45.0, 70.125, 95.0], 4), "frames by derotator angle (deg)", 3),
        (np.repeat(np.arange(25) * 7.0, 2), "frames by derotator angle (deg)", 9),
        # an angle of its own in each frame
        (np.arange(12) * 3.0, "frame", None),
        (None, "frame", None),
    ]:
        n = 12 if derotator is None else len(derotator)
        known = [] if derotator is None else ["derotator"]
        observations = SimpleNamespace(
            n_frames=n,
            frame_columns=known,
            position=lambda name, angle=derotator: np.deg2rad(angle),
        )
        axes = Figure().subplots()
        figures._frame_axis(axes, observations)
        assert axes.get_xlabel() == label, (derotator, label, ticks)
        if ticks:
            assert len(axes.get_xticks()) == ticks, (derotator, label, ticks)
            assert axes.get_xticklabels()[0].get_text() == f"{derotator[0]:.4g}", derotator
            # one line between two angles
            assert len(axes.lines) == len(set(derotator)) - 1, (derotator, label, ticks)
        else:
            assert not axes.lines, (derotator, label, ticks)
