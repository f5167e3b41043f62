# Licensed under a 3-clause BSD style license - see LICENSE
"""
VLT/NaCo, near-infrared dual-beam polarimetry at a Nasmyth focus, decommissioned.

The adapter turns the whole instrument downstream of the tertiary mirror M3, so that there is no
derotator in the beam. Half-wave plate and Wollaston prism are in the instrument, upstream of the
plate M3 and the mirrors of the adaptive optics. Witzel et al. (2011) find up to 4 % of
instrumental polarization in Ks, from bare aluminium on M3 and what is downstream of it, and an
angle of the plate of 13.2 deg off the header until autumn 2009; a measurement in Proc. SPIE 9147,
87 (2014) finds 1.8 +/- 0.5 deg.

``ESO INS ADC1 ENC`` is the encoder of the plate, 4096 steps a turn from 205 steps below zero
(NACO manual, as the public pipeline PIPPIN reads it, https://github.com/samderegt/PIPPIN-NACO).
``ESO ADA POSANG`` is the position angle of the instrument.

Not known, and assumed or nominal here: the signs of these angles, the retardance of the plate
(178 deg), the efficiency of the prism (0.99). The mirrors downstream of M3, which do not turn
against the plate, are one diattenuator that starts at 0. Wire grids instead of the prism are not
included.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.instruments.polarimeter import (
    Polarimeter,
    aluminium,
    turning_retarder,
    wollaston,
)
from astropolcal.instruments.telescope import PARANAL, STARS

__all__ = []

_STEP = 360 / 4096


class NaCo(Polarimeter):
    """
    VLT/NaCo with half-wave plate and Wollaston prism, observing stars.

    Free are, per wavelength, the diattenuation of M3, that of the mirrors downstream of it, the
    retardance of the plate and the efficiency of the prism; and the angle of the plate, within
    20 deg, as it was once 13 deg off.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> naco = instruments.get("VLT/NACO")
    >>> [optic.name for optic in naco.chain("star")][1:]
    ['parallactic', 'm3', 'adapter', 'position_angle', 'mirrors', 'hwp', 'wollaston']
    """

    name = "naco"
    aliases = ("VLT/NaCo", "NAOS+CONICA")
    # nominal centres of J, H and Ks
    wavelength = [1.265, 1.66, 2.18] * u.um
    keywords = {
        "hwp": "ESO INS ADC1 ENC",
        "parallactic": "ESO TEL PARANG START",
        "altitude": "ESO TEL ALT",
        "position_angle": "ESO ADA POSANG",
    }
    transforms = {"hwp": (_STEP, 205 * _STEP)}
    references = (
        "Witzel et al. 2011, A&A 525, A130, doi:10.1051/0004-6361/201015009",
        "Characterizing instrumental effects on polarization at a Nasmyth focus using NaCo, 2014, "
        "Proc. SPIE 9147, 87",
    )
    sources = STARS
    entrance = "mirrors"
    site = PARANAL

    def inner(self, source, optics_in, grid):
        """Return the mirrors of the instrument, the plate and the prism."""
        zero = np.zeros(grid.size)
        mirrors = optics.VectorDiattenuator(horizontal=zero, diagonal=zero, name="mirrors")
        return [mirrors, turning_retarder("hwp", 178, grid, most=20), wollaston(grid)]

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return M3 of aluminium, and the adapter, which keeps the sky at the position angle."""
        return [
            optics.Rotator(mount="parallactic", name="parallactic"),
            aluminium(self.grid(wavelength)),
            # a mirror turns the sense of the angles
            optics.Rotator(mount="parallactic", name="adapter"),
            optics.Rotator(mount="-position_angle", name="position_angle"),
        ]
