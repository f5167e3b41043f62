# Licensed under a 3-clause BSD style license - see LICENSE
"""Frames in the two states of a modulator: pairs, quadruples, and the groups of a table."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.observables import pair_states

AB = [0, 1]


def states(state, hwp=0.0, derotator=90.0, **options):
    state = np.asarray(state)
    angles = (np.broadcast_to(a, state.shape) * u.deg for a in (hwp, derotator))
    return pair_states(state, *angles, **options).tolist()


def modulated(hwp, state, **columns):
    """Return observations of one bin with the column flc_state."""
    table = example_table(hwp=hwp, wavelength=(0.625,))
    table["flc_state"] = list(state)
    for name, column in columns.items():
        table[name] = column
    return Observations.from_table(table, name="night")


# ---- pairs of states -----------------------------------------------------------------


def test_state_a_comes_first_whatever_the_order():
    assert states([0, 1]) == [[0, 1]]
    assert states([1, 0]) == [[1, 0]]
    assert states([1, 0, 0, 1], hwp=[0, 0, 45, 45]) == [[1, 0], [2, 3]]


def test_nearest_in_time_wins():
    # the third frame is farther in number, yet nearer in time
    assert states([0, 1, 1], time=[0.0, 10.0, 1.0], share=True) == [[0, 1], [0, 2]]
    with pytest.warns(AstropolcalWarning, match="1 of 3 frames left out, their partner in the"):
        assert states([0, 1, 1], time=[0.0, 10.0, 1.0]) == [[0, 2]]


def test_both_angles_must_agree_modulo_half_a_turn():
    for hwp, derotator, paired in [
        ([0.0, 0.29], 90.0, True),
        ([0.0, 0.31], 90.0, False),
        ([0.0, 180.0], 90.0, True),
        ([179.9, 0.1], 90.0, True),
        ([0.0, 90.0], 90.0, False),
        (0.0, [90.0, 90.49], True),
        (0.0, [90.0, 90.51], False),
        (0.0, [-90.0, 90.0], True),
    ]:
        if paired:
            assert states(AB, hwp, derotator) == [[0, 1]]
            continue
        with pytest.raises(ObservationError, match="has no partner; a frame in state B at these"):
            states(AB, hwp, derotator)


def test_tolerances_are_options():
    assert states(AB, [0, 2], tolerance=2.1 * u.deg) == [[0, 1]]
    assert states(AB, 0, [90, 93], derotator_tolerance=3.1 * u.deg) == [[0, 1]]


def test_lonely_frame_is_named_with_state_and_angles():
    for rows, where in [(None, "frame index 2"), ([1, 4, 7], "row 7")]:
        words = (
            f"night, {where}: flc_state B at hwp = 22.5 deg and derotator = 90 deg has no partner"
        )
        with pytest.raises(ObservationError, match=words):
            states([0, 1, 1], [0, 0, 22.5], rows=rows, name="night")


@given(st.permutations(range(8)))
def test_pairs_do_not_depend_on_the_order_of_the_rows(order):
    """Four plate angles in both states: each datum keeps its angle, and A comes first."""
    hwp, state = np.repeat([0, 45, 22.5, 67.5], 2)[order], np.tile(AB, 4)[order]
    found = states(state, hwp)
    assert sorted(np.ravel(found).tolist()) == list(range(8))
    for a, b in found:
        assert (state[a], state[b]) == (0, 1)
        assert hwp[a] == hwp[b]


# ---- both states at both plate angles ------------------------------------------------


def test_plate_without_partner_is_named_by_its_row():
    with pytest.raises(ObservationError, match="row 1: hwp = 0 deg has no partner"):
        modulated((0, 0, 22.5, 22.5), "ABAB").groups(4)


# ---- groups of a table ---------------------------------------------------------------


def test_a_state_is_never_paired_with_the_other_by_the_plate():
    obs = modulated((0, 0, 45, 45), "ABBA")
    assert obs.pairs().tolist() == [[0, 3], [1, 2]]
    assert obs.groups(4).tolist() == [[0, 1, 3, 2]]
    assert obs.groups(1).tolist() == [[0], [1], [2], [3]]
    obs.meta["pairing"] = "flc_state"
    assert obs.pairs().tolist() == [[0, 1], [3, 2]]
    # the nearest frame 45 deg away is in the other state
    assert modulated((0, 0, 45, 45), "ABAB").pairs().tolist() == [[0, 2], [1, 3]]


def test_groups_of_other_sizes_are_refused():
    for size in [0, 3, "2", None]:
        with pytest.raises(
            ObservationError, match=f"groups of {size!r} frames; allowed are 1, 2 and"
        ):
            modulated((0, 0, 45, 45), "ABAB").groups(size)


def test_groups_are_found_once_and_cannot_be_changed():
    obs = modulated((0, 0, 45, 45), "ABAB")
    first = obs.pairs()
    assert obs.pairs(0.3 * u.deg, derotator_tolerance=30 * u.arcmin) is first
    assert obs.pairs(0.2 * u.deg) is not first
    assert obs.groups(4) is obs.groups(4)
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0] = 3


def test_a_table_without_any_pair_is_an_error():
    """45 deg apart, but the derotator moved in between: no row is to blame."""
    for derotator, words in [
        ((90.0,), "night, row 1: hwp = 0 deg has no partner"),
        ((90.0, 45.0), "night: none of its 2 frames can be paired; two"),
    ]:
        table = example_table(hwp=(0.0,), derotator=derotator)
        table["hwp"] = np.where(table["frame"] == 1, 45.0, 0.0) * u.deg
        obs = Observations.from_table(table, name="night")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            with pytest.raises(ObservationError, match=words):
                obs.pairs()
        told = [str(one.message) for one in said if one.category is AstropolcalWarning]
        assert any("2 of 2 frames left out" in one for one in told) == (len(derotator) == 2)


def test_unknown_pairing_is_refused():
    obs = modulated((0, 0, 45, 45), "ABAB")
    words = "night: pairing of the meta = 'time'; allowed are hwp, flc_state"
    obs.meta["pairing"] = "time"
    with pytest.raises(ObservationError, match=words):
        obs.pairs()


def test_time_of_the_table_decides():
    # two cycles; the second A is nearer in time to the first B
    obs = modulated((0, 0, 0, 0), "ABAB", time=[0.0, 50.0, 49.0, 100.0])
    obs.meta["pairing"] = "flc_state"
    assert obs.pairs().tolist() == [[0, 3], [2, 1]]
