# Licensed under a 3-clause BSD style license - see LICENSE
"""
Safe reading and checked columns of an observation table.

Files come from anywhere, so everything that is wrong with one ends in a single-line
`~astropolcal.exceptions.ObservationError` that names the file and the place.
Nothing in a file is executed: the text goes through the safe loader of astropy,
and columns of Python objects are refused.
"""

import io
import os
import re
import textwrap
import warnings
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import ascii
from astropy.table import QTable, Table

from astropolcal.exceptions import ObservationError
from astropolcal.files import atomic_path, check_new, check_yaml, one_line, understood
from astropolcal.units import iso_date, plain_number, wavelengths_of
from astropolcal.words import check_type

__all__ = []

# real headers have 1 to 3 kB; the YAML loader needs seconds for a quarter of a megabyte
_MAX_HEADER = 2**18
# a text in which there may be numbers such as 1_000, or digits of another script
_ODD_NUMBERS = re.compile(r"[0-9]_[0-9]|[^\x00-\x7f]")
_SINGLE = ("single_difference", "single_sum")


def read_ecsv(path):
    """Read an ECSV file into a table without trusting it."""
    wanted = "it cannot be read; the name of a file is needed, and from_table takes a table"
    check_type("path", path, (str, os.PathLike), wanted, ObservationError)
    with understood(path, ObservationError, "cannot be read: not a text file of ECSV"):
        # read once: what is checked is what is loaded, even if the file changes meanwhile
        text = Path(path).read_bytes().decode("utf-8")
    # astropy would guess another format, and make one column of it
    if not text.startswith("# %ECSV"):
        raise ObservationError(
            f"{path}: not an ECSV table; its first line must start with '# %ECSV'; "
            "astropy writes such a file of a QTable with units, by table.write('NAME.ecsv')"
        )
    with understood(path, ObservationError, "not a readable ECSV table"):
        _check_header(path, text)
        # doubtful units and types are errors below
        with warnings.catch_warnings(action="ignore"):
            try:
                table = QTable.read(io.BytesIO(text.encode()), format="ascii.ecsv")
            except ValueError:
                # astropy does not say which row it is; without a header there are no columns
                with suppress(AttributeError):
                    _check_numbers(path, text)
                raise
            if _ODD_NUMBERS.search(text):
                _check_numbers(path, text)
        return table


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
        if "datatype" not in "".join(lines):
            raise ObservationError("its header describes no columns (datatype)")
    except ObservationError as error:
        raise ObservationError(f"{path}: not a readable ECSV table: {error}") from None


def _check_numbers(path, text):
    """Refuse what is not a number, or is one to Python although no program writes it so."""
    reader = ascii.get_reader(ascii.Ecsv)
    with suppress(ValueError):
        reader.read(text)
    for column in (c for c in reader.cols if c.dtype.startswith(("int", "uint", "float"))):
        for row, cell in enumerate(column.str_vals):
            try:
                plain_number(cell)
            except ValueError:
                raise ObservationError(
                    f"{path}, row {row + 1}: {column.name} = {one_line(cell, 40)}, "
                    "allowed are numbers such as 1000 or 1e3"
                ) from None


def write_table(table, path, overwrite=False):
    """Write a table as ECSV, completely or not at all."""
    path = check_new(path, overwrite, ObservationError)
    # its meta may hold what YAML cannot represent
    with (
        understood(path, ObservationError, "cannot be written", reads=False),
        atomic_path(path, ObservationError) as temporary,
    ):
        table.write(temporary, format="ascii.ecsv", overwrite=True)


def check_table(table, label, required):
    """
    Return a table as a QTable, or refuse it.

    It needs rows, the required columns, of which all that are missing are named at once, and plain
    values.
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
        column = table[name]
        dtype = getattr(column, "dtype", None)
        # objects and structures hold anything: there is no value that could be checked
        if dtype is not None and dtype.kind in "OV":
            raise ObservationError(
                f"{label}: column {name} has type {dtype}; allowed are numbers, strings and times"
            )
        if getattr(column, "shape", (0,))[1:]:
            raise ObservationError(
                f"{label}: column {name} has shape {column.shape}, one value per row is allowed"
            )
    return table if isinstance(table, QTable) else QTable(table, copy=False)


def stated_date(meta, label, error=ObservationError):
    """
    Return the date in the meta of a table in ISO form, perhaps a month alone; None without one.

    ``error`` is raised for a date that cannot be understood.
    """
    value = meta.get("date")
    if value is None or not str(value).strip():
        return None
    return iso_date(value, f"{label}: date in the meta", error, months=True)


def dates_of(tables, error=ObservationError):
    """Return the dates of tables that state one, the oldest first."""
    dates = (stated_date(table.meta, table.name, error) for table in tables)
    # a month alone begins on its first day
    return sorted(f"{d}-01" if len(d) == len("2025-10") else d for d in dates if d is not None)


def complete_table(table, label):
    """Return a table of single differences and sums as one of beam fluxes.

    Where neither ``frame`` nor ``bin`` is there, each row is a frame of one wavelength; a missing
    ``wavelength`` is that of the meta, ``wavelength`` or ``filter``. Frames of single differences
    with a column ``flc_state`` are paired by it, unless the meta say ``pairing: hwp``.
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
        check_table(table, label, _SINGLE)
        unit = getattr(table[_SINGLE[0]], "unit", None) or u.dimensionless_unscaled
        difference, total = (numeric_column(table, name, label, unit) for name in _SINGLE)
        # what is beyond all numbers becomes infinite, and is masked like that
        with np.errstate(over="ignore", invalid="ignore"):
            new["flux_right"] = 0.5 * (total + difference) * unit
            new["flux_left"] = 0.5 * (total - difference) * unit
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


def numeric_column(table, name, label, unit=None, like=None):
    """
    Return a column of a checked table as floats in ``unit`` (a copy), NaN where it is masked.

    ``like`` is the column whose unit that is, if it is that of another one.
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
        values = _convert(values, getattr(plain, "unit", None), unit, name, label, like)
    values[np.broadcast_to(mask, values.shape)] = np.nan
    return values


def _convert(values, own, unit, name, label, like):
    example = f"such as {unit}" if unit.to_string() else "that is dimensionless"
    why = "" if like in (None, name) else f", as {like} has it"
    if own is None:
        if unit == u.dimensionless_unscaled:
            return values
        raise ObservationError(
            f"{label}: column {name} has no unit, a unit {example} is needed{why}"
        )
    try:
        # a factor keeps the numbers untouched where the units agree
        factor = u.Unit(own).to(unit)
    except (u.UnitsError, TypeError, ValueError, AttributeError):
        raise ObservationError(
            f"{label}: column {name} has unit {one_line(own, 60)}, a unit {example} is needed{why}"
        ) from None
    with np.errstate(over="ignore", under="ignore"):
        return values if factor == 1.0 else values * factor


def first_bad_row(bad, name, values, label, allowed):
    """Raise for the first row that is bad, if there is one, with its value and what is allowed."""
    if np.any(bad):
        row = int(np.argmax(bad))
        raise ObservationError(
            f"{label}, row {row + 1}: {name} = {values[row]}, allowed are {allowed}"
        )


# ---- wavelengths ---------------------------------------------------------------------------------

_FILTERS = Path(__file__).parents[1] / "data" / "filters.ecsv"

#: Wavelengths of two tables are the same when they agree to this share.
SAME_WAVELENGTH = 1e-5


# by how much, relative, a wavelength that is stated may be off the middle of its filter
_OF_FILTER = 0.07


def nearest_bins(wavelength, grid):
    """Return the bin of a grid that is nearest to each wavelength, and which are off the grid."""
    nearest = np.abs(wavelength[:, None] - grid).argmin(axis=1)
    return nearest, np.abs(grid[nearest] - wavelength) > SAME_WAVELENGTH * wavelength


def bins_on_grid(observations, grid):
    """Return the bin of a grid, micrometre, of each wavelength; refuse what is off it."""
    own = observations.wavelength.to_value(u.um)
    nearest, off = nearest_bins(own, grid)
    if off.any():
        raise ObservationError(
            f"{observations.name}: {off.sum()} of {own.size} wavelengths, such as "
            f"{1e3 * own[off][0]:.3f} nm, are none of the {grid.size} of the parameters, "
            f"{1e3 * grid.min():.3f} to {1e3 * grid.max():.3f} nm "
            f"(nearest {1e3 * grid[nearest][off][0]:.3f} nm)"
        )
    return nearest


def common_wavelengths(observations, wavelength=None):
    """Return the grid given, or the union of the wavelengths of datasets, ascending, micrometre."""
    if wavelength is not None:
        return np.atleast_1d(wavelengths_of(wavelength).to_value(u.um))
    # compared with the next lower one, so that a chain of near values keeps its first
    merged = np.sort(np.concatenate([obs.wavelength.to_value(u.um) for obs in observations]))
    return merged[np.diff(merged, prepend=-np.inf) > SAME_WAVELENGTH * merged]


def filter_wavelength(instrument, name):
    """
    Return the central wavelength of a filter of "VAMPIRES", "SCExAO/VAMPIRES" or another.

    Case, blanks and hyphens do not matter.
    """
    own = _filters().get(_plain(str(instrument).split("/")[-1]), {})
    known = {_plain(label): wavelength for label, wavelength in own.items()}
    # headers write 625-50, people 625 50
    if _plain(name) not in known:
        allowed = ", ".join(own) or "none; give the wavelength"
        raise ObservationError(
            f"{instrument}: no wavelength is known of filter {name!r}; known are {allowed}"
        )
    return known[_plain(name)]


def stated_wavelength(meta, label):
    """
    Return the wavelength that the meta state for all rows; None if they state none.

    By ``wavelength`` ("625 nm"), or by ``filter`` and ``instrument``.
    """
    value, named = meta.get("wavelength"), None
    if meta.get("filter") is not None:
        try:
            named = filter_wavelength(meta.get("instrument"), meta["filter"])
        except ObservationError as error:
            if value is None:
                raise ObservationError(f"{label}: {error}") from None
    if value is None:
        return named
    try:
        length = plain_number(value, u.Quantity)
        good = length.isscalar and length.to_value(u.um) > 0
    except (TypeError, ValueError, u.UnitsError):
        good = False
    if not good:
        raise ObservationError(
            f"{label}: wavelength = {value!r} in the meta; allowed is one length such as '625 nm'"
        )
    if named is not None and abs(length / named - 1) > _OF_FILTER:
        raise ObservationError(
            f"{label}: wavelength = {value!r} in the meta, but filter {meta['filter']!r} has "
            f"{named:g}; which of both?"
        )
    return length


def _plain(name):
    return "".join(c for c in str(name).lower() if c.isalnum())


@lru_cache(maxsize=1)
def _filters():
    """Return instrument to name of filter to wavelength."""
    found = {}
    for row in QTable.read(_FILTERS, format="ascii.ecsv"):
        # by the instrument first: a name such as H means another wavelength elsewhere
        found.setdefault(_plain(row["instrument"]), {})[str(row["filter"])] = row["wavelength"]
    return found
