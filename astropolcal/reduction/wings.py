# Licensed under a 3-clause BSD style license - see LICENSE
"""
The light of a star outside of its apertures, from the profile of its image.

What an aperture measures lacks the wings beyond it, and the wings in the ring
are taken for background. A field stop cuts them before they reach the
detector. So the light outside cannot be summed; a profile is fitted to the
part that is seen, and integrated.

References
----------
Moffat 1969, A&A 3, 455: the profile. Its exponent is 11/6 in the wings of a
seeing-limited image (Racine 1996, PASP 108, 699).
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.optimize import least_squares

from astropolcal.reduction._rings import Rings, Star

__all__ = ["HALO_BETA", "Shares", "wing_shares"]

#: Exponent of the halo: that of a seeing-limited image, whose wings fall as r^-11/3.
HALO_BETA = 11 / 6
# full width of the halo: that of the seeing, milliarcsecond, and its relative uncertainty
_SEEING, _SEEING_SPREAD = 500.0, 0.35
# full width at half maximum over alpha
_HALO_WIDTH = 2 * np.sqrt(2 ** (1 / HALO_BETA) - 1)
# rings up to this multiple of the given radius
_TO = 1.5
# part of an aperture that may lie outside of the lit field
_UNLIT = 0.2
# ln of core width over Gaussian width, 1 / exponent, ln of halo radius, slope of the first
_START = np.array([np.log(0.6), 0.3, 0.0, 0.0])
_LOW, _HIGH = np.array([-2.0, 1e-3, -1.2, -0.5]), np.array([1.0, 0.7, 1.2, 0.5])
_SCALE = np.array([0.05, 0.05, 0.2, 0.05])
# in each of the four numbers, which are of order one: central differences good to 1e-8
_STEP = 1e-4


@dataclass(frozen=True)
class Shares:
    """
    Part of a star's light that its apertures have, at each wavelength.

    Attributes
    ----------
    values : `~numpy.ndarray`
        Measured flux of both beams over all of the light, shape (K,).
    covariance : `~numpy.ndarray`
        Of the values, shape (K, K).
    chi_square : float
        Of the profile, over its degrees of freedom.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.reduction.wings import Shares
    >>> Shares(np.array([0.98]), np.array([[1e-6]]), 1.0).values.tolist()
    [0.98]
    """

    values: np.ndarray
    covariance: np.ndarray
    chi_square: float


def wing_shares(cube, good, photometry, level_variance, detector, layout, *, reach=45.0):
    r"""
    Return which part of a star's light the apertures of both beams have.

    Parameters
    ----------
    cube : `~numpy.ndarray`
        Shape (W, Y, X).
    good : `~numpy.ndarray` of bool
        Pixels that have a value.
    photometry : Photometry
        Of the apertures, without a correction.
    level_variance : `~numpy.ndarray`
        What the noise of the background level adds to the variance of a flux,
        shape (2, W).
    detector : Detector
        In the unit of the cube.
    layout : FileLayout
        The rectangles of ``internal_apertures`` lie inside the field stop. Without
        them there is no stop, and each beam has light of the other's image.
    reach : float
        Rings up to 1.5 times this radius are used.

    Returns
    -------
    Shares or None
        Of the slices that have not failed; None if too little of the wings is seen.

    Notes
    -----
    The surface brightness at the distance r from the star is

    .. math::

        B + F \left[A \frac{\beta - 1}{\pi\alpha^2}(1 + r^2/\alpha^2)^{-\beta}
        + H \frac{5/6}{\pi\alpha_h^2}(1 + r^2/\alpha_h^2)^{-11/6}\right]

    with the flux F in the aperture. One exponent :math:`\beta` and one radius
    :math:`\alpha_h` hold for all slices, :math:`\ln\alpha`, A and H are linear in the number
    of the slice, B is free in each. The Gaussian is the limit of large exponents. The halo
    is taken to be as wide as the seeing, 0.5 arcsec within 35 %, unless the rings say
    otherwise.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction import measure_stars
    >>> from astropolcal.reduction.errors import detector_of
    >>> from astropolcal.reduction.wings import wing_shares
    >>> layout = instruments.get("charis").files
    >>> y, x = np.indices(layout.shape[1:])
    >>> image = sum(1e4 * (1 + ((x - cx) ** 2 + (y - cy) ** 2) / 16) ** -2.5
    ...             for cx, cy in ((70, 85), (133.5, 118.1)))
    >>> cube, detector = np.repeat(image[None], 2, axis=0), detector_of(layout)
    >>> plain = measure_stars(cube, None, detector, layout)
    >>> found = wing_shares(cube, cube > 0, plain, np.zeros((2, 2)), detector, layout)
    >>> bool(abs(found.values[0] / (plain.flux[0, 0] / (1e4 * 16 * np.pi / 1.5)) - 1) < 1e-3)
    True
    """
    if photometry.failed.all():
        return None
    star = Star.of(cube, good, photometry, level_variance, layout)
    if star.unlit_part > _UNLIT or (rings := Rings.of(star, reach * _TO)) is None:
        return None
    seeing = min(_SEEING / layout.pixel_scale, reach)
    return _fit(star, rings, detector, seeing / _HALO_WIDTH)


# --- profile ---------------------------------------------------------------------


def _core(r, radius, t):
    """Return a Moffat profile of unit sum, t = 1 / beta, alpha^2 = beta radius^2."""
    return np.exp(-np.log1p(t * (r / radius) ** 2) / t) * (1 - t) / (np.pi * radius**2)


def _core_beyond(r, radius, t):
    return np.exp(np.log1p(t * (r / radius) ** 2) * (1 - 1 / t))


def _halo(r, radius):
    scale = (HALO_BETA - 1) / (np.pi * radius**2)
    return scale * (1 + (r / radius) ** 2) ** -HALO_BETA


def _halo_beyond(r, radius):
    return (1 + (r / radius) ** 2) ** (1 - HALO_BETA)


class _Profile:
    """The profile of a star as a function of the four numbers that it is not linear in."""

    def __init__(self, star, rings, halo_radius):
        self.star, self.rings, self.halo_radius = star, rings, halo_radius
        self.terms = legvander(star.x, min(1, len(star.x) - 1))
        self.area = np.pi * star.radius**2

    def in_rings(self, p):
        """Return the light in the rings, of both beams, that one unit of each number gives."""
        radius, halo_radius = self._radii(p)
        core, halo = 0.0, 0.0
        for flux, r in self._seen():
            core = core + flux[:, None] * _core(r, radius[:, None], p[1]).mean(axis=0)
            halo = halo + flux[:, None] * _halo(r, halo_radius).mean(axis=0)
        return self._columns(core, halo)

    def lacking(self, p):
        """Return the light that the sums of the lit pixels in the apertures lack."""
        star = self.star
        radius, halo_radius = self._radii(p)
        total = star.flux.sum(axis=0)
        core = total * _core_beyond(star.radius, radius, p[1])
        halo = total * _halo_beyond(star.radius, halo_radius)
        if not star.stopped:
            apart = np.hypot(*(star.places[0] - star.places[1]))
            # the light of the other image in the aperture, nearly constant over it
            core = core - total * self.area * _core(apart, radius, p[1])
            halo = halo - total * self.area * _halo(apart, halo_radius)
        for beam, k, r, weights, _ in self.star.unlit:
            core[k] += star.flux[beam, k] * weights @ _core(r, radius[k], p[1])
            halo[k] += star.flux[beam, k] * weights @ _halo(r, halo_radius)
        return self._columns(core, halo)

    def background_in_apertures(self, background):
        """Return what the true background has in the lit pixels of both apertures together."""
        pixels = self.area.copy()
        for _, k, _, weights, _ in self.star.unlit:
            pixels[k] -= weights.sum() / 2
        return background * pixels

    def sums(self):
        """Return the sums of the lit pixels in both apertures, with the background."""
        star = self.star
        level = star.photometry.background[:, star.usable].sum(axis=0)
        sums = star.flux.sum(axis=0) + level * self.area
        for _, k, _, _, light in self.star.unlit:
            sums[k] -= light
        return sums

    def _radii(self, p):
        return self.star.width * np.exp(p[0] + p[3] * self.star.x), self.halo_radius * np.exp(p[2])

    def _columns(self, core, halo):
        along = self.terms.T.reshape(-1, len(core), *(1,) * (core.ndim - 1))
        return np.concatenate([core * along, halo * along])

    def _seen(self):
        rings, flux = self.rings, self.star.flux
        for beam in range(2):
            yield flux[beam], rings.own[:, beam]
            if rings.other is not None:
                yield flux[1 - beam], rings.other[:, beam]


# --- fit -------------------------------------------------------------------------


def _fit(star, rings, detector, halo_radius):
    profile = _Profile(star, rings, halo_radius)
    # weights from data that are the mean of all slices, then from the profile
    # without a model yet; the mean of the slices is less noisy than each of them
    expected = np.broadcast_to(rings.values.mean(axis=1, keepdims=True), rings.values.shape)
    p = _START
    for _ in range(2):
        weights = _weights(expected, rings, detector)
        p, c, background, cost = _least_squares(profile, weights, p)
        light = np.tensordot(c, profile.in_rings(p), 1)
        share = star.flux / star.flux.sum(axis=0)
        expected = share[:, :, None] * light + background[:, None] / 2
    freedom = max(weights.size - len(star.x) - len(c) - len(p), 1)
    found = (p, c, background)
    covariance = _covariance(profile, weights, found) * max(1.0, cost / freedom)
    return _shares(profile, found, covariance, cost / freedom)


def _weights(expected, rings, detector):
    """Return the inverse standard deviation of the sum of both beams in each ring."""
    variances = [detector.of(b).variance(expected[b]) / rings.counts[b] for b in range(2)]
    return 1 / np.sqrt(sum(variances))


def _least_squares(profile, weights, start):
    """Return the numbers of the profile, the backgrounds, and the sum of squares."""
    data = profile.rings.values.sum(axis=0)

    def solve(p):
        columns = profile.in_rings(p)
        matrix = _without_mean(columns, weights).reshape(len(columns), -1).T
        known = _without_mean(data, weights).ravel()
        c = np.linalg.lstsq(matrix, known)[0]
        return c, columns, matrix @ c - known

    def residuals(p):
        # the seeing as one more datum: a normal prior on ln of the radius
        return np.append(solve(p)[2], p[2] / _SEEING_SPREAD)

    bounds = (_LOW, _HIGH)
    p = least_squares(residuals, start, bounds=bounds, x_scale=_SCALE, xtol=1e-4, ftol=1e-6).x
    c, columns, rest = solve(p)
    beyond = data - np.tensordot(c, columns, 1)
    return p, c, (beyond * weights**2).sum(axis=1) / (weights**2).sum(axis=1), rest @ rest


def _without_mean(values, weights):
    """Return weighted values of which the constant in each slice has been fitted."""
    square = weights**2
    mean = (values * square).sum(axis=-1) / square.sum(axis=1)
    return (values - mean[..., None]) * weights


def _covariance(profile, weights, found):
    """Return the covariance of p, c and the backgrounds."""
    _, _, background = found
    slopes = _slopes(profile.in_rings, found)
    own = np.zeros((len(background), *weights.shape))
    own[np.arange(len(background)), np.arange(len(background))] = 1.0
    jacobian = (np.concatenate([slopes, own]) * weights).reshape(len(slopes) + len(own), -1)
    normal = jacobian @ jacobian.T
    normal[2, 2] += _SEEING_SPREAD**-2
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    return np.linalg.pinv(normal / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)


def _slopes(columns, found):
    """Return the derivatives of light, given by columns, to p and c."""
    p, c, _ = found
    moved = []
    for step in _STEP * np.eye(len(p)):
        high, low = (np.tensordot(c, columns(p + sign * step), 1) for sign in (0.5, -0.5))
        moved.append((high - low) / _STEP)
    return np.concatenate([moved, columns(p)])


def _shares(profile, found, covariance, chi_square):
    star = profile.star
    p, c, background = found
    measured = star.flux.sum(axis=0)
    known = profile.sums() - profile.background_in_apertures(background)
    total = known + np.tensordot(c, profile.lacking(p), 1)
    aperture = np.diag(-profile.background_in_apertures(np.ones(len(background))))
    slopes = np.concatenate([_slopes(profile.lacking, found), aperture])
    noise = slopes.T @ covariance @ slopes + np.diag(star.level_variance.sum(axis=0))
    share = measured / total
    relative = share / total
    return Shares(share, noise * np.outer(relative, relative), chi_square)
