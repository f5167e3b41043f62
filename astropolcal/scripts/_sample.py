# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sample the posterior of a calibration's parameters.

An ensemble of walkers does so; the samples are kept with the calibration.

For example::

  astropolcal sample cal.asdf run.ecsv -o sampled.asdf --plots figures
  astropolcal sample cal.asdf a.ecsv b.ecsv --parameters hwp.w_sio2 hwp.w_mgf2
  astropolcal sample cal.asdf run.ecsv --checkpoint run.h5 --resume -o out.asdf

The files are the tables that the calibration was made from, all of them. Which
parameters vary, their bounds and their priors are those of the calibration.
"""

import sys
import warnings
from pathlib import Path

from astropolcal.exceptions import AstropolcalError, FitError
from astropolcal.files import one_line
from astropolcal.progress import in_one_thread
from astropolcal.scripts import _common as common
from astropolcal.words import counted, shortened

# what the library calls them
_OPTIONS = {"n_walkers": "--walkers", "n_steps": "--steps", "burn_in": "--burn"}
_COLUMNS = ("median", "lower", "upper", "fitted")


OPTIONS = """
calibration CAL.asdf Input  calibration file
files FILE + Input  the tables that it was made from (ECSV)
-o --output OUT.asdf Output  write the calibration with samples here; overwritten if it exists
--parameters NAME + ...  what varies, such as hwp.w_sio2; the rest is held at its fitted values
    (default: all free parameters)
--walkers N int  default: twice the parameters, at least 24
--steps N int =5000  default: %(default)s
--burn N|auto burn_in  steps to leave out at the start (default: auto, 5 autocorrelation times)
--seed N int  makes the run repeatable
--checkpoint FILE.h5 Continued  write the steps here while the run lasts
--resume needs:checkpoint  go on from the checkpoint, if there is one
@ plots full json online quiet
"""
# the samples come to what the calibration holds, and nothing of it is lost
DEFAULTS = {"may_replace": {"output": "calibration"}}


TYPES = {"burn_in": common.number_or("auto", kind=int)}


@in_one_thread
def run(arguments):
    """Sample, print what came out and write what was asked for."""
    from astropolcal.calibration import Calibration
    from astropolcal.calibration.posterior import LogPosterior
    from astropolcal.calibration.posterior.samples import need

    common.check_suffix("-o", arguments.output, ".asdf")
    _check_options(arguments)
    calibration = Calibration.read(arguments.calibration)
    # recognized by content, so that their order does not matter
    calibration = calibration.with_observations(common.read_datasets(arguments.files))
    # names of parameters that are wrong, then packages that are missing, are refused at once
    if arguments.parameters:
        LogPosterior(calibration.live_measurement(), parameters=arguments.parameters)
    need("emcee", "sampling")
    # the summary comes last, and must not fail after hours
    need("arviz_stats.base", "the summary of a posterior")
    if arguments.checkpoint:
        need("h5py", "a checkpoint")
    calibration.posterior = _sample(calibration, arguments)
    # first the files: a reader of our words may have gone in the meantime
    written = common.write_calibration(calibration, arguments, calibration.to_dict)
    common.say(arguments, *_words(calibration, arguments, written))


def _check_options(arguments):
    """Raise before the long work is done."""
    if arguments.seed is not None and arguments.seed < 0:
        raise AstropolcalError(f"--seed {arguments.seed}: allowed are whole numbers from 0 up")
    # a run of days must not be overwritten by a typo
    if arguments.checkpoint and Path(arguments.checkpoint).exists() and not arguments.resume:
        raise AstropolcalError(
            f"{arguments.checkpoint}: exists already; --resume goes on from it, or remove it"
        )


def _sample(calibration, arguments):
    from astropolcal.calibration import sample

    given = {key: getattr(arguments, key) for key in ("parameters", "seed", "checkpoint")}
    try:
        with warnings.catch_warnings():
            if not common.is_quiet(arguments):
                # the summary says the same
                warnings.filterwarnings("ignore", message="the chain (is|has)")
            return sample(
                calibration,
                n_walkers=arguments.walkers,
                n_steps=arguments.steps,
                burn_in=None if arguments.burn == "auto" else arguments.burn,
                **given,
                # as for all commands, and not at all where that is not wanted
                progress=False,
            )
    except FitError as error:
        # about the option instead of the argument
        words, option = str(error), _OPTIONS.get(error.argument)
        words = f"{option} {words.removeprefix(f'{error.argument} = ')}" if option else words
        raise FitError(words) from error
    except KeyboardInterrupt:
        if arguments.checkpoint and Path(arguments.checkpoint).exists():
            kept = f"the steps so far are in {one_line(arguments.checkpoint, None)}"
            words = f"astropolcal: {kept}; the same command with --resume goes on"
            common.show(words, file=sys.stderr)
        raise


def _words(calibration, arguments, written):
    """Return the run in words, a table of the parameters, and what the calibration is worth."""
    posterior, words = calibration.posterior, calibration.verdict().words
    complaints = posterior.convergence.complaints(posterior.names)
    if complaints:
        words[0] = shortened(f"NOT CONVERGED: {complaints[0]}")
        words[-1] = "Next        more --steps; with --checkpoint FILE.h5, --resume goes on from it"
    return common.with_ending(_table(posterior), [*words, *written], arguments.full)


def _table(posterior):
    """Return what is common to all wavelengths as a table, and the run in words."""
    parameters = posterior.report()["parameters"]
    # values of a wavelength end in [i]; hundreds of them do not fit a terminal
    alike = {name: entry for name, entry in parameters.items() if not name.endswith("]")}
    # if only such values varied, they are all there is
    shown = alike or parameters
    width = max(map(len, shown)) + 2
    lines = [" " * width + "".join(f"{text:>11}" for text in _COLUMNS)]
    for name, entry in shown.items():
        numbers = "".join(f" {entry[key]:z10.5f}" for key in _COLUMNS)
        lines.append(f"{name:<{width}}{numbers} {entry['unit']}".rstrip())
    lines.append("median, and the 68 % interval from lower to upper")
    rest = len(parameters) - len(shown)
    if rest:
        are = "is" if rest == 1 else "are"
        lines.append(
            f"{counted(rest, 'value')} given per wavelength {are} in the file and in the JSON"
        )
    lines += ["", *(common.wrapped(line, indent=2) for line in posterior.words().splitlines())]
    return lines
