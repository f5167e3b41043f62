# Licensed under a 3-clause BSD style license - see LICENSE
"""Numbers of a report: sizes of effects per wavelength, and accuracies of a model."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np

from astropolcal.calibration import accuracy_table, target_accuracies
from astropolcal.gap.shrinkage import _STEPS, frame_groups

ACCURACIES = ("s_res", "s_mean", "s_cv")
# what a singular value must be of the largest to count
_OPEN = 1e-7


# ---- sizes ---------------------------------------------------------------------------------


def sizes(model, name):
    """
    Return the fitted parameters of an added effect, ready for JSON.

    Each is a dictionary of ``value`` and ``std`` (a number, or one a wavelength),
    ``unit`` and ``limit``, the largest size that is physical. The errors are those
    of the noise, or of the scatter of the residuals where it is larger.
    """
    found = {}
    if not model.added.get(name):
        return found
    covariance, is_open = _covariance(model)
    for parameter in model.added[name]:
        slot = model.problem.free.by_name[parameter.name]
        where = model.problem.slices[parameter.name]
        block = parameter.basis if slot.per_wavelength else None
        block = np.eye(where.stop - where.start) if block is None else block
        value = block @ model.fit.coefficients[where] / slot.factor
        std = np.sqrt(np.einsum("ij,jk,ik->i", block, covariance[where, where], block))
        std = np.where(is_open[where].any(), np.nan, std / slot.factor)
        found[parameter.name] = {
            "value": _number(value),
            "std": _number(std),
            "unit": str(slot.unit or ""),
            "limit": float(u.Quantity(parameter.limit).to_value(slot.unit or u.one)),
        }
    return found


def significance(model, name):
    """Return the size of an effect as a whole in units of its error, or None."""
    if not model.added.get(name):
        return None
    covariance, is_open = _covariance(model)
    rows = [np.arange(model.problem.size)[model.problem.slices[p.name]] for p in model.added[name]]
    rows = np.concatenate(rows)
    rows = rows[~is_open[rows]]
    moved = (model.fit.coefficients - model.problem.centre)[rows]
    block = covariance[np.ix_(rows, rows)]
    error = np.sqrt(np.diag(block))
    # of unit diagonal, so that units do not matter
    left, inverse = moved / error, np.linalg.pinv(block / np.outer(error, error), hermitian=True)
    return float(np.sqrt(max(left @ inverse @ left, 0.0)))


def _covariance(model):
    """Return the covariance of the coefficients, and which of them the data leave open."""
    problem = model.problem
    table = np.concatenate([problem.jacobian(model.fit.coefficients), np.diag(problem.tight)])
    scale = np.linalg.norm(table, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    _, singular, right = np.linalg.svd(table / scale, full_matrices=False)
    good = singular > _OPEN * singular[0]
    half = right[good] / singular[good, None] / scale
    scatter = max(1.0, model.fit.chi2 / max(problem.n_data - problem.size, 1))
    return scatter * (half.T @ half), np.sum(right[~good] ** 2, axis=0) > 1e-6


def _number(values):
    """Return one number, or a list of them; None for what is not finite."""
    plain = [float(v) if np.isfinite(v) else None for v in np.atleast_1d(values)]
    return plain[0] if len(plain) == 1 else plain


# ---- accuracies -----------------------------------------------------------------------------


def accuracies(model, cross_validate=True):
    """
    Return the accuracies of normalized single differences, ready for JSON.

    ``rms_percent`` is the root mean square over all data: of left-out frames, or of
    the fit where there is no cross-validation.
    """
    held_out = _held_out(model) if cross_validate else None
    measurement = model.problem.measurement
    residuals = _flat(model, model.fit.coefficients)
    tables = [
        accuracy_table(measurement, i, residuals, held_out)
        for i in range(len(measurement.datasets))
    ]
    judged = residuals if held_out is None else held_out
    return {
        "observable": "normalized_single_difference",
        "rms_percent": 100 * float(np.sqrt(np.nanmean(judged**2))),
        "datasets": [
            {"name": o.name, "source": o.source}
            | {f"{key}_percent": _median(table[key].value) for key in ACCURACIES}
            for o, table in zip(model.observations, tables, strict=True)
        ],
        "wavelength_nm": _number(1e3 * model.problem.wavelength),
        "rms_percent_per_wavelength": _per_wavelength(measurement, judged),
        "targets": _targets(model, tables, "s_mean") + _targets(model, tables, "s_cv"),
    }


def _flat(model, coefficients):
    """Return observed minus predicted differences in the order of the data, (n_data,)."""
    problem = model.problem
    gaps = problem.differences(coefficients)
    parts = zip(gaps, problem.channels, problem.datasets, strict=True)
    return np.concatenate([np.where(c.valid, g[0], np.nan)[d.valid] for g, c, d in parts])


def _held_out(model):
    """Return the differences of every datum predicted by a fit without its group."""
    labels, numbers = frame_groups(model.observations)
    problem, start = model.problem, model.fit.coefficients
    found = np.full(problem.measurement.n_data, np.nan)
    group = np.concatenate(
        [n[d.group_of_datum] for n, d in zip(numbers, problem.datasets, strict=True)]
    )
    for i in range(len(labels)):
        shapes = [c.shape for c in problem.channels]
        kept = [np.broadcast_to(n != i, s) for n, s in zip(numbers, shapes, strict=True)]
        # as far as `held_out` goes, so that both report the same prediction
        fit = problem.fit(start, rows=np.concatenate([k.ravel() for k in kept]), steps=_STEPS)
        found[group == i] = _flat(model, fit.coefficients)[group == i]
    return found


def _median(values):
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _per_wavelength(measurement, residuals):
    """Return the root mean square at each wavelength over all datasets, in percent."""
    bins = np.concatenate([d.bin_of_datum for d in measurement.datasets])
    squares = [residuals[bins == b] ** 2 for b in range(len(measurement.wavelength))]
    return _number([100 * np.sqrt(np.nanmean(s)) if s.size else np.nan for s in squares])


def _targets(model, tables, column):
    """Return s_p and s_chi, median over the wavelengths, at the worst angle."""
    records = [
        SimpleNamespace(source=o.source, accuracy=table)
        for o, table in zip(model.observations, tables, strict=True)
    ]
    like = SimpleNamespace(
        wavelength=model.problem.wavelength * u.um, datasets=records, chains=model.chains
    )
    return [
        {
            "dolp_percent": float(u.Quantity(t.meta["dolp"]).to_value(u.percent)),
            "column": column,
            "s_p_percent": _median(t["s_p"].value),
            "s_chi_deg": _median(t["s_chi"].value),
            "missing": t.meta["missing"],
        }
        for t in target_accuracies(like, column=column)
    ]
