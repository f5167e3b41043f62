# Licensed under a 3-clause BSD style license - see LICENSE
"""
A fingerprint of a table that does not depend on how its numbers are written.
"""

import hashlib

import astropy.units as u
import numpy as np
from astropy.time import Time

from astropolcal.exceptions import ParameterError
from astropolcal.units import canonical_unit

__all__ = ["hash_columns"]


def hash_columns(columns, header=""):
    """
    Return the SHA-256 of named columns.

    Parameters
    ----------
    columns : dict
        Arrays, quantities, times or table columns by name, in any order. Numbers
        count to 12 significant digits, angles and lengths in canonical units.
    header : str
        More text that belongs to the content.

    Returns
    -------
    str
        64 hexadecimal digits.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.observations.hashing import hash_columns
    >>> hash_columns({"hwp": [45.0] * u.deg}) == hash_columns({"hwp": [2700.0] * u.arcmin})
    True
    """
    digest = hashlib.sha256(header.encode())
    # the order of columns in a file says nothing
    for name in sorted(columns):
        # the name separates columns, or moving a value to the next one would go unnoticed
        unit, text = _canonical(columns[name])
        digest.update(f"\n{name}|{unit}|{text}".encode())
    return digest.hexdigest()


def _canonical(column):
    """Return the unit and the values of a column as text that formats cannot change."""
    unit = getattr(column, "unit", None)
    if isinstance(column, Time):
        column = column.mjd
    elif isinstance(column, u.Quantity):
        try:
            unit = canonical_unit(unit)
            column = column.to_value(unit)
        # units that are neither angles nor lengths, such as adu, stay as they are
        except ParameterError:
            column = column.value
    if not isinstance(column, np.ndarray):
        return unit, "\x1f".join(str(value) for value in column)  # coordinates and the like
    mask = np.asarray(getattr(column, "mask", False))
    values = np.ma.getdata(getattr(column, "unmasked", column))
    if values.dtype.kind in "iuf":
        # adding zero turns -0 into 0
        # 12 digits: what conversions between units leave of a double
        values = np.char.mod("%.11e", np.asarray(values, dtype=float) + 0.0)
    elif values.dtype.kind in "US":
        # a file of text has no blanks about a word, and a word that is empty is masked in it
        values = np.char.strip(values.astype(str))
        mask = mask | (values == "")
    # what lies below a mask is not content
    values = np.where(mask, "masked", np.asarray(values).astype(str))
    return unit, "\x1f".join(values.ravel().tolist())
