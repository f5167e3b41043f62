# Licensed under a 3-clause BSD style license - see LICENSE
"""Single frames that are not what the table says, found and told apart from missing optics."""

import json
from functools import cache

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from astropy.table import QTable
from gap_setups import SETUPS

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic, join
from astropolcal.gap._bench import Bench
from astropolcal.gap.challenge import Setup, make_challenge, score_answer
from astropolcal.gap.diagnosis import diagnose
from astropolcal.gap.frames import lamp_faults, single_data, suspect_frames, without_frames
from astropolcal.gap.model import nominal_model
from astropolcal.gap.report import to_dict
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

DEROTATOR = [45, 55, 65, 75, 85, 95] * u.deg
N = 48


def table(**errors):
    """Frames of a run; by stage: the frame and the error of its angle in degree."""
    frames = half_wave_plate_cycles(derotator=DEROTATOR)
    for stage, (frame, error) in errors.items():
        frames[f"{stage}_true"] = frames[stage] + np.where(np.arange(N) == frame, error, 0) * u.deg
    return frames


def exchanged(one, other):
    frames = table()
    order = np.arange(N)
    order[[one, other]] = other, one
    for stage in ("hwp", "derotator"):
        frames[f"{stage}_true"] = frames[stage][order]
    return frames


def observed(frames=None, true=None, flux=1e6, **options):
    frames = table() if frames is None else frames
    seen = data.observed(true, table=frames, flux=flux, **options).to_table()
    seen.remove_columns([name for name in seen.colnames if name.endswith("_true")])
    return Observations.from_table(seen, name="lamp")


def with_beam(frame, factor):
    return data.with_flux(observed(), np.where(np.arange(N) == frame, factor, 1.0))


def all_faults(model):
    faults = suspect_frames(model)
    return faults + lamp_faults(model, faults)


def found(observations):
    return all_faults(data.fitted(observations))


@cache
def plate_off():
    return observed(table(hwp=(18, 0.7)))


def harmful(faults):
    return [fault for fault in faults if fault.what != "lamp"]


def test_angle_of_any_size_is_found_with_its_value():
    for stage, error in (("hwp", 0.3), ("hwp", -22.5), ("derotator", 4.0), ("hwp", 30.0)):
        frames = table(**{stage: (21, error)})
        (fault,) = found(observed(frames))
        assert (fault.frame, fault.what, fault.with_) == (21, f"{stage} angle", None)
        stood = frames[f"{stage}_true"][21].to_value(u.deg)
        # where the plate is near half a wave it looks the same 90 deg on
        assert abs((fault.value - stood + 45) % 90 - 45) < 5 * fault.error + 0.02
        assert fault.probability > 0.9


def test_angles_that_do_as_well_are_told():
    """Polarized light along the derotator's diagonal sees how far it is off, not on which side."""
    for error in (2.5, -2.5):
        (fault,) = found(observed(table(derotator=(1, error))))
        assert fault.what == "derotator angle"
        assert abs(fault.value - 45 - error) < fault.error + 0.2, error
        assert "at 47.477 or 42.523 deg" in fault.words


def test_angles_of_frames_in_a_row_may_be_something_else():
    """Light that arrives turned for a while looks like a plate that is."""
    frames = table()
    frames["hwp_true"] = frames["hwp"] + np.where(np.isin(np.arange(N), (18, 19)), 0.7, 0) * u.deg
    faults = harmful(found(observed(frames)))
    assert sorted(fault.frame for fault in faults) == [18, 19]
    assert {fault.what for fault in faults} == {"unknown"}
    assert all("half-wave plate at" in fault.words for fault in faults)


def test_one_beam_after_the_other_may_be_something_else():
    """Light that arrives depolarized for a while looks so where a lamp flickers."""
    clouds = optics.Depolarizer(retained_q=0.99, retained_u=0.99, name="clouds")
    cloudy = insert_optic(data.chain(), clouds, before="hwp")
    lamp = np.exp(np.random.default_rng(101).normal(0, 0.05, N))
    seen, other = (observed(true=true, lamp=lamp).to_table() for true in (None, cloudy))
    for beam in ("flux_right", "flux_left"):
        seen[beam] = np.where(np.isin(seen["frame"], (42, 43)), other[beam], seen[beam])
    faults = harmful(found(Observations.from_table(seen, name="lamp")))
    assert sorted(fault.frame for fault in faults) == [42, 43]
    assert {(fault.what, fault.beam) for fault in faults} == {("unknown", None)}
    assert any("beam is off by" in fault.words for fault in faults)


def test_exchanged_frames_are_named_with_each_other():
    for one, other in ((12, 13), (3, 40)):
        faults = found(observed(exchanged(one, other)))
        pairs = {(f.frame, f.with_) for f in faults}
        assert pairs == {(one, other), (other, one)}
        assert all(f.what == "exchanged" and f.value is None for f in faults)


def test_beam_that_was_off_in_one_frame():
    for frame, factor in ((30, 1.01), (7, 0.95)):
        (fault,) = harmful(found(with_beam(frame, factor)))
        assert (fault.frame, fault.what) == (frame, "one beam")
        assert abs(fault.value - factor) < 5 * fault.error


def test_sums_of_a_lamp_that_drifts_say_by_how_much_a_beam_was_off():
    """They are compared with what the other frames foresee, as the differences are."""
    time = np.linspace(-1, 1, N)
    lamp = np.exp(0.1 * time + 0.1 * time**2 + 0.1 * time**3)
    for frame, factor in ((1, 0.95), (45, 1.06)):
        one = data.with_flux(observed(lamp=lamp), np.where(np.arange(N) == frame, factor, 1.0))
        (fault,) = harmful(found(one))
        assert fault.what == "one beam"
        assert abs(fault.value - factor) < 3 * fault.error, (frame, fault.value, fault.error)


def test_datum_of_one_wavelength_that_was_off():
    right = observed()
    for frame, k, factor, beam in ((30, 2, 1.1, "right"), (7, 0, 0.97, "left")):
        table = right.to_table()
        here = (table["frame"] == frame) & (table["bin"] == right.bin[k])
        table[f"flux_{beam}"][here] *= factor
        (fault,) = harmful(found(Observations.from_table(table, name="lamp")))
        assert (fault.frame, fault.what) == (frame, "one wavelength")
        assert f"at {right.wavelength[k].to_value(u.nm):.0f} nm" in fault.words
        # the others of the frame are kept
        (kept,) = without_frames([right], [fault])
        assert np.argwhere(kept.mask).tolist() == [[frame, k]]


def test_frame_whose_wavelengths_are_others_is_named_for_no_reason_that_is_known():
    """What its sums are off by must not be taken for the brightness of all frames."""
    (polarized, lamp), chains, _ = make_challenge(1, kind="none")
    for change in (lambda beam: np.roll(beam, 1), lambda beam: beam[::-1]):
        seen = lamp.to_table()
        for beam in ("flux_right", "flux_left"):
            flux = seen[beam].reshape(lamp.n_frames, -1)
            flux[20] = change(flux[20])
            seen[beam] = flux.ravel()
        shifted = Observations.from_table(seen, name="lamp")
        (fault,) = harmful(all_faults(nominal_model(chains, [polarized, shifted])))
        assert (fault.frame, fault.what, fault.dataset) == (20, "unknown", "lamp")


def test_one_wavelength_of_three_is_no_beam():
    setup = SETUPS["vampires"]()
    for factors, what in (((1, 1.1, 1), "one wavelength"), ((1.03, 1.05, 1.02), "one beam")):
        seen = setup.observed(flux=1e6).to_table()
        seen["flux_left"][seen["frame"] == 21] *= np.array(factors)
        (fault,) = found_of(setup.nominal, Observations.from_table(seen, name="lamp"))
        assert (fault.frame, fault.what) == (21, what)


@pytest.mark.long
def test_single_data_in_many_frames_are_left_out_and_counted():
    observations, chains, case = make_challenge(
        15, kind="listed", snr=40, setup=Setup(n_derotator=6)
    )
    rng, planted, tables = np.random.default_rng(15), set(), []
    for one in observations:
        seen = one.to_table()
        bad = rng.random(len(seen)) < 0.02
        seen["flux_left"][bad] *= 1 + rng.choice([-0.1, 0.1], bad.sum())
        planted |= {(one.name, *place) for place in seen["frame", "bin"][bad].iterrows()}
        tables.append(Observations.from_table(seen, name=one.name))
    diagnosis = diagnose(chains, tables)
    named = {(f.dataset, f.frame, f.bin) for f in diagnosis.frames if f.what == "one wavelength"}
    assert len(planted) > 12
    assert len(named & planted) >= 0.9 * len(planted)
    assert len(named - planted) < 2
    content = to_dict(diagnosis)
    assert f"{len(named)} data in " in content["sentences"][0]
    assert diagnosis.verdict == "named"
    assert score_answer(case, content) == "right"


def test_of_two_single_data_of_a_frame_neither_is_said_to_be_the_only_one():
    seen = observed().to_table()
    for frame, k in ((2, 0), (9, 1), (16, 3), (23, 4), (30, 1), (30, 5), (37, 6)):
        here = (seen["frame"] == frame) & (seen["bin"] == np.unique(seen["bin"])[k])
        seen["flux_left"][here] *= 1.1
    found = single_data(data.fitted(Observations.from_table(seen, name="lamp")))
    words = [fault.words for fault in found if fault.frame == 30]
    assert len(words) == 2
    assert not any("others are not" in one for one in words)


@pytest.mark.slow
def test_data_in_the_tails_of_noise_accuse_no_frame():
    for seed, freedom in ((0, 3), (10, 3), (2, 4)):
        bench, rng = Bench(Setup(), np.random.default_rng(seed)), np.random.default_rng([seed, 7])
        tables = []
        for one, bright, ideal in zip(bench.clean, bench.bright, bench.expose(), strict=True):
            seen = one.to_table()
            for beam, flux in zip(("right", "left"), ideal * bright, strict=True):
                error = np.sqrt(flux.ravel() + bench.setup.read_noise**2)
                drawn = rng.standard_t(freedom, error.shape) / np.sqrt(freedom / (freedom - 2))
                seen[f"flux_{beam}"] = (flux.ravel() + error * drawn) * u.adu
                seen[f"flux_{beam}_err"] = error * u.adu
            tables.append(Observations.from_table(seen, name=one.name))
        found = suspect_frames(nominal_model(bench.setup.chains(), tables))
        assert {fault.what for fault in found} == {"noise"}, (seed, freedom)


def test_noise_of_one_wavelength_is_no_single_datum():
    seen = observed().to_table()
    here = np.asarray(seen["bin"] == 2)
    seen["flux_left"][here] *= 1 + 0.1 * np.random.default_rng(6).normal(size=here.sum())
    assert single_data(data.fitted(Observations.from_table(seen, name="lamp"))) == []
    assert single_data(data.clean_model()) == []


def test_what_is_narrow_in_wavelength_but_in_all_frames_is_no_single_data():
    """Such as the line of a filter that turns with the derotator, a bin wide."""
    charis = instruments.get("charis")
    chain = charis.chain(derotator="linear")
    frames = half_wave_plate_cycles(derotator=np.linspace(45, 132.5, 8) * u.deg)
    clean = simulate(chain, charis.wavelength, frames, flux=1e6, seed=1, name="lamp").to_table()
    turn, line = np.cos(2 * clean["derotator"]), np.exp(-((clean["bin"] - 9.0) ** 2))
    for size in (0.04, 0.1):
        seen = clean.copy()
        seen["flux_left"] *= 1 + size * turn * line
        model = nominal_model([chain], [Observations.from_table(seen, name="lamp")])
        assert single_data(model) == []


def test_clean_frames_are_not_accused():
    assert not any(found(observed(seed=seed)) for seed in range(6))


def test_missing_optic_is_not_blamed_on_frames():
    effects = {
        "hwp_encoder_two_lobe": {"cosine": 0.01, "sine": 0.01},
        "beam_gain": {"imbalance": 0.05},
        "source_rotation_drift": {},
    }
    for name, values in effects.items():
        true = data.with_effect(name, **values)
        if not values:
            continue
        assert harmful(found(observed(true=true))) == []


def test_dim_lamp_with_background_is_no_fault_of_frames():
    lamp = np.where(np.arange(N) < 2, 0.5, 1.0)
    seen = observed(lamp=lamp).to_table()
    for beam in ("flux_right", "flux_left"):
        seen[beam] = seen[beam] + 500 * seen[beam].unit
    faults = found(Observations.from_table(seen, name="lamp"))
    assert harmful(faults) == []
    assert {fault.frame for fault in faults} == {0, 1}


def test_two_faults_of_different_kind():
    seen = data.with_flux(plate_off(), np.where(np.arange(N) == 33, 1.02, 1.0))
    assert {(f.frame, f.what) for f in harmful(found(seen))} == {
        (18, "hwp angle"),
        (33, "one beam"),
    }


def test_many_bad_frames_are_no_single_faults():
    frames = table()
    wrong = np.random.default_rng(3).normal(0, 2, N) * (np.arange(N) % 3 == 0)
    frames["hwp_true"] = frames["hwp"] + wrong * u.deg
    assert harmful(found(observed(frames))) == []


def test_one_bad_frame_is_no_wrong_sign():
    said = []
    result = diagnose(data.chain(), observed(table(hwp=(18, 40.0))), progress=said.append)
    assert [fault.frame for fault in result.frames] == [18]
    assert not [line for line in said if line.startswith("trying")]


def test_lamp_is_named_and_not_masked():
    seen = observed(lamp=np.where(np.arange(N) == 9, 0.9, 1.0))
    (fault,) = found(seen)
    assert (fault.frame, fault.what) == (9, "lamp")
    # one that grows brighter towards the end of a run drifts
    brighter = 1 + 0.03 * np.clip((np.arange(N) - 36) / 12, 0, 1) ** 2
    assert found(observed(lamp=brighter)) == []
    np.testing.assert_allclose(fault.value, 0.9, atol=0.01)
    assert not without_frames([seen], [fault])[0].mask.any()


def test_fit_without_the_frames_is_down_to_the_noise():
    model = data.fitted(plate_off())
    faults = all_faults(model)
    (left,) = without_frames(model.observations, faults)
    assert np.flatnonzero(left.mask.all(axis=1)).tolist() == [18]
    again = data.fitted(left)
    assert model.p_value < 1e-6 < 1e-3 < again.p_value
    assert all_faults(again) == []


def test_model_is_left_as_it_was():
    model = data.fitted(plate_off())
    before = model.residual, model.fit.coefficients.copy()
    all_faults(model)
    np.testing.assert_array_equal(model.residual, before[0])
    np.testing.assert_array_equal(model.fit.coefficients, before[1])


def test_dictionary_is_json_and_frames_go_by_their_numbers():
    seen = plate_off().to_table()
    seen["frame"] = seen["frame"] + 100
    (fault,) = found(Observations.from_table(seen, name="lamp"))
    entry = json.loads(json.dumps(fault.to_dict()))
    assert (entry["frame"], entry["what"], entry["with"]) == (118, "hwp angle", None)
    assert entry["dataset"] == "lamp"
    assert 0.9 < entry["probability"] <= 1


def test_single_wavelength_of_another_instrument():
    irdis = instruments.get("irdis")
    chain = irdis.chain("polarized", wavelength=irdis.wavelength[2:3])
    frames = half_wave_plate_cycles(
        hwp=np.arange(0, 90, 11.25) * u.deg, derotator=np.arange(0, 180, 22.5) * u.deg
    )
    frames["hwp_true"] = frames["hwp"] + np.where(np.arange(64) == 21, 5.0, 0) * u.deg
    seen = simulate(chain, irdis.wavelength[2:3], frames, seed=4).to_table()
    seen.remove_column("hwp_true")
    seen = Observations.from_table(seen, name="irdis")
    # with one number a frame the kind cannot be told, but the frame can
    (fault,) = found_of(chain, seen)
    assert fault.frame == 21


def found_of(chain, observations):
    return harmful(all_faults(data.fitted(observations, [chain])))


@pytest.mark.long
def test_cases_of_another_simulator(shared_data):
    for folder in ["gap-cases-2"]:
        root = shared_data / folder
        if not root.exists():
            pytest.skip(f"no {folder} in the shared folder")
        expected = {
            "case005": {(38, "exchanged"), (41, "exchanged")},
            "case008": {(36, "one beam")},
            "case044": {(18, "hwp angle")},
            "case000": set(),
            "case019": set(),
            "case046": set(),
        }
        for case, named in expected.items():
            seen = [Observations.read(root / case / f"{s}polarized.ecsv") for s in ("", "un")]
            chains = instruments.get("charis").chains_for(seen, derotator="linear")
            faults = harmful(all_faults(nominal_model(chains, seen)))
            assert {(fault.frame, fault.what) for fault in faults} == named, case


# --- frames of a single beam -------------------------------------------------------------------

WAVELENGTH = [0.6, 0.7, 0.8] * u.um


def single_chain(turning):
    """A polarizer that turns, and a wheel of polarizers or a plate that turns and a polarizer."""
    lamp = optics.LinearPolarizer(mount="calibrator", name="calibrator")
    if not turning:
        states = [
            optics.StateAnalyser(
                efficiency=0.95, theta=t * u.deg, name=f"pol{t}", mount=f"filter=POL{t}"
            )
            for t in (0, 60, 120)
        ]
        return join([lamp, *states])
    plate = optics.LinearRetarder(
        retardance=[60, 105, 150] * u.deg, mount="plate", name="plate", fixed={"theta": False}
    )
    return join([lamp, plate, optics.LinearPolarizer(name="analyser")])


def single(turning, error=(), factor=1.0, at=(), seed=1):
    """Frames of a single beam, in some of which a stage stood elsewhere or the lamp was bright."""
    if turning:
        n = 40
        columns = {
            "calibrator": np.linspace(3, 178, n),
            "plate": (13.7 + 39.1 * np.arange(n)) % 180,
        }
        frames = QTable({key: angle * u.deg for key, angle in columns.items()})
    else:
        turns = np.linspace(3, 178, 24)
        frames = QTable({"calibrator": np.repeat(turns, 3) * u.deg})
        frames["filter"] = np.tile(["POL0", "POL60", "POL120"], 24)
        frames["group"] = np.repeat(np.arange(24), 3)
    stood = frames.copy()
    for stage, offset in error:
        stood[stage][list(at)] += offset * u.deg
    lamp = np.ones(len(frames))
    lamp[list(at)] = factor
    seen = simulate(single_chain(turning), WAVELENGTH, stood, lamp=lamp, flux=1e6, seed=seed)
    seen = seen.to_table()
    for stage, _ in error:
        seen[stage] = frames[stage][np.searchsorted(np.arange(len(frames)), seen["frame"])]
    return Observations.from_table(seen, name="single")


def found_of_single(turning, **options):
    chain = single_chain(turning)
    return all_faults(nominal_model([chain], [single(turning, **options)]))


def test_frame_of_a_single_beam_is_named_with_what_its_design_can_tell():
    (fault,) = found_of_single(True, factor=1.05, at=[17])
    assert (fault.frame, fault.what) == (17, "brightness")
    assert abs(fault.value - 1.05) < 5 * fault.error
    # at one wavelength an angle cannot be distinguished from a brightness, at three it hardly can
    (fault,) = found_of_single(True, error=[("plate", 3)], at=[17])
    assert fault.frame == 17
    assert fault.what == "plate angle" or "cannot tell" in fault.words
    (fault,) = found_of_single(False, factor=0.95, at=[20])
    assert (fault.frame, fault.what, fault.value) == (20, "unknown", None)
    assert "calibrator at" in fault.words
    assert "its brightness is off" in fault.words
    assert fault.words.endswith("its design cannot tell")


def test_angle_of_a_whole_group_is_found():
    faults = found_of_single(False, error=[("calibrator", 4)], at=[21, 22, 23])
    assert [(fault.frame, fault.what) for fault in faults] == [
        (21, "calibrator angle"),
        (22, "calibrator angle"),
        (23, "calibrator angle"),
    ]
    stood = 3 + 7 * 175 / 23 + 4
    assert abs(faults[0].value - stood) < 0.5


def test_clean_frames_of_a_single_beam_are_not_accused():
    assert not any(found_of_single(turning, seed=s) for turning in (True, False) for s in range(5))


def test_of_two_frames_neither_is_known_to_be_the_wrong_one():
    table = single(False, factor=0.9, at=[20]).to_table()
    for seed in range(4):
        # nor does the last bit of the data tell
        bits = np.random.default_rng(seed).integers(-2, 3, len(table))
        table["flux"] *= 1 + np.finfo(float).eps * bits
        seen = Observations.from_table(table, name="single")
        # of the group of frame 20 there is no third one
        seen = seen.with_mask(np.arange(seen.n_frames) == 18, "lost")
        (fault,) = all_faults(nominal_model([single_chain(False)], [seen]))
        assert fault.frame == 19
        assert "frames 19 and 20 alone cannot tell which of them is wrong" in fault.words
