# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/HiCIAO, near-infrared polarimetric differential imaging, decommissioned.

Half-wave plate and derotator are those of CHARIS. Hashimoto (slides of the SEEDS project
on its polarimetric calibration) gives bare silver with n = 0.3 + 11.7i at 1.6 um for the tertiary
mirror, which makes 0.3 % of polarization, and three silver mirrors with silica for the derotator.
The silver of the tables here, another film, makes 0.55 % in H.
The keywords of plate, derotator and altitude are those that public code reads of its frames.

Not known, and nominal here: the efficiency of its Wollaston prism (0.985), and what the adaptive
optics do to polarized light. A double Wollaston prism gave each polarization twice: add the
fluxes of the two images.
"""

import astropy.units as u

from astropolcal import optics
from astropolcal.instruments.polarimeter import SubaruPolarimeter
from astropolcal.instruments.telescope import telescope

__all__ = []


class HiCIAO(SubaruPolarimeter):
    """
    Subaru/HiCIAO with half-wave plate, derotator and Wollaston prism.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> hiciao = instruments.get("hiciao")
    >>> mirror = hiciao.on_sky(hiciao.chain("polarized"))["m3"]
    >>> (100 * mirror.diattenuation(hiciao.wavelength)).round(2)
    array([0.65, 0.55, 0.5 ])
    """

    name = "hiciao"
    aliases = ("Subaru/HiCIAO",)
    # nominal centres of J, H and Ks
    wavelength = [1.25, 1.63, 2.15] * u.um
    references = (
        "Hashimoto, Polarimetric Calibration for Nasmyth instrument HiCIAO, slides of SEEDS",
        "'t Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833, for plate and derotator",
    )
    # it had left the telescope before anything of these changed
    changes = ()

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return the telescope with a tertiary mirror of bare silver."""
        return telescope(optics.MetalMirror(material="silver", name="m3"))
