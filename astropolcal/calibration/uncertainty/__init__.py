# Licensed under a 3-clause BSD style license - see LICENSE
"""Covariances, derived quantities with errors, and refits: bootstrap, profiles, sandwich errors."""

from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.calibration.uncertainty.derived import (
    Derived,
    derived_data,
    derived_efficiency,
    derived_mueller,
    derived_retardance,
    derived_sky,
)
from astropolcal.calibration.uncertainty.refits import Resampled, robust_covariance, standard_errors

__all__ = [
    "Covariance",
    "Derived",
    "Resampled",
    "derived_data",
    "derived_efficiency",
    "derived_mueller",
    "derived_retardance",
    "derived_sky",
    "robust_covariance",
    "standard_errors",
]
