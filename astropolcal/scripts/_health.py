# Licensed under a 3-clause BSD style license - see LICENSE
"""
What changed over all calibrations of an instrument, and what needs care.

For each instrument and mode in a folder of calibrations: which optics are
constant, drift or changed and when, and when the next calibration is due.

For example::

  astropolcal health library/
  astropolcal health library/ --html health.html --goal 0.2
  astropolcal health library/ --event 2029-06-10   the mirror was recoated
"""

from contextlib import suppress

import astropy.units as u

from astropolcal.exceptions import ParameterError
from astropolcal.progress import in_one_thread
from astropolcal.scripts import _common as common
from astropolcal.words import counted

OPTIONS = """
library DIR Input  folder of calibrations
--html FILE Output  write a self-contained page
--goal PERCENT float  accuracy that is wanted, in percent of polarization
--max-age DAYS float  age from which on a calibration is too old (default: the instrument's)
--event DATE + ...  something was done to the instrument on this date
--date DATE  moment for which the page holds (default: now)
@ json quiet
"""


@in_one_thread
def run(arguments):
    """Say how the instruments do, and write the page."""
    from astropolcal.pipeline import Library, health
    from astropolcal.pipeline.monitoring import write_health

    common.check_suffix("--html", arguments.html, *common.PAGES)
    library = Library(arguments.library)
    age = None if arguments.max_age is None else arguments.max_age * u.day
    asked = {"goal": arguments.goal, "max_age": age, "events": arguments.event or ()}
    content = health(library, now=arguments.date, **asked)
    if arguments.html:
        figures = [_figures(library, group, arguments.goal) for group in content["groups"]]
        write_health(content, arguments.html, figures=figures)
    lines = [line for group in content["groups"] for line in _group(group)]
    lines += [f"UNREADABLE  {name}: {reason}" for name, reason in content["unreadable"].items()]
    lines = [common.wrapped(line, indent=4) for line in lines]
    common.give(arguments, lines, content, arguments.html, arguments.json)


def _group(group):
    """Return what is printed of an instrument and a mode."""
    from astropolcal.pipeline.monitoring import LIKELY

    name = ", ".join(part for part in (group["instrument"], group["mode"]) if part)
    dates = [one["date"][:10] for one in group["calibrations"] if one["date"]]
    span = f", {dates[0]} to {dates[-1]}" if dates else ""
    lines = [
        f"{name or 'no instrument'}: {counted(len(group['calibrations']), 'calibration')}{span}"
    ]
    lines += [f"  ALARM: {words}" for words in group["alarms"]] or ["  No alarm"]
    lines += [f"  Changed: {one['words']}" for one in group["events"]]
    # what is but more probably constant than not is told with its probability
    sure = [one for one in group["courses"] if one["constant"] >= LIKELY]
    lines += [f"  Constant: {', '.join(one['what'] for one in sure)}"] if sure else []
    lines += [f"  Course: {one['words']}" for one in group["courses"] if one not in sure]
    lines += [f"  Not compared: {words}" for words in group["left_out"]]
    return lines + [f"  Next: {words}" for words in group["next"]]


def _figures(library, group, goal):
    """Return the figures of a group by caption, as data URIs."""
    from astropolcal.gap.report import figure_source
    from astropolcal.plotting import plot_history
    from astropolcal.plotting.parameters import draw_accuracies

    names = {one["name"] for one in group["calibrations"] if one["date"]}
    entries = [entry for entry in library.entries if entry.name in names]
    found = {"Accuracy of each calibration": draw_accuracies(group, goal)} if entries else {}
    for one in group["courses"] if len(entries) > 1 else ():
        # more parameters than a figure holds; the courses are in the table
        with suppress(ParameterError):
            figure = plot_history(entries, [one["what"]], title=one["words"])
            alone = f"{one['words']}. What only a combination of optics tells does not show here"
            found[one["words"] if one["course"] == "constant" else alone] = figure
    return {caption: figure_source(figure, 110) for caption, figure in found.items()}
