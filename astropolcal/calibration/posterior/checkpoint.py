# Licensed under a 3-clause BSD style license - see LICENSE
"""Checkpoints of a sampler: one file that a kill at any moment leaves usable.

A line says what the file is, another one (JSON) of which run it is; then come the steps, each of
the same size, with its number, the state of the random numbers after it and a CRC. A run writes
them in place, where the system has set aside their blocks. What counts is the beginning of the file
up to the first step that is not whole; the rest is computed again, with the same random numbers.
"""

import errno
import json
import os
import zlib
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from astropolcal.exceptions import FitError
from astropolcal.files import atomic_path, check_kind, one_line, understood, write_bytes

__all__ = []

_FORMAT = b"astropolcal posterior checkpoint 3\n"
_KEYS = 624  # words of the state of MT19937


def _step(n_walkers, n_parameters):
    """Return how a step is kept: little-endian whatever the machine, so that a run may move."""
    fields = [
        ("coords", "<f8", (n_walkers, n_parameters)),
        ("log_prob", "<f8", n_walkers),
        # how often each walker has moved so far
        ("accepted", "<i8", n_walkers),
        # what else the state of the generator holds
        ("generator", "<f8", 3),
        ("keys", "<u4", _KEYS),
        # counted from 1: what was never written is no step
        ("number", "<u4"),
        ("crc", "<u4"),
    ]
    return np.dtype(fields)


def _crc(step):
    return zlib.crc32(step.tobytes()[:-4])


class Chain:
    """The steps of a run in memory, and on disk, every few kept steps, where there is a checkpoint.

    ``shape`` is (n_kept, n_walkers, n_parameters).
    """

    def __init__(self, shape, every):
        self._steps = np.zeros(shape[0], _step(*shape[1:]))
        self.coords, self.log_prob = self._steps["coords"], self._steps["log_prob"]
        self.every = every
        self.count = self.saved = 0
        self._file, self._start = None, 0

    @property
    def accepted(self):
        """How often each walker has moved; before the first step the row is still zero."""
        return self._steps["accepted"][max(self.count - 1, 0)]

    @property
    def random_state(self):
        """State of numpy's old generator after the last step."""
        keys, generator = (self._steps[key][self.count - 1] for key in ("keys", "generator"))
        return ("MT19937", keys.astype(np.uint32), *map(int, generator[:2]), float(generator[2]))

    @contextmanager
    def open(self, path, description, arrays, resume):
        """Tie the chain to a checkpoint while a run lasts, continuing what is there.

        ``description`` (JSON) and ``arrays`` must be the same; without ``resume`` a file is
        replaced.
        """
        if path is None:
            yield self
            return
        path = Path(path)
        check_kind(path, FitError)
        with ExitStack() as stack:
            found = os.path.exists(path)
            if found:
                self._file = stack.enter_context(_held(path))
                stated = _head(self._file, path)
                if resume:
                    _compare(path, stated, description, arrays)
                    self._continue(path)
            if not (found and resume):
                self._create(path, description, arrays)
                self._file = stack.enter_context(_held(path))
            try:
                yield self
            finally:
                self.flush()
                self._file = None

    def _continue(self, path):
        """Take the steps of a file, and set aside blocks for what is not in it yet."""
        self._start = self._file.tell()
        found = np.fromfile(self._file, self._steps.dtype, len(self._steps))
        for number, step in enumerate(found, 1):
            if step["number"] != number or step["crc"] != _crc(step):
                break
            self.count = self.saved = number
        self._steps[: self.count] = found[: self.count]
        try:
            _take_room(self._file, self._start + self._steps.nbytes)
        except OSError as error:
            raise self._refused(error) from error

    def _create(self, path, description, arrays):
        """Write a file with room for all steps; it takes its name when it is complete."""
        stated = {"description": description}
        stated |= {"arrays": {key: np.asarray(array).tolist() for key, array in arrays.items()}}
        with atomic_path(path, error=FitError) as temporary, open(temporary, "wb") as stream:
            stream.write(_FORMAT + json.dumps(stated).encode() + b"\n")
            self._start = stream.tell()
            _take_room(stream, self._start + self._steps.nbytes)

    def append(self, coords, log_prob, random_state, accepted):
        """Keep a step; bring the file up to date when it is time."""
        step = self._steps[self.count : self.count + 1]
        self.count += 1
        _, keys, *generator = random_state
        step[0] = (coords, log_prob, accepted, generator, keys, self.count, 0)
        step["crc"] = _crc(step)
        if self.count - self.saved >= self.every:
            self.flush()

    def flush(self):
        """Write what is new."""
        if self._file is None or self.count == self.saved:
            return
        new = self._steps[self.saved : self.count]
        try:
            # once more after a write that failed, so from what is safe
            self._file.seek(self._start + self.saved * new.itemsize)
            write_bytes(self._file.fileno(), new.view(np.uint8))
            os.fsync(self._file.fileno())
        except OSError as error:
            raise self._refused(error) from error
        self.saved = self.count

    def _refused(self, error):
        return FitError(
            f"{self._file.name}: cannot be written: {one_line(error)}; its first "
            f"{self.saved} steps are safe, the run goes on from there"
        )


def _take_room(stream, size):
    """Let the system set aside the blocks that are not written yet, where it can."""
    if not hasattr(os, "posix_fallocate"):
        return
    stream.flush()
    try:
        os.posix_fallocate(stream.fileno(), 0, size)
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise


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
            raise FitError(f"{path}: is in use by another run") from error
        except (ImportError, OSError):
            # a system without such locks: two runs may meet
            pass
        yield stream


def _head(stream, path):
    """Return of which run a checkpoint is; its steps begin where this ends."""
    if stream.read(len(_FORMAT)) != _FORMAT:
        raise FitError(f"{path}: is not a checkpoint of this version")
    with understood(path, FitError, "the checkpoint is damaged"):
        stated = json.loads(stream.readline())
        arrays = {key: np.array(values, float) for key, values in stated["arrays"].items()}
        return dict(stated["description"]), arrays


def _compare(path, stated, description, arrays):
    """Refuse a checkpoint of another run, and say in what it differs."""
    other = [key for key in description if stated[0].get(key) != description[key]]
    for key, array in arrays.items():
        stored = stated[1].get(key)
        # a calibration made anew on another machine may differ in the last digits
        same = stored is not None and stored.shape == np.shape(array)
        if not (same and np.allclose(stored, array, rtol=1e-6, atol=1e-9)):
            other.append(key)
    if other:
        raise FitError(
            f"{path}: is the checkpoint of another run: it differs in {', '.join(other)}; "
            "name another file, or replace it with resume=False"
        )
