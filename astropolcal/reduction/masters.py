# Licensed under a 3-clause BSD style license - see LICENSE
"""Dark and flat of raw frames: what is subtracted, what is divided by, and what is bad in them."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from astropy.io import fits

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.fitscheck import open_fits, readable_fits

__all__ = []


@dataclass(frozen=True)
class Masters:
    """
    Files of a dark and of a flat, either of which may be None.

    Pixels without a value in either, and those at which the flat is not above zero, are bad. Where
    each camera writes files of its own, these are those of the right beam, and the others stand
    beside them. The flat is divided by its median; neither adds its own noise to the errors.
    """

    dark: str | None = None
    flat: str | None = None

    def check(self, layout):
        """Read all files, so that one that does not fit is named before any frame is reduced."""
        for path in filter(None, (self.dark, self.flat)):
            for own in filter(None, (path, layout.left_file(path))):
                _read(str(own), layout.file_shape)

    def of_left(self, layout):
        """Return the files of the left beam."""
        return Masters(*(p and str(layout.left_file(p)) for p in (self.dark, self.flat)))

    def applied(self, cube, good, layout):
        """Return a cube, or a stack of exposures, and its known pixels, less dark and over flat."""
        saturated = cube >= layout.saturation
        raw, cube = cube, np.asarray(cube, dtype=float)
        if self.dark is not None:
            dark = _read(self.dark, layout.file_shape)
            cube, good = cube - dark, good & np.isfinite(dark)
        if self.flat is not None:
            flat = _read(self.flat, layout.file_shape)
            lit = np.isfinite(flat) & (flat > 0)
            level = np.median(flat[lit]) if lit.any() else 1.0
            cube, good = cube / np.where(lit, flat / level, 1.0), good & lit
        # what was saturated is to be seen as such
        return np.where(good, np.where(saturated, raw, cube), 0.0), good


@lru_cache(maxsize=8)
def _read(path, shape):
    """Return the first image of a file that has a shape, or that of one slice; NaN where bad."""
    if not Path(path).is_file():
        raise ParameterError(f"{path}: there is no such file")
    with readable_fits(path), open_fits(path) as stream, fits.open(stream, memmap=False) as hdus:
        shapes = []
        for hdu in hdus:
            data = hdu.data if hdu.is_image else None
            if data is None:
                continue
            if data.shape in (shape, shape[1:], (1, *shape[1:])) and data.dtype.kind in "fiu":
                found = np.array(data, dtype=float)
                if not np.isfinite(found).any():
                    raise ObservationError(f"{path}: no pixel has a value")
                return found
            shapes.append(str(data.shape))
    raise ObservationError(
        f"{path}: {', '.join(shapes) or 'no image'}; {shape} or {shape[1:]} is needed"
    )
