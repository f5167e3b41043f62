# Licensed under a 3-clause BSD style license - see LICENSE
"""Pairs by half-wave-plate angle: preference, left-over frames, laws."""

import time

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import AstropolcalWarning, ObservationError, ParameterError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.observables import pair_frames

CYCLE = [0.0, 45.0, 22.5, 67.5]


def pair(hwp, derotator=None, **kwargs):
    derotator = None if derotator is None else derotator * u.deg
    return pair_frames(np.array(hwp, dtype=float) * u.deg, derotator, **kwargs).tolist()


def test_angles_45_degrees_apart_are_a_pair():
    assert pair(CYCLE) == [[0, 1], [2, 3]]
    # 45 deg comes first, yet 0 deg is the plus frame
    assert pair([45.0, 0.0]) == [[1, 0]]
    # up to 180 degrees
    hwp = np.arange(0.0, 180.0, 11.25)  # the 16 angles of the VAMPIRES calibration
    found = {(hwp[p], hwp[m]) for p, m in pair(hwp)}
    assert found == {(a, a + 45) for a in (0, 11.25, 22.5, 33.75, 90, 101.25, 112.5, 123.75)}
    # modulo 180 degrees
    assert pair([180.0, 45.0]) == [[0, 1]]
    assert pair([0.0, 225.0]) == [[0, 1]]
    assert pair([-180.0, -135.0]) == [[0, 1]]
    # an unused partner 45 degrees behind will do
    assert pair([90.0, 45.0]) == [[0, 1]]
    # one ahead is preferred to a nearer one behind
    assert pair([45.0, 90.0, 0.0, 135.0]) == [[1, 3], [2, 0]]


def test_the_order_of_frames_does_not_matter():
    for order in [[3, 1, 0, 2], [2, 3, 1, 0]]:
        hwp = np.array(CYCLE)[order]
        found = {(hwp[p], hwp[m]) for p, m in pair(hwp)}
        assert found == {(0.0, 45.0), (22.5, 67.5)}, order


def test_tolerance_of_the_plate():
    for offset in [-0.2, 0.0, 0.2]:
        # 0 deg read back as 359.8 deg is still the plus frame
        assert pair([np.mod(offset, 360.0), 45.0]) == [[0, 1]], offset
    # beyond it there is no partner
    with pytest.raises(ObservationError, match="hwp = 0 deg has no partner"):
        pair([0.0, 45.4])
    assert pair([0.0, 45.4], tolerance=0.5 * u.deg) == [[0, 1]]


def test_the_nearest_in_the_sequence_wins():
    # the cycle starts in the middle: frame 0 is nearer to nothing than frame 4 is to frame 3
    hwp = [45.0, 22.5, 67.5, 0.0, 45.0, 22.5, 67.5]
    with pytest.warns(AstropolcalWarning, match=r"1 of 7 frames left out.*frame 0 \(hwp 45 deg\)"):
        assert pair(hwp) == [[1, 2], [3, 4], [5, 6]]


def test_time_replaces_the_sequence():
    hwp = [0.0, 45.0, 45.0, 0.0]
    assert pair(hwp) == [[0, 1], [3, 2]]
    assert pair(hwp, time=[0.0, 9.0, 1.0, 8.0]) == [[0, 2], [3, 1]]


def test_the_derotator_must_stand_still():
    hwp, derotator = [0.0, 45.0, 0.0, 45.0], [45.0, 60.0, 60.0, 45.0]
    assert pair(hwp, derotator) == [[0, 3], [2, 1]]


def test_a_drifting_derotator_pairs_neighbours():
    hwp = CYCLE * 10
    derotator = 97.0 - 0.02 * np.arange(40)
    assert pair(hwp, derotator) == [[i, i + 1] for i in range(0, 40, 2)]


def test_the_same_derotator_angle_comes_before_the_same_time():
    # frames 1 and 2 are neighbours, but 0.4 deg of derotator apart
    hwp, derotator = [45.0, 0.0, 45.0, 0.0], [90.0, 90.0, 90.4, 90.4]
    assert pair(hwp, derotator, time=[0.0, 5.0, 6.0, 11.0]) == [[1, 0], [3, 2]]
    # a smaller drift does not count
    assert pair(hwp, 90.0 + 0.02 * np.arange(4), time=[0.0, 5.0, 6.0, 11.0]) == [[1, 2], [3, 0]]


def test_equal_times_leave_the_choice_to_the_sequence():
    assert pair([0.0, 45.0, 0.0, 45.0], time=[1.0] * 4) == [[0, 1], [2, 3]]
    hwp = [0.0, 0.0, 45.0, 45.0, 0.0, 45.0]
    assert pair(hwp, time=[1.0] * 6) == [[0, 5], [1, 2], [4, 3]]


def test_derotator_tolerance():
    with pytest.warns(AstropolcalWarning, match="2 of 2 frames left out"):
        assert pair([0.0, 45.0], [90.0, 90.6]) == []
    assert pair([0.0, 45.0], [90.0, 90.6], derotator_tolerance=1 * u.deg) == [[0, 1]]
    for derotator in (None, [90.0, 90.6]):
        with pytest.raises(ParameterError, match="derotator_tolerance = 1 needs a unit"):
            pair([0.0, 45.0], derotator, derotator_tolerance=1)


def test_the_modulator_must_be_in_the_same_state():
    assert pair([0.0, 0.0, 45.0, 45.0], flc_state=["A", "B", "B", "A"]) == [[0, 3], [1, 2]]


def test_left_over_frames_are_named_and_counted():
    with pytest.warns(
        AstropolcalWarning, match=r"night: 1 of 3 frames left out.* frame 17 \(hwp 90 deg\)"
    ):
        assert pair([0.0, 45.0, 90.0], labels=[5, 6, 17], name="night") == [[0, 1]]
    with pytest.warns(AstropolcalWarning, match="19 of 21 frames left out.* and 9 more"):
        pair([0.0] * 20 + [45.0])


def test_sharing_gives_every_frame_a_partner():
    assert pair([0.0, 45.0, 90.0], share=True) == [[0, 1], [2, 1]]
    # complete cycles are left alone
    assert pair(CYCLE * 3, share=True) == pair(CYCLE * 3)
    # derotator angles are not bridged
    with pytest.warns(AstropolcalWarning, match=r"1 of 3.*frame 2 \(hwp 0 deg\)"):
        assert pair([0.0, 45.0, 0.0], [45.0, 45.0, 60.0], share=True) == [[0, 1]]


def test_an_angle_without_partner_is_an_error_that_names_the_row():
    with pytest.raises(ObservationError, match=r"night.ecsv, row 13: hwp = 10 deg has no partner"):
        pair([*CYCLE, 10.0], rows=[1, 4, 7, 10, 13], name="night.ecsv")
    # without rows, the frame
    with pytest.raises(ObservationError, match="table, frame index 0: hwp = 10 deg"):
        pair([10.0])


def test_angles_need_a_unit():
    with pytest.raises(ValueError, match="needs a unit such as rad"):
        pair_frames([0.0, 45.0])


@given(
    st.lists(
        st.tuples(st.sampled_from(np.arange(0, 180, 22.5)), st.sampled_from([45.0, 70.0])),
        min_size=1,
        max_size=24,
    ),
    st.booleans(),
)
def test_laws_of_pairing(frames, share):
    hwp, derotator = np.array([*frames, *((a + 45.0, d) for a, d in frames)]).T
    pairs = np.array(pair(hwp, derotator, share=share))
    plus, minus = pairs.T
    np.testing.assert_array_equal(np.mod(hwp[plus] - hwp[minus], 90.0), 45.0)
    np.testing.assert_array_equal(derotator[plus], derotator[minus])
    assert np.all(np.mod(hwp[plus], 90.0) < 45.0)
    if not share:
        # every angle was added with its partner, so everything can be paired once
        assert len(set(pairs.ravel())) == pairs.size
    assert set(pairs.ravel()) == set(range(len(hwp)))


@given(st.permutations(range(12)))
def test_pairs_follow_the_times_whatever_the_order(order):
    time = np.arange(12.0)
    hwp = np.array(CYCLE * 3)
    order = np.array(order)
    found = pair_frames(hwp[order] * u.deg, time=time[order])
    back = {tuple(order[p] for p in pair) for pair in found.tolist()}
    assert back == {(i, i + 1) for i in range(0, 12, 2)}


# --- long tables ------------------------------------------------------------------------------


def cycles(n_frames, rng):
    hwp = np.resize([0, 45, 22.5, 67.5, 90, 135, 112.5, 157.5], n_frames)
    return hwp + rng.uniform(-0.05, 0.05, n_frames), 45 + 2.5 * (np.arange(n_frames) // 16 % 30)


def test_long_tables_are_paired_as_short_ones(monkeypatch):
    """Neighbours in time first: where cycles are complete nothing changes."""
    hwp, derotator = cycles(2400, np.random.default_rng(1))
    long = pair_frames(hwp * u.deg, derotator * u.deg)
    monkeypatch.setattr("astropolcal.observations.observables._SMALL", 10_000)
    whole = pair_frames(hwp * u.deg, derotator * u.deg)
    assert len(long) == 1200
    np.testing.assert_array_equal(long, whole)


def test_partners_far_away_are_found():
    """First all frames at 0 deg, then all at 45 deg."""
    hwp = np.repeat([0.0, 45.0], 1500)
    pairs = pair_frames(hwp * u.deg)
    assert len(pairs) == 1500
    assert sorted(pairs.ravel().tolist()) == list(range(3000))


def test_time_of_pairing_is_linear():
    hwp, derotator = cycles(20_000, np.random.default_rng(2))
    start = time.process_time()
    pairs = pair_frames(hwp * u.deg, derotator * u.deg)
    assert len(pairs) == 10_000
    # quadratic work took 30 s
    assert time.process_time() - start < 5


# --- exposures -----------------------------------------------------------------------------------


def exposed(seconds, unit=u.adu, **columns):
    table = example_table(hwp=(0.0, 45.0, 45.0, 0.0), wavelength=(1.6,))
    for name in [name for name in table.colnames if name.startswith("flux")]:
        table[name] = table[name].value * unit
    table["exposure_time"] = seconds
    for name, column in columns.items():
        table[name] = column
    return Observations.from_table(table)


def test_frames_of_one_exposure_are_paired_though_others_are_nearer():
    for column in ([10, 20, 10.01, 20] * u.s, [10, 20, 10, 20]):
        observations = exposed(column)
        assert observations.pairs().tolist() == [[0, 2], [3, 1]], column
    states = exposed([10, 20, 10, 20] * u.s, hwp=np.zeros(4) * u.deg, flc_state=list("ABBA"))
    states.meta["pairing"] = "flc_state"
    assert states.pairs().tolist() == [[0, 2], [3, 1]]


def test_pairs_of_unequal_exposures_are_told():
    """Twice the light in one of them leaves a third of what a double difference should cancel."""
    for column in ([10, 20, 20, 10] * u.s, [10, 20, 20, 10]):
        with pytest.warns(AstropolcalWarning, match=r"differ in 2 of 2 groups .* 0 \(10.*1 \(20"):
            exposed(column).pairs()


def test_single_beams_of_unequal_exposures_are_told_where_they_share_a_brightness():
    table = exposed([10, 20, 20, 10] * u.s).to_table()
    table.rename_column("flux_right", "flux")
    table.remove_columns([name for name in table.colnames if name.startswith("flux_")])
    with pytest.warns(AstropolcalWarning, match=r"differ in 1 of 1 group .* 0 \(10.*1 \(20"):
        Observations.from_table(table).groups(1)
    table["group"] = [0, 1, 1, 0]
    assert len(Observations.from_table(table).groups(1)) == 4


def test_exposures_do_not_matter_where_fluxes_do_not_grow_with_them():
    seconds = [10, 20, 20, 10] * u.s
    for unit in (u.adu / u.s, u.electron / u.min, u.mJy, u.one):
        assert exposed(seconds, unit).pairs().tolist() == [[0, 1], [3, 2]], unit
    unequal = ["a", "b", "c", "d"], [10, np.nan, np.nan, 20] * u.s
    for unknown in unequal:
        assert exposed(unknown).pairs().tolist() == [[0, 1], [3, 2]], unknown
