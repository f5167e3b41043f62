# Licensed under a 3-clause BSD style license - see LICENSE
"""What of a fit shows that its result cannot be right, for a line near the top of a summary."""

import astropy.units as u
import numpy as np

from astropolcal.calibration.reflections import mirror_names, mirror_values
from astropolcal.calibration.steps import kind_of_source

_MOST = 0.5
# bare metals polarize by a few percent at most, coated ones by little more
_NO_MIRROR = 30 * u.percent
# so many angles common to all wavelengths at their bounds are no chance
_ANGLES = 2
# residuals at least as large happen by chance less often
_UNLIKELY = 0.01


def unusable_words(calibration, known):
    """
    Return why the result cannot be right, one line a reason.

    ``known`` is what ``calibration.parameter_values()`` returns.
    """
    return [
        f"NOT USABLE AS IT IS: {reason}"
        for reason in (_stuck(known), _angles(calibration, known), *_mirrors(calibration, known))
        if reason
    ]


def _stuck(known):
    """Name the parameters that are at a bound nearly everywhere."""
    stuck = [
        f"{name} ({np.sum(entry['at_bound'])} of {entry['value'].size})"
        for name, entry in known.items()
        if entry["value"].ndim and np.mean(entry["at_bound"]) > _MOST
    ]
    return f"at a bound at most wavelengths: {', '.join(stuck)}" if stuck else ""


def _angles(calibration, known):
    """Say that most of the angles are at a bound, and the residuals larger than the noise."""
    angles = {
        name: bool(entry["at_bound"])
        for name, entry in known.items()
        if not (entry["value"].ndim or entry["fixed"] or entry["tied"])
        and entry["unit"] is not None
        and u.Unit(entry["unit"]).is_equivalent(u.rad)
    }
    stuck = [name for name, at_bound in angles.items() if at_bound]
    tests = calibration.fit.get("lack_of_fit") or []
    times = [test["times_noise"] for test in tests if test["p_value"] < _UNLIKELY]
    if len(stuck) < _ANGLES or len(stuck) <= _MOST * len(angles) or not times:
        return ""
    return (
        f"at a bound: {', '.join(stuck)}, with residuals {min(times):.3g} times the noise: check "
        "which beam is left and which right, and the angles in the table and their signs; "
        "astropolcal diagnose looks for such causes"
    )


def _mirrors(calibration, known):
    """Say of each mirror that polarizes as no mirror does, where the source is not to."""
    sources = [r for r in calibration.datasets if kind_of_source(r.source) != "polarized"]
    return [
        f"{name} polarizes by more than {_NO_MIRROR.value:g} % at {counts}, which no mirror does: "
        "is the source of "
        + " and of ".join(f"{r.name} really {str(r.source)!r}" for r in sources)
        + ", as the table says?"
        for name in (mirror_names(calibration) if sources else ())
        if (counts := _too_much(calibration, known, name))
    ]


def _too_much(calibration, known, name):
    """Return at how many wavelengths a fitted mirror polarizes too much with certainty."""
    if known.get(f"{name}.diattenuation", {"fixed": False})["fixed"]:
        return ""
    table = mirror_values(calibration, name)
    # without an error where it is at a bound, and where only a product with another is known
    error = np.nan_to_num(table["diattenuation_err"].value, posinf=np.inf)
    least = np.abs(table["diattenuation"].value) - 3 * error
    count, size = np.sum(least * table["diattenuation"].unit > _NO_MIRROR), len(table)
    return f"{count} of {size} wavelengths" if count > _MOST * size else ""
