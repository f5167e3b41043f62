# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of corrected science: what they show."""

import numpy as np
import pytest

from astropolcal.correction import ScienceFrames, correct
from astropolcal.exceptions import ParameterError
from astropolcal.plotting.correction import plot_images


@pytest.fixture(scope="module")
def images(calibration, charis, track, scene, seen):
    hwp, positions = track()
    right, left = seen(calibration, positions, charis.wavelength, scene(22))
    frames = ScienceFrames.from_arrays(
        right, left, charis.wavelength, positions, hwp=hwp, variance_right=right, variance_left=left
    )
    return correct(calibration, frames)


def test_images_show_the_data(images):
    figure = plot_images(images, wavelength=3)
    panels = {axes.get_title(): axes for axes in figure.axes if axes.images}
    assert list(panels)[:3] == ["I", "Q", "U"]
    np.testing.assert_array_equal(panels["Q"].images[0].get_array(), images["Q"][3])
    low, high = panels["U"].images[0].get_clim()
    assert low == -high
    assert "statistical error of Q" in panels
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert "flux (adu per pixel)" in labels
    assert "1240" in figure.get_suptitle() or "nm" in figure.get_suptitle()


def test_the_mean_is_over_all_wavelengths(images):
    panels = {axes.get_title(): axes for axes in plot_images(images).axes if axes.images}
    np.testing.assert_allclose(panels["Q"].images[0].get_array(), images["Q"].mean(axis=0))
    assert "mean of 22 wavelengths" in plot_images(images).get_suptitle()


def test_east_is_left_where_north_is_up(images):
    images = type(images)(**{**images.__dict__, "north_up": True, "pixel_scale": 16.2})
    axes = plot_images(images).axes[0]
    left, right = axes.images[0].get_extent()[:2]
    assert left > 0 > right
    assert "north (arcsec)" in axes.get_ylabel()


def test_what_is_asked_of_the_wrong_kind(images):
    with pytest.raises(ParameterError, match="these are spectra; plot_images draws images"):
        plot_images(images.aperture(5))
    with pytest.raises(ParameterError, match="wavelength = 40"):
        plot_images(images, wavelength=40)
