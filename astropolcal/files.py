# Licensed under a 3-clause BSD style license - see LICENSE
"""Files that appear complete or not at all."""

import os
from contextlib import contextmanager
from pathlib import Path

from astropolcal.exceptions import AstropolcalError

__all__ = ["atomic_path"]


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
        Where to write, with the same suffix.

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
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as stream:
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as problem:
        raise error(f"{path}: cannot be written: {problem.strerror or problem}") from problem
    finally:
        temporary.unlink(missing_ok=True)
