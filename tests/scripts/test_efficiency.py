# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal efficiency``."""

import json
import re
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import Calibration, calibrate, instruments, optics
from astropolcal.efficiency import polarimetric_efficiency
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    ChainError,
    InstrumentError,
    ParameterError,
)
from astropolcal.scripts.main import build_parser
from astropolcal.simulation import half_wave_plate_cycles, simulate

NIGHT = "2025-11-03T10:00/2025-11-03T13:00"


def run(*argv):
    arguments = build_parser().parse_args(["efficiency", *(str(word) for word in argv)])
    arguments.run(arguments)


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    charis = instruments.get("charis")
    chain = charis.chain(derotator="linear", wavelength=[1.2, 1.6, 2.2] * u.um)
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    data = simulate(chain, [1.2, 1.6, 2.2] * u.um, frames, seed=1)
    path = tmp_path_factory.mktemp("cal") / "cal.asdf"
    calibrate(chain, data, instrument="charis", cross_validate=False).write(path)
    return path


def test_published_values_without_a_file(capsys):
    run("--derotator", 45, 90, "--wavelength", 1.58, 2.3)
    out = capsys.readouterr().out
    assert "Polarimetric efficiency of charis at altitude 60 deg" in out
    rows = [line.split() for line in out.splitlines() if line.strip()[:2] in ("45", "90")]
    assert [row[0] for row in rows] == ["45.00", "90.00"]
    assert float(rows[0][1]) < 0.4 < 0.95 < float(rows[1][1])


def test_more_than_one_is_explained(capsys):
    run("--instrument", "irdis", "--derotator", 90, "--date", "2020-01-01")
    out = capsys.readouterr().out
    words = "Above 1: optics before the analyzer add polarization of their own."
    numbers = [float(text) for text in re.findall(r"\d\.\d{3}", out)]
    assert (words in out) == (max(numbers) > 1)
    assert max(numbers) > 1
    run("--derotator", 45)
    assert "Above 1" not in capsys.readouterr().out


def test_calibration_of_a_lamp_is_taken_to_the_sky(calibration, tmp_path):
    out = tmp_path / "out.json"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run(calibration, "--altitude", 50, "--parallactic", -30, "--json", out, "-q")
    bad = Calibration.read(calibration)
    bad.fit["converged"] = False
    bad.write(tmp_path / "bad.asdf")
    with pytest.warns(AstropolcalWarning, match="bad.asdf: NOT USABLE AS IT IS: the fit did not"):
        run(tmp_path / "bad.asdf", "-q")
    content = json.loads(out.read_text())
    assert content["wavelength_nm"] == pytest.approx([1200, 1600, 2200])
    assert np.shape(content["efficiency"]) == (7, 3)
    assert content["derotator_deg"] == [0, 15, 30, 45, 60, 75, 90]


@pytest.mark.slow
def test_best_offset_for_a_night(capsys):
    run("--target", "72.7,28.3", "--night", NIGHT)
    out = capsys.readouterr().out
    assert "Best derotator offset of charis, pupil stabilized:" in out
    # the table of another pointing was not asked for
    assert out.startswith("Target at altitude")
    # the star passes north of the zenith, where the angle goes on from -180 to 180 deg
    first, last = map(float, re.search(r"parallactic angle (\S+) to (\S+) deg", out).groups())
    assert first < -180 < last < first + 180


@pytest.mark.slow
def test_table_is_printed_beside_a_target_if_it_is_asked_for(capsys):
    for words in [["--altitude", "60"], ["--parallactic", "0"], ["--derotator", "90"]]:
        run("--target", "72.7,28.3", "--night", NIGHT, *words)
        table, best = capsys.readouterr().out.strip().split("\n\nTarget")
        assert table.startswith("Polarimetric efficiency of charis at altitude 60 deg"), words
        assert "Best derotator offset" in best, words


def test_json_has_the_table_whatever_is_printed(capsys):
    run("--target", "72.7,28.3", "--night", NIGHT, "--json", "-")
    content = json.loads(capsys.readouterr().out)
    assert content["altitude_deg"] == 60
    assert content["parallactic_deg"] == 0
    assert np.shape(content["efficiency"]) == (7, len(content["wavelength_nm"]))
    assert content["best_derotator"]["least"] >= content["best_derotator"]["least_of_any_offset"]


def test_instrument_without_telescope_is_seen_behind_its_source(capsys, monkeypatch):
    monkeypatch.setattr(type(instruments.get("charis")), "has_telescope", False)
    run("--derotator", 90)
    assert "of charis downstream of the internal source" in capsys.readouterr().out


@pytest.mark.slow
def test_figure_is_written(tmp_path):
    run("-o", tmp_path / "efficiency.png", "-q")
    assert (tmp_path / "efficiency.png").stat().st_size > 10_000


def test_unknown_format_of_the_figure_is_refused(tmp_path):
    with pytest.raises(AstropolcalError, match="xyz"):
        run("-o", tmp_path / "efficiency.xyz", "-q")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_bad_input_is_one_error():
    for argv, error, words in [
        (["--target", "72.7,28.3"], ParameterError, "--target 72.7,28.3 needs --night START/END"),
        (["--target", "x", "--night", NIGHT], ParameterError, "give RA,DEC in degrees"),
        (["--target", "1,2", "--night", "yesterday"], ParameterError, "START/END"),
        (
            ["--target", "1,2,3", "--night", NIGHT],
            ParameterError,
            "--target 1,2,3: give RA,DEC in",
        ),
        (
            ["--target", "nan,2", "--night", NIGHT],
            ParameterError,
            "--target nan,2: give RA,DEC in",
        ),
        (["--target", "1,nan", "--night", NIGHT], ParameterError, "--target 1,nan: give RA,DEC"),
        (["--target", "\u0661,2", "--night", NIGHT], ParameterError, "give RA,DEC in degrees"),
        (["--target", "1,95", "--night", NIGHT], ParameterError, "--target 1,95: .* -90 to 90"),
        (
            ["--target", "1,2", "--night", "2025-11-03"],
            ParameterError,
            r"^--night 2025-11-03: write START/END in UTC, such as 2025-11-03T08:00/\S+$",
        ),
        (
            ["--target", "72.7,28.3", "--night", "/".join(NIGHT.split("/")[::-1])],
            ParameterError,
            r"--night 2025-11-03T13:00/2025-11-03T10:00: ends before it starts",
        ),
        (["--wavelength", "5"], ParameterError, r"--wavelength 5: allowed are 1.160 to 2.369 um"),
        (["--altitude", "95"], AstropolcalError, "altitude = 95 deg"),
        (["--law", "sky"], ParameterError, "--law sky: allowed of charis are pupil, field"),
        (["--law", "field"], ParameterError, "--law field: of charis it only tells the best off"),
        (["--date", "2020-01-01"], ParameterError, "--date: the telescope of charis"),
        (["--instrument", "irdis", "--date", "spring"], InstrumentError, "is not a date"),
        (["--instrument", "nothing"], InstrumentError, "unknown instrument 'nothing'"),
        (["-o", "/nowhere/x.png"], AstropolcalError, "there is no folder"),
        (["missing.asdf"], AstropolcalError, "missing.asdf"),
    ]:
        with pytest.raises(error, match=words):
            run(*argv)


def test_file_of_another_instrument_is_refused(calibration):
    words = r"cal.asdf: the calibration is of instrument 'charis', not 'irdis'"
    with pytest.raises(InstrumentError, match=words):
        run(calibration, "--instrument", "irdis")
    run(calibration, "--instrument", "CHARIS", "-q")


def test_law_and_coating_are_those_of_the_instrument(tmp_path):
    found = []
    for options in (["--law", "field"], ["--law", "pupil"], ["--date", "2016-01-01"]):
        out = tmp_path / "out.json"
        dated = options if "--date" in options else [*options, "--date", "2018-01-01"]
        run("--instrument", "irdis", *dated, "--parallactic", 30, "--json", out, "-q")
        found.append(np.array(json.loads(out.read_text())["efficiency"]))
    assert found[0].shape == (7, 4)
    assert np.abs(found[0] - found[1]).max() > 1e-5
    assert np.abs(found[1] - found[2]).max() > 1e-5


def test_without_a_half_wave_plate_it_is_that_of_the_frames_that_were_calibrated(tmp_path, capsys):
    roman = instruments.get("roman")
    frames = QTable({"roll": np.repeat([-13, 0, 13], 2) * u.deg})
    frames["prism"] = np.tile([0, 45], 3) * u.deg
    meta = {"instrument": "roman", "source": "polarized standard"}
    chain = roman.chain("polarized standard")
    star = simulate(chain, roman.wavelength, frames, flux=1e9, seed=1, meta=meta)
    chain["wollaston"].efficiency.fixed = chain["wollaston"].theta.fixed = True
    chain["mirrors"].retardance.fixed = True
    path, out = tmp_path / "roman.asdf", tmp_path / "out.json"
    calibrate(chain, star, instrument="roman", cross_validate=False).write(path)
    run(path, "--json", out)
    content = json.loads(out.read_text())
    assert content["components"] == ["I", "Q", "U"]
    # Q and U are measured one after the other
    np.testing.assert_allclose(content["efficiency"][1:], 0.7, atol=0.02)
    assert "Efficiencies of 6 frames of roman" in capsys.readouterr().out
    for option in (("--derotator", 45), ("-o", tmp_path / "figure.png")):
        with pytest.raises(ParameterError, match=f"{option[0]}: is for instruments with"):
            run(path, *option)
    with pytest.raises(ChainError, match="demodulation gives the efficiencies of its frames"):
        polarimetric_efficiency(chain, roman.wavelength, parallactic=0 * u.deg)


def test_frames_are_those_of_all_datasets_whichever_comes_first(tmp_path, capsys, monkeypatch):
    """The first has a calibration unit, whose angles are not those of the light of a star."""
    known = type("Known", (instruments.Instrument,), {"name": "known", "chain": None})
    monkeypatch.setattr(instruments, "_REGISTRY", instruments._REGISTRY | {"known": known})
    inner = optics.LinearRetarder(retardance=125 * u.deg, mount="turning", name="plate")
    inner |= optics.WollastonPrism(efficiency=0.98, name="prism")
    unit = optics.LinearRetarder(retardance=80 * u.deg, mount="unit", name="retarder")
    lamp = optics.LinearPolarizer(mount="first", name="polarizer")
    frames = QTable({"turning": np.tile(np.arange(0, 180, 22.5), 6) * u.deg})
    frames["first"] = frames["unit"] = np.repeat(np.arange(0, 180, 30), 8) * u.deg
    chains = [lamp | unit | inner, inner]
    data = [simulate(one, [0.5] * u.um, frames, name=one.submodel_names[0]) for one in chains]
    path = tmp_path / "cal.asdf"
    calibrate(chains, data, instrument="known", cross_validate=False).write(path)
    run(path)
    assert "Efficiencies of 8 frames of known" in capsys.readouterr().out
