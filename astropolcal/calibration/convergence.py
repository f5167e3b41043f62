# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether a chain of samples is long enough, and what the whole of it says."""

from dataclasses import asdict, dataclass, fields

import numpy as np

from astropolcal.calibration._optional import need
from astropolcal.exceptions import AstropolcalError, ParameterError

__all__ = [
    "ENOUGH",
    "Convergence",
    "autocorrelation",
    "autocorrelation_time",
    "autocorrelation_times",
]

#: Autocorrelation times that a chain must be long for its quantiles to be trusted.
ENOUGH = 50
#: Largest rank-normalized split R-hat, and fewest effective samples, of chains that agree.
LARGEST_R_HAT, FEWEST_SAMPLES = 1.05, 400
# lags are summed up to this many times the result (Sokal's window)
_WINDOW = 5
_QUANTILES = (0.16, 0.5, 0.84)
# the tail is what lies outside of these quantiles
_TAIL = (0.05, 0.95)


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
    # padded to twice the length: without it the end of the chain correlates with its beginning
    spectrum = np.fft.rfft(deviation, n=2 * n, axis=0)
    covariance = np.fft.irfft(np.mean(np.abs(spectrum) ** 2, axis=1), n=2 * n)[:n]
    return np.full(n, np.nan) if _is_flat(chain) else covariance / covariance[0]


def _is_flat(chain):
    return np.ptp(chain) <= 1e-14 * np.abs(chain).max(initial=0.0)


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


def autocorrelation_times(chain):
    """
    Return the autocorrelation time of every parameter, in kept steps.

    Parameters
    ----------
    chain : `~numpy.ndarray`
        Shape (n_steps, n_walkers, n_parameters).

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_parameters,).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration.convergence import autocorrelation_times
    >>> noise = np.random.default_rng(1).normal(size=(5000, 8, 2))
    >>> autocorrelation_times(noise).round(1)
    array([1., 1.])
    """
    return np.array([autocorrelation_time(chain[:, :, i]) for i in range(chain.shape[2])])


@dataclass(frozen=True, eq=False)
class Convergence:
    r"""
    What a run of walkers says of itself, and of each of its parameters.

    It is worked out from all steps behind the burn-in and stays with a
    posterior that is thinned. Arrays have one value a parameter, the
    quantiles in its unit; NaN where a parameter did not move.

    Parameters
    ----------
    n_steps : int
        Steps of the sampler, burn-in included.
    burn_in : int
        Steps of the sampler that were left out at the start.
    n_draws : int
        Samples of all walkers from which the rest is worked out.
    times : array_like
        Integrated autocorrelation times, in steps of the sampler.
    median, lower, upper : array_like
        Quantiles 0.5, 0.16 and 0.84.
    std : array_like
        Standard deviations.
    r_hat : array_like or None
        Rank-normalized split :math:`\hat R` over the walkers [1]_; None
        without arviz-stats.
    ess_bulk, ess_tail : array_like or None
        Effective sample sizes of the middle and of the quantiles 0.05 and
        0.95 [1]_.

    Raises
    ------
    ParameterError
        If the arrays differ in shape.

    References
    ----------
    .. [1] Vehtari, A. et al. 2021, Bayesian Analysis 16, 667, doi:10.1214/20-BA1221

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration.convergence import Convergence
    >>> noise = np.random.default_rng(1).normal(size=(500, 8, 1))
    >>> found = Convergence.of(noise)
    >>> found.converged, found.n_draws
    (True, 4000)
    """

    n_steps: int
    burn_in: int
    n_draws: int
    times: np.ndarray
    median: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    std: np.ndarray
    r_hat: np.ndarray | None = None
    ess_bulk: np.ndarray | None = None
    ess_tail: np.ndarray | None = None

    def __post_init__(self):
        for field in fields(self)[3:]:
            value = getattr(self, field.name)
            if value is not None:
                object.__setattr__(self, field.name, np.array(value, dtype=float))
        shapes = {
            key: value.shape for key, value in asdict(self).items() if hasattr(value, "shape")
        }
        if len(set(shapes.values())) != 1 or len(shapes["times"]) != 1:
            raise ParameterError(f"convergence: one value a parameter is allowed, not {shapes}")

    @classmethod
    def of(cls, chain, *, thin=1, burn_in=0, times=None):
        """
        Work it out.

        Parameters
        ----------
        chain : array_like
            Shape (n_steps, n_walkers, n_parameters).
        thin : int
            Steps of the sampler for each step of the chain.
        burn_in : int
            Steps of the chain to leave out.
        times : array_like, optional
            Autocorrelation times in steps of the sampler, if they are known.

        Returns
        -------
        Convergence
        """
        used = np.asarray(chain, dtype=float)[burn_in:]
        times = autocorrelation_times(used) * thin if times is None else times
        flat = used.reshape(-1, used.shape[2])
        lower, median, upper = np.quantile(flat, _QUANTILES, axis=0)
        return cls(
            n_steps=len(chain) * thin,
            burn_in=burn_in * thin,
            n_draws=len(flat),
            times=times,
            median=median,
            lower=lower,
            upper=upper,
            std=flat.std(axis=0, ddof=1),
            **_statistics(used),
        )

    @property
    def n_times(self):
        """Length of the run in the longest autocorrelation times, 0 where nothing moves."""
        return float(self.n_steps / self.times.max()) if np.isfinite(self.times).all() else 0.0

    @property
    def converged(self):
        """Whether it is long enough, the walkers agree, and the samples suffice."""
        return not self.complaints(["?"] * self.times.size)

    def complaints(self, names):
        """
        Return what is wrong, one sentence without a full stop each.

        Parameters
        ----------
        names : sequence of str
            Name of each parameter.

        Returns
        -------
        list of str
            Empty for a run that has converged.
        """
        stuck = [name for name, time in zip(names, self.times, strict=True) if np.isnan(time)]
        if stuck:
            return [f"{', '.join(stuck)} did not move"]
        found = []
        if self.n_times < ENOUGH:
            found.append(f"{ENOUGH} times are needed; run {self._wanted()} steps or more")
        if self.r_hat is None:
            return found
        worst, value = _extreme(self.r_hat, names, largest=True)
        if not value <= LARGEST_R_HAT:
            found.append(
                f"R-hat of {worst} is {value:.3f}, but {LARGEST_R_HAT} is the most for walkers "
                "that agree"
            )
        for kind, size in (("bulk", self.ess_bulk), ("tail", self.ess_tail)):
            worst, value = _extreme(size, names, largest=False)
            if not value >= FEWEST_SAMPLES:
                found.append(
                    f"{worst} has an effective sample size ({kind}) of {value:.0f}, but "
                    f"{FEWEST_SAMPLES} are needed"
                )
        return found

    def _wanted(self):
        """Return how many steps would do, to two digits."""
        needed = ENOUGH * self.times.max()
        step = 10 ** max(int(np.floor(np.log10(needed))) - 1, 0)
        return int(np.ceil(needed / step) * step)

    def agreement(self):
        """
        Return the largest R-hat and the smallest effective sample size in words.

        Returns
        -------
        str
            Empty where they are not known.
        """
        if self.r_hat is None or not np.isfinite(self.times).all():
            return ""
        size = min(self.ess_bulk.min(), self.ess_tail.min())
        return (
            f"R-hat is {self.r_hat.max():.3f} or less, the effective sample size "
            f"{size:.0f} or more."
        )


def _extreme(values, names, largest):
    """Return name and value of the worst; what is not a number is worse than any."""
    bad = np.where(np.isnan(values), np.inf, values if largest else -values)
    i = int(np.argmax(bad))
    return names[i], values[i]


def _statistics(used):
    """Return R-hat and effective sample sizes; nothing without arviz-stats."""
    try:
        stats = need("arviz_stats.base", "convergence").array_stats
    except AstropolcalError:
        return {}
    measures = {
        "r_hat": stats.rhat,
        "ess_bulk": lambda draws: stats.ess(draws, method="bulk"),
        "ess_tail": lambda draws: stats.ess(draws, method="tail", prob=_TAIL),
    }
    columns = [np.ascontiguousarray(used[:, :, i].T) for i in range(used.shape[2])]
    return {
        key: np.array([np.nan if _is_flat(draws) else float(of(draws)) for draws in columns])
        for key, of in measures.items()
    }
