# Licensed under a 3-clause BSD style license - see LICENSE
"""The wings of a star as they are seen: means in rings, inside the field stop."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial.legendre import legfit, legval

from astropolcal.reduction.apertures import rectangles

# rings from this many full widths on; further in the profile need not be a Moffat
_FROM = 1.2
_FEWEST_PIXELS, _FEWEST_RINGS = 10, 8


@dataclass(frozen=True)
class Star:
    """
    The slices of a star that can be used, and what was measured in them.

    ``lit`` are the pixels that belong to each beam; ``stopped`` says that a stop hides
    the light of the other one there.
    """

    cube: np.ndarray
    good: np.ndarray
    photometry: object
    level_variance: np.ndarray
    usable: np.ndarray
    lit: np.ndarray
    stopped: bool

    @classmethod
    def of(cls, cube, good, photometry, level_variance, layout):
        """Return the slices that have not failed."""
        usable = np.flatnonzero(~photometry.failed)
        # one map for all slices; without a stop, by the mean place of each image
        lit, stopped = _lit(photometry, layout, cube.shape[1:], usable)
        return cls(cube, good, photometry, level_variance[:, usable], usable, lit, stopped)

    @cached_property
    def x(self):
        """Number of the slice, from -1 to 1."""
        n = len(self.usable)
        return np.linspace(-1, 1, n) if n > 1 else np.zeros(1)

    @cached_property
    def flux(self):
        """Of both beams, (2, K)."""
        return self.photometry.flux[:, self.usable]

    @cached_property
    def radius(self):
        """Of the apertures, (K,)."""
        return self.photometry.radius[0, self.usable]

    @cached_property
    def width(self):
        """Of the Gaussians, smooth over the slices, (K,)."""
        # of both beams, which see one atmosphere
        width = self.photometry.fwhm[:, self.usable].mean(axis=0)
        return legval(self.x, legfit(self.x, width, min(2, len(width) - 1)))

    @cached_property
    def places(self):
        """Of both images, (beam, x or y, K)."""
        return np.stack([self.photometry.x, self.photometry.y], axis=1)[..., self.usable]

    @cached_property
    def unlit(self):
        """
        Pixels of the apertures that lie outside of the lit field.

        A list of beam, slice, distances, weights, and the light that was measured.
        """
        return list(_unlit(self))

    @property
    def unlit_part(self):
        """Largest part of an aperture that is not lit."""
        parts = [w.sum() / (np.pi * self.radius[k] ** 2) for _, k, _, w, _ in self.unlit]
        return max(parts, default=0.0)


def _lit(photometry, layout, shape, usable):
    if len(layout.internal_apertures) == 5:
        maps = np.zeros((2, *shape), dtype=bool)
        beams = rectangles(layout.internal_apertures, shape)
        for lit, (rows, columns, weights) in zip(maps, beams, strict=True):
            # pixels wholly inside; those on the edge are dark in part
            lit[rows, columns] = weights > 0.999
        return maps, True
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    middle = [(photometry.x[b, usable].mean(), photometry.y[b, usable].mean()) for b in range(2)]
    # without a stop a pixel belongs to the nearer image
    right, left = (np.hypot(columns - x, rows - y) for x, y in middle)
    return np.stack([right < left, left < right]), False


def _unlit(star):
    from photutils.aperture import CircularAperture

    for beam, lit in enumerate(star.lit):
        for k, (place, radius) in enumerate(zip(star.places[beam].T, star.radius, strict=True)):
            # quick look first: few apertures reach out of the field
            mask = CircularAperture(place, radius).to_mask(method="center")
            if lit[mask.get_overlap_slices(lit.shape)[0]].all():
                continue
            mask = CircularAperture(place, radius).to_mask(method="exact")
            inside, part = mask.get_overlap_slices(lit.shape)
            dark = ~lit[inside] & (mask.data[part] > 0)
            if not dark.any():
                continue
            rows, columns = np.nonzero(dark)
            r = np.hypot(columns + inside[1].start - place[0], rows + inside[0].start - place[1])
            # (pixels in the dark part,) of the slice
            values, known = (
                array[star.usable[k]][inside][dark] for array in (star.cube, star.good)
            )
            weights = mask.data[part][dark]
            yield beam, k, r, weights, float(weights @ np.where(known, values, 0.0))


@dataclass(frozen=True)
class Rings:
    """
    Mean values in rings of a pixel's width, and their pixels; (beam, slice, ring).

    The distances of the pixels, from the own and from the other image, are given as mean
    less and plus standard deviation, with a first axis of two: the mean of a smooth
    profile over a ring is that of its values at both.
    """

    values: np.ndarray
    counts: np.ndarray
    own: np.ndarray
    other: np.ndarray | None

    @classmethod
    def of(cls, star, outer):
        """Return the rings that are seen in all slices; None if there are too few."""
        # from the innermost place at which all slices are in their wings
        edges = np.arange(np.floor(np.minimum(_FROM * star.width, star.radius).max()), outer + 1)
        if len(edges) <= _FEWEST_RINGS:
            return None
        found = np.array([_means(star, beam, edges) for beam in range(2)]).transpose(2, 0, 1, 3)
        # one set of rings for all slices and beams, or the profile could not be common
        full = (found[0] >= _FEWEST_PIXELS).all(axis=(0, 1))
        if full.sum() < _FEWEST_RINGS:
            return None
        # (quantity, beam, slice, ring)
        counts, values, *moments = found[..., full]
        other = None if star.stopped else _interval(*moments[2:])
        return cls(values, counts, _interval(*moments[:2]), other)


def _means(star, beam, edges):
    """Return number and mean of the pixels of each ring, and moments of their distances."""
    found = []
    rows, columns = np.nonzero(star.lit[beam])
    for k, slice_ in enumerate(star.usable):
        x, y = star.places[beam, :, k]
        own = np.hypot(columns - x, rows - y)
        used = (own >= edges[0]) & (own < edges[-1]) & star.good[slice_][rows, columns]
        own, y_used, x_used = own[used], rows[used], columns[used]
        moments = [star.cube[slice_][y_used, x_used], own, own**2]
        if not star.stopped:
            x, y = star.places[1 - beam, :, k]
            other = np.hypot(x_used - x, y_used - y)
            # mean and mean square, for the two points that stand for a ring
            moments += [other, other**2]
        # rings are a pixel wide
        ring = (own - edges[0]).astype(int)
        number = np.bincount(ring, minlength=len(edges) - 1)
        sums = [np.bincount(ring, m, len(edges) - 1) for m in moments]
        found.append([number, *(total / np.maximum(number, 1) for total in sums)])
    return found


def _interval(mean, square):
    # rounding may leave a variance below zero
    spread = np.sqrt(np.maximum(square - mean**2, 0.0))
    return np.stack([mean - spread, mean + spread])
