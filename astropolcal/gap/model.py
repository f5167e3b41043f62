# Licensed under a 3-clause BSD style license - see LICENSE
"""The nominal model with effects added to it, step by step."""

import warnings
from dataclasses import dataclass, field
from functools import cached_property
from types import SimpleNamespace

import astropy.units as u
import numpy as np
from scipy import stats

from astropolcal.calibration import calibrate
from astropolcal.chain import join, leaves
from astropolcal.exceptions import AstropolcalWarning, GapError
from astropolcal.gap._branches import NOISE, in_branch, off_extremum
from astropolcal.gap.effects import Context
from astropolcal.gap.problem import Fit, GapProblem
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.mueller import is_physical
from astropolcal.optics import Perturbation, Rotator

__all__ = ["Model", "effect_tangent", "nominal_calibration", "nominal_model"]

_ROUNDS, _MORE = 3, 3
# directions in which a size at its limit does less than this to the data, in units of the
# noise, are not looked at; nor those of which the model takes up all but this share
_VISIBLE = 1.0
_ABSORBED = 1e-6
# a size so near to its limit, in units of that, is at it; the share of the wavelengths at
# which the data may leave a size there
_AT_LIMIT = 1e-6
_MOST_PRESSED = 0.1
# share by which optics may seem to measure more polarization than there is
_MORE_LIGHT = 1e-3


@dataclass
class Model:
    """
    Chains, what has been added to them, and their fit in both channels.

    Parameters
    ----------
    problem : GapProblem
        Residuals and derivatives.
    fit : Fit
        The solution.
    added : dict of str to list of EffectParameter
        Effects in the chains, with the parameters that they added.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> model.added, model.fit.converged
    ({}, True)
    """

    problem: GapProblem
    fit: object
    added: dict = field(default_factory=dict)

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
        return [_held(train) for train in self.trains]

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
        """
        Return the model of one of the datasets by itself, fitted with the same noise.

        Parameters
        ----------
        i : int
            Number of the dataset.

        Returns
        -------
        Model
            Without what was added.
        """
        mine = self.problem
        noise = SimpleNamespace(fluxes=[mine.fluxes[i]], channels=[mine.channels[i]], waves=None)
        problem = GapProblem([self.trains[i]], [self.observations[i]], ties=mine.ties, like=noise)
        return Model(problem, problem.fit(problem.start))

    def degrees_of_freedom(self, tangent):
        """Return the number of data less that of the directions fitted."""
        return self.problem.n_data - tangent.shape[1]

    @property
    def mean_square(self):
        """Mean square of the whitened residuals: 1 where noise is all that is left."""
        return self.fit.chi2 / max(self.problem.n_data - self.problem.size, 1)

    @property
    def p_value(self):
        """Probability of the residuals by noise alone."""
        tangent = self.problem.tangent(self.fit.coefficients)
        return float(stats.chi2.sf(self.fit.chi2, self.degrees_of_freedom(tangent)))

    def edited(self, *recipes):
        """
        Return the model with effects at zero, not fitted.

        Parameters
        ----------
        *recipes : tuple
            Effect and context each, the latter None for that of the data. An effect that has no
            place without another that is not among them is left out.

        Returns
        -------
        Model
            The model itself where nothing was added.
        """
        mine, trains, edits = self.problem, self.trains, {}
        for effect, context in recipes:
            if effect.applies(trains):
                edits[effect.name] = effect.edit(trains, context or self.context)
                trains = edits[effect.name].chains
        if not edits:
            return self
        settings = {"neutral": dict(mine.neutral)}
        for key in ("ties", "laws", "priors", "limits"):
            settings[key] = dict(getattr(mine, key))
            for edit in edits.values():
                settings[key] |= getattr(edit, key)
        added = {name: edit.parameters for name, edit in edits.items()}
        parameters = [p for own in added.values() for p in own]
        settings["neutral"] |= {p.name: p.canonical_neutral for p in parameters}
        problem = GapProblem(trains, self.observations, like=mine, **settings)
        return Model(problem, Fit(problem.start, np.inf, False), self.added | added)

    def with_effect(self, effect, context=None, **settings):
        """
        Return the model with an effect added and everything fitted again.

        Parameters
        ----------
        effect : Effect
            The effect.
        context : Context, optional
            By default that of the data.
        **settings
            Of `GapProblem.fit`.

        Returns
        -------
        Model
        """
        model = self.edited((effect, context))
        problem, added = model.problem, model.added
        starts = off_extremum(problem, problem.start, added[effect.name])
        fits = [problem.fit(start, **settings) for start in starts]
        return Model(problem, min(fits, key=lambda one: one.chi2), added)

    def with_effects(self, effects, like=None, **settings):
        """
        Return the model with several effects added, and fitted once.

        One that has no place without another that is not among them is left out.

        Parameters
        ----------
        effects : sequence of tuple
            Effect and context each, the latter None for that of the data.
        like : Model, optional
            A model from whose solution the fit starts, where the two share
            parameters.
        **settings
            Of `GapProblem.fit`.

        Returns
        -------
        Model
        """
        model = self.edited(*effects)
        # not fitted in between: one fit at the end is enough
        if like is not None:
            model = Model(model.problem, like.start_of(model.problem), model.added)
        return self if model is self else model._off_extrema().polished(**settings)

    def _off_extrema(self):
        """Return the model with the effects moved whose derivative vanishes where they start."""
        start = self.fit.coefficients
        for parameters in self.added.values():
            # a finite size may be too large, but a fit gets down from there
            others = off_extremum(self.problem, start, parameters)
            start = min(others, key=lambda q: np.sum(self.problem.residual(q) ** 2))
        moved = start is not self.fit.coefficients
        return Model(self.problem, Fit(start, np.inf, False), self.added) if moved else self

    def without(self, names):
        """
        Return the model without some of its effects, to first order.

        Parameters
        ----------
        names : collection of str
            Names of added effects.

        Returns
        -------
        Linear
        """
        problem, q = self.problem, self.fit.coefficients
        kept, jacobian = np.ones(problem.size, dtype=bool), self.jacobian
        residual = self.residual
        absent = problem.coefficients(problem._absent())
        for parameter in (p for name in names for p in self.added[name]):
            where = problem.slices.get(parameter.name)
            if where is not None:
                kept[where] = False
                residual = residual + jacobian[:, where] @ (q - absent)[where]
        # what is known beforehand is one more row of data for each of these parameters
        known = np.flatnonzero(kept & (problem.tight > 0))
        table, target = jacobian, residual
        if known.size:
            rows = np.zeros((known.size, problem.size))
            rows[np.arange(known.size), known] = problem.tight[known]
            table = np.concatenate([jacobian, rows])
            target = np.concatenate([residual, -(q - problem.centre)[known] * problem.tight[known]])
        tangent = problem.tangent(q, table, kept)
        left = target - tangent @ (tangent.T @ target)
        return Linear(self, tangent[: problem.n_rows], left[: problem.n_rows])

    @cached_property
    def jacobian(self):
        """Derivative of the rows to the coefficients, (n_rows, n_coefficients)."""
        return self.problem.jacobian(self.fit.coefficients)

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
        fit = self.problem.fit(self.fit.coefficients, **settings)
        return Model(self.problem, fit, self.added)

    def sizes(self, name):
        """
        Return the fitted coefficients of an added effect and their errors.

        Parameters
        ----------
        name : str
            Name of the effect.

        Returns
        -------
        dict of str to tuple
            ``"optic.parameter"`` to coefficients, errors, unit and EffectParameter.
        """
        errors = self.problem.errors(self.fit.coefficients)
        found = {}
        for parameter in self.added[name]:
            slot = self.problem.free.by_name[parameter.name]
            where = self.problem.slices[parameter.name]
            found[parameter.name] = (
                self.fit.coefficients[where] / slot.factor,
                errors[where] / slot.factor,
                slot.unit,
                parameter,
            )
        return found

    def is_physical(self, name):
        """
        Return whether the fitted values of an effect are possible.

        They are within its limits and the bounds of the optics that have them, whose Mueller
        matrices are physical. A parameter that the fit left at its limit at more than one
        wavelength in ten wants to be beyond it.
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
        # bounds that an effect sets itself may be those of no optic; a perturbation is a change of
        # an optic, and need not be one by itself
        matrices = [
            leaf.mueller(self.problem.wavelength * u.um)
            for leaf in self._carriers(name)
            if not isinstance(leaf, Perturbation)
        ]
        return all(np.isfinite(m).all() and is_physical(m, _AT_LIMIT).all() for m in matrices)

    def keeps_polarization(self, name):
        """
        Return whether no beam would be negative for some light in front of an effect.

        What makes polarization larger may be a change of an optic that makes it smaller, or of one
        behind it, but all optics together never measure more than there is.
        """
        vector, own = None, {p.name.partition(".")[0] for p in self.added[name]}
        for dataset in self.problem.datasets:
            optics = dataset.propagator.leaves
            found = [i for i, leaf in enumerate(optics) if leaf.name in own and _depolarizes(leaf)]
            if not found:
                continue
            vector = self.problem.vector(self.fit.coefficients) if vector is None else vector
            sweep = dataset.forward(vector)
            # rotators, which stand between an optic and what turns with it, change no length
            front = [i for i in range(found[0]) if not isinstance(optics[i], Rotator)][-1:]
            one, none = np.ones(sweep.fluxes[0].shape), np.zeros(sweep.fluxes[0].shape)
            for weights in ((one, none), (none, one)):
                for row, _ in sweep.crossings(front, weights).values():
                    polarized = np.linalg.norm(row[..., 1:], axis=-1)
                    if np.any(polarized > row[..., 0] * (1 + _MORE_LIGHT)):
                        return False
        return True

    def _carriers(self, name):
        """Return the optics that have the parameters of an effect, or some that follow these."""
        own = {parameter.name for parameter in self.added[name]}
        own |= {target for target, tie in self.problem.ties.items() if tie.source in own}
        names = {parameter.partition(".")[0] for parameter in own}
        return [leaf for chain in self.trains for leaf in leaves(chain) if leaf.name in names]

    def at_bound(self, name):
        """Return how many values of an effect are at a bound of their optic."""
        at = self.problem.free.at_bounds(self.problem.vector(self.fit.coefficients))
        slots = [self.problem.free.by_name[p.name] for p in self.added.get(name) or ()]
        return sum(int(np.sum(at[slot.slice])) for slot in slots)

    def impossible(self):
        """Return the names of the effects whose fitted values are out of their limits."""
        return {name for name in self.added if not self.is_physical(name)}


@dataclass
class Linear:
    """
    A fitted model in which effects may be absent, to first order.

    Parameters
    ----------
    model : Model
        The fitted model.
    tangent : `~numpy.ndarray`
        Orthonormal basis of what it can do without these effects, (n_rows, rank).
    residual : `~numpy.ndarray`
        What it leaves then, whitened, (n_rows,).

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.model import Linear
    >>> Linear(None, np.zeros((2, 0)), np.array([3.0, 4.0])).chi2
    25.0
    """

    model: Model
    tangent: np.ndarray
    residual: np.ndarray

    @property
    def chi2(self):
        """Sum of squares of the residuals."""
        return float(self.residual @ self.residual)

    @property
    def mean_square(self):
        """Mean square of the residuals: 1 where noise is all that is left."""
        freedom = self.model.problem.n_data - self.tangent.shape[1]
        return self.chi2 / max(freedom, 1)


def _depolarizes(leaf):
    return isinstance(leaf, Perturbation) and leaf.kind.startswith("depolarization")


def nominal_model(chains, observations, *, calibration=None, like=None, fit=True):
    """
    Fit the nominal chains in both channels.

    Parameters
    ----------
    chains : sequence
        The chain of each dataset.
    observations : sequence of Observations
        The datasets.
    calibration : Calibration, optional
        A calibration of these data; by default it is made.
    like : Model, optional
        A model whose noise is taken over.
    fit : bool
        Whether to fit in both channels, or take the values of the calibration.

    Returns
    -------
    Model

    Raises
    ------
    GapError
        If the nominal fit does not converge.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> model = nominal_model([charis.chain()], [observations])
    >>> bool(model.fit.chi2 < 1.1 * model.problem.n_rows)
    True
    """
    if calibration is None:
        calibration = nominal_calibration(chains, observations)
    if calibration.converged is False and fit:
        raise _no_convergence()
    problem = GapProblem(
        calibration.chains, observations, like=None if like is None else like.problem
    )
    if not fit:
        residual = problem.residual(problem.start)
        return Model(problem, Fit(problem.start, float(residual @ residual), False))
    if like is None:
        problem.settle_noise()
    found = in_branch(problem, _lowest(problem, chains))
    # in turn: the residuals of a better fit tell the noise better
    for _ in range(_ROUNDS - 1 if like is None else 0):
        problem.settle_noise(found.coefficients)
        found = problem.fit(found.coefficients)
    for _ in range(_MORE):
        # along the flat valleys of a model that lacks much, a fit takes its time
        found = found if found.converged else problem.fit(found.coefficients)
    if not (found.converged and np.isfinite(found.chi2)):
        raise _no_convergence()
    return Model(problem, found)


def _lowest(problem, chains):
    """Fit from the calibration and, where noise does not explain what is left, from the chains."""
    found = problem.fit()
    if stats.chi2.sf(found.chi2, max(problem.n_data - problem.size, 1)) > NOISE:
        return found
    known = parameter_table(chains)
    vector = problem.vector(problem.start)
    for slot in problem.free.slots:
        value = np.ravel(known[slot.name][0].value) * slot.factor
        vector[slot.slice] = value if value.size in (1, slot.size) else vector[slot.slice]
    other = problem.fit(np.clip(problem.coefficients(vector), problem.low, problem.high))
    return other if other.converged and other.chi2 < found.chi2 else found


def _no_convergence():
    return GapError(
        "the nominal fit did not converge: nothing can be said of missing effects; "
        "check the angles, the optics in the beam and the starting values"
    )


class _AsGiven:
    """What stands for a calibration where every parameter is held: the chains as they are."""

    converged = True

    def __init__(self, measurement):
        self.measurement = measurement

    @property
    def chains(self):
        """The chains."""
        return self.measurement.chains


def nominal_calibration(chains, observations):
    """
    Calibrate chains without cross-validation, for a diagnosis.

    Parameters
    ----------
    chains : sequence
        The chain of each dataset.
    observations : sequence of Observations
        The datasets.

    Returns
    -------
    Calibration
        It may not have converged, see its ``converged``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_calibration
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> nominal_calibration([chain], [simulate(chain, charis.wavelength, frames, seed=1)]).converged
    True
    """
    measurement = Measurement(chains, observations)
    if not measurement.free.size:
        return _AsGiven(measurement)
    with warnings.catch_warnings():
        # a model that lacks something is expected to fit badly; the report says how badly
        warnings.simplefilter("ignore", AstropolcalWarning)
        return calibrate(list(chains), list(observations), cross_validate=False)


def effect_tangent(model, effect, nominal, context=None):
    """
    Return the directions in the data that an effect adds to a model.

    Parameters
    ----------
    model : Model
        The fitted model.
    effect : Effect
        An effect that is not in the model.
    nominal : `~numpy.ndarray`
        Orthonormal basis of what the model can do already, (n_rows, rank).
    context : Context, optional
        By default that of the data.

    Returns
    -------
    `~numpy.ndarray`
        Orthonormal, shape (n_rows, k). Directions are left out in which even an
        effect at its physical limit would change the data by less than their
        noise.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> from astropolcal.gap.model import effect_tangent, nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> model = nominal_model([charis.chain()], [observations])
    >>> nominal = model.problem.tangent(model.fit.coefficients)
    >>> effect_tangent(model, get_effect("beam_gain"), nominal).shape[1]
    3
    """
    edit = effect.edit(model.held_chains, context or model.context)
    names = {p.name for p in edit.parameters}
    problem = GapProblem(
        edit.chains,
        model.observations,
        ties={name: tie for name, tie in edit.ties.items() if tie.source in names},
        laws=edit.laws,
        like=model.problem,
        copy=False,
    )
    if not problem.size:
        return np.zeros((problem.n_rows, 0))
    priors = edit.priors
    size = np.concatenate(
        [
            np.full(problem.slices[n].stop - problem.slices[n].start, priors[n])
            for n in problem.slices
        ]
    )
    # each column is what a size at the brink of the possible would do
    slopes = problem.jacobian(problem.start) * size
    left = slopes - nominal @ (nominal.T @ slopes)
    # twice is enough to be orthogonal to rounding
    left -= nominal @ (nominal.T @ left)
    basis, singular, _ = np.linalg.svd(left, full_matrices=False)
    # a column is what half the limit does: singular values are in units of the noise
    floor = max(_VISIBLE, _ABSORBED * np.linalg.norm(slopes, axis=0).max())
    return basis[:, singular > floor]


def _held(chain):
    """Return a copy of the chain with every parameter fixed."""
    copy = chain.copy()
    for leaf in leaves(copy):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = True
    return copy
