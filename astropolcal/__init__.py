# Licensed under a 3-clause BSD style license - see LICENSE
"""
Polarimetric calibration with astropy models.

Every optic is an `astropy.modeling` model, a chain of optics is a compound
model, and a calibration is a fit of the chain to measurements. The names
below are loaded when they are first used, so that importing the package
costs next to nothing.
"""

from astropolcal.version import version as __version__

__all__ = [
    "Calibration",
    "Observations",
    "__version__",
    "calibrate",
    "correct",
    "instruments",
    "optics",
]

_WHERE = {
    "Calibration": "astropolcal.calibration",
    "Observations": "astropolcal.observations",
    "calibrate": "astropolcal.calibration",
    "correct": "astropolcal.correction",
    "instruments": None,
    "optics": None,
}


def __getattr__(name):
    if name not in _WHERE:
        raise AttributeError(f"module 'astropolcal' has no attribute {name!r}")
    from importlib import import_module

    module = _WHERE[name]
    return getattr(import_module(module), name) if module else import_module(f"astropolcal.{name}")


def __dir__():
    return sorted([*globals(), *_WHERE])
