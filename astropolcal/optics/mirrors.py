# Licensed under a 3-clause BSD style license - see LICENSE
"""Changes of handedness by mirrors and beam switchers."""

import numpy as np

from astropolcal.optics.core import Optic

__all__ = ["ParityFlip"]


class ParityFlip(Optic):
    r"""
    Parity flip diag(1, -1, 1, -1): changes the sign of Q and V.

    What the ideal Nasmyth beam switcher does (paper, Sec. 5.2). Turned by
    45 deg it is diag(1, 1, -1, -1), the ideal mirror.

    Parameters
    ----------
    theta : `~astropy.units.Quantity`
        Orientation of the axes.

    Examples
    --------
    >>> from astropolcal.optics import ParityFlip
    >>> ParityFlip(name="nbs").mueller().diagonal()
    array([ 1., -1.,  1., -1.])
    """

    def _matrix(self, dispersion):
        return np.diag([1.0, -1.0, 1.0, -1.0])

    def _derivatives(self, dispersion):
        return ()
