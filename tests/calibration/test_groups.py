# Licensed under a 3-clause BSD style license - see LICENSE
"""Groups for cross-validation of tables made up so that the groups are known."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from astropolcal.calibration.noise import scatter as module
from astropolcal.calibration.noise.scatter import groups_by, leave_out_groups, what_is_left_out
from astropolcal.exceptions import FitError


class _Table:
    """Positions and cycles of frames, of which each pair of neighbours is a datum."""

    def __init__(self, name, derotator, cycle):
        self.name = name
        self.derotator = np.deg2rad(np.repeat(derotator, 2))
        self.cycle = np.repeat(cycle, 2)
        self.frame_columns = ["derotator"]

    def position(self, stage):
        assert stage == "derotator"
        return self.derotator


def _dataset(name, derotator, cycle=None, n_bins=2, star=False, lost=()):
    """A dataset of one group of frames a value, with some of its data masked."""
    n = len(derotator)
    table = _Table(name, derotator, np.arange(n) if cycle is None else np.asarray(cycle))
    group = np.tile(np.arange(n), n_bins)
    bins = np.repeat(np.arange(n_bins), n)
    kept = np.array([(g, b) not in lost for g, b in zip(group, bins, strict=True)], dtype=bool)
    return SimpleNamespace(
        observations=table,
        frames=np.arange(2 * n).reshape(n, 2),
        positions={"parallactic": None} if star else {"derotator": None},
        group_of_datum=group[kept],
        bin_of_datum=bins[kept],
    )


def _measurement(*datasets):
    sizes = np.cumsum([0, *(d.group_of_datum.size for d in datasets)])
    return SimpleNamespace(
        datasets=list(datasets),
        segments=[slice(a, b) for a, b in pairwise(sizes)],
        bins=np.concatenate([d.bin_of_datum for d in datasets]),
    )


@pytest.fixture(autouse=True)
def _cycles_of_the_table(monkeypatch):
    monkeypatch.setattr(module, "cycle_numbers", lambda table: table.cycle)


# --- derotator angles -----------------------------------------------------------------------


def test_groups_ascend_with_the_angle_whatever_the_order_of_the_frames():
    found = leave_out_groups(_measurement(_dataset("a", [80, 45, 60, 45], n_bins=1)))
    assert found.tolist() == [2, 0, 1, 0]


def test_angles_within_half_a_degree_are_one():
    """Neighbours count, so that a slow drift stays one group."""
    for step, n_groups in [(0.3, 1), (0.49, 1), (0.51, 4)]:
        found = leave_out_groups(_measurement(_dataset("a", 45 + step * np.arange(4), n_bins=1)))
        assert len(set(found.tolist())) == n_groups, (step, n_groups)


def test_an_encoder_that_begins_again_is_at_the_same_angle():
    for angles, groups in [
        ([359.99, 0.01, 45, 90], [0, 0, 1, 2]),
        ([179.8, 45, 0.1, 359.9], [0, 1, 0, 0]),
        ([179.4, 179.6, 90], [1, 1, 0]),
        # 180 deg of a derotator are none
        ([0, 180, 90], [0, 0, 1]),
        ([0.3, 179.3, 90], [0, 2, 1]),
        ([179.9, 0.1], [0, 0]),
    ]:
        found = leave_out_groups(_measurement(_dataset("a", angles, n_bins=1)))
        assert found.tolist() == groups, angles


def test_every_wavelength_of_a_datum_is_in_its_group():
    found = leave_out_groups(_measurement(_dataset("a", [45, 60], n_bins=3)))
    assert found.tolist() == [0, 1] * 3


def test_datasets_share_no_group():
    """Though both stand at 45 deg."""
    data = _measurement(_dataset("a", [45, 60], n_bins=1), _dataset("b", [45, 45, 80], n_bins=1))
    assert leave_out_groups(data).tolist() == [0, 1, 2, 2, 3]


# --- stars -------------------------------------------------------------------------------------


def test_cycles_of_a_star_are_left_out_in_at_most_eight_runs():
    for n_cycles, sizes in [
        (3, [1, 1, 1]),
        (8, [1] * 8),
        (16, [2] * 8),
        (20, [3, 2, 3, 2, 3, 2, 3, 2]),
    ]:
        star = _dataset("s", np.zeros(n_cycles), n_bins=1, star=True)
        found = leave_out_groups(_measurement(star))
        assert np.bincount(found).tolist() == sizes, n_cycles
        # consecutive: a run is a stretch of the night
        assert (np.diff(found) >= 0).all(), n_cycles


def test_numbers_of_cycles_need_not_begin_at_zero_or_follow_each_other():
    star = _dataset("s", np.zeros(4), cycle=[7, 7, 12, 30], n_bins=1, star=True)
    assert leave_out_groups(_measurement(star)).tolist() == [0, 0, 1, 2]


def test_a_star_behind_a_lamp_goes_on_counting():
    lamp, star = _dataset("a", [45, 60], n_bins=1), _dataset("s", [0, 0], n_bins=1, star=True)
    assert leave_out_groups(_measurement(lamp, star)).tolist() == [0, 1, 2, 3]


# --- the user's choice ---------------------------------------------------------------------------


def _night(**options):
    return _dataset("night", [45, 45, 60, 60, 60, 60], cycle=[0, 0, 1, 1, 2, 2], **options)


def test_what_makes_a_group():
    for by, expected in [("derotator", [0, 0, 1, 1, 1, 1]), ("cycle", [0, 0, 1, 1, 2, 2])]:
        assert groups_by(_measurement(_night()), by).tolist() == expected * 2, by


def test_nights_are_groups():
    data = _measurement(_night(n_bins=1), _night(n_bins=1))
    assert groups_by(data, "dataset").tolist() == [0] * 6 + [1] * 6


def test_an_unknown_way_lists_the_known_ones():
    with pytest.raises(FitError, match="= 'moon'; allowed are derotator, cycle, dataset"):
        groups_by(_measurement(_night()), "moon")


def test_one_group_leaves_nothing_to_predict_it_from():
    for by, words in [
        ("derotator", "by derotator: all data are in one group, derotator 45 deg of a"),
        ("cycle", "by cycle: all data are in one group, cycle number 0 of a"),
        ("dataset", "by dataset: all data are in one group, dataset number 0 of a"),
    ]:
        with pytest.raises(FitError, match=words):
            groups_by(_measurement(_dataset("a", [45, 45], cycle=[3, 3])), by)


def test_a_single_member_is_named():
    data = _measurement(_dataset("a", [45, 45, 60], cycle=[0, 0, 1]))
    with pytest.raises(
        FitError, match="group derotator 60 deg of a has a single member; at least 2"
    ):
        groups_by(data, "derotator")
    with pytest.raises(FitError, match="group cycle number 1 of a has a single member"):
        groups_by(data, "cycle")


def test_members_are_counted_at_the_wavelength_that_has_most():
    """One masked cell does not make a group of two a single member."""
    data = _measurement(_night(lost={(1, 0)}))
    assert groups_by(data, "derotator").size == 11
    both = _measurement(_night(lost={(1, 0), (1, 1)}))
    with pytest.raises(FitError, match="derotator 45 deg of night has a single member"):
        groups_by(both, "derotator")


def test_what_was_left_out_in_words():
    for fit, words in [
        ({}, "derotator angles"),
        ({"groups": "dataset"}, "datasets"),
        ({"groups": "given"}, "groups"),
    ]:
        assert what_is_left_out(SimpleNamespace(fit=fit)) == words, words
