# Licensed under a 3-clause BSD style license - see LICENSE
"""One file: its header, its cube, its fluxes, or the reason why there are none."""

import hashlib
import warnings
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from astropolcal.exceptions import ObservationError
from astropolcal.fitscheck import open_fits, readable_fits
from astropolcal.reduction.apertures import evenly_lit, measure_internal
from astropolcal.reduction.beams import match_beams
from astropolcal.reduction.errors import detector_of
from astropolcal.reduction.headers import (
    add_pointing,
    not_of_instrument,
    observation_time,
    read_header,
    tracking_error,
)
from astropolcal.reduction.photometry import Photometry
from astropolcal.reduction.stars import measure_stars

__all__ = ["Frame", "check_stars", "open_cube", "reduce_frame"]

_ARRAYS = (
    *("flux", "variance", "covariance", "scale", "scale_err"),
    *("x", "y", "fwhm", "radius", "background"),
)
_NEEDED = {"internal": ("hwp", "derotator"), "star": ("hwp", "derotator")}


@dataclass
class Frame:
    """
    What is known of one file.

    Attributes
    ----------
    path : str
        The cube.
    number : int or None
        Of the frame.
    values : dict
        Of the header, see `~astropolcal.reduction.headers.read_header`.
    errors, doubts : list of str
        Why it cannot be used, and what is odd.
    unit : str
        Of the fluxes.
    photometry : Photometry or None
        None if the file cannot be used.
    digest : str
        Of the fluxes, by which copies are recognized.

    Examples
    --------
    >>> from astropolcal.reduction.frames import Frame
    >>> Frame("CRSA00170808_cube.fits").usable
    False
    """

    path: str
    number: int | None = None
    values: dict = field(default_factory=dict)
    errors: list = field(default_factory=list)
    doubts: list = field(default_factory=list)
    unit: str = ""
    photometry: Photometry | None = None
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
        content = {name: getattr(self, name) for name in self.__dataclass_fields__}
        if self.photometry is not None:
            arrays = {name: getattr(self.photometry, name).tolist() for name in _ARRAYS}
            content["photometry"] = arrays | {"reasons": self.photometry.reasons}
        return content

    @classmethod
    def from_dict(cls, content):
        """Return the frame that `to_dict` described."""
        content = dict(content)
        if content["photometry"] is not None:
            plain = content["photometry"]
            arrays = {name: np.array(plain[name], dtype=float) for name in _ARRAYS}
            content["photometry"] = Photometry(**arrays, reasons=list(plain["reasons"]))
        return cls(**content)


def reduce_frame(path, layout, *, source="internal", raw=None, options=None):
    """
    Read a cube and measure both beams.

    Parameters
    ----------
    path : path-like
        The file.
    layout : FileLayout
        Of the instrument.
    source : {"internal", "star"}
        Which photometry.
    raw : dict of int to path-like, optional
        Raw frames by number.
    options : dict, optional
        For `~astropolcal.reduction.measure_internal` or
        `~astropolcal.reduction.measure_stars`.

    Returns
    -------
    Frame
        Whatever is wrong with the file is in its ``errors``.

    Raises
    ------
    ParameterError
        If an option is wrong: that would be so for every file.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.frames import reduce_frame
    >>> reduce_frame("nowhere_00000001.fits", instruments.get("charis").files).errors
    ['no such file']
    """
    frame = Frame(str(path))
    try:
        with open_cube(path, layout) as (primary, header, cube, good):
            # the header that is open already
            known = read_header(path, layout, header=primary, raw=raw)
            frame.number, frame.values = known.number, known.values
            frame.errors, frame.doubts = known.errors, known.doubts
            _check_header(frame, layout, source)
            unit = header.get("BUNIT", primary.get("BUNIT"))
            # per file: gain and exposure time may change within a night
            detector = detector_of(layout, unit, frame.values.get("exposure_time"), frame.values)
            if layout.beam_files:
                detector, cube = match_beams(frame, layout, cube, detector)
            frame.unit = detector.unit.to_string()
            measure = measure_stars if source == "star" else measure_internal
            frame.photometry = measure(cube, good, detector, layout, **(options or {}))
            if frame.photometry.outliers:
                frame.values["outliers"] = frame.photometry.outliers
                frame.doubts.append("single pixels far off their neighbours were left out")
            if source == "internal":
                frame.values["light"] = "even" if evenly_lit(cube, good, layout) else "uneven"
    except ObservationError as error:
        frame.errors.append(str(error).removeprefix(f"{path}: "))
        return frame
    result = frame.photometry
    frame.digest = hashlib.sha256(np.ascontiguousarray(result.flux).tobytes()).hexdigest()[:24]
    if result.failed.all():
        frame.errors.append(f"no slice can be used: {_most(result.reasons)}")
    return frame


def _most(reasons):
    return max(set(reasons), key=reasons.count)


@contextmanager
def open_cube(path, layout):
    """
    Give a cube and its headers, memory-mapped, for the time of a ``with`` block.

    Parameters
    ----------
    path : path-like
        The file.
    layout : FileLayout
        With ``cube_extension`` and ``shape``.

    Yields
    ------
    primary, header : `~astropy.io.fits.Header`
        Of the file and of the cube's extension.
    cube : `~numpy.ndarray`
        Shape (W, Y, X).
    good : `~numpy.ndarray` of bool or None
        Where it has values, by itself and by the inverse variances that may
        follow; None if everywhere.

    Raises
    ------
    ObservationError
        If the file is missing, truncated, no FITS file, or has no such extension
        or one of another shape; or if no pixel has a value.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.frames import open_cube
    >>> with open_cube("nowhere.fits", instruments.get("charis").files) as opened:
    ...     pass
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: nowhere.fits: no such file
    """
    with ExitStack() as stack:
        with readable_fits(path), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # astropy only warns of it, and fails later in other words
            warnings.filterwarnings("error", message=".*truncated.*")
            stream = stack.enter_context(open_fits(path))
            try:
                hdus = stack.enter_context(fits.open(stream, memmap=True))
                opened = _read(path, hdus, layout)
            except AstropyUserWarning as warning:
                # its type tells a user nothing
                raise OSError(str(warning)) from warning
        # behind the door: what fails in the caller's block is not the file's fault
        yield opened


def _read(path, hdus, layout):
    primary, header, cube, good = _read_beams(path, hdus, layout)
    left = layout.left_file(path)
    if left is None:
        return primary, header, cube, good
    if not left.is_file():
        raise ObservationError(f"{path}: no file {left.name} of the left beam beside it")
    # what is joined is in memory, so that this file need not stay open
    with (
        readable_fits(left),
        open_fits(left) as stream,
        fits.open(stream, memmap=False) as others,
    ):
        _, _, other, known = _read_beams(left, others, layout)
    joined = np.concatenate([other, cube], axis=-1)
    if good is not None or known is not None:
        parts = [
            np.ones(c.shape, bool) if g is None else g for c, g in ((other, known), (cube, good))
        ]
        good = np.concatenate(parts, axis=-1)
    return primary, header, joined, good


def _read_beams(path, hdus, layout):
    number = layout.cube_extension
    if len(hdus) <= number:
        raise ObservationError(
            f"{path}: no extension {number}, where the cube should be; it has {len(hdus)} HDUs"
        )
    data = hdus[number].data
    wanted = layout.file_shape
    if data is not None and data.ndim == 2 and wanted[0] == 1:
        data = data[None]
    if data is None or data.shape != wanted:
        shape = "no data" if data is None else f"shape {data.shape}"
        raise ObservationError(f"{path}: {shape} in extension {number}, {wanted} is needed")
    if data.dtype.kind not in "fiu":
        raise ObservationError(f"{path}: pixels of type {data.dtype}, numbers are needed")
    # FITS is big-endian, which slows down all that follows
    native = data.dtype.newbyteorder("=") if data.dtype.kind == "f" else float
    cube = np.asarray(data, dtype=native)
    # NaN marks what extraction could not reach
    good = np.isfinite(cube)
    weight = hdus[number + 1].data if len(hdus) > number + 1 else None
    if weight is not None and weight.size == cube.size:
        weight = weight.reshape(cube.shape)
        good &= np.asarray(weight) > 0
    if not good.any():
        raise ObservationError(f"{path}: no pixel has a value")
    return hdus[0].header, hdus[number].header, cube, None if good.all() else good


def _check_header(frame, layout, source):
    """Add what is missing or contradictory to the errors of a frame."""
    values = frame.values
    foreign = not_of_instrument(values, layout)
    frame.errors += [foreign] if foreign else []
    frame.errors += [
        f"no keyword {layout.keywords[column]} in its header"
        for column in _NEEDED[source]
        if column not in values and not _complained(frame, layout.keywords[column])
    ]
    _add_time(values)
    # of stars `check_stars` looks
    on_plate = tracking_error(values, layout, on_sky=False) if source != "star" else None
    if abs(on_plate or 0.0) > layout.tracking_tolerance:
        frame.doubts.append(
            f"{layout.keywords['hwp_true']} and {layout.keywords['hwp']} differ by more than "
            f"{layout.tracking_tolerance:g} deg, though the plate does not follow the sky"
        )


def _complained(frame, keyword):
    return any(error.startswith(keyword) for error in frame.errors)


def _add_time(values):
    if "mjd" not in values:
        try:
            values["mjd"] = float(observation_time(values).mjd)
        except ObservationError:
            return
    if "date" not in values:
        values["date"] = observation_time(values).isot[:10]


def check_stars(frames, layout):
    """
    Compute the angles of the sky that headers lack, and check that the plates followed it.

    Parameters
    ----------
    frames : list of Frame
        Of stars; what is wrong or odd is added to their ``errors`` and ``doubts``.
    layout : FileLayout
        Of the instrument.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.frames import Frame, check_stars
    >>> frame = Frame("CRSA00170808_cube.fits", values={"hwp": 0.0})
    >>> check_stars([frame], instruments.get("charis").files)
    >>> frame.errors
    ['no keyword PARANG and ALTITUDE in its header, and no date to compute the time from']
    """
    # what could not be opened says nothing
    frames = [frame for frame in frames if frame.values]
    add_pointing(frames, layout)
    for frame in frames:
        if {"parallactic", "altitude"} <= frame.values.keys():
            _check_tracking(frame, layout)


def _check_tracking(frame, layout):
    values = frame.values
    # a plate that did not follow the sky spoils a frame without any other sign
    off = tracking_error(values, layout)
    if off is None:
        frame.doubts.append(
            f"no keyword {layout.keywords.get('hwp_true', 'hwp_true')}: "
            "the tracking of the half-wave plate was not checked"
        )
    elif abs(off) > layout.tracking_tolerance:
        frame.errors.append(
            f"{layout.keywords['hwp_true']} = {values['hwp_true']:g} deg is {off:+.2f} deg off the "
            f"tracking law; up to {layout.tracking_tolerance:g} deg is allowed"
        )
