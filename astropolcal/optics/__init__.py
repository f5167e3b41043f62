# Licensed under a 3-clause BSD style license - see LICENSE
"""
The optics of a polarimeter, each an `astropy.modeling` model.

Join them with ``|`` in the order the light travels. The classes are
registered in `OPTICS`; a new optic is one class and its entry there, and the
registry tests then hold it to the laws that all optics obey.
"""

from astropolcal.optics.beamsplitters import WollastonPrism
from astropolcal.optics.core import Optic, rotation_generator
from astropolcal.optics.depolarizers import Depolarizer
from astropolcal.optics.general import MuellerElement
from astropolcal.optics.mirrors import ParityFlip
from astropolcal.optics.polarizers import Diattenuator, DiattenuatorRetarder, LinearPolarizer
from astropolcal.optics.retarders import EllipticalRetarder, LinearRetarder, TwoLayerWaveplate
from astropolcal.optics.rotators import Rotator

__all__ = [
    "OPTICS",
    "Depolarizer",
    "Diattenuator",
    "DiattenuatorRetarder",
    "EllipticalRetarder",
    "LinearPolarizer",
    "LinearRetarder",
    "MuellerElement",
    "Optic",
    "ParityFlip",
    "Rotator",
    "TwoLayerWaveplate",
    "WollastonPrism",
    "rotation_generator",
]

#: Every optic by class name.
OPTICS = {
    cls.__name__: cls
    for cls in (
        Depolarizer,
        Diattenuator,
        DiattenuatorRetarder,
        EllipticalRetarder,
        LinearPolarizer,
        LinearRetarder,
        MuellerElement,
        ParityFlip,
        Rotator,
        TwoLayerWaveplate,
        WollastonPrism,
    )
}
