# Licensed under a 3-clause BSD style license - see LICENSE
"""What an optic may depend on besides angles: the time in the run, and the fluxes."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import MaskedColumn, QTable
from astropy.time import Time, TimeDelta
from astropy.utils.masked import Masked
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.pointings import clock, frame_coordinate
from astropolcal.optics import COORDINATES, FluxGain

MINUTES = np.array([12.0, 3.0, 0.0, 7.5])
SHARE = MINUTES / 12.0
WANTED = [
    Time(60000.0 + MINUTES / 1440, format="mjd"),
    Time("2025-10-05T23:59:00", scale="utc") + MINUTES * u.min,
    Time(60000.0 + MINUTES / 1440, format="mjd", scale="tai"),
    MINUTES * u.min,
    (MINUTES * u.min).to(u.s),
    MINUTES,
    (MINUTES * 2).astype(int),
    -5.0 + MINUTES,
    (Time("2025-10-05T23:59:00", scale="utc") + MINUTES * u.min).isot,
    Masked(MINUTES * u.min, mask=False),
    MaskedColumn(MINUTES, mask=False),
]
USELESS = [
    ["12:00", "12:03", "12:05", "12:09"],
    [0.0, np.nan, 1.0, 2.0],
    [0.0, np.inf, 1.0, 2.0],
    Masked([0.0, 1.0, 2.0, 3.0] * u.s, mask=[0, 1, 0, 0]),
    MaskedColumn([0.0, 1.0, 2.0, 3.0], mask=[0, 0, 0, 1]),
    Time(Masked(60000.0 + MINUTES, mask=[0, 1, 0, 0]), format="mjd"),
]


def make(time=None, table=None, **columns):
    """Observations of the four frames of the example; columns have one value a frame."""
    table = example_table() if table is None else table
    if time is not None:
        columns["time"] = time
    for name, column in columns.items():
        column = column if hasattr(column, "shape") else np.array(column)
        table[name] = column[np.asarray(table["frame"])]
    return Observations.from_table(table, name="night")


def uneven_table():
    """The example with fluxes that differ in every cell."""
    table = example_table()
    n = len(table)
    table["flux_right"] = np.linspace(1e4, 5e4, n) ** 1.1 * u.adu
    table["flux_left"] = np.linspace(7e4, 2e4, n) * u.adu
    return table


# --- sequence ----------------------------------------------------------------------------------


def test_without_time_the_order_of_the_frames_counts():
    found = make().position("sequence")
    np.testing.assert_allclose(found, [0, 1 / 3, 2 / 3, 1], rtol=1e-15)
    # gaps in the numbers of the frames do not count
    table = example_table()
    table["frame"] = np.array([2, 3, 50, 90])[table["frame"]]
    found = Observations.from_table(table).position("sequence")
    np.testing.assert_allclose(found, [0, 1 / 3, 2 / 3, 1], rtol=1e-15)


def test_time_counts_whatever_its_kind_and_order():
    for time in WANTED:
        found = make(time).position("sequence")
        np.testing.assert_allclose(found, SHARE, rtol=0, atol=1e-6)
        assert (found.min(), found.max()) == (0, 1), time


def test_time_that_does_not_tell_is_as_none():
    for time in USELESS:
        obs = make(time)
        assert clock(obs.frames) is None, time
        np.testing.assert_allclose(obs.position("sequence"), [0, 1 / 3, 2 / 3, 1], rtol=1e-15)
    # duration is no time of its own
    assert clock(QTable({"time": TimeDelta([0, 1] * u.s)})) is None


def test_single_frame():
    obs = make(MINUTES * u.min).select([True, False, False, False])
    assert obs.n_frames == 1
    assert obs.position("sequence").tolist() == [0]
    np.testing.assert_array_equal(obs.position("previous_flux"), np.ones((2, obs.n_bins, 1)))
    assert obs.position("flux").shape == (2, obs.n_bins, 1)
    # a date that is the same in all frames leaves their order
    found = make(np.full(4, 3.0)).position("sequence")
    np.testing.assert_allclose(found, [0, 1 / 3, 2 / 3, 1])


@pytest.mark.slow
@given(times=st.lists(st.floats(-1e6, 1e6), min_size=4, max_size=4))
def test_sequence_is_monotonic_in_time(times):
    found = make(np.array(times)).position("sequence")
    assert np.all((found >= 0) & (found <= 1))
    assert np.all(np.diff(found[np.argsort(times, kind="stable")]) >= 0)


def test_observations_are_not_changed():
    obs = make(MINUTES * u.min)
    for name in set(COORDINATES) - {"parallactic_rate", "flc_state"}:
        first = obs.position(name)
        first[...] = 99.0
        assert not np.any(obs.position(name) == 99.0)


def test_brightness_is_that_of_the_wavelengths_that_a_frame_has():
    table, lamp = example_table(), np.array([1.0, 1.1, 0.95, 0.95])
    spectrum = 1e5 / (1 + np.arange(table["bin"].max() + 1))
    for beam, share in (("right", 0.7), ("left", 0.3)):
        table[f"flux_{beam}"] = share * spectrum[table["bin"]] * lamp[table["frame"]] * u.adu
    found = Observations.from_table(table).position("brightness")
    np.testing.assert_allclose(found, lamp - 1, atol=1e-12)
    # without the brightest
    table["flux_right"][(table["frame"] == 2) & (table["bin"] == 0)] = np.nan
    with pytest.warns(AstropolcalWarning, match="1 cell masked"):
        found = Observations.from_table(table).position("brightness")
    np.testing.assert_allclose(found, lamp - 1, atol=0.02)


def test_rate_of_an_angle_is_its_change_from_frame_to_frame():
    for order in [[0, 1, 2, 3], [2, 0, 3, 1]]:
        table = example_table()
        when = np.array(order)[table["frame"]]
        table["time"] = when * u.min
        # a whole turn between two frames is no motion
        table["parallactic"] = (170.0 + 20.0 * when - 360.0 * (when > 0)) * u.deg
        found = np.rad2deg(Observations.from_table(table).position("parallactic_rate"))
        np.testing.assert_allclose(found, 20.0, atol=1e-12)
    # rate wants the angle
    with pytest.raises(ObservationError, match="no column 'parallactic'"):
        Observations.from_table(example_table()).position("parallactic_rate")


# --- fluxes ------------------------------------------------------------------------------------


def test_fluxes_of_both_beams_right_first():
    obs = make(table=uneven_table())
    found = obs.position("flux")
    assert found.shape == (2, 3, 4)
    np.testing.assert_array_equal(found[0], obs.flux_right.T)
    np.testing.assert_array_equal(found[1], obs.flux_left.T)
    # fluxes are in the unit of the table
    for unit in [u.adu, u.electron, u.one]:
        table = uneven_table()
        for name in ("flux_right", "flux_left", "flux_right_err", "flux_left_err"):
            table[name] = table[name].value * unit
        expected = make(table=uneven_table())
        for name in ("flux", "previous_flux"):
            np.testing.assert_array_equal(make(table=table).position(name), expected.position(name))


def test_flux_over_that_of_the_frame_before():
    obs = make(table=uneven_table())
    found = obs.position("previous_flux")
    flux = np.stack([obs.flux_right.T, obs.flux_left.T])
    np.testing.assert_array_equal(found[..., 0], np.ones((2, 3)))
    np.testing.assert_allclose(found[..., 1:], flux[..., 1:] / flux[..., :-1], rtol=1e-15)


def test_frame_before_is_the_one_before_in_time():
    obs = make(MINUTES * u.min, table=uneven_table())
    found = obs.position("previous_flux")
    flux = obs.position("flux")
    # in the order of time: frames 2, 1, 3, 0
    for now, before in ((1, 2), (3, 1), (0, 3)):
        np.testing.assert_allclose(found[..., now], flux[..., now] / flux[..., before], rtol=1e-15)
    np.testing.assert_array_equal(found[..., 2], np.ones((2, 3)))
    # simultaneous frames follow each other in their order
    obs = make(np.array([1.0, 0.0, 0.0, 1.0]), table=uneven_table())
    found, flux = obs.position("previous_flux"), obs.position("flux")
    for now, before in ((2, 1), (0, 2), (3, 0)):
        np.testing.assert_allclose(found[..., now], flux[..., now] / flux[..., before], rtol=1e-15)


def test_bad_flux_has_no_coordinate():
    for bad in [0.0, -3.0, np.nan, np.inf]:
        table = uneven_table()
        row = np.flatnonzero((table["frame"] == 1) & (table["bin"] == 2))[0]
        table["flux_right"][row] = bad * u.adu
        with pytest.warns(AstropolcalWarning, match="1 cell masked"):
            obs = make(table=table)
        assert_neutral(obs, frame=1, bin_=2)
    # masked cell has no coordinate
    mask = np.zeros((4, 3), dtype=bool)
    mask[2, 0] = True
    assert_neutral(make(table=uneven_table()).with_mask(mask, "cosmic ray"), frame=2, bin_=0)


def assert_neutral(obs, frame, bin_):
    """A masked cell has no flux, and does not act on the frame behind it."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        flux, ratio = obs.position("flux"), obs.position("previous_flux")
    assert np.isfinite(flux).all()
    assert np.isfinite(ratio).all()
    np.testing.assert_array_equal(flux[:, bin_, frame], 0)
    np.testing.assert_array_equal(ratio[:, bin_, frame : frame + 2], 1)
    assert (flux == 0).sum() == 2
    whole = make(table=uneven_table()).position("previous_flux")
    same = np.ones((3, 4), dtype=bool)
    same[bin_, frame : frame + 2] = False
    np.testing.assert_array_equal(ratio[:, same], whole[:, same])
    for power in (1, -1):
        gain = FluxGain(right=0.3, left=0.3, power=power, mount="flux")
        assert gain.mueller(position=flux[0, bin_, frame])[0, 0] == 1


# --- names -------------------------------------------------------------------------------------


def test_unknown_coordinate():
    with pytest.raises(ObservationError, match="night: coordinate = 'fluxes'; allowed are sequen"):
        frame_coordinate(make(), "fluxes")


def test_documentation_names_all():
    for name in COORDINATES:
        assert f'"{name}"' in Observations.position.__doc__


# ---- the state of a modulator ------------------------------------------------------------


def test_state_in_any_spelling_is_zero_or_one():
    for states in [
        ["A", "B", "A", "B"],
        ["a", " b ", "A", "B"],
        [0, 1, 0, 1],
        [0.0, 1.0, 0.0, 1.0],
    ]:
        table = example_table()
        table["flc_state"] = np.repeat(states, 3)
        found = frame_coordinate(Observations.from_table(table), "flc_state")
        assert found.tolist() == [0.0, 1.0, 0.0, 1.0], states


def test_state_that_is_neither_names_the_frame():
    for bad in ["C", "", "2", "on"]:
        table = example_table()
        table["flc_state"] = np.repeat(["A", "B", bad, "B"], 3)
        obs = Observations.from_table(table, name="night")
        words = f"night: flc_state = '{bad}' in frame 2; allowed are A and B, or 0 and 1"
        with pytest.raises(ObservationError, match=words):
            frame_coordinate(obs, "flc_state")
    # state needs its column
    obs = Observations.from_table(example_table(), name="night")
    with pytest.raises(ObservationError, match="night: no column flc_state; it is needed, with A"):
        frame_coordinate(obs, "flc_state")


def test_total_flux_is_the_same_for_both_beams():
    obs = Observations.from_table(example_table())
    total = frame_coordinate(obs, "total_flux")
    assert total.shape == (2, 3, 4)
    np.testing.assert_array_equal(total[0], total[1])
    np.testing.assert_allclose(total, 1000.0)
