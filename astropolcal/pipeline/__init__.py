# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrations at work: library, headers, system Mueller matrices, export, history."""

from astropolcal.pipeline import export, history, library, loading, monitoring, store
from astropolcal.pipeline.export import *
from astropolcal.pipeline.history import *
from astropolcal.pipeline.library import *
from astropolcal.pipeline.loading import *
from astropolcal.pipeline.monitoring import *
from astropolcal.pipeline.store import *

_PARTS = (export, history, library, loading, monitoring, store)
__all__ = sorted(name for part in _PARTS for name in part.__all__)
