# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether the parts of a calibration belong together."""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import AstropolcalError, CalibrationFileError
from astropolcal.measurement.parameters import FreeParameters, parameter_table

__all__ = ["check_calibration"]

# in the unit of its declaration (degree, mm, nm, adu, none): far above all that an instrument has
_LARGEST = 1e15
_ACCURACY = ("wavelength", "n", "k", "s_res", "s_mean", "s_cv")


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
        or identifiability are not those of the free parameters, a value is far
        outside its bounds, datasets of one optic disagree, or the numbers of
        chains and datasets differ.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.converters.consistency import check_calibration
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> cal.at_bound = ["hwp.thickness"]
    >>> check_calibration(cal)
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.CalibrationFileError: at_bound names 'hwp.thickness', which ...
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
    _check_values(calibration.chains)
    _check_shared(calibration.chains, free)
    _check_covariance(calibration.covariance, free)
    _check_identifiability(calibration.identifiability, free.names)
    _check_fit(calibration.fit)
    _check_words(calibration, free.names)


def _check_values(chains):
    """Refuse values that only damage can explain."""
    for name, parameters in parameter_table(chains).items():
        for parameter in parameters:
            low, high = _allowed(parameter.bounds)
            value = np.asarray(parameter.value, dtype=float)
            if not np.all((value >= low) & (value <= high)):
                raise CalibrationFileError(
                    f"{name} = {parameter.value}, which is far outside of its bounds "
                    f"{tuple(parameter.bounds)}; from {low:g} to {high:g} can be stored"
                )


def _allowed(bounds):
    """Return the range of values that can be, which is wider than the bounds of a fit."""
    low, high = bounds
    # a fitter without bounds leaves them now and then, a parameter that is held may be anywhere,
    # but neither by more than the distance between them
    one = next((bound for bound in bounds if bound is not None), 0.0)
    slack = max(abs(one), 1.0) if low is None or high is None or high == low else high - low
    lowest = -_LARGEST if low is None else max(low - slack, -_LARGEST)
    highest = _LARGEST if high is None else min(high + slack, _LARGEST)
    return lowest, highest


def _check_shared(chains, free):
    """Check that a fitted optic has the same values in all chains."""
    table = parameter_table(chains)
    for name in [*free.by_name, *free.ties]:
        # bit by bit: they were one number in the fit
        first, *others = (parameter.value for parameter in table[name])
        if not all(np.array_equal(first, other) for other in others):
            raise CalibrationFileError(f"{name} has different values in different datasets")


def _check_covariance(covariance, free):
    _check_names("covariance", covariance.names, free.names)
    # a parameter with one value a wavelength has as many rows of the covariance
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
        # rank and nullity add up to the number of parameters
        "null_vectors": (n - finding.rank, n),
        "identifiable": (n,),
    }
    for key, shape in shapes.items():
        found = np.shape(getattr(finding, key))
        if found != shape:
            raise CalibrationFileError(f"{key} have shape {found}, expected {shape}")


def _check_fit(fit):
    """Check what a schema does not: the pairs of frames at odds with the fit."""
    masked = fit.get("masked") or []
    if not isinstance(masked, list) or not all(isinstance(one, dict) for one in masked):
        raise CalibrationFileError("fit.masked is no list of reasons, one entry a dataset")
    numbers = ("residual_percent", "sigma", "brightness")
    outliers = fit.get("outliers") or []
    if not isinstance(outliers, list):
        raise CalibrationFileError(f"fit.outliers is a {type(outliers).__name__}, not a list")
    for one in outliers:
        good = isinstance(one, dict) and {"frames", "dataset", *numbers} <= set(one)
        if not good or not all(isinstance(one[key], int | float) for key in numbers):
            raise CalibrationFileError("fit.outliers lacks what a pair of frames is told by")


def _check_words(calibration, names):
    unknown = sorted(set(calibration.at_bound) - set(names))
    if unknown:
        raise CalibrationFileError(f"at_bound names {unknown[0]!r}, which is no free parameter")
    for record in calibration.datasets:
        known = _ACCURACY if record.accuracy is None else record.accuracy.colnames
        missing = [name for name in _ACCURACY if name not in known]
        if missing:
            raise CalibrationFileError(
                f"the accuracy of {record.name} has no column {', '.join(missing)}"
            )
        _check_accuracy(record)


def _check_accuracy(record):
    """Check that the columns of accuracies are numbers, one of each at every wavelength."""
    for name in _ACCURACY if record.accuracy is not None else ():
        column = record.accuracy[name]
        if column.dtype.kind not in "iuf" or column.ndim != 1:
            raise CalibrationFileError(
                f"the accuracy of {record.name}: {name} is no list of numbers"
            )
        # s_res, s_mean and s_cv are shares of the light, in percent
        unit = getattr(column, "unit", None) or u.one
        if name.startswith("s_") and not unit.is_equivalent(u.percent):
            raise CalibrationFileError(
                f"the accuracy of {record.name}: {name} is in {unit}, which is no fraction"
            )
    if record.accuracy is not None:
        length = u.Quantity(record.accuracy["wavelength"])
        if not length.unit.is_equivalent(u.um) or not np.all(length.value > 0):
            raise CalibrationFileError(
                f"the accuracy of {record.name}: wavelength = {length} must be positive lengths"
            )
