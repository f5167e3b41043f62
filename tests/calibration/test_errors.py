# Licensed under a 3-clause BSD style license - see LICENSE
"""Standard errors as published calibrations quote them."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from scipy import stats
from scipy.optimize import curve_fit

from astropolcal import Observations, instruments, optics
from astropolcal.calibration import Calibration, calibrate
from astropolcal.calibration.noise.weighting import problem_of
from astropolcal.calibration.uncertainty import standard_errors
from astropolcal.exceptions import CalibrationFileError, FitError
from astropolcal.simulation import half_wave_plate_cycles, simulate

LAM = [1.2, 1.6, 2.2] * u.um


@pytest.fixture(scope="module")
def cal(make):
    truth = make.truth(make.chain("elliptical", wavelength=LAM))
    data = make.observe(truth, wavelength=LAM, seed=1)
    return calibrate(truth, data, search=False, cross_validate=False)


def test_error_is_that_of_a_fit_of_one_wavelength(cal):
    """Against scipy's curve_fit, which has the same formula, with the common parameters known."""
    table = standard_errors(cal, method="van-holstein")
    measurement = cal.measurement
    vector = measurement.vector()
    for i in range(3):
        own = [slot.start + i for slot in measurement.free.slots if slot.per_wavelength]
        rows = measurement.bins == i

        def model(_, *values, own=own, rows=rows):
            trial = vector.copy()
            trial[own] = values
            return measurement.predict(trial)[rows]

        found, covariance = curve_fit(
            model, np.arange(rows.sum()), measurement.observed[rows], p0=vector[own]
        )
        stds = np.sqrt(np.diag(covariance))
        expected = stds / measurement.free.factors()[own]
        np.testing.assert_allclose(np.asarray(table["std"])[own], expected, rtol=0.02)
        np.testing.assert_allclose((found - vector[own]) / stds, 0, atol=1e-3)


def test_common_parameters_are_named_as_held(cal):
    table = standard_errors(cal, method="van-holstein")
    held = ["calibration_polarizer.theta", "hwp.w_sio2", "hwp.w_mgf2"]
    assert table.meta == {"method": "van-holstein", "held": held}
    known = dict(zip(table["name"], table["std"], strict=True))
    assert all(np.isnan(known[name]) for name in held)
    assert np.isfinite(known["derotator.circular[2]"])
    units = dict(zip(table["name"], table["unit"], strict=True))
    assert (units["derotator.circular[2]"], units["wollaston.efficiency[0]"]) == ("deg", "")


def test_it_is_too_small(cal):
    """What is known of the common parameters is a part of the error."""
    full, part = (
        np.asarray(standard_errors(cal, m)["std"]) for m in ("covariance", "van-holstein")
    )
    both = np.isfinite(part)
    assert np.median(part[both] / full[both]) < 0.9


def test_covariance_method_is_the_covariance(cal):
    table = standard_errors(cal)
    np.testing.assert_array_equal(table["std"], cal.covariance.stds)
    assert table.meta == {"method": "covariance", "held": []}


def test_weights_count(make):
    truth = make.truth(make.chain("linear", wavelength=LAM))
    data = make.observe(truth, wavelength=LAM, seed=1)
    plain, weighted = (
        standard_errors(
            calibrate(truth, data, weights=w, search=False, cross_validate=False), "van-holstein"
        )
        for w in (None, "errors")
    )
    ratio = np.asarray(plain["std"] / weighted["std"])
    assert np.nanmedian(ratio) == pytest.approx(1, abs=0.3)
    assert np.nanmax(np.abs(ratio - 1)) > 1e-4


def test_singular_wavelength_has_no_error(make):
    """No pseudo-inverse: two per-wavelength angles of which the data see the sum."""
    from astropolcal import optics

    angles = np.full(3, 5.0) * u.deg
    chain = (
        optics.LinearPolarizer(theta=0 * u.deg, name="polarizer")
        | optics.Rotator(theta=angles, name="first", fixed={"theta": False})
        | optics.Rotator(theta=angles, name="second", fixed={"theta": False})
        | optics.LinearRetarder(retardance=np.full(3, 170) * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.97, name="wollaston", fixed={"efficiency": True})
    )
    data = make.observe(chain, wavelength=LAM, seed=1)
    cal = calibrate(chain, data, search=False, cross_validate=False)
    table = standard_errors(cal, "van-holstein")
    known = dict(zip(table["name"], table["std"], strict=True))
    assert all(np.isnan(known[f"{name}.theta[1]"]) for name in ("first", "second"))
    assert np.isfinite(known["hwp.retardance[1]"])


@pytest.mark.slow
def test_bad_input_is_refused(cal, tmp_path):
    with pytest.raises(
        FitError, match="method = 'jackknife'; allowed are covariance, white, robust, van-"
    ):
        standard_errors(cal, "jackknife")
    cal.write(tmp_path / "cal.asdf")
    again = Calibration.read(tmp_path / "cal.asdf")
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        standard_errors(again, "van-holstein")
    assert len(standard_errors(again)) == len(standard_errors(cal))


def test_half_a_wave_hides_no_error():
    """The derivative to a retardance vanishes there, and what trades with it is not known well."""
    chain = (
        optics.LinearPolarizer(name="lamp")
        | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    angle = np.array([0.0, 36, 38, 40, 42, 44, 46, 48, 50, 52])
    data = simulate(chain, [0.6] * u.um, QTable({"hwp": angle * u.deg}), noise=False, flux=1e6)
    kept = data.to_table()
    kept["flux_right_err"] = kept["flux_left_err"] = 500 * kept["flux_right"].unit
    data = Observations.from_table(kept)
    single = {"observable": "normalized_single_difference", "weights": "errors"}
    found = calibrate(chain, data, cross_validate=False, errors="white", **single)
    # x = efficiency ((1 + c) / 2 + (1 - c) / 2 cos 4 angle), with c the cosine of the retardance
    wave = np.cos(4 * np.deg2rad(angle))
    sigma = np.sqrt(500**2 * 2 * (1 + (0.98 * wave) ** 2)) / 5e5
    slopes = np.stack([wave, 0.98 * (1 - wave) / 2]) / sigma
    of_efficiency, of_cosine = np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T)))
    alone = 1 / np.linalg.norm(slopes[0])
    assert of_efficiency > 1.5 * alone
    values = found.parameter_values()
    assert values["wollaston.efficiency"]["std"] == pytest.approx(of_efficiency, rel=0.05)
    # it stands far nearer to half a wave than where the cosine changes by its error
    there = 180 - np.rad2deg(np.arccos(of_cosine - 1))
    assert abs(values["hwp.retardance"]["value"] - 180) < 0.05 * there
    assert values["hwp.retardance"]["std"] > there
    assert values["hwp.retardance"]["status"] == "badly determined"


def test_two_errors_from_few_degrees_of_freedom_are_95_percent_of_students_t():
    """With three of them one in seven would be beyond two errors of a noise that is known."""
    source = optics.Diattenuator(diattenuation=0.2, theta=10 * u.deg, name="source")
    prism = optics.WollastonPrism(name="wollaston")
    source.diattenuation.fixed = prism.efficiency.fixed = True
    chain = source | optics.LinearRetarder(retardance=150 * u.deg, mount="hwp", name="hwp") | prism
    for count, freedom in ((8, 3), (80, 39)):
        frames = QTable({"hwp": np.arange(3, 93, 90 / count) * u.deg})
        data = simulate(chain, [1.5] * u.um, frames, flux=1e5, seed=1)
        for weights, expected in ((None, stats.t.ppf(0.975, freedom) / 1.96), ("errors", 1)):
            cal = calibrate(chain, data, weights=weights, errors="white", cross_validate=False)
            problem = problem_of(cal)
            plain = problem.weighting.level * np.sqrt(problem.around().covariance()[0, 0])
            # five percent are no matter
            times = np.deg2rad(cal.covariance.stds[0]) / plain
            assert times == pytest.approx(max(1, expected / 1.05)), (count, weights)


@pytest.mark.slow
def test_errors_know_of_a_lamp_that_changes_within_pairs():
    """It flickers and drifts by ten percent; what takes the sum of each frame is free of it."""
    charis, grid = instruments.get("charis"), np.linspace(1160, 2370, 6) * u.nm
    sources, moved = ("polarized", "unpolarized"), []
    chains = [charis.chain(one, derotator="linear", wavelength=grid) for one in sources]
    for seed in (6, 7):
        rng = np.random.default_rng(seed)
        frames = half_wave_plate_cycles(
            derotator=rng.permutation(np.linspace(45, 132.5, 5)) * u.deg
        )
        data = []
        for i, (chain, source) in enumerate(zip(chains, sources, strict=True)):
            drift = 0.05 * (-1) ** i * np.linspace(-1, 1, len(frames))
            light = {"flux": 1e7, "lamp": np.exp(rng.normal(0, 0.005, len(frames)) + drift)}
            told = {"seed": 10 * seed + i, "name": source, "meta": {"source": source}}
            data.append(simulate(chain, grid, frames, **light, **told))
        for observable in ("normalized_double_difference", "per_frame_double_difference"):
            found = calibrate(chains, data, observable=observable, cross_validate=False)
            off = abs(found.chains[0]["hwp"].theta.quantity - chains[0]["hwp"].theta.quantity)
            assert off < 2.5 * found.covariance.std("hwp.theta"), (seed, observable)
            moved.append(found.fit["lamp_moves"]["errors"])
            said = any("as bright as" in words for words in found.verdict().cautions)
            assert said == (observable == "normalized_double_difference"), (seed, observable)
    assert min(moved[::2]) > 2
    assert max(moved[1::2]) < 1e-6


@pytest.mark.slow
def test_a_brightness_that_a_free_parameter_explains_is_no_lamp():
    """A mirror's diattenuation moved the efficiency by 2 to 8 errors, which grew as much."""
    grid, optic = np.linspace(1.2, 2.2, 5) * u.um, np.ones(5)
    polarizer = optics.LinearPolarizer(theta=20 * u.deg, fixed={"theta": True}, name="polarizer")
    plate = optics.LinearRetarder(retardance=175 * optic * u.deg, mount="hwp", name="hwp")
    mirror = optics.DiattenuatorRetarder(
        diattenuation=0.3 * optic, retardance=160 * optic * u.deg, theta=30 * u.deg, name="mirror"
    )
    rotator = optics.LinearRetarder(
        retardance=170 * optic * u.deg, mount="derotator", name="derotator"
    )
    prism = optics.WollastonPrism(efficiency=0.98 * optic, name="wollaston")
    chain = polarizer | plate | mirror | rotator | prism
    chain["mirror"].theta.fixed, chain["hwp"].theta.fixed = True, False
    frames = half_wave_plate_cycles(derotator=[40, 55, 70, 85, 100] * u.deg)
    for seed in range(3):
        found = calibrate(chain, simulate(chain, grid, frames, flux=1e6, seed=seed))
        assert found.fit["lamp_moves"]["errors"] < 1, seed
        assert not any("as bright as" in words for words in found.verdict().cautions)
