# Licensed under a 3-clause BSD style license - see LICENSE
"""Brightness of frames from their own light, polarized as it is."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import optics
from astropolcal.correction import measurement_rows
from astropolcal.correction.solve import frame_brightness
from astropolcal.exceptions import ObservationError

HWP = np.array([0, 45, 22.5, 67.5, 0, 45, 22.5, 67.5])
LAM = [1.2, 1.6, 2.2] * u.um


@pytest.fixture(scope="module")
def rows():
    """Of a plate that is no half-wave plate behind a mirror that polarizes by 5 percent."""
    chain = (
        optics.Diattenuator(diattenuation=0.05, name="mirror", mount="altitude")
        | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    altitude = np.linspace(40, 70, len(HWP))
    return measurement_rows(chain, {"hwp": HWP * u.deg, "altitude": altitude * u.deg}, LAM)


def light(rows, stokes, clouds):
    """Return (2, n_frames, n_wavelengths) of Stokes parameters (4, n_wavelengths)."""
    return np.einsum("bwfs,sw,wf->bfw", rows, stokes, np.broadcast_to(clouds, rows.shape[1:3]))


@pytest.mark.slow
@given(
    q=st.floats(-0.4, 0.4),
    v=st.floats(-0.4, 0.4),
    clouds=st.lists(st.floats(0.3, 3), min_size=8, max_size=8),
)
def test_clouds_come_back(rows, q, v, clouds):
    """Up to their mean, which is the brightness of the source itself."""
    stokes = np.outer([1e4, 1e4 * q, 1e4 * v, 0.0], [1.0, 2.0, 0.1])
    clouds = np.array(clouds)
    found = frame_brightness(rows, light(rows, stokes, clouds))
    np.testing.assert_allclose(found, np.tile(clouds / clouds.mean(), (3, 1)), rtol=1e-9)


def test_each_wavelength_has_its_own(rows):
    clouds = np.linspace(0.5, 1.5, 24).reshape(3, 8)
    found = frame_brightness(rows, light(rows, np.outer([1, 0.2, 0, 0], np.ones(3)), clouds))
    np.testing.assert_allclose(found, clouds / clouds.mean(axis=1, keepdims=True), rtol=1e-9)


def test_the_sum_of_the_beams_alone_would_be_wrong(rows):
    """What the mirror makes of polarized light looks like clouds; it is not."""
    fluxes = light(rows, np.outer([1.0, 0.3, 0, 0], np.ones(3)), np.ones(8))
    total = fluxes.sum(axis=0).T
    assert np.ptp(total / total.mean(axis=1, keepdims=True)) > 0.01
    np.testing.assert_allclose(frame_brightness(rows, fluxes), 1.0, rtol=1e-9)


def test_double_differences_give_the_same(rows):
    clouds = np.array([0.8, 1, 1.2, 1, 0.9, 1.1, 0.7, 1.3])
    fluxes = light(rows, np.outer([1.0, 0.05, -0.1, 0], np.ones(3)), clouds)
    pairs = [(0, 1), (2, 3), (4, 5), (6, 7)]
    found = frame_brightness(rows, fluxes, observable="double", pairs=pairs)
    np.testing.assert_allclose(found, frame_brightness(rows, fluxes), rtol=1e-8)


def test_a_frame_without_light_is_named(rows):
    for value in [0.0, -3.0]:
        fluxes = light(rows, np.outer([1.0, 0, 0, 0], np.ones(3)), np.ones(8))
        fluxes[:, 5, 1] = value
        with pytest.raises(
            ObservationError,
            match=r"frame 5 has no light at wavelength 1: the sum of both beams is",
        ):
            frame_brightness(rows, fluxes)


def test_light_that_no_source_has_does_not_settle():
    """Negative fluxes of one beam: q is 2.5, of which the mirror would make less than no light."""
    chain = (
        optics.Diattenuator(diattenuation=0.8, name="mirror", mount="altitude")
        | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(name="wollaston")
    )
    positions = {"hwp": HWP * u.deg, "altitude": np.repeat([1e-6, 90.0], 4) * u.deg}
    rows = measurement_rows(chain, positions, LAM[:1])
    q = np.tile([2.5, -2.5, 0.0, 0.0], 2)[:, None]
    with pytest.raises(ObservationError, match="brightness of the frames does not settle"):
        frame_brightness(rows, np.stack([1 + q, 1 - q]))


def test_frames_that_are_almost_dark_determine_nothing(rows):
    """All with the plate at 22.5 and 67.5 deg: what is left has no Q."""
    clouds = np.where(np.isin(HWP, (0, 45)), 1e-6, 1.0)
    fluxes = light(rows, np.outer([1.0, 0, 0, 0], np.ones(3)), clouds)
    with pytest.raises(ObservationError, match="not determined at any wavelength by 8 frames"):
        frame_brightness(rows, fluxes)
