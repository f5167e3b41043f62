# Licensed under a 3-clause BSD style license - see LICENSE
"""The astropolcal command, as a person or a pipeline calls it."""

import json
import re
import subprocess
import sys
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

import astropolcal
from astropolcal import Calibration, Observations, instruments
from astropolcal.scripts._simulate import EXAMPLE
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles, simulate

EXAMPLE_FILE = Path(astropolcal.__file__).parent / "data" / "charis_example.ecsv"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A table of three bins and three derotator angles, quick to calibrate."""
    charis = instruments.get("charis")
    wavelength = charis.wavelength[[9, 12, 16]]
    chain = charis.chain("polarized", ["nbs"], wavelength=wavelength)
    frames = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)
    meta = charis.published_meta()
    path = tmp_path_factory.mktemp("tables") / "small.ecsv"
    simulate(chain, wavelength, frames, seed=5, meta=meta).write(path)
    return path


def _fails(capsys, *argv):
    """Run the command on bad input; return its one line of complaint."""
    try:
        status = main([str(a) for a in argv])
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2
    complaint = [line for line in captured.err.splitlines() if "error" in line]
    assert len(complaint) == 1
    assert "Traceback" not in captured.err
    return complaint[0]


# ---- calibrate ----------------------------------------------------------------------


@pytest.mark.slow
def test_without_files_the_packaged_example_is_calibrated_and_it_says_so(capsys, tmp_path):
    assert main(["calibrate", "--json", str(tmp_path / "out.json")]) == 0
    text = capsys.readouterr().out
    assert "packaged example" in text
    assert max(len(line) for line in text.splitlines() if str(tmp_path) not in line) <= 80
    summary = json.loads((tmp_path / "out.json").read_text())
    assert summary["n_free"] == 93
    assert summary["rank"] == 91
    assert summary["parameters"]["hwp.w_sio2"]["value"] == pytest.approx(1.653, abs=1e-3)
    assert len(summary["null_directions"]) == 2


def test_json_holds_the_keys_of_the_contract(small, tmp_path):
    out = tmp_path / "out.json"
    assert main(["calibrate", str(small), "-q", "--json", str(out)]) == 0
    summary = json.loads(out.read_text())
    wanted = {"instrument", "observable", "fitter", "seconds", "n_data", "n_free", "rank",
              "datasets", "parameters", "null_directions"}  # fmt: skip
    assert wanted <= set(summary)
    dataset = summary["datasets"][0]
    for key in ("wavelength_nm", "n", "s_res_percent", "s_mean_percent", "s_cv_percent"):
        assert len(dataset[key]) == 3
    for key in ("value", "unit", "std", "fixed", "at_bound", "identifiable"):
        assert key in summary["parameters"]["derotator.horizontal"]
    assert len(summary["parameters"]["derotator.horizontal"]["value"]) == 3


@pytest.mark.slow
def test_json_on_the_standard_output_is_nothing_but_json(small, capsys):
    assert main(["calibrate", str(small), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["instrument"] == "charis"


def test_quiet_prints_nothing(small, capsys):
    assert main(["calibrate", str(small), "-q"]) == 0
    assert capsys.readouterr().out == ""


def test_fix_free_and_without_edit_the_model(small, tmp_path):
    out = tmp_path / "out.json"
    arguments = ["--fix", " hwp.theta = 0.1 deg", "--fix", "derotator.circular", "--free",
                 "wollaston.theta", "--without", "nbs"]  # fmt: skip
    assert main(["calibrate", str(small), "-q", "--json", str(out), *arguments]) == 0
    parameters = json.loads(out.read_text())["parameters"]
    assert parameters["hwp.theta"]["value"] == pytest.approx(0.1)
    assert parameters["hwp.theta"]["fixed"]
    assert parameters["derotator.circular"]["fixed"]
    assert not parameters["wollaston.theta"]["fixed"]
    assert "nbs.theta" not in parameters


def test_priors_and_gauge(small, tmp_path):
    out = tmp_path / "out.json"
    arguments = ["--prior", "hwp.theta=0+-0.1deg", "--prior", "derotator.theta=0deg+-6arcmin"]
    assert main(["calibrate", str(small), "-q", "--json", str(out), *arguments]) == 0
    summary = json.loads(out.read_text())
    assert summary["gauge"].startswith("prior on hwp.theta, derotator.theta")
    for name in ("hwp.theta", "derotator.theta"):
        assert summary["parameters"][name]["std"] == pytest.approx(0.1, rel=0.05)
    assert main(["calibrate", str(small), "-q", "--json", str(out), "--gauge", "none"]) == 0
    assert "accident" in json.loads(out.read_text())["gauge"]


@pytest.mark.slow
def test_models_and_strategies(small, tmp_path):
    for option, free in [(("--derotator", "linear"), 3 * 2 + 5), (("--strategy", "two-step"), 17)]:
        out = tmp_path / "out.json"
        assert main(["calibrate", str(small), "-q", "--json", str(out), *option]) == 0, option
        assert json.loads(out.read_text())["n_free"] == free, (option, free)


@pytest.mark.slow
def test_output_and_info_tell_the_same(small, tmp_path, capsys):
    path = tmp_path / "cal.asdf"
    assert main(["calibrate", str(small), "-o", str(path), "--json", str(tmp_path / "a.json")]) == 0
    capsys.readouterr()
    assert main(["info", str(path), "--json", str(tmp_path / "b.json")]) == 0
    assert "Calibration of charis from small" in capsys.readouterr().out
    first, second = (json.loads((tmp_path / name).read_text()) for name in ("a.json", "b.json"))
    assert first.items() <= second.items()
    assert Calibration.read(path).chain["hwp"].w_sio2.unit == u.mm


def test_bad_arguments_get_one_line_and_status_two(capsys, tmp_path, monkeypatch):
    for arguments, complaint in [
        (["missing.ecsv"], "missing.ecsv: no such file"),
        (["--instrument", "charix"], "unknown instrument 'charix'.*did you mean 'charis'"),
        (["--observable", "duoble"], "did you mean 'normalized_double_difference'"),
        (["--strategy", "three-step"], "three-step.*joint, two-step"),
        (["--derotator", "circular"], "elliptical, linear"),
        (["--bounds", "none"], "physical, paper"),
        (["--fix", "hwp.theta=9"], r"hwp.theta=9.*-5.0 to 5.0 deg"),
        (["--fix", "hwp.theta=1mm"], "convertible to deg"),
        (["--fix", "hwp.theta=abc"], "not a number"),
        (["--fix", "hwp.tilt"], "no parameter 'tilt'"),
        (["--prior", "hwp.theta=0"], "MEAN"),
        (["--prior", "hwp.theta=0+-1mm"], "convertible to deg"),
        (["--prior", "hwp.theta=9+-1"], "outside the bounds"),
        (["--prior", "hwp.theta=0+-0"], "positive std"),
        (["--free", "hpw"], "did you mean 'hwp'"),
        (["--without", "m3"], "no optic 'm3'"),
        (["-o", "nowhere/cal.asdf"], "no folder"),
        (["--json", "nowhere/out.json"], "no folder"),
        (["--no-such-option"], "unrecognized"),
    ]:
        monkeypatch.chdir(tmp_path)
        assert re.search(complaint, _fails(capsys, "calibrate", *arguments)), (arguments, complaint)
        assert list(tmp_path.iterdir()) == [], (arguments, complaint)


@pytest.mark.filterwarnings("always:--fix")
def test_value_without_a_unit_says_which_it_took(small, capsys):
    for value, warns in (("0", False), ("0.1deg", False), ("0.1", True)):
        assert main(["calibrate", str(small), "-q", "--fix", f"hwp.theta={value}"]) == 0
        said = f"--fix hwp.theta={value}: no unit is given, deg is taken" in capsys.readouterr().err
        assert said == warns, value


def _spoil(table, how):
    if how == "empty":
        return table[:0]
    if how == "unpaired":
        return table[table["hwp"] < 40 * u.deg]
    if how == "masked":
        table["flux_right"] = np.nan * u.adu
    if how == "infrared":
        table["wavelength"] = table["wavelength"] * 3
    if how == "other instrument":
        table.meta["instrument"] = "VLT/SPHERE"
    if how == "star":
        table.meta["source"] = "unpolarized standard star"
    return table


def test_the_page_of_the_health_replaces_no_table(small, capsys):
    kept = Path(small).read_bytes()
    line = _fails(capsys, "health", str(Path(small).parent), "--html", str(small))
    assert "the name must end with .html or .htm" in line
    assert Path(small).read_bytes() == kept


@pytest.mark.filterwarnings("ignore")
def test_bad_tables_get_one_line_and_leave_nothing_behind(small, capsys, tmp_path):
    for how, complaint in [
        ("empty", "empty"),
        ("unpaired", "45"),
        ("masked", "mask"),
        ("infrared", "bad: the refractive index of quartz is known from"),
        ("other instrument", "SPHERE"),
        ("star", "needs its pointing"),
    ]:
        table = _spoil(QTable.read(small), how)
        path = tmp_path / "bad.ecsv"
        table.write(path, format="ascii.ecsv", overwrite=True)
        argv = [path, "-o", tmp_path / "cal.asdf", "--json", tmp_path / "out.json"]
        if how == "other instrument":
            argv += ["--instrument", "charis"]
        assert complaint in _fails(capsys, "calibrate", *argv), (how, complaint)
        assert [p.name for p in tmp_path.iterdir()] == ["bad.ecsv"], (how, complaint)


# ---- simulate -------------------------------------------------------------------------


def test_the_packaged_example_is_what_simulate_makes(tmp_path):
    assert main(["simulate", "-o", str(tmp_path / "again.ecsv")]) == 0
    again, packaged = Observations.read(tmp_path / "again.ecsv"), Observations.read(EXAMPLE_FILE)
    assert (packaged.n_frames, packaged.n_bins) == (64, 22)
    np.testing.assert_allclose(again.flux_right, packaged.flux_right, rtol=1e-9)
    np.testing.assert_allclose(again.flux_left, packaged.flux_left, rtol=1e-9)
    assert packaged.meta == again.meta


def test_simulate_takes_angles_and_parameters(tmp_path, capsys):
    path = tmp_path / "table.ecsv"
    argv = ["-o", path, "--hwp", "0,45", "--derotator", "60", "--without", "nbs", "--no-noise",
            "--fix", "wollaston.efficiency=0.5", "--json", "-"]  # fmt: skip
    assert main(["simulate", *map(str, argv)]) == 0
    assert json.loads(capsys.readouterr().out)["n_frames"] == 2
    table = Observations.read(path)
    assert table.meta["nasmyth_beam_switcher"] == "not installed"
    contrast = (table.flux_right - table.flux_left) / (table.flux_right + table.flux_left)
    assert np.abs(contrast).max() <= 0.5


def test_simulate_from_a_calibration(small, tmp_path):
    assert main(["calibrate", str(small), "-q", "-o", str(tmp_path / "cal.asdf")]) == 0
    argv = ["simulate", "-o", tmp_path / "new.ecsv", "--calibration", tmp_path / "cal.asdf"]
    assert main([str(a) for a in argv]) == 0
    assert Observations.read(tmp_path / "new.ecsv").n_bins == 3


def test_example_settings_are_the_defaults(tmp_path, capsys):
    command = ["simulate", "-o", str(tmp_path / "run.ecsv"), "--derotator", "45", "--hwp", "0,45"]
    assert main([*command, "--json", "-"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert {key: summary[key] for key in EXAMPLE} == EXAMPLE


# ---- info and the process -----------------------------------------------------------------


def test_info_of_a_table_and_of_the_installation(small, capsys):
    assert main(["info", str(small)]) == 0
    assert "SCExAO/CHARIS" in capsys.readouterr().out
    assert main(["info"]) == 0
    assert "EllipticalRetarder" in capsys.readouterr().out


def test_a_reader_that_goes_away_is_no_error(small):
    command = f"{sys.executable} -m astropolcal.scripts.main info {small} | true"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
