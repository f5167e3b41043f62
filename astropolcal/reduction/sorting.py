# Licensed under a 3-clause BSD style license - see LICENSE
"""Files of several cameras, sorted by camera and state of the modulator as headers say."""

import re
from dataclasses import replace
from pathlib import Path

from astropolcal.exceptions import ObservationError
from astropolcal.reduction.headers import observation_time, read_header

__all__ = []

# seconds; cameras may start as far apart in exposures shorter than twice that
_APART = 1.0


def sort_beams(files, layout):
    """
    Return one file per frame, the layout that knows the left one of each, and why some are lost.

    Where the names do not tell the beam, the headers do: files of the two cameras in one state of
    the modulator, of which one starts in the first half of the other, are a frame.
    """
    files = list(dict.fromkeys(str(path) for path in files))
    marks = layout.beam_files
    unknown = [path for path in files if not any(mark in Path(path).name for mark in marks)]
    if not (marks and unknown):
        return layout.frame_files(files), layout, {}
    groups, lost = _groups(unknown, layout)
    right, left = (float(re.search(r"\d+$", mark).group()) for mark in marks)
    partners = {}
    for state in dict.fromkeys(state for _, state in groups):
        lefts = groups.get((left, state), {})
        for path, (start, length) in groups.get((right, state), {}).items():
            near = {other: abs(start - lefts[other][0]) for other in lefts}
            near = {
                other: apart for other, apart in near.items() if apart <= max(length / 2, _APART)
            }
            if near:
                partners[path] = min(near, key=near.get)
                del lefts[partners[path]]
    for (camera, state), group in groups.items():
        wanted = f"camera {left if camera == right else right:g}"
        wanted += f" in state {state}" if state else ""
        words = [f"no frame of {wanted} was taken with it"]
        lost |= {path: words for path in group if path not in {*partners, *partners.values()}}
    layout = replace(layout, partners=partners)
    return [path for path in layout.frame_files(files) if path not in lost], layout, lost


def _groups(files, layout):
    """Return start and length (s) of the files of each camera and state, and why some are lost."""
    groups, lost = {}, {}
    cameras = [re.search(r"\d+$", mark).group() for mark in layout.beam_files]
    for path in files:
        try:
            frame = read_header(path, layout)
            start, why = 86400 * observation_time(frame.values).mjd, list(frame.errors)
        except ObservationError as error:
            lost[path] = [str(error).removeprefix(f"{path}: ")]
            continue
        camera, state = (frame.values.get(key) for key in ("camera", "flc_state"))
        if f"{camera or 0:g}" not in cameras:
            said = "no {}" if camera is None else "{} = " + f"{camera:g}"
            said = said.format(layout.keywords["camera"])
            why.append(f"{said} in its header; allowed are {', '.join(cameras)}")
        if why:
            lost[path] = why
            continue
        length = frame.values.get("exposure_time", 0.0) * frame.values.get("exposures", 1)
        groups.setdefault((camera, state), {})[path] = (start, length)
    if any(state for _, state in groups):
        keyword = layout.keywords["flc_state"]
        words = [f"no state of the modulator ({keyword}) in its header, which others have"]
        for key in [key for key in groups if not key[1]]:
            lost |= dict.fromkeys(groups.pop(key), words)
    return groups, lost
