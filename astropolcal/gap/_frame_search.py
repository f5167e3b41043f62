# Licensed under a 3-clause BSD style license - see LICENSE
"""Accusing frames, the worst first, until what is left is noise or frames are not at fault."""

import copy

import numpy as np
from scipy import stats

from astropolcal.gap._frame_looks import Look, kept_rows
from astropolcal.gap._noise import noise, settings
from astropolcal.gap.model import Model, nominal_calibration
from astropolcal.gap.problem import GapProblem

__all__ = ["Search", "usual"]

# chance of a false accusation in a run, and the share of the frames that may be accused
_ALPHA = 1e-3
_MOST, _LEAST_MOST = 0.05, 2
# a fit is down to the noise at this chance; else so much of the excess has to be gone, and the
# accused have to stand so far above the others
_NOISE, _GONE, _APART = 1e-3, 0.8, 10.0
# of very many frames several are taken at once, those nearly as bad as the worst
_AT_ONCE, _NEARLY = 12, 0.5
# as bad frames are found, so little of the excess is left that the noise is measured anew
_NEARLY_GONE = 0.1
_STEPS, _SHARE = 20, 1e-5


class Search:
    """
    A search for frames that stand out.

    Parameters
    ----------
    model : Model
        The fitted model. Once frames are accused, it is replaced by one with the noise as the
        others tell it.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap._frame_search import Search
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> Search(model).accused()[0]
    []
    """

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

        Returns
        -------
        places : list of tuple of int
            Index of the dataset and of the frame, in the order of accusation; empty if none
            stands out, or too many.
        look : Look
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
        rows = kept_rows(self.problem, out)
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
        problem = GapProblem(
            chains,
            self.model.observations,
            ties=old.ties,
            laws=old.laws,
            priors=old.priors,
            neutral=old.neutral,
            limits=old.limits,
        )
        q = problem.start if look.chance < _NOISE else look.coefficients
        for channel, dataset, residual, without in zip(
            problem.channels, problem.datasets, problem.differences(q), out, strict=True
        ):
            angles = {stage: angle[0] for stage, angle in dataset.positions.items()}
            sigma = _noise_of_others(channel, residual, angles, without)
            channel.set_noise(sigma, residual, settings(angles, dataset.observations.n_frames))
        self.model, self.problem = Model(problem, self.model.fit), problem

    def _is_hopeless(self, look, n):
        """Return whether so little went with the frames left out that no few of them will do."""
        excess = [one.chi2 - one.freedom for one in (self.first, look)]
        gone = 1 - excess[1] / excess[0] if excess[0] > 0 else 1.0
        return look.chance < _NOISE and n > 2 and gone < 0.5 * n / self.most

    def is_settled(self, places, look):
        """
        Return whether what was wrong is gone without some frames.

        Parameters
        ----------
        places : list of tuple of int
            The frames that are guilty.
        look : Look
            As `accused` gave it.

        Returns
        -------
        bool
        """
        if not places or len(places) > self.most:
            return False
        if _marked_places(look) != set(places):
            look = self._look(places, look.coefficients)
        if look.chance > _NOISE:
            return True
        excess = [one.chi2 / one.freedom - 1 for one in (self.first, look)]
        if excess[1] > (1 - _GONE) * excess[0]:
            return False
        falls = [look.deleted(i)[0] for i in range(len(look.out))]
        left = max(np.max(fall, where=look.kept(i), initial=0.0) for i, fall in enumerate(falls))
        return all(falls[i][f] > _APART * left for i, f in places)


def _marked_places(look):
    return {(i, int(f)) for i, out in enumerate(look.out) for f in np.flatnonzero(out)}


def _noise_of_others(channel, residual, angles, without):
    """Return the noise of every datum, as it is where some frames take no part."""
    others = copy.copy(channel)
    others.valid = channel.valid & ~without
    sigma, stated = noise(others, residual, angles), np.sqrt(channel.variance)
    for own, told in zip(sigma, stated, strict=True):
        known = others.valid & np.isfinite(told) & (told > 0)
        if known.any():
            wanted = without & channel.valid & np.isfinite(told) & (told > 0)
            own[wanted] = told[wanted] * np.median(own[known] / told[known])
    return sigma


def _marked(problem, places):
    """Return which frames are among some places, one array a dataset."""
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
    """
    Return how much larger than noise a statistic is in most frames, at least 1.

    Parameters
    ----------
    fall, freedom : `~numpy.ndarray`
        The statistic and its degrees of freedom, (F,).
    keep : `~numpy.ndarray` of bool
        Frames that count.

    Returns
    -------
    float

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap._frame_search import usual
    >>> round(usual(np.full(5, 4.55), np.ones(5), np.ones(5, dtype=bool)), 1)
    10.0
    """
    if not keep.any():
        return 1.0
    usual = stats.chi2.median(np.maximum(np.median(freedom[keep]), 1))
    return float(max(np.median(fall[keep]) / usual, 1.0))
