# Licensed under a 3-clause BSD style license - see LICENSE
"""Scores, false discoveries, alias groups: the rules by which effects are compared."""

from types import SimpleNamespace

import gap_data as data
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from astropolcal.gap import attribution
from astropolcal.gap.attribution import (
    SAME_EVIDENCE,
    Candidate,
    Score,
    best_of,
    choose,
    contenders,
    false_discovery,
    freed,
    scan,
)
from astropolcal.gap.effects import EFFECTS, get_effect


def effect(name):
    return SimpleNamespace(name=name)


def score(name="a", statistic=100.0, rank=1, p_value=1e-9, scale=1.0):
    return Score(effect(name), statistic, rank, None, scale, p_value)


class Fitted:
    """What the comparison asks of a fitted model."""

    def __init__(self, chi2, *, n_data=1000, size=0, physical=True, converged=True, then=None):
        self.fit = SimpleNamespace(chi2=chi2, converged=converged)
        self.problem = SimpleNamespace(n_data=n_data, size=size)
        self.physical, self.then = physical, then

    def is_physical(self, name):
        return self.physical

    def polished(self):
        return self.then


class Base(Fitted):
    """A model to which effects are added: each leaves the chi-square given for its name."""

    def __init__(self, chi2, left):
        super().__init__(chi2)
        self.left, self.asked = left, []

    def with_effect(self, effect, **settings):
        self.asked.append(effect.name)
        found = self.left[effect.name]
        return found if isinstance(found, Fitted) else Fitted(found)


def names(candidates):
    return [c.name for c in candidates]


# ---- scores --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("statistic", "rank", "expected"),
    # quantiles of chi-square at 5 % from its table
    [(3.841, 1, 0.05), (5.991, 2, 0.05), (18.307, 10, 0.05), (0.0, 3, 1.0)],
)
def test_probability_of_a_score(statistic, rank, expected):
    assert score(statistic=statistic, rank=rank).single_p == pytest.approx(expected, rel=2e-3)
    twice = score(statistic=2 * statistic, rank=rank, scale=2.0)
    assert twice.single_p == pytest.approx(expected, rel=2e-3)


def test_evidence_costs_a_logarithm_a_parameter():
    one = score(statistic=60.0, rank=3, scale=2.0)
    assert one.evidence(1000) == pytest.approx(30 - 3 * np.log(1000))


# ---- false discoveries ---------------------------------------------------------------------


def by_hand(p_values):
    """Benjamini & Yekutieli (2001): p m H_m / rank, made monotonous from above."""
    p = np.asarray(p_values, dtype=float)
    m = len(p)
    order = np.argsort(p)
    adjusted = p[order] * m * np.sum(1 / np.arange(1, m + 1)) / np.arange(1, m + 1)
    adjusted = np.minimum.accumulate(adjusted[::-1])[::-1].clip(max=1)
    out = np.empty(m)
    out[order] = adjusted
    return out


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_false_discovery_rate(p_values):
    found = false_discovery(p_values)
    np.testing.assert_allclose(found, by_hand(p_values), atol=1e-12)
    assert np.all(np.array(found) >= np.array(p_values) - 1e-12)


def test_no_look_is_no_discovery():
    assert false_discovery([]) == []
    assert false_discovery([0.03]) == [0.03]


# ---- the best, and what cannot be told from it ---------------------------------------------


def candidate(name, evidence, physical=True):
    return Candidate(score(name), None, evidence, evidence, physical)


def test_aliases_are_nearly_as_good_and_possible():
    fitted = [
        candidate("best", 100.0),
        candidate("near", 100.0 - SAME_EVIDENCE + 0.1),
        candidate("impossible", 99.0, physical=False),
        candidate("far", 100.0 - SAME_EVIDENCE),
    ]
    assert names(best_of(fitted).aliases) == ["near"]
    assert best_of([]) is None


def test_only_what_is_significant_and_worth_it_is_fitted():
    base = Base(2000.0, dict.fromkeys("abcd", 1000.0))
    scores = [
        score("a", 900.0),
        score("b", 300.0),
        score("c", 800.0, p_value=0.5),
        score("d", 895.0),
    ]
    assert sorted(names(contenders(base, scores))) == ["a", "d"]
    assert base.asked == ["a", "d"]
    # with a small best one everything within 20 of it is tried
    base = Base(1100.0, dict.fromkeys("ab", 1000.0))
    contenders(base, [score("a", 30.0), score("b", 12.0)])
    assert base.asked == ["a", "b"]


def test_no_more_are_fitted_than_asked_for():
    base = Base(2000.0, dict.fromkeys("abc", 1000.0))
    contenders(base, [score(n, 900.0) for n in "abc"], most=2)
    assert base.asked == ["a", "b"]


def test_the_full_fit_decides_and_not_the_scan():
    base = Base(2000.0, {"a": 1500.0, "b": 1000.0})
    best, other = contenders(base, [score("a", 900.0), score("b", 850.0)])
    assert (best.name, other.name) == ("b", "a")
    # both by the scatter that the best one leaves: 1 here
    assert best.gain == pytest.approx(1000.0)
    assert best.evidence == pytest.approx(1000.0 - np.log(1000))
    assert other.gain == pytest.approx(500.0)


def test_all_are_measured_by_the_scatter_of_the_best():
    base = Base(9000.0, {"a": 4000.0, "b": 8000.0})
    best, other = contenders(base, [score("a", 5000.0), score("b", 4000.0)])
    assert best.gain == pytest.approx(5000 / 4)
    assert other.gain == pytest.approx(1000 / 4)


@pytest.mark.parametrize("rounding", [-1e-9, 0.0, 1e-9])
def test_what_fits_equally_well_stays_in_the_order_of_the_library(rounding):
    base = Base(2000.0, {"a": 1000.0, "b": 1000.0 + rounding, "c": 999.0})
    found = contenders(base, [score(name, 900.0) for name in "abc"])
    assert names(found) == ["c", "a", "b"]


def test_the_impossible_comes_last_though_it_fits_best():
    base = Base(2000.0, {"a": Fitted(1000.0, physical=False), "b": 1400.0})
    first, last = contenders(base, [score("a", 900.0), score("b", 880.0)])
    assert (first.name, last.name) == ("b", "a")
    assert choose(base, [score("a", 900.0), score("b", 880.0)]).aliases == []


def test_what_does_nothing_within_its_bounds_is_no_candidate():
    """The scan looks at both directions, one of which may be closed."""
    base = Base(2000.0, {"a": 1999.5, "b": Fitted(1400.0, physical=False)})
    assert names(contenders(base, [score("a", 900.0), score("b", 880.0)])) == ["b"]
    assert contenders(base, [score("a", 900.0)]) == []


def test_a_fit_that_was_cut_short_is_carried_on_if_it_may_win():
    end = Fitted(1000.0)
    left = {"a": Fitted(1100.0, converged=False, then=end), "b": Fitted(1990.0, converged=False)}
    first, second = contenders(Base(2000.0, left), [score("a", 900.0), score("b", 880.0)])
    assert first.model is end
    assert first.gain == pytest.approx(1000.0)
    # what is far behind stays as it is
    assert second.model.fit.converged is False


def test_choose_takes_the_limits_of_contenders():
    base = Base(2000.0, dict.fromkeys("ab", 1000.0))
    assert choose(base, [score("a", p_value=1e-3)], alpha=1e-4) is None
    assert choose(base, [score("a", p_value=1e-3)], alpha=1e-2).name == "a"
    assert choose(base, [score("a"), score("b")], most=1).aliases == []


# ---- on data -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gain_model():
    return data.fitted(data.observed(data.with_effect("beam_gain", imbalance=0.005)))


def test_scan_is_ordered_by_evidence_and_corrected(gain_model):
    effects = [EFFECTS[n] for n in ("hwp_diattenuation", "beam_gain", "derotator_encoder")]
    found = scan(gain_model, effects)
    freedom = gain_model.problem.n_data - gain_model.problem.size
    evidence = [one.evidence(freedom) for one in found]
    assert evidence == sorted(evidence, reverse=True)
    assert found[0].effect.name == "beam_gain"
    single = [one.single_p for one in found]
    np.testing.assert_allclose([one.p_value for one in found], by_hand(single), rtol=1e-9)


def test_statistic_is_the_squared_projection_of_the_residual(gain_model):
    (one,) = scan(gain_model, [EFFECTS["beam_gain"]])
    tangent = gain_model.problem.tangent(gain_model.fit.coefficients)
    assert np.abs(tangent.T @ one.basis).max() < 1e-9
    np.testing.assert_allclose(one.basis.T @ one.basis, np.eye(one.rank), atol=1e-9)
    left = gain_model.residual - tangent @ (tangent.T @ gain_model.residual)
    assert one.statistic == pytest.approx(np.sum((one.basis.T @ left) ** 2))
    # a law of second degree
    assert one.rank == 3
    total = left @ left - one.statistic
    freedom = gain_model.problem.n_data - tangent.shape[1] - 3
    assert one.scale == pytest.approx(max(1.0, total / freedom))


def test_effects_without_a_question_are_not_scored(gain_model):
    absorbed = get_effect("beam_crosstalk")
    elsewhere = get_effect("m3_diattenuation")
    assert absorbed.absorbed_by == "wollaston.efficiency"
    assert scan(gain_model, [absorbed, elsewhere]) == []
    better = gain_model.with_effect(EFFECTS["beam_gain"])
    assert scan(better, [EFFECTS["beam_gain"]]) == []


def test_of_noise_the_statistic_is_chi_square_with_its_rank():
    values = []
    for seed in range(12):
        (one,) = scan(data.clean_model(seed), [EFFECTS["beam_gain"]])
        values.append(one.statistic)
    # the sum of twelve is chi-square with 36 degrees of freedom
    assert 1e-3 < stats.chi2.sf(np.sum(values), 3 * len(values)) < 0.999


def test_a_law_is_freed_where_the_data_ask_for_it():
    """A gain at one wavelength alone is no law of second degree."""
    true = data.with_effect("beam_gain")
    true["gap_beam_gain"].imbalance = np.where(np.arange(len(data.WAVELENGTH)) == 2, 0.02, 0.0)
    model = data.fitted(data.observed(true))
    stiff = choose(model, scan(model, [EFFECTS["beam_gain"]]))
    loose = freed(model, stiff)
    assert loose is not stiff
    assert loose.context.degree is None
    assert loose.model.fit.chi2 < 0.5 * stiff.model.fit.chi2
    assert loose.name == stiff.name
    n = len(data.WAVELENGTH)
    scale = max(1.0, loose.model.fit.chi2 / (model.problem.n_data - loose.model.problem.size))
    freedom = model.problem.n_data - loose.model.problem.size
    cost = (stiff.score.rank + n - 3) * np.log(freedom)
    assert loose.evidence == pytest.approx((model.fit.chi2 - loose.model.fit.chi2) / scale - cost)


def test_an_effect_without_a_law_cannot_be_freed(monkeypatch):
    true = data.with_effect("derotator_encoder", cosine=0.3)
    model = data.fitted(data.observed(true))
    fitted = model.with_effect(EFFECTS["derotator_encoder"])
    one = Candidate(score("derotator_encoder"), fitted, 1.0, 1.0, True)
    one.score.effect = EFFECTS["derotator_encoder"]
    assert freed(model, one) is one
    assert attribution.MOST_REFITTED == 8
