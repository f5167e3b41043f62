# Licensed under a 3-clause BSD style license - see LICENSE
"""A journal of the files that are done, so that a run can go on where it stopped."""

import hashlib
import json
import os
from contextlib import suppress
from pathlib import Path

from astropolcal.exceptions import ObservationError
from astropolcal.files import append_line, understood
from astropolcal.reduction.frames import Frame

__all__ = ["Journal"]

# what a line raises that was cut off, or is no frame
_DAMAGE = (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError)
_DAMAGE += (RecursionError,)


def _frame(content):
    """Return a frame that has what a frame has, or raise."""
    frame = Frame.from_dict(content)
    if not isinstance(frame.path, str) or not isinstance(frame.values, dict):
        raise TypeError("a frame has a path, and values by name")
    for texts in (frame.errors, frame.doubts):
        if not isinstance(texts, list) or not all(isinstance(text, str) for text in texts):
            raise TypeError("errors and doubts are lists of texts")
    frame.to_dict()
    return frame


class Journal:
    """
    Results of files as lines of JSON, written as they come.

    A file counts as done if its name, size and time of change and the settings
    are those of the journal. A line that was cut off is ignored.

    Parameters
    ----------
    path : path-like or None
        The journal; None keeps none.
    settings : dict
        What the results depend on besides the files.

    Raises
    ------
    ObservationError
        If it cannot be read or written, or is something else.

    Examples
    --------
    >>> from astropolcal.reduction.journal import Journal
    >>> Journal(None, {}).done("CRSA00170808_cube.fits") is None
    True
    """

    def __init__(self, path, settings):
        self.path = None if path is None else Path(path)
        text = json.dumps(settings, sort_keys=True, default=repr)
        self._settings = hashlib.sha256(text.encode()).hexdigest()[:16]
        self._is_cut = False
        self._known = {} if self.path is None else self._read()

    def _read(self):
        if not os.path.exists(self.path):
            return {}
        with understood(self.path, ObservationError, "cannot be read as a journal"):
            text = self.path.read_text(encoding="utf-8")
        lines, known = text.splitlines(), {}
        self._is_cut = not text.endswith("\n") and bool(text)
        for line in lines:
            # a line may have been cut off when a run was stopped
            with suppress(*_DAMAGE):
                entry = json.loads(line)
                known[str(entry["key"])] = _frame(entry["frame"])
        if lines and not known:
            raise ObservationError(f"{self.path}: not a journal of a reduction; take another name")
        return known

    def _key(self, path):
        try:
            state = os.stat(path)
        except (OSError, ValueError):
            return None
        return f"{Path(path).resolve()}|{state.st_size}|{state.st_mtime_ns}|{self._settings}"

    def done(self, path):
        """Return the frame of a file that is done, else None."""
        return self._known.get(self._key(path))

    def add(self, frame):
        """Write down a frame."""
        key = self._key(frame.path)
        if self.path is None or key is None:
            return
        # a line that was cut off ends here
        start, self._is_cut = "\n" if self._is_cut else "", False
        line = json.dumps({"key": key, "frame": frame.to_dict()})
        append_line(self.path, start + line, ObservationError)
