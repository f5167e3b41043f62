# Licensed under a 3-clause BSD style license - see LICENSE
"""
Which effect causes the gap: scan of the library, alias groups, forward selection.

Every effect is scored at the fitted model: the squared length of the whitened
residual's projection on what the effect adds to the model's tangent space is
chi-square with its rank where the effect is absent (Rao 1948; the Lagrange
multiplier test). The best few are fitted in full. What fits nearly as well as
the best cannot be told from it and forms its alias group. An effect stays if
frames left out of the fit are predicted better with it.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from astropolcal.calibration._directions import ranked
from astropolcal.gap.model import effect_tangent

__all__ = [
    "Candidate",
    "Score",
    "best_of",
    "choose",
    "contenders",
    "false_discovery",
    "freed",
    "scan",
]

#: False discovery rate of the scan.
ALPHA = 0.01
#: The best candidates that are fitted in full.
MOST_REFITTED = 8
#: An effect fits nearly as well as another if it is this close in evidence.
SAME_EVIDENCE = 10.0
#: Fits of what gives the same data end with evidences that differ by less.
EQUAL_EVIDENCE = 0.1
_WORTH_A_REFIT = 0.4
# lowering of chi-square by a full fit that is none
_LEAST_GAIN = 1.0
# the first fits end after so many steps; those this close to the best are carried on
_FIRST_STEPS, _NEARLY = 12, 0.8


@dataclass
class Score:
    """
    Score of one effect.

    Parameters
    ----------
    effect : Effect
        The effect.
    statistic : float
        Expected lowering of chi-square.
    rank : int
        Number of directions that the effect adds.
    basis : `~numpy.ndarray`
        These directions, (n_rows, rank).
    scale : float
        Variance of the residuals around the model with the effect, at least 1.
    p_value : float
        Of the scan, corrected for the number of effects.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.attribution import Score
    >>> Score(None, 30.0, 2, np.zeros((3, 2)), 1.0).single_p < 1e-6
    True
    """

    effect: object
    statistic: float
    rank: int
    basis: np.ndarray
    scale: float
    p_value: float = 1.0

    @property
    def single_p(self):
        """Probability of the statistic by chance, for this effect alone."""
        return float(stats.chi2.sf(self.statistic / self.scale, self.rank))

    def evidence(self, n_data):
        """Return the statistic less what the parameters cost (Schwarz 1978)."""
        return self.statistic / self.scale - self.rank * np.log(n_data)


def scan(model, effects, *, residual=None, nominal=None, context=None):
    """
    Score all effects at a fitted model.

    Parameters
    ----------
    model : Model
        The fitted model.
    effects : sequence of Effect
        Effects to score; those that are in the model or have no place in its
        chains are left out, as are those that the model takes up entirely.
    residual, nominal : `~numpy.ndarray`, optional
        Whitened residual and tangent space, if known already.
    context : Context, optional
        By default that of the data.

    Returns
    -------
    list of Score
        Best first.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.attribution import scan
    >>> from astropolcal.gap.effects import EFFECTS
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> observations = simulate(charis.chain(), charis.wavelength, frames, seed=1)
    >>> model = nominal_model([charis.chain()], [observations])
    >>> scores = scan(model, [EFFECTS["beam_gain"], EFFECTS["hwp_diattenuation"]])
    >>> all(score.p_value > 0.001 for score in scores)
    True
    """
    nominal = model.problem.tangent(model.fit.coefficients) if nominal is None else nominal
    residual = model.residual if residual is None else residual
    # where the fit has not quite arrived the rest of the step is no effect
    residual = residual - nominal @ (nominal.T @ residual)
    total, freedom = residual @ residual, model.degrees_of_freedom(nominal)
    context, chains, scores = context or model.context, model.chains, []
    for effect in effects:
        if effect.name in model.added or effect.absorbed_by or not effect.applies(chains):
            continue
        basis = effect_tangent(model, effect, nominal, context)
        rank = basis.shape[1]
        if rank:
            statistic = float(np.sum((basis.T @ residual) ** 2))
            # among structure everything is significant: it is measured by what it leaves
            scale = max(1.0, (total - statistic) / max(freedom - rank, 1))
            scores.append(Score(effect, statistic, rank, basis, scale))
    for score, p in zip(scores, false_discovery([s.single_p for s in scores]), strict=True):
        score.p_value = p
    return [scores[i] for i in ranked([s.evidence(freedom) for s in scores], EQUAL_EVIDENCE)]


def false_discovery(p_values):
    """
    Return p-values corrected for the number of looks.

    Parameters
    ----------
    p_values : sequence of float
        One a test.

    Returns
    -------
    list of float
        The smallest false discovery rate at which each is called; Benjamini &
        Yekutieli (2001, doi:10.1214/aos/1013699998), which allows for any
        dependence.

    Examples
    --------
    >>> from astropolcal.gap.attribution import false_discovery
    >>> [round(p, 4) for p in false_discovery([0.001, 0.5])]
    [0.003, 0.75]
    """
    if not len(p_values):
        return []
    return [float(p) for p in stats.false_discovery_control(p_values, method="by")]


@dataclass
class Candidate:
    """
    An effect that was fitted in full, with those that cannot be told from it.

    Parameters
    ----------
    score : Score
        Its score.
    model : Model
        The model with the effect.
    gain : float
        Lowering of chi-square by the full fit, over the remaining scatter.
    evidence : float
        The same, less what the parameters cost.
    physical : bool
        Whether the fitted sizes are within the effect's limits.
    aliases : list of Candidate
        Those that fit nearly as well.
    context : Context, optional
        With which it was added, None for that of the data.

    Examples
    --------
    >>> from astropolcal.gap.attribution import Candidate
    >>> Candidate(None, None, 30.0, 12.0, True).aliases
    []
    """

    score: Score
    model: object
    gain: float
    evidence: float
    physical: bool
    aliases: list = field(default_factory=list)
    context: object = None

    @property
    def name(self):
        """Name of the effect."""
        return self.score.effect.name

    @property
    def recipe(self):
        """Effect and context, as `Model.with_effects` takes them."""
        return self.score.effect, self.context


def choose(model, scores, **limits):
    """
    Fit the best effects in full, and return the best with its alias group.

    Parameters
    ----------
    model, scores, **limits
        As `contenders` takes them.

    Returns
    -------
    Candidate or None
        None if no effect is significant.

    Examples
    --------
    >>> from astropolcal.gap.attribution import choose
    >>> choose(None, []) is None
    True
    """
    return best_of(contenders(model, scores, **limits))


def best_of(fitted):
    """
    Return the best of fitted effects with its alias group.

    Parameters
    ----------
    fitted : list of Candidate
        As `contenders` gives them.

    Returns
    -------
    Candidate or None
        None if there is none.

    Examples
    --------
    >>> from astropolcal.gap.attribution import best_of
    >>> best_of([]) is None
    True
    """
    if not fitted:
        return None
    top = fitted[0]
    top.aliases = [
        c for c in fitted[1:] if c.physical and top.evidence - c.evidence < SAME_EVIDENCE
    ]
    return top


def contenders(model, scores, *, alpha=ALPHA, most=MOST_REFITTED):
    """
    Fit the best effects in full.

    Parameters
    ----------
    model : Model
        The model so far.
    scores : list of Score
        As `scan` gives them.
    alpha : float
        False discovery rate.
    most : int
        So many are fitted in full.

    Returns
    -------
    list of Candidate
        Best first; those of physical size before the others.

    Examples
    --------
    >>> from astropolcal.gap.attribution import contenders
    >>> contenders(None, [])
    []
    """
    significant = [s for s in scores if s.p_value < alpha]
    if not significant:
        return []
    freedom = model.problem.n_data - model.problem.size
    best = max(s.evidence(freedom) for s in significant)
    # the scan is linear, a full fit may change the order: those not far behind are fitted too
    worth = [s for s in significant if s.evidence(freedom) > min(_WORTH_A_REFIT * best, best - 20)][
        :most
    ]
    fitted = [_fitted(model, score, freedom) for score in worth]
    # an effect that data ask for beyond a bound of its optic, where it is absent, does nothing
    fitted = [c for c in fitted if c.gain > _LEAST_GAIN]
    if not fitted:
        return []
    best = max(c.evidence for c in fitted)
    fitted = [
        _polished(model, c, freedom) if c.evidence > min(_NEARLY * best, best - 20) else c
        for c in fitted
    ]
    # what is out of its physical limits is no explanation while another one is left
    top = _best_first(fitted)[0]
    # all are measured by the scatter that the best one leaves
    scale = max(1.0, top.model.fit.chi2 / max(freedom, 1))
    for one in fitted:
        one.gain = (model.fit.chi2 - one.model.fit.chi2) / scale
        one.evidence = one.gain - one.score.rank * np.log(freedom)
    return _best_first(fitted)


def _best_first(fitted):
    # what fits equally well stays in the order of the library
    fitted = [fitted[i] for i in ranked([c.evidence for c in fitted], EQUAL_EVIDENCE)]
    return sorted(fitted, key=lambda c: not c.physical)


def _fitted(model, score, freedom):
    return _candidate(model, score, model.with_effect(score.effect, steps=_FIRST_STEPS), freedom)


def _polished(model, candidate, freedom):
    if candidate.model.fit.converged:
        return candidate
    return _candidate(model, candidate.score, candidate.model.polished(), freedom)


def _candidate(model, score, fresh, freedom):
    physical = fresh.is_physical(score.effect.name)
    gain = model.fit.chi2 - fresh.fit.chi2
    scale = max(1.0, fresh.fit.chi2 / max(freedom, 1))
    return Candidate(score, fresh, gain, gain / scale - score.rank * np.log(freedom), physical)


def freed(model, candidate):
    """
    Give an effect one value a wavelength where the data ask for it.

    Parameters
    ----------
    model : Model
        The model without the effect.
    candidate : Candidate
        The effect with its stiff law.

    Returns
    -------
    Candidate
        The same where the stiff law is enough.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.attribution import choose, freed, scan
    >>> from astropolcal.gap.effects import EFFECTS
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.optics import BeamGain
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> truth = charis.chain() | BeamGain(imbalance=0.01, name="flat")
    >>> observations = simulate(truth, charis.wavelength, frames, seed=1)
    >>> model = nominal_model([charis.chain()], [observations])
    >>> candidate = choose(model, scan(model, [EFFECTS["beam_gain"]]))
    >>> freed(model, candidate) is candidate
    True
    """
    stiff, context = candidate.model, replace(model.context, degree=None)
    names = [parameter.name for parameter in stiff.added[candidate.name]]
    known = [stiff.problem.slices[name] for name in names]
    before = sum(where.stop - where.start for where in known)
    loose = model.with_effect(candidate.score.effect, context)
    after = sum(
        where.stop - where.start for where in (loose.problem.slices[name] for name in names)
    )
    freedom = max(model.problem.n_data - loose.problem.size, 1)
    scale = max(1.0, loose.fit.chi2 / freedom)
    gain = (stiff.fit.chi2 - loose.fit.chi2) / scale
    if after == before or gain < (after - before) * np.log(freedom):
        return candidate
    if not loose.is_physical(candidate.name):
        return candidate
    lowered = (model.fit.chi2 - loose.fit.chi2) / scale
    evidence = lowered - (candidate.score.rank + after - before) * np.log(freedom)
    return Candidate(candidate.score, loose, lowered, evidence, True, candidate.aliases, context)
