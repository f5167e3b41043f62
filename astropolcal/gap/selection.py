# Licensed under a 3-clause BSD style license - see LICENSE
"""
Joint choice of the causes that a model lacks, with probabilities.

Sets of causes grow side by side: the best few sets are kept, each is fitted in full, and the scan
is repeated beside it until no cause is missed any more. Then every cause of the best set is looked
at beside all the others: what explains the data nearly as well in its place is its alias group. An
answer of several unrelated causes is less probable than one cause that no table has, and what the
set leaves lowers the probability of all its causes.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, pairwise
from operator import attrgetter, eq

import numpy as np
from scipy.special import expit

from astropolcal import progress
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.chain import leaves
from astropolcal.gap.attribution import ALIKE, DECIMALS, ENOUGH, Candidate, preference, scan
from astropolcal.gap.cells import BETWEEN_BEAMS, Cell, alike, count_runs, in_other_frame
from astropolcal.gap.courses import alike_courses, real_courses
from astropolcal.gap.shrinkage import foreseen, stability

__all__ = []

# the best candidates count where residuals are no noise
_RETEMPERED = 400
# fits on the way to the answer need not be carried to the end
_QUICK = {"steps": 24, "share": 1e-3}
# of so many causes two may be one that was not seen while the others were missing
_MERGED = (2, 4)
# log evidence by which a name may be behind its cell, and a rival has to be ahead
_AS_GOOD, _CLEARLY = 1.0, 3.0
#: Residuals less probable than this are no noise.
REMAINDER = 1e-4
# and more probable than this they may be
_NOISE = 1e-3
_MOST = 8
# of several runs together, for each run
_MOST_TOGETHER = 10
# what a nominal model has of an optic that turns
_OF_OPTIC = ("retardance_h", "retardance_d", "rotation")
# by the number of causes: so many sets grow side by side, and so many of their continuations
# are fitted in full
_WIDTH, _FITTED = (3, 2, 2, 1), (6, 4, 4, 3)
# those that promise less than this share of what the best of them gained are not
_PROMISING = 0.8
# but this, where the freedom of the best costs more (log evidence): two simple ones may do better
_HALF, _DEAR = 0.5, 30.0
# as much freedom as two functions of the frame with a smooth law
_FREE = 6
# and this of a name with one number, where no derivative explains the gap down to noise
_FAR_PROMISE = 0.3
# the evidence ranks sets of at most so many causes, if these leave more than noise
_BY_EVIDENCE = 2
# names are asked for beside so many causes
_NAMES = 2
# of so many of the best rivals those that have names are asked for
_AMONG = 12
# causes that lower chi-square by shares closer than this are the same for these data
_SAME = 1e-6
# an alias is no less probable than this against the best; so many are listed
_ALIAS, _MOST_ALIASES = np.exp(-ALIKE), 40
# a rival whose statistic is as near as this share is fitted in full, where it is as large as that
_NEAR, _BENT = 0.03, 500.0
# and so is one that needs a size so many times as far from the usual
_FAR = 3.0
# prior probability that a gap has no cause of the table, by the number of causes that an answer
# needs: of two that differ 433 of 438 causes were right in 680 challenges, of three 12 of 54 in
# another 934, of four 1 of 12, of more 2 of 69
_UNLISTED = (0.0, 0.01, 0.03, 0.8, 0.92, 0.93, 0.94, 0.95, 0.97)
# the same of a single cause by the share of the gap that noise may hide, where another course
# would look like that of the table: below both 58 of 60 answers to mechanisms were right, above 11
# of 20, and a quarter of all gaps may be of this sort
_MAY_HIDE, _UNSEEN = (0.25, 0.35), (0.0, 0.11)
# the same where one course that no table has does as well as several causes do together, and below
# how many standard deviations it does: within 2 were 7 of 52 answers to pairs, all right, and 34 of
# 36 to mechanisms, of whose 68 causes 9 were right; the 2.8 that the choice of a law gains from
# noise in 96 frames are counted since
_ONE_COURSE, _AS_WELL = 0.65, 4.3
# and where it does better than a single cause: of 150 answers to cells none was below 0, but those
# that leave a remainder anyway; of 63 to mechanisms 11, and below -0.7 three right of eight
_BETTER_COURSE, _BETTER = 0.85, -0.7
# and where two causes have the same course, or the same place and kind: of such causes given to
# mechanisms with 0.8 or more 2 of 16 and 2 of 10 were right (4 of 10 if any law counts); of 229
# answers to pairs none was of the first sort, and all six of the second were right
_ALIKE_CAUSES = {"course": 0.85, "action": 0.5, "optic": 0.0, "": 0.0}
# from this probability on it is told
_MAY_BE = 0.3
# the same where one of several causes is not asked for in every part of the data: 23 of 52
_SHAKY = 0.5
# above this mean square the residuals are no noise
_STRUCTURED = 1.5
# share of the gap that an answer may leave before it is doubtful
_LEFT = 0.1


@dataclass
class Group:
    """One cause, with all that cannot be distinguished from it.

    ``members`` are candidates, best first, with their probabilities among each other, and
    ``probability`` is that of one of them being a cause. The fit had ``lowered`` chi-square by so
    much; ``stability`` is the share of halves and of left-out angles in which it is found.
    """

    members: list
    probability: float
    lowered: float = 0.0
    stability: float | None = None
    by_dataset: dict = field(default_factory=dict)

    @property
    def best(self):
        """The most probable candidate."""
        return self.members[0][0]


@dataclass
class Selection:
    """The causes in the order in which they were added, and the model with all of them.

    ``scan`` is the evidence beside the base, ``unlisted`` the probability of a cause that no table
    has, and ``history`` the errors on left-out frames of the base and after each cause. One of the
    ``courses`` may be in place of all causes.
    """

    groups: list
    model: object
    scan: object
    unlisted: float
    history: list
    courses: list = field(default_factory=list)


@dataclass
class _State:
    """A set of causes, and its model."""

    model: object
    chosen: list = field(default_factory=list)

    def evidence(self, temper):
        """Return the logarithm of the evidence, up to what is the same for all sets."""
        costs = self.model.costs(temper)
        costs = sum(costs.get(one.name, 0.0) - one.prior for one in self.chosen)
        return -0.5 * self.model.fit.chi2 / temper - costs

    def worth(self, temper):
        """Return the same with the prior odds against every cause."""
        return self.evidence(temper) - ENOUGH * len(self.chosen)

    @property
    def outline(self):
        return frozenset(one.name for one in self.chosen)

    @property
    def name(self):
        return sorted(self.outline)

    @property
    def is_dear(self):
        """Whether one cause alone has much freedom."""
        return len(self.chosen) == 1 and sum(self.model.costs(1.0).values()) > _DEAR


@dataclass
class _Task:
    """What is asked: the model that lacks causes, from which to choose, and how it is checked."""

    base: object
    library: list
    cells: bool
    groups: tuple | None
    say: object
    has_runs: bool = False

    def fitted(self, chosen, like, **how):
        """Return the base with causes, fitted in full."""
        return self.base.with_effects([one.recipe for one in chosen], like=like, **how)

    def quickly(self, chosen, like):
        """Return a set of causes, fitted well enough to be compared."""
        return _State(self.fitted(chosen, like, **_QUICK), chosen)


def _temper(*states):
    """Return the variance of residuals, in units of noise, by which sets are compared."""
    return max(1.0, min(one.model.mean_square for one in states))


def select(base, library, groups, say, *, cells=True, changes=False, most=_MOST):
    """Choose the causes that a model lacks, of one run no more than ``most``."""
    first, runs = _scanned(base, library, cells), count_runs(base.problem)
    task = _Task(base, library, cells, groups, say, has_runs=runs > 1)
    most = min(most, _MOST) if runs < 2 or not cells else _MOST // 2
    best = _search(task, _State(base), first, most)
    if runs > 1 and len(best.chosen) >= most and best.model.p_value < REMAINDER:
        best = _apart(task, first)
        best = _search(replace(task, library=[]), best, first, _MOST_TOGETHER * runs)
    if not best.chosen:
        task.say("one perturbation of any course")
        seen = alike_courses(base, real_courses(base, base, REMAINDER))
        return Selection([], base, first, 0.0, [_errors(base, groups)], seen)
    if first.probes.has_more_steps:
        # those between the steps of the first scan, which were found since
        first = _scanned(base, library, cells)
    best = _with_axes(task, _merged(task, best))
    best, scans = _exchanged(task, best, first)
    best = replace(best, model=best.model.polished())
    if changes:
        shared = [one for one in best.chosen if first.probes.run_of(one.cell) is None]
        own = [one for one in best.chosen if one not in shared]
        best = replace(best, chosen=[*own, *shared])
    # what is possible in place of causes of impossible size
    for one in best.chosen:
        other = None if best.model.is_physical(one.name) else _in_place(task, one, best)
        if other is not None:
            fresh = [new.name for new in other.chosen if new.name not in scans]
            scans |= dict.fromkeys(fresh, scans[one.name])
            best = other
    best, steps, history = _checked(task, best)
    stable = stability(best.model, groups, max(1.0, best.model.mean_square))
    task.say("one perturbation of any course")
    rivals = real_courses(best.model, base, REMAINDER)
    # what changed between runs has two causes, and one course in all of them: that is no evidence
    is_one = alike([one.cell for one in best.chosen]) == "optic"
    of_several = _ONE_COURSE * (runs < 2 and len(best.chosen) > 1 and not is_one)
    behind = np.array([one.behind for one in rivals])
    chances = np.maximum(
        _BETTER_COURSE * expit(3 * (_BETTER - behind)), of_several * expit(_AS_WELL - behind)
    )
    chance = chances.max(initial=0.0)
    unlisted = _unlisted(base, best, stable, chance)
    found = _grouped(task, best, steps, scans, unlisted, stable)
    told = rivals if chance > _MAY_BE else []
    return Selection(found, best.model, first, unlisted, history, alike_courses(base, told))


def _errors(model, groups):
    return None if groups is None else foreseen(model, groups)


def _merged(task, best):
    """Return the set with two causes exchanged for one that does what both do."""
    if not _MERGED[0] <= len(best.chosen) <= _MERGED[1]:
        return best
    temper, found = _temper(best), best
    for pair in combinations(best.chosen, 2):
        task.say(f"as one cause: {' and '.join(one.effect.title for one in pair)}")
        others = [one for one in best.chosen if one not in pair]
        beside = task.fitted(others, best.model, **_QUICK)
        seen = scan(beside, task.library, cells=task.cells, temper=temper)
        for one in _best_of(seen, _FITTED[-1]):
            state = _State(beside.with_effects([one.recipe], **_QUICK), [*others, one])
            if state.model.is_physical(one.name):
                found = max(found, state, key=lambda state: state.worth(temper))
    return found


def _with_axes(task, best):
    """Return the set with an optic of any axis in place of what two components change twice a turn.

    An optic that turns with a stage has a second harmonic of it in each component of a static
    frame: four numbers for the two components in its own frame.
    """
    temper = _temper(best)
    stages = {leaf.stage: leaf.name for chain in task.base.trains for leaf in leaves(chain)}
    for pair in combinations([one for one in best.chosen if one.cell is not None], 2):
        kinds, patterns = ({getattr(o.cell, key) for o in pair} for key in ("kind", "dependence"))
        stem, (word, _, rest) = min(kinds).rpartition("_")[0], min(patterns).partition(":")
        stage, _, number = rest.partition(":")
        oblique = len(patterns) == 1 and kinds == {f"{stem}_h", f"{stem}_d"}
        if not oblique or (word, number) != ("harmonic", "2") or stage not in stages:
            continue
        names = [f"in:{stages[stage]}/{kind}/constant" for kind in sorted(kinds)]
        chosen = [one for one in best.chosen if one not in pair]
        # the first once more, as its law was chosen while the second was missing
        for name in [*names, names[0]]:
            chosen = [one for one in chosen if one.name != name]
            seen = scan(task.fitted(chosen, best.model, **_QUICK), temper=temper)
            fresh = next((one for one in seen.candidates if one.name == name), None)
            if fresh is None or fresh.evidence < ENOUGH:
                break
            chosen = [*chosen, seen.freer(fresh)]
        else:
            turned = task.quickly(chosen, best.model)
            best = max(best, turned, key=lambda state: state.evidence(temper))
    return best


def _best_of(found, most):
    best = _distinct(found.candidates, most)
    return [found.freer(one, best) for one in best]


def _checked(task, best):
    """Return the set without causes that left-out frames contradict.

    With it, what is left with one cause more each, and the errors on left-out frames.
    """
    while True:
        task.say("left-out frames")
        names = [one.name for one in best.chosen]
        # with the first cause, the first two and so on, to first order
        steps = [best.model.without(names[i + 1 :]) for i in range(len(names))]
        steps = [task.base.linear, *steps]
        history = [_errors(step, task.groups) for step in progress.steps(steps, "models")]
        worse = _worse(best, steps, history, task.groups)
        if not worse:
            return best, steps, history
        chosen = [one for i, one in enumerate(best.chosen) if i not in worse]
        best = _State(task.fitted(chosen, best.model), chosen)


def _worse(best, steps, history, groups):
    """Return the numbers of causes that are impossible or contradicted by left-out frames."""
    impossible = [i for i, o in enumerate(best.chosen) if not best.model.is_physical(o.name)]
    impossible = impossible or _of_noise(best, steps[0].model)
    if impossible or groups is None:
        return impossible[-1:]
    pairs = zip(pairwise(history), steps[1:], strict=True)
    few = len(best.chosen) <= _MOST
    found = [i for i, ((a, b), step) in enumerate(pairs) if _worsens(b, a, step.mean_square)]
    # the first may need the last: each is taken out of the whole set, unless there is no evidence
    # for it beside the others
    scatter, whole = best.model.mean_square, history[-1]
    found = [
        i
        for i in (found if few else range(len(best.chosen)))
        if (few and best.chosen[i].evidence < ENOUGH)
        or _worsens(whole, foreseen(best.model.without([best.chosen[i].name]), groups), scatter)
    ]
    return found[-1:] if few else found


def _of_noise(best, base):
    """Return the numbers of causes whose pattern may be that of the noise itself.

    Either the residuals are no larger than noise, or they alone tell how large it is.
    """
    stated, few = all(channel.stated for channel in base.problem.channels), []
    for i, one in enumerate(best.chosen if base.p_value > _NOISE or not stated else ()):
        scatter, error = best.model.unsteadiness(one.name)
        surely = scatter * (scatter > 1 + 2 * error)
        more = surely if stated else max(scatter, 1.0) * (1 + 2 * error)
        if one.evidence < ENOUGH * max(more, best.model.alike) > ENOUGH:
            few.append(i)
    return few if stated or len(few) == len(best.chosen) else []


def _worsens(after, before, scatter):
    """Whether frames that were left out of the fit contradict a cause."""
    # among noise the evidence is to be trusted; among structure it has to hold elsewhere too, by
    # one standard error (Breiman et al. 1984, Classification and Regression Trees, Sec. 3.4.3)
    least = -2.0 if scatter < _STRUCTURED else 1.0
    return after.better_than(before) < least


def explained_by_one(model, library, *, cells=True):
    """Return whether a single cause leaves no more than noise."""
    found = _scanned(model, library, cells)
    few = (one for one in _best_of(found, _WIDTH[0]) if one.evidence > ENOUGH)
    return any(model.with_effect(*one.recipe, **_QUICK).p_value > _NOISE for one in few)


def beside_one(base, selection):
    """Yield a model with each of the few best causes alone."""
    for one in _best_of(selection.scan, _WIDTH[0]):
        yield base.with_effect(*one.recipe, **_QUICK)


def _scanned(model, library, cells):
    """Return the evidence beside a model, measured by the residuals that the best cause leaves."""
    found = scan(model, library, cells=cells)
    if found.best is None:
        return found
    most = max(found.candidates, key=lambda one: one.statistic)
    freedom = max(model.problem.n_data - model.problem.size - most.rank, 1)
    temper = max(1.0, (model.fit.chi2 - most.statistic) / freedom)
    if temper == 1.0:
        return found
    again = sorted((one.tempered(temper) for one in found.candidates[:_RETEMPERED]), key=preference)
    return replace(found, candidates=again, temper=temper)


def _distinct(candidates, most):
    """Return the best candidates of which none does the same as another."""
    found = []
    for one in candidates:
        if all(abs(one.statistic / other.statistic - 1) > _SAME for other in found):
            found.append(one)
        if len(found) == most:
            break
    return found


def _apart(task, first):
    """Return the set of the causes that each run needs by itself."""
    base, chosen = task.base, []
    for i, name in enumerate(first.probes.runs):
        task.say(f"{name} by itself")
        alone = base.of_dataset(i)
        # of groups of all runs those that it has: by itself it may have too few
        groups = task.groups and (task.groups[0], [task.groups[1][i]])
        alone = _Task(alone, [], True, groups, task.say)
        state = _search(alone, _State(alone.base), _scanned(alone.base, [], True), _MOST)
        of_all = [first.probes.run_of(one.cell) is None for one in state.chosen]
        chosen += [
            replace(one, cell=one.cell.in_run(name)) if everywhere else one
            for one, everywhere in zip(state.chosen, of_all, strict=True)
        ]
    task.say("all runs together")
    names = {one.name for one in chosen}
    nominal = [one for one in _nominal_changes(first) if one.name not in names]
    model = task.fitted([*chosen, *nominal], base, **_QUICK)
    return task.quickly([*chosen, *_needed(model, nominal)], model)


def _needed(model, causes):
    """Return those causes of a model that have evidence beside the others, the least dropped."""
    temper, left, dropped = max(1.0, model.mean_square), list(causes), []
    costs = model.costs(temper)
    # one at a time: of two that do the same, the other is needed once the first is gone
    while left:
        now = model.without(dropped).chi2
        lost = [model.without([*dropped, one.name]).chi2 - now for one in left]
        pairs = zip(lost, left, strict=True)
        evidence = [0.5 * more / temper - costs.get(one.name, 0.0) for more, one in pairs]
        least = int(np.argmin(evidence))
        if evidence[least] > ENOUGH:
            break
        dropped.append(left.pop(least).name)
    return left


def _nominal_changes(first):
    """Return the changes of what a nominal model has one value of for all runs."""
    probes, found = first.probes, []
    places = list(dict.fromkeys(place for place, _ in probes.slopes))
    own = [place for place in places if place.startswith("in:")]
    # the angle of an optic is one number, what a model has per wavelength is free there
    slots = probes.problem.free.slots
    varied = {f"in:{slot.name.partition('.')[0]}" for slot in slots if slot.per_wavelength}
    kinds = [
        (place, kind, 2 if kind == "rotation" and place not in varied else None)
        for place in own
        for kind in _OF_OPTIC
    ]
    kinds += [(place, "rotation", 0) for place in places if place == "source"]
    # the efficiency of the splitter, as seen in front of it
    behind = [p for p in places if p[:6] == "after:" and len(probes.slopes[p, "rotation"]) > 1]
    kinds += [(place, "depolarization_linear", None) for place in behind[-1:]]
    for run in probes.runs[1:]:
        cells = [(Cell(place, kind, f"dataset:{run}"), degree) for place, kind, degree in kinds]
        found += [first.of_cell(*each) for each in cells]
    return [one for one in found if one is not None]


def _search(task, best, first, most_causes):
    """Return the best set of causes."""
    states, known = [best], {} if best.chosen else {best.outline: first}
    while len(best.chosen) < most_causes:
        k = len(best.chosen)
        task.say(f"looking for cause {k + 1}, at most {most_causes}")
        # of several runs, whose causes are many, the sets are fewer one step earlier
        step = k + (task.has_runs and k > 1)
        width, most = (part[min(step, len(part) - 1)] for part in (_WIDTH, _FITTED))
        fitted = _extensions(task, states, known, most)
        temper = _temper(best, *fitted)
        # those that are worth more than what they are to be better than
        least = best.worth(temper)
        if not fitted or fitted[0].worth(temper) < least:
            break
        if task.groups and k >= _BY_EVIDENCE and temper >= _STRUCTURED:
            # where several causes leave more than noise, none of them is what it seems, and a set
            # is as good as what it says of frames that are left out
            fitted = [state for state in fitted if state.worth(temper) >= least]
            fitted.sort(key=lambda state: foreseen(state.model, task.groups).typical_percent)
        best, states = fitted[0], fitted[:width]
        if best.model.p_value > REMAINDER:
            # what is left may be noise: one look beside the best set will tell, and one beside
            # those of little freedom where it has much
            simple = [one for one in fitted if not one.is_dear] if best.is_dear else []
            states = [best, *simple][:width]
    return best


def _extensions(task, states, known, most):
    """Return sets with one cause more, fitted in full, best first."""
    k = len(states[0].chosen)
    # what takes many causes has no names; they are asked for once more at the end
    names = task.library if k <= _NAMES or not task.cells else ()
    for state in states:
        if state.outline not in known:
            known[state.outline] = _scanned(state.model, names, task.cells)
    instead = partial(_in_place, replace(task, library=names))
    temper = min(known[state.outline].temper for state in states)
    fitted = _ranked(_fitted(_grown(states, known, temper, most)[:most], temper, instead))
    for more in (_far, _simple, _at_half_a_wave) if not k else ():
        new = more(states[0], known[states[0].outline], fitted, instead)
        fitted = _ranked(fitted + new)
    return fitted


def _ranked(states):
    """Return sets of causes, those with most evidence first; of the same, the name decides."""
    temper = _temper(*states) if states else 1.0
    return sorted(states, key=lambda state: (-round(state.evidence(temper), DECIMALS), state.name))


def _fitted(grown, temper, instead):
    """Return sets fitted in full, without those that promise too little beside the best of them."""
    found, most = [], -np.inf
    for promised, state, added in progress.steps(grown, "fits"):
        is_dear = any(one.is_dear and one.model.p_value > REMAINDER for one in found)
        share, before = _HALF if is_dear else _PROMISING, state.evidence(temper)
        if promised - before < share * (most - before):
            break
        one = _extended(state, added, instead)
        if one is not None:
            found.append(one)
            # where it does more than its derivative promised, others may, too
            most = max(most, min(one.evidence(temper), promised))
    return found


def _far(state, found, fitted, instead):
    """Return sets of one name of one number, fitted in full, where no derivative suffices."""
    # an angle that is far off does more, and other things, than its derivative promises
    if found.temper < _STRUCTURED:
        return []
    least = _FAR_PROMISE * found.best.evidence
    simple = [o for o in found.candidates if o.is_named and o.rank == 1 and o.evidence > least]
    return _new(state, simple[: _FITTED[0]], fitted, instead)


def _simple(state, found, fitted, instead):
    """Return sets of one cause of little freedom, where one of more freedom explains all."""
    # two of them may be what is there, or one whose derivative promises less than it does
    free = fitted and (fitted[0].is_dear or fitted[0].chosen[0].rank >= _FREE)
    if not (free and fitted[0].model.p_value > REMAINDER):
        return []
    best, most = found.best.evidence, _HALF * fitted[0].chosen[0].rank
    few = [one for one in found.candidates if one.rank <= most]
    # names, which are few, may each explain less: such as fringes of two periods
    named = [one for one in few if one.is_named and one.evidence > _FAR_PROMISE * best]
    few = [one for one in few if one.evidence > _HALF * best]
    few = _distinct(few, _FITTED[1]) + _distinct(named, _FITTED[1])
    # a name also where it was fitted with a freer law, which costs more than two simple ones
    same = {(one.chosen[0].name, one.chosen[0].rank) for one in fitted}
    few = {one.name: one for one in few if (one.name, one.rank) not in same}
    dear = [one for one in fitted[1:] if one.is_dear and one.chosen[0].is_named]
    new = _new(state, few.values(), [one for one in fitted if one not in dear], instead)
    # what derivatives ask a law for may be in the second order
    constant = found.constant(fitted[0].chosen[0])
    constant = constant and _extended(state, (constant,), instead)
    few = [fitted[0]]
    if constant and constant.model.fit.chi2 - few[0].model.fit.chi2 < 2 * ENOUGH * found.temper:
        # what it leaves asks for no other cause
        few.append(constant)
    fitted[0] = max(few, key=lambda one: one.evidence(found.temper))
    return new


def _at_half_a_wave(state, found, fitted, instead):
    """Return the set of a retarder beside an optic that the nominal fit left at half a wave."""
    moved = state.model.off_half_waves() if state.model.p_value < REMAINDER else None
    cells = [Cell(*k, "constant") for k in found.probes.slopes if k[1] in _OF_OPTIC[:2]]
    if moved is None or not cells or all(one.is_named for one in found.candidates):
        return []
    added = [Candidate(None, cell, 0.0, 1, 0.0, degree=0) for cell in cells]
    tried = [(state.model.with_effects([o.recipe], like=moved, **_QUICK), o.name) for o in added]
    model, name = min(tried, key=lambda one: one[0].fit.chi2)
    # what it does is known where it is
    beside = scan(model, without=name, temper=max(1.0, model.mean_square)).candidates
    one = next((one for one in beside if one.name == name), None)
    if one is None or name in {o.name for grown in fitted for o in grown.chosen}:
        return []
    grown = _State(state.model.with_effects([one.recipe], like=model, **_QUICK), [one])
    return [grown] if grown.model.is_physical(name) else []


def _new(state, added, fitted, instead):
    """Return the sets with each of some causes, fitted in full, that are not among those fitted."""
    known = {one for grown in fitted for one in grown.outline}
    new = (one for one in added if one.name not in known)
    grown = [_extended(state, (one,), instead) for one in new]
    return [one for one in grown if one is not None]


def _grown(states, known, temper, most):
    """Return evidence, set and causes to add of all continuations of sets, best first."""
    grown = {}
    for state in states:
        for added in _continuations(known[state.outline], most):
            promised = sum(one.tempered(temper).evidence for one in added)
            evidence = state.evidence(temper) + promised
            outline = state.outline.union(one.name for one in added)
            if outline not in grown or grown[outline][0] < evidence:
                grown[outline] = (evidence, state, added)
    found = sorted(grown.values(), key=lambda item: -item[0])
    if len(states[0].chosen) < _BY_EVIDENCE:
        return found
    # sets of several causes are much alike: another cause tells more than the same beside another
    names = [sorted(one.name for one in added) for _, _, added in found]
    return [found[i] for i in sorted(range(len(found)), key=lambda i: names[i] in names[:i])]


def _continuations(found, most):
    """Return what may be added to a set: one cause, or one in each of the runs."""
    # what is in one beam only looks like a cause of both, in place of which it is asked for
    both = [o for o in found.candidates if not (o.cell and o.cell.kind.endswith(BETWEEN_BEAMS))]
    found = replace(found, candidates=both)
    few = [one for one in _best_of(found, most) if one.evidence > ENOUGH]
    if found.probes is None or len(found.probes.runs) < 2:
        return [(one,) for one in few]
    first = {}
    for one in [*few, *found.candidates]:
        run = found.probes.run_of(one.cell)
        if run is not None and run not in first and one.evidence > ENOUGH:
            first[run] = one if one in few else found.freer(one)
    # the data of two runs are not the same: their causes can be taken together
    return [(one,) for one in few] + ([tuple(first.values())] if len(first) > 1 else [])


def _extended(state, added, instead):
    """Return a set with more causes, fitted in full, None where that is impossible."""
    model = state.model.with_effects([one.recipe for one in added], **_QUICK)
    chosen = [*state.chosen, *added]
    impossible = [one for one in chosen if not model.is_physical(one.name)]
    grown = _State(model, chosen)
    if len(impossible) != 1 or impossible[0] in added:
        return None if impossible else grown
    # what was possible before is driven to its limit by what is added: another is in its place
    return instead(impossible[0], grown)


def _in_place(task, one, state):
    """Return a set with the best that is possible in place of a cause, None if nothing is."""
    ask = {"cells": task.cells, "temper": _temper(state), "without": one.name}
    found = scan(state.model, task.library, **ask)
    taken = {other.name for other in state.chosen}
    for rival in _best_of(found, _FITTED[-1]):
        if rival.name in taken or rival.evidence < ENOUGH:
            continue
        chosen = [rival if other is one else other for other in state.chosen]
        new = task.quickly(chosen, state.model)
        asked = [o for o in chosen if o is rival or state.model.is_physical(o.name)]
        if all(new.model.is_physical(other.name) for other in asked):
            return new
    return None


def _exchanged(task, best, first):
    """Return the set with every cause the best beside all the others, and the scans beside these.

    What was chosen first was chosen while the others were missing: its law in wavelength may be too
    stiff, another cause may do better, and a name may do as well as the cell that it is.
    """
    scans, like, start = {}, None, best
    task.say("each cause beside all the others")
    for one in progress.steps(best.chosen[::-1], "causes"):
        others = [other for other in best.chosen if other is not one]
        hidden = all(other.name != one.name for other in first.candidates)
        beside = others or hidden
        found, is_near = _beside(task, best, one, like) if beside else (first, False)
        like = like or (found.probes if is_near else None)
        scans[one.name] = found
        if len(best.chosen) > _MOST:
            # so many that none is sure: what each can be told from is all that is asked
            continue
        rivals = _rivals_beside(found, one, task.library)
        # of many causes none is sure: the best rival is enough, and all stay
        few = len(best.chosen) <= _MERGED[1]
        if few and others and (not rivals or rivals[0].evidence < ENOUGH):
            # the others do what it did
            fewer = task.quickly(others, best.model)
            if 0.5 * (fewer.model.fit.chi2 - best.model.fit.chi2) < ENOUGH * _temper(best):
                best, like = fewer, None
                continue
        for fresh in rivals if few else rivals[:1]:
            if (fresh.name, fresh.degree) == (one.name, one.degree):
                break
            if fresh.name in {other.name for other in others}:
                continue
            chosen = [fresh if o is one else o for o in best.chosen]
            new = task.quickly(chosen, best.model)
            temper = _temper(new, best)
            gained = new.evidence(temper) - best.evidence(temper)
            if new.model.is_physical(fresh.name) and gained > -_CLEARLY:
                scans[fresh.name], like = scans.pop(one.name), None
                best = new
                break
    needed = best.chosen if best is start else _needed(best.model, best.chosen)
    if len(needed) < len(best.chosen):
        # an exchange may do what another cause did; derivatives alone do not tell
        fewer = task.quickly(needed, best.model)
        best = max(fewer, best, key=lambda state: state.worth(_temper(fewer, best)))
    return best, scans


def _beside(task, best, one, like):
    """Return the evidence beside all other causes, and whether it is of the derivatives of all."""
    model = best.model
    ask = partial(scan, effects=task.library, cells=task.cells, temper=_temper(best))
    found = ask(model, without=one.name, like=like)
    own = next((c for c in found.candidates if c.name == one.name), one)
    if own.statistic <= task.base.fit.chi2 - model.fit.chi2 and own.evidence > ENOUGH:
        return found, True
    # no cause does more than all of them, and what was chosen was asked for: it went too far for
    # derivatives, along an open direction or to a large size
    others = [other for other in best.chosen if other is not one]
    return ask(task.fitted(others, model, **_QUICK)), False


def _rivals_beside(found, own, library):
    """
    Return what may be in place of a cause, best first, those that are clearly better and its own.

    Each is a name where that does as well.
    """
    few = _best_of(found, _FITTED[1])
    named = [one for one in _distinct(found.candidates, _AMONG) if one.is_named]
    few += [found.freer(one, named) for one in named[: _FITTED[-1]]]
    mine = [found.freer(one) for one in found.candidates if one.name == own.name][:1]
    names = [
        name for one in [*few, *mine] if not one.is_named for name in found.named_as(one, library)
    ]
    enough = mine[0].evidence + _CLEARLY if mine else -np.inf
    better = {one.name: one for one in few if one.evidence >= enough}
    best = sorted(better.values(), key=preference) + mine
    # a name is given where it does as well as its cell
    as_good = [[n for n in (*names, one) if n.evidence > one.evidence - _AS_GOOD] for one in best]
    return [
        min((n for n in same if n.is_named), key=preference, default=one)
        for one, same in zip(best, as_good, strict=True)
    ]


def _unlisted(base, best, stable, instead):
    """Return the probability that the gap has a cause that no table has.

    A remainder of probability p is evidence for it by a Bayes factor of at most -1/(e p ln p)
    (Sellke, Bayarri & Berger 2001, doi:10.1198/000313001300339950), the more the larger it is.
    """
    prior = _UNLISTED[min(len(best.chosen), len(_UNLISTED) - 1)]
    if len(best.chosen) > 1 and min(stable.values(), default=1.0) < 1:
        prior = max(prior, _SHAKY)
    elif len(best.chosen) == 1:
        hidden = best.model.hidden_share(base)
        prior = max(prior, float(np.interp(hidden, _MAY_HIDE, _UNSEEN)))
    prior = max(prior, instead, _ALIKE_CAUSES[alike([one.cell for one in best.chosen])])
    p = min(max(best.model.p_value, 1e-300), np.exp(-1))
    after = prior / (prior - (1 - prior) * np.e * p * np.log(p))
    freedom = best.model.problem.n_data - best.model.problem.size
    excess = max(base.fit.chi2 - freedom, 1.0)
    share = max(best.model.fit.chi2 - freedom, 0.0) / excess
    return float(prior + (after - prior) * (1 - np.exp(-share / _LEFT)))


def _grouped(task, best, steps, scans, unlisted, stable):
    """Return the causes with their alias groups and probabilities."""
    found, turned = [], _turned(task, best)
    for one, (before, after) in zip(best.chosen, pairwise(steps), strict=True):
        members = _members(one, scans[one.name], _refits(task, best, one), turned[one.name])
        chance = 1 / (1 + np.exp(min(ENOUGH - members[0][0].evidence, 50.0)))
        lowered = max(before.chi2 - after.chi2, 0.0)
        share = stable.get(one.name, 1.0)
        chance *= float((1 - unlisted) * share)
        alone = scans[one.name].by_run(members[0][0])
        found.append(Group(members, chance, lowered, share, alone))
    return found


def _turned(task, best):
    """Return what components of one optic are in its other frame, by name, with weights.

    Neither of the two is anything there without the other.
    """
    found, temper = {one.name: [] for one in best.chosen}, _temper(best)
    stages = {leaf.name: leaf.stage for chain in task.base.trains for leaf in leaves(chain)}
    cells = [one for one in best.chosen if one.cell is not None and not one.is_named]
    for pair in combinations(cells if len(best.chosen) <= _MERGED[1] else (), 2):
        for twins in in_other_frame([one.cell for one in pair], stages):
            new = [replace(one, cell=cell) for one, cell in zip(pair, twins, strict=True)]
            state = task.quickly([*(o for o in best.chosen if o not in pair), *new], best.model)
            weight = np.exp(min(state.evidence(temper) - best.evidence(temper), 0.0))
            if weight >= _ALIAS and all(state.model.is_physical(one.name) for one in new):
                for one, twin in zip(pair, new, strict=True):
                    found[one.name].append((twin, weight))
    return found


def _refits(task, best, chosen):
    """Return what gives the chi-square and the evidence that another in place of a cause loses."""
    if len(best.chosen) > _MERGED[1]:
        # none of so many is sure: derivatives tell what they are like
        return None
    taken, temper = {one.name for one in best.chosen if one is not chosen}, _temper(best)

    def loss(other):
        if other.name in taken:
            return np.inf, np.inf
        new = [other if one is chosen else one for one in best.chosen]
        new = task.quickly(new, best.model)
        lost = 0.5 * (new.model.fit.chi2 - best.model.fit.chi2) / temper
        return lost, best.evidence(temper) - new.evidence(temper)

    return loss


def _as_free(chosen, beside):
    """Return the rivals of a cause; those that are most like it have a law as free as its own."""
    rivals, cell = beside.candidates, chosen.cell
    seen = next((one for one in rivals if one.name == chosen.name), chosen)
    # a name is not behind what does the same because its usual law has more freedom than is asked
    least = (1 - _NEAR) * seen.statistic
    names = [one.named for one in rivals if one.is_named and one.statistic > least]
    asked = {one.name: one for one in beside.with_laws(names)}
    rivals = [max(one, asked.get(one.name, one), key=attrgetter("evidence")) for one in rivals]
    if cell is None or chosen.is_named or beside.probes is None or seen.degree == chosen.degree:
        return rivals
    # of place, kind and dependence no more than one is another, or the dependence is the same
    parts = attrgetter("place", "kind", "dependence")
    equal = [0 if one.is_named else list(map(eq, parts(one.cell), parts(cell))) for one in rivals]
    near = [
        one for one, same in zip(rivals, equal, strict=True) if same and (same[2] or sum(same) > 1)
    ]
    near = [seen, *(one for one in near if one is not seen)][: 3 * _AMONG]
    free = {one.name: beside.of_cell(one.cell, chosen.degree) or one for one in near}
    return [free.get(one.name, one) for one in rivals]


def _members(chosen, beside, loss, turned=()):
    """Return the chosen candidate and its aliases, with probabilities that sum to one.

    Those that are known to be ``turned``, with their weights, are among the aliases.
    """
    rivals = _as_free(chosen, beside)
    seen = own = next((one for one in rivals if one.name == chosen.name), chosen)
    # fits in full were compared already: nothing that is listed is better than what was chosen
    farthest = _FAR * max(own.size, 1.0)
    top = max([own.evidence, *(one.evidence for one in rivals if one.size <= farthest)])
    own = replace(chosen, evidence=top)
    weights = {own.name: (own, 1.0)}
    promised, known = max(chosen.statistic, own.statistic), {}
    for one in rivals:
        if one.name == own.name or len(weights) > _MOST_ALIASES:
            continue
        weight = np.exp(min(one.evidence - top, 0.0))
        # where nothing but the usual sizes tells two apart, the data do not
        is_same = one.rank <= own.rank and one.statistic >= (1 - _SAME) * promised
        is_bent = weight < _ALIAS and one.statistic > (1 - _NEAR) * promised > _BENT
        is_far = (is_same or weight >= _ALIAS) and one.size > farthest
        if loss is not None and (is_bent or is_far):
            # of a strong signal, or at a size far from usual, derivatives do not tell what is alike
            key = round(one.statistic, 3)
            if key not in known and len(known) < _FITTED[0]:
                known[key] = loss(one)
            lost, behind = known.get(key, (np.inf, np.inf))
            fitted = np.exp(min(-behind, 0.0))
            # a fit that does as well as that of the chosen one confirms what was promised
            weight = max(weight, fitted) if lost < 1 else fitted
            is_same = is_same and lost < 1
        if is_same:
            weight = max(weight, _ALIAS)
        is_twin = one.rank == seen.rank and not (one.is_named or seen.is_named)
        is_twin &= abs(one.statistic - seen.statistic) <= _SAME * seen.statistic
        if is_twin and chosen.degree != seen.degree == one.degree:
            # what cannot be told apart with a law cannot be without one either
            weight = max(weight, np.exp(min(one.evidence - seen.evidence, 0.0)))
        if weight >= _ALIAS:
            weights[one.name] = (one, weight)
    weights |= {one.name: (one, weight) for one, weight in turned}
    total = sum(weight for _, weight in weights.values())
    (_, most), *others = weights.values()
    # of one probability the best first; of what does the same, rounding alone would tell which is
    others.sort(key=lambda item: preference(item[0]))
    others = [others[i] for i in ranked([weight for _, weight in others])]
    return [(one, float(weight / total)) for one, weight in [(own, most), *others]]
