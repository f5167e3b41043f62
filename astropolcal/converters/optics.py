# Licensed under a 3-clause BSD style license - see LICENSE
"""
Nodes of optics.

An optic is stored as its parameters, each with value, unit, fixed flag and both bounds written out,
and the settings that rebuild it (name, mount, beam and what else its class has). The position of
its stage belongs to a frame and is not stored.
"""

import astropy.units as u
import numpy as np

from astropolcal.converters.nodes import prior_from_node, prior_node
from astropolcal.exceptions import CalibrationFileError, ParameterError
from astropolcal.optics import OPTICS

__all__ = []


# ---- writing ---------------------------------------------------------------------


def node_from_optic(optic):
    """Return the node of an optic, of a class in `astropolcal.optics.OPTICS`."""
    _check_class(optic)
    settings = {key: value for key, value in optic._settings().items() if value is not None}
    return settings | {
        "parameters": {key: _parameter_node(optic, key) for key in optic.param_names}
    }


def _check_class(optic):
    cls = type(optic)
    # a class of the same name from elsewhere would be read back as ours
    if OPTICS.get(cls.__name__) is not cls:
        raise CalibrationFileError(
            f"optic {optic.name or 'without a name'!r} is a {cls.__module__}.{cls.__qualname__}, "
            f"which files cannot hold; allowed are {', '.join(OPTICS)}"
        )


def _parameter_node(optic, key):
    parameter = getattr(optic, key)
    label = f"{optic.name or type(optic).__name__}.{key}"
    if parameter.tied:
        raise CalibrationFileError(
            f"{label} has a callable 'tied', which files cannot hold; use ties={{...: Tie(...)}} "
            "of calibrate"
        )
    declared = optic._declared(key).unit
    if parameter.unit != declared:
        raise CalibrationFileError(f"{label} is in {parameter.unit}, allowed is {declared}")
    # astropy gives the value of an array of one as a number
    node = {"value": _stored(np.reshape(parameter.value, parameter.shape), label)}
    if declared is not None:
        node["unit"] = declared.to_string()
    if parameter.grid is not None:
        node["wavelength"] = np.array(parameter.grid)
    node |= {"fixed": bool(parameter.fixed), "bounds": _bounds(parameter)}
    known = {} if parameter.prior is None else {"prior": prior_node(parameter.prior, label)}
    return node | known


def _stored(value, label):
    value = np.array(value, dtype=float)
    if value.ndim > 1 or not np.isfinite(value).all():
        raise CalibrationFileError(
            f"{label} = {value} must be a finite number, or one per wavelength"
        )
    return value if value.ndim else float(value)


def _bounds(parameter):
    return [None if bound is None else float(bound) for bound in parameter.bounds]


# ---- reading ---------------------------------------------------------------------


def optic_from_node(name, node):
    """Return the optic of the class ``name`` that a node, which obeys the schema, stores."""
    # an optic that is on no stage says so: the default of some is another
    settings = {"mount": None} | {key: value for key, value in node.items() if key != "parameters"}
    values = {key: _value(entry) for key, entry in node["parameters"].items()}
    try:
        optic = OPTICS[name](**values, **settings)
    except ParameterError as error:
        label = repr(node.get("name", "without a name"))
        raise CalibrationFileError(f"optic {label}: {error}") from None
    # not through the class: its defaults may fix or bound otherwise than the calibration did
    for key, entry in node["parameters"].items():
        parameter = getattr(optic, key)
        parameter.fixed = entry["fixed"]
        parameter.bounds = tuple(entry["bounds"])
        if "wavelength" in entry:
            parameter.wavelength = np.array(entry["wavelength"]) * u.um
        if "prior" in entry:
            parameter.prior = prior_from_node(entry["prior"], f"{node.get('name')}.{key}")
    return optic


def _value(entry):
    value = np.array(entry["value"], dtype=float)
    return value * u.Unit(entry["unit"]) if "unit" in entry else value
