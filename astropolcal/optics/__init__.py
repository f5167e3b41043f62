# Licensed under a 3-clause BSD style license - see LICENSE
"""
The optics of a polarimeter, each an `astropy.modeling` model.

Join them with ``|`` in the order the light travels. The classes are
registered in `OPTICS`; a new optic is one class and its entry there, and the
registry tests then hold it to the laws that all optics obey.
"""

from astropolcal.optics import core, mirrors, modulated, perturbations, polarizers, sources
from astropolcal.optics.core import *
from astropolcal.optics.mirrors import *
from astropolcal.optics.modulated import *
from astropolcal.optics.perturbations import *
from astropolcal.optics.polarizers import *
from astropolcal.optics.positions import COORDINATES
from astropolcal.optics.sources import *

_PARTS = (core, mirrors, modulated, perturbations, polarizers, sources)
__all__ = ["COORDINATES", "OPTICS", *sorted(name for part in _PARTS for name in part.__all__)]

#: Every optic by class name: all classes above but the two bases, and light, which meets no other.
OPTICS = {
    name: globals()[name]
    for name in __all__
    if not name.isupper() and name not in ("FrameOptic", "Light", "Optic")
}
