# Licensed under a 3-clause BSD style license - see LICENSE
"""What a summary says of mirrors, of stars that no fit saw, and of what is left open on sky."""

import textwrap

import astropy.units as u
import numpy as np

from astropolcal.calibration.reflections import METALS, mirror_names, mirror_values
from astropolcal.calibration.sky import shows_on_sky, sky_words

_WIDTH = 80
_N_MIRROR_ROWS = 5
# a diattenuation of so many times that of any metal is pointed at
_ABOVE = 3
# so many wavelengths are all shown
_ALL_ROWS = 12
# so many open directions are named under the accuracies for a target, and as many bad ones
_N_OPEN = 3
_STAR_HEAD = ("DoLP (%)", "catalogue", "AoLP (deg)", "catalogue")


def mirror_lines(calibration):
    """Return diattenuations of mirrors beside those of bare metals, at a few wavelengths."""
    tables = [mirror_values(calibration, name) for name in mirror_names(calibration)]
    if not tables:
        return []
    shown = {table.meta["name"]: table for table in tables}
    # a grid of several tables need not ascend
    order = np.argsort(calibration.wavelength)
    step = 1 if order.size <= _ALL_ROWS else -(-order.size // _N_MIRROR_ROWS)
    shortened = f"; one in {step} of {order.size} wavelengths" if step > 1 else ""
    head = "       nm" + "".join(f"{name:>17}" for name in shown)
    lines = [f"Diattenuation in percent; the metals bare, at 45 deg{shortened}"]
    lines.append(head + "".join(f"{metal:>10}" for metal in METALS))
    for i in order[::step]:
        line = f"{calibration.wavelength[i].to_value(u.nm):9.1f}"
        line += "".join(f"{_with_error(table, 'diattenuation', i):>17}" for table in tables)
        metals = (tables[0][f"diattenuation_{metal}"][i] for metal in METALS)
        lines.append(line + "".join(f"{value.to_value(u.percent):10.2f}" for value in metals))
    # the table may be wider, a sentence need not
    return lines + [s for t in tables for s in textwrap.wrap(_above_metals(t), _WIDTH)]


def _above_metals(table):
    """Say where a mirror polarizes far more than any metal does, with certainty."""
    percent = {
        key: table[key].to_value(u.percent)
        for key in table.colnames
        if key.startswith("diattenuation")
    }
    most = np.max([np.abs(percent[f"diattenuation_{metal}"]) for metal in METALS], axis=0)
    # what is held has no error
    least = np.abs(percent["diattenuation"])
    least = least - 3 * np.nan_to_num(percent["diattenuation_err"], posinf=np.inf)
    above = least / most
    i = int(np.argmax(above))
    if not above[i] > _ABOVE:
        return ""
    return (
        f"{table.meta['name']}: {percent['diattenuation'][i]:.2f} % at "
        f"{table['wavelength'][i].to_value(u.nm):.1f} nm is more than {_ABOVE} times what a bare "
        "metal has: a coating, or something else that the model lacks"
    )


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


# ---- what an accuracy for a target is made of -----------------------------------------------


def open_on_sky(calibration):
    """
    Return what is open or badly determined and changes what is measured on sky.

    Of each direction ``kind``, ``words`` and the changes ``aolp_deg`` and
    ``dolp_percent``, least and largest of the wavelengths; the worst first.
    """
    finding = calibration.identifiability
    return [
        {"kind": kind, "words": words(direction)} | direction["sky"]
        for kind, words, directions in (
            ("open", _open_words, finding.directions),
            ("badly determined", _near_words, finding.near_null),
        )
        for direction in sorted(directions, key=_turn, reverse=True)
        if direction.get("sky") and shows_on_sky(direction["sky"])
    ]


def open_lines(calibration, infinite=True):
    """Say what makes an accuracy for a target infinite or large, one line a kind."""
    found, lines = open_on_sky(calibration), []
    for kind, says in (
        (
            "open",
            "infinite by what the data leave open"
            if infinite
            else "resting on priors, as the data leave it open",
        ),
        ("badly determined", "large by what is badly determined"),
    ):
        words = [one["words"] for one in found if one["kind"] == kind]
        more = [f"and {len(words) - _N_OPEN} more, see below"] if len(words) > _N_OPEN else []
        if words:
            lines.append(f"  {says}: {'; '.join([*words[:_N_OPEN], *more])}")
    return lines


def _turn(direction):
    return max(map(abs, (direction.get("sky") or {}).get("aolp_deg", [0.0])))


def _open_words(direction):
    lead = direction["words"].partition(" cannot be told")[0].partition(" changes no datum")[0]
    return f"{lead}: {sky_words(direction['sky'])}"


def _near_words(direction):
    lead = direction["words"].partition(" at the noise of this fit")[0]
    return f"{lead}: {sky_words(direction['sky'])}"
