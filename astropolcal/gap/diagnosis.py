# Licensed under a 3-clause BSD style license - see LICENSE
"""
Diagnosis of the gap between a model and an instrument.

`diagnose` fits the nominal model, measures the gap, asks the library of effects
which of them the data miss, checks the answer on frames that were left out, and
says what stays unexplained.
"""

import time
from dataclasses import dataclass, field

import numpy as np

from astropolcal.exceptions import GapError
from astropolcal.gap.alternatives import starting_model
from astropolcal.gap.attribution import ALPHA, scan
from astropolcal.gap.effects import EFFECTS, adapted, get_effect
from astropolcal.gap.model import Model
from astropolcal.gap.selection import REMAINDER, select
from astropolcal.gap.shrinkage import frame_groups

__all__ = ["Cause", "Diagnosis", "diagnose"]

# effects that explain less of the gap than this share, and leave no noise, are stand-ins for
# what the library does not hold
_EXPLAINED = 0.8


@dataclass
class Cause:
    """
    One effect that the model lacked, with what cannot be told from it.

    Parameters
    ----------
    effect : Effect
        The effect.
    aliases : list of str
        Effects that explain the data nearly as well.
    p_value : float
        Of the scan, corrected for the number of effects.
    explained : float
        Share of the gap (excess of chi-square over the noise) that it explains.
    before, after : HeldOut or None
        Prediction errors on left-out frames without and with it.
    physical : bool
        Whether its fitted size is a possible one.
    evidence : float
        Lowering of chi-square over the remaining scatter, less the cost of the parameters.

    Examples
    --------
    >>> from astropolcal.gap import Cause
    >>> from astropolcal.gap.effects import get_effect
    >>> Cause(get_effect("beam_gain"), [], 1e-9, 0.9).name
    'beam_gain'
    """

    effect: object
    aliases: list
    p_value: float
    explained: float
    before: object = None
    after: object = None
    physical: bool = True
    evidence: float = 0.0

    @property
    def name(self):
        """Name of the effect."""
        return self.effect.name


@dataclass
class Diagnosis:
    """
    What `diagnose` found.

    Parameters
    ----------
    verdict : {"effect", "none", "unexplained"}
        Whether an effect of the library explains the gap, there is none, or it
        is real and stays unexplained.
    nominal, improved : Model
        The model before, and with all causes in it.
    causes : list of Cause
        Largest first.
    scores : list of Score
        The scan at the nominal model.
    held_out : list of HeldOut
        Prediction errors before and after.
    gap_p_value : float
        Probability of the nominal residuals by noise alone.
    remainder_p_value : float
        The same for the improved model.
    seconds : float
        Time spent.

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
    scores: list
    held_out: list
    gap_p_value: float
    remainder_p_value: float
    seconds: float = 0.0
    settings: dict = field(default_factory=dict)

    @property
    def noise_floor_percent(self):
        """Noise of a normalized single difference, root mean square, in percent."""
        parts = [c.sigma[0][c.valid] for c in self.nominal.problem.channels]
        return 100 * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

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


def _gap_of_fit(model):
    """Return the root mean square of the differences' residuals, in percent."""
    gaps = model.problem.differences(model.fit.coefficients)
    parts = [g[0][c.valid] for g, c in zip(gaps, model.problem.channels, strict=True)]
    return 100 * float(np.sqrt(np.mean(np.square(np.concatenate(parts)))))


def diagnose(
    calibration, observations, *, effects="all", alpha=ALPHA, cross_validate=True, progress=None
):
    """
    Diagnose the gap between a model and measurements.

    Parameters
    ----------
    calibration : Calibration, `~astropy.modeling.CompoundModel` or sequence of them
        The nominal model: a calibration, or the chain of each dataset, which is
        then calibrated.
    observations : Observations or sequence of Observations
        The datasets, used together.
    effects : "all" or sequence of str or Effect
        The library to ask.
    alpha : float
        False discovery rate.
    cross_validate : bool
        Whether to check on left-out frames; without it the gaps are those of
        the fit itself.
    progress : callable, optional
        Called with a line on what is done next.

    Returns
    -------
    Diagnosis

    Raises
    ------
    GapError
        If the nominal fit does not converge, there are too few groups of frames
        to leave out, or an effect is unknown.

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
    observations = list(observations) if isinstance(observations, (list, tuple)) else [observations]
    library = _library(effects)
    groups = frame_groups(observations) if cross_validate else None
    _check_instruments(observations)
    say("fitting the nominal model")
    nominal, causes = starting_model(calibration, observations, library, say)
    base = causes[-1].model if causes else nominal
    say("scanning the effects")
    # what has a place depends on the alternative that was taken
    library = adapted(library, base.chains)
    # the alternatives were tried already, from the start: a scan of derivatives cannot see them
    smooth = [effect for effect in library if effect.kind != "discrete"]
    scores = scan(base, smooth)
    selected, improved, history = select(base, scores, smooth, alpha, groups, say)
    return _conclude(nominal, improved, causes, selected, scores, history, alpha, started)


def _library(effects):
    if isinstance(effects, str) and effects == "all":
        return list(EFFECTS.values())
    names = [effects] if isinstance(effects, str) else list(effects)
    if not names:
        raise GapError("no effects to ask for; give names, or 'all'")
    return [get_effect(name) for name in names]


def _check_instruments(observations):
    named = {o.instrument for o in observations if o.instrument is not None}
    if len({name.lower() for name in named}) > 1:
        raise GapError(f"the datasets are of different instruments: {', '.join(sorted(named))}")


# ---- conclusion --------------------------------------------------------------------------------


def _conclude(nominal, improved, causes, selected, scores, history, alpha, started):
    chosen = [*causes, *selected]
    total = nominal.fit.chi2 - (nominal.problem.n_data - nominal.problem.size)
    # shares are of the excess over the noise; a gap below it must not give more than 1
    total = max(total, nominal.fit.chi2 - improved.fit.chi2, 1e-300)
    before, found = nominal, []
    errors = [None] * len(causes) + history[1:]
    previous = [None] * len(causes) + history[:-1]
    for candidate, after, earlier in zip(chosen, errors, previous, strict=True):
        share = (before.fit.chi2 - candidate.model.fit.chi2) / total
        found.append(
            Cause(
                effect=candidate.score.effect,
                aliases=[alias.name for alias in candidate.aliases],
                p_value=candidate.score.p_value,
                explained=float(share),
                before=earlier,
                after=after,
                # what was possible when it was chosen need not be so next to the others
                physical=candidate.physical and improved.is_physical(candidate.name),
                evidence=float(candidate.evidence),
            )
        )
        before = candidate.model
    gap_p, left_p = nominal.p_value, improved.p_value
    explained = sum(cause.explained for cause in found)
    if found and (explained > _EXPLAINED or left_p > REMAINDER):
        verdict = "effect"
    else:
        verdict = "unexplained" if left_p < REMAINDER else "none"
    return Diagnosis(
        verdict=verdict,
        nominal=nominal,
        improved=improved,
        causes=found,
        scores=scores,
        held_out=[h for h in history if h is not None],
        gap_p_value=gap_p,
        remainder_p_value=left_p,
        seconds=time.perf_counter() - started,
        settings={"alpha": alpha},
    )
