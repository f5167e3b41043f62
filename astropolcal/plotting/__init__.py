# Licensed under a 3-clause BSD style license - see LICENSE
"""
Figures of a calibration and of a diagnosis.

Every function returns a `~matplotlib.figure.Figure` and leaves pyplot alone, so that figures can be
made in a pipeline without a window system. Matplotlib is imported when the first figure is drawn.
"""

from astropolcal.plotting.accuracy import *
from astropolcal.plotting.efficiency import *
from astropolcal.plotting.gap import *
from astropolcal.plotting.identifiability import *
from astropolcal.plotting.parameters import *
from astropolcal.plotting.posterior import *
from astropolcal.plotting.residuals import *
from astropolcal.plotting.saving import *

__all__ = sorted(name for name in globals() if name.startswith(("plot_", "save_")))
