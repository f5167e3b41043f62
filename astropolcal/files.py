# Licensed under a 3-clause BSD style license - see LICENSE
"""
Files that appear complete or not at all, and files that may be anything.

What is read may come from anywhere. Every reader stands in a door, `understood`,
that lets through objects and errors of ours only; YAML is looked at by `check_yaml`
before any of it is loaded.
"""

import errno
import os
import re
import secrets
import time
from contextlib import contextmanager, suppress
from pathlib import Path

from astropolcal.exceptions import AstropolcalError

__all__ = ["atomic_path", "check_new", "check_yaml", "one_line", "understood"]

# a file of ours is 12 levels deep; loaders call themselves at each and die at some thousands
_DEEPEST = 64
# how many times over links may repeat what is written, beyond some nodes that do no harm
_MOST_REPEATS, _FREE_NODES = 10, 10_000
_LONGEST_REASON = 240
_STALE_SECONDS = 24 * 3600
_ADVICE = {
    errno.ENOSPC: "free some space or name another folder",
    errno.EDQUOT: "free some space or name another folder",
    errno.EFBIG: "the file is larger than this system allows; name another folder",
    errno.EACCES: "name a folder that you may write to",
    errno.EPERM: "name a folder that you may write to",
    errno.EROFS: "name a folder that you may write to",
}


def check_new(path, overwrite=False, error=AstropolcalError):
    """
    Return the path of a file to write, before the work of writing it is done.

    Parameters
    ----------
    path : path-like
        The file.
    overwrite : bool
        Whether a file that exists may be replaced.
    error : type
        What to raise.

    Returns
    -------
    `~pathlib.Path`

    Raises
    ------
    AstropolcalError
        Of the type given, if it is a folder, exists and must not be replaced, or its own
        folder is missing.

    Examples
    --------
    >>> from astropolcal.files import check_new
    >>> check_new("no/run.ecsv")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.AstropolcalError: no/run.ecsv: cannot be written: there is no folder no
    """
    path = Path(path)
    if path.is_dir():
        raise error(f"{path}: is a folder; name a file in it")
    if path.exists() and not overwrite:
        raise error(f"{path}: exists already; overwrite=True replaces it")
    if not path.parent.is_dir():
        raise error(f"{path}: cannot be written: there is no folder {path.parent}")
    return path


@contextmanager
def atomic_path(path, error=AstropolcalError):
    """
    Give a temporary path beside ``path`` that takes its name in the end.

    Parameters
    ----------
    path : path-like
        The file to write. It is replaced only when the block ends well.
    error : type
        What to raise where the operating system refuses.

    Yields
    ------
    `~pathlib.Path`
        Where to write, with the same suffix. Nothing is there, and nobody else writes there.

    Raises
    ------
    AstropolcalError
        Of the type given, if the folder is missing or cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from astropolcal.files import atomic_path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_path(Path(folder) / "note.txt") as temporary:
    ...         _ = temporary.write_text("all of it")
    ...     (Path(folder) / "note.txt").read_text()
    'all of it'
    """
    path = Path(path)
    if not path.name or "\0" in str(path):
        raise error(f"{str(path)!r}: is no name of a file")
    # by number of the process alone, one that was killed would stand in the way of another
    mark = f"{os.getpid()}-{secrets.token_hex(4)}"
    temporary = path.with_name(f".{path.stem[:100]}.{mark}.tmp{path.suffix}")
    try:
        _remove_stale(path)
        yield temporary
        # else the name could reach the disk before the content
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        # atomic within a file system, hence the temporary file beside the final one
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as problem:
        raise error(f"{path}: cannot be written: {_refusal(problem, path)}") from problem
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _refusal(problem, path):
    if not path.parent.is_dir():
        return f"there is no folder {path.parent}"
    reason = problem.strerror or one_line(problem)
    advice = _ADVICE.get(problem.errno)
    return f"{reason}; {advice}" if advice else reason


def _remove_stale(path):
    """Remove what runs that were killed long ago left of the same file."""
    ours = re.compile(re.escape(f".{path.stem[:100]}.") + r"\d+(-[0-9a-f]{8})?\.tmp")
    limit = time.time() - _STALE_SECONDS
    with suppress(OSError):
        for other in os.scandir(path.parent):
            stem, suffix = os.path.splitext(other.name)
            # somebody else may have removed it meanwhile
            with suppress(OSError):
                fits = suffix == path.suffix if path.suffix else suffix == ".tmp"
                stem = stem if path.suffix else other.name
                if fits and ours.fullmatch(stem) and other.stat().st_mtime < limit:
                    os.unlink(other.path)


def _sync_folder(folder):
    """Make a new name last through a loss of power, where the system can."""
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


# ---- what is read ------------------------------------------------------------------


@contextmanager
def understood(path, error, words):
    """
    Turn whatever goes wrong in a reader into one line that names the file.

    Parsers raise errors of every kind for a damaged file. Errors of ours pass unchanged.

    Parameters
    ----------
    path : path-like
        The file.
    error : type
        What to raise.
    words : str
        What the file is not, such as ``"not a readable FITS file"``.

    Raises
    ------
    AstropolcalError
        Of the type given.

    Examples
    --------
    >>> from astropolcal.exceptions import ObservationError
    >>> from astropolcal.files import understood
    >>> with understood("night.json", ObservationError, "not a journal"):
    ...     {}["frame"]
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: night.json: not a journal: KeyError: 'frame'
    """
    try:
        yield
    except AstropolcalError:
        raise
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except IsADirectoryError:
        raise error(f"{path}: is a folder, not a file") from None
    except PermissionError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror or problem}") from problem
    except Exception as problem:
        raise error(f"{path}: {words}: {one_line(problem)}") from problem


def one_line(problem, longest=_LONGEST_REASON):
    r"""
    Return what an error or a text says, in one line that is not too long.

    Parameters
    ----------
    problem : Exception or object
        The error, whose type is named where its words alone say little, or a text.
    longest : int
        Number of characters to keep.

    Returns
    -------
    str

    Examples
    --------
    >>> from astropolcal.files import one_line
    >>> one_line(ValueError("could not\n   parse it"))
    'could not parse it'
    >>> one_line(KeyError("names"))
    "KeyError: 'names'"
    """
    text = " ".join(str(problem).split())
    plain = isinstance(problem, ValueError | OSError) or not isinstance(problem, BaseException)
    if not text or not plain:
        text = f"{type(problem).__name__}: {text}".removesuffix(": ")
    text = "".join(c if c.isprintable() else "?" for c in text)
    return text if len(text) <= longest else f"{text[:longest]}..."


def check_yaml(text, error=AstropolcalError):
    """
    Refuse YAML that is small in a file and immense, endless or deadly when it is loaded.

    Links make a document of a kilobyte grow without bounds, loops never end, and a loader that
    calls itself for each level takes the whole process with it. Nothing is loaded here.

    Parameters
    ----------
    text : str or bytes
        The document.
    error : type
        What to raise.

    Raises
    ------
    AstropolcalError
        Of the type given.
    yaml.YAMLError
        If it is no YAML.

    Examples
    --------
    >>> from astropolcal.files import check_yaml
    >>> check_yaml("{hwp: [0, 45]}")
    >>> check_yaml("&loop [*loop]")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.AstropolcalError: its YAML refers to itself
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
            if _merges(event):
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


def _merges(event):
    """Return whether a scalar is a merge key, by its look or its tag."""
    return (event.value == "<<" and event.implicit[0]) or (event.tag or "").endswith(":merge")
