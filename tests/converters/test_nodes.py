# Licensed under a 3-clause BSD style license - see LICENSE
"""Plain values, tables and the checksum."""

import datetime

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import models
from astropy.table import QTable
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from astropolcal.converters.nodes import (
    checksum,
    node_from_optic,
    node_from_table,
    node_from_value,
    plain,
    table_from_node,
    unit_from_text,
    unit_text,
    value_from_node,
)
from astropolcal.exceptions import CalibrationFileError
from astropolcal.optics import LinearRetarder

# of all characters, hypothesis would first make a table, which takes seconds
text = st.text("aZ0 _.:~\"'\\\n\t\0é中\U0001f52d")
leaf = st.none() | st.booleans() | st.integers(-99, 99) | st.floats(allow_nan=False) | text
trees = st.recursive(
    leaf, lambda inner: st.lists(inner) | st.dictionaries(text, inner), max_leaves=10
)


@given(trees)
def test_plain_keeps_what_is_plain(tree):
    assert plain(tree) == tree


def test_plain_of_other_kinds():
    for value, expected in [
        (np.float64(1.5), 1.5),
        (np.int32(3), 3),
        (np.bool_(True), True),
        (np.str_("a"), "a"),
        (np.array(2.5), 2.5),
        ((1, 2), [1, 2]),
        ({1: "a"}, {"1": "a"}),
        (datetime.date(2025, 10, 2), "2025-10-02"),
        (datetime.datetime(2025, 10, 2, 3, 4, 5), "2025-10-02T03:04:05"),
        (Time("2025-10-02T03:04:05"), "2025-10-02T03:04:05.000"),
    ]:
        found = plain(value)
        assert found == expected
        assert type(found) is type(expected)


def test_plain_copies_arrays_and_quantities():
    for value in [3 * u.deg, [1.0, 2.0] * u.mm, np.arange(3)]:
        found = plain({"a": value})["a"]
        assert found is not value
        assert np.all(found == value)
        assert type(found) is type(value)


def test_plain_refuses_the_rest():
    for value in [{1, 2}, object(), len, b"bytes", 1j, np.array(["a"])]:
        with pytest.raises(CalibrationFileError, match=r"meta\.lamps\[1\] is a .* cannot hold"):
            plain({"lamps": [1, value]}, "meta")


def test_units_survive():
    for unit in [None, u.deg, u.mm, u.percent, u.um, 1 / u.deg]:
        assert unit_from_text(unit_text(unit)) == unit


@given(npst.arrays(float, npst.array_shapes(min_dims=0, max_dims=2, min_side=0)))
def test_values_survive(array):
    for value in (array, array * u.deg):
        found = value_from_node(node_from_value(value))
        # a number of its own type
        number = value is array and not array.ndim
        assert type(found) is type(array.item() if number else value)
        assert np.shape(found) == array.shape
        assert np.asarray(found).tobytes() == np.asarray(array).tobytes()


def test_table_survives():
    table = QTable({"n": [1, 2], "wavelength": [1.2, 1.6] * u.um, "s_cv": [np.nan, 1] * u.percent})
    again = table_from_node(node_from_table(table))
    assert again.colnames == table.colnames
    assert again["n"].dtype == table["n"].dtype
    assert again["wavelength"].unit == u.um
    assert np.array_equal(again["s_cv"].value, [np.nan, 1], equal_nan=True)
    assert table_from_node(node_from_table(None)) is None


# ---- the checksum --------------------------------------------------------------------


@pytest.mark.slow
@given(trees, trees)
def test_checksum_tells_trees_apart(one, other):
    # 1, 1.0 and True are equal for Python, but not the same content
    assert (checksum(one) == checksum(other)) == (repr_sorted(one) == repr_sorted(other))


def repr_sorted(tree):
    if isinstance(tree, dict):
        return "mapping", sorted((key, repr_sorted(value)) for key, value in tree.items())
    return [repr_sorted(item) for item in tree] if isinstance(tree, list) else repr(tree)


@given(
    npst.arrays(float, 4, elements=st.floats(allow_nan=False)), st.integers(0, 3), st.integers(0, 7)
)
def test_checksum_sees_a_changed_bit(array, place, byte):
    changed = array.copy()
    changed.view(np.uint8).reshape(4, 8)[place, byte] ^= 1
    both_nan = np.isnan(changed[place]) and np.isnan(array[place])
    assert both_nan or checksum(changed) != checksum(array)


def test_checksum_sees_shape_type_and_unit():
    values = [
        np.zeros(4), np.zeros((2, 2)), np.zeros(4, int), np.zeros(4) * u.deg, np.zeros(4) * u.mm,
        [0.0] * 4, np.zeros(0), np.zeros((0, 3)), [], {},
    ]  # fmt: skip
    assert len({checksum(value) for value in values}) == len(values)


def test_checksum_does_not_see_how_a_file_spells():
    quiet, other = np.array([0x7FF8000000000000, 0xFFF8000000000001], np.uint64).view(float)
    assert checksum(np.array([quiet])) == checksum(np.array([other]))
    array = np.arange(6.0).reshape(2, 3)
    assert checksum(array) == checksum(np.asfortranarray(array)) == checksum(array.astype(">f8"))


def test_checksum_expands_optics():
    plate = LinearRetarder(retardance=180 * u.deg, name="hwp")
    assert checksum([plate]) == checksum([node_from_optic(plate)])


def test_checksum_sees_all_that_a_law_gives():
    laws = [
        models.Polynomial1D(1, c1=1),
        models.Polynomial1D(1, c1=2),
        models.Chebyshev1D(1, c1=1),
        models.Polynomial1D(1, c1=1, domain=(1, 3)),
        models.Polynomial1D(1, c1=1, domain=(1, 3), window=(0, 5)),
        models.Polynomial2D(1, c1_0=1, x_domain=(1, 3)),
        models.Polynomial2D(1, c1_0=1, x_domain=(1, 3), x_window=(0, 5)),
    ]
    assert len({checksum(law) for law in laws}) == len(laws)
