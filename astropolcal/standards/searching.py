# Licensed under a 3-clause BSD style license - see LICENSE
"""Search of the catalogue by position, brightness and observability."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from astropolcal.exceptions import ParameterError
from astropolcal.standards._sky import (
    LIMIT,
    STEP,
    TWILIGHT,
    checked,
    date_of,
    location,
    night_table,
    night_times,
    offline,
    pointing,
)
from astropolcal.standards.catalogues import check_kind, get, names
from astropolcal.standards.visibility import Observability
from astropolcal.units import angle_to_rad

__all__ = ["search"]

# frames spread over the observable hours, for the error of the diattenuation
FRAMES = 32
# where m3_score and m3_error agree; photon noise grows as 10^(0.2 m)
_REFERENCE_MAGNITUDE = 10
_FORMATS = dict.fromkeys(("m3_error", "m3_score"), ".3f")
_FORMATS |= dict.fromkeys(("altitude_min", "altitude_max", "hours"), ".1f")
_FORMATS |= dict.fromkeys(("parallactic_min", "parallactic_max"), ".1f")
_BANDS = ("U", "B", "V", "R", "I", "J", "H", "K")


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
        ``name, kind, ra, dec, magnitude, magnitude_band, p, p_err`` (p in ``band``
        or in the band nearest to V, from the law for a star without measurement),
        with a center ``separation``, with a night ``altitude_min,
        altitude_max, parallactic_min, parallactic_max, hours, transit, m3_error,
        m3_score``. The order is that of the score, else of the separation, else of
        right ascension. It may be empty.

    Raises
    ------
    ParameterError
        If an argument is not what it should be, or lacks its companion.

    Notes
    -----
    ``m3_error`` is the standard error of a telescope's diattenuation, in units
    of the error of one frame, from 32 frames spread over the observable hours, the
    star's polarization unknown (`telescope_information`). ``m3_score`` multiplies
    it by :math:`10^{0.2 (m - 10)}`, how much the photon noise exceeds that of
    a star of magnitude 10. The smaller it is, the better the star fixes the
    diattenuation, provided that it does not saturate the detector.

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
    check_kind(kind)
    if (site is None) != (night is None):
        raise ParameterError("site and night go together")
    if (center is None) != (radius is None):
        raise ParameterError("center and radius go together")
    if band not in (None, *_BANDS):
        raise ParameterError(f"band = {band!r} must be one of {', '.join(_BANDS)}")
    stars = [s for s in map(get, names(kind)) if _in_band(s, band) and _bright(s, band, magnitude)]
    if center is not None:
        stars = _around(stars, center, radius)
    table = _describe(stars, band)
    if center is not None:
        table["separation"] = _places(stars).separation(center).to(u.deg)
        table.sort("separation")
    return table if night is None else _observable(table, site, night, min_altitude)


def _in_band(star, band):
    known = band is None or star.kind == "unpolarized" or star.law is not None
    return known or band in star.polarization["band"]


def _bright(star, band, limits):
    if limits is None:
        return True
    try:
        low, high = (float(limit) for limit in limits)
    except (TypeError, ValueError):
        raise ParameterError(f"magnitude = {limits!r} must be two numbers") from None
    if not low <= high:
        raise ParameterError(f"magnitude = {limits!r} must be the brightest and the faintest")
    return low <= star.brightness(band)[0] <= high


def _around(stars, center, radius):
    if not isinstance(center, SkyCoord) or not center.isscalar:
        raise ParameterError(f"center = {center!r} must be a SkyCoord of one position")
    radius = float(angle_to_rad(radius, "radius"))
    if not 0 < radius <= np.pi:
        raise ParameterError(f"radius = {np.rad2deg(radius):g} deg must be from 0 to 180 deg")
    # separation of no coordinates is an error in astropy
    near = _places(stars).separation(center).rad <= radius if stars else []
    return [star for star, inside in zip(stars, near, strict=True) if inside]


def _places(stars):
    return SkyCoord(
        [s.coord.ra.deg for s in stars] * u.deg, [s.coord.dec.deg for s in stars] * u.deg
    )


def _describe(stars, band):
    """Return the table that does not depend on the night."""
    bright = [s.brightness(band) for s in stars]
    degree = u.Quantity([_degree(s, band) for s in stars] or np.zeros((0, 2)), u.percent)
    place = _places(stars)
    return QTable(
        {
            "name": np.array([s.name for s in stars], dtype=str),
            "kind": np.array([s.kind for s in stars], dtype=str),
            "ra": place.ra.to(u.deg),
            "dec": place.dec.to(u.deg),
            "magnitude": np.array([m for m, _ in bright], dtype=float) * u.mag,
            "magnitude_band": np.array([b for _, b in bright], dtype=str),
            "p": degree[:, 0],
            "p_err": degree[:, 1],
        }
    )


def _degree(star, band):
    """Return the degree of polarization and its error (percent) in or near a band."""
    table = star.polarization
    if band is not None and band in table["band"]:
        table = table[table["band"] == band]
    elif star.law is not None and (band is not None or not len(table)):
        return _from_law(star, band)
    at = int(np.argmin(np.abs(table["wavelength"] - 0.55 * u.um)))
    return table["p"][at].to_value(u.percent), table["p_err"][at].to_value(u.percent)


def _from_law(star, band):
    place = dict(zip(_BANDS, (0.36, 0.44, 0.55, 0.65, 0.8, 1.25, 1.65, 2.2), strict=True))
    wavelength = place.get(band, 0.55) * u.um
    q, stokes_u, covariance = star.stokes(wavelength)
    # the error of the degree is that along the direction of polarization in the (q, u) plane
    along = np.array([q, stokes_u]) / np.hypot(q, stokes_u)
    # where the angle alone is uncertain rounding may leave less than zero
    error = np.sqrt(max(along @ covariance @ along, 0.0))
    return 100 * float(np.hypot(q, stokes_u)), 100 * float(error)


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
    found = table[up]
    seen = [
        Observability(str(name), place, date_of(night), limit, night_table(times, a, p, limit))
        for name, a, p in zip(found["name"], altitude[up], parallactic[up], strict=True)
    ]
    _add_night(found, seen)
    found.sort(["m3_score", "name"])
    return found


def _add_night(found, seen):
    for name in ("altitude", "parallactic"):
        ranges = u.Quantity([getattr(s, name) for s in seen] or np.zeros((0, 2)), u.deg)
        found[f"{name}_min"], found[f"{name}_max"] = ranges[:, 0], ranges[:, 1]
    found["hours"] = u.Quantity([s.hours for s in seen] or [], u.h)
    with offline():
        found["transit"] = np.array([s.transit.iso[:16] for s in seen], dtype=str)
    errors = np.array([s.information(FRAMES).diattenuation for s in seen], dtype=float)
    excess = found["magnitude"].value - _REFERENCE_MAGNITUDE
    found["m3_error"], found["m3_score"] = errors, errors * 10 ** (0.2 * excess)
    for name in found.colnames:
        if name in _FORMATS:
            found[name].info.format = _FORMATS[name]
