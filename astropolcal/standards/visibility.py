# Licensed under a 3-clause BSD style license - see LICENSE
"""When in a night a standard star can be observed, and at which angles."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.coordinates import EarthLocation, SkyCoord
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
from astropolcal.standards.catalogues import StandardStar, get
from astropolcal.standards.information import TelescopeInformation, telescope_information

__all__ = ["Observability", "observability"]


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
        One row a time of the dark hours: ``time, altitude, parallactic,
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
            How many pairs of q and u; by default one a row of the table.
        **options
            As for `telescope_information`.

        Returns
        -------
        TelescopeInformation

        Raises
        ------
        ParameterError
            If ``frames`` is not positive.

        Examples
        --------
        >>> from astropolcal import standards
        >>> seen = standards.observability("HD 293396", "subaru", "2025-11-03")
        >>> round(seen.information(frames=32).diattenuation, 2)
        0.21
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
        Calendar date at the site on which the night begins.
    min_altitude : `~astropy.units.Quantity`
        The star is not observed below it.
    twilight : `~astropy.units.Quantity`
        Altitude of the Sun below which it is dark.
    step : `~astropy.units.Quantity`
        Time between the rows of the table, at most an hour.

    Returns
    -------
    Observability

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
    name, coord = _target(star)
    times = night_times(place, night, twilight=dark, step=step)
    table = night_table(times, *pointing(coord, times, place), limit)
    if not np.any(table["observable"]):
        raise ParameterError(
            f"{name} does not rise above {limit.to_value(u.deg):g} deg in the dark hours of "
            f"{night!s}; it gets to {table['altitude'].max().to_value(u.deg):.1f} deg"
        )
    return Observability(name, place, date_of(night), limit, table)


def _target(star):
    if isinstance(star, SkyCoord):
        return star.to_string("hmsdms", precision=0), star
    star = star if isinstance(star, StandardStar) else get(star)
    return star.name, star.coord


def _range(values):
    return u.Quantity([values.min(), values.max()])


def _spread(count, frames):
    """Return ``frames`` indices that are spread evenly over ``count`` rows."""
    if frames != int(frames) or frames < 1:
        raise ParameterError(f"frames = {frames!r} must be a positive whole number")
    # more frames than rows repeat rows, so that the number of frames still counts
    return np.round(np.linspace(0, count - 1, int(frames))).astype(int)
