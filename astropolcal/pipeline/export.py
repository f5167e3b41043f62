# Licensed under a 3-clause BSD style license - see LICENSE
"""System Mueller matrices as plain tables, for pipelines in other languages.

A FITS table holds the matrices of both beams of each frame and wavelength with their covariances,
an ECSV table the same with one number a column. Both say in their header what the numbers mean.
"""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable

from astropolcal.exceptions import CalibrationFileError, ParameterError
from astropolcal.files import atomic_path, check_new

__all__ = ["mueller_table", "write_mueller"]

_BEAMS = ("right", "left")
_COLUMNS = {
    "FRAME": "frame, in the order of the headers, from 0",
    "BIN": "wavelength, from 0",
    "WAVELENGTH": "wavelength of the bin",
    "MUELLER_RIGHT": "Mueller matrix of the right (ordinary) beam",
    "MUELLER_LEFT": "Mueller matrix of the left (extraordinary) beam",
    "COV_RIGHT": "covariance of its 16 elements, row by row",
    "COV_LEFT": "covariance of its 16 elements, row by row",
}
# lines of at most 72 characters, as a card of FITS has
_WORDS = """\
Each Mueller matrix turns the incident Stokes vector (I, Q, U, V) into
that downstream of the beam splitter; its first row, elements (0, j),
gives the flux of the beam for incident Stokes parameter j.
MUELLER columns have 4 x 4 numbers: the index that varies fastest, the
first of TDIM and of arrays in IDL and Fortran, is the incident Stokes
parameter j, the other one the outgoing i.
COV columns have 16 x 16 numbers over the elements 4 i + j: errors of
the calibrated parameters, to first order, without the error of the
model that the summary of the calibration counts. Infinite: the data of
the calibration do not determine the element; NaN: they do not
constrain it."""


def mueller_table(calibration, header=None, *, positions=None, light="sky", wavelength=None):
    """
    Return the system Mueller matrices of both beams, one row per frame and wavelength.

    Parameters
    ----------
    calibration : LoadedCalibration
        See `~astropolcal.pipeline.load`.
    header, positions, light, wavelength
        As for `~astropolcal.pipeline.LoadedCalibration.system_mueller`.

    Returns
    -------
    `~astropy.table.QTable`
        ``frame``, ``bin``, ``wavelength``, the positions of the stages, and for each beam
        ``mueller_*``, shape (4, 4), and ``cov_*``, shape (16, 16). meta: the keywords of
        `write_mueller`.

    Raises
    ------
    AstropolcalError
        As ``system_mueller``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.pipeline import load, mueller_table
    >>> from astropolcal.testing import example_calibration
    >>> example_calibration().write("to_export.asdf")
    >>> positions = {"hwp": [0, 22.5] * u.deg, "derotator": [60, 60] * u.deg}
    >>> rows = mueller_table(load("to_export.asdf"), positions=positions, light="internal")
    >>> len(rows), rows["mueller_right"].shape
    (44, (44, 4, 4))
    """
    options = {"positions": positions, "light": light, "wavelength": wavelength}
    # positions, wavelengths and frames are the same for both beams
    beams = {beam: calibration.system_mueller(header, beam=beam, **options) for beam in _BEAMS}
    first = beams["right"]
    n_bins = first.wavelength.size
    n_frames = first.value.size // (16 * n_bins)
    table = QTable()
    table["frame"] = np.repeat(np.arange(n_frames), n_bins)
    table["bin"] = np.tile(np.arange(n_bins), n_frames)
    table["wavelength"] = np.tile(first.wavelength.to(u.nm), n_frames)
    for stage, angle in first.positions.items():
        table[stage] = np.repeat(np.broadcast_to(angle, n_frames, subok=True), n_bins)
    for beam, found in beams.items():
        table[f"mueller_{beam}"] = found.value.reshape(-1, 4, 4)
        # errors of two rows are correlated, too, but a table has room for those of a row only
        table[f"cov_{beam}"] = found.covariance.reshape(-1, 16, 16)
    table.meta = _meta(calibration, light, n_frames, n_bins, first.assumed)
    return table


def _meta(calibration, light, n_frames, n_bins, assumed):
    """Return keyword to (value, comment)."""
    from astropolcal.version import version

    held, sets = calibration.validity, calibration.validity.optics_in
    if calibration.optics_in is not None:
        sets = [calibration.optics_in]
    optics = ",".join(sets[0]) or "none" if sets is not None and len(sets) == 1 else None
    reference = "Q = N-S, U = NE-SW" if light == "sky" else "instrument"
    entries = {
        "INSTRUME": (held.instrument, "instrument that was calibrated"),
        "CALMODE": (held.mode, "mode of the calibration"),
        "CALFILE": (calibration.path.name, "calibration file"),
        "CALHASH": (calibration.content_hash, ""),
        "CALFROM": (held.valid_from, "it holds from this moment (UTC)"),
        "CALUNTIL": (held.valid_until, "it holds until this moment (UTC)"),
        "CALOPTIC": (optics, "optional optics in the beam"),
        "CALASSUM": (",".join(assumed) or None, "optics not calibrated, published values"),
        "MUELLIGH": (light, "light enters: sky or internal source"),
        "MUELREF": (reference, "frame of the incident Stokes parameters"),
        "NFRAMES": (n_frames, "number of frames"),
        "NBINS": (n_bins, "number of wavelengths"),
        "CREATOR": (f"astropolcal {version}", ""),
    }
    return {key: entry for key, entry in entries.items() if entry[0] is not None}


def write_mueller(table, path, overwrite=False):
    """
    Write a table of Mueller matrices as FITS or ECSV, as the name ends.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        As `mueller_table` returns it.
    path : path-like
        ``*.fits``: matrices and covariances are columns with two axes. ``*.ecsv``: one
        column a number, ``right_01`` for element (0, 1) and ``right_01_err`` for its standard
        error, without covariances.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    CalibrationFileError
        If the file exists or cannot be written.
    ParameterError
        If the name ends otherwise.

    Examples
    --------
    >>> from astropolcal.pipeline import write_mueller
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> table = QTable({"frame": [0], "bin": [0], "wavelength": [1600.0] * u.nm})
    >>> for beam in ("right", "left"):
    ...     table[f"mueller_{beam}"], table[f"cov_{beam}"] = np.eye(4)[None], np.eye(16)[None]
    >>> write_mueller(table, "mueller.ecsv")
    >>> float(QTable.read("mueller.ecsv")["right_00"][0])
    1.0
    """
    kind = Path(path).suffix.lower()
    if kind not in (".fits", ".fit", ".ecsv"):
        raise ParameterError(f"{path}: the name must end in .fits or .ecsv")
    path = check_new(path, overwrite, CalibrationFileError)
    with atomic_path(path, error=CalibrationFileError) as temporary:
        if kind == ".ecsv":
            _plain(table).write(temporary, format="ascii.ecsv", overwrite=True)
            return
        with open(temporary, "wb") as stream:
            _hdus(table).writeto(stream)


def _plain(table):
    """Return one column a number, which any reader of text tables understands."""
    beams = [f"{kind}_{beam}" for kind in ("mueller", "cov") for beam in _BEAMS]
    plain = table[[name for name in table.colnames if name not in beams]].copy()
    for beam in _BEAMS:
        value = np.asarray(table[f"mueller_{beam}"])
        errors = np.sqrt(np.diagonal(np.asarray(table[f"cov_{beam}"]), axis1=1, axis2=2))
        for i, j in np.ndindex(4, 4):
            plain[f"{beam}_{i}{j}"] = value[:, i, j]
            plain[f"{beam}_{i}{j}_err"] = errors[:, 4 * i + j]
    plain.meta = {key: entry[0] for key, entry in table.meta.items()}
    plain.meta["comments"] = [
        "right_ij, left_ij: element (i, j) of the Mueller matrix of the beam, from incident",
        "Stokes parameter j (0 to 3: I, Q, U, V) to outgoing i; _err: its standard error from",
        "the calibrated parameters, without the error of the model; inf where the data do not",
        "determine the element, nan where they do not constrain it",
    ]
    return plain


def _hdus(table):
    """Return the table as FITS."""
    columns = QTable(table, names=[name.upper() for name in table.colnames], meta={})
    for name in ("FRAME", "BIN"):
        columns[name] = columns[name].astype(np.int32)
    hdu = fits.table_to_hdu(columns)
    hdu.name = "MUELLER"
    for i, column in enumerate(hdu.columns.names, start=1):
        hdu.header.comments[f"TTYPE{i}"] = _COLUMNS.get(column, "position of the stage")[:47]
    for key, (value, comment) in table.meta.items():
        hdu.header[key] = (value, comment)
    for line in _WORDS.splitlines():
        hdu.header["COMMENT"] = line
    return fits.HDUList([fits.PrimaryHDU(), hdu])
