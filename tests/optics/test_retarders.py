# Licensed under a 3-clause BSD style license - see LICENSE
"""Linear and elliptical retarders, and the two-layer waveplate."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from astropolcal.exceptions import WavelengthRangeError
from astropolcal.materials import MGF2, QUARTZ
from astropolcal.optics import EllipticalRetarder, LinearRetarder, TwoLayerWaveplate

COMPONENTS = ("horizontal", "diagonal", "circular")
WAVELENGTH = [1.2, 1.6, 2.1] * u.um


def elliptical(vector):
    return EllipticalRetarder(**dict(zip(COMPONENTS, vector * u.rad, strict=True)))


def generator(vector):
    """The matrix whose exponential is the retarder, from its small-angle limit."""
    h, d, r = vector
    return np.array([[0, 0, 0, 0], [0, 0, r, -d], [0, -r, 0, h], [0, d, -h, 0]])


# --- elliptical retarder ---------------------------------------------------------------


def test_matrix_and_derivative_are_smooth_through_zero():
    for length in [0.0, 1e-300, 1e-160, 1e-14, 1e-8, 1e-4]:
        for direction in [[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, -1, 2]]:
            vector = length * np.array(direction) / np.linalg.norm(direction)
            optic = elliptical(vector)
            K = generator(vector)
            np.testing.assert_allclose(optic.mueller(), expm(K), rtol=0, atol=1e-15)
            for key, axis in zip(COMPONENTS, np.eye(3), strict=True):
                G = generator(axis)
                # derivative of exp(K): the first terms of its series, the next is K^3
                expected = G + (K @ G + G @ K) / 2 + (K @ K @ G + K @ G @ K + G @ K @ K) / 6
                found = optic.mueller_derivatives()[key].to_value(1 / u.rad)
                np.testing.assert_allclose(found, expected, rtol=0, atol=length**3 + 1e-15)


def exact_derivative(K, G):
    """Derivative of exp(K) along G, from the exponential of a block matrix."""
    zero = np.zeros_like(K)
    return expm(np.block([[K, G], [zero, K]]))[:4, 4:]


@given(
    length=st.one_of(
        st.floats(0, 10), st.floats(0.29999, 0.30001), st.floats(0, 1e-6), st.just(2 * np.pi)
    ),
    polar=st.floats(0, np.pi),
    azimuth=st.floats(0, 2 * np.pi),
)
def test_elliptical_derivatives_against_the_exponential(length, polar, azimuth):
    vector = length * np.array(
        [np.cos(polar), np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth)]
    )
    derivatives = elliptical(vector).mueller_derivatives()
    for key, axis in zip(COMPONENTS, np.eye(3), strict=True):
        expected = exact_derivative(generator(vector), generator(axis))
        found = derivatives[key].to_value(1 / u.rad)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


# --- two-layer waveplate ---------------------------------------------------------------


# 't Hart et al. 2021, Proc. SPIE 11833, fitted thicknesses; and the fit of the CHARIS paper
PUBLISHED = [(1.63398, 1.27711), (1.653, 1.291)]


def test_waveplate_of_the_paper():
    for w_sio2, w_mgf2 in PUBLISHED:
        optic = TwoLayerWaveplate(w_sio2=w_sio2 * u.mm, w_mgf2=w_mgf2 * u.mm)
        lam, thickness = WAVELENGTH.to_value(u.um), 1e3 * np.array([w_sio2, w_mgf2])
        path = thickness[0] * QUARTZ._birefringence_um(lam) - thickness[1] * MGF2._birefringence_um(
            lam
        )
        expected = 2 * np.pi / lam * path
        np.testing.assert_allclose(
            optic.retardance(WAVELENGTH).to_value(u.rad), expected, rtol=1e-12
        )


def test_published_waveplates_are_half_wave_plates():
    for w_sio2, w_mgf2 in PUBLISHED:
        # CHARIS paper, figure of the retardance of the half-wave plate: within 160 to
        # 195 deg over 1.15 to 2.4 um; the equation gives it a minus sign
        optic = TwoLayerWaveplate(w_sio2=w_sio2 * u.mm, w_mgf2=w_mgf2 * u.mm)
        retardance = optic.retardance(np.linspace(1.15, 2.4, 22) * u.um).to_value(u.deg)
        assert np.all(retardance < -160), (w_sio2, w_mgf2)
        assert np.all(retardance > -195), (w_sio2, w_mgf2)


def test_default_waveplate_is_the_published_one():
    default = TwoLayerWaveplate()
    assert (default.w_sio2.value, default.w_mgf2.value) == PUBLISHED[0]
    assert default.w_sio2.unit == default.w_mgf2.unit == u.mm


def test_waveplate_out_of_the_range_of_its_materials():
    for wavelength in [0.1, 50.0]:
        optic = TwoLayerWaveplate()
        for use in (optic.retardance, optic.mueller, optic.mueller_derivatives, optic.loosened):
            with pytest.raises(WavelengthRangeError, match=f"not at {wavelength:g} um"):
                use([1.6, wavelength] * u.um)
        with pytest.raises(WavelengthRangeError):
            optic(wavelength * u.um, 1, 0, 0, 0)


def test_loosened_waveplate_keeps_mount_name_and_theta():
    optic = TwoLayerWaveplate(mount="-hwp", name="hwp", theta=2 * u.deg)
    optic.theta.fixed, optic.theta.bounds = False, (-5, 5)
    loose = optic.loosened(WAVELENGTH)
    assert type(loose) is LinearRetarder
    assert (loose.name, loose.mount, loose.theta.value) == ("hwp", "-hwp", 2)
    assert (loose.theta.fixed, loose.theta.bounds) == (False, (-5, 5))
    np.testing.assert_array_equal(loose.retardance.quantity, optic.retardance(WAVELENGTH))
    assert LinearRetarder().loosened(WAVELENGTH).retardance.shape == ()
