# Licensed under a 3-clause BSD style license - see LICENSE
"""
Robust fits, and the frames that are at odds with a calibration.

A robust loss lets data that depart far from the model count less, by iterated weights: a
datum with residual r has the noise that a least-squares fit would need to give it the
weight of the loss. Nothing is dropped; `outlying_data` says which frames depart.
"""

import numpy as np
from astropy.table import QTable

from astropolcal.calibration.noise import data_by_wavelength
from astropolcal.exceptions import FitError
from astropolcal.observations.quality import MAD_TO_SIGMA

__all__ = ["LOSSES", "outlying_data", "robust_sigma"]

# noise of a wavelength is at least this share of the median of its dataset
_FLOOR = 0.1
# robust standard deviations beyond which a frame is at odds with the model
_FAR = 4.0
# smallest weight, so that no datum is lost altogether
_LEAST = 1e-4

#: Weight of a datum by its residual in units of the noise; the constants give 95 % of the
#: efficiency of least squares for normal noise (Holland & Welsch 1977,
#: doi:10.1080/03610927708827533).
LOSSES = {
    "linear": np.ones_like,
    "huber": lambda r: np.minimum(1.0, 1.345 / np.maximum(np.abs(r), 1e-300)),
    "cauchy": lambda r: 1 / (1 + (r / 2.385) ** 2),
    "bisquare": lambda r: np.clip(1 - (r / 4.685) ** 2, 0.0, None) ** 2,
}


def robust_sigma(measurement, loss):
    """
    Return the noise of every datum that gives it the weight of a robust loss.

    Parameters
    ----------
    measurement : Measurement
        At the values of a fit.
    loss : str
        One of `LOSSES`.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_data,).

    Raises
    ------
    FitError
        If the loss is unknown.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration.robust import robust_sigma
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> data = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> sigma = robust_sigma(Measurement(charis.chain(), data), "huber")
    >>> bool((sigma < 0.01).all())
    True
    """
    if loss not in LOSSES:
        raise FitError(f"loss = {loss!r}; allowed are {', '.join(LOSSES)}")
    residuals = measurement.residuals()
    scale = _scales(measurement, residuals)
    # least squares weighs by 1 / sigma^2: sigma = scale / sqrt(weight of the loss)
    return scale / np.sqrt(np.maximum(LOSSES[loss](residuals / scale), _LEAST))


def _scales(measurement, residuals):
    """Return the robust standard deviation of each datum's dataset and wavelength."""
    scale = np.empty(residuals.size)
    _, _, rows = data_by_wavelength(measurement)
    for row in rows:
        scale[row] = MAD_TO_SIGMA * np.median(np.abs(residuals[row])) if np.size(row) else 0.0
    for where in measurement.segments:
        least = _FLOOR * np.median(scale[where]) if scale[where].size else 0.0
        scale[where] = np.maximum(scale[where], max(least, 1e-12))
    return scale


def outlying_data(calibration, limit=_FAR):
    """
    Return the pairs of frames that are at odds with a calibration.

    The residuals of a pair, in units of the robust noise of its wavelength, are reduced to
    their median over the wavelengths, which is what a cloud, a satellite or a wrong angle
    changes. A pair is at odds if this departs by more than ``limit`` robust standard deviations
    of all pairs of its dataset.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    limit : float
        In robust standard deviations.

    Returns
    -------
    `~astropy.table.QTable`
        Largest first: ``dataset``, ``frames`` (numbers as text), ``residual`` (median over the
        wavelengths, percent), ``sigma`` (in robust standard deviations) and ``brightness`` (of
        the fainter frame, relative to the median frame). Empty if there is none.

    Raises
    ------
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import outlying_data
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(outlying_data(cal))
    0
    """
    live, rows = calibration.live_measurement(), []
    residuals = live.residuals()
    scaled = residuals / _scales(live, residuals)
    for part, where in zip(live.datasets, live.segments, strict=True):
        rows += _outliers(part, residuals[where], scaled[where], limit)
    rows.sort(key=lambda row: -row[3])
    names = ("dataset", "frames", "residual", "sigma", "brightness")
    units = {"residual": "percent"}
    table = QTable(rows=rows or None, names=names, dtype=(str, str, float, float, float))
    for name, unit in units.items():
        table[name].unit = unit
    return QTable(table)


def _outliers(part, residuals, scaled, limit):
    from astropolcal.observations.quality import brightness

    groups = np.unique(part.group_of_datum)
    members = [part.group_of_datum == g for g in groups]
    # one number a pair of frames, the median over its wavelengths
    common = np.array([np.median(scaled[rows]) for rows in members])
    off = common - np.median(common)
    # what noise alone gives a median of so many wavelengths
    least = np.array([1.25 / np.sqrt(rows.sum()) for rows in members])
    spread = np.maximum(MAD_TO_SIGMA * np.median(np.abs(off)), least)
    bright = brightness(part.observations)
    numbers = np.asarray(part.observations.frames["frame"])
    found = []
    for i in np.flatnonzero(np.abs(off) > limit * spread):
        frames = part.frames[groups[i]]
        found.append(
            (
                part.observations.name,
                ", ".join(str(n) for n in numbers[frames]),
                100 * float(np.median(residuals[members[i]])),
                float(np.abs(off[i]) / spread[i]),
                float(bright[frames].min()),
            )
        )
    return found
