# Licensed under a 3-clause BSD style license - see LICENSE
"""The Wollaston prism and its two beams."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ParameterError
from astropolcal.optics import WollastonPrism

FRACTION = st.floats(0, 1)


@given(efficiency=FRACTION, q=st.floats(-1, 1), theta=st.floats(-90, 90))
def test_beams_share_the_light(efficiency, q, theta):
    prism = WollastonPrism(efficiency=efficiency, theta=theta * u.deg)
    right, left = prism.beams(1.6 * u.um, 1, q, 0, 0)
    assert right[1] + left[1] == pytest.approx(1, abs=1e-14)
    expected = efficiency * q * np.cos(2 * np.radians(theta))
    assert right[1] - left[1] == pytest.approx(expected, abs=1e-14)


def test_beam_of_the_paper():
    for beam, sign in [("right", 1), ("left", -1)]:
        eta = 0.9
        expected = 0.5 * np.array([[1, sign * eta, 0, 0], [sign * eta, 1, 0, 0], [0] * 4, [0] * 4])
        found = WollastonPrism(efficiency=eta, beam=beam).mueller()
        np.testing.assert_array_equal(found, expected)


def test_beams_leave_the_prism_as_and_where_it_is():
    prism = WollastonPrism(beam="left", efficiency=[0.9, 0.8], name="wollaston")
    right, left = prism.beams([1.2, 1.6] * u.um, 1, 1, 0, 0)
    np.testing.assert_allclose(right[1], [0.95, 0.9])
    np.testing.assert_allclose(left[1], [0.05, 0.1])
    assert prism.beam == "left"
    # beams stand where the prism stands
    prism = WollastonPrism(mount="rotator")
    prism.position = 90 * u.deg
    right, left = prism.beams(1.6 * u.um, 1, 1, 0, 0)
    assert (right[1], left[1]) == (pytest.approx(0, abs=1e-15), pytest.approx(1))


def test_unknown_beam_is_refused():
    for beam in ["up", None, 1]:
        with pytest.raises(ParameterError, match=r"allowed are right, left"):
            WollastonPrism(beam=beam)
        prism = WollastonPrism()
        with pytest.raises(ParameterError, match="beam"):
            prism.beam = beam
        assert prism.beam == "right", beam
