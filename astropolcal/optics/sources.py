# Licensed under a 3-clause BSD style license - see LICENSE
"""Sources of known or unknown polarization, such as standard stars."""

import numpy as np
from astropy.modeling import Parameter

from astropolcal.optics._matrices import blank
from astropolcal.optics.core import Optic

__all__ = ["PolarizedSource"]


class PolarizedSource(Optic):
    r"""
    Source of linearly polarized light, in the place of whatever light arrives.

    .. math:: M = \begin{pmatrix}1&0&0&0\\q&0&0&0\\u&0&0&0\\0&0&0&0\end{pmatrix}

    Light of any polarization leaves with the same intensity and the
    normalized Stokes parameters q and u: an ideal depolarizer, then a source of that
    polarization. It stands first in the chain of a star. Its frame is that
    of what follows; before ``Rotator(mount="parallactic")`` q and u are those of the
    sky, with angles from north through east.

    Parameters
    ----------
    q, u : float or array_like
        Normalized Stokes parameters, between -0.7 and 0.7 so that every pair is a
        possible one; scalars, or one value a wavelength.
    theta : `~astropy.units.Quantity`
        Orientation of the axes of q and u.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.optics import PolarizedSource
    >>> star = PolarizedSource(q=0.01, u=-0.02, name="star")
    >>> [float(x) for x in star(1.6 * u.um, 5, 0, 0, 0)[1:]]
    [5.0, 0.05, -0.1, 0.0]
    """

    # 0.7 sqrt(2) < 1, see the docstring
    q = Parameter(default=0.0, bounds=(-0.7, 0.7), description="Q over I of the source")
    u = Parameter(default=0.0, bounds=(-0.7, 0.7), description="U over I of the source")

    def _matrix(self, dispersion, q, u):
        out = blank(q, u)
        out[..., 0, 0] = 1.0
        # only the first column: whatever polarization arrives is forgotten
        out[..., 1, 0] = q
        out[..., 2, 0] = u
        return out

    def _derivatives(self, dispersion, q, u):
        return tuple(_unit_element(row, q, u) for row in (1, 2))


def _unit_element(row, q, u):
    out = blank(q, u)
    out[..., row, 0] = 1.0
    return np.asarray(out)
