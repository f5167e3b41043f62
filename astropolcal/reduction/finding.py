# Licensed under a 3-clause BSD style license - see LICENSE
"""Find a star in both beams of an image."""

from dataclasses import dataclass

import numpy as np
from astropy.stats import gaussian_fwhm_to_sigma, mad_std
from scipy import ndimage

__all__ = ["Pair", "find_pair"]

# all pairs of peaks are compared; a star and its ghosts are among the brightest
_MAX_PEAKS = 25
# relative error that a sum over a smoothing kernel may have
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Pair:
    """
    A star's images in both beams.

    Attributes
    ----------
    positions : `~numpy.ndarray`
        (x, y) of the right and the left image, shape (2, 2); zeros if there is none.
    fwhm : float
        Diameter of the area above half of the maximum, in pixels.
    reason : str
        Why there is no unambiguous star; empty if there is.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.reduction.finding import Pair
    >>> Pair(np.zeros((2, 2)), 0.0, "no star").reason
    'no star'
    """

    positions: np.ndarray
    fwhm: float
    reason: str = ""


def find_pair(image, good, offset, *, fwhm=4.0, significance=6.0, tolerance=4.0, companion=0.1):
    """
    Find the brightest star that is seen in both beams.

    Parameters
    ----------
    image : `~numpy.ndarray`
        Shape (Y, X).
    good : `~numpy.ndarray` of bool
        Pixels that have a value.
    offset : tuple of float
        (x, y) from the image in the left beam to that in the right one.
    fwhm : float
        Expected width in pixels; the image is smoothed with half of it.
    significance : float
        Lowest height of a peak, in standard deviations of the smoothed image.
    tolerance : float
        Largest deviation from the offset in pixels.
    companion : float
        A second pair brighter than this fraction of the first is another star.

    Returns
    -------
    Pair

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.reduction.finding import find_pair
    >>> rng, (y, x) = np.random.default_rng(1), np.indices((60, 80))
    >>> image = rng.normal(0, 1, x.shape)
    >>> for cx, cy in ((20, 20), (50, 35)):
    ...     image += 50 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 8)
    >>> find_pair(image, np.isfinite(image), (30, 15)).positions.tolist()
    [[50.0, 35.0], [20.0, 20.0]]
    """
    smooth, level, noise = _smoothed(image, good, fwhm)
    if not noise > 0:
        return Pair(np.zeros((2, 2)), 0.0, "no star")
    peaks, heights = _peaks(smooth, level + significance * noise, fwhm)
    heights = heights - level
    if not len(peaks):
        return Pair(np.zeros((2, 2)), 0.0, "no star")
    right, left = _matches(peaks, offset, tolerance)
    if not len(right):
        return Pair(np.zeros((2, 2)), 0.0, "one beam missing")
    # the fainter image of a pair decides: a ghost beside a star makes a poor pair
    strength = np.minimum(heights[right], heights[left])
    best = int(np.argmax(strength))
    positions = peaks[[right[best], left[best]]].astype(float)
    width = _width(smooth - level, positions)
    reason = ""
    if _ambiguous(peaks[right], strength, best, companion, 2.0 * max(width, fwhm)):
        reason = "two stars"
    elif heights.max() > 20 * strength[best] and heights.argmax() not in (right[best], left[best]):
        reason = "one beam missing"
    return Pair(positions, width, reason)


def _smoothed(image, good, fwhm):
    """Return the image smoothed over what is known, its level and its noise."""
    sigma = 0.5 * fwhm * gaussian_fwhm_to_sigma
    # smoothed as well, so that light over weight is the mean of what is known
    known = good.astype(float)
    weight = ndimage.gaussian_filter(known, sigma, mode="constant")
    light = ndimage.gaussian_filter(np.where(good, image, 0.0), sigma, mode="constant")
    # below that too little is known around a pixel
    smooth = np.where(weight > 0.3, light / np.maximum(weight, 0.3), np.nan)
    values = smooth[np.isfinite(smooth)]
    if not values.size:
        return smooth, 0.0, 0.0
    level = float(np.median(values))
    noise, span = float(mad_std(values)), float(np.ptp(values))
    # smoothing an even image leaves rounding errors, which must not pass for peaks
    rounding = _ROUNDING * float(np.abs(values).max())
    if span <= rounding:
        return smooth, level, 0.0
    # an image without noise, as simulations have: any peak that can be seen counts
    noise = noise if noise > rounding else 1e-6 * span
    return np.where(np.isfinite(smooth), smooth, level), level, noise


def _peaks(smooth, threshold, fwhm):
    """Return (x, y) and the heights of the peaks, the brightest first."""
    from photutils.detection import find_peaks

    # odd, about a full width: one peak a star
    size = 2 * int(np.ceil(fwhm / 2)) + 1
    if not (smooth > threshold).any():
        return np.empty((0, 2), dtype=int), np.empty(0)
    table = find_peaks(smooth, threshold, box_size=size)
    if table is None:
        return np.empty((0, 2), dtype=int), np.empty(0)
    xy = np.stack([np.asarray(table["x_peak"]), np.asarray(table["y_peak"])], axis=1)
    heights = np.asarray(table["peak_value"], dtype=float)
    order = np.argsort(heights)[::-1][:_MAX_PEAKS]
    return xy[order], heights[order]


def _matches(peaks, offset, tolerance):
    """Return the indices of all right and left images at the offset from each other."""
    # (right, left, xy)
    deviation = peaks[:, None, :] - peaks[None, :, :] - np.asarray(offset, dtype=float)
    return np.nonzero(np.hypot(deviation[..., 0], deviation[..., 1]) <= tolerance)


def _width(light, positions):
    """Return the diameter of the area above half maximum, the mean of both images."""
    diameters = []
    for x, y in positions.astype(int):
        # only the area connected with the peak, not that of the other image
        labels, _ = ndimage.label(light > 0.5 * light[y, x])
        diameters.append(2.0 * np.sqrt((labels == labels[y, x]).sum() / np.pi))
    return float(np.mean(diameters))


def _ambiguous(places, strength, best, companion, apart):
    """Return whether another pair is nearly as bright and not part of the same image."""
    # in the right beam; the left one has the same distances
    distance = np.hypot(*(places - places[best]).T)
    others = (distance > apart) & (strength > companion * strength[best])
    return bool(others.any())
