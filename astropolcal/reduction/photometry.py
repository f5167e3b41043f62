# Licensed under a 3-clause BSD style license - see LICENSE
"""What photometry gives for one cube: both beams at all wavelengths, and why cells failed."""

import re
from dataclasses import dataclass, replace
from functools import lru_cache

import astropy.units as u
import numpy as np
from scipy import ndimage

from astropolcal.exceptions import InstrumentError, ObservationError, ParameterError
from astropolcal.observations.grid import MAD_TO_SIGMA
from astropolcal.words import check_choice

__all__ = []


@dataclass
class Photometry:
    """
    Fluxes of the beams in the slices of one cube.

    Arrays of shape (n_beams, W), in the order of the layout, unless noted.
    """

    # in the unit of the cube
    flux: np.ndarray
    variance: np.ndarray
    # of the two beams, (W,)
    covariance: np.ndarray
    # factor of the aperture correction, the same in both beams and smooth over wavelength, (W,)
    scale: np.ndarray
    scale_err: np.ndarray
    # of stars, pixels; zero for an internal source and where unknown
    x: np.ndarray
    y: np.ndarray
    fwhm: np.ndarray
    radius: np.ndarray
    # level that was subtracted from each pixel
    background: np.ndarray
    # why a slice cannot be used, empty where it can; length W
    reasons: list
    # pixels that were left out, as they are far off their neighbours
    outliers: int = 0

    @classmethod
    def empty(cls, n_wavelengths, n_beams=2):
        """Return zeros of shape (``n_beams``, ``n_wavelengths``) without a reason."""
        flux, variance, *others = (np.zeros((n_beams, n_wavelengths)) for _ in range(7))
        covariance, scale_err = np.zeros((2, n_wavelengths))
        scale = np.ones(n_wavelengths)
        return cls(flux, variance, covariance, scale, scale_err, *others, [""] * n_wavelengths)

    def flag(self, bad, reason):
        """Mark slices, (W,) or one for all, as unusable; the first reason stays."""
        bad = np.broadcast_to(bad, len(self.reasons))
        self.reasons = [
            own or (reason if flagged else "")
            for own, flagged in zip(self.reasons, bad.tolist(), strict=True)
        ]

    @property
    def failed(self):
        """Which slices cannot be used, shape (W,)."""
        return np.array([bool(reason) for reason in self.reasons])


# ---- errors of fluxes ----------------------------------------------------------------------------

# variance of a median over that of a mean, for normal noise and many pixels
_MEDIAN = np.pi / 2


@dataclass(frozen=True)
class Detector:
    """A detector in the unit of the data."""

    unit: u.UnitBase
    # electrons per unit of the data
    gain: float
    # of a pixel, in the unit of the data
    read_noise: float
    saturation: float
    # by what factor electron multiplication raises the photon noise
    excess_noise: float = 1.0
    # of how many exposures a pixel is the mean
    exposures: float = 1.0
    # that of the left beam, if it is another one
    left: "Detector | None" = None
    # a pixel has at most so many times the light of its neighbours, see `sharpest`
    factor: float = np.inf

    def variance(self, pixels):
        """Return the variance of pixels: photon noise of what is above zero, and read noise."""
        # below zero is noise of the read-out, not light
        return self.photon_noise(np.maximum(pixels, 0.0)) + self.read_noise**2

    def photon_noise(self, signal):
        """Return the variance that the photons of a signal have, in squared units of the data."""
        return self.excess_noise**2 * signal / self.gain

    def spoilt(self, pixels):
        """Return which pixels of images (N, Y, X) measure nothing: full, blank or single ones."""
        found = (pixels >= self.saturation) | piled_up(pixels) | self.blank(pixels)
        if self.factor < np.inf:
            known = np.isfinite(pixels) & ~found
            found |= outliers(pixels, known, np.ones(pixels.shape[1:]), self, self.factor)
        return found

    def blank(self, pixels):
        """Return which pixels lie among exact zeros, as of lost packets and dead regions."""
        zero = pixels == 0
        # without noise of the read-out zero is what no light gives
        if not (self.read_noise > 0 and zero.any()):
            return np.zeros_like(zero)
        # in whole numbers few may be chance, but not nine together, in a block or a line
        shapes = ((*[1] * (zero.ndim - 2), *shape) for shape in ((3, 3), (1, 9), (9, 1)))
        return np.any([ndimage.binary_opening(zero, np.ones(one)) for one in shapes], axis=0)

    def counts_in(self, unit):
        """Return whether another BUNIT is that of the data, or does not say."""
        return unit is None or pixel_unit(unit) == self.unit

    def of(self, beam):
        """Return the detector of the right (0) or left (1) beam."""
        return self.left if beam == 1 and self.left is not None else self

    def units_of(self, other):
        """Return how many units of another detector the electrons of one own unit are there."""
        # of a single exposure: one camera may have lost some of them
        return (self.gain / self.exposures) / (other.gain / other.exposures)

    def in_units_of(self, other):
        """Return the same detector where its electrons count as another one's do."""
        factor = self.units_of(other)
        return replace(
            self,
            unit=other.unit,
            gain=other.gain * self.exposures / other.exposures,
            read_noise=self.read_noise * factor,
            saturation=self.saturation * factor,
        )


def pixel_unit(unit):
    """Return the unit that BUNIT gives: adu if absent; counts and DN are adu."""
    # the longer name first: "count" would leave an s behind
    words = re.sub("counts|count|Counts|DN|ADU|dn", "adu", str(unit or "adu").strip())
    words = words.replace("e-", "electron").replace("electrons", "electron")
    try:
        own = u.Unit(words)
    except (ValueError, TypeError):
        own = u.dimensionless_unscaled
    if not any(own.is_equivalent(kind / per) for kind in (u.adu, u.electron) for per in (1, u.s)):
        raise ObservationError(f"BUNIT = {unit!r}; allowed are adu, electron, and these per second")
    return own


def detector_of(layout, unit=None, values=None):
    """
    Return the detector of a layout in the unit that BUNIT gives (adu if absent).

    The ``values`` of the header say how it was read out. A rate needs their exposure time.
    """
    values = values or {}
    exposure_time, own = values.get("exposure_time"), pixel_unit(unit)
    # of a rate the photon noise depends on how long it was collected
    rate = own.is_equivalent(u.adu / u.s) or own.is_equivalent(u.electron / u.s)
    if rate and exposure_time is None:
        raise ObservationError(f"BUNIT = {unit!r} is a rate, and the exposure time is unknown")
    counts = 1 * own * (exposure_time * u.s if rate else 1)
    how, exposures = layout.read_out(values), values.get("exposures", 1.0)
    # electrons are those of all exposures of which a pixel is the mean
    gain = how.gain * u.electron / u.adu if counts.unit.is_equivalent(u.adu) else exposures
    electrons = float((counts * gain).to_value(u.electron))
    # saturation and noise in electrons, which no unit of the file changes; a pixel that is full
    # may be rounded down, as files in other units have it in single precision
    full, noise = (1 - 5e-7) * how.saturation * how.gain / electrons, how.read_noise / electrons
    return Detector(own, electrons, noise, full, how.excess_noise, exposures)


# so many pixels are not equal by chance
_PILED = 5


def piled_up(cube):
    """
    Return which pixels of images (..., Y, X) share the largest value, as those that are cut off do.

    They are more than share any value below it: of few electrons, or without noise, many are equal.
    """
    with np.errstate(invalid="ignore"):
        top = np.fmax.reduce(cube, axis=(-2, -1), keepdims=True)
        found = cube == top
    number = found.sum(axis=(-2, -1))
    for place in zip(*np.nonzero(number >= _PILED), strict=True):
        image, n = cube[place], number[place]
        below = np.sort(image[image < top[place]])[-10 * n :]
        if below.size < n or 2 * np.unique(below, return_counts=True)[1].max() > n:
            found[place] = False
    found[number < _PILED] = False
    return found


def flux_variance(photons, area, background_variance, n_background=np.inf):
    """
    Return the variance of an aperture's flux after background subtraction.

    Photon noise of the source, area times the variance of a pixel, and the noise of the median of
    ``n_background`` pixels.
    """
    # the same error of the level in every pixel: it grows as the area
    return photons + (area + _MEDIAN * area**2 / n_background) * background_variance


def shared_background(area_right, area_left, background_variance, n_background):
    """Return the covariance of two beams from which the same median background was subtracted."""
    return _MEDIAN * area_right * area_left * background_variance / n_background


def shared_pixels(centre_distance, radius, background_variance):
    """
    Return the covariance of two beams whose circles of one radius overlap.

    The variance of a pixel times the area of the overlap.
    """
    # cosine of half the angle that the overlap spans; beyond 1 there is none
    half = np.clip(np.asarray(centre_distance) / (2.0 * np.asarray(radius)), 0.0, 1.0)
    # area common to two circles of one radius
    lens = 2.0 * np.square(radius) * (np.arccos(half) - half * np.sqrt(1.0 - half**2))
    return lens * background_variance


# ---- internal source -----------------------------------------------------------------------------
# Rectangles keep clear of the edges of the field stop: McIntosh et al. 2026; 't Hart et al. 2021,
# Proc. SPIE 11833.

# a background pixel is this far, in pixels, from both rectangles
_CLEAR = 12.0
# a pixel is far off its neighbours with twice their light, and so many standard deviations and
# electrons more: where electrons are rare and multiplied, single ones are far off what is around
_FACTOR, _SIGMAS, _ELECTRONS = 2.0, 10.0, 30.0


def turned(shape, centre, angle):
    """Return the distances of all pixels along the axes of a turned rectangle."""
    y, x = np.indices(shape)
    dx, dy = x - centre[0], y - centre[1]
    return dx * np.cos(angle) + dy * np.sin(angle), dy * np.cos(angle) - dx * np.sin(angle)


@lru_cache(maxsize=8)
def rectangles(apertures, shape):
    """
    Return the rectangles of the beams: rows, columns, part of each pixel inside.

    ``apertures`` are those of `FileLayout`.
    """
    from photutils.aperture import RectangularAperture

    *centres, width, height, angle = apertures
    found = []
    # of two beams the left one is given first
    for x, y in centres[::-1] if len(centres) == 2 else centres:
        # exact: weights are the parts of pixels inside, and their sum is the area
        mask = RectangularAperture((x, y), width, height, theta=angle).to_mask(method="exact")
        box = mask.bbox
        if min(box.iymin, box.ixmin) < 0 or box.iymax > shape[0] or box.ixmax > shape[1]:
            size = f"{shape[1]} x {shape[0]} pixels"
            raise InstrumentError(f"the rectangle at ({x:g}, {y:g}) leaves the image of {size}")
        found.append((slice(box.iymin, box.iymax), slice(box.ixmin, box.ixmax), mask.data))
    return tuple(found)


def measure_internal(cube, good, detector, layout, *, background="none", max_masked=0.2):
    """Measure the beams of an internal source in all slices of a cube (W, Y, X).

    Pixels without a value are left out, and the sum is scaled to that of the whole rectangle. So
    are single pixels far off their eight neighbours, such as hot ones and those hit by a cosmic
    ray. The options are described in `reduce_run`.
    """
    check_choice("background", background, ("none", "outside"), ParameterError)
    if not 0 <= max_masked < 1:
        raise ParameterError(f"max_masked = {max_masked:g}; allowed is 0 and above, below 1")
    good = np.isfinite(cube) if good is None else good
    result = Photometry.empty(len(cube), len(layout.beams))
    level, spread, number = np.zeros(len(cube)), np.full(len(cube), detector.read_noise**2), np.inf
    if background == "outside":
        level, spread, number = _level(cube, good, detector, layout)
        result.background[:] = level
    areas = []
    inside = rectangles(layout.internal_apertures, cube.shape[1:])
    for beam, (rows, columns, weights) in enumerate(inside):
        own, cut, known = detector.of(beam), cube[:, rows, columns], good[:, rows, columns]
        single = outliers(cut, known, weights, own)
        result.outliers += int(single.sum())
        used = known & ~single
        # one product for all slices: the weighted sum, and the area that has values
        total, kept = (
            pixels.reshape(len(cube), -1) @ weights.ravel()
            for pixels in (np.where(used, cut, 0.0), used)
        )
        area, net = weights.sum(), total - level * kept
        scale, error = _to_whole(cut, used, weights, level, np.stack([net, kept]), own)
        result.flux[beam] = net * scale
        photons = own.photon_noise(np.maximum(net, 0.0)) * scale**2
        pixel = np.maximum(spread, own.read_noise**2)
        result.variance[beam] = flux_variance(photons, area * scale, pixel, number)
        result.variance[beam] += (error * result.flux[beam]) ** 2
        result.flag(kept < (1 - max_masked) * area, f"{layout.beams[beam]} aperture masked")
        full = known & (weights > 0) & (cut >= own.saturation)
        result.flag(full.any(axis=(1, 2)), "saturated")
        areas.append(area)
    if background == "outside" and layout.two_beams:
        result.covariance[:] = shared_background(*areas, spread, number)
    result.flag((result.flux <= 0).any(axis=0), "no light")
    return result


# what is around a pixel without a value weighs as a Gaussian of so many pixels
_AROUND = 3.0


def _to_whole(cut, used, weights, level, sums, detector):
    """Return by what sums over the ``used`` pixels become those of a rectangle, and its error.

    Pixels without a value in one slice are as bright as in the others, and those without one in any
    as a surface of second order and what is around them have it. ``sums`` are of light and area.
    The error, relative and the same in all slices, is that of such pixels where values are known.
    """
    area, (net, kept) = weights.sum(), sums
    plain, inside = area / np.where(kept > 0, kept, 1.0), weights > 0
    mean = np.where(kept > 0, net * plain / area, 0.0).clip(0.0)
    if used[:, inside].all() or not mean.any():
        return plain, 0.0
    light = np.einsum("wyx,w->yx", used, mean)
    dark = np.einsum("wyx,w->yx", used, level)
    bright = np.sum(cut, axis=0, dtype=float, where=used) - dark
    seen = inside & (light > 0)
    pattern = np.divide(bright, light, out=np.zeros(seen.shape), where=seen)
    lost, error = inside & ~seen, 0.0
    if lost.any():
        pattern = _filled(pattern, seen)
        # the same holes elsewhere, where what they hide is known
        steps = [(y * h // 3, x * w // 3) for h, w in [lost.shape] for y, x in np.ndindex(3, 3)][1:]
        holes = [np.roll(light <= 0, step, (0, 1)) & seen for step in steps]
        sizes = [np.sum(weights * hole) / np.sum(weights * lost) for hole in holes]
        off = [
            np.sum(weights * (pattern - _filled(pattern, seen & ~hole))) / size
            for hole, size in zip(holes, sizes, strict=True)
            if size > 0.5
        ]
        # less the noise of the pixels that are known there
        noise = detector.variance(mean).sum() / mean.sum() ** 2 * np.sum(weights[lost] ** 2)
        hidden = (weights * lost).sum()
        error = np.sqrt(max(np.mean(np.square(off)) - noise, 0.0)) if off else hidden
    light_of = weights * pattern
    whole, part = light_of.sum(), used.reshape(len(used), -1) @ light_of.ravel()
    known = (part > 0) & (whole > 0)
    return np.where(known, whole / np.where(known, part, 1.0), plain), error / area


def _filled(pattern, seen):
    """Return an image with what a smooth surface and the pixels around say of those not seen."""
    y, x = np.indices(seen.shape) / np.max(seen.shape)
    terms = np.stack([np.ones(seen.shape), x, y, x * x, x * y, y * y], axis=-1)
    surface = terms @ np.linalg.lstsq(terms[seen], pattern[seen])[0]
    apart = np.where(seen, pattern - surface, 0.0)
    around, known = (ndimage.gaussian_filter(a, _AROUND) for a in (apart, seen.astype(float)))
    around = np.divide(around, known, out=np.zeros(seen.shape), where=known > 0)
    return np.where(seen, pattern, surface + around)


def evenly_lit(cube, good, layout):
    """
    Return whether the rectangles hold the light of a lamp rather than that of a star.

    The median pixel of the brighter beam has at least half of the light of the mean pixel.
    """
    beams = []
    for weights, total, number in _over_slices(cube, good, layout):
        whole = (weights >= 1.0) & (number > 0)
        pixels = total[whole] / number[whole]
        beams.append((pixels.mean(), np.median(pixels)) if pixels.size else (0.0, 0.0))
    # the brighter one: of light that is all in one polarization the other is dark
    mean, median = max(beams)
    # a rectangle whose median pixel has less than this part of the mean one holds a star
    return bool(median >= 0.5 * mean)


def _over_slices(cube, good, layout):
    """Yield the weights of the pixels of each rectangle, and sum and number of known values."""
    for rows, columns, weights in rectangles(layout.internal_apertures, cube.shape[1:]):
        known = good[:, rows, columns]
        # in the precision of the cube a damaged pixel would overflow
        total = np.sum(cube[:, rows, columns], axis=0, dtype=float, where=known)
        yield weights, total, known.sum(axis=0)


# a rectangle is looked at in so many parts along each of its sides
_PARTS = 4


def light_in_parts(cube, good, layout):
    """Return the light of a mean pixel in parts of the rectangles, (n_beams, parts), or NaN.

    All slices together.
    """
    found, (*_, width, height, angle) = [], layout.internal_apertures
    for weights, total, number in _over_slices(cube, good, layout):
        middle = (weights.shape[1] - 1) / 2, (weights.shape[0] - 1) / 2
        sides = zip(turned(weights.shape, middle, angle), (width, height), strict=True)
        along, across = (np.clip(_PARTS * (0.5 + x / side), 0, _PARTS - 1) for x, side in sides)
        part = (_PARTS * along.astype(int) + across.astype(int)).ravel()
        light, area, whole = (
            np.bincount(part, (weights * values).ravel(), _PARTS**2)
            for values in (total / np.maximum(number, 1), number > 0, np.ones(weights.shape))
        )
        found.append(np.where(area > 0.5 * whole, light / np.maximum(area, 0.5), np.nan))
    return np.array(found)


def sharpest(square):
    """Return how many times the light of its neighbours a pixel may have, by the squared width."""
    # below no star is as sharp as a pixel that was hit; else three times what the peak of a star
    # has over its neighbours at 1.2 pixels
    return np.inf if square < 6.25 else 3.0 * np.exp(4 * np.log(2) * 1.44 / square)


# damaged pixels may be beyond all numbers, and are then infinitely far off
@np.errstate(over="ignore", invalid="ignore")
def outliers(cut, known, weights, detector, factor=_FACTOR):
    """Return the single pixels far off their neighbours, with more than ``factor`` their light."""
    # one pixel in so many tells the level of a rectangle
    sample = np.flatnonzero(weights > 0)[::5]
    some, seen = (pixels.reshape(len(cut), -1)[:, sample] for pixels in (cut, known))
    level = _median(some, seen)
    spread = MAD_TO_SIGMA * _median(np.abs(some - level[:, None]), seen)

    def limits(level, spread):
        """Return between which values pixels are like those around them."""
        reach = _SIGMAS * np.sqrt(spread**2 + detector.variance(level))
        high = np.maximum(factor * level, level + reach + _ELECTRONS / detector.gain)
        # there may be less light, down to none
        return np.minimum(level, 0.0) - reach, high

    # first those far off the others of their slice: only of these the neighbours are looked at
    kind = np.result_type(cut, np.float32)
    low, high = (limit[:, None, None].astype(kind) for limit in limits(level, spread))
    found = ((cut > high) | (cut < low)) & (weights > 0) & known
    # of one axis they are found faster
    k, rows, columns = np.unravel_index(np.flatnonzero(found), found.shape)
    if k.size:
        padded = np.full((len(cut), *np.add(cut.shape[1:], 2)), np.nan)
        np.copyto(padded[:, 1:-1, 1:-1], cut, where=known)
        steps = [step for step in np.ndindex(3, 3) if step != (1, 1)]
        around = np.stack([padded[k, rows + y, columns + x] for y, x in steps])
        values = padded[k, rows + 1, columns + 1]
        # half of the neighbours are at most their median; in most of a star they are too bright
        dim = (factor * around <= values).sum(axis=0)
        maybe = (2 * dim >= (~np.isnan(around)).sum(axis=0)) | (values < 0)
        found[k, rows, columns] = False
        k, rows, columns, values = k[maybe], rows[maybe], columns[maybe], values[maybe]
        around = around[:, maybe].T
        low, high = limits(_median(around, ~np.isnan(around)), spread[k])
        # false where no neighbour has a value
        found[k, rows, columns] = (values > high) | (values < low)
    return found


def _median(pixels, known):
    """Return the median of each row, infinite without a value."""
    # nanmedian takes ten times as long; of no value the infinite ones are left
    number, row = known.sum(axis=1), np.arange(len(pixels))
    ordered = np.sort(np.where(known, pixels, np.inf), axis=1)
    return (ordered[row, (number - 1) // 2] + ordered[row, number // 2]) / 2.0


@lru_cache(maxsize=8)
def _outside(apertures, shape):
    """Return the pixels that are clear of all rectangles, the same in all frames of a run."""
    *centres, width, height, angle = apertures
    clear = np.ones(shape, dtype=bool)
    for centre in centres:
        along, across = turned(shape, centre, angle)
        # the wings of the beams reach farther than the rectangles
        clear &= (np.abs(along) > width / 2 + _CLEAR) | (np.abs(across) > height / 2 + _CLEAR)
    return clear


def outside_share(cube, good, layout, flux):
    """Return the light outside the beams, on their area, over their mean ``flux``."""
    clear = _outside(layout.internal_apertures, cube.shape[1:]) & good.all(axis=0)
    # all slices together; exact zeros are no lenslets
    image = np.sum(cube, axis=0, dtype=float)[clear] / len(cube)
    image = image[image != 0.0]
    *_, width, height, _ = layout.internal_apertures
    return float(np.median(image) * width * height / np.mean(flux)) if image.size else 0.0


def _level(cube, good, detector, layout):
    """Return the median outside the beams, the variance of a pixel, and their number."""
    clear = _outside(layout.internal_apertures, cube.shape[1:])
    pixels = np.array(cube[:, clear], dtype=float)
    # cubes hold exact zeros where the detector has no lenslets
    known = good[:, clear] & (pixels != 0.0)
    pixels[~known] = np.nan
    pixels[~known.any(axis=1)] = 0.0
    # a median, which stray light of the beams hardly moves
    level = np.nanmedian(pixels, axis=1)
    # never below the detector's own noise, as a slice of constants would have
    spread = (MAD_TO_SIGMA * np.nanmedian(np.abs(pixels - level[:, None]), axis=1)) ** 2
    return level, np.maximum(spread, detector.variance(level)), np.maximum(known.sum(axis=1), 1)
