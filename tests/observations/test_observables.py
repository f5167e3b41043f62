# Licensed under a 3-clause BSD style license - see LICENSE
"""Observables against their formulas, central differences and Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from astropolcal.exceptions import ObservationError
from astropolcal.observations import OBSERVABLES, Observable
from astropolcal.observations.observables import (
    NormalizedDoubleDifference,
    get_observable,
)

N_BINS, N_DATA = 3, 5
fluxes = arrays(float, (2, N_BINS, N_DATA), elements=st.floats(1.0, 1e6))
gains = st.floats(0.1, 10.0)


def random_beams(k, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(50.0, 200.0, (2, k, N_BINS, N_DATA))


@given(fluxes, fluxes)
def test_normalized_double_difference_is_the_formula_of_the_paper(right, left):
    # CHARIS recalibration paper, Eqs. single difference to normalized double difference
    x_plus, x_minus = right[0] - left[0], right[1] - left[1]
    i_plus, i_minus = right[0] + left[0], right[1] + left[1]
    expected = (0.5 * (x_plus - x_minus)) / (0.5 * (i_plus + i_minus))
    value = get_observable("normalized_double_difference").evaluate(right, left)
    np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-15)


def test_first_pair_of_dataset_1_by_hand():
    # first two rows of the public CHARIS table of 2025-07-15 (1159.56 nm, derotator 45 deg)
    right = np.array([10609191.439855931, 3770491.050174386]).reshape(2, 1, 1)
    left = np.array([5603966.100860059, 14858776.067607284]).reshape(2, 1, 1)
    value = get_observable("normalized_double_difference").evaluate(right, left)
    assert value.shape == (1, 1)
    assert value[0, 0] == pytest.approx(16093510.3566 / 34842424.6578, rel=1e-10)


@given(fluxes, fluxes, gains, gains, gains)
def test_ratio_method_ignores_beam_gain_and_flux(right, left, gain, plus, minus):
    frame = np.array([plus, minus])[:, None, None]
    ratio = get_observable("ratio")
    changed = ratio.evaluate(right * frame, gain * left * frame)
    np.testing.assert_allclose(changed, ratio.evaluate(right, left), rtol=1e-9, atol=1e-12)


@given(fluxes, fluxes, gains, gains)
def test_per_frame_observables_ignore_the_flux(right, left, plus, minus):
    frame = np.array([plus, minus])[:, None, None]
    for name in ("per_frame_double_difference", "normalized_single_difference"):
        observable = get_observable(name)
        k = observable.frames_per_datum
        before = observable.evaluate(right[:k], left[:k])
        after = observable.evaluate((right * frame)[:k], (left * frame)[:k])
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)


@given(arrays(float, (4, N_BINS, N_DATA), elements=st.floats(1.0, 1e6)), gains)
def test_triple_difference_is_made_of_differences_of_states(fluxes, gain):
    right, left = fluxes, fluxes[::-1] * gain
    x, total = right - left, right + left
    plus, minus = x[0] - x[1], x[2] - x[3]
    value = get_observable("normalized_triple_difference").evaluate(right, left)
    np.testing.assert_allclose(value, (plus - minus) / total.sum(axis=0), rtol=1e-12, atol=1e-15)


@given(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2))
def test_triple_difference_is_blind_to_what_only_plate_or_only_state_changes(p, plate, state):
    hwp, flc = np.array([1, 1, -1, -1]), np.array([1, -1, 1, -1])
    x = (p * hwp * flc + plate * hwp + state * flc).reshape(4, 1, 1)
    value = get_observable("normalized_triple_difference").evaluate(1 + x, 1 - x)
    assert value[0, 0] == pytest.approx(p, abs=1e-12)


def test_covariance_of_triple_differences_that_share_a_pair_of_states():
    """Both have the same frames A and B at the minus angle: half of the noise is common."""
    flux = np.full((4, 1, 2), 100.0)
    frames = np.array([[0, 1, 2, 3], [4, 5, 2, 3]])
    x = get_observable("normalized_triple_difference")
    found = x.frame_covariance(flux, flux, flux, flux, 0.0, frames)[0]
    np.testing.assert_allclose(found, [[1 / 800, 1 / 1600], [1 / 1600, 1 / 800]])


def test_default_observable_does_not_ignore_the_flux():
    # the invariance above must be able to fail
    right, left = random_beams(2)
    frame = np.array([1.0, 3.0])[:, None, None]
    x = get_observable("normalized_double_difference")
    assert np.abs(x.evaluate(right * frame, left * frame) - x.evaluate(right, left)).max() > 0.01


@given(st.floats(-0.95, 0.95), st.floats(0.2, 5.0))
def test_all_double_differences_agree_for_a_steady_source_and_equal_beams(p, flux):
    right = flux * np.array([1 + p, 1 - p]).reshape(2, 1, 1)
    left = flux * np.array([1 - p, 1 + p]).reshape(2, 1, 1)
    for observable in OBSERVABLES.values():
        # the state of a modulator exchanges the beams as the half-wave plate does
        frames = [0, 1, 1, 0] if observable.frames_per_datum == 4 else [0, 1]
        frames = frames[: observable.frames_per_datum]
        value = observable.evaluate(right[frames], left[frames])
        assert value[0, 0] == pytest.approx(p, abs=1e-12)


def test_exchanging_the_beams_changes_the_sign():
    for observable in OBSERVABLES.values():
        right, left = random_beams(observable.frames_per_datum)
        value = observable.evaluate(right, left)
        np.testing.assert_allclose(observable.evaluate(left, right), -value, atol=1e-14)


def test_values_lie_between_minus_one_and_one():
    for observable in OBSERVABLES.values():
        right, left = random_beams(observable.frames_per_datum)
        assert np.abs(observable.evaluate(right, left)).max() < 1


def test_derivative_agrees_with_central_differences():
    for observable in OBSERVABLES.values():
        right, left = random_beams(observable.frames_per_datum, seed=1)
        analytic = observable.derivative(right, left)
        step = 1e-3
        for beam in (0, 1):
            assert analytic[beam].shape == right.shape
            for frame in range(observable.frames_per_datum):
                up, down = np.array([right, left]), np.array([right, left])
                up[beam, frame] += step
                down[beam, frame] -= step
                numeric = (observable.evaluate(*up) - observable.evaluate(*down)) / (2 * step)
                np.testing.assert_allclose(analytic[beam][frame], numeric, rtol=1e-6, atol=1e-11)


def test_evaluate_leaves_its_input_alone():
    for observable in OBSERVABLES.values():
        right, left = random_beams(observable.frames_per_datum)
        before = right.copy(), left.copy()
        observable.evaluate(right, left)
        observable.derivative(right, left)
        np.testing.assert_array_equal((right, left), before)


def test_masked_fluxes_stay_nan_without_a_warning():
    for observable in OBSERVABLES.values():
        right, left = random_beams(observable.frames_per_datum)
        right[0, 1, 2] = left[0, 1, 2] = np.nan
        value = observable.evaluate(right, left)
        assert np.argwhere(np.isnan(value)).tolist() == [[1, 2]]
        assert np.isnan(observable.derivative(right, left)[0][0, 1, 2])


def correlated_noise(var_right, var_left, cov, rng, n):
    """Return n draws of right and left noise with the covariance of each frame."""
    first, second = rng.standard_normal((2, n, *var_right.shape))
    slope = cov / np.sqrt(var_right)
    return np.sqrt(var_right) * first, slope * first + np.sqrt(var_left - slope**2) * second


def test_variance_agrees_with_monte_carlo():
    for observable in OBSERVABLES.values():
        rng = np.random.default_rng(20251005)
        right, left = random_beams(observable.frames_per_datum, seed=2)
        var_right, var_left = 0.01 * right, 0.02 * left
        cov = 0.6 * np.sqrt(var_right * var_left)
        n = 20000
        noise_right, noise_left = correlated_noise(var_right, var_left, cov, rng, n)
        # frames first, then draws as further bins
        shape = (observable.frames_per_datum, n * N_BINS, N_DATA)
        draws = observable.evaluate(
            np.moveaxis(right + noise_right, 0, 1).reshape(shape),
            np.moveaxis(left + noise_left, 0, 1).reshape(shape),
        ).reshape(n, N_BINS, N_DATA)
        expected = observable.variance(right, left, var_right, var_left, cov)
        # the scatter of a variance from n draws is sqrt(2 / n) = 1 per cent
        np.testing.assert_allclose(draws.var(axis=0), expected, rtol=0.05)
        # ... and the covariance of the beams matters that much
        without = observable.variance(right, left, var_right, var_left, 0.0)
        assert np.abs(without / expected - 1).max() > 0.2


def test_unknown_variances_give_unknown_errors():
    for observable in OBSERVABLES.values():
        right, left = random_beams(observable.frames_per_datum)
        unknown = np.full_like(right, np.nan)
        assert np.isnan(observable.variance(right, left, unknown, unknown, unknown)).all()


def test_covariance_without_shared_frames_is_the_variance():
    for observable in OBSERVABLES.values():
        k = observable.frames_per_datum
        right, left = random_beams(k)
        frames = np.arange(k * N_DATA).reshape(N_DATA, k)
        covariance = observable.frame_covariance(right, left, right, left, 0.1 * right, frames)
        variance = observable.variance(right, left, right, left, 0.1 * right)
        np.testing.assert_allclose(covariance, np.eye(N_DATA) * variance[:, :, None], atol=1e-15)


@pytest.mark.slow
def test_covariance_of_shared_frames_agrees_with_monte_carlo():
    for observable in [o for o in OBSERVABLES.values() if o.frames_per_datum == 2]:
        rng = np.random.default_rng(7)
        # data 0 and 1 share their minus frame, datum 2 has frame 1 as its plus frame
        frames = np.array([[0, 1], [2, 1], [1, 3], [4, 5]])
        right, left = rng.uniform(80.0, 160.0, (2, 6, 2))
        var_right, var_left = 0.01 * right, 0.02 * left
        cov = -0.4 * np.sqrt(var_right * var_left)
        n = 20000
        noise_right, noise_left = correlated_noise(var_right, var_left, cov, rng, n)

        def of_frames(values, frames=frames):
            return np.moveaxis(values[..., frames.T, :], -1, -2)

        draws = np.array(
            [
                observable.evaluate(of_frames(right + a), of_frames(left + b))
                for a, b in zip(noise_right, noise_left, strict=True)
            ]
        )
        found = observable.frame_covariance(
            *(of_frames(values) for values in (right, left, var_right, var_left, cov)), frames
        )
        for b in range(2):
            expected = np.cov(draws[:, b].T)
            scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
            # in units of correlation, whose scatter is 1 / sqrt(n) = 0.007
            np.testing.assert_allclose(found[b] / scale, expected / scale, atol=0.04)
            assert abs(found[b, 0, 1] / scale[0, 1]) > 0.2, observable
            assert found[b, 0, 3] == 0, observable
            np.testing.assert_allclose(found[b], found[b].T, rtol=1e-12)
            assert np.linalg.eigvalsh(found[b]).min() > 0, observable


def test_covariance_refuses_frames_of_the_wrong_shape():
    right, left = random_beams(2)
    with pytest.raises(ObservationError, match=r"frames has shape \(5, 1\), allowed is .*\(5, 2\)"):
        get_observable("ratio").frame_covariance(
            right, left, right, left, 0.0, np.zeros((N_DATA, 1), int)
        )


def test_every_observable_is_described():
    for observable in OBSERVABLES.values():
        assert isinstance(observable, Observable)
        assert OBSERVABLES[observable.name] is observable
        assert observable.frames_per_datum in (1, 2, 4)
        assert observable.description in repr(observable)


def test_the_default_comes_first():
    assert next(iter(OBSERVABLES)) == "normalized_double_difference"


def test_names_are_forgiving():
    for name in ["ratio", "RATIO", "Normalized-Double-Difference", "normalized double difference"]:
        assert get_observable(name).name == name.lower().replace("-", "_").replace(" ", "_"), name


def test_an_observable_passes_through():
    mine = NormalizedDoubleDifference()
    assert get_observable(mine) is mine


def test_a_misspelt_name_gets_a_suggestion():
    with pytest.raises(ObservationError, match=r"observable = 'ratoi'.*did you mean 'ratio'"):
        get_observable("ratoi")


def test_a_hopeless_name_gets_the_list():
    with pytest.raises(
        ObservationError, match="allowed are normalized_double_difference, "
    ) as info:
        get_observable("12345")
    assert "did you mean" not in str(info.value)
