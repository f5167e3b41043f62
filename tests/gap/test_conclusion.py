# Licensed under a 3-clause BSD style license - see LICENSE
"""The verdict, shares and gaps of a diagnosis; alternatives."""

from types import SimpleNamespace

import astropy.units as u
import gap_data as data
import numpy as np
import pytest

from astropolcal.exceptions import GapError
from astropolcal.gap import alternatives
from astropolcal.gap.alternatives import thinned
from astropolcal.gap.attribution import Candidate
from astropolcal.gap.diagnosis import _conclude, _library
from astropolcal.gap.effects import EFFECTS, get_effect
from astropolcal.gap.shrinkage import HeldOut

N_DATA, SIZE = 1010, 10


class Model:
    """Chi-square and probability of a fitted model; the noise expects 1000."""

    def __init__(self, chi2, p_value=0.5, impossible=()):
        self.fit = SimpleNamespace(chi2=chi2)
        self.problem = SimpleNamespace(n_data=N_DATA, size=SIZE)
        self.p_value, self._impossible = p_value, impossible

    def is_physical(self, name):
        return name not in self._impossible


def candidate(name, model, physical=True, aliases=()):
    score = SimpleNamespace(effect=get_effect(name), p_value=1e-9)
    others = [SimpleNamespace(name=alias) for alias in aliases]
    return Candidate(score, model, 0.0, 12.0, physical, others)


def conclude(nominal, improved, selected=(), causes=(), history=None):
    history = [None] * (len(selected) + 1) if history is None else history
    return _conclude(nominal, improved, list(causes), list(selected), [], history, 0.01, 0.0)


# ---- verdicts ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "p_value", "verdict"),
    [
        # what leaves noise is the effect, however little it explains
        (1500.0, 0.5, "effect"),
        # and what explains more than four fifths of an excess of 1000
        (1150.0, 1e-9, "effect"),
        (1250.0, 1e-9, "unexplained"),
    ],
)
def test_verdict_with_causes(left, p_value, verdict):
    improved = Model(left, p_value)
    found = conclude(Model(2000.0, 0.0), improved, [candidate("beam_gain", improved)])
    assert found.verdict == verdict
    assert found.causes[0].explained == pytest.approx((2000 - left) / 1000)


@pytest.mark.parametrize(("p_value", "verdict"), [(0.3, "none"), (1e-9, "unexplained")])
def test_verdict_without_causes(p_value, verdict):
    model = Model(1100.0, p_value)
    assert conclude(model, model).verdict == verdict


def test_shares_of_several_causes_add_up():
    first, last = Model(1600.0), Model(1050.0)
    selected = [candidate("beam_gain", first), candidate("hwp_tilt", last)]
    found = conclude(Model(2000.0), last, selected)
    assert [c.explained for c in found.causes] == pytest.approx([0.4, 0.55])


def test_a_gap_within_the_noise_is_not_explained_more_than_wholly():
    """Noise alone expects 1000; an effect lowers 990 by 40 nevertheless."""
    last = Model(950.0)
    found = conclude(Model(990.0), last, [candidate("beam_gain", last)])
    assert found.causes[0].explained == pytest.approx(1.0)


def test_what_became_impossible_next_to_the_others_is_called_so():
    last = Model(1050.0, impossible=["beam_gain"])
    first = candidate("beam_gain", Model(1600.0), aliases=["background"])
    found = conclude(Model(2000.0), last, [first, candidate("hwp_tilt", last)])
    assert [c.physical for c in found.causes] == [False, True]
    assert found.causes[0].aliases == ["background"]
    assert (found.causes[1].evidence, found.causes[1].p_value) == (12.0, 1e-9)


def test_every_cause_has_the_errors_before_and_after_it():
    one, two = Model(1600.0), Model(1050.0)
    history = ["base", "with one", "with both"]
    selected = [candidate("beam_gain", one), candidate("hwp_tilt", two)]
    found = conclude(Model(2000.0), two, selected, history=history)
    assert [(c.before, c.after) for c in found.causes] == [
        ("base", "with one"),
        ("with one", "with both"),
    ]
    # an alternative was not checked on left-out frames
    flip = candidate("mirror_flip", one)
    found = conclude(Model(9000.0), two, selected[1:], [flip], history[1:])
    assert (found.causes[0].before, found.causes[0].after) == (None, None)
    assert found.causes[1].before == "with one"


def test_gaps_are_those_of_left_out_frames_if_there_are_any():
    model = data.clean_model()
    errors = [
        HeldOut([""], np.array([square]), np.ones(1), np.array([100])) for square in (0.04, 0.01)
    ]
    found = conclude(Model(2000.0), Model(1000.0), [candidate("beam_gain", Model(1000.0))])
    found.nominal = found.improved = model
    of_fit = 100 * np.sqrt(np.mean(model.problem.differences(model.fit.coefficients)[0][0] ** 2))
    assert found.gap_before_percent == pytest.approx(of_fit)
    assert found.gap_after_percent == pytest.approx(of_fit)
    found.held_out = errors
    assert (found.gap_before_percent, found.gap_after_percent) == pytest.approx((2.0, 1.0))
    # where an optic was exchanged the nominal model has no prediction
    found.causes[0].effect = get_effect("mirror_flip")
    assert found.gap_before_percent == pytest.approx(of_fit)
    assert "mirror_flip" in repr(found) or "beam_gain" in repr(found)


def test_noise_floor_is_the_root_mean_square_of_the_errors():
    found = conclude(Model(1000.0), Model(1000.0))
    found.nominal = SimpleNamespace(
        problem=SimpleNamespace(
            channels=[
                SimpleNamespace(
                    sigma=np.array([[[0.01, 9.0], [0.03, 0.01]]] * 2),
                    valid=np.array([[True, False], [True, True]]),
                )
            ]
        )
    )
    assert found.noise_floor_percent == pytest.approx(100 * np.sqrt(11e-4 / 3))


# ---- the library that is asked -------------------------------------------------------------


def test_effects_may_be_named_or_given():
    assert _library("all") == list(EFFECTS.values())
    assert [e.name for e in _library("beam_gain")] == ["beam_gain"]
    own = get_effect("m3_diattenuation:m4")
    assert _library([own, "beam_gain"]) == [own, get_effect("beam_gain")]
    with pytest.raises(GapError, match="no effects to ask for; give names, or 'all'"):
        _library(())


# ---- alternatives --------------------------------------------------------------------------


def calibration(observed, residual, sigma=np.nan):
    """A calibration with double differences of this size, residual and error."""
    part = SimpleNamespace(observed=np.full(20, observed), sigma=np.full(20, sigma))
    measurement = SimpleNamespace(
        datasets=[part], residuals=lambda: residual * np.resize([1.0, -1.0], 20)
    )
    return SimpleNamespace(measurement=measurement)


@pytest.mark.parametrize(
    ("observed", "residual", "sigma", "wrong"),
    [
        # two percent is a sign that may be wrong, whatever the signal
        (0.9, 0.021, 1e-3, True),
        (0.9, 0.019, 1e-3, False),
        # of a small signal a third is enough, if it is above the noise
        (0.01, 0.004, 1e-3, True),
        (0.01, 0.004, 2e-3, False),
        (0.01, 0.002, 1e-4, False),
        # what has no stated errors has no noise to compare with
        (0.01, 0.004, np.nan, True),
    ],
)
def test_when_a_sign_may_be_wrong(observed, residual, sigma, wrong):
    assert alternatives._may_be_wrong(calibration(observed, residual, sigma)) == wrong


def test_misfit_is_the_root_mean_square():
    assert alternatives._misfit(calibration(0.5, 0.03)) == pytest.approx(0.03)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_thinned_data_are_spread_over_the_wavelengths(count):
    chains, (few,) = thinned([data.chain()], [data.observed()], count)
    grid = data.WAVELENGTH.value
    assert few.n_bins == count
    assert np.size(chains[0]["derotator"].retardance.value) == count
    found = few.wavelength.to_value(u.nm)
    assert found[0] == pytest.approx(grid[0])
    assert count == 1 or found[-1] == pytest.approx(grid[-1])
    # parameters are those at these wavelengths
    picked = np.isin(np.round(grid), np.round(found))
    whole = data.chain()["derotator"].retardance.value
    np.testing.assert_allclose(chains[0]["derotator"].retardance.value, whole[picked])


def test_few_wavelengths_are_all_kept():
    chain, observations = data.chain(), data.observed()
    chains, kept = thinned([chain], [observations], 7)
    assert chains[0] is chain
    assert kept[0] is observations


def test_without_alternatives_nothing_is_tried():
    assert alternatives._tried(None, None, [], None) == []


def test_chains_and_datasets_go_together():
    with pytest.raises(GapError, match="2 chains for 1 datasets"):
        alternatives.starting_model([data.chain()] * 2, [data.observed()], [], print)
