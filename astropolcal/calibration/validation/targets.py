# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an accuracy means for a target: errors of q, u, degree and angle of polarization.

``target_accuracies`` is what a calibration claims, from its covariance. The equations of McIntosh
et al. (2026, Sec. 2.3), after van Holstein et al. 2020, A&A 633, A64
(doi:10.1051/0004-6361/201834996), stand beside it as `paper_accuracies`.
"""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability.linearized import STILL
from astropolcal.calibration.identifiability.sky import settings_of, view_of_calibration, weights_of
from astropolcal.calibration.noise.estimates import mean_of_known
from astropolcal.calibration.noise.scatter import kind_of_source
from astropolcal.calibration.system import model_error
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.exceptions import ParameterError
from astropolcal.files import columns
from astropolcal.stokes import angle_error
from astropolcal.units import angle_to_rad
from astropolcal.words import check_choice

__all__ = ["paper_accuracies", "target_accuracies"]

KEYS = ("s_Q", "s_U", "s_p", "s_chi")
# of a sum of products, relative to its terms
_ROUNDING = 1e-14


def _errors_on_sky(calibration, view, targets, ignore):
    """Yield the rms over the settings of the errors of q, u, degree and angle, as fractions.

    Shape (4, n_wavelengths, n_angles) for each of ``targets``, degrees with double angles in
    radian; infinite where an open direction acts.
    """
    axes = full_covariance(calibration)._axes()
    # the nine changes of I, Q and U in one axis
    along = axes.along(view.changes.reshape(*view.good.shape, 9, -1))
    extra = model_error(calibration.fit, view.lam)
    extra = np.moveaxis(extra.reshape(len(extra), len(view.lam), 9), 0, -1)
    covariance = _products(along[0] * axes.sigmas) + _products(extra)[:, None]
    matrices, count = (covariance, *map(_products, along)), view.good.sum(axis=1)[:, None]
    for dolp, double in targets:
        weights = weights_of(dolp, double).reshape(-1, 9)
        # sums of squares: what cancels leaves the rounding of its terms, of either sign
        variance, known, is_open, blind = (
            np.sum((matrix @ weights.T) * weights.T, axis=-2).clip(0) for matrix in matrices
        )
        # as for any quantity derived from the parameters, see `Covariance.propagate`
        terms = np.trace(sum(matrices[1:]), axis1=-2, axis2=-1)[..., None]
        limit = STILL**2 * (known + is_open + blind)
        limit += _ROUNDING * terms * np.sum(weights**2, axis=-1)
        lost = blind > limit
        if not axes.partial:
            lost &= known <= limit
        if not ignore:
            variance[lost | (is_open > limit)] = np.inf
        # of the angle what is true of a faint target, too; what is open stays so
        turn = np.split(variance, len(KEYS), axis=-1)[-1]
        known = np.isfinite(turn) & (dolp > 0)
        turn[known] = np.deg2rad(angle_error(dolp, 2 * dolp * np.sqrt(turn[known]))) ** 2
        variance[~view.good] = np.nan
        with np.errstate(invalid="ignore", divide="ignore"):
            rms = np.sqrt(np.nansum(variance, axis=1) / np.where(count, count, np.nan))
        yield np.moveaxis(rms.reshape(len(rms), len(KEYS), -1), 0, 1)


def _products(rows):
    return rows @ np.swapaxes(rows, -1, -2)


# ---- what an accuracy means for a target ----


#: Degrees and angles of polarization that are reported; an angle of None is any.
TARGETS = ((30 * u.percent, None), (1 * u.percent, None), (0.1 * u.percent, None))
#: Those of the paper.
PAPER_TARGETS = ((1 * u.percent, None), (30 * u.percent, None))

_CALIBRATIONS = {"polarized": "s_rel", "unpolarized": "s_unpol", "on_sky": "s_sky"}
# where s_Q, s_U, s_p and s_chi are largest: between these angles each rises or falls steadily
_EXTREMES = (0.0, 22.5, 45.0) * u.deg
_OPEN = ("infinite", "ignore")
# which sources tell which error of the model
_OF_SOURCES = {"relative": "polarized", "absolute": "unpolarized"}
# angles among which those of a calibration are sought
_ANY = np.arange(0.0, 180.0, 7.5) * u.deg


# ---- what a calibration claims --------------------------------------------------------------


def target_accuracies(calibration, targets=TARGETS, *, open_directions="infinite"):
    """
    Return the accuracy of a calibration for several targets, per wavelength.

    What the errors of all calibrated parameters, with their correlations, and the error of the
    model do to the polarization of a target on sky: the systematic error that
    `~astropolcal.correction.correct` states, for one cycle of the half-wave plate, rms over a few
    settings of telescope and derotator.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    targets : sequence of (dolp, aolp)
        Degree and angle of linear polarization of each. An angle of None stands for any: each
        error is then that at its worst angle.
    open_directions : {"infinite", "ignore"}
        As for `~astropolcal.correction.correct`: errors along directions that the data do not
        determine are infinite, or zero as if the choice that the calibration made were true.

    Returns
    -------
    list of `~astropy.table.QTable`
        One per target, with columns ``wavelength``, ``s_Q``, ``s_U``, ``s_p`` (percent) and
        ``s_chi`` (degree), infinite where it depends on a direction that the data do not determine;
        in the meta ``dolp``, ``aolp`` and, in ``words``, what the numbers are made of. None where
        the chain has no half-wave plate.

    Raises
    ------
    ParameterError
        If a target is impossible, or the choice is unknown.

    Notes
    -----
    The errors of *q*, *u* and the degree are to first order. That of the angle is the rms of the
    angles that errors of *q* and *u* make of the target if they are equal and independent: without
    polarization, where any angle is as likely, it would be 52 deg.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration import target_accuracies
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> (table,) = target_accuracies(cal, [(30 * u.percent, 50 * u.deg)])
    >>> bool((table["s_chi"] < 0.1 * u.deg).all())
    True
    """
    check_choice("open_directions", open_directions, _OPEN, ParameterError)
    view, ignore = view_of_calibration(calibration), open_directions == "ignore"
    return _accuracies(calibration, targets, view, ignore)


def _accuracies(calibration, targets, view, ignore=False):
    wanted = [_target(*target) for target in targets]
    if view is None:
        return []
    tables, count, known = [], view.good.shape[1], calibration.fit.get("model_error")
    # which errors of the model there are; what no dataset tells counts as zero
    missing = known.get("missing", []) if known else _OF_SOURCES
    none = [source for key, source in _OF_SOURCES.items() if key in missing]
    words = "and an error of the model" + "".join(f", but none from {one} sources" for one in none)
    words = "without an error of the model" if len(none) == len(_OF_SOURCES) else words
    words += ", and those of what was held" if "held_absolute_percent" in (known or {}) else ""
    # where the data leave two signs of a retardance open
    signs = np.count_nonzero((known or {}).get("sign_relative_percent", ()))
    words += f", with signs that nothing tells at {signs} wavelengths" if signs else ""
    words = (
        f"from the covariance of the fit {words}; {view.telescope}; "
        + ("one cycle of the half-wave plate" if view.has_plate else "one sequence of frames")
        + (f", rms over {count} settings" if count > 1 else "")
    )
    words += "; as if the undetermined parameters were known" if ignore else ""
    errors = _errors_on_sky(calibration, view, wanted, ignore)
    for (dolp, aolp), (p, _), error in zip(targets, wanted, errors, strict=True):
        found = np.max(error, axis=-1)
        if p == 0:
            # no angle at all
            found[-1] = np.inf
        table = QTable({"wavelength": calibration.wavelength})
        for key, values in zip(KEYS, found, strict=True):
            table[key] = np.rad2deg(values) * u.deg if key == "s_chi" else 100 * values * u.percent
        table.meta |= {"dolp": dolp, "aolp": aolp, "words": words}
        tables.append(table)
    return tables


def _target(dolp, aolp):
    """Return a degree of polarization as a fraction, and the double angles, radian."""
    if np.ndim(dolp) or np.ndim(aolp):
        raise ParameterError(f"target {dolp}, {aolp}: one degree and one angle are needed")
    double = 2 * np.atleast_1d(angle_to_rad(_ANY if aolp is None else aolp, "aolp"))
    return float(_fraction("dolp", dolp, 1.0)), double


def keep_sky_accuracy(calibration, view=None):
    """Keep what a calibration claims of the usual targets in its ``fit``, and so in its file."""
    if calibration.measurement is not None:
        calibration.fit["sky_settings"] = settings_of(calibration.measurement)
    view = view_of_calibration(calibration) if view is None else view
    tables = _accuracies(calibration, TARGETS, view)
    calibration.fit["sky_accuracy"] = [
        {key.lower(): value for key, value in target_entry(table).items()} for table in tables
    ]
    return calibration


def target_entry(table):
    """Return the accuracies for a target as plain numbers and lists."""
    aolp = table.meta["aolp"]
    return {
        "dolp_percent": float(u.Quantity(table.meta["dolp"]).to_value(u.percent)),
        "aolp_deg": None if aolp is None else float(aolp.to_value(u.deg)),
        "words": table.meta["words"],
    } | columns(table)


# ---- the equations of the paper ------------------------------------------------------------


def propagate_accuracy(dolp, aolp, s_rel, s_abs):
    """Return ``s_Q``, ``s_U``, ``s_p`` and ``s_chi`` of a target (paper, Sec. 2.3).

    s_Q = s_abs + s_rel |q|, s_U likewise; s_p^2 = (q^2 s_Q^2 + u^2 s_U^2) / (q^2 + u^2); s_chi =
    sqrt(q^2 s_U^2 + u^2 s_Q^2) / (2 (q^2 + u^2)), infinite for an unpolarized target.
    """
    p = _fraction("dolp", dolp, 1.0)
    rel, absolute = (_fraction(n, v) for n, v in (("s_rel", s_rel), ("s_abs", s_abs)))
    chi = 2 * angle_to_rad(aolp, "aolp")
    # q and u over p stay defined for an unpolarized target
    along, across = np.abs(np.cos(chi)), np.abs(np.sin(chi))
    s_q, s_u = absolute + rel * p * along, absolute + rel * p * across
    s_p = np.hypot(along * s_q, across * s_u)
    with np.errstate(divide="ignore", invalid="ignore"):
        s_chi = np.where(p > 0, np.hypot(along * s_u, across * s_q) / (2 * p), np.inf)
    percent = {"s_Q": s_q, "s_U": s_u, "s_p": s_p}
    result = {key: 100 * value * u.percent for key, value in percent.items()}
    return result | {"s_chi": np.rad2deg(s_chi) * u.deg}


def _fraction(name, value, limit=np.inf):
    number = np.asarray(u.Quantity(value).to_value(u.one), dtype=float)
    # an accuracy may be unknown, a target may not
    unknown = np.isnan(number).any() and np.isfinite(limit)
    if unknown or np.any(number < 0) or np.any(number > limit) or np.any(np.isinf(number)):
        allowed = "0 to 1 (0 to 100 %)" if np.isfinite(limit) else "numbers from 0"
        raise ParameterError(f"{name} = {value}; allowed are {allowed}")
    return number


def paper_accuracies(calibration, targets=PAPER_TARGETS):
    """
    Return the paper's accuracy of a calibration for several targets, per wavelength.

    It follows from residuals alone, and knows neither telescope nor correlations: what a
    calibration claims is ``target_accuracies``. Which datasets give s_rel, s_unpol and s_sky
    follows from their sources: s_sky is that of unpolarized standard stars. They are the ``s_mean``
    of these datasets; several of one kind count by the rms of theirs. Where no dataset of a kind
    was fitted, a standard of that kind counts that was predicted, see
    `~astropolcal.calibration.add_standard`.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    targets : sequence of (dolp, aolp)
        Degree and angle of linear polarization of each. An angle of None stands for any: the
        accuracies are then the largest over all angles.

    Returns
    -------
    list of `~astropy.table.QTable`
        One per target, with columns ``wavelength``, ``s_rel``, ``s_unpol``, ``s_sky``, ``s_abs``,
        ``s_Q``, ``s_U``, ``s_p`` (percent) and ``s_chi`` (degree), by the equations of the paper
        (Sec. 2.3), and meta ``dolp``, ``aolp``, ``missing`` and ``words``: a kind that is missing
        counts as zero, and its column is NaN. None if no dataset is of a known kind.

    Raises
    ------
    ParameterError
        If a target is impossible.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration.validation import paper_accuracies
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> (table,) = paper_accuracies(cal, [(30 * u.percent, 50 * u.deg)])
    >>> table.meta["missing"]
    ['unpolarized', 'on_sky']
    """
    found, parts = [], _parts_of_kinds(calibration)
    missing = [name for name in _CALIBRATIONS if name not in parts]
    zero = np.zeros(calibration.wavelength.size) * u.percent
    s_rel, s_unpol, s_sky = (parts.get(name, zero) for name in _CALIBRATIONS)
    # the error that scales with the intensity
    s_abs = np.hypot(s_unpol, s_sky)
    table = QTable({"wavelength": calibration.wavelength})
    for name, key in _CALIBRATIONS.items():
        table[key] = parts.get(name, zero * np.nan)
    table["s_abs"] = zero * np.nan if {"unpolarized", "on_sky"} <= {*missing} else s_abs
    words = "all three calibrations count"
    if missing:
        lacking = ", ".join(f"{name} ({_CALIBRATIONS[name]})" for name in missing)
        words = f"without the calibration {lacking}: the accuracies are lower limits"
    for dolp, aolp in targets:
        angles = _EXTREMES if aolp is None else [aolp]
        each = [propagate_accuracy(dolp, angle, s_rel, s_abs) for angle in angles]
        own = table.copy()
        for key in KEYS:
            own[key] = np.max([one[key].value for one in each], axis=0) * each[0][key].unit
        own.meta |= {"dolp": dolp, "aolp": aolp, "missing": missing, "words": words}
        found.append(own)
    return found if parts else []


def _kind(source, chain=None):
    """Return which of the three calibrations a dataset belongs to, or None."""
    kind = kind_of_source(source, chain)
    if kind != "star":
        return kind
    # a polarized star does not tell s_sky, as its own polarization is fitted or from a catalogue
    return "on_sky" if "unpolarized" in source.lower() else None


def _parts_of_kinds(calibration):
    """Return the accuracy of each kind of dataset at the calibration's wavelengths.

    Of a kind that was not fitted it is that of the standards that were predicted.
    """
    grid, fitted, predicted = calibration.wavelength, {}, {}
    for record, chain in zip(calibration.datasets, calibration.chains, strict=True):
        kind = _kind(record.source, chain)
        rows = fitted.setdefault(kind, [])
        if kind is not None and record.accuracy is not None:
            square = record.accuracy["s_mean"].to_value(u.percent) ** 2
            rows.append((record.accuracy["wavelength"], square))
    # a diagnosis asks with what has no fit
    for entry in getattr(calibration, "fit", {}).get("standards", []):
        own, n = np.array(entry["wavelength_nm"]) * u.nm, np.array(entry["n"], dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            # nothing was fitted: its rms over sqrt(n) is what s_mean is for a fit
            square = np.array(entry["s_standard_percent"], dtype=float) ** 2 / n
        predicted.setdefault(_kind(entry["source"]), []).append((own, square))
    parts = {}
    for kind, several in (predicted | fitted).items():
        # a dataset may cover a part of the grid; the rest stays unknown
        rows = np.full((len(several), grid.size), np.nan)
        for row, (own, square) in zip(rows, several, strict=True):
            row[np.abs(own[:, None] - grid).argmin(axis=1)] = square
        if kind is not None and several:
            parts[kind] = np.sqrt(mean_of_known(rows.T)) * u.percent
    return parts
