# Licensed under a 3-clause BSD style license - see LICENSE
"""A summary that fits a terminal of 80 columns and 24 lines."""

import textwrap

import numpy as np

from astropolcal.calibration.stars import fitted_stars
from astropolcal.calibration.verdicts import shortened
from astropolcal.words import counted

# the terminal's 24 lines less the prompt
HEIGHT = 23
HINT = "--full (full=True) adds tables per wavelength, the gauge and mirror solutions"
_WIDTH = 80
_COLUMN = 28
# estimates of the noise, in few words
_NOISES = {"errors": "stated errors"}


def compact_lines(calibration, found, height=HEIGHT):
    """Return the verdict, the parameters, the fit and its goodness in so many lines."""
    stars = fitted_stars(calibration)
    known = without_stars(calibration.parameter_values(), stars)
    single = parameter_lines(known, several=False)
    found_of = (shortened(f"  {star.meta['words']}") for star in stars)
    rows = [*single, *found_of, *parameter_lines(known)[len(single) :]]
    rest = [_heading(calibration), _fit(calibration), *_goodness(calibration)]
    room = height - len(found.words) - len(rest) - 2
    if len(rows) > room:
        rows = [*rows[: room - 1], f"  and {len(rows) - room + 1} more lines"]
    return [*found.words, "", *rows, "", *(shortened(line) for line in rest)]


def _heading(calibration):
    names = [record.name for record in calibration.datasets]
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    return f"Calibration of {calibration.instrument or 'an instrument'} from {names[0]}{more}"


def _fit(calibration):
    fit, n = calibration.fit, len(calibration.covariance)
    outliers = len(fit.get("outliers") or [])
    return (
        f"Fit         {counted(n, 'parameter')}, {fit['n_data']} data, rank "
        f"{calibration.identifiability.rank}, {calibration.settings['strategy']}, "
        + ("converged" if calibration.converged else "NOT CONVERGED")
        + (f"; {counted(outliers, 'pair')} of frames at odds" if outliers else "")
        + ("" if calibration.posterior is None else ", sampled")
    )


def _goodness(calibration):
    s_res, s_cv = (_worst(calibration, key) for key in ("s_res", "s_cv"))
    left_out = f", s_cv {s_cv:.2g} %" if np.isfinite(s_cv) else ""
    datasets = "worst dataset, " if len(calibration.datasets) > 1 else ""
    yield f"Residuals   s_res {s_res:.2g} %{left_out} ({datasets}median wavelength)"
    tests = calibration.fit.get("lack_of_fit") or []
    if tests:
        told = [
            f"{test['times_noise']:.2g} x {_NOISES.get(test['noise'], test['noise'])} "
            f"(p = {test['p_value']:.1g})"
            for test in tests
        ]
        yield f"Scatter     {', '.join(told)}"
    # what no fit saw is why it was given
    for entry in calibration.fit.get("standards", []):
        yield f"Predicted   {entry['name']}: {entry['words']}"
    for entry in calibration.fit.get("stars", []):
        yield f"Catalogue   {entry['words']}"


def _worst(calibration, key):
    """Return the largest of the datasets' medians over the wavelengths."""
    medians = []
    for table in (record.accuracy for record in calibration.datasets):
        known = table[key].value[np.isfinite(table[key].value)] if key in table.colnames else []
        medians += [np.median(known)] if len(known) else []
    return max(medians, default=np.nan)


# ---- parameters -----------------------------------------------------------------------------


def without_stars(known, stars):
    """Return the parameters that are not those of a standard star, which say it in many numbers."""
    names = tuple(f"{star.meta['name']}." for star in stars)
    return {name: entry for name, entry in known.items() if not name.startswith(names)}


def parameter_lines(known, several=True):
    """Return a line for each free parameter, those given per wavelength last, if at all."""
    free = {name: entry for name, entry in known.items() if not entry["fixed"]}
    lines = [
        line
        for name, entry in free.items()
        if not entry["value"].ndim
        for line in _wrapped(name, number(entry))
    ]
    if several:
        rows = {name: entry for name, entry in free.items() if entry["value"].ndim}
        lines += [shortened(f"  {name:<{_COLUMN}}{_range(entry)}") for name, entry in rows.items()]
    return lines


def _wrapped(name, text):
    first = f"  {name:<{_COLUMN}}"
    indent = " " * (_COLUMN + 5)
    return textwrap.wrap(
        first + text, _WIDTH, subsequent_indent=indent, drop_whitespace=True,
        break_on_hyphens=False,
    )  # fmt: skip


def number(entry):
    """Return value, error, unit and status of a parameter common to all wavelengths."""
    value, std, unit = float(entry["value"]), float(entry["std"]), str(entry["unit"] or "")
    status = str(entry["status"])
    # z: what rounds to zero has no sign
    text = f"{value:z12.5f}"
    if status == "tied":
        return f"{text} {unit} (follows {entry['tied']})"
    if status == "at bound":
        inward = inward_words(entry, value, float(entry["std_inward"]))
        return f"{text} {unit} ({'; '.join(filter(None, ['at its bound', inward]))})"
    if not np.isfinite(std):
        return f"{text} {unit} ({'open: not determined alone' if status == 'open' else status})"
    error = f"{std:.5f}" if std < 10 else f"{std:.4g}"
    text = f"{text} +- {error} {unit}".rstrip()
    if status == "conditional":
        return f"{text} ({conditional(entry)})"
    return text if status == "determined" else f"{text} ({status})"


def inward_words(entry, value, inward):
    """Say how far what is at a bound may go inward at one sigma; empty where that is not known."""
    if not np.isfinite(inward):
        return "not limited" if np.isinf(inward) else ""
    low, high = entry["bounds"]
    at_low = high is None or (low is not None and value - low < high - value)
    # two digits of the way inward
    digits = max(2, 1 - int(np.floor(np.log10(inward)))) if inward > 0 else 5
    return f"below {value + inward:.{digits}f}" if at_low else f"above {value - inward:.{digits}f}"


def conditional(entry):
    """Say on what an error hangs, and what it is without."""
    released = float(entry["std_released"])
    without = f"{released:.2g}" if np.isfinite(released) else "open"
    return f"conditional on {entry['conditional_on']} at its bound; without it {without}"


def _range(entry):
    """Return least and largest value over the wavelengths, and how many have which status."""
    values, unit = entry["value"], str(entry["unit"] or "")
    digits = 2 if entry["unit"] else 4
    text = f"{values.min():z.{digits}f} to {values.max():z.{digits}f} {unit}".rstrip()
    statuses, counts = np.unique(entry["status"], return_counts=True)
    std = entry["std"][np.isfinite(entry["std"])]
    error = f" +- {np.median(std):.2g}" if std.size else ""
    if len(statuses) == 1:
        return f"{text}{error} ({statuses[0]})"
    told = (f"{n} {s}" for s, n in zip(statuses, counts, strict=True) if s != "determined")
    return f"{text}{error} ({', '.join(told)})"
