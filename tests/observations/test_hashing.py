# Licensed under a 3-clause BSD style license - see LICENSE
"""The hash of columns depends on their content and on nothing else."""

import astropy.units as u
import numpy as np
from astropy.table import QTable
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.observations.table import hash_columns


def test_hash_depends_on_values_names_and_header():
    column = {"a": np.array([1.0, 2.0])}
    base = hash_columns(column)
    assert len(base) == 64
    assert base == hash_columns({"a": np.array([1, 2])})
    others = [
        hash_columns({"a": np.array([2.0, 1.0])}),
        hash_columns({"b": np.array([1.0, 2.0])}),
        hash_columns({"a": np.array([1.0, 2.0000001])}),
        hash_columns({"a": np.array([1.0, 2.0]) * u.adu}),
        hash_columns(column, "header"),
    ]
    assert len({base, *others}) == 6


def test_hash_ignores_units_of_the_same_kind_and_the_sign_of_zero():
    assert hash_columns({"a": [1159.5614] * u.nm}) == hash_columns({"a": [1.1595614] * u.um})
    assert hash_columns({"a": np.array([0.0])}) == hash_columns({"a": np.array([-0.0])})


def test_hash_knows_strings_times_and_masks():
    assert hash_columns({"a": np.array(["x"])}) != hash_columns({"a": np.array(["y"])})
    # a wider string type is the same content
    assert hash_columns({"a": np.array(["x"])}) == hash_columns({"a": np.array(["x"], "U9")})
    noon = Time(["2025-10-05T12:00:00"])
    assert hash_columns({"a": noon}) == hash_columns({"a": Time(noon.jd, format="jd")})
    masked = QTable({"a": np.ma.MaskedArray([1.0], [True])})["a"]
    assert hash_columns({"a": masked}) != hash_columns({"a": np.array([1.0])})


def test_hash_is_stable_between_versions():
    # stored in calibration files: a change here breaks their provenance
    assert hash_columns({"hwp": [45.0] * u.deg, "frame": np.array([0])}, "x|y") == (
        "8971980382e3faa3c5f4859b7e7e8ef763c0a8a952bfd4ac664798b2a0523acd"
    )


@given(st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=5))
def test_hash_ignores_the_last_digits(numbers):
    # a short decimal number, and what arithmetic makes of it
    exact = np.array(numbers) / 1000.0
    noisy = exact * (1.0 + 1e-15)
    assert hash_columns({"a": noisy}) == hash_columns({"a": exact})


def test_hash_keeps_columns_apart():
    # the same values distributed over other columns or rows are another content
    one = hash_columns({"a": np.array(["x", "y"]), "b": np.array(["z"])})
    two = hash_columns({"a": np.array(["x"]), "b": np.array(["y", "z"])})
    assert one != two
