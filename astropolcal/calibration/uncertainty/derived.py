# Licensed under a 3-clause BSD style license - see LICENSE
"""
Quantities that follow from a calibration, with their errors.

To first order: with g the derivative of a quantity to the parameters and C their covariance, the
variance is g C g. A quantity that moves along a direction which the data do not determine has an
infinite error, however small the change: no pseudo-inverse hides it.
"""

from dataclasses import dataclass, field, replace

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability.linearized import led
from astropolcal.calibration.system import (
    between,
    check_range,
    free_of,
    from_first_stage,
    inverse_rows,
    per_canonical,
    spread_out,
)
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.chain import (
    find_optic,
    leaves,
    system_mueller,
    system_mueller_derivatives,
    with_beam,
)
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations.reading import SAME_WAVELENGTH
from astropolcal.optics import Diattenuator, DiattenuatorRetarder, MetalMirror, PowerLawMirror
from astropolcal.units import canonical_factor, wavelengths_of

__all__ = [
    "Derived",
    "derived_data",
    "derived_efficiency",
    "derived_mueller",
    "derived_retardance",
    "derived_sky",
    "propagate",
]

# step of a central difference along a direction, in degree, micrometre or percent
_STEP = 1e-2


@dataclass
class Derived:
    """
    A quantity that follows from a calibration, with its error.

    Parameters
    ----------
    value : `~astropy.units.Quantity` or `~numpy.ndarray`
        The quantity, of any shape.
    std : `~astropy.units.Quantity` or `~numpy.ndarray`
        Standard error from the calibration, of the same shape: infinite where
        the data do not determine it; NaN where it depends on parameters at a bound
        alone, or where a calibration file does not say.
    covariance : callable
        Called without arguments, the covariance of the flattened quantity in
        squares of its unit, shape (size, size).
    open_directions : dict of str to array
        For each open direction that moves the quantity, named by its leading parameter, the change
        of the quantity for +1 degree (micrometre, percent) of that parameter.
    wavelength : `~astropy.units.Quantity`, optional
        Wavelengths of the values, where there is one value per wavelength.

    Examples
    --------
    >>> from astropolcal.calibration.uncertainty import Derived
    >>> import numpy as np
    >>> Derived(np.array([0.9]), np.array([0.01]), lambda: np.array([[1e-4]])).is_determined
    array([ True])
    """

    value: object
    std: object
    covariance: object
    open_directions: dict = field(default_factory=dict)
    wavelength: object = None

    def spectrum(self):
        """
        Return the quantity as a `~specutils.Spectrum` with standard deviations.

        What the data do not determine is masked. An optic takes a spectrum for a parameter.
        """
        if np.shape(self.value) != np.shape(self.wavelength) or np.ndim(self.value) != 1:
            raise ParameterError("a spectrum has one value at each of several wavelengths")
        from astropy.nddata import StdDevUncertainty
        from specutils import Spectrum

        return Spectrum(
            flux=u.Quantity(self.value),
            spectral_axis=self.wavelength,
            uncertainty=StdDevUncertainty(u.Quantity(self.std)),
            mask=~self.is_determined,
        )

    @property
    def is_determined(self):
        """Whether the data determine each element, a bool array of the shape of ``value``."""
        return np.isfinite(np.asarray(u.Quantity(self.std).value))

    def __str__(self):
        lines = [
            f"{np.size(self.value)} values, {int(np.sum(self.is_determined))} of them with an error"
        ]
        lines += [
            f"  - open: {name} by +1 moves them by up to {np.abs(change).max():.3g}"
            for name, change in self.open_directions.items()
        ]
        return "\n".join(lines)


def propagate(calibration, function, derivatives=None):
    """
    Return any function of the calibrated chains with its error.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    function : callable
        Takes the chain of each dataset as one argument, returns a number, an
        array or a `~astropy.units.Quantity`. Smooth near the solution.
    derivatives : callable, optional
        Takes the same; returns a dict of ``"optic.parameter"`` to the derivative of the function
        per unit of that parameter, as plain numbers of the shape of the function's value, with one
        more axis at the end for a parameter given per wavelength. Without it central differences
        are taken along the directions of the covariance.

    Returns
    -------
    Derived

    Raises
    ------
    ParameterError
        If a derivative is of a parameter that is not free, or of wrong shape.

    Examples
    --------
    >>> from astropolcal.calibration import propagate
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> ratio = propagate(cal, lambda chain: chain["hwp"].w_sio2.value / chain["hwp"].w_mgf2.value)
    >>> bool(0 < ratio.std < 1e-3)
    True
    """
    chains = [chain.copy() for chain in calibration.chains]
    free = FreeParameters(chains, len(calibration.wavelength), calibration.ties)
    value = function(*chains)
    if derivatives is not None:
        known = _slopes_of(free, derivatives(*chains), np.shape(value))
        return derive(calibration, free, value, known)
    unit = value.unit if isinstance(value, u.Quantity) else None
    start, canonical = free.start(), free.factors()

    def slope(direction):
        ends = []
        for sign in (1, -1):
            # direction is in steps, `steps` leads to declared units,
            # `canonical` on to those of the vector
            free.put_back(start + sign * _STEP * direction * axes.steps * canonical)
            end = function(*chains)
            ends.append(np.ravel(end.to_value(unit) if unit is not None else end))
        return (ends[0] - ends[1]) / (2 * _STEP)

    axes = full_covariance(calibration)._axes()
    parts = [
        np.array([slope(row) for row in rows]).reshape(len(rows), np.size(value)).T
        for rows in (axes.known, axes.open, axes.blind)
    ]
    return _package(free, axes, value, parts)


def _slopes_of(free, derivatives, shape):
    """Lay derivatives by name out over the flat vector, shape (size, n_free)."""
    size = int(np.prod(shape, dtype=int))
    slopes = np.zeros((size, free.size))
    for name, derivative in derivatives.items():
        slot, factor, _ = free.lookup(name)
        if slot is None:
            raise ParameterError(f"derivative of {name}: no such free parameter")
        expected = (*shape, slot.size) if slot.per_wavelength else shape
        if np.shape(derivative) != expected:
            raise ParameterError(
                f"derivative of {name} has shape {np.shape(derivative)}; expected is {expected}"
            )
        # a follower moves with the parameter it is tied to, in canonical units
        per_own = canonical_factor(getattr(free.values_of(name), "unit", None))
        block = np.reshape(np.asarray(derivative, dtype=float), (size, slot.size))
        slopes[:, slot.slice] += block / per_own * factor * slot.factor
    return slopes


def derive(calibration, free, value, slopes):
    """Return a quantity with its error from its derivatives per declared unit."""
    axes = full_covariance(calibration)._axes()
    return _package(free, axes, value, axes.along(slopes))


def _package(free, axes, value, along):
    """Return a quantity with its error from its slopes along the axes of the covariance."""
    shape, moved, spread = np.shape(value), {}, axes.spread(*along)
    if spread.is_open.any():
        # the basis of open directions is arbitrary; a user asks what one degree of a parameter does
        reduced, names = zip(*led(free, axes.open), strict=True)
        changes = along[1] @ axes.open @ np.array(reduced).T
        limit = 1e-5 * np.abs(changes).max()
        moved = {
            name: change.reshape(shape)
            for name, change in zip(names, changes.T, strict=True)
            if np.abs(change).max() > limit
        }
    std = spread.stds().reshape(shape)
    std = std * value.unit if isinstance(value, u.Quantity) else std
    return Derived(value, std[()], spread.covariance, moved)


# ---- ready-made quantities ----


def derived_retardance(calibration, optic, wavelength=None, dataset=0):
    r"""
    Return the retardance of an optic with its error.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    optic : str
        Name of a retarder: one that follows a law, a linear, or an elliptical one, whose total
        retardance :math:`\sqrt{\Delta_H^2+\Delta_{45}^2+\Delta_R^2}` is meant.
    wavelength : `~astropy.units.Quantity`, optional
        By default the calibration's grid; between its points, parameters given
        per wavelength are interpolated linearly.
    dataset : int
        Which of the calibration's chains.

    Returns
    -------
    Derived
        In degree, of the shape of ``wavelength``.

    Raises
    ------
    ChainError
        If there is no such optic, or it is not a retarder.
    ParameterError
        If it depends on more than the wavelength, by a law of time for instance.
    WavelengthRangeError
        If a wavelength is outside the grid of its parameters or the law's range.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration.uncertainty import derived_retardance
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> half_wave = derived_retardance(cal, "hwp", 1.65 * u.um)
    >>> bool(half_wave.std < 0.1 * u.deg)
    True
    """
    leaf = find_optic(calibration.chains[dataset], optic)
    components = retardances_of(leaf)
    if components:
        return of_optic(calibration, dataset, optic, components, wavelength)
    if not callable(getattr(leaf, "retardance", None)):
        raise ChainError(f"optic {optic!r} is a {type(leaf).__name__}, which has no retardance")
    lam = calibration.wavelength if wavelength is None else wavelengths_of(wavelength)
    _check_laws(leaf, leaf.own_names)
    return of_law(calibration, optic, "retardance", lam)


def retardances_of(leaf):
    """Return the parameters that are retardances; those of a diattenuator have no unit."""
    names = ("retardance", "horizontal", "diagonal", "circular")
    return [key for key in names if key in leaf.param_names and getattr(leaf, key).unit == u.deg]


def derived_efficiency(calibration, wavelength=None, dataset=0):
    """
    Return the modulation efficiency of the beam splitter with its error.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    wavelength : `~astropy.units.Quantity`, optional
        By default the calibration's grid; between its points the efficiency is
        interpolated linearly.
    dataset : int
        Which of the calibration's chains.

    Returns
    -------
    Derived
        Of the shape of ``wavelength``.

    Raises
    ------
    ChainError
        If no optic has an efficiency.
    ParameterError
        If it depends on more than the wavelength, by a law of time for instance.
    WavelengthRangeError
        If a wavelength is outside the grid.

    Examples
    --------
    >>> from astropolcal.calibration.uncertainty import derived_efficiency
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> derived_efficiency(cal).value.shape
    (22,)
    """
    found = [o for o in leaves(calibration.chains[dataset]) if "efficiency" in o.param_names]
    if not found:
        raise ChainError("no optic of the chain has an efficiency")
    return of_optic(calibration, dataset, found[0].name, ["efficiency"], wavelength)


def of_optic(calibration, dataset, optic, keys, wavelength=None):
    """Return one parameter of an optic, or the length of several, between the wavelengths, too."""
    leaf = find_optic(calibration.chains[dataset], optic)
    _check_laws(leaf, keys, "wavelength")
    lam = calibration.wavelength if wavelength is None else wavelengths_of(wavelength)
    grid, wanted = calibration.wavelength.to_value(u.nm), np.atleast_1d(lam.to_value(u.nm))
    # one number for all wavelengths holds anywhere
    if any(getattr(leaf, key).size > 1 or key in leaf._follows for key in keys):
        check_range(lam, calibration.wavelength)
    weights, unit = between(wanted, grid), getattr(leaf, keys[0]).unit

    def canonical(parameter):
        value = np.ravel(parameter.value) * canonical_factor(parameter.unit)
        return weights @ value if value.size > 1 else np.full(wanted.size, value[0])

    def length(*chains):
        leaf, parts = find_optic(chains[dataset], optic), []
        for key in keys:
            parts.append(canonical(getattr(leaf, key)))
            if law := leaf._follows.get(key):
                more = [canonical(getattr(leaf, name)) for name in law.names(key)]
                parts[-1] += law.value(wanted / 1000, {}, more)
        found = parts[0] if len(keys) == 1 else np.linalg.norm(parts, axis=0)
        return found.reshape(lam.shape) / canonical_factor(unit) * (1 if unit is None else unit)

    return replace(propagate(calibration, length), wavelength=lam)


def _check_laws(leaf, keys, *known):
    """Refuse parameters that follow a law of something else than what is known."""
    for key in keys:
        law = leaf._follows.get(key)
        if law and not {*law.of} <= {*known}:
            raise ParameterError(
                f"{leaf.name}.{key} follows a law of {', '.join(law.of)}; derived_mueller says "
                "what it does at some positions"
            )


def _leaf(chains, name):
    return next(leaf for chain in chains for leaf in leaves(chain) if leaf.name == name)


def of_law(calibration, optic, law, lam):
    """Return a law of an optic, with exact derivatives where it gives them."""
    leaf = _leaf(calibration.chains, optic)
    if law in leaf._laws:
        # a thickness cannot be stepped below zero, and phases of mirrors jump by a turn
        value, slopes = leaf._laws_at(lam)[law]
        slopes = {f"{optic}.{key}": slope for key, slope in slopes.items()}
        mix = between(np.atleast_1d(lam.to_value(u.nm)), calibration.wavelength.to_value(u.nm))
        found = _by_name(calibration, value * (leaf._laws[law] or u.one), slopes, -1, mix)
    else:
        found = propagate(calibration, lambda *chains: getattr(_leaf(chains, optic), law)(lam))
    return replace(found, wavelength=lam)


def derived_mueller(calibration, positions=None, wavelength=None, beam="right", dataset=0):
    """
    Return the system Mueller matrix with the error of each element.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    positions : dict of str to `~astropy.units.Quantity`, optional
        Position of every stage, scalar or shape (n_frames,).
    wavelength : `~astropy.units.Quantity`, optional
        By default the calibration's grid, which is also the only choice where
        parameters are given per wavelength.
    beam : {"right", "left"}
        The beam.
    dataset : int
        Which of the calibration's chains.

    Returns
    -------
    Derived
        Shape (n_frames, n_wavelengths, 4, 4), see `~astropolcal.chain.system_mueller`.

    Raises
    ------
    ChainError, ParameterError
        As `~astropolcal.chain.system_mueller`.
    WavelengthRangeError
        If a wavelength is beyond the calibrated ones.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration.uncertainty import derived_mueller
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> derived_mueller(cal, {"hwp": 0 * u.deg, "derotator": 45 * u.deg}).std.shape
    (22, 4, 4)
    """
    lam = _grid(calibration, wavelength)
    chain = with_beam(calibration.chains[dataset], beam)
    value = system_mueller(chain, lam, positions)
    return _by_name(calibration, value, system_mueller_derivatives(chain, lam, positions), -3)


def _by_name(calibration, value, slopes, axis, mix=None):
    """Return a quantity with its error from derivatives by name, see `spread_out`."""
    free = free_of(calibration)
    mix = np.eye(len(calibration.wavelength)) if mix is None else mix
    slopes = spread_out(free, per_canonical(free, slopes), np.shape(value), mix, axis)
    return derive(calibration, free, value, slopes.reshape(-1, free.size))


def _grid(calibration, wavelength):
    """Return the wavelengths of a matrix; those of the calibration if parameters are on them."""
    grid = calibration.wavelength
    lam = grid if wavelength is None else wavelengths_of(wavelength)
    several = [slot for slot in free_of(calibration).slots if slot.per_wavelength]
    if several and (lam.shape != grid.shape or not u.allclose(lam, grid, rtol=SAME_WAVELENGTH)):
        raise ParameterError(
            f"{several[0].name} is known at the {grid.size} calibrated wavelengths only: "
            "leave out wavelength"
        )
    check_range(lam, grid)
    return lam


def derived_data(calibration, observations=None, dataset=0):
    """
    Return predicted data with the error that the calibration gives them.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    observations : Observations, optional
        Frames to predict; by default those that were fitted, of all datasets.
    dataset : int
        With ``observations``, which of the calibration's chains they belong to.

    Returns
    -------
    Derived
        Shape (n_data,).

    Raises
    ------
    CalibrationFileError
        If the calibration was read from a file and no observations are given.

    Examples
    --------
    >>> from astropolcal.calibration.uncertainty import derived_data
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> bool(derived_data(cal).is_determined.all())
    True
    """
    if observations is None:
        measurement = calibration.live_measurement()
    else:
        measurement = calibration.measurement_of(observations, dataset)
    vector = measurement.vector()
    jacobian, free = measurement.jacobian(vector), free_of(calibration)
    # per declared unit, (n_data, n_free)
    slopes = np.zeros((measurement.n_data, free.size))
    for slot in measurement.free.slots:
        # what leads a parameter need not be in the dataset's own chain
        own, factor, _ = free.lookup(slot.name)
        slopes[:, own.slice] += jacobian[slot.slice].T * factor * own.factor
    return derive(calibration, free, measurement.predict(vector).copy(), slopes)


def derived_sky(calibration, q, u, positions, *, wavelength=None, chain=None, dataset=0):
    """
    Return the Stokes parameters recovered for a source, with the calibration's error.

    A source of known q and u gives normalized double differences, which are linearized and inverted
    with the calibrated chain by least squares; the error is what a wrong calibration does to the
    result. Noise of the frames is not included.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    q, u : float
        Normalized Stokes parameters of the source, V = 0.
    positions : dict of str to `~astropy.units.Quantity`
        Position of every stage in the plus frames, scalar or shape (n_pairs,);
        the half-wave plate (``hwp``) stands 45 degrees further in the minus frames.
    wavelength : `~astropy.units.Quantity`, optional
        By default the calibration's grid.
    chain : `~astropy.modeling.CompoundModel`, optional
        Chain of the sky observation, whose optics bear the names and values of
        the calibrated ones; by default the calibrated chain from its first
        optic on a stage, so without those of the calibration source.
    dataset : int
        Which of the calibration's chains.

    Returns
    -------
    Derived
        q and u for each wavelength, shape (n_wavelengths, 2), or (2,) for a scalar wavelength.

    Raises
    ------
    ChainError
        If a stage has no position, or the chain no optic on a stage.
    ParameterError
        If the positions do not determine q and u, or the source is unphysical.
    WavelengthRangeError
        If a wavelength is beyond the calibrated ones.

    Examples
    --------
    >>> from astropy import units
    >>> from astropolcal.calibration.uncertainty import derived_sky
    >>> from astropolcal.testing import example_calibration
    >>> cal = example_calibration()
    >>> positions = {"hwp": [0, 22.5] * units.deg, "derotator": 60 * units.deg}
    >>> derived_sky(cal, 0.01, 0.0, positions).value.shape
    (22, 2)
    """
    if not np.hypot(q, u) <= 1:
        raise ParameterError(f"q = {q}, u = {u}: more than 100 % of polarization")
    lam = _grid(calibration, wavelength)
    # what stands before the first optic on a stage belongs to the source
    sky = from_first_stage(calibration.chains[dataset]) if chain is None else chain
    numerator, denominator = _double_difference_rows(sky, lam, positions)
    stokes = np.array([1.0, q, u, 0.0])
    total = denominator[""] @ stokes
    ratio = numerator[""] @ stokes / total
    # derivative of the quotient n s / d s to the Stokes vector s: (n - x d) / (d s)
    rows = (numerator[""] - ratio[..., None] * denominator[""]) / total[..., None]
    # of q and u only, shape (n_wavelengths, 2, n_pairs): least squares where there are more pairs
    stacked = np.moveaxis(rows[..., 1:3], 0, -2)
    inverse, _, _, good = inverse_rows(stacked)
    if not good.all():
        raise ParameterError(
            "the positions do not determine q and u: give pairs at two half-wave-plate angles, "
            "such as 0 and 22.5 deg"
        )
    slopes = {}
    for name in filter(None, numerator):
        change = (numerator[name] - ratio[..., None] * denominator[name]) @ stokes / total
        slopes[name] = -np.einsum("...kp,p...->...k", inverse, change)
    value = np.broadcast_to(stokes[1:3], inverse.shape[:-1]).copy()
    return _by_name(calibration, value, slopes, -2)


def _double_difference_rows(chain, lam, positions):
    """Return rows of difference and sum of the four beams (``""``), and their derivatives.

    Two dicts of arrays of shape (n_pairs, n_wavelengths, 4).
    """
    if "hwp" not in positions:
        raise ChainError(f"no position of 'hwp'; positions has {sorted(positions)}")
    shape = np.broadcast_shapes(*(np.shape(angle) for angle in positions.values()), (1,))
    angles = {
        name: np.broadcast_to(u.Quantity(angle), shape, subok=True)
        for name, angle in positions.items()
    }
    numerator, denominator = {}, {}
    for beam, sign in (("right", 1), ("left", -1)):
        arm = with_beam(chain, beam)
        for turned, half in ((0, 1), (45, -1)):
            at = angles | {"hwp": angles["hwp"] + turned * u.deg}
            rows = {"": system_mueller(arm, lam, at)}
            rows |= system_mueller_derivatives(arm, lam, at)
            for name, matrix in rows.items():
                row = np.asarray(getattr(matrix, "value", matrix))[..., 0, :]
                numerator[name] = numerator.get(name, 0.0) + sign * half * row
                denominator[name] = denominator.get(name, 0.0) + row
    return numerator, denominator


# ---- diattenuation and retardance of calibrated mirrors, beside those of bare metals ----


#: Metals that mirrors are compared with.
METALS = ("silver", "gold", "aluminium")

_MIRRORS = (Diattenuator, DiattenuatorRetarder, MetalMirror, PowerLawMirror)


def mirror_names(calibration):
    """Return the names of mirrors in the order of the light: they do not turn on a stage.

    What delays by less than a quarter wave, a mirror by half a wave, is a window or a relay.
    """
    found = {n: leaf for n, leaf in _diattenuators(calibration).items() if leaf.mount is None}
    both = ((n, leaf) for n, leaf in found.items() if isinstance(leaf, DiattenuatorRetarder))
    turns = {n: leaf.retardance.quantity for n, leaf in both}
    return [n for n in found if n not in turns or not np.median(np.cos(turns[n])) > 0]


def _diattenuators(calibration):
    every = [leaf for chain in calibration.chains for leaf in leaves(chain)]
    return {leaf.name: leaf for leaf in every if isinstance(leaf, _MIRRORS)}


def mirror_values(calibration, name, incidence=45 * u.deg):
    """Return diattenuation and retardance of a mirror per wavelength, beside those of metals.

    Retardance is 0 to 360 deg, 180 of an ideal mirror. Metals are bare, with the indices of Rakic
    et al. (1998). Errors are NaN where the data do not determine a value alone, and where it is
    held.
    """
    leaf = _diattenuators(calibration).get(name)
    if leaf is None:
        known = ", ".join(mirror_names(calibration)) or "none"
        raise ChainError(f"no mirror {name!r}; the calibration has {known}")
    wavelength = calibration.wavelength
    table = QTable({"wavelength": wavelength})
    percent, values = 100 * u.percent, calibration.parameter_values()
    for key, unit in (("diattenuation", percent), ("retardance", u.deg)):
        if hasattr(leaf, key):
            own = values.get(f"{name}.{key}")
            found = vars(of_law(calibration, name, key, wavelength)) if own is None else own
            for column, part in ((key, "value"), (f"{key}_err", "std")):
                plain = np.asarray(found[part], dtype=float)
                table[column] = np.broadcast_to(plain, wavelength.shape) * unit
    fitted = ["retardance"] if isinstance(leaf, DiattenuatorRetarder) else leaf.own_names
    table.meta |= {"name": name, "held": all(getattr(leaf, key).fixed for key in fitted)}
    for metal in METALS:
        mirror = MetalMirror(material=metal, incidence=incidence)
        table[f"diattenuation_{metal}"] = mirror.diattenuation(wavelength) * percent
        table[f"retardance_{metal}"] = mirror.retardance(wavelength)
    return table
