# Licensed under a 3-clause BSD style license - see LICENSE
"""
The optics of a polarimeter, each an `astropy.modeling` model.

Join them with ``|`` in the order the light travels. The classes are
registered in `OPTICS`; a new optic is one class and its entry there, and the
registry tests then hold it to the laws that all optics obey.
"""

from astropolcal.optics.core import Optic
from astropolcal.optics.mirrors import KMirror, MetalMirror, ParityFlip, PowerLawMirror
from astropolcal.optics.modulated import (
    DriftRetarder,
    DriftRotator,
    FerroelectricLiquidCrystal,
    FluxGain,
    FrameOptic,
    HarmonicGain,
    HarmonicRetarder,
    HarmonicRotator,
    PolarizedBackground,
    StateAnalyser,
    StateRetarder,
    StrayLight,
)
from astropolcal.optics.perturbations import MuellerElement, Perturbation
from astropolcal.optics.polarizers import (
    BeamGain,
    Depolarizer,
    Diattenuator,
    DiattenuatorRetarder,
    LinearPolarizer,
    VectorDiattenuator,
    WollastonPrism,
)
from astropolcal.optics.positions import COORDINATES
from astropolcal.optics.retarders import (
    EllipticalRetarder,
    LinearRetarder,
    Rotator,
    TwoLayerWaveplate,
)
from astropolcal.optics.sources import Light, PolarizedSource, StarSource

__all__ = [
    "COORDINATES",
    "OPTICS",
    "BeamGain",
    "Depolarizer",
    "Diattenuator",
    "DiattenuatorRetarder",
    "DriftRetarder",
    "DriftRotator",
    "EllipticalRetarder",
    "FerroelectricLiquidCrystal",
    "FluxGain",
    "FrameOptic",
    "HarmonicGain",
    "HarmonicRetarder",
    "HarmonicRotator",
    "KMirror",
    "Light",
    "LinearPolarizer",
    "LinearRetarder",
    "MetalMirror",
    "MuellerElement",
    "Optic",
    "ParityFlip",
    "Perturbation",
    "PolarizedBackground",
    "PolarizedSource",
    "PowerLawMirror",
    "Rotator",
    "StarSource",
    "StateAnalyser",
    "StateRetarder",
    "StrayLight",
    "TwoLayerWaveplate",
    "VectorDiattenuator",
    "WollastonPrism",
]

#: Every optic by class name: all classes above but the two bases, and light, which meets no other.
OPTICS = {
    name: globals()[name]
    for name in __all__
    if not name.isupper() and name not in ("FrameOptic", "Light", "Optic")
}
