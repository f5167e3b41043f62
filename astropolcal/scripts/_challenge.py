# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal challenge``: the diagnosis against sealed simulated data."""

import argparse
from contextlib import nullcontext

from astropolcal.exceptions import AstropolcalError
from astropolcal.scripts._common import (
    add_json,
    add_quiet,
    check_outputs,
    is_quiet,
    wrapped,
    write_json,
)

_EPILOG = """\
examples:
  astropolcal challenge -n 20
  astropolcal challenge -n 1000 --snr 8:300 --workers 8 --checkpoint run.jsonl
  astropolcal challenge -n 50 --kinds none,absorbed --json alarms.json

A run that was interrupted goes on if it is started again with the same
checkpoint.
"""


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "challenge",
        help="test the diagnosis on sealed simulated data",
        description="Simulate calibrations with random effects, diagnose each without the key,\n"
        "and compare the answers with the truth.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "-n", type=int, default=20, metavar="N", help="how many (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="default: %(default)s")
    parser.add_argument(
        "--snr",
        type=_range,
        default=(8.0, 300.0),
        metavar="LOW:HIGH",
        help="signal-to-noise ratio of each effect (default: 8:300)",
    )
    parser.add_argument(
        "--kinds",
        type=lambda text: text.split(","),
        metavar="KIND,KIND,...",
        help="single, none, pair, absorbed, unlisted, withheld (default: all)",
    )
    parser.add_argument("--wavelengths", type=int, default=8, metavar="N", help="default: 8")
    parser.add_argument("--derotator-angles", type=int, default=8, metavar="N", help="default: 8")
    parser.add_argument(
        "--checkpoint", metavar="FILE", help="append each outcome to this file, and go on from it"
    )
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes; default: 1")
    parser.add_argument("--figure", metavar="FILE", help="draw the outcome (PNG, PDF or SVG)")
    add_json(parser)
    add_quiet(parser)
    parser.set_defaults(run=run)


def _range(text):
    """Return the two numbers of ``LOW:HIGH``."""
    try:
        low, high = map(float, text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form LOW:HIGH") from None
    return low, high


def run(arguments):
    """Run the challenges, print how they went and write what was asked for."""
    from astropolcal.gap.challenge import KINDS, Setup, run_challenge

    check_outputs(arguments.json, arguments.figure, arguments.checkpoint)
    # processes are started once for all challenges
    with _workers(arguments.workers) as client:
        result = run_challenge(
            arguments.n,
            arguments.seed,
            snr=arguments.snr,
            kinds=arguments.kinds or tuple(KINDS),
            setup=Setup(
                n_wavelengths=arguments.wavelengths, n_derotator=arguments.derotator_angles
            ),
            client=client,
            checkpoint=arguments.checkpoint,
            progress=not arguments.quiet,
        )
    if arguments.json:
        write_json(result.to_dict(), arguments.json)
    if arguments.figure:
        from astropolcal.plotting._style import save

        save(result.plot(), arguments.figure)
    if not is_quiet(arguments):
        print(_report(result))


def _workers(count):
    """Return a pool of processes, or nothing where one is enough."""
    if count < 1:
        raise AstropolcalError(f"--workers {count}: allowed are whole numbers from 1 up")
    if count == 1:
        return nullcontext()
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    # what is forked from a process with threads may hang
    return ProcessPoolExecutor(count, mp_context=get_context("spawn"))


def _report(result):
    """Return the rates, and the wrong answers one by one."""
    lines = [result.words(), "(in brackets: interval of each rate at 68 %; number it is from)"]
    for record in result.failures:
        # only what went wrong is listed; the rates hold the rest
        truth = " + ".join(record["effects"]) or "nothing"
        said = " + ".join("/".join(group) for group in record["causes"])
        strength = f" (SNR {min(record['snr']):.0f})" if record["snr"] else ""
        answer = f"{record['verdict']} {said}".strip()
        line = f"  no. {record['index']}, {record['kind']}: {truth}{strength} -> {answer}"
        lines.append(wrapped(line, indent=6))
    return "\n".join(lines)
