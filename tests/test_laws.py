# Licensed under a 3-clause BSD style license - see LICENSE
"""
Laws of chains, observables and tables, whatever optics they are made of.

Those of a single optic are in ``tests/optics/test_registry.py``; here random
chains are drawn from the registry, so that a new optic or observable is tested
without a line of its own.
"""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import vstack
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from astropolcal import mueller, optics
from astropolcal.chain import (
    insert_optic,
    join,
    leaves,
    system_mueller,
    system_mueller_derivatives,
)
from astropolcal.measurement import Measurement
from astropolcal.observations import OBSERVABLES, Observations
from astropolcal.optics import OPTICS
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.units import canonical_unit

WAVELENGTH = [1.2, 1.6, 2.1] * u.um
SEED = st.integers(0, 2**32 - 1)
ANGLE = st.floats(-180, 180)
OTHER_UNIT = {u.rad: u.arcmin, u.um: u.m, u.dimensionless_unscaled: u.percent}


def draw(random_chain, seed, n_optics=5):
    """Return a random chain and positions of its stages in two frames."""
    rng = np.random.default_rng(seed)
    positions = {stage: rng.uniform(-180, 180, 2) * u.deg for stage in "abc"}
    return random_chain(rng, 3, n_optics, split=rng.random() < 0.5), positions


def whole(chain, positions, wavelength=WAVELENGTH):
    return system_mueller(chain, wavelength, positions)


# --- composition --------------------------------------------------------------------


def _does_nothing(name):
    optic = OPTICS[name]().loosened(WAVELENGTH)
    return np.array_equal(np.broadcast_to(optic.mueller(WAVELENGTH), (3, 4, 4)), [np.eye(4)] * 3)


@given(seed=SEED, data=st.data())
@settings(max_examples=5)
def test_optic_that_does_nothing_may_stand_anywhere(random_chain, seed, data):
    for name in [name for name in OPTICS if _does_nothing(name)]:
        chain, positions = draw(random_chain, seed, 3)
        place = data.draw(st.sampled_from([leaf.name for leaf in leaves(chain)]))
        more = insert_optic(chain, OPTICS[name](name="more"), before=place)
        np.testing.assert_allclose(
            whole(more, positions), whole(chain, positions), rtol=0, atol=1e-14
        )


@given(seed=SEED)
@settings(max_examples=40)
def test_what_follows_physical_optics_is_physical(random_chain, seed):
    chain, positions = draw(random_chain, seed, 8)
    train = [leaf for leaf in leaves(chain) if np.all(mueller.is_physical(whole(leaf, positions)))]
    assume(len(train) > 1)
    assert np.all(mueller.is_physical(whole(join(train), positions)))


# --- orientation --------------------------------------------------------------------


@given(seed=SEED, angle=ANGLE)
@settings(max_examples=30)
def test_turning_every_optic_turns_the_chain(random_chain, seed, angle):
    chain, positions = draw(random_chain, seed)
    turned = [
        leaf
        if leaf.rotates_frame
        else leaf.with_parameters(theta=leaf.theta.value * u.deg + angle * u.deg)
        for leaf in leaves(chain)
    ]
    expected = mueller.rotate(whole(chain, positions), angle * u.deg)
    # rotators do not turn with the rest, but commute with what turns them
    np.testing.assert_allclose(whole(join(turned), positions), expected, rtol=0, atol=1e-11)


# --- units --------------------------------------------------------------------------


def in_other_units(leaf):
    """The same optic, its parameters given in units that it does not use itself."""
    values = {}
    for key in leaf.param_names:
        parameter = getattr(leaf, key)
        own = parameter.unit or u.dimensionless_unscaled
        values[key] = (parameter.value * own).to(OTHER_UNIT[canonical_unit(own)])
    return leaf.with_parameters(**values)


@given(seed=SEED)
@settings(max_examples=20)
def test_any_unit_gives_the_same_chain_and_derivatives(random_chain, seed):
    chain, positions = draw(random_chain, seed, 4)
    other = join([in_other_units(leaf) for leaf in leaves(chain)])
    moved = {stage: angle.to(u.arcsec) for stage, angle in positions.items()}
    wavelength = WAVELENGTH.to(u.nm)
    np.testing.assert_allclose(
        whole(other, moved, wavelength), whole(chain, positions), rtol=0, atol=1e-10
    )
    expected = system_mueller_derivatives(chain, WAVELENGTH, positions)
    found = system_mueller_derivatives(other, wavelength, moved)
    assert list(found) == list(expected)
    for name, derivative in expected.items():
        scale = 1e-9 * max(1.0, np.abs(derivative.value).max())
        np.testing.assert_allclose(
            found[name].to_value(derivative.unit), derivative.value, rtol=0, atol=scale
        )


# --- observables --------------------------------------------------------------------


@pytest.fixture(scope="module")
def polarimeter():
    return (
        optics.LinearPolarizer(theta=80 * u.deg, name="polarizer", fixed={"theta": False})
        | optics.LinearRetarder(retardance=[150, 170, 190] * u.deg, mount="hwp", name="hwp")
        | optics.EllipticalRetarder(
            horizontal=-99 * u.deg, diagonal=4 * u.deg, mount="derotator", name="derotator"
        )
        | optics.FerroelectricLiquidCrystal(retardance=175 * u.deg, mount="flc_state", name="flc")
        | optics.WollastonPrism(efficiency=[0.9, 0.95, 0.97], name="wollaston")
    )


@pytest.fixture(scope="module")
def table(polarimeter):
    both = [half_wave_plate_cycles(derotator=[45, 62] * u.deg) for _ in "AB"]
    for state, frames in enumerate(both):
        frames["flc_state"] = np.full(len(frames), float(state))
    frames = vstack(both)
    return simulate(polarimeter, WAVELENGTH, frames, flux=1e5, seed=3).to_table()


def measured(chain, table, observable):
    """Data, their errors, predictions and Jacobian."""
    measurement = Measurement(chain, Observations.from_table(table), observable=observable)
    vector = measurement.vector()
    return (
        measurement.observed,
        measurement.sigma,
        measurement.predict(vector),
        measurement.jacobian(vector),
    )


def assert_same(found, expected, rtol=1e-9):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=rtol, atol=1e-12)


def test_units_of_the_table_do_not_matter(polarimeter, table):
    for observable in OBSERVABLES:
        other = table.copy()
        units = {"wavelength": u.m, "hwp": u.rad, "derotator": u.arcsec}
        for name, unit in units.items():
            other[name] = other[name].to(unit)
        assert_same(
            measured(polarimeter, other, observable), measured(polarimeter, table, observable)
        )


def test_scale_and_unit_of_the_flux_do_not_matter(polarimeter, table):
    for factor in [1e-3, 1.0, 1e6]:
        for observable in OBSERVABLES:
            other = table.copy()
            for name in [name for name in table.colnames if name.startswith("flux_")]:
                other[name] = factor * other[name].value * u.electron
            assert_same(
                measured(polarimeter, other, observable), measured(polarimeter, table, observable)
            )


def test_order_of_the_rows_does_not_matter(polarimeter, table):
    for observable in OBSERVABLES:
        shuffled = table[np.random.default_rng(5).permutation(len(table))]
        assert_same(
            measured(polarimeter, shuffled, observable), measured(polarimeter, table, observable)
        )


def test_exchanged_beams_are_a_prism_turned_by_90_deg(polarimeter, table):
    for observable in OBSERVABLES:
        other = table.copy()
        for name in ("flux_{}", "flux_{}_err"):
            right, left = name.format("right"), name.format("left")
            other[right], other[left] = table[left], table[right]
        turned = polarimeter.copy()
        turned["wollaston"].theta = 90 * u.deg
        observed, sigma, predicted, _ = measured(turned, other, observable)
        before, error, as_before, _ = measured(polarimeter, table, observable)
        assert_same((-observed, sigma, -predicted), (before, error, as_before))


@given(angle=ANGLE)
@settings(max_examples=8)
def test_polarimeter_turned_as_a_whole_sees_the_same(polarimeter, table, angle):
    for observable in OBSERVABLES:
        turned = join(
            [
                leaf.with_parameters(theta=leaf.theta.value * u.deg + angle * u.deg)
                for leaf in leaves(polarimeter)
            ]
        )
        for leaf in leaves(turned):
            leaf.theta.bounds = (None, None)
        assert_same(measured(turned, table, observable), measured(polarimeter, table, observable))


def test_half_wave_plate_turned_by_45_deg_changes_the_sign(polarimeter, table):
    """For a perfect plate, as all other optics but polarizer and prism do not polarize."""
    for observable in [name for name, one in OBSERVABLES.items() if one.frames_per_datum > 1]:
        plate = polarimeter.copy()
        plate["hwp"].retardance = [180, 180, 180] * u.deg
        turned = plate.copy()
        turned["hwp"].theta.bounds = (None, None)
        turned["hwp"].theta = 45 * u.deg
        before, after = (measured(one, table, observable)[2] for one in (plate, turned))
        np.testing.assert_allclose(after, -before, rtol=0, atol=1e-12)
