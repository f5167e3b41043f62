# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibration: fit, identifiability, errors, accuracy, result and posterior of an instrument."""

from astropolcal.calibration.fit.calibrate import calibrate
from astropolcal.calibration.fit.runs import RunsCalibration, calibrate_runs
from astropolcal.calibration.identifiability.analysis import examine
from astropolcal.calibration.posterior.sampler import sample
from astropolcal.calibration.result.calibration import Calibration, with_validity
from astropolcal.calibration.result.comparison import compare
from astropolcal.calibration.uncertainty.derived import propagate
from astropolcal.calibration.uncertainty.refits import bootstrap, profile
from astropolcal.calibration.validation.cross_validation import add_standard
from astropolcal.calibration.validation.stars import fitted_stars, star_check
from astropolcal.calibration.validation.targets import target_accuracies

__all__ = [
    "Calibration",
    "RunsCalibration",
    "add_standard",
    "bootstrap",
    "calibrate",
    "calibrate_runs",
    "compare",
    "examine",
    "fitted_stars",
    "profile",
    "propagate",
    "sample",
    "star_check",
    "target_accuracies",
    "with_validity",
]
