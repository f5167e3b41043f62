# Licensed under a 3-clause BSD style license - see LICENSE
"""
Which star to observe, when it is up and at which angles, and what it then tells of a telescope.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_sun
from astropy.table import QTable
from astropy.time import Time

from astropolcal.exceptions import ParameterError
from astropolcal.mueller import rotation_matrix
from astropolcal.observations.pointings import offline, pointing
from astropolcal.standards.priors import StandardStar, get, names
from astropolcal.units import angle_to_rad, iso_date, positive_number
from astropolcal.words import check_choice, did_you_mean

__all__ = ["observability", "search", "telescope_information"]

LIMIT = 30 * u.deg
# end of nautical twilight: standards are bright, the sky need not be quite dark
TWILIGHT = -12 * u.deg
STEP = 10 * u.min
# a coarser table would miss a transit, where the parallactic angle of a high star turns fast
_LARGEST_STEP = 60 * u.min

# east longitude and latitude in degree, height in metre
SITES = {
    "gemini_south": (-70.7367, -30.2407, 2738),
    "keck": (-155.4750, 19.8264, 4145),
    "paranal": (-70.4033, -24.6253, 2635),
    "subaru": (-155.4760, 19.8255, 4139),
}


def location(site):
    """Return the place on Earth that a name or an EarthLocation means."""
    if isinstance(site, EarthLocation):
        return site
    key = str(site).strip().lower().replace(" ", "_").replace("-", "_")
    if key in SITES:
        place = EarthLocation.from_geodetic(*SITES[key])
        place.info.name = key.replace("_", " ").title()
        return place
    raise ParameterError(
        f"site = {site!r} is not known{did_you_mean(key, SITES)} (known: {', '.join(SITES)}; any "
        "other as an EarthLocation)"
    )


def night_times(site, night, *, twilight, step):
    """Return the times of a night with the Sun below ``twilight``, ``step`` apart."""
    with offline():
        # from noon to noon, so that a night is never cut in two whatever the longitude
        date = Time(date_of(night, site), scale="utc")
        # a time of its own, which is printed to the second
        noon = Time(date.jd1, date.jd2, format="jd", scale="utc", precision=0)
        times = (noon + (0.5 - site.lon.to_value(u.deg) / 360) * u.day) + np.arange(
            0, 1, step.to_value(u.day)
        ) * u.day
        sun = get_sun(times).transform_to(AltAz(obstime=times, location=site)).alt
    dark = sun < twilight
    if not np.any(dark):
        raise ParameterError(
            f"night = {night!s}: the Sun does not go below {twilight.to_value(u.deg):g} deg "
            f"at this site; it gets to {sun.min().to_value(u.deg):.1f} deg"
        )
    return times[dark]


def date_of(night, site):
    """Return the date of the evening as text, of a moment that of its night, or raise."""
    try:
        if isinstance(night, Time) and night.mjd % 1:
            # nights begin at noon, of the mean Sun at the site
            night = night.utc + (site.lon.to_value(u.deg) / 360 - 0.5) * u.day
        text = iso_date(night.to_value("iso", "date") if isinstance(night, Time) else night)
        if "T" in text:
            raise ValueError
    except ValueError:
        raise ParameterError(
            f"night = {night!r} must be the date of the evening, such as '2025-11-03'"
        ) from None
    return text


def checked(min_altitude, twilight, step):
    """Return limits and step, or raise."""
    limit = np.rad2deg(float(angle_to_rad(min_altitude, "min_altitude"))) * u.deg
    dark = np.rad2deg(float(angle_to_rad(twilight, "twilight"))) * u.deg
    if not 0 <= limit.value < 90:
        raise ParameterError(f"min_altitude = {limit:g} must be from 0 to below 90 deg")
    if not -90 <= dark.value <= 0:
        raise ParameterError(f"twilight = {dark:g} must be from -90 to 0 deg")
    if not (isinstance(step, u.Quantity) and step.unit.is_equivalent(u.s)):
        raise ParameterError(f"step = {step!r} needs a unit of time")
    if not 0 * u.s < step <= _LARGEST_STEP:
        raise ParameterError(f"step = {step:g} must be positive and at most {_LARGEST_STEP:g}")
    return limit, dark, step


def night_table(times, altitude, parallactic, limit):
    """Return the table of one star over the dark hours."""
    # a star that culminates north of the zenith jumps from -180 to +180 deg there
    smooth, up = np.unwrap(parallactic, period=360 * u.deg), altitude >= limit
    lowest = np.min(smooth[up]) if np.any(up) else smooth[0]
    # from -180 deg on, so that a star that culminates in the north passes +180
    smooth = smooth - np.floor((lowest + 180 * u.deg) / (360 * u.deg)) * 360 * u.deg
    return QTable({"time": times, "altitude": altitude, "parallactic": smooth, "observable": up})


_NAMES = ("star_q", "star_u", "diattenuation", "offset_q", "offset_u")
# singular values below this part of the largest count as zero
_RANK = 1e-9


@dataclass(frozen=True, eq=False)
class TelescopeInformation:
    """
    Expected covariance of a star's polarization and a telescope's diattenuation.

    Parameters
    ----------
    names : tuple of str
        ``star_q``, ``star_u``, ``diattenuation``; with an offset also ``offset_q``, ``offset_u``.
    covariance : `~numpy.ndarray`
        In the order of ``names``; rows and columns of what the frames cannot separate are infinite.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.standards import telescope_information
    >>> info = telescope_information([-45, 45] * u.deg)
    >>> round(info.error("star_q"), 2)
    0.71
    """

    names: tuple
    covariance: np.ndarray

    def error(self, name):
        """Return the standard error of a parameter, infinite if the frames do not determine it."""
        check_choice("parameter", name, self.names, ParameterError)
        place = self.names.index(name)
        return float(np.sqrt(self.covariance[place, place]))

    @property
    def diattenuation(self):
        """Standard error of the telescope's diattenuation."""
        return self.error("diattenuation")


def telescope_information(
    parallactic, altitude=None, *, frame_error=1.0, star_error=None, offset=False
):
    r"""
    Return how well frames separate a telescope's diattenuation from the star.

    In the frame of a tertiary mirror the star turns by the parallactic angle
    :math:`\psi`, while the diattenuation :math:`D` of the mirror stays along q:

    .. math::
        q' = q \cos 2\psi + u \sin 2\psi + D, \qquad
        u' = -q \sin 2\psi + u \cos 2\psi .

    With an offset, the instrument adds a constant in its own frame, which is turned by minus the
    altitude as in the chain of an alt-azimuth telescope's Nasmyth focus. Each frame is taken to
    measure q' and u' with the same error; the covariance is that of linear least squares. For a
    star that is not known and without an offset,

    .. math:: \sigma_D = \sigma_\mathrm{frame} \big/ \sqrt{n (1 - R^2)}, \qquad
              R = \left|\frac1n \sum e^{2 i \psi}\right| ,

    so only the spread of the parallactic angle counts: a half turn of the double angle is all that
    one can wish for, and a star that barely rotates does not constrain it.

    Parameters
    ----------
    parallactic : `~astropy.units.Quantity`
        One angle per frame, shape (n,).
    altitude : `~astropy.units.Quantity`, optional
        One per frame; needed with ``offset``.
    frame_error : float
        Standard error of q and of u in one frame. The default of 1 gives errors in units of it.
    star_error : float, optional
        Standard error of the star's q and u in a catalogue; by default the star is not known.
    offset : bool
        Whether an offset of the instrument is determined as well.

    Returns
    -------
    ``TelescopeInformation``

    Raises
    ------
    ParameterError
        If angles are missing or do not match, or an error is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.standards import telescope_information
    >>> angles = np.linspace(-45, 45, 101) * u.deg
    >>> round(telescope_information(angles, frame_error=1e-3).diattenuation, 5)
    0.00013
    """
    psi = _angles(parallactic, "parallactic")
    turn = np.zeros_like(psi)
    if altitude is not None:
        turn = _angles(altitude, "altitude")
    elif offset:
        raise ParameterError("an offset can only be separated with the altitude of each frame")
    if psi.shape != turn.shape:
        raise ParameterError(f"there are {psi.size} parallactic angles and {turn.size} altitudes")
    columns = _design(psi, turn, offset) / positive_number(frame_error, "frame_error")
    if star_error is not None:
        # a star known beforehand is two more measurements, of its q and u
        known = np.eye(2, columns.shape[1]) / positive_number(star_error, "star_error")
        columns = np.vstack([columns, known])
    inverse = np.linalg.pinv(columns, rcond=_RANK)
    covariance = inverse @ inverse.T
    # a parameter that takes part in an open direction has an infinite error, not that of a
    # pseudo-inverse: the projector on what is determined shortens it
    lost = np.diagonal(inverse @ columns) < 1 - _RANK
    covariance[lost, :] = covariance[:, lost] = np.inf
    return TelescopeInformation(_NAMES[: columns.shape[1]], covariance)


def _design(psi, turn, offset):
    """Return the derivatives of all q' and u' by the parameters, shape (2 n, 3 or 5)."""
    # in the frame of the instrument; the turn itself changes no information
    star, mirror = (rotation_matrix(a * u.rad)[..., 1:3, 1:3] for a in (psi - turn, -turn))
    # columns: star q, star u, diattenuation, and with an offset its q and u
    parts = [star, mirror[..., :1]]
    if offset:
        parts.append(np.broadcast_to(np.eye(2), star.shape))
    return np.concatenate(parts, axis=-1).reshape(2 * len(psi), -1)


def _angles(value, name):
    angles = np.atleast_1d(angle_to_rad(value, name))
    if angles.ndim != 1 or not angles.size or not np.all(np.isfinite(angles)):
        raise ParameterError(f"{name} must be finite angles, one per frame")
    return angles


@dataclass(frozen=True, eq=False)
class Observability:
    """
    A star over one night at one site.

    Parameters
    ----------
    name : str
        The star.
    site : `~astropy.coordinates.EarthLocation`
        Where it is observed.
    night : str
        Date of the evening.
    min_altitude : `~astropy.units.Quantity`
        Altitude below which the star is not observed.
    table : `~astropy.table.QTable`
        One row per time of the dark hours: ``time, altitude, parallactic,
        observable``. ``parallactic`` has no jumps, so it may pass +180 deg.

    Examples
    --------
    >>> from astropolcal import standards
    >>> seen = standards.observability("HD 293396", "subaru", "2025-11-03")
    >>> seen.altitude.round(0)
    <Quantity [31., 69.] deg>
    """

    name: str
    site: EarthLocation
    night: str
    min_altitude: u.Quantity
    table: QTable

    @property
    def _seen(self):
        return self.table[self.table["observable"]]

    @property
    def altitude(self):
        """Lowest and highest altitude at which it is observable."""
        return _range(self._seen["altitude"])

    @property
    def parallactic(self):
        """Smallest and largest parallactic angle while it is observable."""
        return _range(self._seen["parallactic"])

    @property
    def difference(self):
        """Range of altitude - parallactic angle while it is observable."""
        return _range(self._seen["altitude"] - self._seen["parallactic"])

    @property
    def hours(self):
        """How long it is observable."""
        mjd = self.table["time"].mjd
        # each row stands for one step; a star may set and rise again, so not last less first
        return len(self._seen) * 24 * (mjd[1] - mjd[0] if len(mjd) > 1 else 0) * u.h

    @property
    def transit(self):
        """Time of the highest altitude in the dark hours: the transit, if it is in them."""
        time, altitude = self.table["time"], self.table["altitude"].value
        top = int(np.argmax(altitude))
        # highest at dusk or dawn: the transit itself is by day
        if not 0 < top < len(time) - 1:
            return time[top]
        before, at, after = altitude[top - 1 : top + 2]
        # vertex of the parabola through three rows, so that a coarse table gives the same transit
        shift = 0.5 * (before - after) / (before - 2 * at + after)
        with offline():
            return time[top] + shift * (time[top + 1] - time[top])

    def information(self, frames=None, **options) -> TelescopeInformation:
        """
        Return what frames spread over the observable hours say of the telescope.

        Parameters
        ----------
        frames : int, optional
            How many pairs of q and u; by default one per row of the table.
        **options
            As for `telescope_information`.

        Returns
        -------
        ``TelescopeInformation``

        Raises
        ------
        ParameterError
            If ``frames`` is not positive.
        """
        seen = self._seen
        if frames is not None:
            seen = seen[_spread(len(seen), frames)]
        return telescope_information(seen["parallactic"], seen["altitude"], **options)


def observability(
    star, site, night, *, min_altitude=LIMIT, twilight=TWILIGHT, step=STEP
) -> Observability:
    """
    Return when a star can be observed in a night, and at which angles.

    No file is fetched from the network, see `astropolcal.observations.pointing`.

    Parameters
    ----------
    star : str, StandardStar or `~astropy.coordinates.SkyCoord`
        A name of the catalogue, or any position.
    site : str or `~astropy.coordinates.EarthLocation`
        ``"subaru"``, ``"keck"``, ``"paranal"``, ``"gemini_south"``, or a place.
    night : str or `~astropy.time.Time`
        Calendar date at the site on which the night begins; or a moment, from noon to noon there.
    min_altitude : `~astropy.units.Quantity`
        The star is not observed below it.
    twilight : `~astropy.units.Quantity`
        Altitude of the Sun below which it is dark.
    step : `~astropy.units.Quantity`
        Time between the rows of the table, at most an hour.

    Returns
    -------
    ``Observability``

    Raises
    ------
    ParameterError
        If the star, the site or the night is not known, or the star does not
        rise above the limit in the dark hours.

    Examples
    --------
    >>> from astropolcal import standards
    >>> seen = standards.observability("HD 30675", "subaru", "2025-11-03")
    >>> print(seen.transit.iso[:16], seen.altitude.max().round(1))
    2025-11-04 12:18 81.4 deg
    """
    place = location(site)
    limit, dark, step = checked(min_altitude, twilight, step)
    if isinstance(star, SkyCoord):
        if not star.isscalar:
            raise ParameterError(f"star has {star.size} positions; one is needed")
        name, coord = star.to_string("hmsdms", precision=0), star
    else:
        star = star if isinstance(star, StandardStar) else get(star)
        name, coord = star.name, star.coord
    times = night_times(place, night, twilight=dark, step=step)
    table = night_table(times, *pointing(coord, times, place), limit)
    if not np.any(table["observable"]):
        raise ParameterError(
            f"{name} does not rise above {limit.to_value(u.deg):g} deg in the dark hours of "
            f"{night!s}; it gets to {table['altitude'].max().to_value(u.deg):.1f} deg"
        )
    return Observability(name, place, date_of(night, place), limit, table)


def _range(values):
    return u.Quantity([values.min(), values.max()])


def _spread(count, frames):
    """Return ``frames`` indices that are spread evenly over ``count`` rows."""
    if frames != int(frames) or frames < 1:
        raise ParameterError(f"frames = {frames!r} must be a positive whole number")
    # more frames than rows repeat rows, so that the number of frames still counts
    return np.round(np.linspace(0, count - 1, int(frames))).astype(int)


# frames spread over the observable hours, for the error of the diattenuation
FRAMES = 32
# where m3_score and m3_error agree; photon noise grows as 10^(0.2 m)
_REFERENCE_MAGNITUDE = 10
_RANGES = "altitude_min", "altitude_max", "parallactic_min", "parallactic_max", "hours"
_FORMATS = dict.fromkeys(("m3_error", "m3_score"), ".3f") | dict.fromkeys(_RANGES, ".1f")
# nominal wavelengths of bands, um
_BANDS = dict(zip("UBVRIJHK", (0.36, 0.44, 0.55, 0.65, 0.8, 1.25, 1.65, 2.2), strict=True))


def search(
    *,
    center=None,
    radius=None,
    kind=None,
    band=None,
    magnitude=None,
    site=None,
    night=None,
    min_altitude=LIMIT,
):
    r"""
    Return the standard stars that fit, as a table.

    Parameters
    ----------
    center : `~astropy.coordinates.SkyCoord`, optional
        Look around this position.
    radius : `~astropy.units.Quantity`, optional
        How far; goes with ``center``.
    kind : str, optional
        ``"polarized"`` or ``"unpolarized"``.
    band : str, optional
        Of U, B, V, R, I, J, H, K: leaves polarized stars with a measurement in this
        band or a published law (unpolarized ones are kept), and gives the
        magnitude in it, or in V where the catalogue has none.
    magnitude : (float, float), optional
        Brightest and faintest magnitude; stars without one are left out.
    site : str or `~astropy.coordinates.EarthLocation`, optional
        As for `observability`; goes with ``night``.
    night : str, optional
        Date of the evening: leaves stars that rise above the limit.
    min_altitude : `~astropy.units.Quantity`
        That limit.

    Returns
    -------
    `~astropy.table.QTable`
        ``name, kind, ra, dec, magnitude, magnitude_band, p, p_err`` (p in ``band`` or in the band
        nearest to V, from the law for a star without measurement), with a center ``separation``,
        with a night ``altitude_min, altitude_max, parallactic_min, parallactic_max, hours, transit,
        m3_error, m3_score``. The order is that of the score, else of the separation, else of right
        ascension. It may be empty.

    Raises
    ------
    ParameterError
        If an argument is not what it should be, or lacks its companion.

    Notes
    -----
    ``m3_error`` is the standard error of a telescope's diattenuation, in units of the error of one
    frame, from 32 frames spread over the observable hours, the star's polarization unknown
    (`telescope_information`). ``m3_score`` multiplies it by :math:`10^{0.2 (m - 10)}`, how much the
    photon noise exceeds that of a star of magnitude 10. The smaller it is, the better the star
    fixes the diattenuation, provided that it does not saturate the detector.

    Examples
    --------
    >>> from astropolcal import standards
    >>> found = standards.search(kind="unpolarized", magnitude=(9, 10), site="subaru",
    ...                          night="2025-11-03")
    >>> print(found["name", "m3_error"][:2])
       name   m3_error
    --------- --------
     HD 14069    0.191
    HD 293396    0.209
    """
    if (site is None) != (night is None):
        raise ParameterError("site and night go together")
    if (center is None) != (radius is None):
        raise ParameterError("center and radius go together")
    if band is not None:
        check_choice("band", band, _BANDS, ParameterError)
    stars = [star for star in map(get, names(kind)) if _in_band(star, band)]
    if magnitude is not None:
        try:
            low, high = (float(limit) for limit in magnitude)
        except (TypeError, ValueError):
            raise ParameterError(f"magnitude = {magnitude!r} must be two numbers") from None
        if not low <= high:
            raise ParameterError(
                f"magnitude = {magnitude!r} must be the brightest and the faintest"
            )
        stars = [star for star in stars if low <= star.brightness(band)[0] <= high]
    bright = [s.brightness(band) for s in stars]
    degree = u.Quantity([_degree(s, band) for s in stars] or np.zeros((0, 2)), u.percent)
    ra, dec = ([getattr(s.coord, key).deg for s in stars] * u.deg for key in ("ra", "dec"))
    table = QTable(
        {
            "name": np.array([s.name for s in stars], dtype=str),
            "kind": np.array([s.kind for s in stars], dtype=str),
            "ra": ra,
            "dec": dec,
            "magnitude": np.array([m for m, _ in bright], dtype=float) * u.mag,
            "magnitude_band": np.array([b for _, b in bright], dtype=str),
            "p": degree[:, 0],
            "p_err": degree[:, 1],
        }
    )
    if center is not None:
        if not isinstance(center, SkyCoord) or not center.isscalar:
            raise ParameterError(f"center = {center!r} must be a SkyCoord of one position")
        radius = float(angle_to_rad(radius, "radius"))
        if not 0 < radius <= np.pi:
            raise ParameterError(f"radius = {np.rad2deg(radius):g} deg must be from 0 to 180 deg")
        apart = SkyCoord(table["ra"], table["dec"]).separation(center)
        table["separation"] = apart.to(u.deg)
        table = table[apart.rad <= radius]
        table.sort("separation")
    return table if night is None else _observable(table, site, night, min_altitude)


def _in_band(star, band):
    known = band is None or star.kind == "unpolarized" or star.law is not None
    return known or band in star.polarization["band"]


def _degree(star, band):
    """Return the degree of polarization and its error (percent) in or near a band."""
    table = star.polarization
    if band is not None and band in table["band"]:
        table = table[table["band"] == band]
    elif star.law is not None and (band is not None or not len(table)):
        q, stokes_u, covariance = star.stokes(_BANDS[band or "V"] * u.um)
        # the error of the degree is that along the direction of polarization in the (q, u) plane
        along = np.array([q, stokes_u]) / np.hypot(q, stokes_u)
        # where the angle alone is uncertain rounding may leave less than zero
        error = np.sqrt(max(along @ covariance @ along, 0.0))
        return 100 * float(np.hypot(q, stokes_u)), 100 * float(error)
    at = int(np.argmin(np.abs(table["wavelength"] - 0.55 * u.um)))
    return table["p"][at].to_value(u.percent), table["p_err"][at].to_value(u.percent)


def _observable(table, site, night, min_altitude):
    """Return the rows that rise above the limit, with their angles, in order of the score."""
    place = location(site)
    limit, dark, step = checked(min_altitude, TWILIGHT, STEP)
    times = night_times(place, night, twilight=dark, step=step)
    # all stars at once, because the transformation costs the same for one
    altitude, parallactic = pointing(
        SkyCoord(table["ra"][:, None], table["dec"][:, None]), times, place
    )
    up = np.any(altitude >= limit, axis=1)
    found, evening = table[up], date_of(night, place)
    seen = [
        Observability(str(name), place, evening, limit, night_table(times, a, p, limit))
        for name, a, p in zip(found["name"], altitude[up], parallactic[up], strict=True)
    ]
    for name in ("altitude", "parallactic"):
        ranges = u.Quantity([getattr(s, name) for s in seen] or np.zeros((0, 2)), u.deg)
        found[f"{name}_min"], found[f"{name}_max"] = ranges[:, 0], ranges[:, 1]
    found["hours"] = u.Quantity([s.hours for s in seen] or [], u.h)
    with offline():
        found["transit"] = np.array([s.transit.iso[:16] for s in seen], dtype=str)
    errors = np.array([s.information(FRAMES).diattenuation for s in seen], dtype=float)
    excess = found["magnitude"].value - _REFERENCE_MAGNITUDE
    found["m3_error"], found["m3_score"] = errors, errors * 10 ** (0.2 * excess)
    for name, digits in _FORMATS.items():
        found[name].info.format = digits
    found.sort(["m3_score", "name"])
    return found
