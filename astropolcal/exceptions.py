# Licensed under a 3-clause BSD style license - see LICENSE
"""
Every error and warning that astropolcal raises on purpose.

All errors derive from `AstropolcalError`, so that a pipeline can catch what the package objects to
in one clause; each also derives from the builtin that a Python user expects (`ValueError` for a bad
value, `KeyError` never, because it mangles its message).
"""

import warnings

from astropy.utils.exceptions import AstropyUserWarning

__all__ = [
    "AstropolcalError",
    "AstropolcalWarning",
    "CalibrationFileError",
    "ChainError",
    "FitError",
    "GapError",
    "InstrumentError",
    "ObservationError",
    "ParameterError",
    "WavelengthRangeError",
]


class AstropolcalError(Exception):
    """
    Root of every error that astropolcal raises on purpose.

    Parameters
    ----------
    *words : str
        The message.
    argument : str, optional
        Name of the argument that the message is about, where the caller may know it by
        another name, such as an option of a command.

    Examples
    --------
    >>> from astropolcal.exceptions import FitError
    >>> error = FitError("n_steps = 0; allowed are whole numbers from 1 up", argument="n_steps")
    >>> error.argument
    'n_steps'
    """

    def __init__(self, *words, argument=None):
        super().__init__(*words)
        self.argument = argument


class ParameterError(AstropolcalError, ValueError):
    """A parameter has a wrong value, unit, shape or name."""


class WavelengthRangeError(AstropolcalError, ValueError):
    """A wavelength lies outside the range in which a law is known."""


class ChainError(AstropolcalError, ValueError):
    """A compound model is not a polarization chain, or lacks what is asked."""


class ObservationError(AstropolcalError, ValueError):
    """A table of observations is missing, unreadable or inconsistent."""


class InstrumentError(AstropolcalError, ValueError):
    """An instrument is unknown, or a table does not belong to it."""


class FitError(AstropolcalError, RuntimeError):
    """A calibration could not be carried out."""


class CalibrationFileError(AstropolcalError, ValueError):
    """A calibration file is damaged, of another version, or not ours."""


class GapError(AstropolcalError, ValueError):
    """A diagnosis of the gap cannot be made, or an effect is not what it says."""


class AstropolcalWarning(AstropyUserWarning):
    """Something was masked, ignored or doubtful; the result says what."""


def warn(words, stacklevel=2):
    """Warn who called the function that calls this one, or so many levels up."""
    warnings.warn(words, AstropolcalWarning, stacklevel=stacklevel + 1)
