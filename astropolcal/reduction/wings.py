# Licensed under a 3-clause BSD style license - see LICENSE
"""
The light of a star outside of its apertures, from the profile of its image.

What an aperture measures lacks the wings beyond it, and the wings in the ring are taken for
background. A field stop cuts them before they reach the detector. So the light outside cannot be
summed; a profile is fitted to the part that is seen, and integrated.

The profile is that of Moffat 1969, A&A 3, 455. Its exponent is 11/6 in the wings of a
seeing-limited image (Racine 1996, PASP 108, 699).
"""

from collections import namedtuple
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import legfit, legval, legvander
from scipy.optimize import least_squares

from astropolcal.reduction.photometry import rectangles

__all__ = []

#: Exponent of the halo: that of a seeing-limited image, whose wings fall as r^-11/3.
HALO_BETA = 11 / 6
# full width of the halo: that of the seeing, milliarcsecond, and its relative uncertainty
_SEEING, _SEEING_SPREAD = 500.0, 0.35

# ln of core width over Gaussian width, 1 / exponent, ln of halo radius, slope of the first
_START = np.array([np.log(0.6), 0.3, 0.0, 0.0])
_LOW, _HIGH = np.array([-2.0, 1e-3, -1.2, -0.5]), np.array([1.0, 0.7, 1.2, 0.5])
_SCALE = np.array([0.05, 0.05, 0.2, 0.05])
# in each of the four numbers, which are of order one: central differences good to 1e-8
_STEP = 1e-4


def wing_shares(cube, good, photometry, level_variance, detector, layout, *, reach=45.0):
    """
    Return which part of a star's light the apertures of both beams have, (K,), and its covariance.

    None if too little of the wings is seen. Rings up to 1.5 times ``reach`` are used.
    ``level_variance`` (2, W) is what the noise of the background adds to the variance of a flux.
    With the flux F in the aperture the surface brightness at the distance r from the star is

        B + F [A (beta - 1) / (pi alpha^2) (1 + r^2 / alpha^2)^-beta
               + H (5 / 6) / (pi alpha_h^2) (1 + r^2 / alpha_h^2)^(-11 / 6)].

    One exponent beta and one radius alpha_h hold for all slices, ln(alpha), A and H are linear in
    the number of the slice, B is free in each. The Gaussian is the limit of large exponents. The
    halo is as wide as the seeing, 0.5 arcsec within 35 %, unless the rings say otherwise. Without
    ``internal_apertures`` there is no field stop, and each beam has light of the other's image.
    """
    if photometry.failed.all():
        return None
    star = Star(cube, good, photometry, level_variance, layout)
    # part of an aperture that may lie outside of the lit field
    if star.unlit_part > 0.2 or (rings := rings_of(star, reach * 1.5)) is None:
        return None
    # full width at half maximum over the radius of the profile
    width = 2 * np.sqrt(HALO_BETA * (2 ** (1 / HALO_BETA) - 1))
    return _fit(star, rings, detector, min(_SEEING / layout.pixel_scale, reach) / width)


# --- profile ---------------------------------------------------------------------


def _moffat(r, radius, t):
    """Return a Moffat profile of unit sum, t = 1 / beta, alpha^2 = beta radius^2."""
    return np.exp(-np.log1p(t * (r / radius) ** 2) / t) * (1 - t) / (np.pi * radius**2)


def _beyond(r, radius, t):
    """Return the part of its light that is farther away than r."""
    return np.exp(np.log1p(t * (r / radius) ** 2) * (1 - 1 / t))


class _Profile:
    """The profile of a star as a function of the four numbers that it is not linear in."""

    def __init__(self, star, rings, halo_radius):
        self.star, self.rings, self.halo_radius = star, rings, halo_radius
        self.terms = legvander(star.x, min(1, len(star.x) - 1))
        self.area = np.pi * star.radius**2
        # lit pixels of an aperture, mean of both, and the sums in both with the background
        level = star.photometry.background[:, star.usable].sum(axis=0)
        self.pixels, self.sums = self.area.copy(), star.flux.sum(axis=0) + level * self.area
        for _, k, _, weights, light in star.unlit:
            self.pixels[k] -= weights.sum() / 2
            self.sums[k] -= light

    def in_rings(self, p):
        """Return the light in the rings, of both beams, that one unit of each number gives."""
        light = self.star.flux[:, :, None]
        seen = [(light, self.rings.own)]
        # without a stop there is light of the other image
        seen += [] if self.rings.other is None else [(light[::-1], self.rings.other)]
        parts = []
        for radius, t in self._components(p):
            shares = ((own, _moffat(r, radius[:, None], t).mean(axis=0)) for own, r in seen)
            parts.append(sum((own * share).sum(axis=0) for own, share in shares))
        return self._columns(parts)

    def lacking(self, p):
        """Return the light that the sums of the lit pixels in the apertures lack."""
        star, parts = self.star, []
        total = star.flux.sum(axis=0)
        for radius, t in self._components(p):
            part = total * _beyond(star.radius, radius, t)
            if not star.stopped:
                apart = np.hypot(*(star.places[0] - star.places[1]))
                # the light of the other image in the aperture, nearly constant over it
                part = part - total * self.area * _moffat(apart, radius, t)
            for beam, k, r, weights, _ in star.unlit:
                part[k] += star.flux[beam, k] * weights @ _moffat(r, radius[k], t)
            parts.append(part)
        return self._columns(parts)

    def _components(self, p):
        """Return radius in each slice and 1 / exponent of core and halo."""
        core = self.star.width * np.exp(p[0] + p[3] * self.star.x)
        return (core, p[1]), (np.full(len(core), self.halo_radius * np.exp(p[2])), 1 / HALO_BETA)

    def _columns(self, parts):
        along = self.terms.T.reshape(-1, len(parts[0]), *(1,) * (parts[0].ndim - 1))
        return np.concatenate([part * along for part in parts])


# --- fit -------------------------------------------------------------------------


def _fit(star, rings, detector, halo_radius):
    profile = _Profile(star, rings, halo_radius)
    # weights from data that are the mean of all slices, then from the profile
    # without a model yet; the mean of the slices is less noisy than each of them
    expected = np.broadcast_to(rings.values.mean(axis=1, keepdims=True), rings.values.shape)
    p = _START
    for _ in range(2):
        # of the sum of both beams in each ring
        variances = [detector.of(b).variance(expected[b]) / rings.counts[b] for b in range(2)]
        weights = 1 / np.sqrt(sum(variances))
        p, c, background, cost = _least_squares(profile, weights, p)
        light = np.tensordot(c, profile.in_rings(p), 1)
        share = star.flux / star.flux.sum(axis=0)
        expected = share[:, :, None] * light + background[:, None] / 2
    freedom = max(weights.size - len(star.x) - len(c) - len(p), 1)
    found = (p, c, background)
    covariance = _covariance(profile, weights, found) * max(1.0, cost / freedom)
    measured = star.flux.sum(axis=0)
    known = profile.sums - background * profile.pixels
    total = known + np.tensordot(c, profile.lacking(p), 1)
    slopes = np.concatenate([_slopes(profile.lacking, found), np.diag(-profile.pixels)])
    noise = slopes.T @ covariance @ slopes + np.diag(star.level_variance.sum(axis=0))
    relative = measured / total**2
    return measured / total, noise * np.outer(relative, relative)


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
    slopes = _slopes(profile.in_rings, found)
    own = np.eye(len(found[2]))[:, :, None] * np.ones(weights.shape)
    jacobian = (np.concatenate([slopes, own]) * weights).reshape(len(slopes) + len(own), -1)
    normal = jacobian @ jacobian.T
    normal[2, 2] += _SEEING_SPREAD**-2
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scale = np.outer(scale, scale)
    return np.linalg.pinv(normal / scale, hermitian=True) / scale


def _slopes(columns, found):
    """Return the derivatives of light, given by columns, to p and c."""
    p, c, _ = found
    moved = []
    for step in _STEP * np.eye(len(p)):
        high, low = (np.tensordot(c, columns(p + sign * step), 1) for sign in (0.5, -0.5))
        moved.append((high - low) / _STEP)
    return np.concatenate([moved, columns(p)])


# ---- the wings as they are seen: means in rings, inside the field stop ---------------------------

_FEWEST_PIXELS, _FEWEST_RINGS = 10, 8


class Star:
    """The slices of a star that have not failed, and what was measured in them."""

    def __init__(self, cube, good, photometry, level_variance, layout):
        self.usable = usable = np.flatnonzero(~photometry.failed)
        self.cube, self.good, self.photometry = cube, good, photometry
        self.level_variance = level_variance[:, usable]
        # whether a stop hides the light of the other image, and the lit pixels of each beam
        self.stopped = len(layout.internal_apertures) == 5
        # both images (beam, x or y, K), their fluxes (2, K), and the radii of the apertures (K,)
        self.places = np.stack([photometry.x, photometry.y], axis=1)[..., usable]
        self.flux, self.radius = photometry.flux[:, usable], photometry.radius[0, usable]
        # number of the slice, from -1 to 1
        n = len(usable)
        self.x = np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
        # of the Gaussians of both beams, which see one atmosphere, smooth over the slices, (K,)
        width = photometry.fwhm[:, usable].mean(axis=0)
        self.width = legval(self.x, legfit(self.x, width, min(2, n - 1)))
        # one map of the lit pixels for all slices
        self.lit, shape = np.zeros((2, *cube.shape[1:]), dtype=bool), cube.shape[1:]
        if self.stopped:
            beams = rectangles(layout.internal_apertures, shape)
            for own, (rows, columns, weights) in zip(self.lit, beams, strict=True):
                # pixels wholly inside; those on the edge are dark in part
                own[rows, columns] = weights > 0.999
        else:
            rows, columns = np.ogrid[: shape[0], : shape[1]]
            # without a stop a pixel belongs to the image whose mean place is nearer
            right, left = (np.hypot(columns - x, rows - y) for x, y in self.places.mean(axis=2))
            self.lit = np.stack([right < left, left < right])

    @cached_property
    def unlit(self):
        """
        Pixels of the apertures that lie outside of the lit field.

        A list of beam, slice, distances, weights, and the light that was measured.
        """
        from photutils.aperture import CircularAperture

        found = []
        for beam, lit in enumerate(self.lit):
            for k, (place, radius) in enumerate(zip(self.places[beam].T, self.radius, strict=True)):
                aperture = CircularAperture(place, radius)
                # quick look first: few apertures reach out of the field
                mask = aperture.to_mask(method="center")
                if lit[mask.get_overlap_slices(lit.shape)[0]].all():
                    continue
                mask = aperture.to_mask(method="exact")
                inside, part = mask.get_overlap_slices(lit.shape)
                dark = ~lit[inside] & (mask.data[part] > 0)
                if not dark.any():
                    continue
                rows, columns = np.nonzero(dark)
                x, y = columns + inside[1].start - place[0], rows + inside[0].start - place[1]
                # (pixels in the dark part,) of the slice
                values, known = (a[self.usable[k]][inside][dark] for a in (self.cube, self.good))
                weights = mask.data[part][dark]
                light = float(weights @ np.where(known, values, 0.0))
                found.append((beam, k, np.hypot(x, y), weights, light))
        return found

    @property
    def unlit_part(self):
        """Largest part of an aperture that is not lit."""
        parts = [w.sum() / (np.pi * self.radius[k] ** 2) for _, k, _, w, _ in self.unlit]
        return max(parts, default=0.0)


# mean values in rings of a pixel's width, and their pixels; (beam, slice, ring)
# distances from the own and the other image are mean less and plus standard deviation (first
# axis): the mean of a smooth profile over a ring is that of its values at both
Rings = namedtuple("Rings", "values counts own other")


def rings_of(star, outer):
    """Return the rings that are seen in all slices; None if there are too few."""
    # from the innermost place at which all slices are in their wings, beyond 1.2 full widths:
    # further in the profile need not be a Moffat
    edges = np.arange(np.floor(np.minimum(1.2 * star.width, star.radius).max()), outer + 1)
    if len(edges) <= _FEWEST_RINGS:
        return None
    found = np.array([_means(star, beam, edges) for beam in range(2)]).transpose(2, 0, 1, 3)
    # one set of rings for all slices and beams, or the profile could not be common
    full = (found[0] >= _FEWEST_PIXELS).all(axis=(0, 1))
    if full.sum() < _FEWEST_RINGS:
        return None
    # (quantity, beam, slice, ring)
    counts, values, *moments = found[..., full]
    points = []
    for mean, square in zip(moments[::2], moments[1::2], strict=True):
        # rounding may leave a variance below zero
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))
        points.append(np.stack([mean - spread, mean + spread]))
    return Rings(values, counts, points[0], None if star.stopped else points[1])


def _means(star, beam, edges):
    """Return number and mean of the pixels of each ring, and moments of their distances."""
    found = []
    rows, columns = np.nonzero(star.lit[beam])
    for k, slice_ in enumerate(star.usable):
        beams = (beam,) if star.stopped else (beam, 1 - beam)
        distances = [np.hypot(columns - x, rows - y) for x, y in star.places[beams, :, k]]
        own = distances[0]
        used = (own >= edges[0]) & (own < edges[-1]) & star.good[slice_][rows, columns]
        # mean and mean square, for the two points that stand for a ring
        moments = [d[used] ** power for d in distances for power in (1, 2)]
        moments.insert(0, star.cube[slice_][rows[used], columns[used]])
        # rings are a pixel wide
        ring = (own[used] - edges[0]).astype(int)
        number = np.bincount(ring, minlength=len(edges) - 1)
        sums = [np.bincount(ring, m, len(edges) - 1) for m in moments]
        found.append([number, *(total / np.maximum(number, 1) for total in sums)])
    return found
