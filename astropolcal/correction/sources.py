# Licensed under a 3-clause BSD style license - see LICENSE
"""Where the fluxes of both beams come from: arrays in memory or on disk, or cubes in files."""

import io
from dataclasses import dataclass
from itertools import pairwise

import astropy.units as u
import numpy as np
from astropy.io import fits

from astropolcal.correction.geometry import derotate, derotate_variance
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.files import understood
from astropolcal.fitscheck import open_fits, readable_fits

__all__ = []

# times the longer side of an image: any turn of the field fits, and nothing beyond has light
_MOST_SIZE = 2


class ArraySource:
    """
    Beams as arrays, (n_frames, n_wavelengths, ...): in memory, mapped from disk, or of dask.

    ``batch`` frames are read at a time; by default all of arrays in memory, those of a chunk of
    dask arrays, and one of arrays on disk.
    """

    def __init__(
        self, right, left, variance_right=None, variance_left=None, names=None, batch=None
    ):
        self._batch = batch
        self._beams = [_array(right), _array(left)]
        given = [v is not None for v in (variance_right, variance_left)]
        if any(given) != all(given):
            raise ObservationError("variances of one beam only; both or none are needed")
        self._variances = None
        if all(given):
            self._variances = [_array(variance_right), _array(variance_left)]
        shapes = {array.shape for array in [*self._beams, *(self._variances or [])]}
        if len(shapes) > 1 or len(next(iter(shapes))) < 2:
            raise ObservationError(
                f"the beams and their variances have shapes {sorted(shapes)}; one shape "
                "(n_frames, n_wavelengths, ...) is needed"
            )
        self.n_frames, self.n_wavelengths, *image = self._beams[0].shape
        self.image_shape = tuple(image)
        self.names = [f"frame {i}" for i in range(self.n_frames)] if names is None else list(names)

    @property
    def has_variances(self):
        """Whether the fluxes have variances."""
        return self._variances is not None

    def batches(self):
        """Return the frames that are read at a time, a list of slices."""
        array = self._beams[0]
        batch = self._batch or (1 if isinstance(array, np.memmap) else self.n_frames)
        ends = [*range(0, self.n_frames, batch), self.n_frames]
        if self._batch is None and hasattr(array, "chunks"):
            # a part of a chunk costs as much as all of it
            ends = np.cumsum([0, *array.chunks[0]]).tolist()
        return [slice(start, end) for start, end in pairwise(ends)]

    def fluxes(self, beam, frames, wavelengths):
        """Return the fluxes of a beam in some frames and wavelengths, (n, m, ...)."""
        return np.asarray(self._beams[beam][frames, wavelengths])

    def variances(self, beam, frames, wavelengths):
        """Return their variances."""
        return np.asarray(self._variances[beam][frames, wavelengths])


def _array(values):
    return values if hasattr(values, "dtype") and hasattr(values, "shape") else np.asarray(values)


class TurnedSource:
    """
    Beams of another source, turned north up frame by frame when they are read.

    ``position_angle`` is that of the +y axis, (n_frames,); the options are those of `derotate`.
    """

    def __init__(self, source, position_angle, **options):
        self._source, self._angles, self._options = source, position_angle, options
        if len(source.image_shape) != 2:
            raise ParameterError(f"images of shape {source.image_shape} cannot be turned")
        if np.shape(position_angle) != (source.n_frames,):
            raise ParameterError(
                f"position_angle has shape {np.shape(position_angle)}; one for each of the "
                f"{source.n_frames} frames is needed"
            )
        self.n_frames, self.n_wavelengths = source.n_frames, source.n_wavelengths
        size = options.get("size")
        self.image_shape = source.image_shape if size is None else tuple(np.broadcast_to(size, 2))
        self.names = source.names

    @property
    def has_variances(self):
        """Whether the fluxes have variances."""
        return self._source.has_variances

    def batches(self):
        """Return the frames that are read at a time, one by one."""
        return [slice(i, i + 1) for i in range(self.n_frames)]

    def fluxes(self, beam, frames, wavelengths):
        """Return the fluxes of a beam in some frames and wavelengths, (n, m, Y, X)."""
        return self._turned(derotate, self._source.fluxes(beam, frames, wavelengths), frames)

    def variances(self, beam, frames, wavelengths):
        """Return their variances."""
        found = self._source.variances(beam, frames, wavelengths)
        return self._turned(derotate_variance, found, frames)

    def _turned(self, turn, cubes, frames):
        angles = self._angles[frames]
        return np.stack(
            [turn(cube, angle, **self._options) for cube, angle in zip(cubes, angles, strict=True)]
        )


class CubeFiles:
    """
    Both beams of extracted cubes (n_wavelengths, Y, X), cut out of FITS files when they are needed.

    ``centres`` are the place of one point of the sky in the right and left beam, 0-based x and y,
    (2, 2) or (n_frames, 2, 2): side by side, or, with ``left_files``, in the image of each.
    ``size`` rows and columns are cut out about it, turned north up if there are position angles.
    Inverse variances or errors (``weights``) may follow the cube's ``extension``, else those of
    the ``detectors`` count; ``left_scale`` multiplies the left beam. Of ``stacked`` files the
    first axis are exposures, of which the mean is taken.
    """

    def __init__(
        self,
        files,
        centres,
        size,
        *,
        position_angle=None,
        extension=1,
        mirrored=False,
        order=3,
        left_files=None,
        left_scale=1.0,
        weights="inverse variance",
        stacked=False,
        detectors=None,
    ):
        self.files = [str(path) for path in files]
        if not self.files:
            raise ObservationError("no files")
        self._extension, self._order, self._mirrored = extension, order, mirrored
        self.n_frames = len(self.files)
        self.names = self.files
        self._centres = np.broadcast_to(np.asarray(centres, dtype=float), (self.n_frames, 2, 2))
        self._angles = position_angle
        self.image_shape = (int(size), int(size))
        left = self.files if left_files is None else [str(path) for path in left_files]
        self._beam_files = (self.files, left)
        self._scale = np.broadcast_to(np.asarray(left_scale, dtype=float), (self.n_frames,))
        self._weights, self._stacked, self._detectors = weights, stacked, detectors
        # each file once, where both beams are in one
        found = {path: _places(path, extension) for path in dict.fromkeys([*self.files, *left])}
        self._places = [[found[path] for path in files] for files in self._beam_files]
        self._shape = self._of_file(self._places[0][0][0])
        for path, (cube, *_) in found.items():
            if self._of_file(cube) != self._shape or len(cube.shape) != 3 or 0 in cube.shape:
                raise ObservationError(
                    f"{path}: a cube of shape {cube.shape}; {self.files[0]} has {self._shape}, and "
                    "three axes of some length are needed"
                )
        self.n_wavelengths = self._shape[0]
        self._has_errors = all(len(places) > 1 for places in found.values())
        self.has_variances = self._has_errors or detectors is not None
        self._check_size(size)
        self._check_window(self._shape[1:])

    def _of_file(self, place):
        """Return the shape of the cube that is taken from a file."""
        return (1, *place.shape[1:]) if self._stacked and place.shape[0] else place.shape

    def _check_size(self, size):
        height, width = self._shape[1:]
        most = _MOST_SIZE * max(height, width)
        if not 1 <= size <= most:
            raise ParameterError(
                f"size = {size}; the images are {width} x {height} pixels, allowed are 1 to {most}"
            )

    def _check_window(self, shape):
        x, y = self._centres[..., 0], self._centres[..., 1]
        # up to half a pixel beyond the middle of the last one
        inside = (x > -0.5) & (x < shape[1] - 0.5) & (y > -0.5) & (y < shape[0] - 0.5)
        if not inside.all():
            frame, beam = np.argwhere(~inside)[0]
            raise ObservationError(
                f"{self.files[frame]}: the {('right', 'left')[beam]} beam's centre "
                f"{self._centres[frame, beam].tolist()} is outside the image of {shape[1]} x "
                f"{shape[0]} pixels"
            )

    def batches(self):
        """Return the frames that are read at a time, one by one."""
        return [slice(i, i + 1) for i in range(self.n_frames)]

    def fluxes(self, beam, frames, wavelengths):
        """Return the fluxes of a beam in some frames and wavelengths, (n, m, size, size)."""
        numbers = range(self.n_frames)[frames]
        # a damaged file may hold signalling NaNs, of which numpy warns where they are first used
        with np.errstate(invalid="ignore"):
            found = [self._read(beam, i, wavelengths) * self._factor(beam, i) for i in numbers]
        cut = [self._cut(derotate, i, beam, cube) for i, cube in zip(numbers, found, strict=True)]
        return np.stack(cut)

    def variances(self, beam, frames, wavelengths):
        """Return their variances, NaN where the weight or the error is zero."""
        found = []
        for i in range(self.n_frames)[frames]:
            variance = self._variance(beam, i, wavelengths) * self._factor(beam, i) ** 2
            found.append(self._cut(derotate_variance, i, beam, variance))
        return np.stack(found)

    def _variance(self, beam, i, wavelengths):
        if not self._has_errors:
            return self._detectors[i][beam].variance(self._read(beam, i, wavelengths))
        # variance = error^2 = 1 / inverse variance
        power = 2 if self._weights == "error" else -1

        def squared(known):
            return np.where(known > 0, known**power, np.nan)

        with np.errstate(divide="ignore", invalid="ignore"):
            return self._read(beam, i, wavelengths, 1, squared)

    def _factor(self, beam, i):
        return self._scale[i] if beam == 1 else 1.0

    def _cut(self, resample, i, beam, cube):
        angle = 0 * u.deg if self._angles is None else self._angles[i]
        return resample(
            cube,
            angle,
            centre=self._centres[i, beam],
            size=self.image_shape,
            mirrored=self._mirrored,
            order=self._order,
        )

    def _read(self, beam, i, wavelengths, offset=0, change=None):
        """Return a cube or, with an offset, what follows it, ``change``d before it is averaged."""
        if not self._stacked:
            cube = self._section(beam, i, wavelengths, offset)
            return cube if change is None else change(cube)
        cube = self._section(beam, i, slice(None), offset)
        cube = cube if change is None else change(cube) / len(cube)
        number = np.isfinite(cube).sum(axis=0, keepdims=True)
        total = np.nansum(cube, axis=0, keepdims=True)
        return np.where(number > 0, total / np.maximum(number, 1), np.nan)

    def _section(self, beam, i, wavelengths, offset):
        place, path = self._places[beam][i][offset], self._beam_files[beam][i]
        with understood(path, ObservationError, "cannot be read"):
            if place.start is not None:
                # a thousand files would take long to open, wavelength by wavelength
                cube = np.memmap(path, place.dtype, "r", place.start, place.shape)
                return np.array(cube[wavelengths], dtype=float)
            with open_fits(path) as stream, fits.open(stream) as hdus:
                section = hdus[self._extension + offset].section
                if len(section.shape) == 2:
                    return np.array(section[:, :], dtype=float)[None][wavelengths]
                return np.array(section[wavelengths], dtype=float)


@dataclass(frozen=True)
class _Place:
    """Where an array stands in a file; no start if its numbers are packed or scaled."""

    shape: tuple
    dtype: str
    start: int | None


def _places(path, extension):
    """Return where the cube stands in a file, and the inverse variances if they follow."""
    with (
        readable_fits(path),
        open_fits(path) as stream,
        fits.open(stream, memmap=True) as hdus,
    ):
        if len(hdus) <= extension:
            raise ObservationError(f"{path}: no extension {extension} in it")
        packed = isinstance(stream, io.BytesIO)
        found = [_place(hdu, packed) for hdu in hdus[extension : extension + 2]]
    return found if found[-1].shape == found[0].shape else found[:1]


def _place(hdu, packed):
    header, info = hdu.header, hdu.fileinfo()
    # a compressed image is of a subclass
    plain = type(hdu) in (fits.ImageHDU, fits.PrimaryHDU)
    plain &= header.get("BZERO", 0) == 0 and header.get("BSCALE", 1) == 1
    plain &= info is not None and not packed and "BLANK" not in header
    bits = header.get("BITPIX", 8)
    dtype = f">{'f' if bits < 0 else 'i' if bits > 8 else 'u'}{abs(bits) // 8}"
    shape = tuple(getattr(hdu, "shape", ()))
    # an image is a cube of one slice
    shape = (1, *shape) if len(shape) == 2 else shape
    return _Place(shape, dtype, info["datLoc"] if plain else None)
