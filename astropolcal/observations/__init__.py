# Licensed under a 3-clause BSD style license - see LICENSE
"""
The observation layer: tables of beam fluxes, pairs of frames, observables.

A calibration starts from `Observations`, a validated table of the two beam fluxes of every frame
and wavelength. It pairs the frames taken 45 degrees of half-wave plate apart, and an `Observable`
turns their fluxes into the quantity that is fitted, with its derivative and its error.
"""

from astropolcal.observations.observables import OBSERVABLES, Observable
from astropolcal.observations.pointings import location_of, pointing
from astropolcal.observations.table import Observations, example_table

__all__ = ["OBSERVABLES", "Observable", "Observations", "example_table", "location_of", "pointing"]
