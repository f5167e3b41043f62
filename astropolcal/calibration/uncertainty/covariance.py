# Licensed under a 3-clause BSD style license - see LICENSE
"""
Covariance of calibrated parameters, with names and units, and errors at a bound.

The matrix has no number for a parameter that the data do not determine. What the data do know of
such parameters (a sum of two angles, say) is kept beside it: the determined directions with their
errors (``factor``) and the open ones (``null``). With these, the error of anything derived from the
parameters is right: finite where the open directions do not move it, infinite where they do.

A parameter at its bound has no standard error: chi-square still falls beyond. How far it may go
inward is known, and is its one-sided error. The errors of all others include that it may; where
that matters, they say so, and the error without any bound stands beside theirs.

A fit has one value of an optic for all of its datasets. If the optic stood or retarded otherwise in
one of them, other parameters absorb what they can, and the errors know nothing of it. So each angle
is moved in one dataset alone, at all wavelengths together, and all else is fitted again, to first
order: the score test of Rao (1948, Math. Proc. Camb. Phil. Soc. 44, 50,
doi:10.1017/S0305004100023987).
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.linearized import LARGE, RANK, STILL
from astropolcal.calibration.noise.scatter import Scatter, by_chance
from astropolcal.calibration.noise.weighting import Problem, problem_of
from astropolcal.exceptions import ParameterError
from astropolcal.measurement.parameters import declared_step, step_of
from astropolcal.units import canonical_factor

__all__ = ["Covariance"]

# share of the squares of standard errors by which a covariance may differ from its transpose, or
# an error from another: far above rounding, and too little to change anything
_ASYMMETRY = 1e-6
# directions that no residual pulls keep this share of the largest error, so that they stay known
_LEAST = 1e-6
# probability of a normal deviate below this many standard deviations; errors that are too small by
# less than this factor, as with 25 degrees of freedom, are no matter
_NORMAL, _NO_MATTER = (0.975, 1.96), 1.05
# a robust loss makes no direction softer than this
_STIFF = 0.05
# how sure a difference is, and how well a dataset alone has to know an angle, in degree
APART, _TOLD = 4.0, 5.0
# what changes the data less, per degree in units of their noise, or is left of it, is nothing
_SEEN = 1e-6


class Covariance:
    """
    Covariance matrix of named parameters, in their declared units.

    Parameters
    ----------
    names : sequence of str
        Name of each row, such as ``hwp.w_sio2`` or ``derotator.horizontal[3]``.
    units : sequence of `~astropy.units.Unit` or None
        Unit of each.
    matrix : array_like
        Shape (n, n); NaN in the rows and columns of parameters that the data do not determine.
    factor : array_like, optional
        Directions that the data determine, each as long as its standard
        error, shape (rank, n); ``factor.T @ factor`` is the covariance as far
        as it is known. Of those at a bound it has how far they may go inward.
    null : array_like, optional
        Directions that stay open, shape (n_open, n).

    Raises
    ------
    ParameterError
        If the shapes differ or the matrix is not symmetric.

    Examples
    --------
    >>> from astropolcal.calibration.uncertainty import Covariance
    >>> import astropy.units as u
    >>> covariance = Covariance(["hwp.theta"], [u.deg], [[0.04]])
    >>> covariance.std("hwp.theta")
    <Quantity 0.2 deg>
    """

    #: Determined and open directions; None where only the matrix is known.
    factor = null = None

    def __init__(self, names, units, matrix, factor=None, null=None):
        self.names = list(names)
        self.units = list(units)
        self.matrix = np.array(matrix, dtype=float)
        n = len(self.names)
        if self.matrix.shape != (n, n) or len(self.units) != n:
            raise ParameterError(
                f"covariance of {n} names and {len(self.units)} units has shape {self.matrix.shape}"
            )
        variances = np.diag(self.matrix)
        # the parameters have units of their own, and with them the rounding errors
        stds = np.sqrt(np.where(np.isfinite(variances), np.abs(variances), 0.0))
        with np.errstate(over="ignore"):
            slack = _ASYMMETRY * np.outer(stds, stds)
            same = np.isclose(self.matrix, self.matrix.T, rtol=0, atol=slack, equal_nan=True)
        if not same.all():
            row, column = np.argwhere(~same)[0]
            raise ParameterError(
                f"a covariance matrix must be symmetric: that of {self.names[row]} and "
                f"{self.names[column]} is {self.matrix[row, column]:g} and "
                f"{self.matrix[column, row]:g}"
            )
        for key, rows in (("factor", factor), ("null", null)):
            if rows is not None:
                setattr(self, key, np.array(rows, dtype=float).reshape(-1, n))
                if not np.isfinite(getattr(self, key)).all():
                    raise ParameterError(f"{key} of a covariance has a value that is not finite")

    def __len__(self):
        return len(self.names)

    def __repr__(self):
        known = int(np.isfinite(np.diag(self.matrix)).sum())
        return f"<Covariance of {len(self)} parameters, {known} of them determined>"

    def __eq__(self, other):
        if not isinstance(other, Covariance):
            return NotImplemented
        keys = ("names", "units", "matrix", "factor", "null")
        return all(same_content(getattr(self, key), getattr(other, key)) for key in keys)

    __hash__ = None

    @property
    def stds(self):
        """Standard deviations in the declared units, NaN where not determined."""
        return np.sqrt(np.diag(self.matrix))

    def std(self, name):
        """
        Return the standard deviation of one parameter.

        Parameters
        ----------
        name : str
            One of ``names``.

        Returns
        -------
        `~astropy.units.Quantity` or float
            NaN where the data do not determine it.

        Raises
        ------
        ParameterError
            If there is no such parameter.

        Examples
        --------
        >>> from astropolcal.calibration.uncertainty import Covariance
        >>> one = Covariance(["wollaston.efficiency"], [None], [[1e-4]])
        >>> float(one.std("wollaston.efficiency"))
        0.01
        """
        if name not in self.names:
            raise ParameterError(f"no parameter {name!r} in the covariance")
        i = self.names.index(name)
        value = self.stds[i]
        return value if self.units[i] is None else value * self.units[i]

    @property
    def correlation(self):
        """Correlation matrix, shape (n, n), NaN where not determined."""
        stds = self.stds
        return self.matrix / np.outer(stds, stds)

    def widened(self, directions):
        """Return the covariance where elements move farther, along ways that bend.

        ``directions`` has the element, its way to one standard error and what of this is beyond the
        straight one, (n,), of each. What another has widened enough before stays.
        """
        variances = np.diag(self.matrix).copy()
        steps = np.array([declared_step(unit) for unit in self.units])
        rows = []
        for i, way, beyond in sorted(directions, key=lambda one: -abs(one[1][one[0]])):
            # an element that is known exactly has no straight way, and rounding is no widening
            lacking = (way[i] ** 2 - variances[i]) / steps[i] ** 2
            if way[i] ** 2 > variances[i] * (1 + _ASYMMETRY) > 0:
                more = steps * _beyond(lacking, i, way / steps, beyond / steps)
                rows += [*more]
                variances += np.square(more).sum(axis=0)
        return self.beside(np.array(rows)) if rows else self

    def beside(self, rows):
        """Return the covariance with further changes of the parameters, one sigma each, (k, n)."""
        # what has no error has none of them either
        matrix, factor = self.matrix + rows.T @ rows, self.factor
        if factor is not None:
            steps = np.array([declared_step(unit) for unit in self.units])
            whole = np.concatenate([factor, rows]) / steps
            _, sizes, right = np.linalg.svd(whole, full_matrices=False)
            factor = sizes[:, None] * right * steps
        return Covariance(self.names, self.units, matrix, factor=factor, null=self.null)

    def propagate(self, slopes):
        """
        Return the covariance of quantities that depend on the parameters.

        Parameters
        ----------
        slopes : array_like
            Derivative of each quantity to each parameter in its declared unit,
            shape (n_quantities, n) or (n,) for one quantity.

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_quantities, n_quantities), or a scalar for one quantity. On the diagonal
            infinity for what moves along an open direction, NaN for what depends on parameters at a
            bound alone, or on undetermined ones where ``factor`` is not known; outside of the
            diagonal NaN in the rows and columns of both.

        Raises
        ------
        ParameterError
            If the slopes have another shape.

        Examples
        --------
        Of two angles the data know the sum only:

        >>> from astropolcal.calibration.uncertainty import Covariance
        >>> import astropy.units as u
        >>> import numpy as np
        >>> covariance = Covariance(["a.theta", "b.theta"], [u.deg, u.deg],
        ...                         np.full((2, 2), np.nan), factor=[[0.1, 0.1]], null=[[1, -1]])
        >>> float(covariance.propagate([1, 1]).round(3)), float(covariance.propagate([1, 0]))
        (0.04, inf)
        """
        slopes = np.asarray(slopes, dtype=float)
        if slopes.ndim not in (1, 2) or slopes.shape[-1] != len(self):
            raise ParameterError(
                f"slopes of shape {slopes.shape} do not fit a covariance of {len(self)} parameters"
            )
        matrix = self._spread(np.atleast_2d(slopes)).covariance()
        return matrix[0, 0] if slopes.ndim == 1 else matrix

    def _spread(self, slopes):
        axes = self._axes()
        return axes.spread(*axes.along(slopes))

    def _axes(self):
        """Split the space of the parameters, each in degree, micrometre or percent."""
        steps = np.array([declared_step(unit) for unit in self.units])
        # NaN on the diagonal marks what has no error; why is told by `null` and `factor`
        undetermined = ~np.isfinite(np.diag(self.matrix))
        empty = np.zeros((0, len(self)))
        null = empty if self.null is None else self.null / steps
        if self.factor is not None:
            factor = self.factor / steps
            # at a bound: neither in what is known nor in what is open
            moves = np.abs(np.concatenate([factor, null])).max(axis=0, initial=0.0) > 0
            blind = undetermined & ~moves
        else:
            known, blind = ~undetermined, undetermined
            matrix = self.matrix[np.ix_(known, known)] / np.outer(steps[known], steps[known])
            # symmetric: eigenvectors are the directions, roots of eigenvalues their errors
            variance, vectors = np.linalg.eigh(matrix)
            factor = np.zeros((len(variance), len(self)))
            factor[:, known] = (vectors * np.sqrt(variance.clip(0))).T
        # rows of `factor` are principal directions times their standard errors; here they part
        sigmas = np.linalg.norm(factor, axis=1)
        known = factor / np.where(sigmas > 0, sigmas, 1.0)[:, None]
        return _Axes(steps, known, sigmas, null, np.eye(len(self))[blind], self.factor is None)


def _beyond(lacking, i, way, beyond):
    """Return the two rows with which an element has an error, and others that of a way that bends.

    They add the way that bends, and leave of the straight one what is not part of it. So what does
    not go on with the element stays where it was, and what bends has the size that it has there.
    """
    straight = way - beyond
    return [np.sqrt(lacking) * way / way[i], straight[i] * way / way[i] - straight]


def same_content(a, b):
    """Return whether values, or dictionaries of arrays, are equal, NaN to NaN as `==` is not."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same_content(a[key], b[key]) for key in a)
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    return type(a) is type(b) and a == b


@dataclass
class _Axes:
    """Orthonormal directions in parameter space: known, open, and blind (no statement)."""

    steps: np.ndarray
    known: np.ndarray
    sigmas: np.ndarray
    open: np.ndarray
    blind: np.ndarray
    partial: bool

    def along(self, slopes):
        """Return slopes per declared unit along known, open and blind directions."""
        scaled = slopes * self.steps
        return tuple(scaled @ part.T for part in (self.known, self.open, self.blind))

    def spread(self, along_known, along_open, along_blind):
        """Return the spread of quantities from their slopes along the axes, (k, n_axes) each."""
        flags = self.flags(along_known, along_open, along_blind)
        return _Spread(along_known * self.sigmas, *flags)

    def flags(self, along_known, along_open, along_blind):
        """Return which quantities are open and which are blind, from slopes (..., n_axes)."""
        parts = [along_known, along_open, along_blind]
        size = np.sqrt(sum(np.sum(part**2, axis=-1) for part in parts))
        # a rounding error along an open direction is no movement
        limit = STILL * size
        is_open = np.abs(along_open).max(axis=-1, initial=0.0) > limit
        blind = np.abs(along_blind).max(axis=-1, initial=0.0) > limit
        if not self.partial:
            # with a parameter at its bound taken as known there is an error, unless it is all
            blind &= np.abs(along_known).max(axis=-1, initial=0.0) <= limit
        return is_open, blind & ~is_open


@dataclass
class _Spread:
    """How far quantities move for one sigma along each known direction, (k, rank)."""

    moved: np.ndarray
    is_open: np.ndarray
    is_blind: np.ndarray

    def stds(self):
        std = np.sqrt(np.sum(self.moved**2, axis=1))
        return np.where(self.is_open, np.inf, np.where(self.is_blind, np.nan, std))

    def covariance(self):
        matrix = self.moved @ self.moved.T
        unknown = self.is_open | self.is_blind
        # a covariance with something infinite has no value
        matrix[unknown] = matrix[:, unknown] = np.nan
        diagonal = np.arange(len(matrix))[self.is_open]
        matrix[diagonal, diagonal] = np.inf
        return matrix


def covariance_along(free, known, null):
    """Return the covariance of free parameters from a root of it, (k, n), and open directions.

    Both per step of the parameters.
    """
    per_unit = free.steps / free.factors()
    _, sizes, principal = np.linalg.svd(known, full_matrices=False)
    factor = sizes[:, None] * principal * per_unit
    null = null / np.linalg.norm(null, axis=1, keepdims=True)
    open_ = (np.abs(null) > STILL).any(axis=0) | ~np.any(factor, axis=0)
    matrix = factor.T @ factor
    matrix[open_] = matrix[:, open_] = np.nan
    return Covariance(free.names, free.units, matrix, factor=factor, null=null * per_unit)


def full_covariance(calibration):
    """Return the covariance of a calibration with its determined and open directions.

    From an old file without directions only what depends on determined parameters has an error.
    """
    known = calibration.covariance
    if known.factor is not None:
        return known
    if calibration.measurement is None:
        steps = np.array([declared_step(unit) for unit in known.units])
        null = np.asarray(calibration.identifiability.null_vectors).reshape(-1, len(known))
        undetermined = ~np.isfinite(np.diag(known.matrix))
        undetermined &= [name not in set(calibration.at_bound) for name in known.names]
        # less those that a prior has closed
        is_open = (np.abs(null[:, undetermined]) > STILL).any(axis=1)
        return Covariance(known.names, known.units, known.matrix, null=null[is_open] * steps)
    problem = problem_of(calibration)
    whitened = problem.around()
    scatter = _scatter_of(calibration, problem, whitened)
    return covariance_around(problem.measurement, whitened, problem.weighting, scatter)


def _scatter_of(calibration, problem, whitened):
    """Return how the residuals of a calibration scatter, where its errors follow from that."""
    is_white = calibration.settings.get("errors") == "white"
    return None if is_white else Scatter.of(problem.measurement, problem.weighting, whitened)


def covariance_around(measurement, whitened, weighting, scatter):
    """Return the covariance with its directions, of a problem that is decomposed once.

    It is the sandwich (White 1980, Econometrica 48, 817) of how residuals scatter and are
    correlated; where they do not tell, that of independent data. What is at a bound may go inward
    by its error.
    """
    if scatter is None:
        return white_covariance(measurement, whitened, weighting)
    middle = _middle(scatter, weighting.level, whitened.slopes, whitened.prior_slopes)
    slack = _inward(measurement, whitened, scatter)[-1] if whitened.held.any() else None
    return sandwich(measurement, whitened, weighting, middle, slack, scatter)


def _middle(scatter, level, data, priors):
    """Return the covariance of the pulls on directions, from their derivatives (n, n_directions).

    Without ``scatter`` data are independent.
    """
    own = level**2 * data.T @ data if scatter is None else scatter.middle(data)
    return own + level**2 * priors.T @ priors


def widening(calibration):
    """Return by how much the scatter makes the error of each parameter larger, (n_free,).

    Over that where chi-square with the weights of the fit rises by one; of what is at a bound
    inward, and one of what has no error.
    """
    problem = problem_of(calibration)
    measurement, whitened, weighting = problem.measurement, problem.around(), problem.weighting
    scatter = _scatter_of(calibration, problem, whitened)
    middle = _middle(scatter, weighting.level, whitened.slopes, whitened.prior_slopes)
    found = sandwich(measurement, whitened, weighting, middle, scatter=scatter)
    stated = found.stds * measurement.free.factors()
    plain = weighting.level * np.sqrt(np.diag(whitened.covariance()))
    with np.errstate(invalid="ignore", divide="ignore"):
        times = stated / plain
    if whitened.held.any():
        held, columns, *_ = _inward(measurement, whitened, scatter)
        times[held] = _levels(measurement, whitened, scatter, columns) / weighting.level
    return np.where(np.isfinite(times) & (times > 0), times, 1.0)


def white_covariance(measurement, whitened, weighting):
    """Return the covariance of independent data with the noise that the fit assumed."""
    free, level = measurement.free, weighting.level
    if np.isfinite(level):
        middle = level**2 * np.eye(whitened.errors.rank)
        return sandwich(measurement, whitened, weighting, middle)
    unknown, null = np.full((free.size,) * 2, np.nan), whitened.null() * whitened.scale
    return Covariance(free.names, free.units, unknown, null=null / free.factors())


def sandwich(
    measurement, whitened, weighting, middle, slack=None, scatter=None, from_residuals=False
):
    """Return the covariance from that of the pulls on the determined directions.

    ``slack`` has further directions, each one standard error long, in the steps of the problem;
    ``from_residuals`` says that residuals tell the pulls, as they do where they have a ``scatter``.
    """
    slopes = whitened.slopes
    if weighting.follows is not None:
        # with a robust loss a datum far from the model pulls less back than its weight says
        lost = 1 - weighting.follows
        stiff, axes = np.linalg.eigh(np.eye(len(middle)) - slopes.T @ (lost[:, None] * slopes))
        back = (axes / np.maximum(stiff, _STIFF)) @ axes.T
        middle, slopes = back @ middle @ back, slopes @ back
    variances, vectors = np.linalg.eigh(middle)
    freedom = measurement.n_data - whitened.n_taken
    known = not (from_residuals or scatter is not None or weighting.from_residuals)
    freedom = np.inf if known else freedom
    few = _of_few(freedom, scatter, slopes @ vectors, variances)
    stds = np.sqrt(variances.clip(0)) * few
    # with fewer groups than directions a sum of outer products is singular
    stds = np.maximum(stds, _LEAST * stds.max(initial=0.0))
    rows = (stds[:, None] * vectors.T) @ whitened.factor()
    rows = rows if slack is None else np.concatenate([rows, slack])
    # back to orthogonal directions, as `Covariance` keeps them
    _, sizes, principal = np.linalg.svd(rows, full_matrices=False)
    free = measurement.free
    per_unit = whitened.scale / free.factors()
    factor, null = sizes[:, None] * principal * per_unit, whitened.null() * per_unit
    matrix = np.full((free.size, free.size), np.nan)
    columns = whitened.live[whitened.errors.determined]
    determined = factor[:, columns]
    matrix[np.ix_(columns, columns)] = determined.T @ determined
    return Covariance(free.names, free.units, matrix, factor=factor, null=null)


def _of_few(freedom, scatter, slopes, variances):
    """Return by how much errors grow where few degrees of freedom tell the noise, or the scatter.

    By the quantiles of Student's t, for 95 of 100 cases within two errors if noise is even;
    ``slopes`` are the derivatives of the data to the directions that have the ``variances``.
    """
    # a calibration is read where there is no scipy
    from scipy.special import stdtrit

    if scatter is not None:
        freedom = np.minimum(freedom, scatter.freedom(slopes, variances))
    times = stdtrit(np.maximum(freedom, 1.0), _NORMAL[0]) / _NORMAL[1] / _NO_MATTER
    return np.where(freedom > 0, np.maximum(times, 1.0), 1.0)


# ---- differences between datasets ----


def disagreements(measurement, whitened, weighting, scatter):
    """Return in which dataset an angle differs from all others, the surest first.

    Each has ``parameter``, ``dataset``, ``change_deg``, ``std_deg`` and ``sigma``. ``scatter`` is
    that of the residuals, None where they are independent; errors are those that are larger.
    """
    weight = 1.0 if weighting.weight is None else weighting.weight
    residuals, level, found = measurement.residuals() * weight, weighting.level, []
    if not level > 0:
        return found
    names = [dataset.observations.name for dataset in measurement.datasets]
    for slot, i, own in _moves(measurement, whitened):
        # less what other parameters absorb, at the expense of priors
        taken = whitened.slopes.T @ own
        left, lost = own - whitened.slopes @ taken, whitened.prior_slopes @ taken
        size = left @ left + lost @ lost
        if not size > _SEEN * (own @ own):
            continue
        variance = level**2 * size
        change = own @ residuals / size
        if scatter is not None and abs(change) * np.sqrt(size) > APART * level:
            # a change is no scatter: it is that of the residuals without it
            beside = Scatter(measurement, weighting, whitened, left / np.linalg.norm(left))
            scattered = beside.middle(left[:, None])[0, 0] + level**2 * (lost @ lost)
            settings = [part.patterns.shape[1] // 2 for part in beside.parts]
            luck = by_chance(min(filter(None, settings), default=None))
            variance = luck**2 * scattered
        std = np.sqrt(variance) / size
        if abs(change) > APART * std and std < _TOLD:
            one = {"parameter": slot.name, "dataset": names[i], "change_deg": float(change)}
            found.append(one | {"std_deg": float(std), "sigma": float(abs(change) / std)})
    return sorted(found, key=lambda one: -one["sigma"])


def _moves(measurement, whitened):
    """Yield angle, dataset and derivative of the data, per degree in that dataset alone."""
    for slot in measurement.free.slots:
        if slot.unit is None or not u.Unit(slot.unit).is_equivalent(u.deg):
            continue
        turned = whitened.rows[:, slot.slice].sum(axis=1)
        parts = [np.zeros(turned.size) for _ in measurement.segments]
        for part, rows in zip(parts, measurement.segments, strict=True):
            part[rows] = turned[rows]
        seen = [i for i, part in enumerate(parts) if np.abs(part).max(initial=0.0) > _SEEN]
        # what one dataset alone has, none can contradict; of two each differs from the other
        yield from ((slot, i, parts[i]) for i in (seen if len(seen) > 2 else seen[1:]))


def between_datasets(covariance, found):
    """Return a covariance that counts differences between datasets as errors of the angles."""
    rows = np.zeros((len(found), len(covariance)))
    for row, one in zip(rows, found, strict=True):
        for i, (name, unit) in enumerate(zip(covariance.names, covariance.units, strict=True)):
            if name.partition("[")[0] == one["parameter"]:
                row[i] = np.deg2rad(one["change_deg"]) / canonical_factor(unit)
    return covariance.beside(rows) if found else covariance


# ---- errors at a bound, and next to one ----


#: What may be said of a parameter, in the order in which it is decided.
STATUSES = (
    "fixed",
    "tied",
    "at bound",
    "open",
    "badly determined",
    "conditional",
    "by priors",
    "determined",
)

# an error that grows by less than this when the bounds are released hardly hangs on them
_MATTERS = 1.1
# as far from one bound as 68 % of what is anywhere between two
_ANYWHERE = 0.6827
# the spread of what is anywhere between two bounds, as a share of their distance
_UNIFORM = 1 / np.sqrt(12)


def errors_at_bounds(measurement, whitened, scatter=None):
    """Return one-sided errors at bounds (``inward``) and what they do to others (``released``).

    With all others refitted, chi-square rises inward by 2 g t + t^2 / s^2: g is the gradient that
    pushes against the bound, s the error were there none. The one-sided error is where that is one,
    in units of how the residuals scatter along the parameter, or of independent data.
    """
    if not whitened.held.any():
        return {"inward": {}, "released": {}}
    held, columns, response, steps, moved = _inward(measurement, whitened, scatter)
    names, per_unit = measurement.free.names, whitened.scale / measurement.free.factors()
    released = _released(names, whitened, held, columns, response)
    slack = np.linalg.norm(moved, axis=0) * per_unit
    inverse = np.linalg.pinv(np.linalg.qr(columns, mode="r"))
    n, level = measurement.n_data, measurement.weighting.level
    # columns of an orthonormal basis, and the root of how these are pulled
    variances, axes = np.linalg.eigh(_middle(scatter, level, *np.split(columns @ inverse, [n])))
    few = _few_at_bounds(measurement, whitened, scatter, columns[:n] @ inverse @ axes, variances)
    root = inverse @ axes * np.sqrt(variances.clip(0)) * few
    without = np.linalg.norm(response @ root, axis=1) * per_unit[whitened.live]
    for name, told in released.items():
        i = names.index(name)
        told["slack"] = float(slack[i])
        beyond = np.flatnonzero(whitened.live == i)[0]
        told["without"] = float(without[beyond]) if np.isfinite(told["times"]) else np.inf
    inward = {names[k]: float(t * per_unit[k]) for k, t in zip(held, steps, strict=True)}
    return {"inward": inward, "released": released}


def _few_at_bounds(measurement, whitened, scatter, slopes, variances):
    """Return `_of_few` of what is released from its bounds."""
    freedom = measurement.n_data - whitened.n_taken - int(whitened.held.sum())
    known = scatter is None and not measurement.weighting.from_residuals
    freedom = np.inf if known else freedom
    return _of_few(freedom, scatter, slopes, variances)


def _levels(measurement, whitened, scatter, columns):
    """Return by how much what is held is pulled along its own derivatives, over their length."""
    level, size = measurement.weighting.level, np.linalg.norm(columns, axis=0)
    pulled = np.diag(_middle(scatter, level, *np.split(columns, [measurement.n_data])))
    along = np.where(size > 0, np.sqrt(pulled) / np.where(size > 0, size, 1.0), level)
    slopes = columns[: measurement.n_data]
    return along * _few_at_bounds(measurement, whitened, scatter, slopes, pulled)


def _inward(measurement, whitened, scatter):
    """Return what is held, its derivatives, how others follow, one-sided errors, and the slack.

    The slack is how all parameters move while one at its bound goes inward by its one-sided error,
    (n_held, n_free), in steps of a degree, micrometre or percent.
    """
    held = np.flatnonzero(whitened.held)
    rows = np.concatenate([whitened.rows, whitened.prior_rows])
    vector, weighting = measurement.vector(), measurement.weighting
    residual = Problem(measurement, weighting).residuals(vector)
    # less what the live parameters absorb; orthonormal: each determined direction in units of its
    # standard error
    basis = whitened.along(rows)
    along = basis.T @ rows[:, held]
    columns = rows[:, held] - basis @ along
    size = np.linalg.norm(columns, axis=0)
    columns[:, size <= RANK * whitened.together.singular.max(initial=0.0)] = 0.0
    # a step of what is held moves the live ones by this, shape (n_live, n_held)
    response = -whitened.errors.half.T @ along
    low, high = measurement.free.bounds()
    # from the lower bound up, from the upper one down
    inward = np.where((vector - low <= high - vector)[held], 1.0, -1.0)
    widths = (high - low)[held] / whitened.scale[held]
    # the triangular factor is as good as all rows
    rest = residual - basis @ (basis.T @ residual)
    square = np.linalg.qr(np.column_stack([columns * inward, rest]), mode="r")
    levels = _levels(measurement, whitened, scatter, columns)
    steps = [_rises(square, level, i, widths[i]) for i, level in enumerate(levels)]
    # what the data do not limit is anywhere up to the opposite bound
    far = np.where(np.isfinite(steps), steps, _ANYWHERE * widths)
    moved = np.zeros((held.size, whitened.scale.size))
    moved[:, whitened.live] = response.T
    moved[np.arange(held.size), held] = 1.0
    # without an opposite bound either, it stays where it is
    return held, columns, response, steps, moved * np.where(np.isfinite(far), far, 0.0)[:, None]


def _rises(square, level, i, width):
    """Return how far one may go inward until chi-square over the noise has risen by one."""
    # a calibration is read where there is no scipy
    from scipy.optimize import brentq, nnls

    columns, residual = square[:, :-1], square[:, -1]
    own, others = columns[:, i], np.delete(columns, i, axis=1)
    if not np.isfinite(level) or not own.any():
        return np.nan if own.any() else np.inf

    def excess(t):
        # the others at a bound may go inward, too
        here = residual + t * own
        # `nnls` of no columns breaks the memory of scipy 1.17
        rest = nnls(others, -here)[1] ** 2 if others.size else here @ here
        return rest - residual @ residual - level**2

    # with the others held chi-square is a parabola, so this is where it ends at the earliest
    slope, curvature = own @ residual, own @ own
    least = (np.sqrt(slope**2 + curvature * level**2) - slope) / curvature
    most = least
    while excess(most) < 0 and most < width:
        most *= 2
    if least >= width or excess(min(most, width)) < 0:
        return np.inf
    return least if most == least else brentq(excess, least, min(most, width))


def _released(names, whitened, held, columns, response):
    """Return of what is not at a bound by how much its error grows without the bounds."""
    before = np.sum(whitened.errors.half**2, axis=0)
    after = np.sum(whitened.together.half**2, axis=0)[whitened.live]
    after[~whitened.together.determined[whitened.live]] = np.inf
    with np.errstate(divide="ignore", invalid="ignore"):
        times = np.sqrt(after / before)
        each = response**2 / np.sum(columns**2, axis=0) / before[:, None]
    each = np.nan_to_num(each, nan=0.0, posinf=np.inf)
    found = {}
    for row in np.flatnonzero(whitened.errors.determined & (times > _MATTERS)):
        # each released alone; where only all of them together matter, the one that does most
        enough = min(_MATTERS**2 - 1, each[row].max())
        by = [names[k] for k in held[each[row] >= enough]]
        found[names[whitened.live[row]]] = {"times": float(times[row]), "by": by}
    return found


def status_of(entry):
    """Return one of `STATUSES` for each element of an entry of `Calibration.parameter_values`.

    Badly determined is an error of more than 5 deg, 0.05 mm or 0.05, or larger than that of a value
    anywhere between the bounds.
    """
    shape = np.shape(entry["std"])
    if entry["fixed"] or entry["tied"]:
        return np.full(shape, "tied" if entry["tied"] else "fixed")
    std, (_, size, words) = np.asarray(entry["std"]), step_of(entry["unit"])
    low, high = entry["bounds"]
    width = np.inf if low is None or high is None else high - low
    large = min(LARGE[words] / size * declared_step(entry["unit"]), width * _UNIFORM)
    return np.select(
        [
            entry["at_bound"],
            # without any freedom left nothing tells the noise, and so no error
            ~np.isfinite(std) & ~np.asarray(entry["identifiable"]),
            ~(std <= large),
            ~np.isnan(entry["std_released"]),
            # the data alone leave it open
            ~np.asarray(entry["identifiable"]),
        ],
        STATUSES[2:7],
        STATUSES[7],
    )
