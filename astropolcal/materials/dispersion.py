# Licensed under a 3-clause BSD style license - see LICENSE
"""
Dispersion laws, and the materials that follow them.

A law is only evaluated where it is known to hold: outside the range of its
material a `~astropolcal.exceptions.WavelengthRangeError` is raised.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.units import length_to_um

__all__ = ["IsotropicMaterial", "SellmeierLaw", "UniaxialMaterial"]

# lets the ends of a range survive the conversion of their unit
_EDGE = 1e-12


@dataclass(frozen=True)
class SellmeierLaw:
    r"""
    A Sellmeier law, :math:`n^2 = A + \sum_i B_i \lambda^2 / (\lambda^2 - C_i)`.

    Parameters
    ----------
    terms : tuple of (float, float)
        Strength :math:`B_i` (dimensionless) and pole :math:`C_i` (squared
        resonance wavelength in square micrometres) of each term.
    constant : float
        :math:`A`, one for the textbook form.

    Examples
    --------
    >>> from astropolcal.materials import SellmeierLaw
    >>> round(SellmeierLaw(terms=((1.0, 0.01),))._index_um(0.5), 6)
    1.428869
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

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.materials import get_material
        >>> get_material("silver").index(1.6 * u.um).round(2)
        <Quantity 0.43+10.38j>
        """
        return u.Quantity(self._index_um(length_to_um(wavelength)), dtype=complex)

    def _checked_um(self, wavelength_um):
        """Return the wavelengths, or raise if one is out of range or a NaN."""
        wavelength_um = np.asarray(wavelength_um, dtype=float)
        low, high = self._valid_um
        # NaN compares as False and is refused with the others
        inside = (wavelength_um >= low * (1 - _EDGE)) & (wavelength_um <= high * (1 + _EDGE))
        if inside.all():
            return wavelength_um
        offending = wavelength_um[~inside].ravel()[0]
        raise WavelengthRangeError(
            f"the refractive index of {self.name} is known from {low:g} to {high:g} um, "
            f"not at {offending:.6g} um"
        )


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
        The two ends of the wavelengths of the measurements behind the law.
    valid_range : `~astropy.units.Quantity`, optional
        The two ends between which the law is evaluated; the measured range
        if left out.
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
        The two ends of the wavelengths of the measurements behind the laws.
    valid_range : `~astropy.units.Quantity`, optional
        The two ends between which the laws are evaluated; the measured range
        if left out. Where it is wider, the material's own documentation says
        why and at what cost.
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

    def __init__(
        self,
        name,
        ordinary_law,
        extraordinary_law,
        *,
        measured_range,
        valid_range=None,
        doi="",
        aliases=(),
    ):
        super().__init__(
            name,
            measured_range=measured_range,
            valid_range=valid_range,
            doi=doi,
            aliases=aliases,
        )
        self.ordinary_law = ordinary_law
        self.extraordinary_law = extraordinary_law

    def ordinary(self, wavelength):
        """
        Return the ordinary refractive index.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength in vacuum, any shape.

        Returns
        -------
        `~astropy.units.Quantity`
            Dimensionless, of the shape of ``wavelength``.

        Raises
        ------
        WavelengthRangeError
            If a wavelength lies outside ``valid_range`` or is not a number.
        ParameterError
            If the wavelength has no unit of length.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.materials import QUARTZ
        >>> QUARTZ.ordinary(589.3 * u.nm).round(4)
        <Quantity 1.5442>
        """
        return u.Quantity(self.ordinary_law._index_um(self._checked_um(length_to_um(wavelength))))

    def extraordinary(self, wavelength):
        """
        Return the extraordinary refractive index.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength in vacuum, any shape.

        Returns
        -------
        `~astropy.units.Quantity`
            Dimensionless, of the shape of ``wavelength``.

        Raises
        ------
        WavelengthRangeError
            If a wavelength lies outside ``valid_range`` or is not a number.
        ParameterError
            If the wavelength has no unit of length.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.materials import QUARTZ
        >>> QUARTZ.extraordinary(589.3 * u.nm).round(4)
        <Quantity 1.5533>
        """
        return u.Quantity(
            self.extraordinary_law._index_um(self._checked_um(length_to_um(wavelength)))
        )

    def birefringence(self, wavelength):
        """
        Return the extraordinary minus the ordinary refractive index.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength in vacuum, any shape.

        Returns
        -------
        `~astropy.units.Quantity`
            Dimensionless, of the shape of ``wavelength``.

        Raises
        ------
        WavelengthRangeError
            If a wavelength lies outside ``valid_range`` or is not a number.
        ParameterError
            If the wavelength has no unit of length.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.materials import MGF2
        >>> MGF2.birefringence([1.2, 1.6, 2.2] * u.um).round(5)
        <Quantity [0.01154, 0.0114 , 0.01115]>
        """
        return u.Quantity(self._birefringence_um(length_to_um(wavelength)))

    def _birefringence_um(self, wavelength_um):
        """Return the birefringence at floats in micrometre, for the hot path."""
        wavelength_um = self._checked_um(wavelength_um)
        return self.extraordinary_law._index_um(wavelength_um) - self.ordinary_law._index_um(
            wavelength_um
        )

    def _index_um(self, wavelength_um):
        """Return the mean index at floats in micrometre, as complex numbers."""
        wavelength_um = self._checked_um(wavelength_um)
        ordinary = self.ordinary_law._index_um(wavelength_um)
        # mean over directions: two of the three axes of the crystal are ordinary
        return (2 * ordinary + self.extraordinary_law._index_um(wavelength_um)) / 3 + 0j
