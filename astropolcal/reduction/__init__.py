# Licensed under a 3-clause BSD style license - see LICENSE
"""
From FITS cubes to observations: headers, photometry of both beams, errors.

`reduce_cubes` makes an observation table of the cubes of a run, `read_pypolcal`
one of tables that pyPolCal wrote.
"""

from astropolcal.reduction.cubes import (
    CubeFiles,
    DetectorModel,
    ImageModel,
    both_states,
    simulate_cubes,
    true_observations,
)
from astropolcal.reduction.run import Reduction, reduce_cubes, reduce_run
from astropolcal.reduction.spectrum import (
    read_spectra,
    spectra_from_table,
    table_from_spectra,
    write_spectra,
)
from astropolcal.reduction.tables import read_pypolcal

__all__ = [
    "CubeFiles",
    "DetectorModel",
    "ImageModel",
    "Reduction",
    "both_states",
    "read_pypolcal",
    "read_spectra",
    "reduce_cubes",
    "reduce_run",
    "simulate_cubes",
    "spectra_from_table",
    "table_from_spectra",
    "true_observations",
    "write_spectra",
]
