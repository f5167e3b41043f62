# Licensed under a 3-clause BSD style license - see LICENSE
"""
Why cells of an observation table cannot be used.

A bad cell is masked with a reason, never dropped in silence: the first time a
table is read, one warning a reason says how many cells and where the first is.
"""

import warnings

import numpy as np

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.words import counted

__all__ = ["mask_missing", "mask_rows"]

# beyond this, and below its inverse, squares would overflow
_HUGE = 1e100


def mask_rows(table, values, label):
    """
    Judge every row of a table.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        A checked table; its column ``mask_reason`` is respected where it exists.
    values : dict of `~numpy.ndarray`
        Both fluxes, then both errors if there are any, each (N,).
    label : str
        What to call the table in messages.

    Returns
    -------
    code : `~numpy.ndarray` of int
        Shape (N,): 0 usable, otherwise 1 + index of the reason.
    reasons : list of str
        The reasons found.

    Raises
    ------
    ObservationError
        If the column ``mask_reason`` holds no strings.

    Warns
    -----
    AstropolcalWarning
        Once for every reason that the table does not declare itself.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from astropolcal.observations.masking import mask_rows
    >>> table = QTable({"mask_reason": ["", "saturated"]})
    >>> values = {"flux_right": np.array([3.0, 9.0]), "flux_left": np.array([1.0, 9.0])}
    >>> code, reasons = mask_rows(table, values, "night")
    >>> code.tolist(), reasons
    ([0, 1], ['saturated'])
    """
    # what the file declares was warned of when it was made
    code, reasons = _declared_reasons(table, label)
    for names, bad, reason in _complaints(values):
        # the first reason stays
        bad &= code == 0
        if bad.any():
            code[bad] = _number(reason, reasons)
            row = int(np.argmax(bad))
            shown = ", ".join(f"{name} = {values[name][row]:g}" for name in names)
            first = f"row {row + 1}: {shown}; allowed are finite numbers above zero"
            _warn(label, int(bad.sum()), reason, first)
    return code, reasons


def _complaints(values):
    """Yield what may be wrong with single rows: columns, bad rows, reason."""
    names = list(values)
    for kind, pair in (("flux", names[:2]), ("error", names[2:])):
        if pair:
            both = np.array([values[name] for name in pair])
            # NaN compares as false and is lost too
            lost = ~(np.abs(both) < _HUGE).all(axis=0)
            yield pair, lost.copy(), f"{kind} not finite"
            yield pair, ~lost & (both < 1.0 / _HUGE).any(axis=0), f"{kind} not positive"


def _declared_reasons(table, label):
    """Read the column ``mask_reason``, which a written table has where cells were masked."""
    code = np.zeros(len(table), dtype=int)
    if "mask_reason" not in table.colnames:
        return code, []
    column = table["mask_reason"]
    if column.dtype.kind not in "US":
        raise ObservationError(
            f"{label}: column mask_reason has type {column.dtype}, strings are needed"
        )
    # an empty string in ECSV may come back as a masked value
    # code 0 means usable
    text = np.where(getattr(column, "mask", False), "", np.ma.getdata(column).astype(str))
    reasons = [str(reason) for reason in np.unique(text) if reason]
    for number, reason in enumerate(reasons):
        code[text == reason] = number + 1
    return code, reasons


def mask_missing(code, reasons, frame_numbers, bin_numbers, label):
    """
    Give cells without a row (code -1) the reason "missing", in place.

    Parameters
    ----------
    code : `~numpy.ndarray` of int
        Shape (F, W), as from `mask_rows`; changed.
    reasons : list of str
        The reasons so far; extended.
    frame_numbers, bin_numbers : `~numpy.ndarray` of int
        Shape (F,) and (W,).
    label : str
        What to call the table in messages.

    Warns
    -----
    AstropolcalWarning
        If a cell is missing.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.observations.masking import mask_missing
    >>> reasons = []
    >>> mask_missing(np.zeros((2, 1), dtype=int), reasons, [0, 1], [0], "night")
    >>> reasons
    []
    """
    # a hole in the grid is masked like a bad value: a pair that needs it drops out
    missing = code < 0
    if missing.any():
        code[missing] = _number("missing", reasons)
        frame, column = np.argwhere(missing)[0]
        first = f"frame {frame_numbers[frame]}, bin {bin_numbers[column]} has no row"
        _warn(label, int(missing.sum()), "missing", first)


def _number(reason, reasons):
    """Return the code of a reason, adding it to the list where it is new."""
    if reason not in reasons:
        reasons.append(reason)
    return reasons.index(reason) + 1


def _warn(label, count, reason, first):
    message = f"{label}: {counted(count, 'cell')} masked, {reason} (first: {first})"
    warnings.warn(message, AstropolcalWarning, stacklevel=2)
