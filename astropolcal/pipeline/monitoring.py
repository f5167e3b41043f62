# Licensed under a 3-clause BSD style license - see LICENSE
"""The health of an instrument through all its calibrations: what changed, and what needs care."""

import warnings

import astropy.units as u
import numpy as np
from astropy.time import Time

from astropolcal.calibration.fit.evidence import COURSES, moment_of
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.result.calibration import folded
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.files import atomic_path, plain, printable
from astropolcal.instruments import Instrument
from astropolcal.measurement.parameters import optic
from astropolcal.pipeline.headers import date_of, days_of
from astropolcal.pipeline.history import courses
from astropolcal.pipeline.library import Library
from astropolcal.units import positive_number
from astropolcal.words import counted, listed

__all__ = ["health"]

#: A change, or a course, at least this probable is an event.
LIKELY = 0.9
# of the table of a library
_OF_ROWS = ("datasets", "s_res_percent", "s_cv_percent", "converged")
_COURSE_WORDS = {
    "constant": "constant",
    "steps": "changes in steps",
    "drift": "drifts",
    "walk": "wanders",
    "scatter": "differs from run to run",
}


def health(library, *, goal=None, max_age=None, events=(), now=None):
    """
    Return how an instrument does, from all its calibrations.

    Parameters
    ----------
    library : Library or path-like
        The calibrations.
    goal : `~astropy.units.Quantity` or float, optional
        Accuracy that is wanted, percent of polarization: the cross-validated one is compared.
    max_age : `~astropy.units.Quantity`, optional
        Age from which on a calibration is too old; by default that of the instrument.
    events : sequence of str
        Dates at which something was done to the instrument, see `courses`.
    now : str or `~astropy.time.Time`, optional
        The moment for which the page holds.

    Returns
    -------
    dict
        Ready for JSON: ``now``, ``unreadable`` and ``groups``, one per instrument and mode, with
        ``instrument``, ``mode``, ``calibrations`` (name, date, ``s_res_percent``,
        ``s_cv_percent``, converged, datasets), ``courses`` (what, or what else, course,
        probabilities), ``events`` (what, between which calibrations and dates, probability),
        ``alarms`` and ``next`` (sentences), and ``left_out``, why calibrations take no part in the
        courses; those that are dated after ``now`` are not there.

    Raises
    ------
    ParameterError
        If the folder holds no calibration, the goal or the age is none, or an event is not a date,
        after ``now``, or of the same date as another.

    Examples
    --------
    >>> from pathlib import Path
    >>> from astropolcal.pipeline import Library, health
    >>> from astropolcal.testing import example_calibration
    >>> Path("runs").mkdir()
    >>> _ = Library("runs").add(example_calibration(date="2025-03-01"))
    >>> (group,) = health("runs", now="2027-01-01")["groups"]
    >>> print(group["alarms"][0])
    The newest calibration is of 2025-03-01, 671 days old; charis needs one every 365 days.
    """
    library = library if isinstance(library, Library) else Library(library)
    if not len(library):
        raise ParameterError(f"{library.source}: holds no calibration that can be read")
    moment = moment_of(Time.now() if now is None else now, "now")
    days = [moment_of(event, "event").isot[:10] for event in events]
    if len(set(days)) < len(days):
        raise ParameterError(f"events {', '.join(days)}: two of one date are not distinguishable")
    # days may be local
    if late := [day for day in days if moment_of(day, "event") > moment + 1 * u.day]:
        raise ParameterError(f"event {late[0]}: allowed are dates up to now, {moment.isot[:10]}")
    goal = None if goal is None else positive_number(goal, "goal", u.percent)
    limit = None if max_age is None else positive_number(max_age, "max_age", u.day)
    rows = {row["name"]: row for row in library.table()}
    groups = {}
    for entry in library.entries:
        # written now so, now so
        key = (entry.validity.instrument or "", folded(entry.validity.mode or ""))
        groups.setdefault(key, []).append(entry)
    return plain(
        {
            "now": moment.isot[:19],
            "goal_percent": goal,
            "unreadable": {path.name: reason for path, reason in library.problems.items()},
            "groups": [
                _group(sorted(own, key=_start), rows, moment, goal, limit, events)
                for _, own in sorted(groups.items())
            ],
        }
    )


def _start(entry):
    return date_of(entry.calibration) or ""


def _group(entries, rows, moment, goal, limit, events):
    """Return what is to be said of the calibrations of an instrument and a mode."""
    held = entries[-1].validity
    gone = {digest for entry in entries for digest in entry.supersedes}
    left_out = [f"{e.name} is superseded" for e in entries if e.content_hash in gone]
    entries = [entry for entry in entries if entry.content_hash not in gone]
    left_out += [f"{e.name} has no date" for e in entries if not _start(e)]
    # what is of a later day, or wrongly dated, tells nothing of this moment; days may be local
    late = [e for e in entries if moment_of(_start(e) or moment, "date") > moment + 1 * u.day]
    left_out += [f"{e.name} is of {_start(e)[:10]}, after {moment.isot[:10]}" for e in late]
    entries = [entry for entry in entries if entry not in late] or entries
    dated = [e for e in entries if _start(e) and e not in late]
    content = {
        "instrument": held.instrument or "",
        "mode": held.mode or "",
        "calibrations": [
            {"name": entry.name, "date": _start(entry) or None}
            | {key: rows[entry.name][key.removesuffix("_percent")] for key in _OF_ROWS}
            for entry in entries
        ],
        "courses": [],
        "events": [],
        "left_out": left_out,
    }
    newest = dated[-1] if dated else entries[-1]
    # what was done since is seen in no calibration
    since = [e for e in events if moment_of(e, "event") > moment_of(_start(newest) or e, "date")]
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        try:
            found = courses(dated, events=[event for event in events if event not in since])
        except (ParameterError, FitError) as problem:
            found = ()
            few = f"{counted(len(dated), 'calibration')} with a date; courses need at least three"
            left_out.append(few if len(dated) < 3 else str(problem))
    content["courses"], content["events"] = _what_changed(found, dated)
    content["events"].sort(key=lambda one: one["to"])
    known = known_instrument(newest.calibration.instrument) or Instrument
    limit = float(known.max_age.to_value(u.day)) if limit is None else limit
    verdict = newest.calibration.verdict()
    content["alarms"] = _alarms(content, newest, verdict, moment, goal, limit)
    content["alarms"] += dict.fromkeys(f"{doubt.message}." for doubt in doubts)
    words = "Something was done on {}, after all calibrations: none is sure for frames since then."
    content["alarms"] += [words.format(event) for event in since]
    following = _next(newest, len(dated), late, moment, limit)
    content["next"] = [following, f"{newest.name}: {verdict.advice}"]
    return content


def _what_changed(found, dated):
    """Return the courses of all optics, and the steps that are likely, ready for JSON."""
    told_courses, events = [], []
    told = [found.meta[key] for key in ("rivals", "steps")] if len(found) else [(), ()]
    doubtful = {optic(one) for rivals in told[0] for one in rivals}
    for row, rivals, steps in zip(found, *told, strict=True):
        what, course = row["what"], row["course"]
        if course == "constant" and what in doubtful:
            # it may be what another row says of another optic
            continue
        known = {"what": what, "or": rivals, "course": course}
        words = (
            f"{listed([what, *rivals], 'or')} {_COURSE_WORDS[course]} ({100 * row[course]:.0f} %)"
        )
        told_courses.append(known | {name: row[name] for name in COURSES} | {"words": words})
        for before, after, surely, others in (one for one in steps if one[2] >= LIKELY):
            which = listed([what, *others], "or")
            days = [_start(e)[:10] for e in dated if e.name in (before, after)]
            words = f"{which} changed between {days[0]} and {days[1]} ({100 * surely:.0f} %)"
            one = {"what": which, "before": before, "after": after, "from": days[0], "to": days[1]}
            events.append(one | {"probability": surely, "words": words})
    return told_courses, events


def _next(newest, n_dated, late, moment, limit):
    """Return when to calibrate again."""
    if not n_dated:
        if late:
            return f"Calibrate: no calibration is of {moment.isot[:10]} or before."
        return "Give the tables times, or state dates in Python: with_validity(valid_from=)."
    due = moment_of(days_of(newest.calibration)[-1], "date") + limit * u.day
    words = "is due" if due < moment else f"is due by {due.isot[:10]}"
    more = f"; {counted(3 - n_dated, 'more run')} will show what changes" if n_dated < 3 else ""
    return f"The next calibration {words}{more}."


def _alarms(content, newest, verdict, moment, goal, limit):
    """Return sentences on what needs care."""
    found, name = [], content["instrument"] or "the instrument"
    # a calibration is as old as its data, from whatever day on it is said to hold
    for day in days_of(newest.calibration)[-1:]:
        age = (moment - moment_of(day, "date")).to_value(u.day)
        if age > limit and newest.validity.valid_until is None:
            found.append(
                f"The newest calibration is of {day[:10]}, {age:.0f} days old; {name} needs one "
                f"every {limit:.0f} days."
            )
    last = content["calibrations"][-1]
    if not last["converged"]:
        found.append(f"{last['name']}: the fit did not converge.")
    if not verdict.usable:
        found.append(f"{newest.name} is not usable as it is: {verdict.reasons[0]}.")
    reached = last["s_cv_percent"] if np.isfinite(last["s_cv_percent"]) else last["s_res_percent"]
    if goal is not None and not reached <= goal:
        found.append(f"{last['name']} reaches {reached:.2g} %; the goal is {goal:.2g} %.")
    fresh = [one["what"] for one in content["events"] if one["after"] == newest.name]
    if fresh:
        found.append(
            f"{listed(fresh)} changed before {newest.name}: frames between the last two "
            "calibrations have no calibration that is sure."
        )
    moving = [
        listed([one["what"], *one["or"]], "or")
        for one in content["courses"]
        if one["course"] not in ("constant", "steps") and one["constant"] <= 1 - LIKELY
    ]
    if moving:
        verb = "is" if len(moving) == 1 else "are"
        found.append(
            f"{listed(moving)} {verb} not constant: with the age of a file its true errors grow "
            "beyond those that it states."
        )
    return found


def write_health(content, path, *, figures=None):
    """
    Write what `health` returns as one self-contained page, which replaces an existing one.

    ``figures`` are data URIs by caption, a dict per group.
    """
    figures = figures or [{} for _ in content["groups"]]
    groups = list(zip(content["groups"], figures, strict=True))
    known = {"content": content, "groups": groups}
    write_page(path, ParameterError, "astropolcal.pipeline", "health.html", known)


def write_page(path, error, package, template, known, filters=None):
    """Write a page from a template of a package, atomically; what is shown is escaped."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    from astropolcal.version import version

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader("astropolcal.pipeline")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= filters or {}
    page = environment.get_template(template).render(**known, version=version)
    with atomic_path(path, error=error) as temporary:
        temporary.write_text(printable(page), encoding="utf-8")
