# Licensed under a 3-clause BSD style license - see LICENSE
"""Standard errors of parameters, by the full covariance or as published calibrations quote them."""

import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability import _decompose, physical_scale
from astropolcal.exceptions import FitError

__all__ = ["standard_errors"]

METHODS = ("covariance", "van-holstein")
_STILL = 1e-5


def standard_errors(calibration, method="covariance"):
    r"""
    Return the standard errors of the free parameters.

    ``"covariance"`` takes all correlations into account. ``"van-holstein"`` is
    the error that calibrations of SPHERE/IRDIS and CHARIS quote (van Holstein
    et al. 2020, A&A 633, A64, Appendix E): each wavelength is a fit of its own
    in which the parameters common to all wavelengths are known, with
    covariance

    .. math:: s_\mathrm{res}^2 (J^T J)^{-1}, \qquad
              s_\mathrm{res}^2 = \frac{\sum_i r_i^2}{n - k},

    where J is the derivative of the n data of that wavelength to its k
    parameters. It is too small where the common parameters are uncertain, which
    is why the parameters held are named in the table's meta.

    Parameters
    ----------
    calibration : Calibration
        The calibration; with its data for ``"van-holstein"``.
    method : {"covariance", "van-holstein"}
        Which error.

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``name``, ``std`` and ``unit``, one row a parameter; NaN for
        those at a bound, that the data leave open, or (van Holstein) that are
        common to all wavelengths. ``meta`` has ``method`` and ``held``.

    Raises
    ------
    FitError
        If the method is unknown.
    CalibrationFileError
        If the data are needed but were not kept.

    Notes
    -----
    The formula is that of the published software of McIntosh et al. (2026),
    which says that it follows the appendix; it there falls back on a
    pseudo-inverse where the matrix is singular, here there is no number then.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import standard_errors
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> standard_errors(cal, method="van-holstein").meta["held"][:2]
    ['calibration_polarizer.theta', 'hwp.theta']
    """
    if method not in METHODS:
        raise FitError(f"method = {method!r}; allowed are {', '.join(METHODS)}")
    covariance = calibration.covariance
    held = []
    stds = covariance.stds
    if method == "van-holstein":
        stds = _per_wavelength(calibration)
        slots = calibration.measurement.free.slots
        held = [slot.name for slot in slots if not slot.per_wavelength]
    units = [str(unit or "") for unit in covariance.units]
    return QTable(
        {"name": covariance.names, "std": stds, "unit": units},
        meta={"method": method, "held": held},
    )


def _per_wavelength(calibration):
    """Return the errors of fits wavelength by wavelength, in declared units."""
    measurement = calibration._live()
    free, weights = measurement.free, calibration._weights()
    weights = 1.0 if weights is None else weights
    jacobian = measurement.jacobian(measurement.vector()) * weights
    residuals = measurement.residuals() * weights
    at_bound, names = set(calibration.at_bound), free.names
    stds = np.full(free.size, np.nan)
    for i in range(len(measurement.wavelength)):
        own = [slot.start + i for slot in free.slots if slot.per_wavelength]
        own = np.array([j for j in own if names[j] not in at_bound], dtype=int)
        rows = measurement.bins == i
        if own.size and rows.sum() > own.size:
            scale = physical_scale(free)[own]
            unit_noise = _stds(jacobian[np.ix_(own, rows)].T * scale) * scale
            variance = np.sum(residuals[rows] ** 2) / (rows.sum() - own.size)
            stds[own] = np.sqrt(variance) * unit_noise
    return stds / free.factors()


def _stds(jacobian):
    """Return the errors for unit noise, NaN for what the data leave open."""
    singular, right, rank = _decompose(jacobian)
    stds = np.linalg.norm(right[:rank] / singular[:rank, None], axis=0)
    return np.where((np.abs(right[rank:]) > _STILL).any(axis=0), np.nan, stds)
