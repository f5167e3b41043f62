# Licensed under a 3-clause BSD style license - see LICENSE
"""
VLT/SPHERE/IRDIS, near-infrared dual-beam imaging polarimeter.

The chain and its values are those of van Holstein et al. (2020): the mirrors M1 to M3 of the
Unit Telescope as one optic, M4, half-wave plate, derotator, and the pair of polarizers. A
wavelength stands for one of the four broadband filters. The telescope's mirrors were
recoated on 2017-04-16; diattenuations are known before and after.

Beams have the names of the halves of the detector. The left one passes +Q, so single
differences here, right minus left, have the opposite sign of the published ones.
"""

from collections import ChainMap
from dataclasses import dataclass, replace
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.exceptions import ChainError, InstrumentError, ObservationError, warn
from astropolcal.instruments import telescope as shared
from astropolcal.instruments.base import Instrument, SkyLaw
from astropolcal.instruments.layout import COMMON, NO_LIGHT, RANGES, FileLayout, side_by_side
from astropolcal.observations.grid import is_star
from astropolcal.observations.pointings import location_of, offline, pointing
from astropolcal.observations.reading import stated_date
from astropolcal.units import iso_date, plain_number, wavelengths_of
from astropolcal.words import check_choice, counted

__all__ = ["IRDIS"]

# degrees: reading of the plate where theta = 0, and offset between pupil and derotator
_PLATE_ZERO, _PUPIL_OFFSET = 152.15, 135.99
# seconds: of the read-out of every DIT, and of the start of an exposure
_READ_OUT, _START = 0.938, 2.4
# degrees by which a stage or the sky may turn within a frame
_MOST_TURN = 90.0
# degrees by which a stage may turn more than the sky asks for
_MORE_TURN = 1.0
_COMMANDED = {"Qplus": 0.0, "Qminus": 45.0, "Uplus": 22.5, "Uminus": 67.5}
_STAGES = {"hwp_true": "ESO INS4 DROT3", "derotator": "ESO INS4 DROT2"}
_ROTATION, _STOKES = "ESO INS4 COMB ROT", "ESO OCS DPI H2RT STOKES"
_FILTER, _PARALLACTIC = "ESO INS1 FILT ID", "ESO TEL PARANG START"

# van Holstein et al. 2020, as distributed with their pipeline; one row per filter
_DATA = QTable.read(Path(__file__).parents[1] / "data" / "irdis.ecsv", format="ascii.ecsv")

#: Filters with coefficients, and the wavelengths that stand for them.
FILTERS = tuple(str(name) for name in _DATA["filter"])
# a copy: a column knows its table, and cannot go to other processes
CENTRES = _DATA["wavelength"].copy()
#: Day from which the telescope's mirrors have their new coating, and the names of both.
RECOATING = _DATA.meta["recoating"]
COATINGS = ("before", "after")
# central wavelengths by the filter
_BANDS = dict(zip(FILTERS, CENTRES, strict=True))


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
        if allowed is not None:
            check_choice(f"frame {self.number}: {key}", value, allowed, ObservationError)
        return value

    def number_of(self, key, low, high=np.inf):
        text = self.text(key)
        try:
            value = plain_number(text)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and low <= value <= high):
            limit = f" of at least {low:g}" if np.isinf(high) else f" from {low:g} to {high:g}"
            raise ObservationError(
                f"frame {self.number}: {key} = {text!r}; a number{limit} is needed"
            )
        return value

    def mean_angle(self, first, last):
        """Return the mean of two angles, and the turn from the first to the last."""
        ends = [self.number_of(key, *RANGES["parallactic"]) for key in (first, last)]
        turn = (ends[1] - ends[0] + 180) % 360 - 180
        # half a turn has no middle, and long before light of all angles is mixed
        if abs(turn) > _MOST_TURN:
            raise ObservationError(
                f"frame {self.number}: {first} = {ends[0]:g}, but {last} = {ends[1]:g}; within a "
                f"frame up to {_MOST_TURN:g} deg are allowed"
            )
        # on the circle: 359 and 3 deg have the mean 1, not 181
        return float(np.rad2deg(np.angle(np.exp(1j * np.deg2rad(ends)).sum()))), turn


def frame_table(headers, site, sky_law):
    """Return the table of frames from their headers, see the method of `IRDIS`."""
    if not headers:
        raise ObservationError("no headers were given, at least one is needed")
    frames = [_Header(number, header) for number, header in enumerate(headers)]
    stars = [_PARALLACTIC in frame for frame in frames]
    if len(set(stars)) > 1:
        raise ObservationError(f"frame {stars.index(False)}: no keyword {_PARALLACTIC}")
    bands = {_filter(frame) for frame in frames}
    kinds = ("FIELD", "PUPIL")
    trackings = {frame.text(_ROTATION, kinds).lower() if stars[0] else None for frame in frames}
    for what, found in (("filters", bands), ("kinds of tracking", trackings)):
        if len(found) > 1:
            names = ", ".join(sorted(map(str, found)))
            raise ObservationError(f"frames of several {what}: {names}")
    (band,), (tracking,) = bands, trackings
    rows = [_row(frame, tracking, site if stars[0] else None) for frame in frames]
    moved = [row.pop("moved") for row in rows]
    _warn_of_stages(frames, moved, tracking, sky_law)
    table = QTable({key: [row[key] for row in rows] for key in rows[0]})
    table["wavelength"] = np.full(len(rows), 1.0) * _BANDS[band]
    table.meta = {"filter": band, "date": str(table["time"][0])[:10]}
    table.meta |= {"tracking": tracking} if tracking else {}
    return table


def _filter(frame):
    name = frame.text(_FILTER)
    band = name.removeprefix("FILT_BBF_")
    if band == name or band not in _BANDS:
        raise InstrumentError(
            f"frame {frame.number}: {_FILTER} = {name!r} has no coefficients; allowed are "
            f"{', '.join(f'FILT_BBF_{known}' for known in _BANDS)}"
        )
    return band


def _row(frame, tracking, site):
    """Return the angles and times of a frame, of a star with the site of the telescope."""
    stages = {column: _stage(frame, keyword) for column, keyword in _STAGES.items()}
    angles = {column: mean for column, (mean, _) in stages.items()}
    moved = {column: turn for column, (_, turn) in stages.items()}
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
    if site is not None:
        angles["parallactic"] = frame.mean_angle(_PARALLACTIC, "ESO TEL PARANG END")[0]
        limits = {"RA": (0.0, 360.0), "DEC": (-90.0, 90.0)}
        target = SkyCoord(*(frame.number_of(key, *limits[key]) for key in limits), unit=u.deg)
        places = pointing(target, Time([start, middle]), location_of(site))
        # by how much altitude and parallactic angle change until the middle
        higher, turned = (float(np.diff(angle.to_value(u.deg))[0]) for angle in places)
        motion = (turned + 180) % 360 - 180, higher
        # of the start: an offset of what is computed cancels in the change
        angles["altitude"] = frame.number_of("ESO TEL ALT", 0.0, 90.0) + motion[1]
    commanded = _COMMANDED[frame.text(_STOKES, _COMMANDED)] if _STOKES in frame else None
    angles["hwp"] = angles["hwp_true"] if commanded is None else commanded
    row = {"frame": frame.number, "moved": moved | {"sky": motion}} | {
        key: value * u.deg for key, value in angles.items()
    }
    return row | {"exposure_time": dit * ndit * u.s, "time": moment}


def _stage(frame, keyword):
    """Return the mean angle of a stage, and its turn; of the start where there is no other."""
    first, last = f"{keyword} BEGIN", f"{keyword} END"
    if first not in frame and f"{keyword} START" in frame:
        first = f"{keyword} START"
    return frame.mean_angle(first, last if last in frame else first)


def _warn_of_stages(frames, moved, tracking, sky_law):
    """Say which angles are those of the start, and which stages turn more than with the sky."""
    for column, keyword in _STAGES.items():
        on_sky = (0.0, 0.0)
        if tracking is not None:
            law = sky_law.plate_law if column == "hwp_true" else sky_law.derotator_law
            on_sky = law(tracking)
        # until the middle of the exposure
        asked = np.abs([np.dot(on_sky, one["sky"]) for one in moved])
        beyond = np.abs([one[column] for one in moved]) - 2 * asked
        if (much := beyond > _MORE_TURN).any():
            warn(
                f"{keyword} BEGIN and END differ by up to {beyond.max():.2g} deg more than the sky "
                f"turns in {counted(int(much.sum()), 'frame')} of {len(frames)}, the first is "
                f"frame {int(much.argmax())}: {column} moved while the frame was taken, and is "
                "that of the middle",
                stacklevel=4,
            )
        few = [i for i, frame in enumerate(frames) if f"{keyword} END" not in frame]
        if not few:
            continue
        lost = asked[few].max()
        warn(
            f"no keyword {keyword} END in {counted(len(few), 'frame')} of {len(frames)}, the first "
            f"is frame {few[0]}: {column} is that of the start; until the middle of the exposure "
            f"it turns by up to {lost:.2g} deg",
            # _warn_of_stages, frame_table of this module, that of the instrument: who called it
            stacklevel=4,
        )


# a wavelength within this share of a filter's centre stands for the filter
_SAME_FILTER = 0.01


def filters_at(wavelength):
    """Return the index of the filter of every wavelength."""
    centres, lam = CENTRES.to_value(u.um), wavelengths_of(wavelength).to_value(u.um)
    index = np.abs(lam[:, None] / centres - 1).argmin(axis=1)
    # written so that NaN is off, too
    off = ~(np.abs(lam / centres[index] - 1) <= _SAME_FILTER)
    if off.any():
        known = ", ".join(f"{n} ({c:g} um)" for n, c in zip(FILTERS, centres, strict=True))
        raise InstrumentError(
            f"wavelength = {lam[off][0]:.6g} um is that of no filter with coefficients; "
            f"allowed are {known}"
        )
    return index


def coating_on(date):
    """Return which coating the telescope's mirrors had on a date, "before" or "after"."""
    return "before" if iso_date(date, error=InstrumentError)[:10] < RECOATING else "after"


def coating_of(coating, date):
    """Return the coating of a telescope that is put before a chain, by name or date."""
    if coating is not None:
        check_choice("coating", coating, COATINGS, InstrumentError)
    if date is None:
        if coating is None:
            warn(
                "irdis: neither date nor coating of the telescope was given; it is the one from "
                f"{RECOATING} on; give the date of the frames (date, or --date of a command), or "
                "coating='before' for older ones",
                # coating_of, telescope_optics, on_sky: the line that asked for a chain from the sky
                stacklevel=4,
            )
        return coating or "after"
    found = sorted({coating_on(day) for day in (date if np.ndim(date) else [date])})
    if len(found) != 1:
        words = f"of before and of after the recoating of {RECOATING}" if found else "none"
        raise InstrumentError(f"the dates are {words}; those of one coating are needed")
    if coating not in (None, *found):
        raise InstrumentError(
            f"coating = {coating!r}, but the date {date} is {found[0]} {RECOATING}"
        )
    return found[0]


def _retarder(index, name):
    """Return the half-wave plate or the derotator, by the name of its stage."""
    theta = _DATA.meta[f"{name}_theta_deg"]
    held = shared.misaligned(theta)
    held["bounds"] |= {"diattenuation": (-0.1, 0.1), "retardance": (0, 360)}
    values = {key: _DATA[f"{name}_{key}"][index] for key in ("diattenuation", "retardance")}
    settings = {"theta": theta * u.deg, "mount": name, "name": name}
    return optics.DiattenuatorRetarder(**values, **settings, **held)


def telescope(index, coating):
    """Return the optics from the sky to the half-wave plate."""
    check_choice("coating", coating, COATINGS, InstrumentError)
    retardance = _DATA["mirror_retardance"][index]
    values = {name: _DATA[f"{name}_diattenuation_{coating}"][index] for name in ("ut", "m4")}
    ut, m4 = (shared.free_mirror(*pair, retardance, most=0.1) for pair in values.items())
    return [*shared.telescope(ut, "altitude"), m4]


# ---- files -------------------------------------------------------------------------------------

#: What keeps the direction of polarization that is measured fixed to the image.
SKY_LAW = SkyLaw(
    plate={"field": (-1.0, 1.0), "pupil": (-0.5, 1.0)},
    derotator={"field": (-0.5, 0.5), "pupil": (0.0, 0.5)},
)
_PLATE, _TURN = (f"{_STAGES[name]} BEGIN" for name in ("hwp_true", "derotator"))


@dataclass(frozen=True)
class IrdisLayout(FileLayout):
    """Files whose angles follow from several keywords, see `frame_table`."""

    sky_law: SkyLaw = SKY_LAW

    def from_header(self, header):
        """Return a header with the angles, and the time, in the middle of the exposure."""
        table = frame_table([header], self.site, self.sky_law)
        (row,), kind = table, table.meta.get("tracking")
        # of a lamp there is none
        if kind and self.sky_law.plate_law(kind) != self.tracking:
            raise ObservationError(
                f"{_ROTATION} = {kind.upper()}, but most files have another: frames of one kind "
                "of tracking are needed"
            )
        angles = KEYWORDS.keys() & set(row.colnames)
        known = {KEYWORDS[name]: row[name].to_value(u.deg) for name in angles}
        with offline():
            known[self.keywords["mjd"]] = Time(str(row["time"]), scale="utc").mjd
        return ChainMap(known, header)

    def to_header(self, header):
        """Return the header of a frame with these angles, that of a star in field tracking."""
        own = {"ESO DET NDIT": 1} | dict(header)
        own[_PLATE] += _PLATE_ZERO
        own |= {f"{keyword} END": own[f"{keyword} BEGIN"] for keyword in _STAGES.values()}
        names = {angle: name for name, angle in _COMMANDED.items()}
        commanded = own.pop(_STOKES)
        # of an angle without a name the position tells
        own |= {_STOKES: names[commanded]} if commanded in names else {}
        if _PARALLACTIC not in own:
            return own
        # a star that is always up: by its motion the altitude is that of the start
        own = {_ROTATION: "FIELD", "RA": 0.0, "DEC": -80.0} | own
        own["ESO TEL PARANG END"] = own[_PARALLACTIC]
        _, motion = _row(_Header(0, own), None, self.site)["moved"]["sky"]
        return own | {"ESO TEL ALT": own["ESO TEL ALT"] - motion}


#: Column of the observation table to keyword.
KEYWORDS = {
    "hwp": _STOKES,
    "hwp_true": _PLATE,
    "derotator": _TURN,
    "parallactic": _PARALLACTIC,
    "altitude": "ESO TEL ALT",
}
# part of the sides of a half that the rectangles of the internal source have
_LIT = 0.7
#: Full frames, dark, flat and centred: both halves of the detector side by side.
LAYOUT = IrdisLayout(
    keywords=COMMON | KEYWORDS | {"exposures": "ESO DET NDIT", "filter": _FILTER},
    shape=(1, 1024, 2048),
    cube_extension=0,
    weights="error",
    identities=("SPHERE",),
    prefix="IRDIS_",
    gain=1.75,
    read_noise=10.0,
    saturation=30000.0,
    pixel_scale=12.25,
    tracking=SKY_LAW.plate_law("field"),
    site=shared.PARANAL,
    stacked=True,
    centred=True,
    wanted={
        "ESO DPR TYPE": NO_LIGHT,
        "ESO INS4 OPTI8 NAME": ("H_NIR", "the half-wave plate is not in the beam"),
        "ESO INS1 OPTI2 NAME": ("P0-90", "the pair of polarizers is not in the beam"),
    },
    **side_by_side(1024, 1024, _LIT),
)


class IRDIS(Instrument):
    """
    VLT/SPHERE/IRDIS in dual-beam polarimetric imaging.

    References
    ----------
    van Holstein et al. 2020, A&A 633, A64, doi:10.1051/0004-6361/201834996.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> irdis = instruments.get("irdis")
    >>> [optic.name for optic in irdis.chain("star")]
    ['star', 'parallactic', 'ut', 'altitude', 'm4', 'hwp', 'derotator', 'wollaston']
    """

    name = "irdis"
    aliases = ("SPHERE/IRDIS", "VLT/SPHERE/IRDIS")
    wavelength = CENTRES
    keywords = KEYWORDS
    files = LAYOUT
    references = (
        "van Holstein et al. 2020, A&A 633, A64, doi:10.1051/0004-6361/201834996",
        "de Boer et al. 2020, A&A 633, A63, doi:10.1051/0004-6361/201834989",
        "IRDAP, https://github.com/robvanholstein/IRDAP (keywords, limit of saturation)",
    )
    sources = (*shared.INTERNAL, *shared.STARS)
    sky_options = ("wavelength", "date")
    changes = (("ut", RECOATING, RECOATING, "the telescope's mirrors were recoated"),)
    #: Names of the filters with coefficients, in the order of ``wavelength``.
    filters = FILTERS
    sky_law = SKY_LAW
    #: Day from which the mirrors of the telescope have their new coating.
    recoating = RECOATING

    def chain(
        self,
        source="polarized",
        optics_in=(),
        *,
        wavelength=None,
        coating="after",
        star="star",
        target=None,
    ):
        """
        Return the chain of an internal source or a star, with the published values.

        Free are the retardances of half-wave plate and derotator and the diattenuations of plate
        and polarizers, one per filter, and the angles of plate and derotator; of stars also the
        diattenuations of telescope and M4, whose retardances are held. The diattenuation of the
        derotator, to which double differences are blind, is held.

        Parameters
        ----------
        source : str
            ``"polarized"``: internal source with its polarizer, whose angle is free.
            ``"unpolarized"``: without it; q and u of the light that reaches the half-wave plate
            are free, one per filter. ``"unpolarized standard star"``,
            ``"polarized standard star"`` or ``"star"``: downstream of telescope and M4.
        optics_in : sequence of str
            Nothing is optional here.
        wavelength : `~astropy.units.Quantity`, optional
            Filters by their central wavelengths, by default all four.
        coating : {"before", "after"}
            Coating of the telescope's mirrors: before or after 2017-04-16.

        Raises
        ------
        InstrumentError
            If a choice is unknown, or a wavelength is that of no filter with coefficients.

        Others, and what is returned and raised, are as in `Instrument.chain`.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import instruments
        >>> chain = instruments.get("irdis").chain("star", wavelength=[1.625] * u.um)
        >>> chain["derotator"].retardance.quantity.round(1)
        <Quantity 99.3 deg>
        """
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        # published coefficients are of filters: nothing is interpolated between them
        index = filters_at(grid)
        derotator = _retarder(index, "derotator")
        # double differences see it in second order only
        derotator.diattenuation.fixed = True
        # a pair of polarizers before the halves of the detector; the left beam passes +Q
        efficiency = _DATA["polarizer_efficiency"][index]
        analyser = optics.WollastonPrism(efficiency=efficiency, theta=90 * u.deg, name="wollaston")
        common = [_retarder(index, "hwp"), derotator, analyser]
        if source == "polarized":
            polarizer = optics.LinearPolarizer(name="calibration_polarizer", **shared.misaligned(0))
            return join([polarizer, *common])
        if source == "unpolarized":
            zero = np.zeros(index.size)
            # M4 and the lamp polarize together; only what reaches the plate can be measured
            return join([optics.PolarizedSource(q=zero, u=zero, name="lamp"), *common])
        light = shared.star_source(source, grid, star, target)
        return join([light, *telescope(index, coating), *common])

    def published(self):
        """Return the chain of the polarized internal source with the published values."""
        return self.chain("polarized")

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        # a star is seen through the mirrors of today
        return {"instrument": "SPHERE/IRDIS", "source": "polarized", "coating": "after"}

    def telescope_optics(self, behind, *, wavelength=None, coating=None, date=None):
        """
        Return the telescope as published, with M4, for ``on_sky``, which takes the same options.

        Parameters
        ----------
        behind : list of Optic
            The optics from the half-wave plate on.
        wavelength : `~astropy.units.Quantity`, optional
            Filters of the chain by their central wavelengths; needed if it is not of all four.
        coating : {"before", "after"}, optional
            Of the published telescope that is put in front: before or after 2017-04-16.
        date : str, ``datetime.date``, `~astropy.time.Time` or sequence of them, optional
            Of the frames, which tells the coating.

        Returns
        -------
        list of Optic

        Raises
        ------
        ChainError
            If the optics do not tell their filters.
        InstrumentError
            If the coating is unknown, is not that of the date, or the dates are of both.

        Warns
        -----
        AstropolcalWarning
            If neither coating nor date is given: it is then that of after the recoating.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> irdis = instruments.get("irdis")
        >>> [optic.name for optic in irdis.on_sky(irdis.published(), date="2016-05-01")][:4]
        ['parallactic', 'ut', 'altitude', 'm4']
        """
        sizes = {getattr(leaf, key).size for leaf in behind for key in leaf.param_names}
        if wavelength is None and max(sizes) != len(FILTERS):
            raise ChainError(
                f"irdis: the chain has {max(sizes)} values per parameter, and it is not known for "
                f"which of the filters {', '.join(FILTERS)}; give on_sky(chain, wavelength=...)"
            )
        return telescope(filters_at(self.grid(wavelength)), coating_of(coating, date))

    def particulars(self, observations):
        """Return the coating, by ``date`` or ``coating`` in the meta, and names of a star."""
        if not is_star(observations.source):
            return {}
        stated, name = observations.meta.get("coating"), observations.name
        if stated is not None:
            check_choice(f"{name}: coating", stated, COATINGS, InstrumentError)
        else:
            date = stated_date(observations.meta, name, InstrumentError)
            if date is None:
                raise InstrumentError(
                    f"{name}: neither date nor coating in the table's meta; were the "
                    f"telescope's mirrors those 'before' or 'after' {RECOATING}?"
                )
            stated = coating_on(date)
        return {"coating": stated} | super().particulars(observations)

    coating_on = staticmethod(coating_on)

    def configured(self, header):
        """Return the instrument with the filter and the shape of a file."""
        # a new one: the registry hands out instances that others may hold
        one, law = type(self)(), self.sky_law
        one.wavelength = np.atleast_1d(_BANDS[_filter(_Header(0, header))])
        # without NAXIS1 they are of full frames
        columns, rows = int(header.get("NAXIS1", 2048)), int(header.get("NAXIS2", 1024))
        # as high as broad is one half, and higher one that lies on its side
        if columns % 2 or min(rows, columns // 2) < 16 or rows >= columns:
            raise InstrumentError(
                f"irdis: images of {columns} x {rows} pixels; two halves side by side are needed, "
                "of 16 x 16 pixels and more each, broader together than high"
            )
        places = side_by_side(rows, columns // 2, _LIT) | {"tracking": law.plate_law("field")}
        if str(header.get(_ROTATION, "")).strip() == "PUPIL":
            # the offset of the plate to the pupil is not known: it is not checked
            places |= {"tracking": law.plate_law("pupil"), "tracking_tolerance": 90.0}
        one.files = replace(self.files, shape=(1, rows, columns), sky_law=law, **places)
        return one

    def mode_header(self, wavelength):
        """Return the filter in the headers of files of a wavelength."""
        found = [FILTERS[i] for i in filters_at(self.grid(wavelength))]
        if len(found) != 1:
            raise InstrumentError(
                f"irdis: a file is of one filter, not of {', '.join(found)}; give one wavelength, "
                "or a calibration of one filter"
            )
        return {_FILTER: f"FILT_BBF_{found[0]}"}

    def frame_table(self, headers):
        """
        Return angles, times and filters of frames from their headers.

        Parameters
        ----------
        headers : sequence of `~astropy.io.fits.Header` or mapping
            Primary headers of raw frames, all of one filter.

        Returns
        -------
        `~astropy.table.QTable`
            One row per frame: ``frame``, ``hwp`` (commanded), ``hwp_true``, ``derotator``,
            ``wavelength``, ``exposure_time``, ``time``, and of stars ``parallactic`` and
            ``altitude``, all in the middle of the exposure. With the fluxes of both beams it is
            a table of observations. The meta have instrument, filter, date and tracking.

        Raises
        ------
        ObservationError
            If a keyword is missing or impossible; the message names the frame.
        InstrumentError
            If the filter has no coefficients.

        Warns
        -----
        AstropolcalWarning
            If plate or derotator are known at the start of an exposure only (``BEGIN`` or
            ``START`` without ``END``), with how far they turn until its middle.

        Or if a stage turns within a frame by a degree more than the sky asks for.

        Notes
        -----
        Angles are the circular means of begin and end; ``hwp_true`` is that of ``ESO INS4
        DROT3`` less 152.15 deg, the derotator that of ``ESO INS4 DROT2``, plus half the pupil
        offset of 135.99 deg when it follows the pupil. The altitude in the header is that of
        the start; by how much it changes until the middle is computed. The duration is NDIT
        (DIT + 0.938 s) + 2.4 s.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> header = {"ESO INS1 FILT ID": "FILT_BBF_H", "ESO INS4 DROT3 BEGIN": 152.15,
        ...           "ESO INS4 DROT3 END": 152.15, "ESO INS4 DROT2 BEGIN": 359.5,
        ...           "ESO INS4 DROT2 END": 0.3, "MJD-OBS": 57900.0, "EXPTIME": 2.0,
        ...           "ESO DET NDIT": 4}
        >>> table = instruments.get("irdis").frame_table([header])
        >>> table["derotator"].round(6), table.meta["filter"]
        (<Quantity [-0.1] deg>, 'H')
        """
        table = frame_table(list(headers), self.files.site, self.sky_law)
        days = {self.coating_on(time) for time in table["time"]}
        if len(days) > 1:
            raise InstrumentError(
                f"the frames are from before and from after the recoating of {RECOATING}; "
                "make one table of each"
            )
        table.meta["instrument"] = "SPHERE/IRDIS"
        return table
