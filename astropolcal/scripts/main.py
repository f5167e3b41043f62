# Licensed under a 3-clause BSD style license - see LICENSE
"""
Calibrate polarimeters, and say how well their model fits.

Exit status: 0; 1 if sequences of an archive failed; 2 with one clear line on
bad input.

For example::

  astropolcal calibrate                          the packaged example
  astropolcal calibrate run.ecsv -o cal.asdf     fit a model to a table
  astropolcal diagnose cal.asdf run.ecsv         find what the model lacks
  astropolcal correct cubes/ --calibration cal.asdf -o stokes.fits
  astropolcal info cal.asdf                      what a file holds
  astropolcal calibrate --help                   the options of a command
"""

import argparse
import gc
import os
import re
import sys
import threading
import warnings
from _thread import interrupt_main
from contextlib import nullcontext
from functools import partial
from importlib import import_module
from itertools import takewhile

from astropolcal.version import version
from astropolcal.words import did_you_mean

__all__ = ["main"]

# in the order in which a night is worked through, as the help lists them
_COMMANDS = (
    *("reduce", "calibrate", "sample", "diagnose", "correct", "efficiency", "standards"),
    *("simulate", "challenge", "health", "info"),
)


class _OneLineParser(argparse.ArgumentParser):
    """
    A parser whose complaint is one line, like every other error here.

    What starts with a minus sign and a digit is a value, such as ``-155,19,4200``: no option does.
    """

    def __init__(self, *arguments, **settings):
        from astropolcal.units import plain_number

        super().__init__(*arguments, **settings)
        # argparse itself knows single numbers only, and takes a list for an unknown option
        self._negative_number_matcher = re.compile(r"-\.?\d")
        for kind in (float, int):
            self.register("type", kind, partial(plain_number, kind=kind))

    def parse_known_args(self, args=None, namespace=None):
        from astropolcal.scripts._common import check_together

        # an unknown option first: what follows it would be taken for something else
        given = [text.partition("=")[0] for text in takewhile("--".__ne__, args or ())]
        known, unknown = self._option_string_actions, []
        if self._subparsers is None:
            given = (name for name in given if name.startswith("--"))
            unknown = [name for name in given if not any(one.startswith(name) for one in known)]
        if not unknown:
            namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            # here, where the command is known: argparse complains in the name of the whole program
            name = unknown[0].partition("=")[0]
            # two dashes alone make short names alike
            hint = did_you_mean(name, known, cutoff=0.75)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        check_together(self._actions, namespace)
        return namespace, unknown

    def error(self, message):
        wrong = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if wrong:
            message += did_you_mean(wrong[1], re.findall(r"[\w-]+", wrong[2]))
        # argparse prints the usage in several lines before its complaint
        self.exit(2, f"astropolcal: error: {_one_line(message)} (see {self.prog} --help)\n")


class _PrintCompletion(argparse.Action):
    """Print what a shell runs to complete our commands, options and files."""

    def __call__(self, parser, namespace, shell, option_string=None):
        try:
            import shtab
        except ImportError:
            parser.error(f'{option_string} needs shtab: pip install "astropolcal[completion]"')
        from astropolcal.scripts._common import Folder, Input, Output

        (group,) = parser._subparsers._group_actions
        for choice in group._choices_actions:
            # zsh shows the first line of the description
            group.choices[choice.dest].description = choice.help
        for action in (action for each in group.choices.values() for action in each._actions):
            if isinstance(action.type, type) and issubclass(action.type, (Input, Output)):
                folder = issubclass(action.type, Folder)
                action.complete = shtab.DIRECTORY if folder else shtab.FILE
        print(shtab.complete(parser, shell))
        parser.exit()


def build_parser():
    """Return the parser of the command and its subcommands."""
    from astropolcal.scripts._common import add_command, texts_of

    texts = {key: words for key, words in texts_of(__doc__).items() if key != "help"}
    parser = _OneLineParser(prog="astropolcal", **texts)
    parser.add_argument("--version", action="version", version=f"astropolcal {version}")
    words = "print what completes commands, options and files in a shell (needs shtab)"
    shells = {"choices": ("bash", "zsh", "tcsh"), "help": words}
    parser.add_argument("--print-completion", action=_PrintCompletion, **shells)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in _COMMANDS:
        add_command(commands, name, import_module(f"astropolcal.scripts._{name}"))
    return parser


def main(argv=None):
    """
    Run the command.

    Parameters
    ----------
    argv : list of str, optional
        Arguments, by default those of the process.

    Returns
    -------
    int
        Exit status: 0, 1 if sequences of an archive failed, or 2 on bad input.

    Examples
    --------
    >>> from astropolcal.scripts.main import main
    >>> main(["info", "--instruments"])
    charis
    fastpdi
    fors2
    gpi
    hiciao
    ircs
    irdis
    magaox
    naco
    nirc2
    reach
    roman
    vampires
    0
    """
    shown, sys.unraisablehook = sys.unraisablehook, _insist
    try:
        status = _run(argv)
        # what is left in the buffer: at exit it would be too late to say why it is lost
        sys.stdout.flush()
        return status
    except KeyboardInterrupt:
        print("astropolcal: interrupted", file=sys.stderr)
        # 128 + SIGINT, as shells have it
        return 130
    except BrokenPipeError:
        # whoever read our output has gone
        status = 0
    except OSError as error:
        # all files of ours give errors of ours: this is the standard output, such as a full disk
        where = error.filename or "the standard output"
        words = _one_line(f"{where}: cannot be written: {error.strerror or error}")
        print(f"astropolcal: error: {words}", file=sys.stderr)
        status = 2
    finally:
        sys.unraisablehook = shown
    # do not complain again at exit
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return status


def _insist(lost):
    """Interrupt again: what Python calls by itself, as while it imports, drops an interruption."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        # once that is over
        threading.Timer(0.1, interrupt_main).start()
    else:
        sys.__unraisablehook__(lost)


def _run(argv):
    """Run the command; return its status unless it is stopped from outside."""
    # libraries define so many objects that a search among them for garbage takes its time
    gc.set_threshold(50_000)
    # here, not above: it loads astropy, and an interruption meanwhile is one of the command
    from astropolcal.exceptions import AstropolcalError
    from astropolcal.progress import shown
    from astropolcal.scripts._common import check_paths

    with warnings.catch_warnings():
        # a user has no use for file and line of our code
        warnings.showwarning = partial(_show_warning, set())
        # leap seconds to come: what matters of them is said once, where angles are computed
        warnings.filterwarnings("ignore", message="ERFA function")
        try:
            arguments = build_parser().parse_args(argv)
            check_paths(arguments)
            with earth(arguments), shown(not getattr(arguments, "quiet", False)):
                return arguments.run(arguments) or 0
        except AstropolcalError as error:
            words = _one_line(error)
        except MemoryError as error:
            words = f"not enough memory: {_one_line(error) or 'give it less to do at a time'}"
        print(f"astropolcal: error: {words}", file=sys.stderr)
        return 2


def earth(arguments):
    """Return in what to run a command that may ask for new tables of the Earth's rotation."""
    if not getattr(arguments, "online", False):
        return nullcontext()
    from astropolcal.observations.pointings import online

    return online()


def _one_line(message):
    from astropolcal.files import one_line

    return one_line(str(message), None)


def _show_warning(said, message, *_, **__):
    from astropolcal.progress import clear

    words = _one_line(message)
    # several steps of a command read the same table
    if words not in said:
        said.add(words)
        clear()
        print(f"astropolcal: warning: {words}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
