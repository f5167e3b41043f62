# Licensed under a 3-clause BSD style license - see LICENSE
"""Derivatives of elementary matrices, copies of optics, positions, and documented equations."""

import copy
import inspect
import re

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from astropolcal import mueller, optics, thinfilm
from astropolcal.exceptions import ParameterError
from astropolcal.mueller import (
    diattenuator_retarder_slopes,
    retardance_slope,
    rotation_generator,
    transverse_share,
    turn,
)
from astropolcal.optics import OPTICS
from astropolcal.optics.positions import COORDINATES, FLUXES, MOVES, finite_position

MATRIX = arrays(float, (4, 4), elements=st.floats(-1, 1))
ANGLE = st.floats(-3, 3)
STEP = 1e-6


def difference(function, x):
    return (function(x + STEP) - function(x - STEP)) / (2 * STEP)


# --- derivatives --------------------------------------------------------------------------------


@given(matrix=MATRIX, angle=ANGLE)
def test_turned_optic_moves_by_the_commutator(matrix, angle):
    def turned(x):
        return mueller.rotate(matrix, x * u.rad)

    expected = difference(turned, angle)
    np.testing.assert_allclose(rotation_generator(turned(angle)), expected, atol=1e-8)


@given(matrix=MATRIX, angle=ANGLE)
def test_turned_frame_moves_on_one_side_only(matrix, angle):
    def turned(x):
        return mueller.rotation_matrix(x * u.rad) @ matrix

    np.testing.assert_allclose(turn(turned(angle)), difference(turned, angle), atol=1e-8)


def test_generators_act_on_the_last_axes():
    for shape in [(), (3,), (2, 5)]:
        matrices = np.random.default_rng(1).normal(size=(*shape, 4, 4))
        for function in (rotation_generator, turn):
            found = function(matrices)
            assert found.shape == matrices.shape, shape
            for i in np.ndindex(shape):
                np.testing.assert_array_equal(found[i], function(matrices[i]))


@given(x=ANGLE)
def test_slope_of_a_retarder(x):
    expected = difference(lambda a: mueller.linear_retarder(a * u.rad), x)
    np.testing.assert_allclose(retardance_slope(x), expected, atol=1e-9)


@given(epsilon=st.floats(-0.99, 0.99), retardance=ANGLE)
def test_slope_of_a_diattenuator(epsilon, retardance):
    def matrix(e):
        return mueller.diattenuator_retarder(e, retardance * u.rad)

    found, turned = diattenuator_retarder_slopes(epsilon, retardance)
    np.testing.assert_allclose(found, difference(matrix, epsilon), rtol=1e-5, atol=1e-6)
    expected = difference(lambda x: mueller.diattenuator_retarder(epsilon, x * u.rad), retardance)
    np.testing.assert_allclose(turned, expected, atol=1e-9)


@given(st.floats(0, 9))
def test_share_that_is_left_of_u_near_a_polarizer(decades):
    """With eps = 1 - d the root is sqrt(2 d - d^2), to the last digit of d."""
    d = 10.0**-decades
    epsilon = 1 - d
    # what the float has lost is not the function's to bring back
    kept = 1 - epsilon
    assert transverse_share(epsilon) == pytest.approx(np.sqrt(kept * (2 - kept)), rel=1e-14)
    assert transverse_share(-epsilon) == transverse_share(epsilon)


# --- copies and keywords ------------------------------------------------------------------------


def bound_optic():
    plate = optics.LinearRetarder(retardance=[1, 2] * u.deg, mount="-hwp", name="plate")
    plate.retardance.bounds, plate.retardance.fixed = (0, 5), True
    plate.retardance.prior = {"mean": [1, 2]}
    plate.position = 3 * u.deg
    return plate


def test_copy_shares_nothing_that_can_change():
    for how in [copy.deepcopy, lambda optic: optic.copy()]:
        plate = bound_optic()
        twin = how(plate)
        twin.retardance[0] = 9.0
        np.testing.assert_array_equal(plate.retardance.value, [1, 2])
        twin.retardance = [7, 8] * u.deg
        twin.retardance.bounds, twin.retardance.fixed = (-1, 1), False
        twin.retardance.prior["mean"].append(3)
        twin.mount, twin.name, twin.position = "stage", "twin", 1 * u.rad
        np.testing.assert_array_equal(plate.retardance.value, [1, 2])
        assert plate.retardance.bounds == (0, 5), how
        assert plate.retardance.fixed, how
        assert plate.retardance.prior == {"mean": [1, 2]}, how
        assert (plate.mount, plate.name) == ("-hwp", "plate"), how
        assert plate.position == 3 * u.deg, how


def test_parameter_of_a_copy_belongs_to_the_copy():
    """A parameter that still pointed to the first optic would set that one's value."""
    twin = copy.deepcopy(bound_optic())
    twin.retardance.value = [4, 5]
    np.testing.assert_array_equal(twin.mueller([1, 2] * u.um), twin.copy().mueller([1, 2] * u.um))
    assert twin.retardance.model is twin


def test_optics_of_a_list_stay_one_where_they_were_one():
    plate = bound_optic()
    first, second = copy.deepcopy([plate, plate])
    assert first is second
    assert first is not plate


def test_signature_is_of_keywords_with_their_defaults():
    for name in OPTICS:
        signature = inspect.signature(OPTICS[name])
        kinds = {parameter.kind for parameter in signature.parameters.values()}
        assert kinds == {inspect.Parameter.KEYWORD_ONLY}, name
        made = OPTICS[name]()
        assert {*made.param_names, "mount", "name"} <= set(signature.parameters), name
        for key in made.param_names:
            assert u.Quantity(signature.parameters[key].default) == u.Quantity(
                getattr(made, key).value, getattr(made, key).unit
            ), name


# --- positions ----------------------------------------------------------------------------------


def test_numbers_and_angles_of_stages():
    for stage in [*COORDINATES, "-"]:
        if stage in COORDINATES:
            assert finite_position(0.5, "position", stage) == 0.5, stage
            with pytest.raises(ParameterError, match="position has unit deg"):
                finite_position(1 * u.deg, "position", stage)
        else:
            assert finite_position(180 * u.deg, "position", "hwp") == pytest.approx(np.pi), stage
            with pytest.raises(ParameterError, match=r"position = 0\.5 needs a unit such as rad"):
                finite_position(0.5, "position", "hwp")
    # stage is the name where there is no other
    assert finite_position(1.0, "sequence") == 1.0
    with pytest.raises(ParameterError, match=r"hwp = 1\.0 needs a unit"):
        finite_position(1.0, "hwp")
    # position is finite
    for bad in [np.nan, np.inf, -np.inf]:
        with pytest.raises(ParameterError, match=r"flux = .* must be finite"):
            finite_position([1.0, bad], "flux")
        with pytest.raises(ParameterError, match=r"hwp = .* must be finite"):
            finite_position([0.0, bad] * u.deg, "hwp")


def test_kinds_of_positions_do_not_overlap():
    moves = {f"{stage}{what}" for stage in ("hwp", "derotator") for what in MOVES}
    others = {"parallactic_rate", "brightness", "sequence", "flc_state", "frame"}
    assert not set(FLUXES) & (moves | others)
    assert {*FLUXES, *moves, *others} == set(COORDINATES)
    # and the moves of any other stage
    assert "kmirror_move" in COORDINATES


# --- the matrices in the docstrings -------------------------------------------------------------

SYMBOLS = {
    r"\epsilon": "e", r"\Delta_{45}": "f", r"\Delta_H": "h", r"\Delta_R": "r",
    r"\sqrt{1-e^2}": "t", r"\cos\Delta": "c", r"\sin\Delta": "s",
}  # fmt: skip


def documented(cls, **values):
    """Return the Mueller matrix in a docstring's equation, with numbers for its symbols."""
    text = re.search(r"\\begin{pmatrix}(.*?)\\end{pmatrix}", inspect.getdoc(cls), re.DOTALL)[1]
    for symbol, name in SYMBOLS.items():
        text = text.replace(symbol, name)
    rows = [row.split("&") for row in re.sub(r"\s", "", text).split(r"\\")]
    return np.array([[_sum(cell, values) for cell in row] for row in rows])


def _sum(cell, values):
    """Return the value of a sum of products such as ``Thf-Sr`` or ``C+Th^2``."""
    total = 0.0
    for sign, term in re.findall(r"([+-]?)([^+-]+)", cell):
        factors = re.findall(r"([a-zA-Z]|\d)(\^2)?", term)
        product = np.prod(
            [
                (float(name) if name.isdigit() else values[name]) ** (2 if square else 1)
                for name, square in factors
            ]
        )
        total += -product if sign == "-" else product
    return total


def test_documented_matrix_is_that_of_the_code():
    for cls, settings in [
        (optics.LinearRetarder, {"retardance": 1.1 * u.rad}),
        (optics.Diattenuator, {"diattenuation": 0.3}),
        (optics.DiattenuatorRetarder, {"diattenuation": 0.3, "retardance": 1.1 * u.rad}),
        (optics.LinearPolarizer, {}),
    ]:
        expected = documented(cls, e=0.3, t=np.sqrt(1 - 0.09), c=np.cos(1.1), s=np.sin(1.1))
        expected = 0.5 * expected if cls is optics.LinearPolarizer else expected
        np.testing.assert_allclose(cls(**settings).mueller(), expected, atol=1e-14)


def test_documented_mirror_is_that_of_its_amplitudes():
    lam = 1.6 * u.um
    film = ("fused silica", 120 * u.nm)
    surface = thinfilm.reflect(lam, 45 * u.deg, "gold", [film])
    s, p = (float(abs(r) ** 2) for r in (surface.r_s, surface.r_p))
    e, d = (s - p) / (s + p), np.angle(surface.r_p / surface.r_s)
    expected = documented(optics.MetalMirror, e=e, t=np.sqrt(1 - e**2), c=np.cos(d), s=np.sin(d))
    mirror = optics.MetalMirror(material="gold", film_thickness=120 * u.nm)
    np.testing.assert_allclose(mirror.mueller(lam), expected, atol=1e-13)


def test_documented_elliptical_retarder_is_that_of_the_code():
    dh, d45, dr = 0.7, -0.4, 1.3
    d = np.sqrt(dh**2 + d45**2 + dr**2)
    expected = documented(
        optics.EllipticalRetarder,
        h=dh, f=d45, r=dr, C=np.cos(d), S=np.sin(d) / d, T=(1 - np.cos(d)) / d**2,
    )  # fmt: skip
    found = optics.EllipticalRetarder(
        horizontal=dh * u.rad, diagonal=d45 * u.rad, circular=dr * u.rad
    ).mueller()
    np.testing.assert_allclose(found, expected, atol=1e-14)
