# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that follow the flux: detectors that are not linear, afterglow, and added light."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from astropolcal.chain import with_beam
from astropolcal.exceptions import ParameterError
from astropolcal.optics import FluxGain, PolarizedBackground, StrayLight, WollastonPrism

SHARE = st.floats(-0.4, 0.4)
FLUX = st.floats(1.0, 1e8)
STOKES = np.array([1.0, 0.3, -0.2, 0.1])
FLUXES = {FluxGain: "flux", StrayLight: "total_flux", PolarizedBackground: "total_flux"}


def optic(cls, **settings):
    return cls(mount=FLUXES[cls], name="optic", **settings)


# --- gains ------------------------------------------------------------------------------------


@given(right=SHARE, left=SHARE, flux=FLUX, reference=FLUX)
def test_each_beam_bends_by_its_own_coefficient(right, left, flux, reference):
    gain = optic(FluxGain, right=right, left=left, reference=reference)
    for beam, own in (("right", right), ("left", left)):
        expected = (1 + own * flux / reference) * np.eye(4)
        gain.beam = beam
        found = gain.mueller(position=flux)
        np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_coefficient_is_the_gain_at_the_reference():
    gain = optic(FluxGain, right=-0.03, reference=2e6)
    assert gain.mueller(position=2e6)[0, 0] == pytest.approx(0.97)
    assert gain.mueller(position=1e6)[0, 0] == pytest.approx(0.985)


@given(share=st.floats(0, 0.4), before=FLUX, now=FLUX)
def test_afterglow_is_a_share_of_the_frame_before(share, before, now):
    """F' = F (1 + k F_0 / (F / F_before)) = F + k F_0 F_before."""
    gain = FluxGain(right=share, power=-1, reference=1.0, mount="previous_flux", name="glow")
    found = now * gain.mueller(position=now / before)[0, 0]
    assert found == pytest.approx(now + share * before, rel=1e-12)


def test_no_flux_has_no_gain():
    """Masked rows have no flux; they must neither warn nor become infinite."""
    for power in [1, -1]:
        gain = FluxGain(right=0.2, power=power, mount="flux", name="gain")
        np.testing.assert_array_equal(gain.mueller(position=0.0), np.eye(4))
        found = gain.mueller(position=[0.0, 1.0])
        np.testing.assert_allclose(found[:, 0, 0], [1.0, 1.2])


def test_gain_of_one_beam_does_not_move_the_other():
    gain = optic(FluxGain, right=0.1, left=0.2)
    slopes = gain.mueller_derivatives(position=3.0)
    np.testing.assert_array_equal(slopes["left"].value, 0)
    np.testing.assert_allclose(slopes["right"].value, 3 * np.eye(4))
    gain.beam = "left"
    other = gain.mueller_derivatives(position=3.0)
    np.testing.assert_array_equal(other["right"].value, 0)


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


def test_polarized_background_without_polarization_is_stray_light():
    flux = np.array([10.0, 200.0])
    a = optic(StrayLight, amount=0.1, reference=50.0).mueller(position=flux)
    b = optic(PolarizedBackground, amount=0.1, reference=50.0).mueller(position=flux)
    np.testing.assert_array_equal(a, b)


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


def test_stray_light_dilutes_the_polarization_that_is_measured():
    """With b F_0 in F, the contrast of both beams is that of q (F - b F_0) / F."""
    chain = optic(StrayLight, amount=0.25, reference=4.0) | WollastonPrism(name="w")
    stray = chain["optic"]
    stray.position = 4.0
    right, left = (with_beam(chain, b)(1 * u.um, *STOKES)[1] for b in ("right", "left"))
    assert (right - left) / (right + left) == pytest.approx(0.3 * 0.75)


# --- all of them ------------------------------------------------------------------------------

VALUES = {
    FluxGain: {"right": 0.1, "left": -0.2},
    StrayLight: {"amount": 0.1},
    PolarizedBackground: {"amount": 0.1, "q": 0.2, "u": -0.1},
}


def test_derivatives_of_frames_and_wavelengths():
    """Shape (n_frames, n_wavelengths, 4, 4), against central differences."""
    for cls in FLUXES:
        values = {key: np.array([1.0, 0.5, -0.3]) * value for key, value in VALUES[cls].items()}
        made = optic(cls, **values, reference=20.0)
        lam, flux = [1.0, 1.5, 2.0] * u.um, np.array([[5.0], [40.0]])
        slopes = made.mueller_derivatives(lam, flux)
        for key, value in values.items():
            ends = [
                made.with_parameters(**{key: value + step}).mueller(lam, flux)
                for step in (1e-4, -1e-4)
            ]
            assert slopes[key].shape == (2, 3, 4, 4), cls
            np.testing.assert_allclose(slopes[key].value, (ends[0] - ends[1]) / 2e-4, atol=1e-5)


def test_reference_is_one_positive_number():
    for cls in FLUXES:
        for reference in [0.0, -1.0, np.nan, np.inf, [1.0, 2.0]]:
            with pytest.raises(ParameterError, match=rf"{cls.__name__}|StrayLight"):
                optic(cls, reference=reference)


def test_scale_of_the_fluxes_does_not_matter():
    """Counts or electrons: only flux over reference enters."""
    for cls in FLUXES:
        a, b = (
            optic(cls, **VALUES[cls], reference=10.0 * s).mueller(position=3.0 * s)
            for s in (1, 2.5)
        )
        np.testing.assert_allclose(a, b, rtol=1e-14)


def test_settings_survive_a_copy():
    for cls in FLUXES:
        made = optic(cls, **VALUES[cls], reference=7.0)
        again = made.with_parameters(**{next(iter(VALUES[cls])): 0.3})
        assert again.reference == made.copy().reference == 7.0, cls
        assert "reference=7.0" in repr(again), cls
