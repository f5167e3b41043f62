# Licensed under a 3-clause BSD style license - see LICENSE
"""
Mueller matrices of katsu and py_pol are ours.

Both have Stokes vectors (I, Q, U, V), T(-theta) M T(theta) for an optic at theta, and a retarder
with +sin in row 3, column 4, as we do. What differs:

- katsu measures angles from the horizontal, where its Q is positive: the matrices are equal,
  their axes have other names.
- katsu and py_pol give transmissions, Tmax and Tmin; our diattenuators have unit transmission
  for unpolarized light.
- katsu's depolarizer turns the other way: at theta it is ours at -theta.
- py_pol has the matrix in the first two axes, (4, 4, N), and the frames flat.
"""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import mueller, optics
from astropolcal.chain import system_mueller

ANGLE = st.floats(-3.2, 3.2)
RETARDANCE = st.floats(-6.3, 6.3)
DIATTENUATION = st.floats(-0.99, 0.99)
CLOSE = {"atol": 1e-12}


@pytest.fixture(scope="module")
def katsu():
    return pytest.importorskip("katsu.mueller", reason="katsu is not installed")


@pytest.fixture(scope="module")
def py_pol():
    return pytest.importorskip("py_pol.mueller", reason="py_pol is not installed")


def of_pypol(element):
    """Return (N, 4, 4), or (4, 4) of a single one."""
    return np.squeeze(np.moveaxis(element.M, -1, 0))


# --- optics ----------------------------------------------------------------------


@given(angle=ANGLE, retardance=RETARDANCE)
def test_linear_retarder(katsu, py_pol, angle, retardance):
    ours = mueller.rotate(mueller.linear_retarder(retardance * u.rad), angle * u.rad)
    np.testing.assert_allclose(ours, katsu.linear_retarder(angle, retardance), **CLOSE)
    theirs = py_pol.Mueller().retarder_linear(ret=retardance, azimuth=angle)
    np.testing.assert_allclose(ours, of_pypol(theirs), **CLOSE)


@given(angle=ANGLE)
def test_linear_polarizer(katsu, py_pol, angle):
    ours = mueller.rotate(0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg), angle * u.rad)
    np.testing.assert_allclose(ours, katsu.linear_polarizer(angle), **CLOSE)
    theirs = py_pol.Mueller().diattenuator_perfect(azimuth=angle)
    np.testing.assert_allclose(ours, of_pypol(theirs), **CLOSE)


@given(angle=ANGLE, strength=DIATTENUATION)
def test_diattenuator(katsu, py_pol, angle, strength):
    ours = mueller.rotate(mueller.diattenuator_retarder(strength, 0 * u.deg), angle * u.rad)
    high, low = 1 + strength, 1 - strength
    theirs = katsu.linear_diattenuator(angle, low, Tmax=high)
    np.testing.assert_allclose(ours, theirs, **CLOSE)
    theirs = py_pol.Mueller().diattenuator_linear(Tmax=high, Tmin=low, azimuth=angle)
    np.testing.assert_allclose(ours, of_pypol(theirs), **CLOSE)


@given(angle=ANGLE, strength=DIATTENUATION, retardance=st.floats(0, 3.1))
def test_diattenuator_retarder(py_pol, angle, strength, retardance):
    ours = mueller.diattenuator_retarder(strength, retardance * u.rad)
    theirs = py_pol.Mueller().diattenuator_retarder_linear(
        p1=np.sqrt(1 + strength), p2=np.sqrt(1 - strength), R=retardance, azimuth=angle
    )
    np.testing.assert_allclose(mueller.rotate(ours, angle * u.rad), of_pypol(theirs), atol=1e-7)


@given(vector=st.tuples(*[st.floats(-3, 3)] * 3))
def test_elliptical_retarder(py_pol, vector):
    ours = mueller.elliptical_retarder(*(component * u.rad for component in vector))
    given_ = np.array(vector)[:, None]
    theirs = py_pol.Mueller().retarder_vector(given_.copy(), kind="complete")
    np.testing.assert_allclose(ours, of_pypol(theirs), **CLOSE)


@given(diagonal=st.tuples(*[st.floats(0, 0.33)] * 3), angle=ANGLE)
def test_depolarizer(katsu, py_pol, diagonal, angle):
    ours = np.diag([1, *diagonal])
    theirs = py_pol.Mueller().depolarizer_diagonal(d=list(diagonal))
    np.testing.assert_allclose(ours, of_pypol(theirs), **CLOSE)
    theirs = katsu.depolarizer(angle, *diagonal)
    np.testing.assert_allclose(mueller.rotate(ours, -angle * u.rad), theirs, **CLOSE)


@given(angle=ANGLE)
def test_rotation(katsu, angle):
    np.testing.assert_allclose(
        mueller.rotation_matrix(angle * u.rad), katsu.mueller_rotation(angle), **CLOSE
    )


def test_wollaston(katsu):
    for beam, number in [("right", 0), ("left", 1)]:
        prism = optics.WollastonPrism(efficiency=0.93, beam=beam)
        np.testing.assert_allclose(prism.mueller(), katsu.wollaston(number, 0.93), **CLOSE)


# --- decomposition ------------------------------------------------------------------


@settings(max_examples=20)
@given(strength=st.floats(0.01, 0.9), angle=ANGLE, retardance=st.floats(0.05, 3.0))
def test_what_a_matrix_is_made_of(katsu, py_pol, strength, angle, retardance):
    """Diattenuation and retardance of a retarder behind a diattenuator."""
    first = mueller.rotate(mueller.diattenuator_retarder(strength, 0 * u.deg), angle * u.rad)
    matrix = mueller.linear_retarder(retardance * u.rad) @ first
    found = np.linalg.norm(mueller.diattenuation_vector(matrix))
    assert found == pytest.approx(katsu.diattenuation_from_mueller(matrix))
    theirs = py_pol.Mueller().from_matrix(matrix).parameters
    assert found == pytest.approx(theirs.diattenuation())
    vector = mueller.retardance_vector(matrix).to_value(u.rad)
    assert np.linalg.norm(vector) == pytest.approx(retardance, abs=1e-6)


# --- a chain ---------------------------------------------------------------------


def test_chain_of_charis_at_many_frames(katsu, py_pol):
    """22 wavelengths x 8 frames of polarizer, plate, derotator, dichroic and Wollaston."""
    hwp, derotator = np.linspace(0, 1.4, 8), np.linspace(0.8, 2.3, 8)
    plate, prism = np.linspace(2.9, 3.3, 22), np.linspace(1, 3, 22)
    chain = (
        optics.LinearPolarizer(theta=0.2 * u.rad)
        | optics.LinearRetarder(retardance=plate * u.rad, theta=0.01 * u.rad, mount="hwp")
        | optics.LinearRetarder(retardance=prism * u.rad, mount="derotator")
        | optics.Diattenuator(diattenuation=0.03, theta=0.5 * u.rad)
        | optics.WollastonPrism(efficiency=0.97)
    )
    wavelength = np.linspace(1.2, 2.3, 22) * u.um
    ours = system_mueller(chain, wavelength, {"hwp": hwp * u.rad, "derotator": derotator * u.rad})
    shape = (8, 22)
    frames, waves = np.indices(shape)
    theirs = (
        katsu.wollaston(0, 0.97)
        @ katsu.linear_diattenuator(0.5, 0.97, Tmax=1.03)
        @ katsu.linear_retarder(derotator[frames], prism[waves], shape=shape)
        @ katsu.linear_retarder(0.01 + hwp[frames], plate[waves], shape=shape)
        @ katsu.linear_polarizer(0.2)
    )
    np.testing.assert_allclose(ours, theirs, **CLOSE)
    matrices = [
        py_pol.Mueller().diattenuator_perfect(azimuth=0.2),
        py_pol.Mueller().retarder_linear(ret=plate[waves.ravel()],
                                         azimuth=0.01 + hwp[frames.ravel()]),
        py_pol.Mueller().retarder_linear(ret=prism[waves.ravel()],
                                         azimuth=derotator[frames.ravel()]),
        py_pol.Mueller().diattenuator_linear(Tmax=1.03, Tmin=0.97, azimuth=0.5),
    ]  # fmt: skip
    product = optics.WollastonPrism(efficiency=0.97).mueller()
    for element in matrices[::-1]:
        product = product @ np.moveaxis(element.M, -1, 0)
    np.testing.assert_allclose(ours, product.reshape(*shape, 4, 4), **CLOSE)
