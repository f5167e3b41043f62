# Licensed under a 3-clause BSD style license - see LICENSE
"""
A reduced target as `specutils.Spectrum` objects, and back.

The table of a target has one row per wavelength: ``wavelength``, ``intensity``,
``q``, ``u`` and, if measured, ``v``, each with its standard deviation in a column
that ends in ``_err``. ``covariance_qu``, systematic errors (``q_systematic``, ...)
and ``mask`` (true where a row must not be used) are optional. The table that a
correction writes, with ``I`` and ``q_statistical``, is understood as well.
"""

import astropy.units as u
import numpy as np
from astropy.nddata import StdDevUncertainty
from astropy.table import QTable

from astropolcal.exceptions import ObservationError
from astropolcal.observations.reading import numeric_column, read_ecsv, write_table

__all__ = ["read_spectra", "spectra_from_table", "table_from_spectra", "write_spectra"]

_NAMES = {"I": "intensity", "q": "q", "u": "u", "v": "v"}
_REQUIRED = ("I", "q", "u")
_COVARIANCE, _SYSTEMATIC = "covariance_qu", "systematic"


def spectra_from_table(table):
    """
    Return the spectra of a reduced target.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Columns ``wavelength``, ``intensity``, ``q``, ``u``, optionally ``v``, and their standard
        deviations (``intensity_err``, ...); optionally ``covariance_qu``, ``intensity_systematic``,
        ... and ``mask``. Or the table of a correction (`astropolcal.correction`), with ``I``,
        ``q_statistical``, ...; rows that are not ``determined`` are masked.

    Returns
    -------
    dict of str to `~specutils.Spectrum`
        ``"I"``, ``"q"``, ``"u"`` and, if it is there, ``"v"``, on one spectral axis in
        the order of the wavelengths. ``meta`` is that of the table; ``covariance_qu``,
        one value per wavelength, stands in that of ``q`` and ``u``, a systematic error
        as ``systematic`` in that of its spectrum.

    Raises
    ------
    ObservationError
        If a column is missing or has the wrong unit, a value that is not masked is
        not finite, an error is negative, or a wavelength is given twice.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal.reduction import spectra_from_table
    >>> table = QTable({"wavelength": [1.2, 1.6] * u.um, "intensity": [900, 800] * u.adu,
    ...                 "intensity_err": [3, 3] * u.adu, "q": [0.010, 0.008],
    ...                 "q_err": [2e-4, 2e-4], "u": [0.0, 0.001], "u_err": [2e-4, 2e-4]})
    >>> spectra = spectra_from_table(table)
    >>> print(spectra["q"].flux, spectra["q"].spectral_axis)
    [0.01  0.008] [1.2 1.6] um
    """
    from specutils import Spectrum

    table, mask = _checked(table)
    spectra = {}
    for key, name in _NAMES.items():
        if name not in table.colnames:
            continue
        # each spectrum its own: a user may change one
        meta, unit = dict(table.meta), table[name].unit
        if key in ("q", "u") and _COVARIANCE in table.colnames:
            meta[_COVARIANCE] = table[_COVARIANCE].to_value(u.one)
        if f"{name}_{_SYSTEMATIC}" in table.colnames:
            # in the unit of the spectrum: meta have none
            meta[_SYSTEMATIC] = table[f"{name}_{_SYSTEMATIC}"].to_value(unit)
        settings = {"flux": table[name], "spectral_axis": table["wavelength"], "meta": meta}
        uncertainty = StdDevUncertainty(table[f"{name}_err"].to(unit))
        spectra[key] = Spectrum(**settings, uncertainty=uncertainty, mask=mask.copy())
    return spectra


def table_from_spectra(spectra):
    """
    Return the table of a target from its spectra, the inverse of `spectra_from_table`.

    Parameters
    ----------
    spectra : dict of str to `~specutils.Spectrum`
        ``"I"``, ``"q"``, ``"u"`` and optionally ``"v"``: one-dimensional, on the same
        spectral axis (a wavelength, frequency or energy), each with an uncertainty of
        any kind that has a standard deviation.

    Returns
    -------
    `~astropy.table.QTable`
        A row is masked where one of the spectra is; meta are those of ``"I"``.

    Raises
    ------
    ObservationError
        If a spectrum is missing, has no uncertainty, or is on another axis.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal.reduction import spectra_from_table, table_from_spectra
    >>> table = QTable({"wavelength": [1.2, 1.6] * u.um, "intensity": [900, 800] * u.adu,
    ...                 "intensity_err": [3, 3] * u.adu, "q": [0.010, 0.008],
    ...                 "q_err": [2e-4, 2e-4], "u": [0.0, 0.001], "u_err": [2e-4, 2e-4]})
    >>> table_from_spectra(spectra_from_table(table))["q"]
    <Quantity [0.01 , 0.008]>
    """
    missing = [key for key in _REQUIRED if key not in spectra]
    unknown = [str(key) for key in spectra if key not in _NAMES]
    if missing or unknown:
        raise ObservationError(
            f"spectra: missing {', '.join(missing) or 'none'}, unknown "
            f"{', '.join(unknown) or 'none'}; needed are I, q, u, and v if measured"
        )
    axes = {}
    for key, spectrum in spectra.items():
        if np.ndim(spectrum.flux) != 1:
            raise ObservationError(f"spectrum {key}: {np.ndim(spectrum.flux)} axes; 1 is needed")
        axis = u.Quantity(spectrum.spectral_axis)
        # frequencies and energies run the other way; the table is sorted later
        if not axis.unit.is_equivalent(u.um, u.spectral()):
            raise ObservationError(
                f"spectrum {key}: its axis is in {axis.unit}; a wavelength, frequency or energy is "
                "needed"
            )
        axes[key] = axis if axis.unit.is_equivalent(u.um) else axis.to(u.um, u.spectral())
    first = axes["I"]
    for key, axis in axes.items():
        # without an absolute tolerance, which would be 10 nm for an axis in metres
        if axis.shape != first.shape or not u.allclose(axis, first, rtol=1e-5):
            raise ObservationError(f"spectrum {key}: is on another spectral axis than I")
    table = QTable({"wavelength": first})
    table["mask"] = np.zeros(len(table), dtype=bool)
    for key in (key for key in _NAMES if key in spectra):
        spectrum, name = spectra[key], _NAMES[key]
        if spectrum.uncertainty is None:
            raise ObservationError(f"spectrum {key}: has no uncertainty")
        deviation = spectrum.uncertainty.represent_as(StdDevUncertainty)
        unit = deviation.unit or spectrum.flux.unit
        table[name], table[f"{name}_err"] = spectrum.flux, u.Quantity(deviation.array, unit)
        _take(table, f"{name}_{_SYSTEMATIC}", spectrum, key, _SYSTEMATIC, table[name].unit)
        if spectrum.mask is not None:
            table["mask"] |= np.asarray(spectrum.mask, dtype=bool)
    _take(table, _COVARIANCE, spectra["q"], "q", _COVARIANCE, u.one)
    own = ("header", _COVARIANCE, _SYSTEMATIC)
    table.meta = {k: v for k, v in spectra["I"].meta.items() if k not in own}
    return _checked(table)[0]


def write_spectra(spectra, path, *, overwrite=False):
    """
    Write the spectra of a target to one ECSV file.

    Parameters
    ----------
    spectra : dict of str to `~specutils.Spectrum`
        As `spectra_from_table` returns them.
    path : path-like
        The file.
    overwrite : bool
        Whether a file that exists is replaced.

    Raises
    ------
    ObservationError
        If the spectra do not belong together, or the file exists or cannot be written.

    Examples
    --------
    >>> from astropolcal.reduction import write_spectra
    >>> write_spectra({}, "target.ecsv")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: spectra: missing I, q, u, ...
    """
    write_table(table_from_spectra(spectra), path, overwrite)


def read_spectra(path):
    """
    Read the spectra of a target.

    Parameters
    ----------
    path : path-like
        An ECSV file with the columns of `spectra_from_table`.

    Returns
    -------
    dict of str to `~specutils.Spectrum`

    Raises
    ------
    ObservationError
        If the file is absent, unreadable or inconsistent.

    Examples
    --------
    >>> from astropolcal.reduction import read_spectra
    >>> read_spectra("nowhere.ecsv")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: nowhere.ecsv: no such file
    """
    try:
        return spectra_from_table(QTable(read_ecsv(path)))
    except ObservationError as error:
        if str(error).startswith(str(path)):
            raise
        raise ObservationError(f"{path}: {error}") from error


def _checked(table):
    """Return the table in the order of the wavelengths, and its mask, or refuse it."""
    table = QTable(table, copy=True)
    if "I" in table.colnames and "intensity" not in table.colnames:
        # the table of a correction
        names = {"I": "intensity", f"{_COVARIANCE}_statistical": _COVARIANCE}
        for key, name in _NAMES.items():
            names |= {f"{key}_statistical": f"{name}_err"}
            names |= {f"{key}_{_SYSTEMATIC}": f"{name}_{_SYSTEMATIC}"}
        for old, new in names.items():
            if old in table.colnames and old != new:
                table.rename_column(old, new)
        if "determined" in table.colnames and "mask" not in table.colnames:
            table["mask"] = ~_flags(table, "determined", unknown=False)
    names = [_NAMES[key] for key in _REQUIRED] + ["v"] * ("v" in table.colnames)
    needed = ["wavelength", *names, *(f"{name}_err" for name in names)]
    missing = [name for name in needed if name not in table.colnames]
    if missing:
        raise ObservationError(f"target: missing columns {', '.join(missing)}")
    if not len(table):
        raise ObservationError("target: no rows")
    table["wavelength"] = wavelength = _with_unit(table, "wavelength", u.um)
    if not np.all(np.isfinite(wavelength) & (wavelength > 0)):
        raise ObservationError("target: a wavelength is not positive")
    table.sort("wavelength")
    wavelength = table["wavelength"]
    # sorted already: equal ones are neighbours
    twice = wavelength[1:][np.diff(wavelength) == 0]
    if twice.size:
        raise ObservationError(f"target: wavelength {twice[0]} is given twice")
    masked = "mask" in table.colnames
    mask = _flags(table, "mask", unknown=True) if masked else np.zeros(len(table), dtype=bool)
    units = {_COVARIANCE: u.one}
    for name in names:
        unit = u.Quantity(table[name]).unit if name == "intensity" else u.one
        units |= dict.fromkeys([name, f"{name}_err", f"{name}_{_SYSTEMATIC}"], unit)
    for column in [column for column in units if column in table.colnames]:
        table[column] = _with_unit(table, column, units[column])
        values, error = table[column].value, column.endswith(("_err", f"_{_SYSTEMATIC}"))
        # what a calibration leaves open has an infinite systematic error
        known = ~np.isnan(values) if column.endswith(_SYSTEMATIC) else np.isfinite(values)
        bad = (~known | (values < 0 if error else False)) & ~mask
        if bad.any():
            row = np.flatnonzero(bad)[0]
            raise ObservationError(
                f"target: {column} = {values[row]} at {wavelength[row]}; "
                f"{'a number not negative' if error else 'a finite number'} "
                "is needed where the row is not masked"
            )
    return table, mask


def _flags(table, name, unknown):
    """Return a column of true and false, or of 1 and 0; a masked one counts as ``unknown``."""
    column = table[name]
    column = np.ma.array(getattr(column, "unmasked", column), mask=getattr(column, "mask", False))
    # of a text numpy would say that it is not empty
    if column.dtype.kind not in "biu" or column.ndim != 1:
        raise ObservationError(f"target: {name} must be true or false in each row")
    return column.astype(bool).filled(unknown)


def _with_unit(table, column, unit):
    """Return a column as a Quantity of the kind of the unit, NaN where it is masked."""
    # refused in another unit, and kept in its own
    numeric_column(table, column, "target", unit)
    return numeric_column(table, column, "target") * (table[column].unit or u.one)


def _take(table, column, spectrum, key, name, unit):
    """Put what stands in the meta of a spectrum into the table, if it is there."""
    values = spectrum.meta.get(name)
    if values is None:
        return
    if np.shape(values) != (len(table),):
        raise ObservationError(
            f"spectrum {key}: {name} has shape {np.shape(values)} for {len(table)} "
            "wavelengths; meta are not cut with a spectrum"
        )
    table[column] = np.asarray(values) * unit
