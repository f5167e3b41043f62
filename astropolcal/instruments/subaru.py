# Licensed under a 3-clause BSD style license - see LICENSE
"""
Instruments at Subaru's telescope that share the half-wave plate and derotator of CHARIS.

HiCIAO, decommissioned: Hashimoto (slides of the SEEDS project on its polarimetric calibration)
gives bare silver with n = 0.3 + 11.7i at 1.6 um for the tertiary mirror, which makes 0.3 % of
polarization, and three silver mirrors with silica for the derotator. The silver of the tables
here, another film, makes 0.55 % in H. The keywords of plate, derotator and altitude are those that
public code reads of its frames. Not known, and nominal here: the efficiency of its Wollaston prism
(0.985), and what the adaptive optics do to polarized light. A double Wollaston prism gave each
polarization twice: add the fluxes of the two images.

IRCS, imaging and spectropolarimetry with adaptive optics: plate and derotator are in the wave plate
unit of the Nasmyth platform. Its plate for 2 to 5 um (described in a paper of the polarimetric mode
of IRCS in the thermal infrared, with efficiencies of 90 to 98 %) is another one and not included.
Not known, and nominal here: the efficiency of its Wollaston prism (0.985), what the adaptive optics
and the camera do to polarized light, and what the Nasmyth beam switcher changed for it. The
keywords are those of the same plate and derotator in CHARIS; headers of IRCS have not been seen.

SCExAO/Fast-PDI, polarimetry with a fast camera: the public pipeline fastpdi_dpp,
https://github.com/scexao-org/fastpdi_dpp, has a polarizing beam splitter, a liquid crystal that
may be out of the beam, and the bands Y, J and H. The constants in its model carry the names of
filters of VAMPIRES and are not taken. Not known, and nominal here: the liquid crystal has half a
wave and switches by 45 deg, the beam splitter an efficiency of 0.985. What the bench does to
polarized light, with the quarter-wave plates that the pipeline's model has upstream of the liquid
crystal, is not known and left out, and what the Nasmyth beam switcher changed.

SCExAO/REACH, the spectrograph IRD at high resolution, fed by single-mode fibres: the public
pipeline pyird, https://github.com/prvjapan/pyird, has their spectra in Y, J and H. Nothing was
found in public about its polarimetry. Assumed here: two fibres with the two polarizations of a
beam splitter downstream of the derotator, of efficiency 0.985. What fibres and bench do to
polarized light is not known and left out, and what the Nasmyth beam switcher changed.

The retardance of the derotator in Y starts at its published value at 1.16 um in both of SCExAO.
"""

import astropy.units as u

from astropolcal import optics
from astropolcal.instruments.base import SubaruPolarimeter
from astropolcal.instruments.telescope import telescope
from astropolcal.instruments.vampires import VAMPIRES, liquid_crystal

__all__ = []

_PLATE_AND_DEROTATOR = (
    "'t Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833, for plate and derotator"
)


class HiCIAO(SubaruPolarimeter):
    """Subaru/HiCIAO with half-wave plate, derotator and Wollaston prism."""

    name = "hiciao"
    aliases = ("Subaru/HiCIAO",)
    # nominal centres of J, H and Ks
    wavelength = [1.25, 1.63, 2.15] * u.um
    references = (
        "Hashimoto, Polarimetric Calibration for Nasmyth instrument HiCIAO, slides of SEEDS",
        _PLATE_AND_DEROTATOR,
    )
    # it had left the telescope before anything of these changed
    changes = ()

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return the telescope with a tertiary mirror of bare silver."""
        return telescope(optics.MetalMirror(material="silver", name="m3"))


class IRCS(SubaruPolarimeter):
    """Subaru/IRCS with the half-wave plate for J, H and K."""

    name = "ircs"
    aliases = ("Subaru/IRCS",)
    # nominal centres of J, H and K
    wavelength = [1.25, 1.63, 2.20] * u.um
    references = (
        "Thermal-infrared adaptive optics imaging- and spectro-polarimetry with IRCS, on another "
        "plate of the same unit",
        _PLATE_AND_DEROTATOR,
    )


class FastPDI(SubaruPolarimeter):
    """Subaru/SCExAO/Fast-PDI with or without its liquid crystal."""

    name = "fastpdi"
    aliases = ("Fast-PDI", "SCExAO/FastPDI", "Subaru/SCExAO/FastPDI")
    # nominal centres of Y, J and H
    wavelength = [1.03, 1.24, 1.63] * u.um
    keywords = SubaruPolarimeter.keywords | {"flc_state": "U_FLCSTT"}
    references = (
        "fastpdi_dpp, https://github.com/scexao-org/fastpdi_dpp",
        _PLATE_AND_DEROTATOR,
    )
    optional_optics = ("flc",)
    # what tables say of a liquid crystal is the same
    setup, meta_without = VAMPIRES.setup, VAMPIRES.meta_without

    def camera(self, optics_in, grid):
        """Return the liquid crystal, where it is in, and the beam splitter."""
        crystal = [liquid_crystal(grid.size, switching=45)] if "flc" in optics_in else []
        return [*crystal, *super().camera(optics_in, grid)]


class REACH(SubaruPolarimeter):
    """
    Subaru/SCExAO/REACH; its wavelengths here are one for each band.

    Unequal throughputs of the two fibres are the nuisance ``"beam_gain"``.
    """

    name = "reach"
    aliases = ("SCExAO/REACH", "Subaru/SCExAO/REACH")
    wavelength = [1.05, 1.25, 1.60] * u.um
    references = (
        "pyird, https://github.com/prvjapan/pyird",
        _PLATE_AND_DEROTATOR,
    )
