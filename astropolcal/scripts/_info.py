# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal info``: what a file holds, or what this installation can do."""

from pathlib import Path

from astropolcal.scripts._common import write_json


def add_parser(commands):
    """Add the subcommand to what ``add_subparsers`` returned."""
    parser = commands.add_parser(
        "info",
        help="say what a calibration or an observation table holds",
        description="Say what a calibration file or an observation table holds; without a file, "
        "what this installation knows.",
    )
    parser.add_argument("file", nargs="?", metavar="FILE", help="ASDF calibration or ECSV table")
    parser.add_argument("--instruments", action="store_true", help="list the instruments only")
    parser.add_argument("--json", metavar="FILE", help="write it for machines (- for stdout)")
    parser.set_defaults(run=run)


def run(arguments):
    """Print what the file holds."""
    if arguments.instruments:
        from astropolcal import instruments

        print("\n".join(instruments.names()))
        return
    if arguments.file is None:
        text, content = _installation()
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

    calibration = Calibration.read(path)
    made = calibration.provenance
    lines = [
        f"{path}: calibration made {made.get('created', 'at an unknown time')} "
        f"with astropolcal {made.get('astropolcal', '?')}"
    ]
    for record in calibration.datasets:
        optics = ", ".join(f"{k}: {v}" for k, v in record.meta.items() if k not in _DULL)
        lines.append(f"  {record.name}: {optics}, sha256 {record.content_hash[:12]}")
    return "\n".join([*lines, "", calibration.summary()]), calibration.to_dict()


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
    return observations.summary(), content
