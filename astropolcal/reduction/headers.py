# Licensed under a 3-clause BSD style license - see LICENSE
"""
What the headers of a frame say, and whether they can be right.

An extracted cube may lack keywords that the raw frame of the same number has.
What is missing, impossible or contradictory is reported for each file.
"""

import os
import re
import warnings
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import FK5, SkyCoord
from astropy.time import Time
from erfa import ErfaError

from astropolcal.exceptions import (
    AstropolcalError,
    InstrumentError,
    ObservationError,
    ParameterError,
)
from astropolcal.files import one_line
from astropolcal.fitscheck import primary_header
from astropolcal.instruments.layout import (
    ANGLES,
    card_value,
    convert,
    frame_value,
    look_up,
    middle_of,
    other_system,
    stated,
    states_start,
    time_of,
)
from astropolcal.observations import pointing as sky_pointing
from astropolcal.observations.pointings import location_of, sky_angle
from astropolcal.reduction.photometry import Photometry
from astropolcal.units import iso_date
from astropolcal.words import listed

__all__ = []

_SUFFIXES = (".fits", ".fit", ".fits.gz", ".fits.fz", ".fts")


@dataclass
class Frame:
    """What is known of one file: its keywords, in the units of a layout, and what was measured."""

    path: str
    number: int | None = None
    # column to number (degree, second, day) or text; what is missing is absent
    values: dict = field(default_factory=dict)
    # why it cannot be used; and what is odd, but does not matter
    errors: list = field(default_factory=list)
    doubts: list = field(default_factory=list)
    # of the pixels; None if the header does not say
    unit: str | None = None
    photometry: Photometry | None = None
    # of the fluxes, by which copies are recognized
    digest: str = ""

    @property
    def usable(self):
        """Whether there are fluxes, and no error."""
        return self.photometry is not None and not self.errors

    @property
    def name(self):
        """Name of the file without its folder."""
        return Path(self.path).name

    def to_dict(self):
        """Return plain numbers and texts, from which `from_dict` makes the same frame."""
        plain = self.photometry and {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self.photometry).items()
        }
        return vars(self) | {"photometry": plain}

    @classmethod
    def from_dict(cls, content):
        """Return the frame that `to_dict` described."""
        if (plain := content["photometry"]) is not None:
            others = {"reasons": list(plain["reasons"]), "outliers": int(plain["outliers"])}
            arrays = {name: np.array(plain[name], dtype=float) for name in plain.keys() - others}
            content = content | {"photometry": Photometry(**arrays, **others)}
        return cls(**content)


def frame_number(name, layout, header=None):
    """
    Return the number that a cube shares with its raw frame; None if no name holds one.

    The header knows the name that a file had before it was renamed.
    """
    other = "" if header is None else str(card_value(header, layout.original_name) or "")
    for text in (Path(name).name, other):
        # the last one: a date may stand before it
        if found := re.findall(layout.frame_pattern, text):
            return int(found[-1])
    return None


def raw_frames(folder, layout):
    """
    Return the paths of the raw frames in a folder by number; files are looked at by name only.

    Several of one number are lists of several.
    """
    folder = Path(folder)
    if not os.path.isdir(folder):
        raise ObservationError(f"{folder}: no such folder")
    found = {}
    for path in sorted(folder.iterdir()):
        number = frame_number(path.name, layout)
        if number is not None and path.name.lower().endswith(_SUFFIXES):
            found.setdefault(number, []).append(path)
    if not found:
        raise ObservationError(f"{folder}: no FITS file with a frame number in its name")
    return found


def configured(instrument, files):
    """Return the instrument as most headers that can be read say; as it is without one."""
    found, wrong = [], []
    for path in files:
        with suppress(ObservationError), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                # wavelengths and shape of the cubes may depend on it
                one = instrument.configured(primary_header(path))
            except InstrumentError as error:
                wrong.append(f"{path}: {error}")
                continue
            # a file of another mode may come first
            same = next((each for each in found if _same_mode(one, each[0])), [one, 0])
            found += [] if same[1] else [same]
            same[1] += 1
    if wrong and not found:
        raise InstrumentError(wrong[0])
    return max(found, key=lambda each: each[1])[0] if found else instrument


def _same_mode(one, other):
    """Return whether the files of two configurations of an instrument have the same slices."""
    return one is other or (
        one.files == other.files and np.array_equal(one.wavelength, other.wavelength)
    )


def read_header(path, layout, *, header=None, raw=None):
    """
    Read what a layout asks for, from the cube and from the raw frame of the same number (``raw``).

    Keywords that are missing or impossible are in ``errors`` and ``doubts``.
    """
    header = primary_header(path) if header is None else header
    frame = Frame(str(path), frame_number(path, layout, header))
    frame.unit = card_value(header, "BUNIT")
    # what is in the file goes before what a header says of it
    stack = card_value(header, "NAXIS3") if card_value(header, "NAXIS") == 3 else 1
    if layout.stacked and layout.shape[0] == 1 and isinstance(stack, int) and stack > 1:
        frame.values["exposures"] = float(stack)
    columns = list(layout.keywords)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            header = layout.from_header(header)
        frame.doubts += [str(warning.message) for warning in told]
    except AstropolcalError as error:
        frame.errors.append(str(error).removeprefix("frame 0: "))
        columns = [column for column in columns if column not in ANGLES]
    headers = [header]
    # only for these is a raw header opened
    missing = [c for c in layout.raw_columns if look_up(headers, c, layout)[1] is None]
    if raw is not None and missing:
        if frame.number is None:
            frame.errors.append("its name holds no frame number to find the raw frame by")
        elif frame.number not in raw:
            frame.errors.append(f"no raw frame of number {frame.number}")
        else:
            try:
                # behind the cube: its own keywords come first
                headers.append(_raw_header(frame, raw[frame.number], header, layout))
            except ObservationError as error:
                frame.errors.append(f"raw frame: {error}")
    for header, (keyword, (usual, why)) in product(headers, layout.wanted.items()):
        word = str(card_value(header, keyword) or "").strip()
        if word and not re.fullmatch(usual, word, re.IGNORECASE):
            frame.errors.append(f"{keyword} = {word!r}: {why}")
    if other := other_system(headers):
        frame.values["system"] = other
    for column in columns:
        keyword, value = look_up(headers, column, layout)
        if value is not None and column not in frame.values:
            _convert(frame, column, keyword, value, layout)
        if column in ANGLES and column in frame.values:
            _compare(frame, column, stated(headers, column, layout), layout)
        if column == "flc_state":
            told = list(stated(headers, column, layout))
            if len({layout.states.get(str(v), str(v).strip()) for _, v in told} - {""}) > 1:
                words = ", but ".join(f"{keyword} = {value!r}" for keyword, value in told)
                frame.errors.append(f"{words}: which state of the modulator?")
    if states_start(headers, layout):
        frame.values["starts"] = True
    return frame


def _raw_header(frame, paths, header, layout):
    """Return the header of the raw frame; refused where it may be that of another one."""
    names, found, times = [path.name for path in paths], primary_header(paths[0]), []
    # the same file, compressed or not, is one
    if len({name.partition(".")[0] for name in names}) > 1:
        raise ObservationError(
            f"{listed(names, most=3)} have the number {frame.number}: which one?"
        )
    for one in (header, found):
        # what is no time, or a date alone, says nothing
        with suppress(ObservationError):
            told = {key: look_up([one], key, layout)[1] for key in ("mjd", "date", "time")}
            times.append(observation_time(told))
    # numbers begin again, in other nights; start, middle and end may be an hour apart
    if len(times) == 2 and abs(times[0].mjd - times[1].mjd) > 1 / 24:
        ours, theirs = (time.isot for time in times)
        raise ObservationError(f"{names[0]} of the same number is of {theirs}, the cube of {ours}")
    return found


def _compare(frame, column, found, layout):
    """Say which other keywords give another angle than the first one."""
    (first, _), *others = found
    most = layout.tracking_tolerance
    for keyword, value in ((k, v) for k, v in others if k != first):
        # what is no number says nothing
        with suppress(TypeError, ValueError):
            angle = convert(column, value, layout, u.deg)
            # half a turn is none for a half-wave plate, and a derotator
            if not abs(_half_turn(angle - frame.values[column])) <= most:
                frame.doubts.append(f"{first} and {keyword} differ by more than {most:g} deg")


def raw_may_tell(errors, layout):
    """Return whether a keyword is missing that raw frames may have."""
    known = map(layout.keywords.get, layout.raw_columns)
    return any(why.startswith(f"no keyword {word} ") for word in known if word for why in errors)


def _half_turn(angle):
    return (angle + 90.0) % 180.0 - 90.0


def not_of_instrument(values, layout):
    """
    Return why a frame is none of a layout's instrument; empty if it is, or if either does not say.
    """
    own = values.get("instrument")
    if own is None or not layout.identities or own in layout.identities:
        return ""
    keyword = layout.keywords["instrument"]
    return f"{keyword} = {own!r}, allowed are {', '.join(layout.identities)}"


def _convert(frame, column, keyword, value, layout):
    """Store a value in the unit of its column, or say why it cannot be right."""
    try:
        is_date = column == "date"
        found = iso_date(value, keyword) if is_date else frame_value(column, keyword, value, layout)
    except ParameterError as error:
        # the time may stand in another keyword
        frame.doubts.append(f"{error}; it was left out")
    except ValueError as error:
        frame.errors.append(str(error))
    else:
        # a word for no modulation is none
        frame.values |= {} if found == "" else {column: found}


def add_pointing(frames, layout, needed=True):
    """
    Compute the angles of the sky that headers lack, of all frames at once, and say so in a doubt.

    If they are ``needed`` and cannot be computed it is an error of the frame.
    """
    found = []
    for frame in frames:
        # a telescope in space has neither
        asked = layout.keywords.keys() - frame.values.keys()
        missing = [name for name in ("parallactic", "altitude") if name in asked]
        words = [layout.keywords[name] for name in missing]
        if not missing or any(error.startswith(tuple(words)) for error in frame.errors):
            continue
        try:
            found.append((frame, missing, _target(frame.values, layout.site)))
        except ObservationError as error:
            if needed:
                frame.errors.append(f"no keyword {' and '.join(words)} in its header, and {error}")
    if not found:
        return
    # all at once, as the transformation costs the same for one
    ra, dec, mjd = np.array([target for *_, target in found], dtype=float).T
    coordinate = SkyCoord(ra, dec, unit=u.deg, frame=FK5(equinox="J2000"))
    time = Time(mjd, format="mjd", scale="utc")
    angles = sky_pointing(coordinate, time, location_of(layout.site))
    angles = dict(zip(("altitude", "parallactic"), angles, strict=True))
    for i, (frame, missing, _) in enumerate(found):
        known = {name: float(angle[i].to_value(u.deg)) for name, angle in angles.items()}
        # a header value goes before a computed one
        frame.values.update({name: known[name] for name in missing})
        frame.doubts.append(f"{' and '.join(missing)} computed from the coordinates and the time")


def _target(values, site):
    """Return right ascension and declination (degree, J2000), and the middle of the exposure."""
    if not site:
        raise ObservationError("no site of the telescope to compute the pointing from")
    if "system" in values:
        raise ObservationError(values["system"])
    time = observation_time(values)
    # the angles are those of the middle of the exposure
    mjd = (middle_of(time, values) if values.get("starts") else time).mjd
    try:
        ra, dec = (sky_angle(key, values[key]) for key in ("right_ascension", "declination"))
        SkyCoord(ra, dec, unit=u.deg)  # refuses what is beyond the poles
    except KeyError as error:
        raise ObservationError(f"no {error.args[0]} to compute the pointing from") from None
    except (ValueError, TypeError, u.UnitsError) as error:
        raise ObservationError(f"right ascension and declination: {one_line(error)}") from None
    return ra, dec, mjd


def observation_time(values):
    """Return the UTC time that ``mjd``, or ``date`` and ``time`` (perhaps in the former) state."""
    mjd, date, clock = (values.get(key) for key in ("mjd", "date", "time"))
    # a pointing needs the time of day too
    lacking = "date" if date is None else "time" if clock is None and "T" not in str(date) else ""
    if mjd is None and lacking:
        raise ObservationError(f"no {lacking} to compute the time from")
    try:
        return time_of(mjd, date, clock)
    except (TypeError, ValueError, ErfaError) as error:
        raise ObservationError(f"time: {one_line(error)}") from None


def tracking_error(values, layout, *, on_sky=True):
    """
    Return how far the half-wave plate is from where the tracking law puts it.

    Degree, -90 to 90, as half a turn is none. None if an angle is missing.
    """
    laws = zip(("parallactic", "altitude"), layout.tracking, strict=True)
    law = {"hwp": 1.0} | (dict(laws) if on_sky else {})
    if not all(name in values for name in ("hwp_true", *law)):
        return None
    # adding a whole number of turns to the parallactic angle shifts the law by half turns
    off = values["hwp_true"] - sum(factor * values[name] for name, factor in law.items())
    return float(_half_turn(off))


def check_sequence(hwp, derotator, layout, tolerance=0.5):
    """Return what is wrong with commanded angles (degree, in the order of the frames), by index.

    Angles that are not multiples of the layout's step do not fit. The frames are cut into blocks of
    one derotator angle; the angles that most blocks have are the sequence. A block may lack some of
    them, but an angle that occurs more often in a block than in the sequence does not fit.
    """
    hwp, derotator = np.asarray(hwp, dtype=float), np.asarray(derotator, dtype=float)
    if not hwp.size:
        return {}
    steps = np.rint(hwp / layout.hwp_step)
    # an angle that no command of this instrument gives
    uneven = np.abs(hwp - layout.hwp_step * steps) > tolerance
    # an uneven angle is a step of its own, which no sequence has
    steps[uneven] = 1e6 + np.flatnonzero(uneven)
    moved = np.abs(_half_turn(np.diff(derotator))) > 1.0
    blocks = np.split(np.arange(len(hwp)), np.flatnonzero(moved) + 1)
    # the steps that most blocks have, if there is a majority
    ranked = Counter(tuple(steps[block]) for block in blocks if max(steps[block]) < 1e6)
    ranked = ranked.most_common(2)
    tied = len(ranked) == 2 and ranked[0][1] == ranked[1][1]
    sequence = None if len(blocks) < 2 or not ranked or tied else ranked[0][0]
    found = {}
    for i, expected in (one for b in blocks for one in _misfits(b, steps, sequence, uneven)):
        why = f", no multiple of {layout.hwp_step:g} deg" if uneven[i] else " once too often"
        found[int(i)] = f"half-wave plate at {hwp[i]:g} deg{why}"
        if expected is not None and expected < 1e6:
            found[int(i)] += f"; the sequence has {expected * layout.hwp_step:g} deg"
    return found


def _misfits(block, steps, sequence, uneven):
    """Yield the frames of a block that do not fit, and the step at their place if it is known."""
    if sequence is None:
        yield from ((i, None) for i in block[uneven[block]])
        return
    surplus = Counter(steps[block]) - Counter(sequence)
    aligned = len(block) == len(sequence)
    # the frame at the right place keeps an angle that occurs twice
    order = sorted(range(len(block)), key=lambda k: aligned and steps[block[k]] == sequence[k])
    for k in order:
        if surplus[steps[block[k]]] > 0:
            surplus[steps[block[k]]] -= 1
            yield block[k], sequence[k] if aligned else None


# ---- files of several cameras --------------------------------------------------------------------


def sort_beams(files, layout):
    """
    Return one file per frame, the layout that knows the left one of each, and why some are lost.

    Where the names do not tell the beam, the headers do: files of the two cameras in one state of
    the modulator, of which one starts in the first half of the other, are a frame.
    """
    files = list(dict.fromkeys(str(path) for path in files))
    marks = layout.beam_files
    unknown = [path for path in files if not any(mark in Path(path).name for mark in marks)]
    if not (marks and unknown):
        return layout.frame_files(files), layout, {}
    groups, lost = _groups(unknown, layout)
    right, left = (float(re.search(r"\d+$", mark).group()) for mark in marks)
    partners = {}
    for state in dict.fromkeys(state for _, state in groups):
        lefts = groups.get((left, state), {})
        for path, (start, length) in groups.get((right, state), {}).items():
            apart = {other: abs(start - begin) for other, (begin, _) in lefts.items()}
            near = min(apart, key=apart.get, default=None)
            # seconds; cameras may start as far apart in exposures shorter than twice that
            if near is not None and apart[near] <= max(length / 2, 1.0):
                partners[path] = near
                del lefts[near]
    for (camera, state), group in groups.items():
        wanted = f"camera {left if camera == right else right:g}"
        wanted += f" in state {state}" if state else ""
        words = [f"no frame of {wanted} was taken with it"]
        lost |= {path: words for path in group if path not in {*partners, *partners.values()}}
    layout = replace(layout, partners=partners)
    return [path for path in layout.frame_files(files) if path not in lost], layout, lost


def _groups(files, layout):
    """Return start and length (s) of the files of each camera and state, and why some are lost."""
    groups, lost = {}, {}
    cameras = [re.search(r"\d+$", mark).group() for mark in layout.beam_files]
    for path in files:
        try:
            frame = read_header(path, layout)
            start, why = 86400 * observation_time(frame.values).mjd, list(frame.errors)
        except ObservationError as error:
            lost[path] = [str(error).removeprefix(f"{path}: ")]
            continue
        camera, state = (frame.values.get(key) for key in ("camera", "flc_state"))
        if f"{camera or 0:g}" not in cameras:
            said = "no {}" if camera is None else "{} = " + f"{camera:g}"
            said = said.format(layout.keywords["camera"])
            why.append(f"{said} in its header; allowed are {', '.join(cameras)}")
        if why:
            lost[path] = why
            continue
        length = frame.values.get("exposure_time", 0.0) * frame.values.get("exposures", 1)
        groups.setdefault((camera, state), {})[path] = (start, length)
    if any(state for _, state in groups):
        keyword = layout.keywords["flc_state"]
        words = [f"no state of the modulator ({keyword}) in its header, which others have"]
        for key in [key for key in groups if not key[1]]:
            lost |= dict.fromkeys(groups.pop(key), words)
    return groups, lost
