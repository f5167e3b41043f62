# Licensed under a 3-clause BSD style license - see LICENSE
"""
Free parameters of one or several chains as one flat vector.

Chains name their parameters ``optic.parameter``; equal names in several chains are the same
parameter. A parameter with one value per wavelength becomes one number per wavelength of the common
grid. Ties are linear and are applied here, so that the Jacobian stays exact.

Prior knowledge of parameters, used by fits and samplers alike.

A prior sits in astropy's place for it, ``parameter.prior``: `Normal` or ``Uniform`` with units, or
any frozen scipy distribution of the value in the parameter's unit. For a fit a prior is one more
datum, whose residual r obeys ``r**2 / 2 = -log density`` up to a constant; where the density is
zero there is a bound.
"""

import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real

import astropy.units as u
import numpy as np

from astropolcal.chain import find_optic, join, leaves
from astropolcal.exceptions import ParameterError
from astropolcal.optics._modelling import FrozenNormal
from astropolcal.units import canonical_factor, to_unit
from astropolcal.words import check_choice, check_type, counted, did_you_mean

__all__ = ["Normal", "Tie", "parameter_table"]

# a parameter closer to its bound than this (canonical units) sits at it
_AT_BOUND = 1e-5
# ``optic.parameter[3]`` as an attribute
_AS_IDENTIFIER = str.maketrans(".[", "__", "]")
# share of a value, or of one, by which rounding alone may take it beyond a bound
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Tie:
    """
    A parameter that follows another: ``target = factor * source + offset``.

    Parameters
    ----------
    source : str
        Free parameter that leads, ``"optic.parameter"``.
    factor : float
        Factor between values in canonical units (radian, micrometre, 1), not 0.
    offset : `~astropy.units.Quantity` or float
        Constant part, in the target's unit.

    Raises
    ------
    ParameterError
        If the factor is not a finite number, or 0.

    Examples
    --------
    >>> from astropolcal.measurement import Tie
    >>> Tie("hwp.theta", factor=2.0).factor
    2.0
    """

    source: str
    factor: float = 1.0
    offset: object = 0.0

    def __post_init__(self):
        if not (isinstance(self.factor, Real) and np.isfinite(self.factor) and self.factor):
            raise ParameterError(
                f"tie to {self.source}: factor = {self.factor!r}; allowed are finite numbers but 0"
            )


@dataclass(frozen=True)
class Slot:
    """
    Where a named parameter lives in the flat vector.

    Its first element and number of elements, which is more than one for a parameter with one value
    per wavelength; bounds in ``unit``, None where open.
    """

    name: str
    unit: object
    start: int
    size: int
    bounds: tuple

    @property
    def slice(self):
        """The elements of the flat vector."""
        return slice(self.start, self.start + self.size)

    @property
    def factor(self):
        """Factor from ``unit`` to the canonical unit."""
        return canonical_factor(self.unit)

    @property
    def per_wavelength(self):
        """Whether there is one value per wavelength."""
        return self.size > 1

    def canonical_bounds(self):
        """Return lower and upper bound as canonical floats, infinite where open."""
        low, high = limits(self.bounds)
        return low * self.factor, high * self.factor


def step_of(unit):
    """Return the step of a parameter in canonical units, its size and its unit in words."""
    if unit is None:
        return 0.01, 0.01, ""
    if u.Unit(unit).is_equivalent(u.rad):
        # canonical is radian: one degree is the step that a user has a feeling for
        return np.deg2rad(1.0), 1.0, " deg"
    if not u.Unit(unit).is_equivalent(u.um):
        # a coefficient of a law, such as one in deg / day
        return canonical_factor(unit), 1.0, f" {unit}"
    return 1.0, 1.0, " um"


def declared_step(unit):
    """Return the step of a parameter in its declared unit, such as 3600 for one in arcsec."""
    return step_of(unit)[0] / canonical_factor(unit)


def element_names(name, size):
    """Return readable names of the elements of a parameter, such as ``derotator.horizontal[3]``."""
    return [name] if size == 1 else [f"{name}[{i}]" for i in range(size)]


def stem(name):
    """Return the parameter, ``"optic.parameter"``, of an element."""
    return name.partition("[")[0]


def optic(name):
    """Return the optic of a parameter, or of an element."""
    return name.partition(".")[0]


def is_of(name, wanted):
    """Return whether an element is of one of some parameters or optics."""
    return stem(name) in wanted or optic(name) in wanted


def limits(bounds):
    """Return the bounds of a parameter as two numbers, infinite where open."""
    low, high = bounds
    return -np.inf if low is None else low, np.inf if high is None else high


def parameter_table(chains):
    """
    Return every parameter of the chains by name, with the optics that carry it.

    Parameters
    ----------
    chains : sequence
        Chains whose optics have names.

    Returns
    -------
    dict of str to list of `~astropy.modeling.Parameter`
        ``"optic.parameter"`` to its parameter objects, one per chain that has it.

    Raises
    ------
    ParameterError
        If an optic with parameters has no name, or one with a dot or a bracket, or optics of one
        name differ.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.measurement import parameter_table
    >>> list(parameter_table([optics.WollastonPrism(name="wollaston")]))
    ['wollaston.theta', 'wollaston.efficiency']
    """
    table = {}
    kinds = {}
    for chain in chains:
        for leaf in leaves(chain):
            if not leaf.name:
                raise ParameterError(f"{type(leaf).__name__} needs a name to be calibrated")
            # elements are called optic.parameter[index]
            if set(".[]") & set(leaf.name):
                raise ParameterError(
                    f"optic {leaf.name!r} needs a name without dot and brackets to be calibrated, "
                    f"such as {re.sub(r'[][.]+', '_', leaf.name).strip('_') or 'optic'!r}"
                )
            # one name is one piece of glass: it cannot be a mirror for
            # one dataset and a plate for another
            if kinds.setdefault(leaf.name, type(leaf)) is not type(leaf):
                raise ParameterError(
                    f"optic {leaf.name!r} is a {kinds[leaf.name].__name__} in one dataset and a "
                    f"{type(leaf).__name__} in another; give them different names"
                )
            for key in leaf.param_names:
                table.setdefault(f"{leaf.name}.{key}", []).append(getattr(leaf, key))
    return table


def are_outside(values, low, high):
    """Return which values are beyond their bounds by more than rounding."""
    slack = _ROUNDING * np.maximum(1.0, np.abs(values))
    # written so that NaN is outside
    return ~((values >= low - slack) & (values <= high + slack))


def parameters_named(chains, name, label=""):
    """
    Return by name the parameters that ``"optic.parameter"`` names, or ``"optic"`` alone, all of it.

    A ``label`` is of an option that gives a value, which only a single parameter can have.
    """
    optic, _, key = name.partition(".")
    # optics of one name are one optic to the fit, so that all get the same
    table = parameter_table(chains)
    own = {each: table[each] for each in table if each.partition(".")[0] == optic}
    if not own:
        find_optic(chains[0], optic)
    found = {each: own[each] for each in own if not key or each == name}
    if not found:
        keys = [each.partition(".")[2] for each in own]
        hint = did_you_mean(key, keys)
        raise ParameterError(f"{optic} has no parameter {key!r}; it has {', '.join(keys)}{hint}")
    if label and len(found) > 1:
        known = ", ".join(found)
        raise ParameterError(f"{label}: name the parameter that has this value, of {known}")
    return found


def with_own(chains, names, own, ties=None):
    """
    Return copies of chains in which parameters have a value of their own in each group of datasets.

    ``own`` are names of parameters, or these with the group of each dataset, by default its name.
    An optic is called as before in the first group, and with the name of its group after its own in
    the others, where what is shared is tied. Those ties are returned too, and of each parameter the
    names that it has in the groups.
    """
    names = names if len(set(names)) == len(names) else range(1, len(names) + 1)
    if not isinstance(own, Mapping):
        own = dict.fromkeys([own] if isinstance(own, str) else own, names)
    table, ties, optics = parameter_table(chains), checked_ties(ties), {}
    for name, groups in own.items():
        groups = list(map(str, groups))
        check_choice("own", name, table, ParameterError)
        if len(groups) != len(chains):
            given, needed = counted(len(groups), "group"), counted(len(chains), "dataset")
            raise ParameterError(f"own: {name} has {given} for {needed}; give a name for each")
        if table[name][0].fixed:
            raise ParameterError(f"own: {name} is fixed; what has several values has to be free")
        if name in ties or any(tie.source == name for tie in ties.values()):
            raise ParameterError(f"own: {name} is part of a tie; allowed are those that are not")
        optic, key = name.split(".")
        optics.setdefault(optic, {})[key] = groups
    trains, copies = [leaves(chain.copy()) for chain in chains], {}
    for optic, keys in optics.items():
        called, first = {}, {}
        for i, train in enumerate(trains):
            for leaf in (leaf for leaf in train if leaf.name == optic):
                mine = {key: groups[i] for key, groups in keys.items()}
                mark = tuple(dict.fromkeys(mine.values()))
                label = re.sub(r"\W", "_", "_".join((optic, *mark))) if called else optic
                leaf.name = called.setdefault(mark, label)
                for key in leaf.param_names:
                    # the first dataset of a group leads the others
                    lead = first.setdefault((key, mine.get(key)), f"{leaf.name}.{key}")
                    if lead != f"{leaf.name}.{key}" and not getattr(leaf, key).fixed:
                        ties[f"{leaf.name}.{key}"] = ties.get(f"{optic}.{key}", Tie(lead))
        copies |= {f"{optic}.{k}": [x for (o, _), x in first.items() if o == k] for k in keys}
    return [join(train) for train in trains], ties, copies


def checked_ties(ties):
    """Return ties as a dictionary, refused where something else is among them."""
    ties = dict(ties or {})
    for name, tie in ties.items():
        check_type(f"ties: what {name} follows", tie, Tie, "a Tie is needed", ParameterError)
    return ties


def ties_among(ties, names):
    """Return the ties of which both ends are among some parameters."""
    return {name: tie for name, tie in ties.items() if {name, tie.source} <= set(names)}


class FreeParameters:
    """The free parameters of chains that share optics by name, one chain per dataset.

    Refused are shapes that do not fit the common grid of ``n_wavelengths``, parameters that are
    free in one chain and fixed in another, ties that are circular or unknown, and astropy's
    callable ``tied``, which corrupts analytic Jacobians.
    """

    def __init__(self, chains, n_wavelengths, ties=None):
        self.ties = checked_ties(ties)
        self._table = parameter_table(chains)
        for parameter in (p for parameters in self._table.values() for p in parameters):
            # as `Normal`, which an ASDF file can hold where scipy's frozen distribution cannot
            if parameter.prior is not None:
                parameter.prior = normal_per_wavelength(parameter.prior, parameter.unit)
        for name, tie in self.ties.items():
            for wanted in (name, tie.source):
                if wanted not in self._table:
                    raise ParameterError(f"tie {name} -> {tie.source}: no parameter {wanted!r}")
            if tie.source in self.ties:
                raise ParameterError(f"tie {name} -> {tie.source}: the source is itself tied")
        self.slots = []
        self.size = 0
        for name, parameters in self._table.items():
            self._check(name, parameters, n_wavelengths)
            if not parameters[0].fixed and name not in self.ties:
                first = parameters[0]
                size = int(np.size(first.value))
                self.slots.append(Slot(name, first.unit, self.size, size, tuple(first.bounds)))
                self.size += size
        self.by_name = {slot.name: slot for slot in self.slots}
        #: Priors of free parameters, with the slot each belongs to.
        self.priors = [
            (slot, bind_prior(prior, slot.name, slot.unit, slot.bounds))
            for slot in self.slots
            if (prior := self._table[slot.name][0].prior) is not None
        ]
        for slot, prior in self.priors:
            size = np.size(prior.mode)
            if size not in (1, slot.size):
                raise ParameterError(
                    f"prior of {slot.name} has {size} values; allowed are 1 or {slot.size}"
                )
        # slot, factor and offset (canonical) of what is tied
        self._followers = {}
        for name, tie in self.ties.items():
            source, target = self.by_name.get(tie.source), self._table[name][0]
            if source is None:
                raise ParameterError(f"tie {name} -> {tie.source}: {tie.source} is not free")
            if np.size(target.value) != source.size:
                raise ParameterError(f"tie {name} -> {tie.source}: the shapes differ")
            unit, offset = target.unit, tie.offset
            if np.isscalar(offset) and offset == 0:
                offset = 0.0 * (unit or u.one)
            offset = to_unit(offset, unit, f"offset of {name}") * canonical_factor(unit)
            if offset.size not in (1, source.size) or not np.isfinite(offset).all():
                raise ParameterError(
                    f"tie {name} -> {tie.source}: offset = {tie.offset}; allowed are 1 or "
                    f"{source.size} finite values"
                )
            self._followers[name] = source, float(tie.factor), offset
        self._bounds = self._limits()

    def of_chains(self, chains):
        """Return the same parameters, bound to copies of the chains."""
        new = copy.copy(self)
        new._table = parameter_table(chains)
        return new

    @staticmethod
    def _check(name, parameters, n_wavelengths):
        first = parameters[0]
        if first.tied:
            raise ParameterError(
                f"{name} has a callable tie, which makes analytic Jacobians silently wrong; "
                "pass ties={...: Tie(...)} instead"
            )
        # also of what is fixed: an array of another length would be broadcast silently
        size = np.size(first.value)
        if size not in (1, n_wavelengths):
            raise ParameterError(
                f"{name} has {size} values; allowed are 1 or {n_wavelengths}, one per wavelength"
            )
        if any(np.size(p.value) != size or p.fixed != first.fixed for p in parameters[1:]):
            raise ParameterError(f"{name} differs between datasets in shape or in being fixed")
        # those of the first dataset count, and what another says would be lost
        for what, told in (("bounds", limits), ("prior", told_prior)) if not first.fixed else ():
            if any(told(getattr(p, what)) != told(getattr(first, what)) for p in parameters[1:]):
                raise ParameterError(
                    f"{name} differs between datasets in its {what}; give all chains the same"
                )

    @property
    def labels(self):
        """Identifiers of the elements of the flat vector, fit for attribute access."""
        return [name.translate(_AS_IDENTIFIER) for name in self.names]

    @property
    def names(self):
        """Readable names of the elements, such as ``derotator.horizontal[3]``."""
        return [name for slot in self.slots for name in element_names(slot.name, slot.size)]

    @property
    def units(self):
        """Declared units of the elements, None for what has none."""
        return [slot.unit for slot in self.slots for _ in range(slot.size)]

    def start(self):
        """Return the current values of the chains as one vector."""
        vector = np.empty(self.size)
        for slot in self.slots:
            vector[slot.slice] = np.ravel(self._table[slot.name][0].value) * slot.factor
        for slot, prior in self.priors:
            # a value that the prior excludes starts at the prior's mode
            low, high = prior.support
            here = vector[slot.slice]
            # a fitter with bounds refuses a start outside of them
            excluded = (here < low) | (here > high)
            vector[slot.slice] = np.where(excluded, prior.mode * slot.factor, here)
        return vector

    def bounds(self):
        """Return lower and upper bounds, shape (2, n_free)."""
        return self._bounds.copy()

    def at_bounds(self, vector):
        """Return which elements of a vector sit at a bound, or beyond it; shape (n_free,)."""
        low, high = self._bounds
        # fitters stop just inside of a bound; relative above one, as a retardance of 2 pi is
        near = _AT_BOUND * np.maximum(1.0, np.abs(vector))
        return (vector - low < near) | (high - vector < near)

    def _limits(self):
        pairs = [slot.canonical_bounds() for slot in self.slots for _ in range(slot.size)]
        low, high = both = np.array(pairs, dtype=float).reshape(-1, 2).T.copy()
        for slot, prior in self.priors:
            start, end = prior.support
            # where the density is zero there is a bound, whichever is tighter
            low[slot.slice] = np.maximum(low[slot.slice], start)
            high[slot.slice] = np.minimum(high[slot.slice], end)
        return both

    def check_priors(self):
        """Refuse a prior of what is tied, unless it is that of what leads and says the same."""
        for name, (slot, factor, offset) in self._followers.items():
            own, lead = (told_prior(self._table[key][0].prior) for key in (name, slot.name))
            if own != told_prior(None) and (own != lead or factor != 1 or offset.any()):
                raise ParameterError(
                    f"{name} is tied to {slot.name}, and its own prior would be lost; give the "
                    f"prior to {slot.name}, or set that of {name} to None"
                )

    def factors(self):
        """Return the factor from declared to canonical unit of every element."""
        return self.spread([slot.factor for slot in self.slots])

    @property
    def steps(self):
        """One degree, micrometre or percent of each element, canonical."""
        return self.spread([step_of(slot.unit)[0] for slot in self.slots])

    def spread(self, values):
        """Return a value of each slot for all of its elements, shape (n_free,)."""
        return np.repeat(values, [slot.size for slot in self.slots])

    def prior_residuals(self, vector):
        """Return the residuals of the priors that are not flat, one an element of theirs."""
        parts = [p.residual(vector[slot.slice]) for slot, p in self.priors if not p.is_flat]
        return np.concatenate(parts) if parts else np.empty(0)

    def prior_jacobian(self, vector, for_errors=False):
        """Return the derivative of `prior_residuals`, shape (n_free, n_residuals).

        ``for_errors`` no prior tells more than its own width, as at a cusp it seems to.
        """
        parts = []
        for slot, prior in self.priors:
            if not prior.is_flat:
                block = np.zeros((self.size, slot.size))
                # a prior looks at each element alone, so the block is
                # diagonal, (slot.size, slot.size)
                slope = prior.slope(vector[slot.slice])
                most = 1 / prior.width if for_errors else np.inf
                np.fill_diagonal(block[slot.slice], np.clip(slope, -most, most))
                parts.append(block)
        return np.concatenate(parts, axis=1) if parts else np.empty((self.size, 0))

    def lookup(self, name):
        """
        Return slot, factor and offset of a parameter, ``value = factor * vector[slot] + offset``.

        The slot of a fixed parameter is None.
        """
        # free itself: the value is the element of the vector
        if name in self.by_name:
            return self.by_name[name], 1.0, 0.0
        return self._followers.get(name, (None, 0.0, 0.0))

    def values_of(self, name):
        """Return the current value of a parameter, a Quantity where it has a unit."""
        parameter = self._table[name][0]
        value = np.array(parameter.value)
        return value if parameter.unit is None else value * parameter.unit

    def put_back(self, vector):
        """Write the values of the flat vector into the chains' parameters."""
        for name, parameters in self._table.items():
            slot, factor, offset = self.lookup(name)
            if slot is None:
                continue
            # linear in canonical units, so that the Jacobian of a
            # follower is `factor` times the source's
            canonical = factor * np.asarray(vector)[slot.slice] + offset
            for parameter in parameters:
                value = canonical / canonical_factor(parameter.unit)
                parameter.value = value.reshape(np.shape(parameter.value))

    def put_stds(self, stds):
        """Write standard deviations, in the units of the parameters, into the chains; or None."""
        for slot in self.slots:
            own = stds[slot.slice]
            several = None if None in own else np.array(own, dtype=float)
            for parameter in self._table[slot.name]:
                parameter.std = several if several is None or slot.size > 1 else float(several[0])

    def check_data(self, wavelength):
        """Refuse parameters of other wavelengths (um) than the data, or held at several values."""
        for name, parameters in self._table.items():
            others = parameters[1:] if parameters[0].fixed else ()
            if any(np.any(np.abs(p.value - parameters[0].value) > _ROUNDING) for p in others):
                raise ParameterError(
                    f"{name} is fixed and differs between datasets in its value; give all chains "
                    "the same, or the optics different names"
                )
            for parameter in parameters:
                grid = parameter.grid
                if grid is not None and not (
                    grid.shape == wavelength.shape and np.allclose(grid, wavelength, rtol=1e-3)
                ):
                    raise ParameterError(
                        f"{name} has values at {grid.size} wavelengths from {grid[0]:g} to "
                        f"{grid[-1]:g} um, which are not the {wavelength.size} of the data; "
                        "optic.resampled(wavelength) interpolates them"
                    )

    def put_wavelengths(self, wavelength):
        """Tell parameters with one value per wavelength (um) which these are."""
        for parameters in self._table.values():
            for parameter in parameters:
                if parameter.shape == wavelength.shape and parameter.grid is None:
                    parameter.wavelength = wavelength * u.um


# ---- priors --------------------------------------------------------------------------------


# step of the numerical derivative of a general prior's residual, in its widths
_STEP = 1e-5
# quantiles of a normal distribution one standard deviation below and above its mean
_CENTRAL = (0.158655, 0.841345)


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
        mean, std = (_plain(to_unit(v, unit, f"prior of {name}")) for v in (self.mean, self.std))
        if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(std)) and np.all(std > 0)):
            raise ParameterError(f"prior of {name}: Normal({mean}, {std}) needs a positive std")
        return FrozenNormal(mean, std)


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

    distribution: object
    factor: float
    mode: float

    @cached_property
    def _moments(self):
        """Mean and standard deviation; a frozen distribution works them out at every call."""
        return _plain(self.distribution.mean()), _plain(self.distribution.std())

    @cached_property
    def width(self):
        """Half of what holds 68.27 % of the probability, canonical; a variance may be infinite."""
        if self._is_normal:
            return self._moments[1] * self.factor
        low, high = self.distribution.ppf(_CENTRAL)
        return (high - low) / 2 * self.factor

    @cached_property
    def support(self):
        """Where the density is not zero, canonical."""
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

    def log_densities(self, canonical):
        """Return the log density per declared unit at each value."""
        canonical = np.asarray(canonical, dtype=float)
        if self._is_normal:
            return self._log_peak - 0.5 * self.residual(canonical) ** 2
        if self.is_flat:
            # canonical, as bounds are: the edges in the declared unit may lie beyond by rounding
            low, high = self.support
            inside = (canonical >= low) & (canonical <= high)
            return np.where(inside, self._log_peak, -np.inf)
        return self.distribution.logpdf(canonical / self.factor)

    def residual(self, canonical):
        """Return signed residuals whose half square is minus the log density, less its least."""
        value = np.asarray(canonical, dtype=float) / self.factor
        if self._is_normal:
            mean, std = self._moments
            # without the square root below, whose slope jumps at the mode, and without scipy, which
            # checks its arguments at every one of a sampler's million calls
            return (value - mean) / std
        # r = sign(x - mode) sqrt(2 (log p(mode) - log p(x))), so
        # that r^2 / 2 is minus the log density
        depth = self._log_peak - self.distribution.logpdf(value)
        return np.sign(value - self.mode) * np.sqrt(2 * np.maximum(depth, 0.0))

    def slope(self, canonical):
        """Return the derivative of `residual` per canonical unit."""
        canonical = np.asarray(canonical, dtype=float)
        if self._is_normal:
            return np.broadcast_to(1 / self.width, canonical.shape).copy()
        low, high = self.support
        # never beyond the support, where the density is zero and the residual infinite
        up = np.minimum(canonical + _STEP * self.width, high)
        down = np.maximum(canonical - _STEP * self.width, low)
        return (self.residual(up) - self.residual(down)) / (up - down)


def told_prior(prior):
    """Return what a prior says, as text; scipy's frozen ones know no equality."""
    return repr((prior.dist.name, prior.args, prior.kwds) if hasattr(prior, "dist") else prior)


def bind_prior(prior, name, unit, bounds):
    """Check a prior against name, unit and bounds of its parameter; return a BoundPrior."""
    distribution = prior.frozen(unit, name) if isinstance(prior, (Normal, Uniform)) else prior
    if not (hasattr(distribution, "logpdf") and hasattr(distribution, "support")):
        raise ParameterError(
            f"prior of {name} is a {type(prior).__name__}; allowed are Normal, Uniform and "
            "frozen continuous distributions of scipy.stats"
        )
    if np.isnan(distribution.support()).any():
        given = [*map(str, distribution.args), *(f"{k}={v}" for k, v in distribution.kwds.items())]
        raise ParameterError(
            f"prior of {name}: {distribution.dist.name}({', '.join(given)}) is not a distribution"
        )
    mode = _mode(distribution)
    low, high = limits(bounds)
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
    return BoundPrior(distribution, canonical_factor(unit), mode)


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
    if distribution.dist.name in ("norm", "uniform"):
        return _plain(distribution.mean())
    from scipy.optimize import minimize_scalar

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
