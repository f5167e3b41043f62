# Licensed under a 3-clause BSD style license - see LICENSE
"""The covariance matrix with names and units."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.calibration import Covariance
from astropolcal.exceptions import ParameterError
from astropolcal.measurement import FreeParameters

NAMES, UNITS = ["hwp.theta", "hwp.w_sio2", "wollaston.efficiency"], [u.deg, u.mm, None]
MATRIX = np.array([[0.04, 0.001, np.nan], [0.001, 0.0001, np.nan], [np.nan, np.nan, np.nan]])


@pytest.fixture
def covariance():
    return Covariance(NAMES, UNITS, MATRIX)


def test_std_has_the_unit(covariance):
    assert u.isclose(covariance.std("hwp.theta"), 0.2 * u.deg)
    assert u.isclose(covariance.std("hwp.w_sio2"), 10 * u.um)


def test_what_is_not_determined_is_nan(covariance):
    assert np.isnan(covariance.std("wollaston.efficiency"))
    np.testing.assert_allclose(covariance.stds, [0.2, 0.01, np.nan])
    assert repr(covariance) == "<Covariance of 3 parameters, 2 of them determined>"
    assert len(covariance) == 3


def test_correlation(covariance):
    assert covariance.correlation[0, 1] == pytest.approx(0.001 / (0.2 * 0.01))
    np.testing.assert_allclose(np.diag(covariance.correlation)[:2], 1)
    assert np.isnan(covariance.correlation[2]).all()


def test_equality(covariance):
    assert covariance == Covariance(NAMES, UNITS, MATRIX)
    assert covariance != Covariance(NAMES, [u.deg, u.um, None], MATRIX)
    assert covariance != Covariance(NAMES, UNITS, 2 * MATRIX)
    assert covariance != MATRIX.tolist()


def test_matrix_is_a_copy(covariance):
    matrix = np.array([[1.0]])
    made = Covariance(["a.b"], [None], matrix)
    matrix[0, 0] = 2.0
    assert made.matrix[0, 0] == 1.0


def test_unknown_name_is_refused(covariance):
    with pytest.raises(ParameterError, match=r"no parameter 'hwp.phase'"):
        covariance.std("hwp.phase")


@pytest.mark.parametrize(
    ("names", "units", "shape"),
    [
        (NAMES, UNITS, (2, 2)),
        (NAMES, UNITS, (3, 2)),
        (NAMES[:2], UNITS, (3, 3)),
        (NAMES, UNITS[:2], (3, 3)),
    ],
)
def test_shapes_must_agree(names, units, shape):
    with pytest.raises(ParameterError, match="covariance of"):
        Covariance(names, units, np.ones(shape))


def test_asymmetric_matrix_is_refused():
    with pytest.raises(ParameterError, match="symmetric"):
        Covariance(["a.b", "a.c"], [None, None], [[1, 0.5], [0.1, 1]])


def test_canonical_matrix_is_converted():
    """A variance of 1 rad^2 or 1 um^2 in the units of the parameters."""
    chain = optics.TwoLayerWaveplate(name="plate", fixed={"theta": False, "w_mgf2": True})
    free = FreeParameters([chain | optics.WollastonPrism(name="wollaston")], 1)
    covariance = Covariance.from_canonical(free, np.ones((3, 3)))
    assert covariance.names == ["plate.theta", "plate.w_sio2", "wollaston.efficiency"]
    np.testing.assert_allclose(covariance.stds, [np.rad2deg(1), 1e-3, 1])
    assert covariance.matrix[0, 1] == pytest.approx(np.rad2deg(1) * 1e-3)
