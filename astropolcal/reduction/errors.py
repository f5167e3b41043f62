# Licensed under a 3-clause BSD style license - see LICENSE
"""
Errors of aperture fluxes: photons, read noise, background, and what they share.
"""

from dataclasses import dataclass, replace

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ObservationError

__all__ = ["Detector", "detector_of", "flux_variance", "shared_background", "shared_pixels"]

# variance of a median over that of a mean, for normal noise and many pixels
_MEDIAN = np.pi / 2


@dataclass(frozen=True)
class Detector:
    """
    A detector in the unit of the data.

    Attributes
    ----------
    unit : `~astropy.units.UnitBase`
        Of the pixels.
    gain : float
        Electrons per unit of the data.
    read_noise : float
        Standard deviation of a pixel in the unit of the data.
    saturation : float
        In the unit of the data.
    excess_noise : float
        By what factor electron multiplication raises the photon noise.
    left : Detector or None
        That of the left beam, if it is another one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.reduction.errors import Detector
    >>> float(Detector(u.adu, 2.0, 5.0, 4e4).variance(100.0))
    75.0
    """

    unit: u.UnitBase
    gain: float
    read_noise: float
    saturation: float
    excess_noise: float = 1.0
    left: "Detector | None" = None

    def variance(self, pixels):
        """Return the variance of pixels: photon noise of what is above zero, and read noise."""
        # below zero is noise of the read-out, not light
        return self.photon_noise(np.maximum(pixels, 0.0)) + self.read_noise**2

    def photon_noise(self, signal):
        """Return the variance that the photons of a signal have, in squared units of the data."""
        return self.excess_noise**2 * signal / self.gain

    def of(self, beam):
        """Return the detector of the right (0) or left (1) beam."""
        return self.left if beam == 1 and self.left is not None else self

    def in_units_of(self, other):
        """Return the same detector where its electrons count as another one's do."""
        # one own unit is so many of the other
        factor = self.gain / other.gain
        return replace(
            self,
            unit=other.unit,
            gain=other.gain,
            read_noise=self.read_noise * factor,
            saturation=self.saturation * factor,
        )


def detector_of(layout, unit=None, exposure_time=None, values=None):
    """
    Return the detector of a layout in the unit that a header gives.

    Parameters
    ----------
    layout : FileLayout
        With gain (electrons per adu), read noise (electrons) and saturation (adu).
    unit : str, optional
        ``BUNIT``; adu where it is absent.
    exposure_time : float, optional
        Seconds, needed for a rate.
    values : dict, optional
        Of the header, by which the layout knows how the detector was read out.

    Returns
    -------
    Detector

    Raises
    ------
    ObservationError
        If the unit is neither adu nor electrons, nor a rate of them; the exposure time of a rate
        is unknown; or the read-out is.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.errors import detector_of
    >>> detector_of(instruments.get("charis").files, "electron").gain
    1.0
    """
    own = _unit(unit)
    # of a rate the photon noise depends on how long it was collected
    rate = own.is_equivalent(u.adu / u.s) or own.is_equivalent(u.electron / u.s)
    if rate and exposure_time is None:
        raise ObservationError(f"BUNIT = {unit!r} is a rate, and the exposure time is unknown")
    counts = 1 * own * (exposure_time * u.s if rate else 1)
    how = layout.read_out(values or {})
    if counts.unit.is_equivalent(u.adu):
        electrons = float(how.gain * counts.to_value(u.adu))
    else:
        electrons = float(counts.to_value(u.electron))
    # both in electrons, which no unit of the file changes
    full = how.saturation * how.gain
    noise = how.read_noise / electrons
    return Detector(own, electrons, noise, full / electrons, how.excess_noise)


def _unit(text):
    """Return the unit that BUNIT names; counts and DN are adu."""
    words = str(text or "adu").strip()
    # the longer name first: "count" would leave an s behind
    for name in ("counts", "count", "Counts", "DN", "ADU", "dn"):
        words = words.replace(name, "adu")
    words = words.replace("e-", "electron").replace("electrons", "electron")
    try:
        unit = u.Unit(words)
    except (ValueError, TypeError):
        unit = u.dimensionless_unscaled
    if not any(unit.is_equivalent(kind / per) for kind in (u.adu, u.electron) for per in (1, u.s)):
        raise ObservationError(f"BUNIT = {text!r}; allowed are adu, electron, and these per second")
    return unit


def flux_variance(photons, area, background_variance, n_background=np.inf):
    """
    Return the variance of an aperture's flux after background subtraction.

    Parameters
    ----------
    photons : array_like
        Photon noise of the source: its flux over the gain, in squared units of the data.
    area : array_like
        Sum of the aperture's squared weights for what pixels contribute by
        themselves, or the area, where the pixels have weight one.
    background_variance : array_like
        Variance of a pixel without source: read noise, and photon noise of the background.
    n_background : array_like
        Number of pixels whose median was subtracted; infinite for none.

    Returns
    -------
    `~numpy.ndarray`

    Examples
    --------
    >>> from astropolcal.reduction.errors import flux_variance
    >>> float(flux_variance(500.0, 100.0, 4.0))
    900.0
    """
    # the same error of the level in every pixel: it grows as the area
    median = _MEDIAN * np.square(area) / np.asarray(n_background, dtype=float)
    return np.asarray(photons) + (area + median) * np.asarray(background_variance)


def shared_background(area_right, area_left, background_variance, n_background):
    """
    Return the covariance of two beams from which the same background was subtracted.

    Parameters
    ----------
    area_right, area_left : array_like
        Areas of the apertures in pixels.
    background_variance : array_like
        Variance of a pixel without source.
    n_background : array_like
        Number of pixels whose median it was.

    Returns
    -------
    `~numpy.ndarray`

    Examples
    --------
    >>> from astropolcal.reduction.errors import shared_background
    >>> round(float(shared_background(100.0, 100.0, 4.0, 10000)), 3)
    6.283
    """
    return _MEDIAN * np.multiply(area_right, area_left) * background_variance / n_background


def shared_pixels(centre_distance, radius, background_variance):
    """
    Return the covariance of two beams whose circular apertures overlap.

    Parameters
    ----------
    centre_distance, radius : array_like
        Distance of the centres, and the radius of both, in pixels.
    background_variance : array_like
        Variance of a pixel in the overlap, where both stars are faint.

    Returns
    -------
    `~numpy.ndarray`
        The variance of a pixel times the area of the overlap, zero without one.

    Examples
    --------
    >>> from astropolcal.reduction.errors import shared_pixels
    >>> float(shared_pixels(71.6, 30.0, 4.0))
    0.0
    """
    # cosine of half the angle that the overlap spans; beyond 1 there is none
    half = np.clip(np.asarray(centre_distance) / (2.0 * np.asarray(radius)), 0.0, 1.0)
    # area common to two circles of one radius
    lens = 2.0 * np.square(radius) * (np.arccos(half) - half * np.sqrt(1.0 - half**2))
    return lens * background_variance
