# Licensed under a 3-clause BSD style license - see LICENSE
"""
Polarimetric standard stars, the Serkowski law, and which star to observe.

`get` and `search` look into the catalogue that comes with the package, `observability` says when a
star is up and at which angles, and `telescope_information` how well it then fixes the diattenuation
of the telescope. `StandardStar.interstellar` and `StandardStar.unpolarized_error` say how well the
polarization of a star is known. `SerkowskiLaw` is the wavelength dependence of interstellar
polarization as an astropy model.
"""

from astropolcal.standards import law, priors, visibility
from astropolcal.standards.law import *
from astropolcal.standards.priors import *
from astropolcal.standards.visibility import *

__all__ = sorted([*law.__all__, *priors.__all__, *visibility.__all__])
