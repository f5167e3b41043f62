# Licensed under a 3-clause BSD style license - see LICENSE
"""
Nodes of optics.

An optic is stored as its parameters, each with value, unit, fixed flag and both bounds written out,
and the settings that rebuild it (name, mount, beam and what else its class has). The position of
its stage belongs to a frame and is not stored.
"""

from dataclasses import replace

import astropy.units as u
import numpy as np

from astropolcal.converters.nodes import prior_from_node, prior_node
from astropolcal.exceptions import CalibrationFileError, ParameterError
from astropolcal.optics import OPTICS
from astropolcal.optics.core import with_value
from astropolcal.optics.laws import law_of

__all__ = []


# ---- writing ---------------------------------------------------------------------


def node_from_optic(optic):
    """Return the node of an optic, of a class in `astropolcal.optics.OPTICS`."""
    cls = type(optic)
    # a class of the same name from elsewhere would be read back as ours
    if OPTICS.get(cls.__name__) is not cls:
        raise CalibrationFileError(
            f"optic {optic.name or 'without a name'!r} is a {cls.__module__}.{cls.__qualname__}, "
            f"which files cannot hold; allowed are {', '.join(OPTICS)}"
        )
    settings = {key: value for key, value in optic._settings().items() if value is not None}
    return settings | {
        "parameters": {key: _parameter_node(optic, key) for key in type(optic).param_names}
    }


def spelled_model(model):
    """Return what a checksum says of a model that a parameter follows."""
    if hasattr(model, "op"):
        return {"op": model.op, "parts": [spelled_model(model.left), spelled_model(model.right)]}
    values = {name: np.ravel(getattr(model, name).value) for name in model.param_names}
    # what is not there, and what a file does not say, is not a number
    domains = (getattr(model, key, None) for key in ("domain", "x_domain", "y_domain"))
    limits = [np.array([np.nan] if x is None else x, dtype=float) for x in domains]
    return {"model": type(model).__name__, "parameters": values, "domains": limits}


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
    value = np.reshape(parameter.value, parameter.shape)
    value = np.array(value, dtype=float)
    if value.ndim > 1 or not np.isfinite(value).all():
        raise CalibrationFileError(
            f"{label} = {value} must be a finite number, or one per wavelength"
        )
    node = {"value": (value if value.ndim else float(value))}
    if declared is not None:
        node["unit"] = declared.to_string()
    if parameter.grid is not None:
        node["wavelength"] = np.array(parameter.grid)
    node |= {"fixed": bool(parameter.fixed), "bounds": _bounds(parameter)}
    known = {} if parameter.prior is None else {"prior": prior_node(parameter.prior, label)}
    return node | known | _law_node(optic, key)


def _law_node(optic, key):
    law = optic._follows.get(key)
    if law is None:
        return {}
    names = zip(law.model.param_names, law.names(key), strict=True)
    node = {
        "model": law.model,
        "of": list(law.of),
        "known": {name: list(map(float, ends)) for name, ends in law.known.items()},
        "coefficients": {name: _parameter_node(optic, label) for name, label in names},
    }
    return {"law": node if law.since is None else node | {"since": law.since}}


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
    for key, entry in node["parameters"].items():
        _restore(optic, key, entry)
    return optic


def _restore(optic, key, entry):
    """Give a parameter what its node says of it beside the value."""
    # not through the class: its defaults may fix or bound otherwise than the calibration did
    parameter = getattr(optic, key)
    parameter.fixed = entry["fixed"]
    parameter.bounds = tuple(entry["bounds"])
    if "wavelength" in entry:
        parameter.wavelength = np.array(entry["wavelength"]) * u.um
    if "prior" in entry:
        parameter.prior = prior_from_node(entry["prior"], f"{optic.name}.{key}")
    if "law" in entry:
        _restore_law(optic, key, entry["law"])


def _restore_law(optic, key, node):
    label, own = f"{optic.name}.{key}", node["coefficients"]
    try:
        unit = optic._declared(key).unit
        law, found = law_of(label, unit, node["model"], node["of"], node.get("since"))
        if set(own) != set(found):
            raise ParameterError(f"{label}: its law has {', '.join(found)}")
        new = [with_value(found[name], _value(own[name])) for name in found]
    except ParameterError as error:
        raise CalibrationFileError(f"law of {error}") from None
    known = {name: tuple(ends) for name, ends in node["known"].items()}
    optic._follow(key, replace(law, known=known), new)
    for name, place in zip(found, law.names(key), strict=True):
        _restore(optic, place, own[name])


def _value(entry):
    value = np.array(entry["value"], dtype=float)
    return value * u.Unit(entry["unit"]) if "unit" in entry else value
