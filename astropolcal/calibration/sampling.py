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
from astropolcal.calibration._optional import need
from astropolcal.calibration.log_posterior import LogPosterior
from astropolcal.calibration.posterior import ENOUGH, Posterior
from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalWarning, FitError

__all__ = ["sample"]

__doctest_requires__ = {"sample": ["emcee"]}

_FEWEST_WALKERS = 24
# widest start in a direction that the data hardly determine, in degree, micrometre or percent
_WIDEST = 0.3
_MAX_HALVINGS = 60


def sample(
    calibration,
    *,
    parameters=None,
    noise=None,
    n_walkers=None,
    n_steps=5000,
    thin=1,
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
        Noise of the data, see `LogPosterior`; by default the table's errors if
        the fit was weighted by them, otherwise the scatter of its residuals.
    n_walkers : int, optional
        At least twice the number of parameters (the default, or 24 if more).
    n_steps : int
        Steps of each walker, in total: a run that resumes does what is left.
    thin : int
        Every how many steps one is kept.
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
        Moves of emcee. By default its stretch move for up to 10 parameters,
        and differential evolution with snooker steps for more.

    Returns
    -------
    Posterior

    Warns
    -----
    AstropolcalWarning
        If the chain is shorter than 50 autocorrelation times.

    Raises
    ------
    AstropolcalError
        If emcee, or h5py for a checkpoint, is not installed.
    FitError
        If the numbers of walkers or steps make no sense, the walkers find no
        place to start, or the checkpoint belongs to another run, is in use, or
        cannot be written.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Notes
    -----
    The walkers start in a normal ball around the fit, with the covariance of
    the data and priors where these determine it, and 0.3 deg, micrometre or
    percent wide where they do not. Method: Foreman-Mackey et al. (2013),
    doi:10.1086/670067; moves: Goodman & Weare (2010),
    doi:10.2140/camcos.2010.5.65, and ter Braak & Vrugt (2008),
    doi:10.1007/s11222-008-9104-9.

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
    measurement = calibration._live()
    weights = None if noise is not None else calibration.settings.get("weights")
    log_posterior = LogPosterior(measurement, weights, noise, parameters)
    n = log_posterior.sampled.size
    n_walkers = max(2 * n, _FEWEST_WALKERS) if n_walkers is None else n_walkers
    _check(n, n_walkers, n_steps, thin, checkpoint_every)
    moves = _default_moves(emcee, n) if moves is None else moves
    sampler = emcee.EnsembleSampler(n_walkers, n, log_posterior, moves=moves, vectorize=True)
    chain = Chain((n_steps // thin, n_walkers, n), checkpoint_every)
    description, arrays = _fingerprint(log_posterior, n_walkers, thin, moves, seed)
    with chain.open(checkpoint, description, arrays, resume):
        _run(emcee, sampler, log_posterior, chain, thin, seed, progress)
    posterior = _result(log_posterior, chain, thin, seed)
    if not posterior.converged:
        warnings.warn(
            f"the chain is shorter than {ENOUGH} autocorrelation times: {posterior.words()}",
            AstropolcalWarning,
            stacklevel=2,
        )
    return posterior


def _check(n, n_walkers, n_steps, thin, every):
    for name, value in (("n_steps", n_steps), ("thin", thin), ("checkpoint_every", every)):
        if not isinstance(value, (int, np.integer)) or value < 1:
            raise FitError(f"{name} = {value!r}; allowed are whole numbers from 1 up")
    if n_steps < 2 * thin:
        raise FitError(f"n_steps = {n_steps} with thin = {thin} keeps fewer than two steps")
    fewest = max(2 * n, 4)
    if not isinstance(n_walkers, (int, np.integer)) or n_walkers < fewest:
        raise FitError(
            f"n_walkers = {n_walkers!r}; {n} parameters need a whole number from {fewest} up"
        )


def _default_moves(emcee, n):
    if n <= 10:
        return [(emcee.moves.StretchMove(), 1.0)]
    return [(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)]


def _run(emcee, sampler, log_posterior, chain, thin, seed, progress):
    """Advance the walkers until the chain is full."""
    from tqdm import tqdm

    total = len(chain.coords) * thin
    state = _first_state(emcee, log_posterior, chain, sampler.nwalkers, seed)
    previous, accepted = state.coords.copy(), chain.accepted.copy()
    done = chain.count * thin
    steps = sampler.sample(state, iterations=total - done, store=False)
    # disable=None shows the bar on a terminal only
    with tqdm(
        total=total, initial=done, desc="sampling", disable=None if progress else True
    ) as bar:
        for step, state in enumerate(steps, done + 1):
            accepted += (state.coords != previous).any(axis=1)
            previous[...] = state.coords
            if step % thin == 0:
                chain.append(state.coords, state.log_prob, state.random_state, accepted)
            bar.update()


def _first_state(emcee, log_posterior, chain, n_walkers, seed):
    if chain.count:
        last = chain.count - 1
        return emcee.State(
            chain.coords[last], log_prob=chain.log_prob[last], random_state=chain.random_state
        )
    start, steps = np.random.SeedSequence(seed).spawn(2)
    coords = _ball(log_posterior, n_walkers, np.random.default_rng(start))
    legacy = np.random.RandomState(np.random.MT19937(steps)).get_state()
    return emcee.State(coords, log_prob=log_posterior(coords), random_state=legacy)


def _ball(log_posterior, n_walkers, rng):
    """Return where the walkers start, shape (n_walkers, n)."""
    scale = log_posterior.physical_scale()
    scaled = log_posterior.whitened_jacobian() * scale[:, None]
    left, singular, _ = np.linalg.svd(scaled)
    singular = np.pad(singular, (0, scale.size - singular.size))
    width = 1 / np.maximum(singular, 1 / _WIDEST)
    offset = (rng.normal(size=(n_walkers, scale.size)) * width) @ left.T * scale
    return _possible(log_posterior, offset)


def _possible(log_posterior, offset):
    """Return the centre plus offsets, these mirrored at bounds and halved where impossible."""
    low, high, centre = log_posterior.low, log_posterior.high, log_posterior.centre
    outside = (centre + offset < low) | (centre + offset > high)
    offset = np.where(outside, -offset, offset)
    for _ in range(_MAX_HALVINGS):
        coords = np.clip(centre + offset, low, high)
        impossible = ~np.isfinite(log_posterior(coords))
        if not impossible.any():
            return coords
        offset[impossible] /= 2
    raise FitError("the walkers find no place to start: the fitted values have no probability")


# ---- what a checkpoint must agree with -----------------------------------------------


def _fingerprint(log_posterior, n_walkers, thin, moves, seed):
    """Return what makes a run what it is: in words, and as numbers that must be close."""
    measurement = log_posterior.measurement
    free = measurement.free
    low, high = free.bounds()
    held = log_posterior.fitted.copy()
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
        "moves": _move_names(moves),
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


def _move_names(moves):
    weighted = moves if isinstance(moves, list) else [moves]
    parts = [move if isinstance(move, tuple) else (move, 1.0) for move in weighted]
    return [[type(move).__name__, float(weight)] for move, weight in parts]


def _result(log_posterior, chain, thin, seed):
    kept = chain.count
    return Posterior(
        log_posterior.names,
        log_posterior.units,
        chain.coords[:kept] / log_posterior.factors,
        chain.log_prob[:kept],
        acceptance=chain.accepted / (max(chain.accepted_over, kept) * thin),
        fitted=log_posterior.centre / log_posterior.factors,
        thin=thin,
        seed=seed,
        settings={"observable": log_posterior.measurement.observable.name},
    )
