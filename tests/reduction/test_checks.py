# Licensed under a 3-clause BSD style license - see LICENSE
"""Arguments of simulated images: what they become, and what is refused."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal.exceptions import ParameterError
from astropolcal.reduction.cubes import number, per_wavelength, pixels

# CHARIS: 16.15 milliarcsecond a pixel
LAYOUT = SimpleNamespace(pixel_scale=16.15)


def test_number_out_of_bounds_is_refused():
    for value, bounds, words in [
        (-0.1, {}, "x = -0.1; allowed is 0 and above, up to inf"),
        (0.0, {"above": 0.0}, "x = 0; allowed is above 0, up to inf"),
        (1.0, {"above": 1.0}, "x = 1; allowed is above 1, up to inf"),
        (1.5, {"most": 1.0}, "x = 1.5; allowed is 0 and above, up to 1"),
        (2.0, {"least": 3.0}, "x = 2; allowed is 3 and above"),
        (np.nan, {}, "x = nan"),
        (np.inf, {}, "x = inf"),
    ]:
        with pytest.raises(ParameterError, match=words):
            number("x", value, **bounds)


def test_number_within_its_bounds_is_a_float():
    for value, bounds in [(0, {}), (1, {"most": 1.0}), (1e-9, {"above": 0.0}), ("2.5", {})]:
        found = number("x", value, **bounds)
        assert type(found) is float, (value, bounds)
        assert found == float(value), (value, bounds)


def test_scalar_holds_at_all_wavelengths():
    assert per_wavelength("flux", 3, 4).tolist() == [3.0] * 4
    assert per_wavelength("flux", [1, 2, 3], 3).tolist() == [1.0, 2.0, 3.0]


def test_wrong_shapes_and_signs_are_refused():
    for value in [[1.0, 2.0], [[1.0]], -1.0, [1, 2, np.nan], [1, 2, -0.1]]:
        words = r"flux = .*; allowed are numbers not negative, of shape \(\) or \(3,\)"
        with pytest.raises(ParameterError, match=words):
            per_wavelength("flux", value, 3)


def test_angle_on_the_sky_is_a_length_on_the_detector():
    for value, expected in [
        (4.0, 4.0),
        (4.0 * u.pix, 4.0),
        (4.0 * u.one, 4.0),
        (64.6 * u.mas, 4.0),
        (0.0646 * u.arcsec, 4.0),
        ((64.6 * u.mas).to(u.rad), 4.0),
        ([16.15, 32.3] * u.mas, [1.0, 2.0]),
    ]:
        found = pixels("fwhm", value, LAYOUT, 2)
        np.testing.assert_allclose(found, np.broadcast_to(expected, 2), rtol=1e-12)


def test_lengths_that_are_none_are_refused():
    for value, words in [
        (0.4, "fwhm = 0.4 pixels; allowed are 0.5 and above"),
        (1 * u.mas, r"fwhm = 0\.06\d+ pixels"),
        (5 * u.s, "fwhm"),
        (-3.0, "not negative"),
    ]:
        with pytest.raises(ParameterError, match=words):
            pixels("fwhm", value, LAYOUT, 2)
