# Licensed under a 3-clause BSD style license - see LICENSE
"""
What ASDF asks astropolcal for: schemas, tags and converters.

ASDF calls `get_extensions` and `get_resource_mappings` whenever any ASDF file is
opened, so no physics is imported here before a node of this package is read or written.
"""

import re
from importlib.resources import files

from asdf.extension import Converter, ManifestExtension
from asdf.resource import DirectoryResourceMapping

from astropolcal.converters import CALIBRATION_TAG, CALIBRATION_TAGS

__all__ = []

# of schemas, which are named by URI; tags begin with tag:astropolcal.org instead
_BASE = "asdf://astropolcal.org/astropolcal"
#: The list of all tags and the schemas they obey.
MANIFEST_URI = f"{_BASE}/manifests/astropolcal-1.0.0"

#: Module of `astropolcal.optics` in which each optic is defined. It repeats the
#: registry, so that ASDF can find a converter without importing the optics.
OPTIC_MODULES = {
    name: module
    for module, names in {
        "mirrors": "KMirror MetalMirror ParityFlip PowerLawMirror",
        "modulated": "DriftRetarder DriftRotator FerroelectricLiquidCrystal FluxGain "
        "HarmonicGain HarmonicRetarder HarmonicRotator PolarizedBackground StateAnalyser "
        "StateRetarder StrayLight",
        "perturbations": "MuellerElement Perturbation",
        "polarizers": "BeamGain Depolarizer Diattenuator DiattenuatorRetarder EllipticalRetarder "
        "LinearPolarizer LinearRetarder Rotator TwoLayerWaveplate VectorDiattenuator "
        "WollastonPrism",
        "sources": "PolarizedSource StarSource",
    }.items()
    for name in names.split()
}


def optic_tag(name):
    """Return the ASDF tag of a class of optics: ``LinearRetarder`` is ``linear_retarder``."""
    stem = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
    return f"tag:astropolcal.org:astropolcal/optics/{stem}-1.0.0"


class CalibrationConverter(Converter):
    """Convert calibrations; from any version that was read, the newest is written."""

    tags = list(CALIBRATION_TAGS)
    types = ["astropolcal.calibration.result.calibration.Calibration"]

    def select_tag(self, obj, tags, ctx):
        return CALIBRATION_TAG

    def to_yaml_tree(self, obj, tag, ctx):
        from astropolcal.converters.calibration import node_from_calibration

        return node_from_calibration(obj)

    def from_yaml_tree(self, node, tag, ctx):
        from astropolcal.converters.calibration import calibration_from_node

        return calibration_from_node(node, tag)


class OpticConverter(Converter):
    """Convert one class of optics, named by a key of `OPTIC_MODULES`."""

    tags, types = (), ()

    def __init__(self, name):
        self.name = name
        self.tags = [optic_tag(name)]
        self.types = [f"astropolcal.optics.{OPTIC_MODULES[name]}.{name}"]

    def to_yaml_tree(self, obj, tag, ctx):
        from astropolcal.converters.nodes import node_from_optic

        return node_from_optic(obj)

    def from_yaml_tree(self, node, tag, ctx):
        from astropolcal.converters.nodes import optic_from_node

        return optic_from_node(self.name, node)


class ChainConverter(Converter):
    """Leave chains to the converter of astropy's compound models, which are read as chains."""

    tags = ()
    types = ["astropolcal.optics.core.Chain"]

    def select_tag(self, obj, tags, ctx):
        return None

    def to_yaml_tree(self, obj, tag, ctx):
        from astropy.modeling import CompoundModel

        from astropolcal.converters.nodes import refuse_foreign
        from astropolcal.optics import Optic

        for optic in (model for model in obj if isinstance(model, Optic)):
            refuse_foreign(optic)
        return CompoundModel(obj.op, obj.left, obj.right, name=obj.name)

    def from_yaml_tree(self, node, tag, ctx):
        raise NotImplementedError


def get_converters():
    """Return the converters of calibrations and of chains, and one for each class of optics."""
    return [CalibrationConverter(), ChainConverter(), *map(OpticConverter, OPTIC_MODULES)]


def get_resource_mappings():
    """Return the schemas and the manifest, by their URI."""
    # wherever the package is, in a zip file too
    resources = files("astropolcal") / "resources"
    return [
        DirectoryResourceMapping(resources / kind, f"{_BASE}/{kind}/", recursive=True)
        for kind in ("schemas", "manifests")
    ]


def get_extensions():
    """Return the extension that converts optics and calibrations."""
    return [ManifestExtension.from_uri(MANIFEST_URI, converters=get_converters())]
