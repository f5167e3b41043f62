# Licensed under a 3-clause BSD style license - see LICENSE
"""
Accuracy of a calibration per wavelength: s_res, s_mean and cross-validated s_cv.
"""

import warnings

import astropy.units as u
import numpy as np
from astropy.modeling.fitting import TRFLSQFitter
from astropy.table import QTable

from astropolcal.calibration.covariance import prior_noise

__all__ = ["accuracy_table", "cross_validated_residuals", "leave_out_groups"]

# derotator angles that differ by less belong to one group
_SAME_ANGLE = np.deg2rad(0.5)


def accuracy_table(measurement, dataset, residuals, held_out=None):
    r"""
    Return the accuracies of one dataset at each wavelength.

    ``s_res`` is the corrected sample standard deviation of the residuals,
    :math:`\sqrt{\sum r_i^2/(n-k)}`; ``s_mean`` is ``s_res`` over
    :math:`\sqrt{n}`, the paper's s_rel (paper, Sec. 2.3), with k the number of
    free parameters that act at that wavelength; ``s_cv`` is the rms of
    residuals predicted for frames left out in groups.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    dataset : int
        Which of its datasets.
    residuals : `~numpy.ndarray`
        Residuals of all data, shape (n_data,).
    held_out : `~numpy.ndarray`, optional
        Residuals of all data when left out of the fit; NaN where none.

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``wavelength``, ``n``, ``k``, ``s_res``, ``s_mean``, ``s_cv``,
        the last three in percent, NaN where there are too few data.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import accuracy_table
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames)
    >>> measurement = Measurement(charis.chain(), observations)
    >>> accuracy_table(measurement, 0, measurement.residuals()).colnames
    ['wavelength', 'n', 'k', 's_res', 's_mean', 's_cv']
    """
    part = measurement.datasets[dataset]
    residuals = residuals[measurement.segments[dataset]]
    held_out = None if held_out is None else held_out[measurement.segments[dataset]]
    rows = [part.bin_of_datum == b for b in part.bins]
    n = np.array([row.sum() for row in rows])
    k = part.n_parameters_per_wavelength
    squares = np.array([np.sum(residuals[row] ** 2) for row in rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        s_res = np.where(n > k, np.sqrt(squares / np.where(n > k, n - k, 1)), np.nan)
        s_mean = s_res / np.sqrt(n)
    s_cv = [np.nan if held_out is None else _rms(held_out[row]) for row in rows]
    return QTable(
        {
            "wavelength": part.observations.wavelength,
            "n": n,
            "k": np.full(len(n), k),
            "s_res": (s_res * 100) * u.percent,
            "s_mean": (s_mean * 100) * u.percent,
            "s_cv": (np.array(s_cv) * 100) * u.percent,
        }
    )


def _rms(values):
    known = values[np.isfinite(values)]
    return np.sqrt(np.mean(known**2)) if known.size else np.nan


def leave_out_groups(measurement):
    """
    Return the group of each datum for cross-validation: its derotator angle.

    Parameters
    ----------
    measurement : Measurement
        The measurement.

    Returns
    -------
    `~numpy.ndarray`
        Number of the group, shape (n_data,); datasets have their own groups.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import leave_out_groups
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames)
    >>> measurement = Measurement(charis.chain(), observations)
    >>> int(leave_out_groups(measurement).max())
    2
    """
    groups, first = [], 0
    for dataset in measurement.datasets:
        angle = dataset.observations.position("derotator")[dataset.frames[:, 0]]
        order = np.argsort(angle)
        new = np.concatenate([[0], np.cumsum(np.diff(angle[order]) > _SAME_ANGLE)])
        group = np.empty(len(angle), dtype=int)
        group[order] = new
        groups.append(first + group[dataset.group_of_datum])
        first += int(new[-1]) + 1
    return np.concatenate(groups)


def cross_validated_residuals(measurement, vector, weights=None, groups=None):
    """
    Return the residual of every datum predicted by a fit that left its group out.

    Parameters
    ----------
    measurement : Measurement
        The measurement.
    vector : `~numpy.ndarray`
        The fitted values, where each fit starts.
    weights : `~numpy.ndarray`, optional
        Weight of each datum.
    groups : `~numpy.ndarray`, optional
        Group of each datum; by default `leave_out_groups`.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_data,); all NaN where there are fewer than three derotator
        angles, or fewer than two groups of those given.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import cross_validated_residuals
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> measurement = Measurement(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> residuals = cross_validated_residuals(measurement, measurement.vector())
    >>> bool(abs(residuals).max() < 0.01)
    True
    """
    # two derotator angles are too few to predict one from the other; nights need not be
    fewest = 3 if groups is None else 2
    groups = leave_out_groups(measurement) if groups is None else np.asarray(groups)
    held_out = np.full(measurement.n_data, np.nan)
    labels = np.unique(groups)
    if len(labels) < fewest:
        return held_out
    for label in labels:
        out = groups == label
        fitted = _fit_without(measurement, vector, out, weights)
        held_out[out] = measurement.residuals(fitted)[out]
    return held_out


def _fit_without(measurement, vector, out, weights):
    model = measurement.copy()
    model.parameters = vector
    noise = prior_noise(model, weights)
    index, observed, weights = model.fit_arguments(weights, noise, keep=~out)
    with warnings.catch_warnings():
        # a fit that stops early still gives an honest, if poorer, prediction
        warnings.simplefilter("ignore")
        TRFLSQFitter()(model, index, observed, weights=weights, maxiter=50, inplace=True)
    return model.vector()
