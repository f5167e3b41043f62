# Licensed under a 3-clause BSD style license - see LICENSE
"""Models with effects added: sizes within their limits, and what has no place."""

from types import SimpleNamespace

import astropy.units as u
import gap_data as data
import numpy as np
import pytest
from gap_setups import SETUPS

from astropolcal import instruments
from astropolcal.gap import diagnose
from astropolcal.gap.alternatives import starting_model
from astropolcal.gap.challenge import Setup, make_challenge
from astropolcal.gap.effects import Context, get_effect
from astropolcal.gap.model import Model, nominal_model
from astropolcal.gap.problem import Fit, GapProblem
from astropolcal.gap.report import Fitted, to_dict
from astropolcal.observations import Observations
from astropolcal.simulation import simulate

DIATTENUATOR = "static_diattenuator"


@pytest.fixture(scope="module")
def strong():
    """Data with a static diattenuator beyond what the library takes for possible."""
    true = data.with_effect(DIATTENUATOR, horizontal=0.5)
    return data.fitted(data.observed(true, flux=1e7))


def sizes(model, key="horizontal"):
    return np.array(Fitted(model).sizes(DIATTENUATOR)[f"gap_{DIATTENUATOR}.{key}"]["value"])


def test_a_free_size_stays_within_its_limit_and_counts_as_impossible(strong):
    context = Context(strong.context.wavelength, strong.context.flux, None)
    model = strong.with_effect(get_effect(DIATTENUATOR), context)
    assert np.abs(sizes(model)).max() == pytest.approx(0.3)
    assert not model.is_physical(DIATTENUATOR)
    assert not model.is_physical(DIATTENUATOR)


def test_a_possible_size_is_found_as_it_is():
    true = data.with_effect(DIATTENUATOR, horizontal=0.2)
    model = data.fitted(data.observed(true, flux=1e7))
    context = Context(model.context.wavelength, model.context.flux, None)
    model = model.with_effect(get_effect(DIATTENUATOR), context)
    np.testing.assert_allclose(sizes(model), 0.2, atol=0.003)
    assert model.is_physical(DIATTENUATOR)


def test_one_wavelength_at_the_limit_of_many_is_no_reason(strong, monkeypatch):
    model = strong.with_effect(get_effect(DIATTENUATOR))
    slot = model.problem.free.by_name[f"gap_{DIATTENUATOR}.horizontal"]
    values = np.zeros(model.problem.free.size)
    values[slot.start] = 0.3
    monkeypatch.setattr(model.problem, "vector", lambda coefficients: values)
    monkeypatch.setattr("astropolcal.gap.model._MOST_PRESSED", 0.5)
    assert model.is_physical(DIATTENUATOR)
    monkeypatch.setattr("astropolcal.gap.model._MOST_PRESSED", 0.1)
    assert not model.is_physical(DIATTENUATOR)


def test_a_depolarizer_gains_no_polarization():
    """What is retained counts from a level that the efficiency takes up: the law stops at one."""
    name = "anisotropic_depolarizer"
    model = data.fitted(data.observed(_retaining(np.linspace(1.0, 1.1, 7)), flux=1e8))
    free = Context(model.context.wavelength, model.context.flux, None)
    for context in (None, free):
        added = model.with_effect(get_effect(name), context)
        slot = added.problem.free.by_name[f"gap_{name}.retained_q"]
        values = added.problem.vector(added.fit.coefficients)[slot.slice]
        assert values.max() == pytest.approx(1.0, abs=1e-6)
        assert added.is_physical(name)
        assert 0 < added.at_bound(name) < 7
        assert added.fit.chi2 < 0.02 * model.fit.chi2


def test_bounds_that_no_optic_has_do_not_make_a_size_possible():
    """An effect of a user may set bounds of its own: the Mueller matrix is not one then."""

    effect = get_effect("anisotropic_depolarizer")
    wide = effect.changed(inserted=effect.inserted.copy())
    wide.inserted.retained_q.bounds = (0, 1.5)
    edited = data.clean_model().edited((wide, None))
    problem, parameters = edited.problem, edited.added[wide.name]
    for size, possible in ((0.9, True), (1.1, False)):
        q = problem.start.copy()
        q[problem.slices[parameters[0].name]] = size, 0.0, 0.0
        model = Model(problem, Fit(q, 0.0, True), {wide.name: parameters})
        assert model.is_physical(wide.name) == possible, size


def _retaining(share):
    """Return a chain with a depolarizer, of a low efficiency: there is room for more Q."""
    true = data.with_effect("anisotropic_depolarizer", retained_q=share)
    true["gap_anisotropic_depolarizer"].retained_v = share
    true["wollaston"].efficiency = np.full(len(data.WAVELENGTH), 0.85)
    return true


def test_an_effect_without_a_place_is_left_out():
    model = data.clean_model()
    assert not get_effect("m3_diattenuation").applies(model.chains)
    assert model.with_effects([(get_effect("m3_diattenuation"), None)]) is model


def test_a_mounting_that_is_known_is_a_datum():
    """A mirror that is 9 deg off costs what its prior says, and is named."""
    fault = {"type": "listed", "effect": "mirror_misalignment"}
    observations, chains, _ = make_challenge([5, 1], kind="listed", snr=40.0, fault=fault)
    nominal = nominal_model(chains, observations)
    assert nominal.problem.known
    assert nominal.p_value < 1e-6
    free = nominal.with_effects([(get_effect("mirror_misalignment"), None)])
    assert free.p_value > 1e-3
    angle = Fitted(free).sizes("mirror_misalignment")["fold_mirror.theta"]
    assert angle["unit"] == "deg"
    assert abs(angle["value"]) > 3


@pytest.mark.slow
def test_wavelengths_in_a_wrong_mirror_branch_are_no_gap():
    """Noise puts one there in double differences, and a bad frame that is gone by now did."""
    settings = {"wavelength": data.WAVELENGTH, "derotator": "linear"}
    chain = instruments.get("charis").chain("unpolarized", **settings)
    true = chain.copy()
    true["hwp"].w_sio2, true["hwp"].w_mgf2 = 1.651 * u.mm, 1.290 * u.mm
    true["fold_mirror"].diattenuation = np.linspace(0.006, 0.014, 7)
    for flux, seed in ((1e6, 0), (1e6, 5), (1e7, 5)):
        observed = [simulate(true, data.WAVELENGTH, data.frames(), flux=flux, seed=seed)]
        found = nominal_model([chain], observed)
        lowest = GapProblem([true], observed, like=found.problem).fit().chi2
        assert found.fit.chi2 < lowest * 1.001, (flux, seed, lowest)
    bent = data.chain()
    turned = np.where(np.arange(7) == 3, -1, 1)
    bent["derotator"].retardance = bent["derotator"].retardance.quantity * turned
    bent["hwp"].w_sio2 = 1.6 * u.mm
    fit = nominal_model([bent], [data.observed()], SimpleNamespace(chains=[bent]), [data.chain()])
    assert fit.mean_square < 1.2


def test_effects_never_leave_more_than_the_model_without_them():
    base = data.clean_model()
    vector = base.problem.vector(base.fit.coefficients)
    vector[base.problem.free.by_name["derotator.retardance"].slice][3] *= -1
    bent = Model(base.problem, Fit(base.problem.coefficients(vector), np.inf, False), {})
    found = base.with_effects([(get_effect("beam_gain"), None)], like=bent)
    assert found.fit.chi2 <= base.fit.chi2


@pytest.mark.slow
def test_another_zero_of_a_stage_is_found_in_both_directions():
    """A plate that is no exact half-wave plate is another one when it is turned by 90 deg."""
    setup = SETUPS["irdis star"]()
    for by in (45, -45):
        table = setup.observed(flux=1e6).to_table()
        table["derotator"] += by * u.deg
        seen = [Observations.from_table(table, name="night")]
        tried = [get_effect("derotator_offset")]
        _, model, found, _ = starting_model(setup.nominal, seen, tried, lambda line: None)
        assert found, by
        assert model.p_value > 0.01, by


@pytest.mark.slow
def test_a_known_mounting_is_no_row_of_the_data():
    """What is worked out of the rows knows which of them are data: page, proposals, places."""
    fault = {"type": "cell", "place": "in:hwp", "kind": "rotation", "dependence": "time"}
    few = Setup(n_wavelengths=3, n_derotator=3)
    observations, chains, _ = make_challenge(3, setup=few, snr=40.0, fault=fault)
    told = to_dict(diagnose(chains, observations))
    assert told["verdict"] in ("named", "located")
    assert told["causes"][0]["cell"]["dependence"] == "time"


def test_what_noise_may_hide_holds_in_95_of_100():
    true = data.with_effect(DIATTENUATOR, horizontal=0.001)
    models = [data.fitted(data.observed(true, seed=seed)) for seed in range(20)]
    clean = [data.fitted(data.observed(seed=seed)).fit.chi2 for seed in range(20)]
    # the same noise with and without the effect
    hidden = np.mean([model.fit.chi2 for model in models]) - np.mean(clean)
    assert hidden > 80
    assert sum(model.could_hide() >= hidden for model in models) >= 17


def test_errors_of_sizes_are_those_of_the_report():
    """Also where the residuals are larger than the noise, as they are of a missing optic."""
    gain = data.with_effect("beam_gain", imbalance=0.003)
    model = data.fitted(data.observed(gain)).with_effect(get_effect("hwp_encoder_two_lobe"))
    assert model.mean_square > 1.5
    errors = data.errors(model.problem, model.fit.coefficients) * np.sqrt(model.mean_square)
    for name, size in Fitted(model).sizes("hwp_encoder_two_lobe").items():
        expected = np.rad2deg(errors[model.problem.slices[name]])
        np.testing.assert_allclose(size["std"], expected, rtol=1e-6)


def test_beams_are_exchanged_from_the_very_frame_on():
    """A frame without a partner on its side of the edge shows in single differences only."""
    wavelength, library = data.WAVELENGTH[::3], [get_effect("beams_swapped")]
    chain, right = data.chain(wavelength), data.observed(flux=1e7, wavelength=wavelength)
    number = np.repeat(np.arange(right.n_frames), right.n_bins)
    # the last is found a frame too early, as long as it is
    cases = {"from frame 14": (14, 31), "up to frame 10": (0, 10), "in frame 12-21": (12, 21)}
    for where, (first, last) in cases.items():
        there = (number >= first) & (number <= last)
        table = right.to_table()
        for key in ("flux_right", "flux_left", "flux_right_err", "flux_left_err"):
            other = key.replace(*(("right", "left") if "right" in key else ("left", "right")))
            table[key] = np.where(there, right.to_table()[other], table[key])
        wrong = Observations.from_table(table, name="run")
        assert starting_model(chain, [wrong], library, lambda line: None)[-1] == f"run {where}"
