# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of targets and of a star: the curves are the numbers, labels have units."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration import target_accuracies
from astropolcal.calibration.validation import paper_accuracies
from astropolcal.chain import join, leaves
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.plotting import plot_star_check, plot_target_accuracy

MINUS = "\N{MINUS SIGN}"


def curves(axes):
    return {line.get_label(): line for line in axes.lines}


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


# ---- targets -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def targets(several):
    records = [
        replace(record, source=source)
        for record, source in zip(several.datasets, ("polarized", "unpolarized"), strict=True)
    ]
    known = replace(several, datasets=records)
    return plot_target_accuracy(known), target_accuracies(known), paper_accuracies(known)[0]


def test_curves_of_targets_are_their_tables(targets):
    figure, tables, _ = targets
    for axes, key, unit in zip(figure.axes[1:], ("s_p", "s_chi"), ("%", "deg"), strict=True):
        assert len(axes.lines) == len(tables)
        for line, table in zip(axes.lines, tables, strict=True):
            lam = table["wavelength"].to_value(u.nm)
            np.testing.assert_allclose(line.get_xdata(), np.sort(lam))
            expected = table[key].to_value(unit)[np.argsort(lam)]
            np.testing.assert_allclose(line.get_ydata(), expected)


def test_parts_are_named_and_unknown_ones_said(targets):
    figure, _, parts = targets
    found = curves(figure.axes[0])
    assert "s_sky: not known, no such dataset" in found
    assert parts.meta["missing"] == ["on_sky"]
    line = found["s_unpol, of the unpolarized source"]
    assert np.all(line.get_ydata() > 0)
    np.testing.assert_allclose(line.get_ydata(), parts["s_unpol"].to_value(u.percent))
    # without stars the absolute accuracy is that of the unpolarized source
    total = found["s_abs = √(s_unpol² + s_sky²): scales with the intensity"]
    np.testing.assert_allclose(total.get_ydata(), line.get_ydata())
    assert legend(figure)[:4] == list(found)
    # what is not drawn has no marker in the legend
    assert found["s_sky: not known, no such dataset"].get_marker() == "none"
    # of targets whose curves coincide the one below is the larger
    one, *_, two = figure.axes[2].lines
    assert one.get_markersize() > two.get_markersize()
    assert one.get_linewidth() > two.get_linewidth()


def test_labels_of_targets(targets):
    figure, _, _ = targets
    assert [axes.get_ylabel() for axes in figure.axes] == ["accuracy (%)", "s_p (%)", "s_chi (°)"]
    assert figure.axes[-1].get_xlabel() == "wavelength (nm)"
    assert "target of 1 % at its worst angle" in legend(figure)
    assert "target of 30 % at its worst angle" in legend(figure)


def test_a_target_at_an_angle(several):
    figure = plot_target_accuracy(several, [(0.05, 30 * u.deg)])
    assert legend(figure)[-1] == "target of 5 % at 30°"
    (table,) = target_accuracies(several, [(0.05, 30 * u.deg)])
    (line,) = figure.axes[1].lines
    np.testing.assert_allclose(line.get_ydata(), table["s_p"].to_value("%"))
    # looks of targets and parts do not coincide, for they share the legend
    looks = {(one.get_color(), one.get_marker()) for one in figure.axes[0].lines}
    assert (line.get_color(), line.get_marker()) not in looks


def test_impossible_and_unknown_targets_are_refused(several):
    with pytest.raises(ParameterError):
        plot_target_accuracy(several, [(1.5, None)])
    records = [replace(record, source="a lamp") for record in several.datasets]
    chains = [chain.copy() for chain in several.chains]
    unknown = replace(several, datasets=records, chains=[chains[1], chains[1]])
    # without the residuals of a known kind there is nothing to compare with
    assert not plot_target_accuracy(unknown).axes[0].lines
    still = [join(leaf for leaf in leaves(chain) if leaf.name != "hwp") for chain in chains]
    with pytest.raises(ObservationError, match="no half-wave plate"):
        plot_target_accuracy(replace(several, chains=still))


# ---- a star --------------------------------------------------------------------------------


@pytest.fixture
def entry():
    """What a check with a star leaves, with wavelengths in no order."""
    return {
        "star": "HD 1",
        "name": "night",
        "wavelength_nm": [1600.0, 1200.0, 2200.0],
        "dolp_percent": [2.0, 3.0, 1.0],
        "dolp_err_percent": [0.2, 0.3, None],
        "dolp_known_percent": [2.1, 3.1, 1.1],
        "dolp_known_err_percent": [0.01, 0.02, 0.03],
        "dolp_error_percent": [-0.1, -0.1, -0.1],
        "s_dolp_percent": [0.5, 0.6, 0.7],
        "aolp_deg": [30.0, 31.0, 29.0],
        "aolp_err_deg": [1.0, 2.0, 3.0],
        "aolp_known_deg": [30.5, 30.5, 30.5],
        "aolp_known_err_deg": [0.1, 0.1, 0.1],
        "aolp_error_deg": [-0.5, 0.5, -1.5],
    }


def points(axes):
    """Values, and half the lengths of the bars."""
    line, _, (bars,) = axes.containers[0].lines
    lengths = [np.ptp(segment[:, 1]) / 2 for segment in bars.get_segments()]
    return line.get_xdata(), line.get_ydata(), lengths


def checked(entry):
    for key, values in entry.items():
        if isinstance(values, list):
            entry[key] = [np.nan if value is None else value for value in values]
    return entry


def test_star_is_drawn_with_its_errors(elliptical, entry):
    figure = plot_star_check(elliptical, checked(entry))
    top, angle, bottom, off = figure.axes
    x, y, bars = points(top)
    assert x.tolist() == [1200, 1600, 2200]
    assert y.tolist() == [3, 2, 1]
    # an error that is not known is none
    np.testing.assert_allclose(bars, [0.3, 0.2, 0.0])
    np.testing.assert_allclose(points(angle)[1], [31, 30, 29])
    np.testing.assert_allclose(points(angle)[2], [2, 1, 3])
    np.testing.assert_allclose(points(bottom)[1], [-0.1, -0.1, -0.1])
    np.testing.assert_allclose(points(off)[1], [0.5, -0.5, -1.5])


def test_catalogue_is_a_line_with_its_band(elliptical, entry):
    top = plot_star_check(elliptical, checked(entry)).axes[0]
    line = curves(top)["catalogue, with the published errors"]
    assert line.get_ydata().tolist() == [3.1, 2.1, 1.1]
    (band,) = [c for c in top.collections if c.get_alpha() == 0.2]
    edges = band.get_paths()[0].vertices[:, 1]
    assert edges.max() == pytest.approx(3.12)
    assert edges.min() == pytest.approx(1.07)


def test_dashes_are_the_errors_of_single_cycles(elliptical, entry):
    figure = plot_star_check(elliptical, checked(entry))
    dashed = [line for line in figure.axes[2].lines if line.get_linestyle() == "--"]
    np.testing.assert_allclose([line.get_ydata() for line in dashed],
                               [[0.6, 0.5, 0.7], [-0.6, -0.5, -0.7]])  # fmt: skip
    assert not [line for line in figure.axes[3].lines if line.get_linestyle() == "--"]


def test_labels_of_a_star(elliptical, entry):
    figure = plot_star_check(elliptical, checked(entry))
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "DoLP (%)",
        "AoLP (°)",
        f"obs. {MINUS} catalogue\n(%)",
        f"obs. {MINUS} catalogue\n(°)",
    ]
    assert [axes.get_xlabel() for axes in figure.axes[2:]] == ["wavelength (nm)"] * 2
    assert figure.get_suptitle() == "HD 1, which no fit saw\nbench: night"
    assert sorted(legend(figure)) == [
        "catalogue, with the published errors",
        "observed, with 1\N{GREEK SMALL LETTER SIGMA} errors of the mean",
        "± rms error of a single cycle",
    ]


def test_a_star_without_a_catalogue_has_no_line(elliptical, entry):
    for key in ("dolp_known", "dolp_known_err"):
        entry[f"{key}_percent"] = [np.nan] * 3
    for key in ("aolp_known", "aolp_known_err"):
        entry[f"{key}_deg"] = [np.nan] * 3
    figure = plot_star_check(elliptical, checked(entry))
    assert not any("catalogue" in label for label in legend(figure))


def test_the_last_star_is_drawn_unless_told(elliptical, entry):
    fit = elliptical.fit | {"stars": [checked(entry), checked(entry) | {"star": "HD 2"}]}
    several = replace(elliptical, fit=fit)
    assert plot_star_check(several).get_suptitle().startswith("HD 2, ")
    with pytest.raises(ObservationError, match="was checked with no star"):
        plot_star_check(elliptical)
