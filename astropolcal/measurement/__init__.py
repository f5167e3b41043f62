# Licensed under a 3-clause BSD style license - see LICENSE
"""
Chains and observations as one fittable model with an analytic Jacobian.
"""

from astropolcal.measurement.model import Measurement
from astropolcal.measurement.parameters import FreeParameters, Slot, Tie, parameter_table
from astropolcal.measurement.priors import BoundPrior, Normal, Uniform, bind_prior

__all__ = [
    "BoundPrior",
    "FreeParameters",
    "Measurement",
    "Normal",
    "Slot",
    "Tie",
    "Uniform",
    "bind_prior",
    "parameter_table",
]
