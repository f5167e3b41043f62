# Licensed under a 3-clause BSD style license - see LICENSE
"""The wavelengths that several datasets have in common, and those of filters."""

from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.exceptions import ObservationError
from astropolcal.units import plain_number

__all__ = ["SAME_WAVELENGTH", "common_wavelengths", "filter_wavelength", "stated_wavelength"]

_FILTERS = Path(__file__).parents[1] / "data" / "filters.ecsv"

#: Wavelengths of two tables are the same when they agree to this share.
SAME_WAVELENGTH = 1e-5


def common_wavelengths(observations, wavelength=None):
    """
    Return the wavelength grid of several datasets, in micrometre.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets.
    wavelength : `~astropy.units.Quantity`, optional
        The grid, if it is not the union of the datasets'.

    Returns
    -------
    `~numpy.ndarray`
        Ascending, shape (n_wavelengths,).

    Examples
    --------
    >>> from astropolcal.observations import Observations, common_wavelengths, example_table
    >>> night = Observations.from_table(example_table())
    >>> common_wavelengths([night, night]).tolist()
    [1.2, 1.6, 2.2]
    """
    if wavelength is not None:
        return np.atleast_1d(u.Quantity(wavelength).to_value(u.um))
    # compared with the next lower one, so that a chain of near values keeps its first
    merged = np.sort(np.concatenate([obs.wavelength.to_value(u.um) for obs in observations]))
    return merged[np.diff(merged, prepend=-np.inf) > SAME_WAVELENGTH * merged]


def filter_wavelength(instrument, name):
    """
    Return the central wavelength of an instrument's filter.

    Parameters
    ----------
    instrument : str
        Name of the instrument, such as "VAMPIRES" or "SCExAO/VAMPIRES".
    name : str
        Name of the filter; case, blanks and hyphens do not matter.

    Returns
    -------
    `~astropy.units.Quantity`

    Raises
    ------
    ObservationError
        If the instrument has no such filter; the message names those it has.

    Examples
    --------
    >>> from astropolcal.observations.wavelengths import filter_wavelength
    >>> filter_wavelength("vampires", "625-50")
    <Quantity 625. nm>
    """
    own = _filters().get(_plain(str(instrument).split("/")[-1]), {})
    known = {_plain(label): wavelength for label, wavelength in own.items()}
    # headers write 625-50, people 625 50
    if _plain(name) not in known:
        allowed = ", ".join(own) or "none; give the wavelength"
        raise ObservationError(
            f"{instrument}: no wavelength is known of filter {name!r}; known are {allowed}"
        )
    return known[_plain(name)]


def stated_wavelength(meta, label):
    """
    Return the wavelength that the meta of a table state for all its rows.

    Parameters
    ----------
    meta : dict
        ``wavelength``, a quantity or text such as "625 nm", or ``filter`` and ``instrument``.
    label : str
        What to call the table in messages.

    Returns
    -------
    `~astropy.units.Quantity` or None
        None if they state none.

    Raises
    ------
    ObservationError
        If it is no length, or the filter is not known.

    Examples
    --------
    >>> from astropolcal.observations.wavelengths import stated_wavelength
    >>> stated_wavelength({"wavelength": "0.77 um"}, "night")
    <Quantity 0.77 um>
    """
    value = meta.get("wavelength")
    if value is None and meta.get("filter") is None:
        return None
    if value is None:
        try:
            return filter_wavelength(meta.get("instrument"), meta["filter"])
        except ObservationError as error:
            raise ObservationError(f"{label}: {error}") from None
    try:
        length = plain_number(value, u.Quantity)
        good = length.isscalar and length.to_value(u.um) > 0
    except (TypeError, ValueError, u.UnitsError):
        good = False
    if not good:
        raise ObservationError(
            f"{label}: wavelength = {value!r} in the meta; allowed is one length such as '625 nm'"
        )
    return length


def _plain(name):
    return "".join(c for c in str(name).lower() if c.isalnum())


@lru_cache(maxsize=1)
def _filters():
    """Return instrument to name of filter to wavelength."""
    found = {}
    for row in QTable.read(_FILTERS, format="ascii.ecsv"):
        # by the instrument first: a name such as H means another wavelength elsewhere
        found.setdefault(_plain(row["instrument"]), {})[str(row["filter"])] = row["wavelength"]
    return found
