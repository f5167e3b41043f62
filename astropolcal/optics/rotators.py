# Licensed under a 3-clause BSD style license - see LICENSE
"""Turns of the reference frame, such as those by parallactic angle and altitude."""

from astropolcal.mueller.elements import _rotation_matrix
from astropolcal.optics.core import Optic

__all__ = ["Rotator"]


class Rotator(Optic):
    r"""
    Rotation of the reference frame for everything that follows.

    .. math:: T(\Theta) = \begin{pmatrix}1&0&0&0\\0&\cos2\Theta&\sin2\Theta&0\\
              0&-\sin2\Theta&\cos2\Theta&0\\0&0&0&1\end{pmatrix}

    with :math:`\Theta` = ``theta`` + position of the mount (paper, Sec. 4.1).
    The sky chain of CHARIS is ``Rotator(mount="parallactic") | m3 |
    Rotator(mount="-altitude")``.

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

    def _matrix(self, dispersion):
        # the turn by theta and mount is done in Optic, which knows `rotates_frame`
        return _rotation_matrix(0.0)

    def _derivatives(self, dispersion):
        return ()
