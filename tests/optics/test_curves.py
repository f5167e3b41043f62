# Licensed under a 3-clause BSD style license - see LICENSE
"""Curves of optics and chains, and fits to them."""

import sys
from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.fitting import LevMarLSQFitter, TRFLSQFitter

from astropolcal import optics
from astropolcal.chain import at_positions, system_mueller
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.observations import OBSERVABLES

WAVELENGTH = np.linspace(1.1, 2.3, 40) * u.um
ANGLE = np.linspace(0, 180, 31) * u.deg
DOUBLE = OBSERVABLES["normalized_double_difference"]


def instrument():
    return (
        optics.LinearPolarizer(theta=3 * u.deg, name="polarizer")
        | optics.TwoLayerWaveplate(mount="hwp", theta=13 * u.deg, name="hwp")
        | optics.HarmonicRetarder(cosine=3 * u.deg, mount="hwp", name="wobble")
        | optics.Rotator(theta=5 * u.deg, name="frame")
        | optics.DriftRotator(rate=2 * u.deg, mount="hwp", name="drift")
        | optics.EllipticalRetarder(horizontal=80 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )


def curves():
    """Curves of every kind, with inputs."""
    mirror = optics.MetalMirror(material="gold", film_thickness=50 * u.nm)
    chain = instrument()
    return [
        (chain["hwp"].curve("retardance"), WAVELENGTH),
        (chain["hwp"].curve("mueller", (1, 2), hwp=20 * u.deg), WAVELENGTH),
        (chain["hwp"].curve("mueller", (1, 2), against="hwp", wavelength=1.6 * u.um), ANGLE),
        (mirror.curve("retardance"), WAVELENGTH),
        (mirror.curve("diattenuation"), WAVELENGTH),
        (mirror.curve("I"), WAVELENGTH),
        (optics.LinearRetarder(retardance=80 * u.deg).curve("retardance"), WAVELENGTH),
        (chain.curve("Q", hwp=10 * u.deg), WAVELENGTH),
        (chain.curve("I", against="derotator", wavelength=1.6 * u.um, hwp=9 * u.deg), ANGLE),
        (chain.curve(DOUBLE, hwp=[0, 45] * u.deg), WAVELENGTH),
        (chain.curve(DOUBLE, against="hwp", wavelength=1.6 * u.um, hwp=[0, 45] * u.deg), ANGLE),
    ]


def test_values_are_those_of_the_optics():
    chain = instrument()
    hwp, angle = chain["hwp"], np.full(len(ANGLE), 30) * u.deg
    positions = {"hwp": ANGLE, "derotator": angle}
    expected = system_mueller(chain, 1.6 * u.um, positions)[:, 2, 0]
    curve = chain.curve("U", against="hwp", wavelength=1.6 * u.um, derotator=30 * u.deg)
    np.testing.assert_allclose(curve(ANGLE), expected, atol=1e-14)
    np.testing.assert_allclose(hwp.curve("retardance")(WAVELENGTH), hwp.retardance(WAVELENGTH))
    standing = at_positions(hwp, hwp=20 * u.deg)
    for curve in (hwp.curve("mueller", (2, 1), hwp=20 * u.deg), standing.curve("mueller", (2, 1))):
        np.testing.assert_allclose(curve(WAVELENGTH), standing.mueller(WAVELENGTH)[:, 2, 1])
    lamp = optics.Light(Q=0.5) | hwp
    assert lamp.curve("Q")(1.6 * u.um) == pytest.approx(lamp(1.6 * u.um)[2])


def test_an_observable_takes_the_frames_of_a_datum():
    chain = instrument()
    curve = chain.curve(DOUBLE, against="derotator", wavelength=1.6 * u.um, hwp=[0, 45] * u.deg)
    frames = {"hwp": [0, 45] * u.deg, "derotator": [70, 70] * u.deg}
    from astropolcal.chain import with_beam

    fluxes = [
        system_mueller(with_beam(chain, beam), 1.6 * u.um, frames)[:, 0, 0]
        for beam in ("right", "left")
    ]
    (plus, minus), total = fluxes[0] - fluxes[1], sum(fluxes).sum()
    assert curve(70 * u.deg) == pytest.approx((plus - minus) / total)


def test_derivatives_against_differences():
    for curve, x in curves():
        x = x.to_value(curve.input_units["x"])
        values = np.array(curve.parameters)
        found = curve.fit_deriv(x, *values)
        for i, name in enumerate(curve.param_names):
            step = np.zeros(values.size)
            step[i] = 1e-5 * max(1, abs(values[i]))
            difference = curve.evaluate(x, *(values + step)) - curve.evaluate(x, *(values - step))
            np.testing.assert_allclose(
                found[i], difference / (2 * step[i]), atol=1e-6, rtol=1e-6, err_msg=name
            )


def test_parameters_are_those_of_the_optics():
    chain = instrument()
    curve = chain.curve("I", hwp=0 * u.deg)
    assert curve.hwp_w_sio2 is chain["hwp"].w_sio2
    before = curve(1.6 * u.um)
    chain["polarizer"].theta = 1 * u.rad
    assert curve(1.6 * u.um) != before
    curve.hwp_theta = 0.5 * u.rad
    assert chain["hwp"].theta.quantity.to_value(u.rad) == pytest.approx(0.5)
    curve.hwp_theta.bounds = (0, 1) * u.rad
    assert chain["hwp"].theta.max == pytest.approx(np.rad2deg(1))
    assert curve.has_bounds
    # the optics of a copy are others
    curve.copy().hwp_theta = 0 * u.deg
    assert chain["hwp"].theta.value != 0


def test_retardance_measured_in_the_laboratory():
    truth = optics.TwoLayerWaveplate(w_sio2=1.65 * u.mm, w_mgf2=1.29 * u.mm)
    measured = truth.retardance(WAVELENGTH)
    curve = optics.TwoLayerWaveplate().curve("retardance")
    for x, y in (
        (WAVELENGTH, measured),
        (WAVELENGTH.to(u.nm), measured.to(u.rad)),
        (WAVELENGTH.value, measured.value),
    ):
        for fitter in (TRFLSQFitter, LevMarLSQFitter):
            found = fitter(calc_uncertainties=True)(curve, x, y)
            assert found.chain.w_sio2.quantity.to_value(u.um) == pytest.approx(1650, abs=1e-3)
            assert found.w_mgf2.std < 1e-6
            assert found(1.6 * u.um).to_value(u.deg) == pytest.approx(
                truth.retardance(1.6 * u.um).value, abs=1e-4
            )
    assert curve.w_sio2.value == 1.63398
    with pytest.raises(ParameterError, match="the data are in mm, but the curve gives deg"):
        TRFLSQFitter()(curve, WAVELENGTH, measured.value * u.mm)


def test_crossed_polarizers():
    chain = optics.LinearPolarizer(name="first") | optics.LinearPolarizer(
        theta=7 * u.deg, mount="analyser", fixed={"theta": False}, name="second"
    )
    flux = np.cos(ANGLE + 5 * u.deg) ** 2 / 2
    curve = chain.curve("I", against="analyser")
    assert curve(90 * u.deg) == pytest.approx(np.sin(np.deg2rad(7)) ** 2 / 2)
    for data in (flux, flux.to(u.percent)):
        found = TRFLSQFitter()(curve, ANGLE, data)
        assert found.chain["second"].theta.value == pytest.approx(5)
        assert found.second_theta.unit == u.deg


def test_ties_of_a_curve():
    chain = instrument()
    for optic in chain:
        for key in optic.param_names:
            getattr(optic, key).fixed = True
    chain["hwp"].w_sio2.fixed = False
    curve = chain.curve(DOUBLE, hwp=[0, 45] * u.deg)
    curve.hwp_w_mgf2.tied = lambda model: 0.78 * model.hwp_w_sio2
    curve.hwp_w_sio2 = 1.66 * u.mm
    curve.hwp_w_mgf2 = 1.66 * 0.78 * u.mm
    data = curve(WAVELENGTH)
    curve.hwp_w_sio2 = 1.64 * u.mm
    found = TRFLSQFitter()(curve, WAVELENGTH, data)
    assert found.hwp_w_sio2.value == pytest.approx(1.66, abs=1e-5)
    assert found.hwp_w_mgf2.value == pytest.approx(1.66 * 0.78, abs=1e-5)


def test_what_there_is_no_curve_of():
    chain, hwp = instrument(), instrument()["hwp"]
    for make, error, words in (
        (lambda: hwp.curve("retardence"), ParameterError, "did you mean 'retardance'"),
        (lambda: chain.curve("retardance"), ParameterError, "no curve of 'retardance'"),
        (lambda: hwp.curve("mueller"), ParameterError, "element = None"),
        (lambda: hwp.curve("mueller", (0, 4)), ParameterError, r"element = \(0, 4\)"),
        (lambda: hwp.curve("I", against="derotator"), ChainError, "no stage 'derotator'"),
        (lambda: hwp.curve("I", derotator=1 * u.deg), ChainError, "no stage 'derotator'"),
        (lambda: hwp.curve("I", against="hwp")(3 * u.deg), ParameterError, "give one"),
        (lambda: hwp.curve("I", wavelength=1 * u.um), ParameterError, "no single wavelength"),
        (lambda: hwp.curve("retardance", against="hwp"), ParameterError, "against wavelength"),
        (lambda: hwp.curve(DOUBLE), ChainError, "no beam splitter"),
        (lambda: chain.curve("I", hwp=[0, 45] * u.deg), ParameterError, "hwp has shape"),
        (lambda: hwp.curve("I")(1.6), ParameterError, "x = 1.6 needs a unit"),
        (lambda: hwp.curve("I")(-1 * u.um), ParameterError, "must be positive"),
    ):
        with pytest.raises(error, match=words):
            make()


def test_threads_share_a_curve():
    curve = instrument()["hwp"].curve("mueller", (1, 2))

    def one(i):
        x, values = WAVELENGTH.value[: 40 - i % 2], np.array(curve.parameters) + i % 3
        return curve.evaluate(x, *values), curve.fit_deriv(x, *values)

    expected, interval = [one(i) for i in range(6)], sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with ThreadPoolExecutor(3) as pool:
            found = list(pool.map(one, range(300)))
    finally:
        sys.setswitchinterval(interval)
    for i, both in enumerate(found):
        for a, b in zip(both, expected[i % 6], strict=True):
            np.testing.assert_array_equal(a, b)
