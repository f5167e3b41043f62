# Licensed under a 3-clause BSD style license - see LICENSE
"""
Single frames whose data are not what the table says of them.

A wave plate that did not reach its angle, two frames whose files were exchanged, or a beam that was
clipped once bends the whole fit, and an optic is blamed for it. So frames are looked at first: each
is left out in turn, at the cost of one linear step (the deletion residual of Cook & Weisberg 1982),
and what stands out from noise and from all other frames is named, taken out, and the search goes
on. A gap that is in all frames is none of theirs: without the few frames that are named the fit
must be down to the noise, or have lost nearly all of its excess.
"""

import warnings
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from astropolcal.gap._frame_looks import Frame, Group, Look, Trial, angle_stages
from astropolcal.gap.model import Model, nominal_calibration
from astropolcal.gap.problem import GapProblem
from astropolcal.observations.grid import MAD_TO_SIGMA, robust_curve

__all__ = []

# one frame in so many runs of any length is thought to be wrong beforehand, and the share of
# these that nobody can explain
_RARE, _UNEXPLAINED = 10.0, 0.1
# an exchange makes either frame better by so much, and is tried for so many frames
_BETTER, _PARTNERS = 10.0, 5
_CERTAIN = 0.99
# a beam is called by its name where it is it with this share; below the other the kinds of error
# that may be meant are all named
_TELLS, _DECIDED = 0.95, 0.8
# brightness off by so many robust standard deviations is at odds with the drift of the lamp
_FAR, _LARGEST_DRIFT = 6.0, 4
# chance of a false accusation in a run, and the share of the frames that may be accused
_ALPHA = 1e-3
_MOST, _LEAST_MOST = 0.05, 2
# a fit is down to the noise at this chance; else so much of the excess has to be gone, and the
# accused have to stand so far above the others
_NOISE, _GONE, _APART = 1e-3, 0.8, 10.0
# one angle of a group explains its frames if so little is left of them
_LEFT = 0.01
# of very many frames several are taken at once, those nearly as bad as the worst
_AT_ONCE, _NEARLY = 12, 0.5
# as bad frames are found, so little of the excess is left that the noise is measured anew
_NEARLY_GONE = 0.1
_STEPS, _SHARE = 20, 1e-5
_STAGES = {"hwp": "the half-wave plate", "derotator": "the derotator"}


@dataclass
class FrameFault:
    """A frame whose data are not what the table says."""

    dataset: str
    #: The frame's number in the table.
    frame: int
    #: ``"hwp angle"`` (or that of another stage), ``"exchanged"``, ``"one beam"``, ``"brightness"``
    #: of a single beam, ``"unknown"`` where none of these, or more than one, describes it, or
    #: ``"lamp"`` where only the brightness is off its drift, which does not harm the differences.
    what: str
    #: Number of the frame with which it was exchanged.
    with_: int | None = None
    #: Angle at which the stage stood, in degree; factor of the beam or of the lamp.
    value: float | None = None
    #: Angle at which the stage stood, in degree; factor of the beam or of the lamp.
    error: float | None = None
    #: By how much chi-square is lower than without the fault, less what the freedom of size, kind
    #: and frame costs.
    evidence: float = 0.0
    #: That it is this, and neither noise nor another of these faults.
    probability: float = 0.0
    words: str = ""
    #: Index of the dataset and of the frame.
    place: tuple = field(default=(0, 0), repr=False)

    def to_dict(self):
        """Return the fault as JSON holds it (dict)."""
        names = ("dataset", "frame", "what", "value", "error", "evidence", "probability", "words")
        return {name: getattr(self, name) for name in names} | {"with": self.with_}


def suspect_frames(model):
    """
    Return the frames whose data are not what the table says, the most evident first.

    Those of which only the lamp is off come last. There are none where no frame stands out, or so
    many that the model is at fault and not the frames. Where an optic is missing from the model
    everywhere, a small fault of one frame cannot be distinguished from it: look again once the
    optic is in. A frame of a single beam is compared with the others of its group: what they cannot
    tell, such as which of two it is, its words say.
    """
    search = Search(model)
    accused, last = search.accused()
    found = _Hearing(search).faults(accused, last) if accused else []
    if not search.is_settled([fault.place for fault in found], last):
        # where the fit does not find back from where they had bent it, others look bad, too
        found = [fault for fault in found if fault.place in search.worst]
        found = found if search.is_settled([fault.place for fault in found], last) else []
    named = {fault.place for fault in found}
    return found + [fault for fault in _lamp(model) if fault.place not in named]


def without_frames(observations, faults):
    """Mask the frames that are not what the table says."""
    observations = list(observations)
    for fault in faults:
        if fault.what != "lamp":
            i, f = fault.place
            mask = np.arange(observations[i].n_frames) == f
            reason = f"not as the table says: {fault.what}"
            observations[i] = observations[i].with_mask(mask, reason)
    return observations


# ---- hearing ---------------------------------------------------------------------------------


class _Hearing:
    """What each frame that was accused is accused of."""

    def __init__(self, search):
        self.model, self.problem, self.n_frames = search.model, search.problem, search.n_frames

    def faults(self, accused, last):
        """Return what each of the accused frames is accused of, those that are guilty."""
        scatter = [usual(*last.deleted(i), last.kept(i)) for i in range(len(last.out))]
        frames = {(i, f): Frame(last, i, f, scatter[i]) for i, f in accused}
        trials = {place: [one.as_told(), *one.trials()] for place, one in frames.items()}
        exchanged = {place: _exchanges(place, frames, trials) for place in accused}
        found = []
        for place in accused:
            fault = self._verdict(place, trials[place], exchanged[place])
            if fault is not None:
                found.append(fault)
        found = self._of_groups(self._with_partners(found), last, scatter)
        return sorted(found, key=lambda fault: -fault.evidence)

    def _verdict(self, place, trials, exchanged):
        """Weigh the trials of a frame against each other (Bayes), or return None: no fault."""
        i, _ = place
        kinds = len(angle_stages(self.model.chains[i])) + 2
        none, *rest = [*trials, *exchanged]
        prior = 1 / (_RARE * self.n_frames * kinds)
        log = [-none.total / 2]
        for trial in rest:
            share = prior * (_UNEXPLAINED if trial.what == "unknown" else 1.0)
            log.append(np.log(share) - trial.total / 2)
        weight = np.exp(np.array(log) - max(log))
        weight /= weight.sum()
        by_kind = {}
        for trial, w in zip(rest, weight[1:], strict=True):
            by_kind[trial.what] = by_kind.get(trial.what, 0.0) + float(w)
        if weight[0] > 1 - _CERTAIN:
            return None
        what = max(by_kind, key=by_kind.get)
        best = min((t for t in rest if t.what == what), key=lambda trial: trial.total)
        evidence = none.total - best.total + 2 * np.log(prior)
        sides = [w for t, w in zip(rest, weight[1:], strict=True) if t.beam == best.beam]
        best.beam = best.beam if sum(sides) > _TELLS * by_kind[what] else ""
        fault = self._fault(place, best, float(evidence), min(by_kind[what], 1.0))
        rivals = {t.what: t for t in sorted(rest, key=lambda t: -t.total) if t.what in by_kind}
        rivals = {kind: t for kind, t in rivals.items() if by_kind[kind] > 1 - _TELLS}
        rivals = rivals if by_kind[what] < _DECIDED else {}
        return self._of_design(fault, rivals, 1 - weight[0])

    def _of_groups(self, found, last, scatter):
        """Return the faults; of several in a group of a single beam, a stage of all its frames."""
        several = {}
        for fault in found:
            i, f = fault.place
            groups = self.problem.channels[i].groups
            if groups is not None:
                several.setdefault((i, int(groups[f])), []).append(fault)
        for (i, _), faults in several.items():
            group = Group(last, i, faults[0].place[1], scatter[i])
            trials = group.trials() if len(faults) > 1 else []
            if not trials:
                continue
            chi2, before = trials[0].chi2, group.as_told().chi2
            # one angle explains all of them, down to the noise or to what the fit is uncertain by
            if stats.chi2.sf(chi2, max(group.freedom, 1)) < _NOISE and chi2 > _LEFT * before:
                continue
            near = trials[0].total - 2 * np.log(1 - _TELLS)
            rivals = {t.what: t for t in reversed(trials) if t.total < near}
            worst = max(faults, key=lambda fault: fault.evidence)
            found = [fault for fault in found if fault not in faults]
            for f in group.frames:
                fault = self._fault((i, int(f)), trials[0], worst.evidence, worst.probability)
                found.append(self._of_design(fault, rivals, worst.probability))
        return found

    def _of_design(self, fault, rivals, probability):
        """Return a fault with what the design of its observation cannot tell."""
        i, f = fault.place
        channel = self.problem.channels[i]
        if len(rivals) > 1:
            kinds = [self._fault(fault.place, t, 0.0, 0.0) for t in rivals.values()]
            each = (kind.words.partition(": ")[2] for kind in reversed(kinds))
            fault.what, fault.value, fault.error, fault.with_ = "unknown", None, None, None
            fault.partner_place, fault.probability = None, float(probability)
            fault.words = f"frame {fault.frame}: {', or '.join(each)}; its design cannot tell"
        if channel.groups is None:
            return fault
        mates = channel.valid.any(axis=0) & (channel.groups == channel.groups[f])
        if mates.sum() == 2:
            numbers = self.problem.datasets[i].observations.frames["frame"]
            one, other = (int(numbers[k]) for k in np.flatnonzero(mates))
            fault.words += f"; or it is the other of the group: frames {one} and {other} alone"
            fault.words += " cannot tell which of them is wrong"
        return fault

    def _fault(self, place, trial, evidence, probability):
        i, f = place
        observations = self.problem.datasets[i].observations
        numbers = [int(n) for n in observations.frames["frame"]]
        partner = None if trial.partner is None else numbers[trial.partner]
        value, error, told = _as_told(trial, observations, f, self.problem.datasets[i])
        fault = FrameFault(
            observations.name,
            numbers[f],
            trial.what,
            partner,
            value,
            error,
            evidence,
            probability,
            place=place,
        )
        fault.words = _words(fault, told, trial.beam)
        fault.partner_place = None if trial.partner is None else (i, trial.partner)
        return fault

    def _with_partners(self, found):
        """Return the faults, with those frames that were exchanged with one of them."""
        places = {fault.place: fault for fault in found}
        for fault in found:
            other = fault.partner_place
            known = places.get(other)
            if other is None or (known is not None and known.what == "exchanged"):
                continue
            trial = Trial("exchanged", 0.0, 0.0, partner=fault.place[1])
            places[other] = self._fault(other, trial, fault.evidence, fault.probability)
        return list(places.values())


def _exchanges(place, frames, trials):
    """Return the trials in which the stages stood as in another frame, and there as in this."""
    i, f = place
    one, told = frames[place], trials[place][0].chi2
    n = one.channel.shape[2]
    left = one.with_positions_of(np.arange(n))
    left[f] = np.inf
    left[~one.channel.valid.any(axis=0)] = np.inf
    found = []
    for j in np.argsort(left, kind="stable")[:_PARTNERS]:
        if not left[j] < told - _BETTER:
            break
        other = (i, int(j))
        if other not in frames:
            partner = Frame(one.look, *other, one.scatter)
            known = [partner.as_told()]
        else:
            partner, known = frames[other], trials[other]
        theirs = float(partner.with_positions_of([f])[0])
        if theirs < known[0].chi2 - _BETTER:
            cost = 2 * np.log(max(n - 1, 1)) + theirs - min(trial.total for trial in known)
            found.append(Trial("exchanged", float(left[j]), cost, partner=int(j)))
    return found


# ---- words and the lamp ------------------------------------------------------------------------


def _as_told(trial, observations, f, dataset):
    """Return value and error of a trial in the units of the user, and what the table says."""
    if not np.isfinite(trial.value):
        return None, None, None
    if trial.what in ("one beam", "brightness"):
        return trial.value, trial.error, None
    stage = trial.what.removesuffix(" angle")
    stood = float(np.atleast_1d(dataset._given[stage])[f])
    # where a law turns what the table says into the angle of the optic, its error is added
    told = stood
    if stage in observations.frames.colnames:
        told = float(observations.position(stage)[f])
    return tuple(float(np.rad2deg(x)) for x in (told + trial.value - stood, trial.error, told))


def _words(fault, told, beam=""):
    head = f"frame {fault.frame}: "
    if fault.what == "exchanged":
        return f"{head}its data are those of frame {fault.with_}, and the other way round"
    if fault.what == "one beam":
        which = f"the {beam} beam" if beam else "one beam"
        return f"{head}{which} is off by {100 * abs(fault.value - 1):.2g} %"
    if fault.what == "brightness":
        return (
            f"{head}its brightness is off that of its group by {100 * abs(fault.value - 1):.2g} %"
        )
    if fault.what == "lamp":
        return f"{head}the lamp is off its drift by {100 * abs(fault.value - 1):.2g} %"
    if fault.what == "unknown":
        return f"{head}its differences fit no angle of a stage and no factor of a beam"
    stage = fault.what.removesuffix(" angle")
    name = _STAGES.get(stage, f"the stage {stage}")
    # as many digits as tell the two angles apart, and no more than the error is worth
    digits = int(
        np.clip(np.ceil(1 - np.log10(max(fault.error, abs(fault.value - told) / 30))), 1, 4)
    )
    return (
        f"{head}{name} stood at {fault.value:.{digits}f} deg, not at {told:.{digits}f} deg as "
        "the table says"
    )


def _lamp(model):
    """Return the frames of which the brightness is off the drift of the lamp."""
    found = []
    problem, gaps = model.problem, model.problem.differences(model.fit.coefficients)
    for i, channel in enumerate(problem.channels):
        if channel.groups is not None:
            # its frames have no other brightness than that of their group
            continue
        observations = problem.datasets[i].observations
        deviation, score = _off_the_drift(channel, gaps[i][1])
        far = np.flatnonzero(np.abs(np.nan_to_num(score)) > _FAR)
        for f in far:
            fault = FrameFault(
                observations.name,
                int(observations.frames["frame"][f]),
                "lamp",
                value=float(np.exp(deviation[f])),
                error=float(abs(deviation[f] / score[f])),
                evidence=float(score[f] ** 2),
                probability=float(1 - 2 * score.size * stats.norm.sf(abs(score[f]))),
                place=(i, int(f)),
            )
            fault.words = _words(fault, None)
            found.append(fault)
    return sorted(found, key=lambda fault: -fault.evidence)


def _off_the_drift(channel, gap):
    """
    Return by how much the brightness of every frame is off a smooth drift, (F,) each.

    As the logarithm of the flux that is common to all wavelengths, and in robust standard
    deviations; ``gap`` is that of the sums, (W, F).
    """
    sigma = channel.sigma[1]
    table = np.where(channel.valid & np.isfinite(sigma), gap, np.nan)
    with warnings.catch_warnings():
        # a frame that is masked at all wavelengths has no median
        warnings.simplefilter("ignore", RuntimeWarning)
        common = np.nanmedian(table - np.nanmedian(table, axis=1, keepdims=True), axis=0)
        # the variance of a median of n is pi / 2 times that of their mean: 1.25 squared
        count = np.maximum(np.isfinite(table).sum(axis=0), 1)
        error = np.nanmedian(np.nanmedian(sigma, axis=0) * 1.25 / np.sqrt(count))
    least, n = np.inf, np.isfinite(common).sum()
    # the curve whose median deviation is least for what its degree costs
    for degree in range(min(_LARGEST_DRIFT, n // 4) + 1):
        curve = robust_curve(2 * channel.sequence - 1, common, degree)
        middle = np.nanmedian(np.abs(common - curve))
        cost = n * np.log(max(middle, 1e-12)) + degree * np.log(max(n, 2))
        if cost < least:
            least, deviation, spread = cost, common - curve, max(MAD_TO_SIGMA * middle, error)
    return deviation, deviation / spread


# ---- the search --------------------------------------------------------------------------------


class Search:
    """A search for frames that stand out."""

    def __init__(self, model):
        self.model, self.problem = model, model.problem
        self.n_frames = int(sum(c.valid.any(axis=0).sum() for c in self.problem.channels))
        self.most = max(_LEAST_MOST, int(_MOST * self.n_frames))
        nobody = _marked(self.problem, [])
        self.first = Look(model, model.fit.coefficients, nobody)
        #: The frames that bent the fit most.
        self.worst = set()

    def accused(self):
        """
        Return the frames that stand out, and the look at all without them.

        Index of dataset and frame, in the order of accusation; none if too many stand out.
        """
        trail = self._trail([], self.first)
        # the first few, without which nearly all is gone: in a fit that they have bent, more
        # frames look bad than are
        few = (one for one in trail if one[0] and self._is_nearly_gone(one[1]))
        places, look = next(few, ([], self.first))
        if not places:
            return [], self.first
        self.worst = set(places)
        self._start_again(places, look)
        self.first = Look(self.model, look.coefficients, _marked(self.problem, []))
        few = places, self._look(places, look.coefficients)
        *_, (places, look) = self._trail(*few)
        return (places, look) if places else few

    def _trail(self, places, look):
        """Yield the frames that are accused step by step, with the look without them."""
        while True:
            yield places, look
            # a frame that is far off makes others look bad; these are heard and let go
            suspects = _worst(look, self.n_frames)[: max(1, self.most // _AT_ONCE)]
            if not suspects:
                return
            if len(places) >= 2 * self.most or self._is_hopeless(look, len(places)):
                yield [], look
                return
            places = places + suspects
            look = self._look(places, look.coefficients)

    def _is_nearly_gone(self, look):
        excess = [one.chi2 / one.freedom - 1 for one in (self.first, look)]
        return look.chance > _NOISE or excess[1] < _NEARLY_GONE * excess[0]

    def _look(self, places, coefficients):
        out = _marked(self.problem, places)
        rows = self.problem.rows([~o for o in out])
        fit = self.problem.fit(coefficients, rows=rows, steps=_STEPS, share=_SHARE)
        look = Look(self.model, fit.coefficients, out)
        if look.chance > _NOISE:
            return look
        # from where bad frames had bent it a fit need not find back
        other = self.problem.fit(self.problem.start, rows=rows, steps=_STEPS, share=_SHARE)
        return Look(self.model, other.coefficients, out) if other.chi2 < fit.chi2 else look

    def _start_again(self, places, look):
        """Measure the noise without some frames, and find a start for the fit that has them not."""
        old, out = self.problem, _marked(self.problem, places)
        chains = self.model.chains
        if look.chance < _NOISE and not self.model.added:
            seen = zip(self.model.observations, out, strict=True)
            left = [o.with_mask(mask, "accused") if mask.any() else o for o, mask in seen]
            chains = nominal_calibration(chains, left).chains
        keys = ("ties", "laws", "priors", "neutral", "limits")
        known = {key: getattr(old, key) for key in keys}
        problem = GapProblem(chains, self.model.observations, **known)
        q = problem.start if look.chance < _NOISE else look.coefficients
        problem.settle_noise(q, out)
        self.model, self.problem = Model(problem, self.model.fit), problem

    def _is_hopeless(self, look, n):
        """Return whether so little went with the frames left out that no few of them will do."""
        excess = [one.chi2 - one.freedom for one in (self.first, look)]
        gone = 1 - excess[1] / excess[0] if excess[0] > 0 else 1.0
        return look.chance < _NOISE and n > 2 and gone < 0.5 * n / self.most

    def is_settled(self, places, look):
        """Return whether what was wrong is removed without some frames."""
        if not places or len(places) > self.most:
            return False
        marked = {(i, int(f)) for i, out in enumerate(look.out) for f in np.flatnonzero(out)}
        if marked != set(places):
            look = self._look(places, look.coefficients)
        if look.chance > _NOISE:
            return True
        excess = [one.chi2 / one.freedom - 1 for one in (self.first, look)]
        if excess[1] > (1 - _GONE) * excess[0]:
            return False
        falls = [look.deleted(i)[0] for i in range(len(look.out))]
        left = max(np.max(fall, where=look.kept(i), initial=0.0) for i, fall in enumerate(falls))
        return all(falls[i][f] > _APART * left for i, f in places)


def _marked(problem, places):
    """Return which frames are among some places, one array per dataset."""
    out = [np.zeros(c.shape[2], dtype=bool) for c in problem.channels]
    for i, f in places:
        out[i][f] = True
    return out


def _worst(look, n_frames):
    """Return the frames that stand out most, none if all are as noise and the others are."""
    scores, looks = [], 1
    for i in range(len(look.out)):
        keep = look.kept(i)
        tests = [look.deleted(i)]
        for kind, columns in look.columns(i).items():
            tests.append((look.lowering(i, columns[:1]), np.ones(len(keep))))
            if kind.endswith("beam"):
                tests.append((look.lowering(i, columns), np.full(len(keep), len(columns))))
        looks = max(looks, len(tests))
        scores.append(np.max([_surprise(*test, keep) for test in tests], axis=0))
    places = [(i, f) for i, score in enumerate(scores) for f in range(len(score))]
    every = np.concatenate(scores)
    least = max(np.log(n_frames * looks / _ALPHA), _NEARLY * every.max())
    return [places[k] for k in np.argsort(-every, kind="stable") if every[k] > least]


def _surprise(fall, freedom, keep):
    """Return minus the logarithm of the chance of every frame's fall among the others, (F,)."""
    fall = np.where(keep, fall, 0.0) / usual(fall, freedom, keep)
    # far out the chance is no number any more
    return np.minimum(-stats.chi2.logsf(fall, np.maximum(freedom, 1)), fall / 2)


def usual(fall, freedom, keep):
    """Return how much larger than noise a statistic, (F,), is in most frames, at least 1."""
    if not keep.any():
        return 1.0
    usual = stats.chi2.median(np.maximum(np.median(freedom[keep]), 1))
    return float(max(np.median(fall[keep]) / usual, 1.0))
