# Licensed under a 3-clause BSD style license - see LICENSE
"""Chains: their optics, their edits, and the system Mueller matrix with derivatives."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import CompoundModel
from astropy.modeling.models import Identity, Scale
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import optics
from astropolcal.chain import (
    at_positions,
    find_optic,
    insert_optic,
    join,
    leaves,
    remove_optic,
    replace_optic,
    stages,
    system_mueller,
    system_mueller_derivatives,
    with_beam,
)
from astropolcal.exceptions import ChainError, ParameterError, WavelengthRangeError
from astropolcal.units import canonical_unit

SEED = st.integers(0, 2**32 - 1)
WAVELENGTH = [1.2, 1.6, 2.1] * u.um
STAGES = ("a", "b", "c")


@pytest.fixture
def charis():
    """The chain of the CHARIS paper for the polarized internal source."""
    return (
        optics.LinearPolarizer(theta=90 * u.deg, name="calibration_polarizer")
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp")
        | optics.EllipticalRetarder(
            horizontal=[99, 120, 150] * u.deg, diagonal=4 * u.deg, mount="derotator", name="der"
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )


def names(chain):
    return [leaf.name for leaf in leaves(chain)]


def random_positions(rng, shape):
    return {stage: rng.uniform(-180, 180, shape) * u.deg for stage in STAGES}


# --- the paper's product, written out one frame and wavelength at a time ------------------


def turn(angle):
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1]])


def plain_product(chain, j, positions):
    """T(-theta) M T(theta) of each optic, for wavelength j and positions in radian."""
    total = np.eye(4)
    for leaf in leaves(chain):
        theta = np.radians(np.broadcast_to(leaf.theta.value, 3)[j])
        values = {
            key: np.broadcast_to(getattr(leaf, key).value, 3)[j] * (getattr(leaf, key).unit or 1)
            for key in leaf.own_names
        }
        settings = leaf._settings()
        mount = settings.pop("mount")
        own = type(leaf)(**values, **settings)
        moved = 0.0
        if mount:
            moved = (-1 if mount[0] == "-" else 1) * positions[mount.strip("-")]
        if not isinstance(leaf, optics.FrameOptic):
            matrix, theta = own.mueller(WAVELENGTH[j]), theta + moved
        else:
            # without a sign, and at its own orientation
            own.mount = mount and mount.strip("-")
            unit = u.one if own.mount in optics.COORDINATES else u.rad
            matrix = own.mueller(WAVELENGTH[j], moved * unit)
        if isinstance(leaf, optics.Rotator):
            total = turn(theta) @ total
        else:
            total = turn(-theta) @ matrix @ turn(theta) @ total
    return total


@pytest.fixture
def uneven():
    """A chain that changes from frame to frame in every way."""
    return (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.DriftRotator(rate=5 * u.deg, mount="-sequence", name="drift")
        | optics.HarmonicRotator(cosine=3 * u.deg, mount="-hwp", name="encoder")
        | optics.LinearRetarder(retardance=[150, 170, 190] * u.deg, mount="-hwp", name="hwp")
        | optics.HarmonicRetarder(
            sine=[10, 12, 14] * u.deg, theta=7 * u.deg, harmonic=2, mount="-hwp", name="tilt"
        )
        | optics.WollastonPrism(efficiency=0.9, name="wollaston")
        | optics.HarmonicGain(cosine=0.1, differential=True, mount="hwp", name="wander")
        | optics.FluxGain(right=0.2, left=[-0.1, 0.1, 0.3], mount="flux", name="bend")
        | optics.FluxGain(right=0.1, left=0.2, power=-1, mount="previous_flux", name="persistence")
    )


def uneven_positions(rng, n_frames):
    return {
        "hwp": rng.uniform(-180, 180, n_frames) * u.deg,
        "sequence": np.linspace(0, 1, n_frames),
        "flux": rng.uniform(0.1, 1.0, (n_frames, 3)),
        "previous_flux": rng.uniform(0.5, 2.0, (n_frames, 3)),
    }


@given(seed=SEED, n_optics=st.integers(1, 7))
@settings(max_examples=30)
def test_system_mueller_is_the_plain_product(random_chain, seed, n_optics):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 3, n_optics, split=rng.random() < 0.5)
    positions = random_positions(rng, 4)
    found = system_mueller(chain, WAVELENGTH, positions)
    assert found.shape == (4, 3, 4, 4)
    for i, j in np.ndindex(4, 3):
        here = {stage: angle.to_value(u.rad)[i] for stage, angle in positions.items()}
        expected = plain_product(chain, j, here)
        np.testing.assert_allclose(found[i, j], expected, rtol=0, atol=1e-12)


@given(seed=SEED)
@settings(max_examples=30)
def test_light_through_the_chain_is_the_system_matrix(random_chain, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 3)
    positions = random_positions(rng, 4)
    source = rng.normal(size=4)
    columns = {name: positions[name][:, None] for name in stages(chain)}
    through = at_positions(chain, **columns)(WAVELENGTH, *source)
    light = np.stack(np.broadcast_arrays(*through[1:]), axis=-1)
    expected = system_mueller(chain, WAVELENGTH, positions) @ source
    light = np.broadcast_to(light, expected.shape)
    np.testing.assert_allclose(light, expected, rtol=0, atol=1e-12)


@given(seed=SEED)
@settings(max_examples=20)
def test_light_of_one_frame_and_wavelength(random_chain, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 0)
    positions = random_positions(rng, None)
    here = {name: positions[name] for name in stages(chain)}
    through = at_positions(chain, **here)(1.6 * u.um, 1, 0.2, -0.3, 0.1)
    matrix = system_mueller(chain, 1.6 * u.um, positions)
    assert matrix.shape == (4, 4)
    np.testing.assert_allclose(through[1:], matrix @ [1, 0.2, -0.3, 0.1], rtol=0, atol=1e-12)


def test_shapes(charis):
    for wavelength in [1.6 * u.um, [1.2, 1.6, 2.1] * u.um]:
        for frames in [None, 1, 5]:
            chain = charis if np.ndim(wavelength) else remove_optic(charis, "der")
            angle = np.zeros(frames or ()) * u.deg
            expected = (() if frames is None else (frames,)) + np.shape(wavelength) + (4, 4)
            positions = dict.fromkeys(stages(chain), angle)
            assert system_mueller(chain, wavelength, positions).shape == expected, (
                wavelength,
                frames,
            )
            for derivative in system_mueller_derivatives(chain, wavelength, positions).values():
                assert derivative.shape == expected, (wavelength, frames)
    # shape does not depend on what the optics need
    chain = optics.ParityFlip(name="nbs")
    positions = {"hwp": np.zeros(5) * u.deg}
    assert system_mueller(chain).shape == (4, 4)
    assert system_mueller(chain, WAVELENGTH).shape == (3, 4, 4)
    assert system_mueller(chain, None, positions).shape == (5, 4, 4)
    assert system_mueller(chain, WAVELENGTH, positions).shape == (5, 3, 4, 4)
    # frame optics
    for wavelength in [None, 1.6 * u.um, [1.2, 1.6, 2.1] * u.um]:
        for frames in [(), (4,)]:
            chain = (
                optics.HarmonicRetarder(cosine=20 * u.deg, mount="hwp", name="tilt")
                | optics.WollastonPrism(name="wollaston")
                | optics.FluxGain(right=0.1, mount="flux", name="bend")
            )
            hwp, flux = np.full(frames, 30) * u.deg, np.full(frames, 0.5)
            found = system_mueller(chain, wavelength, {"hwp": hwp, "flux": flux})
            grid = () if wavelength is None else wavelength.shape
            assert found.shape == (*frames, *grid, 4, 4), (wavelength, frames)
            one = system_mueller(chain, None, {"hwp": 30 * u.deg, "flux": 0.5})
            np.testing.assert_allclose(found, np.broadcast_to(one, found.shape), rtol=0, atol=1e-15)


def test_stage_that_stands_still_may_be_scalar(charis):
    scalar = {"hwp": [0, 45] * u.deg, "derotator": 30 * u.deg}
    full = scalar | {"derotator": [30, 30] * u.deg}
    np.testing.assert_array_equal(
        system_mueller(charis, WAVELENGTH, scalar), system_mueller(charis, WAVELENGTH, full)
    )


def test_frame_optics_in_the_plain_product(uneven):
    for beam in ["right", "left"]:
        chain, positions = with_beam(uneven, beam), uneven_positions(np.random.default_rng(1), 5)
        found = system_mueller(chain, WAVELENGTH, positions)
        assert found.shape == (5, 3, 4, 4), beam
        for i, j in np.ndindex(5, 3):
            here = {
                "hwp": positions["hwp"][i].to_value(u.rad),
                "sequence": positions["sequence"][i],
            }
            here |= {name: positions[name][i, j] for name in ("flux", "previous_flux")}
            expected = plain_product(chain, j, here)
            np.testing.assert_allclose(found[i, j], expected, rtol=0, atol=1e-13)


def test_light_through_frame_optics(uneven):
    positions = uneven_positions(np.random.default_rng(2), 5)
    columns = positions | {name: positions[name][:, None] for name in ("hwp", "sequence")}
    through = at_positions(uneven, **columns)(WAVELENGTH, 1, 0.2, 0.1, -0.1)
    light = np.stack(np.broadcast_arrays(*through[1:]), axis=-1)
    expected = system_mueller(uneven, WAVELENGTH, positions) @ [1, 0.2, 0.1, -0.1]
    np.testing.assert_allclose(light, expected, rtol=0, atol=1e-13)


def test_flux_may_be_the_same_at_all_wavelengths(uneven):
    positions = uneven_positions(np.random.default_rng(3), 4)
    same = positions | {"flux": np.linspace(0.1, 0.4, 4), "previous_flux": 1.5}
    full = positions | {
        "flux": np.repeat(np.linspace(0.1, 0.4, 4), 3).reshape(4, 3),
        "previous_flux": np.full((4, 3), 1.5),
    }
    np.testing.assert_array_equal(
        system_mueller(uneven, WAVELENGTH, same), system_mueller(uneven, WAVELENGTH, full)
    )


# --- derivatives --------------------------------------------------------------------------


def moved(chain, name, change):
    """A copy of the chain with ``optic.parameter`` moved, in canonical units."""
    optic, key = name.split(".")
    old = find_optic(chain, optic)
    unit = getattr(old, key).unit
    step = change if unit is None else change * (u.rad if unit == u.deg else u.um)
    new = old.with_parameters(**{key: getattr(old, key).value * (unit or 1) + step})
    return replace_optic(chain, optic, new)


@given(seed=SEED)
@settings(max_examples=6)
def test_derivatives_against_differences(random_chain, seed):
    rng = np.random.default_rng(seed)
    chain = random_chain(rng, 3, 4, split=True)
    positions = random_positions(rng, 2)
    derivatives = system_mueller_derivatives(chain, WAVELENGTH, positions)
    wanted = [f"{leaf.name}.{key}" for leaf in leaves(chain) for key in leaf.param_names]
    assert set(derivatives) == set(wanted)
    for name in rng.choice(wanted, 6):
        step = 1e-4

        def at(shift, name=name, step=step):
            return system_mueller(moved(chain, name, shift * step), WAVELENGTH, positions)

        expected = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)
        found = derivatives[name].to_value(canonical_unit(derivatives[name].unit ** -1) ** -1)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8, err_msg=name)


def test_derivatives_of_frame_optics(uneven):
    for beam in ["right", "left"]:
        chain, positions = with_beam(uneven, beam), uneven_positions(np.random.default_rng(4), 4)
        derivatives = system_mueller_derivatives(chain, WAVELENGTH, positions)
        wanted = [f"{leaf.name}.{key}" for leaf in leaves(chain) for key in leaf.param_names]
        assert set(derivatives) == set(wanted), beam
        step = 1e-3
        for name in wanted:
            at = [
                system_mueller(moved(chain, name, n * step), WAVELENGTH, positions)
                for n in (-2, -1, 1, 2)
            ]
            expected = (8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * step)
            found = derivatives[name].to_value(canonical_unit(derivatives[name].unit ** -1) ** -1)
            assert found.shape == (4, 3, 4, 4), beam
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9, err_msg=name)


def test_derivatives_need_names():
    with pytest.raises(ChainError, match="ParityFlip needs a name"):
        system_mueller_derivatives(optics.ParityFlip() | optics.WollastonPrism(name="wollaston"))


# --- what is refused ------------------------------------------------------------------------


def test_bad_wavelengths_and_positions(charis):
    still = {"hwp": 0 * u.deg, "derotator": 0 * u.deg}
    with pytest.raises(ParameterError, match=r"der\.horizontal has 3 values"):
        system_mueller(charis, 1.6 * u.um, still)
    with pytest.raises(ParameterError, match="depends on wavelength: give one"):
        system_mueller(charis, None, still)
    with pytest.raises(ParameterError, match=r"wavelength has shape \(1, 3\)"):
        system_mueller(charis, WAVELENGTH[None], still)
    with pytest.raises(ParameterError, match="needs a unit such as um"):
        system_mueller(charis, [1.2, 1.6, 2.1], still)
    with pytest.raises(WavelengthRangeError):
        system_mueller(charis, [1.2, 1.6, 99] * u.um, still)
    with pytest.raises(ParameterError, match="hwp = 3 needs a unit"):
        system_mueller(charis, WAVELENGTH, still | {"hwp": 3})
    with pytest.raises(ParameterError, match="hwp = nan deg must be finite"):
        system_mueller(charis, WAVELENGTH, still | {"hwp": np.nan * u.deg})
    for function in (system_mueller, system_mueller_derivatives):
        with pytest.raises(ChainError, match=r"hwp has shape \(2, 1\); allowed are a scalar"):
            function(charis, WAVELENGTH, still | {"hwp": [[0], [10]] * u.deg})
    # missing stage
    with pytest.raises(ChainError, match=r"optic der stands on stage 'derotator', but positions"):
        system_mueller(charis, WAVELENGTH, {"hwp": 0 * u.deg})
    with pytest.raises(ChainError, match=r"has only \[\]"):
        system_mueller_derivatives(charis, WAVELENGTH)
    # stages of different lengths
    positions = {"hwp": [0, 45] * u.deg, "derotator": [1, 2, 3] * u.deg}
    for function in (system_mueller, system_mueller_derivatives):
        with pytest.raises(ChainError, match=r"different shapes: .*'hwp': \(2,\)"):
            function(charis, WAVELENGTH, positions)


def test_angle_and_number_are_not_exchanged(uneven):
    positions = uneven_positions(np.random.default_rng(5), 2)
    wrong = {
        "hwp": (np.zeros(2), r"hwp = .* needs a unit such as rad"),
        "sequence": ([0, 1] * u.deg, "sequence has unit deg, which is not convertible"),
        "flux": ([5, 6] * u.adu, "flux has unit adu, which is not convertible"),
        "previous_flux": ([1, np.inf], r"previous_flux = .* must be finite"),
    }
    for name, (value, message) in wrong.items():
        with pytest.raises(ParameterError, match=message):
            system_mueller(uneven, WAVELENGTH, positions | {name: value})
        with pytest.raises(ParameterError, match=message.replace(name, "position", 1)):
            at_positions(uneven, **{name: value})
    with pytest.raises(ChainError, match=r"drift stands on stage 'sequence', but positions"):
        system_mueller(uneven, WAVELENGTH, {"hwp": 0 * u.deg})


def test_flux_of_another_shape(uneven):
    for shape in [(2, 4), (3, 2), (2, 2, 3)]:
        positions = uneven_positions(np.random.default_rng(5), 2) | {"flux": np.ones(shape)}
        with pytest.raises(ChainError, match=r"flux has shape .*; allowed are .* \(n_frames, 3\)"):
            system_mueller(uneven, WAVELENGTH, positions)
        with pytest.raises(ChainError, match=r"allowed are a scalar, \(n_frames,\)$"):
            system_mueller(uneven["wollaston"], 1.6 * u.um, {"flux": np.ones((2, 3))})


def test_optics_share_no_name():
    one = optics.ParityFlip(name="nbs")
    with pytest.raises(ChainError, match="need different names; nbs occurs more than once"):
        leaves(one | optics.Depolarizer(name="nbs"))
    with pytest.raises(ChainError, match="nbs occurs more than once"):
        join([one, one])
    with pytest.raises(ChainError, match="nbs occurs more than once"):
        insert_optic(one, optics.Depolarizer(name="nbs"), after="nbs")


def test_what_is_no_chain():
    for model, message in [
        (optics.ParityFlip() + optics.ParityFlip(), r"joined with \|, not with \+"),
        (optics.ParityFlip() & optics.ParityFlip(), r"not with &"),
        (optics.ParityFlip() | Identity(5), "Identity is not an optic"),
        (Scale(2), "Scale is not an optic"),
        ("hwp", "str is not an optic"),
        (None, "NoneType is not an optic"),
    ]:
        for function in (leaves, stages, system_mueller, lambda chain: join([chain, chain])):
            with pytest.raises(ChainError, match=message):
                function(model)
    # chain of nothing
    with pytest.raises(ChainError, match="at least one optic"):
        join([])
    with pytest.raises(ChainError, match="at least one optic"):
        remove_optic(optics.ParityFlip(name="nbs"), "nbs")


def test_unknown_optic(charis):
    with pytest.raises(ChainError, match=r"no optic 'wolaston'.*did you mean 'wollaston'\?"):
        find_optic(charis, "wolaston")
    with pytest.raises(ChainError, match=r"it has calibration_polarizer, hwp, der, wollaston$"):
        find_optic(charis, "zzz")
    with pytest.raises(ChainError, match="it has no optic with a name"):
        find_optic(optics.ParityFlip(), "nbs")
    for edit in (remove_optic, lambda c, n: replace_optic(c, n, optics.ParityFlip())):
        with pytest.raises(ChainError, match="no optic 'm3'"):
            edit(charis, "m3")
    # insert needs one neighbour
    for neighbours in [{}, {"after": "hwp", "before": "der"}]:
        with pytest.raises(ChainError, match="exactly one neighbour"):
            insert_optic(charis, optics.ParityFlip(name="nbs"), **neighbours)
    with pytest.raises(ChainError, match="no optic 'nbs'"):
        insert_optic(charis, optics.ParityFlip(), after="nbs")


# --- edits ----------------------------------------------------------------------------------


def test_leaves_in_the_order_of_the_light(charis):
    assert names(charis) == ["calibration_polarizer", "hwp", "der", "wollaston"]
    assert leaves(charis)[1] is charis["hwp"]
    assert names(charis[0] | (charis[1] | (charis[2] | charis[3]))) == names(charis)
    assert leaves(charis[0]) == [charis[0]]


def test_join_is_the_inverse_of_leaves(charis):
    assert all(a is b for a, b in zip(leaves(join(leaves(charis))), leaves(charis), strict=True))
    assert join(iter([charis[0]])) is charis[0]
    assert names(join([charis, optics.ParityFlip(name="nbs")]))[-1] == "nbs"


def test_edits_share_the_rest_and_leave_the_chain_alone(charis):
    before = names(charis)
    nbs = optics.ParityFlip(name="nbs")
    assert names(insert_optic(charis, nbs, after="hwp"))[1:4] == ["hwp", "nbs", "der"]
    assert names(insert_optic(charis, nbs, before="hwp"))[1:3] == ["nbs", "hwp"]
    assert names(insert_optic(charis, nbs, after="wollaston"))[-1] == "nbs"
    assert names(remove_optic(charis, "der")) == ["calibration_polarizer", "hwp", "wollaston"]
    edited = replace_optic(charis, "der", nbs)
    assert names(edited) == ["calibration_polarizer", "hwp", "nbs", "wollaston"]
    assert edited["hwp"] is charis["hwp"]
    assert names(charis) == before


def test_stages_are_named_once_and_without_sign(charis):
    assert stages(charis) == ("hwp", "derotator")
    sky = optics.Rotator(mount="p") | optics.Rotator(mount="-a") | optics.ParityFlip(mount="a")
    assert stages(sky) == ("p", "a")
    assert stages(optics.ParityFlip()) == ()


def test_with_beam_is_a_copy(charis, uneven):
    left = with_beam(charis, "left")
    assert (left["wollaston"].beam, charis["wollaston"].beam) == ("left", "right")
    assert left["wollaston"].efficiency.value == 0.98
    with pytest.raises(ParameterError, match="beam = 'up'"):
        with_beam(charis, "up")
    with pytest.raises(ChainError, match="no beam splitter"):
        with_beam(remove_optic(charis, "wollaston"), "left")
    # with beam turns all that follow a beam
    left = with_beam(uneven, "left")
    assert [leaf.name for leaf in leaves(left) if getattr(leaf, "beam", "") == "left"] == [
        "wollaston", "wander", "bend", "persistence",
    ]  # fmt: skip
    assert uneven["bend"].beam == "right"
    with pytest.raises(ChainError, match="no beam splitter"):
        with_beam(uneven["wander"] | uneven["bend"], "left")


def test_at_positions_is_a_copy(charis):
    moved = at_positions(charis, hwp=45 * u.deg)
    assert moved["hwp"].position.to_value(u.deg) == pytest.approx(45)
    assert moved["der"].position == charis["hwp"].position == 0 * u.rad
    with pytest.raises(ChainError, match=r"no stage 'altitude' in the chain; it has hwp, derot"):
        at_positions(charis, altitude=1 * u.deg)
    with pytest.raises(ChainError, match="it has none"):
        at_positions(optics.ParityFlip(), hwp=1 * u.deg)
    with pytest.raises(ParameterError, match="needs a unit"):
        at_positions(charis, hwp=45)


# --- what we rely on in astropy ---------------------------------------------------------------


def test_astropy_idioms(charis):
    assert charis.submodel_names == ("calibration_polarizer", "hwp", "der", "wollaston")
    assert charis.n_submodels == 4
    assert charis["wollaston"].efficiency == 0.98
    copy = charis.copy()
    copy["wollaston"].efficiency = 0.5
    assert charis["wollaston"].efficiency == 0.98
    assert copy["hwp"].mount == "hwp"
    replaced = charis.replace_submodel("der", optics.ParityFlip(name="nbs"))
    assert names(replaced) == ["calibration_polarizer", "hwp", "nbs", "wollaston"]
    assert "der" in charis.submodel_names
    # constraints survive a copy
    charis["der"].theta.fixed, charis["der"].theta.bounds = False, (-5, 5)
    copy = charis.copy()["der"].theta
    assert (copy.fixed, copy.bounds) == (False, (-5, 5))
    # change through the compound reaches the optic
    charis.efficiency_3 = 0.5
    assert charis["wollaston"].efficiency.value == 0.5
    charis.theta_1 = 3 * u.deg
    assert charis["hwp"].theta.quantity == 3 * u.deg


def test_private_behaviour_of_astropy(charis):
    # `leaves` walks the tree by these attributes
    assert isinstance(charis, CompoundModel)
    assert charis.op == "|"
    assert isinstance(charis.left, CompoundModel)
    assert charis.right is charis["wollaston"]
    # an optic's parameters live in its __dict__, and are those of the compound
    assert charis["wollaston"].__dict__["efficiency"] is charis["wollaston"].efficiency
    assert charis.efficiency_3 is charis["wollaston"].efficiency
    # the class keeps the declaration that `Optic._declared` reads
    assert type(charis["hwp"]).__dict__["w_sio2"].unit == u.mm
    assert optics.Optic.standard_broadcasting is False
    # inherited parameters come first
    assert charis["der"].param_names == ("theta", "horizontal", "diagonal", "circular")
