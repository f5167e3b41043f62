# Licensed under a 3-clause BSD style license - see LICENSE
"""How good a calibration is: held-out data, held-out sources, stars, and targets."""

from astropolcal.calibration.noise.scatter import groups_by
from astropolcal.calibration.validation.cross_validation import lack_of_fit
from astropolcal.calibration.validation.held_out import standard_accuracy
from astropolcal.calibration.validation.stars import star_accuracy, star_stokes
from astropolcal.calibration.validation.targets import paper_accuracies, target_accuracy

__all__ = [
    "groups_by",
    "lack_of_fit",
    "paper_accuracies",
    "standard_accuracy",
    "star_accuracy",
    "star_stokes",
    "target_accuracy",
]
