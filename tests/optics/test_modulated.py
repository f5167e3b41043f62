# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that change from frame to frame: what their mounts and settings may be."""

from itertools import product

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import mueller, optics
from astropolcal.chain import system_mueller
from astropolcal.exceptions import ParameterError
from astropolcal.optics import (
    COORDINATES,
    OPTICS,
    DriftRotator,
    FluxGain,
    FrameOptic,
    HarmonicGain,
    HarmonicRetarder,
    HarmonicRotator,
)
from astropolcal.propagation import Propagator

HARMONIC = [HarmonicGain, HarmonicRetarder, HarmonicRotator]
ANGLE = st.floats(-180, 180).map(lambda x: x * u.deg)

# --- mounts ----------------------------------------------------------------------------------


def test_only_some_optics_stand_on_numbers():
    numeric = (
        "DriftRetarder",
        "DriftRotator",
        "FerroelectricLiquidCrystal",
        "FluxGain",
        "Perturbation",
        "PolarizedBackground",
        "StateAnalyser",
        "StateRetarder",
        "StrayLight",
    )
    for name, coordinate, sign in product(OPTICS, COORDINATES, ["", "-"]):
        mount = sign + coordinate
        if name in numeric:
            optic = OPTICS[name](mount=mount)
            assert optic.position.unit == u.one, (name, mount)
            assert (optic.stage, optic.stage_sign) == (coordinate, -1.0 if sign else 1.0)
        else:
            with pytest.raises(ParameterError, match=f"{name}: mount = '{mount}' is a number, not"):
                OPTICS[name](mount=mount)


def test_number_and_angle_are_not_exchanged():
    for coordinate in COORDINATES:
        _number_is_no_angle(DriftRotator(mount=coordinate))
    angle = HarmonicRotator(mount="hwp")
    for set_position in (
        lambda value: setattr(angle, "position", value),
        lambda value: angle.mueller(position=value),
    ):
        with pytest.raises(ParameterError, match=r"position = 0.5 needs a unit such as rad"):
            set_position(0.5)


def _number_is_no_angle(number):
    for set_position in (
        lambda value: setattr(number, "position", value),
        lambda value: number.mueller(position=value),
    ):
        with pytest.raises(ParameterError, match="position has unit deg, which is not conv"):
            set_position(5 * u.deg)
        with pytest.raises(ParameterError, match=r"position = .* must be finite"):
            set_position([0.5, np.nan])
    number.position = 50 * u.percent
    assert number.position == 0.5


def test_position_does_not_outlive_its_kind_of_mount():
    optic = DriftRotator(rate=10 * u.deg, mount="hwp")
    optic.position = 90 * u.deg
    optic.mount = "derotator"
    assert optic.position == np.pi / 2 * u.rad
    optic.mount = "sequence"
    assert optic.position == 0


def test_without_mount_there_is_no_effect():
    for optic in (FluxGain(right=0.1), DriftRotator(rate=9 * u.deg)):
        np.testing.assert_array_equal(optic.mueller(), np.eye(4))


def test_base_is_abstract():
    with pytest.raises(TypeError, match="abstract"):
        FrameOptic()


# --- settings --------------------------------------------------------------------------------


def test_settings_that_are_not_allowed_are_refused():
    for cls, bad in product(HARMONIC, [0, 3, -1, 1.5, "2", True, None, [1], np.array([1, 2])]):
        message = rf"{cls.__name__}.harmonic = .*; allowed are 1, 2, 4"
        with pytest.raises(ParameterError, match=message):
            cls(harmonic=bad)
        optic = cls(harmonic=2)
        with pytest.raises(ParameterError, match=message):
            optic.harmonic = bad
        assert optic.harmonic == 2
    for power in (0, 2, -2, "1", True, None):
        with pytest.raises(ParameterError, match=r"FluxGain.power = .*; allowed are 1, -1"):
            FluxGain(power=power)
    for reference in (0, -1, np.nan, np.inf, [1.0], "many", 5 * u.adu):
        with pytest.raises(ParameterError, match=r"FluxGain.reference"):
            FluxGain(reference=reference)
    for bad in ("no", 1, None):
        with pytest.raises(ParameterError, match=r"HarmonicGain.differential = .* True, False"):
            HarmonicGain(differential=bad)
    for cls in (FluxGain, HarmonicGain, optics.BeamGain):
        with pytest.raises(ParameterError, match=r"allowed are right, left"):
            cls(beam="up")


def test_numbers_of_numpy_become_plain():
    flux = FluxGain(power=np.int64(-1), reference=np.float32(0.5))
    wave = HarmonicGain(harmonic=np.int8(2), differential=np.True_)
    kinds = [type(x) for x in (flux.power, flux.reference, wave.harmonic, wave.differential)]
    assert kinds == [int, float, int, bool]


def test_repr_has_what_is_unlike_the_default():
    assert "harmonic" not in repr(HarmonicGain(mount="hwp"))
    text = repr(HarmonicGain(harmonic=2, differential=True, beam="left", mount="hwp", name="it"))
    assert text == (
        "<HarmonicGain(theta=0. deg, cosine=0., sine=0., harmonic=2, beam='left', "
        "differential=True, mount='hwp', name='it')>"
    )


# --- an optic of one's own -------------------------------------------------------------------


class Dusty(FrameOptic):
    """Diattenuator that grows with the position, with an axis that stands still."""

    slope = Parameter(default=0.0, bounds=(-0.3, 0.3), description="diattenuation a radian")

    def _matrix(self, coordinate, slope):
        return mueller.diattenuator_retarder(slope * np.asarray(coordinate), 0 * u.deg)

    def _derivatives(self, coordinate, slope):
        step = 1e-6
        ends = [self._matrix(coordinate, slope + sign * step) for sign in (1, -1)]
        return ((ends[0] - ends[1]) / (2 * step),)


@given(position=st.floats(-170, 170), theta=ANGLE, slope=st.floats(-0.3, 0.3))
def test_frame_optic_stands_still_unless_it_says_otherwise(position, theta, slope):
    optic = Dusty(slope=slope, theta=theta, mount="-hwp", name="dusty")
    epsilon = -slope * np.radians(position)
    expected = mueller.rotate(mueller.diattenuator_retarder(epsilon, 0 * u.deg), theta)
    found = optic.mueller(position=position * u.deg)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    chained = system_mueller(optic, positions={"hwp": position * u.deg})
    np.testing.assert_allclose(chained, found, rtol=0, atol=1e-15)
    chain = optic | optics.WollastonPrism(name="wollaston")
    right, left = Propagator(chain, [1.6], {"hwp": np.radians([position])}).fluxes()
    np.testing.assert_allclose((right - left) / (right + left), expected[1, 0], atol=1e-14)


# --- what they are for -----------------------------------------------------------------------


@pytest.mark.slow
@given(
    sign=st.sampled_from(["", "-"]),
    harmonic=st.sampled_from([1, 2, 4]),
    position=ANGLE,
    cosine=st.floats(-5, 5),
    sine=st.floats(-5, 5),
    retardance=ANGLE,
)
def test_rotators_around_a_plate_are_the_error_of_its_encoder(
    sign, harmonic, position, cosine, sine, retardance
):
    def error(factor, name):
        amplitudes = {"cosine": factor * cosine * u.deg, "sine": factor * sine * u.deg}
        return HarmonicRotator(**amplitudes, harmonic=harmonic, mount=f"{sign}hwp", name=name)

    plate = optics.LinearRetarder(retardance=retardance, mount=f"{sign}hwp", name="hwp")
    chain = error(1, "before") | plate | error(-1, "behind")
    x = (-1 if sign else 1) * position
    off = (cosine * np.cos(harmonic * x) + sine * np.sin(harmonic * x)) * u.deg
    expected = mueller.rotate(mueller.linear_retarder(retardance), x + off)
    found = system_mueller(chain, positions={"hwp": position})
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


def test_wavelength_that_is_none_is_refused():
    """Also by optics that depend on no wavelength."""
    for optic in [cls() for cls in OPTICS.values()]:
        for wavelength in (-1.0, 0.0, np.nan, np.inf) * u.um:
            with pytest.raises(ParameterError, match="must be positive"):
                optic.mueller(wavelength)
