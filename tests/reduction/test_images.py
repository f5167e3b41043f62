# Licensed under a 3-clause BSD style license - see LICENSE
"""Simulated images: where the light goes, what a detector makes of it, what leaves the image."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import instruments
from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.instruments.layout import FileLayout, ReadOut
from astropolcal.reduction.cubes import (
    ImageModel,
    Scene,
    expose,
    gaussian,
    moffat,
    rectangle,
    simulate_cubes,
)
from astropolcal.simulation import half_wave_plate_cycles

# two upright rectangles of 20 x 16 pixels, side by side
LAYOUT = FileLayout(
    {}, (2, 40, 80),
    internal_apertures=((20.0, 19.5), (60.0, 19.5), 20.0, 16.0, 0.0), star_offset=(40.0, 0.0),
)  # fmt: skip
WHOLE = (slice(0, 61), slice(0, 61))


def scene(source="star", layout=LAYOUT, **options):
    how = {"psf": "gaussian", "fwhm": np.array([3.0, 4.0]), "halo_fwhm": 20.0, "margin": 2.0}
    return Scene(ImageModel(**how | options), layout, source, layout.shape[0])


# ---- light ---------------------------------------------------------------------------


def test_right_flux_falls_in_the_right_beam():
    image = scene().light(np.array([[100.0, 100.0], [7.0, 7.0]]), (20.0, 19.5), 1.0)
    assert image[:, :, 40:].sum(axis=(1, 2)) == pytest.approx([100.0, 100.0], rel=1e-3)
    assert image[:, :, :40].sum(axis=(1, 2)) == pytest.approx([7.0, 7.0], rel=1e-3)


def test_flux_of_a_lamp_is_that_of_an_aperture():
    image = scene("internal").light(np.array([[320.0, 640.0], [0.0, 0.0]]), (20, 19.5), 1.0)
    # 20 x 16 pixels share it
    assert image[:, 19, 60] == pytest.approx([1.0, 2.0])
    inside = rectangle((40, 80), (60.0, 19.5), (20.0, 16.0), 0.0)
    assert (image * inside).sum(axis=(1, 2)) == pytest.approx([320.0, 640.0])


def test_seeing_widens_the_core_and_keeps_its_light():
    fluxes = np.array([[100.0, 100.0], [100.0, 100.0]])
    peaks = [scene().light(fluxes, (20.0, 19.5), w)[0].max() for w in (1.0, 1.5)]
    # a wider Gaussian is lower by the square of its width; half a pixel of offset matters little
    assert peaks[0] / peaks[1] == pytest.approx(1.5**2, rel=0.1)


def test_halo_takes_light_from_the_core():
    for halo in [0.0, 0.3, 1.0]:
        fluxes = np.array([[1.0, 1.0], [1.0, 1.0]])
        images = [scene(halo=h).light(fluxes, (20.0, 19.5), 1.0) for h in (0.0, halo, 1.0)]
        np.testing.assert_allclose(images[1], (1 - halo) * images[0] + halo * images[2], atol=1e-12)


@settings(max_examples=10)
@given(st.floats(1.0, 8.0), st.floats(1.3, 6.0), st.floats(28, 32), st.floats(28, 32))
def test_moffat_is_the_mean_of_its_formula_over_each_pixel(fwhm, beta, x, y):
    image = moffat(WHOLE, (x, y), fwhm, beta)
    fine = np.arange(-5, 6) / 11
    rows, columns = (np.arange(61)[:, None] + fine).ravel() - y, (np.arange(61)[:, None] + fine) - x
    r = np.hypot.outer(rows, columns.ravel())
    alpha = fwhm / (2 * np.sqrt(2 ** (1 / beta) - 1))
    profile = (beta - 1) / (np.pi * alpha**2) * (1 + (r / alpha) ** 2) ** -beta
    expected = profile.reshape(61, 11, 61, 11).mean(axis=(1, 3))
    np.testing.assert_allclose(image, expected, rtol=0.01, atol=0.01 * expected.max())


@settings(max_examples=10)
@given(st.floats(3.0, 6.0), st.floats(25, 35), st.floats(25, 35))
def test_gaussian_has_its_moments(fwhm, x, y):
    image = gaussian(WHOLE, (x, y), fwhm, None)
    rows, columns = np.indices((61, 61))
    assert image.sum() == pytest.approx(1.0)
    assert (image * columns).sum() == pytest.approx(x)
    assert (image * rows).sum() == pytest.approx(y)
    # pixels add the variance of a unit square, 1/12 (Sheppard's correction)
    spread = (image * (columns - x) ** 2).sum()
    assert spread == pytest.approx(fwhm**2 / (8 * np.log(2)) + 1 / 12, rel=1e-6)


# ---- what leaves the image -----------------------------------------------------------


def test_aperture_that_leaves_the_image_is_named():
    for source in ["internal", "star"]:
        for left, right, angle, words in [
            (
                (20.0, 7.4),
                (60.0, 19.5),
                0.0,
                r"the rectangle at \(20, 7.4\) leaves the image of 80 x",
            ),
            (
                (20.0, 19.5),
                (70.0, 19.5),
                0.0,
                r"the rectangle at \(70, 19.5\) leaves .* 80 x 40 pix",
            ),
            ((20.0, 32.0), (60.0, 19.5), 0.0, "the rectangle at"),
            ((9.4, 19.5), (60.0, 19.5), 0.0, "the rectangle at"),
            # upright it fits; turned by a quarter it needs the height of its width
            ((20.0, 8.0), (60.0, 19.5), np.pi / 2, "the rectangle at"),
        ]:
            layout = replace(LAYOUT, internal_apertures=(left, right, 20.0, 16.0, angle))
            with pytest.raises(InstrumentError, match=words):
                scene(source, layout)


def test_aperture_may_touch_the_edge():
    """The outer edge of the first pixel is at -0.5."""
    for place in [(9.5, 19.5), (20.0, 7.5), (20.0, 31.5)]:
        layout = replace(LAYOUT, internal_apertures=(place, (60.0, 19.5), 20.0, 16.0, 0.0))
        assert scene("star", layout).shape == (2, 40, 80), place


def test_stop_must_not_cut_the_apertures():
    # the images of the stop are farther apart than the apertures
    layout = replace(LAYOUT, star_offset=(46.0, 0.0))
    with pytest.raises(ParameterError, match="margin = 2 pixels: the field stop cuts the apert"):
        scene("internal", layout)
    with pytest.raises(ParameterError, match="margin = -3; allowed is 0 and above"):
        scene(margin=-3.0)


def test_star_outside_of_the_image_is_named():
    for place, words in [
        ((-0.1, 19.5), r"the star in the left beam is at \(-0.1, 19.5\), outside of the image of"),
        ((20.0, 39.1), r"right beam is at \(60, 39.1\)"),
        ((45.0, 19.5), r"right beam is at \(85, 19.5\), outside of the image of 80 x 40 pixels"),
        ((20.0, np.nextafter(0, -1)), "right beam"),
    ]:
        with pytest.raises(ParameterError, match=words):
            scene().check_places(np.array([[20.0, 19.5], place]))


def test_a_lamp_has_no_place():
    scene("internal").check_places(np.array([[500.0, 500.0]]))
    scene().check_places(np.array([[0.0, 0.0], [39.0, 39.0]]))


def test_star_beside_the_image_leaves_no_files(tmp_path):
    charis = instruments.get("charis")
    frames = half_wave_plate_cycles(hwp=[0, 45] * u.deg)
    frames["parallactic"], frames["altitude"] = 10 * u.deg, 60 * u.deg
    with pytest.raises(ParameterError, match="the star in the right beam is at"):
        simulate_cubes(
            tmp_path, charis.on_sky(charis.published()), charis, frames, source="star",
            image=ImageModel(centre=(190.0, 85.0)),
        )  # fmt: skip
    assert list(tmp_path.iterdir()) == []


# ---- detector ------------------------------------------------------------------------


def detector(**options):
    return ReadOut(**{"gain": 2.0, "read_noise": 6.0} | options)


def test_noise_has_the_variance_that_the_weights_state():
    for excess in [1.0, np.sqrt(2)]:
        light = np.full((4, 200, 200), 45.0)
        how = detector(excess_noise=excess)
        image, weight = expose(light, how, 1.0, np.random.default_rng(3))
        # F^2 light / gain + (read noise / gain)^2
        expected = excess**2 * 45.0 / 2.0 + 9.0
        assert 1 / weight.mean() == pytest.approx(expected, rel=1e-5), excess
        assert image.var() == pytest.approx(expected, rel=0.02), excess
        assert image.mean() == pytest.approx(45.0, rel=1e-3), excess


def test_without_noise_the_image_is_the_light_and_saturation_cuts_it():
    light = np.array([[[5.0, 15.0, 105.0]]])
    image, weight = expose(light, detector(saturation=50.0), 1.0, None)
    assert image.tolist() == [[[5.0, 15.0, 50.0]]]
    assert (weight > 0).all()
    assert image.dtype == weight.dtype == np.float32


def test_pixels_differ_by_their_response():
    response = np.array([[[0.5, 1.0, 0.0]]])
    image, weight = expose(np.full((1, 1, 3), 10.0), detector(read_noise=0.0), response, None)
    assert image.tolist() == [[[5.0, 10.0, 0.0]]]
    # no light and no read noise: nothing is known of the variance
    assert weight[0, 0, 2] == 0.0
