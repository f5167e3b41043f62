# Licensed under a 3-clause BSD style license - see LICENSE
"""
Errors at a bound, and next to one.

A parameter at its bound has no standard error: chi-square still falls beyond. How far it may go
inward is known, and is its one-sided error. The errors of all others include that it may; where
that matters, they say so, and the error without any bound stands beside theirs.
"""

import numpy as np

from astropolcal.calibration._directions import LARGE, declared_step, step_of

__all__ = ["STATUSES", "errors_at_bounds", "slack_of_bounds", "status_of"]

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
# derivatives that others take up to this share of the largest singular value are open
_OPEN = 1e-9
# as far from one bound as 68 % of what is anywhere between two
_ANYWHERE = 0.6827
# the spread of what is anywhere between two bounds, as a share of their distance
_UNIFORM = 1 / np.sqrt(12)


def errors_at_bounds(measurement, whitened):
    r"""
    Return one-sided errors of parameters at a bound, and what they do to the other errors.

    In the linear problem around the solution, with all others refitted, chi-square in units of the
    noise rises inward by :math:`2 g t + t^2 / s^2`: *g* is the gradient that pushes the parameter
    against its bound, *s* its error were there no bound. The one-sided error is where that is one.

    Parameters
    ----------
    measurement : Measurement
        The fitted measurement, with its ``weighting``.
    whitened : Whitened
        The linear problem around its solution.

    Returns
    -------
    dict
        ``inward``: name to the one-sided error in the parameter's unit, infinite where the data do
        not limit it before the opposite bound. ``released``: name of every other parameter whose
        error grows by more than a tenth without the bounds, to the ratio of the two errors,
        ``times``, with the bound as exact in the smaller one; the names of those at a bound that
        matter, ``by``; and what they add to its error in its unit, as far as they may go inward,
        ``slack``, and if there were no bounds, ``without``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration.bounds import errors_at_bounds
    >>> from astropolcal.calibration.weighting import around
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=2)
    >>> polarizer = chain["calibration_polarizer"]
    >>> polarizer.theta, polarizer.theta.bounds = 91 * u.deg, (90.2, 95)
    >>> cal = calibrate(chain, data, fix={"hwp.theta": None, "derotator.theta": None})
    >>> problem = around(cal.measurement, cal.measurement.weighting)
    >>> list(errors_at_bounds(cal.measurement, problem)["inward"])
    ['calibration_polarizer.theta']
    """
    if not whitened.held.any():
        return {"inward": {}, "released": {}}
    held, columns, response, steps, widths = _inward(measurement, whitened)
    names, per_unit = measurement.free.names, whitened.scale / measurement.free.factors()
    released = _released(names, whitened, held, columns, response)
    slack = np.linalg.norm(_moved(whitened, held, response, steps, widths), axis=0) * per_unit
    root = np.linalg.pinv(np.linalg.qr(columns, mode="r")) * measurement.weighting.level
    without = np.linalg.norm(response @ root, axis=1) * per_unit[whitened.live]
    for name, told in released.items():
        i = names.index(name)
        told["slack"] = float(slack[i])
        beyond = np.flatnonzero(whitened.live == i)[0]
        told["without"] = float(without[beyond]) if np.isfinite(told["times"]) else np.inf
    inward = {names[k]: float(t * per_unit[k]) for k, t in zip(held, steps, strict=True)}
    return {"inward": inward, "released": released}


def slack_of_bounds(measurement, whitened):
    """
    Return how the parameters move while one at its bound goes inward by its one-sided error.

    Parameters
    ----------
    measurement : Measurement
        The fitted measurement, with its ``weighting``.
    whitened : Whitened
        The linear problem around its solution.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_held, n_free), in steps of a degree, micrometre or percent.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> import numpy as np
    >>> from astropolcal.calibration.bounds import slack_of_bounds
    >>> nothing = SimpleNamespace(held=np.zeros(3, dtype=bool), scale=np.ones(3))
    >>> slack_of_bounds(None, nothing).shape
    (0, 3)
    """
    if not whitened.held.any():
        return np.zeros((0, whitened.scale.size))
    held, _, response, steps, widths = _inward(measurement, whitened)
    return _moved(whitened, held, response, steps, widths)


def _inward(measurement, whitened):
    """Return what is held, its derivatives, how others follow, one-sided errors and widths."""
    held = np.flatnonzero(whitened.held)
    columns, residual, response = _without_others(measurement, whitened, held)
    low, high = measurement.free.bounds()
    inward = np.where(_at_low(measurement, held), 1.0, -1.0)
    widths = (high - low)[held] / whitened.scale[held]
    steps = _one_sided(columns * inward, residual, measurement.weighting.level, widths)
    return held, columns, response, steps, widths


def _moved(whitened, held, response, steps, widths):
    # what the data do not limit is anywhere up to the opposite bound
    steps = np.where(np.isfinite(steps), steps, _ANYWHERE * widths)
    rows = np.zeros((held.size, whitened.scale.size))
    rows[:, whitened.live] = response.T
    rows[np.arange(held.size), held] = 1.0
    # without an opposite bound either, it stays where it is
    return rows * np.where(np.isfinite(steps), steps, 0.0)[:, None]


def _at_low(measurement, held):
    """Return which of those at a bound are at the lower one."""
    vector, (low, high) = measurement.vector(), measurement.free.bounds()
    return (vector - low <= high - vector)[held]


def _without_others(measurement, whitened, held):
    """Return derivatives and residuals less what the live parameters take up, and how these go."""
    vector, weighting = measurement.vector(), measurement.weighting
    rows = np.concatenate([whitened.rows, whitened.prior_rows])
    weight = 1.0 if weighting.weight is None else weighting.weight
    data = -weight * measurement.residuals(vector)
    priors = weighting.level * measurement.free.prior_residuals(vector)
    residual = np.concatenate([data, priors])
    # orthonormal: each determined direction in units of its standard error
    basis = rows[:, whitened.live] @ whitened.errors.half.T
    along = basis.T @ rows[:, held]
    columns = rows[:, held] - basis @ along
    size = np.linalg.norm(columns, axis=0)
    columns[:, size <= _OPEN * whitened.together.singular.max(initial=0.0)] = 0.0
    # a step of what is held moves the live ones by this, shape (n_live, n_held)
    return columns, residual - basis @ (basis.T @ residual), -whitened.errors.half.T @ along


def _one_sided(columns, residual, level, widths):
    """Return how far each may go inward until chi-square over the noise has risen by one."""
    # the triangular factor is as good as all rows
    square = np.linalg.qr(np.column_stack([columns, residual]), mode="r")
    columns, residual = square[:, :-1], square[:, -1]
    return [_rises(columns, residual, level, i, width) for i, width in enumerate(widths)]


def _rises(columns, residual, level, i, width):
    # a calibration is read where there is no scipy
    from scipy.optimize import brentq, nnls

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
    """
    Say of each element of a parameter whether it can be trusted.

    Parameters
    ----------
    entry : dict
        As `~astropolcal.calibration.Calibration.parameter_values` has it: ``std``,
        ``std_released``, ``unit``, ``bounds``, ``fixed``, ``tied``, ``at_bound``,
        ``identifiable``.

    Returns
    -------
    `~numpy.ndarray` of str
        One of `STATUSES` each, of the shape of ``std``. Badly determined is what has an error of
        more than 5 deg, 0.05 mm or 0.05, or larger than that of something anywhere between its
        bounds.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration.bounds import status_of
    >>> entry = {"std": np.array([0.01, 0.2]), "std_released": np.full(2, np.nan), "unit": None}
    >>> entry |= {"fixed": False, "tied": None, "at_bound": np.zeros(2, dtype=bool)}
    >>> entry |= {"bounds": (0, 1), "identifiable": np.ones(2, dtype=bool)}
    >>> status_of(entry).tolist()
    ['determined', 'badly determined']
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
