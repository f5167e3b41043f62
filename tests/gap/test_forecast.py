# Licensed under a 3-clause BSD style license - see LICENSE
"""What new exposures would tell: separations and open directions, from closed forms."""

from dataclasses import replace
from types import SimpleNamespace

import gap_data as data
import numpy as np
import pytest

from astropolcal.exceptions import GapError
from astropolcal.gap import planning
from astropolcal.gap._forecast import Known, _hypothetical, _Noise, _set_up, separation
from astropolcal.gap.planning import Exposure, few

CYCLE = tuple(np.arange(8) * 11.25)


def known(slopes, tight=None, names=None):
    """What data with these whitened slopes determine."""
    new = object.__new__(Known)
    n = slopes.shape[1]
    tight = np.zeros(n) if tight is None else tight
    new.problem = SimpleNamespace(size=n, names=names or [f"p{i}" for i in range(n)])
    new.slopes = np.concatenate([slopes, np.diag(tight)])
    scale = np.linalg.norm(new.slopes, axis=0)
    new.scale = np.where(scale > 0, scale, 1.0)
    return new


# ---- open directions -----------------------------------------------------------------------


def test_directions_are_divided_into_known_and_open():
    slopes = np.array([[1.0, 1.0, 0.0], [0.0, 0.0, 2.0], [1.0, 1.0, 1.0]])
    determined, is_open = known(slopes).directions
    assert (determined.shape, is_open.shape) == ((3, 2), (3, 1))
    np.testing.assert_allclose(np.abs(is_open[:, 0]), [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-9)
    assert is_open[0, 0] == pytest.approx(-is_open[1, 0])


def test_a_new_row_fixes_an_open_difference():
    """Four rows know the sum of two, a new one the first: what is left of the difference."""
    one = known(np.array([[50.0, 50.0]] * 4), names=["a.theta", "b.theta"])
    names, sigmas, count = one.fixes(np.array([[300.0, 0.0]]))
    assert set(names) == {"a.theta", "b.theta"}
    # the first by 1/300, the sum by 1/100; a step of 0.01 of each is a difference of 0.02
    assert sigmas == pytest.approx(0.02 / np.sqrt(4 / 300**2 + 1 / 100**2))
    assert count == 1
    names, sigmas, count = one.fixes(np.array([[7.0, 7.0]]))
    assert sigmas == pytest.approx(0, abs=1e-6)
    assert count == 0


def test_a_prior_leaves_nothing_open():
    one = known(np.array([[5.0, 5.0]]), tight=np.array([1.0, 0.0]))
    assert one.directions[1].shape == (2, 0)


# ---- separations ---------------------------------------------------------------------------


class Sees:
    """Slopes and predictions of a model for one exposure."""

    def __init__(self, slopes, predicted):
        self.slopes, self.predicted = slopes, predicted

    def columns(self, j):
        return self.slopes

    def against(self, other, j):
        return other.predicted - self.predicted


def triangle_of(slopes, target):
    """Known, with the triangle of its slopes and of the difference to the truth."""
    one = known(slopes)
    full = np.column_stack([one.slopes / one.scale, np.append(target, np.zeros(slopes.shape[1]))])
    one.triangle = lambda other: np.linalg.qr(full, mode="r")
    return one


def test_separation_is_the_chi_square_that_new_data_add():
    rng = np.random.default_rng(2)
    old_slopes, new_slopes = rng.normal(size=(20, 3)), rng.normal(size=(6, 3))
    before, after = rng.normal(size=20), rng.normal(size=6)
    wrong = triangle_of(old_slopes, before)
    found = separation(
        {"a": wrong, "b": None},
        {"a": Sees(new_slopes, np.zeros(6)), "b": Sees(None, after)},
        "b",
        "a",
        0,
    )

    def left(matrix, target):
        return np.sum((target - matrix @ np.linalg.lstsq(matrix, target, rcond=None)[0]) ** 2)

    both = left(np.concatenate([old_slopes, new_slopes]), np.concatenate([before, after]))
    assert found == pytest.approx(np.sqrt(both - left(old_slopes, before)), rel=1e-6)


def test_what_a_model_can_follow_separates_nothing():
    rng = np.random.default_rng(3)
    slopes = rng.normal(size=(6, 2))
    wrong = triangle_of(rng.normal(size=(20, 2)), np.zeros(20))
    new = {"a": Sees(slopes, np.zeros(6)), "b": Sees(None, np.zeros(6))}
    assert separation({"a": wrong, "b": None}, new, "b", "a", 0) == pytest.approx(0, abs=1e-6)


# ---- noise of new frames -------------------------------------------------------------------


def noise(flicker=0.0, lamp=1.0):
    sigma = np.full((2, 3, 5), 0.01)
    channel = SimpleNamespace(
        sigma=sigma, valid=np.ones((3, 5), dtype=bool), lamp=SimpleNamespace(flicker=flicker)
    )
    base = SimpleNamespace(problem=SimpleNamespace(channels=[channel]))
    return _Noise(base, Exposure(0, CYCLE, lamp=lamp))


def test_photon_noise_falls_with_the_root_of_the_lamp():
    array = np.random.default_rng(1).normal(size=(2, 3, 4))
    np.testing.assert_allclose(noise().whiten(array)[0], array[0] / 0.01)
    np.testing.assert_allclose(noise(lamp=4.0).whiten(array)[0], 2 * array[0] / 0.01)


def test_brightness_of_a_block_is_no_information():
    array = np.ones((2, 3, 4)) * np.arange(3)[:, None]
    found = noise().whiten(array)
    np.testing.assert_allclose(found[1], 0, atol=1e-9)
    assert np.abs(found[0]).max() > 100


def test_flicker_takes_what_is_common_to_the_wavelengths():
    common = np.zeros((2, 3, 4))
    common[1] = np.array([1.0, -1.0, 1.0, -1.0])
    own = np.zeros((2, 3, 4))
    own[1, 0], own[1, 1] = common[1, 0], -common[1, 0]
    quiet, restless = noise(), noise(flicker=1.0)
    norm = np.sqrt(3) / 0.01
    expected = np.linalg.norm(quiet.whiten(common)) / np.sqrt(1 + norm**2)
    assert np.linalg.norm(restless.whiten(common)) == pytest.approx(expected)
    np.testing.assert_allclose(restless.whiten(own), quiet.whiten(own))


# ---- set-ups -------------------------------------------------------------------------------


def test_the_polarizer_is_turned_with_its_bounds():
    chain = data.chain()
    old = chain["calibration_polarizer"].theta
    new = _set_up(chain, Exposure(0, CYCLE, polarizer_turned=45.0))["calibration_polarizer"].theta
    assert new.value == pytest.approx(old.value + 45)
    low, high = old.bounds
    assert new.bounds == (
        None if low is None else low + 45,
        None if high is None else high + 45,
    )
    bare = _set_up(chain, Exposure(0, CYCLE, without=("calibration_polarizer",)))
    with pytest.raises(GapError, match="no polarizer to turn in the chain of this dataset"):
        _set_up(bare, Exposure(0, CYCLE, polarizer_turned=45.0))


def test_new_frames_are_as_bright_as_the_old_ones():
    model = data.clean_model()
    one = Exposure(0, CYCLE, (("derotator", 100.0),))
    group = [one, replace(one, hwp=CYCLE[:4], positions=(("derotator", 20.0),))]
    found = _hypothetical(model, group)
    assert found.n_frames == 12
    np.testing.assert_allclose(np.rad2deg(found.position("derotator")), [*[100.0] * 8, *[20.0] * 4])
    np.testing.assert_allclose(np.rad2deg(found.position("hwp")), [*CYCLE, *CYCLE[:4]])
    level = [np.median(o.flux_right + o.flux_left) for o in (found, model.observations[0])]
    assert level[0] == pytest.approx(level[1], rel=0.02)
    brighter = _hypothetical(model, [replace(one, lamp=2.0)])
    ratio = brighter.flux_right / _hypothetical(model, [one]).flux_right
    np.testing.assert_allclose(ratio, 2.0)


def test_what_is_masked_is_not_foreseen():
    """A wavelength without data weighs nothing, and masked frames do not change the level."""
    observations = data.observed()
    mask = np.zeros((observations.n_frames, observations.n_bins), dtype=bool)
    mask[:, 3], mask[:20, 5] = True, True
    model = data.fitted(observations.with_mask(mask, "water"))
    one = Exposure(0, CYCLE, (("derotator", 100.0),))
    weights = _Noise(model, one).whiten(np.ones((2, 7, 4)))[0]
    assert np.all(weights[3] == 0)
    assert np.all(np.delete(weights, 3, axis=0) > 0)
    found = _hypothetical(model, [one])
    level = np.median((found.flux_right + found.flux_left)[:, 5])
    seen = (observations.flux_right + observations.flux_left)[20:, 5]
    assert level == pytest.approx(np.median(seen), rel=0.02)
    assert np.isfinite(found.flux_right).all()


# ---- ranking -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "effort"),
    [
        ({}, 0),
        ({"polarizer_turned": 45.0}, 1),
        ({"lamp": 2.0, "without": ("polarizer",)}, 2),
        ({"hwp": (0.0, 56.25, 337.5)}, 1),
        ({"hwp": (0.0, 270.0)}, 0),
    ],
)
def test_effort_counts_what_has_to_be_changed(changes, effort):
    assert replace(Exposure(0, CYCLE), **changes).effort == effort


def test_a_change_must_be_worth_its_effort():
    plain, changed = Exposure(0, CYCLE), Exposure(0, CYCLE, lamp=2.0)
    rows = []
    planning._note(rows, plain, ("a", "b"), 10.0, "tells a from b")
    planning._note(rows, changed, ("a", "b"), 10.9, "tells a from b")
    planning._note(rows, plain, ("a", "b"), 0.99, "tells a from b")
    assert len(rows) == 2
    assert rows[0][0] > rows[1][0]
    planning._note(rows, changed, ("a", "b"), 11.1, "tells a from b")
    assert rows[2][0] > rows[0][0]
    assert rows[0][2]["words"].endswith("tells a from b at 10 standard deviations")


@pytest.mark.parametrize(("gain", "words"), [(1.234, "1.2"), (99.0, "99"), (1234.5, "1234")])
def test_gains_have_two_digits_or_are_whole(gain, words):
    assert planning._sigmas(gain) == words


def test_the_best_of_each_purpose_comes_before_the_second_of_any():
    lists = [[{"gain": 9.0}, {"gain": 8.0}], [{"gain": 2.0}], []]
    assert [e["gain"] for e in planning._in_turn(lists, 2)] == [9.0, 2.0]
    assert [e["gain"] for e in planning._in_turn(lists, 3)] == [9.0, 8.0, 2.0]
    assert few([], limit=3) == []


def test_exposures_of_one_set_up_are_computed_together():
    base = Exposure(0, CYCLE, (("derotator", 10.0),))
    turned = replace(base, polarizer_turned=45.0)
    groups = planning._groups([base, turned, replace(base, positions=(("derotator", 20.0),))])
    assert [len(group) for group in groups] == [2, 1]


def test_titles_of_what_is_told_apart():
    title = planning._titled("beam_gain")
    assert title == "unequal gains of the two beams (flat field) (beam_gain)"
    assert planning._titled("mine") == "mine"
