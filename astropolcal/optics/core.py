# Licensed under a 3-clause BSD style license - see LICENSE
"""
What every optic is: an astropy model that takes light and gives light.

An optic's inputs and outputs are the light, ``wavelength, I, Q, U, V``. What belongs to the optic
is a parameter with unit, bounds and description. Its orientation is ``theta``, the installed angle
that a calibration finds, plus the position of the stage named by ``mount``, which comes from each
frame's header and is never a parameter.
"""

import inspect
from abc import abstractmethod
from copy import copy
from functools import reduce
from operator import or_

import astropy.units as u
import numpy as np
from astropy.modeling import CompoundModel, FittableModel, InputParameterError, Model, Parameter

from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.mueller import _rotate, _rotation_matrix, blank, rotation_generator, turn
from astropolcal.optics._modelling import (
    OpticParameter,
    OwnUnits,
    Setting,
    add_parameters,
    refuse_misspelt,
    values_text,
    with_values,
)
from astropolcal.optics.curves import curve_of
from astropolcal.optics.positions import COORDINATES, PLACES, finite_position
from astropolcal.units import canonical_factor, length_to_um, to_unit
from astropolcal.words import check_choice, did_you_mean, html

__all__ = ["Optic"]

LIGHT = ("wavelength", "I", "Q", "U", "V")

# a fit may pass a bound by so much
_ROUNDING = 1e-9


def joined(left, right):
    """Return ``left | right`` of two models as a chain."""
    return Chain("|", left, right) if isinstance(right, Model) else NotImplemented


class KeywordOnly(type(FittableModel)):
    """Keeps astropy from giving each optic an ``__init__`` with positional parameters."""

    def __init__(cls, name, bases, members, **kwargs):
        # astropy's metaclass writes an __init__ for every class whose members have none
        super().__init__(name, bases, {"__init__": cls.__init__} | members, **kwargs)
        # and its own ``|`` into every class
        cls.__or__ = joined
        for parameter in cls._parameters_.values():
            if type(parameter) is Parameter:
                parameter.__class__ = OpticParameter
                if any(isinstance(bound, u.Quantity) for bound in parameter.bounds):
                    parameter.bounds = parameter.bounds
        # those of the bases first
        cls._declared_settings = {
            key: setting
            for base in reversed(cls.__mro__)
            for key, setting in vars(base).items()
            if isinstance(setting, Setting)
        }
        # every keyword that the optic takes, with its default
        found = {}
        # theta is declared first, in the base, and is what a user gives last
        for key in (*cls.param_names[1:], "theta"):
            parameter = inspect.getattr_static(cls, key)
            unit = parameter.unit
            found[key] = parameter.default if unit is None else parameter.default * unit
        found |= {key: setting.default for key, setting in cls._declared_settings.items()}
        for base in cls.__mro__:
            if isinstance(base, KeywordOnly):
                found |= getattr(base.__init__, "__kwdefaults__", None) or {}
        kind = inspect.Parameter.KEYWORD_ONLY
        cls.__signature__ = inspect.Signature(
            [inspect.Parameter(key, kind, default=default) for key, default in found.items()]
        )


class Optic(FittableModel, metaclass=KeywordOnly):
    """
    Base of all optics: light in, light out, with a Mueller matrix.

    A subclass declares its parameters and gives `_matrix` and `_derivatives`
    on canonical floats (radian, micrometre, 1), in the optic's own frame;
    everything else (units, orientation, light, derivatives) is done here.

    Parameters
    ----------
    theta : `~astropy.units.Quantity`
        Installed orientation, counter-clockwise from vertical looking into
        the beam. Fixed by default.
    mount : str, optional
        Name of the stage that carries the optic (``"hwp"``), whose position in
        each frame is added to ``theta``; with a leading minus it is subtracted.
    name : str, optional
        Name of the optic in its chain.
    wavelength : `~astropy.units.Quantity`, optional
        Wavelengths of the parameters with one value per wavelength, increasing. At others they
        are interpolated; without them the optic is for as many wavelengths as there are values.
    **parameters : `~astropy.units.Quantity`, `~specutils.Spectrum` or float
        Values of the optic's parameters: a scalar, or one value per wavelength. A spectrum gives
        values, their wavelengths and, with an uncertainty, the ``std`` of the parameter.

    Raises
    ------
    ParameterError
        If a value has no unit, a wrong one, or is not finite; if a parameter is
        unknown or given by position.

    Notes
    -----
    The derivative and the frame convention are those of Sec. 2 of the CHARIS
    paper: an optic turned by ``theta`` is ``T(-theta) M T(theta)``.

    Examples
    --------
    A new optic is a short class; its matrix is given in its own frame:

    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropolcal.optics import Optic
    >>> class HalfWavePlate(Optic):
    ...     def _matrix(self, dispersion):
    ...         return np.diag([1.0, 1.0, -1.0, -1.0])
    ...     def _derivatives(self, dispersion):
    ...         return ()
    >>> plate = HalfWavePlate(theta=22.5 * u.deg, name="plate")
    >>> _, I, Q, U, V = plate(1.6 * u.um, 1, 1, 0, 0)
    >>> round(float(U), 6)
    1.0
    """

    n_inputs = 5
    n_outputs = 5
    # one value per wavelength is not to be broadcast by astropy against light of another shape
    standard_broadcasting = False
    #: True for an optic that turns the frame of all that follows.
    rotates_frame = False
    #: True for an optic that splits the light into two beams.
    splits_light = False
    #: True for an optic that acts on the two beams differently; it has a ``beam``.
    depends_on_beam = False
    #: True for an optic whose mount may name one of `COORDINATES`, which are not angles.
    takes_numbers = False
    # parameters that are the components of a diattenuation, or an efficiency
    _components = ()
    # laws that parameters follow, by their names, and where this copy stands for them
    _follows, _places = {}, {}

    theta = Parameter(
        default=0.0,
        unit=u.deg,
        bounds=(-180, 180),
        fixed=True,
        description="installed orientation, added to the position of the mount",
    )

    def __init__(self, *args, mount=None, name=None, wavelength=None, **kwargs):
        if args:
            raise ParameterError(
                f"{type(self).__name__} takes its parameters by keyword: {self.param_names}"
            )
        given = {key: _given(kwargs.pop(key)) for key in self.param_names if key in kwargs}
        values = {key: self._at_the_door(key, value) for key, (_, value, _) in given.items()}
        settings = {
            key: kwargs.pop(key, setting.default)
            for key, setting in self._declared_settings.items()
        }
        try:
            super().__init__(name=name, **values, **kwargs)
        except (TypeError, AttributeError, InputParameterError) as error:
            self._check_names(kwargs)
            raise ParameterError(f"{type(self).__name__}: {error}") from None
        # astropy would call the five channels x0 to x4
        self.inputs, self.outputs = LIGHT[: self.n_inputs], LIGHT
        self._mount, self._position = None, 0.0
        self.mount = mount
        for key, value in settings.items():
            setattr(self, key, value)
        for key in self.param_names if wavelength is not None else ():
            if getattr(self, key).size > 1:
                getattr(self, key).wavelength = wavelength
        self._note_spectra(given)

    def _note_spectra(self, given):
        """Keep wavelengths and standard deviations of what was given as a spectrum."""
        for key, (grid, _, std) in given.items():
            parameter = getattr(self, key)
            if grid is not None:
                parameter.wavelength = grid if parameter.shape else None
            parameter.std = None if std is None else to_unit(std, parameter.unit, f"{key}.std")

    def _check_names(self, kwargs):
        rules = ("bounds", "fixed", "tied")
        known = [*inspect.signature(type(self)).parameters, *rules, "meta"]
        for key in [*kwargs, *(name for rule in rules for name in kwargs.get(rule) or ())]:
            if key not in known:
                raise ParameterError(
                    f"{type(self).__name__}: no parameter {key!r}{did_you_mean(key, known)} (its "
                    f"parameters are {', '.join(self.param_names)})"
                )

    def _at_the_door(self, key, value):
        """Return ``value`` as a Quantity in the declared unit of parameter ``key``."""
        unit, label = self._declared(key).unit, f"{type(self).__name__}.{key}"
        number = to_unit(value, unit, label)
        if not np.all(np.isfinite(number)):
            raise ParameterError(f"{label} = {value} must be finite")
        # the only axis that a parameter may have is that of the wavelengths
        if number.ndim > 1 or number.size == 0:
            raise ParameterError(
                f"{label} has shape {number.shape}; allowed are a scalar or one value per "
                "wavelength"
            )
        return number if unit is None else number * unit

    def _declared(self, key):
        # a coefficient of a law belongs to the optic, all else to its class
        return inspect.getattr_static(type(self), key, self.__dict__.get(key))

    def __setattr__(self, attr, value):
        # astropy would adopt the unit of the value and leave the bounds behind
        if attr in self.param_names and attr in self.__dict__:
            value = self._at_the_door(attr, value)
            if np.shape(value) != self.__dict__[attr].shape:
                raise ParameterError(
                    f"{type(self).__name__}.{attr} holds values of shape "
                    f"{self.__dict__[attr].shape}, not {np.shape(value)}; "
                    f"optic.with_parameters({attr}=...) returns a copy of another shape"
                )
        else:
            refuse_misspelt(self, attr, self.param_names)
        super().__setattr__(attr, value)

    def __repr__(self):
        settings, known = self._settings(), inspect.signature(type(self)).parameters
        # name and mount last
        settings |= {key: settings.pop(key) for key in ("mount", "name")}
        words = [
            f", {key}={value!r}"
            for key, value in settings.items()
            if key not in known or value != known[key].default
        ]
        return f"<{type(self).__name__}({values_text(self)}{''.join(words)})>"

    #: Methods of the wavelength that `curve` draws, with the unit of their values; ``_law`` has
    #: value and derivatives to the parameters, canonical, by name of the law.
    _laws = {}

    def _laws_at(self, wavelength):
        """Return of each law the value and the derivatives by parameter, plain in their units."""
        dispersion, _, values = self._resolve(wavelength, None)
        factors = [canonical_factor(getattr(self, key).unit) for key in self.own_names]
        found = {}
        for name, unit in self._laws.items():
            value, slopes = self._law(name, dispersion, *values)
            own = zip(self.own_names, slopes, factors, strict=True)
            scale = canonical_factor(unit)
            found[name] = value / scale, {key: slope * f / scale for key, slope, f in own}
        return found

    def _as(self, kind, **settings):
        """Return an optic of another kind, whose theta is as free as that of this one."""
        new = kind(theta=self.theta.quantity, **settings)
        new.theta.fixed, new.theta.bounds = self.theta.fixed, self.theta.bounds
        return new

    # ---- where the optic stands ------------------------------------------

    @property
    def mount(self):
        """Name of the stage that carries the optic, or None."""
        return self._mount

    @mount.setter
    def mount(self, value):
        stage = value.removeprefix("-") if isinstance(value, str) else ""
        if value is not None and (not stage.strip() or stage.startswith("-")):
            raise ParameterError(
                f"mount = {value!r} must be None or the name of a stage, with or without "
                "one leading minus"
            )
        if stage in COORDINATES and (not self.takes_numbers or stage in PLACES):
            raise ParameterError(
                f"{type(self).__name__}: mount = {value!r} is a number, not the angle of a stage"
            )
        if (stage in COORDINATES) != (self.stage in COORDINATES):
            # what was an angle is no number
            self._position = 0.0
        self._mount = value

    @property
    def stage(self):
        """Name of the stage without its sign, or None."""
        return self._mount.removeprefix("-") if self._mount else None

    @property
    def stage_sign(self):
        """Plus one, or minus one where ``mount`` starts with a minus."""
        return -1.0 if self._mount and self._mount.startswith("-") else 1.0

    @property
    def position(self):
        """Position of the stage at which this copy of the optic stands."""
        return self._position * (u.one if self.stage in COORDINATES else u.rad)

    @position.setter
    def position(self, value):
        self._position = finite_position(value, "position", self.stage)
        self._places = self._places_at(value)

    def _places_at(self, position):
        """Return where the inputs of laws stand, the stage of the optic at a position, if any."""
        if position is None or not self._follows:
            return self._places
        return self._places | {self.stage: finite_position(position, "position", self.stage)}

    # ---- values on canonical floats ---------------------------------------

    def canonical_values(self):
        """
        Return the parameter values as canonical floats (radian, micrometre or 1), ``theta`` first.

        Each has shape () or (n_wavelengths,). A parameter that was given another unit without the
        optic raises a ParameterError.
        """
        values = []
        for key in self.param_names:
            parameter = getattr(self, key)
            self._check_unit(key, parameter.unit)
            value = np.asarray(parameter.value)
            if not np.isfinite(value).all():
                raise ParameterError(f"{self._label}.{key} = {value} must be finite")
            values.append(value * canonical_factor(parameter.unit))
        where = [self.param_names.index(key) for key in self._components]
        length = np.sqrt(sum(values[i] ** 2 for i in where)) if where else 0.0
        # such a diattenuation has no Mueller matrix
        if np.any(length > 1 + _ROUNDING):
            what = self._components[0] if len(where) == 1 else "diattenuation"
            raise ParameterError(
                f"{self._label}: the {what} is {np.max(length):.10g}; allowed is 1 at most"
            )
        return values

    @property
    def _label(self):
        """What messages call the optic."""
        return self.name or type(self).__name__

    def _check_unit(self, key, unit):
        # a fitter may leave a parameter behind without its unit
        if unit is not None and unit != self._declared(key).unit:
            raise ParameterError(
                f"{self._label}.{key} is in {unit}, but its "
                f"bounds are in {self._declared(key).unit}; set optic.{key} = value * unit"
            )

    def of_beam(self, beam):
        """Return a copy that follows a beam; the optic itself if it has none."""
        if not hasattr(self, "beam"):
            return self
        new = self.copy()
        new.beam = beam
        return new

    @property
    def own_names(self):
        """Names of the parameters without ``theta`` and coefficients of laws."""
        return tuple(key for key in type(self).param_names if key != "theta")

    def _dispersion(self, wavelength):
        """Return what `_matrix` needs of the wavelength (um); computed once in a fit."""
        return wavelength

    @abstractmethod
    def _matrix(self, dispersion, *values):
        """Return the Mueller matrix in the optic's own frame, (..., 4, 4)."""

    @abstractmethod
    def _derivatives(self, dispersion, *values):
        """Return the derivatives of `_matrix`, one array (..., 4, 4) a value."""

    # ---- what the user sees ------------------------------------------------

    def mueller(self, wavelength=None, position=None):
        """
        Return the Mueller matrix of the optic where it stands.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`, optional
            Scalar or shape (n_wavelengths,); may be left out where no
            parameter and no law depends on it.
        position : `~astropy.units.Quantity`, optional
            Position of the stage, broadcastable against the wavelengths;
            by default the optic's own ``position``.

        Returns
        -------
        `~numpy.ndarray`
            Shape (..., 4, 4), ``T(-theta) M T(theta)``.

        Raises
        ------
        ParameterError, WavelengthRangeError
            If a wavelength is needed and missing, or out of a law's range.
        """
        return self._oriented(*self._resolve(wavelength, position))

    def mueller_derivatives(self, wavelength=None, position=None):
        """
        Return the derivative of the Mueller matrix to every parameter.

        Parameters
        ----------
        wavelength, position : `~astropy.units.Quantity`, optional
            As in `mueller`.

        Returns
        -------
        dict of str to `~astropy.units.Quantity`
            Parameter name to derivative, shape (..., 4, 4), in one over the parameter's unit.

        Raises
        ------
        ParameterError, WavelengthRangeError
            As `mueller`.
        """
        found = self._resolve(wavelength, position)
        rates = self._rates_at(wavelength, self._places_at(position))
        derivatives = self._oriented_derivatives(self._oriented(*found), *found, rates)
        return {
            key: self._per_unit(key, value)
            for key, value in zip(self.param_names, derivatives, strict=True)
        }

    def _per_unit(self, key, derivative):
        """Turn a derivative per canonical unit into one per the parameter's unit."""
        unit = self._declared(key).unit
        inverse = u.dimensionless_unscaled if unit is None else unit**-1
        return derivative * canonical_factor(unit) * inverse

    def _resolve(self, wavelength, position, parameters=None, places=None):
        """Bring wavelength, orientation and values to canonical floats, with what laws add."""
        lam, shift, values = self._read(wavelength, position, parameters)
        places = self._places_at(position) if places is None else places
        values = self._followed(lam, places, values)
        return (*self._moved(self._dispersion_at(lam), values[0], shift), values[1:])

    # ---- laws that parameters follow ----------------------------------------

    def _coefficients(self, values):
        """Yield of each law the place of its parameter, the law and the values of coefficients."""
        names = type(self).param_names
        start = len(names)
        for key, law in self._follows.items():
            yield names.index(key), law, values[start : start + law.size]
            start += law.size

    def _followed(self, lam, places, values):
        """Return the values without coefficients, with what laws add where their inputs stand."""
        own = list(values[: len(type(self).param_names)])
        for i, law, coefficients in self._coefficients(values):
            if law.stands(lam, places):
                own[i] = own[i] + law.value(lam, places, coefficients)
        return own

    def _rates_at(self, wavelength, places):
        """Return of each coefficient the place of its parameter, and by how much it moves it."""
        if not self._follows:
            return ()
        lam, _, values = self._read(wavelength, None, None)
        return self._rates(lam, places, values)

    def _rates(self, lam, places, values):
        return [
            (i, law.rate(lam, places, coefficients, k) if law.stands(lam, places) else 0.0)
            for i, law, coefficients in self._coefficients(values)
            for k in range(law.size)
        ]

    def _follow(self, key, law, coefficients):
        """Let a parameter follow a law, whose coefficients become parameters of this optic."""
        if key not in type(self).param_names or key in self._follows:
            reason = "follows a law already; add the models" if key in self._follows else "is none"
            raise ParameterError(f"{self._label}.{key} {reason}")
        laws, own = self._follows | {key: law}, type(self).param_names
        # in the order of the parameters, whichever came first
        self._follows = {name: laws[name] for name in own if name in laws}
        more = (name for key, law in self._follows.items() for name in law.names(key))
        found = dict(zip(law.names(key), coefficients, strict=True))
        add_parameters(self, found, (*own, *more))

    def _dispersion_at(self, wavelength):
        """Return the dispersion, or None without a wavelength where none is needed."""
        if wavelength is not None and not np.all((wavelength > 0) & np.isfinite(wavelength)):
            raise ParameterError(f"wavelength = {wavelength} um must be positive and finite")
        # only a law needs the wavelength; a constant matrix is the same at all
        if wavelength is None and type(self)._dispersion is not Optic._dispersion:
            raise ParameterError(f"{type(self).__name__} depends on wavelength: give one")
        return None if wavelength is None else self._dispersion(wavelength)

    def _read(self, wavelength, position, parameters):
        values = self.canonical_values() if parameters is None else parameters
        lam = None if wavelength is None else length_to_um(wavelength)
        values = self.values_at(lam, values)
        turned = self._position
        if position is not None:
            turned = finite_position(position, "position", self.stage)
        try:
            np.broadcast_shapes(np.shape(lam), np.shape(turned))
        except ValueError:
            raise ParameterError(
                f"positions of shape {np.shape(turned)} do not broadcast against wavelengths of "
                f"shape {np.shape(lam)}; give the positions the shape (n_frames, 1)"
            ) from None
        return lam, self.stage_sign * turned, values

    def _moved(self, dispersion, angle, shift):
        """Return what the matrix needs, and the orientation, once the stage has moved."""
        return dispersion, angle + shift

    def values_at(self, lam, values):
        """Return canonical values at wavelengths (um), where they are known."""
        found = []
        for key, value in zip(self.param_names, values, strict=True):
            value = getattr(self, key).at(lam, value)
            # wavelengths are the last axis; a single value holds at all of them
            if value.size > 1 and (lam is None or np.shape(lam)[-1:] != value.shape[-1:]):
                count = 0 if lam is None else np.size(lam)
                raise ParameterError(
                    f"{self._label}.{key} has {value.size} values, one per "
                    f"wavelength, but {count} wavelengths were given"
                )
            found.append(value)
        return found

    def _oriented(self, dispersion, angle, values):
        matrix = self._matrix(dispersion, *values)
        return _rotation_matrix(angle) if self.rotates_frame else _rotate(matrix, angle)

    def _oriented_derivatives(self, matrix, dispersion, angle, values, rates=()):
        """Return those of `_oriented` to theta, then to each other parameter and coefficient."""
        # a rotator of the frame is T(theta) alone, with no T(-theta) behind it
        found = [turn(matrix) if self.rotates_frame else rotation_generator(matrix)]
        found += [_rotate(slope, angle) for slope in self._derivatives(dispersion, *values)]
        return found + [found[i] * np.asarray(rate)[..., None, None] for i, rate in rates]

    @property
    def input_units(self):
        """Micrometre of the wavelength, which is what a fitter hands over without a unit."""
        return {"wavelength": u.um} | dict.fromkeys(self.inputs[1:])

    def _parameter_units_for_data_units(self, input_units, output_units):
        # for compound models of astropy; a `Chain` has its own way
        return {key: unit for key in self.param_names if (unit := self._declared(key).unit)}

    def without_units_for_data(self, **data):
        """Raise, as no optic alone is what a fitter takes."""
        refuse_light(self)

    def prepare_inputs(self, wavelength, *light, **kwargs):
        """Return what `evaluate` takes, as astropy does; refuse a wavelength without unit."""
        length_to_um(wavelength)
        return super().prepare_inputs(wavelength, *light, **kwargs)

    def evaluate(self, wavelength, I, Q, U, V, *parameters):  # noqa: E741
        """
        Return ``wavelength`` and the Stokes parameters downstream of the optic.

        Without units wavelengths are in micrometre and parameters in their own units.
        """
        return wavelength, *self._light_behind(wavelength, (I, Q, U, V), parameters)

    def _light_behind(self, wavelength, light, parameters):
        values = []
        for key, value in zip(self.param_names, parameters, strict=True):
            if isinstance(value, u.Quantity):
                self._check_unit(key, value.unit)
            number = np.asarray(getattr(value, "value", value))
            # a model of astropy is a set of one model, whose axis it adds in a call
            number = number[0] if number.ndim and number.shape[0] == 1 else number
            values.append(np.asarray(number) * canonical_factor(self._declared(key).unit))
        # elements first, (4, 4, ...), so that rows multiply the channels of the light
        matrix = np.moveaxis(
            self._oriented(*self._resolve(u.Quantity(wavelength, u.um), None, values)),
            (-2, -1),
            (0, 1),
        )
        # astropy gives the outputs of scalar inputs back as scalars
        if matrix[0, 0].size > 1 and all(np.size(x) == 1 for x in (wavelength, *light)):
            raise ParameterError(
                f"{self._label} stands at {matrix[0, 0].size} positions: "
                f"give light of shape {matrix[0, 0].shape}"
            )
        return [sum(m * s for m, s in zip(row, light, strict=True)) for row in matrix]

    @property
    def inverse(self):
        """
        What gives the light upstream of the optic from that downstream of it, at present values.

        It raises NotImplementedError where the light cannot be recovered from what is left of
        it, and when it is evaluated a ParameterError if that is so at a wavelength.
        """
        try:
            matrix = self.mueller()
        except ParameterError:  # it depends on the wavelength
            matrix = np.eye(4)
        if self.n_inputs < len(LIGHT) or _singular(matrix):
            raise NotImplementedError(f"the Mueller matrix of {self!r} has no inverse")
        return Inverse(self)

    def curve(self, what, element=None, *, against="wavelength", wavelength=None, **positions):
        """
        Return a model of one input and one output that draws what the optic does.

        Parameters
        ----------
        what : str or Observable
            ``"mueller"``, an element of the Mueller matrix; ``"I"``, ``"Q"``, ``"U"`` or ``"V"`` of
            what unpolarized light of intensity one becomes; an
            `~astropolcal.observations.Observable` where there is a beam splitter; of a single
            optic also a method of the wavelength, such as ``"retardance"``, or a parameter.
        element : tuple of int, optional
            Row and column of the element.
        against : str
            ``"wavelength"``, or the stage whose position is the input.
        wavelength : `~astropy.units.Quantity`, optional
            The one wavelength of a curve against a stage.
        **positions : `~astropy.units.Quantity`
            Positions of other stages, by default those at which the optics stand. One position
            or, for an observable of several frames, one for each; those of the stage ``against``
            are added to the input.

        Returns
        -------
        `~astropy.modeling.FittableModel`
            Its parameters are the same objects as those of the optics, of a chain by
            ``name_parameter``; those with one value per wavelength are left out. After a fit
            the result has copies of the optics, as its ``chain``.

        Raises
        ------
        ParameterError, ChainError
            If there is no such curve.

        Examples
        --------
        The thicknesses of a plate whose retardance was measured:

        >>> import astropy.units as u
        >>> import numpy as np
        >>> from astropy.modeling.fitting import TRFLSQFitter
        >>> from astropolcal.optics import TwoLayerWaveplate
        >>> wavelength = np.linspace(1.1, 2.4, 9) * u.um
        >>> measured = TwoLayerWaveplate(w_sio2=1.65 * u.mm).retardance(wavelength)
        >>> curve = TwoLayerWaveplate().curve("retardance")
        >>> found = TRFLSQFitter()(curve, wavelength, measured)
        >>> found.w_sio2.quantity.round(4)
        <Quantity 1.65 mm>
        """
        return curve_of(self, [self], what, element, against, wavelength, **positions)

    def with_parameters(self, **values):
        """
        Return a copy with other values; shapes may change (scalar to per wavelength).

        Parameters
        ----------
        **values : `~astropy.units.Quantity` or float
            New values by parameter name.

        Returns
        -------
        Optic
            Of the same class, name, mount, position, bounds and fixed flags.

        Raises
        ------
        ParameterError
            If a name or a value does not fit.
        """
        kind = f"parameter of {type(self).__name__}"
        for key in values:
            check_choice(kind, key, self.param_names, ParameterError)
        current = {}
        # astropy would take a value in another unit without its bounds
        for key in set(self.param_names) - set(values):
            self._check_unit(key, getattr(self, key).unit)
            current[key] = getattr(self, key).value * (self._declared(key).unit or 1)
        given = {key: _given((current | values)[key]) for key in self.param_names}
        checked = (self._at_the_door(key, value) for key, (_, value, _) in given.items())
        units = [self._declared(key).unit for key in given]
        # a copy, which keeps all else that the class of a user may hold
        new = with_values(self, [getattr(x, "value", x) for x in checked], units)
        for key in given:
            if getattr(new, key).shape != getattr(self, key).shape:
                getattr(new, key).grid = None
        new._note_spectra({key: given[key] for key in values})
        return new

    def resampled(self, wavelength):
        """
        Return a copy with the values per wavelength interpolated at other wavelengths.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Increasing, shape (n_wavelengths,), within those of the values.

        Returns
        -------
        Optic
            Its ``std`` are interpolated too. specutils resamples spectra in other ways.

        Raises
        ------
        WavelengthRangeError, ParameterError
            If the values are not known at a wavelength, or nobody has said at which they are.
        """
        grid = np.atleast_1d(length_to_um(wavelength))
        several = [key for key in self.param_names if getattr(self, key).size > 1]
        values, stds = {}, {}
        for key in several:
            parameter = getattr(self, key)
            if parameter.grid is None:
                raise ParameterError(f"{key}: its wavelengths are not known; set {key}.wavelength")
            values[key] = parameter.at(grid, parameter.value) * (parameter.unit or u.one)
            stds[key] = None if parameter.std is None else parameter.at(grid, parameter.std)
        new = self.with_parameters(**values)
        for key in several:
            getattr(new, key).wavelength = grid * u.um
            getattr(new, key).std = stds[key]
        return new

    def loosened(self, wavelength):
        """Return the optic with one value per wavelength for its law, or itself without one."""
        return self

    def _settings(self):
        """Return the keyword arguments, other than parameters, that rebuild the optic."""
        own = {key: getattr(self, key) for key in self._declared_settings}
        return {"name": self.name, "mount": self.mount} | own

    def fingerprint(self):
        """Return plain texts that are others where the same values would be another optic."""
        own = self._settings().items()
        own = [f"{key} = {value}" for key, value in own if isinstance(value, (str, int, float))]
        laws = [f"{key}: {law.fingerprint}" for key, law in self._follows.items()]
        return [type(self).__name__, *own, *laws]


class _LinearOptic(Optic):
    """An optic whose matrix is a constant, with elements in proportion to its parameters."""

    _constant = np.zeros((4, 4))
    # for each parameter a factor, and rows and columns of the elements that it adds to
    _elements = ()

    def _matrix(self, dispersion, *values):
        if not values:
            return self._constant
        out = np.empty((*np.broadcast(*values).shape, 4, 4))
        out[...] = self._constant
        for value, (factor, places) in zip(values, self._elements, strict=True):
            change = factor * value
            for row, column in places:
                out[..., row, column] += change
        return out

    def _derivatives(self, dispersion, *values):
        slopes = []
        for factor, places in self._elements:
            out = blank(*values)
            for row, column in places:
                out[..., row, column] = factor
            slopes.append(out)
        return tuple(slopes)


class Inverse(FittableModel):
    """The model that undoes an optic; it has no parameters of its own."""

    n_inputs = n_outputs = 5
    standard_broadcasting = False

    def __init__(self, optic):
        super().__init__(name=optic.name)
        self.inputs = self.outputs = LIGHT
        self._optic = optic.copy()

    @property
    def inverse(self):
        """The optic."""
        return self._optic.copy()

    def evaluate(self, wavelength, *light):
        """Return ``wavelength`` and the Stokes parameters before the optic."""
        matrix = self._optic.mueller(u.Quantity(wavelength, u.um))
        if _singular(matrix):
            raise ParameterError(f"the Mueller matrix of {self._optic!r} has no inverse")
        rows = np.moveaxis(np.linalg.inv(matrix), (-2, -1), (0, 1))
        return wavelength, *(sum(m * s for m, s in zip(row, light, strict=True)) for row in rows)


Inverse.__or__ = joined


def _given(value):
    """Return wavelengths, increasing, values and standard deviations of a spectrum.

    Of anything else it is the value, between None and None.
    """
    if not hasattr(value, "spectral_axis"):
        return None, value, None
    from astropy.nddata import StdDevUncertainty

    spectrum = value
    wavelength = u.Quantity(spectrum.spectral_axis).to(u.um, u.spectral())
    order, std = np.argsort(wavelength), spectrum.uncertainty
    if spectrum.mask is not None and np.any(spectrum.mask):
        raise ParameterError("a spectrum with masked values; cut or resample it first")
    if std is not None:
        std = u.Quantity(std.represent_as(StdDevUncertainty).quantity)[order]
    return wavelength[order], u.Quantity(spectrum.flux)[order], std


def with_value(parameter, value):
    """Return a coefficient of a law with another value, perhaps of another shape."""
    new = copy(parameter)
    new._default = new.value = to_unit(value, parameter.unit, parameter.name)
    return new


def refuse_light(model):
    """Refuse to fit a model that takes or gives light; astropy would mix data and wavelengths."""
    if (model.n_inputs, model.n_outputs) != (1, 1):
        raise ParameterError(
            f"a model of {model.n_inputs} inputs and {model.n_outputs} outputs; fitters take one "
            "of 1 and 1, such as Light(Q=1) | optic | Mapping((2,), n_inputs=5)"
        )


def _singular(matrix):
    return np.any(np.linalg.cond(matrix) > 1e12)


# ---- chains --------------------------------------------------------------------------------------


class Chain(OwnUnits, CompoundModel):
    """
    What ``|`` makes of optics, and of optics and other models of astropy.

    Any of astropy's fitters takes one of one input and one output. Its parameters keep their units
    in a fit, and their values are numbers in these.
    """

    def without_units_for_data(self, **data):
        """Return the chain as a fitter takes it: itself, once data and parameters are checked."""
        for key in self.param_names:
            if np.size(getattr(self, key).value) > 1:
                raise ParameterError(
                    f"{key} has one value per wavelength, and no fitter of astropy takes a model "
                    "with such a parameter, not even a fixed one; astropolcal.calibrate does"
                )
        refuse_light(self)
        self.check_start()
        inputs = [
            data[key] if isinstance(data[key], u.Quantity) else u.Quantity(data[key], unit or u.one)
            for key, unit in (self.input_units or dict.fromkeys(self.inputs)).items()
        ]
        outcome = self(*inputs)
        key = self.outputs[0]
        given, own = (getattr(value, "unit", u.one) for value in (data[key], outcome))
        if isinstance(data[key], u.Quantity) and given != own:
            raise ParameterError(
                f"{key} is in {given}, but the chain gives {str(own) or 'plain numbers'}"
            )
        return self

    def __setattr__(self, attr, value):
        names = self.__dict__.get("_param_names") or ()
        if attr in names:
            # the optic checks value and unit
            index, key = self._param_map[attr]
            setattr(self._leaflist[index], key, value)
        else:
            refuse_misspelt(self, attr, names)
            super().__setattr__(attr, value)

    def __iter__(self):
        return iter(self._leaflist)

    def _repr_html_(self):
        from astropy.table import Table

        rows = [
            (i, m.name or "", type(m).__name__, getattr(m, "mount", None) or "", values_text(m))
            for i, m in enumerate(self)
        ]
        names = ("place", "name", "kind", "mount", "parameters")
        return html(" | ".join(row[1] or row[2] for row in rows), Table(rows=rows, names=names))

    def curve(self, what, element=None, *, against="wavelength", wavelength=None, **positions):
        """Return a model of one input that draws what the chain does; see `Optic.curve`."""
        return curve_of(self, list(self), what, element, against, wavelength, **positions)

    def __getitem__(self, index):
        if isinstance(index, str) and index not in self.submodel_names:
            known = ", ".join(self.submodel_names)
            near = did_you_mean(index, self.submodel_names)
            raise ChainError(f"no optic {index!r} in the chain; it has {known}{near}")
        if not isinstance(index, slice):
            return super().__getitem__(index)
        # astropy finds only what is one branch of its tree
        models = self._leaflist[self._whole(index)]
        if index.step not in (None, 1) or not models:
            raise ChainError(f"no optics at {index} of a chain of {len(self._leaflist)}")
        return reduce(or_, models)

    def replace_submodel(self, name, model):
        """Return a chain with another model in place of that of a name."""
        # the tree that astropy would make is no chain
        self[name]
        return reduce(or_, [model if leaf.name == name else leaf for leaf in self])

    def _whole(self, index):
        """Return a slice by number; a name as its stop is the last optic, as astropy has it."""
        start, stop = (
            self._str_index_to_int(end) if isinstance(end, str) else end
            for end in (index.start, index.stop)
        )
        return slice(start, stop + 1 if isinstance(index.stop, str) else stop)


Chain.__or__ = joined
