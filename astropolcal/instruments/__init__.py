# Licensed under a 3-clause BSD style license - see LICENSE
"""
Instruments, found by name.

An instrument is a subclass of `Instrument`. Other packages add theirs
through the entry-point group ``astropolcal.instruments``.
"""

from importlib.metadata import entry_points

from astropolcal.exceptions import InstrumentError
from astropolcal.files import one_line
from astropolcal.instruments import base, charis, irdis, layout, vampires
from astropolcal.instruments.base import *
from astropolcal.instruments.charis import *
from astropolcal.instruments.irdis import *
from astropolcal.instruments.layout import *
from astropolcal.instruments.nominal import NOMINAL
from astropolcal.instruments.vampires import *
from astropolcal.words import did_you_mean

_PARTS = (base, charis, irdis, layout, vampires)
__all__ = sorted(["get", "names", "register", *(n for part in _PARTS for n in part.__all__)])

_REGISTRY = {}


def register(cls):
    """
    Add an instrument class to the registry.

    Parameters
    ----------
    cls : type
        Subclass of `Instrument` with a ``name``.

    Returns
    -------
    type
        The class, so that this can be a decorator.

    Raises
    ------
    InstrumentError
        If the name is missing or taken.

    Examples
    --------
    >>> from astropolcal.instruments import names
    >>> "charis" in names()
    True
    """
    if not (isinstance(cls, type) and issubclass(cls, base.Instrument) and cls.name):
        raise InstrumentError(f"{cls!r} is not an Instrument with a name")
    if _REGISTRY.get(cls.name, cls) is not cls:
        raise InstrumentError(f"an instrument {cls.name!r} is registered already")
    _REGISTRY[cls.name] = cls
    return cls


def names():
    """
    Return the names of all instruments, plug-ins included.

    Examples
    --------
    >>> from astropolcal.instruments import names
    >>> "charis" in names()
    True
    """
    return sorted(
        {*_REGISTRY, *(point.name for point in entry_points(group="astropolcal.instruments"))}
    )


def get(name):
    """
    Return an instrument by its name or an alias.

    Parameters
    ----------
    name : str
        Such as ``"charis"`` or ``"SCExAO/CHARIS"``; case does not matter.

    Returns
    -------
    Instrument

    Raises
    ------
    InstrumentError
        If it is unknown; the message names near matches, and installed instruments that cannot
        be loaded.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> instruments.get("SCExAO/CHARIS").name
    'charis'
    """
    for cls in _REGISTRY.values():
        if cls().answers_to(str(name)):
            return cls()
    broken = []
    for point in entry_points(group="astropolcal.instruments"):
        try:
            instrument = register(point.load())()
            # `names` lists it by the name of its entry point, which may be another
            asked = instrument.answers_to(str(name)) or point.name == name
        except Exception as error:  # whatever another package raises when it is imported
            why = one_line(f"{type(error).__name__}: {error}", 100)
            broken.append(f"; {one_line(repr(point.name), 40)} cannot be loaded: {why}")
            continue
        if asked:
            return instrument
    # one that cannot be loaded is no suggestion
    near = [known for known in names() if known != str(name).lower()]
    hint = did_you_mean(str(name).lower(), near)
    # what other packages say of themselves has no bounds
    first, *rest = [*dict.fromkeys(broken), ""]
    more = f" (and {len(rest) - 1} more)" if len(rest) > 1 else ""
    raise InstrumentError(
        f"unknown instrument {one_line(repr(name), 60)}; known are "
        f"{one_line(', '.join(names()))}{hint}{first}{more}"
    )


for _cls in (charis.CHARIS, irdis.IRDIS, vampires.VAMPIRES, *NOMINAL):
    register(_cls)
