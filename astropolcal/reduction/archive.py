# Licensed under a 3-clause BSD style license - see LICENSE
"""
An archive: the headers of a tree of files, its sequences, and what was done with them.

The index is a SQLite file that is made again where it cannot be read. What was done is a text file
with one line of JSON per sequence, to which lines are appended.
"""

import hashlib
import json
import os
import re
import sqlite3
import warnings
import zlib
from collections import namedtuple
from contextlib import closing, suppress
from datetime import datetime, timedelta
from fnmatch import fnmatchcase
from functools import partial
from itertools import groupby
from pathlib import Path

from astropolcal import instruments
from astropolcal.exceptions import (
    AstropolcalError,
    InstrumentError,
    ObservationError,
    warn,
)
from astropolcal.files import append_line, one_line, read_lines
from astropolcal.fitscheck import primary_header
from astropolcal.pipeline.headers import recognized
from astropolcal.pipeline.store import sha256_of
from astropolcal.pipeline.tasks import ended_tasks
from astropolcal.progress import counting
from astropolcal.reduction.headers import _SUFFIXES, _half_turn, observation_time, read_header

__all__ = []

# of the columns below; another one is made again
_VERSION = 1
_COLUMNS = (
    *("path", "size", "changed", "instrument", "object", "mode"),
    *("mjd", "seconds", "hwp", "number", "problem"),
)
# headers that are read at a time by one process
_BATCH = 64
_DAY = 86400.0


# ---- the index -----------------------------------------------------------------------------------


class Index:
    """
    What the primary headers of all FITS files of a tree say, kept in a file.

    Only files that are new, or whose size or time of change differ, are opened.
    """

    def __init__(self, path):
        self.path = Path(path)
        try:
            self._connect()
        except sqlite3.OperationalError as problem:
            words = "another run works on this archive" if "locked" in str(problem) else problem
            raise AstropolcalError(f"{path}: {words}") from None
        except sqlite3.DatabaseError as problem:
            warn(f"{path}: not a readable index ({problem}); it is made again")
            self._base.close()
            self.path.unlink()
            self._connect()

    def _connect(self):
        if self.path.is_dir():
            raise AstropolcalError(f"{self.path}: is a folder, not an index")
        self._base = sqlite3.connect(self.path, timeout=0.5)
        # for as long as this run: two would do everything twice
        self._base.execute("PRAGMA locking_mode = EXCLUSIVE")
        self._base.execute("BEGIN EXCLUSIVE")
        (words,) = self._base.execute("PRAGMA quick_check(1)").fetchone()
        if words != "ok":
            raise sqlite3.DatabaseError(words)
        (version,) = self._base.execute("PRAGMA user_version").fetchone()
        if version != _VERSION:
            self._base.execute("DROP TABLE IF EXISTS frames")
            self._base.execute(f"PRAGMA user_version = {_VERSION}")
        kinds = f"path TEXT PRIMARY KEY, {', '.join(_COLUMNS[1:])}"
        self._base.execute(f"CREATE TABLE IF NOT EXISTS frames ({kinds})")
        self._base.commit()

    def close(self):
        self._base.close()

    def update(self, tree, *, instrument=None, besides=None, workers=None, cluster=None):
        """
        Bring it up to date with a tree; return the numbers of files, and of those that were read.

        What is in the folder ``besides`` is not looked at. Without ``instrument``, its name, the
        headers say which it is.
        """
        base, keys = self._base, ", ".join(_COLUMNS)
        # what was read for another instrument is read again
        own = zlib.crc32((instrument or "").encode()) & 0x7FFFFFFF
        (before,) = base.execute("PRAGMA application_id").fetchone()
        if before != own:
            base.execute("DELETE FROM frames")
            base.execute(f"PRAGMA application_id = {own}")
            base.commit()
        base.execute("CREATE TEMP TABLE seen (path TEXT PRIMARY KEY, size, changed)")
        with base:
            base.executemany("INSERT INTO seen VALUES (?, ?, ?)", _files(tree, besides))
            base.execute("DELETE FROM frames WHERE path NOT IN (SELECT path FROM seen)")
        (total,) = base.execute("SELECT count(*) FROM seen").fetchone()
        if not total:
            raise ObservationError(f"{tree}: no FITS file in this folder or those inside")
        rows = base.execute(
            "SELECT seen.* FROM seen LEFT JOIN frames USING (path) WHERE frames.path IS NULL "
            "OR frames.size != seen.size OR frames.changed != seen.changed ORDER BY path"
        ).fetchall()
        n_read, reader = len(rows), partial(_read_headers, instrument)
        batches = (rows[i : i + _BATCH] for i in range(0, n_read, _BATCH))
        given = {"workers": workers, "cluster": cluster, "preload": [__name__]}
        put = f"INSERT OR REPLACE INTO frames ({keys}) VALUES ({', '.join('?' * len(_COLUMNS))})"
        ended = ended_tasks(reader, batches, **given)
        with closing(ended), counting(total, "headers", total - n_read) as add:
            for each in ended:
                found = each.result
                if each.reason is not None:
                    # its process died
                    lost = [_row(file) | {"problem": each.reason} for file in each.task]
                    found = [tuple(row.values()) for row in lost]
                with base:
                    base.executemany(put, found)
                add(len(each.task))
        base.execute("DROP TABLE seen")
        return total, n_read

    def problems(self):
        """Yield path and reason of the files that belong to no sequence."""
        yield from self._base.execute(
            "SELECT path, problem FROM frames WHERE problem IS NOT NULL ORDER BY path"
        )

    def sequences(self, *, gap, cycles=None, target=None):
        """Yield the sequences, `Sequence`, one after the other, however many there are.

        Frames of one instrument, object and mode that follow each other within ``gap`` seconds;
        no more than so many ``cycles`` of the half-wave plate. ``target`` is a pattern for the
        object, such as ``HD*``.
        """
        rows = self._base.cursor().execute(
            f"SELECT {', '.join(_COLUMNS[:-1])} FROM frames WHERE problem IS NULL "
            "ORDER BY instrument, object, mode, mjd IS NULL, mjd, number, path"
        )
        taken, pattern = set(), re.sub(r"[\s_]", "", target or "*").casefold()
        for (instrument, name, mode), group in groupby(map(_Frame._make, rows), _Frame.kind):
            if not fnmatchcase(name or "", pattern):
                continue
            for frames in _cut(group, gap / _DAY, cycles):
                words = (instrument, name or "unnamed", mode, frames[0].moment)
                text = "_".join(re.sub(r"[^A-Za-z0-9+-]+", "-", str(w)) for w in words if w)
                unique, count = text, 1
                while unique in taken:
                    unique, count = f"{text}_{count + 1}", count + 1
                taken.add(unique)
                yield Sequence(unique, instrument, name, mode, frames)


def _files(tree, besides):
    """Yield path, size and time of change of the FITS files of a tree."""
    avoid = None if besides is None else os.path.realpath(besides)
    for folder, inside, names in os.walk(tree):
        inside[:] = [n for n in inside if os.path.realpath(os.path.join(folder, n)) != avoid]
        for name in names:
            if name.lower().endswith(_SUFFIXES) and not name.startswith("."):
                path = os.path.join(folder, name)
                with suppress(OSError):
                    state = os.stat(path)
                    yield os.path.abspath(path), state.st_size, state.st_mtime_ns


def _read_headers(instrument, files):
    """Return the rows of the index of some files."""
    # once for all files: plug-ins are looked for on the disk
    known = list(map(instruments.get, [instrument] if instrument else instruments.names()))
    rows = []
    for file in files:
        row = _row(file)
        try:
            row |= _values(known, row["path"])
        except AstropolcalError as problem:
            row["problem"] = one_line(str(problem).removeprefix(f"{row['path']}: "), None)
        rows.append(tuple(row.values()))
    return rows


def _row(file):
    """Return a row of the index that says nothing yet."""
    return dict.fromkeys(_COLUMNS) | dict(zip(("path", "size", "changed"), file, strict=True))


def _values(known, path):
    """Return what the header of a file says, which is of one of some instruments."""
    header = primary_header(path)
    if "CALHASH" in header and "POLCONV" in header:
        raise ObservationError("a corrected product of this package, not a frame")
    found = known[0] if len(known) == 1 else recognized(header, known)
    with suppress(InstrumentError):
        # which keyword holds the mode may depend on the mode
        found = found.configured(header)
    if found.files is None:
        raise InstrumentError(f"{found.name}: it is not known how its files look")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frame = read_header(path, found.files, header=header)
    values, moment = frame.values, None
    with suppress(ObservationError):
        moment = float(observation_time(values).mjd)
    name = re.sub(r"[^\w+-]|_", "", values.get("object") or "").casefold()
    return {
        "instrument": found.name,
        "object": name or None,
        "mode": values.get("filter"),
        "mjd": moment,
        "seconds": values.get("exposure_time", 0.0) * values.get("exposures", 1.0),
        "hwp": values.get("hwp"),
        "number": frame.number,
    }


# ---- sequences -----------------------------------------------------------------------------------


class _Frame(namedtuple("_Frame", _COLUMNS[:-1])):
    """A row of the index."""

    __slots__ = ()

    def kind(self):
        return self.instrument, self.object, self.mode

    @property
    def moment(self):
        """What tells a sequence from the others: when it began, else a number or a name."""
        if self.mjd is None:
            return Path(self.path).stem if self.number is None else f"{self.number:08d}"
        moment = datetime(1858, 11, 17) + timedelta(milliseconds=round(self.mjd * 1e3 * _DAY))
        return moment.strftime("%Y%m%dT%H%M%S")


class Sequence(namedtuple("Sequence", "name instrument target mode frames")):
    """Frames that are worked on together."""

    __slots__ = ()

    @property
    def files(self):
        """Their paths."""
        return [frame.path for frame in self.frames]

    def key(self, settings):
        """Return what a result depends on, in short: files and settings."""
        text = json.dumps([[(f.path, f.size, f.changed) for f in self.frames], settings])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _cut(frames, gap, cycles):
    """Yield lists of frames, cut where there is a gap in time, and after some cycles."""
    part, end, count, seen = [], None, 1, []
    for frame in frames:
        # of which night a frame without a time is, nobody knows
        late = end is not None and (frame.mjd is None or frame.mjd - end > gap)
        known = frame.hwp is not None
        # degree; two commanded angles that differ by less are one
        same = [known and abs(_half_turn(frame.hwp - other)) < 0.3 for other in seen]
        if any(same[:-1]):
            # an angle that was there before the last one begins another cycle
            count, seen, same = count + 1, [], []
        if part and (late or (cycles and count > cycles)):
            yield part
            part, end, count, seen, same = [], None, 1, [], []
        part.append(frame)
        if known and not any(same[-1:]):
            seen.append(frame.hwp)
        if frame.mjd is not None:
            end = frame.mjd + (frame.seconds or 0.0) / _DAY
    if part:
        yield part


# ---- what was done -------------------------------------------------------------------------------


class Manifest:
    """
    What became of each sequence, in lines of JSON that are appended as sequences end.

    The last line of a sequence counts. A line that was cut off is ignored.
    """

    def __init__(self, path):
        self.path = Path(path)
        named, advice = (lambda e: (str(e["name"]), e)), "take another folder"
        entries, n_bad = read_lines(path, named, "a manifest", advice=advice)
        self.entries = dict(entries)
        if n_bad > 0:
            warn(f"{path}: {n_bad} of its lines cannot be read; their sequences are done again")

    def add(self, entry):
        """Write down what became of a sequence."""
        append_line(self.path, json.dumps(entry), AstropolcalError)
        self.entries[entry["name"]] = entry

    def state(self, name, key, source=None):
        """
        Return "done" or "failed" of a sequence of such files and settings, else "".

        A product is "older" that was made when the ``source`` of calibrations was another one, and
        what failed then is tried again.
        """
        entry = self.entries.get(name)
        if entry is None or entry.get("key") != key:
            return ""
        if entry.get("state") != "done":
            return "failed" if entry.get("source") == source else ""
        product = self.path.parent / str(entry.get("product"))
        # a name may be one that no system takes
        with suppress(OSError, ValueError):
            state = os.stat(product)
            same = state.st_mtime_ns == entry.get("changed")
            # a copy has another time, and the same content
            if state.st_size == entry.get("size") and (
                same or sha256_of(product) == entry.get("sha256")
            ):
                return "done" if entry.get("source") == source else "older"
        return ""
