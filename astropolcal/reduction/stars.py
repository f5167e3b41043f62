# Licensed under a 3-clause BSD style license - see LICENSE
"""
Stars in the beams of an image: found, fitted with Gaussians, and measured at each wavelength.

As in McIntosh et al. 2026 a two-dimensional Gaussian gives centre and width, the aperture is three
full widths in radius but at most 45 pixels, and the median of a ring of 5 pixels around it is the
background.
"""

from collections import namedtuple

import numpy as np
from astropy.nddata import Cutout2D
from astropy.stats import gaussian_fwhm_to_sigma, gaussian_sigma_to_fwhm, mad_std
from numpy.polynomial.legendre import legvander
from scipy import ndimage

from astropolcal.exceptions import ParameterError
from astropolcal.observations.grid import MAD_TO_SIGMA
from astropolcal.reduction.photometry import (
    Photometry,
    flux_variance,
    outliers,
    shared_pixels,
    sharpest,
)
from astropolcal.reduction.wings import wing_shares
from astropolcal.words import check_choice

__all__ = []

# a centre may be this far, in pixels or full widths, from those of its neighbours
_OFF_TRACK = (1.5, 0.5)
# a width may differ from the median by this factor
_WIDTHS = 2.5


def measure_stars(
    cube,
    good,
    detector,
    layout,
    *,
    radius="fwhm",
    factor=3.0,
    max_radius=45.0,
    annulus=5.0,
    aperture_correction=False,
    companion=0.1,
    max_masked=0.1,
):
    """Measure a star in the beams in all slices of a cube (W, Y, X).

    The star is found in the mean of the slices. In each slice a Gaussian gives centre and width in
    each beam; all are measured with the same radius, so that light outside of it does not look
    like polarization. Pixels without a value are filled with the Gaussian and what the pixels
    around them have beyond it. The options are described in `reduce_run`.
    """
    _check(radius, factor, max_radius, annulus, companion, max_masked, aperture_correction, layout)
    result = Photometry.empty(len(cube), len(layout.beams))
    good = np.isfinite(cube) if good is None else good
    result.flag(~good.any(axis=(1, 2)), "empty slice")
    mean, known = _mean(cube, good)
    # of two beams the right image is so far from the left one
    here = (0.0, 0.0)
    usual = (layout.star_offset, here) if layout.two_beams else (here,) * len(layout.beams)
    places = layout.star_offsets or usual
    pair = find_star(mean, known, places, fwhm=layout.fwhm, companion=companion)
    if pair.reason:
        result.flag(True, pair.reason)
        return result
    good = _without_single(result, cube, good, pair, detector, layout.fwhm, max_radius)
    images, there, origin = _cutouts(cube, good, pair)
    starts = np.repeat(pair.positions - origin, len(cube), axis=0)
    _check_light(result, images, there, starts, pair.fwhm, detector, layout.beams)
    fits = fit_gaussians(images, there, x=starts[:, 0], y=starts[:, 1], fwhm=pair.fwhm)
    _judge(result, fits, origin, pair)
    result.radius[:] = _radii(result.fwhm, radius, factor, max_radius, mean, known, pair)
    run = _Cube(cube, good, fits, origin, detector, layout.edge, annulus, max_masked)
    # what the noise of the background adds to the variance of a flux
    level_variance = np.zeros_like(result.flux)
    for k in np.flatnonzero(~result.failed):
        found = _measured(run, result, k)
        if isinstance(found, str):
            result.flag(np.arange(len(cube)) == k, found)
        else:
            result.flux[:, k], result.variance[:, k], result.background[:, k] = found[:3]
            level_variance[:, k] = found[3]
    usable = ~result.failed
    if layout.two_beams:
        # between both images of a slice
        distance = np.hypot(*(np.diff(a[:, usable], axis=0)[0] for a in (result.x, result.y)))
        pixel = detector.variance(result.background[:, usable].mean(axis=0))
        result.covariance[usable] = shared_pixels(distance, result.radius[0, usable], pixel)
    if aperture_correction:
        found = wing_shares(cube, good, result, level_variance, detector, layout, reach=max_radius)
        if found is None:
            result.flag(True, "no aperture correction")
        else:
            _correct(result, *found, usable)
    return result


def _check(radius, factor, max_radius, annulus, companion, max_masked, correction, layout):
    if isinstance(radius, str):
        if radius not in ("fwhm", "growth"):
            raise ParameterError(f"radius = {radius!r}; allowed are 'fwhm', 'growth' and pixels")
    elif not 1 <= radius < np.inf:
        raise ParameterError(f"radius = {radius:g}; it must be at least 1 pixel")
    for name, value in (("factor", factor), ("max_radius", max_radius), ("annulus", annulus)):
        if not 0 < value < np.inf:
            raise ParameterError(f"{name} = {value:g}; it must be above zero")
    for name, value in (("companion", companion), ("max_masked", max_masked)):
        if not 0 <= value < 1:
            raise ParameterError(f"{name} = {value:g}; allowed is 0 and above, below 1")
    check_choice("aperture_correction", correction, (False, True), ParameterError)
    if correction and not layout.two_beams:
        raise ParameterError(
            f"aperture_correction = True for the beams {', '.join(layout.beams)}; the profile of "
            "the wings is that of two beams"
        )


def _mean(cube, good):
    """Return the mean of the slices, and where at least one has a value."""
    number = good.sum(axis=0)
    total = np.where(good, cube, 0.0).sum(axis=0, dtype=float)
    # a pixel known in few slices would show their level, not that of the rest
    known = number > 0.5 * good.any(axis=(1, 2)).sum()
    return np.where(known, total / np.maximum(number, 1), 0.0), known


def _without_single(result, cube, good, pair, detector, smoothing, reach):
    """Return the known pixels but single ones about the star that are sharper than any star."""
    # squared, before the image was smoothed
    factor, good = sharpest(pair.fwhm**2 - (smoothing / 2) ** 2), good.copy()
    if np.isinf(factor):
        return good
    for beam, place in enumerate(pair.positions):
        box = tuple(slice(max(int(x - reach), 0), int(x + reach) + 2) for x in place[::-1])
        cut, known, own = cube[:, *box], good[:, *box], detector.of(beam)
        single = outliers(cut, known, np.ones(cut.shape[1:]), own, factor)
        # a full pixel may be one of the star
        single &= cut < own.saturation
        result.outliers += int(single.sum())
        known &= ~single
    return good


def _cutouts(cube, good, pair):
    """Return the surroundings of the star in all slices of both beams, and their corners."""
    size = np.array(cube.shape[:0:-1])
    # room for the wings of the core, not for other stars; odd sizes keep it in the middle
    half = int(np.clip(np.ceil(1.5 * pair.fwhm) + 3, 6, 30))
    half = min(half, int((size.min() - 1) // 2))
    corners = np.rint(pair.positions).astype(int) - half
    origin = np.clip(corners, 0, size - 2 * half - 1)
    boxes = [(slice(None), *(slice(c, c + 2 * half + 1) for c in xy[::-1])) for xy in origin]
    images, known = (np.concatenate([array[box] for box in boxes]) for array in (cube, good))
    return images, known, origin.astype(float)


def _check_light(result, images, there, starts, fwhm, detector, beams):
    """Flag slices that are saturated, or whose light at the star's place is not significant."""
    n = len(result.reasons)
    values = np.where(there, images, np.nan).reshape(len(beams) * n, -1)
    values[~there.any(axis=(1, 2))] = 0.0
    # before the fit: a saturated core has no centre
    full = [[detector.of(beam).saturation] for beam in range(len(beams))]
    bright = np.nanmax(values, axis=1).reshape(-1, n) >= full
    result.flag(bright.any(axis=0), "saturated")
    level = np.nanmedian(values, axis=1)[:, None]
    noise = MAD_TO_SIGMA * np.nanmedian(np.abs(values - level), axis=1)
    rows, columns = np.indices(images.shape[1:])
    distance = (columns.ravel() - starts[:, :1]) ** 2 + (rows.ravel() - starts[:, 1:]) ** 2
    shape = np.exp(-4.0 * np.log(2.0) * distance / fwhm**2) * there.reshape(len(beams) * n, -1)
    light = np.nansum((values - level) * shape, axis=1)
    scale = np.maximum(noise, detector.read_noise) * np.sqrt((shape**2).sum(axis=1))
    # standard deviations of the light under a Gaussian of the width of the star
    lost = ~(light > 5.0 * scale).reshape(-1, n)
    for own, name in zip(lost, beams, strict=True):
        result.flag(own & ~lost.all(axis=0), f"{name} beam missing")
    result.flag(lost.all(axis=0), "lost star")


def _judge(result, fits, origin, pair):
    """Store centres and widths, and flag slices where they cannot be right."""
    n = len(result.reasons)
    result.x[:] = fits.x.reshape(-1, n) + origin[:, :1]
    result.y[:] = fits.y.reshape(-1, n) + origin[:, 1:]
    result.fwhm[:] = fits.fwhm.reshape(-1, n)
    wild = ~fits.converged | (fits.elongation > 3.0) | (fits.amplitude <= 0)
    wild = wild.reshape(-1, n)
    # a blurred image is found less precisely
    limit = max(_OFF_TRACK[0], _OFF_TRACK[1] * pair.fwhm)
    usable = ~result.failed & ~wild.any(axis=0)
    for values in (result.x, result.y):
        for axis in values:
            wild |= np.abs(axis - _track(axis, usable)) > limit
    if usable.any():
        typical = np.median(result.fwhm[:, usable], axis=1)[:, None]
        wild |= (result.fwhm > _WIDTHS * typical) | (result.fwhm < typical / _WIDTHS)
    result.flag(wild.any(axis=0), "bad centroid")
    for values in (result.x, result.y, result.fwhm):
        values[:, result.failed] = 0.0


def _track(values, usable):
    """Return what the neighbours of each slice have: a running median over the usable ones."""
    if not usable.any():
        return values
    smooth = ndimage.median_filter(values[usable], size=min(7, usable.sum()), mode="nearest")
    return np.interp(np.arange(len(values)), np.flatnonzero(usable), smooth)


def _radii(fwhm, radius, factor, max_radius, mean, known, pair):
    """Return the radius of each slice, the same for both beams."""
    if radius == "fwhm":
        typical = _track(fwhm.mean(axis=0), (fwhm > 0).all(axis=0))
        return np.minimum(factor * typical, max_radius)
    if radius != "growth":
        return float(radius)
    return growth_radius(np.where(known, mean, np.median(mean[known])), pair.positions, max_radius)


def growth_radius(image, places, largest, fraction=0.99):
    """Return the radius in which the mean curve of growth reaches a part of that in the largest."""
    from photutils.profiles import CurveOfGrowth

    radii, curves = np.arange(1.0, largest + 0.5), []
    rows, columns = np.ogrid[: image.shape[0], : image.shape[1]]
    for x, y in places:
        distance = np.hypot(columns - x, rows - y)
        ring = (distance > radii[-1]) & (distance < radii[-1] + 10)
        level = np.median(image[ring]) if ring.any() else 0.0
        curve = np.asarray(CurveOfGrowth(image - level, (x, y), radii).profile, dtype=float)
        if not curve[-1] > 0:
            raise ParameterError(f"no light within {radii[-1]:g} pixels of ({x:g}, {y:g})")
        curves.append(curve / curve[-1])
    curve = np.maximum.accumulate(np.mean(curves, axis=0))
    first = int(np.argmax(curve >= fraction))
    around = slice(max(first - 1, 0), first + 1)
    return float(np.interp(fraction, curve[around], radii[around]))


# a cube, its fits, and what all its apertures have in common
_Cube = namedtuple("_Cube", "cube good fits origin detector edge annulus max_masked")


def _measured(cube, result, k):
    """Return what `_aperture` does of each beam in a slice, (4, n_beams), or why it cannot."""
    places = np.stack([result.x[:, k], result.y[:, k]], axis=1)
    found = [_aperture(cube, k, beam, places, result.radius[0, k]) for beam in range(len(places))]
    wrong = [one for one in found if isinstance(one, str)]
    return wrong[0] if wrong else np.transpose(found)


def _aperture(cube, k, beam, places, radius):
    """Return flux, its variance, background, and what the latter's noise adds to the variance.

    Or why the aperture cannot be used.
    """
    from photutils.aperture import CircularAperture

    place, detector, (rows, columns) = places[beam], cube.detector.of(beam), cube.cube.shape[1:]
    # pixel 0 begins at -0.5
    if min(*place, columns - 1 - place[0], rows - 1 - place[1]) - radius + 0.5 < cube.edge:
        return "edge"
    # with room for the ring
    cut = Cutout2D(cube.cube[k], place, 2 * int(np.ceil(radius + cube.annulus)) + 3)
    known = cube.good[k][cut.slices_original]
    image = np.where(known, cut.data, 0.0).astype(float)
    rows, columns = np.indices(image.shape)
    places = places - cut.origin_original
    distance = [np.hypot(columns - x, rows - y) for x, y in places]
    ring = known & (distance[beam] >= radius) & (distance[beam] <= radius + cube.annulus)
    # the other images of the star are no background
    for other in distance[:beam] + distance[beam + 1 :]:
        ring &= other > radius + cube.annulus
    if ring.sum() < 20:
        return "no background"
    weights = CircularAperture(places[beam], radius).to_mask(method="exact").to_image(image.shape)
    area, inside = weights.sum(), weights > 0
    if weights[~known].sum() > cube.max_masked * area:
        return "aperture masked"
    if image[inside & known].max() >= detector.saturation:
        return "saturated"
    level = float(np.median(image[ring]))
    spread = MAD_TO_SIGMA * np.median(np.abs(image[ring] - level))
    # what the ring shows, but never less than the detector's own noise
    pixel = max(spread**2, float(detector.variance(level)))
    filled = unsure = 0.0
    if not known[inside].all():
        # the Gaussian, and what nearby pixels have beyond it
        x, y = np.subtract(cut.origin_original, cube.origin[beam])
        model = cube.fits.image(beam * len(cube.cube) + k, columns + x, rows + y)
        beyond = np.where(known, image - model, 0.0)
        around, weight, squares = (
            ndimage.gaussian_filter(values, 1.0, mode="constant")
            for values in (beyond, known.astype(float), beyond**2)
        )
        around, squares = np.stack([around, squares]) / np.maximum(weight, 1e-3)
        image = np.where(known, image, model + around)
        filled = float((weights * (image - level))[~known].sum())
        # a pixel may be as far off what is around it as pixels there are from each other, less
        # what is noise
        noise = pixel + detector.photon_noise(np.maximum(image - level, 0.0))
        excess = np.sqrt(np.maximum(squares - around**2 - noise, 0.0))
        off = np.where(known, 0.0, weights * excess)
        # neighbours are off together, as far as the smoothing reaches: 2 pi is one over its peak
        unsure = 2 * np.pi * float((off * ndimage.gaussian_filter(off, 1.0, mode="constant")).sum())
    flux = float((weights * image).sum() - level * area)
    if flux <= 0:
        return "lost star"
    # few pixels of the core may have much of the light
    if filled > cube.max_masked * flux:
        return "aperture masked"
    photons = detector.photon_noise(float((weights**2 * np.maximum(image - level, 0.0)).sum()))
    alone = flux_variance(photons, area, pixel)
    of_level = flux_variance(photons, area, pixel, ring.sum()) - alone
    return flux, alone + of_level + unsure, level, of_level


def _correct(result, share, covariance, known):
    """Divide fluxes by the part of the light that they are."""
    # smooth over wavelength: the noise of the wings must not enter the fluxes
    smooth, error = _smooth(share, covariance, known)
    result.flag(smooth <= 0.0, "no aperture correction")
    result.scale[:] = 1 / np.where(smooth > 0, smooth, 1.0)
    result.scale_err[:] = error * result.scale**2
    result.flux *= result.scale
    relative = result.scale_err / result.scale
    result.variance[:] = result.variance * result.scale**2 + (relative * result.flux) ** 2
    both = relative**2 * result.flux.prod(axis=0)
    result.covariance[:] = result.covariance * result.scale**2 + both


def _smooth(values, covariance, known):
    """Return a polynomial over the slices through what is known, and its standard deviation."""
    degree = min(2, known.sum() - 1)
    terms = legvander(np.linspace(-1, 1, len(known)), degree)
    errors = np.sqrt(np.diag(covariance))
    weighted = terms[known] / errors[:, None]
    inverse = np.linalg.pinv(weighted) / errors
    residuals = (values - terms[known] @ (inverse @ values)) / errors
    freedom = known.sum() - terms.shape[1]
    # a curve that is no polynomial makes errors larger, chance does not make them smaller
    excess = max(1.0, (residuals**2).sum() / freedom) if freedom else 1.0
    spread = inverse @ covariance @ inverse.T * excess
    return terms @ inverse @ values, np.sqrt(np.einsum("ki,ij,kj->k", terms, spread, terms))


# ---- where a star is ---------------------------------------------------------------------------

# all pairs of peaks are compared; a star and its ghosts are among the brightest
_MAX_PEAKS = 25


# a star's images in all beams: (x, y) of each, (n_beams, 2), zeros if there is none; the diameter
# of the area above half of the maximum, pixels; why there is no unambiguous star, empty if there is
Found = namedtuple("Found", "positions fwhm reason")


def find_star(image, good, places, *, fwhm=4.0, companion=0.1):
    """Find the brightest star that is seen in all beams of an image (Y, X).

    ``places`` are (x, y) of its images from a common point, each met within some pixels: there the
    brightest peak is taken and not the nearest, as beams move on the detector and a companion may
    stand where the star was looked for. Hot pixels are to be left out of ``good``: one that
    outshines the star is taken for it. Peaks rise above the noise of the image smoothed with half
    of ``fwhm``. A second star brighter than the fraction ``companion`` makes it ambiguous.
    """
    from photutils.detection import find_peaks

    places = np.asarray(places, dtype=float)
    smooth, level, noise = _smoothed(image, good, fwhm)
    threshold = level + 6.0 * noise
    nothing = np.zeros(places.shape)
    # without a pixel above the threshold find_peaks would warn
    if not (noise > 0 and (smooth > threshold).any()):
        return Found(nothing, 0.0, "no star")
    # an odd box, about a full width: one peak a star
    table = find_peaks(smooth, threshold, box_size=2 * int(np.ceil(fwhm / 2)) + 1)
    # beside an edge it finds no peak below zero
    if table is None:
        return Found(nothing, 0.0, "no star")
    table.sort("peak_value", reverse=True)
    peaks = np.transpose([table["x_peak"], table["y_peak"]])[:_MAX_PEAKS]
    heights = np.asarray(table["peak_value"], dtype=float)[:_MAX_PEAKS] - level
    # (first image, place, peak)
    away = (peaks[:, None] + places - places[0])[:, :, None] - peaks
    # an image may be four pixels off its place
    near = np.hypot(away[..., 0], away[..., 1]) <= 4.0
    whole = np.flatnonzero(near.any(axis=2).all(axis=1))
    if not whole.size:
        return Found(nothing, 0.0, "one beam missing")
    # peaks are in the order of their heights: of those near a place the first is the brightest
    images = near[whole].argmax(axis=2)
    # the faintest image decides: a ghost beside a star makes a poor set
    strength = heights[images].min(axis=1)
    best = int(np.argmax(strength))
    positions, diameters = peaks[images[best]].astype(float), []
    for x, y in peaks[images[best]]:
        # only the area connected with the peak, not that of the other image
        labels, _ = ndimage.label(smooth - level > 0.5 * (smooth[y, x] - level))
        diameters.append(2.0 * np.sqrt((labels == labels[y, x]).sum() / np.pi))
    width, reason = float(np.mean(diameters)), ""
    # another star nearly as bright that is not part of the same image; in the first beam, as the
    # others have the same distances
    apart = np.hypot(*(peaks[whole] - peaks[whole[best]]).T) > 2.0 * max(width, fwhm)
    if np.any(apart & (strength > companion * strength[best])):
        reason = "two stars"
    elif heights[0] > 20 * strength[best] and 0 not in images[best]:
        reason = "one beam missing"
    return Found(positions, width, reason)


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
    rounding = 1e-12 * float(np.abs(values).max())
    if span <= rounding:
        return smooth, level, 0.0
    # an image without noise, as simulations have: any peak that can be seen counts
    noise = noise if noise > rounding else 1e-6 * span
    return np.where(np.isfinite(smooth), smooth, level), level, noise


# ---- Gaussians -----------------------------------------------------------------------------------
# The fit is the one of `~astropy.modeling.fitting.LMLSQFitter` of an elliptical Gaussian2D on a
# constant, with all images in one array: a frame has tens of them, and a fitter called for each
# would take most of the time of a reduction.

# at the start, least and most
_DAMPING = (1e-3, 1e-9, 1e9)


class GaussianFits(namedtuple("Fits", "amplitude x y background fwhm elongation converged shape")):
    """What `fit_gaussians` found, one value an image; pixels of the image.

    ``fwhm`` is the geometric mean of the full widths along the two axes, ``elongation`` the long
    axis over the short one; ``shape`` are the elements xx, xy, yy of the inverse covariance matrix,
    (K, 3).
    """

    __slots__ = ()

    def image(self, k, x, y):
        """Return Gaussian and constant of fit ``k`` at pixels ``x`` and ``y``."""
        xx, xy, yy = self.shape[k]
        dx, dy = x - self.x[k], y - self.y[k]
        exponent = 0.5 * (xx * dx**2 + yy * dy**2) + xy * dx * dy
        return self.amplitude[k] * np.exp(-exponent) + self.background[k]


# images of damaged pixels overflow; what does is no better, and its step is refused
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def fit_gaussians(images, good, *, x, y, fwhm):
    """
    Fit an elliptical Gaussian on a constant to each of many images, (K, rows, columns).

    Least squares by Levenberg and Marquardt, every image with its own damping, from x, y and fwhm,
    scalar or (K,). An image is done when a step hardly changes its sum of squares.
    """
    count, rows, columns = images.shape
    # 0 or 1: a pixel counts or does not
    weight = good.astype(float).reshape(count, -1)
    # NaN times a weight of zero would still be NaN
    data = np.where(good, images, 0.0).reshape(count, -1)
    grid = tuple(axis.ravel().astype(float) for axis in np.indices((rows, columns))[::-1])
    known = np.where(weight > 0, data, np.nan)
    known[~(weight > 0).any(axis=1)] = 0.0
    background = np.nanmedian(known, axis=1)
    # 1 / sigma^2, the same along both axes
    curvature = (gaussian_sigma_to_fwhm / fwhm) ** 2
    start = (np.nanmax(known, axis=1) - background, x, y, curvature, 0.0, curvature, background)
    p = np.stack(np.broadcast_arrays(*start), axis=1).astype(float)
    done = _minimize(p, data, weight, grid)
    amplitude, x, y, xx, xy, yy, background = p.T
    # sqrt(sigma_1 sigma_2) = det^(-1/4)
    fwhm = gaussian_sigma_to_fwhm * (xx * yy - xy**2) ** -0.25
    # eigenvalues of the inverse covariance are mean +- half
    mean, half = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    elongation = np.sqrt((mean + half) / np.maximum(mean - half, 1e-300))
    return GaussianFits(amplitude, x, y, background, fwhm, elongation, done, p[:, 3:6])


def _minimize(p, data, weight, grid):
    """Move the numbers of all images, (K, 7), to the least squares; return which got there."""
    model, jacobian = _model(p, grid)
    cost = (weight * (data - model) ** 2).sum(axis=1)
    damping = np.full(len(p), _DAMPING[0])
    done = np.zeros(len(p), dtype=bool)
    # images still moving; model and jacobian have rows for these only
    todo = np.arange(len(p))
    for _ in range(40):
        if not todo.size:
            break
        trial = p[todo] + _step(data[todo] - model, jacobian, weight[todo], damping[todo])
        trial_model, trial_jacobian = _model(trial, grid)
        trial_cost = (weight[todo] * (data[todo] - trial_model) ** 2).sum(axis=1)
        xx, xy, yy = trial[:, 3:6].T
        # a positive definite matrix: an ellipse, and no saddle
        sane = np.isfinite(trial).all(axis=1) & (xx > 0) & (yy > 0) & (xx * yy > xy**2)
        better = sane & (trial_cost <= cost[todo])
        # the last step hardly lowers the sum of squares
        small = better & (cost[todo] - trial_cost <= 1e-5 * cost[todo])
        p[todo[better]], cost[todo[better]] = trial[better], trial_cost[better]
        model[better], jacobian[better] = trial_model[better], trial_jacobian[better]
        # towards Gauss-Newton after a good step, towards steepest descent after a bad one
        damping[todo] = np.clip(damping[todo] * np.where(better, 0.1, 10.0), *_DAMPING[1:])
        done[todo[small]] = True
        # no step of any length helps: not done, and given up
        stuck = small | (damping[todo] >= _DAMPING[2])
        todo, model, jacobian = todo[~stuck], model[~stuck], jacobian[~stuck]
    return done


def _model(p, grid):
    """Return the models, (K, N), and their derivatives, (K, 7, N)."""
    amplitude, x, y, xx, xy, yy, background = (column[:, None] for column in p.T)
    dx, dy = grid[0] - x, grid[1] - y
    # an ill shape must not overflow; its step is refused
    exponent = np.clip(0.5 * (xx * dx**2 + yy * dy**2) + xy * dx * dy, -50.0, 700.0)
    jacobian = np.empty((len(p), 7, len(grid[0])))
    core = np.exp(-exponent, out=jacobian[:, 0])
    light = amplitude * core
    np.multiply(light, xx * dx + xy * dy, out=jacobian[:, 1])
    np.multiply(light, xy * dx + yy * dy, out=jacobian[:, 2])
    np.multiply(-0.5 * light, dx**2, out=jacobian[:, 3])
    np.multiply(-light, dx * dy, out=jacobian[:, 4])
    np.multiply(-0.5 * light, dy**2, out=jacobian[:, 5])
    jacobian[:, 6] = 1.0
    return light + background, jacobian


def _step(residual, jacobian, weight, damping):
    weighted = jacobian * weight[:, None, :]
    normal = weighted @ jacobian.transpose(0, 2, 1)
    gradient = weighted @ residual[:, :, None]
    # (K, 7)
    diagonal = np.einsum("kii->ki", normal)
    scale = np.sqrt(np.maximum(diagonal, 1e-300))
    # scaled to a unit diagonal, so that fluxes and pixels are solved for alike
    normal = normal / (scale[:, :, None] * scale[:, None, :])
    normal += (damping[:, None, None] + 1e-12) * np.eye(normal.shape[1])
    return np.linalg.solve(normal, gradient / scale[:, :, None])[:, :, 0] / scale
