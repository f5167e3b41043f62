# Licensed under a 3-clause BSD style license - see LICENSE
"""
Curves: what an optic or a chain does against the wavelength or against the angle of a stage.

A curve is a model of one input and one output, to be plotted, and to be fitted by any of astropy's
fitters to what was measured in the laboratory. Its parameters are those of the optics.
"""

import astropy.units as u
import numpy as np

from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.optics._modelling import ScalarParameters
from astropolcal.optics.positions import COORDINATES, finite_position
from astropolcal.units import canonical_factor, length_to_um, to_unit
from astropolcal.words import did_you_mean

__all__ = []

_STOKES = ("I", "Q", "U", "V")


def curve_of(chain, optics, what, element=None, against="wavelength", wavelength=None, **positions):
    """Return the curve of an optic or a chain, whose optics are in a list; see `Optic.curve`."""
    moving = [f"{o.name or 'an optic'}.{key}" for o in optics for key in o._follows]
    if moving:
        raise ParameterError(f"no curve: {moving[0]} follows a law; mueller() says what it does")
    laws = _laws(optics[0]) if len(optics) == 1 else ()
    if isinstance(what, str) and what in laws:
        if element is not None or against != "wavelength" or wavelength is not None or positions:
            raise ParameterError(f"the curve of {what} is one against wavelength, without more")
        return LawCurve(chain, optics, what)
    if what == "mueller":
        if np.shape(element) != (2,) or not {*element} <= {0, 1, 2, 3}:
            raise ParameterError(
                f"element = {element!r}; allowed are two numbers from 0 to 3, row and column"
            )
        row, column = element
    elif what in _STOKES or hasattr(what, "frames_per_datum"):
        row, column = _STOKES.index(what) if what in _STOKES else 0, 0
    else:
        known = ["mueller", *_STOKES, *laws]
        raise ParameterError(
            f"no curve of {what!r}{did_you_mean(str(what), known)}; there are those of "
            f"{', '.join(known)} and of an Observable"
        )
    observable = what if hasattr(what, "frames_per_datum") else None
    return LightCurve(chain, optics, (row, column), observable, against, wavelength, positions)


def _laws(optic):
    """Return what an optic has a value of at each wavelength, with the unit."""
    own = {key: optic._declared(key).unit for key in optic.own_names}
    return own | optic._laws


class Curve(ScalarParameters):
    """
    A model of one input and one output whose parameters are those of optics, the same objects.

    A subclass works on canonical floats; the values of the model are numbers in ``_unit``.
    """

    _unit = None

    def __init__(self, chain, optics, input_unit, unit=None):
        super().__init__()
        self._chain, self._input_unit, self._unit = chain, input_unit, unit
        # which number each value of the optics is, and its factor to canonical units
        self._names_of, self._plan = {}, []
        for i, optic in enumerate(optics):
            plan = []
            for key in self._names(optic):
                factor = canonical_factor(optic._declared(key).unit)
                if np.size(getattr(optic, key).value) == 1:
                    plan.append((len(self._names_of), factor))
                    label = f"{optic.name}_{key}" if optic.name else f"{key}_{i}"
                    self._names_of[key if len(optics) == 1 else label] = i, key
                else:
                    # fitters of astropy take no parameters of several values
                    plan.append((None, factor))
            self._plan.append(plan)
        self._several = any(place is None for plan in self._plan for place, _ in plan)
        self._take(optics)

    def _take(self, optics):
        self._optics = optics
        # of each parameter the optic that has it, and its name there
        self._owners = {name: (optics[i], key) for name, (i, key) in self._names_of.items()}
        self._hold({name: getattr(*owner) for name, owner in self._owners.items()})
        # what a fitter asks for again: setting an attribute of a model takes astropy a while
        self._memo = {}

    def __setattr__(self, attr, value):
        if attr in self._param_names:
            setattr(*self._owners[attr], value)
        else:
            super().__setattr__(attr, value)

    @property
    def return_units(self):
        """Unit of the values, where they have one."""
        return None if self._unit is None else {self.outputs[0]: self._unit}

    def without_units_for_data(self, **data):
        """Return the model as a fitter takes it: with values in the unit of the data."""
        self.check_start()
        values = data[self.outputs[0]]
        if not isinstance(values, u.Quantity):
            return self
        own = u.one if self._unit is None else self._unit
        if not values.unit.is_equivalent(own):
            raise ParameterError(
                f"the data are in {values.unit}, but the curve gives {str(own) or 'plain numbers'}"
            )
        model = self if values.unit == own else self.copy()
        model._unit = values.unit
        return model

    def _names(self, optic):
        """Return the parameters of an optic on which the curve depends."""
        return optic.param_names

    @property
    def chain(self):
        """The optic or the chain to which the parameters belong."""
        return self._chain

    @property
    def input_units(self):
        """Unit of the input: micrometre, or degree of the angle of a stage."""
        return {self.inputs[0]: self._input_unit}

    def __deepcopy__(self, memo):
        memo[id(self)] = new = self.__class__.__new__(self.__class__)
        new.__dict__.update(self.__dict__)
        new._chain = self._chain.copy()
        new._take(list(new._chain) if len(self._optics) > 1 else [new._chain])
        return new

    def prepare_inputs(self, x, **kwargs):
        """Return what `evaluate` takes, as astropy does; refuse an input without its unit."""
        to_unit(x, self._input_unit, self.inputs[0])
        return super().prepare_inputs(x, **kwargs)

    def evaluate(self, x, *parameters):
        """Return the values at ``x``; without units numbers are in the units of the curve."""
        values = self._values(self._found_at(x, parameters), np.size(x))
        return values.reshape(np.shape(x)) / canonical_factor(self._unit)

    @property
    def fit_deriv(self):
        """Derivatives to the parameters, or None where a tie would make them wrong."""
        return None if self.has_tied else self._fit_deriv

    def _fit_deriv(self, x, *parameters):
        slopes = self._slopes(self._found_at(x, parameters), np.size(x))
        out, scale = np.zeros((len(parameters), np.size(x))), canonical_factor(self._unit)
        for plan, own in zip(self._plan, slopes, strict=True):
            for (place, factor), slope in zip(plan, own, strict=True):
                if place is not None:
                    out[place] = slope * (factor / scale)
        return out

    def _found_at(self, x, parameters):
        """Return what is made of an input and values; a fitter asks twice at the same point."""
        x = x.to_value(self._input_unit) if isinstance(x, u.Quantity) else np.asarray(x)
        x = x.ravel()
        at, place, known, found = self._memo.get("point", (None, None, None, None))
        # as np.array_equal, in a fifth of its time
        if at is None or at.shape != x.shape or not (at == x).all():
            at, place, known = np.array(x, dtype=float), self._located(x), None
        # astropy calls with arrays of one, with or without unit, fitters with numbers
        numbers = [getattr(value, "value", value) for value in parameters]
        numbers = [value.item() if hasattr(value, "item") else value for value in numbers]
        # arrays are no parameters of the curve, and may be others next time
        if self._several or known != numbers:
            values = [
                [
                    factor * (getattr(optic, key).value if place is None else numbers[place])
                    for key, (place, factor) in zip(self._names(optic), plan, strict=True)
                ]
                for optic, plan in zip(self._optics, self._plan, strict=True)
            ]
            found = self._found(place, values)
            # all at once: threads may share a curve
            self._memo["point"] = at, place, numbers, found
        return found

    def _values_at(self, wavelength, values):
        """Return the values of each optic at the wavelengths, where some have several."""
        if not self._several:
            return values
        found = []
        for optic, own in zip(self._optics, values, strict=True):
            # the curve of a law leaves theta out
            theta = optic.canonical_values()[: len(optic.param_names) - len(own)]
            full = optic.values_at(wavelength, [np.asarray(value) for value in (*theta, *own)])
            found.append(full[len(theta) :])
        return found


class LawCurve(Curve):
    """A law in wavelength of one optic, such as its retardance, or one of its parameters."""

    def __init__(self, chain, optics, law):
        self._law = law
        super().__init__(chain, optics, u.um, _laws(optics[0])[law])

    def _names(self, optic):
        # a law is that of the optic in its own frame
        return optic.own_names

    def _located(self, x):
        return x, self._optics[0]._dispersion_at(x)

    def _found(self, place, values):
        (optic,), (x, dispersion) = self._optics, place
        (own,) = self._values_at(x, values)
        if self._law in optic._laws:
            return optic._law(self._law, dispersion, *own)
        slopes = [float(key == self._law) for key in optic.own_names]
        return own[optic.own_names.index(self._law)], slopes

    def _values(self, found, size):
        return found[0] + np.zeros(size)

    def _slopes(self, found, size):
        return [found[1]]


class LightCurve(Curve):
    """
    What comes out of optics: an element of their Mueller matrix, or an observable of both beams.

    All that light can do is of shape (k, n): k frames per datum, n inputs of the curve.
    """

    def __init__(self, chain, optics, element, observable, against, wavelength, positions):
        self._element, self._observable, self._against = element, observable, against
        self._frames = getattr(observable, "frames_per_datum", 1)
        self._wavelength = None if wavelength is None else length_to_um(wavelength)
        self._positions = {
            stage: finite_position(value, stage)[..., None] for stage, value in positions.items()
        }
        self._check(optics)
        unit = u.um if against == "wavelength" else None if against in COORDINATES else u.deg
        super().__init__(chain, optics, unit)

    def _check(self, optics):
        stages = dict.fromkeys(optic.stage for optic in optics if optic.stage)
        for stage in {self._against, *self._positions} - {"wavelength"}:
            if stage not in stages:
                raise ChainError(f"no stage {stage!r}; there are {', '.join(stages) or 'none'}")
        for stage, position in self._positions.items():
            if position.shape not in ((1,), (self._frames, 1)):
                raise ParameterError(
                    f"{stage} has shape {position.shape[:-1]}; allowed are one position and one "
                    f"for each frame of a datum, {self._frames}"
                )
        if (self._against == "wavelength") and self._wavelength is not None:
            raise ParameterError("a curve against wavelength is at no single wavelength")
        if np.ndim(self._wavelength):
            raise ParameterError("a curve against a stage is at one wavelength")
        if self._observable is not None and not any(optic.splits_light for optic in optics):
            raise ChainError("the chain has no beam splitter, so it has no such observable")

    def _take(self, optics):
        super()._take(optics)
        # an observable needs the optics of either beam
        self._arms = [optics]
        if self._observable is not None:
            self._arms = [[optic.of_beam(beam) for optic in optics] for beam in ("right", "left")]

    def _located(self, x):
        wavelength, positions = self._wavelength, dict(self._positions)
        if self._against == "wavelength":
            wavelength = x
        else:
            # what is given of this stage is added
            positions[self._against] = positions.get(self._against, 0.0) + (
                x * canonical_factor(self._input_unit)
            )
        shifts = [positions.get(optic.stage, optic._position) for optic in self._optics]
        return wavelength, [
            (optic._dispersion_at(wavelength), optic.stage_sign * np.atleast_2d(shift))
            for optic, shift in zip(self._optics, shifts, strict=True)
        ]

    def _found(self, place, values):
        """Return of each beam the light that leaves it, and what happens on the way."""
        return [self._beam(arm, place, values) for arm in self._arms]

    def _beam(self, arm, place, values):
        wavelength, places = place
        steps, light = [], np.eye(4)[self._element[1]]
        values = self._values_at(wavelength, values)
        for optic, (dispersion, shift), (theta, *own) in zip(arm, places, values, strict=True):
            known = *optic._moved(dispersion, theta, shift), own
            matrix = optic._oriented(*known)
            steps.append((optic, matrix, light, known))
            light = (matrix @ light[..., None])[..., 0]
        return light, steps

    def _values(self, beams, size):
        found = [self._flux(light, size) for light, _ in beams]
        return found[0] if self._observable is None else self._observable.evaluate(*found)[0]

    def _flux(self, light, size):
        """Return what is measured of the light, (k, 1, n), as observables take it."""
        shape, flux = (self._frames, size), light[..., self._element[0]]
        return (flux if flux.shape == shape else np.broadcast_to(flux, shape))[:, None]

    def _slopes(self, beams, size):
        if self._observable is None:
            return self._slopes_of_beam(beams[0][1])
        found = [self._flux(light, size) for light, _ in beams]
        weights = [weight[:, 0] for weight in self._observable.derivative(*found)]
        parts = [self._slopes_of_beam(steps) for _, steps in beams]
        return [
            [
                sum(np.sum(w * slope, axis=0) for w, slope in zip(weights, slopes, strict=True))
                for slopes in zip(*own, strict=True)
            ]
            for own in zip(*parts, strict=True)
        ]

    def _slopes_of_beam(self, steps):
        """Return the derivatives of the flux of a beam, (k, n)."""
        # what the optics downstream make of the light, (..., 1, 4)
        row, found = np.eye(4)[self._element[0], None], []
        for optic, matrix, light, known in reversed(steps):
            slopes = optic._oriented_derivatives(matrix, *known)
            found.append([(row @ slope @ light[..., None])[..., 0, 0] for slope in slopes])
            row = row @ matrix
        return found[::-1]
