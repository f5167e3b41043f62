# Licensed under a 3-clause BSD style license - see LICENSE
"""Frames whose beams fall on two cameras, each with a file of its own."""

from dataclasses import replace

import numpy as np

from astropolcal.reduction.errors import detector_of
from astropolcal.reduction.headers import read_header

__all__ = ["beam_scale", "match_beams"]

# what the headers of both files must agree in, and by how much numbers may differ
_COMMON = {"hwp": 0.1, "derotator": 0.5, "exposure_time": 1e-3, "flc_state": None, "filter": None}


def match_beams(frame, layout, cube, detector):
    """
    Bring both images of a frame to the electrons of the right one.

    Parameters
    ----------
    frame : Frame
        With the values of the right beam's header. What contradicts them in that of the left
        beam is added to its errors.
    layout : FileLayout
        With ``beam_files``.
    cube : `~numpy.ndarray`
        Both images side by side, the left one first.
    detector : Detector
        Of the right beam.

    Returns
    -------
    detector : Detector
        With that of the left beam.
    cube : `~numpy.ndarray`
        In the unit of the right beam.

    Raises
    ------
    ObservationError
        If the header of the left beam cannot be read.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.beams import match_beams
    >>> from astropolcal.reduction.errors import detector_of
    >>> from astropolcal.reduction.frames import Frame
    >>> layout = instruments.get("vampires").files
    >>> match_beams(Frame("a_cam1.fits"), layout, np.ones((1, 8, 16)), detector_of(layout))
    Traceback (most recent call last):
    ...
    astropolcal.exceptions.ObservationError: a_cam2.fits: no such file
    """
    path = layout.left_file(frame.path)
    other = read_header(path, layout)
    frame.errors += [f"{path.name}: {error}" for error in other.errors]
    # what the plate did while the cameras were exposed must be one thing
    frame.errors += _contradictions(frame.values, other.values, path.name)
    frame.errors += _wrong_cameras(frame, other, layout)
    unit = detector.unit.to_string()
    # each camera is read out in its own way
    left = detector_of(layout, unit, other.values.get("exposure_time"), other.values)
    # to the electrons of the right one: single differences compare both beams
    if left.gain != detector.gain:
        width = cube.shape[-1] // 2
        # the left image is the first half of the columns
        factor = np.where(np.arange(cube.shape[-1]) < width, left.gain / detector.gain, 1.0)
        cube = cube * factor
    return replace(detector, left=left.in_units_of(detector)), cube


def beam_scale(path, layout, values, unit=None):
    """
    Return by what the left image is multiplied to count electrons as the right one does.

    Parameters
    ----------
    path : path-like
        The file of the right beam.
    layout : FileLayout
        How the files look.
    values : dict
        Of the header of the right beam.
    unit : str, optional
        ``BUNIT`` of the files.

    Returns
    -------
    float
        1 where one file holds both beams.

    Raises
    ------
    ObservationError
        If the file of the left beam cannot be read.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction.beams import beam_scale
    >>> beam_scale("CRSA00170808_cube.fits", instruments.get("charis").files, {})
    1.0
    """
    path = layout.left_file(path)
    if path is None:
        return 1.0
    other = read_header(path, layout).values
    gains = [detector_of(layout, unit, v.get("exposure_time"), v).gain for v in (other, values)]
    # electrons per adu on the left over those on the right
    return gains[0] / gains[1]


def _contradictions(right, left, name):
    """Return what the headers of both beams do not agree in."""
    found = []
    for column, tolerance in _COMMON.items():
        ours, theirs = right.get(column), left.get(column)
        same = ours == theirs
        if tolerance is not None and None not in (ours, theirs):
            same = abs(ours - theirs) <= tolerance
        if not same:
            found.append(f"{column} = {ours}, but {theirs} in {name}")
    return found


def _wrong_cameras(frame, other, layout):
    """Return which files are not of the camera that their names say."""
    keyword = layout.keywords.get("camera")
    return [
        f"{keyword} = {one.values['camera']:g}, its name says {mark!r}"
        for one, mark in zip((frame, other), layout.beam_files, strict=True)
        if "camera" in one.values and not mark.endswith(f"{one.values['camera']:g}")
    ]
