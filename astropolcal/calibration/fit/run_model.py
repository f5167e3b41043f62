# Licensed under a 3-clause BSD style license - see LICENSE
"""
The coefficients from which the parameters of all runs follow, and how they are found.

Values that all runs share, values of one run only, which are eliminated run by run, and courses in
time; see `astropolcal.calibration.fit.runs`.
"""

from collections import Counter
from copy import copy
from dataclasses import replace

import numpy as np

from astropolcal.calibration.fit.evidence import (
    COURSES,
    EVENT,
    SIMPLE,
    Deviation,
    Term,
    Weighed,
    chances_of,
    laws_of,
    waves_of,
    weigh,
)
from astropolcal.calibration.identifiability.linearized import STILL, decompose, orthonormal
from astropolcal.calibration.noise.scatter import by_chance
from astropolcal.exceptions import ParameterError
from astropolcal.measurement.parameters import is_of, optic, stem
from astropolcal.progress import stage
from astropolcal.words import check_choice

__all__ = []

# an optic that varies with less than this probability is held constant
_SURE = 0.9
_ENOUGH = float(np.log(_SURE / (1 - _SURE)))
# others that explain it nearly as well are named: log evidence
_RIVAL = 5.0
_MOST_TERMS, _MOST_SEARCHES = 12, 5
# prior probability of a step anywhere, and between two runs at the most
_CHANGED, _MOST_CHANGED = 0.3, 0.05
# the solution has arrived where no determined direction moves by this share of its error
_ARRIVED, _MOST_ROUNDS, _HALVINGS, _SHORTER = 0.01, 20, 6, 1.1
# so far beyond a bound, in steps of a degree or so, is rounding
_BEYOND = 1e-9
_PINV = 1e-9
# rows of so many runs are reduced at a time
_MANY = 2000


class Model:
    """The coefficients of all runs, and the rows around them."""

    def __init__(self, work, own, dates, events):
        self.work, self.dates, self.terms = work, dates, []
        frees = [shape.free for shape in work.shapes]
        self.names = [free.names for free in frees]
        self.scales = [free.steps for free in frees]
        count = Counter(name for names in self.names for name in names)
        _check_known(own, count, "own")
        self.own = [
            np.array([count[n] == 1 or is_of(n, own) for n in names]) for names in self.names
        ]
        self.shared = [n for n in count if count[n] > 1 and not is_of(n, own)]
        place = {name: k for k, name in enumerate(self.shared)}
        self.columns = [
            np.array([place[n] for n in np.array(names)[~mine]], dtype=int)
            for names, mine in zip(self.names, self.own, strict=True)
        ]
        # bounds and start of what runs share are those of the first run that has it
        self.limits, self.value = np.empty((2, len(place))), np.empty(len(place))
        parts = zip(frees, work.alone, self.scales, self.own, self.columns, strict=True)
        for free, vector, scale, mine, columns in reversed(list(parts)):
            self.limits[:, columns] = (np.array(free.bounds()) / scale)[:, ~mine]
            self.value[columns] = (vector / scale)[~mine]
        #: What is a run's own and pushed against a bound, where it stays.
        self.stuck = [np.zeros_like(mine) for mine in self.own]
        self.chances = None
        if dates is not None:
            # one change in all runs is thought as probable as in a few
            usual = min(_CHANGED / (len(dates) - 1), _MOST_CHANGED)
            self.chances = chances_of(dates, events, usual)
        self.vectors = work.alone
        #: Rows around the parameters of each run alone, with its residuals there.
        self.alone = self.rows = work.around(self.vectors)
        self.value = self._solved()[0]
        self.luck = max(by_chance(one.settings) for one in self.alone)

    @property
    def varying(self):
        """Names of the shared elements of each optic that all runs have."""
        found, everywhere = {}, set.intersection(*map(set, self.names))
        for name in (n for n in self.shared if n in everywhere):
            for what in (optic(name), stem(name)):
                found.setdefault(what, []).append(name)
        # what has a single parameter is named by its optic
        single = [k for k in found if k != optic(k) and found[k] == found[optic(k)]]
        return {what: names for what, names in found.items() if what not in single}

    # ---- linear algebra

    def _known(self, i, which):
        """Return rows and targets of a run's priors on some elements, in steps."""
        free, vector = self.work.shapes[i].free, self.vectors[i]
        rows = (free.prior_jacobian(vector) * self.scales[i][:, None]).T
        aims = rows @ (vector / self.scales[i]) - free.prior_residuals(vector)
        wanted = rows[:, which].any(axis=1)
        return rows[wanted], aims[wanted]

    def _with_priors(self, i):
        """Return a run's rows and targets, with the priors on what is its own."""
        one, known = self.rows[i], self._known(i, self.own[i])
        return np.concatenate([one.rows, known[0]]), np.concatenate([one.targets, known[1]])

    def _split(self, i):
        """Return a run's rows with what is its own projected out, and their targets."""
        (rows, targets), stuck = self._with_priors(i), self.stuck[i]
        targets = targets - rows[:, stuck] @ (self.vectors[i] / self.scales[i])[stuck]
        basis = orthonormal(rows[:, self.own[i] & ~stuck])
        targets = targets - basis @ (basis.T @ targets)
        rows = rows - basis @ (basis.T @ rows)
        rows[:, self.own[i]] = 0.0
        return rows, targets

    def _shares(self, i):
        """Return the derivative of a run's elements to all coefficients, zero of its own ones."""
        out, start = np.zeros((len(self.names[i]), self.value.size)), len(self.shared)
        out[~self.own[i], self.columns[i]] = 1.0
        for term in self.terms:
            where = [self.names[i].index(name) for name in term.names]
            out[where, start : start + term.size] = np.kron(term.times[i], term.law)
            start += term.size
        return out

    def _system(self):
        """Return the triangular factor of all rows and priors, and its targets."""
        sizes = [np.full(len(self.shared), np.inf)]
        sizes = np.concatenate(sizes + [np.full(term.size, term.prior) for term in self.terms])
        own = np.diag(1 / sizes)[np.isfinite(sizes)]
        total, seen = np.column_stack([own, -own @ self.value]), set()
        for i, names in enumerate(self.names):
            # what is known beforehand of what runs share is taken from the first that has it
            fresh = np.array([n not in seen for n in names]) & ~self.own[i]
            seen |= set(names)
            shares = self._shares(i)
            for rows, targets in (self._known(i, fresh), self._split(i)):
                rows = rows @ shares
                rows = np.column_stack([rows, targets - rows @ self.value])
                total = np.concatenate([total, rows])
            if len(total) > max(4 * total.shape[1], _MANY):
                total = np.linalg.qr(total, mode="r")
        return total[:, :-1], total[:, -1]

    def _solved(self):
        """Return the coefficients that fit best, within their bounds, and the directions."""
        rows, aims = self._system()
        n, (low, high) = len(self.shared), self.limits
        start, held = self.value.copy(), np.zeros(self.value.size, dtype=bool)
        stopped, every, wanted = [~mine for mine in self.own], rows, aims
        while True:
            new, live = start.copy(), np.flatnonzero(~held)
            found = pulled = decompose(rows[:, live])
            if every is not rows:
                pulled = decompose(every[:, live])
            left = wanted - every @ (start - self.value)
            new[live] += pulled.half.T @ (pulled.half @ (every[:, live].T @ left))
            outside = ~held[:n] & ((new[:n] < low) | (new[:n] > high))
            start[:n] = np.where(outside, np.clip(new[:n], low, high), start[:n])
            held[:n] |= outside
            if not outside.any():
                more, bounds = self._beyond(new, stopped)
                if not bounds.size:
                    self.held = held
                    return new, found
                # pulled to its bound as hard as data can, which they resist where they know better
                hard = np.abs(rows).max(initial=1.0)
                every = np.concatenate([every, hard * more])
                wanted = np.concatenate([wanted, hard * (bounds - more @ self.value)])

    def _beyond(self, value, free):
        """Return rows of what a course leads beyond its bounds in a run, and these, once each."""
        rows, bounds = [np.zeros((0, value.size))], [np.zeros(0)]
        for i in range(len(self.names)) if self.terms else ():
            shares, limits = self._shares(i), np.array(self.work.shapes[i].free.bounds())
            theta = shares @ value
            nearest = np.clip(theta, *(limits / self.scales[i]))
            far = free[i] & (np.abs(theta - nearest) > _BEYOND)
            free[i] &= ~far
            rows.append(shares[far])
            bounds.append(nearest[far])
        return np.concatenate(rows), np.concatenate(bounds)

    def _vectors(self, value):
        """Return the canonical parameters of all runs."""
        out = []
        for i, mine in enumerate(self.own):
            theta = self._shares(i) @ value
            theta[mine] = (self.vectors[i] / self.scales[i])[mine]
            (rows, targets), mine = self._with_priors(i), mine & ~self.stuck[i]
            theta[mine] += np.linalg.pinv(rows[:, mine], rcond=_PINV) @ (targets - rows @ theta)
            bounds = self.work.shapes[i].free.bounds()
            out.append(np.clip(theta * self.scales[i], *bounds))
        return out

    def solve(self):
        """Solve around the present parameters, go there, and return those before."""
        before, new = self.value, self._solved()[0]
        old, cost = self.vectors, sum(one.chi2 for one in self.rows)
        # derivatives hold nearby only: a step that makes it much worse is shortened; a little worse
        # is what other weights than equal ones may make it
        for k in range(_HALVINGS):
            trial = before + (new - before) / 2**k
            vectors = self._vectors(trial)
            rows = self.work.around(vectors)
            if sum(one.chi2 for one in rows) <= _SHORTER * cost or k == _HALVINGS - 1:
                break
        self.value, self.vectors, self.rows = trial, vectors, rows
        for i, vector in enumerate(vectors):
            rows, targets = self._with_priors(i)
            pull = rows.T @ (targets - rows @ (vector / self.scales[i]))
            low, high = self.work.shapes[i].free.bounds()
            self.stuck[i] = self.own[i] & np.where(pull < 0, vector <= low, vector >= high)
        return old

    def settle(self):
        """Solve until no run moves by more than a share of its error."""
        for k in range(_MOST_ROUNDS):
            old = self.solve()
            runs = zip(self.rows, self.vectors, old, self.scales, strict=True)
            moves = (one.rows @ ((new - then) / scale) for one, new, then, scale in runs)
            if max(np.abs(move).max(initial=0.0) for move in moves) < _ARRIVED:
                return k + 1, True
        return _MOST_ROUNDS, False

    # ---- courses

    def add_wanted(self, vary):
        """Add the courses that the user asks for."""
        if not isinstance(vary, dict):
            raise ParameterError(f"vary = {vary!r}; allowed are 'evidence' or a dict of courses")
        _check_known(vary, [n for names in self.varying.values() for n in names], "vary")
        for what, course in vary.items():
            check_choice(f"vary: {what}", course, COURSES, ParameterError)
            names = [n for n in self.varying[optic(what)] if is_of(n, [what])]
            # of a drift, and of a step at an event, every element has its own
            law, waves, found = np.eye(len(names)), waves_of(self.dates), []
            if course in ("walk", "scatter"):
                found = [self._weighed(names, self._parts()).best([course])]
            elif course == "drift":
                found = [Term(course, law, waves[course][:, [0]])]
            elif course == "steps":
                for gap in np.flatnonzero(self.chances == EVENT).tolist():
                    found.append(Term(course, law, waves[course][:, [gap]], gap=gap))
                if not found:
                    raise ParameterError(
                        f"vary: {what} has steps, but there is no event between the runs"
                    )
            for one in found:
                self._take([*self.terms, self._term(what, names, one)])

    def search(self):
        """Add the courses that the evidence asks for."""
        before = None
        for k in range(_MOST_SEARCHES):
            stage(f"what changed, look {k + 1}")
            # far from a run its rows mislead: what was found is looked for again from where it led
            gained, terms = self._grown(SIMPLE)
            if len(terms) > 1:
                # a walk does what several steps do, and the other way round
                other = self._grown(COURSES[1:])
                terms = other[1] if other[0] > gained else terms
            self._take(terms)
            found = [(t.what, t.course, t.gap, t.law.shape[1]) for t in terms]
            if found == before:
                break
            before = found
            self.solve()

    def _take(self, terms):
        """Take courses in place of all present ones."""
        self.terms = list(terms)
        self.value = np.pad(self.value[: len(self.shared)], (0, sum(t.size for t in terms)))
        self.value = self._solved()[0]

    def _grown(self, first):
        """Return the evidence of courses that are added one by one, and these.

        As long as one of the ``first`` explains something they are added, and then any.
        """
        self._take([])
        gained, among = 0.0, first
        while len(self.terms) < _MOST_TERMS:
            found = self.weighed()
            odds = {what: one.odds_of(among) for what, one in found.items()}
            what = max(odds, key=odds.get, default=None)
            if what is not None and odds[what] > _ENOUGH:
                new = self._term(what, self.varying[what], found[what].best(among))
                self._take([*self.terms, new])
                gained += odds[what] + self._exchange()
            elif among == COURSES[1:]:
                break
            else:
                among = COURSES[1:]
        return gained, self.terms

    def _term(self, what, names, best):
        # a size that is given to what follows no law keeps it from following the noise
        prior = np.inf if best.course in SIMPLE else best.prior
        return replace(best, what=what, names=names, prior=prior)

    def _exchange(self):
        """Put in place of each course the best of its optic beside all others; return the gain.

        What is needless beside a later one goes.
        """
        gained = 0.0
        for old in self.terms[:-1]:
            k, terms = self.terms.index(old), list(self.terms)
            self._take([*terms[:k], *terms[k + 1 :]])
            found = self.weighed(optic(old.what))
            odds = {what: one.odds_of(COURSES[1:]) for what, one in found.items()}
            what = max(odds, key=odds.get)
            gained -= odds[old.what]
            if odds[what] > _ENOUGH:
                new = self._term(what, self.varying[what], found[what].best(COURSES[1:]))
                gained += odds[what]
                self._take([*terms[:k], new, *terms[k + 1 :]])
        return gained

    def weighed(self, among=None):
        """Return the probabilities of all courses of each optic, beside all that were added.

        Of ``among``, an optic, only.
        """
        wanted = {k: names for k, names in self.varying.items() if among in (None, optic(k))}
        parts = self._parts() if wanted else []
        return {what: self._weighed(names, parts) for what, names in wanted.items()}

    def _parts(self):
        """Return of each run rows, what all coefficients take of them, and what is left."""
        value, found = self._solved()
        wide, parts = np.zeros((self.value.size, found.rank)), []
        wide[~self.held] = found.half.T
        for i in range(len(self.rows)):
            rows, targets = self._split(i)
            spread = rows @ self._shares(i)
            parts.append((rows / self.luck, spread @ wide, (targets - spread @ value) / self.luck))
        return parts

    def _weighed(self, names, parts):
        looks = []
        for law in laws_of(names):
            columns = []
            for own, (rows, taken, left) in zip(self.names, parts, strict=True):
                part = rows[:, [own.index(name) for name in names]] @ law
                columns.append((part.T @ part, taken.T @ part, part.T @ left))
            looks.append(Deviation.of(law, *map(np.array, zip(*columns, strict=True))))
        looks = [look for look in looks if look is not None]
        return weigh(looks, waves_of(self.dates), self.chances) if looks else _NEVER

    def final(self, term):
        """Return the probabilities of an optic's courses beside all others, its rivals, its share.

        Rivals are what would explain the data nearly as well in its place; the share is its
        probability among them and itself.
        """
        new = copy(self)
        new._take([other for other in self.terms if other is not term])
        found, now = new.weighed(), self.weighed()
        odds = {what: one.odds_of(COURSES[1:]) for what, one in found.items()}
        # neither of two optics or parameters that are rivals holds the other
        rivals = [
            what
            for what in found
            if what not in (term.what, optic(term.what))
            and term.what != optic(what)
            and odds[what] > odds[term.what] - _RIVAL
            and now[what].odds_of(COURSES[1:]) < 0
        ]
        weights = np.exp([odds[what] - odds[term.what] for what in rivals])
        return found[term.what], rivals, float(1 / (1 + weights.sum()))

    def courses(self):
        """Return what each optic does, a row each, and of each of its steps first and last gap.

        See `astropolcal.calibration.fit.runs.RunsCalibration`; with the probability of the step,
        and its rivals. Last are the rivals of each row.
        """
        own, rows, spans, others, days = {}, [], [], [], sorted(self.dates.isot)
        for term in self.terms:
            own.setdefault(term.what, []).append(term)
        for what, terms in own.items():
            judged = [self.final(term) for term in terms]
            # of several steps the last one is judged
            told, rivals, share = judged[-1]
            pairs = zip(terms, judged, strict=True)
            spans.append(
                sorted(
                    (*one.span(), 1 - one.chances["constant"], known)
                    for term, (one, known, _) in pairs
                    if term.gap is not None
                )
            )
            row = {"what": what, "course": terms[-1].course}
            row["probability"] = (1 - told.chances["constant"]) * share
            row |= told.chances
            row["when"] = ", ".join(
                f"{days[a][:10]} to {days[b + 1][:10]}" for a, b, *_ in spans[-1]
            )
            rows.append(row | {"or": ", ".join(rivals)})
            others.append(rivals)
        for what, told in self.weighed().items():
            if what == optic(what) and what not in map(optic, own):
                row = {"what": what, "course": "constant", "probability": told.chances["constant"]}
                rows.append(row | told.chances | {"when": "", "or": ""})
                spans.append([])
                others.append([])
        return rows, spans, others

    # ---- errors

    def errors_of(self, i):
        """Return determined and open directions of a run's parameters, in steps."""
        _, found = self._solved()
        mine, (rows, _) = self.own[i] & ~self.stuck[i], self._with_priors(i)
        # how the run's parameters follow the coefficients
        follow = self._shares(i)
        follow[mine] = -np.linalg.pinv(rows[:, mine], rcond=_PINV) @ (rows @ follow)
        follow = follow[:, ~self.held].T
        own = decompose(rows[:, mine])
        block = np.zeros((own.right.shape[0], mine.size))
        block[:, mine] = own.right
        known = np.concatenate(
            [found.half @ follow, block[: own.rank] / own.singular[: own.rank, None]]
        )
        null = np.concatenate([found.null @ follow, block[own.rank :]])
        return known, null[np.linalg.norm(null, axis=1) > STILL]


# nothing is known of it
_NEVER = Weighed({course: float(course == "constant") for course in COURSES}, -np.inf, [])


def _check_known(wanted, names, what):
    known = {key for name in names for key in (stem(name), optic(name))}
    for name in wanted:
        if name not in known:
            raise ParameterError(f"{what}: no free optic or parameter {name!r} in the runs")
