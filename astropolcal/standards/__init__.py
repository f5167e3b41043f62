# Licensed under a 3-clause BSD style license - see LICENSE
"""
Polarimetric standard stars, the Serkowski law, and which star to observe.

`get` and `search` look into the catalogue that comes with the package, `observability` says when a
star is up, and `telescope_information` how well it then fixes the telescope's diattenuation.
"""

from astropolcal.standards import law, priors, visibility
from astropolcal.standards.law import *
from astropolcal.standards.priors import *
from astropolcal.standards.visibility import *

__all__ = sorted([*law.__all__, *priors.__all__, *visibility.__all__])
