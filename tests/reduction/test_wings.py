# Licensed under a 3-clause BSD style license - see LICENSE
"""Light outside of the apertures: stars of many profiles come back with all of their flux."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reduction_lab import Small, expose, pair, star_image
from scipy.integrate import quad

from astropolcal.instruments import CHARIS
from astropolcal.instruments.layout import ReadOut
from astropolcal.reduction import cubes
from astropolcal.reduction import wings as module
from astropolcal.reduction.cubes import ImageModel, Scene
from astropolcal.reduction.photometry import Photometry, detector_of
from astropolcal.reduction.stars import measure_stars
from astropolcal.reduction.wings import wing_shares

N = 8
LAYOUT = replace(CHARIS.files, shape=(N, 201, 201))
DETECTOR = detector_of(LAYOUT)
#: Profile of the core, its full width and exponent, and the share of the halo.
PROFILES = {
    "Gaussian": ("gaussian", 4.0, 3.0, 0.0),
    "Gaussian, halo": ("gaussian", 4.0, 3.0, 0.05),
    "Moffat 2.5": ("moffat", 5.0, 2.5, 0.0),
    "Moffat 2.5, halo": ("moffat", 5.0, 2.5, 0.05),
    "Moffat 3 of many widths": ("moffat", np.linspace(4, 6, N), 3.0, 0.0),
    "Moffat 3, halo": ("moffat", 5.0, 3.0, 0.1),
    "Moffat 4.5": ("moffat", 5.0, 4.5, 0.0),
    "Moffat 4.5 of many widths, halo": ("moffat", np.linspace(3.5, 5, N), 4.5, 0.1),
}


def scene(psf, fwhm, beta, halo, *, layout=LAYOUT):
    """A star behind the field stop of CHARIS."""
    image = ImageModel(psf=psf, fwhm=fwhm, beta=beta, halo=halo)
    return Scene(image, layout, "star", layout.shape[0])


def exposure(stage, seed, *, noise=True, flux=5e5, background=5.0):
    """A cube of the star at another place and seeing in each, and its true fluxes."""
    rng, n = np.random.default_rng(seed), stage.shape[0]
    detector = ReadOut(LAYOUT.gain, LAYOUT.read_noise)
    true = flux / 2 * np.linspace(1.2, 0.8, n) * np.array([[1.01], [0.99]])
    place = stage.centre + rng.standard_normal(2)
    light = stage.light(true, place, np.exp(0.05 * rng.standard_normal()))
    return cubes.expose(light + background, detector, 1.0, rng if noise else None)[0], true


def pulls_of(profile, seeds, **options):
    stage, found = scene(*PROFILES[profile]), []
    for seed in seeds:
        cube, true = exposure(stage, seed, **options)
        result = measure_stars(cube, None, DETECTOR, LAYOUT, aperture_correction=True)
        assert not result.failed.any()
        found.append([(result.flux - true) / np.sqrt(result.variance), result.flux / true - 1])
    return np.moveaxis(found, 1, 0)


# --- all of the flux -------------------------------------------------------------


@pytest.mark.slow
def test_what_is_left_without_noise_is_far_below_the_errors():
    for profile in PROFILES:
        pulls, bias = pulls_of(profile, range(3), noise=False)
        assert abs(pulls.mean()) < 0.1, profile
        assert abs(bias.mean()) < 5e-4, profile


@pytest.mark.long
def test_fluxes_are_unbiased_with_honest_errors():
    """The error of the correction is common to a frame, so frames are what counts."""
    # of noise-free images those without a halo are better, as the test above shows
    for profile in (name for name in PROFILES if "halo" in name):
        pulls, bias = pulls_of(profile, range(1000, 1030))
        means, squares = pulls.mean(axis=(1, 2)), (pulls**2).mean(axis=(1, 2))
        # what may be wrong with the errors, and twice what 30 frames scatter by
        assert abs(means.mean()) < 0.1 + 2 * means.std() / np.sqrt(len(means)), profile
        assert abs(squares.mean() - 1) < 0.15 + 2 * squares.std() / np.sqrt(len(squares)), profile
        assert abs(bias.mean()) < 1e-3, profile


def test_without_it_the_wings_are_missing():
    """What the fluxes lack is not noise; a test of the tests above."""
    cube, true = exposure(scene(*PROFILES["Moffat 3, halo"]), 1)
    plain = measure_stars(cube, None, DETECTOR, LAYOUT)
    assert (plain.flux / true).max() < 0.92


def test_both_beams_have_the_same_factor():
    cube, _ = exposure(scene(*PROFILES["Moffat 2.5, halo"]), 5)
    plain = measure_stars(cube, None, DETECTOR, LAYOUT)
    found = measure_stars(cube, None, DETECTOR, LAYOUT, aperture_correction=True)
    np.testing.assert_allclose(found.flux, plain.flux * found.scale, rtol=1e-12)
    assert (found.scale > 1.02).all()
    assert (found.scale_err > 0).all()
    assert (found.covariance > 0).all()


def test_aperture_that_reaches_out_of_the_field_stop():
    """The stop cuts the aperture too; what it hides there is part of the correction."""
    cube, true = exposure(scene("moffat", 9.0, 3.0, 0.0), 3, noise=False, flux=2e6)
    plain = measure_stars(cube, None, DETECTOR, LAYOUT)
    found = measure_stars(cube, None, DETECTOR, LAYOUT, aperture_correction=True)
    assert plain.radius.min() > 25
    np.testing.assert_allclose(found.flux, true, rtol=3e-3)


def test_few_slices():
    for n in [1, 2, 3]:
        layout = replace(LAYOUT, shape=(n, 201, 201))
        cube, true = exposure(scene("moffat", 5.0, 3.0, 0.0, layout=layout), 2, flux=2e6)
        found = measure_stars(cube, None, DETECTOR, layout, aperture_correction=True)
        assert found.reasons == [""] * n, n
        pulls = (found.flux - true) / np.sqrt(found.variance)
        assert abs(pulls).max() < 4, n


def test_slices_that_failed_do_not_matter():
    cube, _ = exposure(scene(*PROFILES["Moffat 3, halo"]), 4)
    good = np.ones(cube.shape, dtype=bool)
    good[2] = False
    whole = measure_stars(cube, None, DETECTOR, LAYOUT, aperture_correction=True)
    rest = measure_stars(cube, good, DETECTOR, LAYOUT, aperture_correction=True)
    assert rest.reasons == ["", "", "empty slice", "", "", "", "", ""]
    known = ~rest.failed
    assert np.all(abs(rest.scale - whole.scale)[known] < 2 * whole.scale_err[known])
    assert (rest.flux[:, 2] == 0).all()


# --- without a field stop -----------------------------------------------------------


def open_field(beta, fwhm=5.0, flux=2e5):
    """Two stars of the same wings, whose images nothing cuts."""
    core = fwhm / (2 * np.sqrt(2 ** (1 / beta) - 1))
    y, x = np.indices((201, 201))
    image = np.full((201, 201), 20.0)
    for x0, y0, _ in pair(LAYOUT):
        squares = (x - x0) ** 2 + (y - y0) ** 2
        image += flux * (beta - 1) / (np.pi * core**2) * (1 + squares / core**2) ** -beta
    return np.repeat(image[None], 4, axis=0)


def test_wings_of_the_other_image():
    for beta in [2.0, 2.5, 3.0, 4.5]:
        layout = replace(Small.files, internal_apertures=())
        cube = open_field(beta)
        found = measure_stars(cube, None, DETECTOR, layout, aperture_correction=True)
        np.testing.assert_allclose(found.flux, 2e5, rtol=2e-3)


# --- too little is seen -----------------------------------------------------------


def reasons(image, layout=Small.files, **options):
    cube = expose(image, layout, seed=11)
    result = measure_stars(cube, None, DETECTOR, layout, aperture_correction=True, **options)
    return set(result.reasons)


def test_star_outside_of_the_rectangles_is_flagged():
    places = pair(LAYOUT, 40.0, 85.0)
    assert reasons(star_image(places)) == {"no aperture correction"}
    # without rectangles the whole image counts
    assert reasons(star_image(places), replace(Small.files, internal_apertures=())) == {""}


def test_too_few_rings_are_flagged():
    assert reasons(star_image(pair(LAYOUT)), max_radius=8.0) == {"no aperture correction"}
    narrow = replace(
        Small.files, internal_apertures=((70.3, 85.2), (133.8, 118.3), 14.0, 14.0, 0.0)
    )
    assert reasons(star_image(pair(LAYOUT)), narrow, factor=1.0) == {"no aperture correction"}


def test_nothing_usable_gives_nothing():
    result = Photometry.empty(2)
    result.flag(True, "no star")
    cube = np.ones((2, 201, 201))
    assert wing_shares(cube, cube > 0, result, np.zeros((2, 2)), DETECTOR, LAYOUT) is None


# --- the profiles themselves --------------------------------------------------------


@settings(max_examples=20)
@given(radius=st.floats(1, 20), t=st.floats(1e-3, 0.65), edge=st.floats(0, 60))
def test_light_beyond_a_circle_is_the_integral_of_the_profile(radius, t, edge):
    for own in ((radius, t), (radius, 1 / module.HALO_BETA)):
        inside, _ = quad(lambda r: 2 * np.pi * r * module._moffat(r, *own), 0, edge, limit=200)  # noqa: B023
        assert inside + module._beyond(edge, *own) == pytest.approx(1.0, abs=1e-6)


def test_flat_cores_become_gaussians():
    r = np.linspace(0, 10, 20)
    np.testing.assert_allclose(
        module._moffat(r, 3.0, 1e-6), np.exp(-(r**2) / 9) / (np.pi * 9), rtol=1e-4
    )
