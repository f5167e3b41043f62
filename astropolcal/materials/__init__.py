# Licensed under a 3-clause BSD style license - see LICENSE
"""
Refractive indices of the crystals that waveplates are made of.

Each material knows the wavelengths at which it was measured
(``measured_range``) and those at which its law is evaluated
(``valid_range``), and refuses any other.
"""

import difflib

import astropy.units as u

from astropolcal.exceptions import ParameterError
from astropolcal.materials.dispersion import SellmeierLaw, UniaxialMaterial

__all__ = [
    "MGF2",
    "QUARTZ",
    "SellmeierLaw",
    "UniaxialMaterial",
    "get_material",
    "material_names",
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

_MATERIALS = (QUARTZ, MGF2)
_BY_NAME = {name.lower(): m for m in _MATERIALS for name in (m.name, *m.aliases)}


def material_names():
    """
    Return the names of the materials of the package.

    Examples
    --------
    >>> from astropolcal.materials import material_names
    >>> material_names()
    ['quartz', 'MgF2']
    """
    return [material.name for material in _MATERIALS]


def get_material(name):
    """
    Return a material by its name.

    Parameters
    ----------
    name : str
        Name or alias, in any case: ``"quartz"`` (also ``"SiO2"``, which here
        means the crystal), ``"MgF2"`` (also ``"magnesium fluoride"``).

    Returns
    -------
    UniaxialMaterial
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
    """
    key = str(name).strip().lower()
    if key in _BY_NAME:
        return _BY_NAME[key]
    near = difflib.get_close_matches(key, _BY_NAME, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ParameterError(
        f"no material is called {name!r}{hint} (available: {', '.join(material_names())})"
    )
