# Licensed under a 3-clause BSD style license - see LICENSE
"""Where the gap lies: noise has no place, planted gaps have the right one."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from gap_data import (
    WAVELENGTH,
    chain,
    clean_model,
    fitted,
    observed,
    with_effect,
    with_flux,
)
from scipy import stats

from astropolcal import optics
from astropolcal.calibration.identifiability.linearized import orthonormal
from astropolcal.chain import insert_optic
from astropolcal.exceptions import GapError
from astropolcal.gap.residuals import (
    _Equations,
    _simplest,
    _terms,
    _Whitened,
    badly_separated,
    frame_blocks,
    frame_patterns,
    locate,
    looks,
)
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles

N_SEEDS = 24


@pytest.fixture(scope="module")
def noise():
    return [looks(clean_model(seed)) for seed in range(N_SEEDS)]


def first(where, kind="pattern"):
    return next(row for row in where if row["kind"] == kind)


# ---- noise ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_noise_is_silent():
    assert sum(bool(locate(clean_model(seed))) for seed in range(8)) <= 1


@pytest.mark.slow
def test_p_values_of_patterns_are_uniform_on_noise(noise):
    p = np.array([one["p_single"] for where in noise for one in where if one["kind"] == "pattern"])
    # the p-values of one dataset depend on each other, those of two do not: no test over all
    for level in (0.05, 0.1, 0.3, 0.5, 0.8):
        assert level - 0.07 < np.mean(p < level) < level + 0.05
    words = "harmonic 8 of the half-wave-plate angle, in the differences"
    one = [
        look["p_single"] for where in noise for look in where if look["detail"].startswith(words)
    ]
    assert len(one) == N_SEEDS
    assert stats.kstest(one, "uniform").pvalue > 0.01


@pytest.mark.slow
def test_p_values_of_places_are_uniform_on_noise(noise):
    for axis in ("wavelength", "derotator", "beam"):
        wanted = (axis, "place")
        found = [next(x for x in w if (x["axis"], x["kind"]) == wanted) for w in noise]
        assert stats.kstest([x["p_single"] for x in found], "uniform").pvalue > 0.005, axis


@pytest.mark.slow
def test_corrected_values_are_never_below_single_ones(noise):
    for one in noise[0]:
        assert one["p_value"] >= one["p_single"]
        assert 0 <= one["share"] <= 1


def test_expected_squares_of_labels_add_up():
    model = clean_model()
    data = _Whitened(model)
    label = np.arange(model.problem.n_rows) % 3
    assert data.freedom(label, 3).sum() == pytest.approx(data.n_freedom, rel=1e-9)


def test_what_a_pattern_that_is_taken_in_explains_no_other_does():
    """Against the columns of all patterns at once, which are never made, in two datasets."""
    model = fitted([observed(seed=1), observed(seed=2, name="again")])
    data, terms = _Whitened(model), [*_terms(model)[0][::7], _terms(model)[1]]
    equations, basis = _Equations(data, terms), data.tangent
    table = np.zeros((len(data.residual), equations.slices[-1].stop))
    for _, _, where, rows, columns in equations._columns():
        table[rows, where] = columns.T
    for taken in (None, 4, 0):
        if taken is not None:
            left = table - basis @ (basis.T @ table)
            own = left[:, equations.slices[taken]]
            equations.take(taken, equations.test(taken, 1e4, 100).inverse_root)
            basis = np.concatenate([basis, orthonormal(own)], axis=1)
        left = table - basis @ (basis.T @ table)
        for gram, own in zip(equations.own, equations.slices, strict=True):
            np.testing.assert_allclose(gram, left[:, own].T @ left[:, own], atol=1e-9)
            pull = left[:, own].T @ data.residual
            np.testing.assert_allclose(equations.target[own], pull, atol=1e-6)


# ---- planted gaps --------------------------------------------------------------------------


def test_beam_gain_is_constant_in_the_plate_angle():
    where = locate(fitted(observed(with_effect("beam_gain", imbalance=0.01))))
    row = first(where)
    assert row["axis"] == "hwp"
    assert row["detail"] == "what is constant in the half-wave-plate angle, in the differences"
    assert row["share"] > 0.5
    # it holds several patterns
    (null,) = [one for one in where if "null channel" in one["detail"]]
    assert null["share"] > 0.5
    assert null["kind"] == "place"


def test_what_the_angles_cannot_separate_gets_the_simplest_name():
    """A constant and a little of harmonic 2: another harmonic fits both better than either."""
    angle = np.deg2rad(np.tile(np.arange(8) * 11.25, 4))
    shape = 1 + 0.01 * (1 + 0.5 * np.sin(2 * angle))
    model = fitted(with_flux(observed(), shape))
    row = first(locate(model))
    assert row["detail"].startswith("what is constant in the half-wave-plate angle")


def test_a_harmonic_that_explains_nothing_gives_way_to_none():
    terms = [SimpleNamespace(axis="hwp", channel=0, doubtful=i > 0) for i in range(3)]
    tested = {0: SimpleNamespace(evidence=-30.0), 2: SimpleNamespace(evidence=-9.0)}
    assert _simplest(terms, tested, 2) == 2
    tested = {0: SimpleNamespace(evidence=40.0), 2: SimpleNamespace(evidence=60.0)}
    assert _simplest(terms, tested, 2) == 0
    tested = {0: SimpleNamespace(evidence=20.0), 2: SimpleNamespace(evidence=60.0)}
    assert _simplest(terms, tested, 2) == 2


def test_sharp_gap_is_found_at_its_wavelengths():
    gain = np.where(np.arange(len(WAVELENGTH)) == 2, 0.004, 0.0)
    true = insert_optic(chain(), optics.BeamGain(imbalance=gain, name="gain"), after="wollaston")
    where = locate(fitted(observed(true)))
    place = next(e for e in where if e["axis"] == "wavelength")
    assert place["detail"] == "1450 nm"
    assert place["share"] > 0.6
    assert first(where)["axis"] == "wavelength x hwp"


def test_encoder_error_follows_the_angles():
    where = locate(fitted(observed(with_effect("derotator_encoder", cosine=0.3))))
    axes = {e["axis"] for e in where if "dataset" not in e["detail"]}
    assert axes & {"hwp x derotator", "hwp", "derotator"}
    assert first(where)["axis"] in {"hwp x derotator", "hwp", "derotator", "time x hwp"}


def test_order_within_a_block_is_found():
    rng = np.random.default_rng(3)
    # the angles in another order in each block, so that order is no angle
    base = np.array([0, 45, 11.25, 56.25, 22.5, 67.5, 33.75, 78.75])
    table = QTable(
        {
            "hwp": np.concatenate([rng.permutation(base) for _ in range(4)]) * u.deg,
            "derotator": np.repeat([45, 70, 95, 120], 8) * u.deg,
        }
    )
    slot = np.tile(np.arange(8), 4) / 7 - 0.5
    data = with_flux(observed(table=table), 1 + 0.02 * slot)
    row = first(locate(fitted(data)))
    assert row["axis"] == "time"
    assert "order of frames within a block" in row["detail"]


def test_one_bad_derotator_angle_is_a_place():
    rng = np.random.default_rng(4)
    factor = np.where(np.arange(32) // 8 == 2, 1 + 0.01 * rng.normal(size=32), 1.0)
    where = locate(fitted(with_flux(observed(), factor)))
    assert "derotator at 95 deg" in [e["detail"] for e in where]
    assert "frames 16-23" in [e["detail"] for e in where]


def test_the_bad_dataset_is_named():
    bad = with_flux(observed(name="bad"), 1 + 0.01 * np.cos(np.arange(32)))
    where = locate(fitted([observed(seed=2, name="good"), bad]))
    assert 'dataset "bad"' in [e["detail"] for e in where]


def test_sequential_shares_do_not_exceed_the_gap():
    where = locate(fitted(with_flux(observed(), 1 + 0.01 * np.cos(np.arange(32)))))
    taken = [e["share"] for e in where if e["axis"] not in ("beam", "wavelength")]
    assert max(taken, default=0.0) <= 1


def test_no_freedom_is_an_error(monkeypatch):
    model = clean_model()
    monkeypatch.setattr(type(model.problem), "n_data", property(lambda self: 3))
    with pytest.raises(GapError, match="3 data"):
        locate(model)


# ---- patterns ------------------------------------------------------------------------------


def test_harmonics_that_look_alike_are_named_once():
    words = [w for axis, w in frame_patterns(observed()) if axis == "hwp"]
    # the eight angles are one period of harmonic 4: 16 would be the same as 0
    assert "harmonic 4 of the half-wave-plate angle" in words
    assert len(words) == len(set(words))
    turn = half_wave_plate_cycles(np.arange(4) * 22.5 * u.deg, [45, 90] * u.deg)
    words = [w for axis, w in frame_patterns(observed(table=turn)) if axis == "hwp"]
    # at steps of 22.5 deg harmonic 12 is harmonic 4
    assert "harmonic 12 of the half-wave-plate angle" not in words


def test_a_full_turn_separates_the_harmonics():
    full = half_wave_plate_cycles(np.arange(32) * 11.25 * u.deg, [45, 90] * u.deg)
    notes = badly_separated([observed(table=full)])
    assert not [words for words in notes if words.startswith("harmonic")]
    assert "harmonic 1 of the half-wave-plate angle" in badly_separated([observed()])


def test_order_in_a_block_is_doubtful_where_it_tells_the_angle():
    order = "the order of frames within a block at one derotator angle"
    assert order in badly_separated([observed()])
    table = half_wave_plate_cycles(np.arange(8) * 11.25 * u.deg, [45, 90] * u.deg)
    table["hwp"][8:] = table["hwp"][8:][::-1]
    assert order not in badly_separated([observed(), observed(table=table)])


def test_altitude_and_parallactic_angle_are_axes():
    data = observed()
    table = data.to_table()
    for name, step in (("altitude", 1.0), ("parallactic", 2.0)):
        table[name] = np.repeat(20 + step * np.arange(32), data.n_bins) * u.deg
    axes = {axis for axis, _ in frame_patterns(Observations.from_table(table))}
    assert {"altitude", "parallactic", "hwp x altitude"} <= axes


def test_blocks_are_runs_at_one_angle():
    blocks = frame_blocks(observed())
    assert blocks.tolist() == np.repeat(np.arange(4), 8).tolist()
