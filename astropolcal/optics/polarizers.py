# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that polarize, attenuate, depolarize, retard, rotate or split the light."""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal import mueller
from astropolcal.exceptions import ParameterError
from astropolcal.materials import MGF2, QUARTZ
from astropolcal.optics._modelling import Setting, phase
from astropolcal.optics.core import Optic, _LinearOptic
from astropolcal.words import check_choice

__all__ = [
    "BeamGain",
    "Depolarizer",
    "Diattenuator",
    "DiattenuatorRetarder",
    "EllipticalRetarder",
    "LinearPolarizer",
    "LinearRetarder",
    "Rotator",
    "TwoLayerWaveplate",
    "VectorDiattenuator",
    "WollastonPrism",
]


class LinearPolarizer(_LinearOptic):
    r"""
    Perfect linear polarizer; transmits the orientation ``theta``.

    .. math:: M = \tfrac{1}{2}\begin{pmatrix}1&1&0&0\\1&1&0&0\\0&0&0&0\\0&0&0&0\end{pmatrix}

    With ``theta`` = 0 it transmits +Q, with 90 deg -Q, as the CHARIS
    calibration polarizer (paper, Sec. 4.1).

    Parameters
    ----------
    theta : `~astropy.units.Quantity`
        Orientation of the transmission axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import LinearPolarizer
    >>> polarizer = LinearPolarizer(theta=90 * u.deg, name="calibration_polarizer")
    >>> wavelength, I, Q, U, V = polarizer(1.6 * u.um, 1, 0, 0, 0)
    >>> round(float(I), 6), round(float(Q), 6)
    (0.5, -0.5)
    """

    _constant = 0.5 * mueller.UNITS[:2, :2].sum(axis=(0, 1))


class _Diattenuating(Optic):
    """A diattenuator, perhaps with a retardance along the same axes."""

    _components = ("diattenuation",)
    diattenuation = Parameter(
        default=0.0, bounds=(-1, 1), description="relative difference of the two transmissions"
    )

    def _matrix(self, dispersion, diattenuation, retardance=0.0):
        return mueller._diattenuator_retarder(diattenuation, retardance)

    def _derivatives(self, dispersion, diattenuation, retardance=0.0):
        slopes = mueller.diattenuator_retarder_slopes(diattenuation, retardance)
        return slopes[: len(self.own_names)]


class Diattenuator(_Diattenuating):
    r"""
    Linear diattenuator of unit transmission for unpolarized light.

    .. math:: M = \begin{pmatrix}1&\epsilon&0&0\\ \epsilon&1&0&0\\
              0&0&\sqrt{1-\epsilon^2}&0\\0&0&0&\sqrt{1-\epsilon^2}\end{pmatrix}

    The diattenuator-retarder of the CHARIS paper (Eq. for
    :math:`M_\mathrm{DR}`) with zero retardance.

    Parameters
    ----------
    diattenuation : float or array_like
        :math:`\epsilon`, between -1 and 1.
    theta : `~astropy.units.Quantity`
        Orientation of the axis of higher transmission (for positive diattenuation).

    Examples
    --------
    >>> from astropolcal.optics import Diattenuator
    >>> Diattenuator(diattenuation=0.01).mueller()[1, 0]
    np.float64(0.01)
    """


class DiattenuatorRetarder(_Diattenuating):
    r"""
    Linear diattenuator and linear retarder with common axes.

    .. math:: M = \begin{pmatrix}1&\epsilon&0&0\\ \epsilon&1&0&0\\
              0&0&t\cos\Delta&t\sin\Delta\\0&0&-t\sin\Delta&t\cos\Delta\end{pmatrix},
              \qquad t = \sqrt{1-\epsilon^2}

    :math:`M_\mathrm{DR}(\epsilon, \Delta)` of the CHARIS paper (Sec. 4.2):
    the model of a mirror at oblique incidence.

    Parameters
    ----------
    diattenuation : float or array_like
        :math:`\epsilon`, between -1 and 1.
    retardance : `~astropy.units.Quantity`
        :math:`\Delta`.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import DiattenuatorRetarder
    >>> m3 = DiattenuatorRetarder(diattenuation=0.015, retardance=176 * u.deg, name="m3")
    >>> m3.mueller()[0, 1]
    np.float64(0.015)
    """

    retardance = phase("phase between the two axes")


class VectorDiattenuator(Optic):
    r"""
    Diattenuator of any linear orientation, of unit transmission for unpolarized light.

    With the vector :math:`D = (D_H, D_{45})` of length d, and
    :math:`t = \sqrt{1 - d^2}`, the first row and column are (1, D) and the block of
    (Q, U, V) is :math:`t\,\mathbb{1} + D D^T / (1 + t)` (Lu & Chipman 1996,
    doi:10.1364/JOSAA.13.001106).

    Parameters
    ----------
    horizontal, diagonal : float or array_like
        The components; scalars, or one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> from astropolcal.optics import VectorDiattenuator
    >>> VectorDiattenuator(horizontal=0.01, diagonal=-0.02).mueller()[0]
    array([ 1.  ,  0.01, -0.02,  0.  ])
    """

    _components = ("horizontal", "diagonal")
    # 0.7 sqrt(2) < 1: any pair within its bounds is physical
    horizontal = Parameter(default=0.0, bounds=(-0.7, 0.7), description="component along Q")
    diagonal = Parameter(default=0.0, bounds=(-0.7, 0.7), description="component along U")

    def _matrix(self, dispersion, horizontal, diagonal):
        out = mueller.blank(horizontal, diagonal)
        transverse = mueller.transverse_share(np.hypot(horizontal, diagonal))
        # (1 - t) / d^2, written so that nothing is divided by zero without diattenuation
        share = 1 / (1 + transverse)
        out[..., 0, 0] = 1.0
        out[..., 0, 1] = out[..., 1, 0] = horizontal
        out[..., 0, 2] = out[..., 2, 0] = diagonal
        out[..., 1, 1] = transverse + share * horizontal**2
        out[..., 2, 2] = transverse + share * diagonal**2
        out[..., 1, 2] = out[..., 2, 1] = share * horizontal * diagonal
        out[..., 3, 3] = transverse
        return out

    def _derivatives(self, dispersion, horizontal, diagonal):
        parts = np.broadcast_arrays(horizontal, diagonal)
        return tuple(_vector_slope(parts[i], parts[1 - i], i) for i in range(2))


def _vector_slope(own, other, i):
    """Return the derivative to component i (0 along Q, 1 along U) of a diattenuation vector."""
    out = mueller.blank(own)
    j = 1 - i
    transverse = mueller.transverse_share(np.hypot(own, other))
    share = 1 / (1 + transverse)
    # dt/dD_i; and of 1 / (1 + t)
    fall = -own / np.maximum(transverse, np.sqrt(np.finfo(float).eps))
    rise = -(share**2) * fall
    out[..., 0, 1 + i] = out[..., 1 + i, 0] = 1.0
    out[..., 1 + i, 1 + i] = fall + rise * own**2 + 2 * share * own
    out[..., 1 + j, 1 + j] = fall + rise * other**2
    out[..., 1, 2] = out[..., 2, 1] = rise * own * other + share * other
    out[..., 3, 3] = fall
    return out


class Depolarizer(_LinearOptic):
    r"""
    Diagonal depolarizer diag(1, a, b, c) with axes turned to ``theta``.

    Parameters
    ----------
    retained_q, retained_u, retained_v : float or array_like
        Share of Q, U and V (in the optic's frame) that survives, between 0
        and 1; scalars, or one value per wavelength. Physical as long as the
        coherency matrix stays positive, for instance ``a + b <= 1 + c``.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> from astropolcal.optics import Depolarizer
    >>> Depolarizer(retained_q=0.99, retained_u=0.98, retained_v=0.97).mueller().diagonal()
    array([1.  , 0.99, 0.98, 0.97])
    """

    retained_q = Parameter(default=1.0, bounds=(0, 1), description="share of Q that survives")
    retained_u = Parameter(default=1.0, bounds=(0, 1), description="share of U that survives")
    retained_v = Parameter(default=1.0, bounds=(0, 1), description="share of V that survives")

    # the intensity is kept
    _constant = mueller.UNITS[0, 0]
    _elements = tuple((1.0, ((i, i),)) for i in (1, 2, 3))


class LinearRetarder(Optic):
    r"""
    Linear retarder (paper, :math:`M_\mathrm{R}`).

    .. math:: M = \begin{pmatrix}1&0&0&0\\0&1&0&0\\0&0&\cos\Delta&\sin\Delta\\
              0&0&-\sin\Delta&\cos\Delta\end{pmatrix}

    with its axis along Q.

    Parameters
    ----------
    retardance : `~astropy.units.Quantity`
        :math:`\Delta`: scalar, or one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import LinearRetarder
    >>> hwp = LinearRetarder(retardance=180 * u.deg, theta=22.5 * u.deg, name="hwp")
    >>> _, I, Q, U, V = hwp(1.6 * u.um, 1, 1, 0, 0)
    >>> round(float(U), 6)
    1.0
    """

    retardance = phase("phase between the two axes")

    def _matrix(self, dispersion, retardance):
        return mueller._linear_retarder(retardance)

    def _derivatives(self, dispersion, retardance):
        return (mueller.retardance_slope(retardance),)


class TwoLayerWaveplate(Optic):
    r"""
    Achromatic waveplate of crossed crystal quartz and MgF2 layers.

    .. math:: \Delta = \frac{2\pi}{\lambda}\left[w_\mathrm{SiO_2}
              (n_e - n_o)_\mathrm{SiO_2} - w_\mathrm{MgF_2}(n_e - n_o)_\mathrm{MgF_2}\right]

    (paper, Eq. for the physical half-wave plate, after 't Hart et al. 2021);
    indices from Ghosh (1999) and Dodge (1984), see `astropolcal.materials`.
    The sign follows the equation: the CHARIS plate comes out near -172 deg.

    Parameters
    ----------
    w_sio2, w_mgf2 : `~astropy.units.Quantity`
        Thicknesses of the two layers.
    theta : `~astropy.units.Quantity`
        Orientation of the axis.

    Raises
    ------
    WavelengthRangeError
        If a wavelength lies outside the range of either material.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import TwoLayerWaveplate
    >>> hwp = TwoLayerWaveplate(w_sio2=1.653 * u.mm, w_mgf2=1.291 * u.mm, mount="hwp", name="hwp")
    >>> hwp.retardance([1.6, 2.0] * u.um).round(0)
    <Quantity [-171., -176.] deg>
    """

    w_sio2 = Parameter(
        default=1.63398, unit=u.mm, bounds=(0, None), description="thickness of the quartz layer"
    )
    w_mgf2 = Parameter(
        default=1.27711, unit=u.mm, bounds=(0, None), description="thickness of the MgF2 layer"
    )

    _laws = {"retardance": u.deg}

    def _dispersion(self, wavelength):
        # retardance per micrometre of each layer, shape (2, n_wavelengths); crossed axes subtract
        phase = 2 * np.pi / np.asarray(wavelength)
        return np.stack(
            [
                phase * QUARTZ._birefringence_um(wavelength),
                -phase * MGF2._birefringence_um(wavelength),
            ]
        )

    def _law(self, name, dispersion, w_sio2, w_mgf2):
        return w_sio2 * dispersion[0] + w_mgf2 * dispersion[1], tuple(dispersion)

    def _matrix(self, dispersion, *thicknesses):
        return mueller._linear_retarder(self._law("retardance", dispersion, *thicknesses)[0])

    def _derivatives(self, dispersion, *thicknesses):
        slope = mueller.retardance_slope(self._law("retardance", dispersion, *thicknesses)[0])
        return tuple(per_um[..., None, None] * slope for per_um in dispersion)

    def retardance(self, wavelength):
        """Return the retardance at a wavelength of any shape, in degree and not wrapped."""
        return self._laws_at(wavelength)["retardance"][0] * u.deg

    def loosened(self, wavelength):
        """Return the linear retarder of the same retardances, free at each wavelength."""
        return self._as(LinearRetarder, retardance=self.retardance(wavelength), **self._settings())


class EllipticalRetarder(Optic):
    r"""
    Elliptical retarder (paper, :math:`M_\mathrm{ER}`; Chipman et al. 2018).

    .. math:: M = \begin{pmatrix}1&0&0&0\\
              0&C + T\Delta_H^2&T\Delta_H\Delta_{45} + S\Delta_R&
              T\Delta_H\Delta_R - S\Delta_{45}\\
              0&T\Delta_H\Delta_{45} - S\Delta_R&C + T\Delta_{45}^2&
              T\Delta_{45}\Delta_R + S\Delta_H\\
              0&T\Delta_H\Delta_R + S\Delta_{45}&T\Delta_{45}\Delta_R - S\Delta_H&
              C + T\Delta_R^2\end{pmatrix}

    with :math:`\Delta^2 = \Delta_H^2 + \Delta_{45}^2 + \Delta_R^2`,
    :math:`C = \cos\Delta`, :math:`S = \sin\Delta/\Delta` and
    :math:`T = (1 - \cos\Delta)/\Delta^2`. The retardance vector
    :math:`d = (\Delta_H, \Delta_{45}, \Delta_R)` turns (Q, U, V) by :math:`|d|` about
    its own direction. Written with S and T it is exact and smooth through zero retardance.

    Parameters
    ----------
    horizontal, diagonal, circular : `~astropy.units.Quantity`
        :math:`\Delta_H`, :math:`\Delta_{45}`, :math:`\Delta_R`; scalars, or
        one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import EllipticalRetarder
    >>> derotator = EllipticalRetarder(horizontal=99 * u.deg, diagonal=4 * u.deg,
    ...                                circular=4.5 * u.deg, mount="derotator", name="derotator")
    >>> derotator.mueller()[0]
    array([1., 0., 0., 0.])
    """

    horizontal = phase("horizontal linear retardance")
    diagonal = phase("45 deg linear retardance")
    circular = phase("right circular retardance")

    def _matrix(self, dispersion, horizontal, diagonal, circular):
        return mueller._elliptical_retarder(horizontal, diagonal, circular)

    def _derivatives(self, dispersion, horizontal, diagonal, circular):
        # M = cos x 1 + sinc [d] + versine d d^T with x = |d|; by d_i that is d_i times the slope
        # over x of each factor, plus what d_i itself does
        vector = np.stack(np.broadcast_arrays(horizontal, diagonal, circular), axis=-1)
        total = np.sqrt(np.sum(vector**2, axis=-1))
        sinc, half = np.sinc(total / np.pi), np.sinc(total / (2 * np.pi))
        # versine, (1 - cos x)/x^2, is the square of sin(x / 2)/(x / 2) over 2
        factors = sinc, half**2 / 2, _sinc_slope(total), half * _sinc_slope(total / 2) / 4
        sinc, versine, sinc_slope, versine_slope = (f[..., None, None] for f in factors)
        outer = vector[..., :, None] * vector[..., None, :]
        cross = (vector @ _CROSS).reshape(*total.shape, 3, 3)
        common = sinc_slope * cross + versine_slope * outer - sinc * np.eye(3)
        slopes = np.zeros((3, *total.shape, 4, 4))
        for i, block in enumerate(slopes[..., 1:, 1:]):
            # through the length of d, then through its component
            block += vector[..., i, None, None] * common + sinc * _CROSS[i].reshape(3, 3)
            block[..., i, :] += versine[..., 0] * vector
            block[..., :, i] += versine[..., 0] * vector
        return tuple(slopes)


# d @ _CROSS is the antisymmetric part of the rotation of (Q, U, V), row by row
_CROSS = np.array(
    [
        [[0, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 0, -1], [0, 0, 0], [1, 0, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 0]],
    ],
    dtype=float,
).reshape(3, 9)


def _sinc_slope(x):
    """Return the derivative of sin(x)/x over x."""
    # below 0.3 rad six terms of the series are exact to rounding; above, the closed form loses
    # about two digits to cancellation
    small = x < 0.3
    safe, series = np.where(small, 1.0, x), 1.0
    for ratio in (130, 88, 54, 28, 10):
        series = 1.0 - x * x / ratio * series
    return np.where(small, -series / 3, (np.cos(safe) - np.sin(safe) / safe) / safe**2)


class Rotator(_LinearOptic):
    r"""
    Rotation of the reference frame for everything that follows.

    .. math:: T(\Theta) = \begin{pmatrix}1&0&0&0\\0&\cos2\Theta&\sin2\Theta&0\\
              0&-\sin2\Theta&\cos2\Theta&0\\0&0&0&1\end{pmatrix}

    with :math:`\Theta` = ``theta`` + position of the mount (paper, Sec. 4.1). The sky chain of
    CHARIS is ``Rotator(mount="parallactic") | m3 | Rotator(mount="-altitude")``.

    Parameters
    ----------
    theta : `~astropy.units.Quantity`
        Angle of the rotation.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import Rotator
    >>> _, I, Q, U, V = Rotator(theta=45 * u.deg)(1.6 * u.um, 1, 1, 0, 0)
    >>> round(float(U), 6)
    -1.0
    """

    rotates_frame = True

    # the turn by theta and mount is done in Optic, which knows `rotates_frame`
    _constant = np.eye(4)


# sign of eta: the right beam is the ordinary one
BEAMS = {"right": 1.0, "left": -1.0}


def _beam(value, name):
    check_choice("beam", value, BEAMS, ParameterError)
    return value


class _BeamOptic(Optic):
    """What acts differently on the two beams, and follows one of them in a chain."""

    depends_on_beam = True
    beam = Setting("right", _beam, 'The beam that goes on in a chain, ``"right"`` or ``"left"``.')


class WollastonPrism(_BeamOptic, _LinearOptic):
    r"""
    Wollaston prism: two beams of opposite linear polarization.

    .. math:: M = \tfrac{1}{2}\begin{pmatrix}1&\pm\eta&0&0\\ \pm\eta&1&0&0\\
              0&0&0&0\\0&0&0&0\end{pmatrix}

    The right beam is ordinary (:math:`+\eta`), the left extraordinary
    (:math:`-\eta`); paper, Eq. for :math:`M_\mathrm{Wol}`.

    Parameters
    ----------
    efficiency : float or array_like
        Modulation efficiency :math:`|\eta|`, between 0 and 1.
    beam : {"right", "left"}
        The beam that goes on in a chain; `beams` gives both.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import WollastonPrism
    >>> wollaston = WollastonPrism(efficiency=0.99, name="wollaston")
    >>> right, left = wollaston.beams(1.6 * u.um, 1, 1, 0, 0)
    >>> round(float(right[1]), 4), round(float(left[1]), 4)
    (0.995, 0.005)
    """

    splits_light = True
    _components = ("efficiency",)

    efficiency = Parameter(default=1.0, bounds=(0, 1), description="modulation efficiency")

    # half of unpolarized light goes into each beam
    _constant = 0.5 * (mueller.UNITS[0, 0] + mueller.UNITS[1, 1])

    @property
    def _elements(self):
        return ((0.5 * BEAMS[self._beam], ((0, 1), (1, 0))),)

    def beams(self, wavelength, I, Q, U, V):  # noqa: E741
        """
        Return the light of both beams.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Wavelength.
        I, Q, U, V : float or `~numpy.ndarray`
            The light that enters.

        Returns
        -------
        right, left : tuple
            ``(wavelength, I, Q, U, V)`` of each beam.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.optics import WollastonPrism
        >>> right, left = WollastonPrism().beams(1.6 * u.um, 1, -1, 0, 0)
        >>> float(right[1]), float(left[1])
        (0.0, 1.0)
        """
        return tuple(self.of_beam(beam)(wavelength, I, Q, U, V) for beam in ("right", "left"))


class BeamGain(_BeamOptic, _LinearOptic):
    r"""
    Unequal gains of the two beams: :math:`1 + g` for the right, :math:`1 - g` for the left.

    What is left of the flat field, or unequal transmission downstream of the beam
    splitter (Patat & Romaniello 2006, doi:10.1086/497581).

    Parameters
    ----------
    imbalance : float or array_like
        Half the relative difference g of the gains.
    beam : {"right", "left"}
        The beam that goes on in a chain.
    theta : `~astropy.units.Quantity`
        Without consequence here.

    Examples
    --------
    >>> from astropolcal.optics import BeamGain
    >>> float(BeamGain(imbalance=0.01, beam="left").mueller()[0, 0])
    0.99
    """

    imbalance = Parameter(default=0.0, bounds=(-0.5, 0.5), description="half the gain difference")

    _constant = np.eye(4)

    @property
    def _elements(self):
        return ((BEAMS[self._beam], ((0, 0), (1, 1), (2, 2), (3, 3))),)
