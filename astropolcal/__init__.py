# Licensed under a 3-clause BSD style license - see LICENSE
"""
Polarimetric calibration with astropy models.

Every optic is an `astropy.modeling` model, a chain of optics is a compound model, and a calibration
is a fit of the chain to measurements. The names below are loaded when they are first used, so that
importing the package costs next to nothing.
"""

from astropolcal.version import version as __version__

_NAMES = {
    "calibration": ("Calibration", "calibrate", "sample"),
    "correction": ("Corrected", "ScienceFrames", "correct"),
    "gap": ("Diagnosis", "diagnose"),
    "measurement": ("Measurement", "Normal", "Tie"),
    "observations": ("Observations",),
    "pipeline": ("Library", "load"),
    "reduction": ("reduce_cubes",),
    "simulation": ("half_wave_plate_cycles", "simulate"),
}
_WHERE = {name: room for room, names in _NAMES.items() for name in names}
_ROOMS = ("instruments", "optics", "plotting")
# what only some need is found, and is not among the first names
_MORE = ("chain", "gap", "materials", "mueller", "standards")

__all__ = ["__version__", *_WHERE, *_ROOMS]


def __getattr__(name):
    from importlib import import_module

    if name in (*_ROOMS, *_MORE):
        return import_module(f"astropolcal.{name}")
    if name in _WHERE:
        return getattr(import_module(f"astropolcal.{_WHERE[name]}"), name)
    raise AttributeError(f"module 'astropolcal' has no attribute {name!r}")


def __dir__():
    # a module that has been imported is among the globals, too
    return sorted({*globals(), *_WHERE, *_ROOMS, *_MORE})
