# Licensed under a 3-clause BSD style license - see LICENSE
"""
Measure both beams in FITS cubes and write an observation table.

A file that cannot be used is left out and listed with the reason.

For example::

  astropolcal reduce cubes/ --raw raw/ --source polarized -o run.ecsv
  astropolcal reduce cubes/ --raw raw/ --source star -o star.ecsv
  astropolcal reduce cubes/ -o run.ecsv --quicklook look --background outside
  astropolcal reduce nights/ --source star --archive tables/ --workers 8
"""

import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path

import numpy as np

from astropolcal import instruments
from astropolcal.exceptions import AstropolcalError
from astropolcal.files import one_line
from astropolcal.scripts import _common as common
from astropolcal.scripts._archive import is_archive, run_archive
from astropolcal.words import counted

# options that `reduce_run` calls the same
_PASSED_ON = ("source", "raw", "dark", "flat", "workers", "cluster", "resume", "hwp_sequence")
# a folder of other files must not push the summary off the screen
_MAX_LISTED = 20


OPTIONS = """
cubes CUBES + Frames  cubes, or folders of them (*.fits)
-o --output OBS.ecsv Output not:archive  the table; overwritten if it exists
--instrument NAME  default: the one that the headers name, else charis
--raw DIR Frames  folder of raw frames, for keywords that the cubes lack
--dark FILE Input  raw frames: dark that is subtracted (FITS); of two cameras the file of the right
    beam, beside that of the left one
--flat FILE Input  raw frames: flat by which they are divided; pixels where it is not above zero, or
    that have no value in dark or flat, are not used
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
--cluster ADDRESS  scheduler of dask.distributed, in place of processes
--resume FILE Continued not:archive  journal of what is done, to go on after a stop
--quicklook DIR Folder not:archive  write figures to this folder
@ full json online quiet
[whole archives]
@ archive gap cycles target retry timeout
"""


def _pair(text):
    key, equal, value = text.partition("=")
    if not (equal and key.strip() and value.strip()):
        raise ValueError
    return key.strip(), value.strip()


TYPES = {"pair": common.text_type("KEY=VALUE", _pair), "radius": common.number_or("fwhm", "growth")}


def run(arguments):
    """Reduce the cubes, or the archive, and write the table."""
    _options(arguments)
    if is_archive(arguments):
        return run_archive("reduce", arguments)
    common.check_suffix("-o", arguments.output, ".ecsv")
    return work(arguments)


def work(arguments):
    """Reduce the cubes of one table."""
    from astropolcal.fitscheck import primary_header
    from astropolcal.pipeline.headers import describe
    from astropolcal.reduction import reduce_run

    files, name = common.cube_files(arguments.cubes), arguments.instrument
    # all are of one run; those that cannot be read are told of later
    for path in files[:5] if name is None else ():
        with suppress(AstropolcalError):
            name = describe(primary_header(path), stated=("date", "mode"))["instrument"]
            break
    instrument = instruments.get(name or "charis")
    passed = {name: getattr(arguments, name) for name in _PASSED_ON} | _options(arguments)
    reduction = reduce_run(files, instrument, meta=dict(arguments.meta), **passed)
    reduction.write(arguments.output, overwrite=True)
    # after the table, which is what the time went into
    figures = []
    if arguments.quicklook:
        from astropolcal.plotting.reduction import save_quicklook

        figures = save_quicklook(reduction, arguments.quicklook)
    if arguments.json:
        summary = {"output": str(arguments.output)} | reduction.summary()
        common.write_json(summary | {"figures": [str(path) for path in figures]}, arguments.json)
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
        common.show(f"astropolcal: left out: {line}", file=sys.stderr)
    # on stderr also with -q: what was lost is a warning
    more = len(reduction.problems) - _MAX_LISTED
    if more > 0:
        words = f"{counted(more, 'more file')} (--json lists all)"
        common.show(f"astropolcal: left out: {words}", file=sys.stderr)
    # in the order of the files
    doubts = Counter(reason for reasons in reduction.doubts.values() for reason in reasons)
    for why, count in doubts.items():
        common.show(f"astropolcal: doubtful: {counted(count, 'file')}: {why}", file=sys.stderr)
    summary, output = reduction.summary(), arguments.output
    n_masked, n_cells = summary["n_masked"], summary["n_cells"]
    lost = n_masked == n_cells
    verdict = "NOT USABLE AS IT IS: all cells are masked" if lost else "Usable"
    n_left, n_doubtful = len(reduction.problems), len(reduction.doubts)
    told = [f"{counted(n_left, 'file')} left out"] if n_left else []
    told += [f"{counted(n_doubtful, 'file')} doubtful"] if n_doubtful else []
    if told:
        verdict += ("; " if lost else ": ") + ", ".join(told)
    determined = f"{counted(summary['n_frames'], 'frame')}, {n_masked} of "
    determined += f"{counted(n_cells, 'cell')} masked"
    advice = (
        "astropolcal info FILE tells of a cube" if lost else common.following("calibrate", output)
    )
    written = common.written_lines([output, arguments.json], len(figures), arguments.quicklook)
    ends = common.ending(verdict, _accuracy(reduction.table), determined, advice, written)
    flags = summary["flags"].items()
    body = [f"  masked, {reason}: {counted(count, 'cell')}" for reason, count in flags]
    common.say(arguments, *common.with_ending(body, ends, arguments.full))


def _accuracy(table):
    """Return the error of a beam's flux, median over what is known."""
    if not {"flux_right", "flux_right_err"} <= set(table.colnames):
        return "not known: the fluxes have no errors"
    # without units, and NaN where a cell is masked
    flux, error = (np.ma.filled(table[n].value, np.nan) for n in ("flux_right", "flux_right_err"))
    known = error[np.isfinite(error) & (flux > 0)] / flux[np.isfinite(error) & (flux > 0)]
    if not known.size:
        return "not known: no flux has an error"
    return f"errors of the fluxes {100 * np.median(known):.2g} % (median, one beam, one frame)"
