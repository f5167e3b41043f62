# Licensed under a 3-clause BSD style license - see LICENSE
"""
Keck/NIRC2, near-infrared dual-beam polarimetry (NIRC2-Pol).

A half-wave plate upstream of the K-mirror of the adaptive optics of Keck II, at its left Nasmyth
focus, and a Wollaston prism. Chain, keywords and signs are those of the public pipeline
NIRC2Pol-DPP, https://github.com/UCSB-Exoplanet-Polarimetry-Lab/NIRC2Pol-DPP (its Eq. 3: for ideal
optics Q and U are turned by -2 PARANG + 2 EL + 2 ROTPDEST + 4 offset of the plate; ROTPDEST is
twice the angle of the K-mirror on the bench). So plate, K-mirror and altitude count the other way
here than at Subaru. The offset of the plate is found on sky.

Not published, and nominal here: the retardances of plate and K-mirror (178 and 160 deg), the
tertiary mirror (aluminium), the efficiency of the prism (0.99). A model is announced as Zhang et
al. 2026; no values were public.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.instruments.base import Instrument, SkyLaw
from astropolcal.instruments.telescope import STARS, misaligned, star_source
from astropolcal.observations.pointings import location_of

__all__ = ["NIRC2"]


class NIRC2(Instrument):
    """
    Keck II/NIRC2 with half-wave plate, K-mirror and Wollaston prism.

    References
    ----------
    NIRC2Pol-DPP, https://github.com/UCSB-Exoplanet-Polarimetry-Lab/NIRC2Pol-DPP.
    No paper with a DOI was public; Lewis et al. 2026 is announced there.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> nirc2 = instruments.get("nirc2")
    >>> [optic.name for optic in nirc2.chain("star")]
    ['star', 'parallactic', 'm3', 'altitude', 'hwp', 'derotator', 'wollaston']
    """

    name = "nirc2"
    aliases = ("Keck/NIRC2", "NIRC2-Pol")
    # nominal centres of J, H and Kp; the band L has a plate of its own
    wavelength = [1.248, 1.633, 2.124] * u.um
    keywords = {
        "hwp": "PCUPR",
        "derotator": "OBRT",
        "parallactic": "PARANG",
        "altitude": "EL",
    }
    references = (
        "NIRC2Pol-DPP, https://github.com/UCSB-Exoplanet-Polarimetry-Lab/NIRC2Pol-DPP",
        "Lewis et al. 2026, announced there",
    )
    sources = ("polarized", *STARS)
    #: The plate stays where it is put; the K-mirror keeps image or pupil still, by the same signs.
    sky_law = SkyLaw(plate=(0, 0), derotator={"pupil": (0, -0.5), "field": (0.5, -0.5)})

    def chain(self, source="polarized", optics_in=(), *, wavelength=None, star="star", target=None):
        """
        Return the chain of a polarized source upstream of the plate, or of a star.

        Free are, per wavelength, the retardances of plate and K-mirror and the efficiency of the
        prism; the angles of plate and K-mirror for all wavelengths; and of stars the
        diattenuation of the tertiary mirror, whose retardance is held.

        Parameters
        ----------
        source : str
            ``"polarized"``: a polarizer upstream of the plate. Or a kind of star.
        optics_in : sequence of str
            Nothing is optional here.
        wavelength : `~astropy.units.Quantity`, optional
            By default J, H and Kp.
        star, target : str
            Name of the source optic of a star, and of the star in the catalogue.

        Returns
        -------
        `~astropy.modeling.CompoundModel`
        """
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        one = np.ones(grid.size)
        if source == "polarized":
            train = [optics.LinearPolarizer(name="polarizer")]
        else:
            train = [star_source(source, grid, star, target), *telescope(grid)]
        for stage, angle in (("hwp", 178), ("derotator", 160)):
            held = misaligned(0, 10)
            # linear polarization cannot tell 180 + x from 180 - x of the plate
            held["bounds"] |= {"retardance": (150, 180) if stage == "hwp" else (0, 360)}
            train.append(
                optics.LinearRetarder(
                    retardance=angle * one * u.deg, mount=f"-{stage}", name=stage, **held
                )
            )
        return join([*train, optics.WollastonPrism(efficiency=0.99 * one, name="wollaston")])

    def telescope_optics(self, behind, *, wavelength=None):
        """Return the telescope with a tertiary mirror of bare aluminium."""
        return telescope(self.grid(wavelength))

    sky_options = ("wavelength",)

    def setup(self, observations):
        """Return the source from the table's meta, and no optional optics."""
        return self.source_of(observations), ()

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`."""
        return location_of((-155.4747, 19.8260, 4145.0))


def telescope(grid):
    """Return the optics from the sky to the plate."""
    metal = optics.MetalMirror(material="aluminium")
    mirror = optics.DiattenuatorRetarder(
        diattenuation=metal.diattenuation(grid),
        retardance=metal.retardance(grid),
        name="m3",
        fixed={"retardance": True},
        bounds={"diattenuation": (-0.1, 0.1)},
    )
    return [
        optics.Rotator(mount="parallactic", name="parallactic"),
        mirror,
        optics.Rotator(mount="altitude", name="altitude"),
    ]
