# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal reduce``: from FITS cubes to an observation table."""

import argparse
import sys
from pathlib import Path

from astropolcal.exceptions import AstropolcalError
from astropolcal.scripts._common import (
    add_json,
    add_quiet,
    angles,
    check_folders,
    check_outputs,
    cube_files,
    number_or,
    write_json,
)

_MAX_LISTED = 20

_EPILOG = """\
examples:
  astropolcal reduce cubes/ --raw raw/ --source polarized -o run.ecsv
  astropolcal reduce cubes/ --raw raw/ --source star -o star.ecsv
  astropolcal reduce cubes/ -o run.ecsv --quicklook look --background outside
"""


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "reduce",
        help="measure both beams in FITS cubes and write an observation table",
        description="Measure the fluxes of both beams in extracted cubes. A file that cannot be\n"
        "used is left out and listed with the reason.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "cubes", metavar="CUBES", nargs="+", help="cubes, or folders of them (*.fits)"
    )
    parser.add_argument("-o", "--output", metavar="OBS.ecsv", required=True, help="the table")
    _add_meta(parser)
    _add_photometry(parser)
    parser.add_argument("--workers", metavar="N", type=int, help="number of processes")
    parser.add_argument(
        "--resume", metavar="FILE", help="journal of what is done, to go on after a stop"
    )
    parser.add_argument("--quicklook", metavar="DIR", help="write figures to this folder")
    add_json(parser)
    add_quiet(parser, "no progress bar")
    parser.set_defaults(run=run)


def _add_meta(parser):
    """Add what says what the cubes are of, beside or in the place of their headers."""
    parser.add_argument("--instrument", metavar="NAME", default="charis", help="default: charis")
    parser.add_argument(
        "--raw", metavar="DIR", help="folder of raw frames, for keywords that the cubes lack"
    )
    parser.add_argument(
        "--source",
        metavar="KIND",
        default="internal",
        help="internal (default), polarized, unpolarized (internal source with and without its "
        "polarizer), star, 'unpolarized standard star', 'polarized standard star'",
    )
    parser.add_argument(
        "--meta",
        metavar="KEY=VALUE",
        type=_pair,
        action="append",
        default=[],
        help="more for the table's meta, such as yjh50_dichroic=in",
    )
    parser.add_argument(
        "--hwp-sequence",
        metavar="DEG,DEG,...",
        type=angles,
        help="commanded angles that replace wrong ones of the headers, in turn",
    )


def _add_photometry(parser):
    parser.add_argument(
        "--background",
        choices=("none", "outside"),
        help="internal source: subtract nothing (default) or the level outside the beams",
    )
    parser.add_argument(
        "--radius",
        metavar="PIXELS",
        type=number_or("fwhm", "growth"),
        help="stars: radius of the aperture; fwhm (default, 3 full widths), growth (99 %% of the "
        "light) or pixels",
    )
    parser.add_argument(
        "--aperture-correction",
        action="store_true",
        default=None,
        help="stars: scale the fluxes to all of the star's light, by a profile of its wings",
    )


def _pair(text):
    key, equal, value = text.partition("=")
    if not (equal and key.strip() and value.strip()):
        raise argparse.ArgumentTypeError(f"{text!r} is not KEY=VALUE")
    return key.strip(), value.strip()


def run(arguments):
    """Reduce the cubes and write the table."""
    from tqdm import tqdm

    from astropolcal import instruments
    from astropolcal.reduction import reduce_run

    check_outputs(arguments.output, arguments.json, arguments.resume)
    check_folders(arguments.quicklook)
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
            progress=lambda done, _: bar.update(done - bar.n),
            **_options(arguments),
        )
    reduction.write(arguments.output, overwrite=True)
    figures = _quicklook(reduction, arguments.quicklook)
    if arguments.json:
        summary = {"output": str(arguments.output)} | reduction.summary()
        write_json(summary | {"figures": [str(path) for path in figures]}, arguments.json)
    _report(reduction, arguments, figures)


def _options(arguments):
    star = "star" in arguments.source
    given = {
        name: value
        for name in ("background", "radius", "aperture_correction")
        if (value := getattr(arguments, name)) is not None
    }
    wrong = {"background"} & set(given) if star else set(given) - {"background"}
    if wrong:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in sorted(wrong))
        kind = "the internal source" if star else "stars"
        raise AstropolcalError(f"{names} is for {kind}, not for --source {arguments.source}")
    return given


def _quicklook(reduction, folder):
    if folder is None:
        return []
    from astropolcal.plotting.reduction import save_quicklook

    return save_quicklook(reduction, folder)


def _report(reduction, arguments, figures):
    """Say what was done on stdout, and what was left out on stderr."""
    for path, why in list(reduction.problems.items())[:_MAX_LISTED]:
        print(f"astropolcal: left out: {Path(path).name}: {'; '.join(why)}", file=sys.stderr)
    more = len(reduction.problems) - _MAX_LISTED
    if more > 0:
        print(f"astropolcal: left out: {more} more files (--json lists all)", file=sys.stderr)
    for why, paths in _by_reason(reduction.doubts).items():
        print(f"astropolcal: doubtful: {paths} files: {why}", file=sys.stderr)
    if arguments.json == "-":
        return
    summary = reduction.summary()
    print(
        f"Written: {arguments.output} ({summary['n_frames']} frames, "
        f"{summary['n_masked']} of {summary['n_cells']} cells masked)"
    )
    for reason, count in summary["flags"].items():
        print(f"  masked, {reason}: {count} cells")
    if figures:
        print(f"Figures: {arguments.quicklook} ({len(figures)} files)")


def _by_reason(doubts):
    counts = {}
    for reasons in doubts.values():
        for reason in reasons:
            counts[reason] = counts.get(reason, 0) + 1
    return counts
