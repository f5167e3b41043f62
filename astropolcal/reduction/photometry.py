# Licensed under a 3-clause BSD style license - see LICENSE
"""What photometry gives for one cube: both beams at all wavelengths, and why cells failed."""

from dataclasses import dataclass

import numpy as np

__all__ = ["BEAMS", "Photometry"]

BEAMS = ("right", "left")
"""Order of the beams in all arrays."""


@dataclass
class Photometry:
    """
    Fluxes of both beams in the slices of one cube.

    All arrays have shape (2, W), the right beam first, but for the covariance,
    the scale and the reasons.

    Attributes
    ----------
    flux, variance : `~numpy.ndarray`
        In the unit of the cube.
    covariance : `~numpy.ndarray`
        Of the two beams, shape (W,).
    scale, scale_err : `~numpy.ndarray`
        Factor of the aperture correction and its standard deviation, the same in both
        beams, shape (W,); it is smooth over wavelength, so its error is too.
    x, y, fwhm, radius : `~numpy.ndarray`
        Of stars, pixels; zero for an internal source and where unknown.
    background : `~numpy.ndarray`
        Level that was subtracted from each pixel.
    reasons : list of str
        Why a slice cannot be used, empty where it can; length W.
    outliers : int
        Pixels that were left out of the apertures of an internal source, as they are far off
        their neighbours.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.reduction.photometry import Photometry
    >>> result = Photometry.empty(2)
    >>> result.flag(np.array([True, False]), "saturated")
    >>> result.reasons
    ['saturated', '']
    """

    flux: np.ndarray
    variance: np.ndarray
    covariance: np.ndarray
    scale: np.ndarray
    scale_err: np.ndarray
    x: np.ndarray
    y: np.ndarray
    fwhm: np.ndarray
    radius: np.ndarray
    background: np.ndarray
    reasons: list
    outliers: int = 0

    @classmethod
    def empty(cls, n_wavelengths):
        """Return zeros of shape (2, ``n_wavelengths``) without a reason."""
        flux, variance, *others = (np.zeros((2, n_wavelengths)) for _ in range(7))
        covariance, scale_err = np.zeros((2, n_wavelengths))
        scale = np.ones(n_wavelengths)
        return cls(flux, variance, covariance, scale, scale_err, *others, [""] * n_wavelengths)

    def flag(self, bad, reason):
        """
        Mark slices as unusable; the first reason stays.

        Parameters
        ----------
        bad : array_like of bool
            Shape (W,), or one for all.
        reason : str
            Why.
        """
        bad = np.broadcast_to(bad, len(self.reasons))
        self.reasons = [
            own or (reason if flagged else "")
            for own, flagged in zip(self.reasons, bad.tolist(), strict=True)
        ]

    @property
    def failed(self):
        """Which slices cannot be used, shape (W,)."""
        return np.array([bool(reason) for reason in self.reasons])
