# Licensed under a 3-clause BSD style license - see LICENSE
"""Files that appear complete or not at all."""

import os

__all__ = ["write_atomically"]


def write_atomically(path, content):
    """
    Replace a file by new content, or leave everything as it was.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file; it is replaced if it exists.
    content : bytes
        All that it will hold.

    Raises
    ------
    OSError
        If the folder is missing or cannot be written; no half-written or
        temporary file stays behind.

    Examples
    --------
    >>> from pathlib import Path
    >>> from astropolcal._atomic import write_atomically
    >>> write_atomically(Path("note.txt"), b"done")
    >>> Path("note.txt").read_bytes()
    b'done'
    """
    # in the same folder, because a file cannot be moved atomically between disks
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except FileExistsError:  # of another writer in this process: it is not ours to remove
        raise
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
