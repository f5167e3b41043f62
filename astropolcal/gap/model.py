# Licensed under a 3-clause BSD style license - see LICENSE
"""The nominal model with effects added to it, step by step."""

import warnings
from copy import copy as copied
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace

import astropy.units as u
import numpy as np

from astropolcal.calibration.fit.branches import BinProblem, search_branches
from astropolcal.calibration.fit.calibrate import FittedMeasurement, fitted
from astropolcal.calibration.fit.strategies import few_frames
from astropolcal.calibration.noise.weighting import first_weighting
from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.chain import join, leaves
from astropolcal.exceptions import AstropolcalWarning, GapError
from astropolcal.gap.attribution import log_factor
from astropolcal.gap.cells import FINITE
from astropolcal.gap.effects import Context
from astropolcal.gap.problem import Fit, GapProblem
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.mueller import is_physical
from astropolcal.optics import LinearRetarder, Perturbation, Rotator

__all__ = []

_ROUNDS, _MORE = 3, 3
# correlations of neighbours above so many standard errors are real
_CORRELATED = 3.0
# standard deviations below which 95 % are
_ONE_SIDED = 1.645
# a fit whose last round lowered chi-square by less than this share is used, and said not to have
# converged
_FLAT = 0.02
# a size so near to its limit, in units of that, is at it; the share of the wavelengths at
# which the data may leave a size there
_AT_LIMIT = 1e-6
_MOST_PRESSED = 0.1
# share by which optics may seem to measure more polarization than there is
_MORE_LIGHT = 1e-3
# a fit left a retardance at half a wave if it did so at more than this share of the wavelengths
_SHOWS = 0.5
# a fit is repeated so often with the fluxes that the one before expects, and counts if chi-square
# is below so many times the number of data
_FLUXES, _DESCRIBES = 3, 1.5
# keeps directions that are open, of columns of unit length
_HELD = 1e-10
# so often causes are fitted with their parts as large as the largest of them, as long as this
# falls below such a share
_SHRINKS, _SMALLER = 10, 0.9
# a retardance as near to half a wave as this (radian) is at it
_HALF_WAVE = 1e-3
# a second difference above this share of the first one is tried at finite size
_BENT = 1.0


@dataclass
class Model:
    """Chains, what has been added to them, and their fit in both channels."""

    problem: GapProblem
    fit: object
    #: Effects in the chains, with the parameters that they added.
    added: dict = field(default_factory=dict)
    #: The fit of a calibration that was made for it, None where it began with another one.
    calibration: FittedMeasurement | None = None
    #: Chains with the values from which a nominal model was fitted, None of others.
    start: list | None = None

    @property
    def chains(self):
        """The chains, with the fitted values in them."""
        return [join(leaves(train)) for train in self.trains]

    @property
    def trains(self):
        """The optics of the chains, not joined, with the fitted values in them."""
        measurement = self.problem.measurement
        return measurement.put_back(self.problem.vector(self.fit.coefficients))

    @cached_property
    def held_chains(self):
        """Copies of the optics of the chains with every parameter fixed."""
        held = [train.copy() for train in self.trains]
        for leaf in (leaf for train in held for leaf in leaves(train)):
            for key in leaf.param_names:
                getattr(leaf, key).fixed = True
        return held

    @property
    def observations(self):
        """The datasets."""
        return [dataset.observations for dataset in self.problem.datasets]

    @property
    def residual(self):
        """Whitened residuals, shape (n_rows,)."""
        return self.problem.residual(self.fit.coefficients)

    @property
    def context(self):
        """What an effect may know of the data."""
        return Context.of(self.problem.wavelength, self.observations)

    def of_dataset(self, i):
        """Return the model of one of the datasets by itself, fitted with the same noise."""
        mine = self.problem
        own = {key: [getattr(mine, key)[i]] for key in ("fluxes", "flickering", "channels")}
        shared = {"known": mine.known, "wavelength": mine.wavelength}
        noise = SimpleNamespace(**own, **shared, waves=None)
        problem = GapProblem([self.trains[i]], [self.observations[i]], ties=mine.ties, like=noise)
        return Model(problem, problem.fit(problem.start))

    @property
    def mean_square(self):
        """Mean square of the whitened residuals: 1 where noise is all that is left."""
        return self.fit.chi2 / max(self.problem.n_data - self.problem.size, 1)

    @property
    def excess(self):
        """Excess of chi-square over that of noise: what a gap and its shares are measured by."""
        return self.fit.chi2 - self.linear.freedom

    @cached_property
    def p_value(self):
        """Probability of the residuals by noise alone."""
        return float(chi2_above(self.fit.chi2, self.linear.freedom))

    @cached_property
    def alike(self):
        """
        How many neighbouring wavelengths have the same residuals, 1 if they are independent.

        Noise that is correlated from one wavelength to the next repeats itself so often (as an
        autoregressive process of first order): evidence counts it as data each time.
        """
        both, each, count = 0.0, 0.0, 1
        for channel, rows in zip(self.problem.channels, self.problem.segments, strict=True):
            left = self.residual[rows].reshape(channel.shape)[channel.told]
            both += np.sum(left[1:] * left[:-1])
            each += np.sum(left**2)
            count += left.size
        same = float(both / max(each, 1e-300))
        return (1 + same) / (1 - same) if same > _CORRELATED / np.sqrt(count) else 1.0

    def unsteadiness(self, name):
        """Return by what the variance of an effect's size exceeds that of noise, and its error.

        As the frames pull at it (White 1980, doi:10.2307/1912934): noise that is correlated, has
        heavy tails or is larger in some frames or at some wavelengths gives more than 1.
        """
        seen, pulls = self.without([name]).residual - self.linear.residual, []
        for channel, rows in zip(self.problem.channels, self.problem.segments, strict=True):
            shown, left = (part[rows].reshape(channel.shape) for part in (seen, self.residual))
            pulls.append([np.sum(shown * part, axis=(0, 1)) for part in (shown, left)])
        own, pull = np.concatenate(pulls, axis=1)
        # so many frames of equal weight would tell as much
        count = max(own.sum() ** 2 / max(np.sum(own**2), 1e-300), 1.5)
        found = np.sum(pull**2) / max(own.sum(), 1e-300) * count / (count - 1)
        found *= self.problem.n_data / max(self.linear.freedom, 1) / max(self.mean_square, 1.0)
        return float(found), float(np.sqrt(2 / count))

    def could_hide(self):
        """Return the excess of chi-square that the residuals do not exclude (95 %)."""
        freedom, spread = self.linear.freedom, 2 * self.alike * _ONE_SIDED**2
        excess = max(self.excess, 0.0)
        # noncentral chi-square, which is nearly normal: (x - excess)^2 = spread (freedom + 2 x)
        return float(excess + spread + np.sqrt(spread * (2 * excess + spread + freedom)))

    def hidden_share(self, base):
        """Return the share that this may be of a gap, which ``base`` shows without the causes."""
        hidden = self.could_hide()
        return hidden / (hidden + max(base.fit.chi2 - self.fit.chi2, 0.0))

    @cached_property
    def linear(self):
        """The model with all of its effects, to first order."""
        return self._linear(())

    def edited(self, *recipes):
        """
        Return the model with effects, each with its context, at zero and not fitted.

        A context of None is that of the data. An effect that has no place without another that is
        not among them is left out; where nothing was added it is the model itself.
        """
        mine, trains, edits = self.problem, self.trains, {}
        for effect, context in recipes:
            if effect.applies(trains):
                edits[effect.name] = effect.edit(trains, context or self.context)
                trains = edits[effect.name].chains
        if not edits:
            return self
        settings = {}
        for key in ("ties", "laws", "priors", "neutral", "limits"):
            settings[key] = dict(getattr(mine, key))
            for edit in edits.values():
                settings[key] |= getattr(edit, key)
        added = {name: edit.parameters for name, edit in edits.items()}
        problem = GapProblem(trains, self.observations, like=mine, **settings)
        return Model(problem, Fit(problem.start, np.inf, False), self.added | added)

    def with_effect(self, effect, context=None, **settings):
        """Return the model with one effect, see `with_effects`."""
        return self.with_effects([(effect, context)], **settings)

    def with_effects(self, effects, like=None, **settings):
        """
        Return the model with several effects added, each with its context, and fitted once.

        A context of None is that of the data. An effect that has no place without another that is
        not among them is left out.
        """
        # not fitted in between: one fit at the end is enough
        model = self.edited(*effects)
        if model is self:
            return self
        if like is not None:
            start = like.start_of(model.problem)
            found = Model(model.problem, start, model.added)._off_extrema().polished(**settings)
            # where it has an effect less it may end in another branch, above the model without any
            if found.fit.chi2 <= self.fit.chi2 or settings.get("steps") == 0:
                return found
        other = model._off_extrema().polished(**settings)
        return other if like is None or other.fit.chi2 < found.fit.chi2 else found

    def _off_extrema(self):
        """Return the model with the effects moved whose derivative vanishes where they start."""
        start = self.fit.coefficients
        for parameters in self.added.values():
            # a finite size may be too large, but a fit gets down from there
            others = off_extremum(self.problem, start, parameters)
            start = min(others, key=lambda q: np.sum(self.problem.residual(q) ** 2))
        moved = start is not self.fit.coefficients
        return Model(self.problem, Fit(start, np.inf, False), self.added) if moved else self

    def off_half_waves(self):
        """Return the model with retardances moved that its fit left at half a wave, None of none.

        Another retarder does nothing there to first order.
        """
        vector = self.problem.vector(self.fit.coefficients).copy()
        before = vector.copy()
        for slot in self.problem.free.slots:
            pressed = np.abs(np.sin(vector[slot.slice])) < _HALF_WAVE
            if slot.name.endswith(".retardance") and pressed.mean() > _SHOWS:
                vector[slot.slice] += pressed * FINITE
        start = Fit(self.problem.coefficients(vector), np.inf, False)
        return Model(self.problem, start, self.added) if np.any(vector != before) else None

    def without(self, names):
        """Return the model without some of its effects, to first order."""
        return self._linear(names) if names else self.linear

    def _linear(self, names):
        problem, q, jacobian = self.problem, self.fit.coefficients, self.jacobian
        out = problem.numbers(p.name for name in names for p in self.added[name])
        kept = ~np.isin(np.arange(problem.size), out)
        residual = self.residual + jacobian[:, out] @ (q - problem.absent)[out]
        # what is known beforehand is one more row of data for each of these parameters
        known = np.flatnonzero(kept & (problem.tight > 0))
        table, target = jacobian, residual
        if known.size:
            table = np.concatenate([jacobian, np.diag(problem.tight)[known]])
            target = np.concatenate([residual, -(q - problem.centre)[known] * problem.tight[known]])
        tangent = problem.tangent(q, table, kept)
        left = target - tangent @ (tangent.T @ target)
        return Linear(self, tangent[: problem.n_rows], left[: problem.n_rows])

    @cached_property
    def jacobian(self):
        """Derivative of the rows to the coefficients, (n_rows, n_coefficients)."""
        return self.problem.jacobian(self.fit.coefficients)

    @cached_property
    def decomposed(self):
        """What data and priors determine of the coefficients, as `GapProblem.decomposed`."""
        return self.problem.decomposed(self.fit.coefficients, self.jacobian)

    @cached_property
    def _spectra(self):
        """Return what the data say of each effect at the fit, by name, for `costs`.

        Eigenvalues of its normal equations beside the nominal model and the effects before it, and
        by how much chi-square rises along their vectors without it, in units of the usual size.
        """
        problem, q, scale = self.problem, self.fit.coefficients, np.ones(self.problem.size)
        own = {name: problem.numbers(p.name for p in added) for name, added in self.added.items()}
        for one in (parameter for added in self.added.values() for parameter in added):
            scale[problem.numbers([one.name])] = one.canonical_scale
        nominal = ~np.isin(np.arange(problem.size), [k for where in own.values() for k in where])
        order = np.concatenate([np.flatnonzero(nominal), *own.values()]).astype(int)
        weight = ~problem.at_bound(q) * scale
        gram = self.jacobian.T @ self.jacobian * np.outer(weight, weight)
        gram = (gram + np.diag((problem.tight * nominal) ** 2))[np.ix_(order, order)]
        length = np.sqrt(np.diag(gram))
        unit = gram / np.outer(*[np.where(length > 0, length, 1.0)] * 2)
        triangle = np.linalg.cholesky(unit + _HELD * np.eye(len(unit)))
        found, size, start = {}, (q - problem.absent) / scale, int(nominal.sum())
        for name, where in own.items():
            part = slice(start, start := start + where.size)
            if where.size:
                along, singular, _ = np.linalg.svd(length[part, None] * triangle[part, part])
                found[name] = singular**2, (singular * (size[where] @ along)) ** 2
        return found

    def costs(self, temper):
        """
        Return what freedom and size of each effect cost, in the logarithm of the evidence, by name.

        That is the difference between chi-square at the fit, with residuals of variance ``temper``,
        and the integral over the sizes (Laplace), known as in `astropolcal.gap.attribution`.
        """
        return {
            name: float(share.sum() / 2 / temper - log_factor(values, share, 1.0, temper))
            for name, (values, share) in self._spectra.items()
        }

    def start_of(self, problem):
        """Return a start for another problem: this solution where the two share parameters."""
        mine, theirs = self.problem, problem.vector(problem.start)
        vector = mine.vector(self.fit.coefficients)
        for slot in problem.free.slots:
            known = mine.free.by_name.get(slot.name)
            # a law that was freed has other coefficients but the same values
            if known is not None and known.size == slot.size:
                theirs[slot.slice] = vector[known.slice]
        return Fit(problem.coefficients(theirs), np.inf, False)

    def polished(self, **settings):
        """Return the model with its fit carried on to the end, see `GapProblem.fit`."""
        if self.fit.converged:
            return self
        problem, fit = self.problem, self.problem.fit(self.fit.coefficients, **settings)
        first, told = fit, (problem.fluxes, problem.flickering)
        follows = settings.get("steps") != 0 and any(problem.follows_flux)
        # what adds light changes the flux that it follows
        for _ in range(_FLUXES if follows else 0):
            before, fit = fit, _with_its_fluxes(problem, fit, settings)
            if fit is before:
                break
        # what a model that misses the data expects is not what was there
        if fit is not first and fit.chi2 > _DESCRIBES * problem.n_data:
            problem.follow(*told)
            fit = first
        return Model(problem, fit, self.added)

    def modest(self):
        """Return the model with causes whose parts are no larger than the data ask for.

        What the data do not tell of a cause, as a rotation that may be that of the lamp, is taken
        to be as large as the largest of its parts, or as is usual, and no longer as its limits.
        """
        problem, fit, own = copied(self.problem), self.fit, {}
        for name, added in self.added.items():
            rows = [problem.numbers([one.name]) for one in added]
            usual = np.repeat([one.canonical_scale for one in added], [len(row) for row in rows])
            if usual.size:
                own[name] = np.concatenate(rows), usual
        before = dict.fromkeys(own, np.inf)
        for _ in range(_SHRINKS):
            away = np.abs(fit.coefficients - problem.absent)
            largest = {n: np.max(away[r] / usual, initial=1.0) for n, (r, usual) in own.items()}
            if all(size > _SMALLER * before[name] for name, size in largest.items()):
                break
            problem.tight = self.problem.tight.copy()
            for name, (rows, usual) in own.items():
                known = 1 / (largest[name] * usual)
                problem.tight[rows] = np.maximum(problem.tight[rows], known)
            problem.centre = np.where(problem.tight > 0, problem.absent, 0.0)
            fit, before = problem.fit(fit.coefficients), largest
        return replace(self, problem=problem, fit=fit) if own else self

    def is_physical(self, name):
        """Return whether the fitted values of an effect are possible.

        They are within its limits and the bounds of the optics that have them, whose Mueller
        matrices are physical. A parameter that the fit left at its limit at more than one
        wavelength in ten needs to be beyond it.
        """
        vector = self.problem.vector(self.fit.coefficients)
        low, high = self.problem.free.bounds()
        for parameter in self.added[name]:
            where = self.problem.free.by_name[parameter.name].slice
            size = np.abs(vector[where] - parameter.canonical_neutral) / parameter.canonical_limit
            pressed = np.mean(size > 1 - _AT_LIMIT)
            if size.max() > 1 + _AT_LIMIT or pressed > _MOST_PRESSED:
                return False
            beyond = np.maximum(low - vector, vector - high)[where]
            if np.any(beyond > _AT_LIMIT * parameter.canonical_limit):
                return False
        # the optics that have its parameters, or some that follow these: bounds that an effect sets
        # itself may be those of no optic; a perturbation is a change of an optic, and need not be
        # one by itself
        own = {parameter.name for parameter in self.added[name]}
        own |= {target for target, tie in self.problem.ties.items() if tie.source in own}
        names = {parameter.partition(".")[0] for parameter in own}
        matrices = [
            leaf.mueller(self.problem.wavelength * u.um)
            for leaf in (leaf for chain in self.trains for leaf in leaves(chain))
            if leaf.name in names and not isinstance(leaf, Perturbation)
        ]
        return all(np.isfinite(m).all() and is_physical(m, _AT_LIMIT).all() for m in matrices)

    def keeps_polarization(self, name):
        """
        Return whether no beam would be negative for some light upstream of an effect.

        What makes polarization larger may be a change of an optic that makes it smaller, or of one
        downstream of it, but all optics together never measure more than there is.
        """
        own = {p.name.partition(".")[0] for p in self.added[name]}
        for dataset in self.problem.datasets:
            optics = dataset.propagator.leaves
            found = [
                i
                for i, leaf in enumerate(optics)
                if leaf.name in own
                and isinstance(leaf, Perturbation)
                and leaf.kind.startswith("depolarization")
            ]
            if not found:
                continue
            sweep = dataset.forward(self.problem.vector(self.fit.coefficients))
            # rotators, which stand between an optic and what turns with it, change no length
            front = [i for i in range(found[0]) if not isinstance(optics[i], Rotator)][-1:]
            one, none = np.ones(sweep.fluxes[0].shape), np.zeros(sweep.fluxes[0].shape)
            for weights in ((one, none), (none, one)):
                seen = sweep.crossings(front, weights).values()
                for row, _ in (pair for pairs in seen for pair in pairs):
                    polarized = np.linalg.norm(row[..., 1:], axis=-1)
                    if np.any(polarized > row[..., 0] * (1 + _MORE_LIGHT)):
                        return False
        return True

    def at_bound(self, name):
        """Return how many values of an effect are at a bound of their optic."""
        at = self.problem.free.at_bounds(self.problem.vector(self.fit.coefficients))
        slots = [self.problem.free.by_name[p.name] for p in self.added.get(name) or ()]
        return sum(int(np.sum(at[slot.slice])) for slot in slots)


def _with_its_fluxes(problem, fit, settings):
    """Return a fit with the fluxes that another expects, or half way to them, if it is better."""
    before, after = (problem.fluxes, problem.flickering), problem.expected(fit.coefficients)
    pairs = [zip(*both, strict=True) for both in zip(before, after, strict=True)]
    # where much light is added, the whole way leads too far
    half = [[a if b is None else np.sqrt(a * b) for b, a in pair] for pair in pairs]
    for fluxes in (after, half):
        problem.follow(*fluxes)
        again = problem.fit(fit.coefficients, **settings)
        if again.chi2 < fit.chi2:
            return again
    problem.follow(*before)
    return fit


@dataclass
class Linear:
    """A fitted model in which effects may be absent, to first order."""

    model: Model
    #: Orthonormal basis of what it can do without these effects, (n_rows, rank).
    tangent: np.ndarray
    #: What it leaves then, whitened, (n_rows,).
    residual: np.ndarray

    @property
    def chi2(self):
        """Sum of squares of the residuals."""
        return float(self.residual @ self.residual)

    @property
    def mean_square(self):
        """Mean square of the residuals: 1 where noise is all that is left."""
        return self.chi2 / max(self.freedom, 1)

    @cached_property
    def freedom(self):
        """Number of data less that of the parameters, of which a prior determines a part."""
        return self.model.problem.n_data - float(np.sum(self.tangent**2))


def nominal_model(chains, observations, calibration=None, other=None):
    """
    Fit the nominal chains in both channels, from a calibration that is made if none is given.

    ``other`` holds the same chains with other values, from which the fit may start, too.
    """
    if calibration is None:
        calibration = nominal_calibration(chains, observations)
    problem = GapProblem(calibration.chains, observations)
    problem.settle_noise()
    found = _lowest(problem, [chains] if other is None else [chains, other])
    # in turn: the residuals of a better fit tell the noise better
    for _ in range(_ROUNDS - 1):
        problem.settle_noise(found.coefficients)
        found = problem.fit(found.coefficients)
    before = np.inf
    for _ in range(_MORE):
        # along the flat valleys of a model that lacks much, a fit takes its time
        if not found.converged:
            before, found = found.chi2, problem.fit(found.coefficients)
    if not (np.isfinite(found.chi2) and (found.converged or found.chi2 > (1 - _FLAT) * before)):
        raise GapError(
            "the nominal fit did not converge: nothing can be said of missing effects; "
            "check the angles, the optics in the beam and the starting values"
        )
    made = calibration if isinstance(calibration, FittedMeasurement) else None
    return Model(problem, found, calibration=made, start=chains)


def _lowest(problem, starts):
    """Fit from the calibration and from the starts; return the lowest.

    In the double differences, which the calibration fits, noise or a fault may have put a
    wavelength into the wrong mirror branch: single differences often tell.
    """
    found = problem.fit()
    for chains in starts:
        vector = problem.vector(found.coefficients)
        for name, (known, *_) in parameter_table(chains).items():
            slot, value = problem.free.by_name.get(name), np.ravel(known.value)
            if slot is not None and value.size in (1, slot.size):
                vector[slot.slice] = value * slot.factor
        found = _lower(problem, vector, found)
    told = first_weighting(problem.measurement, None)
    bins = BinProblem(*few_frames(problem.measurement, told))
    vector, moved = search_branches(bins, problem.vector(found.coefficients))
    return _lower(problem, vector, found) if moved.any() else found


def _lower(problem, vector, found):
    """Return the lower of two fits, that which starts from a vector and one that is known."""
    other = problem.fit(np.clip(problem.coefficients(vector), problem.low, problem.high))
    return other if other.converged and other.chi2 < found.chi2 else found


def nominal_calibration(chains, observations):
    """Fit chains as a calibration does, of which the errors are seldom asked for."""
    measurement = Measurement(chains, observations)
    if not measurement.free.size:
        # every parameter is held: the chains as they are
        return SimpleNamespace(converged=True, measurement=measurement, chains=measurement.chains)
    with warnings.catch_warnings(action="ignore", category=AstropolcalWarning):
        # a model that lacks something is expected to fit badly; the report says how badly
        instrument = next((o.instrument for o in observations if o.instrument), None)
        return fitted(measurement, instrument=instrument)


def off_extremum(problem, start, parameters):
    """
    Return the start of a fit, or those of both signs where the derivative of a retardance vanishes.

    At half a wave it does, and a fit from there would stay.
    """
    found = []
    optics = {leaf.name: leaf for d in problem.datasets for leaf in d.propagator.leaves}
    for parameter in parameters:
        where = problem.slices.get(parameter.name)
        if where is None or np.any(start[where]) or not _retards(optics, parameter.name):
            continue
        vector = problem.vector(start)
        vector[problem.free.by_name[parameter.name].slice] = FINITE
        step = problem.coefficients(vector) - start
        ends = [start + sign * step for sign in (1, -1)]
        there, up, down = (problem.residual(q) for q in (start, *ends))
        bend = np.linalg.norm(up + down - 2 * there)
        if bend > max(1.0, _BENT * np.linalg.norm(up - down)):
            found += ends
    return found or [start]


def _retards(optics, name):
    """Return whether a parameter is a constant retardance that was inserted."""
    optic = optics.get(name.partition(".")[0])
    if isinstance(optic, Perturbation):
        return optic.kind.startswith("retardance") and optic.dependence == "constant"
    return isinstance(optic, LinearRetarder) and name.endswith(".retardance")
