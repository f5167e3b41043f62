# Licensed under a 3-clause BSD style license - see LICENSE
"""Accuracies by hand, and a cross-validation that is honest."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.calibration import calibrate
from astropolcal.calibration.noise.scatter import leave_out_groups
from astropolcal.calibration.noise.weighting import Problem, assumed
from astropolcal.calibration.validation.cross_validation import (
    accuracy_table,
    cross_validated_residuals,
)
from astropolcal.chain import insert_optic
from astropolcal.exceptions import FitError
from astropolcal.measurement import Measurement, Normal
from astropolcal.observations import Observations

LAM = [1.2, 1.6, 2.2] * u.um


# --- formulae ---------------------------------------------------------------------------


def test_accuracies_by_hand(measurement):
    """Paper, Sec. 2.3: s_res = sqrt(sum r^2 / (n - k)), s_mean = s_res / sqrt(n)."""
    residuals = np.zeros(measurement.n_data)
    residuals[measurement.bins == 1] = 0.01 * np.resize([1, -1], 32)
    table = accuracy_table(measurement, 0, residuals)
    # k: polarizer angle, two thicknesses, retardance and efficiency of the bin
    assert table["k"].tolist() == [5, 5, 5]
    assert table["n"].tolist() == [32, 32, 32]
    s_res = 100 * np.sqrt(32 * 0.01**2 / (32 - 5))
    np.testing.assert_allclose(table["s_res"].to_value(u.percent), [0, s_res, 0])
    np.testing.assert_allclose(table["s_mean"].to_value(u.percent), [0, s_res / np.sqrt(32), 0])
    for column in ("s_cv", "s_standard"):
        assert np.isnan(table[column]).all()
        assert table[column].unit == u.percent
    assert u.allclose(table["wavelength"], LAM)


def test_held_out_residuals_give_their_rms(measurement):
    held_out = np.full(measurement.n_data, np.nan)
    held_out[measurement.bins == 0] = np.resize([0.03, -0.04], 32)
    held_out[np.flatnonzero(measurement.bins == 1)[:2]] = [0.03, -0.04]
    table = accuracy_table(measurement, 0, measurement.residuals(), held_out)
    rms = 100 * np.sqrt((0.03**2 + 0.04**2) / 2)
    np.testing.assert_allclose(table["s_cv"].to_value(u.percent), [rms, rms, np.nan])


def test_too_few_data_give_no_accuracy(make, chain):
    data = make.observe(chain, make.frames([45] * u.deg), LAM, seed=1)
    table = accuracy_table(Measurement(chain, data), 0, np.ones(12))
    assert table["n"].tolist() == [4, 4, 4]
    assert np.isnan(table["s_res"]).all()
    assert np.isnan(table["s_mean"]).all()


def test_masked_data_do_not_count(make, chain, measurement):
    data = measurement.datasets[0].observations
    mask = np.zeros((data.n_frames, 3), dtype=bool)
    mask[0, 2] = True
    table = accuracy_table(Measurement(chain, data.with_mask(mask, "test")), 0, np.ones(95))
    assert table["n"].tolist() == [32, 32, 31]


def test_each_dataset_has_its_own_accuracy(chain, measurement):
    data = measurement.datasets[0].observations
    both = Measurement([chain, chain], [data, data])
    residuals = np.concatenate([np.zeros(96), np.full(96, 0.01)])
    first, second = (accuracy_table(both, i, residuals) for i in (0, 1))
    assert (first["s_res"] == 0).all()
    assert (second["s_res"] > 0).all()


def test_accuracy_of_pure_photon_noise_is_its_error(make, chain):
    data = make.observe(chain, wavelength=LAM, seed=5)
    cal = calibrate(chain, data, cross_validate=False)
    sigma = [
        np.sqrt(np.mean(cal.measurement.sigma[cal.measurement.bins == i] ** 2)) for i in range(3)
    ]
    ratio = cal.accuracy["s_res"].to_value(u.one) / sigma
    # relative error of a standard deviation from 27 degrees of freedom: 14 %
    np.testing.assert_allclose(ratio, 1, atol=0.5)


# --- groups -------------------------------------------------------------------------------


def test_groups_are_derotator_angles(measurement):
    groups = leave_out_groups(measurement)
    assert sorted(set(groups)) == list(range(8))
    assert (np.bincount(groups) == 4 * 3).all()
    part = measurement.datasets[0]
    angle = part.observations.position("derotator")[part.frames[:, 0]][part.group_of_datum]
    for group in range(8):
        assert np.ptp(angle[groups == group]) == 0


def test_nearly_equal_angles_are_one_group(make, chain):
    angles = np.repeat([45, 80, 110], 4) + np.resize([0, 0.01, -0.02, 0.03], 12)
    frames = make.frames([45, 80, 110] * u.deg)
    frames["derotator"] = np.repeat(angles, 2) * u.deg
    data = make.observe(chain, frames, LAM, seed=1)
    assert sorted(set(leave_out_groups(Measurement(chain, data)))) == [0, 1, 2]


def test_datasets_have_their_own_groups(chain, measurement):
    data = measurement.datasets[0].observations
    both = Measurement([chain, chain], [data, data])
    groups = leave_out_groups(both)
    assert set(groups[both.segments[0]]).isdisjoint(groups[both.segments[1]])
    assert sorted(set(groups)) == list(range(16))


# --- cross-validation ---------------------------------------------------------------------


def _spoil(data, angle, amount=0.2):
    """The same observations with other fluxes at one derotator angle."""
    table = data.to_table()
    rows = np.abs(table["derotator"].to_value(u.deg) - angle) < 0.1
    table["flux_right"][rows] *= 1 + amount * np.random.default_rng(3).uniform(-1, 1, rows.sum())
    return Observations.from_table(table)


def test_prediction_does_not_depend_on_what_was_left_out(chain, measurement):
    """The law of an honest cross-validation: a datum has no say in its own prediction."""
    data = measurement.datasets[0].observations
    angle = 70.0
    spoiled = Measurement(chain, _spoil(data, angle))
    predictions = [m.observed - cross_validated_residuals(m) for m in (measurement, spoiled)]
    part = measurement.datasets[0]
    at = np.rad2deg(part.observations.position("derotator"))[part.frames[:, 0]][part.group_of_datum]
    out = np.abs(at - angle) < 0.1
    assert out.sum() == 12
    assert np.abs(spoiled.observed - measurement.observed)[out].max() > 0.01
    np.testing.assert_allclose(predictions[1][out], predictions[0][out], rtol=0, atol=1e-7)
    # and the others do see the change
    assert np.abs(predictions[1] - predictions[0])[~out].max() > 1e-4


def test_held_out_residuals_are_larger_than_fitted_ones(measurement, chain):
    data = measurement.datasets[0].observations
    cal = calibrate(chain, data)
    assert np.mean(cal.accuracy["s_cv"]) > np.sqrt(np.mean(cal.residuals**2)) * 100 * u.percent
    assert (cal.accuracy["s_cv"] < 2 * cal.accuracy["s_res"]).all()


def test_the_fit_itself_is_left_alone(measurement):
    before = measurement.vector()
    cross_validated_residuals(measurement)
    np.testing.assert_array_equal(measurement.vector(), before)


def test_fewer_than_three_groups_give_nan(make, chain):
    data = make.observe(chain, make.frames([45, 80] * u.deg), LAM, seed=1)
    held_out = cross_validated_residuals(Measurement(chain, data))
    assert np.isnan(held_out).all()
    cal = calibrate(chain, data)
    assert np.isnan(cal.accuracy["s_cv"]).all()


def test_groups_may_be_given(measurement):
    groups = np.arange(measurement.n_data) % 3
    held_out = cross_validated_residuals(measurement, groups=groups)
    assert np.isfinite(held_out).all()
    assert np.abs(held_out).max() < 0.01


def test_impossible_groups_are_refused(measurement):
    for groups, message in [
        (np.zeros(95), r"groups of shape \(95,\); allowed is \(96,\), one per datum"),
        (np.arange(96).clip(0, 50), "group 0 has a single member; at least 2 data"),
    ]:
        with pytest.raises(FitError, match=message):
            cross_validated_residuals(measurement, groups=groups)


@pytest.fixture(scope="module")
def two_sources(make, chain):
    """The lamp at eight derotator angles, and through a retarding window at one."""
    window = optics.LinearRetarder(
        retardance=[10, 12, 14] * u.deg,
        theta=20 * u.deg,
        name="window",
    )
    through = insert_optic(chain, window, before="hwp")
    chains = [chain, through]
    data = [
        make.observe(chain, None, LAM, seed=1),
        make.observe(through, make.frames([70] * u.deg), LAM, seed=2),
    ]
    return Measurement(chains, data)


def test_what_only_the_left_out_data_determine_is_not_predicted(two_sources):
    """A fit without them keeps the value that they gave: that would be no prediction."""
    m = two_sources
    held_out = cross_validated_residuals(m)
    lamp, window = m.segments
    assert np.isfinite(held_out[lamp]).all()
    assert np.isnan(held_out[window]).all()


def test_groups_that_nothing_else_determines_are_refused(two_sources):
    groups = np.zeros(two_sources.n_data)
    groups[two_sources.segments[1]] = 1
    message = r"without group 1.0 \(12 data\) the others do not determine window.retardance"
    with pytest.raises(FitError, match=message):
        cross_validated_residuals(two_sources, groups=groups)


def test_a_prior_determines_too(make, two_sources):
    chains = [c.copy() for c in two_sources.chains]
    chains[1]["window"].retardance.prior = Normal(12 * u.deg, 5 * u.deg)
    data = [part.observations for part in two_sources.datasets]
    m = Measurement(chains, data)
    held_out = cross_validated_residuals(m)
    assert np.isfinite(held_out).all()
    # predicted with 12 deg at all wavelengths, where the truth is 10, 12 and 14
    window = m.segments[1]
    rms = [np.sqrt(np.mean(held_out[window][m.bins[window] == i] ** 2)) for i in range(3)]
    assert rms[0] > 5 * rms[1]
    assert rms[2] > 5 * rms[1]


def test_directions_that_no_datum_sees_do_not_spoil_predictions(make):
    """With free gauge angles nothing determines them, and predictions do not depend on them."""
    free = make.chain("elliptical", wavelength=LAM, fixed=False)
    truth = make.truth(free)
    m = Measurement(truth, make.observe(truth, make.frames([45, 60, 80, 100] * u.deg), LAM, seed=1))
    held_out = cross_validated_residuals(m)
    assert np.isfinite(held_out).all()
    assert np.abs(held_out).max() < 0.02


def test_fits_without_a_group_start_near_to_where_they_end(measurement, monkeypatch):
    """Two evaluations are enough, and the predictions are those of fits from anywhere."""
    evaluations, fit = [], Problem.fit

    def counted(self, *arguments):
        found = fit(self, *arguments)
        evaluations.append(found[2].nfev)
        return found

    monkeypatch.setattr(Problem, "fit", counted)
    held_out, groups = cross_validated_residuals(measurement), leave_out_groups(measurement)
    assert np.mean(evaluations) < 2.5
    problem = Problem(measurement, assumed(measurement, None))
    for group in np.unique(groups):
        vector, *_ = fit(problem, problem.solution, 1.0 * (groups != group))
        expected = measurement.residuals(vector)[groups == group]
        np.testing.assert_allclose(held_out[groups == group], expected, atol=1e-7)


def test_weights_are_used(make, chain, measurement):
    """Weights of zero on a spoiled angle: the prediction of the others is the clean one."""
    data = measurement.datasets[0].observations
    spoiled = Measurement(chain, _spoil(data, 70.0))
    groups = leave_out_groups(measurement)
    bad = np.abs(spoiled.observed - measurement.observed) > 0
    weights = np.where(bad, 0.0, 1.0)
    given = [cross_validated_residuals(m, weights, groups)[~bad] for m in (measurement, spoiled)]
    np.testing.assert_allclose(given[0], given[1], rtol=0, atol=1e-7)


def test_weighted_calibration_is_cross_validated_with_its_weights(chain, measurement):
    table = measurement.datasets[0].observations.to_table()
    noisy = np.abs(table["derotator"].to_value(u.deg) - 70.0) < 0.1
    for beam in ("right", "left"):
        table[f"flux_{beam}_err"][noisy] *= 100
    cal = calibrate(chain, _spoil(Observations.from_table(table), 70.0), weights="errors")
    weights = 1 / cal.measurement.sigma
    residuals = cal.measurement.residuals()
    expected, other = (
        accuracy_table(
            cal.measurement, 0, residuals, cross_validated_residuals(cal.measurement, w)
        )["s_cv"].value
        for w in (weights, None)
    )
    np.testing.assert_allclose(cal.accuracy["s_cv"].value, expected, rtol=1e-6)
    assert np.abs(other / expected - 1).max() > 0.01


def test_calibration_can_be_cross_validated_afterwards(measurement, chain):
    data = measurement.datasets[0].observations
    later = calibrate(chain, data, cross_validate=False)
    assert np.isnan(later.accuracy["s_cv"]).all()
    at_once = calibrate(chain, data)
    np.testing.assert_allclose(
        later.cross_validate().accuracy["s_cv"].value, at_once.accuracy["s_cv"].value, rtol=1e-6
    )
