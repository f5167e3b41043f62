# Licensed under a 3-clause BSD style license - see LICENSE
"""Checkpoints of a sampler: one HDF5 file that a kill at any moment leaves usable.

Everything in the file is allocated when it is made (under a temporary name), so that a run writes
raw numbers in place and never touches the structure of the file. First the new rows of the chain go
out and are synced, then a record that counts them, in one of two places in turn; a torn record does
not match its CRC and the other one holds.

HDF5 writes nothing to a disk itself: where that fails it cannot close the file any more, and takes
the process with it. It makes the structure in memory, and says at which bytes the numbers are.
"""

import errno
import io
import json
import os
import struct
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from astropolcal.calibration.posterior.samples import need
from astropolcal.exceptions import FitError
from astropolcal.files import atomic_path, check_kind, one_line, understood, write_bytes

__all__ = []

_FORMAT = "astropolcal posterior checkpoint 2"
_KEYS = 624  # words of the state of MT19937
# steps, CRC of all of them, and what else the state of the generator holds
_HEAD = struct.Struct("<qIiid")
_CRC = struct.Struct("<I")
# the arrays that a run writes to, little-endian whatever the machine, so that it may move
_WRITTEN = {"chain": np.dtype("<f8"), "log_prob": np.dtype("<f8"), "record": np.dtype("u1")}
_MOST_WORDS = 2**24
_BUSY = "is in use by another run"
_PAGE = 4096


class Chain:
    """The steps of a run in memory, and on disk, every few kept steps, where there is a checkpoint.

    ``shape`` is (n_kept, n_walkers, n_parameters).
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
        self._file, self._places = None, {}
        self._slot = 0

    @contextmanager
    def open(self, path, description, arrays, resume):
        """Tie the chain to a checkpoint while a run lasts, continuing what is there.

        ``description`` (JSON) and ``arrays`` must be the same; without ``resume`` a file is
        replaced.
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
        with _opened(h5py, path) as file, _intact(path):
            self._places = {key: _place(h5py, file, key) for key in _WRITTEN}
        with _held(path) as self._file:
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
        with _opened(h5py, path) as file, _intact(path):
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
        record = self._record(self._crc)
        memory = _Pages()
        with h5py.File(memory, "w", libver="earliest") as file:
            file.attrs["format"] = np.bytes_(_FORMAT)
            file["description"] = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
            for key, array in arrays.items():
                file[f"fixed/{key}"] = array
            file["record"] = np.stack([record, record])
            _allocate(h5py, file, "chain", self.coords)
            _allocate(h5py, file, "log_prob", self.log_prob)
            self._places = {key: _place(h5py, file, key) for key in _WRITTEN}
        with atomic_path(path, error=FitError) as temporary:
            with open(temporary, "wb") as stream:
                memory.copy_to(stream)
                self._write_steps(stream.fileno(), slice(0, self.count))
            _take_room(temporary)

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
        number = self._file.fileno()
        try:
            self._write_steps(number, new)
            self._sync()
            # once more after a write that failed, so from what is safe
            crc = _crc_of(self.coords[new], self.log_prob[new], self._crc)
            _write_rows(number, self._places["record"], self._slot, self._record(crc)[None])
            self._sync()
        except OSError as error:
            raise FitError(
                f"{self._file.name}: cannot be written: {one_line(error)}; its first "
                f"{self.saved} steps are safe, the run goes on from there"
            ) from error
        self.saved, self._crc, self._slot = self.count, crc, 1 - self._slot

    def _write_steps(self, number, rows):
        _write_rows(number, self._places["chain"], rows.start, self.coords[rows])
        _write_rows(number, self._places["log_prob"], rows.start, self.log_prob[rows])

    def _sync(self):
        os.fsync(self._file.fileno())

    def _record(self, crc):
        """Return count, random state, acceptance and their CRC as bytes."""
        keys = np.zeros(_KEYS, dtype="<u4")
        head = (0, 0, 0.0)
        if self.random_state is not None:
            _, keys, *head = self.random_state
        content = _HEAD.pack(self.count, crc, *head) + np.asarray(keys, dtype="<u4").tobytes()
        content += self.accepted.astype("<i8").tobytes()
        return np.frombuffer(content + _CRC.pack(zlib.crc32(content)), dtype=np.uint8)


def _crc_of(coords, log_prob, crc):
    """Return the CRC that steps add to, in pieces of any size."""
    for row, value in zip(coords, log_prob, strict=True):
        crc = zlib.crc32(np.ascontiguousarray(row, dtype="<f8").tobytes(), crc)
        crc = zlib.crc32(np.ascontiguousarray(value, dtype="<f8").tobytes(), crc)
    return crc


class _Pages(io.RawIOBase):
    """A file in memory, of which only what is written takes room."""

    def __init__(self):
        super().__init__()
        self._pages, self._size, self._at = {}, 0, 0

    def readable(self):
        return True

    def writable(self):
        return True

    def seekable(self):
        return True

    def seek(self, offset, whence=os.SEEK_SET):
        self._at = offset + {os.SEEK_CUR: self._at, os.SEEK_END: self._size}.get(whence, 0)
        return self._at

    def truncate(self, size=None):
        self._size = self._at if size is None else size
        return self._size

    def write(self, content):
        content = memoryview(content).cast("B")
        for page, inside, part in self._parts(len(content)):
            self._pages.setdefault(page, bytearray(_PAGE))[inside] = content[part]
        self._at += len(content)
        self._size = max(self._size, self._at)
        return len(content)

    def readinto(self, buffer):
        view = memoryview(buffer).cast("B")[: max(self._size - self._at, 0)]
        for page, inside, part in self._parts(len(view)):
            view[part] = self._pages.get(page, bytes(_PAGE))[inside]
        self._at += len(view)
        return len(view)

    def _parts(self, size):
        """Yield the number of each page from here on, and what of it is what of the content."""
        done = 0
        while done < size:
            page, start = divmod(self._at + done, _PAGE)
            part = min(_PAGE - start, size - done)
            yield page, slice(start, start + part), slice(done, done + part)
            done += part

    def copy_to(self, stream):
        """Write it to a file on a disk, which has holes where nothing was written."""
        stream.truncate(self._size)
        for page, content in self._pages.items():
            stream.seek(page * _PAGE)
            stream.write(content[: self._size - page * _PAGE])
        stream.flush()


def _write_rows(number, place, first, rows):
    """Write rows of an array at their place in a file."""
    offset, kind = place
    content = np.ascontiguousarray(rows, dtype=kind)
    # the bytes of one row; there may be none to write
    size = content[:1].nbytes
    os.lseek(number, offset + first * size, os.SEEK_SET)
    write_bytes(number, content.tobytes())


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
def _held(path):
    """Open a checkpoint for the writes of one run; no other one opens it meanwhile."""
    try:
        stream = open(path, "rb+", buffering=0)
    except OSError as error:
        raise FitError(f"{path}: cannot be written: {error.strerror}") from error
    with stream:
        try:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise FitError(f"{path}: {_BUSY}") from error
        except (ImportError, OSError):
            # a system without such locks: two runs may meet
            pass
        yield stream


@contextmanager
def _opened(h5py, path):
    try:
        # the lock that h5py takes is refused while another run holds its own
        file = h5py.File(path, "r", libver="earliest", locking=True)
    except OSError as error:
        busy = isinstance(error, BlockingIOError) or "unable to lock" in str(error)
        reason = _BUSY if busy else f"is not a checkpoint ({one_line(error)})"
        raise FitError(f"{path}: {reason}") from error
    except Exception as error:
        raise FitError(f"{path}: is not a checkpoint ({one_line(error)})") from error
    with file:
        yield file


@contextmanager
def _intact(path):
    with understood(path, FitError, "the checkpoint is damaged"):
        yield


def _read(h5py, path, names=()):
    """Return what a checkpoint holds, its steps not yet; None where there is no file."""
    if not os.path.exists(path):
        return None
    check_kind(path, FitError)
    with _opened(h5py, path) as file, _intact(path):
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
        raise ValueError(f"{name} is not a plain array of this file")
    # what is not written yet may be claimed, but not what a file has no room for
    if found.size and found.id.get_storage_size() < found.nbytes:
        raise ValueError(f"{name} claims {found.nbytes} bytes that are not in the file")
    return found


def _parts(name):
    """Return a name and those of the groups it is in."""
    parts = name.split("/")
    return ["/".join(parts[: i + 1]) for i in range(len(parts))]


def _place(h5py, file, name):
    """Return where the numbers of an array begin in the file, and of which type they are."""
    found, kind = _plain(h5py, file, name), _WRITTEN[name]
    offset = found.id.get_offset()
    if found.dtype != kind or offset is None:
        raise ValueError(f"{name} is of type {found.dtype}, at byte {offset}")
    return offset, kind


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
