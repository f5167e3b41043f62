# Licensed under a 3-clause BSD style license - see LICENSE
"""Find a star in both beams of an image."""

from dataclasses import dataclass

import numpy as np
from astropy.stats import gaussian_fwhm_to_sigma, gaussian_sigma_to_fwhm, mad_std
from scipy import ndimage

from astropolcal.exceptions import ParameterError

__all__ = []

# all pairs of peaks are compared; a star and its ghosts are among the brightest
_MAX_PEAKS = 25
# relative error that a sum over a smoothing kernel may have
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Pair:
    """A star's images in both beams."""

    # (x, y) of the right and the left image, or of all, (n_beams, 2); zeros if there is none
    positions: np.ndarray
    # diameter of the area above half of the maximum, pixels
    fwhm: float
    # why there is no unambiguous star; empty if there is
    reason: str = ""


def find_pair(image, good, offset, *, fwhm=4.0, significance=6.0, tolerance=4.0, companion=0.1):
    """
    Find the brightest star that is seen in both beams of an image (Y, X).

    ``offset`` is (x, y) from the left image to the right one, met within ``tolerance`` pixels;
    peaks rise ``significance`` standard deviations above the image smoothed with half of ``fwhm``.
    A second pair brighter than the fraction ``companion`` is another star.
    """
    smooth, level, noise = _smoothed(image, good, fwhm)
    peaks, heights = _peaks(smooth, level + significance * noise, fwhm)
    if not (noise > 0 and len(peaks)):
        return Pair(np.zeros((2, 2)), 0.0, "no star")
    heights = heights - level
    # of all right and left images at the offset from each other; (right, left, xy)
    deviation = peaks[:, None, :] - peaks[None, :, :] - np.asarray(offset, dtype=float)
    right, left = np.nonzero(np.hypot(deviation[..., 0], deviation[..., 1]) <= tolerance)
    if not len(right):
        return Pair(np.zeros((2, 2)), 0.0, "one beam missing")
    # the fainter image of a pair decides: a ghost beside a star makes a poor pair
    strength = np.minimum(heights[right], heights[left])
    best = int(np.argmax(strength))
    positions = peaks[[right[best], left[best]]].astype(float)
    width = _width(smooth - level, positions)
    reason = ""
    # another pair nearly as bright that is not part of the same image; in the right beam, as
    # the left one has the same distances
    apart = np.hypot(*(peaks[right] - peaks[right[best]]).T) > 2.0 * max(width, fwhm)
    if np.any(apart & (strength > companion * strength[best])):
        reason = "two stars"
    elif heights.max() > 20 * strength[best] and heights.argmax() not in (right[best], left[best]):
        reason = "one beam missing"
    return Pair(positions, width, reason)


def find_images(image, good, places, *, fwhm=4.0, significance=6.0, tolerance=4.0, companion=0.1):
    """
    Find the brightest star that is seen at all of some places from each other, 1 or more.

    As `find_pair`; ``places`` are (x, y) of the images from a common point.
    """
    places = np.asarray(places, dtype=float)
    smooth, level, noise = _smoothed(image, good, fwhm)
    peaks, heights = _peaks(smooth, level + significance * noise, fwhm)
    nothing = np.zeros((len(places), 2))
    if not (noise > 0 and len(peaks)):
        return Pair(nothing, 0.0, "no star")
    # (first image, place, peak)
    wanted = peaks[:, None] + places - places[0]
    distance = np.hypot(*np.moveaxis(wanted[:, :, None] - peaks, -1, 0))
    nearest = distance.argmin(axis=-1)
    whole = np.flatnonzero((distance.min(axis=-1) <= tolerance).all(axis=1))
    if not whole.size:
        return Pair(nothing, 0.0, "one beam missing")
    strength = (heights - level)[nearest[whole]].min(axis=1)
    best = int(np.argmax(strength))
    positions = peaks[nearest[whole[best]]].astype(float)
    width = _width(smooth - level, positions)
    apart = np.hypot(*(peaks[whole] - peaks[whole[best]]).T) > 2.0 * max(width, fwhm)
    two = np.any(apart & (strength > companion * strength[best]))
    return Pair(positions, width, "two stars" if two else "")


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
    # without a pixel above the threshold it would warn
    table = find_peaks(smooth, threshold, box_size=size) if (smooth > threshold).any() else None
    if table is None:
        return np.empty((0, 2), dtype=int), np.empty(0)
    table.sort("peak_value", reverse=True)
    table = table[:_MAX_PEAKS]
    heights = np.asarray(table["peak_value"], dtype=float)
    return np.stack([np.asarray(table["x_peak"]), np.asarray(table["y_peak"])], axis=1), heights


def _width(light, positions):
    """Return the diameter of the area above half maximum, the mean of both images."""
    diameters = []
    for x, y in positions.astype(int):
        # only the area connected with the peak, not that of the other image
        labels, _ = ndimage.label(light > 0.5 * light[y, x])
        diameters.append(2.0 * np.sqrt((labels == labels[y, x]).sum() / np.pi))
    return float(np.mean(diameters))


# ---- Gaussians -----------------------------------------------------------------------------------
# The fit is the one of `~astropy.modeling.fitting.LMLSQFitter` of an elliptical Gaussian2D on a
# constant, with all images in one array: a frame has tens of them, and a fitter called for each
# would take most of the time of a reduction.

# at the start, least and most
_DAMPING = (1e-3, 1e-9, 1e9)


@dataclass(frozen=True)
class GaussianFits:
    """What `fit_gaussians` found, one value an image; pixels of the image."""

    amplitude: np.ndarray
    x: np.ndarray
    y: np.ndarray
    background: np.ndarray
    # geometric mean of the full widths along the two axes, and long axis over short one
    fwhm: np.ndarray
    elongation: np.ndarray
    # root mean square of the residuals
    noise: np.ndarray
    converged: np.ndarray
    # elements xx, xy, yy of the inverse covariance matrix, (K, 3)
    shape: np.ndarray

    def image(self, k, x, y):
        """Return Gaussian and constant of fit ``k`` at pixels ``x`` and ``y``."""
        xx, xy, yy = self.shape[k]
        dx, dy = x - self.x[k], y - self.y[k]
        exponent = 0.5 * (xx * dx**2 + yy * dy**2) + xy * dx * dy
        return self.amplitude[k] * np.exp(-exponent) + self.background[k]


def fit_gaussians(images, good=None, *, x, y, fwhm, max_iterations=40, tolerance=1e-5):
    """
    Fit an elliptical Gaussian on a constant to each of many images, (K, rows, columns).

    Least squares by Levenberg and Marquardt, every image with its own damping, from x, y and fwhm,
    scalar or (K,). An image is done when a step changes its sum of squares by less than
    ``tolerance`` of it.
    """
    images = np.asarray(images, dtype=float)
    if images.ndim != 3 or (good is not None and np.shape(good) != images.shape):
        raise ParameterError(
            f"images of shape {images.shape}, good of shape {np.shape(good)}; both must be "
            "(K, rows, columns)"
        )
    count, rows, columns = images.shape
    # 0 or 1: a pixel counts or does not
    weight = np.ones_like(images) if good is None else np.asarray(good, dtype=float)
    # NaN times a weight of zero would still be NaN
    data = np.where(weight > 0, images, 0.0).reshape(count, -1)
    weight = weight.reshape(count, -1)
    grid = tuple(axis.ravel().astype(float) for axis in np.indices((rows, columns))[::-1])
    p = _start(data, weight, *np.broadcast_arrays(x, y, fwhm, np.zeros(count))[:3])
    p, cost, done = _minimize(p, data, weight, grid, max_iterations, tolerance)
    # seven numbers are fitted
    freedom = np.maximum(weight.sum(axis=1) - p.shape[1], 1.0)
    return _result(p, np.sqrt(cost / freedom), done)


def _start(data, weight, x, y, fwhm):
    """Return amplitude, x, y, xx, xy, yy, background to start from."""
    known = np.where(weight > 0, data, np.nan)
    known[~(weight > 0).any(axis=1)] = 0.0
    background = np.nanmedian(known, axis=1)
    amplitude = np.nanmax(known, axis=1) - background
    # 1 / sigma^2, the same along both axes
    curvature = (gaussian_sigma_to_fwhm / fwhm) ** 2
    return np.stack([amplitude, x, y, curvature, 0 * x, curvature, background], axis=1)


def _minimize(p, data, weight, grid, max_iterations, tolerance):
    model, jacobian = _model(p, grid)
    cost = _cost(data, model, weight)
    damping = np.full(len(p), _DAMPING[0])
    done = np.zeros(len(p), dtype=bool)
    # images still moving; model and jacobian have rows for these only
    todo = np.arange(len(p))
    for _ in range(max_iterations):
        if not todo.size:
            break
        # what overflows is no better, and its step is refused
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            trial = p[todo] + _step(data[todo] - model, jacobian, weight[todo], damping[todo])
            trial_model, trial_jacobian = _model(trial, grid)
            trial_cost = _cost(data[todo], trial_model, weight[todo])
        trial_cost = np.where(_sane(trial), trial_cost, np.inf)
        better = trial_cost <= cost[todo]
        small = better & (cost[todo] - trial_cost <= tolerance * cost[todo])
        p[todo[better]], cost[todo[better]] = trial[better], trial_cost[better]
        model[better], jacobian[better] = trial_model[better], trial_jacobian[better]
        # towards Gauss-Newton after a good step, towards steepest descent after a bad one
        damping[todo] = np.clip(damping[todo] * np.where(better, 0.1, 10.0), *_DAMPING[1:])
        done[todo[small]] = True
        # no step of any length helps: not done, and given up
        stuck = small | (damping[todo] >= _DAMPING[2])
        todo, model, jacobian = todo[~stuck], model[~stuck], jacobian[~stuck]
    return p, cost, done


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


def _cost(data, model, weight):
    return np.einsum("kn,kn,kn->k", weight, data - model, data - model)


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


def _sane(p):
    xx, xy, yy = p[:, 3], p[:, 4], p[:, 5]
    # a positive definite matrix: an ellipse, and no saddle
    return np.isfinite(p).all(axis=1) & (xx > 0) & (yy > 0) & (xx * yy > xy**2)


def _result(p, noise, done):
    amplitude, x, y, xx, xy, yy, background = p.T
    # sqrt(sigma_1 sigma_2) = det^(-1/4)
    fwhm = gaussian_sigma_to_fwhm * (xx * yy - xy**2) ** -0.25
    # eigenvalues of the inverse covariance are mean +- half
    mean, half = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    elongation = np.sqrt((mean + half) / np.maximum(mean - half, 1e-300))
    shape = np.stack([xx, xy, yy], axis=1)
    return GaussianFits(amplitude, x, y, background, fwhm, elongation, noise, done, shape)
