# Licensed under a 3-clause BSD style license - see LICENSE
"""From the cubes of a run to one table of observations."""

import hashlib
import json
import os
import re
from collections import Counter
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np

from astropolcal.exceptions import (
    InstrumentError,
    ObservationError,
    ParameterError,
    warn,
)
from astropolcal.files import append_line, read_lines
from astropolcal.observations import Observations
from astropolcal.observations.grid import MAD_TO_SIGMA, is_star
from astropolcal.observations.reading import stated_date, write_table
from astropolcal.pipeline.tasks import ended_tasks
from astropolcal.progress import shown, steps
from astropolcal.reduction.frames import Frame, Masters, check_stars, reduce_frame
from astropolcal.reduction.headers import (
    check_sequence,
    configured,
    raw_frames,
    raw_may_tell,
    sort_beams,
)
from astropolcal.reduction.tables import photometry_table, reduced_table
from astropolcal.version import version
from astropolcal.words import check_choice, counted

__all__ = ["Reduction", "reduce_cubes", "reduce_run"]

# modulation between these may be of a half-polarized lamp or a bad derotator angle: not guessed
_AMBIGUOUS = (0.15, 0.4)
# single difference in a part of the rectangles, and standard deviations, from what is expected; and
# of how many frames the others are told from
_UNLIKE, _FEWEST = (0.03, 6.0), 6
_UNLIKE_OTHERS = (
    "in a part of the rectangles the beams compare differently from the other frames, as where "
    "pixels are damaged or one beam is cut"
)
# times the light of one beam that the other one may have, in all frames together, and what is left
# of the polarization in such a sum, at the most
_UNEQUAL, _LEFT_OVER = 2.0, 0.3
_OTHER_DAY = "taken more than a day from the middle of the run; the table states one date"


@dataclass
class Reduction:
    """
    A reduced run.

    Attributes
    ----------
    instrument : Instrument
        Whose files they are.
    source : {"internal", "star"}
        The photometry.
    frames : list
        The files in the table, in the order they were taken.
    problems : dict of str to list of str
        File to why it is not in the table.
    doubts : dict of str to list of str
        File to what is odd about it.
    meta : dict
        Of the table.
    options : dict
        Of the photometry.
    masters : object, optional
        Dark and flat of the frames.

    Examples
    --------
    >>> from astropolcal.reduction import Reduction
    >>> Reduction(None, "star").problems
    {}
    """

    instrument: object
    source: str
    frames: list = field(default_factory=list)
    problems: dict = field(default_factory=dict)
    doubts: dict = field(default_factory=dict)
    meta: dict = field(default_factory=dict)
    options: dict = field(default_factory=dict)
    masters: object = None

    @property
    def table(self):
        """One row per frame and wavelength; a cell that failed is masked and has a reason."""
        return reduced_table(self.frames, self.instrument, self.meta)

    @property
    def photometry(self):
        """The same with centres, widths, radii and background levels."""
        return photometry_table(self.frames, self.instrument)

    @property
    def observations(self):
        """The `~astropolcal.observations.Observations`."""
        return Observations.from_table(self.table, name="reduced")

    @property
    def flags(self):
        """Number of cells by the reason why they are masked (dict)."""
        reasons = Counter(r for frame in self.frames for r in frame.photometry.reasons if r)
        return dict(reasons.most_common())

    def write(self, path, overwrite=False):
        """
        Write the table as ECSV; masked cells are empty.

        Parameters
        ----------
        path : path-like
            The file.
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        ObservationError
            If the file exists, or cannot be written.
        """
        write_table(self.table, path, overwrite)

    def summary(self):
        """Return what was reduced and what was not, as plain numbers and texts (dict)."""
        plain = (str, int, float, bool)
        cells = sum(len(frame.photometry.reasons) for frame in self.frames)
        return {
            "instrument": self.instrument.name,
            "photometry": self.source,
            "n_frames": len(self.frames),
            "n_cells": cells,
            "n_masked": sum(self.flags.values()),
            "n_outliers": sum(frame.values.get("outliers", 0) for frame in self.frames),
            "flags": self.flags,
            "problems": self.problems,
            "doubts": self.doubts,
            "meta": {key: value for key, value in self.meta.items() if isinstance(value, plain)},
        }


def reduce_cubes(files, instrument, **options):
    """
    Measure both beams in the cubes of a run.

    Parameters
    ----------
    files : sequence of path-like
        Cubes.
    instrument : Instrument or str
        Or its name.
    **options
        As for `reduce_run`: ``source``, ``raw``, ``workers`` and so on.

    Returns
    -------
    Observations

    Raises
    ------
    ObservationError
        If no file can be used; the message says why.

    Warns
    -----
    AstropolcalWarning
        If files are left out or doubtful; `reduce_run` lists all of them.

    Examples
    --------
    >>> from astropolcal.reduction import reduce_cubes
    >>> reduce_cubes(["nowhere_00000001.fits"], "charis")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: the file cannot be used: nowhere_00000001.fits: no such file
    """  # noqa: E501
    reduction = reduce_run(files, instrument, **options)
    for words, told in (("left out", reduction.problems), ("doubtful", reduction.doubts)):
        for path, why in list(told.items())[:1]:
            warn(
                f"{counted(len(told), 'file')} {words} (reduce_run lists all); the first is "
                f"{path}: {'; '.join(why)}"
            )
    return reduction.observations


def reduce_run(
    files,
    instrument,
    *,
    source="internal",
    raw=None,
    dark=None,
    flat=None,
    meta=None,
    workers=None,
    cluster=None,
    resume=None,
    progress=False,
    hwp_sequence=None,
    keep_repeats=False,
    **options,
):
    """
    Measure both beams in the cubes of a run, and keep what was found on the way.

    A file that cannot be used never stops the run: it is left out, and listed with the reason.

    Parameters
    ----------
    files : sequence of path-like
        Cubes.
    instrument : Instrument or str
        Or its name.
    source : str
        ``"internal"`` or ``"star"`` choose the photometry. What the table says of the source may be
        given at once: ``"polarized"``, ``"unpolarized"``, ``"unpolarized standard star"``. With
        ``"internal"`` it is ``polarized`` or ``unpolarized`` where the fluxes leave no doubt.
    raw : path-like, optional
        Folder of raw frames, whose headers are looked into by frame number.
    dark, flat : path-like, optional
        FITS files of a dark, which is subtracted from each exposure, and of a flat, by which it is
        divided, of the shape of an image of a frame; for raw frames. The dark has to be in the unit
        of the frames, as far as its header says. Pixels without a value in
        them, or where the flat is not above zero, are not used. Where each camera writes a file of
        its own, that of the right beam is named, and that of the left one stands beside it.
    meta : dict, optional
        More for the table's meta, such as ``{"yjh50_dichroic": "in"}``.
    workers : int, optional
        Number of processes; by default one for 100 files, up to that of the CPUs.
    cluster : str, optional
        Address of a ``dask.distributed`` scheduler, whose workers measure a file each at a time.
    resume : path-like, optional
        Journal of what is done: files in it are not measured again.
    progress : bool
        Whether to show how far it is; on a terminal only.
    hwp_sequence : sequence of float, optional
        Commanded angles in degree, which replace those of the headers, in turn and in the order of
        the frames; for headers that are known to be wrong. Every file has to be usable then.
    keep_repeats : bool
        Whether frames of an internal source are kept whose half-wave plate stands
        90 deg from that of another frame at the same derotator angle.
    **options
        Of the photometry of an internal source:

        ``background`` ("none", or "outside": the median of the pixels clear of both beams is
        subtracted; the light of the source fills the field stop, so use it only if the pixels
        outside show the same background as those inside) and ``max_masked`` (largest part of an
        aperture that may lack values, 0.2).

        Of stars: ``radius`` of the aperture ("fwhm": ``factor`` (3) times the width, at most
        ``max_radius`` (45 pixels); "growth": where the curve of growth of the mean image reaches
        99 %; or pixels), ``annulus`` (width of the ring of the background, 5 pixels),
        ``aperture_correction`` (whether fluxes are scaled to all of the star's light, by a
        profile of its wings), ``companion``
        (a second star brighter than this fraction of the first, 0.1, corrupts a frame) and
        ``max_masked`` (0.1, of the aperture as well as of the light in it).

    Returns
    -------
    Reduction

    Raises
    ------
    ObservationError
        If no file can be used; the message says why.
    InstrumentError
        If the instrument does not say how its files look.
    ParameterError
        If an option is wrong, or the source is none that the instrument has.

    Examples
    --------
    >>> from astropolcal.reduction import reduce_run
    >>> reduce_run([], "charis")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: no files to reduce
    """
    files = [str(path) for path in files]
    instrument = _instrument(instrument, files)
    # an instrument of somebody else need not list its sources
    if known := instrument.sources:
        allowed = dict.fromkeys(("internal", "star", *known))
        check_choice("source", source, allowed, ParameterError)
    photometry = "star" if is_star(source) else "internal"
    if not files:
        raise ObservationError("no files to reduce")
    # before the work is done: the table would be refused
    stated_date(meta or {}, "reduced")
    cubes, layout, lost = sort_beams(files, instrument.files)
    masters = Masters(*(None if path is None else str(path) for path in (dark, flat)))
    # a dark that does not fit is no fault of the frames
    masters.check(layout)
    task = {
        "layout": layout,
        "masters": None if masters == Masters() else masters,
        "source": photometry,
        "raw": None if raw is None else raw_frames(raw, layout),
        "options": options,
    }
    frames = _measure_all(cubes, task, workers, cluster, resume, progress)
    if photometry == "star":
        # here and not in the processes that measure: one table of the Earth's rotation for all
        check_stars(frames, layout)
    kept = {"options": options, "masters": task["masters"]}
    reduction = Reduction(instrument, photometry, problems=lost, **kept)
    frames = _usable(frames, reduction, layout, hwp_sequence, keep_repeats)
    if not frames:
        raise ObservationError(_nothing(len(files), task, reduction.problems))
    reduction.frames = frames
    settings = masters.settings(layout)
    seen, stated, wrong = _seen_source(frames, instrument), (meta or {}).get("source", source), []
    if {seen, stated} == {"polarized", "unpolarized"}:
        wrong = [f"source {stated!r} is stated, but the fluxes change with the plate as if {seen}"]
    wrong += _unequal(frames, instrument)
    _doubt(frames, layout, lambda frame: [*wrong, *masters.doubts(frame.values, settings)])
    reduction.doubts = {f.path: f.doubts for f in frames if f.doubts}
    reduction.meta = _meta(frames, instrument, source, meta or {})
    return reduction


def _doubt(frames, layout, others):
    """Note what is doubtful about frames, after what ``others`` returns of each."""
    middle = np.median([f.values["mjd"] for f in frames if "mjd" in f.values] or [np.nan])
    for frame in _unlike_others(frames, layout):
        frame.doubts.append(_UNLIKE_OTHERS)
    for frame in frames:
        frame.doubts += others(frame)
        if frame.values.get("light") == "uneven":
            frame.doubts.append("the light in the rectangles is uneven, as that of a star")
        if abs(frame.values.get("mjd", np.nan) - middle) > 1:
            frame.doubts.append(_OTHER_DAY)


def _usable(frames, reduction, layout, hwp_sequence, keep_repeats):
    """Return the frames that belong in a table together; note why the others do not."""
    lost = [*reduction.problems, *(frame.path for frame in frames if not frame.usable)]
    # copies before sequences: a copy would look like an angle too often
    frames = set_aside(frames, reduction)
    if any(frame.values.get("flc_state") for frame in frames):
        keyword = layout.keywords.get("flc_state", "flc_state")
        why = f"no state of the modulator, A or B, in its header ({keyword}), which others have"
        frames = _kept(frames, reduction, lambda f: [] if "flc_state" in f.values else [why])
    replace_angles(frames, hwp_sequence, lost)
    staged = {"hwp", "derotator"} <= {*layout.stages}
    if staged and hwp_sequence is None:
        frames = consistent(frames, reduction, layout)
    if staged and reduction.source == "internal" and not keep_repeats:
        frames = without_repeats(frames, reduction)
    return frames


def _instrument(instrument, files=()):
    from astropolcal import instruments

    instrument = instruments.get(instrument) if isinstance(instrument, str) else instrument
    # one run, one mode: what differs is left out later
    instrument = configured(instrument, files)
    name, layout = instrument.name, instrument.files
    if layout is None:
        known = [name for name in instruments.names() if instruments.get(name).files is not None]
        raise InstrumentError(
            f"{name}: it is not known how its files look; they can be read of {', '.join(known)}"
        )
    if len(instrument.wavelength) != layout.shape[0]:
        raise InstrumentError(
            f"{name}: {len(instrument.wavelength)} wavelengths, but cubes of {layout.shape[0]} "
            "slices"
        )
    return instrument


def _kept(frames, reduction, why):
    """Return the frames of which ``why`` knows no reasons to leave them out; note the others."""
    found = [(frame, why(frame)) for frame in frames]
    reduction.problems |= {frame.path: reasons for frame, reasons in found if reasons}
    return [frame for frame, reasons in found if not reasons]


def _nothing(count, task, problems):
    """Return why none of the files can be used, and where else to look for keywords."""
    first, *rest = (f"{path}: {'; '.join(why)}" for path, why in problems.items())
    more = f" (and {len(rest)} more)" if rest else ""
    none = "the file cannot be used" if count == 1 else f"none of the {count} files can be used"
    every = [why for reasons in problems.values() for why in reasons]
    if task["raw"] is None and raw_may_tell(every, task["layout"]):
        more += "; give the folder of the raw frames, which may have them (raw, --raw DIR)"
    return f"{none}: {first}{more}"


# --- all files -------------------------------------------------------------------


def _measure_all(files, task, workers, cluster, resume, progress):
    """Return the frames of all files in their order, from the journal or measured now."""
    settings = {name: repr(task[name]) for name in ("layout", "source", "options", "masters")}
    # frames of an older journal hold angles that were checked already
    settings |= {"raw": repr(task["raw"]), "checked": False, "made by": version}
    others = (task["masters"] or Masters()).files(task["layout"])
    others += [path for paths in (task["raw"] or {}).values() for path in paths]
    settings["changed"] = [os.stat(path).st_mtime_ns for path in others]
    journal = Journal(resume, settings, task["layout"].left_file)
    found = {path: frame for path in files if (frame := journal.done(path)) is not None}
    # a file that is named twice is measured once
    todo = [path for path in dict.fromkeys(files) if path not in found]
    if workers is None:
        # below this number of files a process, its start costs more than it saves
        workers = max(1, min(os.cpu_count() or 1, len(todo) // 100))
    if not (isinstance(workers, int) and workers >= 1):
        raise ParameterError(f"workers = {workers!r}; a whole number above zero is needed")
    results = _results(todo, task, min(workers, max(len(todo), 1)), cluster)
    with shown(progress):
        for frame in steps(results, "cubes", len(set(files)), len(found)):
            found[frame.path] = frame
            # at once: a run that is killed keeps what is done
            journal.add(frame)
    return [found[path] for path in dict.fromkeys(files)]


def _results(files, task, workers, cluster):
    """Yield the frames of files as they are done."""
    if workers == 1 and cluster is None:
        yield from (reduce_frame(path, **task) for path in files)
        return
    # imported once, not by each process
    preload = ["astropolcal.reduction.frames", "photutils.aperture"]
    measure = partial(_measured, reduce_frame, task)
    given = {"workers": workers, "cluster": cluster, "preload": preload}
    with closing(ended_tasks(measure, files, **given)) as ended:
        for each in ended:
            if isinstance(each.result, Exception):
                raise each.result
            yield each.result or Frame(each.task, errors=[each.reason])


def _measured(measure, task, path):
    """Return the frame of a file, or what ends the run, such as a wrong option."""
    try:
        return measure(path, **task)
    except Exception as problem:
        return problem


# --- what is said of the run -------------------------------------------------------


def _meta(frames, instrument, source, given):
    """Return the meta of the table."""
    values = [frame.values for frame in frames]
    meta = {"instrument": (*instrument.aliases, instrument.name)[0]}
    for key, column in (("mode", "filter"), ("object", "object"), ("date", "date")):
        texts = [v[column] for v in values if v.get(column)]
        if texts and (key != "object" or "star" in source):
            usual = Counter(texts).most_common(1)[0][0]
            meta[key] = usual[:10] if key == "date" else usual
    for key in instrument.files.optics:
        # all that say it say the same
        if said := {_optic(instrument.files, key, frame) for frame in frames} - {None}:
            (meta[key],) = said
    if any(v.get("flc_state") for v in values):
        # the states alternate within an exposure, so that their difference is the better one
        meta["pairing"] = "flc_state"
    if source != "internal":
        meta["source"] = source
    elif "source" not in given and (seen := _seen_source(frames, instrument)):
        meta |= {"source": seen, "source_from": "the modulation of the fluxes"}
    return meta | dict(given)


def _optic(layout, key, frame):
    """Return what a header says of an optic, by the first pattern that is found, or None."""
    column, words = layout.optics[key]
    said = frame.values.get(column) or ""
    return next((word for pattern, word in words.items() if re.search(pattern, said)), None)


@np.errstate(divide="ignore", invalid="ignore")
def _unlike_others(frames, layout):
    """
    Return the frames of a lamp in which a part of one beam has another light than in the others.

    How the ratio of both beams in a part compares with that of all of the rectangles is the same in
    all frames, wherever the lamp is bright and however it is polarized.
    """
    frames = [frame for frame in frames if frame.values.get("light") == "even"]
    if len(frames) < _FEWEST or not layout.two_beams:
        return []
    # (frame, part), and with one part for the mean of all
    right, left = np.moveaxis(np.array([frame.values["parts"] for frame in frames]), 1, 0)
    whole, rest = (np.ma.masked_invalid(beam).mean(axis=1)[:, None] for beam in (right, left))
    odds = (right / left) / (whole / rest)
    # of light that is all in one beam the other one says nothing
    both = (np.abs(whole - rest) < 0.9 * (whole + rest)).all(axis=1)
    usual = np.ma.median(np.ma.masked_invalid(odds[both]), axis=0)
    off = (right - left) / (right + left) - (usual * whole - rest) / (usual * whole + rest)
    flux, variance = (
        np.array([getattr(f.photometry, name)[:, ~f.photometry.failed].sum(axis=1) for f in frames])
        for name in ("flux", "variance")
    )
    # of the single difference in a part
    error = 2 * np.sqrt((flux[:, ::-1] ** 2 * variance).sum(axis=1)) / flux.sum(axis=1) ** 2
    error, off = np.sqrt(right.shape[1]) * error[:, None], np.ma.masked_invalid(np.abs(off))
    # errors may lack something, such as the noise of a dark
    error = error * max(1.0, MAD_TO_SIGMA * np.ma.median(off / error))
    bad = (off > np.maximum(_UNLIKE[0], _UNLIKE[1] * error)).filled(False).any(axis=1)
    return [frame for frame, unlike in zip(frames, bad, strict=True) if unlike]


def _unequal(frames, instrument):
    """Say that one beam has far more light than the other, in a run that does not polarize it."""
    layout, turns = instrument.files, [frame.values.get("hwp", np.nan) for frame in frames]
    # a half-wave plate at t turns polarization by 2 t, which is half a turn at 45 deg
    if not (layout.two_beams and abs(np.mean(np.exp(4j * np.radians(turns)))) < _LEFT_OVER):
        return []
    with np.errstate(all="ignore"):
        flux = np.sum([np.where(f.photometry.failed, 0, f.photometry.flux) for f in frames], axis=0)
        ratio = np.nanmedian(flux[0] / flux[1])
    if not (ratio > _UNEQUAL or ratio < 1 / _UNEQUAL):
        return []
    return [
        f"the right beam has {ratio:.2g} times the light of the left one in the sum of all frames, "
        "so that they seem less polarized: BUNIT, gain or exposure time of one of them may be wrong"
    ]


def _seen_source(frames, instrument):
    """Return whether an internal source is polarized, as far as its fluxes leave no doubt."""
    if not (instrument.files.two_beams and "hwp" in instrument.files.stages):
        return None
    angles = {round(frame.values["hwp"], 1) for frame in frames}
    if len(angles) < 4:
        return None
    fluxes = np.array([np.where(f.photometry.failed, np.nan, f.photometry.flux) for f in frames])
    single = (fluxes[:, 0] - fluxes[:, 1]) / (fluxes[:, 0] + fluxes[:, 1])
    known = np.isfinite(single).any(axis=0)
    single = single[:, known]
    # half the range over the run, of the usual wavelength: modulation without the offset
    modulation = np.median(np.nanmax(single, axis=0) - np.nanmin(single, axis=0)) / 2
    if modulation < _AMBIGUOUS[0]:
        return "unpolarized"
    return "polarized" if modulation > _AMBIGUOUS[1] else None


# ---- which frames belong together ----------------------------------------------------------------

# what all frames of a run must have in common
_KINDS = {"internal": ("filter", "pickoff", "light"), "star": ("filter", "pickoff", "object")}


def set_aside(frames, reduction):
    """Leave out what cannot be used, copies, and frames of another kind than most."""
    seen = {}

    def why(frame):
        if not frame.usable:
            return frame.errors
        # a copy under another name has the same fluxes to the last bit
        keys = [f"data {frame.digest}"]
        keys += [f"number {frame.number}"] if frame.number is not None else []
        first = next((seen[key] for key in keys if key in seen), None)
        if first is None:
            seen.update(dict.fromkeys(keys, frame))
            return []
        same = "the same data as" if keys[0] in seen else "the same frame as"
        return [f"{same} {first.path if first.name == frame.name else first.name}"]

    kept = _kept(frames, reduction, why)
    # before the rest: fluxes in other units cannot be compared at all
    kept = _of_one_kind(kept, "unit", lambda frame: frame.unit, reduction)
    # the state of a stage differs from frame to frame
    stages = reduction.instrument.files.stages if reduction.instrument else ()
    for name in (name for name in _KINDS[reduction.source] if name not in stages):
        kept = _of_one_kind(kept, name, lambda frame, name=name: frame.values.get(name), reduction)
    # by what they are to a chain, and not by how they are written
    for key in reduction.instrument.files.optics if reduction.instrument else ():
        kept = _of_one_kind(kept, key, partial(_optic, reduction.instrument.files, key), reduction)
    # what has no number comes last, by time
    time = {frame.path: frame.values.get("mjd", np.inf) for frame in kept}
    return sorted(
        kept,
        key=lambda f: (f.number is None, time[f.path] if f.number is None else f.number, f.name),
    )


def _of_one_kind(frames, what, value, reduction):
    """Leave out frames that differ from most in what a run has in common."""
    # case, blanks and signs are written now so, now so; but BD+12 and BD-12 are two stars
    kinds = {f.path: value(f) and re.sub(r"[^\w+-]|_", "", value(f)).casefold() for f in frames}
    # whose frames are fewer is the intruder, even if it came first
    usual = Counter(kind for kind in kinds.values() if kind is not None).most_common()
    if len(usual) < 2:
        return frames
    # a header that says nothing contradicts nothing
    good = (usual[0][0], None)
    words = value(next(frame for frame in frames if kinds[frame.path] == good[0]))

    def why(f):
        said = f"{what} {value(f)!r}, the others of the run have {words!r}"
        return [] if kinds[f.path] in good else [said]

    return _kept(frames, reduction, why)


def replace_angles(frames, sequence, lost=()):
    """Give the frames the angles of a sequence that repeats, in place; none may be ``lost``."""
    if sequence is None:
        return
    if lost:
        raise ObservationError(f"{lost[0]}: cannot be used; leave out all frames of its sequence")
    if not len(sequence) or len(frames) % len(sequence):
        raise ObservationError(
            f"{len(frames)} frames cannot be cut into sequences of {len(sequence)} angles; "
            "frames are missing, and it is unclear which"
        )
    for frame, angle in zip(frames, cycle(map(float, sequence)), strict=False):
        stated, frame.values["hwp"] = frame.values["hwp"], angle
        # degree; what a header rounds
        if abs(stated - angle) > 1e-3:
            words = f"half-wave plate at {stated:g} deg in the header, replaced by {angle:g} deg"
            frame.doubts.append(words)


def consistent(frames, reduction, layout):
    """Leave out frames whose commanded angle does not fit the sequence of the run."""
    angles = ([frame.values[name] for frame in frames] for name in ("hwp", "derotator"))
    wrong = {frames[i].path: [why] for i, why in check_sequence(*angles, layout).items()}
    return _kept(frames, reduction, lambda frame: wrong.get(frame.path))


def without_repeats(frames, reduction):
    """Leave out frames at 90 deg from another one, which measure the same again."""
    seen = []

    def why(frame):
        words = f"half-wave plate at {frame.values['hwp']:g} deg repeats that of"
        for twin in seen:
            hwp, derotator = (abs(frame.values[k] - twin.values[k]) for k in ("hwp", "derotator"))
            # a half-wave plate at 90 deg has the Mueller matrix of one at 0
            if abs(hwp - 90.0) < 0.3 and derotator < 0.5:
                return [f"{words} {twin.name}"]
        seen.append(frame)
        return []

    return _kept(frames, reduction, why)


# ---- journal -------------------------------------------------------------------------------------


def _entry(content):
    """Return key and frame of a line of a journal, with what a frame has, or raise."""
    frame = Frame.from_dict(content["frame"])
    kinds = {"path": str, "values": dict, "errors": list, "doubts": list}
    sane = all(isinstance(getattr(frame, name), kind) for name, kind in kinds.items())
    if not (sane and all(isinstance(text, str) for text in frame.errors + frame.doubts)):
        raise TypeError("a frame has a path, values by name, and texts of errors and doubts")
    return str(content["key"]), frame


class Journal:
    """
    Results of files as lines of JSON, written as they come; None keeps none.

    A file counts as done if its name, size and time of change, those of the file of the left beam
    (``left_file``) and the settings are those of the journal. A line that was cut off is ignored.
    """

    def __init__(self, path, settings, left_file=lambda path: None):
        self.path, self._left_file = None if path is None else Path(path), left_file
        text = json.dumps(settings, sort_keys=True, default=repr)
        self._settings = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._known = {}
        if path is not None:
            pairs, _ = read_lines(path, _entry, "a journal of a reduction", ObservationError)
            self._known = dict(pairs)

    def _key(self, path):
        try:
            files = [path, left] if (left := self._left_file(path)) else [path]
            states = [os.stat(file) for file in files]
        except (OSError, ValueError):
            return None
        told = "|".join(f"{state.st_size}|{state.st_mtime_ns}" for state in states)
        return f"{Path(path).resolve()}|{told}|{self._settings}"

    def done(self, path):
        """Return the frame of a file that is done, else None."""
        return self._known.get(self._key(path))

    def add(self, frame):
        """Write down a frame."""
        key = self._key(frame.path)
        if self.path is None or key is None:
            return
        line = json.dumps({"key": key, "frame": frame.to_dict()})
        append_line(self.path, line, ObservationError)
