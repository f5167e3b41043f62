# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether the parts of a calibration belong together."""

import numpy as np

from astropolcal.exceptions import AstropolcalError, CalibrationFileError
from astropolcal.measurement.parameters import FreeParameters, parameter_table

__all__ = ["check_calibration"]


def check_calibration(calibration):
    """
    Check shapes, names and units of a calibration against each other.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Raises
    ------
    CalibrationFileError
        If the sizes of the parameters do not fit the wavelengths, covariance
        or identifiability are not those of the free parameters, datasets of
        one optic disagree, or the numbers of chains and datasets differ.
    """
    wavelength = calibration.wavelength
    if np.ndim(wavelength) != 1 or not np.all(wavelength.value > 0):
        raise CalibrationFileError(f"wavelength = {wavelength} must be a list of positive lengths")
    if len(calibration.chains) != len(calibration.datasets):
        raise CalibrationFileError(
            f"{len(calibration.chains)} chains but {len(calibration.datasets)} datasets"
        )
    try:
        free = FreeParameters(calibration.chains, len(wavelength), calibration.ties)
    except AstropolcalError as error:
        raise CalibrationFileError(str(error)) from None
    _check_shared(calibration.chains, free)
    _check_covariance(calibration.covariance, free)
    _check_identifiability(calibration.identifiability, free.names)
    _check_words(calibration, free.names)


def _check_shared(chains, free):
    """Check that a fitted optic has the same values in all chains."""
    table = parameter_table(chains)
    for name in [*free.by_name, *free.ties]:
        first, *others = (parameter.value for parameter in table[name])
        if not all(np.array_equal(first, other) for other in others):
            raise CalibrationFileError(f"{name} has different values in different datasets")


def _check_covariance(covariance, free):
    _check_names("covariance", covariance.names, free.names)
    units = [slot.unit for slot in free.slots for _ in range(slot.size)]
    for name, unit, expected in zip(free.names, covariance.units, units, strict=True):
        if unit != expected:
            raise CalibrationFileError(f"covariance of {name} is in {unit}, allowed is {expected}")


def _check_names(what, names, expected):
    if names == expected:
        return
    if len(names) != len(expected):
        raise CalibrationFileError(
            f"{what} of {len(names)} parameters, but {len(expected)} are free in the chains"
        )
    wrong = next(pair for pair in zip(names, expected, strict=True) if pair[0] != pair[1])
    raise CalibrationFileError(f"{what} of {wrong[0]!r}, where {wrong[1]!r} is free in the chains")


def _check_identifiability(finding, names):
    _check_names("identifiability", finding.names, names)
    n = len(names)
    shapes = {
        "singular_values": (n,),
        "null_vectors": (n - finding.rank, n),
        "identifiable": (n,),
    }
    for key, shape in shapes.items():
        found = np.shape(getattr(finding, key))
        if found != shape:
            raise CalibrationFileError(f"{key} have shape {found}, expected {shape}")


def _check_words(calibration, names):
    unknown = sorted(set(calibration.at_bound) - set(names))
    if unknown:
        raise CalibrationFileError(f"at_bound names {unknown[0]!r}, which is no free parameter")
    for record in calibration.datasets:
        missing = {"wavelength", "n", "k", "s_res", "s_mean", "s_cv"}
        missing -= set(record.accuracy.colnames if record.accuracy is not None else missing)
        if missing:
            raise CalibrationFileError(
                f"the accuracy of {record.name} lacks the columns {sorted(missing)}"
            )
