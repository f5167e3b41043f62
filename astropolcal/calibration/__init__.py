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
from astropolcal.calibration.identifiability import (
    Identifiability,
    analyse,
    null_space,
    physical_scale,
)
from astropolcal.calibration.result import Calibration, DatasetRecord
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
    "cross_validated_residuals",
    "describe_gauge",
    "leave_out_groups",
    "null_space",
    "physical_scale",
    "search_branches",
    "settle",
    "summary",
    "to_dict",
]
