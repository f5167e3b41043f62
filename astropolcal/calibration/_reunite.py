# Licensed under a 3-clause BSD style license - see LICENSE
"""Bring a calibration that was read from a file and its observations together again."""

import warnings

import numpy as np

from astropolcal.calibration._beam import instrument_of
from astropolcal.calibration.accuracy import accuracy_table
from astropolcal.exceptions import CalibrationFileError, ObservationError
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations

# two computers agree better in s_res; stages in other positions differ by far more
_SAME_ACCURACY = 1e-3
_SHOWN = 12


def measurement_of_all(calibration, observations, positions=None):
    """
    Return the measurement that a calibration was fitted to.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    observations : Observations or sequence of Observations
        Its datasets, in any order.
    positions : dict or sequence of dict, optional
        Position of every stage, for each of ``observations``.

    Raises
    ------
    CalibrationFileError
        If a table is missing or is another one, or the residuals are not those
        of the calibration.
    """
    given = [observations] if isinstance(observations, Observations) else list(observations)
    positions = [positions] if isinstance(positions, dict) else positions
    if positions is not None and len(positions) != len(given):
        raise CalibrationFileError(f"{len(positions)} positions for {len(given)} tables")
    given = [_prepared(calibration, table) for table in given]
    order = _order(calibration.datasets, given)
    tables = [given[i] for i in order]
    if positions is None:
        positions = _positions(calibration, tables)
    else:
        positions = [positions[i] for i in order]
    # the same chains, ties and grid as in the fit: what the file holds is enough to predict
    measurement = Measurement(
        calibration.chains,
        tables,
        observable=calibration.settings["observable"],
        positions=positions,
        ties=calibration.ties,
        wavelength=calibration.wavelength,
    )
    _check_residuals(calibration, measurement)
    return measurement


def _prepared(calibration, table):
    """Return a table with the masks of the instrument, if the calibration was made with them."""
    # hashes are those of the tables as they were fitted, masks included
    wanted = {record.content_hash for record in calibration.datasets}
    instrument = instrument_of(calibration)
    if table.content_hash in wanted or instrument is None:
        return table
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            masked = instrument.prepare(table)
    except ObservationError:
        return table
    return masked if masked.content_hash in wanted else table


def _order(records, given):
    """Return which of the tables given is that of each record."""
    known = [table.content_hash for table in given]
    wanted = {record.content_hash: record.name for record in records}
    for table in given:
        if table.content_hash not in wanted:
            listed = ", ".join(f"{name} ({hash_[:_SHOWN]})" for hash_, name in wanted.items())
            raise CalibrationFileError(
                f"{table.name}: the calibration was not made from this table, whose content "
                f"hash is {table.content_hash[:_SHOWN]}; it was made from {listed}"
            )
    missing = [record for record in records if record.content_hash not in known]
    if missing:
        listed = ", ".join(f"{r.name} (content hash {r.content_hash[:_SHOWN]})" for r in missing)
        raise CalibrationFileError(f"the calibration was also made from {listed}: give that table")
    # the order of the fit, on which slices of data and residuals depend
    return [known.index(record.content_hash) for record in records]


def _positions(calibration, tables):
    """Return the positions that the instrument reads; None, the columns, without one."""
    instrument = instrument_of(calibration)
    if instrument is None:
        return None
    return [instrument.positions(*pair) for pair in zip(tables, calibration.chains, strict=True)]


def _check_residuals(calibration, measurement):
    """Refuse data that the calibration was not fitted to in this way."""
    residuals = measurement.residuals()
    for i, record in enumerate(calibration.datasets):
        if record.accuracy is None:
            continue
        found = accuracy_table(measurement, i, residuals)["s_res"].value
        stored = record.accuracy["s_res"].value
        if found.shape != stored.shape or not np.allclose(
            found, stored, rtol=_SAME_ACCURACY, equal_nan=True
        ):
            raise CalibrationFileError(
                f"{record.name}: the residuals are not those of the calibration (median s_res "
                f"{np.nanmedian(found):.4g} %, in the calibration {np.nanmedian(stored):.4g} %); "
                "if the stages were not where the table's columns say, give positions="
            )
