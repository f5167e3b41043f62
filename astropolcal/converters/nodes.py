# Licensed under a 3-clause BSD style license - see LICENSE
"""
What nodes are made of: plain values, quantities, tables, priors, posteriors; a checksum.

A prior belongs to a parameter, in any chain in which its optic stands; so the file lists priors by
the parameter's name, beside the chains. Of a posterior it keeps a part of the samples, and what the
whole run says of its convergence, its quantiles among it.

An optic is stored as its parameters, each with value, unit, fixed flag and both bounds written out,
and the settings that rebuild it (name, mount, beam and what else its class has). The position of
its stage belongs to a frame and is not stored.
"""

import datetime
import hashlib
import json
from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time

from astropolcal.calibration.posterior.samples import Posterior
from astropolcal.exceptions import AstropolcalError, CalibrationFileError, ParameterError
from astropolcal.files import one_line
from astropolcal.measurement.parameters import Normal, Uniform, parameter_table
from astropolcal.optics import OPTICS, Optic
from astropolcal.optics._modelling import FrozenNormal
from astropolcal.optics.core import with_value
from astropolcal.optics.laws import law_of

__all__ = []


def unit_text(unit):
    """Return a unit as text that `unit_from_text` understands; None stays None."""
    return None if unit is None else u.Unit(unit).to_string()


def unit_from_text(text):
    """Return the unit of `unit_text`; nothing is written in a number times a unit."""
    if text is None:
        return None
    unit = u.Unit(text)
    # astropy reads a number alone as a unit too
    if getattr(unit, "scale", 1.0) != 1.0:
        raise CalibrationFileError(
            f"unit {one_line(text, 40)!r}; a unit without a factor is needed"
        )
    return unit


def node_from_value(value):
    """Return ``value``, and ``unit`` where it has one, of a number, an array or a Quantity."""
    unit = getattr(value, "unit", None)
    # a copy, as views of one array would share a block of the file
    number = np.array(value.value if isinstance(value, u.Quantity) else value)
    node = {"value": number if number.ndim else number.item()}
    return node if unit is None else node | {"unit": unit_text(unit)}


def value_from_node(node):
    """Return the number, array or Quantity of a node that `node_from_value` made."""
    unknown = sorted(set(node) - {"name", "unit", "value"})
    if unknown:
        raise CalibrationFileError(f"a value with {unknown[0]!r}, which means nothing here")
    value = np.array(node["value"])
    if "unit" in node:
        return value * unit_from_text(node["unit"])
    # a number of its own type, as it was given
    return value if value.ndim else value.item()


def node_from_table(table):
    """Return the node of a table, a list of its columns in their order; None stays None."""
    if table is None:
        return None
    return [{"name": name} | node_from_value(table[name]) for name in table.colnames]


def table_from_node(node):
    """Return the `~astropy.table.QTable` of a node that `node_from_table` made."""
    if node is None:
        return None
    columns = by_name(node, what="column ").items()
    return QTable({name: value_from_node(column) for name, column in columns})


def by_name(entries, key="name", what=""):
    """Return entries by name; of two of one name only one would be left."""
    names = [entry[key] for entry in entries]
    for name in names:
        if names.count(name) > 1:
            raise CalibrationFileError(f"{what}{name!r} is given twice")
    return dict(zip(names, entries, strict=True))


def plain(value, where="value"):
    """Return a value as ASDF stores it: numbers, text, lists, mappings, quantities.

    Dates and times become ISO text, tuples lists, numpy's numbers Python's; ``where`` is for the
    message.
    """
    if isinstance(value, dict):
        return {str(key): plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if hasattr(value, "__array__") and not isinstance(value, (np.ndarray, np.generic)):
        # an array that ASDF reads when it is asked for
        value = np.asarray(value)
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        # a copy: views of one array would share a block
        return value.copy() if value.ndim or isinstance(value, u.Quantity) else value.item()
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, (datetime.date, datetime.datetime)):
        return value.isoformat()
    if isinstance(value, Time):
        return plain(value.isot, where)
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    raise CalibrationFileError(
        f"{where} is a {type(value).__name__}, which files cannot hold; allowed are "
        "numbers, text, dates, quantities, arrays, lists and mappings"
    )


# ---- the checksum ------------------------------------------------------------------


def checksum(node):
    """Return the SHA-256 of the content of a node, however a file spells it.

    Equal for equal bits, regardless of the order of the keys and whether arrays are inline or in
    blocks. Optics, and models that parameters follow, are such nodes themselves.
    """
    # the order of keys in YAML means nothing
    text = json.dumps(_spelled(node), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _spelled(node):
    if isinstance(node, dict):
        return {str(key): _spelled(item) for key, item in node.items()}
    if isinstance(node, (list, tuple)):
        return [_spelled(item) for item in node]
    if isinstance(node, u.Quantity):
        return {"quantity": _spelled(node.value), "unit": unit_text(node.unit)}
    if isinstance(node, float):
        # all bits, where a decimal text might round
        return {"float": float(node).hex()}
    if node is None or isinstance(node, (str, int)):
        return node
    if hasattr(node, "__array__"):
        array = np.asarray(node)
        if array.dtype.kind == "f":
            # YAML knows one not-a-number only, floats have many
            array = np.where(np.isnan(array), np.nan, array)
        # of the same bytes on machines of either order; a block in a file may have any
        array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).reshape(
            array.shape
        )
        return {"array": array.tobytes().hex(), "type": array.dtype.str, "shape": list(array.shape)}
    return _spelled(spelled_optic(node) if isinstance(node, Optic) else spelled_model(node))


# ---- priors in a calibration file ----


_OURS = {"normal": (Normal, "mean", "std"), "uniform": (Uniform, "low", "high")}


def node_from_priors(chains):
    """Return the priors of the chains' parameters: ``parameter``, ``kind`` and their numbers.

    Normal, Uniform and frozen continuous distributions of `scipy.stats` are allowed.
    """
    # one entry a parameter: chains share the optics that stand in several of them
    return [
        {"parameter": name} | prior_node(parameters[0].prior, name)
        for name, parameters in parameter_table(chains).items()
        if parameters[0].prior is not None
    ]


def prior_node(prior, name):
    """Return the node of a prior."""
    for kind, (cls, *keys) in _OURS.items():
        if type(prior) is cls:
            return {"kind": kind} | {key: node_from_value(getattr(prior, key)) for key in keys}
    node = {
        "distribution": getattr(getattr(prior, "dist", None), "name", None),
        "args": plain(list(getattr(prior, "args", ())), f"prior of {name}"),
        "kwds": plain(dict(getattr(prior, "kwds", {})), f"prior of {name}"),
    }
    try:
        _frozen(node)
    except (TypeError, ValueError):
        raise CalibrationFileError(
            f"prior of {name} is a {type(prior).__name__}, which files cannot hold; allowed are "
            "Normal, Uniform and frozen continuous distributions of scipy.stats"
        ) from None
    return {"kind": "scipy"} | node


def _frozen(node):
    """Return the distribution of a node; only those of scipy can be named."""
    name, args, kwds = node["distribution"], node["args"], node["kwds"]
    if (name, len(args), kwds) == ("norm", 2, {}):
        found = FrozenNormal(*args)
    else:
        import scipy.stats

        # names of modules and functions are there too: only distributions pass the next line
        family = getattr(scipy.stats, name, None) if isinstance(name, str) else None
        if not isinstance(family, scipy.stats.rv_continuous):
            raise ValueError(f"scipy.stats has no continuous distribution {name!r}")
        found = family(*args, **kwds)
    # scipy looks at the parameters when they are used, and gives NaN for those that cannot be
    low, high = found.support()
    if not low < high:
        raise ValueError(f"{name} of {node['args']} and {node['kwds']} is not a distribution")
    return found


def without_priors(chain):
    """Return a copy of a chain whose parameters have no priors."""
    copy = chain.copy()
    for parameters in parameter_table([copy]).values():
        for parameter in parameters:
            parameter.prior = None
    return copy


def restore_priors(chains, nodes):
    """Give the parameters of chains the priors that `node_from_priors` wrote."""
    table = parameter_table(chains)
    for name, node in by_name(nodes, "parameter", "prior of ").items():
        if name not in table:
            raise CalibrationFileError(f"prior of {name!r}, which no chain has")
        for parameter in table[name]:
            parameter.prior = prior_from_node(node, name)


def prior_from_node(node, name):
    """Return the prior of a node."""
    try:
        if node["kind"] == "scipy":
            return _frozen(plain(node))
        cls, *keys = _OURS[node["kind"]]
        values = [value_from_node(node[key]) for key in keys]
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CalibrationFileError(f"prior of {name}: {one_line(error)}") from None
    return cls(*values)


# ---- samples of a posterior in a calibration file ----


# for those who look into the file
_DERIVED = ("converged", "words", "kept")


def node_from_posterior(posterior):
    """Return the node of a posterior, thinned if it is not yet."""
    kept = posterior if posterior.is_thinned else posterior.thinned()
    parts = kept.to_dict()
    # what was thinned has no burn-in any more
    del parts["burn_in"]
    return {
        **plain(parts, "posterior"),
        "units": [unit_text(unit) for unit in kept.units],
        "converged": kept.converged,
        "words": kept.words(),
        "kept": kept.kept_words(),
    }


def posterior_from_node(node):
    """Return the thinned posterior that a node, which obeys the schema, stores."""
    parts = {key: value for key, value in node.items() if key not in _DERIVED}
    # copies of our own: what ASDF gives may be tied to the file
    for key in ("chain", "log_prob", "acceptance", "fitted"):
        parts[key] = None if parts[key] is None else np.array(parts[key])
    found = {
        key: np.array(value) if hasattr(value, "__array__") else value
        for key, value in parts["convergence"].items()
    }
    # that of what did not move is not a number
    if np.isinf(found["times"]).any():
        raise CalibrationFileError("posterior: times must be finite")
    parts |= {"settings": plain(parts["settings"]), "convergence": found, "burn_in": None}
    try:
        return Posterior.from_dict(parts)
    except AstropolcalError as error:
        raise CalibrationFileError(f"posterior: {error}") from None


def check_posterior(posterior, covariance):
    """Check a posterior against the free parameters of its calibration."""
    if posterior is None:
        return
    units = dict(zip(covariance.names, covariance.units, strict=True))
    if len(set(posterior.names)) < len(posterior.names):
        raise CalibrationFileError("posterior: a parameter is named twice")
    for name, unit in zip(posterior.names, posterior.units, strict=True):
        if name not in units:
            raise CalibrationFileError(f"posterior of {name!r}, which is not a free parameter")
        if unit != units[name]:
            raise CalibrationFileError(
                f"posterior of {name} is in {unit}, allowed is {units[name]}"
            )
    for what, values in (("samples", posterior.chain), ("log_prob", posterior.log_prob)):
        if not values.size or not np.isfinite(values).all():
            raise CalibrationFileError(f"posterior: {what} must be finite, and some")


# ---- optics, written ---------------------------------------------------------------------


def node_from_optic(optic):
    """Return the node of an optic, of a class in `astropolcal.optics.OPTICS`."""
    refuse_foreign(optic)
    return spelled_optic(optic)


def _is_foreign(optic):
    # a class of the same name from elsewhere would be read back as ours
    return OPTICS.get(type(optic).__name__) is not type(optic)


def refuse_foreign(optic):
    """Raise for an optic of a class that files cannot hold."""
    if _is_foreign(optic):
        cls = type(optic)
        raise CalibrationFileError(
            f"optic {optic.name or 'without a name'!r} is a {cls.__module__}.{cls.__qualname__}, "
            f"which files cannot hold; allowed are {', '.join(OPTICS)}"
        )


def spelled_optic(optic):
    """Return what a checksum says of an optic, which is its node if files can hold it."""
    cls = type(optic)
    if _is_foreign(optic):
        settings = {"class": f"{cls.__module__}.{cls.__qualname__}", "text": optic.fingerprint()}
    else:
        settings = {key: value for key, value in optic._settings().items() if value is not None}
    return settings | {"parameters": {key: _parameter_node(optic, key) for key in cls.param_names}}


def spelled_model(model):
    """Return what a checksum says of a model that a parameter follows."""
    if hasattr(model, "op"):
        return {"op": model.op, "parts": [spelled_model(model.left), spelled_model(model.right)]}
    values = {name: np.ravel(getattr(model, name).value) for name in model.param_names}
    # what is not there, and what a file does not say, is not a number
    domains = (getattr(model, key, None) for key in ("domain", "x_domain", "y_domain"))
    limits = [np.array([np.nan] if x is None else x, dtype=float) for x in domains]
    known = {"model": type(model).__name__, "parameters": values, "domains": limits}
    # checksums of before did not know of windows, hardly any of which is not the default
    windows = {key: getattr(model, key, None) for key in ("window", "x_window", "y_window")}
    windows = {k: np.array(x, dtype=float) for k, x in windows.items() if x not in (None, (-1, 1))}
    return known | ({"windows": windows} if windows else {})


def _parameter_node(optic, key):
    parameter = getattr(optic, key)
    label = f"{optic._label}.{key}"
    if parameter.tied:
        raise CalibrationFileError(
            f"{label} has a callable 'tied', which files cannot hold; use ties={{...: Tie(...)}} "
            "of calibrate"
        )
    declared = optic._declared(key).unit
    if parameter.unit != declared:
        raise CalibrationFileError(f"{label} is in {parameter.unit}, allowed is {declared}")
    # astropy gives the value of an array of one as a number
    value = np.array(np.reshape(parameter.value, parameter.shape), dtype=float)
    if value.ndim > 1 or not np.isfinite(value).all():
        raise CalibrationFileError(
            f"{label} = {value} must be a finite number, or one per wavelength"
        )
    node = {"value": (value if value.ndim else float(value))}
    if declared is not None:
        node["unit"] = declared.to_string()
    # a fit makes a number of an array of one
    if parameter.grid is not None and value.ndim:
        node["wavelength"] = np.array(parameter.grid)
    bounds = [None if bound is None else float(bound) for bound in parameter.bounds]
    node |= {"fixed": bool(parameter.fixed), "bounds": bounds}
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


# ---- optics, read ---------------------------------------------------------------------


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
    if "law" not in entry:
        return
    node, label = entry["law"], f"{optic.name}.{key}"
    own = node["coefficients"]
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
