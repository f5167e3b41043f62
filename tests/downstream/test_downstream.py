# Licensed under a 3-clause BSD style license - see LICENSE
"""
What a package that brings an instrument along relies on.

``tox -e downstream`` installs the package in this folder beside the wheel of astropolcal;
elsewhere its module and its entry point stand in for that.
"""

import ast
import importlib.metadata
import json
import tomllib
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, Observations, instruments, simulate
from astropolcal.exceptions import InstrumentError
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles
from astropolcal.testing import check_instrument

HERE = Path(__file__).parent
PROJECT = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
GROUP = "astropolcal.instruments"


def _installed():
    return "twincam" in {point.name for point in importlib.metadata.entry_points(group=GROUP)}


@pytest.fixture(scope="module", autouse=True)
def package(tmp_path_factory):
    """The package as installed, or what an installation leaves on the path."""
    if _installed():
        yield
        return
    folder = tmp_path_factory.mktemp("site")
    (folder / "twincam.py").write_text((HERE / "twincam.py").read_text(encoding="utf-8"))
    info = folder / "astropolcal_twincam-1.0.dist-info"
    info.mkdir()
    lines = [f"{name} = {where}" for name, where in PROJECT["entry-points"][GROUP].items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *lines]))
    header = f"Metadata-Version: 2.1\nName: {PROJECT['name']}\nVersion: {PROJECT['version']}\n"
    (info / "METADATA").write_text(header)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        patch.setattr(instruments, "_REGISTRY", dict(instruments._REGISTRY))
        yield


@pytest.fixture(scope="module")
def lamp():
    """Frames of the lamp, and the chain that they were simulated with."""
    twincam = instruments.get("twincam")
    truth = twincam.chain()
    truth["derotator"].retardance = [140, 160] * u.deg
    frames = half_wave_plate_cycles(derotator=[10, 40, 70, 100] * u.deg)
    meta = {"instrument": "twincam", "source": "polarized"}
    return simulate(truth, twincam.wavelength, frames, flux=1e7, seed=1, meta=meta), truth


@pytest.fixture
def table(lamp, tmp_path):
    path = tmp_path / "lamp.ecsv"
    lamp[0].write(path)
    return path


def test_the_class_is_that_of_the_page():
    """What the documentation tells others to write is what is tested here."""
    page = HERE.parents[1] / "docs" / "adding_an_instrument.rst"
    lines = iter(page.read_text(encoding="utf-8").splitlines())
    shown = [next(line for line in lines if line.startswith(">>> class TwinCam"))]
    for line in lines:
        if not line.startswith("..."):
            break
        shown.append(line)
    shown = ast.parse("\n".join(line[4:] for line in shown)).body[0]
    module = ast.parse((HERE / "twincam.py").read_text(encoding="utf-8"))
    (kept,) = [node for node in module.body if isinstance(node, ast.ClassDef)]
    assert ast.dump(kept) == ast.dump(shown)


def test_instrument_is_found_by_its_entry_point_and_alias():
    assert "twincam" in instruments.names()
    twincam = instruments.get("twincam")
    assert type(instruments.get("Observatory/TwinCam")) is type(twincam)
    assert type(twincam).__module__ == "twincam"


@pytest.mark.slow
def test_instrument_conforms():
    assert check_instrument(instruments.get("twincam"))


def test_table_knows_its_instrument(table):
    observations = Observations.read(table)
    (chain,) = instruments.get(observations.instrument).chains_for([observations])
    assert chain.submodel_names == ("polarizer", "hwp", "derotator", "wollaston")


@pytest.mark.slow
def test_command_line_calibrates_and_reads_back(table, lamp, tmp_path):
    """Retardances come back within their errors, through the file that a pipeline loads."""
    cal, summary = tmp_path / "cal.asdf", tmp_path / "cal.json"
    status = main(["calibrate", str(table), "-o", str(cal), "--json", str(summary), "--quiet"])
    assert status == 0
    assert json.loads(summary.read_text())["instrument"] == "twincam"
    again = Calibration.read(cal)
    found = again.parameter_values()["derotator.retardance"]
    expected = lamp[1]["derotator"].retardance.value
    assert np.all(np.abs(np.asarray(found["value"]) - expected) < 5 * np.asarray(found["std"]))


def test_command_line_names_an_instrument_that_is_not_installed(table, capsys):
    text = table.read_text().replace("twincam", "quadcam")
    table.write_text(text)
    assert main(["calibrate", str(table)]) == 2
    assert "quadcam" in capsys.readouterr().err


def test_source_that_the_instrument_lacks_is_refused():
    with pytest.raises(InstrumentError, match=r"unpolarized.*polarized.*star"):
        instruments.get("twincam").chain("unpolarized")


def test_star_gets_the_telescope_in_front():
    twincam = instruments.get("twincam")
    on_sky = twincam.on_sky(twincam.chain())
    assert on_sky.submodel_names[:4] == ("parallactic", "m3", "altitude", "hwp")
