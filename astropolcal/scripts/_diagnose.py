# Licensed under a 3-clause BSD style license - see LICENSE
"""
Find what a model lacks to explain the measurements.

That is where the gap lies, which effect causes it, and how far it shrinks on
left-out frames.

For example::

  astropolcal diagnose polarized.ecsv unpolarized.ecsv --report gap.html
  astropolcal diagnose cal.asdf polarized.ecsv      the model of a calibration
  astropolcal diagnose run.ecsv --derotator linear  a simpler model
  astropolcal diagnose run.ecsv --effects beam_gain,hwp_tilt
  astropolcal diagnose july.ecsv october.ecsv --changes
  astropolcal diagnose run.ecsv --save better.asdf  calibrate with what is found

Several tables are used together. The effects are listed by --effects help.
"""

from contextlib import suppress
from pathlib import Path

from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.progress import in_one_thread, stage
from astropolcal.scripts import _common as common

_CORRECT = "correct the table, and calibrate with that"
_HINT = "--full adds each cause with its sizes, and where the gap lies"
# parameters that differ by fewer standard errors did not move
_MOVED = 5.0
# what the figure with both channels of the data shows
_SPECTRUM = (
    "Gap of the fit at each wavelength before and after, with the noise. The verdict and the "
    "shares are of the differences and the sums of the beams together, of the sums less the "
    "drift and flicker of the lamp; the gap in percent is of the differences alone"
)
_FRAMES = (
    "Residuals of the single differences frame by frame, before and after, in that third of the "
    "wavelengths in which the causes do most, with what they do"
)


# the options of a model not with a calibration, which has one
OPTIONS = """
files FILE * Input  observation tables (ECSV); before them may stand a calibration (.asdf), whose
    model is then the nominal one
--instrument NAME  default: as the tables say
@ derotator bounds m3 plate without free fix
--effects all|NAME,NAME =all  which effects to try (default: all; help lists them)
--changes  ask what changed between several runs of the same kind of source
--nested  choose the causes again without each group of frames, and predict these: slow, and the one
    measure in which the choice has no part
--report FILE.html Output  write a page with tables and figures
--save CAL.asdf Output  calibrate with the effects that were found, and write the calibration
@ full json online quiet
"""


@in_one_thread
def run(arguments):
    """Diagnose, print what came out and write what was asked for."""
    from astropolcal.gap import EFFECTS, diagnose, get_effect
    from astropolcal.gap._words import exposure, short
    from astropolcal.gap.report import summary, to_dict

    # needs no table
    if arguments.effects == "help":
        width = max(map(len, EFFECTS)) + 2
        for name, effect in EFFECTS.items():
            common.show(common.wrapped(f"{name:<{width}}{effect.title}", indent=width))
        return
    common.check_suffix("--save", arguments.save, ".asdf")
    common.check_suffix("--report", arguments.report or None, *common.PAGES)
    effects = arguments.effects
    if effects != "all":
        effects = [name.strip() for name in effects.split(",") if name.strip()]
        if not effects:
            raise AstropolcalError(
                f"--effects {arguments.effects!r}: give all, or names separated by commas"
            )
        for name in effects:
            get_effect(name)
    options = {"effects": effects, "changes": arguments.changes, "nested": arguments.nested}
    nominal, datasets, instrument, earlier = _nominal(arguments)
    diagnosis = diagnose(nominal, datasets, **options, progress=stage)
    stage("what to observe next")
    # once: page, JSON and summary say the same
    content = to_dict(diagnosis)
    # first the files: a reader of our words may have gone in the meantime
    _write(diagnosis, content, arguments, instrument)
    following = [exposure(entry, content["causes"]) for entry in content["next_observations"][:1]]
    unusable = content["accuracy_after"]["unusable"]
    keep = "--save FILE.asdf calibrates with what was found"
    keep = f"correct measurements with {arguments.save}" if arguments.save else keep
    fine = "astropolcal calibrate, which says more" if unusable else "calibrate with this model"
    found = {"none": fine, "named": keep, "located": keep}
    told = following or [found.get(content["verdict"], "more frames, at other angles")]
    told = [_CORRECT] if content["misread"] and content["causes"][0]["probability"] >= 0.5 else told
    saved = not content["misread"] and arguments.save
    fitted = diagnosis.nominal.calibration
    # a fit that lacks something shows a change of the parameters that need be none
    is_known = None not in (earlier, fitted) and content["verdict"] == "none"
    since = _since(earlier, fitted.calibration()) if is_known else []
    ends = [*since, f"{'Next':<12}{told[0]}"]
    ends = [line for end in ends for line in common.wrapped(end, indent=12).split("\n")]
    ends += common.written_lines([arguments.json, arguments.report, saved])
    if arguments.full:
        # its end is what stays on the screen
        lines = [summary(diagnosis), "", common.wrapped(content["sentences"][0]), *ends]
    else:
        lines = short(content, [*ends, _HINT])
    common.say(arguments, *lines)
    if arguments.save and not saved:
        raise AstropolcalError(
            f"--save {arguments.save}: not written, as a calibration that misreads a table "
            f"would misread those of science frames, too; {_CORRECT}"
        )


# ---- the nominal model ------------------------------------------------------------------------


def _nominal(arguments):
    """Return the nominal calibration or chains, the datasets, and the instrument's name."""
    first, *rest = arguments.files or [""]
    # by the name: a table is never called that
    known = first if Path(first).suffix == ".asdf" else None
    files = rest if known else arguments.files
    if not files:
        raise AstropolcalError("no tables to diagnose; give at least one FILE")
    datasets = common.read_datasets(files)
    edits = {key: getattr(arguments, key) for key in ("without", "free", "fix")}
    if known:
        return _of_calibration(known, files, datasets, edits, arguments)
    instrument = common.instrument_of(arguments, datasets)
    chains = instrument.chains_for(datasets, **common.stated_model(arguments))
    return common.edit_chains(chains, **edits), datasets, instrument.name, None


def _of_calibration(path, files, datasets, edits, arguments):
    """Return the model of a calibration for the datasets, which need not be its own."""
    from astropolcal.calibration import Calibration
    from astropolcal.gap.diagnosis import check_instruments
    from astropolcal.observations.reading import bins_on_grid

    for option in ("instrument", *common.MODEL):
        if getattr(arguments, option):
            raise AstropolcalError(f"--{option}: the model is that of {path}; give one of them")
    calibration = Calibration.read(path)
    check_instruments(calibration, datasets)
    # refused here, with the name of the table
    for dataset in datasets:
        bins_on_grid(dataset, calibration.wavelength.to_value("um"))
    records = [_record(calibration, path, *pair) for pair in zip(files, datasets, strict=True)]
    # the very tables of the calibration: its fit need not be repeated
    hashes = [dataset.content_hash for dataset in datasets]
    if hashes == [r.content_hash for r in calibration.datasets] and not any(edits.values()):
        return calibration.with_observations(datasets), datasets, calibration.instrument, None
    chains = [calibration.chains[i].copy() for i in records]
    return common.edit_chains(chains, **edits), datasets, calibration.instrument, calibration


def _since(earlier, fitted):
    """Return lines on how far parameters that are free moved from those of a calibration."""
    from astropolcal.pipeline.history import moved
    from astropolcal.words import listed

    optics = moved(earlier, fitted)
    if not optics:
        return []
    together = optics.pop("") > _MOVED
    most = sorted((name for name in optics if optics[name] > _MOVED), key=lambda n: -optics[n])
    words = "the parameters were fitted to these data again, and "
    if most:
        words += listed([f"those of {name} moved by {optics[name]:.0f}" for name in most], most=3)
    else:
        words += f"moved {'together by more' if together else 'by less'} than {_MOVED:.0f}"
    words += " standard errors"
    if most or together:
        words += "; that leaves no gap: --fix holds them where they were"
    return [f"{'Since then':<12}{words}"]


def _record(calibration, path, file, dataset):
    """Return which dataset of a calibration has the chain for a table."""
    known = calibration.datasets
    # its own chain if the table was calibrated, else one of the same kind of source
    same = [i for i, r in enumerate(known) if r.content_hash == dataset.content_hash]
    alike = [i for i, r in enumerate(known) if r.source == dataset.source]
    if same or alike:
        return (same or alike)[0]
    raise AstropolcalError(
        f"{file}: its source is {dataset.source!r}, and {path} has a model for "
        f"{', '.join(sorted({repr(r.source) for r in known}))} only"
    )


# ---- outputs --------------------------------------------------------------------------------


def _write(diagnosis, content, arguments, instrument):
    """Write what was asked for."""
    from astropolcal.gap.report import Fitted, with_causes, write_html

    if arguments.json:
        common.write_json(content, arguments.json)
    if arguments.report:
        stage("drawing")
        figures = {"figures": _figures(diagnosis)}
        figures["size_figures"] = _size_figures(diagnosis, content)
        write_html(diagnosis, arguments.report, **figures)
    if arguments.save and not content["misread"]:
        calibration = with_causes(Fitted(diagnosis.improved), instrument=instrument)
        calibration.write(arguments.save, overwrite=True)


def _figures(diagnosis):
    """Return the figures of the page by caption."""
    from astropolcal.gap.report import MAP
    from astropolcal.plotting import gap

    return ({MAP: gap.plot_cause_map(diagnosis)} if diagnosis.causes else {}) | {
        _FRAMES: gap.plot_gap_frames(diagnosis),
        _SPECTRUM: gap.plot_gap_spectrum(diagnosis),
        "Residuals of the differences, by wavelength and frame": gap.plot_gap_maps(diagnosis),
    }


def _size_figures(diagnosis, content):
    """Return a figure for every cause whose size the data tell and that varies."""
    from astropolcal.gap._words import has_sizes
    from astropolcal.plotting.gap import plot_effect_sizes

    found = {}
    for entry in content["causes"]:
        if any(has_sizes(entry)):
            # the size of some depends on nothing
            with suppress(ParameterError):
                found[entry["name"]] = plot_effect_sizes(diagnosis, entry["name"])
    return found
