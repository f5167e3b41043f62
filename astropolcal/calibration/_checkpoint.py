# Licensed under a 3-clause BSD style license - see LICENSE
"""
Checkpoints of a sampler: one HDF5 file that a kill at any moment leaves usable.

Everything in the file is allocated when it is made (under a temporary name),
so that a run writes raw numbers in place and never touches the structure of
the file. First the new rows of the chain go out and are synced, then a record
that counts them, in one of two places in turn; a torn record does not match
its CRC and the other one holds.
"""

import errno
import json
import os
import struct
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from astropolcal.calibration._optional import need
from astropolcal.exceptions import FitError
from astropolcal.files import atomic_path, one_line, understood

_FORMAT = "astropolcal posterior checkpoint 2"
_KEYS = 624  # words of the state of MT19937
# steps, CRC of all of them, and what else the state of the generator holds
_HEAD = struct.Struct("<qIiid")
_CRC = struct.Struct("<I")
_MOST_WORDS = 2**24


class Chain:
    """
    The steps of a run in memory, and on disk where there is a checkpoint.

    Parameters
    ----------
    shape : tuple
        (n_kept, n_walkers, n_parameters).
    every : int
        Number of kept steps after which the file is brought up to date.
    """

    def __init__(self, shape, every):
        self.coords = np.empty(shape)
        self.log_prob = np.empty(shape[:2])
        self.every = every
        self.count = self.saved = 0
        #: Kept steps that ``accepted`` counts; more than asked for, if the file has more.
        self.accepted_over = 0
        self.accepted = np.zeros(shape[1], dtype=np.int64)
        self.random_state = None
        self._crc = 0
        self._file = None
        self._slot = 0

    @contextmanager
    def open(self, path, description, arrays, resume):
        """
        Tie the chain to a checkpoint while a run lasts, continuing what is there.

        Parameters
        ----------
        path : path-like or None
            The file; None for a run in memory.
        description : dict
            What must be the same, in words of JSON.
        arrays : dict of str to `~numpy.ndarray`
            What must be the same, as numbers.
        resume : bool
            Whether to go on from a file that exists; otherwise it is replaced.
        """
        if path is None:
            yield self
            return
        h5py = need("h5py", "a checkpoint")
        path = Path(path)
        found = _read(h5py, path, arrays)
        if found and resume:
            _compare(path, found, description, arrays)
            self._continue(h5py, path, found)
        if not (found and resume) or found["capacity"] < len(self.coords):
            self._create(h5py, path, description, arrays)
        with _opened(h5py, path, "r+") as self._file:
            try:
                yield self
            finally:
                self.flush()
                self._file = None

    def _continue(self, h5py, path, found):
        self.accepted_over, self._slot = found["count"], 1 - found["slot"]
        self.accepted, self.random_state = found["accepted"], found["random_state"]
        shapes = {"chain": self.coords.shape[1:], "log_prob": self.log_prob.shape[1:]}
        if found["accepted"].shape != self.accepted.shape or found["shapes"] != shapes:
            raise FitError(f"{path}: the checkpoint is damaged: it is of {found['shapes']}")
        with _opened(h5py, path, "r") as file, _intact(path):
            crc = self._take(_plain(h5py, file, "chain"), _plain(h5py, file, "log_prob"))
        if crc != found["crc"]:
            raise FitError(f"{path}: the checkpoint is damaged: its steps do not match their CRC")

    def _take(self, coords, log_prob):
        """Copy what fits of the steps in a file, and return the CRC of all of them."""
        crc, rows = 0, 256
        for start in range(0, self.accepted_over, rows):
            part = slice(start, min(start + rows, self.accepted_over))
            steps = coords[part], log_prob[part]
            crc = _crc_of(*steps, crc)
            end = min(part.stop, len(self.coords))
            if start < end:
                self.coords[start:end], self.log_prob[start:end] = (x[: end - start] for x in steps)
        self.count = self.saved = min(self.accepted_over, len(self.coords))
        self._crc = crc
        return crc

    def _create(self, h5py, path, description, arrays):
        """Write a file with room for all steps; it takes its name when it is complete."""
        with atomic_path(path, error=FitError) as temporary, _as_os_errors():
            with h5py.File(temporary, "w", libver="earliest") as file:
                file.attrs["format"] = np.bytes_(_FORMAT)
                text = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
                file["description"] = text
                for key, array in arrays.items():
                    file[f"fixed/{key}"] = array
                _allocate(h5py, file, "chain", self.coords)[: self.count] = self._done(self.coords)
                _allocate(h5py, file, "log_prob", self.log_prob)[: self.count] = self._done(
                    self.log_prob
                )
                record = self._record(self._crc)
                file["record"] = np.stack([record, record])
            _take_room(temporary)

    def _done(self, array):
        return array[: self.count]

    def append(self, coords, log_prob, random_state, accepted):
        """Keep a step; bring the file up to date when it is time."""
        self.coords[self.count], self.log_prob[self.count] = coords, log_prob
        self.random_state, self.accepted = random_state, accepted.copy()
        self.count += 1
        if self.count - self.saved >= self.every:
            self.flush()

    def flush(self):
        """Write what is new: the steps first, then the record that counts them."""
        if self._file is None or self.count == self.saved:
            return
        new = slice(self.saved, self.count)
        try:
            self._file["chain"][new] = self.coords[new]
            self._file["log_prob"][new] = self.log_prob[new]
            self._sync()
            # once more after a write that failed, so from what is safe
            crc = _crc_of(self.coords[new], self.log_prob[new], self._crc)
            self._file["record"][self._slot] = self._record(crc)
            self._sync()
        except OSError as error:
            raise FitError(
                f"{self._file.filename}: cannot be written: {one_line(error)}; its first "
                f"{self.saved} steps are safe, the run goes on from there"
            ) from error
        self.saved, self._crc, self._slot = self.count, crc, 1 - self._slot

    def _sync(self):
        self._file.flush()
        os.fsync(self._file.id.get_vfd_handle())

    def _record(self, crc):
        """Return count, random state, acceptance and their CRC as bytes."""
        # little-endian whatever the machine, so that a run may move
        keys = np.zeros(_KEYS, dtype="<u4")
        head = (0, 0, 0.0)
        if self.random_state is not None:
            _, keys, *head = self.random_state
        content = _HEAD.pack(self.count, crc, *head) + np.asarray(keys, dtype="<u4").tobytes()
        content += self.accepted.astype("<i8").tobytes()
        return np.frombuffer(content + _CRC.pack(zlib.crc32(content)), dtype=np.uint8)


def _crc_of(coords, log_prob, crc):
    """Return the CRC that steps add to, whatever pieces they come in."""
    for row, value in zip(coords, log_prob, strict=True):
        crc = zlib.crc32(np.ascontiguousarray(row, dtype="<f8").tobytes(), crc)
        crc = zlib.crc32(np.ascontiguousarray(value, dtype="<f8").tobytes(), crc)
    return crc


@contextmanager
def _as_os_errors():
    """HDF5 tells of a full disk in errors of its own while it closes a file."""
    try:
        yield
    except RuntimeError as error:
        raise OSError(one_line(error)) from error


def _take_room(path):
    """Let the system set aside the blocks that are not written yet, where it can."""
    if not hasattr(os, "posix_fallocate"):
        return
    with open(path, "rb+") as stream:
        try:
            os.posix_fallocate(stream.fileno(), 0, os.path.getsize(path))
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                raise


def _allocate(h5py, file, name, like):
    """Make a dataset whose place in the file is taken at once, without writing zeros."""
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    space = h5py.h5s.create_simple(like.shape)
    kind = h5py.h5t.py_create(np.dtype("<f8"))
    h5py.h5d.create(file.id, name.encode(), kind, space, plan)
    return file[name]


@contextmanager
def _opened(h5py, path, mode):
    try:
        file = h5py.File(path, mode, libver="earliest", locking=True)
    except OSError as error:
        busy = isinstance(error, BlockingIOError) or "unable to lock" in str(error)
        reason = "is in use by another run" if busy else f"is no checkpoint ({one_line(error)})"
        raise FitError(f"{path}: {reason}") from error
    except Exception as error:
        raise FitError(f"{path}: is no checkpoint ({one_line(error)})") from error
    with file:
        yield file


@contextmanager
def _intact(path):
    with understood(path, FitError, "the checkpoint is damaged"):
        yield


def _read(h5py, path, names=()):
    """Return what a checkpoint holds, its steps not yet; None where there is no file."""
    if not path.exists():
        return None
    with _opened(h5py, path, "r") as file, _intact(path):
        if _format_of(h5py, file) != _FORMAT.encode():
            raise FitError(f"{path}: is an HDF5 file but no checkpoint of this version")
        # looked up, not listed: a damaged list may claim any length
        fixed = file.get("fixed") if _is_own(h5py, file, "fixed") else None
        names = [key for key in names if isinstance(fixed, h5py.Group) and key in fixed]
        steps = {key: _plain(h5py, file, key) for key in ("chain", "log_prob")}
        capacity = len(steps["chain"])
        found = {
            "description": json.loads(_small(h5py, file, "description", "u").tobytes()),
            "arrays": {key: _small(h5py, file, f"fixed/{key}", "fiub") for key in names},
            "capacity": capacity,
            "shapes": {key: array.shape[1:] for key, array in steps.items()},
        } | _latest(_small(h5py, file, "record", "u"))
        if not 0 <= found["count"] <= capacity or len(steps["log_prob"]) != capacity:
            raise ValueError(f"it counts {found['count']} steps, and has room for {capacity}")
    return found


def _format_of(h5py, file):
    """Return what the file says it is; text of any length is in a heap, which may be damaged."""
    if not h5py.h5a.exists(file.id, b"format"):
        return None
    attribute = h5py.h5a.open(file.id, b"format")
    short = attribute.dtype.kind == "S" and attribute.dtype.itemsize < 100 and not attribute.shape
    return bytes(file.attrs["format"]) if short else None


def _is_own(h5py, file, name):
    """Whether a name leads to something in this very file."""
    return isinstance(file.get(name, getlink=True), h5py.HardLink)


def _plain(h5py, file, name):
    """Return a dataset as it was made: numbers in one piece of this file, none elsewhere."""
    there = all(_is_own(h5py, file, part) for part in _parts(name))
    found = file[name] if there else None
    plain = isinstance(found, h5py.Dataset) and found.dtype.kind in "fiub"
    if not plain or found.external or found.is_virtual or found.chunks:
        raise ValueError(f"{name} is no plain array of this file")
    # what is not written yet may be claimed, but not what a file has no room for
    if found.size and found.id.get_storage_size() < found.nbytes:
        raise ValueError(f"{name} claims {found.nbytes} bytes that are not in the file")
    return found


def _parts(name):
    """Return a name and those of the groups it is in."""
    parts = name.split("/")
    return ["/".join(parts[: i + 1]) for i in range(len(parts))]


def _small(h5py, file, name, kinds):
    found = _plain(h5py, file, name)
    if found.nbytes > 8 * _MOST_WORDS or found.dtype.kind not in kinds:
        raise ValueError(f"{name} is of type {found.dtype} and shape {found.shape}")
    return found[...]


def _latest(records):
    """Return the content of the record that counts more steps, of those that are whole."""
    found, end = [], _HEAD.size + 4 * _KEYS
    # two records: while one is written the other one is whole
    for slot, record in enumerate(records):
        content, crc = record[:-4].tobytes(), record[-4:].tobytes()
        if _CRC.pack(zlib.crc32(content)) == crc and len(content) >= end:
            found.append((_HEAD.unpack_from(content)[0], slot, content))
    if not found:
        raise ValueError("none of its records is whole")
    count, slot, content = max(found)
    _, chain_crc, *rest = _HEAD.unpack_from(content)
    keys = np.frombuffer(content[_HEAD.size : end], dtype="<u4").astype(np.uint32)
    return {
        "count": count,
        "slot": slot,
        "crc": chain_crc,
        "random_state": ("MT19937", keys, *rest) if count else None,
        "accepted": np.frombuffer(content[end:], dtype="<i8").astype(np.int64),
    }


def _compare(path, found, description, arrays):
    """Refuse a checkpoint of another run, and say in what it differs."""
    stated = found["description"]
    if not isinstance(stated, dict):
        raise FitError(f"{path}: the checkpoint is damaged: it does not say what it is of")
    other = [key for key in description if stated.get(key) != description[key]]
    for key, array in arrays.items():
        stored = found["arrays"].get(key)
        # a calibration made anew on another machine may differ in the last digits
        if stored is None or stored.shape != array.shape or not _same(stored, array):
            other.append(key)
    if other:
        raise FitError(
            f"{path}: is the checkpoint of another run: it differs in {', '.join(other)}; "
            "name another file, or replace it with resume=False"
        )


def _same(stored, array):
    return np.allclose(stored, array, rtol=1e-6, atol=1e-9)
