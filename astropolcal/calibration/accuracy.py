# Licensed under a 3-clause BSD style license - see LICENSE
"""
Accuracy of a calibration per wavelength: s_res, s_mean, s_cv and s_standard.

The first two look back at the data of the fit. The others are errors of
predictions: of settings that were left out of the fit, and of a dataset that the
fit never saw (a standard).
"""

import warnings

import astropy.units as u
import numpy as np
from astropy.modeling.fitting import TRFLSQFitter
from astropy.table import QTable

from astropolcal.calibration._whitened import Whitened
from astropolcal.calibration.covariance import prior_noise
from astropolcal.calibration.groups import leave_out_groups
from astropolcal.calibration.identifiability import null_space, physical_scale
from astropolcal.exceptions import FitError

__all__ = ["accuracy_table", "cross_validated_residuals", "leave_out_groups"]

# a datum that moves by less than this share of the largest slope does not move
_STILL = 1e-6
# what is named of a direction, as a share of its length
_WORTH_A_WORD = 0.1
_MOST_NAMES = 4
# of more groups than this none moves the parameters far
_MANY = 16
# a leverage this near to one is that of data which alone determine something
_ALONE = 1e-7


def accuracy_table(measurement, dataset, residuals, held_out=None):
    r"""
    Return the accuracies of one dataset at each wavelength.

    ``s_res`` is the corrected sample standard deviation of the residuals,
    :math:`\sqrt{\sum r_i^2/(n-k)}`; ``s_mean`` is ``s_res`` over
    :math:`\sqrt{n}`, the paper's s_rel (paper, Sec. 2.3), with k the number of
    free parameters that act at that wavelength; ``s_cv`` is the rms of
    residuals predicted for frames left out in groups; ``s_standard``, which
    `add_standard` fills, that of datasets that the fit never saw.

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
        ``s_standard``, the last four in percent, NaN where there are too few
        data or none.

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
    ['wavelength', 'n', 'k', 's_res', 's_mean', 's_cv', 's_standard']
    """
    part = measurement.datasets[dataset]
    residuals = residuals[measurement.segments[dataset]]
    held_out = None if held_out is None else held_out[measurement.segments[dataset]]
    rows = [part.bin_of_datum == b for b in part.bins]
    n = np.array([row.sum() for row in rows])
    k = part.n_parameters_per_wavelength
    squares = np.array([np.sum(residuals[row] ** 2) for row in rows])
    with np.errstate(divide="ignore", invalid="ignore"):
        # n - k as for independent data: every parameter that acts here takes one degree of freedom,
        # also one common to all wavelengths, as in the paper
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
            "s_standard": np.full(len(n), np.nan) * u.percent,
        }
    )


def _rms(values):
    known = values[np.isfinite(values)]
    return np.sqrt(np.mean(known**2)) if known.size else np.nan


def cross_validated_residuals(measurement, vector, weights=None, groups=None):
    """
    Return the residual of every datum predicted by a fit that left its group out.

    Up to 16 groups each have a fit; of more, which weigh little, the fits are
    linear steps from that of all data.

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
        Shape (n_data,). NaN where the other groups do not determine the
        prediction, and everywhere if there are fewer than three derotator angles
        or, of groups that are given, fewer than two.

    Raises
    ------
    FitError
        If given groups are not one a datum, have a single member, or cannot be
        predicted from the others.

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
    labels = leave_out_groups(measurement) if groups is None else _checked(measurement, groups)
    held_out = np.full(measurement.n_data, np.nan)
    found = np.unique(labels)
    if len(found) < fewest:
        return held_out
    jacobian = measurement.jacobian(vector)
    if len(found) > _MANY:
        return _held_out_linearly(measurement, vector, jacobian, weights, labels, groups)
    for label in found:
        out = labels == label
        moved, blind = _undetermined(measurement, vector, jacobian, out, weights)
        if groups is not None and blind.any():
            raise FitError(_not_predicted(measurement, label, out, moved))
        fitted = _fit_without(measurement, vector, out, weights)
        # along what the others leave open the fit still stands where all data have put it
        held_out[out] = np.where(blind, np.nan, measurement.residuals(fitted)[out])
    return held_out


def _held_out_linearly(measurement, vector, jacobian, weights, labels, groups):
    """
    Return what a fit without each of many groups predicts, by one step of linear algebra.

    The residuals of a group g become (1 - H_g)^-1 r_g, with H_g its part of the hat matrix: exact
    for a linear model, and a small group moves no parameter far.
    """
    weight = np.ones(measurement.n_data) if weights is None else np.asarray(weights, dtype=float)
    free = measurement.free
    priors = free.prior_jacobian(vector) * prior_noise(measurement, weights)
    problem = Whitened(jacobian * weight, physical_scale(free), priors, free.at_bounds(vector))
    root = problem.rows[:, problem.live] @ problem.errors.half.T
    residuals = measurement.residuals(vector) * weight
    order = np.argsort(labels, kind="stable")
    ends = np.flatnonzero(labels[order][1:] != labels[order][:-1]) + 1
    held_out = np.empty(measurement.n_data)
    for rows in np.split(order, ends):
        # (1 - H_g)^-1 r_g without inverting a matrix of the size of the group: H_g = R R^T, and its
        # eigenvalues are those of R^T R, (rank, rank)
        own = root[rows]
        values, axes = np.linalg.eigh(own.T @ own)
        seen = own @ axes
        # along these the others determine nothing
        alone = values > 1 - _ALONE
        blind = (np.abs(seen[:, alone]) > _STILL).any(axis=1)
        if groups is not None and blind.any():
            out = labels == labels[rows[0]]
            moved, _ = _undetermined(measurement, vector, jacobian, out, weights)
            raise FitError(_not_predicted(measurement, labels[rows[0]], out, moved))
        gain = np.where(alone, 0.0, 1 / np.where(alone, 1.0, 1 - values))
        # (1 - R R^T)^-1 = 1 + R (1 - R^T R)^-1 R^T
        change = seen @ (gain * (seen.T @ residuals[rows]))
        held_out[rows] = np.where(blind, np.nan, (residuals[rows] + change) / weight[rows])
    return held_out


def _checked(measurement, groups):
    groups = np.asarray(groups)
    if groups.shape != (measurement.n_data,):
        raise FitError(
            f"groups of shape {groups.shape}; allowed is ({measurement.n_data},), one a datum"
        )
    labels, counts = np.unique(groups, return_counts=True)
    if (counts < 2).any():
        raise FitError(
            f"cross-validation: group {labels[counts < 2][0]} has a single member; "
            "at least 2 data are needed"
        )
    return groups


def _undetermined(measurement, vector, jacobian, out, weights):
    """
    Return the moves that only the data left out can see, and which of these see them.

    The moves are canonical, shape (n_moves, n_free).
    """
    scale = physical_scale(measurement.free)
    kept = jacobian[:, ~out] * (1.0 if weights is None else weights[~out])
    kept = np.concatenate([kept, measurement.free.prior_jacobian(vector)], axis=1)
    null = null_space(measurement.free, kept) * scale
    # which combinations of what the others leave open do the data left out see, and how strongly
    left, seen, right = np.linalg.svd(null @ jacobian[:, out], full_matrices=False)
    limit = _STILL * np.abs(jacobian * scale[:, None]).max(initial=0.0)
    moves = seen > limit
    change = seen[moves, None] * right[moves]
    return left.T[moves] @ null, (np.abs(change) > limit).any(axis=0)


def _not_predicted(measurement, label, out, moved):
    share = np.abs(moved / physical_scale(measurement.free)).max(axis=0)
    slots = [s for s in measurement.free.slots if share[s.slice].max() > _WORTH_A_WORD]
    return (
        f"cross-validation: without group {label} ({out.sum()} data) the others do not determine "
        f"{_listed([slot.name for slot in slots])}; group by something else"
    )


def _listed(names):
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


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
