# Licensed under a 3-clause BSD style license - see LICENSE
"""Photometry of both sources against known fluxes; every flag made to happen."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import fitting, models
from hypothesis import given, settings
from hypothesis import strategies as st
from photutils.aperture import CircularAperture, aperture_photometry
from reduction_lab import Small, expose, pair, star_image

from astropolcal.exceptions import InstrumentError, ObservationError, ParameterError
from astropolcal.reduction.cubes import moffat
from astropolcal.reduction.photometry import (
    detector_of,
    measure_internal,
    rectangles,
    shared_pixels,
)
from astropolcal.reduction.stars import find_star, fit_gaussians, growth_radius, measure_stars

LAYOUT = Small.files
DETECTOR = detector_of(LAYOUT)


# --- internal source -------------------------------------------------------------


def test_rectangles_have_the_stated_area_and_do_not_overlap():
    right, left = rectangles(LAYOUT.internal_apertures, (201, 201))
    both = np.zeros((201, 201))
    for rows, columns, weights in (right, left):
        both[rows, columns] += weights
        assert weights.sum() == pytest.approx(44.48 * 112.38, rel=1e-4)
    assert both.max() == pytest.approx(1.0)
    # the right beam is the one at larger x
    assert right[1].start > left[1].start


def test_rectangle_outside_the_image():
    with pytest.raises(InstrumentError, match="leaves the image"):
        rectangles(LAYOUT.internal_apertures, (100, 100))


def test_flat_field_is_unbiased_with_honest_errors():
    cube = expose(np.full((201, 201), 500.0), LAYOUT, seed=3, n_wavelengths=60)
    result = measure_internal(cube, None, DETECTOR, LAYOUT)
    true = 500.0 * 44.48 * 112.38
    assert result.flux.mean() == pytest.approx(true, rel=1e-4)
    pulls = (result.flux - true) / np.sqrt(result.variance)
    assert abs(pulls.mean()) < 0.35
    assert pulls.std() == pytest.approx(1.0, abs=0.2)
    assert not result.failed.any()


def test_masked_pixels_are_corrected_by_area(flat_cube):
    rng = np.random.default_rng(5)
    good = rng.random(flat_cube.shape) > 0.05
    whole = measure_internal(flat_cube, None, DETECTOR, LAYOUT)
    some = measure_internal(np.where(good, flat_cube, np.nan), good, DETECTOR, LAYOUT)
    np.testing.assert_allclose(some.flux, whole.flux, rtol=2e-3)
    assert (some.variance > whole.variance).all()
    assert not some.failed.any()


def test_pixels_without_a_value_are_as_bright_as_those_around():
    """By area alone the fluxes were off by five of their errors, where the lamp is uneven."""
    y, x = np.indices((201, 201))
    uneven = 500.0 * (1 + 0.4 * (x / 201 - 0.5) + 0.2 * np.sin(y / 22))
    uneven *= 1 + 0.1 * np.random.default_rng(9).standard_normal(uneven.shape)
    inside = rectangles(LAYOUT.internal_apertures, uneven.shape)
    true = np.array([(uneven[rows, columns] * w).sum() for rows, columns, w in inside])
    for n_wavelengths in (1, 4):
        pulls = []
        for seed in range(12):
            cube = expose(uneven, LAYOUT, seed=seed, n_wavelengths=n_wavelengths)
            rng, good = np.random.default_rng(seed), np.ones(cube.shape, dtype=bool)
            for row, column in rng.integers(0, 195, (60, 2)):
                good[:, row : row + 6, column : column + 6] = False
            found = measure_internal(cube, good, DETECTOR, LAYOUT)
            pulls.append((found.flux - true[:, None]) / np.sqrt(found.variance))
        # those of one cube have the same pixels, and so the same error, at all wavelengths
        assert np.sqrt(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=0.3)


def test_internal_flags(flat_cube):
    cube, good = flat_cube.copy(), np.ones(flat_cube.shape, dtype=bool)
    good[0, 80:120, 60:140] = False
    cube[1, 90, 75] = LAYOUT.saturation + 1
    cube[2] = -1.0
    reasons = measure_internal(cube, good, DETECTOR, LAYOUT).reasons
    assert reasons == ["left aperture masked", "saturated", "no light", ""]


def test_single_pixels_far_off_their_neighbours_are_left_out():
    """One of a slice and one in all slices, also where others have no value."""
    for value in [39_000.0, 5 * 3000.0, -20_000.0]:
        for level in [5.0, 130.0, 3000.0]:
            clean = expose(np.full((201, 201), level), LAYOUT, seed=4)
            whole = measure_internal(clean, None, DETECTOR, LAYOUT)
            for beam, (rows, columns, weights) in enumerate(
                rectangles(LAYOUT.internal_apertures, (201, 201))
            ):
                direct = (clean[:, rows, columns] * weights).sum(axis=(1, 2), dtype=float)
                np.testing.assert_allclose(whole.flux[beam], direct, rtol=1e-6)
            assert whole.outliers == 0, (level, value)
            hot = clean.copy()
            hot[1, 90, 75] = hot[:, 120, 131] = value
            good = np.random.default_rng(5).random(clean.shape) > 0.02
            for known in (None, good | (hot != clean)):
                found = measure_internal(hot, known, DETECTOR, LAYOUT)
                assert found.outliers == 1 + len(clean), (level, value)
                expected = measure_internal(clean, known, DETECTOR, LAYOUT)
                # within 0.1 %, or a tenth of what noise does
                error = np.abs(found.flux - expected.flux)
                assert (
                    error < np.maximum(1e-3 * expected.flux, 0.1 * np.sqrt(expected.variance))
                ).all(), (level, value)
                assert not found.failed.any(), (level, value)


def test_structure_of_the_light_is_not_left_out():
    """Stars of three pixels, slopes, the pattern of lenslets, and single multiplied electrons."""
    y, x = np.indices((201, 201))
    rng = np.random.default_rng(6)
    star = star_image(pair(LAYOUT), fwhm=3.0)
    images = [star, 10.0 + x * y / 20, 400.0 * (1 + 0.2 * rng.standard_normal(star.shape))]
    cubes = [expose(image, LAYOUT, seed=7) for image in images]
    layout = replace(
        LAYOUT, keywords=LAYOUT.keywords | {"em_gain": "EMGAIN"}, gain=4.5, read_noise=90.0
    )
    multiplied = detector_of(layout, values={"em_gain": 300.0})
    electrons = rng.poisson(0.05, (4, 201, 201))
    counted = rng.gamma(np.maximum(electrons, 1e-12)) / multiplied.gain
    noise = multiplied.read_noise * rng.standard_normal(counted.shape)
    for cube, detector in [*((cube, DETECTOR) for cube in cubes), (counted + noise, multiplied)]:
        assert measure_internal(cube, None, detector, LAYOUT).outliers == 0


def test_background_outside_the_beams_and_what_it_lets_them_share():
    image = np.full((201, 201), 40.0)
    for rows, columns, weights in rectangles(LAYOUT.internal_apertures, (201, 201)):
        image[rows, columns] += 300.0 * weights
    cube = expose(image, LAYOUT, seed=1)
    result = measure_internal(cube, None, DETECTOR, LAYOUT, background="outside")
    # the light of the edge pixels counts with the square of their weights here
    np.testing.assert_allclose(result.flux, 300.0 * 44.48 * 112.38, rtol=0.02)
    np.testing.assert_allclose(result.background, 40.0, rtol=0.02)
    assert (result.covariance > 0).all()
    assert (result.covariance < result.variance.min(axis=0)).all()


def test_internal_options_are_checked(flat_cube):
    with pytest.raises(ParameterError, match="background"):
        measure_internal(flat_cube, None, DETECTOR, LAYOUT, background="sky")
    with pytest.raises(ParameterError, match="max_masked"):
        measure_internal(flat_cube, None, DETECTOR, LAYOUT, max_masked=1.0)


# --- Gaussians -------------------------------------------------------------------


def test_fit_agrees_with_astropy():
    rng = np.random.default_rng(2)
    y, x = np.indices((25, 25))
    images = []
    for _ in range(4):
        model = models.Gaussian2D(
            900, *rng.uniform(11, 13, 2), *rng.uniform(1.5, 3.0, 2), theta=rng.uniform(0, 3)
        )
        images.append(model(x, y) + 12.0 + rng.normal(0, 4, x.shape))
    fits = fit_gaussians(np.array(images), np.ones((len(images), 25, 25), bool), x=12, y=12, fwhm=5)
    assert fits.converged.all()
    for k, image in enumerate(images):
        start = models.Gaussian2D(800, 12, 12, 2, 2.2) + models.Const2D(0)
        theirs = fitting.TRFLSQFitter()(start, x, y, image)
        assert fits.x[k] == pytest.approx(theirs.x_mean_0.value, abs=1e-3)
        assert fits.y[k] == pytest.approx(theirs.y_mean_0.value, abs=1e-3)
        width = np.sqrt(theirs.x_stddev_0.value * theirs.y_stddev_0.value) * 2.354820045
        assert fits.fwhm[k] == pytest.approx(width, rel=1e-3)
        assert fits.background[k] == pytest.approx(theirs.amplitude_1.value, abs=0.05)
        np.testing.assert_allclose(fits.image(k, x, y), theirs(x, y), atol=0.5)


@settings(max_examples=25)
@given(dx=st.floats(-2, 2), dy=st.floats(-2, 2), fwhm=st.floats(2.5, 8))
def test_fit_finds_what_was_put_in(dx, dy, fwhm):
    y, x = np.indices((31, 31))
    sigma = fwhm / 2.354820045
    image = 50 * np.exp(-((x - 15 - dx) ** 2 + (y - 15 - dy) ** 2) / (2 * sigma**2)) - 3
    fits = fit_gaussians(image[None], np.isfinite(image)[None], x=15, y=15, fwhm=5)
    assert fits.x[0] == pytest.approx(15 + dx, abs=1e-3)
    assert fits.y[0] == pytest.approx(15 + dy, abs=1e-3)
    assert fits.fwhm[0] == pytest.approx(fwhm, rel=1e-3)
    assert fits.elongation[0] == pytest.approx(1.0, abs=1e-3)


def test_fit_ignores_bad_pixels():
    image = star_image([(12, 12)], flux=1e4, shape=(25, 25))
    spoiled, good = image.copy(), np.ones(image.shape, dtype=bool)
    good[12, 13] = False
    spoiled[12, 13] = np.nan
    fits = fit_gaussians(spoiled[None], good[None], x=12, y=12, fwhm=5)
    assert (fits.x[0], fits.y[0]) == pytest.approx((12, 12), abs=1e-4)


# --- stars -----------------------------------------------------------------------


def test_star_is_unbiased_with_honest_errors():
    cube = expose(star_image(pair(LAYOUT)), LAYOUT, seed=7, n_wavelengths=80)
    result = measure_stars(cube, None, DETECTOR, LAYOUT)
    assert not result.failed.any()
    assert result.flux.mean() == pytest.approx(2e5, rel=1e-3)
    pulls = (result.flux - 2e5) / np.sqrt(result.variance)
    assert abs(pulls.mean()) < 0.3
    assert pulls.std() == pytest.approx(1.0, abs=0.15)
    np.testing.assert_allclose(result.x[1], 70.3, atol=0.05)
    np.testing.assert_allclose(result.y[0], 85.2 + LAYOUT.star_offset[1], atol=0.05)
    np.testing.assert_allclose(result.fwhm, 5.0, rtol=0.02)
    np.testing.assert_allclose(result.radius, 15.0, rtol=0.02)
    # both beams have the same aperture
    np.testing.assert_array_equal(result.radius[0], result.radius[1])


def test_star_agrees_with_photutils(star_cube):
    result = measure_stars(star_cube, None, DETECTOR, LAYOUT)
    for beam in range(2):
        place = (result.x[beam, 0], result.y[beam, 0])
        aperture = CircularAperture(place, result.radius[beam, 0])
        total = aperture_photometry(star_cube[0].astype(float), aperture)["aperture_sum"][0]
        expected = total - result.background[beam, 0] * aperture.area
        assert result.flux[beam, 0] == pytest.approx(expected, rel=1e-9)


def test_radius_has_the_papers_limit():
    image = star_image(pair(LAYOUT), flux=5e6, fwhm=16.0)
    result = measure_stars(expose(image, LAYOUT), None, DETECTOR, LAYOUT, max_radius=40.0)
    np.testing.assert_allclose(result.radius, 40.0)
    # the two circles overlap, so the beams share pixels
    assert (result.covariance > 0).all()


def test_radius_by_growth(star_cube):
    fixed = measure_stars(star_cube, None, DETECTOR, LAYOUT, radius=3.0)
    whole = measure_stars(star_cube, None, DETECTOR, LAYOUT, radius="growth", max_radius=25.0)
    sigma = 5.0 / 2.354820045
    share = 1 - np.exp(-(3.0**2) / (2 * sigma**2))
    assert fixed.flux.mean() == pytest.approx(2e5 * share, rel=0.05)
    assert whole.radius.mean() == pytest.approx(sigma * np.sqrt(2 * np.log(100)), rel=0.1)


@pytest.mark.slow
def test_aperture_correction_has_the_error_of_its_factor():
    # light, noise and aperture such that the error of the factor is most of all
    errors, offsets, both = [], [], []
    for seed in range(20):
        cube = expose(star_image(pair(LAYOUT), flux=4e5), LAYOUT, seed=seed)
        result = measure_stars(cube, None, DETECTOR, LAYOUT, aperture_correction=True)
        total = result.flux.sum(axis=0)
        errors.append(np.sqrt(result.variance.sum(axis=0) + 2 * result.covariance))
        offsets.append(total - 8e5)
        both.append(result.covariance / np.sqrt(result.variance.prod(axis=0)))
    pulls = np.array(offsets) / errors
    assert abs(pulls.mean()) < 0.4
    assert pulls.std() == pytest.approx(1.0, abs=0.2)
    assert 0.2 < np.mean(both) < 0.95
    assert (result.scale_err > 0).all()


def test_aperture_correction_is_not_misled_by_the_other_beam():
    """Wings as steep as those of a Moffat profile, on both images, without a field stop."""
    y, x = np.indices((201, 201))
    core = 5.0 / (2 * np.sqrt(2 ** (1 / 3) - 1))
    image = np.full((201, 201), 20.0)
    for x0, y0, _ in pair(LAYOUT):
        squares = (x - x0) ** 2 + (y - y0) ** 2
        image += 2e5 * 2 / (np.pi * core**2) * (1 + squares / core**2) ** -3.0
    cube = np.repeat(image[None], 4, axis=0)
    plain = measure_stars(cube, None, DETECTOR, LAYOUT)
    corrected = measure_stars(cube, None, DETECTOR, LAYOUT, aperture_correction=True)
    np.testing.assert_allclose(plain.flux, 2e5, rtol=0.02)
    assert (plain.flux < 0.99 * 2e5).all()
    np.testing.assert_allclose(corrected.flux, 2e5, rtol=1e-3)


def test_single_pixels_about_a_star_are_left_out_as_far_as_no_star_is_so_sharp(star_cube):
    clean = measure_stars(star_cube, None, DETECTOR, LAYOUT)
    assert clean.outliers == 0
    for x, y, value in ((78, 90, 3000.0), (134, 118, 20_000.0), (70, 95, -2000.0)):
        cube = star_cube.copy()
        cube[1, y, x] += value
        found = measure_stars(cube, None, DETECTOR, LAYOUT)
        assert found.outliers == 1, (x, y)
        off = (found.flux - clean.flux) / np.sqrt(clean.variance)
        assert np.abs(off).max() < 1, (x, y)
    # a full pixel may be one of the star
    cube[1, 90, 78] = 50_000.0
    assert measure_stars(cube, None, DETECTOR, LAYOUT).reasons[1] == "saturated"
    for fwhm in (1.5, 2.2, 3.0, 12.0):
        for x, flux in ((70.0, 1e4), (70.0, 1e5), (70.5, 1e5)):
            image = star_image(pair(LAYOUT, x=x), flux=flux, fwhm=fwhm)
            found = measure_stars(expose(image, LAYOUT, seed=4), None, DETECTOR, LAYOUT)
            assert found.outliers == 0, (fwhm, x, flux)


def test_pixels_without_values_are_filled(star_cube):
    rng = np.random.default_rng(4)
    good = rng.random(star_cube.shape) > 0.01
    whole = measure_stars(star_cube, None, DETECTOR, LAYOUT)
    some = measure_stars(np.where(good, star_cube, np.nan), good, DETECTOR, LAYOUT)
    assert not some.failed.any()
    np.testing.assert_allclose(some.flux, whole.flux, rtol=3e-3)


def flags_of(image, good=None, **options):
    cube = image if image.ndim == 3 else expose(image, LAYOUT, seed=11)
    return measure_stars(cube, good, DETECTOR, LAYOUT, **options).reasons


def test_flag_no_star():
    assert set(flags_of(star_image([]))) == {"no star"}


def test_flag_two_stars():
    places = pair(LAYOUT) + pair(LAYOUT, 45.0, 60.0, 0.5)
    assert set(flags_of(star_image(places))) == {"two stars"}
    # a faint one does not spoil the frame
    places = pair(LAYOUT) + pair(LAYOUT, 45.0, 60.0, 0.03)
    assert set(flags_of(star_image(places))) == {""}


def test_flag_one_beam_missing():
    assert set(flags_of(star_image(pair(LAYOUT)[:1]))) == {"one beam missing"}


def test_flag_one_beam_missing_in_a_slice(star_cube):
    cube = star_cube.copy()
    cube[2] = expose(star_image(pair(LAYOUT)[:1]), LAYOUT, seed=1, n_wavelengths=1)[0]
    assert flags_of(cube) == ["", "", "right beam missing", ""]


def test_flag_edge():
    assert set(flags_of(star_image(pair(LAYOUT, 12.0, 85.0)))) == {"edge"}


def test_flag_saturated(star_cube):
    cube = star_cube.copy()
    cube[1, 85, 70] = LAYOUT.saturation
    assert flags_of(cube) == ["", "saturated", "", ""]


def test_each_beam_is_saturated_where_its_own_detector_is(star_cube):
    # the star of the right beam is a quarter as bright
    cube = np.where(np.arange(star_cube.shape[2]) < 100, star_cube, star_cube / 4)
    brightest = cube.max()
    for left, flag in [(2 * brightest, ""), (brightest / 2, "saturated")]:
        own = replace(DETECTOR, saturation=left)
        both = replace(DETECTOR, saturation=brightest / 2, left=own)
        assert set(measure_stars(cube, None, both, LAYOUT).reasons) == {flag}, left


def test_flag_lost_star_and_empty_slice(star_cube):
    cube = star_cube.copy()
    cube[0] = expose(star_image([]), LAYOUT, seed=2, n_wavelengths=1)[0]
    good = np.ones(cube.shape, dtype=bool)
    good[3] = False
    assert flags_of(cube, good) == ["lost star", "", "", "empty slice"]


def test_flag_bad_centroid():
    cube = expose(star_image(pair(LAYOUT)), LAYOUT, n_wavelengths=6)
    moved = star_image([(75.5, 85.2), (70.3 + 63.5, 85.2 + 33.1)])
    cube[3] = expose(moved, LAYOUT, seed=9, n_wavelengths=1)[0]
    assert flags_of(cube) == ["", "", "", "bad centroid", "", ""]


def test_flag_masked_aperture(star_cube):
    good = np.ones(star_cube.shape, dtype=bool)
    good[1, 88:96, 60:82] = False
    assert flags_of(star_cube, good) == ["", "aperture masked", "", ""]


def test_pixels_of_the_core_that_lack_a_value_are_as_uncertain_as_the_light_they_had():
    """A Moffat core is no Gaussian, so that what fills a pixel is off by more than its noise."""
    box = tuple(slice(0, size) for size in LAYOUT.shape[1:])
    left, right = (moffat(box, place[:2], 5.0, 3.0) for place in pair(LAYOUT))
    cube = expose(1e6 * (right + 0.8 * left) + 20.0, LAYOUT)
    whole = measure_stars(cube, None, DETECTOR, LAYOUT)
    y, x = np.unravel_index(np.argmax(left), left.shape)
    for lost in ([0], [0, 1]):
        good = np.ones(cube.shape, dtype=bool)
        good[:, y, np.add(x, lost)] = False
        found = measure_stars(np.where(good, cube, np.nan), good, DETECTOR, LAYOUT)
        # far more than what the noise of the other pixels leaves
        own = np.sqrt(np.maximum(found.variance - whole.variance, 0.0)[1])
        assert np.all(np.abs(found.flux - whole.flux)[1] < 2.5 * own), lost
        assert np.all(np.sqrt(found.variance[1]) < 4 * np.sqrt(whole.variance[1])), lost
    # a per cent of the aperture, but much more of its light
    good[:, y - 1 : y + 2, x - 1 : x + 2] = False
    assert set(flags_of(cube, good)) == {"aperture masked"}


def test_flag_no_background(star_cube):
    y, x = np.indices(star_cube.shape[1:])
    distance = np.min([np.hypot(x - x0, y - y0) for x0, y0, _ in pair(LAYOUT)], axis=0)
    known = np.broadcast_to(distance < 15.1, star_cube.shape)
    cut = np.where(known, star_cube, np.nan)
    assert set(flags_of(cut, known, radius=14.0)) == {""}
    assert set(flags_of(cut, known, radius=15.0)) == {"no background"}


def test_flag_no_aperture_correction():
    image = star_image(pair(LAYOUT, 40.0, 85.0))
    assert set(flags_of(image)) == {""}
    assert set(flags_of(image, aperture_correction=True)) == {"no aperture correction"}


def test_star_options_are_checked(star_cube):
    for options in (
        {"radius": "best"},
        {"radius": 0.0},
        {"factor": -1.0},
        {"annulus": 0.0},
        {"companion": 1.5},
        {"max_masked": -0.1},
        {"aperture_correction": "wings"},
    ):
        with pytest.raises(ParameterError, match=next(iter(options))):
            measure_stars(star_cube, None, DETECTOR, LAYOUT, **options)


def test_pair_has_right_beam_first_and_prefers_the_bright_one():
    image = star_image(pair(LAYOUT) + pair(LAYOUT, 40.0, 50.0, 0.05))
    found = find_star(image, np.isfinite(image), (LAYOUT.star_offset, (0.0, 0.0)))
    np.testing.assert_allclose(found.positions[1], (70.3, 85.2), atol=0.6)
    np.testing.assert_allclose(found.positions[0] - found.positions[1], (63.5, 33.1), atol=1.0)
    assert found.fwhm == pytest.approx(5.0, rel=0.3)


def test_curve_of_growth_of_a_gaussian():
    image = star_image([(50, 50)], fwhm=6.0, shape=(101, 101))
    sigma = 6.0 / 2.354820045
    for fraction in (0.5, 0.99):
        expected = sigma * np.sqrt(-2 * np.log(1 - fraction))
        assert growth_radius(image, [(50, 50)], 30.0, fraction) == pytest.approx(expected, 0.05)
    with pytest.raises(ParameterError, match="no light"):
        growth_radius(np.zeros((101, 101)), [(50, 50)], 30.0)


# --- errors ----------------------------------------------------------------------


def test_detector_in_the_unit_of_the_header():
    for unit, seconds, gain, noise in [
        (None, None, 2.0, 5.0),
        ("adu", None, 2.0, 5.0),
        ("counts", None, 2.0, 5.0),
        ("electron", None, 1.0, 10.0),
        ("adu / s", 10.0, 20.0, 0.5),
        ("electron/s", 10.0, 10.0, 1.0),
    ]:
        detector = detector_of(LAYOUT, unit, {"exposure_time": seconds})
        assert detector.gain == pytest.approx(gain), (unit, seconds, gain, noise)
        assert detector.read_noise == pytest.approx(noise), (unit, seconds, gain, noise)
        # the same number of electrons, whatever the unit
        assert detector.saturation * detector.gain == pytest.approx(80000.0), (
            unit,
            seconds,
            gain,
            noise,
        )
        assert detector.unit.is_equivalent(u.adu) or unit not in (None, "adu", "counts"), (
            unit,
            seconds,
            gain,
            noise,
        )


def test_detector_refuses_other_units_and_rates_without_time():
    with pytest.raises(ObservationError, match="'Jy'"):
        detector_of(LAYOUT, "Jy")
    with pytest.raises(ObservationError, match="exposure time"):
        detector_of(LAYOUT, "adu/s")


def test_shared_pixels_are_the_lens_of_two_circles():
    y, x = np.indices((400, 400)) / 2.0
    both = (np.hypot(x - 80, y - 100) < 40) & (np.hypot(x - 120, y - 100) < 40)
    assert shared_pixels(40.0, 40.0, 1.0) == pytest.approx(both.sum() / 4, rel=0.01)
    assert shared_pixels(80.1, 40.0, 1.0) == 0.0
    assert shared_pixels(0.0, 10.0, 2.0) == pytest.approx(200 * np.pi)
