# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of corrected science: panels, errors, scales, labels."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.correction import ScienceFrames, correct
from astropolcal.exceptions import ParameterError
from astropolcal.plotting import _style, correction
from astropolcal.plotting.correction import plot_images

HWP = [0, 45, 22.5, 67.5] * u.deg
WAVELENGTH = [1.6, 1.2, 2.2] * u.um
Q, U = 0.02, -0.01


def chain():
    plate = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    return plate | optics.WollastonPrism(name="wollaston")


def beams(q, u_, intensity):
    """Fluxes of both beams at the four angles of the plate, an ideal instrument."""
    signs = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]).reshape(4, 2, *(1,) * np.ndim(intensity))
    change = signs[:, 0] * q * intensity + signs[:, 1] * u_ * intensity
    return (intensity + change) / 2, (intensity - change) / 2


@pytest.fixture(scope="module")
def images():
    y, x = np.mgrid[-6:7, -6:7]
    intensity = 1e4 * np.exp(-np.hypot(x, y) / 4) * np.ones((3, 1, 1))
    right, left = beams(Q, U, intensity)
    frames = ScienceFrames.from_arrays(
        right, left, WAVELENGTH, {"hwp": HWP}, variance_right=right, variance_left=left
    )
    return correct(chain(), frames)


# ---- images --------------------------------------------------------------------------------


def panels(figure):
    return {axes.get_title(): axes for axes in figure.axes if axes.images}


def test_a_wavelength_may_be_counted_from_the_end(images):
    first, last = plot_images(images, wavelength=2), plot_images(images, wavelength=-1)
    for name in ("Q", "U"):
        found = [panels(f)[name].images[0].get_array() for f in (first, last)]
        np.testing.assert_array_equal(found[0], found[1])
    assert first.get_suptitle() == last.get_suptitle()
    assert "2200 nm" in last.get_suptitle()
    with pytest.raises(ParameterError, match=r"wavelength = -4; there are 0 to 2"):
        plot_images(images, wavelength=-4)


def test_error_of_a_mean_is_less_by_the_root_of_its_number(images):
    title = "statistical error of Q"
    one = panels(plot_images(images, wavelength=0))[title].images[0].get_array()
    mean = panels(plot_images(images))[title].images[0].get_array()
    np.testing.assert_allclose(mean, one / np.sqrt(3), rtol=1e-6)
    assert "mean of 3 wavelengths, 1200 to 2200 nm" in plot_images(images).get_suptitle()


def test_scales_of_intensity_and_polarization(images):
    """Polarization has one symmetric scale; intensity is logarithmic, dark pixels are darkest."""
    found = panels(plot_images(images))
    limits = {found[name].images[0].get_clim() for name in ("Q", "U", "Q$_\\phi$", "U$_\\phi$")}
    ((low, high),) = limits
    assert low == -high < 0
    assert found["statistical error of Q"].images[0].get_clim()[0] == 0
    image = panels(plot_images(images, wavelength=0))["I"].images[0]
    assert type(image.norm).__name__ == "LogNorm"
    assert image.get_array().min() >= image.norm.vmin
    assert image.norm.vmax == pytest.approx(image.get_array().max())


def test_the_star_is_at_the_origin(images):
    figure = plot_images(images)
    axes = panels(figure)["Q"]
    left, right, bottom, top = axes.images[0].get_extent()
    assert (left + right, bottom + top) == pytest.approx((0, 0))
    (cross,) = axes.lines
    assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (0, 0)
    assert axes.get_ylabel() in ("y (pixels)", "offset to the north (pixels)", "")
    assert figure.get_supxlabel() == "+ star; grey: no value"


# ---- small things --------------------------------------------------------------------------


def test_top_of_a_scale():
    for values, top in [
        ([np.nan, np.nan], 1.0),
        ([0.0, 0.0], 1.0),
        ([-3.0, -2.0], 1.0),
        ([0.0, 4.0, np.nan], 3.98),
    ]:
        assert correction._top(np.array(values)) == pytest.approx(top), (values, top)


def test_mean_of_what_is_known():
    stack = np.array([[[1.0, np.nan]], [[3.0, np.nan]]])
    np.testing.assert_array_equal(_style.mean_known(stack), [[2.0, np.nan]])


def test_labels_of_the_axes():
    for scale, north, label in [
        (None, False, "x (pixels)"),
        (16.15, False, "x (arcsec)"),
        (None, True, "offset to the x (pixels)"),
        (16.15, True, "offset to the x (arcsec)"),
    ]:
        product = SimpleNamespace(pixel_scale=scale, north_up=north)
        assert correction._axis_label(product, "x") == label, (scale, north, label)


def test_east_is_left_and_pixels_are_milliarcseconds():
    product = SimpleNamespace(
        stokes=np.zeros((4, 1, 3, 5)), _middle=lambda: (2.0, 1.0), pixel_scale=20.0, north_up=True
    )
    np.testing.assert_allclose(correction._extent(product), [0.05, -0.05, -0.03, 0.03])
    product.north_up = False
    np.testing.assert_allclose(correction._extent(product), [-0.05, 0.05, -0.03, 0.03])
