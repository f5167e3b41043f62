# Licensed under a 3-clause BSD style license - see LICENSE
"""
Gemini South/GPI, near-infrared dual-beam polarimetry at the straight Cassegrain focus.

It turns with the telescope, so that the sky turns upstream of it by the parallactic angle, and
there is no derotator. The half-wave plate is downstream of the adaptive optics, the Wollaston
prism downstream of the lenslets (Perrin et al. 2015). What polarizes is all upstream of the plate:
Wiktorowicz et al. (2014) measured how unpolarized light leaves it in the band H. Millar-Blanchaer
et al. (2016) find it to be the same at all wavelengths within their errors.

The public pipeline, https://github.com/geminiplanetimager/gpi_pipeline, gives keywords and signs
(primitive ``gpi_combine_polarization_sequence``): the sky is turned by ``PAR_ANG`` and the plate
stands at ``WPANGLE`` + 29.14 deg. It has the retardances of the plate measured in the laboratory,
within 7 deg of half a wave. Both are starts here, and free. That of K2 is above half a wave, and
starts as far below it: linear polarization does not tell the two apart.

Not known from these, and nominal here: the efficiency of the prism, 0.99.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import replace_optic
from astropolcal.instruments.polarimeter import Polarimeter, turning_retarder, wollaston
from astropolcal.instruments.telescope import STARS

__all__ = []

# Wiktorowicz et al. 2014: Q, U and V of unpolarized light that leaves telescope and optics
_POLARIZANCE = (-0.00037, 0.004338, -0.0664)
# of the public pipeline: retardances in Y, J, H, K1 and K2, and the angle of the plate (deg)
_RETARDANCE, _ZERO = (178.9, 175.6, 172.9, 178.5, 175.8), 29.14


class GPI(Polarimeter):
    """
    Gemini Planet Imager with half-wave plate and Wollaston prism, observing stars.

    Free are, per wavelength, the linear diattenuation of all that is upstream of the plate, the
    retardance of the plate and the efficiency of the prism; and the angle of the plate.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> gpi = instruments.get("gpi")
    >>> [optic.name for optic in gpi.chain("star")]
    ['star', 'parallactic', 'telescope_and_ao', 'hwp', 'wollaston']
    >>> (100 * gpi.published()["telescope_and_ao"].mueller()[1:, 0]).round(4).tolist()
    [-0.037, 0.4338, -6.64]
    """

    name = "gpi"
    aliases = ("Gemini/GPI",)
    # nominal centres of Y, J, H, K1 and K2
    wavelength = [1.05, 1.24, 1.65, 2.05, 2.26] * u.um
    keywords = {"hwp": "WPANGLE", "parallactic": "PAR_ANG"}
    references = (
        "Wiktorowicz et al. 2014, Proc. SPIE 9147, arXiv:1407.2505",
        "Perrin et al. 2015, ApJ 799, 182, arXiv:1407.2495",
        "Millar-Blanchaer et al. 2016, Proc. SPIE 9908, 990836, arXiv:1609.08691",
        "GPI data pipeline, https://github.com/geminiplanetimager/gpi_pipeline",
    )
    sources = STARS
    entrance = "telescope_and_ao"
    # what the telescope polarizes is published together with the instrument
    site, focus = (-70.7366, -30.2407, 2722.0), "cassegrain"

    def inner(self, source, optics_in, grid):
        """Return what is upstream of the plate, the plate and the prism."""
        q, u_ = (np.full(grid.size, value) for value in _POLARIZANCE[:2])
        upstream = optics.VectorDiattenuator(horizontal=q, diagonal=u_, name="telescope_and_ao")
        retardance = np.interp(grid.to_value(u.um), self.wavelength.value, _RETARDANCE)
        plate = turning_retarder("hwp", retardance, grid, about=_ZERO, most=30)
        return [upstream, plate, wollaston(grid)]

    def published(self):
        """
        Return the chain of a star with the published polarization, of circular light too.

        A diattenuator with that polarizance has a known matrix (Lu & Chipman 1996).
        """
        vector = np.array(_POLARIZANCE)
        size = np.linalg.norm(vector)
        root, axis = np.sqrt(1 - size**2), vector / size
        matrix = np.eye(4)
        matrix[0, 1:] = matrix[1:, 0] = vector
        matrix[1:, 1:] = root * np.eye(3) + (1 - root) * np.outer(axis, axis)
        upstream = optics.MuellerElement.from_matrix(matrix, name="telescope_and_ao")
        return replace_optic(self.chain("star"), "telescope_and_ao", upstream)

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {"instrument": "gpi", "source": "star"}
