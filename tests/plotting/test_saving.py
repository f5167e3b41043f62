# Licensed under a 3-clause BSD style license - see LICENSE
"""Files of figures, and what drawing leaves behind."""

import subprocess
import sys
from copy import copy
from dataclasses import replace
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from astropolcal import optics
from astropolcal.calibration.posterior import Posterior
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, ObservationError
from astropolcal.plotting import (
    plot_accuracy,
    plot_double_differences,
    plot_efficiency,
    plot_retardances,
    save_all,
    saving,
)
from astropolcal.plotting.parameters import other_parameters, plot_parameters
from astropolcal.plotting.residuals import plot_residuals

pytestmark = pytest.mark.samplers
DRAW = [
    plot_accuracy,
    plot_double_differences,
    plot_efficiency,
    plot_parameters,
    plot_residuals,
    plot_retardances,
]


def names(paths):
    return [path.name for path in paths]


@pytest.mark.long
def test_writes_every_figure_as_png(elliptical, tmp_path):
    pytest.importorskip("corner")
    folder = tmp_path / "new" / "figures"
    sampled = with_posterior(elliptical, ["hwp.w_sio2", "hwp.w_mgf2", "wollaston.efficiency[0]"])
    paths = save_all(sampled, folder)
    assert names(paths) == [
        "double_differences.png",
        "residuals.png",
        "identifiability.png",
        "accuracy.png",
        "retardances.png",
        "targets.png",
        "efficiency.png",
        "correlations.png",
        "corner.png",
    ]
    # nothing half-written or temporary stays behind
    assert sorted(folder.iterdir()) == sorted(paths)
    for path in paths:
        image = imread(path)
        assert min(image.shape[:2]) > 600
        assert np.ptp(image[..., 0]) == 1


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_each_dataset_has_its_double_differences(several, tmp_path):
    found = names(save_all(several, tmp_path))
    assert found[:2] == ["double_differences.png", "double_differences_2.png"]
    # its free diattenuation is there and nowhere else
    assert "mirrors.png" in found
    assert "other_parameters.png" not in found


@pytest.mark.usefixtures("unpainted")
def test_what_no_other_figure_shows_is_drawn(elliptical, tmp_path):
    gain = optics.BeamGain(imbalance=np.zeros(elliptical.wavelength.size), name="flat")
    calibration = replace(elliptical, chains=[elliptical.chain | gain])
    assert other_parameters(calibration) == ["flat.imbalance"]


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_calibration_without_data_gets_the_other_figures(elliptical, tmp_path):
    paths = save_all(replace(elliptical, measurement=None), tmp_path)
    assert names(paths) == [
        "identifiability.png",
        "accuracy.png",
        "retardances.png",
        "targets.png",
        "efficiency.png",
        "correlations.png",
    ]


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_dataset_without_a_datum_is_left_out(several, tmp_path):
    measurement = copy(several.measurement)
    empty = copy(measurement.datasets[1])
    empty.n_data = 0
    measurement.datasets = [measurement.datasets[0], empty]
    without = replace(several, measurement=measurement)
    with pytest.raises(ObservationError, match="unpolarized: no datum is left to draw"):
        plot_double_differences(without, dataset=1)
    assert "double_differences_2.png" not in names(save_all(without, tmp_path))


@pytest.mark.slow
def test_every_kind_of_calibration_is_drawn(request, tmp_path):
    assert len(save_all(request.getfixturevalue("single_angle"), tmp_path)) == 8
    request.getfixturevalue("unpainted")
    for name in ["masked", "undetermined"]:
        assert len(save_all(request.getfixturevalue(name), tmp_path)) == 8, name


def with_posterior(calibration, names=None, seed=1):
    """The calibration with samples of what is named, by default of all that is free."""
    covariance = calibration.covariance
    names = covariance.names if names is None else names
    units = [covariance.units[covariance.names.index(name)] for name in names]
    chain = np.random.default_rng(seed).normal(size=(120, 40, len(names)))
    # every other one is slow
    for i in range(len(names)):
        chain[:, :, i] = np.cumsum(chain[:, :, i], axis=0) if i % 2 else chain[:, :, i]
    return replace(calibration, posterior=Posterior(names, units, chain, chain[..., 0]))


@pytest.fixture
def drawn(monkeypatch, unpainted):
    """What the figure of a posterior was asked to show."""
    pytest.importorskip("corner")
    from astropolcal.plotting import saving

    shown = []

    def remembering(posterior, parameters):
        shown[:] = parameters
        return Figure(figsize=(2, 2))

    monkeypatch.setattr(saving, "plot_corner", remembering)
    return shown


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_posterior_of_a_file_is_drawn(elliptical, tmp_path):
    pytest.importorskip("corner")
    sampled = with_posterior(elliptical, ["hwp.w_sio2", "hwp.w_mgf2", "wollaston.efficiency[0]"])
    stored = replace(sampled, posterior=sampled.posterior.thinned(), measurement=None)
    assert names(save_all(stored, tmp_path))[-1] == "corner.png"


@pytest.mark.slow
def test_few_parameters_are_all_drawn_and_of_many_the_slowest(elliptical, tmp_path, drawn):
    sampled = with_posterior(elliptical, elliptical.covariance.names[:12])
    save_all(sampled, tmp_path)
    assert drawn == sampled.posterior.names
    # of many without common ones the slowest
    sampled = with_posterior(elliptical, [n for n in elliptical.covariance.names if "[" in n])
    save_all(sampled, tmp_path)
    times = dict(zip(sampled.posterior.names, sampled.posterior.autocorrelation_times, strict=True))
    assert len(drawn) == 12
    assert [times[name] for name in drawn] == sorted(times.values(), reverse=True)[:12]


def test_of_many_parameters_the_common_ones_are_drawn(elliptical, tmp_path, drawn):
    sampled = with_posterior(elliptical)
    posterior = sampled.posterior
    common = [name for name in posterior.names if not name.endswith("]")]
    assert 0 < len(common) < 12 < len(posterior.names) - len(common)
    save_all(sampled, tmp_path)
    assert drawn == common


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_without_corner_the_other_figures_are_drawn(elliptical, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "corner", None)
    sampled = with_posterior(elliptical, ["hwp.w_sio2"])
    message = r"corner\.png is not drawn: the corner plot needs the package corner, .*pip install"
    with pytest.warns(AstropolcalWarning, match=message):
        found = names(save_all(sampled, tmp_path))
    assert found[-1] == "correlations.png"
    assert not (tmp_path / "corner.png").exists()


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_parameter_that_does_not_move_costs_the_corner_plot(elliptical, tmp_path):
    pytest.importorskip("corner")
    stuck = with_posterior(elliptical, ["hwp.w_sio2", "hwp.w_mgf2"])
    stuck.posterior.chain[:, :, 0] = 1.65
    with pytest.warns(AstropolcalWarning, match=r"corner\.png is not drawn: .* did not move"):
        assert names(save_all(stuck, tmp_path))[-1] == "correlations.png"


@pytest.mark.usefixtures("unpainted")
@pytest.mark.slow
def test_existing_files_are_replaced(elliptical, tmp_path):
    path = tmp_path / "accuracy.png"
    path.write_text("old")
    save_all(elliptical, str(tmp_path))
    assert path.read_text() == "painted"


@pytest.mark.slow
def test_failure_leaves_the_old_file_whole(elliptical, tmp_path, monkeypatch):
    def fail(self, path, **_):
        path.write_text("half a fig")
        raise OSError(28, "No space left on device")

    path = tmp_path / "double_differences.png"
    path.write_text("old")
    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(AstropolcalError, match="No space left on device"):
        save_all(elliptical, tmp_path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_folder_that_is_a_file_is_refused(elliptical, tmp_path):
    path = tmp_path / "taken"
    path.write_text("")
    with pytest.raises(AstropolcalError, match="taken: cannot be created"):
        save_all(elliptical, path)


def test_drawing_leaves_no_state_behind(elliptical):
    for draw in DRAW:
        from matplotlib import pyplot as plt

        before = dict(mpl.rcParams)
        figure = draw(elliptical)
        assert isinstance(figure, Figure), draw
        assert plt.get_fignums() == [], draw
        assert dict(mpl.rcParams) == before, draw


@pytest.mark.slow
def test_text_is_readable_and_stays_on_the_page(undetermined):
    for draw in DRAW:
        figure = draw(undetermined)
        figure.draw_without_rendering()
        assert figure.get_layout_engine() is not None, draw
        sizes = [text.get_fontsize() for axes in figure.axes for text in axes.texts]
        sizes += [axes.xaxis.label.get_fontsize() for axes in figure.axes]
        assert min(sizes) >= 10, draw
        page = figure.bbox
        title = figure._suptitle.get_window_extent()
        assert page.x0 <= title.x0, draw
        assert title.x1 <= page.x1, draw
        for axes in figure.axes:
            box = axes.get_tightbbox()
            assert box.y0 >= page.y0 - 1, draw
            assert box.y1 <= page.y1 + 1, draw
            assert box.x0 >= page.x0 - 1, draw


@pytest.mark.slow
def test_importing_the_package_does_not_import_matplotlib():
    code = "import sys, astropolcal.plotting; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_what_does_not_move_is_drawn_first(monkeypatch):
    names = [f"a.x[{i}]" for i in range(4)] + ["hwp.theta"]
    times = np.array([3.0, np.nan, 9.0, 5.0, 1.0])
    posterior = SimpleNamespace(names=names, autocorrelation_times=times)
    assert saving._drawn(posterior) == names
    monkeypatch.setattr(saving, "MAX_CORNER", 3)
    assert saving._drawn(posterior) == ["hwp.theta"]
    own = SimpleNamespace(names=names[:4], autocorrelation_times=times[:4])
    assert saving._drawn(own) == ["a.x[1]", "a.x[2]", "a.x[3]"]
