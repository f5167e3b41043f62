# Licensed under a 3-clause BSD style license - see LICENSE
"""How good a calibration is: held-out data, held-out sources, stars, and targets."""

from astropolcal.calibration.validation.cross_validation import lack_of_fit
from astropolcal.calibration.validation.stars import star_accuracy, star_stokes
from astropolcal.calibration.validation.targets import paper_accuracies

__all__ = ["lack_of_fit", "paper_accuracies", "star_accuracy", "star_stokes"]
