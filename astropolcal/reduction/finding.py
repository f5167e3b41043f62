# Licensed under a 3-clause BSD style license - see LICENSE
"""Find a star in all beams of an image, and fit Gaussians to its images."""

from collections import namedtuple

import numpy as np
from astropy.stats import gaussian_fwhm_to_sigma, gaussian_sigma_to_fwhm, mad_std
from scipy import ndimage

__all__ = []

# all pairs of peaks are compared; a star and its ghosts are among the brightest
_MAX_PEAKS = 25
# standard deviations by which a peak rises, and pixels that an image may be off its place
_SIGNIFICANCE, _TOLERANCE = 6.0, 4.0
# relative error that a sum over a smoothing kernel may have
_ROUNDING = 1e-12


# a star's images in all beams: (x, y) of each, (n_beams, 2), zeros if there is none; the diameter
# of the area above half of the maximum, pixels; why there is no unambiguous star, empty if there is
Found = namedtuple("Found", "positions fwhm reason")


def find_star(image, good, places, *, fwhm=4.0, companion=0.1):
    """
    Find the brightest star that is seen in all beams of an image (Y, X).

    ``places`` are (x, y) of its images from a common point, each met within some pixels: there the
    brightest peak is taken and not the nearest, as beams move on the detector and a companion may
    stand where the star was looked for. Hot pixels are to be left out of ``good``: one that
    outshines the star is taken for it. Peaks rise above the noise of the image smoothed with half
    of ``fwhm``. A second star brighter than the fraction ``companion`` makes it ambiguous.
    """
    from photutils.detection import find_peaks

    places = np.asarray(places, dtype=float)
    smooth, level, noise = _smoothed(image, good, fwhm)
    threshold = level + _SIGNIFICANCE * noise
    nothing = np.zeros(places.shape)
    # without a pixel above the threshold find_peaks would warn
    if not (noise > 0 and (smooth > threshold).any()):
        return Found(nothing, 0.0, "no star")
    # an odd box, about a full width: one peak a star
    table = find_peaks(smooth, threshold, box_size=2 * int(np.ceil(fwhm / 2)) + 1)
    if table is None:
        return Found(nothing, 0.0, "no star")
    table.sort("peak_value", reverse=True)
    peaks = np.transpose([table["x_peak"], table["y_peak"]])[:_MAX_PEAKS]
    heights = np.asarray(table["peak_value"], dtype=float)[:_MAX_PEAKS] - level
    # (first image, place, peak)
    away = (peaks[:, None] + places - places[0])[:, :, None] - peaks
    near = np.hypot(away[..., 0], away[..., 1]) <= _TOLERANCE
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
    rounding = _ROUNDING * float(np.abs(values).max())
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
# steps, and the part of the sum of squares by which the last one lowers it
_MOST_STEPS, _SMALL = 40, 1e-5


class GaussianFits(
    namedtuple("GaussianFits", "amplitude x y background fwhm elongation converged shape")
):
    """
    What `fit_gaussians` found, one value an image; pixels of the image.

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
    for _ in range(_MOST_STEPS):
        if not todo.size:
            break
        trial = p[todo] + _step(data[todo] - model, jacobian, weight[todo], damping[todo])
        trial_model, trial_jacobian = _model(trial, grid)
        trial_cost = (weight[todo] * (data[todo] - trial_model) ** 2).sum(axis=1)
        xx, xy, yy = trial[:, 3:6].T
        # a positive definite matrix: an ellipse, and no saddle
        sane = np.isfinite(trial).all(axis=1) & (xx > 0) & (yy > 0) & (xx * yy > xy**2)
        better = sane & (trial_cost <= cost[todo])
        small = better & (cost[todo] - trial_cost <= _SMALL * cost[todo])
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
