# Licensed under a 3-clause BSD style license - see LICENSE
"""Stock fits of an optic through a curve, next to models of astropy written by hand."""

import astropy.units as u
import numpy as np
from astropy.modeling import Fittable1DModel, Parameter
from astropy.modeling.fitting import TRFLSQFitter
from timing import fastest

from astropolcal import optics
from astropolcal.materials import get_material


class Plate(Fittable1DModel):
    """Retardance of a plate of quartz and MgF2, degree, for micrometre and millimetre."""

    w_sio2 = Parameter(default=1.63398, unit=u.mm, bounds=(0, None))
    w_mgf2 = Parameter(default=1.27711, unit=u.mm, bounds=(0, None))
    input_units = {"x": u.um}

    def _parameter_units_for_data_units(self, inputs_unit, outputs_unit):
        return {"w_sio2": u.mm, "w_mgf2": u.mm}

    @staticmethod
    def slopes(x):
        indices = (get_material(name)._birefringence_um(x) for name in ("quartz", "MgF2"))
        return [sign * 360e3 / x * index for sign, index in zip((1, -1), indices, strict=True)]

    def evaluate(self, x, w_sio2, w_mgf2):
        quartz, mgf2 = self.slopes(x)
        return w_sio2 * quartz + w_mgf2 * mgf2

    def fit_deriv(self, x, w_sio2, w_mgf2):
        return self.slopes(x)


class Element(Fittable1DModel):
    """Element (1, 1) of the Mueller matrix of a turning retarder, degree."""

    theta = Parameter(default=5.0, unit=u.deg, bounds=(-180, 180))
    retardance = Parameter(default=170.0, unit=u.deg, bounds=(-360, 360))
    input_units = {"x": u.deg}

    def _parameter_units_for_data_units(self, inputs_unit, outputs_unit):
        return {"theta": u.deg, "retardance": u.deg}

    def evaluate(self, x, theta, retardance):
        angle = np.deg2rad(2 * (x + theta))
        return np.cos(angle) ** 2 + np.sin(angle) ** 2 * np.cos(np.deg2rad(retardance))

    def fit_deriv(self, x, theta, retardance):
        angle, delta = np.deg2rad(2 * (x + theta)), np.deg2rad(retardance)
        to_theta = np.deg2rad(2) * np.sin(2 * angle) * (np.cos(delta) - 1)
        return [to_theta, -np.deg2rad(1) * np.sin(angle) ** 2 * np.sin(delta)]


def test_a_fit_through_a_curve_costs_what_a_model_by_hand_does(measured):
    rng = np.random.default_rng(1)
    wavelength, angle = np.linspace(1.1, 2.3, 50) * u.um, np.linspace(0, 180, 50) * u.deg
    plate = optics.TwoLayerWaveplate().curve("retardance")
    retardance = plate(wavelength) + rng.normal(0, 0.1, 50) * u.deg
    retarder = optics.LinearRetarder(
        retardance=170 * u.deg, theta=5 * u.deg, mount="stage", fixed={"theta": False}
    )
    element = retarder.curve("mueller", (1, 1), against="stage")
    flux = Element().evaluate(angle.value, 7, 165) + rng.normal(0, 0.01, 50)
    fit = TRFLSQFitter()
    for what, ours, theirs, x, y in (
        ("retardance of a plate", plate, Plate(), wavelength, retardance),
        ("element of a Mueller matrix", element, Element(), angle, flux * u.one),
    ):
        found = [fit(model, x, y).parameters for model in (ours, theirs)]
        np.testing.assert_allclose(*found, rtol=1e-6)
        curve, by_hand = fastest(
            lambda ours=ours, x=x, y=y: fit(ours, x, y),
            lambda theirs=theirs, x=x, y=y: fit(theirs, x, y),
            repeats=60,
        )
        measured(f"fit of a curve, {what}", curve, {"model of astropy by hand": by_hand})
        assert curve < 1.5 * by_hand
