# Licensed under a 3-clause BSD style license - see LICENSE
"""Headers of SPHERE/IRDIS frames: angles, times and filters in the middle of the exposures."""

import warnings

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time

from astropolcal.exceptions import AstropolcalWarning, InstrumentError, ObservationError
from astropolcal.observations.pointings import offline, pointing
from astropolcal.units import plain_number
from astropolcal.words import counted

__all__ = ["frame_table"]

# degrees: reading of the plate where theta = 0, and offset between pupil and derotator
_PLATE_ZERO, _PUPIL_OFFSET = 152.15, 135.99
# seconds: of the read-out of every DIT, and of the start of an exposure
_READ_OUT, _START = 0.938, 2.4
_COMMANDED = {"Qplus": 0.0, "Qminus": 45.0, "Uplus": 22.5, "Uminus": 67.5}
_STAGES = {"hwp_true": "ESO INS4 DROT3", "derotator": "ESO INS4 DROT2"}
_ROTATION, _STOKES = "ESO INS4 COMB ROT", "ESO OCS DPI H2RT STOKES"
_FILTER, _PARALLACTIC = "ESO INS1 FILT ID", "ESO TEL PARANG START"


class _Header:
    """The keywords of a frame, with an error that names both where one is missing."""

    def __init__(self, number, header):
        self.number, self.header = number, header

    def __contains__(self, key):
        return key in self.header

    def text(self, key, allowed=None):
        if key not in self.header:
            raise ObservationError(f"frame {self.number}: no keyword {key} in its header")
        value = str(self.header[key]).strip()
        if allowed is not None and value not in allowed:
            raise ObservationError(
                f"frame {self.number}: {key} = {value!r}; allowed are {', '.join(allowed)}"
            )
        return value

    def number_of(self, key, low=-np.inf):
        text = self.text(key)
        try:
            value = plain_number(text)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and value >= low):
            limit = "" if np.isinf(low) else f" of at least {low:g}"
            raise ObservationError(
                f"frame {self.number}: {key} = {text!r}; a number{limit} is needed"
            )
        return value

    def mean_angle(self, first, last):
        # on the circle: 359 and 3 deg have the mean 1, not 181
        ends = np.deg2rad([self.number_of(first), self.number_of(last)])
        return float(np.rad2deg(np.angle(np.exp(1j * ends).sum())))


def frame_table(headers, location, filters, law):
    """
    Return the table of frames from their headers, see `astropolcal.instruments.IRDIS`.

    Parameters
    ----------
    headers : list of mappings
        One a frame.
    location : `~astropy.coordinates.EarthLocation`
        Site of the telescope.
    filters : dict of str to `~astropy.units.Quantity`
        Central wavelength of every filter with coefficients.
    law : SkyLaw
        How plate and derotator follow the sky.

    Returns
    -------
    `~astropy.table.QTable`

    Raises
    ------
    ObservationError, InstrumentError
        If a header cannot be used; the message names frame and keyword.

    Warns
    -----
    AstropolcalWarning
        If the stages are known at the start of an exposure only.

    Examples
    --------
    >>> from astropolcal.instruments._irdis_headers import frame_table
    >>> frame_table([], None, {}, None)
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: no headers were given, at least one is needed
    """
    if not headers:
        raise ObservationError("no headers were given, at least one is needed")
    frames = [_Header(number, header) for number, header in enumerate(headers)]
    stars = [_PARALLACTIC in frame for frame in frames]
    if len(set(stars)) > 1:
        raise ObservationError(f"frame {stars.index(False)}: no keyword {_PARALLACTIC}")
    shared = (
        {_filter(frame, filters) for frame in frames},
        {_tracking(frame, stars[0]) for frame in frames},
    )
    for what, found in zip(("filters", "kinds of tracking"), shared, strict=True):
        if len(found) > 1:
            raise ObservationError(
                f"frames of several {what}: {', '.join(sorted(map(str, found)))}"
            )
    (band,), (tracking,) = shared
    rows = [_row(frame, tracking, location if stars[0] else None) for frame in frames]
    _warn_of_starts(frames, [row.pop("motion") for row in rows], tracking, law)
    table = QTable({key: [row[key] for row in rows] for key in rows[0]})
    table["wavelength"] = np.full(len(rows), 1.0) * filters[band]
    table.meta = {"filter": band, "date": str(table["time"][0])[:10]}
    table.meta |= {"tracking": tracking} if tracking else {}
    return table


def _filter(frame, filters):
    name = frame.text(_FILTER)
    band = name.removeprefix("FILT_BBF_")
    if band == name or band not in filters:
        raise InstrumentError(
            f"frame {frame.number}: {_FILTER} = {name!r} has no coefficients; allowed are "
            f"{', '.join(f'FILT_BBF_{known}' for known in filters)}"
        )
    return band


def _tracking(frame, star):
    return frame.text(_ROTATION, ("FIELD", "PUPIL")).lower() if star else None


def _row(frame, tracking, location):
    angles = {column: _stage(frame, keyword) for column, keyword in _STAGES.items()}
    angles["hwp_true"] = (angles["hwp_true"] - _PLATE_ZERO) % 360
    # the image turns by twice the derotator
    angles["derotator"] += 0.5 * _PUPIL_OFFSET if tracking == "pupil" else 0.0
    dit, ndit = frame.number_of("EXPTIME", 0.0), frame.number_of("ESO DET NDIT", 1.0)
    # EXPTIME is the light of one DIT, without its read-out
    seconds = ndit * (dit + _READ_OUT) + _START
    with offline():
        start = Time(frame.number_of("MJD-OBS", 0.0), format="mjd", scale="utc")
        middle, motion = start + 0.5 * seconds * u.s, (0.0, 0.0)
        moment = middle.isot
    if location is not None:
        angles["parallactic"] = frame.mean_angle(_PARALLACTIC, "ESO TEL PARANG END")
        motion = _motion(frame, Time([start, middle]), location)
        # of the start: an offset of what is computed cancels in the change
        angles["altitude"] = frame.number_of("ESO TEL ALT", 0.0) + motion[1]
    commanded = _COMMANDED[frame.text(_STOKES, _COMMANDED)] if _STOKES in frame else None
    angles["hwp"] = angles["hwp_true"] if commanded is None else commanded
    row = {"frame": frame.number, "motion": motion} | {
        key: value * u.deg for key, value in angles.items()
    }
    return row | {"exposure_time": dit * ndit * u.s, "time": moment}


def _motion(frame, times, location):
    """Return by how much parallactic angle and altitude change from one time to the other."""
    target = SkyCoord(frame.number_of("RA"), frame.number_of("DEC", -90.0), unit=u.deg)
    altitude, parallactic = (
        np.diff(angle.to_value(u.deg))[0] for angle in pointing(target, times, location)
    )
    return float((parallactic + 180) % 360 - 180), float(altitude)


def _stage(frame, keyword):
    """Return the mean angle of a stage, or that of the start where there is no other."""
    first, last = f"{keyword} BEGIN", f"{keyword} END"
    if first not in frame and f"{keyword} START" in frame:
        first = f"{keyword} START"
    return frame.mean_angle(first, last if last in frame else first)


def _warn_of_starts(frames, motions, tracking, law):
    """Say which angles are those of the start, and by how much the middle differs."""
    for column, keyword in _STAGES.items():
        few = [i for i, frame in enumerate(frames) if f"{keyword} END" not in frame]
        if not few:
            continue
        on_sky = (0.0, 0.0)
        if tracking is not None:
            on_sky = (law.plate_law if column == "hwp_true" else law.derotator_law)(tracking)
        lost = max(abs(np.dot(on_sky, motions[i])) for i in few)
        warnings.warn(
            f"no keyword {keyword} END in {counted(len(few), 'frame')} of {len(frames)}, the first "
            f"is frame {few[0]}: {column} is that of the start; until the middle of the exposure "
            f"it turns by up to {lost:.2g} deg",
            AstropolcalWarning,
            # _warn_of_starts, frame_table of this module, that of the instrument: who called it
            stacklevel=4,
        )
