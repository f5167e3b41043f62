# Licensed under a 3-clause BSD style license - see LICENSE
"""Data, errors and frames of a dataset as loops over the table give them."""

import astropy.units as u
import numpy as np
import pytest
from scipy import stats

from astropolcal import optics
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.measurement import Measurement, Normal, Tie
from astropolcal.measurement.datasets import as_pairs
from astropolcal.measurement.parameters import FreeParameters, Uniform, bind_prior
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.2, 1.6, 2.2] * u.um


def _masked(observations, *cells):
    mask = np.zeros((observations.n_frames, 3), dtype=bool)
    for frame, bin_ in cells:
        mask[frame, bin_] = True
    return observations.with_mask(mask, "test")


def _by_hand(observations):
    """Normalized double differences and their errors, pair by pair; None where masked."""
    found = {}
    right, left = observations.flux_right, observations.flux_left
    for g, (plus, minus) in enumerate(observations.pairs()):
        for w in range(observations.n_bins):
            if observations.mask[plus, w] or observations.mask[minus, w]:
                continue
            one, two = right[[plus, minus], w], left[[plus, minus], w]
            total = np.sum(one + two)
            x = ((one[0] - two[0]) - (one[1] - two[1])) / total
            # d x / d flux = (sign - x) / total
            variance = sum(
                ((sign - x) / total) ** 2 * v[frame, w]
                for frame, s in ((plus, 1), (minus, -1))
                for sign, v in ((s, observations.variance_right), (-s, observations.variance_left))
            )
            found[g, w] = x, np.sqrt(variance)
    return found


def test_data_and_errors_are_those_of_the_pairs(chain, observations):
    for cells in [(), ((0, 0), (3, 2)), ((5, 1), (6, 1), (7, 1))]:
        table = _masked(observations, *cells)
        measurement = Measurement(chain, table)
        (part,) = measurement.datasets
        expected = _by_hand(table)
        assert measurement.n_data == part.n_data == len(expected), cells
        for i, key in enumerate(zip(part.group_of_datum, part.bin_of_datum, strict=True)):
            x, sigma = expected[int(key[0]), int(key[1])]
            assert measurement.observed[i] == pytest.approx(x, rel=1e-12), cells
            assert measurement.sigma[i] == pytest.approx(sigma, rel=1e-9), cells


def test_frames_of_a_datum_are_those_of_its_positions(chain, observations):
    (part,) = Measurement(chain, observations).datasets
    hwp, derotator = (observations.position(stage) for stage in ("hwp", "derotator"))
    np.testing.assert_allclose(part.positions["hwp"], hwp[part.frames].T)
    np.testing.assert_allclose(part.positions["derotator"], derotator[part.frames].T)
    # the plate stands 45 deg further in the minus frame
    turn = np.rad2deg(part.positions["hwp"][1] - part.positions["hwp"][0]) % 90
    np.testing.assert_allclose(turn, 45, atol=1e-9)


def test_number_of_parameters_of_a_wavelength(make_chain, observations):
    """Three common ones and four of its own; followers and fixed ones are no number more."""
    chain = make_chain()
    measurement = Measurement(chain, observations)
    common = sum(slot.size == 1 for slot in measurement.free.slots)
    own = sum(slot.size == 3 for slot in measurement.free.slots)
    (part,) = measurement.datasets
    assert part.n_parameters_per_wavelength == common + own == 7
    ties = {"derotator.diagonal": Tie("derotator.circular", factor=-1.0)}
    (tied,) = Measurement(chain, observations, ties=ties).datasets
    assert tied.n_parameters_per_wavelength == 6
    chain["hwp"].w_sio2.fixed = True
    (fixed,) = Measurement(chain, observations).datasets
    assert fixed.n_parameters_per_wavelength == 6


def test_a_chain_in_which_nothing_moves_still_has_its_frames():
    """Every frame is alike: each pair measures the same nothing."""
    still = optics.Diattenuator(diattenuation=0.3, name="mirror", fixed={"diattenuation": False})
    still = still | optics.WollastonPrism(efficiency=0.9, name="wollaston")
    moving = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    frames = half_wave_plate_cycles(derotator=[45, 60] * u.deg)
    data = simulate(moving | still, [1.6] * u.um, frames, noise=False)
    measurement = Measurement(still, data)
    assert measurement.n_data == 8
    np.testing.assert_allclose(measurement.predict(measurement.vector()), 0, atol=1e-12)


# --- fewer frames ---------------------------------------------------------------------------


def test_thinned_measurement_is_the_whole_one_at_fewer_data(chain, observations):
    whole = Measurement(chain, _masked(observations, (0, 0), (9, 1)))
    whole.stand_at(whole.vector() * 1.001)
    fewer, kept = whole.thinned(6)
    assert kept.sum() == fewer.n_data < whole.n_data
    np.testing.assert_array_equal(fewer.vector(), whole.vector())
    for key in ("observed", "sigma", "bins"):
        np.testing.assert_array_equal(getattr(fewer, key), getattr(whole, key)[kept])
    vector = whole.vector()
    np.testing.assert_allclose(fewer.predict(vector), whole.predict(vector)[kept], rtol=1e-12)
    np.testing.assert_allclose(
        fewer.jacobian(vector), whole.jacobian(vector)[:, kept], rtol=1e-9, atol=1e-14
    )


def test_thinning_draws_the_same_frames_again_and_leaves_the_whole_alone(chain, observations):
    whole = Measurement(chain, observations)
    before = whole.predict(whole.vector()).copy()
    masks = [whole.thinned(5)[1] for _ in range(2)]
    np.testing.assert_array_equal(*masks)
    np.testing.assert_array_equal(whole.predict(whole.vector()), before)


def test_a_table_is_thinned_by_itself(chain, observations, frames):
    for most in [20, 1000]:
        whole = Measurement(chain, observations)
        fewer, kept = whole.thinned(most)
        assert kept.all(), most
        assert fewer.datasets[0] is whole.datasets[0], most
    # long and short ones together
    short = simulate(chain, WAVELENGTH, half_wave_plate_cycles(derotator=[45] * u.deg), seed=2)
    whole = Measurement(chain, [observations, short])
    fewer, kept = whole.thinned(4)
    sizes = [len(part.frames) for part in fewer.datasets]
    assert sizes == [4, 4]
    assert kept[whole.segments[1]].all()
    assert not kept[whole.segments[0]].all()


# --- what a fitter is given ---------------------------------------------------------------------


@pytest.fixture
def with_prior(chain, observations):
    chain["wollaston"].efficiency.prior = Normal(0.95, 0.02)
    chain["polarizer"].theta.prior = Uniform(85 * u.deg, 95 * u.deg)
    return Measurement(chain, observations)


def test_priors_stand_behind_the_data(with_prior):
    n = with_prior.n_data
    # one residual a wavelength; a flat prior is a bound and no datum
    assert with_prior.n_priors == 3
    index, observed, weights = with_prior.fit_arguments(noise=0.01)
    assert index.tolist() == [*range(n), n, n + 1, n + 2]
    assert observed[n:].tolist() == [0, 0, 0]
    assert weights[:n].tolist() == [1] * n
    assert weights[n:].tolist() == [0.01] * 3
    predicted = with_prior(index)
    np.testing.assert_allclose(predicted[n:], (0.97 - 0.95) / 0.02)


def test_weights_of_data_and_priors(with_prior):
    weights = np.arange(with_prior.n_data, dtype=float)
    index, observed, chosen = with_prior.fit_arguments(weights, 2.0)
    n = with_prior.n_data
    assert index.tolist() == [*range(n), n, n + 1, n + 2]
    assert observed[:n].tolist() == with_prior.observed.tolist()
    assert chosen.tolist() == [*range(n), 2, 2, 2]


def test_without_weights_and_priors_there_are_no_weights(chain, observations):
    index, observed, weights = Measurement(chain, observations).fit_arguments()
    assert weights is None
    assert index.size == observed.size


def test_sum_of_squares_of_a_fitter_is_that_of_data_and_priors(with_prior):
    """What astropy minimizes, written out: the prior weighs by the noise of a datum."""
    index, observed, weights = with_prior.fit_arguments(noise=0.003)
    total = np.sum((weights * (with_prior(index) - observed)) ** 2)
    data = np.sum(with_prior.residuals() ** 2)
    prior = np.sum(((0.97 - 0.95) / 0.02 * np.ones(3)) ** 2)
    assert total == pytest.approx(data + 0.003**2 * prior, rel=1e-12)


def test_number_of_values_is_checked(with_prior):
    with pytest.raises(ParameterError, match=r"3 values for \d+ parameters"):
        with_prior.stand_at(np.zeros(3))


# --- pairs of chains and tables -----------------------------------------------------------------


def test_one_chain_serves_several_tables(chain, observations):
    found = as_pairs(chain, [observations] * 3, None)
    assert [item is chain for item, _, _ in found] == [True] * 3
    assert [position for _, _, position in found] == [None] * 3


def test_numbers_that_differ_are_told(chain, observations):
    for chains, tables, positions, words in [
        (2, 3, None, "3 datasets, 2 chains and 3 sets"),
        (1, 2, 1, "2 datasets, 1 chains and 1 sets"),
        (0, 0, None, "0 datasets, 0 chains and 0 sets"),
    ]:
        with pytest.raises(ObservationError, match=words):
            as_pairs([chain] * chains, [observations] * tables, positions and [{}] * positions)


def test_wavelength_off_the_grid_names_the_nearest(chain, observations):
    with pytest.raises(
        ObservationError, match=r"1600\.000 nm, are none .* of the parameters.*nearest 1610\.000"
    ):
        Measurement(chain, observations, wavelength=[1.2, 1.61, 2.2] * u.um)


# --- parameters ----------------------------------------------------------------------------------


def test_a_vector_at_its_bounds(chain, observations):
    free = Measurement(chain, observations).free
    _, high = free.bounds()
    vector = np.where(np.isfinite(high), high, free.start())
    at = free.at_bounds(vector)
    np.testing.assert_array_equal(at, np.isfinite(high))
    assert not free.at_bounds(free.start()).any()
    # within a hundred thousandth: relative above one, as of a turn in radian
    slot = free.by_name["derotator.horizontal"]
    assert high[slot.start] > 1
    moved = free.start()
    moved[slot.start] = high[slot.start] * (1 - 2e-6)
    assert free.at_bounds(moved)[slot.start]
    moved[slot.start] = high[slot.start] * (1 - 2e-5)
    assert not free.at_bounds(moved)[slot.start]


def test_bounds_given_out_may_be_changed(chain, observations):
    free = Measurement(chain, observations).free
    free.bounds()[0][:] = 7
    assert not (free.bounds()[0] == 7).any()


def test_values_of_fixed_followers_and_free_parameters_have_units(make_chain):
    chain = make_chain()
    ties = {"derotator.circular": Tie("derotator.diagonal", factor=2.0, offset=1 * u.deg)}
    free = FreeParameters([chain], 3, ties)
    vector = free.start()
    vector[free.by_name["derotator.diagonal"].slice] = np.deg2rad([1.0, 2.0, 3.0])
    free.put_back(vector)
    assert u.allclose(free.values_of("derotator.circular"), [3, 5, 7] * u.deg)
    assert free.values_of("wollaston.efficiency").tolist() == [0.97] * 3
    slot, factor, offset = free.lookup("derotator.circular")
    assert (slot.name, factor) == ("derotator.diagonal", 2.0)
    assert offset == pytest.approx(np.deg2rad(1))
    assert free.lookup("hwp.theta") == (None, 0.0, 0.0)


# --- priors ---------------------------------------------------------------------------------------


def test_mode_of_a_skew_density_is_where_it_peaks():
    """Against the closed forms: exp(-s^2), (a - 1), 0."""
    for name, scale, bounds in [
        ("lognorm", 0.5, (None, None)),
        ("gamma", 2.0, (0, None)),
        ("t", 4.0, (None, None)),
    ]:
        prior = bind_prior(getattr(stats, name)(scale), "a.b", None, bounds)
        expected = {"lognorm": np.exp(-(0.5**2)), "gamma": 1.0, "t": 0.0}[name]
        assert prior.mode == pytest.approx(expected, abs=1e-5), (name, scale, bounds)
        assert prior.residual(prior.mode) == pytest.approx(0, abs=1e-4), (name, scale, bounds)


def test_a_density_that_peaks_at_its_end():
    prior = bind_prior(stats.expon(scale=0.1), "a.b", None, (0, 1))
    assert prior.mode == 0.0
    # half the square of the residual is x / scale
    assert prior.residual(0.2) ** 2 / 2 == pytest.approx(2.0)
    assert np.isfinite(prior.slope(0.05))


def test_priors_that_are_none():
    for prior, words in [
        (Uniform(1 * u.deg, 1 * u.deg), "needs low below high"),
        (Uniform(0 * u.deg, np.inf * u.deg), "needs low below high"),
        (Normal(0 * u.deg, 0 * u.deg), "needs a positive std"),
        (Normal(np.nan * u.deg, 1 * u.deg), "needs a positive std"),
        (Normal(0, 1), "needs a unit"),
        (Normal(0 * u.deg, np.inf * u.deg), "needs a positive std"),
        (stats.gamma(-1), r"gamma\(-1\) is not a distribution"),
        (stats.norm(0, scale=-1), r"norm\(0, scale=-1\) is not a distribution"),
        (0.3, "is a float; allowed are Normal, Uniform"),
        (Uniform(10 * u.deg, 20 * u.deg), "outside the bounds -5 to 5 deg"),
    ]:
        with pytest.raises(ParameterError, match=words) as caught:
            bind_prior(prior, "hwp.theta", u.deg, (-5, 5))
        assert "hwp.theta" in str(caught.value), (prior, words)


def test_a_true_angle_goes_before_the_commanded_one():
    """As in simulations; of an instrument that is known its own law is asked."""
    chain = optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
    chain = optics.LinearPolarizer(name="polarizer") | chain | optics.WollastonPrism(name="prism")
    frames = half_wave_plate_cycles()
    frames["hwp_true"] = frames["hwp"] + np.linspace(1, 8, len(frames)) * u.deg
    measurement = Measurement(chain, simulate(chain, WAVELENGTH, frames, noise=False))
    assert np.abs(measurement.residuals()).max() < 1e-12
