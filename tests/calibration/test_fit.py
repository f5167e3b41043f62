# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrations of simulated data: they arrive, say how well, and object to nonsense."""

import json

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter
from astropy.modeling.fitting import (
    DogBoxLSQFitter,
    LevMarLSQFitter,
    LMLSQFitter,
    NonFiniteValueError,
    TRFLSQFitter,
)

from astropolcal import instruments, optics
from astropolcal.calibration import Calibration, calibrate, calibrate_runs
from astropolcal.calibration.fit.branches import search_branches
from astropolcal.calibration.result.summary import to_dict
from astropolcal.chain import insert_optic, leaves
from astropolcal.exceptions import (
    AstropolcalWarning,
    CalibrationFileError,
    FitError,
    ObservationError,
)
from astropolcal.measurement import Measurement, Tie
from astropolcal.observations import OBSERVABLES
from astropolcal.observations.observables import NormalizedSingleDifference
from astropolcal.simulation import half_wave_plate_cycles, simulate

FEW = [1.2, 1.6, 2.0, 2.2] * u.um


def true_vector(cal, truth):
    """Truth in the order of the fitted vector, canonical units."""
    return cal.measurement.free.__class__([truth], len(cal.wavelength)).start()


@pytest.fixture(scope="module")
def few(make):
    """Four wavelengths: chain to start from, truth, and noisy data."""
    chain = make.chain(wavelength=FEW)
    truth = make.truth(chain)
    meta = {"source": "polarized", "instrument": "charis"}
    return chain, truth, make.observe(truth, wavelength=FEW, seed=11, meta=meta, name="few")


@pytest.fixture(scope="module")
def calibrated(few):
    chain, _, data = few
    return calibrate(chain, data, weights="errors", instrument="charis")


# --- it arrives at the truth ------------------------------------------------------------------


@pytest.mark.slow
def test_noiseless_data_give_back_the_truth(make):
    for observable in sorted(n for n, one in OBSERVABLES.items() if one.frames_per_datum < 4):
        for kind in ["linear", "elliptical"]:
            chain = make.chain(kind, wavelength=FEW)
            truth = make.truth(chain)
            data = make.observe(truth, wavelength=FEW, noise=False)
            cal = calibrate(chain, data, observable=observable, cross_validate=False)
            assert cal.settings["observable"] == observable, kind
            np.testing.assert_allclose(cal.residuals, 0, atol=1e-7)
            np.testing.assert_allclose(
                cal.measurement.vector(), true_vector(cal, truth), rtol=1e-5, atol=1e-5
            )


def test_noisy_data_give_the_truth_within_errors(few):
    for strategy in ["joint", "two-step"]:
        chain, truth, data = few
        cal = calibrate(chain, data, weights="errors", strategy=strategy, cross_validate=False)
        assert cal.converged, strategy
        stds = cal.covariance.stds * cal.measurement.free.factors()
        pulls = (cal.measurement.vector() - true_vector(cal, truth)) / stds
        # the two-step procedure is not the least-squares minimum, but within its neighbourhood
        assert np.abs(pulls).max() < {"joint": 4, "two-step": 6}[strategy], strategy
        chi2 = np.sum((cal.residuals / cal.measurement.sigma) ** 2) / (
            cal.measurement.n_data - len(pulls)
        )
        assert chi2 == pytest.approx(1.0, abs={"joint": 0.5, "two-step": 1.0}[strategy]), strategy


def test_unknown_errors_are_scaled_to_the_residuals(few):
    """Without weights the covariance is (J J^T)^-1 times sum r^2 / (n - rank)."""
    chain, _, data = few
    cal = calibrate(chain, data, errors="white", cross_validate=False)
    slopes = cal.measurement.jacobian(cal.measurement.vector())
    variance = np.sum(cal.residuals**2) / (cal.measurement.n_data - 11)
    stds = np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T)) * variance)
    expected = stds / cal.measurement.free.factors()
    np.testing.assert_allclose(cal.covariance.stds, expected, rtol=1e-5)


def test_known_errors_are_taken_as_they_are(few):
    """Twice the errors of the table, twice those of the parameters, the same values."""
    from astropolcal.observations import Observations

    chain, _, data = few
    table = data.to_table()
    for beam in ("right", "left"):
        table[f"flux_{beam}_err"] *= 2
    pair = (data, Observations.from_table(table))
    options = {"weights": "errors", "errors": "white", "cross_validate": False}
    one, two = (calibrate(chain, d, **options) for d in pair)
    np.testing.assert_allclose(two.covariance.stds, 2 * one.covariance.stds, rtol=1e-3)


def test_any_fitter_reaches_the_same_minimum(few, calibrated):
    for fitter in [TRFLSQFitter, LevMarLSQFitter, DogBoxLSQFitter]:
        chain, _, data = few
        cal = calibrate(chain, data, weights="errors", fitter=fitter(), cross_validate=False)
        assert cal.settings["fitter"] == fitter.__name__
        stds = cal.covariance.stds * cal.measurement.free.factors()
        shift = (cal.measurement.vector() - calibrated.measurement.vector()) / stds
        assert np.abs(shift).max() < 0.02


def test_chain_given_is_not_changed(few):
    chain, _, data = few
    before = [np.copy(v) for leaf in leaves(chain) for v in leaf.canonical_values()]
    calibrate(chain, data, cross_validate=False)
    after = [v for leaf in leaves(chain) for v in leaf.canonical_values()]
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(old, new)


def test_result_has_units_bounds_and_fixed_flags(few, calibrated):
    chain, _, _ = few
    assert calibrated.chain["hwp"].w_sio2.unit == u.mm
    assert calibrated.chain["hwp"].theta.fixed
    for old, new in zip(leaves(chain), leaves(calibrated.chain), strict=True):
        for key in old.param_names:
            assert getattr(old, key).bounds == getattr(new, key).bounds


def test_observable_may_be_an_object(few):
    chain, _, data = few
    cal = calibrate(chain, data, observable=NormalizedSingleDifference(), cross_validate=False)
    assert cal.fit["n_data"] == data.n_frames * len(FEW)


def test_masked_cells_are_left_out(few):
    chain, truth, data = few
    mask = np.zeros((data.n_frames, len(FEW)), dtype=bool)
    mask[3, 1] = mask[10] = True
    cal = calibrate(chain, data.with_mask(mask, "test"), weights="errors", cross_validate=False)
    assert cal.datasets[0].n_masked == 1 + len(FEW)
    assert cal.accuracy["n"].tolist() == [31, 30, 31, 31]
    stds = cal.covariance.stds * cal.measurement.free.factors()
    assert np.abs((cal.measurement.vector() - true_vector(cal, truth)) / stds).max() < 4


def test_single_wavelength_finds_its_branch(make):
    """With one bin every parameter belongs to it, so the search must look there too."""
    lam = [1600] * u.nm
    chain = make.chain(wavelength=lam)
    for key in ("w_sio2", "w_mgf2"):
        getattr(chain["hwp"], key).fixed = True
    truth = chain.copy()
    truth["derotator"].retardance = [100.0] * u.deg
    data = make.observe(truth, wavelength=lam, seed=2)
    chain["derotator"].retardance = [330.0] * u.deg
    lost, found = (
        calibrate(chain, data, weights="errors", search=s, cross_validate=False)
        for s in (False, True)
    )
    chi2 = [np.sum((c.residuals / c.measurement.sigma) ** 2) for c in (lost, found)]
    assert chi2[0] > 1000
    assert chi2[1] < 80  # 32 data, 3 parameters


# --- ties and several datasets ---------------------------------------------------------------


def test_ties_are_kept(few):
    for strategy in ["joint", "two-step"]:
        chain, _, data = few
        ties = {"derotator.theta": Tie("calibration_polarizer.theta", 0.5, offset=-45 * u.deg)}
        cal = calibrate(chain, data, ties=ties, strategy=strategy, cross_validate=False)
        polarizer = cal.chain["calibration_polarizer"].theta.value
        assert cal.chain["derotator"].theta.value == pytest.approx(0.5 * polarizer - 45), strategy
        known = cal.parameter_values()["derotator.theta"]
        assert known["tied"] == "calibration_polarizer.theta", strategy
        assert "derotator.theta" not in cal.covariance.names, strategy
        assert not any("derotator.theta" in row for row in cal.parameters["name"]), strategy
        assert cal.measurement_of(data).free.size == len(cal.covariance), strategy


def test_what_follows_a_held_parameter_is_held_at_its_place(few, make):
    """In the first of the two steps a tie must count although its source does not move."""
    chain, truth, _ = few
    truth = truth.copy()
    truth["derotator"].theta = (0.5 * 90.4 - 40) * u.deg
    ties = {"derotator.theta": Tie("calibration_polarizer.theta", 0.5, offset=-40 * u.deg)}
    data = make.observe(truth, wavelength=FEW, noise=False)
    cal = calibrate(chain, data, ties=ties, strategy="two-step", cross_validate=False)
    # the polarizer is 0.4 deg off in the first step; the derotator would be by 5 deg
    assert cal.stages[0]["residual_rms"] < 0.02
    assert cal.chain["derotator"].theta.value == pytest.approx(5.2, abs=0.05)


def test_two_datasets_share_optics_and_halve_the_variance(make):
    """The same frames with and without the beam switcher: errors fall by sqrt(2)."""
    pair = [make.chain(wavelength=FEW, optics_in=o) for o in ([], ["nbs"])]
    truths = [make.truth(c) for c in pair]
    data = [make.observe(t, wavelength=FEW, seed=i, name=f"set {i}") for i, t in enumerate(truths)]
    options = {"weights": "errors", "errors": "white", "cross_validate": False}
    both, alone = calibrate(pair, data, **options), calibrate(pair[0], data[0], **options)
    assert [record.name for record in both.datasets] == ["set 0", "set 1"]
    assert both.covariance.names == alone.covariance.names
    for name in ("hwp.w_sio2", "calibration_polarizer.theta", "wollaston.efficiency[2]"):
        ratio = both.covariance.std(name) / alone.covariance.std(name)
        assert float(ratio) == pytest.approx(np.sqrt(0.5), abs=0.02), name
    values = [chain["derotator"].retardance.value for chain in both.chains]
    np.testing.assert_array_equal(values[0], values[1])
    stds = both.covariance.stds * both.measurement.free.factors()
    assert np.abs((both.measurement.vector() - true_vector(both, truths[0])) / stds).max() < 4


def test_polarized_and_unpolarized_data_together(make):
    pair = [make.chain(wavelength=FEW, source=s) for s in ("polarized", "unpolarized")]
    truths = [make.truth(c) for c in pair]
    truths[1]["fold_mirror"].diattenuation = [0.012, 0.010, 0.009, 0.008]
    data = [make.observe(t, wavelength=FEW, seed=i) for i, t in enumerate(truths)]
    cal = calibrate(pair, data, weights="errors", cross_validate=False)
    known = cal.parameter_values()["fold_mirror.diattenuation"]
    assert known["identifiable"].all()
    pulls = (known["value"] - truths[1]["fold_mirror"].diattenuation.value) / known["std"]
    assert np.abs(pulls).max() < 4


# --- two steps -----------------------------------------------------------------------------


def test_two_step_records_its_stages(few):
    chain, truth, data = few
    cal = calibrate(chain, data, strategy="two-step", cross_validate=False)
    titles = [stage["title"] for stage in cal.stages]
    assert titles == [
        "per wavelength, misalignments held",
        "global",
        "per wavelength, global parameters held",
    ]
    first, second, third = (stage["parameters"] for stage in cal.stages)
    assert sorted(first) == ["derotator.retardance", "hwp.retardance", "wollaston.efficiency"]
    assert sorted(second) == ["calibration_polarizer.theta", "hwp.w_mgf2", "hwp.w_sio2"]
    assert sorted(third) == ["derotator.retardance", "wollaston.efficiency"]
    # the plate is replaced by one retardance a wavelength, near what its law gives
    law = truth["hwp"].retardance(FEW).to_value(u.deg)
    np.testing.assert_allclose(first["hwp.retardance"].to_value(u.deg), law, atol=3)
    assert u.isclose(second["hwp.w_sio2"], cal.chain["hwp"].w_sio2.quantity)
    assert cal.stages[2]["residual_rms"] <= cal.stages[1]["residual_rms"] * (1 + 1e-9)


def test_joint_fit_is_at_least_as_good_as_two_steps(few, calibrated):
    chain, _, data = few
    two = calibrate(chain, data, weights="errors", strategy="two-step", cross_validate=False)
    sigma = two.measurement.sigma
    chi2 = [np.sum((c.residuals / sigma) ** 2) for c in (calibrated, two)]
    assert chi2[0] <= chi2[1] * (1 + 1e-9)


# --- objections ---------------------------------------------------------------------------


def test_unknown_choice_is_refused(few):
    for options, words in [
        ({"strategy": "three-step"}, "strategy = 'three-step'; allowed are joint, two-step"),
        ({"weights": "none"}, "weights = 'none'; allowed are None, 'wavelength', 'errors'"),
    ]:
        chain, _, data = few
        with pytest.raises(FitError, match=words):
            calibrate(chain, data, **options)


def test_weights_without_errors_are_refused(few):
    from astropolcal.observations import Observations

    chain, _, data = few
    table = data.to_table()
    table.remove_columns(["flux_right_err", "flux_left_err"])
    bare = Observations.from_table(table)
    with pytest.raises(FitError, match="128 of 128 data have no error"):
        calibrate(chain, bare, weights="errors")
    assert calibrate(chain, bare, cross_validate=False).converged


def test_nothing_to_fit_is_refused(few):
    chain, _, data = few
    fixed = chain.copy()
    for leaf in leaves(fixed):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    with pytest.raises(FitError, match="nothing to fit"):
        calibrate(fixed, data)


def test_start_outside_its_bounds_is_named(few):
    chain, _, data = few
    assert calibrate(chain, data, cross_validate=False).converged
    for optic, key, value, words in (
        ("hwp", "theta", 9, r"hwp\.theta starts at 9; allowed are -5 to 5 deg"),
        ("wollaston", "efficiency", -0.5, r"wollaston\.efficiency.* at -0\.5; allowed are 0 to 1$"),
    ):
        wrong = chain.copy()
        parameter = getattr(wrong[optic], key)
        parameter.fixed, parameter.value = False, np.full(np.shape(parameter.value), value)
        for fitter in (None, LMLSQFitter()):
            with pytest.raises(FitError, match=words):
                calibrate(wrong, data, fitter=fitter)
    # by a rounding error alone
    wrong = chain.copy()
    wrong["hwp"].theta.fixed, wrong["hwp"].theta.value = False, 5 + 1e-9
    assert calibrate(wrong, data, cross_validate=False).converged


def test_more_parameters_than_data_are_refused(make):
    chain = make.chain("elliptical", fixed=False, wavelength=FEW)
    data = make.observe(chain, make.frames([45] * u.deg), FEW, seed=1)
    with pytest.raises(FitError, match=r"21 free parameters but only 16 data"):
        calibrate(chain, data)


def test_a_table_that_is_given_twice_is_refused(make, few):
    """It has no more information than given once, and made all errors smaller."""
    chain, truth, data = few
    again = make.observe(truth, wavelength=FEW, seed=11, meta=data.meta, name="copy")
    for tables in ([data, data], [data, again]):
        with pytest.raises(ObservationError, match="once"):
            calibrate(chain, tables, cross_validate=False)
        with pytest.raises(ObservationError, match="once"):
            calibrate_runs(chain, tables, vary=None)


def test_fit_that_does_not_arrive_warns(few, monkeypatch):
    from astropolcal.calibration.fit import strategies as fit

    chain, _, data = few
    monkeypatch.setattr(fit, "_MAX_EVALUATIONS", 1)
    with pytest.warns(AstropolcalWarning, match="did not converge"):
        cal = calibrate(chain, data, search=False, cross_validate=False)
    assert not cal.converged
    assert "NOT CONVERGED" in cal.summary()
    assert cal.verdict().advice == "more angles of derotator and half-wave plate"


def test_step_that_does_not_arrive_warns_too(few, monkeypatch):
    from astropolcal.calibration.fit import strategies as fit

    chain, _, data = few
    monkeypatch.setattr(fit, "_MAX_EVALUATIONS", 1)
    with pytest.warns(AstropolcalWarning, match="did not converge"):
        cal = calibrate(chain, data, strategy="two-step", cross_validate=False)
    assert not cal.converged


def test_fitter_that_leaves_the_bounds_is_told_on(few):
    """`LMLSQFitter` knows no bounds and does not say so."""
    chain, _, data = few
    tight = chain.copy()
    tight["calibration_polarizer"].theta.bounds = (89.8, 90.2)  # the truth is 90.4
    with pytest.warns(AstropolcalWarning, match=r"LMLSQFitter left the bounds of calibration_pol"):
        cal = calibrate(tight, data, fitter=LMLSQFitter(), search=False, cross_validate=False)
    assert not cal.converged


@pytest.mark.slow
def test_when_branches_are_searched(few, monkeypatch):
    for strategy, search, searches in [
        ("joint", None, True),
        ("joint", False, False),
        ("two-step", None, False),  # the paper's procedure goes downhill from its start
        ("two-step", True, True),
    ]:
        from astropolcal.calibration.fit import strategies as fit

        calls = []

        def counted(*args, calls=calls):
            calls.append(args)
            return search_branches(*args)

        chain, _, data = few
        monkeypatch.setattr(fit, "search_branches", counted)
        calibrate(chain, data, strategy=strategy, search=search, cross_validate=False)
        assert bool(calls) == searches


def test_fitter_that_breaks_is_a_fit_error_of_one_line(few):
    chain, _, data = few
    for error in (ValueError("x0 is infeasible"), NonFiniteValueError("not\nfinite")):

        class Broken(TRFLSQFitter):
            def __call__(self, *args, error=error, **kwargs):
                raise error

        with pytest.raises(
            FitError, match=r"Broken failed: (x0 is infeasible|not finite)$"
        ) as info:
            calibrate(chain, data, fitter=Broken())
        assert "\n" not in str(info.value)


# --- the result ------------------------------------------------------------------------------


def test_dictionary_follows_the_contract(calibrated):
    result = to_dict(calibrated)
    again = json.loads(json.dumps(result, allow_nan=False))
    assert again == result
    assert set(result) >= {
        "instrument", "observable", "fitter", "seconds", "n_data", "n_free", "rank", "datasets",
        "parameters", "null_directions",
    }  # fmt: skip
    assert result["instrument"] == "charis"
    assert result["n_free"] == result["rank"] == 11
    (dataset,) = result["datasets"]
    assert set(dataset) >= {
        "name", "source", "wavelength_nm", "n", "s_res_percent", "s_mean_percent", "s_cv_percent",
    }  # fmt: skip
    assert {len(dataset[key]) for key in ("wavelength_nm", "n", "s_res_percent")} == {4}
    for name, entry in result["parameters"].items():
        assert set(entry) >= {"value", "unit", "std", "fixed", "at_bound", "identifiable"}, name
    assert result["parameters"]["hwp.w_sio2"]["unit"] == "mm"
    assert len(result["parameters"]["derotator.retardance"]["value"]) == 4
    assert result["parameters"]["wollaston.theta"]["std"] is None


def test_dictionary_of_a_two_step_fit_is_json_too(few):
    chain, _, data = few
    cal = calibrate(chain, data, strategy="two-step", cross_validate=False)
    result = json.loads(json.dumps(cal.to_dict(), allow_nan=False))
    assert len(result["stages"]) == 3
    assert result["datasets"][0]["s_cv_percent"] == [None] * 4


def test_undetermined_parameters_are_null_in_json(make):
    chain = make.chain("elliptical", fixed=False, wavelength=FEW)
    cal = calibrate(chain, make.observe(make.truth(chain), wavelength=FEW, seed=3))
    result = json.loads(json.dumps(cal.to_dict(), allow_nan=False))
    assert result["rank"] == result["n_free"] - len(result["null_directions"])
    assert result["parameters"]["hwp.theta"]["std"] is None
    assert result["parameters"]["hwp.theta"]["identifiable"] is False
    for direction in result["null_directions"]:
        assert set(direction) == {"words", "parameters", "sky"}


def test_parameter_table_has_a_row_a_free_value(calibrated):
    table = calibrated.parameters
    lines = str(table).splitlines()
    assert lines[0].split() == ["name", "value", "std", "unit", "status"]
    assert len(lines) == len(table) + 2
    assert not any("..." in line or len(line) > 80 for line in lines)
    assert len(table) == len(calibrated.covariance)
    assert list(table["name"]) == calibrated.covariance.names
    np.testing.assert_allclose(table["std"], calibrated.covariance.stds)
    row = table[list(table["name"]).index("hwp.w_sio2")]
    assert row["unit"] == "mm"
    assert row["value"] == pytest.approx(1.6542, abs=0.001)


def test_fixed_parameters_have_no_error(calibrated):
    known = calibrated.parameter_values()["hwp.theta"]
    assert known["fixed"]
    assert np.isnan(known["std"])
    assert not known["identifiable"]


def test_record_of_the_data(few, calibrated):
    _, _, data = few
    (record,) = calibrated.datasets
    assert (record.name, record.source, record.n_frames, record.n_masked) == (
        "few",
        "polarized",
        64,
        0,
    )
    assert record.content_hash == data.content_hash
    assert calibrated.provenance["astropolcal"]
    assert calibrated.instrument == "charis"


def test_measurement_of_new_data_predicts_them(make, few, calibrated):
    _, truth, _ = few
    new = make.observe(truth, make.frames([50, 100] * u.deg), FEW, seed=12)
    measurement = calibrated.measurement_of(new)
    pulls = measurement.residuals() / measurement.sigma
    assert isinstance(measurement, Measurement)
    assert pulls.std() == pytest.approx(1.0, abs=0.35)


def test_residuals_need_data(few, calibrated):
    import dataclasses

    stored = dataclasses.replace(calibrated, measurement=None)
    assert isinstance(stored, Calibration)
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        _ = stored.residuals


def test_words_name_what_matters(calibrated):
    words = calibrated.summary()
    assert "Calibration of charis from few" in words
    assert "hwp.w_sio2" in words
    assert "s_cv" in words
    assert max(len(line) for line in words.splitlines()) <= 80
    assert "11 free parameters, rank 11" in repr(calibrated)
    assert calibrated._repr_html_().startswith("<p>Calibration of ")
    assert "<th>std</th>" in calibrated._repr_html_()


def test_few_wavelengths_do_not_end_in_a_wrong_minimum():
    """Three wavelengths tell no noise; the errors of the table do, and other starts are tried."""
    grid = [1200, 1600, 2000] * u.nm
    charis = instruments.get("charis")
    chain = charis.chain(derotator="linear", wavelength=grid)
    frames = half_wave_plate_cycles(derotator=[50, 65, 80, 95] * u.deg)
    found = []
    for seed, angle in ((8000, -0.5214799195490646), (1, 1.2), (2, -2.0)):
        truth = chain.copy()
        truth["hwp"].theta = angle * u.deg
        truth["wollaston"].efficiency = [0.98, 0.975, 0.97]
        table = simulate(truth, grid, frames, seed=seed, flux=1e6)
        one = calibrate(chain, table, cross_validate=False)
        (test,) = one.fit["lack_of_fit"]
        found.append(test["times_noise"])
        known = one.parameter_values()["hwp.w_sio2"]
        assert abs(known["value"] - truth["hwp"].w_sio2.value) < 5 * known["std"]
    assert max(found) < 1.5


class Fading(optics.Optic):
    """An optic of a user, whose derivative may be wrong."""

    share = Parameter(default=0.9, bounds=(0, 1), description="what is left of Q and U")
    wrong = 1.0

    def _matrix(self, dispersion, share):
        return np.eye(4) * np.where([[1, 0, 0, 1]], 1.0, np.asarray(share)[..., None, None])

    def _derivatives(self, dispersion, share):
        return (self.wrong * np.diag([0.0, 1.0, 1.0, 0.0]),)


def test_wrong_derivatives_of_an_optic_of_a_user_are_refused(few):
    chain, _, data = few
    chain = insert_optic(chain, Fading(name="fading"), before="wollaston")
    chain["wollaston"].efficiency.fixed = True
    assert calibrate(chain, data, cross_validate=False).converged
    for wrong in (0.0, 1.5, -1.0):
        chain["fading"].wrong = wrong
        with pytest.raises(FitError, match=r"fading.share: the derivative"):
            calibrate(chain, data, cross_validate=False)


class Leaking(Fading):
    """One that has no matrix beyond its bound, where it starts."""

    share = Parameter(default=0.0, bounds=(0, 1), description="what leaks")

    def _matrix(self, dispersion, share):
        return super()._matrix(dispersion, 1 - np.sqrt(share))

    def _derivatives(self, dispersion, share):
        return (-0.5 / np.sqrt(max(share, 1e-8)) * super()._derivatives(dispersion, share)[0],)


def test_derivatives_of_an_optic_that_starts_at_its_bound_are_held_against_differences(few):
    chain, truth, data = few
    chain = insert_optic(chain, Leaking(name="leaking"), before="wollaston")
    chain["wollaston"].efficiency = truth["wollaston"].efficiency.value
    chain["wollaston"].efficiency.fixed = True
    found = calibrate(chain, data, cross_validate=False)
    assert found.converged
    assert found.chain["leaking"].share.value < 1e-6
    chain["leaking"].wrong = 1.5
    with pytest.raises(FitError, match=r"leaking.share: the derivative .* by up to \d.*, not \d"):
        calibrate(chain, data, cross_validate=False)


@pytest.mark.slow
def test_names_alone_hold_parameters_where_they_start():
    chain = (
        optics.LinearPolarizer(name="lamp", fixed={"theta": False})
        | optics.LinearRetarder(
            retardance=170 * u.deg, mount="hwp", name="hwp", fixed={"theta": False}
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[0, 0, 0] * u.deg)
    observations = simulate(chain, [0.6] * u.um, frames, seed=1)
    for fix in ("hwp.theta", ["hwp.theta"], {"hwp.theta": None}):
        held = calibrate(chain, observations, fix=fix, cross_validate=False)
        assert held.chain["hwp"].theta.fixed
    # the name of an optic stands for all of its parameters, which have no value in common
    whole = calibrate(chain, observations, fix="hwp", cross_validate=False)
    assert whole.settings["gauge"].startswith("held: hwp.theta, hwp.retardance;")
    for fix, words in [
        ([3], "fix: no optic '3' in the chain; it has lamp, hwp, wollaston"),
        (["hpw"], r"fix: no optic 'hpw'.*did you mean 'hwp'"),
        (["hwp.tetha"], r"fix: hwp has no parameter 'tetha'.*did you mean 'theta'"),
        ({"hwp": 0 * u.deg}, "fix: hwp = 0.0 deg: name the parameter .*, of hwp.theta, hwp.ret"),
    ]:
        with pytest.raises(FitError, match=words):
            calibrate(chain, observations, fix=fix)
