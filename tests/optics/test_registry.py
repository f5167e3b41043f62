# Licensed under a 3-clause BSD style license - see LICENSE
"""
The laws that every optic obeys, for every class of the registry.

A new optic needs one entry in ``CASES``; the message of
`test_every_optic_has_a_case` says what it holds.
"""

import importlib
import inspect
import pkgutil
from dataclasses import dataclass, field
from functools import reduce
from itertools import product

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from astropolcal import mueller, optics
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.materials import get_material
from astropolcal.optics import COORDINATES, OPTICS, FrameOptic, Optic
from astropolcal.optics.perturbations import GENERATORS
from astropolcal.thinfilm import reflect
from astropolcal.units import canonical_factor, canonical_unit

WAVELENGTH = [1.2, 1.6, 2.1] * u.um
FRACTION = st.floats(0, 1)
SIGNED = st.floats(-1, 1)
# sqrt(1 - eps^2) is too steep for differences nearer to the bound
SMOOTH = st.floats(-0.95, 0.95)
DEGREES = st.floats(-360, 360)
ANGLE = st.floats(-180, 180)
SMALL = st.floats(-30, 30)
GAIN = st.floats(-0.4, 0.4)
# two components of a diattenuation below one
COMPONENT = st.floats(-0.7, 0.7)
OTHER_UNITS = {u.rad: (u.deg, u.rad, u.arcmin), u.um: (u.mm, u.um, u.nm)}
# small enough for the five-point rule, large enough for rounding
STEP = {u.rad: 1e-3, u.um: 1e-2, u.dimensionless_unscaled: 1e-4}
# the phase of a film turns faster than that of a crystal plate
STEP_OF_UNIT = {u.nm: 2e-4}


@st.composite
def depolarization(draw):
    """Shares of Q, U, V within the bounds whose coherency matrix is positive."""
    q, u_ = draw(FRACTION), draw(FRACTION)
    low, high = max(0.0, q + u_ - 1), 1 - abs(q - u_)
    v = low + (high - low) * draw(FRACTION)
    return {"retained_q": q, "retained_u": u_, "retained_v": v}


@st.composite
def mueller_elements(draw):
    """Elements of a random physical Mueller matrix of unit transmission."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    root = rng.normal(size=(4, 4)) + 1j * rng.normal(size=(4, 4))
    matrix = np.einsum("ijkl,kl->ij", mueller._BASIS, root @ root.conj().T).real
    matrix /= matrix[0, 0]
    return {f"m{i}{j}": matrix[i, j] for i in range(4) for j in range(4)}


def two_layer_retardance(w_sio2, w_mgf2):
    from astropolcal.materials import MGF2, QUARTZ

    path = w_sio2 * QUARTZ.birefringence(WAVELENGTH) - w_mgf2 * MGF2.birefringence(WAVELENGTH)
    return (2 * np.pi * path / WAVELENGTH).to_value(u.one) * u.rad


def wollaston(beam):
    sign = {"right": 1, "left": -1}[beam]
    # a polarizer along or across the axis, and what depolarizes the rest
    return lambda efficiency: (
        0.5
        * mueller.diattenuator_retarder(sign * efficiency, 0 * u.deg)
        * np.outer([1, 1, 0, 0], [1, 1, 0, 0])
    )


def vector_diattenuator(horizontal, diagonal):
    angle = np.arctan2(diagonal, horizontal) / 2 * u.rad
    return mueller.rotate(
        mueller.diattenuator_retarder(np.hypot(diagonal, horizontal), 0 * u.deg), angle
    )


def polarized_source(q, u):
    shape = np.broadcast_shapes(np.shape(q), np.shape(u))
    light = np.zeros((*shape, 4))
    light[..., 0], light[..., 1], light[..., 2] = 1.0, q, u
    return light[..., :, None] * np.array([1.0, 0, 0, 0])


def star_source(p_max, lambda_max, K, rotation, reference, **departure):
    ratio = (lambda_max / WAVELENGTH).to_value(u.one)
    x = np.log((WAVELENGTH / reference).to_value(u.one))
    chi = (-rotation * np.log(ratio)).to_value(u.rad)
    light = p_max * np.exp(-K * np.log(ratio) ** 2) * np.exp(2j * chi)
    for key, power in (("{}", 0), ("{}_slope", 1), ("{}_curvature", 2)):
        light = light + (departure[key.format("q")] + 1j * departure[key.format("u")]) * x**power
    return polarized_source(light.real, light.imag)


def coated(metal, reflections, incidence, film_thickness, n_scale, k_scale):
    """Diattenuator-retarder of metal mirrors, wavelength by wavelength and in a row."""
    index = get_material(metal).index(WAVELENGTH).value
    index = n_scale * index.real + 1j * k_scale * index.imag
    film = ("fused silica", film_thickness)
    stages = [reflect(WAVELENGTH, angle, index, [film]).mueller() for angle in reflections]
    whole = reduce(lambda so_far, stage: stage @ so_far, stages)
    return whole / whole[..., :1, :1]


def metal_mirror(incidence, **values):
    return coated("gold", [incidence], incidence, **values)


def k_mirror(incidence, **values):
    angles = [incidence, 2 * incidence - 90 * u.deg, incidence]
    return coated("silver", angles, incidence, **values)


def power_law_mirror(b1, m1, b2, m2, incidence):
    length = WAVELENGTH.to_value(u.m)
    permittivity = -(10.0**b1) * length**m1 + 1j * 10.0**b2 * length**m2
    return reflect(WAVELENGTH, incidence, np.sqrt(permittivity)).mueller()


def gained(gain):
    return np.asarray(gain)[..., None, None] * np.eye(4)


def stray(share):
    return np.eye(4) + np.asarray(share)[..., None, None] * np.diag([1.0, 0, 0, 0])


def of_source(share, amount):
    """Return a share of the flux of a frame as one of the light of the source."""
    return share / np.maximum(1 - amount * share, 0.01)


def background(share, q, u):
    out = stray(share) + np.zeros((*np.shape(share * q * u), 4, 4))
    out[..., 1, 0], out[..., 2, 0] = q, u
    return out


def wave(n, x, cosine, sine):
    return cosine * np.cos(n * x) + sine * np.sin(n * x)


def harmonic_rotator(n):
    return lambda x, **amplitudes: mueller.rotation_matrix(wave(n, x, **amplitudes))


def harmonic_retarder(n):
    return lambda x, **amplitudes: mueller.rotate(
        mueller.linear_retarder(wave(n, x, **amplitudes)), x
    )


def harmonic_gain(n, sign=1):
    return lambda x, **amplitudes: gained(1 + sign * u.Quantity(wave(n, x, **amplitudes)).value)


def perturbation(kind, wave=lambda x: (x, 0 * x)):
    """Matrix exponential of the generator, by the series of scipy."""

    def expected(x, amplitude, quadrature):
        first, second = wave(u.Quantity(x).to_value(getattr(x, "unit", u.one)))
        exponent = np.asarray(amplitude * first + quadrature * second)
        if kind == "gain":
            return gained(1 + exponent)
        return expm(exponent[..., None, None] * GENERATORS[kind])

    return expected


def turning(n):
    return lambda x: (np.cos(n * np.deg2rad(x)), np.sin(n * np.deg2rad(x)))


def drift(x):
    return 2 * x - 1, 0 * x


def switched(x):
    return 1.0 * x, 0 * x


@dataclass(frozen=True)
class Case:
    """
    What the laws need to know of an optic.

    ``values``: strategy of physical parameter values within the bounds, as
    floats in the declared units; ``expected``: the Mueller matrix of these
    values (as quantities), by the functions of `astropolcal.mueller`; of a
    `FrameOptic` its first argument is the position; ``smooth``: strategy where
    the derivatives are finite; ``settings``: further arguments of the class;
    ``mount``: the name of a stage, or one of `COORDINATES`; ``position``:
    strategy of positions of that mount, in degree or as numbers.
    """

    optic: type
    values: st.SearchStrategy
    expected: object
    smooth: st.SearchStrategy | None = None
    settings: dict = field(default_factory=dict)
    mount: str = "stage"
    position: st.SearchStrategy = ANGLE

    @property
    def differentiable(self):
        return self.values if self.smooth is None else self.smooth

    @property
    def per_frame(self):
        return issubclass(self.optic, FrameOptic)

    @property
    def placed(self):
        """Strategy of positions with their unit, None where they only turn the optic."""
        unit = u.one if self.mount in COORDINATES else u.deg
        return self.position.map(lambda x: x * unit) if self.per_frame else st.none()


def case(optic, expected, smooth=None, settings=None, mount="stage", position=ANGLE, **values):
    strategy = st.fixed_dictionaries(values)
    steep = None if smooth is None else st.fixed_dictionaries(values | smooth)
    return Case(optic, strategy, expected, steep, settings or {}, mount, position)


CASES = {
    "BeamGain": case(
        optics.BeamGain,
        lambda imbalance: gained(1 + imbalance),
        imbalance=GAIN,
    ),
    "BeamGain, left": case(
        optics.BeamGain,
        lambda imbalance: gained(1 - imbalance),
        settings={"beam": "left"},
        imbalance=GAIN,
    ),
    "Depolarizer": Case(
        optics.Depolarizer,
        depolarization(),
        lambda retained_q, retained_u, retained_v: np.diag([1, retained_q, retained_u, retained_v]),
    ),
    "Diattenuator": case(
        optics.Diattenuator,
        lambda diattenuation: mueller.diattenuator_retarder(diattenuation, 0 * u.deg),
        smooth={"diattenuation": SMOOTH},
        diattenuation=SIGNED,
    ),
    "DiattenuatorRetarder": case(
        optics.DiattenuatorRetarder,
        mueller.diattenuator_retarder,
        smooth={"diattenuation": SMOOTH},
        diattenuation=SIGNED,
        retardance=DEGREES,
    ),
    "DriftRetarder": case(
        optics.DriftRetarder,
        lambda x, horizontal, diagonal, horizontal_rate, diagonal_rate: mueller.elliptical_retarder(
            horizontal + horizontal_rate * x, diagonal + diagonal_rate * x, 0 * u.deg
        ),
        mount="sequence",
        position=FRACTION,
        horizontal=DEGREES,
        diagonal=DEGREES,
        horizontal_rate=DEGREES,
        diagonal_rate=DEGREES,
    ),
    "DriftRotator": case(
        optics.DriftRotator,
        lambda x, rate: mueller.rotation_matrix(rate * x),
        mount="sequence",
        position=FRACTION,
        rate=SMALL,
    ),
    "EllipticalRetarder": case(
        optics.EllipticalRetarder,
        mueller.elliptical_retarder,
        horizontal=DEGREES,
        diagonal=DEGREES,
        circular=DEGREES,
    ),
    "FerroelectricLiquidCrystal": case(
        optics.FerroelectricLiquidCrystal,
        lambda x, retardance, switching_angle: mueller.rotate(
            mueller.linear_retarder(retardance), x * switching_angle
        ),
        mount="flc_state",
        position=FRACTION,
        retardance=DEGREES,
        switching_angle=st.floats(-90, 90),
    ),
    "FluxGain": case(
        optics.FluxGain,
        lambda x, right, left: gained(1 + right * x),
        mount="flux",
        position=st.floats(0, 1.9),
        right=GAIN,
        left=GAIN,
    ),
    "FluxGain, left": case(
        optics.FluxGain,
        lambda x, right, left: gained(1 + left * x / 3e4),
        settings={"beam": "left", "reference": 3e4},
        mount="flux",
        position=st.floats(0, 6e4),
        right=GAIN,
        left=GAIN,
    ),
    "FluxGain, reciprocal": case(
        optics.FluxGain,
        lambda x, right, left: gained(1 / np.maximum(1 - left * 2 / x, 0.01)),
        settings={"beam": "left", "power": -1, "reference": 2.0},
        mount="previous_flux",
        position=st.floats(1, 9),
        right=GAIN,
        left=GAIN,
    ),
    "StateAnalyser": case(
        optics.StateAnalyser,
        lambda x, efficiency, transmission: (
            (1 - x) * np.eye(4) + x * transmission * wollaston("right")(efficiency)
        ),
        smooth={"efficiency": SMOOTH},
        mount="beam=one",
        position=st.sampled_from([0.0, 1.0]),
        efficiency=SIGNED,
        transmission=FRACTION,
    ),
    "StateRetarder": case(
        optics.StateRetarder,
        lambda x, retardance: mueller.linear_retarder(x * retardance),
        mount="lcvr=A",
        position=st.sampled_from([0.0, 1.0]),
        retardance=DEGREES,
    ),
    "StrayLight": case(
        optics.StrayLight,
        lambda x, amount: stray(amount * of_source(3e4 / x, amount)),
        settings={"reference": 3e4},
        mount="total_flux",
        position=st.floats(1e3, 6e4),
        amount=st.floats(0, 0.5),
    ),
    "PolarizedBackground": case(
        optics.PolarizedBackground,
        lambda x, amount, q, u: background(
            *(part * of_source(3e4 / x, amount) for part in (amount, q, u))
        ),
        settings={"reference": 3e4},
        mount="total_flux",
        position=st.floats(1e3, 6e4),
        amount=st.floats(0.2, 0.5),
        q=st.floats(-0.1, 0.1),
        u=st.floats(-0.1, 0.1),
    ),
    "HarmonicGain": case(optics.HarmonicGain, harmonic_gain(1), cosine=GAIN, sine=GAIN),
    "HarmonicGain, left": case(
        optics.HarmonicGain,
        harmonic_gain(2),
        settings={"beam": "left", "harmonic": 2},
        cosine=GAIN,
        sine=GAIN,
    ),
    "HarmonicGain, differential": case(
        optics.HarmonicGain,
        harmonic_gain(4, sign=-1),
        settings={"beam": "left", "harmonic": 4, "differential": True},
        cosine=GAIN,
        sine=GAIN,
    ),
    "HarmonicRetarder": case(
        optics.HarmonicRetarder, harmonic_retarder(1), cosine=SMALL, sine=SMALL
    ),
    "HarmonicRetarder, tilt": case(
        optics.HarmonicRetarder,
        harmonic_retarder(2),
        settings={"harmonic": 2},
        cosine=SMALL,
        sine=SMALL,
    ),
    "HarmonicRotator": case(optics.HarmonicRotator, harmonic_rotator(1), cosine=SMALL, sine=SMALL),
    "HarmonicRotator, 4": case(
        optics.HarmonicRotator,
        harmonic_rotator(4),
        settings={"harmonic": 4},
        cosine=SMALL,
        sine=SMALL,
    ),
    "KMirror": case(
        optics.KMirror,
        k_mirror,
        incidence=st.floats(50, 75),
        film_thickness=st.floats(5, 400),
        n_scale=st.floats(0.5, 2),
        k_scale=st.floats(0.7, 1.4),
    ),
    "LinearPolarizer": case(
        optics.LinearPolarizer, lambda: 0.5 * mueller.diattenuator_retarder(1.0, 0 * u.deg)
    ),
    "LinearRetarder": case(optics.LinearRetarder, mueller.linear_retarder, retardance=DEGREES),
    "MetalMirror": case(
        optics.MetalMirror,
        metal_mirror,
        settings={"material": "gold"},
        incidence=st.floats(2, 80),
        film_thickness=st.floats(5, 600),
        n_scale=st.floats(0.3, 3),
        k_scale=st.floats(0.7, 1.4),
    ),
    "MuellerElement": Case(
        optics.MuellerElement,
        mueller_elements(),
        lambda **m: np.array([[m[f"m{i}{j}"] for j in range(4)] for i in range(4)]),
    ),
    "ParityFlip": case(
        optics.ParityFlip,
        # a mirror, which keeps +Q and changes the sign of U and V, turned by 45 deg
        lambda: mueller.rotate(mueller.linear_retarder(180 * u.deg), 45 * u.deg),
    ),
    "Perturbation": case(
        optics.Perturbation,
        perturbation("retardance_d", turning(2)),
        settings={"kind": "retardance_d", "dependence": "harmonic:stage:2"},
        amplitude=st.floats(-1, 1),
        quadrature=st.floats(-1, 1),
    ),
    "Perturbation, rotation": case(
        optics.Perturbation,
        perturbation("rotation", drift),
        settings={"kind": "rotation", "dependence": "time"},
        mount="sequence",
        position=FRACTION,
        amplitude=st.floats(-1, 1),
        quadrature=st.just(0.0),
    ),
    "Perturbation, diattenuation": case(
        optics.Perturbation,
        perturbation("diattenuation_h", turning(1)),
        settings={"kind": "diattenuation_h", "dependence": "harmonic:stage:1"},
        amplitude=GAIN,
        quadrature=GAIN,
    ),
    "Perturbation, depolarization": case(
        optics.Perturbation,
        perturbation("depolarization_linear", switched),
        settings={"kind": "depolarization_linear", "dependence": "direction:hwp"},
        mount="hwp_direction",
        position=FRACTION,
        amplitude=FRACTION,
        quadrature=st.just(0.0),
    ),
    "Perturbation, gain": case(
        optics.Perturbation,
        perturbation("gain", switched),
        settings={"kind": "gain", "dependence": "move:derotator"},
        mount="derotator_move",
        position=FRACTION,
        amplitude=GAIN,
        quadrature=st.just(0.0),
    ),
    "PolarizedSource": case(
        optics.PolarizedSource,
        polarized_source,
        q=COMPONENT,
        u=COMPONENT,
    ),
    "PowerLawMirror": case(
        optics.PowerLawMirror,
        power_law_mirror,
        b1=st.floats(12, 15),
        m1=st.floats(1.6, 2.2),
        b2=st.floats(12, 15),
        m2=st.floats(1.6, 2.4),
        incidence=st.floats(2, 80),
    ),
    "Rotator": case(optics.Rotator, lambda: mueller.rotation_matrix(0 * u.deg)),
    "StarSource": case(
        optics.StarSource,
        star_source,
        p_max=st.floats(0, 0.1),
        lambda_max=st.floats(400, 800),
        K=st.floats(0.5, 1.5),
        rotation=st.floats(-20, 20),
        reference=st.floats(800, 2000),
        **dict.fromkeys(
            ("q", "u", "q_slope", "u_slope", "q_curvature", "u_curvature"), st.floats(-0.1, 0.1)
        ),
    ),
    "TwoLayerWaveplate": case(
        optics.TwoLayerWaveplate,
        lambda w_sio2, w_mgf2: mueller.linear_retarder(two_layer_retardance(w_sio2, w_mgf2)),
        w_sio2=st.floats(0, 3),
        w_mgf2=st.floats(0, 3),
    ),
    "VectorDiattenuator": case(
        optics.VectorDiattenuator,
        vector_diattenuator,
        smooth={"horizontal": st.floats(-0.65, 0.65), "diagonal": st.floats(-0.65, 0.65)},
        horizontal=COMPONENT,
        diagonal=COMPONENT,
    ),
    "WollastonPrism": case(
        optics.WollastonPrism,
        wollaston("right"),
        smooth={"efficiency": SMOOTH},
        efficiency=FRACTION,
    ),
    "WollastonPrism, left": case(
        optics.WollastonPrism,
        wollaston("left"),
        smooth={"efficiency": SMOOTH},
        settings={"beam": "left"},
        efficiency=FRACTION,
    ),
}
HOW = (
    "add to CASES in tests/optics/test_registry.py a case with a strategy of values for every "
    "parameter but theta and the same matrix by the functions of astropolcal.mueller; it is then "
    "tested for physicality, derivatives, light against matrix, copies, with_parameters and units"
)


def each(labels):
    """Run a test of one label for all; a failure names its label."""

    def decorated(test):
        def run():
            for label in labels:
                try:
                    test(label=label)
                except BaseException as error:
                    error.add_note(f"the case is {label!r}")
                    raise

        run.__name__, run.__doc__, run.__module__ = test.__name__, test.__doc__, test.__module__
        return run

    return decorated


every = each(CASES)
FRAME_OPTICS = [label for label, case_ in CASES.items() if case_.per_frame]
each_frame_optic = each(FRAME_OPTICS)
each_that_turns = each(sorted(set(CASES) - set(FRAME_OPTICS)))


def unit_of(optic, key):
    return getattr(optic, key).unit or u.dimensionless_unscaled


def with_units(cls, values):
    """Attach the declared units to plain values; numbers stay numbers."""
    default = cls()
    return {
        key: value if default._declared(key).unit is None else value * unit_of(default, key)
        for key, value in values.items()
    }


def build(label, values, position=None, **kwargs):
    case_ = CASES[label]
    if position is not None:
        kwargs = {"mount": case_.mount} | kwargs
    optic = case_.optic(**with_units(case_.optic, values), **(case_.settings | kwargs))
    if position is not None:
        optic.position = position
    return optic


def expected_matrix(label, values, position=None):
    where = () if position is None else (position,)
    return CASES[label].expected(*where, **with_units(CASES[label].optic, values))


def draw_per_wavelength(data, strategy):
    """Values of every parameter, one a wavelength."""
    several = [data.draw(strategy) for _ in WAVELENGTH]
    return {key: np.array([one[key] for one in several]) for key in several[0]}


def draw_smooth(data, label):
    strategy = CASES[label].differentiable
    if data.draw(st.booleans()):
        return draw_per_wavelength(data, strategy)
    return data.draw(strategy)


def apply(matrix, light):
    return np.einsum("...ij,j...->i...", matrix, np.asarray(light))


# --- the registry -----------------------------------------------------------------


def test_every_optic_has_a_case():
    missing = set(OPTICS) - {case.optic.__name__ for case in CASES.values()}
    assert not missing, f"{sorted(missing)}: {HOW}"


@every
@given(data=st.data())
@settings(max_examples=1)
def test_case_covers_every_parameter(label, data):
    own = set(CASES[label].optic().own_names)
    assert set(data.draw(CASES[label].values)) == own, f"{label}: {HOW}"
    assert set(data.draw(CASES[label].differentiable)) == own, f"{label}: {HOW}"


def _defined_optics():
    """Every concrete optic that a module of the package defines."""
    for module in pkgutil.iter_modules(optics.__path__):
        importlib.import_module(f"astropolcal.optics.{module.name}")
    pending, found = [Optic], set()
    while pending:
        cls = pending.pop()
        pending.extend(cls.__subclasses__())
        ours = cls.__module__.startswith("astropolcal.") and cls.__name__[0] != "_"
        if ours and not inspect.isabstract(cls):
            found.add(cls)
    return found


def test_every_optic_is_registered():
    missing = {cls.__name__ for cls in _defined_optics()} - {*OPTICS, "Light"}
    assert not missing, f"name {sorted(missing)} in OPTICS of astropolcal/optics/__init__.py"


def test_registry_name_is_the_public_name():
    for name, cls in OPTICS.items():
        assert cls.__name__ == name
        assert name in optics.__all__


@each(OPTICS)
def test_parameters_are_declared_in_full(label):
    name, optic = label, OPTICS[label]()
    assert optic.param_names[0] == "theta", "theta comes first, as the derivatives do"
    for key in optic.param_names:
        parameter = getattr(optic, key)
        assert parameter.__doc__, f"{name}.{key}: give the Parameter a description"
        assert parameter.bounds != (None, None) or parameter.fixed, (
            f"{name}.{key}: give the Parameter bounds, or fixed=True where it is known"
        )
        assert canonical_unit(parameter.unit) in STEP
        low, high = parameter.bounds
        assert low is None or low <= parameter.value
        assert high is None or parameter.value <= high


@each(OPTICS)
def test_only_theta_is_not_the_optics_own(label):
    optic = OPTICS[label]()
    assert ("theta", *optic.own_names) == optic.param_names
    assert optic.theta.fixed
    assert optic.inputs == optic.outputs == ("wavelength", "I", "Q", "U", "V")


# --- physics ----------------------------------------------------------------------


@every
@given(data=st.data())
@settings(max_examples=8)
def test_mueller_matrix_is_physical(label, data):
    values, position = data.draw(CASES[label].values), data.draw(CASES[label].placed)
    optic = build(label, values, position, theta=data.draw(ANGLE) * u.deg)
    assert np.all(mueller.is_physical(optic.mueller(WAVELENGTH)))


@every
@given(data=st.data())
@settings(max_examples=8)
def test_mueller_matrix_is_that_of_the_mueller_functions(label, data):
    values, position = data.draw(CASES[label].values), data.draw(CASES[label].placed)
    expected = expected_matrix(label, values, position)
    found = build(label, values, position).mueller(WAVELENGTH)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=0, atol=2e-13)


@pytest.mark.slow
@every
@given(data=st.data())
@settings(max_examples=6)
def test_one_value_a_wavelength_is_the_stack_of_the_scalars(label, data):
    values = draw_per_wavelength(data, CASES[label].values)
    position = data.draw(CASES[label].placed)
    together = build(label, values, position).mueller(WAVELENGTH)
    for i, wavelength in enumerate(WAVELENGTH):
        one = {key: value[i] for key, value in values.items()}
        alone = build(label, one, position).mueller(wavelength)
        row = together[i] if together.ndim == 3 else together
        np.testing.assert_allclose(row, alone, rtol=0, atol=1e-14)


@pytest.mark.slow
@every
@given(data=st.data(), angle=ANGLE)
@settings(max_examples=6)
def test_orientation_turns_the_matrix(label, data, angle):
    values, position = data.draw(CASES[label].values), data.draw(CASES[label].placed)
    turned = build(label, values, position, theta=angle * u.deg).mueller(WAVELENGTH)
    straight = build(label, values, position).mueller(WAVELENGTH)
    if CASES[label].optic.rotates_frame:
        expected = mueller.rotation_matrix(angle * u.deg) @ straight
    else:
        expected = mueller.rotate(straight, angle * u.deg)
    np.testing.assert_allclose(turned, expected, rtol=0, atol=1e-13)


@each_that_turns
@given(data=st.data(), theta=st.floats(-90, 90), position=st.floats(-90, 90))
@settings(max_examples=6)
def test_position_adds_to_theta(label, data, theta, position):
    values = data.draw(CASES[label].values)
    theta, position = theta * u.deg, position * u.deg
    plus = build(label, values, theta=theta, mount="stage")
    minus = build(label, values, theta=theta, mount="-stage")
    for optic, sum_ in ((plus, theta + position), (minus, theta - position)):
        expected = build(label, values, theta=sum_).mueller(WAVELENGTH)
        given_ = optic.mueller(WAVELENGTH, position=position)
        optic.position = position
        np.testing.assert_allclose(given_, expected, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(optic.mueller(WAVELENGTH), given_)


@pytest.mark.slow
@each_frame_optic
@given(data=st.data(), theta=ANGLE)
@settings(max_examples=6)
def test_position_is_the_coordinate(label, data, theta):
    values = draw_smooth(data, label)
    positions = u.Quantity([data.draw(CASES[label].placed) for _ in range(4)])
    optic = build(label, values, positions[0], theta=theta * u.deg)
    together = np.broadcast_to(optic.mueller(WAVELENGTH, positions[:, None]), (4, 3, 4, 4))
    # on a mount with a minus, the opposite position is the same
    other = build(label, values, -positions[0], theta=theta * u.deg, mount=f"-{CASES[label].mount}")
    for position, matrix in zip(positions, together, strict=True):
        optic.position, other.position = position, -position
        alone = np.broadcast_to(optic.mueller(WAVELENGTH), matrix.shape)
        np.testing.assert_allclose(matrix, alone, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(optic.mueller(WAVELENGTH), other.mueller(WAVELENGTH))


# an analyser has an amplitude in any case
@each([label for label in FRAME_OPTICS if label != "StateAnalyser"])
@given(data=st.data(), theta=ANGLE)
@settings(max_examples=4)
def test_without_amplitude_a_frame_optic_is_the_identity(label, data, theta):
    optic = build(label, {}, data.draw(CASES[label].placed), theta=theta * u.deg)
    assert not any(getattr(optic, key).value for key in optic.own_names)
    np.testing.assert_allclose(optic.mueller(), np.eye(4), rtol=0, atol=1e-15)


@pytest.mark.slow
@every
@given(data=st.data(), angle=ANGLE)
@settings(max_examples=6)
def test_light_is_matrix_times_stokes(label, data, angle):
    values = draw_smooth(data, label)
    optic = build(label, values, data.draw(CASES[label].placed), theta=angle * u.deg)
    light = data.draw(st.lists(st.floats(-3, 3), min_size=4, max_size=4))
    light = np.repeat(np.array(light)[:, None], WAVELENGTH.size, axis=1)
    through = optic(WAVELENGTH, *light)
    assert through[0] is WAVELENGTH or np.all(through[0] == WAVELENGTH)
    expected = apply(optic.mueller(WAVELENGTH), light)
    np.testing.assert_allclose(np.array(through[1:]), expected, rtol=0, atol=1e-12)


@every
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=4)
def test_light_of_many_frames(label, data, seed):
    light = np.random.default_rng(seed).normal(size=(4, 5, WAVELENGTH.size))
    optic = build(label, draw_smooth(data, label), data.draw(CASES[label].placed))
    through = np.array(optic(WAVELENGTH, *light)[1:])
    np.testing.assert_allclose(through, apply(optic.mueller(WAVELENGTH), light), atol=1e-12)


# --- derivatives ------------------------------------------------------------------


def differences(optic, key, position=None):
    """Five-point derivative of the Mueller matrix, per canonical unit."""
    unit = optic._declared(key).unit
    step = STEP_OF_UNIT.get(unit, STEP[canonical_unit(unit)])
    value = np.asarray(getattr(optic, key).value)

    def matrix(shift):
        moved = (value + shift * step / canonical_factor(unit)) * (unit or 1)
        return optic.with_parameters(**{key: moved}).mueller(WAVELENGTH, position)

    return (8 * (matrix(1) - matrix(-1)) - (matrix(2) - matrix(-2))) / (12 * step)


@pytest.mark.slow
@every
@given(data=st.data(), angle=ANGLE)
@settings(max_examples=3)
def test_derivatives_against_differences(label, data, angle):
    values, position = draw_smooth(data, label), data.draw(CASES[label].placed)
    optic = build(label, values, position, theta=angle * u.deg)
    derivatives = optic.mueller_derivatives(WAVELENGTH)
    assert list(derivatives) == list(optic.param_names)
    for key, derivative in derivatives.items():
        unit = unit_of(optic, key)
        assert derivative.unit == unit**-1
        found = derivative.to_value(canonical_unit(unit) ** -1)
        expected = differences(optic, key)
        scale = max(np.abs(expected).max(), 1.0)
        found = np.broadcast_to(found, expected.shape)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7 * scale)


@every
@given(data=st.data())
@settings(max_examples=3)
def test_derivative_to_theta_may_vary_with_wavelength(label, data):
    values, position = data.draw(CASES[label].differentiable), data.draw(CASES[label].placed)
    optic = build(label, values, position, theta=[-20, 3, 50] * u.deg)
    found = optic.mueller_derivatives(WAVELENGTH)["theta"].to_value(1 / u.rad)
    np.testing.assert_allclose(found, differences(optic, "theta"), rtol=0, atol=1e-7)


@each_frame_optic
@given(data=st.data())
@settings(max_examples=3)
def test_derivatives_at_several_positions(label, data):
    optic = build(label, draw_smooth(data, label), data.draw(CASES[label].placed))
    positions = u.Quantity([data.draw(CASES[label].placed) for _ in range(4)])[:, None]
    for key, derivative in optic.mueller_derivatives(WAVELENGTH, positions).items():
        found = derivative.to_value(canonical_unit(unit_of(optic, key)) ** -1)
        expected = differences(optic, key, positions)
        assert len(expected) == 4
        found = np.broadcast_to(found, expected.shape)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-7)


# --- units ------------------------------------------------------------------------


@every
@given(data=st.data(), angle=ANGLE)
@settings(max_examples=4)
def test_any_unit_gives_the_same_optic(label, data, angle):
    values = data.draw(CASES[label].values) | {"theta": angle}
    position = data.draw(CASES[label].placed)
    optic = build(label, values, position)
    quantities = {key: getattr(optic, key).value * unit_of(optic, key) for key in values}
    for i, wavelength in enumerate((WAVELENGTH.to(u.nm), WAVELENGTH.to(u.mm), WAVELENGTH)):
        others = {
            key: value.to(OTHER_UNITS.get(canonical_unit(value.unit), [u.percent] * 3)[i])
            for key, value in quantities.items()
        }
        other = CASES[label].optic(**others, **CASES[label].settings)
        if position is not None:
            other.mount, other.position = CASES[label].mount, position
        assert [getattr(other, k).unit for k in values] == [getattr(optic, k).unit for k in values]
        np.testing.assert_allclose(
            other.mueller(wavelength), optic.mueller(WAVELENGTH), rtol=0, atol=1e-11
        )


@every
def test_plain_number_is_refused_where_a_unit_is_due(label):
    cls = CASES[label].optic
    for key in cls().param_names:
        if cls()._declared(key).unit is not None:
            with pytest.raises(ParameterError, match=f"{cls.__name__}.{key} = 1.0 needs a unit"):
                cls(**{key: 1.0})
            with pytest.raises(ParameterError, match="needs a unit"):
                setattr(cls(), key, 1.0)


@every
def test_wrong_unit_is_refused(label):
    cls = CASES[label].optic
    for key in cls().param_names:
        with pytest.raises(ParameterError, match=f"{cls.__name__}.{key} has unit Jy"):
            cls(**{key: 1 * u.Jy})
        with pytest.raises(ParameterError, match=f"{cls.__name__}.{key} has unit Jy"):
            setattr(cls(), key, 1 * u.Jy)


@every
def test_value_that_is_not_finite_is_refused(label):
    cls = CASES[label].optic
    for key, bad in product(cls().param_names, [np.nan, np.inf, [0.1, np.nan]]):
        value = np.asarray(bad) * unit_of(cls(), key)
        with pytest.raises(ParameterError, match=f"{cls.__name__}.{key} = .* must be finite"):
            cls(**{key: value})


@every
def test_value_of_other_shape_is_refused(label):
    cls = CASES[label].optic
    for key, shape in product(cls().param_names, [(0,), (2, 2), (1, 3)]):
        with pytest.raises(ParameterError, match="scalar or one value per wavelength"):
            cls(**{key: np.zeros(shape) * unit_of(cls(), key)})


@every
def test_value_of_other_number_of_wavelengths_is_refused(label):
    cls = CASES[label].optic
    for key in cls().param_names:
        optic = cls(**{key: np.full(2, 0.5) * unit_of(cls(), key)}, name="it")
        message = rf"it.{key} has 2 values, one per wavelength, but {{}} wavelengths"
        for wavelength in (WAVELENGTH, 1.6 * u.um, None):
            count = 0 if wavelength is None else np.size(wavelength)
            with pytest.raises(ParameterError, match=message.format(count)):
                optic.mueller(wavelength)
        with pytest.raises(ParameterError, match=message.format(3)):
            optic(WAVELENGTH, 1, 0, 0, 0)


def test_misspelt_names_are_refused_wherever_they_are_given():
    plate = optics.LinearRetarder(retardance=170 * u.deg, name="plate")
    chain, curve = plate | optics.WollastonPrism(name="wollaston"), plate.curve("retardance")
    for call, error, words in (
        (lambda: optics.LinearRetarder(fixed={"tehta": False}), ParameterError, "mean 'theta'"),
        (lambda: optics.LinearRetarder(bounds={"tehta": (0, 1)}), ParameterError, "mean 'theta'"),
        (lambda: setattr(plate, "retardence", 1 * u.deg), ParameterError, "mean 'retardance'"),
        (lambda: setattr(chain, "retardance_2", 1 * u.deg), ParameterError, "mean 'retardance_0'"),
        (lambda: setattr(chain, "retardance", 1 * u.deg), ParameterError, "mean 'retardance_0'"),
        (lambda: setattr(curve, "retardence", 1 * u.deg), ParameterError, "mean 'retardance'"),
        (lambda: chain["plat"], ChainError, "it has plate, wollaston; did you mean 'plate'"),
    ):
        with pytest.raises(error, match=words):
            call()


@every
def test_unknown_and_positional_arguments_are_refused(label):
    cls = CASES[label].optic
    assert {"theta", "mount", "name", *cls().own_names} <= set(inspect.signature(cls).parameters)
    with pytest.raises(ParameterError, match=r"parameter 'retardence'.* parameters are theta"):
        cls(retardence=1 * u.deg)
    with pytest.raises(ParameterError, match=r"no parameter 'thetta'; did you mean 'theta'\?"):
        cls(thetta=1 * u.deg)
    with pytest.raises(ParameterError, match=r"by keyword: \('theta'"):
        cls(1 * u.deg)
    with pytest.raises(ParameterError, match=r"parameter of .* = 'retardence'"):
        cls().with_parameters(retardence=1 * u.deg)


@every
def test_unit_changed_behind_the_optics_back_is_refused(label):
    cls = CASES[label].optic
    optic = cls(name="it", **CASES[label].settings)
    # as some fitters of astropy may leave it
    optic.theta._set_unit(u.rad, force=True)
    for use in (
        lambda: optic.mueller(WAVELENGTH),
        lambda: optic.mueller_derivatives(WAVELENGTH),
        lambda: optic.with_parameters(),
        lambda: optic(WAVELENGTH, 1, 0, 0, 0),
    ):
        with pytest.raises(ParameterError, match=r"it.theta is in rad, but its bounds are in deg"):
            use()
    optic.theta = 0.1 * u.rad
    assert optic.theta.unit == u.deg
    optic.mueller(WAVELENGTH)


# --- copies -----------------------------------------------------------------------


@every
@given(data=st.data())
@settings(max_examples=4)
def test_assignment_keeps_the_declared_unit(label, data):
    optic = build(label, data.draw(CASES[label].values))
    for key, value in data.draw(CASES[label].values).items():
        unit, bounds = unit_of(optic, key), getattr(optic, key).bounds
        other = OTHER_UNITS.get(canonical_unit(unit), [u.percent])[-1]
        setattr(optic, key, (value * unit).to(other))
        assert getattr(optic, key).value == pytest.approx(value, abs=1e-12)
        assert getattr(optic, key).unit == optic._declared(key).unit
        assert getattr(optic, key).bounds == bounds
    optic.theta = 0.1 * u.rad
    assert (optic.theta.unit, optic.theta.value) == (u.deg, pytest.approx(np.degrees(0.1)))


def marked(label, values):
    """An optic in which everything that a copy must keep is unlike the default."""
    optic = build(label, values, name="it", mount=f"-{CASES[label].mount}")
    optic.position = 0.7 * optic.position.unit
    optic.theta.fixed, optic.theta.bounds = False, (-5, 5)
    for key in optic.own_names:
        getattr(optic, key).fixed = True
        getattr(optic, key).bounds = (-4, None)
    return optic


def state(optic):
    return [
        type(optic),
        optic.name,
        optic.mount,
        optic.position,
        optic._settings(),
        {key: (getattr(optic, key).fixed, getattr(optic, key).bounds) for key in optic.param_names},
    ]


@every
@given(data=st.data())
@settings(max_examples=3)
def test_copy_is_equal_and_independent(label, data):
    optic = marked(label, draw_smooth(data, label))
    copy = optic.copy()
    before = optic.mueller(WAVELENGTH)
    assert state(copy) == state(optic)
    np.testing.assert_array_equal(copy.mueller(WAVELENGTH), before)
    # a perturbation has the mount of what it follows, with either sign
    copy.position, copy.mount = 0.1 * copy.position.unit, CASES[label].mount
    copy.theta.fixed = True
    copy.theta = 3 * u.deg
    np.testing.assert_array_equal(optic.mueller(WAVELENGTH), before)
    mount = f"-{CASES[label].mount}"
    assert (optic.mount, optic.theta.fixed, optic.theta.value) == (mount, False, 0)


@every
@given(data=st.data())
@settings(max_examples=3)
def test_with_parameters_changes_only_the_values(label, data):
    optic = marked(label, data.draw(CASES[label].values))
    values = draw_per_wavelength(data, CASES[label].values) | {"theta": np.array([1.0, 2.0, 3.0])}
    other = optic.with_parameters(**with_units(CASES[label].optic, values))
    assert state(other) == state(optic)
    assert CASES[label].settings.items() <= other._settings().items()
    for key, value in values.items():
        np.testing.assert_array_equal(getattr(other, key).value, value)
        assert np.shape(getattr(optic, key).value) == ()
    optic.theta.tied = optic.theta.prior = abs
    same = optic.with_parameters()
    assert same.theta.tied is same.theta.prior is abs
    optic.theta.tied, optic.theta.prior = False, None
    assert state(same) == state(optic)
    np.testing.assert_array_equal(same.mueller(WAVELENGTH), optic.mueller(WAVELENGTH))


@every
def test_assignment_of_another_shape_points_to_with_parameters(label):
    optic = CASES[label].optic()
    with pytest.raises(ParameterError, match=r"shape \(\), not \(2,\); optic.with_parameters\(the"):
        optic.theta = [1, 2] * u.deg


@every
@given(data=st.data())
@settings(max_examples=3)
def test_loosened_optic_is_the_same_at_its_wavelengths(label, data):
    mount = CASES[label].mount
    optic = build(label, data.draw(CASES[label].values), name="it", mount=mount)
    loose = optic.loosened(WAVELENGTH)
    assert (loose.name, loose.mount) == ("it", mount)
    np.testing.assert_allclose(
        loose.mueller(WAVELENGTH), optic.mueller(WAVELENGTH), rtol=0, atol=1e-12
    )


@every
def test_repr_names_class_values_mount_and_name(label):
    mount = f"-{CASES[label].mount}"
    optic = build(label, {}, name="it", mount=mount)
    text = repr(optic)
    assert text.startswith(f"<{type(optic).__name__}(theta=0. deg")
    assert all(f"{key}=" in text for key in optic.param_names)
    assert all(f", {key}={value!r}" in text for key, value in CASES[label].settings.items())
    assert text.endswith(f"mount={mount!r}, name='it')>")


@every
def test_only_a_law_in_wavelength_needs_a_wavelength(label):
    optic = CASES[label].optic()
    if optic.loosened(WAVELENGTH) is optic:
        assert optic.mueller().shape == (4, 4)
    else:
        with pytest.raises(ParameterError, match="depends on wavelength: give one"):
            optic.mueller()
