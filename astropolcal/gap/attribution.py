# Licensed under a 3-clause BSD style license - see LICENSE
r"""
Evidence for every cause that a model may lack: cells and named effects.

The logarithm of the Bayes factor of a cause, beside all that the model can do already, has a
closed form where the data are linear in it. With the normal equations S x = b of what the cause
adds, sizes of standard deviation s, and eigenvalues l of S with the components p of b along their
vectors, it is half the sum of :math:`s^2 p^2/(1 + s^2 l) - \ln(1 + s^2 l)`: the first term is what
the cause explains, the second what its freedom costs. The size s is known within two orders of
magnitude only and is averaged over.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from astropolcal.calibration.validation.cross_validation import chi2_above
from astropolcal.gap.cells import Cell, Probes, Reduced, alike
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.problem import GapProblem, law_basis
from astropolcal.optics.perturbations import split_run

__all__ = []

# sizes of the prior, in units of the usual one: bright sources show what is far smaller
_SIZES = (0.01, 0.1, 1.0, 10.0)
# laws in wavelength of a cell: one number, or a smooth curve; for the best cells more freedom,
# None for one value per wavelength
_DEGREES, _FREER = (0, 2), (4, None)
# of so many cells a law that is free at each wavelength is asked for, where there is so many times
# as much evidence for it as for any smooth one
_SHARP, _SHARPER = 3, 2.0
# so many named effects stand in the same chain: each sees the light through all the others
_TOGETHER = 20
#: Log evidence that a cause needs: the prior odds against any cause, and the number of looks.
ENOUGH = 10.0
#: What explains the data less well than another by less than this (log evidence) is its alias.
ALIKE = 7.0
#: Prior odds of a name, or of another component of an optic, against a cell of the table.
NAMED = 5.0
# log prior odds of dependences: what changes needs a reason
_DEPENDENCE = {
    "constant": 0.0,
    "step": -5.0,
    "direction": -1.5,
    "move": -1.5,
    "time2": -1.0,
    "brightness": -1.5,
    "dataset": 0.0,
}
_OTHER = -0.5
# and what is in one of several runs only needs another, be it constant there or not
_ALONE = -2.0
# a direction of which model and lamp leave less than this is theirs
_ABSORBED = 1e-9
#: Evidence that is the same to so many decimals is of causes that do the same.
DECIMALS = 3


def preference(candidate):
    """Return the key that sorts the best first; of what does the same, the name decides."""
    return -round(candidate.evidence, DECIMALS), candidate.name


@dataclass
class Candidate:
    """
    A cause that a model may lack, and the evidence for it.

    Parameters
    ----------
    named : Effect or None
        The effect of the library, None for a cell without a name.
    cell : Cell or None
        Its place, kind and dependence; None where it is not a single cell.
    statistic : float
        By how much it lowers chi-square.
    rank : int
        Number of directions that it adds.
    evidence : float
        Logarithm of the Bayes factor, with the prior odds of its kind.
    prior : float
        Logarithm of these odds.
    spectrum : tuple
        Eigenvalues of its normal equations, what lies along each, and the usual size.
    degree : int or None
        Degree of the law in wavelength of a cell, None for one value per wavelength.
    context : Context or None
        With which a named effect is added, None for that of the data.
    """

    named: object
    cell: object
    statistic: float
    rank: int
    evidence: float
    prior: float = 0.0
    spectrum: tuple = ()
    degree: object = 2
    context: object = None

    @property
    def recipe(self):
        """Effect and context, as `Model.with_effects` takes them."""
        return self.effect, self.context

    @cached_property
    def effect(self):
        """The cause as an effect that can be fitted."""
        return CellEffect(self.cell, self.degree) if self.named is None else self.named

    def tempered(self, temper):
        """Return the same with residuals of another variance, in units of the noise."""
        values, share, scale = self.spectrum
        evidence = log_factor(values, share, scale, temper) + self.prior
        return replace(self, evidence=float(evidence))

    @property
    def name(self):
        """Name of the effect; of a cell, its place, kind and dependence."""
        return self.cell.name if self.named is None else self.named.name

    @property
    def is_named(self):
        """Whether it has a name in the library."""
        return self.named is not None

    @property
    def size(self):
        """Its size to first order where the data ask for it most, in units of the usual one."""
        values, share, scale = self.spectrum
        most = np.argmax(share)
        return float(np.sqrt(share[most] / values[most])) / scale if share[most] > 0 else 0.0

    @property
    def p_value(self):
        """Probability of the statistic by chance, for this cause alone."""
        return float(chi2_above(self.statistic, max(self.rank, 1)))


@dataclass
class Scan:
    """
    Evidence for all causes at a fitted model.

    Parameters
    ----------
    candidates : list of Candidate
        Best first.
    probes : Probes
        Derivatives of the data to the cells.
    temper : float
        Variance of the residuals about the model with the cause, in units of the noise.
    """

    candidates: list
    probes: object = None
    temper: float = 1.0

    def freer(self, candidate, among=()):
        """Return a cause with the law in wavelength for which there is most evidence.

        It is quicker where the candidates ``among`` which it is are known.
        """
        best, probes = candidate, self.probes
        near = () if probes is None or candidate.is_named else probes.steps_near(candidate.cell)
        if near:
            # the step itself, of which only some frames were looked at
            steps = _of_cell(probes, candidate.cell, candidate.degree, self.temper, near)
            best = candidate = steps[0]
            # scans from now on ask all places and kinds for these steps
            for one in steps:
                if one.evidence > best.evidence - ALIKE:
                    probes.waves.setdefault(one.cell.dependence, probes.waves_of(one.cell))
        # an optic that one run has was asked for with its usual law only, of several components
        has_one_law = candidate.is_named and split_run(candidate.named.dependence)[1] is not None
        degrees = (_DEGREES[0], *_FREER) if has_one_law else _FREER
        for degree in degrees if probes is not None else ():
            if candidate.is_named:
                names = [one.named for one in among if one.is_named]
                found = _named(probes, [candidate.named], self.temper, degree, names)
            else:
                found = _of_cell(probes, candidate.cell, degree, self.temper)
            best = min([best, *found], key=preference)
        return best

    def of_cell(self, cell, degree):
        """Return the candidate of a cell with a law of some degree, None where it does nothing."""
        return next(iter(_of_cell(self.probes, cell, degree, self.temper)), None)

    def constant(self, candidate):
        """Return a name with the same sizes at all wavelengths, None where its law is that."""
        if not candidate.is_named:
            return None
        found = _named(self.probes, [candidate.named], self.temper, _DEGREES[0])
        return next((one for one in found if one.rank < candidate.rank), None)

    def by_run(self, candidate):
        """Return the evidence for a cause in each of several runs alone."""
        probes = self.probes
        if probes is None or probes.run_of(candidate.cell) is not None:
            return {}
        found = {}
        for i, run in enumerate(probes.runs):
            if candidate.is_named:
                alone = _named_in(probes, candidate.named, i, self.temper, candidate.context)
            else:
                cell = candidate.cell.in_run(run)
                alone = _of_cell(probes, cell, candidate.degree, self.temper)
            if alone:
                found[run] = alone[0].evidence - alone[0].prior
        return found

    def named_as(self, candidate, effects):
        """Return the names of a cell, each with the law for which there is most evidence."""
        chains, own = self.probes.model.trains, self.probes.own
        return self.with_laws(
            effect
            for effect in effects
            if effect.name not in own and candidate.cell in effect.cells(chains)
        )

    def with_laws(self, effects):
        """Return named effects, each with the law for which there is most evidence."""
        best, effects = {}, list(effects)
        for degree in (*_DEGREES, *_FREER) if effects else ():
            for one in _named(self.probes, effects, self.temper, degree):
                if one.name not in best or best[one.name].evidence < one.evidence:
                    best[one.name] = one
        return list(best.values())

    @property
    def best(self):
        """The best candidate, or None."""
        return self.candidates[0] if self.candidates else None


def scan(model, effects=(), *, cells=True, temper=1.0, without=None, like=None):
    """Return the evidence for all cells and named effects beside a fitted model.

    Effects that are in the model or have no place in it are left out; ``temper`` is the variance of
    the residuals about the model with the cause, in units of the noise. One effect of the model may
    be taken out, to first order; derivatives are those of Probes ``like`` them, where given.
    """
    probes = Probes(model, () if without is None else (without,), like)
    found = _cells(probes, temper) if cells else []
    found += _named(probes, effects, temper)
    found.sort(key=preference)
    return Scan(found, probes, temper)


def _cells(probes, temper):
    """Return the candidate of every cell, with the better of its laws."""
    laws = {degree: law_basis(probes.problem.wavelength, degree) for degree in _DEGREES}
    basis, found = laws[_DEGREES[-1]], []
    # of a few wavelengths the smooth law is one value for each
    inside = {degree: np.linalg.lstsq(basis, law)[0] for degree, law in laws.items()}
    for (place, kind), slopes in probes.slopes.items():
        whole = Reduced(probes, slopes, basis)
        parts = {degree: whole.along(columns) for degree, columns in inside.items()}
        names = probes.dependences_of(place, kind)
        if (place, kind) in probes.bends:
            names = [name for name in names if name != "constant"]
            constant = Cell(place, kind, "constant")
            bent = [one for d in _DEGREES for one in _of_cell(probes, constant, d, temper)]
            found += sorted(bent, key=preference)[:1]
        for same, waves in probes.grouped(names):
            by_law = [(degree, part.normal(waves)) for degree, part in parts.items()]
            found += _candidates(probes, place, kind, same, by_law, temper)
    # where none of these laws is half as good as one that is free
    least = max([ENOUGH, *(_SHARPER * one.evidence for one in found)])
    has_freer = len(basis) > basis.shape[1]
    for cell in _sharpest(probes, temper, least) if has_freer else ():
        free = [o for o in _of_cell(probes, cell, None, temper) if o.evidence > least]
        found = [o for o in found if not free or o.name != cell.name] + free
    return [one for one in found if one.name not in probes.own]


def _sharpest(probes, temper, least):
    """Return the few cells with most evidence for another size at each wavelength, best first.

    What changes from one wavelength to the next, as fringes do, is in no smooth law. What the model
    absorbs of it is left out here, and no two wavelengths or waves are taken to share anything.
    """
    found = []
    for (place, kind), slopes in probes.slopes.items():
        tables = probes.by_wavelength(slopes)
        for names, waves in probes.grouped(probes.dependences_of(place, kind)):
            target, gram = (
                sum(
                    np.einsum("nmf,fw->nmw", w**power, part[i])
                    for w, part in zip(waves, tables, strict=True)
                )
                for i, power in enumerate((1, 2))
            )
            gram, target = (x.reshape(len(names), -1) for x in (gram, target))
            share = np.divide(target**2, gram, out=np.zeros_like(gram), where=gram > 0)
            scale = np.array([Cell(place, kind, name).scale for name in names])
            factors = log_factor(gram, share, scale, temper)
            found += [(f + _prior(n), place, kind, n) for f, n in zip(factors, names, strict=True)]
    found = sorted((one for one in found if one[0] > least), reverse=True)
    return [Cell(*cell) for _, *cell in found[:_SHARP]]


def _bent(probes, place, kind, law):
    """Return gram and target of a constant cell with its second derivative, None if it has none.

    The derivative vanishes where a parameter is at an extremum, as half a wave is; a change shows
    in second order then, with one sign only.
    """
    bend = probes.bends.get((place, kind))
    if bend is None:
        return None
    both = Reduced(probes, [probes.slopes[place, kind], bend], law)
    ((gram,), (target,)) = both.normal([ones[None] for ones in probes.ones])
    k = law.shape[1]
    held = gram + np.eye(2 * k) / Cell(place, kind, "constant").scale ** 2
    size = law @ np.linalg.solve(held, target)[k:]
    return (gram, target) if size.mean() > 0 else None


def _of_cell(probes, cell, degree, temper, others=()):
    """Return the candidates of a cell and of others of its place and kind, best first."""
    law = law_basis(probes.problem.wavelength, degree)
    bent = _bent(probes, cell.place, cell.kind, law) if cell.dependence == "constant" else None
    if bent is None:
        cells = [cell, *others]
        waves = [np.stack(each) for each in zip(*map(probes.waves_of, cells), strict=True)]
        parts = Reduced(probes, probes.slopes[cell.place, cell.kind], law).normal(waves)
        names = [one.dependence for one in cells]
    else:
        names, parts = [cell.dependence], [part[None] for part in bent]
    found = _candidates(probes, cell.place, cell.kind, names, [(degree, parts)], temper)
    return sorted(found, key=preference)


def _candidates(probes, place, kind, names, by_law, temper):
    """Return the candidates of dependences from (degree, normal equations), of the better law."""
    cells, best = [Cell(place, kind, name) for name in names], {}
    scales = np.array([cell.scale for cell in cells])
    others = [Cell(*name.split("/", 2)) for name in probes.own if name.count("/") > 1]
    for degree, (gram, target) in by_law:
        values, share = _spectra(gram, target)
        factors, ranks = log_factor(values, share, scales, temper), _rank(values, scales)
        for i in np.flatnonzero(ranks):
            if i not in best or best[i][0] < factors[i]:
                best[i] = (factors[i], int(ranks[i]), values[i], share[i], degree)
    found = []
    for i, (factor, rank, values, share, degree) in best.items():
        # another component of an optic that is a cause already is no worse than a name
        is_one = any(alike([cells[i], other]) == "optic" for other in others)
        prior = _prior(names[i]) + is_one * float(np.log(NAMED))
        evidence, spectrum = float(factor) + prior, (values, share, float(scales[i]))
        statistic = float(share.sum())
        found.append(Candidate(None, cells[i], statistic, rank, evidence, prior, spectrum, degree))
    return found


@cache
def _prior(dependence):
    text, run = split_run(dependence)
    alone = _ALONE if run is not None else 0.0
    return _DEPENDENCE.get(text.partition(":")[0], _OTHER) + alone


def _spectra(gram, target):
    """Return eigenvalues and what chi-square loses along each vector, of (n, k, k) and (n, k)."""
    values, vectors = np.linalg.eigh(gram)
    square = np.einsum("nij,ni->nj", vectors, target) ** 2
    seen = values > _ABSORBED * np.maximum(values.max(axis=1, keepdims=True), 1.0)
    values = np.where(seen, values, 0.0)
    return values, np.divide(square, values, out=np.zeros_like(square), where=seen)


def log_factor(values, share, scale, temper):
    """Return the log Bayes factor against no such cause, of (..., k) arrays and (...) sizes."""
    scale = np.broadcast_to(scale, values.shape[:-1])[..., None]
    spreads = np.square(np.multiply.outer(_SIZES, scale)) / temper
    gains = share / temper * (spreads * values / (1 + spreads * values))
    each = 0.5 * (gains - np.log1p(spreads * values)).sum(axis=-1)
    return np.logaddexp.reduce(each, axis=0) - np.log(len(_SIZES))


def _rank(values, scale):
    """Return in how many directions even a large size would show."""
    return (np.square(np.asarray(scale)[..., None] * _SIZES[-1]) * values > 1).sum(axis=-1)


def _named(probes, effects, temper, degree="default", others=()):
    """Return the candidates of named effects; ``others`` will be asked for, too."""
    model, found = probes.model, []
    chains = model.trains

    def fits(effect):
        if effect.name in probes.own or effect.absorbed_by:
            return False
        return effect.name in model.added or effect.applies(chains)

    fitting, others = ([*filter(fits, some)] for some in (effects, others))
    law = replace(model.context, degree=degree)
    slopes = [_slopes_of(probes, effect, [*fitting, *others], degree) for effect in fitting]
    for effect, spectrum in zip(fitting, _spectra_of(probes, slopes), strict=True):
        bent = _bent_name(probes, effect, law) if effect.name not in model.added else None
        spectrum = spectrum if bent is None else bent
        if spectrum is not None:
            context = None if degree == "default" else law
            found.append(_with_name(effect, model, *spectrum, temper, context))
    return found


def _columns(model, effects, degree):
    """Return the derivatives to named effects, all at zero in the same chains, by name."""
    known = model.__dict__.setdefault("_named_columns", {})
    asked = {e.name: e for e in effects if e.name not in model.added}
    waiting = [effect for name, effect in asked.items() if (name, degree) not in known]
    context = replace(model.context, degree=degree)
    while waiting:
        edited, parameters, later = list(model.held_chains), {}, []
        ties, laws, neutral = {}, {}, {}
        for effect in waiting:
            # what is absent does nothing to another, but two may free the same parameter, or
            # exchange the same optic
            edit = effect.edit(edited, context)
            names = {p.name for p in edit.parameters}
            taken = {p.name for own in parameters.values() for p in own}
            blocked = parameters and not names
            if blocked or names & taken or len(parameters) == _TOGETHER:
                later.append(effect)
                continue
            edited, parameters[effect.name] = edit.chains, edit.parameters
            ties |= {name: tie for name, tie in edit.ties.items() if tie.source in names}
            laws, neutral = laws | edit.laws, neutral | edit.neutral
        how = {"ties": ties, "laws": laws, "neutral": neutral, "like": model.problem}
        problem = GapProblem(edited, model.observations, **how, copy=False)
        jacobian = problem.jacobian(problem.start) if problem.size else None
        for name, own in parameters.items():
            known[name, degree] = _columns_of(problem, jacobian, own)
        waiting = later
    return {name: found for (name, law), found in known.items() if law == degree}


def _named_in(probes, effect, i, temper, context):
    """Return the candidate of a named effect in one dataset only, in a list."""
    slopes = _slopes_of(probes, effect, [effect], "default" if context is None else context.degree)
    if slopes is None:
        return []
    rows = probes.problem.segments[i]
    alone = np.zeros_like(slopes)
    alone[rows] = slopes[rows]
    (spectrum,) = _spectra_of(probes, [alone])
    return [] if spectrum is None else [_with_name(effect, probes.model, *spectrum, temper)]


def _slopes_of(probes, effect, effects, degree):
    """Return the derivatives to the parameters of an effect, None where it has none."""
    model = probes.model
    if effect.name in model.added:
        return _columns_of(model.problem, model.jacobian, model.added[effect.name])
    return _columns(model, effects, degree).get(effect.name)


def _spectra_of(probes, tables):
    """Return what derivatives say of effects, see `_spectra`, None of those that do nothing."""
    # a law may have no freedom left
    known = [slopes for slopes in tables if slopes is not None and slopes.size]
    taken = probes.tangent.T @ np.concatenate([probes.tangent[:, :0], *known], axis=1)
    parts, found = iter(np.split(taken, np.cumsum([t.shape[1] for t in known]), axis=1)), []
    for slopes in tables:
        if slopes is None or not slopes.size:
            found.append(None)
            continue
        seen = next(parts)
        gram, target = slopes.T @ slopes - seen.T @ seen, slopes.T @ probes.residual
        values, share = (part[0] for part in _spectra(gram[None], target[None]))
        found.append((values, share) if _rank(values, 1.0) else None)
    return found


def _columns_of(problem, jacobian, parameters):
    """Return the derivatives to parameters, each for its usual size, None where none is free."""
    parts = [(problem.slices[p.name], p) for p in parameters if p.name in problem.slices]
    if jacobian is None or not parts:
        return None
    return np.concatenate([jacobian[:, rows] * p.canonical_scale for rows, p in parts], axis=1)


def _bent_name(probes, effect, context):
    """Return what second derivatives say of an effect whose first one vanishes, else None."""
    model = probes.model
    cell = effect.cell(model.trains) if probes.bends else None
    if cell is None or cell.dependence != "constant" or (cell.place, cell.kind) not in probes.bends:
        return None
    added = effect.edit(model.held_chains, context).parameters
    # what is freed, instead of inserted, is no perturbation behind the optic
    if len(added) != 1 or not added[0].name.startswith(effect.label):
        return None
    law = added[0].basis
    law = np.eye(len(probes.problem.wavelength)) if law is None else law
    bent = _bent(probes, cell.place, cell.kind, law)
    if bent is None:
        return None
    (values,), (share,) = _spectra(*(part[None] for part in bent))
    values = values * added[0].canonical_scale ** 2
    return (values, share) if _rank(values, 1.0) else None


def _with_name(effect, model, values, share, temper, context=None):
    is_any = split_run(effect.dependence)[1] is not None and not effect.around
    # no name makes a new optic more probable than the same without one; zeros of stages do move
    prior = _prior(effect.dependence) if is_any else float(np.log(NAMED))
    spectrum, statistic = (values, share, 1.0), float(share.sum())
    cell, rank = effect.cell(model.trains), int(_rank(values, 1.0))
    one = Candidate(effect, cell, statistic, rank, 0.0, prior, spectrum, context=context)
    return one.tempered(temper)


def false_discovery(p_values):
    """Return p-values corrected for the number of looks, as that of `scipy.stats` does.

    Benjamini & Yekutieli (2001), doi:10.1214/aos/1013699998.
    """
    order, numbers = np.argsort(p_values)[::-1], np.arange(len(p_values), 0, -1)
    corrected = np.array(p_values, dtype=float)
    looks = len(numbers) * np.sum(1 / numbers) / numbers
    corrected[order] = np.minimum.accumulate(looks * corrected[order]).clip(max=1)
    return corrected.tolist()
