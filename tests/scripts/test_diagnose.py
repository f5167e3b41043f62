# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal diagnose``."""

import json
import subprocess
import sys

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, Observations, calibrate, instruments
from astropolcal.chain import leaves
from astropolcal.gap import EFFECTS, get_effect
from astropolcal.gap.effects import Context
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[4, 9, 14, 19]]
SIZE = 0.012
FEW = ["--effects", "beam_gain,hwp_diattenuation"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Tables of a polarized and an unpolarized run with unequal beam gains."""
    folder = tmp_path_factory.mktemp("tables")
    frames = half_wave_plate_cycles(derotator=[45, 62.5, 80, 100] * u.deg)
    meta = CHARIS.published_meta() | {
        "yjh50_dichroic": "out",
        "nasmyth_beam_switcher": "not installed",
    }
    for i, source in enumerate(("polarized", "unpolarized")):
        chain = CHARIS.chain(source, wavelength=WAVELENGTH, derotator="linear")
        if source == "unpolarized":
            chain["fold_mirror"].diattenuation = np.full(len(WAVELENGTH), 0.01)
        context = Context(WAVELENGTH.to_value(u.um), 1e6)
        (edited,) = get_effect("beam_gain").edit([chain], context).chains
        edited["gap_beam_gain"].imbalance = np.full(len(WAVELENGTH), SIZE)
        observations = simulate(edited, WAVELENGTH, frames, seed=i, meta=meta | {"source": source})
        observations.write(folder / f"{source}.ecsv")
    return folder


@pytest.fixture(scope="module")
def cal(folder):
    """A calibration of the polarized run, with a linear derotator."""
    table = Observations.read(folder / "polarized.ecsv")
    chains = CHARIS.chains_for([table], derotator="linear")
    calibrate(chains, [table], instrument="charis", cross_validate=False).write(
        folder / "cal.asdf", overwrite=True
    )
    return folder / "cal.asdf"


def run(tmp_path, *arguments):
    out = tmp_path / "out.json"
    assert main(["diagnose", "-q", "--json", str(out), *map(str, arguments)]) == 0
    return json.loads(out.read_text())


def complaint(capsys, *arguments):
    try:
        status = main(["diagnose", *map(str, arguments)])
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2
    (line,) = [line for line in captured.err.splitlines() if "error" in line]
    return line


_MODULES = """
import sys
from astropolcal import load
from astropolcal.scripts.main import main
main(["diagnose", *sys.argv[1:], "--save", "improved.asdf"])
load("improved.asdf")
print({"scipy.stats", "scipy.signal", "matplotlib"} & set(sys.modules))
"""


@pytest.mark.slow
def test_no_module_is_imported_that_takes_long(folder, tmp_path):
    """Nor to read what was found, with the priors of what is mounted."""
    options = ["-q", "--derotator", "linear", "--effects", "beam_gain"]
    tables = [folder / "polarized.ecsv", folder / "unpolarized.ecsv"]
    command = [sys.executable, "-c", _MODULES, *map(str, tables), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout == "set()\n", done
    assert b"distribution: norm" in (tmp_path / "improved.asdf").read_bytes()


@pytest.mark.long
def test_two_tables_with_report_and_calibration(folder, tmp_path, capsys, monkeypatch):
    # where no exposure is better, what was saved is next
    monkeypatch.setattr("astropolcal.gap.report.plan", lambda diagnosis: [])
    tables = [folder / "polarized.ecsv", folder / "unpolarized.ecsv"]
    report, saved = tmp_path / "gap.html", tmp_path / "improved.asdf"
    outputs = ["--report", report, "--save", saved, "--json", tmp_path / "out.json"]
    arguments = [*tables, "--derotator", "linear", *FEW, *outputs]
    assert main(["diagnose", *map(str, arguments)]) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("The model lacks one effect: unequal gains of the two beams")
    assert str(report) in printed.out
    told = " ".join(printed.out.partition("Next")[2].split())
    assert told.startswith(f"correct measurements with {saved}")
    # how far it is, is for terminals
    assert "looking for causes" not in printed.err
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["verdict"] == "named"
    (cause,) = content["causes"]
    assert (cause["effect"], cause["rank"]) == ("beam_gain", 1)
    assert cause["cell"] == {"place": "detector", "kind": "gain", "dependence": "constant"}
    assert cause["probability"] > 0.9
    assert content["frames"] == []
    assert content["nominal"].count(" | ") == 6
    assert [d["name"] for d in content["accuracy_after"]["datasets"]] == [
        "polarized",
        "unpolarized",
    ]
    assert content["accuracy_after"]["targets"][0]["words"]
    assert "unequal gains of the two beams" in report.read_text(encoding="utf-8")
    check_improved(saved, content)


def check_improved(saved, content):
    improved = Calibration.read(saved)
    assert improved.converged
    assert improved.instrument == "charis"
    for chain in improved.chains:
        gain = chain["gap_beam_gain"].imbalance
        # what is known of it is what the diagnosis says
        assert gain.prior is not None
        np.testing.assert_allclose(gain.value, SIZE, rtol=0.05)
        assert list(leaves(chain))[-1].name in ("gap_beam_gain", "wollaston")
    (entry,) = content["causes"][0]["size"].values()
    assert np.all(np.abs(np.subtract(gain.value, entry["value"])) < entry["std"])


@pytest.mark.slow
def test_a_model_that_misreads_angles_is_not_saved(tmp_path, capsys):
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH, derotator="linear")
    frames = half_wave_plate_cycles(derotator=[45, 62.5, 80, 100] * u.deg)
    meta = CHARIS.published_meta() | {"source": "polarized", "yjh50_dichroic": "out"}
    meta["nasmyth_beam_switcher"] = "not installed"
    table = simulate(chain, WAVELENGTH, frames, seed=1, meta=meta).to_table()
    table["hwp"] *= 2
    Observations.from_table(table).write(tmp_path / "doubled.ecsv")
    outputs = ["--save", tmp_path / "cal.asdf", "--json", tmp_path / "out.json"]
    arguments = [tmp_path / "doubled.ecsv", "--derotator", "linear", "--effects", "hwp_doubled"]
    assert main(["diagnose", *map(str, [*arguments, *outputs])]) == 2
    printed = capsys.readouterr()
    assert "Next        correct the table" in printed.out
    assert "--save" not in printed.out
    assert "cal.asdf: not written" in printed.err
    assert not (tmp_path / "cal.asdf").exists()
    assert json.loads((tmp_path / "out.json").read_text())["misread"]


@pytest.mark.long
def test_model_of_a_calibration(folder, cal, tmp_path):
    content = run(tmp_path, cal, folder / "polarized.ecsv", *FEW)
    assert content["causes"][0]["effect"] == "beam_gain"
    # a linear derotator, as in the calibration
    assert "derotator.retardance" in content["nominal"]
    # at some of its wavelengths
    few = Observations.read(folder / "polarized.ecsv").select_bins(np.arange(len(WAVELENGTH)) < 3)
    few.write(tmp_path / "few.ecsv")
    found = run(tmp_path, cal, tmp_path / "few.ecsv", *FEW)
    assert found["causes"][0]["effect"] == "beam_gain"
    edited = run(tmp_path, cal, folder / "polarized.ecsv", *FEW, "--fix", "hwp.theta=0")
    assert edited["n_free"] == content["n_free"] - 1


@pytest.mark.slow
def test_of_another_night_it_says_which_optics_moved(tmp_path, capsys):
    """The fit takes the change up, so that it is no gap."""
    frames = half_wave_plate_cycles(derotator=[45, 62.5, 80, 100] * u.deg)
    meta = CHARIS.published_meta() | {
        "yjh50_dichroic": "out", "nasmyth_beam_switcher": "not installed", "source": "polarized",
    }  # fmt: skip
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH, derotator="linear")

    def night(seed):
        return simulate(chain, WAVELENGTH, frames, flux=1e6, seed=seed, meta=meta)

    known, table = tmp_path / "cal.asdf", tmp_path / "later.ecsv"
    nominal = CHARIS.chain("polarized", wavelength=WAVELENGTH, derotator="linear")
    calibrate(nominal, night(1), instrument="charis", cross_validate=False).write(known)
    # one layer of the plate alone: its retardance changes by a degree
    cases = {
        "": ("theta", 0 * u.deg),
        "derotator": ("theta", 0.5 * u.deg),
        "hwp": ("w_sio2", 1 * u.um),
    }
    for optic, (key, change) in cases.items():
        was = getattr(chain[optic or "hwp"], key).quantity
        setattr(chain[optic or "hwp"], key, was + change)
        night(2).write(table, overwrite=True)
        setattr(chain[optic or "hwp"], key, was)
        assert main(["diagnose", str(known), str(table), *FEW]) == 0
        told = " ".join(capsys.readouterr().out.split())
        assert told.startswith("The model agrees with the measurements")
        moved = told.partition("fitted to these data again, and ")[2]
        expected = (
            f"those of {optic} moved by " if optic else "moved by less than 5 standard errors"
        )
        assert moved.startswith(expected)


@pytest.mark.slow
def test_edits_of_the_model(folder, tmp_path):
    table = folder / "polarized.ecsv"
    elliptical = run(tmp_path, table, *FEW)
    assert "derotator.diagonal" in elliptical["nominal"]
    edits = ["--derotator", "linear", "--free", "wollaston.theta", "--fix", "derotator.theta"]
    content = run(tmp_path, table, "--effects", "beam_gain", *edits)
    assert "wollaston.theta" in content["nominal"]
    assert "derotator.theta" not in content["nominal"]
    assert "derotator.retardance" in content["nominal"]


def test_list_of_effects(capsys):
    assert main(["diagnose", "--effects", "help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if not line.startswith(" ")] == list(EFFECTS)


@pytest.mark.slow
def test_bad_input(folder, cal, tmp_path, capsys):
    table, dark = folder / "polarized.ecsv", folder / "unpolarized.ecsv"
    assert "at least one FILE" in complaint(capsys)
    assert "at least one FILE" in complaint(capsys, cal)
    assert "did you mean 'beam_gain'" in complaint(capsys, table, "--effects", "beam_gian")
    assert "separated by commas" in complaint(capsys, table, "--effects", ",")
    assert "no folder" in complaint(capsys, table, "--report", tmp_path / "no" / "gap.html")
    page = tmp_path / "gap.pdf"
    words = f"--report {page}: the name must end with .html or .htm"
    assert words in complaint(capsys, table, "--report", page)
    assert "same frames" in complaint(capsys, table, table)
    line = complaint(capsys, table, "--save", tmp_path / "better.fits")
    assert line.endswith("better.fits: the name must end with .asdf")
    assert "--derotator" in complaint(capsys, cal, table, "--derotator", "linear")
    line = complaint(capsys, cal, dark)
    assert "unpolarized.ecsv: its source is 'unpolarized'" in line
    assert "'polarized' only" in line
    other = tmp_path / "other.ecsv"
    moved = Observations.read(table).to_table()
    moved["wavelength"] = 1.02 * moved["wavelength"]
    Observations.from_table(moved).write(other)
    assert "are none of the" in complaint(capsys, cal, other)
    other.write_text(table.read_text().replace("SCExAO/CHARIS", "irdis"))
    assert "of different instruments: charis and irdis" in complaint(capsys, cal, other)
    assert "nowhere.ecsv" in complaint(capsys, folder / "nowhere.ecsv")
    assert "mirror" in complaint(capsys, table, "--without", "mirror")
    assert "no parameter 'nonsense'" in complaint(capsys, table, "--free", "hwp.nonsense")
