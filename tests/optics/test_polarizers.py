# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarizers, diattenuators and diattenuator-retarders."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ParameterError
from astropolcal.optics import (
    Diattenuator,
    DiattenuatorRetarder,
    LinearPolarizer,
    StateAnalyser,
    VectorDiattenuator,
    WollastonPrism,
)

EPSILON = st.floats(-1, 1)
DEGREES = st.floats(-360, 360)


def test_calibration_polarizer_at_90_deg_gives_minus_q():
    # CHARIS paper, Sec. 4.1: the polarized calibration source is -Q
    light = LinearPolarizer(theta=90 * u.deg)(1.6 * u.um, 1, 0, 0, 0)[1:]
    np.testing.assert_allclose(light, [0.5, -0.5, 0, 0], atol=1e-15)


@given(epsilon=EPSILON, retardance=DEGREES)
def test_diattenuator_retarder_of_the_paper(epsilon, retardance):
    root, phase = np.sqrt(1 - epsilon**2), np.radians(retardance)
    expected = [
        [1, epsilon, 0, 0],
        [epsilon, 1, 0, 0],
        [0, 0, root * np.cos(phase), root * np.sin(phase)],
        [0, 0, -root * np.sin(phase), root * np.cos(phase)],
    ]
    optic = DiattenuatorRetarder(diattenuation=epsilon, retardance=retardance * u.deg)
    # 1 - eps^2 cancels near |eps| = 1 in this form
    np.testing.assert_allclose(optic.mueller(), expected, rtol=0, atol=2e-8)


def test_derivatives_are_finite_at_full_diattenuation():
    for epsilon in [-1.0, 1.0]:
        optic = DiattenuatorRetarder(diattenuation=epsilon, retardance=30 * u.deg)
        for derivative in optic.mueller_derivatives().values():
            assert np.all(np.isfinite(derivative.value)), epsilon
        assert optic.mueller_derivatives()["diattenuation"][0, 1] == 1, epsilon


def test_a_diattenuation_of_more_than_one_is_refused():
    """It has no Mueller matrix: a number would be none."""
    strong = (
        Diattenuator(diattenuation=[0.1, -1.5], name="it"),
        DiattenuatorRetarder(diattenuation=1.5, name="it"),
        VectorDiattenuator(horizontal=[0.9, 1.2], diagonal=0.9, name="it"),
        WollastonPrism(efficiency=1.5, name="it"),
    )
    for optic in strong:
        with pytest.raises(ParameterError, match=r"it: the \w+ is 1\.5; allowed is 1"):
            optic.mueller()
    with pytest.raises(ParameterError, match=r"it: the \w+ is 1\.5; allowed is 1"):
        StateAnalyser(efficiency=-1.5, name="it", mount="beam=a").mueller(position=1)
    # as a fitter without bounds may leave it
    with pytest.raises(ParameterError, match=r"it: the efficiency is 1\.0000001; allowed is 1"):
        WollastonPrism(efficiency=1 + 1e-7, name="it").mueller()
    perfect = VectorDiattenuator(horizontal=0.6, diagonal=0.8)
    np.testing.assert_allclose(perfect.mueller()[3, 3], 0.0, atol=1e-7)
