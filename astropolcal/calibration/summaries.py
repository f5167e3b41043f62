# Licensed under a 3-clause BSD style license - see LICENSE
"""A calibration in words for the terminal, and in numbers for machines."""

import re
import textwrap

import astropy.units as u
import numpy as np

from astropolcal.calibration._sky_summary import (
    mirror_lines,
    mirrors,
    open_lines,
    open_on_sky,
    star_lines,
)
from astropolcal.calibration._unusable import unusable_words
from astropolcal.calibration.groups import what_is_left_out
from astropolcal.calibration.targets import TARGETS, target_accuracies
from astropolcal.words import counted

__all__ = ["summary", "to_dict"]

_WIDTH = 80
_N_COLUMNS = 5
_ACCURACIES = ("s_res", "s_mean", "s_cv", "s_standard")
# pairs of frames at odds with the fit that a summary names
_MOST_OUTLIERS = 5
# values at a bound that are listed by their wavelength
_MOST_BOUNDS = 6
_ELEMENT = re.compile(r"(\w+\.\w+)\[(\d+)\]")


def summary(calibration, targets=TARGETS):
    """
    Return a calibration as text of at most 80 columns.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    targets : sequence of (dolp, aolp)
        Targets whose accuracy is given, see
        `~astropolcal.calibration.target_accuracies`.

    Returns
    -------
    str
        Accuracy per wavelength with the parameters given per wavelength, the
        global parameters, and what the data do not determine.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import summary
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> print(summary(cal).splitlines()[0])
    Calibration of an instrument from simulated
    """
    known = calibration.parameter_values()
    parts = [
        [*_heading(calibration), *_unusable_lines(calibration, known)],
        _global_lines(known),
        *map(_accuracy_lines, calibration.datasets, _masked(calibration)),
        _accuracy_words(calibration),
        *(_standard_lines(entry) for entry in calibration.fit.get("standards", [])),
        *(
            [*star_lines(entry), *_wrap([f"  {entry['words']}"])]
            for entry in calibration.fit.get("stars", [])
        ),
        _target_lines(calibration, targets),
        _wavelength_lines(calibration, known),
        mirror_lines(calibration),
        _goodness_lines(calibration),
        list(_wrap([_with_wavelengths(str(calibration.identifiability), calibration)])),
        _gauge_lines(calibration),
        _bound_lines(calibration),
        _posterior_lines(calibration),
    ]
    return "\n\n".join("\n".join(part) for part in parts if part)


def _wrap(lines):
    """Break long lines at 80 columns, keeping the indentation of list items."""
    for line in "\n".join(lines).split("\n"):
        indent = " " * (len(line) - len(line.lstrip(" -")))
        yield from textwrap.wrap(line, _WIDTH, subsequent_indent=indent) or [""]


def _with_wavelengths(text, calibration):
    """Name elements of parameters by their wavelength instead of their number."""
    nm = calibration.wavelength.to_value(u.nm)
    return _ELEMENT.sub(
        lambda m: f"{m[1]} ({nm[int(m[2])]:.1f} nm)" if int(m[2]) < nm.size else m[0], text
    )


def _unusable_lines(calibration, known):
    words = unusable_words(calibration, known)
    return list(_wrap(words)) if words else []


def _heading(calibration):
    fit, settings = calibration.fit, calibration.settings
    names = ", ".join(record.name for record in calibration.datasets)
    state = "converged" if calibration.converged else "NOT CONVERGED"
    return [
        f"Calibration of {calibration.instrument or 'an instrument'} from {names}",
        f"{settings['strategy']} fit of {counted(len(calibration.covariance), 'parameter')} to "
        f"{fit['n_data']} {settings['observable'].replace('_', ' ')}s,",
        f"{settings['fitter']}, {fit['seconds']:.2f} s, {state}",
    ]


def _number(entry):
    """Return value, error and unit of a parameter common to all wavelengths."""
    value, std, unit = float(entry["value"]), float(entry["std"]), str(entry["unit"] or "")
    if entry["tied"]:
        note = f"follows {entry['tied']}"
    elif entry["at_bound"]:
        note = "at a bound"
    elif not np.isfinite(std):
        note = "not determined alone, see below"
    else:
        # z: what rounds to zero has no sign
        return f"{value:z12.5f} +- {std:.5f} {unit}"
    return f"{value:z12.5f} {unit} ({note})"


def _global_lines(known):
    shown = {n: e for n, e in known.items() if not e["fixed"] and not e["value"].ndim}
    lines = [f"  {name:<28}{_number(entry)}".rstrip() for name, entry in shown.items()]
    return ["Parameters for all wavelengths", *lines] if lines else []


def _accuracy_lines(record, reasons):
    table = record.accuracy
    masked = f", {counted(record.n_masked, 'cell')} masked" if record.n_masked else ""
    why = "; ".join(f"{reason}: {count}" for reason, count in reasons.items())
    size = f"{counted(record.n_frames, 'frame')} x {counted(len(table), 'wavelength')}"
    counts = f"  ({size}{masked}"
    return [
        f"Accuracy on {record.name}, in percent of polarization",
        *_rows({name: _percent(table, name) for name in _ACCURACIES}),
        *_wrap([f"{counts}; {why})" if why else f"{counts})"]),
    ]


def _masked(calibration):
    """Return why cells of each dataset are masked; a file of before does not say."""
    reasons, count = calibration.fit.get("masked") or [], len(calibration.datasets)
    return reasons if len(reasons) == count else [{}] * count


def _accuracy_words(calibration):
    lines = [
        "  s_res: residuals, corrected for the parameters fitted; s_mean: s_res/sqrt(n), the "
        "paper's s_rel",
        f"  s_cv: rms error on {what_is_left_out(calibration)} left out of the fit",
        "  s_standard: rms error on datasets that the fit never saw"
        + ("" if calibration.fit.get("standards") else " (none given)"),
    ]
    return list(_wrap(lines))


def _percent(table, name):
    # files that were written before a column existed do not have it
    return table[name].value if name in table.colnames else np.full(len(table), np.nan)


def _rows(columns):
    """Return median, best and worst of each column, under their names."""
    head = f"  {'':<10}" + "".join(f"{name:>11}" for name in columns)
    rows = [
        f"  {label:<10}" + "".join(f" {_of(np.abs(v), function)}" for v in columns.values())
        for label, function in (("median", np.median), ("best", np.min), ("worst", np.max))
    ]
    return [head, *rows]


def _of(values, function):
    known = values[np.isfinite(values)]
    return f"{function(known):10.3f}" if known.size else f"{'-':>10}"


def _standard_lines(entry):
    columns = {
        "s_standard": entry["s_standard_percent"],
        "|bias|": entry["bias_percent"],
        "scatter": entry["scatter_percent"],
        "s_cv": entry["s_cv_percent"],
        "/ s_cv": entry["chi"],
    }
    lines = [
        f"Prediction of {entry['name']} (not fitted), in percent",
        *_rows({name: np.array(values, dtype=float) for name, values in columns.items()}),
        f"  {entry['words']} ({counted(entry['n_frames'], 'frame')} x "
        f"{counted(len(entry['n']), 'wavelength')})",
    ]
    return list(_wrap(lines))


def _target_lines(calibration, targets):
    """Return a table with one row a target: median and worst of the wavelengths."""
    tables = target_accuracies(calibration, targets)
    if not tables:
        return []
    heads = ("s_Q", "s_U", "s_p", "(worst)", "s_chi", "(worst)")
    lines = [
        "Accuracy for a target in percent, s_chi in deg, median over the wavelengths",
        f"  {'DoLP':>6}{'AoLP':>10}" + "".join(f"{name:>10}" for name in heads),
        *(_target_row(table) for table in tables),
    ]
    if any(np.isinf(table["s_p"]).any() for table in tables):
        known = target_accuracies(calibration, targets, open_directions="ignore")
        lines += ["  as if what the data leave open were known:", *map(_target_row, known)]
    lines.append(f"  {tables[0].meta['words']}")
    if any(table.meta["aolp"] is None for table in tables):
        lines.append("  AoLP any: at whichever angle the accuracy is worst")
    lines += [_with_wavelengths(line, calibration) for line in open_lines(calibration)]
    return list(_wrap(lines))


def _target_row(table):
    angle = table.meta["aolp"]
    dolp = u.Quantity(table.meta["dolp"]).to_value(u.percent)
    row = f"  {dolp:4.3g} %" + (
        f"{'any':>10}" if angle is None else f"{angle.to_value(u.deg):10.4g}"
    )
    for key in ("s_Q", "s_U", "s_p", "s_chi"):
        # s_Q and s_U only lead to s_p: their worst values would crowd the table
        worst = (np.max,) if key in ("s_p", "s_chi") else ()
        for function in (np.median, *worst):
            row += f"{_short(table[key].value, function):>10}"
    return row


def _short(values, function):
    known = values[~np.isnan(values)]
    return f"{function(known):.2g}" if known.size else "-"


def _wavelength_lines(calibration, known):
    """Return a table with one row a wavelength, as many columns as fit."""
    several = {n: e for n, e in known.items() if e["value"].ndim and not e["fixed"]}
    if not several:
        return []
    # five of 12 characters behind wavelength and accuracy fill the 80 columns
    shown = dict(list(several.items())[:_N_COLUMNS])
    left_out = (
        f"; not shown: {', '.join(list(several)[_N_COLUMNS:])}" if len(several) > len(shown) else ""
    )
    title = f"Parameters for each wavelength (* at a bound; ~ not determined alone{left_out})"
    rows = [*_wrap([title]), *_table_head(shown)]
    s_mean = _by_wavelength(calibration.datasets)
    for i, wavelength in enumerate(calibration.wavelength.to_value(u.nm)):
        mean = s_mean.get(round(wavelength, 2), np.nan)
        row = f"{wavelength:9.1f}" + (f"{mean:9.3f}" if np.isfinite(mean) else f"{'-':>9}")
        for entry in shown.values():
            # degrees to 0.01, shares of one to 0.0001
            digits = 2 if entry["unit"] else 4
            row += f"{entry['value'][i]:z11.{digits}f}" + _mark(entry, i)
        rows.append(row.rstrip())
    return rows


def _mark(entry, i):
    if entry["at_bound"][i]:
        return "*"
    # what follows another parameter has no error of its own
    return " " if np.isfinite(entry["std"][i]) or entry["tied"] else "~"


def _shortened(text):
    """Return a name that leaves a blank between columns of eleven."""
    return text if len(text) < 11 else f"{text[:9]}."


def _table_head(shown):
    optics, keys = zip(*(name.split(".") for name in shown), strict=True)
    units = [str(entry["unit"] or "") for entry in shown.values()]
    return [
        f"{first:>9}{second:>9}" + "".join(f"{_shortened(text):>11} " for text in texts).rstrip()
        for first, second, texts in (("", "", optics), ("", "s_mean", keys), ("nm", "%", units))
    ]


def _by_wavelength(datasets):
    """Return s_mean at each wavelength, of the first dataset that has it."""
    found = {}
    for accuracy in (record.accuracy for record in datasets):
        nm = accuracy["wavelength"].to_value(u.nm)
        for w, s in zip(nm, accuracy["s_mean"].value, strict=True):
            if np.isfinite(s):
                found.setdefault(round(w, 2), s)
    return found


def _goodness_lines(calibration):
    found = calibration.fit.get("lack_of_fit") or []
    lines = [f"  - {test['words']}" for test in found]
    lines += _outlier_lines(calibration.fit.get("outliers") or [])
    return list(_wrap(["Goodness of fit", *lines])) if lines else []


def _outlier_lines(outliers):
    """Name the pairs of frames at odds with the fit, which are not left out."""
    lines = [
        f"  - frames {one['frames']} of {one['dataset']} are at odds with the fit, by "
        f"{one['residual_percent']:+.2g} % ({one['sigma']:.0f} robust sigma, brightness "
        f"{one['brightness']:.2f}); they are not left out"
        for one in outliers[:_MOST_OUTLIERS]
    ]
    more = len(outliers) - _MOST_OUTLIERS
    return lines + ([f"  - and {more} more pairs at odds with the fit"] if more > 0 else [])


def _gauge_lines(calibration):
    gauge = calibration.settings.get("gauge")
    return list(_wrap([_with_wavelengths(f"Gauge: {gauge}", calibration)])) if gauge else []


def _bound_lines(calibration):
    if not calibration.at_bound:
        return []
    elements = {}
    for name in calibration.at_bound:
        stem, _, index = name.rstrip("]").partition("[")
        elements.setdefault(stem, []).extend([int(index)] if index else [])
    nm = calibration.wavelength.to_value(u.nm)
    words = [stem + _at(nm, own) for stem, own in elements.items()]
    return list(_wrap([f"At a bound, so without an error: {', '.join(words)}"]))


def _at(nm, indices):
    if not indices:
        return ""
    if len(indices) > _MOST_BOUNDS:
        return f" ({len(indices)} of {len(nm)} wavelengths)"
    return f" ({', '.join(f'{nm[i]:.1f}' for i in indices)} nm)"


def _posterior_lines(calibration):
    if calibration.posterior is None:
        return []
    return list(
        _wrap(["Posterior", *(f"  {s}" for s in calibration.posterior.words().split("\n"))])
    )


# ---- for machines ------------------------------------------------------------------


def to_dict(calibration, targets=TARGETS):
    """
    Return a calibration as plain numbers, lists and strings, ready for JSON.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    targets : sequence of (dolp, aolp)
        Targets whose accuracy is given, see
        `~astropolcal.calibration.target_accuracies`.

    Returns
    -------
    dict
        Keys ``instrument, observable, fitter, strategy, seconds, n_data,
        n_free, rank, converged, datasets, standards, targets, parameters,
        null_directions`` and others; what is not a number is None.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import to_dict
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> to_dict(cal)["n_free"]
    49
    """
    settings, fit = calibration.settings, calibration.fit
    content = {
        "instrument": calibration.instrument,
        "observable": settings["observable"],
        "fitter": settings["fitter"],
        "strategy": settings["strategy"],
        "weights": settings["weights"],
        "gauge": settings.get("gauge"),
        "seconds": fit["seconds"],
        "converged": calibration.converged,
        "n_data": fit["n_data"],
        "n_free": len(calibration.covariance),
        "rank": calibration.identifiability.rank,
        "lack_of_fit": fit.get("lack_of_fit") or [],
        "outliers": fit.get("outliers") or [],
        "datasets": [
            _dataset(record) | {"masked": reasons}
            for record, reasons in zip(calibration.datasets, _masked(calibration), strict=True)
        ],
        "left_out": what_is_left_out(calibration),
        "stars": fit.get("stars", []),
        "mirrors": mirrors(calibration),
        "standards": [_standard(entry) for entry in fit.get("standards", [])],
        "targets": [_target(table) for table in target_accuracies(calibration, targets)],
        "parameters": {
            name: _parameter(entry) for name, entry in calibration.parameter_values().items()
        },
        "open_on_sky": open_on_sky(calibration),
        "null_directions": calibration.identifiability.directions,
        "near_null_directions": calibration.identifiability.near_null,
        "sampling": list(calibration.identifiability.sampling),
        "mirror_solutions": list(calibration.identifiability.mirrors),
        "mirror_branches": calibration.identifiability.branches,
        "at_bound": list(calibration.at_bound),
        "posterior": calibration.posterior and calibration.posterior.report(),
        "stages": calibration.stages,
        "provenance": dict(calibration.provenance),
    }
    return _plain(content)


def _dataset(record):
    table = record.accuracy
    return {
        "name": record.name,
        "source": record.source,
        "content_hash": record.content_hash,
        "n_frames": record.n_frames,
        "n_masked": record.n_masked,
        "wavelength_nm": _plain(table["wavelength"].to_value(u.nm)),
        "n": _plain(table["n"]),
        "k": _plain(table["k"]),
        **{f"{key}_percent": _plain(_percent(table, key)) for key in _ACCURACIES},
    }


def _standard(entry):
    # nothing is fitted to a standard: with k = 0 its s_res is the error of prediction
    return _plain(entry) | {"s_res_percent": _plain(entry["s_standard_percent"])}


def _target(table):
    angle = table.meta["aolp"]
    shares = [key for key in table.colnames if key not in ("wavelength", "s_chi")]
    return {
        "dolp_percent": float(u.Quantity(table.meta["dolp"]).to_value(u.percent)),
        "aolp_deg": None if angle is None else float(angle.to_value(u.deg)),
        "wavelength_nm": _plain(table["wavelength"].to_value(u.nm)),
        **{f"{key}_percent": _plain(table[key].value) for key in shares},
        "s_chi_deg": _plain(table["s_chi"].value),
        "words": table.meta["words"],
    }


def _parameter(entry):
    return {key: _plain(value) for key, value in entry.items() if key != "unit"} | {
        "unit": str(entry["unit"]) if entry["unit"] is not None else ""
    }


def _plain(value):
    """Turn arrays, quantities and numpy scalars into what JSON knows; NaN into None."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, u.Quantity):
        return {"value": _plain(value.value), "unit": str(value.unit)}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
