# Licensed under a 3-clause BSD style license - see LICENSE
"""Cases that a usual calibration does not meet, each with what must come out of it."""

from dataclasses import replace
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import calibrate, instruments, optics
from astropolcal.calibration import target_accuracies
from astropolcal.calibration.fit.branches import BinProblem
from astropolcal.calibration.fit.calibrate import open_parameters, settled
from astropolcal.calibration.noise import noise_from_null_channel, noise_from_replicates
from astropolcal.calibration.noise.weighting import Weighting, outlying_data, robust_weighting
from astropolcal.calibration.posterior import LogPosterior, Posterior
from astropolcal.calibration.result.summary import _target_lines
from astropolcal.calibration.uncertainty import derived_efficiency, derived_sky
from astropolcal.calibration.uncertainty.covariance import Covariance, full_covariance
from astropolcal.calibration.uncertainty.refits import Profile
from astropolcal.calibration.validation import paper_accuracies, star_stokes
from astropolcal.calibration.validation.cross_validation import cross_validated_residuals
from astropolcal.calibration.validation.stars import _add_known
from astropolcal.exceptions import (
    AstropolcalWarning,
    ChainError,
    FitError,
    ObservationError,
    ParameterError,
    WavelengthRangeError,
)
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.pipeline.headers import describe
from astropolcal.reduction.cubes import both_states
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.standards import SerkowskiLaw

CHARIS = instruments.get("charis")
LAM = [1.2, 1.6, 2.2] * u.um
ANGLES = [45, 60, 80, 100] * u.deg


@pytest.fixture(scope="module")
def data(make, chain):
    return make.observe(chain, half_wave_plate_cycles(derotator=ANGLES), LAM, seed=3)


@pytest.fixture(scope="module")
def cal(chain, data):
    return calibrate(chain, data, search=False, cross_validate=False)


def _changed(table, frame, factor):
    """The table with the right beam of a frame, at all wavelengths, times a factor."""
    rows = table.to_table()
    rows["flux_right"][np.asarray(rows["frame"]) == frame] *= factor
    return Observations.from_table(rows, name=table.name)


# --- measurement ----------------------------------------------------------------------------


def test_an_optic_out_of_its_range_names_the_table():
    """The law of the plate's crystals ends before 20 um."""
    plate = optics.TwoLayerWaveplate(mount="hwp", name="hwp") | optics.WollastonPrism(name="w")
    wide = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    frames = half_wave_plate_cycles(derotator=[45] * u.deg)
    table = simulate(wide | optics.WollastonPrism(name="w"), [20.0] * u.um, frames, name="far")
    with pytest.raises(WavelengthRangeError, match=r"^far: "):
        Measurement(plate, table)


def test_nothing_free_is_nothing_to_sample(chain, data):
    held = chain.copy()
    for leaf in held:
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    with pytest.raises(ParameterError, match="nothing to sample: every parameter is fixed"):
        LogPosterior(Measurement(held, data), noise=0.01)


# --- noise -------------------------------------------------------------------------------------


def test_replicates_at_some_wavelengths_only_are_not_enough(make, chain):
    """At the last wavelength the repeated angle is masked: the null channel is there for all."""
    frames = half_wave_plate_cycles(derotator=[45, 60, 60, 80] * u.deg)
    table = make.observe(chain, frames, LAM, seed=3)
    mask = np.zeros((table.n_frames, 3), dtype=bool)
    second = np.abs(np.rad2deg(table.position("derotator")) - 60) < 1
    mask[np.flatnonzero(second)[:8], 2] = True
    some = Measurement(chain, table.with_mask(mask, "test"))
    assert noise_from_replicates(some).dof.tolist()[2] == 0
    assert np.isfinite(noise_from_null_channel(some).sigma).all()


def test_null_of_a_modulator_has_a_level_of_each_state():
    """Beams unequal by different shares in states A and B: two constants take both away."""
    vampires = instruments.get("vampires")
    fields = vampires.wavelength[:1]
    chain = vampires.chain(wavelength=fields, derotator="linear")
    frames = both_states(half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg))
    meta = {"instrument": "SCExAO/VAMPIRES", "flc": "in", "source": "polarized", "pairing": "hwp"}
    table = simulate(chain, fields, frames, flux=1e7, seed=1, meta=meta)
    quiet = noise_from_null_channel(Measurement(chain, table)).sigma[0]
    rows = table.to_table()
    state = np.asarray(rows["flc_state"])
    rows["flux_right"][state == state[0]] *= 1.02
    uneven = Observations.from_table(rows, name="uneven")
    loud = noise_from_null_channel(Measurement(chain, uneven)).sigma[0]
    # one level for both states would leave half of the difference, 0.5 %; what is left here is the
    # part that goes with x^2, of which one multiple is taken away for both states
    assert quiet < 0.05 * u.percent
    assert loud < 0.2 * u.percent


# --- robust fits ----------------------------------------------------------------------------------


def test_a_datum_at_odds_at_one_wavelength_is_told_with_it(chain, data):
    """A cosmic ray in one beam at one wavelength moves the parameters that all share."""
    table, options = data.to_table(), {"search": False, "cross_validate": False}
    for row, factor in ((0, 1.0), (7, 9.0), (40, 0.5)):
        spoiled = table.copy()
        spoiled["flux_right"][row] *= factor
        found = calibrate(chain, Observations.from_table(spoiled, name="night"), **options)
        told = [row for row in outlying_data(found) if np.isfinite(row["wavelength"])]
        assert len(told) == (factor != 1.0), (row, factor)
        for one in told:
            assert str(spoiled["frame"][row]) in one["frames"].split(", ")
            assert abs(one["wavelength"] - spoiled["wavelength"][row]) < 0.01 * u.nm
            nm = f"at {one['wavelength'].to_value(u.nm):.5g} nm"
            for words in (found.summary(), found.summary(full=True)):
                assert nm in " ".join(words.split()), words
            assert "at odds" in found.verdict().advice, found.verdict()
        if factor == 1.0:
            clean = found
            continue
        told, free = found.fit["outliers_move"], found.measurement.free
        moved = np.abs(found.measurement.vector() - clean.measurement.vector())
        moved = (moved / free.factors() / found.covariance.stds)[
            free.names.index(told["parameter"])
        ]
        # the datum has noise of its own, and the fit is not linear
        assert told["errors"] == pytest.approx(moved, rel=0.2)
        said = any(told["parameter"] in words for words in found.verdict().reasons)
        assert said == (told["errors"] > 2) == (factor == 9.0), (factor, told)


def test_a_frame_at_odds_is_told_with_its_brightness(chain, data):
    spoiled = _changed(data, 5, 1.3)
    found = calibrate(chain, spoiled, search=False, cross_validate=False, loss="bisquare")
    table = outlying_data(found)
    assert len(table) == 1
    frames = [int(n) for n in str(table["frames"][0]).split(",")]
    assert 5 in frames
    # 15 % more light in the frame's beams; its partner is the fainter one, of median brightness
    assert 0.8 < table["brightness"][0] < 1.2
    assert table["sigma"][0] > 4
    # the loss has not let it pull: all parameters are where they are without it
    clean = calibrate(chain, data, search=False, cross_validate=False)
    pulls = (found.measurement.vector() - clean.measurement.vector()) / (
        clean.covariance.stds * clean.measurement.free.factors()
    )
    assert np.abs(pulls).max() < 2


def test_a_far_datum_is_noisy_and_a_near_one_is_not(cal):
    for loss in ["huber", "cauchy", "bisquare"]:
        kinds = (robust_weighting(cal.measurement, name) for name in (loss, "linear"))
        sigma, plain = (weighting.sigma for weighting in kinds)
        # times sigma / scale it is the root of one over the weight: never below one
        ratio, size = sigma / plain, np.abs(cal.measurement.residuals()) / plain
        assert (ratio >= 1 - 1e-12).all(), loss
        order = np.argsort(size)
        assert (np.diff(ratio[order]) >= -1e-9).all(), loss
        assert ratio[order[0]] == pytest.approx(1, abs=1e-3), loss


def test_robust_weights_that_do_not_settle_are_told(chain, data, monkeypatch):
    from astropolcal.calibration.fit import calibrate as fit

    monkeypatch.setattr(fit, "_ROBUST_ROUNDS", 1)
    with pytest.warns(
        AstropolcalWarning, match="weights of the robust fit did not settle in 1 fits"
    ):
        found = calibrate(
            chain, _changed(data, 5, 1.3), search=False, cross_validate=False, loss="huber"
        )
    assert not found.converged


# --- covariances of before -----------------------------------------------------------------


def _without_directions(calibration, **changes):
    """As a file has it that was written before it kept directions."""
    known = calibration.covariance
    plain = Covariance(known.names, known.units, known.matrix)
    return replace(calibration, covariance=plain, **changes)


def test_directions_are_found_again_from_the_data(cal):
    found, known = full_covariance(_without_directions(cal)), cal.covariance
    np.testing.assert_allclose(
        found.factor.T @ found.factor, known.factor.T @ known.factor, rtol=1e-6
    )
    assert full_covariance(cal) is known


def test_without_data_the_open_directions_of_the_finding_count(make, data):
    """Of the polarizer and the plate the sum is known: each alone is infinitely uncertain."""
    chain = make.chain("elliptical", fixed=False, wavelength=LAM)
    free = calibrate(chain, data, search=False, cross_validate=False)
    found = full_covariance(_without_directions(free, measurement=None))
    assert found.factor is None
    assert len(found.null) == len(free.covariance.null)
    # the same space, whatever its basis
    both = np.vstack([found.null, free.covariance.null])
    assert np.linalg.matrix_rank(both, tol=1e-4) == len(found.null)
    alone = np.zeros(len(found))
    alone[found.names.index("hwp.theta")] = 1
    assert np.isinf(found.propagate(alone))
    # what no open direction moves has its error still
    law = np.zeros(len(found))
    law[found.names.index("hwp.w_sio2")] = 1
    assert found.propagate(law) == pytest.approx(free.covariance.std("hwp.w_sio2").value ** 2)


# --- gauge, profile, posterior --------------------------------------------------------------


def test_equal_weights_settle_as_none(make, data):
    """An array of equal weights, whatever their size, chooses the gauge that none does."""
    chain = make.chain("elliptical", fixed=False, wavelength=LAM)
    found = []
    for equal in (False, True):
        measurement = Measurement(chain, data)
        weighting = Weighting("given" if equal else None, np.full(measurement.n_data, 1 / 3))
        origin = measurement.vector()
        moved = origin.copy()
        for name in ("calibration_polarizer.theta", "hwp.theta"):
            moved[measurement.free.by_name[name].start] += np.deg2rad(0.5)
        measurement.stand_at(moved)
        whitened = settled(BinProblem(measurement, weighting), origin)
        found.append((open_parameters(measurement.free, whitened), measurement.vector()))
    assert found[0][0] == found[1][0]
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-4)


def test_a_profile_that_is_above_everywhere_ends_where_it_is():
    made = Profile(
        "a.b", 1.0, np.array([0.0, 1.0, 2.0]), np.array([9.0, 4.0, 9.0]), np.zeros((3, 1))
    )
    assert made.interval(rise=1.0) == (1.0, 1.0)
    low, high = made.interval(rise=6.25)
    # the root of the profile is a straight line between the values: 2 to 3, and 2.5 half way
    assert (low, high) == (pytest.approx(0.5), pytest.approx(1.5))


def test_a_chain_that_does_not_move_is_half_burn_in():
    posterior = Posterior(["a.b"], [None], np.full((20, 4, 1), 3.0), np.zeros((20, 4)))
    assert posterior.burn_in == 10
    assert posterior.quantile("a.b", 0.5) == 3.0


# --- cross-validation of many groups --------------------------------------------------------


def test_linear_steps_are_what_refits_give(cal, monkeypatch):
    """Eight groups, refitted one by one, and the linear way that is taken for more than 16."""
    from astropolcal.calibration.validation import cross_validation as accuracy

    (part,) = cal.measurement.datasets
    groups = part.group_of_datum // 2
    exact = cross_validated_residuals(cal.measurement, groups=groups)
    monkeypatch.setattr(accuracy, "_MANY", 2)
    linear = cross_validated_residuals(cal.measurement, groups=groups)
    scatter = np.sqrt(np.mean(exact**2))
    assert np.abs(linear - exact).max() < 0.02 * scatter
    # what was left out is predicted worse than it was fitted
    assert scatter > np.sqrt(np.mean(cal.residuals**2))


def test_a_group_that_alone_determines_something_is_named(make, chain, monkeypatch):
    """One wavelength lacks all but the first cycle, which alone tells its efficiency."""
    from astropolcal.calibration.validation import cross_validation as accuracy

    table = make.observe(chain, half_wave_plate_cycles(derotator=ANGLES), LAM, seed=3)
    mask = np.zeros((table.n_frames, 3), dtype=bool)
    mask[8:, 0] = True
    measurement = Measurement(chain, table.with_mask(mask, "test"))
    (part,) = measurement.datasets
    groups = (part.group_of_datum // 4).astype(int)
    monkeypatch.setattr(accuracy, "_MANY", 2)
    with pytest.raises(FitError, match=r"without group 0 .*do not determine .*efficiency"):
        cross_validated_residuals(measurement, groups=groups)


# --- derived quantities, stars, targets -----------------------------------------------------


def test_a_chain_without_a_beam_splitter_or_that_stands_still():
    plain = optics.LinearRetarder(retardance=90 * u.deg, name="plate")
    with pytest.raises(ChainError, match="no optic of the chain has an efficiency"):
        derived_efficiency(SimpleNamespace(chains=[plain], wavelength=LAM))
    still = optics.Diattenuator(name="mirror") | optics.WollastonPrism(name="wollaston")
    calibration = SimpleNamespace(chains=[still], wavelength=LAM, ties={})
    with pytest.raises(ChainError, match="no optic on a stage; give the chain from the sky"):
        derived_sky(calibration, 0.01, 0.0, {"hwp": 0 * u.deg})


def test_a_star_of_one_plate_angle_tells_no_q_and_u(chain, cal):
    sky = optics.PolarizedSource(q=0.02, u=0.01, name="star")
    for name in ("hwp", "derotator", "wollaston"):
        sky = sky | chain[name]
    frames = half_wave_plate_cycles(hwp=[0, 45] * u.deg, derotator=[60] * u.deg)
    night = simulate(sky, LAM, frames, seed=3, name="short")
    with pytest.raises(ObservationError, match="short: no cycle determines q and u"):
        star_stokes(cal, sky, night)


def test_errors_of_a_catalogue_lie_along_and_across_its_polarization():
    """An uncertain angle leaves the degree certain, and the other way round."""
    for theta in [0, 17, 33, 70, 101, 158]:
        law = SerkowskiLaw(p_max=0.03, theta=theta * u.deg)
        for errors, dolp, aolp in (
            ({"theta": 2 * u.deg}, 0, 2),
            ({"p_max": 0.2 * u.percent}, 0.2, 0),
        ):
            known = law.stokes([0.55, 0.55] * u.um, errors)
            table = QTable({"wavelength": [0.55, 0.55] * u.um})
            _add_known(table, *known)
            np.testing.assert_allclose(table["dolp_known"].value, 3)
            np.testing.assert_allclose(table["aolp_known"].value, theta, atol=1e-9)
            np.testing.assert_allclose(table["dolp_known_err"].value, dolp, atol=1e-6)
            np.testing.assert_allclose(table["aolp_known_err"].value, aolp, atol=1e-6)
    # a star of no polarization has no angle
    table = QTable({"wavelength": [1.2] * u.um})
    _add_known(table, np.zeros(1), np.zeros(1), 1e-8 * np.eye(2)[None])
    assert np.isnan(table["aolp_known"][0])
    assert table["dolp_known_err"][0].to_value(u.percent) == pytest.approx(0.01)
    assert not np.isfinite(table["aolp_known_err"][0])


def test_a_source_of_no_known_kind_gives_no_accuracy_for_a_target(cal):
    """Nor a table in the summary: neither lamp nor star, and no half-wave plate."""
    records = [replace(cal.datasets[0], source="sunlit dome")]
    bare = optics.Diattenuator(name="mirror") | optics.WollastonPrism(name="wollaston")
    other = replace(cal, datasets=records, chains=[bare], settings={}, fit={})
    assert paper_accuracies(other) == target_accuracies(other) == []
    assert _target_lines(other, ((1 * u.percent, None),)) == []
    # an impossible target is refused all the same
    for accuracies in (paper_accuracies, target_accuracies):
        with pytest.raises(ParameterError, match="dolp"):
            accuracies(other, [(2.0, None)])


# --- headers --------------------------------------------------------------------------------------


def test_an_instrument_without_files_only_tells_its_name(monkeypatch):
    lab = SimpleNamespace(name="lab", files=None, headers=None, configured=lambda header: lab)
    monkeypatch.setattr(instruments, "get", lambda name: lab)
    assert describe({"INSTRUME": "CHARIS"}, "lab") == {"instrument": "lab"}


def test_components_of_a_retarder_may_be_constant_or_per_wavelength():
    """The mirror solutions of one that has both are looked for, too."""
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=172 * u.deg, mount="hwp", name="hwp")
        | optics.EllipticalRetarder(
            horizontal=[100, 90, 80] * u.deg,
            diagonal=4 * u.deg,
            circular=3 * u.deg,
            mount="derotator",
            name="derotator",
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    seen = simulate(chain, LAM, half_wave_plate_cycles(derotator=ANGLES), seed=1)
    cal = calibrate(chain, seen, search=False, cross_validate=False)
    # d (1 - 360 deg / |d|) differs from wavelength to wavelength, the other hand does not
    words = " ".join(cal.identifiability.mirrors)
    assert "all retardances with the other sign" in words
    assert "derotator: a retardance d" not in words
