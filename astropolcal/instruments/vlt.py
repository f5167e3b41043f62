# Licensed under a 3-clause BSD style license - see LICENSE
"""
Dual-beam polarimeters of the VLT with a half-wave plate and a Wollaston prism.

VLT/FORS2, linear imaging and spectropolarimetry in the visible.

FORS2 stands at the Cassegrain focus. Its adapter turns with the sky, so that the sky turns
upstream of the instrument by the position angle of the instrument; the stage ``parallactic`` of
the chain has this angle, and there is no derotator. Downstream of the collimator are a half-wave
plate and a Wollaston prism.

Sources: Patat & Romaniello 2006 (the lenses of the collimator polarize; up to 1.5 % at the edges
of the field), Cikota et al. 2017 (on the axis at most 0.1 %, a function of the wavelength),
Gonzalez-Gaitan et al. 2020 (imaging in four filters).

ESO's manual (Sec. 4.6.2, as the public code https://github.com/gongsale/FORS2-INSTPOL reads it)
has angles of polarization too large by 1.54, 1.80, -1.19 and -2.89 deg in the four filters here,
because the zero of the plate depends on the wavelength: it starts at half of that with the other
sign, and is free.

Not known from these, and nominal here: the plate has 178 deg, the prism an efficiency of 0.99,
and what is polarized on the axis starts at 0. The sign of ``ESO ADA POSANG`` is taken as that of a
position angle from north to east.

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

# of the plate of NaCo: one of 4096 (deg)
_STEP = 360 / 4096
# of that of FORS2 in b_HIGH, v_HIGH, R_SPECIAL and I_BESS (deg)
_ZERO = (-0.77, -0.90, 0.595, 1.445)


class FORS2(Polarimeter):
    """
    VLT/FORS2 with its half-wave plate at any angles, and its Wollaston prism.

    Its polarized source is a polarizer upstream of the instrument, such as the prism with which
    ESO measured the zero of the plate. Free are, per wavelength, retardance and zero of the plate
    and the efficiency of the prism, and of stars what the collimator polarizes, which a polarizer
    hides.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> fors2 = instruments.get("fors2")
    >>> [optic.name for optic in fors2.chain("star")]
    ['star', 'parallactic', 'collimator', 'hwp', 'wollaston']
    """

    name = "fors2"
    aliases = ("VLT/FORS2",)
    # nominal centres of b_HIGH, v_HIGH, R_SPECIAL and I_BESS
    wavelength = [440, 557, 655, 768] * u.nm
    keywords = {
        "hwp": "ESO INS RETA2 POSANG",
        "parallactic": "ESO ADA POSANG",
        "altitude": "ESO TEL ALT",
    }
    references = (
        "Patat & Romaniello 2006, PASP 118, 146, doi:10.1086/497581",
        "Cikota et al. 2017, MNRAS 464, 4146, doi:10.1093/mnras/stw2545",
        "Gonzalez-Gaitan et al. 2020, A&A 634, A70, doi:10.1051/0004-6361/201936379",
        "FORS2-INSTPOL, https://github.com/gongsale/FORS2-INSTPOL",
    )
    entrance = "collimator"
    # M1 and M2 do not polarize on the axis
    site, focus = PARANAL, "cassegrain"

    def inner(self, source, optics_in, grid):
        """Return the collimator, the plate, whose zero is free per wavelength, and the prism."""
        zero = np.zeros(grid.size)
        collimator = optics.VectorDiattenuator(horizontal=zero, diagonal=zero, name="collimator")
        collimator.horizontal.fixed = collimator.diagonal.fixed = source == "polarized"
        theta = np.interp(grid.to_value(u.nm), self.wavelength.value, _ZERO)
        plate = turning_retarder("hwp", 178, grid, most=15, theta=theta * u.deg)
        return [collimator, plate, wollaston(grid)]


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
