# Licensed under a 3-clause BSD style license - see LICENSE
"""Wavelengths that tables share, and those of filters."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ObservationError
from astropolcal.observations import Observations
from astropolcal.observations.reading import (
    SAME_WAVELENGTH,
    common_wavelengths,
    filter_wavelength,
    stated_wavelength,
)


def at(*wavelengths, unit=u.um):
    return SimpleNamespace(wavelength=np.array(wavelengths) * unit)


def test_union_is_sorted_and_in_micrometre():
    found = common_wavelengths([at(2.2, 1.2), at(1600.0, 1200.0, unit=u.nm)])
    np.testing.assert_allclose(found, [1.2, 1.6, 2.2])


def test_nearly_the_same_is_the_same():
    for step, number in [(0.9, 1), (1.1, 2)]:
        assert (
            len(common_wavelengths([at(1.2), at(1.2 * (1 + step * SAME_WAVELENGTH))])) == number
        ), (step, number)


def test_given_grid_is_taken_as_it_is():
    assert common_wavelengths([at(1.2)], [2000.0, 1500.0] * u.nm).tolist() == [2.0, 1.5]
    assert common_wavelengths([], 1.6 * u.um).tolist() == [1.6]


@given(st.lists(st.floats(0.5, 2.5), min_size=1, max_size=8), st.integers(1, 7))
def test_union_does_not_depend_on_how_tables_are_cut(wavelengths, cut):
    together = common_wavelengths([at(*wavelengths)])
    parts = [part for part in (wavelengths[:cut], wavelengths[cut:]) if part]
    np.testing.assert_array_equal(common_wavelengths([at(*part) for part in parts]), together)
    assert np.all(np.diff(together) > 0)


# ---- filters -------------------------------------------------------------------------


def test_spelling_of_a_filter_does_not_matter():
    for name in ["625-50", "625 50", "62550"]:
        for instrument in ["VAMPIRES", "vampires", "SCExAO/VAMPIRES"]:
            assert filter_wavelength(instrument, name) == 625 * u.nm, (instrument, name)


def test_unknown_filter_names_those_that_are_known():
    for instrument, name, words in [
        ("VAMPIRES", "H", r"VAMPIRES: no wavelength is known of filter 'H'; known are .*625-50"),
        ("nobody", "H", "known are none; give the wavelength"),
        (None, "H", "None: no wavelength is known of filter 'H'"),
    ]:
        with pytest.raises(ObservationError, match=words):
            filter_wavelength(instrument, name)


def test_wavelength_that_meta_state():
    for meta, wavelength in [
        ({}, None),
        ({"instrument": "VAMPIRES"}, None),
        ({"wavelength": "625 nm"}, 625 * u.nm),
        ({"wavelength": 0.77 * u.um}, 770 * u.nm),
        ({"filter": "750-50", "instrument": "VAMPIRES"}, 750 * u.nm),
        # what is stated as a number goes before the filter
        ({"wavelength": "0.77 um", "filter": "750-50", "instrument": "VAMPIRES"}, 770 * u.nm),
    ]:
        found = stated_wavelength(meta, "night")
        assert found is wavelength if wavelength is None else np.isclose(found, wavelength), (
            meta,
            wavelength,
        )


def test_what_is_no_length_is_refused():
    for value in ["625", "625 s", 0 * u.nm, "-1 um", [1, 2] * u.um, "wide", float("nan"), 625]:
        with pytest.raises(
            ObservationError, match=r"night: wavelength = .* in the meta; allowed is"
        ):
            stated_wavelength({"wavelength": value}, "night")


def test_a_wavelength_that_contradicts_the_filter_is_refused():
    meta = {"wavelength": "625 nm", "filter": "775-50", "instrument": "VAMPIRES"}
    with pytest.raises(ObservationError, match=r"night: .*625 nm.*'775-50' has 775 nm"):
        stated_wavelength(meta, "night")
    # of a filter that nobody knows the wavelength counts
    assert stated_wavelength(meta | {"filter": "Z"}, "night") == 625 * u.nm


def test_unknown_filter_of_a_table_names_the_table():
    rows = {name: [1.0, 3.0] * u.adu for name in ("single_difference", "single_sum")}
    angles = {"hwp": [0, 45] * u.deg, "derotator": [90, 90] * u.deg}
    table = QTable(rows | angles, meta={"filter": "Z", "instrument": "VAMPIRES"})
    with pytest.raises(ObservationError, match="run: VAMPIRES: no wavelength is known of filter"):
        Observations.from_table(table, name="run")
