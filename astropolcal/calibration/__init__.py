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
from astropolcal.calibration.identifiability import Identifiability, analyse
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
    "leave_out_groups",
    "search_branches",
    "summary",
    "to_dict",
]
