# Licensed under a 3-clause BSD style license - see LICENSE
"""
Real measurements of SCExAO/CHARIS, against what its authors published.

Published are the values of McIntosh et al. (2026) as their software stores
them: s_rel per wavelength with misalignments fixed at 0, n = 32, k = 5.
"""

import json
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table

from astropolcal import instruments
from astropolcal.calibration import calibrate
from astropolcal.chain import replace_optic
from astropolcal.exceptions import AstropolcalWarning
from astropolcal.observations import Observations

CHARIS = instruments.get("charis")


@pytest.fixture(scope="module")
def published(shared_data):
    return Table.read(shared_data / "reference" / "charis_published_fits.ecsv")


@pytest.fixture(scope="module")
def calibrated(charis_fit):
    """Joint fits of Datasets 1 and 3 with all 93 parameters."""
    return {number: charis_fit(number) for number in (1, 3)}


@pytest.fixture(scope="module")
def two_step(charis_data):
    data = charis_data("dataset3_")
    return calibrate(CHARIS.chains_for([data]), data, strategy="two-step", cross_validate=False)


def s_mean(cal, k=None):
    """s_mean in percent of the first dataset, on request with another number of parameters."""
    table = cal.accuracy
    values = table["s_mean"].to_value(u.percent)
    return values if k is None else values * np.sqrt((table["n"] - table["k"]) / (table["n"] - k))


# --- accuracy ---------------------------------------------------------------------------


@pytest.mark.slow
def test_median_accuracy(calibrated):
    """Measured: 0.058 and 0.052 %; the medians published are 0.110 and 0.081 %."""
    for number, limit in [(1, 0.062), (3, 0.055)]:
        cal = calibrated[number]
        assert cal.converged, (number, limit)
        assert np.median(s_mean(cal)) <= limit, (number, limit)


@pytest.mark.slow
def test_more_accurate_than_published_at_nearly_all_wavelengths(calibrated, published):
    """
    Better in 20 and 21 of 22 bins, although misalignments and thicknesses count as parameters.

    Bin 4 (1329 nm) of Dataset 3 is worse because the published fit gives the
    half-wave plate a retardance of its own there, 5 and 9 deg above those of
    its neighbours, which no pair of thicknesses follows. Bins 5 and 19 of Dataset 1 are worse
    by our larger number of parameters alone; see the next test.
    """
    for number, worse in [(1, {5, 19}), (3, {4})]:
        theirs = np.asarray(published[f"s_rel_elliptical_dataset{number}"])
        found = set(np.flatnonzero(s_mean(calibrated[number]) >= theirs).tolist())
        assert len(found) <= 4, number
        assert found <= worse, number


@pytest.mark.slow
def test_residuals_are_smaller_than_published(calibrated, published):
    """With k = 5 as they count, that is compared by the sum of squares: 22 and 21 of 22."""
    for number, worse in [(1, set()), (3, {4})]:
        theirs = np.asarray(published[f"s_rel_elliptical_dataset{number}"])
        found = set(np.flatnonzero(s_mean(calibrated[number], k=5) >= theirs).tolist())
        assert found <= worse, number


@pytest.mark.slow
def test_two_steps_are_as_good_in_the_median(two_step):
    assert np.median(s_mean(two_step)) <= 0.055


@pytest.mark.slow
def test_linear_derotator_needs_its_misalignments(charis_data, published):
    """
    A linear derotator with free angles is eight times better than the one published.

    Theirs has misalignments fixed at 0; free ones take up most of the
    elliptical retardance (a gauge freedom). Measured: 0.109 and 0.095 %.
    """
    for number, published_median in [(1, 1.165), (3, 0.824)]:
        theirs = np.asarray(published[f"s_rel_linear_dataset{number}"])
        assert np.median(theirs) == pytest.approx(published_median, abs=0.001), (
            number,
            published_median,
        )
        data = charis_data(f"dataset{number}_")
        cal = calibrate(CHARIS.chains_for([data], derotator="linear"), data, cross_validate=False)
        assert np.median(s_mean(cal)) < published_median / 8, (number, published_median)


@pytest.mark.slow
def test_frames_left_out_are_predicted(calibrated):
    """s_cv is the rms of single double differences: compare it with s_res, not s_mean."""
    for cal in calibrated.values():
        ratio = cal.accuracy["s_cv"] / cal.accuracy["s_res"]
        assert (ratio > 0.9).all()
        assert np.median(ratio) < 1.5


# --- what is determined -------------------------------------------------------------------


@pytest.mark.slow
def test_rank_is_91_of_93(calibrated):
    for number in [1, 3]:
        finding = calibrated[number].identifiability
        assert (finding.rank, finding.n_free) == (91, 93), number
        assert len(finding.directions) == 2, number


@pytest.mark.slow
def test_gauge_parameters_have_no_error(calibrated):
    for name in ["hwp.theta", "derotator.theta", "derotator.circular[9]"]:
        assert np.isnan(calibrated[3].covariance.std(name)), name


def test_fixed_angles_give_full_rank(charis_data):
    data = charis_data("dataset3_")
    (chain,) = CHARIS.chains_for([data])
    for name in ("hwp", "derotator"):
        chain[name].theta.fixed = True
    cal = calibrate(chain, data, cross_validate=False)
    assert cal.identifiability.rank == cal.identifiability.n_free == 91
    undetermined = np.isnan(cal.covariance.stds)
    assert {n for n, bad in zip(cal.covariance.names, undetermined, strict=True) if bad} == set(
        cal.at_bound
    )
    assert np.median(s_mean(cal)) <= 0.06


@pytest.mark.slow
def test_efficiency_at_its_bound_is_flagged(calibrated):
    """The published efficiency of bin 0 is 0.9999999999 as well."""
    assert "wollaston.efficiency[0]" in calibrated[3].at_bound


# --- parameters ---------------------------------------------------------------------------


@pytest.mark.slow
def test_thicknesses_are_near_the_published(calibrated):
    """1.653 and 1.291 mm in the paper; the errors here are 2 um."""
    hwp = calibrated[3].chain["hwp"]
    assert hwp.w_sio2.quantity.to_value(u.mm) == pytest.approx(1.653, abs=0.006)
    assert hwp.w_mgf2.quantity.to_value(u.mm) == pytest.approx(1.291, abs=0.005)


def _branch(value, reference):
    """The mirror branch of a retardance (deg) that is nearest to a reference."""
    value, reference = np.abs(value), np.abs(reference)
    return np.where(np.abs(360 - value - reference) < np.abs(value - reference), 360 - value, value)


@pytest.mark.slow
def test_horizontal_retardance_in_h_and_k(calibrated, published):
    """Within 2 deg, up to mirror branches; measured: 0.4 deg."""
    theirs = np.asarray(published["derotator_horizontal"])
    ours = _branch(calibrated[3].chain["derotator"].horizontal.value, theirs)
    band = np.asarray(published["wavelength"]) > 1450
    assert np.abs(ours - theirs)[band].max() < 2.0


@pytest.mark.slow
def test_first_step_reproduces_the_published_retardances(two_step, published):
    """
    Where no published value sits at a bound (their circular retardance does, in J).

    The published values are not the least-squares minimum: ours has the
    smaller residuals, at distances of up to the tolerances (deg).
    """
    for name, column, tolerance, in_h_and_k in [
        ("hwp.retardance", "hwp_retardance", 1.5, 1.2),
        ("derotator.horizontal", "derotator_horizontal", 0.3, 0.1),
        ("derotator.diagonal", "derotator_45", 1.5, 0.7),
        ("derotator.circular", "derotator_circular", 1.7, 0.5),
    ]:
        at_bound = np.asarray(published["derotator_circular"]) < 0.1
        theirs = np.asarray(published[column])
        ours = np.abs(two_step.stages[0]["parameters"][name].to_value(u.deg))
        difference = np.abs(_branch(ours, theirs) - theirs)
        assert difference[~at_bound].max() < tolerance, (name, column, tolerance, in_h_and_k)
        band = np.asarray(published["wavelength"]) > 1450
        assert difference[band].max() < in_h_and_k, (name, column, tolerance, in_h_and_k)


@pytest.mark.slow
def test_published_values_are_not_the_minimum(two_step, published):
    """The first step alone, same parameters, same data: smaller residuals over all bins."""
    theirs = np.asarray(published["s_rel_elliptical_dataset3"]) / 100
    rms = np.sqrt(np.mean(theirs**2 * 32 * (32 - 5) / 32))
    assert two_step.stages[0]["residual_rms"] < 0.8 * rms


# --- unpolarized source ---------------------------------------------------------------------


@pytest.mark.slow
def test_fold_mirror_of_dataset_4(charis_data, calibrated, shared_data):
    """
    Diattenuation with all else from Dataset 3, and derotator 45 deg left out as they did.

    Within 12 % of the published means (a gain in the slope of up to 10 % in K,
    where their s_unpol is five times ours); the spread of their own four
    values in a bin is 3 to 8 %.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        data = charis_data("dataset4_")
    derotator = np.rad2deg(data.position("derotator"))
    data = data.with_mask(np.abs(derotator - 45) < 1, "lamp warms up")
    (chain,) = CHARIS.chains_for([data])
    for name in ("hwp", "derotator", "wollaston"):
        known = calibrated[3].chain[name]
        for key in known.param_names:
            value = getattr(known, key)
            setattr(chain[name], key, value.value if value.unit is None else value.quantity)
            getattr(chain[name], key).fixed = True
    cal = calibrate(chain, data, cross_validate=False)
    table = Table.read(shared_data / "reference" / "charis_fold_mirror.ecsv")
    columns = ("fold_mirror_diattenuation", "s_unpol")
    theirs, s_unpol = (
        np.bincount(table["bin"], np.asarray(table[c])) / np.bincount(table["bin"]) for c in columns
    )
    ours = cal.chain["fold_mirror"].diattenuation.value
    np.testing.assert_allclose(ours, theirs, rtol=0.12)
    assert np.median(np.abs(ours / theirs - 1)) < 0.05
    assert np.median(s_mean(cal)) < np.median(s_unpol)


@pytest.mark.slow
def test_fold_mirror_at_one_derotator_angle_at_a_time(charis_data, shared_data):
    """In K six angles agree; the mean of the published values is that of 57.5 deg alone."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        data = charis_data("dataset4_")
    (chain,) = CHARIS.chains_for([data])
    published = CHARIS.published()
    for name in ("hwp", "derotator", "wollaston"):
        chain = replace_optic(chain, name, published[name].copy())
        for key in chain[name].param_names:
            getattr(chain[name], key).fixed = True
    derotator = np.rad2deg(data.position("derotator"))
    found = {}
    for angle in (57.5, 70, 82.5, 95, 107.5, 120, 132.5):
        one = data.select(np.abs(derotator - angle) < 1)
        found[angle] = calibrate(chain, one, cross_validate=False)
    ends = {a: c.chain["fold_mirror"].diattenuation.value[-2:].mean() for a, c in found.items()}
    table = Table.read(shared_data / "reference" / "charis_fold_mirror.ecsv")
    theirs = np.mean(table["fold_mirror_diattenuation"][table["bin"] >= 20])
    first = ends.pop(57.5)
    assert np.ptp(list(ends.values())) < 6e-4
    assert abs(first - theirs) < 2e-4
    assert min(ends.values()) > theirs + 2e-4


# --- an independent simulator ---------------------------------------------------------------


def _cases(folder):
    key = json.loads((folder / "key.json").read_text(encoding="utf-8"))
    return {name: case["base"] for name, case in key.items() if case["effect"] == "none"}


@pytest.mark.slow
def test_simulated_calibrations_without_effect_give_back_the_truth(shared_data):
    """The nominal model on data of a simulator that shares no code with this package."""
    for index in range(3):
        folder = shared_data / "gap-cases"
        name, truth = list(_cases(folder).items())[index]
        data = Observations.read(folder / name / "polarized.ecsv")
        chain = CHARIS.chains_for([data], derotator="linear")
        # the ratio method is free of the lamp's drift and flicker
        cal = calibrate(chain, data, weights="errors", observable="ratio", cross_validate=False)
        assert cal.identifiability.rank == 49
        expected = {
            "hwp.w_sio2": truth["w_sio2"],
            "hwp.w_mgf2": truth["w_mgf2"],
            "hwp.theta": np.rad2deg(truth["d_hwp"]),
            "calibration_polarizer.theta": 90 + np.rad2deg(truth["d_cal"]),
            "derotator.theta": np.rad2deg(truth["d_der"]),
            "derotator.retardance": np.rad2deg(truth["ret_h"]),
            "wollaston.efficiency": truth["eta"],
        }
        known = cal.parameter_values()
        for parameter, true in expected.items():
            value, std = known[parameter]["value"], known[parameter]["std"]
            if parameter == "derotator.retardance":
                value = np.abs(value)  # both signs are exact mirrors, see the instrument
            assert np.abs((value - true) / std).max() < 4, parameter
        chi2 = np.sum((cal.residuals / cal.measurement.sigma) ** 2)
        freedom = cal.measurement.n_data - 49
        assert abs(chi2 - freedom) < 4 * np.sqrt(2 * freedom)
