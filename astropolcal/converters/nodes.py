# Licensed under a 3-clause BSD style license - see LICENSE
"""
What all nodes are made of: plain values, quantities, tables, and a checksum.
"""

import datetime
import hashlib
import json

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time

from astropolcal.exceptions import CalibrationFileError
from astropolcal.files import one_line

__all__ = [
    "checksum",
    "node_from_table",
    "node_from_value",
    "plain",
    "table_from_node",
    "unit_from_text",
    "unit_text",
    "value_from_node",
]


def unit_text(unit):
    """
    Return a unit as text that `unit_from_text` understands; None stays None.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.converters.nodes import unit_text
    >>> unit_text(u.deg)
    'deg'
    """
    return None if unit is None else u.Unit(unit).to_string()


def unit_from_text(text):
    """
    Return the unit that `unit_text` wrote.

    Raises
    ------
    CalibrationFileError
        If it is a number times a unit, such as ``"1e-3 deg"``, which nothing is written in.

    Examples
    --------
    >>> from astropolcal.converters.nodes import unit_from_text
    >>> unit_from_text("mm")
    Unit("mm")
    """
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
    """
    Return the node of a number, an array or a Quantity.

    Parameters
    ----------
    value : float, `~numpy.ndarray` or `~astropy.units.Quantity`
        Of any shape.

    Returns
    -------
    dict
        ``value``, and ``unit`` where it has one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.converters.nodes import node_from_value
    >>> node_from_value(1.5 * u.deg)
    {'value': 1.5, 'unit': 'deg'}
    """
    unit = getattr(value, "unit", None)
    # a copy, as views of one array would share a block of the file
    number = np.array(value.value if isinstance(value, u.Quantity) else value)
    node = {"value": number if number.ndim else number.item()}
    return node if unit is None else node | {"unit": unit_text(unit)}


def value_from_node(node):
    """
    Return the array or the Quantity of a node that `node_from_value` made.

    Examples
    --------
    >>> from astropolcal.converters.nodes import value_from_node
    >>> value_from_node({"value": 1.5, "unit": "deg"})
    <Quantity 1.5 deg>
    """
    unknown = sorted(set(node) - {"name", "unit", "value"})
    if unknown:
        raise CalibrationFileError(f"a value with {unknown[0]!r}, which means nothing here")
    value = np.array(node["value"])
    return value * unit_from_text(node["unit"]) if "unit" in node else value


def node_from_table(table):
    """
    Return the node of a table, a list of its columns in their order; None stays None.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal.converters.nodes import node_from_table
    >>> [column["name"] for column in node_from_table(QTable({"s_res": [0.2] * u.percent}))]
    ['s_res']
    """
    if table is None:
        return None
    return [{"name": name} | node_from_value(table[name]) for name in table.colnames]


def table_from_node(node):
    """
    Return the `~astropy.table.QTable` of a node that `node_from_table` made.

    Examples
    --------
    >>> from astropolcal.converters.nodes import table_from_node
    >>> table_from_node([{"name": "s_res", "value": [0.2], "unit": "%"}])["s_res"]
    <Quantity [0.2] %>
    """
    if node is None:
        return None
    columns = {column["name"]: value_from_node(column) for column in node}
    if len(columns) < len(node):
        raise CalibrationFileError("two columns of a table have the same name")
    return QTable(columns)


def plain(value, where="value"):
    """
    Return a value as ASDF stores it: numbers, text, lists, mappings, quantities.

    Dates and times become ISO text, tuples lists, numpy's numbers Python's.

    Parameters
    ----------
    value : object
        The value, such as the meta of a table.
    where : str
        What it is called in the error message.

    Returns
    -------
    object

    Raises
    ------
    CalibrationFileError
        If it, or something in it, is of another kind.

    Examples
    --------
    >>> import datetime
    >>> from astropolcal.converters.nodes import plain
    >>> plain({"date": datetime.date(2025, 10, 2), "lamps": ("halogen", 2)})
    {'date': '2025-10-02', 'lamps': ['halogen', 2]}
    """
    if isinstance(value, dict):
        return {str(key): plain(item, f"{where}.{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        # a copy: views of one array would share a block
        return value.copy() if value.ndim or isinstance(value, u.Quantity) else value.item()
    return _plain_scalar(value, where)


def _plain_scalar(value, where):
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


def checksum(node, expand=None):
    """
    Return the SHA-256 of the content of a node, however a file spells it.

    Parameters
    ----------
    node : object
        Mappings, lists, numbers, text, arrays and quantities.
    expand : callable, optional
        What turns any other object into such a node.

    Returns
    -------
    str
        64 hexadecimal digits. Equal for equal bits, whatever the order of the
        keys and whether arrays are inline or in blocks.

    Examples
    --------
    >>> from astropolcal.converters.nodes import checksum
    >>> checksum({"a": 1.0, "b": None}) == checksum({"b": None, "a": 1.0})
    True
    >>> checksum(1.0) == checksum(1.0000000000000002)
    False
    """
    # the order of keys in YAML means nothing
    text = json.dumps(_spelled(node, expand), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _spelled(node, expand):
    if isinstance(node, dict):
        return {str(key): _spelled(item, expand) for key, item in node.items()}
    if isinstance(node, (list, tuple)):
        return [_spelled(item, expand) for item in node]
    if isinstance(node, u.Quantity):
        return {"quantity": _spelled(node.value, expand), "unit": unit_text(node.unit)}
    if isinstance(node, float):
        # all bits, where a decimal text might round
        return {"float": float(node).hex()}
    if node is None or isinstance(node, (str, int)):
        return node
    if hasattr(node, "__array__"):
        return _spelled_array(np.asarray(node))
    return _spelled(expand(node), expand)


def _spelled_array(array):
    if array.dtype.kind == "f":
        # YAML knows one not-a-number only, floats have many
        array = np.where(np.isnan(array), np.nan, array)
    # of the same bytes on machines of either order; a block in a file may have any
    array = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).reshape(array.shape)
    return {"array": array.tobytes().hex(), "type": array.dtype.str, "shape": list(array.shape)}
