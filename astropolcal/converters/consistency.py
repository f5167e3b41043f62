# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether the parts of a calibration belong together."""

import astropy.units as u
import numpy as np

from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalError, CalibrationFileError
from astropolcal.files import one_line
from astropolcal.measurement.parameters import ROUNDING, FreeParameters, parameter_table

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
        or identifiability are not those of the free parameters, a value is
        outside of its bounds, datasets of one optic disagree, or the numbers of
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
    # another unit is the schema's to refuse
    if wavelength.unit.is_equivalent("um"):
        _check_laws(calibration.chains, wavelength.to_value("um"))
    _check_values(calibration.chains, free)
    _check_shared(calibration.chains, free)
    _check_covariance(calibration.covariance, free)
    _check_identifiability(calibration.identifiability, free.names)
    _check_fit(calibration.fit)
    _check_words(calibration, free.names)


def _check_laws(chains, wavelength):
    """Refuse wavelengths at which an optic has no matrix."""
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        try:
            leaf._dispersion(wavelength)
        except AstropolcalError as error:
            raise CalibrationFileError(f"{leaf.name}: {error}") from None


def _check_values(chains, free):
    """Refuse values that no fit gives, whatever the checksum says."""
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        for key in leaf.param_names:
            name, parameter = f"{leaf.name}.{key}", getattr(leaf, key)
            bounds = [parameter.bounds]
            if name not in free.by_name:
                # the bounds of a fit do not matter to what is held or tied, those of the optic do
                bounds.append(getattr(type(leaf), key).bounds)
            low = min(-_LARGEST if low is None else low for low, _ in bounds)
            high = max(_LARGEST if high is None else high for _, high in bounds)
            value = np.asarray(parameter.value, dtype=float)
            slack = ROUNDING * np.maximum(np.abs(value), 1.0)
            # written so that NaN is refused
            if not np.all((value >= low - slack) & (value <= high + slack)):
                raise CalibrationFileError(
                    f"{name} = {one_line(parameter.value)} is outside of its bounds, "
                    f"{low:g} to {high:g}"
                )


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
    if not _finite([finding.singular_values, finding.null_vectors]):
        raise CalibrationFileError("identifiability: its numbers must be finite")
    for direction in (*finding.directions, *finding.near_null):
        if not _finite(direction):
            words = one_line(direction["words"], 60)
            raise CalibrationFileError(f"identifiability: numbers of {words!r} must be finite")


def _finite(value):
    """Return whether all numbers of a tree are."""
    if isinstance(value, dict | list | tuple):
        return all(map(_finite, value.values() if isinstance(value, dict) else value))
    return value is None or isinstance(value, str) or bool(np.isfinite(value).all())


def _check_fit(fit):
    """Check what a schema does not: what is masked, at odds with the fit, or at a bound."""
    bounds = fit.get("bounds") or {}
    if not _are_bounds(bounds):
        raise CalibrationFileError("fit.bounds lacks what an error at a bound is told by")
    _check_sky(fit)
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


def _check_sky(fit):
    """Check what the accuracy on sky is worked out from, and the accuracy that is kept."""
    settings = {} if (found := fit.get("sky_settings")) is None else found
    if not isinstance(settings, dict) or not all(
        _is_numbers(angles) and np.isfinite(angles).all() for angles in settings.values()
    ):
        raise CalibrationFileError("fit.sky_settings must be finite angles, some for each stage")
    keys = ("wavelength_nm", "relative_percent", "absolute_percent")
    model = fit.get("model_error")
    if model is not None:
        lists = [model.get(key) for key in keys] if isinstance(model, dict) else [None]
        good = all(_is_numbers(one) and len(one) == len(lists[0]) for one in lists)
        if not good or not np.isfinite(lists).all() or np.min(lists) < 0:
            raise CalibrationFileError(
                f"fit.model_error must have {', '.join(keys)}, finite and of equal length"
            )
    kept = fit.get("sky_accuracy") or []
    columns = ("wavelength_nm", "s_q_percent", "s_u_percent", "s_p_percent", "s_chi_deg")
    if not isinstance(kept, list) or not all(
        isinstance(one, dict) and all(_is_numbers(one.get(key)) for key in columns) for one in kept
    ):
        raise CalibrationFileError(f"fit.sky_accuracy must have {', '.join(columns)}")


def _is_numbers(value):
    """Return whether a value is a list of numbers that is not empty."""
    plain = isinstance(value, list) and bool(value)
    return plain and all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)


def _are_bounds(bounds):
    """Return whether errors at bounds, and what hangs on these, are all there."""
    if not isinstance(bounds, dict):
        return False
    inward, released = (bounds.get(key, {}) for key in ("inward", "released"))
    if not (isinstance(inward, dict) and isinstance(released, dict)):
        return False
    return all(isinstance(value, float) for value in inward.values()) and all(
        isinstance(one, dict)
        and all(isinstance(one.get(key), float) for key in ("times", "slack", "without"))
        and isinstance(one.get("by"), list)
        and all(isinstance(name, str) for name in one["by"])
        for one in released.values()
    )


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
