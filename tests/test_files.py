# Licensed under a 3-clause BSD style license - see LICENSE
"""Files appear complete or not at all, and what is read may be anything."""

import contextlib
import datetime
import errno
import json
import os
import socket
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
import yaml
from astropy.time import Time
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal.exceptions import AstropolcalError, CalibrationFileError, ObservationError
from astropolcal.files import (
    append_line,
    atomic_path,
    check_new,
    check_yaml,
    one_line,
    plain,
    printable,
    understood,
)


def test_the_file_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "out.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_keeps_the_old_file_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")

    def write_half():
        with atomic_path(path) as temporary:
            temporary.write_text("ha")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_half()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_writes_nothing_is_an_error(tmp_path):
    with pytest.raises(AstropolcalError, match="cannot be written"), atomic_path(tmp_path / "x"):
        pass
    assert list(tmp_path.iterdir()) == []


# ---- names and leftovers ---------------------------------------------------------------


def test_the_temporary_file_is_hidden_and_of_the_same_kind(tmp_path):
    """Astropy and others choose a format by the suffix."""
    with atomic_path(tmp_path / "night.fits.gz") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.name.startswith(".night")
        assert temporary.suffix == ".gz"
        assert not temporary.exists()
        temporary.write_text("x")


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    path = tmp_path / "note.txt"
    with atomic_path(path) as first, atomic_path(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    # the one that ends last has the name
    assert path.read_text() == "first"
    assert [other.name for other in tmp_path.iterdir()] == ["note.txt"]


def test_what_killed_runs_left_goes_after_a_day(tmp_path):
    """Only remains of the same file: nothing else in a folder is ours to remove."""
    for name, age, goes in [
        (".note.123-0123abcd.tmp.txt", 25, True),
        (".note.123.tmp.txt", 25, True),
        (".note.123-0123abcd.tmp.txt", 23, False),
        (".note.123-0123abcd.tmp.csv", 25, False),
        (".other.123-0123abcd.tmp.txt", 25, False),
        (".note.abc.tmp.txt", 25, False),
        (".note.123-0123ABCD.tmp.txt", 25, False),
        ("note.txt.bak", 25, False),
    ]:
        other = tmp_path / name
        other.write_text("left")
        then = time.time() - age * 3600
        os.utime(other, (then, then))
        with atomic_path(tmp_path / "note.txt") as temporary:
            temporary.write_text("x")
        assert other.exists() is not goes, (name, age, goes)
    # of a file without a suffix too
    other = tmp_path / ".note.7-0123abcd.tmp"
    other.write_text("left")
    os.utime(other, (0, 0))
    with atomic_path(tmp_path / "note") as temporary:
        temporary.write_text("x")
    assert (tmp_path / "note").exists()
    assert not other.exists()


def test_refusals_say_what_to_do(tmp_path):
    for number, words in [
        (errno.ENOSPC, "No space left on device; free some space or name another folder"),
        (errno.EROFS, "Read-only file system; name a folder that you may write to"),
        (errno.EIO, "Input/output error"),
        (None, "out of luck"),
    ]:
        path = tmp_path / "note.txt"
        with pytest.raises(AstropolcalError) as caught, atomic_path(path):
            raise OSError("out of luck") if number is None else OSError(number, os.strerror(number))
        assert str(caught.value) == f"{path}: cannot be written: {words}", (number, words)


# ---- what is there already -------------------------------------------------------------


def write(path, text):
    """Write a file; return what was under the temporary name at first, and its permissions."""
    with atomic_path(path) as temporary:
        there = temporary.exists()
        mode = temporary.stat().st_mode & 0o777 if there else None
        temporary.write_text(text)
    return there, mode


def test_a_file_that_is_replaced_keeps_its_permissions(tmp_path):
    path = tmp_path / "note.txt"
    old = os.umask(0o027)
    try:
        # a new one has those that any new file has
        assert write(path, "first") == (False, None)
        assert path.stat().st_mode & 0o777 == 0o640
        for mode in (0o600, 0o644, 0o664, 0o444):
            path.chmod(mode)
            # not even for a moment may others read what is private
            assert write(path, f"{mode:o}") == (True, 0o600)
            assert path.stat().st_mode & 0o777 == mode
            assert path.read_text() == f"{mode:o}"
    finally:
        os.umask(old)
    assert [other.name for other in tmp_path.iterdir()] == ["note.txt"]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give files away")
def test_a_file_that_is_replaced_keeps_its_owner(tmp_path):
    path = tmp_path / "note.txt"
    path.write_text("old")
    os.chown(path, 1234, 1235)
    write(path, "new")
    state = path.stat()
    assert (state.st_uid, state.st_gid, path.read_text()) == (1234, 1235, "new")


def test_a_link_stays_a_link(tmp_path):
    folder = tmp_path / "far"
    folder.mkdir()
    (folder / "old.txt").write_text("old")
    (tmp_path / "old.txt").symlink_to("far/old.txt")
    (tmp_path / "chain.txt").symlink_to("old.txt")
    (tmp_path / "dangling.txt").symlink_to("far/new.txt")
    (tmp_path / "nowhere.txt").symlink_to("no/new.txt")
    (tmp_path / "loop.txt").symlink_to("loop.txt")
    for name, target in (("old", "old"), ("chain", "old"), ("dangling", "new")):
        write(tmp_path / f"{name}.txt", name)
        assert (tmp_path / f"{name}.txt").is_symlink()
        assert (folder / f"{target}.txt").read_text() == name
    assert sorted(path.name for path in folder.iterdir()) == ["new.txt", "old.txt"]
    for name, words in (("nowhere", "there is no folder .*no$"), ("loop", "symbolic links")):
        with pytest.raises(AstropolcalError, match=words):
            write(tmp_path / f"{name}.txt", "x")
        assert (tmp_path / f"{name}.txt").is_symlink()
    # each name of a file that has several is a file of its own
    os.link(folder / "old.txt", folder / "hard.txt")
    write(folder / "hard.txt", "hard")
    assert (folder / "old.txt").read_text() == "chain"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_pipe_stays_a_pipe(tmp_path):
    path, got = tmp_path / "pipe.txt", []
    os.mkfifo(path)
    reader = threading.Thread(target=lambda: got.append(path.read_text()), daemon=True)
    reader.start()
    write(path, "all of it" * 20_000)
    reader.join(10)
    assert got == ["all of it" * 20_000]
    assert path.is_fifo()
    assert [other.name for other in tmp_path.iterdir()] == ["pipe.txt"]


def test_a_device_stays_a_device(tmp_path):
    """Of our own: a failure must not take those of the system away."""
    for name, number in (("null", 3), ("full", 7)):
        try:
            os.mknod(tmp_path / name, 0o666 | stat.S_IFCHR, os.makedev(1, number))
            os.close(os.open(tmp_path / name, os.O_WRONLY))
        except OSError:
            pytest.skip("no devices can be made here")
    write(tmp_path / "null", "x")
    with pytest.raises(AstropolcalError, match="full: cannot be written: No space left"):
        write(tmp_path / "full", "x")
    assert all(other.is_char_device() for other in tmp_path.iterdir())


@pytest.mark.skipif(not os.path.exists("/proc/self/fd"), reason="no links to open files")
def test_the_standard_output_gets_both_what_is_written_and_what_is_printed(tmp_path):
    """As a pipe, and as a file that the shell has opened, by either of its names."""
    code = (
        "import sys; from astropolcal.files import atomic_path\nprint('before')\n"
        "with atomic_path(sys.argv[1]) as t:\n    t.write_text('written\\n')\nprint('after')"
    )
    out, link = tmp_path / "out.txt", tmp_path / "stdout"
    link.symlink_to("/proc/self/fd/1")
    for name in (link, out):
        with open(out, "wb") as stream:
            subprocess.run([sys.executable, "-c", code, name], stdout=stream, check=True)
        assert out.read_text() == "before\nwritten\nafter\n"
    done = subprocess.run([sys.executable, "-c", code, link], capture_output=True)
    assert done.stdout == b"before\nwritten\nafter\n"
    assert link.is_symlink()


def test_names_as_long_as_the_system_takes(tmp_path):
    for name in ["é" * 120 + ".txt", "💥" * 63, "a." + "b" * 253, "x" * 255]:
        path = tmp_path / name
        for text in ("first", "second"):
            write(path, text)
            assert path.read_text() == text, name
        assert list(tmp_path.iterdir()) == [path], name
        path.unlink()


def test_names_that_no_system_takes(tmp_path):
    for name in ("n" * 256, "é" * 128):
        with pytest.raises(AstropolcalError, match=f"{name}: cannot be written: File name too"):
            write(tmp_path / name, "x")
        assert check_new(tmp_path / name) == tmp_path / name
        with (
            pytest.raises(ObservationError, match=f"{name}: cannot be read: File name too long"),
            understood(name, ObservationError, "no journal"),
        ):
            open(name)


def test_lines_are_appended_as_a_whole(tmp_path, monkeypatch):
    path = tmp_path / "run.jsonl"
    write_some, room = os.write, [10]

    def small_disk(number, content):
        part = min(len(content), room[0])
        if not part:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        room[0] -= part
        return write_some(number, content[:part])

    monkeypatch.setattr(os, "write", small_disk)
    with pytest.raises(ObservationError, match=r"run\.jsonl: cannot be written: No space left"):
        append_line(path, "more than there is room for", ObservationError)
    assert not path.exists()
    room[0] = 10
    append_line(path, "{}")
    with pytest.raises(ObservationError, match="free some space"):
        append_line(path, "too much again", ObservationError)
    assert path.read_text() == "{}\n"
    with pytest.raises(ObservationError, match="there is no folder"):
        append_line(tmp_path / "no" / "x", "", ObservationError)


# ---- a new file ------------------------------------------------------------------------


def test_a_file_that_cannot_be_new(tmp_path):
    for name, overwrite, words in [
        ("there.txt", False, "exists already; remove it, name another"),
        (".", True, "is a folder; name a file in it"),
        ("nowhere/new.txt", True, "cannot be written: there is no folder"),
    ]:
        (tmp_path / "there.txt").write_text("x")
        with pytest.raises(CalibrationFileError, match=words) as caught:
            check_new(tmp_path / name, overwrite, CalibrationFileError)
        assert str(caught.value).startswith(str(tmp_path / name)), (name, overwrite, words)


def test_a_file_that_the_content_comes_from(tmp_path):
    for name in ("there.txt", "other.txt"):
        (tmp_path / name).write_text("x")
    (tmp_path / "link.txt").symlink_to("there.txt")
    sources = [tmp_path / "there.txt", tmp_path / "no.txt", "a\0b"]
    with pytest.raises(ObservationError, match="was made from this file"):
        check_new(tmp_path / "link.txt", True, ObservationError, sources)
    assert check_new(tmp_path / "other.txt", True, sources=sources) == tmp_path / "other.txt"


def test_a_file_that_can(tmp_path):
    for name, overwrite in [("there.txt", True), ("new.txt", False)]:
        (tmp_path / "there.txt").write_text("x")
        assert check_new(str(tmp_path / name), overwrite) == tmp_path / name, (name, overwrite)


# ---- the door of readers ---------------------------------------------------------------


def test_whatever_goes_wrong_is_one_line():
    for problem, words in [
        (FileNotFoundError(2, "No such file or directory"), "no such file"),
        (IsADirectoryError(21, "Is a directory"), "is a folder, not a file"),
        (PermissionError(13, "Permission denied"), "cannot be read: Permission denied"),
        (PermissionError("locked"), "cannot be read: locked"),
        (OSError(5, "Input/output error"), "no journal: [Errno 5] Input/output error"),
        (ValueError("not\n a number"), "no journal: not a number"),
        (KeyError("frame"), "no journal: KeyError: 'frame'"),
        (RecursionError(), "no journal: RecursionError"),
        (UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"), "no journal: 'utf-8' codec can't"),
    ]:
        with (
            pytest.raises(ObservationError) as caught,
            understood("a.json", ObservationError, "no journal"),
        ):
            raise problem
        assert str(caught.value).startswith(f"a.json: {words}"), (problem, words)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_what_may_have_no_end_is_not_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as ears:
        with contextlib.chdir(tmp_path):
            ears.bind("socket")
        for path, kind in (
            (tmp_path / "pipe", "a pipe"),
            (tmp_path / "socket", "a socket"),
            ("/dev/zero", "a device"),
        ):
            with (
                pytest.raises(ObservationError, match=f"{path}: is {kind}; a regular file"),
                understood(path, ObservationError, "no journal"),
            ):
                pytest.fail("was opened")


def test_errors_of_ours_and_interrupts_pass():
    with pytest.raises(CalibrationFileError, match=r"^as it is$"):
        with understood("a.json", ObservationError, "no journal"):
            raise CalibrationFileError("as it is")
    for kind in (KeyboardInterrupt, SystemExit):
        with pytest.raises(kind), understood("a.json", ObservationError, "no journal"):
            raise kind


def test_the_cause_is_kept_where_it_may_be_needed():
    with pytest.raises(ObservationError) as caught, understood("a", ObservationError, "no journal"):
        {}["frame"]
    assert isinstance(caught.value.__cause__, KeyError)


def test_one_line():
    for said, longest, line in [
        ("  two\n\n words\t", 240, "two words"),
        (ValueError(""), 240, "ValueError"),
        (TypeError("of no\nuse"), 240, "TypeError: of no use"),
        (OSError(2, "gone"), 240, "[Errno 2] gone"),
        (7, 240, "7"),
        ("\x1b[31mred\x07 \u202e", 240, "?[31mred? ?"),
        ("é 💥", 240, "é 💥"),
        ("abcdef", 6, "abcdef"),
        ("abcdefg", 6, "abcdef..."),
        ("a\nb", None, "a b"),
        ("", 240, ""),
    ]:
        assert one_line(said, longest) == line, (said, longest, line)


def test_lines_stay_and_what_moves_the_cursor_does_not():
    assert printable("é 💥\n\n b\r\x1b[2J\x07\u202e\udc80\n") == "é 💥\n\n b??[2J???\n"


# ---- YAML ------------------------------------------------------------------------------


def laughs(levels, width=9):
    """Return lists of which each holds the one before it several times."""
    lines = ["a0: &a0 [x]"]
    for i in range(levels):
        lines.append(f"a{i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * width)}]")
    return "\n".join(lines)


def test_yaml_that_must_not_be_loaded():
    for text, words in [
        ("&a [*a]", "refers to itself"),
        ("a: &a\n  b: {c: *a}", "refers to itself"),
        ("- &a [x]\n- &a [*a]", "refers to itself"),
        ("- *unknown", "undefined alias|refers to itself"),
        ("[" * 64 + "]" * 64, "nested deeper than the 64 levels"),
        ("{a: " * 64 + "1" + "}" * 64, "nested deeper than the 64 levels"),
        (laughs(6), "repeats itself so often"),
        ("a: &a {x: 1}\nb: {<<: *a}", "merge keys"),
        ("a: &a {x: 1}\nb: {!!merge <<: *a}", "merge keys"),
        ("a: &a {x: 1}\nb: {? !<tag:yaml.org,2002:merge> z : *a}", "merge keys"),
    ]:
        with pytest.raises(AstropolcalError, match=words):
            check_yaml(text)


def test_yaml_that_may_be_loaded():
    for text in [
        "",
        "[" * 62 + "]" * 62,
        "a: &a [1, 2]\nb: *a\nc: *a",
        "a: '<<'",
        # the second &a is of another list: what it was before does not count any more
        "- &a [x]\n- *a\n- &a [y]\n- *a",
        laughs(3),
        "--- {a: 1}\n...\n--- {b: 2}\n",
        "\n".join(f"- {i}" for i in range(3000)),
    ]:
        check_yaml(text)
        check_yaml(text.encode())


def test_what_is_no_yaml():
    with pytest.raises(yaml.YAMLError):
        check_yaml("a: [1")


@settings(max_examples=50, deadline=None)
@given(st.recursive(st.integers(), lambda x: st.lists(x, max_size=4), max_leaves=30))
def test_what_was_written_from_a_tree_is_allowed(tree):
    check_yaml(yaml.safe_dump(tree))


def test_immense_yaml_is_refused_before_it_takes_time():
    """Nothing is loaded: of forty levels the last would hold 9 ** 40 words."""
    start = time.process_time()
    with pytest.raises(AstropolcalError, match="repeats itself"):
        check_yaml(laughs(40))
    assert time.process_time() - start < 1


# --- for machines ---------------------------------------------------------------------------------


def test_what_json_knows():
    for value, expected in [
        (np.float64(1.5), 1.5),
        (np.int32(3), 3),
        (np.bool_(True), True),
        (np.nan, None),
        (np.inf, None),
        (np.array([[1.0, np.nan]]), [[1.0, None]]),
        ((1, "a", None), [1, "a", None]),
        (2 * u.deg, {"value": 2.0, "unit": "deg"}),
        ([1, np.nan] * u.mm, {"value": [1.0, None], "unit": "mm"}),
        ({"a": {1: np.array([1])}}, {"a": {"1": [1]}}),
        (u.mm, "mm"),
        (Path("x\ny"), "x y"),
        (Time("2025-10-02T03:04:05"), "2025-10-02T03:04:05.000"),
        (datetime.date(2025, 10, 2), "2025-10-02"),
    ]:
        found = plain(value)
        assert found == expected
        assert json.loads(json.dumps(found, allow_nan=False)) == expected


def test_what_json_cannot_hold_is_named():
    for value in [{1, 2}, object(), len, b"bytes", 1j]:
        name = type(value).__name__
        with pytest.raises(AstropolcalError, match=rf"report\.lamps\[1\] is a {name}, which"):
            plain({"lamps": [1, value]}, "report")
