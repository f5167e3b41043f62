# Licensed under a 3-clause BSD style license - see LICENSE
"""One message for every choice that is not known."""

from astropolcal.exceptions import InstrumentError


def check_choice(what, value, allowed):
    """Raise an InstrumentError if a value is not one of those allowed."""
    if value not in allowed:
        words = ", ".join(map(str, allowed)) or "none"
        raise InstrumentError(f"{what} = {value!r}; allowed are {words}")
