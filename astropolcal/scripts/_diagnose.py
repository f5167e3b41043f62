# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal diagnose``: which effect a model lacks, and how far that explains the gap."""

from contextlib import suppress
from pathlib import Path

from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.progress import in_one_thread, stage
from astropolcal.scripts._common import (
    MODEL,
    PAGES,
    check_suffix,
    edit_chains,
    instrument_of,
    printer,
    read_datasets,
    show,
    stated_model,
    wrapped,
    write_json,
    written_lines,
)

HELP = "find what a model lacks to explain the measurements"
DESCRIPTION = """\
Find what an instrument's model lacks to explain the measurements: where
the gap lies, which effect causes it, and how far it shrinks on left-out frames."""
EXAMPLES = """\
examples:
  astropolcal diagnose polarized.ecsv unpolarized.ecsv --report gap.html
  astropolcal diagnose cal.asdf polarized.ecsv      the model of a calibration
  astropolcal diagnose run.ecsv --derotator linear  a simpler model
  astropolcal diagnose run.ecsv --effects beam_gain,hwp_tilt
  astropolcal diagnose july.ecsv october.ecsv --changes
  astropolcal diagnose run.ecsv --save better.asdf  calibrate with what is found

Several tables are used together. The effects are listed by --effects help.
"""
_HINT = "--full adds each cause with its sizes, and where the gap lies"
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
    from astropolcal.gap import diagnose
    from astropolcal.gap.report import summary, to_dict

    # needs no table
    if arguments.effects == "help":
        from astropolcal.gap import EFFECTS

        width = max(map(len, EFFECTS)) + 2
        for name, effect in EFFECTS.items():
            show(wrapped(f"{name:<{width}}{effect.title}", indent=width))
        return
    say = printer(arguments)
    check_suffix("--save", arguments.save, ".asdf")
    check_suffix("--report", arguments.report or None, *PAGES)
    options = {"effects": _effects(arguments.effects), "progress": stage}
    nominal, datasets, instrument = _nominal(arguments)
    options |= {"changes": arguments.changes, "nested": arguments.nested}
    diagnosis = diagnose(nominal, datasets, **options)
    stage("what to observe next")
    # once: page, JSON and summary say the same
    content = to_dict(diagnosis)
    # first the files: a reader of our words may have gone in the meantime
    written = _write(diagnosis, content, arguments, instrument)
    ends = _ending(content, written)
    if arguments.full:
        # its end is what stays on the screen
        say("\n".join([summary(diagnosis), "", wrapped(content["sentences"][0]), *ends]))
    else:
        from astropolcal.gap._words import short

        say("\n".join(short(content, [*ends, _HINT])))


def _ending(content, written):
    """Return what to do next, and the files that were written."""
    from astropolcal.gap._words import exposure

    following = [exposure(entry, content["causes"]) for entry in content["next_observations"][:1]]
    found = {
        "none": "calibrate with this model",
        "named": "--save FILE.asdf calibrates with what was found",
        "located": "--save FILE.asdf calibrates with what was found",
    }
    told = following or [found.get(content["verdict"], "more frames, at other angles")]
    words = wrapped(f"{'Next':<12}{told[0]}", indent=12).split("\n")
    return [*words, *written_lines(written)]


# ---- effects --------------------------------------------------------------------------------


def _effects(text):
    from astropolcal.gap import get_effect

    if text == "all":
        return "all"
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise AstropolcalError(f"--effects {text!r}: give all, or names separated by commas")
    for name in names:
        get_effect(name)
    return names


# ---- the nominal model ------------------------------------------------------------------------


def _nominal(arguments):
    """Return the nominal calibration or chains, the datasets, and the instrument's name."""
    first, *rest = arguments.files or [""]
    # by the name: a table is never called that
    known = first if Path(first).suffix == ".asdf" else None
    files = rest if known else arguments.files
    if not files:
        raise AstropolcalError("no tables to diagnose; give at least one FILE")
    datasets = read_datasets(files)
    edits = {key: getattr(arguments, key) for key in ("without", "free", "fix")}
    if known:
        return _of_calibration(known, files, datasets, edits, arguments)
    instrument = instrument_of(arguments, datasets)
    chains = instrument.chains_for(datasets, **stated_model(arguments))
    return edit_chains(chains, **edits), datasets, instrument.name


def _of_calibration(path, files, datasets, edits, arguments):
    """Return the model of a calibration for the datasets, which need not be its own."""
    from astropolcal.calibration import Calibration

    for option in ("instrument", *MODEL):
        if getattr(arguments, option):
            raise AstropolcalError(f"--{option}: the model is that of {path}; give one of them")
    calibration = Calibration.read(path)
    records = [
        _record(calibration, path, file, dataset)
        for file, dataset in zip(files, datasets, strict=True)
    ]
    # the very tables of the calibration: its fit need not be repeated
    hashes = [dataset.content_hash for dataset in datasets]
    if hashes == [r.content_hash for r in calibration.datasets] and not any(edits.values()):
        return calibration.with_observations(datasets), datasets, calibration.instrument
    chains = [calibration.chains[i].copy() for i in records]
    return edit_chains(chains, **edits), datasets, calibration.instrument


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
    """Write what was asked for; return the names of the files."""
    written = []
    if arguments.json:
        write_json(content, arguments.json)
        written += [arguments.json] if arguments.json != "-" else []
    if arguments.report:
        from astropolcal.gap.report import write_html

        stage("drawing")
        figures = {"figures": _figures(diagnosis)}
        figures["size_figures"] = _size_figures(diagnosis, content)
        write_html(diagnosis, arguments.report, **figures)
        written.append(arguments.report)
    if arguments.save:
        from astropolcal.gap._numbers import with_causes

        calibration = with_causes(diagnosis.improved, instrument=instrument)
        calibration.write(arguments.save, overwrite=True)
        written.append(arguments.save)
    return written


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
