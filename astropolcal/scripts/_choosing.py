# Licensed under a 3-clause BSD style license - see LICENSE
"""Which calibration a night of frames is corrected with, and which of its chains."""

from dataclasses import dataclass, field
from pathlib import Path

import astropy.units as u

from astropolcal.exceptions import AstropolcalError, CalibrationFileError, ObservationError

# by what a library may ask for
_OPTIONS = {
    "instrument": "--instrument NAME",
    "mode": "--filter MODE",
    "optics_in": "--optics-in NAME,NAME,...",
}
# what a user can do about frames that do not say enough
_WAYS = {
    "date": "--any-date takes it all the same",
    "mode": "--filter {}",
    "other date": "; --any-date takes it all the same",
}


@dataclass
class Night:
    """What the headers tell: date (or None) of each frame, and mode and optics of all."""

    moments: dict
    mode: str | None = None
    beam: dict = field(default_factory=dict)

    @property
    def dates(self):
        """Dates of the first and the last frame."""
        # ISO dates sort as text; a calibration that holds at both ends holds between them
        known = sorted(date for date in self.moments.values() if date)
        return list(dict.fromkeys((known[0], known[-1]))) if known else []


def read_night(files, instrument, raw=None):
    """Return what headers tell; refuse frames that differ in their mode or optics."""
    from astropolcal.fitscheck import primary_header
    from astropolcal.pipeline.headers import told_beam
    from astropolcal.reduction.headers import observation_time, read_header

    layout = instrument.files
    if layout is None:
        raise AstropolcalError(f"{instrument.name}: it is not known how its files look")
    # which keywords there are may depend on the mode
    layout = configured(instrument, files).files
    moments, modes, headers = {}, {}, []
    for file in files:
        frame = read_header(file, layout, raw=raw)
        if frame.values.get("filter"):
            # the first file of each mode, to be named
            modes.setdefault(frame.values["filter"], file)
        try:
            moments[str(file)] = observation_time(frame.values).isot
        except ObservationError:
            # whether it is needed depends on the calibration
            moments[str(file)] = None
        headers.append(primary_header(file))
    if len(modes) > 1:
        (one, first), (other, second) = list(modes.items())[:2]
        raise ObservationError(f"{first} is in mode {one!r}, {second} in {other!r}: correct apart")
    return Night(moments, next(iter(modes), None), told_beam(headers, instrument, files))


def configured(instrument, files):
    """Return the instrument as the first file's header says; as it is if that cannot be read."""
    from astropolcal.fitscheck import primary_header

    try:
        header = primary_header(files[0])
    except (ObservationError, IndexError):
        return instrument
    # wavelengths and shape of the cubes may depend on it
    return instrument.configured(header)


def choose_calibration(arguments, files, raw=None):
    """
    Return the calibration of the frames, its chain and what is said of where it comes from.

    A file that says itself that it does not hold for the frames is refused like one in a library,
    unless the user wants it for any date.
    """
    from astropolcal import Calibration, instruments
    from astropolcal.converters.calibration import content_hash
    from astropolcal.correction.rows import sky_chain

    path = Path(arguments.calibration)
    # a folder is searched when it is known what the frames need
    calibration = None if path.is_dir() else Calibration.read(path)
    name = arguments.instrument or getattr(calibration, "instrument", None) or "charis"
    night = read_night(files, instruments.get(name), raw)
    # what the user says goes before what headers tell
    beam = night.beam if arguments.optics_in is None else {}
    if calibration is None:
        entry = _of_library(path, arguments, night, beam, files)
        calibration, path = entry.calibration, entry.path
    _check_validity(calibration, path, arguments, night)
    chain = sky_chain(
        calibration,
        optics_in=arguments.optics_in,
        beam=beam,
        label=str(path),
        date=night.dates or None,
    )
    return (
        calibration,
        chain,
        {"calibration": str(path), "calibration_hash": content_hash(calibration)},
    )


def _check_validity(calibration, path, arguments, night):
    """Refuse frames for which the calibration does not hold, unless the user wants it."""
    from astropolcal.pipeline.headers import check_frames

    # --filter names the mode as the file does, whatever the headers call it
    mode = arguments.filter or night.mode
    frames = [(file, date, mode) for file, date in night.moments.items()]
    max_age = None if arguments.max_age is None else arguments.max_age * u.yr
    options = {"max_age": max_age, "ways": _WAYS, "dates": not arguments.any_date}
    check_frames(calibration, frames, str(path), **options)


def _of_library(path, arguments, night, beam, files):
    """Return the calibration that holds for the first and the last frame."""
    from astropolcal.pipeline.library import Library

    # None: the library chooses without a date
    dates = [None] if arguments.any_date else night.dates
    if not dates:
        raise ObservationError(f"{files[0]}: no date in its header to choose a calibration by")
    library, mode = Library(path), arguments.filter or night.mode
    wanted = {"mode": mode, "optics_in": arguments.optics_in, "beam": beam}
    try:
        found = [library.find(arguments.instrument, date=date, **wanted) for date in dates]
    except CalibrationFileError as error:
        # the library names what it needs, a user types options
        hint = f" ({_OPTIONS[error.argument]})" if error.argument in _OPTIONS else ""
        raise CalibrationFileError(f"{error}{hint}") from error
    # a night across the change of a calibration
    if len({str(entry.path) for entry in found}) > 1:
        raise AstropolcalError(
            f"{path}: the frames from {dates[0]} to {dates[-1]} need two calibrations, "
            f"{found[0].path} and {found[1].path}: correct them apart"
        )
    return found[0]
