# Licensed under a 3-clause BSD style license - see LICENSE
"""Modulators: optics that are switched between two states from frame to frame."""

import astropy.units as u
import numpy as np
from astropy.modeling import Parameter

from astropolcal.mueller.elements import _linear_retarder, _rotate
from astropolcal.optics._matrices import retardance_slope, rotation_generator
from astropolcal.optics.modulated import FrameOptic

__all__ = ["FerroelectricLiquidCrystal"]


class FerroelectricLiquidCrystal(FrameOptic):
    r"""
    Ferroelectric liquid crystal: a retarder whose axis switches between two orientations.

    .. math:: M_s = T(-s\alpha)\, R(\delta)\, T(s\alpha)

    with the state s from the frame (``mount="flc_state"``): 0 in state A, 1 in state B
    (Norris et al. 2015,
    doi:10.1093/mnras/stu2529). A half-wave retarder with a switching angle
    of 45 deg exchanges the two beams.

    Parameters
    ----------
    retardance : `~astropy.units.Quantity`
        Retardance :math:`\delta`; scalar, or one value a wavelength.
    switching_angle : `~astropy.units.Quantity`
        Angle :math:`\alpha` from the fast axis in state A to that in state B; scalar, or one
        value a wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the fast axis in state A.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import FerroelectricLiquidCrystal
    >>> flc = FerroelectricLiquidCrystal(
    ...     retardance=180 * u.deg, switching_angle=45 * u.deg, mount="flc_state", name="flc"
    ... )
    >>> [float(flc.mueller(position=state)[1, 1].round(6)) for state in (0, 1)]
    [1.0, -1.0]
    """

    retardance = Parameter(
        default=0.0, unit=u.deg, bounds=(-360, 360), description="retardance in both states"
    )
    switching_angle = Parameter(
        default=0.0,
        unit=u.deg,
        bounds=(-90, 90),
        description="angle of the fast axis in state B from that in state A",
    )

    @staticmethod
    def _turned(matrix, coordinate, retardance, switching_angle):
        angle = np.asarray(coordinate * switching_angle)
        # states are (n_frames, 1) where there are several wavelengths
        shape = np.broadcast_shapes(angle.shape, np.shape(retardance))
        return _rotate(np.broadcast_to(matrix, (*shape, 4, 4)), np.broadcast_to(angle, shape))

    def _matrix(self, coordinate, retardance, switching_angle):
        return self._turned(_linear_retarder(retardance), coordinate, retardance, switching_angle)

    def _derivatives(self, coordinate, retardance, switching_angle):
        values = (coordinate, retardance, switching_angle)
        slope = self._turned(retardance_slope(retardance), *values)
        # the axis stands at s alpha: a turn of it, s times
        turning = rotation_generator(self._matrix(*values))
        return slope, np.asarray(coordinate)[..., None, None] * turning
