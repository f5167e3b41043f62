# Licensed under a 3-clause BSD style license - see LICENSE
"""What optics do otherwise than the models of astropy: keywords only, and cheap copies."""

import inspect
from copy import deepcopy

import astropy.units as u
from astropy.modeling import FittableModel, Parameter

# what a copy of an optic may share with it
_SHARED = (str, bool, int, float, type(None), u.UnitBase)


class KeywordOnly(type(FittableModel)):
    """Keeps astropy from giving each optic an ``__init__`` with positional parameters."""

    def __init__(cls, name, bases, members, **kwargs):
        # astropy's metaclass writes an __init__ for every class whose members have none
        super().__init__(name, bases, {"__init__": cls.__init__} | members, **kwargs)
        cls.__signature__ = inspect.Signature(
            [
                inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default)
                for key, default in cls._keywords().items()
            ]
        )

    def _keywords(cls):
        """Return every keyword that the optic takes, with its default."""
        found = {}
        # theta is declared first, in the base, and is what a user gives last
        for key in (*cls.param_names[1:], "theta"):
            parameter = inspect.getattr_static(cls, key)
            unit = parameter.unit
            found[key] = parameter.default if unit is None else parameter.default * unit
        for base in cls.__mro__:
            if isinstance(base, KeywordOnly):
                found |= getattr(base.__init__, "__kwdefaults__", None) or {}
        return found


def copied_attributes(optic, new, memo):
    """
    Fill a new optic with copies of what an optic holds.

    Chains are copied often; this is five times faster than copying every attribute.
    """
    for key, value in optic.__dict__.items():
        if isinstance(value, Parameter):
            new.__dict__[key] = memo[id(value)] = _copied_parameter(value, new, memo)
        elif isinstance(value, _SHARED):
            new.__dict__[key] = value
        else:
            new.__dict__[key] = deepcopy(value, memo)


def _copied_parameter(parameter, model, memo):
    new = parameter.__class__.__new__(parameter.__class__)
    for key, value in parameter.__dict__.items():
        plain = value is None or isinstance(value, _SHARED)
        new.__dict__[key] = value if plain else model if key == "_model" else deepcopy(value, memo)
    return new
