# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal calibrate``: fit an instrument's chain to observation tables."""

from pathlib import Path

from astropolcal.scripts._common import check_outputs, edit_chains, read_datasets, write_json

_EPILOG = """\
examples:
  astropolcal calibrate                          the packaged example
  astropolcal calibrate run.ecsv -o cal.asdf     one dataset, kept as a file
  astropolcal calibrate a.ecsv b.ecsv --plots p  two datasets that share optics
  astropolcal calibrate run.ecsv --fix hwp.theta=0 --fix derotator.theta=0
"""


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    import argparse

    parser = commands.add_parser(
        "calibrate",
        help="fit an instrument's chain of optics to observation tables",
        description="Fit an instrument's chain of optics to observation tables. Without files, "
        "the packaged example is calibrated.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("files", nargs="*", metavar="FILE", help="observation tables (ECSV)")
    parser.add_argument("-o", "--output", metavar="CAL.asdf", help="write the calibration here")
    parser.add_argument("--instrument", metavar="NAME", help="default: as the tables say")
    _add_model_options(parser)
    parser.add_argument("--plots", metavar="DIR", help="save the figures in this folder")
    parser.add_argument(
        "--json", metavar="FILE", help="write a summary for machines (- for stdout)"
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
    parser.set_defaults(run=run)


def _add_model_options(parser):
    """Add what says how the model is made and fitted."""
    parser.add_argument(
        "--derotator",
        metavar="MODEL",
        default="elliptical",
        help="elliptical (default) or linear retarder",
    )
    parser.add_argument(
        "--bounds",
        metavar="KIND",
        default="physical",
        help="physical (default), or those of the paper",
    )
    parser.add_argument(
        "--observable",
        metavar="NAME",
        default="normalized_double_difference",
        help="what is fitted (default: %(default)s)",
    )
    parser.add_argument(
        "--strategy",
        metavar="HOW",
        default="joint",
        help="joint (default), or two-step as in the paper",
    )
    parser.add_argument(
        "--weights",
        choices=("none", "errors"),
        default="none",
        help="equal weights (default), or one over the tables' errors",
    )
    parser.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="NAME[=VALUE]",
        help="hold a parameter, such as hwp.theta=0 or hwp.theta=0.1deg",
    )
    parser.add_argument(
        "--free",
        action="append",
        default=[],
        metavar="NAME",
        help="free a parameter, such as wollaston.theta",
    )
    parser.add_argument(
        "--prior",
        action="append",
        default=[],
        metavar="NAME=MEAN+-STD",
        help="normal prior on a parameter, such as hwp.theta=0+-0.1deg",
    )
    parser.add_argument(
        "--gauge",
        choices=("minimal", "none"),
        default="minimal",
        help="where the data leave a choice: the least misalignments (default), or where the "
        "fit ends",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="OPTIC",
        help="take an optic out of the model",
    )


def run(arguments):
    """Calibrate, print the summary and write what was asked for."""
    from astropolcal import instruments
    from astropolcal.calibration import calibrate
    from astropolcal.observations import get_observable

    say = _silent if arguments.quiet or arguments.json == "-" else print
    check_outputs(arguments.output, arguments.json)
    get_observable(arguments.observable)
    files = arguments.files or [_example(say)]
    datasets = read_datasets(files)
    instrument = instruments.get(arguments.instrument or _stated(datasets))
    chains = instrument.chains_for(datasets, derotator=arguments.derotator, bounds=arguments.bounds)
    edits = {key: getattr(arguments, key) for key in ("without", "free", "fix", "prior")}
    chains = edit_chains(chains, **edits)
    calibration = calibrate(
        chains,
        datasets,
        strategy=arguments.strategy,
        observable=arguments.observable,
        weights=None if arguments.weights == "none" else arguments.weights,
        positions=[instrument.positions(*pair) for pair in zip(datasets, chains, strict=True)],
        gauge=None if arguments.gauge == "none" else arguments.gauge,
        instrument=instrument.name,
    )
    say(calibration.summary())
    _write(calibration, arguments, say)


def _silent(*_):
    pass


def _example(say):
    """Return the path of the packaged example, and say that it is used."""
    import astropolcal

    path = Path(astropolcal.__file__).parent / "data" / "charis_example.ecsv"
    say(
        "No files given: calibrating the packaged example, a simulated CHARIS run\n"
        "(22 wavelengths, 8 derotator angles x 8 half-wave-plate angles).\n"
    )
    return path


def _stated(datasets):
    """Return the instrument that the first table names."""
    from astropolcal.exceptions import InstrumentError

    stated = datasets[0].instrument
    if stated is None:
        raise InstrumentError(
            f"{datasets[0].name}: the table names no instrument; give --instrument NAME"
        )
    return stated


def _write(calibration, arguments, say):
    written = []
    if arguments.output:
        calibration.write(arguments.output, overwrite=True)
        written.append(arguments.output)
    if arguments.plots:
        from astropolcal.plotting import save_all

        written += [str(path) for path in save_all(calibration, arguments.plots)]
    if arguments.json:
        write_json(calibration.to_dict(), arguments.json)
        if arguments.json != "-":
            written.append(arguments.json)
    if written:
        say("\nWritten: " + "\n         ".join(written))
