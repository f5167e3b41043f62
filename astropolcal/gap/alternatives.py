# Licensed under a 3-clause BSD style license - see LICENSE
"""
The nominal model, and what is discrete about it: parity, signs, exchanged beams.

A wrong sign leaves a gap as large as the signal. Every alternative is then
calibrated from the start at a few wavelengths, which is enough to tell right
from wrong, and the best one at all of them.
"""

import astropy.units as u
import numpy as np

from astropolcal.calibration import Calibration
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.chain import join, leaves
from astropolcal.exceptions import GapError
from astropolcal.gap.effects import Context, adapted, tracking_laws
from astropolcal.gap.model import nominal_calibration, nominal_model
from astropolcal.observations import common_wavelengths

__all__ = ["starting_model", "thinned"]

# alternatives are tried where double differences are off by more than this
_WRONG_SIGN = 0.02
# or by more than this share of the signal and so many times the noise, as those of stars are
_WRONG_SHARE, _ABOVE_NOISE = 0.3, 3.0
# an alternative must lower the residuals to this share, and those within a tenth are aliases
_FAR_BETTER, _ALIKE = 0.5, 1.1
# fits of what gives the same data end with misfits that differ by a smaller share
_EQUAL = 1e-3
_FEW = 5


def starting_model(calibration, observations, library, say):
    """
    Return the nominal model, and the discrete alternative that beats it.

    Parameters
    ----------
    calibration : Calibration, `~astropy.modeling.CompoundModel` or sequence of them
        A calibration, or the chain of each dataset.
    observations : list of Observations
        The datasets.
    library : sequence of Effect
        Effects, of which the discrete ones are tried.
    say : callable
        Called with a line on what is done next.

    Returns
    -------
    nominal : Model
        The nominal model.
    base : Model
        That of the alternative that beats it, or the nominal model again.
    alternatives : list of Effect
        The alternative and its aliases, or nothing.

    Raises
    ------
    GapError
        If chains and datasets do not go together, or the nominal fit does not
        converge.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.alternatives import starting_model
    >>> from astropolcal.gap.effects import EFFECTS
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(chain, charis.wavelength, frames, seed=1)
    >>> starting_model(chain, [observations], EFFECTS.values(), print)[2]
    []
    """
    given = calibration if isinstance(calibration, Calibration) else None
    chains = calibration.chains if given else calibration
    chains = list(chains) if isinstance(chains, (list, tuple)) else [chains] * len(observations)
    if len(chains) != len(observations):
        raise GapError(f"{len(chains)} chains for {len(observations)} datasets")
    if given is None:
        given = nominal_calibration(chains, observations)
    elif given.measurement is None:
        given = given.with_observations(observations)
    if _may_be_wrong(given):
        discrete = [e for e in adapted(library, chains) if e.kind == "discrete"]
        found = _tried(chains, observations, discrete, say)
        if found and found[0][0] < _FAR_BETTER * _misfit(given):
            say(f"calibrating: {found[0][1].title}")
            edited = found[0][1].edit(chains, _context(observations)).chains
            best = nominal_calibration(edited, observations)
            if _misfit(best) < _FAR_BETTER * _misfit(given):
                return _with_alternative(chains, observations, given, best, found)
    nominal = nominal_model(chains, observations, calibration=given)
    return nominal, nominal, []


def _tried(chains, observations, effects, say):
    """Return misfit and effect of every alternative at a few wavelengths, best first."""
    if not effects:
        return []
    few, context = thinned(chains, observations, _FEW), _context(observations)
    found = []
    for effect in effects:
        say(f"trying: {effect.title}")
        trial = nominal_calibration(effect.edit(few[0], context).chains, few[1])
        found.append((_misfit(trial), effect))
    misfits = np.array([misfit for misfit, _ in found])
    return [found[i] for i in ranked(-misfits, _EQUAL * misfits.min())]


def _context(observations):
    """Return what a discrete effect may know: how the plates follow the sky."""
    return Context(common_wavelengths(observations), tracking=tracking_laws(observations))


def _misfit(calibration):
    """Return the root mean square residual of the double differences, in polarization."""
    return float(np.sqrt(np.mean(np.square(calibration.measurement.residuals()))))


def _may_be_wrong(calibration):
    """Return whether the double differences are so far off that a sign may be wrong."""
    misfit, datasets = _misfit(calibration), calibration.measurement.datasets
    signal, noise = (
        float(np.sqrt(np.mean(np.concatenate([np.square(part(d)) for d in datasets]))))
        for part in (lambda d: d.observed, lambda d: d.sigma)
    )
    # what has no stated errors has no noise to compare with
    clear = not misfit < _ABOVE_NOISE * noise
    return misfit > _WRONG_SIGN or (misfit > _WRONG_SHARE * signal and clear)


def _with_alternative(chains, observations, given, best, found):
    """Return the nominal model, and the model of the alternative with its aliases."""
    model = nominal_model(best.chains, observations, calibration=best)
    # what fits badly need not converge to be left behind
    nominal = nominal_model(chains, observations, calibration=given, like=model, fit=False)
    least, effect = found[0]
    model.added[effect.name] = []
    return nominal, model, [effect, *(o for misfit, o in found[1:] if misfit < _ALIKE * least)]


def thinned(chains, observations, count):
    """
    Return chains and datasets at a few of the wavelengths.

    Parameters
    ----------
    chains : sequence
        The chain of each dataset, on the common wavelengths.
    observations : sequence of Observations
        The datasets.
    count : int
        How many wavelengths to keep, evenly spread.

    Returns
    -------
    chains : list
    observations : list of Observations

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.alternatives import thinned
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> chains, few = thinned([charis.chain()], [observations], 5)
    >>> few[0].n_bins, chains[0]["derotator"].horizontal.shape
    (5, (5,))
    """
    grid = common_wavelengths(observations)
    if count >= len(grid):
        return list(chains), list(observations)
    keep = np.unique(np.linspace(0, len(grid) - 1, count).round().astype(int))
    few = [_at(o, grid[keep]) for o in observations]
    return [join([_picked(leaf, keep, len(grid)) for leaf in leaves(c)]) for c in chains], few


def _at(observations, wavelength):
    own = observations.wavelength.to_value(u.um)
    near = np.isclose(own[:, None], wavelength, rtol=1e-4).any(axis=1)
    return observations.select_bins(near)


def _picked(leaf, keep, size):
    values = {}
    for key in leaf.param_names:
        parameter = getattr(leaf, key)
        if parameter.shape == (size,):
            values[key] = parameter.value[keep] * (parameter.unit or 1)
    return leaf.with_parameters(**values) if values else leaf.copy()
