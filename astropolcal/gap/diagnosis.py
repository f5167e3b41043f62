# Licensed under a 3-clause BSD style license - see LICENSE
"""
Diagnosis of the gap between a model and an instrument.

`diagnose` fits the nominal model, measures the gap, asks the library of effects which of them the
data miss, checks the answer on frames that were left out, and says what stays unexplained.
"""

import time
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit

from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.exceptions import GapError
from astropolcal.gap.alternatives import chains_of, starting_model
from astropolcal.gap.attribution import ENOUGH, Candidate
from astropolcal.gap.cells import count_runs
from astropolcal.gap.effects import EFFECTS, adapted, get_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.effects.library import OF_RUNS
from astropolcal.gap.frames import (
    lamp_faults,
    not_off,
    single_data,
    suspect_frames,
    unknown_angles,
    without_frames,
)
from astropolcal.gap.model import Model, nominal_model
from astropolcal.gap.problem import GapProblem
from astropolcal.gap.runs import distinct
from astropolcal.gap.selection import REMAINDER, beside_one, explained_by_one, select
from astropolcal.gap.shrinkage import HeldOut, frame_groups
from astropolcal.measurement.datasets import as_tables
from astropolcal.progress import in_one_thread
from astropolcal.words import counted, html, listed

__all__ = ["Cause", "Diagnosis", "diagnose"]

# probabilities from which a cause is named, and from which it is located
_SURE, _LIKELY = 0.9, 0.5
# of an alternative beside which nothing is left
_SURE_SIGN = 0.99
# so probable is, at least, that causes are of the table
_LEAST = 1e-6
# where it leaves no more of the double differences, and needs more causes beside it, of which none
# is sure, others in its place are not asked for
_LITTLE, _FEW = 0.05, 4
# residuals of a smaller mean square, and more probable than this, show that the noise was taken
# too large: by the roughness of a large gap, before its causes were known
_TOO_QUIET, _TOO_PROBABLE = 0.8, 0.999
# above this probability of an unlisted cause frames are looked for again, beside a cause
_DOUBTFUL = 0.5


@dataclass
class Cause:
    """
    One cause that the model lacked, with what cannot be distinguished from it.

    Parameters
    ----------
    effect : Effect
        The cause as an effect, named or a cell.
    cell : Cell or None
        Its place, kind and dependence.
    probability : float
        That it, or one of its aliases, is a cause of the gap.
    aliases : list of (Candidate, float)
        What explains the data nearly as well, with its probability within the group.
    share : float
        Its own probability within the group.
    p_value : float
        Of the scan, for this cause alone.
    explained : float
        Share of the gap (excess of chi-square over the noise) that it explains.
    before, after : HeldOut or None
        Prediction errors on left-out frames without and with it.
    physical : bool
        Whether its fitted size is a possible one.
    evidence : float
        Logarithm of the Bayes factor.
    stability : float or None
        Share of the halves of the wavelengths and of the left-out angles in which it is found.
    by_dataset : dict of str to float
        Evidence for it in each of several runs alone.

    Examples
    --------
    >>> from astropolcal.gap import Cause
    >>> from astropolcal.gap.effects import get_effect
    >>> Cause(get_effect("beam_gain"), None, 0.99, [], 1.0, 1e-9, 0.9).name
    'beam_gain'
    """

    effect: object
    cell: object
    probability: float
    aliases: list
    share: float
    p_value: float
    explained: float
    before: object = None
    after: object = None
    physical: bool = True
    evidence: float = 0.0
    stability: float | None = None
    by_dataset: dict = field(default_factory=dict)

    @property
    def name(self):
        """Name of the effect; of a cell, its place, kind and dependence."""
        return self.effect.name

    @property
    def is_named(self):
        """Whether it has a name in the library."""
        return not isinstance(self.effect, CellEffect)


@dataclass
class Diagnosis:
    """
    What `diagnose` found.

    Parameters
    ----------
    verdict : {"none", "named", "located", "unexplained"}
        There is no gap; its causes have names; they have a place, a kind and a dependence each;
        or there is a gap that no cause of the table explains.
    nominal, improved : Model
        The model before, and with all causes in it.
    causes : list of Cause
        In the order in which they were found.
    scan : Scan
        Evidence for all causes beside the nominal model.
    held_out : list of HeldOut
        Prediction errors before and after.
    gap_p_value : float
        Probability of the nominal residuals by noise alone.
    remainder_p_value : float
        The same for the improved model.
    seconds : float
        Time spent.
    frames : list of FrameFault
        Frames that are not what the table says.
    settings : dict
        How it was asked.
    nested : HeldOut or None
        Errors on groups of frames that took no part in the choice of the causes.
    courses : list of Course
        Of which one may be in place of all causes: a perturbation whose course through the run no
        dependence describes.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(chain, charis.wavelength, frames, seed=1)
    >>> diagnose(chain, observations).verdict
    'none'
    """

    verdict: str
    nominal: Model
    improved: Model
    causes: list
    scan: object
    held_out: list
    gap_p_value: float
    remainder_p_value: float
    seconds: float = 0.0
    frames: list = field(default_factory=list)
    settings: dict = field(default_factory=dict)
    nested: object = None
    courses: list = field(default_factory=list)
    #: What `astropolcal.gap.report.to_dict` has worked out, None before it was asked.
    content: dict | None = field(default=None, init=False, repr=False, compare=False)

    @property
    def noise_floor_percent(self):
        """Noise of a single difference, or of an intensity over the mean of its group, rms."""
        parts = [c.noise[c.valid] for c in self.nominal.problem.channels]
        return 100 * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

    @property
    def hidden_percent(self):
        """Rms of what may be left of the gap in a single difference (95 %), in percent."""
        told = sum(channel.valid.sum() for channel in self.improved.problem.channels)
        return self.noise_floor_percent * float(np.sqrt(self.improved.could_hide() / told))

    @property
    def gap_before_percent(self):
        """Gap of the nominal model on left-out frames (else of its fit), in percent."""
        # a chain of the wrong parity has no fit that could predict left-out frames
        if self.held_out and not any(c.effect.kind == "discrete" for c in self.causes):
            return self.held_out[0].percent
        return _gap_of_fit(self.nominal)

    @property
    def gap_after_percent(self):
        """Gap of the improved model on left-out frames (else of its fit), in percent."""
        return self.held_out[-1].percent if self.held_out else _gap_of_fit(self.improved)

    @property
    def chains(self):
        """The improved chains, with fitted values."""
        return self.improved.chains

    def __repr__(self):
        names = ", ".join(cause.name for cause in self.causes) or "no cause"
        return (
            f"<Diagnosis: {self.verdict} ({names}); gap {self.gap_before_percent:.3g} % -> "
            f"{self.gap_after_percent:.3g} %>"
        )

    def _repr_html_(self):
        from astropolcal.gap.report import causes_table

        return html(repr(self), causes_table(self))


def _gap_of_fit(model):
    """Return the root mean square of the differences' residuals, in percent."""
    gaps = model.problem.differences(model.fit.coefficients)
    parts = [c.gap(g)[c.valid] for g, c in zip(gaps, model.problem.channels, strict=True)]
    return 100 * float(np.sqrt(np.mean(np.square(np.concatenate(parts)))))


@in_one_thread
def diagnose(
    calibration,
    observations,
    *,
    effects="all",
    cells=True,
    changes=False,
    cross_validate=True,
    nested=False,
    progress=None,
):
    """
    Diagnose the gap between a model and measurements.

    Parameters
    ----------
    calibration : Calibration, `~astropy.modeling.CompoundModel` or sequence of them
        The nominal model: a calibration, or the chain of each dataset. Its free parameters are
        calibrated with these data, from the values that they have.
    observations : Observations or sequence of Observations
        The datasets, used together.
    effects : "all" or sequence of str or Effect
        The names to ask for.
    cells : bool
        Whether to ask for every cell of places, kinds and dependences too; without it
        the answer is one of the names, or none.
    changes : bool
        Whether to ask what changed between several runs of the same kind of source: causes
        of one run only come first.
    cross_validate : bool
        Whether to check on left-out frames; without it the gaps are those of the fit itself.
    nested : bool
        Whether to choose the causes again without each group of frames, and predict that with
        them: the one measure of the shrinkage in which the choice has no part. It takes as many
        times the time as there are groups.
    progress : callable, optional
        Called with a line on what is done next.

    Returns
    -------
    Diagnosis

    Raises
    ------
    GapError
        If the nominal fit does not converge, there are too few groups of frames
        to leave out, an effect is unknown, or is given and has no place in the chains, the same
        data are given twice, or changes are asked for where no two datasets have the same source.
    ObservationError
        If the observations are not tables of fluxes.

    Examples
    --------
    A chain that lacks the unequal gains of the beams:

    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.optics import BeamGain
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear", wavelength=[1200, 1600, 2000] * u.nm)
    >>> truth = chain | BeamGain(imbalance=0.02, name="flat")
    >>> frames = half_wave_plate_cycles(derotator=[45, 70, 95, 120] * u.deg)
    >>> observations = simulate(truth, [1200, 1600, 2000] * u.nm, frames, seed=1)
    >>> diagnose(chain, observations).causes[0].name
    'beam_gain'
    """
    started = time.perf_counter()
    say = progress or (lambda line: None)
    observations = as_tables(observations)
    library = _library(effects)
    check_instruments(calibration, observations)
    chains_of(calibration, observations)
    if changes and not cells:
        raise GapError("what changed between runs is found by cells; ask for them, too")
    observations = distinct(observations, changes)
    for effect in library if effects != "all" else ():
        effect.check_for(chains_of(calibration, observations), observations)
    if cross_validate:
        # too few frames are refused before anything is fitted
        frame_groups(observations)
    how = {"cells": cells, "changes": changes, "cross_validate": cross_validate, "nested": nested}
    found = _diagnosed(calibration, observations, library, say, how)
    found.settings["names"] = [o.name for o in observations]
    found.seconds = time.perf_counter() - started
    return found


def _diagnosed(calibration, observations, library, say, how):
    """Return the diagnosis, without its time; see `diagnose` for ``how``."""
    say("fitting the nominal model")
    nominal, base, exchanged, where = starting_model(calibration, observations, library, say)
    edges = unknown_angles(base.observations, exchanged[0]) if exchanged else []
    say("looking for frames that are not what the table says")
    whole, single = (nominal, base), []
    while more := single_data(base, single):
        nominal, base = _without(nominal, base, more, say)
        single += more
    wrong = suspect_frames(base)
    # what has a place depends on the alternative that was taken; the discrete ones were tried.
    # What depends on the last move of a stage shows in a few frames too, and is one cause
    runs = [o.name for o in base.observations] if count_runs(base.problem) > 1 else ()
    smooth = [e for e in adapted(library, base.chains, runs) if e.kind != "discrete"]
    # and so many wavelengths tell it
    smooth = [e for e in smooth if e.is_told(len(base.problem.wavelength))]
    if len(wrong) > 1 and explained_by_one(base, smooth, cells=how["cells"]):
        wrong = []

    def chosen(model, **more):
        groups = frame_groups(model.observations) if how["cross_validate"] else None
        more |= {"cells": how["cells"], "changes": how["changes"]}
        return select(model, smooth, groups, say, **more)

    models = _without(nominal, base, wrong, say)
    answer = _selected(chosen, whole, models, single, wrong, say)
    if not wrong and (more := _beside_causes(answer, say)):

        def anew(frames):
            others = _without(*whole, single + frames, say)
            return _selected(chosen, whole, others, single, frames, say)

        again = anew(more)
        # beside what is in the model now fewer may stand out
        recipes = [group.best.recipe for group in again[1].groups]
        sure = suspect_frames(answer[0][1].with_effects(recipes))
        if len(sure) < len(more):
            more, again = sure, anew(sure)
        if again[1].model.p_value > REMAINDER and again[1].unlisted < _DOUBTFUL:
            answer, wrong = again, more
    (nominal, base), selection, single = answer
    if exchanged:
        share = _share_of(exchanged[0], nominal, base, selection, chosen, say)
        if share < 0.5:
            rest = [effect for effect in library if effect.kind != "discrete"]
            return _diagnosed(calibration, observations, rest, say, how)
        exchanged[0] = exchanged[0].changed(left=max(exchanged[0].left, 1 - share))
    # what dims a frame may be a cause of the gap, and then the lamp did not
    frames = edges + single + wrong
    frames += lamp_faults(selection.model, frames)
    found = _conclude(nominal, base, exchanged, selection, frames)
    found.settings |= {"changes": how["changes"], "fails": where}
    if how["nested"] and how["cross_validate"]:
        found.nested = _nested(base, smooth, say, how["cells"])
    return found


def _without(nominal, base, faults, say):
    """Return the nominal model, and that with an alternative, fitted without what is wrong."""
    if not faults:
        return nominal, base
    many = counted(len({fault.place for fault in faults}), "frame")
    say(f"without what is wrong in {many}: fitting the nominal model again")
    kept = without_frames(base.observations, faults)
    # a fit that the frames had bent need not find back
    fresh = nominal_model(base.start, kept, other=base.chains)
    # with noise and effects of its own
    again = Model(fresh.problem, fresh.fit, base.added, start=base.start)
    return (again if nominal is base else nominal), again


def _selected(chosen, whole, models, single, wrong, say):
    """Return models and causes, and the data that are left out after all; see `_without`."""
    say("looking for causes")
    selection = chosen(models[1])
    if right := not_off(selection.model, whole[1].observations, single):
        say("looking for causes again: they explain data that were left out")
        kept = [fault for fault in single if fault not in right]
        others = _without(*whole, kept + wrong, say)
        again = chosen(others[1])
        # unless one of them is off after all
        if again.model.p_value > min(REMAINDER, selection.model.p_value):
            models, selection, single = others, again, kept
    left, (nominal, base) = selection.model, models
    if nominal is base and left.mean_square < _TOO_QUIET and left.p_value > _TOO_PROBABLE:
        say("looking for causes again: they leave less than what was taken for noise")
        # fitted with the noise that the residuals beside the causes show
        problem = GapProblem(base.chains, base.observations)
        problem.settle_noise(base.fit.coefficients)
        fresh = Model(problem, base.fit, base.added)
        recipes = [group.best.recipe for group in selection.groups]
        beside = fresh.with_effects(recipes, like=selection.model, steps=0)
        beside.problem.settle_noise(beside.fit.coefficients)
        # the noise is that of the channels, which both share
        problem.fluxes, problem.flickering = beside.problem.fluxes, beside.problem.flickering
        nominal = base = Model(problem, problem.fit(base.fit.coefficients), base.added)
        selection = chosen(base)
    return (nominal, base), selection, single


def _beside_causes(answer, say):
    """Return the frames that stand out once the cause is in the model that hid them."""
    (_, base), selection, _ = answer
    if selection.unlisted < _DOUBTFUL or not selection.groups:
        return []
    say("looking for frames that are not what the table says beside a cause")
    models = beside_one(base, selection)
    return next((found for one in models if (found := suspect_frames(one))), [])


def _share_of(effect, nominal, base, selection, chosen, say):
    """Return the probability of an alternative with its causes, where causes alone may be true."""
    count = len(selection.groups)
    is_all = not count and selection.model.p_value > REMAINDER
    if is_all or (count > _FEW and effect.left < _LITTLE):
        return 1.0
    say("looking for causes in place of the alternative")
    # fitted to the same frames, and with the same noise
    problem = GapProblem(nominal.chains, base.observations, like=base.problem)
    other = Model(problem, problem.fit(nominal.fit.coefficients), {})
    # more causes than the alternative is one of are less probable
    other = chosen(other, most=1 + count)
    temper = max(1.0, min(one.model.mean_square for one in (selection, other)))

    def evidence(one):
        costs = one.model.costs(temper)
        cost = sum(ENOUGH + costs.get(group.best.name, 0.0) for group in one.groups)
        unlisted = np.log(max(1 - one.unlisted, _LEAST))
        return unlisted - cost - 0.5 * one.model.fit.chi2 / temper

    return float(expit(evidence(selection) - ENOUGH - evidence(other)))


def _nested(base, smooth, say, cells):
    """Return the errors on frames of groups that took no part in the choice of the causes."""
    labels, numbers = groups = frame_groups(base.observations)
    found = []
    for k, label in enumerate(labels):
        say(f"without {label}, {k + 1} of {len(labels)}")
        seen = [number == k for number in numbers]
        kept = [
            o.with_mask(here, f"left out: {label}")
            for o, here in zip(base.observations, seen, strict=True)
        ]
        fold = Model(GapProblem(base.chains, kept), base.fit, base.added)
        fold.problem.settle_noise(fold.problem.start)
        fold = Model(fold.problem, fold.problem.fit(base.fit.coefficients), base.added)
        # as the whole was chosen: other groups may contradict a cause
        chosen = select(fold, smooth, groups, lambda line: None, cells=cells)
        recipes = [group.best.recipe for group in chosen.groups]
        whole = base.with_effects(recipes, like=chosen.model, steps=0)
        start = chosen.model.start_of(whole.problem)
        found.append(whole.problem.differences(start.coefficients))
    return HeldOut.of_predictions(base.problem, groups, found)


def _library(effects):
    if isinstance(effects, str) and effects == "all":
        return [*EFFECTS.values(), *OF_RUNS]
    names = [effects] if isinstance(effects, str) else list(effects)
    if not names:
        raise GapError("no effects to ask for; give names, or 'all'")
    return [get_effect(name) for name in names]


def check_instruments(calibration, observations):
    """Raise GapError if a calibration, or chains, and datasets are not of one instrument."""
    stated = {getattr(one, "instrument", None) for one in (calibration, *observations)} - {None}
    if len({getattr(known_instrument(name), "name", name).lower() for name in stated}) > 1:
        raise GapError(f"model or datasets are of different instruments: {listed(sorted(stated))}")


# ---- conclusion --------------------------------------------------------------------------------


def _conclude(nominal, base, exchanged, selection, frames):
    improved = selection.model.modest()
    # a gap below the noise must not give shares of more than 1
    total = max(nominal.excess, nominal.fit.chi2 - improved.fit.chi2, 1e-300)
    causes = [_exchanged(nominal, base, improved, exchanged, total)] if exchanged else []
    errors = [None] * len(selection.groups) if None in selection.history else selection.history
    for i, group in enumerate(selection.groups):
        causes.append(_cause(group, improved, group.lowered / total, *errors[i : i + 2]))
    verdict = _verdict(causes, nominal, improved.p_value, selection.courses)
    models = {"nominal": nominal, "gap_p_value": nominal.p_value}
    models |= {"improved": improved, "remainder_p_value": improved.p_value}
    told = [errors for errors in selection.history if errors is not None]
    found = Diagnosis(verdict, causes=causes, scan=selection.scan, held_out=told, **models)
    found.frames, found.courses = frames, selection.courses
    found.settings["unlisted"] = selection.unlisted
    return found


def _exchanged(nominal, base, improved, exchanged, total):
    """Return the cause that an alternative is, as sure as all causes explain the gap.

    It is no surer than it explains the double differences alone: others may be in its place.
    """
    effect, *others = exchanged
    sure = _SURE_SIGN * (1 - min(max(improved.excess / total, effect.left, 0.0), 1.0))
    aliases = [(Candidate(other, None, 0.0, 1, 0.0), 1 / len(exchanged)) for other in others]
    share = (nominal.fit.chi2 - base.fit.chi2) / total
    return Cause(effect, None, float(sure), aliases, 1 / len(exchanged), 0.0, float(share))


def _cause(group, improved, explained, before=None, after=None):
    (best, share), *aliases = group.members
    told = {key: getattr(best, key) for key in ("effect", "cell", "p_value", "evidence")}
    told |= {key: getattr(group, key) for key in ("probability", "stability", "by_dataset")}
    told |= {"aliases": aliases, "share": share, "before": before, "after": after}
    if best.name in improved.added:
        possible = improved.is_physical(best.name)
        told["physical"] = possible and improved.keeps_polarization(best.name)
    return Cause(**told, explained=float(explained))


def _verdict(causes, nominal, left_p, courses):
    """Return what can be said of the gap."""
    if not causes:
        # noise that the residuals themselves told cannot be exceeded by them
        known = all(channel.stated for channel in nominal.problem.channels)
        return "unexplained" if known and (left_p < REMAINDER or courses) else "none"
    sure = min(cause.probability for cause in causes)
    if sure >= _SURE and all(cause.is_named for cause in causes):
        return "named"
    return "located" if sure >= _LIKELY else "unexplained"
