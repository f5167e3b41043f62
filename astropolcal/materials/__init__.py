# Licensed under a 3-clause BSD style license - see LICENSE
"""
Refractive indices of the crystals, metals and films that optics are made of.

Each material knows the wavelengths at which it was measured
(``measured_range``) and those at which its law is evaluated
(``valid_range``), and refuses any other.
"""

import astropy.units as u

from astropolcal.exceptions import ParameterError
from astropolcal.materials.database import DATABASE_PREFIX, database_material
from astropolcal.materials.dispersion import IsotropicMaterial, SellmeierLaw, UniaxialMaterial
from astropolcal.materials.metals import (
    ALUMINIUM,
    GOLD,
    SILVER,
    BrendelBormannLaw,
    Metal,
    TabulatedLaw,
)
from astropolcal.words import did_you_mean

__all__ = [
    "AL2O3",
    "ALUMINIUM",
    "FUSED_SILICA",
    "GOLD",
    "MGF2",
    "QUARTZ",
    "SI3N4",
    "SILVER",
    "BrendelBormannLaw",
    "IsotropicMaterial",
    "Metal",
    "SellmeierLaw",
    "TabulatedLaw",
    "UniaxialMaterial",
    "database_material",
    "get_material",
    "material_names",
    "register_material",
]

#: Crystalline quartz (alpha SiO2; not fused silica), at room temperature.
#:
#: Ghosh 1999, Opt. Commun. 163, 95, doi:10.1016/S0030-4018(99)00091-7, from
#: data between 0.198 and 2.0531 um. The law is evaluated up to 2.5 um, because
#: K-band half-wave plates need it there and its form, whose lattice pole lies
#: at 10 um, stays smooth. The price: against the independent law of
#: Radhakrishnan (1951, Proc. Indian Acad. Sci.; 0.18 to 3 um, coefficients as
#: listed by refractiveindex.info) its birefringence is low by 0.8 % at 1.6 um,
#: 1.2 % at 2.05 um, 1.8 % at 2.4 um and 2.1 % at 2.5 um; from 0.25 to 1.2 um
#: the two differ by less than 0.5 %.
QUARTZ = UniaxialMaterial(
    "quartz",
    SellmeierLaw(constant=1.28604141, terms=((1.07044083, 1.00585997e-2), (1.10202242, 100.0))),
    SellmeierLaw(constant=1.28851804, terms=((1.09509924, 1.02101864e-2), (1.15662475, 100.0))),
    measured_range=[0.198, 2.0531] * u.um,
    valid_range=[0.198, 2.5] * u.um,
    doi="10.1016/S0030-4018(99)00091-7",
    aliases=("sio2", "crystalline quartz", "crystal quartz"),
)

#: Magnesium fluoride at 19 deg C.
#:
#: Dodge 1984, Appl. Opt. 23, 1980, doi:10.1364/AO.23.001980.
MGF2 = UniaxialMaterial(
    "MgF2",
    SellmeierLaw(
        terms=(
            (0.48755108, 0.04338408**2),
            (0.39875031, 0.09461442**2),
            (2.3120353, 23.793604**2),
        )
    ),
    SellmeierLaw(
        terms=(
            (0.41344023, 0.03684262**2),
            (0.50497499, 0.09076162**2),
            (2.4904862, 23.771995**2),
        )
    ),
    measured_range=[0.2, 7.04] * u.um,
    doi="10.1364/AO.23.001980",
    aliases=("magnesium fluoride",),
)

#: Fused silica (amorphous SiO2) at 20 deg C.
#:
#: Malitson 1965, J. Opt. Soc. Am. 55, 1205, doi:10.1364/JOSA.55.001205.
FUSED_SILICA = IsotropicMaterial(
    "fused silica",
    SellmeierLaw(
        terms=(
            (0.6961663, 0.0684043**2),
            (0.4079426, 0.1162414**2),
            (0.8974794, 9.896161**2),
        )
    ),
    measured_range=[0.21, 3.71] * u.um,
    doi="10.1364/JOSA.55.001205",
    aliases=("silica", "silica glass", "vitreous silica"),
)

#: Aluminium oxide; the ordinary index of synthetic sapphire at 24 deg C.
#:
#: Malitson 1962, J. Opt. Soc. Am. 52, 1377, doi:10.1364/JOSA.52.001377.
#: Evaporated films are less dense: their index is 1.6 to 1.7 in the near
#: infrared, that of the crystal 1.75.
AL2O3 = IsotropicMaterial(
    "Al2O3",
    SellmeierLaw(
        terms=(
            (1.023798, 0.06144821**2),
            (1.058264, 0.1106997**2),
            (5.280792, 17.92656**2),
        )
    ),
    measured_range=[0.2652, 5.577] * u.um,
    doi="10.1364/JOSA.52.001377",
    aliases=("alumina", "sapphire", "aluminium oxide", "aluminum oxide"),
)

#: Silicon nitride, a film.
#:
#: Luke et al. 2015, Opt. Lett. 40, 4823, doi:10.1364/OL.40.004823.
SI3N4 = IsotropicMaterial(
    "Si3N4",
    SellmeierLaw(terms=((3.0249, 0.1353406**2), (40314.0, 1239.842**2))),
    measured_range=[0.310, 5.504] * u.um,
    doi="10.1364/OL.40.004823",
    aliases=("silicon nitride",),
)

_BUILT_IN = (QUARTZ, MGF2, SILVER, GOLD, ALUMINIUM, FUSED_SILICA, AL2O3, SI3N4)
_MATERIALS = {material.name: material for material in _BUILT_IN}
_BY_NAME = {name.lower(): m for m in _BUILT_IN for name in (m.name, *m.aliases)}


def material_names():
    """
    Return the names of the materials that `get_material` knows.

    Examples
    --------
    >>> from astropolcal.materials import material_names
    >>> material_names()[:4]
    ['quartz', 'MgF2', 'silver', 'gold']
    """
    return list(_MATERIALS)


def register_material(material):
    """
    Let optics and files name a material of your own.

    A calibration file holds the name of a material, not its index: register it
    before such a file is read.

    Parameters
    ----------
    material : IsotropicMaterial or UniaxialMaterial
        The material; its ``name`` and ``aliases`` are what it is found by.

    Raises
    ------
    ParameterError
        If it is not a material, or another one has one of its names.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import materials
    >>> law = materials.TabulatedLaw([0.9, 2.5] * u.um, [0.2 + 6j, 0.8 + 16j])
    >>> mine = materials.Metal("mirror of 2025", law, measured_range=[0.9, 2.5] * u.um)
    >>> materials.register_material(mine)
    >>> materials.get_material("mirror of 2025") is mine
    True
    """
    if not hasattr(material, "_index_um") or not getattr(material, "name", ""):
        raise ParameterError(f"{material!r} is not a material with a name")
    names = [name.strip().lower() for name in (material.name, *material.aliases)]
    for name in names:
        if name.startswith(DATABASE_PREFIX) or _BY_NAME.get(name, material) is not material:
            raise ParameterError(f"a material called {name!r} exists already; choose another name")
    _MATERIALS[material.name] = material
    _BY_NAME.update(dict.fromkeys(names, material))


def get_material(name):
    """
    Return a material by its name.

    Parameters
    ----------
    name : str
        Name or alias, in any case: ``"quartz"`` (also ``"SiO2"``, which here
        means the crystal), ``"fused silica"``, ``"silver"``; or
        ``"refractiveindex:SHELF/BOOK/PAGE"``, see `database_material`.

    Returns
    -------
    UniaxialMaterial or IsotropicMaterial
        The material.

    Raises
    ------
    ParameterError
        If there is no such material; the message suggests the nearest.

    Examples
    --------
    >>> from astropolcal.materials import get_material
    >>> get_material("SiO2")
    <UniaxialMaterial 'quartz', 0.198 to 2.5 um, doi:10.1016/S0030-4018(99)00091-7>
    >>> get_material("Ag")
    <Metal 'silver', 0.248 to 12.398 um, doi:10.1364/AO.37.005271>
    """
    if str(name).strip().startswith(DATABASE_PREFIX):
        return database_material(str(name).strip())
    key = str(name).strip().lower()
    if key in _BY_NAME:
        return _BY_NAME[key]
    hint = did_you_mean(key, _BY_NAME, cutoff=0.7)
    raise ParameterError(
        f"no material is called {name!r}{hint} (available: {', '.join(material_names())}; "
        "register_material adds your own)"
    )
