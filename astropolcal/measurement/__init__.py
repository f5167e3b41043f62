# Licensed under a 3-clause BSD style license - see LICENSE
"""Chains and observations as one fittable model with an analytic Jacobian."""

from astropolcal.measurement.model import Measurement
from astropolcal.measurement.parameters import Normal, Tie, parameter_table

__all__ = ["Measurement", "Normal", "Tie", "parameter_table"]
