# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal challenge``: the diagnosis against sealed simulated data."""

import argparse
import multiprocessing
import signal
import sys
import time
import warnings
from contextlib import contextmanager

from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, GapError
from astropolcal.scripts._common import (
    Continued,
    Output,
    add_json,
    add_quiet,
    is_quiet,
    show,
    wrapped,
    write_json,
)
from astropolcal.units import plain_number

_EPILOG = """\
examples:
  astropolcal challenge -n 20
  astropolcal challenge -n 1000 --snr 8:300 --workers 8 --checkpoint run.jsonl
  astropolcal challenge -n 50 --kinds none,absorbed --json alarms.json

A run that was interrupted goes on if it is started again with the same
checkpoint.
"""
# seconds between two lines of progress where there is no terminal for a bar
_BETWEEN = 10


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
        "--checkpoint",
        metavar="FILE",
        type=Continued,
        help="append each outcome to this file, and go on from it",
    )
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes; default: 1")
    parser.add_argument(
        "--figure", metavar="FILE", type=Output, help="draw the outcome (PNG, PDF or SVG)"
    )
    add_json(parser)
    add_quiet(parser)
    parser.set_defaults(run=run)


def _range(text):
    """Return the two numbers of ``LOW:HIGH``."""
    try:
        low, high = map(plain_number, text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form LOW:HIGH") from None
    return low, high


def run(arguments):
    """Run the challenges, print how they went and write what was asked for."""
    from astropolcal.gap.challenge import KINDS, Setup, run_challenge

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
            progress=_progress(arguments),
        )
    if arguments.json:
        write_json(result.to_dict(), arguments.json)
    if not result.answered:
        raise GapError(result.shortfall)
    if result.shortfall:
        warnings.warn(result.shortfall, AstropolcalWarning, stacklevel=2)
    if arguments.figure:
        from astropolcal.plotting._style import save

        save(result.plot(), arguments.figure)
    if not is_quiet(arguments):
        show(_report(result))


@contextmanager
def _workers(count):
    """Return a pool of processes, or nothing where one is enough."""
    if count < 1:
        raise AstropolcalError(f"--workers {count}: allowed are whole numbers from 1 up")
    if count == 1:
        yield None
        return
    from concurrent.futures import ProcessPoolExecutor

    others = multiprocessing.active_children()
    # what is forked from a process with threads may hang
    context = multiprocessing.get_context("spawn")
    # an interruption from the keyboard goes to all processes; this one ends the others
    ignored = {"initializer": signal.signal, "initargs": (signal.SIGINT, signal.SIG_IGN)}
    pool = ProcessPoolExecutor(count, mp_context=context, **ignored)
    try:
        yield pool
    except BaseException as problem:
        if isinstance(problem, KeyboardInterrupt):
            show("astropolcal: stopping ...", file=sys.stderr)
        pool.shutdown(wait=False, cancel_futures=True)
        for process in set(multiprocessing.active_children()) - set(others):
            process.terminate()
        raise
    pool.shutdown()


def _progress(arguments):
    """Return what says how far the challenges are: a bar on a terminal, else lines."""
    if is_quiet(arguments):
        return False
    return True if sys.stderr.isatty() else _Progress()


class _Progress:
    """Says now and then how many challenges are done, and after how many seconds."""

    def __init__(self):
        self.started = self.said = time.monotonic()

    def __call__(self, done, n):
        now = time.monotonic()
        if now - self.said >= _BETWEEN:
            self.said = now
            seconds = f"{now - self.started:3.0f} s"
            show(f"astropolcal: {seconds}  {done} of {n} challenges", file=sys.stderr)


def _report(result):
    """Return the rates, and the wrong answers one by one."""
    lines = [result.words()]
    if result.summary()["rates"]:
        lines.append("(in brackets: interval of each rate at 68 %; number it is from)")
    for record in result.failures:
        # only what went wrong is listed; the rates hold the rest
        truth = " + ".join(record["effects"]) or "nothing"
        said = " + ".join("/".join(group) for group in record["causes"])
        strength = f" (SNR {min(record['snr']):.0f})" if record["snr"] else ""
        answer = f"{record['verdict']} {said}".strip()
        line = f"  no. {record['index']}, {record['kind']}: {truth}{strength} -> {answer}"
        lines.append(wrapped(line, indent=6))
    return "\n".join(lines)
