# Licensed under a 3-clause BSD style license - see LICENSE
"""
How our models differ from those of astropy: keywords, settings, units, chains.

Nothing else in the package touches what `astropy.modeling` keeps private. Copies of measurements do
(the dictionaries of models), because every fitter makes one. Chains do, because a fitter asks every
model of a compound for its units, and astropy's ``Mapping`` has no answer. Bounds and ties do,
because astropy drops their units.
"""

from collections import defaultdict
from copy import copy
from types import SimpleNamespace

import astropy.units as u
import numpy as np
from astropy.modeling import FittableModel, Parameter
from astropy.modeling.utils import _ConstraintsDict

from astropolcal.exceptions import ParameterError
from astropolcal.units import check_range, length_to_um, to_unit
from astropolcal.words import did_you_mean

# by how much two wavelengths may differ and be the same, as in tables of observations
_SAME = 1e-5


class Setting:
    """
    A keyword of an optic other than its parameters, with a default, checked whenever it is set.

    ``check(value, name)`` returns what is kept, of a setting ``beam`` in ``_beam``, or raises.
    """

    def __init__(self, default, check, doc):
        self.default, self.check, self.__doc__ = default, check, doc

    def __set_name__(self, owner, name):
        self.name = name

    def __get__(self, optic, owner=None):
        return self if optic is None else optic.__dict__[f"_{self.name}"]

    def __set__(self, optic, value):
        checked = self.check(value, f"{type(optic).__name__}.{self.name}")
        optic.__dict__[f"_{self.name}"] = checked


class FrozenNormal:
    """A frozen normal distribution as those of `scipy.stats`, imported where more is asked of it.

    The import takes longer than many a fit.
    """

    dist = SimpleNamespace(name="norm")

    def __init__(self, mean, std):
        self.args, self.kwds = (mean, std), {}

    def __getattr__(self, name):
        if name.startswith("_"):
            raise AttributeError(name)
        from scipy.stats import norm

        return getattr(norm(*self.args), name)

    def mean(self):
        """Return the mean."""
        return 1.0 * self.args[0]

    def std(self):
        """Return the standard deviation."""
        return 1.0 * self.args[1]

    def support(self):
        """Return where the density is not zero, NaN for a standard deviation that cannot be."""
        end = np.where(self.std() > 0, np.inf, np.nan)
        return self.mean() - end, self.mean() + end

    def logpdf(self, value):
        """Return the logarithm of the density at values."""
        away = (value - self.mean()) / self.std()
        return -0.5 * away**2 - np.log(np.sqrt(2 * np.pi) * self.std())


def phase(description):
    """Return the parameter of a retarder that is a phase, zero at first."""
    return Parameter(default=0.0, unit=u.deg, bounds=(-360, 360), description=description)


class OpticParameter(Parameter):
    """A parameter that converts bounds to its unit, and knows the wavelengths of its values."""

    #: Wavelengths of its values in micrometre, or None where nobody has said.
    grid = None

    def __delete__(self, model):
        # with it, tables of attributes in a documentation show the description
        raise AttributeError(f"parameter {self.name} cannot be deleted")

    @property
    def wavelength(self):
        """Wavelengths of the values of a parameter that has several; None if they are not known."""
        return None if self.grid is None else self.grid * u.um

    @wavelength.setter
    def wavelength(self, value):
        grid = None if value is None else length_to_um(value, f"wavelengths of {self.name}")
        if grid is not None and (
            grid.shape != self.shape or not (np.all(grid > 0) and np.all(np.diff(grid) > 0))
        ):
            raise ParameterError(
                f"wavelengths of {self.name} = {value}; allowed are {self.size} that increase"
            )
        self.grid = grid

    @property
    def law(self):
        """The model of astropy that it follows, in units, with present values; None without."""
        law = self.model._follows.get(self.name) if self.model else None
        if law is None:
            return None
        values = [getattr(self.model, name) for name in law.names(self.name)]
        return with_values(law.model, [p.value for p in values], law.units)

    def at(self, wavelength, values):
        """Return values of the parameter at wavelengths (um), between its own on straight lines."""
        grid = self.grid
        if grid is None or np.size(values) == 1 or wavelength is None:
            return values
        if np.shape(wavelength) == grid.shape and np.allclose(wavelength, grid, rtol=_SAME, atol=0):
            return values
        inside = check_range(wavelength, grid[0], grid[-1], self.name, _SAME)
        return np.interp(inside, grid, values)

    @Parameter.bounds.setter
    def bounds(self, value):
        label = f"bounds of {self.name}"
        plain = [to_unit(b, self.unit, label) if isinstance(b, u.Quantity) else b for b in value]
        if any(b != b for b in plain):
            raise ParameterError(f"{label} = {value}; allowed are numbers and None")
        Parameter.bounds.fset(self, [float(b) if isinstance(b, np.ndarray) else b for b in plain])

    @Parameter.quantity.setter
    def quantity(self, value):
        # astropy would adopt its unit and leave the bounds behind
        self.value = to_unit(value, self.unit, self.name)


class _Ties(_ConstraintsDict):
    """The ties of a model as a fitter calls them: it puts their values among plain numbers."""

    def __init__(self, model):
        super().__init__(model, "tied")

    def __getitem__(self, key):
        tie, parameter = super().__getitem__(key), getattr(self._model, key)

        def plain(model):
            value = tie(model)
            if getattr(value, "unit", None) is None:
                return value
            return to_unit(value, parameter.unit, f"what {parameter.name} is tied to")

        return plain if callable(tie) else tie


class LinearlyTied(OpticParameter):
    """A parameter of a measurement, which refuses a callable tie: its Jacobian is analytic."""

    @Parameter.tied.setter
    def tied(self, value):
        if callable(value):
            raise ParameterError(
                f"{self.name}: a measurement takes no callable tie; give it "
                "ties={name: Tie(source, factor, offset)}"
            )
        Parameter.tied.fset(self, value)


def refuse_misspelt(model, attr, names):
    """Refuse to set what is not an attribute of a model, but nearly a parameter of it."""
    if attr[0] == "_" or attr in model.__dict__ or hasattr(type(model), attr):
        return
    # the parameter that was meant would keep its value without a word
    near = did_you_mean(attr, names, cutoff=0.8)
    if near:
        raise ParameterError(f"{type(model).__name__}: no parameter {attr!r}{near}")


def values_text(model):
    """Return the parameters of a model with their values and units."""
    parameters = ((key, getattr(model, key)) for key in model.param_names)
    return ", ".join(
        f"{key}={np.array2string(p.value, precision=6, threshold=4)}"
        + (f" {p.unit}" if p.unit else "")
        for key, p in parameters
    )


class OwnUnits:
    """A model whose parameters keep their units in a fit; their values are numbers in these."""

    @property
    def has_bounds(self):
        """Whether a free parameter has a bound; what is fixed needs none."""
        parameters = (getattr(self, key) for key in self.param_names)
        return any(p.bounds != (None, None) and not p.fixed for p in parameters)

    @property
    def tied(self):
        """Ties by the name of their parameter, in its unit."""
        return _Ties(self)

    def with_units_from_data(self, **data):
        """Return the fitted model: itself."""
        return self

    def check_start(self):
        """Refuse values and bounds of which some fitters make others without a word."""
        for key in self.param_names:
            parameter = getattr(self, key)
            value, (low, high) = parameter.value, parameter.bounds
            if not np.isfinite(value).all():
                raise ParameterError(f"{key} = {value}; a fit starts at finite numbers")
            if not (parameter.fixed or low is None or high is None or low < high):
                raise ParameterError(f"bounds of {key} = {low}, {high}; the lower one is first")


class ScalarParameters(OwnUnits, FittableModel):
    """A model of one input and one output that is given its parameters one by one, all scalars."""

    n_inputs = 1
    n_outputs = 1
    standard_broadcasting = False
    col_fit_deriv = True
    _param_names = ()

    @property
    def param_names(self):
        """Names of the parameters."""
        return self._param_names

    def __setattr__(self, attr, value):
        refuse_misspelt(self, attr, self._param_names)
        super().__setattr__(attr, value)

    def _hold(self, parameters):
        """Take on parameters by name, once astropy has set those it knows to their defaults."""
        self._param_names = tuple(parameters)
        self.__dict__ |= parameters
        self._constraints_cache = {}
        self._param_metrics = defaultdict(dict)
        self._initialize_slices()

    @property
    def has_tied(self):
        """Whether a parameter is tied; a fitter asks before every evaluation."""
        return any(self.__dict__[name].tied for name in self._param_names)

    def _parameter_units_for_data_units(self, input_units, output_units):
        units = {name: self.__dict__[name].unit for name in self._param_names}
        return {name: unit for name, unit in units.items() if unit is not None}


def with_own_scalars(model, labels):
    """Return a copy of a model that shares everything but its scalar parameters, by their names."""
    new = model.__class__.__new__(model.__class__)
    new.__dict__.update(model.__dict__)
    # where astropy keeps values and constraints beside the parameters
    for key in ("_parameters", "_mconstraints", "_constraints_cache", "_user_inverse", "_meta"):
        if key in model.__dict__:
            new.__dict__[key] = copy(model.__dict__[key])
    for label in labels:
        parameter = copy(model.__dict__[label])
        parameter.model = new
        new.__dict__[label] = parameter
        parameter.value = float(model.__dict__[label].value)
    return new


def with_values(model, values, units=None):
    """Return a copy of a model with other values, without units or in others."""
    new = model.copy()
    units = [None] * len(values) if units is None else units
    for name, value, unit in zip(new.param_names, values, units, strict=True):
        parameter = getattr(new, name)
        parameter._unit = unit
        parameter.value = np.asarray(value, dtype=float)
    new._initialize_slices()
    return new


def add_parameters(model, parameters, names):
    """Give a model parameters of its own, by name, beside those of its class."""
    for name, parameter in parameters.items():
        model.__dict__[name] = parameter
        parameter.model = model
    model.param_names = names
    model._initialize_slices()
