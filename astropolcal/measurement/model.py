# Licensed under a 3-clause BSD style license - see LICENSE
"""
A measurement as one fittable model: index of a datum in, predicted datum out.

Every stock astropy fitter takes it: the parameters are scalars, the free parameters of the chains
in their units, and ``fit_deriv`` is analytic. Inside of the package a measurement is asked for
vectors, which are canonical: radian, micrometre or 1.
"""

import copy as copy_module
from itertools import pairwise

import astropy.units as u
import numpy as np
from astropy.modeling import FittableModel, Parameter

from astropolcal.chain import leaves
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.measurement.datasets import Dataset, as_pairs
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations.observables import default_observable, get_observable
from astropolcal.observations.reading import common_wavelengths
from astropolcal.optics._modelling import LinearlyTied, ScalarParameters, with_own_scalars
from astropolcal.units import to_unit

__all__ = ["Measurement"]

# what changes the brightness of frames by less than a hundredth of what changes it most, squared
_SEEN = 1e-4
# within so many of its errors a parameter may explain it: with one a true diattenuation of 30 % did
# not in 3 of 10 runs, with six one of 2 % explained a lamp that flickers
_ROOM = 3.0


class Measurement(ScalarParameters):
    """
    Chains and their observations as a 1-input, 1-output fittable model.

    Its parameters are the free ones of the chains, in their units, one for each value per
    wavelength. What a fitter returns has them in its `chains` too, with their ``std`` where the
    fitter works out uncertainties.

    Parameters
    ----------
    chain : Optic, `~astropy.modeling.CompoundModel` or sequence of them
        The chain of each dataset. Optics of the same name are the same optic.
    observations : Observations or sequence of Observations
        The datasets.
    observable : str or Observable, optional
        What is compared; see `astropolcal.observations.OBSERVABLES`. By default normalized double
        differences, of tables without a column ``hwp`` single ones, and of single beams the
        intensity.
    positions : sequence of dict, optional
        For each dataset the position of every stage, a Quantity or in radian, shape
        (n_frames,), or (nodes, n_frames) at the Gauss-Legendre nodes of each
        exposure; by default as the instrument that the table names reads it
        (of a star with the tracking of the half-wave plate), or the columns.
    ties : dict of str to Tie, optional
        Parameters that follow others.
    wavelength : `~astropy.units.Quantity`, optional
        Common grid for the parameters given per wavelength; by default the
        union of the observations' wavelengths.
    copy : bool
        Whether to work on copies of the chains (default).

    Raises
    ------
    ObservationError, ChainError, ParameterError
        If chains and observations do not fit together.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import simulate, half_wave_plate_cycles
    >>> chain = (optics.LinearPolarizer(name="polarizer")
    ...          | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(efficiency=0.98, name="wollaston"))
    >>> frames = half_wave_plate_cycles(derotator=[45, 90] * u.deg)
    >>> observations = simulate(chain, [1.2, 1.6] * u.um, frames, seed=1)
    >>> measurement = Measurement(chain, observations)
    >>> measurement.param_names
    ('hwp_retardance', 'wollaston_efficiency')
    >>> measurement.n_data
    16

    Any fitter of astropy takes it:

    >>> from astropy.modeling.fitting import TRFLSQFitter
    >>> fitted = TRFLSQFitter()(measurement, measurement.index, measurement.observed)
    >>> fitted.hwp_retardance.unit
    Unit("deg")
    >>> bool(fitted.chains[0]["hwp"].retardance == fitted.hwp_retardance)
    True
    """

    def __init__(
        self,
        chain,
        observations,
        *,
        observable=None,
        positions=None,
        ties=None,
        wavelength=None,
        copy=True,
        name=None,
    ):
        pairs = as_pairs(chain, observations, positions)
        if copy:
            pairs = [(item.copy(), obs, position) for item, obs, position in pairs]
        self._chains = [item for item, _, _ in pairs]
        self._chains_are_shared = self._fitted = False
        if observable is None:
            observable = default_observable([obs for _, obs, _ in pairs])
        self.observable = get_observable(observable)
        self.wavelength = common_wavelengths([obs for _, obs, _ in pairs], wavelength)
        self.free = FreeParameters(self._chains, len(self.wavelength), ties)
        self.free.check_data(self.wavelength)
        self.datasets = [
            Dataset(item, obs, self.observable, self.free, self.wavelength, position)
            for item, obs, position in pairs
        ]
        self._finish(name)

    def _finish(self, name):
        sizes = [dataset.n_data for dataset in self.datasets]
        # data vector: dataset after dataset, within each wavelength after wavelength
        edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        #: Slice of the data vector that belongs to each dataset.
        self.segments = [slice(a, b) for a, b in pairwise(edges)]
        self.n_data = int(edges[-1])
        if not self.n_data:
            raise ObservationError("no datum is left: every frame is masked or unpaired")
        self.index = np.arange(self.n_data, dtype=float)
        #: Number of residuals that priors add behind the data.
        self.n_priors = self.free.prior_residuals(self.free.start()).size
        self.observed = np.concatenate([d.observed for d in self.datasets])
        self.sigma = np.concatenate([d.sigma for d in self.datasets])
        #: Wavelength (index on the common grid) of each datum.
        self.bins = np.concatenate([d.bin_of_datum for d in self.datasets])
        #: Noise that a fit assumed of the data, a
        #: `~astropolcal.calibration.noise.weighting.Weighting`.
        self.weighting = None
        # vector, sweeps and derivatives of the last prediction: fitters, and those who ask for
        # errors after them, want data and Jacobian at the same point
        self._last = (None, None, {})
        self._param_names = tuple(self.free.labels)
        #: Factor of each parameter from its unit to the canonical one.
        self._factors = self.free.factors()
        bounds = _bounds(*(x / self._factors for x in self.free.bounds()))
        # astropy sets a parameter to its default
        start = (self.free.start() / self._factors).tolist()
        entries = zip(self._param_names, start, self.free.units, bounds, strict=True)
        for label, value, unit, bound in entries:
            parameter = LinearlyTied(name=label, default=value, unit=unit, bounds=bound)
            parameter.model = self
            self.__dict__[label] = parameter
        self.stand_at(self.free.start())
        super().__init__(name=name)

    def __setattr__(self, attr, value):
        # astropy's own way to set a parameter searches all names, for each of the 93
        parameter = self.__dict__.get(attr)
        if isinstance(parameter, Parameter) and isinstance(value, Parameter):
            self.__dict__[attr] = value
        elif isinstance(parameter, Parameter):
            parameter.value = float(to_unit(value, parameter.unit, attr))
        else:
            super().__setattr__(attr, value)

    # A fitter asks for the following again and again. Astropy looks every parameter up by name
    # in tables it builds anew; with one scalar a parameter, plain loops give the same.
    @property
    def parameters(self):
        """Values of the scalar parameters in their units, shape (n_free,)."""
        return np.array([self.__dict__[label].value for label in self._param_names], dtype=float)

    @parameters.setter
    def parameters(self, values):
        values = np.asarray(values, dtype=float).ravel()
        if values.size != len(self._param_names):
            raise ParameterError(f"{values.size} values for {len(self._param_names)} parameters")
        for label, value in zip(self._param_names, values.tolist(), strict=True):
            self.__dict__[label].value = value

    @property
    def has_fixed(self):
        """Whether a scalar parameter is fixed."""
        return any(self.__dict__[label].fixed for label in self._param_names)

    @property
    def sync_constraints(self):
        """Whether astropy reads constraints from the parameters each time; not in a fit."""
        return self.__dict__.get("_sync_constraints", True)

    @sync_constraints.setter
    def sync_constraints(self, value):
        FittableModel.sync_constraints.fset(self, value)
        # a fitter sets it last of all
        self.__dict__["_fitted"] = value

    def without_units_for_data(self, **data):
        """Return the measurement as a fitter takes it: itself, with numbers in its units."""
        self.check_start()
        unit = getattr(data[self.outputs[0]], "unit", u.one)
        if unit != u.one:
            raise ParameterError(f"the data are in {unit}; observables are plain numbers")
        return self

    def canonical(self):
        """Return a copy whose parameters are in canonical units, for fits of this package."""
        new = with_own_scalars(self, self._param_names)
        new._chains_are_shared = True
        new._factors = np.ones_like(self._factors)
        for name, bound in zip(new._param_names, _bounds(*self.free.bounds()), strict=True):
            parameter = new.__dict__[name]
            parameter._unit, parameter.bounds = None, bound
        new.stand_at(self.vector())
        return new

    def __deepcopy__(self, memo):
        # every fitter copies the model: what does not change is shared, and the chains are
        # copied when somebody looks at them
        memo[id(self)] = new = with_own_scalars(self, self._param_names)
        new._chains_are_shared = True
        self._chains_are_shared = True
        return new

    def thinned(self, most):
        """
        Return the measurement with fewer frames, and which data it keeps, bool of shape (n_data,).

        For searches that need not see them all: up to ``most`` groups of frames of each dataset,
        drawn at random, always the same ones. Free parameters and current values are the same.
        """
        chosen = [_drawn(dataset.frames.shape[0], most) for dataset in self.datasets]
        new, parts = copy_module.deepcopy(self), list(zip(self.datasets, chosen, strict=True))
        new.datasets = [
            d if len(groups) == len(d.frames) else d.thinned(chain, groups)
            for chain, (d, groups) in zip(self._chains, parts, strict=True)
        ]
        new._finish(self.name)
        # the thinned measurement starts where this one stands, not where the chains do
        new.stand_at(self.vector())
        kept = [np.isin(dataset.group_of_datum, groups) for dataset, groups in parts]
        return new, np.concatenate(kept)

    @property
    def chains(self):
        """
        The chain of each dataset.

        Those of a measurement that a fitter returns have the values of the fit; otherwise
        `put_back` writes the values into them.
        """
        if self._chains_are_shared:
            self._chains = [chain.copy() for chain in self._chains]
            self.free = self.free.of_chains(self._chains)
            self._chains_are_shared = False
        if self._fitted:
            self._fitted = False
            self.put_back()
            self.free.put_stds([self.__dict__[label].std for label in self._param_names])
        return self._chains

    # ---- evaluation ---------------------------------------------------------

    def _sweeps(self, vector):
        """Return the forward sweep of every dataset; the last one is remembered."""
        known, sweeps, _ = self._last
        if known is None or not np.array_equal(known, vector):
            sweeps = [dataset.forward(vector) for dataset in self.datasets]
            # a copy, because fitters change their vector in place
            self._last = (vector.copy(), sweeps, {})
        return sweeps

    def predict(self, vector):
        """Return all predicted data, (n_data,), for a vector of free parameters (canonical)."""
        sweeps = self._sweeps(np.asarray(vector, dtype=float).ravel())
        parts = [d.values(s) for d, s in zip(self.datasets, sweeps, strict=True)]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def of_lamp(self, vector, errors):
        """Return what all predicted data gain by the brightness of each frame, (n_data,).

        By what no free parameter explains of it, as far as its errors, (n_free,), canonical, allow:
        how bright frames are tells more of some, such as a diattenuation, than the data do.
        """
        if self.observable.name == "intensity":
            # in which the brightness is free anyway
            return np.zeros(self.n_data)
        sweeps = self._sweeps(vector)
        parts = [d.brightness(s) for d, s in zip(self.datasets, sweeps, strict=True)]
        bright, slopes = (np.concatenate(part, axis=-1) for part in zip(*parts, strict=True))
        slopes *= np.where(errors > 0, self.free.steps, 0.0)[:, None]
        room = _ROOM * errors
        held = np.divide(self.free.steps, room, out=np.zeros(room.size), where=room > 0)
        square = np.einsum("kfd,kgd->fg", slopes, slopes, optimize=True)
        square += np.diag(np.mean((bright - 1) ** 2) * held**2)
        step = np.linalg.lstsq(square, np.einsum("kfd,kd->f", slopes, bright), rcond=_SEEN)[0]
        bright = bright - np.einsum("kfd,f->kd", slopes, step)
        ends = np.cumsum([d.n_data for d in self.datasets])[:-1]
        each = zip(self.datasets, sweeps, np.split(bright, ends, axis=1), strict=True)
        return np.concatenate([dataset.of_lamp(*told) for dataset, *told in each])

    def jacobian(self, vector, among=None):
        """
        Return the derivative of all data to all free parameters, (n_free, n_data).

        Where ``among``, (n_free,), is given and False, it is not worked out, and zero.
        """
        sweeps = self._sweeps(np.asarray(vector, dtype=float).ravel())
        known, which = self._last[-1], None if among is None else among.tobytes()
        if which not in known:
            parts = [d.jacobian(s, among) for d, s in zip(self.datasets, sweeps, strict=True)]
            known[which] = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=1)
        # whoever asked may write into it
        return known[which].copy()

    def evaluate(self, x, *parameters):
        """Return the predicted data of index ``x``; after the data come the priors."""
        vector = _numbers(parameters) * self._factors
        return self._pick(self.predict(vector), x, self.free.prior_residuals, vector)

    def fit_deriv(self, x, *parameters):
        """Return the derivative of the data of index ``x``, (n_free, n_data), per unit."""
        vector = _numbers(parameters) * self._factors
        slopes = self._pick(self.jacobian(vector), x, self.free.prior_jacobian, vector)
        return slopes * self._factors[:, None]

    def _pick(self, values, x, prior, vector):
        # all data in order, without the priors: what `predict` asks for, and nothing to be picked
        if np.array_equal(x, self.index):
            return values
        # index n_data + i is the i-th residual of the priors, of observed value zero
        if self.n_priors:
            values = np.concatenate([values, prior(vector)], axis=-1)
        index = np.asarray(x)
        if np.any((index < 0) | (index >= values.shape[-1]) | (index != np.floor(index))):
            raise ObservationError(
                f"index of a datum must be a whole number below {values.shape[-1]}"
            )
        return values[..., index.astype(int)]

    def fit_arguments(self, weights=None, noise=1.0):
        """
        Return what a fitter takes: index, data and weights, with the priors as data after them.

        ``weights`` of the data may be None for equal ones, ``noise`` is the standard deviation of
        a datum of weight one, which sets how much a prior weighs against the data.
        """
        if not self.n_priors:
            return self.index, self.observed, weights
        weights = np.ones(self.n_data) if weights is None else weights
        return (
            np.arange(self.n_data + self.n_priors, dtype=float),
            np.concatenate([self.observed, np.zeros(self.n_priors)]),
            # a prior's residual is in units of its own width; times
            # the noise it is in those of a datum
            np.concatenate([weights, np.full(self.n_priors, noise)]),
        )

    # ---- results --------------------------------------------------------------

    def vector(self):
        """Return the current values of the scalar parameters, canonical, shape (n_free,)."""
        values, (there, vector) = self.parameters, self._stand
        # what was set comes back to the last digit: it may be a bound
        return vector.copy() if np.array_equal(values, there) else values * self._factors

    def stand_at(self, vector):
        """Set the scalar parameters to canonical values, shape (n_free,)."""
        vector = np.array(vector, dtype=float).ravel()
        if vector.size != len(self._param_names):
            raise ParameterError(f"{vector.size} values for {len(self._param_names)} parameters")
        self.parameters = vector / self._factors
        self._stand = self.parameters, vector

    def put_back(self, vector=None):
        """Write values (by default the current ones) into the chains and return these."""
        chains = self.chains
        self.free.put_back(self.vector() if vector is None else vector)
        self.free.put_wavelengths(self.wavelength)
        return chains

    def note_inputs(self):
        """Tell the laws that parameters follow which inputs they have in the frames."""
        chains, ends = self.chains, {}
        for dataset in self.datasets:
            for name, (low, high) in dataset.inputs().items():
                least, most = ends.get(name, (low, high))
                ends[name] = min(low, least), max(high, most)
        for leaf in (leaf for chain in chains for leaf in leaves(chain)):
            leaf._follows = {key: law.with_known(ends) for key, law in leaf._follows.items()}

    def residuals(self, vector=None):
        """Return observed minus predicted data, shape (n_data,)."""
        return self.observed - self.predict(self.vector() if vector is None else vector)


def _drawn(count, most):
    """Return which of so many groups to keep."""
    if count <= most:
        return np.arange(count)
    # drawn, not every n-th, which could hit the same plate angle each time
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _bounds(low, high):
    """Return pairs of bounds; astropy writes an open one as None."""
    low, high = (np.where(np.isfinite(x), x, None).tolist() for x in (low, high))
    return list(zip(low, high, strict=True))


def _numbers(parameters):
    """Return values as astropy hands them over, arrays of one with or without unit."""
    numbers = [getattr(value, "value", value) for value in parameters]
    return np.array(numbers, dtype=float).reshape(-1)
