# Licensed under a 3-clause BSD style license - see LICENSE
"""
Forward selection of effects, checked on left-out frames, with exchanges.

The best effect is added, the scan repeated at the better model, and so on while
left-out frames are predicted better. What was chosen first was chosen while the
others were missing: next to all the others, each effect is then exchanged if
another one explains the data clearly better, and dropped if it is not needed.
"""

from dataclasses import replace

import numpy as np

from astropolcal.calibration._directions import ranked
from astropolcal.gap.attribution import (
    EQUAL_EVIDENCE,
    SAME_EVIDENCE,
    best_of,
    choose,
    contenders,
    freed,
    scan,
)
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
# so many first effects are tried with a second one
_LOOKED_AHEAD = 4
_EXCHANGED_AT = (2,)
# an effect that explains this share gives way to one other alone, and only if that is simpler
# or what is left falls to this share; what takes another out of its limits has to do as well
_MAIN, _CLEARLY = 0.5, 2 / 3


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
    looking for effect 1, at most 6
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
        say(f"looking for effect {len(selected) + 1}, at most {_MOST_CAUSES}")
        pick = choose if selected else _looking_ahead
        candidate = pick(model, scores, alpha=alpha)
        if candidate is None or not _worthy(model, candidate):
            break
        candidate = freed(model, candidate)
        say(f"left-out frames with: {candidate.score.effect.title}")
        possible = candidate.physical and not _pushes(candidate.model, model)
        errors = _errors(candidate.model, groups) if possible else None
        scatter = candidate.model.mean_square
        if not (possible and _holds(errors, history[-1], scatter)):
            refused += 1
            scores = [score for score in scores if score.effect.name != candidate.name]
            continue
        selected.append(candidate)
        history.append(errors)
        # the first choices are the least certain while much is unexplained
        if scatter > _STRUCTURED and len(selected) in _EXCHANGED_AT:
            selected, history = _exchanged(base, selected, history, library, alpha, groups, say)
        model = selected[-1].model
        scores = scan(model, _without_aliases(library, selected))
    return selected, history


def _looking_ahead(model, scores, *, alpha):
    """
    Return the first effect: where much is left, the one that does best with a second one.

    What a single effect explains best while another large one is missing is often a
    makeshift for both.
    """
    fitted = contenders(model, scores, alpha=alpha)
    if not fitted or fitted[0].model.mean_square < _STRUCTURED:
        return best_of(fitted)
    library = [score.effect for score in scores]
    ends = []
    for one in [c for c in fitted if c.physical][:_LOOKED_AHEAD]:
        second = choose(one.model, scan(one.model, library), alpha=alpha, most=_RIVALS)
        # with its name, and the model with both
        end = (None, one.model) if second is None else (second.name, second.model)
        ends.append((one, *end))
    if not ends:
        return fitted[0]
    evidence = [_advantage(item[2], model) for item in ends]
    best, next_to, end = ends[ranked(evidence, EQUAL_EVIDENCE)[0]]
    # next to the same second effect: two that are both needed do as well in either order
    best.aliases = [
        one
        for one, second, other in ends
        if one is not best and second == next_to and _advantage(end, other) < SAME_EVIDENCE
    ]
    return best


def _without_aliases(library, chosen):
    """Return the library less what cannot be told from an effect that is in the model."""
    known = {alias.name for candidate in chosen for alias in candidate.aliases}
    return [effect for effect in library if effect.name not in known]


def _worthy(model, candidate):
    """Whether a candidate explains enough of what is left, or all that is to be explained."""
    excess = model.fit.chi2 - (model.problem.n_data - model.problem.size)
    lowered = model.fit.chi2 - candidate.model.fit.chi2
    left = candidate.model.p_value
    return left > REMAINDER or lowered > _LEAST_SHARE * max(excess, 1e-300)


def _pushes(new, old):
    """Whether a model takes an effect out of its limits that another leaves within, for little."""
    pushed = (new.impossible() & old.added.keys()) - old.impossible()
    return bool(pushed) and new.fit.chi2 > _CLEARLY * old.fit.chi2


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
    chosen, now = list(selected), selected[-1].model if selected else base
    # the last one was chosen next to all the others already; the first ones explain the most
    # and are the last to be dropped
    for i in reversed(range(len(chosen) - 1)):
        say(f"in exchange for: {chosen[i].score.effect.title}")
        model, others = _with(base, chosen[:i] + chosen[i + 1 :], now)
        main = _is_main(base, selected, chosen[i])
        if _advantage(model, now) > 0 and not main and not _pushes(model, now):
            chosen, now = others, model
            continue
        if chosen[i].context is None:
            # a law that was stiff enough while others were missing need not be so now
            loose = freed(model, replace(chosen[i], model=now))
            if not _pushes(loose.model, now):
                chosen[i], now = loose, loose.model
        rival = _rival(model, chosen[i], others, library, alpha)
        if rival is None or (main and not _supersedes(rival.model, now)):
            continue
        if _advantage(rival.model, now) > SAME_EVIDENCE and not _pushes(rival.model, now):
            place = len({one.name for one in others} & {one.name for one in chosen[:i]})
            chosen, now = [*others[:place], rival, *others[place:]], rival.model
    if _outline(chosen) == _outline(selected):
        return selected, history
    # a law that was freed may do what needed another effect before
    for i in reversed(range(len(chosen))):
        model, others = _with(base, chosen[:i] + chosen[i + 1 :], now)
        main = _is_main(base, selected, chosen[i])
        if others and _advantage(model, now) > 0 and not main and not _pushes(model, now):
            chosen, now = others, model
    return _retraced(base, chosen, now, groups, history[0])


def _with(base, chosen, like):
    """Return the model with effects, and those of them that have a place in it."""
    model = base.with_effects([c.recipe for c in chosen], like=like)
    return model, [c for c in chosen if c.name in model.added]


def _supersedes(new, old):
    """Whether a model is simpler than another, or leaves clearly less."""
    return new.problem.size < old.problem.size or new.fit.chi2 < _CLEARLY * old.fit.chi2


def _outline(chosen):
    return [(candidate.name, candidate.context is None) for candidate in chosen]


def _is_main(base, selected, candidate):
    """Whether an effect explained most of the gap: that is not left to several others."""
    names = [one.name for one in selected]
    if candidate.name not in names:
        return False
    i = names.index(candidate.name)
    before = selected[i - 1].model if i else base
    lowered = before.fit.chi2 - candidate.model.fit.chi2
    return lowered > _MAIN * (base.fit.chi2 - selected[-1].model.fit.chi2)


def _rival(model, candidate, others, library, alpha):
    """Return the best effect next to the others, None if that is the candidate."""
    scores = scan(model, _without_aliases(library, others))
    rival = choose(model, scores, alpha=alpha, most=_RIVALS)
    if rival is None or rival.name == candidate.name or not rival.physical:
        return None
    return freed(model, rival)


def _advantage(new, old):
    """Return by how much the evidence for a model is above that for another."""
    freedom = max(new.problem.n_data - new.problem.size, 1)
    scale = max(1.0, min(new.mean_square, old.mean_square))
    cost = (new.problem.size - old.problem.size) * np.log(freedom)
    return (old.fit.chi2 - new.fit.chi2) / scale - cost


def _retraced(base, chosen, last, groups, first):
    """Return candidates and held-out errors as if they had been added in this order."""
    model, selected, history = base, [], [first]
    for i, candidate in enumerate(chosen):
        fresh = base.with_effects([c.recipe for c in chosen[: i + 1]], like=last)
        freedom = max(fresh.problem.n_data - fresh.problem.size, 1)
        gain = (model.fit.chi2 - fresh.fit.chi2) / max(1.0, fresh.mean_square)
        cost = (fresh.problem.size - model.problem.size) * np.log(freedom)
        candidate.model, candidate.gain, candidate.evidence = fresh, gain, gain - cost
        selected.append(candidate)
        history.append(_errors(fresh, groups))
        model = fresh
    return selected, history
