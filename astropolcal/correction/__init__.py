# Licensed under a 3-clause BSD style license - see LICENSE
"""
From science frames to the Stokes parameters of the light that entered the telescope.

`correct` solves for them by least squares over frames, with the system Mueller matrix of each
frame; `Corrected` holds them with their statistical and systematic errors.
"""

from astropolcal.correction.correcting import correct
from astropolcal.correction.frames import ScienceFrames
from astropolcal.correction.result import Corrected
from astropolcal.correction.rows import ideal_chain, measurement_rows
from astropolcal.correction.systematic import Systematic

__all__ = ["Corrected", "ScienceFrames", "Systematic", "correct", "ideal_chain", "measurement_rows"]
