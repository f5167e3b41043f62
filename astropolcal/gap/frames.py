# Licensed under a 3-clause BSD style license - see LICENSE
"""
Single frames whose data are not what the table says of them.

A wave plate that did not reach its angle, two frames whose files were exchanged,
or a beam that was clipped once bends the whole fit, and an optic is blamed for it.
So frames are looked at first: each is left out in turn, at the cost of one linear
step (the deletion residual of Cook & Weisberg 1982), and whatever stands out from
noise and from all other frames is named, taken out, and the search goes on. A gap
that is in all frames is none of theirs: without the few frames that are named the
fit must be down to the noise, or nearly all of its excess be gone.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from astropolcal.gap._frame_looks import angle_stages
from astropolcal.gap._frame_search import Search, usual
from astropolcal.gap._frame_trials import Frame, Trial
from astropolcal.gap.remainders import off_the_drift

__all__ = ["FrameFault", "suspect_frames", "without_frames"]

# one frame in so many runs of any length is thought to be wrong beforehand, and the share of
# these that nobody can explain
_RARE, _UNEXPLAINED = 10.0, 0.1
# an exchange makes either frame better by so much, and is tried for so many frames
_BETTER, _PARTNERS = 10.0, 5
_CERTAIN = 0.99
# a beam is called by its name where it is it with this share
_TELLS = 0.95
_STAGES = {"hwp": "the half-wave plate", "derotator": "the derotator"}


@dataclass
class FrameFault:
    """
    A frame whose data are not what the table says.

    Parameters
    ----------
    dataset : str
        Name of the dataset.
    frame : int
        The frame's number in the table.
    what : str
        ``"hwp angle"`` (or that of another stage), ``"exchanged"``, ``"one beam"``,
        ``"unknown"`` where neither of these describes it, or ``"lamp"`` where only the
        brightness is off its drift, which does not harm the differences.
    with_ : int or None
        Number of the frame with which it was exchanged.
    value, error : float or None
        Angle at which the stage stood, in degree; factor of the beam or of the lamp.
    evidence : float
        By how much chi-square is lower than without the fault, less what the freedom of
        size, kind and frame costs.
    probability : float
        That it is this, and neither noise nor another of these faults.
    words : str
        One sentence.
    place : tuple of int
        Index of the dataset and of the frame.

    Examples
    --------
    >>> from astropolcal.gap.frames import FrameFault
    >>> FrameFault("night", 5, "unknown", probability=0.9).to_dict()["frame"]
    5
    """

    dataset: str
    frame: int
    what: str
    with_: int | None = None
    value: float | None = None
    error: float | None = None
    evidence: float = 0.0
    probability: float = 0.0
    words: str = ""
    place: tuple = field(default=(0, 0), repr=False)

    def to_dict(self):
        """Return the fault as JSON holds it (dict)."""
        names = ("dataset", "frame", "what", "value", "error", "evidence", "probability", "words")
        return {name: getattr(self, name) for name in names} | {"with": self.with_}


def suspect_frames(model):
    """
    Find frames whose data are not what the table says.

    Where an optic is missing from the model everywhere, a small fault of one frame cannot be
    told from it: look again once the optic is in.

    Parameters
    ----------
    model : Model
        The fitted model.

    Returns
    -------
    list of FrameFault
        The most evident first, frames of which only the lamp is off last. It is empty where no
        frame stands out, or so many that the model is at fault and not the frames.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.frames import suspect_frames
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 75, 90] * u.deg)
    >>> frames["hwp_true"] = frames["hwp"] + np.where(np.arange(32) == 5, 1.0, 0.0) * u.deg
    >>> data = simulate(chain, charis.wavelength, frames, seed=3)
    >>> [(fault.frame, fault.what) for fault in suspect_frames(nominal_model([chain], [data]))]
    [(5, 'hwp angle')]
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
    """
    Mask the frames that are not what the table says.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets, in the order in which the model had them.
    faults : sequence of FrameFault
        Frames of which only the lamp is off are left as they are.

    Returns
    -------
    list of Observations

    Examples
    --------
    >>> from astropolcal.gap.frames import FrameFault, without_frames
    >>> from astropolcal.observations import Observations, example_table
    >>> night = Observations.from_table(example_table())
    >>> fault = FrameFault("night", 1, "one beam", place=(0, 1))
    >>> without_frames([night], [fault])[0].mask_reasons
    {'not as the table says: one beam': 3}
    """
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
        return sorted(self._with_partners(found), key=lambda fault: -fault.evidence)

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
        return self._fault(place, best, float(evidence), min(by_kind[what], 1.0))

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
    if trial.what == "one beam":
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
    for i, (observations, far, deviation, score) in enumerate(off_the_drift(model)):
        numbers = observations.frames["frame"]
        for f in np.flatnonzero(far):
            fault = FrameFault(
                observations.name,
                int(numbers[f]),
                "lamp",
                value=float(np.exp(deviation[f])),
                error=float(abs(deviation[f] / score[f])),
                evidence=float(score[f] ** 2),
                probability=float(1 - 2 * far.size * stats.norm.sf(abs(score[f]))),
                place=(i, int(f)),
            )
            fault.words = _words(fault, None)
            found.append(fault)
    return sorted(found, key=lambda fault: -fault.evidence)
