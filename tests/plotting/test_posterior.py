# Licensed under a 3-clause BSD style license - see LICENSE
"""The corner plot."""

import sys

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration.posterior import Posterior
from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.plotting import plot_corner

MINUS = "\N{MINUS SIGN}"
NAMES = ["hwp.w_sio2", "hwp.w_mgf2", "calibration_polarizer.theta"]
pytestmark = pytest.mark.samplers


def make_posterior(n_steps=1500, names=NAMES):
    rng = np.random.default_rng(1)
    first = rng.normal(size=(n_steps, 8))
    rows = [1.654 + 1e-3 * first, 1.292 + 1e-3 * first + 1e-5 * rng.normal(size=first.shape)]
    rows += [90 + rng.normal(size=first.shape) for _ in names[2:]]
    units = [u.mm, u.mm, *[u.deg] * (len(names) - 2)]
    fitted = [1.6541, 1.2921, *[90.2] * (len(names) - 2)]
    return Posterior(names, units, np.stack(rows, axis=2), -(first**2), fitted=fitted)


@pytest.fixture(scope="module")
def posterior():
    return make_posterior()


@pytest.fixture(scope="module")
def corner_plot(posterior):
    pytest.importorskip("corner")
    return plot_corner(posterior)


def texts(axes):
    return [text.get_text() for text in axes.texts]


def rendered(figure, tmp_path):
    figure.savefig(tmp_path / "figure.png", dpi=40)
    return figure


@pytest.mark.slow
def test_corner_shows_every_pair_with_units_and_what_is_taken_off(corner_plot):
    assert len(corner_plot.axes) == 9
    panels = np.array(corner_plot.axes).reshape(3, 3)
    assert texts(panels[1, 0]) == ["r = 0.9999"] or texts(panels[1, 0]) == ["r = 1.0000"]
    assert [axes.get_title() for axes in panels.diagonal()] == ["τ = 1 steps"] * 3
    bottom = corner_plot.axes[6:]
    assert [axes.get_xlabel().split("\n")[0] for axes in bottom] == [
        "hwp",
        "hwp",
        "calibration_polarizer",
    ]
    assert [axes.get_xlabel().split("\n")[1] for axes in bottom] == [
        f"w_sio2 {MINUS} 1.654 (mm)",
        f"w_mgf2 {MINUS} 1.292 (mm)",
        "theta (deg)",
    ]
    low, high = bottom[0].get_xlim()
    assert low < 0 < high < 0.01


@pytest.mark.slow
def test_corner_marks_the_fit(posterior, corner_plot):
    def marks(figure):
        return [
            line for axes in figure.axes for line in axes.lines if line.get_color() == "#D55E00"
        ]

    # one line in each of 3 histograms, two in each of 3 pairs
    assert len(marks(corner_plot)) == 9
    assert "orange: fitted values" in corner_plot.get_suptitle()
    plain = plot_corner(posterior, fitted=False)
    assert not marks(plain)
    assert "orange" not in plain.get_suptitle()


def test_corner_leaves_out_a_fit_far_away():
    parts = make_posterior().to_dict()
    far = Posterior.from_dict(parts | {"fitted": np.array([1.6541, 1.2921, 140.0])})
    pytest.importorskip("corner")
    panels = plot_corner(far).axes
    low, high = panels[8].get_xlim()
    assert high - low < 15


@pytest.mark.slow
def test_corner_is_within_its_figure(corner_plot, tmp_path):
    box = rendered(corner_plot, tmp_path).get_tightbbox()
    width, height = corner_plot.get_size_inches()
    assert box.x0 > 0
    assert box.y0 > 0
    assert box.x1 < width
    assert box.y1 < height


def test_corner_of_some_parameters(posterior):
    pytest.importorskip("corner")
    figure = plot_corner(posterior, NAMES[:1])
    assert len(figure.axes) == 1
    # corner of a chain that is too short says so
    assert "CHAIN TOO SHORT" in plot_corner(make_posterior(40)).get_suptitle()


@pytest.mark.slow
def test_corner_draws_into_a_given_figure(posterior):
    pytest.importorskip("corner")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 8), layout="constrained")
    assert plot_corner(posterior, figure=figure) is figure
    assert len(figure.axes) == 9


def test_no_corner_of_many_parameters():
    pytest.importorskip("corner")
    many = make_posterior(60, [f"derotator.horizontal[{i}]" for i in range(13)])
    with pytest.raises(ParameterError, match="13 parameters for one figure; allowed are 1 to 12"):
        plot_corner(many)
    assert len(plot_corner(many, many.names[2:4]).axes) == 4


def test_no_corner_of_what_does_not_move(posterior):
    pytest.importorskip("corner")
    chain = posterior.chain.copy()
    chain[..., 1] = 1.3
    stuck = Posterior(NAMES, posterior.units, chain, posterior.log_prob)
    with pytest.raises(ParameterError, match=r"hwp\.w_mgf2 did not move"):
        plot_corner(stuck)


def test_unknown_parameter(posterior):
    pytest.importorskip("corner")
    with pytest.raises(ParameterError, match=r"no parameter 'hwp\.theta'"):
        plot_corner(posterior, ["hwp.theta"])


def test_missing_corner(posterior, monkeypatch):
    monkeypatch.setitem(sys.modules, "corner", None)
    with pytest.raises(AstropolcalError, match=r"corner, .*pip install \"astropolcal\[mcmc\]\""):
        plot_corner(posterior)


@pytest.mark.slow
def test_corner_of_a_thinned_posterior(posterior):
    pytest.importorskip("corner")
    figure = plot_corner(posterior.thinned())
    assert "1500 steps of 8 walkers" in figure.get_suptitle()
    assert "drawn: " in figure.get_suptitle()


def test_a_figure_of_walkers_that_do_not_agree_says_so(posterior):
    pytest.importorskip("corner")
    pytest.importorskip("arviz_stats")
    parts = posterior.thinned().to_dict()
    parts["convergence"]["r_hat"] = [1.3, 1.0, 1.0]
    apart = Posterior.from_dict(parts)
    assert "(NOT CONVERGED)" in plot_corner(apart, NAMES[:1]).get_suptitle()
