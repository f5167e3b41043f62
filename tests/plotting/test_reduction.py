# Licensed under a 3-clause BSD style license - see LICENSE
"""Panels of a run, from hand-made numbers."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from astropolcal.plotting import reduction


def frame(mjd=None, reason="", flux=(1.0, 2.0)):
    photometry = SimpleNamespace(
        flux=np.array(flux)[:, None] * np.ones((1, 2)), reasons=[reason, ""]
    )
    return SimpleNamespace(values={} if mjd is None else {"mjd": mjd}, photometry=photometry)


def test_clock_of_a_run():
    for times, clock, label in [
        ([60000.0, 60000.5, 59999.0], [1440, 2160, 0], "time since the first frame (min)"),
        ([60000.0, None], [0, 1], "frame"),
        ([60000.0, 60000.0], [0, 1], "frame"),
    ]:
        found, words = reduction._clock([frame(time) for time in times])
        np.testing.assert_allclose(found, clock)
        assert words == label, (times, clock, label)


def test_cells_that_failed_have_no_value():
    run = SimpleNamespace(frames=[frame(), frame(reason="saturated"), frame(flux=(3.0, 4.0))])
    np.testing.assert_array_equal(
        reduction._cells(run, 0, "flux"), [[1.0, np.nan, 3.0], [2.0, np.nan, 4.0]]
    )
    # at another wavelength the frame is good
    assert np.isfinite(reduction._cells(run, 1, "flux")).all()


def test_what_both_beams_share_is_in_the_error_of_a_single_difference():
    run = SimpleNamespace(frames=[frame()])
    photometry = run.frames[0].photometry
    # fluxes 300 and 500, known to 3 and 4, of which 6 are of the common background
    run.frames[0].unit, photometry.flux = "adu", np.array([[300.0], [500.0]])
    photometry.variance, photometry.covariance = np.array([[9.0], [16.0]]), np.array([6.0])
    photometry.reasons = [""]
    top, below = Figure().subplots(2)
    reduction._draw_fluxes(top, below, run, np.zeros(1), 0)
    (segment,) = below.containers[0][2][0].get_segments()
    slope = 2 * np.array([500.0, -300.0]) / 800.0**2
    expected = np.sqrt(slope @ [[9.0, 6.0], [6.0, 16.0]] @ slope)
    assert np.ptp(segment[:, 1]) / 2 == pytest.approx(expected)


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
