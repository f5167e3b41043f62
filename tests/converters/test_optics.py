# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics and chains of optics survive an ASDF file with all their constraints."""

import io

import asdf
import astropy.units as u
import numpy as np
import pytest
from asdf.exceptions import ValidationError
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from astropolcal import optics
from astropolcal.chain import leaves
from astropolcal.converters.extension import OPTIC_MODULES, OpticConverter, optic_tag
from astropolcal.converters.nodes import (
    node_from_optic,
    optic_from_node,
)
from astropolcal.exceptions import CalibrationFileError
from astropolcal.measurement import Normal
from astropolcal.optics import OPTICS

NAMES = sorted(OPTICS)
numbers = st.floats(allow_nan=False, allow_infinity=False)
some_bounds = st.tuples(st.none() | numbers, st.none() | numbers)
# strategies of the settings that some optics have
SETTINGS = {
    "beam": st.sampled_from(["right", "left"]),
    "dependence": st.sampled_from(["constant", "time", "harmonic:hwp:2", "step:3/dataset:a/b"]),
    "differential": st.booleans(),
    "film": st.sampled_from(["fused silica", "Al2O3"]),
    "harmonic": st.sampled_from([1, 2, 4]),
    "kind": st.sampled_from(["retardance_d", "diattenuation_h", "gain"]),
    "material": st.sampled_from(["silver", "gold"]),
    "power": st.sampled_from([1, -1]),
    "reference": st.floats(min_value=0, exclude_min=True, allow_infinity=False),
}


def written(thing):
    """Return the bytes of an ASDF file that holds one thing."""
    buffer = io.BytesIO()
    asdf.AsdfFile({"thing": thing}).write_to(buffer)
    return buffer.getvalue()


def read(content):
    """Read the thing, validated, with failed conversions as errors."""
    with asdf.config_context() as config:
        config.validate_on_read = True
        config.warn_on_failed_conversion = False
        with asdf.open(io.BytesIO(content), lazy_load=False, memmap=False) as file:
            return file["thing"]


def round_trip(thing):
    return read(written(thing))


def assert_same(optic, again):
    """Compare all of two optics, values to the last bit."""
    assert type(again) is type(optic)
    assert again._settings() == optic._settings()
    kinds = [[type(x) for x in one._settings().values()] for one in (again, optic)]
    assert kinds[0] == kinds[1]
    assert again.param_names == optic.param_names
    for key in optic.param_names:
        old, new = getattr(optic, key), getattr(again, key)
        assert new.shape == old.shape
        assert np.asarray(new.value).tobytes() == np.asarray(old.value, dtype=float).tobytes()
        assert new.unit == old.unit
        assert new.fixed is old.fixed
        assert new.bounds == old.bounds
        assert new.tied is False


@st.composite
def an_optic(draw, name):
    """Any values, shapes, names, mounts, fixed flags and bounds."""
    cls = OPTICS[name]
    n = draw(st.integers(1, 5))
    value = numbers | st.lists(numbers, min_size=n, max_size=n)
    extra = {key: draw(SETTINGS[key]) for key in cls()._settings() if key not in ("name", "mount")}
    # what a perturbation follows is its mount
    if extra.get("dependence", "constant") == "constant":
        extra["mount"] = draw(st.sampled_from([None, "hwp", "-altitude", "nul l"]))
    declared = cls()._declared
    optic = cls(
        name=draw(st.none() | st.text("aZ0 _:~\"'\\\n\té中\U0001f52d", max_size=8)),
        **{key: np.array(draw(value)) * (declared(key).unit or 1) for key in cls.param_names},
        **extra,
    )
    for key in draw(st.lists(st.sampled_from(cls.param_names), unique=True)):
        getattr(optic, key).fixed = draw(st.booleans())
        getattr(optic, key).bounds = draw(some_bounds)
    return optic


# ---- the registry ------------------------------------------------------------------


def test_every_optic_has_a_converter():
    missing = sorted(set(OPTICS) ^ set(OPTIC_MODULES))
    assert not missing, (
        f"{missing}: an optic that calibration files can hold needs its module in OPTIC_MODULES "
        "(converters/extension.py), a schema resources/schemas/optics/<name>-1.0.0.yaml with each "
        "parameter and its unit, and an entry in resources/manifests"
    )
    for name, cls in OPTICS.items():
        assert OpticConverter(name).types == [f"{cls.__module__}.{cls.__qualname__}"]


def test_asdf_knows_the_optic():
    for name in NAMES:
        manager = asdf.AsdfFile().extension_manager
        assert manager.handles_type(OPTICS[name])
        assert manager.handles_tag(optic_tag(name))


@pytest.mark.slow
def test_defaults_survive():
    for name in NAMES:
        optic = OPTICS[name](name="it")
        assert_same(optic, round_trip(optic))


@pytest.mark.slow
def test_anything_survives():
    for name in NAMES:

        @settings(max_examples=2)
        @given(optic=an_optic(name))
        def survives_a_file(optic):
            assert_same(optic, round_trip(optic))

        @settings(max_examples=6)
        @given(optic=an_optic(name), name=st.just(name))
        def survives_its_node(optic, name):
            assert_same(optic, optic_from_node(name, node_from_optic(optic)))

        survives_a_file()
        survives_its_node()


# ---- what others lose --------------------------------------------------------------


def test_what_looks_false_or_like_one_number_survives():
    """Of bounds and flags, of one value a wavelength, of a signed zero and of mounts that count."""
    retarder, bounds = optics.LinearRetarder, [(0, None), (None, 0), (0, 0), (None, None)]
    for optic in [
        *(
            retarder(name="r", bounds={"retardance": b, "theta": b})
            for b in [*bounds, (-np.inf, 3)]
        ),
        optics.MuellerElement(name="window", fixed={"m11": False, "theta": False}),
        retarder(retardance=[3.0] * u.deg, name="r"),
        retarder(retardance=[-0.0, 0.0] * u.deg),
        *(optics.DriftRotator(mount=mount) for mount in ("sequence", "-sequence")),
        *(optics.FluxGain(mount=mount) for mount in ("flux", "previous_flux")),
    ]:
        assert_same(optic, round_trip(optic))


def test_wavelengths_of_the_values_survive():
    optic = optics.LinearRetarder(retardance=[1, 2] * u.deg, wavelength=[1.2, 1.6] * u.um)
    again = round_trip(optic)
    np.testing.assert_array_equal(again.retardance.wavelength, optic.retardance.wavelength)
    assert again.theta.wavelength is None
    # a fit makes a number of an array of one
    optic = optics.LinearRetarder(retardance=[1] * u.deg)
    optic.retardance.wavelength = [1.2] * u.um
    optic.retardance.value = 2.0
    assert round_trip(optic).retardance.value == 2


def test_position_of_a_frame_is_not_stored():
    optic = optics.Rotator(mount="hwp", name="it")
    optic.position = 45 * u.deg
    assert round_trip(optic).position == 0 * u.deg
    assert "position" not in node_from_optic(optic)


# ---- chains ------------------------------------------------------------------------


def make_chain():
    return (
        optics.LinearPolarizer(
            theta=90 * u.deg, name="polarizer", fixed={"theta": False}, bounds={"theta": (0, None)}
        )
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp", bounds={"w_sio2": (None, 2.0)})
        | optics.HarmonicRetarder(cosine=[1, 2, 3] * u.deg, harmonic=4, mount="hwp", name="tilt")
        | optics.EllipticalRetarder(horizontal=[1, 2, 3] * u.deg, name="derotator")
        | optics.WollastonPrism(efficiency=[0.9, 0.95, 1.0], beam="left", name="wollaston")
        | optics.HarmonicGain(
            sine=0.1, harmonic=2, differential=True, beam="left", mount="-hwp", name="wander"
        )
        | optics.FluxGain(
            left=0.1, power=-1, reference=2e4, beam="left", mount="previous_flux", name="lag"
        )
    )


def test_chain_survives_with_all_constraints():
    chain = make_chain()
    again = round_trip(chain)
    for old, new in zip(leaves(chain), leaves(again), strict=True):
        assert_same(old, new)


def test_chain_joined_from_the_right_survives():
    first, second, third = (optics.Rotator(theta=i * u.deg, name=f"r{i}") for i in range(3))
    again = round_trip(first | (second | third))
    assert [leaf.theta.value for leaf in leaves(again)] == [0, 1, 2]


def test_default_lazy_reading_gives_arrays():
    content = written(optics.LinearRetarder(retardance=[1, 2] * u.deg))
    with asdf.open(io.BytesIO(content)) as file:
        optic = file["thing"]
    assert type(optic.retardance.value) is np.ndarray
    assert optic.retardance.value.tolist() == [1, 2]


# ---- what is refused -----------------------------------------------------------------


class Homemade(optics.LinearRetarder):
    """An optic of a user."""


def test_optic_outside_the_registry_is_refused():
    with pytest.raises(CalibrationFileError, match=r"'mine' is a .*Homemade, which files cannot"):
        node_from_optic(Homemade(name="mine"))
    chain = optics.Rotator(name="first") | Homemade(name="mine") | optics.WollastonPrism()
    with pytest.raises(CalibrationFileError, match=r"'mine' is a .*Homemade, which files cannot"):
        written(chain)
    # namesake of an optic is refused
    impostor = type("Rotator", (optics.LinearRetarder,), {})
    with pytest.raises(CalibrationFileError, match="which files cannot hold"):
        node_from_optic(impostor(name="mine"))


def test_what_a_parameter_of_a_file_cannot_be():
    for change, words in [
        (lambda r: setattr(r, "tied", lambda model: model.theta), "has a callable 'tied'.*Tie"),
        (lambda r: setattr(r, "value", np.nan), "= .* finite"),
        (lambda r: setattr(r, "value", np.inf), "= .* finite"),
        # behind the optic's back
        (lambda r: r._set_unit(u.rad, force=True), "is in rad, allowed is deg"),
    ]:
        optic = optics.LinearRetarder(name="r")
        change(optic.retardance)
        with pytest.raises(CalibrationFileError, match=rf"r\.retardance {words}"):
            written(optic)


def test_prior_is_kept_if_it_is_a_distribution():
    optic = optics.LinearRetarder(name="r")
    optic.retardance.prior = norm(170, 2)
    optic.theta.prior = Normal(0 * u.deg, 6 * u.arcmin)
    again = optic_from_node("LinearRetarder", node_from_optic(optic))
    assert again.retardance.prior.mean() == 170
    assert again.theta.prior == optic.theta.prior
    optic.retardance.prior = lambda value: 0.0
    with pytest.raises(CalibrationFileError, match=r"prior of r\.retardance is a function"):
        written(optic)
    for bad in ({"kind": "normal"}, {"kind": "scipy", "distribution": "os"}, {"kind": 1}):
        node = node_from_optic(optics.Rotator(name="t"))
        node["parameters"]["theta"]["prior"] = bad
        with pytest.raises(CalibrationFileError, match=r"prior of t\.theta"):
            optic_from_node("Rotator", node)


@pytest.mark.slow
def test_schema_refuses():
    for old, new in [
        ("unit: deg", "unit: rad"),
        ("unit: deg", "unit: mm"),
        ("unit: deg", "notunit: deg"),
        ("fixed: true", "fixed: 1"),
        ("fixed: true", "fixed: 'no'"),
        ("bounds: [-180.0, 180.0]", "bounds: [-180.0]"),
        ("bounds: [-180.0, 180.0]", "bounds: [-180.0, high]"),
        ("value: 0.98", "value: high"),
        ("value: 0.98", "value: [0.98]"),
        ("value: 0.98", "value: 0.98\n      unit: deg"),
        ("name: wollaston", "name: 5"),
        ("name: wollaston", "colour: red"),
        ("mount: stage", "mount: '-'"),
        ("beam: right", "beam: upper"),
        ("efficiency:", "efficacy:"),
    ]:
        optic = optics.WollastonPrism(efficiency=0.98, mount="stage", name="wollaston")
        content = written(optic)
        assert content.count(old.encode()) == 1, (old, new)
        read(content)
        with pytest.raises(ValidationError):
            read(content.replace(old.encode(), new.encode()))


@pytest.mark.slow
def test_schema_refuses_settings():
    for old, new in [
        ("harmonic: 2", "harmonic: 3"),
        ("harmonic: 2", "harmonic: two"),
        ("harmonic: 2", "harmonic: 2.5"),
        ("harmonic: 2", "harmonic: true"),
        ("harmonic: 2", "harmony: 2"),
        ("differential: true", "differential: 1"),
        ("differential: true", "differential: 'true'"),
        ("power: -1", "power: 0"),
        ("power: -1", "power: -2"),
        ("power: -1", "power: true"),
        ("reference: 250.0", "reference: 0.0"),
        ("reference: 250.0", "reference: -250.0"),
        ("reference: 250.0", "reference: much"),
        ("reference: 250.0", "preference: 250.0"),
        ("beam: left", "beam: upper"),
    ]:
        gains = [
            optics.HarmonicGain(harmonic=2, differential=True, mount="hwp", name="wander"),
            optics.FluxGain(power=-1, reference=250, beam="left", mount="flux", name="bend"),
        ]
        content = next(file for file in map(written, gains) if old.encode() in file)
        assert content.count(old.encode()) == 1, (old, new)
        read(content)
        with pytest.raises(ValidationError):
            read(content.replace(old.encode(), new.encode()))


def test_setting_that_the_class_refuses():
    for optic, changed, message in [
        (optics.FluxGain(name="bend"), {"reference": np.inf}, r"reference = inf must be one pos"),
        (optics.FluxGain(name="bend"), {"power": 3}, r"power = 3; allowed are 1, -1"),
        (optics.HarmonicGain(name="bend"), {"harmonic": 3}, r"harmonic = 3; allowed are 1, 2, 4"),
        (optics.HarmonicGain(name="bend"), {"differential": 0}, r"differential = 0; allowed are"),
        (optics.HarmonicGain(name="bend"), {"mount": "flux"}, r"mount = 'flux' is a number"),
        (optics.BeamGain(name="bend"), {"beam": "up"}, r"beam = 'up'; allowed are"),
        (optics.BeamGain(name="bend"), {"mount": "--hwp"}, r"mount = '--hwp' must be None or"),
        (optics.BeamGain(name="bend"), {"harmonic": 1}, r"'harmonic'"),
    ]:
        node = node_from_optic(optic) | changed
        with pytest.raises(CalibrationFileError, match=rf"optic 'bend': .*{message}"):
            optic_from_node(type(optic).__name__, node)


def test_schema_refuses_arrays_of_another_kind():
    for datatype, shape, data in [
        ("int64", "[2]", "[1, 2]"),
        ("float64", "[1, 2]", "[[1.0, 2.0]]"),
    ]:
        with asdf.config_context() as config:
            config.array_inline_threshold = 10
            text = written(optics.LinearRetarder(retardance=[1, 2] * u.deg)).decode()
        assert "data: [1.0, 2.0]" in text, (datatype, shape, data)
        text = text.replace("datatype: float64", f"datatype: {datatype}").replace("[2]", shape)
        with pytest.raises(ValidationError):
            read(text.replace("[1.0, 2.0]", data).encode())
