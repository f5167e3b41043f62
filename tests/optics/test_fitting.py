# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics among the models and fitters of astropy."""

import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter, fix_inputs
from astropy.modeling.fitting import (
    DogBoxLSQFitter,
    LevMarLSQFitter,
    LMLSQFitter,
    TRFLSQFitter,
)
from astropy.modeling.models import Identity, Mapping, Scale

from astropolcal import optics
from astropolcal.chain import leaves
from astropolcal.exceptions import ChainError, ParameterError

WAVELENGTH = np.linspace(1.1, 2.3, 30) * u.um
TO_U = Mapping((2,), n_inputs=5)


def plate(**values):
    values = {"w_sio2": 1.64 * u.mm, "w_mgf2": 1.28 * u.mm} | values
    return optics.TwoLayerWaveplate(theta=20 * u.deg, name="plate", **values)


def through(plate):
    return optics.Light(Q=1) | plate | TO_U


def relay():
    return (
        optics.LinearRetarder(retardance=100 * u.deg, theta=11 * u.deg, name="first")
        | optics.Diattenuator(diattenuation=0.3, theta=51 * u.deg, name="second")
        | optics.Rotator(theta=10 * u.deg, name="third")
        | optics.Depolarizer(retained_q=0.9, name="fourth")
    )


# --- stock fits of a chain ----------------------------------------------------------


def test_stock_fitters_with_and_without_units():
    truth = through(plate(w_sio2=1.65 * u.mm, w_mgf2=1.29 * u.mm))
    flux = truth(WAVELENGTH)
    for fitter in (TRFLSQFitter, LevMarLSQFitter, DogBoxLSQFitter, LMLSQFitter):
        start = through(plate())
        if fitter is LMLSQFitter:  # which knows no bounds
            for key in ("w_sio2", "w_mgf2"):
                getattr(start["plate"], key).bounds = (None, None)
        for wavelength, data in (
            (WAVELENGTH, flux),
            (WAVELENGTH.to(u.nm), flux * u.one),
            (WAVELENGTH.value, flux),
        ):
            found = fitter(calc_uncertainties=True)(start, wavelength, data)
            assert found["plate"].w_sio2.quantity.to_value(u.um) == pytest.approx(1650, abs=1e-3)
            assert found.w_mgf2_1.unit == u.mm
            assert found["plate"].w_mgf2.std < 1e-6
            np.testing.assert_allclose(found(WAVELENGTH), flux, rtol=0, atol=1e-7)
        assert start["plate"].w_sio2.value == 1.64


def test_in_place_the_optic_itself_is_fitted():
    own = plate()
    flux = through(plate(w_sio2=1.65 * u.mm))(WAVELENGTH)
    TRFLSQFitter()(through(own), WAVELENGTH, flux, inplace=True)
    assert own.w_sio2.value == pytest.approx(1.65, abs=1e-6)


def test_parameters_per_wavelength_are_refused_by_name():
    fixed = optics.LinearRetarder(retardance=np.linspace(80, 100, 30) * u.deg)
    flux = through(plate())(WAVELENGTH)
    with pytest.raises(ParameterError, match="retardance_1 has one value per wavelength, and no"):
        TRFLSQFitter()(through(fixed), WAVELENGTH, flux)


def test_units_of_the_data_are_those_of_the_chain():
    flux = through(plate())(WAVELENGTH)
    with pytest.raises(ParameterError, match="x0 is in %, but the chain gives plain numbers"):
        TRFLSQFitter()(through(plate()), WAVELENGTH, (flux * u.one).to(u.percent))
    counts = through(plate()) | Scale(3.0)
    counts.factor_3.fixed = True
    found = TRFLSQFitter()(counts, WAVELENGTH, 3 * flux)
    assert found["plate"].w_sio2.value == pytest.approx(1.64)


def test_wavelengths_have_units_except_in_a_fit():
    for model in (through(plate()), plate() | plate(), optics.Light()):
        with pytest.raises(ParameterError, match=r"wavelength = 1\.6 needs a unit"):
            model(1.6, *[0] * (model.n_inputs - 1))
    assert through(plate()).input_units == {"wavelength": u.um}


def test_what_no_fit_can_start_from_is_refused_by_every_fitter():
    flux, curve = through(plate())(WAVELENGTH), plate().curve("retardance")
    for fitter in (TRFLSQFitter(), LevMarLSQFitter(), DogBoxLSQFitter(), LMLSQFitter()):
        for key, value, words in (
            ("value", np.nan, r"w_sio2\w* = nan; a fit starts at finite numbers"),
            ("bounds", (1.7, 1.5), r"bounds of w_sio2\w* = 1.7, 1.5; the lower one is first"),
        ):
            start, law = through(plate()), curve.copy()
            setattr(start.w_sio2_1, key, value)
            setattr(law.w_sio2, key, value)
            for model, data in ((start, flux), (law, curve(WAVELENGTH))):
                with pytest.raises(ParameterError, match=words):
                    fitter(model, WAVELENGTH, data)
        with pytest.raises(ParameterError, match="of 1 inputs and 5 outputs; fitters take one of"):
            fitter(optics.Light(Q=1) | plate(), WAVELENGTH, flux)
        with pytest.raises(ParameterError, match="of 5 inputs and 5 outputs; fitters take one of"):
            fitter(plate(), WAVELENGTH, flux)


def test_ties_are_in_the_unit_of_the_parameter():
    def chain(angle):
        first, second = (
            optics.LinearRetarder(retardance=60 * u.deg, theta=t, fixed={"retardance": True})
            for t in (angle, 2 * angle)
        )
        first.theta.fixed = False
        second.theta.fixed = False
        # in another unit than that of the parameter
        second.theta.tied = lambda model: (2 * model.theta_1).to(u.rad)
        return optics.Light(Q=1) | first | second | TO_U

    flux = chain(12 * u.deg)(WAVELENGTH)
    found = TRFLSQFitter()(chain(10 * u.deg), WAVELENGTH, flux)
    assert found.theta_1.value == pytest.approx(12)
    assert found.theta_2.value == pytest.approx(24)


def test_bounds_are_converted():
    by_keyword = optics.LinearRetarder(bounds={"retardance": (1 * u.rad, None)})
    assert by_keyword.retardance.bounds == (np.rad2deg(1), None)
    optic = optics.LinearRetarder()
    optic.theta.bounds = (-60, 60) * u.arcmin
    assert optic.theta.bounds == (-1, 1)
    optic.theta.max = 120 * u.arcmin
    assert optic.theta.bounds == (-1, 2)
    assert optic.copy().theta.bounds == (-1, 2)
    with pytest.raises(ParameterError, match="bounds of theta has unit mm, which is not conv"):
        optic.theta.bounds = (0, 1) * u.mm

    class Own(optics.Optic):
        path = Parameter(default=0.0, unit=u.mm, bounds=(0 * u.um, 5 * u.um))

        def _matrix(self, dispersion, path):
            return np.eye(4)

        def _derivatives(self, dispersion, path):
            return (np.zeros((4, 4)),)

    assert Own().path.bounds == pytest.approx((0, 0.005))


# --- astropy's way with models --------------------------------------------------------


def test_light_is_a_source_with_one_input():
    light = optics.Light(I=2, Q=0.3, U=[0.1, 0.2], V=-0.4, theta=45 * u.deg)
    assert (light.n_inputs, light.n_outputs) == (1, 5)
    wavelength, I, Q, U, V = light([1.2, 1.6] * u.um)  # noqa: E741
    np.testing.assert_allclose(I, [2, 2])
    np.testing.assert_allclose(Q, [-0.1, -0.2], atol=1e-15)
    np.testing.assert_allclose(U, [0.3, 0.3])
    np.testing.assert_allclose(V, [-0.4, -0.4])
    np.testing.assert_array_equal(wavelength, [1.2, 1.6] * u.um)
    assert leaves(light | plate())[0] is light


def test_identity_and_fix_inputs_evaluate():
    expected = through(plate())(WAVELENGTH)
    for model in (
        fix_inputs(plate(), {"I": 1, "Q": 1, "U": 0, "V": 0}) | TO_U,
        fix_inputs(plate() | TO_U, {"I": 1, "Q": 1, "U": 0, "V": 0}),
        optics.Light(Q=1) | Identity(5) | plate() | Identity(5) | TO_U,
    ):
        np.testing.assert_allclose(model(WAVELENGTH), expected)
        assert model.input_units["wavelength"] == u.um


def test_parameters_of_a_chain_take_any_unit():
    chain = relay()
    chain.retardance_0 = 2 * u.rad
    assert chain["first"].retardance.quantity.to_value(u.rad) == pytest.approx(2)
    assert chain.retardance_0.unit == u.deg
    with pytest.raises(ParameterError, match="not convertible"):
        chain.retardance_0 = 2 * u.mm


def test_slices_of_a_chain():
    chain = relay()
    for index, names in (
        (slice(1, 3), ["second", "third"]),
        (slice(-2, None), ["third", "fourth"]),
        (slice("second", "fourth"), ["second", "third", "fourth"]),
        (slice(1), ["first"]),
    ):
        assert [optic.name for optic in leaves(chain[index])] == names
    assert chain[1:3]["third"] is chain["third"]
    for index in (slice(2, 2), slice(0, 4, 2)):
        with pytest.raises(ChainError, match="no optics at slice"):
            chain[index]


def test_an_optic_is_replaced_in_a_chain():
    chain, other = relay(), optics.LinearRetarder(retardance=30 * u.deg, name="other")
    new = chain.replace_submodel("second", other)
    assert [optic.name for optic in new] == ["first", "other", "third", "fourth"]
    assert type(new) is type(chain)
    assert new["other"] is other
    assert "second" in chain.submodel_names
    with pytest.raises(ChainError, match="no optic 'fifth' in the chain"):
        chain.replace_submodel("fifth", other)


def test_the_inverse_undoes_a_chain():
    light = (WAVELENGTH, 1, 0.2, 0.3, 0.4)
    for model in (relay(), plate(), relay().inverse.inverse):
        assert model.has_inverse
        for found, expected in zip(model.inverse(*model(*light)), light, strict=True):
            np.testing.assert_allclose(found, expected)


def test_what_forgets_light_has_no_inverse():
    for model in (optics.LinearPolarizer(), optics.WollastonPrism(), optics.Light()):
        with pytest.raises(NotImplementedError, match="has no inverse"):
            model.inverse  # noqa: B018
    with pytest.raises(NotImplementedError):
        (relay() | optics.LinearPolarizer()).inverse  # noqa: B018
    with pytest.raises(ParameterError, match="has no inverse"):
        optics.StarSource().inverse(1.6 * u.um, 1, 0, 0, 0)


def test_a_law_of_no_wavelength_is_refused():
    for key in ("lambda_max", "reference"):
        star = optics.StarSource(p_max=0.01, name="star", **{key: -5 * u.nm})
        with pytest.raises(ParameterError, match=f"star.{key} = -5 nm; allowed is above zero"):
            star.mueller(1.6 * u.um)


def test_chains_are_copied_and_pickled():
    for copy in (relay().copy(), pickle.loads(pickle.dumps(relay()))):
        assert [optic.name for optic in leaves(copy[1:3])] == ["second", "third"]
        np.testing.assert_allclose(
            copy(1.6 * u.um, 1, 1, 0, 0)[1:], relay()(1.6 * u.um, 1, 1, 0, 0)[1:]
        )


def test_a_notebook_shows_a_table():
    page = (relay() | TO_U)._repr_html_()
    assert page.startswith("<p>first | second | third | fourth | Mapping</p>")
    for text in ("Diattenuator", "diattenuation=0.3", "theta=51. deg"):
        assert text in page


def test_documentation_finds_what_a_parameter_is():
    from inspect import getdoc, getmembers, isdatadescriptor

    found = dict(getmembers(optics.LinearRetarder, isdatadescriptor))
    assert getdoc(found["retardance"]) == "phase between the two axes"
    assert "installed orientation" in getdoc(found["theta"])
    with pytest.raises(AttributeError, match="theta cannot be deleted"):
        del optics.LinearRetarder().theta
