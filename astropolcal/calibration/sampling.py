# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sample the posterior of a calibration with an ensemble of walkers (emcee).

A run with a checkpoint can be killed at any moment; called again it goes on
with the same random numbers, so that the chain is the same as without the
interruption.
"""

import warnings

import numpy as np

from astropolcal.calibration._checkpoint import Chain
from astropolcal.calibration._ensemble import Laplace, default_moves, move_names, refuse_biased
from astropolcal.calibration._optional import need
from astropolcal.calibration.log_posterior import LogPosterior
from astropolcal.calibration.posterior import ENOUGH, Posterior
from astropolcal.calibration.weighting import weighting_of
from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalWarning, FitError

__all__ = ["sample"]

__doctest_requires__ = {"sample": ["emcee"]}

_FEWEST_WALKERS = 24
_PARAMETERS_A_STEP_KEPT = 20


def sample(
    calibration,
    *,
    parameters=None,
    noise=None,
    n_walkers=None,
    n_steps=5000,
    thin=None,
    burn_in=None,
    seed=None,
    checkpoint=None,
    checkpoint_every=100,
    resume=True,
    progress=True,
    moves=None,
):
    """
    Sample the posterior of a calibration's parameters.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data, as `calibrate` returns it.
    parameters : sequence of str, optional
        What varies, see `LogPosterior`; by default all free parameters.
    noise : float, `~astropy.units.Quantity` or array_like, optional
        Noise of the data, see `LogPosterior`; by default the noise that the
        fit assumed.
    n_walkers : int, optional
        At least twice the number of parameters (the default, or 24 if more).
    n_steps : int
        Steps of each walker, in total: a run that resumes does what is left.
    thin : int, optional
        Every how many steps one is kept, by default a twentieth of the number
        of parameters.
    burn_in : int, optional
        Steps to leave out at the start; by default 5 autocorrelation times, at
        most half of all.
    seed : int, optional
        Makes the run repeatable.
    checkpoint : path-like, optional
        HDF5 file that the run is written to.
    checkpoint_every : int
        Number of kept steps between two writes, which is the most that a
        killed run loses.
    resume : bool
        Whether to go on from a checkpoint that exists; otherwise it is
        replaced.
    progress : bool
        Whether to show a progress bar; it appears on a terminal only.
    moves : object or list, optional
        Moves of emcee. By default its stretch move for up to 10 parameters;
        for more a mixture of preconditioned Crank-Nicolson steps around the
        fit, which are large where the posterior is nearly normal, and of
        differential evolution.

    Returns
    -------
    Posterior

    Warns
    -----
    AstropolcalWarning
        If the chain is shorter than 50 autocorrelation times, or the walkers
        do not agree.

    Raises
    ------
    AstropolcalError
        If emcee, or h5py for a checkpoint, is not installed.
    FitError
        If the numbers of walkers or steps make no sense, a move is known to
        sample wrongly, the walkers find no place to start, or the checkpoint
        belongs to another run, is in use, or cannot be written.
    CalibrationFileError
        If the calibration was read from a file, which holds no data, and
        `~astropolcal.calibration.Calibration.with_observations` did not bring them back.

    Notes
    -----
    The walkers start in a normal ball around the fit, with the covariance of
    the data and priors where these determine it to 5 deg, micrometre or
    percent, and 0.3 of these wide where they do not. Method: Foreman-Mackey
    et al. (2013), doi:10.1086/670067; moves: Goodman & Weare (2010),
    doi:10.2140/camcos.2010.5.65, Nelson et al. (2014),
    doi:10.1088/0067-0049/210/1/11, and Cotter et al. (2013),
    doi:10.1214/13-STS421.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import sample
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> wavelength = [1.2, 1.6, 2.0] * u.um
    >>> chain = charis.chain(derotator="linear", wavelength=wavelength)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> data = simulate(chain, wavelength, frames, seed=2)
    >>> cal = calibrate(chain, data, weights="errors")
    >>> posterior = sample(cal, parameters=["hwp.w_sio2"], n_walkers=8, n_steps=2500, seed=1)
    >>> shift = posterior.quantile("hwp.w_sio2", 0.5) - cal.chain["hwp"].w_sio2.quantity
    >>> bool(abs(shift) < posterior.covariance.std("hwp.w_sio2"))
    True
    """
    emcee = need("emcee", "sampling")
    measurement = calibration.live_measurement()
    weights = "given" if noise is not None else weighting_of(calibration).choice
    log_posterior = LogPosterior(measurement, noise=noise, parameters=parameters)
    n = log_posterior.sampled.size
    n_walkers = max(2 * n, _FEWEST_WALKERS) if n_walkers is None else n_walkers
    thin = max(n // _PARAMETERS_A_STEP_KEPT, 1) if thin is None else thin
    _check(n, n_walkers, n_steps, thin, checkpoint_every)
    left_out = _kept_burn_in(burn_in, n_steps, thin)
    laplace = Laplace(log_posterior)
    moves = default_moves(emcee, laplace) if moves is None else moves
    refuse_biased(moves, emcee.__version__)
    sampler = emcee.EnsembleSampler(n_walkers, n, log_posterior, moves=moves, vectorize=True)
    chain = Chain((n_steps // thin, n_walkers, n), checkpoint_every)
    # a checkpoint may only be continued by the very run that wrote it
    description, arrays = _fingerprint(log_posterior, n_walkers, thin, moves, seed)
    with chain.open(checkpoint, description, arrays, resume):
        _run(emcee, sampler, laplace, chain, thin, seed, progress)
    settings = _settings(log_posterior, moves, weights, emcee.__version__)
    posterior = _result(log_posterior, chain, thin, seed, left_out, settings)
    _warn(posterior)
    return posterior


def _warn(posterior):
    if posterior.converged:
        return
    short = posterior.n_times < ENOUGH
    problem = f"is shorter than {ENOUGH} autocorrelation times" if short else "has not converged"
    warnings.warn(f"the chain {problem}: {posterior.words()}", AstropolcalWarning, stacklevel=3)


def _kept_burn_in(burn_in, n_steps, thin):
    """Return the number of kept steps to leave out, None for the usual one."""
    if burn_in is None:
        return None
    # two kept steps at least must be left, for a standard deviation
    most = (n_steps // thin - 2) * thin
    if not isinstance(burn_in, (int, np.integer)) or not 0 <= burn_in <= most:
        raise _refused("burn_in", burn_in, f"{n_steps} steps allow whole numbers from 0 to {most}")
    return -(-int(burn_in) // thin)


def _check(n, n_walkers, n_steps, thin, every):
    for name, value in (("n_steps", n_steps), ("thin", thin), ("checkpoint_every", every)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise _refused(name, value, "allowed are whole numbers from 1 up")
    if n_steps < 2 * thin:
        kept = f", as one in {thin} is kept" if thin > 1 else ""
        raise _refused("n_steps", n_steps, f"allowed are whole numbers from {2 * thin} up{kept}")
    fewest = max(2 * n, 4)
    if not isinstance(n_walkers, (int, np.integer)) or n_walkers < fewest:
        reason = f"{n} parameters need a whole number from {fewest} up"
        raise _refused("n_walkers", n_walkers, reason)


def _refused(name, value, reason):
    return FitError(f"{name} = {value!r}; {reason}", argument=name)


def _run(emcee, sampler, laplace, chain, thin, seed, progress):
    """Advance the walkers until the chain is full."""
    from tqdm import tqdm

    total = len(chain.coords) * thin
    state = _first_state(emcee, laplace, chain, sampler.nwalkers, seed)
    previous, accepted = state.coords.copy(), chain.accepted.copy()
    done = chain.count * thin
    steps = sampler.sample(state, iterations=total - done, store=False)
    # disable=None shows the bar on a terminal only
    with tqdm(
        total=total, initial=done, desc="sampling", disable=None if progress else True
    ) as bar:
        for step, state in enumerate(steps, done + 1):
            # counted at every step, not only at those that are kept
            accepted += (state.coords != previous).any(axis=1)
            previous[...] = state.coords
            if step % thin == 0:
                chain.append(state.coords, state.log_prob, state.random_state, accepted)
            bar.update()


def _first_state(emcee, laplace, chain, n_walkers, seed):
    if chain.count:
        last = chain.count - 1
        return emcee.State(
            chain.coords[last], log_prob=chain.log_prob[last], random_state=chain.random_state
        )
    # independent streams: the start does not depend on how many numbers the steps draw
    start, steps = np.random.SeedSequence(seed).spawn(2)
    coords = laplace.start(n_walkers, np.random.default_rng(start))
    # emcee takes the state of numpy's old generator only
    legacy = np.random.RandomState(np.random.MT19937(steps)).get_state()
    return emcee.State(coords, log_prob=laplace.log_posterior(coords), random_state=legacy)


# ---- what a checkpoint must agree with -----------------------------------------------


def _fingerprint(log_posterior, n_walkers, thin, moves, seed):
    """Return what makes a run what it is: in words, and as numbers that must be close."""
    measurement = log_posterior.measurement
    free = measurement.free
    low, high = free.bounds()
    held = log_posterior.fitted.copy()
    # what varies starts at the fit, but does not define the run
    held[log_posterior.sampled] = 0.0
    description = {
        "parameters": [[n, str(u or "")] for n, u in _pairs(log_posterior)],
        "model": [[_optic(leaf) for leaf in leaves(chain)] for chain in measurement.chains],
        "ties": [[name, t.source, t.factor, str(t.offset)] for name, t in free.ties.items()],
        "data": [dataset.observations.content_hash for dataset in measurement.datasets],
        "observable": measurement.observable.name,
        "priors": [[slot.name, *_distribution(prior)] for slot, prior in free.priors],
        "n_walkers": int(n_walkers),
        "thin": int(thin),
        "moves": move_names(moves),
        "seed": seed,
    }
    arrays = {
        "observed data": measurement.observed,
        "noise": log_posterior.sigma,
        "bounds": np.nan_to_num([low, high]),
        "values of the parameters held": held,
    }
    return description, arrays


def _pairs(log_posterior):
    return zip(log_posterior.names, log_posterior.units, strict=True)


def _optic(leaf):
    """Return class, name and stage of an optic, and the values of what is fixed."""
    fixed = {
        key: np.asarray(getattr(leaf, key).value).tolist()
        for key in leaf.param_names
        if getattr(leaf, key).fixed
    }
    return [type(leaf).__name__, leaf.name, leaf.mount, fixed]


def _distribution(prior):
    frozen = prior.distribution
    return frozen.dist.name, repr(frozen.args), repr(sorted(frozen.kwds.items()))


def _result(log_posterior, chain, thin, seed, burn_in, settings):
    kept = chain.count
    return Posterior(
        log_posterior.names,
        log_posterior.units,
        # from canonical to declared units
        chain.coords[:kept] / log_posterior.factors,
        chain.log_prob[:kept],
        acceptance=chain.accepted / (max(chain.accepted_over, kept) * thin),
        fitted=log_posterior.centre / log_posterior.factors,
        thin=thin,
        seed=seed,
        settings=settings,
        burn_in=burn_in,
    )


def _settings(log_posterior, moves, weights, version):
    """Return what was sampled and how, as plain values that a file can hold."""
    free, sigma = log_posterior.measurement.free, log_posterior.sigma
    sampled = set(log_posterior.names)
    return {
        "observable": log_posterior.measurement.observable.name,
        "held": [name for name in free.names if name not in sampled],
        "noise": {
            "from": weights or "one level",
            "least": float(sigma.min()),
            "median": float(np.median(sigma)),
            "largest": float(sigma.max()),
        },
        "priors": [_prior(slot, prior) for slot, prior in free.priors],
        "moves": move_names(moves),
        "emcee": version,
    }


def _prior(slot, prior):
    name, *_ = _distribution(prior)
    frozen = prior.distribution
    return {
        "parameter": slot.name,
        "unit": str(slot.unit or ""),
        "distribution": name,
        "mean": np.asarray(frozen.mean(), dtype=float).tolist(),
        "std": np.asarray(frozen.std(), dtype=float).tolist(),
    }
