# Licensed under a 3-clause BSD style license - see LICENSE
"""
Where the telescope points: altitude, parallactic angle, and what follows them.

On sky, the light turns by the parallactic angle before the telescope and by the
altitude downstream of it, and the half-wave plate follows both. The angles come from the table, or
from time, target and site. An exposure takes time, and the angles change while it lasts:
a frame is then the mean over a few nodes of Gauss and Legendre.
"""

import warnings
from contextlib import contextmanager
from functools import lru_cache

import astropy.units as u
import numpy as np
from astropy.coordinates import Angle, EarthLocation, HADec, SkyCoord
from astropy.time import Time
from astropy.utils import iers
from astropy.utils.data import download_file
from astropy.utils.exceptions import AstropyWarning
from erfa import ErfaWarning

from astropolcal.exceptions import AstropolcalError, ObservationError, ParameterError, warn
from astropolcal.files import one_line, understood
from astropolcal.observations.reading import numeric_column
from astropolcal.optics import COORDINATES
from astropolcal.optics.positions import PLACES, counted, finite_position, is_move
from astropolcal.units import angle_to_rad, mjd_of, plain_number, to_unit
from astropolcal.words import check_choice, check_type

__all__ = ["location_of", "pointing"]

#: The tracking law of the half-wave plate (paper, Sec. 6.1): factors of parallactic angle
#: and altitude.
TRACKING = (0.5, 1.0)

# how far the middle of the exposure is from the moment of the angle, in exposures
_WHEN = {"start": 0.5, "middle": 0.0, "end": -0.5}
# an image rotator that has made half a turn is the same again; other angles need a whole one
_TURNS = {"derotator": np.pi}
# exact for degree 63: no angle of the sky is that wild within an exposure
_MOST_NODES = 32


# what was warned of in this process: the same holds for every frame and every star
_SAID = set()


@contextmanager
def offline():
    """Use the tables of leap seconds and of the Earth's rotation available; never the network."""
    with (
        # a calibration must not depend on a server, nor wait for one
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("auto_max_age", None),
        iers.conf.set_temp("iers_degraded_accuracy", "warn"),
        # of what matters `_warn_of_uncovered` warns
        warnings.catch_warnings(action="ignore", category=AstropyWarning),
        warnings.catch_warnings(action="ignore", category=ErfaWarning),
    ):
        yield


@contextmanager
def online():
    """Use new tables of the Earth's rotation from the network, for the time of a ``with`` block."""
    urls = [iers.conf.iers_auto_url, iers.conf.iers_auto_url_mirror]
    try:
        path = download_file(urls[0], sources=urls, cache="update", show_progress=False)
        table = iers.IERS_A.read(path)
    except (OSError, ValueError) as error:
        raise AstropolcalError(
            f"tables of the Earth's rotation cannot be had from {' or '.join(urls)}: "
            f"{one_line(error)}"
        ) from None
    with iers.earth_orientation_table.set(table):
        yield


def _warn_of_uncovered(time):
    """Warn once of times for which the difference of UT1 and UTC is not known."""
    with offline():
        days = iers.earth_orientation_table.get()["MJD"].value[[0, -1]]
        mjd, (first, last) = time.utc.mjd, Time(days, format="mjd").isot
    for uncovered, words in (
        (mjd < days[0], f"before {first[:10]}, where the tables of the Earth's rotation begin"),
        (mjd > days[1], f"after {last[:10]}, where the tables of the Earth's rotation end"),
    ):
        if np.any(uncovered) and words not in _SAID:
            _SAID.add(words)
            # 0.9 s of time are 13.5 arcsec of hour angle
            warn(
                f"times {words}: UT1 is taken as UTC. As long as leap seconds keep the two within "
                "0.9 s, the altitude is good to 0.004 deg, and the parallactic angle to 0.004 deg "
                "over the sine of the zenith distance, 0.2 deg at 1 deg from the zenith. Newer "
                "tables come with astropy-iers-data, or over the network with --online",
                stacklevel=3,
            )


def sky_angle(name, value):
    """
    Return a right ascension or a declination, by name, in degree.

    Plain numbers are degrees; sexagesimal right ascensions are hours. What is not an angle
    raises a ValueError.
    """
    try:
        angle = plain_number(value)
    except (TypeError, ValueError):
        angle = _sexagesimal(str(value), u.hourangle if name == "right_ascension" else u.deg)
    limit = 360 if name == "right_ascension" else 90
    if not abs(angle) <= limit:
        raise ValueError(f"{value!r} is not from {-limit} to {limit} deg")
    return angle


# the frames of a target have the same text
@lru_cache(maxsize=1024)
def _sexagesimal(text, unit):
    return float(Angle(text, unit=unit).to_value(u.deg))


def pointing(coord, time, location):
    """
    Return altitude and parallactic angle of a target.

    Refraction is left out. The parallactic angle refers to the celestial pole of date, as those of
    headers mostly do: from the pole of ICRS it is up to 0.3 deg off at a declination of 60 deg, 25
    years after 2000. Nothing is downloaded: the tables of the Earth's rotation are those
    that are installed (``astropy-iers-data``), or those that were given to
    `astropy.utils.iers.earth_orientation_table`.

    Parameters
    ----------
    coord : `~astropy.coordinates.SkyCoord`
        The target.
    time : `~astropy.time.Time`
        When, of any shape.
    location : `~astropy.coordinates.EarthLocation`
        Where.

    Returns
    -------
    altitude, parallactic : `~astropy.units.Quantity`
        Degree; the parallactic angle is between -180 and 180 deg, positive in the west.

    Raises
    ------
    ParameterError
        If the location is none.

    Warns
    -----
    AstropolcalWarning
        Once in a process, if the tables do not cover the times: UT1 is then taken as UTC. Leap
        seconds keep the two within 0.9 s, which is 0.004 deg of hour angle.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import EarthLocation, SkyCoord
    >>> from astropy.time import Time
    >>> from astropolcal.observations import pointing
    >>> site = EarthLocation(lon=-155.476 * u.deg, lat=19.8255 * u.deg, height=4139 * u.m)
    >>> altitude, parallactic = pointing(
    ...     SkyCoord(80 * u.deg, -1 * u.deg), Time("2025-11-03T13:00"), site)
    >>> altitude.round(1), parallactic.round(0)
    (<Quantity 69.1 deg>, <Quantity 6. deg>)
    """
    wanted = "the site of the telescope is needed, an EarthLocation"
    check_type("location", location, EarthLocation, wanted, ParameterError)
    with offline():
        seen = coord.transform_to(HADec(obstime=time, location=location))
    _warn_of_uncovered(time)
    hour, dec = seen.ha.rad, seen.dec.rad
    latitude = location.to_geodetic().lat.rad
    # spherical triangle of pole, zenith and star
    sine = np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)
    # not tan, which is infinite at the poles; atan2 knows the quadrant
    across = np.sin(hour) * np.cos(latitude)
    along = np.sin(latitude) * np.cos(dec) - np.cos(latitude) * np.sin(dec) * np.cos(hour)
    angles = np.arcsin(np.clip(sine, -1, 1)), np.arctan2(across, along)
    return tuple(np.rad2deg(angle) * u.deg for angle in angles)


def tracked(hwp, parallactic, altitude, law=TRACKING):
    """
    Return the true angle of a half-wave plate that follows the sky.

    The law are the factors of parallactic angle and altitude: theta' = theta + 0.5 p + a (paper,
    Sec. 6.1).
    """
    return hwp + law[0] * parallactic + law[1] * altitude


# ---- angles of a table -----------------------------------------------------------------------


def sky_angles(observations, location=None):
    """
    Return altitude and parallactic angle of every frame, radian, (F,).

    Each from the column of that name; else from ``time`` (UTC), ``right_ascension`` and
    ``declination`` (columns or meta, degree) and the `~astropy.coordinates.EarthLocation`.
    """
    names = "altitude", "parallactic"
    stated = [name in observations.frame_columns for name in names]
    angles = [None, None]
    if not all(stated):
        time, target = _times(observations.frames), _target(observations)
        needed = {
            "a column time (date and time of day)": time,
            "right_ascension and declination": target,
            "a site": location,
        }
        lacking = [words for words, thing in needed.items() if thing is None]
        if lacking:
            # angles of a header go by their keywords there
            called = getattr(observations, "keywords", {})
            absent = [called.get(n, n) for n, known in zip(names, stated, strict=True) if not known]
            raise ObservationError(
                f"{observations.name}: a star needs its pointing: columns altitude and "
                f"parallactic (there is no {' and no '.join(absent)}), or all of "
                f"{', '.join(needed)}; missing: "
                f"{getattr(observations, 'unfit', '') or ', '.join(lacking)}"
            )
        angles = [angle.to_value(u.rad) for angle in pointing(target, time, location)]
    # the stage of that name need not stand at the parallactic angle: what is stated counts
    altitude, parallactic = (
        observations.position(name) if known else angle
        for name, known, angle in zip(names, stated, angles, strict=True)
    )
    # written so that NaN is low
    low = ~(altitude > 0)
    if low.any():
        frame = int(np.argmax(low))
        raise ObservationError(
            f"{observations.name}, frame {frame_names(observations.frames)[frame]}: altitude = "
            f"{np.rad2deg(altitude[frame]):.4g} deg; a star is above 0 deg"
        )
    return altitude, parallactic


def _times(frames):
    """Return the times of frames that are times or dates as text; None if one is not known."""
    column = frames["time"] if "time" in frames.colnames else None
    if column is None or np.any(getattr(column, "mask", False)):
        return None
    if isinstance(column, Time):
        return column
    texts = np.asarray(column)
    # a date alone is no moment
    if texts.dtype.kind == "M":
        texts = np.datetime_as_string(texts)
    if texts.dtype.kind not in "SU" or not all(":" in str(text) for text in texts.astype(str)):
        return None
    try:
        with offline():
            return Time(texts, scale="utc")
    except ValueError:
        return None


def _target(observations):
    found = []
    for key in ("right_ascension", "declination"):
        if key in observations.frame_columns:
            angle = numeric_column(observations.frames, key, observations.name, u.deg) * u.deg
        else:
            angle = observations.meta.get(key)
        if angle is None:
            return None
        with understood(observations.name, ObservationError, key, reads=False):
            found.append(angle if isinstance(angle, u.Quantity) else sky_angle(key, angle) * u.deg)
    with understood(observations.name, ObservationError, "position", reads=False):
        return SkyCoord(*found)


# ---- exposures -------------------------------------------------------------------------------


def motion(observations, angle, duty=None, turn=2 * np.pi):
    """
    Return by how much an angle (radian, (F,)) changes while a frame is exposed.

    By the columns ``time`` and ``exposure_time``, or by ``duty``, the share of the time in which
    light is collected. After a ``turn`` the angle is the same again.
    """
    # the parallactic angle jumps by 360 deg north of the zenith
    steady = np.unwrap(np.asarray(angle, dtype=float), period=turn)
    change = np.zeros_like(steady)
    # the beams of an exposure, which are frames of a table, are taken at once
    beams = [np.sort(order) for order in _courses(observations)[1] if len(order) > 1]
    if not beams:
        return change
    light, seconds = (duty, None) if duty is not None else _exposed(observations)
    if duty is not None and not 0 <= duty <= 1:
        raise ObservationError(f"duty = {duty}; allowed is 0 to 1")
    for own in beams:
        place = np.arange(len(own)) if seconds is None else seconds[own]
        if np.any(np.diff(place) <= 0):
            raise ObservationError(f"{observations.name}: the times of the frames do not increase")
        # second order also where the frames are not evenly spaced
        change[own] = np.gradient(steady[own], place)
    return change * light


def _exposed(observations):
    """Return the exposure time of each frame, and its time since the first one, in seconds."""
    frames, times = observations.frames, clock(observations.frames)
    if "exposure_time" not in frames.colnames or times is None:
        raise ObservationError(
            f"{observations.name}: the motion within an exposure needs columns time and "
            "exposure_time, or duty=..., the share of the time in which light is collected"
        )
    exposure = numeric_column(frames, "exposure_time", observations.name, u.s)
    if (unit := getattr(frames["time"], "unit", None)) is None:
        times, unit = _place(observations, "time"), u.day
    # differences before the factor, which would cost five digits
    return exposure, ((times - times[0]) * unit).to_value(u.s)


def smeared(angle, change, nodes=3, when="middle"):
    """
    Return an angle (radian, (F,)) at the Gauss-Legendre nodes of every exposure, (nodes, F).

    ``change`` is that of `motion`, ``when`` the moment that the angle belongs to: start, middle or
    end. A measurement averages the fluxes of the nodes; three are exact to fifth degree in time.
    """
    check_choice("when", when, _WHEN, ObservationError)
    if not 1 <= nodes <= _MOST_NODES:
        raise ObservationError(f"nodes = {nodes}; allowed are 1 to {_MOST_NODES}")
    # on [-1, 1]; the weights are those that a measurement applies
    points, _ = np.polynomial.legendre.leggauss(nodes)
    share = 0.5 * points[:, None] + _WHEN[when]
    return np.asarray(angle, dtype=float) + share * np.asarray(change, dtype=float)


def sky_positions(observations, location=None, *, law=TRACKING, nodes=1, when="middle", duty=None):
    """
    Return altitude, parallactic, derotator and hwp, radian, (F,), or (nodes, F) for several nodes.

    One node, the middle, has shape (1, F) if the angles are of another moment. The plate stands at
    ``hwp_true`` where the table has it, else where the tracking law puts it.
    The other arguments are those of `sky_angles`, `tracked`, `smeared` and `motion`.
    """
    altitude, parallactic = sky_angles(observations, location)
    found = {"altitude": altitude, "parallactic": parallactic}
    if "derotator" in observations.frame_columns:
        found["derotator"] = observations.position("derotator")
    follows = tracked(0.0, parallactic, altitude, law)
    offset = angle_or_zero(observations, "hwp")
    if "hwp_true" in observations.frame_columns:
        # what the plate really did differs from the law by a constant offset in each frame
        offset = observations.position("hwp_true") - follows
    if (nodes, when) != (1, "middle"):
        found = {
            stage: smeared(angle, motion(observations, angle, duty, turn), nodes, when)
            for stage, angle in found.items()
            for turn in [_TURNS.get(stage, 2 * np.pi)]
        }
    if not {"hwp", "hwp_true"} & set(observations.frame_columns):
        return found
    follows = tracked(0.0, found["parallactic"], found["altitude"], law)
    return found | {"hwp": offset + follows}


def location_of(site):
    """
    Return the place of a telescope.

    Parameters
    ----------
    site : tuple of float
        Longitude and latitude in degree, height in metre; empty if it is not known.

    Returns
    -------
    `~astropy.coordinates.EarthLocation` or None

    Examples
    --------
    >>> from astropolcal.observations import location_of
    >>> location_of((-155.4761, 19.8255, 4139.0)).lat.deg.round(4)
    np.float64(19.8255)
    """
    if not len(site):
        return None
    longitude, latitude, height = site
    return EarthLocation(lon=longitude * u.deg, lat=latitude * u.deg, height=height * u.m)


def horizontal(altitude, parallactic):
    """Return altitude and parallactic angle in radian, refusing what no star can have."""
    return finite_position(altitude, "altitude"), angle_to_rad(parallactic, "parallactic")


# ---- other quantities of a frame -----------------------------------------------------------------

# tables of others number the states, and a reader may have turned the numbers into floats
_STATES = {"A": 0.0, "B": 1.0, "0": 0.0, "1": 1.0, "0.0": 0.0, "1.0": 1.0}


def frame_coordinate(observations, name):
    """
    Return one of `~astropolcal.optics.COORDINATES` of every frame, (F,), or (2, B, F) for fluxes.

    They are described in `Observations.position`. Persistence adds a share p of the frame before:
    it multiplies the flux by 1 / (1 - p F_before / F_now), a `~astropolcal.optics.FluxGain` with
    ``power=-1`` and ``mount="previous_flux"``.
    """
    if "=" in name:
        return in_state(observations.frames, name, observations.name)
    check_choice(f"{observations.name}: coordinate", name, COORDINATES, ObservationError)
    if name == "flc_state":
        return modulator_states(observations.frames, observations.name)
    if name in PLACES:
        return _place(observations, name)
    time, courses = _courses(observations)
    if name == "sequence":
        # affine in time, so that a drift has the same parameter whatever the unit of the clock
        passed = time - time.min()
        return passed / (passed.max() or 1.0)
    if name == "frame":
        return np.arange(observations.n_frames, dtype=float)
    if name.endswith("_rate"):
        stage = name.removesuffix("_rate")
        turn = _TURNS.get(stage, 2 * np.pi)
        return angle_change(observations, observations.position(stage), turn)
    if is_move(name):
        stage, _, what = name.rpartition("_")
        angle = observations.position(stage)
        out = np.zeros_like(angle)
        for order in courses:
            out[order] = _moved(angle[order], what)
        return out
    # (2, B, F): beam, wavelength, frame, as the optics of a chain want them
    fluxes = np.stack([observations.flux_right.T, observations.flux_left.T])
    if name == "flux":
        return np.where(observations.mask.T, 0.0, fluxes)
    if name == "brightness":
        return _brightness(fluxes.sum(axis=0), ~observations.mask.T)
    if name == "total_flux":
        # both entries alike: what depends on all of the light acts on both beams alike
        return np.where(observations.mask.T, 0.0, fluxes.sum(axis=0))[None].repeat(2, axis=0)
    # what the frame before leaves behind, of several beams that of the same one; the first has
    # none, and 1 changes nothing there, nor where there is no light
    ratio = np.ones_like(fluxes)
    for order in courses:
        now, before = fluxes[..., order[1:]], fluxes[..., order[:-1]]
        ratio[..., order[1:]] = np.divide(now, before, out=np.ones_like(now), where=before != 0)
    return np.where(np.isnan(ratio), 1.0, ratio)


def _moved(angle, what):
    """Return a move of a stage in each of some frames, (F,), from its angles in their order."""
    rows = np.arange(len(angle))
    if what == "reversed":
        # a cycle is the least period of the angles, or all of them
        tiled = (n for n in rows[2:] if np.array_equal(angle[n:], angle[:-n]))
        period = next(tiled, len(angle))
        other = rows - 2 * (rows % period) + period - 1
        return np.where(other < len(angle), angle[np.minimum(other, len(angle) - 1)] - angle, 0.0)
    word, count = counted(what)
    if word == "next":
        return angle[np.minimum(rows + count, rows[-1:])] - angle
    steps = angle - angle[np.maximum(rows - count, 0)]
    if word == "move":
        return steps
    # whether it was backwards; a stage that stays where it is was last moved as before
    return steps[np.maximum.accumulate(np.where(steps != 0, rows, 0))] < 0


def _brightness(flux, seen):
    """Return by what share frames are brighter than the mean of all, (F,), from tables (B, F)."""
    flux = np.where(seen, flux, 0.0)
    usual = flux.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    # as much as a usual frame has in the wavelengths that this one has
    usual = usual @ seen
    return np.divide(flux.sum(axis=0), usual, out=np.ones_like(usual), where=usual != 0) - 1


def _place(observations, name):
    """Return the moment (Modified Julian Date) or the place in the field (arcsec) of each frame."""
    frames = observations.frames
    if name not in frames.colnames:
        raise ObservationError(
            f"{observations.name}: no column {name!r}, which a law of a parameter needs; it has "
            f"{', '.join(frames.colnames)}"
        )
    if name != "time":
        return numeric_column(frames, name, observations.name, PLACES[name])
    times, unit = _times(frames), getattr(frames["time"], "unit", None)
    if times is None:
        times = clock(frames)
        if times is None:
            raise ObservationError(
                f"{observations.name}: column time; a law of a parameter needs a date in each frame"
            )
        times = times if unit is None else times * unit
    try:
        return mjd_of(times, f"{observations.name}: time")
    except ParameterError as error:
        raise ObservationError(str(error)) from None


def angle_or_zero(observations, stage):
    """Return the position of a stage, zero in all frames where the table has no such column."""
    if stage in observations.frame_columns:
        return observations.position(stage)
    return np.zeros(observations.n_frames)


def axes_apart(first, second):
    """Return the smallest angle, radian, between two axes: half a turn is none."""
    return np.abs(np.mod(first - second + np.pi / 2, np.pi) - np.pi / 2)


def in_state(frames, name, label):
    """Return 1 where a column of frames has a state, ``"COLUMN=STATE"``, and 0 elsewhere, (F,)."""
    column, _, state = name.partition("=")
    if column not in frames.keys():
        raise ObservationError(
            f"{label}: no column {column!r}, whose state {state!r} the chain needs; it has "
            f"{', '.join(frames.keys())}"
        )
    # states are known as text
    found = [str(value).strip() == state for value in np.atleast_1d(frames[column])]
    return np.array(found, dtype=float)


def angle_change(observations, angle, turn=2 * np.pi):
    """
    Return how an angle (radian, (F,)) changes from frame to frame, in the order of the times.

    That is half the change from the frame before to the one after, of the same beam where there are
    several. After a ``turn`` the angle is the same again.
    """
    out = np.zeros_like(angle)
    for order in _courses(observations)[1]:
        if len(order) > 1:
            # central differences, one-sided at both ends
            out[order] = np.gradient(np.unwrap(angle[order], period=turn))
    return out


def clock(frames):
    """
    Return the times of frames as numbers, in days or in the unit of the column.

    None without a column ``time`` of times, dates or numbers, or if one is unknown.
    """
    times = _times(frames)
    if times is not None:
        # a double resolves a microsecond of a modified Julian date
        return np.asarray(times.mjd)
    column = frames["time"] if "time" in frames.colnames else None
    if getattr(getattr(column, "dtype", None), "kind", "") not in tuple("iuf"):
        return None
    # one unknown time makes the order of all frames doubtful, so none is used then
    times = to_unit(column, getattr(column, "unit", None), "time")
    return times if np.all(np.isfinite(times)) else None


def frame_names(frames):
    """Return what messages call the frames of a table: their number, and the beam where needed."""
    numbers = [str(number) for number in frames["frame"]]
    if len(set(numbers)) == len(numbers):
        return numbers
    return [f"{one} (beam {beam})" for one, beam in zip(numbers, frames["beam"], strict=True)]


def modulator_states(frames, label):
    """Return 0 or 1 for the states A and B of a modulator in each frame, (F,)."""
    if "flc_state" not in frames.colnames:
        raise ObservationError(
            f"{label}: no column flc_state; it is needed, with A or B in each frame"
        )
    # strings, bytes and numbers alike become text here
    found = [_STATES.get(str(value).strip().upper()) for value in frames["flc_state"]]
    if None in found:
        i = found.index(None)
        frame = frame_names(frames)[i] if "frame" in frames.colnames else i
        raise ObservationError(
            f"{label}: flc_state = {str(frames['flc_state'][i])!r} in frame {frame}; allowed are A "
            "and B, or 0 and 1"
        )
    return np.array(found, dtype=float)


def _courses(observations):
    """Return the time of each frame, or its place in the order, and the frames of each beam by it.

    The beams of an exposure, which are frames of a table, are taken at once.
    """
    frames, count = observations.frames, observations.n_frames
    times, beams = clock(frames), np.asarray(frames.columns.get("beam", np.zeros(count)))
    own = [np.flatnonzero(beams == beam) for beam in np.unique(beams)]
    # a date alone is the same in all frames, and says no more than none
    if times is None or not np.ptp(times) > 0:
        times, seen = np.zeros(count), {beams[0]}
        for i, beam in enumerate(beams[1:], start=1):
            # one that comes again begins another exposure
            times[i] = times[i - 1] + (beam in seen)
            seen = {beam} if beam in seen else {*seen, beam}
    # stable: frames of one time stay in the order of the table
    return times, [some[np.argsort(times[some], kind="stable")] for some in own]
