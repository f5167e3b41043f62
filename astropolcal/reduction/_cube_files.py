# Licensed under a 3-clause BSD style license - see LICENSE
"""Files of simulated cubes: their names, headers and extensions."""

import os
import re

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.time import Time

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.files import atomic_path, check_new
from astropolcal.instruments.layout import TEXTS, unit_of


def file_names(directory, layout, prefix, first, n_frames, raw, overwrite):
    """Return the paths of cube and raw header of every frame."""
    if not os.path.isdir(directory.parent):
        raise ObservationError(f"{directory}: there is no folder {directory.parent}")
    if os.path.exists(directory) and not os.path.isdir(directory):
        raise ObservationError(f"{directory}: is a file, not a folder")
    prefix = layout.prefix if prefix is None else prefix
    # eight digits, as the frame numbers of the Subaru archive have
    numbers = [f"{prefix}{first + i:08d}" for i in range(n_frames)]
    if first < 0 or re.search(layout.frame_pattern, f"{numbers[-1]}_cube.fits") is None:
        raise ParameterError(
            f"{numbers[-1]}: the number of the frame must match {layout.frame_pattern}"
        )
    # the right beam names a frame; that of the left one follows from it
    mark = layout.beam_files[0] if layout.beam_files else "cube"
    names = [
        (directory / f"{n}_{mark}.fits", directory / "raw" / f"{n}.fits" if raw else None)
        for n in numbers
    ]
    every = [(cube, layout.left_file(cube), header) for cube, header in names]
    # all names before the first file is written: a run is replaced whole or not at all
    for path in (path for group in every for path in group if path is not None):
        if os.path.exists(path):
            check_new(path, overwrite, ObservationError)
    folder = directory / "raw" if raw else directory
    try:
        folder.mkdir(exist_ok=True, parents=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ObservationError(f"{folder}: cannot be made: {reason}") from error
    return names


def write_cube(cube, raw_header, image, weight, header, layout):
    # as real extraction leaves it: some keywords stay behind in the raw frame
    in_raw = {layout.keywords[c] for c in layout.raw_columns if c in layout.keywords}
    in_cube = {k: v for k, v in header.items() if raw_header is None or k not in in_raw}
    left, camera = layout.left_file(cube), layout.keywords.get("camera")
    if left is None:
        _save(_hdus(in_cube, image, weight, layout), cube)
    else:
        # the left image is the first half
        parts = [np.split(array, 2, axis=-1) for array in (image, weight)]
        for number, (path, side) in enumerate([(cube, 1), (left, 0)], start=1):
            # cameras are numbered 1 (right) and 2 (left)
            own = in_cube | ({} if camera is None else {camera: number})
            _save(_hdus(own, *(part[side] for part in parts), layout), path)
    if raw_header is not None:
        _save(fits.HDUList([fits.PrimaryHDU(header=fits.Header(list(header.items())))]), raw_header)


def _hdus(header, image, weight, layout):
    header, second = fits.Header(list(header.items())), ("IVAR", "adu-2")
    if layout.weights == "error":
        with np.errstate(divide="ignore"):
            # where nothing is known the weight is 0, and so is this
            weight = np.where(weight > 0, 1 / np.sqrt(weight), 0.0).astype(np.float32)
        second = ("ERR", "adu")
    if layout.cube_extension == 0:
        # without it the unit would have to be guessed
        header["BUNIT"] = "adu"
        hdus = [fits.PrimaryHDU(image, header=header)]
    else:
        # the cube's extension need not be the first
        hdus = [fits.PrimaryHDU(header=header)]
        hdus += [fits.ImageHDU() for _ in range(layout.cube_extension - 1)]
        hdus.append(fits.ImageHDU(image, header=fits.Header({"BUNIT": "adu"}), name="IMAGE"))
    name, unit = second
    hdus.append(fits.ImageHDU(weight, header=fits.Header({"BUNIT": unit}), name=name))
    return fits.HDUList(hdus)


def _save(hdus, path):
    with atomic_path(path, ObservationError) as temporary, open(temporary, "wb") as stream:
        hdus.writeto(stream)


def header_of(frame, layout):
    """Return keyword and value of every column that the layout has a keyword for."""
    header = {}
    time = Time(frame["time"])
    date, clock = time.isot.split("T")
    # a column of the frames goes before these, so that a test may give an odd one
    known = {"date": date, "time": clock, "mjd": time.mjd * u.day}
    if layout.identities:
        known["instrument"] = layout.identities[0]
    known |= {c: frame[c] for c in frame.colnames if c != "time"}
    for column, keyword in layout.keywords.items():
        if column in known:
            header[keyword] = _value(column, known[column], layout)
    return header


def _value(column, value, layout):
    """Return what a header says: the inverse of how the layout reads it."""
    if column == "flc_state":
        return "AB"[int(value)]
    if column in TEXTS and not isinstance(value, u.Quantity):
        return str(value)
    number = u.Quantity(value).to_value(unit_of(column, layout))
    # value = factor * header + offset, turned round
    factor, offset = layout.transforms.get(column, (1.0, 0.0))
    return float((number - offset) / factor)
