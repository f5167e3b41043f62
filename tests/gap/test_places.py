# Licensed under a 3-clause BSD style license - see LICENSE
"""Sets of data with larger residuals: the scan statistic, its labels and its names."""

from types import SimpleNamespace

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from astropy.table import QTable
from scipy import stats

from astropolcal.gap import residuals
from astropolcal.gap.residuals import _Whitened
from astropolcal.simulation import half_wave_plate_cycles


def whitened(residual, label_freedom=None):
    """Residuals of unit noise in which nothing was fitted."""
    return SimpleNamespace(
        residual=residual,
        scale=max(residual @ residual - residual.size, np.sqrt(2 * residual.size)),
        freedom=lambda label, count: np.bincount(label, minlength=count).astype(float),
    )


def by_hand(squares, freedom, start, stop):
    """Log likelihood ratio of two normal variances against one."""
    inside, outside = squares[start:stop].sum(), squares.sum() - squares[start:stop].sum()
    n_in, n_out = freedom[start:stop].sum(), freedom.sum() - freedom[start:stop].sum()

    def log_likelihood(total, n):
        variance = total / n
        return -0.5 * n * np.log(variance) - 0.5 * n

    if inside / n_in <= outside / n_out:
        return 0.0
    together = log_likelihood(inside + outside, n_in + n_out)
    return log_likelihood(inside, n_in) + log_likelihood(outside, n_out) - together


# ---- the statistic -------------------------------------------------------------------------


def test_unevenness_is_a_likelihood_ratio():
    rng = np.random.default_rng(1)
    freedom = np.array([30.0, 20.0, 40.0, 25.0])
    squares = rng.chisquare(freedom) * [1.0, 2.0, 0.5, 1.0]
    pairs = [(a, b) for a in range(4) for b in range(a + 1, 5) if b - a < 4]
    found = residuals._unevenness(squares[None], freedom, pairs)[0]
    expected = [by_hand(squares, freedom, a, b) for a, b in pairs]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert found[pairs.index((1, 2))] == found.max()


def test_less_than_elsewhere_is_no_place():
    found = residuals._unevenness(np.array([[1.0, 30.0]]), np.array([10.0, 10.0]), [(0, 1), (1, 2)])
    assert found[0, 0] == 0
    assert found[0, 1] > 0


def test_the_place_is_the_run_that_stands_out():
    for template, expected in [("{} nm", "20-30 nm"), (None, "20")]:
        label = np.repeat(np.arange(6), 200)
        sigma = np.array([1, 1.6, 1.6, 1, 1, 1])[label]
        residual = sigma * np.random.default_rng(2).normal(size=label.size)
        names = [10, 20, 30, 40, 50, 60]
        (row,) = residuals.most_uneven(whitened(residual), "wavelength", label, names, template)
        # without a template labels have no neighbours
        assert row["detail"].startswith(expected[:2])
        assert row["detail"] == expected or template is None
        assert row["kind"] == "place"
        assert row["p_single"] < 1e-9
        inside = (label == 1) | (label == 2) if template else label == int(row["detail"]) / 10 - 1
        excess = np.sum(residual[inside] ** 2) - inside.sum()
        assert row["share"] == pytest.approx(excess / (residual @ residual - residual.size))


def test_a_place_holds_half_of_the_labels_at_the_most():
    label = np.repeat(np.arange(4), 300)
    sigma = np.array([1, 2, 2, 2])[label]
    residual = sigma * np.random.default_rng(3).normal(size=label.size)
    (row,) = residuals.most_uneven(whitened(residual), "time", label, [1, 2, 3, 4], "{}")
    first, _, last = row["detail"].partition("-")
    assert int(last or first) - int(first) == 1


def test_probabilities_of_noise_are_uniform():
    label = np.repeat(np.arange(5), 40)
    rng = np.random.default_rng(4)
    p = [
        residuals.most_uneven(whitened(rng.normal(size=200)), "x", label, range(5), "{}")[0][
            "p_single"
        ]
        for _ in range(60)
    ]
    assert stats.kstest(p, "uniform").pvalue > 0.01
    # the data themselves count as one of the draws
    counts = 1001 * np.array([value for value in p if value > 0.05])
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)


def test_probability_beyond_the_draws_is_a_bound():
    """No draw reaches so far: chi-square of one number, times the looks."""
    label = np.repeat(np.arange(2), 500)
    residual = np.where(label == 1, 2.0, 1.0) * np.random.default_rng(5).normal(size=1000)
    (row,) = residuals.most_uneven(whitened(residual), "beam", label, ["a", "b"], None)
    # one-sided, for the larger of two variances
    expected = 2 * stats.chi2.sf(2 * row["evidence"], 1) / 2
    assert row["p_single"] == pytest.approx(expected)
    assert row["p_single"] < 1e-30


def test_one_label_is_no_place():
    assert residuals.most_uneven(None, "dataset", None, ["all"], None) == []


# ---- names ---------------------------------------------------------------------------------


def test_names_of_places():
    for names, start, stop, template, words in [
        (["a", "b"], 1, 2, None, "b"),
        ([1200, 1400, 1600], 0, 1, "{} nm", "1200 nm"),
        ([1200, 1400, 1600], 0, 2, "{} nm", "1200-1400 nm"),
        ([(0, 7), (8, 15), (16, 23)], 0, 1, "frames", "frames 0-7"),
        ([(0, 7), (8, 15), (16, 23)], 1, 3, "frames", "frames 8-23"),
    ]:
        assert residuals._name(names, start, stop, template) == words


# ---- labels --------------------------------------------------------------------------------


def looks(model):
    return {axis: (label, names, template) for axis, label, names, template in
            residuals.places(model)}  # fmt: skip


def test_every_row_has_its_label():
    model = data.clean_model()
    found, shape = looks(model), model.problem.channels[0].shape
    label, names, _ = found["wavelength"]
    assert names.tolist() == data.WAVELENGTH.value.astype(int).tolist()
    np.testing.assert_array_equal(label.reshape(shape)[1, :, 5], np.arange(7))
    label, names, template = found["derotator"]
    np.testing.assert_array_equal(label.reshape(shape)[0, 3], np.repeat(range(4), 8))
    assert (list(names), template) == (["45", "70", "95", "120"], "derotator at {} deg")
    label, names, _ = found["beam"]
    assert label.reshape(shape)[:, 0, 0].tolist() == [0, 1]
    label, names, template = found["time"]
    # as messages name the frames
    assert names == [("0", "7"), ("8", "15"), ("16", "23"), ("24", "31")]
    assert "dataset" not in found
    assert all(len(one) == model.problem.n_rows for one, *_ in found.values())


def test_datasets_are_a_place_where_there_are_several():
    model = data.fitted([data.observed(name="a"), data.observed(seed=2, name="b")])
    found = looks(model)
    label, names, _ = found["dataset"]
    assert names == ['dataset "a"', 'dataset "b"']
    half = model.problem.n_rows // 2
    assert set(label[:half]) == {0}
    assert set(label[half:]) == {1}
    # the order of frames means nothing over several runs
    assert "time" not in found


def test_two_derotator_angles_have_no_run_between_them():
    table = half_wave_plate_cycles(derotator=[45, 90] * u.deg)
    model = data.fitted(data.observed(table=table))
    assert "derotator" not in looks(model)


def test_frames_of_one_angle_each_are_divided_evenly():
    table = QTable({"hwp": np.tile(np.arange(8) * 11.25, 4) * u.deg})
    table["derotator"] = np.linspace(20, 140, 32) * u.deg
    model = data.fitted(data.observed(table=table))
    _, names, template = looks(model)["time"]
    assert template == "frames"
    names = [tuple(map(int, ends)) for ends in names]
    assert names[0][0] == 0
    assert names[-1][1] == 31
    sizes = [last - first + 1 for first, last in names]
    assert sum(sizes) == 32
    assert max(sizes) - min(sizes) <= 1
    assert len(names) <= 24


def test_expected_squares_leave_out_what_is_masked():
    observations = data.observed()
    mask = np.zeros((observations.n_frames, observations.n_bins), dtype=bool)
    mask[:, 3] = True
    model = data.fitted(observations.with_mask(mask, "water"))
    seen = _Whitened(model)
    label = looks(model)["wavelength"][0]
    freedom = seen.freedom(label, 7)
    assert freedom[3] == pytest.approx(0, abs=1e-9)
    assert np.all(np.delete(freedom, 3) > 30)
    assert freedom.sum() == pytest.approx(seen.n_freedom)
