# Licensed under a 3-clause BSD style license - see LICENSE
"""Sequential calibration, joint calibration of lamps and stars, and robust losses."""

from dataclasses import replace
from functools import cache

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from star_data import CHARIS, META, WAVELENGTH, observe_star, star_chain

from astropolcal import Calibration, calibrate, optics
from astropolcal.calibration.noise import outlying_data
from astropolcal.calibration.noise.scatter import kind_of_source
from astropolcal.calibration.noise.weighting import LOSSES
from astropolcal.chain import replace_optic
from astropolcal.exceptions import FitError
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

DEROTATOR = [45, 57.5, 82.5, 107.5, 132.5] * u.deg
OPTICS = ["dichroic", "nbs"]
M3, FOLD = [0.017, 0.014, 0.012], [0.012, 0.010, 0.008]


def truth(chain):
    """Values away from where the fit starts, in all chains alike."""
    chain = chain.copy()
    chain["hwp"].w_sio2, chain["hwp"].w_mgf2 = 1.6542 * u.mm, 1.2919 * u.mm
    chain["wollaston"].efficiency = [0.97, 0.98, 0.975]
    for name, key, value in (
        ("m3", "diattenuation", M3),
        ("fold_mirror", "diattenuation", FOLD),
        ("calibration_polarizer", "theta", 90.4 * u.deg),
    ):
        if name in chain.submodel_names:
            setattr(chain[name], key, value)
    return chain


def chains(**options):
    options = {"wavelength": WAVELENGTH, "derotator": "linear"} | options
    made = [CHARIS.chain(s, OPTICS, **options) for s in ("polarized", "unpolarized")]
    made.append(star_chain(**{k: v for k, v in options.items() if k != "wavelength"}))
    for chain in made:
        # the gauge is not what is tested here
        chain["derotator"].theta.fixed = True
    return made


def lamps(start, seed=0, **options):
    frames = half_wave_plate_cycles(derotator=DEROTATOR)
    return [
        simulate(truth(chain), WAVELENGTH, frames, seed=seed + i, name=source,
                 meta=META | {"source": source}, **options)
        for i, (chain, source) in enumerate(zip(start, ("polarized", "unpolarized"), strict=False))
    ]  # fmt: skip


@pytest.fixture(scope="module")
def data():
    start = chains()
    star = observe_star(truth(start[2]), 12, seed=5)
    return start, [*lamps(start), star]


@pytest.fixture(scope="module")
def fitted(data):
    return {
        strategy: calibrate(*data, strategy=strategy, instrument="charis", cross_validate=False)
        for strategy in ("joint", "sequential")
    }


# --- what calibrates what -------------------------------------------------------------------------


def test_kind_of_a_source():
    for source, kind in [
        ("polarized", "polarized"),
        ("unpolarized", "unpolarized"),
        ("unpolarized standard star", "star"),
        ("polarized standard star", "star"),
        (None, "polarized"),
    ]:
        assert kind_of_source(source) == kind, (source, kind)


# --- joint and sequential -------------------------------------------------------------------------


def test_truth_comes_back(fitted):
    for strategy in ["joint", "sequential"]:
        values = fitted[strategy].parameter_values()
        assert fitted[strategy].converged, strategy
        for name, expected in (("m3.diattenuation", M3), ("fold_mirror.diattenuation", FOLD)):
            np.testing.assert_allclose(values[name]["value"], expected, atol=3e-4)
        assert values["calibration_polarizer.theta"]["value"] == pytest.approx(90.4, abs=0.1), (
            strategy
        )


def test_joint_fit_has_one_covariance_of_all(fitted):
    names = fitted["joint"].covariance.names
    for stem in ("m3.diattenuation[0]", "fold_mirror.diattenuation[0]", "hwp.w_sio2"):
        assert stem in names
    errors = dict(zip(names, fitted["joint"].covariance.stds, strict=True))
    assert 0 < errors["m3.diattenuation[0]"] < 3e-4


def test_steps_are_told_in_the_papers_order(fitted):
    stages = fitted["sequential"].stages
    assert [stage["title"].split(",")[0] for stage in stages] == [
        "polarized", "unpolarized", "star",
    ]  # fmt: skip
    assert set(stages[1]["parameters"]) == {"fold_mirror.diattenuation", "fold_mirror.theta"}
    assert {"m3.diattenuation", "m3.theta"} <= set(stages[2]["parameters"])


def test_later_steps_hold_what_came_before(data, fitted):
    start, observations = data
    alone = calibrate(start[0], observations[0], cross_validate=False)
    both = [cal.parameter_values() for cal in (alone, fitted["sequential"])]
    for name in ("derotator.retardance", "wollaston.efficiency"):
        np.testing.assert_allclose(*(v[name]["value"] for v in both), atol=1e-5)


def test_fits_in_steps_say_how_far_off_the_minimum_they_are(data):
    start, observations = data
    joint, steps = (
        calibrate(start[0], observations[0], strategy=s, search=True, cross_validate=False)
        for s in ("joint", "two-step")
    )
    assert joint.fit["off_minimum"]["errors"] < 0.1
    off = [cal.measurement.vector() / cal.measurement.free.factors() for cal in (joint, steps)]
    off = np.abs(off[1] - off[0]) / steps.covariance.stds
    told, i = steps.fit["off_minimum"], np.argmax(off)
    assert told["parameter"] == steps.covariance.names[i]
    assert told["errors"] == pytest.approx(off[i], rel=0.2)
    cautions = "; ".join(steps.verdict().cautions)
    assert (f"{told['parameter']} is {told['errors']:.2g} errors off" in cautions) == (off[i] > 0.5)
    assert "off the minimum" not in str(joint.verdict().cautions)


def test_two_steps_of_one_wavelength_are_those_that_have_parameters():
    start = CHARIS.chain(derotator="linear", wavelength=[1.6] * u.um)
    plate = optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
    start = replace_optic(start, "hwp", plate)
    frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    table = simulate(start, [1.6] * u.um, frames, seed=1)
    found = [calibrate(start, table, strategy=s, search=False, cross_validate=False)
             for s in ("joint", "two-step")]  # fmt: skip
    np.testing.assert_allclose(*(cal.measurement.vector() for cal in found), rtol=1e-6)
    assert [len(stage["parameters"]) > 0 for stage in found[1].stages] == [False, True, False]


def test_order_of_the_datasets_does_not_matter(data, fitted):
    start, observations = data
    turned = calibrate(start[::-1], observations[::-1], strategy="sequential", cross_validate=False)
    both = [cal.parameter_values() for cal in (turned, fitted["sequential"])]
    for name in both[0]:
        np.testing.assert_allclose(*(v[name]["value"] for v in both), rtol=1e-4, atol=1e-6)


def test_sequential_fit_takes_no_noise_for_all_data(data):
    with pytest.raises(FitError, match="strategy='sequential' fits the datasets one by one"):
        calibrate(*data, strategy="sequential", weights=1e-3)


def test_joint_result_survives_its_file(fitted, data, tmp_path):
    fitted["joint"].write(tmp_path / "joint.asdf")
    again = Calibration.read(tmp_path / "joint.asdf").with_observations(data[1])
    np.testing.assert_allclose(again.residuals, fitted["joint"].residuals, atol=1e-12)


def test_tables_as_written_are_masked_again_when_they_come_back(tmp_path):
    start = chains()[:2]
    frames = 8 * len(DEROTATOR)
    lamp = np.where(np.arange(frames) < 4, 0.3, 1.0)
    lamp[:8] *= np.linspace(0.5, 0.9, 8)
    raw = lamps(start, lamp=lamp)
    with pytest.warns(match="unstable lamp"):
        tables = [CHARIS.prepare(table) for table in raw]
    cal = calibrate(start, tables, instrument="charis", cross_validate=False)
    cal.write(tmp_path / "masked.asdf")
    again = Calibration.read(tmp_path / "masked.asdf").with_observations(raw)
    assert again.residuals.size == cal.residuals.size


def _instrument_held(chain):
    """Return the chain with all that the lamps calibrate fixed, and the mirror to be found."""
    for name in ("hwp", "derotator", "wollaston"):
        for key in chain[name].param_names:
            getattr(chain[name], key).fixed = True
    chain["m3"].diattenuation = [0.01, 0.01, 0.01]
    return chain


def test_two_stars_share_the_mirror_and_not_their_polarization():
    first = star_chain(star="star_a")
    second = star_chain("star", star="star_b")
    known = np.array([0.010, 0.008, 0.006])
    seen = truth(second)
    seen["star_b"].q, seen["star_b"].u = known, -known
    first, second = (_instrument_held(truth(chain)) for chain in (first, second))
    stars = [
        observe_star(truth(first), 10, seed=1),
        observe_star(seen, 10, source="star", target="B", parallactic=(-70, 60), seed=2),
    ]
    cal = calibrate([first, second], stars, cross_validate=False)
    values = cal.parameter_values()
    np.testing.assert_allclose(values["m3.diattenuation"]["value"], M3, atol=5e-4)
    np.testing.assert_allclose(values["star_b.q"]["value"], known, atol=1e-3)
    np.testing.assert_allclose(values["star_b.u"]["value"], -known, atol=1e-3)
    # the other one is unpolarized, as far as one knows
    assert np.abs(float(values["star_a.q"]["value"])) < 3 * float(values["star_a.q"]["std"])


# --- cross-validation on sky ----------------------------------------------------------------------


def test_stars_are_left_out_in_runs_of_cycles(fitted):
    cal = fitted["joint"].cross_validate()
    for record in cal.datasets:
        s_cv, s_res = record.accuracy["s_cv"], record.accuracy["s_res"]
        assert np.isfinite(s_cv).all()
        assert (s_cv < 3 * s_res).all()


# --- robust ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def spoiled(data):
    """The star with a pair in which something passed by one beam."""
    start, observations = data
    table = observations[2].to_table()
    row = np.isin(np.asarray(table["frame"]), [20, 21])
    table["flux_right"][row] *= np.where(np.asarray(table["frame"])[row] == 20, 1.06, 0.95)
    return start, [*observations[:2], Observations.from_table(table, name="star")]


@pytest.fixture(scope="module")
def robust(spoiled):
    """Function that fits these data with a loss, once."""
    options = {"instrument": "charis", "cross_validate": False}
    return cache(lambda loss: calibrate(*spoiled, loss=loss, **options))


@pytest.mark.long
def test_robust_loss_is_not_pulled(robust):
    def error(loss):
        found = robust(loss).parameter_values()["m3.diattenuation"]["value"]
        return np.abs(found - M3).max()

    for loss in ["huber", "cauchy", "bisquare"]:
        assert error(loss) < 0.6 * error("linear"), loss


@pytest.mark.long
def test_a_robust_fit_of_good_data_is_not_surer_than_least_squares():
    """Weights that follow the residuals let a fit move more than weights that stay."""
    chain = CHARIS.chain(derotator="linear", wavelength=WAVELENGTH)
    chain["hwp"].theta.fixed = chain["derotator"].theta.fixed = True
    frames = half_wave_plate_cycles(derotator=[45, 60, 75, 95, 117] * u.deg)
    for errors in ("scatter", "white"):
        stds = {"linear": [], "huber": [], "bisquare": []}
        for seed in range(6):
            data = simulate(chain, WAVELENGTH, frames, flux=1e6, seed=seed)
            for loss, found in stds.items():
                cal = calibrate(chain, data, loss=loss, errors=errors, cross_validate=False)
                found.append(cal.covariance.stds)
        for loss in ("huber", "bisquare"):
            # in a hundred such runs errors as of weights that stay were 0.7 of the scatter
            ratio = np.median(np.divide(stds[loss], stds["linear"]))
            assert 0.9 < ratio < 1.4, (errors, loss, ratio)


def test_outlying_pair_is_reported_and_kept(robust):
    cal = robust("bisquare")
    table = outlying_data(cal)
    assert isinstance(table, QTable)
    assert table["frames"][0] == "20, 21"
    assert table["residual"].unit == u.percent
    assert table["residual"][0] > 1 * u.percent
    assert cal.datasets[2].n_masked == 0
    assert cal.settings["loss"] == "bisquare"
    assert cal.to_dict()["outliers"][0]["frames"] == "20, 21"
    words = " ".join(cal.summary(full=True).split())
    assert "frames 20, 21 of star are at odds with the fit" in words
    assert "they are not left out" in words


def test_good_data_have_no_outliers(fitted):
    assert len(outlying_data(fitted["joint"])) == 0


@pytest.mark.slow
def test_robust_noise_is_found_again_from_the_file(robust, spoiled, tmp_path):
    from astropolcal.calibration.noise.weighting import weighting_of

    cal = robust("huber")
    cal.write(tmp_path / "robust.asdf")
    again = Calibration.read(tmp_path / "robust.asdf").with_observations(spoiled[1])
    np.testing.assert_allclose(weighting_of(again).sigma, weighting_of(cal).sigma, rtol=2e-2)


def test_weights_of_the_losses():
    residuals = np.array([0.0, 0.5, 3.0, 10.0])
    assert LOSSES["linear"](residuals).tolist() == [1, 1, 1, 1]
    np.testing.assert_allclose(LOSSES["huber"](residuals), [1, 1, 1.345 / 3, 0.1345])
    assert LOSSES["bisquare"](residuals)[3] == 0
    assert np.all(np.diff(LOSSES["cauchy"](residuals)) < 0)


def test_unknown_loss_is_an_error(data, fitted):
    from astropolcal.calibration.noise.weighting import weighting_of

    message = r"loss = 'l3'; allowed are linear, huber, cauchy, bisquare"
    with pytest.raises(FitError, match=message):
        calibrate(*data, loss="l3")
    # the text of a calibration that was read from a file may be any
    cal = fitted["joint"]
    live = Measurement(cal.chains, data[1], wavelength=cal.wavelength)
    settings = cal.settings | {"weights": "given", "loss": "l3"}
    with pytest.raises(FitError, match=message):
        weighting_of(replace(cal, settings=settings, measurement=live))
