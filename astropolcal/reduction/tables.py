# Licensed under a 3-clause BSD style license - see LICENSE
"""Tables of reduced frames."""

import csv
import os
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import MaskedColumn, QTable, Table

from astropolcal.exceptions import ObservationError
from astropolcal.files import one_line, understood
from astropolcal.observations import Observations
from astropolcal.units import plain_number

__all__ = ["read_pypolcal"]

_ANGLES = ("hwp", "hwp_true", "derotator", "parallactic", "altitude")


def reduced_table(frames, instrument, meta):
    """
    Return the observation table of frames in the order they were taken.

    Fluxes of a cell that failed are masked, and ``mask_reason`` says why. Errors are those of the
    beams, and, where the beams share noise, those of their difference and sum, too.
    """
    table = _frame_columns(frames, instrument)
    if not frames:
        return table
    failed = np.concatenate([frame.photometry.failed for frame in frames])
    flux, variance = _stack(frames, "flux"), _stack(frames, "variance")
    covariance = _stack(frames, "covariance")
    beams = instrument.files.beams
    names = ["flux"] if len(beams) == 1 else [f"flux_{beam}" for beam in beams]
    columns = dict(zip(names, flux, strict=True))
    columns |= {f"{n}_err": np.sqrt(v) for n, v in zip(names, variance, strict=True)}
    # errors of the beams alone cannot say what they share
    if (covariance[~failed] != 0).any():
        # var(R -+ L) = var(R) + var(L) -+ 2 cov
        both = variance.sum(axis=0)
        columns["single_difference_err"] = np.sqrt(np.maximum(both - 2 * covariance, 0.0))
        columns["single_sum_err"] = np.sqrt(np.maximum(both + 2 * covariance, 0.0))
    for name, values in columns.items():
        table[name] = _column(np.where(failed, 0.0, values), failed, u.Unit(frames[0].unit))
    reasons = [reason for frame in frames for reason in frame.photometry.reasons]
    if any(reasons):
        table["mask_reason"] = reasons
    table.meta.update(meta)
    return table


def _column(values, failed, unit):
    column = MaskedColumn(values, mask=failed, unit=unit)
    return column if failed.any() else column.filled()


def _stack(frames, name):
    """Return an array of the photometry, (n_beams, rows) or (rows,)."""
    return np.concatenate([getattr(frame.photometry, name) for frame in frames], axis=-1)


def _frame_columns(frames, instrument):
    """Return the columns that belong to frames, and those of the wavelengths."""
    n = len(instrument.wavelength)
    table = Table()
    # frames one after the other, wavelengths fastest
    table["file"] = np.repeat([frame.name for frame in frames], n)
    table["frame"] = np.repeat(np.arange(len(frames)), n)
    table["bin"] = np.tile(np.arange(n), len(frames))
    table["wavelength"] = np.tile(instrument.wavelength.to_value(u.nm), len(frames)) * u.nm
    if frames and all(frame.number is not None for frame in frames):
        table["number"] = np.repeat([frame.number for frame in frames], n)
    layout = instrument.files
    own = [name for name in layout.stages if name not in layout.texts]
    units = dict.fromkeys((*_ANGLES, *own), u.deg) | {"exposure_time": u.s, "mjd": u.day}
    # states have none
    units |= dict.fromkeys(("flc_state", *layout.texts))
    for name, unit in units.items():
        values = [frame.values.get(name) for frame in frames]
        # a column is there for all frames or not at all
        if frames and None not in values:
            column = np.repeat(values, n) if unit is None else np.repeat(values, n) * unit
            table["time" if name == "mjd" else name] = column
    return table


def photometry_table(frames, instrument):
    """
    Return all that was measured in frames, masked where a cell failed.

    Besides `reduced_table` centres, widths, radii, backgrounds and the factor of the aperture
    correction.
    """
    table = reduced_table(frames, instrument, {})
    if not frames:
        return table
    failed = np.concatenate([frame.photometry.failed for frame in frames])
    units = dict.fromkeys(("x", "y", "fwhm", "radius"), "pix") | {"background": frames[0].unit}
    for name, unit in units.items():
        for beam, values in zip(instrument.files.beams, _stack(frames, name), strict=True):
            table[f"{name}_{beam}"] = _column(values, failed, u.Unit(unit))
    for name in ("scale", "scale_err"):
        table[name] = _column(_stack(frames, name), failed, u.one)
    return table


# ---- tables of pyPolCal --------------------------------------------------------------------------
# One CSV file per wavelength bin, one row per frame: ``filepath``, ``D_IMRANG`` (derotator), ``RET-
# ANG1`` (commanded half-wave plate), ``LCOUNTS`` and ``RCOUNTS``, their sum and difference
# ``single_sum`` and ``single_diff`` with errors ``sum_std`` and ``diff_std``, ``wavelength_bin``
# (nm), and for stars ``p`` and ``a`` (parallactic angle and altitude), all angles in degree.

_NEEDED = ("filepath", "D_IMRANG", "RET-ANG1", "LCOUNTS", "RCOUNTS", "wavelength_bin")
_PYPOLCAL_ANGLES = {"RET-ANG1": "hwp", "D_IMRANG": "derotator", "p": "parallactic", "a": "altitude"}
_ERRORS = {"diff_std": "single_difference_err", "sum_std": "single_sum_err"}


def read_pypolcal(files, meta=None, *, name=None):
    r"""
    Read the CSV files of pyPolCal for a run.

    Parameters
    ----------
    files : path-like or sequence of path-like
        One file per wavelength bin, or a folder of them.
    meta : dict, optional
        What the files do not say: ``instrument``, ``source``, ``date`` and so on; the
        instrument is SCExAO/CHARIS unless given.
    name : str, optional
        By default that of the folder.

    Returns
    -------
    Observations

    Raises
    ------
    ObservationError
        If a file cannot be read, lacks a column, or contradicts the others; the
        message names it and the row.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from astropolcal.reduction import read_pypolcal
    >>> columns = "filepath,D_IMRANG,RET-ANG1,LCOUNTS,RCOUNTS,sum_std,diff_std,wavelength_bin"
    >>> rows = ["/a/CRSA00000001_cube.fits,45.0,0.0,5e5,1e6,1225,1225,1159.56",
    ...         "/a/CRSA00000002_cube.fits,45.0,45.0,1e6,5e5,1225,1225,1159.56"]
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "bin0.csv"
    ...     _ = path.write_text("\n".join([columns, *rows]))
    ...     observations = read_pypolcal(path, {"source": "polarized"}, name="run")
    >>> observations
    <Observations 'run': SCExAO/CHARIS, polarized, 2 frames x 1 bin, 0 cells masked>
    """
    rows = _rows(files)
    paths = list(dict.fromkeys(path for path, _, _ in rows))
    wavelength = _numbers(rows, "wavelength_bin")
    # wavelengths that differ by less than 0.1 pm are one, spelled by two programs; what is too
    # large to be rounded is refused with the other lengths that cannot be
    with np.errstate(over="ignore"):
        _, bins = np.unique(wavelength.round(4), return_inverse=True)
    # cubes are numbered in the order in which the first file lists them
    cubes, seen = [row["filepath"].strip() for _, _, row in rows], {}
    for (path, i, _), cube, b in zip(rows, cubes, bins.tolist(), strict=True):
        if (cube, b) in seen:
            raise ObservationError(
                f"{path}, line {i}: {one_line(cube, 80)} is given already in {seen[cube, b]}"
            )
        seen[cube, b] = f"{path}, line {i}"
    numbers = {cube: number for number, cube in enumerate(dict.fromkeys(cubes))}
    frames = [numbers[cube] for cube in cubes]
    table = QTable({"file": [Path(row["filepath"]).name for _, _, row in rows]})
    table["frame"], table["bin"], table["wavelength"] = frames, bins, wavelength * u.nm
    for column, ours in _PYPOLCAL_ANGLES.items():
        if all(column in row for _, _, row in rows):
            table[ours] = _numbers(rows, column) * u.deg
    table["flux_right"] = _numbers(rows, "RCOUNTS") * u.adu
    table["flux_left"] = _numbers(rows, "LCOUNTS") * u.adu
    if all(column in row for column in _ERRORS for _, _, row in rows):
        for column, ours in _ERRORS.items():
            table[ours] = _numbers(rows, column) * u.adu
    table.meta.update({"instrument": "SCExAO/CHARIS"} | dict(meta or {}))
    name = name or (paths[0].parent.name if len(paths) > 1 else paths[0].stem)
    return Observations.from_table(table, name=name)


def _rows(files):
    """Return path, line and content of all rows."""
    if isinstance(files, str | Path):
        folder = Path(files)
        files = sorted(folder.glob("*.csv")) if os.path.isdir(folder) else [folder]
        if not files:
            raise ObservationError(f"{folder}: no CSV file in this folder")
    if not len(files):
        raise ObservationError("no files to read")
    rows = []
    for path in map(Path, files):
        with (
            understood(path, ObservationError, "cannot be read as CSV"),
            open(path, encoding="utf-8", newline="") as stream,
        ):
            reader = csv.DictReader(stream, skipinitialspace=True)
            # programs end lines with a comma
            while reader.fieldnames and not reader.fieldnames[-1].strip():
                reader.fieldnames.pop()
            names = reader.fieldnames or ()
            missing = [name for name in _NEEDED if name not in names]
            if missing:
                raise ObservationError(
                    f"{path}: missing column{'s' * (len(missing) > 1)} {', '.join(missing)}"
                )
            for row in filter(lambda row: any(row.values()), reader):
                beyond = row.pop(None, [])
                # a comma too many, or too few, moves all that follows to another column
                if any(beyond) or None in row.values() or len(row) < len(names):
                    raise ObservationError(
                        f"{path}, line {reader.line_num}: each of its {len(names)} columns needs a "
                        "name of its own, and one value"
                    )
                rows.append((path, reader.line_num, row))
    if not rows:
        raise ObservationError(f"{files[0]}: no rows")
    return rows


def _numbers(rows, column):
    values = np.empty(len(rows))
    for k, (path, i, row) in enumerate(rows):
        try:
            values[k] = plain_number(row[column])
        except (TypeError, ValueError):
            raise ObservationError(
                f"{path}, line {i}: {column} = {one_line(row[column], 40)!r}, a number is needed"
            ) from None
    return values
