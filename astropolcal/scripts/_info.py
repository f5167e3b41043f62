# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal info``: what a file holds, or what this installation can do."""

from pathlib import Path

from astropolcal.scripts._common import add_json, wrapped, write_json


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "info",
        help="say what a calibration, a folder of them or an observation table holds",
        description="Say what a calibration file, a folder of calibrations or an observation "
        "table holds, how good it is and for what it is valid; without a file, what this "
        "installation knows.",
    )
    parser.add_argument(
        "file",
        nargs="?",
        metavar="FILE|DIR",
        help="ASDF calibration, folder of calibrations, or ECSV table",
    )
    parser.add_argument("--instruments", action="store_true", help="list the instruments only")
    add_json(parser, "write it")
    parser.set_defaults(run=run)


def run(arguments):
    """Print what the file holds."""
    if arguments.instruments:
        from astropolcal import instruments

        print("\n".join(instruments.names()))
        return
    if arguments.file is None:
        text, content = _installation()
    elif Path(arguments.file).is_dir():
        text, content = _library(arguments.file)
    elif Path(arguments.file).suffix.lower() == ".asdf":
        text, content = _calibration(arguments.file)
    else:
        text, content = _observations(arguments.file)
    if arguments.json:
        write_json(content, arguments.json)
    if arguments.json != "-":
        print(text)


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


def _calibration(path):
    from astropolcal.calibration import Calibration
    from astropolcal.calibration.validity import content_hash, validity_of

    calibration = Calibration.read(path)
    made, held = calibration.provenance, validity_of(calibration)
    digest = content_hash(calibration)
    lines = [
        f"{path}: calibration made {made.get('created', 'at an unknown time')} "
        f"with astropolcal {made.get('astropolcal', '?')}",
        f"  valid for {held}",
        f"  sha256 {digest}",
    ]
    for record in calibration.datasets:
        optics = ", ".join(f"{k}: {v}" for k, v in record.meta.items() if k not in _DULL)
        lines.append(f"  {record.name}: {optics}, sha256 {record.content_hash[:12]}")
    content = calibration.to_dict() | {"validity": held.to_dict(), "content_hash": digest}
    lines = [wrapped(line, indent=4) for line in lines]
    return "\n".join([*lines, "", calibration.summary()]), content


def _library(folder):
    """Return what a folder of calibrations holds, one block of lines a file."""
    from astropolcal.calibration.library import Library

    library = Library(folder)
    table = library.table()
    lines = [f"{folder}: {len(library)} calibration{'s' * (len(library) != 1)}"]
    files = []
    for entry, row in zip(library.entries, table, strict=True):
        good = f"s_res {_percent(row['s_res'])}, s_cv {_percent(row['s_cv'])}"
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
    content = {"folder": str(folder), "calibrations": files}
    text = "\n".join(wrapped(line, indent=4) for line in lines)
    return text, content | {"unreadable": problems, "overlaps": overlaps}


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
    return f"{value:.3f} %" if value == value else "-"


_DULL = ("description", "comments", "reference")


def _observations(path):
    import astropy.units as u

    from astropolcal.observations import Observations

    observations = Observations.read(path)
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
