# Licensed under a 3-clause BSD style license - see LICENSE
"""A star in both beams, and why there is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reduction_lab import star_image

from astropolcal.reduction.stars import find_star

SHAPE, OFFSET = (60, 90), (40.0, 12.0)


def image(*places, noise=1.0, seed=0, **options):
    """Return stars on noise."""
    rng = np.random.default_rng(seed)
    smooth = star_image(places, shape=SHAPE, flux=4e3, fwhm=4.0, background=0.0, **options)
    return smooth + noise * rng.standard_normal(SHAPE)


def both(x=20.0, y=20.0, factor=1.0):
    return [(x, y, factor), (x + OFFSET[0], y + OFFSET[1], factor)]


def found(array, good=None, **options):
    good = np.isfinite(array) if good is None else good
    return find_star(array, good, (OFFSET, (0.0, 0.0)), **options)


@settings(max_examples=20)
@given(st.floats(10, 40), st.floats(10, 38), st.floats(-50, 50))
def test_right_image_comes_first_within_a_pixel(x, y, level):
    pair = found(image(*both(x, y)) + level)
    assert pair.reason == ""
    np.testing.assert_allclose(pair.positions, [[x + 40, y + 12], [x, y]], atol=1.0)
    # of the smoothed image: the width and that of the smoothing in quadrature
    assert pair.fwhm == pytest.approx(np.hypot(4.0, 2.0), rel=0.15)


def test_reason():
    for places, reason in [
        ([], "no star"),
        ([(20.0, 20.0)], "one beam missing"),
        # at another offset than that of the beams
        ([(20.0, 20.0), (60.0, 40.0)], "one beam missing"),
        (both() + both(35.0, 35.0, 0.5), "two stars"),
        (both() + both(35.0, 35.0, 0.05), ""),
        # far brighter than the pair, which is then a ghost
        ([*both(factor=0.1), (12.0, 45.0, 8.0)], "one beam missing"),
    ]:
        assert found(image(*places)).reason == reason, (places, reason)


# photutils says so, too
@pytest.mark.filterwarnings("ignore:No local peaks")
def test_light_below_zero_in_a_corner_is_no_star():
    array = image() - 1e3
    array[:4, :4] += 100.0
    assert found(array).reason == "no star"


def test_how_bright_a_companion_may_be():
    for companion, reason in [(0.3, "two stars"), (0.7, "")]:
        array = image(*both(), *both(35.0, 35.0, 0.5))
        assert found(array, companion=companion).reason == reason, (companion, reason)


def test_offset_may_be_wrong_by_the_tolerance():
    for shift, reason in [(3.0, ""), (6.0, "one beam missing")]:
        array = image((20.0, 20.0), (20.0 + 40.0 + shift, 32.0))
        assert found(array).reason == reason, (shift, reason)


def test_the_brightest_peak_near_a_place_is_the_star():
    """A fainter companion is not taken for it, even where the beams moved so that it is nearer."""
    narrow = {"shape": SHAPE, "fwhm": 1.5, "background": 0.0}
    for shift in (0.0, 3.5):
        star, x = (20.0, 20.0, 1.0), 60.0 - shift
        places = [star, (23.0, 20.0, 0.4), (x, 32.0, 1.0), (x + 3.0, 32.0, 0.4)]
        array = star_image(places, flux=4e3, **narrow)
        array += np.random.default_rng(0).standard_normal(SHAPE)
        pair = found(array, fwhm=1.5)
        np.testing.assert_allclose(pair.positions, [[x, 32.0], star[:2]], atol=1.0)
        # a hot pixel between the star and its place is none, where it is known
        hot = np.zeros(SHAPE, dtype=bool)
        hot[32, 63] = True
        pair = found(np.where(hot, 1e5, array), ~hot, fwhm=1.5)
        np.testing.assert_allclose(pair.positions, [[x, 32.0], star[:2]], atol=1.0)


def test_faint_star_is_found_only_if_it_is_significant():
    # smoothing leaves about a quarter of the noise of a pixel
    assert found(image(*both(factor=0.02), noise=1.0)).reason == ""
    assert found(image(*both(factor=0.002), noise=1.0)).reason == "no star"


def test_bright_bad_pixels_are_no_star():
    array = image(*both())
    good = np.ones(SHAPE, dtype=bool)
    array[50, 10], good[50, 10] = 1e6, False
    array[48, 50], good[48, 50] = np.nan, False
    np.testing.assert_allclose(found(array, good).positions, [[60, 32], [20, 20]], atol=1.0)


def test_even_image_has_no_star():
    for array in [np.zeros(SHAPE), np.full(SHAPE, 7.0)]:
        pair = found(array)
        assert pair.reason == "no star", array
        assert not pair.positions.any(), array


def test_nothing_known_has_no_star():
    assert found(image(*both()), np.zeros(SHAPE, dtype=bool)).reason == "no star"


def test_image_without_noise_is_no_trouble():
    assert found(image(*both(), noise=0.0)).reason == ""


def test_two_peaks_of_one_image_are_one_star():
    """A double core closer than twice the width is not another star."""
    array = image(*both(), *both(25.0, 20.0, 0.9))
    assert found(array).reason == ""
