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
from timing import fastest, report

from astropolcal import calibrate, instruments
from astropolcal.calibration import sample
from astropolcal.calibration.posterior import LogPosterior
from astropolcal.exceptions import AstropolcalWarning
from astropolcal.measurement import Normal

pytest.importorskip("emcee")
pytest.importorskip("h5py")

GLOBAL = ["hwp.w_sio2", "hwp.w_mgf2"]
GLOBAL += [f"{name}.theta" for name in ("hwp", "derotator", "calibration_polarizer")]
# the published path, measured on a machine of two cores: all bins of Dataset 3
PUBLISHED = 2.3


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
def test_log_posterior(calibration, parameters, capsys):
    """The goal is 1,000 evaluations a second."""
    log_posterior = LogPosterior(calibration.measurement, parameters=parameters)
    walkers = np.tile(log_posterior.centre, (12, 1))
    (seconds,) = fastest(lambda: log_posterior(walkers), repeats=60)
    rate = 12 / seconds
    with capsys.disabled():
        print(f"\n  {rate:.0f} log-posteriors a second, {rate / PUBLISHED:.0f} times the published")
    assert rate > 1000


@pytest.mark.parametrize("with_checkpoint", [False, True])
def test_run_of_the_paper(calibration, tmp_path, with_checkpoint, capsys):
    """10,000 steps of 24 walkers in 5 parameters, from 1,000; the goal is minutes."""
    path = tmp_path / "chain.h5" if with_checkpoint else None
    started = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        sample(calibration, parameters=GLOBAL, n_steps=1000, seed=1, checkpoint=path)
    minutes = (time.process_time() - started) * 10 / 60
    with capsys.disabled():
        print(f"\n  10,000 steps take {minutes:.1f} min, checkpoint: {with_checkpoint}")
    assert minutes < 4


def test_over_bare_emcee(calibration, capsys):
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
    report(capsys, f"100 steps of 24 walkers: {times[0]:.2f} s, {times[0] / times[1]:.2f} of emcee")
    assert times[0] < 1.5 * times[1]


def test_log_posterior_over_the_prediction(calibration, capsys):
    """What a log-posterior costs beyond the forward sweep that it needs."""
    log_posterior = LogPosterior(calibration.measurement)
    (dataset,) = calibration.measurement.datasets
    vector = log_posterior.fitted
    times = fastest(
        lambda: log_posterior(vector), lambda: dataset.values(dataset.forward(vector)), repeats=300
    )
    report(capsys, f"log-posterior: {times[0] / times[1]:.2f} of the prediction")
    assert times[0] < 1.5 * times[1]
