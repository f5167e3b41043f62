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
from astropolcal.plotting.correction import plot_corrected, plot_images, plot_spectrum

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
def star():
    intensity = np.array([1e6, 2e6, 0.5e6])
    right, left = beams(Q, U, intensity)
    frames = ScienceFrames.from_arrays(
        right, left, WAVELENGTH, {"hwp": HWP}, variance_right=right, variance_left=left
    )
    return correct(chain(), frames)


@pytest.fixture(scope="module")
def images():
    y, x = np.mgrid[-6:7, -6:7]
    intensity = 1e4 * np.exp(-np.hypot(x, y) / 4) * np.ones((3, 1, 1))
    right, left = beams(Q, U, intensity)
    frames = ScienceFrames.from_arrays(
        right, left, WAVELENGTH, {"hwp": HWP}, variance_right=right, variance_left=left
    )
    return correct(chain(), frames)


def bars(container):
    line, _, (segments,) = container.lines
    return (
        line.get_xdata(),
        line.get_ydata(),
        np.array([np.ptp(s[:, 1]) / 2 for s in segments.get_segments()]),
    )


def legend(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


# ---- spectra -------------------------------------------------------------------------------


def test_fractions_are_drawn_in_percent_with_photon_noise(star):
    figure = plot_spectrum(star)
    top = figure.axes[0]
    found = {c.get_label().split(",")[0]: bars(c) for c in top.containers}
    for name, sign in (("q", Q), ("u", U)):
        x, y, error = found[name]
        np.testing.assert_allclose(x, [1600, 1200, 2200])
        np.testing.assert_allclose(np.abs(y), 100 * abs(sign), rtol=1e-6)
        # two of the four frames tell q, with the photons of both beams
        expected = 100 / np.sqrt(2 * np.array([1e6, 2e6, 0.5e6]))
        np.testing.assert_allclose(error, expected, rtol=0.01)
    # looks of q and u differ by more than colour
    looks = {(c.lines[0].get_marker(), c.lines[0].get_color()) for c in top.containers}
    assert len({marker for marker, _ in looks}) == len({color for _, color in looks}) == 2


def test_the_error_of_the_degree_is_drawn_on_a_logarithmic_axis(star):
    figure = plot_spectrum(star)
    middle = figure.axes[1]
    (line,) = middle.lines
    np.testing.assert_allclose(line.get_ydata(), 100 * star.polarization()["s_p_statistical"])
    assert middle.get_yscale() == "log"
    assert (middle.get_ylabel(), figure.axes[0].get_ylabel()) == (
        "error of the degree (%)",
        "fraction of I (%)",
    )
    assert figure.axes[2].get_xlabel() == "wavelength (nm)"
    assert legend(figure) == ["q, statistical error", "u, statistical error", "$s_p$, statistical"]


def test_condition_is_drawn_by_its_logarithm_beyond_a_thousand(star, monkeypatch):
    bottom = plot_spectrum(star).axes[2]
    np.testing.assert_allclose(bottom.lines[0].get_ydata(), star.condition)
    assert bottom.get_yscale() == "linear"
    assert bottom.get_ylim()[0] == 1
    monkeypatch.setattr(star, "condition", np.array([2.0, 5.0, 1e6]))
    assert plot_spectrum(star).axes[2].get_yscale() == "log"


def test_errors_that_are_not_known_are_said_to_be_so(star, monkeypatch):
    nothing = {name: np.full(3, np.nan) for name in "quv"}
    monkeypatch.setattr(star, "fractional_errors", lambda kind="statistical": nothing)
    degree = {f"s_p_{kind}": np.full(3, np.nan) for kind in ("statistical", "systematic")}
    monkeypatch.setattr(star, "polarization", lambda: degree)
    figure = plot_spectrum(star)
    assert [text.get_text() for text in figure.axes[1].texts] == ["no errors are known"]
    assert legend(figure) == ["q", "u"]
    np.testing.assert_array_equal(bars(figure.axes[0].containers[0])[2], 0)


def test_systematic_errors_are_bands(star, monkeypatch):
    plain = star.fractional_errors()
    known = plain | {name: np.full(3, 0.003) for name in "qu"}
    monkeypatch.setattr(
        star, "fractional_errors", lambda kind="statistical": known if kind[1] == "y" else plain
    )
    figure = plot_spectrum(star)
    bands = figure.axes[0].collections
    bands = [band for band in bands if "systematic" in band.get_label()]
    assert [band.get_label() for band in bands] == ["q, systematic error", "u, systematic error"]
    edges = bands[0].get_paths()[0].vertices[:, 1]
    assert np.ptp(edges) == pytest.approx(0.6, rel=1e-3)
    # the statistical error of each comes first
    assert legend(figure)[:4] == [
        f"{name}, {kind} error" for name in "qu" for kind in ("statistical", "systematic")
    ]


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


def test_kind_of_the_product_decides_what_is_drawn(star, images):
    assert len(panels(plot_corrected(images))) == 6
    assert not panels(plot_corrected(star))
    with pytest.raises(ParameterError, match="these are spectra; plot_spectrum draws them"):
        plot_images(star)
    with pytest.raises(ParameterError, match="these are images; take an aperture"):
        plot_spectrum(images)


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
