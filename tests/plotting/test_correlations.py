# Licensed under a 3-clause BSD style license - see LICENSE
"""What the correlation plot shows, read back from the figure."""

import astropy.units as u
import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.calibration.uncertainty.refits import Resampled
from astropolcal.exceptions import ParameterError
from astropolcal.plotting import plot_correlations


def drawn(figure):
    """The matrix in the figure, NaN where nothing is drawn."""
    (mesh,) = figure.axes[0].collections
    array = np.ma.filled(mesh.get_array().astype(float), np.nan)
    return array.reshape(mesh.get_coordinates().shape[0] - 1, -1)


def test_matrix_is_that_of_the_calibration(elliptical):
    figure = plot_correlations(elliptical)
    np.testing.assert_allclose(drawn(figure), elliptical.covariance.correlation)
    (mesh,) = figure.axes[0].collections
    assert mesh.get_clim() == (-1, 1)
    # the diagonal runs from the upper left
    assert figure.axes[0].yaxis_inverted()
    assert not figure.legends
    assert "Correlations" in figure.get_suptitle()


def test_groups_are_named_once(elliptical):
    labels = [text.get_text() for text in plot_correlations(elliptical).axes[0].get_yticklabels()]
    assert labels[0] == "hwp.w_sio2"
    assert "derotator.horizontal (5)" in labels
    assert len(labels) == len({name.split("[")[0] for name in elliptical.covariance.names})


def test_common_parameters_are_wider(elliptical):
    (mesh,) = plot_correlations(elliptical).axes[0].collections
    widths = np.diff(mesh.get_coordinates()[0, :, 0])
    assert widths[0] > 3 * widths[-1]


def test_undetermined_rows_are_hatched(undetermined):
    figure = plot_correlations(undetermined)
    without = np.isnan(undetermined.covariance.stds)
    assert without.any()
    assert np.isnan(drawn(figure)[without]).all()
    assert figure.axes[0].patch.get_hatch()
    (legend,) = figure.legends
    text = legend.get_texts()[0].get_text()
    assert text.startswith(f"{without.sum()} of {without.size} parameters: left open")


def test_small_matrices_have_numbers():
    matrix = [[0.04, -0.001], [-0.001, 1e-4]]
    figure = plot_correlations(Covariance(["hwp.theta", "hwp.w_sio2"], [u.deg, u.mm], matrix))
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts == ["1.00", "\N{MINUS SIGN}0.50", "\N{MINUS SIGN}0.50", "1.00"]


def test_large_matrices_have_none(elliptical):
    assert len(elliptical.covariance) > 12
    assert not plot_correlations(elliptical).axes[0].texts


def test_resamples_are_drawn():
    samples = np.random.default_rng(0).normal(size=(50, 2))
    made = Resampled(["a.theta", "b.x"], [u.deg, None], samples, "pair", 8, 0)
    np.testing.assert_allclose(drawn(plot_correlations(made)), np.corrcoef(samples.T))


def test_figure_may_be_given(elliptical):
    figure = Figure()
    assert plot_correlations(elliptical, figure=figure) is figure


def test_nothing_to_draw_is_refused():
    with pytest.raises(ParameterError, match="no free parameter"):
        plot_correlations(Covariance([], [], np.zeros((0, 0))))
