# Licensed under a 3-clause BSD style license - see LICENSE
"""
Say what a calibration, a folder of them, a table, cube or product holds.

Of a calibration also how good it is and for what it is valid. Without a file,
what this installation knows.

For example::

  astropolcal info                     version, instruments and optics
  astropolcal info cal.asdf --full     all of a calibration's summary
  astropolcal info library/            the calibrations of a folder
  astropolcal info library/ --frame frame.fits
                                       which of them holds for a frame, and why
  astropolcal info run.ecsv            frames, wavelengths and angles of a table
"""

import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits

from astropolcal import instruments
from astropolcal.exceptions import AstropolcalError, InstrumentError, ObservationError
from astropolcal.files import one_line, plain
from astropolcal.observations import OBSERVABLES, Observations
from astropolcal.observations.observables import default_observable
from astropolcal.observations.reading import read_ecsv
from astropolcal.optics import OPTICS
from astropolcal.pipeline.headers import recognized
from astropolcal.scripts import _common as common
from astropolcal.version import version
from astropolcal.words import counted

OPTIONS = """
file FILE|DIR ? Input  ASDF calibration, folder of calibrations, ECSV table, or FITS cube or product
--instruments not:file  list the instruments only
--frame FILE Input  of a folder: which calibration holds for this frame, and why none of the others
--context NAME  of a folder: the files of this context only
@ full json quiet
"""
# columns by which a table is known, the more special first
_TABLES = (
    ({"wavelength", "I", "q", "u", "determined"}, "spectrum of a corrected target"),
    ({"wavelength", "intensity", "q", "u"}, "spectra of a target"),
    ({"frame", "bin", "right_00", "left_00"}, "Mueller matrices"),
)
# what an observation table has at least one of, and no other table of ours
_OBSERVED = {"flux_right", "flux_left", "single_difference", "single_sum"}
# header values that tell frames apart
_SHOWN = ("object", "filter", "date", "hwp", "derotator", "parallactic", "altitude")
_DULL = ("description", "comments", "reference")
_FITS_NAMES = (".fits", ".fit", ".fts", ".fits.gz", ".fits.fz")


def run(arguments):
    """Print what the file holds."""
    path = arguments.file
    if arguments.instruments:
        common.say(arguments, *instruments.names())
        return
    if (arguments.frame or arguments.context) and not (path and Path(path).is_dir()):
        named = f"{path}: " if path else ""
        raise AstropolcalError(f"{named}--frame and --context need a folder of calibrations")
    if path is None:
        known = {"instruments": instruments.names(), "optics": sorted(OPTICS)}
        known["observables"] = sorted(OBSERVABLES)
        lines = [f"  {key + ':':<13}{', '.join(names)}" for key, names in known.items()]
        lines.insert(0, f"astropolcal {version}")
        lines, content = _wrapped(lines, {"astropolcal": version} | known, 15)
    elif Path(path).is_dir():
        lines, content = _library(path, arguments.context, arguments.frame)
    elif Path(path).suffix.lower() == ".asdf":
        lines, content = _calibration(path, arguments)
    # a FITS file, or one that by its name claims to be one
    elif str(path).lower().endswith(_FITS_NAMES) or common.begins(path, b"SIMPLE  ="):
        lines, content = _wrapped(*describe_fits(path))
    else:
        lines, content = _table(path)
    common.give(arguments, lines, content)


def _wrapped(lines, content, indent=4):
    return [common.wrapped(line, indent) for line in lines], content


def _calibration(path, arguments):
    from astropolcal.calibration import Calibration
    from astropolcal.calibration.result.calibration import validity_of
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
    for record in calibration.datasets if arguments.full else ():
        optics = ", ".join(f"{k}: {v}" for k, v in record.meta.items() if k not in _DULL)
        lines.append(f"  {record.name}: {optics}, sha256 {record.content_hash[:12]}")
    content = calibration.to_dict() | {"validity": held.to_dict(), "content_hash": digest}
    lines, content = _wrapped(lines, content)
    last, found = common.written_lines([arguments.json]), calibration.verdict()
    if arguments.full:
        # its end is what stays on the screen
        return [calibration.summary(full=True), "", *lines, "", *found.words, *last], content
    height = HEIGHT - len("\n".join(lines).split("\n")) - len(last) - 1
    return [*compact_lines(calibration, found, height), *lines, *last, HINT], content


def _library(folder, context, frame):
    """Return what a folder of calibrations holds, one block of lines a file."""
    from astropolcal.pipeline.library import Library

    library = Library(folder, context)
    if frame is not None:
        return _wrapped(*_choice(library, frame))
    lines, files = [f"{folder}: {counted(len(library), 'calibration')}"], []
    for entry, row in zip(library.entries, library.table(), strict=True):
        good = f"s_res {_percent(row['s_res'])}, s_cv {_percent(row['s_cv'])}"
        # loud: nobody should take it by accident
        state = "" if row["converged"] else ", NOT CONVERGED"
        lines += [
            f"{entry.name}",
            f"  valid for {entry.validity}",
            f"  from {row['datasets']}; {good} (median){state}",
            f"  content sha256 {entry.content_hash[:12]}",
        ]
        known = {key: str(row[key]) for key in ("name", "datasets", "content_hash")}
        known |= {f"{key}_percent": row[key] for key in ("s_res", "s_cv")}
        known |= {"converged": bool(row["converged"]), "validity": entry.validity.to_dict()}
        files.append(known)
    problems = {path.name: reason for path, reason in library.problems.items()}
    for name, reason in problems.items():
        lines += [name, f"  UNREADABLE: {reason}"]
    overlaps = library.overlaps()
    lines += [f"OVERLAP: {words}" for words in overlaps]
    others = sum(path.suffix.lower() in (".ecsv", ".fits") for path in Path(folder).iterdir())
    if not (files or problems) and others:
        # they could be told of one by one
        what = counted(others, "table or FITS file", "tables and FITS files")
        lines.append(f"  {what} in it; astropolcal info FILE tells of one")
    content = {"folder": str(folder), "calibrations": files}
    return _wrapped(lines, content | {"unreadable": problems, "overlaps": overlaps})


def _choice(library, frame):
    """Return which calibration of a library holds for a frame, and why none of the others."""
    from astropolcal.pipeline.loading import wanted_of

    try:
        wanted = wanted_of(frame)
    except InstrumentError as error:
        # an argument of Python is no way out in a terminal
        words = str(error).partition("; give instrument=")[0]
        raise InstrumentError(f"{frame}: {words}; give a raw frame, which does") from error
    table = library.explain(**wanted)
    lines = [f"{row['name']}: {row['why']}" for row in table]
    problem = table.meta["problem"]
    rows = [dict(zip(table.colnames, map(str, row), strict=True)) for row in table]
    return lines + [f"NONE: {problem}"] * bool(problem), {"calibrations": rows, "problem": problem}


def _percent(value):
    # NaN is not equal to itself
    return f"{value:.3f} %" if value == value else "-"


def _table(path):
    """Return what an ECSV table holds: beam fluxes, or something else."""
    # what cannot be opened its reader says
    if os.access(path, os.R_OK) and not common.begins(path, b"# %ECSV"):
        raise ObservationError(
            f"{path}: info takes a calibration (.asdf), a folder of them, an ECSV table, or a FITS "
            "cube or product; this is none of them"
        )
    table = read_ecsv(path)
    if _OBSERVED & set(table.colnames) or {"frame", "flux"} <= set(table.colnames):
        return _observations(path)
    kind = next((words for names, words in _TABLES if names <= set(table.colnames)), "table")
    units = {name: str(getattr(table[name], "unit", None) or "") for name in table.colnames}
    columns = ", ".join(f"{name} ({unit})" if unit else name for name, unit in units.items())
    size = f"{counted(len(table), 'row')} x {counted(len(units), 'column')}"
    lines, meta = [f"{path}: {kind}, {size}", f"  columns: {columns}"], _told(table.meta)
    for key, value in meta.items():
        words = ", ".join(map(str, value)) if isinstance(value, list) else value
        lines.append(f"  {key}: {words}")
    content = {"file": str(path), "type": kind, "n_rows": len(table), "columns": units}
    return _wrapped(lines, content | {"meta": meta})


def _observations(path):
    # again, with all checks; the first look was for the columns only
    observations = Observations.read(path)
    paired = default_observable([observations]) == "normalized_double_difference"
    # raises where a plate angle has no partner at all
    pairs = observations.pairs() if paired else ()
    same = ("instrument", "source", "n_frames", "content_hash")
    content = {"file": str(path)} | {key: getattr(observations, key) for key in same}
    content |= {"n_masked": int(observations.mask.sum()), "n_pairs": len(pairs)}
    content |= {"n_wavelengths": observations.n_bins}
    content |= {"wavelength_nm": observations.wavelength.to_value(u.nm)}
    lines = [*observations.summary().splitlines(), f"Next: {common.following('calibrate', path)}"]
    return _wrapped(lines, content, indent=2)


def _told(values):
    """Return values as JSON has them; what it does not know, and what is nested, is text."""
    told = {}
    for key, value in values.items():
        try:
            told[str(key)] = one_line(value, None) if isinstance(value, dict) else plain(value)
        except AstropolcalError:
            told[str(key)] = one_line(value, None)
    return told


# ---- FITS files -----------------------------------------------------------------------------


def describe_fits(path):
    """Return text and JSON content of a product, a cube, or any FITS file."""
    from astropolcal.correction import Corrected
    from astropolcal.correction.product import PRODUCT
    from astropolcal.fitscheck import open_fits, readable_fits

    with readable_fits(path), open_fits(path) as stream, fits.open(stream, memmap=True) as hdus:
        # a product says in its first header what it is
        header = hdus[0].header
        if header.get("CONTENT") != PRODUCT:
            return _describe_frame(path, header, [_hdu(each.name, each.header) for each in hdus])
    return _describe_product(path, Corrected.read(path))


def _describe_product(path, product):
    made, wavelength = product.provenance, product.wavelength.to_value(u.nm)
    # frames have a key of their own
    frames = list(made.get("frames", []))
    same = ("components", "mode", "observable", "north_up")
    content = {"file": str(path), "type": "corrected product"}
    content |= {key: getattr(product, key) for key in same} | {
        "shape": list(product.stokes.shape),
        "unit": product.unit.to_string(),
        "wavelength_nm": wavelength,
        # at a wavelength all components must be
        "n_determined": int(np.sum(product.determined.all(axis=-1))),
        "statistical": product.covariance is not None,
        "systematic": "none" if product.systematic is None else product.systematic.method,
        "provenance": _told({key: made[key] for key in made if key != "frames"}),
        "frames": frames,
    }
    n = counted(len(wavelength), "wavelength")
    size = " x ".join(map(str, content["shape"][2:]))
    ends = dict.fromkeys((frames[0], frames[-1])) if frames else ()
    lines = [
        f"{path}: corrected product, made {made.get('created', 'at an unknown time')} with "
        f"astropolcal {made.get('astropolcal', '?')}",
        f"  Stokes parameters {product.components} in {content['unit'] or 'counts'}, {n} from "
        f"{wavelength.min():.6g} to {wavelength.max():.6g} nm"
        + (f", images of {size} pixels" if size else ""),
        f"  mode {product.mode}, observable {product.observable}, "
        + ("north is up" if product.north_up else "as the detector sees the field"),
        f"  determined at {content['n_determined']} of {n}",
        f"  errors: statistical {'yes' if content['statistical'] else 'no'}, systematic "
        f"{content['systematic']}",
        f"  calibration: {made.get('calibration', 'not known')}, sha256 "
        f"{str(made.get('calibration_hash', 'not known'))[:12]}",
        *(f"  NOT USABLE AS IT IS: {words}" for words in made.get("calibration_faults", [])),
        f"  from {counted(len(frames), 'frame')}" + (f": {' to '.join(ends)}" if frames else ""),
    ]
    return lines, content


def _hdu(name, header):
    """Return name, shape, type and unit of one HDU, read from its header alone."""
    # FITS counts the fastest axis first, numpy last
    shape = [int(header.get(f"NAXIS{i}", 0)) for i in range(int(header.get("NAXIS", 0)), 0, -1)]
    unit = str(header.get("BUNIT", ""))
    return {"name": name, "shape": shape, "bits": header.get("BITPIX"), "unit": unit}


def _describe_frame(path, header, hdus):
    """Return text and JSON content of a FITS file, with what an instrument reads in its header."""
    from astropolcal.reduction.headers import read_header, tracking_error

    shapes = {tuple(hdu["shape"]) for hdu in hdus}
    name, values, words = _instrument(header, shapes), {}, []
    kind = "FITS file" if name is None else f"FITS file of {name}"
    if name is not None:
        with suppress(AstropolcalError):
            # the mode tells which shape a cube has
            layout = instruments.get(name).configured(header).files
            frame = read_header(path, layout, header=header)
            off = [tracking_error(frame.values, layout, on_sky=sky) for sky in (True, False)]
            if None not in off and min(map(abs, off)) > layout.tracking_tolerance:
                names = " and ".join(layout.keywords[key] for key in ("hwp", "hwp_true"))
                frame.doubts.append(f"{names} agree neither on sky nor with the internal source")
            values = {key: frame.values[key] for key in _SHOWN if key in frame.values}
            words = [f"  problem: {one}" for one in frame.errors]
            words += [f"  doubtful: {one}" for one in frame.doubts]
            kind = f"cube of {name}" if _cube_shapes(layout) & shapes else kind
    lines = [f"{path}: {kind}, {counted(len(hdus), 'HDU')}"]
    for number, hdu in enumerate(hdus):
        size = " x ".join(map(str, hdu["shape"])) or "no data"
        lines.append(f"  {number} {hdu['name'] or '-'}: {size} {hdu['unit']}".rstrip())
    shown = [f"{k} {v:zg} deg" if isinstance(v, float) else f"{k} {v}" for k, v in values.items()]
    lines += [f"  header: {', '.join(shown)}"] if values else []
    content = {"file": str(path), "type": kind, "instrument": name, "hdus": hdus}
    return [*lines, *words], content | {"header": _told(values)}


def _instrument(header, shapes):
    """Return the instrument that a header names, or else the only one with such cubes."""
    known = [one for one in map(instruments.get, instruments.names()) if one.files is not None]
    with suppress(InstrumentError):
        return recognized(header, known).name
    # an extracted cube may lack the keywords of its raw frame
    alike = [one.name for one in known if _cube_shapes(one.files) & shapes]
    return alike[0] if len(alike) == 1 else None


def _cube_shapes(layout):
    """Return the shapes of a cube; one of a single slice may be stored as an image."""
    shape = layout.file_shape
    return {shape, shape[1:]} if shape[0] == 1 else {shape}
