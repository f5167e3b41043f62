# Licensed under a 3-clause BSD style license - see LICENSE
"""
Pulls of simulated calibrations: right on average, and by as much as they say.

A pull is (fitted - true) / error. Over an ensemble of n it has mean 0 +- 1/sqrt(n)
and width 1 +- 1/sqrt(2 n), and 68 % of the errors reach the truth. Counted are all
parameters that the data determine, at all 22 wavelengths of CHARIS; where the gauge
is open, quantities that do not depend on it are tested with the same fits.
"""

import astropy.units as u
import numpy as np
import pytest
from scipy.stats import norm

from astropolcal.calibration.uncertainty import derived_data, derived_retardance
from astropolcal.measurement import Measurement
from astropolcal.measurement.parameters import FreeParameters

pytestmark = pytest.mark.long
ONE_SIGMA, TWO_SIGMA = (norm.cdf(k) - norm.cdf(-k) for k in (1, 2))
LAM = [1.25, 1.65, 2.15] * u.um
GAUGE = {
    "calibration_polarizer.theta", "hwp.theta", "derotator.theta",
    "derotator.horizontal", "derotator.diagonal", "derotator.circular",
}  # fmt: skip


def check_pulls(truth, pulls, undetermined=()):
    """Mean 0 and width 1 of every parameter, and no error of what is not determined."""
    n, slots = len(pulls), FreeParameters([truth], 22).by_name
    for name, slot in slots.items():
        group = pulls[:, slot.slice]
        assert np.isfinite(group).all() or np.isnan(group).all(), name
        assert np.isnan(group).all() == (name in undetermined), name
        if name in undetermined:
            continue
        # 0.1 for the groups of 880 and more; a single parameter has n pulls only: 3.5 sigma
        limits = (0.1, 0.1) if slot.size > 1 else (3.5 / np.sqrt(n), 3.5 / np.sqrt(2 * n))
        assert group.mean() == pytest.approx(0.0, abs=limits[0]), name
        assert group.std() == pytest.approx(1.0, abs=limits[1]), name
    # no wavelength hides in the average: each within 4.5 sigma of mean and width
    known = pulls[:, np.isfinite(pulls).all(axis=0)]
    assert np.abs(known.mean(axis=0)).max() < 4.5 / np.sqrt(n)
    assert np.abs(known.std(axis=0) - 1).max() < 4.5 / np.sqrt(2 * n)
    return known


def share_inside(values, sigmas=1.0):
    return np.mean(np.abs(values) < sigmas)


def test_linear_derotator(make, pulls):
    for fixed, n_free in ((True, 47), (False, 49)):
        found = pulls("linear", fixed, 25)
        assert found.shape == (25, n_free)
        check_pulls(make.truth(make.chain("linear", fixed=fixed)), found)


def test_elliptical_derotator_in_a_fixed_gauge(make, pulls):
    n = 60
    found = pulls("elliptical", True, n)
    assert found.shape == (n, 91)
    check_pulls(make.truth(make.chain("elliptical", fixed=True)), found)
    assert share_inside(found) == pytest.approx(ONE_SIGMA, abs=0.03)
    assert share_inside(found, 2.0) == pytest.approx(TWO_SIGMA, abs=0.015)
    # the share of 60 scatters by 6 %; the worst of 91 stays within 4.5 sigma of it
    shares = np.mean(np.abs(found) < 1, axis=0)
    assert np.abs(shares - ONE_SIGMA).max() < 4.5 * np.sqrt(ONE_SIGMA * (1 - ONE_SIGMA) / n)
    # errors that are wrong by a tenth would leave the 3 %
    assert abs(share_inside(1.1 * found) - ONE_SIGMA) > 0.03
    assert abs(share_inside(0.9 * found) - ONE_SIGMA) > 0.03


def test_elliptical_derotator_in_an_open_gauge(make):
    """69 of 93 are the gauge: three angles, and three retardances at 22 wavelengths."""
    truth = make.truth(make.chain("elliptical", fixed=False))
    law = truth["hwp"].retardance(LAM)
    clean = Measurement(truth, make.observe(truth, noise=False)).observed
    found, of_law, of_data = [], [], []
    for _, cal in make.fits("elliptical", False, range(30)):
        found.append(make.pulls_of(truth, cal))
        made = derived_retardance(cal, "hwp", LAM)
        of_law.append(((made.value - law) / made.std).value)
        made = derived_data(cal)
        of_data.append((made.value - clean) / made.std)
    found = np.array(found)
    assert found.shape == (30, 93)
    known = check_pulls(truth, found, GAUGE)
    assert known.shape[1] == 93 - (3 + 3 * 22)
    assert share_inside(known) == pytest.approx(ONE_SIGMA, abs=0.04)
    # a law and predicted data have finite errors although the parameters have none;
    # three retardances of one law are not independent: between 17 and 50 numbers
    assert share_inside(np.array(of_law)) == pytest.approx(ONE_SIGMA, abs=0.12)
    assert share_inside(np.array(of_data)) == pytest.approx(ONE_SIGMA, abs=0.03)
