# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal info``: what a file holds, or what this installation can do."""

from pathlib import Path

from astropolcal.exceptions import ObservationError
from astropolcal.scripts._common import (
    Input,
    add_full,
    add_json,
    add_quiet,
    printer,
    wrapped,
    write_json,
)
from astropolcal.scripts._describing import describe_fits, describe_table, is_observation
from astropolcal.words import counted


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "info",
        help="say what a calibration, a folder of them, a table, cube or product holds",
        description="Say what a calibration file, a folder of calibrations, an observation "
        "table, an image cube or a corrected product holds; of a calibration also how good it is "
        "and for what it is valid. Without a file, what this installation knows.",
    )
    parser.add_argument(
        "file",
        nargs="?",
        metavar="FILE|DIR",
        type=Input,
        help="ASDF calibration, folder of calibrations, ECSV table, or FITS cube or product",
    )
    parser.add_argument("--instruments", action="store_true", help="list the instruments only")
    add_full(parser)
    add_json(parser, "write it")
    add_quiet(parser)
    parser.set_defaults(run=run)


def run(arguments):
    """Print what the file holds."""
    if arguments.instruments:
        from astropolcal import instruments

        printer(arguments)("\n".join(instruments.names()))
        return
    if arguments.file is None:
        text, content = _installation()
    elif Path(arguments.file).is_dir():
        text, content = _library(arguments.file)
    elif Path(arguments.file).suffix.lower() == ".asdf":
        text, content = _calibration(arguments.file, arguments.full)
    elif _is_fits(arguments.file):
        text, content = _lines(*describe_fits(arguments.file))
    else:
        text, content = _table(arguments.file)
    if arguments.json:
        write_json(content, arguments.json)
    printer(arguments)(text)


def _installation():
    from astropolcal import instruments
    from astropolcal.observations import OBSERVABLES
    from astropolcal.optics import OPTICS
    from astropolcal.version import version

    content = {
        "astropolcal": version,
        "instruments": instruments.names(),
        "optics": sorted(OPTICS),
        "observables": sorted(OBSERVABLES),
    }
    lines = [f"astropolcal {version}"]
    for key in ("instruments", "optics", "observables"):
        lines.append(f"  {key + ':':<13}" + ("\n" + " " * 15).join(content[key]))
    return "\n".join(lines), content


def _calibration(path, full):
    from astropolcal.calibration import Calibration
    from astropolcal.calibration.result.validity import validity_of
    from astropolcal.calibration.result.verdict import HEIGHT, HINT, compact_lines
    from astropolcal.converters.calibration import content_hash

    calibration = Calibration.read(path)
    # when it was made and for when it holds are two things
    made, held = calibration.provenance, validity_of(calibration)
    digest = content_hash(calibration)
    lines = [
        f"{path}: calibration made {made.get('created', 'at an unknown time')} "
        f"with astropolcal {made.get('astropolcal', '?')}",
        f"  valid for {held}",
        f"  sha256 {digest}",
    ]
    content = calibration.to_dict() | {"validity": held.to_dict(), "content_hash": digest}
    if not full:
        lines = [wrapped(line, indent=4) for line in lines]
        height = HEIGHT - len("\n".join(lines).split("\n")) - 1
        told = compact_lines(calibration, calibration.verdict(), height)
        return "\n".join([*told, *lines, HINT]), content
    for record in calibration.datasets:
        optics = ", ".join(f"{k}: {v}" for k, v in record.meta.items() if k not in _DULL)
        lines.append(f"  {record.name}: {optics}, sha256 {record.content_hash[:12]}")
    lines = [wrapped(line, indent=4) for line in lines]
    return "\n".join([*lines, "", calibration.summary(full=True)]), content


def _library(folder):
    """Return what a folder of calibrations holds, one block of lines a file."""
    from astropolcal.pipeline.library import Library

    library = Library(folder)
    table = library.table()
    lines = [f"{folder}: {counted(len(library), 'calibration')}"]
    files = []
    for entry, row in zip(library.entries, table, strict=True):
        good = f"s_res {_percent(row['s_res'])}, s_cv {_percent(row['s_cv'])}"
        # loud: nobody should take it by accident
        state = "" if row["converged"] else ", NOT CONVERGED"
        lines += [
            f"{entry.name}",
            f"  valid for {entry.validity}",
            f"  from {row['datasets']}; {good} (median){state}",
            f"  content sha256 {entry.content_hash[:12]}",
        ]
        files.append(_plain(row) | {"validity": entry.validity.to_dict()})
    problems = {path.name: reason for path, reason in library.problems.items()}
    for name, reason in problems.items():
        lines += [name, f"  UNREADABLE: {reason}"]
    overlaps = library.overlaps()
    lines += [f"OVERLAP: {words}" for words in overlaps]
    if not (files or problems) and (others := _others(folder)):
        lines.append(f"  {counted(others, 'table or FITS file', 'tables and FITS files')} in it; "
                     "astropolcal info FILE tells of one")  # fmt: skip
    content = {"folder": str(folder), "calibrations": files}
    text = "\n".join(wrapped(line, indent=4) for line in lines)
    return text, content | {"unreadable": problems, "overlaps": overlaps}


def _others(folder):
    """Return the number of files that could be told of one by one."""
    return sum(path.suffix.lower() in (".ecsv", ".fits") for path in Path(folder).iterdir())


def _plain(row):
    """Return a row of the library's table as JSON knows it; what is not a number is null."""
    import math

    numbers = {f"{key}_percent": float(row[key]) for key in ("s_res", "s_cv")}
    return {
        **{key: str(row[key]) for key in ("name", "datasets", "content_hash")},
        "converged": bool(row["converged"]),
        **{key: value if math.isfinite(value) else None for key, value in numbers.items()},
    }


def _percent(value):
    # NaN is not equal to itself
    return f"{value:.3f} %" if value == value else "-"


_DULL = ("description", "comments", "reference")
_FITS_NAMES = (".fits", ".fit", ".fts", ".fits.gz", ".fits.fz")


def _is_fits(path):
    """Return whether a file is, or by its name claims to be, a FITS file."""
    if str(path).lower().endswith(_FITS_NAMES):
        return True
    try:
        with open(path, "rb") as stream:
            return stream.read(9) == b"SIMPLE  ="
    except OSError:
        # the reader of tables says what is wrong
        return False


def _lines(lines, content):
    return "\n".join(wrapped(line, indent=4) for line in lines), content


def _table(path):
    """Return what an ECSV table holds: beam fluxes, or something else."""
    from astropolcal.observations.reading import read_ecsv

    _check_ecsv(path)
    table = read_ecsv(path)
    if is_observation(table):
        return _observations(path)
    return _lines(*describe_table(path, table))


def _check_ecsv(path):
    """Refuse a file that is nothing of ours, and say what is."""
    try:
        with open(path, "rb") as stream:
            known = stream.read(7) == b"# %ECSV"
    except OSError:
        # the reader of tables says what is wrong
        return
    if not known:
        raise ObservationError(
            f"{path}: info takes a calibration (.asdf), a folder of them, an ECSV table, or a FITS "
            "cube or product; this is none of them"
        )


def _observations(path):
    import astropy.units as u

    from astropolcal.observations import Observations

    # again, with all checks; the first look was for the columns only
    observations = Observations.read(path)
    # raises where a plate angle has no partner at all
    pairs = observations.pairs()
    content = {
        "file": str(path),
        "instrument": observations.instrument,
        "source": observations.source,
        "n_frames": observations.n_frames,
        "n_wavelengths": observations.n_bins,
        "n_masked": int(observations.mask.sum()),
        "n_pairs": len(pairs),
        "wavelength_nm": [float(w) for w in observations.wavelength.to_value(u.nm)],
        "content_hash": observations.content_hash,
    }
    lines = observations.summary().splitlines()
    return "\n".join(wrapped(line, indent=2) for line in lines), content
