# Licensed under a 3-clause BSD style license - see LICENSE
"""Full disks, killed processes, unwritable folders, and several writers at once."""

import errno
import gc
import json
import multiprocessing
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
from contextlib import contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import walk_packages

import astropy.units as u
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import astropolcal
from astropolcal import Calibration, Observations
from astropolcal.calibration.posterior.checkpoint import Chain
from astropolcal.exceptions import AstropolcalError, CalibrationFileError, FitError, GapError
from astropolcal.files import atomic_path
from astropolcal.gap.challenge import _append, _journal
from astropolcal.pipeline import Library, load, mueller_table, write_mueller
from astropolcal.reduction.frames import Frame
from astropolcal.reduction.run import Journal
from astropolcal.scripts._common import write_json
from tests.fuzz.readers import READERS, Checkpoint, calibration, lab

RECORD = {"kind": "none", "verdict": "none", "result": "right", "snr": 0.0}
RECORD |= {"faults": [], "causes": [], "claims": []}
FORK = multiprocessing.get_context("fork")
needs_h5py = pytest.mark.skipif(find_spec("h5py") is None, reason="h5py is not installed")


def product():
    """Return a Stokes product that was read back."""
    import tempfile

    reader = READERS["product"]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.fits"
        path.write_bytes(reader.seeds()["image"])
        return reader.read(path)


def mueller():
    positions = {name: [10.0, 20.0] * u.deg for name in ("hwp", "derotator")}
    return mueller_table(load(calibration()), positions=positions, light="internal")


WRITERS = {
    "calibration": (".asdf", lambda: calibration().write),
    "observations": (".ecsv", lambda: lab()[1].write),
    "product": (".fits", lambda: product().write),
    "mueller_ecsv": (".ecsv", lambda: lambda p, overwrite: write_mueller(mueller(), p, overwrite)),
    "mueller_fits": (".fits", lambda: lambda p, overwrite: write_mueller(mueller(), p, overwrite)),
    "json": (".json", lambda: lambda p, overwrite: write_json({"a": [1.5] * 3000}, p)),
}


@pytest.fixture(scope="module")
def writers():
    """Suffixes, and functions that write a file of more than 4 kB, by what they write."""
    return {what: (suffix, make()) for what, (suffix, make) in WRITERS.items()}


@contextmanager
def files_up_to(size):
    """Let no file grow beyond a size, as on a disk that is full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old)


def assert_says(caught, path, *words):
    text = str(caught.value)
    assert str(path) in text
    assert "\n" not in text
    for word in words:
        assert word in text


# ---- full disk ---------------------------------------------------------------------


def test_full_disk_keeps_the_old_file(writers, tmp_path):
    for what, (suffix, write) in writers.items():
        path = tmp_path / f"out{suffix}"
        for size in [0, 1, 3000]:
            path.write_bytes(b"what was there")
            with (
                files_up_to(size),
                pytest.raises(AstropolcalError, match="cannot be written") as caught,
            ):
                write(path, overwrite=True)
            assert_says(caught, path)
            assert path.read_bytes() == b"what was there", (what, size)
            assert list(tmp_path.iterdir()) == [path], (what, size)
            write(path, overwrite=True)
            assert path.stat().st_size > 4000, (what, size)
        path.unlink()


def test_disk_that_is_full_when_it_is_synced(tmp_path, monkeypatch):
    path = tmp_path / "cal.asdf"
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EIO):

        def refuse(stream, number=number):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", refuse)
        with pytest.raises(CalibrationFileError, match=os.strerror(number)) as caught:
            calibration().write(path)
        advice = () if number == errno.EIO else ("free some space",)
        assert_says(caught, path, *advice)
        assert list(tmp_path.iterdir()) == [], number


def no_room(*arguments):
    raise OSError(errno.ENOSPC, "No space left on device")


@needs_h5py
def test_full_disk_while_a_checkpoint_is_made(tmp_path):
    path = tmp_path / "chain.h5"
    for name in ("write", "fsync"):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, name, no_room)
            with pytest.raises(FitError, match="cannot be written") as caught:
                Checkpoint()._run(path, 4)
        assert_says(caught, path, "free some space")
        assert list(tmp_path.iterdir()) == [], name


@needs_h5py
def test_checkpoint_has_the_room_it_needs_from_the_start(tmp_path):
    path = tmp_path / "chain.h5"
    Checkpoint()._run(path, 1)
    state = path.stat()
    assert 512 * state.st_blocks >= state.st_size


@needs_h5py
def test_making_a_checkpoint_takes_no_memory_for_its_steps(tmp_path):
    chain, reader = Chain((2000, 8, 2), 50), Checkpoint()
    tracemalloc.start()
    try:
        with chain.open(tmp_path / "chain.h5", reader.description, reader.arrays, True):
            peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < chain._steps.nbytes / 4


@needs_h5py
def test_failed_write_of_a_checkpoint_loses_one_interval(tmp_path, monkeypatch):
    path, sync, calls = tmp_path / "chain.h5", os.fsync, []

    def full(number):
        calls.append(number)
        # the first two make the file
        if len(calls) > 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(number)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FitError, match="2 steps are safe") as caught:
        Checkpoint()._run(path, 8)
    assert_says(caught, path, "No space left")
    monkeypatch.setattr(os, "fsync", sync)
    reader = Checkpoint()
    reader.check(reader.read(path), path)


@needs_h5py
def test_write_that_fails_once_spoils_no_checkpoint(tmp_path, monkeypatch):
    path, sync, calls = tmp_path / "chain.h5", os.fsync, []

    def flaky(number):
        calls.append(number)
        if len(calls) == 4:
            raise OSError(errno.EIO, "Input/output error")
        sync(number)

    # the steps that were not written go out when the file is closed
    monkeypatch.setattr(os, "fsync", flaky)
    with pytest.raises(FitError, match="Input/output error"):
        Checkpoint()._run(path, 8)
    reader = Checkpoint()
    reader.check(reader.read(path), path)


@needs_h5py
def test_limit_below_the_size_of_a_checkpoint(tmp_path):
    """HDF5 could not close such a file, and would take the process with it in the end."""
    path, reader = tmp_path / "chain.h5", Checkpoint()
    for size in (0, 100, 3000):
        with files_up_to(size), pytest.raises(FitError, match="cannot be written"):
            reader._run(path, 2)
        assert list(tmp_path.iterdir()) == []
    reader._run(path, 2)
    for size in (0, 100):
        with files_up_to(size), pytest.raises(FitError, match="its first 2 steps are safe"):
            reader._run(path, 8)
    reader.check(reader.read(path), path)


def test_full_disk_while_a_challenge_is_appended(tmp_path):
    path, settings = tmp_path / "run.jsonl", {"seed": 1}
    _journal(path, settings)
    _append(path, {"index": 0} | RECORD)
    size = path.stat().st_size
    with files_up_to(size + 10), pytest.raises(GapError, match="cannot be written") as caught:
        _append(path, {"index": 1, "words": "x" * 4000} | RECORD)
    assert_says(caught, path)
    assert list(_journal(path, settings)) == [0]
    _append(path, {"index": 1} | RECORD)
    assert list(_journal(path, settings)) == [0, 1]


# ---- folders -----------------------------------------------------------------------


def test_folder_that_is_not_there(writers, tmp_path):
    for suffix, write in writers.values():
        path = tmp_path / "no" / f"out{suffix}"
        with pytest.raises(AstropolcalError, match="no folder") as caught:
            write(path, overwrite=True)
        assert_says(caught, path)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="no folder /proc")
def test_folder_in_which_nobody_can_write():
    path = Path("/proc/self/out.asdf")
    with pytest.raises(CalibrationFileError, match="cannot be written") as caught:
        calibration().write(path)
    assert_says(caught, path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write all")
def test_folder_without_permission(writers, tmp_path):
    tmp_path.chmod(0o500)
    for suffix, write in writers.values():
        with pytest.raises(AstropolcalError, match="name a folder that you may write to"):
            write(tmp_path / f"out{suffix}", overwrite=True)
    tmp_path.chmod(0o700)


def test_what_is_no_name_of_a_file():
    for name in ["", ".", "a\0b"]:
        with pytest.raises(AstropolcalError, match="not the name of a file"), atomic_path(name):
            pass


# ---- commands that cannot write, as processes of their own -----------------------------

OLD = "what was there"
STAR = "--source star --hwp 0,45,22.5,67.5 --derotator 60 --altitude 70 --parallactic 20"
# what a command says where a disk is full, files may have 100 bytes, a folder is locked
REASONS = {
    "full": "cannot be written: No space left on device",
    "limited": "cannot be written: File too large",
    "locked": "no permission to write to",
}
CORRECT = "correct cubes --raw cubes/raw --calibration cal.asdf --size 5 --optics-in nbs"
# calls of each command, and its outputs: {old} exists, {new} does not, {spare} can be written
COMMANDS = {
    "calibrate few.ecsv --derotator linear": ["-o {old}.asdf", "--json {old}", "--plots {folder}"],
    "sample few.asdf few.ecsv --parameters hwp.w_sio2 --walkers 4 --steps 20": [
        "-o {old}.asdf",
        "--json {old}",
        "--checkpoint {new}",
    ],
    "diagnose few.ecsv --effects beam_gain --derotator linear": [
        "--report {old}.html",
        "--save {old}.asdf",
        "--json {old}",
    ],
    f"{CORRECT} --any-date": [
        "-o {old}.fits",
        "-o {spare}.fits --spectrum {old}.ecsv",
        "-o {spare}.fits --plot {old}.png",
        "-o {spare}.fits --json {old}",
    ],
    "reduce cubes --raw cubes/raw --source star": [
        "-o {old}.ecsv",
        "-o {spare}.ecsv --resume {new}",
        "-o {spare}.ecsv --quicklook {folder}",
        "-o {spare}.ecsv --json {old}",
    ],
    "simulate --derotator 45 --hwp 0,45": [
        "-o {old}.ecsv",
        "--cubes {folder}",
        "-o {spare}.ecsv --json {old}",
    ],
    "challenge -n 1 --kinds none --wavelengths 5 --derotator-angles 3": [
        "--checkpoint {new}",
        "--reliability {old}.png",
        "--json {old}",
    ],
    "efficiency": ["-o {old}.png", "--json {old}"],
    "standards": ["--json {old}"],
    "info few.ecsv": ["--json {old}"],
}


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with what the commands read."""
    from astropolcal import calibrate, instruments
    from astropolcal.scripts.main import main
    from astropolcal.simulation import half_wave_plate_cycles, simulate

    folder, charis = tmp_path_factory.mktemp("desk"), instruments.get("charis")
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    meta = charis.published_meta() | {"yjh50_dichroic": "out"}
    for name, rows in (("few", [9, 12, 16]), ("cal", slice(None))):
        wavelength = charis.wavelength[rows]
        chain = charis.chain("polarized", ["nbs"], derotator="linear", wavelength=wavelength)
        data = simulate(chain, wavelength, frames, seed=5, meta=meta, name=name)
        data.write(folder / f"{name}.ecsv")
        calibrate(chain, data, instrument="charis").write(folder / f"{name}.asdf")
    cubes = f"simulate -q --cubes {folder / 'cubes'} {STAR} --flux 2e6 --without dichroic"
    assert main(cubes.split()) == 0
    return folder


def contents(folder):
    return {path.name: path.read_bytes()[:100] for path in folder.rglob("*") if path.is_file()}


@contextmanager
def spoiled(kind, folder, old):
    """Let an old file be in a folder that has no room for another, or cannot be written to."""
    folder.mkdir()
    mount = {"full": "-t tmpfs -o size=8k tmpfs", "locked": f"--bind {folder}"}.get(kind)
    if mount:
        subprocess.run(["mount", *mount.split(), folder], check=True)
    if old:
        (folder / old).write_text(OLD)
    if kind == "full":
        with suppress(OSError), open(folder / "rest", "wb", buffering=0) as stream:
            while stream.write(b"x" * 512):
                pass
    if kind == "locked":
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
    owner = os.getpid()
    try:
        yield
    finally:
        # not by a process that was forked meanwhile and comes to its end
        if os.getpid() == owner:
            if mount:
                subprocess.run(["umount", folder], check=True)
            shutil.rmtree(folder)


def forked(kind, words):
    """Run a command in a process that ends like any other; return its status and complaint."""
    from astropolcal.scripts.main import main

    read, write = os.pipe()
    number = os.fork()
    if not number:
        os.dup2(write, 2)
        if kind == "limited":
            hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
            resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
        raise SystemExit(main(words))
    os.close(write)
    with open(read) as stream:
        complaint = stream.read()
    return os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]), complaint


def serve(desk, *kinds):
    """Run all commands, where mounts are nobody else's; print how each of them ended."""
    from astropolcal.scripts.main import main

    os.chdir(desk)
    # loaded once, for all processes
    ours = [name for _, name, _ in walk_packages(astropolcal.__path__, "astropolcal.")]
    for name in [*ours, "arviz_stats.base", "emcee", "h5py", "jinja2", "photutils.detection"]:
        with suppress(ImportError):
            import_module(name)
    main("calibrate few.ecsv -q --derotator linear -o spare.asdf --plots spare".split())
    # else each of them looks at all objects once more when it ends
    gc.freeze()
    print(json.dumps([[kind, *ended] for kind in kinds for ended in ends(kind, Path("place"))]))


def ends(kind, folder):
    """Yield words, status and complaint of each command, and whether the folder is as before."""
    names = {"old": folder / "old", "new": folder / "new", "folder": folder, "spare": "spare"}
    for command, options in COMMANDS.items():
        # everything where the disk is full; else the first output, as all are written in one way
        for option in options if kind == "full" else options[:1]:
            old = re.search(r"\{(old)\}(\.\w+)?", option)
            with spoiled(kind, folder, old and f"old{old[2] or ''}"):
                before, words = contents(folder), f"{command} -q {option.format(**names)}"
                yield words, *forked(kind, shlex.split(words)), contents(folder) == before


@pytest.fixture(scope="module")
def ended(desk):
    """How the commands ended, by what the system did not let them do."""
    space, kinds = ["unshare", "-m" if os.geteuid() == 0 else "-rm"], list(REASONS)
    trial = [*space, "mount", "-t", "tmpfs", "tmpfs", desk]
    if not shutil.which("unshare") or subprocess.run(trial, capture_output=True).returncode:
        space, kinds = [], ["limited"]
    serving = [*space, sys.executable, __file__, desk, *kinds]
    done = subprocess.run(serving, capture_output=True, text=True, timeout=500)
    assert not done.returncode, done.stderr
    return {
        kind: [how for other, *how in json.loads(done.stdout) if other == kind] for kind in kinds
    }


@pytest.mark.long
def test_commands_that_cannot_write(ended):
    for kind, commands in ended.items():
        for words, status, complaint, is_same in commands:
            if words.startswith("sample") and not (find_spec("emcee") and find_spec("h5py")):
                continue
            lines = [
                x for x in complaint.splitlines() if not x.startswith("astropolcal: warning: ")
            ]
            assert (status, len(lines)) == (2, 1), (kind, words, complaint)
            assert lines[0].startswith("astropolcal: error: "), (kind, words, lines)
            assert REASONS[kind] in lines[0], (kind, words, lines)
            assert is_same, (kind, words)
    if set(ended) != set(REASONS):
        pytest.skip("this system lets nobody mount file systems of his own")


def test_standard_output_on_a_full_disk():
    command = [sys.executable, "-m", "astropolcal.scripts.main", "info", "--instruments"]
    with open("/dev/full", "wb") as stream:
        done = subprocess.run(command, stdout=stream, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr == (
        "astropolcal: error: the standard output: cannot be written: No space left on device\n"
    )


# ---- killed processes --------------------------------------------------------------


def killed(task, *arguments, after, written=None):
    """Run an endless function in a process that is killed some time after a file has content."""
    process = FORK.Process(target=task, args=arguments)
    process.start()
    while written and process.is_alive() and not (written.exists() and written.stat().st_size):
        time.sleep(0.001)
    time.sleep(after)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL


def write_for_ever(path):
    content = [b"a" * 300_000, b"b" * 300_000]
    for i in range(10**9):
        with atomic_path(path) as temporary, open(temporary, "wb") as stream:
            for start in range(0, 300_000, 3000):
                stream.write(content[i % 2][start : start + 3000])


@pytest.mark.slow
def test_killed_writer_leaves_a_whole_file(tmp_path):
    path = tmp_path / "out.bin"
    path.write_bytes(b"a" * 300_000)
    rng = np.random.default_rng(4)
    for _ in range(12):
        killed(write_for_ever, path, after=rng.uniform(0.02, 0.12))
        assert path.read_bytes() in (b"a" * 300_000, b"b" * 300_000)
    left = [p for p in tmp_path.iterdir() if p != path]
    # hidden, so that no search for files of a kind finds them
    assert all(p.name.startswith(".out.") for p in left)
    for p in left:
        os.utime(p, (0, 0))
    other = tmp_path / ".out.bin.backup"
    other.touch()
    os.utime(other, (0, 0))
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"new")
    assert path.read_bytes() == b"new"
    assert sorted(tmp_path.iterdir()) == sorted([path, other])


def test_remains_of_a_process_of_the_same_number_do_not_disturb(writers, tmp_path):
    for what, (suffix, write) in writers.items():
        (tmp_path / what).mkdir()
        (tmp_path / what / f".out.{os.getpid()}.tmp{suffix}").write_bytes(b"remains")
        write(tmp_path / what / f"out{suffix}", overwrite=False)
        assert (tmp_path / what / f"out{suffix}").stat().st_size > 4000, what


def write_calibrations(path):
    cal = calibration()  # made before the fork: each of its own would have another date
    while True:
        cal.write(path, overwrite=True)


@pytest.mark.slow
def test_killed_calibrate_leaves_a_calibration_or_nothing(tmp_path):
    path, digest, _ = tmp_path / "cal.asdf", None, calibration()
    rng = np.random.default_rng(5)
    for _ in range(4):
        killed(write_calibrations, path, after=rng.uniform(0.1, 0.5))
        if path.exists():
            found = Calibration.read(path).to_dict()
            assert digest in (None, found)
            digest = found
    # whatever was left is no part of a library
    assert not Library(tmp_path).problems


def append_challenges(path):
    records = _journal(path, {"seed": 1})
    for i in range(len(records), 10**9):
        _append(path, {"index": i, "words": "x" * 500} | RECORD)


@pytest.mark.slow
def test_killed_challenges_go_on(tmp_path):
    path, before = tmp_path / "run.jsonl", 0
    rng = np.random.default_rng(6)
    for _ in range(8):
        killed(append_challenges, path, after=rng.uniform(0.0, 0.15), written=path)
        records = _journal(path, {"seed": 1})
        assert sorted(records) == list(range(len(records)))
        assert len(records) >= before
        before = len(records)
    assert before > 0


def add_frames(path, folder):
    journal = Journal(path, {})
    for i in range(10**9):
        journal.add(Frame(str(folder / f"{i % 5}.fits"), number=i, errors=["x" * 300]))
        (folder / "begun").write_text("yes")


@pytest.mark.slow
def test_killed_reduction_goes_on(tmp_path):
    for i in range(5):
        (tmp_path / f"{i}.fits").write_bytes(b"x")
    path, rng = tmp_path / "journal", np.random.default_rng(7)
    for _ in range(6):
        begun = tmp_path / "begun"
        begun.unlink(missing_ok=True)
        killed(add_frames, path, tmp_path, after=rng.uniform(0.0, 0.12), written=begun)
        assert Journal(path, {}).done(tmp_path / "0.fits").errors == ["x" * 300]
    # a line that was cut off in the middle costs one frame
    path.write_bytes(path.read_bytes()[:-100])
    journal = Journal(path, {})
    journal.add(Frame(str(tmp_path / "4.fits"), number=99))
    assert Journal(path, {}).done(tmp_path / "4.fits").number == 99


def sample_for_ever(path):
    reader = Checkpoint()
    type(reader).shape = (4000, 4, 2)
    while True:
        reader._run(path, 4000, resume=True)
        path.unlink()


@pytest.mark.slow
@needs_h5py
def test_killed_sampler_goes_on(tmp_path, monkeypatch):
    path, rng = tmp_path / "chain.h5", np.random.default_rng(8)
    monkeypatch.setattr(Checkpoint, "shape", (4000, 4, 2))
    for _ in range(6):
        killed(sample_for_ever, path, after=rng.uniform(0.05, 0.3))
        if path.exists():
            chain = Checkpoint()._run(path, 10)
            steps = np.arange(1.0, chain.count + 1)
            assert np.array_equal(chain.coords[: chain.count, 0, 0], steps)


# ---- several writers ---------------------------------------------------------------


def add_to_library(folder, number, same, out):
    library = Library(folder)
    try:
        for i in range(2):
            year = 2025 if same else 2001 + 2 * number + i
            library.add(
                calibration(), valid_from=f"{year}-01-01", valid_until=f"{year}-12-31T23:00:00"
            )
        out.put((number, ""))
    except Exception as error:
        out.put((number, repr(error)))


@pytest.mark.long
def test_several_processes_add_to_one_library(tmp_path):
    calibration()
    for same, n in ((False, 6), (True, 1)):
        folder, out = tmp_path / str(same), FORK.Queue()
        folder.mkdir()
        processes = [
            FORK.Process(target=add_to_library, args=(folder, i, same, out)) for i in range(3)
        ]
        for process in processes:
            process.start()
        told = [out.get(timeout=120) for _ in processes]
        for process in processes:
            process.join()
        assert [words for _, words in sorted(told)] == [""] * 3, same
        library = Library(folder)
        assert not library.problems, same
        assert not library.overlaps(), same
        assert len(library) == n, same
        left = {p.name for p in folder.iterdir()} - {e.name for e in library.entries}
        # there is an index if this took longer than two seconds
        assert left - {".astropolcal-index.json"} == {".lock"}, same


def add_for_ever(folder, first):
    for year in range(first, 10000):
        Library(folder).add(
            calibration(), valid_from=f"{year}-01-01", valid_until=f"{year}-12-31T23:00:00"
        )


@pytest.mark.long
def test_killed_writer_does_not_lock_a_library(tmp_path):
    calibration()
    rng = np.random.default_rng(9)
    for year in range(1991, 1997):
        killed(add_for_ever, tmp_path, 100 * (year - 1970), after=rng.uniform(0.05, 0.3))
        library = Library(tmp_path)
        library.add(calibration(), valid_from=f"{year}-01-01", valid_until=f"{year}-06-01")
        assert not library.problems, year
    assert len(library) >= 6


def write_tables(path, number):
    data = lab()[1]
    for _ in range(15):
        data.write(path, overwrite=True)


@pytest.mark.slow
def test_several_processes_write_one_file(tmp_path):
    path, digest = tmp_path / "night.ecsv", lab()[1].content_hash
    processes = [FORK.Process(target=write_tables, args=(path, i)) for i in range(3)]
    for process in processes:
        process.start()
    while any(process.is_alive() for process in processes):
        if path.exists():
            assert Observations.read(path).content_hash == digest
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert list(tmp_path.iterdir()) == [path]


if __name__ == "__main__":
    serve(*sys.argv[1:])
