# Licensed under a 3-clause BSD style license - see LICENSE
"""
Magellan/MagAO-X, visible polarimetry with two cameras and a polarizing beam splitter.

From its handbook, https://www.magao-x.org/docs/handbook/operating/polarimetry.html, a work
in progress: a half-wave plate, a cube that sends horizontal polarization to camsci1 and vertical
to camsci2, the difference camsci2 - camsci1, and the keywords of the plate's angles. So camsci2 is
the right beam here. From the public calibration https://github.com/mileslucas/2025_magaox_polcal:
the plate stands upstream of the K-mirror, whose keyword is ``STAGEK POS``, and static retarders
downstream of it are not negligible there; no values of them are published.

Not known, and assumed here: plate and K-mirror count as at Subaru, and the tertiary mirror is bare
aluminium. The retardances (178 and 160 deg, and 0 of the static optics) and the efficiency of the
cube (0.99) are nominal. Real frames have not been seen.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.instruments.base import SkyLaw
from astropolcal.instruments.polarimeter import Polarimeter, turning_retarder, wollaston

__all__ = []


class MagAOX(Polarimeter):
    """
    Magellan/MagAO-X with half-wave plate, K-mirror and polarizing beam splitter.

    Free are, per wavelength, the retardances of plate and K-mirror and the efficiency of the cube;
    the angles of plate and K-mirror; and of stars the diattenuation of the tertiary mirror. The
    static retarder ``bench`` is fixed at 0 deg until you free it. Unequal gains of the cameras are
    the nuisance ``"beam_gain"``.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> magaox = instruments.get("MagAO-X")
    >>> [optic.name for optic in magaox.chain("star")][4:]
    ['hwp', 'derotator', 'bench', 'wollaston']
    """

    name = "magaox"
    aliases = ("MagAO-X", "Magellan/MagAO-X")
    # nominal centres of g', r', i' and z'
    wavelength = [527, 614, 762, 908] * u.nm
    keywords = {
        "hwp": "HWPTRACK SET ANGLE",
        "hwp_true": "HWPTRACK ACTUAL ANGLE",
        "derotator": "STAGEK POS",
        "parallactic": "PARANG",
    }
    references = (
        "MagAO-X handbook, https://www.magao-x.org/docs/handbook/operating/polarimetry.html",
        "Calibration of 2025, https://github.com/mileslucas/2025_magaox_polcal",
    )
    site = (-70.6926, -29.0146, 2400.0)
    #: The plate stays where it is put, the K-mirror follows as at any Nasmyth focus.
    sky_law = SkyLaw(plate=(0, 0))

    def inner(self, source, optics_in, grid):
        """Return the plate, the K-mirror, the optics of the bench and the cube."""
        still = np.zeros(grid.size) * u.deg
        return [
            turning_retarder("hwp", 178, grid),
            turning_retarder("derotator", 160, grid, bounds=(0, 360)),
            optics.LinearRetarder(retardance=still, name="bench", fixed={"retardance": True}),
            # the right beam, camsci2, has the vertical polarization
            wollaston(grid, theta=90 * u.deg),
        ]
