# Licensed under a 3-clause BSD style license - see LICENSE
"""
Checkpoints of a sampler: one HDF5 file that a kill at any moment leaves usable.

Everything in the file is allocated when it is made (under a temporary name),
so that a run writes raw numbers in place and never touches the structure of
the file. First the new rows of the chain go out and are synced, then a record
that counts them, in one of two places in turn; a torn record does not match
its CRC and the other one holds.
"""

import json
import os
import struct
import zlib
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from astropolcal.calibration._optional import need
from astropolcal.exceptions import FitError
from astropolcal.files import atomic_path

_FORMAT = "astropolcal posterior checkpoint 1"
_KEYS = 624  # words of the state of MT19937
_HEAD = struct.Struct("<qiid")


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
        found = _read(h5py, path)
        if found and resume:
            _compare(path, found, description, arrays)
            self._continue(found)
        if not (found and resume) or found["capacity"] < len(self.coords):
            self._create(h5py, path, description, arrays)
        with _opened(h5py, path, "r+") as self._file:
            try:
                yield self
            finally:
                self.flush()
                self._file = None

    def _continue(self, found):
        take = min(found["count"], len(self.coords))
        self.coords[:take], self.log_prob[:take] = found["chain"][:take], found["log_prob"][:take]
        self.count = self.saved = take
        self.accepted = found["accepted"]
        self.random_state, self._slot = found["random_state"], 1 - found["slot"]
        self.accepted_over = found["count"]

    def _create(self, h5py, path, description, arrays):
        """Write a file with room for all steps; it takes its name when it is complete."""
        with atomic_path(path, error=FitError) as temporary:
            with h5py.File(temporary, "w", libver="earliest") as file:
                file.attrs["format"] = _FORMAT
                text = np.frombuffer(json.dumps(description).encode(), dtype=np.uint8)
                file["description"] = text
                for key, array in arrays.items():
                    file[f"fixed/{key}"] = array
                _allocate(h5py, file, "chain", self.coords)[: self.count] = self._done(self.coords)
                _allocate(h5py, file, "log_prob", self.log_prob)[: self.count] = self._done(
                    self.log_prob
                )
                record = self._record()
                file["record"] = np.stack([record, record])

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
            self._file["record"][self._slot] = self._record()
            self._sync()
        except OSError as error:
            raise FitError(f"{self._file.filename}: cannot be written: {error}") from error
        self.saved, self._slot = self.count, 1 - self._slot

    def _sync(self):
        self._file.flush()
        os.fsync(self._file.id.get_vfd_handle())

    def _record(self):
        """Return count, random state, acceptance and their CRC as bytes."""
        keys = np.zeros(_KEYS, dtype="<u4")
        head = (0, 0, 0.0)
        if self.random_state is not None:
            _, keys, *head = self.random_state
        content = _HEAD.pack(self.count, *head) + np.asarray(keys, dtype="<u4").tobytes()
        content += self.accepted.astype("<i8").tobytes()
        return np.frombuffer(content + struct.pack("<I", zlib.crc32(content)), dtype=np.uint8)


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
        reason = "is in use by another run" if busy else f"is no checkpoint ({error})"
        raise FitError(f"{path}: {reason}") from error
    with file:
        yield file


def _read(h5py, path):
    """Return what a checkpoint holds; None where there is no file."""
    if not path.exists():
        return None
    with _opened(h5py, path, "r") as file:
        if file.attrs.get("format") != _FORMAT:
            raise FitError(f"{path}: is an HDF5 file but no checkpoint of this version")
        try:
            found = {
                "description": json.loads(file["description"][...].tobytes()),
                "arrays": {key: file[f"fixed/{key}"][...] for key in file["fixed"]},
                "capacity": len(file["chain"]),
            }
            found |= _latest(file["record"][...])
            found["chain"] = file["chain"][: found["count"]]
            found["log_prob"] = file["log_prob"][: found["count"]]
        except (KeyError, ValueError, OSError) as error:
            raise FitError(f"{path}: the checkpoint is damaged: {error}") from error
    return found


def _latest(records):
    """Return the content of the record that counts more steps, of those that are whole."""
    found = []
    for slot, record in enumerate(records):
        content, crc = record[:-4].tobytes(), record[-4:].tobytes()
        if struct.pack("<I", zlib.crc32(content)) == crc:
            found.append((_HEAD.unpack_from(content)[0], slot, content))
    if not found:
        raise ValueError("none of its records is whole")
    count, slot, content = max(found)
    end = _HEAD.size + 4 * _KEYS
    keys = np.frombuffer(content[_HEAD.size : end], dtype="<u4").astype(np.uint32)
    return {
        "count": count,
        "slot": slot,
        "random_state": ("MT19937", keys, *_HEAD.unpack_from(content)[1:]) if count else None,
        "accepted": np.frombuffer(content[end:], dtype="<i8").astype(np.int64),
    }


def _compare(path, found, description, arrays):
    """Refuse a checkpoint of another run, and say in what it differs."""
    other = [key for key in description if found["description"].get(key) != description[key]]
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
