# Licensed under a 3-clause BSD style license - see LICENSE
"""
Choice of a gauge: one of the solutions that the data cannot tell apart.

Where the data leave directions open, every point along them fits equally well,
and where a fit ends is an accident of its start. The *minimal* gauge takes the
solution whose parameters common to all wavelengths (the misalignments) have
moved least from where they started. A user names another gauge by holding
parameters (``fix=``) or by a prior.
"""

import numpy as np

from astropolcal.calibration.identifiability import null_space, physical_scale
from astropolcal.exceptions import FitError

__all__ = ["describe_gauge", "settle"]

GAUGES = ("minimal", None)
_ROUNDS = 6
# a gauge is reached when the leading parameters would move by less (deg, um, percent)
_SETTLED = 1e-4
# longest step along an open direction, in the same units: the surface of solutions is curved
_LONGEST = 2.0
# the solution is left alone if a move spoils it by more than this share
_SPOILT = 1e-3
# a parameter is open if it moves by more than this share along an open direction
_OPEN = 1e-3


def settle(problem, weight, origin):
    """
    Move a solution along the directions that no datum sees, to the minimal gauge.

    Parameters
    ----------
    problem : BinProblem
        The bins of the fitted measurement; its values are changed.
    weight : `~numpy.ndarray` or None
        Weight of each datum.
    origin : `~numpy.ndarray`
        Where the fit started, shape (n_free,).

    Returns
    -------
    list of str
        Parameters common to all wavelengths that the data leave open; those
        that were brought home, if the gauge is minimal.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import BinProblem, settle
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.published()
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> measurement = Measurement(chain, simulate(chain, charis.wavelength, frames, noise=False))
    >>> settle(BinProblem(measurement), None, measurement.vector())
    ['calibration_polarizer.theta', 'hwp.theta', 'derotator.theta']
    """
    measurement = problem.measurement
    vector, chosen = measurement.vector(), []
    leaders = _leaders(measurement.free)
    for _ in range(_ROUNDS):
        null = null_space(measurement.free, _whitened(measurement, vector, weight))
        if not len(null):
            break
        chosen = _open(measurement.free, null)
        step = _step(measurement.free, null, leaders, vector - origin)
        if np.abs(step[leaders] / physical_scale(measurement.free)[leaders]).max() < _SETTLED:
            break
        moved = _move(problem, vector, step)
        if moved is None:
            break
        vector = moved
    measurement.parameters = vector
    return chosen


def open_parameters(measurement, weight):
    """Return the parameters common to all wavelengths that data and priors leave open."""
    vector = measurement.vector()
    jacobian = np.concatenate(
        [_whitened(measurement, vector, weight), measurement.free.prior_jacobian(vector)], axis=1
    )
    return _open(measurement.free, null_space(measurement.free, jacobian))


def _whitened(measurement, vector, weight):
    return measurement.jacobian(vector) * (1.0 if weight is None else weight)


def _open(free, null):
    """Return the names of what moves along the open directions, leaders first."""
    moving = [slot for slot in free.slots if np.abs(null[:, slot.slice]).max(initial=0) > _OPEN]
    return [s.name for s in moving if not s.per_wavelength] or [s.name for s in moving]


def _leaders(free):
    """Return the elements whose moves are to be small: those common to all wavelengths."""
    single = [slot.start for slot in free.slots if not slot.per_wavelength]
    return np.array(single if single else range(free.size), dtype=int)


def _step(free, null, leaders, moved):
    """Return the step along the open directions that brings the leaders nearest to home."""
    scale = physical_scale(free)
    along, *_ = np.linalg.lstsq(null[:, leaders].T, -(moved / scale)[leaders], rcond=1e-6)
    step = along @ null
    longest = np.abs(step).max()
    return step * scale * min(1.0, _LONGEST / longest if longest else 1.0)


def _move(problem, vector, step):
    """Take the step and let the bins follow; None where that spoils the solution."""
    low, high = problem.measurement.free.bounds()
    before = problem.costs(vector).sum()
    trial = np.clip(vector + step, low, high)
    trial, costs = problem.polish(trial, iterations=8, still_gaining=1 - 1e-12)
    # noise-free data are fitted to rounding: there, a share of nothing is nothing
    spoilt = costs.sum() > (1 + _SPOILT) * before + 1e-12 * problem.measurement.n_data
    return None if spoilt else trial


def describe_gauge(gauge, chosen, free, held):
    """
    Say which of the equivalent solutions a calibration reports, and why.

    Parameters
    ----------
    gauge : str or None
        What was asked for.
    chosen : sequence of str
        Parameters that the data leave open.
    free : FreeParameters
        The free parameters.
    held : sequence of str
        Parameters that the user holds.

    Returns
    -------
    str

    Raises
    ------
    FitError
        If the gauge is unknown.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.calibration import describe_gauge
    >>> from astropolcal.measurement import FreeParameters
    >>> free = FreeParameters([optics.WollastonPrism(name="wollaston")], 1)
    >>> describe_gauge("minimal", [], free, ["hwp.theta"])
    'held: hwp.theta; the data determine every free parameter'
    """
    if gauge not in GAUGES:
        raise FitError(f"gauge = {gauge!r}; allowed are 'minimal' and None")
    parts = [f"held: {', '.join(held)}"] if held else []
    if free.priors:
        parts.append(f"prior on {', '.join(slot.name for slot, _ in free.priors)}")
    if not chosen:
        known = "data and priors determine" if free.priors else "the data determine"
        parts.append(f"{known} every free parameter")
    elif gauge is None or free.priors:
        parts.append(f"none for {', '.join(chosen)}: where the fit ended, an accident of its start")
    else:
        parts.append(f"minimal: of all equal fits, the least change of {', '.join(chosen)}")
    return "; ".join(parts)
