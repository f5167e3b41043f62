# Licensed under a 3-clause BSD style license - see LICENSE
"""
Two-dimensional Gaussians fitted to many small images at once.

The fit is the one that `~astropy.modeling.fitting.LMLSQFitter` makes of an
elliptical `~astropy.modeling.functional_models.Gaussian2D` on a constant, with
all images in one array: a frame has tens of them, and a fitter called for each
would take most of the time of a reduction.
"""

from dataclasses import dataclass

import numpy as np
from astropy.stats import gaussian_sigma_to_fwhm

from astropolcal.exceptions import ParameterError

__all__ = ["GaussianFits", "fit_gaussians"]

# at the start, least and most
_DAMPING = (1e-3, 1e-9, 1e9)


@dataclass(frozen=True)
class GaussianFits:
    """
    What `fit_gaussians` found, one value an image.

    Attributes
    ----------
    amplitude, x, y, background : `~numpy.ndarray`
        Of the Gaussian, and the constant; positions in pixels of the image.
    fwhm : `~numpy.ndarray`
        Geometric mean of the full widths along the two axes.
    elongation : `~numpy.ndarray`
        Long axis over short one.
    noise : `~numpy.ndarray`
        Root mean square of the residuals.
    converged : `~numpy.ndarray` of bool
        Whether the fit came to an end.
    shape : `~numpy.ndarray`
        Elements xx, xy, yy of the inverse covariance matrix, (K, 3).

    Examples
    --------
    >>> from astropolcal.reduction.gaussians import GaussianFits
    >>> "fwhm" in GaussianFits.__dataclass_fields__
    True
    """

    amplitude: np.ndarray
    x: np.ndarray
    y: np.ndarray
    background: np.ndarray
    fwhm: np.ndarray
    elongation: np.ndarray
    noise: np.ndarray
    converged: np.ndarray
    shape: np.ndarray

    def image(self, k, x, y):
        """Return Gaussian and constant of fit ``k`` at pixels ``x`` and ``y``."""
        xx, xy, yy = self.shape[k]
        dx, dy = x - self.x[k], y - self.y[k]
        exponent = 0.5 * (xx * dx**2 + yy * dy**2) + xy * dx * dy
        return self.amplitude[k] * np.exp(-exponent) + self.background[k]


def fit_gaussians(images, good=None, *, x, y, fwhm, max_iterations=40, tolerance=1e-5):
    """
    Fit an elliptical Gaussian on a constant to each of many images.

    Least squares by Levenberg and Marquardt, every image with its own damping.

    Parameters
    ----------
    images : `~numpy.ndarray`
        Shape (K, rows, columns).
    good : `~numpy.ndarray` of bool, optional
        Pixels that count, of the same shape.
    x, y, fwhm : array_like
        Where to start, scalar or shape (K,).
    max_iterations : int
        Limit.
    tolerance : float
        An image is done when a step changes its sum of squares by less than this
        fraction.

    Returns
    -------
    GaussianFits

    Raises
    ------
    ParameterError
        If the shapes do not agree.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.reduction.gaussians import fit_gaussians
    >>> row, column = np.indices((21, 21))
    >>> image = 100 * np.exp(-((column - 9.3) ** 2 + (row - 10.6) ** 2) / (2 * 2.0**2)) + 5
    >>> fits = fit_gaussians(image[None], x=10, y=10, fwhm=4)
    >>> [round(float(v[0]), 3) for v in (fits.x, fits.y, fits.fwhm, fits.background)]
    [9.3, 10.6, 4.71, 5.0]
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
    empty = ~(weight > 0).any(axis=1)
    known[empty] = 0.0
    background = np.nanmedian(known, axis=1)
    amplitude = np.nanmax(known, axis=1) - background
    # 1 / sigma^2, the same along both axes
    curvature = (gaussian_sigma_to_fwhm / fwhm) ** 2
    zero = np.zeros_like(background)
    return np.stack([amplitude, x, y, curvature, zero, curvature, background], axis=1)


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
    determinant = xx * yy - xy**2
    # eigenvalues of the inverse covariance are mean +- half
    mean, half = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    return GaussianFits(
        amplitude=amplitude,
        x=x,
        y=y,
        background=background,
        # sqrt(sigma_1 sigma_2) = det^(-1/4)
        fwhm=gaussian_sigma_to_fwhm * determinant**-0.25,
        elongation=np.sqrt((mean + half) / np.maximum(mean - half, 1e-300)),
        noise=noise,
        converged=done,
        shape=np.stack([xx, xy, yy], axis=1),
    )
