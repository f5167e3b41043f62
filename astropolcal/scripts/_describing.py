# Licensed under a 3-clause BSD style license - see LICENSE
"""What ``astropolcal info`` says of products, image cubes and tables other than observations."""

import math

import numpy as np

from astropolcal.words import counted

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


def is_observation(table):
    """Return whether a table holds beam fluxes, however badly."""
    return bool(_OBSERVED & set(table.colnames))


# ---- tables ---------------------------------------------------------------------------------


def describe_table(path, table):
    """Return text and JSON content of a table that holds no beam fluxes."""
    kind = next((words for names, words in _TABLES if names <= set(table.colnames)), "table")
    units = {name: str(getattr(table[name], "unit", None) or "") for name in table.colnames}
    columns = ", ".join(f"{name} ({unit})" if unit else name for name, unit in units.items())
    meta = {str(key): _plain(value) for key, value in table.meta.items()}
    lines = [
        f"{path}: {kind}, {counted(len(table), 'row')} x {counted(len(units), 'column')}",
        f"  columns: {columns}",
        *(f"  {key}: {_text(value)}" for key, value in meta.items()),
    ]
    content = {"file": str(path), "type": kind, "n_rows": len(table), "columns": units}
    return lines, content | {"meta": meta}


def _text(value):
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _plain(value):
    """Return a value as JSON knows it: what is no number or text is shown as text."""
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return " ".join(str(value).split())


# ---- FITS files -----------------------------------------------------------------------------


def describe_fits(path):
    """Return text and JSON content of a product, a cube, or any FITS file."""
    from astropy.io import fits

    from astropolcal.correction import Corrected
    from astropolcal.correction.product import PRODUCT
    from astropolcal.fitscheck import open_fits, readable_fits

    with (
        readable_fits(path),
        open_fits(path) as stream,
        fits.open(stream, memmap=True) as hdus,
    ):
        # a product says in its first header what it is
        header = hdus[0].header
        if header.get("CONTENT") != PRODUCT:
            return _describe_frame(path, header, [_hdu(hdu) for hdu in hdus])
    return _describe_product(path, Corrected.read(path))


def _describe_product(path, product):
    from astropy import units as u

    made, wavelength = product.provenance, product.wavelength.to_value(u.nm)
    # at a wavelength all components must be
    n_determined = int(np.sum(product.determined.all(axis=-1)))
    systematic = "none" if product.systematic is None else product.systematic.method
    shape = product.stokes.shape
    size = " x ".join(map(str, shape[2:]))
    content = {
        "file": str(path),
        "type": "corrected product",
        "components": product.components,
        "shape": list(shape),
        "unit": product.unit.to_string(),
        "wavelength_nm": [float(value) for value in wavelength],
        "mode": product.mode,
        "observable": product.observable,
        "north_up": product.north_up,
        "n_determined": n_determined,
        "statistical": product.covariance is not None,
        "systematic": systematic,
        # frames have a key of their own
        "provenance": {key: _plain(value) for key, value in made.items() if key != "frames"},
    }
    frames = list(made.get("frames", []))
    lines = [
        f"{path}: corrected product, made {made.get('created', 'at an unknown time')} with "
        f"astropolcal {made.get('astropolcal', '?')}",
        f"  Stokes parameters {product.components} in {product.unit.to_string() or 'counts'}, "
        f"{counted(shape[1], 'wavelength')} from {wavelength.min():.6g} to "
        f"{wavelength.max():.6g} nm" + (f", images of {size} pixels" if size else ""),
        f"  mode {product.mode}, observable {product.observable}, "
        + ("north is up" if product.north_up else "as the detector sees the field"),
        f"  determined at {n_determined} of {counted(shape[1], 'wavelength')}",
        f"  errors: statistical {'yes' if content['statistical'] else 'no'}, systematic "
        f"{systematic}",
        f"  calibration: {made.get('calibration', 'not known')}, sha256 "
        f"{str(made.get('calibration_hash', 'not known'))[:12]}",
        f"  from {counted(len(frames), 'frame')}" + (f": {_ends(frames)}" if frames else ""),
    ]
    return lines, content | {"frames": frames}


def _ends(names):
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}"


def _hdu(hdu):
    """Return name, shape, type and unit of one HDU, read from its header alone."""
    header = hdu.header
    # FITS counts the fastest axis first, numpy last
    shape = [int(header.get(f"NAXIS{i}", 0)) for i in range(int(header.get("NAXIS", 0)), 0, -1)]
    unit = str(header.get("BUNIT", ""))
    return {"name": hdu.name, "shape": shape, "bits": header.get("BITPIX"), "unit": unit}


def _describe_frame(path, header, hdus):
    name, frame, kind = _known_frame(path, header, hdus)
    values = {} if frame is None else {k: frame.values[k] for k in _SHOWN if k in frame.values}
    lines = [f"{path}: {kind}, {counted(len(hdus), 'HDU')}"]
    for number, hdu in enumerate(hdus):
        size = " x ".join(map(str, hdu["shape"])) or "no data"
        lines.append(f"  {number} {hdu['name'] or '-'}: {size} {hdu['unit']}".rstrip())
    if values:
        lines.append(f"  header: {', '.join(f'{key} {_short(v)}' for key, v in values.items())}")
    lines += [f"  problem: {words}" for words in (frame.errors if frame else [])]
    lines += [f"  doubtful: {words}" for words in (frame.doubts if frame else [])]
    content = {"file": str(path), "type": kind, "instrument": name, "hdus": hdus}
    return lines, content | {"header": {key: _plain(value) for key, value in values.items()}}


def _short(value):
    return f"{value:zg} deg" if isinstance(value, float) else str(value)


def _known_frame(path, header, hdus):
    """Return the instrument of a file, what it reads in the header, and the kind of file."""
    from astropolcal import instruments
    from astropolcal.exceptions import AstropolcalError
    from astropolcal.reduction.headers import read_header, tracking_error

    shapes = {tuple(hdu["shape"]) for hdu in hdus}
    name = _instrument(header, shapes)
    if name is None:
        return None, None, "FITS file"
    try:
        # the mode tells which shape a cube has
        layout = instruments.get(name).configured(header).files
        frame = read_header(path, layout, header=header)
        off = [tracking_error(frame.values, layout, on_sky=sky) for sky in (True, False)]
        if None not in off and min(map(abs, off)) > layout.tracking_tolerance:
            names = " and ".join(layout.keywords[key] for key in ("hwp", "hwp_true"))
            frame.doubts.append(f"{names} agree neither on sky nor with the internal source")
    except AstropolcalError:
        return name, None, f"FITS file of {name}"
    is_cube = bool(_cube_shapes(layout) & shapes)
    return name, frame, f"cube of {name}" if is_cube else f"FITS file of {name}"


def _instrument(header, shapes):
    """Return the instrument that a header names, or else the only one with such cubes."""
    from astropolcal import instruments

    layouts = {name: instruments.get(name).files for name in instruments.names()}
    layouts = {name: layout for name, layout in layouts.items() if layout is not None}
    for name, layout in layouts.items():
        if header.get(layout.keywords.get("instrument", "INSTRUME")) in layout.identities:
            return name
    # an extracted cube may lack the keywords of its raw frame
    alike = [name for name, layout in layouts.items() if _cube_shapes(layout) & shapes]
    return alike[0] if len(alike) == 1 else None


def _cube_shapes(layout):
    """Return the shapes of a cube; one of a single slice may be stored as an image."""
    shape = layout.file_shape
    return {shape, shape[1:]} if shape[0] == 1 else {shape}
