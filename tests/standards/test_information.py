# Licensed under a 3-clause BSD style license - see LICENSE
"""What frames of a star say of the telescope, against closed forms and the Mueller matrices."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import optics
from astropolcal.exceptions import ParameterError
from astropolcal.standards import telescope_information
from astropolcal.standards.visibility import _design

angles = st.lists(st.floats(-180, 180), min_size=2, max_size=12)


@settings(max_examples=60)
@given(angles, st.floats(0.1, 10))
def test_error_without_offset_is_the_closed_form(psi, frame_error):
    spread = 1 - np.abs(np.mean(np.exp(2j * np.deg2rad(psi)))) ** 2
    info = telescope_information(psi * u.deg, frame_error=frame_error)
    if spread > 1e-4:
        expected = frame_error / np.sqrt(len(psi) * spread)
        assert info.diattenuation == pytest.approx(expected, rel=1e-6)
        both = info.error("star_q") ** 2 + info.error("star_u") ** 2
        assert both == pytest.approx(expected**2 * (1 + spread), rel=1e-6)


@settings(max_examples=30)
@given(angles, st.floats(-90, 90))
def test_altitude_and_a_common_turn_change_nothing_without_offset(psi, turn):
    psi = np.array([*psi, psi[0] + 40]) * u.deg
    plain = telescope_information(psi).diattenuation
    altitude = np.linspace(20, 80, len(psi)) * u.deg
    assert telescope_information(psi, altitude).diattenuation == pytest.approx(plain, rel=1e-6)
    assert telescope_information(psi + turn * u.deg).diattenuation == pytest.approx(plain, rel=1e-6)


def test_derivatives_are_those_of_the_mueller_matrices():
    psi, altitude = np.deg2rad([-35.0, 10.0, 70.0]), np.deg2rad([40.0, 55.0, 62.0])
    step = 1e-6
    columns = []
    for q, stokes_u, d in np.eye(3) * step:
        chain = optics.Diattenuator(diattenuation=d)
        rows = []
        for p, a in zip(psi, altitude, strict=True):
            sky = _turn(p) @ np.array([1, q, stokes_u, 0])
            _, *out = chain(1.6 * u.um, *sky)
            light = _turn(-a) @ np.array([float(getattr(v, "value", v)) for v in out])
            rows.append(light[1:3] / light[0] / step)
        columns.append(np.ravel(rows))
    design = _design(psi, altitude, offset=False)
    np.testing.assert_allclose(np.array(columns).T, design, atol=1e-5)


def _turn(angle):
    """T(angle), as the chain of an alt-azimuth telescope turns light."""
    matrix = np.eye(4)
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    matrix[1:3, 1:3] = [[c, s], [-s, c]]
    return matrix


def test_scatter_of_least_squares_is_the_expected_error():
    rng = np.random.default_rng(4)
    psi, altitude = np.linspace(-60, 35, 16) * u.deg, np.linspace(35, 70, 16) * u.deg
    info = telescope_information(psi, altitude, frame_error=1e-3, offset=True)
    design = _design(psi.to_value(u.rad), altitude.to_value(u.rad), offset=True)
    truth = np.array([0.001, -0.002, 0.015, 0.003, 0.001])
    data = design @ truth + rng.normal(0, 1e-3, (4000, len(design)))
    fits = np.linalg.lstsq(design, data.T, rcond=None)[0]
    assert np.std(fits[2]) == pytest.approx(info.diattenuation, rel=0.04)
    np.testing.assert_allclose(np.cov(fits), info.covariance, atol=0.1 * info.covariance.max())


def test_offset_costs_accuracy_and_is_lost_without_a_change_of_altitude():
    psi = np.linspace(-60, 60, 10) * u.deg
    changing = telescope_information(psi, np.linspace(30, 75, 10) * u.deg, offset=True)
    assert changing.diattenuation > telescope_information(psi).diattenuation
    assert changing.names[-2:] == ("offset_q", "offset_u")
    fixed = telescope_information(psi, np.full(10, 50) * u.deg, offset=True)
    assert fixed.diattenuation == np.inf
    assert np.isfinite(fixed.error("star_q"))


def test_a_star_that_does_not_turn_says_nothing_unless_it_is_known():
    psi = np.full(8, 20.0) * u.deg
    assert telescope_information(psi).diattenuation == np.inf
    known = telescope_information(psi, frame_error=1e-3, star_error=1e-4).diattenuation
    assert known == pytest.approx(np.hypot(1e-3 / np.sqrt(8), 1e-4), rel=1e-6)


def test_a_prior_only_helps():
    psi = np.linspace(-20, 20, 8) * u.deg
    free = telescope_information(psi).diattenuation
    errors = [telescope_information(psi, star_error=e).diattenuation for e in (1e-6, 1, 1e6)]
    assert errors[0] == pytest.approx(1 / np.sqrt(8), rel=1e-6)
    assert errors[0] < errors[1] < errors[2]
    assert errors[2] == pytest.approx(free, rel=1e-6)


def test_error_falls_with_the_square_root_of_the_frames():
    psi = np.linspace(-40, 60, 20)
    once = telescope_information(psi * u.deg).diattenuation
    often = telescope_information(np.tile(psi, 9) * u.deg).diattenuation
    assert often == pytest.approx(once / 3, rel=1e-9)


def test_bad_angles_are_refused():
    for arguments, words in [
        (([1, 2],), "needs a unit"),
        (([] * u.deg,), "finite angles"),
        (([[1, 2]] * u.deg,), "one per frame"),
        (([1, np.nan] * u.deg,), "finite angles"),
        (([1, 2] * u.deg, [1] * u.deg), "2 parallactic angles and 1 altitudes"),
    ]:
        with pytest.raises(ParameterError, match=words):
            telescope_information(*arguments)


def test_bad_errors_are_refused():
    for key in ["frame_error", "star_error"]:
        for value in [0, -1, np.inf, np.nan, [1, 2]]:
            with pytest.raises(ParameterError, match=key):
                telescope_information([0, 40] * u.deg, **{key: value})


def test_offset_needs_the_altitude_and_names_are_checked():
    with pytest.raises(ParameterError, match="altitude of each frame"):
        telescope_information([0, 40] * u.deg, offset=True)
    with pytest.raises(ParameterError, match="parameter = 'm3'; allowed are"):
        telescope_information([0, 40] * u.deg).error("m3")
