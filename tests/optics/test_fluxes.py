# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that follow the flux: detectors that are not linear, afterglow, and added light."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from astropolcal.exceptions import ParameterError
from astropolcal.optics import FluxGain, PolarizedBackground, StrayLight

SHARE = st.floats(-0.4, 0.4)
FLUX = st.floats(1.0, 1e8)
STOKES = np.array([1.0, 0.3, -0.2, 0.1])
FLUXES = {FluxGain: "flux", StrayLight: "total_flux", PolarizedBackground: "total_flux"}


def optic(cls, **settings):
    return cls(mount=FLUXES[cls], name="optic", **settings)


# --- gains ------------------------------------------------------------------------------------


def test_no_flux_has_no_gain():
    """Masked rows have no flux; they must neither warn nor become infinite."""
    for power, wanted in [(1, 1.2), (-1, 1.25)]:
        gain = FluxGain(right=0.2, power=power, mount="flux", name="gain")
        np.testing.assert_array_equal(gain.mueller(position=0.0), np.eye(4))
        found = gain.mueller(position=[0.0, 1.0])
        np.testing.assert_allclose(found[:, 0, 0], [1.0, wanted])


def test_gain_of_one_beam_does_not_move_the_other():
    gain = optic(FluxGain, right=0.1, left=0.2)
    slopes = gain.mueller_derivatives(position=3.0)
    np.testing.assert_array_equal(slopes["left"].value, 0)
    np.testing.assert_allclose(slopes["right"].value, 3 * np.eye(4))
    gain.beam = "left"
    other = gain.mueller_derivatives(position=3.0)
    np.testing.assert_array_equal(other["right"].value, 0)


@given(share=SHARE, flux=FLUX, before=FLUX)
def test_a_beam_gets_what_is_added_to_it_whatever_its_own_flux(share, flux, before):
    """Faint beams get as much as bright ones: a constant flux, or a share of the frame before."""
    assume(abs(share) * before < 0.98 * (flux + share * before))
    seen = flux + share * before
    for settings, position in (
        ({"mount": "flux", "reference": before}, seen),
        ({"mount": "previous_flux"}, seen / before),
    ):
        gain = FluxGain(right=share, power=-1, name="gain", **settings)
        found = flux * gain.mueller(position=position)
        np.testing.assert_allclose(found, seen * np.eye(4), rtol=1e-9)


# --- added light --------------------------------------------------------------------------------


@given(amount=SHARE, flux=FLUX, reference=FLUX)
def test_stray_light_adds_a_constant_flux(amount, flux, reference):
    """What is added does not depend on what the source gives: S M I = S + b F_0 = F."""
    added = amount * reference
    assume(abs(added) < 0.98 * (flux + added))
    stray = optic(StrayLight, amount=amount, reference=reference)
    out = flux * stray.mueller(position=flux + added) @ STOKES
    np.testing.assert_allclose(out, flux * STOKES + [amount * reference, 0, 0, 0], rtol=1e-9)


@given(amount=SHARE, q=SHARE, u_=SHARE, flux=FLUX)
def test_background_adds_the_same_stokes_vector(amount, q, u_, flux):
    assume(abs(1e4 * amount) < 0.98 * (flux + 1e4 * amount))
    background = optic(PolarizedBackground, amount=amount, q=q, u=u_, reference=1e4)
    out = flux * background.mueller(position=flux + 1e4 * amount) @ STOKES
    added = 1e4 * np.array([amount, q, u_, 0])
    np.testing.assert_allclose(out - flux * STOKES, added, rtol=1e-7, atol=1e-7 * (flux + 1e4))


def test_background_turns_with_its_axes_but_not_with_the_source():
    """q of a background at 45 deg is u, and light of the source passes as it came."""
    background = optic(PolarizedBackground, q=0.1, theta=45 * u.deg)
    matrix = background.mueller(position=1.0)
    np.testing.assert_allclose(matrix[:, 0], [1, 0, 0.1, 0], atol=1e-15)
    np.testing.assert_allclose(matrix[:, 1:], np.eye(4)[:, 1:], atol=1e-15)


def test_nothing_is_added_where_there_is_no_flux():
    for cls in [StrayLight, PolarizedBackground]:
        found = optic(cls, amount=0.3).mueller(position=[0.0, 2.0])
        np.testing.assert_array_equal(found[0], np.eye(4))
        assert found[1, 0, 0] == pytest.approx(1 / 0.85), cls
        # nearly all of a frame may be added light, but not all of it
        assert optic(cls, amount=0.5).mueller(position=0.1)[0, 0] == pytest.approx(501), cls


def test_reference_is_one_positive_number():
    for cls in FLUXES:
        for reference in [0.0, -1.0, np.nan, np.inf, [1.0, 2.0]]:
            with pytest.raises(ParameterError, match=rf"{cls.__name__}|StrayLight"):
                optic(cls, reference=reference)
