# Licensed under a 3-clause BSD style license - see LICENSE
"""Where a star stands over a site: altitude, parallactic angle, the hours of a night."""

import astropy.units as u
import numpy as np
from astropy.coordinates import AltAz, EarthLocation, get_sun
from astropy.table import QTable
from astropy.time import Time

from astropolcal.exceptions import ParameterError
from astropolcal.observations.pointings import offline, pointing
from astropolcal.units import angle_to_rad, iso_date
from astropolcal.words import did_you_mean

__all__ = ["offline", "pointing"]

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
        times = _evening_noon(site, night) + np.arange(0, 1, step.to_value(u.day)) * u.day
        sun = get_sun(times).transform_to(AltAz(obstime=times, location=site)).alt
    dark = sun < twilight
    if not np.any(dark):
        raise ParameterError(
            f"night = {night!s}: the Sun does not go below {twilight.to_value(u.deg):g} deg "
            f"at this site; it gets to {sun.min().to_value(u.deg):.1f} deg"
        )
    return times[dark]


def _evening_noon(site, night):
    """Return the local mean noon of the date on which the night begins."""
    date = Time(date_of(night), scale="utc")
    # a time of its own, which is printed to the second
    noon = Time(date.jd1, date.jd2, format="jd", scale="utc", precision=0)
    # local mean noon is 12 h UTC minus the east longitude
    return noon + (0.5 - site.lon.to_value(u.deg) / 360) * u.day


def date_of(night):
    """Return the date of the evening as text, or raise."""
    try:
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
