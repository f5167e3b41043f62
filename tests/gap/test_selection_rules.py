# Licensed under a 3-clause BSD style license - see LICENSE
"""The rules of the selection, each with models that have the numbers it asks for."""

from types import SimpleNamespace

import numpy as np
import pytest

from astropolcal.gap import selection
from astropolcal.gap.attribution import SAME_EVIDENCE, Candidate
from astropolcal.gap.shrinkage import HeldOut

N_DATA = 1000


class Model:
    """Chi-square, number of parameters and effects of a fitted model."""

    def __init__(self, chi2, size=10, added=(), p_value=0.0, impossible=()):
        self.fit = SimpleNamespace(chi2=chi2)
        self.problem = SimpleNamespace(n_data=N_DATA, size=size)
        self.added, self.p_value = dict.fromkeys(added), p_value
        self._impossible = set(impossible)

    @property
    def mean_square(self):
        return self.fit.chi2 / (N_DATA - self.problem.size)

    def impossible(self):
        return self._impossible


class Base(Model):
    """A model that knows how every set of effects would fit."""

    def __init__(self, chi2, sets):
        super().__init__(chi2)
        self.sets = {frozenset(names): model for names, model in sets.items()}

    def with_effects(self, recipes, like=None):
        names = frozenset(effect.name for effect, _ in recipes)
        if not names:
            return self
        self.sets[names].added = dict.fromkeys(names)
        return self.sets[names]


def candidate(name, model=None, physical=True, context=None):
    effect = SimpleNamespace(name=name, title=name)
    return Candidate(SimpleNamespace(effect=effect), model, 0.0, 0.0, physical, context=context)


def errors(*whitened):
    whitened = np.array(whitened, dtype=float)
    return HeldOut([""] * len(whitened), whitened, whitened, np.full(len(whitened), 10))


# ---- is it worth it ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chi2", "p_value", "worthy"),
    [
        # an excess of 1010: a twentieth of it is 50.5
        (1949.0, 0.0, True),
        (1950.0, 0.0, False),
        # what leaves noise is worth it however little it was
        (1999.0, 1e-3, True),
        (1999.0, 1e-5, False),
    ],
)
def test_an_effect_explains_enough_or_all(chi2, p_value, worthy):
    one = candidate("a", Model(chi2, p_value=p_value))
    assert selection._worthy(Model(2000.0), one) == worthy


@pytest.mark.parametrize(
    ("after", "scatter", "holds"),
    [
        # among structure left-out frames have the last word
        ((1.0, 1.1, 1.2), 5.0, True),
        ((3.0, 3.1, 3.2), 5.0, False),
        ((2.0, 2.1, 2.2), 5.0, False),
        # among noise they must not speak against it
        ((2.0, 2.1, 2.2), 1.0, True),
        ((2.0, 2.2, 2.1), 1.0, True),
        ((3.0, 3.1, 3.2), 1.0, False),
    ],
)
def test_what_left_out_frames_say(after, scatter, holds):
    assert selection._holds(errors(*after), errors(2.0, 2.1, 2.2), scatter) == holds


def test_without_left_out_frames_the_scan_is_trusted():
    assert selection._holds(None, None, 9.0)
    assert selection._errors(None, None) is None


# ---- comparing models ----------------------------------------------------------------------


def test_advantage_is_evidence_over_the_lesser_scatter():
    old, new = Model(3960.0), Model(1980.0, size=12)
    scatter = 1980 / (N_DATA - 12)
    expected = 1980 / scatter - 2 * np.log(N_DATA - 12)
    assert selection._advantage(new, old) == pytest.approx(expected)
    # a model with less structure than noise is measured by the noise
    quiet = selection._advantage(Model(500.0), Model(600.0))
    assert quiet == pytest.approx(100.0)
    assert selection._advantage(Model(500.0), Model(500.0)) == 0


@pytest.mark.parametrize(
    ("chi2", "size", "supersedes"),
    [(2000.0, 9, True), (1334.0, 10, False), (1333.0, 10, True), (1333.0, 20, True)],
)
def test_one_supersedes_another_if_it_is_simpler_or_leaves_clearly_less(chi2, size, supersedes):
    assert selection._supersedes(Model(chi2, size=size), Model(2000.0)) == supersedes


def test_the_main_effect_explains_more_than_half():
    selected = [
        candidate("a", Model(1600.0)),
        candidate("b", Model(1100.0)),
        candidate("c", Model(1000.0)),
    ]
    base = Model(2000.0)
    # 400, 500 and 100 of 1000
    assert [selection._is_main(base, selected, one) for one in selected] == [False] * 3
    selected[1].model = Model(1050.0)
    assert [selection._is_main(base, selected, one) for one in selected] == [False, True, False]
    assert not selection._is_main(base, selected, candidate("d"))


def test_aliases_of_what_is_chosen_are_no_rivals():
    chosen = candidate("a")
    chosen.aliases = [candidate("b")]
    library = [SimpleNamespace(name=name) for name in "abc"]
    left = selection._without_aliases(library, [chosen])
    assert [effect.name for effect in left] == ["a", "c"]


def test_outline_tells_a_law_that_was_freed():
    stiff, loose = candidate("a"), candidate("a", context="free")
    assert selection._outline([stiff]) != selection._outline([loose])
    assert selection._outline([stiff]) == selection._outline([candidate("a")])


# ---- exchanges -----------------------------------------------------------------------------


@pytest.fixture
def exchange(monkeypatch):
    """The exchange of candidates where no law is freed and rivals are as given."""

    def run(base, selected, rivals=None):
        rivals = rivals or {}
        monkeypatch.setattr(selection, "freed", lambda model, one: one)
        monkeypatch.setattr(selection, "_rival", lambda model, one, *others: rivals.get(one.name))
        last = selected[-1].model
        last.problem.n_data = N_DATA
        history = [None] * (len(selected) + 1)
        return selection._exchanged(base, selected, history, [], 0.01, None, lambda line: None)[0]

    return run


def names(candidates):
    return [one.name for one in candidates]


def test_an_effect_that_is_not_needed_next_to_the_others_is_dropped(exchange):
    both = Model(1000.0, size=14)
    base = Base(5000.0, {"a": Model(4000.0, size=12), "b": Model(1001.0, size=12), "ab": both})
    selected = [candidate("a", base.sets[frozenset("a")]), candidate("b", both)]
    assert names(exchange(base, selected)) == ["b"]


def test_an_effect_that_is_needed_stays(exchange):
    both = Model(1000.0, size=14)
    base = Base(5000.0, {"a": Model(4000.0, size=12), "b": Model(1500.0, size=12), "ab": both})
    selected = [candidate("a", base.sets[frozenset("a")]), candidate("b", both)]
    assert exchange(base, selected) is selected


@pytest.mark.parametrize(
    ("chi2", "found"),
    # by more than what counts as the same evidence
    [(1000.0 - SAME_EVIDENCE - 5, ["c", "b"]), (1000.0 - SAME_EVIDENCE + 5, ["a", "b"])],
)
def test_a_rival_takes_the_place_if_it_is_clearly_better(exchange, chi2, found):
    both, other = Model(1000.0, size=14), Model(chi2, size=14)
    sets = {"a": Model(4000.0), "b": Model(1500.0), "ab": both, "c": Model(3000.0), "cb": other}
    base = Base(5000.0, sets)
    selected = [candidate("a", base.sets[frozenset("a")]), candidate("b", both)]
    rival = candidate("c", other)
    assert names(exchange(base, selected, {"a": rival})) == found


def test_a_main_effect_gives_way_only_to_what_supersedes_it(exchange):
    both, other = Model(1000.0, size=14), Model(900.0, size=14)
    sets = {"a": Model(1500.0), "b": Model(4800.0), "ab": both, "c": Model(1400.0), "cb": other}
    base = Base(5000.0, sets)
    selected = [candidate("a", base.sets[frozenset("a")]), candidate("b", both)]
    assert names(exchange(base, selected, {"a": candidate("c", other)})) == ["a", "b"]
    clearly = Model(600.0, size=14)
    base.sets[frozenset("cb")] = clearly
    assert names(exchange(base, selected, {"a": candidate("c", clearly)})) == ["c", "b"]


def test_a_rival_that_takes_another_out_of_its_limits_must_do_far_better(exchange):
    both = Model(1000.0, size=14, added="ab")
    other = Model(900.0, size=14, added="cb", impossible="b")
    sets = {"a": Model(4000.0), "b": Model(1500.0), "ab": both, "c": Model(3000.0), "cb": other}
    base = Base(5000.0, sets)
    selected = [candidate("a", base.sets[frozenset("a")]), candidate("b", both)]
    assert exchange(base, selected, {"a": candidate("c", other)}) is selected


def test_what_changed_is_told_in_the_order_of_the_effects():
    one, two = Model(3000.0, size=12), Model(1000.0, size=14)
    base = Base(5000.0, {"a": one, "ab": two})
    chosen = [candidate("a"), candidate("b")]
    selected, history = selection._retraced(base, chosen, two, None, "first")
    assert [c.model for c in selected] == [one, two]
    assert history == ["first", None, None]
    scatter = 3000 / (N_DATA - 12)
    assert selected[0].gain == pytest.approx(2000 / scatter)
    assert selected[0].evidence == pytest.approx(2000 / scatter - 2 * np.log(N_DATA - 12))
    assert selected[1].gain == pytest.approx(2000 / (1000 / (N_DATA - 14)))


# ---- looking ahead -------------------------------------------------------------------------


@pytest.fixture
def ahead(monkeypatch):
    """Look ahead among fitted effects, with the second that each would be given."""

    def run(fitted, seconds, start=5000.0):
        monkeypatch.setattr(selection, "contenders", lambda *args, **options: fitted)
        monkeypatch.setattr(selection, "scan", lambda model, library: model)
        monkeypatch.setattr(
            selection, "choose", lambda model, scores, **options: seconds.get(id(model))
        )
        return selection._looking_ahead(Model(start), [], alpha=0.01)

    return run


def test_the_first_effect_is_the_one_that_does_best_with_a_second(ahead):
    a, b = candidate("a", Model(2000.0)), candidate("b", Model(2500.0))
    second = {
        id(a.model): candidate("c", Model(1900.0, size=12)),
        id(b.model): candidate("a", Model(1000.0, size=12)),
    }
    assert ahead([a, b], second) is b


def test_two_that_do_as_well_with_the_same_second_are_aliases(ahead):
    a, b = candidate("a", Model(2000.0)), candidate("b", Model(2001.0))
    second = {
        id(a.model): candidate("c", Model(1000.0, size=12)),
        id(b.model): candidate("c", Model(1001.0, size=12)),
    }
    best = ahead([a, b], second)
    assert best is a
    assert names(best.aliases) == ["b"]
    second[id(b.model)] = candidate("d", Model(1001.0, size=12))
    assert ahead([a, b], second).aliases == []


def test_where_little_is_left_nobody_looks_ahead(ahead, monkeypatch):
    a = candidate("a", Model(1000.0))
    monkeypatch.setattr(selection, "best_of", lambda fitted: "the best")
    assert ahead([a], {}) == "the best"
    assert ahead([], {}) == "the best"


def test_if_nothing_is_possible_the_best_comes_first(ahead):
    a = candidate("a", Model(2000.0), physical=False)
    assert ahead([a], {}) is a
