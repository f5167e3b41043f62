# Licensed under a 3-clause BSD style license - see LICENSE
"""Noise of the data, its weights, and how residuals scatter in groups."""

from astropolcal.calibration.noise.estimates import (
    noise_from_errors,
    noise_from_null_channel,
    noise_from_replicates,
    noise_from_roughness,
)
from astropolcal.calibration.noise.weighting import outlying_data

__all__ = [
    "noise_from_errors",
    "noise_from_null_channel",
    "noise_from_replicates",
    "noise_from_roughness",
    "outlying_data",
]
