# Licensed under a 3-clause BSD style license - see LICENSE
"""
Pulls of a hundred simulated calibrations: right on average, and by as much as they say.

A pull is (fitted - true) / error. Over an ensemble of n it has mean 0 +- 1/sqrt(n)
and width 1 +- 1/sqrt(2 n).
"""

import numpy as np
import pytest

from astropolcal.measurement.parameters import FreeParameters

pytestmark = pytest.mark.slow
N = 100
CASES = {
    # kind of derotator, gauge angles fixed, number of parameters
    "linear, angles fixed": ("linear", True, 47),
    "linear, angles free": ("linear", False, 49),
    "elliptical, angles fixed": ("elliptical", True, 91),
    "elliptical, angles free": ("elliptical", False, 93),
}


@pytest.fixture(scope="module", params=CASES, ids=lambda name: name.replace(", ", "-"))
def ensemble(request, make, pulls):
    """Slots by name, and the pulls of all parameters, shape (N, n_free)."""
    kind, fixed, n_free = CASES[request.param]
    found = pulls(kind, fixed, N)
    assert found.shape == (N, n_free)
    truth = make.truth(make.chain(kind, fixed=fixed))
    return FreeParameters([truth], 22).by_name, found


def test_pulls_have_mean_zero_and_width_one(ensemble):
    slots, pulls = ensemble
    for name, slot in slots.items():
        group = pulls[:, slot.slice]
        assert np.isfinite(group).all() or not np.isfinite(group).any(), name
        if not np.isfinite(group).any():
            continue
        # 0.1 for the groups of 2200; a single parameter has 100 pulls only: 3.5 sigma
        limits = (0.1, 0.1) if slot.size > 1 else (3.5 / np.sqrt(N), 3.5 / np.sqrt(2 * N))
        assert group.mean() == pytest.approx(0.0, abs=limits[0]), name
        assert group.std() == pytest.approx(1.0, abs=limits[1]), name


def test_every_single_wavelength_is_right(ensemble):
    """No wavelength hides in the average: each within 4.5 sigma of mean and width."""
    _, pulls = ensemble
    known = pulls[:, np.isfinite(pulls).all(axis=0)]
    assert np.abs(known.mean(axis=0)).max() < 4.5 / np.sqrt(N)
    assert np.abs(known.std(axis=0) - 1).max() < 4.5 / np.sqrt(2 * N)


def test_identifiable_parameters_have_errors_and_the_others_none(ensemble):
    slots, pulls = ensemble
    undetermined = {name for name, s in slots.items() if np.isnan(pulls[:, s.slice]).any()}
    gauge = {
        "calibration_polarizer.theta", "hwp.theta", "derotator.theta",
        "derotator.horizontal", "derotator.diagonal", "derotator.circular",
    }  # fmt: skip
    assert undetermined in (set(), gauge)
    assert (undetermined == gauge) == (pulls.shape[1] == 93)
