# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of effects, of the gap and of its places, from hand-made numbers."""

from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import QTable
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from astropolcal.exceptions import ParameterError
from astropolcal.gap.effects import EffectParameter
from astropolcal.gap.residuals import Where
from astropolcal.plotting import effects, gap
from astropolcal.plotting._style import BLUE, ORANGE, SKY, VERMILION
from astropolcal.plotting.effects import plot_effect_scores, plot_effect_sizes
from astropolcal.plotting.gap import plot_where

NM = np.array([1200.0, 1600.0, 2200.0])


def score(name, statistic, p_value, scale=1.0):
    return SimpleNamespace(
        effect=SimpleNamespace(name=name), statistic=statistic, scale=scale, p_value=p_value
    )


def cause(name, aliases=(), explained=0.9):
    return SimpleNamespace(name=name, aliases=list(aliases), explained=explained)


def diagnosis(scores=(), causes=(), verdict="effect", **settings):
    return SimpleNamespace(
        scores=list(scores), causes=list(causes), verdict=verdict, settings=settings
    )


# ---- the scan ------------------------------------------------------------------------------


@pytest.fixture
def scanned():
    scores = [
        score("found", 900.0, 0.0),
        score("alias", 1600.0, 1e-20, scale=4.0),
        score("strong", 100.0, 1e-6),
        score("weak", 4.0, 0.4),
    ]
    return diagnosis(scores, [cause("found", ["alias"])])


def test_bars_are_signal_to_noise_ratios_in_their_order(scanned):
    (axes,) = plot_effect_scores(scanned).axes
    assert [bar.get_width() for bar in axes.patches] == [30.0, 20.0, 10.0, 2.0]
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == ["found", "alias", "strong", "weak"]
    # the best one is at the top
    low, high = axes.get_ylim()
    assert low > high
    assert axes.get_xlim() == (0, pytest.approx(1.18 * 30))


def test_bars_tell_their_kind_by_more_than_colour(scanned):
    figure = plot_effect_scores(scanned)
    bars = figure.axes[0].patches
    assert [bar.get_facecolor() for bar in bars] == [
        to_rgba(color) for color in (VERMILION, ORANGE, SKY, "0.85")
    ]
    assert [bool(bar.get_hatch()) for bar in bars] == [False, True, False, False]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["found", "alias: the data cannot tell", "significant", "not significant"]


def test_probabilities_stand_at_the_bars(scanned):
    (axes,) = plot_effect_scores(scanned).axes
    texts = [text.get_text().strip() for text in axes.texts]
    assert texts == ["p < 1e-15", "p < 1e-15", "p = 1e-06", "p = 0.4"]
    places = [text.get_position() for text in axes.texts]
    assert places == [(30.0, 0), (20.0, 1), (10.0, 2), (2.0, 3)]


def test_no_more_than_the_best_are_drawn(scanned):
    (axes,) = plot_effect_scores(scanned, limit=2).axes
    assert len(axes.patches) == 2


def test_significance_is_that_of_the_diagnosis(scanned):
    scanned.settings["alpha"] = 0.5
    labels = [t.get_text() for t in plot_effect_scores(scanned).legends[0].get_texts()]
    assert "not significant" not in labels


def test_nothing_to_score():
    (axes,) = plot_effect_scores(diagnosis(verdict="none")).axes
    assert [text.get_text() for text in axes.texts] == ["no effect to score"]


@pytest.mark.parametrize(
    ("verdict", "causes", "line"),
    [
        ("effect", [cause("a")], "1 effect is missing: a"),
        ("effect", [cause("a", explained=0.1), cause("b")], "2 effects are missing: b and a"),
        ("none", [], "no gap beyond the noise"),
        ("unexplained", [], "a real gap that no effect explains"),
        ("unexplained", [cause("a")], "a real gap that no effect explains\n(in part: a)"),
    ],
)
def test_verdict_as_a_title(verdict, causes, line):
    assert effects.verdict_line(diagnosis(causes=causes, verdict=verdict)) == line


# ---- sizes ---------------------------------------------------------------------------------


def sized(sizes, parameters, factor=1.0):
    """A diagnosis with one cause of these sizes, and the content of its report."""
    problem = SimpleNamespace(
        wavelength=NM / 1000,
        free=SimpleNamespace(by_name={name: SimpleNamespace(factor=factor) for name in sizes}),
    )
    model = SimpleNamespace(problem=problem, added={"one": parameters}, chains=[])
    found = diagnosis(causes=[cause("one")])
    found.nominal = found.improved = model
    return found, {"causes": [{"parameters": sizes}]}


def size(value, std, unit="", limit=1.0):
    return {"value": list(value), "std": list(std), "unit": unit, "limit": limit}


@pytest.fixture
def four():
    names = ["gap_one.horizontal", "gap_one.diagonal", "gap_one.horizontal_rate"]
    sizes = {name: size([1.0, 2.0, 3.0], [0.01, 0.02, 0.03], "deg") for name in names}
    sizes["gap_one.common"] = {"value": 1.0, "std": 0.1, "unit": "", "limit": 1.0}
    return sized(sizes, [EffectParameter(name, 1, 1) for name in sizes])


def test_a_panel_for_each_size_that_depends_on_the_wavelength(four):
    found, content = four
    figure = plot_effect_sizes(found, "one", content=content)
    drawn = [axes for axes in figure.axes if axes.axison]
    assert [axes.get_ylabel() for axes in drawn] == [
        "horizontal (deg)",
        "diagonal (deg)",
        "horizontal rate (deg)",
    ]
    assert all(axes.get_xlabel() == "wavelength (nm)" for axes in drawn)
    for axes in drawn:
        line, _, (bars,) = axes.containers[0].lines
        np.testing.assert_allclose(line.get_xdata(), NM)
        np.testing.assert_allclose(line.get_ydata(), [1, 2, 3])
        lengths = [np.ptp(s[:, 1]) / 2 for s in bars.get_segments()]
        np.testing.assert_allclose(lengths, [0.01, 0.02, 0.03])


@pytest.mark.parametrize(
    ("name", "neutral", "factor", "line"),
    [
        ("gap_one.horizontal", None, 1.0, 0.0),
        # a share that is retained is one where there is no effect
        ("gap_one.retained_q", None, 1.0, 1.0),
        # an angle that the model held, in degrees though canonical inside
        ("k.theta", np.pi / 2, np.pi / 180, 90.0),
        # a catalogue's polarization, one a wavelength
        ("star.q", [0.01, 0.02, 0.03], 1.0, [0.01, 0.02, 0.03]),
    ],
)
def test_the_line_is_where_the_effect_is_absent(name, neutral, factor, line):
    parameter = EffectParameter(name, 1, 1, neutral=neutral)
    found, content = sized({name: size([1.0] * 3, [0.01] * 3)}, [parameter], factor)
    (axes,) = plot_effect_sizes(found, "one", content=content).axes
    np.testing.assert_allclose(axes.lines[0].get_ydata(), line)


def test_wavelengths_without_a_size_are_crosses_at_the_foot():
    sizes = {"gap_one.horizontal": size([1.0, 2.0, 3.0], [0.01, 0.2, None])}
    found, content = sized(sizes, [EffectParameter("gap_one.horizontal", 1, 1)])
    (axes,) = plot_effect_sizes(found, "one", content=content).axes
    (crosses,) = [line for line in axes.lines if line.get_marker() == "x"]
    np.testing.assert_allclose(crosses.get_xdata(), NM[1:])
    np.testing.assert_allclose(crosses.get_ydata(), 0.05)
    # in shares of the height of the panel
    assert crosses.get_transform() == axes.get_xaxis_transform()
    assert axes.get_title(loc="left") == "crosses: not determined"
    sizes["gap_one.horizontal"]["std"] = [None] * 3
    (axes,) = plot_effect_sizes(found, "one", content=content).axes
    assert len(axes.get_yticks()) == 0


def test_what_has_no_size_is_refused(four):
    found, content = four
    with pytest.raises(ParameterError, match="'other' is no cause; these are: one"):
        plot_effect_sizes(found, "other", content=content)
    content["causes"][0]["parameters"] = {}
    with pytest.raises(ParameterError, match="'one' has no size that depends on wavelength"):
        plot_effect_sizes(found, "one", content=content)


# ---- where ---------------------------------------------------------------------------------


def where(*rows):
    names = ("axis", "detail", "kind", "share", "p_single", "p_value")
    table = QTable({name: [row[i] for row in rows] for i, name in enumerate(names)})
    return Where(table, 100.0, 500)


def test_patterns_and_places_have_panels_of_their_own():
    found = where(
        ("hwp", "harmonic 4 " * 12, "pattern", 0.6, 0.0, 1e-9),
        ("time", "a trend", "pattern", 0.005, 0.0, 1e-9),
        ("beam", "the sums", "place", 0.97, 0.0, 1e-9),
        ("dataset", "lamp", "place", 0.3, 0.5, 0.5),
    )
    top, bottom = plot_where(found).axes
    # what is minute or not significant is left out
    assert [bar.get_width() for bar in top.patches] == pytest.approx([60])
    assert [bar.get_width() for bar in bottom.patches] == pytest.approx([97])
    assert [bar.get_facecolor() for bar in (*top.patches, *bottom.patches)] == [
        to_rgba(BLUE),
        to_rgba(ORANGE),
    ]
    assert "shares add up" in top.get_title(loc="left")
    assert "do not add up" in bottom.get_title(loc="left")
    (label,) = top.get_yticklabels()
    assert max(map(len, label.get_text().splitlines())) <= 56
    # a number that would leave the panel stands inside its bar
    assert top.texts[0].get_ha() == "left"
    assert bottom.texts[0].get_ha() == "right"


def test_no_more_places_than_asked_for():
    found = where(*(("x", f"at {i}", "place", 0.5 - 0.01 * i, 0.0, 1e-9) for i in range(20)))
    assert len(plot_where(found).axes[1].patches) == 12
    assert len(plot_where(found, limit=3).axes[1].patches) == 3
    assert [t.get_text() for t in plot_where(found).axes[0].texts] == ["nothing beyond the noise"]


# ---- axes of the other figures -------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "scale", "limits"),
    [
        ([1.0, 4.0], "linear", (0, 4.6)),
        ([1.0, 6.0], "log", (1 / 1.6, 9.6)),
        # a wavelength that is masked wholly does not count
        ([1.0, np.nan, 4.0], "linear", (0, 4.6)),
        ([0.0, 1.0, 40.0], "log", (1 / 1.6, 64)),
    ],
)
def test_axis_of_percent(values, scale, limits):
    axes = Figure().subplots()
    gap._percent_axis(axes, np.array(values))
    assert axes.get_yscale() == scale
    assert axes.get_ylim() == pytest.approx(limits)


def test_plain_numbers_on_a_logarithmic_axis():
    text = gap._plain((1, 2, 5))
    assert [text(value, 0) for value in (0.02, 0.1, 5.0, 30.0)] == ["0.02", "0.1", "5", ""]


@pytest.mark.parametrize(
    ("derotator", "label", "ticks"),
    [
        (np.repeat([45.0, 70.125, 95.0], 4), "frames by derotator angle (deg)", 3),
        (np.repeat(np.arange(25) * 7.0, 2), "frames by derotator angle (deg)", 9),
        # an angle of its own in each frame
        (np.arange(12) * 3.0, "frame", None),
        (None, "frame", None),
    ],
)
def test_frames_are_named_by_their_derotator_angle(derotator, label, ticks):
    n = 12 if derotator is None else len(derotator)
    known = [] if derotator is None else ["derotator"]
    observations = SimpleNamespace(
        n_frames=n,
        frames=SimpleNamespace(colnames=known),
        position=lambda name: np.deg2rad(derotator),
    )
    axes = Figure().subplots()
    gap._frame_axis(axes, observations)
    assert axes.get_xlabel() == label
    if ticks:
        assert len(axes.get_xticks()) == ticks
        assert axes.get_xticklabels()[0].get_text() == f"{derotator[0]:.4g}"
        # one line between two angles
        assert len(axes.lines) == len(set(derotator)) - 1
    else:
        assert not axes.lines


def test_unknown_channels_are_refused():
    assert [gap._name(name) for name in ("difference", "sum")] == [0, 1]
    with pytest.raises(ParameterError, match="channel = 'ratio'; allowed are difference, sum"):
        gap._name("ratio")
