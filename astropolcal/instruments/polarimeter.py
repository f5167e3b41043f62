# Licensed under a 3-clause BSD style license - see LICENSE
"""
What most instruments share: a chain of source or star, telescope, and what is downstream of them.

An instrument at a telescope of its own gives `Polarimeter.inner`, the optics from its entrance
on; what shares Subaru's telescope, half-wave plate and derotator is a `SubaruPolarimeter`
and gives its `SubaruPolarimeter.camera`.
"""

from abc import abstractmethod

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.instruments import telescope as shared
from astropolcal.instruments.base import Instrument, SkyLaw
from astropolcal.instruments.layout import COMMON, FileLayout
from astropolcal.observations.pointings import location_of

__all__ = []


class Polarimeter(Instrument):
    """
    An instrument whose chain is a source, or a star and the telescope, and its own optics.

    Attributes
    ----------
    site : tuple of float
        Longitude and latitude (deg) and height (m) of the telescope; empty without a site.
    focus : str
        ``"nasmyth"``, with a tertiary mirror of bare aluminium, or ``"cassegrain"``, where the sky
        turns upstream of the instrument and nothing else.
    altitude : str
        The stage of the altitude at a Nasmyth focus, with its sign.
    transforms : dict
        Of the keywords, see `~astropolcal.instruments.FileLayout`.
    times : dict
        Keywords of the time of a frame, where they are not the usual ones.
    """

    sources = ("polarized", *shared.STARS)
    sky_options = ("wavelength",)
    site, focus, altitude = (), "nasmyth", "-altitude"
    transforms, times = {}, {}
    #: The plate stays where it is put, and turns with the instrument.
    sky_law = SkyLaw(plate=(0, 0), derotator={})

    def chain(self, source=None, optics_in=(), *, wavelength=None, star="star", target=None):
        """
        Return the chain of a source upstream of the instrument or of a star, to be calibrated.

        As `Instrument.chain`. The first of ``sources`` is the default; ``"polarized"`` is a
        polarizer upstream of the instrument, ``"unpolarized"`` a lamp without one, all others are
        stars.
        """
        source = self.sources[0] if source is None else source
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        light = self.light(source, grid, star, target)
        return join([*light, *self.inner(source, optics_in, grid)])

    def light(self, source, grid, star, target):
        """Return the polarizer, or a star and the telescope."""
        if source == "polarized":
            return [optics.LinearPolarizer(name="polarizer")]
        light = shared.star_source(source, grid, star, target)
        return [light, *self.telescope_optics(wavelength=grid)]

    @abstractmethod
    def inner(self, source, optics_in, grid):
        """Return the optics from the entrance of the instrument on."""

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return the telescope of the focus."""
        if self.focus == "cassegrain":
            return [optics.Rotator(mount="parallactic", name="parallactic")]
        return shared.telescope(aluminium(self.grid(wavelength)), self.altitude)

    @property
    def headers(self):
        """Layout that reads the headers of frames."""
        keywords = {key: word for key, word in COMMON.items() if key != "exposure_time"}
        return FileLayout(
            keywords | self.keywords | self.times, (1, 1, 1), transforms=self.transforms
        )

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`, or None."""
        return location_of(self.site) if self.site else None


class SubaruPolarimeter(Polarimeter):
    """
    What stands downstream of Subaru's tertiary mirror, half-wave plate and derotator.

    Sources are those of the calibration unit upstream of the plate, and stars. Free are what is
    free of CHARIS, from the same starts.
    """

    sources = (*shared.INTERNAL, *shared.STARS)
    sky_options = ()
    site = shared.SITE
    changes = shared.CHANGES
    keywords = {
        "hwp": "RET-ANG1",
        "hwp_true": "RET-POS1",
        "derotator": "D_IMRANG",
        "altitude": "ALTITUDE",
    }
    times = {"mjd": "MJD", "time": "UT"}
    sky_law = SkyLaw()

    def light(self, source, grid, star, target):
        """Return the internal source, or a star and the telescope."""
        return shared.entrance(source, grid, star, target, "free")

    def inner(self, source, optics_in, grid):
        """Return the half-wave plate, the derotator and the camera."""
        plate = shared.two_layer_plate(**shared.misaligned(0))
        return [plate, shared.published_derotator(grid), *self.camera(optics_in, grid)]

    def camera(self, optics_in, grid):
        """Return the optics downstream of the derotator, here a Wollaston prism."""
        return [optics.WollastonPrism(efficiency=np.full(grid.size, 0.985), name="wollaston")]

    def telescope_optics(self, behind=(), **options):
        """Return the telescope with the tertiary mirror that is published."""
        return shared.telescope(shared.published_mirror())


def aluminium(grid):
    """Return a tertiary mirror whose diattenuation, at first that of aluminium, is free."""
    metal = optics.MetalMirror(material="aluminium")
    return optics.DiattenuatorRetarder(
        diattenuation=metal.diattenuation(grid),
        retardance=metal.retardance(grid),
        name="m3",
        fixed={"retardance": True},
        bounds={"diattenuation": (-0.1, 0.1)},
    )


def diattenuator(name, grid, horizontal=0.0, diagonal=0.0):
    """Return optics that polarize along a direction of their own, free per wavelength."""
    values = {"horizontal": horizontal, "diagonal": diagonal}
    values = {key: np.full(grid.size, value) for key, value in values.items()}
    return optics.VectorDiattenuator(name=name, **values)


def turning_retarder(
    stage, retardance, grid, *, bounds=(150, 180), sign="", about=0.0, most=10, **more
):
    """Return a retarder on a stage, free in its angle and, per wavelength, its retardance (deg)."""
    held = shared.misaligned(about, most) | {"theta": about * u.deg} | more
    # linear polarization cannot tell 180 + x from 180 - x of a half-wave plate
    held["bounds"] |= {"retardance": bounds}
    values = np.full(grid.size, retardance, dtype=float) * u.deg
    return optics.LinearRetarder(retardance=values, mount=sign + stage, name=stage, **held)


def wollaston(grid, **settings):
    """Return a prism of nominal efficiency, free per wavelength."""
    return optics.WollastonPrism(efficiency=np.full(grid.size, 0.99), name="wollaston", **settings)
