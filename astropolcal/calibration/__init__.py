# Licensed under a 3-clause BSD style license - see LICENSE
"""
Calibration: fit, mirror branches, identifiability, errors, accuracy, result.
"""

from astropolcal.calibration.accuracy import (
    accuracy_table,
    cross_validated_residuals,
    leave_out_groups,
)
from astropolcal.calibration.covariance import Covariance
from astropolcal.calibration.fit import calibrate
from astropolcal.calibration.gauge import describe_gauge, settle
from astropolcal.calibration.harmonics import harmonic_conditions, harmonic_words
from astropolcal.calibration.identifiability import (
    Identifiability,
    analyse,
    complete,
    null_space,
    physical_scale,
)
from astropolcal.calibration.mirrors import mirror_solutions
from astropolcal.calibration.result import Calibration, DatasetRecord
from astropolcal.calibration.sky import sky_consequences
from astropolcal.calibration.starts import BinProblem, search_branches
from astropolcal.calibration.summary import summary, to_dict

__all__ = [
    "BinProblem",
    "Calibration",
    "Covariance",
    "DatasetRecord",
    "Identifiability",
    "accuracy_table",
    "analyse",
    "calibrate",
    "complete",
    "cross_validated_residuals",
    "describe_gauge",
    "harmonic_conditions",
    "harmonic_words",
    "leave_out_groups",
    "mirror_solutions",
    "null_space",
    "physical_scale",
    "search_branches",
    "settle",
    "sky_consequences",
    "summary",
    "to_dict",
]
