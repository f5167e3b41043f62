# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Complex refractive indices of the metals that mirrors are coated with.

Indices are n + ik with positive k, for fields that vary as
:math:`e^{-i\omega t}`.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.materials.dispersion import IsotropicMaterial
from astropolcal.units import length_to_um

__all__ = ["ALUMINIUM", "GOLD", "SILVER", "BrendelBormannLaw", "Metal", "TabulatedLaw"]

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

    Examples
    --------
    >>> from astropolcal.materials import BrendelBormannLaw
    >>> free = BrendelBormannLaw(plasma=9.0, drude=(1.0, 0.05))
    >>> free._index_um(1.6).round(2)
    np.complex128(0.38+11.55j)
    """

    plasma: float
    drude: tuple
    resonances: tuple = ()

    def _permittivity_um(self, wavelength_um):
        """Return the complex permittivity at wavelengths in micrometre, unchecked."""
        omega = _EV_UM / np.asarray(wavelength_um, dtype=float)
        strength, width = self.drude
        total = 1.0 - strength * self.plasma**2 / (omega * (omega + 1j * width))
        return total + sum(self._resonance(omega, *terms) for terms in self.resonances)

    def _resonance(self, omega, strength, width, centre, spread):
        # pipelines that load a calibration need no scipy, unless a metal is in it
        from scipy.special import wofz

        a = np.sqrt(omega * (omega + 1j * width))
        scale = np.sqrt(2) * spread
        shape = wofz((a - centre) / scale) + wofz((a + centre) / scale)
        return 0.5j * np.sqrt(np.pi) * strength * self.plasma**2 / (a * scale) * shape

    def _index_um(self, wavelength_um):
        """Return n + ik at wavelengths in micrometre, unchecked."""
        return np.sqrt(self._permittivity_um(wavelength_um))


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
    >>> from astropolcal.materials import Metal, TabulatedLaw
    >>> law = TabulatedLaw([1.1, 1.7, 2.4] * u.um, [0.3 + 7.5j, 0.5 + 11j, 0.8 + 15j])
    >>> Metal("aged silver", law, measured_range=[1.1, 2.4] * u.um).index(1.4 * u.um)
    <Quantity 0.4+9.25j>
    """

    def __init__(self, wavelength, index):
        self._wavelength = np.atleast_1d(length_to_um(wavelength))
        self._index = np.atleast_1d(np.asarray(index, dtype=complex))
        if self._wavelength.ndim != 1 or self._wavelength.shape != self._index.shape:
            raise ParameterError(
                f"a table of {self._wavelength.shape} wavelengths has {self._index.shape} "
                "indices; allowed is one a wavelength"
            )
        if self._wavelength.size < 2 or not np.all(np.diff(self._wavelength) > 0):
            raise ParameterError("the wavelengths of a table must be two or more and increase")
        good = np.isfinite(self._index) & (self._index.real > 0) & (self._index.imag >= 0)
        if not good.all():
            row = int(np.argmin(good))
            raise ParameterError(
                f"index {self._index[row]:.6g} in row {row + 1} of a table; allowed are n + ik "
                "with n > 0 and k >= 0"
            )

    def _index_um(self, wavelength_um):
        return np.interp(wavelength_um, self._wavelength, self._index)


class Metal(IsotropicMaterial):
    """
    A metal with a complex refractive index.

    Parameters
    ----------
    name : str
        What the metal is called in the registry and in messages.
    law : BrendelBormannLaw or TabulatedLaw
        Law of the index.
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
    >>> from astropolcal.materials import GOLD
    >>> GOLD.index([1.2, 2.2] * u.um).round(2)
    <Quantity [0.39 +7.56j, 0.97+14.03j]>
    """

    def permittivity(self, wavelength):
        r"""
        Return the complex permittivity :math:`\epsilon = (n + ik)^2`.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength in vacuum, any shape.

        Returns
        -------
        `~astropy.units.Quantity`
            Complex and dimensionless, of the shape of ``wavelength``.

        Raises
        ------
        WavelengthRangeError
            If a wavelength lies outside ``valid_range`` or is not a number.
        ParameterError
            If the wavelength has no unit of length.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.materials import SILVER
        >>> SILVER.permittivity(1.6 * u.um).round(1)
        <Quantity -107.6+8.9j>
        """
        return self.index(wavelength) ** 2


_RAKIC = "10.1364/AO.37.005271"

#: Silver; Rakić et al. 1998, Brendel-Bormann parameters, 0.1 to 5 eV.
#:
#: Films differ: at 1.6 um, n is 0.43 here, 0.27 in Yang et al. (2015,
#: doi:10.1103/PhysRevB.91.235137) and 0.15 in Johnson & Christy (1972,
#: doi:10.1103/PhysRevB.6.4370); k is 10.4, 11.3 and 11.8.
SILVER = Metal(
    "silver",
    BrendelBormannLaw(
        plasma=9.01,
        drude=(0.821, 0.049),
        resonances=(
            (0.050, 0.189, 2.025, 1.894),
            (0.133, 0.067, 5.185, 0.665),
            (0.051, 0.019, 4.343, 0.189),
            (0.467, 0.117, 9.809, 1.170),
            (4.000, 0.052, 18.56, 0.516),
        ),
    ),
    measured_range=[0.248, 12.398] * u.um,
    doi=_RAKIC,
    aliases=("ag",),
)

#: Gold; Rakić et al. 1998, Brendel-Bormann parameters, 0.2 to 5 eV.
#:
#: Films differ: at 1.6 um, n is 0.61 here and 0.34 in Olmon et al. (2012,
#: evaporated, doi:10.1103/PhysRevB.86.235147); k is 10.2 and 11.0.
GOLD = Metal(
    "gold",
    BrendelBormannLaw(
        plasma=9.03,
        drude=(0.770, 0.050),
        resonances=(
            (0.054, 0.074, 0.218, 0.742),
            (0.050, 0.035, 2.885, 0.349),
            (0.312, 0.083, 4.069, 0.830),
            (0.719, 0.125, 6.137, 1.246),
            (1.648, 0.179, 27.97, 1.795),
        ),
    ),
    measured_range=[0.248, 6.199] * u.um,
    doi=_RAKIC,
    aliases=("au",),
)

#: Aluminium; Rakić et al. 1998, Brendel-Bormann parameters, 0.005 to 20 eV.
ALUMINIUM = Metal(
    "aluminium",
    BrendelBormannLaw(
        plasma=14.98,
        drude=(0.526, 0.047),
        resonances=(
            (0.213, 0.312, 0.163, 0.013),
            (0.060, 0.315, 1.561, 0.042),
            (0.182, 1.587, 1.827, 0.256),
            (0.014, 2.145, 4.495, 1.735),
        ),
    ),
    measured_range=[0.062, 247.97] * u.um,
    doi=_RAKIC,
    aliases=("al", "aluminum"),
)
