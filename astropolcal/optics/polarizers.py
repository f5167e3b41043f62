# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that attenuate: polarizers, diattenuators and diattenuating retarders."""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.mueller.elements import _diattenuator, _diattenuator_retarder
from astropolcal.optics._matrices import (
    blank,
    diattenuation_slope,
    fill_phase_block,
    transverse_share,
)
from astropolcal.optics.core import Optic

__all__ = ["Diattenuator", "DiattenuatorRetarder", "LinearPolarizer", "VectorDiattenuator"]


class LinearPolarizer(Optic):
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

    def _matrix(self, dispersion):
        out = np.zeros((4, 4))
        out[:2, :2] = 0.5
        return out

    def _derivatives(self, dispersion):
        return ()


class Diattenuator(Optic):
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
        Orientation of the axis of higher transmission (for positive
        diattenuation).

    Examples
    --------
    >>> from astropolcal.optics import Diattenuator
    >>> Diattenuator(diattenuation=0.01).mueller()[1, 0]
    np.float64(0.01)
    """

    diattenuation = Parameter(
        default=0.0, bounds=(-1, 1), description="relative difference of the two transmissions"
    )

    def _matrix(self, dispersion, diattenuation):
        return _diattenuator(diattenuation)

    def _derivatives(self, dispersion, diattenuation):
        return (diattenuation_slope(diattenuation, 1.0, 0.0),)


class DiattenuatorRetarder(Optic):
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

    diattenuation = Parameter(
        default=0.0, bounds=(-1, 1), description="relative difference of the two transmissions"
    )
    retardance = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="phase between the two axes"
    )

    def _matrix(self, dispersion, diattenuation, retardance):
        return _diattenuator_retarder(diattenuation, retardance)

    def _derivatives(self, dispersion, diattenuation, retardance):
        c, s = np.cos(retardance), np.sin(retardance)
        to_retardance = blank(diattenuation, retardance)
        root = transverse_share(diattenuation)
        fill_phase_block(to_retardance, -root * s, root * c)
        return diattenuation_slope(diattenuation, c, s), to_retardance


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
        The components; scalars, or one value a wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> from astropolcal.optics import VectorDiattenuator
    >>> VectorDiattenuator(horizontal=0.01, diagonal=-0.02).mueller()[0]
    array([ 1.  ,  0.01, -0.02,  0.  ])
    """

    # 0.7 sqrt(2) < 1: any pair within its bounds is physical
    horizontal = Parameter(default=0.0, bounds=(-0.7, 0.7), description="component along Q")
    diagonal = Parameter(default=0.0, bounds=(-0.7, 0.7), description="component along U")

    def _matrix(self, dispersion, horizontal, diagonal):
        out = blank(horizontal, diagonal)
        transverse = np.sqrt(1 - horizontal**2 - diagonal**2)
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
        parts = np.broadcast_arrays(
            np.asarray(horizontal, dtype=float), np.asarray(diagonal, dtype=float)
        )
        return tuple(_vector_slope(parts[i], parts[1 - i], i) for i in range(2))


def _vector_slope(own, other, i):
    """Return the derivative to component i (0 along Q, 1 along U) of a diattenuation vector."""
    out = blank(own)
    j = 1 - i
    transverse = np.sqrt(1 - own**2 - other**2)
    share = 1 / (1 + transverse)
    # dt/dD_i; and of 1 / (1 + t)
    fall = -own / transverse
    rise = -(share**2) * fall
    out[..., 0, 1 + i] = out[..., 1 + i, 0] = 1.0
    out[..., 1 + i, 1 + i] = fall + rise * own**2 + 2 * share * own
    out[..., 1 + j, 1 + j] = fall + rise * other**2
    out[..., 1, 2] = out[..., 2, 1] = rise * own * other + share * other
    out[..., 3, 3] = fall
    return out
