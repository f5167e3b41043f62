# Licensed under a 3-clause BSD style license - see LICENSE
r"""
One perturbation of any course through the run, in place of the causes that were found.

The table of dependences is a list, and nature does not read it. So at each place and for each kind
the perturbation gets another size in every frame: :math:`c_f l(\lambda)`, a course c and a smooth
law l in wavelength, beside all that model and lamp absorb. Each of the two is fitted while the
other is held, in turn (alternating least squares). Where one such course explains the data as well
as several causes do together, these may be one thing that no table has. A course that has one size
for each angle of a stage has much less freedom, and less evidence distinguishes it from a cause
that follows the stage.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag, eigh
from scipy.special import chdtri

from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.gap.attribution import ENOUGH
from astropolcal.gap.cells import Cell, Probes, Reduced, own_name
from astropolcal.gap.problem import law_basis
from astropolcal.observations.grid import clusters
from astropolcal.observations.pointings import frame_names

__all__ = []

# degree of the law in wavelength, and of what follows a stage
_DEGREE, _SMOOTH = 4, 2
# rounds for every place and kind, and for so many of the best
_ROUNDS, _MORE, _BEST = 1, 5, 6
# what lowers chi-square by less than this share more is the same
_SAME = 1e-4
# what explains this share of a course may be its shape, the simplest of those as near as that; a
# law is where it has more than a part of its largest value
_NEARLY, _AS_MUCH, _PART = 0.9, 0.05, 0.5
_TWO_SIGMA = 4.0
# so many standard deviations more than expected noise may gain, and with this probability the best
# of all courses that follow a stage
_LUCK, _BEST_BY_CHANCE = 2.0, 0.05
# by this share of what causes explain the model without them may be off, to first order
_LINEAR = 0.1
# a direction of which model and lamp leave less than this is theirs
_ABSORBED = 1e-6


@dataclass
class Course:
    """A perturbation with a size of its own in every frame; place and kind are as in `Cell`."""

    place: str
    kind: str
    #: Sums over the wavelengths of its derivatives, during the fit.
    reduced: Reduced | None
    #: The law in wavelength, (W,), which is 1 where it is largest; coefficients during the fit.
    law: np.ndarray
    #: The course in each dataset, (F,), radian or shares, and its errors, without what model and
    #: lamp absorb; zero and infinite in frames that do not tell it.
    wave: list = field(default_factory=list)
    std: list = field(default_factory=list)
    #: Which frames tell it, and its whitened normal equations there.
    equations: tuple = ()
    #: By how much it lowers chi-square, and by how many directions.
    lowered: float = 0.0
    freedom: int = 0
    #: By how much more than the causes that were found it lowers chi-square, beyond what its larger
    #: freedom may gain from noise; by how much less, in standard deviations of that.
    gained: float = -np.inf
    behind: float = np.inf
    #: In which frames and wavelengths it is, in words; empty where it is everywhere.
    shape: str = ""
    #: Probability that noise alone lowers chi-square so much, for this place and kind alone.
    p_value: float = 1.0
    #: The stage of which it is a function, and the number of its angle in every frame of each
    #: dataset, (F,); empty where each frame has a size of its own.
    stage: str = ""
    settings: tuple = ()

    @property
    def words(self):
        """What it is, in words."""
        what = Cell(self.place, self.kind, "constant").title
        return f"{what}, with a course through the run that no table has"

    def find_shape(self, model):
        """Find in which frames and wavelengths it is."""
        size, nm = np.abs(self.law), np.round(1000 * model.problem.wavelength).astype(int)
        there = np.flatnonzero(size > _PART * size.max())
        few = bool(len(there) == np.ptp(there) + 1 <= len(size) / 2)
        sharp = few and bool(np.sum(size[there] ** 2) > _NEARLY * np.sum(size**2))
        ends = dict.fromkeys(nm[[there[0], there[-1]]])
        follows = f"one size at each angle of the {own_name(self.stage)}" * bool(self.stage)
        when = follows or self._when(model.observations)
        found = [when, f"at {'-'.join(map(str, ends))} nm" * sharp]
        self.shape = ", ".join(filter(None, found))

    def _when(self, observations):
        names = [name for o in observations for name in frame_names(o.frames)]
        sizes = [o.n_frames for o in observations]
        run = np.repeat(np.arange(len(sizes)), sizes)
        of = [f' of "{o.name}"' * (len(sizes) > 1) for o in observations]
        # from each frame on to the end of its dataset
        steps = np.tril(run[:, None] == run).astype(float)
        one, both = (_best(gained) for gained in self._of_steps(steps))
        (k,), (i, j) = one[1:], sorted(both[1:])
        word = f"from {one[0]}frame {names[k]}{of[run[k]]} on"
        if not k or run[k - 1] != run[k]:
            # all of a single run is no shape
            word = f'in "{observations[run[k]].name}"' * (len(sizes) > 1)
        known = [(word, steps[:, [k]])]
        ends = [f"{names[i]}{of[run[i]]}", f"{names[j]}{of[run[j]]}"]
        if run[i] == run[j]:
            # between two steps of one dataset, and not before and after
            frames = list(dict.fromkeys((names[i], names[j - 1])))
            word = f"in {both[0]}frame{'s' * (len(frames) > 1)} {'-'.join(frames)}{of[run[i]]}"
            known.append((word, steps[:, [i]] - steps[:, [j]]))
            ends[0] = names[i]
        known.append((f"with steps at {both[0]}frames {' and '.join(ends)}", steps[:, [i, j]]))
        known += [
            self._of_period(end - n, n, of[r])
            for r, (end, n) in enumerate(zip(np.cumsum(sizes), sizes, strict=True))
        ]
        shares = [self._share(waves) for _, waves in known]
        least = max(_NEARLY, max(shares) - _AS_MUCH)
        return next((w for (w, _), one in zip(known, shares, strict=True) if one >= least), "")

    def _of_steps(self, steps):
        """Return by how much each step, and each two of them, lower chi-square."""
        gram, target = self._normal(steps)
        own = np.diagonal(gram)
        is_open = own > _ABSORBED * max(own.max(), 1e-300)
        one = np.where(is_open, target**2 / np.where(is_open, own, 1.0), 0.0)
        det = np.multiply.outer(own, own) - gram**2
        is_open = det > _ABSORBED * np.multiply.outer(own, own)
        both = np.multiply.outer(target**2, own)
        both = both + both.T - 2 * np.multiply.outer(target, target) * gram
        return one, np.triu(np.where(is_open, both / np.where(is_open, det, 1.0), 0.0))

    def _of_period(self, start, size, of):
        """Return the period, in words, that explains most of one dataset, and its waves (F, 2)."""

        def waves(rate):
            found, phase = np.zeros((len(self.equations[0]), 2)), 2 * np.pi * rate * np.arange(size)
            found[start : start + size] = np.stack([np.cos(phase), np.sin(phase)], axis=1)
            return found

        rates = np.linspace(min(1.5 / size, 1 / 3), 1 / 3, max(4 * size // 3, 1))
        best = max(rates, key=lambda rate: self._share(waves(rate)))
        return f"with a period of about {1 / best:.0f} frames{of}", waves(best)

    def _normal(self, courses):
        """Return the normal equations of courses (F, n), less what model and lamp absorb."""
        told, root, seen, target = self.equations
        columns = courses[told] * root[:, None]
        taken = seen.T @ columns
        return columns.T @ columns - taken.T @ taken, columns.T @ target

    def _share(self, courses):
        """Return the share of what the course explains that one along columns (F, n) explains."""
        gram, target = self._normal(courses)
        gained = target @ np.linalg.lstsq(gram, target, rcond=_ABSORBED)[0] - len(target)
        return gained / max(self.lowered - self.freedom, 1.0)

    def is_constant(self, temper):
        """Return whether one size for all frames, with a law as free, does as well (95 %)."""
        ones = [np.ones((1, 1, len(wave))) for wave in self.wave]
        (gram,), (target,) = self.reduced.normal(ones)
        more = self.lowered - target @ np.linalg.lstsq(gram, target)[0]
        freer = max(self.freedom - len(target), 1.0)
        return more / temper <= freer + self.chosen + 2 * np.sqrt(2 * freer)

    @property
    def chosen(self):
        """What the choice of the law gains from noise: of k singular values the largest counts."""
        k = len(self.reduced.target[0][0])
        return 2 * np.sqrt((k - 1) * max(self.freedom - k + 1, 0))

    def close(self, temper):
        """Give each frame its size, with errors for residuals of a variance, once it is fitted."""
        # large, and of no use any more
        self.reduced = None
        self.std = [np.sqrt(temper) * std for std in self.std]
        if self.stage:
            (wave,), (std,) = self.wave, self.std
            # frames at one angle tell its size together
            std = std * np.sqrt(np.bincount(np.concatenate(self.settings)))
            self.wave, self.std = ([x[own] for own in self.settings] for x in (wave, std))

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
        taken = taken[told] / root[:, None]
        self.equations = told, root, taken, target
        # (1 - t t^T)^-1 of what is left of each direction, nothing of what is taken up whole; the
        # directions are those of the frames or of what takes up, whichever are fewer
        few = len(taken) < taken.shape[1]
        strength, directions = np.linalg.eigh(taken @ taken.T if few else taken.T @ taken)
        is_open = 1 - strength > _ABSORBED
        factor = 1 / np.where(is_open, 1 - strength, -strength)
        basis = directions * np.sqrt(strength.clip(0)) if few else taken @ directions
        solved = target + basis @ (factor * (basis.T @ target))
        wave, variance = np.zeros(len(gram)), np.full(len(gram), np.inf)
        wave[told] = solved / root
        kept = 1 + basis**2 @ factor
        variance[told] = np.where(kept > _ABSORBED, kept, np.inf) / root**2
        edges = np.cumsum([len(g) for g in reduced.gram])[:-1]
        self.wave, self.std = np.split(wave, edges), np.split(np.sqrt(variance), edges)
        self.lowered = float(target @ solved)
        self.freedom = int(told.sum() - np.sum(~is_open)) + len(law) - 1


def _best(gained):
    """Return where a table is largest, after "about " where that is not the only place (95 %)."""
    count = np.sum(gained > gained.max() - _TWO_SIGMA)
    return "about " * bool(count > 1), *np.unravel_index(np.argmax(gained), gained.shape)


def courses(model, base):
    """Return the courses in place of all causes of a fitted model, the best first.

    ``base`` is the model without them. Derivatives are those at the model, and where its causes are
    so large that the base is not what they are to first order, also at the base, where a course may
    do better: many causes that are not the true ones are far from where it is. One that does no
    better than a constant is none.
    """
    names = [name for name in model.added if name not in base.added]
    without = model.without(names)
    found = [(one, without) for one in _fitted(model, names, without)]
    off = abs(without.chi2 - base.fit.chi2)
    if names and off > _LINEAR * (base.fit.chi2 - model.fit.chi2):
        found += [(one, base.linear) for one in _fitted(base, (), base.linear)]
    # measured by what the better of the two answers leaves, as alike as that is
    large = max(1.0, model.mean_square)
    temper = max(1.0, min([large, *(_left(without, one) for one, without in found)]))
    temper *= 1 + (model.alike - 1) * temper / large
    # one that does no better than a constant is none
    found = [(one, without) for one, without in found if not one.is_constant(temper)]
    looks = sum(bool(one.stage) for one, _ in found)
    for one, without in found:
        # to first order, as the courses are
        lost, freedom = without.chi2 - model.fit.chi2, without.freedom - model.linear.freedom
        freer = max(one.freedom - freedom, 1.0)
        # a law of one number is not chosen, but noise scatters as much, and a size for every datum
        # of a single wavelength takes it all
        scatter = np.sqrt(2 * freer)
        luck = max(one.chosen, _LUCK * scatter)
        if one.stage:
            luck = max(luck, chdtri(freer, _BEST_BY_CHANCE / looks) - freer)
        one.gained = float((one.lowered - lost) / temper - freer - luck)
        one.behind = float(-one.gained / scatter)
        one.p_value = float(chi2_above(one.lowered / temper - one.chosen, max(one.freedom, 1)))
        one.close(temper)
    best = {}
    for one, _ in sorted(found, key=lambda each: -each[0].gained):
        best.setdefault((one.place, one.kind, one.stage), one)
    return list(best.values())


def real_courses(model, base, least):
    """Return the courses that noise makes with less than a probability, of so many looks."""
    found = courses(model, base)
    return [one for one in found if one.p_value * len(found) < least]


def alike_courses(base, found):
    """Return the best courses, which the data do not tell apart; first simple ones of no stage."""
    near = [2 * np.sqrt(2 * max(one.freedom, found[0].freedom)) for one in found]
    best = {}
    for one, noise in zip(found, near, strict=True):
        if one.gained > found[0].gained - noise:
            # the best of those of one place and kind
            best.setdefault((one.place, one.kind), one)
    for one in best.values():
        one.find_shape(base)
    return sorted(best.values(), key=lambda one: not one.shape or bool(one.stage))


def _left(without, course):
    """Return the mean square that a course leaves of a model to first order."""
    return (without.chi2 - course.lowered) / max(without.freedom - course.freedom, 1)


def _fitted(model, absent, without):
    """Return the courses at a fitted model of which some effects are taken out."""
    probes = Probes(model, absent)
    wavelength, found, follow = probes.problem.wavelength, [], []
    basis, smooth = (law_basis(wavelength, degree) for degree in (_DEGREE, _SMOOTH))
    settings, inside = _settings(probes), np.linalg.lstsq(basis, smooth)[0]
    slopes = probes.slopes | _of_one_beam(probes)
    for (place, kind), slope in slopes.items():
        reduced = Reduced(probes, slope, basis)
        found.append(Course(place, kind, reduced, _first_law(reduced)))
        found[-1].fit(_ROUNDS)
        for stage, numbers in settings.items():
            few = reduced.together(numbers).along(inside)
            one = Course(place, kind, few, _first_law(few), stage=stage, settings=numbers)
            one.fit(_MORE)
            follow.append(one)
    found = [one for one in found if one.lowered > 0]
    found.sort(key=lambda one: one.freedom - one.lowered)
    for i, one in enumerate(found[:_BEST]):
        one.fit(_MORE)
        if len(basis.T) < len(wavelength):
            # what is sharp in wavelength has no smooth law
            free = Reduced(probes, slopes[one.place, one.kind], np.eye(len(wavelength)))
            free = Course(one.place, one.kind, free, basis @ one.law, list(one.wave))
            free.fit(_MORE)
            left = max(_left(without, free), 1.0)
            gained = [o.lowered / left - o.freedom - o.chosen for o in (one, free)]
            if gained[1] > gained[0] + ENOUGH:
                found[i] = free
    found += [one for one in follow if one.lowered > 0]
    for one in found:
        law = one.law
        law = law if len(law) == len(wavelength) else (smooth if one.stage else basis) @ law
        largest = law[np.argmax(np.abs(law))]
        one.law = law / largest
        one.wave = [wave * largest for wave in one.wave]
        one.std = [std * abs(largest) for std in one.std]
    return found


def _first_law(reduced):
    """Return the law along which most frames are off, against their noise, of unit length."""
    target, gram = np.concatenate(reduced.target), np.concatenate(reduced.gram).sum(axis=0)
    noise = gram + _ABSORBED * (np.trace(gram) or 1.0) * np.eye(len(gram))
    law = eigh(target.T @ target, noise)[1][:, -1]
    return law / np.linalg.norm(law)


def _settings(probes):
    """Return, by stage, the number of its angle in every frame of each dataset, where few."""
    found = {}
    for name, waves in probes.waves.items():
        kind, _, rest = name.partition(":")
        stage, _, number = rest.partition(":")
        if (kind, number) == ("harmonic", "1"):
            cosine, sine = np.concatenate(waves, axis=1)
            count = 1 + (number := clusters(np.arctan2(sine, cosine), turn=2 * np.pi)).max()
            # three are a constant and a harmonic; both are zero in a dataset without the stage
            if 3 < count < len(number) / 2 and np.hypot(cosine, sine).all():
                found[stage] = np.split(number, np.cumsum([w.shape[1] for w in waves])[:-1])
    return found


def _of_one_beam(probes):
    """Return the derivatives to a gain of either beam alone, of which the sums of both tell."""
    problem, found = probes.problem, {}
    for i, slope in probes.slopes.get(("detector", "gain"), {}).items():
        channel = problem.channels[i]
        for sign, beam in ((1, "right"), (-1, "left")):
            both = np.stack([slope[0], slope[1] + sign * channel.valid]) / 2
            found.setdefault(("detector", f"gain_of_{beam}_beam"), {})[i] = both
    return found
