# Licensed under a 3-clause BSD style license - see LICENSE
"""Images of the beams of a dual-beam polarimeter: field stop, stars, detector."""

import astropy.units as u
import numpy as np
from astropy.stats import gaussian_fwhm_to_sigma
from scipy import ndimage
from scipy.special import erf

from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.reduction.photometry import rectangles, turned
from astropolcal.reduction.wings import HALO_BETA
from astropolcal.simulation import check_electrons
from astropolcal.units import angle_to_rad

__all__ = []

# what is simulated are both beams of a Wollaston prism
BEAMS = ("right", "left")

# three-point Gauss rule over a pixel
_NODES, _WEIGHTS = np.array([-1.0, 0.0, 1.0]) * np.sqrt(0.15), np.array([5.0, 8.0, 5.0]) / 18


class Scene:
    """Where the light of each beam falls: the shares of its flux in every pixel."""

    def __init__(self, layout, *, source, psf, fwhm, beta, halo, halo_fwhm, margin):
        left, right, width, height, angle = layout.internal_apertures
        self.shape, self.source, self.psf = layout.shape, source, psf
        self.fwhm, self.beta, self.halo, self.halo_fwhm = fwhm, beta, halo, halo_fwhm
        self.offset = np.asarray(layout.star_offset, dtype=float)
        # the field stop moves with the star from beam to beam
        # place in the left beam whose image in the right one is as far off its aperture
        self.centre = (np.add(left, right) - self.offset) / 2
        # flux of a lamp is what an aperture of the layout gets, whatever the stop
        self.area = width * height
        # margin on all sides: an aperture must not see the edge of the stop
        size = (width + 2 * margin, height + 2 * margin)
        self.boxes, self.stops = [], []
        apertures = rectangles(layout.internal_apertures, layout.shape[1:])
        places = self.centres(self.centre)
        for place, (rows, columns, weights) in zip(places, apertures, strict=True):
            stop = rectangle(layout.shape[1:], place, size, angle)
            if not stop.any():
                raise InstrumentError("internal_apertures: a beam lies outside the cube")
            if source == "internal" and np.any(stop[rows, columns][weights > 0] < 1):
                raise ParameterError(
                    f"margin = {margin:g} pixels: the field stop cuts the apertures of the layout"
                )
            # a stop fills a part of the image only; profiles are computed inside
            (box,) = ndimage.find_objects((stop > 0).astype(int))
            self.boxes.append(box)
            self.stops.append(stop[box])

    def check_places(self, centres):
        """Refuse frames whose star lies outside of the image, in either beam."""
        if self.source != "star":
            return
        rows, columns = self.shape[1:]
        for beam, places in zip(BEAMS, self.centres(centres), strict=True):
            outside = ((places < 0) | (places > (columns - 1, rows - 1))).any(axis=1)
            if outside.any():
                x, y = places[int(np.argmax(outside))]
                raise ParameterError(
                    f"the star in the {beam} beam is at ({x:.4g}, {y:.4g}), outside of the image "
                    f"of {columns} x {rows} pixels"
                )

    def centres(self, left):
        """Return the place in the right and in the left beam."""
        return np.asarray(left) + self.offset, np.asarray(left)

    def peak(self):
        """Return the largest share of a beam's light in a pixel, one per wavelength or one."""
        if self.source != "star":
            return 1 / self.area
        # in the middle of a pixel it is the largest
        box = tuple(slice(0, size) for size in self.shape[1:])
        middle = np.array(self.shape[:0:-1]) // 2
        return self._star(box, middle, self.fwhm).max(axis=(1, 2))

    def light(self, fluxes, centre, widening):
        """Return the image of both beams, in the unit of the fluxes."""
        image = np.zeros(self.shape)
        places = self.centres(centre)
        for beam, stop, box, place in zip(fluxes, self.stops, self.boxes, places, strict=True):
            if self.source == "star":
                share = stop * self._star(box, place, self.fwhm * widening)
            else:
                share = stop / self.area
            # (W, 1, 1) times (y, x) of a lamp or (W, y, x) of a star; stops may overlap
            image[(slice(None), *box)] += beam[:, None, None] * share
        return image

    def _star(self, box, place, fwhm):
        """Return the share of a star's light in the pixels of a box, (n_wavelengths, y, x)."""
        # both have the same arguments, of which a Gaussian needs fewer
        core = moffat if self.psf == "moffat" else gaussian
        share = _by_width(core, box, place, fwhm, self.beta)
        if self.halo:
            share = (1 - self.halo) * share + self.halo * _by_width(
                moffat, box, place, self.halo_fwhm, HALO_BETA
            )
        return share


def rectangle(shape, centre, size, angle):
    """Return the part of each pixel within a turned rectangle, its edges a pixel wide."""
    sides = zip(turned(shape, centre, angle), size, strict=True)
    # linear over one pixel: the area stays that of the rectangle at any angle
    return np.prod([np.clip(full / 2 - np.abs(d) + 0.5, 0, 1) for d, full in sides], axis=0)


def _by_width(profile, box, place, fwhm, beta):
    """Return a profile for each wavelength; equal widths are computed once."""
    widths, which = np.unique(fwhm, return_inverse=True)
    return np.stack([profile(box, place, width, beta) for width in widths])[which]


def gaussian(box, place, fwhm, _beta):
    """Return the exact integral over every pixel of a Gaussian of unit sum."""
    # erf(x / (sqrt 2 sigma)) / 2 is the integral of a unit Gaussian from 0 to x
    scale = np.sqrt(2) * fwhm * gaussian_fwhm_to_sigma
    parts = []
    for along, middle in zip(box, (place[1], place[0]), strict=True):
        edges = np.arange(along.start, along.stop + 1) - 0.5
        parts.append(0.5 * np.diff(erf((edges - middle) / scale)))
    return np.outer(*parts)


def moffat(box, place, fwhm, beta):
    """Return the integral over every pixel of a Moffat profile of unit sum."""
    # alpha, by which r is divided: the profile is 1/2 at r = fwhm / 2
    core = fwhm / (2 * np.sqrt(2 ** (1 / beta) - 1))
    squares = []
    for along, middle in zip(box, (place[1], place[0]), strict=True):
        # three nodes a pixel and axis, exact for the fifth degree across a pixel
        nodes = np.arange(along.start, along.stop)[:, None] + _NODES
        squares.append((nodes.ravel() - middle) ** 2)
    profile = (1 + np.add.outer(*squares) / core**2) ** -beta
    rows, columns = (size // 3 for size in profile.shape)
    # i, j: pixels; a, b: nodes within
    pixels = np.einsum("iajb,a,b->ij", profile.reshape(rows, 3, columns, 3), _WEIGHTS, _WEIGHTS)
    # integral over the plane of (1 + r^2/alpha^2)^-beta is pi alpha^2 / (beta - 1)
    return pixels * (beta - 1) / (np.pi * core**2)


def expose(light, how, response, rng):
    """
    Return the image in adu that a detector, `ReadOut`, makes of light, and inverse variances.

    Of the light in each pixel, with that of the background; without noise where ``rng`` is None.
    """
    electrons = how.gain * response * light
    # in adu^2; of the expectation, not of what was drawn, so that weights are unbiased
    variance = (how.excess_noise**2 * electrons + how.read_noise**2) / how.gain**2
    check_electrons(electrons)
    if rng is not None:
        electrons = rng.poisson(electrons)
        # each becomes an exponentially distributed number of them; F^2 = 1 + the variance of
        # what one becomes, in units of the gain squared
        extra = how.excess_noise**2 - 1
        electrons = extra * rng.gamma(electrons / extra) if extra > 0 else electrons
        electrons = electrons + how.read_noise * rng.standard_normal(light.shape)
    # in adu, as the layout gives it
    image = np.minimum(electrons / how.gain, how.saturation)
    with np.errstate(divide="ignore"):
        weight = np.where(variance > 0, 1 / variance, 0.0)
    return image.astype(np.float32), weight.astype(np.float32)


# ---- arguments -----------------------------------------------------------------------------------

# milliarcsecond in a degree, the unit of a layout's pixel scale
_MAS_PER_DEG = 3.6e6


def number(name, value, *, least=0.0, above=-np.inf, most=np.inf):
    """Return a number within its bounds, of which ``above`` is itself not allowed."""
    value = float(value)
    # NaN compares as false and is refused as well
    if not (np.isfinite(value) and least <= value <= most and value > above):
        bounds = f"above {above:g}" if above > least or above == least else f"{least:g} and above"
        raise ParameterError(f"{name} = {value:g}; allowed is {bounds}, up to {most:g}")
    return value


def per_wavelength(name, value, n_wavelengths):
    """Return numbers that are not negative, one per wavelength, shape (W,)."""
    value = np.asarray(value, dtype=float)
    if value.shape not in ((), (n_wavelengths,)) or not np.all(np.isfinite(value) & (value >= 0)):
        raise ParameterError(
            f"{name} = {value}; allowed are numbers not negative, of shape () or ({n_wavelengths},)"
        )
    return np.broadcast_to(value, (n_wavelengths,))


def pixels(name, value, layout, n_wavelengths, least=0.5):
    """Return a length on the detector in pixels, one per wavelength."""
    # a plain number, and a Quantity without a unit, are pixels already
    if isinstance(value, u.Quantity) and value.unit is not u.dimensionless_unscaled:
        if value.unit.is_equivalent(u.pix):
            value = value.to_value(u.pix)
        else:
            value = np.rad2deg(angle_to_rad(value, name)) * _MAS_PER_DEG / layout.pixel_scale
    value = per_wavelength(name, value, n_wavelengths)
    if value.min() < least:
        raise ParameterError(f"{name} = {value.min():g} pixels; allowed are {least:g} and above")
    return value
