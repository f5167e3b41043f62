# Licensed under a 3-clause BSD style license - see LICENSE
"""
How the FITS files of an instrument look, and what their headers say in the units of the layout.
"""

import math
import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import astropy.units as u
from astropy.io.fits import VerifyError
from astropy.io.fits.card import Undefined
from astropy.time import Time

from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.observations.pointings import offline
from astropolcal.units import iso_date, mjd_of, plain_number
from astropolcal.words import check_choice

__all__ = ["FileLayout", "ReadOut"]

#: By what factor a long multiplication register raises the photon noise.
EM_EXCESS_NOISE = math.sqrt(2)


@dataclass(frozen=True)
class ReadOut:
    """
    A way to read a detector out.

    Parameters
    ----------
    gain : float
        Electrons per adu.
    read_noise : float
        Of a pixel, electrons.
    saturation : float
        Value of a pixel, in adu, above which it is not linear.
    excess_noise : float
        Standard deviation of the signal over that of its photon noise; 1 without multiplication.

    Raises
    ------
    InstrumentError
        If a number is out of range.

    Notes
    -----
    In an EMCCD the number of electrons that leave the register for each that enters has a wide
    distribution, which raises the photon noise by a factor near the square root of 2 (Robbins &
    Hadwen 2003, IEEE Trans. Electron Devices 50, 1227, doi:10.1109/TED.2003.813462).

    Examples
    --------
    >>> from astropolcal.instruments.layout import ReadOut
    >>> ReadOut(gain=4.5, read_noise=90.0).multiplied(300).read_noise
    0.3
    """

    gain: float = 1.0
    read_noise: float = 0.0
    saturation: float = math.inf
    excess_noise: float = 1.0

    def __post_init__(self):
        positive = self.gain > 0 and self.saturation > 0
        if not (positive and self.read_noise >= 0 and self.excess_noise >= 1):
            raise InstrumentError(
                f"{self}: gain and saturation must be above zero, read_noise at least 0 and "
                "excess_noise at least 1"
            )

    def multiplied(self, em_gain):
        """Return gain and read noise in electrons before a multiplication by ``em_gain``."""
        return replace(self, gain=self.gain / em_gain, read_noise=self.read_noise / em_gain)


_WEIGHTS = ("inverse variance", "error")


@dataclass(frozen=True)
class FileLayout:
    """
    What a reduction must know of an instrument's FITS files.

    Positions are 0-based pixels (x, y), angles radian.

    Parameters
    ----------
    keywords : dict of str to str
        Column of the observation table to FITS keyword. Besides the columns of angles: ``hwp_true``
        (position of the half-wave plate, tracking included), ``exposure_time``, ``mjd``, ``date``,
        ``time`` (of day, both UTC), ``right_ascension``, ``declination``, ``object``,
        ``instrument``, ``filter`` and ``pickoff``.
    shape : tuple of int
        Of a cube: wavelengths, rows, columns.
    cube_extension : int
        Extension that holds the cube.
    alternatives : dict of str to tuple of str
        Column to further keywords, in which it is looked up in turn.
    units : dict of str to str
        Column to the unit of its keyword; degree where none is given.
    transforms : dict of str to (float, float) or dict
        Column to (factor, offset): value = factor * header + offset, in the
        unit of the keyword. Or to the value of each word that the keyword may have.
    raw_columns : tuple of str
        Columns looked up in the header of the raw frame where the cube lacks them.
    identities : tuple of str
        Values of the ``instrument`` keyword that belong to the instrument.
    frame_pattern : str
        Regular expression of the number that cube and raw frame share.
    prefix : str
        What stands before the number in the instrument's own names.
    original_name : str
        Keyword in which a reduced copy keeps the name of the original.
    gain : float
        Electrons per adu.
    read_noise : float
        Of a pixel of the cube, electrons.
    saturation : float
        Value of a pixel, in adu, above which it is not linear.
    beams : tuple of str
        Names of the beams in an image, 1 to N; a single one of any name is the column ``flux``.
    stages : tuple of str
        Columns of the stages that each frame must have, as far as they have keywords.
    texts : tuple of str
        Those of them that have states, whose names the keywords give.
    internal_apertures : tuple
        ((x, y) of the left rectangle, (x, y) of the right one, width, height,
        rotation); of other beams the places in the order of ``beams``.
    star_offset : tuple of float
        (x, y) from a star's image in the left beam to that in the right one.
    star_offsets : tuple of (float, float)
        Of other beams: places of a star's images, in the order of ``beams``, from a common one.
    pixel_scale : float
        Milliarcsecond.
    edge : float
        A star whose aperture comes closer to the edge, in pixels, is flagged.
    fwhm : float
        Of a star's image, in pixels, for finding it.
    tracking : tuple of float
        (f, g) of the law hwp_true = hwp + f * parallactic + g * altitude.
    tracking_tolerance : float
        Largest deviation from it, degree.
    hwp_step : float
        The commanded angles are multiples of it, degree.
    site : tuple of float
        Longitude and latitude in degree, height in metre.
    beam_files : tuple of str
        Marks in the names of the files of the right and of the left beam, where each camera
        writes files of its own; each ends with the number of its camera. The shape, and all
        places, are then those of both images side by side, the left one first.
    partners : dict of str to str
        File of the right beam to that of the left one, where headers tell and not the names.
    weights : {"inverse variance", "error"}
        What the extension after the cube holds.
    states : dict of str to str
        Value of the ``flc_state`` keyword to state of the modulator, "A" or "B"; "" for none.
    read_outs : dict of str to ReadOut
        Ways to read the detector out, by the value of the ``read_mode`` keyword, or that value
        and the number of the ``camera``, such as "slow 1"; ``em`` and ``conventional`` are the
        registers of an EMCCD, which has a keyword ``em_gain``. See `read_out`.
    stacked : bool
        Whether the first axis of an image of one wavelength may hold exposures, which are
        averaged; keyword ``exposures``: of how many an image in the file is the mean.
    centred : bool
        Whether the star has been moved to the middle of each beam, so that a correction need not
        find it.
    optics : dict of str to (str, dict of str to str)
        What headers say of optics in the beam: key of the table's meta to (column, {regular
        expression: word}). The first expression found in the column's text gives the word.
    wanted : dict of str to (str, str)
        What further keywords have to hold, if they are there: keyword to (regular expression,
        what is wrong with a frame that has another word).

    Raises
    ------
    InstrumentError
        If a number that must be positive is not, or the shape is not that of a cube.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> layout = instruments.get("charis").files
    >>> layout.keywords["hwp"], layout.shape
    ('RET-ANG1', (22, 201, 201))
    """

    keywords: dict
    shape: tuple
    cube_extension: int = 1
    alternatives: dict = field(default_factory=dict)
    units: dict = field(default_factory=dict)
    transforms: dict = field(default_factory=dict)
    raw_columns: tuple = ()
    identities: tuple = ()
    frame_pattern: str = r"(?<!\d)\d{8}(?!\d)"
    prefix: str = ""
    original_name: str = "ORIGNAME"
    gain: float = 1.0
    read_noise: float = 0.0
    saturation: float = float("inf")
    beams: tuple = ("right", "left")
    stages: tuple = ("hwp", "derotator")
    texts: tuple = ()
    internal_apertures: tuple = ()
    star_offset: tuple = (0.0, 0.0)
    star_offsets: tuple = ()
    pixel_scale: float = 1.0
    edge: float = 1.0
    fwhm: float = 4.0
    tracking: tuple = (0.5, 1.0)
    tracking_tolerance: float = 1.0
    hwp_step: float = 11.25
    site: tuple = ()
    beam_files: tuple = ()
    partners: dict = field(default_factory=dict)
    weights: str = _WEIGHTS[0]
    states: dict = field(default_factory=dict)
    read_outs: dict = field(default_factory=dict)
    stacked: bool = False
    centred: bool = False
    optics: dict = field(default_factory=dict)
    wanted: dict = field(default_factory=dict)

    def __post_init__(self):
        for name in ("gain", "saturation", "pixel_scale", "fwhm", "hwp_step"):
            if not getattr(self, name) > 0:
                raise InstrumentError(f"{name} = {getattr(self, name)}; it must be above zero")
        for name in ("read_noise", "edge", "tracking_tolerance"):
            if not getattr(self, name) >= 0:
                raise InstrumentError(f"{name} = {getattr(self, name)}; allowed are 0 and above")
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise InstrumentError(
                f"shape = {self.shape}; three positive numbers are needed (wavelength, y, x)"
            )
        check_choice("weights", self.weights, _WEIGHTS, InstrumentError)
        if not self.beams or len({*self.beams}) < len(self.beams):
            raise InstrumentError(f"beams = {self.beams}; names that differ are needed, at least 1")
        if len(self.star_offsets) not in (0, len(self.beams)):
            raise InstrumentError(
                f"star_offsets = {self.star_offsets}; one place for each of {', '.join(self.beams)}"
            )
        if len(self.beam_files) not in (0, 2):
            raise InstrumentError(
                f"beam_files = {self.beam_files}; the marks of the right and left beam are needed"
            )

    def from_header(self, header):
        """
        Return a header in which the keyword of each column holds what the column means.

        Here the same; an instrument that works its angles out of several keywords has its own.
        """
        return header

    def to_header(self, header):
        """Return the header, as the instrument writes it, from which `from_header` gets this."""
        return header

    @property
    def two_beams(self):
        """Whether the beams are the right and the left one."""
        return tuple(self.beams) == ("right", "left")

    @property
    def file_shape(self):
        """Shape of the cube in a file, which may be that of one beam only."""
        # with a file for each camera the shape is that of both images side by side
        slices, rows, columns = self.shape
        return (slices, rows, columns // 2) if self.beam_files else tuple(self.shape)

    def read_out(self, values):
        """Return how the detector was read out in a frame.

        ``values`` of its header are ``em_gain``, ``read_mode`` and ``camera``, as far as they are
        known. With an EM gain above one, gain and read noise are those before the multiplication;
        of a mean of several ``exposures`` they are those of the electrons of all.
        """
        how = ReadOut(self.gain, self.read_noise, self.saturation)
        em_gain, mode = values.get("em_gain"), values.get("read_mode")
        if em_gain is not None:
            if not (em_gain == 0 or em_gain >= 1):
                raise ObservationError(
                    f"{self.keywords['em_gain']} = {em_gain:g}; allowed are 0 (no multiplication) "
                    "and 1 and above"
                )
            # 0 and 1 both mean the conventional register, which has a noise of its own
            if em_gain <= 1:
                how = self.read_outs.get("conventional", how)
            else:
                multiplied = replace(how, excess_noise=EM_EXCESS_NOISE)
                how = self.read_outs.get("em", multiplied).multiplied(em_gain)
        elif mode is not None and self.read_outs:
            mode, camera = str(mode).strip().lower(), values.get("camera")
            # two cameras of one kind need not have the same noise
            names = [mode] if camera is None else [f"{mode} {camera:g}", mode]
            found = [name for name in names if name in self.read_outs]
            if not found:
                word, known = self.keywords["read_mode"], ", ".join(self.read_outs)
                raise ObservationError(f"{word} = {mode!r}; allowed are {known}")
            how = self.read_outs[found[0]]
        # of a single exposure so far
        n = values.get("exposures", 1)
        return replace(how, gain=how.gain * n, read_noise=how.read_noise * math.sqrt(n))

    def left_file(self, path):
        """
        Return the file of the left beam that belongs to one of the right beam.

        None where one file holds both.
        """
        if not self.beam_files:
            return None
        if str(path) in self.partners:
            return Path(self.partners[str(path)])
        path, (right, left) = Path(path), self.beam_files
        # the last one: a folder or target may have the mark in its name too
        head, found, tail = path.name.rpartition(right)
        if not found:
            raise ObservationError(
                f"{path}: a frame needs the file of the right beam, with {right!r} in its name"
            )
        return path.with_name(f"{head}{left}{tail}")

    def frame_files(self, files):
        """Return one file per frame, without those of left beams that belong to another file."""
        files = [str(path) for path in files]
        if not self.beam_files:
            return files
        # left files without a right one stay, so that the error names them
        mark, known = self.beam_files[0], self.partners
        rights = [path for path in files if str(path) in known or mark in Path(path).name]
        lefts = {str(self.left_file(path)) for path in rights}
        return [path for path in files if str(Path(path)) not in lefts]


def side_by_side(rows, columns, lit):
    """Return the places of beams whose images, of rows and columns, stand side by side.

    The rectangles of the internal source are the middle share ``lit`` of each side.
    """
    x, y = (columns - 1) / 2, (rows - 1) / 2
    return {
        "internal_apertures": ((x, y), (x + columns, y), lit * columns, lit * rows, 0.0),
        "star_offset": (float(columns), 0.0),
    }


#: Keywords that most instruments have, by the column of the table.
COMMON = {
    "exposure_time": "EXPTIME",
    "mjd": "MJD-OBS",
    "date": "DATE-OBS",
    "right_ascension": "RA",
    "declination": "DEC",
    "object": "OBJECT",
    "instrument": "INSTRUME",
}

#: Types of frames that have none of the light that is measured, by a keyword ``wanted``.
NO_LIGHT = (r"(?!.*\b(DARK|BIAS|SKY)\b).*", "it has no light of the source")

#: Columns that are angles of a stage.
ANGLES = ("hwp", "hwp_true", "derotator", "parallactic", "altitude")
#: Columns that are text, whatever they look like.
TEXTS = ("date", "time", "right_ascension", "declination", "object", "instrument")
TEXTS += ("filter", "pickoff", "flc", "flc_state", "read_mode")
#: Beyond these, in degree, an angle in a header cannot be right.
RANGES = dict.fromkeys(ANGLES, (-720.0, 720.0)) | {"altitude": (0.0, 90.0)}
# an exposure of zero seconds has no rate
RANGES |= {"em_gain": (0.0, 1e5), "exposures": (1.0, 1e6), "exposure_time": (5e-324, math.inf)}
# what a layout means that gives no unit, "" for a number; everything else is in degree
_UNITS = {"camera": "", "em_gain": "", "exposures": "", "exposure_time": "s", "mjd": "d"}

_MISSING = ("", "unavailable", "none", "nan", "n/a", "#")


def look_up(headers, column, layout):
    """Return the first keyword that holds a value for a column, and the value.

    Looked through are the headers in turn, for the ``keywords`` and ``alternatives`` of the
    layout. Without a value it is the first keyword (None if the layout knows none) and None, as
    for what stands for no value, such as "N/A".
    """
    return next(stated(headers, column, layout), (layout.keywords.get(column), None))


def stated(headers, column, layout):
    """Yield all keywords that hold a value for a column, with the value, see ``look_up``."""
    keywords = (layout.keywords.get(column), *layout.alternatives.get(column, ()))
    for header, keyword in product(headers, filter(None, keywords)):
        value = card_value(header, keyword)
        if value is None or isinstance(value, Undefined):
            continue
        if str(value).strip().lower() not in _MISSING:
            yield keyword, value


def unit_of(column, layout):
    """
    Return the unit of a column's keyword.

    Where the layout gives none, angles are in degree and times in seconds.
    """
    return u.Unit(layout.units.get(column, _UNITS.get(column, "deg")))


def card_value(header, keyword):
    """Return the value of a keyword, None without it; of a card that astropy cannot read, words."""
    try:
        return header.get(keyword)
    except VerifyError:
        # no number, and no text that anything answers to
        return "an unreadable card"


def convert(column, value, layout, target):
    """Return a value of a header as a float in a unit, or raise TypeError or ValueError."""
    law, unit = layout.transforms.get(column, (1.0, 0.0)), unit_of(column, layout)
    if isinstance(law, dict):
        if str(value).strip() not in law:
            raise ValueError(f"allowed are {', '.join(law)}")
        return law[str(value).strip()] * unit.to(target)
    factor, offset = law
    return (factor * plain_number(value) + offset) * unit.to(target)


def frame_value(column, keyword, value, layout):
    """Return what a header says of a column, a number in its unit or text, or raise ValueError."""
    if column == "flc_state":
        known = {"A": "A", "B": "B"} | layout.states
        # a whole number may be written as 1.0
        word = f"{value:g}" if isinstance(value, float) else str(value).strip()
        if word not in known:
            raise ValueError(f"{keyword} = {value!r}, allowed are {', '.join(known)}")
        return known[word]
    if column in TEXTS or column in layout.texts:
        return " ".join(str(value).split())
    target = {"exposure_time": u.s}.get(column, unit_of(column, layout))
    target = u.deg if column in ANGLES else target
    try:
        number = convert(column, value, layout, target)
    except (TypeError, ValueError) as error:
        stated = isinstance(layout.transforms.get(column), dict)
        needed = error if stated else "a number is needed"
        raise ValueError(f"{keyword} = {value!r}, {needed}") from None
    # two turns: encoders count on past 360 deg, but what is further out is no angle
    any_angle = (-720.0, 720.0) if target == u.deg else (-math.inf, math.inf)
    low, high = RANGES.get(column, any_angle)
    if not (math.isfinite(number) and low <= number <= high):
        allowed = "finite numbers" if math.isinf(low) else "numbers above zero"
        allowed = f"{low:g} to {high:g} {target}".strip() if math.isfinite(high) else allowed
        raise ValueError(f"{keyword} = {value}, allowed are {allowed}")
    return number


def frame_time(header, layout):
    """
    Return when a frame was taken (UTC), None if the header does not say.

    A date alone is its midnight; what cannot be understood raises TypeError or ValueError.
    """
    return time_of(*(look_up([header], key, layout)[1] for key in ("mjd", "date", "time")))


# these state the start of an exposure; others the middle, or it is not known
_STARTS = ("MJD-OBS", "MJD-STR", "MJD-BEG", "EXPSTART", "DATE-OBS", "DATE-BEG")
_DAY = 86400.0
# what tells how long an exposure is
_LENGTH = ("exposure_time", "exposures")
# in which the times and the places of targets are understood
_SYSTEMS = {"TIMESYS": r"None|UTC?(\(.*)?", "EQUINOX": r"None|J?2000(\.0*)?"}


def other_system(headers):
    """Return in words that headers have times or places in another system, or an empty text."""
    for header, (keyword, usual) in product(headers, _SYSTEMS.items()):
        value = card_value(header, keyword)
        if not re.fullmatch(usual, str(value).strip()):
            return f"{keyword} = {value!r}: times in UTC and places of J2000 are needed"
    return ""


def states_start(headers, layout):
    """Return whether the time of headers is that at which an exposure starts."""
    keyword, value = look_up(headers, "mjd", layout)
    return (look_up(headers, "date", layout)[0] if value is None else keyword) in _STARTS


def middle_time(header, layout):
    """Return the middle of an exposure (UTC), None where a header does not say the time of day."""
    mjd, date, clock = (look_up([header], key, layout)[1] for key in ("mjd", "date", "time"))
    if mjd is None and clock is None and ":" not in str(date):
        return None
    time, values = time_of(mjd, date, clock), {}
    for column in _LENGTH if states_start([header], layout) else ():
        keyword, value = look_up([header], column, layout)
        if value is not None:
            values[column] = frame_value(column, keyword, value, layout)
    return middle_of(time, values)


def middle_of(time, values):
    """Return the middle of an exposure that starts at a time, with its ``values`` of a header."""
    half = values.get("exposure_time", 0.0) * values.get("exposures", 1.0) / 2 / _DAY
    return Time(time.mjd + half, format="mjd", scale="utc") if half else time


# local and universal dates differ by one day at most
_DAYS_APART = 2.0


# a header is asked for its time by several who want to know it
@lru_cache(maxsize=4096, typed=True)
def time_of(mjd=None, date=None, clock=None):
    """Return the time (UTC) that a number of days, or a date and a time of day, state, or None."""
    if mjd is None:
        return _by_calendar(date, clock)
    time, stated = in_calendar(Time(plain_number(mjd), format="mjd", scale="utc")), None
    mjd_of(time, "Modified Julian Date")
    # a date that cannot be read contradicts nothing
    with suppress(TypeError, ValueError):
        stated = _by_calendar(date, None)
    if stated is not None and abs(time.mjd - stated.mjd - 0.5) > _DAYS_APART:
        raise ValueError(f"the Modified Julian Date {mjd} is {time.isot[:10]}, the date {date}")
    return time


def _by_calendar(date, clock):
    if date is None:
        return None
    day = iso_date(date)
    if "T" not in day and clock is not None:
        day = iso_date(f"{day}T{str(clock).strip()}")
    with offline():
        return in_calendar(Time(day, scale="utc"))


def in_calendar(time):
    """
    Return a time as it is if a calendar has its day, else raise a ValueError (ErfaError).

    Astropy takes any number as a day, and finds out in the first conversion only.
    """
    # years long before UTC was made are doubtful, but are years
    with offline():
        time.tai, time.isot  # noqa: B018
    return time
