# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal reduce``."""

import json
from types import SimpleNamespace

import astropy.units as u
import pytest
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.exceptions import AstropolcalError, InstrumentError
from astropolcal.observations import Observations
from astropolcal.reduction.cubes import simulate_cubes
from astropolcal.scripts._common import check_paths
from astropolcal.scripts._reduce import _options, _report
from astropolcal.scripts.main import build_parser
from astropolcal.simulation import half_wave_plate_cycles


def command(*words):
    arguments = build_parser().parse_args(["reduce", *map(str, words)])
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


def test_words_that_cannot_be_read(cubes, tmp_path, capsys):
    for words in [["--meta", "dichroic"], ["--radius", "wide"], ["--hwp-sequence", "0,x"]]:
        with pytest.raises(SystemExit):
            command(cubes, "-o", tmp_path / "obs.ecsv", *words)
        assert words[1].split(",")[0] in capsys.readouterr().err, words


def test_what_is_written_and_read_is_known_before_the_work(cubes, tmp_path):
    with pytest.raises(AstropolcalError, match=r"-o obs\.fits: the name must end with \.ecsv"):
        command(cubes, "-o", "obs.fits")
    with pytest.raises(InstrumentError, match=r"did you mean 'charis'\?") as caught:
        command(cubes, "-o", tmp_path / "obs.ecsv", "--instrument", "charsi")
    assert all(name in str(caught.value) for name in instruments.names())
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


DOUBT = "no keyword RET-POS1: the tracking of the half-wave plate was not checked"


class Reduced:
    """As much of a reduction as a report reads."""

    def __init__(self, n_problems=0, doubts=None, flags=None, n_frames=2):
        self.problems = {f"night/a{i:02d}.fits": ["no star", "old"] for i in range(n_problems)}
        self.doubts = doubts or {}
        self.flags, self.n_frames = flags or {}, n_frames
        self.table = QTable({"flux_right": [2.0, 4] * u.ct, "flux_right_err": [0.02, 0.08] * u.ct})

    def summary(self):
        return {
            "n_frames": self.n_frames, "n_cells": 4 * self.n_frames,
            "n_masked": sum(self.flags.values()), "flags": self.flags,
        }  # fmt: skip


def said(capsys, reduction, figures=(), **options):
    arguments = {
        "output": "run.ecsv",
        "quiet": False,
        "json": None,
        "quicklook": "look",
        "full": False,
    }
    arguments |= options
    _report(reduction, SimpleNamespace(**arguments), figures)
    return capsys.readouterr()


def test_report_of_a_run(capsys):
    out, err = said(capsys, Reduced())
    assert out.splitlines() == [
        "Usable",
        "Accuracy    errors of the fluxes 1.5 % (median, one beam, one frame)",
        "Determined  2 frames, 0 of 8 cells masked",
        "Next        astropolcal calibrate run.ecsv",
        "Written:    run.ecsv",
    ]
    assert err == ""
    assert "\nDetermined  1 frame, 0 of 4 c" in said(capsys, Reduced(n_frames=1)).out
    # what is lost is in the verdict
    for reduction, words in [
        (Reduced(2, doubts={"a": [DOUBT]}), "Usable: 2 files left out, 1 file doubtful"),
        (Reduced(flags={"edge": 8}), "NOT USABLE AS IT IS: all cells are masked"),
    ]:
        assert words in said(capsys, reduction).out.splitlines(), words
    # masked cells and figures are counted
    out = said(capsys, Reduced(flags={"saturated": 3, "edge": 1}), ["a.png"]).out
    lines = out.splitlines()
    assert lines[:2] == ["  masked, saturated: 3 cells", "  masked, edge: 1 cell"]
    assert "Determined  2 frames, 4 of 8 cells masked" in lines
    assert lines[-1] == "Written:    1 figure in look"


def test_what_is_left_out_is_listed_up_to_a_limit(capsys):
    for quiet in [False, True]:
        for n, listed, last in [
            (1, 1, "astropolcal: left out: a00.fits: no star; old"),
            (20, 20, "astropolcal: left out: a19.fits: no star; old"),
            (21, 20, "astropolcal: left out: 1 more file (--json lists all)"),
            (25, 20, "astropolcal: left out: 5 more files (--json lists all)"),
        ]:
            out, err = said(capsys, Reduced(n), quiet=quiet)
            lines = err.splitlines()
            assert sum("no star; old" in line for line in lines) == listed, (quiet, n, listed, last)
            assert lines[-1] == last, (quiet, n, listed, last)
            assert (out == "") == quiet, (quiet, n, listed, last)


def test_doubts_are_counted_by_reason(capsys):
    doubts = {"a": [DOUBT, "odd"], "b": [DOUBT], "c": [DOUBT]}
    assert said(capsys, Reduced(doubts=doubts)).err.splitlines() == [
        f"astropolcal: doubtful: 3 files: {DOUBT}",
        "astropolcal: doubtful: 1 file: odd",
    ]


def test_json_on_the_standard_output_is_alone(capsys):
    out, err = said(capsys, Reduced(1), json="-")
    assert out == ""
    assert "left out" in err


# ---- options -----------------------------------------------------------------------------


def options(source, **given):
    known = {"background": None, "radius": None, "aperture_correction": None} | given
    return _options(SimpleNamespace(source=source, **known))


def test_options_are_passed_on_if_they_were_given():
    for source, given in [
        ("internal", {}),
        ("polarized", {"background": "outside"}),
        ("star", {"radius": "growth", "aperture_correction": True}),
        ("unpolarized standard star", {"radius": 12.0}),
    ]:
        assert options(source, **given) == given, (source, given)


def test_options_of_the_other_photometry_are_refused():
    for source, given, words in [
        ("star", {"background": "none"}, "--background is for the internal source, not for --sou"),
        ("internal", {"radius": 3.0}, "--radius is for stars, not for --source internal"),
        (
            "unpolarized",
            {"radius": 3.0, "aperture_correction": True},
            "--aperture-correction, --radius is for stars",
        ),
    ]:
        with pytest.raises(AstropolcalError, match=words):
            options(source, **given)
