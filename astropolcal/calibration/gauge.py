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

from astropolcal.calibration.identifiability import physical_scale
from astropolcal.calibration.weighting import Weighting, around
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
# what changes the data by less than this (for a degree, micrometre, percent) changes none
_SILENT = 1e-12


def settle(problem, weight, origin):
    """
    Move a solution along the directions that no datum sees, to the minimal gauge.

    Directions that a prior closes are not open.

    Parameters
    ----------
    problem : BinProblem
        The bins of the fitted measurement; its values are changed.
    weight : `~numpy.ndarray`, Weighting or None
        Weight of each datum, or the noise that the fit assumed.
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
    weighting = weight if isinstance(weight, Weighting) else _weighting(measurement, weight)
    return settled(problem, weighting, origin)[0]


def _weighting(measurement, weight):
    if weight is None:
        return Weighting(None, np.full(measurement.n_data, np.nan))
    return Weighting("given", 1 / np.asarray(weight, dtype=float))


def settled(problem, weighting, origin):
    """Settle; return the open parameters and the linear problem around the new solution."""
    measurement = problem.measurement
    vector = measurement.vector()
    scale, leaders = physical_scale(measurement.free), _leaders(measurement.free)
    whitened = around(measurement, weighting, vector)
    for _ in range(_ROUNDS):
        null = whitened.together.null
        if not len(null):
            break
        # open directions turn as one moves along them, so in steps with a new null space each
        step = _step(null, leaders, scale, vector - origin)
        if np.abs(step[leaders] / scale[leaders]).max() < _SETTLED:
            break
        moved = _move(problem, vector, step)
        if moved is None:
            break
        vector = moved
        whitened = around(measurement, weighting, vector)
    measurement.parameters = vector
    return open_parameters(measurement.free, whitened), whitened


def open_parameters(free, whitened):
    """Return the parameters common to all wavelengths that data and priors leave open."""
    return _open(free, whitened.together.null)


def hold_silent(measurement, origin):
    """Put back to the start what ended elsewhere although it changes no datum."""
    vector, scale = measurement.vector(), physical_scale(measurement.free)
    slopes = np.abs(measurement.jacobian(vector)).max(axis=1, initial=0.0) * scale
    still = (slopes < _SILENT) & (vector != origin)
    for slot, prior in measurement.free.priors:
        # a prior that is not flat has put it where it belongs
        still[slot.slice] &= prior.is_flat
    predicted = measurement.predict(vector)
    for i in np.flatnonzero(still):
        trial = vector.copy()
        trial[i] = origin[i]
        if np.abs(measurement.predict(trial) - predicted).max() < _SILENT:
            vector = trial
    if still.any():
        measurement.parameters = vector


def _open(free, null):
    """Return the names of what moves along the open directions, leaders first."""
    moving = [slot for slot in free.slots if np.abs(null[:, slot.slice]).max(initial=0) > _OPEN]
    return [s.name for s in moving if not s.per_wavelength] or [s.name for s in moving]


def _leaders(free):
    """Return the elements whose moves are to be small: those common to all wavelengths."""
    single = [slot.start for slot in free.slots if not slot.per_wavelength]
    return np.array(single if single else range(free.size), dtype=int)


def _step(null, leaders, scale, moved):
    """Return the step along the open directions that brings the leaders nearest to home."""
    # least squares of what the leaders are away from home, over shifts along the null directions
    along, *_ = np.linalg.lstsq(null[:, leaders].T, -(moved / scale)[leaders], rcond=1e-6)
    step = along @ null
    longest = np.abs(step).max()
    return step * scale * min(1.0, _LONGEST / longest if longest else 1.0)


def _move(problem, vector, step):
    """Take the step and let the bins follow; None where that spoils the solution."""
    low, high = problem.measurement.free.bounds()
    before = problem.total(vector)
    trial = np.clip(vector + step, low, high)
    # a straight step leaves the curved surface of equal fits; the bins find back to it
    trial, _ = problem.polish(trial, iterations=8, still_gaining=1 - 1e-12)
    # noise-free data are fitted to rounding: there, a share of nothing is nothing
    spoilt = problem.total(trial) > (1 + _SPOILT) * before + 1e-12 * problem.measurement.n_data
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
    elif gauge is None:
        parts.append(f"none for {', '.join(chosen)}: where the fit ended, an accident of its start")
    else:
        parts.append(f"minimal: of all equal fits, the least change of {', '.join(chosen)}")
    return "; ".join(parts)
