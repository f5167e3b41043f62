# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal reduce``: from FITS cubes to an observation table."""

import argparse
import sys
from collections import Counter
from pathlib import Path

from astropolcal.exceptions import AstropolcalError
from astropolcal.files import one_line
from astropolcal.scripts._common import (
    check_suffix,
    cube_files,
    number_or,
    printer,
    show,
    write_json,
)
from astropolcal.words import counted

# a folder of other files must not push the summary off the screen
_MAX_LISTED = 20

HELP = "measure both beams in FITS cubes and write an observation table"
DESCRIPTION = """\
Measure the fluxes of both beams in extracted cubes. A file that cannot be
used is left out and listed with the reason."""
EXAMPLES = """\
examples:
  astropolcal reduce cubes/ --raw raw/ --source polarized -o run.ecsv
  astropolcal reduce cubes/ --raw raw/ --source star -o star.ecsv
  astropolcal reduce cubes/ -o run.ecsv --quicklook look --background outside
"""


OPTIONS = """
cubes CUBES + Frames  cubes, or folders of them (*.fits)
-o --output OBS.ecsv Output required  the table; overwritten if it exists
--instrument NAME =charis  default: charis
--raw DIR Frames  folder of raw frames, for keywords that the cubes lack
--source KIND =internal  internal (default), polarized, unpolarized (internal source with and
    without its polarizer), star, 'unpolarized standard star', 'polarized standard star'
--meta KEY=VALUE pair ...  more for the table's meta, such as yjh50_dichroic=in
--hwp-sequence DEG,DEG,... angles  commanded angles that replace wrong ones of the headers, in turn
--background {none,outside}  internal source: subtract nothing (default) or the level outside the
    beams
--radius PIXELS radius  stars: radius of the aperture; fwhm (default, 3 full widths), growth (99 %%
    of the light) or pixels
--aperture-correction  stars: scale the fluxes to all of the star's light, by a profile of its wings
--workers N int  number of processes
--resume FILE Continued  journal of what is done, to go on after a stop
--quicklook DIR Folder  write figures to this folder
@ json online quiet
"""


def _pair(text):
    key, equal, value = text.partition("=")
    if not (equal and key.strip() and value.strip()):
        raise argparse.ArgumentTypeError(f"{text!r} is not KEY=VALUE")
    return key.strip(), value.strip()


TYPES = {"pair": _pair, "radius": number_or("fwhm", "growth")}


def run(arguments):
    """Reduce the cubes and write the table."""
    from tqdm import tqdm

    from astropolcal import instruments
    from astropolcal.reduction import reduce_run

    check_suffix("-o", arguments.output, ".ecsv")
    files = cube_files(arguments.cubes)
    instrument = instruments.get(arguments.instrument)
    with tqdm(
        total=len(files), desc="reducing", unit="cube", disable=True if arguments.quiet else None
    ) as bar:
        reduction = reduce_run(
            files,
            instrument,
            source=arguments.source,
            raw=arguments.raw,
            meta=dict(arguments.meta),
            workers=arguments.workers,
            resume=arguments.resume,
            hwp_sequence=arguments.hwp_sequence,
            # tqdm counts steps, the reduction the total
            progress=lambda done, _: bar.update(done - bar.n),
            **_options(arguments),
        )
    reduction.write(arguments.output, overwrite=True)
    # after the table, which is what the time went into
    figures = []
    if arguments.quicklook:
        from astropolcal.plotting.reduction import save_quicklook

        figures = save_quicklook(reduction, arguments.quicklook)
    if arguments.json:
        summary = {"output": str(arguments.output)} | reduction.summary()
        write_json(summary | {"figures": [str(path) for path in figures]}, arguments.json)
    _report(reduction, arguments, figures)


def _options(arguments):
    star = "star" in arguments.source
    given = {
        name: value
        for name in ("background", "radius", "aperture_correction")
        if (value := getattr(arguments, name)) is not None and value is not False
    }
    # options of one photometry do nothing in the other
    wrong = {"background"} & set(given) if star else set(given) - {"background"}
    if wrong:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(wrong))
        kind = "the internal source" if star else "stars"
        raise AstropolcalError(f"{names} is for {kind}, not for --source {arguments.source}")
    return given


def _report(reduction, arguments, figures):
    """Say what was done on stdout, and what was left out on stderr."""
    for path, why in list(reduction.problems.items())[:_MAX_LISTED]:
        line = one_line(f"{Path(path).name}: {'; '.join(why)}", None)
        show(f"astropolcal: left out: {line}", file=sys.stderr)
    # on stderr also with -q: what was lost is a warning
    more = len(reduction.problems) - _MAX_LISTED
    if more > 0:
        words = f"{counted(more, 'more file')} (--json lists all)"
        show(f"astropolcal: left out: {words}", file=sys.stderr)
    # in the order of the files
    doubts = Counter(reason for reasons in reduction.doubts.values() for reason in reasons)
    for why, count in doubts.items():
        show(f"astropolcal: doubtful: {counted(count, 'file')}: {why}", file=sys.stderr)
    say, summary = printer(arguments), reduction.summary()
    say(
        f"Written: {one_line(arguments.output, None)} ({counted(summary['n_frames'], 'frame')}, "
        f"{summary['n_masked']} of {counted(summary['n_cells'], 'cell')} masked)"
    )
    for reason, count in summary["flags"].items():
        say(f"  masked, {reason}: {counted(count, 'cell')}")
    if figures:
        say(f"Figures: {one_line(arguments.quicklook, None)} ({counted(len(figures), 'file')})")
