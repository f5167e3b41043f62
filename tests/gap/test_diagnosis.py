# Licensed under a 3-clause BSD style license - see LICENSE
"""Verdicts: on planted effects and cells, on none, on wrong frames and on bad input."""

import json
import warnings
from types import SimpleNamespace

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from astropy.table import QTable
from gap_setups import SETUPS
from scipy.stats import norm
from sky_data import held
from star_data import WAVELENGTH, observe_star, star_chain

from astropolcal import Calibration, Normal, calibrate, instruments, optics
from astropolcal.chain import insert_optic, join, leaves
from astropolcal.exceptions import AstropolcalWarning, GapError
from astropolcal.gap import EFFECTS, Effect, alternatives, diagnose, model, problem
from astropolcal.gap.alternatives import thinned
from astropolcal.gap.cells import Cell
from astropolcal.gap.report import Fitted, to_dict, with_causes
from astropolcal.instruments.telescope import published_mirror
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

pytestmark = pytest.mark.usefixtures("own_instruments")
QUICK = {"cross_validate": False}


def names(cause):
    return [cause.name, *(candidate.name for candidate, _ in cause.aliases)]


# ---- nothing is missing ------------------------------------------------------------------------


def _one_wavelength():
    charis, one = instruments.get("charis"), data.WAVELENGTH[3:4]
    chain = charis.chain(wavelength=one, derotator="linear")
    return chain, simulate(chain, one, data.frames(), flux=1e6, seed=1)


def _unpolarized():
    chain = instruments.get("charis").chain(
        "unpolarized", wavelength=data.WAVELENGTH, derotator="linear"
    )
    truth = chain.copy()
    truth["fold_mirror"].diattenuation = np.full(7, 0.01)
    return chain, simulate(truth, data.WAVELENGTH, data.frames(), flux=1e6, seed=4)


def _few_frames():
    table = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    return data.chain(), data.observed(table=table)


def _masked():
    observations = data.observed()
    mask = np.random.default_rng(1).random((32, 7)) < 0.2
    return data.chain(), observations.with_mask(mask, "clouds")


def _drifting_lamp():
    return data.chain(), data.observed(lamp=1 + 0.3 * np.linspace(0, 1, 32) ** 2)


def _two_runs():
    return [data.chain()] * 2, [data.observed(name="July"), data.observed(seed=2, name="October")]


def _of(name):
    setup = SETUPS[name]()
    return setup.nominal, setup.observed()


CLEAN = [_one_wavelength, _unpolarized, _few_frames, _masked, _drifting_lamp, _two_runs]


@pytest.mark.slow
@pytest.mark.parametrize("make", [*CLEAN, *sorted(set(SETUPS) - {"vampires"})])
def test_clean_data_have_no_gap(make):
    chains, observations = _of(make) if isinstance(make, str) else make()
    found = diagnose(chains, observations, **QUICK)
    assert (found.verdict, found.causes, found.frames) == ("none", [], [])
    assert found.held_out == []
    assert found.gap_before_percent == found.gap_after_percent
    assert found.gap_before_percent == pytest.approx(found.noise_floor_percent, rel=0.3)


@pytest.mark.long
def test_a_prior_with_units_is_that_of_scipy():
    """Of the angle of what is mounted, free or held at another value."""
    window = optics.LinearRetarder(retardance=3 * u.deg, theta=10 * u.deg, name="window")
    truth = insert_optic(data.chain(), window, after="hwp")
    observed, found = data.observed(truth), []
    for prior in (Normal(10 * u.deg, 0.5 * u.deg), norm(10, 0.5)):
        for fixed, angle in ((False, 10), (True, 5)):
            nominal = truth.copy()
            theta = nominal["window"].theta
            theta.value, theta.fixed, theta.prior = angle, fixed, prior
            made = diagnose(nominal, observed, effects=["static_retarder"], **QUICK)
            found.append([(one.name, one.probability) for one in made.causes])
    assert found[0] == found[2] == []
    assert found[1] == found[3] != []


@pytest.mark.slow
def test_calibration_from_a_file(tmp_path):
    observations = data.observed()
    calibrate(data.chain(), observations).write(tmp_path / "cal.asdf")
    found = diagnose(Calibration.read(tmp_path / "cal.asdf"), observations)
    assert found.verdict == "none"
    # the errors of left-out frames are noise
    assert found.held_out[0].chi2 == pytest.approx(1, abs=0.3)


# ---- something is ------------------------------------------------------------------------------

NAMED = [
    ("charis", "derotator_diattenuation", {"diattenuation": 0.005}),
    ("cassegrain", "hwp_diattenuation", {"diattenuation": 0.01}),
    ("irdis lamp", "hwp_tilt", {"cosine": 1 * u.deg, "sine": 0.5 * u.deg}),
    ("irdis star", "m3_diattenuation:m4", {"diattenuation": 0.01}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "effect", "sizes"), NAMED)
def test_an_effect_gets_its_name_and_its_gap_is_closed(name, effect, sizes):
    setup = SETUPS[name]()
    found = diagnose(setup.nominal, setup.observed(setup.with_effect(effect, **sizes)))
    assert found.verdict == "named"
    (cause,) = found.causes
    assert effect in names(cause)
    assert cause.is_named
    assert cause.physical
    assert cause.probability > 0.9
    assert cause.explained > 0.9
    assert found.gap_after_percent < 1.3 * found.noise_floor_percent
    value, low, high = found.held_out[0].shrinkage(found.held_out[-1])
    assert 0 < low <= value <= high
    assert effect in repr(found)


@pytest.mark.slow
def test_what_has_no_name_is_located():
    setup, cell = SETUPS["charis"](), Cell("in:derotator", "retardance_d", "harmonic:hwp:1")
    # too small for a wrong sign to be looked for, which takes most of the time
    true = setup.with_cell(cell, 0.03, 0.018)
    found = diagnose(setup.nominal, setup.observed(true, flux=1e8))
    assert found.verdict == "located"
    (cause,) = found.causes
    assert (cause.name, cause.cell, cause.is_named) == (cell.name, cell, False)
    assert cause.before.percent > 3 * cause.after.percent
    assert found.gap_p_value < 1e-9 < found.remainder_p_value


@pytest.mark.slow
def test_what_no_cell_explains_stays_unexplained():
    """The gain changes from frame to frame by itself, as no optic does."""
    setup, rng = SETUPS["cassegrain"](), np.random.default_rng(2)
    observations = data.with_flux(setup.observed(), 1 + 0.02 * rng.choice([-1, 1], 48))
    found = diagnose(setup.nominal, observations, **QUICK)
    assert found.verdict == "unexplained"
    assert all(cause.probability < 0.5 for cause in found.causes)


@pytest.mark.slow
def test_wrong_parity_is_a_discrete_cause():
    wrong = EFFECTS["mirror_flip"].edit([data.chain()], None).chains[0]
    found = diagnose(wrong, data.observed(flux=1e7), **QUICK)
    assert found.verdict == "named"
    (cause,) = found.causes
    assert cause.effect.kind == "discrete"
    # they cannot be told apart, so they come in the order of the library
    equal = names(cause)
    assert "mirror_flip" in equal
    assert equal == [name for name in EFFECTS if name in equal]
    assert cause.share == pytest.approx(1 / len(equal))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "effect"),
    [
        ("cassegrain", "parallactic_sign"),
        ("rotating", "derotator_sign"),
        ("irdis star", "hwp_tracking_parallactic_sign"),
    ],
)
def test_a_wrong_sign_is_found(name, effect):
    setup = SETUPS[name]()
    observations = setup.observed(setup.with_effect(effect))
    found = diagnose(setup.nominal, observations, **QUICK)
    assert found.causes[0].effect.kind == "discrete"
    assert effect in names(found.causes[0])


# of the alternatives those that are alike: each costs a fit or two
ROWS = {"effects": ["hwp_early", "hwp_late", "angles_early", "angles_late", "hwp_doubled"]}


@pytest.mark.long
def test_angles_of_another_row_or_unit_are_a_mistake_of_the_table():
    few = data.WAVELENGTH[::2]
    right = data.observed(flux=2e7, wavelength=few)
    n = right.n_bins
    late, early = (lambda x: np.r_[x[:n], x[:-n]]), (lambda x: np.r_[x[n:], x[-n:]])
    mistakes = {
        "hwp_late": {"hwp": late},
        "angles_early": {"hwp": early, "derotator": early},
        "hwp_doubled": {"hwp": lambda x: 2 * x},
    }
    for name, columns in mistakes.items():
        table = right.to_table()
        for key, change in columns.items():
            table[key] = change(table[key])
        wrong = Observations.from_table(table)
        with warnings.catch_warnings():
            # one row is lost, and with it a pair of frames
            warnings.simplefilter("ignore", AstropolcalWarning)
            found = diagnose(data.chain(few), wrong, **QUICK, **ROWS, cells=False)
        assert found.verdict == "named"
        assert names(found.causes[0]) == [name]
        content = to_dict(found)
        assert content["sentences"][0].startswith("Correct the table first: angle")
        # frames that such a table pairs are no double differences
        assert content["double_difference"] is None
        edge = {"hwp_late": wrong.n_frames - 1, "angles_early": 0}.get(name)
        assert [fault.frame for fault in found.frames] == ([] if edge is None else [edge])
        # nor has that frame a part in what calibrate says
        assert content["accuracy_after"]["rms_percent"] < 0.1


@pytest.mark.parametrize(
    "in_part",
    [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.long)],
)
def test_a_plate_that_lags_and_cycles_in_another_order_are_one_cause(in_part):
    turn = np.linspace(45, 110, 6) * u.deg
    few = data.WAVELENGTH[::2]
    right = data.observed(flux=1e7, wavelength=few, table=half_wave_plate_cycles(derotator=turn))
    n, cycle = right.n_bins, right.n_frames // len(turn)
    rows = np.arange(right.n_frames)
    middle = (rows >= 3 * cycle) & (rows < 4 * cycle)
    in_reverse = rows - 2 * (rows % cycle) + cycle - 1
    part = f"/dataset:run in frame {3 * cycle}-{4 * cycle - 1}"
    # the row of the run whose angle the table states, and the frames of which it has none
    cases = {
        "hwp_early": (np.roll(rows, -2), [0, 1]),
        "hwp_reversed": (in_reverse, []),
        f"hwp_reversed{part}": (np.where(middle, in_reverse, rows), []),
        f"beams_swapped{part}": (rows, []),
    }
    asked = {"effects": [*ROWS["effects"], "hwp_reversed", "beams_swapped"], "cells": False}
    for name, (order, edge) in cases.items():
        if in_part != (part in name):
            continue
        table = right.to_table()
        table["hwp"] = table["hwp"].reshape(-1, n)[order].ravel()
        if name.startswith("beams"):
            for key in ("{}", "{}_err"):
                one, other = (key.format(f"flux_{side}") for side in ("right", "left"))
                both = np.repeat(middle, n)
                table[one][both], table[other][both] = table[other][both], table[one][both]
        found = diagnose(
            data.chain(few), Observations.from_table(table, name="run"), **QUICK, **asked
        )
        assert found.verdict == "named", name
        assert name in names(found.causes[0])
        assert [fault.frame for fault in found.frames] == edge, name


@pytest.mark.slow
def test_a_misread_angle_is_found_where_the_star_is_hardly_polarized():
    setup = SETUPS["irdis star"]()
    # the plate follows the parallactic angle, and is where the table says that it is not
    cases = {"derotator_halved": ("derotator", 0.5), "parallactic_sign": ("parallactic", -1)}
    for name, (column, factor) in cases.items():
        table = setup.observed(flux=1e6).to_table()
        table[column] *= factor
        found = diagnose(setup.nominal, Observations.from_table(table, name="night"), **QUICK)
        assert found.verdict == "named"
        assert names(found.causes[0]) == [name]


@pytest.mark.long
def test_of_two_tables_the_one_that_is_misread_is_named():
    first, second = (data.observed(flux=1e7, seed=seed, name=f"run {seed}") for seed in (1, 2))
    table = second.to_table()
    table["hwp"] = np.roll(table["hwp"], second.n_bins)
    second = Observations.from_table(table, name="run 2")
    found = diagnose(data.chain(), [first, second], **QUICK, **ROWS, cells=False)
    assert found.verdict == "named"
    assert names(found.causes[0]) == ["hwp_late/dataset:run 2"]
    assert [(fault.dataset, fault.frame) for fault in found.frames] == [("run 2", 31)]
    sentences = to_dict(found)["sentences"]
    assert 'in the table of "run 2" only' in sentences[0]
    assert "run 2, frame 31: its angle is in no row" in sentences[1]


@pytest.mark.long
def test_what_goes_wrong_in_the_middle_of_a_run_is_found():
    """A frame is lost, or the angles of all later ones are in disorder."""
    turn = np.linspace(45, 110, 4) * u.deg
    right = data.observed(flux=1e7, table=half_wave_plate_cycles(derotator=turn))
    n = right.n_bins
    mixed = np.random.default_rng(1).permutation(right.n_frames - 20)
    for is_lost in (True, False):
        table = right.to_table()
        later = table["hwp"][20 * n :].reshape(-1, n)
        later = np.vstack([later[1:], later[-1:]]) if is_lost else later[mixed]
        table["hwp"][20 * n :] = later.ravel()
        wrong = Observations.from_table(table, name="run")
        with warnings.catch_warnings():
            # some frames have no partner then
            warnings.simplefilter("ignore", AstropolcalWarning)
            found = diagnose(data.chain(), wrong, **QUICK, **ROWS, cells=False)
        first, second, *_ = to_dict(found)["sentences"]
        if is_lost:
            told = sorted(names(found.causes[0]))[-1]
            assert told.startswith("hwp_early/dataset:run from frame 2")
            assert "its data are those of the half-wave plate" in second
            assert found.gap_after_percent < 0.2
        else:
            assert found.verdict == "unexplained"
            assert first.startswith('The model does not fit "run from frame 2')


@pytest.mark.slow
def test_an_angle_in_no_row_does_not_hide_that_a_short_table_is_late():
    right = data.observed(table=half_wave_plate_cycles(derotator=[45, 80] * u.deg))
    table = right.to_table()
    for shift, name in ((-1, "hwp_early"), (1, "hwp_late")):
        table["hwp"] = np.repeat(np.roll(right.position("hwp"), shift), right.n_bins) * u.rad
        wrong = Observations.from_table(table)
        found = diagnose(data.chain(), wrong, **QUICK, **ROWS, cells=False)
        assert (found.verdict, names(found.causes[0])) == ("named", [name])


def test_an_alternative_that_leaves_no_pair_of_frames_is_not_asked_for():
    chain = data.chain()
    for leaf in leaves(chain):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    table = half_wave_plate_cycles([0, 45] * u.deg, derotator=[45] * u.deg)
    table = data.observed(table=table).to_table()
    table["hwp"] += 15 * u.deg
    options = QUICK | {"effects": ["hwp_late"], "cells": False}
    found = diagnose(chain, Observations.from_table(table), **options)
    assert found.verdict == "unexplained"


@pytest.mark.slow
def test_what_was_found_and_saved_may_have_changed_again():
    nominal, options = data.chain(), {"effects": ["beam_gain"], "cells": False}
    for night, gain in enumerate((1.01, 1.03, 1.05), 1):
        seen = data.with_flux(data.observed(seed=night), np.full(32, gain))
        diagnosis = diagnose(nominal, seen, **options, cross_validate=False)
        assert [cause.name for cause in diagnosis.causes] == ["beam_gain"]
        nominal = with_causes(Fitted(diagnosis.improved))
        gains = [o.imbalance.value for o in leaves(nominal.chains[0]) if "beam_gain" in o.name]
        assert len(gains) == night
        assert np.allclose(sum(gains), (gain - 1) / (gain + 1), atol=1e-3)
    assert not diagnose(nominal, seen, **options, cross_validate=False).causes


@pytest.mark.slow
def test_an_alternative_beside_which_much_is_left_is_not_sure():
    """Of the beams, exchanged in most of the run, an alternative explains no more than a part."""
    right = data.observed(flux=1e7)
    table = right.to_table()
    late = np.arange(len(table)) > len(table) / 5
    for key in ("", "_err"):
        one, other = table[f"flux_right{key}"].copy(), table[f"flux_left{key}"].copy()
        table[f"flux_right{key}"] = np.where(late, other, one)
        table[f"flux_left{key}"] = np.where(late, one, other)
    asked = {"effects": ["beams_swapped", "mirror_flip", "static_retarder", "hwp_late"]}
    found = diagnose(data.chain(), Observations.from_table(table), **QUICK, **asked, cells=False)
    assert found.verdict == "unexplained"
    assert found.causes[0].effect.kind == "discrete"
    assert found.causes[0].probability < 0.9


def _one_beam(drift, retardance):
    """Return a chain of one beam with extinction, and data that lack a retarder or a calm lamp."""
    wavelength = [1.0, 1.3, 1.7] * u.um
    plate = optics.LinearRetarder(retardance=[120, 128, 135] * u.deg, mount="plate", name="plate")
    plate.retardance.bounds = (100, 150)
    first = optics.LinearPolarizer(mount="calibrator", name="calibrator")
    chain = first | plate | optics.LinearPolarizer(name="analyser")
    window = optics.LinearRetarder(retardance=retardance, theta=45 * u.deg, name="window")
    frames = QTable({"calibrator": np.repeat([0, 45, 80, 130], 16) * u.deg})
    frames["plate"] = np.tile(3 + np.arange(16) * 22.5, 4) * u.deg
    frames["group"] = np.repeat(np.arange(4), 16)
    lamp = 1 + drift * np.linspace(-1, 1, len(frames))
    truth = insert_optic(chain, window, before="analyser")
    return chain, simulate(truth, wavelength, frames, flux=1e7, seed=1, lamp=lamp, name="lamp")


def test_one_beam_has_intensities_and_no_gain_between_beams():
    for drift, retardance in ((0.02, 0 * u.deg), (0, 2 * u.deg)):
        chain, seen = _one_beam(drift, retardance)
        found = diagnose(chain, seen)
        content = to_dict(found)
        (cause,) = content["causes"]
        assert cause["probability"] > 0.9
        said = json.dumps([content[key] for key in ("sentences", "causes", "where", "scores")])
        assert "beam" not in said
        assert ("brightness of the source, or gain" in said) == bool(drift)
        assert "percent of the mean of their group" in said
        # shot noise: of that the frames that are nearly dark have the least
        noise = found.noise_floor_percent
        assert noise == pytest.approx(100 / np.sqrt(seen.flux_right.mean()), rel=0.1)
        assert found.gap_after_percent < 1.1 * noise < 0.3 * found.gap_before_percent


def test_a_wavelength_that_has_the_gap_alone_comes_first():
    few = data.WAVELENGTH[:5]
    rng, table = np.random.default_rng(3), data.observed(flux=1e7, wavelength=few).to_table()
    nm = np.round(table["wavelength"].to_value(u.nm))
    table["flux_right"] = table["flux_right"] * np.where(
        nm == nm[3], rng.normal(1, 0.03, len(nm)), 1
    )
    found = diagnose(data.chain(few), Observations.from_table(table), **QUICK)
    # it may be a perturbation as well, but that has a law in wavelength
    assert found.courses
    assert found.verdict == "unexplained"
    content = to_dict(found)
    assert content["sentences"][0].endswith(f"lies at {nm[3]:.0f} nm.")
    assert all(one["axis"] != "course" for one in content["where"])


@pytest.mark.slow
def test_noise_that_neighbouring_wavelengths_share_has_no_cause():
    """It is no larger than stated, and its patterns repeat themselves."""
    rng, table = np.random.default_rng(4), data.observed(flux=1e12, seed=4).to_table()
    near = np.exp(-(np.subtract.outer(np.arange(7), np.arange(7)) ** 2) / 4)
    near /= np.linalg.norm(near, axis=0)
    for beam in ("flux_right", "flux_left"):
        flux = table[beam].value
        sigma = 1e-3 * np.sqrt(np.mean(flux) * flux)
        noise = rng.normal(size=(len(table) // 7, 7)) @ near
        table[beam] = (flux + noise.ravel() * sigma) * table[beam].unit
        table[f"{beam}_err"] = sigma * table[beam].unit
    found = diagnose(data.chain(), Observations.from_table(table, name="lamp"))
    assert (found.verdict, found.causes) == ("none", [])


@pytest.mark.slow
def test_wrong_frames_are_named_and_left_out():
    table = data.frames()
    table["hwp_true"] = table["hwp"] + np.where(np.arange(32) == 5, 3.0, 0.0) * u.deg
    # the table does not say where the plate stood
    table = data.observed(table=table, flux=1e7).to_table()
    table.remove_column("hwp_true")
    found = diagnose(data.chain(), Observations.from_table(table))
    assert [(fault.frame, fault.what) for fault in found.frames] == [(5, "hwp angle")]
    assert (found.verdict, found.causes) == ("none", [])
    for one in (found.nominal, found.improved):
        mask = one.observations[0].mask
        assert mask[5].all()
        assert mask.sum() == 7


# ---- on sky ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_star_tells_what_a_chain_without_free_parameters_lacks():
    chain = star_chain()
    chain["m3"].diattenuation = published_mirror().diattenuation(WAVELENGTH)
    found = diagnose(held(chain), observe_star(chain, seed=4))
    assert (found.verdict, found.causes) == ("none", [])
    star = observe_star(chain, seed=3, parallactic=(-60, 60))
    found = diagnose(held(chain, without=["m3"]), star)
    assert found.verdict == "named"
    assert found.causes[0].name == "m3_diattenuation"
    measured = found.chains[0]["gap_m3_diattenuation"].diattenuation.value
    np.testing.assert_allclose(measured, chain["m3"].diattenuation.value, atol=3e-4)
    assert found.gap_after_percent < 0.2 * found.gap_before_percent


@pytest.mark.long
def test_a_wrong_sign_is_not_told_where_one_cause_does_better():
    """The polarization of a standard is a little off: halved plate angles explain most of it."""
    source = "polarized standard star"
    chain = star_chain(source, target="HD 30675", derotator="linear")
    star, *behind = leaves(chain)
    q, stokes_u = star.q.value + 0.003, star.u.value - 0.0052
    true = join([optics.PolarizedSource(q=q, u=stokes_u, name=star.name), *behind])
    how = {"target": "HD 30675", "parallactic": (20, 50), "flux": 1e7, "seed": 3}
    found = diagnose(held(chain), observe_star(true, 6, source, **how))
    assert found.verdict == "named"
    # which the data do not tell apart
    assert found.causes[0].name in ("standard_polarization", "sky_background")


# ---- bad input ---------------------------------------------------------------------------------


def test_bad_input_is_refused_in_one_line(monkeypatch):
    chain, observed = data.chain(), data.observed()
    one = data.observed(table=data.frames()[:1])
    short = data.observed(table=half_wave_plate_cycles(derotator=[45] * u.deg))
    two = [data.observed(meta={"instrument": name}) for name in ("CHARIS", "IRDIS")]
    cases = {
        "too few frames to leave out in groups: 8 in the shortest": (chain, short, {}),
        "of different instruments: CHARIS and IRDIS": (chain, two, {}),
        "model or datasets are of different instruments: CHARIS and GPI": (
            SimpleNamespace(instrument="GPI"),
            two[0],
            {},
        ),
        "2 chains for 1 datasets": ([chain] * 2, [observed], {}),
        "no effects to ask for; give names, or 'all'": (chain, observed, {"effects": []}),
        "no effect 'beam_gian'.*'beam_gain'": (chain, observed, {"effects": ["beam_gian"]}),
        "too few frames to leave out in groups: 1 in the shortest": (chain, one, {}),
    }
    # of one's own, or of the library, which no chain has a place for
    for message, place, dependence in (
        ("e: optic of its place = 'hpw'; allowed are .*did you mean 'hwp'", "in:hpw", "time"),
        ("e: place = 'telescope'; allowed are source, in:hwp", "telescope", "time"),
        ("e: stage of its dependence move:x = 'x'; allowed are hwp", "in:hwp", "move:x"),
        ("e: dependence = 'step:32'; frames are 0 to 31", "in:hwp", "step:32"),
        ("e: dataset of its dependence = 'x'; allowed are lamp", "in:hwp", "time/dataset:x"),
    ):
        one = Effect("e", "e", place, "rotation", dependence)
        cases[f"effect {message}"] = (chain, observed, {"effects": [one]})
    cases["effect altitude_sign: "] = (chain, observed, {"effects": ["altitude_sign"]})
    for message, (chains, observations, options) in cases.items():
        with pytest.raises(GapError, match=message) as refused:
            diagnose(chains, observations, **options)
        assert "\n" not in str(refused.value)
    monkeypatch.setattr(
        problem.GapProblem,
        "fit",
        lambda self, *args, **kwargs: problem.Fit(self.start, np.inf, False),
    )
    with pytest.raises(GapError, match="the nominal fit did not converge"):
        diagnose(chain, observed)


def test_a_nominal_fit_ends_where_its_last_steps_gain_next_to_nothing(monkeypatch):
    observed = [data.observed(data.chain())]

    def creeping(share):
        """Return a fit that never converges, and lowers chi-square by a share each time."""
        chi2 = 1e6

        def fit(self, *args, **kwargs):
            nonlocal chi2
            chi2 *= 1 - share
            return problem.Fit(self.start, chi2, False)

        return fit

    monkeypatch.setattr(problem.GapProblem, "fit", creeping(0.01))
    assert not model.nominal_model([data.chain()], observed).fit.converged
    monkeypatch.setattr(problem.GapProblem, "fit", creeping(0.1))
    with pytest.raises(GapError, match="the nominal fit did not converge"):
        model.nominal_model([data.chain()], observed)


# ---- model ------------------------------------------------------------------------------


def test_a_sign_may_be_wrong_where_double_differences_are_far_off():
    cases = [
        # one percent is a sign that may be wrong, whatever the signal
        (0.9, 0.011, 1e-3, True),
        (0.9, 0.009, 1e-3, False),
        # of a small signal a tenth is enough, if it is above the noise
        (0.01, 0.004, 1e-3, True),
        (0.01, 0.004, 2e-3, False),
        (0.01, 0.0011, 1e-4, True),
        (0.01, 0.0009, 1e-4, False),
        # what has no stated errors has no noise to compare with
        (0.01, 0.004, np.nan, True),
    ]
    for observed, residual, sigma, wrong in cases:
        part = SimpleNamespace(observed=np.full(20, observed), sigma=np.full(20, sigma))
        left = residual * np.resize([1.0, -1.0], 20)
        measurement = SimpleNamespace(datasets=[part], residuals=lambda left=left: left)
        given = SimpleNamespace(measurement=measurement)
        assert alternatives._may_be_wrong(given) == wrong, (observed, residual, sigma)


def test_thinned_data_are_spread_over_the_wavelengths():
    chain, observations, grid = data.chain(), data.observed(), data.WAVELENGTH.value
    whole = chain["derotator"].retardance.value
    for count in (1, 3, 5):
        (few_chain,), (few,) = thinned([chain], [observations], count)
        found = few.wavelength.to_value(u.nm)
        assert len(found) == count
        assert found[0] == pytest.approx(grid[0])
        assert count == 1 or found[-1] == pytest.approx(grid[-1])
        # parameters are those at these wavelengths
        picked = np.isin(np.round(grid), np.round(found))
        np.testing.assert_allclose(few_chain["derotator"].retardance.value, whole[picked])
    assert thinned([chain], [observations], 7) == ([chain], [observations])


@pytest.mark.slow
def test_a_large_gap_is_not_taken_for_noise():
    """Unequal gains of 3 % are rough in wavelength; a retarder of 0.04 deg lies below."""
    charis = instruments.get("charis")
    wavelength = charis.wavelength[[2, 6, 10, 14, 18, 20]]
    nominal = charis.chain(derotator="linear", wavelength=wavelength)
    window = optics.LinearRetarder(retardance=0.04 * u.deg, name="window")
    truth = insert_optic(nominal, window, after="hwp") | optics.BeamGain(imbalance=0.03)
    frames = half_wave_plate_cycles(derotator=np.arange(45, 135, 12.5) * u.deg)
    run = simulate(truth, wavelength, frames, flux=1e7, seed=1)
    found = diagnose(nominal, run)
    content = to_dict(found)
    noise = content["double_difference"]["noise_percent"]
    stated = 100 * np.sqrt(np.mean(Measurement(nominal, run).sigma ** 2))
    assert abs(noise / stated - 1) < 0.02
    assert content["double_difference"]["after_percent"] < 1.1 * noise
    assert found.causes[0].name == "beam_gain"
    assert "after:hwp/retardance_h/constant" in [
        f"{c.place}/{c.kind}/{c.dependence}" for c in found.causes[1].effect.cells(nominal)
    ] + names(found.causes[1])
