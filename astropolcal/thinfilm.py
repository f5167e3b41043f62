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
from astropolcal.units import angle_to_rad, length_to_um

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

    def to_index(self):
        """Return the derivatives of the normal wave number and the admittance to the index."""
        slope = self.index / self.normal
        # dq/dn = n / q, so that d(n^2 / q)/dn = 2 n / q - (n / q)^3
        return slope, np.stack([slope, 2 * slope - slope**3])

    def to_alpha(self):
        """Return the derivatives of the normal wave number and the admittance to alpha."""
        slope = -self.alpha / self.normal
        # dq/d(alpha) = -alpha / q, and d(n^2 / q)/dq = -(n / q)^2
        return slope, np.stack([slope, -slope * (self.index / self.normal) ** 2])


class _Film(_Medium):
    """A film: its characteristic matrix without the phase of one passage, which cancels in r."""

    def __init__(self, index, alpha, thickness, wavelength):
        super().__init__(index, alpha)
        self.wave = 2j * _TURN / wavelength
        self.thickness = thickness
        # twice the passage; never grows, so that a thick film overflows nowhere
        self.echo = np.exp(self.wave * thickness * self.normal)

    def times(self, upper, lower):
        """Return the tangential fields upstream of the film from those downstream of it."""
        plus, minus = (1 + self.echo) / 2, (1 - self.echo) / 2
        front = plus * upper + minus / self.admittance * lower
        return front, self.admittance * minus * upper + plus * lower

    def back(self, upper, lower):
        """Return a row vector times the matrix of the film."""
        plus, minus = (1 + self.echo) / 2, (1 - self.echo) / 2
        front = plus * upper + self.admittance * minus * lower
        return front, minus / self.admittance * upper + plus * lower

    def slopes(self, row, fields):
        """Return the derivatives of row times fields to the admittance and to the echo."""
        (left, right), (upper, lower) = row, fields
        eta, minus = self.admittance, (1 - self.echo) / 2
        to_admittance = minus * (right * upper - left * lower / eta**2)
        to_echo = 0.5 * (left * (upper - lower / eta) + right * (lower - eta * upper))
        return to_admittance, to_echo


class _Stack:
    """
    Amplitudes of a stack on canonical floats; s and p are the first axis.

    ``indices`` runs from the ambient to the substrate, ``thicknesses`` over the films.
    """

    def __init__(self, wavelength, incidence, indices, thicknesses):
        count = len(indices)
        arrays = np.broadcast_arrays(wavelength, incidence, *indices, *thicknesses)
        wavelength, self.incidence = arrays[:2]
        indices, thicknesses = arrays[2 : 2 + count], arrays[2 + count :]
        alpha = indices[0].real * np.sin(self.incidence)
        self.ambient = _Medium(indices[0] + 0j, alpha)
        self.substrate = _Medium(indices[-1] + 0j, alpha)
        self.films = [
            _Film(index + 0j, alpha, thickness, wavelength)
            for index, thickness in zip(indices[1:-1], thicknesses, strict=True)
        ]
        self._solve()

    def _solve(self):
        # no light comes back from the substrate: its tangential fields are (1, eta)
        fields = np.ones_like(self.substrate.admittance), self.substrate.admittance
        self.fields = [fields]
        for film in reversed(self.films):
            fields = film.times(*fields)
            self.fields.insert(0, fields)
        upper, lower = fields
        eta = self.ambient.admittance
        # what comes in and what goes back are (eta E + H) / 2 and (eta E - H) / 2
        self.total = eta * upper + lower
        self.tangential = (eta * upper - lower) / self.total

    @property
    def amplitudes(self):
        """Reflection amplitudes r_s and r_p; the p field turns with the light."""
        # the amplitudes are of tangential fields; that of p turns its direction in the reflection
        return self.tangential[0], -self.tangential[1]

    def transmittances(self):
        """Return T_s and T_p into the substrate."""
        # the phase of one passage that the films left out, squared
        loss = np.prod([np.abs(film.echo) for film in self.films], axis=0)
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
        rows = self._rows()
        upper = self.fields[0][0] * (1 - self.tangential) / self.total
        to_alpha = _chain(self.ambient.to_alpha(), 0.0, upper)
        indices, thicknesses = [], []
        for film, row, fields in zip(self.films, rows, self.fields[1:], strict=False):
            to_admittance, to_echo = film.slopes(row, fields)
            # echo = exp(2i 2 pi / lambda d q)
            to_normal = to_echo * film.wave * film.thickness * film.echo
            thicknesses.append(to_echo * film.wave * film.normal * film.echo)
            indices.append(_chain(film.to_index(), to_normal, to_admittance))
            to_alpha = to_alpha + _chain(film.to_alpha(), to_normal, to_admittance)
        # the fields in the substrate are (1, admittance)
        right = rows[-1][1]
        indices.append(_chain(self.substrate.to_index(), 0.0, right))
        to_alpha = to_alpha + _chain(self.substrate.to_alpha(), 0.0, right)
        # alpha = n_0 sin(incidence)
        to_incidence = to_alpha * self.ambient.index.real * np.cos(self.incidence)
        return (
            self._of_log(to_incidence),
            [self._of_log(slope) for slope in indices],
            [self._of_log(slope) for slope in thicknesses],
        )

    def _rows(self):
        """Return the derivative of the amplitudes to the fields upstream of each layer."""
        eta, r = self.ambient.admittance, self.tangential
        # r = (eta E - H) / (eta E + H), by E and by H
        rows = [(eta * (1 - r) / self.total, -(1 + r) / self.total)]
        for film in self.films:
            rows.append(film.back(*rows[-1]))
        return rows

    def _of_log(self, slope):
        # d ln(r_p / r_s); the sign of r_p cancels
        return slope[1] / self.tangential[1] - slope[0] / self.tangential[0]


def _chain(slopes, to_normal, to_admittance):
    normal, admittance = slopes
    return to_normal * normal + to_admittance * admittance


def _wrapped(phase):
    """Return a phase between 0 and 2 pi, in which that of a mirror does not jump."""
    return np.mod(phase, _TURN)


@dataclass(frozen=True)
class Reflection:
    """
    What a surface does to the light that it reflects, made by `reflect`.

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
        """
        Return the derivatives of diattenuation and retardance (radian), two in a tuple.

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
    stack = _checked_stack(lam, incidence, indices, [_thickness(d) for _, d in films])
    r_s, r_p = stack.amplitudes
    with np.errstate(divide="ignore", invalid="ignore"):
        # at the Brewster angle of a transparent body the phase of p has no slope
        slopes = stack.log_slopes()
    return Reflection(r_s, r_p, *stack.transmittances(), slopes)


def _checked_stack(lam, incidence, indices, thicknesses):
    angle = angle_to_rad(incidence, "incidence")
    if not np.all((angle >= 0) & (angle < np.pi / 2)):
        raise ParameterError(f"incidence = {incidence}; allowed are 0 deg to less than 90 deg")
    try:
        return _Stack(lam, angle, indices, thicknesses)
    except ValueError:
        raise ParameterError(
            "wavelength, incidence, indices and thicknesses must broadcast together; their shapes "
            f"are {[np.shape(x) for x in (lam, angle, *indices, *thicknesses)]}"
        ) from None


def _index(material, lam):
    if isinstance(material, str):
        material = get_material(material)
    return material._index_um(lam) if hasattr(material, "_index_um") else _plain_index(material)


def _plain_index(value):
    try:
        index = np.asarray(value, dtype=complex)
    except (TypeError, ValueError):
        raise ParameterError(f"{value!r} is neither a material nor an index") from None
    if not np.all(np.isfinite(index) & (index.real >= 0) & (index.imag >= 0) & (index != 0)):
        raise ParameterError(f"index = {value}; allowed are n + ik with n and k not negative")
    return index


def _thickness(value):
    thickness = length_to_um(value, "thickness")
    if not np.all(np.isfinite(thickness) & (thickness >= 0)):
        raise ParameterError(f"thickness = {value} must be finite and not negative")
    return thickness
