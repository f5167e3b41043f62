# Licensed under a 3-clause BSD style license - see LICENSE
"""
VLT/SPHERE/IRDIS, near-infrared dual-beam imaging polarimeter.

The chain and its values are those of van Holstein et al. (2020): the mirrors M1 to M3 of the
Unit Telescope as one optic, M4, half-wave plate, derotator, and the pair of polarizers. A
wavelength stands for one of the four broadband filters. The telescope's mirrors were coated
anew on 2017-04-16; diattenuations are known before and after.

Beams have the names of the halves of the detector. The left one passes +Q, so single
differences here, right minus left, have the opposite sign of the published ones.
"""

import re

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.time import Time

from astropolcal import optics
from astropolcal.chain import join, leaves, stages
from astropolcal.exceptions import ChainError, InstrumentError, ObservationError
from astropolcal.instruments.base import Instrument
from astropolcal.instruments.nuisance import without_nuisance
from astropolcal.instruments.telescope import star_source
from astropolcal.observations import is_star
from astropolcal.observations.pointing import location_of, pointing

__all__ = ["IRDIS"]

# van Holstein et al. 2020, as distributed with their pipeline; one value a filter
_FILTERS = ("Y", "J", "H", "Ks")
_CENTRES = (1.043, 1.245, 1.625, 2.182) * u.um
_HWP_RETARDANCE = (184.24489040687035, 177.52027378388257, 170.67214967707864, 177.61874393785442)
_HWP_DIATTENUATION = (
    -0.00021492286258857182, -0.00043278581895049085, -0.00029657803108325395,
    -0.00041456866069250524)  # fmt: skip
_DEROTATOR_RETARDANCE = (
    126.11957538036766,
    156.0584333408133,
    99.32313652084311,
    84.13439892002613,
)
_DEROTATOR_DIATTENUATION = (
    -0.0009423930026144313, -0.008303978181252019, -0.002260131403393225,
    0.0035517563420643166)  # fmt: skip
# computed by them from the refractive index of aluminium, and held: UT and M4 alike
_MIRROR_RETARDANCE = (171.891576898, 173.414169049, 174.998748608, 176.302288996)
_UT_DIATTENUATION = {
    "before": (0.023607413903534567, 0.016685701811847004, 0.012930082215499676,
               0.010575041739439168),
    "after": (0.01745394681183012, 0.01213513552053676, 0.009032205030412622,
              0.0074593218421309315),
}  # fmt: skip
_M4_DIATTENUATION = {
    "before": (0.018211735858186456, 0.012844478639635984, 0.009845229155837451,
               0.007766430613637994),
    "after": (0.018194769704367342, 0.013046513475544473, 0.009220985704954044,
              0.008078285701524354),
}  # fmt: skip
_POLARIZER = (0.9801695109615369, 0.9894796343284551, 0.9955313968849352, 0.9841908773870153)
_HWP_OFFSET, _DEROTATOR_OFFSET = -0.613158589269 * u.deg, 0.500072483779 * u.deg

_RECOATING = "2017-04-16"
_COATINGS = tuple(_UT_DIATTENUATION)
# a wavelength within this share of a filter's centre stands for the filter
_SAME_FILTER = 0.01

# hwp_true = hwp + f * parallactic + g * altitude: what keeps the direction of polarization that
# is measured fixed on the detector, with a derotator that follows the field, or the pupil
_TRACKING = {"field": (-1.0, 1.0), "pupil": (-0.5, 1.0)}

# longitude, latitude (deg) and height (m) of the telescope in the headers
_SITE = (-70.4045, -24.6268, 2648.0)


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
    wavelength = _CENTRES
    keywords = {
        "hwp_true": "ESO INS4 DROT3 BEGIN",
        "derotator": "ESO INS4 DROT2 BEGIN",
        "parallactic": "ESO TEL PARANG START",
        "altitude": "ESO TEL ALT",
    }
    references = (
        "van Holstein et al. 2020, A&A 633, A64, doi:10.1051/0004-6361/201834996",
        "de Boer et al. 2020, A&A 633, A63, doi:10.1051/0004-6361/201834989",
    )
    sources = (
        "polarized",
        "unpolarized",
        "unpolarized standard star",
        "polarized standard star",
        "star",
    )
    #: Names of the filters with coefficients, in the order of ``wavelength``.
    filters = _FILTERS
    #: Day from which the mirrors of the telescope have their new coating.
    recoating = _RECOATING

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
        and polarizers, one a filter, and the angles of plate and derotator; of stars also the
        diattenuations of telescope and M4, whose retardances are held. The diattenuation of the
        derotator, to which double differences are blind, is held.

        Parameters
        ----------
        source : str
            ``"polarized"``: internal source with its polarizer, whose angle is free.
            ``"unpolarized"``: without it; q and u of the light that reaches the half-wave plate
            are free, one a filter. ``"unpolarized standard star"``,
            ``"polarized standard star"`` or ``"star"``: behind telescope and M4.
        optics_in : sequence of str
            Nothing is optional here.
        wavelength : `~astropy.units.Quantity`, optional
            Filters by their central wavelengths, by default all four.
        coating : {"before", "after"}
            Coating of the telescope's mirrors: before or after 2017-04-16.
        star : str
            Name of the source optic in a star's chain.
        target : str, optional
            Name of the star, for what the catalogue of standards knows of it.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Raises
        ------
        InstrumentError
            If a choice is unknown, or a wavelength is that of no filter with coefficients.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import instruments
        >>> chain = instruments.get("irdis").chain("star", wavelength=[1.625] * u.um)
        >>> chain["derotator"].retardance.quantity.round(1)
        <Quantity 99.3 deg>
        """
        _choice("source", source, self.sources)
        if tuple(optics_in):
            raise InstrumentError(f"optics_in = {list(optics_in)}: no optic of irdis is optional")
        grid = self.wavelength if wavelength is None else np.atleast_1d(u.Quantity(wavelength))
        index = _filters_at(grid)
        common = [_half_wave_plate(index), _derotator(index), _polarizers(index)]
        if source == "polarized":
            return join([_calibration_polarizer(), *common])
        if source == "unpolarized":
            zero = np.zeros(index.size)
            return join([optics.PolarizedSource(q=zero, u=zero, name="lamp"), *common])
        light = star_source(source, grid, star, target)
        return join([light, *_telescope(index, coating), *common])

    def published(self):
        """
        Return the chain of the polarized internal source with the published values.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Examples
        --------
        >>> from astropolcal import instruments
        >>> instruments.get("irdis").published()["wollaston"].efficiency.value.round(3).tolist()
        [0.98, 0.989, 0.996, 0.984]
        """
        return self.chain("polarized")

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {"instrument": "SPHERE/IRDIS", "source": "polarized"}

    def on_sky(self, chain, *, wavelength=None, coating="after"):
        """
        Return the chain from the sky that has the optics of an internal chain.

        Parameters
        ----------
        chain : `~astropy.modeling.CompoundModel`
            A chain with a half-wave plate; one with the telescope already keeps it.
        wavelength : `~astropy.units.Quantity`, optional
            Filters of the chain by their central wavelengths; needed if it is not of all four.
        coating : {"before", "after"}
            Of the published telescope that is put in front: before or after 2017-04-16.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Raises
        ------
        ChainError
            If the chain has no half-wave plate, or does not tell its filters.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> irdis = instruments.get("irdis")
        >>> [optic.name for optic in irdis.on_sky(irdis.published(), coating="before")][:4]
        ['parallactic', 'ut', 'altitude', 'm4']
        """
        chain = without_nuisance(chain)
        found = leaves(chain)
        if "parallactic" in stages(chain):
            return chain
        start = next((i for i, leaf in enumerate(found) if leaf.name == "hwp"), None)
        if start is None:
            raise ChainError("irdis: the chain has no optic 'hwp' to put the telescope before")
        if wavelength is None:
            _check_all_filters(found[start:])
            wavelength = self.wavelength
        index = _filters_at(np.atleast_1d(wavelength))
        return join([*_telescope(index, coating), *found[start:]])

    def setup(self, observations):
        """
        Return source and optics in the beam, as the table's meta states them.

        Parameters
        ----------
        observations : Observations
            Its meta holds ``source``.

        Returns
        -------
        source : str
        optics_in : tuple of str
            Empty.

        Raises
        ------
        InstrumentError
            If the source is not known.
        """
        source = observations.source
        if source not in self.sources:
            raise InstrumentError(
                f"{observations.name}: source {source!r} in the table's meta; allowed are "
                f"{', '.join(self.sources)}"
            )
        return source, ()

    def particulars(self, observations):
        """
        Return the coating, and source optic and target of a star.

        Parameters
        ----------
        observations : Observations
            Of a star: its meta holds ``date`` (ISO), or ``coating``, which is
            ``before`` or ``after``; and ``object``.

        Returns
        -------
        dict

        Raises
        ------
        InstrumentError
            If the table of a star does not tell the coating.
        """
        if not is_star(observations.source):
            return {}
        own = {"coating": _coating(observations)}
        target = str(observations.meta.get("object") or "")
        words = re.sub(r"\W+", "", target)
        return own | ({"star": f"star_{words}", "target": target} if words else {})

    @staticmethod
    def coating_on(date):
        """
        Return which coating the telescope's mirrors had.

        Parameters
        ----------
        date : str or ``datetime.date``
            ISO date of the observation.

        Returns
        -------
        {"before", "after"}

        Raises
        ------
        InstrumentError
            If it is no date.

        Examples
        --------
        >>> from astropolcal.instruments import IRDIS
        >>> IRDIS.coating_on("2017-04-15"), IRDIS.coating_on("2017-04-16T03:00")
        ('before', 'after')
        """
        day = str(date)[:10]
        if not re.fullmatch(r"\d{4}-[01]\d-[0-3]\d", day):
            raise InstrumentError(f"date = {date!r}; an ISO date such as {_RECOATING} is needed")
        return "before" if day < _RECOATING else "after"

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`."""
        return location_of(_SITE)

    def positions(self, observations, chain, **exposure):
        """
        Return the position of every stage of the chain in each frame, in radian.

        The true angle of the half-wave plate is the column ``hwp_true``; where there is
        none, it follows from ``hwp`` by the tracking law that ``tracking`` in the meta names,
        ``field`` or ``pupil``.

        Parameters
        ----------
        observations : Observations
            The dataset.
        chain : Optic or `~astropy.modeling.CompoundModel`
            The chain.
        **exposure
            As for `Instrument.positions`.

        Returns
        -------
        dict of str to `~numpy.ndarray`

        Raises
        ------
        InstrumentError
            If a star has neither.
        """
        if {"parallactic", "altitude"} & set(stages(chain)):
            exposure = {"law": _law(observations)} | exposure
        return super().positions(observations, chain, **exposure)

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
            One row a frame: ``frame``, ``hwp`` (commanded), ``hwp_true``, ``derotator``,
            ``wavelength``, ``exposure_time``, ``time``, and of stars ``parallactic`` and
            ``altitude``, all in the middle of the exposure. With the fluxes of both beams it is
            a table of observations. The meta have instrument, filter, date and tracking.

        Raises
        ------
        ObservationError
            If a keyword is missing or impossible; the message names the frame.
        InstrumentError
            If the filter has no coefficients.

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
        ...           "ESO INS4 DROT3 END": 152.15, "ESO INS4 DROT2 BEGIN": 359.0,
        ...           "ESO INS4 DROT2 END": 3.0, "MJD-OBS": 57900.0, "EXPTIME": 2.0,
        ...           "ESO DET NDIT": 4}
        >>> table = instruments.get("irdis").frame_table([header])
        >>> table["derotator"].round(6), table.meta["filter"]
        (<Quantity [1.] deg>, 'H')
        """
        table = _frame_table(list(headers), self.location)
        days = {self.coating_on(time) for time in table["time"]}
        if len(days) > 1:
            raise InstrumentError(
                f"the frames are from before and from after the recoating of {_RECOATING}; "
                "make one table of each"
            )
        table.meta["instrument"] = "SPHERE/IRDIS"
        return table


def _choice(what, value, allowed):
    if value not in allowed:
        raise InstrumentError(f"{what} = {value!r}; allowed are {', '.join(allowed)}")


def _filters_at(wavelength):
    """Return the index of the filter of every wavelength."""
    centres, lam = _CENTRES.to_value(u.um), u.Quantity(wavelength).to_value(u.um)
    index = np.abs(lam[:, None] / centres - 1).argmin(axis=1)
    off = ~(np.abs(lam / centres[index] - 1) <= _SAME_FILTER)
    if off.any():
        known = ", ".join(f"{n} ({c:g} um)" for n, c in zip(_FILTERS, centres, strict=True))
        raise InstrumentError(
            f"wavelength = {lam[off][0]:.6g} um is that of no filter with coefficients; "
            f"allowed are {known}"
        )
    return index


def _check_all_filters(found):
    sizes = {getattr(leaf, key).size for leaf in found for key in leaf.param_names}
    if max(sizes) != len(_FILTERS):
        raise ChainError(
            f"irdis: the chain has {max(sizes)} values a parameter, and it is not known for which "
            f"of the filters {', '.join(_FILTERS)}; give on_sky(chain, wavelength=...)"
        )


def _coating(observations):
    stated = observations.meta.get("coating")
    if stated is not None:
        _choice(f"{observations.name}: coating", stated, _COATINGS)
        return stated
    if observations.meta.get("date") is None:
        raise InstrumentError(
            f"{observations.name}: neither date nor coating in the table's meta; were the "
            f"telescope's mirrors those 'before' or 'after' {_RECOATING}?"
        )
    return IRDIS.coating_on(observations.meta["date"])


def _law(observations):
    stated = observations.meta.get("tracking")
    if stated is None and "hwp_true" in observations.frames.colnames:
        # the law then only tells how the plate moves within an exposure
        return _TRACKING["field"]
    if stated not in _TRACKING:
        raise InstrumentError(
            f"{observations.name}: tracking is {stated!r} in the table's meta; without a column "
            f"hwp_true it must be one of {', '.join(_TRACKING)}"
        )
    return _TRACKING[stated]


def _at(values, index):
    return np.array(values)[index]


def _near(about):
    return {"fixed": {"theta": False}, "bounds": {"theta": (about - 5, about + 5)}}


def _plate(retardance, diattenuation, index, theta, **settings):
    held = _near(theta.value)
    held["bounds"] |= {"diattenuation": (-0.1, 0.1), "retardance": (0, 360)}
    return optics.DiattenuatorRetarder(
        diattenuation=_at(diattenuation, index),
        retardance=_at(retardance, index) * u.deg,
        theta=theta,
        **held,
        **settings,
    )


def _half_wave_plate(index):
    names = {"mount": "hwp", "name": "hwp"}
    return _plate(_HWP_RETARDANCE, _HWP_DIATTENUATION, index, _HWP_OFFSET, **names)


def _derotator(index):
    names = {"mount": "derotator", "name": "derotator"}
    derotator = _plate(
        _DEROTATOR_RETARDANCE, _DEROTATOR_DIATTENUATION, index, _DEROTATOR_OFFSET, **names
    )
    # double differences see it in second order only
    derotator.diattenuation.fixed = True
    return derotator


def _polarizers(index):
    # the left beam passes +Q
    return optics.WollastonPrism(
        efficiency=_at(_POLARIZER, index), theta=90 * u.deg, name="wollaston"
    )


def _calibration_polarizer():
    return optics.LinearPolarizer(name="calibration_polarizer", **_near(0))


def _telescope(index, coating):
    _choice("coating", coating, _COATINGS)
    return [
        optics.Rotator(mount="parallactic", name="parallactic"),
        _mirror(_UT_DIATTENUATION[coating], index, "ut"),
        optics.Rotator(mount="altitude", name="altitude"),
        _mirror(_M4_DIATTENUATION[coating], index, "m4"),
    ]


def _mirror(diattenuation, index, name):
    return optics.DiattenuatorRetarder(
        diattenuation=_at(diattenuation, index),
        retardance=_at(_MIRROR_RETARDANCE, index) * u.deg,
        name=name,
        fixed={"retardance": True},
        bounds={"diattenuation": (-0.1, 0.1)},
    )


# ---- headers ---------------------------------------------------------------------------------

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
            value = float(text)
        except ValueError:
            value = np.nan
        if not (np.isfinite(value) and value >= low):
            limit = "" if np.isinf(low) else f" of at least {low:g}"
            raise ObservationError(
                f"frame {self.number}: {key} = {text!r}; a number{limit} is needed"
            )
        return value

    def mean_angle(self, first, last):
        ends = np.deg2rad([self.number_of(first), self.number_of(last)])
        return float(np.rad2deg(np.angle(np.exp(1j * ends).sum())))


def _frame_table(headers, location):
    if not headers:
        raise ObservationError("no headers were given, at least one is needed")
    frames = [_Header(number, header) for number, header in enumerate(headers)]
    stars = [_PARALLACTIC in frame for frame in frames]
    if len(set(stars)) > 1:
        raise ObservationError(f"frame {stars.index(False)}: no keyword {_PARALLACTIC}")
    shared = {_filter(frame) for frame in frames}, {_tracking(frame, stars[0]) for frame in frames}
    for what, found in zip(("filters", "kinds of tracking"), shared, strict=True):
        if len(found) > 1:
            raise ObservationError(
                f"frames of several {what}: {', '.join(sorted(map(str, found)))}"
            )
    (band,), (tracking,) = shared
    rows = [_row(frame, tracking, location if stars[0] else None) for frame in frames]
    table = QTable({key: [row[key] for row in rows] for key in rows[0]})
    table["wavelength"] = np.full(len(rows), _CENTRES[_FILTERS.index(band)].value) * u.um
    table.meta = {"filter": band, "date": str(table["time"][0])[:10]}
    table.meta |= {"tracking": tracking} if tracking else {}
    return table


def _filter(frame):
    name = frame.text(_FILTER)
    band = name.removeprefix("FILT_BBF_")
    if band == name or band not in _FILTERS:
        raise InstrumentError(
            f"frame {frame.number}: {_FILTER} = {name!r} has no coefficients; allowed are "
            f"{', '.join(f'FILT_BBF_{known}' for known in _FILTERS)}"
        )
    return band


def _tracking(frame, star):
    return frame.text(_ROTATION, ("FIELD", "PUPIL")).lower() if star else None


def _row(frame, tracking, location):
    angles = {
        column: frame.mean_angle(f"{keyword} BEGIN", f"{keyword} END")
        for column, keyword in _STAGES.items()
    }
    angles["hwp_true"] = (angles["hwp_true"] - _PLATE_ZERO) % 360
    angles["derotator"] += 0.5 * _PUPIL_OFFSET if tracking == "pupil" else 0.0
    dit, ndit = frame.number_of("EXPTIME", 0.0), frame.number_of("ESO DET NDIT", 1.0)
    seconds = ndit * (dit + _READ_OUT) + _START
    start = Time(frame.number_of("MJD-OBS", 0.0), format="mjd", scale="utc")
    middle = start + 0.5 * seconds * u.s
    if location is not None:
        angles["parallactic"] = frame.mean_angle(_PARALLACTIC, "ESO TEL PARANG END")
        angles["altitude"] = _altitude(frame, Time([start, middle]), location)
    commanded = _COMMANDED[frame.text(_STOKES, _COMMANDED)] if _STOKES in frame else None
    angles["hwp"] = angles["hwp_true"] if commanded is None else commanded
    row = {"frame": frame.number} | {key: value * u.deg for key, value in angles.items()}
    return row | {"exposure_time": dit * ndit * u.s, "time": middle.isot}


def _altitude(frame, times, location):
    """Return the altitude in the middle: that in the header and the change since the start."""
    target = SkyCoord(frame.number_of("RA"), frame.number_of("DEC", -90.0), unit=u.deg)
    start, middle = pointing(target, times, location)[0].to_value(u.deg)
    return frame.number_of("ESO TEL ALT", 0.0) + float(middle - start)
