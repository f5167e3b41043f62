# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that retard or rotate: retarders, a waveplate of two layers, turns of the frame."""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.materials import MGF2, QUARTZ
from astropolcal.mueller import (
    _elliptical_retarder,
    _linear_retarder,
    blank,
    retardance_slope,
)
from astropolcal.optics._modelling import phase
from astropolcal.optics.core import Optic, _LinearOptic

__all__ = ["EllipticalRetarder", "LinearRetarder", "Rotator", "TwoLayerWaveplate"]


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
        return _linear_retarder(retardance)

    def _derivatives(self, dispersion, retardance):
        return (retardance_slope(retardance),)


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
        return _linear_retarder(self._law("retardance", dispersion, *thicknesses)[0])

    def _derivatives(self, dispersion, *thicknesses):
        slope = retardance_slope(self._law("retardance", dispersion, *thicknesses)[0])
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
        return _elliptical_retarder(horizontal, diagonal, circular)

    def _derivatives(self, dispersion, horizontal, diagonal, circular):
        # M = cos x 1 + sinc [d] + versine d d^T with x = |d|; by d_i that is d_i times the slope
        # over x of each factor, plus what d_i itself does
        vector = np.stack(np.broadcast_arrays(horizontal, diagonal, circular), axis=-1)
        total = np.sqrt(np.sum(vector**2, axis=-1))
        sinc, versine, sinc_slope, versine_slope = (f[..., None, None] for f in _functions(total))
        outer = vector[..., :, None] * vector[..., None, :]
        cross = (vector @ _CROSS).reshape(*total.shape, 3, 3)
        common = sinc_slope * cross + versine_slope * outer - sinc * np.eye(3)
        return tuple(self._slope(i, vector, sinc, versine, common) for i in range(3))

    @staticmethod
    def _slope(i, vector, sinc, versine, common):
        """Derivative to component i; ``common`` is that through the length, over d_i."""
        out = blank(vector[..., 0])
        block = out[..., 1:, 1:]
        block += vector[..., i, None, None] * common + sinc * _CROSS[i].reshape(3, 3)
        block[..., i, :] += versine[..., 0] * vector
        block[..., :, i] += versine[..., 0] * vector
        return out


# d @ _CROSS is the antisymmetric part of the rotation of (Q, U, V), row by row
_CROSS = np.array(
    [
        [[0, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 0, -1], [0, 0, 0], [1, 0, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 0]],
    ],
    dtype=float,
).reshape(3, 9)


def _functions(x):
    """Return sin(x)/x, (1 - cos x)/x^2 and their derivatives over x, for any x >= 0."""
    sinc, half = np.sinc(x / np.pi), np.sinc(x / (2 * np.pi))
    # (1 - cos x)/x^2 is the square of sin(x / 2)/(x / 2) over 2
    return sinc, half**2 / 2, _sinc_slope(x), half * _sinc_slope(x / 2) / 4


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
