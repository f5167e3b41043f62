# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/SCExAO/Fast-PDI, near-infrared polarimetry with a fast camera.

Half-wave plate and derotator are those of CHARIS. The public pipeline fastpdi_dpp,
https://github.com/scexao-org/fastpdi_dpp, has a polarizing beam splitter, a liquid crystal that
may be out of the beam, and the bands Y, J and H. The constants in its model carry the names of
filters of VAMPIRES and are not taken.

Not known, and nominal here: the liquid crystal has half a wave and switches by 45 deg, the beam
splitter an efficiency of 0.985. What the bench does to polarized light, with the quarter-wave
plates that the pipeline's model has upstream of the liquid crystal, is not known and left out,
and what the Nasmyth beam switcher changed. The retardance of the derotator in Y starts at its
published value at 1.16 um.
"""

import astropy.units as u

from astropolcal.instruments.polarimeter import SubaruPolarimeter
from astropolcal.instruments.vampires import VAMPIRES, liquid_crystal

__all__ = []


class FastPDI(SubaruPolarimeter):
    """
    Subaru/SCExAO/Fast-PDI with or without its liquid crystal.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> chain = instruments.get("fastpdi").chain("polarized", ["flc"])
    >>> [optic.name for optic in chain]
    ['calibration_polarizer', 'hwp', 'derotator', 'flc', 'wollaston']
    """

    name = "fastpdi"
    aliases = ("Fast-PDI", "SCExAO/FastPDI", "Subaru/SCExAO/FastPDI")
    # nominal centres of Y, J and H
    wavelength = [1.03, 1.24, 1.63] * u.um
    keywords = SubaruPolarimeter.keywords | {"flc_state": "U_FLCSTT"}
    references = (
        "fastpdi_dpp, https://github.com/scexao-org/fastpdi_dpp",
        "'t Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833, for plate and derotator",
    )
    optional_optics = ("flc",)
    # what tables say of a liquid crystal is the same
    setup, meta_without = VAMPIRES.setup, VAMPIRES.meta_without

    def camera(self, optics_in, grid):
        """Return the liquid crystal, where it is in, and the beam splitter."""
        crystal = [liquid_crystal(grid.size, switching=45)] if "flc" in optics_in else []
        return [*crystal, *super().camera(optics_in, grid)]
