# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that attenuate: polarizers, diattenuators and diattenuating retarders."""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.mueller.elements import _diattenuator, _diattenuator_retarder
from astropolcal.optics.core import Optic, blank

__all__ = ["Diattenuator", "DiattenuatorRetarder", "LinearPolarizer"]

# sqrt(1 - eps^2) has no derivative at |eps| = 1: a floor keeps it finite there
_ROOT_FLOOR = 1e-8


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
        return (_to_diattenuation(diattenuation, 1.0, 0.0),)


class DiattenuatorRetarder(Optic):
    r"""
    Linear diattenuator and linear retarder with common axes.

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
        root = _transverse(diattenuation)
        _phase_block(to_retardance, -root * s, root * c)
        return _to_diattenuation(diattenuation, c, s), to_retardance


def _transverse(diattenuation):
    return np.sqrt((1 - diattenuation) * (1 + diattenuation))


def _phase_block(matrix, c, s):
    """Fill the U, V block with [[c, s], [-s, c]], in place."""
    matrix[..., 2, 2] = matrix[..., 3, 3] = c
    matrix[..., 2, 3] = s
    matrix[..., 3, 2] = -np.asarray(s)


def _to_diattenuation(diattenuation, c, s):
    out = blank(diattenuation, c)
    out[..., 0, 1] = out[..., 1, 0] = 1.0
    slope = -diattenuation / np.maximum(_transverse(diattenuation), _ROOT_FLOOR)
    _phase_block(out, slope * c, slope * s)
    return out
