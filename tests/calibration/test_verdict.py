# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether a calibration is usable, why not, and that it is said in 24 lines of 80 columns."""

import json
import warnings
from pathlib import Path
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import models
from astropy.table import QTable
from star_data import observe_star, star_chain

import astropolcal
from astropolcal import Calibration, Observations, calibrate, instruments, optics
from astropolcal.calibration.result import verdict as verdicts
from astropolcal.calibration.result.verdict import verdict
from astropolcal.calibration.uncertainty.covariance import status_of
from astropolcal.chain import follow
from astropolcal.exceptions import AstropolcalWarning
from astropolcal.pipeline.headers import faults_of
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")


def _entry(value, std=np.nan, unit=None, **flags):
    shape = np.shape(value)
    known = {"value": np.asarray(value, float), "std": np.broadcast_to(std, shape), "unit": unit}
    known |= {"fixed": False, "tied": None, "at_bound": np.zeros(shape, bool), "bounds": (0, 2)}
    known |= {"identifiable": np.isfinite(known["std"]), "std_released": np.full(shape, np.nan)}
    return known | flags | {"status": status_of(known | flags)}


def _calibration(source=None, s_res=0.1, **fit):
    accuracy = QTable({"s_res": np.full(3, s_res) * u.percent})
    record = SimpleNamespace(name="night", source=source, accuracy=accuracy)
    return SimpleNamespace(fit=fit, datasets=[record])


def _test(times, p_value):
    return {"times_noise": times, "p_value": p_value, "words": ""}


def fits_a_terminal(calibration):
    """Return the summary's lines after a look at their size, in full as well."""
    lines = calibration.summary().splitlines()
    assert len(lines) < 24
    assert lines[:5] == calibration.verdict().words
    assert lines[-1].startswith("--full")
    full = calibration.summary(full=True)
    assert max(map(len, [*lines, *full.splitlines()])) <= 80
    assert full.splitlines()[:5] == lines[:5]
    return lines


# ---- whole calibrations -------------------------------------------------------------------


@pytest.fixture(scope="module")
def example():
    path = Path(astropolcal.__file__).parent / "data" / "charis_example.ecsv"
    return Observations.read(path)


@pytest.mark.slow
def test_the_example_leaves_the_zero_of_the_angle_open(example, tmp_path):
    (chain,) = CHARIS.chains_for([example])
    cal = calibrate(chain, example, instrument="charis", cross_validate=False)
    found = cal.verdict()
    assert not found.usable
    assert found.reasons == ["AoLP and DoLP on sky are open (calibration_polarizer.theta)"]
    first, accuracy, determined, missing, advice = fits_a_terminal(cal)[:5]
    assert first == f"NOT USABLE AS IT IS: {found.reasons[0]}"
    assert accuracy == "On sky      30, 1, 0.1 % open, AoLP open"
    assert determined.startswith("Determined  23 of 93: hwp.w_sio2, hwp.w_mgf2")
    assert missing.startswith("Not         69 open, 1 at bound: calibration_polarizer.theta")
    assert advice.endswith("or --fix hwp.theta if its mount is known")
    # the same from a file, and for machines
    cal.write(tmp_path / "cal.asdf")
    again = Calibration.read(tmp_path / "cal.asdf")
    assert again.verdict() == found
    assert json.loads(json.dumps(again.to_dict(), allow_nan=False))["verdict"] == found.to_dict()
    # and with the advice followed
    held = calibrate(chain, example, fix={"hwp.theta": None}, cross_validate=False)
    assert held.verdict().usable
    assert "open (not seen on sky)" in fits_a_terminal(held)[3]
    assert held.verdict().words[1].endswith("deg")


def test_beams_are_no_suspects_where_frames_are_wrong_or_there_is_one_beam():
    """A frame whose plate stood elsewhere, and a plate that is always off by its own angle."""
    plate = optics.LinearRetarder(retardance=125 * u.deg, mount="turning", name="plate")
    lamp = optics.LinearPolarizer(mount="first", name="lamp", fixed={"theta": False})
    frames = QTable({"turning": np.tile(np.arange(0, 180, 22.5), 6) * u.deg})
    frames["first"] = np.repeat(np.arange(7, 180, 30), 8) * u.deg
    frames["group"] = np.repeat(np.arange(6), 8)
    one, wave = np.arange(48) == 20, 0.4 * np.sin(2 * frames["turning"])
    for analyser, off, asked in [
        (optics.WollastonPrism(efficiency=0.98, name="prism"), 2 * one, "wrong frames?"),
        (optics.LinearPolarizer(name="analyser"), wave, "diagnose: why"),
    ]:
        chain = lamp | plate | analyser
        data = simulate(chain, [0.5, 0.6] * u.um, frames, flux=1e6, seed=1, name="run")
        table = data.to_table()
        table["turning"] += np.repeat(off, 2) * u.deg
        cal = calibrate(chain, Observations.from_table(table, name="run"), cross_validate=False)
        lines = fits_a_terminal(cal)
        assert asked in lines[0], lines
        at_odds = "At odds     frame 20 of run, by " in cal.summary()
        assert at_odds is (asked == "wrong frames?"), cal.summary()


@pytest.mark.slow
def test_exchanged_beams_are_asked_about_where_little_else_shows_them(example):
    """With polarizer and plate held, the other angles make up for all but 1.2 % of polarization."""
    table, fix = example.to_table(), ["calibration_polarizer.theta", "hwp.theta"]
    for right, left in (("flux_right", "flux_left"), ("flux_right_err", "flux_left_err")):
        table[right], table[left] = table[left].copy(), table[right].copy()
    for data, asked in ((example, False), (Observations.from_table(table), True)):
        cal = calibrate(CHARIS.chains_for([data])[0], data, fix=fix, cross_validate=False)
        assert ("beams exchanged?" in fits_a_terminal(cal)[0]) is asked


@pytest.mark.slow
def test_a_polarized_star_alone_determines_nothing():
    options = {"target": "HD 30675", "star": "star_HD30675"}
    truth = star_chain("polarized standard star", **options)
    data = observe_star(truth, 8, source="polarized standard star", target="HD 30675", seed=1)
    cal = calibrate(CHARIS.chains_for([data]), [data], instrument="charis", cross_validate=False)
    found = cal.verdict()
    assert not found.usable
    assert any("is known to" in reason or "larger than" in reason for reason in found.reasons)
    assert "the internal source with its polarizer" in fits_a_terminal(cal)[4]


def test_a_forgotten_mount_leaves_nothing_to_fit(example):
    n = len(example.wavelength)
    own = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.LinearRetarder(retardance=np.full(n, -172) * u.deg, name="plate")
        | optics.WollastonPrism(efficiency=np.full(n, 0.98), name="prism")
    )
    cal = calibrate(own, example, cross_validate=False)
    assert cal.converged
    assert cal.identifiability.rank == 0
    found = cal.verdict()
    assert found.reasons[0] == "no free parameter changes any datum"
    lines = fits_a_terminal(cal)
    assert "mount=" in lines[4]
    # a number there would be none of this instrument
    assert "unknown" in lines[1]


@pytest.mark.long
def test_real_data_fit_a_terminal(shared_data):
    for name, patterns, first in (
        ("charis", ["charis/dataset3*", "charis/dataset4*", "charis/hd293396*"], "Usable: "),
        (
            "vampires",
            ["vampires/*internal_[67o]*"],
            "NOT USABLE AS IT IS: orientations depend on the bound of derotator.theta",
        ),
    ):
        found = [sorted(shared_data.glob(f"data/{pattern}")) for pattern in patterns]
        if not all(found):
            pytest.skip(f"no real tables of {name}")
        instrument = instruments.get(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", astropolcal.exceptions.AstropolcalWarning)
            data = [instrument.prepare(Observations.read(p)) for paths in found for p in paths]
        cal = calibrate(instrument.chains_for(data), data, instrument=name, cross_validate=False)
        assert fits_a_terminal(cal)[0].startswith(first)


# ---- reasons one by one -----------------------------------------------------------------------


def test_a_fit_that_did_not_arrive_is_not_usable(make):
    lam = [1.2, 1.6, 2.2] * u.um
    chain = make.chain(wavelength=lam)
    cal = calibrate(chain, make.observe(make.truth(chain), wavelength=lam, seed=1))
    assert cal.verdict().usable
    assert fits_a_terminal(cal)[0] == "Usable"
    cal.fit["converged"] = False
    assert cal.verdict().reasons == ["the fit did not converge"]
    assert verdict(cal).words[0] == "NOT USABLE AS IT IS: the fit did not converge"


def test_what_is_wrong_is_told_without_looking_at_the_sky(make, monkeypatch):
    """Which takes long; and not by what the words are: tables have any name."""
    lam = [1.2, 1.6, 2.2] * u.um
    chain = make.chain(wavelength=lam)
    cal = calibrate(chain, make.observe(make.truth(chain), wavelength=lam, seed=1))
    assert faults_of(cal, "night.asdf") == []
    cal.fit["converged"] = False
    cal.datasets[0].name, cal.datasets[0].source = "lamp on sky side", "unpolarized"
    table = QTable({"diattenuation": [99, 98, 99] * u.percent})
    table["diattenuation_err"] = [1, 1, 1] * u.percent
    monkeypatch.setattr(verdicts, "mirror_names", lambda calibration: ["m3"])
    monkeypatch.setattr(verdicts, "mirror_values", lambda calibration, name: table)
    reasons = cal.verdict().reasons
    monkeypatch.delattr(verdicts, "target_accuracies")
    with pytest.warns(AstropolcalWarning, match="is lamp on sky side really 'unpolarized'"):
        assert faults_of(cal, "night.asdf") == reasons
    assert len(reasons) == 2


def test_a_parameter_at_a_bound_nearly_everywhere():
    for stuck, words in ((1, ""), (2, "at a bound at most wavelengths: w.efficiency (2 of 3)")):
        free = {
            "w.efficiency": _entry([1.0, 1.0, 1.0], at_bound=np.arange(3) < stuck),
            "hwp.theta": _entry(1.0, at_bound=np.array(True)),
        }
        assert verdicts._stuck(free) == words


def test_most_angles_at_bounds_and_large_residuals():
    for stuck, p_values, says in (
        (1, (0.0, 0.0), False),
        (2, (0.0, 0.0), True),
        (3, (0.0, 0.0), True),
        (3, (0.3, 0.3), False),
        # one estimate of the noise excuses them
        (3, (0.3, 0.0), False),
        (3, (np.nan, np.nan), False),
    ):
        free = {
            name: _entry(1.0, unit="deg", at_bound=np.array(i < stuck))
            for i, name in enumerate(("polarizer.theta", "hwp.theta", "derotator.theta"))
        } | {"hwp.w_sio2": _entry(1.6, unit="mm")}
        tests = [_test(times, p) for times, p in zip((41.2, 80.0), p_values, strict=True)]
        # with a probability of 0.3 they agree with that noise
        tests = [test | {"times_noise": 1.1} if test["p_value"] == 0.3 else test for test in tests]
        words = verdicts._angles(_calibration(lack_of_fit=tests), free)
        assert bool(words) is says
        if says:
            assert "are beams or signs exchanged? (polarizer.theta, hwp.theta" in words
            assert "41.2 times the noise" in words


def test_a_mirror_that_polarizes_as_none_does(monkeypatch):
    for source, percent, std, fixed, says in [
        ("unpolarized", [-99.0, -98.0, -100.0], np.nan, False, True),
        ("unpolarized standard star", [60.0, 70.0, 1.0], 2.0, False, True),
        # one wavelength that went astray, a small one, one within its error, and one held
        ("unpolarized", [60.0, 2.0, 1.0], np.nan, False, False),
        ("unpolarized", [8.0, 9.0, 9.0], 0.1, False, False),
        ("unpolarized", [60.0, 70.0, 80.0], 20.0, False, False),
        ("unpolarized", [60.0, 70.0, 80.0], np.nan, True, False),
        ("polarized", [-99.0, -98.0, -100.0], np.nan, False, False),
        (None, [-99.0, -98.0, -100.0], np.nan, False, False),
    ]:
        table = QTable({"diattenuation": percent * u.percent})
        table["diattenuation_err"] = np.full(3, std) * u.percent
        monkeypatch.setattr(verdicts, "mirror_names", lambda calibration: ["m3"])
        monkeypatch.setattr(verdicts, "mirror_values", lambda calibration, name, t=table: t)
        known = {"m3.diattenuation": _entry(np.array(percent) / 100, fixed=fixed)}
        words = verdicts._mirrors(_calibration(source), known)
        told = f"m3 polarizes by more than 30 %, as no mirror does: is night really {source!r}?"
        assert [*words] == ([told] if says else []), (source, fixed, says)


def test_a_lamp_without_its_polarizer_is_no_prism_without_efficiency():
    grid = [1.2, 1.45, 1.6, 1.9, 2.2] * u.um
    chains = {
        source: CHARIS.chain(source, derotator="linear", wavelength=grid)
        for source in ("polarized", "unpolarized")
    }
    frames = half_wave_plate_cycles(derotator=[45, 60, 75, 90, 110, 130] * u.deg)
    asks = "wollaston.efficiency is below 50 %, as of no prism: is lamp really 'polarized'?"
    for true, says in (("polarized", False), ("unpolarized", True)):
        for seed in range(3):
            told = {"meta": {"source": "polarized"}, "name": "lamp", "seed": seed}
            seen = simulate(chains[true], grid, frames, **told)
            reasons = calibrate(chains["polarized"], seen).verdict().reasons
            assert (reasons[:1] == [asks]) == says, reasons


def test_residuals_of_a_model_that_is_none():
    bad, good = [_test(60.0, 0.0)], [_test(1.0, 0.4)]
    assert verdicts._misfit(_calibration(s_res=1.5, lack_of_fit=bad)) == ""
    # noise may be large
    assert verdicts._misfit(_calibration(s_res=20.0, lack_of_fit=good)) == ""
    assert verdicts._misfit(_calibration(s_res=np.nan, lack_of_fit=bad)) == ""
    # 9 times a noise that few numbers tell may be chance, and is no excuse
    for tests in (bad, [*bad, _test(9.4, 0.07)]):
        words = verdicts._misfit(_calibration(s_res=20.0, lack_of_fit=tests))
        assert words == "the model misses the data by 20 %, 60 times the noise"
    assert verdicts._misfit(_calibration(s_res=20.0, lack_of_fit=[_test(9.4, 0.07)])) == ""


def test_errors_that_say_that_nothing_is_known():
    wide = {"bounds": (-360, 360)}
    for entry, words in (
        (_entry(1.0, 9.0, u.deg, **wide), []),
        (_entry(1.0, 1328.0, u.deg, bounds=(None, None)), ["a.b is known to 1.33e+03 deg only"]),
        (_entry(1.0, 1.9, u.mm), []),
        (_entry(1.0, 2.1, u.mm), ["errors larger than the bounds: a.b"]),
        (_entry([1.0, 1.0, 1.0], [3, 3, 0.1]), ["errors larger than the bounds: a.b"]),
        (_entry([1.0, 1.0, 1.0], [3, 0.1, 0.1]), []),
        (_entry([1.0, 1.0, 1.0], 100.0, u.deg, **wide), []),
    ):
        assert verdicts._absurd({"a.b": entry}) == words


def test_the_constant_of_a_law_far_from_its_frames():
    """A law is known to 0.01 deg at all wavelengths, and to 30 deg where these are zero."""
    wavelength = np.linspace(1.2, 2.2, 14) * u.um
    still = (
        optics.LinearPolarizer(name="polarizer", fixed={"theta": False})
        | optics.LinearRetarder(retardance=172 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(
            retardance=95 * u.deg, mount="derotator", name="derotator", fixed={"retardance": False}
        )
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    chain = follow(still, "derotator.retardance", models.Polynomial1D(5), "wavelength")
    truth = chain.copy()
    truth["derotator"].retardance, truth["derotator"].retardance_c1 = 40 * u.deg, 35 * u.deg / u.um
    frames = half_wave_plate_cycles(derotator=[40, 70, 100, 130] * u.deg)
    observations = simulate(truth, wavelength, frames, flux=1e6, seed=1)
    cal = calibrate(chain, observations, cross_validate=False)
    assert cal.covariance.std("derotator.retardance") > 10 * u.deg
    assert cal.verdict().reasons == []


def test_orientations_that_hang_on_a_bound():
    entry = {"unit": u.deg, "bounds": (-5, 5), "std_released": np.array(2.4)}
    for by, words in (("hwp.theta", "orientations depend on the bound of hwp.theta"), ("a.q", "")):
        free = {
            "hwp.theta": _entry(5.0, unit=u.deg, at_bound=np.array(True)),
            "polarizer.theta": _entry(1.0, 0.2, conditional_on=np.array(f"b.q, {by}"), **entry),
        }
        assert verdicts._hanging(free) == words


def test_a_target_that_is_not_known():
    def table(s_p, s_chi):
        found = QTable({"s_p": np.full(3, s_p) * u.percent, "s_chi": np.full(3, s_chi) * u.deg})
        found.meta |= {"dolp": 30 * u.percent, "aolp": None}
        return found

    for s_p, s_chi, sky, words in (
        (0.1, 0.1, {}, []),
        (40.0, 0.1, {}, ["the DoLP of 30 % on sky is known to 40 % only"]),
        (0.1, 20.0, {}, ["the AoLP of 30 % on sky is known to 20 deg only"]),
        (0.1, np.inf, {}, ["the AoLP of 30 % on sky is open"]),
        # what is open is said with its name
        (np.inf, np.inf, {"AoLP": ["a.b"], "DoLP": ["a.b"]}, []),
    ):
        assert list(verdicts._too_far([table(s_p, s_chi)], sky)) == words
    assert list(verdicts._too_far([], {})) == []
    assert verdicts._accuracy([], {}) == "On sky      unknown: the frames do not measure Q and U"
    words = verdicts._accuracy([table(0.0001, np.inf), table(0.02, np.inf)], {})
    assert words == "On sky      30, 30 % to <0.001, 0.02 %, AoLP open"
    words = verdicts._accuracy([table(0.0253, 1.26), table(1.234, 60.0)], {})
    assert words == "On sky      30, 30 % to 0.025, 1.2 %, AoLP 1.3, >45 deg"
    words = verdicts._accuracy([table(0.02, 0.001)] * 2, {"DoLP": ["a.b"]})
    assert words == "On sky      30, 30 % open, AoLP <0.01 deg"
    assert verdicts._open_words({}) == ""
    words = verdicts._open_words({"AoLP": ["calibration_polarizer.theta"], "DoLP": ["a.b"]})
    assert words == "AoLP and DoLP on sky are open (calibration_polarizer.theta)"


def test_a_long_first_line_counts_what_it_leaves_out():
    one, two = "a reason " * 3, "another reason " * 5
    for told, words in (
        ([], "Usable"),
        ([one], f"Usable: {one}"),
        ([two], verdicts.shortened(f"Usable: {two}")),
        ([one, one], f"Usable: {one}; {one}"),
    ):
        assert verdicts.shortened(verdicts._first([], told)) == words
    line = verdicts._first([two, one], [])
    assert line.startswith("NOT USABLE AS IT IS: another reason another")
    assert line.endswith(" ... (and 1 more)")
    assert len(line) <= 80


def test_errors_that_rest_on_few_numbers_are_named_so(make):
    """In simulations the errors of three angles that residuals share are less than half of it."""
    chain = make.truth(make.chain())
    for count in (3, 8):
        frames = make.frames(np.linspace(45, 132.5, count) * u.deg)
        data = make.off_at_settings(chain, frames, seed=3)
        cautions = calibrate(chain, data, search=False, cross_validate=False).verdict().cautions
        assert any("lower limits: 3 settings" in one for one in cautions) == (count == 3)
    lam, plate = [1.2, 1.6, 2.2] * u.um, [0, 45, 22.5, 67.5] * u.deg
    chain = make.charis.chain(derotator="linear", wavelength=lam)
    data = make.observe(chain, half_wave_plate_cycles(plate, [50, 80] * u.deg), lam, seed=2)
    cautions = calibrate(chain, data, cross_validate=False).verdict().cautions
    assert any("1 degree of freedom only" in one for one in cautions)


def test_only_what_an_instrument_has_is_advised():
    """FORS2 has neither an internal source nor a derotator."""
    fors2 = instruments.get("fors2")
    frames = QTable({"hwp": np.tile(np.arange(0, 180, 22.5), 2) * u.deg})
    frames["parallactic"] = np.repeat([0, 90], 8) * u.deg
    frames["altitude"] = np.full(16, 60) * u.deg
    meta = {"instrument": "fors2", "source": "unpolarized standard star"}
    chain = fors2.chain(meta["source"])
    star = simulate(chain, fors2.wavelength, frames, flux=1e9, seed=1, meta=meta)
    told = []
    for theta, free in ((True, False), (False, True)):
        chain["hwp"].retardance.fixed = chain["wollaston"].efficiency.fixed = True
        chain["hwp"].theta.fixed, chain["hwp"].retardance.fixed = theta, not free
        cal = calibrate(chain, star, instrument="fors2", cross_validate=False)
        told.append(fits_a_terminal(cal)[4])
    assert not any("internal" in line or "derotator" in line for line in told), told
