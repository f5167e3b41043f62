# Licensed under a 3-clause BSD style license - see LICENSE
"""Accuracies of a calibration, for targets, and of a standard star."""

from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest

import astropolcal
from astropolcal import Observations, calibrate, instruments
from astropolcal.calibration import target_accuracies
from astropolcal.calibration.validation import paper_accuracies
from astropolcal.chain import join, leaves
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.plotting import plot_accuracy, plot_star_check, plot_target_accuracy


def lines(axes):
    return {line.get_label().split(" ")[0].rstrip(":"): line for line in axes.lines}


def test_curves_are_the_accuracy_table_with_units(elliptical):
    (axes,) = plot_accuracy(elliptical).axes
    drawn = lines(axes)
    assert list(drawn) == ["s_res", "s_mean", "s_cv"]
    for name, line in drawn.items():
        np.testing.assert_allclose(line.get_ydata(), elliptical.accuracy[name].value)
        np.testing.assert_allclose(line.get_xdata(), [1200, 1400, 1600, 1900, 2200])
    assert len({line.get_marker() for line in drawn.values()}) == 3
    assert len({line.get_color() for line in drawn.values()}) == 3
    assert axes.get_xlabel() == "wavelength (nm)"
    assert axes.get_ylabel() == "accuracy (% of polarization)"
    assert "n = 20" in axes.get_title()
    assert "k = 6" in axes.get_title()
    # calibration without data will do
    assert len(plot_accuracy(replace(elliptical, measurement=None)).axes) == 1


def test_legend_defines_every_curve_outside_the_axes(elliptical, single_angle):
    figure = plot_accuracy(elliptical)
    figure.draw_without_rendering()
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(texts) == 3
    assert "√(Σr²/(n" in texts[0]
    assert "s_res/√n" in texts[1]
    assert "left out of the fit" in texts[2]
    box = figure.legends[0].get_window_extent()
    assert not any(box.overlaps(axes.get_window_extent()) for axes in figure.axes)
    figure = plot_accuracy(single_angle)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[2].startswith("s_cv: not known")
    cycles = replace(elliptical, fit=elliptical.fit | {"groups": "cycle"})
    texts = [text.get_text() for text in plot_accuracy(cycles).legends[0].get_texts()]
    assert "half-wave-plate cycles left out" in texts[2]


def test_one_panel_a_dataset(several):
    figure = plot_accuracy(several)
    # counts below the name, which may be long
    titles = [axes.get_title().split("\n")[0] for axes in figure.axes]
    assert titles == ["polarized", "unpolarized"]
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()


def test_fit_that_did_not_converge_is_marked(elliptical):
    failed = replace(elliptical, fit=elliptical.fit | {"converged": False})
    assert "NOT CONVERGED" in plot_accuracy(failed).get_suptitle()
    assert "NOT CONVERGED" not in plot_accuracy(elliptical).get_suptitle()


def _standard(name, source, factor=3.0, wavelength=(1200.0, 1600.0, 2200.0)):
    """What a calibration remembers of a standard, see add_standard."""
    n = len(wavelength)
    return {
        "name": name,
        "source": source,
        "content_hash": name,
        "wavelength_nm": list(wavelength),
        "n": [12] * n,
        "s_standard_percent": [0.1 * factor] * n,
        "s_cv_percent": [0.1] * n,
    }


def test_standards_are_drawn_into_the_panel_of_their_source(several):
    sources = [record.source for record in several.datasets]
    entries = [_standard("july", sources[0]), _standard("august", sources[0], 5.0, (1600.0,))]
    with_standards = replace(several, fit=several.fit | {"standards": entries})
    figure = plot_accuracy(with_standards)
    assert len(figure.axes) == 2
    drawn = [line for line in figure.axes[0].lines if "s_standard" in line.get_label()]
    assert [line.get_label().split("predicting ")[1].split(",")[0] for line in drawn] == [
        "july",
        "august",
    ]
    np.testing.assert_allclose(drawn[0].get_ydata(), 0.3)
    np.testing.assert_allclose(drawn[1].get_xdata(), [1600])
    assert drawn[0].get_marker() != drawn[1].get_marker()
    assert drawn[0].get_linestyle() != drawn[1].get_linestyle()
    low, high = figure.axes[0].get_ylim()
    assert low < 0.3 < 0.5 < high
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(texts) == 5
    assert "not fitted" in texts[-1]


def test_standard_of_another_source_has_its_own_panel(elliptical):
    star = _standard("star", "unpolarized standard star")
    figure = plot_accuracy(replace(elliptical, fit=elliptical.fit | {"standards": [star]}))
    first, second = figure.axes
    assert list(lines(first)) == ["s_res", "s_mean", "s_cv"]
    assert "star\nn = 12 data per wavelength, predicted" in second.get_title()
    drawn = {line.get_label().split(" ")[0].rstrip(":"): line for line in second.lines}
    assert list(drawn) == ["s_standard", "s_cv"]
    np.testing.assert_allclose(drawn["s_cv"].get_ydata(), 0.1)


def test_datasets_of_one_wavelength_share_a_panel(several):
    single = [
        replace(one, accuracy=one.accuracy[i : i + 1]) for i, one in enumerate(several.datasets)
    ]
    (axes,) = plot_accuracy(replace(several, datasets=single)).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == [
        "polarized\n1200 nm",
        "unpolarized\n1400 nm",
    ]
    expected = [one.accuracy["s_res"].to_value(u.percent)[0] for one in single]
    np.testing.assert_allclose(lines(axes)["s_res"].get_ydata(), expected)


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


def test_what_no_data_determine_is_said_in_the_panel(undetermined):
    # a lamp alone leaves the angles open
    figure = plot_target_accuracy(undetermined)
    *known, angle = figure.axes
    # the degree is drawn, so that each target has its entry
    assert sum(text.startswith("target of") for text in legend(figure)) == len(known[1].lines) == 3
    assert not any(axes.texts for axes in known)
    assert [text.get_text()[:5] for text in angle.texts] == ["open:"]
    assert not len(angle.get_yticks())
    # with its telescope the packaged run leaves both open
    seen = Observations.read(Path(astropolcal.__file__).parent / "data" / "charis_example.ecsv")
    chain = instruments.get("charis").chain(wavelength=seen.wavelength)
    nothing = plot_target_accuracy(
        calibrate(chain, seen, cross_validate=False, instrument="charis")
    )
    assert not any(text.startswith("target of") for text in legend(nothing))


def test_impossible_and_unknown_targets_are_refused(several):
    with pytest.raises(ParameterError):
        plot_target_accuracy(several, [(1.5, None)])
    records = [replace(record, source="a lamp") for record in several.datasets]
    chains = [chain.copy() for chain in several.chains]
    unknown = replace(several, datasets=records, chains=[chains[1], chains[1]])
    # without the residuals of a known kind there is nothing to compare with
    assert not plot_target_accuracy(unknown).axes[0].lines
    still = [join(leaf for leaf in leaves(chain) if leaf.stage is None) for chain in chains]
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


def test_star_and_catalogue_are_drawn_with_their_errors(elliptical, entry):
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
    # catalogue is a line with its band
    line = curves(top)["catalogue, with the published errors"]
    assert line.get_ydata().tolist() == [3.1, 2.1, 1.1]
    (band,) = [c for c in top.collections if c.get_alpha() == 0.2]
    edges = band.get_paths()[0].vertices[:, 1]
    assert edges.max() == pytest.approx(3.12)
    assert edges.min() == pytest.approx(1.07)
    # dashes are the errors of single cycles
    dashed = [line for line in figure.axes[2].lines if line.get_linestyle() == "--"]
    np.testing.assert_allclose([line.get_ydata() for line in dashed],
                               [[0.6, 0.5, 0.7], [-0.6, -0.5, -0.7]])  # fmt: skip
    assert not [line for line in figure.axes[3].lines if line.get_linestyle() == "--"]


def test_a_star_at_one_wavelength_has_its_catalogue(elliptical, entry):
    one = {key: x[:1] if isinstance(x, list) else x for key, x in entry.items()}
    top, _, bottom, _ = plot_star_check(elliptical, checked(one)).axes
    known = curves(top)["catalogue, with the published errors"]
    assert known.get_ydata().tolist() == [2.1, 2.1]
    dashed = [line for line in bottom.lines if line.get_linestyle() == "--"]
    assert all(np.ptp(line.get_xdata()) > 0 for line in (known, *dashed))
    (band,) = [c for c in top.collections if c.get_alpha() == 0.2]
    assert (np.ptp(band.get_paths()[0].vertices, axis=0) > 0).all()


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
