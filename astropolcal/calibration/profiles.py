# Licensed under a 3-clause BSD style license - see LICENSE
"""
Profile likelihood: chi-square along one parameter, all others refitted.

Where a parameter enters the model non-linearly, the interval in which the
profile rises by one is a better statement than a standard error, and need not
be symmetric. Where the data leave a parameter open the profile is flat.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.calibration._directions import declared_step
from astropolcal.calibration._refit import Refit
from astropolcal.calibration.covariance import residual_variance
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.units import to_unit

__all__ = ["Profile", "profile"]

# half width of the default scan, in standard errors; in degree, micrometre, percent if open
_WIDTH = 3.0
_OPEN_WIDTH = 1.0


@dataclass
class Profile:
    """
    Profile of chi-square along one parameter.

    Parameters
    ----------
    name : str
        The parameter.
    best : `~astropy.units.Quantity` or float
        Its calibrated value.
    values : `~astropy.units.Quantity` or `~numpy.ndarray`
        Where it was held, ascending, with the calibrated value among them.
    delta_chi2 : `~numpy.ndarray`
        Rise of chi-square over the calibration's, in units of the residual
        variance where the errors of the data are not given.
    vectors : `~numpy.ndarray`
        All parameters in canonical units at each value, shape (n_values, n_free).
    bounds : tuple of float
        Bounds of the parameter in its unit.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Profile
    >>> made = Profile("wollaston.efficiency", 0.9, np.array([0.8, 0.9, 1.0]),
    ...                np.array([4.0, 0.0, 4.0]), np.zeros((3, 1)))
    >>> [round(end, 3) for end in made.interval()]
    [0.85, 0.95]
    """

    name: str
    best: object
    values: object
    delta_chi2: np.ndarray
    vectors: np.ndarray
    bounds: tuple = (-np.inf, np.inf)

    def interval(self, rise=1.0):
        """
        Return where the profile has risen.

        Parameters
        ----------
        rise : float
            Rise of chi-square; 1 for one sigma.

        Returns
        -------
        low, high : `~astropy.units.Quantity` or float
            Infinite on a side where the profile stays below ``rise`` as far
            as it was followed.
        """
        values = np.asarray(getattr(self.values, "value", self.values))
        unit = getattr(self.values, "unit", None)
        here = int(np.argmin(np.abs(values - getattr(self.best, "value", self.best))))
        # of a parabola the root is a straight line, so that interpolation is exact
        root = np.sqrt(np.clip(self.delta_chi2, 0, None))
        # left half turned round, so that both sides are searched outwards from the best value
        ends = (
            -_crossing(-values[here::-1], root[here::-1], np.sqrt(rise)),
            _crossing(values[here:], root[here:], np.sqrt(rise)),
        )
        return ends if unit is None else tuple(end * unit for end in ends)

    @property
    def words(self):
        """The finding in a sentence."""
        low, high = self.interval()
        ends = f"{self.values[0]:.6g} and {self.values[-1]:.6g}"
        if np.isinf(low) and np.isinf(high):
            return (
                f"{self.name} is unbounded: between {ends} chi-square rises by at most "
                f"{self.delta_chi2.max():.2g}, so the data do not determine it"
            )
        if np.isinf(low) or np.isinf(high):
            return self._one_sided(low, high)
        return f"{self.name} = {self.best:.6g}, between {low:.6g} and {high:.6g} at one sigma"

    def _one_sided(self, low, high):
        if np.isinf(low):
            least, end, last, bound = "at most", high, self.values[0], self.bounds[0]
        else:
            least, end, last, bound = "at least", low, self.values[-1], self.bounds[1]
        at_bound = np.isclose(getattr(last, "value", last), bound)
        stop = "its bound" if at_bound else "the last value"
        return (
            f"{self.name} is {least} {end:.6g} at one sigma; chi-square does not limit it "
            f"up to {stop} {last:.6g}"
        )

    def __str__(self):
        return self.words


def _crossing(values, root, rise):
    """Return where the root of the profile first exceeds ``rise``, between two values."""
    above = np.flatnonzero(root > rise)
    if not above.size:
        return np.inf
    i = above[0]
    if i == 0:
        return float(values[0])
    share = (rise - root[i - 1]) / (root[i] - root[i - 1])
    return float(values[i - 1] + share * (values[i] - values[i - 1]))


def profile(calibration, name, values=None, n=21):
    """
    Return chi-square along one parameter, with all others refitted.

    Parameters
    ----------
    calibration : Calibration
        A calibration with its data.
    name : str
        One of ``calibration.covariance.names``, such as ``"hwp.w_sio2"`` or
        ``"derotator.horizontal[3]"``.
    values : `~astropy.units.Quantity` or array_like, optional
        Where to hold it; by default three standard errors to either side, of what
        is at a bound one-sided ones, or 1 degree (micrometre, percent) where it has
        none, within its bounds.
    n : int
        Number of values if none are given.

    Returns
    -------
    Profile

    Raises
    ------
    ParameterError
        If there is no such parameter, or a value has the wrong unit or is
        outside the bounds.
    FitError
        If ``n`` is below 3.
    CalibrationFileError
        If the calibration was read from a file, which holds no data.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import profile
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> low, high = profile(cal, "hwp.w_sio2", n=7).interval()
    >>> bool(low < cal.chain["hwp"].w_sio2.quantity < high)
    True
    """
    covariance = calibration.covariance
    if name not in covariance.names:
        raise ParameterError(f"no free parameter {name!r}; there are {_some(covariance.names)}")
    if n < 3:
        raise FitError(f"n = {n}; a profile needs at least 3 values")
    index = covariance.names.index(name)
    refit = Refit(calibration)
    unit = covariance.units[index]
    factor = refit.measurement.free.factors()[index]
    best = refit.solution[index] / factor
    low, high = (bounds[index] / factor for bounds in refit.measurement.free.bounds())
    if values is None:
        inward = (calibration.fit.get("bounds") or {"inward": {}})["inward"]
        std = inward.get(name, covariance.stds[index])
        grid = _grid(best, std, declared_step(unit), n)
        grid = np.unique(np.clip(grid, low, high))
    else:
        grid = np.unique(np.append(to_unit(values, unit, name), best))
        if grid[0] < low or grid[-1] > high:
            raise ParameterError(f"{name}: values outside its bounds {low:g} to {high:g}")
    chi2, vectors = _follow(refit, index, grid * factor, int(np.argmin(np.abs(grid - best))))
    rise = (chi2 - chi2.min()) / residual_variance(calibration)
    quantity = 1 if unit is None else u.Unit(unit)
    return Profile(name, best * quantity, grid * quantity, rise, vectors, (low, high))


def _some(names):
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def _grid(best, std, step, n):
    """Return values around the best; an odd number of them, so that it is one."""
    half = _WIDTH * std if np.isfinite(std) else _OPEN_WIDTH * step
    return best + half * np.linspace(-1, 1, n + 1 - n % 2)


def _follow(refit, index, values, here):
    """Refit at every value, starting from the solution and going outward on both sides."""
    chi2, vectors = np.empty(values.size), np.empty((values.size, refit.solution.size))
    for side in (range(here, values.size), range(here, -1, -1)):
        # each fit starts from its neighbour's, so that it stays in the same valley
        vector = refit.solution
        for i in side:
            start = vector.copy()
            start[index] = values[i]
            vector, chi2[i], _ = refit.fit(start, held=[index])
            vectors[i] = vector
    return chi2, vectors
