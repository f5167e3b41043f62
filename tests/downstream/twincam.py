# Licensed under a 3-clause BSD style license - see LICENSE
"""A package that depends on astropolcal: the instrument of docs/adding_an_instrument.rst."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.instruments import Instrument, SkyLaw
from astropolcal.observations.pointings import location_of

__all__ = ["TwinCam"]


class TwinCam(Instrument):
    """Two-filter polarimeter at the Nasmyth focus of a telescope."""

    name = "twincam"
    aliases = ("Observatory/TwinCam",)
    wavelength = [1.25, 1.63] * u.um
    keywords = {
        "hwp": "HWPANG",
        "derotator": "ROTANG",
        "parallactic": "PARANG",
        "altitude": "ALTITUDE",
    }
    references = ("Author et al. 2020, Journal 1, 1",)
    sources = ("polarized", "star")
    sky_law = SkyLaw(plate=(0.5, 1.0), derotator={"pupil": (0.0, 0.5)})

    def chain(self, source="polarized", optics_in=(), *, wavelength=None):
        self.check_choices(source, optics_in)
        size = self.grid(wavelength).size
        free = {"fixed": {"theta": False}, "bounds": {"theta": (-5, 5)}}
        if source == "polarized":
            train = [optics.LinearPolarizer(name="polarizer")]
        else:
            train = [
                optics.PolarizedSource(q=np.zeros(size), u=np.zeros(size), name="star"),
                *self.telescope_optics(),
            ]
        train += [
            optics.LinearRetarder(
                retardance=np.full(size, 175) * u.deg, mount="hwp", name="hwp", **free
            ),
            optics.LinearRetarder(
                retardance=np.full(size, 150) * u.deg, mount="derotator", name="derotator", **free
            ),
            optics.WollastonPrism(efficiency=np.full(size, 0.98), name="wollaston"),
        ]
        return join(train)

    def telescope_optics(self, behind=()):
        return [
            optics.Rotator(mount="parallactic", name="parallactic"),
            optics.MetalMirror(material="aluminium", name="m3"),
            optics.Rotator(mount="-altitude", name="altitude"),
        ]

    @property
    def location(self):
        return location_of((-70.4, -24.6, 2635.0))
