# Licensed under a 3-clause BSD style license - see LICENSE
"""Linear and elliptical retarders, and the two-layer waveplate."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from astropolcal import mueller
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.materials import MGF2, QUARTZ
from astropolcal.optics import EllipticalRetarder, LinearRetarder, TwoLayerWaveplate
from astropolcal.optics.retarders import _functions

COMPONENTS = ("horizontal", "diagonal", "circular")
RADIAN = st.floats(-6, 6)
WAVELENGTH = [1.2, 1.6, 2.1] * u.um


def elliptical(vector):
    return EllipticalRetarder(**dict(zip(COMPONENTS, vector * u.rad, strict=True)))


def generator(vector):
    """The matrix whose exponential is the retarder, from its small-angle limit."""
    h, d, r = vector
    return np.array([[0, 0, 0, 0], [0, 0, r, -d], [0, -r, 0, h], [0, d, -h, 0]])


def papers_elliptical_retarder(h, d, r):
    """Eq. for M_ER of the CHARIS paper, element by element."""
    delta = np.sqrt(h**2 + d**2 + r**2)
    C, S, T = np.cos(delta), np.sin(delta), 1 - np.cos(delta)
    rows = [
        [h**2 + (d**2 + r**2) * C, d * h * T + r * S * delta, h * r * T - d * S * delta],
        [d * h * T - r * S * delta, d**2 + (r**2 + h**2) * C, r * d * T + h * S * delta],
        [h * r * T + d * S * delta, r * d * T - h * S * delta, r**2 + (d**2 + h**2) * C],
    ]
    out = np.eye(4)
    out[1:, 1:] = np.array(rows) / delta**2
    return out


# --- elliptical retarder ---------------------------------------------------------------


@given(h=RADIAN, d=RADIAN, r=RADIAN)
def test_elliptical_retarder_of_the_paper(h, d, r):
    vector = np.array([h, d, r])
    if np.linalg.norm(vector) < 1e-3:
        vector += 1e-2  # the equation divides by the square of the retardance
    expected = papers_elliptical_retarder(*vector)
    np.testing.assert_allclose(elliptical(vector).mueller(), expected, rtol=0, atol=1e-11)


@given(h=RADIAN, d=RADIAN, r=RADIAN, power=st.integers(-15, 0))
def test_elliptical_retarder_is_a_matrix_exponential(h, d, r, power):
    vector = np.array([h, d, r]) * 10.0**power
    expected = expm(generator(vector))
    np.testing.assert_allclose(elliptical(vector).mueller(), expected, rtol=0, atol=1e-13)


@given(h=st.floats(-360, 360))
def test_elliptical_retarder_without_the_rest_is_linear(h):
    np.testing.assert_allclose(
        EllipticalRetarder(horizontal=h * u.deg).mueller(),
        LinearRetarder(retardance=h * u.deg).mueller(),
        rtol=0,
        atol=1e-14,
    )


@given(d=st.floats(-360, 360))
def test_diagonal_retardance_is_linear_retardance_at_45_deg(d):
    # the paper's Q = vertical - horizontal, U = +45 - (-45): T(45 deg) turns U into +Q
    np.testing.assert_allclose(
        EllipticalRetarder(diagonal=d * u.deg).mueller(),
        LinearRetarder(retardance=d * u.deg, theta=45 * u.deg).mueller(),
        rtol=0,
        atol=1e-14,
    )


@given(r=st.floats(-360, 360))
def test_circular_retardance_turns_the_plane_of_polarization(r):
    np.testing.assert_allclose(
        EllipticalRetarder(circular=r * u.deg).mueller(),
        mueller.rotation_matrix(r / 2 * u.deg),
        rtol=0,
        atol=1e-14,
    )


def test_derivatives_at_zero_are_the_generators():
    derivatives = elliptical(np.zeros(3)).mueller_derivatives()
    for key, axis in zip(COMPONENTS, np.eye(3), strict=True):
        found = derivatives[key].to_value(1 / u.rad)
        np.testing.assert_array_equal(found, generator(axis))


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


def test_series_and_closed_form_meet():
    # either side of the switch at 0.3 rad
    below, above = np.array(_functions(np.array([np.nextafter(0.3, 0), 0.3]))).T
    np.testing.assert_allclose(below, above, rtol=0, atol=3e-15)


def test_functions_against_their_series():
    x = np.array([0.0, 1e-8, 0.1, 0.29, 0.31, 0.5])
    k = np.arange(12)[:, None]
    factorial = np.cumprod(np.concatenate([[1.0], np.arange(1, 28)]))
    sinc = ((-1.0) ** k * x ** (2 * k) / factorial[2 * k + 1]).sum(axis=0)
    versine = ((-1.0) ** k * x ** (2 * k) / factorial[2 * k + 2]).sum(axis=0)
    k = k[1:]
    sinc_slope = ((-1.0) ** k * 2 * k * x ** (2 * k - 2) / factorial[2 * k + 1]).sum(axis=0)
    versine_slope = ((-1.0) ** k * 2 * k * x ** (2 * k - 2) / factorial[2 * k + 2]).sum(axis=0)
    for found, expected in zip(
        _functions(x), (sinc, versine, sinc_slope, versine_slope), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


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


@given(w_sio2=st.floats(0, 3), w_mgf2=st.floats(0, 3), theta=st.floats(-90, 90))
def test_waveplate_is_the_linear_retarder_of_its_retardance(w_sio2, w_mgf2, theta):
    optic = TwoLayerWaveplate(w_sio2=w_sio2 * u.mm, w_mgf2=w_mgf2 * u.mm, theta=theta * u.deg)
    linear = LinearRetarder(retardance=optic.retardance(WAVELENGTH), theta=theta * u.deg)
    np.testing.assert_allclose(
        optic.mueller(WAVELENGTH), linear.mueller(WAVELENGTH), rtol=0, atol=1e-12
    )


def test_equal_delays_cancel():
    ratio = QUARTZ.birefringence(1.6 * u.um) / MGF2.birefringence(1.6 * u.um)
    optic = TwoLayerWaveplate(w_sio2=1 * u.mm, w_mgf2=ratio * u.mm)
    assert optic.retardance(1.6 * u.um).to_value(u.rad) == pytest.approx(0, abs=1e-12)


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


# --- linear retarder -------------------------------------------------------------------


def test_half_wave_plate_turns_polarization_by_twice_its_angle():
    plate = LinearRetarder(retardance=180 * u.deg)
    for angle in np.arange(0, 180, 11.25):
        plate.theta = angle * u.deg
        _, _, q, u_, v = plate(1.6 * u.um, 1, 1, 0, 0)
        expected = np.cos(np.radians(4 * angle)), np.sin(np.radians(4 * angle)), 0
        np.testing.assert_allclose((q, u_, v), expected, atol=1e-14)


def test_quarter_wave_plate_makes_circular_light():
    # the U, V block is [[0, 1], [-1, 0]]: +U goes in, -V comes out
    _, _, _, u_, v = LinearRetarder(retardance=90 * u.deg)(1.6 * u.um, 1, 0, 1, 0)
    assert (u_, v) == (pytest.approx(0, abs=1e-15), pytest.approx(-1))


def test_bare_number_as_retardance_is_refused():
    with pytest.raises(ParameterError, match=r"LinearRetarder.retardance = 3.14 needs a unit"):
        LinearRetarder(retardance=3.14)
