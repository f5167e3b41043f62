# Licensed under a 3-clause BSD style license - see LICENSE
"""
Diagnosis of the gap between a model and the instrument it stands for.

Where the two differ, which effect that the model lacks causes it, how far the
gap shrinks once the effect is in, and what stays unexplained.
"""

from astropolcal.gap.attribution import Candidate, Score, scan
from astropolcal.gap.diagnosis import Cause, Diagnosis, diagnose
from astropolcal.gap.effects import EFFECTS, Effect, get_effect, register_effect
from astropolcal.gap.model import Model, nominal_model
from astropolcal.gap.problem import GapProblem
from astropolcal.gap.shrinkage import HeldOut, frame_groups, held_out

__all__ = [
    "EFFECTS",
    "Candidate",
    "Cause",
    "Diagnosis",
    "Effect",
    "GapProblem",
    "HeldOut",
    "Model",
    "Score",
    "diagnose",
    "frame_groups",
    "get_effect",
    "held_out",
    "nominal_model",
    "register_effect",
    "scan",
]
