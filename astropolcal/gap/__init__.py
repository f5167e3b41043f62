# Licensed under a 3-clause BSD style license - see LICENSE
"""
Diagnosis of the gap between a model and the instrument it stands for.

Where the two differ, which effect that the model lacks causes it, how far the
gap shrinks once the effect is in, and what stays unexplained.
"""

from astropolcal.gap.attribution import Candidate, Scan, scan
from astropolcal.gap.challenge import make_challenge, run_challenge
from astropolcal.gap.diagnosis import Cause, Diagnosis, diagnose
from astropolcal.gap.effects import EFFECTS, Effect, check_effect, get_effect, register_effect
from astropolcal.gap.model import Model, nominal_model
from astropolcal.gap.planning import Exposure, plan
from astropolcal.gap.problem import GapProblem
from astropolcal.gap.remainders import Component, outlying_frames, remainder
from astropolcal.gap.residuals import Where, locate
from astropolcal.gap.shrinkage import HeldOut, frame_groups, held_out

__all__ = [
    "EFFECTS",
    "Candidate",
    "Cause",
    "Component",
    "Diagnosis",
    "Effect",
    "Exposure",
    "GapProblem",
    "HeldOut",
    "Model",
    "Scan",
    "Where",
    "check_effect",
    "diagnose",
    "frame_groups",
    "get_effect",
    "held_out",
    "locate",
    "make_challenge",
    "nominal_model",
    "outlying_frames",
    "plan",
    "register_effect",
    "remainder",
    "run_challenge",
    "scan",
]
