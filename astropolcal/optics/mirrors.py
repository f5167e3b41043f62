# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Mirrors: changes of handedness, and reflection by metals with a film.

A mirror at oblique incidence is a diattenuator-retarder. With ``theta`` = 0 the
field across the plane of incidence (s) is along +Q, so that
:math:`\epsilon = (R_s - R_p)/(R_s + R_p)` is positive for a metal and
:math:`\Delta = \arg r_p - \arg r_s` is 180 deg for an ideal mirror,
diag(1, 1, -1, -1). See `astropolcal.thinfilm` for signs and phases.
"""

from abc import abstractmethod
from contextlib import suppress

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.materials import get_material
from astropolcal.mueller import _diattenuator_retarder, diattenuator_retarder_slopes
from astropolcal.optics._modelling import Setting
from astropolcal.optics.core import Optic, _LinearOptic
from astropolcal.optics.polarizers import DiattenuatorRetarder
from astropolcal.thinfilm import _Stack, _wrapped

__all__ = ["KMirror", "MetalMirror", "ParityFlip", "PowerLawMirror"]

# powers of ten as exp, whose derivative is at hand
_LN10 = np.log(10.0)
_UM_IN_M = 1e-6


class ParityFlip(_LinearOptic):
    r"""
    Parity flip diag(1, -1, 1, -1): changes the sign of Q and V.

    What the ideal Nasmyth beam switcher does (paper, Sec. 5.2). Turned by
    45 deg it is diag(1, 1, -1, -1), the ideal mirror.

    Parameters
    ----------
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> from astropolcal.optics import ParityFlip
    >>> ParityFlip(name="nbs").mueller().diagonal()
    array([ 1., -1.,  1., -1.])
    """

    _constant = np.diag([1.0, -1.0, 1.0, -1.0])


class _Mirror(Optic):
    """
    A diattenuator-retarder by reflection.

    A subclass gives ln(r_p / r_s) and its derivative to every parameter; its
    real part is the diattenuation -tanh(...), its imaginary part the retardance.
    """

    _laws = {"diattenuation": None, "retardance": u.deg}

    @abstractmethod
    def _log_ratio(self, dispersion, *values):
        """Return ln(r_p / r_s)."""

    @abstractmethod
    def _log_slopes(self, dispersion, *values):
        """Return ln(r_p / r_s) and its derivatives to the values."""

    def _matrix(self, dispersion, *values):
        ratio = self._log_ratio(dispersion, *values)
        # ln(r_p / r_s) = x + i Delta, so that
        # (R_s - R_p) / (R_s + R_p) = (1 - e^2x) / (1 + e^2x) = -tanh x
        return _diattenuator_retarder(-np.tanh(ratio.real), ratio.imag)

    def _derivatives(self, dispersion, *values):
        ratio, slopes = self._log_slopes(dispersion, *values)
        diattenuation = -np.tanh(ratio.real)
        to_diattenuation, to_retardance = diattenuator_retarder_slopes(diattenuation, ratio.imag)
        # 1 - tanh^2, without the cancellation near a polarizer
        steepness = (1 - diattenuation) * (1 + diattenuation)
        to_diattenuation = -steepness[..., None, None] * to_diattenuation
        return tuple(
            slope.real[..., None, None] * to_diattenuation
            + slope.imag[..., None, None] * to_retardance
            for slope in slopes
        )

    def _check(self, good, key, value, unit, words):
        """Refuse values that no mirror has; bounds may have been lifted."""
        if not np.all(good):
            # argmin of booleans is the first that is False
            worst = np.ravel(value)[np.argmin(np.ravel(good))]
            raise ParameterError(f"{self._label}.{key} = {worst:.6g}{unit}; allowed are {words}")

    def _check_incidence(self, incidence):
        # the same mirror from the other side: a fit may cross zero
        good = np.abs(incidence) < np.pi / 2
        self._check(good, "incidence", np.rad2deg(incidence), " deg", "less than 90 deg")

    def _law(self, name, dispersion, *values):
        ratio, slopes = self._log_slopes(dispersion, *values)
        if name == "retardance":
            return _wrapped(ratio.imag), [slope.imag for slope in slopes]
        diattenuation = -np.tanh(ratio.real)
        return diattenuation, [(diattenuation**2 - 1) * slope.real for slope in slopes]

    def diattenuation(self, wavelength):
        """Return the diattenuation, positive where s is better reflected than p."""
        return self._laws_at(wavelength)["diattenuation"][0]

    def retardance(self, wavelength):
        """Return the retardance, 0 to 360 deg (Quantity); 180 deg for an ideal mirror."""
        return self._laws_at(wavelength)["retardance"][0] * u.deg

    def loosened(self, wavelength):
        """Return the diattenuator-retarder of the same values, free at each wavelength."""
        values = {law: getattr(self, law)(wavelength) for law in self._laws}
        # the free optic has neither metal nor film
        return self._as(DiattenuatorRetarder, name=self.name, mount=self.mount, **values)


class PowerLawMirror(_Mirror):
    r"""
    Bare mirror whose permittivity follows two power laws of the wavelength.

    .. math:: \epsilon = -10^{b_1}\lambda^{m_1} + i\,10^{b_2}\lambda^{m_2}

    with :math:`\lambda` in metre (paper, Eq. for the physical model of M3, after 't Hart et al.
    2021): straight lines in log-log space. The index is the root of :math:`\epsilon`, and the
    reflection that of Fresnel. Only what a metal looks like fixes the four numbers: :math:`m_1` = 2
    and :math:`m_2` = 3 are those of free electrons.

    Parameters
    ----------
    b1, m1 : float or array_like
        Offset and slope of the real part (negative).
    b2, m2 : float or array_like
        Offset and slope of the imaginary part (absorption).
    incidence : `~astropy.units.Quantity`
        Angle of incidence.
    theta : `~astropy.units.Quantity`
        Orientation of the field across the plane of incidence.

    Raises
    ------
    ParameterError
        If the angle of incidence is 90 deg or more.

    References
    ----------
    't Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833.

    Examples
    --------
    The published M3 of Subaru:

    >>> import astropy.units as u
    >>> from astropolcal.optics import PowerLawMirror
    >>> m3 = PowerLawMirror(b1=15.56, m1=3.186, b2=9.69, m2=1.040, name="m3")
    >>> m3.diattenuation([1.2, 1.6, 2.2] * u.um).round(4)
    array([0.0171, 0.0147, 0.0125])
    """

    b1 = Parameter(default=13.70, bounds=(0, 40), description="log10 of -Re(permittivity) at 1 m")
    m1 = Parameter(default=1.94, bounds=(-2, 6), description="power of the real part")
    b2 = Parameter(default=13.89, bounds=(0, 40), description="log10 of Im(permittivity) at 1 m")
    m2 = Parameter(default=2.08, bounds=(-2, 6), description="power of the imaginary part")
    incidence = Parameter(
        default=45.0, unit=u.deg, bounds=(0, 89), fixed=True, description="angle of incidence"
    )

    def _dispersion(self, wavelength):
        return np.log(np.asarray(wavelength) * _UM_IN_M)

    @staticmethod
    def _parts(log, b1, m1, b2, m2):
        """Return the two terms of the permittivity."""
        return -np.exp(b1 * _LN10 + m1 * log), 1j * np.exp(b2 * _LN10 + m2 * log)

    def _stack(self, parts, incidence):
        self._check_incidence(incidence)
        # a bare surface has no phase that depends on the wavelength
        return _Stack(1.0, incidence, [1.0, np.sqrt(sum(parts))], [])

    def _log_ratio(self, log, *values):
        return self._stack(self._parts(log, *values[:4]), values[4]).log_ratio()

    def _log_slopes(self, log, *values):
        real, imaginary = self._parts(log, *values[:4])
        stack = self._stack((real, imaginary), values[4])
        # n = sqrt(epsilon), so that dn = d(epsilon) / 2n, for either part
        to_incidence, (to_index,), _ = stack.log_slopes()
        per_part = to_index / (2 * stack.substrate.index)
        # a power 10^b lambda^m has the slopes ln 10 and ln(lambda) times itself
        to_b1, to_b2 = per_part * real * _LN10, per_part * imaginary * _LN10
        slopes = to_b1, to_b1 * log / _LN10, to_b2, to_b2 * log / _LN10, to_incidence
        return stack.log_ratio(), slopes

    def index(self, wavelength):
        """Return the complex index n + ik of the law."""
        log, _, values = self._resolve(wavelength, None)
        return np.sqrt(sum(self._parts(log, *values[:4])))


def _material_name(value, label):
    """Return the name by which a material is found again, in a file too."""
    if isinstance(value, str):
        get_material(value)
        return value
    name = getattr(value, "name", None)
    with suppress(ParameterError):
        if name and get_material(name) is value:
            return name
    raise ParameterError(
        f"{label} = {value!r}; allowed is the name of a material, which register_material "
        "gives to one of your own"
    )


class _Metallic(_Mirror):
    """What is coated with a metal and a film: one or several reflections in one plane."""

    material = Setting(
        "silver", _material_name, "Name of the metal, see `~astropolcal.materials.get_material`."
    )
    film = Setting("fused silica", _material_name, "Name of the material of the film.")

    def _dispersion(self, wavelength):
        wavelength = np.asarray(wavelength)
        # once in a fit: the wavelengths stay, only factors and thickness change
        materials = (get_material(name) for name in (self._material, self._film))
        return wavelength, *(material._index_um(wavelength) for material in materials)

    incidence = Parameter(
        default=45.0, unit=u.deg, bounds=(0, 89), fixed=True, description="angle of incidence"
    )
    film_thickness = Parameter(
        default=0.0, unit=u.nm, bounds=(0, 2000), fixed=True, description="thickness of the film"
    )
    n_scale = Parameter(
        default=1.0, bounds=(0.05, 20), fixed=True, description="factor on n of the metal"
    )
    k_scale = Parameter(
        default=1.0, bounds=(0.2, 5), fixed=True, description="factor on k of the metal"
    )

    def _reflections(self, incidence):
        """Return (angle, its derivative to the parameter, how often) of each reflection."""
        return ((incidence, 1.0, 1),)

    def _stacks(self, dispersion, incidence, film_thickness, n_scale, k_scale):
        wavelength, metal, film = dispersion
        self._check_incidence(incidence)
        for key, value, unit in (
            ("film_thickness", film_thickness, " um"),
            ("n_scale", n_scale, ""),
            ("k_scale", k_scale, ""),
        ):
            self._check(value >= 0, key, value, unit, "values that are not negative")
        # from the air through the film into the metal; n and k are scaled apart
        indices = [1.0, film, n_scale * metal.real + 1j * k_scale * metal.imag]
        return [
            (_Stack(wavelength, angle, indices, [film_thickness]), slope, count)
            for angle, slope, count in self._reflections(incidence)
        ]

    def _log_ratio(self, dispersion, *values):
        return sum(
            count * stack.log_ratio() for stack, _, count in self._stacks(dispersion, *values)
        )

    def _log_slopes(self, dispersion, *values):
        metal = dispersion[1]
        ratios, slopes = [], []
        for stack, slope, count in self._stacks(dispersion, *values):
            to_incidence, (_, to_metal), (to_thickness,) = stack.log_slopes()
            # the ratio is holomorphic in the index: d/dk is i d/dn
            to_scales = to_metal * metal.real, 1j * to_metal * metal.imag
            ratios.append(count * stack.log_ratio())
            slopes.append(count * np.stack([slope * to_incidence, to_thickness, *to_scales]))
        return sum(ratios), sum(slopes)


class MetalMirror(_Metallic):
    r"""
    Metal mirror, bare or with a film.

    .. math:: M = \begin{pmatrix}1&\epsilon&0&0\\ \epsilon&1&0&0\\
              0&0&t\cos\Delta&t\sin\Delta\\0&0&-t\sin\Delta&t\cos\Delta\end{pmatrix},
              \quad \epsilon = \frac{|r_s|^2 - |r_p|^2}{|r_s|^2 + |r_p|^2}, \quad
              \Delta = \arg\frac{r_p}{r_s}, \quad t = \sqrt{1-\epsilon^2}

    Fresnel reflection by the complex index of the metal, through the
    characteristic matrix of the film. Metals differ from film to film: a
    ``n_scale`` and a ``k_scale`` multiply n and k of the tables.

    Parameters
    ----------
    incidence : `~astropy.units.Quantity`
        Angle of incidence.
    film_thickness : `~astropy.units.Quantity`
        Thickness of the film; zero, the default, is a bare metal.
    n_scale, k_scale : float or array_like
        Factors on the real and the imaginary part of the index of the metal.
    material, film : str
        Names of the metal and of the material of the film, see
        `~astropolcal.materials.get_material`.
    theta : `~astropy.units.Quantity`
        Orientation of the field across the plane of incidence.

    Raises
    ------
    ParameterError
        If the angle of incidence is 90 deg or more, a thickness or
        factor is negative, or a material is not known.
    WavelengthRangeError
        If the index of a material is not known at a wavelength.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import MetalMirror
    >>> fold = MetalMirror(material="gold", name="fold_mirror")
    >>> fold.diattenuation([1.2, 1.6, 2.2] * u.um).round(4)
    array([0.0094, 0.0082, 0.0069])
    >>> fold.retardance(1.6 * u.um).round(1)
    <Quantity 187.9 deg>
    """


class KMirror(_Metallic):
    r"""
    Image derotator of three mirrors in one plane, a K-mirror, with equal films.

    Light meets the first and the last mirror at the angle of incidence
    :math:`\alpha` and the middle one at :math:`2\alpha - 90^\circ`, so that it
    leaves along the line on which it came: 60, 30, 60 deg by default. The amplitudes of the three
    multiply; together they are one diattenuator-retarder that turns with its mount ('t Hart et al.
    2021, who fit the film of that of Subaru).

    Parameters
    ----------
    incidence : `~astropy.units.Quantity`
        Angle of incidence :math:`\alpha` on the first and the last mirror.
    film_thickness : `~astropy.units.Quantity`
        Thickness of the film on each mirror.
    n_scale, k_scale : float or array_like
        Factors on the real and the imaginary part of the index of the metal.
    material, film : str
        Names of the metal and of the material of the film, see
        `~astropolcal.materials.get_material`.
    theta : `~astropy.units.Quantity`
        Orientation of the field across the plane of incidence.

    Raises
    ------
    ParameterError
        If the angle of incidence is not from 45 deg to less than 90 deg, a thickness or
        factor is negative, or a material is not known.
    WavelengthRangeError
        If the index of a material is not known at a wavelength.

    References
    ----------
    't Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import KMirror
    >>> derotator = KMirror(film_thickness=260 * u.nm, mount="derotator", name="derotator")
    >>> derotator.retardance([1.2, 1.6, 2.2] * u.um).round(0)
    <Quantity [144., 274., 303.] deg>
    """

    incidence = Parameter(
        default=60.0,
        unit=u.deg,
        bounds=(50, 80),
        fixed=True,
        description="angle of incidence on the first and the last mirror",
    )
    film_thickness = Parameter(
        default=200.0, unit=u.nm, bounds=(0, 2000), description="thickness of the films"
    )

    def _reflections(self, incidence):
        # a smaller angle leaves the middle mirror no place
        good = incidence >= np.pi / 4
        self._check(good, "incidence", np.rad2deg(incidence), " deg", "45 deg to less than 90 deg")
        # a mirror at the angle a bends the light by 180 deg - 2 a; the outer two undo what the
        # middle one does: 2 (180 - 2 a) = 180 - 2 b
        return ((incidence, 1.0, 2), (2 * incidence - np.pi / 2, 2.0, 1))
