# Licensed under a 3-clause BSD style license - see LICENSE
"""Panels of a run, from hand-made numbers."""

from types import SimpleNamespace

import numpy as np
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
