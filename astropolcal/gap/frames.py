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
from dataclasses import dataclass, field, fields, replace

import numpy as np
from scipy.special import gammaincinv, ndtr, stdtrit

from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.gap._frame_looks import (
    DIGITS,
    NOISE,
    Frame,
    Group,
    Look,
    Trial,
    angle_stages,
    tails_of,
)
from astropolcal.gap.model import Model, nominal_calibration
from astropolcal.gap.problem import GapProblem, law_basis
from astropolcal.observations.grid import MAD_TO_SIGMA, robust_curve
from astropolcal.observations.pointings import frame_names
from astropolcal.words import listed

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
# share of the frames, those nearest to the drift, that tell it: a drift at the end of a run is in
# more than the other tenth; and the mean deviation of these for noise of unit width
_TRUSTED, _OF_TRUSTED = 0.9, 0.657
# chance of a false accusation in a run, and the share of the frames that may be accused
_ALPHA = 1e-3
_MOST, _LEAST_MOST = 0.05, 2
# where a fit is not down to the noise so much of the excess has to be gone, and the accused have to
# stand so far above the others
_GONE, _APART = 0.8, 10.0
# ends of what may last a while
_FOR_A_WHILE = (" angle", "one beam", "unknown")
# one angle of a group explains its frames if so little is left of them
_LEFT = 0.01
# single data that are so many robust standard deviations off what the others of their frame and
# the nominal model say, and so many where some are known; a wavelength or a frame of which more
# than such a share is, is something else
_OFF, _ALSO = 8.0, 5.0
_OF_WAVELENGTH, _OF_FRAME = 0.1, 0.3
# scatter below this share of the noise is none; the largest degree of the law of a frame, and what
# a datum has to itself
_LITTLE, _SMOOTH, _SEEN = 0.2, 4, 0.05
# of very many frames several are taken at once, those nearly as bad as the worst
_AT_ONCE, _NEARLY = 6, 0.5
# as bad frames are found, so little of the excess is left that the noise is measured anew
_NEARLY_GONE = 0.1
_STEPS, _SHARE = 20, 1e-5
# what a problem knows beside its chains
_KNOWN = ("ties", "laws", "priors", "neutral", "limits")
_STAGES = {"hwp": "the half-wave plate", "derotator": "the derotator"}


@dataclass
class FrameFault:
    """A frame whose data are not what the table says."""

    dataset: str
    #: The frame's number in the table.
    frame: int
    #: ``"hwp angle"`` (or that of another stage), ``"exchanged"``, ``"one beam"``, ``"brightness"``
    #: of a single beam, ``"one wavelength"`` where the others are right, ``"unknown"`` where none
    #: of these, or more than one, describes it, ``"noise"`` where the noise of the others has such
    #: wide tails that this may be it, or ``"lamp"`` where only the brightness is off its drift,
    #: which does not harm the differences.
    what: str
    #: Angle at which the stage stood, in degree; factor of the beam or of the lamp.
    value: float | None = None
    #: Its standard error; where other angles do as well, the distance to the farthest of them.
    error: float | None = None
    #: By how much chi-square is lower than without the fault, less what the freedom of size, kind
    #: and frame costs.
    evidence: float = 0.0
    #: That it is this, and neither noise nor another of these faults.
    probability: float = 0.0
    words: str = ""
    #: ``"right"`` or ``"left"``, where the data tell which beam is off.
    beam: str | None = None
    #: Number of the frame with which it was exchanged.
    with_: int | None = None
    #: Index of the dataset and of the frame, and of that with which it was exchanged.
    place: tuple = field(default=(0, 0), repr=False)
    partner_place: tuple | None = field(default=None, repr=False)
    #: Index of the only wavelength that is off.
    bin: int | None = field(default=None, repr=False)

    def to_dict(self):
        """Return the fault as JSON holds it (dict)."""
        # indices are for the diagnosis itself
        told = [one.name for one in fields(self) if one.repr]
        return {name.rstrip("_"): getattr(self, name) for name in told}


def suspect_frames(model):
    """Return the frames whose data are not what the table says, the most evident first.

    Not those of which only the lamp is off, see `lamp_faults`. There are none where no frame stands
    out, or so many that the model is at fault and not the frames. Where an optic is missing from
    the model everywhere, a small fault of one frame cannot be distinguished from it: look again
    once the optic is in. A frame of a single beam is compared with the others of its group: what
    they cannot tell, such as which of two it is, its words say.
    """
    search = Search(model)
    accused, last = search.accused()
    found = _faults(last, accused, search.n_frames) if accused else []
    if not search.is_settled([fault.place for fault in found], last):
        # where the fit does not find back from where they had bent it, others look bad, too
        found = [fault for fault in found if fault.place in search.worst]
        found = found if search.is_settled([fault.place for fault in found], last) else []
    return found


def single_data(model, known=()):
    """Return the single data that are far off the wavelengths beside them, the farthest first.

    Hot pixels and cosmic rays do that; a gap is smooth in wavelength, or in more frames. There are
    none where they are, with those known, in so few frames that `suspect_frames` finds them, or so
    many that the model is at fault.
    """
    problem, linear, found = model.problem, model.linear, []
    for i, (channel, rows) in enumerate(zip(problem.channels, problem.segments, strict=True)):
        residual, tangent = (
            part[rows].reshape(*channel.shape, -1)[channel.told].swapaxes(0, 1)
            for part in (model.residual, linear.tangent)
        )
        weight = (channel.valid / channel.sigma[channel.told]).T
        off, tail = _single(residual[..., 0], tangent, weight, _ALSO if known else _OFF)
        for f, k in zip(*np.nonzero(off), strict=True):
            what = "one wavelength" if off[f, k] > tail else "noise"
            trial = Trial(what, 0.0, 0.0, bin=int(k))
            chance = float(1 - 2 * off.size * ndtr(-off[f, k]))
            found.append(_fault(problem, (i, int(f)), trial, float(off[f, k] ** 2), chance))
    few = max(_LEAST_MOST, _MOST * sum(c.valid.any(axis=0).sum() for c in problem.channels))
    data = sum(c.valid.sum() for c in problem.channels)
    places = [fault.place for fault in (*known, *found)]
    is_many = len(set(places)) > few
    return sorted(found, key=_order) if is_many and len(places) <= _MOST * data else []


def _single(residual, tangent, weight, least):
    """Return by how many standard deviations data are off, (F, W), 0 where it is less than so many.

    And how far the tails of the noise reach.
    Each is left out in turn: of a frame, beside a smooth law in wavelength of its own, and of what
    the nominal model absorbs, ``tangent`` (F, W, p). ``weight`` (F, W) whitens.
    """
    found, n = np.zeros(residual.shape), residual.shape[1]
    law = law_basis(np.arange(n), min(_SMOOTH, (n - 1) // 3))
    while True:
        kept = (weight > 0) & (found == 0)
        kept &= np.sum(kept, axis=1, keepdims=True) > law.shape[1] + 1
        own = np.linalg.qr(law * (weight * kept)[..., None])[0] * kept[..., None]
        left = np.concatenate([tangent, residual[..., None]], axis=2) * kept[..., None]
        left = left - own @ (own.swapaxes(1, 2) @ left)
        flat = left.reshape(found.size, -1)
        basis, size, _ = np.linalg.svd(flat[:, :-1], full_matrices=False)
        basis = basis[:, size > _SEEN]
        missed = (flat[:, -1] - basis @ (basis.T @ flat[:, -1])).reshape(found.shape)
        seen = kept - np.sum(own**2, axis=2) - np.sum(basis**2, axis=1).reshape(found.shape)
        off = np.abs(missed) / np.sqrt(np.where(seen > _SEEN, seen, np.inf))
        spread = max(MAD_TO_SIGMA * np.median(off[kept]), _LITTLE) if kept.any() else np.inf
        # the worst of each of the worst frames first: it makes others look bad, and the scatter
        frames = np.flatnonzero(off.max(axis=1) > max(_ALSO * spread, _NEARLY * off.max()))
        if not frames.size:
            break
        if np.count_nonzero(found) > 2 * _MOST * found.size:
            return 0.0 * found, np.inf
        worst = off.argmax(axis=1)[frames]
        found[frames, worst] = off[frames, worst]
    # what is in many frames is there, too, where it is weaker
    found[np.sum(found > 0, axis=1) > _OF_FRAME * n] = 0.0
    found[:, np.mean(found > 0, axis=0) > _OF_WAVELENGTH] = 0.0
    freedom, width = tails_of(off[kept])
    tail = -width * stdtrit(freedom, _ALPHA / (2 * found.size))
    return np.where(found > least * spread, found / spread, 0.0), tail


def not_off(model, observations, faults):
    """Return those of single data that agree with a model fitted without them."""
    if not faults:
        return []
    known = {key: getattr(model.problem, key) for key in _KNOWN}
    problem = GapProblem(model.trains, observations, **known)
    problem.settle_noise()
    found, gaps = [], problem.differences(problem.start)
    for fault in faults:
        i, f = fault.place
        place = problem.channels[i].told, fault.bin, f
        if abs(gaps[i][place]) < _ALSO * problem.channels[i].sigma[place]:
            found.append(fault)
    return found


def unknown_angles(observations, effect):
    """Return the frames whose angle, as an alternative reads it, is in no row of their table."""
    found = []
    for i, one in enumerate(observations):
        for f in np.flatnonzero(effect.edge(one)):
            number = int(one.frames["frame"][f])
            name = frame_names(one.frames)[f]
            words = f'frame {name}: its angle is in no row of "{one.name}"'
            given = {"probability": 1.0, "words": words, "place": (i, int(f))}
            found.append(FrameFault(one.name, number, "unknown", **given))
    return found


def without_frames(observations, faults):
    """Mask the frames that are not what the table says."""
    observations = list(observations)
    for fault in faults:
        if fault.what != "lamp":
            i, f = fault.place
            mask = np.zeros((observations[i].n_frames, observations[i].n_bins), dtype=bool)
            mask[f, slice(None) if fault.bin is None else fault.bin] = True
            reason = f"not as the table says: {fault.what}"
            observations[i] = observations[i].with_mask(mask, reason)
    return observations


# ---- hearing ---------------------------------------------------------------------------------


def _faults(look, accused, n_frames):
    """Return what each of the accused frames is accused of, those that are guilty."""
    scatter = [usual(*look.deleted(i), look.kept(i)) for i in range(len(look.out))]
    frames = {(i, f): Frame(look, i, f, scatter[i]) for i, f in accused}
    trials = {place: [one.as_told(), *one.trials()] for place, one in frames.items()}
    found = {}
    for place in accused:
        every = [*trials[place], *_exchanges(place, frames, trials)]
        fault = _verdict(look, place, every, n_frames)
        if fault is not None:
            found[place] = fault
    for fault in list(found.values()):
        # those frames, too, that were exchanged with one of them
        other = fault.partner_place
        if other is not None and (other not in found or found[other].what != "exchanged"):
            trial = Trial("exchanged", 0.0, 0.0, partner=fault.place[1])
            found[other] = _fault(look.problem, other, trial, fault.evidence, fault.probability)
    found = _of_groups(look, _of_a_while(look, list(found.values())), scatter)
    return sorted(found, key=_order)


def _of_a_while(look, found):
    """Return the faults; of frames in a row no angle is to blame, unless a stage did not move.

    Something may have changed for a while: light that arrives turned looks like a half-wave plate
    that is, and that each move of a stage failed is no more probable. Nor is one beam to blame, and
    then the other: light that arrives depolarized looks so.
    """
    off = {one.place: (one.what, one.beam) for one in found if one.what.endswith(_FOR_A_WHILE)}
    for fault in found:
        (i, f), stage = fault.place, fault.what.removesuffix(" angle")
        near = [k for k in (f - 1, f + 1) if (i, k) in off]
        is_known = fault.place in off and fault.what != "unknown"
        if not is_known or look.problem.channels[i].groups is not None:
            continue
        # a beam has no angle that could move
        stood = np.atleast_1d(look.problem.datasets[i]._given.get(stage, np.zeros(f + 2)))
        if any(stood[k] != stood[f] or off[i, k] != off[i, f] for k in near):
            fault.what, fault.value, fault.error, fault.beam = "unknown", None, None, None
            fault.words += ", or something else changed for a while"
    return found


def _order(fault):
    return -round(fault.evidence, DIGITS), fault.place


def _verdict(look, place, trials, n_frames):
    """Weigh the trials of a frame against each other (Bayes), or return None: no fault."""
    kinds = len(angle_stages(look.chains[place[0]])) + 2
    none, *rest = trials
    prior = 1 / (_RARE * n_frames * kinds)
    shares = [prior * (_UNEXPLAINED if trial.what == "unknown" else 1.0) for trial in rest]
    log = np.log([1.0, *shares]) - np.array([trial.total for trial in trials]) / 2
    weight = np.exp(log - max(log))
    weight /= weight.sum()
    if weight[0] > 1 - _CERTAIN:
        # without the tails of the noise it may be guilty
        normal = [replace(none, cost=0.0), *rest]
        fault = _verdict(look, place, normal, n_frames) if none.cost else None
        noise = Trial("noise", 0.0, 0.0, bin=fault and fault.bin)
        return fault and _fault(look.problem, place, noise, fault.evidence, fault.probability)
    by_kind, weights = {}, weight[1:].tolist()
    for trial, w in zip(rest, weights, strict=True):
        by_kind[trial.what] = by_kind.get(trial.what, 0.0) + w
    what = max(by_kind, key=by_kind.get)
    best = min((t for t in rest if t.what == what), key=lambda trial: trial.total)
    evidence = none.total - best.total + 2 * np.log(prior)
    side = sum(w for t, w in zip(rest, weights, strict=True) if t.beam == best.beam)
    best.beam = best.beam if side > _TELLS * by_kind[what] else ""
    rivals = {}
    if by_kind[what] < _DECIDED:
        worst_first = sorted(rest, key=lambda trial: -trial.total)
        rivals = {t.what: t for t in worst_first if by_kind[t.what] > 1 - _TELLS}
    fault = _fault(look.problem, place, best, float(evidence), min(by_kind[what], 1.0))
    return _of_design(look.problem, fault, rivals, float(1 - weight[0]))


def _of_groups(look, found, scatter):
    """Return the faults; of several in a group of a single beam, a stage of all its frames."""
    several = {}
    for fault in found:
        i, f = fault.place
        groups = look.problem.channels[i].groups
        if groups is not None:
            several.setdefault((i, int(groups[f])), []).append(fault)
    for (i, _), faults in several.items():
        group = Group(look, i, faults[0].place[1], scatter[i])
        trials = group.trials() if len(faults) > 1 else []
        if not trials:
            continue
        chi2, before = trials[0].chi2, group.as_told().chi2
        # one angle explains all of them, down to the noise or to what the fit is uncertain by
        if chi2_above(chi2, max(group.freedom, 1)) < NOISE and chi2 > _LEFT * before:
            continue
        near = trials[0].total - 2 * np.log(1 - _TELLS)
        rivals = {t.what: t for t in reversed(trials) if t.total < near}
        worst = max(faults, key=lambda fault: fault.evidence)
        found = [fault for fault in found if fault not in faults]
        for f in group.frames:
            fault = _fault(look.problem, (i, int(f)), trials[0], worst.evidence, worst.probability)
            found.append(_of_design(look.problem, fault, rivals, worst.probability))
    return found


def _of_design(problem, fault, rivals, probability):
    """Return a fault with what the design of its observation cannot tell."""
    i, f = fault.place
    channel = problem.channels[i]
    if len(rivals) > 1:
        kinds = [_fault(problem, fault.place, trial, 0.0, 0.0) for trial in rivals.values()]
        each = (kind.words.partition(": ")[2] for kind in reversed(kinds))
        name = fault.words.partition(": ")[0]
        fault = _fault(problem, fault.place, Trial("unknown", 0, 0), fault.evidence, probability)
        fault.words = f"{name}: {', or '.join(each)}; its design cannot tell"
    if channel.groups is None:
        return fault
    mates = channel.valid.any(axis=0) & (channel.groups == channel.groups[f])
    if mates.sum() == 2:
        names = frame_names(problem.datasets[i].observations.frames)
        one, other = (names[k] for k in np.flatnonzero(mates))
        fault.words += f"; or it is the other of the group: frames {one} and {other} alone"
        fault.words += " cannot tell which of them is wrong"
    return fault


def _fault(problem, place, trial, evidence, probability):
    """Return the fault that a trial of a frame is, in the units of the user."""
    (i, f), told, others = place, None, np.array(trial.others)
    dataset = problem.datasets[i]
    observations = dataset.observations
    value, error = trial.value, trial.error
    if trial.what.endswith(" angle"):
        stage = trial.what.removesuffix(" angle")
        stood = told = float(np.atleast_1d(dataset._given[stage])[f])
        # where a law turns what the table says into the angle of the optic, its error is added
        if stage in observations.frame_columns:
            told = float(observations.position(stage)[f])
        others = np.rad2deg(told + others - stood)
        value, error, told = np.rad2deg([told + value - stood, error, told]).tolist()
    numbers, names = observations.frames["frame"], frame_names(observations.frames)
    told_of = {"evidence": evidence, "probability": probability, "place": place, "bin": trial.bin}
    told_of["beam"] = trial.beam or None
    fault = FrameFault(observations.name, int(numbers[f]), trial.what, **told_of)
    if np.isfinite(value):
        fault.value, fault.error = value, error
    if trial.partner is not None:
        fault.with_, fault.partner_place = int(numbers[trial.partner]), (i, trial.partner)
    nm = None if trial.bin is None else observations.wavelength[trial.bin].to_value("nm")
    fault.words = f"frame {names[f]}: {_words(fault, told, trial.beam, others, nm, names)}"
    fault.error = float(np.abs(others - value).max()) if others.size else fault.error
    return fault


def _words(fault, told, beam, others, nm, names):
    """Return what is wrong with a frame, beside the angle (degree) that its table states."""
    if not fault.what.endswith(" angle"):
        off = None if fault.value is None else f"{100 * abs(fault.value - 1):.2g} %"
        other = names[fault.partner_place[1]] if fault.partner_place else ""
        return {
            "exchanged": f"its data are those of frame {other}, and the other way round",
            "one beam": f"{f'the {beam}' if beam else 'one'} beam is off by {off}",
            "brightness": f"its brightness is off that of its group by {off}",
            "one wavelength": f"its data at {nm or 0:.0f} nm do not fit those at others",
            "noise": "it is far off, as some data are in noise of such wide tails",
            "lamp": f"the lamp is off its drift by {off}",
            "unknown": "its differences fit no angle of a stage and no factor of a beam",
        }[fault.what]
    stage = fault.what.removesuffix(" angle")
    name = _STAGES.get(stage, f"the stage {stage}")
    # as many digits as tell the two angles apart, and no more than the error is worth
    finest = max(fault.error, abs(fault.value - told) / 30)
    digits = int(np.clip(np.ceil(1 - np.log10(finest)), 1, 4))
    stood = listed([f"{angle:.{digits}f}" for angle in (fault.value, *others)], "or") + " deg"
    words = f"its data are those of {name} at {stood}, not at"
    return f"{words} {told:.{digits}f} deg as the table says"


def _exchanges(place, frames, trials):
    """Return the trials in which the stages stood as in another frame, and there as in this."""
    i, f = place
    one, told = frames[place], trials[place][0].chi2
    n, others = one.channel.shape[2], one.channel.valid.any(axis=0)
    others[f] = False
    left = np.where(others, one.with_positions_of(np.arange(n)), np.inf)
    found = []
    for j in np.argsort(left, kind="stable")[:_PARTNERS]:
        if not left[j] < told - _BETTER:
            break
        other = (i, int(j))
        partner = frames.get(other) or Frame(one.look, *other, one.scatter)
        known = trials.get(other) or [partner.as_told()]
        theirs = float(partner.with_positions_of([f])[0])
        if theirs < known[0].chi2 - _BETTER:
            cost = 2 * np.log(max(n - 1, 1)) + theirs - min(trial.total for trial in known)
            found.append(Trial("exchanged", float(left[j]), cost, partner=int(j)))
    return found


# ---- the lamp --------------------------------------------------------------------------------


def lamp_faults(model, others=()):
    """Return the frames, without those of others, whose brightness is off the lamp's drift."""
    found, named = [], {fault.place for fault in others}
    problem, gaps = model.problem, model.problem.differences(model.fit.coefficients)
    for i, (channel, gap) in enumerate(zip(problem.channels, gaps, strict=True)):
        if channel.groups is not None:
            # its frames have no other brightness than that of their group
            continue
        deviation, score = _off_the_drift(channel, gap[1])
        for f in np.flatnonzero(np.abs(np.nan_to_num(score)) > _FAR):
            size, off = float(np.exp(deviation[f])), float(abs(score[f]))
            trial = Trial("lamp", 0.0, 0.0, size, float(abs(deviation[f]) / off))
            chance = float(1 - 2 * score.size * ndtr(-off))
            found.append(_fault(problem, (i, int(f)), trial, off**2, chance))
    return sorted((fault for fault in found if fault.place not in named), key=_order)


def _off_the_drift(channel, gap):
    """Return by how much the brightness of every frame is off a smooth drift, (F,) each.

    As the logarithm of the flux that is common to all wavelengths, and in robust standard
    deviations; ``gap`` is that of the sums, (W, F).
    """
    sigma = channel.sigma[1]
    table = np.where(channel.valid & np.isfinite(sigma), gap, np.nan)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        # a frame that is masked at all wavelengths has no median
        common = np.nanmedian(table - np.nanmedian(table, axis=1, keepdims=True), axis=0)
        # the variance of a median of n is pi / 2 times that of their mean: 1.25 squared; some
        # frames may be noisier than others
        count = np.maximum(np.isfinite(table).sum(axis=0), 1)
        error = np.nanmedian(sigma, axis=0) * 1.25 / np.sqrt(count)
    least, n = np.inf, np.isfinite(common).sum()
    # the curve whose median deviation is least for what its degree costs
    for degree in range(min(_LARGEST_DRIFT, n // 4) + 1):
        curve = robust_curve(2 * channel.sequence - 1, common, degree)
        off = np.sort(np.abs(common - curve))[: int(np.ceil(_TRUSTED * n))]
        middle = np.mean(off) if off.size else np.nan
        cost = n * np.log(max(middle, 1e-12)) + degree * np.log(max(n, 2))
        if cost < least:
            least, deviation, spread = cost, common - curve, np.fmax(middle / _OF_TRUSTED, error)
    return deviation, deviation / spread


# ---- the search --------------------------------------------------------------------------------


class Search:
    """A search for frames that stand out."""

    def __init__(self, model):
        self.model, self.problem = model, model.problem
        self.n_frames = int(sum(c.valid.any(axis=0).sum() for c in self.problem.channels))
        self.most = max(_LEAST_MOST, int(_MOST * self.n_frames))
        self.first = Look(model, model.fit.coefficients, _marked(self.problem, []))
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
        least = _NEARLY_GONE * self.first.excess
        few = (one for one in trail if one[0] and (one[1].is_noise or one[1].excess < least))
        places, look = next(few, ([], self.first))
        if not places:
            return [], self.first
        self.worst = set(places)
        # the noise is measured without them, and a start found for the fit that has them not
        old, chains, out = self.problem, self.model.chains, _marked(self.problem, places)
        if not look.is_noise and not self.model.added:
            seen = zip(self.model.observations, out, strict=True)
            left = [o.with_mask(mask, "accused") for o, mask in seen]
            chains = nominal_calibration(chains, left).chains
        known = {key: getattr(old, key) for key in _KNOWN}
        problem = GapProblem(chains, self.model.observations, **known)
        problem.settle_noise(look.coefficients if look.is_noise else problem.start, out)
        self.model, self.problem = Model(problem, self.model.fit), problem
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
            # so little went with those that no few will do
            excess = [one.chi2 - one.freedom for one in (self.first, look)]
            gone = 1 - excess[1] / excess[0] if excess[0] > 0 else 1.0
            hopeless = len(places) > 2 and gone < 0.5 * len(places) / self.most
            if len(places) >= 2 * self.most or (hopeless and not look.is_noise):
                yield [], look
                return
            places = places + suspects
            look = self._look(places, look.coefficients)

    def _look(self, places, coefficients):
        out = _marked(self.problem, places)
        rows = self.problem.rows([~o for o in out])
        fit = self.problem.fit(coefficients, rows=rows, steps=_STEPS, share=_SHARE)
        look = Look(self.model, fit.coefficients, out)
        if look.is_noise:
            return look
        # from where bad frames had bent it a fit need not find back
        other = self.problem.fit(self.problem.start, rows=rows, steps=_STEPS, share=_SHARE)
        return Look(self.model, other.coefficients, out) if other.chi2 < fit.chi2 else look

    def is_settled(self, places, look):
        """Return whether what was wrong is removed without some frames."""
        if not places or len(places) > self.most:
            return False
        marked = {(i, int(f)) for i, out in enumerate(look.out) for f in np.flatnonzero(out)}
        if marked != set(places):
            look = self._look(places, look.coefficients)
        if look.is_noise:
            return True
        if look.excess > (1 - _GONE) * self.first.excess:
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
        chances = []
        for fall, freedom in tests:
            fall = np.where(keep, fall, 0.0) / usual(fall, freedom, keep)
            # far out the chance is no number any more
            with np.errstate(divide="ignore"):
                log = np.log(chi2_above(fall, np.maximum(freedom, 1)))
            chances.append(np.minimum(-log, fall / 2))
        scores.append(np.max(chances, axis=0))
    places = [(i, f) for i, score in enumerate(scores) for f in range(len(score))]
    every = np.concatenate(scores).round(DIGITS)
    least = max(np.log(n_frames * looks / _ALPHA), _NEARLY * every.max())
    return [places[k] for k in np.argsort(-every, kind="stable") if every[k] > least]


def usual(fall, freedom, keep):
    """Return how much larger than noise a statistic, (F,), is in most frames, at least 1."""
    if not keep.any():
        return 1.0
    # the median of chi-square
    usual = 2 * gammaincinv(max(np.median(freedom[keep]), 1) / 2, 0.5)
    return float(max(np.median(fall[keep]) / usual, 1.0))
