# Licensed under a 3-clause BSD style license - see LICENSE
"""
Contexts of a library: files that are frozen by name and checksum, as one archive, from afar.

A context is a small file beside the calibrations, ``NAME.context.json``, with the SHA-256 of each.
Its archive is a ZIP file of these. What is fetched has to have the checksum that the user gives.
"""

import hashlib
import json
import re
import shutil
import tempfile
import zipfile
from pathlib import Path

from astropy.config.paths import get_cache_dir

from astropolcal.exceptions import CalibrationFileError
from astropolcal.files import atomic_path, check_new, one_line, understood
from astropolcal.words import check_choice

__all__ = ["fetch", "import_context"]

_SUFFIX, _VERSION = ".context.json", 1
_CHUNK = 1 << 20
# bytes of a context file, of a calibration, and of all of them, at the most
_MOST_NAMES, _MOST_FILE, _MOST_ALL = 1 << 24, 1 << 30, 1 << 36


def sha256_of(path):
    """Return the SHA-256 of a file."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def freeze(folder, name, files):
    """Write the context of some files of a folder, which has to be a new one."""
    path = _path_of(folder, name)
    check_new(path, error=CalibrationFileError)
    known = {file.name: sha256_of(file) for file in files}
    if not known:
        raise CalibrationFileError(f"context {name}: {folder} holds no calibration to freeze")
    with atomic_path(path, CalibrationFileError) as new:
        new.write_text(json.dumps({"version": _VERSION, "files": known}, indent=1), "utf-8")
    return path


def frozen(folder, name):
    """Return the files of a context, each of which has to be what it was."""
    path, files = _path_of(folder, name), []
    try:
        with open(path, "rb") as stream:
            known = _understood(stream.read(_MOST_NAMES), path)
    except FileNotFoundError:
        check_choice(f"{folder}: context", name, contexts(folder), CalibrationFileError)
        raise
    for file, digest in known.items():
        found = Path(folder) / file
        if not found.is_file():
            raise CalibrationFileError(f"context {name}: {file} is missing in {folder}")
        if sha256_of(found) != digest:
            raise CalibrationFileError(f"context {name}: {file} is not what it was when frozen")
        files.append(found)
    return files


def contexts(folder):
    """Return the names of the contexts of a folder."""
    found = (path.name.removesuffix(_SUFFIX) for path in Path(folder).glob(f"*{_SUFFIX}"))
    return sorted(found)


def _path_of(folder, name):
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        raise CalibrationFileError(
            f"context {one_line(repr(name))}: allowed are up to 100 letters, digits and . _ -",
            argument="context",
        )
    return Path(folder) / f"{name}{_SUFFIX}"


def _understood(content, path):
    """Return names and checksums of a context; refused where it is not one."""
    try:
        told = json.loads(content)
        files = told["files"]
        good = told["version"] == _VERSION and all(
            re.fullmatch(r"[^/\\\x00-\x1f.][^/\\\x00-\x1f]*\.asdf", name)
            and re.fullmatch(r"[0-9a-f]{64}", digest)
            for name, digest in files.items()
        )
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        good = False
    if not good:
        raise CalibrationFileError(f"{path}: is not a context of this version of astropolcal")
    return files


def export(folder, name, path):
    """Write a context and its files as one archive."""
    files = frozen(folder, name)
    check_new(path, error=CalibrationFileError, sources=files, suffix=".zip")
    with (
        atomic_path(path, CalibrationFileError) as new,
        zipfile.ZipFile(new, "w", zipfile.ZIP_DEFLATED) as archive,
    ):
        archive.write(_path_of(folder, name), f"{name}{_SUFFIX}")
        for file in files:
            archive.write(file, file.name)
    return Path(path)


def import_context(path, folder):
    """
    Put the context and the calibrations of an archive into a folder.

    Parameters
    ----------
    path : path-like
        What `Library.export` wrote.
    folder : path-like
        A folder, of a library or new. Files that are there already stay, and have to be the same.

    Returns
    -------
    str
        Name of the context.

    Raises
    ------
    CalibrationFileError
        If it is not such an archive, a file in it is missing, altered or too large, or the folder
        has another file of one of the names. Nothing is written then.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from astropolcal.pipeline import import_context
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "night.zip"
    ...     _ = path.write_bytes(b"not an archive")
    ...     try:
    ...         import_context(path, folder)
    ...     except ValueError as problem:
    ...         "is not an archive of a context" in str(problem)
    True
    """
    folder = Path(folder)
    with tempfile.TemporaryDirectory() as scratch:
        with (
            understood(path, CalibrationFileError, "is not an archive of a context"),
            zipfile.ZipFile(path) as archive,
        ):
            name, known = _checked(archive, path)
            # what it says of the sizes bounds what is unpacked
            archive.extractall(scratch)
        for file in (*known, name):
            digest, there = sha256_of(Path(scratch) / file), folder / file
            if known.get(file, digest) != digest:
                raise CalibrationFileError(f"{path}: {file} does not have its checksum")
            with understood(there, CalibrationFileError, "cannot be read"):
                same = not there.exists() or sha256_of(there) == digest
            if not same:
                raise CalibrationFileError(f"{folder} has another file {file}; nothing is written")
        with understood(folder, CalibrationFileError, "cannot be written", reads=False):
            folder.mkdir(parents=True, exist_ok=True)
        # the context last: it is there only when its files are
        for file in (*known, name):
            _copy(Path(scratch) / file, folder / file)
    return name.removesuffix(_SUFFIX)


def _checked(archive, path):
    """Return the name of the context in an archive, and its files."""
    names = archive.namelist()
    told = [name for name in names if name.endswith(_SUFFIX)]
    if len(told) != 1 or told[0] != _path_of("", told[0].removesuffix(_SUFFIX)).name:
        raise CalibrationFileError(f"{path}: is not an archive of a context")
    sizes = [item.file_size for item in archive.infolist()]
    if max(sizes) > _MOST_FILE or sum(sizes) > _MOST_ALL:
        raise CalibrationFileError(f"{path}: is larger than calibrations are; nothing is written")
    with archive.open(told[0]) as stream:
        known = _understood(stream.read(_MOST_NAMES), f"{path}: {told[0]}")
    odd = sorted({*known} ^ ({*names} - {told[0]}))
    if odd or len(names) != len(known) + 1:
        what = f"{one_line(odd[0])} is in one only" if odd else "a name occurs twice"
        raise CalibrationFileError(f"{path}: context and archive differ: {what}")
    return told[0], known


def _copy(source, path):
    with atomic_path(path, CalibrationFileError) as new:
        shutil.copyfile(source, new)


def fetch(url, folder, *, sha256):
    """
    Fetch a calibration, or the archive of a context, into a library.

    Parameters
    ----------
    url : str
        Any URL that `fsspec <https://filesystem-spec.readthedocs.io>`_ opens, such as ``https://``,
        ``s3://`` or ``file://``; it is installed with ``astropolcal[remote]``.
    folder : path-like
        Where to put it, a folder of a library or a new one.
    sha256 : str
        Checksum of the file. What has another one is not kept. A file with this checksum that was
        fetched before is taken from astropy's cache, without asking the network.

    Returns
    -------
    str or `~pathlib.Path`
        Name of the context, or the file of a single calibration.

    Raises
    ------
    CalibrationFileError
        If fsspec is not installed, the URL cannot be read, or what comes has another checksum or is
        not a calibration or archive.

    Examples
    --------
    >>> from astropolcal.pipeline import fetch
    >>> fetch("https://example.org/night.zip", "calibrations", sha256="none")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.CalibrationFileError: sha256 = 'none'; 64 hexadecimal digits are needed
    """
    if not re.fullmatch(r"[0-9a-fA-F]{64}", str(sha256)):
        raise CalibrationFileError(
            f"sha256 = {one_line(repr(sha256))}; 64 hexadecimal digits are needed"
        )
    cached = Path(get_cache_dir()) / "astropolcal" / sha256.lower()
    if not cached.is_file() or sha256_of(cached) != sha256.lower():
        _download(url, cached)
    if zipfile.is_zipfile(cached):
        return import_context(cached, folder)
    name = str(url).rpartition("/")[2]
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*\.asdf", name):
        raise CalibrationFileError(f"{url}: neither an archive nor the name of an .asdf file")
    path = Path(folder) / name
    if not (path.exists() and sha256_of(path) == sha256.lower()):
        path.parent.mkdir(parents=True, exist_ok=True)
        check_new(path, error=CalibrationFileError)
        _copy(cached, path)
    return path


def _download(url, path):
    """Fetch a file into the cache, where its name is its checksum."""
    try:
        import fsspec
    except ImportError:
        raise CalibrationFileError(
            "fetching needs fsspec: pip install 'astropolcal[remote]'"
        ) from None
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path, CalibrationFileError) as new:
        try:
            with fsspec.open(str(url), "rb") as source, open(new, "wb") as target:
                while block := source.read(_CHUNK):
                    target.write(block)
                    if target.tell() > _MOST_ALL:
                        raise CalibrationFileError(f"{url}: is larger than calibrations are")
        except CalibrationFileError:
            raise
        except Exception as problem:
            # each file system has errors of its own
            said = one_line(str(problem)) or type(problem).__name__
            raise CalibrationFileError(f"{url}: cannot be fetched: {said}") from problem
        digest = sha256_of(new)
        if digest != path.name:
            raise CalibrationFileError(
                f"{url}: has the checksum {digest}, not {path.name}; it is not kept"
            )
