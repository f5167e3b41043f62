# Licensed under a 3-clause BSD style license - see LICENSE
"""Files of frames: headers, cubes and fluxes, or the reason why there are none."""

import hashlib
import re
import warnings
from collections import namedtuple
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable
from astropy.utils.exceptions import AstropyUserWarning

from astropolcal.exceptions import (
    AstropolcalError,
    ObservationError,
    ParameterError,
    warn,
)
from astropolcal.fitscheck import open_fits, primary_header, readable_fits
from astropolcal.instruments.layout import ANGLES, card_value
from astropolcal.observations.grid import mean_of_exposures
from astropolcal.pipeline.headers import told_beam
from astropolcal.reduction.headers import (
    Frame,
    _half_turn,
    add_pointing,
    configured,
    not_of_instrument,
    observation_time,
    raw_frames,
    raw_may_tell,
    read_header,
    tracking_error,
)
from astropolcal.reduction.photometry import (
    detector_of,
    evenly_lit,
    light_in_parts,
    measure_internal,
    outside_share,
    piled_up,
    rectangles,
    sharpest,
)
from astropolcal.reduction.stars import measure_stars
from astropolcal.words import counted

__all__ = []

_SINGLE = "single pixels far off their neighbours were left out"
# share of the light inside the beams of a lamp that is worth a word where it is outside them; from
# the second on the lamp itself fills the field
_OUTSIDE = (0.01, 0.5)
# pixels of a twentieth are below the first percentile and above the second; below zero by so many
# times the read noise, and by such a share of the light, they are not by noise
_SPAN, _BELOW, _WORTH_A_WORD = (5, 95), 5.0, 0.005


def reduce_frame(path, layout, *, source="internal", raw=None, masters=None, options=None):
    """
    Read a cube and measure both beams; everything that is wrong with the file is in ``errors``.

    ``raw`` are raw frames by number, ``masters`` their dark and flat; options are those of
    `measure_internal` or `measure_stars`, and a wrong one raises.
    """
    frame = Frame(str(path))
    try:
        with open_cube(path, layout, masters) as (primary, header, cube, good):
            # the header that is open already
            frame = read_header(path, layout, header=primary, raw=raw)
            _check_header(frame, layout, source)
            # per file: gain and exposure time may change within a night
            detector = detector_of(layout, _unit_of(header, primary), frame.values)
            if layout.beam_files:
                detector, cube = match_beams(frame, layout, cube, detector)
            frame.unit = detector.unit.to_string()
            measure = measure_stars if source == "star" else measure_internal
            frame.photometry = measure(cube, good, detector, layout, **(options or {}))
            if frame.photometry.outliers:
                frame.values["outliers"] = frame.photometry.outliers
                frame.doubts.append(_SINGLE)
            if source == "internal":
                even = evenly_lit(cube, good, layout)
                frame.values["light"] = "even" if even else "uneven"
                frame.values["parts"] = light_in_parts(cube, good, layout).tolist()
                frame.doubts += _background(cube, good, layout, frame.photometry) if even else []
                dark = masters is not None and masters.dark is not None
                frame.doubts += (
                    _overdone(cube[good], detector) if dark else _raw(cube, good, frame, layout)
                )
    except ObservationError as error:
        frame.errors.append(str(error).removeprefix(f"{path}: "))
        return frame
    result = frame.photometry
    frame.digest = _digest(result.flux)
    if result.failed.all():
        most = max(set(result.reasons), key=result.reasons.count)
        frame.errors.append(f"no slice can be used: {most}")
    return frame


def _background(cube, good, layout, result):
    """Say that there is light outside the beams of a lamp, which was not subtracted."""
    flux = result.flux[:, ~result.failed]
    if not flux.size or result.background.any():
        return []
    share = outside_share(cube, good, layout, flux)
    if not _OUTSIDE[0] <= share < _OUTSIDE[1]:
        return []
    return [
        f"outside the beams there is {100 * share:.2g} % of the light inside, on the same area; "
        "where it is under the beams, too, they seem less polarized (background='outside', "
        "--background outside, subtracts it)"
    ]


def _overdone(pixels, detector):
    """Say that a dark has left less than no light."""
    low, high = np.percentile(pixels, _SPAN) if pixels.size else (0.0, 0.0)
    if low >= -max(_BELOW * detector.read_noise, _WORTH_A_WORD * high):
        return []
    return [
        f"less the dark, a twentieth of the pixels are below {low:.3g} {detector.unit}: the "
        "dark is too high, or was subtracted before; beams seem more polarized than they are"
    ]


def _raw(cube, good, frame, layout):
    """Say that nothing was subtracted from the whole numbers of a raw frame."""
    rows, columns, _ = rectangles(layout.internal_apertures, cube.shape[1:])[0]
    # of the right beam, which is in its own unit; of a mean the sum is whole
    pixels = cube[:, rows, columns][good[:, rows, columns]].astype(float)
    sums = pixels[pixels != 0] * frame.values.get("exposures", 1.0)
    # some pixels are whole by chance
    whole = sums.size and np.mean(np.abs(sums - np.rint(sums)) < 1e-6) > 0.9
    if not whole or frame.photometry.background.any():
        return []
    return [
        "its pixels are whole numbers, as of a raw frame, and no dark was given (dark, --dark): "
        "bias and dark current are taken for unpolarized light"
    ]


def _digest(array):
    return hashlib.sha256(np.ascontiguousarray(array)).hexdigest()[:24]


def _unit_of(*headers):
    """Return the first BUNIT of some headers, or None."""
    units = (card_value(header, "BUNIT") for header in headers)
    return next((unit for unit in units if unit is not None), None)


@contextmanager
def open_cube(path, layout, masters=None):
    """
    Give primary header, header, cube (W, Y, X) and known pixels, for a ``with`` block.

    The cube is memory-mapped. Pixels with a value and an inverse variance above zero are known.
    ``masters`` are dark and flat, see `Masters`.
    """
    with ExitStack() as stack:
        with readable_fits(path), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # astropy only warns of it, and fails later in other words
            warnings.filterwarnings("error", message=".*truncated.*")
            stream = stack.enter_context(open_fits(path))
            try:
                hdus = stack.enter_context(fits.open(stream))
                opened = _read(path, hdus, layout, masters)
            except AstropyUserWarning as warning:
                # its type tells a user nothing
                raise OSError(str(warning)) from warning
        # behind the door: what fails in the caller's block is not the file's fault
        yield opened


def _read(path, hdus, layout, masters):
    primary, header, cube, good, light = _read_beams(path, hdus, layout, masters)
    left = layout.left_file(path)
    if left is None:
        return primary, header, cube, good
    if not left.is_file():
        raise ObservationError(f"{path}: no file {left.name} of the left beam beside it")
    # what is joined is in memory, so that this file need not stay open
    with readable_fits(left), open_fits(left) as stream, fits.open(stream, memmap=False) as others:
        own = masters and masters.of_left(layout)
        _, _, other, known, theirs = _read_beams(left, others, layout, own)
    _check_exposures(path, light, left, theirs)
    joined, good = (np.concatenate(pair, axis=-1) for pair in ((other, cube), (known, good)))
    return primary, header, joined, good


def _read_beams(path, hdus, layout, masters):
    number, wanted = layout.cube_extension, layout.file_shape
    if len(hdus) <= number:
        raise ObservationError(
            f"{path}: no extension {number}, where the cube should be; it has {len(hdus)} HDUs"
        )
    data = hdus[number].data
    if data is not None and data.ndim == 2 and wanted[0] == 1:
        data = data[None]
    stack = layout.stacked and wanted[0] == 1 and np.shape(data)[1:] == wanted[1:]
    if data is None or (data.shape != wanted and not stack):
        shape = "no data" if data is None else f"shape {data.shape}"
        raise ObservationError(f"{path}: {shape} in extension {number}, {wanted} is needed")
    if data.dtype.kind not in "fiu":
        raise ObservationError(f"{path}: pixels of type {data.dtype}, numbers are needed")
    # FITS is big-endian, which slows down all that follows
    cube = np.asarray(data, dtype=data.dtype.newbyteorder("=") if data.dtype.kind == "f" else float)
    # NaN marks what extraction could not reach
    good = np.isfinite(cube)
    if not good.all():
        # of a signalling NaN numpy would warn wherever it is used
        cube = np.where(np.isnan(cube), np.array(np.nan, cube.dtype), cube)
    weight = hdus[number + 1].data if len(hdus) > number + 1 else None
    if weight is not None and weight.size == cube.size:
        weight = np.asarray(weight.reshape(cube.shape))
        # no measurement is without noise, nor is one that is all noise a measurement
        good &= (weight > 0) & (weight < np.inf)
    primary, header = hdus[0].header, hdus[number].header
    values = read_header(path, layout, header=primary).values
    detector = detector_of(layout, _unit_of(header, primary), values)
    light, several, good = None, cube.shape != wanted, good & ~detector.blank(cube)
    if (piled := piled_up(cube)).any() and np.isfinite(detector.saturation):
        # cut off below the limit that is stated: as full as those above it
        cube = np.where(piled, np.maximum(cube, 1.001 * detector.saturation), cube)
    if masters is not None:
        cube, good = masters.applied(cube, good, layout, detector)
    if not good.any():
        raise ObservationError(f"{path}: no pixel has a value")
    if several:
        # the noise of the mean is that of all of them
        empty = np.flatnonzero(~good.any(axis=(1, 2)))
        if empty.size:
            count = f"{empty.size} of its {len(good)} exposures, such as number {empty[0] + 1},"
            raise ObservationError(f"{path}: {count} have no pixel with a value; leave them out")
        # one saturated exposure spoils the mean, and is to be seen in it
        full = np.where(good, cube, -np.inf).max(axis=0) >= detector.saturation
        light = _light(cube, good, detector) if layout.beam_files else None
        # of few exposures a star may stand elsewhere than in the mean
        cube = np.where(full, detector.saturation, mean_of_exposures(cube, good)[0])
        good = (full | (good.mean(axis=0) > 0.5))[None]
    return primary, header, cube, good, light


# more than so many times the light of the same exposure is in one camera than in the other
_UNLIKE = 2.0


def _light(stack, good, detector):
    """Return the light of each exposure, where most of it is, or None if it is hardly any."""
    mean = np.where(good.all(axis=0), stack.mean(axis=0), -np.inf)
    # a tenth of the pixels: those of a lamp, or of a star and its halo
    bright = mean >= np.quantile(mean, 0.9)
    # single pixels that are hot, or were hit, do not count
    sums = np.minimum(stack[:, bright], 3 * np.median(mean[bright])).sum(axis=1)
    level = np.median(sums) if np.isfinite(sums).all() else 0.0
    # that of the detector is the noise of the mean
    variance = len(stack) * (detector.photon_noise(level) + bright.sum() * detector.read_noise**2)
    return sums if level > 20 * np.sqrt(variance) else None


def _check_exposures(path, light, left, theirs):
    """Refuse means to which both cameras do not contribute the same exposures."""
    if light is None or theirs is None or len(light) != len(theirs):
        return
    # of the usual exposure the ratio is one
    ours, theirs = (np.maximum(each / np.median(each), 0.0) for each in (light, theirs))
    wrong = np.flatnonzero((ours > _UNLIKE * theirs) | (theirs > _UNLIKE * ours))
    if wrong.size:
        first = wrong[0]
        raise ObservationError(
            f"{path}: {wrong.size} of its {len(light)} exposures, such as number {first + 1} with "
            f"{ours[first]:.0%} of the usual light, where {left.name} has {theirs[first]:.0%}, "
            "are not the same in both cameras; leave them out"
        )


def _check_header(frame, layout, source):
    """Add what is missing or contradictory to the errors of a frame."""
    values, keywords = frame.values, layout.keywords
    foreign = not_of_instrument(values, layout)
    frame.errors += [foreign] if foreign else []
    frame.errors += [
        f"no keyword {keywords[column]} in its header"
        for column in layout.stages
        if column in keywords and column not in values and not frame.errors
    ]
    try:
        time = observation_time(values)
        values.setdefault("mjd", float(time.mjd))
        values.setdefault("date", time.isot[:10])
    except ObservationError as error:
        # without a time it is as good as any; not with a wrong one
        frame.errors += [str(error)] if "mjd" in values else []
    # of stars `check_stars` looks
    on_plate = tracking_error(values, layout, on_sky=False) if source != "star" else None
    if abs(on_plate or 0.0) > layout.tracking_tolerance:
        frame.doubts.append(
            f"{keywords['hwp_true']} and {keywords['hwp']} differ by more than "
            f"{layout.tracking_tolerance:g} deg, though the plate does not follow the sky"
        )


def check_stars(frames, layout, needed=True):
    """
    Compute the angles of the sky that headers lack, and check that the plates followed it.

    What is wrong or odd is added to the frames' ``errors`` and ``doubts``; that an angle is not
    known, if all are ``needed``.
    """
    # what could not be opened says nothing
    frames = [frame for frame in frames if frame.values]
    add_pointing(frames, layout, needed)
    name, most = layout.keywords.get("hwp_true", "hwp_true"), layout.tracking_tolerance
    for frame in frames:
        if not {"parallactic", "altitude"} <= frame.values.keys():
            continue
        # a plate that did not follow the sky spoils a frame without any other sign
        off = tracking_error(frame.values, layout)
        if off is None:
            words = "the tracking of the half-wave plate was not checked"
            frame.doubts.append(f"no keyword {name}: {words}")
        elif abs(off) > most:
            stated = f"{name} = {frame.values['hwp_true']:g} deg"
            law = f"{off:+.2f} deg off the tracking law; up to {most:g} deg is allowed"
            frame.errors.append(f"{stated} is {law}")


# ---- dark and flat of raw frames ----------------------------------------------------------------


# what the headers of a dark, or of a flat, must have in common with those of its frames; numbers
# may differ by so much, a part of them or degrees
_SETTINGS = {
    "dark": {"exposure_time": 0.01, "em_gain": 0.0, "read_mode": None, "camera": 0.0},
    "flat": {"filter": None, "camera": 0.0},
}


def contradictions(ours, theirs, columns, where):
    """Return in which columns the values of two headers differ, by more than is allowed."""
    found = []
    for column, tolerance in columns.items():
        one, other = ours.get(column), theirs.get(column)
        same = one == other
        if tolerance is not None and None not in (one, other):
            # half a turn is none of a plate and a derotator
            off = _half_turn(one - other) if column in ANGLES else (one - other) / (one or 1.0)
            same = abs(off) <= tolerance
        found += [] if same else [f"{column} = {one}, but {other} in {where}"]
    return found


@dataclass(frozen=True)
class Masters:
    """Files of a dark and of a flat, either of which may be None.

    Pixels without a value in either, and those at which the flat is not above zero, are bad. Where
    each camera writes files of its own, these are those of the right beam, and the others stand
    beside them. The flat is divided by its median; neither adds its own noise to the errors.
    """

    dark: str | None = None
    flat: str | None = None

    def check(self, layout):
        """Read all files, so that one that does not fit is named before any frame is reduced."""
        for path in self.files(layout):
            _image(path, layout.file_shape)

    def files(self, layout):
        """Return all files, those of left beams too."""
        given = [path for path in (self.dark, self.flat) if path]
        return [str(own) for path in given for own in (path, layout.left_file(path)) if own]

    def of_left(self, layout):
        """Return the files of the left beam."""
        return Masters(*(p and str(layout.left_file(p)) for p in (self.dark, self.flat)))

    def settings(self, layout):
        """Return what the headers of dark and flat say, by ``"dark"`` and ``"flat"``."""
        return {kind: read_header(path, layout).values for kind, path in vars(self).items() if path}

    @staticmethod
    def doubts(values, settings):
        """Return where ``settings`` that both state differ between a frame, and dark and flat."""
        for kind, told in settings.items():
            both = {c: n for c, n in _SETTINGS[kind].items() if c in values and c in told}
            yield from contradictions(values, told, both, f"its {kind}")

    def applied(self, cube, good, layout, detector):
        """Return a cube, or a stack of exposures, and its known pixels, less dark and over flat."""
        saturated = cube >= detector.saturation
        raw, cube = cube, np.asarray(cube, dtype=float)
        if self.dark is not None:
            dark, unit = _image(self.dark, layout.file_shape)
            if not dark[np.isfinite(dark)].any():
                raise ObservationError(f"{self.dark}: all its pixels are 0; give a dark, or none")
            if not detector.counts_in(unit):
                raise ObservationError(f"{self.dark} is in {unit}, the frame in {detector.unit}")
            cube, good = cube - dark, good & np.isfinite(dark)
        if self.flat is not None:
            flat, _ = _image(self.flat, layout.file_shape)
            lit = np.isfinite(flat) & (flat > 0)
            level = np.median(flat[lit]) if lit.any() else 1.0
            cube, good = cube / np.where(lit, flat / level, 1.0), good & lit
        # what was saturated is to be seen as such
        return np.where(good, np.where(saturated, raw, cube), 0.0), good


def _image(path, shape):
    """Return the first image of a file of a shape, or that of a slice, NaN where bad, and BUNIT."""
    if not Path(path).is_file():
        raise ParameterError(f"{path}: there is no such file")
    return _read_image(path, shape, Path(path).stat().st_mtime_ns)


# read once for all frames, and again when it has changed
@lru_cache(maxsize=8)
def _read_image(path, shape, changed):
    with readable_fits(path), open_fits(path) as stream, fits.open(stream, memmap=False) as hdus:
        shapes = []
        for hdu in (hdu for hdu in hdus if hdu.is_image and hdu.data is not None):
            data = hdu.data
            if data.shape in (shape, shape[1:], (1, *shape[1:])) and data.dtype.kind in "fiu":
                found = np.array(data, dtype=float)
                if not np.isfinite(found).any():
                    raise ObservationError(f"{path}: no pixel has a value")
                return found, _unit_of(hdu.header, hdus[0].header)
            shapes.append(str(data.shape))
    raise ObservationError(
        f"{path}: {', '.join(shapes) or 'no image'}; {shape} or {shape[1:]} is needed"
    )


# ---- beams on two cameras, each with a file of its own -------------------------------------------

# what the headers of both files must agree in, and by how much numbers may differ
_COMMON = {"hwp": 0.1, "derotator": 0.5, "exposure_time": 1e-3, "flc_state": None, "filter": None}
# the gains may differ, but a detector without one is of another kind
_COMMON |= {"em_gain": np.inf}


def match_beams(frame, layout, cube, detector):
    """
    Bring both images of a frame, the left one first, to the electrons of the right one.

    Returns the detector with that of the left beam, and the cube.
    """
    other = _left_header(frame, layout)
    # each camera is read out in its own way
    left = detector_of(layout, other.unit or detector.unit.to_string(), other.values)
    # to the electrons of the right one: single differences compare both beams
    if (factor := left.units_of(detector)) != 1.0:
        # the left image is the first half of the columns
        first = np.arange(cube.shape[-1]) < cube.shape[-1] // 2
        cube = cube * np.where(first, factor, 1.0)
    return replace(detector, left=left.in_units_of(detector)), cube


def _left_header(frame, layout):
    """Return that of the left beam; what contradicts the right one is an error of the frame."""
    path = layout.left_file(frame.path)
    other = read_header(path, layout)
    frame.errors += [f"{path.name}: {error}" for error in other.errors]
    # what the plate did while the cameras were exposed must be one thing
    frame.errors += contradictions(frame.values, other.values, _COMMON, path.name)
    for one, mark in zip((frame, other), layout.beam_files, strict=True):
        camera = one.values.get("camera")
        if camera is not None and not mark.endswith(f"{camera:g}"):
            keyword = layout.keywords["camera"]
            frame.errors.append(f"{keyword} = {camera:g}, its name says {mark!r}")
    return other


def beam_detectors(path, layout, values, unit=None):
    """
    Return the detectors of the right and the left beam, the same where one file holds both.

    ``values`` are those of the right beam's header, and ``unit`` its BUNIT.
    """
    right, left = detector_of(layout, unit, values), layout.left_file(path)
    if left is None:
        return right, right
    other = read_header(left, layout)
    return right, detector_of(layout, other.unit or unit, other.values)


# ---- science frames, before their light is measured ---------------------------------------------


# what the headers tell: date (or None) of each frame, dates of the first and the last, and mode and
# optics of all
Night = namedtuple("Night", "moments dates mode beam")


def read_night(files, instrument):
    """Return what headers tell; refuse frames that differ in their mode or optics."""
    if instrument.files is None:
        raise AstropolcalError(f"{instrument.name}: it is not known how its files look")
    # which keywords there are may depend on the mode
    layout = configured(instrument, files).files
    moments, modes = {}, {}
    for file in files:
        values = read_header(file, layout).values
        if values.get("filter"):
            # the first file of each mode, to be named
            modes.setdefault(values["filter"], file)
        moments[str(file)] = None
        try:
            moments[str(file)] = observation_time(values).isot
        except ObservationError as error:
            # whether a time is needed depends on the calibration; a wrong one is refused
            if "mjd" in values:
                raise ObservationError(f"{file}: {error}") from None
    if len(modes) > 1:
        (one, first), (other, second) = list(modes.items())[:2]
        raise ObservationError(f"{first} is in mode {one!r}, {second} in {other!r}: correct apart")
    # ISO dates sort as text; a calibration that holds at both ends holds between them
    known = sorted(filter(None, moments.values()))
    beam = told_beam([primary_header(file) for file in files], instrument, files)
    dates = list(dict.fromkeys(known[:1] + known[-1:]))
    return Night(moments, dates, next(iter(modes), None), beam)


def survey_frames(files, layout, *, raw=None, centre=None, exposed=False, ways=None):
    """Return angles of all frames, places of the star, exposures, and detectors of both beams.

    The places are None where the star is in the middle of each beam.

    ``raw`` is a folder of raw frames, ``centre`` the place of the star where it is known,
    ``exposed`` whether a file without an exposure time is refused. ``ways`` are what a user can do
    about a file that lacks ``"raw"``, ``"centre"`` or an ``"exposure"``, to be said.
    """
    ways = {"raw": "", "centre": "", "exposure": ""} | (ways or {})
    known = None if raw is None else raw_frames(raw, layout)
    found = _survey(files, layout, known, centre is None and not layout.centred)
    for file, frame in zip(files, found, strict=True):
        foreign = not_of_instrument(frame.values, layout)
        if foreign:
            raise ObservationError(f"{file}: {foreign}")
        if exposed and "exposure_time" not in frame.values:
            word = layout.keywords.get("exposure_time", "exposure_time")
            raise ObservationError(f"{file}: no keyword {word} in its header{ways['exposure']}")
        if frame.errors:
            way = ways["raw"] if raw is None and raw_may_tell(frame.errors, layout) else ""
            raise ObservationError(f"{file}: {'; '.join(frame.errors)}{way}")
    _check_one_target(files, found)
    odd = {}
    for file, frame in zip(files, found, strict=True):
        for words in frame.doubts:
            odd.setdefault(words, []).append(file)
    for words, of in odd.items():
        # their images are used as they are
        warn(f"{counted(len(of), 'file')}: {words}; the first is {of[0]}", stacklevel=3)
    if centre is None and not layout.centred:
        # (beam, x and y): the star moves over the slices by less than a fraction of a pixel
        seen = ((f.photometry, ~f.photometry.failed) for f in found)
        centre = [np.median(np.stack([p.x, p.y])[:, :, good], axis=2).T for p, good in seen]
        seen = np.isfinite(np.asarray(centre)).all(axis=(1, 2))
        if not seen.all():
            bad = files[int(np.argmin(seen))]
            raise ObservationError(f"{bad}: the star was not found{ways['centre']}")
    detectors = [_detectors(*both, layout) for both in zip(files, found, strict=True)]
    return _angles(found), centre, _brightness(files, found, detectors), detectors


def _detectors(file, frame, layout):
    """Return those of both beams of a frame, which know how sharp an image of a star may be."""
    widths = [] if frame.photometry is None else frame.photometry.fwhm
    seen = np.asarray(widths)[np.asarray(widths) > 0]
    factor = sharpest((np.median(seen) if seen.size else layout.fwhm) ** 2)
    both = beam_detectors(file, layout, frame.values, frame.unit)
    return tuple(replace(each, factor=factor) for each in both)


def _brightness(files, frames, detectors):
    """Return the relative brightness of a steady source, None where it is the same in all."""
    units = [right.unit for right, _ in detectors]
    for file, unit in zip(files, units, strict=True):
        if unit != units[0]:
            raise ObservationError(
                f"{files[0]} is in {units[0]}, {file} in {unit}: correct apart, or bring them to "
                "one unit"
            )
    exposure = np.array([frame.values.get("exposure_time", np.nan) for frame in frames])
    if not np.isfinite(exposure).all():
        # what a header does not say is not guessed
        exposure = np.ones(len(frames))
    # electrons grow with time; a unit of the data is so many of them, of all exposures of a mean
    number = np.array([frame.values.get("exposures", 1.0) for frame in frames])
    scale = exposure * number / [right.gain for right, _ in detectors]
    return scale / np.median(scale) if np.ptp(scale) > 1e-6 * scale.max() else None


def _check_one_target(files, frames):
    """Refuse frames with the same data, and warn of frames of different objects."""
    seen, objects = {}, {}
    for file, frame in zip(files, frames, strict=True):
        first = seen.setdefault(frame.digest, file) if frame.digest else file
        if first != file:
            raise ObservationError(f"{file}: the same data as {first}; leave one of them out")
        name = frame.values.get("object")
        if name:
            # written now so, now so
            objects.setdefault(re.sub(r"[^\w+-]|_", "", name).casefold(), (name, file))
    if len(objects) > 1:
        (one, first), (other, second) = list(objects.values())[:2]
        warn(f"{first} is of object {one!r}, {second} of {other!r}: corrected as one", stacklevel=4)


def _survey(files, layout, raw, find):
    """Return what is known of the files, with the places of a star that is to be found."""
    # to find the star takes the time of this step
    frames = [
        reduce_frame(file, layout, source="star", raw=raw) if find else _known(file, layout, raw)
        for file in files
    ]
    # of a star whose place is known, which angles are needed depends on the calibration
    check_stars(frames, layout, needed=find)
    return frames


def _known(path, layout, raw):
    """Return what is known of a frame whose light is not measured."""
    frame = read_header(path, layout, raw=raw)
    with readable_fits(path), open_fits(path) as stream, fits.open(stream) as hdus:
        # what is not there is refused where it is corrected
        if len(hdus) > layout.cube_extension and hdus[layout.cube_extension].data is not None:
            cube = hdus[layout.cube_extension]
            frame.unit = _unit_of(cube.header, hdus[0].header)
            frame.digest = _digest(cube.data)
    if layout.beam_files:
        _left_header(frame, layout)
    return frame


def _angles(frames):
    """Return a table of the angles and states that are known of all frames."""
    table = QTable()
    for name in ANGLES:
        # an angle that no header has is no column at all
        values = [frame.values.get(name, np.nan) for frame in frames]
        if np.isfinite(values).any():
            table[name] = values * u.deg
    states = [frame.values.get("flc_state", "") for frame in frames]
    if any(states):
        table["flc_state"] = states
    if "hwp_true" in table.colnames and not np.isfinite(table["hwp_true"]).all():
        # an angle that some headers lack follows from the tracking law in all
        table.remove_column("hwp_true")
    return table
