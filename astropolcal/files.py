# Licensed under a 3-clause BSD style license - see LICENSE
"""
Files that appear complete or not at all, and files that are not trusted.

What is read may come from anywhere. Every reader stands in a door, ``understood``,
that lets through objects and errors of this package only; YAML is looked at by ``check_yaml``
before any of it is loaded.
"""

import datetime
import errno
import json
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import astropy
import astropy.units as u
import numpy as np
from astropy.time import Time

from astropolcal.exceptions import AstropolcalError

__all__ = []

# a file of ours is 12 levels deep; loaders call themselves at each and die at some thousands
_DEEPEST = 64
# how many times over links may repeat what is written, beyond some nodes that do no harm
_MOST_REPEATS, _FREE_NODES = 10, 10_000
_LONGEST_REASON = 240
# bytes of a name that the usual file systems take
_LONGEST_NAME = 255
_STALE_SECONDS = 24 * 3600
_ADVICE = {errno.EFBIG: "the file is larger than this system allows; name another folder"}
_ADVICE |= dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some space or name another folder")
_MAY_NOT = (errno.EACCES, errno.EPERM, errno.EROFS)
_ADVICE |= dict.fromkeys(_MAY_NOT, "name a folder that you may write to")
# what a line of JSON raises that was cut off, or is none of ours
_DAMAGE = (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
_BAD_NAMES = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.ELOOP)
_KINDS = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
_KINDS |= dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "a device")


def check_new(path, overwrite=False, error=AstropolcalError, sources=(), suffix=""):
    """Return the path of a file to write, before the work of writing it is done.

    It is not a folder, does not exist unless ``overwrite``, is none of the ``sources`` of the
    content, and has the ``suffix``, by which it is found again.
    """
    path = Path(path)
    # os.path answers where pathlib raises: the name may be one that no system takes
    if os.path.isdir(path):
        raise error(f"{path}: is a folder; name a file in it")
    if os.path.exists(path) and not overwrite:
        ways = "remove it, name another, or in Python overwrite=True replaces it"
        raise error(f"{path}: exists already; {ways}")
    if not os.path.isdir(path.parent):
        raise error(f"{path}: cannot be written: there is no folder {path.parent}")
    if suffix and path.suffix.lower() != suffix:
        raise error(f"{one_line(path)}: the name must end with {suffix}")
    for source in sources:
        same = False
        # one of them may not be there
        with suppress(OSError, ValueError):
            same = os.path.samefile(path, source)
        if same:
            raise error(f"{path}: what is to be written was made from this file; name another one")
    return path


@contextmanager
def atomic_path(path, error=AstropolcalError):
    """Give a temporary path that takes the place of ``path`` when the block ends well.

    It has the same suffix, and nobody else writes there. A file that exists keeps its permissions,
    and a link stays a link: what it points to is replaced. Pipes and devices, such as
    ``/dev/null``, stay what they are; the content is written to them. ``error`` is raised where
    the system refuses.
    """
    path = _named(path, error)
    try:
        with (_poured if _is_stream(path) else _replaced)(path) as temporary:
            yield temporary
    except OSError as problem:
        raise error(f"{path}: cannot be written: {_refusal(problem, path)}") from problem


def _named(path, error):
    path = Path(path)
    if not path.name or "\0" in str(path):
        raise error(f"{str(path)!r}: is not the name of a file")
    return path


@contextmanager
def _replaced(path):
    """Give a hidden path beside a file, or what a link to it points to, that takes its name."""
    path = Path(os.path.realpath(path))
    # by number of the process alone, one that was killed would stand in the way of another
    start, end = _hidden(path)
    temporary = path.with_name(f"{start}{os.getpid()}-{secrets.token_hex(4)}{end}")
    try:
        start, end = map(re.escape, _hidden(path))
        ours = re.compile(rf"{start}\d+(-[0-9a-f]{{8}})?{end}")
        limit = time.time() - _STALE_SECONDS
        with suppress(OSError):
            for other in os.scandir(path.parent):
                # somebody else may have removed it meanwhile
                with suppress(OSError):
                    if ours.fullmatch(other.name) and other.stat().st_mtime < limit:
                        os.unlink(other.path)
        old = os.stat(path) if path.exists() else None
        if old is not None:
            # what only some may read is not for all while it is written
            os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        yield temporary
        # else the name could reach the disk before the content
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        if old is not None:
            with suppress(AttributeError, OSError):
                os.chown(temporary, -1, old.st_gid)
                os.chown(temporary, old.st_uid, -1)
            with suppress(OSError):
                os.chmod(temporary, stat.S_IMODE(old.st_mode))
        # atomic within a file system, hence the temporary file beside the final one
        os.replace(temporary, path)
        with suppress(OSError):
            number = os.open(path.parent, os.O_RDONLY)
            try:
                os.fsync(number)
            finally:
                os.close(number)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def _poured(path):
    """Give a path elsewhere, whose content goes to a pipe or a device."""
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / path.name
        yield temporary
        number = _standard_stream(path)
        with (
            open(temporary, "rb") as source,
            open(path if number is None else os.dup(number), "wb") as target,
        ):
            shutil.copyfileobj(source, target)


def _is_stream(path):
    """Return whether a file is not a regular one, or is where our own words go."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return False
    return stat.S_IFMT(mode) in _KINDS or _standard_stream(path) is not None


def _standard_stream(path):
    """Return the number of the standard output or error, if a path leads there."""
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        # closed, or never open
        with suppress(OSError, AttributeError, ValueError):
            if os.path.samestat(os.stat(path), os.fstat(number)):
                stream.flush()
                return number
    return None


def append_line(path, line, error=AstropolcalError):
    """Append a line to a file, which is on the disk then; all of it or nothing.

    A last line that was cut off, as its writer was killed, is ended first.
    """
    path = _named(path, error)
    try:
        is_new = not os.path.exists(path)
        with open(path, "a+b", buffering=0) as stream:
            size = stream.seek(0, os.SEEK_END)
            if size:
                stream.seek(-1, os.SEEK_END)
                line = line if stream.read(1) == b"\n" else f"\n{line}"
            try:
                write_bytes(stream.fileno(), f"{line}\n".encode())
                os.fsync(stream.fileno())
            except BaseException:
                with suppress(OSError):
                    os.remove(os.path.realpath(path)) if is_new else stream.truncate(size)
                raise
    except OSError as problem:
        raise error(f"{path}: cannot be written: {_refusal(problem, path)}") from problem


def read_lines(path, understand, kind, error=AstropolcalError, advice="take another name"):
    """
    Return what the lines of JSON in a file say, and how many of them cannot be understood.

    The last line does not count: it may have been cut off. Without a file there are none; ``kind``
    says in words what the file is.
    """
    found, n_bad, line = [], 0, "\n"
    if not os.path.exists(path):
        return found, n_bad
    words = f"cannot be read as {kind}"
    with understood(path, error, words), open(path, encoding="utf-8") as lines:
        for line in lines:
            try:
                found.append(understand(json.loads(line)))
            except _DAMAGE:
                n_bad += 1
    if n_bad and not found:
        raise error(f"{path}: not {kind}; {advice}")
    return found, n_bad - (not line.endswith("\n"))


def write_bytes(number, content):
    """Write bytes to an open file, by its number; a disk that fills up takes a part of them."""
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(number, rest) :]


def _refusal(problem, path):
    parent = Path(os.path.realpath(path)).parent
    if not os.path.isdir(parent):
        return f"there is no folder {parent if os.path.islink(path) else path.parent}"
    # libraries raise errors of their own from that of the system
    while problem.errno is None and isinstance(problem.__context__, OSError):
        problem = problem.__context__
    reason = problem.strerror or one_line(problem)
    advice = _ADVICE.get(problem.errno)
    return f"{reason}; {advice}" if advice else reason


def _hidden(path):
    """Return how the hidden names of a file begin and end."""
    suffix = path.suffix if len(os.fsencode(path.suffix)) < 50 else ""
    # what is left for the stem beside two numbers, in bytes; a character may have four
    room = _LONGEST_NAME - len(os.fsencode(suffix)) - 30
    stem = os.fsencode(path.stem[:100])[:room].decode(errors="ignore")
    return f".{stem}.", f".tmp{suffix}"


# ---- what is read ------------------------------------------------------------------


def check_kind(path, error=AstropolcalError):
    """Refuse to read a pipe, a device or a socket, which may have no end."""
    try:
        # a number would be an open file
        kind = _KINDS.get(stat.S_IFMT(os.stat(os.fspath(path)).st_mode))
    except (OSError, TypeError, ValueError):
        # what else is wrong with it is for its reader to say
        return
    if kind:
        raise error(f"{path}: is {kind}; a regular file is needed")


@contextmanager
def understood(path, error, words, *, reads=True):
    """Turn any failure of a reader into one line that names the file and says what it is not.

    Parsers raise errors of every kind for a damaged file. Errors of this package pass unchanged.
    What is not a regular file is refused before it is opened, where it is going to be read, see
    ``check_kind``.
    """
    if reads:
        check_kind(path, error)
    try:
        yield
    except AstropolcalError:
        raise
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except IsADirectoryError:
        raise error(f"{path}: is a folder, not a file") from None
    except Exception as problem:
        if isinstance(problem, PermissionError) or getattr(problem, "errno", None) in _BAD_NAMES:
            reason = getattr(problem, "strerror", None) or one_line(problem)
            raise error(f"{path}: {'cannot be read' if reads else words}: {reason}") from problem
        raise error(f"{path}: {words}: {one_line(problem)}") from problem


def one_line(problem, longest=_LONGEST_REASON):
    """Return what an error or a text says, in one line of up to ``longest`` characters (None: all).

    The type of an error is named where its words alone say little.
    """
    text = " ".join(str(problem).split())
    plain = isinstance(problem, ValueError | OSError)
    if isinstance(problem, BaseException) and not (text and plain):
        text = f"{type(problem).__name__}: {text}".removesuffix(": ")
    text = printable(text)
    return text if longest is None or len(text) <= longest else f"{text[:longest]}..."


def printable(text):
    """Return a text without control characters and marks that turn writing; ends of lines stay."""
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in str(text))


def plain(value, where="value"):
    """
    Return a value as JSON knows it: null for a number that is not finite, text for keys and names.

    A quantity has ``value`` and ``unit``. ``where`` is for the message of what JSON cannot hold.
    """
    if isinstance(value, dict):
        return {str(key): plain(each, f"{where}.{key}") for key, each in value.items()}
    if isinstance(value, u.Quantity):
        return {"value": plain(value.value, where), "unit": str(value.unit)}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(each, f"{where}[{i}]") for i, each in enumerate(value)]
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, os.PathLike | datetime.date | Time | u.UnitBase):
        return one_line(value, None)
    if value is None or isinstance(value, str | int):
        return value
    raise AstropolcalError(
        f"{where} is a {type(value).__name__}, which JSON cannot hold; allowed are numbers, text, "
        "dates, paths, units, quantities, arrays, lists and mappings"
    )


_COLUMN_UNITS = {"percent": u.percent, "deg": u.deg, "nm": u.nm}


def provenance():
    """Return the time, and the versions of what made a result."""
    from astropolcal.version import version

    made = {"created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")}
    return made | {"astropolcal": version, "astropy": astropy.__version__, "numpy": np.__version__}


def columns(table, *keys):
    """Return columns of a table, by default all, as lists by name and unit: ``s_cv_percent``."""
    found = {}
    for key in keys or table.colnames:
        values = np.asarray(table[key])
        for name, unit in _COLUMN_UNITS.items():
            if table[key].unit is not None and table[key].unit.is_equivalent(unit):
                key, values = f"{key}_{name}", table[key].to_value(unit)
                break
        found[key] = values.tolist()
    return found


def check_yaml(text, error=AstropolcalError):
    """Refuse YAML that is small in a file and immense, endless or deadly when it is loaded.

    Links make a document of a kilobyte grow without bounds, loops never end, and a loader that
    calls itself for each level takes the whole process with it. Nothing is loaded here. What is not
    YAML at all raises yaml.YAMLError.
    """
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    known, levels, written = {}, [["", 0]], 0
    for event in yaml.parse(text, Loader=loader):
        anchor = getattr(event, "anchor", None)
        if isinstance(event, yaml.AliasEvent):
            if anchor not in known:
                raise error("its YAML refers to itself")
            size = known[anchor]
        elif isinstance(event, yaml.CollectionStartEvent):
            # until the collection ends its anchor is of no known size: an alias to it is a loop
            known.pop(anchor, None)
            levels.append([anchor, 1])
            if len(levels) > _DEEPEST:
                raise error(f"its YAML is nested deeper than the {_DEEPEST} levels allowed")
            continue
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, size = levels.pop()
        elif isinstance(event, yaml.ScalarEvent):
            # a merge key, by its look or its tag
            plain_merge = event.value == "<<" and event.implicit[0]
            if plain_merge or (event.tag or "").endswith(":merge"):
                raise error("YAML merge keys ('<<') are not allowed")
            size = 1
        else:
            continue
        known |= {anchor: size} if anchor else {}
        written += 1
        levels[-1][1] += size
        # size counts what aliases stand for, written what is in the file
        if levels[-1][1] > _FREE_NODES + _MOST_REPEATS * written:
            raise error("its YAML repeats itself so often that it cannot be loaded")
