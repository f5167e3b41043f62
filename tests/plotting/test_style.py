# Licensed under a 3-clause BSD style license - see LICENSE
"""What all figures have in common: colours, grids, headings, files."""

from types import SimpleNamespace

import astropy.units as u
import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from astropolcal.exceptions import AstropolcalError, ObservationError, ParameterError
from astropolcal.plotting import _style


def calibration(*names, converged=True, instrument="bench"):
    datasets = [SimpleNamespace(name=name) for name in names]
    return SimpleNamespace(datasets=datasets, converged=converged, instrument=instrument)


# ---- colours and markers -------------------------------------------------------------------


def lightness(color):
    """CIE lightness, which all kinds of colour vision share."""
    rgb = np.array(to_rgb(color))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    y = linear @ [0.2126, 0.7152, 0.0722]
    return 116 * np.cbrt(y) - 16 if y > 0.008856 else 903.3 * y


def test_looks_do_not_repeat_soon_and_differ_from_the_paper():
    pairs = _style.looks(72)
    assert len(set(pairs)) == 72
    assert _style.looks(73)[72] == pairs[0]
    assert _style.looks(0) == []
    assert len(set(_style.COLORS)) == len(_style.COLORS)
    # on white a line needs some darkness
    assert max(map(lightness, _style.COLORS)) < 75


def test_the_users_settings_come_back():
    before = dict(mpl.rcParams)
    with _style.canvas(None, 4, 3):
        assert mpl.rcParams["axes.grid"]
        assert dict(mpl.rcParams) != before
    assert dict(mpl.rcParams) == before


# ---- figures -------------------------------------------------------------------------------


def test_a_figure_keeps_legends_out_of_its_panels():
    own = Figure(figsize=(9, 9))
    with _style.canvas(None, 4, 3) as new, _style.canvas(own, 4, 3) as kept:
        assert new.get_size_inches().tolist() == [4, 3]
        assert kept is own
        assert own.get_size_inches().tolist() == [9, 9]
    for figure in (new, own):
        assert type(figure.get_layout_engine()).__name__ == "ConstrainedLayoutEngine"
    # a layout that was chosen is kept
    own = Figure(layout="tight")
    with _style.canvas(own, 1, 1) as kept:
        assert type(kept.get_layout_engine()).__name__ == "TightLayoutEngine"
    (part,) = np.ravel(Figure().subfigures(1, 1))
    with _style.canvas(part, 1, 1) as kept:
        assert kept is part


def test_headings():
    for of, names, title in [
        (calibration("a", "b"), None, "What\nbench: a, b"),
        (calibration("a", "b", "c"), None, "What\nbench: 3 datasets"),
        (calibration("a"), ["x"], "What\nbench: x"),
        (calibration("a", instrument=None), None, "What\na"),
        (calibration("a", converged=False), None, "What  (FIT NOT CONVERGED)\nbench: a"),
        # what has no datasets, as a covariance, has no more to say
        (SimpleNamespace(), None, "What"),
    ]:
        figure = Figure()
        _style.heading(figure, of, "What", names)
        assert figure.get_suptitle() == title, (of, names, title)


def test_legend_entries_are_named_once_in_their_order():
    panels = Figure().subplots(1, 2)
    first = panels[0].plot([1, 2], label="a")[0]
    panels[0].plot([1, 2], label="b")
    panels[1].plot([1, 2], label="a")
    panels[1].plot([1, 2], label="c")
    panels[1].plot([1, 2])
    entries = _style.legend_entries(panels)
    assert list(entries) == ["a", "b", "c"]
    assert entries["a"] is first


def test_a_line_is_drawn_in_the_order_of_the_wavelengths():
    axes = Figure().subplots()
    line = _style.draw_line(axes, [3, 1, 2], [30, 10, np.nan], color="red", label="x")
    assert line.get_xdata().tolist() == [1, 2, 3]
    np.testing.assert_array_equal(line.get_ydata(), [10, np.nan, 30])
    assert (line.get_color(), line.get_label()) == ("red", "x")


# ---- wavelengths and angles ----------------------------------------------------------------


def test_wavelengths_in_any_unit_are_nanometres():
    np.testing.assert_allclose(_style.nanometres(1.6 * u.um), [1600.0])
    np.testing.assert_allclose(_style.nanometres([12000, 16000] * u.AA), [1200.0, 1600.0])
    # wavelengths need a unit
    for wavelength in [1600.0, [1.2, 1.6], 3 * u.deg, None]:
        with pytest.raises(ParameterError, match="needs a unit such as nm"):
            _style.nanometres(wavelength)


def test_angles_are_short():
    for angle, text in [
        (11.25, "11.25°"),
        (45.0, "45°"),
        (-0.001, "0°"),
        (0.004, "0°"),
        (22.5, "22.5°"),
        (-10, "-10°"),
    ]:
        assert _style.degrees(angle) == text, (angle, text)


# ---- arrays --------------------------------------------------------------------------------


def test_root_mean_square_of_what_is_known():
    values = np.array([[3.0, np.nan, 4.0], [np.nan, np.nan, 1.0]])
    np.testing.assert_allclose(_style.rms(values, axis=1), [np.sqrt(12.5), 1.0])
    np.testing.assert_allclose(_style.rms(values, axis=0), [3.0, np.nan, np.sqrt(8.5)])
    assert _style.rms(values) == pytest.approx(np.sqrt(26 / 3))
    assert np.isnan(_style.rms(np.full(3, np.nan)))


@given(st.lists(st.floats(0.5, 99), min_size=2, max_size=9, unique=True))
def test_every_centre_is_in_its_cell(centres):
    centres = np.sort(centres)
    edges = _style.cell_edges(centres)
    assert len(edges) == len(centres) + 1
    assert np.all((edges[:-1] <= centres) & (centres <= edges[1:]))
    # the first and the last centre are in the middle of theirs
    assert centres[0] - edges[0] == pytest.approx(edges[1] - centres[0])
    assert edges[-1] - centres[-1] == pytest.approx(centres[-1] - edges[-2])


def test_a_single_cell_has_a_width():
    low, high = _style.cell_edges(np.array([1600.0]))
    assert low < 1600 < high


def test_elements_of_a_parameter_belong_together():
    names = ["hwp.theta", "a.x[0]", "b.y", "a.x[1]", "a.x[2]"]
    assert _style.element_places(names) == {"hwp.theta": [0], "a.x": [1, 3, 4], "b.y": [2]}
    assert _style.element_places([]) == {}


# ---- files ---------------------------------------------------------------------------------


def test_the_suffix_tells_the_format(tmp_path):
    for suffix in [".png", ".PDF", ".svg"]:
        path = tmp_path / f"figure{suffix}"
        assert _style.save(Figure(figsize=(1, 1)), str(path)) == path, suffix
        start = {".png": b"\x89PNG", ".PDF": b"%PDF", ".svg": b"<?xml"}[suffix]
        assert path.read_bytes().startswith(start), suffix
    # and nothing else
    assert len(list(tmp_path.iterdir())) == 3


def test_unknown_formats_are_refused_before_anything_is_written(tmp_path):
    for name in ["figure", "figure.xyz", "figure.asdf"]:
        with pytest.raises(ObservationError, match=f"{name}: the name must end with"):
            _style.save(Figure(), tmp_path / name, ObservationError)
        with pytest.raises(AstropolcalError):
            _style.save(Figure(), tmp_path / name)
        assert not list(tmp_path.iterdir()), name


def test_an_axis_is_logarithmic_where_the_values_need_it():
    for values, scale, limits in [
        ([1.0, 4.0], "linear", (0, 4.32)),
        ([1.0, 7.0], "log", (1 / 1.3, 9.1)),
        # a wavelength that is masked wholly does not count, nor does what is missing
        ([1.0, np.nan, 4.0], "linear", (0, 4.32)),
        ([0.0, 1.0, 40.0], "log", (1 / 1.3, 52)),
    ]:
        axes = Figure().subplots()
        _style.scale_axis(axes, np.array(values))
        assert axes.get_yscale() == scale, (values, scale, limits)
        assert axes.get_ylim() == pytest.approx(limits), (values, scale, limits)
        if scale == "log":
            assert axes.yaxis.get_major_formatter()(0.02, 0) == "0.02"
