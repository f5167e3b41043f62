# Licensed under a 3-clause BSD style license - see LICENSE
"""Sizes within their limits, and effects that go with others."""

import gap_data as data
import numpy as np
import pytest

from astropolcal.gap.effects import Context, get_effect
from astropolcal.gap.selection import _CLEARLY, _pushes

DIATTENUATOR = "static_diattenuator"


@pytest.fixture(scope="module")
def strong():
    """Data with a static diattenuator beyond what the library takes for possible."""
    true = data.with_effect(DIATTENUATOR, horizontal=0.5)
    return data.fitted(data.observed(true, flux=1e7))


def sizes(model, key="horizontal"):
    return model.sizes(DIATTENUATOR)[f"gap_{DIATTENUATOR}.{key}"][0]


def test_a_free_size_stays_within_its_limit_and_counts_as_impossible(strong):
    context = Context(strong.context.wavelength, strong.context.flux, None)
    model = strong.with_effect(get_effect(DIATTENUATOR), context)
    assert np.abs(sizes(model)).max() == pytest.approx(0.3)
    assert not model.is_physical(DIATTENUATOR)
    assert model.impossible() == {DIATTENUATOR}


def test_a_possible_size_is_found_as_it_is():
    true = data.with_effect(DIATTENUATOR, horizontal=0.2)
    model = data.fitted(data.observed(true, flux=1e7))
    context = Context(model.context.wavelength, model.context.flux, None)
    model = model.with_effect(get_effect(DIATTENUATOR), context)
    np.testing.assert_allclose(sizes(model), 0.2, atol=0.003)
    assert model.impossible() == set()


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


def test_an_effect_without_a_place_is_left_out():
    model = data.clean_model()
    assert not get_effect("m3_diattenuation").applies(model.chains)
    assert model.with_effects([(get_effect("m3_diattenuation"), None)]) is model


class _Model:
    """What `_pushes` looks at."""

    def __init__(self, chi2, added, impossible):
        self.fit, self.added = type("Fit", (), {"chi2": chi2}), dict.fromkeys(added)
        self._impossible = set(impossible)

    def impossible(self):
        return self._impossible


def test_nothing_is_taken_out_of_its_limits_for_little():
    old = _Model(100.0, ["a"], [])
    assert _pushes(_Model(99.0, ["a", "b"], ["a"]), old)
    assert not _pushes(_Model(99.0 * _CLEARLY, ["a", "b"], ["a"]), old)
    assert not _pushes(_Model(99.0, ["a", "b"], ["b"]), old)
    assert not _pushes(_Model(99.0, ["a", "b"], ["a"]), _Model(100.0, ["a"], ["a"]))
