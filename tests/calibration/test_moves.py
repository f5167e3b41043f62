# Licensed under a 3-clause BSD style license - see LICENSE
"""Moves and starts of the walkers, against distributions that are known."""

import warnings

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate
from astropolcal.calibration import sample
from astropolcal.calibration.posterior import LogPosterior
from astropolcal.calibration.posterior import sampler as sampling_module
from astropolcal.calibration.posterior.sampler import (
    Laplace,
    default_moves,
    move_names,
    refuse_biased,
)
from astropolcal.calibration.posterior.samples import autocorrelation_times
from astropolcal.exceptions import AstropolcalWarning, FitError

emcee = pytest.importorskip("emcee")
pytestmark = pytest.mark.samplers


class Normal:
    """
    A normal distribution of any covariance, with the interface of a LogPosterior.

    ``mistaken`` widens what the linear problem tells, as if the fit were wrong.
    """

    def __init__(self, n, seed=1, mistaken=1.0, low=-np.inf, centre=0.0):
        rng = np.random.default_rng(seed)
        self.root = rng.normal(size=(n, 2 * n + 5)) * np.geomspace(0.5, 5, 2 * n + 5)
        self.mistaken = mistaken
        self.centre = np.full(n, centre)
        self.low, self.high = np.full(n, low), np.full(n, np.inf)

    def __call__(self, rows):
        inside = (rows >= self.low).all(axis=1)
        return np.where(inside, -0.5 * np.sum((rows @ self.root) ** 2, axis=1), -np.inf)

    def whitened_jacobian(self):
        return self.root / self.mistaken

    def physical_scale(self):
        return np.ones(len(self.root))

    def whitened(self, chain):
        """Return a chain in coordinates of unit variance."""
        return chain @ np.linalg.cholesky(self.root @ self.root.T)


def run(target, moves, n_steps, n_walkers=None, start=1.0, seed=1):
    """Sample from walkers that start in the distribution, times ``start``."""
    n = target.centre.size
    n_walkers = max(2 * n, 24) if n_walkers is None else n_walkers
    sampler = emcee.EnsembleSampler(n_walkers, n, target, moves=moves, vectorize=True)
    coords = start * Laplace(target).start(n_walkers, np.random.default_rng(seed))
    state = emcee.State(coords, random_state=np.random.RandomState(seed).get_state())
    sampler.run_mcmc(state, n_steps)
    return sampler.get_chain(discard=n_steps // 3)


@pytest.mark.long
def test_default_moves_keep_a_normal_distribution():
    for n in [3, 10, 60]:
        target = Normal(n)
        chain = run(target, default_moves(emcee, Laplace(target)), 3000)
        assert target.whitened(chain).std() == pytest.approx(1, abs=0.02), n


@pytest.mark.long
def test_default_moves_find_the_distribution_though_the_fit_is_wrong():
    """The steps around the fit then hardly help, but do no harm."""
    for mistaken in [0.5, 2.0]:
        target = Normal(20, mistaken=mistaken)
        chain = run(target, default_moves(emcee, Laplace(target)), 6000)
        assert target.whitened(chain).std() == pytest.approx(1, abs=0.04), mistaken


@pytest.mark.slow
def test_default_moves_widen_a_start_that_is_too_narrow():
    target = Normal(20)
    chain = run(target, default_moves(emcee, Laplace(target)), 2000, start=0.3)
    assert target.whitened(chain).std() == pytest.approx(1, abs=0.04)


@pytest.mark.slow
def test_each_default_move_alone_keeps_a_normal_distribution():
    target = Normal(12)
    for move, _ in default_moves(emcee, Laplace(target)):
        assert target.whitened(run(target, move, 3000)).std() == pytest.approx(1, abs=0.03)


@pytest.mark.slow
def test_steps_around_the_fit_are_worth_it_in_many_dimensions():
    target = Normal(60)
    moves = default_moves(emcee, Laplace(target))
    around, alone = (
        autocorrelation_times(run(target, these, 1500)).max()
        for these in (moves, [(emcee.moves.DEMove(), 1.0)])
    )
    assert around < 40
    assert alone > 4 * around


@pytest.mark.slow
def test_half_of_a_normal_distribution_at_a_bound():
    """One parameter at its bound: mean and width of half a normal distribution."""
    target = Normal(12)
    target.root = np.eye(12)
    target.low = np.where(np.arange(12) == 0, 0.0, -np.inf)
    moves = default_moves(emcee, Laplace(target))
    assert [name for name, _ in move_names(moves)] == [
        "DEMove", "CrankNicolsonMove", "BoundDEMove"
    ]  # fmt: skip
    chain = run(target, moves, 8000)
    assert chain[..., 0].min() >= 0
    assert chain[..., 0].mean() == pytest.approx((2 / np.pi) ** 0.5, rel=0.03)
    assert chain[..., 0].std() == pytest.approx((1 - 2 / np.pi) ** 0.5, rel=0.03)
    assert chain[..., 1:].std() == pytest.approx(1, abs=0.02)


def test_moves_of_an_open_direction_leave_it_to_differential_evolution():
    """Along a direction without data the steps around the fit do not move."""
    target = Normal(12)
    target.root[:] = 0
    target.root[1:, 1:12] = np.eye(11)
    target.low, target.high = np.full(12, -3.0), np.full(12, 3.0)
    laplace = Laplace(target)
    assert laplace.determined.sum() == 11
    moves = {type(move).__name__: move for move, _ in default_moves(emcee, laplace)}
    coords = np.random.default_rng(1).uniform(-1, 1, size=(5, 12))
    moved, _ = moves["CrankNicolsonMove"].get_proposal(coords, np.random.RandomState(1))
    np.testing.assert_allclose(moved[:, 0], coords[:, 0], rtol=1e-12)
    assert (moved[:, 1:] != coords[:, 1:]).all()


@pytest.fixture(scope="module")
def calibration(make):
    """A CHARIS-like fit of 6 wavelengths, one efficiency at its bound."""
    wavelength = make.charis.wavelength[::4]
    truth = make.truth(make.chain(wavelength=wavelength))
    truth["wollaston"].efficiency = [1.0, *truth["wollaston"].efficiency.value[1:]]
    data = make.observe(truth, wavelength=wavelength, flux=1e5, seed=6)
    cal = calibrate(truth, data, weights="errors", errors="white", cross_validate=False)
    assert cal.at_bound == ["wollaston.efficiency[0]"]
    return cal


def test_snooker_steps_of_a_biased_emcee_are_refused(calibration):
    moves = [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]
    refuse_biased(moves, "3.1.7")
    refuse_biased(moves[:1], "3.1.6")
    with pytest.raises(FitError, match=r"DESnookerMove of emcee 3\.1\.6 samples too narrow"):
        refuse_biased(moves, "3.1.6")
    if emcee.__version__ == "3.1.6":
        with pytest.raises(FitError, match="too narrow"):
            sample(calibration, moves=moves, n_steps=40, progress=False)
    for wrong in ("stretch", ["stretch"], [("stretch", 1.0)]):
        with pytest.raises(FitError, match="moves: 'stretch'; allowed are moves of emcee"):
            sample(calibration, moves=wrong, n_steps=40, progress=False)


def test_walkers_start_with_the_covariance(calibration):
    log_posterior = LogPosterior(calibration.measurement)
    start = Laplace(log_posterior).start(2000, np.random.default_rng(1))
    assert (start >= log_posterior.low).all()
    assert (start <= log_posterior.high).all()
    covariance = calibration.covariance
    free = np.flatnonzero(np.isfinite(covariance.stds))
    assert free.size == len(covariance) - 1
    found = start[:, free].std(axis=0) / log_posterior.factors[free]
    np.testing.assert_allclose(found, covariance.stds[free], rtol=0.15)
    # as probable as samples of a normal distribution are
    drop = log_posterior(log_posterior.centre) - log_posterior(start)
    assert 2 * np.median(drop) / len(covariance) == pytest.approx(1, abs=0.25)


def test_walkers_leave_a_bound_inwards(calibration):
    log_posterior = LogPosterior(calibration.measurement)
    i = log_posterior.names.index("wollaston.efficiency[0]")
    start = Laplace(log_posterior).start(500, np.random.default_rng(1))[:, i]
    assert (start <= 1).all()
    assert np.unique(start).size > 450
    assert 1e-5 < 1 - start.mean() < 0.02


def test_walkers_start_narrow_where_nothing_is_determined(make):
    wavelength = make.charis.wavelength[::6]
    truth = make.truth(make.chain(wavelength=wavelength, kind="elliptical", fixed=False))
    cal = calibrate(truth, make.observe(truth, wavelength=wavelength, flux=1e6, seed=3))
    assert cal.identifiability.rank == len(cal.covariance) - 2
    log_posterior = LogPosterior(cal.measurement)
    start = Laplace(log_posterior).start(400, np.random.default_rng(1))
    i = log_posterior.names.index("hwp.theta")
    spread = (start[:, i].std() * u.rad).to_value(u.deg)
    assert 0.02 < spread <= 0.35
    assert np.isfinite(log_posterior(start)).all()


def test_default_numbers_of_walkers_and_of_steps_kept_grow(calibration, monkeypatch):
    asked = []

    def stop(*numbers):
        asked.append(numbers[:4])
        raise FitError("enough")

    monkeypatch.setattr(sampling_module, "_check", stop)
    n = len(calibration.covariance)
    assert 12 < n < 40
    for parameters in (None, ["hwp.w_sio2"]):
        with pytest.raises(FitError, match="enough"):
            sample(calibration, parameters=parameters)
    assert asked == [(n, 2 * n, 5000, 1), (1, 24, 5000, 1)]


@pytest.mark.slow
def test_resumed_run_of_many_parameters_is_the_uninterrupted_one(calibration, tmp_path):
    """The steps around the fit draw the same random numbers."""
    pytest.importorskip("h5py")
    options = {"seed": 4, "progress": False, "checkpoint": tmp_path / "chain.h5"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        sample(calibration, n_steps=20, **options)
        resumed = sample(calibration, n_steps=45, **options)
        whole = sample(calibration, n_steps=45, **(options | {"checkpoint": None}))
    assert resumed == whole
    assert whole.settings["moves"][1] == ["CrankNicolsonMove", 0.5]


def test_burn_in_is_in_steps_of_the_sampler(calibration):
    for burn_in, kept in [(0, 0), (7, 3), (30, 10)]:
        with pytest.warns(AstropolcalWarning, match="shorter than 50"):
            posterior = sample(
                calibration,
                parameters=["hwp.w_sio2"],
                n_walkers=6,
                n_steps=60,
                thin=3,
                burn_in=burn_in,
                seed=1,
                progress=False,
            )
        assert posterior.burn_in == kept, (burn_in, kept)
        assert posterior.convergence.burn_in == 3 * kept, (burn_in, kept)


def test_bad_burn_in(calibration):
    for burn_in in [-1, 55, 2.5]:
        with pytest.raises(
            FitError, match=r"burn_in = .*60 steps allow whole numbers from 0 to 54"
        ):
            sample(calibration, n_walkers=80, n_steps=60, thin=3, burn_in=burn_in, progress=False)


def test_settings_say_what_was_sampled(calibration):
    with pytest.warns(AstropolcalWarning):
        posterior = sample(
            calibration, parameters=["hwp.w_sio2"], n_walkers=6, n_steps=10, progress=False
        )
    settings = posterior.settings
    assert settings["noise"]["from"] == "errors"
    assert settings["held"] == [n for n in calibration.covariance.names if n != "hwp.w_sio2"]
    assert settings["priors"] == []
    assert settings["moves"] == [["DEMove", 0.3], ["CrankNicolsonMove", 0.5]]
    with pytest.warns(AstropolcalWarning):
        given = sample(
            calibration,
            parameters=["hwp.w_sio2"],
            noise=0.01,
            n_walkers=6,
            n_steps=10,
            progress=False,
        )
    assert given.settings["noise"] == {
        "from": "given", "least": 0.01, "median": 0.01, "largest": 0.01
    }  # fmt: skip
