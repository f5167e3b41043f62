# Licensed under a 3-clause BSD style license - see LICENSE
"""A calibration in words for the terminal, and in numbers for machines."""

import re
import textwrap

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.sky import shows_on_sky, sky_words
from astropolcal.calibration.noise.scatter import what_is_left_out
from astropolcal.calibration.result.verdict import (
    HEIGHT,
    HINT,
    at_wavelength,
    compact_lines,
    inward_words,
    parameter_lines,
    verdict,
    without_stars,
)
from astropolcal.calibration.uncertainty.derived import METALS, mirror_names, mirror_values
from astropolcal.calibration.validation.stars import fitted_stars
from astropolcal.calibration.validation.targets import TARGETS, target_accuracies, target_entry
from astropolcal.chain import leaves
from astropolcal.files import columns, plain
from astropolcal.words import WIDTH, counted, with_error

__all__ = []

# logarithm of the Bayes factor from which on something is said to be so
_STRONG = 3.0
# value and error of so many parameters fill the 80 columns
_N_COLUMNS = 3
# errors from which on digits behind the point are too long
_MANY = 1000
# what stands beside an error, and in place of one
_MARKS = {"badly determined": "?", "conditional": "c"}
_SAID = {"open": "open", "at bound": "bound", "badly determined": "no error"}
_ACCURACIES = ("s_res", "s_mean", "s_cv", "s_standard")
# pairs of frames at odds with the fit that a summary names
_MOST_OUTLIERS = 5
_AFTER_LEAD = re.compile(" cannot be distinguished| changes no datum| at the noise of this fit")
_ELEMENT = re.compile(r"(\w+\.\w+)\[(\d+)\]")


def summary(calibration, targets=TARGETS, full=False):
    """Return a calibration as text of at most 80 columns, in less than 24 lines unless ``full``."""
    found = verdict(calibration, targets)
    if not full:
        return "\n".join([*compact_lines(calibration, found, HEIGHT - 1), HINT])
    known, stars = calibration.parameter_values(), fitted_stars(calibration)
    fit, gauge, posterior = calibration.fit, calibration.settings.get("gauge"), []
    told = [*found.reasons, *found.cautions]
    hidden = told and "; ".join(told) not in found.words[0]
    if calibration.posterior is not None:
        posterior = [f"  {line}" for line in calibration.posterior.words().split("\n")]
    pairs = zip(calibration.datasets, _masked(calibration), strict=True)
    before = [
        _heading(calibration),
        _titled(
            "Parameters for all wavelengths",
            parameter_lines(without_stars(known, stars), several=False),
        ),
        _titled("Laws that are added to parameters", _law_lines(calibration)),
        _titled("Parameters with values of their own", _own_lines(calibration)),
        # what was found of the stars, and how far it rests on the catalogue
        _titled("Standard stars", [f"  {' '.join(s.meta['words'].split())}" for s in stars]),
        *(_accuracy_lines(*pair) for pair in pairs),
        [
            "  s_res: residuals, corrected for the parameters fitted; s_mean: s_res/sqrt(n), the "
            "paper's s_rel",
            f"  s_cv: rms error on {what_is_left_out(calibration)} left out of the fit",
            "  s_standard: rms error on datasets that were not fitted"
            + ("" if fit.get("standards") else " (none given)"),
        ],
        *(_standard_lines(entry) for entry in fit.get("standards", [])),
        *([*star_lines(entry), f"  {entry['words']}"] for entry in fit.get("stars", [])),
        _target_lines(calibration, targets),
        *_wavelength_blocks(calibration, known),
    ]
    after = [
        _titled("Goodness of fit", _goodness_lines(calibration)),
        [str(calibration.identifiability)],
        [f"Gauge: {gauge}"] if gauge else [],
        _titled("At a bound", _bound_lines(calibration.parameters, known)),
        _titled("Posterior", posterior),
    ]
    before, after = ([_wrap(calibration, part) for part in parts] for parts in (before, after))
    verdict_lines = [*found.words, *_wrap(calibration, [f"  - {one}" for one in told if hidden])]
    # a table of many mirrors may be wider
    parts = [verdict_lines, *before, mirror_lines(calibration), *after]
    return "\n\n".join("\n".join(part) for part in parts if part)


def _titled(title, lines):
    return [title, *lines] if lines else []


def _wrap(calibration, lines):
    """Break long lines at 80 columns, keeping the indentation of list items.

    Elements of parameters are named by their wavelength instead of their number.
    """
    nm = calibration.wavelength.to_value(u.nm)

    def named(found):
        i = int(found[2])
        return f"{found[1]} ({nm[i]:.1f} nm)" if i < nm.size else found[0]

    wrapped = []
    for line in _ELEMENT.sub(named, "\n".join(lines)).split("\n") if lines else ():
        indent = " " * (len(line) - len(line.lstrip(" -")))
        wrapped += textwrap.wrap(line, WIDTH, subsequent_indent=indent) or [""]
    return wrapped


def _heading(calibration):
    fit, settings = calibration.fit, calibration.settings
    names = ", ".join(record.name for record in calibration.datasets)
    state = "converged" if calibration.converged else "NOT CONVERGED"
    title = f"Calibration of {calibration.instrument or 'an instrument'} from {names}"
    return [
        title,
        f"{settings['strategy']} fit of {counted(len(calibration.covariance), 'parameter')} to "
        f"{fit['n_data']} {settings['observable'].replace('_', ' ')}s,",
        f"{settings['fitter']}, {fit['seconds']:.2f} s, {state}",
    ]


def _law_lines(calibration):
    """Name the laws that parameters follow, and the frames with which they were calibrated."""
    optics = {leaf.name: leaf for chain in calibration.chains for leaf in leaves(chain)}
    return [
        f"  - {name}.{key}: {law}"
        for name, leaf in optics.items()
        for key, law in leaf._follows.items()
    ]


def _own_lines(calibration):
    """Say which parameters with values of their own really differ."""
    lines = []
    for name, copies in (calibration.settings.get("own") or {}).items():
        evidence = _evidence(calibration, copies)
        words = "differs" if evidence > _STRONG else "may as well be the same in all of them"
        words = words if np.isfinite(evidence) else "is not determined"
        lines.append(f"  - {name}: {words} (ln Bayes factor {evidence:.1f})")
    return lines


def _evidence(calibration, names):
    """Return the logarithm of the Bayes factor of parameters that differ against equal ones."""
    free = list(calibration.covariance.names)
    value = dict(zip(calibration.parameters["name"], calibration.parameters["value"], strict=True))
    first, *others = ([e for e in free if e.partition("[")[0] == name] for name in names)
    contrasts = np.zeros((len(first) * len(others), len(free)))
    pairs = ((one, other) for several in others for one, other in zip(first, several, strict=True))
    for row, (one, other) in zip(contrasts, pairs, strict=True):
        row[free.index(one)], row[free.index(other)] = -1.0, 1.0
    used = contrasts.any(axis=0)
    matrix = calibration.covariance.matrix[np.ix_(used, used)]
    difference = contrasts @ [value[name] for name in free]
    if not np.isfinite(matrix).all():
        return np.nan
    spread = contrasts[:, used] @ matrix @ contrasts[:, used].T
    chi2 = difference @ np.linalg.pinv(spread, hermitian=True) @ difference
    # Schwarz's approximation (1978, Ann. Statist. 6, 461)
    return (chi2 - len(difference) * np.log(calibration.fit["n_data"])) / 2


def _accuracy_lines(record, reasons):
    table = record.accuracy
    masked = f", {counted(record.n_masked, 'cell')} masked" if record.n_masked else ""
    size = f"{counted(record.n_frames, 'frame')} x {counted(len(table), 'wavelength')}"
    counts = [f"{size}{masked}", *(f"{reason}: {count}" for reason, count in reasons.items())]
    return [
        f"Accuracy on {record.name}, in percent of polarization",
        *_rows({name: _percent(table, name) for name in _ACCURACIES}),
        f"  ({'; '.join(counts)})",
    ]


def _masked(calibration):
    """Return why cells of each dataset are masked; a file of before does not say."""
    reasons, count = calibration.fit.get("masked") or [], len(calibration.datasets)
    return reasons if len(reasons) == count else [{}] * count


def _percent(table, name):
    # files that were written before a column existed do not have it
    return table[name].value if name in table.colnames else np.full(len(table), np.nan)


def _rows(columns):
    """Return median, best and worst of each column, under their names."""
    head = f"  {'':<10}" + "".join(f"{name:>11}" for name in columns)
    # a share of an error of zero, as of data without noise, is infinite and says nothing
    known = {name: np.where(np.isfinite(v), np.abs(v), np.nan) for name, v in columns.items()}
    rows = [
        f"  {label:<10}" + "".join(f"{_told(v, end, '.3f'):>11}" for v in known.values())
        for label, end in (("median", np.median), ("best", np.min), ("worst", np.max))
    ]
    return [head, *rows]


def _told(values, function, form):
    known = values[~np.isnan(values)]
    return f"{function(known):{form}}" if known.size else "-"


def _standard_lines(entry):
    columns = {
        "s_standard": entry["s_standard_percent"],
        "|bias|": entry["bias_percent"],
        "scatter": entry["scatter_percent"],
        "s_cv": entry["s_cv_percent"],
        "/ s_cv": entry["chi"],
    }
    return [
        f"Prediction of {entry['name']} (not fitted), in percent",
        *_rows({name: np.array(values, dtype=float) for name, values in columns.items()}),
        f"  {entry['words']} ({counted(entry['n_frames'], 'frame')} x "
        f"{counted(len(entry['n']), 'wavelength')})",
    ]


def _target_lines(calibration, targets):
    """Return a table with one row per target: median and worst of the wavelengths."""
    tables = target_accuracies(calibration, targets)
    if not tables:
        return []
    heads = ("s_Q", "s_U", "s_p", "(worst)", "s_chi", "(worst)")
    lines = [
        "Accuracy for a target in percent, s_chi in deg, median over the wavelengths",
        f"  {'DoLP':>6}{'AoLP':>10}" + "".join(f"{name:>10}" for name in heads),
        *(_target_row(table) for table in tables),
    ]
    infinite = any(np.isinf(table[key]).any() for table in tables for key in ("s_p", "s_chi"))
    if infinite:
        known = target_accuracies(calibration, targets, open_directions="ignore")
        lines += ["  as if the undetermined parameters were known:", *map(_target_row, known)]
    lines.append(f"  {tables[0].meta['words']}")
    if any(table.meta["aolp"] is None for table in tables):
        lines.append("  AoLP any: the angle with the worst accuracy")
    return lines + open_lines(calibration, infinite)


def _target_row(table):
    angle = table.meta["aolp"]
    dolp = u.Quantity(table.meta["dolp"]).to_value(u.percent)
    shown = "any" if angle is None else f"{angle.to_value(u.deg):.4g}"
    row = f"  {dolp:4.3g} %{shown:>10}"
    for key in ("s_Q", "s_U", "s_p", "s_chi"):
        # s_Q and s_U only lead to s_p: their worst values would crowd the table
        worst = (np.max,) if key in ("s_p", "s_chi") else ()
        for function in (np.median, *worst):
            row += f"{_told(table[key].value, function, '.2g'):>10}"
    return row


def _wavelength_blocks(calibration, known):
    """Return tables with one row per wavelength, and in each as many parameters as fit."""
    several = [(n, e) for n, e in known.items() if e["value"].ndim and not e["fixed"]]
    s_mean, blocks = {}, []
    # at each wavelength that of the first dataset that has it
    for accuracy in (record.accuracy for record in calibration.datasets):
        nm = accuracy["wavelength"].to_value(u.nm)
        for w, s in zip(nm, accuracy["s_mean"].value, strict=True):
            if np.isfinite(s):
                s_mean.setdefault(round(w, 2), s)
    for start in range(0, len(several), _N_COLUMNS):
        names, shown = zip(*several[start : start + _N_COLUMNS], strict=True)
        optics, keys = zip(*(name.split(".") for name in names), strict=True)
        units = [str(entry["unit"] or "") for entry in shown]
        marks = "Parameters for each wavelength (? badly determined, c conditional on a bound)"
        rows = [] if start else [marks]
        for first, second, texts in (("", "", optics), ("", "s_mean", keys), ("nm", "%", units)):
            row = f"{first:>8}{second:>8}" + "".join(f"{text[:20]:>17}    " for text in texts)
            rows.append(row.rstrip())
        for i, wavelength in enumerate(calibration.wavelength.to_value(u.nm)):
            mean = s_mean.get(round(wavelength, 2), np.nan)
            row = f"{wavelength:8.1f}" + (f"{mean:8.3f}" if np.isfinite(mean) else f"{'-':>8}")
            rows.append((row + "".join(_cell(entry, i) for entry in shown)).rstrip())
        blocks.append(rows)
    return blocks


def _cell(entry, i):
    """Return value and error of one wavelength; 21 characters."""
    # degrees to 0.01, shares of one to 0.0001
    digits, std, status = 2 if entry["unit"] else 4, entry["std"][i], entry["status"][i]
    value = f"{entry['value'][i]:z10.{digits}f}"
    if np.isfinite(std):
        error = f"{std:.{digits}f}" if std < _MANY else f"{std:.0e}"
        return f"{value} +- {error}".ljust(20) + _MARKS.get(status, " ")
    # what follows another parameter has no error of its own
    return f"{value} {_SAID.get(status, '')}".ljust(21)


def _goodness_lines(calibration):
    """Return the tests, and the pairs of frames at odds with the fit, which are not left out."""
    outliers = calibration.fit.get("outliers") or []
    lines = [f"  - {test['words']}" for test in calibration.fit.get("lack_of_fit") or []]
    lines += [
        f"  - frames {one['frames']} of {one['dataset']} are at odds with the fit"
        f"{at_wavelength(one)}, by {one['residual_percent']:+.2g} % ({one['sigma']:.0f} "
        f"robust sigma, brightness {one['brightness']:.2f}); they are not left out"
        for one in outliers[:_MOST_OUTLIERS]
    ]
    more = len(outliers) - _MOST_OUTLIERS
    return lines + ([f"  - and {more} more pairs at odds with the fit"] if more > 0 else [])


def _bound_lines(table, known):
    """Name what is at a bound, how far it may go inward, and whose errors depend on that."""
    lines, hanging = [], {}
    for row in table:
        name = row["name"].partition("[")[0]
        if row["at_bound"]:
            end = inward_words(known[name], row["value"], row["std_inward"])
            lines.append(f"  - {row['name']}{end and ': '}{end}")
        if row["status"] == "conditional":
            times = row["std_released"] / row["std"]
            hanging.setdefault((row["conditional_on"], name), []).append(times)
    for (by, name), times in hanging.items():
        several = f" at {len(times)} wavelengths" if len(times) > 1 else ""
        low, high = min(times), max(times)
        lines.append(
            f"  - the error of {name}{several} is conditional on {by} at its bound; without it "
            f"{low:.2g}{'' if low == high else f' to {high:.2g}'} times as large"
        )
    return lines


# ---- for machines ------------------------------------------------------------------


def to_dict(calibration, targets=TARGETS):
    """Return a calibration as plain numbers, lists and strings, ready for JSON; NaN is None."""
    settings, fit = calibration.settings, calibration.fit
    content = {
        "verdict": verdict(calibration, targets).to_dict(),
        "instrument": calibration.instrument,
        **{key: settings[key] for key in ("observable", "fitter", "strategy", "weights")},
        "gauge": settings.get("gauge"),
        "seconds": fit["seconds"],
        "converged": calibration.converged,
        "n_data": fit["n_data"],
        "n_free": len(calibration.covariance),
        "rank": calibration.identifiability.rank,
        **{key: fit.get(key) or [] for key in ("lack_of_fit", "outliers", "disagreements")},
        "datasets": [
            _dataset(record) | {"masked": reasons}
            for record, reasons in zip(calibration.datasets, _masked(calibration), strict=True)
        ],
        "left_out": what_is_left_out(calibration),
        "stars": fit.get("stars", []),
        "mirrors": [
            {"name": table.meta["name"], "retardance_held": table.meta["held"]} | columns(table)
            for table in _mirror_tables(calibration)
        ],
        "fitted_stars": [
            {key: table.meta[key] for key in ("name", "from_data")} | columns(table)
            for table in fitted_stars(calibration)
        ],
        "standards": [
            # nothing is fitted to a standard: with k = 0 its s_res is the error of prediction
            entry | {"s_res_percent": entry["s_standard_percent"]}
            for entry in fit.get("standards", [])
        ],
        "targets": [target_entry(table) for table in target_accuracies(calibration, targets)],
        "parameters": {
            name: entry | {"unit": str(entry["unit"] or "")}
            for name, entry in calibration.parameter_values().items()
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
    return plain(content)


def _dataset(record):
    table = record.accuracy
    keys = ("name", "source", "content_hash", "n_frames", "n_masked")
    return {key: getattr(record, key) for key in keys} | {
        "wavelength_nm": table["wavelength"].to_value(u.nm),
        "n": table["n"],
        "k": table["k"],
        **{f"{key}_percent": _percent(table, key) for key in _ACCURACIES},
    }


# ---- mirrors, stars that no fit saw, and what is left open on sky ----


_N_MIRROR_ROWS = 5
# a diattenuation of so many times that of any metal is pointed at
_ABOVE = 3
# so many wavelengths are all shown
_ALL_ROWS = 12
# so many open directions are named under the accuracies for a target, and as many bad ones
_N_OPEN = 3
_STAR_HEAD = ("DoLP (%)", "catalogue", "AoLP (deg)", "catalogue")


def _mirror_tables(calibration):
    return [mirror_values(calibration, name) for name in mirror_names(calibration)]


def mirror_lines(calibration):
    """Return diattenuations of mirrors beside those of bare metals, at a few wavelengths."""
    tables = _mirror_tables(calibration)
    if not tables:
        return []
    # a grid of several tables need not ascend
    order = np.argsort(calibration.wavelength)
    step = 1 if order.size <= _ALL_ROWS else -(-order.size // _N_MIRROR_ROWS)
    shortened = f"; one in {step} of {order.size} wavelengths" if step > 1 else ""
    head = "       nm" + "".join(f"{table.meta['name']:>17}" for table in tables)
    lines = [f"Diattenuation in percent; the metals bare, at 45 deg{shortened}"]
    lines.append(head + "".join(f"{metal:>10}" for metal in METALS))
    for i in order[::step]:
        line = f"{calibration.wavelength[i].to_value(u.nm):9.1f}"
        for table in tables:
            value, std = (table[f"diattenuation{end}"][i].value for end in ("", "_err"))
            line += with_error(value, ".3f", std).rjust(17)
        metals = (tables[0][f"diattenuation_{metal}"][i] for metal in METALS)
        lines.append(line + "".join(f"{value.to_value(u.percent):10.2f}" for value in metals))
    # the table may be wider, a sentence need not
    return lines + [s for t in tables for s in textwrap.wrap(_above_metals(t), WIDTH)]


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
                line += with_error(value, f".{digits}f", std).rjust(17)
        lines.append(line)
    return lines


# ---- what an accuracy for a target is made of -----------------------------------------------


def open_on_sky(calibration):
    """Return what is open or badly determined and changes what is measured on sky, worst first.

    Of each direction ``kind``, ``words``, and least and largest change ``aolp_deg`` and
    ``dolp_percent``.
    """
    finding, found = calibration.identifiability, []
    kinds = (("open", finding.directions), ("badly determined", finding.near_null))
    for kind, directions in kinds:
        shown = [one for one in directions if one.get("sky") and shows_on_sky(one["sky"])]
        shown.sort(key=lambda one: max(map(abs, one["sky"]["aolp_deg"])), reverse=True)
        for one in shown:
            words = f"{_AFTER_LEAD.split(one['words'])[0]}: {sky_words(one['sky'])}"
            found.append({"kind": kind, "words": words} | one["sky"])
    return found


def open_lines(calibration, infinite=True):
    """Say what makes an accuracy for a target infinite or large, one line a kind."""
    of_open = "infinite, because the data do not determine"
    if not infinite:
        of_open = "from priors, because the data do not determine it"
    of_bad, lines = "large, because of badly determined directions", []
    for kind, says in (("open", of_open), ("badly determined", of_bad)):
        words = [one["words"] for one in open_on_sky(calibration) if one["kind"] == kind]
        more = [f"and {len(words) - _N_OPEN} more, see below"] if len(words) > _N_OPEN else []
        if words:
            lines.append(f"  {says}: {'; '.join([*words[:_N_OPEN], *more])}")
    return lines
