# Licensed under a 3-clause BSD style license - see LICENSE
"""Parameters that follow models of time, field and wavelength, and several nights in one fit."""

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import models
from astropy.time import Time
from scipy.stats import norm

from astropolcal import Calibration, calibrate, optics
from astropolcal.chain import (
    at_positions,
    follow,
    join,
    leaves,
    remove_optic,
    stages,
    system_mueller,
    system_mueller_derivatives,
    with_beam,
)
from astropolcal.correction import ScienceFrames, correct, measurement_rows
from astropolcal.exceptions import (
    AstropolcalWarning,
    CalibrationFileError,
    ChainError,
    ObservationError,
    ParameterError,
)
from astropolcal.gap import diagnose
from astropolcal.measurement import Measurement, Normal, Tie
from astropolcal.observations import Observations
from astropolcal.pipeline import load, restart
from astropolcal.propagation import Propagator
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.units import canonical_factor

WAVELENGTH = [1.2, 1.6, 2.0] * u.um
SINCE = "2026-01-01"
LINE, PLANE = models.Polynomial1D(1), models.Polynomial2D(1)
ARRAY = {"weights": "errors", "errors": "white", "cross_validate": False, "search": False}


@pytest.fixture
def still():
    """A polarizer that may turn, a plate, a derotator and a prism, with nothing that changes."""
    return join(
        [
            optics.LinearPolarizer(name="polarizer", fixed={"theta": False}),
            optics.LinearRetarder(retardance=[170, 173, 176] * u.deg, mount="hwp", name="hwp"),
            optics.LinearRetarder(retardance=100 * u.deg, mount="derotator", name="derotator"),
            optics.WollastonPrism(efficiency=0.98, name="wollaston"),
        ]
    )


@pytest.fixture
def frames():
    """Eight cycles of the plate in 100 days, all over the field."""
    table = half_wave_plate_cycles(derotator=np.linspace(40, 140, 8) * u.deg)
    rng = np.random.default_rng(0)
    table["time"] = Time(SINCE) + np.repeat(np.linspace(0, 100, 8), 8) * u.day
    for name in ("x", "y"):
        table[name] = rng.uniform(-5, 5, len(table)) * u.arcsec
    return table


def law_of_time(chain, name="polarizer.theta", model=LINE):
    return follow(chain, name, model, "time", since=SINCE)


def everything(chain):
    """Laws of all kinds of inputs in one chain."""
    chain = law_of_time(chain, model=models.Polynomial1D(2, c1=0.02, c2=1e-4))
    chain = follow(chain, "derotator.retardance", models.Polynomial2D(1, c1_0=0.3), ("x", "y"))
    wave = models.Sine1D(0.01, 0.01, 0.1, fixed={"frequency": True}) + models.Linear1D(1e-4, 0)
    chain = law_of_time(chain, "wollaston.efficiency", wave)
    # the slope of each wavelength is its own
    slopes = models.Polynomial1D(1, c1=[0.01, 0.02, 0.03])
    return follow(chain, "hwp.retardance", slopes, "derotator")


# --- what a law is ------------------------------------------------------------------------------


def test_coefficients_are_parameters_of_the_optic(still):
    law = models.Polynomial1D(2, c1=3.6525 * u.deg / u.year, bounds={"c1": (-365.25, 365.25)})
    chain = law_of_time(still, model=law)
    polarizer = chain["polarizer"]
    assert polarizer.param_names == ("theta", "theta_c0", "theta_c1", "theta_c2")
    assert polarizer.theta_c1.unit == u.deg / u.day
    assert polarizer.theta_c1.value == pytest.approx(0.01)
    # those of the user are in his unit
    np.testing.assert_allclose(polarizer.theta_c1.bounds, [-1, 1])
    assert polarizer.theta_c2.unit == u.deg / u.day**2
    assert [getattr(polarizer, name).fixed for name in polarizer.param_names] == [0, 1, 0, 0]
    assert polarizer.theta.law(10 * u.day).to_value(u.deg) == pytest.approx(0.1)
    assert still["polarizer"].theta.law is None
    assert stages(chain) == ("time", "hwp", "derotator")
    polarizer.theta_c1 = 1 * u.arcmin / u.day
    found = chain.copy()["polarizer"].theta.law(60 * u.day)
    assert found.to_value(u.deg) == pytest.approx(1)


def test_constant_of_a_law_is_held(still):
    for model, held in [
        (LINE, ["c0"]),
        (models.Linear1D(), ["intercept"]),
        (models.Chebyshev1D(2, domain=(0, 100)), ["c0"]),
        (models.Const1D(), ["amplitude"]),
        (LINE + models.Sine1D(), ["c0_0"]),
        (models.Sine1D(), []),
        (models.Box1D(1, 550, 1000, fixed={"x_0": True}), ["x_0"]),
    ]:
        polarizer = law_of_time(still, model=model)["polarizer"]
        names = [name for name in polarizer.param_names if getattr(polarizer, name).fixed]
        assert names == [f"theta_{name}" for name in held], model


def test_the_constant_of_a_law_of_wavelength_may_be_any_turn():
    """Of -200 deg/um and 180 deg at 1.7 um it is 520 deg, beyond the bounds of a retardance."""
    still = optics.LinearRetarder(retardance=170 * u.deg, name="plate", bounds={"theta": (-5, 5)})
    for name, of, expected in (
        ("retardance", "wavelength", (None, None)),
        ("retardance", "x", still.retardance.bounds),
        ("theta", "wavelength", (-5, 5)),
    ):
        found = follow(still, f"plate.{name}", models.Polynomial1D(1), of)
        assert getattr(found, name).bounds == expected, (name, of)


def test_law_is_added_where_its_inputs_are(still):
    chain = law_of_time(still, model=models.Polynomial1D(1, c1=0.5))
    for when in ("2026-01-21", Time("2026-01-21", scale="tai"), 61061.0, 61061 * u.day):
        turned = at_positions(chain, time=when)["polarizer"]
        expected = optics.LinearPolarizer(theta=10 * u.deg).mueller()
        np.testing.assert_allclose(turned.mueller(), expected, atol=1e-5)
    # nothing is said of the time
    plain = optics.LinearPolarizer().mueller()
    np.testing.assert_array_equal(chain["polarizer"].mueller(), plain)
    with pytest.raises(
        ChainError, match=r"polarizer\.theta follows a law of 'time', but positions"
    ):
        system_mueller(with_beam(chain, "left"), WAVELENGTH, {"hwp": 0 * u.deg})


def test_law_of_the_stage_of_its_optic():
    plate = optics.LinearRetarder(retardance=90 * u.deg, mount="-hwp", name="plate")
    chain = follow(plate, "plate.retardance", models.Sine1D(10, 1 / 360), "hwp")
    for angle in (30 * u.deg, 0.4 * u.rad, [[10], [80]] * u.deg):
        there = at_positions(chain, hwp=angle)
        other = chain.copy()
        other.position = angle
        for found in (chain.mueller(position=angle), other.mueller()):
            np.testing.assert_array_equal(found, there.mueller())
        for key, slope in chain.mueller_derivatives(position=angle).items():
            np.testing.assert_array_equal(slope, there.mueller_derivatives()[key])
    still = optics.LinearRetarder(retardance=95 * u.deg, theta=-30 * u.deg).mueller()
    np.testing.assert_allclose(chain.mueller(position=30 * u.deg), still, atol=1e-15)


def test_copies_with_other_values_follow_the_same_law(still):
    plate = everything(still)["hwp"]
    other = plate.with_parameters(retardance=5 * u.deg, retardance_c1=0.1)
    assert other.retardance.law(10 * u.deg) == 1 * u.deg
    assert other.param_names == plate.param_names
    plate.retardance.wavelength = plate.retardance_c1.wavelength = WAVELENGTH
    between = plate.resampled([1.4] * u.um)
    assert between.retardance_c1.value == pytest.approx(0.015)


# --- every optic, and every parameter -----------------------------------------------------------


def example(cls, key):
    """An optic in a chain whose parameter follows a law of time and wavelength."""
    mounts = {"FluxGain": "flux", "StrayLight": "total_flux", "PolarizedBackground": "total_flux"}
    if cls.__name__.startswith("State"):
        mount = "state=B"
    else:
        mount = mounts.get(cls.__name__, None if "Source" in cls.__name__ else "hwp")
    more = {"dependence": "harmonic:hwp:1"} if cls is optics.Perturbation else {}
    optic = cls(name="optic", mount=mount, **more)
    for name in cls.param_names:
        if not np.any(getattr(optic, name).value):
            setattr(optic, name, 0.02 * (getattr(optic, name).unit or 1))
    source = optics.VectorDiattenuator(horizontal=0.3, diagonal=0.2, name="source")
    behind = [optics.LinearRetarder(retardance=80 * u.deg, theta=20 * u.deg, name="retarder")]
    behind += [] if optic.splits_light else [optics.WollastonPrism(efficiency=0.9, name="prism")]
    behind = behind[1:] if optic.splits_light else behind
    model = models.Polynomial2D(1, c1_0=1e-3, c0_1=2e-4)
    return follow(
        join([source, optic, *behind]), f"optic.{key}", model, ("time", "wavelength"), since=SINCE
    )


@pytest.mark.slow
def test_fluxes_of_every_optic_are_those_of_its_matrices():
    rng, n = np.random.default_rng(1), 5
    known = {
        "hwp": rng.uniform(0, 3, n),
        "time": 61041 + rng.uniform(0, 9, n),
        "state=B": np.array([0.0, 1, 1, 0, 1]),
        "flux": np.ones((2, 3, n)),
        "total_flux": np.ones((2, 3, n)),
    }
    for cls, key in ((optic, key) for optic in optics.OPTICS.values() for key in optic.param_names):
        chain = example(cls, key)
        placed = {stage: known[stage] for stage in stages(chain)}
        propagator = Propagator(chain, WAVELENGTH.value, placed)
        sweep = propagator.forward()
        given = {
            s: v * u.rad if s == "hwp" else v if v.ndim == 1 else v[0].T for s, v in placed.items()
        }
        for i, beam in enumerate(("right", "left")):
            one = with_beam(chain, beam)
            expected = system_mueller(one, WAVELENGTH, given)[..., 0, 0].T
            np.testing.assert_allclose(propagator.fluxes()[i], expected, atol=1e-12)
            np.testing.assert_allclose(sweep.fluxes[i], expected, atol=1e-12)
            slopes = system_mueller_derivatives(one, WAVELENGTH, given)
            weights = [np.full(propagator.shape, float(i == k)) for k in (0, 1)]
            names = chain["optic"].param_names
            found = sweep.derivatives([(1, j) for j in range(len(names))], weights)
            for j, label in enumerate(names):
                factor = canonical_factor(chain["optic"].__dict__[label].unit)
                wanted = slopes[f"optic.{label}"].value[..., 0, 0].T / factor
                got = found.get((1, j), 0 * wanted)
                np.testing.assert_allclose(got, wanted, atol=1e-9, err_msg=f"{cls} {label}")


def test_jacobian_is_that_of_central_differences(still, frames):
    chain = everything(still)
    measurement = Measurement(chain, simulate(chain, WAVELENGTH, frames, seed=1))
    vector = measurement.vector()
    jacobian = measurement.jacobian(vector)
    assert {"hwp_retardance_c1_2", "wollaston_efficiency_phase_0"} <= set(measurement.param_names)
    for i, name in enumerate(measurement.param_names):
        step = 1e-5 * np.eye(len(vector))[i]
        change = measurement.predict(vector + step) - measurement.predict(vector - step)
        np.testing.assert_allclose(jacobian[i], change / 2e-5, rtol=1e-5, atol=1e-6, err_msg=name)


# --- calibration --------------------------------------------------------------------------------


def test_derivatives_to_coefficients_of_any_size():
    plate = optics.LinearRetarder(retardance=90 * u.deg, name="plate")
    for phase in (0, 1e-12, 1e-9, 1e-6, 1e-3, 0.3):
        chain = follow(plate, "plate.retardance", models.Sine1D(10, 0.01, phase), "hwp")
        slopes = system_mueller_derivatives(chain, positions={"hwp": 10 * u.deg})
        angle = 2 * np.pi * (0.1 + phase)
        slope = np.deg2rad(10) * 2 * np.pi * np.cos(angle)
        expected = -np.sin(np.deg2rad(90 + 10 * np.sin(angle))) * slope
        found = slopes["plate.retardance_phase"][2, 2]
        np.testing.assert_allclose(found, expected, rtol=1e-6, err_msg=f"{phase}")


def test_recovery_with_errors(still, frames):
    chain = law_of_time(still)
    chain = follow(chain, "derotator.retardance", PLANE, ("x", "y"))
    truth = chain.copy()
    values = {"theta_c1": 0.01, "retardance_c1_0": 0.1, "retardance_c0_1": -0.2}
    names = dict(zip(values, ("polarizer", "derotator", "derotator"), strict=True))
    for key, value in values.items():
        setattr(truth[names[key]], key, value * getattr(truth[names[key]], key).unit)
    pulls = []
    for seed in range(10):
        observations = simulate(truth, WAVELENGTH, frames, flux=1e5, seed=seed)
        found = calibrate(chain, observations, **ARRAY)
        for key, value in values.items():
            std = found.covariance.std(f"{names[key]}.{key}").value
            pulls.append((getattr(found.chain[names[key]], key).value - value) / std)
    # 30 pulls of unit width: their rms is 1 +- 0.13
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 1.4
    assert abs(np.mean(pulls)) < 0.7


def test_step_at_a_dated_event(still, frames):
    # from day 50 on
    step = models.Box1D(0.5, 1050, 2000, fixed={"x_0": True, "width": True})
    chain = law_of_time(still, model=step)
    observations = simulate(chain, WAVELENGTH, frames, flux=1e6, seed=1)
    start = law_of_time(still, model=models.Box1D(0, 1050, 2000, fixed=step.fixed))
    found = calibrate(start, observations, **ARRAY)
    std = found.covariance.std("polarizer.theta_amplitude").value
    assert found.chain["polarizer"].theta_amplitude.value == pytest.approx(0.5, abs=4 * std)
    assert std < 0.1


@pytest.fixture
def calibrated(still, frames):
    """A calibration of a plate that changes with time, and the truth."""
    chain = law_of_time(still, "hwp.retardance", models.Polynomial1D(1, c1=0.05))
    observations = simulate(chain, WAVELENGTH, frames, flux=1e7, seed=1, name="lamp")
    return calibrate(chain, observations, **ARRAY), chain, observations


def science(chain, date, angle=60 * u.deg):
    positions = {
        "hwp": [0, 45, 22.5, 67.5] * u.deg,
        "derotator": np.full(4, 1) * angle,
        "time": Time([date] * 4),
    }
    fluxes = measurement_rows(chain, positions, WAVELENGTH) @ [1e6, 2e4, -1e4, 0]
    right, left = fluxes.swapaxes(1, 2)
    return ScienceFrames.from_arrays(right, left, WAVELENGTH, positions, hwp=positions["hwp"])


def test_correction_takes_the_time_of_the_frames(calibrated):
    calibration, truth, _ = calibrated
    sky = remove_optic(calibration.chain, "polarizer")
    sky_truth = remove_optic(truth, "polarizer")
    options = {"chain": sky, "open_directions": "ignore"}
    star = correct(calibration, science(sky_truth, "2026-03-01"), **options)
    np.testing.assert_allclose(star.q, 0.02, atol=1e-4)
    # at another time the plate was another
    wrong = science(sky_truth, "2026-04-01")
    wrong.positions["time"] = Time(["2026-01-02"] * 4)
    assert abs(correct(calibration, wrong, **options).u + 0.01).max() > 2e-4


def test_extrapolation_is_said_and_its_errors_grow(calibrated):
    calibration, *_ = calibrated
    where = {"hwp": 20 * u.deg, "derotator": 60 * u.deg, "time": Time("2026-02-01")}
    inside = calibration.system_mueller(positions=where, light="internal")
    where["time"] = Time("2027-02-01")
    words = (
        r"the law of hwp.retardance is extrapolated: time = 2027-02-01, calibrated from "
        r"2026-01-01 to 2026-04-11"
    )
    with pytest.warns(AstropolcalWarning, match=words):
        beyond = calibration.system_mueller(positions=where, light="internal")
    # of the chain alone, too
    with pytest.warns(AstropolcalWarning, match=words):
        at_positions(calibration.chain, time=where["time"])
    with pytest.warns(AstropolcalWarning, match=words):
        system_mueller(calibration.chain, WAVELENGTH, where)
    # the V of the detector hangs on the retardance
    assert (beyond.std[..., 0, 3] > 3 * inside.std[..., 0, 3]).all()


def test_a_law_of_a_stage_is_not_extrapolated_in_silence(still, frames):
    chain = follow(still, "wollaston.efficiency", LINE, "derotator")
    chain["wollaston"].efficiency_c1 = 2e-4 / u.deg
    observations = simulate(chain, WAVELENGTH, frames, flux=1e7, seed=1)
    calibration = calibrate(chain, observations, gauge=None, **ARRAY)
    # the prism would be better than perfect there
    with pytest.warns(AstropolcalWarning, match=r"derotator = 175 deg, calibrated from 40 deg"):
        calibration.system_mueller(
            positions={"hwp": 0 * u.deg, "derotator": 175 * u.deg}, light="internal"
        )


def test_summary_names_the_law(calibrated):
    calibration, *_ = calibrated
    words = " ".join(calibration.summary(full=True).split())
    assert (
        "hwp.retardance: Polynomial1D of time since 2026-01-01, calibrated for time from "
        "2026-01-01 to 2026-04-11" in words
    )
    row = calibration.parameters[calibration.parameters["name"] == "hwp.retardance_c1"][0]
    assert row["unit"] == "deg / d"
    assert row["value"] == pytest.approx(0.05, abs=5 * row["std"])


def test_files_keep_laws(still, frames, tmp_path):
    chain = everything(still)
    chain["polarizer"].theta_c1.prior = Normal(0.02 * u.deg / u.day, 1 * u.deg / u.day)
    # the retardances are known: what is kept does not depend on how many are free
    chain["hwp"].retardance.fixed = chain["wollaston"].efficiency_phase_0.fixed = True
    observations = simulate(chain, WAVELENGTH, frames, flux=1e6, seed=1)
    calibration = calibrate(chain, observations, gauge=None, **ARRAY)
    path = tmp_path / "law.asdf"
    calibration.write(path)
    again = Calibration.read(path)
    assert again.covariance.names == calibration.covariance.names
    for old, new in zip(leaves(calibration.chain), leaves(again.chain), strict=True):
        assert new.param_names == old.param_names
        for key in old.param_names:
            np.testing.assert_array_equal(getattr(new, key).value, getattr(old, key).value)
            assert getattr(new, key).fixed == getattr(old, key).fixed
    assert isinstance(again.chain["polarizer"].theta_c1.prior, Normal)
    np.testing.assert_array_equal(
        again.with_observations(observations).residuals, calibration.residuals
    )
    where = {"hwp": 0 * u.deg, "derotator": 60 * u.deg, "time": "2029-02-01"}
    where |= {"x": 0 * u.arcsec, "y": 60 * u.arcsec}
    with pytest.warns(AstropolcalWarning) as caught:
        again.system_mueller(positions=where, light="internal")
    words = " ".join(str(one.message) for one in caught)
    assert "derotator.retardance is extrapolated: y = 60 arcsec" in words
    assert "wollaston.efficiency is extrapolated: time = 2029-02-01" in words
    # what a law says belongs to the content
    text = path.read_bytes().replace(b"of: [time]", b"of: [sequence]", 1)
    path.write_bytes(text)
    with pytest.raises(CalibrationFileError, match=r"checksum|unit"):
        Calibration.read(path)


@pytest.mark.slow
def test_diagnosis_of_a_model_that_drifts(still, frames):
    chain = law_of_time(still)
    truth = chain.copy()
    truth["polarizer"].theta_c1 = 0.01 * u.deg / u.day
    observations = simulate(truth, WAVELENGTH, frames, flux=1e6, seed=1)
    # what drifts in the model is no gap; where it does not, the drift is found
    assert not diagnose(chain, observations).causes
    assert any("time" in c.name or "drift" in c.name for c in diagnose(still, observations).causes)


# --- several nights -----------------------------------------------------------------------------


@pytest.fixture
def nights(still):
    """Three nights with another polarizer, and in the last another efficiency."""
    table = half_wave_plate_cycles(derotator=np.linspace(40, 140, 4) * u.deg)
    found = []
    for i, (angle, efficiency) in enumerate([(0.0, 0.98), (0.5, 0.98), (-0.3, 0.95)]):
        night = still.copy()
        night["polarizer"].theta, night["wollaston"].efficiency = angle * u.deg, efficiency
        found.append(simulate(night, WAVELENGTH, table, flux=1e6, seed=i, name=f"night {i + 1}"))
    return found


def test_nights_share_all_but_what_is_their_own(still, nights, tmp_path):
    own = {"polarizer.theta": [1, 2, 3], "wollaston.efficiency": ["a", "a", "b"]}
    found = calibrate(still, nights, own=own, **ARRAY)
    assert [chain[0].name for chain in found.chains] == ["polarizer", "polarizer_2", "polarizer_3"]
    assert [chain[3].name for chain in found.chains] == ["wollaston", "wollaston", "wollaston_b"]
    for chain, angle, efficiency in zip(
        found.chains, (0, 0.5, -0.3), (0.98, 0.98, 0.95), strict=True
    ):
        assert chain[0].theta.value == pytest.approx(angle, abs=0.05)
        assert chain[3].efficiency.value == pytest.approx(efficiency, abs=1e-3)
    assert len(found.covariance) == 3 + 3 + 1 + 2
    found.write(tmp_path / "nights.asdf")
    assert Calibration.read(tmp_path / "nights.asdf").covariance.names == found.covariance.names
    for one in (["polarizer.theta"], "polarizer.theta"):
        names = [calibrate(still, nights, own=one, **ARRAY).chains[i][0].name for i in (1, 2)]
        assert names == ["polarizer_night_2", "polarizer_night_3"]


def test_summary_says_which_parameters_vary(still, nights):
    own = ["polarizer.theta", "derotator.retardance"]
    found = calibrate(still, nights[:2], own=own, **ARRAY)
    words = " ".join(found.summary(full=True).split())
    assert "polarizer.theta: differs (ln Bayes factor " in words
    assert "derotator.retardance: may as well be the same in all of them (ln Bayes" in words


def test_other_parameters_of_the_optic_stay_shared(still, nights):
    # the plate turns in the second night; its retardances are those of all
    still["hwp"].theta.fixed = False
    found = calibrate(still, nights[:2], own=["hwp.theta"], fix={"polarizer.theta": None}, **ARRAY)
    assert found.ties == {"hwp_night_2.retardance": Tie("hwp.retardance")}
    np.testing.assert_array_equal(
        found.chains[0]["hwp"].retardance.value, found.chains[1]["hwp_night_2"].retardance.value
    )


def test_no_frame_has_the_value_of_the_first_night_in_silence(still, nights):
    own = calibrate(still, nights, own=["wollaston.efficiency"], **ARRAY)
    assert "on sky as in night 1: own values of wollaston.efficiency" in own.verdict().cautions
    words = "wollaston.efficiency with a value of its own in each table"
    for use in (lambda: load(own).chain, lambda: measurement_rows(own, {}, WAVELENGTH)):
        with pytest.raises(ChainError, match=words):
            use()
    with pytest.raises(ParameterError, match=r"wollaston.efficiency has several values"):
        restart(own, nights[2], ["derotator"])
    assert restart(own, nights[2], ["wollaston"], cross_validate=False).chain[
        "wollaston"
    ].efficiency.value == pytest.approx(0.95, abs=2e-3)
    # of the lamp there is nothing in a frame
    lamp = calibrate(still, nights[:2], own=["polarizer.theta"], **ARRAY)
    assert not any("own values" in words for words in lamp.verdict().cautions)
    assert "polarizer" not in [leaf.name for leaf in leaves(load(lamp).chain)]


def test_own_parameters_that_cannot_be(still, nights):
    for own, message in [
        (["plate.theta"], "own = 'plate.theta'; allowed are polarizer.theta"),
        (["hwp.theta"], "own: hwp.theta is fixed"),
        ({"polarizer.theta": [1, 2]}, "own: polarizer.theta has 2 groups for 3 datasets"),
    ]:
        with pytest.raises(ParameterError, match=message):
            calibrate(still, nights, own=own, **ARRAY)
    tie = {"derotator.retardance": Tie("wollaston.efficiency")}
    with pytest.raises(ParameterError, match=r"own: wollaston.efficiency is part of a tie"):
        calibrate(still, nights, own=["wollaston.efficiency"], ties=tie, **ARRAY)


# --- what is wrong is said in one line ------------------------------------------------------------


def test_laws_that_cannot_be(still):
    for name, model, of, message in [
        ("polarizer.theta", LINE, "time", r"a law of time needs since=\.\.\., when time is zero"),
        ("polarizer.theta", PLANE, "x", "Polynomial2D has 2 inputs, and each needs a name"),
        ("polarizer.theta", "line", "x", "'line'; a fittable model of one output is needed"),
        ("polarizer.angle", LINE, "x", "no parameter 'angle' of 'polarizer'; it has theta"),
        ("polarizer.theta", models.Polynomial1D(1, c1=np.nan), "x", "must be a finite number"),
        (
            "polarizer.theta",
            models.Polynomial1D(1, c1=1 * u.m),
            "x",
            "not convertible to deg / arc",
        ),
        ("polarizer.theta", models.Linear1D(tied={"slope": lambda m: 1}), "x", "a callable tie"),
    ]:
        with pytest.raises(ParameterError, match=message):
            follow(still, name, model, of)
    with pytest.raises(ParameterError, match="follows a law already; add the models"):
        law_of_time(law_of_time(still))
    with pytest.raises(ParameterError, match="since = 'soon' is not a date"):
        follow(still, "polarizer.theta", LINE, "time", since="soon")
    with pytest.raises(ParameterError, match="is a number, not the angle of a stage"):
        optics.DriftRotator(mount="time")


def test_a_prior_is_of_the_coefficient_in_its_unit(still):
    hourly = models.Polynomial1D(1, c0=0 * u.deg, c1=0.1 * u.deg / u.hour)
    hourly.c1.prior = norm(0.1, 0.01)
    with pytest.raises(ParameterError, match="prior is of a value in deg / h"):
        follow(still, "polarizer.theta", hourly, "time", since=SINCE)
    hourly.c1.prior = Normal(0.1 * u.deg / u.hour, 0.01 * u.deg / u.hour)
    daily = models.Polynomial1D(1, c1=2.4 * u.deg / u.day)
    daily.c1.prior = norm(2.4, 0.24)
    for model in (hourly, daily):
        chain = follow(still, "polarizer.theta", model, "time", since=SINCE)
        assert chain["polarizer"].theta_c1.value == pytest.approx(2.4)
        assert chain["polarizer"].theta_c1.prior is model.c1.prior


def changed(observations, **columns):
    table = observations.to_table()
    for name, values in columns.items():
        if values is None:
            table.remove_column(name)
        else:
            table[name] = values if np.ndim(values) else np.full(len(table), 1) * values
    return Observations.from_table(table, name="night")


def test_tables_without_what_a_law_needs(still, frames):
    chain = follow(law_of_time(still), "derotator.retardance", PLANE, ("x", "y"))
    observations = simulate(chain, WAVELENGTH, frames, seed=1)
    lost = observations.to_table()["x"].copy()
    lost[5] = lost[3] = lost[4] = np.nan
    for columns, message in [
        ({"time": None}, "night: no column 'time', which a law of a parameter needs; it has"),
        ({"y": None}, "night: no column 'y', which a law of a parameter needs"),
        ({"x": 3.0}, "night: column x has no unit, a unit such as arcsec is needed"),
        ({"x": 3.0 * u.mm}, "night: column x has unit mm, a unit such as arcsec is needed"),
        ({"x": lost}, "night, frame 1: x is not known; a finite number is needed"),
        ({"time": 12.0}, "time = 12 is not a Modified Julian Date; allowed are 40000 to 100000"),
        ({"time": 12.0 * u.s}, "is not a Modified Julian Date"),
        ({"time": 12.0 * u.m}, "night: time has unit m, which is not convertible to d"),
    ]:
        with pytest.raises(ObservationError, match=message):
            Measurement(chain, changed(observations, **columns))
    # scales of Time, numbers and texts are the same moments
    times = Time(observations.to_table()["time"])
    for same in (times.tai, times.mjd, times.mjd * u.day, times.isot):
        found = changed(observations, time=same).position("time")
        np.testing.assert_allclose(found, observations.position("time"), atol=1e-6)
    with pytest.raises(ParameterError, match=r"x = 3 needs a unit such as arcsec"):
        at_positions(chain, x=3)
