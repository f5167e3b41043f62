# Licensed under a 3-clause BSD style license - see LICENSE
"""
FITS products: Stokes parameters and errors with their conventions in the header.

The primary array has the axes x, y, wavelength and Stokes (FITS order; spectra lack the first
two). The wavelengths, which need not be evenly spaced, stand in the table ``WAVELENGTH``.
"""

import io
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import StokesCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.utils.exceptions import AstropyUserWarning

from astropolcal.correction.engine import covariance_index
from astropolcal.correction.systematic import Systematic
from astropolcal.exceptions import ObservationError
from astropolcal.files import atomic_path

__all__ = ["read_product", "write_product"]

_KIND = "astropolcal Stokes product"
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


def write_product(corrected, path, *, overwrite=False, maps=True):
    """
    Write corrected Stokes parameters to a FITS file, which appears complete or not at all.

    Parameters
    ----------
    corrected : Corrected
        What to write.
    path : path-like
        The file.
    overwrite : bool
        Whether an existing file may be replaced.
    maps : bool
        See ``Corrected.write``.

    Raises
    ------
    ObservationError
        If the file exists or cannot be written.

    Examples
    --------
    >>> from astropolcal.correction.product import write_product
    >>> write_product(None, ".")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: .: exists already; overwrite=True replaces it
    """
    path = Path(path)
    if path.is_dir() or (path.exists() and not overwrite):
        raise ObservationError(f"{path}: exists already; overwrite=True replaces it")
    if not path.parent.is_dir():
        raise ObservationError(f"{path}: there is no folder {path.parent}")
    hdus = [fits.PrimaryHDU(corrected.stokes, _header(corrected)), _wavelengths(corrected)]
    hdus += _errors(corrected)
    if maps:
        hdus += _maps(corrected)
    hdus.append(_frames(corrected))
    with atomic_path(path, ObservationError) as temporary:
        fits.HDUList(hdus).writeto(temporary, overwrite=True, checksum=True)


def _header(corrected):
    header = fits.Header()
    header["CONTENT"] = (_KIND, "what this file is")
    header["CONTVERS"] = (_VERSION, "version of its form")
    header["BUNIT"] = corrected.unit.to_string("fits")
    _axes(header, corrected)
    header["POLCONV"] = ("IAU", "angles from north through east")
    header["COMMENT"] = "Q is positive north-south, U from north-east to south-west; the position"
    header["COMMENT"] = "angle is atan2(U, Q) / 2. V is right minus left."
    header["STOKES"] = (corrected.components, "Stokes parameters along the last axis")
    header["CORRMODE"] = (corrected.mode, "stokes: whole Mueller matrix; ip: offsets only")
    header["OBSERVBL"] = (corrected.observable, "what was fitted")
    header["NORTHUP"] = (corrected.north_up, "north is up and east is left")
    for key, (keyword, comment) in _KEYWORDS.items():
        if corrected.provenance.get(key):
            value = str(corrected.provenance[key])
            # a card holds 80 characters
            header[keyword] = (value, comment) if len(value) + len(comment) < 60 else value
    for word in corrected.provenance.get("held", []):
        header["HISTORY"] = f"not free in the calibration, without error: {word}"
    for i, words in enumerate(corrected.weak):
        if words:
            header["HISTORY"] = f"poorly determined at wavelength {i}: {words}"
    return header


def _axes(header, corrected):
    """Describe the axes; the Stokes axis by the codes of the FITS standard."""
    n = corrected.stokes.ndim
    codes = corrected.stokes_axis.value
    keys = {"CTYPE": "STOKES", "CRPIX": 1.0, "CRVAL": float(codes[0]), "CDELT": 1.0}
    for key, value in keys.items():
        header[f"{key}{n}"] = value
    header[f"CTYPE{n - 1}"] = ("BIN", "see the table WAVELENGTH")
    if n == 4 and corrected.centre is not None and corrected.pixel_scale is not None:
        step = corrected.pixel_scale / 3.6e6
        # offsets from the star, not coordinates on the sky
        for axis, name, sign in ((1, "XOFFSET", -1), (2, "YOFFSET", 1)):
            header[f"CTYPE{axis}"] = (name, "from the star" + (", to the east" if sign < 0 else ""))
            header[f"CUNIT{axis}"] = "deg"
            header[f"CRPIX{axis}"] = corrected.centre[axis - 1] + 1
            header[f"CRVAL{axis}"] = 0.0
            header[f"CDELT{axis}"] = (sign if corrected.north_up else 1) * step
    if n == 4 and corrected.centre is not None:
        header["STARX"] = (corrected.centre[0], "place of the star, 0-based pixel")
        header["STARY"] = (corrected.centre[1], "place of the star, 0-based pixel")
    if corrected.pixel_scale is not None:
        header["PIXSCALE"] = (corrected.pixel_scale, "milliarcsecond")


def _wavelengths(corrected):
    table = QTable({"wavelength": corrected.wavelength.to(u.um)})
    table["condition"] = corrected.condition
    table["determined"] = corrected.determined
    table["leakage"] = corrected.leakage
    table["weak"] = np.array(corrected.weak, dtype=str)
    # FITS has no columns of width zero
    table["weak"] = np.where(table["weak"] == "", " ", table["weak"])
    return fits.BinTableHDU(table, name="WAVELENGTH")


def _image(name, values, *lines):
    hdu = fits.ImageHDU(values, name=name)
    for i, line in enumerate(lines):
        hdu.header[f"PLANE{i + 1}"] = line
    return hdu


def _errors(corrected):
    n, names = len(corrected.components), corrected.components
    pairs = [f"{names[i]}{names[j]}" for i, j in covariance_index(n)]
    hdus = []
    if corrected.covariance is not None:
        hdus.append(_image("COVSTAT", corrected.covariance, *pairs))
    systematic = corrected.systematic
    if systematic is not None:
        factor = systematic.factor
        # an array of no directions cannot be stored
        factor = factor if len(factor) else np.zeros((1, *factor.shape[1:]))
        hdu = _image("SYSFACT", factor)
        hdu.header["COMMENT"] = "Change of the Stokes vector (axis 2) for one sigma along each"
        hdu.header["COMMENT"] = "direction (axis 4), per unit of the true one (axis 1)."
        hdu.header["SYSMETH"] = systematic.method
        hdus += [hdu, _image("SYSOPEN", systematic.open.astype(np.uint8))]
    return hdus


def _maps(corrected):
    """Return what follows from the rest, for those who read FITS only."""
    hdus, n = [], len(corrected.components)
    names = [f"{corrected.components[i]}{corrected.components[j]}" for i, j in covariance_index(n)]
    if corrected.systematic is not None:
        known = corrected.covariances("systematic")
        planes = np.stack([known[i, j] for i, j in covariance_index(n)])
        hdus.append(_image("COVSYST", planes, *names))
    found = corrected.polarization()
    order = ("dolp", "dolp_debiased", "s_p_statistical", "s_p_systematic")
    hdus.append(_image("DOLP", np.stack([found[name] for name in order]), *order))
    order = ("aolp", "s_chi_statistical", "s_chi_systematic")
    hdu = _image("AOLP", np.stack([found[name] for name in order]), *order)
    hdu.header["BUNIT"] = "deg"
    hdus.append(hdu)
    if corrected.stokes.ndim == 4:
        found = corrected.azimuthal()
        hdus.append(_image("QPHI", np.stack(list(found.values())), *found))
    return hdus


def _frames(corrected):
    names = [str(name) for name in corrected.provenance.get("frames", [])] or ["unknown"]
    return fits.BinTableHDU(Table({"frame": np.array(names, dtype=str)}), name="FRAMES")


def read_product(path):
    """
    Read a product of `write_product`.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    Corrected

    Raises
    ------
    ObservationError
        If the file is missing, damaged or not ours.

    Examples
    --------
    >>> from astropolcal.correction.product import read_product
    >>> read_product("nowhere.fits")
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: nowhere.fits: no such file
    """
    try:
        # astropy does not close a file that it cannot read
        with open(path, "rb") as stream, warnings.catch_warnings():
            # a wrong checksum is found when the data are read, and only warned of
            warnings.simplefilter("error", AstropyUserWarning)
            _check_sizes(path, stream)
            with fits.open(stream, checksum=True, memmap=False) as hdus:
                return _read(path, hdus)
    except FileNotFoundError:
        raise ObservationError(f"{path}: no such file") from None
    except ObservationError:
        raise
    except Exception as error:  # astropy raises errors of many kinds for damaged files
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ObservationError(f"{path}: not a readable product: {reason}") from error


def _read(path, hdus):
    from astropolcal.correction.result import Corrected

    header = hdus[0].header
    if header.get("CONTENT") != _KIND or header.get("CONTVERS") != _VERSION:
        raise ObservationError(
            f"{path}: CONTENT = {header.get('CONTENT')!r}, version {header.get('CONTVERS')}; "
            f"needed is {_KIND!r}, version {_VERSION}"
        )
    if header.get("POLCONV") != "IAU":
        raise ObservationError(f"{path}: POLCONV = {header.get('POLCONV')!r}; allowed is 'IAU'")
    stokes = _native(hdus[0].data)
    n = stokes.ndim
    codes = header[f"CRVAL{n}"] + header[f"CDELT{n}"] * np.arange(len(stokes))
    table = Table.read(hdus["WAVELENGTH"])
    provenance = {
        key: header[keyword] for key, (keyword, _) in _KEYWORDS.items() if keyword in header
    }
    provenance["frames"] = [str(name) for name in Table.read(hdus["FRAMES"])["frame"]]
    _check(path, hdus, stokes, codes, table)
    return Corrected(
        "".join(StokesCoord(codes).symbol),
        np.asarray(table["wavelength"], dtype=float) * u.Unit(table["wavelength"].unit),
        stokes,
        _native(hdus["COVSTAT"].data) if "COVSTAT" in hdus else None,
        _systematic(hdus),
        _native(table["condition"]),
        np.asarray(table["determined"], dtype=bool),
        _native(table["leakage"]),
        [str(words).strip() for words in table["weak"]],
        header["CORRMODE"],
        header["OBSERVBL"],
        u.Unit(header["BUNIT"]),
        bool(header["NORTHUP"]),
        (header["STARX"], header["STARY"]) if "STARX" in header else None,
        header.get("PIXSCALE"),
        provenance,
    )


def _check_sizes(path, stream):
    """Refuse headers that claim more data than the file has, before anything is read."""
    size = Path(path).stat().st_size
    with fits.open(io.BytesIO(stream.read()), memmap=False) as hdus:
        for hdu in hdus:
            info = hdu.fileinfo()
            if info["file"].compression is None and info["datLoc"] + info["datSpan"] > size:
                raise ObservationError(f"{path}: truncated: {hdu.name or 'the image'} is not whole")
    stream.seek(0)


def _check(path, hdus, stokes, codes, table):
    """Refuse parts that do not belong together."""
    n, w = stokes.shape[:2] if stokes.ndim in (2, 4) else (0, 0)
    pairs = n * (n + 1) // 2
    needed = {"COVSTAT": (pairs, *stokes.shape[1:]), "SYSOPEN": (w, n, n)}
    if "SYSFACT" in hdus:
        needed["SYSFACT"] = (len(hdus["SYSFACT"].data), w, n, n)
    wrong = [name for name, shape in needed.items() if name in hdus and hdus[name].shape != shape]
    if tuple(codes) not in ((1, 2, 3), (1, 2, 3, 4)) or len(table) != w or wrong:
        raise ObservationError(
            f"{path}: not a readable product: Stokes parameters of shape {stokes.shape} do not fit "
            f"{', '.join(wrong) or f'{len(table)} wavelengths and the codes {codes.tolist()}'}"
        )
    values = np.asarray(table["wavelength"], dtype=float)
    if not np.all(np.isfinite(values) & (values > 0)) or not u.Unit(
        table["wavelength"].unit
    ).is_equivalent(u.um):
        raise ObservationError(f"{path}: not a readable product: its wavelengths are no lengths")
    if "COVSTAT" in hdus and n:
        diagonal = [i for i, (a, b) in enumerate(covariance_index(n)) if a == b]
        if np.any(hdus["COVSTAT"].data[diagonal] < 0):
            raise ObservationError(f"{path}: not a readable product: negative variances")


def _native(values):
    return np.array(values, dtype=float)


def _systematic(hdus):
    if "SYSFACT" not in hdus:
        return None
    held = [
        line.rpartition(": ")[2]
        for line in hdus[0].header.get("HISTORY", [])
        if line.startswith("not free")
    ]
    found = hdus["SYSFACT"]
    is_open = np.asarray(hdus["SYSOPEN"].data, dtype=bool)
    return Systematic(_native(found.data), is_open, found.header["SYSMETH"], held)
