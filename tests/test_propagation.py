# Licensed under a 3-clause BSD style license - see LICENSE
"""Fluxes and derivatives of the two sweeps against the plain matrices."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import optics
from astropolcal.chain import (
    insert_optic,
    join,
    leaves,
    stages,
    system_mueller,
    system_mueller_derivatives,
    with_beam,
)
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.propagation import Propagator
from astropolcal.units import canonical_unit

SEED = st.integers(0, 2**32 - 1)
LAM = np.array([1.2, 1.6, 2.1])
BEAMS = ("right", "left")
N_FRAMES = 4


def random_case(random_chain, seed, n_frames=N_FRAMES):
    """A chain with optics on both sides of the prism, positions (rad) and a source."""
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 3, rng.integers(1, 7), split=True)
    rotator = optics.Rotator(name="sky", theta=rng.uniform(-90, 90) * u.deg, mount="-a")
    chain = insert_optic(chain, rotator, after=rng.choice([leaf.name for leaf in leaves(chain)]))
    positions = {stage: rng.uniform(-3, 3, n_frames) for stage in ("a", "b", "c")}
    source = np.array([1.0, *rng.uniform(-0.5, 0.5, 3)])
    return rng, chain, positions, source


def with_unit(positions):
    return {stage: angle * u.rad for stage, angle in positions.items()}


def plain_fluxes(chain, positions, source):
    """Both fluxes by the system Mueller matrices, (n_wavelengths, n_frames) each."""
    matrices = [
        system_mueller(with_beam(chain, beam), LAM * u.um, with_unit(positions)) for beam in BEAMS
    ]
    return [(matrix @ source)[..., 0].T for matrix in matrices]


# --- fluxes ---------------------------------------------------------------------------------


@given(seed=SEED)
@settings(max_examples=60)
def test_fluxes_are_those_of_the_matrices(random_chain, seed):
    _, chain, positions, source = random_case(random_chain, seed)
    found = Propagator(chain, LAM, positions, source).fluxes()
    for flux, expected in zip(found, plain_fluxes(chain, positions, source), strict=True):
        assert flux.shape == (3, N_FRAMES)
        np.testing.assert_allclose(flux, expected, rtol=0, atol=1e-12)


@given(seed=SEED)
@settings(max_examples=15)
def test_as_many_frames_as_wavelengths(random_chain, seed):
    # what is one a wavelength must not be taken for one a frame
    _, chain, positions, source = random_case(random_chain, seed, n_frames=3)
    found = Propagator(chain, LAM, positions, source).fluxes()
    np.testing.assert_allclose(found, plain_fluxes(chain, positions, source), rtol=0, atol=1e-12)


@pytest.mark.parametrize("mount", [None, "hwp"])
def test_theta_may_be_one_value_a_wavelength(mount):
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(
            retardance=170 * u.deg, theta=[1, 20, 40] * u.deg, mount=mount, name="hwp"
        )
        | optics.WollastonPrism(theta=[0, 5, 9] * u.deg, name="wollaston")
    )
    for positions in ({"hwp": np.radians([0, 22.5, 45])}, {"hwp": np.radians([0, 30])}):
        found = Propagator(chain, LAM, positions).fluxes()
        expected = plain_fluxes(chain, positions, [1, 0, 0, 0])
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_rotators_before_the_first_and_after_the_last_optic():
    turned = optics.Rotator(theta=20 * u.deg, name="first"), optics.Rotator(name="last")
    prism = optics.WollastonPrism(efficiency=0.8, name="wollaston")
    chain = join([turned[0], prism, turned[1]])
    source = np.array([1, 0.3, 0.2, 0.1])
    q = np.cos(np.radians(40)) * 0.3 + np.sin(np.radians(40)) * 0.2
    right, left = Propagator(chain, LAM, {}, source).fluxes()
    np.testing.assert_allclose(right, np.full((3, 1), 0.5 * (1 + 0.8 * q)), rtol=1e-14)
    np.testing.assert_allclose(left, np.full((3, 1), 0.5 * (1 - 0.8 * q)), rtol=1e-14)


def test_half_wave_plate_modulates_the_difference():
    chain = optics.LinearRetarder(
        retardance=180 * u.deg, mount="hwp", name="hwp"
    ) | optics.WollastonPrism(name="wollaston")
    angle = np.radians(np.arange(0, 90, 11.25))
    right, left = Propagator(chain, LAM, {"hwp": angle}, [1, 0.02, -0.01, 0]).fluxes()
    expected = 0.02 * np.cos(4 * angle) - 0.01 * np.sin(4 * angle)
    np.testing.assert_allclose((right - left)[0], expected, rtol=0, atol=1e-15)
    np.testing.assert_allclose(right + left, np.ones((3, 8)), rtol=1e-14)


@given(seed=SEED)
@settings(max_examples=15)
def test_given_values_replace_the_chains_own(random_chain, seed):
    _, chain, positions, source = random_case(random_chain, seed)
    other = join(leaf.with_parameters(theta=11 * u.deg) for leaf in leaves(chain))
    values = Propagator(other, LAM, positions, source).values()
    found = Propagator(chain, LAM, positions, source).fluxes(values)
    np.testing.assert_allclose(found, plain_fluxes(other, positions, source), rtol=0, atol=1e-12)


def test_values_are_canonical_and_follow_the_chain():
    prism = optics.WollastonPrism(theta=45 * u.deg, name="wollaston")
    propagator = Propagator(prism, LAM, {})
    prism.efficiency = 0.7
    ((theta, efficiency),) = propagator.values()
    assert (theta, efficiency) == (pytest.approx(np.pi / 4), 0.7)


# --- derivatives ----------------------------------------------------------------------------


def every_parameter(chain):
    return [(i, k) for i, leaf in enumerate(leaves(chain)) for k in range(len(leaf.param_names))]


@given(seed=SEED)
@settings(max_examples=40)
def test_derivatives_are_those_of_the_matrices(random_chain, seed):
    rng, chain, positions, source = random_case(random_chain, seed)
    weights = rng.normal(size=(2, 3, N_FRAMES))
    wanted = every_parameter(chain)
    found = Propagator(chain, LAM, positions, source).forward().derivatives(wanted, weights)
    expected = [
        system_mueller_derivatives(with_beam(chain, beam), LAM * u.um, with_unit(positions))
        for beam in BEAMS
    ]
    assert set(found) == set(wanted)
    for i, k in wanted:
        leaf = leaves(chain)[i]
        key = leaf.param_names[k]
        unit = canonical_unit(getattr(leaf, key).unit) ** -1
        slopes = [d[f"{leaf.name}.{key}"].to_value(unit) @ source for d in expected]
        total = sum(w * slope[..., 0].T for w, slope in zip(weights, slopes, strict=True))
        assert found[i, k].shape == (3, N_FRAMES)
        scale = max(1.0, np.abs(total).max())
        np.testing.assert_allclose(found[i, k], total, rtol=0, atol=1e-11 * scale)


@given(seed=SEED)
@settings(max_examples=15)
def test_derivatives_against_differences(random_chain, seed):
    rng, chain, positions, source = random_case(random_chain, seed)
    propagator = Propagator(chain, LAM, positions, source)
    weights = rng.normal(size=(2, 3, N_FRAMES))
    for i, k in rng.permutation(every_parameter(chain))[:5]:
        step = 1e-4

        def at(shift, i=i, k=k, step=step):
            values = propagator.values()
            values[i][k] = values[i][k] + shift * step
            return sum(w * f for w, f in zip(weights, propagator.fluxes(values), strict=True))

        expected = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)
        found = propagator.forward().derivatives([(i, k)], weights)
        assert list(found) == [(i, k)]
        np.testing.assert_allclose(found[i, k], expected, rtol=0, atol=1e-8)


@given(seed=SEED)
@settings(max_examples=10)
def test_derivatives_asked_for_together_and_alone(random_chain, seed):
    rng, chain, positions, source = random_case(random_chain, seed)
    sweep = Propagator(chain, LAM, positions, source).forward()
    weights = rng.normal(size=(2, 3, N_FRAMES))
    wanted = every_parameter(chain)
    together = sweep.derivatives(wanted, weights)
    for key in wanted[:: max(1, len(wanted) // 5)]:
        np.testing.assert_array_equal(sweep.derivatives([key], weights)[key], together[key])
    assert sweep.derivatives([], weights) == {}


@given(seed=SEED)
@settings(max_examples=10)
def test_derivatives_are_linear_in_the_weights(random_chain, seed):
    rng, chain, positions, source = random_case(random_chain, seed)
    sweep = Propagator(chain, LAM, positions, source).forward()
    right, left = rng.normal(size=(2, 3, N_FRAMES))
    wanted, none = every_parameter(chain), np.zeros((3, N_FRAMES))
    both = sweep.derivatives(wanted, (right, left))
    one, other = sweep.derivatives(wanted, (right, none)), sweep.derivatives(wanted, (none, left))
    for key in wanted:
        scale = max(1.0, np.abs(both[key]).max())
        np.testing.assert_allclose(both[key], one[key] + other[key], rtol=0, atol=1e-12 * scale)


# --- what is refused ------------------------------------------------------------------------


def test_chain_without_beam_splitter():
    with pytest.raises(ChainError, match="no beam splitter, so it predicts no beam fluxes"):
        Propagator(optics.LinearPolarizer(), LAM, {})


def test_stage_without_position():
    chain = optics.LinearRetarder(mount="hwp", name="plate") | optics.WollastonPrism()
    assert stages(chain) == ("hwp",)
    with pytest.raises(ChainError, match=r"optic plate stands on stage 'hwp'; .* \['altitude'\]"):
        Propagator(chain, LAM, {"altitude": np.zeros(2)})


def test_stages_with_different_numbers_of_positions():
    chain = optics.LinearRetarder(mount="hwp") | optics.WollastonPrism(mount="rotator")
    with pytest.raises(ChainError, match=r"different numbers of positions: .*'hwp': 2"):
        Propagator(chain, LAM, {"hwp": np.zeros(2), "rotator": np.zeros(3)})
    still = Propagator(chain, LAM, {"hwp": np.zeros(2), "rotator": np.zeros(1)})
    assert still.fluxes()[0].shape == (3, 2)


def test_parameters_on_another_wavelength_grid():
    chain = optics.WollastonPrism(efficiency=[0.9, 0.8], name="wollaston")
    propagator = Propagator(chain, np.array([1.6]), {})
    with pytest.raises(ParameterError, match=r"wollaston.efficiency has 2 values.* 1 wavelengths"):
        propagator.fluxes()
    # a measurement gives each dataset the values on its own grid
    right, _ = propagator.fluxes([[np.array(0.0), np.array(0.9)]])
    assert right.shape == (1, 1)


def test_unknown_chain():
    with pytest.raises(ChainError, match="is not an optic"):
        Propagator("wollaston", LAM, {})
