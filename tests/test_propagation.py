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
from astropolcal.measurement import Measurement
from astropolcal.observations import OBSERVABLES
from astropolcal.propagation import Propagator
from astropolcal.simulation import half_wave_plate_cycles, simulate
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


def frame_case(seed, n_frames=N_FRAMES):
    """
    A chain that changes from frame to frame in every way, on both sides of the prism.

    Parameters are scalars or one a wavelength, the stages have either sign, and
    the fluxes differ between beams, wavelengths and frames.
    """
    rng = np.random.default_rng(seed)

    def value(limit, unit=1):
        return rng.uniform(-limit, limit, None if rng.random() < 0.5 else 3) * unit

    def stage(name):
        return rng.choice(["", "-"]) + name

    def waves(limit, unit=1):
        harmonic = int(rng.choice([1, 2, 4]))
        return {"cosine": value(limit, unit), "sine": value(limit, unit), "harmonic": harmonic}

    train = [
        optics.LinearPolarizer(theta=value(90, u.deg), name="polarizer"),
        optics.DriftRotator(rate=value(30, u.deg), mount=stage("sequence"), name="drift"),
        optics.HarmonicRotator(**waves(30, u.deg), mount=stage("a"), name="encoder"),
        optics.LinearRetarder(retardance=value(180, u.deg), mount=stage("a"), name="plate"),
        optics.HarmonicRetarder(
            **waves(60, u.deg), theta=value(90, u.deg), mount=stage("a"), name="tilt"
        ),
        optics.HarmonicGain(**waves(0.3), mount=stage("a"), name="dust"),
        optics.WollastonPrism(efficiency=rng.uniform(0.2, 1), theta=5 * u.deg, name="wollaston"),
        optics.HarmonicRetarder(**waves(60, u.deg), mount=stage("b"), name="window"),
        optics.HarmonicGain(
            **waves(0.3), differential=True, mount=stage("b"), theta=9 * u.deg, name="wander"
        ),
        optics.FluxGain(
            right=value(0.4), left=value(0.4), reference=0.7, mount="flux", name="bend"
        ),
        optics.FluxGain(
            right=value(0.2), left=value(0.2), power=-1, mount="previous_flux", name="lag"
        ),
    ]
    positions = {name: rng.uniform(-3, 3, n_frames) for name in ("a", "b")}
    positions["sequence"] = rng.uniform(0, 1, n_frames)
    positions["flux"] = rng.uniform(0.1, 1, (2, 3, n_frames))
    positions["previous_flux"] = rng.uniform(0.5, 2, (2, 3, n_frames))
    source = np.array([1.0, *rng.uniform(-0.5, 0.5, 3)])
    return rng, join(train), positions, source


def with_unit(positions, beam):
    """Positions as `system_mueller` takes them: angles with a unit, the fluxes of one beam."""
    given_ = {}
    for stage, position in positions.items():
        position = position[BEAMS.index(beam)].T if position.ndim == 3 else position
        given_[stage] = position if stage in optics.COORDINATES else position * u.rad
    return given_


def plain_fluxes(chain, positions, source):
    """Both fluxes by the system Mueller matrices, (n_wavelengths, n_frames) each."""
    matrices = [
        system_mueller(with_beam(chain, beam), LAM * u.um, with_unit(positions, beam))
        for beam in BEAMS
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


def moving_case(seed):
    """A chain where any part stands still: stages in front of, at or behind the prism, or none."""
    rng = np.random.default_rng(seed)
    places = [name or None for name in rng.permutation(["", "", "a", "-b"]).tolist()]
    train = [
        optics.LinearPolarizer(theta=20 * u.deg, name="polarizer", mount=places[0]),
        optics.DiattenuatorRetarder(diattenuation=0.3, retardance=[1, 2, 3] * u.rad, name="plate",
                                    mount=places[1]),
        optics.Rotator(theta=rng.choice([0, 30]) * u.deg, name="turn", mount=places[2]),
        optics.EllipticalRetarder(diagonal=0.4 * u.rad, theta=[5, 6, 7] * u.deg, name="window"),
        optics.WollastonPrism(efficiency=[0.9, 0.8, 0.7], theta=12 * u.deg, name="wollaston",
                              mount=places[3]),
        optics.LinearRetarder(retardance=1 * u.rad, theta=40 * u.deg, name="behind"),
    ]  # fmt: skip
    if rng.random() < 0.3:
        train.insert(2, optics.HarmonicGain(cosine=0.2, mount="a", name="dust"))
    if rng.random() < 0.3:
        train.insert(-1, optics.Rotator(theta=8 * u.deg, name="last", mount="b"))
    positions = {stage: rng.uniform(-3, 3, 4) for stage in "ab"}
    return join(train), positions, np.array([1.0, *rng.uniform(-0.5, 0.5, 3)])


@given(seed=SEED)
@settings(max_examples=60)
def test_fluxes_alone_are_those_of_the_sweep(seed):
    # the fluxes alone meet what stands still as two rows, the sweep carries all light through
    chain, positions, source = moving_case(seed)
    propagator = Propagator(chain, LAM, positions, source)
    found, expected = propagator.fluxes(), plain_fluxes(chain, positions, source)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(propagator.forward().fluxes, expected, rtol=0, atol=1e-13)


def test_fluxes_leave_source_and_sweep_alone():
    chain, positions, source = moving_case(3)
    propagator = Propagator(chain, LAM, positions, source)
    sweep = propagator.forward()
    before = [flux.copy() for flux in sweep.fluxes]
    propagator.fluxes()
    propagator.forward()
    np.testing.assert_array_equal(sweep.fluxes, before)
    np.testing.assert_array_equal(propagator.source.ravel(), source)


@given(seed=SEED, n_frames=st.sampled_from([1, 3, 4]))
@settings(max_examples=25)
def test_fluxes_through_frame_optics_are_those_of_the_matrices(seed, n_frames):
    _, chain, positions, source = frame_case(seed, n_frames)
    found = Propagator(chain, LAM, positions, source).fluxes()
    expected = plain_fluxes(chain, positions, source)
    assert found[0].shape == (3, n_frames)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_flux_may_be_the_same_in_both_beams():
    _, chain, positions, source = frame_case(1)
    same = positions | {"flux": np.linspace(0.1, 1, N_FRAMES)}
    full = positions | {"flux": np.broadcast_to(same["flux"], (2, 3, N_FRAMES))}
    found = [Propagator(chain, LAM, p, source).fluxes() for p in (same, full)]
    np.testing.assert_array_equal(*found)


def test_frame_optic_without_mount_stands_at_zero():
    _, chain, positions, source = frame_case(2)
    still = join(leaf.with_parameters() for leaf in leaves(chain))
    for leaf in leaves(still):
        leaf.mount = None
    zero = {name: np.zeros(1) for name in positions}
    found = [Propagator(c, LAM, zero, source).fluxes() for c in (still, chain)]
    np.testing.assert_allclose(*found, rtol=0, atol=1e-14)


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


@pytest.mark.slow
@given(seed=SEED)
@settings(max_examples=40)
def test_derivatives_are_those_of_the_matrices(random_chain, seed):
    rng, chain, positions, source = random_case(random_chain, seed)
    assert_derivatives_of_the_matrices(rng, chain, positions, source)


@given(seed=SEED)
@settings(max_examples=15)
def test_derivatives_of_frame_optics_are_those_of_the_matrices(seed):
    assert_derivatives_of_the_matrices(*frame_case(seed))


def assert_derivatives_of_the_matrices(rng, chain, positions, source):
    weights = rng.normal(size=(2, 3, N_FRAMES))
    wanted = every_parameter(chain)
    found = Propagator(chain, LAM, positions, source).forward().derivatives(wanted, weights)
    expected = [
        system_mueller_derivatives(with_beam(chain, beam), LAM * u.um, with_unit(positions, beam))
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
    wanted = rng.permutation(every_parameter(chain))[:5]
    assert_derivatives_are_differences(rng, chain, positions, source, wanted)


def assert_derivatives_are_differences(rng, chain, positions, source, wanted):
    propagator = Propagator(chain, LAM, positions, source)
    weights = rng.normal(size=(2, 3, N_FRAMES))
    for i, k in wanted:
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
    # of several sums at once as of each
    several = np.stack([weights, 2 * np.array(weights[::-1])], axis=1)
    for key, both in sweep.derivatives(wanted, several).items():
        for i, slope in enumerate(both):
            np.testing.assert_allclose(slope, sweep.derivatives([key], several[:, i])[key])


# --- what is refused ------------------------------------------------------------------------


def test_chain_without_beam_splitter_has_a_dark_left_beam():
    turns = {"hwp": np.deg2rad([0.0, 22.5, 45.0])}
    plate = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    for source, level in (((1, 0, 0, 0), [0.5] * 3), ((1, 1, 0, 0), [1, 0.5, 0])):
        for behind in ([], [optics.Rotator(theta=20 * u.deg)]):
            chain = join([plate, optics.LinearPolarizer(name="analyser"), *behind])
            light = Propagator(chain, LAM, turns, source)
            for right, left in (light.fluxes(), light.forward().fluxes):
                np.testing.assert_allclose(right, [level] * 3, atol=1e-12)
                assert not left.any()
    slopes = light.forward().derivatives([(0, 0)], [np.ones((3, 3)), np.ones((3, 3))])
    np.testing.assert_allclose(slopes[0, 0], [[0, -2, 0]] * 3, atol=1e-12)
    with pytest.raises(ChainError, match="no optic that polarizes or splits"):
        Propagator(optics.Rotator(), LAM, {})


def test_positions_that_are_refused():
    chain = optics.LinearRetarder(mount="hwp", name="plate") | optics.WollastonPrism()
    assert stages(chain) == ("hwp",)
    with pytest.raises(ChainError, match=r"optic plate stands on stage 'hwp', .* \['altitude'\]"):
        Propagator(chain, LAM, {"altitude": np.zeros(2)})
    # different numbers of positions
    chain = optics.LinearRetarder(mount="hwp") | optics.WollastonPrism(mount="rotator")
    with pytest.raises(ChainError, match=r"different numbers of positions: .*'hwp': 2"):
        Propagator(chain, LAM, {"hwp": np.zeros(2), "rotator": np.zeros(3)})
    still = Propagator(chain, LAM, {"hwp": np.zeros(2), "rotator": np.zeros(1)})
    assert still.fluxes()[0].shape == (3, 2)
    # another shape
    for shape in [(3, 4), (4, 3), (3, 3, 4), (2, 4, 3), (1, 2, 3, 4)]:
        chain = optics.WollastonPrism(name="wollaston") | optics.FluxGain(mount="flux", name="bend")
        message = r"bend stands on stage 'flux', whose positions have shape .* \(2, 3, n_columns\)"
        with pytest.raises(ChainError, match=message):
            Propagator(chain, LAM, {"flux": np.ones(shape)})
    # flux that differs between beams for an optic that does not
    drift = optics.DriftRotator(mount="flux", name="drift")
    for chain in (drift | optics.WollastonPrism(), optics.WollastonPrism() | drift):
        with pytest.raises(ChainError, match=r"drift stands on stage 'flux', which differs betw"):
            Propagator(chain, LAM, {"flux": np.ones((2, 3, 5))})
    chain = optics.LinearRetarder(mount="hwp") | optics.WollastonPrism()
    chain = chain | optics.FluxGain(mount="flux")
    with pytest.raises(ChainError, match=r"different numbers of positions: .*'flux': 5"):
        Propagator(chain, LAM, {"hwp": np.zeros(2), "flux": np.ones((2, 3, 5))})


def test_unknown_chain_and_another_wavelength_grid():
    with pytest.raises(ChainError, match="is not an optic"):
        Propagator("wollaston", LAM, {})
    chain = optics.WollastonPrism(efficiency=[0.9, 0.8], name="wollaston")
    propagator = Propagator(chain, np.array([1.6]), {})
    with pytest.raises(ParameterError, match=r"wollaston.efficiency has 2 values.* 1 wavelengths"):
        propagator.fluxes()
    # a measurement gives each dataset the values on its own grid
    right, _ = propagator.fluxes([[np.array(0.0), np.array(0.9)]])
    assert right.shape == (1, 1)


# --- in a measurement -----------------------------------------------------------------------


def observed_case(time=None):
    """A chain whose gains follow the fluxes, and a table with masked cells that it may fit."""
    ideal = (
        optics.LinearPolarizer(theta=80 * u.deg, name="polarizer")
        | optics.LinearRetarder(retardance=[150, 170, 190] * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=[0.9, 0.95, 0.97], name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[45, 62] * u.deg)
    if time is not None:
        frames["time"] = time
    observations = simulate(ideal, LAM * u.um, frames, flux=1e5, seed=3)
    mask = np.zeros((observations.n_frames, 3), dtype=bool)
    mask[3, 1] = mask[6] = True
    chain = ideal
    for optic in (
        optics.DriftRotator(rate=1 * u.deg, mount="sequence", name="drift"),
        optics.HarmonicRotator(sine=[1, 2, 3] * u.deg, harmonic=2, mount="-hwp", name="encoder"),
        optics.HarmonicGain(cosine=0.02, mount="hwp", name="dust"),
    ):
        chain = insert_optic(chain, optic, before="hwp")
    chain = (
        chain
        | optics.FluxGain(
            right=-0.03, left=[0.01, 0.02, 0.03], reference=5e4, mount="flux", name="bend"
        )
        | optics.FluxGain(right=0.01, left=0.02, power=-1, mount="previous_flux", name="lag")
    )
    return chain, observations.with_mask(mask, "test")


def test_jacobian_of_a_measurement_with_frame_optics():
    for observable in sorted(n for n, one in OBSERVABLES.items() if one.frames_per_datum < 4):
        chain, observations = observed_case(time=[*range(8, 16), *range(8)] * u.s)
        measurement = Measurement(chain, observations, observable=observable)
        vector = measurement.vector()
        assert {"drift.rate", "bend.right", "lag.left"} <= set(measurement.free.by_name), observable
        step = 1e-4
        expected = []
        for i in range(vector.size):
            at = [measurement.predict(vector + n * step * (np.arange(vector.size) == i))
                  for n in (-2, -1, 1, 2)]  # fmt: skip
            expected.append((8 * (at[2] - at[1]) - (at[3] - at[0])) / (12 * step))
        found = measurement.jacobian(vector)
        assert np.isfinite(measurement.residuals()).all(), observable
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_prediction_of_a_measurement_with_frame_optics():
    chain, observations = observed_case(time=[*range(8, 16), *range(8)] * u.s)
    measurement = Measurement(chain, observations, observable="normalized_single_difference")
    positions = {stage: observations.position(stage) for stage in stages(chain)}
    right, left = plain_fluxes(chain, positions, [1, 0, 0, 0])
    expected = ((right - left) / (right + left))[~observations.mask.T]
    np.testing.assert_allclose(measurement(measurement.index), expected, rtol=0, atol=1e-13)


@settings(max_examples=10)
@given(seed=SEED)
def test_crossings_are_derivatives_to_the_elements_of_a_matrix(seed):
    """What any small change of an optic does, against a general matrix that stands behind it."""
    rng = np.random.default_rng(seed)
    # light that differs between the beams is known twice
    apart = seed % 2
    split = optics.Perturbation(amplitude=0.1, dependence="beam", name="split")
    chain = join(
        [
            optics.LinearPolarizer(theta=rng.uniform(-90, 90) * u.deg, name="polarizer"),
            *[split] * apart,
            optics.LinearRetarder(retardance=170 * u.deg, mount="a", name="plate"),
            optics.MuellerElement(theta=rng.uniform(-90, 90) * u.deg, mount="b", name="any"),
            optics.Diattenuator(diattenuation=0.1, theta=20 * u.deg, name="mirror"),
            optics.WollastonPrism(efficiency=0.97, name="wollaston"),
        ]
    )
    positions = {stage: rng.uniform(-3, 3, N_FRAMES) for stage in ("a", "b")}
    sweep = Propagator(chain, LAM, positions, np.array([1.0, 0.2, -0.1, 0.3])).forward()
    index = [leaf.name for leaf in leaves(chain)].index("any")
    weights = rng.normal(size=(2, 3, N_FRAMES))
    pairs = sweep.crossings([index], weights)[index]
    assert len(pairs) == 1 + apart
    keys = chain["any"].param_names
    wanted = [(index, keys.index(f"m{i}{j}")) for i in range(4) for j in range(4)]
    expected = sweep.derivatives(wanted, weights)
    for (i, j), place in zip(np.ndindex(4, 4), wanted, strict=True):
        found = sum(row[..., i] * light[..., j] for row, light in pairs)
        np.testing.assert_allclose(found, expected[place], atol=1e-12)
