# Licensed under a 3-clause BSD style license - see LICENSE
"""A measurement is a fittable model with an analytic Jacobian."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.fitting import DogBoxLSQFitter, LevMarLSQFitter, TRFLSQFitter
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic, join
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.measurement import Measurement, Tie
from astropolcal.observations import OBSERVABLES
from astropolcal.observations.observables import NormalizedSingleDifference
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.2, 1.6, 2.2] * u.um
FITTERS = [TRFLSQFitter, LevMarLSQFitter, DogBoxLSQFitter]

# frames without a modulator
PLAIN = sorted(name for name, one in OBSERVABLES.items() if one.frames_per_datum < 4)


def numerical(measurement, vector, step=1e-6):
    """Central differences of the prediction, (n_free, n_data)."""
    rows = []
    for i in range(vector.size):
        delta = np.zeros(vector.size)
        delta[i] = step
        rows.append(
            (measurement.predict(vector + delta) - measurement.predict(vector - delta)) / (2 * step)
        )
    return np.array(rows)


def assert_jacobian_right(measurement, vector=None):
    vector = measurement.vector() if vector is None else vector
    np.testing.assert_allclose(
        measurement.jacobian(vector), numerical(measurement, vector), rtol=0, atol=2e-8
    )


# --- hypothesis: any chain --------------------------------------------------------------

angle = st.floats(-170, 170).map(lambda x: x * u.deg)
fraction = st.floats(0.3, 0.95)


def _free(**more):
    return {"fixed": {"theta": False}, **more}


@st.composite
def optic(draw, name):
    """Any optic that is not the beam splitter, with theta free."""
    kind = draw(
        st.sampled_from(
            [
                "linear",
                "elliptical",
                "plate",
                "diattenuator",
                "both",
                "depolarizer",
                "flip",
                "rotator",
            ]
        )
    )
    mount = draw(st.sampled_from([None, "hwp", "derotator", "-hwp"]))
    common = _free(theta=draw(angle), mount=mount, name=name)
    several = draw(st.booleans())

    def value(strategy):
        return u.Quantity([draw(strategy) for _ in range(3)]) if several else draw(strategy)

    if kind == "linear":
        return optics.LinearRetarder(retardance=value(angle), **common)
    if kind == "elliptical":
        keys = ("horizontal", "diagonal", "circular")
        return optics.EllipticalRetarder(**{k: value(angle) for k in keys}, **common)
    if kind == "plate":
        return optics.TwoLayerWaveplate(**common)
    if kind == "diattenuator":
        return optics.Diattenuator(diattenuation=value(fraction), **common)
    if kind == "both":
        return optics.DiattenuatorRetarder(
            diattenuation=value(fraction), retardance=value(angle), **common
        )
    if kind == "depolarizer":
        keys = ("retained_q", "retained_u", "retained_v")
        return optics.Depolarizer(**{k: value(fraction) for k in keys}, **common)
    return {"flip": optics.ParityFlip, "rotator": optics.Rotator}[kind](**common)


@st.composite
def chains(draw):
    count = draw(st.integers(1, 4))
    train = [optics.Diattenuator(diattenuation=0.8, theta=draw(angle), name="source", **_free())]
    train += [draw(optic(f"optic{i}")) for i in range(count)]
    efficiency = [draw(fraction) for _ in range(3)]
    train.append(optics.WollastonPrism(efficiency=efficiency, name="wollaston", **_free()))
    return join(train)


def _frames_for(observable):
    """Return two cycles, with both states of a modulator where the observable needs them."""
    frames = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, [30, 75] * u.deg)
    if OBSERVABLES[observable].frames_per_datum < 4:
        return frames
    both = frames[np.repeat(np.arange(len(frames)), 2)]
    both["flc_state"] = np.tile([0.0, 1.0], len(frames))
    return both


def _modulated(chain, observable):
    """Return the chain, with a modulator in front of the beam splitter where it is needed."""
    if OBSERVABLES[observable].frames_per_datum < 4:
        return chain
    crystal = optics.FerroelectricLiquidCrystal(
        retardance=170 * u.deg, switching_angle=43 * u.deg, mount="flc_state", name="flc", **_free()
    )
    return insert_optic(chain, crystal, before="wollaston")


def _noiseless(chain, frames):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return simulate(chain, WAVELENGTH, frames, noise=False)


@pytest.mark.slow
@settings(max_examples=60)
@given(chain=chains(), observable=st.sampled_from(sorted(OBSERVABLES)))
def test_jacobian_is_the_derivative_for_any_chain_and_observable(chain, observable):
    chain = _modulated(chain, observable)
    observations = _noiseless(chain, _frames_for(observable))
    measurement = Measurement(chain, observations, observable=observable)
    assume(np.abs(measurement.predict(measurement.vector())).max() < 0.95)
    vector = measurement.vector()
    # thicknesses are hundreds of waves: a step of 1e-6 um is as small as one of 1e-6 rad
    np.testing.assert_allclose(
        measurement.jacobian(vector), numerical(measurement, vector), rtol=1e-5, atol=1e-7
    )


@pytest.mark.slow
@settings(max_examples=40)
@given(chain=chains(), observable=st.sampled_from(sorted(OBSERVABLES)))
def test_prediction_is_what_a_simulation_without_noise_measures(chain, observable):
    chain, frames = _modulated(chain, observable), _frames_for(observable)
    measurement = Measurement(chain, _noiseless(chain, frames), observable=observable)
    np.testing.assert_allclose(
        measurement(measurement.index), measurement.observed, rtol=0, atol=1e-12
    )


# --- special measurements -----------------------------------------------------------------


def test_masked_cells_give_no_datum(chain, observations):
    for observable in PLAIN:
        mask = np.zeros((observations.n_frames, 3), dtype=bool)
        mask[5, 1] = mask[6] = True
        masked = observations.with_mask(mask, "test")
        whole, part = (Measurement(chain, o, observable=observable) for o in (observations, masked))
        frames = whole.datasets[0].frames
        # a datum of frame 5 in one bin, and those of frame 6 in all three
        assert sum({5, 6} <= set(pair) for pair in frames.tolist()) == 0, observable
        assert whole.n_data - part.n_data == 1 + 3, observable
        assert np.isfinite(part.observed).all(), observable
        assert_jacobian_right(part)
        kept = part.datasets[0].valid.ravel()
        np.testing.assert_array_equal(whole.observed[kept], part.observed)
        np.testing.assert_array_equal(whole.bins[kept], part.bins)


def test_nothing_left_is_an_error(chain, observations):
    mask = np.zeros(observations.n_frames, dtype=bool)
    mask[observations.pairs()[:, 0]] = True
    with pytest.raises(ObservationError, match="no datum is left"):
        Measurement(chain, observations.with_mask(mask, "test"))


def test_two_datasets_share_their_optics(make_chain, frames):
    pair = [make_chain(), make_chain(flip=True)]
    data = [simulate(c, WAVELENGTH, frames, noise=False) for c in pair]
    measurement = Measurement(pair, data)
    assert measurement.free.size == Measurement(pair[0], data[0]).free.size
    assert [s.stop - s.start for s in measurement.segments] == [
        d.n_data for d in measurement.datasets
    ]
    np.testing.assert_allclose(measurement.residuals(), 0, atol=1e-12)
    assert_jacobian_right(measurement)
    halves = [Measurement(c, d) for c, d in zip(pair, data, strict=True)]
    both = np.concatenate([half.jacobian(half.vector()) for half in halves], axis=1)
    np.testing.assert_allclose(measurement.jacobian(measurement.vector()), both, atol=1e-14)


def test_what_is_fixed_has_one_value_in_all_datasets(make_chain, observations):
    pair = [make_chain(), make_chain()]
    # by rounding alone, as values in another unit
    pair[1]["hwp"].theta = 1e-15 * u.deg
    Measurement(pair, [observations, observations])
    pair[1]["hwp"].theta = 2 * u.deg
    with pytest.raises(ParameterError, match=r"hwp.theta is fixed and differs between datasets"):
        Measurement(pair, [observations, observations])


def test_two_datasets_with_one_chain(chain, observations):
    double = Measurement(chain, [observations, observations])
    single = Measurement(chain, observations)
    for segment in double.segments:
        np.testing.assert_array_equal(double.observed[segment], single.observed)
    assert double.n_data == 2 * single.n_data
    assert double.free.size == single.free.size


def test_datasets_may_cover_parts_of_the_grid(make_chain, frames):
    chain = make_chain(wavelength=[1.2, 1.4, 1.6, 2.2] * u.um)
    parts = ([1.2, 1.6] * u.um, [1.4, 1.6, 2.2] * u.um)
    rows = ([0, 2], [1, 2, 3])
    data = []
    for wavelength, row in zip(parts, rows, strict=True):
        truth = make_chain(wavelength=wavelength)
        for optic_name, key in (
            ("derotator", "horizontal"), ("derotator", "diagonal"),
            ("derotator", "circular"), ("wollaston", "efficiency"),
        ):  # fmt: skip
            parameter = getattr(chain[optic_name], key)
            setattr(truth[optic_name], key, parameter.value[row] * (parameter.unit or 1))
        data.append(simulate(truth, wavelength, frames, noise=False))
    measurement = Measurement(chain, data)
    np.testing.assert_allclose(measurement.wavelength, [1.2, 1.4, 1.6, 2.2])
    np.testing.assert_allclose(measurement.residuals(), 0, atol=1e-12)
    assert sorted(set(measurement.bins[measurement.segments[0]])) == [0, 2]
    assert_jacobian_right(measurement)
    # what belongs to 1.4 um does not act on the first dataset
    slot = measurement.free.by_name["derotator.horizontal"]
    first = measurement.jacobian(measurement.vector())[slot.start + 1, measurement.segments[0]]
    np.testing.assert_array_equal(first, 0)


def test_fixed_arrays_follow_the_grid_too(make_chain, frames):
    chain = make_chain(wavelength=[1.2, 1.4, 1.6] * u.um)
    truth = make_chain(wavelength=[1.4] * u.um)
    chain["wollaston"].efficiency = [0.5, 0.9, 0.6]
    chain["wollaston"].efficiency.fixed = True
    truth["wollaston"].efficiency = [0.9]
    for key in ("horizontal", "diagonal", "circular"):
        setattr(truth["derotator"], key, getattr(chain["derotator"], key).value[[1]] * u.deg)
    data = simulate(truth, [1.4] * u.um, frames, noise=False)
    measurement = Measurement(chain, data, wavelength=[1.2, 1.4, 1.6] * u.um)
    np.testing.assert_allclose(measurement.residuals(), 0, atol=1e-12)


def test_frames_shared_by_pairs():
    """Positions 0, 45, 90 and 135 deg: a frame may serve two pairs, and still differentiates."""
    chain = optics.LinearPolarizer(theta=10 * u.deg, name="polarizer", fixed={"theta": False})
    chain = chain | optics.LinearRetarder(retardance=150 * u.deg, mount="hwp", name="hwp")
    chain = chain | optics.WollastonPrism(efficiency=0.95, name="wollaston")
    frames = half_wave_plate_cycles([0, 45, 90, 22.5, 67.5] * u.deg, [45] * u.deg)
    observations = simulate(chain, 1.6 * u.um, frames, noise=False)
    shared = observations.pairs(share=True)
    assert np.bincount(shared.ravel()).max() == 2

    class Shared(type(observations)):
        def pairs(self, *args, **options):
            return shared

    observations.__class__ = Shared
    measurement = Measurement(chain, observations)
    np.testing.assert_allclose(measurement.residuals(), 0, atol=1e-12)
    assert_jacobian_right(measurement)


def test_tied_parameters_keep_the_jacobian_exact(chain, observations):
    ties = {
        "derotator.theta": Tie("polarizer.theta", factor=0.5, offset=-45 * u.deg),
        "derotator.diagonal": Tie("derotator.horizontal", factor=-0.1),
    }
    measurement = Measurement(chain, observations, ties=ties)
    assert "derotator_theta" not in measurement.param_names
    assert "derotator_diagonal_0" not in measurement.param_names
    assert_jacobian_right(measurement)
    measurement.put_back()
    derotator = measurement.chains[0]["derotator"]
    assert derotator.theta.value == pytest.approx(0.5 * 90 - 45)
    np.testing.assert_allclose(derotator.diagonal.value, -0.1 * derotator.horizontal.value)


def test_given_positions_replace_the_columns(chain, observations):
    moved = {s: observations.position(s) for s in ("hwp", "derotator")}
    moved["hwp"] = moved["hwp"] + np.deg2rad(2.0)
    by_position = Measurement(chain, observations, positions=[moved])
    chain["hwp"].theta = 2 * u.deg
    by_theta = Measurement(chain, observations)
    np.testing.assert_allclose(
        by_position.predict(by_position.vector()), by_theta.predict(by_theta.vector()), atol=1e-13
    )
    units = {stage: (angle * u.rad).to(u.deg) for stage, angle in moved.items()}
    by_unit = Measurement(
        chain, observations, positions=[units | {"hwp": units["hwp"] - 2 * u.deg}]
    )
    np.testing.assert_allclose(
        by_unit.predict(by_unit.vector()), by_theta.predict(by_theta.vector()), atol=1e-13
    )
    for wrong, error, words in (
        (units["hwp"].value * u.m, ParameterError, "position of hwp has unit m, which is not conv"),
        (
            units["hwp"][:3],
            ObservationError,
            r"hwp has positions of shape \(3,\); allowed are \(40",
        ),
    ):
        with pytest.raises(error, match=words):
            Measurement(chain, observations, positions=[units | {"hwp": wrong}])


def test_observable_may_be_an_object(chain, observations):
    measurement = Measurement(chain, observations, observable=NormalizedSingleDifference())
    assert measurement.n_data == observations.n_frames * 3
    with pytest.raises(ObservationError, match="observable = "):
        Measurement(chain, observations, observable="triple difference")


# --- evaluation on an index -------------------------------------------------------------------


def test_index_picks_data(chain, observations):
    measurement = Measurement(chain, observations)
    some = np.array([7, 0, 3])
    np.testing.assert_array_equal(measurement(some), measurement(measurement.index)[some])
    values = measurement.vector()
    np.testing.assert_array_equal(
        measurement.fit_deriv(some, *measurement.parameters),
        measurement.jacobian(values)[:, some] * measurement.free.factors()[:, None],
    )


def test_index_of_no_datum_is_an_error(chain, observations):
    for index in [-1.0, 0.5, 1e6]:
        measurement = Measurement(chain, observations)
        with pytest.raises(ObservationError, match="whole number below"):
            measurement(np.array([0.0, index]))


def test_remembered_sweep_belongs_to_its_vector(chain, observations):
    measurement = Measurement(chain, observations)
    vector = measurement.vector()
    first = measurement.predict(vector)
    measurement.predict(vector + 0.01)
    np.testing.assert_array_equal(measurement.predict(vector), first)
    vector += 0.01  # a fitter may change its array in place
    assert np.abs(measurement.predict(vector) - first).max() > 1e-3


def test_results_do_not_share_memory_with_what_is_remembered(chain, observations):
    measurement = Measurement(chain, observations)
    vector = measurement.vector()
    for method in (measurement.predict, measurement.jacobian):
        before = method(vector).copy()
        method(vector)[...] = 0
        np.testing.assert_array_equal(method(vector), before)


def test_derivatives_at_a_point_are_worked_out_once(chain, observations, monkeypatch):
    measurement, asked = Measurement(chain, observations), []
    worked_out = type(measurement.datasets[0]).jacobian

    def counted(self, sweep, among=None):
        asked.append(among)
        return worked_out(self, sweep, among)

    monkeypatch.setattr(type(measurement.datasets[0]), "jacobian", counted)
    vector, among = measurement.vector(), np.arange(measurement.free.size) < 2
    for which, count in ((None, 1), (None, 1), (among, 2), (None, 2), (among, 2)):
        found = measurement.jacobian(vector, which)
        assert (len(asked), found[2:].any()) == (count, which is None)
    measurement.jacobian(vector + 0.01)
    assert len(asked) == 3


# --- parameters as astropy sees them ----------------------------------------------------------


def test_parameters_are_scalars_in_the_units_of_the_optics(chain, observations):
    measurement = Measurement(chain, observations)
    assert measurement.param_names[:3] == ("polarizer_theta", "hwp_w_sio2", "hwp_w_mgf2")
    assert all(getattr(measurement, name).shape == () for name in measurement.param_names)
    assert measurement.polarizer_theta.quantity == 90 * u.deg
    assert u.isclose(measurement.hwp_w_sio2.quantity, 1.65 * u.mm)
    assert u.isclose(measurement.derotator_horizontal_0.quantity, -230 * u.deg)
    assert measurement.wollaston_efficiency_0.unit is None
    expected = np.concatenate([[np.pi / 2, 1650, 1290], np.deg2rad([-230])])
    np.testing.assert_allclose(measurement.vector()[:4], expected)
    with pytest.raises(ParameterError, match=r"polarizer_theta = 1\.5 needs a unit"):
        measurement.polarizer_theta = 1.5


def test_bounds_are_converted(chain, observations):
    chain["polarizer"].theta.bounds = (85, 95)
    measurement = Measurement(chain, observations)
    np.testing.assert_allclose(measurement.polarizer_theta.bounds, [85, 95])
    assert measurement.hwp_w_sio2.bounds == (0.0, None)
    np.testing.assert_allclose(measurement.derotator_circular_2.bounds, (-360, 360))
    measurement.polarizer_theta.bounds = (1.5, 1.6) * u.rad
    np.testing.assert_allclose(measurement.polarizer_theta.bounds, np.rad2deg([1.5, 1.6]))
    assert measurement.wollaston_efficiency_1.bounds == (0.0, 1.0)


def test_the_quantity_of_a_parameter_may_be_set_in_any_unit(chain, observations):
    measurement, curve = Measurement(chain, observations), chain["hwp"].curve("retardance")
    for model, name in (
        (measurement, "hwp_w_sio2"),
        (chain["hwp"], "w_sio2"),
        (chain, "w_sio2_1"),
        (curve, "w_sio2"),
    ):
        parameter = getattr(model, name)
        parameter.quantity = 1640 * u.um
        assert parameter.value == pytest.approx(1.64), name
        assert parameter.unit == u.mm, name
        with pytest.raises(ParameterError, match="unit deg, which is not convertible to mm"):
            parameter.quantity = 1 * u.deg
    expected = Measurement(chain, observations).predict(measurement.vector())
    np.testing.assert_allclose(measurement(measurement.index), expected, rtol=0, atol=1e-12)


def test_fixed_parameters_are_left_out(chain, observations):
    free = set(Measurement(chain, observations).param_names)
    chain["hwp"].w_sio2.fixed = True
    chain["derotator"].diagonal.fixed = True
    less = set(Measurement(chain, observations).param_names)
    assert free - less == {"hwp_w_sio2", *(f"derotator_diagonal_{i}" for i in range(3))}


def test_parameters_belong_to_the_instance():
    """
    Two measurements in one process keep their own parameters.

    This rests on private behaviour of astropy (``_param_names``, parameters in
    the instance's ``__dict__``), which this test pins.
    """
    frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)

    def measurement(retardance, n):
        chain = optics.LinearPolarizer(name="polarizer") | optics.LinearRetarder(
            retardance=np.full(n, retardance) * u.deg, mount="hwp", name="hwp"
        )
        chain = chain | optics.WollastonPrism(efficiency=0.9, name="wollaston")
        return Measurement(chain, simulate(chain, np.linspace(1, 2, n) * u.um, frames, seed=1))

    before = dict(vars(Measurement))
    one, two = measurement(170.0, 2), measurement(160.0, 3)
    assert one.param_names == ("hwp_retardance_0", "hwp_retardance_1", "wollaston_efficiency")
    assert two.param_names == (
        "hwp_retardance_0", "hwp_retardance_1", "hwp_retardance_2", "wollaston_efficiency",
    )  # fmt: skip
    one.stand_at(one.vector() + 0.1)
    one.hwp_retardance_0 = 1.0 * u.rad
    assert one.hwp_retardance_0.value == one.parameters[0] == np.rad2deg(1.0)
    assert two.hwp_retardance_0.value == pytest.approx(160.0)
    assert not hasattr(two, "hwp_retardance_3")
    after = dict(vars(Measurement))
    assert after == before
    assert Measurement._param_names == ()


def test_parameter_may_be_replaced_by_a_parameter(chain, observations):
    """As astropy does it when it copies a model."""
    measurement = Measurement(chain, observations)
    parameter = measurement.polarizer_theta.copy()
    measurement.polarizer_theta = parameter
    assert measurement.polarizer_theta is parameter


def test_chains_given_are_not_changed(chain, observations):
    before = [np.array(v) for leaf in chain for v in leaf.canonical_values()]
    measurement = Measurement(chain, observations)
    measurement.stand_at(measurement.vector() + 0.1)
    measurement.put_back()
    after = [np.array(v) for leaf in chain for v in leaf.canonical_values()]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


def test_put_back_writes_values_with_units(chain, observations):
    measurement = Measurement(chain, observations)
    vector = measurement.vector()
    vector[measurement.free.by_name["hwp.w_sio2"].slice] = 1700.0
    vector[measurement.free.by_name["derotator.horizontal"].slice] = np.deg2rad([10, 20, 30])
    (own,) = measurement.put_back(vector)
    assert u.isclose(own["hwp"].w_sio2.quantity, 1.7 * u.mm)
    assert u.allclose(own["derotator"].horizontal.quantity, [10, 20, 30] * u.deg)
    # they know their wavelengths now
    between = np.mean(WAVELENGTH[:2].value) * u.um
    assert u.isclose(own["derotator"].curve("horizontal")(between), 15 * u.deg)
    with pytest.raises(ParameterError, match=r"derotator\.horizontal has values at 3 wavelengths"):
        Measurement(own, simulate(chain, WAVELENGTH * 1.1, observations.frames, noise=False))


def test_without_copy_the_chain_is_the_one_given(chain, observations):
    measurement = Measurement(chain, observations, copy=False)
    measurement.polarizer_theta = 1.5 * u.rad
    measurement.put_back()
    assert chain["polarizer"].theta.value == pytest.approx(np.rad2deg(1.5))


def test_copy_is_independent_but_shares_the_data(chain, observations):
    measurement = Measurement(chain, observations)
    clone = measurement.copy()
    clone.stand_at(measurement.vector() + 0.1)
    clone.put_back()
    assert clone.observed is measurement.observed
    assert clone.chains[0] is not measurement.chains[0]
    assert measurement.chains[0]["polarizer"].theta.value == 90
    assert clone.chains[0]["polarizer"].theta.value == pytest.approx(90 + np.rad2deg(0.1))
    assert measurement.polarizer_theta.value == 90
    np.testing.assert_array_equal(
        clone.predict(clone.vector()), measurement.predict(clone.vector())
    )


def test_sigma_is_the_error_of_the_data(chain, frames):
    """Normalized residuals of pure photon noise have unit variance."""
    data = simulate(chain, WAVELENGTH, frames, flux=1e5, seed=7)
    measurement = Measurement(chain, data)
    pulls = measurement.residuals() / measurement.sigma
    assert pulls.std() == pytest.approx(1.0, abs=5 / np.sqrt(2 * pulls.size))


# --- fitters ---------------------------------------------------------------------------------


def _full_rank(wavelength, frames):
    chain = instruments.get("charis").chain(wavelength=wavelength, derotator="linear")
    for name in ("hwp", "derotator"):
        chain[name].theta.fixed = True
    truth = chain.copy()
    truth["derotator"].retardance = chain["derotator"].retardance.value * 1.01 * u.deg
    truth["calibration_polarizer"].theta = 90.6 * u.deg
    return chain, simulate(truth, wavelength, frames, seed=5)


@pytest.fixture
def solutions(frames):
    chain, data = _full_rank([1.2, 1.6, 2.0, 2.2] * u.um, frames)
    found = []
    for fitter in FITTERS:
        measurement = Measurement(chain, data)
        fitted = fitter()(measurement, measurement.index, measurement.observed, maxiter=500)
        found.append(fitted)
    return found


def test_fitters_agree(solutions):
    reference = solutions[0]
    assert np.abs(reference.residuals()).max() < 2e-3
    for other in solutions[1:]:
        difference = np.abs(reference.vector() - other.vector())
        # canonical units: 1e-6 rad and efficiency, 1e-3 um of more than 1000
        tolerance = np.where(reference.vector() > 100, 2e-3, 2e-6)
        assert (difference < tolerance).all()


def test_fit_uses_the_analytic_jacobian(frames, monkeypatch):
    """Finite differences would call ``evaluate`` once a parameter for every step."""
    chain, data = _full_rank([1.2, 1.6, 2.0, 2.2] * u.um, frames)
    counts = {}
    for name in ("evaluate", "fit_deriv"):
        method = getattr(Measurement, name)

        def counted(self, *args, _method=method, _name=name):
            counts[_name] += 1
            return _method(self, *args)

        monkeypatch.setattr(Measurement, name, counted)
    for fitter in FITTERS:
        measurement = Measurement(chain, data)
        counts |= {"evaluate": 0, "fit_deriv": 0}
        fitter()(measurement, measurement.index, measurement.observed)
        assert counts["fit_deriv"] > 0, fitter
        assert counts["evaluate"] < measurement.free.size + 2 * counts["fit_deriv"] + 5, fitter
        assert counts["evaluate"] <= 40, fitter


def test_bounds_hold_in_a_fit(frames):
    chain, data = _full_rank([1.2, 1.6, 2.0, 2.2] * u.um, frames)
    chain["calibration_polarizer"].theta.bounds = (89.5, 90.2)
    measurement = Measurement(chain, data)
    fitted = TRFLSQFitter()(measurement, measurement.index, measurement.observed)
    assert fitted.calibration_polarizer_theta.value <= 90.2 + 1e-9


def test_chains_of_a_fit_have_its_values_and_errors(frames):
    chain, data = _full_rank([1.2, 1.6, 2.0, 2.2] * u.um, frames)
    for inplace in (False, True):
        measurement = Measurement(chain, data)
        arguments = measurement, measurement.index, measurement.observed
        fitted = TRFLSQFitter(calc_uncertainties=True)(*arguments, inplace=inplace)
        optic = fitted.chains[0]["calibration_polarizer"]
        assert optic.theta.quantity == fitted.calibration_polarizer_theta.quantity
        assert optic.theta.std == fitted.calibration_polarizer_theta.std > 0
        efficiency = fitted.chains[0]["wollaston"].efficiency
        assert efficiency.std.shape == efficiency.shape == (4,)
        assert fitted.chains[0]["wollaston"].theta.std is None
        # nobody else's
        assert (measurement is fitted) == inplace
        assert chain["calibration_polarizer"].theta.value != optic.theta.value
    start = Measurement(chain, data)
    TRFLSQFitter()(start, start.index, start.observed)
    assert start.chains[0]["wollaston"].efficiency.value == pytest.approx(
        chain["wollaston"].efficiency.value
    )


def test_what_a_fit_does_not_take_is_refused(chain, observations):
    measurement = Measurement(chain, observations)
    with pytest.raises(ParameterError, match="the data are in %; observables are plain numbers"):
        TRFLSQFitter()(measurement, measurement.index, measurement.observed * u.percent)
    measurement.polarizer_theta.value = np.nan
    with pytest.raises(ParameterError, match="polarizer_theta = nan; a fit starts at finite"):
        LevMarLSQFitter()(measurement, measurement.index, measurement.observed)
    # a callable tie, when it is set
    measurement = Measurement(chain, observations)
    with pytest.raises(ParameterError, match="hwp_w_sio2: a measurement takes no callable tie"):
        measurement.hwp_w_sio2.tied = lambda model: 2 * model.hwp_w_mgf2
    measurement.hwp_w_sio2.tied = False
