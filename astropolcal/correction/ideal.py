# Licensed under a 3-clause BSD style license - see LICENSE
"""
The instrument as it would be without retardance errors and losses of polarization.

With it, a correction can be restricted to the instrumental polarization, as was done before
there were models of the crosstalk.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join, leaves
from astropolcal.optics import COORDINATES

__all__ = ["ideal_chain"]

_IDENTITY, _HALF_WAVE = np.eye(4), np.diag([1.0, 1.0, -1.0, -1.0])
# a half-wave plate at 45 deg: Q and V change sign
_FLIP = np.diag([1.0, -1.0, 1.0, -1.0])


def ideal_chain(chain, wavelength):
    """
    Return a chain of perfect optics at the places and angles of those of a chain.

    What turns with a stage is a half-wave plate (a derotator of an odd number of mirrors
    included), a splitter is perfect, and whatever stands still is what it comes closest to: a
    mirror, a flip of the image, or nothing. Rotations stay.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        From the sky to the detector.
    wavelength : `~astropy.units.Quantity`
        Where fixed optics are looked at.

    Returns
    -------
    `~astropy.modeling.CompoundModel`

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.correction import ideal_chain
    >>> charis = instruments.get("charis")
    >>> ideal = ideal_chain(charis.on_sky(charis.published()), charis.wavelength)
    >>> float(ideal["wollaston"].efficiency.value), ideal["hwp"].retardance.quantity
    (1.0, <Quantity 180. deg>)
    """
    found = (_ideal(leaf, np.atleast_1d(wavelength)) for leaf in leaves(chain))
    return join(leaf for leaf in found if leaf is not None)


def _ideal(leaf, wavelength):
    name, theta = leaf.name, leaf.theta.quantity
    if leaf.rotates_frame:
        return leaf
    if leaf.splits_light:
        return optics.WollastonPrism(name=name, mount=leaf.mount, theta=theta)
    # drifts, stray light and gains of the beams are faults
    if leaf.stage in COORDINATES or leaf.depends_on_beam:
        return None
    if leaf.stage:
        return _half_wave(name, leaf.mount, theta)
    # the mean over wavelengths: which of the three is nearest must not change along a spectrum
    matrix = np.mean(np.atleast_3d(_normalized(leaf, wavelength)), axis=0)
    nearest = min((_IDENTITY, _HALF_WAVE, _FLIP), key=lambda m: np.abs(m - matrix).max())
    if nearest is _IDENTITY:
        return None
    return _half_wave(name, None, theta + (0 if nearest is _HALF_WAVE else 45) * u.deg)


def _normalized(leaf, wavelength):
    """Return the matrices of an optic in its own axes, without its losses."""
    matrix = leaf._matrix(leaf._dispersion(wavelength.to_value(u.um)), *leaf.canonical_values()[1:])
    matrix = np.reshape(matrix, (-1, 4, 4))
    return matrix / matrix[:, :1, :1]


def _half_wave(name, mount, theta):
    return optics.LinearRetarder(retardance=180 * u.deg, name=name, mount=mount, theta=theta)
