# Licensed under a 3-clause BSD style license - see LICENSE
"""
Fit an instrument's chain of optics to observation tables.

Without files, the packaged example is calibrated.

For example::

  astropolcal calibrate                          the packaged example
  astropolcal calibrate run.ecsv -o cal.asdf     one dataset, kept as a file
  astropolcal calibrate a.ecsv b.ecsv --plots p  two datasets that share optics
  astropolcal calibrate run.ecsv --fix hwp.theta=0 --fix derotator.theta=0
  astropolcal calibrate t1.ecsv t2.ecsv --own hwp.theta
  astropolcal calibrate run.ecsv --standard other.ecsv --groups cycle
  astropolcal calibrate run.ecsv --target 5,30   for 5 % at 30 deg
  astropolcal calibrate polarized.ecsv star.ecsv --strategy sequential
"""

import sys
from functools import partial
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal import standards
from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.observations.grid import is_star
from astropolcal.observations.observables import get_observable
from astropolcal.progress import in_one_thread
from astropolcal.scripts import _common as common

OPTIONS = """
files FILE * Input  observation tables (ECSV)
-o --output CAL.asdf Output  write the calibration here; overwritten if it exists
--instrument NAME  default: as the tables say
@ derotator bounds m3 plate
--exact not:start  take the polarization of standard stars and the orientation of fixed optics as
    exact, as published calibrations do; by default they have the errors of the catalogue and of the
    mounting
--nuisance KIND[:DATASET] ...  add what differs from dataset to dataset, with a prior: background,
    beam_gain, or lamp (q and u of an unpolarized internal source); for all datasets or for one
--observable NAME  what is fitted (default: normalized_double_difference; single differences of
    tables without half-wave plate, and the intensity of single beams)
--strategy HOW =joint not:start  joint (default), two-step (the paper's fit of a polarized source),
    or sequential: polarized source, unpolarized source, stars, each step holding what came before
--loss NAME =linear  linear (default: least squares), huber, cauchy or bisquare: data far off count
    less
--keep-all  mask nothing by itself: neither an unstable lamp, nor saturated frames, nor incomplete
    half-wave-plate cycles
--weights {none,wavelength,errors} =none  equal weights (default), one over the residuals' scatter
    at each wavelength, or one over the tables' errors
--errors {scatter,white} =scatter  errors from how the residuals scatter and are correlated
    (default), or those of independent data with the noise of --weights
@ fix free
--own NAME[=GROUP,...] ... not:start  a parameter with a value of its own in each table, or in each
    group of tables, such as hwp.theta=july,july,october; all others are shared
--start OLD.asdf Input  start from this calibration, hold it, and refit only what --free names
--prior NAME=MEAN+-STD ... not:start  normal prior on a parameter, such as hwp.theta=0+-0.1deg
--gauge {minimal,none} =minimal  where the data leave a choice: the least misalignments (default),
    or where the fit ends
@ without
--standard FILE Input ...  table that is predicted, not fitted; its errors are s_standard. A
    standard star is compared with the catalogue, too
--groups {derotator,cycle,dataset}  what cross-validation leaves out: derotator angles (default,
    where there are three), cycles of the half-wave plate, or whole datasets
--target DOLP[,AOLP] ...  target whose accuracy is given, in percent and degree (default: 30, 1 and
    0.1, at any angle)
@ plots full json online quiet
"""


@in_one_thread
def run(arguments):
    """Calibrate, print the summary and write what was asked for."""
    from astropolcal.calibration.result.summary import to_dict
    from astropolcal.calibration.validation.cross_validation import add_standard
    from astropolcal.calibration.validation.stars import add_star_check
    from astropolcal.calibration.validation.targets import TARGETS

    common.check_suffix("-o", arguments.output, ".asdf")
    # raises before any table is read
    if arguments.start and not arguments.free:
        raise AstropolcalError("--start holds everything: say with --free NAME what may change")
    if arguments.observable is not None:
        get_observable(arguments.observable)
    targets = [_target(text) for text in arguments.target] or TARGETS
    files = arguments.files
    if not files:
        # so that a first call without any data shows what comes out
        files = [Path(__file__).parents[1] / "data" / "charis_example.ecsv"]
        common.say(arguments, "No files given: this is the packaged example, a simulated run\n")
    datasets = common.read_datasets(files)
    standards = common.read_datasets(arguments.standard)
    for path, standard in zip(arguments.standard, standards, strict=True):
        for file, dataset in zip(files, datasets, strict=True):
            # a prediction of what was fitted proves nothing
            if standard.content_hash == dataset.content_hash:
                raise AstropolcalError(
                    f"--standard {path} is not an independent standard: it is fitted as {file}"
                )
    instrument, options = common.instrument_of(arguments, datasets), common.stated_model(arguments)
    # standards follow the datasets in the lists, and are not fitted
    n, tables = len(datasets), [*datasets, *standards]
    # the instrument knows which of its frames cannot be trusted
    if not arguments.keep_all:
        tables = [instrument.prepare(table) for table in tables]
    exact = {"nuisance": arguments.nuisance, "exact": arguments.exact}
    chains = instrument.chains_for(tables[:n], **exact, **options)
    # each on its own wavelengths
    chains += [instrument.chains_for([table], **options)[0] for table in tables[n:]]
    edits = {key: getattr(arguments, key) for key in ("without", "free", "fix", "prior")}
    if arguments.start:
        edits["free"] = []
    chains = common.edit_chains(chains, **edits)
    positions = [instrument.positions(*pair) for pair in zip(tables, chains, strict=True)]
    calibration = _fitted(arguments, chains[:n], tables[:n], positions[:n], instrument)
    if arguments.groups:
        # the fit leaves cross-validation to this line where groups are named
        calibration.cross_validate(arguments.groups)
        calibration.fit["groups"] = arguments.groups
    for item in list(zip(chains, tables, positions, strict=True))[n:]:
        add_standard(calibration, *item)
        # then its true polarization is a better judge than its scatter
        if _is_known(item[1]):
            add_star_check(calibration, *item)
    # written first: whoever reads the summary may go away
    content = partial(to_dict, calibration, targets)
    written = common.write_calibration(calibration, arguments, content)
    _tell(arguments, calibration, targets, written)


def _tell(arguments, calibration, targets, written):
    """Print the summary and what was written; of an unusable result something even if quiet."""
    from astropolcal.calibration.result.summary import summary
    from astropolcal.calibration.result.verdict import HEIGHT, HINT, compact_lines, verdict

    found = verdict(calibration, targets)
    if common.is_quiet(arguments):
        if not found.usable:
            words = f"NOT USABLE AS IT IS: {'; '.join(found.reasons)}"
            common.show(f"astropolcal: warning: {words}", file=sys.stderr)
        return
    if arguments.full:
        # its end is what stays on the screen
        lines = [summary(calibration, targets, full=True), "", *found.words]
    else:
        written = [*written, HINT]
        before = 0 if arguments.files else 2
        lines = compact_lines(calibration, found, HEIGHT - before - len(written))
    common.show("\n".join([*lines, *written]))


def _is_known(observations):
    """Return whether a table is of a star whose polarization the catalogue knows."""
    if not is_star(observations.source):
        return False
    try:
        standards.get(str(observations.meta.get("object"))).stokes(observations.wavelength)
    except AstropolcalError:
        return False
    return True


def _fitted(arguments, chains, datasets, positions, instrument):
    """Return the fit of all that is free, or of what changed since another calibration."""
    from astropolcal.calibration import Calibration, calibrate
    from astropolcal.measurement import parameter_table
    from astropolcal.pipeline import restart

    options = {key: getattr(arguments, key) for key in ("weights", "loss", "errors", "gauge")}
    options |= {key: None for key in ("weights", "gauge") if options[key] == "none"}
    options |= {"positions": positions, "cross_validate": arguments.groups is None}
    if arguments.start:
        old = Calibration.read(arguments.start)
        return restart(old, datasets, arguments.free, chain=chains, **options)
    options |= {"strategy": arguments.strategy, "observable": arguments.observable}
    # what was fixed by name, as the gauge is to name it; a --prior frees one parameter of an optic
    # that --fix holds
    held, loose = ({t.partition("=")[0] for t in a} for a in (arguments.fix, arguments.prior))
    known = {name: {name, name.partition(".")[0]} for name in parameter_table(chains)}
    found = [name for name, names in known.items() if names & held and not names & loose]
    options |= {"fix": dict.fromkeys(found) or None, "instrument": instrument.name}
    return calibrate(chains, datasets, own=_own(arguments.own), **options)


def _own(texts):
    """Return the parameters of ``--own``, with the groups of the tables where these are named."""
    pairs = [text.partition("=")[::2] for text in texts]
    if len(pairs) > 1 and len({bool(groups) for _, groups in pairs}) > 1:
        raise ParameterError("--own: name the groups of all parameters, or of none")
    if pairs and pairs[0][1]:
        found = {name: [group.strip() for group in groups.split(",")] for name, groups in pairs}
        if empty := [name for name, groups in found.items() if not all(groups)]:
            raise ParameterError(f"--own {empty[0]}=...: each group needs a name")
        return found
    return [name for name, _ in pairs]


def _target(text):
    """Return degree and angle of polarization of DOLP[,AOLP]."""
    dolp, comma, aolp = text.partition(",")
    degree = _quantity(text, dolp, u.percent, 0, 100)
    return degree, _quantity(text, aolp, u.deg, -180, 180) if comma else None


def _quantity(text, part, unit, low, high):
    """Return a number with or without unit, in this one."""
    try:
        # a plain number is in the unit of the option
        value = common.number_in(part, unit)
    except (TypeError, ValueError):
        value = np.nan
    if not low <= value <= high:
        raise ParameterError(
            f"--target {text}: {part!r} is not allowed; it is {low} to {high} {unit}, "
            "such as 1 or 30,45 or 5%,-20deg"
        )
    return value * unit
