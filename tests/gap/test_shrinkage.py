# Licensed under a 3-clause BSD style license - see LICENSE
"""Frames that are left out: groups, prediction errors, and how far they shrink."""

from types import SimpleNamespace

import gap_data as data
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import GapError
from astropolcal.gap.effects import get_effect
from astropolcal.gap.model import Linear
from astropolcal.gap.shrinkage import HeldOut, foreseen, frame_groups


def errors(squares, counts=None, whitened=None):
    squares = np.array(squares, dtype=float)
    counts = np.full(len(squares), 100) if counts is None else np.array(counts)
    whitened = squares if whitened is None else np.array(whitened, dtype=float)
    return HeldOut([f"group {i}" for i in range(len(squares))], squares, whitened, counts)


def table(n_frames, derotator=None, name="night"):
    """A dataset with the positions of its frames, degree, and nothing else."""
    columns = {} if derotator is None else {"derotator": np.deg2rad(derotator)}
    return SimpleNamespace(
        name=name,
        n_frames=n_frames,
        frame_columns=list(columns),
        position=lambda name: columns[name],
    )


# ---- numbers -------------------------------------------------------------------------------


def test_error_is_the_root_mean_square_in_percent():
    # 0.04 over 200 data and 0.05 over 800: a mean square of 9e-5
    assert errors([0.04, 0.05], [200, 800]).percent == pytest.approx(100 * np.sqrt(9e-5))
    assert errors([1, 1], [100, 300], [100.0, 500.0]).chi2 == pytest.approx(1.5)


@given(st.floats(0.01, 0.99), st.integers(3, 9))
def test_the_same_shrinkage_in_every_group_has_no_width(factor, n):
    before = errors(np.linspace(1, 2, n))
    value, low, high = before.shrinkage(errors(factor * before.squares))
    assert value == pytest.approx(100 * (1 - factor))
    assert low == pytest.approx(value)
    assert high == pytest.approx(value)


def test_interval_of_the_shrinkage_is_that_of_a_bootstrap():
    rng = np.random.default_rng(5)
    before, after = errors(rng.uniform(1, 2, 12)), errors(rng.uniform(0.2, 1.0, 12))
    value, low, high = before.shrinkage(after)
    assert low < value < high
    # for many groups the interval is that of the ratio of means, by error propagation
    ratio = after.squares.sum() / before.squares.sum()
    left = (after.squares - ratio * before.squares) / before.squares.mean()
    error = 100 * left.std() / np.sqrt(12)
    assert (high - low) / 2 == pytest.approx(error, rel=0.15)
    assert before.shrinkage(after) == (value, low, high)


def test_a_model_that_is_worse_shrinks_below_zero():
    assert errors([1.0, 1.0]).shrinkage(errors([2.0, 2.0]))[0] == pytest.approx(-100)


def test_better_is_counted_in_standard_errors():
    before, after = errors([3.0, 5.0, 7.0]), errors([2.0, 3.0, 4.0])
    # differences of 1, 2 and 3 over 100 data: mean 2, standard error 1/sqrt(3)
    assert after.better_than(before) == pytest.approx(2 * np.sqrt(3))
    assert before.better_than(after) == pytest.approx(-2 * np.sqrt(3))


def test_typical_error_is_the_mean_of_those_of_the_groups():
    found = errors([1.0, 4.0, 9.0])
    each = 100 * np.sqrt(found.squares / found.counts)
    assert found.typical_percent == pytest.approx(each.mean())
    assert found.typical_percent < found.percent


def test_a_difference_without_scatter_is_certain():
    for change, expected in [(-1.0, np.inf), (0.0, 0.0), (1.0, -np.inf)]:
        before = errors([3.0, 3.0])
        assert errors([3.0 + change] * 2).better_than(before) == expected


# ---- groups --------------------------------------------------------------------------------


def test_groups_are_derotator_angles_over_all_datasets():
    one = table(6, np.repeat([45.0, 60.0, 90.0], 2))
    two = table(4, np.repeat([90.0, 45.0], 2))
    labels, numbers = frame_groups([one, two])
    assert labels == ["derotator at 45 deg", "derotator at 60 deg", "derotator at 90 deg"]
    assert [n.tolist() for n in numbers] == [[0, 0, 1, 1, 2, 2], [2, 2, 0, 0]]


def test_angles_that_are_nearly_the_same_are_one_group():
    labels, numbers = frame_groups([table(8, [45.0, 45.1, 60.0, 60.1, 60.0, 89.95, 90.05, 90])])
    assert labels == ["derotator at 45 deg", "derotator at 60 deg", "derotator at 90 deg"]
    assert numbers[0].tolist() == [0, 0, 1, 1, 1, 2, 2, 2]


def test_other_frames_are_grouped_in_blocks():
    for tables in [
        # none, two angles only, and an angle that moves from frame to frame
        [table(24)],
        [table(24, np.repeat([45.0, 60.0], 12))],
        [table(24, np.linspace(0, 90, 24))],
        # one dataset without the angle is enough
        [table(24, np.repeat([45.0, 60.0, 90.0], 8)), table(24)],
    ]:
        labels, numbers = frame_groups(tables)
        assert labels == [f"frames {i} of 6" for i in range(1, 7)]
        assert numbers[0].tolist() == np.repeat(np.arange(6), 4).tolist()


def test_there_are_at_most_eight_blocks_and_all_frames_have_one():
    labels, numbers = frame_groups([table(101), table(50)])
    assert len(labels) == 8
    for number in numbers:
        assert np.all(np.diff(number) >= 0)
        assert set(number) == set(range(8))
        # blocks differ by a frame at most
        assert np.ptp(np.bincount(number)) <= 1


def test_too_few_frames():
    for n in [1, 11]:
        with pytest.raises(GapError, match=rf"{n} in the shortest dataset; .*twelve frames"):
            frame_groups([table(100), table(n)])
        for angles, words in ((None, ""), ([45.0] * n, "three derotator angles, or ")):
            short = table(n, angles, name="short")
            with pytest.raises(GapError, match=f"; {words}twelve frames of short,? are the least"):
                frame_groups([table(100), short])


# ---- fits ----------------------------------------------------------------------------------


def refits(model, numbers):
    """Return the fit of a model without each group of frames."""
    return [
        model.problem.fit(
            model.fit.coefficients, rows=model.problem.rows([number != i for number in numbers])
        )
        for i in range(max(map(max, numbers)) + 1)
    ]


def held_out(model, groups):
    """Return the errors of the predictions of refits."""
    gaps = [model.problem.differences(fit.coefficients) for fit in refits(model, groups[1])]
    return HeldOut.of_predictions(model.problem, groups, gaps)


def test_a_group_is_predicted_by_a_fit_that_has_not_seen_it():
    """Spoil one group: its prediction does not follow, the fit to all does."""
    model = data.fitted(data.observed(data.with_effect("beam_gain", imbalance=0.01)))
    model = model.with_effect(get_effect("beam_gain"))
    labels, numbers = frame_groups(model.observations)
    fits = refits(model, numbers)
    assert len(fits) == len(labels) == 4
    problem, found = model.problem, held_out(model, (labels, numbers))
    for i, fit in enumerate(fits):
        out = numbers[0] == i
        gap = problem.differences(fit.coefficients)[0]
        assert found.squares[i] == pytest.approx(np.sum(gap[0][:, out] ** 2))
        assert found.counts[i] == out.sum() * len(data.WAVELENGTH)
        # the fit to the other frames is the best for these
        rows = np.broadcast_to(~out, problem.channels[0].shape).ravel()
        at_all = np.sum(problem.residual(model.fit.coefficients)[rows] ** 2)
        assert fit.chi2 <= at_all + 1e-6
    fitted = problem.differences(model.fit.coefficients)[0][0]
    assert found.squares.sum() > np.sum(fitted**2)


def test_a_group_without_data_is_left_out():
    observations = data.observed()
    mask = np.zeros((observations.n_frames, observations.n_bins), dtype=bool)
    mask[8:16] = True
    model = data.fitted(observations.with_mask(mask, "clouds"))
    found = held_out(model, frame_groups(model.observations))
    assert found.labels == [f"derotator at {angle} deg" for angle in (45, 95, 120)]
    assert len(found.squares) == len(found.counts) == len(found.whitened) == 3


def test_pure_noise_is_predicted_to_the_noise():
    model = data.clean_model()
    found = held_out(model, frame_groups(model.observations))
    noise = 100 * np.sqrt(np.mean(model.problem.channels[0].sigma[0] ** 2))
    assert found.percent == pytest.approx(noise, rel=0.15)
    assert found.chi2 == pytest.approx(1.0, abs=0.2)


# ---- foreseen --------------------------------------------------------------------------------


class Table:
    """Data of three and five frames, linear in a few coefficients."""

    shape = (2, 4, 8)

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        valid = rng.random(self.shape[1:]) < 0.8
        sigma = np.broadcast_to(rng.uniform(0.5, 2, (2, 4, 1)), self.shape)
        told = {"sigma": sigma, "told": 0, "noise": sigma[0]}
        self.channel = SimpleNamespace(shape=self.shape, valid=valid, count=2, **told)
        keep = np.broadcast_to(valid, self.shape).ravel()
        self.slopes, self.target = rng.normal(size=(64, 3)), rng.normal(size=64)
        self.slopes[~keep], self.target[~keep] = 0.0, 0.0

    def left(self, kept):
        """Return the residuals of a fit to some of the rows."""
        found = np.linalg.lstsq(self.slopes[kept], self.target[kept], rcond=None)[0]
        return self.target - self.slopes @ found

    @property
    def model(self):
        tangent = np.linalg.svd(self.slopes, full_matrices=False)[0]
        problem = SimpleNamespace(channels=[self.channel], segments=[slice(0, 64)])
        return Linear(SimpleNamespace(problem=problem), tangent, self.left(slice(None)))


@given(st.integers(0, 2**32 - 1))
def test_what_is_foreseen_of_a_linear_model_is_what_refits_give(seed):
    table, number = Table(seed), np.array([0, 0, 0, 1, 1, 1, 1, 1])
    found = foreseen(table.model, (["a", "b"], [number]))
    for i in range(2):
        out = np.broadcast_to(number == i, table.shape)
        gap = table.left(~out.ravel()).reshape(table.shape)
        assert found.whitened[i] == pytest.approx(np.sum(gap[out] ** 2) / 2)
        assert found.squares[i] == pytest.approx(
            np.sum((gap[0] * table.channel.sigma[0])[out[0]] ** 2)
        )
        assert found.counts[i] == np.sum(table.channel.valid & (number == i))


def test_what_is_foreseen_is_nearly_what_refits_give():
    true = data.with_effect("beam_gain", imbalance=0.01)
    for model in (data.fitted(data.observed(true)), data.clean_model()):
        groups = frame_groups(model.observations)
        found, expected = foreseen(model, groups), held_out(model, groups)
        assert found.labels == expected.labels
        np.testing.assert_array_equal(found.counts, expected.counts)
        assert found.percent == pytest.approx(expected.percent, rel=0.05)
        assert found.chi2 == pytest.approx(expected.chi2, rel=0.1)
