# Licensed under a 3-clause BSD style license - see LICENSE
"""
From science frames to the Stokes parameters of the light that entered the telescope.

`correct` solves for them by least squares over frames, with the system Mueller matrix of each
frame; `Corrected` holds them with their statistical and systematic errors.
"""

from astropolcal.correction.brightness import frame_brightness
from astropolcal.correction.correcting import MODES, correct
from astropolcal.correction.frames import ScienceFrames, frame_positions
from astropolcal.correction.geometry import (
    azimuthal,
    derotate,
    derotate_variance,
    position_angles,
)
from astropolcal.correction.ideal import ideal_chain
from astropolcal.correction.result import Corrected
from astropolcal.correction.rows import RowModel, check_optics, measurement_rows, sky_chain
from astropolcal.correction.solve import COMPONENTS, Estimator, estimator
from astropolcal.correction.systematic import Systematic, linear_systematic, sampled_systematic

__all__ = [
    "COMPONENTS",
    "MODES",
    "Corrected",
    "Estimator",
    "RowModel",
    "ScienceFrames",
    "Systematic",
    "azimuthal",
    "check_optics",
    "correct",
    "derotate",
    "derotate_variance",
    "estimator",
    "frame_brightness",
    "frame_positions",
    "ideal_chain",
    "linear_systematic",
    "measurement_rows",
    "position_angles",
    "sampled_systematic",
    "sky_chain",
]
