# Licensed under a 3-clause BSD style license - see LICENSE
"""
Figures of a calibration and of a diagnosis.

Every function returns a `~matplotlib.figure.Figure` and leaves pyplot alone,
so that figures can be made in a pipeline without a window system. Matplotlib
is imported when the first figure is drawn.
"""

from astropolcal.plotting import (
    accuracy,
    efficiency,
    gap,
    identifiability,
    parameters,
    posterior,
    residuals,
    saving,
)
from astropolcal.plotting.accuracy import *
from astropolcal.plotting.efficiency import *
from astropolcal.plotting.gap import *
from astropolcal.plotting.identifiability import *
from astropolcal.plotting.parameters import *
from astropolcal.plotting.posterior import *
from astropolcal.plotting.residuals import *
from astropolcal.plotting.saving import *

_PARTS = (accuracy, efficiency, gap, identifiability, parameters, posterior, residuals, saving)
__all__ = sorted(name for part in _PARTS for name in part.__all__)
