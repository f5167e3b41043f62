# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sample the posterior of a calibration with an ensemble of walkers (emcee).

The likelihood is that of normal noise; the priors are those of the fit. A run with a checkpoint can
be killed at any moment; called again it goes on with the same random numbers, so that the chain is
the same as without the interruption.
"""

import numpy as np

from astropolcal.calibration.noise.weighting import (
    GIVEN,
    Problem,
    Weighting,
    given_noise,
    noise_of,
    weighting_of,
)
from astropolcal.calibration.posterior.checkpoint import Chain
from astropolcal.calibration.posterior.samples import ENOUGH, Posterior, need
from astropolcal.calibration.result.calibration import Calibration
from astropolcal.calibration.uncertainty.covariance import widening
from astropolcal.chain import leaves
from astropolcal.exceptions import FitError, ParameterError, warn
from astropolcal.measurement.parameters import told_prior
from astropolcal.progress import in_one_thread, shown, steps
from astropolcal.units import check_seed
from astropolcal.words import check_type, did_you_mean, is_whole

__all__ = ["LogPosterior", "sample"]

FIT = "fit"


class LogPosterior:
    r"""
    Log-posterior of a measurement, up to a constant.

    :math:`-\frac{1}{2}\sum_i (r_i/\sigma_i)^2` plus the log density of the
    priors; minus infinity outside the bounds.

    Parameters
    ----------
    measurement : Measurement
        The measurement; its current values are those of the fit.
    weights : {"fit", None, "wavelength", "errors"}, NoiseEstimate or array_like
        Where the noise comes from, as for `~astropolcal.calibration.calibrate`. By default it is
        the one that the fit assumed, so that fit and posterior agree; one level
        from the residuals of all data if no fit is known.
    noise : float, `~astropy.units.Quantity` or array_like, optional
        Noise to use instead: one value, one per wavelength, or one per datum.
    parameters : sequence of str, optional
        What varies, ``"hwp.w_sio2"`` (all its values) or ``"derotator.horizontal[3]"``; all others
        keep their fitted values. By default everything varies.

    Raises
    ------
    FitError
        If there is no noise to be had.
    ParameterError
        If a parameter is unknown, fixed or named twice, or the noise has the
        wrong shape or is not positive.

    Examples
    --------
    >>> from astropolcal.calibration.posterior import LogPosterior
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> posterior = LogPosterior(cal.measurement, parameters=["hwp.w_sio2", "hwp.w_mgf2"])
    >>> posterior.names, posterior(posterior.centre) > posterior(posterior.centre + 1.0)
    (['hwp.w_sio2', 'hwp.w_mgf2'], True)
    """

    def __init__(self, measurement, weights=FIT, noise=None, parameters=None):
        self.measurement = measurement
        free = measurement.free
        low, high = free.bounds()
        #: All fitted values, canonical, shape (n_free,).
        self.fitted = np.clip(measurement.vector(), low, high)
        #: Elements of the flat vector that vary.
        self.sampled = _elements(free, parameters)
        #: Names of what varies, one an element.
        self.names = [free.names[i] for i in self.sampled]
        #: Declared units of what varies.
        self.units = [free.units[i] for i in self.sampled]
        #: Factors from declared to canonical units.
        self.factors = free.factors()[self.sampled]
        #: Bounds of what varies, canonical.
        self.low, self.high = low[self.sampled], high[self.sampled]
        #: Noise of each datum, shape (n_data,).
        if noise is not None:
            self.sigma = given_noise(measurement, noise)
        else:
            if isinstance(weights, str) and weights == FIT:
                known = measurement.weighting
                weights = None if known is None else known.choice
            self.sigma = noise_of(measurement, weights).sigma

    @property
    def centre(self):
        """Fitted values of what varies, canonical."""
        return self.fitted[self.sampled]

    def __call__(self, values):
        """Return the log-posterior at canonical values, (n,); (n_walkers,) at (n_walkers, n)."""
        values = np.asarray(values, dtype=float)
        if values.ndim not in (1, 2) or values.shape[-1] != self.sampled.size:
            raise ParameterError(
                f"values of shape {values.shape} for {self.sampled.size} parameters; allowed are "
                f"({self.sampled.size},) and (n_walkers, {self.sampled.size})"
            )
        rows = np.atleast_2d(values)
        # an optic outside of its bounds may not exist, so nothing is evaluated there
        inside = ((rows >= self.low) & (rows <= self.high)).all(axis=1)
        vectors = np.tile(self.fitted, (int(inside.sum()), 1))
        vectors[:, self.sampled] = rows[inside]
        total = -0.5 * np.array([self._chi2(vector) for vector in vectors])
        for slot, prior in self.measurement.free.priors:
            total += prior.log_densities(vectors[:, slot.slice]).sum(axis=1)
        found = np.full(len(rows), -np.inf)
        # emcee stops at NaN; a model that fails somewhere makes that place impossible
        found[inside] = np.where(np.isnan(total), -np.inf, total)
        return float(found[0]) if values.ndim == 1 else found

    def _chi2(self, vector):
        # not through Measurement.predict, which keeps its last sweep for the fitters
        parts = [d.values(d.forward(vector)) for d in self.measurement.datasets]
        return np.sum(((self.measurement.observed - np.concatenate(parts)) / self.sigma) ** 2)

    def whitened_jacobian(self):
        """Return derivatives of data and priors over their noise, (n, n_data + n_priors)."""
        problem = Problem(self.measurement, Weighting(GIVEN, self.sigma))
        return problem.jacobian(self.fitted).T[self.sampled]

    def physical_scale(self):
        """Return a degree, a micrometre or a percent of what varies, canonical."""
        return self.measurement.free.steps[self.sampled]


def _elements(free, parameters):
    """Return the elements of the flat vector that the names stand for, in their order."""
    if not free.size:
        raise ParameterError("nothing to sample: every parameter is fixed or tied")
    parameters = free.names if parameters is None else parameters
    parameters = [parameters] if isinstance(parameters, str) else list(parameters)
    by_name = {name: [i] for i, name in enumerate(free.names)}
    by_name |= {slot.name: list(range(slot.start, slot.start + slot.size)) for slot in free.slots}
    for name in parameters:
        if name not in by_name:
            raise ParameterError(
                f"no free parameter {name!r}; allowed are "
                f"{', '.join(slot.name for slot in free.slots)}, or one value of them such as "
                f"{free.names[-1]}{did_you_mean(name, by_name)}"
            )
    found = [i for name in parameters for i in by_name[name]]
    if not found or len(set(found)) < len(found):
        raise ParameterError(f"parameters = {parameters} must name something, and nothing twice")
    return np.array(found)


# ---- where the walkers of a sampler start, and how they move ----


# in degree, micrometre or percent: a direction counts as determined up to this error, and
# the walkers start as wide as this along one that is not
_WIDEST, _START = 5.0, 0.3
# a parameter closer to its bound than this (canonical units) sits at it
_AT_BOUND = 1e-5
_MAX_DRAWS, _MAX_HALVINGS = 50, 60
# least part of a walker's place that a step around the fit draws anew
_LEAST_ANEW = 0.1
# emcee up to this version accepts snooker steps with a wrong probability (its pull request 531):
# in 91 normal parameters their standard deviation comes out as 0.82 of the true one
_BIASED_SNOOKER = (3, 1, 6)


class Laplace:
    """The normal distribution around a fit, with the covariance of data and priors.

    It leaves out what sits at a bound. Along directions that are not determined it is narrow.
    """

    def __init__(self, log_posterior):
        self.log_posterior = log_posterior
        self.centre = log_posterior.centre
        scale = log_posterior.physical_scale()
        jacobian = log_posterior.whitened_jacobian() * scale[:, None]
        low, high = self.centre - log_posterior.low, log_posterior.high - self.centre
        near = _AT_BOUND * np.maximum(1.0, np.abs(self.centre))
        #: Sign in which each parameter can leave the bound that it sits at, else 0.
        self.inward = np.where(low <= near, 1.0, np.where(high <= near, -1.0, 0.0))
        self.free = self.inward == 0
        # rows of the Jacobian are parameters: left vectors are directions among them, (n, n)
        left, singular, _ = np.linalg.svd(jacobian[self.free])
        # the standard error along each, as the Jacobian is in units of the noise
        width = 1 / np.maximum(np.pad(singular, (0, len(left) - singular.size)), 1e-99)
        #: Which principal directions are determined.
        self.determined = width < _WIDEST
        width = np.where(self.determined, width, _START)
        # columns lead from unit normal numbers to parameters, `_back` the other way
        self._out = left * width * scale[self.free][:, None]
        self._back = (left / width).T / scale[self.free]
        # what sits at a bound leaves it as far as its own slope allows
        steepness = np.linalg.norm(jacobian[~self.free], axis=1)
        self._reach = scale[~self.free] / np.maximum(steepness, 1 / _START)

    def normal(self, coords):
        """Return coordinates along the principal directions, of unit width."""
        return (coords - self.centre)[:, self.free] @ self._back.T

    def place(self, coords, normal):
        """Return places with other coordinates along the principal directions."""
        coords = coords.copy()
        coords[:, self.free] = self.centre[self.free] + normal @ self._out.T
        return coords

    def start(self, n_walkers, rng):
        """Return places of walkers within the bounds, where there is probability.

        What is outside of the bounds is drawn again, and mirrored if that does not help; what is
        impossible comes closer to the fit.
        """
        low, high, centre = self.log_posterior.low, self.log_posterior.high, self.centre
        coords = self._draw(n_walkers, rng)
        # a normal cut off at the bounds, by rejection; near many bounds that may take forever
        for _ in range(_MAX_DRAWS):
            wrong = ((coords < low) | (coords > high)).any(axis=1)
            coords[wrong] = self._draw(int(wrong.sum()), rng)
        offset = np.where((coords < low) | (coords > high), centre - coords, coords - centre)
        for _ in range(_MAX_HALVINGS):
            coords = np.clip(centre + offset, low, high)
            impossible = ~np.isfinite(self.log_posterior(coords))
            if not impossible.any():
                return coords
            # the fit itself is possible, so that halving the way to it ends somewhere that is
            offset[impossible] /= 2
        raise FitError("the walkers find no place to start: the fitted values have no probability")

    def _draw(self, count, rng):
        coords = np.tile(self.centre, (count, 1))
        coords = self.place(coords, rng.normal(size=(count, self.determined.size)))
        away = np.abs(rng.normal(size=(count, self._reach.size))) * self._reach
        coords[:, ~self.free] += self.inward[~self.free] * away
        return coords


# ---- moves -------------------------------------------------------------------------------


def default_moves(emcee, laplace):
    """Return what moves the walkers, with the share of each.

    Steps around the fit, as good in a hundred parameters as in one, accepted as far as the
    posterior is the normal distribution around it (Cotter et al. 2013, Statistical Science 28, 424,
    doi:10.1214/13-STS421); steps of what sits at a bound alone; and differential evolution, which
    needs no fit.
    """
    moved, held = laplace.determined, ~laplace.free

    def around_the_fit(coords, random):
        before = laplace.normal(coords)
        after = before.copy()
        anew = random.uniform(_LEAST_ANEW, 1.0, size=(len(coords), 1))
        noise = random.normal(size=(len(coords), int(moved.sum())))
        after[:, moved] = np.sqrt(1 - anew**2) * before[:, moved] + anew * noise
        # log of the ratio of proposal densities; it undoes the normal part of the posterior
        gain = 0.5 * np.sum(after[:, moved] ** 2 - before[:, moved] ** 2, axis=1)
        return laplace.place(coords, after), gain

    class CrankNicolsonMove(emcee.moves.MHMove):
        """Steps around the fit."""

    class BoundDEMove(emcee.moves.DEMove):
        """Differential evolution of what sits at a bound, the rest held."""

        def get_proposal(self, s, c, random):
            proposed, factors = super().get_proposal(s, c, random)
            return np.where(held, proposed, s), factors

    moves = [(emcee.moves.DEMove(), 0.3)]
    if moved.any():
        moves.append((CrankNicolsonMove(around_the_fit), 0.5))
    if held.any():
        # the optimal scale for as many dimensions as move
        # (ter Braak 2006, doi:10.1007/s11222-006-8769-1)
        moves.append((BoundDEMove(gamma0=2.38 / np.sqrt(2 * int(held.sum()))), 0.2))
    return moves


def move_names(moves):
    """Return the name of each move, and its share."""
    weighted = moves if isinstance(moves, list) else [moves]
    parts = [move if isinstance(move, tuple) else (move, 1.0) for move in weighted]
    for move, *_ in parts:
        if not hasattr(move, "propose"):
            allowed = "allowed are moves of emcee, such as emcee.moves.StretchMove()"
            raise FitError(f"moves: {move!r}; {allowed}", argument="moves")
    return [[type(move).__name__, float(weight)] for move, weight in parts]


def refuse_biased(moves, version):
    """Raise FitError if emcee samples wrongly with a move, or it is none."""
    numbers = tuple(int(part) for part in version.split(".")[:3] if part.isdigit())
    if "DESnookerMove" in dict(move_names(moves)) and numbers <= _BIASED_SNOOKER:
        raise FitError(
            f"moves: the DESnookerMove of emcee {version} samples too narrow a distribution; "
            "use DEMove or StretchMove"
        )


# ---- sample the posterior of a calibration with an ensemble of walkers (emcee) ----


__doctest_requires__ = {"sample": ["emcee"]}

_FEWEST_WALKERS = 24
# a share by which samples may be too narrow without a word
_NARROW = 0.2
_PARAMETERS_A_STEP_KEPT = 20


@in_one_thread
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
        A calibration with its data, as `~astropolcal.calibration.calibrate` returns it.
    parameters : sequence of str, optional
        What varies, see ``LogPosterior``; by default all free parameters.
    noise : float, `~astropy.units.Quantity` or array_like, optional
        Noise of the data, see ``LogPosterior``; by default the noise that the fit assumed.
    n_walkers : int, optional
        At least twice the number of parameters (the default, or 24 if more).
    n_steps : int
        Steps of each walker, in total: a run that resumes does what is left.
    thin : int, optional
        Every how many steps one is kept, by default a twentieth of the number of parameters.
    burn_in : int, optional
        Steps to leave out at the start; by default 5 autocorrelation times, at most half of all.
    seed : int, optional
        Makes the run repeatable.
    checkpoint : path-like, optional
        HDF5 file that the run is written to.
    checkpoint_every : int
        Number of kept steps between two writes, which is the most that a killed run loses.
    resume : bool
        Whether to go on from a checkpoint that exists; otherwise it is replaced.
    progress : bool
        Whether to show how far it is; on a terminal only.
    moves : object or list, optional
        Moves of emcee. By default a mixture of preconditioned Crank-Nicolson steps around the fit,
        which are large where the posterior is nearly normal, and of differential evolution.

    Returns
    -------
    Posterior

    Warns
    -----
    AstropolcalWarning
        If the chain is shorter than 50 autocorrelation times, or the walkers do not agree; or if
        residuals are correlated or vary so that the errors of the calibration are larger than those
        of the independent data that the samples are drawn for.

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
    The walkers start in a normal ball around the fit, with the covariance of the data and priors
    where these determine it to 5 deg, micrometre or percent, and 0.3 of these wide where they do
    not. Method: Foreman-Mackey et al. (2013), doi:10.1086/670067; moves: Goodman & Weare (2010),
    doi:10.2140/camcos.2010.5.65, Nelson et al. (2014), doi:10.1088/0067-0049/210/1/11, and Cotter
    et al. (2013), doi:10.1214/13-STS421.

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
    wanted = "what `calibrate` returns is needed"
    check_type("calibration", calibration, Calibration, wanted, FitError)
    seed = check_seed(seed, generator=False)
    measurement = calibration.live_measurement()
    weights = "given" if noise is not None else weighting_of(calibration).choice
    log_posterior = LogPosterior(measurement, noise=noise, parameters=parameters)
    n = log_posterior.sampled.size
    n_walkers = max(2 * n, _FEWEST_WALKERS) if n_walkers is None else n_walkers
    thin = max(n // _PARAMETERS_A_STEP_KEPT, 1) if thin is None else thin
    _check(n, n_walkers, n_steps, thin, checkpoint_every, burn_in)
    laplace = Laplace(log_posterior)
    moves = default_moves(emcee, laplace) if moves is None else moves
    refuse_biased(moves, emcee.__version__)
    sampler = emcee.EnsembleSampler(n_walkers, n, log_posterior, moves=moves, vectorize=True)
    chain = Chain((n_steps // thin, n_walkers, n), checkpoint_every)
    # a checkpoint may only be continued by the very run that wrote it
    description, arrays = _fingerprint(log_posterior, n_walkers, thin, moves, seed)
    with chain.open(checkpoint, description, arrays, resume):
        _run(emcee, sampler, laplace, chain, thin, seed, progress)
    kept, narrow = chain.count, "" if noise is not None else _narrow(calibration, log_posterior)
    posterior = Posterior(
        log_posterior.names,
        log_posterior.units,
        # from canonical to declared units
        chain.coords[:kept] / log_posterior.factors,
        # a part of the steps would hold them all in memory
        chain.log_prob[:kept].copy(),
        acceptance=chain.accepted / (kept * thin),
        fitted=log_posterior.centre / log_posterior.factors,
        thin=thin,
        seed=seed,
        settings=_settings(log_posterior, moves, weights, emcee.__version__) | {"scatter": narrow},
        # of kept steps
        burn_in=None if burn_in is None else -(-int(burn_in) // thin),
    )
    _warn(posterior)
    return posterior


def _warn(posterior):
    """Warn of a chain that has not converged, and of samples that are too narrow."""
    doubts = [posterior.scatter]
    if not posterior.converged:
        short = posterior.n_times < ENOUGH
        problem = f"shorter than {ENOUGH} autocorrelation times" if short else "not converged"
        complaints = "; ".join(posterior.convergence.complaints(posterior.names))
        doubts.append(f"the chain is {problem}: {complaints}")
    for doubt in filter(None, doubts):
        warn(doubt, stacklevel=3)


def _narrow(calibration, log_posterior):
    """Return in words by how much the errors of the fit exceed those of independent data."""
    times = widening(calibration)[log_posterior.sampled]
    worst = int(np.argmax(times))
    words = (
        "the samples take data as independent; by the scatter of the residuals the error of "
        f"{log_posterior.names[worst]} is {times[worst]:.1f} times as large (see the covariance)"
    )
    return words if times[worst] > 1 + _NARROW else ""


def _check(n, n_walkers, n_steps, thin, every, burn_in):
    for name, value in (("n_steps", n_steps), ("thin", thin), ("checkpoint_every", every)):
        if not is_whole(value) or value < 1:
            raise _refused(name, value, "allowed are whole numbers from 1 up")
    if n_steps < 2 * thin:
        kept = f", as one in {thin} is kept" if thin > 1 else ""
        raise _refused("n_steps", n_steps, f"allowed are whole numbers from {2 * thin} up{kept}")
    fewest = max(2 * n, 4)
    if not is_whole(n_walkers) or n_walkers < fewest:
        reason = f"{n} parameters need a whole number from {fewest} up"
        raise _refused("n_walkers", n_walkers, reason)
    # two kept steps at least must be left, for a standard deviation
    most = (n_steps // thin - 2) * thin
    if burn_in is not None and (not is_whole(burn_in) or not 0 <= burn_in <= most):
        allowed = f"{n_steps} steps allow whole numbers from 0 to {most}"
        raise _refused("burn_in", burn_in, allowed)


def _refused(name, value, reason):
    return FitError(f"{name} = {value!r}; {reason}", argument=name)


def _run(emcee, sampler, laplace, chain, thin, seed, progress):
    """Advance the walkers until the chain is full."""
    if chain.count:
        coords, log_prob = chain.coords[chain.count - 1], chain.log_prob[chain.count - 1]
        random_state = chain.random_state
    else:
        # independent streams: the start does not depend on how many numbers the steps draw
        start, moving = np.random.SeedSequence(seed).spawn(2)
        coords = laplace.start(sampler.nwalkers, np.random.default_rng(start))
        log_prob = laplace.log_posterior(coords)
        # emcee takes the state of numpy's old generator only
        random_state = np.random.RandomState(np.random.MT19937(moving)).get_state()
    state = emcee.State(coords, log_prob=log_prob, random_state=random_state)
    previous, accepted = state.coords.copy(), chain.accepted.copy()
    total, done = len(chain.coords) * thin, chain.count * thin
    states = sampler.sample(state, iterations=total - done, store=False)
    with shown(progress):
        for step, state in enumerate(steps(states, "steps", total, done), done + 1):
            # counted at every step, not only at those that are kept
            accepted += (state.coords != previous).any(axis=1)
            previous[...] = state.coords
            if step % thin == 0:
                chain.append(state.coords, state.log_prob, state.random_state, accepted)


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
        "parameters": [
            [name, str(unit or "")]
            for name, unit in zip(log_posterior.names, log_posterior.units, strict=True)
        ],
        "model": [[_optic(leaf) for leaf in leaves(chain)] for chain in measurement.chains],
        "ties": [[name, t.source, t.factor, str(t.offset)] for name, t in free.ties.items()],
        "data": [dataset.observations.content_hash for dataset in measurement.datasets],
        "observable": measurement.observable.name,
        "priors": [[slot.name, told_prior(prior.distribution)] for slot, prior in free.priors],
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


def _optic(leaf):
    """Return what an optic is, and the values of what is fixed."""
    held = (getattr(leaf, key) for key in leaf.param_names if getattr(leaf, key).fixed)
    return [*leaf.fingerprint(), {p.name: np.asarray(p.value).tolist() for p in held}]


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
        "priors": [
            {
                "parameter": slot.name,
                "unit": str(slot.unit or ""),
                "distribution": (frozen := prior.distribution).dist.name,
                "mean": np.asarray(frozen.mean(), dtype=float).tolist(),
                "std": np.asarray(frozen.std(), dtype=float).tolist(),
            }
            for slot, prior in free.priors
        ],
        "moves": move_names(moves),
        "emcee": version,
    }
