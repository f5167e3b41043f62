# Licensed under a 3-clause BSD style license - see LICENSE
r"""
One perturbation of any course through the run, in place of the causes that were found.

The table of dependences is a list, and nature does not read it. So at each place and for each kind
the perturbation gets another size in every frame: :math:`c_f l(\lambda)`, a course c and a smooth
law l in wavelength, beside all that model and lamp absorb. Each of the two is fitted while the
other is held, in turn (alternating least squares). Where one such course explains the data as well
as several causes do together, these may be one thing that no table has.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag, eigh

from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.gap.cells import Cell, Probes, Reduced
from astropolcal.gap.problem import law_basis

__all__ = []

# degree of the law in wavelength
_DEGREE = 4
# rounds for every place and kind, and for so many of the best
_ROUNDS, _MORE, _BEST = 1, 5, 6
# what lowers chi-square by less than this share more is the same
_SAME = 1e-4
# a direction of which model and lamp leave less than this is theirs
_ABSORBED = 1e-6


@dataclass
class Course:
    """
    A perturbation with a size of its own in every frame.

    Parameters
    ----------
    place, kind : str
        As in `Cell`.
    reduced : Reduced or None
        Sums over the wavelengths of its derivatives, during the fit.
    law : `~numpy.ndarray`
        The law in wavelength, (W,), which is 1 where it is largest; coefficients during the fit.
    wave, std : list of `~numpy.ndarray`
        The course in each dataset, (F,), radian or shares, and its errors, without what model and
        lamp absorb; zero and infinite in frames that do not tell it.
    lowered, freedom : float, int
        By how much it lowers chi-square, and by how many directions.
    gained, behind : float
        By how much more than the causes that were found it lowers chi-square, beyond what its
        larger freedom gains from noise; by how much less, in standard deviations of that.
    p_value : float
        Probability that noise alone lowers chi-square so much, for this place and kind alone.
    """

    place: str
    kind: str
    reduced: Reduced | None
    law: np.ndarray
    wave: list = field(default_factory=list)
    std: list = field(default_factory=list)
    lowered: float = 0.0
    freedom: int = 0
    gained: float = -np.inf
    behind: float = np.inf
    p_value: float = 1.0

    @property
    def words(self):
        """What it is, in words."""
        what = Cell(self.place, self.kind, "constant").title
        return f"{what}, with a course through the run that no table has"

    def fit(self, rounds):
        """Fit law and course in turn, until nothing is gained."""
        if not self.wave:
            self._fit_wave()
        for _ in range(rounds):
            (gram,), (target,) = self.reduced.normal([wave[None, None] for wave in self.wave])
            law, before = np.linalg.lstsq(gram, target)[0], self.lowered
            self.law = law / (np.linalg.norm(law) or 1.0)
            self._fit_wave()
            if self.lowered <= (1 + _SAME) * before:
                break

    def _fit_wave(self):
        reduced, law = self.reduced, self.law
        gram = np.concatenate([law @ (g @ law).T for g in reduced.gram])
        seen = np.concatenate([law @ part for part in reduced.seen])
        taken = np.hstack([seen, block_diag(*(law @ part for part in reduced.lamps))])
        told = gram > _ABSORBED * gram.max()
        root = np.sqrt(gram[told])
        target = np.concatenate([t @ law for t in reduced.target])[told] / root
        left, strength, _ = np.linalg.svd(taken[told] / root[:, None], full_matrices=False)
        # (1 - t t^T)^-1 of what is left of each direction, nothing of what is taken up whole
        rest = 1 - strength**2
        is_open = rest > _ABSORBED
        factor = np.where(is_open, 1 / np.where(is_open, rest, 1.0) - 1, -1.0)
        solved = target + left @ (factor * (left.T @ target))
        wave, variance = np.zeros(len(gram)), np.full(len(gram), np.inf)
        wave[told] = solved / root
        kept = 1 + left**2 @ factor
        variance[told] = np.where(kept > _ABSORBED, kept, np.inf) / root**2
        edges = np.cumsum([len(g) for g in reduced.gram])[:-1]
        self.wave, self.std = np.split(wave, edges), np.split(np.sqrt(variance), edges)
        self.lowered = float(target @ solved)
        self.freedom = int(told.sum() - np.sum(~is_open)) + len(law) - 1


def courses(model, base):
    """
    Return the courses in place of all causes of a fitted model, the best first.

    ``base`` is the model without them. Derivatives are those at the one or at the other, where a
    course does better: many causes that are not the true ones are far from where it is.
    """
    names = [name for name in model.added if name not in base.added]
    temper, best = model.alike * max(1.0, model.mean_square), {}
    for at, absent in ((model, names), (base, ())) if names else ((base, ()),):
        without = at.without(absent)
        # to first order, as the courses are
        lost, freedom = without.chi2 - model.fit.chi2, without.freedom - model.linear.freedom
        for one in _fitted(at, absent):
            freer = max(one.freedom - freedom, 1.0)
            one.gained = float((one.lowered - lost) / temper - freer)
            one.behind = float(-one.gained / np.sqrt(2 * freer))
            # the law is chosen: of k singular values the largest is more than a share of their sum
            k = len(one.reduced.target[0][0])
            gain = 2 * np.sqrt((k - 1) * max(one.freedom - k + 1, 0))
            one.p_value = float(chi2_above(one.lowered / temper - gain, max(one.freedom, 1)))
            one.std = [np.sqrt(temper) * std for std in one.std]
            known = best.setdefault((one.place, one.kind), one)
            best[one.place, one.kind] = max(known, one, key=lambda course: course.gained)
    for one in best.values():
        # large, and of no use once it is fitted
        one.reduced = None
    return sorted(best.values(), key=lambda one: -one.gained)


def _fitted(model, absent):
    """Return the courses at a fitted model of which some effects are taken out."""
    probes = Probes(model, absent)
    basis = law_basis(probes.problem.wavelength, _DEGREE)
    found = []
    for (place, kind), slopes in probes.slopes.items():
        reduced = Reduced(probes, slopes, basis)
        found.append(Course(place, kind, reduced, _first_law(reduced)))
        found[-1].fit(_ROUNDS)
    found = [one for one in found if one.lowered > 0]
    found.sort(key=lambda one: one.freedom - one.lowered)
    for one in found[:_BEST]:
        one.fit(_MORE)
    for one in found:
        law = basis @ one.law
        largest = law[np.argmax(np.abs(law))]
        one.law = law / largest
        one.wave = [wave * largest for wave in one.wave]
        one.std = [std * abs(largest) for std in one.std]
    return found


def _first_law(reduced):
    """Return the law along which most frames are off, against their noise."""
    target, gram = np.concatenate(reduced.target), np.concatenate(reduced.gram).sum(axis=0)
    noise = gram + _ABSORBED * (np.trace(gram) or 1.0) * np.eye(len(gram))
    law = eigh(target.T @ target, noise)[1][:, -1]
    return law / np.linalg.norm(law)
