# Licensed under a 3-clause BSD style license - see LICENSE
"""Cubes resampled at once give what scipy makes of each slice."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import affine_transform

from astropolcal.correction import geometry as _spline
from astropolcal.correction.geometry import derotate


@pytest.fixture(scope="module")
def cube():
    return np.random.default_rng(1).normal(size=(5, 34, 41))


def by_scipy(planes, matrix, offset, shape, order):
    settings = {"output_shape": shape, "order": order, "mode": "mirror"}
    return np.stack([affine_transform(plane, matrix, offset, **settings) for plane in planes])


@settings(max_examples=40)
@given(
    angle=st.floats(-7, 7), x=st.floats(-5, 45), y=st.floats(-5, 45), order=st.sampled_from([1, 3]),
    shape=st.tuples(st.integers(1, 60), st.integers(1, 60)),
)  # fmt: skip
def test_as_scipy_inside_the_image(angle, x, y, order, shape):
    planes = np.random.default_rng(1).normal(size=(5, 34, 41))
    matrix = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    offset = np.array([y, x]) - matrix @ [shape[0] / 2, shape[1] / 2]
    ours = _spline.resample(planes, matrix, offset, shape, order)
    theirs = by_scipy(planes, matrix, offset, shape, order)
    i, j = np.indices(shape)
    row, column = (line[0] * i + line[1] * j + o for line, o in zip(matrix, offset, strict=True))
    inside = (row >= 0) & (row <= 33) & (column >= 0) & (column <= 40)
    np.testing.assert_allclose(ours[:, inside], theirs[:, inside], atol=1e-11)


def test_blocks_of_rows_make_no_difference(cube, monkeypatch):
    whole = derotate(cube, 33 * u.deg)
    monkeypatch.setattr(_spline, "_BLOCK", 100)
    _spline._weights.cache_clear()
    np.testing.assert_array_equal(derotate(cube, 33 * u.deg), whole)


def test_slices_are_turned_as_single_images_are(cube):
    for order in range(6):
        together = derotate(cube, 70 * u.deg, order=order, centre=(12.3, 20.1))
        alone = np.stack(
            [derotate(image, 70 * u.deg, order=order, centre=(12.3, 20.1)) for image in cube]
        )
        np.testing.assert_allclose(together, alone, atol=1e-11)


def test_pixels_without_values_spoil_the_same_of_the_result(cube):
    for everywhere in [False, True]:
        holes = cube.copy()
        holes[slice(None) if everywhere else 2, 15, 20] = np.nan
        together = derotate(holes, 20 * u.deg)
        alone = np.stack([derotate(image, 20 * u.deg) for image in holes])
        np.testing.assert_array_equal(np.isnan(together), np.isnan(alone))
        np.testing.assert_allclose(together, alone, atol=1e-11)
        lost = np.isnan(together).sum(axis=(1, 2))
        assert lost[2] > lost[0] or everywhere, everywhere
