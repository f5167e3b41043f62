# Licensed under a 3-clause BSD style license - see LICENSE
"""
From FITS cubes to observations: headers, photometry of both beams, errors.

`reduce_cubes` makes an observation table of the cubes of a run, `read_pypolcal`
one of tables that pyPolCal wrote.
"""

from astropolcal.reduction.apertures import measure_internal
from astropolcal.reduction.pypolcal import read_pypolcal
from astropolcal.reduction.run import Reduction, reduce_cubes, reduce_run
from astropolcal.reduction.stars import measure_stars

__all__ = [
    "Reduction",
    "measure_internal",
    "measure_stars",
    "read_pypolcal",
    "reduce_cubes",
    "reduce_run",
]
