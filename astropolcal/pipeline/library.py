# Licensed under a 3-clause BSD style license - see LICENSE
"""Libraries of calibrations: which one holds for a frame.

A library is a folder of calibration files, or some files. Each says for which
instrument, mode, optics in the beam and dates it holds, and of those that hold
the newest is taken. What is ambiguous is an error, never a choice.

An index beside the files of a folder tells what each holds for, so that a look-up reads one file of
many. It only proposes: what is chosen is read, and has to be what the index says.
"""

import errno
import fnmatch
import hashlib
import json
import os
import re
import stat
import time
from collections.abc import Iterable
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import entry_points
from itertools import islice, pairwise
from operator import attrgetter
from pathlib import Path, PureWindowsPath

import numpy as np
from astropy.table import Table

from astropolcal import instruments
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.result.calibration import (
    Validity,
    _moment,
    beam_words,
    folded,
    optics_sets,
    optics_words,
    validity_of,
    with_validity,
)
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.calibration.validation.targets import keep_sky_accuracy
from astropolcal.converters.calibration import content_hash
from astropolcal.converters.files import read_calibration, write_calibration
from astropolcal.exceptions import CalibrationFileError, warn
from astropolcal.files import atomic_path, check_kind, one_line
from astropolcal.pipeline.headers import date_of
from astropolcal.pipeline.store import contexts, export, freeze, frozen
from astropolcal.version import version as our_version
from astropolcal.words import check_type, listed

__all__ = ["Entry", "Library"]

_LOCK, _INDEX, _INDEX_VERSION = ".lock", ".astropolcal-index.json", 2
# of the index for each file of the folder; 500 are usual
_MOST_BYTES = 16_384
# nanoseconds; a younger file may change once more within the same tick of its file system's clock
_SETTLED = 2_000_000_000
_LONGEST_NAME, _LONGEST_SLUG, _MOST_SHOWN = 255, 60, 4
_CHOSEN = "chosen: the newest that holds"
# by more standard errors calibrations of the same optics differ, of which so many are compared
_MOVED, _NEAREST = 5.0, 5
# by how many differences: quantiles of Student's t, with which one error holds 68 of 100 cases
_FEW = (1.84, 1.32, 1.20, 1.14)
# what the index keeps of how good a calibration is
_QUALITY = {"datasets": str, "s_res": float | None, "s_cv": float | None, "converged": bool}


class Entry:
    """
    A file of a library.

    Parameters
    ----------
    path : `~pathlib.Path`
        The file.
    calibration : Calibration or None
        What it holds; None to read it when it is asked for.
    validity : ``Validity``
        For what it holds.
    content_hash : str
        SHA-256 of all that the file keeps.
    supersedes : sequence of str
        The ``content_hash`` of those that it replaces.

    Examples
    --------
    >>> from astropolcal.pipeline import Entry
    >>> from astropolcal.calibration.result.calibration import Validity
    >>> Entry("cal.asdf", None, Validity("lab"), "00").validity.instrument
    'lab'
    """

    def __init__(self, path, calibration, validity, content_hash, supersedes=()):
        self.path, self.validity, self.content_hash = path, validity, content_hash
        self.supersedes = tuple(supersedes)
        self._calibration, self._quality = calibration, None

    def __repr__(self):
        return f"<Entry {self.name}: {self.validity}>"

    @property
    def name(self):
        """Name of the file."""
        return Path(self.path).name

    @property
    def calibration(self):
        """What the file holds; an error if that is not what the entry says."""
        if self._calibration is not None:
            return self._calibration
        path = Path(self.path)
        try:
            calibration, record = _read(path, _state(path))
        except OSError as error:
            raise CalibrationFileError(f"{path}: {error.strerror}") from error
        told = {"validity": self.validity.to_dict(), "content_hash": self.content_hash}
        told["supersedes"] = list(self.supersedes)
        if told != {key: record[key] for key in told}:
            raise CalibrationFileError(
                f"{path}: holds something else than when the library was read; read the library "
                f"again, and delete {_INDEX} in it if that does not help"
            )
        self._calibration = calibration
        return calibration


class Library:
    """
    Calibration files, looked up by what they hold for.

    Parameters
    ----------
    source : path-like or sequence of path-like
        A folder, whose ``*.asdf`` count, or files.
    context : str, optional
        Name of a context of the folder, see `freeze`: its files only, as they were.

    Attributes
    ----------
    entries : list of Entry
        The readable files, by instrument and start of validity.
    problems : dict of `~pathlib.Path` to str
        The others, and why.

    Notes
    -----
    What the files of a folder hold for is kept in ``.astropolcal-index.json`` beside them, and only
    files that have changed are read again. A folder that cannot be written to does without.

    Raises
    ------
    CalibrationFileError
        If there is no such folder, file or context, or a file of the context is missing or altered.

    Examples
    --------
    >>> from astropolcal.pipeline import Library
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     len(Library(folder))
    0
    """

    def __init__(self, source, context=None):
        one = isinstance(source, (str, Path)) or hasattr(source, "__fspath__")
        if not one:
            wanted = "a folder, a file or several are needed"
            check_type("the source of calibrations", source, Iterable, wanted, CalibrationFileError)
        self.source = Path(source) if one else None
        if context is not None:
            if not one or not self.source.is_dir():
                raise CalibrationFileError(f"context {context}: only a folder has contexts")
            source, one = frozen(self.source, context), False
        self.context = context
        self._files = [self.source] if one else [Path(path) for path in source]
        for path in self._files:
            # os.path answers where pathlib raises: the name may be one that no system takes
            if not os.path.exists(path):
                raise CalibrationFileError(f"{one_line(path)}: no such file or folder")
            check_kind(path, CalibrationFileError)
        self._scan()

    @property
    def _folder(self):
        whole = self.source is not None and self.context is None
        return self.source if whole and self.source.is_dir() else None

    def _scan(self, believe=True):
        """Look through the files; those that the index knows are not read."""
        folder = self._folder
        files = [(p, p.resolve()) for p in self._files] if folder is None else _files_of(folder)
        index = _read_index(folder, len(files)) if folder is not None and believe else {}
        self.entries, self.problems, known = [], {}, {}
        for path, target in files:
            try:
                state, record = _state(target), index.get(path.name)
                entry = _entry(target, record, state)
                if entry is None:
                    record = _read(target, state)[1]
                    entry = _entry(target, record, state)
                    if not state[-1] or len(json.dumps(record)) > _MOST_BYTES:
                        # it may change yet, or tells too much for the index
                        record = None
            except (OSError, CalibrationFileError) as error:
                reason = " ".join(str(error).split())
                self.problems[path] = reason.removeprefix(f"{target}: ")
                continue
            self.entries.append(entry)
            if record is not None:
                known[path.name] = record
        self.entries.sort(key=_order)
        if folder is not None and known != index:
            _write_index(folder, known)

    def _confirmed(self, choose):
        """Return the entry that is chosen when its file is what the entry says, or None."""
        # the file may have changed since, and after that the index may be wrong
        for believe in (True, False, None):
            entry = choose()
            try:
                if entry is not None:
                    entry.calibration  # noqa: B018
                return entry
            except CalibrationFileError:
                if believe is None:
                    raise
                self._scan(believe)

    def __len__(self):
        return len(self.entries)

    def __repr__(self):
        bad = f", {len(self.problems)} unreadable" if self.problems else ""
        return f"<Library {self._label!r}: {len(self)} calibrations{bad}>"

    @property
    def _label(self):
        inside = f", context {self.context}" if self.context else ""
        return "of files" if self.source is None else f"{self.source}{inside}"

    def _in_force(self):
        """Return the entries that no other one supersedes."""
        gone = {digest for entry in self.entries for digest in entry.supersedes}
        return [entry for entry in self.entries if entry.content_hash not in gone]

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
        wanted = {"mode": mode, "optics_in": optics_in, "beam": beam or None, "date": date}
        return self._confirmed(lambda: self._choice(instrument, wanted))

    def _choice(self, instrument, wanted):
        self._check_readable("as it might be the one that is needed, remove or repair it")
        found, date = _of_instrument(self._in_force(), instrument), wanted["date"]
        # once, as it takes longer than to compare
        moment = _moment(date, "date")
        words = f"no calibration of {instrument}" if instrument else "no calibration"
        if not found:
            raise CalibrationFileError(f"{self._label}: {words}{_known(self.entries)}")
        for key, value in wanted.items():
            if value is None:
                continue
            fitting = moment if key == "date" else value
            kept = [e for e in found if _fits(e.validity, key, fitting)]
            if not kept:
                # of several reasons the date says most: there is a
                # calibration, but not of that time
                if date is not None and not any(e.validity.holds(moment) for e in found):
                    key, value = "date", date
                shown = "+".join(value) or "none" if key == "optics_in" else value
                told = f"a beam {beam_words(value)}" if key == "beam" else f"{key} {shown}"
                raise CalibrationFileError(f"{self._label}: {words} for {told}{_known(found)}")
            before, found = found, kept
        newest = self._newest(found, wanted | {"instrument": instrument})
        if date is not None:
            _check_replaced(newest, before, moment)
        return newest

    def _check_readable(self, advice):
        for path, reason in self.problems.items():
            raise CalibrationFileError(f"{path}: {reason}; {advice}")

    def _newest(self, found, wanted):
        # a copy of a file is no second opinion
        found = sorted({e.content_hash: e for e in reversed(found)}.values(), key=_start)
        for key in ("instrument", "mode", "optics_in"):
            kinds = {getattr(e.validity, key): e for e in reversed(found)}
            if len(kinds) > 1 and wanted[key] is None:
                # one of each kind is enough to choose by
                some = sorted(kinds.values(), key=_order)
                names = listed([f"{e.name} ({e.validity})" for e in some], most=_MOST_SHOWN)
                raise CalibrationFileError(
                    f"{self._label}: {names}: say which {key} is meant", argument=key
                )
        if len(found) > 1 and wanted["date"] is None:
            names = listed([e.name for e in found], most=_MOST_SHOWN)
            raise CalibrationFileError(f"{self._label}: {names}: a date is needed to choose")
        *others, newest = found
        for other in others:
            if _meet(other, newest):
                raise CalibrationFileError(_overlap(other, newest))
        return newest

    def _with_changes(self, chosen):
        """Return an entry with what changes between calibrations in its covariance, and warn of it.

        Each of the nearest in time is compared with the next. The mean square of the changes that
        are beyond the errors of both is what a frame after one of them has to expect.
        """
        calibration, beside = chosen.calibration, self._beside(chosen)
        same = [
            e for e in beside if np.array_equal(e.calibration.wavelength, calibration.wavelength)
        ]
        changes = [_change(*pair) for pair in pairwise(same)]
        told = [words for words, _ in changes if words]
        if not told:
            return chosen
        warn(
            f"{listed(told, most=2)} standard errors: what changes from one calibration to the "
            f"next is among the errors of {chosen.name} (astropolcal health says what changed)",
            stacklevel=3,
        )
        # samples of a posterior know of no other calibration
        covariance = full_covariance(calibration)
        shifts = [[shift.get(name, 0.0) for name in covariance.names] for _, shift in changes]
        count = len(shifts)
        covariance = covariance.beside(_FEW[count - 1] * np.array(shifts) / np.sqrt(count))
        found = copy(chosen)
        found._calibration = keep_sky_accuracy(
            replace(calibration, covariance=covariance, fit=dict(calibration.fit), posterior=None)
        )
        return found

    def _beside(self, chosen):
        """Return the entries nearest to one in time, of the same instrument, mode and optics."""
        kind = attrgetter("validity.instrument", "validity.mode", "validity.optics_in")
        same = sorted((e for e in self._in_force() if kind(e) == kind(chosen)), key=_start)
        k = [e.name for e in same].index(chosen.name)
        first = min(max(k - _NEAREST // 2, 0), max(len(same) - _NEAREST, 0))
        return same[first : first + _NEAREST]

    def explain(self, instrument=None, *, mode=None, date=None, optics_in=None, beam=None):
        """
        Return which calibration `find` chooses, and why none of the others.

        Parameters
        ----------
        instrument, mode, date, optics_in, beam
            As for `find`.

        Returns
        -------
        `~astropy.table.Table`
            One row per file, the chosen one first: ``name``, ``holds`` (for what), ``why`` it is
            chosen or not. Where `find` raises, its words are in ``meta["problem"]``.
        """
        wanted = {"mode": mode, "optics_in": optics_in, "beam": beam or None, "date": date}
        problem, chosen = "", None
        try:
            chosen = self._confirmed(lambda: self._choice(instrument, wanted))
        except CalibrationFileError as error:
            problem = str(error)
        rows = [
            (entry.name, str(entry.validity), self._why(entry, chosen, instrument, wanted))
            for entry in self.entries
        ]
        rows += [(path.name, "", f"unreadable: {why}") for path, why in self.problems.items()]
        rows.sort(key=lambda row: row[2] != _CHOSEN)
        table = Table(rows=rows or None, names=("name", "holds", "why"), dtype=(str, str, str))
        table.meta["problem"] = problem
        return table

    def _why(self, entry, chosen, instrument, wanted):
        """Return why a calibration is chosen or not, the first reason in the order of `find`."""
        if entry is chosen:
            return _CHOSEN
        held, moment = entry.validity, _moment(wanted["date"], "date")
        for other in self.entries:
            if entry.content_hash in other.supersedes:
                return f"superseded by {other.name}"
        if not _of_instrument([entry], instrument):
            return f"of {held.instrument or 'an unknown instrument'}"
        for key in ("mode", "optics_in", "beam"):
            if wanted[key] is not None and not _fits(held, key, wanted[key]):
                return f"of mode {held.mode}" if key == "mode" else optics_words(held.optics_in)
        if moment is not None and not held.holds(moment):
            begins = held.valid_from is not None and moment < held.valid_from
            return f"begins {held.valid_from}" if begins else f"ended {held.valid_until}"
        if chosen is None:
            return "holds, but the choice is open"
        if entry.content_hash == chosen.content_hash:
            return f"a copy of {chosen.name}"
        return f"replaced by {chosen.name}"

    def freeze(self, name):
        """
        Keep what the folder holds now as a context, which stays as it is.

        Parameters
        ----------
        name : str
            Of the context: letters, digits, and . _ -

        Returns
        -------
        `~pathlib.Path`
            The file of the context, beside the calibrations.

        Raises
        ------
        CalibrationFileError
            If the library is not a folder, holds nothing or something unreadable, or there is such
            a context.
        """
        if self._folder is None:
            raise CalibrationFileError(f"{self._label}: only a folder can be frozen")
        with _locked(self.source):
            self._scan()
            self._check_readable("remove or repair it")
            return freeze(self.source, name, [path for path, _ in _files_of(self.source)])

    @property
    def contexts(self):
        """Names of the contexts of the folder."""
        return [] if self.source is None else contexts(self.source)

    def export(self, context, path):
        """
        Write a context and its calibrations as one archive, for `import_context`.

        Parameters
        ----------
        context : str
            Its name.
        path : path-like
            A new file, with suffix ``.zip``.

        Returns
        -------
        `~pathlib.Path`
            The file.

        Raises
        ------
        CalibrationFileError
            If there is no such context, a file of it is missing or altered, or the archive exists.
        """
        if self.source is None:
            raise CalibrationFileError(f"{self._label}: only a folder has contexts")
        return export(self.source, context, path)

    def add(self, calibration, name=None, *, supersedes=(), **stated):
        """
        Write a calibration into the folder, under a name of its own.

        Parameters
        ----------
        calibration : Calibration
            The calibration.
        name : str, optional
            Name of the file, with suffix ``.asdf``; by default it is made of instrument, mode,
            start and hash.
        supersedes : sequence of str
            Names of files that it replaces from now on, for all dates. They stay in the folder,
            and in the contexts that have them.
        **stated
            As for ``with_validity``.

        Returns
        -------
        `~pathlib.Path`
            The file. A calibration that is there already is not written again, nor renamed.

        Warns
        -----
        AstropolcalWarning
            If it is there already under another name than the one given.

        Raises
        ------
        CalibrationFileError
            If the library is not a folder, the name is not that of a file in it, a file of the name
            exists, or the range overlaps with that of a calibration in it.
        """
        if self._folder is None:
            raise CalibrationFileError(f"{self._label}: only a folder can be added to")
        calibration = with_validity(calibration, **stated)
        with _locked(self.source):
            self._scan()
            calibration, gone = self._superseding(calibration, supersedes)
            held, digest = validity_of(calibration), content_hash(calibration)
            path = self.source / _file_name(name, held, digest)
            new = Entry(path, calibration, held, digest, gone)
            same = self._confirmed(
                lambda: next((e for e in self.entries if e.content_hash == digest), None)
            )
            if same is not None:
                if name not in (None, same.name):
                    warn(
                        f"name = {name!r}: the calibration is there already, as {same.name}; "
                        "nothing is written"
                    )
                return self.source / same.name
            others = [entry for entry in self._in_force() if entry.content_hash not in gone]
            for pair in (sorted([entry, new], key=_order) for entry in others):
                # of which some frame could choose neither
                if _differ(*pair) and _meet(*pair):
                    raise CalibrationFileError(_overlap(*pair))
            # within the lock, or two writers at once could both find nothing that overlaps
            write_calibration(calibration, path)
            self._scan()
        return path

    def _superseding(self, calibration, names):
        """Return a calibration that says which ones it supersedes, and these."""
        if not names:
            return calibration, supersedes_of(calibration)
        names = [names] if isinstance(names, str) else names
        known = {entry.name: entry.content_hash for entry in self.entries}
        for name in names:
            if name not in known:
                raise CalibrationFileError(
                    f"supersedes: no {one_line(repr(name))} in {self._label}", argument="supersedes"
                )
        gone = sorted({known[name] for name in names})
        settings = calibration.settings | {"supersedes": gone}
        return replace(calibration, settings=settings), tuple(gone)

    def overlaps(self):
        """Return a sentence for each pair of different files that claim the same moment."""
        found, entries = [], sorted(self._in_force(), key=_order)
        for i, first in enumerate(entries):
            name = first.validity.instrument
            for second in islice(entries, i + 1, None):
                # in the order of instruments and starts: none that follows meets it either
                if second.validity.instrument != name or not _meet(first, second):
                    break
                if _differ(first, second):
                    found.append(_overlap(first, second))
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
            held, good = entry.validity, entry._quality or _quality(entry.calibration)
            stated = ("instrument", "mode", "valid_from", "valid_until")
            row = {"name": entry.name} | {key: getattr(held, key) or "" for key in stated}
            row["optics_in"] = optics_words(held.optics_in).removeprefix("with ")
            row |= {key: np.nan if value is None else value for key, value in good.items()}
            rows.append(row | {"content_hash": entry.content_hash})
        return Table(rows=rows)


def _order(entry):
    return (entry.validity.instrument or "", *_start(entry))


def _start(entry):
    return (entry.validity.valid_from or "", str(entry.path))


def _change(first, second):
    """Say by how much a calibration differs from the next, if that is beyond the errors of both.

    And return the difference of the parameters of optics that changed, but for those renewed
    between the two, of which no frame after that has to expect as much again.
    """
    # what compares is not needed to choose
    from astropolcal.pipeline.history import moved, shift

    pair = first.calibration, second.calibration
    known, days = known_instrument(pair[0].instrument), [date_of(one) or "" for one in pair]
    renewed = {
        optic
        for optic, begin, end, _ in (known.changes if known else ())
        if min(days) < end and max(days) >= begin
    }
    optics = {key: by for key, by in moved(*pair).items() if key not in renewed}
    by = optics.pop("", 0.0)
    if renewed:
        # it may be all that differs
        by = max(optics.values(), default=0.0)
    if None in renewed or not by > _MOVED:
        return "", {}
    most = max(optics, key=optics.get)
    own = [optic for optic in optics if optics[optic] > _MOVED] or [*optics]
    words = f"{first.name} differs from {second.name} by {by:.0f} ({most} by {optics[most]:.0f})"
    return words, {n: x for n, x in shift(*pair).items() if n.partition(".")[0] in own}


def _of_instrument(entries, instrument):
    if instrument is None:
        return entries
    names = {entry.validity.instrument for entry in entries} - {None}
    known, own = known_instrument(instrument), str(instrument).lower()
    same = {name for name in names if (known.answers_to(name) if known else name.lower() == own)}
    return [entry for entry in entries if entry.validity.instrument in same]


def _fits(validity, key, value):
    if key == "date":
        return validity.holds(value)
    if key == "mode":
        return validity.mode is None or folded(validity.mode) == folded(value)
    if key == "beam":
        sets = validity.optics_in
        return sets is None or any(
            all((name in names) == is_in for name, is_in in value.items()) for names in sets
        )
    return validity.optics_in is not None and optics_sets(value)[0] in validity.optics_in


def _differ(first, second):
    """Return whether two are different ones, of which some frame could choose either."""
    one, other = first.validity, second.validity
    modes = None in (one.mode, other.mode) or folded(one.mode) == folded(other.mode)
    sets = None in (one.optics_in, other.optics_in) or set(one.optics_in) & set(other.optics_in)
    # a copy under another name chooses the same
    copied = first.content_hash == second.content_hash
    return not copied and one.instrument == other.instrument and modes and bool(sets)


def _meet(first, second):
    """Return whether two claim a moment both; one without an end makes way for a newer one."""
    older, newer = first.validity, second.validity
    if older.valid_until is None:
        return older.valid_from == newer.valid_from
    # ISO texts in UTC compare as the moments do
    return older.valid_until > (newer.valid_from or "")


def _overlap(older, newer):
    return (
        f"{older.name} ({older.validity}) and {newer.name} ({newer.validity}) overlap: state "
        "until when the first holds, or remove one of them"
    )


def _check_replaced(entry, others, moment):
    """Refuse one without an end that another had replaced which has ended since."""
    held = entry.validity
    if held.valid_until is not None:
        return
    for other in others:
        if (held.valid_from or "") < (other.validity.valid_from or "") <= moment:
            raise CalibrationFileError(
                f"no calibration for {moment}: {other.name} ({other.validity}) had replaced "
                f"{entry.name} ({held}) and has ended; state until when that one holds"
            )


def _known(entries):
    if not entries:
        return "; it holds none"
    shown = "; ".join(f"{entry.name} ({entry.validity})" for entry in entries[-_MOST_SHOWN:])
    return f"; there {'is' if len(entries) == 1 else 'are'} {shown}"


def _file_name(name, held, digest):
    """Return the name of a file to add, refused where it leads out of the folder or is hidden."""
    if name is None:
        parts = [held.instrument, held.mode, (held.valid_from or "")[:10], digest[:8]]
        slugs = [re.sub(r"[^A-Za-z0-9.-]+", "-", part)[:_LONGEST_SLUG] for part in parts if part]
        return "_".join(slug.strip("-.") for slug in slugs) + ".asdf"
    good = (
        isinstance(name, str)
        # of another system too: a library may be copied there
        and PureWindowsPath(name).name == name
        and name.isprintable()
        and len(os.fsencode(name)) <= _LONGEST_NAME
        and name.endswith(".asdf")
        and not name.startswith(".")
    )
    if not good:
        raise CalibrationFileError(
            f"name = {one_line(repr(name))} cannot be added: allowed are names of files without "
            f"folder or leading dot, of at most {_LONGEST_NAME} bytes, with suffix .asdf",
            argument="name",
        )
    return name


# ---- the index ---------------------------------------------------------------------------


def _files_of(folder):
    """Return the calibration files of a folder, each with where it really is."""
    try:
        with os.scandir(folder) as found:
            links = {file.name: file.is_symlink() for file in found if file.name[0] != "."}
    except OSError as error:
        raise CalibrationFileError(f"{folder}: cannot be read: {error.strerror}") from error
    root = folder.resolve()
    # to resolve each of them would take longer than all the rest
    return [
        (folder / name, (root / name).resolve() if links[name] else root / name)
        for name in sorted(fnmatch.filter(links, "*.asdf"))
    ]


def _state(path):
    """Return by what a change of a file is noticed, and whether any change from now on is."""
    told = os.stat(path)
    settled = time.time_ns() - max(told.st_mtime_ns, told.st_ctime_ns) > _SETTLED
    # size and time of change stay where a copy with old times is put in its place
    return (told.st_size, told.st_mtime_ns, told.st_ctime_ns, told.st_ino, settled)


@lru_cache(maxsize=256)
def _read(path, state):
    """Return a calibration, and what the index keeps of a file in this state."""
    calibration = read_calibration(path)
    return calibration, {
        "state": list(state),
        "validity": validity_of(calibration).to_dict(),
        "content_hash": content_hash(calibration),
        "supersedes": list(supersedes_of(calibration)),
        "quality": _quality(calibration),
    }


def supersedes_of(calibration):
    """Return the hashes of those that a calibration supersedes."""
    gone = calibration.settings.get("supersedes") or ()
    if isinstance(gone, str) or not all(isinstance(digest, str) for digest in gone):
        raise CalibrationFileError(f"supersedes = {gone!r}; hashes of calibrations are needed")
    return tuple(gone)


def _quality(calibration):
    tables = [r.accuracy for r in calibration.datasets if r.accuracy is not None]
    found = {"datasets": ", ".join(record.name for record in calibration.datasets)}
    for key in ("s_res", "s_cv"):
        known = [t[key].value[np.isfinite(t[key].value)] for t in tables if key in t.colnames]
        # None of a column that no dataset fills: there is no accuracy, not a perfect one
        medians = (float(np.median(values)) for values in known if values.size)
        found[key] = max(medians, default=None)
    return found | {"converged": bool(calibration.converged)}


def _entry(path, record, state):
    """Return the entry that a record tells of; None if it is of another state, or not valid."""
    try:
        quality, held = record["quality"], Validity(**record["validity"])
        sound = [isinstance(quality[key], kind) for key, kind in _QUALITY.items()]
        sound += [isinstance(held.instrument, str | None), isinstance(record["content_hash"], str)]
        gone = record["supersedes"]
        sound += [isinstance(gone, list), all(isinstance(digest, str) for digest in gone)]
        if record["state"] != list(state) or not all(sound):
            return None
    except (LookupError, TypeError, CalibrationFileError):
        return None
    entry = Entry(path, None, held, record["content_hash"], gone)
    entry._quality = quality
    return entry


def _read_index(folder, n_files):
    """Return what the index tells of each file; nothing if it is damaged or of other software."""
    most = _MOST_BYTES * (n_files + 1)
    try:
        with os.fdopen(_open_plain(folder / _INDEX, os.O_RDONLY), "rb") as stream:
            content = stream.read(most + 1)
        index = json.loads(content) if len(content) <= most else {}
        files = index["files"]
        return files if isinstance(files, dict) and index == _index(files) else {}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return {}


def _write_index(folder, files):
    """Write the index where that is possible; without one, all files are read each time."""
    path = folder / _INDEX
    with suppress(OSError, CalibrationFileError):
        # what somebody put there is left alone
        if not os.path.lexists(path) or stat.S_ISREG(os.lstat(path).st_mode):
            with atomic_path(path, error=CalibrationFileError) as temporary:
                temporary.write_text(json.dumps(_index(files)), encoding="ascii")


def _index(files):
    content = json.dumps(files, sort_keys=True).encode("ascii")
    # what decides, besides the files, for what they hold
    known = {*instruments._REGISTRY, *(name for name, *_ in _plugins())}
    return {
        "version": _INDEX_VERSION,
        "software": [our_version, sorted(known), [list(plugin) for plugin in _plugins()]],
        "sha256": hashlib.sha256(content).hexdigest(),
        "files": files,
    }


@lru_cache(maxsize=1)
def _plugins():
    points = entry_points(group="astropolcal.instruments")
    return sorted((p.name, p.value, p.dist.version if p.dist else "") for p in points)


def _open_plain(path, flags):
    """Open a regular file, never what a link leads to, and wait for nothing."""
    for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC"):
        flags |= getattr(os, name, 0)
    number = os.open(path, flags, 0o666)
    if not stat.S_ISREG(os.fstat(number).st_mode):
        os.close(number)
        raise OSError(errno.EINVAL, "it is not a regular file")
    return number


@contextmanager
def _locked(folder):
    """Let one writer at a time look for overlaps; without locks names alone keep files apart."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    path = folder / _LOCK
    try:
        with os.fdopen(_open_plain(path, os.O_RDWR | os.O_CREAT | os.O_APPEND), "ab") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            yield
    except OSError as error:
        if os.path.lexists(path) and not stat.S_ISREG(os.lstat(path).st_mode):
            raise CalibrationFileError(
                f"{path}: is a link or not a regular file; remove it to add to the library"
            ) from error
        raise CalibrationFileError(f"{folder}: cannot be written: {error.strerror}") from error
