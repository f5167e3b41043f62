# Licensed under a 3-clause BSD style license - see LICENSE
"""Shapes of what is left, and frames at odds with the run, piece by piece."""

from importlib import import_module
from types import SimpleNamespace

import gap_data as data
import numpy as np
import pytest
from scipy import stats

from astropolcal.gap.remainders import outlying_frames, remainder

# its package has a function of the same name
shapes = import_module("astropolcal.gap.frames")
WAVELENGTH = np.array([2.0, 1.2, 1.4, 1.6, 1.8])


def run(n=24, derotator=None):
    angles = {"hwp": np.deg2rad(np.tile(np.arange(8) * 11.25, n // 8))}
    if derotator is not None:
        angles["derotator"] = np.deg2rad(np.asarray(derotator, float))
    positions = angles | {"sequence": np.linspace(0, 1, n)}
    return SimpleNamespace(
        n_frames=n,
        name="run",
        frames=SimpleNamespace(colnames=list(angles)),
        position=positions.__getitem__,
    )


# ---- shapes --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("quantile", "probability"),
    # the Tracy-Widom law of order one: its median, and quantiles of Bejan (2005), table 1
    [(-1.2686, 0.50), (0.4501, 0.10), (0.9793, 0.05), (2.0234, 0.01)],
)
def test_chance_is_the_law_of_tracy_and_widom(quantile, probability):
    n, m = 200, 300
    root = np.sqrt(m - 1) + np.sqrt(n)
    spread = root * (1 / np.sqrt(m - 1) + 1 / np.sqrt(n)) ** (1 / 3)
    found = shapes._chance(root**2 + spread * quantile, n, m)
    assert found == pytest.approx(probability, rel=0.03)


def test_chance_of_a_single_row_is_chi_square():
    assert shapes._chance(30.0, 1, 20) == pytest.approx(stats.chi2.sf(30, 20))
    assert shapes._chance(30.0, 20, 1) == pytest.approx(stats.chi2.sf(30, 20))


@pytest.mark.parametrize(
    ("spectrum", "words"),
    [
        # in the order of the wavelengths, not of the table
        ([9.0, 0.1, 0.1, 0.1, 0.1], "2000 nm"),
        ([0.0, 2.0, 2.0, 0.1, 0.0], "1200-1400 nm"),
        ([0.0, 0.0, 3.0, 2.9, 0.0], "1400 nm"),
        ([1.0, 1.0, 1.0, 1.0, 1.0], "1200-1600 nm"),
    ],
)
def test_the_range_is_the_shortest_with_half_of_the_power(spectrum, words):
    assert shapes._range(np.array(spectrum), WAVELENGTH) == words


def test_a_harmonic_is_recognized_with_its_share():
    observations = run()
    plate = observations.position("hwp")
    wave = np.cos(4 * plate + 0.4)
    title, share = shapes._likeness(wave, observations)
    assert title == "harmonic 4 of the half-wave-plate angle"
    assert share == pytest.approx(1.0)
    noise = np.random.default_rng(1).normal(size=24)
    noise *= np.linalg.norm(wave) / np.linalg.norm(noise)
    _, share = shapes._likeness(wave + noise, observations)
    assert 0.2 < share < 0.8


def test_noise_is_like_nothing():
    noise = np.random.default_rng(6).normal(size=96)
    assert shapes._likeness(noise, run(96))[1] < 0.3


@pytest.fixture(scope="module")
def planted():
    """A spectrum times a harmonic, thirty times as large as the noise of a table."""
    observations = run(48)
    spectrum = np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    wave = np.sqrt(2) * np.cos(2 * observations.position("hwp") + 1)
    table = 3 * np.outer(spectrum, wave) + np.random.default_rng(2).normal(size=(5, 48))
    return spectrum, wave, shapes._shapes(table, "sum", observations, WAVELENGTH, 1e-3)


def test_a_planted_shape_is_found_alone(planted):
    spectrum, wave, found = planted
    (one,) = found
    assert one.p_value < 1e-12
    # up to a common sign
    sign = np.sign(one.frames @ wave)
    assert np.mean(one.frames**2) == pytest.approx(1)
    assert np.corrcoef(sign * one.frames, wave)[0, 1] > 0.98
    np.testing.assert_allclose(sign * one.spectrum, 3 * spectrum, atol=0.6)
    assert one.words.startswith("sums of run, strongest at 1400 nm; follows harmonic 2 of the half")


def test_power_of_a_shape_is_that_of_the_signal(planted):
    spectrum, wave, (one,) = planted
    power = np.sum(np.outer(3 * spectrum, wave) ** 2)
    assert one.share == pytest.approx(power, rel=0.05)


def test_two_shapes_come_largest_first():
    rng = np.random.default_rng(5)
    model = data.clean_model()
    two = remainder(data.fitted(data.with_flux(data.observed(), 1 + 0.01 * rng.normal(size=32))))
    shares = [one.share for one in two]
    assert shares == sorted(shares, reverse=True)
    assert all(0 < share <= 1 for share in shares)
    assert remainder(model) == []
    # with a laxer limit noise has shapes, too
    assert remainder(model, alpha=2.0) != []


# ---- frames at odds ------------------------------------------------------------------------


def test_what_is_common_to_the_wavelengths():
    table = np.zeros((6, 10)) + np.arange(6)[:, None]
    table[:, 3] += 0.5
    table[0, 7] += 9.0
    common, error, agree = shapes._common(table, np.full((6, 10), 0.1))
    expected = np.where(np.arange(10) == 3, 0.5, 0.0)
    np.testing.assert_allclose(common, expected, atol=1e-12)
    # error of a median: 1.25 times that of a mean
    np.testing.assert_allclose(error, 0.125 / np.sqrt(6))
    assert agree[3]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_drift_has_the_degree_that_pays(degree):
    rng = np.random.default_rng(3)
    x = np.linspace(0, 1, 60)
    true = np.polynomial.legendre.Legendre.basis(degree)(2 * x - 1) if degree else 0 * x
    values = true + 1e-3 * rng.normal(size=60)
    values[20:26] += 5.0
    found = shapes._drift(x, values, 4)
    # a tenth of bad frames does not bend it
    np.testing.assert_allclose(found, true, atol=2e-3)
    flat = shapes._drift(x, values, 0)
    assert np.ptp(flat) < 1e-12


def test_few_frames_drift_little():
    values = np.array([0.0, 1.0, 4.0, 9.0, np.nan])
    # four known values allow a line, no more
    left = np.diff(shapes._drift(np.linspace(0, 1, 5), values, 4), n=2)
    np.testing.assert_allclose(left, 0, atol=1e-9)


@pytest.mark.parametrize(
    ("far", "groups"),
    [
        # half of a run, and at least three frames, is the run
        ([0, 1, 2, 3], [(0, 7)]),
        ([0, 1, 2], [(0, 0), (1, 1), (2, 2)]),
        ([9], [(9, 9)]),
        ([8, 9, 10, 11, 23], [(8, 15), (23, 23)]),
    ],
)
def test_frames_are_joined_to_runs(far, groups):
    observations = run(24, np.repeat([45, 70, 95], 8))
    mask = np.isin(np.arange(24), far)
    score = np.where(mask, 7.0, 0.1)
    rows = shapes._runs(observations, "sum", mask, 0.02 * score, score)
    expected = [f"{a}-{b}" if b > a else f"{a}" for a, b in groups]
    assert [row["frames"] for row in rows] == expected


def test_words_of_a_frame_at_odds():
    observations = run(24, np.repeat([45, 70, 95], 8))
    deviation = np.where(np.arange(24) == 9, -0.1, 0.0)
    row = shapes._row(observations, "sum", np.array([9]), deviation, 80 * deviation)
    assert row["words"] == (
        "lamp unstable at derotator 70 deg (frame 9 of run): off its drift by up to 9.5 %"
    )
    assert (row["sigma"], row["deviation"]) == (8.0, -0.1)
    row = shapes._row(run(24), "difference", np.arange(8, 11), deviation, 80 * deviation)
    assert row["words"] == (
        "all wavelengths depart together at frames 8-10 of run: differences off by up to 10 %"
    )


def test_good_data_give_an_empty_table_with_its_columns():
    table = outlying_frames(data.clean_model())
    assert table.colnames == ["dataset", "frames", "channel", "deviation", "sigma", "words"]
    assert len(table) == 0


def test_the_worst_frame_comes_first():
    factor = np.ones(32)
    factor[[5, 20]] = 1.02, 1.05
    table = outlying_frames(data.fitted(data.with_flux(data.observed(), factor)))
    differences = table[table["channel"] == "difference"]
    assert list(differences["frames"]) == ["20", "5"]
    assert np.all(np.diff(table["sigma"]) <= 0)
    # 5 percent of one beam is half of that in the difference over the sum
    assert differences["deviation"][0] == pytest.approx(0.025, rel=0.3)
