# Licensed under a 3-clause BSD style license - see LICENSE
"""Samples of a posterior: quantiles, covariance, and whether the chain is long enough."""

from dataclasses import asdict, dataclass, fields
from functools import cached_property, partial
from importlib import import_module
from inspect import signature

import astropy.units as u
import numpy as np

from astropolcal.calibration.result.calibration import ParameterTable
from astropolcal.calibration.uncertainty.covariance import Covariance, same_content
from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.files import plain

__all__ = ["Posterior"]


def need(module, what):
    """Return an optional module of the extra ``mcmc``, or say how to install it."""
    try:
        return import_module(module)
    except ImportError as error:
        # as pip knows it: arviz_stats.base is in arviz-stats
        package = module.split(".")[0].replace("_", "-")
        raise AstropolcalError(
            f"{what} needs the package {package}, which is not installed: "
            'pip install "astropolcal[mcmc]", or in a clone pip install ".[mcmc]"'
        ) from error


# ---- whether a chain of samples is long enough, and what the whole of it says ----


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
    """Return the autocorrelation of (n_steps, n_walkers); NaN where nothing moves.

    Deviations are from the mean of all, so that walkers that stay in different places count as
    correlated.
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
    r"""Return the integrated autocorrelation time of (n_steps, n_walkers), in steps.

    :math:`\tau = 1 + 2\sum_{t=1}^{M}\rho(t)` with the smallest window M of at least :math:`5\tau`
    (Sokal 1997; Goodman & Weare 2010, CAMCoS 5, 65, doi:10.2140/camcos.2010.5.65); NaN where
    nothing moves.
    """
    time = 2 * np.cumsum(autocorrelation(chain)) - 1
    wide = np.arange(len(time)) >= _WINDOW * time
    return float(time[np.argmax(wide)] if wide.any() else time[-1])


def autocorrelation_times(chain):
    """Return the autocorrelation time of each parameter of a (n_steps, n_walkers, n) chain."""
    return np.array([autocorrelation_time(chain[:, :, i]) for i in range(chain.shape[2])])


@dataclass(frozen=True, eq=False)
class Convergence:
    r"""What a run of walkers says of itself and of each parameter after the burn-in.

    Steps are those of the sampler. :math:`\hat R` is rank-normalized and split; ``ess_bulk`` and
    ``ess_tail`` are effective sample sizes (Vehtari et al. 2021, Bayesian Analysis 16, 667); None
    without arviz-stats.
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
            raise ParameterError(f"convergence: one value per parameter is allowed, not {shapes}")

    @classmethod
    def of(cls, chain, *, thin=1, burn_in=0):
        """Work it out from a chain (n_steps, n_walkers, n_parameters), thinned by ``thin``.

        ``burn_in`` counts steps of the chain.
        """
        used = np.asarray(chain, dtype=float)[burn_in:]
        flat = used.reshape(-1, used.shape[2])
        lower, median, upper = np.quantile(flat, _QUANTILES, axis=0)
        try:
            stats = need("arviz_stats.base", "convergence").array_stats
        except AstropolcalError:
            measures = {}
        else:
            measures = {
                "r_hat": stats.rhat,
                "ess_bulk": partial(stats.ess, method="bulk"),
                "ess_tail": partial(stats.ess, method="tail", prob=_TAIL),
            }
        columns = [np.ascontiguousarray(used[:, :, i].T) for i in range(used.shape[2])]
        statistics = {
            key: [np.nan if _is_flat(draws) else float(of(draws)) for draws in columns]
            for key, of in measures.items()
        }
        return cls(
            n_steps=len(chain) * thin,
            burn_in=burn_in * thin,
            n_draws=len(flat),
            times=autocorrelation_times(used) * thin,
            median=median,
            lower=lower,
            upper=upper,
            std=flat.std(axis=0, ddof=1),
            **statistics,
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
        """Return what is wrong, one sentence without a full stop each."""
        stuck = [name for name, time in zip(names, self.times, strict=True) if np.isnan(time)]
        if stuck:
            return [f"{', '.join(stuck)} did not move"]
        found = []
        if self.n_times < ENOUGH:
            needed = ENOUGH * self.times.max()
            # to two digits
            step = 10 ** max(int(np.floor(np.log10(needed))) - 1, 0)
            wanted = int(np.ceil(needed / step) * step)
            found.append(f"{ENOUGH} times are needed; run {wanted} steps or more")
        if self.r_hat is None:
            return found
        # what is not a number is the worst for numpy, too
        worst = np.argmax(self.r_hat)
        if not self.r_hat[worst] <= LARGEST_R_HAT:
            found.append(
                f"R-hat of {names[worst]} is {self.r_hat[worst]:.3f}, but {LARGEST_R_HAT} is the "
                "most for walkers that agree"
            )
        for kind, size in (("bulk", self.ess_bulk), ("tail", self.ess_tail)):
            worst = np.argmin(size)
            if not size[worst] >= FEWEST_SAMPLES:
                found.append(
                    f"{names[worst]} has an effective sample size ({kind}) of {size[worst]:.0f}, "
                    f"but {FEWEST_SAMPLES} are needed"
                )
        return found

    def agreement(self):
        """Return the largest R-hat and the smallest effective sample size in words, if known."""
        if self.r_hat is None or not np.isfinite(self.times).all():
            return ""
        size = min(self.ess_bulk.min(), self.ess_tail.min())
        return (
            f"R-hat is {self.r_hat.max():.3f} or less, the effective sample size "
            f"{size:.0f} or more."
        )


# ---- samples of a posterior: quantiles, covariance, and whether to believe them ----


#: Samples that a file keeps of each parameter, by default.
DRAWS = 4000
# steps left out at the start, in autocorrelation times
_BURN_IN = 5


class Posterior:
    """
    Samples of the posterior of calibrated parameters; ``sample`` makes it.

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
        How it was made: what was sampled, the noise, the priors.
    burn_in : int, optional
        Kept steps to leave out at the start, by default 5 autocorrelation
        times, at most half of all.
    convergence : Convergence, optional
        What the whole run says of itself, where the chain is a part of it after the burn-in.

    Raises
    ------
    ParameterError
        If the shapes differ, or the burn-in leaves less than two steps.

    Examples
    --------
    >>> from astropolcal.calibration.posterior import Posterior
    >>> import astropy.units as u
    >>> import numpy as np
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
        burn_in=None,
        convergence=None,
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
        self._burn_in, self._convergence = burn_in, convergence
        self._check()

    def _check(self):
        n = len(self.names)
        if self.chain.ndim != 3 or self.chain.shape[2] != n or len(self.units) != n:
            raise ParameterError(
                f"chain of {n} names and {len(self.units)} units has shape {self.chain.shape}; "
                "allowed is (n_steps, n_walkers, n_parameters)"
            )
        known = self._convergence and self._convergence.times
        for key, array, shape in (
            ("log_prob", self.log_prob, self.chain.shape[:2]),
            ("acceptance", self.acceptance, self.chain.shape[1:2]),
            ("fitted", self.fitted, (n,)),
            ("convergence", known, (n,)),
        ):
            if array is not None and array.shape != shape:
                raise ParameterError(
                    f"{key} has shape {array.shape}, not {shape} as the chain {self.chain.shape}"
                )
        most = len(self.chain) - 2
        if self._burn_in is not None and not 0 <= self._burn_in <= most:
            raise ParameterError(
                f"burn_in = {self._burn_in}; allowed are 0 to {most} of {len(self.chain)} kept "
                f"steps of {self.thin}"
            )

    def __repr__(self):
        steps, walkers, n = self.chain.shape
        return f"<Posterior of {n} parameters: {steps} steps of {walkers} walkers>"

    def __eq__(self, other):
        if not isinstance(other, Posterior):
            return NotImplemented
        return same_content(self.to_dict(), other.to_dict())

    __hash__ = None

    # ---- convergence -----------------------------------------------------------

    @property
    def is_thinned(self):
        """Whether the chain is a part of a run, its burn-in left out already."""
        return self._convergence is not None

    @cached_property
    def burn_in(self):
        """Kept steps left out at the start."""
        if self.is_thinned:
            return 0
        if self._burn_in is not None:
            return int(self._burn_in)
        half = len(self.chain) // 2
        # from the second half: the way from the start would look like a long memory
        times = autocorrelation_times(self.chain[half:])
        if not np.isfinite(times).any():
            return half
        # the slowest parameter decides
        return int(min(half, np.ceil(_BURN_IN * np.nanmax(times))))

    @property
    def steps(self):
        """Step of the sampler that each kept step is, counted from 1; shape (n_steps,)."""
        before = self._convergence.burn_in if self.is_thinned else 0
        return before + self.thin * np.arange(1, len(self.chain) + 1)

    @property
    def autocorrelation_times(self):
        """Integrated autocorrelation time of each parameter, in steps of the sampler."""
        return self.convergence.times

    @cached_property
    def convergence(self):
        """What the whole run says of itself and of each parameter, a ``Convergence``."""
        if self.is_thinned:
            return self._convergence
        return Convergence.of(self.chain, thin=self.thin, burn_in=self.burn_in)

    @property
    def n_steps(self):
        """Length of the run in steps of the sampler, burn-in included."""
        return self.convergence.n_steps

    @property
    def n_times(self):
        """Length of the run in the longest autocorrelation times, 0 where nothing moves."""
        return self.convergence.n_times

    @property
    def converged(self):
        """Whether to believe the samples.

        The run is longer than 50 of its longest autocorrelation times, R-hat
        is 1.05 or less, and the effective sample sizes are 400 or more; only
        the first where arviz-stats is not installed.
        """
        return self.convergence.converged

    @property
    def scatter(self):
        """By how much the scatter of the residuals makes errors larger, in words; "" if hardly."""
        return str(self.settings.get("scatter") or "")

    def words(self):
        """
        Return what the run says about itself.

        Returns
        -------
        str
            Length, autocorrelation, agreement of the walkers, acceptance; what
            to do if it has not converged; whether the samples are too narrow.
        """
        found, times = self.convergence, self.convergence.times
        what = "1 parameter" if times.size == 1 else f"{times.size} parameters"
        lines = [f"{self.n_steps} steps of {self.chain.shape[1]} walkers in {what}."]
        if np.isfinite(times).all():
            slowest = int(np.argmax(times))
            lines.append(
                f"The longest autocorrelation time is {times[slowest]:.0f} steps, of "
                f"{self.names[slowest]}; the chain is {int(self.n_times)} times as long."
            )
        lines += [line for line in (found.agreement(),) if line]
        lines += [f"NOT CONVERGED: {reason}." for reason in found.complaints(self.names)]
        if self.acceptance is not None:
            low, high = self.acceptance.min(), self.acceptance.max()
            lines.append(f"The walkers moved in {low:.0%} to {high:.0%} of the steps.")
        lines.append(f"The first {found.burn_in} steps are left out as burn-in.")
        lines += [f"TOO NARROW: {self.scatter}."] if self.scatter else []
        return "\n".join(lines)

    def kept_words(self):
        """
        Return how much of the run is in the chain.

        Returns
        -------
        str
        """
        if not self.is_thinned:
            return "All steps are kept."
        return (
            f"Of {self.convergence.n_draws} samples {self.log_prob.size} are kept, one step in "
            f"{self.thin}; convergence and quantiles are those of all."
        )

    # ---- numbers -----------------------------------------------------------------

    def samples(self, burn_in=None):
        """
        Return the samples of all walkers after the burn-in.

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
        # written so that NaN is refused, too
        if not np.all((np.asarray(q) >= 0) & (np.asarray(q) <= 1)):
            raise ParameterError(f"q = {q}; allowed are numbers from 0 to 1")
        value = np.quantile(self.chain[self.burn_in :, :, i], q)
        return value if self.units[i] is None else value * self.units[i]

    @property
    def covariance(self):
        """``Covariance`` of the samples; finite for undetermined parameters too, by the priors."""
        n = len(self.names)
        return Covariance(self.names, self.units, np.cov(self.samples().T).reshape(n, n))

    def summary(self):
        """
        Return one row per parameter, worked out from all samples after the burn-in.

        Returns
        -------
        `~astropy.table.QTable`
            ``name``, ``unit``, ``median``, 16 % quantile ``lower``, 84 % quantile ``upper``,
            ``std``, autocorrelation time ``tau`` in steps, rank-normalized split ``r_hat`` over the
            walkers, and effective sample sizes ``ess_bulk`` and ``ess_tail``.

        Raises
        ------
        AstropolcalError
            If arviz-stats is not installed, unless the posterior knows.
        """
        if self.convergence.r_hat is None:
            need("arviz_stats.base", "the summary of a posterior")
        columns = {"name": self.names, "unit": [str(unit or "") for unit in self.units]}
        keys = ("median", "lower", "upper", "std", "times", "r_hat", "ess_bulk", "ess_tail")
        columns |= {key: getattr(self.convergence, key) for key in keys}
        table = ParameterTable({"tau" if key == "times" else key: c for key, c in columns.items()})
        for key in table.colnames[2:]:
            table[key].info.format = ".5g" if key in ("median", "lower", "upper") else ".3g"
        return table

    def report(self):
        """
        Return a description of the posterior, ready for JSON.

        Returns
        -------
        dict
            ``converged``, ``words``, ``n_steps``, ``n_walkers``, ``burn_in`` (in steps),
            ``n_samples`` (after the burn-in), ``acceptance`` (least and largest), ``seed``,
            ``settings``, and for each of ``parameters`` its ``unit``, ``fitted`` value, ``median``,
            ``lower``, ``upper``, ``std``, ``autocorrelation_time``, ``r_hat``, ``ess_bulk`` and
            ``ess_tail``; not-a-number as None.
        """
        found = self.convergence
        columns = {"fitted": self.fitted, "autocorrelation_time": found.times}
        keys = ("median", "lower", "upper", "std", "r_hat", "ess_bulk", "ess_tail")
        columns |= {key: getattr(found, key) for key in keys}
        ends = None if self.acceptance is None else [self.acceptance.min(), self.acceptance.max()]
        content = {
            "converged": self.converged,
            "words": self.words(),
            "n_steps": self.n_steps,
            "n_walkers": self.chain.shape[1],
            "burn_in": found.burn_in,
            "n_samples": found.n_draws,
            "acceptance": ends,
            "seed": self.seed,
            "settings": dict(self.settings),
            "parameters": {
                name: {"unit": str(self.units[i] or "")}
                | {k: None if column is None else column[i] for k, column in columns.items()}
                for i, name in enumerate(self.names)
            },
        }
        return plain(content)

    # ---- files ----------------------------------------------------------------------

    def thinned(self, step=None, *, draws=DRAWS):
        """
        Return a posterior of fewer samples, as files keep it.

        The burn-in is left out. Convergence, and the quantiles that go with
        it, stay those of the whole run.

        Parameters
        ----------
        step : int, optional
            Which kept steps stay; by default the least that leaves no more
            than ``draws`` samples of each parameter.
        draws : int
            Number of samples, one step of all walkers at least.

        Returns
        -------
        Posterior

        Raises
        ------
        ParameterError
            If no step would be left.
        """
        start, walkers = self.burn_in, self.chain.shape[1]
        left = len(self.chain) - start
        if step is None:
            step = int(np.ceil(left / max(draws // walkers, 1)))
        if step < 1 or step > left:
            raise ParameterError(f"step = {step}; allowed are 1 to {left}")
        # the last of every `step` steps, which is the furthest from the start
        rows = slice(start + step - 1, None, step)
        parts = {"chain": self.chain[rows].copy(), "log_prob": self.log_prob[rows].copy()}
        parts |= {"thin": self.thin * step, "burn_in": None, "convergence": self.convergence}
        return Posterior(**(self._parts() | parts))

    def _parts(self):
        given = {"burn_in": self._burn_in, "convergence": self._convergence}
        return {key: given[key] if key in given else getattr(self, key) for key in _KEYS}

    def to_dict(self):
        """
        Return everything as arrays, lists and plain values.

        Returns
        -------
        dict
            Keys ``names, units, chain, log_prob, acceptance, fitted, thin,
            seed, settings, burn_in, convergence``; units as text, empty where
            there is none, convergence as a dictionary or None.
        """
        found = None if self._convergence is None else asdict(self._convergence)
        units = [str(unit or "") for unit in self.units]
        return self._parts() | {"units": units, "convergence": found}

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
        found = parts["convergence"]
        return cls(**(parts | {"convergence": None if found is None else Convergence(**found)}))


# all that makes a posterior
_KEYS = tuple(signature(Posterior).parameters)
