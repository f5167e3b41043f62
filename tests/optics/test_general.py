# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics known by their matrix alone: general element, depolarizer, parity flip, rotator."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ParameterError
from astropolcal.optics import (
    MuellerElement,
    ParityFlip,
    Rotator,
)

SEED = st.integers(0, 2**32 - 1)


# --- general element -------------------------------------------------------------------


@given(seed=SEED, per_wavelength=st.booleans())
def test_from_matrix_and_back(seed, per_wavelength):
    shape = (3, 4, 4) if per_wavelength else (4, 4)
    matrix = np.random.default_rng(seed).normal(size=shape)
    wavelength = [1.2, 1.6, 2.1] * u.um if per_wavelength else 1.6 * u.um
    element = MuellerElement.from_matrix(matrix, name="window", theta=0 * u.deg)
    np.testing.assert_allclose(element.mueller(wavelength), matrix, rtol=0, atol=1e-15)
    assert element.name == "window"


def test_elements_are_fixed_and_the_default_is_nothing():
    element = MuellerElement()
    np.testing.assert_array_equal(element.mueller(), np.eye(4))
    assert all(getattr(element, key).fixed for key in element.param_names)


def test_matrix_of_other_shape_or_not_finite_is_refused():
    for shape in [(4,), (3, 4), (2, 3, 4, 4), (4, 4, 3)]:
        with pytest.raises(ParameterError, match=r"shape \(4, 4\) or \(n, 4, 4\), not"):
            MuellerElement.from_matrix(np.zeros(shape))
    matrix = np.eye(4)
    matrix[2, 3] = np.nan
    with pytest.raises(ParameterError, match=r"MuellerElement.m23 = nan must be finite"):
        MuellerElement.from_matrix(matrix)


# --- parity flip -----------------------------------------------------------------------


def test_parity_flip_changes_q_and_v():
    light = ParityFlip()(1.6 * u.um, 1, 0.1, 0.2, 0.3)[1:]
    np.testing.assert_array_equal(light, [1, -0.1, 0.2, -0.3])


# --- rotator ---------------------------------------------------------------------------


@given(angle=st.floats(-180, 180), seed=SEED)
def test_optic_between_opposite_rotators_is_a_turned_optic(angle, seed):
    matrix = np.random.default_rng(seed).uniform(-1, 1, size=(4, 4))
    angle = angle * u.deg
    back = Rotator(theta=angle, mount=None).mueller(), Rotator(theta=-angle).mueller()
    turned = MuellerElement.from_matrix(matrix, theta=angle).mueller()
    np.testing.assert_allclose(back[1] @ matrix @ back[0], turned, rtol=0, atol=1e-14)


def test_matrix_keeps_its_unit_and_its_mask():
    percent = MuellerElement.from_matrix([[100, 3, 0, 0], *(100 * np.eye(4))[1:]] * u.percent)
    assert percent.mueller()[0].tolist() == [1, 0.03, 0, 0]
    masked = np.ma.array(np.eye(4), mask=np.eye(4, k=1))
    for matrix in (masked, np.eye(4) * (1 + 1j), np.eye(4) * u.deg):
        with pytest.raises(ParameterError):
            MuellerElement.from_matrix(matrix)
