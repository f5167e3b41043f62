# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics that lose polarization without changing the intensity."""

from astropy.modeling import Parameter

from astropolcal.optics._matrices import blank
from astropolcal.optics.core import Optic

__all__ = ["Depolarizer"]


class Depolarizer(Optic):
    r"""
    Diagonal depolarizer diag(1, a, b, c) with axes turned to ``theta``.

    Parameters
    ----------
    retained_q, retained_u, retained_v : float or array_like
        Share of Q, U and V (in the optic's frame) that survives, between 0
        and 1; scalars, or one value a wavelength. Physical as long as the
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

    def _matrix(self, dispersion, *retained):
        out = blank(*retained)
        out[..., 0, 0] = 1.0
        # the first element is the intensity, which is kept
        for i, value in enumerate(retained, start=1):
            out[..., i, i] = value
        return out

    def _derivatives(self, dispersion, *retained):
        slopes = []
        for i in range(1, 4):
            out = blank(*retained)
            out[..., i, i] = 1.0
            slopes.append(out)
        return tuple(slopes)
