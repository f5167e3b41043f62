# Licensed under a 3-clause BSD style license - see LICENSE
"""
Calibration: fit, mirror branches, identifiability, errors, accuracy, result.
"""

from astropolcal.calibration.accuracy import (
    accuracy_table,
    cross_validated_residuals,
    leave_out_groups,
)
from astropolcal.calibration.comparison import compare, comparison_text
from astropolcal.calibration.convergence import Convergence
from astropolcal.calibration.covariance import Covariance, full_covariance
from astropolcal.calibration.derived import Derived, propagate
from astropolcal.calibration.efficiency import (
    DEROTATOR_LAWS,
    BestDerotator,
    best_derotator,
    polarimetric_efficiency,
)
from astropolcal.calibration.errors import robust_covariance, standard_errors
from astropolcal.calibration.export import mueller_table, write_mueller
from astropolcal.calibration.fit import calibrate
from astropolcal.calibration.gauge import describe_gauge, settle
from astropolcal.calibration.goodness import LackOfFit, lack_of_fit
from astropolcal.calibration.harmonics import harmonic_conditions, harmonic_words
from astropolcal.calibration.history import Change, changes, parameter_history, significance
from astropolcal.calibration.identifiability import (
    Identifiability,
    analyse,
    complete,
    examine,
    null_space,
    physical_scale,
)
from astropolcal.calibration.library import Entry, Library
from astropolcal.calibration.loading import LoadedCalibration, SystemMueller, load
from astropolcal.calibration.log_posterior import LogPosterior
from astropolcal.calibration.mirrors import mirror_solutions
from astropolcal.calibration.noise import (
    NoiseEstimate,
    noise_from_errors,
    noise_from_replicates,
)
from astropolcal.calibration.null_channel import estimate_noise, noise_from_null_channel
from astropolcal.calibration.posterior import Posterior, autocorrelation, autocorrelation_time
from astropolcal.calibration.profiles import Profile, profile
from astropolcal.calibration.quantities import (
    derived_data,
    derived_efficiency,
    derived_mueller,
    derived_retardance,
    derived_sky,
)
from astropolcal.calibration.reflections import mirror_names, mirror_values
from astropolcal.calibration.resampling import Resampled, bootstrap
from astropolcal.calibration.restarting import restart
from astropolcal.calibration.result import Calibration, DatasetRecord
from astropolcal.calibration.robust import LOSSES, outlying_data, robust_sigma
from astropolcal.calibration.sampling import sample
from astropolcal.calibration.sky import sky_consequences
from astropolcal.calibration.standards import add_standard, standard_accuracy
from astropolcal.calibration.star_checks import add_star_check, star_check
from astropolcal.calibration.stars import star_accuracy, star_stokes
from astropolcal.calibration.starts import BinProblem, search_branches
from astropolcal.calibration.summaries import summary, to_dict
from astropolcal.calibration.targets import (
    absolute_accuracy,
    four_accuracies,
    groups_by,
    keep_sky_accuracy,
    paper_accuracies,
    propagate_accuracy,
    target_accuracies,
    target_accuracy,
)
from astropolcal.calibration.validity import Validity, content_hash, validity_of, with_validity
from astropolcal.calibration.verdicts import Verdict, verdict
from astropolcal.calibration.weighting import Weighting, noise_of, residual_noise, weighting_of

__all__ = [
    "DEROTATOR_LAWS",
    "LOSSES",
    "BestDerotator",
    "BinProblem",
    "Calibration",
    "Change",
    "Convergence",
    "Covariance",
    "DatasetRecord",
    "Derived",
    "Entry",
    "Identifiability",
    "LackOfFit",
    "Library",
    "LoadedCalibration",
    "LogPosterior",
    "NoiseEstimate",
    "Posterior",
    "Profile",
    "Resampled",
    "SystemMueller",
    "Validity",
    "Verdict",
    "Weighting",
    "absolute_accuracy",
    "accuracy_table",
    "add_standard",
    "add_star_check",
    "analyse",
    "autocorrelation",
    "autocorrelation_time",
    "best_derotator",
    "bootstrap",
    "calibrate",
    "changes",
    "compare",
    "comparison_text",
    "complete",
    "content_hash",
    "cross_validated_residuals",
    "derived_data",
    "derived_efficiency",
    "derived_mueller",
    "derived_retardance",
    "derived_sky",
    "describe_gauge",
    "estimate_noise",
    "examine",
    "four_accuracies",
    "full_covariance",
    "groups_by",
    "harmonic_conditions",
    "harmonic_words",
    "keep_sky_accuracy",
    "lack_of_fit",
    "leave_out_groups",
    "load",
    "mirror_names",
    "mirror_solutions",
    "mirror_values",
    "mueller_table",
    "noise_from_errors",
    "noise_from_null_channel",
    "noise_from_replicates",
    "noise_of",
    "null_space",
    "outlying_data",
    "paper_accuracies",
    "parameter_history",
    "physical_scale",
    "polarimetric_efficiency",
    "profile",
    "propagate",
    "propagate_accuracy",
    "residual_noise",
    "restart",
    "robust_covariance",
    "robust_sigma",
    "sample",
    "search_branches",
    "settle",
    "significance",
    "sky_consequences",
    "standard_accuracy",
    "standard_errors",
    "star_accuracy",
    "star_check",
    "star_stokes",
    "summary",
    "target_accuracies",
    "target_accuracy",
    "to_dict",
    "validity_of",
    "verdict",
    "weighting_of",
    "with_validity",
    "write_mueller",
]
