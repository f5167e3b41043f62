# Licensed under a 3-clause BSD style license - see LICENSE
"""
Keck II/NIRC2, near-infrared dual-beam polarimetry downstream of the adaptive optics.

A half-wave plate stands upstream of the K-mirror of the adaptive optics, at the Nasmyth
focus, and a Wollaston prism. Chain, keywords and signs are those of the public pipeline
NIRC2Pol-DPP, https://github.com/UCSB-Exoplanet-Polarimetry-Lab/NIRC2Pol-DPP (its Eq. 3: for ideal
optics Q and U are turned by -2 PARANG + 2 EL + 2 ROTPDEST + 4 offset of the plate; ROTPDEST is
twice the angle of the K-mirror on the bench). So plate, K-mirror and altitude count the other way
here than at Subaru. The offset of the plate is found on sky; the pipeline's log has 10.4 to 11.4
deg in J, H and Kp in June 2026, known up to 45 deg, so that it is free within half of that.

Not published, and nominal here: the retardances of plate and K-mirror (178 and 160 deg), the
tertiary mirror (aluminium), the efficiency of the prism (0.99). A model is announced as Zhang et
al. 2026; no values were public.
"""

import astropy.units as u

from astropolcal.instruments.base import SkyLaw
from astropolcal.instruments.polarimeter import (
    Polarimeter,
    turning_retarder,
    wollaston,
)

__all__ = []


class NIRC2(Polarimeter):
    """
    Keck II/NIRC2 with half-wave plate, K-mirror and Wollaston prism.

    Free are, per wavelength, the retardances of plate and K-mirror and the efficiency of the
    prism; the angles of plate and K-mirror; and of stars the diattenuation of the tertiary mirror,
    whose retardance is held.

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
    site, altitude = (-155.4747, 19.8260, 4145.0), "altitude"
    #: The plate stays where it is put; the K-mirror keeps image or pupil still, by the same signs.
    sky_law = SkyLaw(plate=(0, 0), derotator={"pupil": (0, -0.5), "field": (0.5, -0.5)})

    def inner(self, source, optics_in, grid):
        """Return the plate, the K-mirror and the prism."""
        k_mirror = turning_retarder("derotator", 160, grid, bounds=(0, 360), sign="-")
        plate = turning_retarder("hwp", 178, grid, sign="-", most=22.5)
        return [plate, k_mirror, wollaston(grid)]
