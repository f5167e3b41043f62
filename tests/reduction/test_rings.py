# Licensed under a 3-clause BSD style license - see LICENSE
"""Rings around a star: which pixels they have, their means, and what two radii stand for."""

from dataclasses import replace

import numpy as np
import pytest

from astropolcal.instruments.layout import FileLayout
from astropolcal.reduction.photometry import Photometry
from astropolcal.reduction.wings import Star, rings_of

SHAPE = (81, 161)
OPEN = FileLayout({}, (3, *SHAPE), star_offset=(80.0, 0.0))
# the field of each beam is 61 x 61 pixels around its middle
STOPPED = replace(OPEN, internal_apertures=((40.0, 40.0), (120.0, 40.0), 61.0, 61.0, 0.0))


def star(image, layout=OPEN, *, good=None, radius=8.0, width=4.0, failed=()):
    """Return a star whose slices all have the same image."""
    n = 3
    cube = np.repeat(image[None], n, axis=0)
    photometry = Photometry.empty(n)
    photometry.x[:], photometry.y[:] = [[120.0], [40.0]], 40.0
    photometry.radius[:], photometry.fwhm[:] = radius, width
    photometry.flux[:] = [[100.0], [50.0]]
    for k in failed:
        photometry.flag(np.arange(n) == k, "saturated")
    good = np.ones(cube.shape, dtype=bool) if good is None else good
    return Star(cube, good, photometry, np.zeros((2, n)), layout)


def distance(x, y=40.0):
    rows, columns = np.indices(SHAPE)
    return np.hypot(columns - x, rows - y)


def test_without_a_stop_a_pixel_belongs_to_the_nearer_image():
    known = star(np.zeros(SHAPE))
    assert not known.stopped
    np.testing.assert_array_equal(known.lit[0], distance(120.0) < distance(40.0))
    assert not (known.lit[0] & known.lit[1]).any()


def test_with_a_stop_whole_pixels_inside_are_lit():
    known = star(np.zeros(SHAPE), STOPPED)
    assert known.stopped
    assert known.lit.sum(axis=(1, 2)).tolist() == [61 * 61] * 2
    assert known.lit[1, 10:71, 10:71].all()


def test_failed_slices_are_left_out():
    known = star(np.zeros(SHAPE), failed=[1])
    assert known.usable.tolist() == [0, 2]
    assert known.x.tolist() == [-1.0, 1.0]
    assert known.flux.tolist() == [[100.0, 100.0], [50.0, 50.0]]
    assert star(np.zeros(SHAPE), failed=[0, 1]).x.tolist() == [0.0]


def test_mean_of_a_smooth_profile_is_that_at_two_radii():
    """Rings of a pixel's width, with the mean and scatter of the distances of their pixels."""
    profile = 1e3 * (1 + (distance(120.0) / 6) ** 2) ** -2.0
    rings = rings_of(star(profile), outer=30)
    seen = rings.values[0, 0]
    two = 1e3 * (1 + (rings.own[:, 0, 0] / 6) ** 2) ** -2.0
    np.testing.assert_allclose(two.mean(axis=0), seen, rtol=2e-3)
    # a single radius would be clearly worse
    one = 1e3 * (1 + (rings.own[:, 0, 0].mean(axis=0) / 6) ** 2) ** -2.0
    assert np.abs(one / seen - 1).max() > 3 * np.abs(two.mean(axis=0) / seen - 1).max()


def test_counts_are_the_areas_of_rings():
    rings = rings_of(star(np.zeros(SHAPE)), outer=35)
    radius = rings.own[:, 0, 0].mean(axis=0)
    np.testing.assert_allclose(rings.counts[0, 0], 2 * np.pi * radius, rtol=0.25)
    assert rings.counts[0, 0].sum() == pytest.approx(np.pi * (35**2 - 4**2), rel=0.01)
    assert np.all(np.diff(radius) == pytest.approx(1.0, abs=0.1))


def test_rings_begin_in_the_wings():
    """At 1.2 full widths, but never beyond the aperture."""
    for width, radius, first in ((4.0, 8.0, 4.0), (10.0, 8.0, 8.0), (10.0, 30.0, 12.0)):
        rings = rings_of(star(np.zeros(SHAPE), width=width, radius=radius), outer=35)
        assert np.floor(rings.own[:, 0, 0, 0].mean()) == first


def test_bad_pixels_do_not_count():
    image = np.full(SHAPE, 7.0)
    good = np.ones((3, *SHAPE), dtype=bool)
    image[40, 130], good[:, 40, 130] = 1e6, False
    full, fewer = (rings_of(star(image, good=g), outer=20) for g in (None, good))
    np.testing.assert_allclose(fewer.values, 7.0)
    assert (full.counts - fewer.counts).sum() == 3


def test_distance_of_the_other_image_matters_without_a_stop_only():
    for layout in [OPEN, STOPPED]:
        rings = rings_of(star(np.zeros(SHAPE), layout), outer=20)
        assert (rings.other is None) == (layout is STOPPED), layout
        if rings.other is not None:
            # the images are 80 pixels apart
            np.testing.assert_allclose(rings.other.mean(axis=0)[0, 0], 80.0, atol=3.0)


def test_too_few_rings_are_none():
    assert rings_of(star(np.zeros(SHAPE)), outer=10) is None
    good = np.zeros((3, *SHAPE), dtype=bool)
    assert rings_of(star(np.zeros(SHAPE), good=good), outer=30) is None


def test_aperture_that_reaches_out_of_the_field_lists_its_dark_pixels():
    image = np.full(SHAPE, 2.0)
    inside = star(image, STOPPED, radius=30.0)
    assert inside.unlit == []
    assert inside.unlit_part == 0.0
    beyond = star(image, STOPPED, radius=35.0)
    assert len(beyond.unlit) == 6
    beam, k, r, weights, light = beyond.unlit[0]
    assert (beam, k) == (0, 0)
    # beyond the edge of the field, half of 61 pixels from the star
    assert r.min() > 30.0
    assert r.max() < 36.0
    assert light == pytest.approx(2.0 * weights.sum())
    # four caps of a circle of 35 beyond lines at 30.5
    cap = 35**2 * np.arccos(30.5 / 35) - 30.5 * np.sqrt(35**2 - 30.5**2)
    assert weights.sum() == pytest.approx(4 * cap, rel=0.02)
    assert beyond.unlit_part == pytest.approx(4 * cap / (np.pi * 35**2), rel=0.02)


def test_width_is_smooth_over_the_slices():
    known = star(np.zeros(SHAPE))
    assert known.width == pytest.approx([4.0] * 3)
    assert known.radius.tolist() == [8.0] * 3
    assert known.places.shape == (2, 2, 3)
