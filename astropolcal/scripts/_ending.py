# Licensed under a 3-clause BSD style license - see LICENSE
"""The summary with which a command ends: it fits a terminal of 80 columns and 24 lines."""

from astropolcal.calibration.result.verdict import HEIGHT, shortened
from astropolcal.files import one_line
from astropolcal.words import counted


def ending(verdict, accuracy, determined, advice, written):
    """Return verdict, accuracy, what is determined, what to do next, and the files written."""
    told = {"Accuracy": accuracy, "Determined": determined, "Next": advice}
    words = [verdict, *(f"{name:<12}{text}" for name, text in told.items())]
    return [*(shortened(line) for line in words), *written]


def written_lines(named, figures=0, folder=None):
    """Return a line for each file that was written; figures are counted."""
    names = [one_line(path, None) for path in named if path and str(path) != "-"]
    names += [f"{counted(figures, 'figure')} in {one_line(folder, None)}"] if figures else []
    return [f"Written:    {name}" for name in names]


def written_calibration(arguments, written):
    """Return what `write_calibration` wrote in a few lines, or that nothing was kept."""
    named = [path for path in written if path in (arguments.output, arguments.json)]
    kept = [] if arguments.output else ["Not kept: -o cal.asdf writes the calibration to a file"]
    return written_lines(named, len(written) - len(named), arguments.plots) + kept


def with_ending(body, ends, full):
    """Return a body and its summary in a terminal's lines; in full, the summary at both ends."""
    if full:
        return [*ends, "", *body, "", *ends]
    room, lines = HEIGHT - len(ends) - 1, "\n".join(body).split("\n")
    if len(lines) > room:
        lines[room - 1 :] = [f"and {len(lines) - room + 1} more lines (--full prints all)"]
    return [*lines, "", *ends] if body else ends
