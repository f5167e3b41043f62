# Licensed under a 3-clause BSD style license - see LICENSE
"""Units at the door, floats inside; numbers and dates as texts write them."""

import datetime

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling import Parameter
from astropy.table import Column, MaskedColumn, QTable
from astropy.time import Time
from astropy.utils.masked import Masked
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.units import (
    angle_to_rad,
    canonical_factor,
    canonical_unit,
    iso_date,
    length_to_um,
    plain_number,
    to_unit,
    wavelengths_of,
)

FINITE = st.floats(-1e6, 1e6)
ANGLES = (u.deg, u.rad, u.arcmin, u.hourangle, u.mas)
LENGTHS = (u.nm, u.um, u.mm, u.m, u.AA)


# --- internal units -------------------------------------------------------------------------


def test_internal_unit_of_a_kind():
    for unit, expected in [
        (u.deg, u.rad),
        ("arcsec", u.rad),
        (u.AA, u.um),
        ("mm", u.um),
        (u.percent, u.one),
        (None, u.one),
        ("", u.one),
    ]:
        assert canonical_unit(unit) == expected, (unit, expected)


def test_kind_without_an_internal_unit():
    for unit in [u.s, "Hz", u.adu, u.deg / u.um, u.rad**2]:
        with pytest.raises(ParameterError, match="neither an angle, a length nor dimensionless"):
            canonical_unit(unit)
        assert canonical_factor(unit) == 1.0, unit


def test_factor_to_the_internal_unit():
    for unit, factor in [
        (u.deg, np.pi / 180),
        (u.mm, 1e3),
        (u.nm, 1e-3),
        (u.percent, 0.01),
        (None, 1.0),
        (u.um, 1.0),
    ]:
        assert canonical_factor(unit) == pytest.approx(factor, rel=1e-15), (unit, factor)


@given(value=FINITE, unit=st.sampled_from([*ANGLES, *LENGTHS, u.percent]))
def test_factor_is_the_conversion(value, unit):
    expected = (value * unit).to_value(canonical_unit(unit))
    assert value * canonical_factor(unit) == pytest.approx(expected, rel=1e-12)


# --- conversion -------------------------------------------------------------------------------


@given(value=FINITE, unit=st.sampled_from(ANGLES))
def test_angle_survives_the_way_in_and_out(value, unit):
    back = (float(angle_to_rad(value * unit)) * u.rad).to_value(unit)
    assert back == pytest.approx(value, rel=1e-12, abs=1e-300)


@given(value=FINITE, unit=st.sampled_from(LENGTHS))
def test_length_survives_the_way_in_and_out(value, unit):
    back = (float(length_to_um(value * unit)) * u.um).to_value(unit)
    assert back == pytest.approx(value, rel=1e-12, abs=1e-300)


def test_shape_is_kept_and_the_result_is_plain():
    for shape in [(), (1,), (3,), (2, 3), (0,)]:
        found = angle_to_rad(np.full(shape, 180.0) * u.deg)
        assert type(found) is np.ndarray, shape
        assert found.shape == shape, shape
        assert found.dtype == float, shape
        np.testing.assert_allclose(found, np.pi)


def test_whatever_carries_a_unit():
    for value in [
        Parameter("x", default=90.0, unit=u.deg),
        QTable({"x": [90.0] * u.deg})["x"],
        Column([90.0], unit=u.deg),
        u.Quantity(np.float32(90), u.deg),
    ]:
        np.testing.assert_allclose(angle_to_rad(value), np.pi / 2, rtol=1e-7)


def test_plain_numbers_where_there_is_no_unit():
    for value in [3, True, [1, 2], np.float32(0.5), "2.5", (1.0,)]:
        np.testing.assert_array_equal(to_unit(value, None), np.asarray(value, dtype=float))


def test_percent_is_a_number_and_a_number_is_percent():
    assert to_unit(3 * u.percent, None) == pytest.approx(0.03)
    assert to_unit(0.03 * u.one, u.percent) == pytest.approx(3)


def test_masked_wavelengths_are_not_known():
    column = MaskedColumn([1.2, 1.6], mask=[False, True], unit="um")
    for hidden in (column, Masked([1.2, 1.6] * u.um, mask=[False, True])):
        with pytest.raises(ParameterError, match="finite numbers above zero"):
            wavelengths_of(hidden)
    assert wavelengths_of(Column([1200, 1600], unit="nm"))[1] == 1600 * u.nm


def test_what_was_given_is_not_changed():
    given_ = np.array([1.0, 2.0]) * u.mm
    length_to_um(given_)[0] = 5
    np.testing.assert_array_equal(given_.value, [1, 2])


def test_not_a_number_and_infinity_pass():
    """Whether a value must be finite is for the caller to say, who knows its name."""
    assert np.isnan(angle_to_rad(np.nan * u.deg))
    assert length_to_um(np.inf * u.m) == np.inf


# --- what is refused ----------------------------------------------------------------------------


def test_what_is_refused_is_named():
    for call, words in [
        (lambda: angle_to_rad(3.0), r"^angle = 3.0 needs a unit such as rad$"),
        (lambda: angle_to_rad([1, 2], "theta"), r"theta = \[1, 2\] needs a unit such as rad"),
        (lambda: length_to_um(1.6), r"^wavelength = 1.6 needs a unit such as um$"),
        (lambda: angle_to_rad(1 * u.um, "hwp"), "hwp has unit um, which is not convertible to rad"),
        (lambda: angle_to_rad([1] * u.one, "hwp"), "^hwp has no unit and needs one such as rad$"),
        (lambda: angle_to_rad(Column([1]), "hwp"), "^hwp has no unit and needs one such as rad$"),
        (lambda: length_to_um(2 * u.Hz), "wavelength has unit Hz, which is not convertible to um"),
        (lambda: to_unit(1 * u.deg, None, "q"), "q has unit deg, .* convertible to a plain number"),
        (lambda: to_unit("east", None, "q"), "q = 'east' is not a number"),
        (lambda: to_unit({}, None, "q"), "q = {} is not a number"),
        (lambda: to_unit(None, None, "q"), "q = None is not a number"),
        (lambda: to_unit([1.0, None], None, "q"), r"q = \[1.0, None\] is not a number"),
        (lambda: to_unit(1j, None, "q"), "q = 1j is complex; allowed are real numbers"),
        (lambda: to_unit([1j] * u.deg, u.deg, "q"), "is complex"),
    ]:
        with pytest.raises(ParameterError, match=words):
            call()


# --- numbers and dates as text --------------------------------------------------------------------


def test_numbers_are_written_in_plain_digits():
    """Python alone takes all of these for numbers."""
    for text, number in (("1000", 1000.0), (" -1.5e3 ", -1500.0), ("inf", np.inf), (7, 7.0)):
        assert plain_number(text) == number
    assert plain_number("12", int) == 12
    assert plain_number("0.625 \u00b5m", u.Quantity) == 625 * u.nm
    for text in ("1_000", "\u0661\u0662", "\uff11", "1\u0662.5"):
        assert float(text) > 0
        with pytest.raises(ValueError, match="is not written as a plain number"):
            plain_number(text)
    with pytest.raises(ValueError, match="is not written as a plain number"):
        plain_number("\u0661\u0662 nm", u.Quantity)


def test_all_spellings_of_a_date_become_one():
    zone = datetime.timezone(datetime.timedelta(hours=10))
    for date in (
        *(
            "2025-10-05",
            " 2025-10-5",
            "20251005",
            20251005,
            "60953",
            60953,
            np.int64(60953),
            60953.0,
        ),
        datetime.date(2025, 10, 5),
    ):
        assert iso_date(date) == "2025-10-05"
    for moment in (
        *("2025-10-05T12:00", "2025-10-05 12:00:00", "2025-10-05T12:00:00.0Z", "60953.5", 60953.5),
        *(datetime.datetime(2025, 10, 5, 12), datetime.datetime(2025, 10, 5, 22, tzinfo=zone)),
        Time("2025-10-05T12:00:37", scale="tai"),
    ):
        assert iso_date(moment) == "2025-10-05T12:00:00.000"
    # the time of day stays where it was stated
    assert iso_date("2025-10-05T00:00") == "2025-10-05T00:00:00.000"
    assert iso_date("2025-10", months=True) == "2025-10"
    # leap seconds so far off are not known, which is no matter here
    assert iso_date("2099-12-31") == "2099-12-31"


def test_what_is_no_date_is_refused():
    for date in (
        *("5 Oct 2025", "05.10.2025", "2025-10-05T25:00", "2025-10-05T24:00", "2025-10-05T09"),
        *("0000-00-00", "0001-01-01", "2025-13-01", "2025-02-30", "20250230", "18991231", 2025),
        *("12345", 39999, 100000, "60_953", "2025-10", "2025", "", "unknown", True, "J2025.7"),
        *("\u0662\u0660\u0662\u0665-10-05", "\uff16\uff10\uff19\uff15\uff13", [], np.nan),
        *(Time(["2025-10-05"]), Time("2025-10-05", scale="local"), datetime.time(12)),
        datetime.datetime(1, 1, 1, tzinfo=datetime.timezone(datetime.timedelta(hours=10))),
    ):
        with pytest.raises(ParameterError, match="is not a date; allowed are 2025-10-05") as caught:
            iso_date(date)
        assert "\n" not in str(caught.value)
    with pytest.raises(
        ObservationError, match=r"night: date = '2025-10x' is not a date; .*2025-10,"
    ):
        iso_date("2025-10x", "night: date", ObservationError, months=True)
