# Licensed under a 3-clause BSD style license - see LICENSE
"""
Optics that act in one state of a device, or on one beam of several.

Their ``mount`` is ``"COLUMN=STATE"``: the position is 1 in the frames whose column of the table
has that state, and 0 in all others, where the optic does nothing. A liquid crystal with four
voltages is four retarders, ``mount="lcvr=A"`` to ``"lcvr=D"``; an analyser with three beams is
three polarizers, ``mount="beam=NAME"``, one for each column ``flux_NAME``.
"""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.mueller import _linear_retarder, blank, retardance_slope
from astropolcal.optics.modulated import FrameOptic

__all__ = ["StateAnalyser", "StateRetarder"]


def _times(factor, matrix):
    return np.asarray(factor)[..., None, None] * matrix


class StateRetarder(FrameOptic):
    r"""
    Linear retarder that is there in one state of a device only.

    Its retardance is :math:`x\delta`, with x = 1 in the frames of its state and 0 in the others:
    a liquid crystal at one of its voltages (Tomczyk et al. 2010, Appl. Opt. 49, 3580,
    doi:10.1364/AO.49.003580).

    Parameters
    ----------
    retardance : `~astropy.units.Quantity`
        Retardance :math:`\delta` in this state; scalar, or one value per wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the fast axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import StateRetarder
    >>> quarter = StateRetarder(retardance=90 * u.deg, mount="lcvr=B", name="lcvr_B")
    >>> [float(quarter.mueller(position=x)[2, 3].round(6)) for x in (0, 1)]
    [0.0, 1.0]
    """

    retardance = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="retardance in this state"
    )

    def _matrix(self, coordinate, retardance):
        return _linear_retarder(coordinate * retardance)

    def _derivatives(self, coordinate, retardance):
        return (_times(coordinate, retardance_slope(coordinate * retardance)),)


class StateAnalyser(FrameOptic):
    r"""
    Linear polarizer that one beam, or one state of a wheel, passes through.

    .. math:: M = (1 - x)\,\mathbb{1} + x\,\frac{t}{2}
              \begin{pmatrix}1&\eta&0&0\\ \eta&1&0&0\\0&0&0&0\\0&0&0&0\end{pmatrix}

    with x = 1 in its beam or state and 0 in the others: one beam of a double Wollaston prism
    (Oliva 1997, A&AS 123, 589), or one polarizer of a filter wheel. For all beams to be analysed,
    each needs one.

    Parameters
    ----------
    efficiency : float or array_like
        Modulation efficiency :math:`\eta`, between -1 and 1.
    transmission : float or array_like
        Transmission t, relative to the other beams or states. Fixed by default.
    theta : `~astropy.units.Quantity`
        Orientation of the transmission axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import StateAnalyser
    >>> beam = StateAnalyser(efficiency=0.99, theta=45 * u.deg, mount="beam=i45", name="i45")
    >>> beam.mueller(position=1)[0].round(3).tolist()
    [0.5, 0.0, 0.495, 0.0]
    """

    efficiency = Parameter(default=1.0, bounds=(-1, 1), description="modulation efficiency")
    transmission = Parameter(
        default=1.0, bounds=(0, 4), fixed=True, description="relative transmission"
    )

    def _matrix(self, coordinate, efficiency, transmission):
        shape = np.broadcast_shapes(*map(np.shape, (coordinate, efficiency, transmission)))
        out = np.empty((*shape, 4, 4))
        out[...] = _times(1.0 - np.asarray(coordinate), np.eye(4))
        for i in (0, 1):
            out[..., i, i] += coordinate * transmission / 2
            out[..., i, 1 - i] += coordinate * transmission * efficiency / 2
        return out

    def _derivatives(self, coordinate, efficiency, transmission):
        values = (coordinate, efficiency, transmission)
        slopes = blank(*values), blank(*values)
        for i in (0, 1):
            slopes[0][..., i, 1 - i] = coordinate * transmission / 2
            slopes[1][..., i, i] = coordinate / 2
            slopes[1][..., i, 1 - i] = coordinate * efficiency / 2
        return slopes
