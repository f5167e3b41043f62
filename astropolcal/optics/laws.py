# Licensed under a 3-clause BSD style license - see LICENSE
"""
Laws that parameters follow: a model of astropy, of time, place in the field or wavelength.

What a law gives is added to its parameter in each frame. Its coefficients are parameters of the
optic like any other, named after both: ``theta_c1`` is ``c1`` of the law of ``theta``.
"""

from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.modeling import Model
from astropy.modeling.polynomial import Polynomial1D, Polynomial2D, PolynomialModel

from astropolcal.exceptions import ParameterError
from astropolcal.optics._modelling import OpticParameter, with_values
from astropolcal.optics.positions import COORDINATES, FLUXES, PLACES
from astropolcal.units import canonical_factor, iso_date, mjd_of, to_unit

__all__ = []

# inputs at which a coefficient whose effect is the same everywhere is the constant of a law
_PROBES = np.array([-2e4, -90.0, -3.0, -0.5, 0.7, 1.6, 2.4, 150.0, 2e4])


@dataclass(frozen=True, eq=False)
class Law:
    """
    What is added to a parameter: a model without units of numbers in the units of `input_unit`.

    ``of`` names the inputs; ``since`` is the Modified Julian Date at which time is zero; ``known``
    are the lowest and highest of each input in the frames of a calibration, canonical.
    """

    model: Model
    of: tuple
    unit: object
    since: float | None = None
    known: dict = field(default_factory=dict)

    def __post_init__(self):
        units = coefficient_units(self.model, self.of, self.unit)
        object.__setattr__(self, "units", units)
        object.__setattr__(self, "_factors", [canonical_factor(unit) for unit in units])

    def __deepcopy__(self, memo):
        return self  # it does not change

    @property
    def size(self):
        """Number of coefficients."""
        return len(self.model.param_names)

    def __str__(self):
        ends = (
            (name, shown(name, low), shown(name, high))
            for name, (low, high) in sorted(self.known.items())
        )
        where = "; ".join(f"{name} from {low} to {high}" for name, low, high in ends)
        kind = "compound model" if hasattr(self.model, "op") else type(self.model).__name__
        since = "" if self.since is None else f" since {shown('time', self.since)}"
        told = f"{kind} of {', '.join(self.of)}{since}"
        return f"{told}, calibrated for {where}" if where else told

    @property
    def fingerprint(self):
        """Text that is another where the same coefficients would mean something else."""
        found = self.model.evaluate(*np.full(len(self.of), 0.7), *np.arange(1.0, self.size + 1))
        return f"{replace(self, known={})} in {self.unit}: {np.ravel(found).tolist()}"

    def names(self, key):
        """Return the names of the coefficients among the parameters of an optic."""
        return tuple(f"{key}_{name}" for name in self.model.param_names)

    def value(self, lam, places, coefficients):
        """Return what is added, canonical, of canonical coefficients at wavelengths (um)."""
        return self._evaluated(self._inputs(lam, places), self._numbers(coefficients))

    def rate(self, lam, places, coefficients, i):
        """Return the derivative of `value` to coefficient i, by central differences."""
        inputs, numbers = self._inputs(lam, places), self._numbers(coefficients)
        # exact to rounding where the law is linear; not lost in it where a coefficient is tiny
        small = 1e-6 * np.maximum(np.abs(numbers[i]), 0.1)
        step = np.ones_like(small) if _is_linear(self.model) else small
        high, low = ([*numbers[:i], numbers[i] + s, *numbers[i + 1 :]] for s in (step, -step))
        change = self._evaluated(inputs, high) - self._evaluated(inputs, low)
        return change / (2 * step) / self._factors[i]

    def _numbers(self, coefficients):
        pairs = zip(coefficients, self._factors, strict=True)
        return [np.asarray(value) / factor for value, factor in pairs]

    def _inputs(self, lam, places):
        found = []
        for name in self.of:
            value = lam if name == "wavelength" else places[name]
            shifted = value - self.since if name == "time" else value
            # angles of stages are radian, all else is a number in its unit already
            found.append(np.rad2deg(shifted) if input_unit(name) is u.deg else shifted)
        return found

    def _evaluated(self, inputs, numbers):
        return self.model.evaluate(*inputs, *numbers) * canonical_factor(self.unit)

    def with_known(self, ends):
        """Return the law with the lowest and highest of its inputs, of those of all positions."""
        return replace(self, known={name: ends[name] for name in self.of if name in ends})

    def middle(self, name):
        """Return the middle of an input in the frames of a calibration, or where it is zero."""
        return np.mean(self.known[name]) if name in self.known else self.since or 0.0

    def stands(self, lam, places):
        """Return whether all of its inputs are there."""
        return all(lam is not None if n == "wavelength" else n in places for n in self.of)

    def beyond(self, places):
        """Say in words where a place is outside of what was calibrated; None where none is."""
        for name in (name for name in self.known if name in places):
            value, (low, high) = np.asarray(places[name]), self.known[name]
            slack = 1e-9 * max(1.0, abs(low), abs(high))
            outside = (value < low - slack) | (value > high + slack)
            if outside.any():
                words = [shown(name, x) for x in (value[outside].flat[0], low, high)]
                return "{} = {}, calibrated from {} to {}".format(name, *words)
        return None


def _is_linear(model):
    """Return whether a model is linear in its parameters; for astropy what ``|`` joins is."""
    if hasattr(model, "op"):
        return model.op in "+-" and _is_linear(model.left) and _is_linear(model.right)
    return model.linear


def shown(name, value):
    """Return an input of a law as text with its unit."""
    if name == "time":
        return iso_date(f"{value:.5f}")
    unit = input_unit(name)
    value = np.rad2deg(value) if unit is u.deg else value
    return f"{value:.4g} {unit or ''}".strip()


def input_unit(name):
    """Return the unit of an input of a law, None of a number."""
    if name in PLACES:
        return PLACES[name]
    return u.um if name == "wavelength" else None if name in COORDINATES else u.deg


def coefficient_units(model, of, unit):
    """Return the unit of each coefficient, None where it has none or astropy does not know it."""
    own = u.one if unit is None else unit
    units = [input_unit(name) or u.one for name in of]
    if isinstance(model, (Polynomial1D, Polynomial2D)):
        powers = [map(int, name[1:].split("_")) for name in model.param_names]
        found = [own / np.prod([x**n for x, n in zip(units, p, strict=True)]) for p in powers]
    elif isinstance(model, PolynomialModel):
        found = [own for _ in model.param_names]
    else:
        data = {name: 1 * x for name, x in zip(model.inputs, units, strict=True)}
        try:
            known = model.with_units_from_data(**data, **{model.outputs[0]: 1 * own})
        except (NotImplementedError, AttributeError):
            return [None] * len(model.param_names)
        found = [getattr(known, name).unit for name in model.param_names]
    found = [None if x is None else u.Unit(x) for x in found]
    return [None if x in (None, u.one) else x for x in found]


def law_of(label, unit, model, of, since=None):
    """Return a law for a parameter, and its coefficients as `OpticParameter` by name."""
    of = (of,) if isinstance(of, str) else tuple(of)
    if not (isinstance(model, Model) and model.fittable and model.n_outputs == 1):
        raise ParameterError(f"{label} follows {model!r}; a fittable model of one output is needed")
    if len(of) != model.n_inputs or not all(isinstance(n, str) and n not in FLUXES for n in of):
        raise ParameterError(
            f"{label}: of = {of!r}; {type(model).__name__} has {model.n_inputs} inputs, and each "
            'needs a name such as "time", "x", "y", "wavelength" or that of a stage'
        )
    if "time" in of and since is None:
        raise ParameterError(f"{label}: a law of time needs since=..., when time is zero")
    units = coefficient_units(model, of, unit)
    named = list(zip(model.param_names, units, strict=True))
    found = {name: _coefficient(f"{label}_{name}", getattr(model, name), x) for name, x in named}
    law = Law(
        with_values(model, [np.mean(p.value) for p in found.values()]),
        of,
        unit,
        None if since is None else float(mjd_of(since, "since")),
    )
    inputs = [np.roll(_PROBES, i) for i in range(len(law.of))]
    numbers = [np.ravel(p.value)[0] for p in found.values()]
    for i, parameter in enumerate(found.values()):
        with np.errstate(all="ignore"):
            moved = [*numbers[:i], numbers[i] + 1.0, *numbers[i + 1 :]]
            change = law.model.evaluate(*inputs, *moved) - law.model.evaluate(*inputs, *numbers)
        change = np.broadcast_to(change, _PROBES.shape)
        if np.all(change != 0) and np.ptp(change) < 1e-6 * np.abs(change).max():
            parameter.fixed = True
    return law, found


def _coefficient(label, given, unit):
    if given.tied:
        raise ParameterError(f"{label} has a callable tie; pass ties={{...: Tie(...)}} instead")
    value, factor = np.asarray(given.value, dtype=float), 1.0
    if given.unit is not None:
        factor = float(to_unit(1.0 * given.unit, unit, label))
    if value.ndim > 1 or not np.all(np.isfinite(value)):
        raise ParameterError(f"{label} = {value} must be a finite number, or one per wavelength")
    if factor != 1 and hasattr(given.prior, "dist"):
        # a distribution of scipy has no unit
        raise ParameterError(
            f"{label}: its prior is of a value in {given.unit}; give model and prior in {unit}"
        )
    bounds = [None if bound is None else float(bound) * factor for bound in given.bounds]
    new = OpticParameter(
        name=label.rpartition(".")[2],
        default=value * factor,
        unit=unit,
        bounds=bounds,
        fixed=given.fixed,
        description=f"{given.name} of the law that it follows",
    )
    new.prior = given.prior
    return new
