# Licensed under a 3-clause BSD style license - see LICENSE
"""
Prior knowledge of parameters, used by fits and samplers alike.

A prior sits in astropy's place for it, ``parameter.prior``: `Normal` or
``Uniform`` with units, or any frozen scipy distribution of the value in the
parameter's unit. For a fit a prior is one more datum, whose residual r obeys
``r**2 / 2 = -log density`` up to a constant; where the density is zero there
is a bound.
"""

from dataclasses import dataclass
from functools import cached_property

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.units import canonical_factor, to_unit

__all__ = ["Normal"]

# step of the numerical derivative of a general prior's residual, in its standard deviations
_STEP = 1e-5


@dataclass(frozen=True)
class Normal:
    """
    Normal prior.

    Parameters
    ----------
    mean, std : `~astropy.units.Quantity` or float
        In any unit that converts to the parameter's; one value per wavelength for a
        parameter that has one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.measurement import Normal
    >>> hwp = optics.TwoLayerWaveplate(mount="hwp", name="hwp", fixed={"theta": False})
    >>> hwp.theta.prior = Normal(0 * u.deg, 0.1 * u.deg)
    """

    mean: object
    std: object

    def frozen(self, unit, name):
        """Return the scipy distribution of the value in ``unit``."""
        from scipy.stats import norm

        mean, std = (_plain(to_unit(v, unit, f"prior of {name}")) for v in (self.mean, self.std))
        if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(std)) and np.all(std > 0)):
            raise ParameterError(f"prior of {name}: Normal({mean}, {std}) needs a positive std")
        return norm(mean, std)


@dataclass(frozen=True)
class Uniform:
    """Uniform prior: tighter bounds, in any unit that converts to that of the parameter."""

    low: object
    high: object

    def frozen(self, unit, name):
        """Return the scipy distribution of the value in ``unit``."""
        from scipy.stats import uniform

        low, high = (float(to_unit(v, unit, f"prior of {name}")) for v in (self.low, self.high))
        if not (np.isfinite(low) and np.isfinite(high) and high > low):
            raise ParameterError(f"prior of {name}: Uniform({low}, {high}) needs low below high")
        # scipy's uniform takes the start and the width
        return uniform(low, high - low)


@dataclass(frozen=True)
class BoundPrior:
    """
    A prior bound to a parameter, on canonical values.

    ``distribution`` is a frozen scipy distribution of the value in the declared unit, ``mode``
    where its density is largest, ``factor`` leads from the declared to the canonical unit.
    """

    name: str
    distribution: object
    factor: float
    mode: float

    @cached_property
    def _moments(self):
        """Mean and standard deviation; a frozen distribution works them out at every call."""
        return _plain(self.distribution.mean()), _plain(self.distribution.std())

    @cached_property
    def _support(self):
        low, high = self.distribution.support()
        return low * self.factor, high * self.factor

    @cached_property
    def _log_peak(self):
        return _plain(self.distribution.logpdf(self.mode))

    @property
    def is_flat(self):
        """Whether it only bounds, as a uniform prior does."""
        return self.distribution.dist.name == "uniform"

    @property
    def _is_normal(self):
        return self.distribution.dist.name == "norm"

    def canonical_support(self):
        """Return where the density is not zero, canonical."""
        return self._support

    def log_densities(self, canonical):
        """Return the log density per declared unit at each value."""
        canonical = np.asarray(canonical, dtype=float)
        value = canonical / self.factor
        if self._is_normal:
            mean, std = self._moments
            # scipy's logpdf checks its arguments at every call, which
            # a sampler makes a million times
            return self._log_peak - 0.5 * ((value - mean) / std) ** 2
        if self.is_flat:
            low, high = self._support
            inside = (canonical >= low) & (canonical <= high)
            return np.where(inside, self._log_peak, -np.inf)
        return self.distribution.logpdf(value)

    def log_density(self, canonical):
        """Return the log density per declared unit, summed over the values."""
        return float(np.sum(self.log_densities(canonical)))

    def residual(self, canonical):
        """Return signed residuals whose half square is minus the log density, less its least."""
        value = np.asarray(canonical, dtype=float) / self.factor
        if self._is_normal:
            mean, std = self._moments
            # signed, and without the square root below, whose slope jumps at the mode
            return (value - mean) / std
        # r = sign(x - mode) sqrt(2 (log p(mode) - log p(x))), so
        # that r^2 / 2 is minus the log density
        depth = self._log_peak - self.distribution.logpdf(value)
        return np.sign(value - self.mode) * np.sqrt(2 * np.maximum(depth, 0.0))

    def slope(self, canonical):
        """Return the derivative of `residual` per canonical unit."""
        canonical = np.asarray(canonical, dtype=float)
        std = self._moments[1] * self.factor
        if self._is_normal:
            return np.broadcast_to(1 / std, canonical.shape).copy()
        low, high = self._support
        # never beyond the support, where the density is zero and the residual infinite
        up = np.minimum(canonical + _STEP * std, high)
        down = np.maximum(canonical - _STEP * std, low)
        return (self.residual(up) - self.residual(down)) / (up - down)


def bind_prior(prior, name, unit, bounds):
    """Check a prior against name, unit and bounds of its parameter; return a BoundPrior."""
    distribution = prior.frozen(unit, name) if hasattr(prior, "frozen") else prior
    if not (hasattr(distribution, "logpdf") and hasattr(distribution, "support")):
        raise ParameterError(
            f"prior of {name} is a {type(prior).__name__}; allowed are Normal, Uniform and "
            "frozen continuous distributions of scipy.stats"
        )
    mode = _mode(distribution)
    low, high = (
        -np.inf if bounds[0] is None else bounds[0],
        np.inf if bounds[1] is None else bounds[1],
    )
    start, end = distribution.support()
    # a flat prior has no peak that would have to be inside
    inside = (low <= mode) & (mode <= high) | (distribution.dist.name == "uniform")
    if np.any(start >= high) or np.any(end <= low) or not np.all(inside):
        worst = mode if np.ndim(mode) == 0 else mode[np.argmin(inside)]
        start, end = np.min(start), np.max(end)
        raise ParameterError(
            f"prior of {name} peaks at {worst:g} on ({start:g}, {end:g}), outside the bounds "
            f"{low:g} to {high:g} {unit or ''}".rstrip()
        )
    return BoundPrior(name, distribution, canonical_factor(unit), mode)


def normal_per_wavelength(prior, unit):
    """
    Return a frozen normal distribution of several values as `Normal`, which files can hold.

    Any other prior comes back as it is.
    """
    name = getattr(getattr(prior, "dist", None), "name", None)
    if name != "norm" or np.ndim(prior.mean()) == 0:
        return prior
    unit = u.one if unit is None else unit
    mean, std = np.broadcast_arrays(prior.mean(), prior.std())
    return Normal(mean * unit, std * unit)


def _plain(value):
    """Return a float, or an array where there is one value per wavelength."""
    value = np.asarray(value, dtype=float)
    return value if value.ndim else float(value)


def _mode(distribution):
    """Return where the density peaks, by a search between far quantiles."""
    from scipy.optimize import minimize_scalar

    if distribution.dist.name in ("norm", "uniform"):
        return _plain(distribution.mean())
    # a search needs finite ends; a peak beyond them would be one in a millionth of the probability
    ends = distribution.ppf([1e-6, 1 - 1e-6])
    inside = minimize_scalar(
        lambda x: -distribution.logpdf(x),
        bounds=tuple(ends),
        method="bounded",
        options={"xatol": 1e-10 * (ends[1] - ends[0])},
    ).x
    # a density cut off at a bound (truncnorm) may peak there, where no search by derivative ends
    candidates = [inside, *(x for x in distribution.support() if np.isfinite(x))]
    return float(max(candidates, key=distribution.logpdf))
