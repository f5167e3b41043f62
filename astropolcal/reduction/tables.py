# Licensed under a 3-clause BSD style license - see LICENSE
"""Tables of reduced frames."""

import astropy.units as u
import numpy as np
from astropy.table import MaskedColumn, Table

from astropolcal.exceptions import ObservationError
from astropolcal.files import atomic_path, check_new
from astropolcal.reduction.photometry import BEAMS

__all__ = ["photometry_table", "reduced_table", "write_table"]

_ANGLES = ("hwp", "hwp_true", "derotator", "parallactic", "altitude")
_GEOMETRY = {"x": "pix", "y": "pix", "fwhm": "pix", "radius": "pix"}


def reduced_table(frames, instrument, meta):
    """
    Return the observation table of frames.

    Parameters
    ----------
    frames : list of Frame
        In the order they were taken.
    instrument : Instrument
        With the wavelengths of the slices.
    meta : dict
        Of the table.

    Returns
    -------
    `~astropy.table.Table`
        One row a frame and wavelength. The fluxes of a cell that failed are
        masked, and ``mask_reason`` says why. Errors are those of the beams, or,
        where the beams share noise, those of their difference and sum.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.tables import reduced_table
    >>> len(reduced_table([], instruments.get("charis"), {}))
    0
    """
    table = _frame_columns(frames, instrument)
    if not frames:
        return table
    failed = np.concatenate([frame.photometry.failed for frame in frames])
    unit = u.Unit(frames[0].unit)
    flux = _stack(frames, "flux")
    variance = _stack(frames, "variance")
    covariance = np.concatenate([frame.photometry.covariance for frame in frames])
    columns = {f"flux_{beam}": values for beam, values in zip(BEAMS, flux, strict=True)}
    # errors of the beams alone cannot say what they share
    if (covariance[~failed] != 0).any():
        # var(R -+ L) = var(R) + var(L) -+ 2 cov
        both = variance.sum(axis=0)
        columns["single_difference_err"] = np.sqrt(np.maximum(both - 2 * covariance, 0.0))
        columns["single_sum_err"] = np.sqrt(np.maximum(both + 2 * covariance, 0.0))
    else:
        columns |= {f"flux_{b}_err": np.sqrt(v) for b, v in zip(BEAMS, variance, strict=True)}
    for name, values in columns.items():
        table[name] = _column(np.where(failed, 0.0, values), failed, unit)
    reasons = [reason for frame in frames for reason in frame.photometry.reasons]
    if any(reasons):
        table["mask_reason"] = reasons
    table.meta.update(meta)
    return table


def _column(values, failed, unit):
    if failed.any():
        return MaskedColumn(values, mask=failed, unit=unit)
    return MaskedColumn(values, unit=unit).filled()


def _stack(frames, name):
    """Return an array of the photometry, (2, rows)."""
    return np.concatenate([getattr(frame.photometry, name) for frame in frames], axis=1)


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
    units = dict.fromkeys(_ANGLES, u.deg) | {"exposure_time": u.s, "mjd": u.day}
    for name, unit in units.items():
        values = [frame.values.get(name) for frame in frames]
        # a column is there for all frames or not at all
        if frames and None not in values:
            column = "time" if name == "mjd" else name
            table[column] = np.repeat(np.array(values, dtype=float), n) * unit
    states = [frame.values.get("flc_state") for frame in frames]
    if frames and None not in states:
        table["flc_state"] = np.repeat(states, n)
    return table


def photometry_table(frames, instrument):
    """
    Return all that was measured in frames.

    Parameters
    ----------
    frames : list of Frame
        In the order they were taken.
    instrument : Instrument
        With the wavelengths of the slices.

    Returns
    -------
    `~astropy.table.Table`
        Columns such as ``x_right``, ``fwhm_left``, ``background_right``, and factor
        and error of the aperture correction; masked where a cell failed.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.tables import photometry_table
    >>> len(photometry_table([], instruments.get("charis")))
    0
    """
    table = reduced_table(frames, instrument, {})
    if not frames:
        return table
    failed = np.concatenate([frame.photometry.failed for frame in frames])
    units = {name: u.Unit(unit) for name, unit in _GEOMETRY.items()}
    for name, unit in (units | {"background": u.Unit(frames[0].unit)}).items():
        for beam, values in zip(BEAMS, _stack(frames, name), strict=True):
            table[f"{name}_{beam}"] = _column(values, failed, unit)
    for name in ("scale", "scale_err"):
        values = np.concatenate([getattr(frame.photometry, name) for frame in frames])
        table[name] = _column(values, failed, u.one)
    return table


def write_table(table, path, overwrite=False):
    """
    Write a table as ECSV, completely or not at all.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table.
    path : path-like
        The file.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    ObservationError
        If the file exists, or cannot be written.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from astropolcal.reduction.tables import write_table
    >>> write_table(Table({"bin": [0]}), "no/run.ecsv")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: no/run.ecsv: cannot be written: there is no folder no
    """
    path = check_new(path, overwrite, ObservationError)
    with atomic_path(path, ObservationError) as temporary:
        table.write(temporary, format="ascii.ecsv", overwrite=True)
