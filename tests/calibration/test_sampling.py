# Licensed under a 3-clause BSD style license - see LICENSE
"""Sampling: the log-posterior, the walkers, and checkpoints that survive a kill."""

import os
import random
import subprocess
import sys
import time
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.models import Polynomial1D

from astropolcal import Calibration, calibrate, optics
from astropolcal.calibration import sample
from astropolcal.calibration.noise.weighting import Problem, Weighting, noise_of
from astropolcal.calibration.posterior import LogPosterior, Posterior
from astropolcal.calibration.posterior import checkpoint as checkpoint_module
from astropolcal.chain import follow
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    CalibrationFileError,
    FitError,
    ParameterError,
)
from astropolcal.measurement import Normal
from astropolcal.measurement.parameters import Uniform
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

NOISE = 0.01
WAVELENGTH = [1.2, 1.6] * u.um
FRAMES = half_wave_plate_cycles(derotator=[45, 70] * u.deg)
emcee, h5py = (pytest.importorskip(name) for name in ("emcee", "h5py"))
pytestmark = pytest.mark.samplers


def make_chain(retardance_free=True, **priors):
    chain = (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=165 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(
            retardance=-70 * u.deg, mount="derotator", name="derotator", fixed={"retardance": True}
        )
        | optics.WollastonPrism(efficiency=[0.8, 0.85], name="wollaston")
    )
    chain["hwp"].retardance.fixed = not retardance_free
    for name, prior in priors.items():
        optic, key = name.split("__")
        getattr(chain[optic], key).prior = prior
    return chain


def make_calibration(retardance_free=True, seed=1, frames=FRAMES, **priors):
    chain = make_chain(retardance_free, **priors)
    data = simulate(chain, WAVELENGTH, frames, flux=1e4, seed=seed)
    return calibrate(chain, data, cross_validate=False)


def quiet_sample(*args, **kwargs):
    """Sample without a word about the length of the chain."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropolcalWarning)
        return sample(*args, **kwargs)


@pytest.fixture(scope="module")
def linear():
    """Only efficiencies are free, in which the data are linear."""
    return make_calibration(retardance_free=False)


@pytest.fixture(scope="module")
def small():
    """Two efficiencies and a retardance."""
    return make_calibration()


@pytest.fixture(scope="module")
def full_rank(make):
    """A CHARIS-like fit of 6 wavelengths whose weights are the true errors."""
    wavelength = make.charis.wavelength[::4]
    truth = make.truth(make.chain(wavelength=wavelength))
    data = make.observe(truth, wavelength=wavelength, flux=1e5, seed=3)
    return calibrate(truth, data, weights="errors", errors="white", cross_validate=False)


def exact(cal, noise, prior=None):
    """Mean and standard deviation of the two efficiencies, by linear algebra."""
    live = cal.measurement
    jacobian = live.jacobian(live.vector())
    precision = np.sum(jacobian**2, axis=1) / noise**2
    mean = live.vector() + jacobian @ live.residuals() / noise**2 / precision
    if prior is not None:
        total = precision + 1 / prior[1] ** 2
        mean, precision = (precision * mean + prior[0] / prior[1] ** 2) / total, total
    return mean, 1 / np.sqrt(precision)


def assert_normal(posterior, mean, std):
    """Compare with a normal posterior, to five Monte-Carlo errors."""
    samples = posterior.samples()
    size = len(samples) / posterior.autocorrelation_times.max()
    assert posterior.converged
    np.testing.assert_allclose(samples.mean(axis=0), mean, rtol=0, atol=5 * std.max() / size**0.5)
    np.testing.assert_allclose(samples.std(axis=0), std, rtol=5 / (2 * size) ** 0.5)


# --- the log-posterior --------------------------------------------------------------------


def test_log_posterior_is_half_of_chi_square_and_the_priors():
    cal = make_calibration(hwp__retardance=Normal(165 * u.deg, 0.5 * u.deg))
    posterior = LogPosterior(cal.measurement, noise=NOISE)
    vector = posterior.centre + np.array([0.01, 0.002, -0.004])
    chi2 = np.sum(cal.measurement.residuals(vector) ** 2) / NOISE**2
    priors = cal.measurement.free.priors
    known = sum(prior.log_densities(vector[slot.slice]).sum() for slot, prior in priors)
    expected = -0.5 * chi2 + known
    assert posterior(vector) == pytest.approx(expected, rel=1e-12)


def test_log_posterior_of_walkers_is_that_of_each(small):
    posterior = LogPosterior(small.measurement)
    rng = np.random.default_rng(1)
    rows = posterior.centre + rng.normal(0, 0.02, (7, 3))
    assert posterior(rows).tolist() == [posterior(row) for row in rows]
    assert posterior(rows[:0]).shape == (0,)


def test_log_posterior_outside_the_bounds(small):
    posterior = LogPosterior(small.measurement)
    rows = np.tile(posterior.centre, (3, 1))
    rows[1, -1] = 1.0001
    rows[2, 0] = np.nan
    found = posterior(rows)
    assert np.isfinite(found).tolist() == [True, False, False]
    assert found[1] == found[2] == -np.inf


def test_log_posterior_of_some_parameters_holds_the_others(small):
    names = ["wollaston.efficiency[1]", "hwp.retardance"]
    part = LogPosterior(small.measurement, parameters=names, noise=NOISE)
    everything = LogPosterior(small.measurement, noise=NOISE)
    assert part.names == names
    vector = everything.centre + np.array([0.01, 0.0, -0.03])
    assert part(vector[[2, 0]]) == everything(vector)


def test_name_of_a_parameter_stands_for_all_its_values(small):
    found = LogPosterior(small.measurement, parameters="wollaston.efficiency").names
    assert found == ["wollaston.efficiency[0]", "wollaston.efficiency[1]"]


def test_noise_given(small):
    for noise, expected in [(1 * u.percent, [0.01, 0.01]), ([0.01, 0.02], [0.01, 0.02])]:
        posterior = LogPosterior(small.measurement, noise=noise)
        assert posterior.sigma == pytest.approx(np.array(expected)[small.measurement.bins])


def test_noise_from_the_table(small):
    sigma = LogPosterior(small.measurement, weights="errors").sigma
    assert sigma is small.measurement.sigma


@pytest.mark.slow
def test_noise_from_residuals_is_unbiased():
    """Mean square over 1000 noises; 8 data and 1 parameter a wavelength: else it were 0.88."""
    live = make_calibration(False).measurement
    vector, jacobian = live.vector(), live.jacobian(live.vector())
    rng, squares = np.random.default_rng(1), []
    for _ in range(1000):
        noise = rng.normal(0, NOISE, live.n_data)
        best = vector + np.linalg.lstsq(jacobian.T, noise, rcond=None)[0]
        live.observed = live.predict(vector) + noise
        live.stand_at(best)
        equal = Problem(live, Weighting(None, np.full(live.n_data, np.nan))).around()
        noise = Weighting("wavelength", np.full(live.n_data, NOISE)).updated(live, equal)
        squares.append(noise.sigma[[0, -1]] ** 2 / NOISE**2)
    assert np.mean(squares, axis=0) == pytest.approx([1.0, 1.0], abs=4 * (2 / 7 / 1000) ** 0.5)


def test_no_noise_without_residuals():
    chain = make_chain()
    exact_data = simulate(chain, WAVELENGTH, FRAMES)
    cal = calibrate(chain, exact_data, cross_validate=False)
    cal.measurement.observed[:] = cal.measurement.predict(cal.measurement.vector())
    with pytest.raises(FitError, match=r"1200\.0 nm: 8 data leave .* give noise="):
        noise_of(cal.measurement, "wavelength")


def test_bad_log_posterior(small):
    for options, error, message in [
        ({"parameters": ["hwp.theta"]}, ParameterError, r"no free parameter 'hwp\.theta'; allowed"),
        ({"parameters": ["hwp.retardance"] * 2}, ParameterError, "nothing twice"),
        ({"parameters": []}, ParameterError, "must name something"),
        (
            {"parameters": ["wollaston.efficiency", "wollaston.efficiency[1]"]},
            ParameterError,
            "nothing twice",
        ),
        ({"noise": 0.0}, ParameterError, "must be positive"),
        ({"noise": np.nan}, ParameterError, "must be positive"),
        ({"noise": [0.1] * 3}, ParameterError, r"shape \(3,\); allowed are one value, 2"),
        ({"noise": 1 * u.m}, ParameterError, "noise has unit m"),
        ({"noise": "much"}, ParameterError, "not a number"),
        ({"weights": "equal"}, FitError, "allowed are None, 'wavelength', 'errors'"),
    ]:
        with pytest.raises(error, match=message):
            LogPosterior(small.measurement, **options)


def test_log_posterior_of_a_wrong_shape(small):
    for shape in [(2,), (4,), (5, 2), (2, 2, 3), ()]:
        with pytest.raises(ParameterError, match="values of shape"):
            LogPosterior(small.measurement)(np.zeros(shape))


def test_weights_without_errors():
    cal = make_calibration()
    cal.measurement.sigma[3] = np.nan
    with pytest.raises(FitError, match="1 of 16 data have no error"):
        LogPosterior(cal.measurement, weights="errors")


# --- the walkers: posteriors that are known -----------------------------------------------


@pytest.mark.long
def test_linear_normal_posterior(linear):
    posterior = sample(linear, noise=NOISE, n_walkers=32, n_steps=1200, seed=1, progress=False)
    assert_normal(posterior, *exact(linear, NOISE))
    correlation = posterior.covariance.correlation[0, 1]
    assert abs(correlation) < 5 * (posterior.autocorrelation_times.max() / (32 * 1100)) ** 0.5


@pytest.mark.long
def test_linear_normal_posterior_with_a_prior():
    prior = (0.78, 0.005)
    cal = make_calibration(False, wollaston__efficiency=Normal(*prior))
    posterior = sample(cal, noise=NOISE, n_walkers=32, n_steps=1200, seed=2, progress=False)
    mean, std = exact(cal, NOISE, prior)
    assert abs(mean[1] - exact(cal, NOISE)[0][1]) > 5 * std[1]
    assert_normal(posterior, mean, std)


@pytest.mark.slow
def test_uniform_prior_and_bounds_are_never_left():
    cal = make_calibration(False, wollaston__efficiency=Uniform(0.795, 0.86))
    posterior = quiet_sample(cal, noise=10 * NOISE, n_steps=800, seed=3, progress=False)
    assert posterior.chain.min() >= 0.795
    assert posterior.chain.max() <= 0.86
    # so wide a likelihood fills the interval evenly
    samples = posterior.samples()
    assert samples.std(axis=0) == pytest.approx(0.065 / 12**0.5, rel=0.15)


@pytest.mark.slow
def test_walkers_start_within_bounds_where_the_fit_is_at_one():
    chain = make_chain(retardance_free=False)
    chain["wollaston"].efficiency = [1.0, 0.85]
    data = simulate(chain, WAVELENGTH, FRAMES, flux=1e4, seed=5)
    cal = calibrate(chain, data, cross_validate=False)
    cal.measurement.wollaston_efficiency_0.value = 1.0
    posterior = quiet_sample(cal, noise=NOISE, n_steps=300, seed=1, progress=False)
    assert posterior.chain.max() <= 1.0
    assert np.ptp(posterior.chain[0, :, 0]) > 0


@pytest.mark.long
def test_sampled_errors_are_those_of_the_covariance(full_rank):
    names = ["calibration_polarizer.theta", "derotator.retardance"]
    assert full_rank.identifiability.rank == len(full_rank.covariance)
    posterior = quiet_sample(full_rank, n_steps=2500, seed=4, progress=False)
    size = len(posterior.samples()) / posterior.autocorrelation_times.max()
    assert size > 500
    rows = [i for i, name in enumerate(posterior.names) if name.split("[")[0] in names]
    assert len(rows) == 7
    expected = full_rank.covariance.stds[rows]
    np.testing.assert_allclose(posterior.covariance.stds[rows], expected, rtol=5 / size**0.5)
    centre = np.median(posterior.samples(), axis=0)[rows] - posterior.fitted[rows]
    assert np.abs(centre / expected).max() < 0.35


@pytest.mark.long
def test_samples_narrower_than_the_scatter_of_residuals_say_so():
    """All frames at a derotator angle err alike: by that the errors are larger."""
    frames = half_wave_plate_cycles(derotator=np.linspace(45, 110, 8) * u.deg)
    found = {}
    for drift in (0.0, 0.03):
        chain = make_chain(retardance_free=False)
        data = simulate(chain, WAVELENGTH, frames, flux=1e4, seed=1)
        table, group = data.to_table(), np.arange(len(frames)).repeat(2) // 8
        gain = 1 + drift * np.where(group % 2, 1, -1) * np.cos(4 * table["hwp"].to_value(u.rad))
        table["flux_right"] *= gain
        cal = calibrate(chain, Observations.from_table(table, name="a"), cross_validate=False)
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            posterior = sample(cal, n_steps=500, seed=1)
        found[drift] = [str(one.message) for one in told if "independent" in str(one.message)]
        assert (f"TOO NARROW: {posterior.scatter}." in posterior.words()) == bool(drift)
    assert not found[0.0]
    assert "times as large" in found[0.03][0]


@pytest.mark.slow
def test_parameters_held_have_no_share_in_the_errors(full_rank):
    """With all else known, the thicknesses are better known than in the fit of all."""
    names = ["hwp.w_sio2", "hwp.w_mgf2"]
    posterior = sample(full_rank, parameters=names, n_steps=500, seed=5, progress=False)
    live = full_rank.measurement
    rows = [live.free.names.index(name) for name in names]
    part = live.jacobian(live.vector())[rows] / live.sigma
    # canonical: micrometre; declared: mm
    expected = np.sqrt(np.diag(np.linalg.inv(part @ part.T))) * 1e-3
    assert posterior.covariance.stds == pytest.approx(expected, rel=0.1)
    assert (posterior.covariance.stds < full_rank.covariance.stds[rows]).all()


@pytest.mark.long
def test_undetermined_direction_is_filled_by_its_prior():
    """Polarizer and half-wave plate turned together: only the prior keeps them apart."""
    chain = make_chain(retardance_free=False)
    chain["hwp"].retardance = 180 * u.deg
    chain["hwp"].theta.prior = Normal(0 * u.deg, 0.5 * u.deg)
    for name in ("polarizer", "hwp"):
        chain[name].theta.fixed = False
    cal = calibrate(
        chain, simulate(chain, WAVELENGTH, FRAMES, flux=1e4, seed=1), cross_validate=False
    )
    names = ["polarizer.theta", "hwp.theta"]
    posterior = sample(cal, parameters=names, noise=NOISE, n_steps=3000, seed=1, progress=False)
    assert posterior.covariance.std("hwp.theta").to_value(u.deg) == pytest.approx(0.5, rel=0.15)
    assert posterior.covariance.correlation[0, 1] > 0.8


# --- runs that repeat and resume ----------------------------------------------------------


RUN = {"n_walkers": 10, "n_steps": 60, "seed": 7, "progress": False}


@pytest.mark.slow
def test_seed_repeats_the_run(small):
    first, second = (quiet_sample(small, **RUN) for _ in range(2))
    assert first == second
    assert first != quiet_sample(small, **(RUN | {"seed": 8}))
    assert quiet_sample(small, **(RUN | {"seed": None})) != first


def test_thinned_run_keeps_every_third_step(small):
    whole, thinned = quiet_sample(small, **RUN), quiet_sample(small, **RUN, thin=3)
    np.testing.assert_array_equal(thinned.chain, whole.chain[2::3])
    np.testing.assert_array_equal(thinned.acceptance, whole.acceptance)


def test_first_step_is_behind_the_start_and_acceptance_is_counted(small):
    posterior = quiet_sample(small, **RUN)
    moved = (np.diff(posterior.chain, axis=0) != 0).any(axis=2).sum(axis=0)
    assert (np.abs(posterior.acceptance * 60 - moved) <= 1.001).all()
    assert (posterior.acceptance > 0.2).all()


def test_log_prob_belongs_to_the_chain(small):
    posterior = quiet_sample(small, **RUN)
    log_posterior = LogPosterior(small.measurement)
    again = log_posterior(posterior.chain[-1] * log_posterior.factors)
    np.testing.assert_allclose(again, posterior.log_prob[-1], rtol=1e-9)


@pytest.mark.slow
def test_resumed_chain_is_the_uninterrupted_one(small, tmp_path):
    for interval in [1, 7, 100]:
        for thin in [1, 4]:
            path = tmp_path / f"chain{thin}_{interval}.h5"
            options = {"checkpoint": path, "checkpoint_every": interval, "thin": thin}
            for n_steps in (20, 33, 60):
                found = quiet_sample(small, **(RUN | {"n_steps": n_steps}), **options)
                assert len(found.chain) == n_steps // thin, (interval, thin)
            assert found == quiet_sample(small, **RUN, thin=thin), (interval, thin)


def test_shorter_run_than_the_checkpoint_reads_its_beginning(small, tmp_path):
    path = tmp_path / "chain.h5"
    # a seed of numpy is a number as any other
    whole = quiet_sample(small, **(RUN | {"seed": np.int64(RUN["seed"])}), checkpoint=path)
    before = path.read_bytes()
    part = quiet_sample(small, **(RUN | {"n_steps": 20}), checkpoint=path)
    np.testing.assert_array_equal(part.chain, whole.chain[:20])
    assert part == quiet_sample(small, **(RUN | {"n_steps": 20}))
    assert path.read_bytes() == before


def test_interrupted_run_keeps_every_step(small, tmp_path, monkeypatch):
    """Ctrl-C is not a kill: what is in memory is written."""
    path = tmp_path / "chain.h5"
    append = checkpoint_module.Chain.append

    def interrupted(self, *args):
        append(self, *args)
        if self.count == 23:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint_module.Chain, "append", interrupted)
    with pytest.raises(KeyboardInterrupt):
        quiet_sample(small, **RUN, checkpoint=path)
    monkeypatch.undo()
    assert stored_count(path) == 23
    assert quiet_sample(small, **RUN, checkpoint=path) == quiet_sample(small, **RUN)


def test_without_resume_the_run_starts_anew(small, tmp_path):
    path = tmp_path / "chain.h5"
    quiet_sample(small, **RUN, checkpoint=path)
    other = RUN | {"seed": 8, "n_walkers": 12}
    found = quiet_sample(small, **other, checkpoint=path, resume=False)
    assert found == quiet_sample(small, **other)


def stored_steps(path):
    """Return the steps in a checkpoint, and where they begin; they are an ordinary dataset."""
    with h5py.File(path) as file:
        return file["steps"][...], file["steps"].id.get_offset()


def stored_count(path):
    return np.count_nonzero(stored_steps(path)[0]["number"])


# --- a checkpoint of something else -------------------------------------------------------


def test_checkpoint_of_another_run(small, tmp_path):
    path = tmp_path / "chain.h5"
    quiet_sample(small, **RUN, checkpoint=path)
    before = path.read_bytes()
    prior = make_calibration(hwp__retardance=Normal(165 * u.deg, 50 * u.deg))
    chain = make_chain()
    chain["polarizer"].theta = 1 * u.deg
    model = calibrate(
        chain, small.measurement.datasets[0].observations, search=False, cross_validate=False
    )
    cases = [
        (make_calibration(seed=2), {}, "data"),
        (make_calibration(False), {}, "parameters"),
        (prior, {}, "priors"),
        (model, {}, "model"),
        (small, {"parameters": ["wollaston.efficiency", "hwp.retardance"]}, "parameters"),
        (small, {"noise": NOISE}, "noise"),
        (small, {"thin": 2}, "thin"),
        (small, {"n_walkers": 11}, "n_walkers"),
        (small, {"seed": 8}, "seed"),
        (small, {"moves": emcee.moves.DEMove()}, "moves"),
    ]
    for cal, options, named in cases:
        with pytest.raises(FitError, match=rf"chain\.h5: .* differs in [^;]*{named}.*resume=False"):
            quiet_sample(cal, **(RUN | options), checkpoint=path)
    assert path.read_bytes() == before


def test_checkpoint_with_other_values_of_held_parameters(small, tmp_path):
    path = tmp_path / "chain.h5"
    options = RUN | {"parameters": ["wollaston.efficiency"], "noise": NOISE, "checkpoint": path}
    quiet_sample(small, **options)
    other = make_calibration()
    other.measurement.hwp_retardance.value += 6e-3
    with pytest.raises(FitError, match="differs in values of the parameters held"):
        quiet_sample(other, **options)


def test_checkpoint_of_another_law(tmp_path):
    """Its coefficients have the same names, and mean something else."""
    data = simulate(make_chain(), WAVELENGTH, FRAMES, flux=1e4, seed=1)
    options = RUN | {"n_steps": 4, "checkpoint": tmp_path / "chain.h5"}
    first, other = (
        calibrate(
            follow(make_chain(), "hwp.retardance", Polynomial1D(1, **ends), "wavelength"),
            data,
            weights="errors",
            search=False,
            cross_validate=False,
        )
        for ends in ({}, {"domain": [1.2, 1.6], "window": [-1, 1]})
    )
    quiet_sample(first, **options)
    assert first.covariance.names == other.covariance.names
    with pytest.raises(FitError, match="differs in model"):
        quiet_sample(other, **options)


def test_other_last_digits_do_not_matter(small, tmp_path):
    """A calibration made anew may differ by rounding; the walkers go on."""
    path = tmp_path / "chain.h5"
    quiet_sample(small, **(RUN | {"n_steps": 20}), checkpoint=path)
    other = make_calibration()
    other.measurement.hwp_retardance.value += 1e-11
    assert len(quiet_sample(other, **RUN, checkpoint=path).chain) == 60


def test_other_files_are_not_touched(small, tmp_path):
    for content in [b"", b"no checkpoint at all" * 100, b"astropolcal posterior checkpoint 2\n{}"]:
        path = tmp_path / "chain.h5"
        path.write_bytes(content)
        for resume in (True, False):
            with pytest.raises(FitError, match=r"chain\.h5: is not a checkpoint"):
                quiet_sample(small, **RUN, checkpoint=path, resume=resume)
        assert path.read_bytes() == content


def test_truncated_checkpoint_goes_on_from_its_last_whole_step(small, tmp_path):
    path = tmp_path / "chain.h5"
    whole = quiet_sample(small, **RUN, checkpoint=path)
    content = path.read_bytes()
    steps, start = stored_steps(path)
    for count in (59, 58):
        path.write_bytes(content[: start + count * steps.itemsize + 5])
        assert quiet_sample(small, **RUN, checkpoint=path) == whole
        end = start + 60 * steps.itemsize
        assert path.read_bytes()[:end] == content[:end]
    path.write_bytes(content[:100])
    with pytest.raises(FitError, match=r"chain\.h5: the checkpoint is damaged"):
        quiet_sample(small, **RUN, checkpoint=path)


def test_steps_from_a_damaged_one_on_are_computed_again(small, tmp_path):
    for torn in (0, 37, 59):
        path = tmp_path / f"chain{torn}.h5"
        whole = quiet_sample(small, **RUN, checkpoint=path)
        steps, start = stored_steps(path)
        content = bytearray(path.read_bytes())
        content[start + torn * steps.itemsize + 5] ^= 0x5A
        path.write_bytes(content)
        kept, append = [], checkpoint_module.Chain.append

        def counted(chain, *parts, append=append, kept=kept):
            append(chain, *parts)
            kept.append(chain.count)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(checkpoint_module.Chain, "append", counted)
            assert quiet_sample(small, **RUN, checkpoint=path) == whole, torn
        assert kept == list(range(torn + 1, 61)), torn


def test_steps_that_another_run_has_left_behind_are_computed_again(small, tmp_path):
    """Killed while it overwrote the steps behind a damaged one, where it had gone another way."""
    first, second = tmp_path / "first.h5", tmp_path / "second.h5"
    without_seed = RUN | {"seed": None}
    quiet_sample(small, **without_seed, checkpoint=first)
    whole = quiet_sample(small, **without_seed, checkpoint=second)
    steps, start = stored_steps(first)
    end = start + 30 * steps.itemsize
    first.write_bytes(second.read_bytes()[:end] + first.read_bytes()[end:])
    assert quiet_sample(small, **without_seed, checkpoint=first) == whole


def test_damaged_words_of_a_checkpoint_are_refused(small, tmp_path):
    path = tmp_path / "chain.h5"
    quiet_sample(small, **RUN, checkpoint=path)
    good = path.read_bytes()
    text = good[: good.index(b"}")]
    # in the place of the steps, the length of the text, and a number of the run
    numbers = text.index(b"\n") + 1
    for at in (numbers, text.index(b" ", numbers) + 1, text.rindex(b".") + 1):
        content = bytearray(good)
        content[at] ^= 1
        path.write_bytes(content)
        with pytest.raises(FitError, match=r"chain\.h5: the checkpoint is damaged"):
            quiet_sample(small, **RUN, checkpoint=path)


def test_checkpoint_in_use(small, tmp_path):
    path = tmp_path / "chain.h5"
    quiet_sample(small, **RUN, checkpoint=path)
    code = f"import fcntl; f = open({str(path)!r}, 'rb+'); fcntl.flock(f, fcntl.LOCK_EX)"
    code += "; print(1, flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        with pytest.raises(FitError, match="in use by another run"):
            quiet_sample(small, **RUN, checkpoint=path)
        other.stdin.close()


def test_checkpoint_where_no_file_can_be(small, tmp_path):
    with pytest.raises(FitError, match="cannot be written"):
        quiet_sample(small, **RUN, checkpoint=tmp_path / "no_folder" / "chain.h5")


# --- SIGKILL ------------------------------------------------------------------------------


EVERY, STEPS = 20, 1500
KILLS = int(os.environ.get("ASTROPOLCAL_KILLS", "3"))
WORKER = """
import sys, warnings
sys.path.insert(0, {folder!r})
warnings.simplefilter("ignore")
from test_sampling import EVERY, STEPS, make_calibration, sample
from astropolcal.calibration.posterior.checkpoint import Chain

append = Chain.append
def tell(self, *args):
    append(self, *args)
    print(self.count, flush=True)
Chain.append = tell
sample(make_calibration(), n_walkers=10, n_steps=STEPS, seed=3, checkpoint={path!r},
       checkpoint_every=EVERY)
"""


def killed_run(path, folder, after):
    """Run until ``after`` seconds behind the first step; return all counts it told."""
    code = WORKER.format(folder=str(folder), path=str(path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as run:
        told = [run.stdout.readline()]
        time.sleep(after)
        run.kill()
        told += run.stdout.readlines()
    return [int(line) for line in told if line.endswith(b"\n")]


def check_kills(n_kills, path, request, rng):
    kills, before = 0, 0
    while kills < n_kills:
        told = killed_run(path, request.path.parent, rng.uniform(0, 0.25))
        if not told:
            break
        assert told[0] == before + 1
        before = stored_count(path)
        assert told[-1] - before <= EVERY
        kills += 1
        if before == STEPS:
            break
    return kills


@pytest.mark.long
def test_killed_runs_lose_one_interval_at_most(tmp_path, request):
    path = tmp_path / "chain.h5"
    assert check_kills(KILLS, path, request, random.Random(1)) >= 2
    options = {"n_walkers": 10, "n_steps": STEPS, "seed": 3, "progress": False}
    resumed = quiet_sample(make_calibration(), **options, checkpoint=path, checkpoint_every=EVERY)
    assert resumed == quiet_sample(make_calibration(), **options)


# --- bad input ----------------------------------------------------------------------------


def test_bad_numbers(small):
    for options, message in [
        ({"n_walkers": 5}, r"n_walkers = 5; 3 parameters need a whole number from 6 up"),
        ({"n_walkers": 10.0}, r"n_walkers = 10\.0"),
        ({"n_steps": 0}, "n_steps = 0; allowed are whole numbers"),
        ({"n_steps": 10.5}, r"n_steps = 10\.5"),
        ({"thin": 0}, "thin = 0"),
        ({"thin": 40}, "n_steps = .*; allowed are whole numbers from 80 up, as one in 40"),
        ({"checkpoint_every": -1}, "checkpoint_every = -1"),
    ]:
        with pytest.raises(FitError, match=message) as caught:
            sample(small, **(RUN | options))
        # a command says it in words of its options
        assert str(caught.value).startswith(f"{caught.value.argument} = ")


def test_calibration_from_a_file_has_no_data(small, tmp_path):
    small.write(tmp_path / "cal.asdf")
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        sample(Calibration.read(tmp_path / "cal.asdf"), **RUN)


def test_no_place_to_start(small, monkeypatch):
    monkeypatch.setattr(LogPosterior, "_chi2", lambda self, vector: np.inf)
    with pytest.raises(FitError, match="no place to start"):
        sample(small, **RUN)


def test_missing_package(small, tmp_path):
    for package in ("emcee", "h5py"):
        words = rf'{package}, .*pip install "astropolcal\[mcmc\]"'
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, package, None)
            with pytest.raises(AstropolcalError, match=words):
                sample(small, **RUN, checkpoint=tmp_path / "chain.h5")


def test_short_chain_warns(small):
    with pytest.warns(AstropolcalWarning, match=r"(?s)shorter than 50 .*run \d+ steps or more"):
        posterior = sample(small, **RUN)
    assert isinstance(posterior, Posterior)
    assert not posterior.converged


def test_progress_bar_on_a_terminal_only(small, capsys):
    quiet_sample(small, **(RUN | {"progress": True}))
    assert capsys.readouterr().err == ""


# --- real measurements --------------------------------------------------------------------


@pytest.fixture(scope="module")
def paper(charis_data):
    """The paper's 5 parameters with its priors on Dataset 3, all else held at the fit."""
    from astropolcal import instruments

    data = charis_data("dataset3_")
    (chain,) = instruments.get("charis").chains_for([data])
    for name, angle in (("calibration_polarizer", 90), ("hwp", 0), ("derotator", 0)):
        chain[name].theta.prior = Normal(angle * u.deg, 1 * u.deg)
    names = ["hwp.w_sio2", "hwp.w_mgf2"]
    names += [f"{name}.theta" for name in ("hwp", "derotator", "calibration_polarizer")]
    cal = calibrate(chain, data, cross_validate=False)
    return quiet_sample(cal, parameters=names, n_steps=800, seed=1, progress=False)


@pytest.mark.long
def test_thicknesses_of_dataset_3_are_degenerate(paper):
    """
    McIntosh et al. (2026, Appendix on MCMC): "perfectly degenerate with each other".

    10,000 steps give r = 0.9999 for the thicknesses, 0.9991 for the angles of
    half-wave plate and polarizer.
    """
    correlation = paper.covariance.correlation
    assert correlation[0, 1] > 0.99
    assert correlation[2, 4] > 0.99
    # the paper, with stretch moves: 80 steps; steps around the fit: 10
    assert paper.autocorrelation_times.max() < 20
