# Licensed under a 3-clause BSD style license - see LICENSE
"""Evidence for cells and named effects beside a fitted model."""

import gap_data as data
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from astropolcal.gap.attribution import NAMED, Candidate, false_discovery, scan
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import EFFECTS, get_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.model import Model
from astropolcal.gap.problem import Fit

SMOOTH = [effect for effect in EFFECTS.values() if effect.kind != "discrete"]
GAIN = Cell("detector", "gain", "constant")


@pytest.fixture(scope="module")
def model():
    return data.fitted(data.observed(data.with_effect("beam_gain", imbalance=0.005), flux=1e7))


@pytest.fixture(scope="module")
def found(model):
    return scan(model, SMOOTH)


# ---- the Bayes factor --------------------------------------------------------------------------


def marginal(columns, target, size, temper):
    """Return the log evidence for two coefficients of a normal prior, by sums over a grid."""
    axis = np.linspace(-8, 8, 121) * size
    one, other = np.meshgrid(axis, axis, indexing="ij")
    left = target[:, None, None] - columns[:, :1, None] * one - columns[:, 1:, None] * other
    log = -0.5 * (np.sum(left**2, axis=0) - np.sum(target**2)) / temper
    log -= 0.5 * (one**2 + other**2) / size**2 + np.log(2 * np.pi * size**2)
    return np.logaddexp.reduce(log, axis=None) + 2 * np.log(axis[1] - axis[0])


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 4.0]))
def test_evidence_is_the_marginal_likelihood(seed, temper):
    """Averaged over four sizes of the prior, from a hundredth of the usual one to ten times it."""
    rng = np.random.default_rng(seed)
    columns, target = rng.normal(size=(6, 2)) / 3, 2 * rng.normal(size=6)
    values, vectors = np.linalg.eigh(columns.T @ columns)
    share = (vectors.T @ columns.T @ target) ** 2 / values
    one = Candidate(None, GAIN, share.sum(), 2, 0.0, 1.5, (values, share, 0.3))
    each = [marginal(columns, target, size, temper) for size in (0.003, 0.03, 0.3, 3.0)]
    expected = np.logaddexp.reduce(each) - np.log(4) + 1.5
    assert one.tempered(temper).evidence == pytest.approx(expected, abs=0.02)
    # the more the residuals scatter, the less a cause can gain
    assert one.tempered(2 * temper).statistic == one.statistic


@given(st.lists(st.floats(0, 1), max_size=12))
def test_false_discovery_rate(p_values):
    """Benjamini & Yekutieli (2001): p m H_m / rank, made monotonous from above."""
    found, m = false_discovery(p_values), len(p_values)
    order = np.argsort(p_values)
    rank = np.arange(1, m + 1)
    adjusted = np.array(p_values)[order] * m * np.sum(1 / rank) / rank
    adjusted = np.minimum.accumulate(adjusted[::-1])[::-1].clip(max=1)
    np.testing.assert_allclose(np.array(found)[order], adjusted, atol=1e-12)


# ---- the scan ----------------------------------------------------------------------------------


def test_statistic_is_the_squared_projection_of_the_residual(model, found):
    tangent = model.problem.tangent(model.fit.coefficients)
    left = model.residual - tangent @ (tangent.T @ model.residual)
    by_name = {one.name: one for one in found.candidates}
    asked = [
        GAIN,
        Cell("source", "retardance_d", "time"),
        Cell("in:derotator", "rotation", "harmonic:derotator:2"),
        Cell("after:hwp", "diattenuation_c", "step:9"),
        Cell("detector", "nonlinearity", "flux"),
    ]
    for one in [by_name[cell.name] for cell in asked] + [by_name["hwp_diattenuation"]]:
        basis = data.effect_basis(model, one.effect, tangent)
        expected = np.sum((basis.T @ left) ** 2)
        assert one.statistic == pytest.approx(expected, rel=0.05, abs=0.2), one.name
        assert one.p_value == pytest.approx(stats.chi2.sf(one.statistic, one.rank))


def test_statistic_and_evidence_predict_those_of_the_full_fit(model, found):
    for name in (GAIN.name, "beam_gain"):
        one = next(one for one in found.candidates if one.name == name)
        better = model.with_effect(*one.recipe)
        gained = model.fit.chi2 - better.fit.chi2
        assert one.statistic == pytest.approx(gained, rel=0.02)
        for temper in (1.0, 3.0):
            promised = one.tempered(temper).evidence - one.prior
            kept = gained / 2 / temper - better.costs(temper)[name]
            assert promised == pytest.approx(kept, rel=0.02), (name, temper)


def test_what_the_data_leave_open_costs_nothing(model):
    """There is no circular polarization before the first optic; a retardance makes some of it."""
    for kind, is_open in (("depolarization_circular", True), ("retardance_d", False)):
        cell, found = CellEffect(Cell("source", kind, "constant"), 0), []
        added = model.edited((cell, None))
        for size in (0.0, 0.5):
            q = added.fit.coefficients.copy()
            q[added.problem.numbers(p.name for p in added.added[cell.name])] = size
            fit = Fit(q, 0.0, True)
            found.append(Model(added.problem, fit, added.added).costs(1.0)[cell.name])
        if is_open:
            np.testing.assert_allclose(found, 0, atol=1e-9)
        else:
            assert found[1] > found[0] + 3 > 5


def test_another_component_of_an_optic_that_is_a_cause_is_as_good_as_a_name(model):
    """An elliptical derotator was given as a retarder and an anisotropic depolarizer."""
    asked = {
        "in:derotator/rotation/constant": True,
        "in:derotator/rotation/time": False,
        "in:hwp/retardance_h/constant": False,
        "after:derotator/depolarization_d/constant": False,
    }
    own = CellEffect(Cell("in:derotator", "retardance_d", "constant"), 0)
    before, after = (
        {one.name: one.prior for one in scan(each).candidates}
        for each in (model, model.edited((own, None)))
    )
    for name, favoured in asked.items():
        expected = before[name] + favoured * np.log(NAMED)
        assert after[name] == pytest.approx(expected), name


def test_every_question_is_asked_once_and_the_best_answer_comes_first(model, found):
    evidence = [one.evidence for one in found.candidates]
    names = [one.name for one in found.candidates]
    # of what does the same, the name decides and not the rounding
    order = [(-round(value, 3), name) for value, name in zip(evidence, names, strict=True)]
    assert order == sorted(order)
    assert len(set(names)) == len(names)
    assert {found.best.name, names[1]} == {"beam_gain", GAIN.name}
    # of the library only, and of the cells only
    few = scan(model, SMOOTH, cells=False)
    assert {one.name for one in few.candidates} == {o.name for o in found.candidates if o.is_named}
    assert not any(one.is_named for one in scan(model).candidates)
    # what the model takes up, what has no place in it and what it has already are no questions
    asked = ["beam_crosstalk", "m3_diattenuation"]
    assert scan(model, [get_effect(name) for name in asked], cells=False).best is None
    better = model.with_effect(EFFECTS["beam_gain"]).with_effect(CellEffect(GAIN, 0))
    left = {one.name for one in scan(better, SMOOTH).candidates}
    assert left.isdisjoint({"beam_gain", GAIN.name})
    assert len(left) > 1000


def test_a_name_has_the_evidence_of_its_cell_and_its_prior_odds(model, found):
    by_name = {one.name: one for one in found.candidates}
    name, cell = by_name["beam_gain"], by_name[GAIN.name]
    assert name.cell == cell.cell
    assert name.prior == pytest.approx(np.log(NAMED))
    assert cell.prior == 0
    # both with the law that the data ask for
    (again,) = found.named_as(cell, SMOOTH)
    assert again.name == "beam_gain"
    assert again.statistic == pytest.approx(cell.statistic, rel=1e-6)
    assert again.evidence == pytest.approx(cell.evidence + np.log(NAMED), abs=1)
    # beside a model that has it, it has no other name
    assert scan(model.with_effect(EFFECTS["beam_gain"])).named_as(cell, SMOOTH) == []


def test_a_name_has_the_same_evidence_alone_and_among_all_others(model, found):
    """Also those that exchange one optic, of which only one can be in the chain at a time."""
    together = {one.name: one.evidence for one in found.candidates if one.is_named}
    for effect in SMOOTH:
        alone = scan(model, [effect], cells=False).best
        assert (alone is None) == (effect.name not in together), effect.name
        if alone is not None:
            assert together[effect.name] == pytest.approx(alone.evidence, abs=1e-4), effect.name
    assert "derotator_elliptical_retardance" in together


def test_a_law_is_freed_where_the_data_ask_for_it():
    """A gain at one wavelength alone is no curve of second degree."""
    true = data.with_effect("beam_gain")
    true["gap_beam_gain"].imbalance = np.where(np.arange(len(data.WAVELENGTH)) == 2, 0.02, 0.0)
    model = data.fitted(data.observed(true))
    found = scan(model, [EFFECTS["beam_gain"]])
    for name in ("beam_gain", GAIN.name):
        stiff = next(one for one in found.candidates if one.name == name)
        loose = found.freer(stiff)
        assert loose.name == name
        assert loose.rank == len(data.WAVELENGTH)
        assert loose.evidence > stiff.evidence + 50
        left = model.with_effect(*loose.recipe)
        assert left.fit.chi2 < 0.5 * model.with_effect(*stiff.recipe).fit.chi2
        assert left.p_value > 1e-3
    # among noise there is nothing to gain
    quiet = scan(data.clean_model())
    for one in quiet.candidates[:3]:
        assert 0 <= quiet.freer(one).evidence - one.evidence < 3


@pytest.mark.slow
def test_of_noise_statistics_are_chi_square_with_their_rank(found):
    values, ranks = [], []
    for seed in range(6):
        quiet = scan(data.clean_model(seed))
        # of real structure all of the cells see something
        middle, seen = (
            np.median([one.statistic for one in each.candidates]) for each in (quiet, found)
        )
        assert seen > 2 * middle
        # cells are no independent tests: two that have nothing to do with each other
        for cell in (GAIN, Cell("in:derotator", "diattenuation_h", "constant")):
            (one,) = [c for c in quiet.candidates if c.name == cell.name]
            values.append(one.statistic)
            ranks.append(one.rank)
    assert 1e-3 < stats.chi2.sf(np.sum(values), np.sum(ranks)) < 0.999


@pytest.mark.slow
def test_a_law_of_one_number_has_the_data_of_all_wavelengths():
    for bins in ([0, 6], [0, 3, 6], [0, 2, 4, 6]):
        wavelength = data.WAVELENGTH[bins]
        model = data.fitted(data.observed(wavelength=wavelength), [data.chain(wavelength)])
        found = scan(model)
        constant = [one for one in found.candidates if one.degree == 0]
        assert len(constant) > 50
        for one in constant:
            alone = found.of_cell(one.cell, 0)
            assert one.evidence == pytest.approx(alone.evidence, abs=1e-6), (bins, one.name)
