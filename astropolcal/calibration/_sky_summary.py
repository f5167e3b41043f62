# Licensed under a 3-clause BSD style license - see LICENSE
"""What a summary says of mirrors, and of stars that no fit saw."""

import astropy.units as u
import numpy as np

from astropolcal.calibration.reflections import METALS, mirror_names, mirror_values

_N_MIRROR_ROWS = 5
_STAR_HEAD = ("DoLP (%)", "catalogue", "AoLP (deg)", "catalogue")


def mirror_lines(calibration):
    """Return diattenuations of mirrors beside those of bare metals, at a few wavelengths."""
    tables = [mirror_values(calibration, name) for name in mirror_names(calibration)]
    if not tables:
        return []
    shown = {table.meta["name"]: table for table in tables}
    # a grid of several tables need not ascend
    order = np.argsort(calibration.wavelength)
    rows = order[np.unique(np.linspace(0, order.size - 1, _N_MIRROR_ROWS).round().astype(int))]
    head = "       nm" + "".join(f"{name:>17}" for name in shown)
    lines = ["Diattenuation in percent; the metals bare, at 45 deg"]
    lines.append(head + "".join(f"{metal:>10}" for metal in METALS))
    for i in rows:
        line = f"{calibration.wavelength[i].to_value(u.nm):9.1f}"
        line += "".join(f"{_with_error(table, 'diattenuation', i):>17}" for table in tables)
        metals = (tables[0][f"diattenuation_{metal}"][i] for metal in METALS)
        lines.append(line + "".join(f"{value.to_value(u.percent):10.2f}" for value in metals))
    return lines


def _with_error(table, key, i):
    value, std = (table[name][i].value for name in (key, f"{key}_err"))
    return f"{value:.3f} +- {std:.3f}" if np.isfinite(std) else f"{value:.3f}"


def star_lines(entry):
    """Return what a star of known polarization says of the calibration."""
    lines = [
        f"{entry['star']} against the catalogue; no fit saw {entry['name']}",
        "       nm" + "".join(f"{t:>17}" for t in _STAR_HEAD),
    ]
    for i, lam in enumerate(entry["wavelength_nm"]):
        line = f"{lam:9.1f}"
        for key, unit, digits in (("dolp", "percent", 3), ("aolp", "deg", 1)):
            for name in (key, f"{key}_known"):
                value, std = entry[f"{name}_{unit}"][i], entry[f"{name}_err_{unit}"][i]
                text = "-" if not np.isfinite(value) else f"{value:.{digits}f}"
                text += f" +- {std:.{digits}f}" if np.isfinite(std) and text != "-" else ""
                line += f"{text:>17}"
        lines.append(line)
    return lines


def mirrors(calibration):
    """Return the values of all mirrors for machines."""
    tables = [mirror_values(calibration, name) for name in mirror_names(calibration)]
    return [_entry(table) for table in tables]


def _entry(table):
    columns = {"wavelength_nm": table["wavelength"].to_value(u.nm)}
    for key in table.colnames[1:]:
        unit = "percent" if key.startswith("diattenuation") else "deg"
        columns[f"{key}_{unit}"] = table[key].value
    return {"name": table.meta["name"], "retardance_held": table.meta["held"]} | columns
