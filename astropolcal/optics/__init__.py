# Licensed under a 3-clause BSD style license - see LICENSE
"""
The optics of a polarimeter, each an `astropy.modeling` model.

Join them with ``|`` in the order the light travels. The classes are
registered in `OPTICS`; a new optic is one class and its entry there, and the
registry tests then hold it to the laws that all optics obey.
"""

from astropolcal.optics.beamsplitters import BeamGain, WollastonPrism
from astropolcal.optics.core import COORDINATES, Optic, rotation_generator
from astropolcal.optics.depolarizers import Depolarizer
from astropolcal.optics.derotators import KMirror
from astropolcal.optics.fluxes import FluxGain, PolarizedBackground, StrayLight
from astropolcal.optics.general import MuellerElement
from astropolcal.optics.mirrors import MetalMirror, ParityFlip, PowerLawMirror
from astropolcal.optics.modulated import (
    DriftRetarder,
    DriftRotator,
    FrameOptic,
    HarmonicGain,
    HarmonicRetarder,
    HarmonicRotator,
)
from astropolcal.optics.modulators import FerroelectricLiquidCrystal
from astropolcal.optics.perturbations import GENERATORS, Dependence, Perturbation
from astropolcal.optics.polarizers import (
    Diattenuator,
    DiattenuatorRetarder,
    LinearPolarizer,
    VectorDiattenuator,
)
from astropolcal.optics.retarders import EllipticalRetarder, LinearRetarder, TwoLayerWaveplate
from astropolcal.optics.rotators import Rotator
from astropolcal.optics.sources import PolarizedSource, StarSource

__all__ = [
    "COORDINATES",
    "GENERATORS",
    "OPTICS",
    "BeamGain",
    "Dependence",
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
    "StrayLight",
    "TwoLayerWaveplate",
    "VectorDiattenuator",
    "WollastonPrism",
    "rotation_generator",
]

#: Every optic by class name.
OPTICS = {
    cls.__name__: cls
    for cls in (
        BeamGain,
        Depolarizer,
        Diattenuator,
        DiattenuatorRetarder,
        DriftRetarder,
        DriftRotator,
        EllipticalRetarder,
        FerroelectricLiquidCrystal,
        FluxGain,
        HarmonicGain,
        HarmonicRetarder,
        HarmonicRotator,
        KMirror,
        LinearPolarizer,
        LinearRetarder,
        MetalMirror,
        MuellerElement,
        ParityFlip,
        Perturbation,
        PolarizedBackground,
        PolarizedSource,
        PowerLawMirror,
        Rotator,
        StarSource,
        StrayLight,
        TwoLayerWaveplate,
        VectorDiattenuator,
        WollastonPrism,
    )
}
