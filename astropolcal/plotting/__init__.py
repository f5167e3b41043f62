# Licensed under a 3-clause BSD style license - see LICENSE
"""
Figures of a calibration and of a diagnosis.

Every function returns a `~matplotlib.figure.Figure` and leaves pyplot alone,
so that figures can be made in a pipeline without a window system. Matplotlib
is imported when the first figure is drawn.
"""

from astropolcal.plotting.accuracy import plot_accuracy
from astropolcal.plotting.correlations import plot_correlations
from astropolcal.plotting.differences import plot_double_differences
from astropolcal.plotting.efficiency import plot_polarimetric_efficiency
from astropolcal.plotting.gap import (
    plot_effect_scores,
    plot_gap_maps,
    plot_gap_spectrum,
    plot_where,
)
from astropolcal.plotting.identifiability import plot_identifiability
from astropolcal.plotting.parameters import (
    plot_efficiency,
    plot_parameters,
    plot_retardances,
)
from astropolcal.plotting.posterior import plot_corner, plot_traces
from astropolcal.plotting.residuals import plot_residuals
from astropolcal.plotting.saving import save_all
from astropolcal.plotting.standards import plot_observability

__all__ = [
    "plot_accuracy",
    "plot_corner",
    "plot_correlations",
    "plot_double_differences",
    "plot_effect_scores",
    "plot_efficiency",
    "plot_gap_maps",
    "plot_gap_spectrum",
    "plot_identifiability",
    "plot_observability",
    "plot_parameters",
    "plot_polarimetric_efficiency",
    "plot_residuals",
    "plot_retardances",
    "plot_traces",
    "plot_where",
    "save_all",
]
