# Licensed under a 3-clause BSD style license - see LICENSE
"""How ``astropolcal calibrate`` judges the accuracy: standards, groups, targets, gauge."""

import json
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.time import Time
from star_data import WAVELENGTH as STAR_WAVELENGTH
from star_data import observe_star, star_chain

import astropolcal
from astropolcal import Calibration, Observations, calibrate, instruments, standards
from astropolcal.calibration.noise.scatter import GROUPS
from astropolcal.calibration.validation.cross_validation import standard_accuracy
from astropolcal.calibration.validation.targets import target_accuracies
from astropolcal.scripts._calibrate import _target
from astropolcal.scripts.main import build_parser, main
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[9, 12, 16]]
HELD = ["--fix", "hwp.theta=0", "--fix", "derotator.theta"]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Tables of two polarized nights and an unpolarized one, of the same optics."""
    folder = tmp_path_factory.mktemp("tables")
    meta = CHARIS.published_meta() | {"yjh50_dichroic": "out"}
    frames = half_wave_plate_cycles(derotator=[50, 50, 62.5, 80, 100] * u.deg)
    paths = {}
    for i, (name, source) in enumerate(
        {"first": "polarized", "second": "polarized", "dark": "unpolarized"}.items()
    ):
        chain = CHARIS.chain(source, ["nbs"], wavelength=WAVELENGTH)
        if source == "unpolarized":
            chain["fold_mirror"].diattenuation = np.full(3, 0.01)
        paths[name] = folder / f"{name}.ecsv"
        data = simulate(chain, WAVELENGTH, frames, seed=i, meta=meta | {"source": source})
        data.write(paths[name])
    return paths


def run(tmp_path, *arguments):
    out = tmp_path / "out.json"
    assert main(["calibrate", "-q", "--json", str(out), *map(str, arguments)]) == 0
    return json.loads(out.read_text())


def complaint(capsys, *arguments):
    try:
        status = main(["calibrate", *map(str, arguments)])
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2
    assert "Traceback" not in captured.err
    (line,) = [line for line in captured.err.splitlines() if "error" in line]
    return line


# ---- standards ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_standard_is_predicted_and_not_fitted(tables, tmp_path):
    alone = run(tmp_path, tables["first"])
    with_standard = run(tmp_path, tables["first"], "--standard", tables["second"])
    assert alone["standards"] == []
    for name, known in alone["parameters"].items():
        assert with_standard["parameters"][name]["value"] == known["value"]
    assert with_standard["n_data"] == alone["n_data"]
    (entry,) = with_standard["standards"]
    assert (entry["name"], entry["source"]) == ("second", "polarized")
    assert entry["n"] == [20, 20, 20]
    np.testing.assert_allclose(entry["wavelength_nm"], WAVELENGTH.to_value(u.nm), rtol=1e-6)
    for key in ("s_standard_percent", "s_res_percent", "bias_percent", "s_cv_percent", "chi"):
        assert len(entry[key]) == 3
    # photon noise and the same optics
    assert 0.5 < np.median(entry["chi"]) < 2
    np.testing.assert_allclose(
        with_standard["datasets"][0]["s_standard_percent"], entry["s_standard_percent"]
    )


def test_the_command_predicts_what_the_function_predicts(tables, tmp_path):
    (entry,) = run(tmp_path, tables["first"], "--standard", tables["second"])["standards"]
    first, second = (Observations.read(tables[name]) for name in ("first", "second"))
    cal = calibrate(CHARIS.chains_for([first]), first)
    table = standard_accuracy(cal, *CHARIS.chains_for([second]), second)
    found = table["s_standard"].to_value(u.percent)
    np.testing.assert_allclose(entry["s_standard_percent"], found, rtol=1e-4)


@pytest.mark.slow
def test_several_standards_and_optics_of_their_own(tables, tmp_path, capsys):
    files = [tables["first"], "--standard", tables["second"], "--standard", tables["dark"]]
    assert "dark: nothing determines fold_mirror.diattenuation" in complaint(capsys, *files)
    summary = run(tmp_path, *files, "--fix", "fold_mirror.diattenuation=0.01")
    assert [entry["name"] for entry in summary["standards"]] == ["second", "dark"]
    assert summary["standards"][1]["not_calibrated"] == ["fold_mirror"]
    # it is no part of the fit, and not of its gauge
    assert "fold_mirror" not in summary["gauge"]
    assert not any(name.startswith("fold_mirror") for name in summary["parameters"])
    wrong = run(tmp_path, *files, "--fix", "fold_mirror.diattenuation=0.02")["standards"][1]
    right = summary["standards"][1]
    assert np.median(wrong["s_standard_percent"]) > 5 * np.median(right["s_standard_percent"])


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_summary_file_and_info_know_the_standard(tables, tmp_path, capsys):
    cal = tmp_path / "cal.asdf"
    arguments = [tables["first"], "--standard", tables["second"], "-o", cal, "--plots", tmp_path]
    assert main(["calibrate", "--full", *map(str, arguments)]) == 0
    text = capsys.readouterr().out
    assert "Prediction of second (not fitted), in percent" in text
    assert max(len(line) for line in text.splitlines() if str(tmp_path) not in line) <= 80
    assert (tmp_path / "accuracy.png").is_file()
    assert main(["info", "--full", str(cal)]) == 0
    assert "Prediction of second (not fitted), in percent" in capsys.readouterr().out
    assert main(["info", str(cal)]) == 0
    assert "Predicted   second: errors" in capsys.readouterr().out
    assert Calibration.read(cal).fit["standards"][0]["name"] == "second"


def test_what_is_no_standard_is_refused(tables, capsys, tmp_path):
    line = complaint(capsys, tables["first"], "--standard", tables["first"])
    assert "is not an independent standard: it is fitted as" in line
    line = complaint(capsys, tables["first"], *["--standard", tables["second"]] * 2)
    assert "holds the same frames as" in line
    assert "no such file" in complaint(capsys, tables["first"], "--standard", "nowhere.ecsv")
    # a standard at other wavelengths is refused
    lam = CHARIS.wavelength[[9, 13]]
    chain = CHARIS.chain("polarized", ["nbs"], wavelength=lam)
    frames = half_wave_plate_cycles(derotator=[50, 80] * u.deg)
    path = tmp_path / "other.ecsv"
    simulate(chain, lam, frames, seed=1, meta=CHARIS.published_meta()).write(path)
    line = complaint(capsys, tables["first"], "--standard", path)
    assert "other: 1 of 2 wavelengths, such as 1804.702 nm, are none of the 3 of" in line


# ---- groups ----------------------------------------------------------------------------


@pytest.mark.slow
def test_cross_validation_leaves_out_what_is_asked_for(tables, tmp_path, capsys):
    assert build_parser().parse_args(["calibrate"]).groups is None
    usual = run(tmp_path, tables["first"])
    found = {by: run(tmp_path, tables["first"], "--groups", by) for by in ("derotator", "cycle")}
    assert usual["left_out"] == found["derotator"]["left_out"] == "derotator angles"
    assert found["cycle"]["left_out"] == "half-wave-plate cycles"
    s_cv = {by: summary["datasets"][0]["s_cv_percent"] for by, summary in found.items()}
    assert s_cv["derotator"] == usual["datasets"][0]["s_cv_percent"]
    # the two cycles at 50 deg predict each other
    assert not np.allclose(s_cv["cycle"], s_cv["derotator"], rtol=1e-3)
    assert main(["calibrate", "--full", str(tables["first"]), "--groups", "cycle"]) == 0
    assert "s_cv: rms error on half-wave-plate cycles left out" in capsys.readouterr().out


@pytest.mark.slow
def test_whole_datasets_may_be_left_out(tables, tmp_path, capsys):
    both = run(tmp_path, tables["first"], tables["second"], "--groups", "dataset")
    assert both["left_out"] == "datasets"
    assert all(np.isfinite(d["s_cv_percent"]).all() for d in both["datasets"])
    line = complaint(capsys, tables["first"], "--groups", "dataset")
    assert "cross-validation by dataset: all data are in one group" in line
    # without the dark nothing tells the mirror, without the lamp not the polarizer
    line = complaint(capsys, tables["first"], tables["dark"], "--groups", "dataset")
    assert "the others do not determine" in line


def test_groups_with_a_single_member_and_unknown_ones(tables, tmp_path, capsys):
    data = Observations.read(tables["first"])
    pairs = data.pairs()
    keep = np.concatenate([pairs[:13].ravel(), pairs[16:].ravel()])
    path = tmp_path / "few.ecsv"
    data.select(keep).write(path)
    for by, what in (("derotator", "derotator 80 deg"), ("cycle", "cycle number 3")):
        line = complaint(capsys, path, "--groups", by)
        assert f"cross-validation by {by}: group {what} of few has a single member" in line
    line = complaint(capsys, "--groups", "moon")
    assert all(repr(name) in line for name in GROUPS)


# ---- targets ---------------------------------------------------------------------------


@pytest.mark.slow
def test_targets_by_default_and_by_choice(tables, tmp_path, capsys):
    usual = run(tmp_path, tables["first"], tables["dark"])["targets"]
    assert [(t["dolp_percent"], t["aolp_deg"]) for t in usual] == [(d, None) for d in (30, 1, 0.1)]
    files = [tables["first"], tables["dark"], "-o", tmp_path / "cal.asdf"]
    chosen = run(tmp_path, *files, "--target", "5%,20", "--target", "2")["targets"]
    assert [(t["dolp_percent"], t["aolp_deg"]) for t in chosen] == [(5.0, 20.0), (2.0, None)]
    cal = Calibration.read(tmp_path / "cal.asdf")
    (table,) = target_accuracies(cal, [(5 * u.percent, 20 * u.deg)])
    for key in ("s_Q", "s_U", "s_p"):
        np.testing.assert_allclose(chosen[0][f"{key}_percent"], table[key].value)
    np.testing.assert_allclose(chosen[0]["s_chi_deg"], table["s_chi"].value)
    assert main(["calibrate", "--full", str(tables["first"]), "--target", "5%,20"]) == 0
    text = capsys.readouterr().out
    assert "On sky      5 % " in text
    row = next(line for line in text.splitlines() if line.split()[:3] == ["5", "%", "20"])
    assert len(row.split()) == 9


def test_spelling_of_targets():
    for text, dolp, aolp in [
        ("1", 1, None),
        ("30%", 30, None),
        ("0.5,-20", 0.5, -20),
        ("100 %,0.5rad", 100, 28.64788976),
        ("0,0deg", 0, 0),
    ]:
        found = _target(text)
        assert found[0].to_value(u.percent) == pytest.approx(dolp), (text, dolp, aolp)
        assert (
            found[1] is None if aolp is None else found[1].to_value(u.deg) == pytest.approx(aolp)
        ), text


def test_impossible_targets_get_one_line(tables, capsys):
    for text in [
        "",
        "x",
        "101",
        "-1",
        "nan",
        "1,",
        "1,x",
        "1,2,3",
        "1um",
        "0.1 2",
        "1,5%",
        "5,200",
        "5,-181",
    ]:
        line = complaint(capsys, tables["first"], f"--target={text}")
        assert f"--target {text}" in line, text
        assert "such as 1 or 30,45" in line, text


# ---- gauge -----------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_fixed_is_named_in_the_gauge(tables, tmp_path):
    summary = run(tmp_path, tables["first"], *HELD)
    assert summary["gauge"] == (
        "held: hwp.theta, derotator.theta; the data determine every free parameter"
    )
    assert summary["parameters"]["hwp.theta"]["value"] == 0
    usual = run(tmp_path, tables["first"])["gauge"]
    assert usual.startswith("minimal")
    # an optic's name stands for all of its parameters
    whole = run(tmp_path, tables["first"], "--fix", "hwp")["gauge"]
    assert whole.startswith("held: hwp.theta, hwp.w_sio2, hwp.w_mgf2; ")


def test_a_part_of_an_optic_is_freed_or_held(tables, tmp_path):
    both = ["--fix", "hwp", "--prior", "hwp.theta=0+-0.1deg", "--fix", "derotator.theta"]
    summary = run(tmp_path, tables["first"], *both)
    assert "prior on hwp.theta" in summary["gauge"]
    assert "hwp.theta" not in summary["gauge"].partition(";")[0]
    assert not summary["parameters"]["hwp.theta"]["fixed"]
    assert summary["parameters"]["hwp.w_sio2"]["fixed"]
    # all of an optic is freed but what is held
    known = run(tmp_path, tables["first"], "--free", "hwp", "--fix", "hwp.theta=0")["parameters"]
    assert known["hwp.theta"]["fixed"]
    assert not known["hwp.w_sio2"]["fixed"]


def test_held_and_free_at_once_is_refused(tables, capsys):
    for held, option, other in [
        ("hwp.theta", "--free", "hwp.theta"),
        ("hwp.theta=0", "--free", "hwp.theta"),
        ("hwp", "--free", "hwp.theta"),
        ("hwp", "--free", "hwp"),
        ("hwp.theta=0", "--prior", "hwp.theta=0+-0.1deg"),
    ]:
        line = complaint(capsys, tables["first"], "--fix", held, option, other)
        name = held.partition("=")[0]
        assert f"{option} {other} cannot be combined with --fix {name}" in line, held


# ---- what a summary says at the top, and what is refused ---------------------------------


def _edited(path, to, edit):
    table = Observations.read(path).to_table()
    edit(table)
    table.write(to, format="ascii.ecsv")
    return to


def _shown(capsys, *arguments):
    """Return what the command prints, which fits a terminal."""
    assert main(["calibrate", *map(str, arguments)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 24
    # names of files are not broken
    assert all(len(line) <= 80 or line.startswith("Written") for line in lines)
    return lines


@pytest.mark.slow
def test_a_lamp_with_the_wrong_source_is_not_usable(tables, tmp_path, capsys):
    wrong = _edited(
        tables["first"], tmp_path / "lamp.ecsv", lambda t: t.meta.update(source="unpolarized")
    )
    first = _shown(capsys, wrong)[0]
    assert first.startswith("NOT USABLE AS IT IS: fold_mirror polarizes by more than 30 %")
    assert _shown(capsys, tables["first"], tables["dark"], *HELD)[0] == "Usable"


@pytest.mark.slow
def test_exchanged_beams_are_not_usable(tmp_path, capsys):
    def exchange(table):
        left, right = table["flux_left"].copy(), table["flux_right"].copy()
        table["flux_left"], table["flux_right"] = right, left

    right = Path(astropolcal.__file__).parent / "data" / "charis_example.ecsv"
    lines = _shown(capsys, _edited(right, tmp_path / "beams.ecsv", exchange), *HELD)
    assert lines[0].startswith("NOT USABLE AS IT IS: the model misses the data by ")
    assert any("astropolcal diagnose" in line for line in lines[:5])


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_what_is_printed_fits_a_terminal_and_tells_what_is_hidden(tables, tmp_path, capsys):
    cal, figures, out = tmp_path / "cal.asdf", tmp_path / "figures", tmp_path / "cal.json"
    files = [tables["first"]]
    lines = _shown(capsys, *files, "-o", cal, "--plots", figures, "--json", out)
    assert lines[0].startswith("NOT USABLE AS IT IS: AoLP and DoLP on sky are open")
    assert lines[-1].startswith("--full (full=True) adds tables per wavelength")
    n = len(list(figures.iterdir()))
    assert [line.partition("  ")[2].strip() for line in lines[-4:-1]] == [
        str(cal), str(out), f"{n} figures in {figures}",
    ]  # fmt: skip
    verdict = json.loads(out.read_text())["verdict"]
    assert (verdict["usable"], verdict["words"]) == (False, lines[:5])
    # a file says the same, and in full it stands at both ends
    assert main(["info", str(cal)]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[:5] == lines[:5]
    assert len(told) < 24
    assert main(["calibrate", "--full", *map(str, files)]) == 0
    full = capsys.readouterr().out.splitlines()
    assert full[:5] == full[-6:-1] == lines[:5]
    assert full[-1].startswith("Not kept: -o cal.asdf")
    assert len(full) > 50


@pytest.mark.slow
def test_quiet_warns_of_what_is_not_usable(tables, capsys):
    for options in (["-q"], ["--json", "-"]):
        assert main(["calibrate", str(tables["first"]), *options]) == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line == (
            "astropolcal: warning: NOT USABLE AS IT IS: AoLP and DoLP on sky are open "
            "(calibration_polarizer.theta)"
        )
    assert main(["calibrate", str(tables["first"]), "-q", *HELD]) == 0
    assert capsys.readouterr().err == ""


# ---- lamps and stars ------------------------------------------------------------------


@pytest.fixture(scope="module")
def star_table(tables):
    """A star through the same optics, whose first cycle is incomplete."""
    chain = CHARIS.chain("unpolarized standard star", ["nbs"], wavelength=WAVELENGTH)
    chain["m3"].diattenuation = [0.017, 0.014, 0.012]
    frames = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.full(8, 97) * u.deg)[1:]
    frames["parallactic"] = np.linspace(20, 35, 31) * u.deg
    frames["altitude"] = np.linspace(67, 64, 31) * u.deg
    commanded = frames["hwp"].copy()
    frames["hwp"] = commanded + 0.5 * frames["parallactic"] + frames["altitude"]
    meta = CHARIS.published_meta() | {"yjh50_dichroic": "out", "object": "HD 293396"}
    meta |= {"source": "unpolarized standard star"}
    table = simulate(chain, WAVELENGTH, frames, seed=9, meta=meta).to_table()
    table["hwp"] = np.repeat(commanded, 3)
    path = tables["first"].parent / "star.ecsv"
    Observations.from_table(table).write(path)
    return path


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*frames (masked|left out)")
@pytest.mark.slow
def test_lamps_and_star_together(tables, star_table, tmp_path):
    for options in [[], ["--strategy", "sequential"], ["--loss", "huber"]]:
        content = run(tmp_path, tables["first"], tables["dark"], star_table, *HELD, *options)
        assert [one["source"] for one in content["datasets"]] == [
            "polarized", "unpolarized", "unpolarized standard star",
        ], options  # fmt: skip
        found = content["parameters"]["m3.diattenuation"]["value"]
        np.testing.assert_allclose(found, [0.017, 0.014, 0.012], atol=5e-4)
        # three frames of the first cycle cannot be used
        assert content["datasets"][2]["n"] == [14, 14, 14], options


@pytest.mark.filterwarnings("ignore:.*frames left out")
def test_nothing_is_masked_where_all_is_to_be_kept(tables, star_table, tmp_path):
    content = run(tmp_path, star_table, tables["first"], *HELD, "--keep-all")
    assert content["datasets"][0]["n"] == [15, 15, 15]


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*frames (masked|left out)")
def test_model_of_the_tertiary_mirror(tables, star_table, tmp_path):
    content = run(tmp_path, star_table, tables["first"], *HELD, "--m3", "metal")
    free = {k for k, v in content["parameters"].items() if k.startswith("m3.") and not v["fixed"]}
    assert free == {"m3.theta", "m3.film_thickness", "m3.n_scale", "m3.k_scale"}


def test_models_that_are_unknown_or_do_not_fit_get_one_line(tables, capsys):
    for name, options, words in [
        ("first", ["--m3", "glass"], "m3 = 'glass'; allowed are free, power law, metal"),
        ("first", ["--loss", "l3"], "loss = 'l3'; allowed are linear, huber, cauchy, bisquare"),
        ("first", ["--nuisance", "fog"], "nuisance = 'fog'; allowed are background, beam_gain, l"),
        ("dark", ["--strategy", "two-step"], "'two-step' is for a polarized source, but the sour"),
    ]:
        assert words in complaint(capsys, tables[name], *options), (options, words)


# ---- refit of what changed ------------------------------------------------------------------


@pytest.mark.slow
def test_start_holds_all_but_what_is_free(tables, tmp_path):
    old, new = tmp_path / "old.asdf", tmp_path / "new.asdf"
    assert main(["calibrate", str(tables["first"]), "-q", "-o", str(old), *HELD]) == 0
    refit = ["--start", str(old), "--free", "Wollaston"]
    assert main(["calibrate", str(tables["second"]), "-q", "-o", str(new), *refit]) == 0
    before, after = Calibration.read(old), Calibration.read(new)
    assert {name.partition("[")[0] for name in after.covariance.names} == {"wollaston.efficiency"}
    assert after.chain["hwp"].w_sio2.value == before.chain["hwp"].w_sio2.value
    assert after.settings["restarted"]["free"] == ["Wollaston"]


def test_start_on_bad_input(tables, tmp_path, capsys):
    for more, complaint in [
        ([], "say with --free NAME what may change"),
        (["--free", "hwp", "--fix", "hwp.theta"], "--fix cannot be combined with --start"),
        (["--free", "hwp", "--bounds", "paper"], "--bounds paper cannot be combined with --start"),
        (["--free", "hwp", "--strategy", "two-step"], "--strategy two-step cannot be combined"),
        (["--free", "m9"], "free: no 'm9' in the chains; optics are calibration_polarizer"),
        (["--free", "hwp"], r"none.asdf: no such file"),
    ]:
        path = tmp_path / ("none.asdf" if "no such file" in complaint else "old.asdf")
        if "m9" in more:
            assert main(["calibrate", str(tables["first"]), "-q", "-o", str(path)]) == 0, more
        assert main(["calibrate", str(tables["second"]), "--start", str(path), *more]) == 2, more
        assert complaint in capsys.readouterr().err, (more, complaint)


# ---- nuisance, derotator, stars -----------------------------------------------------------


def test_nuisance_of_one_dataset(tables, tmp_path):
    chosen = ["--nuisance", "lamp", "--nuisance", f"background:{tables['first'].stem}"]
    result = run(tmp_path, tables["first"], tables["dark"], *chosen, *HELD)
    names = {name.split(".")[0] for name in result["parameters"]}
    assert {"lamp_dark", "background_first"} <= names
    assert "background_dark" not in names


def test_derotator_of_three_mirrors(tables, tmp_path):
    result = run(tmp_path, tables["first"], "--derotator", "kmirror", "--fix", "hwp.theta=0")
    assert result["parameters"]["derotator.film_thickness"]["unit"] == "nm"


@pytest.fixture
def star(tmp_path):
    """Write a table of the polarized standard HD 30675, changed as asked."""

    def write(change=lambda table: None, **meta):
        chain = star_chain("star")
        known = standards.get("HD 30675").stokes(STAR_WAVELENGTH)
        chain["star"].q, chain["star"].u = known.q, known.u
        seen = observe_star(chain, 8, source="polarized standard star", target="HD 30675", seed=1)
        table = seen.to_table()
        table.meta |= meta
        change(table)
        path = tmp_path / "star.ecsv"
        table.write(path, overwrite=True)
        return path

    return write


@pytest.fixture(scope="module")
def lamp(tmp_path_factory):
    chain = CHARIS.chain("polarized", ["dichroic", "nbs"], wavelength=STAR_WAVELENGTH)
    frames = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)
    meta = CHARIS.published_meta()
    path = tmp_path_factory.mktemp("lamp") / "lamp.ecsv"
    simulate(chain, STAR_WAVELENGTH, frames, seed=3, meta=meta).write(path)
    return path


@pytest.fixture
def unpolarized(tmp_path):
    path = tmp_path / "unpolarized.ecsv"
    observe_star(star_chain(), 8, seed=2).write(path)
    return path


def test_polarized_standard_is_held_against_the_catalogue(lamp, unpolarized, star, tmp_path):
    result = run(tmp_path, lamp, unpolarized, "--standard", star(), *HELD)
    (entry,) = result["stars"]
    assert entry["star"] == "HD 30675"
    assert np.abs(entry["dolp_error_percent"]).max() < 0.1
    assert [mirror["name"] for mirror in result["mirrors"]] == ["m3"]


def test_bad_tables_of_stars_get_one_line(star, capsys):
    def raise_it(table):
        table["altitude"] = 95 * u.deg

    assert "altitude = 95.0, allowed are -90 to 90 deg" in complaint(capsys, star(raise_it))
    line = complaint(capsys, star(object="HD 999999"))
    assert "the catalogue has no standard star 'HD 999999'" in line


@pytest.mark.filterwarnings("always::astropolcal.exceptions.AstropolcalWarning")
def test_saturated_frames_are_masked_with_a_reason(lamp, unpolarized, tmp_path, capsys):
    table = Observations.read(unpolarized).to_table()
    table["saturated"] = np.isin(table["frame"], [4])
    table.write(unpolarized, overwrite=True)
    result = run(tmp_path, lamp, unpolarized, *HELD)
    assert "1 of 32 frames masked, saturated: frame 4" in capsys.readouterr().err
    reasons = result["datasets"][1]["masked"]
    assert reasons == {"saturated": 3, "incomplete half-wave-plate cycle": 9}


# --- several nights, and time ----------------------------------------------------------------


@pytest.fixture(scope="module")
def nights(tmp_path_factory):
    """Tables of two nights between which the plate has turned by 0.5 deg."""
    folder, paths = tmp_path_factory.mktemp("nights"), []
    meta = CHARIS.published_meta() | {"yjh50_dichroic": "out", "source": "polarized"}
    for day in (0, 10):
        chain = CHARIS.chain("polarized", ["nbs"], wavelength=WAVELENGTH)
        chain["hwp"].theta = 0.05 * day * u.deg
        frames = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)
        frames["time"] = Time("2026-03-01") + np.full(len(frames), day) * u.day
        paths.append(folder / f"night{day}.ecsv")
        table = simulate(chain, WAVELENGTH, frames, seed=day, meta=meta, name=f"night {day}")
        table.write(paths[-1])
    return paths


@pytest.mark.slow
def test_parameters_of_each_night(nights, tmp_path):
    held = ["-q", "--fix", "derotator.theta=0", "--fix", "calibration_polarizer.theta"]
    out = tmp_path / "cal.asdf"
    for options, name in (("hwp.theta", "hwp_night10"), ("hwp.theta=march,april", "hwp_april")):
        argv = ["calibrate", *map(str, nights), *held, "--own", options, "-o", str(out)]
        assert main(argv) == 0
        found = {leaf.name: leaf for chain in Calibration.read(out).chains for leaf in chain}
        # only the turn between the nights is known
        seen = found[name].theta.value - found["hwp"].theta.value
        assert seen == pytest.approx(0.5, abs=0.02)


def test_groups_that_do_not_fit_get_one_line(nights, capsys):
    for options, words in (
        (["--own", "hwp.thetta"], "did you mean 'hwp.theta'"),
        (["--own", "hwp.theta=march"], "has 1 group for 2 datasets"),
        (["--own", "hwp.theta=march,"], "--own hwp.theta=...: each group needs a name"),
        (["--own", "hwp.theta", "--own", "wollaston.efficiency=a,b"], "or of none"),
        (["--own", "hwp.theta", "--start", "old.asdf"], "--own cannot be combined with --start"),
    ):
        assert words in complaint(capsys, *nights, *options)
