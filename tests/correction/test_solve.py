# Licensed under a 3-clause BSD style license - see LICENSE
"""Least squares over frames: exact without noise, honest where frames do not suffice."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import optics
from astropolcal.correction import measurement_rows
from astropolcal.correction.solve import CHANNELS, Channels, estimator
from astropolcal.exceptions import ObservationError, ParameterError


def ideal(hwp, wavelengths=1):
    chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    chain = chain | optics.WollastonPrism(name="wollaston")
    return measurement_rows(chain, {"hwp": hwp * u.deg}, np.linspace(1.2, 2, wavelengths) * u.um)


def pairs_of(hwp):
    from astropolcal.observations.observables import pair_frames

    return pair_frames(hwp)


def test_stokes_come_back(sky, charis, star):
    for observable in CHANNELS:
        rows = measurement_rows(sky, star.positions, charis.wavelength)
        solution = estimator(rows, observable=observable, pairs=pairs_of(star.hwp))
        found = solution.apply([star.right, star.left])
        np.testing.assert_allclose(found / found[0], star.stokes / star.stokes[0], atol=1e-12)
        assert solution.determined.all(), observable
        assert solution.condition.max() < 3, observable
        assert not any(solution.weak), observable


@pytest.mark.slow
@given(weights=st.lists(st.floats(0.1, 10), min_size=16, max_size=16))
def test_no_weights_change_what_is_exact(sky, charis, star, weights):
    rows = measurement_rows(sky, star.positions, charis.wavelength)
    found = estimator(rows, weights=weights).apply([star.right, star.left])
    np.testing.assert_allclose(found, star.stokes, rtol=1e-10)


def test_a_frame_of_weight_zero_does_not_count(sky, charis, star):
    rows = measurement_rows(sky, star.positions, charis.wavelength)
    right = star.right.copy()
    right[3] = 1e9
    solution = estimator(rows, weights=np.where(np.arange(16) == 3, 0.0, 1.0))
    np.testing.assert_allclose(solution.apply([right, star.left]), star.stokes, rtol=1e-10)


def test_a_gain_that_differs_between_beams_leaves_double_differences_alone():
    hwp = np.array([0, 45, 22.5, 67.5])
    flux = np.einsum("bwfs,s->bfw", ideal(hwp), [1.0, 0.02, 0.01, 0.0])
    flux[0] *= 1.05
    kinds = {k: estimator(ideal(hwp), observable=k, pairs=[(0, 1), (2, 3)]) for k in CHANNELS}
    found = {k: s.apply(flux)[:, 0] for k, s in kinds.items()}
    for k in CHANNELS:
        # the mean gain only scales all of them
        np.testing.assert_allclose(found[k][1:] / found[k][0], [0.02, 0.01], rtol=1e-10)
    one = estimator(ideal(hwp[[0, 2]])).apply(flux[:, [0, 2]])[:, 0]
    assert abs(one[1] / one[0] - 0.02) > 0.01


def test_brightness_of_the_frames(sky, charis, star):
    scale = np.linspace(0.5, 2, 16)
    rows = measurement_rows(sky, star.positions, charis.wavelength)
    flux = np.stack([star.right, star.left]) * scale[:, None]
    np.testing.assert_allclose(estimator(rows, scale=scale).apply(flux), star.stokes, rtol=1e-10)


def test_v_is_solved_for_where_it_is_determined(sky, charis, star, seen):
    rows = measurement_rows(sky, star.positions, charis.wavelength)
    stokes = np.vstack([star.stokes, 300 * np.ones((1, 22))])
    flux = seen(sky, star.positions, charis.wavelength, stokes)
    four = estimator(rows, components="IQUV")
    np.testing.assert_allclose(four.apply(flux), stokes, atol=1e-6)
    # and what it does to the others where it is taken as zero is predicted
    three = estimator(rows)
    leaked = three.apply(flux) - star.stokes
    np.testing.assert_allclose(leaked, 300 * three.leakage.T, atol=1e-6)
    assert np.abs(three.leakage[:, 1:]).max() > 0.05


def test_v_is_taken_as_zero_and_flagged_where_it_is_not_determined():
    solution = estimator(ideal(np.array([0, 45, 22.5, 67.5])), components="IQUV")
    assert solution.determined.tolist() == [[True, True, True, False]]
    assert solution.weak == ["1.00 V"]
    assert solution.condition[0] > 1e10
    assert np.isnan(solution.gain[0, 3]).all()
    assert np.isfinite(solution.gain[0, :3]).all()
    assert solution.leakage[0, 1:3] == pytest.approx(0)


def test_too_few_angles_are_refused():
    with pytest.raises(
        ObservationError, match=r"Q and U are not determined .* by 4 frames: .* 1\.00 U;"
    ):
        estimator(ideal(np.array([0, 45, 0, 45])))
    labels = ["a.fits", "b.fits"]
    with pytest.raises(ObservationError, match=r"2 frames \(a\.fits, b\.fits\) in 1 pairs"):
        estimator(ideal(np.array([0, 45])), observable="double", pairs=[(0, 1)], labels=labels)
    with pytest.raises(ObservationError, match=r"by 1 frame: poorly"):
        estimator(ideal(np.array([0.0])))


def test_what_is_open_at_one_wavelength_only_is_flagged_there():
    hwp = np.array([0, 45, 22.5, 67.5])
    rows = ideal(hwp, 3)
    rows[:, 1, :, 2] = 0.0
    solution = estimator(rows)
    assert solution.determined[:, 2].tolist() == [True, False, True]
    assert [bool(words) for words in solution.weak] == [False, True, False]
    found = solution.apply(np.einsum("bwfs,s->bfw", rows, [1, 0.1, 0.2, 0]))
    np.testing.assert_allclose(found[1], 0.1)
    assert np.isnan(found[2, 1])
    np.testing.assert_allclose(found[2, [0, 2]], 0.2)


def test_an_open_mixture_leaves_neither():
    hwp = np.array([0, 45, 22.5, 67.5])
    rows = ideal(hwp, 2)
    rows[:, 0, :, 1] = rows[:, 0, :, 2] = rows[:, 0, :, 1] + rows[:, 0, :, 2]
    solution = estimator(rows)
    assert solution.determined[0].tolist() == [True, False, False]
    assert "0.71 Q" in solution.weak[0]
    assert "0.71 U" in solution.weak[0]


def test_open_components_are_named_the_same_on_every_processor(other_svd):
    def words():
        with pytest.raises(ObservationError, match=r"1\.00 U; 1\.00 V;") as refused:
            estimator(ideal(np.array([0, 45])), components="IQUV")
        return str(refused.value)

    before = words()
    other_svd()
    assert words() == before


def test_nearly_open_is_a_matter_of_the_limit():
    rows = ideal(np.array([0, 45, 22.5, 67.5]), 2)
    rows[:, 0, :, 2] /= 100
    assert not estimator(rows).determined[0, 2]
    assert estimator(rows, max_condition=1000).determined.all()


def test_bad_choices():
    for settings, words in [
        ({"components": "QU"}, "components = 'QU'"),
        ({"observable": "triple"}, "observable = 'triple'"),
        ({"weights": [1, 2]}, "weights has shape"),
        ({"weights": [1, -1, 1, 1]}, "weights = -1"),
        ({"scale": [1, 0, 1, 1]}, "scale = 0"),
        ({"scale": [1, np.nan, 1, 1]}, "scale = nan"),
        ({"max_condition": 1}, "max_condition = 1"),
    ]:
        with pytest.raises(ParameterError, match=words):
            estimator(ideal(np.array([0, 45, 22.5, 67.5])), **settings)


@pytest.mark.slow
@given(seed=st.integers(0, 1000))
def test_gains_of_beams_are_those_of_channels(seed):
    for observable in CHANNELS:
        rng = np.random.default_rng(seed)
        # a frame may belong to two pairs
        channels = Channels(observable, 4, [(0, 1), (2, 1), (0, 3)])
        fluxes = rng.normal(size=(2, 4, 5))
        combined = channels.combine(fluxes)
        gain = rng.normal(size=combined.shape[:2])
        direct = np.einsum("cu,cup->p", gain, combined)
        np.testing.assert_allclose(np.einsum("bf,bfp->p", channels.to_beams(gain), fluxes), direct)
