# Licensed under a 3-clause BSD style license - see LICENSE
"""Samples of a posterior: quantiles, covariance, and whether to believe them."""

from functools import cached_property

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration._optional import need
from astropolcal.calibration.covariance import Covariance
from astropolcal.exceptions import ParameterError

__all__ = ["ENOUGH", "Posterior", "autocorrelation", "autocorrelation_time"]

#: Autocorrelation times that a chain must be long for its quantiles to be trusted.
ENOUGH = 50
# lags are summed up to this many times the result (Sokal's window)
_WINDOW = 5
# steps left out at the start, in autocorrelation times
_BURN_IN = 5
# chains that agree have a smaller R-hat (Vehtari et al. 2021, doi:10.1214/20-BA1221)
_R_HAT = 1.01
_KEYS = ("names", "units", "chain", "log_prob", "acceptance", "fitted", "thin", "seed", "settings")


def autocorrelation(chain):
    """
    Return the autocorrelation of an ensemble, averaged over its walkers.

    Deviations are taken from the mean of all walkers, so that walkers that
    stay in different places count as correlated.

    Parameters
    ----------
    chain : array_like
        One parameter, shape (n_steps, n_walkers).

    Returns
    -------
    `~numpy.ndarray`
        For lags 0 to n_steps - 1; NaN where nothing moves.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import autocorrelation
    >>> float(autocorrelation(np.random.default_rng(1).normal(size=(100, 8)))[0])
    1.0
    """
    chain = np.asarray(chain, dtype=float)
    deviation = chain - chain.mean()
    n = len(chain)
    spectrum = np.fft.rfft(deviation, n=2 * n, axis=0)
    covariance = np.fft.irfft(np.mean(np.abs(spectrum) ** 2, axis=1), n=2 * n)[:n]
    flat = np.ptp(chain) <= 1e-14 * np.abs(chain).max(initial=0.0)
    return np.full(n, np.nan) if flat else covariance / covariance[0]


def autocorrelation_time(chain):
    r"""
    Return the integrated autocorrelation time of an ensemble, in steps.

    :math:`\tau = 1 + 2\sum_{t=1}^{M}\rho(t)` with the smallest window M that
    is at least :math:`5\tau` [1]_, [2]_.

    Parameters
    ----------
    chain : array_like
        One parameter, shape (n_steps, n_walkers).

    Returns
    -------
    float
        NaN where nothing moves.

    References
    ----------
    .. [1] Sokal, A. 1997, "Monte Carlo Methods in Statistical Mechanics",
       doi:10.1007/978-1-4899-0319-8_6
    .. [2] Goodman, J. & Weare, J. 2010, CAMCoS 5, 65, doi:10.2140/camcos.2010.5.65

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import autocorrelation_time
    >>> noise = np.random.default_rng(1).normal(size=(5000, 8))
    >>> round(autocorrelation_time(noise), 1)
    1.0
    """
    time = 2 * np.cumsum(autocorrelation(chain)) - 1
    wide = np.arange(len(time)) >= _WINDOW * time
    return float(time[np.argmax(wide)] if wide.any() else time[-1])


class Posterior:
    """
    Samples of the posterior of calibrated parameters; `sample` makes it.

    Parameters
    ----------
    names : sequence of str
        Name of each parameter, such as ``derotator.horizontal[3]``.
    units : sequence of `~astropy.units.Unit`, str or None
        Unit of each.
    chain : array_like
        Shape (n_steps, n_walkers, n_parameters), in these units.
    log_prob : array_like
        Log-posterior, up to a constant, shape (n_steps, n_walkers).
    acceptance : array_like, optional
        Share of steps in which each walker moved, shape (n_walkers,).
    fitted : array_like, optional
        Values of the fit that the walkers started from, shape (n_parameters,).
    thin : int
        Steps of the sampler for each step kept.
    seed : int, optional
        Seed of the random numbers.
    settings : dict, optional
        How it was made.

    Raises
    ------
    ParameterError
        If the shapes differ.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.calibration import Posterior
    >>> chain = np.random.default_rng(1).normal(3.0, 0.1, size=(4000, 4, 1))
    >>> posterior = Posterior(["hwp.theta"], [u.deg], chain, np.zeros((4000, 4)))
    >>> posterior.quantile("hwp.theta", 0.5).round(1)
    <Quantity 3. deg>
    """

    def __init__(
        self,
        names,
        units,
        chain,
        log_prob,
        *,
        acceptance=None,
        fitted=None,
        thin=1,
        seed=None,
        settings=None,
    ):
        self.names = list(names)
        self.units = [u.Unit(unit) if unit else None for unit in units]
        self.chain = np.asarray(chain, dtype=float)
        self.log_prob = np.asarray(log_prob, dtype=float)
        self.acceptance = None if acceptance is None else np.asarray(acceptance, dtype=float)
        self.fitted = None if fitted is None else np.asarray(fitted, dtype=float)
        self.thin = int(thin)
        self.seed = seed
        self.settings = dict(settings or {})
        n = len(self.names)
        if self.chain.ndim != 3 or self.chain.shape[2] != n or len(self.units) != n:
            raise ParameterError(
                f"chain of {n} names and {len(self.units)} units has shape {self.chain.shape}; "
                "allowed is (n_steps, n_walkers, n_parameters)"
            )
        if self.log_prob.shape != self.chain.shape[:2]:
            raise ParameterError(
                f"log_prob has shape {self.log_prob.shape}, the chain {self.chain.shape}"
            )
        for key, size in (("acceptance", self.chain.shape[1]), ("fitted", n)):
            if getattr(self, key) is not None and getattr(self, key).shape != (size,):
                raise ParameterError(f"{key} has shape {getattr(self, key).shape}, not ({size},)")

    def __repr__(self):
        steps, walkers, n = self.chain.shape
        return f"<Posterior of {n} parameters: {steps} steps of {walkers} walkers>"

    def __eq__(self, other):
        if not isinstance(other, Posterior):
            return NotImplemented
        mine, theirs = self.to_dict(), other.to_dict()
        return all(_equal(mine[key], theirs[key]) for key in _KEYS)

    __hash__ = None

    # ---- convergence -----------------------------------------------------------

    @cached_property
    def burn_in(self):
        """Kept steps left out at the start: 5 autocorrelation times, at most half of all."""
        half = len(self.chain) // 2
        times = self._times(half)
        longest = np.nanmax(times) if np.isfinite(times).any() else np.inf
        return int(min(half, np.ceil(_BURN_IN * longest))) if np.isfinite(longest) else half

    def _times(self, start):
        return np.array(
            [autocorrelation_time(self.chain[start:, :, i]) for i in range(len(self.names))]
        )

    @cached_property
    def autocorrelation_times(self):
        """Integrated autocorrelation time of each parameter, in steps of the sampler."""
        return self._times(self.burn_in) * self.thin

    @property
    def n_times(self):
        """Length of the chain in the longest autocorrelation times, 0 where nothing moves."""
        times = self.autocorrelation_times
        if not np.isfinite(times).all():
            return 0.0
        return float(len(self.chain) * self.thin / times.max())

    @property
    def converged(self):
        """Whether the chain is longer than 50 of its longest autocorrelation times."""
        return self.n_times >= ENOUGH

    def words(self):
        """
        Return what the chain says about itself.

        Returns
        -------
        str
            Length, autocorrelation, acceptance; what to do if it is too short.
        """
        steps, walkers, n = self.chain.shape
        times = self.autocorrelation_times
        lines = [f"{steps * self.thin} steps of {walkers} walkers in {n} parameters."]
        if not np.isfinite(times).all():
            stuck = [name for name, time in zip(self.names, times, strict=True) if np.isnan(time)]
            lines.append(f"NOT CONVERGED: {', '.join(stuck)} did not move.")
            return "\n".join(lines)
        slowest = int(np.argmax(times))
        lines.append(
            f"The longest autocorrelation time is {times[slowest]:.0f} steps, of "
            f"{self.names[slowest]}; the chain is {int(self.n_times)} times as long."
        )
        if not self.converged:
            lines.append(
                f"NOT CONVERGED: {ENOUGH} times are needed; run {self._wanted()} steps or more."
            )
        if self.acceptance is not None:
            low, high = self.acceptance.min(), self.acceptance.max()
            lines.append(f"The walkers moved in {low:.0%} to {high:.0%} of the steps.")
        lines.append(f"The first {self.burn_in * self.thin} steps are left out as burn-in.")
        return "\n".join(lines)

    def _wanted(self):
        """Return how many steps would do, to two digits."""
        needed = ENOUGH * self.autocorrelation_times.max()
        step = 10 ** max(int(np.floor(np.log10(needed))) - 1, 0)
        return int(np.ceil(needed / step) * step)

    # ---- numbers -----------------------------------------------------------------

    def samples(self, burn_in=None):
        """
        Return the samples of all walkers behind the burn-in.

        Parameters
        ----------
        burn_in : int, optional
            Kept steps to leave out, by default ``self.burn_in``.

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_samples, n_parameters), in the declared units.
        """
        start = self.burn_in if burn_in is None else burn_in
        return self.chain[start:].reshape(-1, len(self.names))

    def index(self, name):
        """
        Return the place of a parameter in the chain.

        Parameters
        ----------
        name : str
            One of ``names``.

        Raises
        ------
        ParameterError
            If there is no such parameter.
        """
        if name not in self.names:
            raise ParameterError(f"no parameter {name!r} in the posterior of {self.names}")
        return self.names.index(name)

    def quantile(self, name, q):
        """
        Return quantiles of a parameter.

        Parameters
        ----------
        name : str
            One of ``names``.
        q : float or array_like
            Between 0 and 1.

        Returns
        -------
        `~astropy.units.Quantity` or float

        Raises
        ------
        ParameterError
            If there is no such parameter or q is out of range.
        """
        i = self.index(name)
        if np.any((np.asarray(q) < 0) | (np.asarray(q) > 1)):
            raise ParameterError(f"q = {q}; allowed are numbers from 0 to 1")
        value = np.quantile(self.samples()[:, i], q)
        return value if self.units[i] is None else value * self.units[i]

    @property
    def covariance(self):
        """`Covariance` of the samples; finite for undetermined parameters too, by the priors."""
        n = len(self.names)
        return Covariance(self.names, self.units, np.cov(self.samples().T).reshape(n, n))

    def summary(self):
        """
        Return one row a parameter.

        Returns
        -------
        `~astropy.table.QTable`
            ``name``, ``unit``, ``median``, 16 % quantile ``lower``, 84 %
            quantile ``upper``, ``std``, autocorrelation time ``tau`` in steps,
            rank-normalized split ``r_hat`` over the walkers, and bulk
            effective sample size ``ess``.

        Raises
        ------
        AstropolcalError
            If arviz-stats is not installed.
        """
        stats = need("arviz_stats.base", "the summary of a posterior").array_stats
        lower, median, upper = np.quantile(self.samples(), [0.16, 0.5, 0.84], axis=0)
        draws = self.chain[self.burn_in :].transpose(2, 1, 0)
        return QTable(
            {
                "name": self.names,
                "unit": [str(unit or "") for unit in self.units],
                "median": median,
                "lower": lower,
                "upper": upper,
                "std": self.samples().std(axis=0, ddof=1),
                "tau": self.autocorrelation_times,
                "r_hat": [float(stats.rhat(draw)) for draw in draws],
                "ess": [float(stats.ess(draw)) for draw in draws],
            }
        )

    # ---- files ----------------------------------------------------------------------

    def thinned(self, step):
        """
        Return a posterior with every ``step``-th step, for a smaller file.

        Parameters
        ----------
        step : int
            At least 1.

        Returns
        -------
        Posterior
        """
        if step < 1 or step > len(self.chain):
            raise ParameterError(f"step = {step}; allowed are 1 to {len(self.chain)}")
        parts = self.to_dict() | {"thin": self.thin * step}
        for key in ("chain", "log_prob"):
            parts[key] = parts[key][step - 1 :: step]
        return Posterior.from_dict(parts)

    def to_dict(self):
        """
        Return everything as arrays, lists and plain values.

        Returns
        -------
        dict
            Keys ``names, units, chain, log_prob, acceptance, fitted, thin,
            seed, settings``; units as text, empty where there is none.
        """
        plain = {key: getattr(self, key) for key in _KEYS}
        return plain | {"units": [str(unit or "") for unit in self.units]}

    @classmethod
    def from_dict(cls, parts):
        """
        Make it from what `to_dict` returned.

        Parameters
        ----------
        parts : dict
            With the same keys.

        Returns
        -------
        Posterior

        Raises
        ------
        ParameterError
            If a key is missing or unknown, or the shapes differ.
        """
        if set(parts) != set(_KEYS):
            odd = sorted(set(parts) ^ set(_KEYS))
            raise ParameterError(f"posterior with missing or unknown {', '.join(odd)}")
        return cls(**parts)


def _equal(a, b):
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    return type(a) is type(b) and a == b
