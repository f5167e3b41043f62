# Licensed under a 3-clause BSD style license - see LICENSE
"""
Forward selection of effects, checked on left-out frames, with exchanges.

The best effect is added, the scan repeated at the better model, and so on while
left-out frames are predicted better. What was chosen first was chosen while the
others were missing: next to all the others, each effect is then exchanged if
another one explains the data clearly better, and dropped if it is not needed.
"""

from operator import is_

import numpy as np

from astropolcal.gap.attribution import SAME_EVIDENCE, choose, freed, scan
from astropolcal.gap.shrinkage import held_out

__all__ = ["REMAINDER", "select"]

#: Residuals less probable than this are no noise.
REMAINDER = 1e-4
_MOST_CAUSES = 6
# so many effects may be refused by left-out frames before the selection ends
_MOST_REFUSED = 3
# an effect that explains less of a significant gap than this is no cause of it
_LEAST_SHARE = 0.05
# above this mean square the residuals are no noise, and held-out frames have the last word
_STRUCTURED = 1.5
# so many are fitted in full where an effect might be exchanged
_RIVALS = 4
_EXCHANGED_AT = (2, 3)


def select(base, scores, library, alpha, groups, say):
    """
    Choose the effects that a model lacks.

    Parameters
    ----------
    base : Model
        The fitted model.
    scores : list of Score
        The scan at it.
    library : sequence of Effect
        Effects that are not discrete.
    alpha : float
        False discovery rate.
    groups : tuple or None
        As `frame_groups` gives them; None to trust the scan alone.
    say : callable
        Called with a line on what is done next.

    Returns
    -------
    selected : list of Candidate
        In the order in which they were added.
    model : Model
        With all of them.
    history : list of HeldOut or None
        Errors on left-out frames of the base and after each effect.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import EFFECTS
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.selection import select
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> select(model, [], EFFECTS.values(), 0.01, None, print)[0]
    []
    """
    selected, history = _forward(base, scores, library, alpha, groups, say)
    selected, history = _exchanged(base, selected, history, library, alpha, groups, say)
    return selected, selected[-1].model if selected else base, history


def _forward(base, scores, library, alpha, groups, say):
    """Add effects one by one; return candidates and held-out errors."""
    model, selected, refused = base, [], 0
    history = [_errors(base, groups)]
    while len(selected) < _MOST_CAUSES and refused < _MOST_REFUSED:
        candidate = choose(model, scores, alpha=alpha)
        if candidate is None or not _worthy(model, candidate):
            break
        candidate = freed(model, candidate)
        say(f"left-out frames with: {candidate.score.effect.title}")
        errors = _errors(candidate.model, groups) if candidate.physical else None
        scatter = candidate.model.mean_square
        if not (candidate.physical and _holds(errors, history[-1], scatter)):
            refused += 1
            scores = [score for score in scores if score.effect.name != candidate.name]
            continue
        selected.append(candidate)
        history.append(errors)
        # the first choices are the least certain while much is unexplained
        if scatter > _STRUCTURED and len(selected) in _EXCHANGED_AT:
            selected, history = _exchanged(base, selected, history, library, alpha, groups, say)
        model = selected[-1].model
        scores = scan(model, library)
    return selected, history


def _worthy(model, candidate):
    """Whether a candidate explains enough of what is left, or all that is to be explained."""
    excess = model.fit.chi2 - (model.problem.n_data - model.problem.size)
    lowered = model.fit.chi2 - candidate.model.fit.chi2
    left = candidate.model.p_value
    return left > REMAINDER or lowered > _LEAST_SHARE * max(excess, 1e-300)


def _holds(errors, before, scatter):
    if errors is None:
        return True
    # among pure noise the scan is to be trusted, unless left-out frames speak against it
    if scatter < _STRUCTURED:
        return errors.better_than(before) > -2
    return errors.better_than(before) > 1 and errors.squares.sum() < before.squares.sum()


def _errors(model, groups):
    return None if groups is None else held_out(model, groups)


# ---- exchanges -------------------------------------------------------------------------------


def _exchanged(base, selected, history, library, alpha, groups, say):
    """Return the candidates, each the best next to all the others, and held-out errors."""
    chosen, i = list(selected), 0
    # the last one was chosen next to all the others already
    while i < len(chosen) - 1:
        say(f"in exchange for: {chosen[i].score.effect.title}")
        better = _rival(base, chosen, i, library, alpha)
        chosen[i : i + 1] = better
        i += len(better)
    if len(chosen) == len(selected) and all(map(is_, chosen, selected)):
        return selected, history
    return _retraced(base, chosen, groups, history[0])


def _rival(base, chosen, i, library, alpha):
    """Return what belongs in the place of a candidate, a list: itself, another, or nothing."""
    now = base.with_effects([c.recipe for c in chosen])
    model = base.with_effects([c.recipe for c in chosen[:i] + chosen[i + 1 :]])
    if _advantage(model, now) > 0:
        return []
    rival = choose(model, scan(model, library), alpha=alpha, most=_RIVALS)
    if rival is None or rival.name == chosen[i].name or not rival.physical:
        return [chosen[i]]
    rival = freed(model, rival)
    return [rival if _advantage(rival.model, now) > SAME_EVIDENCE else chosen[i]]


def _advantage(new, old):
    """Return by how much the evidence for a model is above that for another."""
    freedom = max(new.problem.n_data - new.problem.size, 1)
    scale = max(1.0, min(new.mean_square, old.mean_square))
    cost = (new.problem.size - old.problem.size) * np.log(freedom)
    return (old.fit.chi2 - new.fit.chi2) / scale - cost


def _retraced(base, chosen, groups, first):
    """Return candidates and held-out errors as if they had been added in this order."""
    model, selected, history = base, [], [first]
    for i, candidate in enumerate(chosen):
        fresh = base.with_effects([c.recipe for c in chosen[: i + 1]])
        freedom = max(fresh.problem.n_data - fresh.problem.size, 1)
        gain = (model.fit.chi2 - fresh.fit.chi2) / max(1.0, fresh.mean_square)
        cost = (fresh.problem.size - model.problem.size) * np.log(freedom)
        candidate.model, candidate.gain, candidate.evidence = fresh, gain, gain - cost
        selected.append(candidate)
        history.append(_errors(fresh, groups))
        model = fresh
    return selected, history
