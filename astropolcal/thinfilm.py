# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Reflection by a surface and by a stack of films: Fresnel and the characteristic matrix.

Fields vary as :math:`e^{i(kz - \omega t)}`, so that an absorbing index is n + ik with positive k.
The directions of s, p and of the light are right-handed before and after the reflection; at normal
incidence :math:`r_p = -r_s`, and an ideal mirror has a retardance of 180 deg. The retardance is
:math:`\Delta = \arg r_p - \arg r_s`, the diattenuation
:math:`\epsilon = (R_s - R_p)/(R_s + R_p)`.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.materials import get_material
from astropolcal.mueller import diattenuator_retarder
from astropolcal.units import angle_to_rad, length_to_um, to_unit

__all__ = ["reflect"]

# keeps the admittance of p finite exactly at the critical angle
_GRAZING = 1e-12
_TURN = 2 * np.pi


class _Medium:
    """A medium at a given tangential wave number alpha = n_0 sin(incidence)."""

    def __init__(self, index, alpha):
        # Snell: alpha is the same in all layers; q = sqrt(n^2 - alpha^2) is the normal wave number
        self.index, self.alpha = index, alpha
        normal = np.sqrt(index * index - alpha * alpha)
        # the wave that decays, or that goes on, away from the light
        normal = np.where(normal.imag < 0, -normal, normal)
        self.normal = np.where(np.abs(normal) < _GRAZING, _GRAZING, normal)
        # eta_s = q, eta_p = n^2 / q
        self.admittance = np.stack([self.normal, index * index / self.normal])

    def slopes(self, to_admittance, to_normal=0.0):
        """Return derivatives to index and alpha from those to admittance and normal wave number."""
        ratio, fall = self.index / self.normal, -self.alpha / self.normal
        # dq/dn = n / q, so that d(n^2 / q)/dn = 2 n / q - (n / q)^3
        by_index = np.stack([ratio, 2 * ratio - ratio**3])
        # dq/d(alpha) = -alpha / q, and d(n^2 / q)/dq = -(n / q)^2
        by_alpha = np.stack([fall, -fall * ratio**2])
        return (
            to_normal * ratio + to_admittance * by_index,
            to_normal * fall + to_admittance * by_alpha,
        )


class _Stack:
    """Amplitudes of a stack on canonical floats; s and p are the first axis.

    ``indices`` runs from the ambient to the substrate, ``thicknesses`` over the films. The
    admittance Y of the light, the ratio of its tangential fields, is carried through the films from
    the substrate on.
    """

    def __init__(self, wavelength, incidence, indices, thicknesses):
        arrays = np.broadcast_arrays(wavelength, incidence, *indices, *thicknesses)
        wavelength, self.incidence = arrays[:2]
        indices, thicknesses = arrays[2 : 2 + len(indices)], arrays[2 + len(indices) :]
        alpha = indices[0].real * np.sin(self.incidence)
        self.ambient, *films, self.substrate = (_Medium(index + 0j, alpha) for index in indices)
        # no light comes back from the substrate
        y, field, self.films = self.substrate.admittance, 1.0, []
        for film, thickness in zip(films[::-1], thicknesses[::-1], strict=True):
            wave, eta = 2j * _TURN / wavelength, film.admittance
            # twice the passage; never grows, so that a thick film overflows nowhere
            echo = np.exp(wave * thickness * film.normal)
            # of the characteristic matrix without the phase of one passage, which cancels in r
            under = 1 + echo + y * (1 - echo) / eta
            self.films.insert(0, (film, wave, thickness, echo, y, under))
            field = field * under / 2
            y = (y * (1 + echo) + eta * (1 - echo)) / under
        self.y, eta = y, self.ambient.admittance
        # what comes in and what goes back are (eta + Y) / 2 and (eta - Y) / 2 of the field
        self.total, self.tangential = (eta + y) * field, (eta - y) / (eta + y)

    @property
    def amplitudes(self):
        """Reflection amplitudes r_s and r_p; the p field turns with the light."""
        # the amplitudes are of tangential fields; that of p turns its direction in the reflection
        return self.tangential[0], -self.tangential[1]

    def transmittances(self):
        """Return T_s and T_p into the substrate."""
        # the phase of one passage that the films left out, squared
        loss = np.prod([np.abs(echo) for _, _, _, echo, _, _ in self.films], axis=0)
        out = 4 * self.ambient.admittance.real * self.substrate.admittance.real
        return out * loss / np.abs(self.total) ** 2

    def log_ratio(self):
        """Return ln(r_p / r_s)."""
        s, p = self.amplitudes
        return np.log(p / s)

    def log_slopes(self):
        """
        Return the derivatives of `log_ratio`.

        To the incidence (one), to the indices downstream of the ambient (a list with the substrate
        last), and to the thicknesses (a list). It is holomorphic in the indices.
        """
        y, eta = self.y, self.ambient.admittance
        # of ln r = ln(eta - Y) - ln(eta + Y)
        to_y = -2 * eta / (eta**2 - y**2)
        _, to_alpha = self.ambient.slopes(2 * y / (eta**2 - y**2))
        indices, thicknesses = [], []
        for film, wave, thickness, echo, below, under in self.films:
            eta = film.admittance
            # the derivatives of Y above the film, see `__init__`
            to_echo = to_y * 2 * (below**2 - eta**2) / (eta * under**2)
            to_eta = to_y * (y / eta - 4 * below * echo / (eta * under**2))
            to_y, y = to_y * 4 * echo / under**2, below
            # echo = exp(2i 2 pi / lambda d q)
            to_phase = to_echo * wave * echo
            thicknesses.append(to_phase * film.normal)
            to_index, more = film.slopes(to_eta, to_phase * thickness)
            indices.append(to_index)
            to_alpha = to_alpha + more
        to_index, more = self.substrate.slopes(to_y)
        # alpha = n_0 sin(incidence)
        to_incidence = (to_alpha + more) * self.ambient.index.real * np.cos(self.incidence)
        found = [to_incidence, *indices, to_index, *thicknesses]
        incidence, *found = [p - s for s, p in found]
        return incidence, found[: len(indices) + 1], found[len(indices) + 1 :]


def _wrapped(phase):
    """Return a phase between 0 and 2 pi, in which that of a mirror does not jump."""
    return np.mod(phase, _TURN)


@dataclass(frozen=True)
class Reflection:
    """What a surface does to the light that it reflects, made by `reflect`.

    ``r_s`` and ``r_p`` are complex amplitudes of the field across and in the plane of incidence,
    ``transmittance_s`` and ``transmittance_p`` shares of the power that enter the substrate,
    ``slopes`` derivatives of ln(r_p / r_s), see ``derivatives``.
    """

    r_s: np.ndarray
    r_p: np.ndarray
    transmittance_s: np.ndarray
    transmittance_p: np.ndarray
    slopes: tuple

    @property
    def reflectance_s(self):
        """Share of the power reflected across the plane of incidence."""
        return np.abs(self.r_s) ** 2

    @property
    def reflectance_p(self):
        """Share of the power reflected in the plane of incidence."""
        return np.abs(self.r_p) ** 2

    @property
    def reflectance(self):
        """Share of unpolarized light that is reflected."""
        return (self.reflectance_s + self.reflectance_p) / 2

    @property
    def diattenuation(self):
        """Difference of the reflectances over their sum, positive where s is better reflected."""
        return (self.reflectance_s - self.reflectance_p) / (2 * self.reflectance)

    @property
    def retardance(self):
        """Phase of r_p over that of r_s, 0 to 360 deg; 180 deg for an ideal mirror."""
        return np.rad2deg(_wrapped(np.angle(self.r_p * np.conj(self.r_s)))) * u.deg

    def mueller(self):
        """Return the Mueller matrix of unit transmission with s along Q, shape (..., 4, 4)."""
        return diattenuator_retarder(self.diattenuation, self.retardance)

    def derivatives(self):
        """Return the derivatives of diattenuation and retardance (radian), two in a tuple.

        Keys are ``incidence`` (per radian), ``n`` and ``k`` of the substrate, and ``n_1``,
        ``k_1``, ``thickness_1`` (per micrometre) and so on of the films, the first being where the
        light arrives.
        """
        incidence, indices, thicknesses = self.slopes
        labels = [f"_{i + 1}" for i in range(len(thicknesses))]
        found = {"incidence": incidence}
        for label, slope in zip([*labels, ""], indices, strict=True):
            found |= {f"n{label}": slope, f"k{label}": 1j * slope}
        for label, slope in zip(labels, thicknesses, strict=True):
            found[f"thickness{label}"] = slope
        steepness = (1 - self.diattenuation) * (1 + self.diattenuation)
        return {key: (-steepness * slope.real, slope.imag) for key, slope in found.items()}


def reflect(wavelength, incidence, substrate, films=(), ambient=1.0):
    r"""
    Return the reflection by a mirror with any number of films.

    The characteristic matrix of each film relates the tangential fields on its sides,

    .. math:: \begin{pmatrix}\cos\delta & -i\sin\delta/\eta\\
              -i\eta\sin\delta & \cos\delta\end{pmatrix}, \qquad
              \delta = \frac{2\pi}{\lambda} q d, \quad
              \eta_s = q, \quad \eta_p = n^2/q,

    and the substrate has the fields :math:`(1, \eta)`.

    Parameters
    ----------
    wavelength : `~astropy.units.Quantity`
        In vacuum, any shape.
    incidence : `~astropy.units.Quantity`
        Angle of incidence, 0 deg to less than 90 deg; broadcast with the wavelengths.
    substrate : str, material, or complex
        Name (see `~astropolcal.materials.get_material`), material, or index n + ik.
    films : sequence of (material, `~astropy.units.Quantity`)
        Material (as ``substrate``) and thickness of each film, the first where the light arrives.
    ambient : float
        Real index upstream of the films.

    Returns
    -------
    Reflection
        Amplitudes, diattenuation, retardance and their derivatives.

    Raises
    ------
    ParameterError
        If an angle, a thickness or an index is not allowed, or a material unknown.
    WavelengthRangeError
        If the index of a material is not known at a wavelength.

    References
    ----------
    Abelès 1950, Ann. Phys. 12, 596; Born & Wolf 1999, Principles of Optics, Sec. 1.6.

    Examples
    --------
    A film of silica changes the retardance of a silver mirror:

    >>> import astropy.units as u
    >>> from astropolcal.thinfilm import reflect
    >>> reflect(1.6 * u.um, 45 * u.deg, "silver").retardance.round(1)
    <Quantity 187.8 deg>
    >>> film = ("fused silica", 200 * u.nm)
    >>> reflect(1.6 * u.um, 45 * u.deg, "silver", [film]).retardance.round(1)
    <Quantity 207.4 deg>
    """
    lam = length_to_um(wavelength)
    if not np.all(lam > 0):
        raise ParameterError(f"wavelength = {wavelength} must be positive")
    entrance = _plain_index(ambient)
    if not np.all((entrance.imag == 0) & (entrance.real > 0)):
        raise ParameterError(f"ambient = {ambient}; allowed are real, positive indices")
    indices = [entrance]
    indices += [_index(material, lam) for material in (*(m for m, _ in films), substrate)]
    thicknesses = [length_to_um(thickness, "thickness") for _, thickness in films]
    for thickness in thicknesses:
        if not np.all(np.isfinite(thickness) & (thickness >= 0)):
            raise ParameterError(f"thickness = {thickness} um must be finite and not negative")
    angle = angle_to_rad(incidence, "incidence")
    if not np.all((angle >= 0) & (angle < np.pi / 2)):
        raise ParameterError(f"incidence = {incidence}; allowed are 0 deg to less than 90 deg")
    try:
        stack = _Stack(lam, angle, indices, thicknesses)
    except ValueError:
        raise ParameterError(
            "wavelength, incidence, indices and thicknesses must broadcast together; their shapes "
            f"are {[np.shape(x) for x in (lam, angle, *indices, *thicknesses)]}"
        ) from None
    r_s, r_p = stack.amplitudes
    with np.errstate(divide="ignore", invalid="ignore"):
        # at the Brewster angle of a transparent body the phase of p has no slope
        slopes = stack.log_slopes()
    return Reflection(r_s, r_p, *stack.transmittances(), slopes)


def _index(material, lam):
    if isinstance(material, str):
        material = get_material(material)
    return material._index_um(lam) if hasattr(material, "_index_um") else _plain_index(material)


def _plain_index(value):
    index = to_unit(value, None, "material or index", complex)
    if not np.all(np.isfinite(index) & (index.real >= 0) & (index.imag >= 0) & (index != 0)):
        raise ParameterError(f"index = {value}; allowed are n + ik with n and k not negative")
    return index
