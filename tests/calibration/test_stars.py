# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarization of stars, simulated and real: M3, the accuracy on sky, HD 30675."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from star_data import CHARIS, WAVELENGTH, observe_star, star_chain

from astropolcal import calibrate
from astropolcal.calibration import fitted_stars, star_check, target_accuracies
from astropolcal.calibration.validation import paper_accuracies, star_accuracy, star_stokes
from astropolcal.calibration.validation.cross_validation import standard_accuracy
from astropolcal.calibration.validation.stars import _pull
from astropolcal.chain import leaves, replace_optic
from astropolcal.exceptions import AstropolcalWarning, ChainError, FitError
from astropolcal.instruments.telescope import published_mirror
from astropolcal.measurement import Measurement
from astropolcal.simulation import half_wave_plate_cycles, simulate

# --- simulated --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated():
    """A calibration that knows everything but M3, from an unpolarized star."""
    chain = star_chain()
    for leaf in leaves(chain):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = (leaf.name, key) != ("m3", "diattenuation")
    truth = chain.copy()
    truth["m3"].diattenuation = [0.017, 0.014, 0.012]
    cal = calibrate(chain, observe_star(truth, 12, seed=1), cross_validate=False)
    return cal, truth


def polarized(truth, q, u_, **options):
    chain = replace_optic(truth, "star", star_chain("star")["star"])
    chain["star"].q, chain["star"].u = q, u_
    return observe_star(chain, 6, source="star", parallactic=(10, 60), **options)


def test_star_comes_back_in_the_frame_of_the_sky(simulated):
    cal, truth = simulated
    q, u_ = np.array([0.03, 0.02, 0.01]), np.array([-0.01, 0.02, 0.03])
    table = star_stokes(cal, star_chain("star"), polarized(truth, q, u_, seed=3))
    np.testing.assert_allclose(table["q"].to_value(u.one), q, atol=1e-3)
    np.testing.assert_allclose(table["u"].to_value(u.one), u_, atol=1e-3)
    np.testing.assert_allclose(table["dolp"].to_value(u.one), np.hypot(q, u_), atol=1e-3)
    angle = np.mod(np.rad2deg(0.5 * np.arctan2(u_, q)), 180)
    np.testing.assert_allclose(table["aolp"].to_value(u.deg), angle, atol=1.5)
    assert table["n_cycles"].tolist() == [6, 6, 6]
    assert table["q_cycles"].shape == (3, 6)


def test_errors_are_the_scatter_of_the_cycles(simulated):
    cal, truth = simulated
    zero = np.zeros(3)
    table = star_stokes(cal, star_chain("star"), polarized(truth, zero, zero, seed=4))
    scatter = np.std(table["q_cycles"], axis=1) / np.sqrt(5)
    assert u.allclose(table["q_err"], scatter)
    assert (np.abs(table["q"]) < 6 * table["q_err"]).all()


def test_cycle_that_is_masked_does_not_count(simulated):
    cal, truth = simulated
    zero = np.zeros(3)
    star = polarized(truth, zero, zero, seed=4).with_mask(np.arange(24) == 5, "cloud")
    table = star_stokes(cal, star_chain("star"), star)
    assert table["n_cycles"].tolist() == [5, 5, 5]
    assert np.isnan(table["q_cycles"][:, 1]).all()


def test_accuracy_of_a_known_star():
    table = QTable({"wavelength": [1.2, 1.6] * u.um})
    for key, values in {"q": [1.1, 0.1], "u": [0.0, 0.0]}.items():
        table[key] = values * u.percent
        table[f"{key}_cycles"] = (np.array(values)[:, None] + [[-0.1, 0.1]] * 2) * u.percent
    known = star_accuracy(table, q=[0.01, 0.0])
    assert u.allclose(known["dolp_error"], [0.1, 0.1] * u.percent)
    assert known["aolp_error"][0] == 0 * u.deg
    assert np.isnan(known["aolp_error"][1])
    # along q the cycles are off by 0 and 0.2; where nothing is known, by both components
    np.testing.assert_allclose(known["s_dolp"][0].to_value(u.percent), np.sqrt(0.02))
    np.testing.assert_allclose(known["s_u"].to_value(u.percent), 0.1)


@pytest.mark.slow
def test_a_star_that_is_not_as_the_catalogue_says_is_told_by_what_it_moves():
    """Its prior of 0 +- 0.025 % pulls at M3; the field turns, so that the data exclude it."""
    source, kept = "unpolarized standard star", {"m3.diattenuation", "m3.theta"}
    for q, usable in ((0.0, True), (0.003, False)):
        truth, chain = (star_chain(source, target="HD 14069") for _ in range(2))
        truth["m3"].diattenuation, truth["star"].q = [0.017, 0.014, 0.012], q
        for leaf in leaves(chain):
            for key in leaf.param_names:
                if leaf.name != "star" and f"{leaf.name}.{key}" not in kept:
                    getattr(leaf, key).fixed = True
        data = observe_star(truth, 12, target="HD 14069", flux=1e6, seed=1)
        cal = calibrate(chain, data, cross_validate=False)
        told, against = cal.verdict(), cal.fit["against_prior"]
        assert told.usable == (against is None) == usable, (q, told, against)
        if not usable:
            assert against["parameter"] == "star.q"
            assert against["sigma"] > 4
            assert against["moves"]["parameter"].startswith("m3.")
            assert told.reasons[0].startswith("star.q is ")
            assert "star's name" in told.advice


@pytest.mark.slow
def test_an_angle_that_moved_between_lamp_and_star_is_named_and_counts_in_the_errors():
    grid, light = [1200, 1400, 1600, 1900, 2200] * u.nm, (30 * u.percent, None)
    frames = half_wave_plate_cycles(derotator=[45, 57.5, 70, 82.5, 95, 107.5, 120] * u.deg)
    source, nominal = (
        CHARIS.chain("polarized", ["nbs"], wavelength=grid),
        star_chain(wavelength=grid),
    )
    chains, errors = [source, nominal], []
    lamp = simulate(source, grid, frames, flux=1e7, seed=3, meta={"source": "polarized"})
    for move in (0.0, 2.0):
        star = nominal.copy()
        star["m3"].diattenuation = [0.017, 0.016, 0.015, 0.013, 0.012]
        star["derotator"].theta.value += move
        night = observe_star(star, 12, wavelength=grid, flux=1e7, seed=4)
        cal = calibrate(chains, [lamp, night], search=False, cross_validate=False)
        (accuracy,) = target_accuracies(cal, [light])
        errors.append(np.median(accuracy["s_p"].value))
        told, found = cal.verdict(), cal.fit["disagreements"]
        assert told.usable, told
        assert bool(found) == bool(move), found
        if move:
            assert found[0]["parameter"] == "derotator.theta"
            assert abs(found[0]["change_deg"] - move) < 3 * found[0]["std_deg"]
            assert "derotator.theta differs in star by" in told.words[0]
            named = "did derotator.theta move between datasets? --own derotator.theta gives each"
            assert told.advice.endswith(f"{named} its own")
    assert errors[1] > 5 * errors[0], errors


def test_what_turned_between_datasets_is_named_as_surely_as_noise_allows():
    chain = CHARIS.chain("polarized", derotator="linear", wavelength=CHARIS.wavelength[[2, 11, 20]])
    frames = half_wave_plate_cycles(derotator=np.linspace(45, 122, 8) * u.deg)
    for optic in ("hwp", "calibration_polarizer"):
        runs, second = [], chain.copy()
        second[optic].theta.value += 0.3
        for seed, true in enumerate((chain, second)):
            run = simulate(true, CHARIS.wavelength[[2, 11, 20]], frames, seed=seed, name=f"r{seed}")
            runs.append(run)
        cal = calibrate([chain, chain], runs, search=False, cross_validate=False)
        # what a change adds to the residuals is no noise by which it could be judged
        assert cal.fit["disagreements"][0]["sigma"] > 20, optic
        assert f"{optic}.theta" in cal.verdict().advice, optic


def test_chain_without_a_star_is_an_error(simulated):
    cal, truth = simulated
    with pytest.raises(ChainError, match="begins with a PolarizedSource"):
        star_stokes(cal, CHARIS.chain(), observe_star(truth, 2, noise=False))


def test_a_star_is_as_many_errors_off_whether_it_is_polarized_or_not():
    """Without polarization it is q and u that are off, and no star was right within its errors."""
    rng, off, n = np.random.default_rng(3), [], 400
    for degree in (1.0, 0.0):
        errors = rng.standard_normal((n, 2))
        table = QTable({"wavelength": np.linspace(1.2, 2.2, n) * u.um})
        for key, value, error in zip("qu", (degree, 0.0), errors.T, strict=True):
            table[key] = (value + 0.1 * error) * u.percent
            table[f"{key}_cycles"] = table[key][:, None]
        table.update(star_accuracy(table, q=degree / 100))
        for key, value in {"_known": degree, "_err": 0.08, "_sys_err": 0.06}.items():
            table[f"dolp{key}"] = np.full(n, value) * u.percent
        table["dolp_known_err"] = np.full(n, np.nan) * u.percent
        off.append([float(_pull(table[[i]], "dolp").split()[0]) for i in range(n)])
    rms = np.sqrt(np.mean(np.square(off), axis=1))
    np.testing.assert_allclose(rms, 1, atol=0.1)


def test_polarized_standard_is_predicted_from_the_catalogue(simulated):
    cal, truth = simulated
    chain = star_chain("polarized standard star", target="HD 30675", star="star_HD30675")
    star = chain["star_HD30675"]
    seen = replace_optic(truth, "star", star.copy())
    table = observe_star(seen, 4, source="polarized standard star", target="HD 30675", seed=2)
    found = standard_accuracy(cal, chain, table)
    assert found["s_standard"].max() < 0.1 * u.percent
    assert "star_HD30675" in found.meta["not_calibrated"]


def test_star_that_nothing_is_known_of_is_no_standard(simulated):
    cal, truth = simulated
    star = polarized(truth, np.zeros(3), np.zeros(3), seed=4)
    with pytest.raises(FitError, match=r"nothing determines star_b.q, star_b.u"):
        standard_accuracy(cal, star_chain("star", star="star_b"), star)


def test_predicted_star_gives_s_sky_where_none_was_fitted():
    from astropolcal.calibration import add_standard

    source, star = (
        CHARIS.chain("polarized", ["dichroic", "nbs"], wavelength=WAVELENGTH),
        star_chain(),
    )
    frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    lamp = simulate(source, WAVELENGTH, frames, seed=1, meta={"source": "polarized"})
    cal = calibrate(source, lamp, cross_validate=False)
    star["m3"].diattenuation.fixed = True
    (before,) = paper_accuracies(cal, [(1 * u.percent, None)])
    table = add_standard(cal, star, observe_star(star, 6, seed=2))
    (after,) = paper_accuracies(cal, [(1 * u.percent, None)])
    assert before.meta["missing"] == ["unpolarized", "on_sky"]
    assert after.meta["missing"] == ["unpolarized"]
    assert u.allclose(after["s_sky"], table["s_standard"] / np.sqrt(12))


# --- real: the joint fit of the paper's datasets ----------------------------------------------


@pytest.fixture(scope="module")
def prepared(charis_data):
    def read(*names):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropolcalWarning)
            return [CHARIS.prepare(charis_data(name)) for name in names]

    return read


@pytest.fixture(scope="module")
def joint(prepared):
    data = prepared("dataset3", "dataset4", "hd293396")
    return calibrate(CHARIS.chains_for(data), data, instrument="charis")


@pytest.mark.slow
def test_diattenuation_of_m3_falls_from_1_6_to_1_2_percent(joint, prepared):
    """If the star were exactly unpolarized; as nobody knows that, it is up to 0.2 % less."""
    data = prepared("dataset3", "dataset4", "hd293396")
    chains = CHARIS.chains_for(data)
    exact = {
        f"star_HD293396.{key}{suffix}": None
        for key in "qu"
        for suffix in ("", "_slope", "_curvature")
    }
    held = calibrate(chains, data, fix=exact, instrument="charis", cross_validate=False)
    found = 100 * held.parameter_values()["m3.diattenuation"]["value"]
    slope, middle = np.polyfit(np.linspace(-1, 1, 22), found, 1)
    assert middle - slope == pytest.approx(1.62, abs=0.06)
    assert middle + slope == pytest.approx(1.19, abs=0.06)
    assert np.std(found - np.polyval([slope, middle], np.linspace(-1, 1, 22))) < 0.08
    free = joint.parameter_values()["m3.diattenuation"]
    pulls = (100 * free["value"] - found) / (100 * free["std"])
    assert np.abs(pulls).max() < 2.5
    assert np.median(free["std"]) > 5e-4


@pytest.mark.slow
def test_residuals_are_below_those_of_the_published_law(joint, prepared):
    (star,) = prepared("hd293396")
    ours = joint.residuals[joint.measurement.segments[2]]
    chain = replace_optic(joint.chains[2], "m3", published_mirror())
    theirs = Measurement(chain, star).residuals()
    assert np.sqrt(np.mean(ours**2)) < np.sqrt(np.mean(theirs**2))


@pytest.mark.slow
def test_fold_mirror_is_within_the_published_range(joint, shared_data):
    """Four values a wavelength are published, which differ by up to 0.2 %."""
    from astropy.table import Table

    table = Table.read(shared_data / "reference" / "charis_fold_mirror.ecsv")
    found = joint.parameter_values()["fold_mirror.diattenuation"]["value"]
    for b, value in enumerate(found):
        published = table["fold_mirror_diattenuation"][table["bin"] == b]
        assert published.min() - 5e-4 < value < published.max() + 5e-4
    ours = np.median(joint.datasets[1].accuracy["s_mean"].to_value(u.percent))
    assert ours < 0.6 * np.median(table["s_unpol"])


@pytest.mark.slow
def test_accuracy_for_a_target_is_the_papers(joint):
    """Paper, Fig. of s_p: 0.02 to 0.12 % for a target of 1 %."""
    (table,) = paper_accuracies(joint, [(1 * u.percent, 50 * u.deg)])
    s_p = table["s_p"].to_value(u.percent)
    assert table.meta["missing"] == []
    assert np.median(s_p) < 0.03
    assert s_p.max() < 0.12


@pytest.mark.slow
def test_frames_left_out_are_stated_beside(joint):
    star = joint.datasets[2].accuracy
    s_cv, s_res = (np.median(star[key].to_value(u.percent)) for key in ("s_cv", "s_res"))
    assert 0.8 * s_res < s_cv < 1.3 * s_res


@pytest.mark.slow
def test_unpolarized_star_is_what_the_fit_has_found_of_it(joint, prepared):
    (star,) = prepared("hd293396")
    (chain,) = CHARIS.chains_for([star])
    table = star_stokes(joint, chain, star)
    (found,) = fitted_stars(joint)
    for key in "qu":
        assert np.median(np.abs(table[key] - found[key])) < 0.04 * u.percent
        # two catalogue errors
        assert np.abs(found[key]).max() < 0.5 * u.percent
        assert (found[f"{key}_err"] < 0.75 * found[f"{key}_prior_err"]).all()
    assert 0.4 < found.meta["from_data"] <= 1
    assert table["n_cycles"].max() == 23


@pytest.mark.slow
def test_four_numbers_of_the_power_law_are_not_determined(prepared):
    (star,) = prepared("hd293396")
    (chain,) = CHARIS.chains_for([star], m3="power law")
    for leaf in leaves(chain):
        if leaf.name != "m3":
            for key in leaf.param_names:
                getattr(leaf, key).fixed = True
    cal = calibrate(chain, star, cross_validate=False)
    values = cal.parameter_values()
    known = [
        bool(values[f"m3.{key}"]["std"] < 0.5)
        for key in ("b1", "m1", "b2", "m2")
    ]  # fmt: skip
    assert sum(known) <= 2
    assert cal.identifiability.near_null or cal.at_bound or cal.identifiability.null_directions


# --- real: the polarized standard that no fit saw ---------------------------------------------


@pytest.fixture(scope="module")
def february(prepared):
    """Dataset 1, and the unpolarized star of the same weeks as HD 30675."""
    data = prepared("dataset1", "hd35532")
    return calibrate(CHARIS.chains_for(data), data, instrument="charis", cross_validate=False)


@pytest.mark.slow
def test_polarized_standard_comes_out(february, joint, prepared):
    """
    The paper's appendix: DoLP residual below 0.3 % in J and H. No fit has seen it.

    Its angle is that of the catalogue within 1.5 times the errors stated, with calibrations of
    July and of October.
    """
    (star,) = prepared("hd30675")
    (chain,) = CHARIS.chains_for([star])
    for calibration in (february, joint):
        found = star_check(calibration, chain, star)
        in_j_and_h = star.wavelength < 1.81 * u.um
        assert np.abs(found["dolp_error"][in_j_and_h]).max() < 0.3 * u.percent
        stated = {
            key: np.sqrt(
                sum(found[f"{key}{part}"] ** 2 for part in ("_err", "_sys_err", "_known_err"))
            )
            for key in ("dolp", "aolp")
        }
        assert np.abs(np.median(found["aolp_error"] / stated["aolp"])) < 1.5
        assert np.abs(found["aolp_error"] / stated["aolp"]).max() < 2.5
        # beyond 1.8 um the star has more than its law
        assert np.abs(found["dolp_error"] / stated["dolp"])[in_j_and_h].max() < 2.5
        # with the plate where chi-square, by scatter, is 2.2 higher, the angle is 12 to 14 deg off
        assert (found["aolp_sys_err"] < 12 * u.deg).all()


@pytest.mark.slow
def test_polarized_standard_is_predicted(february, prepared):
    (star,) = prepared("hd30675")
    (chain,) = CHARIS.chains_for([star])
    found = standard_accuracy(february, chain, star)
    in_j_and_h = star.wavelength < 1.81 * u.um
    assert np.median(found["s_standard"][in_j_and_h]) < 0.3 * u.percent
    assert february.datasets[1].content_hash != star.content_hash
