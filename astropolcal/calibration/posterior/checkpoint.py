# Licensed under a 3-clause BSD style license - see LICENSE
"""Checkpoints of a sampler: one HDF5 file that a kill at any moment leaves usable.

HDF5 lays the file out in memory, without the steps, and never touches it again: where a write of
its own fails it takes the process with it. The block before its structures, which it leaves to the
user, says where the steps are and (JSON) of which run, so that no structure is read that may be
damaged. All steps have the same size, with their number, the state of the random numbers and a CRC;
a run writes them in place. What counts is the beginning of the file up to the first step that is
not whole; the rest is computed again, with the same random numbers. The CRC goes on from that of
the step before: what an earlier run has left after a step that was computed again may follow from
other places of the walkers, where another machine rounds otherwise or no seed was given.
"""

import io
import json
import os
import zlib
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from astropolcal.calibration.posterior.samples import need
from astropolcal.exceptions import FitError
from astropolcal.files import atomic_path, check_kind, one_line, understood, write_bytes

__all__ = []

_FORMAT = b"astropolcal posterior checkpoint 3\n"
_KEYS = 624  # words of the state of MT19937
_LEAST_BLOCK = 512  # of HDF5, before its structures; larger ones are twice, four times ... as large
_LONGEST = 2**29  # bytes that may say of which run the steps are


def _crc(step, before):
    """Return the CRC of a step, which goes on from that of the step before."""
    return zlib.crc32(step.tobytes()[:-4], before)


class Chain:
    """The steps of a run in memory, and on disk, every few kept steps, where there is a checkpoint.

    ``shape`` is (n_kept, n_walkers, n_parameters).
    """

    def __init__(self, shape, every):
        n_kept, n_walkers, n_parameters = shape
        # how a step is kept: little-endian on any machine, so that a run may move
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
        self._steps = np.zeros(n_kept, fields)
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
        path, room = Path(path), 0
        check_kind(path, FitError)
        with ExitStack() as stack:
            if os.path.exists(path):
                self._file = stack.enter_context(_held(path))
                self._start, room, *stated = _head(self._file, path)
                if resume:
                    _compare(path, *stated, description, arrays)
                    self._continue()
            if not resume or room < len(self._steps):
                self._create(path, description, arrays)
                self._file = stack.enter_context(_held(path))
            try:
                yield self
            finally:
                self.flush()
                self._file = None

    def _continue(self):
        """Take the steps of a file."""
        self._file.seek(self._start)
        found = np.fromfile(self._file, self._steps.dtype, len(self._steps))
        before = 0
        for number, step in enumerate(found, 1):
            if step["number"] != number or step["crc"] != _crc(step, before):
                break
            self.count = self.saved = number
            before = int(step["crc"])
        self._steps[: self.count] = found[: self.count]

    def _create(self, path, description, arrays):
        """Write a file with room for all steps; it takes its name when it is complete."""
        h5py = need("h5py", "a checkpoint")
        arrays = {key: np.asarray(array).tolist() for key, array in arrays.items()}
        stated = {"description": description, "arrays": arrays, "room": len(self._steps)}
        stated = json.dumps(stated).encode()
        # a power of two, with room for the first lines beside the text
        block = max(_LEAST_BLOCK, 1 << (len(stated) + 99).bit_length())
        image = io.BytesIO()
        with h5py.File(image, "w", libver="earliest", userblock_size=block) as file:
            steps = file.create_dataset("steps", self._steps.shape, self._steps.dtype)
            # the first one takes the place of all, which would be twice in memory
            steps[:1] = self._steps[:1]
            self._start = steps.id.get_offset()
        # of both: the place is what the CRC of the text begins with
        numbers = f"{self._start} {len(stated)} {zlib.crc32(stated, self._start)}\n"
        image.seek(0)
        image.write(_FORMAT + numbers.encode() + stated + b"\n")
        with (
            atomic_path(path, error=FitError) as temporary,
            open(temporary, "wb", buffering=0) as stream,
        ):
            for content in (image.getbuffer()[: self._start], self._steps.view(np.uint8)):
                write_bytes(stream.fileno(), content)

    def append(self, coords, log_prob, random_state, accepted):
        """Keep a step; bring the file up to date when it is time."""
        step = self._steps[self.count : self.count + 1]
        before = int(self._steps["crc"][self.count - 1]) if self.count else 0
        self.count += 1
        _, keys, *generator = random_state
        step[0] = (coords, log_prob, accepted, generator, keys, self.count, 0)
        step["crc"] = _crc(step, before)
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
            raise FitError(
                f"{self._file.name}: cannot be written: {one_line(error)}; its first "
                f"{self.saved} steps are safe, the run goes on from there"
            ) from error
        self.saved = self.count


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
    """Return where the steps of a checkpoint begin, for how many it has room, and of which run."""
    if stream.read(len(_FORMAT)) != _FORMAT:
        raise FitError(f"{path}: is not a checkpoint of this version")
    with understood(path, FitError, "the checkpoint is damaged"):
        start, length, crc = map(int, stream.readline(100).split())
        if not (0 <= length < min(start, _LONGEST) and start < os.path.getsize(path)):
            raise ValueError(f"its steps begin at byte {start}, after a text of {length}")
        stated = stream.read(length)
        if zlib.crc32(stated, start) != crc:
            raise ValueError("what it says of the run does not match its CRC")
        stated = json.loads(stated)
        arrays = {key: np.array(values, float) for key, values in stated["arrays"].items()}
        return start, int(stated["room"]), dict(stated["description"]), arrays


def _compare(path, stated, stored, description, arrays):
    """Refuse a checkpoint of another run, and say in what it differs."""
    other = [key for key in description if stated.get(key) != description[key]]
    for key, array in arrays.items():
        # a calibration made anew on another machine may differ in the last digits
        same = key in stored and stored[key].shape == np.shape(array)
        if not (same and np.allclose(stored[key], array, rtol=1e-6, atol=1e-9)):
            other.append(key)
    if other:
        raise FitError(
            f"{path}: is the checkpoint of another run: it differs in {', '.join(other)}; "
            "name another file, or replace it with resume=False"
        )
