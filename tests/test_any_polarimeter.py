# Licensed under a 3-clause BSD style license - see LICENSE
"""Five polarimeters without a half-wave plate in pairs: simulated, calibrated, diagnosed, used."""

import inspect
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import calibrate, instruments, optics
from astropolcal.calibration.uncertainty import derived_retardance
from astropolcal.chain import insert_optic, join, stages
from astropolcal.correction import ScienceFrames, correct, measurement_rows
from astropolcal.efficiency import demodulation
from astropolcal.exceptions import AstropolcalWarning, ChainError, FitError, ObservationError
from astropolcal.gap import diagnose
from astropolcal.gap.effects import Context, adapted, get_effect
from astropolcal.gap.report import summary, to_dict
from astropolcal.instruments import Instrument, SkyLaw
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.observations.grid import mask_incomplete_cycles
from astropolcal.observations.pointings import motion
from astropolcal.plotting import save_all
from astropolcal.simulation import simulate
from astropolcal.testing import check_instrument

FREE = {"fixed": {"theta": False}, "bounds": {"theta": (-10, 10)}}


class Bench(Instrument):
    """A lamp behind a polarizer and a quarter-wave plate that turn, in front of an instrument."""

    wavelength = [0.6, 0.7, 0.8] * u.um
    sources = ("lamp", "star")
    references = ("this test",)
    sky_law = SkyLaw(plate=(0, 0), derotator={})
    calibrators = ("polarizer", "retarder")

    def chain(self, source="lamp", optics_in=(), *, wavelength=None):
        self.check_choices(source, optics_in)
        plate = {"retardance": 85 * u.deg, "fixed": {"retardance": True}}
        unit = {
            "polarizer": optics.LinearPolarizer(mount="calibrator", name="calibrator"),
            "retarder": optics.LinearRetarder(mount="retarder", name="retarder", **plate),
        }
        train = self.telescope_optics() if source == "star" else [unit[k] for k in self.calibrators]
        return join([*train, *self.inner(self.grid(wavelength).size)])

    def telescope_optics(self, behind=()):
        return [optics.Rotator(mount="parallactic", name="parallactic")]


class Wheel(Bench):
    """Three polarizers in a wheel, one beam, behind a mirror, as in HST/ACS."""

    name, entrance, calibrators = "wheel", "mirror", ("polarizer",)

    def inner(self, size):
        mirror = optics.DiattenuatorRetarder(
            diattenuation=np.full(size, 0.02), retardance=np.full(size, 170) * u.deg, name="mirror"
        )
        yield mirror
        for angle in (0, 60, 120):
            yield optics.StateAnalyser(
                efficiency=0.95, theta=angle * u.deg, mount=f"filter=POL{angle}", name=f"pol{angle}"
            )

    def frames(self, turns):
        return QTable(
            {
                "calibrator": np.repeat(turns, 3) * u.deg,
                "filter": np.tile(["POL0", "POL60", "POL120"], len(turns)),
                "group": np.repeat(np.arange(len(turns)), 3),
            }
        )


class Rolls(Bench):
    """Two Wollaston prisms, at 0 and 45 deg, one at a time, as in the Roman coronagraph."""

    name, entrance, calibrators = "rolls", "mirror", ("polarizer",)

    def inner(self, size):
        yield optics.DiattenuatorRetarder(
            diattenuation=np.full(size, 0.02), retardance=np.full(size, 160) * u.deg, name="mirror"
        )
        yield optics.WollastonPrism(
            efficiency=np.full(size, 0.97), mount="prism", name="wollaston", **FREE
        )

    def frames(self, turns):
        return QTable(
            {
                "calibrator": np.repeat(turns, 2) * u.deg,
                "prism": np.tile([0, 45], len(turns)) * u.deg,
            }
        )


class QuarterWave(Bench):
    """Quarter-wave plate at arbitrary angles and a Wollaston prism, as in FORS2: full Stokes."""

    name, entrance = "quarter", "qwp"

    def inner(self, size):
        yield optics.LinearRetarder(
            retardance=np.full(size, 88) * u.deg, mount="qwp", name="qwp", **FREE
        )
        yield optics.WollastonPrism(efficiency=np.full(size, 0.98), name="wollaston")

    def frames(self, turns):
        n = 4 * len(turns)
        return QTable(
            {
                "calibrator": np.repeat(turns, 4) * u.deg,
                "retarder": np.repeat(37 * np.arange(len(turns)) % 180, 4) * u.deg,
                "qwp": (13.7 + 39.1 * np.arange(n)) % 360 * u.deg,
            }
        )


class Crystal(Bench):
    """Liquid crystal with four voltages and a polarizer, one beam: full Stokes."""

    name, entrance = "crystal", "lc1_A"
    # those of IMaX (Martinez Pillet et al. 2011), the most efficient ones
    states = {"A": (315, 305.3), "B": (315, 54.7), "C": (225, 125.3), "D": (225, 234.7)}

    def inner(self, size):
        for i, theta in enumerate((0, 45)):
            for state, values in self.states.items():
                yield optics.StateRetarder(
                    retardance=values[i] * u.deg,
                    theta=theta * u.deg,
                    mount=f"lcvr={state}",
                    name=f"lc{i + 1}_{state}",
                )
        yield optics.LinearPolarizer(name="analyser")

    def frames(self, turns):
        return QTable(
            {
                "calibrator": np.repeat(turns, 4) * u.deg,
                "retarder": np.repeat(37 * np.arange(len(turns)) % 180, 4) * u.deg,
                "lcvr": np.tile(list("ABCD"), len(turns)),
                "group": np.repeat(np.arange(len(turns)), 4),
            }
        )


class FourBeams(Bench):
    """Half-wave plate and a double Wollaston prism with four beams at once, as in ALFOSC."""

    name, entrance, calibrators = "fourbeams", "hwp", ("polarizer",)

    def inner(self, size):
        yield optics.LinearRetarder(
            retardance=np.full(size, 172) * u.deg, mount="hwp", name="hwp", **FREE
        )
        for angle in (0, 45, 90, 135):
            name = f"i{angle}"
            yield optics.StateAnalyser(
                efficiency=0.98, theta=angle * u.deg, mount=f"beam={name}", name=name
            )

    def frames(self, turns):
        return QTable(
            {
                "calibrator": turns * u.deg,
                "hwp": (11.3 * np.arange(len(turns))) % 180 * u.deg,
            }
        )


KINDS = [Wheel(), Rolls(), QuarterWave(), Crystal(), FourBeams()]
every = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
TURNS = np.linspace(3, 178, 24)


def observed(kind, chain=None, seed=0, turns=TURNS, flux=3e5, **options):
    return simulate(
        kind.chain() if chain is None else chain,
        kind.wavelength,
        kind.frames(turns),
        flux=flux,
        seed=seed,
        meta={"instrument": kind.name, "source": "lamp"},
        name=kind.name,
        **options,
    )


def truth_with_fault(kind):
    """Return the chain with something wrong, and what the diagnosis calls it."""
    chain = kind.chain()
    if kind.name == "wheel":
        chain["pol60"].theta = 61.5 * u.deg
        # of three polarizers only their relative angles count
        return chain, "state:filter=POL"
    if kind.name == "rolls":
        return chain | optics.BeamGain(imbalance=0.01, name="flat"), "beam_gain"
    if kind.name == "fourbeams":
        tilt = optics.HarmonicRetarder(cosine=2 * u.deg, harmonic=2, mount="hwp", name="tilt")
        return insert_optic(chain, tilt, after="hwp"), "hwp_tilt"
    chain["retarder"].retardance = 89 * u.deg
    return chain, "hwp_retardance"


def test_a_new_instrument_is_short():
    shared = len(inspect.getsource(Bench).splitlines())
    for kind in map(type, KINDS):
        assert shared + len(inspect.getsource(kind).splitlines()) <= 60, kind


@every
def test_the_instrument_conforms(kind):
    # the test instruments have neither site nor keywords
    report = check_instrument(kind, skip=["mounts"], raises=False)
    assert report, str(report)


def test_noiseless_frames_are_predicted_and_the_derivative_is_that_of_differences():
    for kind in KINDS:
        measurement = Measurement(kind.chain(), observed(kind, noise=False))
        vector = measurement.vector()
        np.testing.assert_allclose(measurement.residuals(vector), 0, atol=1e-9)
        rng = np.random.default_rng(1)
        there = vector + 0.01 * rng.normal(size=vector.size)
        step = 1e-5 * rng.normal(size=vector.size)
        change = measurement.predict(there + step) - measurement.predict(there - step)
        np.testing.assert_allclose(change, 2 * step @ measurement.jacobian(there), atol=1e-11)


def test_the_table_survives_a_file(tmp_path):
    for kind in KINDS:
        table = observed(kind)
        table.write(tmp_path / "run.ecsv", overwrite=True)
        again = Observations.read(tmp_path / "run.ecsv")
        assert again.content_hash == table.content_hash, kind.name
        one, other = (Measurement(kind.chain(), each) for each in (table, again))
        np.testing.assert_allclose(one.observed, other.observed)


@pytest.mark.long
@every
def test_pulls_are_one(kind):
    pulls, truth = [], Measurement(kind.chain(), observed(kind)).vector()
    for seed in range(12):
        found = calibrate(
            kind.chain(), observed(kind, seed=seed), weights="errors", cross_validate=False
        )
        live = found.live_measurement()
        pulls.append((live.vector() - truth) / live.free.factors() / found.covariance.stds)
    assert np.std(pulls) == pytest.approx(1, abs=0.1), np.std(pulls, axis=0)
    assert np.mean(pulls) == pytest.approx(0, abs=0.2)


@pytest.mark.long
@every
def test_a_planted_fault_is_found_and_none_without_one(kind):
    assert diagnose(kind.chain(), observed(kind, seed=3), cross_validate=False).verdict == "none"
    chain, name = truth_with_fault(kind)
    # four beams share the light: with less of it the noise alone is half of what a tilt does
    flux = 1e7 if kind.name == "fourbeams" else 1e6
    found = diagnose(kind.chain(), observed(kind, chain, seed=3, flux=flux))
    words = summary(found)
    assert "double diff" not in words.replace("in double diff.", "")
    assert "half-wave" not in words or kind.name == "fourbeams"
    assert found.verdict in ("named", "located")
    assert name in found.causes[0].name
    assert found.gap_after_percent < 0.3 * found.gap_before_percent
    if kind.name == "wheel":
        # what the data leave open has an answer, in stages that the instrument has
        asked = [one for one in to_dict(found)["next_observations"] if one["question"] == "cause"]
        assert asked
        for one in asked:
            assert one["probability_after"] > one["probability_now"] + 0.3, one
            assert "half-wave" not in one["words"]
            assert "derotator" not in one["words"]


@every
def test_a_star_is_corrected(kind):
    calibration = calibrate(
        kind.chain(),
        observed(kind, seed=2, flux=1e8),
        weights="errors",
        cross_validate=False,
        instrument=kind.name,
    )
    truth, n = kind.on_sky(kind.chain()), 8
    has_v = "retarder" in kind.calibrators
    star = np.array([1, 0.02, -0.01, 0.005 * has_v])
    frames = kind.frames(np.linspace(0, 170, n))
    group = np.arange(len(frames)) * n // len(frames)
    where = {s: frames[s] for s in frames.colnames if s not in ("calibrator", "retarder", "group")}
    where["parallactic"] = np.linspace(-50, 60, n)[group] * u.deg
    # clouds, which the frames of a group share
    bright = 1 + 0.3 * np.cos(np.arange(n))[group]

    def fluxes(**more):
        rows = measurement_rows(truth, where | more, kind.wavelength)
        return np.moveaxis(rows @ star * 1e6 * bright, 1, 2)

    beams = [stage.partition("=")[2] for stage in stages(truth) if stage.startswith("beam=")]
    if beams:
        seen = {name: fluxes(beam=[name] * len(frames))[0] for name in beams}
        science = ScienceFrames.from_arrays(seen, None, kind.wavelength, where)
    elif "group" in frames.colnames:
        seen = fluxes()[0]
        science = ScienceFrames.from_arrays(seen, None, kind.wavelength, where, groups=group)
    else:
        science = ScienceFrames.from_arrays(*fluxes(), kind.wavelength, where)
    sky = kind.on_sky(calibration.chains[0])
    found = correct(calibration, science, chain=sky, components="IQUV" if has_v else "IQU")
    np.testing.assert_allclose([found.q, found.u], [[0.02] * 3, [-0.01] * 3], atol=5e-5)
    if has_v:
        np.testing.assert_allclose(found.v, 0.005, atol=5e-5)


def test_polarization_on_sky_is_known_of_angles_and_states_of_any_kind():
    """And with a hundred times the light it is known ten times as well."""
    for kind in KINDS:
        claims = []
        for flux in (1e6, 1e8):
            seen = observed(kind, seed=2, flux=flux)
            found = calibrate(kind.chain(), seen, weights="errors", cross_validate=False)
            (claim,) = [one for one in found.fit["sky_accuracy"] if one["dolp_percent"] == 30]
            assert "one sequence of frames" in claim["words"]
            claims.append(np.mean(claim["s_p_percent"]))
        assert claims[0] / claims[1] == pytest.approx(10, rel=0.5), kind.name
        assert 0 < claims[1] < 0.1


# --- what does not fit ----------------------------------------------------------------------------


def changed(observations, change):
    """Return observations of a table that a function has changed."""
    table = observations.to_table()
    change(table)
    return Observations.from_table(table, name="table")


def state(column, old, new):
    def change(table):
        table[column] = [new if value == old else str(value) for value in table[column]]

    return change


def unknown_angle(table):
    table["qwp"][table["frame"] == 3] = np.nan


def test_what_the_table_lacks_or_has_too_much_is_named():
    wheel, quarter, four = KINDS[0], KINDS[2], KINDS[4]
    one, two = observed(wheel), observed(quarter)
    lost = changed(two, lambda table: table.rename_column("qwp", "wave"))
    strange = changed(one, state("filter", "POL60", "POL90"))
    beam = changed(observed(four), state("beam", "i45", "i50"))
    cases = [
        (wheel, two, None, "has two beams a frame, the chain one; flux, or flux_NAME"),
        (quarter, one, None, "has one beam a frame, the chain two; flux_right and flux_left"),
        (wheel, one, "ratio", "observable ratio of one beam a frame; allowed is intensity"),
        (quarter, two, "intensity", "observable intensity of two beams a frame"),
        (four, observed(wheel), None, "no column 'hwp'; its angles are calibrator"),
        (quarter, lost, None, "no column 'qwp'; its angles are calibrator, retarder, wave"),
        (wheel, strange, None, "filter = POL90 in the table; the chain knows POL0, POL60, POL120"),
        (four, beam, None, "beam = i50 in the table; the chain knows i0, i45, i90, i135"),
        (quarter, changed(two, unknown_angle), None, "frame 3: qwp is not known"),
    ]
    for kind, observations, observable, message in cases:
        with pytest.raises(ObservationError, match=message) as info:
            Measurement(kind.chain(), observations, observable=observable)
        assert "\n" not in str(info.value)


def test_beams_in_columns_are_frames_of_one_group():
    wide = QTable({"frame": [7, 9], "bin": [0, 0], "wavelength": [0.6, 0.6] * u.um})
    for i, name in enumerate(("a", "b", "c")):
        wide[f"flux_{name}"] = [10.0 + i, 20.0 + i] * u.adu
        wide[f"flux_{name}_err"] = [1.0, 2.0] * u.adu
    found = Observations.from_table(wide)
    assert found.single_beam
    assert found.n_frames == 6
    assert found.frames["beam"].tolist() == ["a", "b", "c"] * 2
    assert found.brightness_groups.tolist() == [0, 0, 0, 1, 1, 1]
    assert found.flux_right[:, 0].tolist() == [10, 11, 12, 20, 21, 22]
    # messages name the frames of the user's table
    assert found.frames["frame"].tolist() == [7] * 3 + [9] * 3
    tall = Observations.from_table(found.to_table()[::-1])
    assert tall.content_hash == found.content_hash
    wide["turn"], wide["flux_b"][1] = [0, np.nan] * u.deg, -1 * u.adu
    splitter = join([optics.StateAnalyser(mount=f"beam={name}", name=name) for name in "abc"])
    plate = optics.LinearRetarder(mount="turn", name="plate")
    with pytest.warns(AstropolcalWarning, match=r"first: row 2 \(beam b\): flux = -1"):
        lost = Observations.from_table(wide)
    with pytest.raises(ObservationError, match=r"frame 9 \(beam a\): turn is not known"):
        Measurement(plate | splitter, lost)
    assert not found.flux_left.any()
    assert found.variance_right[3, 0] == 4
    alone = wide["frame", "bin", "wavelength", "flux_a", "flux_a_err"]
    assert Observations.from_table(alone).frames.colnames == ["frame"]
    wide.remove_column("flux_b_err")
    with pytest.raises(ObservationError, match="missing column flux_b_err"):
        Observations.from_table(wide)


def test_states_that_no_optic_knows_are_refused_wherever_they_are_given():
    wheel = [
        optics.StateAnalyser(theta=a * u.deg, name=f"p{a}", mount=f"filter=P{a}") for a in (0, 60)
    ]
    chain, light = join(wheel), ([0.6] * u.um,)
    wrong = {"filter": ["P0", "p60"]}
    fluxes = ScienceFrames.from_arrays([[1.0], [1.0]], None, *light, wrong)
    for call in (
        lambda: simulate(chain, *light, QTable(wrong)),
        lambda: demodulation(chain, *light, QTable(wrong)),
        lambda: measurement_rows(chain, wrong, *light),
        lambda: correct(chain, fluxes),
    ):
        with pytest.raises(ObservationError, match=r"filter = p60 .* knows P0, P60"):
            call()


def test_a_model_without_light_fits_no_single_beam():
    polarizers = optics.LinearPolarizer(name="lamp") | optics.LinearPolarizer(
        mount="wheel", name="analyser"
    )
    frames = QTable({"wheel": [0, 30, 60, 10, 80, 40] * u.deg, "group": [0, 0, 0, 1, 1, 1]})
    run = simulate(polarizers, [0.6] * u.um, frames, flux=1e4, seed=1)
    crossed = optics.Diattenuator(diattenuation=-1, name="crossed")
    dark = insert_optic(polarizers, crossed, after="lamp")
    lit, unlit = (Measurement(chain, run).residuals() for chain in (polarizers, dark))
    assert np.abs(lit).max() < 0.1
    # it predicts none, instead of whatever was measured
    np.testing.assert_allclose(unlit, Measurement(polarizers, run).observed, atol=1e-12)


def test_beams_of_an_exposure_are_taken_at_once():
    # run, moves and rates of three beams are those of the two beams of a prism
    turns, exposed = np.array([0, 40, 60, 45, 5.0]) * u.deg, np.array([2, 2, 3, 2, 2.0]) * u.s
    columns = {"frame": np.arange(5), "bin": np.zeros(5, dtype=int), "wavelength": [0.6] * 5 * u.um}
    columns |= {stage: turns for stage in ("hwp", "derotator", "parallactic")}
    names = ["sequence", "hwp_move", "hwp_direction", "derotator_rate", "parallactic_rate"]
    for times in ({}, {"time": [0, 10, 30, 40, 60] * u.s, "exposure_time": exposed}):
        two, three = (
            Observations.from_table(
                QTable(columns | times | {f"flux_{one}": np.ones(5) * u.adu for one in beams})
            )
            for beams in (("right", "left"), "abc")
        )
        for name in names:
            wanted = np.repeat(two.position(name), 3)
            np.testing.assert_allclose(three.position(name), wanted, atol=1e-12, err_msg=name)
        for duty in (0.5, None) if times else (0.5,):
            moved = [motion(one, one.position("hwp"), duty) for one in (two, three)]
            np.testing.assert_allclose(moved[1], np.repeat(moved[0], 3), atol=1e-12)


def test_angles_of_any_stage_may_be_those_of_another_moment():
    # a star behind two plates: the second is what elsewhere is a derotator, and may lag as one
    turn = optics.Rotator(mount="parallactic", name="parallactic")
    plates = [
        optics.LinearRetarder(retardance=angle * u.deg, mount=stage, name=stage)
        for stage, angle in (("hwp", 180), ("quarter", 90))
    ]
    chain = join([turn, *plates, optics.WollastonPrism(name="wollaston")])
    angles = {"parallactic": np.arange(6.0), "hwp": np.arange(6) * 22.5, "quarter": [0, 10] * 3}
    frames = QTable({stage: angle * u.deg for stage, angle in angles.items()})
    run = simulate(chain, [0.6] * u.um, frames, seed=1)
    for effect in adapted([get_effect("derotator_motion")], [chain]):
        context = Context.of([0.6], [run])
        late = effect.edit([chain], context).chains[0]
        assert Measurement(late, run, observable="normalized_single_difference").n_data == 6


def test_cycles_of_a_half_wave_plate_are_those_of_its_exposures():
    angles = np.tile([0, 45, 22.5, 67.5], 3)[:-1] * u.deg
    beams = [
        optics.StateAnalyser(theta=a * u.deg, mount=f"beam=i{a}", name=f"i{a}") for a in (0, 60)
    ]
    plate = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    star = simulate(join([plate, *beams]), [0.6] * u.um, QTable({"hwp": angles}), seed=1)
    with pytest.warns(AstropolcalWarning, match="6 of 22 frames masked, incomplete"):
        whole = mask_incomplete_cycles(star)
    assert whole.mask[:, 0].tolist() == [False] * 16 + [True] * 6


# --- few frames, and none with noise -------------------------------------------------------------


def roman_star(n, **options):
    """Frames of an unpolarized standard star at some rolls, and its chain."""
    roman = instruments.get("roman")
    frames = QTable({"roll": np.repeat(np.linspace(-13, 13, n), 2) * u.deg})
    frames["prism"] = np.tile([0, 45], n) * u.deg
    source = "unpolarized standard"
    meta = {"instrument": "roman", "source": source}
    options = {"flux": 1e9, "seed": 1, "meta": meta} | options
    star = simulate(roman.chain(source), roman.wavelength, frames, **options)
    (chain,) = roman.chains_for([star])
    chain["wollaston"].efficiency.fixed = chain["wollaston"].theta.fixed = True
    chain["mirrors"].retardance.fixed = True
    return chain, star


def test_as_many_parameters_as_data_are_refused_in_one_line():
    chain, star = roman_star(2)
    with pytest.raises(FitError, match="8 free parameters and 8 data leave none for the noise"):
        calibrate(chain, star, instrument="roman")
    known = calibrate(chain, star, instrument="roman", weights="errors")
    assert "no degree of freedom left for s_res" in known.summary()


def test_a_table_without_noise_is_fitted_exactly():
    chain, star = roman_star(6, noise=False)
    found = calibrate(chain, star, instrument="roman")
    np.testing.assert_allclose(found.residuals, 0, atol=1e-9)


def test_states_of_a_modulator_may_be_named():
    vampires = instruments.get("vampires")
    frames = QTable({"hwp": [0, 45, 22.5, 67.5] * u.deg, "flc_state": ["A", "B", "A", "B"]})
    frames["derotator"] = np.full(4, 40) * u.deg
    simulate(vampires.published(), vampires.wavelength, frames)
    frames["flc_state"][3] = "C"
    with pytest.raises(ObservationError, match="flc_state = 'C' in frame 3; allowed are A and B"):
        simulate(vampires.published(), vampires.wavelength, frames)


def test_a_v_that_is_taken_as_zero_is_spoken_of():
    """A quarter-wave plate at few angles gives V to Q; at many of equal weight it does not."""
    plate = optics.LinearRetarder(retardance=90 * u.deg, mount="qwp", name="qwp")
    chain = plate | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    for angles, speaks in (([-45, 45, -45, 45, 0, 22.5, 67.5], True), (range(0, 180, 15), False)):
        where = {"qwp": [*angles] * u.deg}
        beams = measurement_rows(chain, where, [0.6] * u.um) @ [1e6, 1e4, -2e4, 3e4]
        right, left = np.moveaxis(beams, 1, 2)
        frames = ScienceFrames.from_arrays(right, left, [0.6] * u.um, where)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            linear = correct(chain, frames)
        assert any("V is taken as zero: 1 % of V" in str(one.message) for one in told) == speaks
        # 3 % of V
        assert (abs(linear.q[0] - 0.01) > 0.009) == speaks
        full = correct(chain, frames, components="IQUV")
        np.testing.assert_allclose(full.stokes[:, 0] / 1e6, [1, 0.01, -0.02, 0.03], atol=1e-9)


def test_a_diattenuation_is_no_retardance(tmp_path):
    """Components of both have the same names; of a diattenuator they have no unit."""
    lamp = optics.LinearPolarizer(mount="calibrator", name="calibrator")
    lens = optics.VectorDiattenuator(horizontal=[0.01, 0.02], diagonal=0.0, name="lens")
    wollaston = optics.WollastonPrism(efficiency=[0.9, 0.9], name="wollaston")
    frames = QTable({"calibrator": np.arange(0, 180, 15) * u.deg})
    chain = lamp | lens | wollaston
    calibration = calibrate(chain, simulate(chain, [0.5, 0.6] * u.um, frames, seed=1))
    with pytest.raises(ChainError, match="VectorDiattenuator, which has no retardance"):
        derived_retardance(calibration, "lens")
    names = [path.name for path in save_all(calibration, tmp_path)]
    assert "retardances.png" not in names
    assert "other_parameters.png" in names


def test_fluxes_of_several_beams_need_one_unit():
    wide = QTable({"frame": [0, 1], "bin": [0, 0], "wavelength": [0.6, 0.6] * u.um})
    wide["flux_a"], wide["flux_b"] = [1, 2] * u.adu, [1, 2] * u.electron
    with pytest.raises(ObservationError, match="one unit, not flux_a in adu, flux_b in electron"):
        Observations.from_table(wide)
