# Licensed under a 3-clause BSD style license - see LICENSE
"""Laws of Mueller matrices: rotation, composition, retarders within matrices, physicality."""

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
    coherency = root @ np.swapaxes(root, -1, -2).conj()
    return np.einsum("ijkl,...kl->...ij", mueller._BASIS, coherency).real


ELEMENTS = {
    "rotation": mueller.rotation_matrix(33 * u.deg),
    "polarizer": 0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg),
    "crossed polarizer": mueller.rotate(
        0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg), 90 * u.deg
    ),
    "diattenuator": mueller.diattenuator_retarder(-0.3, 0 * u.deg),
    "full diattenuator": mueller.diattenuator_retarder(1.0, 0 * u.deg),
    "quarter wave": mueller.linear_retarder(90 * u.deg),
    "half wave": mueller.linear_retarder(180 * u.deg),
    "elliptical": mueller.elliptical_retarder(100 * u.deg, -20 * u.deg, 300 * u.deg),
    "mirror": mueller.diattenuator_retarder(0.05, 170 * u.deg),
}
DEPOLARIZING = {
    "isotropic": np.diag([1, 0.7, 0.7, 0.7]),
    "inverting": np.diag([1, -1 / 3, -1 / 3, -1 / 3]),
    "uneven": np.diag([1, 0.9, 0.5, 0.6]),
    "scrambler": np.diag([1, 0.0, 0.0, 0.0]),
    "rank one": np.diag([1, 1.0, 0.0, 0.0]),
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
    found = mueller.rotation_matrix(other * u.deg) @ mueller.rotation_matrix(one * u.deg)
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
    one, other = random_physical(first), random_physical(second)
    turned = mueller.rotate(other, angle * u.deg) @ mueller.rotate(one, angle * u.deg)
    whole = mueller.rotate(other @ one, angle * u.deg)
    np.testing.assert_allclose(turned, whole, atol=1e-11 * whole[0, 0])


@given(ANGLE)
def test_half_a_turn_changes_nothing(angle):
    matrix = random_physical(3)
    np.testing.assert_allclose(
        mueller.rotate(matrix, angle * u.deg),
        mueller.rotate(matrix, (angle + 180) * u.deg),
        atol=1e-11 * matrix[0, 0],
    )


@given(ANGLE, ANGLE)
def test_a_half_wave_plate_mirrors_the_angle_of_polarization(plate, angle):
    def light(degrees):
        return [1, 0.3 * np.cos(2 * np.deg2rad(degrees)), 0.3 * np.sin(2 * np.deg2rad(degrees)), 0]

    turned = mueller.rotate(mueller.linear_retarder(180 * u.deg), plate * u.deg)
    np.testing.assert_allclose(turned @ light(angle), light(2 * plate - angle), atol=1e-11)


@given(ANGLE)
def test_crossed_polarizers_are_dark(angle):
    one = mueller.rotate(0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg), angle * u.deg)
    other = mueller.rotate(
        0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg), (angle + 90) * u.deg
    )
    np.testing.assert_allclose(other @ one, 0, atol=1e-11)


@given(FRACTION, RETARDANCE)
def test_a_diattenuator_retarder_is_the_two_in_any_order(diattenuation, retardance):
    parts = (
        mueller.diattenuator_retarder(diattenuation, 0 * u.deg),
        mueller.linear_retarder(retardance * u.rad),
    )
    found = mueller.diattenuator_retarder(diattenuation, retardance * u.rad)
    np.testing.assert_allclose(found, parts[0] @ parts[1], atol=1e-15)
    np.testing.assert_allclose(found, parts[1] @ parts[0], atol=1e-15)


def test_elements_broadcast():
    angles = np.linspace(0, 1, 3) * u.rad
    fractions = np.linspace(-1, 1, 5)[:, None]
    assert mueller.rotation_matrix(angles).shape == (3, 4, 4)
    assert mueller.linear_retarder(angles).shape == (3, 4, 4)
    assert mueller.diattenuator_retarder(fractions, 0 * u.deg).shape == (5, 1, 4, 4)
    matrix = mueller.diattenuator_retarder(fractions, angles)
    assert matrix.shape == (5, 3, 4, 4)
    np.testing.assert_array_equal(matrix[4, 2], mueller.diattenuator_retarder(1.0, angles[2]))
    assert mueller.elliptical_retarder(angles[:, None], angles, 0 * u.rad).shape == (3, 3, 4, 4)
    assert mueller.rotate(matrix, angles).shape == (5, 3, 4, 4)
    assert mueller.rotate(ELEMENTS["polarizer"], angles).shape == (3, 4, 4)


def test_bad_elements_are_refused():
    for call, message in (
        (lambda: mueller.rotation_matrix(30), "angle"),
        (lambda: mueller.rotation_matrix(np.nan * u.deg), "angle"),
        (lambda: mueller.rotation_matrix(1 * u.um), "angle"),
        (lambda: mueller.linear_retarder(np.inf * u.deg), "retardance"),
        (lambda: mueller.elliptical_retarder(0 * u.deg, 1.0, 0 * u.deg), "diagonal"),
        (
            lambda: mueller.diattenuator_retarder(1.01, 0 * u.deg),
            "diattenuation = 1.01 must be between -1 and 1",
        ),
        (lambda: mueller.diattenuator_retarder([0.1, np.nan], 0 * u.deg), "diattenuation = nan"),
        (lambda: mueller.diattenuator_retarder(-2, 0 * u.deg), "diattenuation"),
        (lambda: mueller.rotate(np.eye(3), 0 * u.deg), r"matrix has shape \(3, 3\)"),
        (lambda: mueller.rotate(np.full((4, 4), np.nan), 0 * u.deg), r"nan at index \(0, 0\)"),
        (lambda: mueller.rotate(np.eye(4), 0.0), "angle"),
        (lambda: mueller.rotate("optic", 0 * u.deg), "matrix"),
    ):
        with pytest.raises(ParameterError, match=message):
            call()


# --- what a matrix does -------------------------------------------------------


@given(SEED, st.floats(-1, 1), ANGLE)
def test_diattenuation_is_the_contrast_of_the_transmission(seed, strength, angle):
    turned = 0.4 * mueller.rotate(mueller.diattenuator_retarder(strength, 0 * u.deg), angle * u.deg)
    for matrix in (random_physical(seed), turned):
        vector = mueller.diattenuation_vector(matrix)
        axis = vector / (np.linalg.norm(vector) or 1)
        best, worst = (matrix[0] @ [1, *(sign * axis)] for sign in (1, -1))
        contrast = (best - worst) / (best + worst)
        assert np.linalg.norm(vector) == pytest.approx(contrast, rel=1e-12)
    turn = 2 * np.deg2rad(angle)
    expected = strength * np.array([np.cos(turn), np.sin(turn), 0])
    np.testing.assert_allclose(mueller.diattenuation_vector(turned), expected, atol=1e-11)


def retarder_of(matrix):
    vector = mueller.retardance_vector(matrix).to_value(u.rad)
    return mueller._elliptical_retarder(*np.moveaxis(vector, -1, 0))


def assert_rest_is_no_retarder(matrix, atol=1e-8):
    """What the retarder leaves of M D^-1 is symmetric, as a depolarizer is (Lu & Chipman)."""
    retarder = retarder_of(matrix)
    row = mueller.diattenuation_vector(matrix)
    strength = np.linalg.norm(row, axis=-1)[..., None, None]
    share = np.sqrt(1 - strength**2)
    outer = row[..., :, None] * row[..., None, :]
    diattenuator = np.broadcast_to(np.eye(4), matrix.shape).copy()
    diattenuator[..., 0, 1:] = diattenuator[..., 1:, 0] = row
    diattenuator[..., 1:, 1:] = share * np.eye(3) + outer / (1 + share)
    rest = matrix @ np.linalg.inv(diattenuator) @ np.swapaxes(retarder, -1, -2)
    block = rest[..., 1:, 1:] / matrix[..., :1, :1]
    np.testing.assert_allclose(block, np.swapaxes(block, -1, -2), rtol=0, atol=atol)
    # without absolute values: the depolarizer takes the sign of the determinant
    values = np.linalg.eigvalsh((block + np.swapaxes(block, -1, -2)) / 2)
    hand = np.sign(np.linalg.det(matrix))
    assert np.all(hand[..., None] * values > -atol)


@given(SEED)
def test_a_matrix_is_depolarizer_retarder_and_diattenuator(seed):
    assert_rest_is_no_retarder(random_physical(seed, (6,)))
    negative = np.diag([1, -0.2, -0.25, -0.3]) @ mueller.linear_retarder(40 * u.deg)
    assert_rest_is_no_retarder(negative)
    np.testing.assert_allclose(retarder_of(negative), mueller.linear_retarder(40 * u.deg))


@given(SEED, FRACTION, RETARDANCE, ANGLE)
def test_the_retarder_of_a_chain_is_found(seed, diattenuation, retardance, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    vector = abs(retardance) * axis / np.linalg.norm(axis) * u.rad
    diattenuator = mueller.rotate(
        mueller.diattenuator_retarder(0.95 * diattenuation, 0 * u.deg), angle * u.deg
    )
    depolarizer = mueller.rotate(np.diag([1, 0.9, 0.7, 0.8]), -angle * u.deg)
    matrix = 0.8 * depolarizer @ mueller.elliptical_retarder(*vector) @ diattenuator
    np.testing.assert_allclose(mueller.retardance_vector(matrix), vector, atol=1e-8 * u.rad)


@given(RETARDANCE, RETARDANCE, RETARDANCE, st.integers(-12, 0))
def test_retardance_vector_round_trip(h, d, r, exponent):
    vector = np.array([h, d, r]) * 10.0**exponent
    length = np.linalg.norm(vector)
    if length > 3.14:
        vector *= 3.14 / length
    found = mueller.retardance_vector(mueller._elliptical_retarder(*vector))
    np.testing.assert_allclose(found.to_value(u.rad), vector, rtol=0, atol=1e-12)


def test_retardances_of_half_a_wave_and_more():
    found = mueller.retardance_vector(mueller.linear_retarder(200 * u.deg)).to_value(u.deg)
    np.testing.assert_allclose(found, [-160, 0, 0], atol=1e-10)
    # at half a wave the first component that is not zero is positive
    for axis in np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0.6, -0.8, 0]]):
        expected = np.pi * axis * np.sign(axis[np.nonzero(axis)[0][0]])
        for sign in (1, -1):
            matrix = mueller._elliptical_retarder(*(sign * np.pi * axis))
            found = mueller.retardance_vector(matrix).to_value(u.rad)
            np.testing.assert_allclose(found, expected, atol=1e-7, err_msg=str(axis))
    # an ideal mirror, and the sign flip of Q and V of the paper's beam switcher
    for diagonal, expected in (([1.0, 1, -1, -1], [180, 0, 0]), ([1.0, -1, 1, -1], [0, 180, 0])):
        vector = mueller.retardance_vector(np.diag(diagonal)).to_value(u.deg)
        np.testing.assert_allclose(vector, expected, atol=1e-10)


@given(ANGLE, ANGLE, st.floats(0.01, 1))
def test_a_polarizer_has_the_smallest_retardance_that_fits(entrance, leave, kept):
    # light enters along one axis and leaves, partly depolarized, along another
    before = mueller.rotate(0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg), entrance * u.deg)
    turn = mueller.rotation_matrix((entrance - leave) * u.deg)
    matrix = np.diag([1, kept, kept, kept]) @ turn @ before
    found = np.linalg.norm(mueller.retardance_vector(matrix)).to_value(u.deg)
    expected = 2 * abs((entrance - leave + 90) % 180 - 90)
    assert found == pytest.approx(expected, abs=1e-5)


def test_the_retarder_behind_what_is_almost_a_polarizer():
    for distance in (1e-3, 1e-6, 1e-9, 1e-12, 1e-14, 1e-16):
        first = mueller.rotate(mueller.diattenuator_retarder(1 - distance, 0 * u.deg), 20 * u.deg)
        retarder = retarder_of(ELEMENTS["elliptical"] @ first)
        # below 1e-13 it counts as a polarizer, which leaves sqrt(2 distance)
        # and just above it rounding grows with one over the distance
        atol = 1e-10 + 1e-16 / distance if distance > 1e-13 else 1.5 * np.sqrt(2 * distance) + 1e-12
        expected = ELEMENTS["elliptical"] @ first
        np.testing.assert_allclose(retarder @ first, expected, atol=atol, err_msg=str(distance))


@given(SEED, st.floats(0.01, 1))
def test_one_surviving_state_is_turned_the_short_way(seed, strength):
    enter, leave = np.random.default_rng(seed).normal(size=(2, 3))
    enter, leave = enter / np.linalg.norm(enter), leave / np.linalg.norm(leave)
    matrix = np.zeros((4, 4))
    matrix[0, 0] = 1
    matrix[1:, 1:] = strength * np.outer(leave, enter)
    found = np.linalg.norm(mueller.retardance_vector(matrix)).to_value(u.rad)
    assert found == pytest.approx(np.arccos(enter @ leave), abs=1e-6)
    # opposite states: half a wave, about any axis across
    matrix[1:, 1:] = -strength * np.outer(enter, enter)
    found = np.linalg.norm(mueller.retardance_vector(matrix)).to_value(u.deg)
    assert found == pytest.approx(180, abs=1e-5)


def test_matrices_that_leave_no_state_have_no_retarder():
    polarizing = np.zeros((4, 4))
    polarizing[:, 0] = [1, 0.3, 0, 0.1]
    for matrix in (np.diag([2.0, 0, 0, 0]), polarizing, polarizing.T):
        assert not np.any(mueller.retardance_vector(matrix).value)


# --- physicality ----------------------------------------------------------------


def test_every_element_is_physical():
    for name, matrix in EVERY.items():
        for angle in (0.0, 31.0) * u.deg:
            assert mueller.is_physical(mueller.rotate(matrix, angle), tolerance=1e-14), name


@given(st.lists(st.sampled_from(sorted(EVERY)), min_size=1, max_size=5), ANGLE)
def test_products_of_elements_are_physical(names, angle):
    matrix = np.eye(4)
    for i, name in enumerate(names):
        matrix = mueller.rotate(EVERY[name], i * angle * u.deg) @ matrix
    # crossed polarizers leave rounding only, which is relative to one here
    assert np.linalg.eigvalsh(mueller.coherency_matrix(matrix))[0] > -1e-12


def test_impossible_matrices():
    for diagonal in ([1, 1, 1, -1], [1, 1, -1, 1], [1, -1, -1, -1], [1, 1.1, 1, 1], [-1, 0, 0, 0]):
        assert not mueller.is_physical(np.diag(np.array(diagonal, dtype=float))), diagonal
    # an optic that polarizes more than fully
    matrix = 0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg)
    matrix[1, 0] *= 1.001
    assert not mueller.is_physical(matrix)
    assert mueller.is_physical(matrix, tolerance=0.1)


@given(SEED, st.integers(1, 4))
def test_mixtures_of_optics_are_physical(seed, rank):
    matrix = random_physical(seed, rank=rank)
    coherency = mueller.coherency_matrix(matrix)
    np.testing.assert_allclose(coherency, coherency.conj().T, atol=1e-13 * matrix[0, 0])
    assert np.trace(coherency).real == pytest.approx(matrix[0, 0])
    values = np.linalg.eigvalsh(coherency)
    np.testing.assert_allclose(values[: 4 - rank], 0, atol=1e-13 * matrix[0, 0])
    assert mueller.is_physical(matrix)


@given(RETARDANCE, RETARDANCE, RETARDANCE)
def test_coherency_of_a_retarder_is_that_of_its_jones_matrix(h, d, r):
    # exp(i Delta . sigma / 2) = cos(Delta / 2) + i sin(Delta / 2) axis . sigma
    vector = np.array([h, d, r])
    total = np.linalg.norm(vector)
    c = np.array([np.cos(total / 2), *(1j * np.sinc(total / 2 / np.pi) * vector / 2)])
    found = mueller.coherency_matrix(mueller._elliptical_retarder(h, d, r))
    np.testing.assert_allclose(found, np.outer(c, c.conj()), atol=1e-14)


# --- what all functions of a matrix have in common --------------------------------

FUNCTIONS_OF_A_MATRIX = [
    mueller.diattenuation_vector,
    mueller.is_physical,
    mueller.retardance_vector,
]


def test_bad_matrices_give_no_number():
    for function in FUNCTIONS_OF_A_MATRIX:
        for bad in (np.full((4, 4), np.nan), np.eye(3), np.ones(4), [["a"]]):
            with pytest.raises(ParameterError, match="matrix"):
                function(bad)
    for function in (mueller.diattenuation_vector, mueller.retardance_vector):
        for transmission in (0.0, -1.0):
            with pytest.raises(ParameterError, match=r"matrix\[0, 0\] = .* must be positive"):
                function(np.stack([np.eye(4), transmission * np.eye(4)]))
    matrix = mueller.diattenuator_retarder(1.0, 0 * u.deg)
    matrix[0, 1] = 1.02
    with pytest.raises(ParameterError, match=r"diattenuation = 1\.02 .*at most 1"):
        mueller.retardance_vector(matrix)
    for tolerance in (-1e-9, np.nan):
        with pytest.raises(ParameterError, match="tolerance"):
            mueller.is_physical(np.eye(4), tolerance)


def test_functions_of_a_matrix_are_vectorised_and_leave_it_as_it_is():
    matrix = random_physical(21, (2, 3))
    matrix[0, 1] = EVERY["polarizer"]
    copy = matrix.copy()
    for function in FUNCTIONS_OF_A_MATRIX:
        whole = function(matrix)
        for index in np.ndindex(2, 3):
            one = function(matrix[index])
            assert whole[index].shape == one.shape
            np.testing.assert_allclose(
                getattr(whole[index], "value", whole[index]), getattr(one, "value", one), atol=1e-12
            )
    np.testing.assert_array_equal(matrix, copy)
