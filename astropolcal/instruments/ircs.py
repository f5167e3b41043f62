# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/IRCS, near-infrared dual-beam imaging and spectropolarimetry with adaptive optics.

Half-wave plate and derotator are those of CHARIS, in the wave plate unit of the Nasmyth
platform. Its plate for 2 to 5 um (described in a paper of the polarimetric mode of IRCS in the
thermal infrared, with efficiencies of 90 to 98 %) is another one and not included.

Not known, and nominal here: the efficiency of its Wollaston prism (0.985), what the adaptive
optics and the camera do to polarized light, and what the Nasmyth beam switcher changed for it. The
keywords are those of the same plate and derotator in CHARIS; headers of IRCS have not been seen.
"""

import astropy.units as u

from astropolcal.instruments.polarimeter import SubaruPolarimeter

__all__ = []


class IRCS(SubaruPolarimeter):
    """
    Subaru/IRCS with the half-wave plate for J, H and K.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> [optic.name for optic in instruments.get("ircs").chain("unpolarized")]
    ['fold_mirror', 'hwp', 'derotator', 'wollaston']
    """

    name = "ircs"
    aliases = ("Subaru/IRCS",)
    # nominal centres of J, H and K
    wavelength = [1.25, 1.63, 2.20] * u.um
    references = (
        "Thermal-infrared adaptive optics imaging- and spectro-polarimetry with IRCS, on another "
        "plate of the same unit",
        "'t Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833, for plate and derotator",
    )
