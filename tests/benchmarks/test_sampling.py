# Licensed under a 3-clause BSD style license - see LICENSE
"""
Speed of sampling on one core, and of the checkpoint.

Not part of the normal run: ``pytest tests/benchmarks``.
"""

import time
import warnings

import astropy.units as u
import numpy as np
import pytest
from timing import fastest

from astropolcal import calibrate, instruments
from astropolcal.calibration import sample
from astropolcal.calibration.posterior import LogPosterior
from astropolcal.exceptions import AstropolcalWarning
from astropolcal.measurement import Normal

pytest.importorskip("emcee")
pytest.importorskip("h5py")

GLOBAL = ["hwp.w_sio2", "hwp.w_mgf2"]
GLOBAL += [f"{name}.theta" for name in ("hwp", "derotator", "calibration_polarizer")]


@pytest.fixture(scope="module")
def calibration(shared_data):
    """Dataset 3: 22 wavelengths x 64 frames, 93 parameters, the paper's priors."""
    from astropolcal.observations import Observations

    (path,) = (shared_data / "data" / "charis").glob("dataset3_*.ecsv")
    data = Observations.read(path)
    (chain,) = instruments.get("charis").chains_for([data])
    for name, angle in (("calibration_polarizer", 90), ("hwp", 0), ("derotator", 0)):
        chain[name].theta.prior = Normal(angle * u.deg, 1 * u.deg)
    return calibrate(chain, data, cross_validate=False)


@pytest.mark.parametrize("parameters", [GLOBAL, None], ids=["5 parameters", "93 parameters"])
def test_log_posterior(calibration, parameters, measured):
    """The goal is 1,000 evaluations a second."""
    log_posterior = LogPosterior(calibration.measurement, parameters=parameters)
    walkers = np.tile(log_posterior.centre, (12, 1))
    (seconds,) = fastest(lambda: log_posterior(walkers), repeats=60)
    rate = 12 / seconds
    n = len(parameters or calibration.measurement.free.names)
    measured(f"log-posterior, {n} parameters", 1 / rate)
    assert rate > 1000


@pytest.mark.parametrize("with_checkpoint", [False, True])
def test_run_of_the_paper(calibration, tmp_path, with_checkpoint, measured):
    """10,000 steps of 24 walkers in 5 parameters, from 1,000; the goal is minutes."""
    path = tmp_path / "chain.h5" if with_checkpoint else None
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        sample(calibration, parameters=GLOBAL, n_steps=1000, seed=1, checkpoint=path)
    minutes = (time.process_time() - started) * 10 / 60
    kept = ", with a checkpoint" if with_checkpoint else ""
    measured(f"10,000 steps of 24 walkers in 5 parameters{kept}", 60 * minutes)
    assert minutes < 4


def test_over_bare_emcee(calibration, measured):
    """Steps of `sample` against those of emcee with the same log-posterior and moves."""
    import emcee

    log_posterior = LogPosterior(calibration.measurement, parameters=GLOBAL)
    rng = np.random.default_rng(1)
    start = log_posterior.centre + 1e-5 * rng.normal(size=(24, len(GLOBAL)))

    def bare():
        sampler = emcee.EnsembleSampler(24, len(GLOBAL), log_posterior, vectorize=True)
        sampler.run_mcmc(start, 100, skip_initial_state_check=True)

    def ours():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropolcalWarning)
            sample(calibration, parameters=GLOBAL, n_walkers=24, n_steps=100, seed=1)

    times = fastest(ours, bare, repeats=3, clock=time.process_time)
    measured("100 steps of 24 walkers", times[0], {"emcee with the same posterior": times[1]})
    assert times[0] < 1.5 * times[1]


def test_log_posterior_over_the_prediction(calibration, measured):
    """What a log-posterior costs beyond the forward sweep that it needs."""
    log_posterior = LogPosterior(calibration.measurement)
    (dataset,) = calibration.measurement.datasets
    vector = log_posterior.fitted
    times = fastest(
        lambda: log_posterior(vector), lambda: dataset.values(dataset.forward(vector)), repeats=300
    )
    measured("log-posterior of one walker", times[0], {"the prediction in it": times[1]})
    assert times[0] < 1.5 * times[1]
