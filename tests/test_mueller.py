# Licensed under a 3-clause BSD style license - see LICENSE
"""Laws of Mueller matrices: rotation, composition, decomposition, physicality."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from astropolcal import mueller
from astropolcal.exceptions import ParameterError

ANGLE = st.floats(-720, 720)
RETARDANCE = st.floats(-3.0, 3.0)
FRACTION = st.floats(-1, 1)
SEED = st.integers(0, 2**32 - 1)


def random_physical(seed, shape=(), rank=4):
    """Mueller matrices from random coherency matrices of the given rank."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(*shape, 4, rank)) + 1j * rng.normal(size=(*shape, 4, rank))
    return mueller.mueller_from_coherency(root @ np.swapaxes(root, -1, -2).conj())


def random_pure(seed, shape=()):
    return random_physical(seed, shape, rank=1)


ELEMENTS = {
    "rotation": mueller.rotation_matrix(33 * u.deg),
    "polarizer": mueller.linear_polarizer(),
    "crossed polarizer": mueller.rotate(mueller.linear_polarizer(), 90 * u.deg),
    "diattenuator": mueller.diattenuator(-0.3),
    "full diattenuator": mueller.diattenuator(1.0),
    "quarter wave": mueller.linear_retarder(90 * u.deg),
    "half wave": mueller.linear_retarder(180 * u.deg),
    "elliptical": mueller.elliptical_retarder(100 * u.deg, -20 * u.deg, 300 * u.deg),
    "mirror": mueller.diattenuator_retarder(0.05, 170 * u.deg),
}
DEPOLARIZING = {
    "isotropic": mueller.depolarizer(0.7),
    "inverting": mueller.depolarizer(-1 / 3),
    "uneven": mueller.depolarizer(0.9, 0.5, 0.6),
    "scrambler": mueller.depolarizer(0.0),
    "rank one": mueller.depolarizer(1.0, 0.0, 0.0),
}
EVERY = {**ELEMENTS, **DEPOLARIZING}


# --- elements ---------------------------------------------------------------


def test_rotation_matrix_of_the_paper():
    c, s = np.cos(2 * 0.3), np.sin(2 * 0.3)
    expected = [[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1]]
    np.testing.assert_array_equal(mueller.rotation_matrix(0.3 * u.rad), expected)


def test_linear_retarder_of_the_paper():
    c, s = np.cos(0.7), np.sin(0.7)
    expected = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]
    np.testing.assert_array_equal(mueller.linear_retarder(0.7 * u.rad), expected)


def test_diattenuator_retarder_of_the_paper():
    eps, c, s = 0.28, 0.96 * np.cos(0.7), 0.96 * np.sin(0.7)
    expected = [[1, eps, 0, 0], [eps, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]]
    np.testing.assert_allclose(
        mueller.diattenuator_retarder(eps, 0.7 * u.rad), expected, atol=1e-15
    )


def paper_elliptical_retarder(h, d, r):
    """The elliptical retarder of the paper, term by term."""
    total = np.sqrt(h * h + d * d + r * r)
    c, s, t = np.cos(total), np.sin(total), 1 - np.cos(total)
    block = [
        [h * h + (d * d + r * r) * c, d * h * t + r * s * total, h * r * t - d * s * total],
        [d * h * t - r * s * total, d * d + (r * r + h * h) * c, r * d * t + h * s * total],
        [h * r * t + d * s * total, r * d * t - h * s * total, r * r + (d * d + h * h) * c],
    ]
    matrix = np.eye(4)
    matrix[1:, 1:] = np.array(block) / total**2
    return matrix


@given(RETARDANCE, RETARDANCE, st.floats(0.1, 6.0))
def test_elliptical_retarder_of_the_paper(h, d, r):
    found = mueller.elliptical_retarder(h * u.rad, d * u.rad, r * u.rad)
    np.testing.assert_allclose(found, paper_elliptical_retarder(h, d, r), atol=1e-13)


def generator(h, d, r):
    return np.array([[0, r, -d], [-r, 0, h], [d, -h, 0]])


@given(RETARDANCE, RETARDANCE, RETARDANCE, st.integers(-300, 0))
def test_elliptical_retarder_is_exact_through_zero(h, d, r, exponent):
    scale = 10.0**exponent
    found = mueller._elliptical_retarder(h * scale, d * scale, r * scale)
    expected = expm(generator(h * scale, d * scale, r * scale))
    np.testing.assert_allclose(found[1:, 1:], expected, rtol=0, atol=1e-14)
    # the small elements keep their own relative accuracy
    if exponent < -9:
        small = generator(h, d, r) * scale
        off = ~np.eye(3, dtype=bool)
        np.testing.assert_allclose(
            found[1:, 1:][off], small[off], rtol=1e-12, atol=20 * scale**2 + 1e-320
        )


def test_no_retardance_is_no_optic():
    np.testing.assert_array_equal(mueller._elliptical_retarder(0.0, 0.0, 0.0), np.eye(4))


@given(RETARDANCE)
def test_a_linear_retarder_is_a_horizontal_elliptical_one(retardance):
    zero = 0 * u.rad
    np.testing.assert_allclose(
        mueller.elliptical_retarder(retardance * u.rad, zero, zero),
        mueller.linear_retarder(retardance * u.rad),
        atol=1e-15,
    )


@given(RETARDANCE)
def test_a_diagonal_retarder_is_a_linear_one_at_45_degrees(retardance):
    zero = 0 * u.rad
    np.testing.assert_allclose(
        mueller.elliptical_retarder(zero, retardance * u.rad, zero),
        mueller.rotate(mueller.linear_retarder(retardance * u.rad), 45 * u.deg),
        atol=1e-14,
    )


@given(ANGLE)
def test_a_circular_retarder_is_a_rotation(angle):
    zero = 0 * u.deg
    np.testing.assert_allclose(
        mueller.elliptical_retarder(zero, zero, 2 * angle * u.deg),
        mueller.rotation_matrix(angle * u.deg),
        atol=1e-12,
    )


@given(RETARDANCE, RETARDANCE, RETARDANCE)
def test_retarders_are_rotations_of_the_sphere(h, d, r):
    matrix = mueller.elliptical_retarder(h * u.rad, d * u.rad, r * u.rad)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(4), atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1, abs=1e-13)


@given(ANGLE, ANGLE)
def test_rotations_add_up(one, other):
    found = mueller.compose(
        mueller.rotation_matrix(one * u.deg), mueller.rotation_matrix(other * u.deg)
    )
    expected = mueller.rotation_matrix((one + other) * u.deg)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@given(SEED, ANGLE, ANGLE)
def test_turning_twice_is_turning_by_the_sum(seed, one, other):
    matrix = random_physical(seed)
    twice = mueller.rotate(mueller.rotate(matrix, one * u.deg), other * u.deg)
    once = mueller.rotate(matrix, (one + other) * u.deg)
    np.testing.assert_allclose(twice, once, atol=1e-11 * matrix[0, 0])


@given(SEED, SEED, ANGLE)
def test_a_chain_turns_as_its_parts(first, second, angle):
    parts = random_physical(first), random_physical(second)
    turned = mueller.compose(*(mueller.rotate(part, angle * u.deg) for part in parts))
    whole = mueller.rotate(mueller.compose(*parts), angle * u.deg)
    np.testing.assert_allclose(turned, whole, atol=1e-11 * whole[0, 0])


@given(ANGLE)
def test_half_a_turn_changes_nothing(angle):
    matrix = random_physical(3)
    np.testing.assert_allclose(
        mueller.rotate(matrix, angle * u.deg),
        mueller.rotate(matrix, (angle + 180) * u.deg),
        atol=1e-11 * matrix[0, 0],
    )


@given(ANGLE, st.floats(0.01, 1), ANGLE)
def test_a_half_wave_plate_mirrors_the_angle_of_polarization(plate, dolp, angle):
    from astropolcal.stokes import stokes_from_dolp_aolp

    turned = mueller.rotate(mueller.linear_retarder(180 * u.deg), plate * u.deg)
    found = turned @ stokes_from_dolp_aolp(dolp, angle * u.deg)
    expected = stokes_from_dolp_aolp(dolp, (2 * plate - angle) * u.deg)
    np.testing.assert_allclose(found, expected, atol=1e-11)


@given(ANGLE)
def test_crossed_polarizers_are_dark(angle):
    one = mueller.rotate(mueller.linear_polarizer(), angle * u.deg)
    other = mueller.rotate(mueller.linear_polarizer(), (angle + 90) * u.deg)
    np.testing.assert_allclose(mueller.compose(one, other), 0, atol=1e-11)


def test_compose_follows_the_light():
    polarizer, plate = ELEMENTS["polarizer"], ELEMENTS["elliptical"]
    np.testing.assert_array_equal(mueller.compose(polarizer, plate), plate @ polarizer)
    np.testing.assert_array_equal(mueller.compose(plate), plate)


@given(FRACTION, RETARDANCE)
def test_a_diattenuator_retarder_is_the_two_in_any_order(diattenuation, retardance):
    parts = mueller.diattenuator(diattenuation), mueller.linear_retarder(retardance * u.rad)
    found = mueller.diattenuator_retarder(diattenuation, retardance * u.rad)
    np.testing.assert_allclose(found, mueller.compose(*parts), atol=1e-15)
    np.testing.assert_allclose(found, mueller.compose(*parts[::-1]), atol=1e-15)


def test_a_full_diattenuator_is_twice_a_polarizer():
    np.testing.assert_array_equal(mueller.diattenuator(1.0), 2 * mueller.linear_polarizer())


def test_elements_broadcast():
    angles = np.linspace(0, 1, 3) * u.rad
    fractions = np.linspace(-1, 1, 5)[:, None]
    assert mueller.rotation_matrix(angles).shape == (3, 4, 4)
    assert mueller.linear_retarder(angles).shape == (3, 4, 4)
    assert mueller.diattenuator(fractions).shape == (5, 1, 4, 4)
    matrix = mueller.diattenuator_retarder(fractions, angles)
    assert matrix.shape == (5, 3, 4, 4)
    np.testing.assert_array_equal(matrix[4, 2], mueller.diattenuator_retarder(1.0, angles[2]))
    assert mueller.elliptical_retarder(angles[:, None], angles, 0 * u.rad).shape == (3, 3, 4, 4)
    assert mueller.depolarizer(np.full(3, 0.5), np.full((2, 1), 0.4), 0.3).shape == (2, 3, 4, 4)
    assert mueller.rotate(matrix, angles).shape == (5, 3, 4, 4)
    assert mueller.rotate(ELEMENTS["polarizer"], angles).shape == (3, 4, 4)
    assert mueller.compose(matrix, ELEMENTS["polarizer"], matrix[:, :1]).shape == (5, 3, 4, 4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mueller.rotation_matrix(30), "angle"),
        (lambda: mueller.rotation_matrix(np.nan * u.deg), "angle"),
        (lambda: mueller.rotation_matrix(1 * u.um), "angle"),
        (lambda: mueller.linear_retarder(np.inf * u.deg), "retardance"),
        (lambda: mueller.elliptical_retarder(0 * u.deg, 1.0, 0 * u.deg), "diagonal"),
        (lambda: mueller.diattenuator(1.01), "diattenuation = 1.01 must be between -1 and 1"),
        (lambda: mueller.diattenuator([0.1, np.nan]), "diattenuation = nan"),
        (lambda: mueller.diattenuator_retarder(-2, 0 * u.deg), "diattenuation"),
        (lambda: mueller.depolarizer(1.2), "q = 1.2"),
        (lambda: mueller.depolarizer(1, 1, -1), "q = 1.0, u = 1.0, v = -1.0"),
        (lambda: mueller.depolarizer(-0.5), r"\|q \+ u\| <= 1 \+ v"),
        (mueller.compose, "at least one"),
        (lambda: mueller.compose(np.eye(4), np.eye(3)), r"matrix 2 has shape \(3, 3\)"),
        (lambda: mueller.rotate(np.full((4, 4), np.nan), 0 * u.deg), r"nan at index \(0, 0\)"),
        (lambda: mueller.rotate(np.eye(4), 0.0), "angle"),
        (lambda: mueller.rotate("optic", 0 * u.deg), "matrix"),
    ],
)
def test_bad_elements_are_refused(call, message):
    with pytest.raises(ParameterError, match=message):
        call()


# --- what a matrix does -------------------------------------------------------


def test_vectors_of_a_turned_diattenuator():
    matrix = 0.4 * mueller.rotate(mueller.diattenuator(0.3), 22.5 * u.deg)
    expected = 0.3 / np.sqrt(2) * np.array([1, 1, 0])
    np.testing.assert_allclose(mueller.diattenuation_vector(matrix), expected, atol=1e-15)
    np.testing.assert_allclose(mueller.polarizance_vector(matrix), expected, atol=1e-15)
    assert mueller.diattenuation(matrix) == pytest.approx(0.3)
    assert mueller.polarizance(matrix) == pytest.approx(0.3)


@given(SEED)
def test_diattenuation_is_the_contrast_of_the_transmission(seed):
    matrix = random_physical(seed)
    vector = mueller.diattenuation_vector(matrix)
    axis = vector / np.linalg.norm(vector)
    best, worst = (matrix[0] @ [1, *(sign * axis)] for sign in (1, -1))
    contrast = (best - worst) / (best + worst)
    assert mueller.diattenuation(matrix) == pytest.approx(contrast, rel=1e-12)


@pytest.mark.parametrize("name", ELEMENTS)
def test_pure_elements_do_not_depolarize(name):
    matrix = ELEMENTS[name]
    assert mueller.depolarization_index(matrix) == pytest.approx(1, abs=1e-14)
    assert mueller.lu_chipman(matrix).depolarization_power == pytest.approx(0, abs=1e-12)


@given(SEED)
def test_products_of_pure_matrices_are_pure(seed):
    matrix = mueller.compose(*random_pure(seed, (3,)))
    assert mueller.depolarization_index(matrix) == pytest.approx(1, abs=1e-10)


@given(SEED, st.integers(2, 4))
def test_mixtures_depolarize(seed, rank):
    assert mueller.depolarization_index(random_physical(seed, rank=rank)) < 1


def test_depolarization_of_known_depolarizers():
    assert mueller.depolarization_index(np.diag([1.0, 0, 0, 0])) == 0
    matrix = mueller.depolarizer(0.9, 0.5, 0.6)
    expected = np.sqrt((0.81 + 0.25 + 0.36) / 3)
    assert mueller.depolarization_index(2 * matrix) == pytest.approx(expected, rel=1e-15)
    assert mueller.lu_chipman(matrix).depolarization_power == pytest.approx(1 - 2 / 3, rel=1e-12)


# --- polar decomposition ------------------------------------------------------


def assert_factors(parts, matrix, atol=1e-10):
    """Each factor is what it is called, and the product is the matrix."""
    scale = np.asarray(matrix)[..., 0, 0].max()
    np.testing.assert_allclose(parts.matrix, matrix, rtol=0, atol=atol * scale)
    rotation = parts.retarder[..., 1:, 1:]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2),
        np.broadcast_to(np.eye(3), rotation.shape),
        atol=1e-12,
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    np.testing.assert_array_equal(parts.depolarizer[..., 0, 1:], 0)
    block = parts.depolarizer[..., 1:, 1:]
    scale = np.abs(block).max() + 1
    np.testing.assert_allclose(block, np.swapaxes(block, -1, -2), atol=1e-12 * scale)
    np.testing.assert_allclose(
        parts.diattenuator, np.swapaxes(parts.diattenuator, -1, -2), atol=1e-12 * scale
    )
    assert np.all(mueller.is_physical(parts.diattenuator))


@given(SEED, st.integers(1, 4))
def test_lu_chipman_recomposes_physical_matrices(seed, rank):
    matrix = random_physical(seed, (6,), rank)
    assert_factors(mueller.lu_chipman(matrix), matrix)


@pytest.mark.parametrize("name", EVERY)
def test_lu_chipman_recomposes_every_element(name):
    assert_factors(mueller.lu_chipman(EVERY[name]), EVERY[name], 1e-13)


@given(SEED, FRACTION, RETARDANCE, ANGLE)
def test_lu_chipman_takes_a_chain_apart(seed, diattenuation, retardance, angle):
    diattenuation *= 0.95
    diattenuator = 0.8 * mueller.rotate(mueller.diattenuator(diattenuation), angle * u.deg)
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    vector = abs(retardance) * axis / np.linalg.norm(axis) * u.rad
    retarder = mueller.elliptical_retarder(*vector)
    depolarizer = mueller.rotate(mueller.depolarizer(0.9, 0.7, 0.8), -angle * u.deg)
    parts = mueller.lu_chipman(mueller.compose(diattenuator, retarder, depolarizer))
    np.testing.assert_allclose(parts.diattenuator, diattenuator, atol=1e-12)
    np.testing.assert_allclose(parts.retarder, retarder, atol=1e-11)
    np.testing.assert_allclose(parts.depolarizer, depolarizer, atol=1e-11)
    np.testing.assert_allclose(parts.retardance_vector, vector, atol=1e-8 * u.rad)
    assert parts.depolarization_power == pytest.approx(0.2, abs=1e-11)


@given(RETARDANCE, RETARDANCE, RETARDANCE, st.integers(-12, 0))
def test_retardance_vector_round_trip(h, d, r, exponent):
    vector = np.array([h, d, r]) * 10.0**exponent
    length = np.linalg.norm(vector)
    if length > 3.14:
        vector *= 3.14 / length
    found = mueller.retardance_vector(mueller._elliptical_retarder(*vector))
    np.testing.assert_allclose(found.to_value(u.rad), vector, rtol=0, atol=1e-12)


def test_retardance_beyond_half_a_wave_comes_back_the_short_way():
    found = mueller.retardance_vector(mueller.linear_retarder(200 * u.deg)).to_value(u.deg)
    np.testing.assert_allclose(found, [-160, 0, 0], atol=1e-10)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0.6, -0.8, 0]])
def test_half_wave_retardance_has_a_positive_first_component(axis):
    axis = np.array(axis)
    expected = np.pi * axis * np.sign(axis[np.nonzero(axis)[0][0]])
    for sign in (1, -1):
        matrix = mueller._elliptical_retarder(*(sign * np.pi * axis))
        found = mueller.retardance_vector(matrix).to_value(u.rad)
        np.testing.assert_allclose(found, expected, atol=1e-7)


def test_a_mirror_is_a_half_wave_retarder():
    vector = mueller.retardance_vector(np.diag([1.0, 1.0, -1.0, -1.0]))
    np.testing.assert_allclose(vector.to_value(u.deg), [180, 0, 0], atol=1e-10)
    # the sign flip of Q and V of the paper's beam switcher
    vector = mueller.retardance_vector(np.diag([1.0, -1.0, 1.0, -1.0]))
    np.testing.assert_allclose(vector.to_value(u.deg), [0, 180, 0], atol=1e-10)


@given(ANGLE, ANGLE, st.floats(0.01, 1))
def test_a_polarizer_has_the_smallest_retardance_that_fits(entrance, leave, kept):
    # light enters along one axis and leaves, partly depolarized, along another
    before = mueller.rotate(mueller.linear_polarizer(), entrance * u.deg)
    turn = mueller.rotation_matrix((entrance - leave) * u.deg)
    matrix = mueller.compose(before, turn, mueller.depolarizer(kept))
    parts = mueller.lu_chipman(matrix)
    assert_factors(parts, matrix, 1e-11)
    assert mueller.diattenuation(parts.diattenuator) == pytest.approx(1, abs=1e-13)
    assert parts.depolarization_power == pytest.approx(1 - kept, abs=1e-12)
    expected = 2 * abs((entrance - leave + 90) % 180 - 90)
    assert parts.retardance.to_value(u.deg) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("angle", [0.0, 17.0, 45.0, 90.0, 133.3])
def test_a_polarizer_alone_is_neither_retarder_nor_depolarizer(angle):
    matrix = mueller.rotate(mueller.linear_polarizer(), angle * u.deg)
    parts = mueller.lu_chipman(matrix)
    np.testing.assert_allclose(parts.retarder, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(parts.depolarizer, np.eye(4), atol=1e-14)
    np.testing.assert_allclose(parts.diattenuator, matrix, atol=1e-14)


@pytest.mark.parametrize("distance", [1e-3, 1e-6, 1e-9, 1e-12, 1e-14, 1e-16])
def test_lu_chipman_close_to_a_polarizer(distance):
    matrix = mueller.compose(
        mueller.rotate(mueller.diattenuator(1 - distance), 20 * u.deg), ELEMENTS["elliptical"]
    )
    parts = mueller.lu_chipman(matrix)
    # below 1e-13 it counts as a polarizer, which leaves sqrt(2 distance)
    atol = 1e-10 if distance > 1e-13 else 1.5 * np.sqrt(2 * distance) + 1e-12
    np.testing.assert_allclose(parts.matrix, matrix, atol=atol)


def test_matrices_that_leave_no_state_have_no_retarder():
    parts = mueller.lu_chipman(np.diag([2.0, 0, 0, 0]))
    np.testing.assert_array_equal(parts.retarder, np.eye(4))
    assert parts.depolarization_power == 1
    polarizing = np.zeros((4, 4))
    polarizing[:, 0] = [1, 0.3, 0, 0.1]
    assert_factors(mueller.lu_chipman(polarizing), polarizing)
    analysing = polarizing.T.copy()
    assert_factors(mueller.lu_chipman(analysing), analysing)


def test_a_matrix_that_leaves_one_state_turns_it_the_short_way():
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 1
    matrix[2, 1] = 0.5
    parts = mueller.lu_chipman(matrix)
    assert_factors(parts, matrix)
    assert parts.retardance.to_value(u.deg) == pytest.approx(90, abs=1e-9)
    # opposite states: half a wave, about any axis across
    matrix[2, 1], matrix[1, 1] = 0.0, -0.5
    parts = mueller.lu_chipman(matrix)
    assert_factors(parts, matrix)


@given(SEED, st.floats(0.01, 1))
def test_one_surviving_state_fixes_the_retardance(seed, strength):
    enter, leave = np.random.default_rng(seed).normal(size=(2, 3))
    enter, leave = enter / np.linalg.norm(enter), leave / np.linalg.norm(leave)
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 1
    matrix[1:, 1:] = strength * np.outer(leave, enter)
    parts = mueller.lu_chipman(matrix)
    assert_factors(parts, matrix)
    assert parts.retardance.to_value(u.rad) == pytest.approx(np.arccos(enter @ leave), abs=1e-6)


def test_a_negative_determinant_goes_to_the_depolarizer():
    matrix = mueller.compose(
        mueller.linear_retarder(40 * u.deg), mueller.depolarizer(-0.2, -0.25, -0.3)
    )
    parts = mueller.lu_chipman(matrix)
    assert_factors(parts, matrix)
    assert np.linalg.det(parts.depolarizer) < 0
    assert parts.retardance.to_value(u.deg) == pytest.approx(40, abs=1e-9)


def test_polarizance_of_a_decomposition_is_that_of_the_matrix():
    matrix = random_physical(5)
    parts = mueller.lu_chipman(matrix)
    for name in ("diattenuation_vector", "polarizance_vector", "depolarization_index"):
        expected = getattr(mueller, name)(matrix)
        np.testing.assert_allclose(getattr(parts, name), expected, atol=1e-12)


def test_decompositions_keep_the_leading_shape():
    matrix = random_physical(9, (2, 3))
    matrix[0, 1] = EVERY["polarizer"]
    parts = mueller.lu_chipman(matrix)
    assert parts.matrix.shape == parts.retarder.shape == (2, 3, 4, 4)
    assert parts.retardance_vector.shape == parts.polarizance_vector.shape == (2, 3, 3)
    assert parts.depolarization_power.shape == parts.retardance.shape == (2, 3)
    np.testing.assert_allclose(
        parts.retardance_vector[1, 2].value,
        mueller.retardance_vector(matrix[1, 2]).value,
        atol=1e-12,
    )
    np.testing.assert_allclose(parts.retarder[0, 1], np.eye(4), atol=1e-14)


# --- physicality ----------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("angle", [0.0, 31.0])
def test_every_element_is_physical(name, angle):
    assert mueller.is_physical(mueller.rotate(EVERY[name], angle * u.deg), tolerance=1e-14)


@given(st.lists(st.sampled_from(sorted(EVERY)), min_size=1, max_size=5), ANGLE)
def test_products_of_elements_are_physical(names, angle):
    chain = [mueller.rotate(EVERY[name], i * angle * u.deg) for i, name in enumerate(names)]
    matrix = mueller.compose(*chain)
    # crossed polarizers leave rounding only, which is relative to one here
    assert mueller.coherency_eigenvalues(matrix)[0] > -1e-12


@pytest.mark.parametrize(
    "diagonal", [[1, 1, 1, -1], [1, 1, -1, 1], [1, -1, -1, -1], [1, 1.1, 1, 1], [-1, 0, 0, 0]]
)
def test_impossible_matrices(diagonal):
    assert not mueller.is_physical(np.diag(np.array(diagonal, dtype=float)))


def test_an_optic_that_polarizes_more_than_fully_is_not_physical():
    matrix = mueller.linear_polarizer()
    matrix[1, 0] *= 1.001
    assert not mueller.is_physical(matrix)
    assert mueller.is_physical(matrix, tolerance=0.1)


@given(SEED)
def test_coherency_round_trip(seed):
    matrix = np.random.default_rng(seed).normal(size=(3, 4, 4))
    coherency = mueller.coherency_matrix(matrix)
    np.testing.assert_allclose(coherency, np.swapaxes(coherency, -1, -2).conj(), atol=1e-14)
    np.testing.assert_allclose(np.trace(coherency, axis1=1, axis2=2), matrix[:, 0, 0], atol=1e-14)
    np.testing.assert_allclose(mueller.mueller_from_coherency(coherency), matrix, atol=1e-14)
    values = mueller.coherency_eigenvalues(matrix)
    assert np.all(np.diff(values) >= 0)
    np.testing.assert_allclose(values.sum(axis=-1), matrix[:, 0, 0], atol=1e-13)


@given(RETARDANCE, RETARDANCE, RETARDANCE)
def test_coherency_of_a_retarder_is_that_of_its_jones_matrix(h, d, r):
    # exp(i Delta . sigma / 2) = cos(Delta / 2) + i sin(Delta / 2) axis . sigma
    vector = np.array([h, d, r])
    total = np.linalg.norm(vector)
    c = np.array([np.cos(total / 2), *(1j * np.sinc(total / 2 / np.pi) * vector / 2)])
    found = mueller.coherency_matrix(mueller._elliptical_retarder(h, d, r))
    np.testing.assert_allclose(found, np.outer(c, c.conj()), atol=1e-14)


@given(SEED)
def test_pure_matrices_have_one_eigenvalue(seed):
    matrix = random_pure(seed)
    values = mueller.coherency_eigenvalues(matrix)
    np.testing.assert_allclose(values[:3], 0, atol=1e-13 * matrix[0, 0])


@given(SEED, st.floats(0.01, 2))
def test_nearest_physical_is_physical_and_stays(seed, noise):
    rng = np.random.default_rng(seed)
    matrix = np.eye(4) + noise * rng.normal(size=(5, 4, 4))
    matrix[:, 0, 0] = 1 + rng.random(5)
    found = mueller.nearest_physical(matrix)
    assert np.all(mueller.is_physical(found, tolerance=1e-12))
    np.testing.assert_allclose(found[:, 0, 0], matrix[:, 0, 0], rtol=1e-13)
    np.testing.assert_array_equal(mueller.nearest_physical(found), found)


@given(SEED, st.integers(1, 4))
def test_nearest_physical_leaves_physical_matrices_alone(seed, rank):
    matrix = random_physical(seed, (4,), rank)
    np.testing.assert_array_equal(mueller.nearest_physical(matrix), matrix)


@given(SEED, st.floats(0.001, 1), st.integers(1, 4))
def test_no_physical_matrix_comes_to_lie_farther_away(seed, noise, rank):
    truth = random_physical(seed, rank=rank)
    truth /= truth[0, 0]
    noisy = truth + noise * np.random.default_rng(seed).normal(size=(4, 4))
    noisy[0, 0] = 1.0
    found = mueller.nearest_physical(noisy)
    assert np.linalg.norm(found - truth) <= np.linalg.norm(noisy - truth) + 1e-12
    # the triangle at a projection is never acute
    assert np.sum((noisy - found) * (truth - found)) <= 1e-12


def test_nearest_physical_of_a_known_matrix():
    # eigenvalues (-1/2, 1/2, 1/2, 1/2): three of 1/3 are left
    found = mueller.nearest_physical(np.diag([1.0, 1.0, 1.0, -1.0]))
    np.testing.assert_allclose(found, np.diag([1, 1 / 3, 1 / 3, -1 / 3]), atol=1e-15)


def test_passivity():
    assert mueller.is_passive(np.eye(4))
    assert mueller.is_passive(ELEMENTS["elliptical"])
    assert mueller.is_passive(0.5 * mueller.diattenuator(1.0))
    assert not mueller.is_passive(1.001 * np.eye(4))
    assert not mueller.is_passive(mueller.diattenuator(0.01))
    assert mueller.is_passive(mueller.diattenuator(0.01) / 1.01)
    assert mueller.is_passive(1.001 * np.eye(4), tolerance=0.01)
    # it passes too much from behind only
    matrix = np.zeros((4, 4))
    matrix[:2, 0] = [0.8, 0.4]
    assert not mueller.is_passive(matrix)
    np.testing.assert_array_equal(
        mueller.is_passive(np.array([0.5, 2.0])[:, None, None] * np.eye(4)), [True, False]
    )


@given(SEED)
def test_passive_matrices_give_out_no_more_than_they_take(seed):
    matrix = random_physical(seed)
    matrix /= matrix[0, 0] * (1 + max(mueller.diattenuation(matrix), mueller.polarizance(matrix)))
    assert mueller.is_passive(matrix)
    direction = np.random.default_rng(seed).normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    assert np.all(matrix[0, 0] + direction @ matrix[0, 1:] <= 1 + 1e-12)


FUNCTIONS_OF_A_MATRIX = [
    mueller.coherency_eigenvalues,
    mueller.coherency_matrix,
    mueller.depolarization_index,
    mueller.diattenuation,
    mueller.diattenuation_vector,
    mueller.is_passive,
    mueller.is_physical,
    mueller.lu_chipman,
    mueller.nearest_physical,
    mueller.polarizance,
    mueller.polarizance_vector,
    mueller.retardance_vector,
]


@pytest.mark.parametrize("function", FUNCTIONS_OF_A_MATRIX)
@pytest.mark.parametrize("bad", [np.full((4, 4), np.nan), np.eye(3), np.ones(4), [["a"]]])
def test_bad_matrices_give_no_number(function, bad):
    with pytest.raises(ParameterError, match="matrix"):
        function(bad)


NEED_LIGHT = [
    f
    for f in FUNCTIONS_OF_A_MATRIX
    if f not in (mueller.coherency_eigenvalues, mueller.coherency_matrix, mueller.is_physical)
]


@pytest.mark.parametrize("function", NEED_LIGHT)
@pytest.mark.parametrize("transmission", [0.0, -1.0])
def test_matrices_without_transmission_are_refused(function, transmission):
    with pytest.raises(ParameterError, match=r"matrix\[0, 0\] = .* must be positive"):
        function(np.stack([np.eye(4), transmission * np.eye(4)]))


# lu_chipman returns an object: test_decompositions_keep_the_leading_shape
@pytest.mark.parametrize(
    "function", [f for f in FUNCTIONS_OF_A_MATRIX if f.__name__ != "lu_chipman"]
)
def test_functions_of_a_matrix_are_vectorised(function):
    matrix = random_physical(21, (2, 3))
    whole = function(matrix)
    for index in np.ndindex(2, 3):
        one = function(matrix[index])
        assert whole[index].shape == one.shape
        np.testing.assert_allclose(
            getattr(whole[index], "value", whole[index]), getattr(one, "value", one), atol=1e-12
        )


def test_a_diattenuation_above_one_is_not_decomposed():
    matrix = mueller.diattenuator(1.0)
    matrix[0, 1] = 1.02
    with pytest.raises(ParameterError, match=r"diattenuation = 1\.02 .*nearest_physical"):
        mueller.lu_chipman(matrix)
    assert mueller.lu_chipman(mueller.nearest_physical(matrix)).matrix.shape == (4, 4)


@pytest.mark.parametrize("tolerance", [-1e-9, np.nan])
def test_a_tolerance_is_not_negative(tolerance):
    for function in (mueller.is_physical, mueller.is_passive, mueller.nearest_physical):
        with pytest.raises(ParameterError, match="tolerance"):
            function(np.eye(4), tolerance)


@pytest.mark.parametrize("bad", [np.eye(3), np.full((4, 4), np.nan), np.triu(np.ones((4, 4)))])
def test_bad_coherency_matrices_are_refused(bad):
    with pytest.raises(ParameterError, match="coherency"):
        mueller.mueller_from_coherency(bad)


def test_inputs_are_left_as_they_are():
    matrix = random_physical(2, (3,))
    copy = matrix.copy()
    for function in FUNCTIONS_OF_A_MATRIX:
        function(matrix)
    mueller.rotate(matrix, 10 * u.deg)
    np.testing.assert_array_equal(matrix, copy)
