# Licensed under a 3-clause BSD style license - see LICENSE
"""
Safe reading and checked columns of an observation table.

Files come from anywhere, so whatever is wrong with one ends in a single-line
`~astropolcal.exceptions.ObservationError` that names the file and the place.
Nothing in a file is executed: the text goes through the safe loader of astropy,
and columns of Python objects are refused.
"""

import io
import re
import textwrap
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import ascii
from astropy.table import QTable, Table

from astropolcal.exceptions import ObservationError
from astropolcal.files import check_yaml, one_line, understood
from astropolcal.observations.wavelengths import stated_wavelength
from astropolcal.units import iso_date, plain_number

__all__ = [
    "check_table",
    "complete_table",
    "first_bad_row",
    "numeric_column",
    "read_ecsv",
    "stated_date",
]

# real headers have 1 to 3 kB; the YAML loader needs seconds for a quarter of a megabyte
_MAX_HEADER = 2**18
# a text in which there may be numbers such as 1_000, or digits of another script
_ODD_NUMBERS = re.compile(r"[0-9]_[0-9]|[^\x00-\x7f]")
_SINGLE = ("single_difference", "single_sum")


def read_ecsv(path):
    """
    Read an ECSV file into a table without trusting it.

    Parameters
    ----------
    path : str or `~pathlib.Path`
        The file.

    Returns
    -------
    `~astropy.table.QTable`

    Raises
    ------
    ObservationError
        If there is no such file or it is not a readable ECSV table.

    Examples
    --------
    >>> from astropolcal.observations.reading import read_ecsv
    >>> read_ecsv("nowhere.ecsv")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: nowhere.ecsv: no such file
    """
    # read once: what is checked is what is loaded, even if the file changes meanwhile
    text = _read_text(path)
    # astropy would guess another format, and make one column of it
    if not text.startswith("# %ECSV"):
        raise ObservationError(
            f"{path}: not an ECSV table; its first line must start with '# %ECSV'"
        )
    with understood(path, ObservationError, "not a readable ECSV table"):
        _check_header(path, text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # doubtful units and types are errors below
            table = QTable.read(io.BytesIO(text.encode()), format="ascii.ecsv")
            if _ODD_NUMBERS.search(text):
                _check_numbers(path, text)
        return table


def _read_text(path):
    try:
        with understood(path, ObservationError, "cannot be read"):
            return Path(path).read_bytes().decode("utf-8")
    except ObservationError as error:
        if str(error).endswith("is a folder, not a file"):
            raise ObservationError(f"{path}: is a folder, an ECSV file is needed") from None
        if isinstance(error.__cause__, UnicodeDecodeError):
            raise ObservationError(f"{path}: not a text file, an ECSV table is needed") from None
        raise


def _check_header(path, text):
    """Look at what astropy takes out of the comments at the start, and loads."""
    lines, size = [], 0
    for line in map(str.strip, text.split("\n")):
        if line and not line.startswith("#"):
            break
        size += len(line)
        if size > _MAX_HEADER:
            raise ObservationError(
                f"{path}: the header is longer than the {_MAX_HEADER} characters allowed"
            )
        # astropy splits at more characters than newline: there could be text we did not check
        if len(line.splitlines()) > 1:
            raise ObservationError(f"{path}: a line of the header has an end within it")
        lines += [line[1:]] if line[1:] else []
    try:
        check_yaml(textwrap.dedent("\n".join(lines[1:])), ObservationError)
    except ObservationError as error:
        raise ObservationError(f"{path}: not a readable ECSV table: {error}") from None


def _check_numbers(path, text):
    """Refuse what astropy reads as numbers, as Python does, though no program writes them so."""
    reader = ascii.get_reader(ascii.Ecsv)
    reader.read(text)
    for column in (c for c in reader.cols if c.data.dtype.kind in "iuf" and c.data.ndim == 1):
        for row, cell in enumerate(column.str_vals):
            try:
                plain_number(cell)
            except ValueError:
                raise ObservationError(
                    f"{path}, row {row + 1}: {column.name} = {one_line(cell, 40)}, "
                    "allowed are numbers such as 1000 or 1e3"
                ) from None


def check_table(table, label, required):
    """
    Refuse what is not a table with rows, the required columns and plain values.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table.
    label : str
        What to call it in messages: the file or a name.
    required : sequence of str
        Columns that must exist.

    Returns
    -------
    `~astropy.table.QTable`
        The same columns.

    Raises
    ------
    ObservationError
        If something is wrong; all missing columns are named at once.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from astropolcal.observations.reading import check_table
    >>> check_table(Table({"frame": [1]}), "night.ecsv", ["frame", "bin"])
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: night.ecsv: missing column bin; it has frame
    """
    if not isinstance(table, Table):
        raise ObservationError(f"{label}: a {type(table).__name__}, an astropy Table is needed")
    missing = [name for name in required if name not in table.colnames]
    if missing:
        raise ObservationError(
            f"{label}: missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}; "
            f"it has {', '.join(table.colnames) or 'none'}"
        )
    if len(table) == 0:
        raise ObservationError(f"{label}: the table is empty, at least one row is needed")
    for name in table.colnames:
        _check_plain(table[name], name, label)
    return table if isinstance(table, QTable) else QTable(table, copy=False)


def _check_plain(column, name, label):
    dtype = getattr(column, "dtype", None)
    # objects and structures hold anything: there is no value that could be checked
    if dtype is not None and dtype.kind in "OV":
        raise ObservationError(
            f"{label}: column {name} has type {dtype}; allowed are numbers, strings and times"
        )
    if getattr(column, "shape", (0,))[1:]:
        raise ObservationError(
            f"{label}: column {name} has shape {column.shape}, one value a row is allowed"
        )


def stated_date(meta, label, error=ObservationError):
    """
    Return the date in the meta of a table.

    Parameters
    ----------
    meta : dict
        Of the table.
    label : str
        What to call the table in messages.
    error : type
        What to raise.

    Returns
    -------
    str or None
        As ``iso_date`` returns it, perhaps a month alone; None where the meta
        have none.

    Raises
    ------
    AstropolcalError
        Of the type given, if there is a date that cannot be understood.

    Examples
    --------
    >>> from astropolcal.observations.reading import stated_date
    >>> stated_date({"date": 60953}, "night.ecsv")
    '2025-10-05'
    """
    value = meta.get("date")
    if value is None or not str(value).strip():
        return None
    return iso_date(value, f"{label}: date in the meta", error, months=True)


def complete_table(table, label):
    """
    Return a table of single differences and sums as one of beam fluxes.

    Where neither beam has a column, right and left are half the sum and difference of
    ``single_sum`` and ``single_difference``. Where neither ``frame`` nor ``bin`` is there, each
    row is a frame, of one wavelength. Where ``wavelength`` is not there, it is that of the
    meta: ``wavelength``, such as "625 nm", or ``filter``, see
    `~astropolcal.observations.wavelengths.filter_wavelength`. Frames of single differences
    with a column ``flc_state`` are paired by it, unless the meta say ``pairing: hwp``.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table; it is not changed.
    label : str
        What to call it in messages.

    Returns
    -------
    `~astropy.table.Table`
        The same, or a completed copy.

    Raises
    ------
    ObservationError
        If a difference or sum is no number, the units do not fit, or the filter is unknown.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal.observations.reading import complete_table
    >>> table = QTable({"single_difference": [1.0] * u.adu, "single_sum": [3.0] * u.adu},
    ...                meta={"wavelength": "625 nm"})
    >>> complete_table(table, "night").colnames
    ['frame', 'bin', 'wavelength', 'flux_right', 'flux_left']
    """
    if not isinstance(table, Table) or not len(table):
        return table
    there, n = set(table.colnames), len(table)
    new = {}
    if not there & {"frame", "bin"}:
        new |= {"frame": np.arange(n), "bin": np.zeros(n, dtype=int)}
    if "wavelength" not in there:
        wavelength = stated_wavelength(table.meta, label)
        new |= {} if wavelength is None else {"wavelength": np.full(n, 1.0) * wavelength}
    if not there & {"flux_right", "flux_left"} and there >= set(_SINGLE):
        new |= _beams(table, label)
    if not new:
        return table
    kept = [name for name in table.colnames if name not in _SINGLE or "flux_right" not in new]
    modulated = "flux_right" in new and "flc_state" in there
    # the states alternate within an exposure, so that their difference is the better one
    meta = {"pairing": "flc_state"} if modulated else {}
    completed = QTable(new, meta=meta | dict(table.meta))
    for name in kept:
        completed[name] = table[name]
    return completed


def _beams(table, label):
    check_table(table, label, _SINGLE)
    unit = getattr(table[_SINGLE[0]], "unit", None) or u.dimensionless_unscaled
    difference, total = (numeric_column(table, name, label, unit) for name in _SINGLE)
    # what is beyond all numbers becomes infinite, and is masked like that
    with np.errstate(over="ignore", invalid="ignore"):
        right, left = 0.5 * (total + difference), 0.5 * (total - difference)
    return {"flux_right": right * unit, "flux_left": left * unit}


def numeric_column(table, name, label, unit=None):
    """
    Return a column as floats in ``unit``, NaN where it is masked.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        A table that passed `check_table`.
    name : str
        The column.
    label : str
        What to call the table in messages.
    unit : `~astropy.units.UnitBase`, optional
        The unit wanted; by default the column may have any unit or none.

    Returns
    -------
    `~numpy.ndarray`
        Shape (N,), a copy.

    Raises
    ------
    ObservationError
        If the column is not numeric or its unit is missing or of another kind.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal.observations.reading import numeric_column
    >>> numeric_column(QTable({"hwp": [0, 45] * u.deg}), "hwp", "night", u.arcmin).tolist()
    [0.0, 2700.0]
    """
    column = table[name]
    dtype = getattr(column, "dtype", None)
    if dtype is None or dtype.kind not in "iuf":
        kind = type(column).__name__ if dtype is None else dtype
        raise ObservationError(f"{label}: column {name} has type {kind}, numbers are needed")
    # MaskedColumn, Masked quantities and plain columns in one way
    mask = np.asarray(getattr(column, "mask", False))
    plain = getattr(column, "unmasked", column)
    data = plain.value if isinstance(plain, u.Quantity) else np.ma.getdata(plain)
    # a copy, which the caller may change
    values = np.array(data, dtype=float)
    if unit is not None:
        values = _convert(values, getattr(plain, "unit", None), unit, name, label)
    values[np.broadcast_to(mask, values.shape)] = np.nan
    return values


def _convert(values, own, unit, name, label):
    example = f"such as {unit}" if unit.to_string() else "that is dimensionless"
    if own is None:
        if unit == u.dimensionless_unscaled:
            return values
        raise ObservationError(f"{label}: column {name} has no unit, a unit {example} is needed")
    try:
        # a factor keeps the numbers untouched where the units agree
        factor = u.Unit(own).to(unit)
    except (u.UnitsError, TypeError, ValueError, AttributeError):
        raise ObservationError(
            f"{label}: column {name} has unit {one_line(own, 60)}, a unit {example} is needed"
        ) from None
    with np.errstate(over="ignore", under="ignore"):
        return values if factor == 1.0 else values * factor


def first_bad_row(bad, name, values, label, allowed):
    """
    Raise for the first row that is bad, if there is one.

    Parameters
    ----------
    bad : `~numpy.ndarray` of bool
        Shape (N,).
    name : str
        The column.
    values : sequence
        What to show of the row.
    label, allowed : str
        What to call the table, and what would have been allowed.

    Raises
    ------
    ObservationError
        Naming the row, counted from 1.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.observations.reading import first_bad_row
    >>> first_bad_row(np.array([False, True]), "hwp", [0, np.inf], "night", "finite angles")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: night, row 2: hwp = inf, allowed are finite angles
    """
    if np.any(bad):
        row = int(np.argmax(bad))
        raise ObservationError(
            f"{label}, row {row + 1}: {name} = {values[row]}, allowed are {allowed}"
        )
