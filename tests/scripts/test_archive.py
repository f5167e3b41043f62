# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal correct`` and ``reduce`` of whole archives."""

import hashlib
import json
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from benchmarks import archive as bench

from astropolcal import Calibration, Observations, instruments
from astropolcal.correction import Corrected
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning
from astropolcal.pipeline import Library
from astropolcal.reduction.archive import Index, Manifest
from astropolcal.reduction.cubes import CubeFiles, simulate_cubes
from astropolcal.scripts.main import main
from astropolcal.simulation import half_wave_plate_cycles

HEADER = {"INSTRUME": "CHARIS", "OBJECT": "HD 1", "FILTNAME": "Broadband", "EXPTIME": 30.0}
OPTIONS = ("--any-date", "--centre", "5,5", "--size", 7, "--workers", 1)
N = 4


def write_header(path, **changes):
    """A FITS file without data."""
    path.parent.mkdir(parents=True, exist_ok=True)
    cards = {k: v for k, v in (HEADER | changes).items() if v is not None}
    fits.PrimaryHDU(header=fits.Header(cards)).writeto(path, overwrite=True)
    return path


def write_night(folder, hwp, start=60988.0, step=60.0, first=0, **changes):
    """Frames a minute apart, at angles of the half-wave plate."""
    return [
        write_header(
            folder / f"CRSA{first + i:08d}.fits",
            **({"RET-ANG1": angle, "MJD": start + i * step / 86400} | changes),
        )
        for i, angle in enumerate(hwp)
    ]


def indexed(tmp_path, **options):
    """The sequences of a folder, as lists of frame numbers, and what belongs to none."""
    with closing(Index(tmp_path / "index.sqlite")) as index:
        counts = index.update(tmp_path / "tree", workers=1)
        found = list(index.sequences(**({"gap": 1800} | options)))
        numbers = {s.name: [int(Path(f).stem[4:]) for f in s.files] for s in found}
        return counts, numbers, dict(index.problems())


# ---- index and sequences -------------------------------------------------------------------------


CYCLE = [0.0, 45.0, 22.5, 67.5]


def test_frames_are_cut_into_sequences(tmp_path):
    tree = tmp_path / "tree"
    write_night(tree / "a", 2 * CYCLE)
    # after an hour; another object; another mode
    write_night(tree / "b", CYCLE, 60988.0 + 1 / 24, first=10)
    write_night(tree / "b", CYCLE, 60988.002, first=20, OBJECT="HD 2")
    write_night(tree / "a", CYCLE, 60988.004, first=30, FILTNAME="K")
    _, found, _ = indexed(tmp_path)
    assert found == {
        "charis_hd1_Broadband_20251109T000000": list(range(8)),
        "charis_hd1_Broadband_20251109T010000": [10, 11, 12, 13],
        "charis_hd1_K_20251109T000545": [30, 31, 32, 33],
        "charis_hd2_Broadband_20251109T000252": [20, 21, 22, 23],
    }
    _, found, _ = indexed(tmp_path, gap=7200, target="hd 1*")
    assert sorted(map(len, found.values())) == [4, 12]
    _, found, _ = indexed(tmp_path, cycles=1)
    assert [0, 1, 2, 3] in found.values()
    assert [4, 5, 6, 7] in found.values()


def test_a_cycle_ends_where_an_angle_comes_again(tmp_path):
    """Several frames at an angle are of one cycle, and what a cycle lacks ends none."""
    write_night(tmp_path / "tree", [0, 0, 45, 45, 22.5, 67.5, 0, 45, 22.5, 0.1, 135, 22.5, 67.5])
    _, found, _ = indexed(tmp_path, cycles=1)
    assert list(found.values()) == [[0, 1, 2, 3, 4, 5], [6, 7, 8], [9, 10, 11, 12]]
    _, found, _ = indexed(tmp_path, cycles=2)
    assert list(map(len, found.values())) == [9, 4]


def test_frames_without_a_time_follow_their_numbers(tmp_path):
    write_night(tmp_path / "tree", CYCLE, MJD=None)
    _, found, _ = indexed(tmp_path)
    assert found == {"charis_hd1_Broadband_00000000": [0, 1, 2, 3]}
    # and are of no other night, such as the last one
    write_night(tmp_path / "tree", CYCLE, first=10)
    _, found, _ = indexed(tmp_path)
    assert sorted(found.values()) == [[0, 1, 2, 3], [10, 11, 12, 13]]


def test_only_new_and_changed_files_are_opened(tmp_path):
    tree = tmp_path / "tree"
    paths = write_night(tree, CYCLE)
    (tree / "notes.txt").write_text("no FITS file")
    (tree / "bad.fits").write_text("no FITS file either")
    counts, _, problems = indexed(tmp_path)
    assert counts == (5, 5)
    assert list(problems) == [str(tree / "bad.fits")]
    assert indexed(tmp_path)[0] == (5, 0)
    paths[0].unlink()
    write_header(paths[1], OBJECT="HD 2", MJD=60988.0, COMMENT="x" * 3000)
    counts, found, _ = indexed(tmp_path)
    assert counts == (4, 1)
    assert sorted(found.values()) == [[1], [2, 3]]


def test_files_that_are_no_frames_say_why(tmp_path):
    tree = tmp_path / "tree"
    write_header(tree / "a.fits", INSTRUME="NICI")
    write_header(tree / "b.fits", CALHASH="0", POLCONV="IAU")
    _, found, problems = indexed(tmp_path)
    reasons = [problems[str(tree / name)] for name in ("a.fits", "b.fits")]
    assert not found
    assert reasons[0].startswith("which instrument? the header says 'NICI', which is not known")
    assert reasons[1] == "a corrected product of this package, not a frame"


def test_a_corrupt_index_is_made_again(tmp_path):
    write_night(tmp_path / "tree", CYCLE)
    indexed(tmp_path)
    path = tmp_path / "index.sqlite"
    for content in (b"no data base", path.read_bytes()[:5000] + b"\xff" * 3000):
        path.write_bytes(content)
        with pytest.warns(AstropolcalWarning, match=r"index\.sqlite: not a readable index"):
            assert indexed(tmp_path)[0] == (4, 4)
    # one of another version, without a warning
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA user_version = 99")
    assert indexed(tmp_path)[0] == (4, 4)


def test_headers_are_read_again_for_another_instrument(tmp_path):
    write_night(tmp_path / "tree", CYCLE, INSTRUME=None)
    assert not indexed(tmp_path)[1]
    for instrument in ("charis", "charis", "ircs"):
        with closing(Index(tmp_path / "index.sqlite")) as index:
            with suppress(AstropolcalError):
                index.update(tmp_path / "tree", instrument=instrument, workers=1)
            found = list(index.sequences(gap=1800))
        assert [s.instrument for s in found] == (["charis"] if instrument == "charis" else [])


def test_two_runs_at_a_time_are_refused(tmp_path):
    write_night(tmp_path / "tree", CYCLE)
    with closing(Index(tmp_path / "index.sqlite")) as index:
        index.update(tmp_path / "tree", workers=1)
        with pytest.raises(AstropolcalError, match="another run works on this archive"):
            Index(tmp_path / "index.sqlite")


def test_manifest_lines_that_cannot_be_read(tmp_path):
    path = tmp_path / "manifest.jsonl"
    manifest = Manifest(path)
    manifest.add({"name": "a", "key": "1", "state": "failed", "reason": "why"})
    with path.open("a") as stream:
        stream.write('{"name": "b", "ke')
    # a run that was killed while it wrote
    manifest = Manifest(path)
    manifest.add({"name": "c", "key": "1", "state": "failed"})
    with pytest.warns(AstropolcalWarning, match="1 of its lines cannot be read"):
        manifest = Manifest(path)
    assert [manifest.state(*names) for names in (("a", "1"), ("a", "2"), ("b", "1"))] == [
        *("failed", "", "")
    ]
    assert manifest.state("c", "1") == "failed"
    path.write_text("something else\n")
    with pytest.raises(AstropolcalError, match="not a manifest; take another folder"):
        Manifest(path)


# ---- the command ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A calibration, and some sequences."""
    folder = tmp_path_factory.mktemp("lab")
    calibration = bench.write_calibration(folder / "charis.asdf")
    bench.write_sequences(folder / "tree", calibration, range(N))
    return folder


def archive(lab, out, *more, tree=None, calibration=None):
    """Run the command in this process; return its status and its summary."""
    words = ["correct", tree or lab / "tree", "--archive", out, *OPTIONS, "--json", f"{out}.json"]
    words += ["--calibration", calibration or lab / "charis.asdf", "-q", *more]
    status = main(list(map(str, words)))
    return status, json.loads(Path(f"{out}.json").read_text())


def entries(out):
    lines = (out / "manifest.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


@pytest.mark.slow
def test_an_archive_is_corrected_and_gone_on_with(lab, tmp_path, capsys):
    out = tmp_path / "out"
    status, summary = archive(lab, out, "--workers", 2)
    assert (status, summary["n_done"], summary["n_worked_on"]) == (0, N, N)
    assert capsys.readouterr().out == ""
    first = entries(out)
    assert len(first) == N
    for entry in first:
        product = out / entry["product"]
        assert hashlib.sha256(product.read_bytes()).hexdigest() == entry["sha256"]
        assert len(entry["calibration_hash"]) == 64
        assert Path(entry["calibration"]) == lab / "charis.asdf"
        assert Corrected.read(product).stokes.shape == (3, 22, 7, 7)
    assert summary["most_megabytes"] < 1000
    # nothing to do; then what is lacking, what was altered, and what other settings give
    assert archive(lab, out)[1]["n_worked_on"] == 0
    (out / first[0]["product"]).unlink()
    with (out / first[1]["product"]).open("ab") as stream:
        stream.write(b" ")
    assert archive(lab, out)[1]["n_worked_on"] == 2
    assert archive(lab, out, "--mode", "ip")[1]["n_worked_on"] == N


@pytest.mark.long
def test_a_sequence_that_fails_stops_no_other(lab, tmp_path, capsys):
    tree, out = tmp_path / "tree", tmp_path / "out"
    for path in (lab / "tree").rglob("*.fits"):
        place = tree / path.relative_to(lab / "tree")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.symlink_to(path)
    one = sorted((tree / "00001").iterdir())[0]
    content = one.read_bytes()
    one.unlink()
    one.write_bytes(content)
    fits.setval(one, "RET-ANG1", value=1e9)
    status, summary = archive(lab, out, tree=tree)
    assert (status, summary["n_failed"], summary["n_done"]) == (1, 1, N - 1)
    ((name, reason),) = summary["failed"].items()
    assert "RET-ANG1 = 1000000000" in reason
    assert "hd1_" in name
    # what failed is not tried again unless that is asked for, or the file changes
    status, summary = archive(lab, out, tree=tree)
    assert (status, summary["n_worked_on"]) == (1, 0)
    status, summary = archive(lab, out, "--retry", tree=tree)
    assert (status, summary["n_worked_on"]) == (1, 1)
    fits.setval(one, "RET-ANG1", value=0.0)
    status, summary = archive(lab, out, tree=tree)
    assert (status, summary["n_worked_on"], summary["n_failed"]) == (0, 1, 0)
    # a product that is there already is not taken for that of this run
    fits.setval(one, "RET-ANG1", value=1e9)
    _, summary = archive(lab, out, tree=tree)
    assert summary["failed"][name].endswith(f"; {name}.fits is that of an earlier run")


@pytest.mark.slow
def test_the_summary_fits_a_terminal(lab, tmp_path, capsys):
    tree = tmp_path / "tree"
    for i in range(30):
        write_night(tree / f"{i}", CYCLE, OBJECT=f"HD {i}")
        (tree / f"{i}.fits").write_text("broken")
    words = ["correct", tree, "--archive", tmp_path / "out", *OPTIONS]
    words += ["--calibration", lab / "charis.asdf"]
    assert main(list(map(str, words))) == 1
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) <= 23
    assert max(map(len, shown[:-1])) <= 80
    assert "NOT COMPLETE: 30 of 30 sequences failed" in shown
    assert any("--retry" in line for line in shown)
    assert main([*map(str, words), "--full"]) == 1
    assert capsys.readouterr().out.count("  failed: ") == 30


@pytest.mark.long
def test_the_calibration_of_each_sequence_comes_from_a_library(lab, tmp_path):
    folder = tmp_path / "library"
    folder.mkdir()
    library = Library(folder)
    library.add(Calibration.read(lab / "charis.asdf"))
    out = tmp_path / "out"
    words = ["correct", lab / "tree", "--archive", out, "--calibration", folder, "-q"]
    assert main(list(map(str, [*words, *OPTIONS[1:]]))) == 0
    assert {entry["calibration_hash"] for entry in entries(out)} == {
        entry.content_hash for entry in Library(folder).entries
    }


@pytest.mark.long
def test_a_newer_calibration_makes_its_products_again(lab, tmp_path):
    folder, out = tmp_path / "library", tmp_path / "out"
    folder.mkdir()
    first = Library(folder).add(Calibration.read(lab / "charis.asdf"), valid_until="2040-01-01")
    words = ["correct", lab / "tree", "--archive", out, "--calibration", folder, "-q"]
    words = list(map(str, [*words, *OPTIONS[1:]]))
    assert main(words) == 0
    made = {path: path.stat().st_mtime_ns for path in out.glob("*.fits")}
    assert len(made) == N
    # one of other years concerns none of them: they are looked at, and stay
    other = Calibration.read(lab / "charis.asdf")
    Library(folder).add(other, "other.asdf", valid_from="2040-01-01")
    assert main(words) == 0
    assert {path: path.stat().st_mtime_ns for path in made} == made
    assert len(entries(out)) == 2 * N
    assert main(words) == 0
    assert len(entries(out)) == 2 * N
    # one in place of the first concerns all
    newer = Calibration.read(lab / "charis.asdf")
    newer.chain["hwp"].theta = newer.chain["hwp"].theta.quantity + 1 * u.deg
    added = Library(folder).add(newer, "newer.asdf", supersedes=[first.name])
    digest = next(e.content_hash for e in Library(folder).entries if e.name == added.name)
    assert main(words) == 0
    assert {e["calibration_hash"] for e in entries(out)[2 * N :]} == {digest}
    assert all(path.stat().st_mtime_ns > before for path, before in made.items())


@pytest.mark.slow
def test_an_archive_is_reduced(lab, tmp_path):
    charis = instruments.get("charis")
    (tmp_path / "tree").mkdir()
    for k in range(2):
        frames = half_wave_plate_cycles(CYCLE * u.deg, [60] * u.deg)
        frames["parallactic"], frames["altitude"] = np.full((2, 4), [[20.0], [60.0]]) * u.deg
        simulate_cubes(
            tmp_path / f"tree/{k}", charis.chain("unpolarized", ["nbs"]), charis, frames,
            source="internal", flux=1e7, seed=k, files=CubeFiles(raw=False),
        )  # fmt: skip
    words = ["reduce", tmp_path / "tree", "--archive", tmp_path / "out", "--workers", 2, "-q"]
    words += ["--json", tmp_path / "s.json"]
    assert main(list(map(str, words))) in (0, 1)
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["failed"] == {}
    tables = [tmp_path / "out" / entry["product"] for entry in entries(tmp_path / "out")]
    assert {Observations.read(path).n_frames for path in tables} == {4}


def test_bad_input(lab, tmp_path, capsys):
    write_night(tmp_path / "tree", CYCLE)
    (tmp_path / "empty").mkdir()
    tree, calibration = tmp_path / "tree", ["--calibration", lab / "charis.asdf"]
    out = ["--archive", tmp_path / "out"]
    for words, message in (
        (["correct", tree, *calibration], "-o FILE is needed, or --archive DIR"),
        (["correct", tree, *calibration, "-o", "a.fits", "--retry"], "--retry needs --archive"),
        (
            ["correct", tree, *calibration, *out, "-o", "a.fits"],
            "-o a.fits cannot be combined with",
        ),
        (
            ["correct", tree, *calibration, *out, "--plot", "a.png"],
            "--plot a.png cannot be combined",
        ),
        (["correct", tree, tree, *calibration, *out], "--archive takes one folder"),
        (["correct", tree, *calibration, *out, "--gap", "0"], "--gap 0: a number above zero"),
        (["correct", tree, *calibration, *out, "--target", "x"], "no sequence in it"),
        (["correct", tmp_path / "empty", *calibration, *out], "no FITS file in this folder"),
        (["correct", tmp_path / "none", *calibration, *out], "no such folder"),
        (
            ["reduce", tree, *out, "--quicklook", tmp_path / "q"],
            "q cannot be combined with --archive DIR",
        ),
        (
            ["correct", tree, *calibration, "-o", "a.fits", "--timeout", "1"],
            "1 needs --archive DIR",
        ),
    ):
        assert main(list(map(str, words))) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert lines[0].startswith("astropolcal: error: ")
        assert message in lines[0]


@pytest.mark.long
def test_a_worker_that_is_killed_loses_nothing(tmp_path):
    """Eight sequences: what a cluster gives is to the last bit what one process gives."""
    pytest.importorskip("distributed", reason="distributed is not installed")
    calibration = tmp_path / "charis.asdf"
    bench.write_sequences(tmp_path / "tree", bench.write_calibration(calibration), range(8))
    serial, _ = bench.correct(tmp_path / "tree", calibration, tmp_path / "one", "--workers", 1)
    with bench.LossyCluster(tmp_path / "two", [3]) as cluster:
        options = ("--cluster", cluster.address)
        parallel, _ = bench.correct(tmp_path / "tree", calibration, tmp_path / "two", *options)
    assert len(cluster.killed) == 1
    assert serial["n_done"] == parallel["n_done"] == 8
    assert len(list((tmp_path / "two").glob("*.fits"))) == 8
    assert bench.differing(tmp_path / "one", tmp_path / "two") == []
