# Licensed under a 3-clause BSD style license - see LICENSE
"""
What our models do differently from those of astropy: keywords only, settings, and cheap copies.

Copies touch what `astropy.modeling` keeps private, the dictionaries of models and parameters: a
calibration copies chains and measurements thousands of times, and a deep copy of everything takes
five times as long. Nothing else in the package does.
"""

import inspect
from copy import copy, deepcopy

import astropy.units as u
from astropy.modeling import FittableModel, Parameter

# what a copy of an optic may share with it
_SHARED = (str, bool, int, float, type(None), u.UnitBase)


class Setting:
    """
    A keyword of an optic other than its parameters, with a default, checked whenever it is set.

    ``check(value, name)`` returns what is kept, of a setting ``beam`` in ``_beam``, or raises.
    """

    def __init__(self, default, check, doc):
        self.default, self.check, self.__doc__ = default, check, doc

    def __set_name__(self, owner, name):
        self.name = name

    def __get__(self, optic, owner=None):
        return self if optic is None else optic.__dict__[f"_{self.name}"]

    def __set__(self, optic, value):
        checked = self.check(value, f"{type(optic).__name__}.{self.name}")
        optic.__dict__[f"_{self.name}"] = checked


class KeywordOnly(type(FittableModel)):
    """Keeps astropy from giving each optic an ``__init__`` with positional parameters."""

    def __init__(cls, name, bases, members, **kwargs):
        # astropy's metaclass writes an __init__ for every class whose members have none
        super().__init__(name, bases, {"__init__": cls.__init__} | members, **kwargs)
        # those of the bases first
        cls._declared_settings = {
            key: setting
            for base in reversed(cls.__mro__)
            for key, setting in vars(base).items()
            if isinstance(setting, Setting)
        }
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
        found |= {key: setting.default for key, setting in cls._declared_settings.items()}
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


def with_own_scalars(model, labels):
    """Return a copy of a model that shares everything but its scalar parameters, by their names."""
    new = model.__class__.__new__(model.__class__)
    new.__dict__.update(model.__dict__)
    # where astropy keeps values and constraints beside the parameters
    for key in ("_parameters", "_mconstraints", "_constraints_cache", "_user_inverse", "_meta"):
        if key in model.__dict__:
            new.__dict__[key] = copy(model.__dict__[key])
    for label in labels:
        parameter = copy(model.__dict__[label])
        parameter.model = new
        new.__dict__[label] = parameter
        parameter.value = float(model.__dict__[label].value)
    return new
