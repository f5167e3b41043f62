# Licensed under a 3-clause BSD style license - see LICENSE
"""What the data determine, and how parameters are correlated."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal import Calibration
from astropolcal.calibration.identifiability.analysis import Identifiability, harmonic_conditions
from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.calibration.uncertainty.refits import Resampled
from astropolcal.exceptions import ParameterError
from astropolcal.plotting import plot_correlations, plot_identifiability

FULL = np.arange(32) * 11.25 * u.deg


def panel(figure, letter):
    (axes,) = [a for a in figure.axes if letter in a.get_title() + a.get_title(loc="left")]
    return axes


def points(axes):
    return {line.get_label().split(":")[0]: line for line in axes.lines}


def cells(axes):
    """Numbers in the heat map, by row and column label."""
    rows = [text.get_text() for text in axes.get_yticklabels()]
    columns = [text.get_text() for text in axes.get_xticklabels()]
    return {
        (rows[round(text.get_position()[1])], columns[round(text.get_position()[0])]): float(
            text.get_text().replace("\N{MINUS SIGN}", "-")
        )
        for text in axes.texts
    }


def all_words(figure):
    return "\n".join(text.get_text() for axes in figure.axes for text in axes.texts)


# ---- singular values --------------------------------------------------------------------


def test_singular_values_are_drawn_and_open_ones_counted(undetermined):
    finding = undetermined.identifiability
    n_open = finding.n_free - finding.rank
    assert n_open > 0
    axes = panel(plot_identifiability(undetermined), "(a)")
    drawn = points(axes)
    assert axes.get_yscale() == "log"
    shown = np.concatenate([drawn["determined"].get_ydata(), drawn["shown in (b)"].get_ydata()])
    np.testing.assert_allclose(np.sort(shown)[::-1], finding.singular_values[: finding.rank])
    (label,) = (label for label in drawn if label.startswith(f"{n_open} open"))
    open_ones = drawn[label]
    assert len(open_ones.get_xdata()) == n_open
    limit = drawn["limit of the rank"].get_ydata()[0]
    assert finding.singular_values[finding.rank] <= limit
    assert limit < finding.singular_values[finding.rank - 1]
    assert (np.array(open_ones.get_ydata()) < limit).all()
    # they belong below, so they stand on the edge and not at a value
    assert (np.array(open_ones.get_ydata()) == axes.get_ylim()[0]).all()
    assert not open_ones.get_clip_on()
    full = [text.get_text() for text in axes.get_legend().get_texts()]
    assert any(text.endswith("(below the axis)") for text in full)
    assert f"{finding.rank} of {finding.n_free}" in axes.get_title()
    assert f"{n_open} open" in axes.get_title()


def test_full_rank_has_no_limit_and_says_so(elliptical):
    axes = panel(plot_identifiability(elliptical), "(a)")
    assert "none open" in axes.get_title()
    assert "limit of the rank" not in points(axes)
    low, high = axes.get_ylim()
    values = elliptical.identifiability.singular_values
    assert low < values.min() < values.max() < high


def test_error_axis_is_noise_over_singular_value(elliptical):
    """The weakest direction has the largest error of the covariance, in steps."""
    axes = panel(plot_identifiability(elliptical), "(a)")
    (right,) = axes.child_axes
    assert "standard error" in right.get_ylabel()
    covariance = elliptical.covariance
    steps = np.array([1e-2 if unit is None else 1 if unit == u.deg else 1e-3
                      for unit in covariance.units])  # fmt: skip
    # along the weakest direction: the square root of the largest eigenvalue
    largest = np.sqrt(np.linalg.eigvalsh(covariance.matrix / steps / steps[:, None])[-1])
    convert = right._functions[0]
    found = convert(elliptical.identifiability.singular_values.min())
    assert found == pytest.approx(largest, rel=1e-3)


# ---- loadings ---------------------------------------------------------------------------


def test_loadings_are_those_of_the_words(undetermined):
    figure = plot_identifiability(undetermined, weakest=2)
    finding = undetermined.identifiability
    axes = panel(figure, "(b)")
    rows = [text.get_text() for text in axes.get_yticklabels()]
    n_open = finding.n_free - finding.rank
    assert rows == [f"open {i + 1}" for i in range(n_open)] + ["largest error 1", "largest error 2"]
    table = np.abs(np.asarray(axes.images[0].get_array()))
    # each direction has length 1
    np.testing.assert_allclose(np.sum(table**2, axis=1), 1, rtol=1e-9)
    text = " ".join(all_words(figure).split())
    for i, direction in enumerate(finding.directions):
        assert " ".join(direction["words"].split()) in text
        moved = direction["parameters"]
        found = {column: v for (row, column), v in cells(axes).items() if row == f"open {i + 1}"}
        single = {name: v for name, v in moved.items() if np.ndim(v) == 0 and name in found}
        lead = direction["words"].split(" ")[0]
        for name, value in single.items():
            assert found[name] / found[lead] == pytest.approx(value / moved[lead], abs=0.3)


def test_columns_are_parameters_with_those_per_wavelength_in_one(elliptical):
    axes = panel(plot_identifiability(elliptical), "(b)")
    columns = [text.get_text() for text in axes.get_xticklabels()]
    assert columns == [
        "hwp.w_sio2",
        "hwp.w_mgf2",
        "derotator.horizontal (5)",
        "derotator.diagonal (5)",
        "derotator.circular (5)",
        "wollaston.efficiency (5)",
    ]


def test_weak_directions_are_the_largest_errors(elliptical):
    figure = plot_identifiability(elliptical, weakest=1)
    covariance = elliptical.covariance
    # thickness in um, the others in degree and percent
    steps = np.array([1e-2 if unit is None else 1 if unit == u.deg else 1e-3
                      for unit in covariance.units])  # fmt: skip
    _, vectors = np.linalg.eigh(covariance.matrix / steps / steps[:, None])
    table = np.asarray(panel(figure, "(b)").images[0].get_array())
    assert table.shape == (1, 6)
    stems = [name.split("[")[0] for name in covariance.names]
    expected = [
        np.linalg.norm(vectors[:, -1][[s == stem for s in stems]]) for stem in dict.fromkeys(stems)
    ]
    np.testing.assert_allclose(np.abs(table[0]), expected, atol=1e-6)
    assert "largest error 1: 1\N{GREEK SMALL LETTER SIGMA} changes" in all_words(figure)


def test_near_null_directions_keep_their_own_words(elliptical):
    covariance = elliptical.covariance
    axes = covariance._axes()
    weakest = axes.known[np.argmax(axes.sigmas)] * axes.sigmas.max()
    moved = {}
    for name, value, unit in zip(covariance.names, weakest, covariance.units, strict=True):
        stem = name.split("[")[0]
        value = value * (0.01 if unit is None else 1)
        moved[stem] = [*moved.get(stem, []), float(value)]
    moved = {stem: v[0] if len(v) == 1 else v for stem, v in moved.items()}
    finding = replace(elliptical.identifiability)
    finding.near_null = [{"words": "uncertain by 12 deg at the noise", "parameters": moved}]
    figure = plot_identifiability(replace(elliptical, identifiability=finding), weakest=2)
    rows = [text.get_text() for text in panel(figure, "(b)").get_yticklabels()]
    assert rows == ["badly determined 1", "largest error 2"]
    assert "badly determined 1: uncertain by 12 deg at the noise" in all_words(figure)


def test_parameters_at_a_bound_have_no_part(at_bound):
    assert at_bound.at_bound
    figure = plot_identifiability(at_bound)
    assert len(figure.axes) >= 4
    table = np.asarray(panel(figure, "(b)").images[0].get_array())
    np.testing.assert_allclose(np.sum(table**2, axis=1), 1, rtol=1e-9)


# ---- half-wave-plate angles ------------------------------------------------------------


def test_conditions_are_those_of_the_harmonics(elliptical):
    axes = panel(plot_identifiability(elliptical), "(c)")
    angles = np.deg2rad(np.arange(8) * 11.25)
    expected = list(harmonic_conditions(angles).values())
    ends = [patch.get_x() + patch.get_width() for patch in axes.patches]
    np.testing.assert_allclose(ends, expected, rtol=1e-5)
    assert [text.get_text() for text in axes.get_yticklabels()] == [
        "harmonics 0, 4",
        "harmonics 0, 2, 4",
        "harmonics 0, 1, 2, 4",
    ]
    # poor ones are marked otherwise than by colour alone
    assert [bool(patch.get_hatch()) for patch in axes.patches] == [False, True, True]
    assert "8 angles" in axes.get_xlabel()


def test_angles_may_be_given(elliptical):
    axes = panel(plot_identifiability(elliptical, hwp=FULL), "(c)")
    assert not any(patch.get_hatch() for patch in axes.patches)
    few = panel(plot_identifiability(elliptical, hwp=[0, 45, 22.5, 67.5] * u.deg), "(c)")
    assert sum("too few angles" in text.get_text() for text in few.texts) == 2
    with pytest.raises(ParameterError, match="hwp"):
        plot_identifiability(elliptical, hwp=[1, 2] * u.um)


# ---- what is not known ------------------------------------------------------------------


@pytest.mark.slow
def test_calibration_from_a_file(tmp_path, elliptical):
    elliptical.write(tmp_path / "cal.asdf")
    read = Calibration.read(tmp_path / "cal.asdf")
    figure = plot_identifiability(read)
    live = plot_identifiability(elliptical)
    for letter in ("(a)", "(b)"):
        assert panel(figure, letter).get_title() == panel(live, letter).get_title()
    np.testing.assert_allclose(
        panel(figure, "(b)").images[0].get_array(), panel(live, "(b)").images[0].get_array()
    )
    # the angles are gone, their consequence is not
    said = " ".join(panel(figure, "(c)").texts[0].get_text().split())
    assert " ".join(read.identifiability.sampling[0].split()) in said
    # what star would help is not about these angles, and has no space there
    read.identifiability.sampling.append("m3.theta: a star")
    assert "m3" not in panel(plot_identifiability(read), "(c)").texts[0].get_text()
    assert panel(plot_identifiability(read, hwp=FULL), "(c)").patches


def test_identifiability_alone(undetermined, elliptical):
    figure = plot_identifiability(undetermined.identifiability)
    rows = [text.get_text() for text in panel(figure, "(b)").get_yticklabels()]
    assert all(row.startswith("open") for row in rows)
    assert not panel(figure, "(a)").child_axes
    # full rank without errors has nothing to load
    figure = plot_identifiability(elliptical.identifiability)
    (text,) = panel(figure, "(b)").texts
    assert text.get_text() == "no open direction; errors are not known"


def test_directions_without_words_are_drawn_as_they_are():
    null = np.array([[0.6, 0.8, 0.0]])
    finding = Identifiability(
        ["a.theta", "b.theta", "c.theta"], 2, np.array([1, 0.1, 0.0]), null, np.zeros(3, bool)
    )
    figure = plot_identifiability(finding)
    found = cells(panel(figure, "(b)"))
    assert found == {("open 1", "a.theta"): 0.6, ("open 1", "b.theta"): 0.8}
    assert "exactly zero" in panel(figure, "(a)").get_legend().get_texts()[1].get_text()
    assert panel(figure, "(c)").texts[0].get_text() == "half-wave-plate angles are not known"


def test_nothing_determined_at_all():
    finding = Identifiability(
        ["a.theta"], 0, np.zeros(1), np.ones((1, 1)), np.zeros(1, bool),
        directions=[{"words": "a.theta changes no datum", "parameters": {"a.theta": 1.0}}],
    )  # fmt: skip
    figure = plot_identifiability(finding)
    figure.draw_without_rendering()
    assert "0 of 1 combinations determined, 1 open" in panel(figure, "(a)").get_title()


def test_impossible_requests_are_refused(elliptical):
    with pytest.raises(ParameterError, match="weakest = -1"):
        plot_identifiability(elliptical, weakest=-1)
    nothing = Identifiability([], 0, np.zeros(0), np.zeros((0, 0)), np.zeros(0, bool))
    with pytest.raises(ParameterError, match="no free parameter"):
        plot_identifiability(nothing)


@pytest.mark.slow
def test_words_are_below_the_panels_and_inside_the_figure(undetermined):
    figure = plot_identifiability(undetermined)
    figure.draw_without_rendering()
    (text,) = [t for a in figure.axes for t in a.texts if t.get_text().startswith("open 1")]
    box, page = text.get_window_extent(), figure.bbox
    assert page.x0 <= box.x0 < box.x1 <= page.x1
    assert page.y0 <= box.y0
    # tick labels of the heat map end above the words
    heat = panel(figure, "(b)")
    assert min(t.get_window_extent().y0 for t in heat.get_xticklabels()) >= box.y1 - 1


def drawn(figure):
    """The matrix in the figure, NaN where nothing is drawn."""
    (mesh,) = figure.axes[0].collections
    array = np.ma.filled(mesh.get_array().astype(float), np.nan)
    return array.reshape(mesh.get_coordinates().shape[0] - 1, -1)


def test_matrix_is_that_of_the_calibration(elliptical):
    figure = Figure()
    assert plot_correlations(elliptical, figure=figure) is figure
    np.testing.assert_allclose(drawn(figure), elliptical.covariance.correlation)
    (mesh,) = figure.axes[0].collections
    assert mesh.get_clim() == (-1, 1)
    # the diagonal runs from the upper left
    assert figure.axes[0].yaxis_inverted()
    assert not figure.legends
    assert "Correlations" in figure.get_suptitle()
    # groups are named once
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert labels[0] == "hwp.w_sio2"
    assert "derotator.horizontal (5)" in labels
    assert len(labels) == len({name.split("[")[0] for name in elliptical.covariance.names})
    # common parameters are wider
    widths = np.diff(mesh.get_coordinates()[0, :, 0])
    assert widths[0] > 3 * widths[-1]
    # large matrices have no numbers
    assert len(elliptical.covariance) > 12
    assert not figure.axes[0].texts


def test_undetermined_parameters_are_listed_and_not_drawn(undetermined):
    figure = plot_correlations(undetermined)
    known = np.isfinite(undetermined.covariance.stds)
    assert 0 < known.sum() < known.size
    matrix = undetermined.covariance.correlation[np.ix_(known, known)]
    np.testing.assert_allclose(drawn(figure), matrix)
    listed = " ".join(figure.get_supxlabel().split())
    for name, is_known in zip(undetermined.covariance.names, known, strict=True):
        assert (name.partition("[")[0] in listed) or is_known, name


def test_no_parameter_with_an_error_is_said():
    nothing = Covariance(["hwp.theta"], [u.deg], [[np.nan]])
    assert "no parameter has an error" in all_words(plot_correlations(nothing))


def test_small_matrices_have_numbers():
    matrix = [[0.04, -0.001], [-0.001, 1e-4]]
    figure = plot_correlations(Covariance(["hwp.theta", "hwp.w_sio2"], [u.deg, u.mm], matrix))
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == ["1.00", "\N{MINUS SIGN}0.50", "\N{MINUS SIGN}0.50", "1.00"]


def test_resamples_are_drawn():
    samples = np.random.default_rng(0).normal(size=(50, 2))
    made = Resampled(["a.theta", "b.x"], [u.deg, None], samples, "pair", 8, 0)
    np.testing.assert_allclose(drawn(plot_correlations(made)), np.corrcoef(samples.T))


def test_nothing_to_draw_is_refused():
    with pytest.raises(ParameterError, match="no free parameter"):
        plot_correlations(Covariance([], [], np.zeros((0, 0))))
