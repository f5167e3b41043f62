# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal reduce``."""

import argparse
import json

import astropy.units as u
import pytest

from astropolcal import instruments
from astropolcal.exceptions import AstropolcalError, InstrumentError
from astropolcal.observations import Observations
from astropolcal.reduction.cubes import simulate_cubes
from astropolcal.scripts import _reduce
from astropolcal.scripts._common import check_paths
from astropolcal.simulation import half_wave_plate_cycles


def command(*words):
    parser = argparse.ArgumentParser()
    _reduce.add_parser(parser.add_subparsers())
    arguments = parser.parse_args(["reduce", *map(str, words)])
    check_paths(arguments)
    arguments.run(arguments)


@pytest.fixture(scope="module")
def cubes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cubes")
    charis = instruments.get("charis")
    frames = half_wave_plate_cycles(hwp=[0, 45, 22.5, 67.5] * u.deg, derotator=[45] * u.deg)
    simulate_cubes(folder, charis.published(), charis, frames, flux=1e7, seed=1)
    return folder


@pytest.mark.slow
def test_cubes_to_table(cubes, tmp_path, capsys):
    (cubes / "CRSA00000077_cube.fits").write_text("no FITS")
    table, summary = tmp_path / "obs.ecsv", tmp_path / "summary.json"
    look = tmp_path / "look"
    words = ["-o", table, "--json", summary, "--quicklook", look]
    command(cubes, "--raw", cubes / "raw", "--meta", "yjh50_dichroic=in", *words)
    observations = Observations.read(table)
    assert (observations.n_frames, observations.n_bins) == (4, 22)
    assert instruments.get("charis").setup(observations)[1] == ("dichroic", "nbs")
    content = json.loads(summary.read_text())
    assert content["n_frames"] == 4
    assert content["n_masked"] == 0
    assert [path.rpartition("/")[2] for path in content["problems"]] == ["CRSA00000077_cube.fits"]
    assert sorted(path.name for path in look.iterdir()) == ["apertures.png", "run.png"]
    out, err = capsys.readouterr()
    assert "4 frames, 0 of 88 cells masked" in out
    assert "left out: CRSA00000077_cube.fits" in err


def test_without_raw_headers_nothing_is_usable(cubes, tmp_path):
    with pytest.raises(AstropolcalError, match=r"none of the .* RET-ANG1.*--raw DIR"):
        command(cubes, "-o", tmp_path / "obs.ecsv", "-q")
    assert not (tmp_path / "obs.ecsv").exists()


def test_options_of_the_other_source_are_refused(cubes, tmp_path):
    with pytest.raises(AstropolcalError, match="--radius is for stars"):
        command(cubes, "-o", tmp_path / "obs.ecsv", "--radius", "12")
    with pytest.raises(AstropolcalError, match="--background is for the internal source"):
        command(cubes, "-o", tmp_path / "a.ecsv", "--source", "star", "--background", "none")


@pytest.mark.parametrize(
    "words",
    [["--meta", "dichroic"], ["--radius", "wide"], ["--hwp-sequence", "0,x"]],
)
def test_words_that_cannot_be_read(cubes, tmp_path, words, capsys):
    with pytest.raises(SystemExit):
        command(cubes, "-o", tmp_path / "obs.ecsv", *words)
    assert words[1].split(",")[0] in capsys.readouterr().err


def test_what_is_written_and_who_took_it_are_known_before_the_work(cubes, tmp_path):
    with pytest.raises(AstropolcalError, match=r"-o obs\.fits: the name must end with \.ecsv"):
        command(cubes, "-o", "obs.fits")
    with pytest.raises(InstrumentError, match=r"did you mean 'charis'\?") as caught:
        command(cubes, "-o", tmp_path / "obs.ecsv", "--instrument", "charsi")
    assert all(name in str(caught.value) for name in instruments.names())


def test_missing_places(cubes, tmp_path):
    with pytest.raises(AstropolcalError, match="no folder"):
        command(cubes, "-o", tmp_path / "a" / "obs.ecsv")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(AstropolcalError, match="no FITS file"):
        command(empty, "-o", tmp_path / "obs.ecsv")


def test_summary_on_stdout(cubes, tmp_path, capsys):
    words = ["--raw", cubes / "raw", "-o", tmp_path / "obs.ecsv", "--json", "-", "-q"]
    command(cubes, "--resume", tmp_path / "run.journal", *words)
    assert json.loads(capsys.readouterr().out)["photometry"] == "internal"
    assert (tmp_path / "run.journal").stat().st_size > 1000
