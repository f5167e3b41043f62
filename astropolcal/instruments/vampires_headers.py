# Licensed under a 3-clause BSD style license - see LICENSE
"""
Files of VAMPIRES: keywords, detectors, and the fields of the multiband imager.

Files are those of the public pipeline vampires_dpp (https://github.com/scexao-org/vampires_dpp):
one a camera, state of the liquid crystal and half-wave-plate angle, the image or the fields of
the multiband imager in the primary HDU and errors in the next. Keywords and the properties of the
detectors are as its modules ``headers`` and ``constants`` have them.
"""

from dataclasses import replace

import astropy.units as u
import numpy as np

from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments._subaru_optics import SITE
from astropolcal.instruments.layout import FileLayout
from astropolcal.instruments.readout import EM_EXCESS_NOISE, ReadOut
from astropolcal.observations.reading import SAME_WAVELENGTH, filter_wavelength

__all__ = ["FIELDS", "KEYWORDS", "LAYOUT", "layout_of", "mode_header", "slices_of"]

#: Fields of the multiband imager, in the order of the slices.
FIELDS = ("MBI 610", "MBI 670", "MBI 720", "MBI 760")
_BANDS = ("625-50", "Open", "675-50", "725-50", "750-50", "775-50")
_MODE, _FILTER = "OBS-MOD", "FILTER01"
_MULTIBAND, _REDUCED, _SINGLE = "IPOL_MBI", "IPOL_MBIR", "IPOL"
# pixels of a field of 1.1 arcsec, and of the usual window of 3 arcsec
_FIELD_SIDE, _WINDOW_SIDE = 184, 536
# part of a side that the rectangles of the internal source have
_LIT = 0.8

#: Column of the observation table to keyword.
KEYWORDS = {
    "hwp": "RET-ANG1",
    "hwp_true": "RET-POS1",
    "derotator": "D_IMRANG",
    "flc_state": "U_FLC",
    "flc": "U_FLCST",
    "camera": "U_CAMERA",
    "em_gain": "U_EMGAIN",
    "read_mode": "U_DETMOD",
    "filter": _FILTER,
    "altitude": "ALTITUDE",
    "parallactic": "PA",
}

# two ORCA-Quest since 2023, by read mode; before that two EMCCDs iXon Ultra 897
_FULL = 65535.0
_READ_OUTS = {
    "slow 1": ReadOut(0.105, 0.245, _FULL),
    "slow 2": ReadOut(0.105, 0.220, _FULL),
    "fast 1": ReadOut(0.103, 0.403, _FULL),
    "fast 2": ReadOut(0.103, 0.399, _FULL),
    "slow": ReadOut(0.105, 0.245, _FULL),
    "fast": ReadOut(0.103, 0.403, _FULL),
    "em": ReadOut(4.5, 89.0, _FULL, EM_EXCESS_NOISE),
    "conventional": ReadOut(4.5, 9.6, 40000.0),
}


def _places(side):
    """Return what depends on the size of an image."""
    middle, lit = (side - 1) / 2, _LIT * side
    return {
        "internal_apertures": ((middle, middle), (middle + side, middle), lit, lit, 0.0),
        "star_offset": (float(side), 0.0),
    }


#: The multiband imager; `layout_of` has the other modes.
LAYOUT = FileLayout(
    keywords=KEYWORDS
    | {
        "exposure_time": "EXPTIME",
        "mjd": "MJD",
        "date": "DATE-OBS",
        "time": "UT",
        "right_ascension": "RA",
        "declination": "DEC",
        "object": "OBJECT",
        "instrument": "INSTRUME",
        "pickoff": _MODE,
    },
    shape=(len(FIELDS), _FIELD_SIDE, 2 * _FIELD_SIDE),
    cube_extension=0,
    weights="error",
    alternatives={"flc_state": ("U_FLCSTT",), "hwp": ("U_HWPANG",), "filter": ("U_FILTER",)},
    units={"exposure_time": "s", "mjd": "d"},
    identities=("VAMPIRES",),
    prefix="VMPA",
    frame_pattern=r"(?<!\d)\d{8}(?!\d)",
    gain=0.105,
    read_noise=0.25,
    saturation=_FULL,
    pixel_scale=5.9,
    fwhm=3.5,
    site=SITE,
    beam_files=("cam1", "cam2"),
    states={"1": "A", "2": "B", "NA": ""},
    read_outs=_READ_OUTS,
    optics={"flc": ("flc", {r"(?i)^\s*in": "in", r"(?i)^\s*out": "out"})},
    **_places(_FIELD_SIDE),
)


def slices_of(header):
    """
    Return the wavelengths of the slices in a file.

    Parameters
    ----------
    header : `~astropy.io.fits.Header` or mapping
        With the mode, and outside of the multiband imager the filter.

    Returns
    -------
    `~astropy.units.Quantity`

    Raises
    ------
    InstrumentError
        If the filter is missing or has no known wavelength.

    Examples
    --------
    >>> from astropolcal.instruments.vampires_headers import slices_of
    >>> slices_of({"OBS-MOD": "IPOL_MBI"}), slices_of({"FILTER01": "750-50"})
    (<Quantity [610., 670., 720., 760.] nm>, <Quantity [750.] nm>)
    """
    mode = str(header.get(_MODE, "")).upper()
    if "MBI" in mode:
        # the reduced multiband imager leaves the first field out
        return _wavelengths(FIELDS[1:] if "MBIR" in mode else FIELDS)
    name = header.get(_FILTER, header.get("U_FILTER"))
    if name is None:
        raise InstrumentError(f"vampires: no keyword {_FILTER} in the header")
    try:
        return u.Quantity([filter_wavelength("vampires", str(name).strip())])
    except ObservationError as error:
        raise InstrumentError(f"{_FILTER} = {name!r}: {error}") from None


def layout_of(header):
    """
    Return how files of a mode look.

    Parameters
    ----------
    header : `~astropy.io.fits.Header` or mapping
        Primary header; without ``NAXIS1`` and ``NAXIS2`` of images as large as they usually are.

    Returns
    -------
    FileLayout

    Raises
    ------
    InstrumentError
        If the image is not square, or the filter is not known.

    Examples
    --------
    >>> from astropolcal.instruments.vampires_headers import layout_of
    >>> layout_of({"FILTER01": "Open", "NAXIS1": 128, "NAXIS2": 128}).shape
    (1, 128, 256)
    """
    multiband = "MBI" in str(header.get(_MODE, "")).upper()
    # headers that are asked before any file is read have no size
    usual = _FIELD_SIDE if multiband else _WINDOW_SIDE
    side, rows = (int(header.get(key, usual)) for key in ("NAXIS1", "NAXIS2"))
    if side != rows or side < 16:
        raise InstrumentError(
            f"vampires: images of {side} x {rows} pixels; square ones of 16 and more are needed"
        )
    keywords = LAYOUT.keywords | ({"filter": _MODE} if multiband else {})
    shape = (len(slices_of(header)), side, 2 * side)
    return replace(LAYOUT, keywords=keywords, shape=shape, **_places(side))


def mode_header(wavelength):
    """
    Return the keywords of the mode that has slices of these wavelengths.

    Parameters
    ----------
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,).

    Returns
    -------
    dict of str to str

    Raises
    ------
    InstrumentError
        If they are neither one filter nor the fields of the multiband imager.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.instruments.vampires_headers import mode_header
    >>> mode_header([775] * u.nm)
    {'OBS-MOD': 'IPOL', 'FILTER01': '775-50'}
    """
    known = [({_MODE: _MULTIBAND, _FILTER: "Open"}, FIELDS)]
    known.append(({_MODE: _REDUCED, _FILTER: "Open"}, FIELDS[1:]))
    known += [({_MODE: _SINGLE, _FILTER: name}, (name,)) for name in _BANDS]
    wavelength = np.atleast_1d(u.Quantity(wavelength)).to_value(u.nm)
    for header, names in known:
        own = _wavelengths(names).value
        if own.shape == wavelength.shape and np.allclose(own, wavelength, SAME_WAVELENGTH, 0):
            return header
    raise InstrumentError(
        f"vampires: no file has slices of {', '.join(f'{w:g}' for w in wavelength)} nm; allowed "
        f"are one of {', '.join(_BANDS)}, or the fields {', '.join(FIELDS)} with or without the "
        "first"
    )


def _wavelengths(names):
    return u.Quantity([filter_wavelength("vampires", name) for name in names])
