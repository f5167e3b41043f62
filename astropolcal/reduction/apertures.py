# Licensed under a 3-clause BSD style license - see LICENSE
"""
Photometry of the internal source: a rectangle on each Wollaston beam.

References
----------
McIntosh et al. 2026; 't Hart et al. 2021, Proc. SPIE 11833: rectangles that
keep clear of the edges of the field stop.
"""

from functools import lru_cache

import numpy as np

from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.observations.quality import MAD_TO_SIGMA
from astropolcal.reduction.errors import flux_variance, shared_background
from astropolcal.reduction.photometry import BEAMS, Photometry

__all__ = ["evenly_lit", "measure_internal", "rectangles"]

_BACKGROUNDS = ("none", "outside")
# a background pixel is this far, in pixels, from both rectangles
_CLEAR = 12.0
# a pixel is far off its neighbours with twice their light, and so many standard deviations and
# electrons more: where electrons are rare and multiplied, single ones are far off what is around
_FACTOR, _SIGMAS, _ELECTRONS = 2.0, 10.0, 30.0
# one pixel in so many tells the level of a rectangle
_SAMPLED = 5
# a rectangle whose median pixel has less than this part of the mean one holds a star
_EVEN = 0.5


@lru_cache(maxsize=8)
def rectangles(apertures, shape):
    """
    Return the weights of the pixels in the rectangles of both beams.

    Parameters
    ----------
    apertures : tuple
        ((x, y) of the left, (x, y) of the right, width, height, rotation in radian).
    shape : tuple of int
        Rows and columns of an image.

    Returns
    -------
    tuple
        For the right and the left beam: rows (slice), columns (slice), weights
        (`~numpy.ndarray`, the part of each pixel inside).

    Raises
    ------
    InstrumentError
        If a rectangle does not lie wholly inside the image.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.apertures import rectangles
    >>> layout = instruments.get("charis").files
    >>> [round(float(w.sum())) for _, _, w in rectangles(layout.internal_apertures, (201, 201))]
    [4999, 4999]
    """
    from photutils.aperture import RectangularAperture

    left, right, width, height, angle = apertures
    found = []
    for x, y in (right, left):
        # exact: weights are the parts of pixels inside, and their sum is the area
        mask = RectangularAperture((x, y), width, height, theta=angle).to_mask(method="exact")
        box = mask.bbox
        inside = box.iymin >= 0 and box.ixmin >= 0 and box.iymax <= shape[0]
        if not (inside and box.ixmax <= shape[1]):
            raise InstrumentError(
                f"the rectangle at ({x:g}, {y:g}) leaves the image of {shape[1]} x {shape[0]} "
                "pixels"
            )
        found.append((slice(box.iymin, box.iymax), slice(box.ixmin, box.ixmax), mask.data))
    return tuple(found)


@lru_cache(maxsize=8)
def _outside(apertures, shape):
    """Return the pixels that are clear of both rectangles."""
    left, right, width, height, angle = apertures
    # the wings of the beams reach farther than the rectangles
    grown = (left, right, width + 2 * _CLEAR, height + 2 * _CLEAR, angle)
    y, x = np.indices(shape)
    clear = np.ones(shape, dtype=bool)
    for cx, cy in grown[:2]:
        # into the axes of the rectangle
        along = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        across = (y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)
        clear &= (np.abs(along) > grown[2] / 2) | (np.abs(across) > grown[3] / 2)
    return clear


def measure_internal(cube, good, detector, layout, *, background="none", max_masked=0.2):
    """
    Measure both beams of an internal source in all slices of a cube.

    Pixels without a value are left out, and the sum is scaled to the full area. So are single
    pixels far off their eight neighbours, such as hot ones and those hit by a cosmic ray.

    Parameters
    ----------
    cube : `~numpy.ndarray`
        Shape (W, Y, X).
    good : `~numpy.ndarray` of bool or None
        Pixels that have a value; None if all have.
    detector : Detector
        In the unit of the cube.
    layout : FileLayout
        With ``internal_apertures``.
    background : {"none", "outside"}
        Nothing, or the median of the pixels clear of both beams, is subtracted.
        The light of the source fills the field stop, so use it only if the
        pixels outside show the same background as those inside.
    max_masked : float
        Largest part of an aperture that may lack values.

    Returns
    -------
    Photometry

    Raises
    ------
    ParameterError
        If an option is unknown or out of range.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.apertures import measure_internal
    >>> from astropolcal.reduction.errors import detector_of
    >>> layout = instruments.get("charis").files
    >>> result = measure_internal(np.ones(layout.shape), None, detector_of(layout), layout)
    >>> result.flux[0].round(1)[:2].tolist()
    [4998.6, 4998.6]
    """
    if background not in _BACKGROUNDS:
        raise ParameterError(f"background = {background!r}; allowed are {', '.join(_BACKGROUNDS)}")
    if not 0 <= max_masked < 1:
        raise ParameterError(f"max_masked = {max_masked:g}; allowed is 0 and above, below 1")
    result = Photometry.empty(len(cube))
    level, spread, number = np.zeros(len(cube)), np.full(len(cube), detector.read_noise**2), np.inf
    if background == "outside":
        level, spread, number = _level(cube, good, detector, layout)
        result.background[:] = level
    areas = []
    for beam, (rows, columns, weights) in enumerate(
        rectangles(layout.internal_apertures, cube.shape[1:])
    ):
        cut = cube[:, rows, columns]
        known = None if good is None else good[:, rows, columns]
        single = _outliers(cut, known, weights, detector.of(beam))
        result.outliers += int(single.sum())
        used = known if not single.any() else ~single if known is None else known & ~single
        total, area, kept = _weighted(cut, used, weights)
        scale = area / np.where(kept > 0, kept, 1.0)
        result.flux[beam] = total * scale - level * area
        own = detector.of(beam)
        photons = own.photon_noise(np.maximum(total - level * kept, 0.0)) * scale**2
        pixel = np.maximum(spread, own.read_noise**2)
        result.variance[beam] = flux_variance(photons, area * scale, pixel, number)
        result.flag(kept < (1 - max_masked) * area, f"{BEAMS[beam]} aperture masked")
        result.flag(_peak(cut, known, weights) >= own.saturation, "saturated")
        areas.append(area)
    if background == "outside":
        result.covariance[:] = shared_background(*areas, spread, number)
    result.flag((result.flux <= 0).any(axis=0), "no light")
    return result


def evenly_lit(cube, good, layout):
    """
    Return whether the rectangles hold the light of a lamp rather than that of a star.

    Parameters
    ----------
    cube : `~numpy.ndarray`
        Shape (W, Y, X).
    good : `~numpy.ndarray` of bool or None
        Pixels that have a value; None if all have.
    layout : FileLayout
        With ``internal_apertures``.

    Returns
    -------
    bool
        Whether the median pixel of the brighter beam, in the mean of the slices, has
        at least half of the light of the mean pixel.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.apertures import evenly_lit
    >>> layout = instruments.get("charis").files
    >>> cube = np.zeros(layout.shape)
    >>> cube[:, 85:90, 70:75] = cube[:, 117:122, 132:137] = 1.0
    >>> evenly_lit(cube, None, layout), evenly_lit(cube + 1.0, None, layout)
    (False, True)
    """
    beams = []
    for rows, columns, weights in rectangles(layout.internal_apertures, cube.shape[1:]):
        inside = (slice(None), rows, columns)
        values, whole = cube[inside], weights >= 1.0
        if good is not None:
            known = good[inside]
            values = np.where(known, values, 0.0)
            whole = whole & known.any(axis=0)
            pixels = values.sum(axis=0, dtype=float)[whole] / known.sum(axis=0)[whole]
        else:
            # in the precision of the cube a damaged pixel would overflow
            pixels = values.mean(axis=0, dtype=float)[whole]
        beams.append((pixels.mean(), np.median(pixels)) if pixels.size else (0.0, 0.0))
    # the brighter one: of light that is all in one polarization the other is dark
    mean, median = max(beams)
    return bool(median >= _EVEN * mean)


def _weighted(cut, known, weights):
    """Return the weighted sum of each slice, the area, and the area that has values."""
    # (W, pixels) @ (pixels,): one product for all slices
    flat, w = cut.reshape(len(cut), -1), weights.ravel()
    area = w.sum()
    if known is None:
        return flat @ w, area, np.full(len(cut), area)
    known = known.reshape(len(cut), -1)
    return np.where(known, flat, 0.0) @ w, area, known @ w


# damaged pixels may be beyond all numbers, and are then infinitely far off
@np.errstate(over="ignore", invalid="ignore")
def _outliers(cut, known, weights, detector):
    """Return the single pixels that are far off their neighbours."""
    sample = (slice(None), *(index[::_SAMPLED] for index in np.nonzero(weights)))
    level, spread = _robust(cut[sample], None if known is None else known[sample])
    # first those far off the others of their slice: only of these the neighbours are looked at
    low, high = (limit[:, None, None] for limit in _limits(level, spread, detector))
    kind = np.result_type(cut, np.float32)
    found = ((cut > high.astype(kind)) | (cut < low.astype(kind))) & (weights > 0)
    if known is not None:
        found &= known
    k, rows, columns = places = np.nonzero(found)
    if k.size:
        values = np.asarray(cut if known is None else np.where(known, cut, np.nan), dtype=float)
        padded = np.pad(values, ((0, 0), (1, 1), (1, 1)), constant_values=np.nan)
        steps = [step for step in np.ndindex(3, 3) if step != (1, 1)]
        around = np.stack([padded[k, rows + y, columns + x] for y, x in steps], axis=1)
        low, high = _limits(_median(around, ~np.isnan(around)), spread[k], detector)
        # false where no neighbour has a value
        found[places] = (values[places] > high) | (values[places] < low)
    return found


def _limits(level, spread, detector):
    """Return between which values pixels are like those around them."""
    reach = _SIGMAS * np.sqrt(spread**2 + detector.variance(level))
    high = np.maximum(_FACTOR * level, level + reach + _ELECTRONS / detector.gain)
    # there may be less light, down to none
    return np.minimum(level, 0.0) - reach, high


def _robust(pixels, known):
    """Return the median of each row and its robust standard deviation, infinite without a value."""
    level = _median(pixels, known)
    return level, MAD_TO_SIGMA * _median(np.abs(pixels - level[:, None]), known)


def _median(pixels, known):
    # nanmedian takes ten times as long; of no value the infinite ones are left
    number = np.full(len(pixels), pixels.shape[1]) if known is None else known.sum(axis=1)
    ordered = np.sort(pixels if known is None else np.where(known, pixels, np.inf), axis=1)
    row = np.arange(len(pixels))
    return (ordered[row, (number - 1) // 2] + ordered[row, number // 2]) / 2.0


def _peak(cut, known, weights):
    # -inf never is the brightest
    values = cut if known is None else np.where(known, cut, -np.inf)
    return values[:, weights > 0].max(axis=1)


def _level(cube, good, detector, layout):
    """Return the median outside the beams, the variance of a pixel, and their number."""
    clear = _outside(layout.internal_apertures, cube.shape[1:])
    pixels = np.array(cube[:, clear], dtype=float)
    # cubes hold exact zeros where the detector has no lenslets
    unknown = pixels == 0.0
    if good is not None:
        unknown |= ~good[:, clear]
    pixels[unknown] = np.nan
    number = (~unknown).sum(axis=1)
    pixels[number == 0] = 0.0
    # a median, which stray light of the beams hardly moves
    level = np.nanmedian(pixels, axis=1)
    # never below the detector's own noise, as a slice of constants would have
    spread = (MAD_TO_SIGMA * np.nanmedian(np.abs(pixels - level[:, None]), axis=1)) ** 2
    return level, np.maximum(spread, detector.variance(level)), np.maximum(number, 1)
