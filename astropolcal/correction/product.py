# Licensed under a 3-clause BSD style license - see LICENSE
"""
FITS products: Stokes parameters and errors with their conventions in the header.

The primary array has the axes x, y, wavelength and Stokes (FITS order; spectra lack the first
two). The wavelengths, which need not be evenly spaced, stand in the table ``WAVELENGTH``.
"""

import warnings
from itertools import combinations_with_replacement

import astropy.units as u
import numpy as np
from astropy.coordinates import StokesCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning

from astropolcal.correction.solve import covariance_index
from astropolcal.correction.star import COLUMNS, star_words
from astropolcal.correction.systematic import Systematic
from astropolcal.exceptions import ObservationError
from astropolcal.files import atomic_path, check_new, understood
from astropolcal.fitscheck import open_fits

__all__ = []

#: What the keyword ``CONTENT`` of a product says.
PRODUCT = "astropolcal Stokes product"
# characters of a HISTORY card
_CARD = 72
# raised when a reader of the version before would misunderstand the file
_VERSION = 1
_KEYWORDS = {
    "created": ("DATE", "when this file was made (UTC)"),
    "astropolcal": ("APCVERS", "version of astropolcal"),
    "astropy": ("APYVERS", "version of astropy"),
    "numpy": ("NPYVERS", "version of numpy"),
    "instrument": ("INSTRUME", "instrument of the calibration"),
    "calibration": ("CALFILE", "calibration file"),
    "calibration_hash": ("CALHASH", "SHA-256 of the calibration"),
    "systematic": ("SYSMETH", "how systematic errors were found"),
}


def write_product(corrected, path, *, overwrite=False):
    """Write a `Corrected` to a FITS file, which appears complete or not at all."""
    frames = corrected.provenance.get("frames", [])
    path = check_new(path, overwrite, ObservationError, frames)
    table = QTable({"wavelength": corrected.wavelength.to(u.um)})
    for name in ("condition", "determined", "leakage"):
        table[name] = getattr(corrected, name)
    # FITS has no columns of width zero
    table["weak"] = np.array([words or " " for words in corrected.weak], dtype=str)
    hdus = [fits.PrimaryHDU(corrected.stokes, _header(corrected))]
    hdus += [fits.BinTableHDU(table, name="WAVELENGTH"), *_errors(corrected)]
    # what follows from the rest, for those who read FITS only
    found = corrected.polarization()
    order = ("dolp", "dolp_debiased", "s_p_statistical", "s_p_systematic")
    hdus.append(_image("DOLP", np.stack([found[name] for name in order]), *order))
    order = ("aolp", "s_chi_statistical", "s_chi_systematic")
    hdus.append(_image("AOLP", np.stack([found[name] for name in order]), *order, unit=u.deg))
    if corrected.stokes.ndim == 4:
        found = corrected.azimuthal()
        hdus.append(_image("QPHI", np.stack(list(found.values())), *found, unit=corrected.unit))
        if not corrected.north_up:
            hdus[-1].header["COMMENT"] = "as if north were up, which is not known (NORTHUP = F)"
    if corrected.star is not None:
        hdus.append(fits.BinTableHDU(corrected.star, name="STAR"))
    names = [_printable(name) for name in frames] or ["unknown"]
    hdus.append(fits.BinTableHDU(Table({"frame": np.array(names, dtype=str)}), name="FRAMES"))
    with atomic_path(path, ObservationError) as temporary, open(temporary, "wb") as stream:
        fits.HDUList(hdus).writeto(stream, checksum=True)


def _header(corrected):
    header = fits.Header()
    header["CONTENT"] = (PRODUCT, "what this file is")
    header["CONTVERS"] = (_VERSION, "version of its form")
    header["BUNIT"] = _unit(corrected.unit)
    _axes(header, corrected)
    header["POLCONV"] = ("IAU", "angles from north through east")
    header["COMMENT"] = "Q is positive north-south, U from north-east to south-west; the position"
    header["COMMENT"] = "angle is atan2(U, Q) / 2. V is right minus left. North is that of the"
    header["COMMENT"] = "frames' parallactic angles, the pole of date if coordinates gave them."
    header["STOKES"] = (corrected.components, "Stokes parameters along the last axis")
    header["CORRMODE"] = (corrected.mode, "stokes: whole Mueller matrix; ip: offsets only")
    header["OBSERVBL"] = (corrected.observable, "what was fitted")
    header["NORTHUP"] = (corrected.north_up, "north is up and east is left")
    header["RESAMPLE"] = (corrected.resampling, "mean variance of a pixel, before: 1")
    for key, (keyword, comment) in _KEYWORDS.items():
        if corrected.provenance.get(key):
            value = _printable(corrected.provenance[key])
            if keyword == "DATE":
                # in FITS it is UTC, and has no zone
                value = value.removesuffix("+00:00")
            # a card holds 80 characters
            header[keyword] = (value, comment) if len(value) + len(comment) < 60 else value
    if corrected.star is not None:
        header["STARSUB"] = (corrected.star.meta["star"], "light of the star subtracted")
        header["HISTORY"] = f"polarization of the star, subtracted: {star_words(corrected.star)}"
    if faults := corrected.provenance.get("calibration_faults"):
        header["CALFAULT"] = _printable("; ".join(faults))
    for word in corrected.provenance.get("held", []):
        header["HISTORY"] = f"not free in the calibration, without error: {_printable(word)}"
    for i, words in enumerate(corrected.weak):
        if words:
            header["HISTORY"] = f"poorly determined at wavelength {i}: {words}"
    return header


def _unit(unit):
    try:
        return unit.to_string("fits")
    except ValueError:
        # such as electrons, which the standard does not know
        return unit.to_string()


def _printable(text):
    """Return a text in the characters that FITS has, space to tilde; others as Python escapes."""
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in str(text))


def _axes(header, corrected):
    """Describe the axes; the Stokes axis by the codes of the FITS standard."""
    n = corrected.stokes.ndim
    # 1, 2, 3, 4 for I, Q, U, V (Greisen and Calabretta 2002, Table 7): evenly spaced as FITS needs
    for key, value in {"CTYPE": "STOKES", "CRPIX": 1.0, "CRVAL": 1.0, "CDELT": 1.0}.items():
        header[f"{key}{n}"] = value
    header[f"CTYPE{n - 1}"] = ("BIN", "see the table WAVELENGTH")
    if n == 4 and corrected.centre is not None and corrected.pixel_scale is not None:
        # milliarcsecond to degree
        step = corrected.pixel_scale / 3.6e6
        # offsets from the star, not coordinates on the sky
        to_right = -1 if corrected.north_up else 1
        for axis, name, sign in ((1, "XOFFSET", to_right), (2, "YOFFSET", 1)):
            header[f"CTYPE{axis}"] = (name, "from the star" + (", to the east" if sign < 0 else ""))
            header[f"CUNIT{axis}"] = "deg"
            # FITS counts pixels from one
            header[f"CRPIX{axis}"] = corrected.centre[axis - 1] + 1
            header[f"CRVAL{axis}"] = 0.0
            header[f"CDELT{axis}"] = sign * step
    if n == 4 and corrected.centre is not None:
        header["STARX"] = (corrected.centre[0], "place of the star, 0-based pixel")
        header["STARY"] = (corrected.centre[1], "place of the star, 0-based pixel")
    if corrected.pixel_scale is not None:
        header["PIXSCALE"] = (corrected.pixel_scale, "milliarcsecond")


def _image(name, values, *lines, unit=None):
    hdu = fits.ImageHDU(values, name=name)
    if unit is not None:
        hdu.header["BUNIT"] = _unit(unit)
    for i, line in enumerate(lines):
        hdu.header[f"PLANE{i + 1}"] = line
    return hdu


def _errors(corrected):
    names = list(map("".join, combinations_with_replacement(corrected.components, 2)))
    hdus, systematic, unit = [], corrected.systematic, corrected.unit**2
    if corrected.covariance is not None:
        hdus.append(_image("COVSTAT", corrected.covariance, *names, unit=unit))
    if systematic is not None:
        factor = systematic.factor
        # an array of no directions cannot be stored
        hdu = _image("SYSFACT", factor if len(factor) else np.zeros((1, *factor.shape[1:])))
        hdu.header["COMMENT"] = "Change of the Stokes vector (axis 2) for one sigma along each"
        hdu.header["COMMENT"] = "direction (axis 4), per unit of the true one (axis 1)."
        hdu.header["SYSMETH"] = systematic.method
        known = corrected.covariances("systematic")
        planes = np.stack([known[pair] for pair in covariance_index(len(known))])
        hdus += [hdu, _image("SYSOPEN", systematic.open.astype(np.uint8))]
        hdus.append(_image("COVSYST", planes, *names, unit=unit))
    return hdus


def read_product(path):
    """Return the fields of a `Corrected` from a product of `write_product`."""
    with (
        understood(path, ObservationError, "not a readable product"),
        open_fits(path, whole=True) as stream,
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("error", AstropyUserWarning)
        with fits.open(stream, memmap=False) as hdus:
            return _read(hdus)


def _read(hdus):
    header = hdus[0].header
    for key, needed in {"CONTENT": PRODUCT, "CONTVERS": _VERSION, "POLCONV": "IAU"}.items():
        if header.get(key) != needed:
            raise ValueError(f"{key} = {header.get(key)!r}; needed is {needed!r}")
    # FITS holds big-endian numbers
    stokes = _native(hdus[0].data)
    n = stokes.ndim
    codes = header[f"CRVAL{n}"] + header[f"CDELT{n}"] * np.arange(len(stokes))
    table = _table(hdus["WAVELENGTH"])
    provenance = {
        key: header[keyword] for key, (keyword, _) in _KEYWORDS.items() if keyword in header
    }
    if "CALFAULT" in header:
        provenance["calibration_faults"] = [_stated(header, "CALFAULT", str)]
    provenance["frames"] = [str(name) for name in _table(hdus["FRAMES"])["frame"]]
    _check(hdus, stokes, codes, table)
    unit = u.Unit(header["BUNIT"])
    # a number alone is a unit too to astropy, and FITS cannot hold all of them
    if getattr(unit, "scale", 1.0) != 1.0:
        raise ValueError(f"BUNIT = {header['BUNIT']!r}; a unit without a factor is needed")
    # products of before do not say it
    resampling = _stated(header, "RESAMPLE", float) if "RESAMPLE" in header else 1.0
    if not resampling > 0:
        raise ValueError(f"RESAMPLE = {resampling}; a number above zero is needed")
    place = tuple(_stated(header, key, float) for key in ("STARX", "STARY") if "STARX" in header)
    return {
        "components": "".join(StokesCoord(codes).symbol),
        "wavelength": np.asarray(table["wavelength"], dtype=float) * table["wavelength"].unit,
        "stokes": stokes,
        "covariance": _native(hdus["COVSTAT"].data) if "COVSTAT" in hdus else None,
        "systematic": _systematic(hdus),
        "condition": _native(table["condition"]),
        "determined": np.asarray(table["determined"], dtype=bool),
        "leakage": _native(table["leakage"]),
        "weak": [str(words).strip() for words in table["weak"]],
        "mode": _stated(header, "CORRMODE", str),
        "observable": _stated(header, "OBSERVBL", str),
        "unit": unit,
        "north_up": _stated(header, "NORTHUP", bool),
        "centre": place or None,
        "pixel_scale": _stated(header, "PIXSCALE", float) if "PIXSCALE" in header else None,
        "resampling": resampling,
        "provenance": provenance,
        "star": _star(hdus),
    }


def _star(hdus):
    """Return the polarization of the star that was subtracted, or None."""
    if "STARSUB" not in hdus[0].header:
        return None
    table = QTable(_table(hdus["STAR"]))
    if len(table) != len(hdus["WAVELENGTH"].data) or not set(COLUMNS) <= set(table.colnames):
        raise ValueError("STAR has not what is subtracted")
    table.meta = {"star": _stated(hdus[0].header, "STARSUB", str)}
    return table


def _table(hdu):
    """Return a table; one of this package has no arrays in a heap, which may claim any length."""
    heap = [form for form in hdu.columns.formats if "P" in form or "Q" in form]
    if heap:
        raise ValueError(f"a column of {heap[0]!r}")
    table = Table.read(hdu)
    for name in table.colnames:
        if table[name].dtype.kind == "c":
            raise ValueError(f"{name} is complex")
        if table[name].dtype.kind in "US" and not all(str(text).isascii() for text in table[name]):
            raise ValueError(f"text in {name} is not ASCII")
    return table


def _stated(header, keyword, kind):
    """Return the value of a keyword, which must be of a kind; floats may be whole numbers."""
    value = header[keyword]
    # True is an int to Python
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind or (kind is float and not np.isfinite(value)):
        words = {str: "a text", bool: "T or F", float: "a finite number"}[kind]
        raise ValueError(f"{keyword} = {value!r}, {words} is needed")
    return value


def _check(hdus, stokes, codes, table):
    """Refuse parts that do not belong together."""
    n, w = stokes.shape[:2] if stokes.ndim in (2, 4) else (0, 0)
    index = covariance_index(n)
    needed = {"COVSTAT": (len(index), *stokes.shape[1:]), "SYSOPEN": (w, n, n)}
    if "SYSFACT" in hdus:
        needed["SYSFACT"] = (len(hdus["SYSFACT"].data), w, n, n)
    wrong = [name for name, shape in needed.items() if name in hdus and hdus[name].shape != shape]
    if tuple(codes) not in ((1, 2, 3), (1, 2, 3, 4)) or len(table) != w or wrong:
        raise ValueError(
            f"Stokes parameters of shape {stokes.shape} do not fit "
            f"{', '.join(wrong) or f'{len(table)} wavelengths and the codes {codes.tolist()}'}"
        )
    values, unit = np.asarray(table["wavelength"], dtype=float), u.Unit(table["wavelength"].unit)
    if not np.all(np.isfinite(values) & (values > 0)) or not unit.is_equivalent(u.um):
        raise ValueError("its wavelengths are not lengths")
    diagonal = [i for i, (a, b) in enumerate(index) if a == b]
    if "COVSTAT" in hdus and np.any(hdus["COVSTAT"].data[diagonal] < 0):
        raise ValueError("negative variances")


def _native(values):
    return np.array(values, dtype=float)


def _systematic(hdus):
    if "SYSFACT" not in hdus:
        return None
    held, before, going = [], "", False
    for line in hdus[0].header.get("HISTORY", []):
        if line.startswith("not free"):
            held.append(line.rpartition(": ")[2])
            going = True
        else:
            # a card holds no more, and the next one goes on
            going = going and len(before) == _CARD and not line.startswith("poorly determined")
            held[-1:] = [held[-1] + line] if going else held[-1:]
        before = line
    found = hdus["SYSFACT"]
    is_open = np.asarray(hdus["SYSOPEN"].data, dtype=bool)
    return Systematic(_native(found.data), is_open, found.header["SYSMETH"], held)
