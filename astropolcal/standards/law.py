# Licensed under a 3-clause BSD style license - see LICENSE
"""The wavelength dependence of interstellar polarization."""

from typing import NamedTuple

import astropy.units as u
import numpy as np
from astropy.modeling import Fittable1DModel, Parameter

from astropolcal.exceptions import ParameterError
from astropolcal.optics.sources import serkowski
from astropolcal.units import angle_to_rad, check_range, length_to_um, to_unit
from astropolcal.words import check_choice

__all__ = ["SerkowskiLaw", "whittet_width"]

# Whittet et al. (1992): K = intercept + slope * lambda_max / um
_INTERCEPT, _SLOPE = 0.01, 1.66
_TURN = u.deg / u.um
_CANONICAL = {"p_max": u.dimensionless_unscaled, "lambda_max": u.um, "theta": u.rad}
_CANONICAL |= {"K": u.dimensionless_unscaled, "rotation": u.rad / u.um}


class LinearStokes(NamedTuple):
    """Normalized linear Stokes parameters, and their covariance (..., 2, 2), None if unknown."""

    q: np.ndarray
    u: np.ndarray
    covariance: np.ndarray | None


def whittet_width(lambda_max):
    r"""
    Return the width that goes with a wavelength of maximum polarization.

    :math:`K = 0.01 + 1.66\,\lambda_\mathrm{max}/\mathrm{um}`, an average over
    sight lines; the K of single stars scatter by about 0.1 around it.

    Parameters
    ----------
    lambda_max : `~astropy.units.Quantity` or SerkowskiLaw
        A wavelength; or a law, so that the function can tie its K.

    Returns
    -------
    float

    References
    ----------
    Wilking, Lebofsky & Rieke 1982, AJ 87, 695, doi:10.1086/113147;
    Whittet et al. 1992, ApJ 386, 562, doi:10.1086/171039.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.standards import SerkowskiLaw, whittet_width
    >>> round(float(whittet_width(550 * u.nm)), 3)
    0.923
    >>> law = SerkowskiLaw()
    >>> law.K.tied = whittet_width
    """
    if isinstance(lambda_max, SerkowskiLaw):
        # in a fit it is a plain number of micrometres
        given = lambda_max.lambda_max
        lambda_max = u.Quantity(given.value, given.unit or u.um)
    return _INTERCEPT + _SLOPE * length_to_um(lambda_max, "lambda_max")


class SerkowskiLaw(Fittable1DModel):
    r"""
    Degree of interstellar linear polarization against wavelength.

    .. math:: p(\lambda) = p_\mathrm{max}
              \exp\left[-K \ln^2(\lambda_\mathrm{max} / \lambda)\right], \qquad
              \theta(\lambda) = \theta + \rho\,(\lambda - \lambda_\mathrm{max})

    The model returns the degree; `q`, `u` and `stokes` also use the angle. ``theta`` and
    ``rotation`` are fixed by default, because a fit to degrees does not constrain them.

    Parameters
    ----------
    p_max : float or `~astropy.units.Quantity`
        Largest degree of polarization, as a number or in percent.
    lambda_max : `~astropy.units.Quantity`
        Wavelength of the largest polarization.
    K : float, optional
        Width of the curve; by default that of `whittet_width`. To keep it there in
        a fit, set ``law.K.tied = whittet_width``.
    theta : `~astropy.units.Quantity`
        Angle at ``lambda_max``, from north through east.
    rotation : `~astropy.units.Quantity`
        Change of the angle with wavelength.
    **kwargs
        What an `astropy.modeling.Model` takes, such as ``name``.

    Raises
    ------
    ParameterError
        If a parameter has a wrong unit.
    WavelengthRangeError
        If a wavelength lies outside ``valid_range``. The law was measured from
        U to K (``measured_range``); beyond 2.5 um a power law holds instead.

    References
    ----------
    Serkowski, Mathewson & Ford 1975, ApJ 196, 261, doi:10.1086/153410; Wilking et al. 1980, ApJ
    235, 905; Whittet et al. 1992, ApJ 386, 562, doi:10.1086/171039.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.standards import SerkowskiLaw
    >>> law = SerkowskiLaw(p_max=3.9 * u.percent, lambda_max=520 * u.nm, K=0.99)
    >>> print(law([0.52, 1.25] * u.um).to(u.percent).round(2))
    [3.9  1.82] %
    """

    p_max = Parameter(default=0.05, bounds=(0, None), description="largest degree of polarization")
    lambda_max = Parameter(
        default=0.55, unit=u.um, bounds=(0.1, 2.5), description="wavelength of the maximum"
    )
    K = Parameter(default=0.923, bounds=(0, 5), description="width of the curve")
    theta = Parameter(default=0.0, unit=u.deg, fixed=True, description="angle at lambda_max")
    rotation = Parameter(
        default=0.0, unit=_TURN, fixed=True, description="change of the angle with wavelength"
    )

    measured_range = [0.36, 2.04] * u.um
    valid_range = [0.28, 2.5] * u.um
    # `evaluate` gets micrometres, whatever unit of length the wavelengths have
    input_units_strict = True
    _input_units_allow_dimensionless = False

    def __init__(
        self,
        p_max=0.05,
        lambda_max=0.55 * u.um,
        K=None,
        theta=0 * u.deg,
        rotation=0 * _TURN,
        **kwargs,
    ):
        longest = length_to_um(lambda_max, "lambda_max")
        super().__init__(
            p_max=to_unit(p_max, None, "p_max"),
            lambda_max=longest * u.um,
            # the relation only gives the start: K is a free parameter unless it is tied
            K=_INTERCEPT + _SLOPE * longest if K is None else to_unit(K, None, "K"),
            theta=angle_to_rad(theta, "theta") * u.rad.to(u.deg) * u.deg,
            rotation=to_unit(rotation, _TURN, "rotation") * _TURN,
            **kwargs,
        )

    @property
    def input_units(self):
        """Unit of the input: micrometre, or none in a fit."""
        return None if self.lambda_max.unit is None else {self.inputs[0]: u.um}

    def _parameter_units_for_data_units(self, inputs_unit, outputs_unit):
        angle = (u.deg, u.deg / inputs_unit[self.inputs[0]])
        units = (outputs_unit[self.outputs[0]], inputs_unit[self.inputs[0]], None, *angle)
        return {name: unit for name, unit in zip(self.param_names, units, strict=True) if unit}

    def without_units_for_data(self, **data):
        """Return the law as a fitter takes it, p_max and its bounds in the unit of the data."""
        law, own = self.copy(), self.p_max.unit or u.one
        scale = own.to(getattr(data[self.outputs[0]], "unit", u.one))
        # for astropy a plain number is in the unit of the data already, and bounds always are
        law.p_max = self.p_max.value * own
        law.p_max.bounds = [None if bound is None else bound * scale for bound in law.p_max.bounds]
        return super(SerkowskiLaw, law).without_units_for_data(**data)

    def evaluate(self, x, p_max, lambda_max, K, theta, rotation):
        """Return the degree of polarization; astropy calls it."""
        longest, width = u.Quantity(lambda_max, u.um).value, u.Quantity(K).value
        degree = p_max * serkowski(_in_range(x, self.valid_range), longest, width)[0]
        # a model with units must not mix plain numbers with quantities
        return degree << u.dimensionless_unscaled if hasattr(x, "unit") else degree

    @property
    def fit_deriv(self):
        """Derivatives by the parameters, or None with a tie, of which astropy drops the column."""
        return None if any(self.tied.values()) else self._columns

    @staticmethod
    def _columns(x, p_max, lambda_max, K, theta, rotation):
        shape, log = serkowski(np.asarray(x, dtype=float), lambda_max, K)
        degree = p_max * shape
        none = np.zeros_like(shape)
        # d/dp_max, d/dlambda_max, d/dK of p_max exp(-K ln^2(lambda_max /
        # lambda)); the degree does not depend on the angle
        by_width = -(log**2) * degree
        by_maximum = -2 * K * log / lambda_max * degree
        return [shape, by_maximum, by_width, none, none]

    def angle(self, wavelength):
        """Return the angle of polarization in degree, from north through east, in [0, 180)."""
        x = _in_range(length_to_um(wavelength, "wavelength"), self.valid_range)
        return np.mod(np.rad2deg(self._angle_rad(x)), 180) * u.deg

    def _angle_rad(self, x):
        values = self._values()
        return values["theta"] + values["rotation"] * (x - values["lambda_max"])

    def _values(self):
        """Return the parameters in canonical units, as a dictionary of floats."""
        return {
            name: float(u.Quantity(p.value, p.unit).to_value(_CANONICAL[name]))
            for name, p in ((n, getattr(self, n)) for n in self.param_names)
        }

    def q(self, wavelength):
        """Return Stokes q, positive along north."""
        return self.stokes(wavelength).q

    def u(self, wavelength):
        """Return Stokes u, positive towards north-east."""
        return self.stokes(wavelength).u

    def stokes(self, wavelength, covariance=None):
        """
        Return q and u, with the covariance that errors of the parameters give them.

        Parameters
        ----------
        wavelength : `~astropy.units.Quantity`
            Any shape.
        covariance : mapping or array-like, optional
            Standard errors by the names of parameters, as quantities where the parameter has a
            unit; or a covariance matrix in the parameters' units, of all five in the order of
            ``param_names`` or of those that are neither fixed nor tied, as a fitter returns it.

        Returns
        -------
        LinearStokes
            ``q``, ``u`` and ``covariance``, of shape (..., 2, 2) or None.

        Raises
        ------
        ParameterError
            If the covariance does not belong to the parameters.
        WavelengthRangeError
            If the law does not hold at a wavelength.

        Notes
        -----
        The covariance is that at each wavelength; those of two wavelengths are
        correlated, because the parameters are common.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.standards import SerkowskiLaw
        >>> law = SerkowskiLaw(p_max=0.04, theta=90 * u.deg)
        >>> errors = {"p_max": 0.1 * u.percent, "theta": 1 * u.deg}
        >>> q, stokes_u, covariance = law.stokes(550 * u.nm, errors)
        >>> print((covariance.diagonal() ** 0.5).round(5))
        [0.001  0.0014]
        """
        x = _in_range(length_to_um(wavelength, "wavelength"), self.valid_range)
        values = self._values()
        degree_columns = self._columns(x, *values.values())
        degree = values["p_max"] * degree_columns[0]
        angle = 2 * self._angle_rad(x)
        along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        q_u = degree[..., None] * along
        if covariance is None:
            return LinearStokes(q_u[..., 0], q_u[..., 1], None)
        # (q, u) = p (cos 2 theta, sin 2 theta): along is d/dp, across d/dtheta
        across = 2 * degree[..., None] * np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
        one = np.ones_like(x)
        # derivatives of theta(lambda) = theta + rotation (lambda -
        # lambda_max) to the five parameters
        turns = [0 * one, -values["rotation"] * one, 0 * one, one, x - values["lambda_max"]]
        pairs = zip(degree_columns, turns, strict=True)
        jacobian = np.stack([d[..., None] * along + t[..., None] * across for d, t in pairs], -1)
        matrix = self._canonical_covariance(covariance)
        return LinearStokes(
            q_u[..., 0], q_u[..., 1], jacobian @ matrix @ np.swapaxes(jacobian, -1, -2)
        )

    def _canonical_covariance(self, covariance):
        """Return the covariance of all five parameters in canonical units."""
        if hasattr(covariance, "keys"):
            for key in covariance:
                check_choice("parameter of the law", key, self.param_names, ParameterError)
            errors = [
                to_unit(covariance.get(n, 0 * _CANONICAL[n]), _CANONICAL[n], f"error of {n}")
                for n in self.param_names
            ]
            if not np.all(np.isfinite(errors)) or np.min(errors) < 0:
                raise ParameterError(
                    f"errors = {dict(covariance)!r} must be finite and not negative"
                )
            return np.diag(np.square(errors))
        matrix = np.asarray(covariance, dtype=float)
        free = [n for n in self.param_names if not (self.fixed[n] or self.tied[n])]
        square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
        if not (square and np.all(np.isfinite(matrix))):
            raise ParameterError("the covariance must be a square matrix of finite numbers")
        names = {len(self.param_names): self.param_names, len(free): free}.get(len(matrix))
        if names is None:
            raise ParameterError(
                f"the covariance has {len(matrix)} rows; it must have {len(self.param_names)} "
                f"({', '.join(self.param_names)}) or {len(free)} (free: {', '.join(free)})"
            )
        scale = [(getattr(self, n).unit or u.one).to(_CANONICAL[n]) for n in self.param_names]
        moves = np.array([self._moves(name, names) for name in self.param_names])
        return moves @ matrix @ moves.T * np.outer(scale, scale)

    def _moves(self, name, names):
        """Return by how much a parameter moves with others, by its tie if it is not one of them."""
        tie = self.tied[name]
        if name in names or not tie:
            return [float(name == other) for other in names]
        found = []
        for other in names:
            ends, step = [], 1e-4 * max(abs(getattr(self, other).value), 1e-3)
            for sign in (1, -1):
                moved = self.copy()
                getattr(moved, other).value += sign * step
                ends.append(float(u.Quantity(tie(moved)).value))
            found.append((ends[0] - ends[1]) / (2 * step))
        return found


def _in_range(x, valid):
    """Return the wavelengths, or raise where the law does not hold."""
    value = length_to_um(x) if hasattr(x, "unit") else x
    return check_range(value, *valid.to_value(u.um), "the Serkowski law")
