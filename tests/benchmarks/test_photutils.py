# Licensed under a 3-clause BSD style license - see LICENSE
"""
What of the photometry is our own, next to the classes of photutils that do the same.

Ours is kept where it is at least three times faster; masks of apertures, peaks and curves of growth
are photutils'.
"""

import warnings

import numpy as np
from photutils.aperture import ApertureStats, RectangularAperture
from photutils.psf import fit_2dgaussian
from timing import fastest

from astropolcal import instruments
from astropolcal.reduction.photometry import detector_of, measure_internal
from astropolcal.reduction.stars import fit_gaussians

N_SLICES = 22


def test_gaussians_of_all_wavelengths(measured):
    y, x = np.indices((21, 21), dtype=float)
    rng = np.random.default_rng(1)
    images = 1000 * np.exp(-((x - 10.3) ** 2 + (y - 9.8) ** 2) / (2 * 2.1**2)) + 50
    images = images + rng.normal(0, 3, (2 * N_SLICES, 21, 21))

    def ours():
        return fit_gaussians(images, np.isfinite(images), x=10.0, y=10.0, fwhm=5.0)

    def theirs():
        return [
            fit_2dgaussian(image - 50, xypos=(10, 10), fit_shape=21, fwhm=5.0, fix_fwhm=False)
            for image in images
        ]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [float(fit.results["x_fit"][0]) for fit in theirs()]
        np.testing.assert_allclose(ours().x, found, atol=0.02)
        times = fastest(ours, theirs, repeats=3)
    others = {"fit_2dgaussian of photutils": times[1]}
    measured("Gaussians in all slices of a cube", times[0], others)
    assert times[1] > 3 * times[0]


def test_rectangles_of_all_wavelengths(measured):
    layout = instruments.get("charis").files
    cube = np.random.default_rng(1).poisson(1000, (N_SLICES, 201, 201)).astype(np.float32)
    left, right, width, height, angle = layout.internal_apertures
    apertures = [RectangularAperture(place, width, height, theta=angle) for place in (right, left)]
    detector = detector_of(layout)

    def ours():
        return measure_internal(cube, None, detector, layout)

    def theirs():
        # sum, brightest pixel and spread: without the search for single bad pixels
        found = [[ApertureStats(image, a) for image in cube] for a in apertures]
        return [[(s.sum, s.max, s.std) for s in row] for row in found]

    sums = np.array(theirs())[..., 0]
    np.testing.assert_allclose(ours().flux, sums, rtol=1e-3)
    times = fastest(ours, theirs, repeats=3)
    measured("rectangles in all slices", times[0], {"ApertureStats of photutils": times[1]})
    assert times[1] > 3 * times[0]
