# Licensed under a 3-clause BSD style license - see LICENSE
"""A calibration in words for the terminal, and in numbers for machines."""

import textwrap

import astropy.units as u
import numpy as np

__all__ = ["summary", "to_dict"]

_WIDTH = 80
_N_COLUMNS = 5


def summary(calibration):
    """
    Return a calibration as text of at most 80 columns.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

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
        _heading(calibration),
        _global_lines(known),
        *(_accuracy_lines(record) for record in calibration.datasets),
        _wavelength_lines(calibration, known),
        _goodness_lines(calibration),
        list(_wrap([str(calibration.identifiability)])),
        _gauge_lines(calibration),
        _bound_lines(calibration),
    ]
    return "\n\n".join("\n".join(part) for part in parts if part)


def _wrap(lines):
    """Break long lines at 80 columns, keeping the indentation of list items."""
    for line in "\n".join(lines).split("\n"):
        indent = " " * (len(line) - len(line.lstrip(" -")))
        yield from textwrap.wrap(line, _WIDTH, subsequent_indent=indent) or [""]


def _heading(calibration):
    fit, settings = calibration.fit, calibration.settings
    names = ", ".join(record.name for record in calibration.datasets)
    state = "converged" if calibration.converged else "NOT CONVERGED"
    return [
        f"Calibration of {calibration.instrument or 'an instrument'} from {names}",
        f"{settings['strategy']} fit of {len(calibration.covariance)} parameters to "
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
        return f"{value:12.5f} +- {std:.5f} {unit}"
    return f"{value:12.5f} {unit} ({note})"


def _global_lines(known):
    shown = {n: e for n, e in known.items() if not e["fixed"] and not e["value"].ndim}
    lines = [f"  {name:<28}{_number(entry)}".rstrip() for name, entry in shown.items()]
    return ["Parameters for all wavelengths", *lines] if lines else []


def _accuracy_lines(record):
    table = record.accuracy
    lines = [
        f"Accuracy on {record.name}, in percent of polarization",
        f"  {'':<10}{'s_res':>10}{'s_mean':>10}{'s_cv':>10}",
    ]
    for label, function in (("median", np.median), ("best", np.min), ("worst", np.max)):
        values = [_of(table[column].value, function) for column in ("s_res", "s_mean", "s_cv")]
        lines.append(f"  {label:<10}" + "".join(values))
    lines += [
        "  s_res: residuals, corrected for the parameters fitted; s_mean: s_res/sqrt(n),",
        "  the paper's s_rel; s_cv: rms error on derotator angles left out of the fit",
    ]
    masked = f", {record.n_masked} cells masked" if record.n_masked else ""
    lines.append(f"  ({record.n_frames} frames x {len(table)} wavelengths{masked})")
    return lines


def _of(values, function):
    known = values[np.isfinite(values)]
    return f"{function(known):10.3f}" if known.size else f"{'-':>10}"


def _wavelength_lines(calibration, known):
    """Return a table with one row a wavelength, as many columns as fit."""
    several = {n: e for n, e in known.items() if e["value"].ndim and not e["fixed"]}
    if not several:
        return []
    shown = dict(list(several.items())[:_N_COLUMNS])
    left_out = (
        f"; not shown: {', '.join(list(several)[_N_COLUMNS:])}" if len(several) > len(shown) else ""
    )
    rows = [f"Parameters for each wavelength (* at a bound{left_out})", *_table_head(shown)]
    s_mean = _by_wavelength(calibration.datasets[0].accuracy)
    for i, wavelength in enumerate(calibration.wavelength.to_value(u.nm)):
        mean = s_mean.get(round(wavelength, 2), np.nan)
        row = f"{wavelength:9.1f}" + (f"{mean:9.3f}" if np.isfinite(mean) else f"{'-':>9}")
        for entry in shown.values():
            digits = 2 if entry["unit"] else 4
            row += f"{entry['value'][i]:11.{digits}f}" + ("*" if entry["at_bound"][i] else " ")
        rows.append(row.rstrip())
    return rows


def _table_head(shown):
    optics, keys = zip(*(name.split(".") for name in shown), strict=True)
    units = [str(entry["unit"] or "") for entry in shown.values()]
    return [
        f"{first:>9}{second:>9}" + "".join(f"{text[:11]:>11} " for text in texts).rstrip()
        for first, second, texts in (("", "", optics), ("", "s_mean", keys), ("nm", "%", units))
    ]


def _by_wavelength(accuracy):
    nm = accuracy["wavelength"].to_value(u.nm)
    return {round(w, 2): s for w, s in zip(nm, accuracy["s_mean"].value, strict=True)}


def _goodness_lines(calibration):
    found = calibration.fit.get("lack_of_fit") or []
    lines = [f"  - {test['words']}" for test in found]
    return list(_wrap(["Goodness of fit", *lines])) if lines else []


def _gauge_lines(calibration):
    gauge = calibration.settings.get("gauge")
    return list(_wrap([f"Gauge: {gauge}"])) if gauge else []


def _bound_lines(calibration):
    if not calibration.at_bound:
        return []
    return list(_wrap([f"At a bound, so without an error: {', '.join(calibration.at_bound)}"]))


# ---- for machines ------------------------------------------------------------------


def to_dict(calibration):
    """
    Return a calibration as plain numbers, lists and strings, ready for JSON.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Returns
    -------
    dict
        Keys ``instrument, observable, fitter, strategy, seconds, n_data,
        n_free, rank, converged, datasets, parameters, null_directions``;
        what is not a number is None.

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
    return {
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
        "lack_of_fit": _plain(fit.get("lack_of_fit") or []),
        "datasets": [_dataset(record) for record in calibration.datasets],
        "parameters": {
            name: _parameter(entry) for name, entry in calibration.parameter_values().items()
        },
        "null_directions": calibration.identifiability.directions,
        "sampling": list(calibration.identifiability.sampling),
        "mirror_solutions": list(calibration.identifiability.mirrors),
        "at_bound": list(calibration.at_bound),
        "stages": [_plain(stage) for stage in calibration.stages],
        "provenance": dict(calibration.provenance),
    }


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
        **{f"{key}_percent": _plain(table[key].value) for key in ("s_res", "s_mean", "s_cv")},
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
