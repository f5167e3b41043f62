# Licensed under a 3-clause BSD style license - see LICENSE
"""
Figures of a calibration and of a diagnosis.

Every function returns a `~matplotlib.figure.Figure` and leaves pyplot alone,
so that figures can be made in a pipeline without a window system. Matplotlib
is imported when the first figure is drawn.
"""

from astropolcal.plotting.accuracy import plot_accuracy
from astropolcal.plotting.comparison import plot_comparison
from astropolcal.plotting.correlations import plot_correlations
from astropolcal.plotting.differences import plot_double_differences
from astropolcal.plotting.effects import plot_cause_map, plot_effect_sizes
from astropolcal.plotting.efficiency import plot_derotator_offsets, plot_polarimetric_efficiency
from astropolcal.plotting.gap import plot_gap_frames, plot_gap_maps, plot_gap_spectrum, plot_where
from astropolcal.plotting.history import plot_history
from astropolcal.plotting.identifiability import plot_identifiability
from astropolcal.plotting.mirrors import plot_mirrors
from astropolcal.plotting.parameters import (
    plot_efficiency,
    plot_parameters,
    plot_retardances,
)
from astropolcal.plotting.posterior import plot_corner, plot_traces
from astropolcal.plotting.residuals import plot_residuals
from astropolcal.plotting.saving import save_all
from astropolcal.plotting.standards import plot_observability
from astropolcal.plotting.star_check import plot_star_check
from astropolcal.plotting.targets import plot_target_accuracy

__all__ = [
    "plot_accuracy",
    "plot_cause_map",
    "plot_comparison",
    "plot_corner",
    "plot_correlations",
    "plot_derotator_offsets",
    "plot_double_differences",
    "plot_effect_sizes",
    "plot_efficiency",
    "plot_gap_frames",
    "plot_gap_maps",
    "plot_gap_spectrum",
    "plot_history",
    "plot_identifiability",
    "plot_mirrors",
    "plot_observability",
    "plot_parameters",
    "plot_polarimetric_efficiency",
    "plot_residuals",
    "plot_retardances",
    "plot_star_check",
    "plot_target_accuracy",
    "plot_traces",
    "plot_where",
    "save_all",
]
