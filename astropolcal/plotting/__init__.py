# Licensed under a 3-clause BSD style license - see LICENSE
"""
Figures of a calibration and of a diagnosis.

Every function returns a `~matplotlib.figure.Figure` and leaves pyplot alone,
so that figures can be made in a pipeline without a window system. Matplotlib
is imported when the first figure is drawn.
"""

from astropolcal.plotting.accuracy import plot_accuracy, plot_star_check, plot_target_accuracy
from astropolcal.plotting.efficiency import plot_comparison, plot_observability
from astropolcal.plotting.gap import (
    plot_cause_map,
    plot_gap_frames,
    plot_gap_maps,
    plot_gap_spectrum,
)
from astropolcal.plotting.identifiability import plot_correlations, plot_identifiability
from astropolcal.plotting.parameters import (
    plot_efficiency,
    plot_history,
    plot_mirrors,
    plot_retardances,
)
from astropolcal.plotting.posterior import plot_corner, plot_traces
from astropolcal.plotting.residuals import plot_double_differences
from astropolcal.plotting.saving import save_all

__all__ = [
    "plot_accuracy",
    "plot_cause_map",
    "plot_comparison",
    "plot_corner",
    "plot_correlations",
    "plot_double_differences",
    "plot_efficiency",
    "plot_gap_frames",
    "plot_gap_maps",
    "plot_gap_spectrum",
    "plot_history",
    "plot_identifiability",
    "plot_mirrors",
    "plot_observability",
    "plot_retardances",
    "plot_star_check",
    "plot_target_accuracy",
    "plot_traces",
    "save_all",
]
