# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrations at work: library, headers, system Mueller matrices, export, history."""

from astropolcal.pipeline.export import mueller_table, write_mueller
from astropolcal.pipeline.history import Change, changes, parameter_history, restart
from astropolcal.pipeline.library import Entry, Library
from astropolcal.pipeline.loading import LoadedCalibration, SystemMueller, load
from astropolcal.pipeline.monitoring import health
from astropolcal.pipeline.store import fetch, import_context
from astropolcal.pipeline.timeline import courses

__all__ = [
    "Change",
    "Entry",
    "Library",
    "LoadedCalibration",
    "SystemMueller",
    "changes",
    "courses",
    "fetch",
    "health",
    "import_context",
    "load",
    "mueller_table",
    "parameter_history",
    "restart",
    "write_mueller",
]
