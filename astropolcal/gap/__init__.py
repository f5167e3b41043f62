# Licensed under a 3-clause BSD style license - see LICENSE
"""
Diagnosis of the gap between a model and the instrument it stands for.

Where the two differ, which effect that the model lacks causes it, how far the
gap shrinks once the effect is in, and what stays unexplained.
"""

from astropolcal.gap.diagnosis import Cause, Diagnosis, diagnose
from astropolcal.gap.effects import EFFECTS, Effect, check_effect, get_effect, register_effect

__all__ = [
    "EFFECTS",
    "Cause",
    "Diagnosis",
    "Effect",
    "check_effect",
    "diagnose",
    "get_effect",
    "register_effect",
]
