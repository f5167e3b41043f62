# Licensed under a 3-clause BSD style license - see LICENSE
"""Cubes of a small instrument, as numbers and as files."""

import os
from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.io import fits

from astropolcal.instruments import CHARIS
from astropolcal.reduction.frames import reduce_frame

N_WAVELENGTHS = 4
HEADER = {
    "RET-ANG1": 0.0,
    "RET-POS1": 80.0,
    "D_IMRANG": 97.0,
    "PARANG": 20.0,
    "ALTITUDE": 70.0,
    "EXPTIME": 10.0,
    "UTC-DATE": "2025-11-03",
    "UTC-TIME": "12:00:00",
    "MJD": 60982.5,
    "OBJECT": "HD 293396",
    "INSTRUME": "CHARIS",
    "FILTNAME": "Broadband",
}


class Small(CHARIS):
    """CHARIS with few wavelengths."""

    name = "small"
    aliases = ("test/small",)
    wavelength = np.array([1200.0, 1500.0, 1800.0, 2100.0]) * u.nm
    files = replace(CHARIS.files, shape=(N_WAVELENGTHS, 201, 201))


def star_image(places, *, flux=2e5, fwhm=5.0, background=20.0, shape=(201, 201)):
    """Return Gaussian stars on a constant: ``places`` are (x, y) or (x, y, factor)."""
    y, x = np.indices(shape)
    sigma = fwhm / np.sqrt(8 * np.log(2))
    image = np.full(shape, background)
    for place in places:
        factor = place[2] if len(place) == 3 else 1.0
        distance = (x - place[0]) ** 2 + (y - place[1]) ** 2
        image += factor * flux / (2 * np.pi * sigma**2) * np.exp(-distance / (2 * sigma**2))
    return image


def expose(image, layout, seed=0, n_wavelengths=N_WAVELENGTHS):
    """Return noisy slices of an image in adu."""
    rng = np.random.default_rng(seed)
    shape = (n_wavelengths, *image.shape)
    electrons = rng.poisson(np.broadcast_to(np.maximum(image, 0) * layout.gain, shape))
    return ((electrons + rng.normal(0, layout.read_noise, shape)) / layout.gain).astype("f4")


def pair(layout, x=70.3, y=85.2, factor=1.0):
    """Return the places of a star in the left and the right beam."""
    dx, dy = layout.star_offset
    return [(x, y, factor), (x + dx, y + dy, factor)]


def write_cube(path, cube, *, drop=(), extra_hdus=(), **changes):
    """Write a cube with a header; keywords with ``_`` for ``-``."""
    header = HEADER | {key.replace("__", "-"): value for key, value in changes.items()}
    cards = [(key, value) for key, value in header.items() if key not in drop]
    hdus = [fits.PrimaryHDU(header=fits.Header(cards))]
    hdus += [] if cube is None else [fits.ImageHDU(np.asarray(cube, dtype="f4"))]
    fits.HDUList([*hdus, *extra_hdus]).writeto(path, overwrite=True)
    return path


def reduce_frame_or_die(path, layout, **task):
    """Reduce a frame, but end the whole process at one whose name says so."""
    if "deadly" in path:
        os._exit(9)
    return reduce_frame(path, layout, **task)
