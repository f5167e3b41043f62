# Licensed under a 3-clause BSD style license - see LICENSE
"""
The observation layer: tables of beam fluxes, pairs of frames, observables.

A calibration starts from `Observations`, a validated table of the two beam
fluxes of every frame and wavelength. `pair_frames` finds the frames taken 45
degrees of half-wave plate apart, and an `Observable` turns their fluxes into
the quantity that is fitted, with its derivative and its error.
"""

from astropolcal.observations.differences import (
    double_difference,
    double_sum,
    single_difference,
    single_sum,
)
from astropolcal.observations.example import example_table
from astropolcal.observations.observables import (
    OBSERVABLES,
    NormalizedDoubleDifference,
    NormalizedSingleDifference,
    NormalizedTripleDifference,
    Observable,
    PerFrameDoubleDifference,
    RatioMethod,
    get_observable,
)
from astropolcal.observations.pairing import pair_frames
from astropolcal.observations.pointings import (
    motion,
    pointing,
    sky_angles,
    sky_positions,
    smeared,
    tracked,
)
from astropolcal.observations.quality import (
    brightness,
    cycle_numbers,
    is_star,
    mask_incomplete_cycles,
    mask_saturated,
    mask_unstable_lamp,
)
from astropolcal.observations.table import Observations
from astropolcal.observations.wavelengths import SAME_WAVELENGTH, common_wavelengths

__all__ = [
    "OBSERVABLES",
    "SAME_WAVELENGTH",
    "NormalizedDoubleDifference",
    "NormalizedSingleDifference",
    "NormalizedTripleDifference",
    "Observable",
    "Observations",
    "PerFrameDoubleDifference",
    "RatioMethod",
    "brightness",
    "common_wavelengths",
    "cycle_numbers",
    "double_difference",
    "double_sum",
    "example_table",
    "get_observable",
    "is_star",
    "mask_incomplete_cycles",
    "mask_saturated",
    "mask_unstable_lamp",
    "motion",
    "pair_frames",
    "pointing",
    "single_difference",
    "single_sum",
    "sky_angles",
    "sky_positions",
    "smeared",
    "tracked",
]
