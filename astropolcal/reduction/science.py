# Licensed under a 3-clause BSD style license - see LICENSE
"""What headers and images tell of science frames, before their light is measured."""

from contextlib import suppress
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.exceptions import AstropolcalError, ObservationError
from astropolcal.fitscheck import primary_header
from astropolcal.pipeline.headers import told_beam
from astropolcal.reduction.frames import beam_detectors, check_stars, reduce_frame
from astropolcal.reduction.headers import (
    add_pointing,
    configured,
    not_of_instrument,
    observation_time,
    raw_frames,
    read_header,
)

__all__ = []

# what a chain may ask of a frame
_ANGLES = ("hwp", "hwp_true", "derotator", "parallactic", "altitude")


@dataclass
class Night:
    """What the headers tell: date (or None) of each frame, and mode and optics of all."""

    moments: dict
    mode: str | None = None
    beam: dict = field(default_factory=dict)

    @property
    def dates(self):
        """Dates of the first and the last frame."""
        # ISO dates sort as text; a calibration that holds at both ends holds between them
        known = sorted(date for date in self.moments.values() if date)
        return list(dict.fromkeys((known[0], known[-1]))) if known else []


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
        # whether it is needed depends on the calibration
        with suppress(ObservationError):
            moments[str(file)] = observation_time(values).isot
    if len(modes) > 1:
        (one, first), (other, second) = list(modes.items())[:2]
        raise ObservationError(f"{first} is in mode {one!r}, {second} in {other!r}: correct apart")
    beam = told_beam([primary_header(file) for file in files], instrument, files)
    return Night(moments, next(iter(modes), None), beam)


def survey_frames(files, layout, *, raw=None, centre=None, ways=None):
    """
    Return angles of all frames, places of the star, exposures, and detectors of both beams.

    The places are None where the star is in the middle of each beam.

    ``raw`` is a folder of raw frames, ``centre`` the place of the star where it is known. ``ways``
    are what a user can do about a file that lacks ``"raw"`` or ``"centre"``, to be said.
    """
    ways = {"raw": "", "centre": ""} | (ways or {})
    known = None if raw is None else raw_frames(raw, layout)
    found = _read(files, layout, known, centre is None and not layout.centred)
    for file, frame in zip(files, found, strict=True):
        foreign = not_of_instrument(frame.values, layout)
        if foreign:
            raise ObservationError(f"{file}: {foreign}")
        if frame.errors:
            way = ways["raw"] if raw is None and layout.raw_columns else ""
            raise ObservationError(f"{file}: {'; '.join(frame.errors)}{way}")
    if centre is None and not layout.centred:
        # (beam, x and y): the star moves over the slices by less than a fraction of a pixel
        centre = [np.median([f.photometry.x, f.photometry.y], axis=2).T for f in found]
        seen = np.isfinite(np.asarray(centre)).all(axis=(1, 2))
        if not seen.all():
            bad = files[int(np.argmin(seen))]
            raise ObservationError(f"{bad}: the star was not found{ways['centre']}")
    # frames of equal exposures need no scale, known or not
    exposure = np.array([frame.values.get("exposure_time", np.nan) for frame in found])
    differ = np.isfinite(exposure).all() and np.ptp(exposure) > 1e-6 * exposure.max()
    detectors = [
        beam_detectors(file, layout, f.values, f.unit) for file, f in zip(files, found, strict=True)
    ]
    return _angles(found), centre, exposure / np.median(exposure) if differ else None, detectors


def _read(files, layout, raw, find):
    """Return what is known of the files, with the places of a star that is to be found."""
    if find:
        # finds the star, which takes the time of this step
        frames = [reduce_frame(file, layout, source="star", raw=raw) for file in files]
        check_stars(frames, layout)
        return frames
    frames = [read_header(file, layout, raw=raw) for file in files]
    # whether they are needed depends on the calibration
    add_pointing(frames, layout, needed=False)
    return frames


def _angles(frames):
    """Return a table of the angles and states that are known of all frames."""
    table = QTable()
    for name in _ANGLES:
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
