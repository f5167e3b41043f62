# Licensed under a 3-clause BSD style license - see LICENSE
"""Where the fluxes of both beams come from: arrays in memory or on disk, or cubes in files."""

import io
from itertools import pairwise

import astropy.units as u
import numpy as np
from astropy.io import fits

from astropolcal.correction.geometry import derotate, derotate_gain, derotate_variance
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.files import one_line, understood
from astropolcal.fitscheck import open_fits, readable_fits
from astropolcal.observations.grid import mean_of_exposures
from astropolcal.units import to_unit

__all__ = []

# times the longer side of an image: any turn of the field fits, and nothing beyond has light
_MOST_SIZE = 2


class ArraySource:
    """Beams as arrays, (n_frames, n_wavelengths, ...): in memory, mapped from disk, or of dask.

    At a time all frames of arrays in memory are read, those of a chunk of dask arrays, and one of
    arrays on disk. Quantities are converted to ``unit``; what is masked has no value.
    """

    # as `TurnedSource`
    resampling = 1.0

    def __init__(
        self, right, left, variance_right=None, variance_left=None, names=None, unit=u.adu
    ):
        self._beams = [_array(right, "right", unit), _array(left, "left", unit)]
        given = {"variance_right": variance_right, "variance_left": variance_left}
        given = {name: value for name, value in given.items() if value is not None}
        if len(given) == 1:
            raise ObservationError("variances of one beam only; both or none are needed")
        self.has_variances = bool(given)
        self._variances = [_array(value, name, unit**2) for name, value in given.items()]
        shapes = {array.shape for array in [*self._beams, *self._variances]}
        if len(shapes) > 1 or len(next(iter(shapes))) < 2 or 0 in next(iter(shapes)):
            raise ObservationError(
                f"the beams and their variances have shapes {sorted(shapes)}; one shape "
                "(n_frames, n_wavelengths, ...) without a zero is needed"
            )
        self.n_frames, self.n_wavelengths, *image = self._beams[0].shape
        self.image_shape = tuple(image)
        self.names = [f"frame {i}" for i in range(self.n_frames)] if names is None else list(names)
        if len(self.names) != self.n_frames:
            raise ObservationError(f"{len(self.names)} names for {self.n_frames} frames")

    def batches(self):
        """Return the frames that are read at a time, a list of slices."""
        array = self._beams[0]
        ends = range(self.n_frames + 1) if isinstance(array, np.memmap) else [0, self.n_frames]
        if hasattr(array, "chunks"):
            # a part of a chunk costs as much as all of it
            ends = np.cumsum([0, *array.chunks[0]]).tolist()
        return [slice(start, end) for start, end in pairwise(ends)]

    def fluxes(self, beam, frames, wavelengths):
        """Return the fluxes of a beam in some frames and wavelengths, (n, m, ...)."""
        return np.asarray(self._beams[beam][frames, wavelengths])

    def variances(self, beam, frames, wavelengths):
        """Return their variances, NaN where they are zero: of no measurement."""
        found = np.asarray(self._variances[beam][frames, wavelengths], dtype=float)
        if (found < 0).any():
            frame = range(self.n_frames)[frames][np.argwhere(found < 0)[0, 0]]
            raise ObservationError(
                f"{self.names[frame]}: a variance is {found[found < 0][0]:g}; allowed are numbers "
                "above zero, and zero or NaN where there is no value"
            )
        return np.where(found > 0, found, np.nan)


def _array(values, name, unit):
    """Return numbers, in a unit if they have one, and NaN where they are masked."""
    mask, plain = getattr(values, "mask", None), getattr(values, "unmasked", values)
    if getattr(values, "unit", None) is not None:
        plain = to_unit(u.Quantity(np.asarray(plain), values.unit), unit, name)
    elif not (hasattr(plain, "dtype") and hasattr(plain, "shape")):
        plain = np.asarray(plain)
    if plain.dtype.kind not in "fiu":
        raise ObservationError(f"{name}: values of type {plain.dtype}; numbers are needed")
    return plain if mask is None or not np.any(mask) else np.where(mask, np.nan, plain)


class TurnedSource:
    """Beams of another source, turned north up frame by frame when they are read.

    ``position_angle`` is that of the +y axis, (n_frames,); ``centre`` the 0-based x and y that
    stays, (2,) or (n_frames, 2, 2) of each beam, by default the middle; ``size`` rows and columns
    are cut out about it, by default all. The other options are those of `derotate`.
    """

    def __init__(self, source, position_angle, *, centre=None, size=None, **options):
        self._source, self._angles = source, position_angle
        if len(source.image_shape) != 2:
            raise ParameterError(f"images of shape {source.image_shape} cannot be turned")
        if np.shape(position_angle) != (source.n_frames,):
            raise ParameterError(
                f"position_angle has shape {np.shape(position_angle)}; one for each of the "
                f"{source.n_frames} frames is needed"
            )
        height, width = source.image_shape
        centre = ((width - 1) / 2, (height - 1) / 2) if centre is None else centre
        try:
            centre = np.asarray(centre, dtype=float)
            # a number alone would be taken for both x and y
            if centre.shape not in ((2,), (2, 2), (source.n_frames, 2, 2)):
                raise ValueError
        except (TypeError, ValueError):
            raise ParameterError(
                f"centre = {one_line(centre)}; x and y are needed, or those of each beam and frame"
            ) from None
        self._centres = np.broadcast_to(centre, (source.n_frames, 2, 2))
        self._options = options | {"size": size}
        self.image_shape = source.image_shape
        if size is not None:
            self.image_shape = tuple(np.broadcast_to(size, 2).tolist())
        self.n_frames, self.n_wavelengths = source.n_frames, source.n_wavelengths
        self.names, self.has_variances = source.names, source.has_variances

    @property
    def resampling(self):
        """Mean variance of a pixel over the one that it had before it was turned."""
        shape, turns = self._source.image_shape, zip(self._angles, self._centres, strict=True)
        known = [(angle, centre) for angle, both in turns for centre in both]
        return np.mean([derotate_gain(shape, a, centre=xy, **self._options) for a, xy in known])

    def batches(self):
        """Return the frames that are read at a time, one by one."""
        return [slice(i, i + 1) for i in range(self.n_frames)]

    def fluxes(self, beam, frames, wavelengths):
        """Return the fluxes of a beam in some frames and wavelengths, (n, m, Y, X)."""
        return self._turned(derotate, self._source.fluxes, beam, frames, wavelengths)

    def variances(self, beam, frames, wavelengths):
        """Return their variances."""
        return self._turned(derotate_variance, self._source.variances, beam, frames, wavelengths)

    def _turned(self, turn, read, beam, frames, wavelengths):
        cubes = read(beam, frames, wavelengths)
        known = zip(cubes, self._angles[frames], self._centres[frames, beam], strict=True)
        return np.stack([turn(c, angle, centre=xy, **self._options) for c, angle, xy in known])


class CubeFiles(TurnedSource):
    """
    Both beams of extracted cubes (n_wavelengths, Y, X), cut out of FITS files when they are needed.

    ``centres`` are the place of one point of the sky in the right and left beam, 0-based x and y,
    (2, 2) or (n_frames, 2, 2): side by side, or, with ``left_files``, in the image of each.
    ``size`` rows and columns are cut out about it, turned north up if there are position angles.
    The other options are those of `_WholeCubes`.
    """

    def __init__(self, files, centres, size, *, position_angle=None, mirrored=False, **options):
        source = _WholeCubes([str(path) for path in files], **options)
        #: Whether variances are those of the measured flux, and not told by the files.
        self.estimated = source.has_variances and not source._has_errors
        height, width = source.image_shape
        most = _MOST_SIZE * max(height, width)
        if not 1 <= size <= most:
            raise ParameterError(
                f"size = {size}; the images are {width} x {height} pixels, allowed are 1 to {most}"
            )
        if position_angle is None:
            position_angle = np.zeros(source.n_frames) * u.deg
        options = {"centre": centres, "size": int(size), "mirrored": mirrored}
        super().__init__(source, position_angle, **options)
        x, y = self._centres[..., 0], self._centres[..., 1]
        # up to half a pixel beyond the middle of the last one
        inside = (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
        if not inside.all():
            frame, beam = np.argwhere(~inside)[0]
            raise ObservationError(
                f"{self.names[frame]}: the {('right', 'left')[beam]} beam's centre "
                f"{self._centres[frame, beam].tolist()} is outside the image of {width} x "
                f"{height} pixels"
            )


class _WholeCubes:
    """Cubes of both beams in FITS files, which are opened when they are needed.

    Inverse variances or errors (``weights``) may follow the cube's ``extension``, else those of
    the ``detectors`` count. Pixels that these call spoilt have no value. ``left_scale``
    multiplies the left beam. Of ``stacked`` files the first axis are exposures, of which the mean
    is taken.
    """

    def __init__(
        self,
        files,
        *,
        extension=1,
        left_files=None,
        left_scale=1.0,
        weights="inverse variance",
        stacked=False,
        detectors=None,
    ):
        if not files:
            raise ObservationError("no files")
        self.names, self.n_frames = files, len(files)
        left = files if left_files is None else [str(path) for path in left_files]
        self._beam_files, self._extension = (files, left), extension
        self._weights, self._stacked, self._detectors = weights, stacked, detectors
        scale = to_unit(left_scale, None, "left_scale")
        one_each = scale.shape in ((), (self.n_frames,))
        if not (one_each and np.all((scale > 0) & np.isfinite(scale))):
            raise ParameterError(
                f"left_scale = {one_line(left_scale)}; allowed are one number above zero, or one "
                f"for each of the {self.n_frames} frames"
            )
        scale = np.broadcast_to(scale, self.n_frames)
        self._scale = np.stack([np.ones(self.n_frames), scale])
        # each file once, where both beams are in one
        found = {path: _places(path, extension) for path in dict.fromkeys([*files, *left])}
        self._places = [[found[path] for path in files] for files in self._beam_files]
        shapes = {path: places[0][0] for path, places in found.items()}
        if stacked:
            # of all exposures one image is made; what has no image at all is refused below
            shapes = {path: (1, *s[1:]) if s and s[0] else s for path, s in shapes.items()}
        first = shapes[files[0]]
        for path, shape in shapes.items():
            if shape != first or len(shape) != 3 or 0 in shape:
                raise ObservationError(
                    f"{path}: a cube of shape {found[path][0][0]}; {files[0]} has {first}, and "
                    "three axes of some length are needed"
                )
        self.n_wavelengths, *image = first
        self.image_shape = tuple(image)
        self._has_errors = all(len(places) > 1 for places in found.values())
        self.has_variances = self._has_errors or detectors is not None

    def fluxes(self, beam, frames, wavelengths):
        """Return the fluxes of a beam in some frames and wavelengths, (n, m, Y, X)."""
        return self._of_frames(beam, frames, wavelengths, 1)

    def variances(self, beam, frames, wavelengths):
        """Return their variances, NaN where the weight or the error is zero or infinite."""
        return self._of_frames(beam, frames, wavelengths, 2)

    def _of_frames(self, beam, frames, wavelengths, power):
        # a damaged file may hold signalling NaNs, of which numpy warns where they are first used
        with np.errstate(divide="ignore", invalid="ignore"):
            scaled = [
                self._read(beam, i, wavelengths, power) * self._scale[beam, i] ** power
                for i in range(self.n_frames)[frames]
            ]
        return np.stack(scaled)

    def _read(self, beam, i, wavelengths, power):
        """Return the fluxes of a frame or, with a power of two, their variances."""
        if self._stacked:
            return self._mean(beam, i)[power - 1]
        if self._has_errors and power == 2:
            return self._squared(self._section(beam, i, wavelengths, 1))
        flux = self._fluxes(beam, i, wavelengths)
        return flux if power == 1 else self._detectors[i][beam].variance(flux)

    def _mean(self, beam, i):
        """Return the mean of the exposures that have a value and an error, and its variance."""
        flux, variance = self._fluxes(beam, i, slice(None)), None
        good = np.isfinite(flux)
        if self._has_errors:
            variance = self._squared(self._section(beam, i, slice(None), 1))
            good &= np.isfinite(variance)
        mean, number = mean_of_exposures(flux, good)
        if self._has_errors:
            variance = np.where(good, variance, 0.0).sum(axis=0, keepdims=True) / number**2
        elif self._detectors is not None:
            # the detector is that of a mean of all exposures
            variance = self._detectors[i][beam].variance(mean) * len(flux) / number
        return mean, variance

    def _fluxes(self, beam, i, wavelengths):
        """Return the fluxes of a file, NaN where pixels measure nothing."""
        flux = self._section(beam, i, wavelengths, 0)
        if spoilt := getattr(self._detectors and self._detectors[i][beam], "spoilt", None):
            flux[spoilt(flux)] = np.nan
        return flux

    def _squared(self, known):
        """Return variances of errors or weights: error^2 = 1 / inverse variance."""
        square = known ** (2 if self._weights == "error" else -1)
        # no measurement is without noise, nor is one that is all noise a measurement
        return np.where((known > 0) & (known < np.inf), square, np.nan)

    def _section(self, beam, i, wavelengths, offset):
        (shape, dtype, start), path = self._places[beam][i][offset], self._beam_files[beam][i]
        with understood(path, ObservationError, "cannot be read"):
            if start is not None:
                # a thousand files would take long to open, wavelength by wavelength
                return np.array(np.memmap(path, dtype, "r", start, shape)[wavelengths], dtype=float)
            with open_fits(path) as stream, fits.open(stream) as hdus:
                section = hdus[self._extension + offset].section
                if len(section.shape) == 2:
                    return np.array(section[:, :], dtype=float)[None][wavelengths]
                return np.array(section[wavelengths], dtype=float)


def _places(path, extension):
    """Return where the cube stands in a file, and the inverse variances if they follow.

    Shape, type and start of each; no start if its numbers are packed or scaled.
    """
    with readable_fits(path), open_fits(path) as stream, fits.open(stream, memmap=True) as hdus:
        if len(hdus) <= extension:
            raise ObservationError(f"{path}: no extension {extension} in it")
        packed = isinstance(stream, io.BytesIO)
        found = [_place(hdu, packed) for hdu in hdus[extension : extension + 2]]
    return found if found[-1][0] == found[0][0] else found[:1]


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
    return shape, dtype, info["datLoc"] if plain else None
