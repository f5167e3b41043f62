# Licensed under a 3-clause BSD style license - see LICENSE
"""
Libraries of calibrations: which one holds for a frame.

A library is a folder of calibration files, or some files. Each says for which
instrument, mode, optics in the beam and dates it holds, and of those that hold
the newest is taken. What is ambiguous is an error, never a choice.
"""

import re
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
from astropy.table import Table

from astropolcal import instruments
from astropolcal.calibration.files import read_calibration, write_calibration
from astropolcal.calibration.validity import (
    Validity,
    beam_words,
    content_hash,
    optics_sets,
    optics_words,
    validity_of,
    with_validity,
)
from astropolcal.exceptions import CalibrationFileError, InstrumentError

__all__ = ["Entry", "Library"]

_LOCK = ".lock"


@dataclass(frozen=True, eq=False)
class Entry:
    """
    A file of a library.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file.
    calibration : Calibration
        What it holds.
    validity : Validity
        For what it holds.
    content_hash : str
        See `content_hash`.

    Examples
    --------
    >>> from astropolcal.calibration import Entry
    >>> from astropolcal.calibration import Validity
    >>> Entry("cal.asdf", None, Validity("lab"), "00").validity.instrument
    'lab'
    """

    path: Path
    calibration: object
    validity: Validity
    content_hash: str

    @property
    def name(self):
        """Name of the file."""
        return Path(self.path).name


@lru_cache(maxsize=256)
def _entry(path, modified, size):
    calibration = read_calibration(path)
    return Entry(path, calibration, validity_of(calibration), content_hash(calibration))


class Library:
    """
    Calibration files, looked up by what they hold for.

    Parameters
    ----------
    source : path-like or sequence of path-like
        A folder, whose ``*.asdf`` count, or files.

    Attributes
    ----------
    entries : list of Entry
        The readable files, by instrument and start of validity.
    problems : dict of `~pathlib.Path` to str
        The others, and why.

    Raises
    ------
    CalibrationFileError
        If there is no such folder or file.

    Examples
    --------
    >>> import tempfile
    >>> from astropolcal.calibration import Library
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     len(Library(folder))
    0
    """

    def __init__(self, source):
        one = isinstance(source, (str, Path)) or hasattr(source, "__fspath__")
        self.source = Path(source) if one else None
        self.entries, self.problems = [], {}
        for path in self._files(source):
            try:
                state = path.stat()
                # read again only if the file has changed
                self.entries.append(_entry(path.resolve(), state.st_mtime_ns, state.st_size))
            except (OSError, CalibrationFileError) as error:
                reason = " ".join(str(error).split())
                self.problems[path] = reason.removeprefix(f"{path.resolve()}: ")
        self.entries.sort(key=_order)

    def _files(self, source):
        if self.source is None:
            files = [Path(path) for path in source]
        elif self.source.is_dir():
            return sorted(p for p in self.source.glob("*.asdf") if not p.name.startswith("."))
        else:
            files = [self.source]
        for path in files:
            if not path.exists():
                raise CalibrationFileError(f"{path}: no such file or folder")
        return files

    def __len__(self):
        return len(self.entries)

    def __repr__(self):
        bad = f", {len(self.problems)} unreadable" if self.problems else ""
        return f"<Library {self._label!r}: {len(self)} calibrations{bad}>"

    @property
    def _label(self):
        return "of files" if self.source is None else str(self.source)

    def find(self, instrument=None, *, mode=None, date=None, optics_in=None, beam=None):
        """
        Return the newest calibration that holds.

        Parameters
        ----------
        instrument : str, optional
            Name or alias.
        mode : str, optional
            Mode; case does not matter.
        date : str, `~astropy.time.Time` or date, optional
            When, UTC.
        optics_in : sequence of str, optional
            All optional optics in the beam.
        beam : dict of str to bool, optional
            Single optics that are known to be in the beam or not, such as ``{"nbs": True}``.

        Returns
        -------
        Entry

        Raises
        ------
        CalibrationFileError
            If a file is unreadable, no calibration holds, or several do and the
            choice between them is open: their ranges overlap, or what is left out
            here would decide. The message names the files.
        """
        if self.problems:
            path, reason = next(iter(self.problems.items()))
            raise CalibrationFileError(
                f"{path}: {reason}; as it might be the one that is needed, remove or repair it"
            )
        wanted = {"mode": mode, "optics_in": optics_in, "beam": beam or None, "date": date}
        found = [e for e in self.entries if instrument is None or _same(e, instrument)]
        words = f"no calibration of {instrument}" if instrument else "no calibration"
        for key, value in wanted.items():
            if value is None or not found:
                continue
            kept = [e for e in found if _fits(e.validity, key, value)]
            if not kept:
                # of several reasons the date says most: there is a
                # calibration, but not of that time
                if date is not None and not any(e.validity.holds(date) for e in found):
                    key, value = "date", date
                raise CalibrationFileError(self._lacking(words, key, value, found))
            before, found = found, kept
        if not found:
            raise CalibrationFileError(f"{self._label}: {words}{self._known(self.entries)}")
        newest = self._newest(found, wanted | {"instrument": instrument})
        if date is not None:
            _check_replaced(newest, before, date)
        return newest

    def _lacking(self, words, key, value, found):
        if key == "beam":
            told = f"a beam {beam_words(value)}"
        else:
            told = f"{key} {'+'.join(value) or 'none' if key == 'optics_in' else value}"
        return f"{self._label}: {words} for {told}{self._known(found)}"

    def _known(self, entries):
        if not entries:
            return "; it holds none"
        shown = "; ".join(f"{entry.name} ({entry.validity})" for entry in entries[-4:])
        return f"; there {'is' if len(entries) == 1 else 'are'} {shown}"

    def _newest(self, found, wanted):
        # a copy of a file is no second opinion
        found = sorted({e.content_hash: e for e in reversed(found)}.values(), key=_order)
        for key in ("instrument", "mode", "optics_in"):
            kinds = {getattr(e.validity, key) for e in found}
            if len(kinds) > 1 and wanted[key] is None:
                names = ", ".join(f"{e.name} ({e.validity})" for e in found)
                raise CalibrationFileError(
                    f"{self._label}: {names}: say which {key} is meant", argument=key
                )
        if len(found) > 1 and wanted["date"] is None:
            names = ", ".join(e.name for e in found)
            raise CalibrationFileError(f"{self._label}: {names}: a date is needed to choose")
        *others, newest = found
        for other in others:
            _check_overlap(other, newest)
        return newest

    def add(self, calibration, name=None, **stated):
        """
        Write a calibration into the folder, under a name of its own.

        Parameters
        ----------
        calibration : Calibration
            The calibration.
        name : str, optional
            Name of the file, by default made of instrument, mode, start and hash.
        **stated
            As for `with_validity`.

        Returns
        -------
        `~pathlib.Path`
            The file. A calibration that is there already is not written again.

        Raises
        ------
        CalibrationFileError
            If the library is no folder, a file of the name exists, or the range overlaps with
            that of a calibration in it.
        """
        if self.source is None or not self.source.is_dir():
            raise CalibrationFileError(f"{self._label}: only a folder can be added to")
        calibration = with_validity(calibration, **stated)
        new = Entry(Path("new"), calibration, validity_of(calibration), content_hash(calibration))
        path = self.source / (name or _name(new))
        with _locked(self.source):
            here = Library(self.source)
            for entry in here.entries:
                if entry.content_hash == new.content_hash:
                    return self.source / entry.name
                _check_pair(entry, replace(new, path=path))
            # within the lock, or two writers at once could both find nothing that overlaps
            write_calibration(calibration, path)
            self.__init__(self.source)
        return path

    def overlaps(self):
        """Return a sentence for each pair of different files that claim the same moment."""
        found = []
        for one, other in combinations(self.entries, 2):
            try:
                _check_pair(one, other)
            except CalibrationFileError as error:
                found.append(str(error))
        return found

    def table(self):
        """
        Return one row a readable file: what it holds for, and how good it is.

        Returns
        -------
        `~astropy.table.Table`
            ``name``, ``instrument``, ``mode``, ``valid_from``, ``valid_until``, ``optics_in``,
            ``datasets``, ``s_res`` and ``s_cv`` (median over wavelengths of the worst dataset,
            percent), ``converged``, ``content_hash``.
        """
        rows = []
        for entry in self.entries:
            held, cal = entry.validity, entry.calibration
            rows.append(
                {
                    "name": entry.name,
                    "instrument": held.instrument or "",
                    "mode": held.mode or "",
                    "valid_from": held.valid_from or "",
                    "valid_until": held.valid_until or "",
                    "optics_in": optics_words(held.optics_in).removeprefix("with "),
                    "datasets": ", ".join(record.name for record in cal.datasets),
                    "s_res": _worst_median(cal, "s_res"),
                    "s_cv": _worst_median(cal, "s_cv"),
                    "converged": cal.converged,
                    "content_hash": entry.content_hash,
                }
            )
        return Table(rows=rows)


def _order(entry):
    held = entry.validity
    return (held.instrument or "", held.valid_from or "", str(entry.path))


def _same(entry, instrument):
    stated = entry.validity.instrument
    try:
        return stated is not None and instruments.get(instrument).answers_to(stated)
    except InstrumentError:
        return stated is not None and stated.lower() == str(instrument).lower()


def _fits(validity, key, value):
    if key == "date":
        return validity.holds(value)
    if key == "mode":
        return validity.mode is None or _folded(validity.mode) == _folded(value)
    if key == "beam":
        sets = validity.optics_in
        return sets is None or any(_in_beam(names, value) for names in sets)
    return validity.optics_in is not None and optics_sets(value)[0] in validity.optics_in


def _in_beam(names, beam):
    return all((name in names) == is_in for name, is_in in beam.items())


def _folded(text):
    return " ".join(str(text).split()).casefold()


def _alike(one, other):
    """Return whether two calibrations may hold for the same frame but for its date."""
    modes = None in (one.mode, other.mode) or _folded(one.mode) == _folded(other.mode)
    sets = None in (one.optics_in, other.optics_in) or set(one.optics_in) & set(other.optics_in)
    return one.instrument == other.instrument and modes and bool(sets)


def _check_pair(one, other):
    """Refuse two different files of which some frame could choose neither."""
    # a copy under another name chooses the same
    if one.content_hash == other.content_hash or not _alike(one.validity, other.validity):
        return
    first, second = sorted([one, other], key=_order)
    end = first.validity.valid_until
    # ISO texts in UTC compare as the moments do
    if end is None or end > (second.validity.valid_from or ""):
        _check_overlap(first, second)


def _check_overlap(older, newer):
    """Refuse two that claim a moment both; one without an end makes way for a newer one."""
    first, second = older.validity, newer.validity
    if first.valid_until is None and first.valid_from != second.valid_from:
        return
    raise CalibrationFileError(
        f"{older.name} ({first}) and {newer.name} ({second}) overlap: state until when the "
        "first holds, or remove one of them"
    )


def _check_replaced(entry, others, date):
    """Refuse one without an end that another had replaced which has ended since."""
    held = entry.validity
    if held.valid_until is not None:
        return
    moment = Validity(valid_from=date).valid_from
    for other in others:
        if (held.valid_from or "") < (other.validity.valid_from or "") <= moment:
            raise CalibrationFileError(
                f"no calibration for {moment}: {other.name} ({other.validity}) had replaced "
                f"{entry.name} ({held}) and has ended; state until when that one holds"
            )


def _name(entry):
    held = entry.validity
    parts = [held.instrument, held.mode, (held.valid_from or "")[:10], entry.content_hash[:8]]
    slugs = [re.sub(r"[^A-Za-z0-9.-]+", "-", part).strip("-") for part in parts if part]
    return "_".join(slugs) + ".asdf"


def _worst_median(calibration, key):
    tables = [r.accuracy for r in calibration.datasets if r.accuracy is not None]
    known = [t[key].value[np.isfinite(t[key].value)] for t in tables if key in t.colnames]
    # NaN of a column that no dataset fills: there is no accuracy, not a perfect one
    return max((float(np.median(values)) for values in known if values.size), default=np.nan)


@contextmanager
def _locked(folder):
    """Let one writer at a time look for overlaps; without locks names alone keep files apart."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    try:
        with open(folder / _LOCK, "w", encoding="utf-8") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            yield
    except OSError as error:
        raise CalibrationFileError(f"{folder}: cannot be written: {error.strerror}") from error
